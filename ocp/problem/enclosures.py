"""Interval enclosures of functions of one variable: bounds of values and slopes, also across kinks and jumps.

This is forward-mode differentiation in interval arithmetic. Each instruction carries its range and an interval of
slopes that contains every difference quotient (x(s) - x(t)) / (s - t) of two places in the interval. A smooth operation
propagates slopes by the mean value theorem. At a kink the slopes of both sides are hulled, as in Clarke's generalised
gradient (Clarke 1983, *Optimization and Nonsmooth Analysis*, section 2.3). Where a jump cannot be excluded the slopes
are unbounded, and the range alone bounds the value. No whole expression is differentiated, as casadi's derivatives
ignore jumps.

Enclosures bound the motion of bodies that is prescribed as a function of time. Over an interval of length h, let every
coordinate of a point have a range of width w and slopes in [l, u]. Then the point's distance from its position at the
middle is at most

    min(w, h/2 max(|l|, |u|)),

and its distance from the chord between its end positions is at most h/4 (u - l). Both hold across kinks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ocp.errors import ProblemError
from ocp.problem.hulls import WORLD, CoveredPairs, Separation
from ocp.problem.intervals import (
    RULES,
    Interval,
    bounded_where,
    check_instructions,
    constant,
    decided_masks,
    evaluate,
    interpret,
    multiple_of,
)
from ocp.problem.values import identity


class Enclosure(NamedTuple):
    """Bounds, possibly infinite, of the values and slopes of expressions over intervals of their only variable.

    Attributes:
        low, high: Bounds of the values. Shape (M, n) for M intervals and n expressions.
        least, most: Bounds of the slopes, that is of all difference quotients within an interval. Shape (M, n).
    """

    low: np.ndarray
    high: np.ndarray
    least: np.ndarray
    most: np.ndarray


class Enclosures:
    """Evaluator that bounds the values and slopes of expressions of one scalar symbol over intervals of the symbol.

    The bounds hold wherever an entry and all its subexpressions are defined: the square root of a function that becomes
    negative counts where it is real.

    Raises:
        ProblemError: An operation without a rule, by name; another symbol in the values.
    """

    def __init__(self, values: Any, symbol: Any, what: str = "bounds") -> None:
        try:
            function = ca.Function("values", [symbol], [ca.densify(values)])
            self._function = function if isinstance(symbol, ca.SX) else function.expand()
        except (RuntimeError, NotImplementedError) as error:
            words = f"{what}: values must be expressions of the symbol alone: {str(error).splitlines()[-1]}"
            raise ProblemError(words, name="values", value=values) from error
        check_instructions(what, self._function)

    def __call__(self, low: np.ndarray, high: np.ndarray) -> Enclosure:
        """Return bounds of the expressions over M intervals of the symbol, from ``low`` (M,) to ``high`` (M,)."""

        def apply(code: int, *operands: _Jet) -> _Jet:
            return _KINKED[code](code, *operands) if code in _KINKED else _smooth(code, *operands)

        symbol, zero = _Jet(Interval(low, high), constant(1.0, low)), constant(0.0, low)
        with np.errstate(all="ignore"):
            jets = interpret(self._function, [symbol], lambda value: _Jet(constant(value, low), zero), apply)
        sides = zip(*((*jet.value[:2], *jet.slope[:2]) for jet in jets), strict=True)
        return Enclosure(*(np.column_stack(side) for side in sides))


class _Jet(NamedTuple):
    """Bounds of the value and of the slope of one instruction of a casadi function over M intervals."""

    value: Interval
    slope: Interval


ADD, MULTIPLY, SUBTRACT = (RULES[code] for code in (ca.OP_ADD, ca.OP_MUL, ca.OP_SUB))


def _smooth(code: int, *jets: _Jet) -> _Jet:
    """Return bounds of the value and slope of a smooth operation, by the mean value theorem."""
    value = RULES[code](*(jet.value for jet in jets))
    exponent = None
    if code in (ca.OP_POW, ca.OP_CONSTPOW):
        low, high = jets[1].value[:2]
        exponent = float(low[0]) if (low == low[0]).all() and (high == low[0]).all() else None
    slope = constant(0.0, value.low)
    inputs = [jet.value for jet in jets[: 1 if exponent is not None else None]]
    for partial, jet in zip(evaluate(_partials(code, len(jets), exponent), inputs), jets, strict=False):
        if jet.slope.low.any() or jet.slope.high.any():
            slope = ADD(slope, MULTIPLY(partial, jet.slope))
    return _Jet(value, bounded_where(np.isfinite(value.low) & np.isfinite(value.high), slope))


@lru_cache(maxsize=4096)
def _partials(code: int, count: int, exponent: float | None) -> Any:
    """Return the partial derivatives of an operation as an SX function; ``exponent`` is None unless constant."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    if count == 1:
        return ca.Function("partials", [x], [ca.densify(ca.gradient(ca.SX.unary(code, x), x))])
    if exponent is not None:
        return ca.Function("partials", [x], [exponent * ca.constpow(x, exponent - 1)])
    both = ca.vertcat(x, y)
    return ca.Function("partials", [x, y], [ca.densify(ca.gradient(ca.SX.binary(code, x, y), both))])


def _piecewise_constant(code: int, *jets: _Jet) -> _Jet:
    """Return bounds of the value and slope of a piecewise constant operation: floor, ceil, sign, comparisons."""
    value = RULES[code](*(jet.value for jet in jets))
    return _Jet(value, bounded_where(value.low == value.high, constant(0.0, value.low)))


def _absolute(code: int, x: _Jet) -> _Jet:
    rises, falls = x.value.low >= 0, x.value.high <= 0
    sign = Interval(np.where(rises, 1.0, -1.0), np.where(falls & ~rises, -1.0, 1.0))
    return _Jet(RULES[code](x.value), MULTIPLY(sign, x.slope))


def _extreme(code: int, x: _Jet, y: _Jet) -> _Jet:
    """Return bounds of the value and slope of fmin or fmax, from both operands where their ranges overlap."""
    low, high = (x, y) if code == ca.OP_FMIN else (y, x)
    first, second = low.value.high <= high.value.low, high.value.high <= low.value.low
    either = np.minimum(x.slope.low, y.slope.low), np.maximum(x.slope.high, y.slope.high)
    slope = bounded_where(first, x.slope, *bounded_where(second, y.slope, *either)[:2])
    return _Jet(RULES[code](x.value, y.value), slope)


def _if_else_zero(code: int, test: _Jet, x: _Jet) -> _Jet:
    holds, fails = decided_masks(test.value)
    slope = bounded_where(holds | fails, bounded_where(holds, x.slope, 0.0, 0.0))
    return _Jet(RULES[code](test.value, x.value), slope)


def _modulo(code: int, x: _Jet, y: _Jet) -> _Jet:
    multiple, known = multiple_of(x.value, y.value, np.trunc if code == ca.OP_FMOD else np.rint)
    slope = SUBTRACT(x.slope, MULTIPLY(Interval(multiple, multiple), y.slope))
    return _Jet(RULES[code](x.value, y.value), bounded_where(known, slope))


def _copysign(code: int, x: _Jet, y: _Jet) -> _Jet:
    size = _absolute(ca.OP_FABS, x).slope
    down = y.value.high < 0
    slope = Interval(np.where(down, -size.high, size.low), np.where(down, -size.low, size.high))
    return _Jet(RULES[code](x.value, y.value), bounded_where(down | (y.value.low > 0), slope))


def _angle(code: int, y: _Jet, x: _Jet) -> _Jet:
    """Return bounds of the value and slope of atan2, which jumps by a full turn on the negative x axis."""
    smooth = _smooth(code, y, x)
    continuous = (x.value.low > 0) | (y.value.low > 0) | (y.value.high < 0)
    return _Jet(smooth.value, bounded_where(continuous, smooth.slope))


_KINKED: dict[int, Callable[..., _Jet]] = {
    ca.OP_FABS: _absolute,
    ca.OP_FMIN: _extreme,
    ca.OP_FMAX: _extreme,
    ca.OP_IF_ELSE_ZERO: _if_else_zero,
    ca.OP_FMOD: _modulo,
    ca.OP_REMAINDER: _modulo,
    ca.OP_COPYSIGN: _copysign,
    ca.OP_ATAN2: _angle,
    **{
        getattr(ca, f"OP_{name}"): _piecewise_constant
        for name in ("FLOOR", "CEIL", "SIGN", "LT", "LE", "EQ", "NE", "NOT", "AND", "OR")
    },
}
"""Rules for bounds of operations that are not smooth, by the instruction code of casadi."""


FRAME_ENTRIES = 12
"""Number of entries that describe a frame: its rotation matrix column by column, then its position."""


class PrescribedMotion:
    """Motion of bodies that is a prescribed function of time alone, such as that of moving obstacles.

    Args:
        separation: The pairs of bodies. placements: Poses of their frames, possibly in other symbols than those of the
            separation. time: The symbol of time.
        parameters, values: Symbols of parameters, and their numbers.

    Raises:
        ProblemError: A frame of time and states; such a frame observed from another one than the world; an operation
            without bounds, by its name.
    """

    def __init__(
        self, separation: Separation, placements: Any, time: Any, *, parameters: Sequence[Any], values: Sequence[Any]
    ) -> None:
        what = f"separation {separation.name!r}"
        parts = [placements[k : k + FRAME_ENTRIES] for k in range(0, placements.numel(), FRAME_ENTRIES)]
        frames = [k for k, part in enumerate(parts) if ca.depends_on(part, time)]
        rows = [_as_function_of_time(f"{what}: frame {k}", parts[k], time, parameters, values) for k in frames]
        self._enclosures = Enclosures(ca.vertcat(*rows), time, what) if rows else None
        hulls = separation.bodies
        covered = CoveredPairs(separation.pairs, separation.covers)
        for first, second, seen in covered.rows:
            if seen != WORLD and {seen, hulls[first].frame, hulls[second].frame} & set(frames):
                words = f"{what}: bodies on frames that depend on time must be observed from the world, -1, not from "
                raise ProblemError(f"{words}{seen}", name="pairs", value=int(seen), limit=WORLD)
        self._bodies: list[tuple[int, np.ndarray]] = []
        self._of_pair = np.full((len(separation), 2), -1)
        for pair, side in np.ndindex(*self._of_pair.shape):
            _, indices = covered.of(np.array([pair]))
            moving = [hulls[k] for k in covered.rows[indices, side] if hulls[k].frame in frames]
            if moving:
                core = np.concatenate([hull.core for hull in moving])
                self._of_pair[pair, side] = len(self._bodies)
                self._bodies.append((frames.index(moving[0].frame), _coordinates(core)))

    def bounds(self, pair: np.ndarray, begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds of how far prescribed motion moves the bodies of given pairs within time intervals.

        Args:
            pair, begin, end: Indices of the pairs, and the ends of the intervals in the unit of the time. Shape (K,).

        Returns:
            Largest distance from the position at the middle of the interval, and from the chord between its ends. Shape
            (K,) each, m.
        """
        displacements, deviations = np.zeros(len(pair)), np.zeros(len(pair))
        mine = np.flatnonzero((self._of_pair[pair] >= 0).any(axis=1))
        if self._enclosures is None or not mine.size:
            return displacements, deviations
        ends, where = np.unique(np.stack([begin[mine], end[mine]]), axis=1, return_inverse=True)
        enclosure = self._enclosures(*ends)
        huge = 1e150  # stands for an infinite bound: its products and squares are finite
        low, high, least, most = (
            np.clip(np.nan_to_num(side, posinf=huge, neginf=-huge), -huge, huge) for side in enclosure
        )
        half = (ends[1] - ends[0])[:, None] / 2
        bodies = self._of_pair[pair[mine]]
        for body in np.unique(bodies[bodies >= 0]).tolist():
            frame, coordinates = self._bodies[body]
            entries = slice(FRAME_ENTRIES * frame, FRAME_ENTRIES * (frame + 1))
            positive, negative = np.maximum(coordinates, 0.0), np.minimum(coordinates, 0.0)
            lowest = least[:, entries] @ positive.T + most[:, entries] @ negative.T
            highest = most[:, entries] @ positive.T + least[:, entries] @ negative.T
            width = (high - low)[:, entries] @ np.abs(coordinates).T
            displacement = _longest(np.minimum(width, half * np.maximum(np.abs(lowest), np.abs(highest))))
            deviation = _longest(half / 2 * (highest - lowest))
            rows = np.flatnonzero((bodies == body).any(axis=1))  # the bodies of a pair differ
            displacements[mine[rows]] += displacement[where.ravel()[rows]]
            deviations[mine[rows]] += deviation[where.ravel()[rows]]
        return displacements, deviations


def _as_function_of_time(what: str, frame: Any, time: Any, parameters: Sequence[Any], values: Sequence[Any]) -> Any:
    """Return the pose of a frame as an expression of time alone, with numbers in place of the parameters.

    Raise ProblemError if the frame also depends on states.
    """
    known = {identity(symbol) for symbol in ca.symvar(ca.vertcat(time, *parameters))}
    others = [symbol for symbol in ca.symvar(frame) if identity(symbol) not in known]
    if others and ca.depends_on(frame, ca.vertcat(*map(ca.vec, others))):
        words = f"{what} depends on time and on states; introduce a state for the time"
        raise ProblemError(words, name="placements", value=", ".join(map(str, others)))
    function = ca.Function("frame", [time, *parameters, *others], [frame])
    return function(time, *values, *(ca.DM.zeros(other.shape) for other in others))


def _coordinates(core: np.ndarray) -> np.ndarray:
    """Return the matrix that maps the pose of a body (12 numbers) to the corners of its bounding box, both in world.

    Shape (3 C, 12) for C corners. ``core`` are the points of the body in the frame.
    """
    ends = np.stack([core.min(axis=0), core.max(axis=0)])
    corners = np.unique(np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3), axis=0)
    with_one = np.column_stack([corners, np.ones(len(corners))])
    return np.kron(with_one, np.eye(3))


def _longest(coordinates: np.ndarray) -> np.ndarray:
    """Return the length of the longest of the C vectors in each row of an array (M, 3 C). Shape (M,).

    A huge length is returned as infinite.
    """
    lengths = np.linalg.norm(coordinates.reshape(len(coordinates), -1, 3), axis=2).max(axis=1)
    return np.where(lengths < 1e100, lengths, np.inf)
