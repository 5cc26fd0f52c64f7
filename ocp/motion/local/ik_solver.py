"""All inverse kinematics solutions (IK configurations) of an arm at poses of its tip, and whether they are complete.

Six joints are solved for at once, in closed form or by elimination; redundant joints are sampled. Tasks that leave the
orientation of the tip open and arms of fewer joints are brought to that form by revolute joints that the arm does not
have, between its last joint and the tip: one about the tool axis if the roll is open, three about the tip if the
orientation is; and auxiliary ones if there are still fewer than six, which must stay at zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, Flag, auto
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models import FixedBase, Machine
from models.checks import Array, ArrayInput
from models.spatial import least_rotation, rotation_matrices
from ocp.errors import ProblemError, require
from ocp.motion.local.chain import TURN, Chain, Motion, Solutions
from ocp.motion.local.closed_forms import SIX, PoseSolver, closed_forms, is_scara
from ocp.motion.local.elimination import elimination_of
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.tip_task import ANGULAR, LINEAR, TipTask

ROTATION_TOLERANCE = 1e-6  # largest accepted entry of R R^T - 1 for a rotation matrix R
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


class ToolFreedom(Enum):
    """Part of the orientation of the tip that a task leaves free."""

    NONE = "none"
    ROLL = "roll"
    CONE = "cone"
    ROTATION = "rotation"


class Incompleteness(Flag):
    """Reasons why IK configurations of a pose may be missing; no flag means that all configurations are found.

    Attributes:
        SAMPLED: The arm is redundant. Its configurations form families, of which those at samples are listed.
        SINGULAR: A configuration is singular or nearly so. Others may coincide with it, or belong to a family.
        ILL_CONDITIONED: The elimination is ill-conditioned at the pose.
    """

    SAMPLED = auto()
    SINGULAR = auto()
    ILL_CONDITIONED = auto()


@dataclass(frozen=True, eq=False)
class IkConfigurations:
    """Configurations in which the tip of an arm reaches N given poses, up to rounding errors.

    Attributes:
        joints: Configurations of all poses. Shape (K, n), rad or m.
        pose: Index of the pose of each configuration, increasing. Shape (K,).
        parameters: Names of the sampled parameters: joints, and "roll" or others for open angles of the tip.
        reasons: Why configurations may be missing, for each pose.
    """

    joints: Array
    pose: NDArray[np.intp]
    parameters: tuple[str, ...]
    reasons: tuple[Incompleteness, ...]

    def __repr__(self) -> str:
        return f"<IkConfigurations: {len(self)} at {len(self.reasons)} poses, {self.complete.sum()} of them complete>"

    @property
    def complete(self) -> NDArray[np.bool_]:
        """Mask of the poses for which all configurations are found. Shape (N,), bool."""
        return np.array([not reason for reason in self.reasons], dtype=bool)

    def at(self, pose: int) -> Array:
        """Return the configurations at the pose with a given index. Shape (k, n)."""
        first, last = np.searchsorted(self.pose, [pose, pose + 1])
        return self.joints[first:last]

    def __len__(self) -> int:
        return len(self.joints)


def idle_positions(lower: Array, upper: Array) -> Array:
    """Return positions for joints that move no tip: the middle of a finite range, else the value nearest to 0."""
    with np.errstate(invalid="ignore"):
        middle = (lower + upper) / 2
    return np.asarray(np.where(np.isfinite(middle), middle, np.clip(0.0, lower, upper)))


def joint_range(machine: Machine, limits: bool) -> tuple[Array, Array]:
    """Return the position limits of the joints, infinite if `limits` is False. Shape (n,) each, rad or m."""
    unlimited = np.full(machine.joint_size, np.inf)
    return (machine.robot.lower, machine.robot.upper) if limits else (-unlimited, unlimited)


def sampling_range(lower: Array, upper: Array, revolute: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return finite limits (n,) for sampling; unlimited joints get one turn or, if prismatic, 2 `ARM.slide_range`."""
    span = np.where(revolute, np.pi, ARM.slide_range)
    low = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper - 2 * span, -span))
    return low, np.where(np.isfinite(upper), upper, low + 2 * span)


def sample_shares(first: int, count: int, dimension: int) -> Array:
    """Return `count` points of a low-discrepancy sequence in the unit cube of a given dimension, from index `first`."""
    return np.asarray(((first + np.arange(count) + 0.5)[:, None] * STEPS[:dimension] + 0.5) % 1)


class IkSolver:
    """Solver of all IK configurations of an arm on a fixed base, prepared for any number of poses of its tip.

    Six joints have at most 16 configurations, which are found in closed form or by elimination. Further joints are
    sampled, so that configurations on all branches are listed at each sample. Joints that do not move the tip are in
    the middle of their limits. For tasks that leave a part of the orientation free, see `ik_configurations`.
    """

    def __init__(self, machine: Machine, *, limits: bool = True, samples: int = 36) -> None:
        """Prepare the inverse kinematics of an arm, within its position limits if `limits`.

        Redundant joints are sampled at a number of `samples`. Raises ProblemError if the base moves, no six joints
        determine the pose of the tip, or an argument is invalid.
        """
        require.instance("machine", machine, FixedBase)
        require.flag("limits", limits)
        require.count("samples", samples, 1)
        arm = ArmSolver.of(machine, *joint_range(machine, limits))
        if arm is None:
            words = f"{machine.robot.name}: no six joints on a fixed base determine the tip; use inverse_kinematics"
            raise ProblemError(words, name="machine", value=machine)
        self.arm, self.samples = arm, int(samples)

    def __repr__(self) -> str:
        sampled = f", {self.samples} samples of {' and '.join(self.parameters)}" if self.parameters else ""
        return f"<IkSolver of six joints{sampled}>"

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the redundant joints, which are sampled."""
        return self.arm.parameters(self.arm.solvers[0])

    def __call__(self, positions: ArrayInput, rotations: ArrayInput) -> IkConfigurations:
        """Return the IK configurations at one pose or N poses of the tip.

        Args:
            positions: Positions in the world. Shape (3,) or (N, 3), m.
            rotations: Rotation matrices. Shape (3, 3) or (N, 3, 3).

        Raises:
            ProblemError: A shape is wrong, a value is not finite, or a matrix is not a rotation.
        """
        places, turns = _checked_poses(positions, rotations)
        dimension = len(self.parameters)
        count = self.samples if dimension else 1
        shares = (np.arange(count)[:, None] + 0.5) / count if dimension == 1 else sample_shares(0, count, dimension)
        joints, pose, reasons = self.arm.solve(self.arm.solvers[0], places, turns, shares[:, :dimension])
        return IkConfigurations(joints, pose, self.parameters, reasons)


@dataclass(frozen=True, eq=False)
class ArmSolver:
    """Solver of an arm's inverse kinematics within limits, on all branches and for partly free orientations."""

    chain: Chain
    solvers: tuple[PoseSolver, ...]  # for several choices of the sampled joints, the best-conditioned one first
    auxiliary: tuple[int, ...]  # indices of the auxiliary joints of these solvers, which must stay at zero
    lower: Array  # limits of the joints, infinite for unlimited ones, (n,)
    upper: Array
    free: ToolFreedom
    tool_axis: Array  # axis of the roll in the frame of the tip
    within: float  # half-angle of the cone, rad
    sampled_angles: int  # number of free angles that are sampled
    names: tuple[str, ...]

    @classmethod
    def of(
        cls,
        tip: Machine,
        lower: Array,
        upper: Array,
        *,
        free: ToolFreedom = ToolFreedom.NONE,
        tool_axis: ArrayInput = (0.0, 0.0, 1.0),
        within: float = 0.0,
    ) -> ArmSolver | None:
        """Prepare an arm for inverse kinematics; return None if its base moves or no six joints determine its tip."""
        chain = Chain.of(tip)
        if chain is None or (free is ToolFreedom.CONE and len(chain.order) < SIX):
            return None
        axis, axes, sampled = np.array(tool_axis), np.zeros((0, 3)), 0
        if free is ToolFreedom.ROTATION:
            axes = np.eye(3)
        elif free is ToolFreedom.ROLL and len(chain.order) < SIX and not is_scara(chain):
            axes = (chain.rotation @ axis)[None]
        elif free is not ToolFreedom.NONE:
            sampled = 1 if free is ToolFreedom.ROLL else 3
        solvers, auxiliary = _pose_solvers(chain, axes)
        if not solvers or len(solvers[0].redundant) + sampled > ARM.max_samples:
            return None
        return cls(chain, solvers, auxiliary, lower, upper, free, axis, within, sampled, tip.robot.joint_names)

    @property
    def complete(self) -> bool:
        """Whether all solutions can be found without sampling a parameter."""
        return not (self.sampled_angles or self.solvers[0].redundant)

    def parameters(self, solver: PoseSolver) -> tuple[str, ...]:
        """Return the names of the parameters that are sampled if this solver is used."""
        return (*(self.names[j] for j in solver.redundant), *("roll", "azimuth", "tilt")[: self.sampled_angles])

    def solve(
        self, solver: PoseSolver, positions: Array, rotations: Array, shares: Array, *, turns: bool = True
    ) -> tuple[Array, NDArray[np.intp], tuple[Incompleteness, ...]]:
        """Return IK configurations (K, n), the indices (K,) of their poses, and why some may be missing at each pose.

        `shares` (S, k) samples the parameters as shares of their ranges. With `turns` all whole turns within the limits
        are listed, else only the one farthest from the limits; unlimited joints are between -pi and pi.
        """
        count, samples, redundant = len(positions), len(shares), list(solver.redundant)
        if self.free is ToolFreedom.ROTATION:  # any rotation at which the added joints are not singular
            rotations = np.tile(rotation_matrices(np.array([0.3, 0.5, 0.7])), (count, 1, 1))
        prescribed = shares[:, : len(redundant)]
        if redundant:
            low, high = sampling_range(self.lower[redundant], self.upper[redundant], self.chain.revolute[redundant])
            prescribed = low + prescribed * (high - low)
        if self.sampled_angles:
            rotations = (rotations[:, None] @ self._rotations(shares[:, len(redundant) :])).reshape(-1, 3, 3)
        elif samples > 1:
            rotations = np.repeat(rotations, samples, axis=0)
        goal = Motion(rotations, np.repeat(positions, samples, axis=0) if samples > 1 else positions)
        solutions, doubtful = solver.solve(goal.shift, goal.turn, np.tile(prescribed, (count, 1)))
        solutions = self._within_limits(self._of_the_arm(solver, solutions, goal), turns)
        pose, joints = solutions.pose // samples, solutions.joints
        if count > 1:
            order = np.argsort(pose, kind="stable")
            pose, joints = pose[order], joints[order]
        if len(self.chain.order) < joints.shape[1]:
            idle = np.isin(np.arange(len(self.lower)), self.chain.order, invert=True)
            joints[:, idle] = idle_positions(self.lower, self.upper)[idle]
        reasons = [Incompleteness(0) if self.complete else Incompleteness.SAMPLED] * count
        for k in set((solutions.pose[solutions.singular] // samples).tolist()):
            reasons[k] |= Incompleteness.SINGULAR
        for k in set((np.flatnonzero(doubtful) // samples).tolist()):
            reasons[k] |= Incompleteness.ILL_CONDITIONED
        return joints, pose, tuple(reasons)

    def _of_the_arm(self, solver: PoseSolver, solutions: Solutions, goal: Motion) -> Solutions:
        """Drop auxiliary joints from a solver's solutions; return the distinct solutions for the arm's own joints."""
        n, extended = len(self.chain.axes), solver.chain
        if self.auxiliary:
            still = (np.abs(solutions.joints[:, list(self.auxiliary)]) < ARM.auxiliary).all(axis=1)
            joints = solutions.joints[still]
            joints[:, list(self.auxiliary)] = 0.0
            own = [j for j in solver.free if j not in self.auxiliary]
            solutions = extended.refine(solutions.pose[still], joints, own, goal)
        if len(extended.axes) > n + len(self.auxiliary):
            solutions = extended.distinct(solutions, [j for j in solver.free if j < n], goal)
        return solutions._replace(joints=solutions.joints[:, :n])

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

    def _rotations(self, shares: Array) -> Array:
        """Map samples of the unit cube to permitted rotations (S, 3, 3) of the tip: roll, azimuth, tilt in the cone."""
        rolled = rotation_matrices(TURN * shares[:, :1] * self.tool_axis)
        if self.free is ToolFreedom.ROLL:
            return rolled
        across = np.eye(3)[np.abs(self.tool_axis).argmin()]
        across = np.cross(self.tool_axis, across) / np.linalg.norm(np.cross(self.tool_axis, across))
        azimuths = rotation_matrices(TURN * shares[:, 1:2] * self.tool_axis)
        tilts = np.arccos(1 - shares[:, 2:3] * (1 - np.cos(self.within)))  # uniform on the cap of the sphere
        return rotation_matrices(tilts * (azimuths @ across)) @ rolled


@lru_cache(maxsize=256)
def _whole_turns(counts: tuple[int, ...]) -> Array:
    """Return all combinations of 0 to count - 1 whole turns of several joints, rad. Shape (combinations, joints)."""
    return np.asarray(TURN * np.indices(counts).reshape(len(counts), -1).T)


def _pose_solvers(chain: Chain, axes: Array) -> tuple[tuple[PoseSolver, ...], tuple[int, ...]]:
    """Return the pose solvers of an arm whose tip may rotate about `axes` (k, 3), and auxiliary joints kept at 0."""
    extended = chain.extend(axes, np.tile(chain.position, (len(axes), 1)))
    count, joints = len(extended.order), tuple(chain.order)
    if not 0 < count <= SIX + min(ARM.max_samples, len(joints)):
        return (), ()
    if is_scara(extended):
        return closed_forms(extended), ()
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
    return tuple(solvers), auxiliary


def _conditions(chain: Chain, choices: list[tuple[int, ...]]) -> Array:
    """Return for each choice of redundant joints the least singular value of the Jacobian, averaged over samples."""
    _, jacobian = chain.linearize(*chain.random_configurations(ARM.trials, ARM.seed), chain.order)
    columns = [[k for k, j in enumerate(chain.order) if j not in redundant] for redundant in choices]
    values = [np.linalg.svd(jacobian[:, :, each], compute_uv=False)[:, -1] for each in columns]
    return np.exp(np.log(np.maximum(values, 1e-300)).mean(axis=1)) if values else np.zeros(0)


def _checked_poses(positions: Any, rotations: Any) -> tuple[Array, Array]:
    """Return a user's tip positions (N, 3) and rotations (N, 3, 3); raise ProblemError if they are invalid."""
    places, turns = np.asarray(positions, dtype=float), np.asarray(rotations, dtype=float)
    places, turns = (places[None], turns[None]) if places.ndim == 1 else (places, turns)
    if places.ndim != 2 or places.shape[1] != 3 or turns.shape != (len(places), 3, 3):
        words = f"poses have shapes {places.shape} and {turns.shape}, (N, 3) and (N, 3, 3) expected"
        raise ProblemError(words, name="rotations", value=turns.shape, limit=(len(places), 3, 3))
    if not np.isfinite(places).all():
        raise ProblemError("positions are not finite", name="positions", value=positions)
    deviation = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    if not (deviation <= ROTATION_TOLERANCE and (np.linalg.det(turns) > 0).all()):
        words = "rotations are not rotation matrices: their columns must be orthonormal and right-handed"
        raise ProblemError(words, name="rotations", value=rotations, limit=ROTATION_TOLERANCE)
    return places, turns


class IkBranches:
    """Solver of all IK configurations for given targets of a pose task, at samples of the parameters that are free."""

    def __init__(self, equations: TaskEquations, arm: ArmSolver) -> None:
        self.arm, self.complete = arm, arm.complete
        self._task = equations.bound[0].task

    def configurations(
        self, targets: Array, count: int, number: int = 0, *, turns: bool = True, choices: int | None = None
    ) -> IkConfigurations:
        """Return the configurations that satisfy task targets (size,), for samples of the free parameters.

        Args:
            count: Number of samples of the free parameters, over several choices of the sampled joints.
            number: Number of the first sample; a different one gives other samples.
            turns: Whether all whole turns are listed, or only the one farthest from the limits.
            choices: Largest number of choices of the sampled joints, each singular elsewhere; None for all.
        """
        solvers = self.arm.solvers[:choices]
        position, rotation = targets[None, :3], self._rotation(targets)[None]
        parts, names, reason = list[Array](), dict[str, None](), Incompleteness(0)
        for solver in solvers:
            parameters = self.arm.parameters(solver)
            n = -(-count // len(solvers)) if parameters else 1
            shares = sample_shares(number, n, len(parameters))
            joints, _, reasons = self.arm.solve(solver, position, rotation, shares, turns=turns)
            parts.append(joints)
            names |= dict.fromkeys(parameters)
            reason |= reasons[0]
            if not parameters and not reason:
                break
        joints = np.concatenate(parts)
        return IkConfigurations(joints, np.zeros(len(joints), dtype=np.intp), tuple(names), (reason,))

    def _rotation(self, targets: Array) -> Array:
        """Return a rotation of the tip that satisfies the targets of the task. Shape (3, 3)."""
        if self._task.direction is not None:
            axis, direction = np.array(self._task.tool_axis), targets[6:9] / np.linalg.norm(targets[6:9])
            return least_rotation(axis, direction)
        if self._task.orientation is not None and set(self._task.chosen) & set(ANGULAR):
            return np.asarray(targets[6:15].reshape(3, 3).T)
        return self.arm.chain.rotation


def ik_branches(equations: TaskEquations, lower: Array, upper: Array) -> IkBranches | None:
    """Return the solver of all IK branches of a task; None if no such solver exists for the task or machine.

    There is one for a pose of the tip of an arm in the world: the whole pose, a position and a direction or a cone
    about it, a position alone, or, on a SCARA, a position and the rotation about its axes.
    """
    if len(equations.bound) != 1:
        return None
    task, tip, reference = equations.bound[0]
    whole_position = set(task.chosen) >= set(LINEAR) and task.position is not None
    if reference is not None or not task.is_pose or not whole_position or (chain := Chain.of(tip)) is None:
        return None
    if not equations.idle[np.isin(np.arange(len(lower)), chain.order, invert=True)].all():
        return None  # other joints matter, for example to the balance of a standing machine
    rotation = set(task.chosen) & set(ANGULAR)
    free, axis = ToolFreedom.NONE, np.array(task.tool_axis)
    if task.direction is not None:
        free = ToolFreedom.ROLL if task.within is None else ToolFreedom.CONE
    elif is_scara(chain):
        if not rotation:
            first = next(j for j in chain.order if chain.revolute[j])
            free, axis = ToolFreedom.ROLL, chain.rotation.T @ chain.axes[first]
    elif not rotation:
        free = ToolFreedom.ROTATION
    elif rotation < set(ANGULAR):
        return None
    arm = ArmSolver.of(tip, lower, upper, free=free, tool_axis=axis, within=float(task.within or 0.0))
    return None if arm is None else IkBranches(equations, arm)


def ik_configurations(
    machine: Machine, task: TipTask, *, time: float = 0.0, limits: bool = True, samples: int = 36
) -> IkConfigurations:
    """Return IK configurations of an arm on all branches of a pose task, and whether the list is complete.

    For many poses of one arm, prepare an `IkSolver`.

    Args:
        machine: Machine on a fixed base.
        task: A position, with an orientation, a direction, a cone or neither, at a `time`, s.
        limits: Whether the position limits of the robot apply.
        samples: Number of samples of the free parameters, if the arm is redundant for the task.

    Raises:
        ProblemError: The task is not of this kind, or the machine has no such solver: use `inverse_kinematics`.
    """
    require.count("samples", samples, 1)
    require.flag("limits", limits)
    require.number("time", time, unit="s")
    equations = bind(machine, task)
    branches = ik_branches(equations, *joint_range(machine, limits))
    if branches is None:
        words = "ik_configurations needs the pose of the tip of an arm on a fixed base; use inverse_kinematics"
        raise ProblemError(words, name="task", value=task)
    targets = np.array(equations.target_function()(float(time))).ravel()
    return branches.configurations(targets, int(samples), choices=1)
