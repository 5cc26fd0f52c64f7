"""Inverse kinematics of six joints: interface of the solvers, and closed forms for arms with a suitable geometry.

A `PoseSolver` solves for six joints of a chain; further joints are redundant, and their positions are given.

Six revolute joints have a closed form if the axes of three consecutive joints meet in a point or are parallel (Pieper
1968): arms with spherical wrists or shoulders and arms with three parallel axes. The joint motions multiply to the
motion of the tip from its home, e_1 .. e_6 = G. Inverted and conjugated by G the product keeps its form, so the three
joints can be taken as the last ones, a, b, c, and the others as x, y, z. The invariant of the three, a point, or a
direction and the distance along it, gives two equations that are linear in the cosines and sines of the angles of x and
z: a polynomial of degree four with at most four pairs. The angle of y follows, and a, b, c have two solutions each: at
most eight in all (subproblems like those of Elias and Wen 2022, IK-Geo). For four joints along one direction, three
revolute and one prismatic (SCARA), the last step alone remains.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import combinations, pairwise
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models.checks import Array
from models.cts.trigonometric import Harmonics, polish, roots, square_of_first_harmonic
from models.spatial import Frame, cross, expression, rotation_matrices
from ocp.motion.local.chain import Chain, Motion, Solutions, SymbolicAxis, compose, inverse
from ocp.problem.values import Sampler

Mask: TypeAlias = NDArray[np.bool_]


TINY = 1e-300  # small number that is added to divisors to avoid divisions by zero
SIX, SCARA = 6, 4  # numbers of non-redundant joints of arms with closed forms: six in general, four for a SCARA


@dataclass(frozen=True)
class FormSettings:
    """Settings of closed-form inverse kinematics; lengths are relative to the size of the arm."""

    straight: float = 1e-8  # up to this much, also in rad, axes count as meeting or parallel; Newton's method refines
    near: float = 1e-3  # residual up to which rough solutions, as near double ones, are refined
    vanishing: float = 1e-8  # size of the coefficients of an equation below which each angle solves it
    nearby: float = 0.05  # distance up to which two roots may be close to each other, rad
    # solutions that a solver may have missed at a pose are searched by solving for poses nearby
    pairs: int = 2  # number of pairs of nearby poses for each pose
    distance: float = 1e-3  # typical distance of nearby poses, also in rad
    seed: int = 0  # seed of the directions of nearby poses


FORMS = FormSettings()


@dataclass(frozen=True, eq=False)
class PoseSolver(ABC):
    """Base class of solvers of the inverse kinematics of a chain for given positions of its redundant joints."""

    chain: Chain
    redundant: tuple[int, ...]

    @cached_property
    def free(self) -> list[int]:
        """Indices of the joints that are solved for, in the order along the chain."""
        return [j for j in self.chain.order if j not in self.redundant]

    @abstractmethod
    def solve_regular(self, tips: Motion, redundant: Array) -> tuple[Solutions, Mask, Mask]:
        """Return the IK solutions at M poses of the tip; at singular poses some solutions may be missing.

        `redundant` has the positions of the redundant joints, (M, k). Return also two masks (M,): poses at which it
        must be confirmed that these are all solutions, and poses at which some may be missing.
        """

    def solve(self, positions: Array, rotations: Array, redundant: Array) -> tuple[Solutions, Mask]:
        """Return all isolated IK solutions at M poses, and a mask (M,) of poses where some solutions may be missing.

        Where solutions may be missing, and at singularities, solutions at nearby poses are candidates too: isolated
        solutions depend continuously on the pose, and some members of a family are found.
        """
        tips, count = Motion(rotations, positions), len(positions)
        solutions, unconfirmed, doubtful = self.solve_regular(tips, redundant)
        again = unconfirmed | doubtful
        again[solutions.pose[solutions.singular]] = True
        if again.any():
            chosen, before = np.flatnonzero(again), np.bincount(solutions.pose, minlength=count)
            for nearby in self._nearby(tips.take(chosen)):
                more, _, _ = self.solve_regular(nearby, redundant[chosen])
                refined = self.chain.refine(chosen[more.pose], more.joints, self.free, tips)
                solutions = self.chain.union(solutions, refined, self.free, tips)
            doubtful = doubtful | (unconfirmed & (np.bincount(solutions.pose, minlength=count) > before))
        return solutions, doubtful

    def _nearby(self, tips: Motion) -> Iterator[Motion]:
        """Yield sets of poses displaced slightly from given poses, at which missing IK solutions may be found."""
        rng = np.random.default_rng(FORMS.seed)
        for _ in range(FORMS.pairs):
            turn, shift = FORMS.distance * rng.normal(size=(2, 3))
            for sign in (1.0, -1.0):
                yield Motion(tips.turn @ rotation_matrices(sign * turn), tips.shift + sign * self.chain.size * shift)


@dataclass(frozen=True, eq=False)
class ClosedForm(PoseSolver):
    """Solver of the inverse kinematics of an arm in closed form."""

    kind: str  # "meeting" or "parallel", by the axes of three of its joints, or "scara"
    triple: tuple[int, ...]  # indices of these joints

    def solve_regular(self, tips: Motion, redundant: Array) -> tuple[Solutions, Mask, Mask]:
        """Return IK solutions at M poses of the tip; continuous families of solutions may be incomplete."""
        arguments = np.concatenate([redundant, tips.turn.reshape(-1, 9), tips.shift], axis=1)
        count, families = len(arguments), np.zeros(len(arguments), dtype=bool)
        if self.kind == "scara":
            pose, positions, excess = np.arange(count), *self._planar_function(arguments)
        else:
            pairs, residuals, determination = self._pair_function(arguments)
            families = determination[:, 0] < FORMS.vanishing
            pose, column = np.nonzero(residuals < FORMS.near)
            arguments = np.concatenate([arguments[pose], pairs.reshape(count, -1, 2)[pose, column]], axis=1)
            positions, excess, arm = self._triple_function(arguments)
            families[pose[arm[:, 0] < FORMS.vanishing]] = True  # the joint between the pair may have any angle
            excess[arm < FORMS.near] = 0.0  # its angle is inaccurate, so that the excess is too
        within = np.flatnonzero(np.repeat(excess[:, 0] < FORMS.near, 2))
        joints = np.zeros((len(within), len(self.chain.axes)))
        pose = pose[within // 2]
        joints[:, list(self.redundant)] = redundant[pose]
        joints[:, self.free] = positions.reshape(-1, len(self.free))[within]
        return self.chain.refine(pose, joints, self.free, tips), np.zeros_like(families), families

    def _loop(self) -> _SymbolicLoop:
        """Return the loop of joint axes that the tip pose closes, with the three joints of `triple` last."""
        chain = self.chain
        symbols, fixed = ca.SX.sym("pose", len(self.redundant) + 12), Frame(ca.DM.eye(3), ca.DM(3, 1))
        points, axes = chain.points.copy(), list[SymbolicAxis]()
        if self.kind == "meeting":
            points[list(self.triple)] = _meeting_point(chain, self.triple)[0]
        for j in chain.order:
            axis = SymbolicAxis(expression(chain.axes[j]), expression(points[j]), bool(chain.revolute[j]))
            if j in self.redundant:
                fixed = compose(fixed, axis.frame(symbols[self.redundant.index(j)]))
            else:
                axes.append(axis.moved(fixed))
        tip = Frame(ca.reshape(symbols[-12:-3], 3, 3).T, symbols[-3:])
        goal = compose(tip, inverse(compose(fixed, chain.home)))
        last = self.free.index(self.triple[-1]) + 1
        axes = [*(axis.moved(goal) for axis in axes[last:]), *axes[:last]]
        return _SymbolicLoop(symbols, axes, [*self.free[last:], *self.free[:last]], goal)

    def _positions(self, order: list[int], solutions: list[list[Any]]) -> Any:
        """Stack the joint positions of IK solutions in a column; `order` lists the joints as ordered in a solution."""
        return ca.vertcat(*(each[order.index(j)] for each in solutions for j in self.free))

    @cached_property
    def _planar_function(self) -> Sampler:
        """Function from a tip pose to two IK solutions of a SCARA, and the excess of the pose over the arm's reach."""
        symbols, axes, order, goal = self._loop()
        triple = [axes[order.index(j)] for j in self.triple]
        slide = next(axis for axis in axes if not axis.revolute)
        shift = ca.dot(slide.direction, goal.point(triple[0].point) - triple[0].point)
        solutions, excess = _solve_triple(triple, goal, meeting=False)
        numbers = [*self.triple, *(j for j in self.free if j not in self.triple)]
        return Sampler([symbols], [self._positions(numbers, [[*each, shift] for each in solutions]), excess])

    @cached_property
    def _pair_function(self) -> Sampler:
        """Function of a tip pose: candidates for two angles, residuals, and a number that is 0 if an angle is free."""
        symbols, (x, y, z, a, *_), _, goal = self._loop()
        size = self.chain.size
        offsets = (x.point - y.point) / size, (z.point - y.point) / size
        end = (goal.point(a.point) - x.point) / size
        if self.kind == "meeting":
            start = (a.point - z.point) / size
            # e_z p and e_x^-1 G p have the same height along the axis of y and the same distance from it
            images, vectors = (end, 2 * end), (start, 2 * start)
            height = ca.dot(y.direction, offsets[1] - offsets[0])
            lengths = [ca.sumsqr(part) for part in (offsets[1], start, offsets[0], end)]
            sides = ca.vertcat(height, lengths[0] + lengths[1] - lengths[2] - lengths[3])
        else:
            ahead = ca.mtimes(goal.rotation, a.direction)
            # the direction of the triple, and the distance of a point along it, before and after the motion
            images, vectors = (ahead, ahead), (a.direction, a.direction)
            sides = ca.vertcat(0, ca.dot(a.direction, a.point - z.point) / size - ca.dot(ahead, end))
        of_x = ca.vertcat(*map(x.terms, (y.direction, offsets[0]), images, (-1, -1)))
        of_z = ca.vertcat(*map(z.terms, (y.direction, offsets[1]), vectors))
        c = sides + of_z[:, 0] - of_x[:, 0]
        first, second, residuals, determination = _pair_solver()(of_x[:, 1:], -of_z[:, 1:], c)
        return Sampler([symbols], [ca.horzcat(first, second).T, residuals, determination])

    @cached_property
    def _triple_function(self) -> Sampler:
        """Function from a tip pose and angles of the first and third joint in the loop closure equation to two IK
        solutions, the fraction by which the last three joints' reach is exceeded, and the second joint's lever arm.
        """
        symbols, (x, y, z, *triple), order, goal = self._loop()
        angles, meeting = ca.SX.sym("angles", 2), self.kind == "meeting"
        before, after = z.frame(angles[1]), compose(inverse(x.frame(angles[0])), goal)
        if meeting:
            start, end = (part.point(triple[0].point) - y.point for part in (before, after))
        else:
            start, end = (ca.mtimes(part.rotation, triple[0].direction) for part in (before, after))
        second = y.angle(start, end)
        solutions, excess = _solve_triple(triple, compose(inverse(compose(y.frame(second), before)), after), meeting)
        arm = ca.norm_2(cross(y.direction, start)) / (self.chain.size if meeting else 1.0)
        positions = self._positions(order, [[angles[0], second, angles[1], *each] for each in solutions])
        return Sampler([ca.vertcat(symbols, angles)], [positions, excess, arm])


class _SymbolicLoop(NamedTuple):
    """Loop closure equation of an arm in CasADi symbols: the product of the joint motions equals a goal pose."""

    symbols: Any  # positions of the redundant joints, rows of the rotation of the tip, its position, (k + 12,)
    axes: list[SymbolicAxis]
    order: list[int]  # indices of the joints
    goal: Frame


def closed_forms(chain: Chain, lockable: Sequence[int] | None = None) -> tuple[ClosedForm, ...]:
    """Return the closed-form solvers of a chain, one for each suitable choice of redundant joints from `lockable`."""
    if is_scara(chain):
        return (ClosedForm(chain, (), "scara", tuple(j for j in chain.order if chain.revolute[j])),)
    n, forms = len(chain.order), list[ClosedForm]()
    for redundant in combinations(chain.order if lockable is None else lockable, n - SIX) if n >= SIX else ():
        if not chain.revolute[[j for j in chain.order if j not in redundant]].all():
            continue
        triples = [chain.order[i : i + 3] for i in range(n - 2)]
        kinds = [(_kind_of(chain, triple), triple) for triple in triples if not set(triple) & set(redundant)]
        forms += [ClosedForm(chain, redundant, kind, triple) for kind, triple in sorted(kinds) if kind][:1]
    return tuple(forms)


def is_scara(chain: Chain) -> bool:
    """Return whether a chain is a SCARA: three parallel revolute joints and a prismatic one along them."""
    revolute = tuple(j for j in chain.order if chain.revolute[j])
    prismatic = [j for j in chain.order if not chain.revolute[j]]
    if len(chain.order) != SCARA or len(prismatic) != 1 or _kind_of(chain, revolute) != "parallel":
        return False
    return float(np.linalg.norm(np.cross(chain.axes[prismatic[0]], chain.axes[revolute[0]]))) < FORMS.straight


def _kind_of(chain: Chain, triple: tuple[int, ...]) -> str:
    """Classify three consecutive joint axes: "parallel", "meeting" (in a point), or "" for neither."""
    axes, points = chain.axes, chain.points
    if not chain.revolute[list(triple)].all():
        return ""
    sines = [float(np.linalg.norm(np.cross(axes[i], axes[j]))) for i, j in pairwise(triple)]
    if max(sines) < FORMS.straight:
        offsets = [points[j] - points[i] for i, j in pairwise(triple)]
        offsets = [offset - offset @ axes[triple[0]] * axes[triple[0]] for offset in offsets]
        return "parallel" if min(map(np.linalg.norm, offsets)) > FORMS.straight * chain.size else ""
    distance = _meeting_point(chain, triple)[1]
    return "meeting" if min(sines) > FORMS.straight and distance < FORMS.straight * chain.size else ""


def _meeting_point(chain: Chain, triple: tuple[int, ...]) -> tuple[Array, float]:
    """Return the point nearest to three joint axes by least squares, and its largest distance from one of them, m."""
    axes, points = chain.axes[list(triple)], chain.points[list(triple)]
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    projected = np.einsum("kij,kj->ki", projectors, points)
    point = np.linalg.lstsq(projectors.sum(axis=0), projected.sum(axis=0), rcond=FORMS.straight)[0]
    return point, float(np.linalg.norm(np.einsum("kij,j->ki", projectors, point) - projected, axis=1).max())


@cache
def _pair_solver() -> Any:
    """Return the CasADi function that solves a [cos, sin](first) + b [cos, sin](second) = c for two angles.

    The singular value decomposition b = L diag(s) R, in closed form, separates the angles: with a' = L' a and c' = L' c
    the remainders w = c' - a' [cos, sin](first) satisfy (w_1 / s_1)^2 + (w_2 / s_2)^2 = 1, a trigonometric polynomial
    of two harmonics. The outputs are sixteen pairs of angles, some of which are no solutions; how far each pair is from
    a solution; and a number that vanishes where an angle is not determined.
    """
    a, b, c = ca.SX.sym("a", 2, 2), ca.SX.sym("b", 2, 2), ca.SX.sym("c", 2)
    mean, difference = (b[0, 0] + b[1, 1]) / 2, (b[0, 0] - b[1, 1]) / 2
    turn, shear = (b[1, 0] - b[0, 1]) / 2, (b[1, 0] + b[0, 1]) / 2
    larger, smaller = ca.hypot(mean, turn), ca.hypot(difference, shear)
    sizes = larger + smaller + TINY, larger - smaller
    sum_angle, difference_angle = ca.atan2(shear, difference), ca.atan2(turn, mean)
    left, right = (difference_angle + sum_angle) / 2, (difference_angle - sum_angle) / 2
    cosine, sine = ca.cos(left), ca.sin(left)
    rotated = ca.mtimes(ca.vertcat(ca.horzcat(cosine, sine), ca.horzcat(-sine, cosine)), ca.horzcat(a, c))
    equations = [(rotated[i, 2], -rotated[i, 0], -rotated[i, 1]) for i in (0, 1)]
    singular = ca.fabs(sizes[1]) <= FORMS.straight * sizes[0]
    share = sizes[1] / sizes[0]
    squares = (square_of_first_harmonic(*(f * part for part in e)) for e, f in zip(equations, (share, 1), strict=True))
    ellipse = Harmonics(*(one + other for one, other in zip(*squares, strict=True)))
    ellipse = ellipse._replace(a0=ellipse.a0 - sizes[1] ** 2)
    # an equation without the second angle has two solutions by itself
    middle, half = _middle_and_half(-equations[1][0], *equations[1][1:])
    alone = ca.vertcat(middle + half, middle - half)
    first = ca.if_else(singular, ca.vertcat(alone, alone, alone, alone), _close_roots(ellipse))
    repeated = ca.if_else(singular, ca.vertcat(0, 0, *[1] * 6), ca.DM.zeros(8))
    w = [e[0] + e[1] * ca.cos(first) + e[2] * ca.sin(first) for e in equations]
    cosine = ca.fmin(ca.fmax(w[0] / sizes[0], -1.0), 1.0)
    firsts, seconds, residuals = [], [], []
    for sine in (ca.sqrt(1 - cosine**2), -ca.sqrt(1 - cosine**2)):
        residual = ca.fmax(ca.fabs(w[0] - sizes[0] * cosine), ca.fabs(w[1] - sizes[1] * sine))
        firsts.append(first)
        seconds.append(ca.atan2(sine, cosine) - right)
        residuals.append(residual / ca.sqrt(ca.fmax(sizes[0], 1e-12)) + repeated)
    largest = ca.fmax(ca.fabs(ellipse.a0), ca.fmax(ca.hypot(*ellipse[1:3]), ca.hypot(*ellipse[3:5])) / 2)
    linear = ca.fmax(ca.fabs(equations[1][0]), ca.hypot(*equations[1][1:]) / 2)
    determination = ca.fmin(ca.if_else(singular, linear, largest), sizes[0])
    outputs = [ca.vertcat(*part) for part in (firsts, seconds, residuals)]
    return ca.Function("pairs", [a, b, c], [*outputs, determination])


def _close_roots(f: Harmonics) -> Any:
    """Return eight angles (8, 1) that include all roots of a trigonometric polynomial; double roots become close pairs.

    Of two roots close to each other the general method may find only one. The parabola with the same value, slope and
    curvature there has both roots.
    """
    size = TINY + sum(map(ca.fabs, f))
    f = Harmonics(*(part / size for part in f))
    slope = f.derivative()
    start = tuple(ca.vertcat(*part) for part in zip(*roots(f, steps=0), strict=True))
    point = polish(start, lambda c, s: (f.value(c, s), slope.value(c, s)), floor=np.finfo(float).eps)
    value, rate, curvature = f.value(*point), slope.value(*point), slope.derivative().value(*point)
    root = ca.sqrt(ca.fmax(rate**2 - 2 * value * curvature, 0.0))
    double = rate + ca.if_else(rate < 0, -root, root)
    steps = -2 * value * double / (double**2 + TINY), -double * curvature / (curvature**2 + TINY)
    angle = ca.atan2(point[1], point[0])
    return ca.vertcat(*(angle + ca.fmin(ca.fmax(step, -FORMS.nearby), FORMS.nearby) for step in steps))


def _middle_and_half(value: Any, cosine: Any, sine: Any) -> tuple[Any, Any]:
    """Return mean and half difference of the roots q of a cos(q) + b sin(q) = value; of the best q if none exist."""
    share = value / ca.fmax(ca.hypot(cosine, sine), TINY)
    return ca.atan2(sine, cosine), ca.acos(ca.fmin(ca.fmax(share, -1.0), 1.0))


def _solve_triple(axes: list[SymbolicAxis], goal: Frame, meeting: bool) -> tuple[list[list[Any]], Any]:
    """Return two solutions for three joints that must produce a rotation (meeting axes) or a planar motion (parallel
    axes), and the fraction by which the motion exceeds their reach. Beyond the reach, the solutions are the nearest.
    """
    a, b, c = axes
    goal_point = goal.point(c.point)
    if meeting:
        constant, cosine, sine = ca.horzsplit(b.terms(a.direction, c.direction))
        value = ca.dot(a.direction, ca.mtimes(goal.rotation, c.direction)) - constant
    else:
        distances = goal_point - a.point, b.point - a.point, c.point - b.point
        to_goal, arm, reach = (part - ca.dot(part, a.direction) * a.direction for part in distances)
        value = (ca.sumsqr(to_goal) - ca.sumsqr(arm) - ca.sumsqr(reach)) / 2
        cosine, sine = ca.dot(arm, reach), ca.dot(arm, cross(b.direction, reach))
    middle, half = _middle_and_half(value, cosine, sine)
    solutions = []
    for second in (middle + half, middle - half):
        motion = b.frame(second)
        if meeting:
            start, end = (ca.mtimes(part.rotation, c.direction) for part in (motion, goal))
        else:
            start, end = motion.point(c.point) - a.point, goal_point - a.point
        first = a.angle(start, end)
        remaining = ca.mtimes(ca.mtimes(a.frame(first).rotation, motion.rotation).T, goal.rotation)
        third = ca.atan2(2 * ca.dot(c.direction, ca.inv_skew(remaining)), ca.trace(remaining) - 1)
        solutions.append([first, second, third])
    return solutions, ca.fabs(value) / ca.fmax(ca.hypot(cosine, sine), TINY) - 1
