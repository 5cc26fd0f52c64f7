"""Plans within what the drives of a machine give: torques, power, accelerations and jerks that are limited.

The cheapest motions without these limits come first, by all that `plan` does. Each is the guess of the same problem at
the level of accelerations, with the same cost. Under more limits no motion is cheaper than the one that it comes from:
those that were dearer without them than the best is within them are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from models.arrays import Array
from ocp.builders.clearance import Clear
from ocp.builders.drives import checked_motors, joint_torques
from ocp.builders.dynamics_plan import within_limits
from ocp.builders.tool_motion import ToolMotion
from ocp.direct.guess import Samples
from ocp.errors import SolveError
from ocp.planning.motion import Candidate, Plan
from ocp.planning.postures import Asked
from ocp.planning.request import declared_motion
from ocp.problem.problem import Problem
from ocp.solution import Solution
from ocp.tasks.limits import Limits

__all__ = ["Demand", "driven_plan", "limits_drives", "without_drives"]

DRIVES = ("acceleration", "jerk", "torque", "power")
LOOKED_AT = 2001
"""Times at which it is looked what a motion takes, and fractions of a guess."""
SAME_PLACE = 1e-9
"""rad or m: of a joint where it is held."""
SAME = 1e-5
"""Share of its cost by which a motion without the limits may be dearer than one within them, and become cheaper."""


def limits_drives(limits: Limits) -> bool:
    """Whether anything but positions and rates is limited."""
    return any(getattr(limits, what) is not None for what in DRIVES)


def without_drives(limits: Limits) -> Limits:
    """Those of positions and rates alone."""
    return replace(limits, acceleration=None, jerk=None, torque=None, power=None)


@dataclass(frozen=True)
class Demand:
    """What a motion takes most of, as a share of its limit.

    Attributes:
        what: "torque", ... joint: Its name. time: s. asked, allowed: In `unit`.
    """

    what: str
    joint: str
    time: float
    asked: float
    allowed: float
    unit: str

    def __str__(self) -> str:
        return (
            f"{self.what} of {self.joint!r} is {self.asked:.4g} {self.unit} at {self.time:.4g} s, "
            f"{self.allowed:.4g} allowed"
        )

    @classmethod
    def of(cls, plan: Plan, limits: Limits) -> Demand | None:
        """Of a plan; None where no drive is limited."""
        machine = checked_motors("limits", plan.machine)
        robot, bounds = machine.robot, limits.bounds(machine)
        sample = plan.sampled(np.linspace(0.0, plan.horizon, LOOKED_AT))
        bases = plan.at(sample.t)["base"] if machine.base_size else np.zeros((LOOKED_AT, 0))
        symbols = [ca.SX.sym("v", size) for size in (machine.base_size, *[machine.joint_size] * 3)]
        torques_at = ca.Function("torques", symbols, [joint_torques(machine, *symbols)])
        torques = np.array(
            torques_at.map(LOOKED_AT)(bases.T, sample.joints.T, sample.rates.T, sample.accelerations.T)
        ).T
        worst: tuple[float, Demand] | None = None
        for what, values, most, units in (
            ("acceleration", np.abs(sample.accelerations), bounds.acceleration, ("rad/s^2", "m/s^2")),
            ("torque", np.abs(torques), bounds.torque, ("N m", "N")),
            ("power", torques * sample.rates, bounds.power, ("W", "W")),
        ):
            shares = values / most
            if not np.isfinite(most).any():
                continue
            row, joint = np.unravel_index(int(np.argmax(shares)), shares.shape)
            if worst is None or shares[row, joint] > worst[0]:
                kind = robot.moving_joints[joint].kind
                told = float(sample.t[row]), float(values[row, joint]), float(most[joint])
                worst = shares[row, joint], cls(what, robot.joint_names[joint], *told, units[kind == "prismatic"])
        return None if worst is None else worst[1]


def driven_plan(asked: Asked, start: Array | None, reference: Array, free: Plan, limits: Limits) -> Plan:
    """The cheapest motion within the limits of the drives, from the motions of a plan without them.

    Args:
        asked: What is asked. start, reference: As of `tool_motion_problem`.
        free: The plan without limits of drives. limits: With them.

    Raises:
        SolveError: No motion holds the limits; names the joint, when, what it takes without the limit and what it may.
    """
    told: list[Candidate] = []
    best: Candidate | None = None
    first: tuple[SolveError, Demand | None] | None = None
    for one in free.candidates:
        if one.solution is None or (best is not None and one.cost > best.cost * (1 + SAME)):
            told.append(replace(one, why=one.why or "dearer", solution=None))
            continue
        moved = Plan(free.machine, one.solution, free.parts)
        demand = Demand.of(moved, limits)
        beyond = f"without the limits of its drives, {demand}" if demand and demand.asked > demand.allowed else ""
        try:
            solution = _solved(asked, start, reference, moved, limits)
        except SolveError as error:
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise
            first = first or (error, demand)
            why = "; ".join(part for part in (beyond, _brief(error)) if part)
            told.append(Candidate(one.start, np.nan, why))
            continue
        found = Candidate(one.start, solution.cost, "", solution)
        if best is not None:
            told.append(
                replace(max(best, found, key=_cost), why="; ".join(part for part in ("dearer", beyond) if part))
            )
        best = found if best is None else min(best, found, key=_cost)
    if best is None:
        assert first is not None
        cause, demand = first
        words = "no motion holds the limits of its drives"
        words += f": without them {demand}" if demand is not None else ""
        details: dict[str, Any] = {"name": cause.name, "value": cause.value, "limit": cause.limit, "time": cause.time}
        if demand is not None and demand.asked > demand.allowed:
            details = {"name": demand.joint, "value": demand.asked, "limit": demand.allowed, "time": demand.time}
        raise SolveError(f"{words}\n{cause}", cause.solution, cause.conflicts, **details) from cause
    assert best.solution is not None
    return replace(free, solution=best.solution, candidates=(best, *told), _audits={})


def _cost(one: Candidate) -> float:
    return one.cost


def _brief(error: SolveError) -> str:
    """The line of an error that says most."""
    lines = [line.strip() for line in str(error).split("\n")]
    return next((line for line in lines if "beyond its" in line), lines[-1] if len(lines) > 1 else lines[0])


def _solved(asked: Asked, start: Array | None, reference: Array, moved: Plan, limits: Limits) -> Solution:
    """A motion within the limits, from one without; judged from its own start where many are as good."""
    if asked.start is None and start is not None:
        # a joint that began elsewhere is not ignorable: bodies are held apart by it
        start = np.where(np.abs(moved.at(0.0)["joints"] - start) <= SAME_PLACE, start, np.nan)

    def declared(begin: Array | None, clear: Clear | None) -> ToolMotion:
        return declared_motion(asked, start=begin, reference=reference, clear=clear, limits=limits)

    def planned(begin: Array | None) -> Solution:
        def declare(clear: Clear | None) -> Problem:
            motion = declared(begin, clear)
            _guess(motion, moved)
            return motion.problem

        return within_limits(declare, asked.clear, None, _breaks(asked), None, None, {"": (asked.machine, limits)})

    solution = planned(start)
    audit = solution.audit()
    if audit.feasible and audit.optimal is None and (start is None or np.isnan(start).any()):
        held = planned(solution[f"joints{asked.stretches[0].suffix}"][0])
        if held.audit().passed:
            return held
    return solution


def _breaks(asked: Asked) -> list[float]:
    """Fractions of the horizon at which tasks are less smooth."""
    parts = [(stretch.breaks - stretch.begin) / stretch.duration for stretch in asked.stretches]
    return np.unique(np.concatenate([np.zeros(0), *parts])).tolist()  # type: ignore[no-any-return]


def _guess(motion: ToolMotion, moved: Plan) -> None:
    """Give the states and controls of a problem the values of a motion without drives."""
    fractions = np.linspace(0.0, 1.0, LOOKED_AT)
    sample = moved.solution.at_fraction(fractions)
    for stretch, part in zip(motion.stretches, moved.parts, strict=True):
        given = {
            "base": sample.get(f"base{stretch.suffix}"),
            "joints": sample[f"joints{stretch.suffix}"],
            "velocities": sample[moved.rated + stretch.suffix],
            "accelerations": moved._accelerations(part, fractions),
        }
        for name, values in given.items():
            for pool in (motion.problem.declared.states, motion.problem.declared.controls):
                if values is not None and (own := pool.get(name + stretch.suffix)) is not None:
                    pool[own.name] = replace(own, guess=Samples(fractions * motion.horizon, values))
