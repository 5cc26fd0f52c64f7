"""Distances between the bodies of a machine and obstacles at samples of a motion, and their increase by self-motion.

Nothing is proven between the samples; the audit of a plan does that (:mod:`ocp.audit.clearance`). A redundant machine
can move IK solutions that are in collision along their self-motions: each step separates the colliding bodies by damped
least squares (Nakamura & Hanafusa 1986) in the null space of the task, and then corrects the tips. Gradients of
distances are finite differences, since penetration depths of hulls have no better ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import CollisionScene, Machine
from models.checks import Array
from ocp.errors import ProblemError, require
from ocp.problem.hulls import WORLD, BodyPairs, Frames, Hull, frames_of
from ocp.problem.values import Sampler
from ocp.tolerances import STANDSTILL


class Collision(NamedTuple):
    """Pair of bodies that are closer to each other than the clearance at a time of a motion."""

    pair: int  # index in `CollisionScene.pairs`
    bodies: tuple[str, str]
    distance: float  # m, negative if they overlap
    time: float  # s
    protrusion: float = 0.0  # how much closer the bodies are that cover meshes in separation constraints, m

    def __str__(self) -> str:
        how = f"overlap by {-self.distance:.3g} m" if self.distance < 0 else f"are {self.distance:.3g} m apart"
        return f"{self.bodies[0]} and {self.bodies[1]} {how} at {self.time:.4g} s"


def scene_hulls(scene: CollisionScene) -> dict[str, Hull]:
    """Return the shapes of the bodies and obstacles of a collision scene as convex hulls, by name."""
    return {
        body.name: Hull(
            body.frame, body.shape.core, body.shape.swept_radius, getattr(body.shape, "normal", np.zeros(0)), body.link
        )
        for body in scene.bodies
    }


def distances_along(
    scene: CollisionScene,
    base: Array,
    joints: Array,
    times: Array | float,
    *,
    cutoff: float = np.inf,
    pairs: Sequence[int] | None = None,
) -> Array:
    """Return the distances of all pairs of bodies at samples of a motion, m. Shape (M, pairs).

    The penetration depth of a pair with a mesh or a cylinder is an estimate.

    Args:
        base, joints, times: Samples of the motion; a base (base_size,) or a time that all samples share is enough.
        cutoff: For pairs farther apart than this, m, a lower bound of at least `cutoff` may be returned.
        pairs: Indices of the only pairs that count; the distances of the others are infinite. All if None.
    """
    count = len(joints)
    if not len(scene.pairs):
        return np.zeros((count, 0))
    placements, bodies = prepared_pairs(scene)
    bases = np.broadcast_to(base, (count, scene.machine.base_size))
    return bodies.distances(frames_of(placements(bases, joints, np.reshape(times, (-1, 1)))[0]), cutoff, pairs)


def near_pairs(
    scene: CollisionScene, joints: Array, reach: float, gradients: bool = True
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
    """Return the pairs of bodies in a scene of fixed obstacles that are closer than the clearance plus `reach`, m.

    Returns:
        Configuration, among (M, n) of a fixed base, and pair of each; its distance beyond the clearance, m, shape (K,);
            and the gradient of this distance, or 0 without `gradients`, shape (K, n).
    """
    bodies, n, near = prepared_pairs(scene)[1], joints.shape[1], scene.clearance + reach
    frames = _fixed_base_frames(scene, joints)
    at, pair = np.nonzero(bodies.all_balls(frames) < near)
    gap = bodies.gaps(frames, at, pair, near)
    at, pair, gap = at[gap < near], pair[gap < near], gap[gap < near]
    gradient = np.zeros((len(at), n))
    if gradients and len(at):
        # a distance is the largest gap along any direction: its derivative is that of the gap along the maximiser
        rows, index = np.unique(at, return_inverse=True)
        facing = bodies.nearest(frames, at, pair)[0]
        gap_now = bodies.chords(facing, frames, (at,))
        for joint, change in enumerate(SLIDING.difference * np.eye(n)):
            moved = bodies.chords(facing, _fixed_base_frames(scene, joints[rows] + change), (index,))
            gradient[:, joint] = (moved - gap_now) / SLIDING.difference
    return at, pair, gap - scene.clearance, gradient


def largest_changes(
    scene: CollisionScene,
    joints: Array,
    at: NDArray[np.intp],
    pair: NDArray[np.intp],
    *,
    box: tuple[Array, Array, Array],
) -> Array:
    """Return upper bounds (K,) on the change of body distances, m, within boxes of joint displacements.

    A displacement is d = T . t + e with |t_a| <= reach_a and |e_j| <= rest_j. A point p of a body then moves, relative
    to the other body, by no more than

        sum of reach_a |dp/dt_a| + lever . rest + (turn . |d|) (lever . |d|),

    with the levers and turns of the scene; the last term is half the bound of p'' in :mod:`ocp.problem.hulls`. The
    points are those of the cores, whose distances are greater by the radii of the bodies. Unlike lever . |d|, the first
    term is 0 for a body that the self-motion T leaves in place. The levers alone bound the change where the penetration
    depth is an estimate, which may be too large.

    Args:
        joints: Middle configurations of a machine on a fixed base. Shape (M, n).
        at, pair: Index of the configuration and of the pair of each of K distances.
        box: T, (M, n, r), the reach, (M, r), and the rest, (M, n).
    """
    tangents, reach, rest = box
    hulls, levers, step = [*scene_hulls(scene).values()], scene.levers, SLIDING.difference
    spans = (np.abs(tangents) * reach[:, None]).sum(axis=2)[at] + rest[at]
    arms, turns = levers.joints[pair], levers.joint_turns[pair]
    changes = (arms * rest[at]).sum(axis=1) + (turns * spans).sum(axis=1) * (arms * spans).sum(axis=1)
    rows, index = np.unique(at, return_inverse=True)
    for axis in range(tangents.shape[2]):
        shift = step * tangents[rows, :, axis]
        ends = [_fixed_base_frames(scene, joints[rows] + sign * shift) for sign in (1.0, -1.0)]
        for number in np.unique(pair).tolist():
            chosen = np.flatnonzero(pair == number)
            *bodies, observer = scene.pairs[number].tolist()
            if number in scene.covers or not _has_exact_depth(*(hulls[body] for body in bodies)):
                changes[chosen] = np.inf
                continue
            for hull in (hulls[body] for body in bodies if hulls[body].frame not in (observer, WORLD)):
                poses = [_relative_pose(each, index[chosen], hull.frame, observer) for each in ends]
                rotation, speed = ((first - last) / (2 * step) for first, last in zip(*poses, strict=True))
                moved = hull.core @ rotation.transpose(0, 2, 1) + speed[:, None]
                changes[chosen] += reach[at[chosen], axis] * np.linalg.norm(moved, axis=2).max(axis=1)
    return np.asarray(np.minimum(changes, (arms * spans).sum(axis=1)))


def _has_exact_depth(first: Hull, second: Hull) -> bool:
    """Return whether the penetration depth of two bodies is computed exactly: for half-spaces, segments and boxes."""
    return bool(first.normal.size or second.normal.size) or max(first.kind, second.kind) <= 2


def _relative_pose(frames: Frames, at: NDArray[np.intp], frame: int, observer: int) -> tuple[Array, Array]:
    """Return rotations (K, 3, 3) and positions (K, 3) of a frame at given samples, observed from another frame."""
    turn = frames.rotations[at, observer].transpose(0, 2, 1)
    offset = frames.positions[at, frame] - frames.positions[at, observer]
    return turn @ frames.rotations[at, frame], (turn @ offset[:, :, None])[:, :, 0]


def _fixed_base_frames(scene: CollisionScene, joints: Array) -> Frames:
    """Return the frames of all bodies at configurations (M, n) of a machine on a fixed base; no obstacle moves."""
    count = len(joints)
    return frames_of(prepared_pairs(scene)[0](np.zeros((count, 0)), joints, np.zeros((count, 1)))[0])


def find_collisions(scene: CollisionScene, base: Array, joints: Array, times: Array) -> list[Collision]:
    """Return the pairs of bodies that come closer than the clearance, at their closest samples, sorted by distance."""
    distances = distances_along(scene, base, joints, times, cutoff=scene.clearance)
    if not distances.size:
        return []
    pairs = np.flatnonzero(distances.min(axis=0) < scene.clearance)
    places = zip(distances.argmin(axis=0)[pairs].tolist(), pairs.tolist(), strict=True)
    collisions = [_collision_at(scene, place, distances[place], base, joints, times) for place in places]
    return sorted(collisions, key=lambda collision: collision.distance)


def worst_collisions(
    scene: CollisionScene, base: Array, joints: Array, times: Array, *, pairs: Sequence[int] | None = None
) -> list[Collision | None]:
    """Return for each sample the closest bodies that violate the clearance by more than rounding errors, or None."""
    distances = distances_along(scene, base, joints, times, cutoff=scene.clearance, pairs=pairs)
    worst = list[Collision | None]([None] * len(joints))
    for sample in np.flatnonzero(distances.min(axis=1, initial=np.inf) < scene.clearance - STANDSTILL).tolist():
        place = sample, int(distances[sample].argmin())
        worst[sample] = _collision_at(scene, place, distances[place], base, joints, times)
    return worst


def _collision_at(
    scene: CollisionScene, place: tuple[int, int], distance: float, base: Array, joints: Array, times: Array
) -> Collision:
    """Return the collision of a pair of bodies at a sample; `place` has the index of the sample and of the pair."""
    at, pair = place
    base, time = np.broadcast_to(base, (len(joints), scene.machine.base_size))[at], float(np.ravel(times)[at])
    covers = pair in scene.cover_pairs
    protrusion = float(distance) - _cover_distance(scene, pair, base, joints[at], time) if covers else 0.0
    return Collision(pair, scene.labels[pair], float(distance), time, protrusion)


def _cover_distance(scene: CollisionScene, pair: int, base: Array, joints: Array, time: float) -> float:
    """Return the smallest distance between the convex shapes that cover the two bodies of a pair, m."""
    frames = frames_of(prepared_pairs(scene)[0](base[None], joints[None], np.full((1, 1), time))[0])
    rows = np.array([(*covers, scene.pairs[pair, 2]) for covers in scene.cover_pairs[pair]])
    return float(BodyPairs([*scene_hulls(scene).values()], rows, {}).distances(frames).min())


def prepared_pairs(scene: CollisionScene) -> tuple[Sampler, BodyPairs]:
    """Return two cached functions of a scene: body frames from (base, joints, time), and distances from frames."""
    cached: tuple[Sampler, BodyPairs] | None = scene.__dict__.get("_prepared")
    if cached is None:
        machine = scene.machine
        base, joints = ca.SX.sym("base", machine.base_size), ca.SX.sym("q", machine.joint_size)
        time = ca.SX.sym("time")
        placements = Sampler([base, joints, time], [ca.SX(scene.placements(base, joints, time))])
        cached = placements, BodyPairs(tuple(scene_hulls(scene).values()), scene.pairs, scene.covers)
        scene.__dict__["_prepared"] = cached
    return cached


def checked_collision_scene(value: Any, machine: Machine, limits: bool = True) -> CollisionScene:
    """Return a collision scene; raise ProblemError if it is of another machine, or assumes limits that do not hold."""
    if require.instance("scene", value, CollisionScene).machine is not machine:
        words = "scene belongs to another machine; build it from this one: CollisionScene(machine, ...)"
        raise ProblemError(words, name="scene", value=value)
    if value.limits and not limits:
        words = "scene assumes joints within their limits; build it without: CollisionScene(..., limits=False)"
        raise ProblemError(words, name="scene", value=value)
    scene: CollisionScene = value
    return scene


@dataclass(frozen=True)
class SlidingSettings:
    """Settings of `slide_apart`, which moves configurations out of collision along self-motions."""

    steps: int = 12  # largest number of steps
    difference: float = 1e-5  # step of the finite differences, rad or m: the root of the rounding error of distances
    longest: float = 0.25  # longest step of a joint, rad or m
    damping: float = 0.1  # damping relative to the size of the gradients
    spare: float = 2e-3  # distance beyond the clearance that correcting the tips may use up, m


SLIDING = SlidingSettings()


def slide_apart(
    scene: CollisionScene,
    base: Array,
    joints: Array,
    time: float,
    *,
    jacobian: Callable[[Array], Array],
    back: Callable[[Array], Array],
    lower: Array,
    upper: Array,
) -> Array:
    """Move configurations (K, n) out of collision along their self-motion manifolds, as far as necessary or possible.

    Return the configurations on these paths with the largest minimum distances. `jacobian` gives the Jacobian (m, n) of
    the task at a configuration (n,), and `back` moves configurations to nearby ones that satisfy the task again.
    """
    count, n = joints.shape
    target = scene.clearance + SLIDING.spare

    def distances(configurations: Array) -> Array:
        """Return the distances (K, P) of all pairs of bodies; beyond the distance `target` lower bounds suffice."""
        return distances_along(scene, base, configurations, np.full(len(configurations), time), cutoff=target)

    best, current, clearance = joints.copy(), joints.copy(), np.full(count, -np.inf)
    for _ in range(SLIDING.steps):
        perturbed = (current[:, None] + SLIDING.difference * np.eye(n)).reshape(-1, n)
        gaps = distances(current)
        minimum = gaps.min(axis=1)
        better = minimum > clearance
        best[better], clearance[better] = current[better], minimum[better]
        if (clearance >= scene.clearance).any():
            break
        gradients = (distances(perturbed).reshape(count, n, -1) - gaps[:, None]) / SLIDING.difference
        closeness = zip(map(jacobian, current), gaps, gradients, strict=True)
        step = np.array([_separating_step(*each, target) for each in closeness])
        current = back(np.clip(current + step, lower, upper))
    return best


def _separating_step(jacobian: Array, distances: Array, gradients: Array, target: float) -> Array:
    """Return a joint step (n,) that separates close bodies and, to first order, leaves the tips in place."""
    close = distances < target
    projector = np.eye(jacobian.shape[1]) - np.linalg.pinv(jacobian) @ jacobian
    rows = gradients[:, close].T @ projector
    regularisation = SLIDING.damping**2 * max(float((rows**2).sum(axis=1).max(initial=0.0)), 1e-12)
    step = rows.T @ np.linalg.solve(rows @ rows.T + regularisation * np.eye(len(rows)), target - distances[close])
    return np.asarray(step * min(1.0, SLIDING.longest / max(float(np.abs(step).max()), 1e-12)))
