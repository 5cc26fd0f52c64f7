"""Order of a kinematic tree: which link is the root, which joint comes first; and the same tree from another root.

Joints that follow others: what drives each, which are held with a joint that is held, and what limits they set.

The position of a follower is multiplier times that of the joint it follows, plus offset (<mimic> of URDF). Followers
of followers make a chain; the joint at its end, which follows none, is the leader of them all, and it alone has an
entry in the joint vector.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from typing import NamedTuple

import numpy as np

from models.arrays import MAX_LISTED, Array
from models.errors import ModelError
from models.robot.parts import Joint, Link, Mimic


def unknown_name(what: str, name: object, known: Iterable[str]) -> ModelError:
    """The error that says a name does not exist and which ones come near it."""
    names = list(known)
    folded = {each.casefold(): each for each in reversed(names)}
    near = [folded[each] for each in get_close_matches(str(name).casefold(), folded, n=3, cutoff=0.5)]
    hint = f"did you mean {' or '.join(repr(each) for each in near)}? " if near else ""
    listed = f"{names[:MAX_LISTED]} and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else f"{names}"
    message = f"{what} {name!r} does not exist; {hint}there are {listed if names else 'none'}"
    return ModelError(message, name=str(name) or what, value=name, limit=tuple(names))


def require_unique(names: Iterable[str], what: str) -> None:
    """Raise ModelError when a name occurs twice."""
    for name, count in Counter(names).items():
        if count > 1:
            message = f"{what} name {name!r} is used more than once; give every {what} its own name"
            raise ModelError(message, name=name, value=count, limit=1)


def find_root(links: Sequence[str], edges: Sequence[tuple[str, str, str]]) -> str:
    """Name of the only link that is no joint's child.

    Args:
        links: Names of the links, unique.
        edges: (joint, parent link, child link) of every joint.

    Raises:
        ModelError: Unknown link name, a link with two parents, no root (a loop), more than one root.
    """
    if not links:
        raise ModelError("a robot needs at least one link", name="link", value=0, limit=1)
    known = set(links)
    parent_joint: dict[str, str] = {}
    for joint, parent, child in edges:
        for role, link in (("parent", parent), ("child", child)):
            if link not in known:
                raise unknown_name(f"joint {joint!r}: {role} link", link, links)
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
    """Indices of the joints such that every parent link is reached before its children.

    The order of declaration is kept wherever it already is such an order.

    Raises:
        ModelError: Some links form a loop that the root does not reach.
    """
    below = defaultdict(list)
    for i, (_, parent, _) in enumerate(edges):
        below[parent].append(i)
    order: list[int] = []
    ready = below[root][::]
    while ready:
        first = min(ready)
        ready.remove(first)
        ready += below[edges[first][2]]
        order.append(first)
    if len(order) < len(edges):
        names = [edges[i][0] for i in sorted(set(range(len(edges))) - set(order))]
        message = f"joints {names} form a loop that is not connected to the root link {root!r}"
        raise ModelError(message, name="joints", value=tuple(names))
    return order


def reroot_tree(
    links: Sequence[Link], joints: Sequence[Joint], old: str, new: str
) -> tuple[tuple[Link, ...], tuple[Joint, ...]]:
    """The tree of root `old` hung up at the link `new`.

    Joints between the two change direction. Every link keeps its frame, and every joint its name, limits and the sign
    of its position: a moving joint J now carries a massless link "J_frame" at the joint's frame, on which the former
    parent is fixed by a joint "J_fixed". (Where parent and joint frame coincide, J carries the parent itself.)

    Raises:
        ModelError: The new root is no link; a name that is needed is taken.
    """
    names = [link.name for link in links]
    if not isinstance(new, str) or new not in names:
        raise unknown_name("root link", new, names)
    above = {joint.child: joint for joint in joints}
    turned: dict[str, list[Joint]] = {}
    frames: list[Link] = []
    while new != old:
        joint = above[new]
        turn, shift = joint.rotation, joint.translation
        back = {"rotation": turn.T, "translation": -turn.T @ shift}
        together = not shift.any() and np.array_equal(turn, np.eye(3))
        at_origin = {"rotation": np.eye(3), "translation": np.zeros(3), "axis": -joint.axis}
        if not joint.moves:
            turned[joint.name] = [replace(joint, parent=joint.child, child=joint.parent, **back)]
        elif together:
            turned[joint.name] = [replace(joint, parent=joint.child, child=joint.parent, **at_origin)]
        else:
            frame = Link(f"{joint.name}_frame")
            frames.append(frame)
            turned[joint.name] = [
                replace(joint, parent=joint.child, child=frame.name, **at_origin),
                Joint(f"{joint.name}_fixed", "fixed", frame.name, joint.parent, **back),
            ]
        new = joint.parent
    result = [each for joint in joints for each in turned.get(joint.name, [joint])]
    require_unique((*names, *(frame.name for frame in frames)), "link")
    require_unique((joint.name for joint in result), "joint")
    return (*links, *frames), tuple(result)


LIMITS = ("lower", "upper", "velocity", "effort")


class JointCoupling(NamedTuple):
    """What moves a joint: multiplier times an entry of the joint vector, plus an offset (rad or m)."""

    column: int
    multiplier: float
    offset: float


def ties_to_leaders(joints: Sequence[Joint]) -> dict[str, Mimic]:
    """The tie of each follower to its leader, by the follower's name.

    Raises:
        ModelError: A joint that follows one that does not exist, or itself by way of others.
    """
    ties = {joint.name: joint.mimic for joint in joints if joint.mimic is not None}
    names = {joint.name: None for joint in joints}
    found: dict[str, Mimic] = {}
    for name, tie in ties.items():
        chain = [name]
        while True:
            if tie.joint not in names:
                raise unknown_name(f"joint {chain[-1]!r}: mimicked joint", tie.joint, names)
            if tie.joint in chain:
                message = f"joints {chain} mimic each other in a ring; let one of them mimic none"
                raise ModelError(message, name="joints", value=tuple(chain))
            if tie.joint not in ties:
                break
            chain.append(tie.joint)
            further = ties[tie.joint]
            offset = tie.offset + tie.multiplier * further.offset
            tie = Mimic(further.joint, tie.multiplier * further.multiplier, offset)
        found[name] = tie
    return found


def lock_with_followers(joints: Sequence[Joint], positions: Mapping[str, float]) -> tuple[Joint, ...]:
    """The joints, some of them locked at given positions (rad or m, by name), and with them what does not move then.

    Those are the followers of a locked or a fixed joint, which stands at 0, and a follower of multiplier 0. A follower
    that is locked itself follows no more.

    Raises:
        ModelError: What `ties_to_leaders` and `Joint.locked` refuse.
    """
    joints = tuple(joint.locked(positions[joint.name]) if joint.name in positions else joint for joint in joints)
    at = {joint.name: float(positions.get(joint.name, 0.0)) for joint in joints if not joint.moves}
    places = {
        name: tie.offset + tie.multiplier * at.get(tie.joint, 0.0)
        for name, tie in ties_to_leaders(joints).items()
        if tie.joint in at or tie.multiplier == 0
    }
    return tuple(joint.locked(places[joint.name]) if joint.name in places else joint for joint in joints)


def prune_joints(joints: Sequence[Joint], kept: Container[str]) -> tuple[Joint, ...]:
    """The joints of the links that are kept, by the name of their child.

    Followers of a joint that goes follow on: its leader where that stays, else the first of them, which becomes a
    leader. So what stays can stand as it could before; the limits of what goes are gone.
    """
    ties, result = ties_to_leaders(joints), []
    staying = {joint.name for joint in joints if joint.child in kept}
    heirs: dict[str, str] = {}
    for joint in joints:
        if joint.name not in staying:
            continue
        if joint.mimic is not None and joint.mimic.joint not in staying:
            tie: Mimic | None = ties[joint.name]
            if tie is not None and tie.joint not in staying:
                heir = heirs.setdefault(tie.joint, joint.name)
                ratio = tie.multiplier / ties[heir].multiplier
                tie = None if heir == joint.name else Mimic(heir, ratio, tie.offset - ratio * ties[heir].offset)
            joint = replace(joint, mimic=tie)
        result.append(joint)
    return tuple(result)


def joint_couplings(joints: Sequence[Joint]) -> dict[str, JointCoupling]:
    """What moves each joint that moves, by name: the leaders, in their order, are the entries of the joint vector."""
    leaders = [joint.name for joint in joints if joint.moves and joint.mimic is None]
    columns = {name: column for column, name in enumerate(leaders)}
    own = {joint.name: Mimic(joint.name) for joint in joints if joint.moves} | ties_to_leaders(joints)
    return {name: JointCoupling(columns[tie.joint], tie.multiplier, tie.offset) for name, tie in own.items()}


def joint_limits(joints: Sequence[Joint], driven: Mapping[str, JointCoupling]) -> dict[str, Array]:
    """Limits "lower", "upper", "velocity" and "effort" of the joint vector. Shape (dof,) each.

    No joint passes its limits, so that followers narrow the positions and slow the leaders that drive them. Effort is
    that of the leader's own drive, the one actuator of them all: what loads the followers loads it too. A velocity or
    an effort of 0 says, as in many URDF files, that the limit is unknown: it is infinite here.

    Raises:
        ModelError: Followers that leave a leader no position.
    """
    moving = {joint.name: joint for joint in joints if joint.moves}
    leaders = [joint for joint in moving.values() if joint.mimic is None]
    limits = {what: np.array([getattr(joint, what) for joint in leaders], dtype=float) for what in LIMITS}
    for what in ("velocity", "effort"):
        limits[what][limits[what] == 0] = np.inf
    for name, (column, multiplier, offset) in driven.items():
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
