"""All postures of an arm at a pose, in closed form where its geometry has one.

Six joints that turn have one where the axes of three of them that follow each other meet in a point or are parallel
(Pieper 1968): spherical wrists and shoulders, arms with three parallel axes. The product of the joints' motions is what
moves the tip from its home, e_1 .. e_6 = G; turned round, and carried along by G, it stays one, so that the three may
be taken as the last ones, a, b, c, and the others as x, y, z. What the three leave alone, a point, or a direction and
the places along it, gives two equations linear in the cosines and sines of the angles of x and z: a polynomial of
degree four, four pairs at most. The angle of y follows, and of a, b, c there are two ways each: at most eight postures
(subproblems as those of Elias and Wen 2022, IK-Geo). Four joints along one direction, three that turn and one that
slides (SCARA), are the last of these steps alone. Joints more than that are held.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import Machine
from models.arrays import Array

__all__ = ["ClosedForm", "closed_forms"]

SIX, SCARA, MOST = 6, 4, 8
"""Joints of the arms that closed forms are known of, and as many as an arm may have, those that are held counted."""
POSTURES = 8
"""At most, at one pose, of joints that turn."""
TURN = 2 * np.pi


@dataclass(frozen=True)
class FormSettings:
    """How exact geometry and solutions of a closed form have to be.

    Attributes:
        straight: Share of the arm's size, and rad, up to which axes meet or are parallel; Newton's method refines.
        near: Miss of equations up to which what solves them is corrected: where two solutions meet they are so inexact.
        steps: Of Newton's method at most.
        exact: Share of the arm's size, and rad, that the pose is missed by at last.
        rough: Share of the arm's size, and rad, that the pose is missed by ever.
        same: rad: postures nearer to each other are one.
    """

    straight: float = 1e-6
    near: float = 1e-3
    steps: int = 8
    exact: float = 1e-10
    rough: float = 0.1
    same: float = 1e-6


FORMS = FormSettings()


class Motion(NamedTuple):
    """Rigid motions v -> turn v + shift. Shapes (M, 3, 3), (M, 3)."""

    turn: Array
    shift: Array

    def take(self, chosen: NDArray[np.intp]) -> Motion:
        return Motion(self.turn[chosen], self.shift[chosen])

    def after(self, other: Motion) -> Motion:
        """First the other one."""
        return Motion(self.turn @ other.turn, self.at(other.shift))

    def at(self, points: Array) -> Array:
        """Where points (M, 3) come to."""
        return np.asarray(np.einsum("mij,mj->mi", self.turn, points) + self.shift)

    @property
    def back(self) -> Motion:
        """The motion that undoes it."""
        turn = self.turn.transpose(0, 2, 1)
        return Motion(turn, -np.einsum("mij,mj->mi", turn, self.shift))


class Axis(NamedTuple):
    """Lines that joints turn about, or along which they slide. Unit vectors (M, 3) and points (M, 3)."""

    way: Array
    point: Array

    def take(self, chosen: NDArray[np.intp]) -> Axis:
        return Axis(self.way[chosen], self.point[chosen])

    def moved(self, motion: Motion) -> Axis:
        return Axis(np.einsum("mij,mj->mi", motion.turn, self.way), motion.at(self.point))

    def by(self, angle: Array, turns: bool = True) -> Motion:
        """The motion of the joint."""
        if not turns:
            return Motion(np.broadcast_to(np.eye(3), (len(angle), 3, 3)), self.way * angle[:, None])
        cross = np.cross(np.eye(3)[None], self.way[:, None])
        sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
        turn = np.eye(3) + sine * cross + (1 - cosine) * cross @ cross
        return Motion(turn, self.point - np.einsum("mij,mj->mi", turn, self.point))

    def angle(self, start: Array, end: Array) -> Array:
        """By which it turns vectors (M, 3) towards others, as seen along it."""
        across = start - _dot(start, self.way)[:, None] * self.way
        return np.arctan2(_dot(self.way, np.cross(across, end)), _dot(across, end))


@dataclass(frozen=True, eq=False)
class ClosedForm:
    """A closed form of the postures of an arm.

    Attributes:
        kind: "meeting" or "parallel": what the axes of three of its joints do; "scara".
        three: Numbers of these joints.
        held: Of those that have to be given.
        ways, points: Axes of all joints when all are at 0, in the world. Shapes (n, 3), m.
        turns: Which joints turn; the others slide along their axes. Shape (n,), bool.
        place, rotation: Of the tip then, in the world. Shapes (3,), (3, 3).
        order: Numbers of the joints from the base to the tip.
        size: How far the axes are from the tip, m.
    """

    kind: str
    three: tuple[int, ...]
    held: tuple[int, ...]
    ways: Array
    points: Array
    turns: NDArray[np.bool_]
    place: Array
    rotation: Array
    order: tuple[int, ...]
    size: float

    def postures(self, places: Array, rotations: Array, held: Array) -> tuple[NDArray[np.intp], Array]:
        """All postures at M poses, but where a whole family does.

        Args:
            places, rotations: Of the tip in the world. Shapes (M, 3), (M, 3, 3).
            held: Positions of the joints that are held. Shape (M, len(held)).

        Returns:
            The pose of each posture, shape (K,), and joint positions, angles between -pi and pi, (K, n); joints that do
            not lead to the tip are at 0.
        """
        count, n = len(places), len(self.ways)
        joints = np.zeros((count, n))
        joints[:, list(self.held)] = held
        moved = Motion(np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 3)))
        axes = list[Axis]()
        for j in self.order:
            axis = Axis(np.broadcast_to(self.ways[j], (count, 3)), np.broadcast_to(self.points[j], (count, 3)))
            axis = axis.moved(moved)
            if j in self.held:
                moved = axis.by(joints[:, j], bool(self.turns[j])).after(moved)
            else:
                axes.append(axis)
        home = moved.after(Motion(np.broadcast_to(self.rotation, (count, 3, 3)), np.tile(self.place, (count, 1))))
        goal = Motion(rotations, places).after(home.back)
        free = [j for j in self.order if j not in self.held]
        if self.kind == "scara":
            seats = [free.index(j) for j in (*self.three, *(j for j in free if j not in self.three))]
            own, angles = _planar([axes[i] for i in seats[:3]], goal)
            slid = _dot(axes[seats[3]].way, goal.at(axes[seats[0]].point) - axes[seats[0]].point)
            found = np.column_stack([angles, slid[own]])
        else:
            at = free.index(self.three[0])
            # what stands behind the three goes before; what goes past the pose so is carried back by it
            seats = [(at + 3 + i) % SIX for i in range(SIX)]
            own, found = _of_six([axes[i].moved(goal.back) if i < at + 3 else axes[i] for i in seats], goal, self)
        angles = np.empty_like(found)
        angles[:, seats] = found
        own, angles = _corrected(axes, goal, own, angles, self.turns[free], places, self.size)
        joints = joints[own]
        joints[:, free] = angles
        return own, joints


def closed_forms(machine: Machine) -> tuple[ClosedForm, ...]:
    """The closed forms of a machine's arm, found from its axes; none where it has none, or where its base moves.

    Of arms with more joints than six one for each choice of joints to hold that leaves one. Joints that do not lead to
    the tip do not matter.
    """
    robot = machine.robot
    path = () if robot.tip is None else [joint for joint in robot.path_to(robot.tip_link) if joint.moves]
    n = len(path)
    if machine.base_size or n > MOST or any(joint.mimic is not None for joint in path):
        return ()
    order = tuple(robot.joint_names.index(joint.name) for joint in path)
    arm = _Arm.of(machine, order)
    return _forms_of_scara(arm) if n == SCARA else _forms_of_six(arm)


def _forms_of_scara(arm: _Arm) -> tuple[ClosedForm, ...]:
    three, slides = tuple(j for j in arm.order if arm.turns[j]), [j for j in arm.order if not arm.turns[j]]
    if len(slides) != 1 or arm.kind_of(three) != "parallel":
        return ()
    lean = float(np.linalg.norm(np.cross(arm.ways[slides[0]], arm.ways[three[0]])))
    return (arm.form("scara", three, ()),) if lean < FORMS.straight else ()


def _forms_of_six(arm: _Arm) -> tuple[ClosedForm, ...]:
    n, found = len(arm.order), list[ClosedForm]()
    for held in combinations(arm.order, n - SIX) if n >= SIX else ():
        if not arm.turns[[j for j in arm.order if j not in held]].all():
            continue
        rows = [arm.order[i : i + 3] for i in range(n - 2)]
        kinds = [(arm.kind_of(three), three) for three in rows if not set(three) & set(held)]
        found += [arm.form(kind, three, held) for kind, three in sorted(kinds) if kind][:1]
    return tuple(found)


class _Arm(NamedTuple):
    """Axes of an arm with all joints at zero, and its tip there; as of ClosedForm."""

    ways: Array
    points: Array
    turns: NDArray[np.bool_]
    place: Array
    rotation: Array
    order: tuple[int, ...]
    size: float

    @classmethod
    def of(cls, machine: Machine, order: tuple[int, ...]) -> _Arm:
        at = ca.DM(machine.joint_size, 1)
        pose, jacobian = machine.tip_pose((), at), np.array(ca.DM(machine.tip_jacobian((), at)))
        place, rotation = np.array(ca.DM(pose.position)).ravel(), np.array(ca.DM(pose.rotation))
        turning, moving = jacobian[:3].T, jacobian[3:].T
        turns = np.linalg.norm(turning, axis=1) > 0.5  # it is one or zero
        ways = np.where(turns[:, None], turning, moving)
        points = np.where(turns[:, None], place + np.cross(turning, moving), place)
        size = max(float(np.linalg.norm(points - place, axis=1).max()), 1e-3)
        return cls(ways, points, turns, place, rotation, order, size)

    def form(self, kind: str, three: tuple[int, ...], held: tuple[int, ...]) -> ClosedForm:
        """The closed form by three axes, with some joints held."""
        return ClosedForm(kind, three, held, *self)

    def kind_of(self, three: tuple[int, ...]) -> str:
        """What three axes do that follow each other: "parallel", "meeting", or "" for neither."""
        ways, points = self.ways, self.points
        if not self.turns[list(three)].all():
            return ""
        leans = [float(np.linalg.norm(np.cross(ways[one], ways[other]))) for one, other in pairwise(three)]
        if max(leans) < FORMS.straight:
            apart = [points[other] - points[one] for one, other in pairwise(three)]
            apart = [way - way @ ways[three[0]] * ways[three[0]] for way in apart]
            return "parallel" if min(map(np.linalg.norm, apart)) > FORMS.straight * self.size else ""
        across = np.eye(3) - ways[list(three), :, None] * ways[list(three), None, :]
        pulled = np.einsum("kij,kj->ki", across, points[list(three)])
        point = np.linalg.lstsq(across.sum(axis=0), pulled.sum(axis=0), rcond=FORMS.straight)[0]
        off = np.linalg.norm(np.einsum("kij,j->ki", across, point) - pulled, axis=1).max()
        return "meeting" if min(leans) > FORMS.straight and off < FORMS.straight * self.size else ""


def _dot(one: Array, other: Array) -> Array:
    return np.asarray((one * other).sum(axis=-1))


def _turned(fixed: Array, axis: Array, vector: Array) -> tuple[Array, Array, Array]:
    """fixed . R(axis, angle) vector = constant + cosine part + sine part, of M vectors each."""
    constant = _dot(fixed, axis) * _dot(axis, vector)
    return constant, _dot(fixed, vector) - constant, _dot(fixed, np.cross(axis, vector))


def _of_six(axes: list[Axis], goal: Motion, form: ClosedForm) -> tuple[NDArray[np.intp], Array]:
    """Angles of e_x e_y e_z e_a e_b e_c = goal, those of a, b, c meeting or parallel: rough, and some that are none."""
    (x, y, z, a, b, c), kind, size = axes, form.kind, form.size
    between = (x.point - y.point) / size, (z.point - y.point) / size
    if kind == "meeting":
        point = _meeting(a, b, c)
        end, start = (goal.at(point) - x.point) / size, (point - z.point) / size
        # e_z p and e_x^-1 G p are as far from the axis of y, and as high above its point
        left = [_turned(2 * between[0], -x.way, end), _turned(y.way, -x.way, end)]
        right = [_turned(2 * between[1], z.way, start), _turned(y.way, z.way, start)]
        rest = [
            _dot(between[1], between[1]) + _dot(start, start) - _dot(between[0], between[0]) - _dot(end, end),
            _dot(y.way, between[1] - between[0]),
        ]
    else:
        way, point = a.way, a.point
        ahead, end = np.einsum("mij,mj->mi", goal.turn, way), (goal.at(point) - x.point) / size
        # the direction of the three, and how far along it a point is, before and after
        left = [_turned(y.way, -x.way, ahead), _turned(between[0], -x.way, ahead)]
        right = [_turned(y.way, z.way, way), _turned(between[1], z.way, way)]
        rest = [np.zeros(len(way)), _dot(way, point - z.point) / size - _dot(ahead, end)]
    a_, b_ = (np.stack([np.stack(part[1:], axis=1) for part in side], axis=1) for side in (left, right))
    c_ = np.stack([r + part[0] - other[0] for r, part, other in zip(rest, right, left, strict=True)], axis=1)
    own, first, third = _pairs(a_, -b_, c_)
    x, y, z, a, b, c = (axis.take(own) for axis in (x, y, z, a, b, c))
    goal = goal.take(own)
    if kind == "meeting":
        start, end = z.by(third).at(point[own]) - y.point, x.by(first).back.at(goal.at(point[own])) - y.point
    else:
        start = np.einsum("mij,mj->mi", z.by(third).turn, way[own])
        end = np.einsum("mji,mj->mi", x.by(first).turn, ahead[own])
    second = y.angle(start, end)
    left_over = x.by(first).after(y.by(second)).after(z.by(third)).back.after(goal)
    which, last = (_wrist if kind == "meeting" else _planar)([a, b, c], left_over)
    return own[which], np.column_stack([first[which], second[which], third[which], last])


def _pairs(a: Array, b: Array, c: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """Angles with a [cos, sin](first) + b [cos, sin](second) = c. Shapes (M, 2, 2), (M, 2, 2), (M, 2)."""
    left, size, right = np.linalg.svd(b)
    size = size + 1e-300
    low = size[:, 1] < FORMS.straight * size[:, 0]
    alpha, gamma = left.transpose(0, 2, 1) @ a, np.einsum("mji,mj->mi", left, c)
    # w(z) = gamma - delta z - conj(delta) / z with z = exp(i first), and (w_1 / s_1)^2 + (w_2 / s_2)^2 = 1
    delta = (alpha[:, :, 0] - 1j * alpha[:, :, 1]) / 2
    rows = np.stack([-delta, gamma.astype(complex), -delta.conj()], axis=2)
    scale = size[:, ::-1] / size[:, :1]
    square = np.zeros((len(a), 5), dtype=complex)
    for i in range(3):
        for j in range(3):
            square[:, i + j] += (scale**2 * rows[:, :, i] * rows[:, :, j]).sum(axis=1)
    square[:, 2] -= size[:, 1] ** 2
    roots = _roots(square)
    # where the second equation does not know the second angle it has two solutions by itself
    straight = _roots(rows[:, 1])
    roots[low] = np.concatenate([straight, np.full_like(straight, np.nan)], axis=1)[low]
    with np.errstate(divide="ignore", invalid="ignore"):
        own, column = np.nonzero(np.abs(np.log(np.abs(roots))) < FORMS.near)
    first = np.angle(roots[own, column])
    missing = gamma[own] - np.einsum("kij,kj->ki", alpha[own], np.column_stack([np.cos(first), np.sin(first)]))
    cosine = np.clip(missing[:, 0] / size[own, 0], -1.0, 1.0)
    sine = np.sqrt(1 - cosine**2)
    found = []
    for side in (sine, -sine):
        unit = np.einsum("kji,kj->ki", right[own], np.column_stack([cosine, side]))
        off = np.abs(missing - size[own] * np.column_stack([cosine, side])).max(axis=1)
        good = off < FORMS.near * np.maximum(size[own, 0], 1e-12) ** 0.5
        found.append((own[good], first[good], np.arctan2(unit[good, 1], unit[good, 0])))
    owns, firsts, seconds = (np.concatenate(part) for part in zip(*found, strict=True))
    return owns, firsts, seconds


def _roots(rows: Array) -> Array:
    """Roots (M, d) of polynomials, highest powers first, (M, d + 1); nan of those that are all zero."""
    degree, size = rows.shape[1] - 1, np.abs(rows).max(axis=1)
    good = size > 0
    lead = rows[:, 0] + np.where(np.abs(rows[:, 0]) < 1e-14 * size, 1e-14 * size, 0.0)
    companion = np.zeros((len(rows), degree, degree), dtype=complex)
    companion[:, 1:, :-1] = np.eye(degree - 1)
    companion[good, 0] = -rows[good, 1:] / lead[good, None]
    roots = np.linalg.eigvals(companion)
    roots[~good] = np.nan
    return np.asarray(roots)


def _meeting(*axes: Axis) -> Array:
    """The points where lines meet. Shape (M, 3)."""
    across = [np.eye(3) - axis.way[:, :, None] * axis.way[:, None, :] for axis in axes]
    pulled = sum(np.einsum("mij,mj->mi", part, axis.point) for part, axis in zip(across, axes, strict=True))
    return np.asarray(np.linalg.solve(sum(across), np.asarray(pulled)[:, :, None])[:, :, 0])


def _both(middle: Array, half: Array) -> tuple[NDArray[np.intp], Array]:
    """middle + half and middle - half."""
    rows = np.arange(len(middle))
    return np.concatenate([rows, rows]), np.concatenate([middle + half, middle - half])


def _wrist(axes: list[Axis], wanted: Motion) -> tuple[NDArray[np.intp], Array]:
    """Angles of a, b, c that meet, so that they turn as wanted: two each, the nearest where there are none."""
    a, b, c = axes
    constant, cosine, sine = _turned(a.way, b.way, c.way)
    value = np.einsum("mi,mij,mj->m", a.way, wanted.turn, c.way) - constant
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.clip(np.nan_to_num(value / np.hypot(cosine, sine)), -1.0, 1.0)
    own, second = _both(np.arctan2(sine, cosine), np.arccos(share))
    return own, _ends([axis.take(own) for axis in axes], wanted.take(own), second, None)


def _planar(axes: list[Axis], wanted: Motion) -> tuple[NDArray[np.intp], Array]:
    """Angles of a, b, c that are parallel, so that they move as wanted: two each, the nearest where there are none."""
    a, b, c = axes
    along = a.way
    place = wanted.at(c.point)
    arm, reach = b.point - a.point, c.point - b.point
    far = place - a.point
    parts = [part - _dot(part, along)[:, None] * along for part in (far, arm, reach)]
    value = (_dot(parts[0], parts[0]) - _dot(parts[1], parts[1]) - _dot(parts[2], parts[2])) / 2
    cosine, sine = _dot(parts[1], parts[2]), _dot(parts[1], np.cross(b.way, parts[2]))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.clip(np.nan_to_num(value / np.hypot(cosine, sine)), -1.0, 1.0)
    own, second = _both(np.arctan2(sine, cosine), np.arccos(share))
    return own, _ends([axis.take(own) for axis in axes], wanted.take(own), second, place[own])


def _ends(axes: list[Axis], wanted: Motion, second: Array, place: Array | None) -> Array:
    """The angles of a, b, c, that of b known: a from where it turns c, or the point of it, c from what is left."""
    a, b, c = axes
    motion = b.by(second)
    if place is None:
        start, end = (np.einsum("mij,mj->mi", part.turn, c.way) for part in (motion, wanted))
    else:
        start, end = motion.at(c.point) - a.point, place - a.point
    first = a.angle(start, end)
    rest = a.by(first).after(motion).back.after(wanted).turn
    turned = np.stack([rest[:, 2, 1] - rest[:, 1, 2], rest[:, 0, 2] - rest[:, 2, 0], rest[:, 1, 0] - rest[:, 0, 1]], 1)
    third = np.arctan2(_dot(c.way, turned) / 2, (np.trace(rest, axis1=1, axis2=2) - 1) / 2)
    return np.column_stack([first, second, third])


def _corrected(
    axes: list[Axis],
    goal: Motion,
    own: NDArray[np.intp],
    found: Array,
    turns: NDArray[np.bool_],
    tip: Array,
    size: float,
) -> tuple[NDArray[np.intp], Array]:
    """Angles that put the tip (M, 3) where it is to be, by Newton's method from rough ones; each once."""
    found, good = found.copy(), np.zeros(len(own), dtype=bool)
    busy = np.arange(len(own))
    for _ in range(FORMS.steps):
        if not busy.size:
            break
        at = own[busy]
        moved, columns = Motion(np.broadcast_to(np.eye(3), (len(at), 3, 3)), np.zeros((len(at), 3))), []
        for k, axis in enumerate(axes):
            line = axis.take(at)
            now = line.moved(moved)
            if turns[k]:
                columns.append(np.concatenate([now.way, np.cross(now.way, tip[at] - now.point) / size], axis=1))
            else:
                columns.append(np.concatenate([np.zeros_like(now.way), now.way / size], axis=1))
            moved = moved.after(line.by(found[busy, k], bool(turns[k])))
        left = goal.take(at).after(moved.back)
        turn = left.turn
        spin = np.stack(
            [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1
        )
        missed = np.concatenate([spin / 2, (tip[at] - left.back.at(tip[at])) / size], axis=1)
        over = np.trace(turn, axis1=1, axis2=2) < 1  # turned by a right angle or more
        worst = np.abs(missed).max(axis=1)
        good[busy[(worst < FORMS.exact) & ~over]] = True
        on = (worst >= FORMS.exact) & ~over & (worst < FORMS.rough)
        step = np.einsum("kij,kj->ki", np.linalg.pinv(np.stack(columns, axis=2)[on], rcond=1e-8), missed[on])
        busy = busy[on]
        found[busy] += np.clip(step, -1.0, 1.0)
    own, found = own[good], found[good]
    found[:, turns] -= TURN * np.round(found[:, turns] / TURN)
    order = np.argsort(own, kind="stable")
    own, found = own[order], found[order]
    twice = np.zeros(len(own), dtype=bool)
    for apart in range(1, 2 * POSTURES):
        way = found[apart:] - found[:-apart]
        way[:, turns] -= TURN * np.round(way[:, turns] / TURN)
        twice[apart:] |= (own[apart:] == own[:-apart]) & (np.abs(way) < FORMS.same).all(axis=1)
    return own[~twice], found[~twice]
