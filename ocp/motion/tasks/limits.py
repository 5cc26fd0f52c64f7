"""Limits of joints and of the contact with the ground in a motion, and rules for the zero moment point."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias, get_args
from warnings import warn

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import Machine, ModelWarning, Robot, Standing
from models.checks import NOT_NUMBERS, Array, floats, real
from models.spatial import expression
from ocp.errors import ProblemError, require

PARALLEL = 1e-12  # cosine to the normal of a support edge below which a direction counts as parallel to the edge

ROUNDING_M = 1e-9
REFERENCE_SAMPLES = 201  # number of times at which a reference is checked


@dataclass(frozen=True)
class InFoot:
    """Rule that the zero moment point stays inside the support polygon by a margin (m) of at least 0."""

    margin: float = 0.0

    def __post_init__(self) -> None:
        require.nonnegative("InFoot: margin", self.margin, unit="m")


@dataclass(frozen=True)
class IndexAtLeast:
    """Rule that the stability index of the zero moment point (Yoo et al. 2004) is `value` or more in x and in y.

    Equations (5) and (6) of that paper. The zero moment point also stays inside the support polygon.
    """

    value: float

    def __post_init__(self) -> None:
        if not (np.isfinite(real(self.value)) and self.value < 1):
            words = f"IndexAtLeast: value must be below 1, not {self.value!r}; for 1 use Pinned()"
            raise ProblemError(words, name="value", value=self.value, limit=1.0)


@dataclass(frozen=True)
class Pinned:
    """Rule that the zero moment point stays at a place, or follows it.

    This holds in the directions in which motion moves the point, see Standing.moving_directions; in the others it stays
    inside the support.

    Attributes:
        point: (x, y), m, or a function of the CasADi symbol of time, s; None for the machine's most stable point.
    """

    point: Any = None

    def place(self, machine: Standing, time: Any) -> Any:
        """Return the prescribed zero moment point at a time. Shape (2, 1), m."""
        return prescribed_point(self.point, machine, time, "Pinned: point")


def prescribed_point(point: Any, machine: Standing, time: Any, name: str) -> Any:
    """Return a zero moment point (2, 1), m, that is given as in `Pinned`; raise ProblemError if it is no pair."""
    value = machine.most_stable_point if point is None else point(time) if callable(point) else point
    try:
        place = expression(value)
    except NOT_NUMBERS:
        place = ca.DM()
    numeric = isinstance(place, ca.DM)
    if place.numel() != 2 or 1 not in place.shape or (numeric and not np.isfinite(np.array(place)).all()):
        shown = value if numeric else str(value)  # expressions cannot be pickled
        words = f"{name} must be two numbers (x, y), not {value!r}"
        raise ProblemError(words, name=name.rpartition(" ")[2], value=shown)
    return ca.vec(place)


@dataclass(frozen=True)
class Anywhere:
    """Rule that the zero moment point is not checked, so that the machine may tip over."""


ZmpRule: TypeAlias = InFoot | IndexAtLeast | Pinned | Anywhere


def foot_edges(machine: Standing, zmp: ZmpRule) -> tuple[Array, Array]:
    """Return the edges of the region that a zero moment point rule allows: inward normals n (k, 2) and offsets o (k,),
    with n . point >= o inside. Where a rule prescribes the point, they are those of the support in other directions.
    """
    normals = machine.support.normals
    offsets = (normals * machine.support.vertices).sum(axis=1)
    if isinstance(zmp, InFoot):
        return normals, offsets + zmp.margin
    open_edges = np.zeros(len(offsets), dtype=bool)
    if isinstance(zmp, IndexAtLeast):
        radius = machine.half_widths * np.sqrt(1 - zmp.value)
        low, high = machine.most_stable_point - radius, machine.most_stable_point + radius
        corners = np.array(np.meshgrid(*np.transpose([low, high]))).reshape(2, 4)
        open_edges = (normals @ corners).min(axis=1) < offsets
        sides = np.vstack([np.eye(2), -np.eye(2)])
        return np.vstack([sides, normals[open_edges]]), np.concatenate([low, -high, offsets[open_edges]])
    if isinstance(zmp, Pinned):
        directions = machine.moving_directions
        open_edges = np.abs(normals - normals @ directions.T @ directions).max(axis=1) > PARALLEL
    return normals[open_edges], offsets[open_edges]


def foot_rows(machine: Standing, zmp: ZmpRule, point: Any, external: bool) -> Any:
    """Return those distances (k, 1), m, of a zero moment point (2, 1) from `foot_edges` that are not constant.
    Raise ProblemError if a constant distance is negative. `external` states whether external wrenches act.
    """
    normals, offsets = foot_edges(machine, zmp)
    movable = np.abs(normals @ machine.moving_directions.T).max(axis=1, initial=0.0) > PARALLEL
    rows = ca.mtimes(ca.sparsify(ca.DM(normals)), point) - ca.DM(offsets)
    free = [i for i in range(len(offsets)) if (external or movable[i]) and ca.symvar(rows[i])]
    reachable = machine.nearest_reachable(machine.most_stable_point)
    for i in set(range(len(offsets))) - set(free):
        inside = float(ca.evalf(rows[i])) if external else float(normals[i] @ reachable - offsets[i])
        if inside < -ROUNDING_M:
            words = f"the zero moment point is {-inside:.4g} m outside the region that {type(zmp).__name__} allows, in "
            words += "every motion of the joints: move the foot below the machine"
            raise ProblemError(words, name="zero moment point", value=-inside, limit=0.0)
    return rows[free]


def check_rule(machine: Standing, horizon: float, zmp: ZmpRule) -> None:
    """Raise ProblemError if a zero moment point rule has the wrong type or demands a point outside the support."""
    if not isinstance(zmp, ZmpRule):
        words = f"zmp must be InFoot, IndexAtLeast, Pinned or Anywhere, not {zmp!r}"
        raise ProblemError(words, name="zmp", value=zmp, limit=get_args(ZmpRule))
    if isinstance(zmp, InFoot):
        directions, support = machine.moving_directions, machine.support
        half_lengths = np.ptp(support.vertices @ directions.T, axis=0) / 2
        largest = support.inner_radius if len(directions) == 2 else float(half_lengths.min(initial=np.inf))
        if zmp.margin >= largest * (1 - 1e-9):
            words = f"InFoot: margin {zmp.margin!r} m is too large for the support, which allows {largest:g} m at most"
            raise ProblemError(words, name="margin", value=zmp.margin, limit=largest)
    if not isinstance(zmp, Pinned):
        return
    for time in np.linspace(0.0, horizon, REFERENCE_SAMPLES if callable(zmp.point) else 1):
        place = np.array(ca.DM(zmp.place(machine, ca.DM(time)))).ravel()
        if not np.isfinite(place).all():
            words = f"Pinned: the zero moment point {place.tolist()} at {time:.4g} s is not finite"
            raise ProblemError(words, name="Pinned", value=place, time=float(time))
        inside = float(machine.support.margin(machine.nearest_reachable(place)))
        if inside < -ROUNDING_M:
            words = f"Pinned: {place.tolist()} m at {time:.4g} s is {-inside:.4g} m outside the support, where the "
            words += "machine tips over; stay inside, or give another support"
            raise ProblemError(words, name="Pinned", value=place, limit=machine.support.vertices, time=float(time))


LIMITED = {
    "velocity": "rad/s or m/s",
    "acceleration": "rad/s^2 or m/s^2",
    "jerk": "rad/s^3 or m/s^3",
    "torque": "N m or N",
    "power": "W",
}
"""Limits that are given as one number for each joint or for all joints, and their units: fields of `Limits` and of
`JointBounds`, entries of the table [limits] in task files and, except for the power, options of `selfmotion check`."""


class JointBounds(NamedTuple):
    """Limits of each joint in SI units, infinite if there is none, as in `Limits`. Shape (n,) each."""

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    torque: Array
    power: Array

    def tightened(self, other: JointBounds) -> JointBounds:
        """Return, for each joint and quantity, the tighter of both limits."""
        upper = (np.minimum(own, limit) for own, limit in zip(self[1:], other[1:], strict=True))
        return JointBounds(np.maximum(self.lower, other.lower), *upper)


@dataclass(frozen=True)
class Limits:
    """Limits of a motion: of the joints, of their actuators and of the ground contact.

    None means the limit of the robot description, which has none for acceleration, jerk and power. Many URDF files give
    0 for an unknown velocity or torque limit; 0 is read as unlimited.

    Attributes:
        velocity, acceleration, jerk, torque: One number for each joint, or one for all; inf for no limit.
        power: Largest power that each actuator delivers, W, in the same form; braking is free.
        joints: Whether the position limits of the robot apply.
        vertical_force: Least vertical ground force on a standing machine, N; None for a tenth of its weight.
        friction: Friction coefficient of the ground.
        zmp: Rule for the zero moment point of a standing machine; None keeps it inside the foot.
        robust: Sizes of uncertainties for which a plan must keep all limits, by name as in `Plan.margin`; only `plan`
            takes them.

    Raises:
        ProblemError: A limit is not positive.
    """

    velocity: Any = None
    acceleration: Any = None
    jerk: Any = None
    torque: Any = None
    power: Any = None
    joints: bool = True
    vertical_force: float | None = None
    friction: float = np.inf
    zmp: ZmpRule | None = None
    robust: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        for kind in LIMITED:
            if getattr(self, kind) is not None:
                require.array(f"limits: {kind}", getattr(self, kind), ("joints",), entries="numbers", sign="positive")
        if self.vertical_force is not None:
            require.positive("limits: vertical_force", self.vertical_force)
        require.flag("limits: joints", self.joints)
        if self.zmp is not None and not isinstance(self.zmp, ZmpRule):
            words = f"limits: zmp must be a rule such as InFoot(), not {self.zmp!r}"
            raise ProblemError(words, name="zmp", value=self.zmp)
        if not real(self.friction) > 0:
            words = f"limits: friction must be positive, not {self.friction!r}"
            raise ProblemError(words, name="friction", value=self.friction, limit=0.0)

    def least_force(self, machine: Standing) -> float:
        """Return the least permitted vertical ground force on a standing machine, N."""
        return 0.1 * machine.weight if self.vertical_force is None else float(self.vertical_force)

    def of_joints(self, chosen: NDArray[Any]) -> Limits:
        """Return the limits of selected joints of a machine, given as a mask (n,) or as indices in a new order."""
        own: dict[str, Any] = {kind: floats(getattr(self, kind)) for kind in LIMITED if np.ndim(getattr(self, kind))}
        return replace(self, **{kind: values[chosen] for kind, values in own.items()})

    def bounds(self, machine: Machine, used: Collection[str] = ()) -> JointBounds:
        """Return the joint limits of a machine; limits that the robot description lacks are infinite.

        Warns of `used` kinds of limits, "velocity" or "torque", that are not set here and 0 in the robot description.

        Raises:
            ProblemError: A limit is neither one number nor one number for each joint.
        """
        if self.robust is not None:
            words = "limits: robust is taken by plan alone; leave it out here, and see Plan.margin"
            raise ProblemError(words, name="robust", value=self.robust)
        robot, n = machine.robot, machine.joint_size
        inf = np.full(n, np.inf)
        values = {**dict.fromkeys(LIMITED, inf), "velocity": robot.velocity, "torque": robot.effort}
        for kind in values:
            value = getattr(self, kind)
            if value is not None:
                values[kind] = require.broadcast(f"limits: {kind}", value, n, "joints", entries="numbers")
            elif kind in used and (names := unknown_limits(robot, kind)):
                words = f"the robot gives {', '.join(names)} a {kind} limit of 0, which is read as unknown: they are "
                words += f"unlimited; set Limits({kind}=...), inf for no limit"
                warn(ModelWarning(words, name=names[0], value=0.0), stacklevel=2)
        lower, upper = (robot.lower, robot.upper) if self.joints else (-inf, inf)
        return JointBounds(lower, upper, **values)


def unknown_limits(robot: Robot, kind: str) -> list[str]:
    """Return the joints whose "velocity" or "torque" limit in the robot description is 0, which means unknown."""
    attribute = {"velocity": "velocity", "torque": "effort"}.get(kind)
    return [joint.name for joint in robot.moving_joints if attribute and getattr(joint, attribute) == 0]
