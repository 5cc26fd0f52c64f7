"""Where the links of a robot are along a motion, for pictures and for the view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models import ModelError, Robot, link_frames
from models.arrays import Array
from models.spatial import rotation, rotation_from_quaternion

TIP = "the tip frame"
"""Key of the tip among the frames; no link can have it that is also a link of the arm drawn."""


@dataclass(frozen=True)
class Frames:
    """Frames in the world along a motion, by link name and TIP.

    Attributes:
        rotations: Axes as columns. Shape (M, 3, 3) each.
        positions: Origins. Shape (M, 3) each, m.
    """

    rotations: dict[str, Array]
    positions: dict[str, Array]

    @property
    def tip(self) -> Array:
        """Origin of the tip frame. Shape (M, 3), m."""
        return self.positions[TIP]


def placement(base: Any, translation: Any = None, turn: Any = None) -> tuple[Any, Any]:
    """(Rotation, position) of the root link for a base configuration, or for a base that is fixed as given.

    Args:
        base: Symbols of shape (0, 1), (3, 1): x, y, angle, or (7, 1): position and quaternion [w, x, y, z] of any
            length but zero.
        translation, turn: Of a fixed base; the world's own frame if None.

    Raises:
        ModelError: A base of another size.
    """
    size = base.shape[0]
    if size == 0:
        place = np.zeros(3) if translation is None else np.asarray(translation, dtype=float)
        return ca.DM(np.eye(3) if turn is None else np.asarray(turn, dtype=float)), ca.DM(place)
    if size == 3:
        return rotation((0, 0, 1), base[2]), ca.vertcat(base[0:2], type(base)(1, 1))
    if size == 7:
        return rotation_from_quaternion(base[3:7] / ca.norm_2(base[3:7])), base[0:3]
    raise ModelError(f"a base configuration has 0, 3 or 7 entries, not {size}")


def frames_function(
    robot: Robot, base_size: int = 0, translation: Any = None, turn: Any = None
) -> Callable[[Any, Any], Frames]:
    """A function of (joints, base), as of frames_along, that is made once and called often.

    Raises:
        ModelError: A base size that is none of 0, 3, 7.
    """
    q, b = ca.SX.sym("q", robot.dof), ca.SX.sym("b", base_size)
    found = link_frames(robot, q, placement(b, translation, turn))
    tip = found[robot.tip_link]
    entries = [ca.vertcat(ca.vec(frame.rotation), frame.position) for frame in found.values()]
    entries.append(
        ca.vertcat(ca.vec(ca.mtimes(tip.rotation, ca.DM(robot.tip_rotation))), tip.point(robot.tip_translation))
    )
    function = ca.Function("frames", [b, q], [ca.densify(ca.SX(ca.horzcat(*entries)))], {"cse": True})
    names = [*found, TIP]

    def frames(joints: Any, base: Any) -> Frames:
        angles = np.atleast_2d(np.asarray(joints, dtype=float))
        count = len(angles)
        place = np.zeros((count, 0)) if base is None else np.atleast_2d(np.asarray(base, dtype=float))
        if angles.shape[1] != robot.dof or place.shape != (count, base_size):
            raise ModelError(
                f"joints and base of the shapes {angles.shape}, {place.shape} do not fit {robot.dof} joints "
                f"{list(robot.joint_names)} and a base of {base_size} entries"
            )
        values = np.array(function.map(count)(place.T, angles.T)).T.reshape(count, len(names), 12)
        rotations = {name: values[:, i, :9].reshape(-1, 3, 3).transpose(0, 2, 1) for i, name in enumerate(names)}
        return Frames(rotations, {name: values[:, i, 9:] for i, name in enumerate(names)})

    return frames


def frames_along(robot: Robot, joints: Any, base: Any = None, translation: Any = None, turn: Any = None) -> Frames:
    """Frames of all links and of the tip.

    Args:
        robot: The robot.
        joints: In the order of robot.joint_names. Shape (M, dof).
        base: Shape (M, 0), (M, 3) or (M, 7), see placement; None for a fixed base.
        translation, turn: Of a fixed base, see placement.

    Raises:
        ModelError: Wrong sizes.
    """
    size = 0 if base is None else np.atleast_2d(base).shape[1]
    return frames_function(robot, size, translation, turn)(joints, base)


def chain(robot: Robot) -> list[str]:
    """Links from the root to the tip, and TIP: the arm as a line of points."""
    return [robot.root, *(joint.child for joint in robot.path_to(robot.tip_link)), TIP]


def inertia_box(robot: Robot, name: str) -> tuple[Array, Array, Array] | None:
    """The box of even density that has a link's mass and inertia.

    Returns:
        Edge lengths (3,), m; its axes (3, 3), as columns, and its centre (3,), in the link's frame. None for a link
        without mass or whose inertia no body can have.
    """
    link = robot.link(name)
    if link.mass <= 0:
        return None
    moments, axes = np.linalg.eigh(np.asarray(link.inertia, dtype=float))
    squares = 6 / link.mass * (moments.sum() - 2 * moments)
    if not (np.isfinite(squares).all() and (squares >= -1e-9 * max(float(np.abs(squares).max()), 1e-12)).all()):
        return None
    if np.linalg.det(axes) < 0:
        axes = axes * [1, 1, -1]
    return np.sqrt(np.maximum(squares, 0)), axes, np.asarray(link.center_of_mass, dtype=float)
