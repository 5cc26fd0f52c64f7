"""Distances of many pairs of bodies with their gradients, by wrenches.

A distance of rigid bodies changes with the twist of one seen from the other alone, by a wrench, and that twist is a sum
of the screws of the joints between the two: no derivatives are taken but those of frames by the base. All pairs of two
kinds of shapes are columns of numbers side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.arrays import Array
from models.machines.machine import Machine
from models.robot.kinematics import frames_and_axes
from models.shapes.distance import COLUMNS, column, distance, pair_wrenches, soft_minimum
from models.shapes.shapes import Shape
from models.spatial import Expression, Frame, cross

WORLD = -1
"""In the place of a frame: the world."""


class PlacedShape(NamedTuple):
    """A body that is looked at.

    Attributes:
        name: Of its link, with a number where it has several; or of an obstacle.
        shape: In the frame that it rides on.
        frame: Index of that frame among those of `CollisionScene.placements`; -1: the world.
    """

    name: str
    shape: Shape
    frame: int


def distance_gradients(
    machine: Machine,
    bodies: Sequence[PlacedShape],
    carriers: Sequence[str],
    moving: Callable[[Expression], list[Frame]],
    groups: Sequence[Sequence[tuple[int, int]]],
    rounding: float,
    softness: float,
) -> Any:
    """Function (base, q, time) -> distances, shape (n, 1), m, and gradients, shape (n, size of base and q).

    Args:
        machine: Whose bodies.
        bodies: All. carriers: Links of their frames, in order. moving: Time (s) -> the frames behind these.
        groups: Of each distance the pairs, numbers of two bodies, that it is the least of.
        rounding, softness: Of a distance, and of the least of several, m.
    """
    base, q, time = ca.SX.sym("base", machine.base_size), ca.SX.sym("q", machine.joint_size), ca.SX.sym("time")
    world_from_base = machine.world_from_base(base)
    links, axes = frames_and_axes(machine.robot, q, world_from_base)
    frames = [*(links[link] for link in carriers), *moving(time), None]
    screws = ca.horzcat(_base_twists(world_from_base, base), *(ca.vertcat(*axis) for axis in axes.values()))
    pairs = np.array([both for group in groups for both in group], dtype=int).reshape(-1, 2)
    lots: dict[Any, list[int]] = {}
    for number, both in enumerate(pairs.tolist()):
        kinds = tuple(type(bodies[body].shape) for body in both)
        lots.setdefault(kinds if set(kinds) <= COLUMNS.keys() else None, []).append(number)
    others = lots.pop(None, [])
    placed = [[bodies[body] for body in pairs[number]] for number in others]
    apart = [distance(a.shape, b.shape, frames[a.frame], frames[b.frame], rounding=rounding) for a, b in placed]
    rest = ca.vertcat(ca.SX(0, 1), *apart)
    sides = [
        [ca.vertcat(*(column(bodies[body].shape, frames[bodies[body].frame]).T for body in some)) for some in own.T]
        for own in (pairs[members] for members in lots.values())
    ]
    slopes = ca.jacobian(rest, ca.vertcat(base, q))
    parts = ca.cse([ca.SX(screws), rest, slopes, *(side for both in sides for side in both)])
    posed = ca.Function("posed", [base, q, time], list(map(ca.densify, parts)))

    names = ["base", "q", "time"]
    given = [ca.MX.sym(name, symbol.numel()) for name, symbol in zip(names, (base, q, time), strict=True)]
    twists, value, gradient, *columns = posed.call(given)
    moved, gathered = _moved(machine, bodies, carriers, pairs, list(axes)), _gathered(machine, list(axes))
    values, rows, order = [value], [gradient], list(others)
    for k, (kinds, members) in enumerate(lots.items()):
        gap, wrench = pair_wrenches(kinds[0], kinds[1], rounding, len(members))(*columns[2 * k : 2 * k + 2])
        by_screws = ca.mtimes(wrench, twists) * moved[members]
        values.append(gap)
        rows.append(by_screws if gathered is None else ca.mtimes(by_screws, gathered))
        order += members
    found = ca.vertcat(*values), ca.vertcat(*rows)
    if order:
        found = _least(*found, np.argsort(order, kind="stable").tolist(), list(map(len, groups)), softness)
    return ca.Function("distances", given, found, names, ["distances", "gradients"])


def _least(
    value: Expression, gradient: Expression, place: list[int], counts: list[int], softness: float
) -> tuple[Expression, Expression]:
    """Return the soft minimum of consecutive pairs, or the one pair itself."""
    values, rows, order = [value], [gradient], []
    for begin, end in pairwise(accumulate(counts, initial=0)):
        at = place[begin:end]
        if len(at) == 1:
            order += at
            continue
        own = value[at]
        weights = ca.exp((ca.mmin(own) - own) / softness)
        order.append(len(place) + len(values) - 1)
        values.append(soft_minimum(ca.vertsplit(own), softness))
        rows.append(ca.mtimes((weights / ca.sum1(weights)).T, gradient[at, :]))
    return ca.vertcat(*values)[order], ca.vertcat(*rows)[order, :]


def _moved(
    machine: Machine, bodies: Sequence[PlacedShape], carriers: Sequence[str], pairs: Array, joints: Sequence[str]
) -> Array:
    """1 where a coordinate of the base or a joint moves the first body of a pair alone, -1 the second, else 0."""
    size = machine.base_size
    carried = np.zeros((len(bodies), size + len(joints)))
    for k, body in enumerate(bodies):
        if 0 <= body.frame < len(carriers):
            above = {joint.name for joint in machine.robot.path_to(carriers[body.frame])}
            carried[k] = [1.0] * size + [float(name in above) for name in joints]
    return np.asarray(carried[pairs[:, 0]] - carried[pairs[:, 1]])


def _gathered(machine: Machine, joints: Sequence[str]) -> ca.DM | None:
    """Columns of base and joints, followers at the joints that they follow; None where each has its own."""
    robot, size = machine.robot, machine.base_size
    gathered = np.zeros((size + len(joints), size + robot.dof))
    gathered[:size, :size] = np.eye(size)
    for k, name in enumerate(joints):
        column, ratio, _ = robot.couplings[name]
        gathered[size + k, size + column] = ratio
    return None if np.array_equal(gathered, np.eye(len(gathered))) else ca.DM(gathered)


def _base_twists(world_from_base: Frame, base: Expression) -> Expression:
    """Twists of a base by its coordinates, (angular, linear at the world's origin), world axes. Shape (6, size)."""
    turn, place = (ca.SX(part) for part in world_from_base)
    found = []
    for k in range(base.numel()):
        spin = ca.mtimes(ca.reshape(ca.jacobian(ca.vec(turn), base[k]), 3, 3), turn.T)
        angular = ca.vertcat(spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]) / 2
        found.append(ca.vertcat(angular, ca.jacobian(place, base[k]) + cross(place, angular)))
    return ca.horzcat(ca.SX(6, 0), *found)
