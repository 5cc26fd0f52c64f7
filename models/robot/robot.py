"""A robot as a kinematic tree of links and joints, checked when it is made."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from models.arrays import Array, ArrayInput, checked_array, checked_rotation
from models.errors import ModelError
from models.robot.parts import Joint, Link
from models.robot.tree import absent, find_root, require_unique, reroot, tree_order
from models.robot.urdf import InertiaRule, MimicRule, Source, held_by_mimicry, read_urdf


@dataclass(frozen=True, eq=False)
class Robot:
    """A kinematic tree of links, with one frame of interest, the tip.

    Attributes:
        links: Every link, in the order given.
        joints: Every joint, parents first; the order given is kept wherever it already is such an order.
        tip: Name of the link that carries the tip; the only leaf when not given.
        tip_translation: Tip frame's origin in the tip link's frame. Shape (3,), m.
        tip_rotation: Tip frame's axes, as columns, in the tip link's frame. Shape (3, 3).
        name: What the robot is called in texts.
        root: Name of the link without a parent, the base.

    Raises:
        ModelError: Duplicate or unknown names, a loop, several roots, several leaves and no tip, wrong sizes.
    """

    links: tuple[Link, ...]
    joints: tuple[Joint, ...] = ()
    tip: str | None = None
    tip_translation: ArrayInput = (0.0, 0.0, 0.0)
    tip_rotation: ArrayInput = field(default_factory=lambda: np.eye(3))
    name: str = "robot"
    root: str = field(init=False)

    def __post_init__(self) -> None:
        links, joints = tuple(self.links), tuple(self.joints)
        require_unique((link.name for link in links), "link")
        require_unique((joint.name for joint in joints), "joint")
        edges = [(joint.name, joint.parent, joint.child) for joint in joints]
        root = find_root([link.name for link in links], edges)
        object.__setattr__(self, "root", root)
        object.__setattr__(self, "links", links)
        object.__setattr__(self, "joints", tuple(joints[i] for i in tree_order(root, edges)))
        object.__setattr__(self, "tip", self._find_tip())
        owner = "robot"
        object.__setattr__(self, "tip_translation", checked_array(self.tip_translation, (3,), owner, "tip_translation"))
        object.__setattr__(self, "tip_rotation", checked_rotation(self.tip_rotation, owner, "tip_rotation"))

    def _find_tip(self) -> str:
        names = [link.name for link in self.links]
        if self.tip is not None:
            if self.tip not in names:
                raise absent("tip link", self.tip, names)
            return self.tip
        parents = {joint.parent for joint in self.joints}
        leaves = [name for name in names if name not in parents]
        if len(leaves) > 1:
            raise ModelError(f"the tree has the leaves {leaves}; say which carries the tip: tip=name")
        return leaves[0]

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
        mimic: MimicRule = "error",
        inertia: InertiaRule = "error",
    ) -> Robot:
        """The robot of a URDF description; `models.robot.urdf.read_urdf` says what is read, with which defaults.

        Args:
            source: The text, recognised by its first character "<", or the path of a file.
            tip: Link that carries the tip; needed where the tree has several leaves.
            root: Link to hang the tree up at, the base of the robot; the root of the file if None. Links keep their
                frames, joints their names, limits and signs, see `models.robot.tree.reroot`.
            tip_translation: As of Robot.
            tip_rotation: As of Robot; no turn if None.
            lock: Joints to hold fixed at given positions (rad or m), by name.
            mimic: Joints that follow one that is locked or fixed are held with it. The other followers: refuse them
                ("error"), hold each where it is when the joint that it follows is at 0 ("lock"), or take them as
                independent ("free").
            inertia: What to do about an inertia that no body can have: refuse it ("error") or take it "as_given".

        Raises:
            ModelError: What read_urdf, Robot and `models.robot.rebuild.locked` refuse.
        """
        found = read_urdf(source, inertia=inertia)
        held = dict(lock or {})
        moving = {joint.name: joint for joint in found.joints}
        for name in held:
            if name not in moving:
                raise absent("joint", name, moving)
        held |= held_by_mimicry(found.joints, found.mimics, held, mimic)
        joints = tuple(joint.locked(held[joint.name]) if joint.name in held else joint for joint in found.joints)
        links = found.links
        if root is not None:
            whole = cls(links, joints, tip=links[0].name)  # says what is wrong with the tree before it is turned round
            links, joints = reroot(links, joints, whole.root, root)
        turn = np.eye(3) if tip_rotation is None else tip_rotation
        return cls(links, joints, tip, tip_translation, turn, found.name)

    @cached_property
    def moving_joints(self) -> tuple[Joint, ...]:
        """Joints with a degree of freedom, in tree order: the order of every joint vector."""
        return tuple(joint for joint in self.joints if joint.moves)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the moving joints, in tree order."""
        return tuple(joint.name for joint in self.moving_joints)

    @property
    def dof(self) -> int:
        """Number of moving joints."""
        return len(self.moving_joints)

    @property
    def total_mass(self) -> float:
        """kg."""
        return float(sum(link.mass for link in self.links))

    @property
    def lower(self) -> Array:
        """Least positions of the moving joints. Shape (dof,), rad or m."""
        return np.array([joint.lower for joint in self.moving_joints], dtype=float)

    @property
    def upper(self) -> Array:
        """Greatest positions of the moving joints. Shape (dof,), rad or m."""
        return np.array([joint.upper for joint in self.moving_joints], dtype=float)

    @property
    def velocity(self) -> Array:
        """Greatest speeds of the moving joints. Shape (dof,), rad/s or m/s."""
        return np.array([joint.velocity for joint in self.moving_joints], dtype=float)

    @property
    def effort(self) -> Array:
        """Greatest torques or forces of the moving joints. Shape (dof,), N m or N."""
        return np.array([joint.effort for joint in self.moving_joints], dtype=float)

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
        if name not in self._links_by_name:
            raise absent("link", name, self._links_by_name)
        return self._links_by_name[name]

    def joint(self, name: str) -> Joint:
        """The joint of that name, moving or fixed; ModelError, as for a link, when there is none."""
        if name not in self._joints_by_name:
            raise absent("joint", name, self._joints_by_name)
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

    def __str__(self) -> str:
        lines = [
            f"{self.name} of {len(self.links)} links, {self.dof} degrees of freedom, "
            f"{self.total_mass:g} kg, tip on {self.tip}",
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
    unit, push = ("m", "N") if joint.kind == "prismatic" else ("rad", "N m")
    parts: list[str] = [joint.kind]
    if np.isfinite([joint.lower, joint.upper]).any() and joint.moves:
        parts.append(f"{joint.lower:g} .. {joint.upper:g} {unit}")
    if np.isfinite(joint.velocity) and joint.moves:
        parts.append(f"{joint.velocity:g} {unit}/s")
    if np.isfinite(joint.effort) and joint.moves:
        parts.append(f"{joint.effort:g} {push}")
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
    lengths = np.atleast_1d(np.asarray(lengths, dtype=float))
    count = lengths.shape[0]
    if lengths.ndim != 1 or count == 0:
        raise ModelError(f"planar chain: lengths must be a vector of at least one length, not of shape {lengths.shape}")
    lengths = checked_array(lengths, (count,), "planar chain", "lengths")
    masses = checked_array(masses, (count,), "planar chain", "masses")
    moments = checked_array(
        masses * lengths**2 / 12 if inertias is None else inertias, (count,), "planar chain", "inertias"
    )
    mount = checked_array(mount, (2,), "planar chain", "mount")
    root = base if base is not None else Link("base")
    links, joints = [root], []
    for i in range(count):
        # Only the moment about z matters to a planar machine; the others are those of a lamina.
        inertia = np.diag([moments[i] / 2, moments[i] / 2, moments[i]])
        links.append(Link(f"link{i + 1}", masses[i], (lengths[i] / 2, 0.0, 0.0), inertia))
        place = (*mount, 0.0) if i == 0 else (lengths[i - 1], 0.0, 0.0)
        joints.append(Joint(f"joint{i + 1}", "revolute", links[i].name, links[i + 1].name, translation=place))
    return Robot(tuple(links), tuple(joints), tip_translation=(lengths[-1], 0.0, 0.0))
