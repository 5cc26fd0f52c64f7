"""Whether steps can be taken in the times that are asked: the quickest ones on a coarse mesh, and a guess out of them.

A step that is asked too fast has no plan, and a solver that looks for one may look for long. With durations that may
be longer than asked, at a price beside which all else is small, there nearly always is one: with the durations that
are asked where that can be, else with the least that have to be longer. A few intervals tell them to a percent or two.
What is found is a local minimum, as plans are, so that it is no proof, but it holds everything else that is asked; and
steps are refused only where a solver that starts from the times that are asked finds none there either.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ocp.builders.standing.problem import FreeTime
from ocp.builders.standing.stances import Steps
from ocp.builders.standing.steps import StepWeights, steps_problem
from ocp.console import time_left
from ocp.direct.collocation import Collocation
from ocp.errors import SolveError
from ocp.methods import solve
from ocp.problem.formulation import Formulation
from ocp.problem.phases import DURATION, Phases
from ocp.solution import Solution
from ocp.status import SolverStatus

__all__ = ["guess_in_time"]

COARSE = Collocation(4, degree=2, scheme="legendre")
ROUGHLY = {"tol": 1e-4, "acceptable_tol": 1e-3, "acceptable_iter": 5}
"""Of IPOPT: what is wanted are durations to a percent."""


@dataclass(frozen=True)
class PaceSettings:
    """How it is found out whether steps can be taken in their times, on a coarse mesh.

    Attributes:
        iterations: For steps in the times that are asked, where longer ones are found; those that exist took 31 to 51.
        near: Share of a duration by which so coarse a mesh may be wrong: 3 and 12 intervals differ by up to .016.
        price: Of a duration once more, over those of accelerations and rates of a radian in that time.
        longer: Durations of the guess, over those that are asked.
        longest: The longest durations, over those that are asked.
        samples: Of a phase, at which it is looked what is at its limit.
        met: Distance from a limit, over the way that it has along the motion, at which a row counts as at its limit.
        told: Limits that are named, at most.
    """

    iterations: int = 60
    near: float = 0.05
    price: float = 1e4
    longer: float = 5.0
    longest: float = 50.0
    samples: int = 21
    met: float = 0.01
    told: int = 3


PACE = PaceSettings()


def guess_in_time(
    steps: Steps, start_joints: Any, asked: Mapping[str, Any], options: Mapping[str, Any]
) -> dict[str, Any] | None:
    """A guess for `steps_problem`: steps in the times that are asked, on a coarse mesh; None where none are found.

    Args:
        asked: Options of steps_problem. options: Of IPOPT.

    Raises:
        SolveError: The quickest steps that were found take longer, and none were found in the times that are asked:
            `name` is the phase that takes longest for what is asked, `value` and `limit` its durations found and asked,
            s. Or however long they take, something else has to give way, which its `conflicts` tell.
    """
    seconds = {
        name: phase.seconds
        for name, phase in zip(steps.names, steps.phases, strict=True)
        if not isinstance(phase.duration, FreeTime)
    }
    problem = _unhurried(steps, start_joints, asked, seconds)
    found = solve(problem, COARSE, options={**options, **ROUGHLY}, check=False)
    if not found.success:
        if time_left() > 0:
            _check_conflicts(problem, found)
        return None
    spans = {name: end - begin for name, (begin, end) in found.phases.items()}
    if any(spans[name] > (1 + PACE.near) * each for name, each in seconds.items()):
        # a minimum beside may be quicker
        brief = {**options, **ROUGHLY, "max_iter": PACE.iterations}
        asked_for = solve(steps_problem(steps, start_joints, **asked), COARSE, options=brief, check=False)
        if not asked_for.success:
            raise _too_fast(problem, found, seconds, spans)
        found = asked_for
    told = [f"{name}.{DURATION}" for name in seconds]
    return {
        name: lambda share, name=name: found.at_fraction(share)[name]
        for name in (*found.states, *found.controls)
        if name not in told
    }


def _unhurried(steps: Steps, start_joints: Any, asked: Mapping[str, Any], seconds: Mapping[str, float]) -> Phases:
    """The same steps with durations of at least so many seconds; prices in units of their mean, at any scale alike."""
    phases = [
        replace(phase, duration=FreeTime(each, PACE.longest * each, PACE.longer * each))
        if (each := seconds.get(name)) is not None
        else phase
        for name, phase in zip(steps.names, steps.phases, strict=True)
    ]
    unit = float(np.mean([phase.seconds for phase in steps.phases]))
    default = StepWeights()
    weights = StepWeights(
        acceleration=default.acceleration * unit**3,
        velocity=default.velocity * unit,
        joint_limits=default.joint_limits / unit,
        load=default.load / unit,
    )
    slower = replace(steps, phases=tuple(phases))
    problem = steps_problem(slower, start_joints, **{**asked, "weights": weights})
    problem.minimize(
        0, PACE.price * default.acceleration * sum(problem[name].duration / each for name, each in seconds.items())
    )
    return problem


def _check_conflicts(problem: Phases, found: Solution) -> None:
    """Raise SolveError where more time does not help, of what would have to give way."""
    try:
        solve(problem, COARSE, options={"max_iter": 0})  # looks for it at once
    except SolveError as error:
        if not error.conflicts:
            return
        lines = [
            f"  {each.label} would have to go {each.amount:.3g} beyond its {each.side} bound {each.bound:.4g}, at "
            f"{100 * each.fraction:.0f} % of its phase"
            for each in error.conflicts[: PACE.told]
        ]
        words = "no steps were found, however long they may take; near the guess"
        worst = error.conflicts[0]
        details = {"name": worst.label, "value": worst.amount, "limit": worst.bound}
        raise SolveError("\n".join([words, *lines]), found, error.conflicts, **details) from None


def _too_fast(problem: Phases, found: Solution, seconds: Mapping[str, float], spans: Mapping[str, float]) -> SolveError:
    """That the quickest steps take longer, in which phases, and what they meet there."""
    late = sorted(seconds, key=lambda name: -spans[name] / seconds[name])
    late = [name for name in late if spans[name] > (1 + PACE.near) * seconds[name]]
    lines = [
        f"  phase {name!r}: {spans[name]:.3g} s, {seconds[name]:.3g} s are asked; {_met(problem, found, name)}"
        for name in late
    ]
    words = "too fast: the quickest steps that were found take longer; give them more time, or ask for shorter ones"
    worst = late[0]
    slow = replace(found, success=False, status=SolverStatus.REJECTED, message="too fast")
    return SolveError("\n".join([words, *lines]), slow, name=worst, value=spans[worst], limit=seconds[worst])


def _met(problem: Phases, found: Solution, phase: str) -> str:
    """What is at its limits in a phase, and for which share of it, in words."""
    form = Formulation.of(problem)
    at = np.linspace(0.0, 1.0, PACE.samples)
    x, u = found.state_interpolant(at), found.control_interpolant(at)
    p = form.parameter_vector({})
    rows = form.sampled([form.path.expression], x, u, at, found.horizon, p)[0]
    places = np.concatenate([form.bounds.places["state"], form.bounds.places["control"], form.path.bounds])
    low, high = (side[places] for side in form.bound_values(p))
    values = np.hstack([x, u, rows])
    near = np.minimum(values - low, high - values) <= PACE.met * np.ptp(values, axis=0)
    near[:, low == high] = False
    names = [label.partition("[")[0] for label in (*form.state_labels, *form.control_labels, *form.path.labels)]
    shares = {
        name.removeprefix(f"{phase}."): float(
            near[:, [k for k, each in enumerate(names) if each == name]].any(axis=1).mean()
        )
        for name in dict.fromkeys(names)
        if name.startswith(f"{phase}.") and name != f"{phase}.{DURATION}"
    }
    most = sorted((name for name in shares if shares[name] > 0), key=lambda name: -shares[name])[: PACE.told]
    return "at their limits " + ", ".join(f"{name} for {100 * shares[name]:.0f} % of it" for name in most)
