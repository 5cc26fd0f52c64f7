"""Signed distances of many pairs of bodies, and their gradients with respect to base and joint coordinates.

The distance of two rigid bodies changes only with their relative twist, through a wrench. That twist is a sum of the
screws of the joints between them, so only the base frame is differentiated. All pairs of the same two
kinds of shapes are evaluated together as columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.checks import Array
from models.machines.machine import Machine
from models.robot.kinematics import frames_and_axes
from models.shapes.distance import COLUMNS, column, distance, pair_wrenches, soft_minimum
from models.shapes.shapes import Shape
from models.spatial import Expression, Frame, cross

WORLD = -1
"""Frame index that stands for the world."""


class PlacedShape(NamedTuple):
    """A shape in a collision scene, with its name and the frame that carries it.

    Attributes:
        name: Name of its link, with a number if the link has several shapes, or of an obstacle.
        shape: Shape in the frame that carries it.
        frame: Index of that frame among those of `CollisionScene.placements`; -1 for the world.
        link: Name of the link that carries the shape, or of the obstacle.
    """

    name: str
    shape: Shape
    frame: int
    link: str


def distance_gradients(
    machine: Machine,
    bodies: Sequence[PlacedShape],
    carriers: Sequence[str],
    moving: Callable[[Expression], list[Frame]],
    *,
    groups: Sequence[Sequence[tuple[int, int]]],
    rounding: float,
    softness: float,
) -> Any:
    """Return the CasADi Function that computes the distances of pairs of bodies and their gradients.

    (base, q, time) -> distances (n, 1), m, and gradients for base and q, shape (n, size of base and q).

    Args:
        machine: Machine that carries the bodies.
        bodies: All shapes.
        carriers: Links of the first frames, in order.
        moving: Function from time (s) to the remaining frames.
        groups: For each distance the pairs, indices of two bodies, of which it is the minimum.
        rounding, softness: Smoothing of each distance, and of the minimum of several, m.
    """
    base, q, time = ca.SX.sym("base", machine.base_size), ca.SX.sym("q", machine.joint_size), ca.SX.sym("time")
    world_from_base = machine.world_from_base(base)
    links, axes = frames_and_axes(machine.robot, q, world_from_base)
    frames = [*(links[link] for link in carriers), *moving(time), None]
    screws = ca.horzcat(_base_twists(world_from_base, base), *(ca.vertcat(*axis) for axis in axes.values()))
    pairs = np.array([both for group in groups for both in group], dtype=int).reshape(-1, 2)
    batches: dict[Any, list[int]] = {}
    for number, both in enumerate(pairs.tolist()):
        kinds = tuple(type(bodies[body].shape) for body in both)
        batches.setdefault(kinds if set(kinds) <= COLUMNS.keys() else None, []).append(number)
    general = batches.pop(None, [])
    general_pairs = [[bodies[body] for body in pairs[number]] for number in general]
    gaps = [distance(a.shape, b.shape, frames[a.frame], frames[b.frame], rounding=rounding) for a, b in general_pairs]
    general_gaps = ca.vertcat(ca.SX(0, 1), *gaps)
    sides = [
        [ca.vertcat(*(column(bodies[k].shape, frames[bodies[k].frame]).T for k in side)) for side in pairs[members].T]
        for members in batches.values()
    ]
    general_gradients = ca.jacobian(general_gaps, ca.vertcat(base, q))
    parts = ca.cse([ca.SX(screws), general_gaps, general_gradients, *(side for both in sides for side in both)])
    geometry = ca.Function("posed", [base, q, time], list(map(ca.densify, parts)))

    names = ["base", "q", "time"]
    arguments = [ca.MX.sym(name, symbol.numel()) for name, symbol in zip(names, (base, q, time), strict=True)]
    twist_columns, value, gradient, *columns = geometry.call(arguments)
    signs, reduction = _motion_signs(machine, bodies, carriers, pairs, list(axes)), _leader_columns(machine, list(axes))
    values, rows, order = [value], [gradient], list(general)
    for k, (kinds, members) in enumerate(batches.items()):
        gap, wrench = pair_wrenches(kinds[0], kinds[1], rounding, len(members))(*columns[2 * k : 2 * k + 2])
        joint_gradient = ca.mtimes(wrench, twist_columns) * signs[members]
        values.append(gap)
        rows.append(joint_gradient if reduction is None else ca.mtimes(joint_gradient, reduction))
        order += members
    result = ca.vertcat(*values), ca.vertcat(*rows)
    if order:
        result = _reduce_groups(*result, np.argsort(order, kind="stable").tolist(), list(map(len, groups)), softness)
    return ca.Function("distances", arguments, result, names, ["distances", "gradients"])


def _reduce_groups(
    value: Expression, gradient: Expression, positions: list[int], counts: list[int], softness: float
) -> tuple[Expression, Expression]:
    """Return the soft minimum of the distances in each group of pairs of shapes, and the gradient of the minimum."""
    values, rows, order = [value], [gradient], []
    for begin, end in pairwise(accumulate(counts, initial=0)):
        members = positions[begin:end]
        if len(members) == 1:
            order += members
            continue
        group = value[members]
        weights = ca.exp((ca.mmin(group) - group) / softness)
        order.append(len(positions) + len(values) - 1)
        values.append(soft_minimum(ca.vertsplit(group), softness))
        rows.append(ca.mtimes((weights / ca.sum1(weights)).T, gradient[members, :]))
    return ca.vertcat(*values)[order], ca.vertcat(*rows)[order, :]


def _motion_signs(
    machine: Machine, bodies: Sequence[PlacedShape], carriers: Sequence[str], pairs: Array, joints: Sequence[str]
) -> Array:
    """Return 1 where a base or joint coordinate moves only the first body of a pair, -1 only the second, else 0. Shape
    (n, k).
    """
    size = machine.base_size
    carried = np.zeros((len(bodies), size + len(joints)))
    for k, body in enumerate(bodies):
        if 0 <= body.frame < len(carriers):
            above = {joint.name for joint in machine.robot.path_to(carriers[body.frame])}
            carried[k] = [1.0] * size + [float(name in above) for name in joints]
    return np.asarray(carried[pairs[:, 0]] - carried[pairs[:, 1]])


def _leader_columns(machine: Machine, joints: Sequence[str]) -> ca.DM | None:
    """Return the matrix that adds the columns of mimic joints to those of their leaders, or None if no joint mimics."""
    robot, size = machine.robot, machine.base_size
    matrix = np.zeros((size + len(joints), size + robot.dof))
    matrix[:size, :size] = np.eye(size)
    for k, name in enumerate(joints):
        column, ratio, _ = robot.couplings[name]
        matrix[size + k, size + column] = ratio
    return None if np.array_equal(matrix, np.eye(len(matrix))) else ca.DM(matrix)


def _base_twists(world_from_base: Frame, base: Expression) -> Expression:
    """Return the twist of the base, in world axes, for a unit rate of each base coordinate. Shape (6, size).

    A column is (angular velocity, velocity at the world's origin).
    """
    orientation, position = (ca.SX(part) for part in world_from_base)
    twists = []
    for k in range(base.numel()):
        spin = ca.mtimes(ca.reshape(ca.jacobian(ca.vec(orientation), base[k]), 3, 3), orientation.T)
        angular = ca.vertcat(spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]) / 2
        twists.append(ca.vertcat(angular, ca.jacobian(position, base[k]) + cross(position, angular)))
    return ca.horzcat(ca.SX(6, 0), *twists)
