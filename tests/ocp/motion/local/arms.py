"""Arms of different builds for tests of inverse kinematics, by their published or typical dimensions."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from models import FixedBase, Joint, Link, Robot
from tests.models.robot.pinocchio_robots import DATA, urdf_file
from tests.ocp.motion.tasks.space_tasks import panda, ur5

RIGHT = np.pi / 2


def arm(
    axes: Any, points: Any, tip: Any, rotation: Any = None, *, prismatic: Any = (), limit: float = np.inf
) -> FixedBase:
    """An arm whose axes point so, through points in the world, when all joints are at 0."""
    n, points = len(axes), np.asarray(points, dtype=float)
    span: dict[str, Any] = {"lower": -min(limit, 9.0), "upper": min(limit, 9.0)}
    links = [Link(f"link{k}") for k in range(n + 1)] + [Link("tip")]
    joints = []
    for k in range(n):
        kind: Any = "prismatic" if k in prismatic else "revolute" if np.isfinite(limit) else "continuous"
        shift = points[k] - (points[k - 1] if k else 0.0)
        bounds = {} if kind == "continuous" else span
        joints.append(Joint(f"joint{k}", kind, f"link{k}", f"link{k + 1}", translation=shift, axis=axes[k], **bounds))
    turned = np.eye(3) if rotation is None else rotation
    joints.append(Joint("flange", "fixed", f"link{n}", "tip", translation=tip - points[-1], rotation=turned))
    return FixedBase(Robot(tuple(links), tuple(joints), tip="tip"))


def denavit_hartenberg(rows: Any, *, prismatic: Any = (), limit: float = np.inf) -> FixedBase:
    """An arm of standard Denavit-Hartenberg rows (a, alpha, d)."""
    frame, axes, points = np.eye(4), [], []
    for a, alpha, d in rows:
        axes.append(frame[:3, 2].copy())
        points.append(frame[:3, 3].copy())
        cosine, sine = np.cos(alpha), np.sin(alpha)
        frame = frame @ [[1, 0, 0, a], [0, cosine, -sine, 0], [0, sine, cosine, d], [0, 0, 0, 1]]
    return arm(axes, points, frame[:3, 3], frame[:3, :3], prismatic=prismatic, limit=limit)


def random_arm(rng: Any, count: int = 6) -> FixedBase:
    """An arm of random axes."""
    axes = rng.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    rotation = Rotation.random(random_state=rng).as_matrix()
    return arm(axes, rng.uniform(-0.5, 0.5, (count, 3)), rng.uniform(-0.5, 0.5, 3), rotation)


def calibrated(machine: FixedBase, deviation: float, seed: int = 0) -> FixedBase:
    """The arm with axes and joints displaced by about so much, rad and m, as calibration finds them."""
    rng, joints = np.random.default_rng(seed), list[Joint]()
    for joint in machine.robot.joints:
        turn, shift = deviation * rng.normal(size=(2, 3))
        moved = Rotation.from_rotvec(turn).as_matrix() @ np.asarray(joint.rotation)
        new = replace(joint, rotation=moved, translation=np.asarray(joint.translation) + shift)
        joints.append(new if joint.moves else joint)
    return FixedBase(Robot(machine.robot.links, tuple(joints), tip=machine.robot.tip))


def on_rail(machine: FixedBase, count: int = 1) -> FixedBase:
    """The arm on a rail, or on two slides of a gantry."""
    robot = machine.robot
    links = tuple(Link(f"carriage{k}") for k in range(count))
    names = [*(link.name for link in links), robot.root]
    slides = tuple(
        Joint(f"slide{k}", "prismatic", names[k], names[k + 1], axis=np.eye(3)[k], lower=-0.5, upper=0.5)
        for k in range(count)
    )
    return FixedBase(Robot((*links, *robot.links), (*slides, *robot.joints), tip=robot.tip))


def crx(limit: float = np.inf) -> FixedBase:
    """An arm whose wrist has an offset, like the CRX series."""
    rows = [(0, -RIGHT, 0.2), (0.71, 0, 0), (0, -RIGHT, 0), (0, RIGHT, 0.54), (0, -RIGHT, 0.15), (0, 0, 0.16)]
    return denavit_hartenberg(rows, limit=limit)


IIWA_ROWS = [
    (0, -RIGHT, 0.36), (0, RIGHT, 0), (0, RIGHT, 0.42), (0, -RIGHT, 0), (0, -RIGHT, 0.4), (0, RIGHT, 0), (0, 0, 0.126)
]  # fmt: skip
"""Standard Denavit-Hartenberg rows of the LBR iiwa 14 R820, by its data sheet."""


def iiwa() -> FixedBase:
    """The LBR iiwa 14 R820 with the limits of its data sheet, without shapes."""
    robot = denavit_hartenberg(IIWA_ROWS).robot
    most = np.radians([170, 120, 170, 120, 170, 120, 175])
    rates = np.radians([85, 85, 100, 75, 130, 135, 135])
    limits = iter(zip(most, rates, strict=True))
    joints = []
    for joint in robot.joints:
        if joint.moves:
            angle, rate = next(limits)
            joint = replace(joint, kind="revolute", lower=-angle, upper=angle, velocity=rate)
        joints.append(joint)
    return FixedBase(replace(robot, joints=tuple(joints)))


@cache
def build(name: str) -> FixedBase:
    """One of the arms."""
    machine: FixedBase = ARMS[name]()
    return machine


ARMS: dict[str, Any] = {
    "UR5": ur5,
    "UR5 calibrated": lambda: calibrated(ur5(), 1e-3),
    "xArm6": lambda: denavit_hartenberg(
        [(0, -RIGHT, 0.267), (0.2895, 0, 0), (0.0775, -RIGHT, 0), (0, RIGHT, 0.3425), (0.076, -RIGHT, 0), (0, 0, 0.097)]
    ),
    "Panda": panda,
    "Kinova": lambda: FixedBase(
        Robot.from_urdf(urdf_file(DATA, "kinova_description/robots/kinova.urdf"), tip="j2s6s200_end_effector")
    ),
    "PUMA": lambda: denavit_hartenberg(
        [(0, RIGHT, 0), (0.4318, 0, 0), (0.0203, -RIGHT, 0.15), (0, RIGHT, 0.4318), (0, -RIGHT, 0), (0, 0, 0.06)]
    ),
    "CRX": crx,
    "JACO": lambda: denavit_hartenberg(
        [
            (0, RIGHT, 0.2755),
            (0.41, np.pi, 0),
            (0, RIGHT, -0.0098),
            (0, np.pi / 3, -0.2501),
            (0, np.pi / 3, -0.0856),
            (0, np.pi, -0.2228),
        ]
    ),
    "SCARA": lambda: arm(
        [(0, 0, 1)] * 4, [(0, 0, 0), (0.3, 0, 0), (0.5, 0, 0), (0.5, 0.1, 0.1)], (0.6, 0, 0), prismatic=(2,)
    ),
    "random": lambda: random_arm(np.random.default_rng(7)),
    "prismatic": lambda: denavit_hartenberg(
        [(0.1, RIGHT, 0.3), (0.2, 0.5, 0.1), (0.1, RIGHT, 0), (0.1, 0.7, 0.2), (0.05, -RIGHT, 0.1), (0.1, 0, 0.1)],
        prismatic=(2,),
    ),
    "UR5 on a rail": lambda: on_rail(ur5()),
    "CRX on a gantry": lambda: on_rail(crx(), 2),
    "seven joints": lambda: denavit_hartenberg(
        [
            (0.05, -RIGHT, 0.3),
            (0, RIGHT, 0.1),
            (0.03, -RIGHT, 0.35),
            (0, RIGHT, 0.12),
            (0.04, -RIGHT, 0.3),
            (0.08, RIGHT, 0.1),
            (0.03, 0, 0.12),
        ]
    ),
    "five joints": lambda: denavit_hartenberg(
        [(0.05, -RIGHT, 0.3), (0.3, 0, 0), (0.25, 0, 0.02), (0, RIGHT, 0.05), (0.02, 0.3, 0.2)]
    ),
}
"""Arms by their names."""
