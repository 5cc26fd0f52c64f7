"""Seeded tasks planned by search over all motions, beside the best of many random starts.

python -m tests.sweep.global_plans --out FILE [--only panda] [--starts 200] [--minutes 60] [--again]

The global plan must never be dearer than the best of the starts, must cost at most a tenth of their processor time, and
its bound must be within 2 % with one free direction, 10 % with two. Of 1000 random planar arms, no starts are tried,
since the bound tells how far the cost is from the least: at most 2 % with one free direction, 8 % with two. Results are
added line by line to a file; a task that is there already is not done again, or, with --again, only its global plan,
beside the starts of the older code.
"""

from __future__ import annotations

import time
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase
from models.checks import Array
from ocp import ProblemError, SolveError, TipTask, inverse_kinematics, plan
from ocp.motion.local.inverse_kinematics import Unreachable
from tests.ocp.motion.search.test_charts import planar
from tests.ocp.motion.tasks.space_tasks import panda, ur5
from tests.sweep.results import Row, Sweep, parser

SECONDS = 4.0
KINDS = {"panda": (panda, 1), "ur5": (ur5, 1), "planar": (lambda: planar(np.array([0.4, 0.3, 0.3, 0.2]), 2.0), 2)}
"""Machines, and the directions that their tasks leave free: the whole pose, the roll free, and the place in a plane."""
RANDOM_KINDS = ("plain", "cut", "slow", "turning", "two")
"""Random planar arms: limits that hardly matter; that cut the set of postures; slow joints; joints that turn without
end; four joints."""
COUNTS = {"panda": 14, "ur5": 13, "planar": 13, **dict.fromkeys(RANDOM_KINDS, 200)}
"""Tasks of each."""
GAPS = {1: 0.02, 2: 0.1}
RANDOM_GAPS = {False: 0.02, True: 0.08}
"""Of random planar arms with one free direction, and with two."""
SHARE = 0.1
CHECKED_COUNT = 5
"""Times at which a task must be within reach."""


def task_of(kind: str, seed: int) -> tuple[FixedBase, TipTask]:
    """A bent way from a random posture that is within reach all along."""
    rng = np.random.default_rng([sorted(KINDS).index(kind), seed])
    make: Any = KINDS[kind][0]
    machine: FixedBase = make()
    low, high = np.maximum(machine.robot.lower, -np.pi), np.minimum(machine.robot.upper, np.pi)
    while True:
        joints = rng.uniform(0.8 * low, 0.8 * high)
        pose = machine.tip_pose((), joints)
        first, turn = np.array(ca.DM(pose.position)).ravel(), np.array(ca.DM(pose.rotation))
        paths = rng.normal(size=(2, 3))
        paths *= np.array([[rng.uniform(0.1, 0.3)], [rng.uniform(0.0, 0.1)]]) / np.linalg.norm(paths, axis=1)[:, None]

        def where(t: Any, first: Array = first, paths: Array = paths) -> Any:
            s = t / SECONDS
            return ca.DM(first) + s * ca.DM(paths[0]) + ca.sin(2 * np.pi * s) * ca.DM(paths[1])

        if kind == "panda":
            task = TipTask(position=where, orientation=turn, duration=SECONDS)
        elif kind == "ur5":
            task = TipTask(position=where, direction=turn[:, 2], duration=SECONDS)
        else:
            task = TipTask(position=lambda t, where=where: where(t)[:2], rows=[3, 4], duration=SECONDS)
        try:
            for t in np.linspace(0, SECONDS, CHECKED_COUNT):
                inverse_kinematics(machine, task, time=float(t), starts=16)
        except Unreachable:
            continue
        return machine, task


def random_task(kind: str, seed: int) -> tuple[FixedBase, TipTask]:
    """A bent way of the tip of a random arm in a plane."""
    rng = np.random.default_rng([RANDOM_KINDS.index(kind), seed])
    size = 4 if kind == "two" else 3
    limit = {"cut": rng.uniform(1.0, 2.2), "turning": 7.0, "two": 1.6}.get(kind, 2.8)
    speed = rng.uniform(0.15, 0.5) if kind == "slow" else 3.0
    lengths = rng.uniform(0.25, 0.6, size)
    machine = planar(lengths, limit, speed)
    joints = rng.uniform(-1.0, 1.0, size) * min(limit, 2.0)
    first = np.array(ca.DM(machine.tip_pose((), joints).position)).ravel()[:2]
    paths = rng.normal(size=(2, 2))
    paths *= np.array([[rng.uniform(0.1, 0.4)], [0.1]]) / np.linalg.norm(paths, axis=1)[:, None]
    s = np.linspace(0, 1, 200)[:, None]
    farthest = np.linalg.norm(first + s * paths[0] + 4 * s * (1 - s) * paths[1], axis=1).max()
    shrunk = min(1.0, 0.97 * lengths.sum() / farthest)

    def where(t: Any) -> Any:
        s = t / SECONDS
        return shrunk * (ca.DM(first) + s * ca.DM(paths[0]) + 4 * s * (1 - s) * ca.DM(paths[1]))

    return machine, TipTask(position=where, rows=[3, 4], duration=SECONDS)


def random_faults(kind: str, row: dict[str, Any]) -> list[str]:
    """What a random arm's plan breaks: its cost is farther above its bound than it may be, or it fails its audit.

    An arm may have no motion within its limits.
    """
    if not np.isfinite(row["cost"]):
        return [] if "no motion does the tasks" in row["said"] or "reach" in row["said"] else ["error"]
    near = row["bound"] <= row["cost"] * (1 + 1e-9) and row["bound"] >= (1 - RANDOM_GAPS[kind == "two"]) * row["cost"]
    return ["gap"] * (not near) + ["audit"] * (not row["passed"])


def by_search(kind: str, seed: int) -> dict[str, Any]:
    """The global plan: its cost, bound and processor time."""
    machine, task = random_task(kind, seed) if kind in RANDOM_KINDS else task_of(kind, seed)
    row: dict[str, Any]
    begun = time.process_time()
    try:
        result = plan(machine, task, search="global", scene=False)
        row = {"cost": result.cost, "bound": result.bound, "passed": result.audit().passed}
    except (SolveError, ProblemError) as error:
        row = {"cost": np.inf, "bound": 0.0, "passed": False, "said": str(error)[:200]}
    return row | {"seconds": time.process_time() - begun}


def by_starts(kind: str, seed: int, starts: int) -> dict[str, Any]:
    """The best of so many random starts, and the processor time of all."""
    machine, task = task_of(kind, seed)
    begun, best, failed, k = time.process_time(), np.inf, 0, 0
    while k < starts:
        for configuration in inverse_kinematics(machine, task, seed=1000 * seed + k, starts=starts):
            k += 1
            try:
                best = min(best, plan(machine, task, start=configuration.joints, search="start", scene=False).cost)
            except (SolveError, ProblemError):
                failed += 1
            if k == starts:
                break
    return {"best": best, "failed": failed, "starts": starts, "starts_seconds": time.process_time() - begun}


def faults(kind: str, row: dict[str, Any]) -> list[str]:
    """What a task's result breaks of what is promised."""
    result = list[str]()
    if row["cost"] > row["best"] * (1 + 1e-6):
        result.append("dearer")
    if row["bound"] > min(row["best"], row["cost"]) * (1 + 1e-6):
        result.append("bound above")
    if np.isfinite(row["cost"]) and row["bound"] < (1 - GAPS[KINDS[kind][1]]) * row["cost"]:
        result.append("gap")
    if row["seconds"] > SHARE * row["starts_seconds"]:
        result.append("slow")
    if np.isfinite(row["cost"]) and not row["passed"]:
        result.append("audit")
    return result


def main() -> None:
    arguments = parser(__doc__, COUNTS)
    arguments.add_argument("--starts", type=int, default=200)
    options = arguments.parse_args()
    sweep, shown = Sweep(__file__, options, COUNTS), []

    def result(kind: str, seed: int, known: Row | None) -> Row:
        if kind in RANDOM_KINDS:
            row = by_search(kind, seed)
            return row | {"wrong": random_faults(kind, row)}
        names = ("best", "failed", "starts", "starts_seconds", "starts_code")
        starts = {name: known[name] for name in names} if known else by_starts(kind, seed, options.starts)
        row = {"starts_code": sweep.code} | starts | by_search(kind, seed)
        return row | {"wrong": faults(kind, row)}

    for row in sweep.rows(result):
        shown.append(row)
        if row["kind"] in RANDOM_KINDS:
            print(*([row] if row["wrong"] else []), sep="", end="\n" if row["wrong"] else "", flush=True)
            continue
        print(
            f"{row['kind']:7s} {row['seed']:3d}  cost {row['cost']:.6f}  best of starts {row['best']:.6f}  bound "
            f"{row['bound'] / row['cost']:.4f}  time {row['seconds'] / row['starts_seconds']:.3f}  {row['wrong']}",
            flush=True,
        )
    print(sweep.summary(shown))


if __name__ == "__main__":
    main()
