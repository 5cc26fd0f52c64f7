"""All IK solutions of an arm at a pose, in closed form if its geometry has one.

Six revolute joints have a closed form if the axes of three consecutive joints meet in a point or are parallel (Pieper
1968): arms with spherical wrists or shoulders and arms with three parallel axes. The joint motions multiply to the
motion of the tip from its home, e_1 .. e_6 = G. Inverted and conjugated by G the product keeps its form, so the three
joints can be taken as the last ones, a, b, c, and the others as x, y, z. The invariant of the three, a point, or a
direction and the distance along it, gives two equations that are linear in the cosines and sines of the angles of x and
z: a polynomial of degree four with at most four pairs. The angle of y follows, and a, b, c have two solutions each: at
most eight in all (subproblems like those of Elias and Wen 2022, IK-Geo). For four joints along one direction, three
revolute and one prismatic (SCARA), the last step alone remains. Further joints are redundant: their positions are
given.
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

SIX, SCARA, MAX_JOINTS = 6, 4, 8
"""Numbers of joints of the arms with closed forms, and the largest number including redundant joints."""
MAX_SOLUTIONS = 8
"""Of six revolute joints at one pose."""
TURN = 2 * np.pi


@dataclass(frozen=True)
class FormSettings:
    """Tolerances of the closed forms; lengths are shares of the size of the arm.

    Attributes:
        straight: Up to this much, also in rad, axes count as meeting or parallel; Newton's method refines.
        near: Residual up to which rough solutions are refined: near a double solution they are that inaccurate.
        steps: Largest number of Newton steps.
        exact: Largest final pose error, also in rad.
        rough: Pose error above which a solution is dropped, also in rad.
        same: Distance below which two solutions count as one, rad.
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
        """Return the motions at these indices."""
        return Motion(self.turn[chosen], self.shift[chosen])

    def after(self, first: Motion) -> Motion:
        """Return the composition with a motion that is applied first."""
        return Motion(self.turn @ first.turn, self.at(first.shift))

    def at(self, points: Array) -> Array:
        """Return the images of points (M, 3)."""
        return np.asarray(np.einsum("mij,mj->mi", self.turn, points) + self.shift)

    @property
    def inverse(self) -> Motion:
        """The inverse motions."""
        turn = self.turn.transpose(0, 2, 1)
        return Motion(turn, -np.einsum("mij,mj->mi", turn, self.shift))


class Axis(NamedTuple):
    """Axes of joints: unit directions (M, 3) and points (M, 3)."""

    direction: Array
    point: Array

    def take(self, chosen: NDArray[np.intp]) -> Axis:
        """Return the axes at these indices."""
        return Axis(self.direction[chosen], self.point[chosen])

    def moved(self, motion: Motion) -> Axis:
        """Return the axes moved by a motion."""
        return Axis(np.einsum("mij,mj->mi", motion.turn, self.direction), motion.at(self.point))

    def by(self, angle: Array, turns: bool = True) -> Motion:
        """Return the motions of revolute or prismatic joints about these axes."""
        if not turns:
            return Motion(np.broadcast_to(np.eye(3), (len(angle), 3, 3)), self.direction * angle[:, None])
        cross = np.cross(np.eye(3)[None], self.direction[:, None])
        sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
        turn = np.eye(3) + sine * cross + (1 - cosine) * cross @ cross
        return Motion(turn, self.point - np.einsum("mij,mj->mi", turn, self.point))

    def angle(self, start: Array, end: Array) -> Array:
        """Return the angles by which joints rotate vectors (M, 3) towards others, as seen along the axes."""
        across = start - _dot(start, self.direction)[:, None] * self.direction
        return np.arctan2(_dot(self.direction, np.cross(across, end)), _dot(across, end))


@dataclass(frozen=True, eq=False)
class ClosedForm:
    """Closed form of the inverse kinematics of an arm.

    Attributes:
        kind: "meeting" or "parallel", by the axes of three of its joints, or "scara".
        triple: Numbers of these joints.
        redundant: Numbers of the joints whose positions have to be given.
        axes, points: Axes of all joints at the zero configuration, in the world. Shapes (n, 3), m.
        turns: Which joints are revolute; the others are prismatic. Shape (n,), bool.
        place, rotation: Pose of the tip at the zero configuration, in the world. Shapes (3,), (3, 3).
        order: Numbers of the joints from the base to the tip.
        size: Largest distance of the axes from the tip, m.
    """

    kind: str
    triple: tuple[int, ...]
    redundant: tuple[int, ...]
    axes: Array
    points: Array
    turns: NDArray[np.bool_]
    place: Array
    rotation: Array
    order: tuple[int, ...]
    size: float

    def solutions(self, places: Array, rotations: Array, redundant: Array) -> tuple[NDArray[np.intp], Array]:
        """Return all isolated solutions at M poses.

        Args:
            places, rotations: Poses of the tip in the world. Shapes (M, 3), (M, 3, 3).
            redundant: Positions of the redundant joints. Shape (M, len(self.redundant)).

        Returns:
            Pose of each solution, shape (K,), and joint positions, angles between -pi and pi, (K, n); joints that do
                not move the tip are at 0.
        """
        count, n = len(places), len(self.axes)
        joints = np.zeros((count, n))
        joints[:, list(self.redundant)] = redundant
        moved = Motion(np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 3)))
        axes = list[Axis]()
        for j in self.order:
            axis = Axis(np.broadcast_to(self.axes[j], (count, 3)), np.broadcast_to(self.points[j], (count, 3)))
            axis = axis.moved(moved)
            if j in self.redundant:
                moved = axis.by(joints[:, j], bool(self.turns[j])).after(moved)
            else:
                axes.append(axis)
        home = moved.after(Motion(np.broadcast_to(self.rotation, (count, 3, 3)), np.tile(self.place, (count, 1))))
        goal = Motion(rotations, places).after(home.inverse)
        free = [j for j in self.order if j not in self.redundant]
        if self.kind == "scara":
            seats = [free.index(j) for j in (*self.triple, *(j for j in free if j not in self.triple))]
            pose, angles = _solve_planar([axes[i] for i in seats[:3]], goal)
            slide = _dot(axes[seats[3]].direction, goal.at(axes[seats[0]].point) - axes[seats[0]].point)
            solutions = np.column_stack([angles, slide[pose]])
        else:
            first = free.index(self.triple[0])
            # joints behind the triple move to the front, conjugated by the goal
            seats = [(first + 3 + i) % SIX for i in range(SIX)]
            pose, solutions = _solve_six(
                [axes[i].moved(goal.inverse) if i < first + 3 else axes[i] for i in seats], goal, self
            )
        angles = np.empty_like(solutions)
        angles[:, seats] = solutions
        pose, angles = _refine(axes, goal, pose, angles, self.turns[free], places, self.size)
        joints = joints[pose]
        joints[:, free] = angles
        return pose, joints


def closed_forms(machine: Machine) -> tuple[ClosedForm, ...]:
    """Return the closed forms of a machine's arm; none if its geometry has none or its base moves.

    An arm of more than six joints has one for each choice of redundant joints that leaves one. Joints that do not move
    the tip do not matter.
    """
    robot = machine.robot
    path = () if robot.tip is None else [joint for joint in robot.path_to(robot.tip_link) if joint.moves]
    n = len(path)
    if machine.base_size or n > MAX_JOINTS or any(joint.mimic is not None for joint in path):
        return ()
    order = tuple(robot.joint_names.index(joint.name) for joint in path)
    arm = _Arm.build(machine, order)
    return _scara_forms(arm) if n == SCARA else _six_joint_forms(arm)


def _scara_forms(arm: _Arm) -> tuple[ClosedForm, ...]:
    """Return the closed form of four joints, if they are those of a SCARA."""
    revolute, prismatic = tuple(j for j in arm.order if arm.turns[j]), [j for j in arm.order if not arm.turns[j]]
    if len(prismatic) != 1 or arm.kind_of(revolute) != "parallel":
        return ()
    sine = float(np.linalg.norm(np.cross(arm.axes[prismatic[0]], arm.axes[revolute[0]])))
    return (arm.form("scara", revolute, ()),) if sine < FORMS.straight else ()


def _six_joint_forms(arm: _Arm) -> tuple[ClosedForm, ...]:
    """Return the closed forms of six revolute joints, one for each choice of redundant joints."""
    n, forms = len(arm.order), list[ClosedForm]()
    for redundant in combinations(arm.order, n - SIX) if n >= SIX else ():
        if not arm.turns[[j for j in arm.order if j not in redundant]].all():
            continue
        triples = [arm.order[i : i + 3] for i in range(n - 2)]
        kinds = [(arm.kind_of(triple), triple) for triple in triples if not set(triple) & set(redundant)]
        forms += [arm.form(kind, triple, redundant) for kind, triple in sorted(kinds) if kind][:1]
    return tuple(forms)


class _Arm(NamedTuple):
    """Axes and tip of an arm at the zero configuration, see ClosedForm."""

    axes: Array
    points: Array
    turns: NDArray[np.bool_]
    place: Array
    rotation: Array
    order: tuple[int, ...]
    size: float

    @classmethod
    def build(cls, machine: Machine, order: tuple[int, ...]) -> _Arm:
        """Return the arm of a machine at the zero configuration."""
        zero = ca.DM(machine.joint_size, 1)
        pose, jacobian = machine.tip_pose((), zero), np.array(ca.DM(machine.tip_jacobian((), zero)))
        tip, rotation = np.array(ca.DM(pose.position)).ravel(), np.array(ca.DM(pose.rotation))
        angular, linear = jacobian[:3].T, jacobian[3:].T
        turns = np.linalg.norm(angular, axis=1) > 0.5  # it is one or zero
        axes = np.where(turns[:, None], angular, linear)
        points = np.where(turns[:, None], tip + np.cross(angular, linear), tip)
        size = max(float(np.linalg.norm(points - tip, axis=1).max()), 1e-3)
        return cls(axes, points, turns, tip, rotation, order, size)

    def form(self, kind: str, triple: tuple[int, ...], redundant: tuple[int, ...]) -> ClosedForm:
        """Return the closed form by a triple of axes."""
        return ClosedForm(kind, triple, redundant, *self)

    def kind_of(self, triple: tuple[int, ...]) -> str:
        """Return how three consecutive axes lie: "parallel", "meeting", or "" for neither."""
        axes, points = self.axes, self.points
        if not self.turns[list(triple)].all():
            return ""
        sines = [float(np.linalg.norm(np.cross(axes[i], axes[j]))) for i, j in pairwise(triple)]
        if max(sines) < FORMS.straight:
            offsets = [points[j] - points[i] for i, j in pairwise(triple)]
            offsets = [offset - offset @ axes[triple[0]] * axes[triple[0]] for offset in offsets]
            return "parallel" if min(map(np.linalg.norm, offsets)) > FORMS.straight * self.size else ""
        projectors = np.eye(3) - axes[list(triple), :, None] * axes[list(triple), None, :]
        projected = np.einsum("kij,kj->ki", projectors, points[list(triple)])
        point = np.linalg.lstsq(projectors.sum(axis=0), projected.sum(axis=0), rcond=FORMS.straight)[0]
        distance = np.linalg.norm(np.einsum("kij,j->ki", projectors, point) - projected, axis=1).max()
        return "meeting" if min(sines) > FORMS.straight and distance < FORMS.straight * self.size else ""


def _dot(a: Array, b: Array) -> Array:
    """Return the scalar products of vectors."""
    return np.asarray((a * b).sum(axis=-1))


def _rotation_terms(fixed: Array, axis: Array, vector: Array) -> tuple[Array, Array, Array]:
    """Return fixed . R(axis, angle) vector as constant, cosine part and sine part, of M vectors each."""
    constant = _dot(fixed, axis) * _dot(axis, vector)
    return constant, _dot(fixed, vector) - constant, _dot(fixed, np.cross(axis, vector))


def _solve_six(axes: list[Axis], goal: Motion, form: ClosedForm) -> tuple[NDArray[np.intp], Array]:
    """Return rough angles with e_x e_y e_z e_a e_b e_c = goal, where a, b, c meet or are parallel; some do not hold."""
    (x, y, z, a, b, c), kind, size = axes, form.kind, form.size
    offsets = (x.point - y.point) / size, (z.point - y.point) / size
    if kind == "meeting":
        point = _meeting_points(a, b, c)
        end, start = (goal.at(point) - x.point) / size, (point - z.point) / size
        # e_z p and e_x^-1 G p have the same distance from the axis of y and the same height along it
        left = [_rotation_terms(2 * offsets[0], -x.direction, end), _rotation_terms(y.direction, -x.direction, end)]
        right = [_rotation_terms(2 * offsets[1], z.direction, start), _rotation_terms(y.direction, z.direction, start)]
        sides = [
            _dot(offsets[1], offsets[1]) + _dot(start, start) - _dot(offsets[0], offsets[0]) - _dot(end, end),
            _dot(y.direction, offsets[1] - offsets[0]),
        ]
    else:
        direction, point = a.direction, a.point
        ahead, end = np.einsum("mij,mj->mi", goal.turn, direction), (goal.at(point) - x.point) / size
        # the direction of the triple, and the distance of a point along it, before and after the motion
        left = [_rotation_terms(y.direction, -x.direction, ahead), _rotation_terms(offsets[0], -x.direction, ahead)]
        right = [
            _rotation_terms(y.direction, z.direction, direction),
            _rotation_terms(offsets[1], z.direction, direction),
        ]
        sides = [np.zeros(len(direction)), _dot(direction, point - z.point) / size - _dot(ahead, end)]
    a_, b_ = (np.stack([np.stack(part[1:], axis=1) for part in side], axis=1) for side in (left, right))
    c_ = np.stack([r + part[0] - other[0] for r, part, other in zip(sides, right, left, strict=True)], axis=1)
    pose, first, third = _angle_pairs(a_, -b_, c_)
    x, y, z, a, b, c = (axis.take(pose) for axis in (x, y, z, a, b, c))
    goal = goal.take(pose)
    if kind == "meeting":
        start, end = z.by(third).at(point[pose]) - y.point, x.by(first).inverse.at(goal.at(point[pose])) - y.point
    else:
        start = np.einsum("mij,mj->mi", z.by(third).turn, direction[pose])
        end = np.einsum("mji,mj->mi", x.by(first).turn, ahead[pose])
    second = y.angle(start, end)
    remaining = x.by(first).after(y.by(second)).after(z.by(third)).inverse.after(goal)
    which, last = (_solve_wrist if kind == "meeting" else _solve_planar)([a, b, c], remaining)
    return pose[which], np.column_stack([first[which], second[which], third[which], last])


def _angle_pairs(a: Array, b: Array, c: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """Return angles with a [cos, sin](first) + b [cos, sin](second) = c. Shapes (M, 2, 2), (M, 2, 2), (M, 2)."""
    left, size, right = np.linalg.svd(b)
    size = size + 1e-300
    singular = size[:, 1] < FORMS.straight * size[:, 0]
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
    roots = _polynomial_roots(square)
    # an equation without the second angle has two solutions by itself
    roots_alone = _polynomial_roots(rows[:, 1])
    roots[singular] = np.concatenate([roots_alone, np.full_like(roots_alone, np.nan)], axis=1)[singular]
    with np.errstate(divide="ignore", invalid="ignore"):
        pose, column = np.nonzero(np.abs(np.log(np.abs(roots))) < FORMS.near)
    first = np.angle(roots[pose, column])
    remaining = gamma[pose] - np.einsum("kij,kj->ki", alpha[pose], np.column_stack([np.cos(first), np.sin(first)]))
    cosine = np.clip(remaining[:, 0] / size[pose, 0], -1.0, 1.0)
    sine = np.sqrt(1 - cosine**2)
    pairs = []
    for signed_sine in (sine, -sine):
        unit = np.einsum("kji,kj->ki", right[pose], np.column_stack([cosine, signed_sine]))
        residual = np.abs(remaining - size[pose] * np.column_stack([cosine, signed_sine])).max(axis=1)
        good = residual < FORMS.near * np.maximum(size[pose, 0], 1e-12) ** 0.5
        pairs.append((pose[good], first[good], np.arctan2(unit[good, 1], unit[good, 0])))
    poses, firsts, seconds = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return poses, firsts, seconds


def _polynomial_roots(rows: Array) -> Array:
    """Return the roots (M, d) of polynomials (M, d + 1), highest powers first; nan for those that are zero."""
    degree, size = rows.shape[1] - 1, np.abs(rows).max(axis=1)
    good = size > 0
    lead = rows[:, 0] + np.where(np.abs(rows[:, 0]) < 1e-14 * size, 1e-14 * size, 0.0)
    companion = np.zeros((len(rows), degree, degree), dtype=complex)
    companion[:, 1:, :-1] = np.eye(degree - 1)
    companion[good, 0] = -rows[good, 1:] / lead[good, None]
    roots = np.linalg.eigvals(companion)
    roots[~good] = np.nan
    return np.asarray(roots)


def _meeting_points(*axes: Axis) -> Array:
    """Return the points where axes meet. Shape (M, 3)."""
    projectors = [np.eye(3) - axis.direction[:, :, None] * axis.direction[:, None, :] for axis in axes]
    projected = sum(np.einsum("mij,mj->mi", part, axis.point) for part, axis in zip(projectors, axes, strict=True))
    return np.asarray(np.linalg.solve(sum(projectors), np.asarray(projected)[:, :, None])[:, :, 0])


def _middle_angles(value: Array, cosine: Array, sine: Array) -> tuple[NDArray[np.intp], Array]:
    """Return indices and both angles with cosine cos + sine sin = value, the nearest where there are none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.clip(np.nan_to_num(value / np.hypot(cosine, sine)), -1.0, 1.0)
    middle, half, rows = np.arctan2(sine, cosine), np.arccos(share), np.arange(len(value))
    return np.concatenate([rows, rows]), np.concatenate([middle + half, middle - half])


def _axial(turn: Array) -> Array:
    """Return the axial vectors of rotations, 2 sin(angle) times their axes. Shapes (M, 3, 3) to (M, 3)."""
    return np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1)


def _solve_wrist(axes: list[Axis], goal: Motion) -> tuple[NDArray[np.intp], Array]:
    """Return two solutions of meeting axes a, b, c for a rotation, the nearest if there are none."""
    a, b, c = axes
    constant, cosine, sine = _rotation_terms(a.direction, b.direction, c.direction)
    value = np.einsum("mi,mij,mj->m", a.direction, goal.turn, c.direction) - constant
    pose, second = _middle_angles(value, cosine, sine)
    return pose, _outer_angles([axis.take(pose) for axis in axes], goal.take(pose), second, None)


def _solve_planar(axes: list[Axis], goal: Motion) -> tuple[NDArray[np.intp], Array]:
    """Return two solutions of parallel axes a, b, c for a planar motion, the nearest if there are none."""
    a, b, c = axes
    along = a.direction
    goal_point = goal.at(c.point)
    arm, reach = b.point - a.point, c.point - b.point
    to_goal = goal_point - a.point
    parts = [part - _dot(part, along)[:, None] * along for part in (to_goal, arm, reach)]
    value = (_dot(parts[0], parts[0]) - _dot(parts[1], parts[1]) - _dot(parts[2], parts[2])) / 2
    cosine, sine = _dot(parts[1], parts[2]), _dot(parts[1], np.cross(b.direction, parts[2]))
    pose, second = _middle_angles(value, cosine, sine)
    return pose, _outer_angles([axis.take(pose) for axis in axes], goal.take(pose), second, goal_point[pose])


def _outer_angles(axes: list[Axis], goal: Motion, second: Array, goal_point: Array | None) -> Array:
    """Return the angles of a, b, c for a known angle of b: a from the image of c or its point, c from the rest."""
    a, b, c = axes
    motion = b.by(second)
    if goal_point is None:
        start, end = (np.einsum("mij,mj->mi", part.turn, c.direction) for part in (motion, goal))
    else:
        start, end = motion.at(c.point) - a.point, goal_point - a.point
    first = a.angle(start, end)
    remaining = a.by(first).after(motion).inverse.after(goal).turn
    third = np.arctan2(_dot(c.direction, _axial(remaining)) / 2, (np.trace(remaining, axis1=1, axis2=2) - 1) / 2)
    return np.column_stack([first, second, third])


def _refine(
    axes: list[Axis],
    goal: Motion,
    pose: NDArray[np.intp],
    angles: Array,
    turns: NDArray[np.bool_],
    tip: Array,
    size: float,
) -> tuple[NDArray[np.intp], Array]:
    """Refine rough angles by Newton's method until the tip (M, 3) is at its goal; return each solution once."""
    angles, good = angles.copy(), np.zeros(len(pose), dtype=bool)
    active = np.arange(len(pose))
    for _ in range(FORMS.steps):
        if not active.size:
            break
        at = pose[active]
        before, columns = Motion(np.broadcast_to(np.eye(3), (len(at), 3, 3)), np.zeros((len(at), 3))), []
        for k, axis in enumerate(axes):
            line = axis.take(at)
            now = line.moved(before)
            if turns[k]:
                columns.append(
                    np.concatenate([now.direction, np.cross(now.direction, tip[at] - now.point) / size], axis=1)
                )
            else:
                columns.append(np.concatenate([np.zeros_like(now.direction), now.direction / size], axis=1))
            before = before.after(line.by(angles[active, k], bool(turns[k])))
        error = goal.take(at).after(before.inverse)
        rotation = error.turn
        missed = np.concatenate([_axial(rotation) / 2, (tip[at] - error.inverse.at(tip[at])) / size], axis=1)
        beyond = np.trace(rotation, axis1=1, axis2=2) < 1
        worst = np.abs(missed).max(axis=1)
        good[active[(worst < FORMS.exact) & ~beyond]] = True
        on = (worst >= FORMS.exact) & ~beyond & (worst < FORMS.rough)
        step = np.einsum("kij,kj->ki", np.linalg.pinv(np.stack(columns, axis=2)[on], rcond=1e-8), missed[on])
        active = active[on]
        angles[active] += np.clip(step, -1.0, 1.0)
    pose, angles = pose[good], angles[good]
    angles[:, turns] -= TURN * np.round(angles[:, turns] / TURN)
    order = np.argsort(pose, kind="stable")
    pose, angles = pose[order], angles[order]
    repeated = np.zeros(len(pose), dtype=bool)
    for offset in range(1, 2 * MAX_SOLUTIONS):
        difference = angles[offset:] - angles[:-offset]
        difference[:, turns] -= TURN * np.round(difference[:, turns] / TURN)
        repeated[offset:] |= (pose[offset:] == pose[:-offset]) & (np.abs(difference) < FORMS.same).all(axis=1)
    return pose[~repeated], angles[~repeated]
