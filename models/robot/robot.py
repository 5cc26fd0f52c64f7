"""Robots: validated kinematic trees of links and joints."""

from __future__ import annotations

import os
import secrets
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args
from warnings import warn

import numpy as np

from models.checks import Array, ArrayInput, require, set_fields, warn_of_millimetres
from models.errors import ModelError, ModelWarning
from models.robot.mjcf import read_mjcf
from models.robot.parts import Joint, Link, urdf_text
from models.robot.tree import (
    JointCoupling,
    find_root,
    joint_couplings,
    joint_limits,
    lock_with_followers,
    require_unique,
    reroot_tree,
    resolve_mimics,
    tree_order,
)
from models.robot.urdf import Description, InertiaRule, Source, numbers_of, parse_urdf, read_urdf, text_of

MimicRule: TypeAlias = Literal["couple", "lock", "free"]


@dataclass(frozen=True, eq=False)
class Robot:
    """A kinematic tree of links with one frame of interest, the tip.

    Attributes:
        links: All links, in the given order.
        joints: All joints, parents before children, otherwise in the given order. Mimics of a fixed joint are fixed.
        tip: Name of the link that carries the tip. If not given, the only leaf, or None if there are several.
        tip_translation: Tip frame's origin in the tip link's frame. Shape (3,), m.
        tip_rotation: Tip frame's axes, as columns, in the tip link's frame. Shape (3, 3).
        name: Name of the robot in texts.
        root: Name of the link without a parent, the base.

    Raises:
        ModelError: Duplicate or unknown names, a loop, several roots, wrong sizes, a joint that mimics an unknown
            joint or itself through others, mimic joints whose limits leave the mimicked joint no position.
    """

    links: tuple[Link, ...]
    joints: tuple[Joint, ...] = ()
    tip: str | None = None
    tip_translation: ArrayInput = (0.0, 0.0, 0.0)
    tip_rotation: ArrayInput = field(default_factory=lambda: np.eye(3))
    name: str = "robot"
    root: str = field(init=False)

    def __post_init__(self) -> None:
        owner = "robot"
        links = require.each(f"{owner}: links", self.links, Link)
        joints = require.each(f"{owner}: joints", self.joints, Joint)
        if not (isinstance(self.name, str) and self.name == ""):  # descriptions may omit it
            require.name(f"{owner}: name", self.name)
        require_unique((link.name for link in links), "link")
        require_unique((joint.name for joint in joints), "joint")
        joints = lock_with_followers(joints, {})
        names, edges = [link.name for link in links], [(joint.name, joint.parent, joint.child) for joint in joints]
        root = find_root(names, edges)
        set_fields(self, root=root, links=links, joints=tuple(joints[i] for i in tree_order(root, edges)))
        if self.tip is None:
            set_fields(self, tip=self._leaves[0] if len(self._leaves) == 1 else None)
        elif not isinstance(self.tip, str) or self.tip not in names:
            raise require.unknown("tip link", self.tip, names)
        set_fields(self, tip_translation=require.array(f"{owner}: tip_translation", self.tip_translation, (3,)))
        set_fields(self, tip_rotation=require.rotation(f"{owner}: tip_rotation", self.tip_rotation))
        warn_of_millimetres(f"{owner}: tip_translation", self.tip_translation)
        _ = self._limits  # raises if mimic joints leave a joint no position

    @property
    def _leaves(self) -> list[str]:
        parents = {joint.parent for joint in self.joints}
        return [link.name for link in self.links if link.name not in parents]

    @property
    def tip_link(self) -> str:
        """Name of the link that carries the tip; raises ModelError if the robot has no tip."""
        if self.tip is None:
            message = (
                f"{self.name!r} has no tip, which is needed here: its tree has the leaves {self._leaves}; say which "
                "link carries it, tip=NAME where the robot is made or move_tip(robot, NAME), or let tasks name links"
            )
            raise ModelError(message, name="tip", limit=tuple(self._leaves))
        return self.tip

    @classmethod
    def from_urdf(
        cls,
        source: Source,
        *,
        tip: str | None = None,
        root: str | None = None,
        tip_translation: ArrayInput = (0.0, 0.0, 0.0),
        tip_rotation: ArrayInput = None,
        lock: Mapping[str, float] | None = None,
        mimic: MimicRule = "couple",
        inertia: InertiaRule = "warn",
    ) -> Robot:
        """Read a robot from a URDF text or file; see `models.robot.urdf.read_urdf` for its contents and defaults.

        Args:
            source: The text, recognised by its first character "<", or the path of a file.
            tip: Link that carries the tip. If None, the link that `to_urdf` stored in the file, else the only leaf.
            root: Link to become the root of the tree, the base; the root of the file if None. Links keep their frames,
                joints their names, limits and signs, see `models.robot.tree.reroot_tree`.
            tip_translation: As in Robot.
            tip_rotation: As in Robot; the identity if None.
            lock: Positions (rad or m) at which joints, and those that mimic them, are locked, by joint name.
            mimic: Treatment of joints that mimic others: couple them to these ("couple"), lock each where it is when
                the joint that it mimics is at 0 ("lock"), or make them independent, even if that joint is locked
                ("free").
            inertia: Treatment of physically impossible inertias: accept them with a warning ("warn") or silently
                ("as_given").

        Raises:
            ModelError: As read_urdf, Robot and `models.robot.rebuild.lock_joints`.

        Warns:
            ModelWarning: Parts of the file that are left out, physically impossible inertias, joints to which limits of
                joints that mimic them leave a single position.
        """
        place = {"tip_translation": tip_translation, "tip_rotation": tip_rotation}
        return cls._from_description(read_urdf(source, inertia=inertia), tip, root, lock=lock, mimic=mimic, **place)

    @classmethod
    def from_mjcf(
        cls,
        source: Source,
        *,
        tip: str | None = None,
        root: str | None = None,
        tip_translation: ArrayInput = (0.0, 0.0, 0.0),
        tip_rotation: ArrayInput = None,
        lock: Mapping[str, float] | None = None,
        mimic: MimicRule = "couple",
    ) -> Robot:
        """Read a robot in MJCF, the XML format of MuJoCo, from a text or file with the package `mujoco`.

        `models.robot.mjcf.read_mjcf` documents contents and defaults. `excluded_pairs` reads the pairs of bodies that
        the description excludes from contact.

        Args:
            source: The text, recognised by its first character "<", or the path of a file.
            tip: Body or named site that carries the tip; the only leaf of the tree if None.
            root: As in from_urdf, with the root "world".
            tip_translation, tip_rotation, lock, mimic: As in from_urdf.

        Raises:
            ModelError: As read_mjcf, Robot and `models.robot.rebuild.lock_joints`.

        Warns:
            ModelWarning: As read_mjcf; joints to which limits of joints that mimic them leave a single position.
        """
        place = {"tip_translation": tip_translation, "tip_rotation": tip_rotation}
        return cls._from_description(read_mjcf(source), tip, root, lock=lock, mimic=mimic, **place)

    @classmethod
    def _from_description(
        cls,
        description: Description,
        tip: str | None,
        root: str | None,
        *,
        lock: Mapping[str, float] | None,
        mimic: MimicRule,
        tip_translation: ArrayInput,
        tip_rotation: ArrayInput,
    ) -> Robot:
        """Return the robot of a URDF or MJCF description with the requested root, tip, locked and mimic joints."""
        require.choice("robot: mimic", mimic, get_args(MimicRule))
        joints = description.joints
        if mimic == "free":
            joints = tuple(replace(joint, mimic=None) for joint in joints)
        names = {joint.name: None for joint in joints}
        positions = {} if lock is None else require.mapping("robot: lock", lock)
        for name in positions:
            if name not in names:
                raise require.unknown("joint", name, names)
        joints = lock_with_followers(joints, positions)
        if mimic == "lock":
            joints = lock_with_followers(joints, {name: tie.offset for name, tie in resolve_mimics(joints).items()})
        links = description.links
        if root is not None:
            original = cls(links, joints, tip=links[0].name)  # validates the tree before it is rerooted
            links, joints = reroot_tree(links, joints, original.root, root)
        turn = np.eye(3) if tip_rotation is None else tip_rotation
        robot = cls(links, joints, description.tip if tip is None else tip, tip_translation, turn, description.name)
        ranges = zip(robot.moving_joints, robot.lower, robot.upper, strict=True)
        if stuck := [joint.name for joint, lower, upper in ranges if lower == upper and joint.lower < joint.upper]:
            warn(f"joints {stuck} cannot move: limits of joints that follow them leave one position", ModelWarning, 3)
        return robot

    def to_urdf(self, file: str | os.PathLike[str] | None = None) -> str:
        """Return the robot as URDF text, from which from_urdf recreates it; also write it to `file` if given.

        See `models.robot.parts.urdf_text` for how other readers interpret it. The file is replaced atomically.
        """
        place: dict[str, Any] = {"translation": self.tip_translation, "rotation": self.tip_rotation}
        text = urdf_text(self.name, self.links, self.joints, self.tip, **place)
        if file is not None:
            if not isinstance(file, str | os.PathLike):
                raise ModelError(f"to_urdf: file must be a path, not {file!r}", name="file", value=file)
            part = Path(file).with_name(f"{Path(file).name}.{secrets.token_hex(4)}.part")
            with part.open("x", encoding="utf-8") as stream:  # refuses to follow an existing link
                stream.write(text)
            part.replace(file)
        return text

    @cached_property
    def moving_joints(self) -> tuple[Joint, ...]:
        """Joints that move independently, in tree order: the order of every joint vector."""
        return tuple(joint for joint in self.joints if joint.moves and joint.mimic is None)

    @cached_property
    def couplings(self) -> dict[str, JointCoupling]:
        """Coupling of each moving joint's position to an entry of the joint vector, by joint name."""
        return joint_couplings(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the independently moving joints, in the order of the joint vector."""
        return tuple(joint.name for joint in self.moving_joints)

    def unit(self, per: str = "") -> str:
        """Return the units of the joint positions, "rad", "m" or "rad, m", each followed by `per`, such as "/s"."""
        return ", ".join(dict.fromkeys(joint.unit + require.text("unit: per", per) for joint in self.moving_joints))

    @property
    def effort_unit(self) -> str:
        """Units of joint torques and forces: "N m", "N", or both separated by a comma in the order of the joints."""
        return ", ".join(dict.fromkeys(joint.effort_unit for joint in self.moving_joints))

    @property
    def dof(self) -> int:
        """Number of independently moving joints: the length of the joint vector."""
        return len(self.moving_joints)

    @property
    def total_mass(self) -> float:
        """Mass of all links of the robot, kg."""
        return float(sum(link.mass for link in self.links))

    @cached_property
    def _limits(self) -> dict[str, Array]:
        return joint_limits(self.joints, self.couplings)

    @property
    def lower(self) -> Array:
        """Lower position limits of the joints, raised by limits of joints that mimic them. Shape (dof,), rad or m."""
        return self._limits["lower"].copy()

    @property
    def upper(self) -> Array:
        """Upper position limits of the joints, lowered by limits of joints that mimic them. Shape (dof,), rad or m."""
        return self._limits["upper"].copy()

    @property
    def velocity(self) -> Array:
        """Joint speed limits, lowered by limits of mimic joints; infinite if unknown. Shape (dof,), rad/s or m/s."""
        return self._limits["velocity"].copy()

    @property
    def effort(self) -> Array:
        """Torque or force limits of the joints' own actuators; infinite if unknown. Shape (dof,), N m or N."""
        return self._limits["effort"].copy()

    @cached_property
    def _links_by_name(self) -> dict[str, Link]:
        return {link.name: link for link in self.links}

    @cached_property
    def _joints_by_name(self) -> dict[str, Joint]:
        return {joint.name: joint for joint in self.joints}

    @cached_property
    def _joint_above(self) -> dict[str, Joint]:
        return {joint.child: joint for joint in self.joints}

    def link(self, name: str) -> Link:
        """Return the link with a given name; raise ModelError, which lists similar names, for an unknown name."""
        if not isinstance(name, str) or name not in self._links_by_name:
            raise require.unknown("link", name, self._links_by_name)
        return self._links_by_name[name]

    def joint(self, name: str) -> Joint:
        """Return the moving or fixed joint with a given name; raise ModelError, listing similar names, if unknown."""
        if not isinstance(name, str) or name not in self._joints_by_name:
            raise require.unknown("joint", name, self._joints_by_name)
        return self._joints_by_name[name]

    def path_to(self, name: str) -> tuple[Joint, ...]:
        """Return the joints from the root to a link, beginning at the root; raise ModelError for an unknown link."""
        self.link(name)
        path: list[Joint] = []
        while name != self.root:
            path.append(self._joint_above[name])
            name = path[-1].parent
        return tuple(reversed(path))

    def __repr__(self) -> str:
        return f"<Robot {self.name!r}: {len(self.links)} links, {self.dof} degrees of freedom, tip on {self.tip}>"

    def __str__(self) -> str:
        lines = [
            f"{self.name} of {len(self.links)} links, {self.dof} degrees of freedom, "
            f"{self.total_mass:g} kg, {'no tip' if self.tip is None else f'tip on {self.tip}'}",
            f"{self.root}  {self.link(self.root).mass:g} kg",
        ]
        children = defaultdict(list)
        for joint in self.joints:
            children[joint.parent].append(joint)
        waiting = [(joint, "") for joint in reversed(children[self.root])]
        while waiting:
            joint, indent = waiting.pop()
            last = joint is children[joint.parent][-1]
            lines.append(
                f"{indent}{'└─' if last else '├─'} {joint.name} ({_joint_text(joint)}) -> {joint.child}  "
                f"{self.link(joint.child).mass:g} kg"
            )
            indent += "   " if last else "│  "
            waiting += [(each, indent) for each in reversed(children[joint.child])]
        return "\n".join(lines)


def _joint_text(joint: Joint) -> str:
    unit, parts = joint.unit, [str(joint.kind)]
    if (tie := joint.mimic) is not None:
        parts.append(f"{tie.multiplier:g} x {tie.joint}" + (f" {tie.offset:+g} {unit}" if tie.offset else ""))
    if np.isfinite([joint.lower, joint.upper]).any() and joint.moves:
        parts.append(f"{joint.lower:g} .. {joint.upper:g} {unit}")
    if 0 < joint.velocity < np.inf and joint.moves:
        parts.append(f"{joint.velocity:g} {unit}/s")
    if 0 < joint.effort < np.inf and joint.moves:
        parts.append(f"{joint.effort:g} {joint.effort_unit}")
    return ", ".join(parts)


def named_states(srdf: Source, robot: Robot) -> dict[str, Array]:
    """Return the named states of an SRDF file, such as "home", as joint vectors. Shape (dof,) each, rad or m.

    A state, <group_state>, gives the positions of the joints of one group. The other joints are at 0, or at the limit
    nearest to 0 if their limits exclude it. Fixed and mimic joints are skipped. If several groups have a state of one
    name, its key is "GROUP/NAME".

    Args:
        srdf: The text, recognised by its first character "<", or the path of a file.
        robot: The robot, whose joints the file names.

    Raises:
        ModelError: The file is unreadable, or a state has no name, no group, or a position that is not a finite number.

    Warns:
        ModelWarning: The file names joints that the robot does not have.
    """
    require.instance("named_states: robot", robot, Robot)
    elements = [(text_of(each, "name", "SRDF"), each) for each in parse_urdf(srdf).findall("group_state")]
    counts = Counter(name for name, _ in elements)
    columns = {name: column for column, name in enumerate(robot.joint_names)}
    known = {joint.name for joint in robot.joints}
    states, unknown = {}, set()
    for name, element in elements:
        owner = f"SRDF: state {name!r}"
        positions = np.clip(np.zeros(robot.dof), robot.lower, robot.upper)
        for each in element.findall("joint"):
            joint = text_of(each, "name", owner)
            if joint in columns:
                positions[columns[joint]] = numbers_of(each, "value", f"{owner}: joint {joint!r}", 1)[0]
            elif joint not in known:
                unknown.add(joint)
        states[name if counts[name] == 1 else f"{text_of(element, 'group', owner)}/{name}"] = positions
    if unknown:
        names = ", ".join(map(repr, sorted(unknown)))
        message = f"the SRDF file gives states to joints that {robot.name!r} does not have: {names}"
        warn(ModelWarning(message, name=min(unknown), value=tuple(sorted(unknown))), stacklevel=2)
    return states


def planar_chain(
    lengths: ArrayInput,
    masses: ArrayInput,
    inertias: ArrayInput | None = None,
    *,
    mount: ArrayInput = (0.0, 0.0),
    base: Link | None = None,
) -> Robot:
    """Return a planar arm of revolute joints about z; its links lie along x if all joint angles are zero.

    Centres of mass are at mid-link.

    Args:
        lengths: Link lengths. Shape (n,), m.
        masses: Link masses. Shape (n,), kg.
        inertias: Moments about z through the centres of mass. Shape (n,), kg m^2; those of slender rods, m l^2 / 12, if
            None.
        mount: First joint in the base link frame (x, y). Shape (2,), m.
        base: Root link; a massless "base" if None.

    Returns:
        Robot with links "link1".. on joints "joint1".. and the tip at the end of the last link.

    Raises:
        ModelError: Sizes that differ, no link, an impossible mass or inertia.
    """
    owner = "planar chain"
    lengths = require.array(f"{owner}: lengths", lengths, ("links",), unit="m", sign="positive")
    count = len(lengths)
    masses = require.array(f"{owner}: masses", masses, (count,))
    moments = require.array(f"{owner}: inertias", masses * lengths**2 / 12 if inertias is None else inertias, (count,))
    mount = require.array(f"{owner}: mount", mount, (2,))
    links, joints = [Link("base") if base is None else require.instance(f"{owner}: base", base, Link)], []
    for i in range(count):
        # Only the moment about z affects a planar machine; the others are those of a lamina.
        inertia = np.diag([moments[i] / 2, moments[i] / 2, moments[i]])
        links.append(Link(f"link{i + 1}", masses[i], (lengths[i] / 2, 0.0, 0.0), inertia))
        place = (*mount, 0.0) if i == 0 else (lengths[i - 1], 0.0, 0.0)
        joints.append(Joint(f"joint{i + 1}", "revolute", links[i].name, links[i + 1].name, translation=place))
    return Robot(tuple(links), tuple(joints), tip_translation=(lengths[-1], 0.0, 0.0))
