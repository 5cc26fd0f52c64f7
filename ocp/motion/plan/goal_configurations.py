"""Configurations of a machine at a goal: its joints, or all that inverse kinematics finds at its pose."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from models import Box, Machine, Sphere
from models.checks import Array, floats
from ocp.errors import ProblemError, require
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.local.inverse_kinematics import Unreachable, inverse_kinematics
from ocp.motion.tasks.checks import clip_to_limits
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.goals import Goal
from ocp.motion.tasks.limits import Limits

__all__ = ["goal_configurations", "nearest_configuration"]

REGION_SAMPLES = 8
"""Random places of the tip in the region of a goal, besides its centre."""


def nearest_configuration(machine: Machine, goal: Goal, near: Array, *, limits: Limits, seed: int) -> Array:
    """Return the joints at the pose of a goal that are nearest to others. Shape (n,).

    Raises:
        Unreachable, ProblemError: As `inverse_kinematics`.
    """
    options: dict[str, Any] = {"near": near, "seed": seed, "limits": limits.joints}
    solutions = inverse_kinematics(machine, goal.task, **options)
    distances = [float(np.linalg.norm(solution.joints - near)) for solution in solutions]
    return np.asarray(solutions[int(np.argmin(distances))].joints)


def goal_configurations(
    machine: Machine, goal: Goal, near: Array, *, limits: Limits, constraints: ClearanceConstraints | None, seed: int
) -> Array:
    """Return configurations at a goal that keep limits and clearance, the nearest to others first. Shape (K, n).

    The tip of a goal with a region is at the centre of the region, and at random places in it. Joints that do not move
    the tip stay where they are.

    Args:
        near: Joints to which the goals are compared. Shape (n,).

    Raises:
        Unreachable, ProblemError: As `inverse_kinematics`; or the joints of the goal do not fit, see `clip_to_limits`.
    """
    bounds, names = limits.bounds(machine), machine.robot.joint_names
    if not goal.has_pose:
        if goal.joints is None:
            raise ProblemError("a goal needs joints or a pose", name="joints", value=None)
        values = require.array("goal", np.nan_to_num(floats(goal.joints)), (len(near),), meaning="one for each joint")
        joints = np.where(np.isnan(floats(goal.joints).ravel()), near, values)
        return clip_to_limits("end", names, joints, bounds.lower, bounds.upper, "end inside them")[None]
    scene = None if constraints is None else constraints.scene
    tasks = [goal.task, *(replace(goal.task, position=point) for point in _points_inside(goal.region, seed))]
    solutions, error = list[Array](), None
    for task in tasks:
        try:
            members = inverse_kinematics(machine, task, near=near, seed=seed, limits=limits.joints, scene=scene)
        except Unreachable as unreachable:
            error = error or unreachable
            continue
        idle = bind(machine, task).idle
        solutions += [np.where(idle, near, solution.joints) for solution in members]
    if not solutions:
        assert error is not None
        raise error
    order = np.argsort([float(np.linalg.norm(joints - near)) for joints in solutions], kind="stable")
    return np.array(solutions)[order]


def _points_inside(region: Box | Sphere | None, seed: int) -> Array:
    """Return random points of a region in world, none without one. Shape (K, 3), m."""
    if region is None:
        return np.zeros((0, 3))
    center: Array = np.array(region.position, dtype=float)
    rng = np.random.default_rng(seed)
    if isinstance(region, Box):
        inside = (rng.random((REGION_SAMPLES, 3)) - 0.5) * np.asarray(region.size)
        return np.asarray(center + inside @ np.asarray(region.rotation, dtype=float).T)
    directions = rng.normal(size=(REGION_SAMPLES, 3))
    radii = float(region.radius) * np.cbrt(rng.random((REGION_SAMPLES, 1)))
    return np.asarray(center + radii * directions / np.linalg.norm(directions, axis=1, keepdims=True))
