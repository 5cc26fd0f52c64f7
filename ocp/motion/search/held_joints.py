"""Joints that a plan keeps at rest: joints that move no task frame, and joints that also move other limbs.

A gripper, a head or another arm adds joints that no task determines. They are locked at the present position, or at a
free one near the middle of their limits, and the motion is planned for the machine that remains. Bodies that then
cannot move relative to each other are checked once. A joint is released only if a body that it moves obstructs the
motion.

A torso that carries the arm of a task carries other limbs as well. If an arm has more redundant degrees of freedom than
a global search can cover, such joints are held at rest. The lower bound is then one for motions with the torso at rest.
The last joint of an arm whose roll is free may affect nothing but itself. It is fixed at the start only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar
from warnings import warn

import numpy as np

from models import Machine, ModelWarning, Robot
from models.checks import Array
from models.shapes.bodies import RigidParts
from ocp.errors import ProblemError, SolveError
from ocp.motion.local.ik_solver import idle_positions
from ocp.motion.local.inverse_kinematics import Unreachable, sample_starts
from ocp.motion.search.configurations import (
    PlanRequest,
    check_clear_start,
    local_motions_from,
    lowest_cost_motion,
    start_collisions,
    start_configurations,
)
from ocp.motion.search.dead_end import DeadEnd
from ocp.motion.search.search import MAX_FREE_DIRECTIONS
from ocp.motion.tasks.checks import ignorable_joints
from ocp.motion.tasks.equations import bind

STIFFNESS = 1e6
"""Factor on the rate weights of joints shared with other limbs, which makes local motions hardly move these joints."""
Error = TypeVar("Error", bound=Exception)


def all_joints(robot: Robot, held: Mapping[str, float], values: Array, *, rates: bool = False) -> Array:
    """Return the positions or rates (..., n) of all joints from the values (..., m) of the joints not held at rest.

    Args:
        robot: Robot with all its joints.
        held: Positions of the held joints, rad or m, by name.
        values: Positions, or derivatives of them if `rates`, of the other joints in their order.
    """
    if not held:
        return values
    names = robot.joint_names
    constants = np.array([0.0 if rates else held.get(name, 0.0) for name in names])
    result = np.array(np.broadcast_to(constants, (*values.shape[:-1], len(names))))
    result[..., [name not in held for name in names]] = values
    return result


def hold_idle_joints(request: PlanRequest) -> PlanRequest:
    """Return a request that holds at rest the joints that move no task frame, at their start or mid-range positions."""
    idle = bind(request.machine, request.tasks).idle
    if idle.all():
        return request
    bounds, start = request.bounds, request.start
    positions = idle_positions(bounds.lower, bounds.upper) if start is None else start
    return request.with_held(_positions_by_name(request.machine, positions, np.flatnonzero(idle).tolist()))


def place_held_joints(whole: PlanRequest, request: PlanRequest) -> tuple[PlanRequest, Array]:
    """Choose collision-free positions of the joints held at rest; return the request and start configurations (K, m).

    Held joints stay where they are if any configuration is collision-free there. Otherwise they take the nearest
    sampled positions with a collision-free configuration. A global search may hold further joints, see
    `_hold_shared_joints`.

    Args:
        whole: Request before joints were held.
        request: Request with held joints.

    Raises:
        ProblemError: The start is in collision; or as in `start_configurations`.
    """
    configurations = start_configurations(request)
    placed = _place_idle_joints(whole, request, configurations)
    _check_held_bodies(whole, placed, configurations[0])
    if placed.start is not None:
        check_clear_start(placed, configurations)
    narrowed = _hold_shared_joints(placed, configurations)
    return narrowed, configurations if narrowed is request else start_configurations(narrowed)


def _place_idle_joints(whole: PlanRequest, request: PlanRequest, configurations: Array) -> PlanRequest:
    """Hold at rest the joints that move no task frame, at the nearest positions with a collision-free configuration.

    If held bodies of the machine collide with each other at all sampled positions, that is ignored. So are start
    configurations (K, m) whose collisions do not depend on the held joints, unless all have such collisions.
    """
    robot, own = whole.machine.robot, _own_held(whole, request)
    if whole.clearance_constraints is None or whole.start is not None or not own:
        return request
    choices = [own, *_nearest_positions(whole, own)]
    still = _still_pairs(whole, request)
    places = np.array([all_joints(robot, held, configurations[0]) for held in choices])
    apart = [collision is None for collision in start_collisions(whole, places, still)]
    allowed = [held for held, is_apart in zip(choices, apart, strict=True) if is_apart or not any(apart)]
    by_held = whole.clearance_constraints.scene.levers.joints[:, [name in own for name in robot.joint_names]] > 0
    pairs = np.setdiff1d(np.flatnonzero(by_held.any(axis=1)), still).tolist()
    others = np.setdiff1d(np.flatnonzero(~by_held.any(axis=1)), still).tolist()
    free = [each is None for each in start_collisions(whole, all_joints(robot, own, configurations), others)]
    configurations = configurations[free] if any(free) else configurations

    def clear(held: Mapping[str, float]) -> bool:
        return None in start_collisions(whole, all_joints(robot, held, configurations), pairs)

    best = next(filter(clear, allowed), own)
    return request if best is own else whole.with_held(best)


def _own_held(whole: PlanRequest, request: PlanRequest) -> dict[str, float]:
    """Return the positions of the joints that `request` holds at rest but the user's request `whole` does not."""
    return {name: position for name, position in request.held.items() if name not in whole.held}


def _still_pairs(whole: PlanRequest, request: PlanRequest) -> list[int]:
    """Return the indices of the body pairs whose relative pose the moving joints of a request cannot change."""
    assert whole.clearance_constraints is not None
    moving = [name not in request.held for name in whole.machine.robot.joint_names]
    levers = whole.clearance_constraints.scene.levers.joints[:, moving]
    return np.flatnonzero(~(levers > 0).any(axis=1)).tolist()


def _check_held_bodies(whole: PlanRequest, request: PlanRequest, configuration: Array) -> None:
    """Check for collisions at the start between bodies that the moving joints of the request cannot separate.

    Raises:
        ProblemError: A body collides with an obstacle.

    Warns:
        ModelWarning: Two bodies of the machine collide with each other, which changes nothing about the motion.
    """
    if whole.clearance_constraints is None or not request.held:
        return
    scene, robot = whole.clearance_constraints.scene, whole.machine.robot
    start = all_joints(robot, _own_held(whole, request), configuration)[None]
    still = _still_pairs(whole, request)
    with_obstacle = [pair for pair in still if scene.pairs[pair, 2] < 0]
    for pairs in (with_obstacle, sorted({*still} - {*with_obstacle})):
        if (collision := start_collisions(whole, start, pairs)[0]) is None:
            continue
        columns = np.flatnonzero(scene.levers.joints[collision.pair]).tolist()
        names = [name for name in (robot.joint_names[column] for column in columns) if name in request.held]
        where = ", ".join(f"{name!r} stays at {request.held[name]:.4g}" for name in names)
        words = f"{collision}, where {where}, since no task moves it; give a start with other positions, or ignore "
        words += f"this pair of bodies: ignored={[scene.pair_names(collision.pair)]}"
        details: dict[str, Any] = {"value": collision.distance, "limit": scene.clearance}
        if pairs is with_obstacle:
            raise ProblemError(words, name=" and ".join(collision.bodies), **details)
        warn(ModelWarning(words, name=" and ".join(collision.bodies), **details), stacklevel=2)


def fix_ignorable_joints(request: PlanRequest, configurations: Array) -> tuple[Array, Array]:
    """Return fixed start positions (n,) of the joints that have no effect on the tasks, and nan for all other joints.

    Also return the configurations with these joints fixed. An example of such an ignorable (cyclic) coordinate is the
    last joint of an arm whose roll about the tool's axis is free. If it were free, each motion would belong to a family
    of equal cost. It is therefore fixed in the middle of its range. If that puts every configuration in collision, it
    takes the values of a configuration, or random ones, for which most configurations are collision-free.
    """
    bounds = request.bounds
    start = np.full(request.machine.joint_size, np.nan)
    ignorable = np.ones(request.machine.joint_size, dtype=bool)
    for stretch in request.stretches:
        if stretch.equations is not None:
            ignorable &= ignorable_joints(stretch.equations, request.base)
    bounded = np.isfinite(bounds.upper - bounds.lower)
    start[ignorable] = np.where(bounded, idle_positions(bounds.lower, bounds.upper), configurations[0])[ignorable]

    def clear_count(values: Array) -> int:
        return start_collisions(request, np.where(ignorable, values, configurations)).count(None)

    if ignorable.any() and not clear_count(start):
        count, seed = request.settings.ik_starts, request.seed
        samples = sample_starts(request.machine, bounds.lower, bounds.upper, count, seed=seed)
        start[ignorable] = max((start, *configurations, *samples), key=clear_count)[ignorable]
    return start, np.where(ignorable, start, configurations)


def move_aside(whole: PlanRequest, request: PlanRequest, error: SolveError) -> PlanRequest | None:
    """Return a planning request whose joints at rest are moved out of the collision that an error reports.

    Args:
        whole: Request before joints were held.
        request: Request with held joints.
        error: Why no motion passes. A collision is named by its two bodies.

    Returns:
        The request with the nearest such positions; None if the start is given, or there are none.
    """
    names = _obstructing_joints(whole, request, error)
    if not names or whole.start is not None:
        return None
    assert whole.clearance_constraints is not None
    robot, levers, own = whole.machine.robot, whole.clearance_constraints.scene.levers.joints, _own_held(whole, request)
    columns = [robot.joint_names.index(name) for name in names]
    pairs = np.flatnonzero((levers[:, columns] > 0).any(axis=1)).tolist()
    motions = local_motions_from(request, start_configurations(request))
    joints = np.concatenate([motion.joints for motion in motions], axis=1)
    joints = joints[:, np.linspace(0, joints.shape[1] - 1, whole.settings.compared_samples).astype(int)]

    def clear(held: Mapping[str, float]) -> bool:
        samples = all_joints(robot, held, joints.reshape(-1, joints.shape[2]))
        free = np.array([collision is None for collision in start_collisions(whole, samples, pairs)])
        return bool(free.reshape(joints.shape[:2]).all(axis=1).any())

    elsewhere = ({**own, **held} for held in _nearest_positions(whole, {name: own[name] for name in names}))
    best = next(filter(clear, elsewhere), None)
    return None if best is None else whole.with_held(best)


def release_obstructing(whole: PlanRequest, request: PlanRequest, error: SolveError) -> PlanRequest | None:
    """Return a request that releases the held joints which move a colliding body; None if there are no such joints.

    Args: As in `move_aside`.
    """
    names = _obstructing_joints(whole, request, error)
    if not names or request.search == "global":
        return None
    return whole.with_held({name: place for name, place in _own_held(whole, request).items() if name not in names})


def _obstructing_joints(whole: PlanRequest, request: PlanRequest, error: SolveError) -> list[str]:
    """Return the names of the held joints that move one of the two bodies whose collision an error reports."""
    if whole.clearance_constraints is None:
        return []
    scene, own = whole.clearance_constraints.scene, _own_held(whole, request)
    pairs = [pair for pair, bodies in enumerate(scene.labels) if " and ".join(bodies) == error.name]
    columns = np.unique(np.nonzero(scene.levers.joints[pairs])[1]).tolist()
    return [name for name in (whole.machine.robot.joint_names[column] for column in columns) if name in own]


def _nearest_positions(whole: PlanRequest, held: Mapping[str, float]) -> list[dict[str, float]]:
    """Return random positions within limits for joints held at rest, sorted by distance from the present positions."""
    names, bounds = whole.machine.robot.joint_names, whole.bounds
    samples = sample_starts(whole.machine, bounds.lower, bounds.upper, whole.settings.ik_starts, seed=whole.seed)
    columns = [names.index(name) for name in held]
    order = np.argsort(np.abs(samples[:, columns] - np.array([*held.values()])).max(axis=1), kind="stable")
    return [_positions_by_name(whole.machine, sample, columns) for sample in samples[order]]


def _hold_shared_joints(request: PlanRequest, configurations: Array) -> PlanRequest:
    """Hold joints shared with other limbs at rest if the request has too many redundant joints for a global search.

    Only joints that carry a limb without a task are held, those nearest to the root first. They are held at the start
    of the motion if it is given, otherwise where the lowest-cost local motion begins that leaves them nearly still.

    Args:
        request: The request, without idle joints.
        configurations: Its joints at the start. Shape (K, n).
    """
    excess = request.redundancy - MAX_FREE_DIRECTIONS
    columns = _shared_joints(request)[: max(excess, 0)]
    if request.search != "global" or request.machine.base_size or excess <= 0 or len(columns) < excess:
        return request
    if request.start is not None:
        return request.with_held(_positions_by_name(request.machine, request.start, columns))
    weights = request.weights.copy()
    weights[columns] *= STIFFNESS
    motions = local_motions_from(replace(request, weights=weights), configurations)
    best, _ = lowest_cost_motion(motions)
    return request.with_held(_positions_by_name(request.machine, motions[0].joints[best, 0], columns))


def _shared_joints(request: PlanRequest) -> list[int]:
    """Return the indices of the joints that move a task frame and also another limb, sorted from the root outwards.

    A gripper at the end of an arm is no such limb: it is fixed to the part that carries the frame.
    """
    machine = request.whole or request.machine
    robot, parts = machine.robot, RigidParts.of(machine.robot)
    bound = bind(machine, request.tasks).bound
    ends = {parts.of_link[tip.robot.tip_link] for part in bound for tip in (part.tip, part.reference) if tip}
    path = {step.joint.child for end in ends for step in parts.path(parts.of_link[robot.root], end)[1]}
    limbs = [part for part, step in parts.step.items() if part not in path and step.above not in ends]
    carriers = {step.joint.name for limb in limbs for step in parts.path(parts.of_link[robot.root], limb)[1]}
    names, shared = request.machine.robot.joint_names, {name for name in carriers if robot.joint(name).child in path}
    return [column for column, name in enumerate(names) if name in shared]


def restore_error(error: Error, request: PlanRequest) -> Error:
    """Return an error in which configurations have been extended by the positions of the joints held at rest."""
    if request.whole is None:
        return error
    restore = partial(all_joints, request.whole.robot, request.held)
    if isinstance(error, Unreachable):
        error.joints = restore(error.joints)
    if isinstance(error, DeadEnd):
        error.obstructions = tuple(
            each._replace(before=restore(each.before), after=restore(each.after)) for each in error.obstructions
        )
        error.relaxations = tuple(each._replace(joints=restore(each.joints)) for each in error.relaxations)
    return error


def _positions_by_name(machine: Machine, joints: Array, columns: list[int]) -> dict[str, float]:
    return {machine.robot.joint_names[column]: float(joints[column]) for column in columns}
