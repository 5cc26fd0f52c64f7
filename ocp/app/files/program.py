"""A machine-tool program of cuts, rapid moves and pauses as read from a file, and its trajectory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models import Path, SmoothPath, smooth
from models.checks import Array, ArrayInput
from models.paths.path import NO_ROTATION, Reversal, fit_splines
from ocp.errors import ProblemError, problem_errors, require, values_within
from ocp.motion.schedule import LineLimits, Schedule, schedule

DEFAULT_TOLERANCE_M = 5e-5
"""Default deviation of a rounded path, m, which is a usual contour tolerance of machine tools."""


class Note(NamedTuple):
    """Remark about words of a file that were ignored or could be interpreted in several ways.

    Attributes:
        text: The words and their interpretation.
        lines: Line numbers, from 1.
    """

    text: str
    lines: tuple[int, ...]

    def __str__(self) -> str:
        numbers = ", ".join(str(line) for line in self.lines[:8]) + (" ..." if len(self.lines) > 8 else "")
        return f"line{'s' if len(self.lines) > 1 else ''} {numbers}: {self.text}"


@dataclass(frozen=True, eq=False)
class Cut:
    """A path that is traversed at the programmed feed without a stop, such as a cut of a mill.

    Attributes:
        path: Path of n segments.
        feeds: Programmed speed along each segment. Shape (n,), m/s.
        tolerances: Deviation allowed for the rounded path in the mode of each segment, nan if the file gives none.
            Shape (n,), m.
        lines: Line number of each segment in the file. Shape (n,).
    """

    path: Path
    feeds: Array
    tolerances: Array
    lines: NDArray[np.intp]

    @property
    def name(self) -> str:
        """Name of this cutting motion for messages, with the lines of the file that describe it."""
        return f"cut, lines {self.lines[0]} to {self.lines[-1]}"

    def smooth(self, tolerance: float | None = None, **options: Any) -> SmoothPath:
        """Return the path of the cut with its corners rounded, by the arguments of `Program.smooth`."""
        return self._fitted(tolerance, options)[0]

    def _fitted(self, tolerance: float | None, options: dict[str, Any]) -> tuple[SmoothPath, Array]:
        """Return the path of the cut with rounded corners, and the programmed feed on each segment of it, m/s."""
        deviation = np.fmin(self.tolerances[:-1], self.tolerances[1:])
        if tolerance is not None:
            deviation = np.fmin(deviation, require.positive("tolerance", tolerance))
        deviation = np.where(np.isnan(deviation), DEFAULT_TOLERANCE_M, deviation)
        path, first = smooth_path(self.path, deviation, options, np.flatnonzero(np.diff(self.feeds)) + 1)
        return path, self.feeds[first]


@dataclass(frozen=True, eq=False)
class Rapid:
    """A straight rapid move, usually between two cuts.

    Attributes:
        start, end: Start and end point. Shape (3,), m.
        line: Line number in the file.
    """

    start: Array
    end: Array
    line: int

    @property
    def name(self) -> str:
        """Description of the rapid move with its line number."""
        return f"rapid, line {self.line}"


@dataclass(frozen=True)
class Pause:
    """A pause of a program, during which the tool stands still.

    Attributes:
        duration: Duration, s; zero if the program waits for the operator.
        line: Line number in the file.
        why: The code that causes the pause.
    """

    duration: float
    line: int
    why: str

    @property
    def name(self) -> str:
        """Description of the pause with its line number."""
        return f"pause {self.why}, line {self.line}"


Section: TypeAlias = Cut | Rapid | Pause


@dataclass(frozen=True, eq=False)
class Program:
    """Contents of a program file: cuts, rapid moves and pauses in order.

    Attributes:
        sections: Cuts, rapids and pauses; each starts where the previous one ends.
        start: Initial position. Shape (3,), m.
        notes: Words that were ignored or interpreted.
    """

    sections: tuple[Section, ...]
    start: Array
    notes: tuple[Note, ...] = ()

    @cached_property
    def cuts(self) -> tuple[Cut, ...]:
        """The cutting motions of the program, without rapid motions and pauses, in their order."""
        return tuple(each for each in self.sections if isinstance(each, Cut))

    @property
    def paths(self) -> tuple[Path, ...]:
        """Paths of the cuts of the program, in their order."""
        return tuple(cut.path for cut in self.cuts)

    @property
    def feeds(self) -> tuple[Array, ...]:
        """Programmed speed along each segment of each path, m/s."""
        return tuple(cut.feeds for cut in self.cuts)

    @property
    def rapids(self) -> tuple[Rapid, ...]:
        """Rapid moves (G0) of the program."""
        return tuple(each for each in self.sections if isinstance(each, Rapid))

    @property
    def length(self) -> float:
        """Total length of the cuts, m."""
        return sum(path.length for path in self.paths)

    def __str__(self) -> str:
        paths, rapids = (
            f"{count} {noun}{'' if count == 1 else 's'}"
            for count, noun in ((len(self.paths), "path"), (len(self.rapids), "rapid"))
        )
        head = f"{paths} of {1e3 * self.length:.6g} mm in all, {rapids}"
        return "\n".join([head, *(str(note) for note in self.notes)])

    def placed(self, position: ArrayInput = (0.0, 0.0, 0.0), orientation: ArrayInput = NO_ROTATION) -> Program:
        """Return the program with its origin moved to a given pose in the world: position, m, and unit quaternion.

        Raises:
            ModelError: The position is invalid, or the orientation is not a unit quaternion.
        """
        # lines from the origin along the axes check the pose and give its rotation
        frame = [Path.through([(0, 0, 0), axis]).placed(position, orientation).segments[0] for axis in np.eye(3)]
        origin = np.asarray(frame[0].start)
        rotation = np.array([np.asarray(line.end) - origin for line in frame])
        sections: list[Section] = []
        for each in self.sections:
            if isinstance(each, Cut):
                each = replace(each, path=each.path.placed(position, orientation))
            elif isinstance(each, Rapid):
                each = replace(each, start=origin + each.start @ rotation, end=origin + each.end @ rotation)
            sections.append(each)
        return Program(tuple(sections), origin + self.start @ rotation, self.notes)

    def smooth(self, tolerance: float | None = None, **options: Any) -> tuple[SmoothPath, ...]:
        """Return the paths of all cuts with rounded corners; splines replace runs of short segments of equal feed.

        Args:
            tolerance: Largest deviation from the path, m. A smaller tolerance in the file (G64 P) takes precedence; the
                smallest one of a cut applies to its splines, see `models.paths.fit_splines`. None: that of the file, or
                0.05 mm.
            options: `kind`, `shape`, `overlap` of models.smooth.

        Raises:
            ProblemError: The tolerance is not positive, or an option is unknown.
        """
        return tuple(cut.smooth(tolerance, **options) for cut in self.cuts)

    def schedule(
        self, limits: LineLimits, *, rapid: float | None = None, tolerance: float | None = None, **options: Any
    ) -> TimedProgram:
        """Return the trajectory of the program, in which each section runs from rest to rest.

        Args:
            limits: Limits of all sections; the speed, one number, also limits the feeds. An infinite centripetal limit
                is that of the acceleration. `LineLimits.tool` limits each axis of a machine.
            rapid: Speed of rapids, m/s; None: the speed of the limits.
            tolerance, options: As in `smooth`.

        Raises:
            ProblemError: The limits are invalid, include joint limits, or have one speed per segment.
        """
        require.instance("limits", limits, LineLimits)
        if np.ndim(limits.speed) or limits.joints is not None:
            name = "joints" if limits.joints is not None else "speed"
            message = f"limits of a program: {name} must be {'None' if name == 'joints' else 'one number, m/s'}"
            raise ProblemError(message, name=name, value=getattr(limits, name))
        fastest = float(np.asarray(limits.speed))
        if np.isinf(limits.centripetal):
            limits = replace(limits, centripetal=limits.acceleration)
        rapid_speed = fastest if rapid is None else require.positive("rapid", rapid)
        schedules: list[Schedule | None] = []
        for each in self.sections:
            if isinstance(each, Cut):
                path, feeds = each._fitted(tolerance, options)
                schedules.append(schedule(path, replace(limits, speed=np.minimum(feeds, fastest))))
            elif isinstance(each, Rapid):
                line = smooth(Path.through([each.start, each.end]), DEFAULT_TOLERANCE_M)
                schedules.append(schedule(line, replace(limits, speed=rapid_speed)))
            else:
                schedules.append(None)
        return TimedProgram(self, tuple(schedules))


def checked_reversal(owner: str, value: Any) -> Reversal:
    """Check and return the treatment of path reversals: "split", or the width (m) of a bulb-shaped turn."""
    if isinstance(value, str):
        require.choice(f"{owner}: reversal", value, ("split",))
        return "split"
    return float(require.positive(f"{owner}: reversal", value))


def smooth_path(
    path: Path, deviation: ArrayInput, options: dict[str, Any], corners: ArrayInput | None = None
) -> tuple[SmoothPath, NDArray[np.intp]]:
    """Replace runs of short segments of a path by splines, and round the corners, within a given deviation, m.

    Return also the index of the first segment that each segment of the result replaces; raise the errors of
    `models.smooth` as ProblemError.
    """
    known = {"kind", "shape", "overlap"}
    if unknown := [name for name in options if name not in known]:
        message = f"smooth: unknown option {unknown[0]!r}; known: {', '.join(sorted(known))}"
        raise ProblemError(message, name=unknown[0], limit=tuple(sorted(known)))
    with problem_errors():
        fitted, first, left = fit_splines(path, deviation, corners=corners)
        return smooth(fitted, deviation=left, **options), first


class ProgramMotion(NamedTuple):
    """Motion of the tool in a machine-tool program at M sample times.

    Attributes:
        t: Sample times. Shape (M,), s.
        section: Index of the section. Shape (M,).
        distance: Path length from the start of the section. Shape (M,), m.
        position: Position of the tool. Shape (M, 3), m.
        tangent: Unit tangent of the path; zero in a pause. Shape (M, 3).
        speed, acceleration, jerk: Time derivatives of the distance. Shape (M,), m/s, m/s^2, m/s^3.
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
    """Trajectory of a program: its sections in sequence, each from rest to rest.

    Attributes:
        program: The program.
        schedules: Schedule of each section, whose `path` is the rounded one; None for a pause.
    """

    program: Program
    schedules: tuple[Schedule | None, ...]

    def __repr__(self) -> str:
        return f"<TimedProgram of {self.duration:.6g} s: {self.program}>"

    @cached_property
    def bounds(self) -> Array:
        """Start times of the sections, and the end time of the program. Shape (K + 1,), s."""
        pairs = zip(self.program.sections, self.schedules, strict=True)
        durations = [each.duration if timed is None else timed.duration for each, timed in pairs]  # type: ignore[union-attr]
        return np.concatenate([[0.0], np.cumsum(durations)])

    @property
    def duration(self) -> float:
        """Duration of the program, s."""
        return float(self.bounds[-1])

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each section of the program for messages, with the lines of the file that describe it."""
        return tuple(each.name for each in self.program.sections)

    def at(self, time: ArrayLike) -> ProgramMotion:
        """Return the motion at times (M,) in [0, duration], s; a boundary belongs to the section that begins there.

        Raises:
            ProblemError: A time is not a number, or is outside by more than rounding.
        """
        words = f"s is outside the program, 0 to {self.duration:g} s"
        t = np.atleast_1d(values_within(time, self.duration, "time", words))
        index = np.clip(np.searchsorted(self.bounds, t, side="right") - 1, 0, len(self.schedules) - 1)
        rows = {name: np.zeros(len(t)) for name in ("distance", "speed", "acceleration", "jerk")}
        position, tangent = np.empty((len(t), 3)), np.zeros((len(t), 3))
        for number in np.unique(index):
            members = np.flatnonzero(index == number)
            plan = self.schedules[number]
            if plan is None:
                position[members] = self._rest(int(number))
                continue
            motion = plan.at(np.minimum(t[members] - self.bounds[number], plan.duration))
            point = plan.path.at(motion.distance)
            position[members], tangent[members] = point.position, point.tangent
            for name, row in rows.items():
                row[members] = getattr(motion, name)
        return ProgramMotion(t, index, position=position, tangent=tangent, **rows)

    def _rest(self, which: int) -> Array:
        """Return the position of the tool during a pause, which is the end of the previous move."""
        for each in reversed(self.program.sections[:which]):
            if isinstance(each, Rapid):
                return each.end
            if isinstance(each, Cut):
                return np.asarray(each.path.segments[-1].end)
        return self.program.start
