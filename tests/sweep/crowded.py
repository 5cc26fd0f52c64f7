"""Random tasks among random boxes: what is planned is clear by an engine of others, and what can be planned is.

python -m tests.sweep.crowded --out FILE [--only panda] [--postures 30] [--minutes 60] [--again]

Results are added line by line to a file; a task that is there already is not done again.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import coal
import numpy as np

from models import Box, CollisionScene, FixedBase
from ocp import Plan, ProblemError, Scene, SolveError, TipTask, inverse_kinematics, plan
from ocp.motion.local.collisions import distances_along
from tests.models.shapes.shape_oracles import in_coal
from tests.ocp.motion.plan.motions import pair
from tests.ocp.motion.tasks.space_tasks import panda, ur5
from tests.sweep.results import Row, Sweep, parser

SECONDS = 3.0
CLEARANCE = 0.01
ROBOTS = {"panda": panda, "ur5": ur5, "two arms": pair}
COUNTS = dict.fromkeys(sorted(ROBOTS), 100)
"""Tasks of each."""
COARSE, FINE = 1000, 60_000
"""Samples of a plan, of all pairs and of those that come near."""
NEAR = 0.02
"""m."""


@dataclass(frozen=True)
class Crowd:
    """A task of a machine among boxes.

    Attributes:
        machine, tasks, boxes: As of `plan`. start: Joints that it was made from, which are clear.
    """

    machine: FixedBase
    tasks: TipTask
    boxes: tuple[Box, ...]
    start: np.ndarray


@cache
def alone(robot: str) -> CollisionScene:
    return CollisionScene(ROBOTS[robot]())


def crowd(robot: str, seed: int) -> Crowd:
    """A straight way of 0.15 to 0.4 m from a posture that is clear of three to six boxes."""
    rng = np.random.default_rng([sorted(ROBOTS).index(robot), seed])
    machine = ROBOTS[robot]()
    low, high = np.maximum(machine.robot.lower, -np.pi), np.minimum(machine.robot.upper, np.pi)
    while True:
        joints = rng.uniform(0.9 * low, 0.9 * high)
        first = np.array(ca.DM(machine.tip_pose((), joints).position)).ravel()
        if first[2] < 0.1 or distances_along(alone(robot), np.zeros(0), joints[None], np.zeros(1)).min() < CLEARANCE:
            continue
        way = rng.normal(size=3)
        way *= rng.uniform(0.15, 0.4) / np.linalg.norm(way)
        boxes = []
        for _ in range(int(rng.integers(3, 7))):
            turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            turn *= np.sign(np.linalg.det(turn))
            at = first + way * rng.uniform(-0.2, 1.2) + rng.normal(size=3) * 0.25
            boxes.append(Box(rng.uniform(0.05, 0.25, size=3), at, turn))
        around = CollisionScene(machine, boxes, CLEARANCE)
        if distances_along(around, np.zeros(0), joints[None], np.zeros(1)).min() < CLEARANCE:
            continue

        def where(t: Any, first: np.ndarray = first, way: np.ndarray = way) -> Any:
            s = t / SECONDS
            return ca.DM(first) + (10 * s**3 - 15 * s**4 + 6 * s**5) * ca.DM(way)

        return Crowd(
            machine, TipTask(position=where, duration=SECONDS, link=machine.robot.tip_link), tuple(boxes), joints
        )


def least_by_coal(result: Plan, boxes: Sequence[Box]) -> float:
    """Least distance by coal of all pairs at 1000 times, and of those that come near at sixty times as many."""
    around = CollisionScene(result.machine, boxes, CLEARANCE)
    pairs = np.arange(len(around.pairs))
    times = np.linspace(0.0, result.horizon, COARSE + 1)
    outcome = _by_coal(around, np.asarray(result.at(times)["joints"]), pairs)
    least, near = float(outcome.min(initial=np.inf)), outcome < NEAR
    steps = np.flatnonzero(near.any(axis=1))
    if steps.size:
        between = np.linspace(-1, 1, 2 * FINE // COARSE + 1) * (result.horizon / COARSE)
        finer = np.unique(np.clip(times[steps, None] + between, 0.0, result.horizon))
        again = _by_coal(around, np.asarray(result.at(finer)["joints"]), pairs[near.any(axis=0)])
        least = min(least, float(again.min(initial=np.inf)))
    return least


def _by_coal(around: CollisionScene, joints: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Distances of some pairs at joints (M, n). Shape (M, all pairs), inf for those left out.

    Hulls of meshes are as far apart as they are, or as the nearest of their covers, whichever is farther.
    """
    q = ca.SX.sym("q", joints.shape[1])
    placed = ca.Function("placed", [q], [around.placements((), q)]).map(len(joints))
    frames = np.array(placed(joints.T)).T.reshape(len(joints), -1, 4, 3)
    bodies = [in_coal(body.shape) for body in around.bodies]
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.enable_signed_distance = True
    outcome = np.full((len(joints), len(around.pairs)), np.inf)

    def apart(one: int, other: int, m: int) -> float:
        sides = []
        for body in (one, other):
            geometry, place = bodies[body]
            frame = around.bodies[body].frame
            if frame >= 0:
                turn = frames[m, frame, :3].T
                place = coal.Transform3s(
                    turn @ place.getRotation(), turn @ place.getTranslation() + frames[m, frame, 3]
                )
            sides += [geometry, place]
        result.clear()
        return float(coal.distance(*sides, request, result))

    for k in pairs:
        for m in range(len(joints)):
            one, other = around.pairs[k, :2].tolist()
            outcome[m, k] = apart(one, other, m)
            if k in around.covers:
                outcome[m, k] = max(outcome[m, k], min(apart(i, j, m) for i, j in around.covers[k].tolist()))
    return outcome


def planned(arguments: Crowd, **options: Any) -> Plan | str:
    """The plan, or the first line of why there is none."""
    try:
        return plan(
            arguments.machine, arguments.tasks, scene=Scene(obstacles=arguments.boxes, clearance=CLEARANCE), **options
        )
    except (ProblemError, SolveError) as error:
        return str(error).split("\n")[0]


def by_configurations(options: Crowd, count: int) -> Plan | None:
    """The first plan from one of so many postures that are clear at the start."""
    around = CollisionScene(options.machine, options.boxes, CLEARANCE)
    solutions = inverse_kinematics(options.machine, options.tasks, scene=around, starts=4 * count, near=options.start)
    for configuration in solutions[:count]:
        result = planned(options, start=configuration.joints, search="start")
        if isinstance(result, Plan):
            return result
        if "no joint positions put" in result:  # on the way, from wherever it comes
            break
    return None


def result(robot: str, seed: int, configurations: int) -> Row:
    """A task planned: cost and least distance by coal, or why there is no plan and what a search of postures finds."""
    task, begun = crowd(robot, seed), time.process_time()
    outcome = planned(task)
    row: Row = {"seconds": time.process_time() - begun}
    if isinstance(outcome, Plan):
        passed, least = outcome.audit().passed, least_by_coal(outcome, task.boxes)
        wrong = ["touches"] * (passed and least < CLEARANCE - 1e-6) + ["audit"] * (not passed)
        return row | {"cost": outcome.cost, "passed": passed, "least": least, "wrong": wrong}
    other = by_configurations(task, configurations) if configurations else None
    return row | {
        "said": outcome,
        "other": None if other is None else other.cost,
        "wrong": ["lost"] * (other is not None),
    }


def main() -> int:
    arguments = parser(__doc__, COUNTS)
    arguments.add_argument(
        "--postures", type=int, default=30, help="of the search that the share solved is compared with"
    )
    options = arguments.parse_args()
    sweep, shown = Sweep(__file__, options, COUNTS), []
    for row in sweep.rows(lambda robot, seed, _: result(robot, seed, options.postures)):
        shown.append(row)
        print(row, flush=True)
    print(f"{sweep.summary(shown)}; {sum('cost' in row for row in shown)} solved")
    return int(any("touches" in row["wrong"] for row in shown))


if __name__ == "__main__":
    raise SystemExit(main())
