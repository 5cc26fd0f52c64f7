"""Collision-free joint paths of several homotopy classes, each shortened and locally optimised.

Random searches with different seeds find paths on different sides of obstacles. Two paths count as one class if one
deforms into the other through clear configurations along straight motions; of these the shorter one is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from models.checks import Array
from ocp.console import TimeLimitReached
from ocp.motion.sampling.path_optimisation import PathOptimisationSettings, optimise_length
from ocp.motion.sampling.random_trees import TreeSearch, connect
from ocp.motion.sampling.shortening import ShorteningSettings, path_length, same_class, shorten

__all__ = ["JointPath", "PathSearchSettings", "find_paths"]


@dataclass(frozen=True)
class PathSearchSettings:
    """Settings of the search for paths.

    Attributes:
        classes: Number of random searches after the first one that finds a path, each as long as that.
        first, attempts: Number of samples of the first search, and of searches. Every second one has twice as many
            samples as those before: the duration of a search varies so much that restarts shorten it.
        most_paths: Largest number of paths, one for each class, the shortest first.
        shortening, optimisation: Settings of both.
    """

    classes: int = 1
    first: int = 512
    attempts: int = 16
    most_paths: int = 3
    shortening: ShorteningSettings = field(default_factory=ShorteningSettings)
    optimisation: PathOptimisationSettings = field(default_factory=PathOptimisationSettings)


@dataclass(frozen=True, eq=False)
class JointPath:
    """Collision-free path of straight motions in joint space.

    Attributes:
        joints: Corners with both ends. Shape (M, n), rad or m.
        goal: Index of the goal where it ends.
        length: Length in the metric of the search.
    """

    joints: Array
    goal: int
    length: float


def find_paths(
    search: TreeSearch,
    start: Array,
    goals: Array,
    *,
    limits: tuple[Array, Array],
    seed: int,
    settings: PathSearchSettings = PathSearchSettings(),
) -> list[JointPath]:
    """Return collision-free paths from a start to goals, the shortest first; empty if none was found.

    If the straight motion to the nearest goal is clear, no path is shorter, and only straight motions are returned.

    Args:
        search: Proofs of clearance, sampled box and metric.
        start: Shape (n,). goals: Shape (K, n). Both keep the clearance.
        limits: Lower and upper limits of the joints. Shape (n,) each.
        seed: Seed of the random searches.
        settings: Settings.

    Raises:
        TimeLimitReached: The time limit has passed before a path was found.
    """
    motions, scale = search.motions, search.scale
    lengths = np.linalg.norm((goals - start) * scale, axis=1)
    clear = motions.are_clear(np.broadcast_to(start, goals.shape), goals)
    paths = [JointPath(np.array([start, goals[k]]), int(k), float(lengths[k])) for k in np.flatnonzero(clear)]
    paths.sort(key=lambda path: path.length)
    if len(paths) and paths[0].length <= lengths.min():
        return paths[: settings.most_paths]
    try:
        number, last, samples = 0, settings.attempts, settings.first
        while number < last:
            random = np.random.default_rng([seed, number])
            joints = connect(search, start, goals, random, samples)
            if joints is not None:
                joints = shorten(motions, joints, scale, random, settings.shortening)
                paths = _with_path(search, paths, _path_of(joints, goals, scale))
                last = min(last, number + 1 + settings.classes)
            number += 1
            if not paths and number % 2 == 0:
                samples *= 2
        for path in paths[: settings.most_paths]:
            joints = optimise_length(motions, path.joints, scale, limits, settings.optimisation)
            paths = _with_path(search, [p for p in paths if p is not path], _path_of(joints, goals, scale))
    except TimeLimitReached:
        if not paths:
            raise
    return paths[: settings.most_paths]


def _path_of(joints: Array, goals: Array, scale: Array) -> JointPath:
    goal = int(np.abs(goals - joints[-1]).max(axis=1).argmin())
    return JointPath(joints, goal, path_length(joints, scale))


def _with_path(search: TreeSearch, paths: list[JointPath], path: JointPath) -> list[JointPath]:
    """Return the paths with another one, the shortest first, and of each class the shortest only."""
    others = []
    for other in paths:
        if other.goal == path.goal and same_class(search.motions, other.joints, path.joints, search.scale):
            path = min(path, other, key=lambda each: each.length)
        else:
            others.append(other)
    return sorted([*others, path], key=lambda each: each.length)
