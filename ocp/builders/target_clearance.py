"""How a chaser stays clear of the target that it approaches: held at the points of a mesh, and proven between them.

The hand, and what hangs on it, is to touch the target; everything else of the chaser is not. The target's pose is a
state, whose motion is not known before the time is. So both bodies of a pair are seen from the world, where the target
moves none of its points faster than its own states say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import casadi as ca
import numpy as np

from models import FreeFloating, Robot, Surroundings
from models.arrays import Array
from models.shapes.bodies import bodies_of
from models.shapes.distance import distance
from models.shapes.rigid_parts import RigidParts
from models.spatial import Frame
from ocp.audit.clearance import Clearance
from ocp.builders.clearance import APART, CLEARANCE, MARGIN, ROUNDING, widened
from ocp.errors import ProblemError, checked_nonnegative
from ocp.local.touching import hulls_of
from ocp.problem.hulls import Hull
from ocp.problem.problem import Problem

__all__ = ["ClearOfTarget", "hand_of"]

TURN_OF_QUATERNION = 2.0
"""rad: a unit quaternion that changes by dq turns by 2 |dq|."""


@dataclass(frozen=True, eq=False)
class ClearOfTarget:
    """What of a chaser stays clear of the target's body while approaching, and by how much.

    Attributes:
        target: Of one link.
        around: The chaser, and beside it the target's bodies, where they stand in its link's frame.
        pairs: Those of `around` that are one of each, by their places.
        margins: By how much more than the clearance each is held apart, by its place in `pairs`, m.
    """

    target: FreeFloating
    around: Surroundings
    pairs: list[int]
    margins: Mapping[int, float]

    @classmethod
    def of(cls, chaser: FreeFloating, target: FreeFloating, clearance: float, *, limits: bool = True) -> ClearOfTarget:
        """All bodies of the chaser but the hand's, from all of the target's.

        Args:
            clearance: m. limits: Whether the joints keep to the robot's position limits.

        Raises:
            ProblemError: A clearance that is none; bodies that there are none of.
        """
        near = checked_nonnegative("capture: clearance", clearance)
        theirs = [body.shape for body in bodies_of(target.robot)]
        hand, own = hand_of(chaser.robot), list(dict.fromkeys(body.link for body in bodies_of(chaser.robot)))
        told = [(one, other) for k, one in enumerate(own) for other in own[:k]]
        told += [(link, f"obstacle {k}") for link in own if link in hand for k in range(len(theirs))]
        if not theirs or hand.issuperset(own):
            words = "capture: a clearance is asked for, and chaser or target has no shapes (but for those of the hand)"
            raise ProblemError(words, name="clearance")
        around = Surroundings(chaser, theirs, near, ignored=told, limits=limits)
        first = len(around.bodies) - len(theirs)
        pairs = np.flatnonzero(around.pairs[:, 1] >= first)
        return cls(target, around, pairs.tolist(), dict.fromkeys(range(len(pairs)), MARGIN))

    def widened(self, proofs: Sequence[Clearance]) -> Self:
        """The same with what came too near held farther apart."""
        return replace(self, margins=widened(self.margins, self._labels, proofs))

    def declare(self, problem: Problem, base: Any, joints: Any, goal: Any) -> None:
        """Declare what is proven and what is held, of a problem with the states "base", "joints" and "target"."""
        around, pairs = self.around, self.around.pairs[self.pairs].copy()
        placed = self.target.world_from_base(goal)
        own = ca.SX(around.placements(base, joints))
        frames = ca.vertcat(own, ca.vec(placed.rotation), placed.position)
        hulls = dict(zip(self._names, hulls_of(around).values(), strict=True))
        for name in self._theirs:
            hulls[name] = replace(hulls[name], frame=own.numel() // 12)
        levers = around.levers
        moved = {
            "base": (levers.base[self.pairs], levers.base_turns[self.pairs]),
            "joints": (levers.joints[self.pairs], levers.joint_turns[self.pairs]),
            "target": self._of_target([hulls[self._names[other]] for other in pairs[:, 1]]),
        }
        problem.separate(
            f"{CLEARANCE} of the target",
            frames,
            hulls,
            pairs,
            np.full(len(pairs), around.clearance),
            levers={name: both[0] for name, both in moved.items()},
            turns={name: both[1] for name, both in moved.items()},
        )
        if self.margins:
            held = sorted(self.margins)
            least = [around.clearance + self.margins[pair] for pair in held]
            problem.path(APART, self._distances(own, placed, held, ROUNDING), lower=least, unit="m")

    def require_room(self, base: Any, joints: Any, goal: Any) -> None:
        """Raise where bodies are nearer than they may be at the start already.

        Args:
            base, joints, goal: Configurations of chaser and target there.

        Raises:
            ProblemError: Names the bodies, how far they are apart and should be.
        """
        placements, placed = (
            self.around.placements(ca.DM(base), ca.DM(joints)),
            self.target.world_from_base(ca.DM(goal)),
        )
        apart = np.array(ca.DM(self._distances(placements, placed, range(len(self.pairs))))).ravel()
        worst = int(np.argmin(apart))
        if apart[worst] < self.around.clearance:
            one, other = self._labels[worst]
            words = (
                f"capture: {one!r} and {other!r} are {apart[worst]:.4g} m apart at the start, and a clearance of "
                f"{self.around.clearance:g} m is asked for; start farther away"
            )
            raise ProblemError(words, name="clearance", value=float(apart[worst]), limit=self.around.clearance)

    def _distances(self, placements: Any, placed: Frame, pairs: Sequence[int], rounding: float = 0.0) -> Any:
        """Of pairs, by their places: where the chaser's bodies are and the target is. Shape (n, 1), m."""
        found = []
        for one, other in self.around.pairs[self.pairs][list(pairs), :2]:
            first, second = self.around.bodies[one], self.around.bodies[other]
            part = placements[12 * first.frame : 12 * (first.frame + 1)]
            frame = Frame(ca.reshape(part[:9], 3, 3), part[9:])
            found.append(distance(first.shape, second.shape, frame, placed, rounding=rounding))
        return ca.vertcat(*found)

    @property
    def _theirs(self) -> list[str]:
        """Names of the target's bodies."""
        name, count = self.target.robot.root, len(self.around.obstacles)
        return [name] if count == 1 else [f"{name}/{k + 1}" for k in range(count)]

    @property
    def _names(self) -> list[str]:
        bodies = [body.name for body in self.around.bodies]
        return bodies[: len(bodies) - len(self._theirs)] + self._theirs

    @property
    def _labels(self) -> list[tuple[str, str]]:
        return [(self._names[one], self._names[other]) for one, other, _ in self.around.pairs[self.pairs]]

    def _of_target(self, hulls: Sequence[Hull]) -> tuple[Array, Array]:
        """Levers and turns of the target's configuration. Shape (n, base_size) each."""
        reach = [float(np.linalg.norm(hull.core, axis=1).max()) + hull.radius for hull in hulls]
        n, size = len(hulls), self.target.base_size
        turns = np.zeros((n, size))
        turns[:, 2 if size == 3 else slice(3, 7)] = 1.0 if size == 3 else TURN_OF_QUATERNION
        levers = turns * np.array(reach)[:, None]
        levers[:, : 2 if size == 3 else 3] = 1.0
        return levers, turns


def hand_of(robot: Robot) -> set[str]:
    """Links of the hand: those that move with the tip, and all that hang on them."""
    parts = RigidParts.of(robot)
    hand = parts.of_link[str(robot.tip_link)]
    found = {hand}
    for part, step in parts.step.items():  # from the root outwards
        if step.above in found:
            found.add(part)
    return {link for link, part in parts.of_link.items() if part in found}
