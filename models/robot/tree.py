"""Kinematic trees: root, order of the joints, change of the root, mimic joints, joints with several degrees of freedom.

The position of a mimic joint, or follower, is multiplier times that of the joint it mimics, plus offset. Mimic joints
may mimic each other in a chain. Only the joint at its end, the leader, has an entry in the joint vector.

Planar and floating joints become chains of joints with one degree of freedom on massless links, "NAME_x" and so on: x,
y and angle; or x, y, z, yaw, pitch and roll, with the rotation Rz(yaw) Ry(pitch) Rx(roll), singular at a pitch of
+-pi/2.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias
from warnings import warn

import numpy as np

from models.checks import Array, require
from models.errors import ModelError, ModelWarning
from models.robot.parts import Joint, Kind, Link, Mimic
from models.spatial import least_rotation


def require_unique(names: Iterable[str], kind: str) -> None:
    """Raise ModelError if a name of a link or joint occurs more than once."""
    for name, count in Counter(names).items():
        if count > 1:
            message = f"{kind} name {name!r} is used more than once; give every {kind} its own name"
            raise ModelError(message, name=name, value=count, limit=1)


def find_root(links: Sequence[str], edges: Sequence[tuple[str, str, str]]) -> str:
    """Return the root of a kinematic tree, the only link that is not the child of a joint.

    Args:
        links: Names of the links, unique.
        edges: (joint, parent link, child link) of every joint.

    Raises:
        ModelError: Unknown link name, a link with two parents, no root (a loop), several roots.
    """
    if not links:
        raise ModelError("a robot needs at least one link", name="link", value=0, limit=1)
    known = set(links)
    parent_joint: dict[str, str] = {}
    for joint, parent, child in edges:
        for role, link in (("parent", parent), ("child", child)):
            if link not in known:
                raise require.unknown(f"joint {joint!r}: {role} link", link, links)
        if parent == child:
            raise ModelError(f"joint {joint!r} connects link {child!r} to itself: a loop", name=joint, value=child)
        if child in parent_joint:
            message = (
                f"link {child!r} is the child of joints {parent_joint[child]!r} and {joint!r}: "
                "a loop; a kinematic tree gives each link one parent"
            )
            raise ModelError(message, name=child, value=(parent_joint[child], joint), limit=1)
        parent_joint[child] = joint
    roots = [link for link in links if link not in parent_joint]
    if not roots:
        message = f"links {sorted(known)} form a loop: every link has a parent, so there is no root"
        raise ModelError(message, name="links", value=tuple(sorted(known)))
    if len(roots) > 1:
        message = f"links {roots} have no parent joint; a kinematic tree has one root: join or remove the others"
        raise ModelError(message, name="links", value=tuple(roots), limit=1)
    return roots[0]


def tree_order(root: str, edges: Sequence[tuple[str, str, str]]) -> list[int]:
    """Return the indices of the joints in order of declaration, except that each joint precedes all its descendants.

    Raises:
        ModelError: Some links form a loop that is not connected to the root.
    """
    children = defaultdict(list)
    for i, (_, parent, _) in enumerate(edges):
        children[parent].append(i)
    order: list[int] = []
    ready = children[root][::]
    while ready:
        first = min(ready)
        ready.remove(first)
        ready += children[edges[first][2]]
        order.append(first)
    if len(order) < len(edges):
        names = [edges[i][0] for i in sorted(set(range(len(edges))) - set(order))]
        message = f"joints {names} form a loop that is not connected to the root link {root!r}"
        raise ModelError(message, name="joints", value=tuple(names))
    return order


def reroot_tree(
    links: Sequence[Link], joints: Sequence[Joint], old: str, new: str
) -> tuple[tuple[Link, ...], tuple[Joint, ...]]:
    """Return the links and joints of a kinematic tree after making the link `new`, instead of `old`, its root.

    Joints between the two are reversed. Every link keeps its frame, and every joint its name, its limits and the sign
    of its position: a moving joint J then carries a massless link "J_frame" at the joint's frame, to which the former
    parent is attached by a fixed joint "J_fixed". If parent and joint frame coincide, J carries the parent itself.

    Raises:
        ModelError: The new root is not a link, or a required name is already used.
    """
    names = [link.name for link in links]
    if not isinstance(new, str) or new not in names:
        raise require.unknown("root link", new, names)
    parent_joint = {joint.child: joint for joint in joints}
    reversed_joints: dict[str, list[Joint]] = {}
    frames: list[Link] = []
    while new != old:
        joint = parent_joint[new]
        turn, shift = joint.rotation, joint.translation
        inverse = {"rotation": turn.T, "translation": -turn.T @ shift}
        coincident = not shift.any() and np.array_equal(turn, np.eye(3))
        at_origin = {"rotation": np.eye(3), "translation": np.zeros(3), "axis": -joint.axis}
        if not joint.moves:
            reversed_joints[joint.name] = [replace(joint, parent=joint.child, child=joint.parent, **inverse)]
        elif coincident:
            reversed_joints[joint.name] = [replace(joint, parent=joint.child, child=joint.parent, **at_origin)]
        else:
            frame = Link(f"{joint.name}_frame")
            frames.append(frame)
            reversed_joints[joint.name] = [
                replace(joint, parent=joint.child, child=frame.name, **at_origin),
                Joint(f"{joint.name}_fixed", "fixed", frame.name, joint.parent, **inverse),
            ]
        new = joint.parent
    result = [each for joint in joints for each in reversed_joints.get(joint.name, [joint])]
    require_unique((*names, *(frame.name for frame in frames)), "link")
    require_unique((joint.name for joint in result), "joint")
    return (*links, *frames), tuple(result)


LIMITS = ("lower", "upper", "velocity", "effort")


class JointCoupling(NamedTuple):
    """Coupling of a joint to the joint vector: position = multiplier times its entry `column`, plus offset."""

    column: int
    multiplier: float
    offset: float


def resolve_mimics(joints: Sequence[Joint]) -> dict[str, Mimic]:
    """Return each mimic joint's coupling to the independent joint at the end of its chain of mimicked joints, by name.

    Raises:
        ModelError: A joint that follows an unknown joint, or itself through others.
    """
    ties = {joint.name: joint.mimic for joint in joints if joint.mimic is not None}
    names = {joint.name: None for joint in joints}
    resolved: dict[str, Mimic] = {}
    for name, tie in ties.items():
        chain = [name]
        while True:
            if tie.joint not in names:
                raise require.unknown(f"joint {chain[-1]!r}: mimicked joint", tie.joint, names)
            if tie.joint in chain:
                message = f"joints {chain} mimic each other in a ring; let one of them mimic none"
                raise ModelError(message, name="joints", value=tuple(chain))
            if tie.joint not in ties:
                break
            chain.append(tie.joint)
            next_tie = ties[tie.joint]
            offset = tie.offset + tie.multiplier * next_tie.offset
            tie = Mimic(next_tie.joint, tie.multiplier * next_tie.multiplier, offset)
        resolved[name] = tie
    return resolved


def lock_with_followers(joints: Sequence[Joint], positions: Mapping[str, float]) -> tuple[Joint, ...]:
    """Return all joints of a robot after locking the joints named in `positions` and the joints that mimic them.

    Positions are in rad or m, by joint name. Other joints that cannot move are locked too: those that mimic a fixed
    joint (which counts as being at 0), or any joint with multiplier 0. A mimic joint that is locked by its own name is
    no longer coupled.

    Raises:
        ModelError: As `resolve_mimics` and `Joint.locked`.
    """
    joints = tuple(joint.locked(positions[joint.name]) if joint.name in positions else joint for joint in joints)
    locked_positions = {joint.name: float(positions.get(joint.name, 0.0)) for joint in joints if not joint.moves}
    followers = {
        name: tie.offset + tie.multiplier * locked_positions.get(tie.joint, 0.0)
        for name, tie in resolve_mimics(joints).items()
        if tie.joint in locked_positions or tie.multiplier == 0
    }
    return tuple(joint.locked(followers[joint.name]) if joint.name in followers else joint for joint in joints)


def prune_joints(joints: Sequence[Joint], kept: Container[str]) -> tuple[Joint, ...]:
    """Return the joints whose child link is in `kept`; mimics of removed joints are coupled to remaining joints.

    Mimics of a removed joint stay coupled: to its leader if that is kept, else to the first of them, which becomes
    their leader. So the remaining joints can reach the same positions as before; limits of removed joints are lost.
    """
    ties, result = resolve_mimics(joints), []
    kept_joints = {joint.name for joint in joints if joint.child in kept}
    new_leaders: dict[str, str] = {}
    for joint in joints:
        if joint.name not in kept_joints:
            continue
        if joint.mimic is not None and joint.mimic.joint not in kept_joints:
            tie: Mimic | None = ties[joint.name]
            if tie is not None and tie.joint not in kept_joints:
                leader = new_leaders.setdefault(tie.joint, joint.name)
                ratio = tie.multiplier / ties[leader].multiplier
                tie = None if leader == joint.name else Mimic(leader, ratio, tie.offset - ratio * ties[leader].offset)
            joint = replace(joint, mimic=tie)
        result.append(joint)
    return tuple(result)


def joint_couplings(joints: Sequence[Joint]) -> dict[str, JointCoupling]:
    """Return, by joint name, the coupling of each moving joint to the vector of the independent joints' positions."""
    leaders = [joint.name for joint in joints if joint.moves and joint.mimic is None]
    columns = {name: column for column, name in enumerate(leaders)}
    couplings = {joint.name: Mimic(joint.name) for joint in joints if joint.moves} | resolve_mimics(joints)
    return {name: JointCoupling(columns[tie.joint], tie.multiplier, tie.offset) for name, tie in couplings.items()}


def joint_limits(joints: Sequence[Joint], couplings: Mapping[str, JointCoupling]) -> dict[str, Array]:
    """Return "lower", "upper", "velocity" and "effort" limits, (dof,) each, of all independent joints.

    Mimic joints must keep their own limits, so they narrow positions and speed of the joint that they mimic; effort is
    that of its actuator. A velocity or effort of 0 means, as in many URDF files, that the limit is unknown; it becomes
    infinite.

    Raises:
        ModelError: Limits of mimic joints leave the mimicked joint no position.
    """
    moving = {joint.name: joint for joint in joints if joint.moves}
    leaders = [joint for joint in moving.values() if joint.mimic is None]
    limits = {kind: np.array([getattr(joint, kind) for joint in leaders], dtype=float) for kind in LIMITS}
    for kind in ("velocity", "effort"):
        limits[kind][limits[kind] == 0] = np.inf
    for name, (column, multiplier, offset) in couplings.items():
        joint, leader = moving[name], leaders[column]
        if joint is leader:
            continue
        lower, upper = sorted(((joint.lower - offset) / multiplier, (joint.upper - offset) / multiplier))
        limits["lower"][column] = max(limits["lower"][column], lower)
        limits["upper"][column] = min(limits["upper"][column], upper)
        limits["velocity"][column] = min(limits["velocity"][column], (joint.velocity or np.inf) / abs(multiplier))
        if limits["lower"][column] > limits["upper"][column]:
            message = (
                f"joint {name!r} follows {leader.name!r} and stays within its limits {joint.lower:g} .. "
                f"{joint.upper:g} only where that is in {lower:g} .. {upper:g}, which its own limits {leader.lower:g} "
                f".. {leader.upper:g}, or those of other followers, exclude"
            )
            raise ModelError(message, name=name, value=(lower, upper), limit=(leader.lower, leader.upper))
    return limits


X, Y, Z = np.eye(3)
Parts: TypeAlias = tuple[tuple[Link, ...], tuple[Joint, ...]]
"""Links and joints of a robot."""


def replace_planar(place: Joint, axis: Array | None, links: Sequence[Link], joints: Sequence[Joint]) -> Parts:
    """Return the links and joints of a robot with a planar joint replaced by the joints NAME_x, NAME_y, NAME_angle.

    The plane is the one across `axis` (of any length; None: z) through the frame of `place`, a fixed joint that stands
    for the planar one. For another axis, the frame is turned by the least rotation that takes z to the axis or its
    opposite.
    """
    normal = Z if axis is None or not np.any(axis) else axis / np.linalg.norm(axis)
    normal = normal if normal[2] >= 0 else -normal
    tilt = least_rotation(Z, normal)
    steps: list[tuple[str, Kind, Array]] = [("x", "prismatic", tilt @ X), ("y", "prismatic", tilt @ Y)]
    return _replace_by_chain(place, [*steps, ("angle", "continuous", normal)], links, joints)


def replace_floating(place: Joint, links: Sequence[Link], joints: Sequence[Joint]) -> Parts:
    """Return links and joints with `place`, a fixed joint that stands for a floating one, replaced or omitted.

    If the joint connects the whole robot to a massless root, both are omitted. Otherwise it is replaced by the joints
    NAME_x, NAME_y, NAME_z, NAME_yaw, NAME_pitch and NAME_roll.

    Warns:
        ModelWarning: The omitted root has collision shapes.
    """
    base = next((link for link in links if link.name == place.parent), None)
    alone = all(joint is place for joint in joints if place.parent in (joint.parent, joint.child))
    if base is None or not alone or base.mass or base.inertia.any():
        steps: list[tuple[str, Kind, Array]] = [("x", "prismatic", X), ("y", "prismatic", Y), ("z", "prismatic", Z)]
        steps += [("yaw", "continuous", Z), ("pitch", "continuous", Y), ("roll", "continuous", X)]
        return _replace_by_chain(place, steps, links, joints)
    if base.collisions:
        message = (
            f"link {base.name!r}, from which joint {place.name!r} lets the robot float, is left out with its "
            "<collision> shapes: give them as obstacles"
        )
        warn(ModelWarning(message, name=base.name, value=len(base.collisions)), stacklevel=4)
    return tuple(link for link in links if link is not base), tuple(joint for joint in joints if joint is not place)


def _replace_by_chain(
    place: Joint, steps: Sequence[tuple[str, Kind, Array]], links: Sequence[Link], joints: Sequence[Joint]
) -> Parts:
    """Return a robot with one joint replaced by several; `steps` states each new joint's name suffix, kind and axis."""
    new_links = [Link(f"{place.name}_{suffix}_link") for suffix, *_ in steps[:-1]]
    ends = [place.parent, *(link.name for link in new_links), place.child]
    chain = [
        Joint(f"{place.name}_{suffix}", kind, ends[k], ends[k + 1], axis=axis)
        for k, (suffix, kind, axis) in enumerate(steps)
    ]
    chain[0] = replace(chain[0], translation=place.translation, rotation=place.rotation)
    at = joints.index(place)
    return (*links, *new_links), (*joints[:at], *chain, *joints[at + 1 :])
