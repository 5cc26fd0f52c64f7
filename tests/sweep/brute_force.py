"""Random coarse tasks of planar arms: the search beside the least over all sequences of postures of a fine grid.

python -m tests.sweep.brute_force --out FILE [--count 1000] [--only two] [--minutes 60] [--again]

The bound must be above none of them, what is found as cheap, and nothing may be called impossible that the grid can do.
Results are added line by line to a file; a case that is there already is not done again.
"""

from __future__ import annotations

import time
from typing import Any

import casadi as ca
import numpy as np

from models.checks import Array
from ocp import TipTask, inverse_kinematics
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.search.charts import SelfMotionManifolds, TimeSample
from ocp.motion.search.joint_space import FULL_TURN, JointSpace
from ocp.motion.search.lengths import PathLength
from ocp.motion.search.search import AtlasSearch
from ocp.motion.search.steps import SquaredRates, StepCost, Steps
from ocp.motion.tasks.equations import bind
from tests.ocp.motion.search.test_charts import planar
from tests.ocp.motion.search.test_values import SECONDS, TIME_SAMPLES, reached
from tests.sweep.results import Sweep, parser

KINDS = dict.fromkeys(("plain", "cut", "slow", "turning", "two"), 200)
"""Cases of each kind: limits that hardly matter; that cut the set of postures; slow joints; joints that turn without
end; four joints."""
GRID, COARSE = 700, 36
"""Angles of the first joint of three; of each of the first two of four."""
GAPS = {False: 0.03, True: 0.1}
AT_ONCE = 100_000
"""Steps that are looked at together."""
AS_CHEAP = {False: 1.01, True: 1.02}
"""What is found of the least on the grid, at most; with two free directions the grid is coarse."""


def judged(kind: str, seed: int) -> dict[str, Any]:
    """One case: what was found, its bound, the least on the grid, and what is wrong."""
    rng = np.random.default_rng([list(KINDS).index(kind), seed])
    two, cost = kind == "two", (SquaredRates, PathLength)[seed % 2 if kind != "two" else 0]
    size = 4 if two else 3
    limit = {"cut": rng.uniform(1.0, 2.2), "turning": 7.0, "two": 1.6}.get(kind, 2.8)
    speed = rng.uniform(0.15, 0.5) if kind == "slow" else 3.0
    lengths, weights = rng.uniform(0.25, 0.6, size), rng.uniform(0.5, 2.0, size)
    machine = planar(lengths, limit, speed)
    joints = rng.uniform(-1.0, 1.0, size) * min(limit, 2.0)
    first = np.array(ca.DM(machine.tip_pose((), joints).position)).ravel()[:2]
    paths = rng.normal(size=(2, 2))
    paths *= np.array([[rng.uniform(0.1, 0.4)], [0.1]]) / np.linalg.norm(paths, axis=1)[:, None]
    s = np.linspace(0, 1, TIME_SAMPLES)[:, None]
    places = first + s * paths[0] + 4 * s * (1 - s) * paths[1]
    places *= np.minimum(1.0, 0.97 * lengths.sum() / np.linalg.norm(places, axis=1).max())
    times = np.linspace(0, SECONDS, TIME_SAMPLES)
    price, seconds = cost(weights), float(times[1])
    metric = weights if cost is SquaredRates else np.ones(size)
    space = JointSpace(machine, machine.robot.lower, machine.robot.upper, metric)
    most = machine.robot.velocity * seconds
    angles = min(limit, np.pi) * (1 - 1e-9)
    nodes = [(_by_four if two else _by_three)(lengths, place, angles) for place in places]
    least = _least(nodes, price, seconds, most, space)
    equations = bind(machine, TipTask(position=[*places[0]], rows=[3, 4]))
    sets = SelfMotionManifolds(space, equations, np.array([np.r_[place, 0.0, 0.0, 0.0, 0.0] for place in places]))

    def seeds(k: int) -> Array:
        at = TipTask(position=[*places[k]], rows=[3, 4])
        return np.array([one.joints for one in inverse_kinematics(machine, at, starts=16, seed=k)])

    begun, steps, bound = time.process_time(), np.inf, np.inf
    try:
        time_samples = [TimeSample(sets, k) for k in range(TIME_SAMPLES)]
        search = AtlasSearch(
            space, time_samples, Steps(times, price, np.repeat(most[None], TIME_SAMPLES - 1, axis=0)), seeds=seeds
        )
        path, bound = search.solve(np.inf)
        steps = np.inf if path is None else search.path_cost(path)
    except Unreachable:
        pass
    wrong = []
    if bound > min(steps, least) * (1 + 1e-9):
        wrong.append("bound above")
    if steps > AS_CHEAP[two] * least:
        wrong.append("dearer")
    if np.isfinite(steps) and bound < (1 - GAPS[two]) * steps:
        wrong.append("gap")
    by_name = {"cost": cost.__name__, "steps": steps, "bound": bound, "least": least}
    return by_name | {"wrong": wrong, "seconds": time.process_time() - begun}


def _by_three(lengths: Array, at: Array, limit: float) -> Array:
    """Postures of an arm of three joints, of the first all angles."""
    return reached(lengths, at, limit, GRID)


def _by_four(lengths: Array, at: Array, limit: float) -> Array:
    """Postures of an arm of four joints, of the first two all angles."""
    results = []
    for angle in np.linspace(-limit, limit, COARSE):
        c, s = np.cos(angle), np.sin(angle)
        beyond = np.array([[c, s], [-s, c]]) @ at - [lengths[0], 0.0]
        rest = reached(lengths[1:], beyond, limit, COARSE)
        results.append(np.column_stack([np.full(len(rest), angle), rest]))
    return np.vstack(results)


def _least(nodes: list[Array], price: StepCost, seconds: float, most: Array, space: JointSpace) -> float:
    """The least cost over all sequences of nodes."""
    value = np.zeros(len(nodes[-1]))
    for here, there in zip(nodes[-2::-1], nodes[:0:-1], strict=True):
        before = np.full(len(here), np.inf)
        share = max(1, AT_ONCE // max(len(there), 1))
        for first in range(0, len(here), share):
            path = there - here[first : first + share, None]
            path[..., space.periodic] -= FULL_TURN * np.round(path[..., space.periodic] / FULL_TURN)
            total = np.where((np.abs(path) <= most).all(axis=2), value + price.evaluate(path, seconds), np.inf)
            before[first : first + share] = total.min(axis=1, initial=np.inf)
        value = before
    return float(value.min(initial=np.inf))


def main() -> None:
    sweep, shown = Sweep(__file__, parser(__doc__, KINDS).parse_args(), KINDS), []
    for row in sweep.rows(lambda kind, seed, _: judged(kind, seed)):
        shown.append(row)
        if row["wrong"]:
            print(row, flush=True)
    print(f"{sweep.summary(shown)}; {sum(np.isfinite(row['steps']) for row in shown)} have a motion")


if __name__ == "__main__":
    main()
