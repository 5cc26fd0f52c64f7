"""Where outputs may be written: below a folder, with the suffix of their kind, and over no file of somebody else.

Whether selfmotion wrote a file is seen from its contents: formats that have a place for it name the program, the head
of a table or of a message is as it is written here, and a plan is read.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

from models.input_files import open_regular
from ocp.errors import ProblemError
from ocp.storage import read_arrays, table_joints

__all__ = ["MARK", "SUFFIXES", "checked_output"]

MARK = "written by selfmotion"
SUFFIXES = {
    "plan": (".npz",),
    "csv": (".csv",),
    "json": (".json",),
    "yaml": (".yaml", ".yml"),
    "mcap": (".mcap",),
    "urdf": (".urdf",),
    "report": (".html", ".htm"),
}
BEGINNINGS = {
    "json": re.compile(rb'\{"header": \{"stamp": \{"sec": 0, "nanosec": 0\}, "frame_id": ""\}, "joint_names": \['),
    "yaml": re.compile(rf"# {MARK}\n".encode()),
    "mcap": re.compile(rb"\x89MCAP0\r\n\x01.{8}\x04\0\0\0ros2.{4}[ -~]{1,99}\x0c.{8}\x0a\0\0\0selfmotion", re.DOTALL),
    "urdf": re.compile(rf"<\?xml [^>]*>\n<!-- {MARK} -->\n".encode()),
    "report": re.compile(rb'<!doctype html>\n<html[^>]*>\s*<head>\s*<meta name="generator" content="selfmotion">'),
}


def checked_output(kind: str, file: str | os.PathLike[str], folder: Path | None = None, force: bool = False) -> Path:
    """Return the path to which an output of a kind is written, with links followed.

    Args:
        kind: One of SUFFIXES.
        folder: Where the output must lie, or below; None for anywhere.
        force: Whether a file is overwritten that selfmotion did not write.

    Raises:
        ProblemError: The name has another suffix or strange characters, lies elsewhere, or is taken by such a file.
    """
    if not str(file).isprintable():
        raise ProblemError(f"{str(file)!r} is no name for an output; use printable characters", name=kind, value=file)
    place = Path(os.path.realpath(file))
    if place.suffix.lower() not in SUFFIXES[kind]:
        at = "" if place.name == Path(file).name else f" (a link to {place})"
        words = f"{file}{at} would be no {kind} by its name; end it with {' or '.join(SUFFIXES[kind])}"
        raise ProblemError(words, name=kind, value=str(file), limit=SUFFIXES[kind])
    if folder is not None and not place.is_relative_to(os.path.realpath(folder)):
        words = f"{file} lies outside of {folder}; name a file below it, or allow another folder by --output-folder"
        raise ProblemError(words, name=kind, value=str(file), limit=str(folder))
    if not force and os.path.lexists(place) and not _is_own(kind, place):
        words = f"{file} is there and was not written by selfmotion; name another file, or overwrite it by --force"
        raise ProblemError(words, name=kind, value=str(file))
    return place


def _is_own(kind: str, place: Path) -> bool:
    try:
        if kind == "plan":
            return "head" in read_arrays(place)
        with open_regular(place, sys.maxsize) as stream:
            start = stream.read(2**20)  # the head of a table of some thousand joints
    except (OSError, ProblemError):
        return False
    if kind == "csv":
        return bool(table_joints(start.partition(b"\n")[0].decode(errors="replace").split(",")))
    return BEGINNINGS[kind].match(start) is not None
