"""Standing machines, spatial ones among them, and random motions of them."""

from __future__ import annotations

import numpy as np

from models import Joint, Link, Robot
from models.standing import Standing
from models.support import Support, rectangle
from tests.models.trees import Array, random_robot, random_rotation


def standing_arm() -> Standing:
    """Seven joints about z and y in turn on a foot of 0.3 m x 0.4 m; 12 kg of foot, 30 kg of arm, 1.3 m long."""
    lengths, masses = (0.25, 0.15, 0.2, 0.2, 0.2, 0.15, 0.1), (8.0, 6.0, 5.0, 4.5, 3.0, 2.0, 1.5)
    links, joints = [Link("foot", 12.0, (0.0, 0.0, 0.05), np.diag([0.2, 0.1, 0.3]))], []
    for i, (length, mass) in enumerate(zip(lengths, masses, strict=True)):
        side = mass * (length**2 + 0.1**2) / 12
        links.append(Link(f"link{i + 1}", mass, (0.0, 0.0, length / 2), np.diag([side, side, mass * 0.05**2 / 2])))
        joints.append(
            Joint(
                f"joint{i + 1}",
                "revolute",
                links[i].name,
                links[i + 1].name,
                (0.0, 0.0, 0.1 if i == 0 else lengths[i - 1]),
                axis=(0, 0, 1) if i % 2 == 0 else (0, 1, 0),
                lower=-2.8,
                upper=2.8,
                velocity=4.0,
                effort=300.0,
            )
        )
    robot = Robot(tuple(links), tuple(joints), tip_translation=(0.0, 0.0, lengths[-1]))
    return Standing(robot, support=rectangle((-0.15, 0.15), (-0.2, 0.2)))


def random_standing(rng: np.random.Generator, size: int) -> Standing:
    """A random tree on a triangular foot, its root anywhere in the world."""
    return Standing(
        random_robot(rng, size),
        translation=rng.normal(size=3),
        rotation=random_rotation(rng),
        support=Support([(0, 0), (1, 0), (0, 1)]),
        gravity=float(rng.uniform(1, 12)),
    )


def random_motion(rng: np.random.Generator, machine: Standing) -> tuple[Array, Array, Array]:
    """q, q', q''. Shape (n,) each."""
    n = machine.joint_size
    return rng.normal(size=n), rng.normal(size=n), rng.normal(scale=3.0, size=n)
