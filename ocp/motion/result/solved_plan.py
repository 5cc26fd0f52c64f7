"""Plans whose motion solves one optimal control problem, of one phase or several, and their file format."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models import Machine
from models.checks import Array
from models.machines.machine import hold_joints
from ocp.audit.audit import Audit
from ocp.curves import gauss_points
from ocp.errors import ProblemError, StorageWarning
from ocp.motion.builders.tool_motion import CLOCK, ERRORS, PACE, SLOPES, START_ERRORS
from ocp.motion.result.candidate import Candidate
from ocp.motion.result.plan import Plan, Rows, evaluate_parts, read_record, reading_plan, record_arrays
from ocp.motion.result.request import MotionRequest, machines_of_phases, request_of, restored_request, stored_request
from ocp.motion.search.held_joints import all_joints
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.motion.tasks.speed_profile import segment_index
from ocp.motion.tasks.targets import Target, targets_along, tip_poses
from ocp.motion.tasks.tip_task import TipTask
from ocp.solution import Solution

RATES = ("rates", SLOPES, "velocities")
PHASED = "plan.phased"  # name of the array whose presence marks the file of a plan with several phases
TARGET_TIMES = 401  # number of times at which a plan stores the target poses of its tasks


class Part(NamedTuple):
    """Time interval of a plan, s, and the suffix of the names of states and controls in this interval."""

    begin: float
    end: float
    suffix: str


def deviation_cost(solution: Solution, parts: Sequence[Part]) -> float:
    """Return the part of a solution's cost that penalises deviations of relaxed tasks from their targets."""
    curve = solution.control_interpolant
    fractions, shares = (each.ravel() for each in gauss_points(curve.breaks, len(curve.nodes)))
    errors = {part.suffix: part.end - part.begin for part in parts if f"{ERRORS}{part.suffix}" in solution.controls}
    sample = solution.at_fraction(np.clip(fractions, 0.0, 1.0)) if errors else {}
    total = sum(seconds * shares @ (sample[f"{ERRORS}{suffix}"] ** 2).sum(axis=1) for suffix, seconds in errors.items())
    starts = (values[-1] for name, values in solution.states.items() if name.startswith(START_ERRORS))
    return float(total + sum((values**2).sum() for values in starts)) / 2


@dataclass(frozen=True, eq=False, repr=False)
class SolvedPlan(Plan):
    """Plan whose motion solves one optimal control problem.

    Attributes:
        solution: The solution.
        parts: Intervals of time with the same tasks, which share one normalised time in the solution.
        machine, candidates, bound, targets, held: As in `Plan`.
    """

    machine: Machine
    solution: Solution
    parts: tuple[Part, ...]
    candidates: tuple[Candidate, ...] = ()
    bound: float | None = None
    targets: tuple[Target, ...] = ()
    held: Mapping[str, float] = field(default_factory=dict)
    _audits: dict[str, Any] = field(default_factory=dict, repr=False)

    # ---- values ------------------------------------------------------------------------------------------------------

    @cached_property
    def cost(self) -> float:
        """Value of the cost function for the motion; deviations from relaxed tasks, within tolerance, cost nothing."""
        return self.solution.cost - deviation_cost(self.solution, self.parts)

    @property
    def horizon(self) -> float:
        """Final time of the motion, s."""
        return self.parts[-1].end

    @property
    def t(self) -> Array:
        """Times of the plan's grid, s; the time at a junction of two parts occurs twice. Shape (M,)."""
        if CLOCK in self.solution.states:
            return np.asarray(self.solution[CLOCK][:, 0])
        share = self.solution.t / self.solution.horizon
        return np.concatenate([part.begin + (part.end - part.begin) * share for part in self.parts])

    def _variable(self, name: str, part: Part) -> str:
        """Return the name that a state or control of a part has in the solution."""
        return name + part.suffix

    def _values(self, name: str) -> Array:
        values = {**self.solution.states, **self.solution.controls}
        return np.concatenate([self._plan_values(name, part, values) for part in self.parts])

    def _values_at(self, name: str, times: Array) -> Array:
        def values(number: int, rows: Rows) -> Array:
            part = self.parts[number]
            fraction = self._fractions(part, times[rows])
            if name == "accelerations":
                return self._of_all_joints(name, part, self.accelerations(part, fraction))
            return self._plan_values(name, part, self.solution.at_fraction(fraction))

        size = self.machine.base_size if name == "base" else self.machine.joint_size
        return evaluate_parts(self._begins, times, size, values)

    def _plan_values(self, name: str, part: Part, values: Mapping[str, Array]) -> Array:
        """Return "joints", "rates" or "base" of a part of the plan from values of the solution, (M, m) by name."""
        own = self.rate_name if name == "rates" else name
        pace = values[PACE] if own == SLOPES else 1.0
        return self._of_all_joints(name, part, values[self._variable(own, part)] / pace)

    def _of_all_joints(self, name: str, part: Part, values: Array) -> Array:
        """Insert the values of the joints that stay at rest into joint values (M, m) of a part of the solution."""
        return values if name == "base" else all_joints(self.machine.robot, self.held, values, rates=name != "joints")

    def solved_parts(self, times: Array) -> list[tuple[Solution, str, Array]]:
        """Return for each part the solution, its suffix of variable names, and its times on the solution's clock."""
        which = segment_index([*self._begins, np.inf], times)
        return [
            (self.solution, part.suffix, self._fractions(part, times[which == k]) * self.solution.horizon)
            for k, part in enumerate(self.parts)
        ]

    @property
    def request(self) -> MotionRequest | None:
        """Builder and arguments from which the problem was declared; None if the user declared the problem."""
        return request_of(self.solution.problem)

    def task_share(self, times: Any) -> Array:
        """Return the fraction of the duration of the tasks that has passed at times (M,), s. Shape (M,)."""
        if CLOCK not in self.solution.states:
            return super().task_share(times)
        return self._fractions(self.parts[0], np.atleast_1d(self._checked_times(times)))

    @property
    def joint_bounds(self) -> JointBounds:
        own, limits = super().joint_bounds, None if self.request is None else self.request.arguments.get("limits")
        if not isinstance(limits, Limits):
            return own
        stated = limits.bounds(hold_joints(self.machine, self.held) if self.held else self.machine)
        whole = [np.array(values) for values in own]  # joints that are held have the limits of the robot
        for values, free in zip(whole, stated, strict=True):
            values[[name not in self.held for name in self.names]] = free
        return own.tightened(JointBounds(*whole))

    def _audit(self, **settings: Any) -> Audit:
        """Return the audit of the solution, with findings about all joint limits if the user declared the problem.

        The meaning of the limits in such a problem is unknown.
        """
        audit: Audit = self.solution.audit(**settings)
        if self.request is None:
            audit = replace(audit, findings=(*audit.findings, *self.limit_findings()))
        return audit

    # ---- targets -----------------------------------------------------------------------------------------------------

    def with_targets(self, tasks: Sequence[TipTask]) -> SolvedPlan:
        """Return the plan with the target poses of its tasks, sampled at evenly spaced times."""
        return replace(self, targets=self._targets_of(tasks, np.linspace(0.0, self.horizon, TARGET_TIMES)))

    def targets_at(self, times: Any) -> tuple[Target, ...]:
        """Return the target poses of the tasks at times (M,), s; none if the tasks are unknown."""
        return () if self.request is None else self._targets_of(self.request.tasks, self._checked_times(times))

    def _targets_of(self, tasks: Sequence[TipTask], times: Array) -> tuple[Target, ...]:
        clock = self.task_share(times) * self.solution.horizon if CLOCK in self.solution.states else times
        at = self.at(times)
        base = at["base"] if "base" in at else np.zeros((len(times), 0))
        return targets_along(self.machine, tasks, clock, base=base, joints=at["joints"], shown_times=times)

    # ---- files -------------------------------------------------------------------------------------------------------

    def arrays(self, path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
        """Return the arrays that are written to the file of the plan, by name.

        They hold the request, from which `load` declares the problem again. For a problem that the user declared, they
        hold the machine and the expressions of the problem, operation by operation.
        """
        try:
            request, hint = stored_request("", {"machine": self.machine}), ""
        except ProblemError as error:
            words = f"the machine cannot be stored in a file: {error}; save the plan's solution alone"
            raise ProblemError(words, name="machine", value=error.value) from error
        if self.request is not None and self.request.machine is self.machine:
            try:
                request = stored_request(self.request.builder, self.request.arguments)
                hint = "it is declared again from the request of the plan: read the file with Plan.load"
            except ProblemError as error:
                words = f"{path} is saved with the problem instead of the request: {error}"
                warnings.warn(StorageWarning(words, name=error.name), stacklevel=2)
        record = {
            "request": request,
            "parts": self.parts,
            "bound": self.bound,
            "held": [[name, position] for name, position in self.held.items()],
            "candidates": [candidate.record() for candidate in self.candidates],
            "targets": [
                np.column_stack([target.t, target.position, target.rotation.reshape(-1, 9)]) for target in self.targets
            ],
        }
        return {**self.solution.arrays(path, hint), **record_arrays("plan", record)}

    @classmethod
    def of_arrays(cls, path: str | os.PathLike[str], arrays: dict[str, np.ndarray]) -> SolvedPlan:
        """Build the plan from the arrays of a file, which are checked because files are not trusted."""
        solution = Solution.of_arrays(path, arrays)
        if "plan" not in arrays:
            words = f"{path} holds a solution and no plan; read it with Solution.load"
            raise ProblemError(words, name="path", value=str(path))
        with reading_plan(path):
            head = read_record(path, arrays, "plan")
            request = restored_request(head["request"])
            if request.builder:
                solution = solution.tied_to(request.problem())
            parts = tuple(Part(float(a), float(b), str(suffix)) for a, b, suffix in head["parts"])
            candidates = tuple(Candidate.of_record(record, solution) for record in head["candidates"])
            bound = None if head["bound"] is None else float(head["bound"])
            targets = tuple(Target(rows[:, 0], rows[:, 1:4], rows[:, 4:].reshape(-1, 3, 3)) for rows in head["targets"])
            held = request.held if request.builder else {str(name): float(value) for name, value in head["held"]}
            plan = cls(request.machine, solution, parts, candidates, bound, targets, held)
            plan._check_parts()
            return plan.with_targets(request.tasks) if request.builder and targets else plan

    # ---- time of the motion and time of the solution -----------------------------------------------------------------

    def _check_parts(self) -> None:
        """Raise ValueError if the time intervals, the joints or the base of the plan do not fit the solution."""
        ends = [0.0, *(part.end for part in self.parts)]
        contiguous = all(part.begin == end < part.end for part, end in zip(self.parts, ends, strict=False))
        clock = self.solution.states.get(CLOCK)
        if not (self.parts and contiguous and ends[-1] == (self.solution.horizon if clock is None else clock[-1, 0])):
            raise ValueError(f"its parts {self.parts} do not fill the time of its solution one after the other")
        variables = {**self.solution.states, **self.solution.controls}
        sizes_by_name = {name: values.shape[1] for name, values in variables.items()}
        if unknown := [name for name in self.held if name not in self.names]:
            raise ValueError(f"the machine has no joints {unknown}, which it holds")
        sizes = {"joints": self.machine.joint_size - len(self.held), "base": self.machine.base_size}
        for part in self.parts:
            rate_sizes = [sizes_by_name.get(name + part.suffix) for name in RATES]
            sizes_of_part = [sizes_by_name.get(name + part.suffix, 0) for name in sizes]
            if sizes_of_part != list(sizes.values()) or sizes["joints"] not in rate_sizes:
                raise ValueError(f"the solution has no joints and rates of this machine, {sizes}, in {part}")

    @property
    def rate_name(self) -> str:
        """Name of the state or control in the solution that holds the joint rates."""
        names = {**self.solution.states, **self.solution.controls}
        return next(name for name in RATES if self._variable(name, self.parts[0]) in names)

    def accelerations(self, part: Part, fraction: Array) -> Array:
        """Return the joint accelerations at fractions (M,) of a time interval (part) of the plan. Shape (M, m)."""
        sample, duration = self.solution.at_fraction(fraction), part.end - part.begin
        name = self.rate_name + part.suffix
        if (accelerations := self._variable("accelerations", part)) in sample:
            return sample[accelerations]
        slope = self._slope(name, fraction)
        if self.rate_name != SLOPES:
            return np.asarray(slope / duration)
        pace, change = sample[PACE], self._slope(PACE, fraction)
        return np.asarray((slope * pace - sample[name] * change) / pace**3 / self.solution.horizon)

    def _slope(self, name: str, fraction: Array) -> Array:
        """Return the derivative of a state or control with respect to the fraction of the horizon. Shape (M, n)."""
        is_state = name in self.solution.states
        pool = self.solution.states if is_state else self.solution.controls
        interpolant = self.solution.state_interpolant if is_state else self.solution.control_interpolant
        offset = sum(values.shape[1] for values in list(pool.values())[: list(pool).index(name)])
        return np.asarray(interpolant.derivative()(fraction)[:, offset : offset + pool[name].shape[1]])

    def _fractions(self, part: Part, times: Array) -> Array:
        """Convert times (M,) in a time interval (part) of the plan to fractions of the solution's horizon."""
        if CLOCK not in self.solution.states:
            return np.asarray(np.clip((times - part.begin) / (part.end - part.begin), 0.0, 1.0))
        low, high = np.zeros(len(times)), np.ones(len(times))
        for _ in range(np.finfo(float).nmant):  # bisection; the clock always advances
            middle = (low + high) / 2
            is_late = self.solution.at_fraction(middle)[CLOCK][:, 0] > times
            low, high = np.where(is_late, low, middle), np.where(is_late, middle, high)
        return np.asarray((low + high) / 2)

    @property
    def _begins(self) -> list[float]:
        """Times at which the parts of the plan begin, s."""
        return [part.begin for part in self.parts]


@dataclass(frozen=True, eq=False, repr=False)
class PhasedPlan(SolvedPlan):
    """Plan of several consecutive phases, such as motions to several goals with different loads.

    The suffix of a part is the name of its phase; `plan.solution.phase(name)` is the phase over its own time.

    Attributes:
        machine: Machine of the first phase. All phases have its joints.
        solution, parts, candidates, bound, targets: As in `SolvedPlan`.
    """

    @property
    def phases(self) -> tuple[str, ...]:
        """Names of the phases."""
        return tuple(part.suffix for part in self.parts)

    @cached_property
    def machines(self) -> tuple[Machine, ...]:
        """Machine of each phase; if the user declared the problem, the machine of the first phase for all phases."""
        machines = machines_of_phases(self.request)
        return machines if len(machines) == len(self.parts) else (self.machine,) * len(self.parts)

    @cached_property
    def _joint_indices(self) -> dict[str, NDArray[np.intp]]:
        """Indices of the first machine's joints in the joint vector of each phase, by phase name. Shape (n,) each."""
        orders = {}
        for name, machine in zip(self.phases, self.machines, strict=True):
            joints = list(machine.robot.joint_names)
            orders[name] = np.array([joints.index(joint) for joint in self.names], dtype=np.intp)
        return orders

    def _variable(self, name: str, part: Part) -> str:
        return f"{part.suffix}.{name}"

    def _of_all_joints(self, name: str, part: Part, values: Array) -> Array:
        """Return joint values of a phase in the joint order of the first phase's machine."""
        return values if name == "base" else values[:, self._joint_indices[part.suffix]]

    def _tips_at(self, times: Array, bases: Array, joints: Array) -> Array:
        def tips(number: int, rows: Rows) -> Array:
            order = np.argsort(self._joint_indices[self.phases[number]])
            return tip_poses(self.machines[number], bases[rows], joints[rows][:, order])

        return evaluate_parts(self._begins, times, 7, tips)

    def arrays(self, path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
        """Return the arrays that are written to the file of the plan, by name."""
        return {**super().arrays(path), PHASED: np.ones(1)}

    def solved_parts(self, times: Array) -> list[tuple[Solution, str, Array]]:
        """Return an empty list, since the phases of the plan are solved together as one problem."""
        return []

    def _check_parts(self) -> None:
        times = self.solution.phases
        if tuple(times) != self.phases:
            raise ValueError(f"its parts {self.phases} are not the phases {tuple(times)} of its solution")
        if not all(np.allclose(times[part.suffix], part[:2], rtol=1e-9, atol=1e-12) for part in self.parts):
            raise ValueError(f"its parts {self.parts} do not fill the time of its solution one after the other")
        for part, machine in zip(self.parts, self.machines, strict=True):
            names = [self._variable(each, part) for each in ("joints", "velocities")]
            sizes = [self.solution.states.get(each, np.zeros((0, 0))).shape[1] for each in names]
            if set(machine.robot.joint_names) != set(self.names) or sizes != [machine.joint_size] * 2:
                raise ValueError(f"the solution has no joints and velocities of its machine in phase {part.suffix!r}")
