"""A motion as it is shown: a plan, a solution of a problem of one's own or anybody's trajectory.

Whatever it was made by, it is sampled once, with what is known of it: what was asked, limits, costs, the bodies that
come nearest, the audit.

What is drawn over the time of a motion, with its limits: joints, torques, costs, what a base does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models import FreeFloating, Machine, Standing, inverse_dynamics, simplified
from models.arrays import Array
from models.machines.standing import center_of_pressure
from models.robot.dynamics import GRAVITY
from ocp.app.check.joint_limits import Row, floating_base, floating_torques, rows_of
from ocp.app.check.oddities import readable
from ocp.app.check.plan_verdict import PlanVerdict, verdict_of
from ocp.app.check.verdict import bounds_of
from ocp.app.files import RawTrajectory
from ocp.app.view.pictures import Obstacle, looks_of, obstacles_of
from ocp.audit.audit import Audit
from ocp.audit.clearance import closest_pairs_along
from ocp.errors import ProblemError, unknown_name
from ocp.motion.builders.tool_motion import CLOCK
from ocp.motion.plan import Plan
from ocp.motion.tasks.limits import JointBounds
from ocp.motion.tasks.targets import Target
from ocp.problem.formulation import Formulation
from ocp.problem.values import Sampler
from ocp.solution import Solution, match_order

__all__ = [
    "PAGE_SETTINGS",
    "Curve",
    "Footing",
    "Near",
    "PageSettings",
    "Shown",
    "footing_of",
    "joint_curves",
    "machine_curves",
    "shown_plan",
    "shown_solution",
    "shown_trajectory",
    "so_far",
]


@dataclass(frozen=True, eq=False)
class Curve:
    """A number over the time of a motion.

    Attributes:
        group: What it is drawn with. name: Of it. unit: "" of a pure number.
        values: At the motion's M times. Shape (M,).
        lower, upper: Its limits, infinite where there is none.
    """

    group: str
    name: str
    unit: str
    values: Array
    lower: float = -np.inf
    upper: float = np.inf


@dataclass(frozen=True, eq=False)
class Footing:
    """Where the ground pushes on a machine that stands.

    Attributes:
        corners: Of the region under its foot. Shape (k, 2), m.
        points: Zero moment points, at the motion's M times. Shape (M, 2), m.
        forces: Whether forces from outside are known, and in them.
    """

    corners: Array
    points: Array
    forces: bool


def joint_curves(
    machine: Machine, bounds: JointBounds, joints: Array, rates: Array, accelerations: Array | None
) -> list[Curve]:
    """Positions, rates and torques of all joints, shape (M, n) each, with what bounds them."""
    robot, found = machine.robot, []
    torques = None if accelerations is None else _torques(machine, joints, rates, accelerations)
    torque_group = "Torques, without forces from outside" if isinstance(machine, Standing) else "Torques"
    for k, joint in enumerate(robot.moving_joints):
        found.append(Curve("Joints", joint.name, joint.unit, joints[:, k], bounds.lower[k], bounds.upper[k]))
    for k, joint in enumerate(robot.moving_joints):
        most = float(bounds.velocity[k])
        found.append(Curve("Joint rates", joint.name, f"{joint.unit}/s", rates[:, k], -most, most))
    for k, joint in enumerate(robot.moving_joints if torques is not None else ()):
        assert torques is not None
        most = float(bounds.torque[k])
        found.append(Curve(torque_group, joint.name, joint.effort_unit, torques[:, k], -most, most))
    return found


def _torques(machine: Machine, joints: Array, rates: Array, accelerations: Array) -> Array | None:
    """By inverse dynamics, shape (M, n); None of a robot without masses."""
    robot = machine.robot
    if robot.total_mass == 0:
        return None
    q, v, a = (ca.SX.sym(name, robot.dof) for name in ("q", "v", "a"))
    if isinstance(machine, FreeFloating):
        torque = floating_torques(machine, q, v, a)
    else:
        gravity = getattr(machine, "gravity_in_world", GRAVITY)
        frame = machine.world_from_base(())
        torque = inverse_dynamics(simplified(robot), q, v, a, (), gravity, frame)
    found: Array = Sampler([q, v, a], [torque])(joints, rates, accelerations)[0]
    return found


def machine_curves(machine: Machine, base: Array, joints: Array, rates: Array, base_rates: Array | None) -> list[Curve]:
    """Manipulability and speed of the tip; of a floating machine its momentum, where rates of its base are known."""
    robot, found = machine.robot, []
    b, q, v = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", robot.dof), ca.SX.sym("v", robot.dof)
    if robot.tip is not None:
        rows = range(6) if robot.dof >= 6 else range(3, 6) if robot.dof >= 3 else (3, 4)
        what = "of the pose" if robot.dof >= 6 else "of the position" if robot.dof >= 3 else "in the plane"
        twist = machine.tip_twist(b, q, v)
        sampler = Sampler([b, q, v], [machine.manipulability(b, q, rows), ca.norm_2(twist[3:6])])
        index, speed = sampler(base, joints, rates)
        found.append(Curve("The motion", f"manipulability {what}", "", index[:, 0]))
        found.append(Curve("The motion", "speed of the tip", "m/s", speed[:, 0]))
    if isinstance(machine, FreeFloating) and base_rates is not None:
        r = ca.SX.sym("r", machine.base_size)
        whole = machine.momentum(b, q, machine.twist_of_rate(b, r), v)
        own = machine.momentum(b, q, ca.SX(len(machine.twist_rows), 1), v)
        turns = 3 if machine.base_size == 7 else 1
        parts = [whole[:turns], whole[turns:], own[:turns], own[turns:]]
        spin, push, own_spin, own_push = Sampler([b, q, v, r], [ca.norm_2(part) for part in parts])(
            base, joints, rates, base_rates
        )
        for name, value, share, unit in (
            ("moment of momentum", spin, own_spin, "N m s"),
            ("momentum", push, own_push, "N s"),
        ):
            found.append(Curve("Momentum", f"{name}, of the whole", unit, value[:, 0]))
            found.append(Curve("Momentum", f"{name}, of the joints alone", unit, share[:, 0]))
    return found


def footing_of(
    machine: Standing, joints: Array, rates: Array, accelerations: Array, inside: Sequence[Curve] = ()
) -> tuple[Footing, list[Curve]]:
    """Where the ground pushes, and how far from the edge of the foot.

    Args:
        joints, rates, accelerations: Shape (M, n) each.
        inside: How far it is inside each edge, as a problem says that knows of forces from outside; less a margin that
            is the same everywhere. Without, no such forces are known.
    """
    normals, corners = machine.support.normals, np.asarray(machine.support.vertices)
    if len(inside) == len(normals):
        point = ca.SX.sym("point", 2)
        edges = np.array(ca.Function("edges", [point], [machine.support.distances(point)])(np.zeros(2))).ravel()
        rows = np.column_stack([normals, -np.ones(len(normals))])
        told = np.column_stack([one.values for one in inside]) - edges
        found, *_ = np.linalg.lstsq(rows, told.T, rcond=None)
        if np.abs(rows @ found - told.T).max() < 1e-8:  # m: rounding; they are those of one point
            points = np.ascontiguousarray(found[:2].T)
            distances = edges + points @ normals.T
            margin = Curve("Standing", "zero moment point from the edge of the foot", "m", distances.min(axis=1), 0.0)
            return Footing(corners, points, True), [margin]
    q, v, a = (ca.SX.sym(name, machine.joint_size) for name in ("q", "v", "a"))
    point = center_of_pressure(machine.ground_reaction(q, v, a))
    points, inner = Sampler([q, v, a], [point, machine.support.margin(point)])(joints, rates, accelerations)
    words = "zero moment point from the edge of the foot, no forces from outside"
    return Footing(corners, points, False), [Curve("Standing", words, "m", inner[:, 0], 0.0)]


def so_far(t: Array, values: Array) -> Array:
    """The integral of samples (M,) up to each time, by trapezia. Shape (M,)."""
    return np.concatenate([[0.0], np.cumsum(np.diff(t) * (values[1:] + values[:-1]) / 2)])


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
        about["near"] = _joined(looks, closest_pairs_along(solution.problem, solution, looks))
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
    ordered = match_order(form, solution)
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
        found += closest_pairs_along(problem, plan.solution, times, suffix)
    return _joined(looks, found)


def _joined(t: Array, found: Sequence[Any]) -> Near | None:
    if len(found) < len(t):
        return None
    points, distances, asked = (
        np.array([getattr(one, what) for one in found]) for what in ("points", "distance", "required")
    )
    return Near(t, points, distances, asked, tuple(one.bodies for one in found))
