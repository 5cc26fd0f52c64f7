"""Tables as CSV: names and texts in them mean nothing to a spreadsheet or a shell, and are read back."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any
from urllib.parse import unquote

__all__ = ["cell", "column_name", "joint_name", "table_head", "table_joints"]

ENDS = ("", ".velocity", ".acceleration")
STRANGE = re.compile(r"[^\w./: -]|^[^\w]| $")
"""What is written as %XX: all but letters, digits and signs that mean nothing within a name.

At the beginning `-` would begin a formula, `/` a command, and blanks at the ends would be lost.
"""


FORMULA = re.compile(r"^[=+\-@\t\r%]")
"""What begins a formula in a spreadsheet, and the sign by which it is written in a cell."""


def column_name(name: str) -> str:
    """Return a joint's name as it stands in the head of a table, with strange characters as %XX of their UTF-8."""
    return STRANGE.sub(_quoted, name)


def cell(value: Any) -> Any:
    """Return a value as it stands in a cell: a text that a spreadsheet would take for a formula begins with %XX."""
    return FORMULA.sub(_quoted, value) if isinstance(value, str) else value


def _quoted(sign: re.Match[str]) -> str:
    return "".join(f"%{byte:02X}" for byte in sign[0].encode(errors="surrogatepass"))


def joint_name(column: str) -> str:
    """Return the name that :func:`column_name` wrote."""
    return unquote(column, errors="surrogatepass")


def table_head(names: Sequence[str]) -> list[str]:
    """Return the head of the table of a plan: time, and positions, velocities and accelerations of joints."""
    return ["time", *(column_name(name) + end for end in ENDS for name in names)]


def table_joints(head: Sequence[str]) -> tuple[str, ...]:
    """Return the joints of a head that :func:`table_head` made; none where another program or person wrote it."""
    try:
        names = tuple(map(joint_name, head[1 : 1 + len(head) // 3]))
    except UnicodeDecodeError:
        return ()
    return names if list(head) == table_head(names) and len(set(names)) == len(names) else ()
