"""Kinematics of robots: frames, Jacobians, motion of links and centre of mass, performance indices.

Joint positions q, velocities qd and accelerations qdd have shape (dof, 1) in the order of `robot.joint_names`, as SX,
MX, DM or numbers. `world_from_base` = (rotation, position) is the pose of the root link in the world, the identity if
None. The base is at rest. All functions raise ModelError for vectors of a wrong size and unknown links, and for a
massless robot if they divide by its mass.

Everything is written in world axes, so that what a planar machine cannot do stays a structural zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from models.checks import NOT_NUMBERS, Array, argument_of, check_entries, floats, require
from models.errors import ModelError
from models.robot.parts import massless_error
from models.robot.robot import Robot
from models.spatial import Expression, Frame, cross, determinant, expression, on_scalars, rotation

Placement = tuple[Expression, Expression]


class _ParallelRotation(NamedTuple):
    """Rotation about consecutive parallel joint axes: initial orientation, common axis and sum of the joint angles."""

    before: Expression
    axis: Array
    angle: Expression


def joint_vector(robot: Robot, q: Expression, name: str = "q") -> Expression:
    """Return a joint vector as a column; raise ModelError unless it has one entry for each independent joint."""
    require.instance("kinematics: robot", robot, Robot)
    return checked_vector(name, q, robot.dof, f"one entry for each of the joints {list(robot.joint_names)}")


def checked_vector(label: str, value: Expression, size: int, meaning: str) -> Expression:
    """Return a vector as a CasADi column; raise ModelError unless it is numeric, finite and has `size` entries.

    `label` is as in `models.checks.Checks`; `meaning`, of the entries, is for messages.
    """
    name, limit = argument_of(label), (size, 1)
    try:
        value = expression(value)
    except NOT_NUMBERS as error:
        message = f"{label} {value!r} is not numeric; {limit} expected: {meaning}"
        raise ModelError(message, name=name, value=value, limit=limit) from error
    if value.shape != limit and not (size == 0 and value.numel() == 0):
        message = f"{label} has shape {tuple(value.shape)}, expected {limit}: {meaning}"
        raise ModelError(message, name=name, value=tuple(value.shape), limit=limit)
    if isinstance(value, ca.DM) and not value.is_regular():
        raise ModelError(f"{label} {value} is not finite", name=name, value=np.array(value).ravel())
    return value


def checked_placement(placement: Placement | None, label: str = "world_from_base") -> Frame:
    """Return a pose (rotation, position) as a frame, the identity if None; raise ModelError if the pose is invalid."""
    if placement is None:
        return Frame(ca.DM.eye(3), ca.DM(3, 1))
    name = argument_of(label)
    try:
        orientation, position = map(expression, placement)
    except NOT_NUMBERS as error:
        message = f"{label} must be (rotation, position), not {placement!r}"
        raise ModelError(message, name=name, value=placement) from error
    shapes, expected = (orientation.shape, position.shape), ((3, 3), (3, 1))
    if shapes != expected:
        message = f"{label} has parts of shapes {shapes}, expected {expected}"
        raise ModelError(message, name=name, value=shapes, limit=expected)
    if not all(part.is_regular() for part in (orientation, position) if isinstance(part, ca.DM)):
        raise ModelError(f"{label} {placement!r} is not finite", name=name, value=placement)
    return Frame(orientation, position)


def expand_joint_vector(robot: Robot, vector: Expression, label: str = "q") -> dict[str, Expression]:
    """Return a joint vector's entries for all moving joints, by name; a mimic joint's entry includes its multiplier.

    The result is right for rates and accelerations; for positions, the offsets of mimic joints are missing.
    """
    vector = joint_vector(robot, vector, label)
    return {name: vector[k] if ratio == 1 else ratio * vector[k] for name, (k, ratio, _) in robot.couplings.items()}


def reduce_to_joint_vector(robot: Robot, by_joint: Mapping[str, Expression]) -> list[Expression]:
    """Convert a quantity such as torque from values of all moving joints, by name, to entries of the joint vector.

    An entry is the joint's own value plus, for each joint that mimics it, the multiplier times the mimic's value.
    """
    entries = [by_joint[name] for name in robot.joint_names]
    for joint in robot.joints:
        if joint.mimic is not None:
            column, multiplier, _ = robot.couplings[joint.name]
            entries[column] = entries[column] + multiplier * by_joint[joint.name]
    return entries


def coupling_matrix(robot: Robot) -> ca.DM:
    """Return the matrix, (moving joints, dof), that maps rates of the joint vector to rates of all moving joints."""
    rows = np.zeros((len(robot.couplings), robot.dof))
    for row, (column, ratio, _) in zip(rows, robot.couplings.values(), strict=True):
        row[column] = ratio
    return ca.sparsify(ca.DM(rows))


def link_frames(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> dict[str, Frame]:
    """Return the frames of all links in the world, by link name, the root link first."""
    return frames_and_axes(robot, q, world_from_base)[0]


def tip_pose(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Frame:
    """Return the pose of the tip frame in the world."""
    return tip_frame(robot, link_frames(robot, q, world_from_base))


def tip_frame(robot: Robot, frames: dict[str, Frame]) -> Frame:
    """Return the pose of the tip frame in the world, computed from the frames of the links."""
    link = frames[robot.tip_link]
    return Frame(ca.mtimes(link.rotation, constant(robot.tip_rotation)), link.point(robot.tip_translation))


def centers_of_mass(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> dict[str, Expression]:
    """Return the centre of mass of each link in the world, by link name. Shape (3, 1) each, m."""
    frames = link_frames(robot, q, world_from_base)
    return {link.name: frames[link.name].point(link.center_of_mass) for link in robot.links}


def center_of_mass(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Return the centre of mass of the whole robot in the world. Shape (3, 1), m."""
    frames = link_frames(robot, q, world_from_base)
    if robot.total_mass == 0:
        raise massless_error("hence no centre of mass")
    moment = sum(link.mass * frames[link.name].point(link.center_of_mass) for link in robot.links if link.mass)
    return ca.densify(moment / robot.total_mass)


def frame_jacobian(
    robot: Robot,
    q: Expression,
    link: str,
    *,
    point: Expression = (0.0, 0.0, 0.0),
    world_from_base: Placement | None = None,
) -> Expression:
    """Return the matrix, (6, dof), from joint rates to the (angular, linear) velocity of a link's point, in world axes.

    Columns of joints that do not carry the link are zero.

    Args:
        point: In the link's frame. Shape (3,), m.
    """
    frames, axes = frames_and_axes(robot, q, world_from_base)
    robot.link(link)
    place = frames[link].point(checked_vector("point", point, 3, "x, y and z in the frame of the link"))
    return ca.densify(point_jacobian(robot, axes, link, place))


def link_jacobians(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> dict[str, Expression]:
    """Return the geometric Jacobians of the origins of all link frames, by link name. Shape (6, dof) each."""
    frames, axes = frames_and_axes(robot, q, world_from_base)
    return {link: ca.densify(point_jacobian(robot, axes, link, frame.position)) for link, frame in frames.items()}


def tip_jacobian(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Return the matrix, (6, dof), that maps joint rates to the tip's (angular, linear) velocity in world axes."""
    tip = require.instance("kinematics: robot", robot, Robot).tip_link
    return frame_jacobian(robot, q, tip, point=robot.tip_translation, world_from_base=world_from_base)


def point_jacobian(
    robot: Robot, axes: dict[str, tuple[Expression, Expression]], link: str, point: Expression
) -> Expression:
    """Return the geometric Jacobian, (6, dof), of a link's point in world axes, computed from `frames_and_axes`."""
    carriers = {joint.name for joint in robot.path_to(link)}
    columns = {
        name: ca.vertcat(angular, linear + cross(angular, point)) if name in carriers else ca.DM(6, 1)
        for name, (angular, linear) in axes.items()
    }
    return ca.horzcat(ca.DM(6, 0), *reduce_to_joint_vector(robot, columns))


def joint_frames(robot: Robot, q: Expression) -> dict[str, Frame]:
    """Return the pose of each joint's child link in its parent link at given joint positions, by joint name."""
    positions, frames = _positions(robot, q), {}
    for joint in robot.joints:
        orientation, position = constant(joint.rotation), constant(joint.translation)
        if joint.kind == "prismatic":
            position = position + ca.mtimes(orientation, constant(joint.axis)) * positions[joint.name]
        elif joint.moves:
            orientation = ca.mtimes(orientation, rotation(constant(joint.axis), positions[joint.name]))
        frames[joint.name] = Frame(orientation, position)
    return frames


def _positions(robot: Robot, q: Expression) -> dict[str, Expression]:
    """Return the positions of all moving joints, including those that mimic others, by joint name."""
    positions = expand_joint_vector(robot, q)
    for name, coupling in robot.couplings.items():
        if coupling.offset:
            positions[name] = positions[name] + coupling.offset
    return positions


def frames_and_axes(
    robot: Robot, q: Expression, world_from_base: Placement | None = None
) -> tuple[dict[str, Frame], dict[str, tuple[Expression, Expression]]]:
    """Return, by name, the frames of all links in the world and the twist of each moving joint at unit joint rate.

    Twists are (angular velocity, velocity at the world's origin), world axes. Mimic joints are included.
    """
    positions = _positions(robot, q)
    frames: dict[str, Frame] = {robot.root: checked_placement(world_from_base)}
    axes: dict[str, tuple[Expression, Expression]] = {}
    turns: dict[str, _ParallelRotation] = {}
    for joint in robot.joints:
        parent, turn = frames[joint.parent], turns.get(joint.parent)
        frame = Frame(ca.mtimes(parent.rotation, constant(joint.rotation)), parent.point(joint.translation))
        if not np.array_equal(joint.rotation, np.eye(3)):
            turn = None
        if joint.kind == "prismatic":
            axis = ca.mtimes(frame.rotation, constant(joint.axis))
            axes[joint.name] = (ca.DM(3, 1), axis)
            frame = Frame(frame.rotation, frame.position + positions[joint.name] * axis)
        elif joint.moves:
            # Angles about consecutive parallel axes add up, which is cheaper than a product of rotations.
            if turn is not None and np.array_equal(turn.axis, joint.axis):
                turn = turn._replace(angle=turn.angle + positions[joint.name])
            else:
                turn = _ParallelRotation(frame.rotation, joint.axis, positions[joint.name])
            axis = ca.mtimes(turn.before, constant(joint.axis))
            axes[joint.name] = (axis, cross(frame.position, axis))
            frame = Frame(ca.mtimes(turn.before, rotation(constant(joint.axis), turn.angle)), frame.position)
        frames[joint.child] = frame
        if turn is not None:
            turns[joint.child] = turn
    return frames, axes


def constant(array: Array) -> Expression:
    """Return an array as a sparse CasADi DM that omits zeros and rounding residues such as cos(pi / 2)."""
    return ca.sparsify(ca.DM(array), 1e-15 * float(np.abs(array).max(initial=0.0)))


TWIST_SIZE = 6


def joint_limit_index(robot: Robot, q: Expression) -> Expression:
    """Return the joint-limit index, which grows from 0 as joints leave the middle of their ranges. Shape (1, 1).

    The sum of ((q - middle) / range)^2 over all joints with two position limits, equation (23) of Yoo et al. 2004. A
    joint adds 1/4 at a limit.
    """
    q = joint_vector(robot, q)
    width = robot.upper - robot.lower
    limited = np.flatnonzero(np.isfinite(width) & (width > 0)).tolist()
    middle = (robot.upper[limited] + robot.lower[limited]) / 2
    return ca.sumsqr((q[limited] - ca.DM(middle)) / ca.DM(width[limited])) if limited else type(q)(1, 1)


def joint_excess(robot: Robot, q: Expression) -> Expression:
    """Return the largest violation, (1, 1), of a joint limit: negative inside all limits, -inf without limits."""
    q = joint_vector(robot, q)
    lower, upper = np.flatnonzero(np.isfinite(robot.lower)).tolist(), np.flatnonzero(np.isfinite(robot.upper)).tolist()
    if not lower and not upper:
        return ca.DM(-np.inf)
    return ca.mmax(ca.densify(ca.vertcat(ca.DM(robot.lower[lower]) - q[lower], q[upper] - ca.DM(robot.upper[upper]))))


@on_scalars
def jacobian_manipulability(jacobian: Expression, rows: Sequence[int] = range(TWIST_SIZE)) -> Expression:
    """Return Yoshikawa's manipulability sqrt(det(G G')) of selected rows G of a tip Jacobian, zero at singularities.

    Args:
        jacobian: Shape (6, n).
        rows: Rows of the twist that the task fixes: angular 0..2, linear 3..5.

    Raises:
        ModelError: Rows out of range, repeated, or none.
    """
    return manipulability_of(ca.densify(expression(jacobian))[checked_rows(rows), :])


@on_scalars
def manipulability_of(task: Expression) -> Expression:
    """Return Yoshikawa's manipulability sqrt(det(G G')) of a task Jacobian G with shape (m, n). Shape (1, 1)."""
    square = ca.mtimes(task, task.T)
    if square.shape[0] <= 7:  # division-free
        volume = determinant(square)
    else:  # several arms: the expansion would be long
        diagonal, _, _ = ca.ldl(ca.densify(square), False)
        volume = 1
        for entry in ca.vertsplit(ca.vec(diagonal)):
            volume = volume * entry
    return ca.sqrt(ca.fmax(volume, 0))  # rounding can make a zero negative


def checked_rows(rows: Sequence[int]) -> list[int]:
    """Return indices of twist components as a list; raise ModelError for an empty list, repeated or unknown indices."""
    try:
        check_entries(rows)
        numbers = floats(list(rows))
    except NOT_NUMBERS:
        numbers = np.array([np.nan])
    integral = numbers.ndim == 1 and bool((numbers == np.round(numbers)).all())
    indices = numbers.astype(int).tolist() if integral else []
    if not integral:
        message = f"rows must be a list of the twist rows 0..5, not {rows!r}"
    elif not indices:
        message = "rows is empty; a task fixes at least one of the twist rows 0..5"
    elif len(set(indices)) < len(indices):
        message = f"rows {indices} name a twist row more than once"
    elif not all(0 <= row < TWIST_SIZE for row in indices):
        message = f"rows {indices} are not all among the twist rows 0..5 (angular 0..2, linear 3..5)"
    else:
        return indices
    raise ModelError(message, name="rows", value=rows, limit=(0, TWIST_SIZE - 1))
