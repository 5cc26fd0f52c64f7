"""What a plan is: a machine's motion over time, its cost, its audit, and the other motions that were found."""

from __future__ import annotations

import csv
import io
import json
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models import Machine, ModelError
from models.arrays import Array
from models.spatial import quaternion_from_rotation
from ocp.audit.audit import Finding
from ocp.console import interruptible
from ocp.errors import NOT_NUMBERS, ProblemError, StorageWarning, floats, sample_times, unknown_name
from ocp.motion.builders.tool_motion import CLOCK, PACE, SLOPES, Stretch
from ocp.motion.plan.candidate import Candidate
from ocp.motion.plan.request import MotionRequest, request_of, restored_request, stored_request
from ocp.motion.schedule.trajectory import JointTrajectory
from ocp.motion.tasks.targets import Target, targets_along
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.stored import ARRAY_NAMES, RECORD_ERRORS, pack_record, unpack_record
from ocp.registry import call_registered
from ocp.solution import Solution, read_head
from ocp.storage import read_arrays, table_head, write_arrays, write_text

__all__ = ["CHECKED_TIMES", "Part", "Plan", "PlanSample", "parts_of"]

RATES = ("rates", SLOPES, "velocities")
MOST_LINES = 15
"""Of a plan that is printed."""
TARGET_TIMES = 401
"""At which a plan keeps what its tasks ask for."""
ACCURACY = 1e-3
"""Share of its limit by which a joint may pass it, as in the audit."""
CHECKED_TIMES = 2001
"""At which joints are held against limits, beside the times of the plan."""
SAME_TIME = 1e-9
"""Share of the horizon: times beyond it by less are its ends."""


class Part(NamedTuple):
    """A stretch of a plan's time, and the suffix of the names that its states and controls have in the solution."""

    begin: float
    end: float
    suffix: str


class PlanSample(NamedTuple):
    """A plan at M times.

    Attributes:
        t: s. Shape (M,).
        joints: rad or m. Shape (M, n).
        rates, accelerations: Of the joints, their derivatives. Shape (M, n).
        tip: Pose of the machine's tip in the world, position (m) and quaternion [w, x, y, z]. Shape (M, 7).
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
    """The cheapest motion that was found and that passes its audit.

    Attributes:
        machine: What moves.
        solution: Of the problem that was solved, with it.
        parts: Stretches of time in which the same tasks are done; in the solution they stand side by side.
        candidates: Every motion found, the plan among them, the cheapest first.
        bound: A lower bound of the cost of any motion that does the tasks; None where none was looked for.
        targets: The poses that the tasks ask for, along the plan, in the world.
    """

    machine: Machine
    solution: Solution
    parts: tuple[Part, ...]
    candidates: tuple[Candidate, ...] = ()
    bound: float | None = None
    targets: tuple[Target, ...] = ()
    _audits: dict[str, Any] = field(default_factory=dict, repr=False)

    # ---- what it says ------------------------------------------------------------------------------------------

    @property
    def cost(self) -> float:
        """Of the motion."""
        return self.solution.cost

    @property
    def horizon(self) -> float:
        """Final time, s."""
        return self.parts[-1].end

    @property
    def names(self) -> tuple[str, ...]:
        """Of the joints that move."""
        return tuple(self.machine.robot.joint_names)

    @property
    def t(self) -> Array:
        """Times of the plan's own grid; where two parts meet there are two of the same. Shape (M,), s."""
        if CLOCK in self.solution.states:
            return np.asarray(self.solution[CLOCK][:, 0])
        share = self.solution.t / self.solution.horizon
        return np.concatenate([part.begin + (part.end - part.begin) * share for part in self.parts])

    def __getitem__(self, name: str) -> Array:
        """Values of "joints", "rates" or "base" at the times `t`. Shape (M, n)."""
        self._check_name(name)
        if self.rated == SLOPES and name == "rates":
            return np.asarray(self.solution[SLOPES] / self.solution[PACE])
        own = self.rated if name == "rates" else name
        return np.concatenate([self.solution[own + part.suffix] for part in self.parts])

    def at(self, time: Any) -> dict[str, Array]:
        """Values of "joints", "rates" and "base" at a time, each (n,), or at times (M,), each (M, n).

        Raises:
            ProblemError: A time outside 0 to the horizon, or not finite.
        """
        times = self._checked_times(time)

        def named(name: str) -> Array:
            def said(part: Part, fraction: Array) -> Array:
                sample = self.solution.at_fraction(fraction)
                if name == "rates":
                    return sample[self.rated + part.suffix] / (sample[PACE] if self.rated == SLOPES else 1.0)
                return sample[name + part.suffix]

            return self._over(times.ravel(), said)

        found = {name: named(name) for name in self._names()}
        return {name: values[0] if times.ndim == 0 else values for name, values in found.items()}

    def sample(self, period: float) -> PlanSample:
        """The motion every `period` s from 0; the last sample, at the end, comes as early as the horizon says.

        Rates may jump where the tasks do, for example where a path begins at full speed; accelerations there are
        those after the jump.

        Raises:
            ProblemError: A period that is not positive, or too short.
        """
        return self.sampled(sample_times("sample: period", period, self.horizon))

    def sampled(self, times: Any) -> PlanSample:
        """The motion at times (M,), s."""
        t = np.atleast_1d(self._checked_times(times))
        at = self.at(t)
        bases = at["base"] if "base" in at else np.zeros((len(t), 0))
        return PlanSample(
            t, at["joints"], at["rates"], self._over(t, self.accelerations), self._tips(bases, at["joints"])
        )

    @property
    def request(self) -> MotionRequest | None:
        """What was asked, from which the problem can be declared again; None of a problem of one's own."""
        return request_of(self.solution.problem)

    def task_share(self, times: Any) -> Array:
        """Return the share of the tasks' own time that has passed at times (M,), s.

        It is that of the horizon, unless the horizon was free: the pace of the tasks is planned then.

        Raises:
            ProblemError: A time outside 0 to the horizon, or not finite.
        """
        t = np.atleast_1d(self._checked_times(times))
        return self._fractions(self.parts[0], t) if CLOCK in self.solution.states else t / self.horizon

    @interruptible
    def audit(self, **settings: Any) -> Any:
        """Check the motion independently of what made it; see `ocp.audit.audit.audit`. Done once for each setting.

        A plan without a `request` is also held against the limits of its own machine, for nobody knows what those of
        its problem stand for.
        """
        key = repr(sorted(settings.items()))
        if key not in self._audits:
            audit = self.solution.audit(**settings)
            if self.request is None:
                audit = replace(audit, findings=(*audit.findings, *self._against_machine()))
            self._audits[key] = audit
        return self._audits[key]

    def _against_machine(self) -> list[Finding]:
        """How far joints are beyond the limits of the machine, where they are most."""
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
            limit = ACCURACY * (size if np.isfinite(size) else 1.0)
            findings.append(Finding(label, value, limit, float(t[row]), unit=unit))
        return findings

    @property
    def audits(self) -> tuple[Any, ...]:
        """Those that were done, the first one first."""
        return tuple(self._audits.values())

    def __repr__(self) -> str:
        return f"<Plan of {self.horizon:.6g} s: {len(self.names)} joints, {self._costs}, {self._found}>"

    def __str__(self) -> str:
        """What it costs, and why the other motions are not the plan, by reason; 15 lines at most."""
        lines = [f"plan of {self.horizon:.6g} s for {', '.join(self.names)}: {self._costs}; {self._found}"]
        told: dict[str, list[float]] = {}
        for one in self.candidates:
            told.setdefault(str(one.reason or "the plan"), []).append(one.cost)
        for why, costs in list(told.items())[: MOST_LINES - 2]:
            found = [cost for cost in costs if np.isfinite(cost)] or [np.nan]
            low, high = min(found), max(found)
            span = f"{low:10.6g}" + (f" to {high:.6g}" if low < high else "")
            several = "" if len(costs) == 1 else f"{len(costs)} motions: "
            lines.append(f"  {span:<23}  {several}{why}")
        if len(told) > MOST_LINES - 2:
            rest = sum(len(costs) for costs in list(told.values())[MOST_LINES - 2 :])
            lines.append(f"  {rest} more: `candidates` of the plan")
        return "\n".join(lines)

    @property
    def _costs(self) -> str:
        return f"cost {self.cost:.6g}" + ("" if self.bound is None else f", at least {self.bound:.6g} any")

    @property
    def _found(self) -> str:
        solved = sum(1 for candidate in self.candidates if candidate.solution is not None)
        return f"{solved} of {len(self.candidates)} motions solved"

    # ---- what it looks like --------------------------------------------------------------------------------------

    def plot(self, against: Any = None, *, figure: Any = None) -> Any:
        """Position, velocity and acceleration of every joint over time, with limits; see `view.plots.plot_plan`.

        The plan is blue; what it is compared with, another plan or what `resolve` made, or several by name, orange.
        A notebook shows the figure, `.savefig("plan.png")` writes it; `figure=plt.figure()` draws into a window.

        Raises:
            ProblemError: Nothing that can be compared, or of other joints.
        """
        return call_registered("plot_plan", self, against, figure)

    def _repr_html_(self) -> str:
        return str(call_registered("html_of_plan", self))

    # ---- what was asked -----------------------------------------------------------------------------------------

    def with_targets(self, tasks: Sequence[TipTask]) -> Plan:
        """The same plan, which tells what the tasks that it does ask for at TARGET_TIMES times."""
        times = np.linspace(0.0, self.horizon, TARGET_TIMES)
        clock = times
        if CLOCK in self.solution.states:
            clock = self.task_share(times) * self.solution.horizon
        at = self.at(times)
        base = at["base"] if "base" in at else np.zeros((TARGET_TIMES, 0))
        return replace(self, targets=targets_along(self.machine, tasks, clock, base, at["joints"], times))

    # ---- files -------------------------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the plan to one `.npz` file, whole or not at all. The file is data: reading it runs nothing.

        It holds what was asked, from which `load` declares the problem again; of a problem of one's own its machine and
        its expressions, operation by operation.

        Raises:
            ProblemError, OSError: As `Solution.save`; a machine that is none of models'.

        Warns:
            StorageWarning: A part of the request is no data, such as a callback of Python's, so that the problem is
                written in its place; or the problem cannot be written, either.
        """
        try:
            request, why_none = stored_request("", {"machine": self.machine}), ""
        except ProblemError as error:
            words = f"the machine cannot be written to a file: {error}; save the plan's solution alone"
            raise ProblemError(words, name="machine", value=error.value) from error
        if self.request is not None and self.request.machine is self.machine:
            try:
                request = stored_request(self.request.builder, self.request.arguments)
                why_none = "it is declared again from what the plan was asked: read the file with Plan.load"
            except ProblemError as error:
                words = f"{path} is saved without what was asked, by the problem alone: {error}"
                warnings.warn(StorageWarning(words, name=error.name), stacklevel=2)
        told, numbers = pack_record(
            {
                "request": request,
                "parts": self.parts,
                "bound": self.bound,
                "candidates": [
                    [c.start.tolist(), c.cost, int(c.stage), c.reason and c.reason.record()] for c in self.candidates
                ],
                "targets": [np.column_stack([o.t, o.position, o.rotation.reshape(-1, 9)]) for o in self.targets],
            }
        )
        arrays = {**self.solution.arrays(path, why_none), "plan": np.frombuffer(json.dumps(told).encode(), np.uint8)}
        write_arrays(path, {**arrays, **{f"plan.{name}": values for name, values in numbers.items()}})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Plan:
        """Read a file that `save` wrote. Of the candidates only the plan has its solution.

        The problem is declared again from what was asked, by the code that plans, so that the audit holds the motion
        against the machine, limits, tasks and obstacles of the request. What the file says of its bound and of other
        candidates is told as it stands there.

        Raises:
            FileNotFoundError, ProblemError: As `Solution.load`; a file that is no plan's.
        """
        arrays = read_arrays(path)
        solution = Solution.of_arrays(path, arrays)
        if "plan" not in arrays:
            words = f"{path} holds a solution and no plan; read it with Solution.load"
            raise ProblemError(words, name="path", value=str(path))
        try:
            told = unpack_record(
                read_head(path, arrays["plan"]), {name: arrays[f"plan.{name}"] for name in ARRAY_NAMES}
            )
            request = restored_request(told["request"])
            if request.builder:
                solution = solution.tied_to(request.problem())
            parts = tuple(Part(float(a), float(b), str(suffix)) for a, b, suffix in told["parts"])
            candidates = tuple(
                Candidate.of_record(start, cost, stage, reason, solution)
                for start, cost, stage, reason in told["candidates"]
            )
            bound = None if told["bound"] is None else float(told["bound"])
            targets = tuple(Target(one[:, 0], one[:, 1:4], one[:, 4:].reshape(-1, 3, 3)) for one in told["targets"])
            plan = cls(request.machine, solution, parts, candidates, bound, targets)
            plan._check_parts()
            return plan.with_targets(request.tasks) if request.builder and targets else plan
        except (*RECORD_ERRORS, ModelError) as error:
            name = getattr(error, "name", None) or "plan"
            raise ProblemError(
                f"{path}: the plan in it is damaged: {error}", name=str(name), value=str(path)
            ) from error

    def trajectory(self, period: float) -> JointTrajectory:
        """The joints every `period` s, as a trajectory of joints."""
        found = self.sample(period)
        return JointTrajectory(self.names, found.t, found.joints, found.rates, found.accelerations)

    def table(self, period: float = 0.01) -> dict[str, Array]:
        """Columns by name, a row every `period` s: what pandas.DataFrame, polars.DataFrame and pyarrow.table take.

        `time` (s), the joints (rad or m), `NAME.velocity` and `NAME.acceleration` of each. Shape (M,) each.
        """
        found = self.sample(period)
        columns = {"time": found.t}
        for end, values in (("", found.joints), (".velocity", found.rates), (".acceleration", found.accelerations)):
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
        """Plain dictionary of the fields of trajectory_msgs/msg/JointTrajectory, a point every `period` s."""
        return self.trajectory(period).to_ros()

    # ---- between the motion's time and the solution's ----------------------------------------------------------

    def _check_parts(self) -> None:
        """Raise ValueError where the parts are not the solution's, or its joints are not the machine's."""
        ends = [0.0, *(part.end for part in self.parts)]
        follow = all(part.begin == end < part.end for part, end in zip(self.parts, ends, strict=False))
        clock = self.solution.states.get(CLOCK)
        if not (self.parts and follow and ends[-1] == (self.solution.horizon if clock is None else clock[-1, 0])):
            raise ValueError(f"its parts {self.parts} do not fill the time of its solution one after the other")
        found = {name: values.shape[1] for name, values in {**self.solution.states, **self.solution.controls}.items()}
        sizes = {"joints": self.machine.joint_size, "base": self.machine.base_size}
        for part in self.parts:
            rated = [found.get(name + part.suffix) for name in RATES]
            known = [found.get(name + part.suffix, 0) for name in sizes]
            if known != list(sizes.values()) or sizes["joints"] not in rated:
                raise ValueError(f"the solution has no joints and rates of this machine, {sizes}, in {part}")

    def _names(self) -> tuple[str, ...]:
        return ("joints", "rates", *(("base",) if self.machine.base_size else ()))

    def _check_name(self, name: str) -> None:
        if name not in self._names():
            raise unknown_name("name in a plan", name, self._names())

    def _checked_times(self, time: Any) -> Array:
        try:
            times = floats(time)
        except NOT_NUMBERS as error:
            words = f"a time or an array of times is expected, not {time!r}"
            raise ProblemError(words, name="time", value=time) from error
        slack = SAME_TIME * self.horizon
        if not ((times >= -slack) & (times <= self.horizon + slack)).all():
            words = f"time {time!r} is outside the plan, 0 to {self.horizon:g} s"
            raise ProblemError(words, name="time", value=time, limit=(0.0, self.horizon))
        return np.asarray(np.clip(times, 0.0, self.horizon))

    @property
    def rated(self) -> str:
        """What the joint rates are called in the solution; SLOPES by the path, over the pace, are these too."""
        told = {**self.solution.states, **self.solution.controls}
        return next(name for name in RATES if name + self.parts[0].suffix in told)

    def accelerations(self, part: Part, fraction: Array) -> Array:
        """Of the joints, at fractions (M,) of a part. Shape (M, n)."""
        sample, name, long = self.solution.at_fraction(fraction), self.rated + part.suffix, part.end - part.begin
        if "accelerations" + part.suffix in sample:
            return sample["accelerations" + part.suffix]
        slope = self._slope(name, fraction)
        if self.rated != SLOPES:
            return np.asarray(slope / long)
        pace, change = sample[PACE], self._slope(PACE, fraction)
        return np.asarray((slope * pace - sample[name] * change) / pace**3 / self.solution.horizon)

    def _slope(self, name: str, fraction: Array) -> Array:
        """Derivative of a state or a control by the fraction. Shape (M, n)."""
        own = name in self.solution.states
        pool = self.solution.states if own else self.solution.controls
        curve = self.solution.state_interpolant if own else self.solution.control_interpolant
        before = sum(values.shape[1] for values in list(pool.values())[: list(pool).index(name)])
        return np.asarray(curve.derivative()(fraction)[:, before : before + pool[name].shape[1]])

    def _fractions(self, part: Part, times: Array) -> Array:
        """Fractions of the solution's horizon at times (M,) of a part."""
        if CLOCK not in self.solution.states:
            return np.asarray(np.clip((times - part.begin) / (part.end - part.begin), 0.0, 1.0))
        low, high = np.zeros(len(times)), np.ones(len(times))
        for _ in range(np.finfo(float).nmant):  # the clock never stands still
            middle = (low + high) / 2
            late = self.solution.at_fraction(middle)[CLOCK][:, 0] > times
            low, high = np.where(late, low, middle), np.where(late, middle, high)
        return np.asarray((low + high) / 2)

    def _over(self, times: Array, ask: Callable[[Part, Array], Array]) -> Array:
        """What each part says at its fractions, of the times (M,) that it covers; the later one where two meet."""
        begins = [part.begin for part in self.parts]
        which = np.clip(np.searchsorted(begins, times, side="right") - 1, 0, len(self.parts) - 1)
        found: Array | None = None
        for number in np.unique(which):
            part, rows = self.parts[number], np.flatnonzero(which == number)
            values = ask(part, self._fractions(part, times[rows]))
            found = np.empty((len(times), values.shape[1])) if found is None else found
            found[rows] = values
        return np.zeros((0, self.machine.joint_size)) if found is None else found

    def _tips(self, bases: Array, joints: Array) -> Array:
        if self.machine.robot.tip is None:
            return np.zeros((len(joints), 7)) * np.nan
        b, q = ca.SX.sym("b", self.machine.base_size), ca.SX.sym("q", self.machine.joint_size)
        pose = self.machine.tip_pose(b, q)
        function = ca.Function("tip", [b, q], [pose.position, pose.rotation])
        position, rotation = function.map(len(joints))(bases.T, joints.T)
        turns = np.array(rotation).reshape(3, len(joints), 3).transpose(1, 0, 2)
        return np.column_stack([np.array(position).T, quaternion_from_rotation(turns)])


def parts_of(stretches: Sequence[Stretch]) -> tuple[Part, ...]:
    """The parts of a plan made of stretches."""
    return tuple(Part(stretch.begin, stretch.end, stretch.suffix) for stretch in stretches)
