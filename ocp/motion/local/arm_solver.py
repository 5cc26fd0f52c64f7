"""All inverse kinematics solutions of an arm within its limits; redundant joints are sampled.

Six joints are solved for at once, in closed form or by elimination. Tasks that leave the orientation of the tip open
and arms of fewer joints are brought to that form by revolute joints that the arm does not have, between its last joint
and the tip: one about the tool axis if the roll is open, three about the tip if the orientation is; and auxiliary ones
if there are still fewer than six, which must stay at zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from models.checks import Array
from ocp.motion.local.chain import TURN, Chain, Motion, Solutions
from ocp.motion.local.closed_forms import SCARA, SIX, PoseSolver, closed_forms
from ocp.motion.local.elimination import elimination_of

STEPS = np.sqrt([2.0, 3.0, 5.0, 7.0, 11.0, 13.0]) % 1
"""Increments of the sampled parameters, as fractions of their ranges; irrational, so that no sample repeats."""


@dataclass(frozen=True)
class ArmSettings:
    """Settings of the choice of redundant joints, whose positions are sampled in inverse kinematics."""

    max_samples: int = 6  # largest number of sampled parameters
    # largest number of choices of the sampled joints in closed form, and by elimination
    max_solvers: tuple[int, int] = (6, 2)
    trials: int = 32  # number of random configurations at which choices are compared
    seed: int = 0  # seed of these configurations and of the axes of auxiliary joints
    slide_range: float = 1.0  # prismatic joints without limits are sampled this far on either side of 0, m
    auxiliary: float = 1e-3  # largest position of an auxiliary joint that is refined at zero, rad
    excess: float = 1e-9  # largest excess over a limit that counts as rounding and is clipped, rad or m


ARM = ArmSettings()


def sample_shares(first: int, count: int, dimension: int) -> Array:
    """Return `count` points of a low-discrepancy sequence in [0, 1)^dimension, from index `first` on."""
    return np.asarray(((first + np.arange(count) + 0.5)[:, None] * STEPS[:dimension] + 0.5) % 1)


@dataclass(frozen=True, eq=False)
class ArmSolver:
    """Solver of all inverse kinematics solutions of an arm within its limits. Use `arm_solver` to build it.

    Attributes:
        solvers: Solvers of six joints, or four of a SCARA, for several choices of the sampled joints; the
            best-conditioned one first. Their chains have further joints at the end.
        auxiliary: Indices of the auxiliary joints, which must stay at zero.
        lower, upper: Limits of the joints, infinite for unlimited ones. Shape (n,).
    """

    chain: Chain
    solvers: tuple[PoseSolver, ...]
    auxiliary: tuple[int, ...]
    lower: Array
    upper: Array

    def redundant_positions(self, solver: PoseSolver, shares: Array) -> Array:
        """Convert fractions of the joint ranges to positions of the redundant joints of a solver. Shapes (M, k)."""
        joints = list(solver.redundant)
        if not joints:
            return shares[:, :0]
        span = np.where(self.chain.revolute[joints], np.pi, ARM.slide_range)
        low, high = self.lower[joints], self.upper[joints]
        low = np.where(np.isfinite(low), low, np.where(np.isfinite(high), high - 2 * span, -span))
        high = np.where(np.isfinite(high), high, low + 2 * span)
        return np.asarray(low + shares * (high - low))

    def solve(
        self, solver: PoseSolver, positions: Array, rotations: Array, redundant: Array, *, turns: bool = True
    ) -> tuple[Solutions, NDArray[np.bool_]]:
        """Return all isolated IK solutions within the limits at M poses, and flags of poses where some may be missing.

        Revolute joints are shifted by whole turns in all ways that keep the limits (with `turns` False, only to the one
        farthest from them); unlimited ones are between -pi and pi. `redundant` has the positions of the redundant
        joints of the solver, (M, k). Joints that do not move the tip are at 0.
        """
        solutions, doubtful = solver.solve(positions, rotations, redundant)
        n, extended = len(self.chain.axes), solver.chain
        if self.auxiliary:
            still = (np.abs(solutions.joints[:, list(self.auxiliary)]) < ARM.auxiliary).all(axis=1)
            joints = solutions.joints[still]
            joints[:, list(self.auxiliary)] = 0.0
            own = [j for j in solver.free if j not in self.auxiliary]
            solutions = extended.refine(solutions.pose[still], joints, own, Motion(rotations, positions))
        if len(extended.axes) > n + len(self.auxiliary):  # solutions that differ only in joints the arm does not have
            solutions = extended.distinct(solutions, [j for j in solver.free if j < n], Motion(rotations, positions))
        return self._within_limits(solutions._replace(joints=solutions.joints[:, :n]), turns), doubtful

    def _within_limits(self, solutions: Solutions, turns: bool) -> Solutions:
        """Return the IK solutions within the limits and, with `turns`, all whole-turn shifts that keep the limits."""
        below, above, order = np.isfinite(self.lower), np.isfinite(self.upper), list(self.chain.order)
        both, lower, upper = below & above & self.chain.revolute, self.lower - ARM.excess, self.upper + ARM.excess
        start = np.where(
            below, lower, upper - TURN
        )  # lower end of the interval of one turn into which angles are shifted
        if not turns:
            start[both] = (self.lower[both] + self.upper[both]) / 2 - np.pi
        shiftable = np.flatnonzero((below | above) & self.chain.revolute)
        joints = solutions.joints.copy()
        joints[:, shiftable] += TURN * np.ceil((start[shiftable] - joints[:, shiftable]) / TURN)
        good = ((joints >= lower) & (joints <= upper))[:, order].all(axis=1)
        rows, joints, several = np.flatnonzero(good), joints[good], np.flatnonzero(both & (upper - lower >= TURN))
        if turns and several.size:
            counts = 1 + ((upper[several] - joints[:, several]) // TURN).astype(int)
            shifts = list(map(_whole_turns, map(tuple, counts.tolist())))
            copies = np.repeat(np.arange(len(rows)), [len(each) for each in shifts])
            rows, joints = rows[copies], joints[copies]
            joints[:, several] += np.concatenate(shifts) if shifts else 0.0
        joints[:, order] = np.clip(joints[:, order], self.lower[order], self.upper[order])
        return Solutions(solutions.pose[rows], joints, solutions.singular[rows])


@lru_cache(maxsize=256)
def _whole_turns(counts: tuple[int, ...]) -> Array:
    """Return all combinations of 0 to count - 1 whole turns of several joints, rad. Shape (combinations, joints)."""
    return np.asarray(TURN * np.indices(counts).reshape(len(counts), -1).T)


def arm_solver(chain: Chain, lower: Array, upper: Array, axes: Array | None = None) -> ArmSolver | None:
    """Return the inverse kinematics solver of an arm; None if no choice of joints can be solved for.

    Args:
        lower, upper: Limits of the joints, infinite for unlimited ones. Shape (n,).
        axes: Axes (k, 3) through the tip at zero about which the task leaves the orientation open.
    """
    virtual = np.zeros((0, 3)) if axes is None else axes
    extended = chain.extend(virtual, np.tile(chain.position, (len(virtual), 1)))
    count, joints = len(extended.order), tuple(chain.order)
    if not 0 < count <= SIX + min(ARM.max_samples, len(joints)):
        return None
    if count == SCARA and (forms := closed_forms(extended)):
        return ArmSolver(chain, forms, (), lower, upper)
    auxiliary = tuple(range(len(extended.axes), len(extended.axes) + SIX - count))
    if auxiliary:
        rng = np.random.default_rng(ARM.seed)
        directions = rng.normal(size=(len(auxiliary), 3))
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        extended = extended.extend(directions, chain.position + chain.size * rng.uniform(-1, 1, directions.shape))
    solvers: list[PoseSolver] = list(closed_forms(extended, joints))
    conditions = _conditions(extended, [solver.redundant for solver in solvers])
    solvers = [solvers[k] for k in np.argsort(-conditions, kind="stable")[: ARM.max_solvers[0]]]
    if not solvers:
        choices = list(combinations(joints, max(count - SIX, 0)))
        for k in np.argsort(-_conditions(extended, choices), kind="stable"):
            solver = elimination_of(extended, choices[k])
            solvers += [] if solver is None else [solver]
            if len(solvers) == ARM.max_solvers[1]:
                break
    return ArmSolver(chain, tuple(solvers), auxiliary, lower, upper) if solvers else None


def _conditions(chain: Chain, choices: list[tuple[int, ...]]) -> Array:
    """Return the geometric mean of the least singular value of the Jacobian for each choice of redundant joints."""
    _, jacobian = chain.linearize(*chain.random_configurations(ARM.trials, ARM.seed), chain.order)
    columns = [[k for k, j in enumerate(chain.order) if j not in redundant] for redundant in choices]
    values = [np.linalg.svd(jacobian[:, :, each], compute_uv=False)[:, -1] for each in columns]
    return np.exp(np.log(np.maximum(values, 1e-300)).mean(axis=1)) if values else np.zeros(0)
