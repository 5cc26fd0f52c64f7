"""Changes of robots: lock joints, attach tools and loads, mount on rails, join arms, prune, change the root or the tip.

Every function leaves its robot unchanged and returns a new one. Poses are translations of shape (3,), m, and rotations
of shape (3, 3) whose columns are axes, the identity if None. All raise ModelError for an unknown name, with similar
names, and for a name that would occur twice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from models.checks import Array, ArrayInput, require
from models.errors import ModelError
from models.robot.parts import Joint, Link
from models.robot.robot import Robot
from models.robot.tree import lock_with_followers, prune_joints, reroot_tree


def lock_joints(robot: Robot, positions: Mapping[str, float]) -> Robot:
    """Return the robot with some joints, and the joints that mimic them, locked at given positions.

    Args:
        positions: Position of each joint to lock (rad or m), by name. Limits are not checked.

    Raises:
        ModelError: A joint that is already fixed, or a position that is not finite.
    """
    positions = require.mapping("lock_joints: positions", positions)
    joints = lock_with_followers(_robot(robot).joints, {robot.joint(name).name: positions[name] for name in positions})
    return replace(robot, joints=joints)


def move_tip(
    robot: Robot, tip: str, translation: ArrayInput = (0.0, 0.0, 0.0), rotation: ArrayInput | None = None
) -> Robot:
    """Return the robot with its tip at another frame, which is fixed in a given link."""
    turn = _or_identity(rotation)
    return replace(robot, tip=_robot(robot).link(tip).name, tip_translation=translation, tip_rotation=turn)


def with_load(
    robot: Robot,
    link: str,
    mass: float,
    center_of_mass: ArrayInput = (0.0, 0.0, 0.0),
    *,
    inertia: ArrayInput | None = None,
) -> Robot:
    """Return the robot with a load, a rigid body, merged into one of its links.

    Args:
        link: Name of the link that carries the load.
        mass: kg.
        center_of_mass: In the link's frame. Shape (3,), m.
        inertia: About the load's centre of mass, in link axes. Shape (3, 3), kg m^2; a point mass if None.

    Raises:
        ModelError: An impossible mass or inertia.
    """
    carrier = _robot(robot).link(link)
    load = Link(f"load of {link}", mass, center_of_mass, np.zeros((3, 3)) if inertia is None else inertia)
    loaded = _merge_links(carrier, [(load, np.eye(3), np.zeros(3))])
    return replace(robot, links=tuple(loaded if each.name == link else each for each in robot.links))


def attach_tool(
    robot: Robot,
    tool: Robot | Link,
    link: str | None = None,
    translation: ArrayInput = (0.0, 0.0, 0.0),
    *,
    rotation: ArrayInput | None = None,
    prefix: str = "",
    keep_tip: bool = False,
) -> Robot:
    """Return the robot with a tool, or any other robot, attached to one of its links by a fixed joint.

    The joint is called "NAME_mount", NAME being the tool's root link with the prefix. The joints of the tool come last.

    Args:
        tool: A robot or a single link.
        link: Name of the link that carries it; the tip frame if None.
        translation: Tool's root link in the carrying frame. Shape (3,), m.
        rotation: Tool's root link in the carrying frame. Shape (3, 3).
        prefix: Prefix of all names of the tool.
        keep_tip: Keep the robot's tip; otherwise the tool's tip becomes that of the robot.
    """
    owner = "attached tool"
    added = tool if isinstance(tool, Robot) else Robot((require.instance(f"{owner}: tool", tool, Link),))
    added, robot = add_prefix(added, prefix), _robot(robot)
    require.flag(f"{owner}: keep_tip", keep_tip)
    shift = require.array(f"{owner}: translation", translation, (3,))
    turn = require.rotation(f"{owner}: rotation", _or_identity(rotation))
    if link is None:
        link = robot.tip_link
        shift, turn = robot.tip_translation + robot.tip_rotation @ shift, robot.tip_rotation @ turn
    mount = Joint(f"{added.root}_mount", "fixed", robot.link(link).name, added.root, shift, turn)
    links, joints = (*robot.links, *added.links), (*robot.joints, mount, *added.joints)
    return replace(robot if keep_tip else added, links=links, joints=joints, name=robot.name)


def mount_on_rail(
    robot: Robot, axis: ArrayInput, lower: float, upper: float, *, velocity: float = np.inf, name: str = "rail"
) -> Robot:
    """Return the robot on a linear axis, such as a rail or a lift: a prismatic joint moves the link that was its root.

    The joint is called "NAME_joint" and comes first. The rail itself, the new root link, has neither mass nor shape.

    Args:
        axis: Direction of the rail in the frame of the robot's root link, of any length. Shape (3,).
        lower, upper: Position limits, m. At position 0 the root link has the pose of the rail.
        velocity: Speed limit, m/s.
        name: Name of the new root link.
    """
    link, root = Link(name), _robot(robot).root
    rail = Joint(f"{name}_joint", "prismatic", name, root, axis=axis, lower=lower, upper=upper, velocity=velocity)
    return replace(robot, links=(link, *robot.links), joints=(rail, *robot.joints))


def merge_robots(
    base: Robot | Link,
    arms: Mapping[str, Robot],
    *,
    links: Mapping[str, str] | None = None,
    translations: Mapping[str, ArrayInput] | None = None,
    rotations: Mapping[str, ArrayInput] | None = None,
) -> Robot:
    """Return one robot that joins several, such as arms, on a common base; its tip is the tip of the first robot.

    Args:
        base: A link or a robot that carries the arms.
        arms: Robots by the prefix of all their names: {"left_": arm, "right_": arm}.
        links: Link of the base that carries each arm, by prefix; the root of the base by default.
        translations: Each arm's root link in the carrying link, by prefix; zero by default. Shape (3,), m.
        rotations: The same for the rotation. Shape (3, 3).

    Raises:
        ModelError: No arms, or a pose for an unknown prefix.
    """
    owner = "merged robots"
    arms = require.mapping(f"{owner}: arms", arms)
    if not arms:
        raise ModelError(f"{owner}: no arms are given", name="arms", value=arms)
    mappings = {"links": links, "translations": translations, "rotations": rotations}
    poses = [require.mapping(f"{owner}: {argument}", mapping) for argument, mapping in mappings.items()]
    if unknown := [prefix for mapping in poses for prefix in mapping if prefix not in arms]:
        message = f"{owner}: {unknown} are no prefixes of the arms, which are {list(arms)}"
        raise ModelError(message, name=unknown[0], value=unknown, limit=tuple(arms))
    merged = base if isinstance(base, Robot) else Robot((require.instance("merge: base", base, Link),), name=base.name)
    root, first = merged.root, next(iter(arms))
    for prefix, arm in arms.items():
        carrier, shift, turn = (mapping.get(prefix) for mapping in poses)
        carrier, shift = root if carrier is None else carrier, np.zeros(3) if shift is None else shift
        require.instance(f"{owner}: {prefix!r}: arm", arm, Robot)
        merged = attach_tool(merged, arm, carrier, shift, rotation=turn, prefix=prefix, keep_tip=prefix != first)
    return merged


def add_prefix(robot: Robot, prefix: str) -> Robot:
    """Return the robot with a prefix before its name and the names of all its links and joints."""
    robot = _robot(robot)
    if not require.text("add_prefix: prefix", prefix):
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
    """Return the robot with another link as the root of its tree; joints between the two roots are reversed."""
    links, joints = reroot_tree(_robot(robot).links, robot.joints, robot.root, root)
    return replace(robot, links=links, joints=joints)


def subtree(robot: Robot, root: str, tip: str | None = None) -> Robot:
    """Return a link, with all links that it carries, as a separate robot.

    Joints that mimic a removed joint are treated as by `prune`.

    Args:
        root: Name of the link.
        tip: Link whose frame is the tip. If None, the robot's tip if it belongs to the subtree, else the only leaf if
            any.
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
    """Return the robot with only the links on the paths from the root to the tip and to given other links.

    The other branches are removed with their mass. To keep the mass, lock their joints and call `simplify` instead.
    Joints that mimic a removed joint stay coupled to each other, see `models.robot.tree.prune_joints`.

    Raises:
        ModelError: The robot has no tip and `keep` is empty.
    """
    robot, names = _robot(robot), _names(keep)
    ends = [*names] if robot.tip is None and names else [robot.tip_link, *names]
    kept = {robot.root, *(joint.child for name in ends for joint in robot.path_to(name))}
    links = tuple(link for link in robot.links if link.name in kept)
    return replace(robot, links=links, joints=prune_joints(robot.joints, kept))


def simplify(robot: Robot, keep: Iterable[str] = ()) -> Robot:
    """Return the robot with links on fixed joints merged into the links that carry them, which keeps its dynamics.

    The tip frame, the names and order of the moving joints and the frames of their links are unchanged.

    Args:
        keep: Links on fixed joints whose frames are needed. They stay, but their mass goes to the link that carries
            them.
    """
    robot = _robot(robot)
    kept = {robot.link(name).name for name in _names(keep)}
    # by link: the link that carries its frame, or its mass, and the pose (rotation, translation) in it
    frame_carrier = {robot.root: (robot.root, np.eye(3), np.zeros(3))}
    mass_carrier = dict(frame_carrier)
    joints = []
    for joint in robot.joints:
        host, turn, shift = frame_carrier[joint.parent]
        turn, shift = turn @ joint.rotation, shift + turn @ joint.translation
        is_kept = joint.moves or joint.child in kept
        if is_kept:
            joints.append(replace(joint, parent=host, rotation=turn, translation=shift))
        frame_carrier[joint.child] = (joint.child, np.eye(3), np.zeros(3)) if is_kept else (host, turn, shift)
        mass_host, turn, shift = mass_carrier[joint.parent]
        turn, shift = turn @ joint.rotation, shift + turn @ joint.translation
        mass_carrier[joint.child] = (joint.child, np.eye(3), np.zeros(3)) if joint.moves else (mass_host, turn, shift)
    parts: dict[str, list[tuple[Link, Array, Array]]] = {}
    for link in robot.links:
        parts.setdefault(mass_carrier[link.name][0], []).append((link, *mass_carrier[link.name][1:]))
    links = []
    for link in robot.links:
        if mass_carrier[link.name][0] == link.name:
            links.append(_merge_links(link, [part for part in parts[link.name] if part[0] is not link]))
        elif frame_carrier[link.name][0] == link.name:
            links.append(Link(link.name))
    if robot.tip is None:
        return replace(robot, links=tuple(links), joints=tuple(joints))
    tip, turn, shift = frame_carrier[robot.tip]
    shift, turn = shift + turn @ robot.tip_translation, turn @ robot.tip_rotation
    return replace(robot, links=tuple(links), joints=tuple(joints), tip=tip, tip_translation=shift, tip_rotation=turn)


def _merge_links(link: Link, others: Sequence[tuple[Link, Array, Array]]) -> Link:
    """Return a link to which the masses and shapes of other links, at poses (rotation, translation), are added."""
    shapes = (shape.placed(turn, shift) for part, turn, shift in others for shape in part.collisions)
    visuals = (shape.placed(turn, shift) for part, turn, shift in others for shape in part.visuals)
    link = replace(link, collisions=(*link.collisions, *shapes), visuals=(*link.visuals, *visuals))
    others = [part for part in others if part[0].mass or part[0].inertia.any()]
    if not others:
        return link
    parts = [(link, np.eye(3), np.zeros(3)), *others]
    masses = [part.mass for part, _, _ in parts]
    centers = [shift + turn @ part.center_of_mass for part, turn, shift in parts]
    mass = sum(masses)
    center = np.average(centers, axis=0, weights=masses) if mass else np.zeros(3)
    inertia = np.zeros((3, 3))
    for (part, turn, _), part_mass, mass_center in zip(parts, masses, centers, strict=True):
        arm = mass_center - center
        inertia += turn @ part.inertia @ turn.T + part_mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    any_inertia = any(part.any_inertia for part, _, _ in parts)
    return replace(link, mass=mass, center_of_mass=center, inertia=inertia, any_inertia=any_inertia)


def _or_identity(rotation: ArrayInput | None) -> ArrayInput:
    return np.eye(3) if rotation is None else rotation


def _names(names: Iterable[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else require.each("links: keep", names, str)


def _robot(robot: Robot) -> Robot:
    return require.instance("rebuilt robot: robot", robot, Robot)
