"""Check the data of a trajectory file before its limits are checked, and return the motion without faulty data.

A fault of the data has a name and a time; the corrected motion is then checked further, as the fault says. A suspicion
that the times or the names of columns mean something else leaves the verdict undetermined until they are confirmed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import combinations

import casadi as ca
import numpy as np

from models import FixedBase, Robot
from models.checks import Array
from ocp.app.check.joint_limits import Fault, Indices, Motion, half_digits
from ocp.app.files import RawTrajectory
from ocp.errors import ProblemError
from ocp.motion.tasks.limits import JointBounds
from ocp.problem.values import Sampler


@dataclass(frozen=True)
class DataThresholds:
    """Thresholds beyond which data of a trajectory file are implausible: positions, jumps, times, exchanged joints.

    Attributes:
        wild: Relative to a limit, plus 1 rad or m: a position beyond it is unlikely to be in rad or m.
        leap: A step is a jump if its velocity differs from those around it by this many times their spread, and by more
            than their median.
        hardest: Acceleration of a single step that counts as a jump, rad/s^2 or m/s^2; industrial arms reach about 30.
        around: Number of steps before and after one that are compared with it; their median ignores one outlier.
        longest_step: Time between samples, s, that no controller exceeds.
        tip_samples: Samples at which the tip is computed for exchanged joints.
        straight, even: A tip path is straight, or its speed constant, below this distance from a line over its length,
            or this relative standard deviation. Arbitrary joint motions are far above.
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
    1e-3: "per millisecond",
    -1.0: "of the opposite sign",
}
"""Ratios of a file's velocities to the time derivatives of its positions, and the unit that each ratio suggests."""


@dataclass(frozen=True, eq=False)
class CleanedTrajectory:
    """Trajectory without its invalid samples, so that the other samples can be checked.

    Attributes:
        joints: Indices of its k joints in the robot's joint vector.
        motion: Motion of these joints.
        faults, notes: Faults of the data, and remarks on data that were ignored or interpreted.
        base, efforts: Configurations of a floating base (M, 3) or (M, 7), and efforts of the joints (M, k), or None.
        samples: Number of samples in the file.
    """

    joints: Indices
    motion: Motion
    faults: list[Fault]
    notes: list[str]
    base: Array | None
    efforts: Array | None
    samples: int


PLANAR_BASE = ("base.x", "base.y", "base.angle")
BASES = (("base.x", "base.y", "base.z", "base.qw", "base.qx", "base.qy", "base.qz"), PLANAR_BASE)
"""Names of the file columns for the configuration of a floating base: first of a spatial, then of a planar base."""


@dataclass(eq=False)
class _Samples:
    """Times (M,) and joint samples (M, k) of a file while its faults are corrected, with joint limits and faults."""

    t: Array
    q: Array
    v: Array | None
    a: Array | None
    names: list[str]
    kinds: Sequence[str]
    lower: Array
    upper: Array
    velocity: Array
    faults: list[Fault]
    notes: list[str]


def clean_trajectory(
    raw: RawTrajectory, robot: Robot, bounds: JointBounds, *, unit_known: bool = False, unwrap: bool = False
) -> CleanedTrajectory:
    """Return the part of a trajectory that can be checked, and the faults of its data.

    `bounds` are the limits of the joint vector. `unit_known` says that the times are in seconds. With `unwrap`, joints
    with limits are unwrapped too; wrapped values are then a note instead of a fault.

    Raises:
        ProblemError: No joint of the robot, or no sample without a fault, is left.
    """
    faults, notes = list[Fault](), list(raw.notes)
    base_names = next((names for names in BASES if set(names) <= set(raw.names)), ())
    columns, joints = _columns(raw, robot, base_names, faults, notes)
    used = [*columns, *(raw.names.index(name) for name in base_names)]
    finite_rows = _finite(raw, used, joints, faults, notes)
    rows = _in_order(raw, finite_rows, faults)
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
    limits = bounds.lower[joints], bounds.upper[joints], bounds.velocity[joints]
    kinds, positions = [robot.joint(name).kind for name in names], raw.positions[rows][:, columns]
    samples = _Samples(raw.t[rows], positions, v, a, names, kinds, *limits, faults, notes)
    if not unit_known:
        _convert_to_seconds(samples)
    _convert_units(samples)
    if len(samples.t) == 1:
        notes.append("one sample is a configuration, not a motion: it is checked as a rest of one second")
        samples.t = np.array([samples.t[0], samples.t[0] + 1.0])
        samples.q = np.repeat(samples.q, 2, axis=0)
        samples.v, samples.a, efforts, base = (
            None if values is None else np.repeat(values, 2, axis=0) for values in (samples.v, samples.a, efforts, base)
        )
    wrapped = _unwrap(samples)
    faults += [] if unwrap else wrapped
    notes += [f"{fault.name} {fault.text}" for fault in wrapped if unwrap]
    _check_velocities(samples)
    _check_jumps(samples)
    _check_followers(raw, robot, rows, faults)
    motion = Motion(samples.t, samples.q, samples.v, samples.a)
    return CleanedTrajectory(joints, motion, faults, notes, base, efforts, len(raw.t))


def _columns(
    raw: RawTrajectory, robot: Robot, base: Sequence[str], faults: list[Fault], notes: list[str]
) -> tuple[list[int], Indices]:
    """Match the columns of a file to the robot's joints; return the indices of the columns and of their joints."""
    names = robot.joint_names
    joints = [k for k, name in enumerate(names) if name in raw.names]
    missing = [name for name in names if name not in raw.names]
    fixed = {joint.name: not joint.moves for joint in robot.joints}
    for name in raw.names:
        if name in names or name in base or name in fixed:
            notes += [f"{name} is fixed in the robot; its column is ignored"] if fixed.get(name) else []
            continue
        similar = get_close_matches(name, missing, n=1, cutoff=0.7)
        if raw.names_are_joints or similar:
            hint = f"; is it {similar[0]}?" if similar else ""
            faults.append(Fault("unknown joint", name, f"the robot has no joint of that name{hint}"))
        else:
            notes.append(f"column {name} is not a joint of the robot and is ignored")
    if not joints:
        words = f"{raw.file}: none of its columns is a joint of {robot.name!r}: it has {', '.join(raw.names[:12])}, "
        words += f"the robot {', '.join(names)}"
        raise ProblemError(words, name="joints", value=raw.names, limit=names)
    followers = {joint.mimic.joint: joint.name for joint in robot.joints if joint.mimic and joint.name in raw.names}
    for name in missing:
        follower = followers.get(name)
        hint = f"its follower {follower} is given: give the joint itself" if follower else "lock it: --lock"
        faults.append(Fault("missing joint", name, f"the trajectory has no positions for it; {hint}"))
    return [raw.names.index(names[k]) for k in joints], np.array(joints)


def _finite(raw: RawTrajectory, used: list[int], joints: Indices, faults: list[Fault], notes: list[str]) -> Indices:
    """Return the indices (K,) of samples whose values are all finite; append faults about all others to `faults`."""
    columns = [("time", "", raw.t), *((raw.names[column], "", raw.positions[:, column]) for column in used)]
    for kind, values in (("velocity of ", raw.velocities), ("acceleration of ", raw.accelerations)):
        if values is not None:
            own = [(raw.names[column], kind, values[:, column]) for column in used[: len(joints)]]
            columns += [(name, kind, column) for name, kind, column in own if np.isfinite(column).any()]
    finite = np.ones(len(raw.t), dtype=bool)
    for name, kind, column in columns:
        invalid = ~np.isfinite(column)
        if invalid.any():
            k, count = int(invalid.argmax()), int(invalid.sum())
            text = f"{count} values are not numbers, the first" if count > 1 else "a value is not a number,"
            time = float(raw.t[k]) if np.isfinite(raw.t[k]) else None
            text = f"{kind}{text} at {raw.t[k]:.6g} s (line {raw.lines[k]})"
            faults.append(Fault("not a number", name, text, time, time, line=int(raw.lines[k])))
            finite &= ~invalid
    if not finite.any():
        words = f"{raw.file}: every sample has a value that is not a number"
        raise ProblemError(words, name=raw.names[used[0]], value=len(raw.t))
    if not finite.all():
        count = int((~finite).sum())
        notes.append(f"{count} of {len(finite)} samples have a value that is not a number and are left out")
    return np.flatnonzero(finite)


def _in_order(raw: RawTrajectory, finite_rows: Indices, faults: list[Fault]) -> Indices:
    """Return the indices of samples in order of time; append faults for decreasing or repeated times to `faults`."""
    t = raw.t[finite_rows]
    steps = np.diff(t)
    for violated, words in (steps < 0, "goes back from {:.6g} s to {:.6g} s"), (steps == 0, "{:.6g} s is repeated"):
        if violated.any():
            k = int(np.flatnonzero(violated)[0])
            more = f", and {int(violated.sum()) - 1} times more" if violated.sum() > 1 else ""
            line, time = int(raw.lines[finite_rows[k + 1]]), float(t[k + 1])
            text = words.format(t[k], t[k + 1]) + f" at line {line}{more}"
            faults.append(Fault("times", "", f"time {text}; times must increase", time, time, line=line))
    return np.asarray(finite_rows[np.unique(t, return_index=True)[1]])


# ---- units, wrapped angles, jumps --------------------------------------------------------------------------------


def likely_unit(t: Array, q: Array, velocity: Array) -> tuple[str, float]:
    """Return the unit below 1 s in which times are plausible ("" if none), and the highest speed if the unit is 1 s.

    The speed is relative to the joint's limit, or to 1 without one. Times are plausible if the samples are at 10 kHz or
    less, and the fastest joint moves at 1 to 1000 % of its limit.
    """
    h, usual = np.diff(t), np.where(np.isfinite(velocity), velocity, 1.0)
    used = float((np.abs(np.diff(q, axis=0)) / h[:, None] / usual).max())
    fits = [unit for unit, n in SMALL_UNITS.items() if 1e-2 <= used * n <= 10 and np.median(h) >= 1e-4 * n]
    return fits[-1] if fits else "", used


def _convert_to_seconds(samples: _Samples) -> None:
    """Convert times to s and add a fault if the times are whole numbers too far apart to be seconds."""
    t = samples.t
    if len(t) < 3 or not (t == np.rint(t)).all() or (step := float(np.median(np.diff(t)))) < THRESHOLDS.longest_step:
        return
    unit = likely_unit(t, samples.q, samples.velocity)[0] or ("nanoseconds" if step >= 1e5 else "microseconds")
    words = f"times look like {unit}: whole numbers, {step:.6g} apart; the rest of the check takes them as {unit}"
    samples.faults.append(Fault("units", "time", words, None, None, step, THRESHOLDS.longest_step, "s"))
    samples.t = t / SMALL_UNITS[unit]


def _convert_units(samples: _Samples) -> None:
    """Convert positions and their derivatives to rad and m if they seem to be in degrees or mm, and add faults."""
    q, lower, upper = samples.q, samples.lower, samples.upper
    bound, scale = np.maximum(np.abs(lower), np.abs(upper)), np.ones(q.shape[1])
    margin = 0.05 * np.where(np.isfinite(bound), upper - lower, 1.0)

    def doubt(k: int, unit: str, why: str, plain: str) -> None:
        at = int(np.abs(q[:, k]).argmax())
        value, time = float(q[at, k]), float(samples.t[at])
        words = f"positions look like {unit}: {value:.5g} at {time:.6g} s, {why}; "
        words += f"the rest of the check takes them as {unit}"
        samples.faults.append(Fault("units", samples.names[k], words, time, None, value, float(bound[k]), plain))

    turning = [k for k, kind in enumerate(samples.kinds) if kind != "prismatic"]
    worst = _worst_in_degrees(samples, turning, margin)
    if worst is not None:
        doubt(worst, "degrees", "in rad beyond any limit, while in degrees all joints keep theirs", "rad")
        scale[turning] = np.pi / 180
    for k in set(range(q.shape[1])) - set(turning):
        in_m, largest = q[:, k] * 1e-3, np.abs(q[:, k]).max()
        fits = ((in_m >= lower[k] - margin[k]) & (in_m <= upper[k] + margin[k])).all()
        if np.isfinite(bound[k]) and largest > max(10 * bound[k], 1.0) and fits:
            doubt(k, "millimetres", f"limits {lower[k]:g} .. {upper[k]:g} m", "m")
            scale[k] = 1e-3
    samples.q = q * scale
    samples.v, samples.a = (None if values is None else values * scale for values in (samples.v, samples.a))


def _worst_in_degrees(samples: _Samples, turning: list[int], margin: Array) -> int | None:
    """Return the joint with the largest position if the positions seem to be in degrees instead of rad; else None.

    At least half of the moving joints must be impossible in rad, by their velocities if none has position limits.
    """
    t, q, lower, upper, velocity = samples.t, samples.q, samples.lower, samples.upper, samples.velocity
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


def _unwrap(samples: _Samples) -> list[Fault]:
    """Remove jumps of joint positions by full turns; return a fault for each corrected joint that has limits.

    For a joint with limits, a jump is nearly one whole turn in a step that the joint is too slow for, or that no arm
    makes. It is removed if the limits allow, if necessary after a shift by whole turns.
    """
    t, q, lower, upper, velocity = samples.t, samples.q, samples.lower, samples.upper, samples.velocity
    unwrapped, faults, h = q.copy(), [], np.diff(t)
    for k, (name, kind) in enumerate(zip(samples.names, samples.kinds, strict=True)):
        continued, steps = np.unwrap(q[:, k]), np.diff(q[:, k])
        leaps = np.abs(np.diff(continued) - steps) > np.pi
        if kind != "continuous":
            swift = (np.abs(steps) > velocity[k] * h) | (np.abs(steps) > THRESHOLDS.hardest * h**2)
            leaps &= swift & (np.abs(np.diff(continued)) < 0.5) & (np.abs(steps) < 3 * np.pi)
            continued = q[:, k] - np.cumsum([0.0, *np.where(leaps, steps - np.diff(continued), 0.0)])
            if continued.min() < lower[k] or continued.max() > upper[k]:
                middle = (lower[k] + upper[k] - continued.min() - continued.max()) / 2
                continued += 2 * np.pi * np.rint(middle / (2 * np.pi))
        if kind == "prismatic" or not leaps.any() or continued.min() < lower[k] or continued.max() > upper[k]:
            continue
        unwrapped[:, k], at = continued, int(leaps.argmax())
        words = f"is wrapped at {t[at]:.6g} s ({leaps.sum()} in all); it is unwrapped"
        if kind == "continuous":
            samples.notes.append(f"{name} {words}")
            continue
        words += " in the rest of the check, within its limits: unwrap it, or pass --unwrap if the controller does"
        faults.append(Fault("jump", name, words, float(t[at + 1]), float(t[at + 1]), float(steps[at]), unit="rad"))
    samples.q = unwrapped
    return faults


def _check_velocities(samples: _Samples) -> None:
    """Convert the times if the velocities imply a smaller time unit, and add faults for wrong velocities."""
    t, q, v, names, faults = samples.t, samples.q, samples.v, samples.names, samples.faults
    if v is None or len(t) < 10:
        return
    by_positions, stated = np.diff(q, axis=0) / np.diff(t)[:, None], (v[1:] + v[:-1]) / 2
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
                words = f"times look like {unit}: velocities are {whole:.4g} times those of the positions; "
                words += f"the rest of the check takes them as {unit}"
                faults.append(Fault("units", "time", words, value=float(whole)))
                samples.t = t / power
                return
    for k, ratio in ratios.items():
        likely = next((words for factor, words in FACTORS.items() if abs(ratio / factor - 1) < 0.1), "")
        at = int(np.abs(stated[:, k] - by_positions[:, k]).argmax())
        words = f"are {ratio:.4g} times those of its positions" + (f": they look like {likely}" if likely else "")
        words = f"velocities {'do not match its positions' if np.isnan(ratio) else words}"
        pair = float(stated[at, k]), float(by_positions[at, k])
        text = f"{words}, worst at {t[at]:.6g} s: {pair[0]:.4g} given, {pair[1]:.4g} from positions"
        faults.append(Fault("units" if likely else "velocities", names[k], text, float(t[at]), None, *pair))


def _check_jumps(samples: _Samples) -> None:
    """Add a fault for each joint that moves far more between two samples than between neighbouring samples."""
    t, q, velocity = samples.t, samples.q, samples.velocity
    h, steps = np.diff(t), np.diff(q, axis=0)
    speeds, count = steps / h[:, None], len(h)
    if count < 3:
        return
    digits, around = half_digits(q), THRESHOLDS.around
    places = np.arange(count)[:, None] + np.array([d for d in range(-around, around + 1) if d])
    in_range = (places >= 0) & (places < count)
    for k, name in enumerate(samples.names):
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
        unit = "m" if samples.kinds[k] == "prismatic" else "rad"
        worst = int(jumps[np.abs(steps[jumps, k]).argmax()])
        turn = unit == "rad" and abs(abs(steps[worst, k]) - 2 * np.pi) < 0.5
        words = f"jumps by {steps[worst, k]:.4g} {unit} from {t[worst]:.6g} to {t[worst + 1]:.6g} s"
        words += ", a whole turn: it was wrapped, and this joint cannot turn further" if turn else ""
        words += f"; {len(jumps)} such steps, the first at {t[jumps[0]]:.6g} s" if len(jumps) > 1 else ""
        times = float(t[worst + 1]), float(t[jumps[0] + 1])
        step, usual_step = float(steps[worst, k]), float(abs(median[worst]) * h[worst])
        samples.faults.append(Fault("jump", name, words, *times, step, usual_step, unit))


def _check_followers(raw: RawTrajectory, robot: Robot, rows: Indices, faults: list[Fault]) -> None:
    """Append a fault for each mimic joint that does not follow the joint that it mimics."""
    for joint in robot.joints:
        column, ratio, offset = robot.couplings.get(joint.name, (0, 1.0, 0.0))
        leader = robot.joint_names[column]
        if joint.mimic is None or not joint.moves or not {joint.name, leader} <= set(raw.names):
            continue
        actual, leading = (raw.positions[rows, raw.names.index(name)] for name in (joint.name, leader))
        deviation = np.abs(actual - (ratio * leading + offset))
        k = int(np.nanargmax(deviation)) if np.isfinite(deviation).any() else 0
        tolerance = 1e-3 * max(1e-3, float(np.nanmax(np.abs(actual), initial=0.0)))
        if not deviation[k] <= tolerance:
            time = float(raw.t[rows[k]])
            words = f"follows {leader} but deviates by {deviation[k]:.4g} {joint.unit} at {time:.6g} s"
            faults.append(Fault("follower", joint.name, words, time, time, float(deviation[k]), tolerance, joint.unit))


# ---- suspicions --------------------------------------------------------------------------------------------------


def doubtful_times(motion: Motion, velocity: Array) -> list[Fault]:
    """Return a list with one suspicion if times given as seconds look like a smaller unit or sample numbers, else [].

    A smaller unit is plausible, the samples are a second or more apart, and no joint is faster than 0.5 % of its limit.
    Sample numbers: 50 or more, spaced by one, and no joint is faster than 10 %.
    """
    t, steps = motion.t, np.diff(motion.t)
    step, whole = float(np.median(steps)), bool((np.abs(t - np.rint(t)) <= 1e-9 * np.abs(t)).all())
    unit, used = likely_unit(t, motion.q, velocity)
    enumerated = whole and len(t) >= 50 and np.ptp(steps) < 1e-6 and abs(step - 1) < 1e-6 and 1e-5 < used < 0.1
    small = bool(unit) and step >= 1 and used < 5e-3 and len(t) >= (3 if whole else 10)
    if not small and not enumerated:
        return []
    likely = " or ".join(word for word, fits in ((unit, small), ("sample numbers", enumerated)) if fits)
    faster = f", in {unit} {100 * used * SMALL_UNITS[unit]:.3g} %" if small else ""
    text = f"times look like {likely}: {step:.6g} apart, and in seconds the fastest joint is at {100 * used:.2g} % of "
    text += f"its limit{faster}; pass --time-unit s, ms, us, ns, or seconds from sample to sample"
    return [Fault("suspicion", "time", text)]


def exchanged_joints(motion: Motion, robot: Robot, columns: Indices, tip: bool = True) -> list[Fault]:
    """Return a list with one suspicion if swapping the columns of two joints makes the motion far simpler, else [].

    Either one joint is outside its limits most of the time, and all are inside after the exchange, or the tip moves
    straight or at constant speed only after the exchange. The latter requires three joints that do not move in
    proportion, because motions between two configurations are simple by chance, and a `tip` that is known: all joints
    are known (`columns` has their indices in the joint vector), and the base does not float.
    """
    names, lower, upper = [robot.joint_names[k] for k in columns], robot.lower[columns], robot.upper[columns]

    def fault(pair: tuple[int, int], evidence: str) -> list[Fault]:
        both = " and ".join(names[k] for k in pair)
        text = f"the columns of {both} look exchanged: then {evidence}, which is far from true as written"
        return [Fault("suspicion", both, f"{text}; correct the names, or pass --names-confirmed")]

    kinds = [robot.joint(name).kind == "prismatic" for name in names]
    pairs = [(i, j) for i, j in combinations(range(len(names)), 2) if kinds[i] == kinds[j]]
    outside = ((motion.q[:, :, None] < lower) | (motion.q[:, :, None] > upper)).mean(axis=0)  # of column i for joint j
    current, identity = outside.diagonal(), np.arange(len(names))
    repairs = [
        p
        for p in pairs
        if current[[*p]].max() > 0.5 and not current[~np.isin(identity, p)].any() and not outside[p] + outside[p[::-1]]
    ]
    if len(repairs) == 1:
        return fault(repairs[0], "all joints are inside their limits")
    rows = np.unique(np.linspace(0, len(motion.t) - 1, THRESHOLDS.tip_samples).astype(int))
    joints = motion.q[rows]
    reach = np.ptp(joints, axis=0)
    if not tip or robot.tip is None or len(rows) < 10 or (reach > 0.1 * reach.max()).sum() < 3:
        return []
    sizes = np.linalg.svd(joints - joints.mean(axis=0), compute_uv=False)
    if sizes[1] < 1e-3 * sizes[0]:
        return []
    q = ca.SX.sym("q", robot.dof)
    sampler = Sampler([q], [FixedBase(robot).tip_pose((), q).position])
    orders = np.tile(identity, (len(pairs) + 1, 1))
    for order, pair in zip(orders[1:], pairs, strict=True):
        order[[*pair]] = pair[::-1]
    tips = sampler(np.concatenate([joints[:, order] for order in orders]))[0].reshape(-1, len(rows), 3)
    centred = tips - tips.mean(axis=1, keepdims=True)
    line = np.linalg.svd(centred, full_matrices=False)[2][:, :1]
    distance = np.linalg.norm(centred - (centred * line).sum(axis=2, keepdims=True) * line, axis=2).max(axis=1)
    steps = np.linalg.norm(np.diff(tips, axis=1), axis=2)
    length = np.maximum(steps.sum(axis=1), 1e-12)
    speeds = (steps / np.diff(motion.t[rows]))[:, len(rows) // 5 : -(len(rows) // 5)]  # without its ends
    measure = np.column_stack([distance / length, speeds.std(axis=1) / np.maximum(speeds.mean(axis=1), 1e-12)])
    measure /= [THRESHOLDS.straight, THRESHOLDS.even]
    measure[length < max(0.01, 0.1 * length[0])] = np.inf  # m: hardly a motion of the tip
    best, criterion = divmod(int(measure.argmin()), 2)
    if measure[best, criterion] > min(1.0, measure[0, criterion] / 20) or measure[0].min() < 3:
        return []
    return fault(pairs[best - 1], ("the tip goes straight", "the tip keeps its speed")[criterion])
