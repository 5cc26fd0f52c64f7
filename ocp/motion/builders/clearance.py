"""Clearance constraints of motions: the audit proves clearances, path constraints keep chosen pairs of bodies apart.

The audit proves the clearance of all declared pairs. Path constraints separate only the pairs that were found too
close: a planner solves, finds these pairs, adds separation constraints and solves again. A motion without collisions
needs no such constraints. The constrained distance is smoothed from below (`models.shapes.distance`), so that its
gradient is continuous where the closest points jump, and has a margin for the excess between the points of the grid.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from models import CollisionScene
from models.checks import Array
from ocp.audit.audit import Audit
from ocp.audit.clearance import Clearance, Track, clearance_along
from ocp.errors import ProblemError, SolveError, problem_errors, require
from ocp.motion.local.collisions import Collision, scene_hulls
from ocp.problem.declarations import Variable
from ocp.problem.hulls import Separation, frames_of
from ocp.problem.problem import Problem
from ocp.problem.values import Sampler, constant
from ocp.solution import Solution

CLEARANCE, APART = "clearance", "apart"
"""Name prefixes of the clearances that the audit proves (CLEARANCE) and of separation constraints (APART)."""
ROUNDING = 3e-3  # width of the smoothing of distances in separation constraints, m; see `models.shapes.distance`
MAX_SOLVES = 6  # largest number of solves of a motion, after each of which bodies that collide are separated
MARGIN = 5e-5  # first margin of separated bodies beyond the clearance, and least increase of it, m


@dataclass(frozen=True, eq=False)
class ClearanceConstraints:
    """Collision scene of a motion, and the pairs of bodies that separation constraints keep apart.

    Attributes:
        scene: Collision scene of the machine, with the clearance of every pair.
        margins: Distance beyond the clearance that each separated pair keeps, m, by the index of the pair. For meshes
            it is that of the bodies that cover them, and negative where these protrude.

    Raises:
        ProblemError: The scene is no CollisionScene, a pair does not exist, or a margin is not a finite number.
    """

    scene: CollisionScene
    margins: Mapping[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require.instance("clearance_constraints: scene", self.scene, CollisionScene)
        margins = require.mapping("clearance_constraints: margins", self.margins, object)
        if margins:
            require.indices("clearance_constraints: pairs of margins", list(margins), len(self.scene.pairs))
            require.array("clearance_constraints: margins", list(margins.values()), unit="m")

    def with_pairs(self, pairs: Sequence[int]) -> ClearanceConstraints:
        """Return a copy of the constraints that also separates the pairs of bodies with the given indices."""
        return replace(self, margins={**{int(pair): MARGIN for pair in pairs}, **self.margins})

    def with_collisions(self, collisions: Sequence[Collision]) -> ClearanceConstraints:
        """Return a copy of the constraints that also separates the pairs of bodies in the given collisions.

        Two hulls of meshes are separated by their covers, which protrude and may overlap in every configuration. The
        covers have to gain as much distance as the hulls lack where these are closest.
        """
        margins = {each.pair: MARGIN - each.protrusion for each in reversed(collisions)}
        return replace(self, margins={**margins, **self.margins})

    def widened(self, proofs: Sequence[Clearance]) -> ClearanceConstraints:
        """Return a copy of the constraints with larger margins for the pairs of bodies that violate their clearance."""
        places = {label: pair for pair, label in enumerate(self.scene.labels)}
        wider = dict(self.margins)
        for closest in (each for proof in proofs for each in proof.pairs):
            if closest.missed > 0 and closest.bodies in places:
                pair = places[closest.bodies]
                wider[pair] = self.margins[pair] + 1.5 * closest.missed + MARGIN if pair in self.margins else MARGIN
        return replace(self, margins=wider)

    def declare(
        self,
        problem: Problem,
        base: Any,
        joints: str = "joints",
        *,
        suffix: str = "",
        begin: float = 0.0,
        pace: float = 1.0,
        horizon: float | None = None,
    ) -> None:
        """Add to a problem the clearances that the audit shall prove, and the separation constraints.

        Args:
            base: Name of the state of the base, or the configuration of a fixed base.
            joints: Name of the state of the joint positions.
            suffix: Suffix of the declared names.
            begin, pace: The time of the scene is begin + pace times the time of the problem.
            horizon: Horizon of the problem, s; None if it is free, which excludes moving obstacles.

        Raises:
            ProblemError: An obstacle moves and the horizon is free; the motion of an obstacle is not defined over the
                whole horizon, or uses operations without interval bounds.
        """
        scene, time, states = self.scene, begin + pace * problem.time, problem.declared.states
        _check_limits(scene, states[joints])
        if horizon is not None:
            with problem_errors():
                scene.check_motions(begin, begin + pace * horizon)
        elif scene.has_moving_obstacles:
            words = "a moving obstacle needs a known time; give a horizon in s, or a fixed obstacle"
            raise ProblemError(words, name="obstacles")
        levers = scene.levers
        moved = {joints: (levers.joints, levers.joint_turns)}
        if isinstance(base, str):
            moved[base] = (levers.base, levers.base_turns)
        at = states[base].symbol if isinstance(base, str) else base, states[joints].symbol, time
        problem.separate(
            f"{CLEARANCE}{suffix}",
            _evaluate(scene.placements, *at),
            scene_hulls(scene),
            scene.pairs,
            least=np.full(len(scene.pairs), scene.clearance),
            levers={name: pair[0] for name, pair in moved.items()},
            turns={name: pair[1] for name, pair in moved.items()},
            covers=scene.covers,
            assumed=scene.assumed,
        )
        if self.margins:
            pairs = sorted(self.margins)
            distances = _evaluate(partial(scene.distances, pairs=pairs, rounding=ROUNDING), *at)
            least = [scene.clearance + self.margins[pair] for pair in pairs]
            problem.path(f"{APART}{suffix}", distances, lower=least, unit="m")


def clearance_of(
    scene: CollisionScene,
    joints: Callable[[Array], Array],
    breaks: Array,
    horizon: float,
    *,
    rates: Array,
    seconds: Array,
    smooth: bool,
    pairs: Sequence[int] | None = None,
) -> Clearance:
    """Prove the clearances of pairs of bodies, by default all, in a motion on a fixed base among fixed obstacles.

    `joints` returns joint positions (M, n) at fractions of the horizon (M,), with the properties that
    `ocp.audit.clearance.Track` describes.
    """
    machine, levers, n = scene.machine, scene.levers, len(scene.pairs)
    q = ca.SX.sym("q", machine.joint_size)
    placements = ca.SX(scene.placements(ca.DM(machine.base_home()), q, 0.0))
    separation = Separation(
        CLEARANCE,
        placements,
        scene_hulls(scene),
        scene.pairs,
        np.full(n, scene.clearance),
        movers={"joints": machine.joint_size},
        levers=levers.joints,
        turns=levers.joint_turns,
        covers=scene.covers,
        assumed=scene.assumed,
    )
    sampler = Sampler([q], [placements])
    frames = Track(breaks, horizon, rates, seconds, smooth, lambda at: frames_of(sampler(joints(at))[0]))
    return clearance_along(separation if pairs is None else separation.of(pairs), frames)


def _check_limits(scene: CollisionScene, joints: Variable) -> None:
    """Raise ProblemError if a problem lets joints leave the position limits that the collision scene presupposes."""
    robot = scene.machine.robot
    inside = (constant(joints.lower) >= robot.lower) & (constant(joints.upper) <= robot.upper)
    if scene.limits and not inside.all():
        name = robot.joint_names[int(np.flatnonzero(~inside)[0])]
        words = f"the collision scene assumes joint {name!r} within its limits, but the problem does not limit it; use "
        words += "CollisionScene(..., limits=False)"
        raise ProblemError(words, name=name)


def solve_with_clearance(
    clearance_constraints: ClearanceConstraints | None, run: Callable[[ClearanceConstraints | None], Solution]
) -> Solution:
    """Solve a problem repeatedly; after each solve, add separation constraints for the bodies that collide.

    `run` solves and audits. It raises a SolveError named after a clearance if that is the solution's only failure.

    Raises:
        SolveError: As `run`; or the bodies cannot be separated: names them with place and time.
    """
    collision: SolveError | None = None
    for _ in range(MAX_SOLVES):
        try:
            return run(clearance_constraints)
        except SolveError as error:
            if clearance_constraints is None or error.solution is None or not is_clearance(error.name):
                if collision is None:
                    raise
                words = f"{collision}; with these bodies separated, no motion was found: {error}"
                details = {"value": collision.value, "limit": collision.limit, "time": collision.time}
                raise SolveError(words, error.solution, error.conflicts, name=collision.name, **details) from error
            collision = error
            clearance_constraints = clearance_constraints.widened(list(error.solution.audit().clearances.values()))
    assert collision is not None
    raise collision


def is_clearance(name: Any) -> bool:
    """Return whether a name, which may begin with the name of a phase, is the name of a clearance constraint."""
    return str(name).rpartition(".")[2].startswith(CLEARANCE)


def collision_error(audit: Audit, solution: Solution) -> SolveError | None:
    """Return an error that names colliding bodies if a solution fails its audit only because of them, else None."""
    failures = audit.failures
    if not failures or any(finding.name not in audit.clearances for finding in failures):
        return None
    finding = failures[0]
    words = f"bodies collide: {audit.clearances[finding.name].worst}"
    return SolveError(words, solution, name=finding.name, value=finding.value, limit=finding.limit, time=finding.time)


def _evaluate(expression: Callable[..., Any], base: Any, joints: Any, time: Any) -> Any:
    """Evaluate a function of base, joints and time that accepts only SX expressions, for MX expressions as well."""
    arguments = [base if isinstance(base, ca.SX | ca.MX) else ca.DM(base), joints, time]
    if not any(isinstance(value, ca.MX) for value in arguments):
        return ca.SX(expression(*arguments))
    symbols = [ca.SX.sym("v", value.numel()) for value in arguments]
    return ca.Function("expression", symbols, [ca.densify(ca.SX(expression(*symbols)))])(*arguments)
