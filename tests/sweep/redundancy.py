"""The problems of the benchmark of redundant arms, planned and checked by its rules with other libraries.

python -m tests.sweep.redundancy [--only panda__1cube]
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import pinocchio as pin

from models.arrays import Array
from ocp import SolveError
from ocp.planning.waypoints import WaypointPlan, plan_waypoints
from tests.models.machines.test_redundancy_benchmark import by_coal
from tests.redundancy_benchmark import FOLDER, PROBLEMS, Benchmark, problem_of, tip_and_file

REVOLUTE, PRISMATIC = np.radians(7.0), 0.02
"""rad and m: less than this between two waypoints."""


def planned(problem: Benchmark) -> WaypointPlan:
    """The shortest way, rad and m counted alike."""
    turns = turning(problem)
    return plan_waypoints(
        problem.machine,
        problem.positions,
        problem.quaternions,
        step=np.where(turns, REVOLUTE, PRISMATIC) * (1 - 1e-9),
        obstacles=problem.boxes,
        ignored=problem.ignored,
    )


def turning(problem: Benchmark) -> Array:
    """Which joints turn. Shape (n,), bool."""
    return np.array([joint.kind != "prismatic" for joint in problem.machine.robot.moving_joints])


def faults(name: str, joints: Array) -> list[str]:
    """What is not valid in a way through a problem's waypoints, (N, n), by Pinocchio and coal."""
    problem, found = problem_of(name), list[str]()
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
        found.append(f"the tip misses its poses by {worst[0]:.2g} m, {worst[1]:.2g} rad")
    steps = np.abs(np.diff(joints, axis=0))
    if not (steps < np.where(turning(problem), REVOLUTE, PRISMATIC)).all():
        found.append(f"joints move {steps.max(axis=0)} between waypoints")
    if not ((joints >= robot.lower - 1e-9) & (joints <= robot.upper + 1e-9)).all():
        found.append("joints pass their limits")
    ways = {link.name: {joint.name for joint in robot.path_to(link.name) if joint.moves} for link in robot.links}
    looked_at = {
        pair: values
        for pair, values in by_coal(problem, joints).items()
        if not pair <= ways.keys()
        or len(set.symmetric_difference(*(ways[link] for link in pair))) > 1  # not neighbours
    }
    nearest = min((float(values.min()), sorted(pair)) for pair, values in looked_at.items())
    if nearest[0] < 0:
        found.append(f"{nearest[1]} overlap by {-nearest[0]:.2g} m")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=PROBLEMS)
    only = parser.parse_args().only
    for name in [only] if only else PROBLEMS:
        problem, begun = problem_of(name), time.process_time()
        row: dict[str, Any] = {"problem": name, "published": (problem.torm_length_rad, problem.torm_length_m)}
        try:
            found = planned(problem)
            ways, turns = np.abs(np.diff(found.joints, axis=0)).sum(axis=0), turning(problem)
            row |= {"rad": float(ways[turns].sum()), "m": float(ways[np.logical_not(turns)].sum())}
            row |= {"bound": found.bound, "faults": faults(name, found.joints)}
        except SolveError as error:
            row |= {"faults": [str(error)]}
        print(row | {"seconds": round(time.process_time() - begun, 1)}, flush=True)


if __name__ == "__main__":
    main()
