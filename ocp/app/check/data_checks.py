"""What is odd about a trajectory before any limit is looked at, and the motion that is left without it.

Joints that nobody has or that are missing, values that are no numbers, times that do not increase, other units than
radians, metres and seconds, jumps, turns that were wrapped, followers that do not follow. Each is a fault by name and
time; what is left is looked at further, as told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

import numpy as np

from models import Robot
from models.arrays import Array
from ocp.app.check.interpolation import Indices, Motion, half_digits
from ocp.app.files import RawTrajectory
from ocp.errors import ProblemError

__all__ = [
    "SMALL_UNITS",
    "THRESHOLDS",
    "CleanedTrajectory",
    "DataThresholds",
    "Fault",
    "clean_trajectory",
    "likely_unit",
]


@dataclass(frozen=True)
class DataThresholds:
    """From where on a file is doubted.

    Attributes:
        wild: Of a limit, and 1 rad or m more: a position beyond is hardly in rad or m.
        leap: Times how far the steps around it differ: a step that is a jump, if it is twice as long as they, too.
        hardest: Acceleration that a lone step takes, rad/s^2 or m/s^2: arms of industry give up to about 30.
        around: Steps before and after one with which it is compared: enough for a median that one outlier leaves.
        longest_step: Time between samples, s: no controller waits so long.
        tip_samples: Samples at which the tip is compared with that of exchanged joints.
        straight, even: The tip's distance from a line over its length, and the relative spread of its speed, below
            which it goes straight or keeps its speed: far below what joints make by chance.
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
"""Velocities written by those that the positions have, and what they are then; by 1000 the times are milliseconds."""


@dataclass(frozen=True)
class Fault:
    """Something that is wrong with a trajectory.

    Attributes:
        kind: "jump", "velocity", "clearance", "suspicion", ...
        name: Of the joint, the two bodies, or the waypoint; "" where it is about the whole.
        text: What is wrong, in words.
        time: Where it is worst, s; None where it is everywhere. first: Where it begins.
        value, limit: What was found and what may be. unit: Of both.
        line: Of the file, where it is one line's.
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
    """What is left of a trajectory.

    Attributes:
        joints: Columns of the robot's joint vector that are there. Shape (k,).
        motion: Of these.
        faults, notes: What was found; what was passed over or taken otherwise than it stands.
        base: Configuration of a floating base over time, or None. Shape (M, 3) or (M, 7).
        efforts: Of the same joints, or None. Shape (M, k).
        samples: Of the file.
    """

    joints: Indices
    motion: Motion
    faults: list[Fault] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    base: Array | None = None
    efforts: Array | None = None
    samples: int = 0


BASES = (("base.x", "base.y", "base.z", "base.qw", "base.qx", "base.qy", "base.qz"), ("base.x", "base.y", "base.angle"))
"""Names of the columns of a floating base."""


def clean_trajectory(
    raw: RawTrajectory,
    robot: Robot,
    lower: Array,
    upper: Array,
    velocity: Array,
    stated: bool = False,
    unwrap: bool = False,
) -> CleanedTrajectory:
    """What is left of a file's trajectory for a robot.

    Args:
        lower, upper, velocity: Limits of the joint vector, infinite where there are none. Shape (dof,) each.
        stated: Whether the times are known to be in seconds.
        unwrap: Take joints with limits that were wrapped as turning on, which is no fault then.

    Raises:
        ProblemError: Nothing is left: no joint of the robot, or no sample without a fault.
    """
    faults: list[Fault] = []
    notes = list(raw.notes)
    base_names = next((names for names in BASES if set(names) <= set(raw.names)), ())
    columns, joints = _columns(raw, robot, base_names, faults, notes)
    used = [*columns, *(raw.names.index(name) for name in base_names)]
    kept = _finite(raw, robot, columns, used, joints, faults, notes)
    rows = _in_order(raw, kept, faults)
    t, q = raw.t[rows], raw.positions[rows][:, columns]
    v, a, efforts = (
        None if whole is None or not np.isfinite(whole[kept][:, columns]).all() else whole[rows][:, columns]
        for whole in (raw.velocities, raw.accelerations, raw.efforts)
    )
    for kind, told, left in (("velocities", raw.velocities, v), ("accelerations", raw.accelerations, a)):
        if told is not None and left is None:
            notes.append(f"{kind} are not those of every joint, and are not used")
    if v is None and a is not None:
        notes.append("accelerations without velocities are not used")
        a = None
    base = raw.positions[rows][:, used[len(columns) :]] if base_names else None
    names = [robot.joint_names[k] for k in joints]
    kinds = [robot.joint(name).kind for name in names]
    limits = lower[joints], upper[joints], velocity[joints]
    t = t if stated else _in_seconds(t, q, limits[2], faults)
    q, v, a = _in_units(t, q, v, a, names, kinds, limits, faults)
    if len(t) == 1:
        notes.append("one sample is a posture, not a motion: it is looked at as one that rests for a second")
        t = np.array([t[0], t[0] + 1.0])
        q = np.repeat(q, 2, axis=0)
        v, a, efforts, base = (None if one is None else np.repeat(one, 2, axis=0) for one in (v, a, efforts, base))
    q, wrapped = _unwrapped(t, q, names, kinds, limits, notes)
    faults += [] if unwrap else wrapped
    notes += [f"{fault.name} {fault.text}" for fault in wrapped] if unwrap else []
    t = _time_by_velocities(t, q, v, names, faults)
    _jumps(t, q, names, kinds, velocity[joints], faults)
    _followers(raw, robot, rows, faults)
    return CleanedTrajectory(joints, Motion(t, q, v, a), faults, notes, base, efforts, len(raw.t))


def _columns(
    raw: RawTrajectory, robot: Robot, base: Sequence[str], faults: list[Fault], notes: list[str]
) -> tuple[list[int], Indices]:
    """Columns of the file of the joints that are there, and their places in the joint vector."""
    names = robot.joint_names
    found = [k for k, name in enumerate(names) if name in raw.names]
    missing = [name for name in names if name not in raw.names]
    strange = []
    for name in raw.names:
        if name in names or name in base:
            continue
        known = {joint.name: joint for joint in robot.joints}.get(name)
        if known is None:
            strange.append(name)
        elif not known.moves:
            notes.append(f"{name} is fixed in the robot; its column is not read")
    for name in strange:
        near = get_close_matches(name, missing, n=1, cutoff=0.7)
        if raw.names_are_joints or near:
            hint = f"; is it {near[0]}?" if near else ""
            faults.append(Fault("unknown joint", name, f"the robot has no joint of that name{hint}"))
        else:
            notes.append(f"column {name} is no joint of the robot and is not read")
    if not found:
        words = (
            f"{raw.file}: none of its columns is a joint of {robot.name!r}: it has {', '.join(raw.names[:12])}, the "
            f"robot {', '.join(names)}"
        )
        raise ProblemError(words, name="joints", value=raw.names, limit=names)
    led = {joint.mimic.joint: joint.name for joint in robot.joints if joint.mimic and joint.name in raw.names}
    for name in missing:
        hint = f"{led[name]}, which is there, follows it: say where it is itself" if name in led else "hold it: --lock"
        faults.append(Fault("missing joint", name, f"the trajectory does not say where it is; {hint}"))
    return [raw.names.index(names[k]) for k in found], np.array(found)


def _finite(
    raw: RawTrajectory,
    robot: Robot,
    columns: list[int],
    used: list[int],
    joints: Indices,
    faults: list[Fault],
    notes: list[str],
) -> Indices:
    """Numbers of the samples without a value that is no number. Shape (K,)."""
    good = np.isfinite(raw.t)
    if not good.all():
        k = int(np.flatnonzero(~good)[0])
        faults.append(Fault("not a number", "time", _count(~good, raw, k), None, line=int(raw.lines[k])))
    for kind, values in (
        ("", raw.positions),
        ("velocity of ", raw.velocities),
        ("acceleration of ", raw.accelerations),
    ):
        if values is None:
            continue
        for column, joint in zip([*columns, *used[len(columns) :]], [*joints, *[None] * len(used)], strict=False):
            wrong = ~np.isfinite(values[:, column])
            if not wrong.any() or (kind and (joint is None or wrong.all())):
                continue
            k = int(np.flatnonzero(wrong)[0])
            name = raw.names[column]
            time = float(raw.t[k]) if np.isfinite(raw.t[k]) else None
            faults.append(Fault("not a number", name, kind + _count(wrong, raw, k), time, time, line=int(raw.lines[k])))
            good &= ~wrong
    if not good.any():
        words = f"{raw.file}: no sample is without a value that is no number"
        raise ProblemError(words, name=raw.names[used[0]], value=len(raw.t))
    if not good.all():
        notes.append(f"{int((~good).sum())} of {len(good)} samples have a value that is no number, and are left out")
    return np.flatnonzero(good)


def _count(wrong: Any, raw: RawTrajectory, k: int) -> str:
    """How many are wrong and where the first is."""
    several = f"{int(wrong.sum())} values are no numbers, the first" if wrong.sum() > 1 else "a value is no number,"
    return f"{several} at {raw.t[k]:.6g} s (line {raw.lines[k]})"


def _in_order(raw: RawTrajectory, kept: Indices, faults: list[Fault]) -> Indices:
    """Numbers of samples whose times increase."""
    t = raw.t[kept]
    steps = np.diff(t)
    for wrong, kind, words in (
        (steps < 0, "times", "goes back from {:.6g} s to {:.6g} s"),
        (steps == 0, "times", "{:.6g} s is there twice"),
    ):
        if wrong.any():
            k = int(np.flatnonzero(wrong)[0])
            more = f", and {int(wrong.sum()) - 1} times more" if wrong.sum() > 1 else ""
            line, time = int(raw.lines[kept[k + 1]]), float(t[k + 1])
            text = words.format(t[k], t[k + 1]) + f" at line {line}{more}"
            faults.append(Fault(kind, "", f"time {text}; times must increase", time, time, line=line))
    return np.asarray(kept[np.unique(t, return_index=True)[1]])


def likely_unit(t: Array, q: Array, velocity: Array) -> tuple[str, float]:
    """The unit below a second in which the times make a plausible motion, or ""; the share of a limit used in seconds.

    Plausible are samples at 10 kHz or less, and a fastest joint at 1 to 1000 % of its limit, or of 1 where it has none.
    """
    h, usual = np.diff(t), np.where(np.isfinite(velocity), velocity, 1.0)
    used = float((np.abs(np.diff(q, axis=0)) / h[:, None] / usual).max())
    fits = [unit for unit, n in SMALL_UNITS.items() if 1e-2 <= used * n <= 10 and np.median(h) >= 1e-4 * n]
    return fits[-1] if fits else "", used


def _in_seconds(t: Array, q: Array, velocity: Array, faults: list[Fault]) -> Array:
    """The times; in seconds where they are whole numbers that far apart that they must be in a smaller unit."""
    if len(t) < 3 or not (t == np.rint(t)).all() or (step := float(np.median(np.diff(t)))) < THRESHOLDS.longest_step:
        return t
    unit = likely_unit(t, q, velocity)[0] or ("nanoseconds" if step >= 1e5 else "microseconds")
    words = f"times look like {unit}: whole numbers, {step:.6g} apart; what follows is of times in {unit}"
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
    """Positions, velocities and accelerations, of joints that look like degrees or millimetres in rad and m."""
    lower, upper, _ = limits
    most, scale = np.maximum(np.abs(lower), np.abs(upper)), np.ones(len(names))
    room = 0.05 * np.where(np.isfinite(most), upper - lower, 1.0)

    def doubt(k: int, unit: str, why: str, plain: str) -> None:
        at = int(np.abs(q[:, k]).argmax())
        words = (
            f"positions look like {unit}: {q[at, k]:.5g} at {t[at]:.6g} s, {why}; what follows is of the motion in "
            f"{unit}, taken as such"
        )
        faults.append(Fault("units", names[k], words, float(t[at]), None, float(q[at, k]), float(most[k]), plain))

    turning = [k for k, kind in enumerate(kinds) if kind != "prismatic"]
    worst = _worst_in_degrees(t, q, turning, limits, room)
    if worst is not None:
        doubt(worst, "degrees", "which in rad is beyond any limit, and in degrees all joints keep theirs", "rad")
        scale[turning] = np.pi / 180
    for k, kind in enumerate(kinds):
        in_m, far = q[:, k] * 1e-3, np.abs(q[:, k]).max()
        fits = ((in_m >= lower[k] - room[k]) & (in_m <= upper[k] + room[k])).all()
        if kind == "prismatic" and np.isfinite(most[k]) and far > max(10 * most[k], 1.0) and fits:
            doubt(k, "millimetres", f"limits {lower[k]:g} .. {upper[k]:g} m", "m")
            scale[k] = 1e-3
    return q * scale, None if v is None else v * scale, None if a is None else a * scale


def _worst_in_degrees(
    t: Array, q: Array, turning: Sequence[int], limits: tuple[Array, Array, Array], room: Array
) -> int | None:
    """The joint that is farthest beyond what is possible in rad, where all are possible in degrees.

    At least half of the joints that move must be so. Those without position limits may turn on for ever: where no joint
    has any, they are judged by how fast they would be.
    """
    lower, upper, velocity = limits
    far, most, in_degrees = np.abs(q).max(axis=0), np.maximum(np.abs(lower), np.abs(upper)), np.deg2rad(q)
    limited = [k for k in turning if np.isfinite(most[k])]
    if limited:
        wild = [k for k in limited if far[k] > max(THRESHOLDS.wild * most[k] + 1, 2 * np.pi)]
        moving = [k for k in limited if np.ptp(q[:, k]) > 0 or far[k] > 0]
        inside = (in_degrees >= lower - room) & (in_degrees <= upper + room)
        possible = bool(inside[:, limited].all())
    else:
        fast = np.zeros(q.shape[1])
        if len(t) > 1:
            fast = np.median(np.abs(np.diff(np.unwrap(q, axis=0), axis=0)) / np.diff(t)[:, None], axis=0)
        wild, moving = [k for k in turning if fast[k] > velocity[k]], list(turning)
        possible = all(np.deg2rad(fast[k]) <= velocity[k] for k in turning) and far.max() > 2 * np.pi
    suspected = wild and 2 * len(wild) >= len(moving) and possible
    return max(wild, key=lambda k: far[k]) if suspected else None


def _unwrapped(
    t: Array, q: Array, names: Sequence[str], kinds: Sequence[str], limits: tuple[Array, ...], notes: list[str]
) -> tuple[Array, list[Fault]]:
    """Positions without the leaps of whole turns, and a fault for each joint with limits that had some.

    Of such a joint a leap is nearly a whole turn, and a step that it is too slow for, or that no arm makes. It turns on
    where its limits have room for that, if need be whole turns away; elsewhere the leaps are left.
    """
    found, wrapped, (lower, upper, velocity), h = q.copy(), [], limits, np.diff(t)
    for k, kind in enumerate(kinds):
        on, steps = np.unwrap(q[:, k]), np.diff(q[:, k])
        leaps = np.abs(np.diff(on) - steps) > np.pi
        if kind != "continuous":
            swift = (np.abs(steps) > velocity[k] * h) | (np.abs(steps) > THRESHOLDS.hardest * h**2)
            leaps &= swift & (np.abs(np.diff(on)) < 0.5)
            on = q[:, k] - np.cumsum([0.0, *np.where(leaps, steps - np.diff(on), 0.0)])
            if on.min() < lower[k] or on.max() > upper[k]:
                on += 2 * np.pi * np.rint((lower[k] + upper[k] - on.min() - on.max()) / (4 * np.pi))
        if kind == "prismatic" or not leaps.any() or on.min() < lower[k] or on.max() > upper[k]:
            continue
        found[:, k], at = on, int(leaps.argmax())
        words = f"is wrapped at {t[at]:.6g} s ({leaps.sum()} in all); it turns on"
        if kind == "continuous":
            notes.append(f"{names[k]} {words}")
            continue
        words += " in what follows, within its limits: unwrap it, or state --unwrap if the controller does"
        wrapped.append(Fault("jump", names[k], words, float(t[at + 1]), float(t[at + 1]), float(steps[at]), unit="rad"))
    return found, wrapped


def _time_by_velocities(t: Array, q: Array, v: Array | None, names: Sequence[str], faults: list[Fault]) -> Array:
    """The times, in s where the velocities say that they are in ms; faults of velocities that are not the motion's."""
    if v is None or len(t) < 10:
        return t
    h = np.diff(t)[:, None]
    by_positions, told = np.diff(q, axis=0) / h, (v[1:] + v[:-1]) / 2
    most = np.abs(by_positions).max(axis=0)
    rough = np.median(np.abs(np.diff(by_positions, axis=0)), axis=0)
    ratios: dict[int, float] = {}
    for k in range(q.shape[1]):
        if most[k] * (t[-1] - t[0]) < 1e-6 or rough[k] > 0.2 * most[k] or not np.abs(told[:, k]).any():
            continue  # at rest, too coarse to say, or asked to stop at every sample
        fast = np.abs(by_positions[:, k]) > 0.05 * most[k]
        ratio = np.median(told[fast, k] / by_positions[fast, k])
        off = np.median(np.abs(told[fast, k] - ratio * by_positions[fast, k]))
        if abs(ratio - 1) > 0.2 or off > 0.3 * abs(ratio) * most[k]:
            ratios[k] = float(ratio) if off <= 0.3 * abs(ratio) * most[k] else np.nan
    if ratios and len(ratios) == int((most * (t[-1] - t[0]) >= 1e-6).sum()):
        whole = np.median(list(ratios.values()))
        for unit, power in SMALL_UNITS.items():
            if abs(whole / power - 1) < 0.1:
                words = f"times look like {unit}: velocities are {whole:.4g} times those of the positions over them"
                words += f"; what follows is of times in {unit}"
                faults.append(Fault("units", "time", words, value=float(whole)))
                return t / power
    for k, ratio in ratios.items():
        near = next((words for factor, words in FACTORS.items() if abs(ratio / factor - 1) < 0.1), "")
        at = int(np.abs(told[:, k] - by_positions[:, k]).argmax())
        if np.isnan(ratio):
            words = "velocities are not those of its positions"
        else:
            words = f"velocities are {ratio:.4g} times those of its positions" + (near and f": they look like {near}")
        text = f"{words}, most so at {t[at]:.6g} s: {told[at, k]:.4g} told, {by_positions[at, k]:.4g} by positions"
        kind = "units" if near else "velocities"
        found = float(told[at, k]), float(by_positions[at, k])
        faults.append(Fault(kind, names[k], text, float(t[at]), None, *found))
    return t


def _jumps(
    t: Array, q: Array, names: Sequence[str], kinds: Sequence[str], velocity: Array, faults: list[Fault]
) -> None:
    """Steps that are far longer than those around them, and that no arm makes."""
    h = np.diff(t)
    steps = np.diff(q, axis=0)
    speeds = steps / h[:, None]
    count = len(h)
    if count < 3:
        return
    digits, around = half_digits(q), THRESHOLDS.around
    places = np.arange(count)[:, None] + np.array([d for d in range(-around, around + 1) if d])
    inside = (places >= 0) & (places < count)
    for k, name in enumerate(names):
        beside = np.where(inside, speeds[np.clip(places, 0, count - 1), k], np.nan)
        usual = np.nanmedian(beside, axis=1)
        spread = np.nanmedian(np.abs(beside - usual[:, None]), axis=1)
        off = np.abs(speeds[:, k] - usual)
        spread = np.maximum(spread, np.median(off))  # of noise
        tall = (off > THRESHOLDS.leap * spread) & (off > np.abs(usual))
        tall &= (off / h > THRESHOLDS.hardest) | (np.abs(speeds[:, k]) > velocity[k])
        tall &= off * h > np.maximum(6 * digits[k], 1e-6 * max(1.0, float(np.abs(q[:, k]).max())))
        where = np.flatnonzero(tall)
        if not where.size:
            continue
        unit = "m" if kinds[k] == "prismatic" else "rad"
        worst = int(where[np.abs(steps[where, k]).argmax()])
        turn = unit == "rad" and abs(abs(steps[worst, k]) - 2 * np.pi) < 0.5
        words = (
            f"jumps by {steps[worst, k]:.4g} {unit} from {t[worst]:.6g} to {t[worst + 1]:.6g} s"
            + (", a whole turn: it was wrapped, and this joint cannot turn on" if turn else "")
            + (f"; {len(where)} such steps, the first at {t[where[0]]:.6g} s" if len(where) > 1 else "")
        )
        times = float(t[worst + 1]), float(t[where[0] + 1])
        step, usual_step = float(steps[worst, k]), float(abs(usual[worst]) * h[worst])
        faults.append(Fault("jump", name, words, *times, step, usual_step, unit))


def _followers(raw: RawTrajectory, robot: Robot, rows: Indices, faults: list[Fault]) -> None:
    """Joints that follow others and are told where they do not."""
    for joint in robot.joints:
        if joint.mimic is None or not joint.moves or joint.name not in raw.names:
            continue
        column, ratio, offset = robot.drives[joint.name]
        leader = robot.joint_names[column]
        if leader not in raw.names:
            continue
        told, led = (raw.positions[rows, raw.names.index(name)] for name in (joint.name, leader))
        off = np.abs(told - (ratio * led + offset))
        k = int(np.nanargmax(off)) if np.isfinite(off).any() else 0
        room = 1e-3 * max(1e-3, float(np.nanmax(np.abs(told), initial=0.0)))
        if not off[k] <= room:
            time = float(raw.t[rows[k]])
            words = f"follows {leader} and is {off[k]:.4g} {joint.unit} from where that takes it at {time:.6g} s"
            faults.append(Fault("follower", joint.name, words, time, time, float(off[k]), room, joint.unit))
