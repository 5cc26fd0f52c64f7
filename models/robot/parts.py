"""Parts of a robot: links, joints and shapes, validated on construction, and written as elements of URDF.

Array attributes accept anything that NumPy reads and are stored as read-only arrays of floats.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self, TypeAlias, get_args
from xml.etree import ElementTree

import casadi as ca
import numpy as np

from models.checks import Array, ArrayInput, freeze, require, set_fields, warn_of_degrees, warn_of_millimetres
from models.errors import ModelError
from models.spatial import rotation

Kind: TypeAlias = Literal["fixed", "revolute", "continuous", "prismatic"]
UNLIMITED = float(np.finfo(float).max)
"""Limit in a URDF file that stands for none, because readers refuse infinite ones."""
ShapeKind: TypeAlias = Literal["box", "sphere", "cylinder", "capsule", "mesh"]

SHAPES = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2, "mesh": 3}
"""Number of entries of the field `size` of a collision shape, by kind of shape."""
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
"""Attributes of <inertia> in URDF: the upper triangle of the inertia by rows."""
INERTIA_TOLERANCE = 1e-6
"""Relative tolerance of the inertia checks, so that inertias printed to six digits pass."""


@dataclass(frozen=True, eq=False)
class CollisionShape:
    """A shape that represents a link, or part of one, in collision checks.

    Attributes:
        kind: "box", "sphere", "cylinder", "capsule" or "mesh". Cylinders and capsules lie along z of the shape's frame.
        size: Edge lengths along x, y, z of a box; (radius,) of a sphere; (radius, length) of a cylinder, or of a
            capsule without its caps; scale along x, y, z of a mesh, negative to mirror it. m, except for the scale.
        file: File of a mesh as written in the description; it is not opened here.
        translation: Origin of the shape's frame in the link frame; the centre of all shapes but meshes. Shape (3,), m.
        rotation: Axes of the shape's frame, as columns, in the link frame. Shape (3, 3).
        folder: Folder of the description that names the file, where the file is searched first; "" if unknown.

    Raises:
        ModelError: Unknown kind, wrong sizes, a size that is not positive, a mesh without a file or with zero scale.
    """

    kind: ShapeKind
    size: ArrayInput
    file: str = ""
    translation: ArrayInput = (0.0, 0.0, 0.0)
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))
    folder: str = ""

    def __post_init__(self) -> None:
        size_length = SHAPES[require.choice("collision shape: kind", self.kind, SHAPES)]
        for argument in ("file", "folder"):
            require.text(f"collision shape: {argument}", getattr(self, argument))
        owner, mesh = f"collision {self.kind}", self.kind == "mesh"
        size = require.array(f"{owner}: size", self.size, (size_length,), sign="positive" if not mesh else "any")
        if mesh and not self.file:
            raise ModelError(f"{owner}: a mesh needs the name of its file", name="file", value=self.file)
        if not size.all():
            raise ModelError(f"{owner}: size {size.tolist()} scales it to nothing", name="size", value=size)
        set_fields(self, size=size, translation=require.array(f"{owner}: translation", self.translation, (3,)))
        if not mesh and not isinstance(self, VisualShape):
            warn_of_millimetres(f"{owner}: size", size)
        set_fields(self, rotation=require.rotation(f"{owner}: rotation", self.rotation))

    def placed(self, rotation: Array, translation: Array) -> Self:
        """Return the shape in another frame, in which its link has a given rotation (3, 3) and translation (3,), m."""
        turn = require.rotation("placed shape: rotation", rotation)
        shift = require.array("placed shape: translation", translation, (3,)) + turn @ self.translation
        return replace(self, translation=shift, rotation=turn @ self.rotation)


@dataclass(frozen=True, eq=False)
class VisualShape(CollisionShape):
    """A shape of a link for display only.

    Attributes:
        kind, size, file, translation, rotation, folder: As in CollisionShape; any size is accepted.
        color: Red, green, blue and opacity, 0 to 1; None if unspecified. Shape (4,).

    Raises:
        ModelError: As CollisionShape; an invalid color.
    """

    color: ArrayInput = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.color is None:
            return
        color = require.array(f"visual {self.kind}: color", self.color, (4,))
        if not ((color >= 0) & (color <= 1)).all():
            message = f"visual {self.kind}: color {color.tolist()} has entries outside 0 to 1"
            raise ModelError(message, name="color", value=color, limit=(0.0, 1.0))
        set_fields(self, color=color)


@dataclass(frozen=True, eq=False)
class Link:
    """A link of a robot: a rigid body with its inertia and its shapes.

    Attributes:
        name: Unique within the robot.
        mass: kg, not negative.
        center_of_mass: In the link frame. Shape (3,), m.
        inertia: About the centre of mass, in link axes. Shape (3, 3), kg m^2.
        any_inertia: Accept a physically impossible inertia, as some robot descriptions contain. It must be symmetric.
        collisions: Shapes that represent the link in collision checks.
        visuals: Shapes for display.

    Raises:
        ModelError: Negative or non-finite mass, wrong sizes, an inertia that no mass distribution has (not
            symmetric, not positive semidefinite, a principal moment above the sum of the two others).
    """

    name: str
    mass: float = 0.0
    center_of_mass: ArrayInput = (0.0, 0.0, 0.0)
    inertia: ArrayInput = field(default_factory=lambda: np.zeros((3, 3)))
    any_inertia: bool = False
    collisions: tuple[CollisionShape, ...] = ()
    visuals: tuple[VisualShape, ...] = ()

    def __post_init__(self) -> None:
        owner = f"link {require.name('link: name', self.name)!r}"
        require.flag(f"{owner}: any_inertia", self.any_inertia)
        mass = require.nonnegative(f"{owner}: mass", self.mass, unit="kg")
        inertia = require.array(f"{owner}: inertia", self.inertia, (3, 3))
        _check_inertia(inertia, owner, self.any_inertia)
        set_fields(self, mass=mass, center_of_mass=require.array(f"{owner}: center_of_mass", self.center_of_mass, (3,)))
        warn_of_millimetres(f"{owner}: center_of_mass", self.center_of_mass, self.name)
        set_fields(self, inertia=freeze((inertia + inertia.T) / 2))
        set_fields(self, collisions=require.each(f"{owner}: collisions", self.collisions, CollisionShape))
        set_fields(self, visuals=require.each(f"{owner}: visuals", self.visuals, VisualShape))


@dataclass(frozen=True)
class Mimic:
    """Coupling of a joint that mimics another: its position is multiplier times that joint's position, plus offset.

    Attributes:
        joint: Name of the joint that is mimicked, which may itself mimic another.
        multiplier: rad or m per rad or m of that joint.
        offset: rad or m.

    Raises:
        ModelError: A number that is not finite.
    """

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        owner = f"mimic of joint {require.name('mimic: joint', self.joint)!r}"
        for argument in ("multiplier", "offset"):
            set_fields(self, **{argument: require.number(f"{owner}: {argument}", getattr(self, argument))})


@dataclass(frozen=True, eq=False)
class Joint:
    """A connection of a child link to a parent link: fixed, or moving with one degree of freedom.

    The joint frame has the pose `translation`, `rotation` in the parent link frame (URDF convention). The child link
    frame is the joint frame rotated about `axis` (revolute, continuous) or translated along it (prismatic).

    Attributes:
        name: Unique within the robot.
        kind: "fixed", "revolute", "continuous" (a revolute joint without position limits) or "prismatic".
        parent: Name of the parent link.
        child: Name of the child link.
        translation: Joint frame's origin in the parent link frame. Shape (3,), m.
        rotation: Joint frame's axes, as columns, in the parent link frame. Shape (3, 3).
        axis: In the joint frame; stored with unit length. Shape (3,).
        lower: Lower position limit, rad or m.
        upper: Upper position limit, rad or m.
        velocity: Speed limit, rad/s or m/s; 0, as in many URDF files, means unknown and hence no limit.
        effort: Torque or force limit, N m or N; 0 likewise.
        mimic: Coupling to the joint that it follows; None for an independent joint.

    Raises:
        ModelError: Unknown kind, wrong sizes, zero axis, an invalid rotation, lower > upper, a negative limit, position
            limits of a continuous joint, a fixed joint that follows another.

    Warns:
        ModelWarning: Limits that look like degrees, an origin that looks like millimetres.
    """

    name: str
    kind: Kind
    parent: str
    child: str
    translation: ArrayInput = (0.0, 0.0, 0.0)
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))
    axis: ArrayInput = (0.0, 0.0, 1.0)
    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = np.inf
    effort: float = np.inf
    mimic: Mimic | None = None

    def __post_init__(self) -> None:
        owner = f"joint {require.name('joint: name', self.name)!r}"
        require.choice(f"{owner}: kind", self.kind, get_args(Kind))
        for role in ("parent", "child"):
            require.name(f"{owner}: {role}", getattr(self, role))
        if self.mimic is not None:
            require.instance(f"{owner}: mimic", self.mimic, Mimic)
        axis = require.array(f"{owner}: axis", self.axis, (3,))
        length = float(np.linalg.norm(axis))
        if not length > 0:
            raise ModelError(f"{owner}: axis {axis.tolist()} has no direction", name="axis", value=axis)
        set_fields(self, axis=freeze(axis / length))
        set_fields(self, translation=require.array(f"{owner}: translation", self.translation, (3,)))
        set_fields(self, rotation=require.rotation(f"{owner}: rotation", self.rotation))
        for name in ("lower", "upper", "velocity", "effort"):
            limit = require.number(f"{owner}: {name}", getattr(self, name), finite=False)
            set_fields(self, **{name: limit})
            if name in ("velocity", "effort") and limit < 0:
                raise ModelError(f"{owner}: {name} limit {limit} is negative", name=name, value=limit, limit=0.0)
        limits = (self.lower, self.upper)
        if self.lower > self.upper:
            message = f"{owner}: lower limit {self.lower} is above upper limit {self.upper}"
            raise ModelError(message, name="lower", value=self.lower, limit=self.upper)
        if self.lower == np.inf or self.upper == -np.inf:
            message = f"{owner}: limits {self.lower} .. {self.upper} leave no position"
            raise ModelError(message, name="limits", value=limits)
        if self.kind == "continuous" and np.isfinite(limits).any():
            message = (
                f"{owner}: a continuous joint has no position limits, but {self.lower} .. {self.upper} is "
                "given; make it revolute or leave them out"
            )
            raise ModelError(message, name="limits", value=limits, limit=(-np.inf, np.inf))
        warn_of_millimetres(f"{owner}: translation", self.translation, self.name)
        if self.kind == "revolute":
            warn_of_degrees(f"{owner}: limit", limits, self.name)
        if self.mimic is not None and not self.moves:
            message = f"{owner} is fixed and cannot follow joint {self.mimic.joint!r}"
            raise ModelError(message, name=self.name, value=self.mimic.joint)

    @property
    def moves(self) -> bool:
        """Whether the joint can move, independently or as a mimic of another joint; False if it is fixed."""
        return self.kind != "fixed"

    @property
    def unit(self) -> str:
        """Unit of the joint's position: "m" for a prismatic joint, else "rad"."""
        return "m" if self.kind == "prismatic" else "rad"

    @property
    def effort_unit(self) -> str:
        """Unit of the joint's effort: "N" for a prismatic joint, else "N m"."""
        return "N" if self.kind == "prismatic" else "N m"

    def placed(self, position: float) -> tuple[Array, Array]:
        """Return rotation (3, 3) and translation (3,), m, of the child link in the parent link at a joint position."""
        turn, shift = self.rotation, self.translation
        position = require.number(f"joint {self.name!r}: position", position)
        if self.kind == "prismatic":
            return turn, shift + position * (turn @ self.axis)
        return (turn @ np.array(ca.DM(rotation(self.axis, position))) if self.moves else turn), shift

    def locked(self, position: float) -> Joint:
        """Return this joint fixed at a given position (rad or m), which may be outside the joint's limits.

        Raises:
            ModelError: The joint is already fixed, or the position is not finite.
        """
        if not self.moves:
            message = f"joint {self.name!r} is fixed; only a joint that moves can be locked"
            raise ModelError(message, name=self.name, value=self.kind)
        turn, shift = self.placed(require.number(f"joint {self.name!r}: locked position", position))
        return Joint(self.name, "fixed", self.parent, self.child, shift, turn, self.axis)


def massless_error(consequence: str) -> ModelError:
    """Return the error about a robot without mass; `consequence` states what is impossible without mass."""
    message = f"the robot has no mass, {consequence}: give its links masses; in URDF none has an <inertial>"
    return ModelError(message, name="mass", value=0.0, limit=0.0)


def _check_inertia(inertia: Array, owner: str, any_inertia: bool) -> None:
    slack = INERTIA_TOLERANCE * float(np.abs(inertia).max())
    if np.abs(inertia - inertia.T).max() > slack:
        raise ModelError(f"{owner}: inertia {inertia.tolist()} is not symmetric", name="inertia", value=inertia)
    if any_inertia:
        return
    smallest, middle, largest = np.linalg.eigvalsh(inertia / 2 + inertia.T / 2)
    if smallest < -slack:
        message = f"{owner}: inertia has the negative principal moment {smallest:g} kg m^2"
        raise ModelError(message, name="inertia", value=float(smallest), limit=0.0)
    if largest > smallest + middle + slack:
        message = (
            f"{owner}: inertia has principal moments {smallest:g}, {middle:g}, {largest:g} kg m^2, which violate the "
            "triangle inequality: none may exceed the sum of the two others"
        )
        raise ModelError(message, name="inertia", value=float(largest), limit=float(smallest + middle))


def urdf_text(
    name: str, links: Sequence[Link], joints: Sequence[Joint], tip: str | None, *, translation: Array, rotation: Array
) -> str:
    """Return a robot as URDF text, from which `read_urdf` recreates links, joints and tip exactly.

    A tip frame that differs from its link's frame, (3,) and (3, 3) as in Robot, becomes a link "LINK_tip" on a fixed
    joint. The tip is named by <tip link="NAME"/>, a non-standard element that other readers skip. A revolute joint
    without position limits becomes a continuous joint, which is the same. urdfdom, and so ROS and Pinocchio, requires
    finite limits of effort and velocity, so that infinite limits are written as the largest number, `UNLIMITED`.
    """
    robot = ElementTree.Element("robot", name=name)
    if tip is not None and (translation.any() or not np.array_equal(rotation, np.eye(3))):
        taken = {link.name for link in links} | {joint.name for joint in joints}
        free = (f"{tip}_tip{i or ''}" for i in range(len(taken) + 1))
        end = next(name for name in free if name not in taken and f"{name}_fixed" not in taken)
        links, joints = [*links, Link(end)], [*joints, Joint(f"{end}_fixed", "fixed", tip, end, translation, rotation)]
        tip = end
    for link in links:
        _write_link(robot, link)
    for joint in joints:
        _write_joint(robot, joint)
    if tip is not None:
        ElementTree.SubElement(robot, "tip", link=tip)
    ElementTree.indent(robot)
    head = '<?xml version="1.0" encoding="utf-8"?>\n<!-- written by selfmotion -->\n'
    return head + ElementTree.tostring(robot, encoding="unicode") + "\n"


def _write_link(robot: ElementTree.Element, link: Link) -> None:
    element = ElementTree.SubElement(robot, "link", name=link.name)
    if link.mass or link.inertia.any() or link.center_of_mass.any():
        body = ElementTree.SubElement(element, "inertial")
        _write_origin(body, link.center_of_mass, np.eye(3))
        ElementTree.SubElement(body, "mass", value=_join_numbers(link.mass))
        moments = map(_join_numbers, link.inertia[np.triu_indices(3)])
        ElementTree.SubElement(body, "inertia", dict(zip(MOMENTS, moments, strict=True)))
    for visual in link.visuals:
        shape = _write_shape(element, "visual", visual)
        if visual.color is not None:
            material = ElementTree.SubElement(shape, "material", name="")
            ElementTree.SubElement(material, "color", rgba=_join_numbers(visual.color))
    for collision in link.collisions:
        _write_shape(element, "collision", collision)


def _write_joint(robot: ElementTree.Element, joint: Joint) -> None:
    endless = joint.moves and joint.kind != "prismatic" and not np.isfinite([joint.lower, joint.upper]).any()
    element = ElementTree.SubElement(robot, "joint", name=joint.name, type="continuous" if endless else joint.kind)
    _write_origin(element, joint.translation, joint.rotation)
    ElementTree.SubElement(element, "parent", link=joint.parent)
    ElementTree.SubElement(element, "child", link=joint.child)
    if not joint.moves:
        return
    ElementTree.SubElement(element, "axis", xyz=_join_numbers(joint.axis))
    limits = {key: getattr(joint, key) for key in ("effort", "velocity", *(() if endless else ("lower", "upper")))}
    if np.isfinite(list(limits.values())).any() or not endless:
        written = {key: _join_numbers(np.clip(value, -UNLIMITED, UNLIMITED)) for key, value in limits.items()}
        ElementTree.SubElement(element, "limit", written)
    if (tie := joint.mimic) is not None:
        numbers = {"multiplier": _join_numbers(tie.multiplier), "offset": _join_numbers(tie.offset)}
        ElementTree.SubElement(element, "mimic", {"joint": tie.joint} | numbers)


def _write_shape(link: ElementTree.Element, tag: str, shape: CollisionShape) -> ElementTree.Element:
    element = ElementTree.SubElement(link, tag)
    _write_origin(element, shape.translation, shape.rotation)
    if shape.kind == "mesh":
        sizes = {"filename": shape.file, "scale": _join_numbers(shape.size)}
    elif shape.kind == "box":
        sizes = {"size": _join_numbers(shape.size)}
    else:
        sizes = dict(zip(("radius", "length"), map(_join_numbers, shape.size), strict=False))  # a sphere has no length
    ElementTree.SubElement(ElementTree.SubElement(element, "geometry"), shape.kind, sizes)
    return element


def _write_origin(element: ElementTree.Element, translation: Array, rotation: Array) -> None:
    """Add an <origin> element with a given pose to a URDF element; omit a zero rotation, so that zeros stay exact."""
    rpy = {} if np.array_equal(rotation, np.eye(3)) else {"rpy": _join_numbers(_rpy(rotation))}
    ElementTree.SubElement(element, "origin", {"xyz": _join_numbers(translation)} | rpy)


def _rpy(rotation: Array) -> Array:
    """Return roll, pitch and yaw of a rotation matrix, (3,), rad; at pitch +-pi/2 one of many equivalent triples."""
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    across = np.array([-np.sin(yaw), np.cos(yaw)]) @ rotation[:2]  # y axis of the frame rotated by yaw alone
    return np.array([np.arctan2(-across[2], across[1]), pitch, yaw])


def _join_numbers(numbers: Any) -> str:
    return " ".join(repr(float(number)) for number in np.ravel(numbers))
