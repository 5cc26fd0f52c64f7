"""Read G-code as paths: the motions G0 to G3 of three axes, and every word that affects these motions.

The dialect is RS274/NGC as in LinuxCNC (its manual, "G-Codes"), which most CAM postprocessors for mills follow. A word
that would change the path in an unknown way, such as cutter compensation or a machine's own positions, is an error
with its line. A word that does not change the path, such as coolant, is noted with its line. Several codes in one line
take effect in the order of the manual, "Order of Execution", except that F is in the units of its own line.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np

from models import Line, ModelError, ModelWarning
from models.checks import Array, ArrayInput
from models.paths import Segment, split_at_reversals
from models.paths.path import Reversal
from models.paths.segments import SHORTEST_SEGMENT
from ocp.app.files.gcode_words import (
    GROUPS,
    IGNORED_CODES,
    IGNORED_LETTERS,
    M_WORDS,
    MACHINE_CODES,
    MOTIONS,
    PLANES,
    REPOST,
    UNSUPPORTED_CODES,
    ArcError,
    Block,
    arcs_about_center,
    center_from_radius,
    code_name,
    read_blocks,
)
from ocp.app.files.program import Cut, Note, Pause, Program, Rapid, Section, checked_reversal
from ocp.app.files.safe_files import FileName, line_error, read_lines
from ocp.errors import ProblemError, problem_errors, require

UNITS = {"mm": 1e-3, "inch": 0.0254}
DEFAULT_GAPS_M = {"mm": 2 * np.sqrt(2) * 1e-5, "inch": 2 * np.sqrt(2) * 2.54e-5}
"""Largest difference of an arc's two end radii that rounding to 0.01 mm or 0.001 inch explains, by unit, m."""
AXES, OFFSETS, OTHER_AXES = "XYZ", "IJK", "ABCUVW"


def read_gcode(
    file: FileName,
    *,
    unit: str | None = None,
    feed: float | None = None,
    start: ArrayInput = (0.0, 0.0, 0.0),
    home: ArrayInput | None = None,
    reversal: Reversal = "split",
    gap: float | None = None,
    block_delete: bool = False,
) -> Program:
    """Read a G-code file and return its cuts, rapid moves and pauses.

    A path extends from one rapid, dwell or stop to the next. It also ends where its direction reverses, and after every
    move in exact path mode (G61). Moves of zero length are dropped. The centre of an arc is corrected for rounding, so
    that the arc meets its ends exactly.

    Args:
        unit: "mm" or "inch", valid until the first G20 or G21. None: mm, with a warning if the file gives no unit
            either.
        feed: Feed, m/s, valid until the first F. None: a move without feed is an error.
        start: Initial position in the coordinates of the program. Shape (3,), m.
        home: Position of G28, G30 and G53 with zeros, in the coordinates of the program. Shape (3,), m. None: these are
            ignored if nothing has moved before or nothing moves afterwards, and an error otherwise.
        reversal: "split", or the width (m) of the bulb in which the path turns round: see models.paths.path.
        gap: Largest difference (m) of an arc's ends in their distance from the centre that counts as rounding. None:
            0.028 mm or 0.0028 inch, by the unit. A thousandth of the radius also counts as rounding.
        block_delete: Whether lines that begin with `/` are skipped.

    Raises:
        ProblemError: A line is unsupported or contradictory (its number is the error's name), or the file has no moves.

    Warns:
        ModelWarning: Neither the file nor the caller gives the unit of lengths.
    """
    if unit is not None:
        require.choice("G-code: unit", unit, tuple(UNITS))
    with problem_errors():
        origin = require.array("G-code: start", start, (3,))
        home_position = None if home is None else require.array("G-code: home", home, (3,))
    speed = None if feed is None else require.positive("G-code: feed", feed)
    turn = checked_reversal("G-code", reversal)
    rounding = None if gap is None else require.positive("G-code: gap", gap)
    skips = require.flag("G-code: block_delete", block_delete)
    return _Reader(file, unit, speed, origin, home_position, turn, rounding, skips).read(read_lines(file))


class _Reader:
    """Reader of a G-code file, which keeps the modal state and the sections of the program read so far.

    Positions are in metres in the frame of the program's start. `position` is the programmed one; `reached` is the end
    of the path, which differs from it because moves below a nanometre are dropped.
    """

    def __init__(
        self,
        file: FileName,
        unit: str | None,
        feed: float | None,
        start: Array,
        home: Array | None,
        reversal: Reversal,
        gap: float | None,
        block_delete: bool,
    ) -> None:
        self.file, self.home, self.reversal, self.gap, self.block_delete = file, home, reversal, gap, block_delete
        self.start, self.position, self.reached, self.offset = start, start.copy(), start.copy(), np.zeros(3)
        self.unit, self.has_unit = unit or "mm", unit is not None
        self.feed, self.inverse_time = feed, False
        self.motion: int | None = None
        self.plane, self.absolute, self.absolute_centers = 170, True, False
        self.system: int | None = None
        self.exact, self.tolerance = False, np.nan
        self.moves: list[tuple[Segment, float, float, int]] = []
        self.sections: list[Section] = []
        self.note_lines: dict[str, list[int]] = {}
        self.machine: Block | None = None  # a move to an unknown position, after which no other move is allowed
        self.moved = False
        self.block = Block(0, "", (), {}, False)

    def read(self, lines: Sequence[str]) -> Program:
        """Read the lines of a file and return the program."""
        for block in read_blocks(self.file, lines):
            self.block = block
            if block.skipped:
                self._note("/: skipped, block_delete is on" if self.block_delete else "/: run, block_delete is off")
                if self.block_delete:
                    continue
            try:
                is_end = self._run()
            except ArcError as error:
                hint = f", or read with gap={1.01 * error.size:.2g}" if error.size > 0 else ""
                self._refuse(f"{error.why}; correct it{hint}", error.limit)
            except ModelError as error:
                self._refuse(str(error))
            if is_end:
                break
        self._end_path()
        if not self.sections:
            raise ProblemError(f"{self.file}: no line moves anything; is it G-code?", name="file", value=str(self.file))
        notes = tuple(Note(text, tuple(numbers)) for text, numbers in self.note_lines.items())
        return Program(tuple(self.sections), self.start, notes)

    def _refuse(self, why: str, limit: Any = None) -> NoReturn:
        """Raise a ProblemError about the current line of the G-code file, with a reason."""
        raise line_error(self.file, self.block.number, self.block.text, why, limit=limit)

    def _note(self, text: str) -> None:
        """Add a note about the current line of the G-code file to the notes of the program."""
        lines = self.note_lines.setdefault(text, [])
        if not lines or lines[-1] != self.block.number:
            lines.append(self.block.number)

    def _run(self) -> bool:
        """Execute the current line of the G-code program; return whether the line ends the program."""
        words = dict(self.block.words)
        codes = {code for letter, code in self.block.codes if letter == "G"}
        self._check_groups(codes)
        unit_before = self.unit
        self._set_modes(codes, words)
        if "F" in words:
            if (feed := words.pop("F")) < 0:
                self._refuse("the feed F is negative")
            self.feed = feed / 60 if self.inverse_time else feed * UNITS[self.unit] / 60  # 1/s or m/s
            if self.unit != unit_before:
                self._note("F is in the units of its own line")
        for letter, text in IGNORED_LETTERS.items():
            if letter in words:
                del words[letter]
                self._note(text)
        for letter in OTHER_AXES:
            if words.pop(letter, 0.0) != 0.0:
                self._refuse(f"{letter} moves an axis beside X, Y and Z, which is not supported; post for three axes")
        if 40 in codes:
            self._dwell(words)
        if machine_codes := codes.intersection(MACHINE_CODES):
            self._to_machine_position(machine_codes.pop(), words)
        elif codes & {920, 921, 922}:
            self._shift(codes, words)
        else:
            self._move(codes, words)
        return self._stop(words)

    def _check_groups(self, codes: set[int]) -> None:
        """Raise ProblemError for unsupported codes and for several codes of one modal group."""
        code_of_group: dict[str, int] = {}
        for code in sorted(codes):
            if code in UNSUPPORTED_CODES:
                self._refuse(f"{code_name(code)}: {UNSUPPORTED_CODES[code]}")
            group = GROUPS.get(code)
            if group is None and code not in IGNORED_CODES and code not in (40, 90, 920, 921, 922, *MACHINE_CODES):
                self._refuse(f"{code_name(code)} is not known; {REPOST}")
            if group in code_of_group:
                pair = f"{code_name(code_of_group[group])} and {code_name(code)}"
                self._refuse(f"{pair} contradict each other; remove one")
            if group is not None:
                code_of_group[group] = code
            if code in IGNORED_CODES:
                self._note(f"{code_name(code)}: {IGNORED_CODES[code]}")

    def _set_modes(self, codes: set[int], words: dict[str, float]) -> None:
        """Set units, plane, distance modes, coordinate system and path control from the codes of a block."""
        for code in codes:
            if code in (200, 210):
                self.unit, self.has_unit = "inch" if code == 200 else "mm", True
            elif code in PLANES:
                self.plane = code
            elif code in (900, 910):
                self.absolute = code == 900
            elif code in (901, 911):
                self.absolute_centers = code == 901
            elif code in (930, 940):
                self.inverse_time = code == 930
                self.feed = None if code == 930 else self.feed
            elif GROUPS.get(code) == "coordinate system":
                self._set_system(code)
        if codes & {610, 611}:
            self.exact = True
            self._note("G61: the path stops after every move")
        if 640 in codes:
            self.exact = False
            tolerance = words.pop("P", 0.0) * UNITS[self.unit]
            if tolerance < 0:
                self._refuse("the tolerance P of G64 is negative")
            self.tolerance = tolerance or np.nan
            self._note("G64: P is the tolerance of rounding" if tolerance else "G64: the caller's tolerance applies")

    def _set_system(self, code: int) -> None:
        """Set the work coordinate system; raise ProblemError if the program has already used another system."""
        if self.system is None and not self.moved and not self.moves:
            self.system = code
        if code != (540 if self.system is None else self.system):
            why = "a second coordinate system, whose offset only the machine knows; write a separate program"
            self._refuse(f"{code_name(code)}: {why}")
        self._note(f"{code_name(code)}: its zero is the zero of the program")

    def _dwell(self, words: dict[str, float]) -> None:
        """Add a pause of P seconds, which the code G4 requests."""
        if "P" not in words:
            self._refuse("G4 needs P, the time in s")
        duration = words.pop("P")
        if duration < 0:
            self._refuse("the time P of G4 is negative")
        self._end_path()
        self.sections.append(Pause(duration, self.block.number, "G4"))
        self._note("G4: P is read as seconds")

    def _to_machine_position(self, code: int, words: dict[str, float]) -> None:
        """Move to the machine's home position (G28, G30, G53); if it is unknown, ignore the move and add a note."""
        if code in (281, 301):
            self._refuse(f"{code_name(code)} stores a position of the machine; {REPOST}")
        axes = [i for i, axis in enumerate(AXES) if axis in words]
        has_moved = self.moved or self.moves
        if code == 530:
            codes = {code for letter, code in self.block.codes if letter == "G"}
            self.motion = 0 if 0 in codes else self.motion
            if self.motion != 0 or codes & {10, 20, 30}:
                self._refuse("G53 is supported with G0 only")
            if any(words[AXES[i]] for i in axes):
                self._refuse("G53 moves in the machine's own coordinates; write the position in the program's")
        via = self._target(words)
        for axis in AXES:
            words.pop(axis, None)
        if self.home is None:
            if has_moved:
                self.machine = self.block
            self._note(f"{code_name(code)}: the machine's own position; ignored")
            return
        if code != 530:
            self._rapid(via)
        target = self.position.copy()
        target[axes or slice(None)] = self.home[axes or slice(None)]
        self._rapid(target)

    def _shift(self, codes: set[int], words: dict[str, float]) -> None:
        """Shift the origin so that the current position gets given coordinates (G92), or remove such a shift."""
        if 920 not in codes:
            self.offset = np.zeros(3)
            return
        if not any(axis in words for axis in AXES):
            self._refuse("G92 names no axis")
        for i, axis in enumerate(AXES):
            if axis in words:
                self.offset[i] = self.position[i] - words.pop(axis) * UNITS[self.unit]

    def _target(self, words: dict[str, float]) -> Array:
        """Return the programmed target point in the frame of the program's start. Shape (3,), m."""
        target, unit = self.position.copy(), UNITS[self.unit]
        for i, axis in enumerate(AXES):
            if axis in words:
                value = words.pop(axis) * unit
                target[i] = value + self.offset[i] if self.absolute else target[i] + value
        return target

    def _move(self, codes: set[int], words: dict[str, float]) -> None:
        """Execute the motion of the current line of G-code, if it has coordinates."""
        if 800 in codes:
            self.motion = None
        for code in codes.intersection(MOTIONS):
            self.motion = code
        if not any(letter in words for letter in AXES + OFFSETS + "R"):
            return
        has_target = any(axis in words for axis in AXES)
        if self.motion is None:
            self._refuse("coordinates without a motion code; write G0, G1, G2 or G3 before them")
        if self.machine is not None:
            self.block = self.machine
            why = "moves to the machine's own position, which is unknown, and continues from there"
            self._refuse(f"{why}; read with home=, its position in the coordinates of the program, or remove the line")
        if not self.has_unit:
            self.has_unit = True
            message = f"{self.file}: neither G20 nor G21; lengths are read as {self.unit}; pass unit='mm' or 'inch'"
            warnings.warn(ModelWarning(message, name="unit", value=self.unit), stacklevel=5)
            self._note("no G20 or G21 before: lengths are in mm")
        if self.motion in (0, 10):
            for letter in OFFSETS + "R":
                if words.pop(letter, None) is not None:
                    self._refuse(f"{letter} belongs to G2 and G3; remove it")
            if self.motion == 0:
                self._rapid(self._target(words))
            elif has_target:
                self._line(self._target(words))
        else:
            self._arc(words)

    def _rapid(self, target: Array) -> None:
        """Add a rapid move to a target point."""
        self._end_path()
        if np.linalg.norm(target - self.reached) > SHORTEST_SEGMENT:
            self.sections.append(Rapid(self.reached, target, self.block.number))
            self.reached = target
        self.position, self.moved = target, True

    def _line(self, target: Array) -> None:
        """Add a straight move to a target point at the current feed."""
        self.position = target
        if np.linalg.norm(target - self.reached) > SHORTEST_SEGMENT:
            self._add((Line(self.reached, target),), target)

    def _arc(self, words: dict[str, float]) -> None:
        """Add an arc or a helix at the current feed."""
        start, unit = self.reached, UNITS[self.unit]
        target, plane = self._target(words), PLANES[self.plane]
        in_plane = list(plane[:2])
        turns = words.pop("P", 1.0)
        if turns < 1 or turns != round(turns) or turns > 1e4:
            self._refuse(f"P{turns:g} turns of an arc; write a whole number from 1")
        center_words = {i: words.pop(letter) * unit for i, letter in enumerate(OFFSETS) if letter in words}
        radius = words.pop("R", None)
        clockwise, gap = self.motion == 20, self.gap or DEFAULT_GAPS_M[self.unit]
        if radius is not None:
            if center_words:
                self._refuse("the arc has both a radius R and a centre; remove one")
            center = center_from_radius(start[in_plane], target[in_plane], radius * unit, clockwise=clockwise, gap=gap)
        else:
            if center_words.pop(plane[2], 0.0) != 0.0:
                self._refuse(f"{OFFSETS[plane[2]]} is not in the plane of {code_name(self.plane)}; remove it")
            if not center_words or (self.absolute_centers and len(center_words) < 2):
                both = " and ".join(OFFSETS[i] for i in sorted(in_plane))
                self._refuse(f"the arc has no centre; give {both}, or R")
            whole = np.zeros(3)
            for i, value in center_words.items():
                whole[i] = value
            center = (whole + (self.offset if self.absolute_centers else self.position))[in_plane]
        self.position = target
        arcs = arcs_about_center(start, target, center, clockwise=clockwise, turns=int(turns), plane=plane, gap=gap)
        self._add(arcs, target)

    def _add(self, segments: Sequence[Segment], reached: Array) -> None:
        """Append segments to the current path, with the feed and the tolerance that apply to the current line."""
        if not self.feed:
            self._refuse("no feed is set; write F, or read with feed= in m/s")
        feed = self.feed * sum(segment.length for segment in segments) if self.inverse_time else self.feed
        self.moves += [(segment, feed, self.tolerance, self.block.number) for segment in segments]
        self.reached = reached
        if self.inverse_time:
            self.feed = None  # in this mode every line has its own feed
        if self.exact or ("G", 90) in self.block.codes:
            self._end_path()

    def _stop(self, words: dict[str, float]) -> bool:
        """Execute the M codes of a block; reject words that no code uses; return whether the program ends."""
        is_end = False
        for code in (code for letter, code in self.block.codes if letter == "M"):
            kind, name = M_WORDS.get(code, ""), f"M{code // 10}"
            if kind == "call":
                self._refuse(f"{name}: subroutines are not supported; post the program without them")
            if kind == "stop":
                self._end_path()
                self.sections.append(Pause(0.0, self.block.number, name))
            is_end |= kind == "end"
            if kind != "end":
                self._note(f"{name}: {'a stop' if kind == 'stop' else 'ignored'}")
        if any(letter == "M" for letter, _ in self.block.codes):
            words.clear()  # P of M66 and the like
        if words:
            self._refuse(f"{', '.join(words)} belongs to no code of this line; remove it")
        return is_end

    def _end_path(self) -> None:
        """Convert the tool moves since the last stop into cuts (tool paths without a stop), and start a new path."""
        if not self.moves:
            return
        self.moved = True
        segments, feeds, tolerances, lines = zip(*self.moves, strict=True)
        self.moves = []
        for path, index in split_at_reversals(segments, self.reversal):
            self.sections.append(Cut(path, np.array(feeds)[index], np.array(tolerances)[index], np.array(lines)[index]))
