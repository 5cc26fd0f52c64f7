"""A machine as plain values, to be written to a file with the plan made for it, and read again."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

import casadi as ca
import numpy as np

from models import (
    CollisionShape,
    FixedBase,
    FreeFloating,
    Joint,
    Link,
    Machine,
    Mimic,
    ModelError,
    Robot,
    Standing,
    Support,
    VisualShape,
)
from ocp.errors import NOT_NUMBERS, ProblemError

__all__ = ["machine_of", "written_machine"]

MACHINES = (FixedBase, FreeFloating, Standing)
KINDS = {kind.__name__: kind for kind in (*MACHINES, Robot, Link, Joint, Mimic, CollisionShape, VisualShape, Support)}


def written_machine(machine: Machine) -> dict[str, Any]:
    """A machine of `models` as what JSON can hold.

    Raises:
        ProblemError: A machine of another kind, or with parts of such.
    """
    written: dict[str, Any] = _written(machine)
    return written


def machine_of(written: Any) -> Machine:
    """The machine that `written_machine` wrote.

    Raises:
        ProblemError: It is something else.
    """
    try:
        found = _read(written)
    except (*NOT_NUMBERS, KeyError, AttributeError, ModelError) as error:
        raise ProblemError(f"the machine that was written is damaged: {error}", name="machine") from error
    if not isinstance(found, MACHINES):
        raise ProblemError(f"what was written is no machine but {type(found).__name__}", name="machine")
    made: Machine = found
    return made


def _written(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        kind = type(value).__name__
        if KINDS.get(kind) is not type(value):
            words = f"a machine with a {kind} cannot be written to a file; save the plan's solution alone"
            raise ProblemError(words, name="machine", value=kind)
        given = {part.name: _written(getattr(value, part.name)) for part in fields(value) if part.init}
        return {"kind": kind, "fields": given}
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, tuple | list):
        return [_written(part) for part in value]
    if isinstance(value, np.ndarray | np.number | ca.DM):
        return np.asarray(value.full() if isinstance(value, ca.DM) else value, dtype=float).tolist()
    words = f"a machine with {value!r} cannot be written to a file; save the plan's solution alone"
    raise ProblemError(words, name="machine", value=repr(value))


def _read(value: Any) -> Any:
    if isinstance(value, dict):
        return KINDS[value["kind"]](**{name: _read(part) for name, part in value["fields"].items()})
    if isinstance(value, list):
        return tuple(_read(part) for part in value)
    return value
