"""Plan that consists of straight motions in joint space through tool poses."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from models import FixedBase
from models.checks import Array
from ocp.audit.audit import Audit, Finding, clearance_finding
from ocp.audit.clearance import Clearance
from ocp.errors import ProblemError
from ocp.motion.builders.clearance import ClearanceConstraints, clearance_of
from ocp.motion.result.candidate import Candidate
from ocp.motion.result.plan import Plan, read_record, reading_plan, record_arrays
from ocp.motion.result.request import restored_request, stored_request
from ocp.motion.search.lengths import Homogeneous, LargestMotion, PathLength
from ocp.motion.search.shortening import PathPoses, PathProblem, optimality_of
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.motion.tasks.speed_profile import segment_index
from ocp.motion.tasks.targets import Target, tip_poses
from ocp.solution import Solution
from ocp.tolerances import CLEARANCE_TOLERANCE_M, RESOLVED_SHARE

POSE_TOLERANCE = 1e-6  # largest pose error at a waypoint, m and rad
STEP_TOLERANCE = 1e-6  # largest excess over a joint limit or over the largest step between waypoints, rad or m
UNLIMITED_RATE = 1.0
"""Rate that is assumed for joints without velocity limits when a path is timed or compared, rad/s or m/s."""
SAVED = "cost that displacements would save"
"""Name of the finding about the first-order conditions: what small displacements would save, relative to the cost."""


@dataclass(frozen=True, eq=False, repr=False)
class PathPlan(Plan):
    """Plan that consists of straight motions in joint space through tool poses.

    A path has no times of its own. The plan passes it in the least time at constant joint rates between waypoints
    within the velocity limits; `ocp.joint_path` and `schedule` time it under further limits.

    Attributes:
        machine: The arm.
        joints: Joint positions at the waypoints. Shape (N, n), rad or m.
        limits: Limits of the joints.
        constraints: Collision scene; None without a collision check.
        poses: Poses of the tip at the waypoints, and largest displacements of the joints between them.
        step_cost: Cost of the steps between waypoints.
        candidates, bound: As in `Plan`; the bound is that of any path with at most as many segments.
        reconfigurations: Waypoints from which the arm moves to the next one in another configuration, by a motion that
            is not planned.
    """

    machine: FixedBase
    joints: Array
    limits: Limits
    constraints: ClearanceConstraints | None
    poses: PathPoses
    step_cost: Homogeneous
    candidates: tuple[Candidate, ...] = ()
    bound: float | None = None
    reconfigurations: tuple[int, ...] = ()
    _audits: dict[str, Any] = field(default_factory=dict, repr=False)

    # ---- values ------------------------------------------------------------------------------------------------------

    @cached_property
    def cost(self) -> float:
        """Cost of the path; reconfigurations do not count."""
        costs = self.step_cost.evaluate(np.diff(self.joints, axis=0), 1.0)
        return float(np.delete(costs, list(self.reconfigurations)).sum())

    @property
    def solution(self) -> Solution:  # type: ignore[override]
        """Solution of an optimal control problem; not available, since a path through waypoints solves none.

        Raises:
            ProblemError: Always.
        """
        words = "a path through waypoints solves no optimal control problem; its joints are plan.joints"
        raise ProblemError(words, name="solution")

    @property
    def targets(self) -> tuple[Target, ...]:  # type: ignore[override]
        """Tool poses that the path must reach at the waypoints, in world."""
        return (Target(self.t, self.poses.positions, self.poses.rotations),)

    @property
    def t(self) -> Array:
        """Times at which the plan passes the waypoints, s. Shape (N,)."""
        limits = self.limits.bounds(self.machine).velocity
        rates = np.where(np.isfinite(limits), limits, UNLIMITED_RATE)
        durations = (np.abs(np.diff(self.joints, axis=0)) / rates).max(axis=1, initial=0.0)
        least = max(float(durations.max(initial=0.0)), 1.0) * np.finfo(float).eps ** 0.5  # waypoints may be equal
        return np.concatenate([[0.0], np.cumsum(np.maximum(durations, least))])

    @property
    def joint_bounds(self) -> JointBounds:
        return super().joint_bounds.tightened(self.limits.bounds(self.machine))

    @property
    def horizon(self) -> float:
        """Duration of the path at the velocity limits, s."""
        return float(self.t[-1])

    @property
    def steps(self) -> Array:
        """Largest displacement of each joint between waypoints, without reconfigurations. Shape (n,), rad or m."""
        steps = np.delete(np.abs(np.diff(self.joints, axis=0)), list(self.reconfigurations), axis=0)
        return np.asarray(steps.max(axis=0, initial=0.0))

    def _values(self, name: str) -> Array:
        return self.joints if name == "joints" else self._values_at(name, self.t)

    def _values_at(self, name: str, times: Array) -> Array:
        t = self.t
        if name == "joints":
            return np.stack([np.interp(times, t, column) for column in self.joints.T], axis=1)
        if name == "rates":
            return np.asarray((np.diff(self.joints, axis=0) / np.diff(t)[:, None])[segment_index(t, times)])
        return np.zeros((len(times), self.machine.joint_size if name == "accelerations" else 0))

    def solved_parts(self, times: Array) -> list[tuple[Solution, str, Array]]:
        """Return an empty list, since the path solves no optimal control problem."""
        return []

    # ---- audit -------------------------------------------------------------------------------------------------------

    def clearance(self, pairs: Sequence[int] | None = None) -> Clearance | None:
        """Return the proven clearance between waypoints, except in reconfigurations; None if clearance is unchecked.

        `pairs` are the indices of the only pairs of bodies that count; all count if it is None.
        """
        if self.constraints is None:
            return None
        t, horizon = self.t, self.horizon
        breaks, rates = t / horizon, np.abs(np.diff(self.joints, axis=0)) / np.diff(t)[:, None]
        rates[list(self.reconfigurations)] = 0.0

        def joints_at(fractions: Array) -> Array:
            interval = segment_index(breaks, fractions)
            waiting = np.isin(interval, self.reconfigurations) & (fractions < 1.0)  # until the next waypoint
            ends = t[interval + np.where(waiting, 0, 1)]
            return self._values_at("joints", np.clip(fractions * horizon, t[interval], ends))

        bounds: dict[str, Any] = {"rates": rates, "seconds": np.zeros_like(rates), "smooth": False, "pairs": pairs}
        return clearance_of(self.constraints.scene, joints_at, breaks, horizon, **bounds)

    def _audit(self, **settings: Any) -> Audit:
        if settings:
            name = next(iter(settings))
            words = f"the audit of a path through waypoints has no setting {name!r}"
            raise ProblemError(words, name=name, value=settings[name])
        t, bounds = self.t, self.limits.bounds(self.machine)
        excess = np.maximum(self.joints - bounds.upper, bounds.lower - self.joints)
        findings = [_largest("joints beyond their limits", excess, STEP_TOLERANCE, t, self.names)]
        findings += self._pose_findings()
        clearance = self.clearance()
        findings += [] if clearance is None else [clearance_finding(clearance, CLEARANCE_TOLERANCE_M)]
        clearances = {} if clearance is None else {clearance.name: clearance}
        optimality, undecided = self._optimality()
        remarks = () if self.gap is None else (f"it may cost {self.gap:.2g} too much",)
        options: dict[str, Any] = {"clearances": clearances, "remarks": remarks}
        return Audit("path through waypoints", tuple(findings + optimality), undecided, **options)

    def _optimality(self) -> tuple[list[Finding], str]:
        """Return the finding on first-order optimality, and the reason why a local minimum is undetermined, or ""."""
        scene = None if self.constraints is None else self.constraints.scene
        options: dict[str, Any] = {"bounds": self.limits.bounds(self.machine), "idle": self.joints[0], "scene": scene}
        problem = PathProblem.through_poses(self.machine, self.poses, self.step_cost, **options)
        firsts, lasts = [0, *(k + 1 for k in self.reconfigurations)], [*self.reconfigurations, len(self.joints) - 1]
        parts = [
            optimality_of(self.joints[first : last + 1], problem.restrict(first, last))
            for first, last in zip(firsts, lasts, strict=True)
        ]
        saved = sum(part[0] for part in parts) / max(self.cost, np.finfo(float).tiny)
        undecided = "its cost may decrease to second order" if any(part[1] for part in parts) else ""
        return [Finding(SAVED, saved, RESOLVED_SHARE, verdict="optimal", note="relative, to first order")], undecided

    @property
    def _counts(self) -> str:
        return f"the best of {len(self.candidates)} paths"

    def _pose_findings(self) -> list[Finding]:
        """Return the audit findings about the largest pose errors and the joint step that exceeds its limit most."""
        t, poses, tips = self.t, self.poses, tip_poses(self.machine, np.zeros((len(self.joints), 0)), self.joints)
        misses = np.abs(tips[:, :3] - poses.positions)
        rotations = scipy.spatial.transform.Rotation.from_quat(tips[:, [4, 5, 6, 3]])
        turns = rotations.inv() * scipy.spatial.transform.Rotation.from_matrix(poses.rotations)
        steps = np.abs(np.diff(self.joints, axis=0)) - poses.step
        steps[list(self.reconfigurations)] = 0.0
        return [
            _largest("positions of the tip", misses, POSE_TOLERANCE, t, unit="m"),
            _largest("orientations of the tip", turns.magnitude()[:, None], POSE_TOLERANCE, t, unit="rad"),
            _largest("steps beyond the largest", steps, STEP_TOLERANCE, t, self.names),
        ]

    def __str__(self) -> str:
        lines = super().__str__().split("\n")
        if self.reconfigurations:
            places = ", ".join(map(str, self.reconfigurations))
            count = f"{len(self.reconfigurations)} time{'s' if len(self.reconfigurations) > 1 else ''}"
            lines.insert(1, f"  the arm reconfigures {count}, after waypoint {places}")
        return "\n".join(lines)

    # ---- files -------------------------------------------------------------------------------------------------------

    def arrays(self, path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
        """Return the arrays that are written to the file of the plan, by name."""
        arguments = {"machine": self.machine, "limits": self.limits, "constraints": self.constraints}
        record = {
            "request": stored_request("", arguments),
            "bound": self.bound,
            "reconfigurations": list(self.reconfigurations),
            "candidates": [candidate.record() for candidate in self.candidates],
            "joints": self.joints,
            "poses": self.poses._asdict(),
            "weights": self.step_cost.weights,
            "timed": isinstance(self.step_cost, LargestMotion),
        }
        return record_arrays("path", record)

    @classmethod
    def of_arrays(cls, path: str | os.PathLike[str], arrays: dict[str, np.ndarray]) -> PathPlan:
        """Build the plan from the arrays of a file, which are checked because files are not trusted."""
        with reading_plan(path):
            head = read_record(path, arrays, "path")
            arguments = restored_request(head["request"]).arguments
            machine, limits, constraints = (arguments[name] for name in ("machine", "limits", "constraints"))
            if not isinstance(limits, Limits) or not isinstance(machine, FixedBase):
                raise TypeError(f"its machine is a {type(machine).__name__}, its limits a {type(limits).__name__}")
            values = _checked_values(head, machine.joint_size)
            joints, weights = values.pop("joints"), values.pop("weights")
            if constraints is not None and not isinstance(constraints, ClearanceConstraints):
                raise TypeError(f"its collision scene is a {type(constraints).__name__}")
            if constraints is not None and constraints.scene.has_moving_obstacles:
                raise ValueError("its obstacles move, though a path has no times")
            breaks = tuple(int(number) for number in head["reconfigurations"])
            if not all(0 <= number < len(joints) - 1 for number in breaks):
                raise ValueError(f"it reconfigures at waypoints that it has not: {breaks}")
            kind = LargestMotion if head["timed"] is True else PathLength
            candidates = tuple(Candidate.of_record(record, None) for record in head["candidates"])
            return cls(
                machine=machine,
                joints=joints,
                limits=limits,
                constraints=constraints,
                poses=PathPoses(**values),
                step_cost=kind(weights),
                candidates=candidates,
                bound=None if head["bound"] is None else float(head["bound"]),
                reconfigurations=breaks,
            )


def _checked_values(head: Mapping[str, Any], size: int) -> dict[str, Array]:
    """Return joints, weights and poses from a file; raise ValueError if their shapes do not fit the machine."""
    count, written = len(head["joints"]), {"joints": head["joints"], "weights": head["weights"], **head["poses"]}
    shapes = {"joints": (count, size), "weights": (size,)}
    shapes |= {"positions": (count, 3), "rotations": (count, 3, 3), "step": (size,)}
    values = {name: np.asarray(written[name], dtype=float) for name in shapes}
    wrong = [name for name, shape in shapes.items() if values[name].shape != shape]
    finite = all(np.isfinite(values[name]).all() for name in values if name != "step")
    if wrong or count < 2 or not finite:
        raise ValueError(f"its {', '.join(wrong) or 'values'} do not fit its machine")
    return values


def _largest(
    name: str, values: Array, limit: float, times: Array, names: tuple[str, ...] = (), unit: str = ""
) -> Finding:
    """Return the audit finding about the largest of the values, whose first axis is time; 0 if all are negative."""
    if not values.size:
        return Finding(name, 0.0, limit, unit=unit)
    row, column = np.unravel_index(int(np.argmax(values)), values.shape)
    label = f"{name}, {names[column]!r}" if names else name
    return Finding(label, max(float(values[row, column]), 0.0), limit, float(times[row]), f"waypoint {row}", unit=unit)
