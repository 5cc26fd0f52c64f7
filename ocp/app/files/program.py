"""A program of several paths with rapids and pauses between, as it was read, and over time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models import ModelError, Path, SmoothPath, smooth
from models.arrays import Array, ArrayInput
from models.paths.path import NO_ROTATION, Reversal
from ocp.errors import NOT_NUMBERS, ProblemError, checked_choice, checked_instance, checked_positive, floats
from ocp.motion.schedule import LineLimits, Schedule, schedule

__all__ = [
    "DEFAULT_TOLERANCE",
    "Cut",
    "Note",
    "Pause",
    "Program",
    "ProgramMotion",
    "Rapid",
    "Section",
    "TimedProgram",
    "checked_reversal",
    "smoothed",
]

DEFAULT_TOLERANCE = 5e-5
"""m, where neither the file nor the caller says one: a usual contour tolerance of machine tools."""


class Note(NamedTuple):
    """Something in a file that was passed over or read in one of several ways.

    Attributes:
        text: What, and what was made of it.
        lines: Where, counted from 1.
    """

    text: str
    lines: tuple[int, ...]

    def __str__(self) -> str:
        shown = ", ".join(str(line) for line in self.lines[:8]) + (" ..." if len(self.lines) > 8 else "")
        return f"line{'s' if len(self.lines) > 1 else ''} {shown}: {self.text}"


@dataclass(frozen=True, eq=False)
class Cut:
    """A path that is run at its feeds without a stop.

    Attributes:
        path: Of n segments.
        feeds: Asked line speed of each segment. Shape (n,), m/s.
        tolerances: How far the rounded path may stray in the mode of each segment, nan where the file says nothing.
            Shape (n,), m.
        lines: Of the file, for each segment. Shape (n,).
    """

    path: Path
    feeds: Array
    tolerances: Array
    lines: NDArray[np.intp]

    @property
    def name(self) -> str:
        """With the lines it comes from."""
        return f"cut, lines {self.lines[0]} to {self.lines[-1]}"

    def smooth(self, tolerance: float | None = None, **options: Any) -> SmoothPath:
        """The path with its corners rounded, see `Program.smooth`."""
        given = np.fmin(self.tolerances[:-1], self.tolerances[1:])
        if tolerance is not None:
            given = np.fmin(given, checked_positive("tolerance", tolerance))
        return smoothed(self.path, np.where(np.isnan(given), DEFAULT_TOLERANCE, given), options)


@dataclass(frozen=True, eq=False)
class Rapid:
    """A straight way from one cut to another.

    Attributes:
        start, end: Shape (3,), m.
        line: Of the file.
    """

    start: Array
    end: Array
    line: int

    @property
    def name(self) -> str:
        """With the line it comes from."""
        return f"rapid, line {self.line}"


@dataclass(frozen=True)
class Pause:
    """A stop.

    Attributes:
        duration: s; zero where the program waits to be started again.
        line: Of the file.
        why: The word that asks for it.
    """

    duration: float
    line: int
    why: str

    @property
    def name(self) -> str:
        """With the line it comes from."""
        return f"pause {self.why}, line {self.line}"


Section: TypeAlias = Cut | Rapid | Pause


@dataclass(frozen=True, eq=False)
class Program:
    """What a file asks for, in its order.

    Attributes:
        sections: Cuts, rapids and pauses; each starts where the one before ends.
        start: Where the program begins. Shape (3,), m.
        notes: What was passed over, by line.
    """

    sections: tuple[Section, ...]
    start: Array
    notes: tuple[Note, ...] = ()

    @cached_property
    def cuts(self) -> tuple[Cut, ...]:
        """The paths that are run at a feed."""
        return tuple(each for each in self.sections if isinstance(each, Cut))

    @property
    def paths(self) -> tuple[Path, ...]:
        """Of the cuts."""
        return tuple(cut.path for cut in self.cuts)

    @property
    def feeds(self) -> tuple[Array, ...]:
        """Asked line speeds of the paths, one for each segment, m/s."""
        return tuple(cut.feeds for cut in self.cuts)

    @property
    def rapids(self) -> tuple[Rapid, ...]:
        """The ways between."""
        return tuple(each for each in self.sections if isinstance(each, Rapid))

    @property
    def length(self) -> float:
        """Of all cuts, m."""
        return sum(path.length for path in self.paths)

    def __str__(self) -> str:
        counts = _counted(len(self.paths), "path"), _counted(len(self.rapids), "rapid")
        head = f"{counts[0]} of {1e3 * self.length:.6g} mm in all, {counts[1]}"
        return "\n".join([head, *(str(note) for note in self.notes)])

    def placed(self, position: ArrayInput = (0.0, 0.0, 0.0), orientation: ArrayInput = NO_ROTATION) -> Program:
        """The program where its zero has a pose in the world; see `models.Path.placed`.

        Raises:
            ModelError: No position, no unit quaternion.
        """
        ends = [self.start, *(end for each in self.rapids for end in (each.start, each.end))]
        moved = iter(_moved(np.array(ends), position, orientation))
        start = next(moved)
        made: list[Section] = []
        for each in self.sections:
            if isinstance(each, Cut):
                made.append(replace(each, path=each.path.placed(position, orientation)))
            else:
                made.append(replace(each, start=next(moved), end=next(moved)) if isinstance(each, Rapid) else each)
        return Program(tuple(made), start, self.notes)

    def smooth(self, tolerance: float | None = None, **options: Any) -> tuple[SmoothPath, ...]:
        """Every path with its corners rounded.

        Args:
            tolerance: How far (m) a rounded path may stray; a tolerance in the file (G64 P) holds where it is smaller.
                None takes that of the file, or 0.05 mm.
            options: `kind`, `shape`, `overlap` of models.smooth.

        Raises:
            ProblemError: A tolerance that is not positive, unknown options.
        """
        return tuple(cut.smooth(tolerance, **options) for cut in self.cuts)

    def schedule(
        self, limits: LineLimits, *, rapid: float | None = None, tolerance: float | None = None, **options: Any
    ) -> TimedProgram:
        """The whole program over time: each path at its feeds, each rapid a straight line, from rest to rest.

        Args:
            limits: Of all stretches; its speed, one number, is the most that a feed may be.
            rapid: Speed of rapids, m/s; that of the limits if None.
            tolerance, options: As of `smooth`.

        Raises:
            ProblemError: No limits, joint limits, a speed for each segment.
        """
        checked_instance("limits", limits, LineLimits)
        if np.ndim(limits.speed) or limits.joints is not None:
            what = "joints" if limits.joints is not None else "speed"
            message = f"limits of a program: {what} must be {'None' if what == 'joints' else 'one number, m/s'}"
            raise ProblemError(message, name=what, value=getattr(limits, what))
        fastest = float(np.asarray(limits.speed))
        across = fastest if rapid is None else checked_positive("rapid", rapid)
        timed: list[Schedule | None] = []
        for each in self.sections:
            if isinstance(each, Cut):
                path = each.smooth(tolerance, **options)
                timed.append(schedule(path, replace(limits, speed=np.minimum(each.feeds, fastest))))
            elif isinstance(each, Rapid):
                line = smooth(Path.through([each.start, each.end]), DEFAULT_TOLERANCE)
                timed.append(schedule(line, replace(limits, speed=across)))
            else:
                timed.append(None)
        return TimedProgram(self, tuple(timed))


def checked_reversal(owner: str, value: Any) -> Reversal:
    """`value`, or ProblemError unless it is "split" or a width, m."""
    if isinstance(value, str):
        checked_choice(f"{owner}: reversal", value, ("split",))
        return "split"
    return float(checked_positive(f"{owner}: reversal", value))


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _moved(points: Array, position: ArrayInput, orientation: ArrayInput) -> Array:
    # a path of one line from the origin stands for the checks and for the rotation
    frame = [Path.through([(0, 0, 0), axis]).placed(position, orientation).segments[0] for axis in np.eye(3)]
    origin = np.asarray(frame[0].start)
    return np.asarray(origin + points @ np.array([np.asarray(line.end) - origin for line in frame]))


def smoothed(path: Path, deviation: ArrayInput, options: dict[str, Any]) -> SmoothPath:
    """A path rounded within a deviation, with options of models.smooth; its errors are ProblemErrors."""
    known = {"kind", "shape", "overlap"}
    if strange := [name for name in options if name not in known]:
        message = f"smooth: unknown option {strange[0]!r}; known: {', '.join(sorted(known))}"
        raise ProblemError(message, name=strange[0], limit=tuple(sorted(known)))
    try:
        return smooth(path, deviation=deviation, **options)
    except ModelError as error:
        raise ProblemError(str(error), **vars(error)) from error


class ProgramMotion(NamedTuple):
    """Where a program is at M instants.

    Attributes:
        t: Time. Shape (M,), s.
        section: Index in the program's stretches. Shape (M,).
        distance: Along the stretch. Shape (M,), m.
        position: Shape (M, 3), m.
        tangent: Unit; zero in a pause. Shape (M, 3).
        speed, acceleration, jerk: Of the line. Shape (M,), m/s, m/s^2, m/s^3.
    """

    t: Array
    section: NDArray[np.intp]
    distance: Array
    position: Array
    tangent: Array
    speed: Array
    acceleration: Array
    jerk: Array


@dataclass(frozen=True, eq=False)
class TimedProgram:
    """One trajectory of all stretches, one after the other, each from rest to rest.

    Attributes:
        program: What it is made for.
        schedules: Of each stretch, whose `path` is the rounded one; None for a pause.
    """

    program: Program
    schedules: tuple[Schedule | None, ...]

    @cached_property
    def bounds(self) -> Array:
        """Times at which the stretches begin, and the end. Shape (K + 1,), s."""
        pairs = zip(self.program.sections, self.schedules, strict=True)
        durations = [each.duration if timed is None else timed.duration for each, timed in pairs]  # type: ignore[union-attr]
        return np.concatenate([[0.0], np.cumsum(durations)])

    @property
    def duration(self) -> float:
        """s."""
        return float(self.bounds[-1])

    @property
    def names(self) -> tuple[str, ...]:
        """Of the stretches, with the lines they come from."""
        return tuple(each.name for each in self.program.sections)

    def at(self, time: ArrayLike) -> ProgramMotion:
        """Motion at times of [0, duration]. Shape (M,), s. At a bound it is that of the stretch that begins.

        Raises:
            ProblemError: nan, or a time outside by more than rounding.
        """
        try:
            t = np.atleast_1d(floats(time))
        except NOT_NUMBERS as error:
            raise ProblemError(f"time {time!r} is not numeric", name="time", value=time) from error
        slack = 1e-9 * self.duration
        if t.ndim != 1 or not ((t >= -slack) & (t <= self.duration + slack)).all():
            message = f"times must be a row within the program, 0 to {self.duration:g} s"
            raise ProblemError(message, name="time", value=time, limit=(0.0, self.duration))
        t = np.clip(t, 0.0, self.duration)
        index = np.clip(np.searchsorted(self.bounds, t, side="right") - 1, 0, len(self.schedules) - 1)
        rows = {name: np.zeros(len(t)) for name in ("distance", "speed", "acceleration", "jerk")}
        position, tangent = np.empty((len(t), 3)), np.zeros((len(t), 3))
        for which in np.unique(index):
            here = np.flatnonzero(index == which)
            timed = self.schedules[which]
            if timed is None:
                position[here] = self._rest(int(which))
                continue
            motion = timed.at(np.minimum(t[here] - self.bounds[which], timed.duration))
            place = timed.path.at(motion.distance)
            position[here], tangent[here] = place.position, place.tangent
            for name, row in rows.items():
                row[here] = getattr(motion, name)
        return ProgramMotion(
            t, index, rows["distance"], position, tangent, rows["speed"], rows["acceleration"], rows["jerk"]
        )

    def _rest(self, which: int) -> Array:
        """Where a pause stands: the end of what is before it."""
        for each in reversed(self.program.sections[:which]):
            if isinstance(each, Rapid):
                return each.end
            if isinstance(each, Cut):
                return np.asarray(each.path.segments[-1].end)
        return self.program.start
