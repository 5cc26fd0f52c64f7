"""A module that takes what `rerun` takes, and notes it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any


def recorder() -> Any:
    """What `log_rerun` calls of the module, which notes it under `noted`."""
    noted: dict[str, Any] = {}

    class Columns:
        @staticmethod
        def columns(**options: Any) -> dict[str, Any]:
            return options

    return SimpleNamespace(
        noted=noted,
        Scalars=Columns,
        Points3D=Columns,
        TimeColumn=lambda name, duration: (name, duration),
        LineStrips3D=lambda lines: lines,
        log=lambda path, what, static: noted.update({path: what}),
        send_columns=lambda path, indexes, columns: noted.update({path: (indexes, columns)}),
    )
