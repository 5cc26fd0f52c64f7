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

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from models.checks import Array
from ocp.motion.local.chain import Axis, Chain, Motion, Solutions, axial, cross, dot, pick
from ocp.motion.local.pose_solver import Mask, PoseSolver

__all__ = ["ClosedForm", "closed_forms", "is_scara"]

TINY = 1e-300
"""Added to lengths that divide, so that zeros give no exception."""
SIX, SCARA = 6, 4
"""Numbers of joints of the arms with closed forms, without redundant joints."""


@dataclass(frozen=True)
class FormSettings:
    """Tolerances of the closed forms; lengths are shares of the size of the arm.

    Attributes:
        straight: Up to this much, also in rad, axes count as meeting or parallel; Newton's method refines.
        near: Residual up to which rough solutions are refined: near a double solution they are that inaccurate.
        vanishing: Size of the coefficients of an equation below which each angle solves it.
    """

    straight: float = 1e-8
    near: float = 1e-3
    vanishing: float = 1e-8


FORMS = FormSettings()


@dataclass(frozen=True, eq=False)
class ClosedForm(PoseSolver):
    """Closed form of the inverse kinematics of an arm.

    Attributes:
        kind: "meeting" or "parallel", by the axes of three of its joints, or "scara".
        triple: Numbers of these joints.
    """

    kind: str
    triple: tuple[int, ...]

    def solve_regular(self, tips: Motion, redundant: Array) -> tuple[Solutions, Mask, Mask]:
        """Return solutions; where they belong to families, some may be missing. See `PoseSolver.solve_regular`."""
        prescribed = self.prescribe(redundant)
        axes, goal = self.loop(prescribed, tips)
        free, families = self.free, np.zeros(len(tips.shift), dtype=bool)
        if self.kind == "scara":
            seats = [free.index(j) for j in (*self.triple, *(j for j in free if j not in self.triple))]
            pose, angles = _solve_planar([axes[i] for i in seats[:3]], goal)
            slide = dot(axes[seats[3]].direction, goal.at(axes[seats[0]].point) - axes[seats[0]].point)
            solutions = np.column_stack([angles, slide[pose]])
        else:
            first, back = free.index(self.triple[0]), goal.inverse
            # joints behind the triple move to the front, conjugated by the goal
            seats = [(first + 3 + i) % SIX for i in range(SIX)]
            loop = [axes[i].moved(back) if i < first + 3 else axes[i] for i in seats]
            pose, solutions, families = _solve_six(loop, goal, self)
        positions = np.empty_like(solutions)
        positions[:, seats] = solutions
        return self.refine(pose, positions, prescribed, tips), np.zeros_like(families), families


def closed_forms(chain: Chain, lockable: Sequence[int] | None = None) -> tuple[ClosedForm, ...]:
    """Return the closed forms of a chain: one for each choice of redundant joints that leaves one.

    Args:
        chain: The chain.
        lockable: Numbers of the joints that may be redundant; None: all.
    """
    if len(chain.order) == SCARA:
        return _scara_forms(chain)
    return _six_joint_forms(chain, chain.order if lockable is None else tuple(lockable))


def _scara_forms(chain: Chain) -> tuple[ClosedForm, ...]:
    """Return the closed form of four joints, if they are those of a SCARA."""
    revolute = tuple(j for j in chain.order if chain.revolute[j])
    prismatic = [j for j in chain.order if not chain.revolute[j]]
    if len(prismatic) != 1 or _kind_of(chain, revolute) != "parallel":
        return ()
    sine = float(np.linalg.norm(np.cross(chain.axes[prismatic[0]], chain.axes[revolute[0]])))
    return (ClosedForm(chain, (), "scara", revolute),) if sine < FORMS.straight else ()


def is_scara(chain: Chain) -> bool:
    """Return whether a chain has the four joints of a SCARA."""
    return len(chain.order) == SCARA and bool(_scara_forms(chain))


def _six_joint_forms(chain: Chain, lockable: tuple[int, ...]) -> tuple[ClosedForm, ...]:
    """Return the closed forms of six revolute joints, one for each choice of redundant joints."""
    n, forms = len(chain.order), list[ClosedForm]()
    for redundant in combinations(lockable, n - SIX) if n >= SIX else ():
        if not chain.revolute[[j for j in chain.order if j not in redundant]].all():
            continue
        triples = [chain.order[i : i + 3] for i in range(n - 2)]
        kinds = [(_kind_of(chain, triple), triple) for triple in triples if not set(triple) & set(redundant)]
        forms += [ClosedForm(chain, redundant, kind, triple) for kind, triple in sorted(kinds) if kind][:1]
    return tuple(forms)


def _kind_of(chain: Chain, triple: tuple[int, ...]) -> str:
    """Return how three consecutive axes lie: "parallel", "meeting", or "" for neither."""
    axes, points = chain.axes, chain.points
    if not chain.revolute[list(triple)].all():
        return ""
    sines = [float(np.linalg.norm(np.cross(axes[i], axes[j]))) for i, j in pairwise(triple)]
    if max(sines) < FORMS.straight:
        offsets = [points[j] - points[i] for i, j in pairwise(triple)]
        offsets = [offset - offset @ axes[triple[0]] * axes[triple[0]] for offset in offsets]
        return "parallel" if min(map(np.linalg.norm, offsets)) > FORMS.straight * chain.size else ""
    projectors = np.eye(3) - axes[list(triple), :, None] * axes[list(triple), None, :]
    projected = np.einsum("kij,kj->ki", projectors, points[list(triple)])
    point = np.linalg.lstsq(projectors.sum(axis=0), projected.sum(axis=0), rcond=FORMS.straight)[0]
    distance = np.linalg.norm(np.einsum("kij,j->ki", projectors, point) - projected, axis=1).max()
    return "meeting" if min(sines) > FORMS.straight and distance < FORMS.straight * chain.size else ""


def _rotation_terms(fixed: Array, axis: Array, vector: Array) -> tuple[Array, Array]:
    """Return fixed . R(axis, angle) vector as constants (...), and cosine and sine parts, (..., 2)."""
    constant = dot(fixed, axis) * dot(axis, vector)
    return constant, np.stack([dot(fixed, vector) - constant, dot(fixed, cross(axis, vector))], axis=-1)


def _stack(count: int, *parts: Array) -> Array:
    """Return vectors, (M, 3) or (1, 3) each, as one array (k, M, 3)."""
    stacked = np.empty((len(parts), count, 3))
    for k, part in enumerate(parts):
        stacked[k] = part
    return stacked


def _solve_six(axes: list[Axis], goal: Motion, form: ClosedForm) -> tuple[NDArray[np.intp], Array, Mask]:
    """Return rough angles with e_x e_y e_z e_a e_b e_c = goal, where a, b, c meet or are parallel; some do not hold.

    The third result says which poses have families of solutions.
    """
    (x, y, z, a, b, c), kind, size = axes, form.kind, form.chain.size
    first_offset, second_offset = (x.point - y.point) / size, (z.point - y.point) / size
    count = len(goal.shift)
    fixed = _stack(count, y.direction, y.direction, first_offset, second_offset)
    directions = _stack(count, -x.direction, z.direction, -x.direction, z.direction)
    sides = np.zeros((2, count))
    if kind == "meeting":
        point = _meeting_points(a, b, c)
        end, start = (goal.at(point) - x.point) / size, (point - z.point) / size
        # e_z p and e_x^-1 G p have the same height along the axis of y and the same distance from it
        vectors = _stack(count, end, start, 2 * end, 2 * start)
        sides[0] = dot(y.direction, second_offset - first_offset)
        sides[1] = dot(second_offset, second_offset) + dot(start, start)
        sides[1] -= dot(first_offset, first_offset) + dot(end, end)
    else:
        direction, point = a.direction, a.point
        ahead, end = goal.rotate(direction), (goal.at(point) - x.point) / size
        # the direction of the triple, and the distance of a point along it, before and after the motion
        vectors = _stack(count, ahead, direction, ahead, direction)
        sides[1] = dot(direction, point - z.point) / size - dot(ahead, end)
    constants, parts = _rotation_terms(fixed, directions, vectors)
    sides += constants[1::2] - constants[::2]
    a_, b_ = parts[::2].transpose(1, 0, 2), -parts[1::2].transpose(1, 0, 2)
    c_ = sides.T
    pose, first, third, families = _angle_pairs(a_, b_, c_)
    x, y, z, a, b, c = (axis.take(pose) for axis in (x, y, z, a, b, c))
    goal = goal.take(pose)
    before, after = z.by(third), x.by(first).inverse.after(goal)
    if kind == "meeting":
        start, end = before.at(pick(point, pose)) - y.point, after.at(pick(point, pose)) - y.point
    else:
        start, end = before.rotate(pick(direction, pose)), after.rotate(pick(direction, pose))
    second = y.angle(start, end)
    on_axis = np.abs(cross(y.direction, start)).max(axis=1) < FORMS.vanishing * (size if kind == "meeting" else 1.0)
    families[pose[on_axis]] = True  # y may have any angle
    remaining = y.by(second).after(before).inverse.after(after)
    which, last = (_solve_wrist if kind == "meeting" else _solve_planar)([a, b, c], remaining)
    outer = np.stack([first, second, third], axis=1)[which]
    return pose[which], np.concatenate([outer, last], axis=1), families


def _angle_pairs(a: Array, b: Array, c: Array) -> tuple[NDArray[np.intp], Array, Array, Mask]:
    """Return angles with a [cos, sin](first) + b [cos, sin](second) = c. Shapes (M, 2, 2), (M, 2, 2), (M, 2).

    The last result says for which of the M equations an angle is not determined.
    """
    left, size, right = np.linalg.svd(b)
    size = size + TINY
    singular = size[:, 1] <= FORMS.straight * size[:, 0]
    alpha, gamma = left.transpose(0, 2, 1) @ a, (c[:, None] @ left)[:, 0]
    # w(z) = gamma - delta z - conj(delta) / z with z = exp(i first), and (w_1 / s_1)^2 + (w_2 / s_2)^2 = 1
    delta = (alpha[:, :, 0] - 1j * alpha[:, :, 1]) / 2
    high, middle = (size[:, ::-1] / size[:, :1] * part for part in (delta, gamma))
    square = np.empty((len(a), 5), dtype=complex)
    square[:, 0], square[:, 1] = (high**2).sum(axis=1), -2 * (high * middle).sum(axis=1)
    square[:, 2] = (2 * np.abs(high) ** 2 + middle**2).sum(axis=1) - size[:, 1] ** 2
    square[:, 3], square[:, 4] = square[:, 1].conj(), square[:, 0].conj()
    rows = np.stack([-delta[:, 1], gamma[:, 1].astype(complex), -delta[:, 1].conj()], axis=1)
    roots = _polynomial_roots(square)
    if singular.any():  # an equation without the second angle has two solutions by itself
        roots[singular, :2], roots[singular, 2:] = _polynomial_roots(rows[singular]), np.nan
    pose, column = np.nonzero(np.abs(np.abs(roots) - 1) < FORMS.near)
    first = np.angle(roots[pose, column])
    direction = np.stack([np.cos(first), np.sin(first)], axis=1)
    remaining = gamma[pose] - (alpha[pose] @ direction[:, :, None])[:, :, 0]
    cosine = np.clip(remaining[:, 0] / size[pose, 0], -1.0, 1.0)
    sine = np.sqrt(1 - cosine**2)
    good = np.abs(remaining - size[pose] * np.stack([cosine, sine], axis=1)).max(axis=1)
    flipped = np.abs(remaining - size[pose] * np.stack([cosine, -sine], axis=1)).max(axis=1)
    allowed = FORMS.near * np.maximum(size[pose, 0], 1e-12) ** 0.5
    chosen = np.concatenate([np.flatnonzero(good < allowed), np.flatnonzero(flipped < allowed)])
    sign = np.repeat([1.0, -1.0], [np.count_nonzero(good < allowed), np.count_nonzero(flipped < allowed)])
    unit = np.stack([cosine[chosen], sign * sine[chosen]], axis=1)[:, None] @ right[pose[chosen]]
    poses, firsts, seconds = pose[chosen], first[chosen], np.arctan2(unit[:, 0, 1], unit[:, 0, 0])
    free = np.where(singular, np.abs(rows).max(axis=1), np.abs(square).max(axis=1)) < FORMS.vanishing
    return poses, firsts, seconds, free | (size[:, 0] < FORMS.vanishing)


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
    share = np.clip(value / np.maximum(np.hypot(cosine, sine), TINY), -1.0, 1.0)
    middle, half, rows = np.arctan2(sine, cosine), np.arccos(share), np.arange(len(value))
    return np.concatenate([rows, rows]), np.concatenate([middle + half, middle - half])


def _solve_wrist(axes: list[Axis], goal: Motion) -> tuple[NDArray[np.intp], Array]:
    """Return two solutions of meeting axes a, b, c for a rotation, the nearest if there are none."""
    a, b, c = axes
    constant, parts = _rotation_terms(a.direction, b.direction, c.direction)
    value = dot(a.direction, goal.rotate(c.direction)) - constant
    pose, second = _middle_angles(value, parts[..., 0], parts[..., 1])
    return pose, _outer_angles([axis.take(pose) for axis in axes], goal.take(pose), second, None)


def _solve_planar(axes: list[Axis], goal: Motion) -> tuple[NDArray[np.intp], Array]:
    """Return two solutions of parallel axes a, b, c for a planar motion, the nearest if there are none."""
    a, b, c = axes
    along = a.direction
    goal_point = goal.at(c.point)
    arm, reach = b.point - a.point, c.point - b.point
    to_goal = goal_point - a.point
    parts = [part - dot(part, along)[:, None] * along for part in (to_goal, arm, reach)]
    value = (dot(parts[0], parts[0]) - dot(parts[1], parts[1]) - dot(parts[2], parts[2])) / 2
    cosine, sine = dot(parts[1], parts[2]), dot(parts[1], cross(b.direction, parts[2]))
    pose, second = _middle_angles(value, cosine, sine)
    return pose, _outer_angles([axis.take(pose) for axis in axes], goal.take(pose), second, goal_point[pose])


def _outer_angles(axes: list[Axis], goal: Motion, second: Array, goal_point: Array | None) -> Array:
    """Return the angles of a, b, c for a known angle of b: a from the image of c or its point, c from the rest."""
    a, b, c = axes
    motion = b.by(second)
    if goal_point is None:
        start, end = (part.rotate(c.direction) for part in (motion, goal))
    else:
        start, end = motion.at(c.point) - a.point, goal_point - a.point
    first = a.angle(start, end)
    remaining = (a.by(first).turn @ motion.turn).transpose(0, 2, 1) @ goal.turn
    trace = remaining[:, 0, 0] + remaining[:, 1, 1] + remaining[:, 2, 2]
    third = np.arctan2(dot(c.direction, axial(remaining)), trace - 1)
    return np.stack([first, second, third], axis=1)
