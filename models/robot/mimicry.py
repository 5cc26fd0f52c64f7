"""Joints that follow others: what drives each, which are held with a joint that is held, and what limits they set.

The position of a follower is multiplier times that of the joint it follows, plus offset (<mimic> of URDF). Followers
of followers make a chain; the joint at its end, which follows none, is the leader of them all, and it alone has an
entry in the joint vector.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from models.arrays import Array
from models.errors import ModelError
from models.robot.parts import Joint, Mimic
from models.robot.tree import absent

LIMITS = ("lower", "upper", "velocity", "effort")


class Drive(NamedTuple):
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
                raise absent(f"joint {chain[-1]!r}: mimicked joint", tie.joint, names)
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


def held(joints: Sequence[Joint], positions: Mapping[str, float]) -> tuple[Joint, ...]:
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


def cut(joints: Sequence[Joint], kept: Container[str]) -> tuple[Joint, ...]:
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


def drives(joints: Sequence[Joint]) -> dict[str, Drive]:
    """What moves each joint that moves, by name: the leaders, in their order, are the entries of the joint vector."""
    leaders = [joint.name for joint in joints if joint.moves and joint.mimic is None]
    columns = {name: column for column, name in enumerate(leaders)}
    own = {joint.name: Mimic(joint.name) for joint in joints if joint.moves} | ties_to_leaders(joints)
    return {name: Drive(columns[tie.joint], tie.multiplier, tie.offset) for name, tie in own.items()}


def joint_limits(joints: Sequence[Joint], driven: Mapping[str, Drive]) -> dict[str, Array]:
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
