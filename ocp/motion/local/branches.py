"""IK solutions on all branches of a pose task, at samples of the parameters that it leaves open."""

from __future__ import annotations

import numpy as np
import scipy

from models import Machine
from models.checks import Array, real
from ocp.errors import ProblemError, require
from ocp.motion.local.arm_solver import sample_shares
from ocp.motion.local.chain import Chain
from ocp.motion.local.closed_forms import is_scara
from ocp.motion.local.ik_solver import IkConfigurations, PreparedArm, ToolFreedom
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.tip_task import ANGULAR, LINEAR, TipTask

__all__ = ["IkBranches", "ik_branches", "ik_configurations"]


class IkBranches:
    """IK configurations of one pose task at samples of its free parameters. Use `ik_branches` to build it.

    Attributes:
        arm: The prepared arm.
        complete: Whether the task leaves no parameter free, so that all configurations are listed.
    """

    def __init__(self, equations: TaskEquations, arm: PreparedArm) -> None:
        self.arm, self.complete = arm, arm.complete
        self._task = equations.bound[0].task

    def configurations(
        self, targets: Array, count: int, number: int = 0, *, turns: bool = True, choices: int | None = None
    ) -> IkConfigurations:
        """Return the configurations of all branches within the limits, joints without limits between -pi and pi.

        Args:
            targets: Targets of the equations. Shape (size,).
            count: Number of samples of the free parameters, over several choices of the sampled joints.
            number: Number of the first sample; a different one gives other samples.
            turns: Whether all whole turns are listed, or only the one farthest from the limits.
            choices: Largest number of choices of the sampled joints; None: all that have a solver. Each is singular at
                other configurations.
        """
        solvers = self.arm.arm.solvers[:choices]
        position, rotation = targets[None, :3], self._rotation(targets)[None]
        parts, names, reason = list[Array](), dict[str, None](), None
        for solver in solvers:
            parameters = self.arm.parameters(solver)
            n = -(-count // len(solvers)) if parameters else 1
            shares = sample_shares(number, n, len(parameters))
            joints, _, reasons = self.arm.solve(solver, position, rotation, shares, turns=turns)
            parts.append(joints)
            names |= dict.fromkeys(parameters)
            reason = reasons[0] if reason is None else reason | reasons[0]
            if not parameters and not reason:
                break
        joints = np.concatenate(parts)
        assert reason is not None
        return IkConfigurations(joints, np.zeros(len(joints), dtype=np.intp), tuple(names), (reason,))

    def _rotation(self, targets: Array) -> Array:
        """Return a rotation of the tip that does the task. Shape (3, 3)."""
        if self._task.direction is not None:
            axis, direction = np.array(self._task.tool_axis), targets[6:9] / np.linalg.norm(targets[6:9])
            return np.asarray(
                scipy.spatial.transform.Rotation.align_vectors(direction[None], axis[None])[0].as_matrix()
            )
        if self._task.orientation is not None and set(self._task.chosen) & set(ANGULAR):
            return np.asarray(targets[6:15].reshape(3, 3).T)
        return self.arm.arm.chain.rotation


def ik_branches(equations: TaskEquations, lower: Array, upper: Array) -> IkBranches | None:
    """Return the IK branches of a task, None for tasks and machines that have no solver.

    Args:
        equations: Equations of one pose of the tip of an arm in the world: the whole pose, a position and a direction
            or a cone about it, a position alone, or, on a SCARA, a position and the rotation about its axes.
        lower, upper: Limits of the joints, infinite for unlimited ones. Shape (n,).
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
    arm = PreparedArm.of(tip, lower, upper, free=free, tool_axis=axis, within=float(task.within or 0.0))
    return None if arm is None else IkBranches(equations, arm)


def ik_configurations(
    machine: Machine, task: TipTask, *, time: float = 0.0, limits: bool = True, samples: int = 36
) -> IkConfigurations:
    """Return the IK configurations of an arm on all branches of a pose task, and whether they are all.

    For many poses of one arm, prepare an `IkSolver`.

    Args:
        machine: Machine on a fixed base.
        task: A position, with an orientation, a direction, a cone or neither.
        time: Time of the task, s.
        limits: Whether the position limits of the robot apply.
        samples: Number of samples of the free parameters, if the arm is redundant for the task.

    Raises:
        ProblemError: The task is not of this kind, or the machine has no such solver: use `inverse_kinematics`.
    """
    require.count("samples", samples, 1)
    require.flag("limits", limits)
    if not np.isfinite(real(time)):
        raise ProblemError(f"time must be a finite number of seconds, not {time!r}", name="time", value=time)
    equations, unbounded = bind(machine, task), np.full(machine.joint_size, np.inf)
    lower, upper = (machine.robot.lower, machine.robot.upper) if limits else (-unbounded, unbounded)
    branches = ik_branches(equations, lower, upper)
    if branches is None:
        words = "ik_configurations needs the pose of the tip of an arm on a fixed base; use inverse_kinematics"
        raise ProblemError(words, name="task", value=task)
    targets = np.array(equations.target_function()(float(time))).ravel()
    return branches.configurations(targets, int(samples), choices=1)
