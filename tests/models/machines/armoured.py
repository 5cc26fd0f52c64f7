"""Arms with collision bodies for tests."""

from __future__ import annotations

import numpy as np

from models import CollisionShape, Joint, Link, Robot


def armoured_arm(count: int = 7, length: float = 0.35, radius: float = 0.06, scale: float = 1.0) -> Robot:
    """Joints about z and y in turn, and a capsule along every second link; all lengths times a scale."""
    length, radius = scale * length, scale * radius
    foot = CollisionShape("cylinder", (0.1 * scale, 0.2 * scale), translation=(0, 0, -0.2 * scale))
    links, joints = [Link("base", mass=5.0, inertia=np.eye(3) * 0.2, collisions=(foot,))], []
    for k in range(count):
        long = length if k % 2 else 0.0
        tube = CollisionShape("capsule", (radius, long - 0.2 * scale), translation=(0, 0, long / 2)) if long else None
        name = f"link{k + 1}"
        links.append(Link(name, mass=1.0, inertia=np.eye(3) * 0.01, collisions=(tube,) if tube else ()))
        height = 0.1 * scale if k == 0 else 0.0 if k % 2 else length
        joint = Joint(
            f"joint{k + 1}", "revolute", links[-2].name, name, axis=(0, k % 2, 1 - k % 2), translation=(0, 0, height),
            lower=-2.9, upper=2.9, velocity=2.0,
        )  # fmt: skip
        joints.append(joint)
    return Robot(tuple(links), tuple(joints), tip=links[-1].name, tip_translation=(0, 0, 0.05 * scale))
