"""Paths of floating arms that are feasible and lead the pseudo-inverse by a singularity: how many are planned.

A motion is made first, its tip's path is the task: so it can be done. The pseudo-inverse loses a factor of 30 in
manipulability on it, or breaks down. Others lead out of reach, and are to be refused, soon.

python -m tests.sweep.passages --out FILE [--only beyond] [--minutes 60] [--again]

Results are added line by line to a file; a path that is there already is not done again.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.polynomial import Chebyshev
from scipy.integrate import solve_ivp

from models import FreeFloating
from models.checks import Array
from models.spatial import quaternion_from_rotation
from ocp import Plan, ProblemError, RateOptions, SolveError, TipTask, plan, resolve
from tests.models.robot.trees import seven_joint_arm
from tests.sweep.results import Row, Sweep, parser

COUNTS = {"pose": 20, "place": 20, "beyond": 10}
"""Paths that ask for the whole pose of the tip, which leaves one direction free, or its place, which leaves four; and
of both by turns that lead out of reach."""
BEYOND, SOON = 4.0, 10.0
"""m out of reach, and s of processor time until that is said."""
PATIENCE = 300.0
"""s, for a path that can be done. Without a limit, planning ends after 20 s if all motions fail."""
SECONDS = 5.0
LOSS = 30.0
"""Factor of manipulability that the pseudo-inverse loses."""
DEGREE = 40
"""Of the Chebyshev series that tell the path."""
SEGMENT_COUNT = 3
"""Harmonics of the motion that is made."""
MOST = 1.0
"""rad/s: about how fast its joints are."""


@dataclass(frozen=True)
class Passage:
    """A task that can be done.

    Attributes:
        machine, task: As of `plan`. start: Joints at the start. joints: Of the motion it was made from, (M, n), at t.
        cost: Of that motion.
    """

    machine: FreeFloating
    task: TipTask
    start: Array
    t: Array
    joints: Array
    cost: float


def series(t: Array, values: Array) -> Any:
    """A function of time through samples (M, k), as casadi knows it."""
    fits = [Chebyshev.fit(t, column, DEGREE, domain=[0.0, SECONDS]) for column in values.T]
    fits = [fit - (fit(0.0) - column[0]) for fit, column in zip(fits, values.T, strict=True)]

    def at(time: Any) -> Any:
        x = 2 * time / SECONDS - 1
        terms = [1.0, x]
        while len(terms) <= DEGREE:
            terms.append(2 * x * terms[-1] - terms[-2])
        return ca.vertcat(*(sum(float(c) * term for c, term in zip(fit.coef, terms, strict=True)) for fit in fits))

    return at


def passage(seed: int, beyond: float = 0.0) -> Passage:
    """Of even seeds the tip's whole pose is asked for, one direction is free; of odd ones its place, four are.

    Args:
        beyond: m, by which the path leaves that of the motion, along x at a steady rate: then it cannot be done.
    """
    rng = np.random.default_rng([15, seed])
    machine = FreeFloating(seven_joint_arm())
    b, q, u = ca.SX.sym("b", 7), ca.SX.sym("q", 7), ca.SX.sym("u", 7)
    rate = ca.Function("rate", [b, q, u], [machine.base_rate(b, q, u)])
    frame = machine.tip_pose(b, q)
    tip = ca.Function("tip", [b, q], [frame.position, frame.rotation])
    whole, paces = seed % 2 == 0, np.pi * np.arange(1, SEGMENT_COUNT + 1) / SECONDS
    t = (1 - np.cos(np.linspace(0, np.pi, 8 * DEGREE))) * SECONDS / 2
    while True:
        start = rng.uniform(-1.5, 1.5, 7)
        waves = rng.normal(size=(SEGMENT_COUNT, 7)) * MOST / np.sqrt(SEGMENT_COUNT)

        def joints(s: Any, start: Array = start, waves: Array = waves) -> Array:
            return np.asarray(start + np.sin(np.multiply.outer(s, paces)) / paces @ waves)

        def rates(s: Any, waves: Array = waves) -> Array:
            return np.asarray(np.cos(np.multiply.outer(s, paces)) @ waves)

        base = solve_ivp(
            lambda s, at: np.array(rate(at, joints(s), rates(s))).ravel(),
            (0.0, SECONDS), machine.base_home(), t_eval=t, rtol=1e-11, atol=1e-12, method="DOP853",
        ).y.T  # fmt: skip
        places, turns = tip.map(len(t))(base.T, joints(t).T)
        quaternions = quaternion_from_rotation(np.array(turns).reshape(3, len(t), 3).transpose(1, 0, 2))
        flips = np.cumprod(np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1.0, 1.0))
        quaternions[1:] *= flips[:, None]
        path = np.array(places).T + np.outer(t, [beyond / SECONDS, 0.0, 0.0])
        by_name: dict[str, Any] = {"position": series(t, path), "duration": SECONDS}
        turn = series(t, quaternions)
        if whole:
            by_name["orientation"] = lambda s, turn=turn: turn(s) / ca.norm_2(turn(s))
        task = TipTask(**by_name)
        if beyond:
            return Passage(machine, task, start, t, joints(t), np.inf)
        local = resolve(machine, task, SECONDS, start=start, samples=101, options=RateOptions(tolerance=1e-7))
        if local.stopped is None and local.manipulability.min() > local.manipulability[0] / LOSS:
            continue
        cost = float(np.trapezoid((rates(t) ** 2).sum(axis=1) / 2, t))
        return Passage(machine, task, start, t, joints(t), cost)


def planned(arguments: Passage, **options: Any) -> Plan | str:
    """The plan, or the first lines of why there is none."""
    try:
        return plan(arguments.machine, arguments.task, start=arguments.start, scene=False, **options)
    except (ProblemError, SolveError) as error:
        return f"{type(error).__name__} {error}"[:300]


def result(kind: str, seed: int) -> Row:
    """A path planned, and what is wrong: not planned though it can be done, or the other way round, or late."""
    beyond = kind == "beyond"
    task = passage(seed if beyond else 2 * seed + (kind == "place"), BEYOND * beyond)
    begun = time.process_time()
    outcome = planned(task, time_limit=None if beyond else PATIENCE)
    row: Row = {"seconds": time.process_time() - begun, "made_with": task.cost}
    if isinstance(outcome, str):
        late = row["seconds"] > SOON
        return row | {"said": outcome, "wrong": ["late"] * late if beyond else ["not planned"]}
    passed = outcome.audit().passed
    return row | {"cost": outcome.cost, "passed": passed, "wrong": ["planned"] * beyond + ["audit"] * (not passed)}


def main() -> None:
    sweep, shown = Sweep(__file__, parser(__doc__, COUNTS).parse_args(), COUNTS), []
    for row in sweep.rows(lambda kind, seed, _: result(kind, seed)):
        shown.append(row)
        print(row, flush=True)
    print(f"{sweep.summary(shown)}; {sum('cost' in row for row in shown)} planned")


if __name__ == "__main__":
    main()
