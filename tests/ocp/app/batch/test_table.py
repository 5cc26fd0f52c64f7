"""Tables say of every task what came of it; the best is the cheapest that is done and sound; neighbours are near."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyarrow import parquet

from ocp import Collocation, Problem, Solution, solve
from ocp.app.batch import Batch, read_batch
from ocp.app.batch.engine import failure_payload
from ocp.app.batch.result_store import ResultStore, as_data, canonical_text, key_of, pack_result, unpack_result
from ocp.app.batch.run import neighbours, source_version


def written(folder: Path, results: list[tuple[Any, Any]]) -> Batch:
    """A folder with these tasks and what the function returned; an exception is one."""
    store = ResultStore.of(folder, "m:f", "1", True)
    for task, value in results:
        if isinstance(value, Exception):
            record, files = failure_payload("failed", type(value).__name__, str(value))
        else:
            result = pack_result(value)
            record, files = (
                {"status": "done", "error": "", "message": "", "seconds": 0.25, **result.record},
                result.files,
            )
        own = {"key": key_of(canonical_text(task, "task")), "task": task, "neighbour": None, "inputs": {}}
        store.write({**own, **record}, files)
    return read_batch(folder)


def solved() -> Solution:
    problem = Problem("integrator")
    x, u = problem.state("x", initial=0.0, terminal=1.0), problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize(u**2)
    return solve(problem, Collocation(intervals=2, degree=2))


RESULTS: list[tuple[Any, Any]] = [
    ({"robot": "a", "x": 0.1}, {"cost": 3.0, "verdict": True, "turns": 2}),
    ({"robot": "a", "x": 0.2}, {"cost": 1.0, "verdict": False, "turns": 4}),
    ({"robot": "a", "x": 1 / 3}, {"cost": 2.0, "verdict": None, "note": 'said "no", and\nleft'}),
    ({"robot": "ü", "x": [1, 2]}, 0.5),
    ({"robot": "ü", "x": 5}, ValueError("too far, by 1 m")),
    ({"robot": "c"}, ValueError("too far")),
]


def test_a_table_has_a_row_for_each_result_and_every_digit(tmp_path: Path) -> None:
    batch = written(tmp_path / "b", RESULTS)
    batch.write_csv(tmp_path / "a.csv")
    batch.write_parquet(tmp_path / "a.parquet")
    with open(tmp_path / "a.csv", encoding="utf-8", newline="") as stream:
        texts = list(csv.DictReader(stream))
    table = parquet.read_table(tmp_path / "a.parquet").to_pylist()
    assert len(texts) == len(table) == len(RESULTS)
    values = {canonical_text(task, "task"): value for task, value in RESULTS}
    for result, text, row in zip(batch, texts, table, strict=True):
        value = values[canonical_text(result.task, "task")]
        assert text["key"] == row["key"] == result.key
        assert row["cost"] == result.cost == (None if text["cost"] == "" else float(text["cost"]))
        assert text["status"] == row["status"] == ("failed" if isinstance(value, Exception) else "done")
        assert text["message"] == row["message"] == (str(value) if isinstance(value, Exception) else "")
        assert row["verdict"] == (value.get("verdict") if isinstance(value, dict) else None)
        assert row["task.robot"] == result.task["robot"]
        x = result.task.get("x")
        assert text["task.x"] == ("" if x is None else json.dumps(x))
        assert row["task.x"] == (None if x is None else json.dumps(x))  # numbers and lists: all as texts
        assert row["result.turns"] == (value.get("turns") if isinstance(value, dict) else None)
        assert text["result.note"] == (value.get("note", "") if isinstance(value, dict) else "")
    assert batch.counts == {"done": 4, "failed": 2}
    assert "1 x failed: ValueError too far, by 1 m" in str(batch)


def test_no_text_in_a_table_begins_a_formula_and_numbers_stay(tmp_path: Path) -> None:
    texts = ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "%3D1", "a=1", ""]
    results = [({"name": text, "x": -1.5}, {"note": text, "cost": -2.0}) for text in texts]
    written(tmp_path / "b", results).write_csv(tmp_path / "a.csv")
    with open(tmp_path / "a.csv", encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row in rows:
        assert not any(row[name].startswith(tuple("=+-@\t\r")) for name in ("task.name", "result.note"))
        assert unquote(row["task.name"][:3]) + row["task.name"][3:] in texts
        assert (float(row["task.x"]), float(row["cost"])) == (-1.5, -2.0)


def test_the_best_of_a_group_has_the_lowest_cost_among_valid_results(tmp_path: Path) -> None:
    batch = written(tmp_path / "b", RESULTS)
    best = batch.best("robot")
    assert {group: result.cost for group, result in best.items()} == {"a": 2.0, "ü": 0.5}
    assert batch.best(lambda task: None)[None].cost == 0.5


@pytest.mark.parametrize(
    "at", [lambda plan: plan, lambda plan: {"a": [1, {"b": plan}], "c": plan}, lambda plan: [plan, 2.5]]
)
def test_solutions_come_back_wherever_they_stood(at: Any) -> None:
    plan = solved()
    payload = pack_result(at(plan))
    json.dumps(payload.record)
    assert len(payload.files) == len(payload.record["files"]) >= 1
    result = unpack_result(payload)

    def same(one: Any, two: Any) -> bool:
        if isinstance(one, Solution):
            return bool(one.cost == two.cost and (one["u"] == two["u"]).all() and two.audit().feasible)
        if isinstance(one, dict):
            return one.keys() == two.keys() and all(same(one[name], two[name]) for name in one)
        if isinstance(one, list):
            return len(one) == len(two) and all(same(*pair) for pair in zip(one, two, strict=True))
        return bool(one == two)

    assert same(at(plan), result)


def test_the_cost_is_that_of_the_function_or_of_the_only_plan() -> None:
    plan = solved()
    assert pack_result(plan).record["cost"] == plan.cost
    assert pack_result({"plan": plan, "cost": 7}).record["cost"] == 7.0
    assert pack_result({"one": plan, "two": plan}).record["cost"] is None
    assert pack_result(3).record["cost"] == 3.0
    assert pack_result(True).record["cost"] is None
    assert pack_result({"cost": "dear"}).record["cost"] is None
    assert pack_result(None).record == {"cost": None, "verdict": None, "value": None, "files": []}


def test_data_are_plain_and_their_own() -> None:
    options = {"a": (np.int64(1), np.arange(2.0)), "b": [np.bool_(True)]}
    assert as_data(options, "task") == {"a": [1, [0.0, 1.0]], "b": [True]}
    assert canonical_text({"b": 1, "a": {"d": 1, "c": 2}}, "task") == '{"a":{"c":2,"d":1},"b":1}'
    assert len({key_of(canonical_text(value, "task")) for value in (0.1, 0.1 + 1e-18, np.float64(0.1))}) == 1
    assert len({key_of(canonical_text(value, "task")) for value in (0.1, np.nextafter(0.1, 1), np.float32(0.1))}) == 3


def test_a_neighbour_is_the_nearest_of_all_generations_before() -> None:
    chance = np.random.default_rng(0)
    tasks: dict[str, Any] = {
        key_of(str(i)): {"x": float(x), "y": [float(y), 0.0]} for i, (x, y) in enumerate(chance.random((300, 2)))
    }
    result = neighbours(tasks, ["x", "y"])
    order = list(result)
    assert sorted(order) == order == sorted(tasks)
    places = np.array([[tasks[key]["x"], tasks[key]["y"][0]] for key in order])
    places /= np.ptp(places, axis=0)
    assert result[order[0]] is None
    for i in range(1, len(order)):
        before = 2 ** int(np.log2(i))
        assert result[order[i]] == order[int(np.argmin(np.linalg.norm(places[:before] - places[i], axis=1)))]
    depth = {order[0]: 0}
    for key, parent in list(result.items())[1:]:
        assert parent is not None
        depth[key] = depth[parent] + 1
    assert max(depth.values()) <= 9
    assert neighbours({}, ["x"]) == {}
    assert set(neighbours({key: {"x": 1.0} for key in "abcd"}, ["x"]).values()) >= {None, "a"}


def test_a_version_changes_with_the_code_and_not_with_its_comments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    for name, text in (("one", "return 1"), ("two", "return 1  # as ever"), ("three", "return 2")):
        (tmp_path / f"batch_{name}.py").write_text(f"def f(task):\n    {text}\n")
    versions = [source_version(__import__(f"batch_{name}").f) for name in ("one", "two", "three")]
    assert versions[0] == versions[1] != versions[2]
    assert source_version(len) == ""


@given(st.integers(0, 2**32 - 1), st.floats(1e-4, 1e4))
def test_neighbours_do_not_depend_on_units(seed: int, unit: float) -> None:
    places = np.random.default_rng(seed).random((40, 2))
    one: dict[str, Any] = {f"{k:02}": {"x": x, "y": y} for k, (x, y) in enumerate(places)}
    other = {key: {"x": unit * task["x"], "y": task["y"]} for key, task in one.items()}
    assert neighbours(one, ["x", "y"]) == neighbours(other, ["x", "y"])
