"""A robot as a kinematic tree of links and joints, checked when it is made."""

from __future__ import annotations

import os
import secrets
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, TypeAlias, get_args
from warnings import warn

import numpy as np

from models.arrays import (
    Array,
    ArrayInput,
    checked_array,
    checked_choice,
    checked_each,
    checked_instance,
    checked_mapping,
    checked_name,
    checked_rotation,
    checked_text,
    warn_of_millimetres,
)
from models.errors import ModelError, ModelWarning
from models.robot.parts import Joint, Link
from models.robot.tree import (
    JointCoupling,
    find_root,
    joint_couplings,
    joint_limits,
    lock_with_followers,
    require_unique,
    reroot_tree,
    ties_to_leaders,
    tree_order,
    unknown_name,
)
from models.robot.urdf import InertiaRule, Source, read_urdf, urdf_text

MimicRule: TypeAlias = Literal["couple", "lock", "free"]


@dataclass(frozen=True, eq=False)
class Robot:
    """A kinematic tree of links, with one frame of interest, the tip.

    Attributes:
        links: Every link, in the order given.
        joints: Every joint, parents first; the order given is kept wherever it already is such an order. Joints that
            follow one that does not move are fixed.
        tip: Name of the link that carries the tip; when not given the only leaf, None where there are several.
        tip_translation: Tip frame's origin in the tip link's frame. Shape (3,), m.
        tip_rotation: Tip frame's axes, as columns, in the tip link's frame. Shape (3, 3).
        name: What the robot is called in texts.
        root: Name of the link without a parent, the base.

    Raises:
        ModelError: Duplicate or unknown names, a loop, several roots, wrong sizes; joints that follow none that exists
            or each other in a ring, or whose limits leave the joint that they follow no position.
    """

    links: tuple[Link, ...]
    joints: tuple[Joint, ...] = ()
    tip: str | None = None
    tip_translation: ArrayInput = (0.0, 0.0, 0.0)
    tip_rotation: ArrayInput = field(default_factory=lambda: np.eye(3))
    name: str = "robot"
    root: str = field(init=False)

    def __post_init__(self) -> None:
        links, joints = (
            checked_each(self.links, Link, "robot", "links"),
            checked_each(self.joints, Joint, "robot", "joints"),
        )
        if not (isinstance(self.name, str) and self.name == ""):  # a description may leave it out
            checked_name(self.name, "robot", "name")
        require_unique((link.name for link in links), "link")
        require_unique((joint.name for joint in joints), "joint")
        joints = lock_with_followers(joints, {})
        edges = [(joint.name, joint.parent, joint.child) for joint in joints]
        root = find_root([link.name for link in links], edges)
        object.__setattr__(self, "root", root)
        object.__setattr__(self, "links", links)
        object.__setattr__(self, "joints", tuple(joints[i] for i in tree_order(root, edges)))
        object.__setattr__(self, "tip", self._find_tip())
        owner = "robot"
        object.__setattr__(self, "tip_translation", checked_array(self.tip_translation, (3,), owner, "tip_translation"))
        object.__setattr__(self, "tip_rotation", checked_rotation(self.tip_rotation, owner, "tip_rotation"))
        warn_of_millimetres(self.tip_translation, owner, "tip_translation", "tip_translation")
        _ = self._limits  # raises where followers leave a joint no position

    def _find_tip(self) -> str | None:
        names = [link.name for link in self.links]
        if self.tip is not None and (not isinstance(self.tip, str) or self.tip not in names):
            raise unknown_name("tip link", self.tip, names)
        leaves = self._leaves
        return self.tip if self.tip is not None else leaves[0] if len(leaves) == 1 else None

    @property
    def _leaves(self) -> list[str]:
        parents = {joint.parent for joint in self.joints}
        return [link.name for link in self.links if link.name not in parents]

    @property
    def tip_link(self) -> str:
        """Name of the link that carries the tip; ModelError, which says how to give it, where there is none."""
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
        """The robot of a URDF description; `models.robot.urdf.read_urdf` says what is read, with which defaults.

        Args:
            source: The text, recognised by its first character "<", or the path of a file.
            tip: Link that carries the tip; if None the one that the file names as to_urdf does, else the only leaf.
            root: Link to hang the tree up at, the base of the robot; the root of the file if None. Links keep their
                frames, joints their names, limits and signs, see `models.robot.tree.reroot_tree`.
            tip_translation: As of Robot.
            tip_rotation: As of Robot; no turn if None.
            lock: Joints to hold fixed at given positions (rad or m), by name, and with them the joints that follow.
            mimic: Joints that follow another one: move with it ("couple"), hold each where it is when the joint that
                it follows is at 0 ("lock"), or take all, also those of locked joints, as independent ("free").
            inertia: What to do about inertias that no body can have: "warn" that they are taken, or take them
                "as_given" without a word.

        Raises:
            ModelError: What read_urdf, Robot and `models.robot.rebuild.lock_joints` refuse.

        Warns:
            ModelWarning: Inertias that no body can have, attributes that mean nothing in URDF, joints whose followers'
                limits leave them one position.
        """
        checked_choice(mimic, get_args(MimicRule), "URDF", "mimic")
        found = read_urdf(source, inertia=inertia)
        joints = found.joints if mimic != "free" else tuple(replace(joint, mimic=None) for joint in found.joints)
        known = {joint.name: None for joint in joints}
        positions = {} if lock is None else checked_mapping(lock, "URDF", "lock")
        for name in positions:
            if name not in known:
                raise unknown_name("joint", name, known)
        joints = lock_with_followers(joints, positions)
        if mimic == "lock":
            joints = lock_with_followers(joints, {name: tie.offset for name, tie in ties_to_leaders(joints).items()})
        links = found.links
        if root is not None:
            whole = cls(links, joints, tip=links[0].name)  # says what is wrong with the tree before it is turned round
            links, joints = reroot_tree(links, joints, whole.root, root)
        turn = np.eye(3) if tip_rotation is None else tip_rotation
        robot = cls(links, joints, found.tip if tip is None else tip, tip_translation, turn, found.name)
        room = zip(robot.moving_joints, robot.lower, robot.upper, strict=True)
        if names := [joint.name for joint, lower, upper in room if lower == upper and joint.lower < joint.upper]:
            warn(f"joints {names} cannot move: limits of joints that follow them leave one position", ModelWarning, 2)
        return robot

    def to_urdf(self, file: str | os.PathLike[str] | None = None) -> str:
        """The robot as URDF text, of which from_urdf makes the same robot; written to a file too where one is given.

        See `models.robot.urdf.urdf_text` for what other readers make of it. The file is replaced as a whole.
        """
        place = np.asarray(self.tip_translation), np.asarray(self.tip_rotation)
        text = urdf_text(self.name, self.links, self.joints, self.tip, *place)
        if file is not None:
            if not isinstance(file, str | os.PathLike):
                raise ModelError(f"to_urdf: file must be a path, not {file!r}", name="file", value=file)
            part = Path(file).with_name(f"{Path(file).name}.{secrets.token_hex(4)}.part")
            with part.open("x", encoding="utf-8") as stream:  # a new file, where a link may lie in wait
                stream.write(text)
            part.replace(file)
        return text

    @cached_property
    def moving_joints(self) -> tuple[Joint, ...]:
        """Joints that move and follow no other, in tree order: the order of every joint vector."""
        return tuple(joint for joint in self.joints if joint.moves and joint.mimic is None)

    @cached_property
    def couplings(self) -> dict[str, JointCoupling]:
        """What moves each joint that moves, followers included, by name."""
        return joint_couplings(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the entries of the joint vector."""
        return tuple(joint.name for joint in self.moving_joints)

    def unit(self, per: str = "") -> str:
        """Unit of the joint vector, or with `per` "/s" of its rates: "rad", "m", or both, "rad, m", in its order."""
        return ", ".join(dict.fromkeys(joint.unit + checked_text(per, "unit", "per") for joint in self.moving_joints))

    @property
    def effort_unit(self) -> str:
        """Unit of the efforts of the joint vector, likewise: "N m", "N" or "N m, N"."""
        return ", ".join(dict.fromkeys(joint.effort_unit for joint in self.moving_joints))

    @property
    def dof(self) -> int:
        """Length of the joint vector."""
        return len(self.moving_joints)

    @property
    def total_mass(self) -> float:
        """kg."""
        return float(sum(link.mass for link in self.links))

    @cached_property
    def _limits(self) -> dict[str, Array]:
        return joint_limits(self.joints, self.couplings)

    @property
    def lower(self) -> Array:
        """Least positions of the joint vector, at which no follower passes its limits. Shape (dof,), rad or m."""
        return self._limits["lower"].copy()

    @property
    def upper(self) -> Array:
        """Greatest positions, likewise. Shape (dof,), rad or m."""
        return self._limits["upper"].copy()

    @property
    def velocity(self) -> Array:
        """Greatest speeds, likewise; infinite where a joint's is unknown. Shape (dof,), rad/s or m/s."""
        return self._limits["velocity"].copy()

    @property
    def effort(self) -> Array:
        """Greatest torques or forces of the joints' own drives, likewise. Shape (dof,), N m or N."""
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
        """The link of that name; ModelError, which says what names come near, when there is none."""
        if not isinstance(name, str) or name not in self._links_by_name:
            raise unknown_name("link", name, self._links_by_name)
        return self._links_by_name[name]

    def joint(self, name: str) -> Joint:
        """The joint of that name, moving or fixed; ModelError, as for a link, when there is none."""
        if not isinstance(name, str) or name not in self._joints_by_name:
            raise unknown_name("joint", name, self._joints_by_name)
        return self._joints_by_name[name]

    def path_to(self, name: str) -> tuple[Joint, ...]:
        """Joints from the root to a link, root first; ModelError when there is no such link."""
        self.link(name)
        path: list[Joint] = []
        while name != self.root:
            path.append(self._joint_above[name])
            name = path[-1].parent
        return tuple(reversed(path))

    def print(self) -> None:
        """Print the tree with masses and limits, which is also `str(robot)`. A limit that is not there is not shown."""
        print(self)

    def __repr__(self) -> str:
        return f"<Robot {self.name!r}: {len(self.links)} links, {self.dof} degrees of freedom, tip on {self.tip}>"

    def __str__(self) -> str:
        lines = [
            f"{self.name} of {len(self.links)} links, {self.dof} degrees of freedom, "
            f"{self.total_mass:g} kg, {'no tip' if self.tip is None else f'tip on {self.tip}'}",
            f"{self.root}  {self.link(self.root).mass:g} kg",
        ]
        below = defaultdict(list)
        for joint in self.joints:
            below[joint.parent].append(joint)
        waiting = [(joint, "") for joint in reversed(below[self.root])]
        while waiting:
            joint, indent = waiting.pop()
            last = joint is below[joint.parent][-1]
            lines.append(
                f"{indent}{'└─' if last else '├─'} {joint.name} ({_limits(joint)}) -> {joint.child}  "
                f"{self.link(joint.child).mass:g} kg"
            )
            indent += "   " if last else "│  "
            waiting += [(each, indent) for each in reversed(below[joint.child])]
        return "\n".join(lines)


def _limits(joint: Joint) -> str:
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


def planar_chain(
    lengths: ArrayInput,
    masses: ArrayInput,
    inertias: ArrayInput | None = None,
    *,
    mount: ArrayInput = (0.0, 0.0),
    base: Link | None = None,
) -> Robot:
    """Arm of revolute joints about z whose links lie along x at zero joint angles.

    Centres of mass at mid-link.

    Args:
        lengths: Link lengths. Shape (n,), m.
        masses: Link masses. Shape (n,), kg.
        inertias: Moments about z through the centres of mass. Shape (n,), kg m^2; slender rods, m l^2 / 12,
            if None.
        mount: First joint in the base link frame (x, y). Shape (2,), m.
        base: Root link; a massless "base" if None.

    Returns:
        Robot with links "link1".. on joints "joint1".. and the tip at the end of the last link.

    Raises:
        ModelError: Sizes that differ, no link, a mass or an inertia that is impossible.
    """
    owner = "planar chain"
    lengths = checked_array(lengths, ("links",), owner, "lengths", positive=True, unit="m")
    count = len(lengths)
    masses = checked_array(masses, (count,), owner, "masses")
    moments = checked_array(masses * lengths**2 / 12 if inertias is None else inertias, (count,), owner, "inertias")
    mount = checked_array(mount, (2,), owner, "mount")
    root = Link("base") if base is None else checked_instance(base, Link, owner, "base")
    links, joints = [root], []
    for i in range(count):
        # Only the moment about z matters to a planar machine; the others are those of a lamina.
        inertia = np.diag([moments[i] / 2, moments[i] / 2, moments[i]])
        links.append(Link(f"link{i + 1}", masses[i], (lengths[i] / 2, 0.0, 0.0), inertia))
        place = (*mount, 0.0) if i == 0 else (lengths[i - 1], 0.0, 0.0)
        joints.append(Joint(f"joint{i + 1}", "revolute", links[i].name, links[i + 1].name, translation=place))
    return Robot(tuple(links), tuple(joints), tip_translation=(lengths[-1], 0.0, 0.0))
