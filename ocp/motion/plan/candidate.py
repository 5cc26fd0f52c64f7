"""A motion on its way to become the plan: how far it has come, what it costs, and why it is rejected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import Enum, IntEnum
from typing import Any

import numpy as np

from models.arrays import Array
from ocp.audit.clearance import ClosestPair
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.local.collisions import Collision
from ocp.motion.local.rates import LocalMotion
from ocp.solution import Solution

__all__ = ["Candidate", "Reason", "Rejection", "Seed", "Stage", "collision"]


class Stage(IntEnum):
    """How far a candidate has come."""

    SEED = 0  # a guess, mostly a local motion
    COARSE = 1  # solved on the coarse mesh
    SEPARATED = 2  # there with constraints that separate bodies
    FINE = 3  # solved on the fine mesh
    REFINED = 4  # on a mesh on which its tips keep to their poses
    AUDITED = 5  # passed its audit
    ACTUATED = 6  # within the limits of actuators, too


class Rejection(Enum):
    """Why a candidate is not the plan."""

    COLLISION = "touches"
    COSTLIER = "costlier"
    DUPLICATE = "the same as another one, or of the same cost"
    UNTRACKED = "the tasks cannot be tracked from there"
    INFEASIBLE = "no motion was found"
    AUDIT = "the audit fails"
    UNDETERMINED = "not decided"
    ACTUATORS = "beyond the limits of actuators"
    NOT_TRIED = "not tried"


@dataclass(frozen=True)
class Reason:
    """Why a candidate is not the plan.

    Attributes:
        kind: What kind of reason it is.
        detail: What exactly.
        then: What was tried against it, and what came of that.
        name, value, limit, time: The offending thing, its value, what is allowed, and when, s; None if unknown.
    """

    kind: Rejection
    detail: str = ""
    name: str | None = None
    value: float | None = None
    limit: float | None = None
    time: float | None = None
    then: str = ""

    def __str__(self) -> str:
        return self.kind.value + (self.detail and f": {self.detail}") + (self.then and f"; {self.then}")

    def record(self) -> dict[str, Any]:
        """What a file holds of it."""
        return {**asdict(self), "kind": self.kind.name}

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Reason:
        """The reason of which `record` returned the record. Nothing in it is trusted.

        Raises:
            KeyError, TypeError, ValueError: It is damaged.
        """
        numbers = {name: None if record[name] is None else float(record[name]) for name in ("value", "limit", "time")}
        name = None if record["name"] is None else str(record["name"])
        return cls(Rejection[record["kind"]], str(record["detail"]), name, then=str(record["then"]), **numbers)

    @classmethod
    def of_error(cls, kind: Rejection, error: Exception) -> Reason:
        """The first line of an error, with its value, limit and time where these are numbers."""
        numbers = {name: getattr(error, name, None) for name in ("value", "limit", "time")}
        given: dict[str, Any] = {
            name: float(value) for name, value in numbers.items() if isinstance(value, int | float)
        }
        name = getattr(error, "name", None)
        return cls(kind, str(error).split("\n")[0], None if name is None else str(name), **given)


def collision(near: Collision | ClosestPair, limit: float, then: str = "") -> Reason:
    """That two bodies come nearer than a limit, m."""
    return Reason(Rejection.COLLISION, str(near), " and ".join(near.bodies), near.distance, limit, near.time, then)


@dataclass(frozen=True, eq=False)
class Seed:
    """What a candidate begins from.

    Attributes:
        guess: Of its first solve.
        cost: Of the local motion; inf if there is none.
        local: The local motion, one in each stretch of time; () if there is none.
        tracked: Whether it does its tasks.
        direct: Whether it is solved on the fine mesh at once.
        fixed: Whether the start stays where it is, though it might move along its self-motion.
        thorough: Whether a solve that fails is begun from other guesses, too, and diagnosed.
    """

    guess: Any = None
    cost: float = np.inf
    local: Sequence[LocalMotion] = ()
    tracked: bool = True
    direct: bool = False
    fixed: bool = False
    thorough: bool = False


@dataclass(frozen=True, eq=False)
class Candidate:
    """A motion that may become the plan.

    Attributes:
        start: Joints that the search began with, rad or m. Shape (n,).
        cost: Of the motion, nan where none was found. Before it is solved on the fine mesh it is an estimate, and more
            constraints can but make it larger.
        reason: Why it is not the plan; None for the plan itself.
        stage: How far it has come.
        solution: Of the last solve; of a candidate that has ended, where that was on the fine mesh.
        seed: What it began from.
        clearance_constraints: What it has to stay clear of, with the pairs that constraints separate.
        separations: How often pairs were separated, or farther. separated: The reason of the last time.
    """

    start: Array
    cost: float = np.nan
    reason: Reason | None = None
    stage: Stage = Stage.SEED
    solution: Solution | None = None
    seed: Seed = field(default_factory=Seed, repr=False)
    clearance_constraints: ClearanceConstraints | None = field(default=None, repr=False)
    separations: int = field(default=0, repr=False)
    separated: Reason | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        start = np.array2string(self.start, precision=3, separator=", ", max_line_width=200)
        return f"<Candidate from {start}: cost {self.cost:.6g}, {self.reason or 'the plan'}>"

    @classmethod
    def of_record(cls, start: Any, cost: Any, stage: Any, reason: Any, solution: Solution) -> Candidate:
        """A candidate of a plan that a file holds, whose motion is the solution unless it was rejected.

        Raises:
            KeyError, TypeError, ValueError: What the file says is damaged.
        """
        why = None if reason is None else Reason.of_record(reason)
        return cls(np.array(start, dtype=float), float(cost), why, Stage(stage), solution if why is None else None)

    @property
    def passed(self) -> bool:
        """Whether it ended and nothing is wrong with it."""
        return self.reason is None

    def rejected(self, reason: Reason) -> Candidate:
        """The same with the reason why it is not the plan; where bodies were separated for that they collided first."""
        if self.separated is not None and reason.kind not in (Rejection.COSTLIER, Rejection.DUPLICATE):
            reason = replace(self.separated, then=f"held apart: {reason}")
        return replace(self, reason=reason, cost=np.nan if reason.kind is Rejection.UNTRACKED else self.cost)

    def ended(self) -> Candidate:
        """The same as a plan tells it."""
        solution = self.solution if self.stage >= Stage.FINE else None
        return Candidate(self.start, self.cost, self.reason, self.stage, solution)
