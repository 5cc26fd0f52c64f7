"""The rig written anew in plain numpy, for the tests: geometry in the yawed plane instead of the paper's formulas."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from models import Rig, Tunnel
from models.cts.rig import Branch

Array = NDArray[np.float64]


def joints_by_geometry(rig: Rig, targets: Array, roll: Any, branch: Branch) -> tuple[Array, Any]:
    """Joints, shape (6, samples), and whether they reach; targets of shape (5, samples)."""
    x, y, z, yaw, pitch = targets
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-np.sin(yaw), np.cos(yaw)])
    lg = rig.goose_neck
    along = -rig.sting * np.cos(pitch) + lg * np.cos(roll) * np.sin(pitch)
    up = rig.sting * np.sin(pitch) + lg * np.cos(roll) * np.cos(pitch)
    corner = np.array([x, y]) + forward * along - left * lg * np.sin(roll)
    height = (z + up) / rig.pitch_link
    with np.errstate(invalid="ignore"):
        level = branch.pitch * np.sqrt(1 - height**2)
        elbow = corner - forward * (rig.yaw_link_2 + rig.pitch_link * level) - left * rig.yaw_offset
        side = elbow[1] / rig.yaw_link_1
        swing = branch.yaw * np.arccos(side)
    q4 = np.arctan2(-height, level)
    q1 = elbow[0] + rig.yaw_link_1 * np.sin(swing)
    joints = np.array(
        [q1, swing, yaw - swing - np.pi / 2, q4, pitch + np.pi / 2 - q4, np.broadcast_to(roll, np.shape(q1))]
    )
    return joints, np.isfinite(joints).all(axis=0)


def index_by_geometry(rig: Rig, tunnel: Tunnel, targets: Array, roll: Any) -> Array:
    """I1 from the distance of the corner to the centre. Shape (samples,)."""
    corner = corner_by_rotation(rig, targets, roll)
    return np.asarray((tunnel.weights / tunnel.ranges**2) @ (corner - tunnel.center[:, None]) ** 2)


def corner_by_rotation(rig: Rig, targets: Array, roll: Any) -> Array:
    """P_G from the rotation matrix of the tool, shape (3, samples)."""
    x, y, z, yaw, pitch = targets
    cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    tool_x = np.array([cy * cp, sy * cp, -sp])
    tool_z = np.array([sy * sr + cy * sp * cr, -cy * sr + sy * sp * cr, cp * cr])
    return np.asarray(np.array([x, y, z]) - rig.sting * tool_x + rig.goose_neck * tool_z)


def grid_minimum(
    rig: Rig, tunnel: Tunnel, targets: Array, branch: Branch, points: int, gain: float = 0.0, previous: Any = 0.0
) -> Array:
    """Least index over a dense grid of rolls within reach and limits; inf where no roll of the grid is."""
    best = np.full(targets.shape[1], np.inf)
    limited = bool(np.isfinite(rig.lower[5]))
    for roll in np.linspace(-np.pi, np.pi, points, endpoint=False):
        joints, inside = joints_by_geometry(rig, targets, roll, branch)
        inside &= (joints[0] >= rig.lower[0]) & (joints[0] <= rig.upper[0])
        for k in range(1, 5):
            if np.isfinite(rig.lower[k]):
                turn = (joints[k] - rig.lower[k]) % (2 * np.pi)
                inside &= turn <= rig.upper[k] - rig.lower[k]
        cost = index_by_geometry(rig, tunnel, targets, roll)
        for turn in range(-2, 3):
            full = roll + 2 * np.pi * turn
            if not limited or rig.lower[5] <= full <= rig.upper[5]:
                total = cost + gain * (full - previous) ** 2
                best = np.where(inside & (total < best), total, best)
    return best


def random_targets(rng: np.random.Generator, count: int) -> Array:
    """Targets about the reference rig, some of them out of reach. Shape (5, samples), m and rad."""
    spans = [(1.5, 3.0), (-0.8, 0.8), (-0.8, 0.8), (-0.9, 0.9), (-0.7, 0.7)]
    return np.array([rng.uniform(low, high, count) for low, high in spans])
