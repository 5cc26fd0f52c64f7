"""Machines whose joint space is a room: a ball that slides along two or three axes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from models import Box, CollisionShape, FixedBase, Joint, Link, Robot
from models.checks import Array

RADIUS = 0.1
"""Of the ball, m."""


def slider(axes: int = 2, span: float = 2.0) -> FixedBase:
    """Return a ball that slides along axes of the room within +-span, m, at up to 1 m/s."""
    shape = CollisionShape("sphere", (RADIUS,))
    links = [Link("base"), *(Link(f"slide{k}") for k in range(axes - 1)), Link("ball", 1.0, collisions=(shape,))]
    joints = [
        Joint(
            "xyz"[k], kind="prismatic", parent=links[k].name, child=links[k + 1].name, axis=tuple(np.eye(3)[k]),
            lower=-span, upper=span, velocity=1.0,
        )
        for k in range(axes)
    ]  # fmt: skip
    return FixedBase(Robot(tuple(links), tuple(joints), tip="ball"))


def gap(points: Array, boxes: list[Box]) -> Array:
    """Return the distance of the ball at points (M, 2 or 3) from the nearest of some boxes, along the axes, m."""
    room = np.column_stack([points, np.zeros((len(points), 3 - points.shape[1]))])
    least = np.full(len(points), np.inf)
    for box in boxes:
        excess = np.abs(room - box.position) - np.asarray(box.size) / 2
        outside = np.linalg.norm(np.maximum(excess, 0.0), axis=1) + np.minimum(excess.max(axis=1), 0.0)
        least = np.minimum(least, outside - RADIUS)
    return least


def dense(path: Array, count: int = 400) -> Array:
    """Return points on the straight motions of a path (M, n)."""
    shares = np.linspace(0.0, 1.0, count)[:, None]
    return np.concatenate([a + shares * (b - a) for a, b in pairwise(path)])
