"""The problems of the benchmark of redundant arms, planned and checked by its rules with other libraries.

python -m tests.sweep.redundancy --out FILE [--only panda__1cube] [--minutes 60] [--again]

Every problem is planned in a process of its own, whose processor time and memory are told. Results are added line by
line to a file; a problem that is there already is not planned again.
"""

from __future__ import annotations

import resource
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pinocchio as pin

from models.checks import Array
from ocp import Scene, SolveError, Waypoints, plan
from ocp.motion.result.path_plan import PathPlan
from tests.models.machines.test_redundancy_benchmark import by_coal
from tests.redundancy_benchmark import FOLDER, PROBLEMS, Benchmark, problem_of, tip_and_file
from tests.sweep.results import Row, Sweep, parser

REVOLUTE, PRISMATIC = np.radians(7.0), 0.02
"""rad and m: less than this between two waypoints."""
HORIZONS = {"fetch_arm__hello": 48.9, "fetch_arm__s": 10.45}
"""rad, at most; of the others what is published, or a bound above it."""
SECONDS, MEGABYTES = 60.0, 2000.0
"""Of one problem, at most."""


def planned(problem: Benchmark) -> PathPlan:
    """The shortest way, rad and m counted alike."""
    turns = turning(problem)
    outcome = plan(
        problem.machine,
        Waypoints(problem.positions, problem.quaternions, step=np.where(turns, REVOLUTE, PRISMATIC) * (1 - 1e-9)),
        scene=Scene(obstacles=problem.boxes, ignored=problem.ignored),
    )
    assert isinstance(outcome, PathPlan)
    return outcome


def turning(problem: Benchmark) -> Array:
    """Which joints turn. Shape (n,), bool."""
    return np.array([joint.kind != "prismatic" for joint in problem.machine.robot.moving_joints])


def faults(name: str, joints: Array) -> list[str]:
    """What is not valid in a way through a problem's waypoints, (N, n), by Pinocchio and coal."""
    problem, outcome = problem_of(name), list[str]()
    robot = problem.machine.robot
    tip, file, base = tip_and_file(name)
    model = pin.buildModelFromUrdf(str(FOLDER / file))
    data, frames = model.createData(), [model.getFrameId(link) for link in (base, tip)]
    worst = np.zeros(2)
    for at, position, (w, x, y, z) in zip(joints, problem.positions, problem.quaternions, strict=True):
        q = pin.neutral(model)
        for joint, value in zip(robot.joint_names, at, strict=True):
            one = model.joints[model.getJointId(joint)]
            q[one.idx_q : one.idx_q + one.nq] = value if one.nq == 1 else (np.cos(value), np.sin(value))
        pin.framesForwardKinematics(model, data, q)
        pose = data.oMf[frames[0]].actInv(data.oMf[frames[1]])
        turn = pin.Quaternion(w, x, y, z).normalized().toRotationMatrix()
        off = np.linalg.norm(pose.translation - position), np.linalg.norm(pin.log3(turn.T @ pose.rotation))
        worst = np.maximum(worst, off)
    if worst[0] > 1e-4 or worst[1] > np.radians(0.1):
        outcome.append(f"the tip misses its poses by {worst[0]:.2g} m, {worst[1]:.2g} rad")
    steps = np.abs(np.diff(joints, axis=0))
    if not (steps < np.where(turning(problem), REVOLUTE, PRISMATIC)).all():
        outcome.append(f"joints move {steps.max(axis=0)} between waypoints")
    if not ((joints >= robot.lower - 1e-9) & (joints <= robot.upper + 1e-9)).all():
        outcome.append("joints pass their limits")
    paths = {link.name: {joint.name for joint in robot.path_to(link.name) if joint.moves} for link in robot.links}
    checked = {
        pair: values
        for pair, values in by_coal(problem, joints).items()
        if not pair <= paths.keys()
        or len(set.symmetric_difference(*(paths[link] for link in pair))) > 1  # not neighbours
    }
    nearest = min((float(values.min()), sorted(pair)) for pair, values in checked.items())
    if nearest[0] < 0:
        outcome.append(f"{nearest[1]} overlap by {-nearest[0]:.2g} m")
    return outcome


def result(name: str) -> Row:
    """A problem planned and checked, by the process that this is called in."""
    problem, request = problem_of(name), HORIZONS.get(name, problem_of(name).torm_length_rad)
    row, wrong = Row(), list[str]()
    try:
        outcome = planned(problem)
        used = resource.getrusage(resource.RUSAGE_SELF)
        paths, turns = np.abs(np.diff(outcome.joints, axis=0)).sum(axis=0), turning(problem)
        row |= {"rad": float(paths[turns].sum()), "m": float(paths[np.logical_not(turns)].sum()), "asked": request}
        row |= {"bound": outcome.bound}
        wrong += faults(name, outcome.joints)
        if request is not None and row["rad"] > request >= (outcome.bound or 0.0):
            wrong.append("longer")
    except SolveError as error:
        used = resource.getrusage(resource.RUSAGE_SELF)
        wrong.append(str(error))
    unit = 1024.0**2 if sys.platform == "darwin" else 1024.0
    row |= {"seconds": used.ru_utime + used.ru_stime, "megabytes": used.ru_maxrss / unit}
    wrong += ["slow"] * (row["seconds"] > SECONDS) + ["large"] * (row["megabytes"] > MEGABYTES)
    return row | {"wrong": wrong}


def main() -> None:
    counts = dict.fromkeys(PROBLEMS, 1)
    sweep, shown = Sweep(__file__, parser(__doc__, counts).parse_args(), counts), []

    def apart(name: str, *_: object) -> Row:
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            return pool.submit(result, name).result()

    for row in sweep.rows(apart):
        shown.append(row)
        print(row, flush=True)
    print(sweep.summary(shown))


if __name__ == "__main__":
    main()
