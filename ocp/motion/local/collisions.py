"""How near the bodies of a machine come to each other and to obstacles at samples of a motion.

Between the samples nothing is said: a plan's audit proves what holds there (:mod:`ocp.audit.clearance`).

Postures slid along their self-motions until no bodies touch.

Where joints are more than a task's rows, of the postures that do the task a sample may touch and others between not.
Each step moves what touches apart by damped least squares (Nakamura & Hanafusa 1986) in the null space of the task, and
puts the tips back on it. Slopes of distances are finite differences: depths of hulls have no better ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models import CollisionScene, Machine
from models.arrays import Array
from ocp.errors import ProblemError, checked_instance
from ocp.problem.hulls import BodyPairs, Hull, frames_of
from ocp.problem.values import Sampler

__all__ = ["Collision", "checked_collision_scene", "distances_along", "find_collisions", "hulls_of", "slid"]


class Collision(NamedTuple):
    """Two bodies that come too near.

    Attributes:
        pair: Its place in `CollisionScene.pairs`. bodies: Their names.
        distance: m, negative where they overlap. time: s.
    """

    pair: int
    bodies: tuple[str, str]
    distance: float
    time: float

    def __str__(self) -> str:
        how = f"overlap by {-self.distance:.3g} m" if self.distance < 0 else f"are {self.distance:.3g} m apart"
        return f"{self.bodies[0]} and {self.bodies[1]} {how} at {self.time:.4g} s"


def hulls_of(scene: CollisionScene) -> dict[str, Hull]:
    """The bodies and obstacles, by name."""
    return {
        body.name: Hull(body.frame, body.shape.core, body.shape.swelling, getattr(body.shape, "normal", np.zeros(0)))
        for body in scene.bodies
    }


def distances_along(scene: CollisionScene, base: Array, joints: Array, times: Array, near: float = np.inf) -> Array:
    """Distances of all pairs at samples of a motion; how deep those with a mesh or a cylinder overlap is told about.

    Shape (M, n), m.

    Args:
        scene: Of the machine that moves.
        base: Its base, shape (M, base_size) or (base_size,). joints: Shape (M, joint_size). times: s. Shape (M,).
        near: Of pairs that are no nearer than this, m, some number is told that is no less, and no more than they are.
    """
    count = len(joints)
    if not len(scene.pairs):
        return np.zeros((count, 0))
    placements, bodies = _prepared(scene)
    places = np.broadcast_to(base, (count, scene.machine.base_size))
    return bodies.distances(frames_of(placements(places, joints, np.reshape(times, (-1, 1)))[0]), near)


def find_collisions(scene: CollisionScene, base: Array, joints: Array, times: Array) -> list[Collision]:
    """The pairs that come nearer than the clearance at some samples, each where it is nearest, the worst first.

    Args: As of `distances_along`.
    """
    apart = distances_along(scene, base, joints, times, scene.clearance)
    if not apart.size:
        return []
    where, labels = apart.argmin(axis=0), scene.labels
    found = [
        Collision(pair, labels[pair], float(apart[where[pair], pair]), float(np.ravel(times)[where[pair]]))
        for pair in np.flatnonzero(apart.min(axis=0) < scene.clearance).tolist()
    ]
    return sorted(found, key=lambda touch: touch.distance)


def _prepared(scene: CollisionScene) -> tuple[Sampler, BodyPairs]:
    """Of base, joints and time the placements, and all pairs; kept with the surroundings."""
    kept: tuple[Sampler, BodyPairs] | None = scene.__dict__.get("_prepared")
    if kept is None:
        machine = scene.machine
        base, joints = ca.SX.sym("base", machine.base_size), ca.SX.sym("q", machine.joint_size)
        time = ca.SX.sym("time")
        placements = Sampler([base, joints, time], [ca.SX(scene.placements(base, joints, time))])
        hulls = tuple(hulls_of(scene).values())
        kept = placements, BodyPairs(hulls, scene.pairs, scene.covers)
        scene.__dict__["_prepared"] = kept
    return kept


def checked_collision_scene(value: Any, machine: Machine, limits: bool = True) -> CollisionScene:
    """Surroundings of a machine whose joints keep their limits, or do not, or ProblemError unless they are."""
    if checked_instance("scene", value, CollisionScene).machine is not machine:
        words = "surroundings are those of another machine; make them of this one: Surroundings(machine, ...)"
        raise ProblemError(words, name="scene", value=value)
    if value.limits and not limits:
        words = "surroundings keep the joints within their limits; make them without: Surroundings(..., limits=False)"
        raise ProblemError(words, name="scene", value=value)
    found: CollisionScene = value
    return found


@dataclass(frozen=True)
class SlidingSettings:
    """How postures are slid.

    Attributes:
        steps: At most.
        difference: Of finite differences, rad or m: the root of the distances' rounding, 1e-10 m.
        longest: Step of any joint, rad or m.
        damping: Relative to the size of the slopes.
        spare: By which what is slid is farther off than it has to be, so that putting the tips back leaves it clear, m.
    """

    steps: int = 12
    difference: float = 1e-5
    longest: float = 0.25
    damping: float = 0.1
    spare: float = 2e-3


def slid(
    scene: CollisionScene,
    base: Array,
    joints: Array,
    time: float,
    *,
    jacobian: Callable[[Array], Array],
    back: Callable[[Array], Array],
    lower: Array,
    upper: Array,
    settings: SlidingSettings = SlidingSettings(),
) -> Array:
    """Postures moved off what they touch, as far as that goes.

    Args:
        scene: Of the machine. base: Its base. Shape (base_size,). time: s.
        joints: Postures that do the task. Shape (K, n).
        jacobian: Of the task at a posture (n,). Shape (m, n).
        back: Postures (K, n) -> postures nearby that do the task again.
        lower, upper: Limits of the joints. Shape (n,).
        settings: How.

    Returns:
        Of each posture the one on its way whose least distance is largest. Shape (K, n).
    """
    count, n = joints.shape
    wanted = scene.clearance + settings.spare

    def measured(postures: Array) -> Array:
        """Of all pairs, those farther than is wanted not told how far. Shape (K, P)."""
        return distances_along(scene, base, postures, np.full(len(postures), time), near=wanted)

    best, at, depth = joints.copy(), joints.copy(), np.full(count, -np.inf)
    for _ in range(settings.steps):
        moved = (at[:, None] + settings.difference * np.eye(n)).reshape(-1, n)
        gaps = measured(at)
        least = gaps.min(axis=1)
        better = least > depth
        best[better], depth[better] = at[better], least[better]
        if (depth >= scene.clearance).any():
            break
        slopes = (measured(moved).reshape(count, n, -1) - gaps[:, None]) / settings.difference
        step = np.array([_step(*each, wanted, settings) for each in zip(map(jacobian, at), gaps, slopes, strict=True)])
        at = back(np.clip(at + step, lower, upper))
    return best


def _step(task: Array, gaps: Array, slopes: Array, wanted: float, settings: SlidingSettings) -> Array:
    """Joints (n,) that move what is too near apart, and the tips nowhere to first order."""
    close = gaps < wanted
    null = np.eye(task.shape[1]) - np.linalg.pinv(task) @ task
    rows = slopes[:, close].T @ null
    soft = settings.damping**2 * max(float((rows**2).sum(axis=1).max(initial=0.0)), 1e-12)
    step = rows.T @ np.linalg.solve(rows @ rows.T + soft * np.eye(len(rows)), wanted - gaps[close])
    return np.asarray(step * min(1.0, settings.longest / max(float(np.abs(step).max()), 1e-12)))
