"""Motions of several legs: through points on the way, and with loads that are picked up and put down.

Each leg is a phase of its own, `dynamics_problem` with the machine that moves on it, from where the leg before ended.
What goes on from one into the next are the joints and how the base lies, the velocities where the machine does not rest
there, and the accelerations where the jerk is the control.

A load that is picked up or put down changes the machine. It does so at rest: then nothing has to be brought to speed,
joints and base stay where they are, and the momentum of a machine that floats, which is zero before, is zero after,
too. A load that is grasped while it moves jumps in velocity, as after an impact; that is a join of `Phases` to be said
by hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Unpack

import numpy as np

from models import FreeFloating
from ocp.builders.clearance import Clear
from ocp.builders.drives import Motors, checked_motors
from ocp.builders.dynamics import AskedOfDrives, dynamics_problem
from ocp.builders.standing.problem import FreeTime
from ocp.console import interruptible
from ocp.errors import ProblemError, checked_choice, checked_each, checked_instance, checked_text
from ocp.problem.phases import DURATION, Phases
from ocp.tasks.checks import checked_horizon
from ocp.tasks.tip_task import TipTask

__all__ = ["Leg", "checked_legs", "dynamics_phases"]


@dataclass(frozen=True, eq=False)
class Leg:
    """A part of a motion, to a point at which something changes or that is to be passed.

    Attributes:
        joints: Where it ends, rad or m, shape (n,); nan where free, None: all are.
        horizon: How long it takes, s, or FreeTime(...).
        end: Whether the joints are at rest at its end, or free to move on through it.
        machine: What moves on it, `with_load` or without; None: as on the leg before.
        tasks: What the tips do on it, of the time since its beginning, which is at joints that are told.
        name: Of its phase; "leg 1", "leg 2", ... if "".
    """

    joints: Any
    horizon: float | FreeTime
    end: Literal["rest", "free"] = "rest"
    machine: Motors | None = None
    tasks: TipTask | Sequence[TipTask] = ()
    name: str = ""


@interruptible
def dynamics_phases(
    machine: Motors,
    start_joints: Any,
    legs: Sequence[Leg],
    *,
    total: float | None = None,
    clear: Clear | None = None,
    **asked: Unpack[AskedOfDrives],
) -> Phases:
    """Legs one after the other as one problem, at the least cost of all together.

    Args:
        machine: On the first leg, unless that says its own.
        start_joints: Shape (n,), rad or m.
        legs: At least one; all have the joints of the machine.
        total: Time of all legs together, s, where theirs are free; None: as long as is best.
        clear: What the motion has to stay clear of, on legs whose machine is that of its surroundings.
        asked: Of all legs, as of `dynamics_problem`; `start` and `start_base` where the first begins, `end_base`
            where the last ends.

    Raises:
        ProblemError: As `dynamics_problem`; no legs, another number of joints or another kind of base, a machine that
            changes where it does not rest or carries momentum, a leg with tasks from joints that are not told, a total
            that the legs cannot have, what a leg says itself.
    """
    given = checked_legs(legs)
    if clear is not None:
        checked_instance("dynamics_phases: clear", clear, Clear)
    for what in ("end_joints", "tasks", "end"):
        if what in asked:
            raise ProblemError(f"{what}: legs say it themselves, Leg({what}=...)", name=what, value=asked.get(what))
    names = [leg.name or f"leg {k + 1}" for k, leg in enumerate(given)]
    if len(set(names)) < len(names):
        raise ProblemError(f"legs: names {names} are not all different", name="legs", value=names)
    movers, problems = _machines(machine, given, names), {}
    options: dict[str, Any] = {
        name: value for name, value in asked.items() if name not in ("start", "start_base", "end_base")
    }
    begin: Any = start_joints
    for k, (name, leg) in enumerate(zip(names, given, strict=True)):
        known = begin is not None and not np.isnan(np.asarray(begin, dtype=float)).any()
        if k and not known and not (isinstance(leg.tasks, Sequence) and not leg.tasks):
            words = f"{name}: its tasks begin where the leg before ends; tell all joints there"
            raise ProblemError(words, name=name, value=begin)
        own: dict[str, Any] = {"start": asked.get("start", "rest") if k == 0 else given[k - 1].end}
        own["start_base"] = asked.get("start_base") if k == 0 else np.full(movers[k].base_size, np.nan)
        if k == len(given) - 1:
            own["end_base"] = asked.get("end_base")
        kept = clear if clear is not None and clear.surroundings.machine is movers[k] else None
        problems[name] = dynamics_problem(
            movers[k], begin, leg.horizon, end_joints=leg.joints, tasks=leg.tasks, end=leg.end, clear=kept,
            **own, **options,
        )  # fmt: skip
        begin = leg.joints
    phases = Phases("legs", problems)
    for k in range(1, len(given)):
        _join(phases, names[k - 1], names[k], given[k - 1])
    if total is not None:
        duration = checked_horizon(total)
        if not any(isinstance(leg.horizon, FreeTime) for leg in given):
            words = "total: every leg tells its own time; let one of them be free"
            raise ProblemError(words, name="total", value=total)
        last = phases[names[-1]]
        phases.end("total time", last.begin + last.duration - duration, lower=0.0, upper=0.0, unit="s")
    return phases


def checked_legs(legs: Any) -> tuple[Leg, ...]:
    """Legs as a tuple.

    Raises:
        ProblemError: None, or something else; ends that are neither at rest nor free, a name that is no text.
    """
    given = checked_each("legs", legs, Leg)
    if not given:
        raise ProblemError("legs: at least one is needed", name="legs", value=legs)
    for leg in given:
        checked_choice("leg: end", leg.end, ("rest", "free"))
        checked_text("leg: name", leg.name)
    return tuple(given)


def _machines(machine: Motors, legs: Sequence[Leg], names: Sequence[str]) -> list[Motors]:
    """What moves on each leg."""
    found = [checked_motors("dynamics_phases", machine)]
    for k, (name, leg) in enumerate(zip(names, legs, strict=True)):
        own = found[-1] if leg.machine is None else checked_motors(name, leg.machine)
        before = found[-1]
        if (own.joint_size, own.base_size) != (before.joint_size, before.base_size):
            words = f"{name}: its machine has {own.joint_size} joints and a base of {own.base_size}, the one before "
            words += f"{before.joint_size} and {before.base_size}"
            raise ProblemError(words, name=name, value=own.joint_size, limit=before.joint_size)
        if k and own is not before:
            if legs[k - 1].end != "rest":
                words = f"{name}: a load is picked up or put down at rest; say Leg(end='rest') of {names[k - 1]!r}"
                raise ProblemError(words, name=name, value=legs[k - 1].end, limit="rest")
            for one in (own, before):
                if isinstance(one, FreeFloating) and np.any(np.asarray(one.conserved_momentum)):
                    words = f"{name}: a load that is at rest is picked up by a machine without momentum"
                    raise ProblemError(words, name="conserved_momentum", value=one.conserved_momentum, limit=0.0)
        found.append(own)
    return found[1:]


def _join(phases: Phases, before: str, after: str, leg: Leg) -> None:
    """What of one leg goes on in the next: all that is not told at both ends already."""
    told: dict[str, Any] = {}
    if leg.joints is not None and not np.isnan(np.asarray(leg.joints, dtype=float)).any():
        told["joints"] = None
    if leg.end == "rest":
        told |= {"velocities": None, "accelerations": None}
    states = [name for name in phases.of(after) if f"{after}.{name}" in phases.declared.states and name != DURATION]
    if any(told.get(name, "joined") is not None for name in states):
        phases.join(before, after, {name: value for name, value in told.items() if name in states})
