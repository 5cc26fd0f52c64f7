"""Plan: the motion of a machine over time, its cost, bound and audit, and its tables and files.

Plans differ in what they are made of: a solution of an optimal control problem (`solved_plan`), a joint path through
waypoints (`path_plan`), or several plans one after the other (`segmented_plan`).
"""

from __future__ import annotations

import json
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from models import Machine, ModelError
from models.checks import MAX_LISTED, Array
from ocp.audit.audit import Audit, Finding
from ocp.console import interruptible
from ocp.errors import ProblemError, require, sample_times, values_within
from ocp.motion.result.candidate import Candidate, Rejection, Stage
from ocp.motion.schedule.trajectory import JointTrajectory
from ocp.motion.tasks.checks import CHECKS
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.motion.tasks.speed_profile import segment_index
from ocp.motion.tasks.targets import Target, tip_poses
from ocp.problem.record_reader import ARRAY_NAMES, RECORD_ERRORS, unpack_record
from ocp.problem.record_writer import pack_record
from ocp.solution import MAX_LINES, Solution
from ocp.solution_data import call_registered, read_head
from ocp.storage import table_head, write_arrays, write_text
from ocp.tolerances import LIMIT_SHARE

ENDS = "speed at both ends"  # name of the audit finding that tells whether a motion starts and ends at rest
CHECKED_TIMES = 2001  # number of samples at which joint limits are checked, besides the times of the plan
Rows: TypeAlias = NDArray[np.intp]


class PlanSample(NamedTuple):
    """Samples of a plan at M times.

    Attributes:
        t: Times, s. Shape (M,).
        joints: Joint positions, rad or m. Shape (M, n).
        rates, accelerations: First and second time derivatives of the joint positions. Shape (M, n).
        tip: Pose of the machine's tip in world: position (m) and quaternion [w, x, y, z]. Shape (M, 7).
    """

    t: Array
    joints: Array
    rates: Array
    accelerations: Array
    tip: Array

    def __repr__(self) -> str:
        times = f"{len(self.t)} times, {self.t[0]:g} to {self.t[-1]:g} s"
        return f"<PlanSample of {self.joints.shape[1]} joints at {times}>"


class Plan(ABC):
    """Lowest-cost motion that planning found and that passes its audit (base class of all plans).

    Attributes:
        machine: The machine.
        candidates: All motions found, the plan first, then by rising cost.
        bound: Lower bound of the cost of any motion that does the same with the joints in `held` where they are; None
            if none was computed.
        targets: Poses that the tasks require along the plan, in world.
        held: Positions of the joints that stand still and are no variables of the solution, rad or m, by name, see
            `search.held_joints`. The torque that holds them is not limited.
        solution: Solution of the optimal control problem of the motion. Plans of several motions raise ProblemError.
    """

    machine: Machine
    candidates: tuple[Candidate, ...]
    bound: float | None
    targets: tuple[Target, ...]
    held: Mapping[str, float] = MappingProxyType({})
    solution: Solution
    _audits: dict[str, Any]

    # ---- values ------------------------------------------------------------------------------------------------------

    @property
    @abstractmethod
    def cost(self) -> float:
        """Value of the cost function for the motion."""

    @property
    def gap(self) -> float | None:
        """Difference between the cost and its lower bound, relative to the cost; None if there is no bound."""
        if self.bound is None:
            return None
        return (self.cost - self.bound) / self.cost if self.cost > 0 else 0.0

    @property
    @abstractmethod
    def horizon(self) -> float:
        """Final time of the motion, s."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints, in the order of their values in the plan."""
        return tuple(self.machine.robot.joint_names)

    @property
    @abstractmethod
    def t(self) -> Array:
        """Times of the samples that the plan stores, s; a time of an abrupt change occurs twice. Shape (M,)."""

    @abstractmethod
    def _values(self, name: str) -> Array:
        """Return the values of "joints", "rates" or "base" at the times `t` of the plan. Shape (M, n)."""

    @abstractmethod
    def _values_at(self, name: str, times: Array) -> Array:
        """Return values of "joints", "rates", "accelerations" or "base" at checked times (M,). Shape (M, n)."""

    def __getitem__(self, name: str) -> Array:
        """Return joint positions ("joints"), joint rates ("rates") or base configurations ("base") at the times `t`."""
        if name not in self._names():
            raise require.unknown("name in a plan", name, self._names())
        return self._values(name)

    def at(self, time: Any) -> dict[str, Array]:
        """Return joint positions, joint rates and base configurations at one time or at times (M,), by name.

        The names are "joints", "rates" and, if the base moves, "base". Shapes (n,) for one time, (M, n) for several.

        Raises:
            ProblemError: A time is not finite or outside 0 to the horizon.
        """
        times = self._checked_times(time)
        values_by_name = {name: self._values_at(name, times.ravel()) for name in self._names()}
        return {name: values[0] if times.ndim == 0 else values for name, values in values_by_name.items()}

    def sample(self, period: float) -> PlanSample:
        """Return samples of the motion every `period` s from 0; the last sample is at the horizon.

        Rates may jump where the tasks do, such as where a path begins at full speed. Accelerations there are those
        after the jump.

        Raises:
            ProblemError: A period that is not positive, or too short.
        """
        return self.sampled(sample_times("sample: period", period, self.horizon))

    def sampled(self, times: Any) -> PlanSample:
        """Return samples of the motion at times (M,), s."""
        t = np.atleast_1d(self._checked_times(times))
        at = self.at(t)
        bases = at["base"] if "base" in at else np.zeros((len(t), 0))
        accelerations, tips = self._values_at("accelerations", t), self._tips_at(t, bases, at["joints"])
        return PlanSample(t, at["joints"], at["rates"], accelerations, tips)

    def task_share(self, times: Any) -> Array:
        """Return the fraction of the duration of the tasks that has passed at times (M,), s. Shape (M,).

        It equals the share of the horizon unless the pace of the tasks is planned, or the tasks wait.

        Raises:
            ProblemError: A time is not finite or outside 0 to the horizon.
        """
        return np.atleast_1d(self._checked_times(times)) / self.horizon

    @abstractmethod
    def solved_parts(self, times: Array) -> list[tuple[Solution, str, Array]]:
        """Return each solution in the plan with the suffix of its variable names and the given times that lie in it.

        The times (M,), s, are divided among the solutions: each gets an array (K,) on its own clock, and all K add up
        to M. The list is empty for a plan that solves no optimal control problem.
        """

    # ---- audit -------------------------------------------------------------------------------------------------------

    @interruptible
    def audit(self, **settings: Any) -> Audit:
        """Check the motion independently of its solver (`ocp.audit.audit.audit`); results are cached by settings."""
        key = audit_key(**settings)
        audit: Audit = self._audits.get(key) or self._audit(**settings)
        if all(finding.name != ENDS for finding in audit.findings):  # a planner's audit of the solution has no such row
            audit = self._with_rest_finding(audit)
        self._audits[key] = audit
        return audit

    @abstractmethod
    def _audit(self, **settings: Any) -> Audit:
        """Audit the motion without using the cache of earlier audits."""

    def _with_rest_finding(self, audit: Audit) -> Audit:
        """Return an audit with a further finding: how fast the joints move at the start and end of the motion."""
        ends = np.array([0.0, self.horizon])
        speeds = np.abs(self.at(ends)["rates"])
        speeds[speeds <= max(LIMIT_SHARE * np.abs(self._values("rates")).max(initial=0.0), CHECKS.still)] = 0.0
        end, joint = (int(k) for k in np.unravel_index(int(speeds.argmax()), speeds.shape))
        text = describe_ends(speeds, self.names, [self._unit(k) for k in range(len(self.names))])
        finding = Finding(ENDS, float(speeds[end, joint]), None, float(ends[end]), text or "at rest")
        remarks = [f"it {text}"] if text else []
        if audit.optimal is None and self.gap is not None:
            remarks.insert(0, f"its cost exceeds a lower bound by at most {100 * max(self.gap, 0.0):.2g} %")
        finding = replace(finding, unit=f"{self._unit(joint)}/s")
        return replace(audit, findings=(*audit.findings, finding), remarks=(*audit.remarks, *remarks))

    def _unit(self, joint: int) -> str:
        """Return the unit of a joint's position."""
        return self.machine.robot.moving_joints[joint].unit

    def margin(self, uncertainty: Mapping[str, Any] | None = None, tolerance: float | None = None) -> Any:
        """Return how far payload, friction and placements may differ from the model before the plan breaks a limit.

        The joints move as planned. Limits are those of torque and power, of the ground reaction of a standing machine,
        the clearances that the plan keeps, and the tolerance of the tip. See `ocp.motion.result.margin`.

        Args:
            uncertainty: By name, the size to cover at once with the others, or (0, size), or None for as much as
                possible; None: all that a limit of the plan depends on, as much as possible. The names are "payload"
                (kg, a point mass at the tip, besides what the robot carries), "friction" (Coulomb friction in any
                direction in all joints, as a share of their torque limits), "base position", "obstacle position" (of
                each obstacle) and "tool offset" (of the tip and of the shapes of the link that carries it), which are
                misplaced by up to a distance, m, in any direction. Pairs of bodies that the plan does not check, such
                as an immobile link and an obstacle, do not count.
            tolerance: Allowed deviation of the tip from its planned position, m; None: unlimited.

        Returns:
            The `ocp.motion.result.margin.Margin`, whose text states the largest sizes.

        Raises:
            ProblemError: An unknown name, a size that is not positive, or no limit of the plan depends on a named one.
        """
        return call_registered("margin_of_plan", self, uncertainty, tolerance)

    @property
    def audits(self) -> tuple[Audit, ...]:
        """Cached audits, in the order in which they were made."""
        return tuple(self._audits.values())

    @property
    def joint_bounds(self) -> JointBounds:
        """Limits of all joints during the plan: the tighter of the robot's limits and those stated to the planner."""
        return Limits().bounds(self.machine)

    def limit_findings(self) -> list[Finding]:
        """Return the audit findings about the joint position and the joint rate that exceed their limits most."""
        robot, t = self.machine.robot, np.union1d(self.t, np.linspace(0.0, self.horizon, CHECKED_TIMES))
        at, findings = self.at(t), list[Finding]()
        for name, values, lower, upper in (
            ("joints", at["joints"], robot.lower, robot.upper),
            ("rates", at["rates"], -robot.velocity, robot.velocity),
        ):
            excess = np.maximum(values - upper, lower - values)
            row, joint = np.unravel_index(int(np.argmax(excess)), excess.shape)
            size = max(abs(float(lower[joint])), abs(float(upper[joint])))
            unit = self._unit(int(joint)) + ("/s" if name == "rates" else "")
            label = f"{name} of the machine, {self.names[joint]!r}"
            value = max(float(excess[row, joint]), 0.0)
            limit = LIMIT_SHARE * (size if np.isfinite(size) else 1.0)
            findings.append(Finding(label, value, limit, float(t[row]), unit=unit))
        return findings

    def __repr__(self) -> str:
        return f"<Plan of {self.horizon:.6g} s: {len(self.names)} joints, {self._costs}, {self._counts}>"

    def __str__(self) -> str:
        """Return a text of at most 15 lines: cost, joints held at rest, and rejected motions with their reasons."""
        moving = len(self.names) - len(self.held)
        lines = [f"plan of {self.horizon:.6g} s for {moving} joints: {self._costs}; {self._counts}"]
        if self.held:
            held = [f"{name} at {position:.4g}" for name, position in self.held.items()]
            more = f" and {len(held) - MAX_LISTED} more" if len(held) > MAX_LISTED else ""
            lines.append(f"  held: {', '.join(held[:MAX_LISTED])}{more}")
        most, by_reason = MAX_LINES - 1 - len(lines), dict[str, list[Candidate]]()
        for candidate in self.candidates:
            by_reason.setdefault(str(candidate.reason or "the plan"), []).append(candidate)
        for reason, candidates in list(by_reason.items())[:most]:
            finite = [each for each in candidates if np.isfinite(each.cost)]
            low, high = (end((each.cost for each in finite), default=np.nan) for end in (min, max))
            if not finite or reason == Rejection.DUPLICATE.value:  # estimates say nothing about the same motion
                span = f"{'-':>10}"
            elif any(each.stage < Stage.FINE for each in finite):  # costs are estimates
                span = f"about {low:.3g}" + (f" to {high:.3g}" if low < high else "")
            else:
                span = f"{low:10.6g}" + (f" to {high:.6g}" if low < high else "")
            prefix = "" if len(candidates) == 1 else f"{len(candidates)} motions: "
            lines.append(f"  {span:<23}  {prefix}{reason}")
        if len(by_reason) > most:
            remaining = sum(len(each) for each in list(by_reason.values())[most:])
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
        """Plot position, velocity and acceleration of every joint over time with limits, by `view.plots.plot_plan`.

        The plan is blue; what it is compared with, another plan, a result of `resolve`, or several by name, is orange.
        A notebook shows the figure, `.savefig("plan.png")` writes it, and `figure=plt.figure()` draws into a window.

        Raises:
            ProblemError: `against` cannot be compared, or has other joints.
        """
        return call_registered("plot_plan", self, against, figure)

    def _repr_html_(self) -> str:
        return str(call_registered("html_of_plan", self))

    # ---- files -------------------------------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the plan to one `.npz` file atomically. It contains only data: reading it executes nothing.

        Raises:
            ProblemError, OSError: As in `Solution.save`; or a machine of an unknown kind.

        Warns:
            StorageWarning: A part of the request is not data, such as a Python callback. The file then holds the
                problem instead, or only the solution if that cannot be written either.
        """
        write_arrays(path, self.arrays(path))

    @abstractmethod
    def arrays(self, path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
        """Return the data of the plan as arrays by name, as `save` writes them to a file."""

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Plan:
        """Read a plan from a file that `save` has written; candidates other than the plan come without solutions.

        The problem is declared again from the request by the planner's own code, so that the audit checks the motion
        against the machine, limits, tasks and obstacles of the request. The bound and the other candidates are read as
        stored.

        Raises:
            FileNotFoundError, ProblemError: As in `Solution.load`; or the file holds no plan.
        """
        plan: Plan = call_registered("load_plan", path)
        return plan

    def trajectory(self, period: float) -> JointTrajectory:
        """Return the joint trajectory, sampled every `period` s."""
        sample = self.sample(period)
        return JointTrajectory(self.names, sample.t, sample.joints, sample.rates, sample.accelerations)

    def table(self, period: float = 0.01) -> dict[str, Array]:
        """Return the motion as a table of named columns, with a row every `period` s, for pandas, polars or pyarrow.

        The columns are `time` (s), the joints (rad or m), and `NAME.velocity` and `NAME.acceleration` of each. Each
        column has the shape (M,).
        """
        sample = self.sample(period)
        columns = {"time": sample.t}
        for end, values in (("", sample.joints), (".velocity", sample.rates), (".acceleration", sample.accelerations)):
            columns |= {f"{name}{end}": column for name, column in zip(self.names, values.T, strict=True)}
        return columns

    def write_csv(self, path: str | os.PathLike[str], period: float = 0.01) -> None:
        """Write the `table` of the motion, with a row every `period` s, to a CSV file in full precision."""
        rows = np.column_stack([*self.table(period).values()]).tolist()
        lines = (table_head(self.names), *(map(repr, row) for row in rows))
        write_text(path, "".join(f"{','.join(line)}\n" for line in lines))

    def to_ros(self, period: float = 0.01) -> dict[str, Any]:
        """Return the fields of trajectory_msgs/msg/JointTrajectory as a dictionary, sampled every `period` s."""
        return self.trajectory(period).to_ros()

    # ---- helpers -----------------------------------------------------------------------------------------------------

    def _names(self) -> tuple[str, ...]:
        return ("joints", "rates", *(("base",) if self.machine.base_size else ()))

    def _checked_times(self, time: Any) -> Array:
        return values_within(time, self.horizon, "time", f"s is outside the plan, 0 to {self.horizon:g} s")

    def _tips_at(self, times: Array, bases: Array, joints: Array) -> Array:
        """Return the poses of the machine's tip at checked times (M,). Shape (M, 7)."""
        return tip_poses(self.machine, bases, joints)


def evaluate_parts(begins: Sequence[float], times: Array, width: int, evaluate: Callable[[int, Rows], Array]) -> Array:
    """Evaluate a quantity of a multi-part motion at times (M,), each in the part that contains it. Shape (M, width).

    The parts begin at the increasing times `begins`, which belong to them. `evaluate` takes the number of a part and
    the indices (K,) of the times in it; it returns (K, width).
    """
    values, which = np.zeros((len(times), width)), segment_index([*begins, np.inf], times)
    for number in np.unique(which).tolist():
        rows = np.flatnonzero(which == number)
        values[rows] = evaluate(number, rows)
    return values


def record_arrays(kind: str, record: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Convert a record of JSON values and arrays to arrays of a plan file, whose names begin with the kind of plan."""
    head, numbers = pack_record(record)
    text = np.frombuffer(json.dumps(head).encode(), np.uint8)
    return {kind: text, **{f"{kind}.{name}": values for name, values in numbers.items()}}


def read_record(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray], kind: str) -> Any:
    """Return the record that `record_arrays` has written to a plan file as arrays whose names begin with `kind`."""
    return unpack_record(read_head(path, arrays[kind]), {name: arrays[f"{kind}.{name}"] for name in ARRAY_NAMES})


@contextmanager
def reading_plan(path: str | os.PathLike[str]) -> Iterator[None]:
    """Convert errors that damaged data of a plan file cause in a `with` block to a ProblemError that names the file."""
    try:
        yield
    except (*RECORD_ERRORS, ModelError) as error:
        name = getattr(error, "name", None) or "plan"
        raise ProblemError(f"{path}: the plan in it is damaged: {error}", name=str(name), value=str(path)) from error


def describe_ends(speeds: Array, names: Sequence[str], units: Sequence[str]) -> str:
    """Return a text about the fastest joints at the start and at the end of a motion, "" if all joints rest there.

    The speeds (2, n) at both ends are 0 at rest. The units are those of the joints' positions.
    """
    fastest = [(verb, row, int(row.argmax())) for verb, row in zip(("starts", "ends"), speeds, strict=True)]
    texts = [f"{verb} at {row[k]:.3g} {units[k]}/s ({names[k]!r})" for verb, row, k in fastest if row[k] > 0]
    return f"{' and '.join(texts)}, not at rest" if texts else ""


def audit_key(**settings: Any) -> str:
    """Return the key under which a plan caches its audit with the given settings."""
    return repr(sorted(settings.items()))
