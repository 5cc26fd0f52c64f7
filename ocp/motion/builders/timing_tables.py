"""Reference motion, mesh and tabulated path quantities of the minimum-time problem in builders.timing.

The time of the reference motion is the path parameter of builders.timing. The quantities of the path that limit the
speed become smooth casadi functions of it, polynomials between the joins of the path. Samples lie between the places
where a derivative of the path jumps, and intervals are halved until their polynomials agree with the path to
`TABLES.accuracy`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import comb
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ocp.errors import ProblemError
from ocp.motion.schedule.limits import (
    JointPath,
    LineLimits,
    PathLike,
    check_smooth,
    curvature_along,
    limit_rows,
    rates_along,
)
from ocp.motion.schedule.planner import schedule
from ocp.motion.tasks.speed_profile import Array, LineMotion, SpeedProfile, segment_index

Columns = Callable[[Array], Array]
"""Type of a function that returns C quantities of a path, shape (M, C), at times (M,) of the reference motion."""


@dataclass(frozen=True)
class TableSettings:
    """Settings of the tables of path quantities, and of the mesh of the minimum-time problem."""

    degree: int = 7  # degree of the polynomials of a table
    accuracy: float = 1e-8  # largest error of a tabulated quantity, relative to its largest value
    smallest_cell: float = 1e-9  # width of an interval that is not halved further, relative to the whole
    halvings: int = 40  # largest number of halvings of an interval
    # points of an interval at which ratios to limits are evaluated, ten for each collocation point and node
    points: int = 40
    beside_jump: float = 1e-6  # distance of nodes from a jump of the path's derivatives, relative to the whole time
    same_node: float = 1e-7  # distance of nodes that count as one, relative to the whole time


TABLES = TableSettings()


def table(columns: Columns, breaks: Array) -> Any:
    """Return a casadi Function that approximates path quantities over time by piecewise polynomials of degree 7.

    Intervals between `breaks` are halved as far as necessary. At a break the interval that begins there applies.
    """
    nodes = (
        1 - np.cos(np.pi * (np.arange(TABLES.degree + 1) + 0.5) / (TABLES.degree + 1))
    ) / 2  # inside the interval, off the breaks
    between = (nodes[1:] + nodes[:-1]) / 2
    fit = np.linalg.inv(_bernstein(nodes))
    start, width = breaks[:-1], np.diff(breaks)
    finished: list[tuple[Array, Array]] = []
    scale: Array | None = None
    for number in range(TABLES.halvings):
        if not start.size:
            break
        places = np.concatenate([nodes, between])
        values = columns((start[:, None] + width[:, None] * places).ravel()).reshape(len(start), len(places), -1)
        if scale is None:
            scale = np.maximum(np.abs(values).max(axis=(0, 1)), 1e-300)
        coefficients = np.einsum("ij,cjm->cim", fit, values[:, : len(nodes)])
        error = np.abs(np.einsum("ij,cjm->cim", _bernstein(between), coefficients) - values[:, len(nodes) :])
        fine = ((error <= TABLES.accuracy * scale).all(axis=(1, 2))) | (
            width < TABLES.smallest_cell * (breaks[-1] - breaks[0])
        )
        fine |= number == TABLES.halvings - 1
        finished.append((start[fine], coefficients[fine]))
        half = width[~fine] / 2
        start = np.stack([start[~fine], start[~fine] + half], axis=1).ravel()
        width = np.repeat(half, 2)
    starts, cells = (np.concatenate(parts) for parts in zip(*finished, strict=True))
    order = np.argsort(starts)
    cells = cells[order]
    # a constant polynomial behind the end, which belongs to no other interval
    cells = np.concatenate([cells, np.repeat(cells[-1:, -1:], TABLES.degree + 1, axis=1)])
    ends = np.concatenate([starts[order], [breaks[-1], 2 * breaks[-1] - breaks[0]]])
    knots = np.repeat(ends, TABLES.degree + 1).tolist()
    flat = cells.reshape(-1, cells.shape[2])
    time = ca.MX.sym("time")
    value = ca.bspline(time, ca.DM(flat.ravel()), [knots], [TABLES.degree], flat.shape[1], {"lookup_mode": ["binary"]})
    return ca.Function("along", [time], [value])


def speed_limit(path: PathLike, limits: LineLimits, s: Array) -> Array:
    """Return the limit of the speed along a path at distances (M,) from its start. Shape (M,), m/s."""
    return np.asarray(path.by_piece(limits.speed)[segment_index(path.bounds, s)])


def path_columns(path: PathLike, limits: LineLimits, joints: JointPath | None, s: Array) -> Array:
    """Return speed limit, curvature, and first three derivatives of the joint positions at distances (M,) along a path.

    The curvature is zero if the centripetal acceleration is not limited. Shape (M, C).

    Raises:
        ProblemError: A curvature or a joint is not finite, or the joints have a wrong shape.
    """
    limited = np.isfinite(limits.centripetal)
    columns = [speed_limit(path, limits, s), curvature_along(path, s) if limited else np.zeros(len(s))]
    if joints is None:
        return np.column_stack(columns)
    rates = rates_along(joints, s)
    return np.column_stack([*columns, rates.first, rates.second, rates.third])


def largest_demand(path: PathLike, limits: LineLimits, joints: JointPath | None, motion: LineMotion) -> Array:
    """Return the largest ratio of a limited quantity to its limit at each sample of a motion along a path. Shape (M,).

    Torques are not among the quantities. Where the path's derivatives jump, the values after the jump count.
    """
    usage = np.abs(limit_rows(path, limits, joints, motion.distance, torques=False).usage(motion))
    usage[:, 0] **= 2  # the speed at the centripetal limit, of which the acceleration is the square
    return np.asarray(np.maximum(motion.speed / speed_limit(path, limits, motion.distance), usage.max(axis=1)))


def demand_of_intervals(path: PathLike, limits: LineLimits, joints: JointPath | None, profile: SpeedProfile) -> Array:
    """Return the largest ratio of a limited quantity to its limit in each interval of a speed profile. Shape (K,)."""
    inside = (np.arange(TABLES.points) + 0.5) / TABLES.points
    inside[0], inside[-1] = 1e-9, 1 - 1e-9
    motion = profile.at((profile.t[:-1, None] + np.diff(profile.t)[:, None] * inside).ravel())
    distance = np.clip(motion.distance, 0.0, path.length)
    demand = largest_demand(path, limits, joints, motion._replace(distance=distance))
    return np.asarray(demand.reshape(-1, TABLES.points).max(axis=1))


def _bernstein(x: Array) -> Array:
    """Return the Bernstein polynomials of degree `TABLES.degree` at points x. Shape (len(x), degree + 1)."""
    return np.stack(
        [comb(TABLES.degree, i) * x**i * (1 - x) ** (TABLES.degree - i) for i in range(TABLES.degree + 1)], axis=1
    )


def reference_motion(path: PathLike, limits: LineLimits, joints: JointPath | None) -> SpeedProfile:
    """Return a speed profile within all limits along a path, from `schedule` or, if that fails, a slower profile."""
    try:
        return schedule(path, limits, joints=joints).profile
    except ProblemError:
        check_smooth(path, limits, joints)  # raises if no motion satisfies the limits
    quick = schedule(path, LineLimits(limits.speed, limits.acceleration, limits.jerk)).profile
    # slowed down by a factor: velocities shrink with it, accelerations with its square, jerks with its cube
    motion = quick.at(quick.duration * np.linspace(0, 1, 2001))
    rows = limit_rows(path, limits, joints, motion.distance, torques=False)
    ends = np.cumsum([kind.shape[1] for kind in rows])[:-1]
    kinds = np.split(np.abs(rows.usage(motion)), ends, axis=1)
    c = 1.05 * max(float(kind.max(initial=1.0)) ** (1 / (order + 1)) for order, kind in enumerate(kinds))
    return SpeedProfile(quick.t * c, quick.distance, quick.speed / c, quick.acceleration / c**2, quick.jerk / c**3)


def distinct(values: Array, tolerance: float) -> Array:
    """Sort values and drop each value that exceeds the one before by at most a tolerance; the largest one is kept."""
    ordered = np.sort(values)
    ordered = ordered[np.concatenate([[True], np.diff(ordered) > tolerance])]
    ordered[-1] = values.max()
    return np.asarray(ordered)


def reference_mesh(reference: SpeedProfile, joins: Array, span: tuple[float, float], intervals: int) -> Array:
    """Return the mesh nodes of the minimum-time problem as fractions of its horizon.

    Args:
        reference: Reference motion; the changes of its jerk become nodes.
        joins: Times at which the path's derivatives jump; nodes are placed on both sides. Shape (B,), s.
        span: Start and end of the problem in the time of the reference motion, s.
        intervals: Least number of intervals over the whole time.
    """
    whole, (begin, end) = reference.duration, span
    beside = TABLES.beside_jump * whole
    joins = joins[(joins > begin + 2 * beside) & (joins < end - 2 * beside)]
    sides = np.concatenate([joins - beside, joins + beside])
    changes = reference.t[
        (reference.t > begin + TABLES.same_node * whole) & (reference.t < end - TABLES.same_node * whole)
    ]
    if sides.size:
        changes = changes[np.abs(changes[:, None] - sides).min(axis=1) > 2 * beside]
    nodes = distinct(np.concatenate([[begin, end], sides, changes]), TABLES.same_node * whole)
    parts = np.maximum(np.ceil(np.diff(nodes) / (whole / intervals) - 1e-9), 1).astype(int)
    mesh = subdivide(nodes, parts)
    fractions = (mesh - begin) / (end - begin)
    fractions[0], fractions[-1] = 0.0, 1.0
    return np.asarray(fractions)


def subdivide(nodes: Array, parts: NDArray[np.intp]) -> Array:
    """Divide each of the N intervals of a mesh into a given number of equal parts; return the nodes of the new mesh."""
    first = np.cumsum(parts) - parts
    step = np.arange(parts.sum()) - np.repeat(first, parts)
    return np.append(np.repeat(nodes[:-1], parts) + np.repeat(np.diff(nodes) / parts, parts) * step, nodes[-1])
