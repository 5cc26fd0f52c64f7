"""Collision-free joint paths of several homotopy classes, found by random trees, shortened and locally optimised.

Two trees of straight motions grow from the start and from the goals towards random configurations, and towards each
other (RRT-Connect: Kuffner & LaValle 2000). Every edge is proven clear (`ocp.motion.sampling.joint_paths`), many at
once: an edge of a Panda among boxes takes 0.5 ms in a batch and 9 ms by itself.

Searches with different seeds find paths on different sides of obstacles. Two paths count as one class if one deforms
into the other through clear configurations along straight motions; of these the shorter one is kept.

The planners of OMPL are not used: they ask Python for one edge at a time, so that batches are impossible, and they
accept a seed only once for each process, so that a repeated call has another result.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.checks import Array
from ocp.console import TimeLimitReached, check_time
from ocp.motion.sampling.joint_paths import (
    StraightMotions,
    optimise_length,
    path_length,
    same_class,
    shorten,
)  # fmt: skip

Indices = NDArray[np.intp]


TREE_BATCH = 16  # number of random configurations towards which a tree grows at once
LONGEST_EDGE_SHARE = 0.05  # longest edge of a tree, as a share of the diagonal of the sampled range of configurations


@dataclass(frozen=True, eq=False)
class TreeSearch:
    """Problem of finding a collision-free joint path from a start to one of several goals by random trees.

    Attributes:
        motions: Proofs of clearance.
        start, goals: Configurations, which keep the clearance. Shapes (n,), (K, n), rad or m.
        lower, upper: Range from which configurations are sampled; it contains start and goals. Shape (n,), rad or m.
        scale: Distances are lengths of scale * dq. Shape (n,).
    """

    motions: StraightMotions
    start: Array
    goals: Array
    lower: Array
    upper: Array
    scale: Array

    def path(self, joints: Array) -> JointPath:
        """Convert the corners (M, n) of a path to a `JointPath`, with the path's length and the index of its goal."""
        goal = int(np.abs(self.goals - joints[-1]).max(axis=1).argmin())
        return JointPath(joints, goal, path_length(joints, self.scale))


class _Tree:
    """Random tree of configurations, in which each node stores the index of its parent."""

    def __init__(self, roots: Array) -> None:
        self.nodes, self.parents = roots.copy(), np.full(len(roots), -1)

    def add(self, nodes: Array, parents: Indices) -> Indices:
        """Add configurations as nodes of the tree and return their indices."""
        first = len(self.nodes)
        self.nodes, self.parents = np.vstack([self.nodes, nodes]), np.append(self.parents, parents)
        return np.arange(first, len(self.nodes))

    def nearest(self, joints: Array, scale: Array) -> Indices:
        """Return, for each of K configurations (K, n), the index of the nearest node of the tree."""
        nodes, points = self.nodes * scale, joints * scale
        return np.asarray(((nodes**2).sum(axis=1) - 2 * points @ nodes.T).argmin(axis=1))

    def branch(self, index: int) -> Array:
        """Return the path in the tree from a node to its root. Shape (K, n)."""
        indices = [index]
        while self.parents[indices[-1]] >= 0:
            indices.append(int(self.parents[indices[-1]]))
        return self.nodes[indices]


def connect(search: TreeSearch, *, random: np.random.Generator, most_samples: int) -> Array | None:
    """Return a path of proven collision-free straight motions from the start to a goal; None if none is found.

    Args:
        search: Start, goals, proofs of clearance, sampled range and metric.
        random: Source of the samples.
        most_samples: Number of random configurations after which the search ends.

    Returns:
        Configurations, shape (M, n), or None after the largest number, which does not prove that there is no path.

    Raises:
        TimeLimitReached: The time limit has passed.
    """
    lower, upper = search.lower, search.upper
    step = LONGEST_EDGE_SHARE * float(np.linalg.norm((upper - lower) * search.scale))
    trees = _Tree(search.start[None]), _Tree(search.goals)
    growing, tried = 0, 0
    while tried < most_samples:
        check_time()
        tried += TREE_BATCH
        tree, other = trees[growing], trees[1 - growing]
        samples = lower + (upper - lower) * random.random((TREE_BATCH, len(lower)))
        parents = tree.nearest(samples, search.scale)
        nodes = _step_towards(tree.nodes[parents], samples, step, search.scale)
        clear = search.motions.are_clear(tree.nodes[parents], nodes)
        new = tree.add(nodes[clear], parents[clear])
        if len(new):
            targets = other.nearest(tree.nodes[new], search.scale)
            met = _grow_to(search, tree, new, other.nodes[targets], step)
            if met is not None:
                place, index = met
                path = np.vstack([tree.branch(index)[::-1], other.branch(int(targets[place]))[1:]])
                return path if growing == 0 else path[::-1].copy()
        growing = int(len(trees[0].nodes) > len(trees[1].nodes))
    return None


def _step_towards(starts: Array, targets: Array, step: float, scale: Array) -> Array:
    """Return configurations (K, n) moved towards their targets by at most the step length of a random tree."""
    length = np.linalg.norm((targets - starts) * scale, axis=1, keepdims=True)
    return np.where(length <= step, targets, starts + (targets - starts) * (step / np.maximum(length, step)))


def _grow_to(search: TreeSearch, tree: _Tree, new: Indices, targets: Array, step: float) -> tuple[int, int] | None:
    """Extend a random tree step by step from new nodes towards target nodes (K, n) of another tree.

    Return the index of the first target that is reached and the tree's node there; None if no target is reached.
    """
    places = np.arange(len(new))
    while len(places):
        starts = tree.nodes[new]
        ends = _step_towards(starts, targets[places], step, search.scale)
        clear = search.motions.are_clear(starts, ends)
        places, parents, ends = places[clear], new[clear], ends[clear]
        new = tree.add(ends, parents)
        reached = np.flatnonzero((ends == targets[places]).all(axis=1))
        if len(reached):
            return int(places[reached[0]]), int(new[reached[0]])
    return None


@dataclass(frozen=True)
class PathSearchSettings:
    """Settings of `find_paths`: numbers of random searches, of their samples and of paths.

    Attributes:
        classes: Number of random searches after the first one that finds a path, each as long as that.
        first, attempts: Number of samples of the first search, and of searches. Every second one has twice as many
            samples as those before: the duration of a search varies so much that restarts shorten it.
        most_paths: Largest number of paths, one for each class, the shortest first.
    """

    classes: int = 1
    first: int = 512
    attempts: int = 16
    most_paths: int = 3


@dataclass(frozen=True, eq=False)
class JointPath:
    """Collision-free path of straight motions in joint space, with its length.

    Attributes:
        joints: Corners with both ends. Shape (M, n), rad or m.
        goal: Index of the goal where it ends.
        length: Length in the metric of the search.
    """

    joints: Array
    goal: int
    length: float


def find_paths(
    search: TreeSearch, *, limits: tuple[Array, Array], seed: int, settings: PathSearchSettings = PathSearchSettings()
) -> list[JointPath]:
    """Return collision-free joint paths from a start to goals, sorted by length; empty if none was found.

    If the straight motion to the nearest goal is clear, no path is shorter, and only straight motions are returned.

    Args:
        search: Start, goals, proofs of clearance, sampled range and metric.
        limits: Lower and upper limits of the joints. Shape (n,) each.
        seed: Seed of the random searches.

    Raises:
        TimeLimitReached: The time limit has passed before a path was found.
    """
    motions, paths = search.motions, list[JointPath]()
    try:
        for path in search_paths(search, seed=seed, settings=settings):
            paths = _with_path(search, paths, path)
        for path in paths[: settings.most_paths]:
            joints = optimise_length(motions, path.joints, search.scale, limits=limits)
            paths = _with_path(search, [p for p in paths if p is not path], search.path(joints))
    except TimeLimitReached:
        if not paths:
            raise
    return paths[: settings.most_paths]


def search_paths(search: TreeSearch, *, seed: int, settings: PathSearchSettings) -> Iterator[JointPath]:
    """Yield collision-free paths from a start to goals as they are found, shortened but not yet optimised.

    Raises:
        TimeLimitReached: The time limit has passed.
    """
    motions, start, goals = search.motions, search.start, search.goals
    clear = motions.are_clear(np.broadcast_to(start, goals.shape), goals)
    paths = [search.path(np.array([start, goal])) for goal in goals]
    straight = sorted((paths[k] for k in np.flatnonzero(clear)), key=lambda path: path.length)
    yield from straight[: settings.most_paths]
    if straight and straight[0].length <= min(path.length for path in paths):
        return
    number, last, samples, has_path = 0, settings.attempts, settings.first, bool(straight)
    while number < last:
        random = np.random.default_rng([seed, number])
        joints = connect(search, random=random, most_samples=samples)
        number += 1
        if joints is not None:
            has_path, last = True, min(last, number + settings.classes)
            yield search.path(shorten(motions, joints, search.scale, random=random))
        if not has_path and number % 2 == 0:
            samples *= 2


def _with_path(search: TreeSearch, paths: list[JointPath], path: JointPath) -> list[JointPath]:
    """Add a path to a list sorted by length, which keeps only the shortest path of each homotopy class."""
    others = []
    for other in paths:
        if other.goal == path.goal and same_class(search.motions, other.joints, path.joints, search.scale):
            path = min(path, other, key=lambda each: each.length)
        else:
            others.append(other)
    return sorted([*others, path], key=lambda each: each.length)
