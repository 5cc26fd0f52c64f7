"""Robots made from robots: joints locked, tools and loads attached, arms joined, branches cut, another root or tip.

Every function takes a robot, which it leaves as it is, and returns a new one. Placements are (3,) translations in m
and (3, 3) rotations whose columns are axes, no turn if None. All raise ModelError, naming the near ones, for a name
that does not exist, and for a name that would occur twice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from models.arrays import (
    Array,
    ArrayInput,
    checked_array,
    checked_each,
    checked_flag,
    checked_instance,
    checked_mapping,
    checked_rotation,
    checked_text,
)
from models.errors import ModelError
from models.robot.parts import Joint, Link
from models.robot.robot import Robot
from models.robot.tree import lock_with_followers, prune_joints, reroot_tree


def lock_joints(robot: Robot, positions: Mapping[str, float]) -> Robot:
    """The robot with some joints held fixed, and with each the joints that follow it, where that puts them.

    Args:
        positions: Position of each joint to lock (rad or m), by name. Limits are not checked.

    Raises:
        ModelError: A joint that is fixed already; a position that is not finite.
    """
    given = checked_mapping(positions, "lock_joints", "positions")
    joints = lock_with_followers(_robot(robot).joints, {robot.joint(name).name: at for name, at in given.items()})
    return replace(robot, joints=joints)


def move_tip(
    robot: Robot, tip: str, translation: ArrayInput = (0.0, 0.0, 0.0), rotation: ArrayInput | None = None
) -> Robot:
    """The robot with its tip at a frame placed in the link `tip`."""
    return replace(robot, tip=_robot(robot).link(tip).name, tip_translation=translation, tip_rotation=_turn(rotation))


def with_load(
    robot: Robot,
    link: str,
    mass: float,
    center_of_mass: ArrayInput = (0.0, 0.0, 0.0),
    inertia: ArrayInput | None = None,
) -> Robot:
    """The robot with a body welded to a link, whose inertia it joins.

    Args:
        link: Name of the link that carries the load.
        mass: kg.
        center_of_mass: In the link's frame. Shape (3,), m.
        inertia: About that point, in link axes. Shape (3, 3), kg m^2; a point mass if None.

    Raises:
        ModelError: An impossible mass or inertia.
    """
    carrier = _robot(robot).link(link)
    load = Link(f"load of {link}", mass, center_of_mass, np.zeros((3, 3)) if inertia is None else inertia)
    whole = _welded(carrier, [(load, np.eye(3), np.zeros(3))])
    return replace(robot, links=tuple(whole if each.name == link else each for each in robot.links))


def attach_tool(
    robot: Robot,
    tool: Robot | Link,
    link: str | None = None,
    translation: ArrayInput = (0.0, 0.0, 0.0),
    rotation: ArrayInput | None = None,
    *,
    prefix: str = "",
    keep_tip: bool = False,
) -> Robot:
    """The robot with a tool, or any other robot, fixed to one of its links.

    The fixed joint is called "NAME_mount", NAME being the tool's root link with the prefix. The joints of the tool
    come last.

    Args:
        tool: What is attached: a robot, or a single link.
        link: Name of the link that carries it. The tool stands at its tip frame if None.
        translation: Tool's root link in the carrying frame. Shape (3,), m.
        rotation: Tool's root link in the carrying frame. Shape (3, 3).
        prefix: Put before every name of the tool.
        keep_tip: The tip stays where it is; otherwise the tool's tip becomes that of the robot.
    """
    added = add_prefix(
        tool if isinstance(tool, Robot) else Robot((checked_instance(tool, Link, "attached", "tool"),)), prefix
    )
    robot = _robot(robot)
    checked_flag(keep_tip, "attached tool", "keep_tip")
    shift = checked_array(translation, (3,), "attached tool", "translation")
    turn = checked_rotation(_turn(rotation), "attached tool", "rotation")
    if link is None:
        link = robot.tip_link
        shift, turn = robot.tip_translation + robot.tip_rotation @ shift, robot.tip_rotation @ turn
    mount = Joint(f"{added.root}_mount", "fixed", robot.link(link).name, added.root, shift, turn)
    owner = robot if keep_tip else added
    return replace(
        owner, links=(*robot.links, *added.links), joints=(*robot.joints, mount, *added.joints), name=robot.name
    )


def merge_robots(
    base: Robot | Link,
    arms: Mapping[str, Robot],
    *,
    links: Mapping[str, str] | None = None,
    translations: Mapping[str, ArrayInput] | None = None,
    rotations: Mapping[str, ArrayInput] | None = None,
) -> Robot:
    """Several robots on one base. The tip is that of the first arm; see move_tip.

    Args:
        base: What carries the arms: a link, or a robot.
        arms: Robots by prefix, which is put before all their names: {"left_": arm, "right_": arm}.
        links: Link of the base that carries each, by prefix; the root of the base where none is given.
        translations: Each arm's root link in the carrying link, by prefix; zero where none is given. Shape (3,), m.
        rotations: The same for the turn. Shape (3, 3).

    Raises:
        ModelError: No arm; a placement of an arm that is not there.
    """
    owner = "merged robots"
    arms = checked_mapping(arms, owner, "arms")
    if not arms:
        raise ModelError(f"{owner}: no arms are given", name="arms", value=arms)
    placed = {"links": links, "translations": translations, "rotations": rotations}
    given = [{} if places is None else checked_mapping(places, owner, what) for what, places in placed.items()]
    if unknown := [prefix for places in given for prefix in places if prefix not in arms]:
        message = f"merged robots: {unknown} are no prefixes of the arms, which are {list(arms)}"
        raise ModelError(message, name=unknown[0], value=unknown, limit=tuple(arms))
    whole = base if isinstance(base, Robot) else Robot((checked_instance(base, Link, owner, "base"),), name=base.name)
    root, first = whole.root, True
    for prefix, arm in arms.items():
        carrier, shift, turn = (places.get(prefix) for places in given)
        shift = np.zeros(3) if shift is None else shift
        checked_instance(arm, Robot, f"{owner}: {prefix!r}", "arm")
        whole = attach_tool(
            whole, arm, root if carrier is None else carrier, shift, turn, prefix=prefix, keep_tip=not first
        )
        first = False
    return whole


def add_prefix(robot: Robot, prefix: str) -> Robot:
    """The robot with a prefix before the names of all links and joints."""
    robot = _robot(robot)
    if not checked_text(prefix, "add_prefix", "prefix"):
        return robot
    links = tuple(replace(link, name=prefix + link.name) for link in robot.links)
    joints = []
    for joint in robot.joints:
        tie = joint.mimic and replace(joint.mimic, joint=prefix + joint.mimic.joint)
        name, parent, child = (prefix + each for each in (joint.name, joint.parent, joint.child))
        joints.append(replace(joint, name=name, parent=parent, child=child, mimic=tie))
    tip = robot.tip and prefix + robot.tip
    return replace(robot, links=links, joints=tuple(joints), tip=tip, name=prefix + robot.name)


def reroot(robot: Robot, root: str) -> Robot:
    """The robot hung up at another link, its new base: same links, frames, joint names, limits and signs.

    See `models.robot.tree.reroot_tree` for the massless links that this takes.
    """
    links, joints = reroot_tree(_robot(robot).links, robot.joints, robot.root, root)
    return replace(robot, links=links, joints=joints)


def subtree(robot: Robot, root: str, tip: str | None = None) -> Robot:
    """A link with all that it carries, as a robot of its own; `pruned` says what becomes of joints that follow others.

    Args:
        root: Name of the link.
        tip: Link whose frame is the tip. If None the robot's tip where it is among them, else the only leaf if any.
    """
    kept = {_robot(robot).link(root).name}
    for joint in robot.joints:
        if joint.parent in kept:
            kept.add(joint.child)
    links, joints = tuple(link for link in robot.links if link.name in kept), prune_joints(robot.joints, kept - {root})
    if tip is None and robot.tip in kept:
        return replace(robot, links=links, joints=joints)
    return Robot(links, joints, tip, name=robot.name)


def prune(robot: Robot, keep: Iterable[str] = ()) -> Robot:
    """The links on the way from the root to the tip, and to the links of `keep`; other branches, mass and all, go.

    To keep what the other branches weigh, lock their joints instead, and simplify. Joints that follow one that goes
    are tied to each other as they were by it: see `models.robot.tree.prune_joints`.

    Raises:
        ModelError: No tip and nothing to keep.
    """
    robot, named = _robot(robot), _names(keep)
    ends = [*named] if robot.tip is None and named else [robot.tip_link, *named]
    stay = {robot.root, *(joint.child for name in ends for joint in robot.path_to(name))}
    links = tuple(link for link in robot.links if link.name in stay)
    return replace(robot, links=links, joints=prune_joints(robot.joints, stay))


def simplify(robot: Robot, keep: Iterable[str] = ()) -> Robot:
    """The same motion and dynamics with fewer links: what hangs on a fixed joint becomes part of its carrier.

    The tip frame, the names and order of the moving joints and the frames of their links stay.

    Args:
        keep: Links on fixed joints whose frames are still wanted. They stay, without mass: that goes to the carrier.
    """
    robot = _robot(robot)
    stay = {robot.link(name).name for name in _names(keep)}
    carrier = {robot.root: (robot.root, np.eye(3), np.zeros(3))}  # of the frame: placement in the link it is part of
    body = dict(carrier)  # of the mass
    joints = []
    for joint in robot.joints:
        host, turn, shift = carrier[joint.parent]
        turn, shift = turn @ joint.rotation, shift + turn @ joint.translation
        stays = joint.moves or joint.child in stay
        if stays:
            joints.append(replace(joint, parent=host, rotation=turn, translation=shift))
        carrier[joint.child] = (joint.child, np.eye(3), np.zeros(3)) if stays else (host, turn, shift)
        whole, turn, shift = body[joint.parent]
        turn, shift = turn @ joint.rotation, shift + turn @ joint.translation
        body[joint.child] = (joint.child, np.eye(3), np.zeros(3)) if joint.moves else (whole, turn, shift)
    parts: dict[str, list[tuple[Link, Array, Array]]] = {}
    for link in robot.links:
        parts.setdefault(body[link.name][0], []).append((link, *body[link.name][1:]))
    links = []
    for link in robot.links:
        if body[link.name][0] == link.name:
            links.append(_welded(link, [part for part in parts[link.name] if part[0] is not link]))
        elif carrier[link.name][0] == link.name:
            links.append(Link(link.name))
    if robot.tip is None:
        return replace(robot, links=tuple(links), joints=tuple(joints))
    tip, turn, shift = carrier[robot.tip]
    shift, turn = shift + turn @ robot.tip_translation, turn @ robot.tip_rotation
    return replace(robot, links=tuple(links), joints=tuple(joints), tip=tip, tip_translation=shift, tip_rotation=turn)


def _welded(link: Link, others: Sequence[tuple[Link, Array, Array]]) -> Link:
    """One link of several, shapes and all, the others placed in its frame by (rotation, translation); parallel axes."""
    shapes = (shape.placed(turn, shift) for part, turn, shift in others for shape in part.collisions)
    seen = (shape.placed(turn, shift) for part, turn, shift in others for shape in part.visuals)
    link = replace(link, collisions=(*link.collisions, *shapes), visuals=(*link.visuals, *seen))
    others = [part for part in others if part[0].mass or part[0].inertia.any()]
    if not others:
        return link
    parts = [(link, np.eye(3), np.zeros(3)), *others]
    masses = [part.mass for part, _, _ in parts]
    centers = [shift + turn @ part.center_of_mass for part, turn, shift in parts]
    mass = sum(masses)
    center = np.average(centers, axis=0, weights=masses) if mass else np.zeros(3)
    inertia = np.zeros((3, 3))
    for (part, turn, _), own, place in zip(parts, masses, centers, strict=True):
        arm = place - center
        inertia += turn @ part.inertia @ turn.T + own * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    doubtful = any(part.any_inertia for part, _, _ in parts)
    return replace(link, mass=mass, center_of_mass=center, inertia=inertia, any_inertia=doubtful)


def _turn(rotation: ArrayInput | None) -> ArrayInput:
    return np.eye(3) if rotation is None else rotation


def _names(names: Iterable[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else checked_each(names, str, "links", "keep")


def _robot(robot: Robot) -> Robot:
    return checked_instance(robot, Robot, "rebuilt robot", "robot")
