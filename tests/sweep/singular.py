"""Motions from singular configurations beside damped least squares by Pinocchio, and the same moved by 1e-12.

Arms of three builds start in wrist, elbow and shoulder singularities and move along a line in and out of the plane of
the arm, slowly and fast, with the orientation held or the roll free. Where damped least squares does the task within
the limits, `plan` must find a motion that costs no more, and the same one if start, end and axis move by 1e-12.

python -m tests.sweep.singular [--out FILE] [--only panda] [--again]
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.metadata import files

import numpy as np
import pinocchio as pin

from models import FixedBase, Robot, lock_joints
from models.checks import Array
from ocp import SolveError, TipTask
from ocp.errors import ProblemError
from tests.ocp.motion.plan.motions import plan_bare
from tests.sweep.results import Row, Sweep, parser

PERTURBATION = 1e-12
"""rad, m or of a unit vector."""
PERTURBED = 10
SAME_COST, COST_INCREASE = 1e-6, 1e-4
"""Relative difference of the costs of perturbed motions, and by how much a plan may cost more than its comparison."""
DAMPING, STEPS, FEEDBACK, TOLERANCE = 1e-3, 800, 0.5, 1e-5
"""Damping in the units of the Jacobian, steps, share of the error that a step corrects, and m or rad of the error."""
URDF = {"ur5": "ur5_robot.urdf", "panda": "panda.urdf", "z1": "z1.urdf"}
TIPS = {"ur5": "tool0", "panda": "panda_link8", "z1": "link06"}
LOCKED: dict[str, tuple[str, ...]] = {
    "ur5": (),
    "panda": ("panda_finger_joint1", "panda_finger_joint2"),
    "z1": ("jointGripper",),
}
STARTS: dict[str, dict[str, tuple[float, ...]]] = {
    "ur5": {
        "straight": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        "wrist": (0.3, -1.2, 1.5, -0.9, 0.0, 0.4),
        "elbow": (0.2, -1.0, 0.0, -0.8, 0.0, 0.2),
    },
    "panda": {
        "wrist": (0.3, -0.5, 0.0, -1.8, 0.4, 0.0873, 0.3),
        "shoulder": (0.4, 0.0, 0.2, -1.5, 0.0, 1.5, 0.3),
        "elbow": (0.2, 0.5, 0.0, -0.0698, 0.0, 1.2, 0.3),
        "plane": (0.0, 0.0, 0.0, -1.5, 0.0, 1.571, 0.0),
    },
    "z1": {"wrist": (0.3, 1.2, -1.0, -0.2, 0.0, 0.4), "aligned": (0.3, 1.2, -1.0, -0.2, np.pi / 2, 0.4)},
}
DISPLACEMENTS = {"in": (-0.15, 0.0, 0.0), "down": (0.0, 0.0, -0.1), "both": (-0.1, 0.0, -0.1), "out": (-0.05, 0.1, 0.0)}
"""m: along the arm, across it, and up."""
DURATIONS = (1.0, 3.0)


def urdf_of(arm: str) -> str:
    return str(next(path.locate() for path in files("example-robot-data") or () if path.name == URDF[arm]))


@cache
def machine(name: str) -> FixedBase:
    robot = Robot.from_urdf(urdf_of(name), tip=TIPS[name])
    return FixedBase(lock_joints(robot, dict.fromkeys(LOCKED[name], 0.0)))


@dataclass(frozen=True)
class Motion:
    """A straight motion of a tip.

    Attributes:
        arm, start, along: Keys of URDF, STARTS and DISPLACEMENTS.
        held: Whether the orientation is held; else the roll about the tool axis is free.
        duration: s.
    """

    arm: str
    start: str
    along: str
    held: bool
    duration: float

    @property
    def name(self) -> str:
        return f"{self.arm} {self.start} {self.along} {'held' if self.held else 'roll'} {self.duration:g}"

    @property
    def joints(self) -> Array:
        return np.array(STARTS[self.arm][self.start])

    @property
    def displacement(self) -> Array:
        heading = float(self.joints[0])
        c, s = np.cos(heading), np.sin(heading)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ DISPLACEMENTS[self.along]

    def task(self, joints: Array, displacement: Array, axis: Array | float = 0.0) -> TipTask:
        """Return the task from joints along a displacement, with a tool axis turned by `axis`."""
        pose = machine(self.arm).tip_pose(np.zeros(0), joints)
        position, rotation = np.array(pose.position).ravel(), np.array(pose.rotation)
        line = lambda t: position + displacement * (t / self.duration)  # noqa: E731
        if self.held:
            return TipTask(position=line, orientation=rotation, duration=self.duration)
        return TipTask(position=line, direction=rotation[:, 2] + axis, duration=self.duration)


def motions() -> Iterator[Motion]:
    for arm, starts in STARTS.items():
        for start in starts:
            for along in DISPLACEMENTS:
                for held in (True, False):
                    for duration in DURATIONS:
                        yield Motion(arm, start, along, held, duration)


def damped_cost(motion: Motion) -> float:
    """Return the cost of damped least squares, infinite if it misses the task or a limit."""
    model = pin.buildModelFromUrdf(urdf_of(motion.arm))
    robot, data = machine(motion.arm).robot, model.createData()
    columns = [model.joints[model.getJointId(name)].idx_v for name in robot.joint_names]
    frame, q = model.getFrameId(TIPS[motion.arm]), pin.neutral(model)
    for name in LOCKED[motion.arm]:
        q[model.joints[model.getJointId(name)].idx_q] = 0.0
    q[columns] = motion.joints
    pin.framesForwardKinematics(model, data, q)
    first, step, cost = data.oMf[frame].copy(), motion.duration / STEPS, 0.0
    velocity = motion.displacement / motion.duration
    for k in range(STEPS + 1):
        pin.framesForwardKinematics(model, data, q)
        placed = data.oMf[frame]
        gap = first.translation + velocity * (k * step) - placed.translation
        if motion.held:
            turn = pin.log3(first.rotation @ placed.rotation.T)
            angular = np.eye(3)
        else:
            turn = np.cross(placed.rotation[:, 2], first.rotation[:, 2])
            angular = placed.rotation[:, :2].T
        if max(np.linalg.norm(gap), np.linalg.norm(turn)) > TOLERANCE:
            return np.inf
        if k == STEPS:
            return cost
        jacobian = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)[:, columns]
        rows = np.vstack([jacobian[:3], angular @ jacobian[3:]])
        wanted = np.concatenate([velocity + FEEDBACK * gap / step, angular @ turn * FEEDBACK / step])
        rates = rows.T @ np.linalg.solve(rows @ rows.T + DAMPING**2 * np.eye(len(rows)), wanted)
        if (np.abs(rates) > robot.velocity).any():
            return np.inf
        q[columns] += rates * step
        if (q[columns] < robot.lower).any() or (q[columns] > robot.upper).any():
            return np.inf
        cost += step * float(rates @ rates) / 2
    return cost


def result(motion: Motion, perturbed: int = PERTURBED) -> Row:
    """Plan a motion and its perturbations, and compare their costs.

    What is promised: either all of them are refused or all have the same cost, which damped least squares bounds.
    """
    rng, reference = np.random.default_rng(sum(map(ord, motion.name))), damped_cost(motion)
    costs, reasons, began = list[float](), list[str](), time.process_time()
    for k in range(1 + perturbed):
        size = PERTURBATION if k else 0.0
        joints = motion.joints + size * rng.uniform(-1, 1, len(motion.joints))
        displacement, axis = motion.displacement + size * rng.uniform(-1, 1, 3), size * rng.uniform(-1, 1, 3)
        start = joints if k % 2 else motion.joints  # every second time the task alone moves
        try:
            instance = plan_bare(
                machine(motion.arm), motion.task(joints, displacement, axis), start=start, search="start"
            )
            costs.append(float(instance.cost))
        except (SolveError, ProblemError) as error:
            costs.append(np.inf)
            reasons.append(str(error))
    wrong = []
    if np.isfinite(reference) and not max(costs) <= reference * (1 + COST_INCREASE):
        wrong.append(f"costs {max(costs):g}, damped least squares {reference:g}")
    if np.isfinite(costs).any() and not max(costs) <= min(costs) * (1 + SAME_COST):
        wrong.append(f"costs from {min(costs):g} to {max(costs):g}")
    seconds = round(time.process_time() - began, 2)
    row: Row = {"name": motion.name, "seconds": seconds, "wrong": wrong}
    if np.isfinite(reference):
        row["damped"] = reference
    if np.isfinite(costs).all():
        row["cost"] = max(costs)
    if reasons:
        row["reason"] = reasons[0]
    return row


def main() -> None:
    cases = {arm: [motion for motion in motions() if motion.arm == arm] for arm in URDF}
    counts = {arm: len(each) for arm, each in cases.items()}
    sweep, shown = Sweep(__file__, parser(__doc__ or "", counts).parse_args(), counts), list[Row]()
    for row in sweep.rows(lambda kind, seed, _: result(cases[kind][seed])):
        shown.append(row)
        print(row, flush=True)
    done = sum("damped" in row for row in shown)
    planned = sum("damped" in row and "cost" in row for row in shown)
    print(f"{sweep.summary(shown)}; damped least squares does {done}, of which {planned} are planned")


if __name__ == "__main__":
    main()
