"""A batch whose tasks fail says so, ends a script with status 1, and tries them again when an input has changed."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ocp.app.batch import Batch, BatchError, cached, read_batch, run_batch
from ocp.errors import ProblemError
from tests.ocp.app.batch import functions
from tests.ocp.app.batch.drivers import ROOT, stored

SCRIPT = """
from models import FixedBase, Robot
from ocp.app.batch import cached, run_batch

def arm(file):
    return FixedBase(Robot.from_urdf(file, tip="tool0"))

def joints(task):
    return cached(arm, "robot.urdf").joint_size + task["x"]

if __name__ == "__main__":
    run_batch(joints, [{"x": i} for i in range(20)], "b", cluster=1).write_csv("b.csv")
"""
URDF = """<robot name="r"><link name="base"/><link name="tool0"/><joint name="j" type="continuous"><parent link="base"/>
<child link="tool0"/></joint></robot>"""


def started(folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "script.py"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.long
def test_a_script_whose_file_is_missing_ends_with_status_1_and_is_done_when_the_file_is_there(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    report = started(tmp_path)
    assert report.returncode == 1
    assert "BatchError: b: 20 tasks: 0 done, 20 failed, first: ModelError: " in report.stderr
    (message,) = (line for line in report.stderr.splitlines() if "BatchError: b: " in line)
    assert message.endswith('run again with again="failed"')
    assert "robot.urdf" in message
    assert not (tmp_path / "b.csv").exists()
    (tmp_path / "robot.urdf").write_text(URDF)
    report = started(tmp_path)
    assert (report.returncode, report.stderr) == (0, "")
    rows = list(csv.DictReader((tmp_path / "b.csv").read_text().splitlines()))
    assert [float(row["cost"]) for row in rows] == [1.0 + i for i in range(20)]
    before = stored(tmp_path / "b")
    assert started(tmp_path).returncode == 0
    assert stored(tmp_path / "b") == before


def test_failures_are_tried_again_when_a_file_has_changed_and_results_stay(tmp_path: Path, here: Any) -> None:
    good, bad = tmp_path / "good", tmp_path / "bad"
    good.write_text("1")
    tasks = [{"file": str(file), "x": x} for file in (good, bad) for x in (0, 1)]

    def counts(**options: Any) -> dict[str, int]:
        return run_batch(functions.of_file, tasks, tmp_path / "b", cluster=here, failures="return", **options).counts

    assert counts() == {"done": 2, "failed": 2}
    kept_results = {name: text for name, text in stored(tmp_path / "b").items() if b'"done"' in text[1]}
    message = read_batch(tmp_path / "b").results
    assert {result.error for result in message} == {"", "ProblemError"}
    assert any("cached: read('" in result.message and "FileNotFoundError" in result.message for result in message)
    before = stored(tmp_path / "b")
    assert counts() == {"done": 2, "failed": 2}
    assert stored(tmp_path / "b") == before, "nothing has changed"
    bad.write_text("no digit")
    assert counts() == {"done": 2, "failed": 2}
    assert any("ValueError" in result.message for result in read_batch(tmp_path / "b"))
    bad.write_text("2")
    good.write_text("3")
    assert counts() == {"done": 4}
    now = stored(tmp_path / "b")
    assert {name: now[name] for name in kept_results} == kept_results


@pytest.mark.long
def test_failures_are_repeated_when_the_function_or_its_module_has_changed(tmp_path: Path) -> None:
    def run(helper: str, function: str) -> subprocess.CompletedProcess[str]:
        source = f"""
from ocp.app.batch import run_batch
def helper(x):
    {helper}
def double(task):
    {function}
if __name__ == "__main__":
    print(run_batch(double, [1.5, 2.5], "b", cluster=1))
"""
        (tmp_path / "script.py").write_text(source)
        return started(tmp_path)

    assert "2 tasks: 0 done, 2 failed, first: ZeroDivisionError" in run("return x / 0", "return helper(task)").stderr
    assert "2 failed, first: ValueError: 1.5" in run("return x / 0", "raise ValueError(task)").stderr
    completed = run("return 2 * x", "return helper(task)")
    assert "b: 2 done" in completed.stdout
    assert completed.returncode == 0
    changed = run("return 2 * x", "return 3 * helper(task)")
    assert "the source has changed" in changed.stderr, "results of two functions are not mixed"


def test_again_tries_failures_though_nothing_has_changed(tmp_path: Path, here: Any) -> None:
    gate = tmp_path / "gate"
    tasks = [{"until": str(gate)}]
    before = ["problem", "good"]
    run_batch(functions.endings, before, tmp_path / "b", cluster=here, failures="return")
    first = stored(tmp_path / "b")
    with pytest.raises(BatchError):
        run_batch(functions.endings, before, tmp_path / "b", cluster=here, again="failed")
    again = stored(tmp_path / "b")
    assert sum(again[name][0] != first[name][0] for name in first) == 1
    assert run_batch(functions.without_room, tasks, tmp_path / "c", cluster=here).counts == {"done": 1}


def test_the_error_carries_the_results_and_can_be_had_later(tmp_path: Path, here: Any) -> None:
    batch = run_batch(functions.endings, ["good", "problem", "solve"], tmp_path / "b", cluster=here, failures="return")
    with pytest.raises(BatchError) as caught:
        batch.check()
    assert str(caught.value) == (
        'b: 3 tasks: 1 done, 2 failed, first: ProblemError: the arm is too short; run again with again="failed"'
    )
    assert (caught.value.batch, caught.value.value, caught.value.limit) == (batch, 2, 0)
    assert caught.value.name == "b"
    run_batch(functions.endings, ["good"], tmp_path / "b", cluster=here).check()


def test_errors_of_cached_functions_name_the_function_and_its_arguments(tmp_path: Path) -> None:
    with pytest.raises(ProblemError, match=r"cached: read\('.*nothing'\) raised FileNotFoundError") as caught:
        cached(functions.read, str(tmp_path / "nothing"))
    assert caught.value.name == "make"
    assert isinstance(caught.value.__cause__, FileNotFoundError)


# ---- a folder that others may write ------------------------------------------------------------------------------


def marked(folder: Path) -> dict[str, Any]:
    """The files below a folder and what they hold."""
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def record_of(folder: Path) -> Path:
    (place,) = (folder / "results").glob("*/*.json")
    return place


@pytest.mark.parametrize("linked", ["record", "file", "shard", "head", "results", "lock", "part"])
def test_links_lead_nothing_out_of_the_folder(linked: str, tmp_path: Path, here: Any) -> None:
    """What they point at is neither changed nor removed nor taken for a result."""
    folder, outside = tmp_path / "b", tmp_path / "outside"
    outside.mkdir()
    (outside / "marker").write_text("mine")
    task = {"mass": 1.0, "stiffness": 0.0}
    run_batch(functions.spring, [task], folder, cluster=here)
    record = record_of(folder)
    places = {
        "record": record,
        "file": record.with_suffix(".0.npz"),
        "shard": record.parent,
        "head": folder / "batch.json",
        "part": record.with_name(f"{record.name}.01234567.part"),
    }
    place = places.get(linked, folder / linked)
    target = outside if place.is_dir() else outside / "marker"
    if place.is_dir():
        for path in sorted(place.rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        place.rmdir()
    else:
        place.unlink(missing_ok=True)
    place.symlink_to(target)
    before = marked(outside)
    if linked in ("head", "results", "lock"):
        with pytest.raises(ProblemError, match="is a link") as caught:
            run_batch(functions.spring, [task], folder, cluster=here)
        assert caught.value.name == "folder"
    else:
        batch = run_batch(functions.spring, [task], folder, cluster=here)
        assert batch[0].value["plan"].cost == batch[0].cost
        assert not record.is_symlink()
    assert marked(outside) == before


@pytest.mark.parametrize("kind", ["record", "file", "head", "part"])
def test_pipes_are_not_waited_for(kind: str, tmp_path: Path, here: Any) -> None:
    task = {"mass": 1.0, "stiffness": 0.0}
    folder = tmp_path / "b"
    run_batch(functions.spring, [task], folder, cluster=here)
    record = record_of(folder)
    places = {
        "record": record,
        "file": record.with_suffix(".0.npz"),
        "head": folder / "batch.json",
        "part": record.with_name(f"{record.name}.01234567.part"),
    }
    places[kind].unlink(missing_ok=True)
    os.mkfifo(places[kind])
    if kind == "head":
        with pytest.raises(ProblemError, match="no file, but a folder, a pipe or a device"):
            read_batch(folder)
    elif kind in ("record", "file"):
        assert len(read_batch(folder)) == 0
    else:
        assert run_batch(functions.spring, [task], folder, cluster=here).counts == {"done": 1}


def changed(record: dict[str, Any], **parts: Any) -> str:
    return json.dumps({**record, **parts})


def test_records_that_nobody_wrote_are_none_and_values_that_do_not_fit_are_named(tmp_path: Path, here: Any) -> None:
    folder, task = tmp_path / "b", {"mass": 1.0, "stiffness": 0.0}
    batch = run_batch(functions.spring, [task], folder, cluster=here)
    place = record_of(folder)
    text = place.read_text()
    record = json.loads(text)
    (file,) = record["files"]
    for wrong in (
        "[" * 100_000,
        "[]",
        "7",
        text.replace(str(record["cost"]), "NaN"),
        text.replace(str(record["cost"]), "1e999"),
        changed(record, status="sold"),
        changed(record, task={"mass": 2.0, "stiffness": 0.0}),
        changed(record, key="../../victim"),
        changed(record, inputs=[]),
        changed(record, files=[{**file, "bytes": "many"}]),
        changed(record, more=1),
    ):
        place.write_text(wrong)
        assert len(read_batch(folder)) == 0, wrong[:80]
    for report in (
        {**file, "kind": "Popen"},
        {**file, "at": ["nowhere", 1]},
        {**file, "at": [["plan"]]},
        {**file, "at": ["cost", 0]},
        {"bytes": file["bytes"]},
    ):
        place.write_text(changed(record, files=[report]))
        with pytest.raises(ProblemError):
            _ = read_batch(folder)[0].value
    source = record["inputs"]["source"]
    inputs = {"source": source, "kept": {"\0": None, "/dev/zero": "a", "../../x": 7}}
    place.write_text(changed(record, status="failed", inputs=inputs))
    assert run_batch(functions.spring, [task], folder, cluster=here).counts == {"done": 1}
    assert batch[0].value["plan"].cost == batch[0].cost


def test_a_result_is_read_by_load_alone_and_a_pickle_in_its_place_runs_nothing(tmp_path: Path, here: Any) -> None:
    import numpy as np

    class Collision:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "run"),)

    folder, task = tmp_path / "b", {"mass": 1.0, "stiffness": 0.0}
    run_batch(functions.spring, [task], folder, cluster=here)
    place = record_of(folder)
    file = place.with_suffix(".0.npz")
    np.savez(file, head=np.array([Collision()], dtype=object), allow_pickle=True)
    record = json.loads(place.read_text())
    record["files"][0]["bytes"] = file.stat().st_size
    place.write_text(json.dumps(record))
    with pytest.raises(ProblemError):
        _ = read_batch(folder)[0].value
    assert not (tmp_path / "run").exists()


def test_a_batch_consists_of_results(tmp_path: Path) -> None:
    for wrong in ((1, 2), (None, ()), (tmp_path, [1])):
        with pytest.raises(ProblemError):
            Batch(*wrong)
