"""What LinuxCNC's interpreter makes of a program, as moves to compare with.

`rs274` is its stand-alone interpreter (Debian's package linuxcnc-uspace; it may be unpacked with `dpkg -x`). It prints
a canonical call a line, lengths in the units of the program with four decimals. The files *.canon beside the programs
were made with LinuxCNC 2.9 by

    printf 'T1 P1 D1 ;\\nT3 P3 D1 ;\\n' > tools.tbl
    for file in *.ngc; do : > none.var; rs274 -g -n 2 -t tools.tbl -v none.var $file > ${file%.ngc}.canon; done
"""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models import Arc, Helix
from ocp.app.files import Cut, Program, Rapid

Array = NDArray[np.float64]
CALL = re.compile(r"^\s*\d+ N\S*\s+([A-Z0-9_]+)\((.*)\)\s*$")
PLANES = {"XY": (0, 1, 2), "XZ": (2, 0, 1), "YZ": (1, 2, 0)}


class Move(NamedTuple):
    """A move: of kind "rapid", "line" or "arc"; m, rad, m/s."""

    kind: str
    end: Array
    center: Array  # of an arc, on the height of its start; zero otherwise
    sweep: float  # of an arc, about the normal of its plane
    feed: float
    normal: int = 2  # of the plane of an arc: 0, 1, 2


def of_canonical(text: str) -> list[Move]:
    """Moves that have a length, of the lines that rs274 prints."""
    unit, plane, feed, here, offset = 1e-3, "XY", 0.0, np.zeros(3), np.zeros(3)
    moves: list[Move] = []
    for line in text.splitlines():
        if not (result := CALL.match(line)):
            continue
        call, options = result[1], [each.strip() for each in result[2].split(",")]
        if call == "USE_LENGTH_UNITS":
            unit = 0.0254 if "INCH" in options[0] else 1e-3
        elif call == "SET_G92_OFFSET":
            offset = unit * np.array([float(each) for each in options[:3]])
        elif call == "SELECT_PLANE":
            plane = options[0].rpartition("_")[2]
        elif call == "SET_FEED_RATE":
            feed = float(options[0]) * unit / 60
        elif call in ("STRAIGHT_TRAVERSE", "STRAIGHT_FEED"):
            end = offset + unit * np.array([float(each) for each in options[:3]])
            kind = "rapid" if call == "STRAIGHT_TRAVERSE" else "line"
            moves.append(Move(kind, end, np.zeros(3), 0.0, feed))
        elif call == "ARC_FEED":
            a, b, n = PLANES[plane]
            numbers = [float(each) for each in options[:6]]
            end, center = np.zeros(3), here.copy()
            end[[a, b, n]] = offset[[a, b, n]] + unit * np.array([numbers[0], numbers[1], numbers[5]])
            center[[a, b]] = offset[[a, b]] + unit * np.array(numbers[2:4])
            turns = round(numbers[4])
            first, last = here[[a, b]] - center[[a, b]], end[[a, b]] - center[[a, b]]
            angle = np.arctan2(first[0] * last[1] - first[1] * last[0], first @ last)
            sweep = (np.sign(turns) * angle) % (2 * np.pi)
            close = 2e-4 * unit / np.linalg.norm(first)
            sweep = 2 * np.pi if sweep < close or sweep > 2 * np.pi - close else sweep
            sweep = float(np.sign(turns) * (sweep + 2 * np.pi * (abs(turns) - 1)))
            moves.append(Move("arc", end, center, sweep, feed, n))
        if call not in ("STRAIGHT_TRAVERSE", "STRAIGHT_FEED", "ARC_FEED"):
            continue
        if np.linalg.norm(moves[-1].end - here) < 1e-9 and moves[-1].kind != "arc":
            moves.pop()
        else:
            here = moves[-1].end
    return moves


def of_program(program: Program) -> list[Move]:
    """The same of what was read."""
    moves: list[Move] = []
    for section in program.sections:
        if isinstance(section, Rapid):
            moves.append(Move("rapid", section.end, np.zeros(3), 0.0, 0.0))
        elif isinstance(section, Cut):
            last = 0
            for segment, feed, line in zip(section.path.segments, section.feeds, section.lines, strict=True):
                if isinstance(segment, Arc | Helix):
                    sense = float(np.sign(np.asarray(segment.axis).sum()))
                    end, center = np.asarray(segment.end), np.asarray(segment.center)
                    normal = int(np.abs(segment.axis).argmax())
                    before = moves.pop().sweep if line == last else 0.0  # two halves of one arc
                    moves.append(Move("arc", end, center, before + sense * segment.sweep, float(feed), normal))
                else:
                    moves.append(Move("line", np.asarray(segment.end), np.zeros(3), 0.0, float(feed)))
                last = line
    return moves


def differences(ours: list[Move], theirs: list[Move], digits: float) -> list[str]:
    """Where the two are not the same to the digits (m) that are printed."""
    wrong: list[str] = []
    if [move.kind for move in ours] != [move.kind for move in theirs]:
        return [f"{len(ours)} moves here, {len(theirs)} there, or of other kinds"]
    for i, (one, other) in enumerate(zip(ours, theirs, strict=True)):
        checks: list[tuple[str, Any, Any, float]] = [("end", one.end, other.end, digits)]
        if one.kind == "arc":
            # theirs is a spiral where the centre is not in the middle; ours has it moved
            inside = [axis for axis in range(3) if axis != other.normal]
            start = theirs[i - 1].end[inside] if i else np.zeros(2)
            radii = [float(np.linalg.norm(end - other.center[inside])) for end in (start, other.end[inside])]
            chord = max(float(np.linalg.norm(start - other.end[inside])), 1e-9)
            slack = digits + (abs(radii[0] - radii[1]) + digits) * max(1.0, 1.01 * max(radii) / chord)
            checks += [
                ("center", one.center, other.center, slack if chord > 1e-8 else 2 * digits),
                ("plane", one.normal, other.normal, 0.0),
                ("sweep", one.sweep, other.sweep, 5 * slack / max(radii)),
            ]
        if one.kind != "rapid":
            checks.append(("feed", one.feed, other.feed, 1e-5))
        wrong += [
            f"move {i}: {what} {mine} here, {its} there"
            for what, mine, its, slack in checks
            if np.abs(np.asarray(mine) - its).max() > slack
        ]
    return wrong
