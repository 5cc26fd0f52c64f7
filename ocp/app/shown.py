"""A motion as it is shown: a plan, a solution of a problem of one's own or anybody's trajectory.

Whatever it was made by, it is sampled once, with what is known of it: what was asked, limits, costs, the bodies that
come nearest, the audit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from models import FreeFloating, Machine, Standing
from models.arrays import Array
from ocp.app.bases import floating_base
from ocp.app.joint_limits import Row, rows_of
from ocp.app.obstacles import Obstacle, looks_of, obstacles_of
from ocp.app.oddities import readable
from ocp.app.plan_verdict import PlanVerdict, verdict_of
from ocp.app.quantities import Curve, Footing, footing_of, joint_curves, machine_curves, so_far
from ocp.app.verdict import bounds_of
from ocp.audit.audit import Audit
from ocp.audit.clearance import nearest_along
from ocp.builders.tool_motion import CLOCK
from ocp.errors import ProblemError, unknown_name
from ocp.files import RawTrajectory
from ocp.planning import Plan
from ocp.problem.formulation import Formulation
from ocp.solution import Solution, in_order_of
from ocp.tasks.targets import Target

__all__ = ["PAGE_SETTINGS", "Near", "PageSettings", "Shown", "shown_plan", "shown_solution", "shown_trajectory"]

FOOT = "zero moment point"
"""What problems of standing machines call the constraint that keeps it in the foot."""


@dataclass(frozen=True)
class PageSettings:
    """How finely a page shows a motion.

    Attributes:
        per_second, least, most: Times at which a motion is sampled.
        poses: Of them those at which poses are told, at most; between them they are interpolated.
        near: Times at which the nearest bodies are looked for, which takes longer.
        same_cost: Relative: costs that end nearer to each other are told once.
        most_bytes: Of a page.
    """

    per_second: int = 50
    least: int = 200
    most: int = 600
    poses: int = 301
    near: int = 161
    same_cost: float = 1e-3
    most_bytes: int = 8_000_000


PAGE_SETTINGS = PageSettings()


class Near(NamedTuple):
    """The two bodies that are nearest to each other, at K times.

    Attributes:
        t: s. Shape (K,).
        points: On their cores, in world. Shape (K, 2, 3), m.
        distances: m. Shape (K,). asked: The least allowed. Shape (K,), m.
        bodies: Their names.
    """

    t: Array
    points: Array
    distances: Array
    asked: Array
    bodies: tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class Shown:
    """A motion, sampled.

    Attributes:
        name: What it is called.
        machine: What moves.
        t: s. Shape (M,).
        joints: Shape (M, n). base: Shape (M, base_size).
        curves: What is drawn over time.
        targets: What tips were asked to do.
        footing: Where the ground pushes; None of a machine that does not stand.
        near: The nearest bodies; None where nothing is known of them.
        around: Obstacles; what moves has its places at the times t.
        verdict: Of the audit, a sentence, or "". passed: Whether it is good; None where nothing was looked at.
        rows: Of the audit.
        cost: Of it; None where it is not known.
    """

    name: str
    machine: Machine
    t: Array
    joints: Array
    base: Array
    curves: tuple[Curve, ...]
    targets: tuple[Target, ...] = ()
    footing: Footing | None = None
    near: Near | None = None
    around: tuple[Obstacle, ...] = ()
    verdict: str = ""
    passed: bool | None = None
    rows: tuple[Row, ...] = ()
    cost: float | None = None


def shown_plan(plan: Plan, name: str = "plan", **settings: Any) -> Shown:
    """A plan, with its audit, of which `settings` are."""
    times = _times(plan.horizon)
    sample = plan.sampled(times)
    base = plan.at(times)["base"] if plan.machine.base_size else np.zeros((len(times), 0))
    near = _near(plan)
    single = len(plan.parts) == 1
    told: list[Curve] = []
    if single:
        fractions = plan._fractions(plan.parts[0], times)
        own = fractions * plan.solution.horizon if CLOCK in plan.solution.states else times
        told = _told(plan.solution, fractions, own)
    given = sample.joints, sample.rates, sample.accelerations
    about: dict[str, Any] = {
        "near": near,
        "around": tuple(obstacles_of(plan.solution, looks_of(plan, times))),
        "cost": plan.cost,
        "targets": plan.targets,
    }
    about |= _audited(plan.solution, lambda: verdict_of(plan, sample, name, **settings))
    return _shown(name, plan.machine, times, base, *given, _base_rates(times, base), told, **about)


def shown_solution(
    solution: Solution,
    machine: Machine,
    name: str = "solution",
    *,
    joints: str = "joints",
    base: str = "base",
    **settings: Any,
) -> Shown:
    """A solution of a problem of one's own.

    Args:
        machine: Whose joints, and base, are states of the problem.
        joints, base: What these states are called.
        settings: Of the audit.

    Raises:
        ProblemError: No such state, or another size.
    """
    wanted = {joints: machine.joint_size} | ({base: machine.base_size} if machine.base_size else {})
    for state, size in wanted.items():
        if state not in solution.states:
            raise unknown_name("state", state, list(solution.states))
        found = solution.states[state].shape[1]
        if found != size:
            words = f"state {state!r} has {found} entries, the machine {size}: {list(machine.robot.joint_names)}"
            raise ProblemError(words, name=state, value=found, limit=size)
    times = _times(solution.horizon)
    fractions = times / solution.horizon
    columns, at = {}, 0
    for state, values in solution.states.items():
        columns[state] = slice(at, at + values.shape[1])
        at += values.shape[1]
    curve = solution.state_interpolant
    states = curve(fractions)
    slopes = curve.derivative()(fractions) / solution.horizon
    bends = curve.derivative().derivative()(fractions) / solution.horizon**2
    q, v, a = (one[:, columns[joints]] for one in (states, slopes, bends))
    place = states[:, columns[base]] if machine.base_size else np.zeros((len(times), 0))
    moves = slopes[:, columns[base]] if machine.base_size else np.zeros((len(times), 0))
    about: dict[str, Any] = {"cost": solution.cost, "around": tuple(obstacles_of(solution, [("", times)]))}
    about |= _audited(solution, lambda: solution.audit(**settings))
    if solution.problem is not None:
        looks = np.linspace(0.0, solution.horizon, PAGE_SETTINGS.near)
        about["near"] = _joined(looks, nearest_along(solution.problem, solution, looks))
    smooth = _torque_like(solution, joints)
    told = _told(solution, fractions, times)
    return _shown(name, machine, times, place, q, v, a if smooth else None, moves, told, **about)


def shown_trajectory(raw: RawTrajectory, machine: Machine, name: str = "") -> Shown:
    """Anybody's trajectory, between its samples as a controller makes it.

    Raises:
        ProblemError: It lacks joints of the machine, or has no sample that can be read.
    """
    robot = machine.robot
    bounds = bounds_of(robot)
    found = readable(raw, robot, bounds.lower, bounds.upper, bounds.velocity)
    if len(found.joints) < robot.dof:
        lacking = [one for k, one in enumerate(robot.joint_names) if k not in found.joints]
        words = f"{raw.file} does not move {lacking}; hold them: --lock {lacking[0]}=VALUE"
        raise ProblemError(words, name=lacking[0], value=raw.file)
    motion = found.motion
    begin, end = float(motion.t[0]), float(motion.t[-1])
    times = _times(end - begin)
    joints, rates = motion.position.at(begin + times), motion.velocity.at(begin + times)
    accelerations = None if motion.acceleration is None else motion.acceleration.at(begin + times)
    base, moves = np.zeros((len(times), 0)), None
    if machine.base_size:
        told = found.base
        if told is None:
            assert isinstance(machine, FreeFloating)
            told = floating_base(machine, motion)[0]  # moves as its momentum has it
        else:
            moves = _between(begin + times, motion.t, np.gradient(told, motion.t, axis=0))
        base = _between(begin + times, motion.t, told)
    return _shown(name or raw.file, machine, times, base, joints, rates, accelerations, moves, [])


def _between(times: Array, t: Array, values: Array) -> Array:
    """Columns of samples, straight between them."""
    return np.column_stack([np.interp(times, t, column) for column in values.T])


def _shown(
    name: str,
    machine: Machine,
    t: Array,
    base: Array,
    joints: Array,
    rates: Array,
    accelerations: Array | None,
    base_rates: Array | None,
    told: Sequence[Curve],
    **about: Any,
) -> Shown:
    """With what every motion tells."""
    effort = so_far(t, (rates**2).sum(axis=1) / 2)
    curves = [Curve("Cost", "half the squared joint rates, so far", "", effort)]
    own = [one for one in told if one.group == "Cost"]
    curves += [
        one for one in own if abs(one.values[-1] - effort[-1]) > PAGE_SETTINGS.same_cost * max(abs(effort[-1]), 1e-12)
    ]
    curves += machine_curves(machine, base, joints, rates, base_rates)
    near = about.get("near")
    if near is not None:
        distances = np.interp(t, near.t, near.distances)
        curves.append(Curve("The motion", "nearest two bodies", "m", distances, float(near.asked.min())))
    footing = None
    if isinstance(machine, Standing) and accelerations is not None:
        footing, more = footing_of(machine, joints, rates, accelerations, [one for one in told if one.group == FOOT])
        curves += more
    curves += joint_curves(machine, bounds_of(machine.robot), joints, rates, accelerations)
    curves += _rooms([one for one in told if one.group != "Cost"])
    return Shown(name, machine, t, joints, base, tuple(curves), footing=footing, **about)


def _times(horizon: float) -> Array:
    count = int(np.clip(np.ceil(PAGE_SETTINGS.per_second * horizon), PAGE_SETTINGS.least, PAGE_SETTINGS.most))
    return np.linspace(0.0, horizon, count + 1)


def _base_rates(t: Array, base: Array) -> Array:
    return np.asarray(np.gradient(base, t, axis=0, edge_order=2)) if base.shape[1] else base


def _torque_like(solution: Solution, joints: str) -> bool:
    """Whether the joints' accelerations are of the plan: the states' own curves bend smoothly."""
    return len(solution.state_interpolant.nodes) > 2 and any(
        name != joints and values.shape[1] == solution.states[joints].shape[1]
        for name, values in solution.states.items()
    )


def _audited(solution: Solution, judge: Callable[[], Audit | PlanVerdict]) -> dict[str, Any]:
    """What the audit says; of a solution without its problem that there can be none."""
    if solution.problem is None:
        return {"verdict": f"Its problem is not in the file, so that nothing is audited: {solution.problem_lost}."}
    verdict = judge()
    audit = verdict.audit if isinstance(verdict, PlanVerdict) else verdict
    return {"verdict": f"The plan {verdict.sentence}.", "passed": verdict.passed, "rows": tuple(rows_of(audit))}


def _told(solution: Solution, fractions: Array, times: Array) -> list[Curve]:
    """What the problem itself says along the motion: its running cost so far, and every row of its path constraints.

    The rows of a constraint have its name for their group.
    """
    if solution.problem is None:
        return []
    form = Formulation.of(solution.problem)
    ordered = in_order_of(form, solution)
    x, u = ordered.state_interpolant(fractions), ordered.control_interpolant(fractions)
    p = form.parameter_vector(ordered.parameters)
    running, rows = form.sampled([form.running, form.path.expression], x, u, times, ordered.horizon, p)
    lower, upper = (side[form.path.bounds] for side in form.bound_values(p))
    own = so_far(fractions * ordered.horizon, running[:, 0])
    return [Curve("Cost", "the problem's own, so far", "", own)] + [
        Curve(owner, label, form.units[owner], rows[:, k], float(lower[k]), float(upper[k]))
        for k, (owner, label) in enumerate(zip(form.path.owners, form.path.labels, strict=True))
    ]


def _rooms(rows: Sequence[Curve]) -> list[Curve]:
    """Of each constraint, how far its tightest row is from its limit, or of equations how far the worst is off."""
    found = []
    for name in dict.fromkeys(one.group for one in rows):
        own = [one for one in rows if one.group == name]
        unit = own[0].unit if "," not in own[0].unit else ""
        if equal := [one for one in own if one.lower == one.upper]:
            off = np.max([np.abs(one.values - one.lower) for one in equal], axis=0)
            found.append(Curve("Constraints", f"{name}: off by", unit, off))
        if open_ := [one for one in own if one.lower < one.upper]:
            rooms = [np.minimum(one.values - one.lower, one.upper - one.values) for one in open_]
            found.append(Curve("Constraints", f"{name}: room to its limit", unit, np.min(rooms, axis=0), 0.0))
    return [one for one in found if np.isfinite(one.values).any()]


def _near(plan: Plan) -> Near | None:
    problem = plan.solution.problem
    if problem is None:
        return None
    looks = np.linspace(0.0, plan.horizon, PAGE_SETTINGS.near)
    found = []
    for suffix, times in looks_of(plan, looks):
        found += nearest_along(problem, plan.solution, times, suffix)
    return _joined(looks, found)


def _joined(t: Array, found: Sequence[Any]) -> Near | None:
    if len(found) < len(t):
        return None
    points, distances, asked = (
        np.array([getattr(one, what) for one in found]) for what in ("points", "distance", "asked")
    )
    return Near(t, points, distances, asked, tuple(one.bodies for one in found))
