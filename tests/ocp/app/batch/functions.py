"""Functions that the tests' batches are of, and a driver of them. Workers import this module, so it imports little."""

from __future__ import annotations

import errno
import json
import math
import os
import signal
import sys
import time
from typing import Any

import numpy as np

from ocp import Collocation, Problem, ProblemError, Solution, SolveError, prepare
from ocp.app.batch import cached, run_batch


def square(task: Any) -> dict[str, Any]:
    """A cost, after a while (and not before a file is there), with a line in a log for each call that ends."""
    while "gate" in task and not os.path.exists(task["gate"]):
        time.sleep(0.02)
    time.sleep(task.get("wait", 0.0))
    if "log" in task:
        with open(task["log"], "a", encoding="utf-8") as log:
            log.write(f"{task['x']}\n")
    return {
        "cost": math.sin(task["x"]) ** 2,
        "name": f"x = {task['x']}",
        "process": os.getpid(),
        "drawn": float(np.random.random()),  # noqa: NPY002
    }


def same(task: Any) -> Any:
    """The task."""
    return task


def deadly(task: Any) -> float:
    """A number, or the end of the worker, with a line in a log."""
    if task["kill"]:
        with open(task["log"], "a", encoding="utf-8") as log:
            log.write("killed\n")
        os.kill(os.getpid(), signal.SIGKILL)
    return float(task["x"])


def endings(task: str) -> Any:
    """Each way in which a function ends that is no result."""
    if task == "problem":
        raise ProblemError("the arm is too short", name="arm")
    if task == "solve":
        raise SolveError("no motion was found", name="tip")
    if task == "mistake":
        return 1 / 0
    if task == "exit":
        sys.exit("left")
    if task == "interrupt":
        raise KeyboardInterrupt
    if task == "set":
        return {"found": {1, 2}}
    return {"nan": math.nan, "inf": [1.0, math.inf], "inside": {"a": {"b": [0.0, math.nan]}}, "good": 1.5}[task]


def arm(stiffness: float) -> Any:
    """A spring that is pulled, prepared; the payload is a parameter."""
    problem = Problem("spring")
    x = problem.state("x", initial=0.0, terminal=1.0)
    v = problem.state("v", initial=0.0, terminal=0.0)
    u = problem.control("u")
    mass = problem.parameter("mass")
    problem.dynamics(x, v)
    problem.dynamics(v, (u - stiffness * x**3) / mass)
    problem.horizon(1.0)
    problem.minimize(u**2)
    return prepare(problem, Collocation(intervals=4, degree=3))


def read(path: str) -> str:
    """A file's text, which has to begin with a digit."""
    with open(path, encoding="utf-8") as stream:
        text = stream.read()
    return f"{int(text[0])}"


def of_file(task: Any) -> float:
    """A number of a file, plus another."""
    return float(cached(read, task["file"])) + float(task["x"])


def spring(task: Any) -> dict[str, Any]:
    """A solution, of a problem that is prepared once in each worker."""
    result = cached(arm, task["stiffness"])
    return {"plan": result.solve(parameters={"mass": task["mass"]}), "built": id(result), "process": os.getpid()}


def warm(task: Any, guess: Any) -> dict[str, Any]:
    """The same from a neighbour's solution."""
    solution: Solution = cached(arm, 1.0).solve(
        parameters={"mass": task["mass"]}, guess=None if guess is None else guess["plan"]
    )
    by_name = {"solver": solution.solver, "guess": None if guess is None else guess["mass"]}
    return {"plan": solution, **by_name, **task}


def without_room(task: Any) -> float:
    """As on a disk that is full for as long as there is a file."""
    if os.path.exists(task["until"]):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "plan.npz")
    return 1.0


def main() -> None:
    """A driver: `python -m tests.ocp.app.batch.functions '{"folder": ..., "tasks": [...], "workers": 2}'`."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # shells start background jobs with Ctrl-C ignored
    request = json.loads(sys.argv[1])
    done = run_batch(square, request["tasks"], request["folder"], cluster=request["workers"])
    print(done, flush=True)


if __name__ == "__main__":
    from tests.ocp.app.batch import functions

    functions.main()
