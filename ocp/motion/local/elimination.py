"""All inverse kinematics solutions of any six joints, by elimination (Raghavan, Roth 1993; Manocha, Canny 1994).

Six joint motions close a loop, e_x e_y e_z e_a e_b e_c = G. The last, revolute joint c moves neither the points nor the
direction of its axis, so that a point p on it and its direction l satisfy

    e_z e_a e_b (p, l) = e_y^-1 e_x^-1 G (p, l).

On both sides take the 15 numbers 1, p, p.p, l, p.l, p x l and p.p l - 2 p.l p: the conformal coordinates of the point
and of the line element in it. Each joint acts on them by a matrix that is linear in cos q and sin q, or quadratic in a
displacement: both are quadratic forms on the projective line, 1, cos h and sin h of an angle h with q = h, or q = size
tan(h / 2). The 15 x 9 matrix of the products of x and y has a left null space of six rows, which removes x and y; times
cos(h / 2) and sin(h / 2) of one of z, a, b they are twelve equations, linear in twelve products of that angle and
another one and quadratic in the third: a polynomial eigenvalue problem with 24 eigenvalues. At most 16 of them are
solutions; half-angles are rotated such that no solution is at infinity.

The loop may be opened at any of its joints, and each opening leaves six ways to choose the angles. Where axes meet or
are parallel some of these problems are singular for all poses. A trial at random configurations chooses regular ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.checks import Array
from models.spatial import rotation_matrices
from ocp.motion.local.chain import TURN, Chain, Motion, Solutions
from ocp.motion.local.closed_forms import SIX, Mask, PoseSolver

# angles h at which a function is sampled to find its coefficients of 1, cos h and sin h
SAMPLES = 2 * np.pi / 3 * np.arange(3)
COEFFICIENTS = np.linalg.inv(np.stack([np.ones(3), np.cos(SAMPLES), np.sin(SAMPLES)], axis=1))
# coefficients of the products of 1, cos h, sin h with cos h/2, sin h/2 in cos h/2, sin h/2, cos 3h/2, sin 3h/2
PRODUCTS = np.array(
    [[[1, 0, 0, 0], [0, 1, 0, 0]], [[0.5, 0, 0.5, 0], [0, -0.5, 0, 0.5]], [[0, 0.5, 0, 0.5], [0.5, 0, -0.5, 0]]]
)


@dataclass(frozen=True)
class EliminationSettings:
    """Settings of the inverse kinematics of six joints by elimination."""

    rank: float = 1e-9  # singular values of the eliminated products below this share of the largest count as zero
    regular: float = 1e-11  # reciprocal condition number below which an eigenvalue problem counts as singular
    real: float = 3e-2  # distance of exp(i h) from the unit circle below which an angle h may be real
    probably_real: float = 1e-4  # distance below which a multiple eigenvalue counts as real
    surely_real: float = 1e-7  # distance below which a simple eigenvalue is real
    simple: float = 1e-4  # deviation of an eigenvector from products below which its eigenvalue is simple
    poles: tuple[float, ...] = (0.3, 1.9, 3.5, 5.1)  # angles h at which the half-angle may be infinite
    same: float = 1e-5  # distance of a solution from a configuration of the trial to be the same, rad or m
    trials: int = 12  # number of random configurations of the trial
    openings: int = 3  # largest number of eigenvalue problems that are solved at a doubtful pose
    seed: int = 0  # seed of the trial


ELIMINATION = EliminationSettings()


def axial(turn: Array) -> Array:
    """Return the axial vectors (M, 3) of rotation matrices (M, 3, 3), which are 2 sin(angle) times the axis."""
    return np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1)


class Axis(NamedTuple):
    """Unit direction of a joint axis and a point on it, at each of M poses, (M, 3), or for all poses, (1, 3)."""

    direction: Array
    point: Array
    revolute: bool = True

    def take(self, chosen: NDArray[np.intp]) -> Axis:
        """Return the joint axis at only those of the M poses that have the given indices."""
        return self if len(self.point) == 1 else Axis(self.direction[chosen], self.point[chosen], self.revolute)

    def moved(self, motion: Motion) -> Axis:
        """Return the axis transformed by rigid motions, one for each pose."""
        return Axis(motion.rotate(self.direction), motion.at(self.point), self.revolute)

    def motion(self, position: Array) -> Motion:
        """Return the rigid motions that the joint causes at joint positions (M,)."""
        if not self.revolute:
            return Motion(np.broadcast_to(np.eye(3), (len(position), 3, 3)), self.direction * position[:, None])
        turn = rotation_matrices(position[:, None] * self.direction)
        return Motion(turn, self.point - (turn @ self.point[:, :, None])[:, :, 0])


class LoopOpening(NamedTuple):
    """Choice of the joint at which the kinematic loop is opened, and of the roles of the joints in the elimination."""

    first: int  # index of the joint x; the others follow in the order of the loop
    rank: int  # number of independent products of x and y at a regular pose
    roles: tuple[int, int, int]  # which of z, a, b has the eigenvalue, half-angles, and the rest


class _Loop(NamedTuple):
    """Loop closure equation of six joints at each of M poses: the product of the joint motions is the goal motion."""

    joints: list[Axis]
    goal: Motion
    size: float


class _Candidates(NamedTuple):
    """Candidate IK solutions, with counts per pose, that result from opening the kinematic loop at one joint."""

    pose: NDArray[np.intp]  # index of the pose of each candidate, (K,)
    free: Array  # positions of the free joints, (K, 6)
    least: NDArray[np.intp]  # how many solutions each pose has at least, from simple real eigenvalues, (M,)
    mixed: Mask  # which poses have multiple real eigenvalues, (M,)
    singular: Mask  # which poses have a singular problem, (M,)


@dataclass(frozen=True, eq=False)
class Elimination(PoseSolver):
    """Solver of the inverse kinematics of six joints by elimination, built by `elimination_of`."""

    openings: tuple[LoopOpening, ...]  # openings of the loop that have regular problems, the best first

    def solve_regular(self, tips: Motion, redundant: Array) -> tuple[Solutions, Mask, Mask]:
        """Return IK solutions at M poses, and two masks: poses to confirm, and poses where solutions may be missing.

        Solutions may be missing where the problem is singular, or where fewer solutions than real eigenvalues or an odd
        number of solutions were found. Multiple eigenvalues mix the products of several solutions; completeness is then
        to be confirmed. Such poses are solved with further openings.
        """
        prescribed, count = self.prescribe(redundant), len(tips.shift)
        even, solutions = bool(self.chain.revolute[self.free].all()), Solutions.none(len(self.chain.axes))
        doubtful, mixed = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
        for opening in self.openings:
            chosen = np.flatnonzero(doubtful | mixed)
            if not chosen.size:
                break
            axes, goal = self.loop(prescribed[chosen], tips.take(chosen))
            rough = solve_opening(axes, goal, self.chain.size, opening)
            more = self.refine(chosen[rough.pose], rough.free, prescribed, tips)
            solutions = self.chain.union(solutions, more, self.free, tips)
            numbers = np.bincount(solutions.pose, minlength=count)[chosen]
            doubtful[chosen] = rough.singular | (numbers < rough.least) | (even & (numbers % 2 == 1))
            mixed[chosen] = rough.mixed
        return solutions, mixed, doubtful

    def prescribe(self, redundant: Array) -> Array:
        """Return configurations (M, n) with given positions (M, k) of the redundant joints and the others at 0."""
        joints = np.zeros((len(redundant), len(self.chain.axes)))
        joints[:, list(self.redundant)] = redundant
        return joints

    def refine(self, pose: NDArray[np.intp], free: Array, prescribed: Array, goal: Motion) -> Solutions:
        """Refine rough positions (K, m) of the free joints by Newton's method; return the IK solutions."""
        joints = prescribed[pose]
        joints[:, self.free] = free
        return self.chain.refine(pose, joints, self.free, goal)

    def loop(self, prescribed: Array, goal: Motion) -> tuple[list[Axis], Motion]:
        """Return the axes of the free joints and the rigid motion that these joints must produce to reach a goal."""
        chain, fixed, axes = self.chain, Motion(np.eye(3)[None], np.zeros((1, 3))), list[Axis]()
        for j in chain.order:
            axis = Axis(chain.axes[[j]], chain.points[[j]], bool(chain.revolute[j])).moved(fixed)
            if j in self.redundant:
                fixed = axis.motion(prescribed[:, j]).after(fixed)
            else:
                axes.append(axis)
        home = Motion(chain.rotation[None], chain.position[None])
        return axes, goal.after(fixed.after(home).inverse)


def elimination_of(chain: Chain, redundant: tuple[int, ...]) -> Elimination | None:
    """Return the elimination solver of six joints of a chain; None if all eigenvalue problems are singular.

    At random configurations the openings are sorted by the condition of their problems. The first openings that recover
    the most of these configurations, and find the most solutions, are taken.
    """
    joints, tips = chain.random_configurations(ELIMINATION.trials, ELIMINATION.seed)
    solver = Elimination(chain, redundant, ())
    prescribed = solver.prescribe(joints[:, list(redundant)])
    axes, goal = solver.loop(prescribed, tips)
    conditions = list[tuple[float, LoopOpening]]()
    for first in range(SIX):
        if axes[first - 1].revolute:
            singular_vectors, ranks, remaining = _split(_open(axes, goal, chain.size, first))
            rank = int(ranks.max())
            for z, a, b in permutations(range(3)):
                matrices = _matrices(singular_vectors[:, :, rank:], remaining, (z, a, b))
                condition = float(np.median(_companions(matrices)[2]))
                conditions.append((condition, LoopOpening(first, rank, (z, a, b))))
    regular = sorted(each for each in conditions if each[0] > ELIMINATION.regular)[::-1]
    kept, most = list[LoopOpening](), (0, 0)
    for _, opening in regular:
        rough = solve_opening(axes, goal, chain.size, opening)
        solutions = solver.refine(rough.pose, rough.free, prescribed, tips)
        deviation = (solutions.joints - joints[solutions.pose])[:, list(chain.order)]
        deviation[:, chain.revolute[list(chain.order)]] %= TURN
        same = np.minimum(deviation, TURN - deviation).max(axis=1, initial=0.0) < ELIMINATION.same
        score = len(np.unique(solutions.pose[same])), len(solutions.pose)
        if score >= most:
            kept = [*(kept if score == most else []), opening]
            most = score
        if len(kept) >= ELIMINATION.openings and most[0] == ELIMINATION.trials:
            break
    kept = kept[: ELIMINATION.openings]
    return Elimination(chain, redundant, tuple(kept)) if kept else None


def _open(axes: list[Axis], goal: Motion, size: float, first: int) -> _Loop:
    """Return the loop opened at a joint: the joints before it come last, transformed by the inverse goal motion."""
    back = goal.inverse
    joints = [axes[(first + i) % SIX] for i in range(SIX)]
    return _Loop([axis.moved(back) if i >= SIX - first else axis for i, axis in enumerate(joints)], goal, size)


def _split(loop: _Loop) -> tuple[Array, NDArray[np.intp], Array]:
    """Return singular vectors (M, 15, 15) and ranks (M,) of the coefficients of a loop's first two joints, which are
    eliminated, and coefficients (M or 1, 15, 3, 3, 3) for the three joints that follow.
    """
    goal, size, c = loop.goal, loop.size, loop.joints[5]
    center = sum(axis.point for axis in loop.joints) / SIX
    local = [axis._replace(point=(axis.point - center) / size) for axis in loop.joints]
    remaining = _coefficients(local[4:1:-1], local[5].point, c.direction)
    point, direction = (goal.at(c.point) - center) / size, goal.rotate(c.direction)
    inverted = [axis._replace(direction=-axis.direction) for axis in local[:2]]
    left, values, _ = np.linalg.svd(_coefficients(inverted, point, direction).reshape(len(point), 15, 9))
    return left, (values > ELIMINATION.rank * values[:, :1]).sum(axis=1), remaining


def _coefficients(axes: list[Axis], point: Array, direction: Array) -> Array:
    """Return the coefficients of 1, cos and sin of joint angles in 15 coordinates of a moved point and direction.

    The module's docstring defines the coordinates. Shape (M, 15, 3, ...). `axes` begins with the joint that moves the
    point first; the array has the axes of the joint angles in reverse order.
    """
    weights, count = np.ones(1), max(len(point), *(len(axis.point) for axis in axes))
    point, direction = (np.broadcast_to(part[:, None], (count, 1, 3)) for part in (point, direction))
    for axis in axes:
        w, p = axis.direction[:, None, None], axis.point[:, None, None]
        if axis.revolute:
            cosine, sine = (part[:, None, None] for part in (np.cos(SAMPLES), np.sin(SAMPLES)))
            moved = []
            for vector in (point[:, None] - p, direction[:, None]):
                along = np.vecdot(vector, w)[..., None] * w
                moved.append(along + cosine * (vector - along) + sine * np.cross(w, vector))
            moved[0] = moved[0] + p
        else:
            shifts = np.tan(SAMPLES / 2)[:, None, None] * w
            moved = [
                point[:, None] + shifts,
                np.broadcast_to(direction[:, None], (len(point), 3, *direction.shape[1:])),
            ]
        scale = np.ones(3) if axis.revolute else np.cos(SAMPLES / 2) ** 2
        weights = (scale[:, None] * weights).ravel()
        point, direction = (part.reshape(len(point), -1, 3) for part in moved)
    square, along = np.vecdot(point, point)[..., None], np.vecdot(point, direction)[..., None]
    parts = [np.ones_like(square), point, square, direction, along, np.cross(point, direction)]
    values = np.concatenate([*parts, square * direction - 2 * along * point], axis=2) * weights[:, None]
    values = values.transpose(0, 2, 1).reshape(len(point), 15, *[3] * len(axes))
    for k in range(len(axes)):
        values = np.moveaxis(np.moveaxis(values, 2 + k, -1) @ COEFFICIENTS.T, -1, 2 + k)
    return values


def _matrices(annihilators: Array, remaining: Array, roles: tuple[int, int, int]) -> Array:
    """Return the coefficient matrices (M, 3, 12, 12) of 1, cos and sin of a joint angle in its eigenvalue problem."""
    count, _, rows = annihilators.shape
    equations = annihilators.transpose(0, 2, 1) @ remaining.reshape(-1, 15, 27)
    equations = equations.reshape(count, rows, 3, 3, 3).transpose(0, 1, *(2 + role for role in roles))
    # (pose, row, eigenvalue, half, other) -> (pose, eigenvalue, row x 2, 4 x other)
    products = equations.transpose(0, 2, 1, 4, 3).reshape(-1, 3) @ PRODUCTS.reshape(3, 8)
    products = products.reshape(count, 3, rows, 3, 2, 4).transpose(0, 1, 2, 4, 5, 3).reshape(count, 3, 2 * rows, 12)
    if rows > SIX:
        mix = np.linalg.qr(np.random.default_rng(ELIMINATION.seed).normal(size=(2 * rows, 12)))[0]
        products = mix.T @ products
    return np.asarray(products)


def _companions(matrices: Array) -> tuple[Array, Array, Array]:
    """Return companion matrices (M, 24, 24) with eigenvalues tan((h - pole) / 2) for the solutions h of eigenvalue
    problems in cos h and sin h, the poles (M,), rad, and reciprocal condition numbers (M,) of leading matrices.
    """
    count, poles = len(matrices), np.array(ELIMINATION.poles)
    one, cosine, sine = (matrices[:, None, k] for k in range(3))
    at = np.cos(poles)[:, None, None] * cosine + np.sin(poles)[:, None, None] * sine
    leading = one - at
    with np.errstate(all="ignore"):
        inverses = _inverses(leading)
        conditions = 1 / (np.abs(leading).sum(axis=3).max(axis=2) * np.abs(inverses).sum(axis=3).max(axis=2))
    conditions = np.nan_to_num(conditions)
    best, rows = conditions.argmax(axis=1), np.arange(count)
    pole = poles[best]
    slope = 2 * (np.cos(pole)[:, None, None] * matrices[:, 2] - np.sin(pole)[:, None, None] * matrices[:, 1])
    constant = (one + at)[rows, best]
    companions = np.zeros((count, 24, 24))
    companions[:, :12, 12:] = np.eye(12)
    companions[:, 12:] = -np.nan_to_num(inverses[rows, best]) @ np.concatenate([constant, slope], axis=2)
    return companions, pole, conditions[rows, best]


def _inverses(matrices: Array) -> Array:
    """Return the inverses of matrices; the inverse of an exactly singular matrix is infinite."""
    try:
        return np.asarray(np.linalg.inv(matrices))
    except np.linalg.LinAlgError:
        singular = np.linalg.det(matrices) == 0
        inverses = np.linalg.inv(np.where(singular[..., None, None], np.eye(matrices.shape[-1]), matrices))
        return np.asarray(np.where(singular[..., None, None], np.inf, inverses))


def solve_opening(axes: list[Axis], goal: Motion, size: float, opening: LoopOpening) -> _Candidates:
    """Return candidate IK solutions of a loop opened at a joint, from the real eigenvalues of a matrix problem."""
    loop = _open(axes, goal, size, opening.first)
    singular_vectors, ranks, remaining = _split(loop)
    matrices = _matrices(singular_vectors[:, :, opening.rank :], remaining, opening.roles)
    companions, pole, condition = _companions(matrices)
    values, vectors = np.linalg.eig(companions)
    with np.errstate(all="ignore"):
        rotation = np.exp(1j * pole)[:, None] * (1 + 1j * values) / (1 - 1j * values)
        distance = np.nan_to_num(np.abs(np.log(np.abs(rotation))), nan=np.inf)
    revolute = [axis.revolute for axis in loop.joints]
    if not revolute[2 + opening.roles[0]]:
        distance[np.abs(rotation + 1) < ELIMINATION.real] = np.inf  # a prismatic joint at infinity
    pose, column = np.nonzero(distance < ELIMINATION.real)
    upper, vector = np.abs(values[pose, column]) > 1, vectors[pose, :, column]
    half, other, residual = _factor_angles(np.where(upper[:, None], vector[:, 12:], vector[:, :12]).reshape(-1, 4, 3))
    away, simple = distance[pose, column], residual < ELIMINATION.simple
    least = np.bincount(pose[simple & (away < ELIMINATION.surely_real)], minlength=len(distance))
    mixed = np.bincount(pose[~simple & (away < ELIMINATION.probably_real)], minlength=len(distance))
    angles = np.empty((len(pose), 3))
    angles[:, opening.roles] = np.column_stack([np.angle(rotation[pose, column]), half, other])
    middle = np.where(revolute[2:5], angles, size * np.tan(angles / 2))
    free = np.empty((len(pose), SIX))
    free[:, [(opening.first + i) % SIX for i in range(SIX)]] = _all_positions(loop, pose, middle)
    return _Candidates(pose, free, least, mixed > 0, (condition < ELIMINATION.regular) | (ranks < opening.rank))


def _factor_angles(vectors: Array) -> tuple[Array, Array, Array]:
    """Recover two joint angles from each of K eigenvectors, whose entries are products of sines and cosines of both.

    The entries (4, 3) multiply functions of half the first angle by functions of the second. The third result is the
    largest deviation of an entry from such products, relative to the largest entry.
    """
    flat, rows = vectors.reshape(-1, 12), np.arange(len(vectors))
    largest = flat[rows, np.abs(flat).argmax(axis=1)]
    real = (vectors / largest[:, None, None]).real
    column, row = np.abs(real).sum(axis=1).argmax(axis=1), np.abs(real).sum(axis=2).argmax(axis=1)
    half, other = real[rows, :, column], real[rows, row]
    angle = np.angle((half[:, 2] + 1j * half[:, 3]) * (half[:, 0] - 1j * half[:, 1]))
    signed = np.where(other[:, :1] < 0, -other, other)
    other_angle = np.arctan2(signed[:, 2], signed[:, 1])
    multiples = angle[:, None] * [0.5, 1.5]
    waves = np.column_stack([np.cos(multiples), np.sin(multiples)])[:, [0, 2, 1, 3]]
    functions = np.column_stack([np.ones(len(rows)), np.cos(other_angle), np.sin(other_angle)])
    products = waves[:, :, None] * functions[:, None]
    place = rows, row, column
    residual = real - products * (real[place] / products[place])[:, None, None]
    return angle, other_angle, np.abs(residual).max(axis=(1, 2), initial=0.0)


def _all_positions(loop: _Loop, pose: NDArray[np.intp], middle: Array) -> Array:
    """Return the positions (K, 6) of all joints of a loop, given positions (K, 3) of the third to fifth joint.

    The motions of x and y are found from e_x^-1 (G p, G l) = e_y (p', l'), which is linear in their cosines and sines.
    """
    x, y, z, a, b, c = (axis.take(pose) for axis in loop.joints)
    goal, size = loop.goal.take(pose), loop.size
    motion = z.motion(middle[:, 0]).after(a.motion(middle[:, 1])).after(b.motion(middle[:, 2]))
    ends = (goal.at(c.point), goal.rotate(c.direction)), (motion.at(c.point), motion.rotate(c.direction))
    columns, constants = list[Array](), list[Array]()
    for axis, (point, direction), sign in ((x, ends[0], -1.0), (y, ends[1], 1.0)):
        if not axis.revolute:
            slide = np.zeros((len(pose), 6))
            slide[:, :3] = axis.direction / size
            columns += [slide, np.zeros_like(slide)]
            constants.append(sign * np.concatenate([point / size, direction], axis=1))
            continue
        parts = []
        for vector, origin, unit in ((point - axis.point, axis.point, size), (direction, 0.0, 1.0)):
            along = np.vecdot(vector, axis.direction)[:, None] * axis.direction
            parts.append(((origin + along) / unit, (vector - along) / unit, np.cross(axis.direction, vector) / unit))
        constant, cosine, sine = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
        columns += [sign * cosine, sine]
        constants.append(sign * constant)
    inverse = np.linalg.pinv(np.stack(columns, axis=2), rcond=ELIMINATION.rank)
    solved = -(inverse @ (constants[0] + constants[1])[:, :, None])[:, :, 0]
    first, second = (
        np.arctan2(part[:, 1], part[:, 0]) if axis.revolute else part[:, 0]
        for axis, part in ((x, solved[:, :2]), (y, solved[:, 2:]))
    )
    rest = x.motion(first).after(y.motion(second)).after(motion).inverse.after(goal).turn
    last = np.arctan2(np.vecdot(c.direction, axial(rest)) / 2, (np.trace(rest, axis1=1, axis2=2) - 1) / 2)
    return np.column_stack([first, second, middle, last])
