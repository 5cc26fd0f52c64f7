"""Motions that stay clear of themselves and of their surroundings: what is declared, looked at, and held apart.

All pairs are declared to be proven apart by the audit. Held apart by the method, as path constraints, are those alone
that are told: a planner solves, looks which pairs touch, holds these, and solves again, so that a motion that is clear
anyway costs nothing. The constraint is the distance rounded from below (`models.shapes.distance`), whose gradient has
no jumps where nearest points do, and a margin for what a constraint at points leaves between them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol, Self, TypeVar

import casadi as ca
import numpy as np

from models import CollisionScene, ModelError
from models.arrays import Array
from ocp.audit.audit import Audit
from ocp.audit.clearance import Clearance, Track, clearance_along
from ocp.errors import ProblemError, SolveError, checked_instance, checked_mapping, checked_nonnegative
from ocp.motion.local.collisions import Collision, find_collisions, scene_hulls
from ocp.problem.declarations import Variable
from ocp.problem.hulls import frames_of
from ocp.problem.problem import Problem
from ocp.problem.separation import Separation
from ocp.problem.values import Sampler, constant
from ocp.solution import Solution

__all__ = [
    "APART",
    "CLEARANCE",
    "LOOKS",
    "MARGIN",
    "ROUNDING",
    "ClearanceConstraints",
    "Keeping",
    "Kept",
    "clearance_of",
    "collision_error",
    "of_clearance",
    "solve_with_clearance",
    "widened",
]  # fmt: skip

CLEARANCE, APART = "clearance", "apart"
"""Names of what the audit proves, and of the constraints, with the suffix of a stretch of time."""
ROUNDING = 3e-3
"""m: of the distances that are held."""
LOOKS = 6
"""Times that a motion is planned anew because bodies come too near."""
MARGIN = 5e-5
"""m: that a pair which is held has at least, and by which a margin that was too small grows beside what was missed."""


@dataclass(frozen=True, eq=False)
class ClearanceConstraints:
    """What a motion has to stay clear of, and by how much.

    Attributes:
        scene: Of the machine, with the clearance of every pair.
        margins: Pairs that are held apart by constraints, by their places, and by how much more than that, m.

    Raises:
        ProblemError: No surroundings, a pair that there is none of, a margin that is no number.
    """

    scene: CollisionScene
    margins: Mapping[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        checked_instance("clearance_constraints: scene", self.scene, CollisionScene)
        for pair, margin in checked_mapping("clearance_constraints: margins", self.margins).items():
            checked_nonnegative("clearance_constraints: margins", margin)
            if (
                isinstance(pair, bool)
                or not isinstance(pair, int | np.integer)
                or not 0 <= pair < len(self.scene.pairs)
            ):
                words = f"clearance_constraints: there is no pair {pair!r}, only {len(self.scene.pairs)}"
                raise ProblemError(words, name="margins", value=pair, limit=len(self.scene.pairs))

    def holding(self, pairs: Sequence[int]) -> ClearanceConstraints:
        """The same with some pairs more held apart."""
        return replace(self, margins={**{int(pair): MARGIN for pair in pairs}, **self.margins})

    def widened(self, proofs: Sequence[Clearance]) -> ClearanceConstraints:
        """The same with what came too near held apart, farther by what it missed."""
        return replace(self, margins=widened(self.margins, self.scene.labels, proofs))

    def declare(
        self,
        problem: Problem,
        base: Any,
        joints: Any,
        *,
        base_name: str = "",
        joints_name: str = "joints",
        suffix: str = "",
        begin: float = 0.0,
        pace: float = 1.0,
        horizon: float | None = None,
    ) -> None:
        """Declare what is proven and what is held, for a machine whose configuration is two states.

        Args:
            problem: Of SX symbols, with these states.
            base, joints: Symbols, or numbers where the base stands.
            base_name, joints_name: Names of the states; "" where the base is none.
            suffix: Of the names of what is declared.
            begin, pace: The time of the surroundings is begin + pace times that of the problem.
            horizon: Of the problem, s; None where it is free, and then nothing may move by itself.

        Raises:
            ProblemError: A moving obstacle and a free horizon; obstacles whose motion is not
                defined all the time, or made of operations without bounds.
        """
        around, time = self.scene, begin + pace * problem.time
        _check_limits(around, problem.declared.states[joints_name])
        if horizon is not None:
            try:
                around.check_motions(begin, begin + pace * horizon)
            except ModelError as error:
                raise ProblemError(str(error), **vars(error)) from error
        elif around.moves_by_itself:
            words = "an obstacle that moves needs a time that is known; give a horizon in s, or let it stand"
            raise ProblemError(words, name="obstacles")
        levers = around.levers
        moved = {joints_name: (levers.joints, levers.joint_turns)}
        if base_name:
            moved[base_name] = (levers.base, levers.base_turns)
        problem.separate(
            f"{CLEARANCE}{suffix}",
            _said(around.placements, base, joints, time),
            scene_hulls(around),
            around.pairs,
            np.full(len(around.pairs), around.clearance),
            levers={name: pair[0] for name, pair in moved.items()},
            turns={name: pair[1] for name, pair in moved.items()},
            covers=around.covers,
            assumed=around.assumed,
        )
        if self.margins:
            pairs = sorted(self.margins)
            apart = _said(partial(around.distances, pairs=pairs, rounding=ROUNDING), base, joints, time)
            least = [around.clearance + self.margins[pair] for pair in pairs]
            problem.path(f"{APART}{suffix}", apart, lower=least, unit="m")

    def find_collisions(self, base: Array, joints: Array, times: Array) -> list[Collision]:
        """The pairs that come nearer than they may at some samples of a motion, see `local.collisions`."""
        return find_collisions(self.scene, base, joints, times)


class Keeping(Protocol):
    """What is held apart, by margins that grow."""

    def widened(self, proofs: Sequence[Clearance]) -> Self:
        """The same with what came too near held apart, farther by what it missed."""


def widened(
    margins: Mapping[int, float], labels: Sequence[tuple[str, str]], proofs: Sequence[Clearance]
) -> dict[int, float]:
    """Margins of pairs, m, by their places among the labels, grown by what the pairs missed; of other pairs nothing."""
    places = {label: pair for pair, label in enumerate(labels)}
    found = dict(margins)
    for proof in proofs:
        for near in proof.pairs:
            if near.missed > 0 and near.bodies in places:
                pair = places[near.bodies]
                found[pair] = margins[pair] + 1.5 * near.missed + MARGIN if pair in margins else MARGIN
    return found


def clearance_of(
    around: CollisionScene,
    joints: Callable[[Array], Array],
    breaks: Array,
    horizon: float,
    rates: Array,
    seconds: Array,
    smooth: bool,
) -> Clearance:
    """How near each pair comes at any time of a motion of a machine whose base stands still, and nothing else moves.

    Args:
        joints: From fractions of the horizon (M,) to joints (M, n).
        breaks, horizon, rates, seconds, smooth: Of the joints, as of `ocp.audit.clearance.Track`.

    Raises:
        ModelError: Joints that slide without limits.
    """
    machine, levers, n = around.machine, around.levers, len(around.pairs)
    q = ca.SX.sym("q", machine.joint_size)
    placements = ca.SX(around.placements(ca.DM(machine.base_home()), q, 0.0))
    apart = Separation(
        CLEARANCE,
        placements,
        scene_hulls(around),
        around.pairs,
        np.full(n, around.clearance),
        movers={"joints": machine.joint_size},
        levers=levers.joints,
        turns=levers.joint_turns,
        covers=around.covers,
        assumed=around.assumed,
    )
    sampler = Sampler([q], [placements])
    frames = Track(breaks, horizon, rates, seconds, smooth, lambda at: frames_of(sampler(joints(at))[0]))
    return clearance_along(apart, frames)


def _check_limits(around: CollisionScene, joints: Variable) -> None:
    """Raise where joints may leave the limits by which pairs were left that never touch."""
    robot = around.machine.robot
    kept = (constant(joints.lower) >= robot.lower) & (constant(joints.upper) <= robot.upper)
    if around.limits and not kept.all():
        name = robot.joint_names[int(np.flatnonzero(~kept)[0])]
        words = (
            f"surroundings keep joint {name!r} within its limits, the problem does not: Surroundings(..., limits=False)"
        )
        raise ProblemError(words, name=name)


Kept = TypeVar("Kept", bound=Keeping | None)
"""What a planner is told to keep apart, or None."""


def solve_with_clearance(clearance_constraints: Kept, run: Callable[[Kept], Solution]) -> Solution:
    """What ``run`` plans, with the bodies held apart that come too near in what it planned before.

    Args:
        clearance_constraints: What to stay clear of; None for nothing.
        run: Solves and audits; raises SolveError that names the clearance where that alone is wrong with its solution.

    Raises:
        SolveError: As ``run``; names the bodies that touch, where and when, if they cannot be kept apart.
    """
    touching: SolveError | None = None
    for _ in range(LOOKS):
        try:
            return run(clearance_constraints)
        except SolveError as error:
            if clearance_constraints is None or error.solution is None or not of_clearance(error.name):
                if touching is None:
                    raise
                words = f"{touching}; held apart, no motion was found: {error}"
                found = {"value": touching.value, "limit": touching.limit, "time": touching.time}
                raise SolveError(words, error.solution, error.conflicts, name=touching.name, **found) from error
            touching = error
            clearance_constraints = clearance_constraints.widened(list(error.solution.audit().clearances.values()))
    assert touching is not None
    raise touching


def of_clearance(name: Any) -> bool:
    """Whether that is the name of a clearance, in a phase or without one."""
    return str(name).rpartition(".")[2].startswith(CLEARANCE)


def collision_error(audit: Audit, solution: Solution) -> SolveError | None:
    """What says that bodies come too near in a solution that is sound otherwise; None where it is not that."""
    failures = audit.failures
    if not failures or any(finding.name not in audit.clearances for finding in failures):
        return None
    finding = failures[0]
    words = f"bodies touch: {audit.clearances[finding.name].worst}"
    return SolveError(words, solution, name=finding.name, value=finding.value, limit=finding.limit, time=finding.time)


def _said(expression: Callable[..., Any], base: Any, joints: Any, time: Any) -> Any:
    """An expression of base, joints and time, worked out on scalars where these are MX."""
    given = [base if isinstance(base, ca.SX | ca.MX) else ca.DM(base), joints, time]
    if not any(isinstance(value, ca.MX) for value in given):
        return ca.SX(expression(*given))
    symbols = [ca.SX.sym("v", value.numel()) for value in given]
    return ca.Function("said", symbols, [ca.densify(ca.SX(expression(*symbols)))])(*given)
