"""Why there is no capture, said before one is planned: bounds that hold whatever the chaser does.

The grasp may be farther off than the arm reaches and thrusters push. And both may have more momentum than is stored or
taken away in the time. At rest all of it is in the rotors. A wheel holds h a, |h| <= I w, and no more than its motor
gives it; a gyro h s, turned about its gimbal's axis g as far as that gets. What all hold along a direction u at most,

    s(u) = sum of h |a u| + sum of h |u - g g u| cos(angle that is left to it),

is convex, and homogeneous. Turned, the base brings the momentum along any axis of its own: what counts is the greatest
s(u) of all unit vectors. Thrusters change the momentum about the common centre of mass c by their forces f <= F,

    |L'| <= most |sum of f (p - o) x d| + |c - o| most |sum of f d|,

with o fixed in the base, from which c is no farther than arm and target take it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import FreeFloating, Robot, Thruster, center_of_mass, link_frames, wheels_of
from models.arrays import Array
from ocp.errors import ProblemError
from ocp.tasks.limits import JointBounds

__all__ = ["Start", "greatest", "held_by_rotors", "require_reach", "require_room"]

ROOM = 1e-9
"""Share by which a momentum may be greater than what can be held: rounding."""
CLOSE, MOST = 1e-7, 200_000
"""Relative, how near a bound comes to what it bounds, if that takes no more triangles."""
CORNERS = np.vstack([np.eye(3), -np.eye(3)])
FACES = CORNERS[[[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]]
"""Of an octahedron. Shape (8, 3, 3)."""

Support = Callable[[Array], Array]
"""How far a set reaches along unit vectors (N, 3): (N,)."""


class Start(NamedTuple):
    """Where a capture begins, and until when it may take.

    Attributes:
        base, joints, velocities: Of the chaser; velocities that are free are nan.
        target_base: Configuration of the target.
        approach, detumble: How long the phases last at most, s.
    """

    base: Array
    joints: Array
    velocities: Array
    target_base: Array
    approach: float
    detumble: float


def greatest(support: Support) -> float:
    """The size of the largest element of a convex set, never less than that: the greatest support of all unit vectors.

    Where a ray crosses a triangle of unit vectors, a convex support is no more than the largest at the corners, and the
    triangle nowhere nearer to the origin than its plane. What may be larger than the largest that is found is split.
    """
    faces, found = FACES, 0.0
    while True:
        values = support(faces.reshape(-1, 3)).reshape(-1, 3).max(axis=1)
        found = max(found, float(values.max()))
        normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
        distances = np.abs(np.sum(normals * faces[:, 0], axis=1)) / np.linalg.norm(normals, axis=1)
        bounds = values / distances
        left = bounds > found * (1 + CLOSE)
        if not left.any():
            return found * (1 + CLOSE)
        if 4 * np.count_nonzero(left) > MOST:
            return float(bounds.max())
        a, b, c = np.swapaxes(faces[left], 0, 1)
        middles = [(a + b) / 2, (b + c) / 2, (c + a) / 2]
        ab, bc, ac = (middle / np.linalg.norm(middle, axis=1)[:, None] for middle in middles)
        parts = [(a, ab, ac), (ab, b, bc), (ac, bc, c), (ab, bc, ac)]
        faces = np.concatenate([np.stack(part, axis=1) for part in parts])


def _most(machine: FreeFloating, support: Support) -> float:
    """Of momenta, which a planar base turns about z alone."""
    if machine.base == "planar":
        return float(support(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])).max())
    return greatest(support)


def held_by_rotors(
    machine: FreeFloating, bounds: JointBounds, steady: NDArray[np.bool_], start: Start, drives_alone: bool = True
) -> Support:
    """Angular momentum that the rotors of a chaser hold at most along directions of its base at rest, N m s.

    Args:
        bounds: Of its joints.
        steady: Whether joints keep the speed with which they start. Shape (n,).
        start: Of the capture.
        drives_alone: Whether nothing but its motor turns a rotor about its axis: there is no friction.
    """
    robot, time = machine.robot, start.approach + start.detumble
    names = list(robot.joint_names)
    known = not np.isnan(start.velocities).any()
    spin = np.zeros(3)
    if known:
        twist = np.array(ca.DM(machine.base_twist(start.base, start.joints, start.velocities))).ravel()
        whole = (np.eye(6)[:, machine.twist_rows] @ twist)[:3]
        spin = np.array(ca.DM(machine.world_from_base(start.base).rotation)).T @ whole
    wheels, rotors = wheels_of(robot), []
    loose = np.inf if {name for name, kept in zip(names, steady, strict=True) if kept} - set(wheels) else 0.0
    for name, inertia in wheels.items():
        wheel, k = robot.joint(name), names.index(name)
        speed, kept = start.velocities[k], steady[k] and not np.isnan(start.velocities[k])
        size = inertia * (abs(speed) if kept else np.inf if steady[k] else bounds.velocity[k])
        carrying = [joint for joint in robot.path_to(wheel.parent) if joint.moves and joint.kind != "prismatic"]
        if len(carrying) > 1 or any(joint.mimic is not None for joint in carrying):
            loose += size
            continue
        angles, left = start.joints.copy(), 0.0
        if carrying:
            i = names.index(carrying[0].name)
            reach = np.inf if steady[i] else bounds.velocity[i] * time
            low, high = max(bounds.lower[i], angles[i] - reach), min(bounds.upper[i], angles[i] + reach)
            left = min((high - low) / 2, np.pi)
            angles[i] = (low + high) / 2 if np.isfinite(high - low) else 0.0
        frames = link_frames(robot, ca.DM(angles))
        axis = np.array(ca.DM(frames[wheel.parent].rotation)) @ np.asarray(wheel.rotation) @ np.asarray(wheel.axis)
        about = axis
        if carrying:
            about = np.array(ca.DM(frames[carrying[0].child].rotation)) @ np.asarray(carrying[0].axis)
        elif known and drives_alone and not kept:
            size = min(size, inertia * abs(speed + axis @ spin) + bounds.torque[k] * time)
        signs = (float(np.sign(speed)),) if kept else (1.0, -1.0)
        rotors.append(_Rotor(size, signs, about, axis, left))

    def support(directions: Array) -> Array:
        return np.asarray(loose + sum((rotor.along(directions) for rotor in rotors), np.zeros(len(directions))))

    return support


class _Rotor(NamedTuple):
    """Momentum of some size along an axis, to one side or either, that turns about another by some angle each way."""

    size: float
    signs: tuple[float, ...]
    about: Array
    axis: Array
    left: float

    def along(self, directions: Array) -> Array:
        out = directions @ self.about
        flat = directions - out[:, None] * self.about
        share = float(self.axis @ self.about)
        across = self.axis - share * self.about
        found = []
        for sign in self.signs:
            angle = np.arctan2(flat @ np.cross(self.about, sign * across), flat @ (sign * across))
            turned = np.cos(np.maximum(np.abs(angle) - self.left, 0.0))
            length = np.linalg.norm(across) * np.linalg.norm(flat, axis=1)
            found.append(sign * share * out + length * turned)
        return np.asarray(self.size * np.max(found, axis=0))


def require_room(
    chaser: FreeFloating,
    target: FreeFloating,
    momentum: Array,
    start: Start,
    held: Support,
    thrusters: Sequence[Thruster] = (),
) -> None:
    """Raise where rotors cannot hold the angular momentum, whatever the attitude of the base at the end.

    Args:
        momentum: Of both, at the start, as of `pair_momentum`.
        held: What the rotors hold, as of `held_by_rotors`.
        thrusters: What changes the momentum.
    """
    size = float(np.linalg.norm(np.asarray(momentum)[[k for k, row in enumerate(chaser.twist_rows) if row < 3]]))
    if not np.isfinite(held(CORNERS)).all():
        return
    stored = _most(chaser, held)
    taken = _impulse(chaser, target, thrusters, start) if thrusters else 0.0
    most = stored + taken
    if size > most * (1 + ROOM) + ROOM:
        pushed = f" and thrusters take away {taken:.6g} in the time" if thrusters else ""
        words = (
            f"capture: the pair has an angular momentum of {size:.6g} N m s, of which the wheels and gyros hold "
            f"{stored:.6g}{pushed} at most: {size - most:.6g} N m s are missing for it to come to rest. Thrusters, "
            "other wheels, more time, momentum of the chaser against that of the target, or rest=False help"
        )
        raise ProblemError(words, name="momentum", value=size, limit=most)


def _impulse(chaser: FreeFloating, target: FreeFloating, thrusters: Sequence[Thruster], start: Start) -> float:
    """By how much thrusters change the angular momentum of both at most, N m s.

    The two centres of mass part by no more than they do at both ends of the approach, and what thrusters push them off
    the chord between, F t (T - t) / 2 m.
    """
    robot = chaser.robot
    middle = np.asarray(robot.link(robot.root).center_of_mass)
    turning, push = _pushes(robot, thrusters, middle)
    moment, force = _most(chaser, turning), greatest(push)
    others = [link for link in robot.links if link.mass and link.name != robot.root]
    own = sum(link.mass * (_longest(robot, link.name, link.center_of_mass) + np.linalg.norm(middle)) for link in others)
    off, arm = float(own) / robot.total_mass, _arm(chaser, target)
    share = target.robot.total_mass / (robot.total_mass + target.robot.total_mass)
    way, _ = _apart(chaser, target, start)
    parted = max(float(np.linalg.norm(way)), arm) * start.approach
    parted += force / robot.total_mass * start.approach**3 / 12
    return float(
        start.approach * (moment + force * off)
        + force * share * parted
        + start.detumble * (moment + force * (off + share * arm))
    )


def _pushes(robot: Robot, thrusters: Sequence[Thruster], middle: Array) -> tuple[Support, Support]:
    """Moments about a point of the base, and forces, that thrusters give together along its directions at most."""
    frames = link_frames(robot, ca.DM(robot.dof, 1))
    moments, forces, loose = [], [], np.zeros(2)
    for each in thrusters:
        if any(joint.moves for joint in robot.path_to(each.link)):
            lever = _longest(robot, each.link, each.point) + np.linalg.norm(middle)
            loose += each.force * np.array([lever, 1.0])
            continue
        frame = frames[each.link]
        along = each.force * np.array(ca.DM(frame.rotation)) @ np.asarray(each.direction)
        forces.append(along)
        moments.append(np.cross(np.array(ca.DM(frame.point(each.point))).ravel() - middle, along))

    def reaching(vectors: list[Array], more: float) -> Support:
        sides = np.reshape(vectors, (-1, 3)).T
        return lambda directions: more + np.maximum(directions @ sides, 0.0).sum(axis=1)

    return reaching(moments, loose[0]), reaching(forces, loose[1])


def require_reach(
    chaser: FreeFloating, target: FreeFloating, start: Start, earliest: float, thrusters: Sequence[Thruster] = ()
) -> None:
    """Raise where the grasp is too far off for the arm at any time.

    Both centres of mass go on as they do, w + v t, but for what thrusters push the chaser, F t^2 / 2 m. The tip is no
    farther from the chaser's centre of mass than all joints in a line take it.

    Args:
        start: With the latest time of the grasp. earliest: The earliest, s.
    """
    arm = _arm(chaser, target)
    pushed = greatest(_pushes(chaser.robot, thrusters, np.zeros(3))[1]) / chaser.robot.total_mass if thrusters else 0.0
    way, drift = _apart(chaser, target, start)
    square, reach = np.polynomial.Polynomial([way @ way, 2 * way @ drift, drift @ drift]), [arm, 0.0, pushed / 2]
    bent = (square - np.polynomial.Polynomial(reach) ** 2).deriv().roots()
    times = [earliest, start.approach, *bent[np.isreal(bent)].real]
    times = [time for time in times if earliest <= time <= start.approach]
    off = min(float(np.sqrt(max(square(time), 0.0))) - pushed * time**2 / 2 for time in times)
    if off > arm * (1 + ROOM):
        words = (
            f"capture: the centres of mass of chaser and target are {off:.4g} m apart or more, and the arm reaches "
            f"{arm:.4g} m at most: {off - arm:.4g} m are missing. Start nearer, let them drift together, or give "
            "thrusters"
        )
        raise ProblemError(words, name="reach", value=off, limit=arm)


def _apart(chaser: FreeFloating, target: FreeFloating, start: Start) -> tuple[Array, Array]:
    """From the chaser's centre of mass to the target's, m, and how fast that changes. Shape (3,) each."""
    centers, speeds = [], []
    for machine, base, joints in ((target, start.target_base, np.zeros(0)), (chaser, start.base, start.joints)):
        center = center_of_mass(machine.robot, ca.DM(joints), machine.world_from_base(ca.DM(base)))
        centers.append(np.array(ca.DM(center)).ravel())
        momentum = np.eye(6)[:, machine.twist_rows] @ np.asarray(machine.conserved_momentum)
        speeds.append(momentum[3:] / machine.robot.total_mass)
    return centers[0] - centers[1], speeds[0] - speeds[1]


def _arm(chaser: FreeFloating, target: FreeFloating) -> float:
    """How far apart the centres of mass of both are at most while the tip holds the grasp, m."""
    robot, body = chaser.robot, target.robot
    middle = sum(link.mass * _longest(robot, link.name, link.center_of_mass) for link in robot.links if link.mass)
    arm = _longest(robot, str(robot.tip_link), robot.tip_translation) + middle / robot.total_mass
    return arm + float(np.linalg.norm(np.subtract(body.tip_translation, body.links[0].center_of_mass)))


def _longest(robot: Robot, link: str, point: object) -> float:
    """How far a point of a link is from the root's origin at most, m; inf beyond a slide without limits."""
    found = float(np.linalg.norm(np.asarray(point, dtype=float)))
    for joint in robot.path_to(link):
        slides = max(abs(joint.lower), abs(joint.upper)) if joint.kind == "prismatic" else 0.0
        found += float(np.linalg.norm(joint.translation)) + slides
    return found
