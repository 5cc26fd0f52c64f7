"""All IK configurations of an arm at poses of its tip, with what is known about their completeness."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, Flag, auto
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models import FixedBase, Machine, ModelError
from models.checks import Array, ArrayInput
from models.machines.machine import with_tip
from ocp.errors import ProblemError, require
from ocp.motion.local.arm_solver import ARM, ArmSolver, arm_solver, sample_shares
from ocp.motion.local.chain import TURN, Chain
from ocp.motion.local.closed_forms import SIX, is_scara
from ocp.motion.local.pose_solver import PoseSolver

__all__ = ["IkConfigurations", "IkSolver", "Incompleteness", "PreparedArm", "ToolFreedom", "idle_positions"]

ROTATION_TOLERANCE = 1e-6
"""Largest deviation of a rotation matrix from an orthonormal one."""


class ToolFreedom(Enum):
    """Freedom that a task leaves in the orientation of the tip."""

    NONE = "none"
    ROLL = "roll"
    CONE = "cone"
    ROTATION = "rotation"


class Incompleteness(Flag):
    """Why IK configurations of a pose may be missing; no flag: these are all.

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
    """IK configurations of an arm at N poses; each one reaches its pose to rounding.

    Attributes:
        joints: Configurations of all poses. Shape (K, n), rad or m.
        pose: Number of the pose of each configuration, increasing. Shape (K,).
        parameters: Names of the sampled parameters: joints, and "roll" or others for open angles of the tip.
        reasons: Why configurations may be missing, for each pose.
    """

    joints: Array
    pose: NDArray[np.intp]
    parameters: tuple[str, ...]
    reasons: tuple[Incompleteness, ...]

    @property
    def complete(self) -> NDArray[np.bool_]:
        """At which poses no configuration is missing. Shape (N,), bool."""
        return np.array([not reason for reason in self.reasons], dtype=bool)

    def at(self, pose: int) -> Array:
        """Return the configurations at a pose. Shape (k, n)."""
        first, last = np.searchsorted(self.pose, [pose, pose + 1])
        return self.joints[first:last]

    def __len__(self) -> int:
        return len(self.joints)


def idle_positions(lower: Array, upper: Array) -> Array:
    """Return positions for joints without effect: the middle of their limits, else the value next to 0."""
    with np.errstate(invalid="ignore"):
        middle = (lower + upper) / 2
    return np.asarray(np.where(np.isfinite(middle), middle, np.clip(0.0, lower, upper)))


class IkSolver:
    """Solver of all IK configurations of an arm on a fixed base, prepared once for any number of poses.

    Six joints have at most 16 configurations, which are found in closed form or by elimination. With further joints,
    and where the task leaves angles of the tip open, these parameters are sampled, so that configurations on all
    branches are listed at each sample. Joints that do not move the tip are in the middle of their limits.
    """

    def __init__(
        self,
        machine: Machine,
        *,
        link: str | None = None,
        point: ArrayInput = (0.0, 0.0, 0.0),
        free: ToolFreedom = ToolFreedom.NONE,
        tool_axis: ArrayInput = (0.0, 0.0, 1.0),
        within: float = 0.0,
        limits: bool = True,
        samples: int = 36,
    ) -> None:
        """
        Args:
            machine: Machine on a fixed base.
            link, point: Link of the tip, and its origin in the frame of the link, (3,), m; None: the tip of the robot.
            free: What of the orientation is open. ROLL: the angle about `tool_axis`; CONE: also the direction of this
                axis, within a cone; ROTATION: all.
            tool_axis: In the frame of the tip. Shape (3,).
            within: Half-angle of the cone, rad, between 0 and pi.
            limits: Whether the position limits of the robot apply.
            samples: Number of samples of the parameters, if there are any.

        Raises:
            ProblemError: The machine has a moving base, no six of its joints determine the pose of the tip, or an
                argument is invalid.
        """
        require.instance("machine", machine, FixedBase)
        require.instance("free", free, ToolFreedom)
        if free is ToolFreedom.CONE:
            require.positive("within", within, below=np.pi)
        require.flag("limits", limits)
        require.count("samples", samples, 1)
        try:
            tip = machine if link is None else with_tip(machine, link, require.array("IkSolver: point", point, (3,)))
            axis = require.array("IkSolver: tool_axis", tool_axis, (3,))
        except ModelError as error:
            raise ProblemError(str(error), **vars(error)) from error
        if not np.linalg.norm(axis) > 0:
            raise ProblemError(f"tool_axis {axis.tolist()} has no direction", name="tool_axis", value=axis)
        unbounded = np.full(machine.joint_size, np.inf)
        lower, upper = (machine.robot.lower, machine.robot.upper) if limits else (-unbounded, unbounded)
        prepared = PreparedArm.of(tip, lower, upper, free=free, tool_axis=axis, within=float(within))
        if prepared is None:
            words = f"{machine.robot.name}: no six joints on a fixed base determine the tip; use inverse_kinematics"
            raise ProblemError(words, name="machine", value=machine)
        self.prepared, self.samples = prepared, int(samples)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the sampled parameters."""
        return self.prepared.parameters(self.prepared.arm.solvers[0])

    def __call__(self, positions: ArrayInput, rotations: ArrayInput) -> IkConfigurations:
        """Return the configurations at one pose or N poses of the tip.

        Args:
            positions: Positions in the world. Shape (3,) or (N, 3), m.
            rotations: Rotation matrices. Shape (3, 3) or (N, 3, 3). Of what is open their value does not matter: with a
                free roll they give the direction of the tool axis.

        Raises:
            ProblemError: A shape is wrong, a value is not finite, or a matrix is not a rotation.
        """
        places, turns = _checked_poses(positions, rotations)
        solver = self.prepared.arm.solvers[0]
        dimension = len(self.parameters)
        count = self.samples if dimension else 1
        shares = (np.arange(count)[:, None] + 0.5) / count if dimension == 1 else sample_shares(0, count, dimension)
        joints, pose, reasons = self.prepared.solve(solver, places, turns, shares[:, :dimension])
        return IkConfigurations(joints, pose, self.parameters, reasons)


@dataclass(frozen=True, eq=False)
class PreparedArm:
    """A prepared arm, see `IkSolver`.

    Attributes:
        arm: Solver of the arm.
        free: What of the orientation is open.
        tool_axis: Axis of the roll in the frame of the tip.
        sampled_angles: Number of open angles that are sampled.
        within: Half-angle of the cone, rad.
        names: Names of the joints.
    """

    arm: ArmSolver
    free: ToolFreedom
    tool_axis: Array
    sampled_angles: int
    within: float
    names: tuple[str, ...]

    @classmethod
    def of(
        cls, tip: Machine, lower: Array, upper: Array, *, free: ToolFreedom, tool_axis: Array, within: float = 0.0
    ) -> PreparedArm | None:
        """Return the prepared arm; None if its base moves or no six joints determine the pose of its tip."""
        chain = Chain.of(tip)
        if chain is None or (free is ToolFreedom.CONE and len(chain.order) < SIX):
            return None
        axis, axes, sampled = tool_axis / np.linalg.norm(tool_axis), None, 0
        if free is ToolFreedom.ROTATION:
            axes = np.eye(3)
        elif free is ToolFreedom.ROLL and len(chain.order) < SIX and not is_scara(chain):
            axes = (chain.rotation @ axis)[None]
        elif free is not ToolFreedom.NONE:
            sampled = 1 if free is ToolFreedom.ROLL else 3
        arm = arm_solver(chain, lower, upper, axes)
        if arm is None or len(arm.solvers[0].redundant) + sampled > ARM.max_samples:
            return None
        return cls(arm, free, axis, sampled, within, tip.robot.joint_names)

    @property
    def complete(self) -> bool:
        """Whether no parameter is sampled."""
        return not (self.sampled_angles or self.arm.solvers[0].redundant)

    def parameters(self, solver: PoseSolver) -> tuple[str, ...]:
        """Return the names of the parameters that are sampled with a solver."""
        return (*(self.names[j] for j in solver.redundant), *("roll", "azimuth", "tilt")[: self.sampled_angles])

    def solve(
        self, solver: PoseSolver, positions: Array, rotations: Array, shares: Array, *, turns: bool = True
    ) -> tuple[Array, NDArray[np.intp], tuple[Incompleteness, ...]]:
        """Return configurations (K, n), their poses (K,), and why some may be missing at each of N poses.

        Args:
            solver: One of the solvers of the arm.
            positions, rotations: Shapes (N, 3), (N, 3, 3).
            shares: Samples of the parameters as shares of their ranges. Shape (S, k).
            turns: Whether all whole turns are listed, or only the one farthest from the limits.
        """
        count, samples = len(positions), len(shares)
        if (
            self.free is ToolFreedom.ROTATION
        ):  # any rotation will do, but not one at which the added joints are singular
            rotations = np.tile(Rotation.from_rotvec([0.3, 0.5, 0.7]).as_matrix(), (count, 1, 1))
        redundant = self.arm.redundant_positions(solver, shares[:, : len(solver.redundant)])
        if self.sampled_angles:
            rotations = (rotations[:, None] @ self._rotations(shares[:, len(solver.redundant) :])).reshape(-1, 3, 3)
        elif samples > 1:
            rotations = np.repeat(rotations, samples, axis=0)
        if samples > 1:
            positions, redundant = np.repeat(positions, samples, axis=0), np.tile(redundant, (count, 1))
        elif count > 1:
            redundant = np.repeat(redundant, count, axis=0)
        solutions, doubtful = self.arm.solve(solver, positions, rotations, redundant, turns=turns)
        pose, joints = solutions.pose // samples, solutions.joints
        if count > 1:
            order = np.argsort(pose, kind="stable")
            pose, joints = pose[order], joints[order]
        if self._idle.any():
            joints[:, self._idle] = idle_positions(self.arm.lower, self.arm.upper)[self._idle]
        reasons = [Incompleteness(0) if self.complete else Incompleteness.SAMPLED] * count
        for k in np.unique(solutions.pose[solutions.singular] // samples).tolist():
            reasons[k] |= Incompleteness.SINGULAR
        for k in np.unique(np.flatnonzero(doubtful) // samples).tolist():
            reasons[k] |= Incompleteness.ILL_CONDITIONED
        return joints, pose, tuple(reasons)

    @cached_property
    def _idle(self) -> NDArray[np.bool_]:
        """Which joints do not move the tip. Shape (n,)."""
        return np.isin(np.arange(len(self.arm.lower)), self.arm.chain.order, invert=True)

    def _rotations(self, shares: Array) -> Array:
        """Return rotations of the tip in its own frame at shares of the open angles. Shape (S, 3, 3)."""
        rolled = Rotation.from_rotvec(TURN * shares[:, :1] * self.tool_axis)
        if self.free is ToolFreedom.ROLL:
            return np.asarray(rolled.as_matrix())
        across = np.eye(3)[np.abs(self.tool_axis).argmin()]
        across = np.cross(self.tool_axis, across) / np.linalg.norm(np.cross(self.tool_axis, across))
        azimuths = Rotation.from_rotvec(TURN * shares[:, 1:2] * self.tool_axis)
        tilts = np.arccos(1 - shares[:, 2:3] * (1 - np.cos(self.within)))  # uniform on the cap of the sphere
        return np.asarray((Rotation.from_rotvec(tilts * azimuths.apply(across)) * rolled).as_matrix())


def _checked_poses(positions: Any, rotations: Any) -> tuple[Array, Array]:
    """Return positions (N, 3) and rotations (N, 3, 3)."""
    places, turns = np.asarray(positions, dtype=float), np.asarray(rotations, dtype=float)
    single = places.ndim == 1
    places, turns = (places[None], turns[None]) if single else (places, turns)
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
