"""Every task is done once and only once, and what is kept is what was returned."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ocp import ProblemError, SolveError
from ocp.app.batch import BatchError, cached, read_batch, run_batch
from ocp.app.batch.result_store import ResultStore
from ocp.app.batch.run import source_version
from tests.ocp.app.batch import functions
from tests.ocp.app.batch.drivers import ROOT, count, driver, runs, stored, until, workers_of

X = [{"x": i} for i in range(12)]


def test_results_are_the_returned_values_in_the_order_of_the_tasks(tmp_path: Path, pair: Any) -> None:
    tasks = [{"x": i} for i in (5, 3, 9, 0, 7)]
    batch = run_batch(functions.square, tasks, tmp_path / "b", cluster=pair)
    assert [result.task for result in batch] == tasks
    assert batch.counts == {"done": 5}
    for result, task in zip(batch, tasks, strict=True):
        there = functions.square(task)
        assert result.value["process"] != os.getpid()
        assert result.value["name"] == there["name"]
        assert result.cost == there["cost"]
        assert result.seconds > 0
    assert len({result.value["drawn"] for result in batch}) == 5  # no two workers draw the same
    assert [result.key for result in read_batch(tmp_path / "b")] == sorted(result.key for result in batch)


def test_a_repeated_batch_computes_missing_or_damaged_results_alone(tmp_path: Path, here: Any) -> None:
    tasks = [{"mass": 1.0 + i, "stiffness": 0.0} for i in range(8)]
    batch = run_batch(functions.spring, tasks[:6], tmp_path / "b", cluster=here)
    before = stored(tmp_path / "b")
    folder = tmp_path / "b" / "results"
    files = [folder / result.key[:2] / result.key for result in batch]
    files[0].with_suffix(".json").write_bytes(b"")
    files[1].with_suffix(".json").write_text(files[1].with_suffix(".json").read_text()[:-20])
    plan = files[2].with_suffix(".0.npz")
    plan.write_bytes(plan.read_bytes()[:-100])
    (files[3].parent / f"{files[3].name}.json.12345678.part").write_text("cut sho")
    costs = [result.cost for result in batch]
    assert len(read_batch(tmp_path / "b")) == 3
    again = run_batch(functions.spring, tasks, tmp_path / "b", cluster=here)
    assert [result.cost for result in again][:6] == costs
    assert len(read_batch(tmp_path / "b")) == 8
    assert again[2].value["plan"].cost == costs[2]
    after = stored(tmp_path / "b")
    assert {name for name in before if after[name] == before[name]} == {f"{batch[i].key}.json" for i in (3, 4, 5)}
    assert run_batch(functions.spring, tasks, tmp_path / "b").counts == {"done": 8}
    assert stored(tmp_path / "b") == after


def test_one_content_is_one_task_whatever_the_order_of_its_names(tmp_path: Path, here: Any) -> None:
    tasks: list[Any] = [
        {"a": 1.0, "b": [1, 2]},
        {"b": (1, 2), "a": np.float64(1.0)},
        {"b": np.array([1, 2]), "a": 1.0},
        {"a": np.nextafter(1.0, 2.0), "b": [1, 2]},
        {"a": 1, "b": [1, 2]},
        {"a": True, "b": [1, 2]},
        {"ü": "é", "数": "😀"},
        {"u\u0308": "é", "数": "😀"},
        "text",
        None,
        [],
        {},
        -0.0,
        0.0,
    ]
    batch = run_batch(functions.same, tasks, tmp_path / "b", cluster=here)
    assert len(batch) == len(tasks) - 2
    assert [result.value for result in batch] == [result.task for result in batch]
    assert batch[1].value == {"a": 1.0000000000000002, "b": [1, 2]}
    assert [type(batch[i].value["a"]) for i in range(4)] == [float, float, int, bool]
    assert [result.value for result in batch][4:6] == tasks[6:8]
    batch.write_csv(tmp_path / "a.csv")
    assert "数" in (tmp_path / "a.csv").read_text(encoding="utf-8")


def test_plans_are_kept_as_files_and_problems_are_prepared_once_in_a_worker(tmp_path: Path, pair: Any) -> None:
    tasks = [{"mass": 1.0 + 0.1 * i, "stiffness": float(i % 2)} for i in range(8)]
    batch = run_batch(functions.spring, tasks, tmp_path / "b", cluster=pair)
    matches = [result.value for result in batch]
    for task, result, value in zip(tasks, batch, matches, strict=True):
        assert value["plan"].cost == result.cost
        assert value["plan"].parameters["mass"] == pytest.approx(task["mass"], abs=0.0)
        if not task["stiffness"]:
            assert result.cost == pytest.approx(12 * task["mass"] ** 2, rel=1e-9)  # integral of (m a)^2, a = 6 - 12 t
    distinct = {(value["process"], value["built"]) for value in matches}
    assert len(distinct) <= 2 * len({value["process"] for value in matches}) <= 4


@pytest.mark.long
def test_tasks_begin_from_the_results_of_neighbours_the_same_whoever_does_them(
    tmp_path: Path, here: Any, pair: Any
) -> None:
    tasks = [{"mass": float(mass)} for mass in np.linspace(1.0, 3.0, 16)]
    alone = run_batch(functions.warm, tasks, tmp_path / "alone", cluster=here, near=["mass"])
    both = run_batch(functions.warm, tasks[::-1], tmp_path / "both", cluster=pair, near=["mass"])
    own = {result.key: result for result in both}
    cold = [result for result in alone if result.neighbour is None]
    assert len(cold) == 1
    assert cold[0].value["guess"] is None
    by_key = {result.key: result for result in alone}
    for result in alone:
        assert result.neighbour == own[result.key].neighbour
        assert result.cost == own[result.key].cost
        if result.neighbour is not None:
            assert result.value["guess"] == by_key[result.neighbour].task["mass"]
    assert cold[0].value["solver"] == "ipopt"
    assert {result.value["solver"] for result in alone if result.neighbour is not None} == {"newton"}


# ---- what ends otherwise -----------------------------------------------------------------------------------------


def test_errors_and_numbers_that_are_none_are_failures_with_their_reason_and_not_tried_again(
    tmp_path: Path, here: Any
) -> None:
    by_name = {
        "problem": ("ProblemError", "the arm is too short"),
        "solve": ("SolveError", "no motion was found"),
        "mistake": ("ZeroDivisionError", "float division by zero (functions.py, line "),
        "exit": ("SystemExit", "left"),
        "interrupt": ("KeyboardInterrupt", ""),
        "set": ("ProblemError", "the result['found'] is a set, which is not data"),
        "nan": ("ProblemError", "the result is nan, not a finite number"),
        "inf": ("ProblemError", "the result[1] is inf"),
        "inside": ("ProblemError", "the result['a']['b'][1] is nan"),
    }
    batch = run_batch(functions.endings, [*by_name, "good"], tmp_path / "b", cluster=here, failures="return")
    assert batch.counts == {"failed": len(by_name), "done": 1}
    for result in batch.results[:-1]:
        error, words = by_name[result.task]
        assert result.error == error
        assert words.replace("float division", "division") in result.message.replace("float division", "division")
        assert result.cost is None
        with pytest.raises(SolveError, match="failed") as caught:
            _ = result.value
        assert caught.value.name == "task"
    assert batch[-1].cost == 1.5
    assert "9 failed, 1 done" in str(batch)
    assert "1 x failed: ProblemError the arm is too short" in str(batch)
    before = stored(tmp_path / "b")
    words = '9 tasks: 0 done, 9 failed, first: ProblemError: the arm is too short; run again with again="failed"'
    with pytest.raises(BatchError, match=words) as again:
        run_batch(functions.endings, list(by_name), tmp_path / "b", cluster=here)
    assert stored(tmp_path / "b") == before
    assert (again.value.name, again.value.value) == ("b", 9)
    assert again.value.batch is not None
    assert again.value.batch.counts == {"failed": 9}
    run_batch(functions.endings, list(by_name), tmp_path / "b", cluster=here, again="failed", failures="return")
    after = stored(tmp_path / "b")
    assert sum(after[name][0] != before[name][0] for name in before) == len(by_name)


@pytest.mark.long
def test_a_task_that_always_ends_its_worker_is_set_aside_and_the_others_are_done(tmp_path: Path) -> None:
    log = tmp_path / "log"
    tasks = [{"x": i, "kill": i == 2, "log": str(log)} for i in range(6)]
    batch = run_batch(functions.deadly, tasks, tmp_path / "b", cluster=1, failures="return")
    assert batch.counts == {"done": 5, "killed": 1}
    assert log.read_text() == 3 * "killed\n"
    assert batch[2].message == "it ended 3 workers"
    with pytest.raises(BatchError, match="5 done, 1 failed, first: killed: it ended 3 workers"):
        run_batch(functions.deadly, tasks, tmp_path / "b", cluster=1)
    assert log.read_text() == 3 * "killed\n"


def test_ctrl_c_stops_a_batch_whose_tasks_never_end_and_the_rest_is_done_later(tmp_path: Path, here: Any) -> None:
    never = {"gate": str(tmp_path / "gate")}
    tasks = [{"x": i, **(never if i >= 4 else {})} for i in range(8)]
    process = driver(tmp_path / "b", tasks)
    until(lambda: count(tmp_path / "b") == 4)
    workers = workers_of(process.pid)
    assert len(workers) == 2
    process.send_signal(signal.SIGINT)
    message, _ = process.communicate()
    assert "KeyboardInterrupt" in message
    until(lambda: not any(runs(worker) for worker in workers))
    assert len(run_batch(functions.square, tasks[:4], tmp_path / "b", cluster=here)) == 4


# ---- what cannot be begun ----------------------------------------------------------------------------------------


def test_a_function_that_no_worker_finds_is_refused(tmp_path: Path) -> None:
    def inner(task: Any) -> Any:
        return task

    with pytest.raises(ProblemError, match="top level of a module") as caught:
        run_batch(inner, X, tmp_path / "b")
    assert caught.value.name == "function"
    with pytest.raises(ProblemError, match="top level of a module"):
        run_batch(lambda task: task, X, tmp_path / "b")
    with pytest.raises(ProblemError, match="function with a name"):
        run_batch(partial(functions.square), X, tmp_path / "b")
    assert not (tmp_path / "b").exists()


GUARD = "if __name__ == '__main__':\n    print(run_batch(double, [1.5, 2.5], 'b', cluster=1), end='')\n"
SCRIPT = "from ocp.app.batch import run_batch\ndef double(task):\n    return 2 * task\n"


@pytest.mark.long
@pytest.mark.parametrize(
    ("end", "says"),
    [(GUARD, "b: 2 done"), (GUARD.partition("\n")[2].lstrip(), "call it under if __name__ == '__main__'")],
    ids=["with its guard", "without"],
)
def test_a_script_runs_its_own_function_under_its_guard(end: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT + end)
    completed = subprocess.run(
        [sys.executable, "script.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert says in completed.stdout + completed.stderr
    assert (completed.returncode == 0) == (says == "b: 2 done")
    if not completed.returncode:
        (tmp_path / "other.py").write_text((SCRIPT + end).replace("2 *", "3 *"))
        assert json.loads((tmp_path / "b" / "batch.json").read_text())["function"] == "script:double"


@pytest.mark.long
def test_a_folder_of_another_function_version_or_program_is_refused(tmp_path: Path) -> None:
    ResultStore.of(tmp_path / "b", "tests.ocp.app.batch.functions:square", source_version(functions.square), False)
    run_batch(functions.square, X[:1], tmp_path / "b")
    with pytest.raises(ProblemError, match=r"contains results of .*square, not of .*same") as caught:
        run_batch(functions.same, X, tmp_path / "b")
    assert caught.value.name == "folder"
    with pytest.raises(ProblemError, match="use another folder") as caught:
        run_batch(functions.square, X, tmp_path / "b", version="2")
    assert caught.value.name == "version"
    head = tmp_path / "b" / "batch.json"
    written = json.loads(head.read_text())
    head.write_text(json.dumps(written | {"version": "0123"}))
    with pytest.raises(ProblemError, match=r"the source has changed: .* pass version='0123'"):
        run_batch(functions.square, X, tmp_path / "b")
    run_batch(functions.square, [], tmp_path / "b", version="0123")
    head.write_text(json.dumps(written | {"format": 7}))
    with pytest.raises(ProblemError, match="format 7"):
        run_batch(functions.square, X, tmp_path / "b")
    head.write_text("{")
    with pytest.raises(ProblemError, match="damaged"):
        run_batch(functions.square, X, tmp_path / "b")
    with pytest.raises(ProblemError, match="not the folder of a batch"):
        run_batch(functions.square, X, tmp_path)
    assert not (tmp_path / "results").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(ProblemError, match="not a folder"):
        run_batch(functions.square, X, tmp_path / "file")


def test_cached_objects_are_made_once_for_each_content_and_evicted_in_turn() -> None:
    results: list[float] = []

    def make(value: dict[str, float]) -> float:
        results.append(value["a"])
        return value["a"]

    assert [cached(make, {"a": value}) for value in (1.0, 1.0, 2.0, 1.0)] == [1.0, 1.0, 2.0, 1.0]
    assert results == [1.0, 2.0]
    for value in range(3, 10):
        cached(make, {"a": float(value)})
    cached(make, {"a": 1.0})
    cached(make, {"a": 2.0})
    assert results[-1] == 2.0
    assert results.count(1.0) == 1 or results.count(1.0) == 2
