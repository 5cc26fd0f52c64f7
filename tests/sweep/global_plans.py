"""Plans by global search for seeded tasks, compared with the best of many solves from random start configurations.

python -m tests.sweep.global_plans --out FILE [--only panda] [--starts 200] [--minutes 60] [--again]

A global plan may cost at most 0.5 % more than the best solve, whose start configuration is free as well. The gap to the
lower bound may be 2 % with one redundant degree of freedom, and 10 % with two. For 1000 random planar arms no solves
are compared, since the bound already tells how far the cost is from the least cost: the gap may be 2 % with one
redundant degree of freedom, and 8 % with two. Results are added line by line to a file. A task that is in the file is
not planned again; with --again, a result of older code is replaced, but the solves from random starts are kept.
"""

from __future__ import annotations

import time
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase
from models.checks import Array
from ocp import Collocation, ProblemError, SolveError, TipTask, inverse_kinematics, plan, plan_problem, prepare
from ocp.direct.guess import Samples
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.local.rates import track_tasks
from ocp.motion.search.dead_end import DeadEnd
from ocp.motion.tasks.equations import bind
from tests.ocp.motion.search.test_charts import planar
from tests.ocp.motion.tasks.space_tasks import panda, ur5
from tests.sweep.results import Row, Sweep, parser

SECONDS = 4.0
KINDS = {"panda": (panda, 1), "ur5": (ur5, 1), "planar": (lambda: planar(np.array([0.4, 0.3, 0.3, 0.2]), 2.0), 2)}
"""Machines and redundant degrees of freedom: a prescribed pose, a free roll, and a prescribed position in a plane."""
RANDOM_KINDS = ("plain", "cut", "slow", "turning", "two")
"""Random planar arms: wide joint limits; narrow joint limits; low velocity limits; continuous joints; four joints."""
COUNTS = {"panda": 100, "ur5": 50, "planar": 150, **dict.fromkeys(RANDOM_KINDS, 200)}
"""Number of tasks of each kind."""
GAPS = {1: 0.02, 2: 0.1}
RANDOM_GAPS = {False: 0.02, True: 0.08}
"""Largest relative gap for random planar arms, by whether they have two redundant degrees of freedom."""
EXCESS = 0.005
"""Largest relative excess of a global plan's cost over the best of the solves from random starts."""
MESH, MAX_ITERATIONS, TRACKING_STEPS, DAMPING = Collocation(12, 3), 150, 40, 0.01
"""Mesh and iterations of the solves from random starts; steps and relative damping of the local motions that are their
guesses."""
DISTINCT = 1e-4
"""Relative difference from which two costs belong to different local optima."""
CHECKED_COUNT = 5
"""Number of times at which a task must be within reach."""


def task_of(kind: str, seed: int) -> tuple[FixedBase, TipTask]:
    """Return a machine and a curved path of its tip from a random configuration, within reach all along."""
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
    """Return a random planar arm and a curved path of its tip."""
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
    """Return the promises that the plan of a random arm breaks: the gap to its bound, or its audit.

    An arm may have no motion within its limits.
    """
    if not np.isfinite(row["cost"]):
        return [] if row["impossible"] else ["error"]
    near = row["bound"] <= row["cost"] * (1 + 1e-9) and row["bound"] >= (1 - RANDOM_GAPS[kind == "two"]) * row["cost"]
    return ["gap"] * (not near) + ["audit"] * (not row["passed"])


def by_search(kind: str, seed: int) -> dict[str, Any]:
    """Return the cost, the bound and the processor time of the global plan."""
    machine, task = random_task(kind, seed) if kind in RANDOM_KINDS else task_of(kind, seed)
    row: dict[str, Any]
    begun = time.process_time()
    try:
        result = plan(machine, task, search="global", scene=False)
        row = {"cost": result.cost, "bound": result.bound, "passed": result.audit().passed}
    except (SolveError, ProblemError) as error:
        impossible = isinstance(error, Unreachable) or (isinstance(error, DeadEnd) and error.proven)
        row = {"cost": np.inf, "bound": 0.0, "passed": False, "impossible": impossible, "said": str(error)[:200]}
    return row | {"seconds": time.process_time() - begun}


def by_starts(kind: str, seed: int, starts: int) -> dict[str, Any]:
    """Return the lowest cost of local optima found from random start configurations, and the processor time of all.

    The guesses are the local motions from random IK solutions; the solver is free to move their starts. The best local
    optimum on the coarse mesh that `plan` confirms from its start configuration, with an audit, is the result.
    """
    machine, task = task_of(kind, seed)
    begun = time.process_time()
    solutions = list[Array]()
    while len(solutions) < starts:
        first = 1000 * seed + len(solutions)
        solutions += [each.joints for each in inverse_kinematics(machine, task, seed=first, starts=starts)]
    joints, times = np.array(solutions[:starts]), np.linspace(0, SECONDS, TRACKING_STEPS + 1)
    motion = track_tasks(
        bind(machine, task),
        joints,
        np.zeros((starts, 0)),
        times,
        weights=np.ones(joints.shape[1]),
        damping=DAMPING,
        lower=machine.robot.lower,
        upper=machine.robot.upper,
    )
    problem, optima = plan_problem(machine, task, scene=False), list[tuple[float, Array]]()
    prepared = prepare(problem, MESH, options={"max_iter": MAX_ITERATIONS})
    for k in range(starts):
        guess = {"joints": Samples(times, motion.joints[k]), "rates": Samples(times, motion.rates[k])}
        solution = prepared.solve(guess=guess, check=False)
        if solution.success:
            optima.append((solution.cost, solution["joints"][0]))
    best, previous = np.inf, -np.inf
    for cost, start in sorted(optima, key=lambda optimum: optimum[0]):
        if cost <= previous * (1 + DISTINCT):
            continue
        previous = cost
        try:
            best = plan(machine, task, start=start, search="start", scene=False).cost
        except (SolveError, ProblemError):
            continue
        break
    failed = starts - len(optima)
    return {"best": best, "failed": failed, "starts": starts, "starts_seconds": time.process_time() - begun}


def faults(kind: str, row: dict[str, Any]) -> list[str]:
    """Return the promises that the result of a task breaks."""
    result = list[str]()
    if row["cost"] > row["best"] * (1 + EXCESS):
        result.append("costlier")
    if row["bound"] > min(row["best"], row["cost"]) * (1 + 1e-6):
        result.append("bound above")
    if np.isfinite(row["cost"]) and row["bound"] < (1 - GAPS[KINDS[kind][1]]) * row["cost"]:
        result.append("gap")
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
