"""Check the data of a trajectory file before its limits are checked, and return the motion without faulty data.

The checks find unknown and missing joints, values that are not numbers, times that do not increase, units other than
radians, metres and seconds, jumps, wrapped turns, and mimic joints that do not follow. Each is a fault with name and
time; the corrected motion is then checked further, as the fault says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

import numpy as np

from models import Robot
from models.checks import Array
from ocp.app.check.interpolation import Indices, Motion, half_digits
from ocp.app.files import RawTrajectory
from ocp.errors import ProblemError
from ocp.motion.tasks.limits import JointBounds


@dataclass(frozen=True)
class DataThresholds:
    """Thresholds for implausible positions, jumps, sample times and signs of exchanged joints in a trajectory file.

    Attributes:
        wild: Relative to a limit, plus 1 rad or m: a position beyond it is unlikely to be in rad or m.
        leap: A step is a jump if its velocity differs from those around it by this many times their spread, and by more
            than their median.
        hardest: Acceleration of a single step that counts as a jump, rad/s^2 or m/s^2; industrial arms reach about 30.
        around: Number of steps before and after one that are compared with it; their median ignores one outlier.
        longest_step: Time between samples, s, that no controller exceeds.
        tip_samples: Samples at which the tip is computed for exchanged joints.
        straight, even: A tip path is straight, or its speed constant, below this distance from a line over its length,
            or this relative standard deviation. Both are far below the values of arbitrary joint motions.
    """

    wild: float = 1.5
    leap: float = 10.0
    hardest: float = 50.0
    around: int = 3
    longest_step: float = 1000.0
    tip_samples: int = 65
    straight: float = 3e-4
    even: float = 5e-4


THRESHOLDS = DataThresholds()
SMALL_UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
FACTORS = {
    180 / np.pi: "degrees per second",
    np.pi / 180: "radians per second where the positions are degrees",
    30 / np.pi: "turns per minute",
    1000.0: "",
    1e-3: "per millisecond",
    -1.0: "of the opposite sign",
}
"""Ratios of a file's velocities to the time derivatives of its positions, and the unit that each ratio suggests."""


@dataclass(frozen=True)
class Fault:
    """A fault of a trajectory, such as a violated limit or a jump: what is wrong, where, and by how much.

    Attributes:
        kind: "jump", "velocity", "clearance", "suspicion", ...
        name: Joint, pair of bodies, or waypoint; "" if it concerns the whole trajectory.
        text: Description of the fault.
        time: Time of the worst violation, s; None if it holds throughout.
        first: Time of the first violation, s.
        value, limit: Worst value and allowed value.
        unit: Unit of both values.
        line: Line in the file, if the fault is in one line.
    """

    kind: str
    name: str
    text: str
    time: float | None = None
    first: float | None = None
    value: float | None = None
    limit: float | None = None
    unit: str = ""
    line: int | None = None

    def __str__(self) -> str:
        where = f"{self.name}: " if self.name else ""
        return f"{self.kind}: {where}{self.text}"


@dataclass(frozen=True, eq=False)
class CleanedTrajectory:
    """Trajectory without its invalid samples, so that the other samples can be checked.

    Attributes:
        joints: Indices of its joints in the robot's joint vector. Shape (k,).
        motion: Motion of these joints.
        faults, notes: Faults of the data, and remarks on data that were ignored or interpreted.
        base: Configuration of a floating base over time, or None. Shape (M, 3) or (M, 7).
        efforts: Efforts of these joints, or None. Shape (M, k).
        samples: Number of samples in the file.
    """

    joints: Indices
    motion: Motion
    faults: list[Fault] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    base: Array | None = None
    efforts: Array | None = None
    samples: int = 0


PLANAR_BASE = ("base.x", "base.y", "base.angle")
BASES = (("base.x", "base.y", "base.z", "base.qw", "base.qx", "base.qy", "base.qz"), PLANAR_BASE)
"""Names of the file columns for the configuration of a floating base: first of a spatial, then of a planar base."""


def clean_trajectory(
    raw: RawTrajectory, robot: Robot, bounds: JointBounds, *, unit_known: bool = False, unwrap: bool = False
) -> CleanedTrajectory:
    """Return the part of a trajectory that can be checked, and the faults of its data.

    Args:
        raw: The trajectory as written.
        robot: The robot that it moves.
        bounds: Limits of the joint vector.
        unit_known: Whether the times are known to be in seconds.
        unwrap: Unwrap joints with limits; wrapped values are then a note instead of a fault.

    Raises:
        ProblemError: No joint of the robot, or no sample without a fault, is left.
    """
    faults: list[Fault] = []
    notes = list(raw.notes)
    base_names = next((names for names in BASES if set(names) <= set(raw.names)), ())
    columns, joints = _columns(raw, robot, base_names, faults, notes)
    used = [*columns, *(raw.names.index(name) for name in base_names)]
    finite_rows = _finite(raw, used, joints, faults, notes)
    rows = _in_order(raw, finite_rows, faults)
    t, q = raw.t[rows], raw.positions[rows][:, columns]
    v, a, efforts = (
        None if values is None or not np.isfinite(values[finite_rows][:, columns]).all() else values[rows][:, columns]
        for values in (raw.velocities, raw.accelerations, raw.efforts)
    )
    for kind, values, usable in (("velocities", raw.velocities, v), ("accelerations", raw.accelerations, a)):
        if values is not None and usable is None:
            notes.append(f"{kind} are not given for every joint and are not used")
    if v is None and a is not None:
        notes.append("accelerations without velocities are ignored")
        a = None
    base = raw.positions[rows][:, used[len(columns) :]] if base_names else None
    names = [robot.joint_names[k] for k in joints]
    kinds = [robot.joint(name).kind for name in names]
    limits = bounds.lower[joints], bounds.upper[joints], bounds.velocity[joints]
    t = t if unit_known else _in_seconds(t, q, limits[2], faults)
    q, v, a = _in_units(t, q, v, a, names, kinds, limits, faults)
    if len(t) == 1:
        notes.append("one sample is a configuration, not a motion: it is checked as a rest of one second")
        t = np.array([t[0], t[0] + 1.0])
        q = np.repeat(q, 2, axis=0)
        v, a, efforts, base = (None if x is None else np.repeat(x, 2, axis=0) for x in (v, a, efforts, base))
    q, wrapped = _unwrap(t, q, names, kinds, limits, notes)
    faults += [] if unwrap else wrapped
    notes += [f"{fault.name} {fault.text}" for fault in wrapped] if unwrap else []
    t = _time_by_velocities(t, q, v, names, faults)
    _jumps(t, q, names, kinds, limits[2], faults)
    _followers(raw, robot, rows, faults)
    return CleanedTrajectory(joints, Motion(t, q, v, a), faults, notes, base, efforts, len(raw.t))


def _columns(
    raw: RawTrajectory, robot: Robot, base: Sequence[str], faults: list[Fault], notes: list[str]
) -> tuple[list[int], Indices]:
    """Match the columns of a file to the robot's joints; return the indices of the matching columns and of their
    joints.
    """
    names = robot.joint_names
    joints = [k for k, name in enumerate(names) if name in raw.names]
    missing = [name for name in names if name not in raw.names]
    unknown = []
    for name in raw.names:
        if name in names or name in base:
            continue
        joint = {joint.name: joint for joint in robot.joints}.get(name)
        if joint is None:
            unknown.append(name)
        elif not joint.moves:
            notes.append(f"{name} is fixed in the robot; its column is ignored")
    for name in unknown:
        similar = get_close_matches(name, missing, n=1, cutoff=0.7)
        if raw.names_are_joints or similar:
            hint = f"; is it {similar[0]}?" if similar else ""
            faults.append(Fault("unknown joint", name, f"the robot has no joint of that name{hint}"))
        else:
            notes.append(f"column {name} is not a joint of the robot and is ignored")
    if not joints:
        words = (
            f"{raw.file}: none of its columns is a joint of {robot.name!r}: it has {', '.join(raw.names[:12])}, the "
            f"robot {', '.join(names)}"
        )
        raise ProblemError(words, name="joints", value=raw.names, limit=names)
    followers = {joint.mimic.joint: joint.name for joint in robot.joints if joint.mimic and joint.name in raw.names}
    for name in missing:
        hint = "lock it: --lock"
        if name in followers:
            hint = f"its follower {followers[name]} is given: give the joint itself"
        faults.append(Fault("missing joint", name, f"the trajectory has no positions for it; {hint}"))
    return [raw.names.index(names[k]) for k in joints], np.array(joints)


def _finite(raw: RawTrajectory, used: list[int], joints: Indices, faults: list[Fault], notes: list[str]) -> Indices:
    """Return the indices (K,) of samples whose values are all finite; append faults about all others to `faults`."""
    finite = np.isfinite(raw.t)
    if not finite.all():
        k = int(np.flatnonzero(~finite)[0])
        faults.append(Fault("not a number", "time", _count(~finite, raw, k), None, line=int(raw.lines[k])))
    quantities = {"": raw.positions, "velocity of ": raw.velocities, "acceleration of ": raw.accelerations}
    for kind, values in quantities.items():
        if values is None:
            continue
        for column, joint in zip(used, [*joints, *[None] * len(used)], strict=False):
            invalid = ~np.isfinite(values[:, column])
            if not invalid.any() or (kind and (joint is None or invalid.all())):
                continue
            k = int(np.flatnonzero(invalid)[0])
            name = raw.names[column]
            time = float(raw.t[k]) if np.isfinite(raw.t[k]) else None
            text = kind + _count(invalid, raw, k)
            faults.append(Fault("not a number", name, text, time, time, line=int(raw.lines[k])))
            finite &= ~invalid
    if not finite.any():
        words = f"{raw.file}: every sample has a value that is not a number"
        raise ProblemError(words, name=raw.names[used[0]], value=len(raw.t))
    if not finite.all():
        notes.append(
            f"{int((~finite).sum())} of {len(finite)} samples have a value that is not a number and are left out"
        )
    return np.flatnonzero(finite)


def _count(invalid: Any, raw: RawTrajectory, k: int) -> str:
    """Return a text that states the number of invalid values, and the time and line of the first one, in sample k."""
    count = int(invalid.sum())
    text = f"{count} values are not numbers, the first" if count > 1 else "a value is not a number,"
    return f"{text} at {raw.t[k]:.6g} s (line {raw.lines[k]})"


def _in_order(raw: RawTrajectory, finite_rows: Indices, faults: list[Fault]) -> Indices:
    """Return the indices of samples in order of time; append faults for decreasing or repeated times to `faults`."""
    t = raw.t[finite_rows]
    steps = np.diff(t)
    descriptions = (steps < 0, "goes back from {:.6g} s to {:.6g} s"), (steps == 0, "{:.6g} s is repeated")
    for violated, words in descriptions:
        if violated.any():
            k = int(np.flatnonzero(violated)[0])
            more = f", and {int(violated.sum()) - 1} times more" if violated.sum() > 1 else ""
            line, time = int(raw.lines[finite_rows[k + 1]]), float(t[k + 1])
            text = words.format(t[k], t[k + 1]) + f" at line {line}{more}"
            faults.append(Fault("times", "", f"time {text}; times must increase", time, time, line=line))
    return np.asarray(finite_rows[np.unique(t, return_index=True)[1]])


def likely_unit(t: Array, q: Array, velocity: Array) -> tuple[str, float]:
    """Return the unit below 1 s in which sample times give plausible joint speeds, "" if there is none, and a speed.

    The speed is that of the fastest joint, relative to its limit, if the times are in seconds. Plausible are samples at
    10 kHz or less, and a fastest joint at 1 to 1000 % of its limit, or of 1 if it has none.
    """
    h, usual = np.diff(t), np.where(np.isfinite(velocity), velocity, 1.0)
    used = float((np.abs(np.diff(q, axis=0)) / h[:, None] / usual).max())
    fits = [unit for unit, n in SMALL_UNITS.items() if 1e-2 <= used * n <= 10 and np.median(h) >= 1e-4 * n]
    return fits[-1] if fits else "", used


def _in_seconds(t: Array, q: Array, velocity: Array, faults: list[Fault]) -> Array:
    """Return the times in seconds; whole numbers that lie far apart are taken for milliseconds or a smaller unit."""
    if len(t) < 3 or not (t == np.rint(t)).all() or (step := float(np.median(np.diff(t)))) < THRESHOLDS.longest_step:
        return t
    unit = likely_unit(t, q, velocity)[0] or ("nanoseconds" if step >= 1e5 else "microseconds")
    words = f"times look like {unit}: whole numbers, {step:.6g} apart; the rest of the check takes them as {unit}"
    faults.append(Fault("units", "time", words, None, None, step, THRESHOLDS.longest_step, "s"))
    return t / SMALL_UNITS[unit]


def _in_units(
    t: Array,
    q: Array,
    v: Array | None,
    a: Array | None,
    names: Sequence[str],
    kinds: Sequence[str],
    limits: tuple[Array, Array, Array],
    faults: list[Fault],
) -> tuple[Array, Array | None, Array | None]:
    """Return positions, velocities and accelerations in rad and m, converted if they seem to be in degrees or mm."""
    lower, upper, _ = limits
    bound, scale = np.maximum(np.abs(lower), np.abs(upper)), np.ones(len(names))
    margin = 0.05 * np.where(np.isfinite(bound), upper - lower, 1.0)

    def doubt(k: int, unit: str, why: str, plain: str) -> None:
        at = int(np.abs(q[:, k]).argmax())
        words = (
            f"positions look like {unit}: {q[at, k]:.5g} at {t[at]:.6g} s, {why}; the rest of the check takes them as "
            f"{unit}"
        )
        faults.append(Fault("units", names[k], words, float(t[at]), None, float(q[at, k]), float(bound[k]), plain))

    turning = [k for k, kind in enumerate(kinds) if kind != "prismatic"]
    worst = _worst_in_degrees(t, q, turning, limits, margin)
    if worst is not None:
        doubt(worst, "degrees", "in rad beyond any limit, while in degrees all joints keep theirs", "rad")
        scale[turning] = np.pi / 180
    for k, kind in enumerate(kinds):
        in_m, largest = q[:, k] * 1e-3, np.abs(q[:, k]).max()
        fits = ((in_m >= lower[k] - margin[k]) & (in_m <= upper[k] + margin[k])).all()
        if kind == "prismatic" and np.isfinite(bound[k]) and largest > max(10 * bound[k], 1.0) and fits:
            doubt(k, "millimetres", f"limits {lower[k]:g} .. {upper[k]:g} m", "m")
            scale[k] = 1e-3
    return q * scale, None if v is None else v * scale, None if a is None else a * scale


def _worst_in_degrees(
    t: Array, q: Array, turning: Sequence[int], limits: tuple[Array, Array, Array], margin: Array
) -> int | None:
    """Return the joint with the largest position if the positions seem to be in degrees instead of rad; else None.

    At least half of the moving joints must be impossible in rad. If no joint has position limits, their velocities are
    compared with the velocity limits instead.
    """
    lower, upper, velocity = limits
    largest, bound, in_degrees = np.abs(q).max(axis=0), np.maximum(np.abs(lower), np.abs(upper)), np.deg2rad(q)
    limited = [k for k in turning if np.isfinite(bound[k])]
    if limited:
        wild = [k for k in limited if largest[k] > max(THRESHOLDS.wild * bound[k] + 1, 2 * np.pi)]
        moving = [k for k in limited if np.ptp(q[:, k]) > 0 or largest[k] > 0]
        inside = (in_degrees >= lower - margin) & (in_degrees <= upper + margin)
        possible = bool(inside[:, limited].all())
    else:
        speeds = np.zeros(q.shape[1])
        if len(t) > 1:
            speeds = np.median(np.abs(np.diff(np.unwrap(q, axis=0), axis=0)) / np.diff(t)[:, None], axis=0)
        wild, moving = [k for k in turning if speeds[k] > velocity[k]], list(turning)
        possible = all(np.deg2rad(speeds[k]) <= velocity[k] for k in turning) and largest.max() > 2 * np.pi
    suspected = wild and 2 * len(wild) >= len(moving) and possible
    return max(wild, key=lambda k: largest[k]) if suspected else None


def _unwrap(
    t: Array, q: Array, names: Sequence[str], kinds: Sequence[str], limits: tuple[Array, ...], notes: list[str]
) -> tuple[Array, list[Fault]]:
    """Return positions without jumps by full turns, and a fault for each joint with limits that had such a jump.

    For a joint with limits, a jump is nearly a whole turn in a step that the joint is too slow for, or that no arm
    makes. It is removed if the limits allow, if necessary after a shift by whole turns.
    """
    unwrapped, faults, (lower, upper, velocity), h = q.copy(), [], limits, np.diff(t)
    for k, kind in enumerate(kinds):
        continued, steps = np.unwrap(q[:, k]), np.diff(q[:, k])
        leaps = np.abs(np.diff(continued) - steps) > np.pi
        if kind != "continuous":
            swift = (np.abs(steps) > velocity[k] * h) | (np.abs(steps) > THRESHOLDS.hardest * h**2)
            leaps &= swift & (np.abs(np.diff(continued)) < 0.5)
            continued = q[:, k] - np.cumsum([0.0, *np.where(leaps, steps - np.diff(continued), 0.0)])
            if continued.min() < lower[k] or continued.max() > upper[k]:
                continued += (
                    2 * np.pi * np.rint((lower[k] + upper[k] - continued.min() - continued.max()) / (4 * np.pi))
                )
        if kind == "prismatic" or not leaps.any() or continued.min() < lower[k] or continued.max() > upper[k]:
            continue
        unwrapped[:, k], at = continued, int(leaps.argmax())
        words = f"is wrapped at {t[at]:.6g} s ({leaps.sum()} in all); it is unwrapped"
        if kind == "continuous":
            notes.append(f"{names[k]} {words}")
            continue
        words += " in the rest of the check, within its limits: unwrap it, or pass --unwrap if the controller does"
        faults.append(Fault("jump", names[k], words, float(t[at + 1]), float(t[at + 1]), float(steps[at]), unit="rad"))
    return unwrapped, faults


def _time_by_velocities(t: Array, q: Array, v: Array | None, names: Sequence[str], faults: list[Fault]) -> Array:
    """Return the times in s, converted if the velocities imply a smaller unit; append faults for wrong velocities."""
    if v is None or len(t) < 10:
        return t
    h = np.diff(t)[:, None]
    by_positions, stated = np.diff(q, axis=0) / h, (v[1:] + v[:-1]) / 2
    peak = np.abs(by_positions).max(axis=0)
    rough = np.median(np.abs(np.diff(by_positions, axis=0)), axis=0)
    ratios: dict[int, float] = {}
    for k in range(q.shape[1]):
        if peak[k] * (t[-1] - t[0]) < 1e-6 or rough[k] > 0.2 * peak[k] or not np.abs(stated[:, k]).any():
            continue  # at rest, too coarse to judge, or commanded to stop at every sample
        fast = np.abs(by_positions[:, k]) > 0.05 * peak[k]
        ratio = np.median(stated[fast, k] / by_positions[fast, k])
        deviation = np.median(np.abs(stated[fast, k] - ratio * by_positions[fast, k]))
        if abs(ratio - 1) > 0.2 or deviation > 0.3 * abs(ratio) * peak[k]:
            ratios[k] = float(ratio) if deviation <= 0.3 * abs(ratio) * peak[k] else np.nan
    if ratios and len(ratios) == int((peak * (t[-1] - t[0]) >= 1e-6).sum()):
        whole = np.median(list(ratios.values()))
        for unit, power in SMALL_UNITS.items():
            if abs(whole / power - 1) < 0.1:
                words = f"times look like {unit}: velocities are {whole:.4g} times those of the positions"
                words += f"; the rest of the check takes them as {unit}"
                faults.append(Fault("units", "time", words, value=float(whole)))
                return t / power
    for k, ratio in ratios.items():
        likely = next((words for factor, words in FACTORS.items() if abs(ratio / factor - 1) < 0.1), "")
        at = int(np.abs(stated[:, k] - by_positions[:, k]).argmax())
        if np.isnan(ratio):
            words = "velocities do not match its positions"
        else:
            words = f"velocities are {ratio:.4g} times those of its positions"
            words += f": they look like {likely}" if likely else ""
        pair = float(stated[at, k]), float(by_positions[at, k])
        text = f"{words}, worst at {t[at]:.6g} s: {pair[0]:.4g} given, {pair[1]:.4g} from positions"
        faults.append(Fault("units" if likely else "velocities", names[k], text, float(t[at]), None, *pair))
    return t


def _jumps(
    t: Array, q: Array, names: Sequence[str], kinds: Sequence[str], velocity: Array, faults: list[Fault]
) -> None:
    """Append a fault for each joint that moves far more between two samples than between the samples around them."""
    h = np.diff(t)
    steps = np.diff(q, axis=0)
    speeds = steps / h[:, None]
    count = len(h)
    if count < 3:
        return
    digits, around = half_digits(q), THRESHOLDS.around
    places = np.arange(count)[:, None] + np.array([d for d in range(-around, around + 1) if d])
    in_range = (places >= 0) & (places < count)
    for k, name in enumerate(names):
        neighbours = np.where(in_range, speeds[np.clip(places, 0, count - 1), k], np.nan)
        median = np.nanmedian(neighbours, axis=1)
        spread = np.nanmedian(np.abs(neighbours - median[:, None]), axis=1)
        deviation = np.abs(speeds[:, k] - median)
        spread = np.maximum(spread, np.median(deviation))  # at least the spread of the noise
        is_jump = (deviation > THRESHOLDS.leap * spread) & (deviation > np.abs(median))
        is_jump &= (deviation / h > THRESHOLDS.hardest) | (np.abs(speeds[:, k]) > velocity[k])
        is_jump &= deviation * h > np.maximum(6 * digits[k], 1e-6 * max(1.0, float(np.abs(q[:, k]).max())))
        jumps = np.flatnonzero(is_jump)
        if not jumps.size:
            continue
        unit = "m" if kinds[k] == "prismatic" else "rad"
        worst = int(jumps[np.abs(steps[jumps, k]).argmax()])
        turn = unit == "rad" and abs(abs(steps[worst, k]) - 2 * np.pi) < 0.5
        words = (
            f"jumps by {steps[worst, k]:.4g} {unit} from {t[worst]:.6g} to {t[worst + 1]:.6g} s"
            + (", a whole turn: it was wrapped, and this joint cannot turn further" if turn else "")
            + (f"; {len(jumps)} such steps, the first at {t[jumps[0]]:.6g} s" if len(jumps) > 1 else "")
        )
        times = float(t[worst + 1]), float(t[jumps[0] + 1])
        step, usual_step = float(steps[worst, k]), float(abs(median[worst]) * h[worst])
        faults.append(Fault("jump", name, words, *times, step, usual_step, unit))


def _followers(raw: RawTrajectory, robot: Robot, rows: Indices, faults: list[Fault]) -> None:
    """Append a fault for each mimic joint that does not follow the joint that it mimics."""
    for joint in robot.joints:
        if joint.mimic is None or not joint.moves or joint.name not in raw.names:
            continue
        column, ratio, offset = robot.couplings[joint.name]
        leader = robot.joint_names[column]
        if leader not in raw.names:
            continue
        actual, leading = (raw.positions[rows, raw.names.index(name)] for name in (joint.name, leader))
        deviation = np.abs(actual - (ratio * leading + offset))
        k = int(np.nanargmax(deviation)) if np.isfinite(deviation).any() else 0
        tolerance = 1e-3 * max(1e-3, float(np.nanmax(np.abs(actual), initial=0.0)))
        if not deviation[k] <= tolerance:
            time = float(raw.t[rows[k]])
            words = f"follows {leader} but deviates by {deviation[k]:.4g} {joint.unit} at {time:.6g} s"
            faults.append(Fault("follower", joint.name, words, time, time, float(deviation[k]), tolerance, joint.unit))
