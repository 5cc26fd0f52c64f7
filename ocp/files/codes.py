"""The words of G-code that a path can be read from, those it cannot, and those that do not change it.

Codes are in tenths: 901 is G90.1. The numbers are those of the LinuxCNC manual, "G-Codes" and "M-Codes"; where another
dialect uses a code otherwise, it is refused.
"""

from __future__ import annotations

from ocp.files.arcs import PLANES

__all__ = [
    "CALLS",
    "ENDS",
    "GROUPS",
    "KEPT",
    "LETTERS",
    "MACHINE",
    "MOTIONS",
    "NONMODAL",
    "POST",
    "REFUSED",
    "STOPS",
    "code_name",
]

MOTIONS = (0, 10, 20, 30)
"""G0, G1, G2, G3."""

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
"""Of G codes, in tenths, of which a line may have one."""

POST = "post the program without it"
REFUSED: dict[int, str] = {
    **dict.fromkeys((50, 51, 52, 53, 60, 61, 62), f"splines are not read; {POST}, as G1, G2 and G3"),
    **dict.fromkeys((70, 330, 331, 760, 700, 710, 711, 712, 720, 721, 722), f"lathe words are not read; {POST}"),
    **dict.fromkeys((120, 130), f"pocket cycles are not read; {POST}"),
    **dict.fromkeys((160, 161), f"polar coordinates are not read; {POST}"),
    **dict.fromkeys((310, 382, 383, 384, 385), f"probing has no path that is known before; {POST}"),
    **dict.fromkeys((410, 411, 420, 421), "cutter compensation is not read; let the CAM compensate, or write G40"),
    **dict.fromkeys((650, 660, 670), f"macro calls are not run; {POST}"),
    **dict.fromkeys((680, 510, 511), f"rotated and scaled coordinates are not read; {POST}"),
    **dict.fromkeys((730, 740, *range(810, 900, 10)), f"canned cycles are not read; {POST}, as G0 and G1"),
    100: f"offsets of the machine cannot be set here; {POST}",
    520: "local offsets are not read; write G92, or post the program without it",
    923: "offsets kept from another program are not known; write G92 with numbers",
    950: "feed per revolution is not read; write G94 and units per minute",
}
KEPT: dict[int, str] = {
    80: "diameters off: so it is",
    150: "polar coordinates off: so it is",
    400: "cutter compensation off: so it is",
    800: "canned cycles off: so it is",
    430: "tool length: the path is that of the tool's tip",
    431: "tool length: the path is that of the tool's tip",
    440: "tool length: the path is that of the tool's tip",
    490: "tool length: the path is that of the tool's tip",
    500: "scaling off: so it is",
    690: "rotation off: so it is",
    960: "spindle mode, passed over",
    970: "spindle mode, passed over",
    980: "return of canned cycles, passed over",
    990: "return of canned cycles, passed over",
}
LETTERS: dict[str, str] = {
    "S": "S: spindle speed, passed over",
    "T": "T: tool, passed over",
    "H": "H: tool length, passed over",
    "D": "D: tool diameter, passed over",
    "E": "E: extrusion, passed over",
    "L": "L: passed over",
    "Q": "Q: passed over",
}
STOPS, ENDS = (0, 10, 600), (20, 300)  # M words
CALLS = {970: "M97", 980: "M98", 990: "M99"}
MACHINE = (280, 281, 300, 301, 530)
"""G words that lead to, or store, positions which the machine knows."""
NONMODAL = (40, 90, 920, 921, 922, *MACHINE)


def code_name(tenths: int) -> str:
    """Of a G code as it is written."""
    whole, rest = divmod(tenths, 10)
    return f"G{whole}.{rest}" if rest else f"G{whole}"
