"""Several plans one after the other, with motions to another configuration between them, as one plan."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from models import FixedBase
from models.checks import Array
from ocp.audit.audit import COST_LOST, Audit, Finding
from ocp.audit.clearance import Clearance
from ocp.errors import ProblemError
from ocp.motion.result.candidate import Candidate
from ocp.motion.result.plan import Plan
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.motion.tasks.targets import Target
from ocp.problem.record_reader import ARRAY_NAMES, RECORD_ERRORS, unpack_record
from ocp.problem.record_writer import pack_record
from ocp.solution import Solution, read_head

__all__ = ["Piece", "Reconfiguration", "SegmentedPlan"]

NO_MOTION = "reconfigurations without a motion"
JUMP_TOLERANCE = 1e-6
"""Largest difference of a joint between the end of a motion and the start of the next one, rad or m."""


@dataclass(frozen=True, eq=False)
class Reconfiguration:
    """Motion between two segments, to the same place of the tasks in another configuration.

    Attributes:
        time: Time of the tasks, which wait, s.
        before, after: Joints, rad or m. Shape (n,).
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
    """Plan that begins at a time of the whole, s."""

    begin: float
    plan: SolvedPlan


@dataclass(frozen=True, eq=False, repr=False)
class SegmentedPlan(Plan):
    """Motions that do the tasks one after the other, and reconfigurations between them while the tasks wait.

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
    _audits: dict[str, Any] = field(default_factory=dict, repr=False)

    # ---- values ------------------------------------------------------------------------------------------------------

    @property
    def cost(self) -> float:
        """Cost of all segments, without reconfigurations."""
        return float(sum(segment.cost for segment in self.segments))

    @property
    def bound(self) -> float | None:  # type: ignore[override]
        """Lower bound of the cost in the same segments; None if that of a segment is not known."""
        bounds = [segment.bound for segment in self.segments]
        return None if None in bounds else float(sum(bounds))  # type: ignore[arg-type]

    @property
    def held(self) -> Mapping[str, float]:  # type: ignore[override]
        """Joints that stand still in all segments."""
        return self.segments[0].held

    @property
    def candidates(self) -> tuple[Candidate, ...]:  # type: ignore[override]
        """Candidates of all segments."""
        return tuple(candidate for segment in self.segments for candidate in segment.candidates)

    @property
    def targets(self) -> tuple[Target, ...]:  # type: ignore[override]
        """Targets of all segments."""
        return tuple(
            target._replace(t=target.t + piece.begin) for piece in self.pieces for target in piece.plan.targets
        )

    @property
    def solution(self) -> Solution:  # type: ignore[override]
        """The solution, if there is one segment.

        Raises:
            ProblemError: There are several.
        """
        if len(self.segments) == 1:
            return self.segments[0].solution
        words = f"the plan has {len(self.segments)} segments, each with a solution: plan.segments[0].solution"
        raise ProblemError(words, name="solution", value=len(self.segments), limit=1)

    @property
    def task_horizon(self) -> float:
        """Duration of the tasks, without reconfigurations, s."""
        return self.start_times[-1] + self.segments[-1].horizon

    @property
    def pieces(self) -> tuple[Piece, ...]:
        """Segments and motions between them, in order, with the times at which they begin."""
        plans: list[SolvedPlan] = [self.segments[0]]
        for reconfiguration, segment in zip(self.reconfigurations, self.segments[1:], strict=True):
            plans += [*((reconfiguration.motion,) if reconfiguration.motion is not None else ()), segment]
        begins = np.concatenate([[0.0], np.cumsum([plan.horizon for plan in plans])])
        return tuple(Piece(float(begin), plan) for begin, plan in zip(begins, plans, strict=False))

    @property
    def horizon(self) -> float:
        """Duration of segments and reconfigurations, s."""
        last = self.pieces[-1]
        return last.begin + last.plan.horizon

    @property
    def t(self) -> Array:
        """Times of the grids of all pieces, with both copies of the times between them. Shape (M,), s."""
        return np.concatenate([piece.begin + piece.plan.t for piece in self.pieces])

    def _values(self, name: str) -> Array:
        return np.concatenate([piece.plan[name] for piece in self.pieces])

    def _values_at(self, name: str, times: Array) -> Array:
        pieces = self.pieces
        which = np.searchsorted([piece.begin for piece in pieces], times, side="right") - 1
        values = np.zeros((len(times), self.machine.joint_size if name != "base" else self.machine.base_size))
        for number in np.unique(which):
            piece, rows = pieces[number], which == number
            local = np.clip(times[rows] - piece.begin, 0.0, piece.plan.horizon)
            values[rows] = piece.plan._values_at(name, local)
        return values

    def task_share(self, times: Any) -> Array:
        """Return the share of the tasks' own time that has passed; they wait during reconfigurations."""
        pieces = self.pieces
        waits = [piece.plan.horizon * all(piece.plan is not segment for segment in self.segments) for piece in pieces]
        ends, lost = [piece.begin + piece.plan.horizon for piece in pieces], np.cumsum(waits)
        t = np.atleast_1d(self._checked_times(times))
        task_times = np.interp(t, [0.0, *ends], [0.0, *(np.array(ends) - lost)])
        return np.asarray(np.minimum(task_times / self.task_horizon, 1.0))

    def solved_parts(self, times: Array) -> list[tuple[Solution, str, Array]]:
        """Return the parts of all pieces; see `Plan.solved_parts`."""
        pieces = self.pieces
        which = np.searchsorted([piece.begin for piece in pieces], times, side="right") - 1
        parts: list[tuple[Solution, str, Array]] = []
        for number, piece in enumerate(pieces):
            local = np.clip(times[which == number] - piece.begin, 0.0, piece.plan.horizon)
            parts += piece.plan.solved_parts(local)
        return parts

    # ---- audit -------------------------------------------------------------------------------------------------------

    def _audit(self, **settings: Any) -> Audit:
        """Return the findings of the audits of all pieces, of the joints between them, and of the cost lost."""
        findings: list[Finding] = []
        undecided, clearances, losses = "", dict[str, Clearance](), list[float]()
        for number, piece in enumerate(self.pieces, 1):
            audit, label = piece.plan.audit(**settings), f"motion {number}: "
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
        missing = [each for each in self.reconfigurations if each.motion is None]
        if self.reconfigurations:
            note = missing[0].failure if missing else ""
            findings += [Finding(NO_MOTION, float(len(missing)), 0.0, None, note), self._jump_finding()]
        if len(losses) == len(self.pieces):
            total = sum(piece.plan.cost for piece in self.pieces)
            findings.append(Finding(COST_LOST, sum(losses) / total if total > 0 else 0.0, verdict="optimal"))
        return Audit("segments", tuple(findings), undecided, clearances=clearances)

    def _jump_finding(self) -> Finding:
        """Return the largest difference of the joints where one motion ends and the next one begins."""
        pieces = self.pieces
        jumps = [
            np.abs(after.plan.at(0.0)["joints"] - before.plan.at(before.plan.horizon)["joints"])
            for before, after in pairwise(pieces)
        ]
        row, joint = np.unravel_index(int(np.argmax(jumps)), np.shape(jumps))
        label = f"joints between motions, {self.names[joint]!r}"
        return Finding(label, float(jumps[row][joint]), JUMP_TOLERANCE, pieces[row + 1].begin)

    def __str__(self) -> str:
        count = len(self.reconfigurations)
        counted = f"{count} reconfiguration{'' if count == 1 else 's'}"
        fewest = "the fewest possible" if self.fewest == count else f"at least {self.fewest} needed"
        lines = [f"plan of {self.horizon:.6g} s for {', '.join(self.names)}: {counted}, {fewest}; cost {self.cost:.6g}"]
        for k, segment in enumerate(self.segments):
            end = self.start_times[k] + segment.horizon
            bound = "" if segment.bound is None else f", lower bound {segment.bound:.6g}"
            lines.append(f"  {self.start_times[k]:.4g} to {end:.4g} s: cost {segment.cost:.6g}{bound}")
            if k < count:
                lines.append(f"  {self.reconfigurations[k]}")
        return "\n".join(lines)

    # ---- files -------------------------------------------------------------------------------------------------------

    def arrays(self, path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
        """Return the arrays of the file of the plan; those of each motion are named after it."""
        head, numbers = pack_record(
            {
                "start_times": list(self.start_times),
                "reconfigurations": [
                    [each.time, each.before, each.after, each.motion is not None, each.failure]
                    for each in self.reconfigurations
                ],
                "fewest": self.fewest,
            }
        )
        arrays = {"segments": np.frombuffer(json.dumps(head).encode(), np.uint8)}
        arrays |= {f"segments.{name}": values for name, values in numbers.items()}
        motions = [each.motion for each in self.reconfigurations]
        for kind, plans in (("segment", self.segments), ("reconfiguration", motions)):
            for number, plan in enumerate(plans):
                if plan is not None:
                    arrays |= {f"{kind} {number}/{name}": array for name, array in plan.arrays(path).items()}
        return arrays

    @classmethod
    def of_arrays(cls, path: str | os.PathLike[str], arrays: dict[str, np.ndarray]) -> SegmentedPlan:
        """Return the plan of the arrays of a file, which are not trusted; raise as `Plan.load`."""

        def plan_of(kind: str, number: int) -> SolvedPlan:
            prefix = f"{kind} {number}/"
            own = {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
            return SolvedPlan.of_arrays(path, own)

        try:
            numbers = {name: arrays[f"segments.{name}"] for name in ARRAY_NAMES}
            head = unpack_record(read_head(path, arrays["segments"]), numbers)
            times = tuple(float(time) for time in head["start_times"])
            segments = tuple(plan_of("segment", number) for number in range(len(times)))
            changes = tuple(
                Reconfiguration(
                    *(float(time), np.asarray(before, dtype=float), np.asarray(after, dtype=float)),
                    *(plan_of("reconfiguration", number) if has_motion else None, str(failure)),
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
        except RECORD_ERRORS as error:
            words = f"{path}: the plan in it is damaged: {error}"
            raise ProblemError(words, name="path", value=str(path)) from error
