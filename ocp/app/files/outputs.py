"""Check where outputs may be written: below a folder, with the suffix of their kind, never over a foreign file.

The contents of a file show whether selfmotion wrote it. Formats with a place for it name the program; the header of a
table or of a message has a fixed form; a plan is read.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

from models.files import open_regular
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
SIGNATURES = {
    "json": re.compile(rb'\{"header": \{"stamp": \{"sec": 0, "nanosec": 0\}, "frame_id": ""\}, "joint_names": \['),
    "yaml": re.compile(rf"# {MARK}\n".encode()),
    "mcap": re.compile(rb"\x89MCAP0\r\n\x01.{8}\x04\0\0\0ros2.{4}[ -~]{1,99}\x0c.{8}\x0a\0\0\0selfmotion", re.DOTALL),
    "urdf": re.compile(rf"<\?xml [^>]*>\n<!-- {MARK} -->\n".encode()),
    "report": re.compile(rb'<!doctype html>\n<html[^>]*>\s*<head>\s*<meta name="generator" content="selfmotion">'),
}
"""First bytes of files that selfmotion writes, by kind."""


def checked_output(kind: str, file: str | os.PathLike[str], folder: Path | None = None, force: bool = False) -> Path:
    """Return the path to which an output is written, with links resolved.

    Args:
        kind: Key of SUFFIXES.
        file: Requested name.
        folder: Folder in or below which the output must be; None: anywhere.
        force: Whether a file that selfmotion did not write may be overwritten.

    Raises:
        ProblemError: The name has a wrong suffix or unprintable characters, is outside of the folder, or belongs to a
            foreign file.
    """
    if not str(file).isprintable():
        raise ProblemError(f"{str(file)!r} is not a valid file name; use printable characters", name=kind, value=file)
    path = Path(os.path.realpath(file))
    if path.suffix.lower() not in SUFFIXES[kind]:
        link = "" if path.name == Path(file).name else f" (a link to {path})"
        message = f"{file}{link} does not have the suffix of a {kind}; end it with {' or '.join(SUFFIXES[kind])}"
        raise ProblemError(message, name=kind, value=str(file), limit=SUFFIXES[kind])
    if folder is not None and not path.is_relative_to(os.path.realpath(folder)):
        message = f"{file} is outside of {folder}; name a file below it, or choose another folder with --output-folder"
        raise ProblemError(message, name=kind, value=str(file), limit=str(folder))
    if not force and os.path.lexists(path) and not _is_own(kind, path):
        message = f"{file} exists and was not written by selfmotion; name another file, or overwrite it with --force"
        raise ProblemError(message, name=kind, value=str(file))
    return path


def _is_own(kind: str, path: Path) -> bool:
    """Return whether selfmotion wrote the file."""
    try:
        if kind == "plan":
            return "head" in read_arrays(path)
        with open_regular(path, sys.maxsize) as stream:
            start = stream.read(2**20)  # enough for the header of a table with some thousand joints
    except (OSError, ProblemError):
        return False
    if kind == "csv":
        return bool(table_joints(start.partition(b"\n")[0].decode(errors="replace").split(",")))
    return SIGNATURES[kind].match(start) is not None
