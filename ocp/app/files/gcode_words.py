"""Split G-code lines into words, classify the codes, and construct arcs from their centre or radius.

The dialect is RS274/NGC as in the LinuxCNC manual, "G-Code Overview", "G-Codes" and "M-Codes". Codes are in tenths: 901
is G90.1. A code with another meaning in another dialect is an error. The numbers of a program are rounded, so the
centre of an arc is rarely at the same distance from both ends. It is moved by the smallest distance onto the
perpendicular bisector of the chord, so that the arc meets both ends exactly. LinuxCNC keeps the written centre and runs
a spiral instead; the two curves differ by less than the gap.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from models.checks import Array
from models.files import INPUT_LIMITS
from models.paths import Arc, Helix
from models.paths.segments import SHORTEST_SEGMENT
from models.spatial import FULL_TURN
from ocp.app.files.safe_files import FileName, line_error
from ocp.tolerances import STANDSTILL

PLANES = {170: (0, 1, 2), 180: (2, 0, 1), 190: (1, 2, 0)}
"""First axis, second axis and normal of the planes G17, G18, G19: right-handed, so that G3 turns about the normal."""
RADIUS_SHARE = 1e-3
"""Accepted difference of the two end radii of an arc in a file with few digits, relative to the radius."""


class ArcError(Exception):
    """Error raised if numbers of a G-code line describe no arc: the reason, the geometric error and its limit, m."""

    def __init__(self, why: str, size: float, limit: float) -> None:
        super().__init__(why)
        self.why, self.size, self.limit = why, size, limit


def center_from_radius(start: Array, end: Array, radius: float, *, clockwise: bool, gap: float) -> Array:
    """Return the centre (2,), m, of an arc with given ends and radius; a negative radius selects the longer arc."""
    chord = end - start
    length = float(np.hypot(*chord))
    if length == 0:
        raise ArcError("an arc with R ends where it starts; give I, J, K for a full circle", 0.0, gap)
    deficit = length / 2 - abs(radius)
    if deficit > gap and deficit > RADIUS_SHARE * length / 2:
        raise ArcError(f"R is {deficit:.3g} m less than half the chord", deficit, gap)
    height = np.sqrt(max(radius**2 - length**2 / 4, 0.0))
    left = np.array([-chord[1], chord[0]]) / length
    return np.asarray((start + end) / 2 + (height if clockwise == (radius < 0) else -height) * left)


def arcs_about_center(
    start: Array, end: Array, center: Array, *, clockwise: bool, turns: int, plane: tuple[int, int, int], gap: float
) -> list[Arc | Helix]:
    """Return the arc or helix about a centre from start to end, or two arcs if no single centre fits both ends.

    Two are needed if a circle nearly closes but ends nearer to the centre (2,) than it starts. `turns` is the number of
    begun turns, `plane` has the indices of the first axis, the second axis and the normal, and `gap` is the largest
    difference of the distances from the centre that counts as rounding, m.

    Raises:
        ArcError: The distances from the centre differ by more than rounding.
    """
    in_plane, normal = list(plane[:2]), plane[2]
    first, last = start[in_plane], end[in_plane]
    radii = float(np.hypot(*(first - center))), float(np.hypot(*(last - center)))
    if min(radii) <= SHORTEST_SEGMENT:
        raise ArcError("the centre is the start or the end of the arc", max(radii), gap)
    difference = abs(radii[0] - radii[1])
    allowed = max(gap, min(RADIUS_SHARE * max(radii), 100 * gap))  # at most two digits fewer than usual
    if difference > allowed:
        why = f"start and end are {radii[0]:.6g} and {radii[1]:.6g} m from the centre: a difference of "
        raise ArcError(f"{why}{difference:.3g} m", difference, allowed)
    sweep = _sweep(first - center, last - center, clockwise)
    moved = _equidistant_center(center, first, last)
    # displacement of the arc's far side by moving the centre
    if np.hypot(*(moved - center)) * (1 - np.cos(sweep / 2)) <= max(2 * difference, gap):
        if (first != last).any():
            sweep = _sweep(first - moved, last - moved, clockwise)
        return [_arc_of_sweep(start, end, moved, clockwise, sweep + FULL_TURN * (turns - 1), plane)]
    half = (-sweep if clockwise else sweep) / 2
    cosine, sine = np.cos(half), np.sin(half)
    out = (first - center) * (radii[0] + radii[1]) / (2 * radii[0])
    middle = start.copy()
    middle[in_plane] = center + np.array([cosine * out[0] - sine * out[1], sine * out[0] + cosine * out[1]])
    total = sweep + FULL_TURN * (turns - 1)
    middle[normal] += (end[normal] - start[normal]) * sweep / 2 / total
    halves = []
    for begin, stop, extra in ((start, middle, 0.0), (middle, end, total - sweep)):
        own_center = _equidistant_center(center, begin[in_plane], stop[in_plane])
        turn = _sweep(begin[in_plane] - own_center, stop[in_plane] - own_center, clockwise)
        halves.append(_arc_of_sweep(begin, stop, own_center, clockwise, turn + extra, plane))
    return halves


def _equidistant_center(center: Array, first: Array, last: Array) -> Array:
    """Return the point nearest to `center` that is equidistant from two given points. Shape (2,) each."""
    chord = last - first
    square = float(chord @ chord)
    return center if square == 0 else np.asarray(center - ((center - (first + last) / 2) @ chord) / square * chord)


def _arc_of_sweep(
    start: Array, end: Array, center: Array, clockwise: bool, sweep: float, plane: tuple[int, int, int]
) -> Arc | Helix:
    """Return the arc from `start` that turns by `sweep`, or a helix if it rises or exceeds a full turn."""
    axis, middle = np.zeros(3), start.copy()
    axis[plane[2]] = -1.0 if clockwise else 1.0
    middle[list(plane[:2])] = center
    rise = float((end - start) @ axis)
    if sweep <= FULL_TURN * (1 + 1e-12) and abs(rise) <= STANDSTILL:
        return Arc(start, middle, axis, min(sweep, FULL_TURN))
    return Helix(start, middle, axis, sweep, rise)


def _sweep(first: Array, last: Array, clockwise: bool) -> float:
    """Return the angle from one vector to another in the given sense of rotation, in (0, 2 pi]."""
    angle = float(np.arctan2(first[0] * last[1] - first[1] * last[0], first @ last))
    angle = (-angle if clockwise else angle) % FULL_TURN
    return angle if angle > 1e-6 else FULL_TURN  # a smaller angle means a full circle


MOTIONS = (0, 10, 20, 30)
"""Codes of the motions G0, G1, G2 and G3, as ten times their numbers."""
GROUPS: dict[int, str] = {
    **dict.fromkeys((*MOTIONS, 330, 331, 382, 383, 384, 385, 730, 760, *range(810, 900, 10), 50, 51, 52, 53), "motion"),
    **dict.fromkeys(PLANES, "plane"),
    **dict.fromkeys((900, 910), "distances"),
    **dict.fromkeys((901, 911), "centres"),
    **dict.fromkeys((930, 940, 950), "feed mode"),
    **dict.fromkeys((200, 210), "units"),
    **dict.fromkeys((610, 611, 640), "path control"),
    **dict.fromkeys((*range(540, 600, 10), 591, 592, 593), "coordinate system"),
    **dict.fromkeys((400, 410, 411, 420, 421), "cutter compensation"),
}
"""Modal group of each G code, keyed by ten times its number; a line may have one code of each group."""
REPOST = "post the program without it"
UNSUPPORTED_CODES: dict[int, str] = {
    **dict.fromkeys((50, 51, 52, 53, 60, 61, 62), f"splines are not supported; {REPOST}, as G1, G2 and G3"),
    **dict.fromkeys((70, 330, 331, 760, 700, 710, 711, 712, 720, 721, 722), f"lathe words are not supported; {REPOST}"),
    **dict.fromkeys((120, 130), f"pocket cycles are not supported; {REPOST}"),
    **dict.fromkeys((160, 161), f"polar coordinates are not supported; {REPOST}"),
    **dict.fromkeys((310, 382, 383, 384, 385), f"the path of probing is not known in advance; {REPOST}"),
    **dict.fromkeys((410, 411, 420, 421), "cutter compensation is not supported; let the CAM compensate, or write G40"),
    **dict.fromkeys((650, 660, 670), f"macro calls are not supported; {REPOST}"),
    **dict.fromkeys((680, 510, 511), f"rotated and scaled coordinates are not supported; {REPOST}"),
    **dict.fromkeys((730, 740, *range(810, 900, 10)), f"canned cycles are not supported; {REPOST}, as G0 and G1"),
    100: f"offsets of the machine cannot be set here; {REPOST}",
    520: "local offsets are not supported; write G92, or post the program without it",
    923: "offsets kept from another program are not known; write G92 with numbers",
    950: "feed per revolution is not supported; write G94 and units per minute",
}
IGNORED_CODES: dict[int, str] = {
    80: "diameters off: already so",
    150: "polar coordinates off: already so",
    400: "cutter compensation off: already so",
    800: "canned cycles off: already so",
    **dict.fromkeys((430, 431, 440, 490), "tool length: the path is that of the tool's tip"),
    500: "scaling off: already so",
    690: "rotation off: already so",
    **dict.fromkeys((960, 970), "spindle mode, ignored"),
    **dict.fromkeys((980, 990), "return of canned cycles, ignored"),
}
_WORDS = {"S": "spindle speed, ", "T": "tool, ", "H": "tool length, ", "D": "tool diameter, ", "E": "extrusion, "}
IGNORED_LETTERS = {letter: f"{letter}: {_WORDS.get(letter, '')}ignored" for letter in "STHDELQ"}
M_WORDS = {
    **dict.fromkeys((0, 10, 600), "stop"),
    **dict.fromkeys((20, 300), "end"),
    **dict.fromkeys((970, 980, 990), "call"),
}
"""M words that affect the path, keyed by ten times their numbers; all other M words are ignored."""
MACHINE_CODES = (280, 281, 300, 301, 530)
"""G codes, as ten times their numbers, that move to, or store, positions that only the machine knows."""
WORD = re.compile(r"([A-Z])([+-]?(?:\d+\.?\d*|\.\d+))")
COMMENT = re.compile(r"\([^()]*\)")
DELETED = re.compile(r"^/\d*")
CHECKSUM = re.compile(r"\*\d+$")
EXPONENT = re.compile(r"[\d.]E[+-]?\d+(?![\d.])", re.IGNORECASE)
CONTROL, PROGRAM_NUMBER = re.compile(r"(N\d+)?O[\d<]"), re.compile(r"(N\d+)?O\d+")
NOT_RUN = "O-words (subroutines, loops, conditions) are not supported; post the program without them"


class Block(NamedTuple):
    """Words (letters with numbers) of one line of G-code.

    G and M words are in tenths: ("G", 901) is G90.1. A skipped line begins with `/`. All other words are by letter.
    """

    number: int
    text: str
    codes: tuple[tuple[str, int], ...]
    words: dict[str, float]
    skipped: bool


def read_blocks(file: FileName, lines: Sequence[str]) -> Iterator[Block]:
    """Yield a Block for each line of G-code that contains words, up to the line with `%` that ends the program.

    Raises:
        ProblemError: With the line: an invalid word, an unclosed comment, an expression, or a repeated letter.
    """
    inside = False
    for number, text in enumerate(lines, 1):
        try:
            words = _without_comments(text).upper().split()
            if words and words[0][0] == "%" and inside:
                return
            if words and words[0][0] != "%" and (block := _block(number, text, words)):
                yield block
        except _InvalidBlock as error:
            raise line_error(file, number, text, str(error)) from error
        inside = inside or bool(words)  # a lone % after words also ends the program


class _InvalidBlock(Exception):
    """Error raised if a line is not valid G-code."""


def _without_comments(text: str) -> str:
    """Return a line of G-code without its comments; raise an error if a comment is unclosed or nested."""
    line, semicolon, _ = text.partition(";") if "(" not in text.partition(";")[0] else (text, "", "")
    if not semicolon:
        line = COMMENT.sub(" ", text)
        line = line.partition(";")[0] if "(" not in line.partition(";")[0] else line
    if "(" in line or ")" in line:
        raise _InvalidBlock("a comment is unclosed or nested; close it with one ')'")
    return line


def _block(number: int, text: str, words: Sequence[str]) -> Block | None:
    """Return the words of a line, in upper case and without comments, as a block; None if the line has no words."""
    if exponent := EXPONENT.search(" ".join(words)):
        raise _InvalidBlock(f"{exponent[0]!r} is not a G-code number; write it without E")
    line = CHECKSUM.sub("", DELETED.sub("", "".join(words)))
    word_pairs = WORD.findall(line)
    if sum(len(letter) + len(value) for letter, value in word_pairs) != len(line):
        raise _InvalidBlock(_reason(line))
    codes, values = [], dict[str, float]()
    for letter, value in word_pairs:
        if letter in "GM":
            codes.append((letter, _tenths(letter, value)))
        elif letter == "O":
            if not PROGRAM_NUMBER.fullmatch(line):
                raise _InvalidBlock(NOT_RUN)
        elif letter != "N":
            if letter in values:
                raise _InvalidBlock(f"{letter} is repeated in one line; remove one")
            if len(value) > INPUT_LIMITS.number_characters:
                raise _InvalidBlock(f"{letter} has more than {INPUT_LIMITS.number_characters} digits")
            values[letter] = float(value)
    return Block(number, text, tuple(codes), values, words[0][0] == "/") if codes or values else None


def _tenths(letter: str, value: str) -> int:
    """Return ten times the number of a G or M code, because codes such as G38.2 have one decimal."""
    exact = float(value) * 10 if len(value) < 9 else -1.0
    if exact < 0 or abs(exact - round(exact)) > 1e-6:
        raise _InvalidBlock(f"{letter}{value} is not a code; codes have at most one decimal")
    return round(exact)


def _reason(line: str) -> str:
    """Return an error text about the part of a G-code line that does not consist of letters with numbers."""
    if CONTROL.match(line):
        return NOT_RUN
    if any(sign in line for sign in "#[]=<>"):
        return "parameters and expressions are not supported; post the program with plain numbers"
    return f"{WORD.sub('', line)[:20]!r} is not a G-code word (a letter and a number); correct it or make it a comment"


def code_name(tenths: int) -> str:
    """Return a G code, given in tenths, as it is written: "G90.1" for 901."""
    whole, rest = divmod(tenths, 10)
    return f"G{whole}.{rest}" if rest else f"G{whole}"
