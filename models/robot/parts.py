"""Links, their shapes, and joints: the parts of a robot, checked when they are made.

Attributes that are arrays are given as anything numpy reads and stored as read-only float arrays.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import casadi as ca
import numpy as np

from models.arrays import Array, ArrayInput, checked_array, checked_rotation, frozen
from models.errors import ModelError
from models.spatial import rotation

Kind: TypeAlias = Literal["fixed", "revolute", "continuous", "prismatic"]
ShapeKind: TypeAlias = Literal["box", "sphere", "cylinder", "capsule", "mesh"]

KINDS = ("fixed", "revolute", "continuous", "prismatic")
SHAPES = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2, "mesh": 3}
"""Kinds of collision shapes, and how many numbers their size is."""
INERTIA_TOLERANCE = 1e-6
"""Relative slack of the inertia checks: inertias printed to six digits still pass."""


@dataclass(frozen=True, eq=False)
class CollisionShape:
    """A shape that stands for a link, or for a part of one, where it may touch something.

    Attributes:
        kind: "box", "sphere", "cylinder", "capsule" or "mesh". Those with a length lie along z of the shape's frame.
        size: Edges along x, y, z of a box; (radius,) of a sphere; (radius, length) of a cylinder, or of a capsule
            without its caps; scale along x, y, z of a mesh, negative where it is mirrored. m, but for the scale.
        file: Of a mesh, as it was given: nothing looks for it here.
        translation: Origin of the shape's frame, the middle of all but a mesh, in the link frame. Shape (3,), m.
        rotation: Axes of the shape's frame, as columns, in the link frame. Shape (3, 3).

    Raises:
        ModelError: Unknown kind, wrong sizes, a size that is not positive, a mesh without a file or scaled to nothing.
    """

    kind: ShapeKind
    size: ArrayInput
    file: str = ""
    translation: ArrayInput = (0.0, 0.0, 0.0)
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        owner = "collision shape"
        if self.kind not in SHAPES:
            raise ModelError(f"{owner}: unknown kind {self.kind!r}; use one of {', '.join(SHAPES)}")
        size = checked_array(self.size, (SHAPES[self.kind],), owner, f"size of the {self.kind}")
        if self.kind == "mesh" and not self.file:
            raise ModelError(f"{owner}: a mesh needs the name of its file")
        if not (size.all() if self.kind == "mesh" else (size > 0).all()):
            raise ModelError(f"{owner}: size {size.tolist()} of the {self.kind} is not positive")
        object.__setattr__(self, "size", size)
        object.__setattr__(self, "translation", checked_array(self.translation, (3,), owner, "translation"))
        object.__setattr__(self, "rotation", checked_rotation(self.rotation, owner, "rotation"))

    def placed(self, rotation: Array, translation: Array) -> CollisionShape:
        """The same shape in a frame in which its link stands so. Shape (3, 3) and (3,)."""
        shift = translation + rotation @ self.translation
        return replace(self, translation=shift, rotation=rotation @ self.rotation)


@dataclass(frozen=True, eq=False)
class Link:
    """A rigid body.

    Attributes:
        name: Unique within the robot.
        mass: kg, not negative.
        center_of_mass: In the link frame. Shape (3,), m.
        inertia: About the centre of mass, in link axes. Shape (3, 3), kg m^2.
        any_inertia: Take an inertia that no body has, as some robot descriptions give. It must still be symmetric.
        collisions: Shapes that stand for the body where it may touch something.

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

    def __post_init__(self) -> None:
        owner = f"link {self.name!r}"
        mass = checked_array(self.mass, (), owner, "mass").item()
        if mass < 0:
            raise ModelError(f"{owner}: mass {mass} kg is negative")
        inertia = checked_array(self.inertia, (3, 3), owner, "inertia")
        _check_inertia(inertia, owner, self.any_inertia)
        object.__setattr__(self, "mass", mass)
        object.__setattr__(self, "center_of_mass", checked_array(self.center_of_mass, (3,), owner, "center_of_mass"))
        object.__setattr__(self, "inertia", frozen((inertia + inertia.T) / 2))
        object.__setattr__(self, "collisions", tuple(self.collisions))


@dataclass(frozen=True)
class Mimic:
    """What ties a joint to another one that it follows: its position is multiplier times that one's, plus offset.

    Attributes:
        joint: Name of the joint that is followed, which may itself follow another.
        multiplier: rad or m per rad or m of the joint that is followed.
        offset: rad or m.

    Raises:
        ModelError: A number that is not finite.
    """

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        for what in ("multiplier", "offset"):
            number = checked_array(getattr(self, what), (), f"mimic of joint {self.joint!r}", what).item()
            object.__setattr__(self, what, number)


@dataclass(frozen=True, eq=False)
class Joint:
    """A connection of a child link to a parent link.

    The joint frame stands in the parent link frame at `translation`, `rotation` (URDF convention). The child
    link frame is the joint frame turned about `axis` (revolute, continuous) or shifted along it (prismatic).

    Attributes:
        name: Unique within the robot.
        kind: "fixed", "revolute", "continuous" (a revolute joint without position limits) or "prismatic".
        parent: Name of the parent link.
        child: Name of the child link.
        translation: Joint frame's origin in the parent link frame. Shape (3,), m.
        rotation: Joint frame's axes, as columns, in the parent link frame. Shape (3, 3).
        axis: In the joint frame; stored with unit length. Shape (3,).
        lower: Least position, rad or m.
        upper: Greatest position, rad or m.
        velocity: Greatest speed, rad/s or m/s.
        effort: Greatest torque or force, N m or N.
        mimic: Which joint it follows, and how; None for a joint of its own.

    Raises:
        ModelError: Unknown kind, wrong sizes, zero axis, a rotation that is none, lower > upper, a negative
            limit, position limits of a continuous joint, a fixed joint that follows another.
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
        owner = f"joint {self.name!r}"
        if self.kind not in KINDS:
            raise ModelError(f"{owner}: unknown kind {self.kind!r}; use one of {', '.join(KINDS)}")
        axis = checked_array(self.axis, (3,), owner, "axis")
        length = float(np.linalg.norm(axis))
        if not length > 0:
            raise ModelError(f"{owner}: axis {axis.tolist()} has no direction")
        object.__setattr__(self, "axis", frozen(axis / length))
        object.__setattr__(self, "translation", checked_array(self.translation, (3,), owner, "translation"))
        object.__setattr__(self, "rotation", checked_rotation(self.rotation, owner, "rotation"))
        for what in ("lower", "upper", "velocity", "effort"):
            limit = checked_array(getattr(self, what), (), owner, what, finite=False).item()
            object.__setattr__(self, what, limit)
        if self.lower > self.upper:
            raise ModelError(f"{owner}: lower limit {self.lower} is above upper limit {self.upper}")
        if self.lower == np.inf or self.upper == -np.inf:
            raise ModelError(f"{owner}: limits {self.lower} .. {self.upper} leave no position")
        for what in ("velocity", "effort"):
            if getattr(self, what) < 0:
                raise ModelError(f"{owner}: {what} limit {getattr(self, what)} is negative")
        if self.kind == "continuous" and np.isfinite([self.lower, self.upper]).any():
            raise ModelError(
                f"{owner}: a continuous joint has no position limits, but {self.lower} .. {self.upper} is "
                "given; make it revolute or leave them out"
            )

        if self.mimic is not None and not self.moves:
            raise ModelError(f"{owner} is fixed and cannot follow joint {self.mimic.joint!r}")

    @property
    def moves(self) -> bool:
        """Whether the joint is not fixed; one that follows another moves with it."""
        return self.kind != "fixed"

    def placed(self, position: float) -> tuple[Array, Array]:
        """Placement of the child link in the parent link at a joint position (rad or m): rotation, translation."""
        turn, shift = self.rotation, self.translation
        if self.kind == "prismatic":
            return turn, shift + position * (turn @ self.axis)
        return (turn @ np.array(ca.DM(rotation(self.axis, position))) if self.moves else turn), shift

    def locked(self, position: float) -> Joint:
        """The joint held fixed at a position (rad or m), which may lie outside its limits.

        Raises:
            ModelError: The joint is fixed already, or the position is not finite.
        """
        if not self.moves:
            raise ModelError(f"joint {self.name!r} is fixed; only a joint that moves can be locked")
        held = checked_array(position, (), f"joint {self.name!r}", "locked position").item()
        turn, shift = self.placed(held)
        return Joint(self.name, "fixed", self.parent, self.child, shift, turn, self.axis)


def massless(consequence: str) -> ModelError:
    """The error that says a robot has no mass, what that makes impossible, and what URDF has for it."""
    return ModelError(f"the robot has no mass, {consequence}: give its links masses; in URDF none has an <inertial>")


def _check_inertia(inertia: Array, owner: str, lenient: bool) -> None:
    slack = INERTIA_TOLERANCE * float(np.abs(inertia).max())
    if np.abs(inertia - inertia.T).max() > slack:
        raise ModelError(f"{owner}: inertia {inertia.tolist()} is not symmetric")
    if lenient:
        return
    least, middle, greatest = np.linalg.eigvalsh((inertia + inertia.T) / 2)
    if least < -slack:
        raise ModelError(f"{owner}: inertia has the negative principal moment {least:g} kg m^2")
    if greatest > least + middle + slack:
        raise ModelError(
            f"{owner}: principal moments {least:g}, {middle:g}, {greatest:g} kg m^2 violate the triangle "
            "inequality: none may exceed the sum of the two others"
        )
