"""Margins of plans: how far payload, friction and placements may differ from the model before a limit is violated.

The planned joint motion is executed as it is. A payload and joint friction then change torques, powers and the ground
reaction, and do so affinely. A displacement in any direction changes a distance by at most its length, and in the worst
direction by exactly its length. Every requirement on a motion, at every time, therefore is

    sum_k coefficient_k size_k <= slack,

where size_k >= 0 is the size of uncertainty k. First-order sensitivities are thus exact for every size, and the
largest sizes follow without a search. Distances are bounded at all times (:mod:`ocp.audit.clearance`). Torques are
sampled; between samples, they are assumed to deviate from the nearest sample by at most the largest second difference
of the samples nearby, eight times the error of their linear interpolation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models import FixedBase, Machine, Stance, Standing, with_load
from models.checks import Array
from models.machines.machine import hold_joints, wrenches_at
from ocp.audit.clearance import Clearance, clearance_of_pairs
from ocp.console import interruptible
from ocp.errors import ProblemError, require
from ocp.motion.builders.dynamics import joint_torques
from ocp.motion.result.path_plan import PathPlan
from ocp.motion.result.plan import CHECKED_TIMES, Plan
from ocp.motion.result.request import RESERVE, request_of
from ocp.motion.result.segmented_plan import ConsecutivePlans
from ocp.motion.result.solved_plan import Part, PhasedPlan, SolvedPlan
from ocp.motion.tasks.limits import Anywhere, IndexAtLeast, InFoot, Limits, foot_edges
from ocp.problem.hulls import WORLD
from ocp.problem.values import Sampler
from ocp.tolerances import ROUNDING_SHARE

PAYLOAD, FRICTION, BASE, OBSTACLE, TOOL = "payload", "friction", "base position", "obstacle position", "tool offset"
PHRASES: dict[str, tuple[str, float, str]] = {
    PAYLOAD: ("payloads from 0 to {} kg", 1.0, "the motion has no torque limits: give Limits(torque=...), or efforts "
              "in the robot's description, and no floating base or stance, whose motion depends on the payload"),
    FRICTION: ("joint friction of up to {} % of the torque limits", 100.0, "the motion has no torque limits: give "
               "Limits(torque=...), or efforts in the robot's description"),
    BASE: ("a base misplaced by up to {} mm", 1000.0, "plan it among obstacles, Scene(obstacles=...), or give the "
           "allowed deviation of the tip, tolerance=..., m"),
    OBSTACLE: ("obstacles misplaced by up to {} mm", 1000.0, "plan it among obstacles, Scene(obstacles=...)"),
    TOOL: ("a tool misplaced by up to {} mm", 1000.0, "give the allowed deviation of the tip, tolerance=..., m, or "
           "collision shapes of the link that carries the tip"),
}  # fmt: skip
"""Text about the size of each uncertainty, factor to the unit of the text, and what to do if no limit depends on it."""
LOADS = (PAYLOAD, FRICTION)  # names of the uncertainties that change torques; the others are misplacements
UNCERTAINTIES = tuple(PHRASES)  # names of the uncertainties, see `ocp.motion.result.plan.Plan.margin`
SAMPLES_PER_STEP = 8
"""Smallest number of intervals between two sample times of a plan at whose ends torques are evaluated: twice the degree
of the polynomials that `plan` uses. There are at least CHECKED_TIMES intervals in all."""
INSIDE = 1e-9
"""Distance of the first and last of these samples from the ends of the step, where accelerations may jump, as a share
of the step."""
DIGITS = 2  # number of significant digits of a margin in a sentence, rounded down
TIGHTENING_SHARE = 0.01
"""Share by which torque limits of robust plans are tightened more than estimated, so that few motions are planned."""
PYRAMID_SIDES = 32
"""Number of sides of the pyramid in the cone of friction; at most 1 - cos(pi / 32), 0.5 % of the friction, is lost."""


class Requirements(NamedTuple):
    """Inequalities of one kind at M samples: sum of coefficients times sizes of uncertainties <= slack.

    Attributes:
        name: Name of the limited quantity.
        times: Times of the samples, s. Shape (M,).
        slack: Distance from the limit for a motion as modelled, in the unit of the limit. Shape (M,).
        coefficients: By uncertainty, the largest decrease of the slack for each unit of size, not negative. Shape (M,).
        most: The limit.
        joint: Name of the joint whose torque is limited; "" for other quantities.
    """

    name: str
    times: Array
    slack: Array
    coefficients: Mapping[str, Array]
    most: float = 0.0
    joint: str = ""

    def coefficient(self, uncertainty: str) -> Array:
        """Return the largest loss of margin per unit of an uncertainty, zero if it has no effect. Shape (M,)."""
        return self.coefficients.get(uncertainty, np.zeros(self.slack.shape))


class Range(NamedTuple):
    """Largest allowed size of an uncertainty, or factor of several sizes, and the limit that prevents a larger value.

    Attributes:
        size: Largest size (kg, share of the torque limits, or m), or factor.
        limit: Name of the limited quantity that a larger size may violate.
        time: Time of the violation, s.
        row: Index of the requirement.
    """

    size: float
    limit: str
    time: float
    row: int

    def __str__(self) -> str:
        return f"{self.limit} at {self.time:.4g} s"


@dataclass(frozen=True)
class Margin:
    """How far uncertain quantities may differ from the model of a plan, alone and together.

    Attributes:
        alone: Largest size of each uncertainty if the others are zero.
        together: Sizes of all uncertainties within which any combination, in any directions, keeps all limits. The
            sizes grow in proportion until limits stop them: first the stated uncertainties, up to their stated sizes
            if others are not stated; then the others, in proportion to their sizes in `alone`.
        factor: Factor by which all stated sizes, or all of `alone` if none is stated, may be multiplied at once.
        stated: Stated sizes.
        moves_tip: Whether the tip may deviate by as much as base or tool, because no tolerance limits its deviation.
    """

    alone: Mapping[str, Range]
    together: Mapping[str, float]
    factor: Range
    stated: Mapping[str, float]
    moves_tip: bool = False

    def __getitem__(self, name: str) -> Range:
        if name not in self.alone:
            raise require.unknown("uncertainty in the margin", name, self.alone)
        return self.alone[name]

    @property
    def covers_stated(self) -> bool:
        """Whether all limits hold for the stated sizes of all uncertainties at once; True if none is stated."""
        return not self.stated or self.factor.size >= 1

    @property
    def sentence(self) -> str:
        """Sentence that states which uncertainties the plan tolerates; sizes are rounded down."""
        texts = [describe_size(name, size) for name, size in self.together.items() if size > 0]
        none = [name for name, size in self.together.items() if not size > 0]
        parts = [f"keeps all limits for {_enumerate(texts)}"] if texts else []
        parts += [] if self.alone else ["has no limits that payload, friction or misplacements can violate"]
        parts += [f"has no margin for {name}: {self.alone[name]}" for name in none]
        if not self.covers_stated:
            missed = _enumerate([describe_size(name, size, up=True) for name, size in self.stated.items()])
            parts.append(f"does not cover {missed}: {self.factor}")
        if self.moves_tip and any(self.together.get(name, 0.0) > 0 for name in (BASE, TOOL)):
            parts.append("the tip is then misplaced by as much")
        return "; ".join(parts)

    def __str__(self) -> str:
        alone = [f"  alone: {describe_size(name, size.size)}, then {size}" for name, size in self.alone.items()]
        return "\n".join([f"The plan {self.sentence}.", *alone])


def _enumerate(texts: list[str]) -> str:
    return " and ".join(filter(None, [", ".join(texts[:-1]), texts[-1]]))


def describe_size(name: str, size: float, up: bool = False) -> str:
    """Return a text that states the size of an uncertainty, rounded down to few digits, or up if `up`."""
    text, factor, _ = PHRASES[name]
    value = factor * size
    if value > 0:
        unit = 10.0 ** (np.floor(np.log10(value)) - DIGITS + 1)
        # a size with few digits stays as it is although it is no exact multiple of a binary fraction
        value = (np.ceil(value / unit - ROUNDING_SHARE) if up else np.floor(value / unit + ROUNDING_SHARE)) * unit
    return text.format(f"{value:.{DIGITS}g}")


@interruptible
def margin_of_plan(plan: Plan, uncertainty: Any = None, tolerance: float | None = None) -> Margin:
    """Return how far uncertain quantities may differ from the model of a plan, alone and together."""
    stated = checked_uncertainty(uncertainty)
    if tolerance is not None:
        tolerance = require.nonnegative("margin: tolerance", tolerance, unit="m")
    rows = [row for row in _requirements(plan, tolerance) if row.slack.size]
    names = [name for name in stated or UNCERTAINTIES if any((row.coefficient(name) > 0).any() for row in rows)]
    if missing := [name for name in stated if name not in names]:
        words = f"margin: no limit of the plan depends on the {missing[0]}; {PHRASES[missing[0]][2]}"
        raise ProblemError(words, name=missing[0], value=stated[missing[0]])
    if not names:
        return Margin({}, {}, Range(np.inf, "", np.nan, 0), {})
    stacked = _Stacked.of(rows, names)
    alone = {name: stacked.largest(stacked.coefficients[name], stacked.slack) for name in names}
    sizes = {name: size for name, size in stated.items() if size is not None}
    weights = {name: sizes.get(name, alone[name].size) for name in names}
    together, factors = stacked.grow(weights, [*sizes])
    moves_tip = tolerance is None and bool({BASE, TOOL} & set(names))
    return Margin(alone, together, factors[0] if factors else alone[names[0]], sizes, moves_tip)


class _Stacked(NamedTuple):
    """Inequalities of all kinds at all M samples: sum of coefficients times sizes of uncertainties <= slack."""

    coefficients: dict[str, Array]  # of each uncertainty, (M,)
    slack: Array
    times: Array
    labels: Array

    @classmethod
    def of(cls, rows: list[Requirements], names: list[str]) -> _Stacked:
        coefficients = {name: np.concatenate([row.coefficient(name) for row in rows]) for name in names}
        slack, times = (np.concatenate([getattr(row, each) for row in rows]) for each in ("slack", "times"))
        return cls(coefficients, slack, times, np.repeat([row.name for row in rows], [row.slack.size for row in rows]))

    def largest(self, growth: Array, left: Array) -> Range:
        """Return the largest factor with factor * growth (M,) <= left (M,), and the requirement that limits it."""
        factors = np.full(growth.shape, np.inf)
        np.divide(np.maximum(left, 0.0), growth, out=factors, where=growth > 0)
        row = int(factors.argmin())
        return Range(float(factors[row]), str(self.labels[row]), float(self.times[row]), row)

    def grow(self, weights: Mapping[str, float], stated: list[str]) -> tuple[dict[str, float], list[Range]]:
        """Enlarge all uncertainties until limits stop them; return their sizes, and these limits in the order reached.

        All grow in proportion to their weights: first the stated ones, up to their weights if there are others, then
        the others. An uncertainty stops at the first requirement that allows no more of it.
        """
        together, factors = dict.fromkeys(weights, 0.0), list[Range]()
        others = [name for name in weights if name not in stated]
        for group, most in ((stated, 1.0 if others else np.inf), (others, np.inf)):
            growing, factor = [name for name in group if weights[name] > 0], 0.0
            while growing and factor < most:
                used = np.sum([self.coefficients[name] * together[name] for name in weights], axis=0)
                growth = np.sum([self.coefficients[name] * weights[name] for name in growing], axis=0)
                end = self.largest(growth, self.slack - used)
                step = min(end.size, most - factor)
                together |= {name: together[name] + step * weights[name] for name in growing}
                growing = [name for name in growing if not self.coefficients[name][end.row] > 0]
                factor += step
                factors.append(end)
        return together, factors


def checked_uncertainty(value: Any) -> dict[str, float | None]:
    """Return the stated size of each uncertainty by name, None if it is not stated; raise ProblemError if invalid."""
    sizes: dict[str, float | None] = {}
    for name, stated in require.mapping("uncertainty", value).items():
        if name not in UNCERTAINTIES:
            raise require.unknown("uncertainty", name, UNCERTAINTIES)
        if isinstance(stated, tuple | list):
            if len(stated) != 2 or stated[0] != 0:
                words = f"uncertainty: {name} must be a size or (0, size), not {stated!r}; the plan's own model counts "
                words += "as 0: plan with the least payload in the robot (models.with_load)"
                raise ProblemError(words, name=name, value=stated)
            stated = stated[1]
        sizes[name] = None if stated is None else require.positive(f"uncertainty: {name}", stated)
    return sizes


def tightened_torques(plan: Plan, sizes: Mapping[str, float]) -> dict[str, float]:
    """Return tighter torque limits, by joint, for joints whose limits do not suffice for uncertainties of given sizes.

    The torque at the worst time is reduced in the ratio in which it would exceed its limit, and by TIGHTENING_SHARE
    more, because payloads add torque roughly in proportion to the torque without them.
    """
    largest: dict[str, float] = {}
    for row in _requirements(plan, None):
        if row.joint:
            needed = np.sum([row.coefficient(name) * size for name, size in sizes.items()], axis=0)
            torque = row.most - row.slack
            short = (needed > row.slack) & (torque > 0)
            targets = (1 - TIGHTENING_SHARE) * row.most * torque[short] / (torque + needed)[short]
            largest[row.joint] = min(largest.get(row.joint, np.inf), float(targets.min(initial=np.inf)))
    return {joint: torque for joint, torque in largest.items() if np.isfinite(torque)}


def _requirements(plan: Plan, tolerance: float | None) -> list[Requirements]:
    """Return all requirements on a plan that an uncertainty can violate."""
    if isinstance(plan, ConsecutivePlans):
        parts = [(piece, row) for piece in plan.pieces for row in _requirements(piece.plan, tolerance)]
        return [row._replace(name=f"{piece.name}: {row.name}", times=row.times + piece.begin) for piece, row in parts]
    rows = _distance_requirements(plan)
    if tolerance is not None:
        one = np.ones(1)
        rows.append(Requirements("position of the tip", 0 * one, tolerance * one, {BASE: one, TOOL: one}))
    if isinstance(plan, PhasedPlan):
        for part, machine in zip(plan.parts, plan.machines, strict=True):
            rows += _dynamic_requirements(plan, machine, part)
    elif isinstance(plan, SolvedPlan):
        rows += _dynamic_requirements(plan, plan.machine, Part(0.0, plan.horizon, ""))
    return rows


# ---- distances -------------------------------------------------------------------------------------------------------


def _distance_requirements(plan: Plan) -> list[Requirements]:
    """Return the requirements on the smallest distances of bodies that a misplaced base, obstacle or tool changes.

    All pairs of bodies that the same displacements change are one requirement, whose slack is that of their closest
    pair. Two bodies of the robot keep their distance if the base is misplaced.
    """
    prove: Callable[[str, list[int]], Clearance | None]
    reserve = 0.0
    if isinstance(plan, PathPlan):
        scene = None if plan.constraints is None else plan.constraints.scene
        separations: list[tuple[str, Any]] = [] if scene is None else [("", scene)]

        def prove(name: str, pairs: list[int]) -> Clearance | None:
            return plan.clearance(pairs)
    else:
        problem = plan.solution.problem
        if problem is None:
            words = f"margin: the plan has no problem that states its limits: {plan.solution.problem_lost}"
            raise ProblemError(words, name="problem")
        separations = list(problem.declared.apart.items())
        request = request_of(problem)
        reserve = 0.0 if request is None else float(request.arguments.get(RESERVE, {}).get("distance", 0.0))
        prove = partial(clearance_of_pairs, problem, plan.solution)
    tip, rows = plan.machine.robot.tip, list[Requirements]()
    for name, separation in separations:
        groups: dict[tuple[str, ...], list[int]] = {}
        links = [body.link for body in separation.bodies]
        for pair, (first, second, observer) in enumerate(separation.pairs):
            carries_tip = tip is not None and tip in (links[first], links[second])
            moved_by = ((BASE, observer == WORLD), (OBSTACLE, observer == WORLD), (TOOL, carries_tip))
            groups.setdefault(tuple(each for each, moves in moved_by if moves), []).append(pair)
        for moved, pairs in groups.items():
            proof = prove(name, pairs) if moved else None
            if proof is not None and proof.pairs:
                worst = min(proof.pairs, key=lambda pair: pair.least - pair.required)
                slack = worst.least - worst.required + (reserve if BASE in moved else 0.0)
                label, one = f"distance of {' and '.join(worst.bodies)}", np.ones(1)
                rows.append(Requirements(label, worst.time * one, slack * one, dict.fromkeys(moved, one)))
    return rows


# ---- torques and ground reaction -------------------------------------------------------------------------------------


def _dynamic_requirements(plan: SolvedPlan, machine: Machine, part: Part) -> list[Requirements]:
    """Return the requirements on torques, powers and the ground reaction in one part of a plan.

    `machine` is the one that moves in this part, with its load; its joints are those of the plan, in any order.
    """
    if isinstance(machine, Stance) or machine.robot.total_mass == 0:
        return []
    machine = hold_joints(machine, plan.held) if plan.held else machine
    robot = machine.robot
    columns = [plan.names.index(name) for name in robot.joint_names]
    arguments: Mapping[str, Any] = {} if plan.request is None else plan.request.arguments
    limits = arguments.get("limits") or Limits()
    bounds, reserve = limits.bounds(machine), arguments.get(RESERVE, {})
    bounds = bounds._replace(torque=reserve["torque"][columns]) if reserve else bounds
    grid = plan.t[(plan.t >= part.begin) & (plan.t <= part.end)]
    grid = np.union1d(grid, [part.begin, part.end])
    count = max(SAMPLES_PER_STEP, -(-CHECKED_TIMES // len(grid)))
    nodes = np.clip(np.linspace(0.0, 1.0, count + 1), INSIDE, 1 - INSIDE)
    times = grid[:-1, None] + np.diff(grid)[:, None] * nodes
    sample = plan.sampled(times.ravel())
    motion = [values[:, columns] for values in (sample.joints, sample.rates, sample.accelerations)]
    bases = plan.at(sample.t)["base"] if machine.base_size else np.zeros((len(sample.t), 0))
    nominal, loaded, reaction, loaded_reaction = _loads(machine, arguments)(bases, *motion, sample.t[:, None])
    rows: list[Requirements] = []

    def bounded(values: Array) -> Array:
        """Return upper bounds of sampled values (M, ...) in the intervals around the samples."""
        steps = values.reshape(*times.shape, -1)
        bends = np.abs(np.diff(steps, n=2, axis=1)).max(axis=1, keepdims=True)
        return np.asarray((steps + bends).reshape(values.shape))

    def add(
        name: str, most: float, value: Array, change: Array, friction: Array | None = None, joint: str = ""
    ) -> None:
        """Require `value` <= `most`; it grows by `change` per unit of payload, by `friction` per unit of friction."""
        if np.isfinite(most):
            size = max(float(np.abs(value).max()), abs(most))
            growth = {PAYLOAD: bounded(change)} | ({} if friction is None else {FRICTION: friction})
            growth = {key: np.where(part > ROUNDING_SHARE * size, part, 0.0) for key, part in growth.items()}
            rows.append(Requirements(name, sample.t, most - bounded(value), growth, most, joint))

    change, rates = loaded - nominal, motion[1]
    for joint, name in enumerate(robot.joint_names):
        torque, added, most = nominal[:, joint], change[:, joint], float(bounds.torque[joint])
        for sign in (1.0, -1.0):
            add(f"torque of {name}", most, sign * torque, sign * added, np.full(len(torque), most), name)
        friction = np.abs(rates[:, joint]) * (most if np.isfinite(most) else 0.0)
        powers = torque * rates[:, joint], added * rates[:, joint]
        add(f"power of {name}", float(bounds.power[joint]), *powers, friction)
    if isinstance(machine, Standing):
        added_reaction = loaded_reaction - reaction
        for name, row, most in _ground_rows(machine, limits):
            add(name, most, reaction @ row, added_reaction @ row)
    return rows


def _loads(machine: Machine, arguments: Mapping[str, Any]) -> Sampler:
    """Return the function from base, joints, rates, accelerations and time to torques and ground reactions.

    Its outputs are the torques without and with a payload of 1 kg at the tip, shape (M, n), and the wrenches of the
    ground on a standing machine without and with it, shape (M, 6); none for other machines. A payload changes the
    motion of a floating base, so that the torques with it are those without it there.
    """
    setup = arguments.get("setup")
    symbols = getattr(setup, "symbols", ca.SX)
    base, q, v, a = (symbols.sym("v", size) for size in (machine.base_size, *[machine.joint_size] * 3))
    time = symbols.sym("time")
    robot = machine.robot
    loaded: Any = machine
    if isinstance(machine, FixedBase) and robot.tip is not None:
        loaded = replace(machine, robot=with_load(robot, robot.tip_link, 1.0, robot.tip_translation))
    torques, reactions = list[Any](), list[Any]()
    each: Any
    for each in (machine, loaded):
        wrenches = wrenches_at(getattr(setup, "wrenches", ()), machine, base, q, time=time)
        if isinstance(each, Standing):
            torques.append(each.joint_torques(q, v, a, wrenches))
            reactions.append(each.ground_reaction(q, v, a, wrenches))
        else:
            forces = {name: getattr(setup, name, None) for name in ("friction", "gravity")}
            torques.append(joint_torques(each, (base, q, v, a), wrenches=wrenches, **forces))
            reactions.append(symbols(0, 1))
    return Sampler([base, q, v, a, time], [*torques, *reactions])


def _ground_rows(machine: Standing, limits: Limits) -> list[tuple[str, Array, float]]:
    """Return names, row vectors w (6,) and limits c of the inequalities w . reaction <= c on the ground reaction.

    The reaction has the moment about the world's origin and the force. While the vertical force is positive, the zero
    moment point (-reaction[1], reaction[0]) / reaction[5] satisfies linear conditions exactly if the reaction does.
    The cone of friction is replaced by an inscribed pyramid.
    """
    zmp = limits.zmp if isinstance(limits.zmp, InFoot | IndexAtLeast | Anywhere) else InFoot()
    rows = [
        ("zero moment point", np.array([-y, x, 0.0, 0.0, 0.0, offset]), 0.0)
        for (x, y), offset in zip(*foot_edges(machine, zmp), strict=True)
    ]
    rows.append(("vertical force of the ground", np.array([0.0, 0, 0, 0, 0, -1]), -limits.least_force(machine)))
    if np.isfinite(limits.friction):
        most = limits.friction * np.cos(np.pi / PYRAMID_SIDES)
        for angle in 2 * np.pi / PYRAMID_SIDES * np.arange(PYRAMID_SIDES):
            rows.append(("friction", np.array([0.0, 0, 0, np.cos(angle), np.sin(angle), -most]), 0.0))
    return rows
