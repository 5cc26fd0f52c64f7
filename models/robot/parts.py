"""Links and joints, the parts of a robot, checked when they are made.

Attributes that are arrays are given as anything numpy reads and stored as read-only float arrays.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import casadi as ca
import numpy as np

from models.arrays import Array, ArrayInput, checked_array, checked_rotation, frozen
from models.errors import ModelError
from models.spatial import rotation

Kind: TypeAlias = Literal["fixed", "revolute", "continuous", "prismatic"]

KINDS = ("fixed", "revolute", "continuous", "prismatic")
INERTIA_TOLERANCE = 1e-6
"""Relative slack of the inertia checks: inertias printed to six digits still pass."""


@dataclass(frozen=True, eq=False)
class Link:
    """A rigid body.

    Attributes:
        name: Unique within the robot.
        mass: kg, not negative.
        center_of_mass: In the link frame. Shape (3,), m.
        inertia: About the centre of mass, in link axes. Shape (3, 3), kg m^2.
        any_inertia: Take an inertia that no body has, as some robot descriptions give. It must still be symmetric.

    Raises:
        ModelError: Negative or non-finite mass, wrong sizes, an inertia that no mass distribution has (not
            symmetric, not positive semidefinite, a principal moment above the sum of the two others).
    """

    name: str
    mass: float = 0.0
    center_of_mass: ArrayInput = (0.0, 0.0, 0.0)
    inertia: ArrayInput = field(default_factory=lambda: np.zeros((3, 3)))
    any_inertia: bool = False

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

    Raises:
        ModelError: Unknown kind, wrong sizes, zero axis, a rotation that is none, lower > upper, a negative
            limit, position limits of a continuous joint.
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

    @property
    def moves(self) -> bool:
        """Whether the joint has a degree of freedom."""
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
