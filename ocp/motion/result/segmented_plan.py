"""Plans that consist of consecutive plans: goals and tasks in sequence, or segments with reconfigurations."""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np

from models import FixedBase, Machine
from models.checks import Array
from ocp.audit.audit import COST_LOST, Audit, Finding
from ocp.audit.clearance import Clearance
from ocp.errors import ProblemError
from ocp.motion.result.candidate import Candidate
from ocp.motion.result.plan import Plan, Rows, evaluate_parts, read_record, reading_plan, record_arrays
from ocp.motion.result.solved_plan import PHASED, PhasedPlan, SolvedPlan
from ocp.motion.tasks.limits import JointBounds
from ocp.motion.tasks.speed_profile import segment_index
from ocp.motion.tasks.targets import Target
from ocp.solution import Solution

NO_MOTION = "reconfigurations without a motion"
JUMP_TOLERANCE = 1e-6
"""Largest difference of a joint position between the end of a motion and the start of the next motion, rad or m."""


@dataclass(frozen=True, eq=False)
class Reconfiguration:
    """Motion between two segments to another configuration at the same tool pose.

    Attributes:
        time: Time of the tasks, which wait, s.
        before, after: Configurations, rad or m. Shape (n,).
        motion: Collision-free motion within the rate limits; unlike in a plan, its joints do not start at rest. None if
            none was found, which does not prove that there is none.
        failure: Why there is no motion; "" otherwise.
    """

    time: float
    before: Array
    after: Array
    motion: SolvedPlan | None
    failure: str = ""

    @property
    def duration(self) -> float:
        """Duration of the motion, s; nan without a motion."""
        return np.nan if self.motion is None else self.motion.horizon

    def __str__(self) -> str:
        largest = np.abs(self.after - self.before).max()
        how = f"no collision-free motion was found: {self.failure}"
        if self.motion is not None:
            how = f"in {self.duration:.4g} s"
        return f"at {self.time:.4g} s the arm reconfigures, a joint by up to {largest:.3g}: {how}"


class Piece(NamedTuple):
    """One of several consecutive plans, with its start time (s) and the name of its motion."""

    begin: float
    plan: SolvedPlan
    name: str


class ConsecutivePlans(Plan):
    """Plan that consists of consecutive plans, each of which starts where the previous one ends.

    Attributes:
        machine, candidates, bound, targets: As in `Plan`.
        kind: Name of this kind of plan in files and in its audit.
    """

    kind: ClassVar[str]

    @property
    @abstractmethod
    def pieces(self) -> tuple[Piece, ...]:
        """The consecutive plans, with the times at which they begin."""

    @property
    def _plans(self) -> tuple[SolvedPlan, ...]:
        """Plans of all pieces, in order of time."""
        return tuple(piece.plan for piece in self.pieces)

    # ---- values ------------------------------------------------------------------------------------------------------

    @property
    def joint_bounds(self) -> JointBounds:
        lower, *upper = zip(*(piece.plan.joint_bounds for piece in self.pieces), strict=True)
        return JointBounds(np.min(lower, axis=0), *(np.max(limit, axis=0) for limit in upper))

    @property
    def cost(self) -> float:
        """Total cost of the consecutive plans, without the reconfigurations between them."""
        return float(sum(plan.cost for plan in self._plans))

    @property
    def bound(self) -> float | None:  # type: ignore[override]
        """Sum of the lower bounds of the consecutive plans' costs, each with its ends fixed; None if one is unknown."""
        bounds = [plan.bound for plan in self._plans]
        return None if None in bounds else float(sum(bounds))  # type: ignore[arg-type]

    @property
    def candidates(self) -> tuple[Candidate, ...]:  # type: ignore[override]
        """Candidates of all consecutive plans."""
        return tuple(candidate for plan in self._plans for candidate in plan.candidates)

    @property
    def targets(self) -> tuple[Target, ...]:  # type: ignore[override]
        """Target poses of the tasks of all consecutive plans, in world."""
        return tuple(each._replace(t=each.t + piece.begin) for piece in self.pieces for each in piece.plan.targets)

    @property
    def solution(self) -> Solution:  # type: ignore[override]
        """Solution of the optimal control problem of the plan, if it consists of a single motion.

        Raises:
            ProblemError: There are several motions.
        """
        if len(self.pieces) == 1:
            return self.pieces[0].plan.solution
        words = f"the plan has {len(self.pieces)} parts, each with a solution: plan.pieces[0].plan.solution"
        raise ProblemError(words, name="solution", value=len(self.pieces), limit=1)

    @property
    def horizon(self) -> float:
        """Total duration of the consecutive plans, s."""
        last = self.pieces[-1]
        return last.begin + last.plan.horizon

    @property
    def t(self) -> Array:
        """Times of the grids of the consecutive plans, s; the time at a junction occurs twice. Shape (M,)."""
        return np.concatenate([piece.begin + piece.plan.t for piece in self.pieces])

    def _values(self, name: str) -> Array:
        return np.concatenate([piece.plan[name] for piece in self.pieces])

    def _values_at(self, name: str, times: Array) -> Array:
        pieces = self.pieces

        def values(number: int, rows: Rows) -> Array:
            local = np.clip(times[rows] - pieces[number].begin, 0.0, pieces[number].plan.horizon)
            return pieces[number].plan._values_at(name, local)

        size = self.machine.base_size if name == "base" else self.machine.joint_size
        return evaluate_parts([piece.begin for piece in pieces], times, size, values)

    def solved_parts(self, times: Array) -> list[tuple[Solution, str, Array]]:
        """Return each solution with the suffix of its variable names and the given times that lie in it."""
        pieces = self.pieces
        which = segment_index([*(piece.begin for piece in pieces), np.inf], times)
        parts: list[tuple[Solution, str, Array]] = []
        for number, piece in enumerate(pieces):
            local = np.clip(times[which == number] - piece.begin, 0.0, piece.plan.horizon)
            parts += piece.plan.solved_parts(local)
        return parts

    # ---- audit -------------------------------------------------------------------------------------------------------

    def _audit(self, **settings: Any) -> Audit:
        """Audit all consecutive plans and the junctions between them, and combine the suboptimality of the plans."""
        findings: list[Finding] = []
        undecided, clearances, losses = "", dict[str, Clearance](), list[float]()
        for piece in self.pieces:
            audit, label = piece.plan.audit(**settings), f"{piece.name}: "
            findings += [
                replace(
                    finding,
                    name=label + finding.name,
                    time=None if finding.time is None else finding.time + piece.begin,
                )
                for finding in audit.findings
            ]
            clearances |= {label + name: clearance for name, clearance in audit.clearances.items()}
            undecided = undecided or (audit.undecided and label + audit.undecided)
            losses += [finding.value * piece.plan.cost for finding in audit.findings if finding.name == COST_LOST]
        findings += self._junction_findings()
        if len(losses) == len(self.pieces):
            total = sum(piece.plan.cost for piece in self.pieces)
            findings.append(Finding(COST_LOST, sum(losses) / total if total > 0 else 0.0, verdict="optimal"))
        return Audit(self.kind, tuple(findings), undecided, clearances=clearances)

    def _junction_findings(self) -> list[Finding]:
        """Return the audit findings about jumps of joint and base positions between consecutive motions."""
        names = ("joints", *(("base",) if self.machine.base_size else ()))
        return [self._jump_finding(name) for name in names] if len(self.pieces) > 1 else []

    def _jump_finding(self, name: str) -> Finding:
        """Return the audit finding about the largest jump of "joints", "rates" or "base" between two motions."""
        jumps = [
            np.abs(after.plan.at(0.0)[name] - before.plan.at(before.plan.horizon)[name])
            for before, after in pairwise(self.pieces)
        ]
        row, column = np.unravel_index(int(np.argmax(jumps)), np.shape(jumps))
        label = f"{name} between motions" + ("" if name == "base" else f", {self.names[column]!r}")
        return Finding(label, float(jumps[row][column]), JUMP_TOLERANCE, self.pieces[row + 1].begin)


@dataclass(frozen=True, eq=False, repr=False)
class SequencePlan(ConsecutivePlans):
    """Motions to goals and along tasks in sequence, including the motions that approach the tasks.

    Attributes:
        machine: Machine of the first motion; all motions have its joints.
        parts: Audited plans in order; the time of each starts at 0.
        phases: Names of the plans.
        smooth: Whether the rates are continuous, since actuators are limited.
    """

    machine: Machine
    parts: tuple[SolvedPlan, ...]
    phases: tuple[str, ...]
    smooth: bool
    kind: ClassVar[str] = "sequence"
    _audits: dict[str, Any] = field(default_factory=dict, repr=False)

    @cached_property
    def pieces(self) -> tuple[Piece, ...]:
        """The motions of the sequence, with the times at which they begin."""
        begins = np.cumsum([0.0, *(plan.horizon for plan in self.parts[:-1])]).tolist()
        return tuple(map(Piece, begins, self.parts, self.phases))

    def _tips_at(self, times: Array, bases: Array, joints: Array) -> Array:
        pieces = self.pieces

        def tips(number: int, rows: Rows) -> Array:
            return pieces[number].plan._tips_at(times[rows] - pieces[number].begin, bases[rows], joints[rows])

        return evaluate_parts([piece.begin for piece in pieces], times, 7, tips)

    def _junction_findings(self) -> list[Finding]:
        """Return the audit findings about jumps of joints, base and, if they must be continuous, rates at junctions."""
        rates = [self._jump_finding("rates")] if self.smooth and len(self.parts) > 1 else []
        return super()._junction_findings() + rates

    def __str__(self) -> str:
        lines = [f"plan of {self.horizon:.6g} s for {len(self.names)} joints: {len(self.parts)} motions, {self._costs}"]
        for piece in self.pieces:
            end = piece.begin + piece.plan.horizon
            lines.append(f"  {piece.begin:.4g} to {end:.4g} s, {piece.name}: {piece.plan._costs}")
        return "\n".join(lines)

    # ---- files -------------------------------------------------------------------------------------------------------

    def arrays(self, path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
        """Return the arrays of the plan's file by name; a prefix of the name identifies the motion of an array."""
        arrays = record_arrays(self.kind, {"phases": list(self.phases), "smooth": self.smooth})
        for number, plan in enumerate(self.parts):
            arrays |= {f"part {number}/{name}": array for name, array in plan.arrays(path).items()}
        return arrays

    @classmethod
    def of_arrays(cls, path: str | os.PathLike[str], arrays: dict[str, np.ndarray]) -> SequencePlan:
        """Build the plan from the arrays of a file, which are checked because files are not trusted."""
        with reading_plan(path):
            head = read_record(path, arrays, cls.kind)
            phases = tuple(str(name) for name in head["phases"])
            parts = tuple(solved_plan_of(path, arrays, f"part {number}/") for number in range(len(phases)))
            machine, smooth = parts[0].machine, head["smooth"]
            if not all(plan.names == parts[0].names for plan in parts) or not isinstance(smooth, bool):
                raise ValueError("its motions do not fit together")
            return cls(machine, parts, phases, smooth)


def solved_plan_of(path: str | os.PathLike[str], arrays: dict[str, np.ndarray], prefix: str = "") -> SolvedPlan:
    """Build one of the plans in a file from the arrays whose names begin with a prefix."""
    own = {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
    return (PhasedPlan if PHASED in own else SolvedPlan).of_arrays(path, own)


@dataclass(frozen=True, eq=False, repr=False)
class SegmentedPlan(ConsecutivePlans):
    """Motions along consecutive segments of tasks; the arm reconfigures between segments while the tasks pause.

    Attributes:
        machine: The arm.
        segments: Audited plans of parts of the tasks; the time of each starts at 0.
        start_times: Time of the tasks at which each segment starts, s; each ends where the next one starts.
        reconfigurations: Motions between segments.
        fewest: Lower bound of the number of reconfigurations, under the assumptions of `ocp.motion.search.search`.
    """

    machine: FixedBase
    segments: tuple[SolvedPlan, ...]
    start_times: tuple[float, ...]
    reconfigurations: tuple[Reconfiguration, ...]
    fewest: int
    kind: ClassVar[str] = "segments"
    _audits: dict[str, Any] = field(default_factory=dict, repr=False)

    # ---- values ------------------------------------------------------------------------------------------------------

    @property
    def _plans(self) -> tuple[SolvedPlan, ...]:
        return self.segments  # reconfigurations cost nothing

    @property
    def held(self) -> Mapping[str, float]:  # type: ignore[override]
        """Positions of the joints that stay at rest in all segments, rad or m, by name."""
        return self.segments[0].held

    @property
    def task_horizon(self) -> float:
        """Duration of the tasks, without reconfigurations, s."""
        return self.start_times[-1] + self.segments[-1].horizon

    @property
    def pieces(self) -> tuple[Piece, ...]:
        """Segments and reconfigurations in order, with the times at which they begin."""
        plans: list[SolvedPlan] = [self.segments[0]]
        for reconfiguration, segment in zip(self.reconfigurations, self.segments[1:], strict=True):
            plans += [*((reconfiguration.motion,) if reconfiguration.motion is not None else ()), segment]
        begins = np.cumsum([0.0, *(plan.horizon for plan in plans[:-1])]).tolist()
        names = [f"motion {number}" for number in range(1, len(plans) + 1)]
        return tuple(map(Piece, begins, plans, names))

    def task_share(self, times: Any) -> Array:
        """Return the fraction of the duration of the tasks that has passed; reconfigurations do not count."""
        pieces = self.pieces
        waits = [piece.plan.horizon * all(piece.plan is not segment for segment in self.segments) for piece in pieces]
        ends, lost = [piece.begin + piece.plan.horizon for piece in pieces], np.cumsum(waits)
        t = np.atleast_1d(self._checked_times(times))
        task_times = np.interp(t, [0.0, *ends], [0.0, *(np.array(ends) - lost)])
        return np.asarray(np.minimum(task_times / self.task_horizon, 1.0))

    def _junction_findings(self) -> list[Finding]:
        """Return the audit findings about reconfigurations for which no motion was found, and about jumps of joints."""
        if not self.reconfigurations:
            return []
        missing = [each for each in self.reconfigurations if each.motion is None]
        note = missing[0].failure if missing else ""
        return [Finding(NO_MOTION, float(len(missing)), 0.0, None, note), *super()._junction_findings()]

    def __str__(self) -> str:
        count = len(self.reconfigurations)
        counted = f"{count} reconfiguration{'' if count == 1 else 's'}"
        fewest = "the fewest possible" if self.fewest == count else f"at least {self.fewest} needed"
        joints = len(self.names)
        lines = [f"plan of {self.horizon:.6g} s for {joints} joints: {counted}, {fewest}; cost {self.cost:.6g}"]
        for k, segment in enumerate(self.segments):
            end = self.start_times[k] + segment.horizon
            bound = "" if segment.bound is None else f", lower bound {segment.bound:.6g}"
            lines.append(f"  {self.start_times[k]:.4g} to {end:.4g} s: cost {segment.cost:.6g}{bound}")
            if k < count:
                lines.append(f"  {self.reconfigurations[k]}")
        return "\n".join(lines)

    # ---- files -------------------------------------------------------------------------------------------------------

    def arrays(self, path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
        """Return the arrays of the plan's file by name; a prefix of the name identifies the motion of an array."""
        record = {
            "start_times": list(self.start_times),
            "reconfigurations": [
                [each.time, each.before, each.after, each.motion is not None, each.failure]
                for each in self.reconfigurations
            ],
            "fewest": self.fewest,
        }
        arrays = record_arrays(self.kind, record)
        motions = [each.motion for each in self.reconfigurations]
        for kind, plans in (("segment", self.segments), ("reconfiguration", motions)):
            for number, plan in enumerate(plans):
                if plan is not None:
                    arrays |= {f"{kind} {number}/{name}": array for name, array in plan.arrays(path).items()}
        return arrays

    @classmethod
    def of_arrays(cls, path: str | os.PathLike[str], arrays: dict[str, np.ndarray]) -> SegmentedPlan:
        """Build the plan from the arrays of a file, which are checked because files are not trusted."""
        with reading_plan(path):
            head = read_record(path, arrays, cls.kind)
            times = tuple(float(time) for time in head["start_times"])
            segments = tuple(solved_plan_of(path, arrays, f"segment {number}/") for number in range(len(times)))
            changes = tuple(
                Reconfiguration(
                    *(float(time), np.asarray(before, dtype=float), np.asarray(after, dtype=float)),
                    *(solved_plan_of(path, arrays, f"reconfiguration {number}/") if has_motion else None, str(failure)),
                )
                for number, (time, before, after, has_motion, failure) in enumerate(head["reconfigurations"])
            )
            machine, n = segments[0].machine, segments[0].machine.joint_size
            plans = [*segments, *(each.motion for each in changes if each.motion is not None)]
            ends = np.cumsum([segment.horizon for segment in segments])
            if not isinstance(machine, FixedBase):
                raise TypeError(f"its machine is a {type(machine).__name__}")
            fits = len(times) == len(segments) == len(changes) + 1
            fits = fits and all(plan.machine.robot.joint_names == machine.robot.joint_names for plan in plans)
            fits = fits and all(each.before.shape == each.after.shape == (n,) for each in changes)
            fits = fits and np.allclose(times, [0.0, *ends[:-1]]) and times[1:] == tuple(each.time for each in changes)
            if not fits:
                raise ValueError("its segments do not fit together")
            return cls(machine, segments, times, changes, int(head["fewest"]))
