"""The motion whose time is the path parameter of ocp.builders.path_timing, and the mesh over it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ocp.errors import ProblemError
from ocp.schedule.grid import make_grid
from ocp.schedule.limits import JointPath, Limits, PathLike, joint_demands, line_demands
from ocp.schedule.planner import schedule
from ocp.schedule.profile import Array, SpeedProfile

__all__ = ["cut", "distinct", "reference_mesh", "reference_motion"]

JUST = 1e-6
"""Nodes stand this far before and after a place where the path's derivatives jump, over the whole time."""
CLOSE = 1e-7
"""Nodes closer than this over the whole time count as one."""


def reference_motion(path: PathLike, limits: Limits, joints: JointPath | None) -> SpeedProfile:
    """A schedule's motion; where none is found, an even slower one that surely keeps all limits."""
    try:
        return schedule(path, limits, joints=joints).profile
    except ProblemError:
        make_grid(path, limits, joints)  # what no motion keeps is refused here
    quick = schedule(path, Limits(limits.speed, limits.acceleration, limits.jerk)).profile
    # slower by a factor in time: velocities shrink with it, accelerations with its square, jerks with its cube
    fractions = np.linspace(0, 1, 2001)
    motion = quick.at(quick.duration * fractions)
    rates = None if joints is None else joints.at(motion.distance)
    steady, power = line_demands(limits, np.asarray(path.curvature(motion.distance)), rates)
    slower = [(steady[power == 1] * motion.speed).max(initial=1.0), np.sqrt(steady[0] * motion.speed**2).max()]
    if joints is not None and rates is not None:
        whole = joint_demands(limits, rates, motion)[0]
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
    just = JUST * whole
    joins = joins[(joins > begin + 2 * just) & (joins < end - 2 * just)]
    sides = np.concatenate([joins - just, joins + just])
    changes = reference.t[(reference.t > begin + CLOSE * whole) & (reference.t < end - CLOSE * whole)]
    if sides.size:
        changes = changes[np.abs(changes[:, None] - sides).min(axis=1) > 2 * just]
    nodes = distinct(np.concatenate([[begin, end], sides, changes]), CLOSE * whole)
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
