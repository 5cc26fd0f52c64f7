"""Distances of many pairs of bodies with their gradients, by wrenches.

A distance of rigid bodies changes with the twist of one seen from the other alone, by a wrench, and that twist is a sum
of the screws of the joints between the two: no derivatives are taken but those of frames by the base. Here are the
parts: what follows from the configuration, and the pairs of two kinds of shapes side by side. An interpreter puts them
together as columns of numbers (`PairGradients.function`); so may a program in C.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.arrays import Array
from models.machines.machine import Machine
from models.robot.kinematics import frames_and_axes
from models.robot.robot import Robot
from models.shapes.distance import COLUMNS, column, distance, pair_wrenches, soft_minimum
from models.shapes.shapes import Shape
from models.spatial import Expression, Frame, cross

WORLD = -1
"""In the place of a frame: the world."""


class Placed(NamedTuple):
    """A body that is looked at.

    Attributes:
        name: Of its link, with a number where it has several; or of an obstacle.
        shape: In the frame that it rides on.
        frame: Index of that frame among those of `Surroundings.placements`; -1: the world.
    """

    name: str
    shape: Shape
    frame: int


class Lot(NamedTuple):
    """Pairs of two kinds of shapes.

    Attributes:
        kinds: Of the first and the second shape of each pair.
        rows: Where these are among the columns of their kinds. Shape (2, n).
        still: Which of them rest in the world, so that their columns are always the same. Shape (2, n).
        members: Numbers of the pairs. Shape (n,).
    """

    kinds: tuple[Any, Any]
    rows: Array
    still: Array
    members: Array


@dataclass(frozen=True)
class PairGradients:
    """What distances and gradients of P pairs of bodies are put together from.

    Attributes:
        posed: Function (base, q, time) -> the screws of the c coordinates of the base and joints that move, (angular,
            linear at the world's origin), world axes, shape (6, c); the distances of ``others``, shape (R, 1), m, and
            their gradients, shape (R, size of base and q); then the columns of the shapes of each kind of
            `models.shapes.distance.COLUMNS`, shape (bodies, entries). All dense.
        lots: The pairs of shapes that have columns.
        others: Numbers of the pairs that do not.
        moved: 1 where a coordinate moves the first body of a pair alone, -1 the second, else 0. Shape (P, c).
        gathered: Share of each of the c coordinates in the rates of base and q. Shape (c, size).
        counts: Of how many pairs in a row each distance that is told is the least.
        softness: Width of that `soft_minimum`, m.
        rounding: Of the distances, m.
    """

    posed: Any
    lots: tuple[Lot, ...]
    others: tuple[int, ...]
    moved: Array
    gathered: Array
    counts: tuple[int, ...]
    softness: float
    rounding: float

    def function(self) -> Any:
        """Function (base, q, time) -> distances, shape (n, 1), m, and gradients, shape (n, size); interpreted."""
        symbols = [ca.MX.sym(self.posed.name_in(k), self.posed.size1_in(k)) for k in range(3)]
        screws, rest, slopes, *told = self.posed.call(symbols)
        shapes = dict(zip(COLUMNS, told, strict=True))
        values, rows, order = [rest], [slopes], list(self.others)
        follow = not np.array_equal(self.gathered, np.eye(len(self.gathered)))
        for lot in self.lots:
            sides = [shapes[kind][at.tolist(), :] for kind, at in zip(lot.kinds, lot.rows, strict=True)]
            gap, wrench = pair_wrenches(lot.kinds[0], lot.kinds[1], self.rounding, len(lot.members))(*sides)
            by_screws = ca.mtimes(wrench, screws) * self.moved[lot.members]
            values.append(gap)
            rows.append(ca.mtimes(by_screws, ca.DM(self.gathered)) if follow else by_screws)
            order += lot.members.tolist()
        value, gradient = ca.vertcat(*values), ca.vertcat(*rows)
        if order:
            value, gradient = self._told(value, gradient, np.argsort(order, kind="stable").tolist())
        return ca.Function("distances", symbols, [value, gradient], ["base", "q", "time"], ["distances", "gradients"])

    def _told(self, value: Expression, gradient: Expression, place: list[int]) -> tuple[Expression, Expression]:
        """What is told of the pairs, which are at these places: themselves, or the soft minimum of several."""
        values, rows, order, first = [value], [gradient], [], 0
        for count in self.counts:
            at = place[first : first + count]
            first += count
            if count == 1:
                order.append(at[0])
                continue
            own = value[at]
            weights = ca.exp((ca.mmin(own) - own) / self.softness)
            order.append(len(place) + len(values) - 1)
            values.append(soft_minimum(ca.vertsplit(own), self.softness))
            rows.append(ca.mtimes((weights / ca.sum1(weights)).T, gradient[at, :]))
        return ca.vertcat(*values)[order], ca.vertcat(*rows)[order, :]


def pair_gradients(
    machine: Machine,
    bodies: Sequence[Placed],
    carriers: Sequence[str],
    moving: Callable[[Expression], list[Frame]],
    groups: Sequence[Sequence[tuple[int, int]]],
    rounding: float,
    softness: float,
) -> PairGradients:
    """The parts of distances with gradients of a machine.

    Args:
        machine: Whose bodies.
        bodies: All. carriers: Links of their frames, in order. moving: Time (s) -> the frames behind these.
        groups: Of each distance that is told the pairs, numbers of two bodies, that it is the least of.
        rounding, softness: m.
    """
    base, q, time = ca.SX.sym("base", machine.base_size), ca.SX.sym("q", machine.joint_size), ca.SX.sym("time")
    measured = [both for each in groups for both in each]
    kinds = [tuple(type(bodies[body].shape) for body in both) for both in measured]
    world_from_base = machine.world_from_base(base)
    links, axes = frames_and_axes(machine.robot, q, world_from_base)
    frames = [*(links[link] for link in carriers), *moving(time), None]
    lots: dict[Any, list[int]] = {}
    for number, both in enumerate(kinds):
        lots.setdefault(both if set(both) <= COLUMNS.keys() else None, []).append(number)
    others = lots.pop(None, [])
    placed = [(bodies[one], bodies[other]) for one, other in (measured[number] for number in others)]
    apart = [distance(a.shape, b.shape, frames[a.frame], frames[b.frame], rounding=rounding) for a, b in placed]
    seen = dict.fromkeys(body for members in lots.values() for number in members for body in measured[number])
    columns = {body: column(bodies[body].shape, frames[bodies[body].frame]).T for body in seen}
    of_kind = {kind: [body for body in columns if type(bodies[body].shape) is kind] for kind in COLUMNS}
    screws = ca.horzcat(_base_twists(world_from_base, base), *(ca.vertcat(*axis) for axis in axes.values()))
    rest = ca.vertcat(ca.SX(0, 1), *apart)
    told = [
        ca.densify(ca.vertcat(ca.SX(0, size), *(columns[body] for body in of_kind[kind])))
        for kind, size in COLUMNS.items()
    ]
    parts = ca.cse([ca.SX(screws), rest, ca.jacobian(rest, ca.vertcat(base, q))])
    posed = ca.Function("posed", [base, q, time], [*(ca.densify(part) for part in parts), *told], {})
    places = {body: row for rows in of_kind.values() for row, body in enumerate(rows)}

    def side_by_side(kinds: Any, members: list[int]) -> Lot:
        own = [measured[number] for number in members]
        rows, frames = (np.array([[of(body) for body in both] for both in own]).T for of in (places.get, frame_of))
        return Lot(kinds, rows, frames == WORLD, np.array(members))

    def frame_of(body: int) -> int:
        return bodies[body].frame

    return PairGradients(
        posed,
        tuple(side_by_side(*lot) for lot in lots.items()),
        tuple(others),
        _moved(machine, bodies, carriers, measured, list(axes)),
        _gathered(machine.robot, machine.base_size, list(axes)),
        tuple(map(len, groups)),
        softness,
        float(rounding),
    )


def _moved(
    machine: Machine,
    bodies: Sequence[Placed],
    carriers: Sequence[str],
    measured: Sequence[tuple[int, int]],
    joints: Sequence[str],
) -> Array:
    """1 where a coordinate of the base or a joint moves the first body of a pair alone, -1 the second, else 0."""
    size = machine.base_size
    carried = np.zeros((len(bodies), size + len(joints)))
    for k, body in enumerate(bodies):
        if 0 <= body.frame < len(carriers):
            above = {joint.name for joint in machine.robot.path_to(carriers[body.frame])}
            carried[k] = [1.0] * size + [float(name in above) for name in joints]
    both = np.array(measured, dtype=int).reshape(-1, 2)
    return np.asarray(carried[both[:, 0]] - carried[both[:, 1]])


def _gathered(robot: Robot, size: int, joints: Sequence[str]) -> Array:
    """Columns of a base of this size and of joints, followers at the joints that they follow."""
    gathered = np.zeros((size + len(joints), size + robot.dof))
    gathered[:size, :size] = np.eye(size)
    for k, name in enumerate(joints):
        column, ratio, _ = robot.drives[name]
        gathered[size + k, size + column] = ratio
    return gathered


def _base_twists(world_from_base: Frame, base: Expression) -> Expression:
    """Twists of a base by its coordinates, (angular, linear at the world's origin), world axes. Shape (6, size)."""
    turn, place = (ca.SX(part) for part in world_from_base)
    found = []
    for k in range(base.numel()):
        spin = ca.mtimes(ca.reshape(ca.jacobian(ca.vec(turn), base[k]), 3, 3), turn.T)
        angular = ca.vertcat(spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]) / 2
        found.append(ca.vertcat(angular, ca.jacobian(place, base[k]) + cross(place, angular)))
    return ca.horzcat(ca.SX(6, 0), *found)
