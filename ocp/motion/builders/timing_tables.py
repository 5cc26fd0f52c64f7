"""What the minimum time along a path is declared with: a reference motion, the mesh over it, and tables of the path.

The time of the reference motion is the path parameter of builders.timing. What the path asks of speed becomes a
smooth casadi function of it, polynomials between the path's corners: everything is sampled between the places where a
derivative of the path jumps, never across one, and cells are halved until their polynomials agree with the path to
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
    JointRates,
    LineLimits,
    PathLike,
    check_smooth,
    curvature_along,
    rates_along,
)
from ocp.motion.schedule.planner import schedule
from ocp.motion.schedule.profile import Array, LineMotion, SpeedProfile, segment_index

__all__ = [
    "Columns",
    "asked_speed",
    "cut",
    "demand_of_pieces",
    "distinct",
    "largest_demand",
    "path_columns",
    "reference_mesh",
    "reference_motion",
    "table",
]

Columns = Callable[[Array], Array]
"""Times (M,) to values (M, m)."""


@dataclass(frozen=True)
class TableSettings:
    """How exact the tables of a path are, and where its mesh has nodes.

    Attributes:
        degree: Of the polynomials of a table.
        accuracy: Largest error of a column, relative to its largest value.
        smallest_cell: Cells below this share of the whole are not halved further.
        halvings: Of a cell at most.
        points: Of a piece at which demands are looked at: ten times those of the collocation and the node.
        beside_jump: How far before and after a jump of the path's derivatives nodes stand, over the whole time.
        one_node: Nodes closer than this over the whole time count as one.
    """

    degree: int = 7
    accuracy: float = 1e-8
    smallest_cell: float = 1e-9
    halvings: int = 40
    points: int = 40
    beside_jump: float = 1e-6
    one_node: float = 1e-7


TABLES = TableSettings()


def table(columns: Columns, breaks: Array) -> Any:
    """casadi Function time -> values (m, 1), polynomials of degree 7 on cells that have all `breaks` among their ends.

    At a break its value is that of the cell that begins there.
    """
    nodes = (
        1 - np.cos(np.pi * (np.arange(TABLES.degree + 1) + 0.5) / (TABLES.degree + 1))
    ) / 2  # inside: no break is touched
    between = (nodes[1:] + nodes[:-1]) / 2
    fit = np.linalg.inv(_bernstein(nodes))
    start, width = breaks[:-1], np.diff(breaks)
    done: list[tuple[Array, Array]] = []
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
        done.append((start[fine], coefficients[fine]))
        half = width[~fine] / 2
        start = np.stack([start[~fine], start[~fine] + half], axis=1).ravel()
        width = np.repeat(half, 2)
    starts, pieces = (np.concatenate(parts) for parts in zip(*done, strict=True))
    order = np.argsort(starts)
    pieces = pieces[order]
    # a constant cell behind the end, which would belong to none
    pieces = np.concatenate([pieces, np.repeat(pieces[-1:, -1:], TABLES.degree + 1, axis=1)])
    ends = np.concatenate([starts[order], [breaks[-1], 2 * breaks[-1] - breaks[0]]])
    knots = np.repeat(ends, TABLES.degree + 1).tolist()
    flat = pieces.reshape(-1, pieces.shape[2])
    time = ca.MX.sym("time")
    value = ca.bspline(time, ca.DM(flat.ravel()), [knots], [TABLES.degree], flat.shape[1], {"lookup_mode": ["binary"]})
    return ca.Function("along", [time], [value])


def asked_speed(path: PathLike, limits: LineLimits, s: Array) -> Array:
    """Asked line speed at distances (M,)."""
    return np.asarray(path.by_piece(limits.speed)[segment_index(path.bounds, s)])


def path_columns(path: PathLike, limits: LineLimits, joints: JointPath | None, s: Array) -> Array:
    """Asked speed, curvature, and three derivatives of the joints by the distance, at distances (M,). Shape (M, m).

    Zero curvature where centripetal acceleration is not limited; no joints if None.

    Raises:
        ProblemError: A curvature or a joint that is not finite, joints of a wrong shape.
    """
    limited = np.isfinite(limits.centripetal)
    found = [asked_speed(path, limits, s), curvature_along(path, s) if limited else np.zeros(len(s))]
    if joints is None:
        return np.column_stack(found)
    rates = rates_along(joints, s)
    return np.column_stack([*found, rates.first, rates.second, rates.third])


def largest_demand(path: PathLike, limits: LineLimits, joints: JointPath | None, motion: LineMotion) -> Array:
    """The largest of speed, acceleration, jerk, centripetal acceleration and joint demands over its limit. Shape (M,).

    Values of the path's derivatives where they jump are those after the jump.
    """
    s = motion.distance
    rates = joints.at(s) if joints is not None and limits.joints is not None else None
    curvature = np.asarray(path.curvature(s)) if np.isfinite(limits.centripetal) else np.zeros(len(s))
    steady, power = line_demands(limits, curvature, rates)
    rows = [motion.speed / asked_speed(path, limits, s), steady[0] * motion.speed**2]
    rows += [np.abs(motion.acceleration) / limits.acceleration, np.abs(motion.jerk) / limits.jerk]
    if rates is not None:
        velocities = steady[1:][power[1:] == 1]
        rows += [*(velocities * motion.speed), *joint_demands(limits, rates, motion)]
    return np.asarray(np.max(rows, axis=0))


def line_demands(limits: LineLimits, curvature: Array | None, rates: JointRates | None) -> tuple[Array, Array]:
    """Demand over limit at unit, steady line speed, and the power of the speed it grows with.

    Of centripetal acceleration, then of velocity, acceleration and jerk of each joint: v^p demand <= 1. Shape (C, M)
    and (C,).
    """
    count = 0 if rates is None else len(rates.first)
    rows = [np.zeros((1, count)) if curvature is None else curvature[None] / limits.centripetal]
    powers = [2.0]
    if rates is not None:
        number = rates.first.shape[1]
        bounds = limits.of_joints(number)
        for order, derivative in enumerate((rates.first, rates.second, rates.third)):
            rows.append(np.abs(derivative.T) / bounds[order][:, None])
            powers += [order + 1.0] * number
    return np.concatenate(rows), np.array(powers)


def joint_demands(limits: LineLimits, rates: JointRates, motion: LineMotion) -> Array:
    """Joint acceleration and jerk over their limits during a motion: q'' v^2 + q' a, q''' v^3 + 3 q'' v a + q' j.

    Shape (2 n, M).
    """
    v, a, j = (value[:, None] for value in (motion.speed, motion.acceleration, motion.jerk))
    _, most, jerks = limits.of_joints(rates.first.shape[1])
    accelerations = (rates.second * v**2 + rates.first * a) / most
    jerk = (rates.third * v**3 + 3 * rates.second * v * a + rates.first * j) / jerks
    return np.asarray(np.abs(np.concatenate([accelerations.T, jerk.T])))


def demand_of_pieces(path: PathLike, limits: LineLimits, joints: JointPath | None, profile: SpeedProfile) -> Array:
    """Largest demand inside each piece of a profile, from either side where the path jumps. Shape (K,)."""
    inside = (np.arange(TABLES.points) + 0.5) / TABLES.points
    inside[0], inside[-1] = 1e-9, 1 - 1e-9
    motion = profile.at((profile.t[:-1, None] + np.diff(profile.t)[:, None] * inside).ravel())
    distance = np.clip(motion.distance, 0.0, path.length)
    found = largest_demand(path, limits, joints, motion._replace(distance=distance))
    return np.asarray(found.reshape(-1, TABLES.points).max(axis=1))


def _bernstein(x: Array) -> Array:
    """Values of the Bernstein polynomials of the degree of a table at x. Shape (len(x), degree + 1)."""
    return np.stack(
        [comb(TABLES.degree, i) * x**i * (1 - x) ** (TABLES.degree - i) for i in range(TABLES.degree + 1)], axis=1
    )


def reference_motion(path: PathLike, limits: LineLimits, joints: JointPath | None) -> SpeedProfile:
    """A schedule's motion; where none is found, an even slower one that surely keeps all limits."""
    try:
        return schedule(path, limits, joints=joints).profile
    except ProblemError:
        check_smooth(path, limits, joints)  # what no motion keeps is refused here
    quick = schedule(path, LineLimits(limits.speed, limits.acceleration, limits.jerk)).profile
    # slower by a factor in time: velocities shrink with it, accelerations with its square, jerks with its cube
    fractions = np.linspace(0, 1, 2001)
    motion = quick.at(quick.duration * fractions)
    rates = None if joints is None else joints.at(motion.distance)
    steady, power = line_demands(limits, np.asarray(path.curvature(motion.distance)), rates)
    slower = [(steady[power == 1] * motion.speed).max(initial=1.0), np.sqrt(steady[0] * motion.speed**2).max()]
    if joints is not None and rates is not None:
        whole = joint_demands(limits, rates, motion)
        count = len(joints.names)
        slower += [np.sqrt(whole[:count]).max(), np.cbrt(whole[count:]).max()]
    c = 1.05 * float(max(slower))
    return SpeedProfile(quick.t * c, quick.distance, quick.speed / c, quick.acceleration / c**2, quick.jerk / c**3)


def distinct(values: Array, apart: float) -> Array:
    """Sorted, without those that follow another one closer than that; the last one stays."""
    kept = np.sort(values)
    kept = kept[np.concatenate([[True], np.diff(kept) > apart])]
    kept[-1] = values.max()
    return np.asarray(kept)


def reference_mesh(reference: SpeedProfile, joins: Array, span: tuple[float, float], intervals: int) -> Array:
    """Fractions of a span of the reference's time, at least `intervals` over all of it, none longer than the others.

    Args:
        reference: Changes of its jerk become nodes.
        joins: Its times where the path's derivatives jump: nodes stand on both sides. Shape (B,), s.
        span: s.
    """
    whole, (begin, end) = reference.duration, span
    just = TABLES.beside_jump * whole
    joins = joins[(joins > begin + 2 * just) & (joins < end - 2 * just)]
    sides = np.concatenate([joins - just, joins + just])
    changes = reference.t[
        (reference.t > begin + TABLES.one_node * whole) & (reference.t < end - TABLES.one_node * whole)
    ]
    if sides.size:
        changes = changes[np.abs(changes[:, None] - sides).min(axis=1) > 2 * just]
    nodes = distinct(np.concatenate([[begin, end], sides, changes]), TABLES.one_node * whole)
    parts = np.maximum(np.ceil(np.diff(nodes) / (whole / intervals) - 1e-9), 1).astype(int)
    mesh = cut(nodes, parts)
    fractions = (mesh - begin) / (end - begin)
    fractions[0], fractions[-1] = 0.0, 1.0
    return np.asarray(fractions)


def cut(nodes: Array, parts: NDArray[np.intp]) -> Array:
    """Nodes (N + 1,) with each interval cut into equal parts (N,)."""
    first = np.cumsum(parts) - parts
    step = np.arange(parts.sum()) - np.repeat(first, parts)
    return np.append(np.repeat(nodes[:-1], parts) + np.repeat(np.diff(nodes) / parts, parts) * step, nodes[-1])
