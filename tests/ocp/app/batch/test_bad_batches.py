"""What is no task, no function, no folder and no number of workers is refused by name."""

from __future__ import annotations

import atexit
from functools import cache
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any

import pytest
from distributed import Client, LocalCluster

from ocp.app.batch import Batch, cached, read_batch, run_batch
from ocp.app.batch.result_store import ResultStore
from tests.bad_values import (
    CALLABLE,
    COUNT,
    INF,
    INSTANCE,
    NAN,
    NOTHING,
    SYMBOL,
    TEXT,
    Bad,
    Case,
    assert_refused,
    good_calls,
    method,
    panel,
)
from tests.ocp.app.batch.functions import same

ENDLESS: dict[str, Any] = {}
ENDLESS["a"] = ENDLESS
DEEP: list[Any] = []
for _ in range(100):
    DEEP = [DEEP]

DATA: Bad = SYMBOL | {
    "nan": NAN,
    "inf": [INF],
    "nan inside": {"a": {"b": [NAN]}},
    "bytes": b"a",
    "set": {1},
    "complex": 1j,
    "object": object(),
    "function": same,
    "path": Path("a"),
    "numbers as names": {1: 2},
    "half a character": "\ud800",
    "half a character in a name": {"\ud800": 1},
    "endless": ENDLESS,
    "deep": DEEP,
    "many digits": 10**5000,
}
TASKS: Bad = {label: [1.0, value] for label, value in DATA.items()} | {
    "None": None,
    "number": 3,
    "text": "a",
    "one task": {"a": 1},
    "bytes": b"a",
    "object": object(),
}
FOLDER: Bad = {
    "None": None,
    "number": 3,
    "empty": "",
    "bytes": b"a",
    "list": ["a"],
    "object": object(),
    "file": __file__,
    "in a file": __file__ + "/a",
    "zero byte": "a\0b",
    "store": "s3://bucket/results",
    "root": "/",
}
PATH: Bad = {"None": None, "number": 3, "bytes": b"a", "list": ["a"], "object": object(), "folder": "/"}
NAMES: Bad = {"None": None, "text": "x", "number": 3, "numbers": [1], "object": object()}
CLUSTER: Bad = {"word": "host", "scheme": "http://a", "no host": "tcp://", "object": object(), "list": []}
FUNCTION: Bad = (
    CALLABLE | NOTHING | {"lambda": lambda task: task, "method": DEEP.append, "class": NOTHING.__class__.get}
)


@cache
def folder() -> str:
    """Of a batch in which nothing is left to be done."""
    path = mkdtemp()
    atexit.register(rmtree, path)
    own: Any = {"processes": False, "n_workers": 1, "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(**own) as cluster, Client(cluster, set_as_default=False) as client:
        run_batch(same, TASKS_DONE, path, cluster=client)
    return path


TASKS_DONE = [{"x": 1.0, "y": [1.0, 2.0], "z": "a"}, {"x": 2.0, "y": [1.0, 3.0], "z": "b"}]


def batch() -> Batch:
    return read_batch(folder())


def again(**options: Any) -> Batch:
    return run_batch(**{"folder": folder(), **options})


CASES = [
    Case(
        "run_batch",
        again,
        {"function": same, "tasks": TASKS_DONE},
        {
            "function": FUNCTION,
            "tasks": TASKS,
            "folder": FOLDER,
            "cluster": COUNT | CLUSTER | {"too many": 10**6},
            "near": NAMES | {"unknown": ["nobody"], "no number": ["z"], "one of two": ["x", "nobody"]},
            "again": NAMES | {"unknown": ["nobody"], "done": ["done"], "word": "done"},
            "failures": TEXT | {"unknown": "ignore"},
            "version": TEXT | {"other": "2"},
        },
    ),
    Case("read_batch", read_batch, {}, {"folder": FOLDER | {"nowhere": "/nowhere/to/be/found"}}),
    Case(
        "cached",
        lambda make, argument: cached(make, argument),
        {"make": list, "argument": [1]},
        {"make": CALLABLE | {"raises": int}, "argument": DATA},
    ),
    Case(
        "Batch",
        Batch,
        {"store": ResultStore(Path("b"), "f", "1"), "results": ()},
        {"store": INSTANCE, "results": NAMES | {"one": read_batch}},
    ),
    method(batch, "best", {"by": "z"}, by=NOTHING | {"number": 3, "unknown": "nobody", "list": ["x"], "no text": "y"}),
    method(batch, "write_csv", {"path": "a.csv"}, path=PATH),
    method(batch, "write_parquet", {"path": "a.parquet"}, path=PATH),
]


@pytest.mark.parametrize("case", good_calls([case for case in CASES if case.good]))
def test_valid_values_are_accepted(case: Case, tmp_path: Path) -> None:
    case.call(**{**case.good, **({"path": tmp_path / "a.csv"} if "path" in case.good else {})})


@pytest.mark.parametrize(("case", "argument"), panel(CASES))
def test_bad_input_is_refused_by_name(case: Case, argument: str) -> None:
    assert_refused(case, argument)
