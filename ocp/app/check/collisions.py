"""What a motion may touch, and where its tip goes: distances proven between the samples, and the way off a path."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from models import CollisionScene, Machine
from models.arrays import Array
from ocp.app.check.joint_limits import Row, RowVerdict
from ocp.app.check.oddities import Fault
from ocp.app.check.pieces import Motion
from ocp.app.files import Waypoints
from ocp.audit.clearance import Clearance
from ocp.motion.builders.clearance import clearance_of
from ocp.motion.local.collisions import distances_along
from ocp.problem.values import Sampler
from ocp.tolerances import CLEARANCE_TOLERANCE_M

__all__ = ["clearance_rows", "path_rows", "proof", "within_limits"]

SHOWN = 20
"""Pairs that are named."""


def within_limits(machine: Machine, motion: Motion) -> Machine:
    """The machine itself where the motion keeps its limits and its slides have some; else one with limits so wide."""
    robot = machine.robot
    low, high = (getattr(motion.position.coefficients, side)(axis=(0, 1)) for side in ("min", "max"))
    joints = []
    for joint in robot.joints:
        if joint.moves and joint.kind != "continuous":
            column, ratio, offset = robot.drives[joint.name]
            ends = sorted((ratio * float(low[column]) + offset, ratio * float(high[column]) + offset))
            lower, upper = min(joint.lower, ends[0]), max(joint.upper, ends[1])
            if joint.kind == "prismatic":
                lower, upper = (own if np.isfinite(own) else end for own, end in zip((lower, upper), ends, strict=True))
            if (lower, upper) != (joint.lower, joint.upper):
                joint = replace(joint, lower=lower, upper=upper)
        joints.append(joint)
    if all(one is other for one, other in zip(joints, robot.joints, strict=True)):
        return machine
    made: Machine = replace(machine, robot=replace(robot, joints=tuple(joints)))  # type: ignore[type-var]
    return made


def proof(around: CollisionScene, motion: Motion) -> Clearance:
    """How near each pair comes at any time of a motion, within the limits, of a machine whose base stands still."""
    start, horizon = float(motion.t[0]), float(motion.t[-1] - motion.t[0])
    rates = motion.velocity.greatest
    seconds = np.zeros_like(rates) if motion.acceleration is None else motion.acceleration.greatest
    smooth, breaks = motion.acceleration is not None, (motion.t - start) / horizon
    return clearance_of(
        around, lambda at: motion.position.at(start + at * horizon), breaks, horizon, rates, seconds, smooth
    )


def clearance_rows(around: CollisionScene, motion: Motion, bases: Array | None) -> tuple[list[Row], list[Fault]]:
    """Rows and faults of what comes too near.

    Where the base moves, `bases` (M, base_size) at the samples, pairs are looked at there and at the middles between
    them, and nothing is proven.
    """
    assumed = [f"{pair} ({why})" for pair, why in around.assumed.items()]
    left = f"left out by assumption: {', '.join(assumed)}"
    told = [Row("pairs not looked at", len(assumed), None, "", None, RowVerdict.TOLD, left)] if assumed else []
    if not len(around.pairs):
        none = Row("clearance", np.inf, around.clearance, "m", None, RowVerdict.TOLD, "no pairs that may touch")
        return [none, *told], []
    if bases is not None:
        rows, faults = _sampled(around, motion, bases)
        return [*rows, *told], faults
    found = proof(around, motion)
    start = float(motion.t[0])
    rows, faults = [], []
    proven = min(near.least for near in found.pairs)
    for near in sorted(found.pairs, key=lambda near: near.distance - near.required)[:SHOWN]:
        one, other = near.bodies
        time = start + near.time
        if near.distance < near.required - CLEARANCE_TOLERANCE_M:
            verdict, note = RowVerdict.FAILED, "touching" if near.distance < 0 else "too near"
            between = "" if np.isclose(motion.t, time, rtol=0, atol=1e-12).any() else ", between two samples"
            how = f"overlap by {-near.distance:.4g} m" if near.distance < 0 else f"are {near.distance:.4g} m apart"
            text = f"{how} at {time:.6g} s{between}, at least {near.required:g} m asked"
            faults.append(Fault("clearance", f"{one} and {other}", text, time, None, near.distance, near.required, "m"))
        elif near.missed > CLEARANCE_TOLERANCE_M:
            verdict, note = RowVerdict.UNDECIDED, f"at least {near.least:.4g} m is proven"
        else:
            least = "" if faults else f": at no time are any two nearer than {proven:.4g} m"
            verdict, note = RowVerdict.OK, f"proven{least}"
        rows.append(Row(f"clearance of {one} and {other}", near.distance, near.required, "m", time, verdict, note))
        if verdict == "ok":
            break  # what is farther is proven as well, or told as not decided
    shown = {row.name for row in rows}
    faults = _with_beginnings(around, motion, faults)
    for near in found.pairs:
        name = f"clearance of {near.bodies[0]} and {near.bodies[1]}"
        find_collisions = near.distance < near.required - CLEARANCE_TOLERANCE_M
        if near.missed > CLEARANCE_TOLERANCE_M and not find_collisions and name not in shown:
            note = f"at least {near.least:.4g} m is proven"
            rows.append(Row(name, near.distance, near.required, "m", start + near.time, RowVerdict.UNDECIDED, note))
    return [*rows, *told], faults


def _with_beginnings(around: CollisionScene, motion: Motion, faults: list[Fault]) -> list[Fault]:
    """The same faults, each with the first of the samples, or of those that are looked at, where it is one already."""
    if not faults:
        return []
    worst = np.array([fault.time for fault in faults])
    times = np.unique(np.concatenate([motion.t[:: len(motion.t) // 1000 + 1], worst]))
    base = around.machine.base_home()
    apart = distances_along(around, base, motion.position.at(times), times, around.clearance)
    columns = {f"{one} and {other}": k for k, (one, other) in enumerate(around.labels)}
    found = []
    for fault in faults:
        near = np.flatnonzero(apart[:, columns[fault.name]] < around.clearance - CLEARANCE_TOLERANCE_M)
        first = float(times[near[0]]) if near.size else fault.time
        found.append(replace(fault, first=first))
    return found


def _sampled(around: CollisionScene, motion: Motion, bases: Array) -> tuple[list[Row], list[Fault]]:
    middles = (motion.t[1:] + motion.t[:-1]) / 2
    times = np.concatenate([motion.t, middles])
    joints = motion.position.at(times)
    places = np.concatenate([bases, (bases[1:] + bases[:-1]) / 2])
    apart = distances_along(around, places, joints, times)
    rows, faults = [], []
    for pair in np.argsort(apart.min(axis=0))[:SHOWN]:
        k = int(apart[:, pair].argmin())
        one, other = around.labels[pair]
        value, time = float(apart[k, pair]), float(times[k])
        failed = value < around.clearance - CLEARANCE_TOLERANCE_M
        told = RowVerdict.of(failed), "at samples and middles; not proven between them"
        rows.append(Row(f"clearance of {one} and {other}", value, around.clearance, "m", time, *told))
        if not failed:
            break
        how = f"overlap by {-value:.4g} m" if value < 0 else f"are {value:.4g} m apart"
        text = f"{how} at {time:.6g} s, at least {around.clearance:g} m asked"
        faults.append(Fault("clearance", f"{one} and {other}", text, time, None, value, around.clearance, "m"))
    return rows, faults


# ---- the path ----------------------------------------------------------------------------------------------------


def path_rows(
    machine: Machine, motion: Motion, bases: Array | None, path: Waypoints, tolerance: float, angle: float
) -> tuple[list[Row], list[Fault]]:
    """Rows and faults of the tip's distance from the straight lines through waypoints, of theirs from its way, and of
    the lean of its z axis where they tell one.

    Looked at in four times of every piece, and the distance at the worst as fine as it takes.
    """
    base, q = ca.SX.sym("base", machine.base_size), ca.SX.sym("q", machine.joint_size)
    pose = machine.tip_pose(base, q)
    sampler = Sampler([base, q], [pose.position, pose.rotation[:, 2]])
    quarters = np.arange(4) / 4
    piece = np.repeat(np.arange(len(motion.t) - 1), len(quarters))
    place = np.tile(quarters, len(motion.t) - 1)
    times = np.append(motion.t[piece] + place * np.diff(motion.t)[piece], motion.t[-1])

    def tips(at: Array) -> list[Array]:
        places = np.zeros((len(at), 0)) if bases is None else _between(motion.t, bases, at)
        return sampler(places, motion.position.at(at))

    corners = path.positions
    way, axes = tips(times)
    off, where = _off(way, corners)
    worst = int(off.argmax())
    finer = np.linspace(times[max(worst - 1, 0)], times[min(worst + 1, len(times) - 1)], 65)
    near = _off(tips(finer)[0], corners)[0]
    value, time = max((float(off[worst]), float(times[worst])), (float(near.max()), float(finer[near.argmax()])))
    link = machine.robot.tip_link
    rows, faults = [_row("tip off the path", value, tolerance, "m", time)], []
    if value > tolerance:
        first = float(times[np.flatnonzero(off > tolerance)[0]]) if (off > tolerance).any() else time
        between = "" if time in motion.t else ", between two samples"
        text = f"the tip is {value:.4g} m off its path at {time:.6g} s{between}, {tolerance:g} m allowed"
        faults.append(Fault("path", link, text, time, first, value, tolerance, "m"))
    missed = _off(corners, way)[0]
    k = int(missed.argmax())
    rows.append(_row("waypoint off the tip's way", float(missed[k]), tolerance, "m", None))
    if missed[k] > tolerance:
        more = int((missed > tolerance).sum()) - 1
        text = f"the tip comes no nearer than {missed[k]:.4g} m, {tolerance:g} m allowed"
        text += f"; {more} others are missed, too" if more else ""
        name = f"waypoint {k + 1} (line {int(path.lines[k])})"
        faults.append(Fault("path", name, text, None, None, float(missed[k]), tolerance, "m"))
    if path.orientations is not None:
        told = _axes(path, where)
        lean = np.arccos(np.clip((told * axes).sum(axis=1), -1.0, 1.0))
        k = int(lean.argmax())
        value, time = float(lean[k]), float(times[k])
        rows.append(_row("tool axis off the path's", value, angle, "rad", time))
        if value > angle:
            first = float(times[np.flatnonzero(lean > angle)[0]])
            text = f"its z axis leans by {value:.4g} rad at {time:.6g} s, {angle:g} rad allowed"
            faults.append(Fault("path", link, text, time, first, value, angle, "rad"))
    return rows, faults


def _row(name: str, value: float, limit: float, unit: str, time: float | None) -> Row:
    bounded = bool(np.isfinite(limit))
    verdict = RowVerdict.of(value > limit) if bounded else RowVerdict.TOLD
    return Row(name, value, limit if bounded else None, unit, time, verdict)


def _axes(path: Waypoints, where: Array) -> Array:
    """The tool's z axis at places along the waypoints, K numbers with shares between. Shape (K, 3)."""
    assert path.orientations is not None
    w, x, y, z = path.orientations.T
    at_waypoints = np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    numbers = np.arange(len(at_waypoints))
    found = np.column_stack([np.interp(where, numbers, column) for column in at_waypoints.T])
    return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1), 1e-12)[:, None])


def _between(t: Array, values: Array, at: Array) -> Array:
    """Straight lines through samples; quaternions are of some length, which rotations take out. Shape (K, n)."""
    found = np.column_stack([np.interp(at, t, column) for column in values.T])
    if values.shape[1] == 7:
        found[:, 3:] /= np.linalg.norm(found[:, 3:], axis=1)[:, None]
    return found


def _off(points: Array, corners: Array) -> tuple[Array, Array]:
    """Distances of points (K, 3) from the lines through others (M, 3), and where these are nearest: the number of the
    corner before and a share of the way to the next. Shape (K,) each."""
    if len(corners) == 1:
        return np.asarray(np.linalg.norm(points - corners[0], axis=1)), np.zeros(len(points))
    found, where = np.full(len(points), np.inf), np.zeros(len(points))
    begin, way = corners[:-1], np.diff(corners, axis=0)
    long = (way * way).sum(axis=1)
    lot = max(1, 4_000_000 // len(begin))
    for first in range(0, len(points), lot):
        part = points[first : first + lot]
        to = part[:, None] - begin
        share = np.clip((to * way).sum(axis=2) / np.where(long > 0, long, 1.0), 0.0, 1.0)
        away = np.linalg.norm(to - share[:, :, None] * way, axis=2)
        k = away.argmin(axis=1)
        rows = np.arange(len(part))
        found[first : first + lot], where[first : first + lot] = away[rows, k], k + share[rows, k]
    return found, where
