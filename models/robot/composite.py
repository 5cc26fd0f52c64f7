"""Planar and floating joints as chains of joints with one degree of freedom each, on massless links.

A planar joint has the coordinates x, y and angle of `models.machines.free_floating.FreeFloating` with a planar base, a
floating one x, y, z, yaw, pitch and roll, with the rotation Rz(yaw) Ry(pitch) Rx(roll), which is singular at a pitch of
+-pi/2. Their joints are called "NAME_x", and so on.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from models.arrays import Array
from models.robot.parts import Joint, Kind, Link

X, Y, Z = np.eye(3)


class JointChain(NamedTuple):
    """Joints from one link to another, and the massless links between them."""

    links: tuple[Link, ...]
    joints: tuple[Joint, ...]


def planar_joint(place: Joint, axis: Array | None) -> JointChain:
    """Return the joints "NAME_x", "NAME_y" and "NAME_angle" of a planar joint.

    The plane is the one through the joint frame across the axis, the xy plane without an axis. For any other axis, the
    frame is turned by the least rotation that takes its z axis to the axis or the opposite direction.

    Args:
        place: Fixed joint with the name, links and frame of the planar one.
        axis: Normal of the plane in the joint frame, of any nonzero length, shape (3,); or None.
    """
    normal = Z if axis is None or not np.any(axis) else axis / np.linalg.norm(axis)
    normal = normal if normal[2] >= 0 else -normal
    cross = np.cross(Z, normal)
    tilt = np.eye(3) + _skew(cross) + _skew(cross) @ _skew(cross) / (1 + normal[2])
    steps: list[tuple[str, Kind, Array]] = [("x", "prismatic", tilt @ X), ("y", "prismatic", tilt @ Y)]
    return _chain(place, [*steps, ("angle", "continuous", normal)])


def floating_joint(place: Joint) -> JointChain:
    """Return the joints "NAME_x" to "NAME_z", "NAME_yaw", "NAME_pitch" and "NAME_roll" of a floating joint.

    Args:
        place: Fixed joint with the name, links and frame of the floating one.
    """
    slides: list[tuple[str, Kind, Array]] = [("x", "prismatic", X), ("y", "prismatic", Y), ("z", "prismatic", Z)]
    return _chain(place, [*slides, ("yaw", "continuous", Z), ("pitch", "continuous", Y), ("roll", "continuous", X)])


def _chain(place: Joint, steps: Sequence[tuple[str, Kind, Array]]) -> JointChain:
    """Return the chain of joints with one degree of freedom, given by suffix, kind and axis."""
    links = [Link(f"{place.name}_{suffix}_link") for suffix, *_ in steps[:-1]]
    ends = [place.parent, *(link.name for link in links), place.child]
    joints = []
    for k, (suffix, kind, axis) in enumerate(steps):
        frame = {"translation": place.translation, "rotation": place.rotation} if k == 0 else {}
        joints.append(Joint(f"{place.name}_{suffix}", kind, ends[k], ends[k + 1], axis=axis, **frame))
    return JointChain(tuple(links), tuple(joints))


def _skew(vector: Array) -> Array:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
