"""Planning request of a motion: start, goal or waypoints, cost, and the obstacles to avoid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from models import Box, Machine, Sphere
from models.checks import NOT_NUMBERS, Array, ArrayInput, floats, short_repr
from models.machines.machine import Wrenches
from ocp.errors import ProblemError, require
from ocp.motion.tasks.checks import checked_configuration, checked_weights
from ocp.motion.tasks.tip_task import TipTask


@dataclass(frozen=True, eq=False)
class Start:
    """Start of a motion: configuration and velocity of a machine.

    Attributes:
        joints: Joint positions, rad or m, shape (n,); None: searched.
        base: Configuration of a floating base, shape (base_size,); None: the machine's base_home().
        velocity: "rest", "free", or the joint velocities, shape (n,), rad/s or m/s; for goals, since the tasks of a tip
            determine the velocities at their start.
    """

    joints: Any = None
    base: Any = None
    velocity: Literal["rest", "free"] | Any = "rest"

    @classmethod
    def of(cls, value: Any, machine: Machine, *, known: bool = False) -> tuple[Start, Any, Array]:
        """Convert a start, joint positions or None to a `Start`; also return its joints (n,) or None, and its base.

        Raises:
            ProblemError: As `checked_configuration`; or the joints are None although they have to be `known`.
        """
        start = value if isinstance(value, cls) else cls(value)
        if start.joints is None and not known:
            return start, None, checked_configuration(machine, np.zeros(machine.joint_size), start.base)[1]
        return start, *checked_configuration(machine, start.joints, start.base)


@dataclass(frozen=True, eq=False, kw_only=True)
class Goal:
    """End of a motion or of a part of it, given by joint positions or by a pose of the tip.

    Attributes:
        joints: Joint positions, nan where free. Shape (n,), rad or m.
        tip: Link whose pose is meant; None for the tip of the robot.
        position: Position of the tip in world. Shape (3,), m.
        orientation: Orientation of the tip in world: quaternion [w, x, y, z] or rotation matrix.
        direction: Direction of the tool axis in world, with a free roll about it, in place of an orientation. Shape
            (3,).
        within: Half-angle of the cone about the direction in which the tool axis may lie, rad.
        tool_axis: Tool axis in the tip's frame. Shape (3,).
        region: Box or sphere in world in which the tip may lie, in place of a position.
        velocity: "rest", "free", or the joint velocities at the goal, nan where free. Shape (n,), rad/s or m/s.
        base: Configuration of a floating base at the end, nan where free. Shape (base_size,).
        duration: Duration of this part of a motion with several goals, s, or FreeTime(...); None: the horizon.
        machine: Machine on the way to this goal, for example with a load; None for that of the part before.
        tasks: Tip tasks on the way to this goal, as functions of the time since its beginning.
        name: Name of this part; "leg 1", "leg 2", ... if empty.

    Raises:
        ProblemError: The goal is neither joints nor a pose, or both; or a value is invalid.
    """

    joints: Any = None
    tip: str | None = None
    position: Any = None
    orientation: Any = None
    direction: Any = None
    within: float | None = None
    tool_axis: ArrayInput = (0.0, 0.0, 1.0)
    region: Box | Sphere | None = None
    velocity: Literal["rest", "free"] | Any = "rest"
    base: Any = None
    duration: Any = None
    machine: Machine | None = None
    tasks: TipTask | Sequence[TipTask] = ()
    name: str = ""

    __repr__ = short_repr

    def __post_init__(self) -> None:
        require.text("goal: name", self.name)
        pose = {name: getattr(self, name) for name in ("position", "orientation", "direction", "region")}
        named = [name for name, value in pose.items() if value is not None]
        if self.joints is not None and named:
            words = f"a goal has joints or a pose, not both: leave out joints, or {', '.join(named)}"
            raise ProblemError(words, name="joints", value=self.joints)
        if self.tip is not None and not named:
            words = "goal: tip names the link whose pose is meant; give a position, orientation, direction or region"
            raise ProblemError(words, name="tip", value=self.tip)
        if self.position is not None and self.region is not None:
            words = "a goal has a position or a region in which the tip may lie, not both"
            raise ProblemError(words, name="region", value=self.region)
        if self.region is not None and not isinstance(self.region, Box | Sphere):
            words = f"goal: region must be a Box or a Sphere in world, not a {type(self.region).__name__}"
            raise ProblemError(words, name="region", value=self.region)
        if self.within is not None:
            require.positive("goal: within", self.within, below=np.pi)
        if isinstance(self.velocity, str):
            require.choice("goal: velocity", self.velocity, ("rest", "free"))
        else:
            try:
                floats(self.velocity)
            except NOT_NUMBERS as error:
                words = f"goal: velocity must be numbers, 'rest' or 'free', not {self.velocity!r}"
                raise ProblemError(words, name="velocity", value=self.velocity) from error
        if self.has_pose:
            _ = self.task  # checks the pose

    @property
    def has_pose(self) -> bool:
        """Whether the goal is a pose of the tip."""
        return any(value is not None for value in (self.position, self.orientation, self.direction, self.region))

    @property
    def task(self) -> TipTask:
        """Tip task whose constant target is the pose of the goal, or the centre of the goal's region."""
        center = self.position if self.region is None else self.region.position
        return TipTask(
            position=center,
            orientation=self.orientation,
            direction=self.direction,
            within=self.within,
            tool_axis=self.tool_axis,
            link=self.tip,
        )


@dataclass(frozen=True, eq=False)
class Waypoints:
    """Sequence of tool poses without times, to be planned as a joint path.

    Attributes:
        positions: Positions of the tip in world. Shape (N, 3), m.
        quaternions: Orientations of the tip, [w, x, y, z], of any length. Shape (N, 4).
        step: Largest displacement of each joint between waypoints, rad or m; one number or one per joint.
        reconfigurations: "forbidden", or "counted": if no path goes through all waypoints, find the fewest
            reconfigurations, and among these the least cost. In a reconfiguration, the arm leaves the path at a
            waypoint and returns at the next one in any configuration; it costs nothing and is not planned. Only with at
            most one redundant degree of freedom.
    """

    positions: ArrayInput
    quaternions: ArrayInput
    step: Any = np.inf
    reconfigurations: Literal["forbidden", "counted"] = "forbidden"

    __repr__ = short_repr


PER_JOINT = ("effort", "acceleration")  # terms of the cost that may have a weight for each joint


@dataclass(frozen=True, eq=False)
class Cost:
    """Weights of the cost of a motion: of its duration, and of integrals such as the squared joint velocity.

        J = time T + integral of (velocity/2 sum(w q'^2) + effort sum(tau^2) + length sqrt(sum(w q'^2))
            + acceleration sum(q''^2) + jerk sum(q'''^2) + energy sum(max(tau q', 0)) + turning |omega|^2) dt

    with duration T, joint positions q, joint torques tau and angular velocity omega of the base.

    Attributes:
        velocity, jerk: Weights of half the squared joint velocities, and of the squared jerks.
        time: Weight of the duration, 1/s.
        effort: Weight of the squared torques (losses in the windings), one number or one for each joint, 1/(N m)^2/s.
        length: Weight of the length of the joint path, 1/rad.
        energy: Weight of the positive actuator work, 1/J. Braking regains nothing.
        acceleration: Weight of the squared accelerations, one number or one for each joint. It matters for light joints
            at the end of an arm, which need hardly any torque.
        turning: Weight of the squared angular velocity of a floating base, 1/(rad/s)^2/s.
        weights: Weights w of the joints in the velocity and the length, positive, shape (n,); all 1 if None.

    Raises:
        ProblemError: A weight is negative, or all are zero.
    """

    velocity: float = 1.0
    time: float = 0.0
    effort: Any = 0.0
    length: float = 0.0
    energy: float = 0.0
    acceleration: Any = 0.0
    jerk: float = 0.0
    turning: float = 0.0
    weights: Any = None

    def __post_init__(self) -> None:
        for name in TERMS:
            if name in PER_JOINT:
                require.array(f"cost: {name}", getattr(self, name), ("joints",), sign="nonnegative")
            else:
                require.nonnegative(f"cost: {name}", getattr(self, name))
        if not self.terms:
            raise ProblemError("cost: at least one weight must be above zero", name="cost", value=self, limit=0.0)

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the terms of the cost whose weights are not zero."""
        return tuple(name for name in TERMS if np.any(np.asarray(getattr(self, name))))

    def of_joints(self, chosen: NDArray[np.bool_]) -> Cost:
        """Return the cost with the weights of a subset of the joints, given as a mask (n,)."""
        names = [name for name in (*PER_JOINT, "weights") if np.ndim(getattr(self, name))]
        own: dict[str, Any] = {name: floats(getattr(self, name)) for name in names}
        return replace(self, **{name: values[chosen] for name, values in own.items()})

    def joint_weights(self, size: int) -> Array:
        """Return the checked weights (size,) of the squared joint velocities: `velocity` times `weights`."""
        return self.velocity * checked_weights(self.weights, size)

    def __repr__(self) -> str:
        weighted = ", ".join(f"{name}={getattr(self, name)!r}" for name in self.terms)
        return f"Cost({weighted}{'' if self.weights is None else f', weights={self.weights!r}'})"


TERMS = tuple(term.name for term in fields(Cost) if term.name != "weights")  # names of all terms of the cost


@dataclass(frozen=True, eq=False)
class Scene:
    """Obstacles around a machine, required clearances, and external forces.

    The values are checked when a motion is planned in the scene, together with the machine; see
    `models.CollisionScene`.

    Attributes:
        obstacles: Shapes in world, or `MovingObstacle` ones.
        clearance: Least distance to obstacles and between links, m; 0 excludes contact.
        ignored: Pairs of links, or of a link and an obstacle, that are not checked.
        srdf: SRDF file whose disabled pairs are ignored; None for none.
        folders: Folders of the robot's meshes.
        missing: "raise" if a mesh is missing, or "skip" to leave it out.
        wrenches: External wrenches on a standing machine: a list of `Wrench`, or a function of time (s) and tip
            position (m) that returns one, for example `tip_spring`. Give the times of short pushes as `TipTask.breaks`.
    """

    obstacles: Any = ()
    clearance: float = 0.0
    ignored: Any = ()
    srdf: Any = None
    folders: Any = ()
    missing: Literal["raise", "skip"] = "raise"
    wrenches: Wrenches = ()

    __repr__ = short_repr

    @property
    def collision_options(self) -> dict[str, Any]:
        """Keyword arguments that describe the scene for `models.CollisionScene`, besides the machine and its limits."""
        return {name: value for name, value in vars(self).items() if name != "wrenches"}
