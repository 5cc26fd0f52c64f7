"""Plan: the motion of a machine, its cost and audit, the rejected candidates, and its file format."""

from __future__ import annotations

import csv
import io
import json
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from models import Machine, ModelError
from models.arrays import MAX_LISTED, Array
from ocp.audit.audit import Finding
from ocp.console import interruptible
from ocp.errors import NOT_NUMBERS, ProblemError, StorageWarning, floats, sample_times, unknown_name
from ocp.motion.builders.tool_motion import CLOCK, PACE, SLOPES, Stretch
from ocp.motion.plan.candidate import Candidate
from ocp.motion.plan.request import MotionRequest, request_of, restored_request, stored_request
from ocp.motion.schedule.trajectory import JointTrajectory
from ocp.motion.search.held_joints import all_joints
from ocp.motion.tasks.targets import Target, targets_along, tip_poses
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.stored import ARRAY_NAMES, RECORD_ERRORS, pack_record, unpack_record
from ocp.registry import call_registered
from ocp.solution import Solution, read_head
from ocp.storage import read_arrays, table_head, write_arrays, write_text

__all__ = ["CHECKED_TIMES", "Part", "Plan", "PlanSample", "parts_of"]

RATES = ("rates", SLOPES, "velocities")
MAX_LINES = 15
"""Lines of a printed plan."""
TARGET_TIMES = 401
"""Samples at which a plan keeps the targets of its tasks."""
LIMIT_TOLERANCE = 1e-3
"""Largest relative excess over a joint limit, as in the audit."""
CHECKED_TIMES = 2001
"""Samples at which joint limits are checked, besides the times of the plan."""
TIME_TOLERANCE = 1e-9
"""Share of the horizon by which a time may lie outside it."""


class Part(NamedTuple):
    """Interval of a plan, s, and the suffix of its states and controls in the solution."""

    begin: float
    end: float
    suffix: str


class PlanSample(NamedTuple):
    """Plan at M times.

    Attributes:
        t: s. Shape (M,).
        joints: rad or m. Shape (M, n).
        rates, accelerations: First and second derivatives of the joints. Shape (M, n).
        tip: Pose of the machine's tip in world: position (m) and quaternion [w, x, y, z]. Shape (M, 7).
    """

    t: Array
    joints: Array
    rates: Array
    accelerations: Array
    tip: Array

    def __repr__(self) -> str:
        return (
            f"<PlanSample of {self.joints.shape[1]} joints at {len(self.t)} times, {self.t[0]:g} to {self.t[-1]:g} s>"
        )


@dataclass(frozen=True, eq=False)
class Plan:
    """Lowest-cost motion found that passes its audit.

    Attributes:
        machine: The machine.
        solution: Solution of the optimal control problem.
        parts: Intervals of time with the same tasks; in the solution they run side by side.
        candidates: All motions found, the plan first, then by rising cost.
        bound: Lower bound of the cost of any motion that does the tasks with the joints in `held` where they are; None
            if none was computed.
        targets: Poses that the tasks require along the plan, in world.
        held: Positions of the joints that stand still and are no variables of the solution, rad or m, by name, see
            `search.held_joints`. The torque that holds them is not limited.
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

    @property
    def cost(self) -> float:
        """Cost of the motion."""
        return self.solution.cost

    @property
    def horizon(self) -> float:
        """Final time, s."""
        return self.parts[-1].end

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the moving joints."""
        return tuple(self.machine.robot.joint_names)

    @property
    def t(self) -> Array:
        """Times of the plan's own grid, with both copies of the times between parts. Shape (M,), s."""
        if CLOCK in self.solution.states:
            return np.asarray(self.solution[CLOCK][:, 0])
        share = self.solution.t / self.solution.horizon
        return np.concatenate([part.begin + (part.end - part.begin) * share for part in self.parts])

    def __getitem__(self, name: str) -> Array:
        """Return "joints", "rates" or "base" at the times `t`. Shape (M, n)."""
        if name not in self._names():
            raise unknown_name("name in a plan", name, self._names())
        if self.rate_name == SLOPES and name == "rates":
            return self._of_all_joints(name, np.asarray(self.solution[SLOPES] / self.solution[PACE]))
        own = self.rate_name if name == "rates" else name
        return self._of_all_joints(name, np.concatenate([self.solution[own + part.suffix] for part in self.parts]))

    def _of_all_joints(self, name: str, values: Array) -> Array:
        """Return values of the solution by name, (M, m), extended by the joints that stand still."""
        return values if name == "base" else all_joints(self.machine.robot, self.held, values, rates=name != "joints")

    def at(self, time: Any) -> dict[str, Array]:
        """Return "joints", "rates" and "base" at a time, each (n,), or at times (M,), each (M, n).

        Raises:
            ProblemError: A time is not finite or outside 0 to the horizon.
        """
        times = self._checked_times(time)

        def values_of(name: str) -> Array:
            def values(part: Part, fraction: Array) -> Array:
                sample = self.solution.at_fraction(fraction)
                if name == "rates":
                    return sample[self.rate_name + part.suffix] / (sample[PACE] if self.rate_name == SLOPES else 1.0)
                return sample[name + part.suffix]

            return self._of_all_joints(name, self._over(times.ravel(), values))

        values_by_name = {name: values_of(name) for name in self._names()}
        return {name: values[0] if times.ndim == 0 else values for name, values in values_by_name.items()}

    def sample(self, period: float) -> PlanSample:
        """Sample the motion every `period` s from 0; the last sample is at the horizon.

        Rates may jump where the tasks do, such as where a path begins at full speed. Accelerations there are those
        after the jump.

        Raises:
            ProblemError: A period that is not positive, or too short.
        """
        return self.sampled(sample_times("sample: period", period, self.horizon))

    def sampled(self, times: Any) -> PlanSample:
        """Sample the motion at times (M,), s."""
        t = np.atleast_1d(self._checked_times(times))
        at = self.at(t)
        bases = at["base"] if "base" in at else np.zeros((len(t), 0))
        accelerations = self._of_all_joints("accelerations", self._over(t, self.accelerations))
        tips = tip_poses(self.machine, bases, at["joints"])
        return PlanSample(t, at["joints"], at["rates"], accelerations, tips)

    @property
    def request(self) -> MotionRequest | None:
        """Builder and arguments of the problem; None for a problem that the user declared."""
        return request_of(self.solution.problem)

    def task_share(self, times: Any) -> Array:
        """Return the share of the tasks' own time that has passed at times (M,), s.

        It equals the share of the horizon unless the horizon is free, in which case the pace of the tasks is planned.

        Raises:
            ProblemError: A time is not finite or outside 0 to the horizon.
        """
        t = np.atleast_1d(self._checked_times(times))
        return self._fractions(self.parts[0], t) if CLOCK in self.solution.states else t / self.horizon

    @interruptible
    def audit(self, **settings: Any) -> Any:
        """Check the motion independently of its solver; see `ocp.audit.audit.audit`. Results are cached by settings.

        For a plan without a `request`, the limits of its machine are checked as well, since the meaning of the limits
        in its problem is unknown.
        """
        key = repr(sorted(settings.items()))
        if key not in self._audits:
            audit = self.solution.audit(**settings)
            if self.request is None:
                audit = replace(audit, findings=(*audit.findings, *self._machine_limit_findings()))
            self._audits[key] = audit
        return self._audits[key]

    def _machine_limit_findings(self) -> list[Finding]:
        """Return the largest excess of joints and rates over the limits of the machine."""
        robot, t = self.machine.robot, np.union1d(self.t, np.linspace(0.0, self.horizon, CHECKED_TIMES))
        at, findings = self.at(t), list[Finding]()
        for name, values, lower, upper in (
            ("joints", at["joints"], robot.lower, robot.upper),
            ("rates", at["rates"], -robot.velocity, robot.velocity),
        ):
            excess = np.maximum(values - upper, lower - values)
            row, joint = np.unravel_index(int(np.argmax(excess)), excess.shape)
            size = max(abs(float(lower[joint])), abs(float(upper[joint])))
            unit = ("rad", "m")[robot.moving_joints[joint].kind == "prismatic"] + ("/s" if name == "rates" else "")
            label = f"{name} of the machine, {self.names[joint]!r}"
            value = max(float(excess[row, joint]), 0.0)
            limit = LIMIT_TOLERANCE * (size if np.isfinite(size) else 1.0)
            findings.append(Finding(label, value, limit, float(t[row]), unit=unit))
        return findings

    @property
    def audits(self) -> tuple[Any, ...]:
        """Cached audits, the first one first."""
        return tuple(self._audits.values())

    def __repr__(self) -> str:
        return f"<Plan of {self.horizon:.6g} s: {len(self.names)} joints, {self._costs}, {self._counts}>"

    def __str__(self) -> str:
        """Return the cost, the joints that stand still, and the rejected motions by reason, in at most 15 lines."""
        moving = [name for name in self.names if name not in self.held]
        lines = [f"plan of {self.horizon:.6g} s for {', '.join(moving)}: {self._costs}; {self._counts}"]
        if self.held:
            held = [f"{name} at {position:.4g}" for name, position in self.held.items()]
            more = f" and {len(held) - MAX_LISTED} more" if len(held) > MAX_LISTED else ""
            lines.append(f"  held: {', '.join(held[:MAX_LISTED])}{more}")
        costs_by_reason: dict[str, list[float]] = {}
        for candidate in self.candidates:
            costs_by_reason.setdefault(str(candidate.reason or "the plan"), []).append(candidate.cost)
        for reason, costs in list(costs_by_reason.items())[: MAX_LINES - 3]:
            finite = [cost for cost in costs if np.isfinite(cost)] or [np.nan]
            low, high = min(finite), max(finite)
            span = f"{low:10.6g}" + (f" to {high:.6g}" if low < high else "")
            prefix = "" if len(costs) == 1 else f"{len(costs)} motions: "
            lines.append(f"  {span:<23}  {prefix}{reason}")
        if len(costs_by_reason) > MAX_LINES - 3:
            remaining = sum(len(costs) for costs in list(costs_by_reason.values())[MAX_LINES - 3 :])
            lines.append(f"  {remaining} more, see `candidates`")
        return "\n".join(lines)

    @property
    def _costs(self) -> str:
        return f"cost {self.cost:.6g}" + ("" if self.bound is None else f", lower bound {self.bound:.6g}")

    @property
    def _counts(self) -> str:
        solved = sum(1 for candidate in self.candidates if candidate.solution is not None)
        return f"{solved} of {len(self.candidates)} motions solved"

    # ---- figures -----------------------------------------------------------------------------------------------------

    def plot(self, against: Any = None, *, figure: Any = None) -> Any:
        """Plot position, velocity and acceleration of every joint over time, with limits; see `view.plots.plot_plan`.

        The plan is blue; what it is compared with, another plan, a result of `resolve`, or several by name, is orange.
        A notebook shows the figure, `.savefig("plan.png")` writes it, and `figure=plt.figure()` draws into a window.

        Raises:
            ProblemError: `against` cannot be compared, or has other joints.
        """
        return call_registered("plot_plan", self, against, figure)

    def _repr_html_(self) -> str:
        return str(call_registered("html_of_plan", self))

    # ---- targets -----------------------------------------------------------------------------------------------------

    def with_targets(self, tasks: Sequence[TipTask]) -> Plan:
        """Return the plan with the targets of the tasks that it does, at TARGET_TIMES times."""
        times = np.linspace(0.0, self.horizon, TARGET_TIMES)
        clock = times
        if CLOCK in self.solution.states:
            clock = self.task_share(times) * self.solution.horizon
        at = self.at(times)
        base = at["base"] if "base" in at else np.zeros((TARGET_TIMES, 0))
        return replace(self, targets=targets_along(self.machine, tasks, clock, base, at["joints"], times))

    # ---- files -------------------------------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the plan to one `.npz` file, atomically. The file is data: reading it runs nothing.

        It holds the request, from which `load` declares the problem again. For a problem that the user declared, it
        holds the machine and the expressions of the problem, operation by operation.

        Raises:
            ProblemError, OSError: As in `Solution.save`; or a machine of an unknown kind.

        Warns:
            StorageWarning: A part of the request is not data, such as a Python callback. The file then holds the
                problem instead, or only the solution if that cannot be written either.
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
        head, numbers = pack_record(
            {
                "request": request,
                "parts": self.parts,
                "bound": self.bound,
                "held": [[name, position] for name, position in self.held.items()],
                "candidates": [
                    [c.start.tolist(), c.cost, int(c.stage), c.reason and c.reason.record()] for c in self.candidates
                ],
                "targets": [
                    np.column_stack([target.t, target.position, target.rotation.reshape(-1, 9)])
                    for target in self.targets
                ],
            }
        )
        arrays = {**self.solution.arrays(path, hint), "plan": np.frombuffer(json.dumps(head).encode(), np.uint8)}
        write_arrays(path, {**arrays, **{f"plan.{name}": values for name, values in numbers.items()}})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Plan:
        """Read a file that `save` wrote. Of the candidates, only the plan has its solution.

        The problem is declared again from the request by the planner's own code, so that the audit checks the motion
        against the machine, limits, tasks and obstacles of the request. The bound and the other candidates are read as
        stored.

        Raises:
            FileNotFoundError, ProblemError: As in `Solution.load`; or the file holds no plan.
        """
        arrays = read_arrays(path)
        solution = Solution.of_arrays(path, arrays)
        if "plan" not in arrays:
            words = f"{path} holds a solution and no plan; read it with Solution.load"
            raise ProblemError(words, name="path", value=str(path))
        try:
            head = unpack_record(
                read_head(path, arrays["plan"]), {name: arrays[f"plan.{name}"] for name in ARRAY_NAMES}
            )
            request = restored_request(head["request"])
            if request.builder:
                solution = solution.tied_to(request.problem())
            parts = tuple(Part(float(a), float(b), str(suffix)) for a, b, suffix in head["parts"])
            candidates = tuple(
                Candidate.of_record(start, cost, stage, reason, solution)
                for start, cost, stage, reason in head["candidates"]
            )
            bound = None if head["bound"] is None else float(head["bound"])
            targets = tuple(Target(rows[:, 0], rows[:, 1:4], rows[:, 4:].reshape(-1, 3, 3)) for rows in head["targets"])
            held = request.held if request.builder else {str(name): float(value) for name, value in head["held"]}
            plan = cls(request.machine, solution, parts, candidates, bound, targets, held)
            plan._check_parts()
            return plan.with_targets(request.tasks) if request.builder and targets else plan
        except (*RECORD_ERRORS, ModelError) as error:
            name = getattr(error, "name", None) or "plan"
            words = f"{path}: the plan in it is damaged: {error}"
            raise ProblemError(words, name=str(name), value=str(path)) from error

    def trajectory(self, period: float) -> JointTrajectory:
        """Return the joint trajectory with a point every `period` s."""
        sample = self.sample(period)
        return JointTrajectory(self.names, sample.t, sample.joints, sample.rates, sample.accelerations)

    def table(self, period: float = 0.01) -> dict[str, Array]:
        """Return columns by name with a row every `period` s, as for pandas, polars or pyarrow.

        They are `time` (s), the joints (rad or m), and `NAME.velocity` and `NAME.acceleration` of each. Shape (M,)
        each.
        """
        sample = self.sample(period)
        columns = {"time": sample.t}
        for end, values in (("", sample.joints), (".velocity", sample.rates), (".acceleration", sample.accelerations)):
            columns |= {f"{name}{end}": column for name, column in zip(self.names, values.T, strict=True)}
        return columns

    def write_csv(self, path: str | os.PathLike[str], period: float = 0.01) -> None:
        """Write the `table` of times and joints every `period` s, in full precision, with a header."""
        columns = self.table(period)
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(table_head(self.names))
        writer.writerows([repr(value) for value in row] for row in np.column_stack([*columns.values()]).tolist())
        write_text(path, stream.getvalue())

    def to_ros(self, period: float = 0.01) -> dict[str, Any]:
        """Return a dictionary with the fields of trajectory_msgs/msg/JointTrajectory, a point every `period` s."""
        return self.trajectory(period).to_ros()

    # ---- time of the motion and time of the solution -----------------------------------------------------------------

    def _check_parts(self) -> None:
        """Raise ValueError if the parts do not match the solution, or its joints not the machine."""
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

    def _names(self) -> tuple[str, ...]:
        return ("joints", "rates", *(("base",) if self.machine.base_size else ()))

    def _checked_times(self, time: Any) -> Array:
        try:
            times = floats(time)
        except NOT_NUMBERS as error:
            words = f"a time or an array of times is expected, not {time!r}"
            raise ProblemError(words, name="time", value=time) from error
        slack = TIME_TOLERANCE * self.horizon
        if not ((times >= -slack) & (times <= self.horizon + slack)).all():
            words = f"time {time!r} is outside the plan, 0 to {self.horizon:g} s"
            raise ProblemError(words, name="time", value=time, limit=(0.0, self.horizon))
        return np.asarray(np.clip(times, 0.0, self.horizon))

    @property
    def rate_name(self) -> str:
        """Name of the joint rates in the solution; SLOPES are derivatives by the path, to be divided by the pace."""
        names = {**self.solution.states, **self.solution.controls}
        return next(name for name in RATES if name + self.parts[0].suffix in names)

    def accelerations(self, part: Part, fraction: Array) -> Array:
        """Return the accelerations of the joints of the solution at fractions (M,) of a part. Shape (M, m)."""
        sample, duration = self.solution.at_fraction(fraction), part.end - part.begin
        name = self.rate_name + part.suffix
        if "accelerations" + part.suffix in sample:
            return sample["accelerations" + part.suffix]
        slope = self._slope(name, fraction)
        if self.rate_name != SLOPES:
            return np.asarray(slope / duration)
        pace, change = sample[PACE], self._slope(PACE, fraction)
        return np.asarray((slope * pace - sample[name] * change) / pace**3 / self.solution.horizon)

    def _slope(self, name: str, fraction: Array) -> Array:
        """Return the derivative of a state or control by the fraction. Shape (M, n)."""
        is_state = name in self.solution.states
        pool = self.solution.states if is_state else self.solution.controls
        interpolant = self.solution.state_interpolant if is_state else self.solution.control_interpolant
        offset = sum(values.shape[1] for values in list(pool.values())[: list(pool).index(name)])
        return np.asarray(interpolant.derivative()(fraction)[:, offset : offset + pool[name].shape[1]])

    def _fractions(self, part: Part, times: Array) -> Array:
        """Return the fractions of the solution's horizon at times (M,) of a part."""
        if CLOCK not in self.solution.states:
            return np.asarray(np.clip((times - part.begin) / (part.end - part.begin), 0.0, 1.0))
        low, high = np.zeros(len(times)), np.ones(len(times))
        for _ in range(np.finfo(float).nmant):  # bisection; the clock always advances
            middle = (low + high) / 2
            is_late = self.solution.at_fraction(middle)[CLOCK][:, 0] > times
            low, high = np.where(is_late, low, middle), np.where(is_late, middle, high)
        return np.asarray((low + high) / 2)

    def _over(self, times: Array, evaluate: Callable[[Part, Array], Array]) -> Array:
        """Evaluate each part at the fractions of the times (M,) that it covers; the later one where two meet."""
        begins = [part.begin for part in self.parts]
        which = np.clip(np.searchsorted(begins, times, side="right") - 1, 0, len(self.parts) - 1)
        result: Array | None = None
        for number in np.unique(which):
            part, rows = self.parts[number], np.flatnonzero(which == number)
            values = evaluate(part, self._fractions(part, times[rows]))
            result = np.empty((len(times), values.shape[1])) if result is None else result
            result[rows] = values
        return np.zeros((0, self.machine.joint_size)) if result is None else result


def parts_of(stretches: Sequence[Stretch]) -> tuple[Part, ...]:
    """Return the parts of a plan that consists of stretches."""
    return tuple(Part(stretch.begin, stretch.end, stretch.suffix) for stretch in stretches)
