"""G-code read into paths: G0 to G3 of three axes, and every word that bears upon them.

The dialect is RS274/NGC as LinuxCNC has it (its manual, "G-Codes"), which most CAM posts for mills keep to. What would
change the path and cannot be known here, such as cutter compensation or a machine's own positions, is refused by line.
What does not change it, such as coolant, is noted by line. Several codes in one line take effect in the order of the
manual, "Order of Execution", but that F is in the units of its own line.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np

from models import Line, ModelError, ModelWarning
from models.arrays import Array, ArrayInput, checked_array
from models.paths import Segment, split_at_reversals
from models.paths.path import Reversal
from models.paths.segments import SHORTEST_SEGMENT
from ocp.app.files.lines import FileName, read_lines, wrong_line
from ocp.app.files.program import Cut, Note, Pause, Program, Rapid, Stretch, checked_reversal
from ocp.app.files.words import (
    GROUPS,
    KEPT,
    LETTERS,
    M_WORDS,
    MACHINE,
    MOTIONS,
    PLANES,
    POST,
    REFUSED,
    Block,
    Gap,
    about_center,
    blocks,
    center_of_radius,
    code_name,
)
from ocp.errors import ProblemError, checked_choice, checked_flag, checked_positive

__all__ = ["read_gcode"]

UNITS = {"mm": 1e-3, "inch": 0.0254}
GAPS = {"mm": 2 * np.sqrt(2) * 1e-5, "inch": 2 * np.sqrt(2) * 2.54e-5}
"""m: by so much an arc's ends differ in their distance from the centre, where all is written to 0.01 mm, 0.001 inch."""
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
    """Read a program of G-code.

    A path goes from a rapid, a dwell or a stop to the next; where it turns back the way it came, and after every move
    in exact path mode (G61), it ends too. Moves of no length are dropped. The centre of an arc is moved the least that
    rounding needs, and arcs meet their ends exactly.

    Args:
        file: Its name.
        unit: "mm" or "inch", before the first G20 or G21. None takes mm, and warns where the file says neither.
        feed: m/s, before the first F; None refuses moves without.
        start: Where the program begins, in its own coordinates. Shape (3,), m.
        home: Where G28, G30 and G53 with zeros lead, in the coordinates of the program. Shape (3,), m. If None they
            are passed over where nothing has moved yet or nothing moves afterwards, and refused elsewhere.
        reversal: "split", or the width (m) of the bulb of a reversal, see models.paths.split_at_reversals.
        gap: Largest difference (m) of an arc's ends in their distance from the centre that counts as rounding; by the
            unit if None: 0.028 mm or 0.0028 inch. A thousandth of the radius is rounding too.
        block_delete: Whether lines that begin with `/` are passed over.

    Raises:
        ProblemError: With the line as its name: whatever is not read, or contradicts itself. A file without moves.

    Warns:
        ModelWarning: Lengths whose unit neither the file nor the caller says.
    """
    if unit is not None:
        checked_choice("G-code: unit", unit, tuple(UNITS))
    try:
        origin = checked_array(start, (3,), "G-code", "start")
        known_home = None if home is None else checked_array(home, (3,), "G-code", "home")
    except ModelError as error:
        raise ProblemError(str(error), **vars(error)) from error
    reader = _Reader(
        file,
        unit,
        None if feed is None else checked_positive("G-code: feed", feed),
        origin,
        known_home,
        checked_reversal("G-code", reversal),
        None if gap is None else checked_positive("G-code: gap", gap),
        checked_flag("G-code: block_delete", block_delete),
    )
    return reader.read(read_lines(file))


class _Reader:
    """The modes of the machine while a file is read, and what has been read.

    Positions are metres in the frame of the program's beginning: `position` as programmed, `reached` where the path
    ends, for moves below a nanometre are dropped.
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
        self.unit, self.unit_said = unit or "mm", unit is not None
        self.feed, self.inverse_time = feed, False
        self.motion: int | None = None
        self.plane, self.absolute, self.absolute_centers = 170, True, False
        self.system: int | None = None
        self.exact, self.tolerance = False, np.nan
        self.moves: list[tuple[Segment, float, float, int]] = []
        self.stretches: list[Stretch] = []
        self.noted: dict[str, list[int]] = {}
        self.machine: Block | None = None  # a move to where nobody knows, after which nothing may move
        self.moved = False
        self.block = Block(0, "", (), {}, False)

    def read(self, lines: Sequence[str]) -> Program:
        """All blocks, as a program."""
        for block in blocks(self.file, lines):
            self.block = block
            if block.skipped:
                self._note("/: passed over, block_delete is on" if self.block_delete else "/: run, block_delete is off")
                if self.block_delete:
                    continue
            try:
                ended = self._run()
            except Gap as wrong:
                hint = f", or read with gap={1.01 * wrong.size:.2g}" if wrong.size > 0 else ""
                self._refuse(f"{wrong.why}; correct it{hint}", wrong.limit)
            except ModelError as error:
                self._refuse(str(error))
            if ended:
                break
        self._end_path()
        if not self.stretches:
            message = f"{self.file}: no word of it moves anything; is it G-code?"
            raise ProblemError(message, name="file", value=str(self.file))
        notes = tuple(Note(text, tuple(numbers)) for text, numbers in self.noted.items())
        return Program(tuple(self.stretches), self.start, notes)

    def _refuse(self, why: str, limit: Any = None) -> NoReturn:
        raise wrong_line(self.file, self.block.number, self.block.text, why, limit)

    def _note(self, text: str) -> None:
        lines = self.noted.setdefault(text, [])
        if not lines or lines[-1] != self.block.number:
            lines.append(self.block.number)

    def _run(self) -> bool:
        """Take a block; whether the program ends there."""
        words = dict(self.block.words)
        codes = {code for letter, code in self.block.codes if letter == "G"}
        self._check_groups(codes)
        before = self.unit
        self._set_modes(codes, words)
        if "F" in words:
            self._set_feed(words.pop("F"))
            if self.unit != before:
                self._note("F is in the units of its own line")
        for letter, text in LETTERS.items():
            if letter in words:
                del words[letter]
                self._note(text)
        for letter in OTHER_AXES:
            if words.pop(letter, 0.0) != 0.0:
                self._refuse(f"{letter} moves an axis beside X, Y and Z, which is not read; post for three axes")
        if 40 in codes:
            self._dwell(words)
        if machine := codes.intersection(MACHINE):
            self._to_machine_position(machine.pop(), words)
        elif codes & {920, 921, 922}:
            self._shift(codes, words)
        else:
            self._move(codes, words)
        return self._stop(words)

    def _check_groups(self, codes: set[int]) -> None:
        seen: dict[str, int] = {}
        for code in sorted(codes):
            if code in REFUSED:
                self._refuse(f"{code_name(code)}: {REFUSED[code]}")
            group = GROUPS.get(code)
            if group is None and code not in KEPT and code not in (40, 90, 920, 921, 922, *MACHINE):
                self._refuse(f"{code_name(code)} is not known; {POST}")
            if group in seen:
                self._refuse(
                    f"{code_name(seen[group])} and {code_name(code)} contradict each other in one line; leave one"
                )
            if group is not None:
                seen[group] = code
            if code in KEPT:
                self._note(f"{code_name(code)}: {KEPT[code]}")

    def _set_modes(self, codes: set[int], words: dict[str, float]) -> None:
        for code in codes:
            if code in (200, 210):
                self.unit, self.unit_said = "inch" if code == 200 else "mm", True
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
                self._refuse("the tolerance P of G64 is below zero")
            self.tolerance = tolerance or np.nan
            self._note("G64: P is the tolerance of rounding" if tolerance else "G64: the reader's tolerance holds")

    def _set_system(self, code: int) -> None:
        if self.system is None and not self.moved and not self.moves:
            self.system = code
        if code != (540 if self.system is None else self.system):
            why = "another coordinate system, whose offset only the machine knows; make a program of its own"
            self._refuse(f"{code_name(code)}: {why}")
        self._note(f"{code_name(code)}: its zero is the zero of the program")

    def _set_feed(self, value: float) -> None:
        if value < 0:
            self._refuse("the feed F is below zero")
        if self.inverse_time:
            self.feed = value / 60  # 1/s
        else:
            self.feed = value * UNITS[self.unit] / 60

    def _dwell(self, words: dict[str, float]) -> None:
        if "P" not in words:
            self._refuse("G4 needs P, the time in s")
        duration = words.pop("P")
        if duration < 0:
            self._refuse("the time P of G4 is below zero")
        self._end_path()
        self.stretches.append(Pause(duration, self.block.number, "G4"))
        self._note("G4: P is read as seconds")

    def _to_machine_position(self, code: int, words: dict[str, float]) -> None:
        if code in (281, 301):
            self._refuse(f"{code_name(code)} stores a position of the machine; {POST}")
        named = [i for i, axis in enumerate(AXES) if axis in words]
        leaves_cut = self.moved or self.moves
        if code == 530:
            codes = {code for letter, code in self.block.codes if letter == "G"}
            self.motion = 0 if 0 in codes else self.motion
            if self.motion != 0 or codes & {10, 20, 30}:
                self._refuse("G53 is read with G0 only")
            if any(words[AXES[i]] for i in named):
                self._refuse("G53 leads to a place in the machine's own coordinates; write it in the program's")
        if self.home is None:
            for axis in AXES:
                words.pop(axis, None)
            if leaves_cut:
                self.machine = self.block
            self._note(f"{code_name(code)}: the machine's own position; not gone to")
            return
        if code != 530:  # by way of the point that is named
            self._rapid(self._target(words))
        target = self.position.copy()
        for i in named or range(3):
            target[i] = self.home[i]
        for axis in AXES:
            words.pop(axis, None)
        self._rapid(target)

    def _shift(self, codes: set[int], words: dict[str, float]) -> None:
        """G92: the axes named have these values here; G92.1 and G92.2: no offset any more."""
        if 920 not in codes:
            self.offset = np.zeros(3)
            return
        if not any(axis in words for axis in AXES):
            self._refuse("G92 names no axis")
        for i, axis in enumerate(AXES):
            if axis in words:
                self.offset[i] = self.position[i] - words.pop(axis) * UNITS[self.unit]

    def _target(self, words: dict[str, float]) -> Array:
        target, unit = self.position.copy(), UNITS[self.unit]
        for i, axis in enumerate(AXES):
            if axis in words:
                value = words.pop(axis) * unit
                target[i] = value + self.offset[i] if self.absolute else target[i] + value
        return target

    def _move(self, codes: set[int], words: dict[str, float]) -> None:
        if 800 in codes:
            self.motion = None
        for code in codes.intersection(MOTIONS):
            self.motion = code
        if not any(letter in words for letter in AXES + OFFSETS + "R"):
            return
        named = any(axis in words for axis in AXES)
        if self.motion is None:
            self._refuse("coordinates without a motion; write G0, G1, G2 or G3 before them")
        if self.machine is not None:
            self.block = self.machine
            why = "goes to the machine's own position, which is not known, and moves on from there"
            self._refuse(f"{why}; read with home=, where it leads in the coordinates of the program, or take it out")
        if not self.unit_said:
            self.unit_said = True
            message = f"{self.file}: neither G20 nor G21; lengths are read as {self.unit}, say unit='mm' or 'inch'"
            warnings.warn(ModelWarning(message, name="unit", value=self.unit), stacklevel=5)
            self._note("no G20 or G21 before: lengths are in mm")
        if self.motion in (0, 10):
            for letter in OFFSETS + "R":
                if words.pop(letter, None) is not None:
                    self._refuse(f"{letter} belongs to G2 and G3; leave it out")
            if self.motion == 0:
                self._rapid(self._target(words))
            elif named:
                self._line(self._target(words))
        else:
            self._arc(words)

    def _rapid(self, target: Array) -> None:
        self._end_path()
        if np.linalg.norm(target - self.reached) > SHORTEST_SEGMENT:
            self.stretches.append(Rapid(self.reached, target, self.block.number))
            self.reached = target
        self.position, self.moved = target, True

    def _line(self, target: Array) -> None:
        self.position = target
        if np.linalg.norm(target - self.reached) > SHORTEST_SEGMENT:
            self._add((Line(self.reached, target),), target)

    def _arc(self, words: dict[str, float]) -> None:
        start, unit = self.reached, UNITS[self.unit]
        target, plane = self._target(words), PLANES[self.plane]
        inside = list(plane[:2])
        turns = words.pop("P", 1.0)
        if turns < 1 or turns != round(turns) or turns > 1e4:
            self._refuse(f"P{turns:g} turns of an arc; write a whole number from 1")
        given = {i: words.pop(letter) * unit for i, letter in enumerate(OFFSETS) if letter in words}
        radius = words.pop("R", None)
        clockwise, gap = self.motion == 20, self.gap or GAPS[self.unit]
        if radius is not None:
            if given:
                self._refuse("an arc has a radius R and a centre; leave one of them out")
            center = center_of_radius(start[inside], target[inside], radius * unit, clockwise, gap)
        else:
            if given.pop(plane[2], 0.0) != 0.0:
                self._refuse(f"{OFFSETS[plane[2]]} does not lie in the plane of {code_name(self.plane)}; leave it out")
            if not given or (self.absolute_centers and len(given) < 2):
                both = " and ".join(OFFSETS[i] for i in sorted(inside))
                self._refuse(f"the arc has no centre; give {both}, or R")
            whole = np.zeros(3)
            for i, value in given.items():
                whole[i] = value
            center = (whole + (self.offset if self.absolute_centers else self.position))[inside]
        self.position = target
        self._add(about_center(start, target, center, clockwise, int(turns), plane, gap), target)

    def _add(self, segments: Sequence[Segment], reached: Array) -> None:
        if not self.feed:
            self._refuse("no feed yet; give F, or read with feed= in m/s")
        feed = self.feed * sum(segment.length for segment in segments) if self.inverse_time else self.feed
        self.moves += [(segment, feed, self.tolerance, self.block.number) for segment in segments]
        self.reached = reached
        if self.inverse_time:
            self.feed = None  # every line needs its own
        if self.exact or ("G", 90) in self.block.codes:
            self._end_path()

    def _stop(self, words: dict[str, float]) -> bool:
        ended = False
        for code in (code for letter, code in self.block.codes if letter == "M"):
            kind, name = M_WORDS.get(code, ""), f"M{code // 10}"
            if kind == "call":
                self._refuse(f"{name}: subroutines are not run; post the program without them")
            if kind == "stop":
                self._end_path()
                self.stretches.append(Pause(0.0, self.block.number, name))
            ended |= kind == "end"
            if kind != "end":
                self._note(f"{name}: {'a stop' if kind == 'stop' else 'passed over'}")
        if any(letter == "M" for letter, _ in self.block.codes):
            words.clear()  # P of M66 and the like
        if words:
            self._refuse(f"{', '.join(words)} belongs to no word of this line; leave it out")
        return ended

    def _end_path(self) -> None:
        if not self.moves:
            return
        self.moved = True
        segments, feeds, tolerances, lines = zip(*self.moves, strict=True)
        self.moves = []
        for path, index in split_at_reversals(segments, self.reversal):
            made = Cut(path, np.array(feeds)[index], np.array(tolerances)[index], np.array(lines)[index])
            self.stretches.append(made)
