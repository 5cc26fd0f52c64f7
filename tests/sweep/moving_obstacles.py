"""Random obstacles that move beside a motion of an arm: no proven distance is above the one that coal finds.

python -m tests.sweep.moving_obstacles --out FILE [--only panda] [--count 20] [--minutes 60] [--again]

Obstacles jump, pass in milliseconds, have kinks, follow tables, or spin. One motion of each arm serves all of them:
only its clearance is proven again. Coal measures at many times, and at more about those at which something happens.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import coal
import numpy as np

from models import Box, Capsule, CollisionScene, FixedBase, Mesh, ModelError, MovingObstacle, Sphere
from ocp import Collocation, Problem, ProblemError, Solution, solve
from ocp.audit.clearance import Clearance, clearance
from ocp.motion.builders.clearance import CLEARANCE, ClearanceConstraints
from ocp.problem.formulation import Formulation
from tests.models.shapes.shape_oracles import in_coal
from tests.ocp.motion.tasks.space_tasks import panda, ur5
from tests.sweep.results import Row, Sweep, parser

SECONDS = 4.0
ROBOTS = {"panda": panda, "ur5": ur5}
ENDS = {
    "panda": ([-1.2, -0.4, 0.3, -2.0, 0.2, 1.6, 0.5], [1.0, 0.5, -0.4, -1.2, -0.5, 2.2, -0.8]),
    "ur5": ([-1.0, -1.6, 1.4, -1.2, -1.5, 0.0], [1.2, -0.9, 0.9, -1.7, -1.2, 1.0]),
}
COUNTS = dict.fromkeys(sorted(ROBOTS), 100)
COARSE, CLOSE = 600, 120
"""Times over the whole motion, and about every event."""
EXACT = 1e-6
"""m: to which coal measures."""
Trajectory = Callable[[Any], Any]


@dataclass(frozen=True)
class Obstacle:
    """An obstacle, the name of its motion, and times (s) at which something happens, each with a width about it."""

    moving: MovingObstacle
    motion: str
    events: list[tuple[float, float]]


def problem_of(machine: FixedBase, ends: Sequence[Any]) -> tuple[Problem, Any]:
    """A motion from joints to joints in a given time, and the symbol of the joints."""
    robot = machine.robot
    problem = Problem("beside", symbols=ca.SX)
    q = problem.state("joints", robot.dof, lower=robot.lower, upper=robot.upper, initial=ends[0], terminal=ends[1])
    u = problem.control("rates", robot.dof)
    problem.dynamics(q, u * (1 + 0.3 * ca.sin(2 * problem.time)))
    problem.horizon(SECONDS)
    problem.minimize(ca.sumsqr(u))
    return problem, q


@cache
def motion(robot: str) -> Solution:
    """Solved once."""
    return solve(problem_of(ROBOTS[robot](), ENDS[robot])[0], Collocation(12, 4))


def obstacle(robot: str, seed: int) -> Obstacle:
    """One whose motion comes near some link, the kinds of motion in turn."""
    rng = np.random.default_rng([sorted(ROBOTS).index(robot), seed])
    kind = sorted(MOTIONS)[seed % len(MOTIONS)]
    when, machine = rng.uniform(0.3, SECONDS - 0.3), ROBOTS[robot]()
    joints = motion(robot).state_interpolant(np.array([when / SECONDS]))[0]
    tip = np.array(ca.DM(machine.tip_pose((), joints).position)).ravel()
    aim = tip * rng.uniform(0.5, 1.1) + rng.normal(size=3) * 0.08
    far = aim + rng.normal(size=3) * rng.uniform(0.3, 1.0)
    position, rotation, events = MOTIONS[kind](rng, when, aim, far)
    return Obstacle(MovingObstacle(_shape(rng, thin=kind == "spins"), position, rotation), kind, events)


def _shape(rng: np.random.Generator, thin: bool) -> Any:
    if thin:
        return Box((rng.uniform(0.3, 0.8), 0.002, 0.002))
    size = rng.uniform(0.02, 0.09)
    results: list[Callable[[], Any]] = [
        lambda: Sphere(size, (0, 0, 0)),
        lambda: Capsule(size / 2, (0, 0, -size), (0, size, size)),
        lambda: Box(size * rng.uniform(0.5, 2.0, size=3)),
        lambda: Mesh(size * rng.normal(size=(12, 3))),
    ]
    return results[int(rng.integers(len(results)))]()


def _between(far: np.ndarray, aim: np.ndarray, share: Callable[[Any], Any]) -> Trajectory:
    return lambda t: ca.DM(far) + share(t) * ca.DM(aim - far)


def _turned(angle: Any) -> Any:
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))


def _once(share: Callable[[float, float], Callable[[Any], Any]], low: float = -5.0, high: float = -0.5) -> Any:
    """A motion from far to aim by a share, with an event at one time, of a random width in powers of ten, s."""

    def trajectory(rng: np.random.Generator, when: float, aim: np.ndarray, far: np.ndarray) -> Any:
        width = float(10 ** rng.uniform(low, high))
        return _between(far, aim, share(when, width)), None, [(when, 2 * width)]

    return trajectory


def _again(share: Callable[[float, float], Callable[[Any], Any]], low: float, high: float) -> Any:
    """A motion of a random rate between two, from far to aim by a share, which is there at one time."""

    def trajectory(rng: np.random.Generator, when: float, aim: np.ndarray, far: np.ndarray) -> Any:
        return _between(far, aim, share(rng.uniform(low, high), when)), None, [(when, 0.05)]

    return trajectory


def _table(kind: str) -> Any:
    def trajectory(rng: np.random.Generator, when: float, aim: np.ndarray, far: np.ndarray) -> Any:
        knots = np.unique([0.0, *rng.uniform(0, SECONDS, 8), when - 0.02, when, when + 0.02, SECONDS])
        values = np.clip(rng.normal(0.2, 0.3, len(knots)), -0.5, 0.8)
        values[knots == when] = 1.0
        table = ca.interpolant("table", kind, [knots.tolist()], values.tolist())
        return _between(far, aim, lambda t: table(t)), None, [(when, 0.03)]

    return trajectory


def _spinning(rng: np.random.Generator, when: float, aim: np.ndarray, far: np.ndarray) -> Any:
    rate = rng.uniform(5, 60)
    turn = rng.choice(np.array(["even", "to and fro", "by steps"]))
    angle: dict[str, Trajectory] = {
        "even": lambda t: rate * t,
        "to and fro": lambda t: rate * ca.fabs(t - when),
        "by steps": lambda t: ca.floor(3 * t) + rate * ca.fmax(0.0, t - when),
    }
    drift = _between(aim + 0.2 * (far - aim), aim, lambda t: ca.sin(t))
    return drift, lambda t: _turned(angle[str(turn)](t)), [(when, 0.1)]


MOTIONS: dict[str, Any] = {
    "jumps there and back": _once(lambda at, w: lambda t: ca.if_else(ca.fabs(t - at) < w, 1.0, 0.0)),
    "spikes": _once(lambda at, w: lambda t: ca.if_else(ca.fabs(t - at) < w, 1 - ca.fabs(t - at) / w, 0.0)),
    "comes, rests and goes": _once(lambda at, w: lambda t: ca.fmin(1.0, ca.fmax(0.0, 2 - ca.fabs(t - at) / w))),
    "zigzags": _again(lambda f, at: lambda t: ca.fabs(ca.fmod(f * (t - at) + 99.0, 2) - 1), 0.3, 9.0),
    "saws": _again(lambda f, at: lambda t: 0.5 + ca.remainder(f * (t - at), 1.0), 0.3, 3.0),
    "steps": _again(lambda f, at: lambda t: ca.floor(f * (t - at) + 1.0) / 3 + 0.1 * ca.ceil(t), 0.5, 3.0),
    "turns its sign": _once(lambda at, w: lambda t: 0.5 + ca.copysign(0.5, t - at) * ca.fmin(1, ca.fabs(t - at) / w)),
    "dips like a root": _once(lambda at, w: lambda t: 1 - ca.sqrt(ca.fabs(t - at) / (0.1 + w))),
    "crosses a cut": _once(lambda at, w: lambda t: ca.atan2((t - at) / w, -1.0) / np.pi),
    "swings": _again(lambda f, at: lambda t: ca.cos(f * (t - at)) ** 2, 0.3, 6.0),
    "bumps": _once(lambda at, w: lambda t: ca.exp(-(((t - at) / w) ** 2)), -3.0, 0.0),
    "follows a table": _table("linear"),
    "follows a spline": _table("bspline"),
    "spins": _spinning,
    "has no bounds": _once(lambda at, w: lambda t: ca.erf((t - at) / w)),
}
"""Motions: of a generator, a time, where it goes then and where it comes from, to position, rotation and events."""


def proven(robot: str, options: Obstacle) -> tuple[CollisionScene, Clearance]:
    """What is proven of the motion beside an obstacle, of the pairs with it alone."""
    machine = ROBOTS[robot]()
    around = CollisionScene(machine, [options.moving])
    problem, q = problem_of(machine, ENDS[robot])
    ClearanceConstraints(around).declare(problem, machine.base_home(), q, horizon=SECONDS)
    beside = [k for k, pair in enumerate(around.labels) if "obstacle 0" in pair]
    apart = problem.declared.apart[CLEARANCE].of(beside)
    return around, clearance(Formulation.of(problem), apart, motion(robot), np.zeros(0))


def least_by_coal(robot: str, options: Obstacle, around: CollisionScene) -> dict[tuple[str, str], float]:
    """Least distances of the obstacle from each body, m."""
    about = [np.linspace(at - width, at + width, CLOSE + 1) for at, width in options.events]
    times = np.unique(np.clip(np.concatenate([np.linspace(0, SECONDS, COARSE + 1), *about]), 0.0, SECONDS))
    joints = motion(robot).state_interpolant(times / SECONDS)
    q, t = ca.SX.sym("q", joints.shape[1]), ca.SX.sym("t")
    placed = ca.Function("placed", [q, t], [around.placements((), q, t)]).map(len(times))
    frames = np.array(placed(joints.T, times[None])).T.reshape(len(times), -1, 4, 3)
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.enable_signed_distance = True
    by_name = {}
    for label, (one, other, _) in zip(around.labels, around.pairs.tolist(), strict=True):
        if "obstacle 0" not in label:
            continue
        sides = [(around.bodies[k], *in_coal(around.bodies[k].shape)) for k in (one, other)]
        least = np.inf
        for row in frames:
            both: list[Any] = []
            for body, geometry, place in sides:
                turn, shift = row[body.frame, :3].T, row[body.frame, 3]
                moved = coal.Transform3s(turn @ place.getRotation(), turn @ place.getTranslation() + shift)
                both += [geometry, moved if body.frame >= 0 else place]
            result.clear()
            least = min(least, float(coal.distance(*both, request, result)))
        by_name[label] = least
    return by_name


def result(robot: str, seed: int) -> Row:
    """What is said of an obstacle, the least distance that is proven and the one by coal, m."""
    options, begun = obstacle(robot, seed), time.process_time()
    row: Row = {"motion": options.motion, "wrong": []}
    try:
        around, outcome = proven(robot, options)
    except (ModelError, ProblemError) as error:
        return row | {"seconds": time.process_time() - begun, "said": "refused", "why": str(error)}
    worst = outcome.worst
    assert worst is not None
    row |= {"seconds": time.process_time() - begun, "looked": outcome.n_intervals}
    known = least_by_coal(robot, options, around)
    above = [near.bodies for near in outcome.pairs if not near.least <= max(known[near.bodies], 0.0) + EXACT]
    least = min(near.least for near in outcome.pairs)
    message = "proven" if not worst.missed else "in collision" if worst.distance < 0 else "not proven"
    find_collisions = message == "proven" and min(known.values()) < -EXACT
    numbers = {"least": None if not np.isfinite(least) else least, "by_coal": min(known.values())}
    wrong = [f"above the truth: {pair}" for pair in above] + ["touches"] * find_collisions
    return row | numbers | {"said": message, "why": outcome.reason, "wrong": wrong}


def main() -> int:
    sweep, shown = Sweep(__file__, parser(__doc__, COUNTS).parse_args(), COUNTS), []
    for row in sweep.rows(lambda robot, seed, _: result(robot, seed)):
        shown.append(row)
        print(row, flush=True)
    message = Counter(row["said"] for row in shown)
    print(f"{sweep.summary(shown)}; {', '.join(f'{count} {what}' for what, count in sorted(message.items()))}")
    return int(any(row["wrong"] for row in shown))


if __name__ == "__main__":
    raise SystemExit(main())
