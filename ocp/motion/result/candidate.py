"""Candidate motions of a plan: how far each motion is solved, the cost, and the reason for a rejection.

A motion that misses its tasks does so because of a limit or because it passes near a singular configuration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import Enum, IntEnum
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.checks import ROUNDING, Array
from ocp.audit.audit import Audit
from ocp.console import TimeLimitReached
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.tool_motion import Stretch
from ocp.motion.local.inverse_kinematics import describe_miss
from ocp.motion.local.rates import LocalMotion
from ocp.motion.search.configurations import PlanRequest
from ocp.solution import Solution


class Stage(IntEnum):
    """Stage of the solution process that a candidate has reached."""

    SEED = 0  # guess, mostly a local motion
    COARSE = 1  # solved on the coarse mesh
    SEPARATED = 2  # solved on the coarse mesh with separation constraints
    FINE = 3  # solved on the fine mesh
    REFINED = 4  # on a mesh on which the tips follow their tasks
    AUDITED = 5  # passed its audit
    ACTUATED = 6  # within actuator limits as well


class Rejection(Enum):
    """Kinds of reasons for rejecting a candidate."""

    COLLISION = "collides"
    COSTLIER = "costlier"
    DUPLICATE = "the same motion or cost as another candidate"
    UNTRACKED = "the tasks cannot be tracked from this start"
    INFEASIBLE = "the solver found no motion"
    AUDIT = "fails the audit"
    UNDETERMINED = "undetermined"
    ACTUATORS = "exceeds actuator limits"
    NOT_TRIED = "not tried"


@dataclass(frozen=True)
class Reason:
    """Reason why a candidate was rejected.

    Attributes:
        kind: Kind of the reason.
        detail: Details in words.
        remedy: What was tried against it, with which result; or what the user can change.
        name, value, limit, time: Offending item, its value, its limit and the time, s; None if unknown.
    """

    kind: Rejection
    detail: str = ""
    name: str | None = None
    value: float | None = None
    limit: float | None = None
    time: float | None = None
    remedy: str = ""

    @property
    def fault(self) -> dict[str, Any]:
        """Name, value, limit and time of the violation, as a dictionary of the fields of an exception."""
        return {name: getattr(self, name) for name in ("name", "value", "limit", "time")}

    def __str__(self) -> str:
        return self.kind.value + (self.detail and f": {self.detail}") + (self.remedy and f"; {self.remedy}")

    def record(self) -> dict[str, Any]:
        """Return the reason for the rejection as plain data for a file."""
        return {**asdict(self), "kind": self.kind.name}

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Reason:
        """Rebuild a rejection reason from the data of a file, which are checked because files are not trusted.

        Raises:
            KeyError, TypeError, ValueError: The record is damaged.
        """
        numbers = {name: None if record[name] is None else float(record[name]) for name in ("value", "limit", "time")}
        name = None if record["name"] is None else str(record["name"])
        return cls(Rejection[record["kind"]], str(record["detail"]), name, remedy=str(record["remedy"]), **numbers)

    @classmethod
    def of_error(cls, kind: Rejection, error: Exception) -> Reason:
        """Return a rejection reason from an exception's first line and its value, limit and time if numeric."""
        if isinstance(error, TimeLimitReached):
            return cls(kind, "the time limit passed", "time_limit")
        numbers = {name: getattr(error, name, None) for name in ("value", "limit", "time")}
        details: dict[str, Any] = {name: float(x) for name, x in numbers.items() if isinstance(x, int | float)}
        name = getattr(error, "name", None)
        return cls(kind, str(error).split("\n")[0], None if name is None else str(name), **details)


@dataclass(frozen=True, eq=False)
class Seed:
    """Initial guess of a candidate motion, and options for solving the optimal control problem from this guess.

    Attributes:
        guess: Guess of the first solve.
        cost: Cost of the local motion; inf if there is none.
        approach: Estimated cost of the motion by which the machine comes to the start.
        local: Local motion in each stretch of time; () if there is none.
        tracked: Whether the local motion satisfies the tasks.
        direct: Whether the first solve is on the fine mesh.
        fixed: Whether the start is fixed, though it could move along its self-motion.
        thorough: Whether a motion that fails is solved again with relaxed tasks.
        relaxed: Whether the tasks are relaxed, see `tool_motion_problem`.
    """

    guess: Any = None
    cost: float = np.inf
    approach: float = 0.0
    local: Sequence[LocalMotion] = ()
    tracked: bool = True
    direct: bool = False
    fixed: bool = False
    thorough: bool = False
    relaxed: bool = False

    def is_turned(self, other: Seed, turning: Sequence[int] | NDArray[np.intp]) -> bool:
        """Return whether another initial guess differs from this one only by full turns of the joints `turning`."""
        pairs = list(zip(self.local, other.local, strict=False))
        if not pairs or (self.direct, self.fixed, self.relaxed) != (other.direct, other.fixed, other.relaxed):
            return False
        if not all(np.array_equal(one.t, two.t) for one, two in pairs):
            return False
        turns = 2 * np.pi * np.round((pairs[0][0].joints - pairs[0][1].joints)[0, 0] / (2 * np.pi))
        turns[[joint not in turning for joint in range(len(turns))]] = 0.0
        differences = [np.abs(one.joints - two.joints - turns).max() for one, two in pairs]
        differences += [np.abs(one.base - two.base).max(initial=0.0) for one, two in pairs]
        return bool(max(differences) <= ROUNDING)


@dataclass(frozen=True, eq=False)
class Candidate:
    """Motion that may become the plan, with its cost and the stage that its solution has reached.

    Attributes:
        start: Start configuration of the search, rad or m. Shape (n,).
        cost: Cost of the motion, nan if none was found. Until it is solved on the fine mesh, it is an estimate, which
            further constraints can only increase.
        reason: Reason why the candidate is not the plan; None for the plan.
        stage: Stage of the solution process that the candidate has reached.
        solution: Solution of the last solve; None for a finished candidate that was not solved on the fine mesh.
        seed: Initial guess of the candidate.
        constraints: Clearance constraints with the separated pairs.
        separations: Number of solves that separated pairs, or separated them farther.
        separated: Reason of the last separation.
        audit: Audit of the solution that passed.
    """

    start: Array
    cost: float = np.nan
    reason: Reason | None = None
    stage: Stage = Stage.SEED
    solution: Solution | None = None
    seed: Seed = field(default_factory=Seed, repr=False)
    constraints: ClearanceConstraints | None = field(default=None, repr=False)
    separations: int = field(default=0, repr=False)
    separated: Reason | None = field(default=None, repr=False)
    audit: Audit | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        start = np.array2string(self.start, precision=3, separator=", ", max_line_width=200)
        return f"<Candidate from {start}: cost {self.cost:.6g}, {self.reason or 'the plan'}>"

    @classmethod
    def of_record(cls, record: Sequence[Any], solution: Solution | None) -> Candidate:
        """Rebuild a candidate from a `record` that is not trusted; `solution` is its motion unless it was rejected.

        Raises:
            KeyError, TypeError, ValueError: The record is damaged.
        """
        start, cost, stage, reason = record
        rejection = None if reason is None else Reason.of_record(reason)
        motion = solution if rejection is None else None
        return cls(np.array(start, dtype=float), float(cost), rejection, Stage(stage), motion)

    def record(self) -> list[Any]:
        """Return the start, cost, stage and reason of the candidate as plain data for a file."""
        return [self.start.tolist(), self.cost, int(self.stage), self.reason and self.reason.record()]

    @property
    def total(self) -> float:
        """Cost for comparing candidates: the cost of the motion plus the cost of the approach to its start."""
        return self.cost + self.seed.approach

    @property
    def passed(self) -> bool:
        """Whether the candidate has not been rejected."""
        return self.reason is None

    def with_rejection(self, reason: Reason) -> Candidate:
        """Return a copy rejected for `reason` or, if colliding bodies were separated in vain, for their collision."""
        if self.separated is not None and reason.kind not in (Rejection.COSTLIER, Rejection.DUPLICATE):
            reason = replace(self.separated, remedy=f"with separated bodies: {reason}")
        return replace(self, reason=reason, cost=np.nan if reason.kind is Rejection.UNTRACKED else self.cost)


def ranked(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return finished candidates: first the lowest-cost candidate that passed, then the others by rising cost.

    Other candidates that passed are rejected, because they cost more. The data of intermediate stages are left out.
    """
    best = min((c for c in candidates if c.passed), key=lambda c: c.total)
    costlier = Reason(Rejection.COSTLIER, limit=best.cost)
    order = sorted(candidates, key=lambda c: (c is not best, np.inf if np.isnan(c.cost) else c.total))
    rejected = [replace(c, reason=c.reason or replace(costlier, value=c.cost)) for c in order[1:]]
    return [
        Candidate(c.start, c.cost, c.reason, c.stage, c.solution if c.stage >= Stage.FINE else None, audit=c.audit)
        for c in (best, *rejected)
    ]


@dataclass(frozen=True)
class SingularSettings:
    """Thresholds below which a motion counts as nearly singular, and a joint as being at a limit.

    Attributes:
        conditioning: Ratio of the least to the largest singular value of the tasks' Jacobian below which tasks are
            relaxed. Below it joint rates exceed the tip's velocity by more than its inverse, and the multipliers of the
            tasks grow with its square.
        at_limit: Distance from a limit, relative to the limit of a rate or to the range of a position, below which a
            joint is at it.
    """

    conditioning: float = 1e-2
    at_limit: float = 1e-3


SINGULAR = SingularSettings()


@dataclass(frozen=True)
class MotionSample:
    """Samples of a motion in one time interval, in which the same tasks are active.

    Attributes:
        stretch: The time interval and its tasks.
        t: Times, s. Shape (M,).
        base, joints, rates: Base and joint positions, and joint rates. Shapes (M, base_size), (M, n), (M, n).
    """

    stretch: Stretch
    t: Array
    base: Array
    joints: Array
    rates: Array

    @classmethod
    def of_local(cls, stretch: Stretch, motion: LocalMotion) -> MotionSample:
        """Return the samples, within one time interval, of the first of several local (resolved-rate) motions."""
        return cls(stretch, motion.t, motion.base[0], motion.joints[0], motion.rates[0])

    @property
    def is_nearly_singular(self) -> bool:
        """Whether the task Jacobian is nearly singular at one of the samples."""
        equations, joints = self.stretch.equations, self.joints
        if equations is None or not equations.size:
            return False
        columns = np.array(equations.jacobian_function.map(len(joints))(joints.T, self.base.T))
        jacobians = columns.reshape(len(columns), *joints.shape).transpose(1, 0, 2)
        values = np.linalg.svd(jacobians[np.isfinite(jacobians).all(axis=(1, 2))], compute_uv=False)
        return bool((values[:, -1] < SINGULAR.conditioning * values[:, 0]).any())

    def misses(self) -> tuple[Array, Array]:
        """Return the largest position and orientation errors of any task at each sample, m and rad. Shapes (M,).

        The error of a velocity task is the integral of its velocity error.
        """
        equations, worst = self.stretch.equations, np.zeros((2, len(self.t)))
        if equations is None:
            return worst[0], worst[1]
        errors = np.nan_to_num(equations.errors(self.t, self.base, self.joints), nan=np.inf)
        if not equations.pose_rows.all():
            targets = np.array(equations.target_function().map(len(self.t))(self.t[None, :]))
            values = equations.function.map(len(self.t))(self.base.T, self.joints.T, targets)
            columns, right = (np.array(part) for part in values[:2])
            jacobians = columns.reshape(equations.size, *self.joints.shape)
            velocities = np.einsum("mkn,kn->km", jacobians, self.rates) - right.T
            strayed = np.cumsum(velocities[:-1] * np.diff(self.t)[:, None], axis=0)
            errors = np.where(equations.pose_rows, errors, np.vstack([np.zeros((1, equations.size)), strayed]))
        ends = np.cumsum([0, *(part.task.size for part in equations.bound)]).tolist()
        for begin, end in pairwise(ends):
            turning = equations.turning[begin:end]
            for k, chosen in enumerate((~turning, turning)):
                worst[k] = np.maximum(worst[k], np.linalg.norm(errors[:, begin:end][:, chosen], axis=1))
        return worst[0], worst[1]


def _limit_reason(request: PlanRequest, samples: Sequence[MotionSample]) -> Reason | None:
    """Return a rejection reason about the joint that exceeds its rate limit most; None if no joint exceeds it."""
    sample = max(samples, key=lambda each: float(_rate_shares(request, each.rates).max()))
    shares = _rate_shares(request, sample.rates)
    k, index = np.unravel_index(int(shares.argmax()), shares.shape)
    if shares[k, index] <= 1 + SINGULAR.at_limit:
        return None
    joint, time = request.machine.robot.moving_joints[index], float(sample.t[k])
    rate, limit = float(abs(sample.rates[k, index])), float(request.bounds.velocity[index])
    words = f"at {time:.4g} s {joint.name!r} would have to move at {rate:.4g} {joint.unit}/s, its limit is "
    words += f"{limit:.4g} {joint.unit}/s; lengthen the horizon or start elsewhere"
    return Reason(Rejection.INFEASIBLE, words, joint.name, rate, limit, time)


def shortfall_reason(request: PlanRequest, samples: Sequence[MotionSample]) -> Reason:
    """Return why a motion that misses its tasks is rejected: a rate beyond its limit, or else the largest pose error.

    The largest pose error is described together with a joint that is at its limit at that time.
    """
    if (reason := _limit_reason(request, samples)) is not None:
        return reason
    sample, k, misses = samples[0], 0, (0.0, 0.0)
    for each in samples:
        distances, angles = each.misses()
        i = int((distances + angles).argmax())
        if distances[i] + angles[i] > sum(misses):
            sample, k, misses = each, i, (float(distances[i]), float(angles[i]))
    bounds, joints, time = request.bounds, sample.joints[k], float(sample.t[k])
    moving = request.machine.robot.moving_joints
    words = f"at {time:.4g} s the tip misses its task by {describe_miss(*misses)}"
    with np.errstate(invalid="ignore"):
        slack = np.nan_to_num(SINGULAR.at_limit * (bounds.upper - bounds.lower), nan=0.0, posinf=0.0)
    for limits in (bounds.lower, bounds.upper):
        for index in np.flatnonzero(np.abs(joints - limits) <= slack).tolist():
            name, value, limit = moving[index].name, float(joints[index]), float(limits[index])
            how = f"at its limit {limit:.5g} {moving[index].unit}"
            words += f", with {name!r} {how}; start elsewhere or leave a row free"
            return Reason(Rejection.INFEASIBLE, words, name, value, limit, time)
    shares = _rate_shares(request, sample.rates[k])
    index = int(shares.argmax())
    name, value, limit = moving[index].name, float(abs(sample.rates[k, index])), float(bounds.velocity[index])
    how = "at the limit of its rate" if shares[index] >= 1 - SINGULAR.at_limit else "as the fastest joint"
    words += f", with {name!r} {how}, {value:.4g} {moving[index].unit}/s; lengthen the horizon or start elsewhere"
    return Reason(Rejection.INFEASIBLE, words, name, value, limit, time)


def _rate_shares(request: PlanRequest, rates: Array) -> Array:
    """Return absolute joint rates as fractions of the rate limits; the fraction is zero for a joint at rest."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num(np.abs(rates) / request.bounds.velocity, nan=0.0)
