"""Arms that stand unfastened on level ground: zero moment point, ground reaction, stability (Yoo et al. 2004).

The ground is the plane z = 0 of the world, z upwards. As long as the foot stays flat on it the machine is one on a
fixed base; whether it stays is read from the reaction that the ground would have to give.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from models.arrays import Array, ArrayInput, checked_array, checked_instance, checked_number
from models.errors import ModelError
from models.machines.machine import FixedBase
from models.machines.support import Support
from models.robot.dynamics import Wrench, base_reaction, checked_wrenches, external_wrench, inverse_dynamics
from models.robot.kinematics import checked_vector, joint_vector
from models.robot.parts import massless
from models.robot.rebuild import simplified
from models.robot.robot import Robot
from models.spatial import Expression, expression

External: TypeAlias = Callable[[Expression, Expression], Sequence[Wrench]]
"""Wrenches from outside as a function of time (s) and the tip's position in the world (3, 1)."""


def wrenches_at(external: External | None, time: Expression, tip: Expression) -> tuple[Wrench, ...]:
    """What `external` gives, () if None; ModelError unless it is a function that returns a list of wrenches."""
    if external is None:
        return ()
    if not callable(external):
        message = f"external must be a function of time and tip position, not {external!r}"
        raise ModelError(message, name="external", value=external)
    return checked_wrenches(external(time, tip))


class ZmpRows(NamedTuple):
    """The equation (18) that keeps the zero moment point at a given place: J_m q'' + q'^T H_m q' = C.

    Row 0 says where its x is, row 1 where its y is; both are moments over the place, in N m.

    Attributes:
        jacobian: J_m. Shape (2, n).
        hessians: The two planes of H_m, symmetric. Shape (n, n) each.
        right: C, with gravity and the wrenches. Shape (2, 1).
    """

    jacobian: Expression
    hessians: tuple[Expression, Expression]
    right: Expression

    def needed(self, qd: Expression) -> Expression:
        """C - q'^T H_m q': what J_m q'' has to be. Shape (2, 1), N m."""
        qd = expression(qd)
        return self.right - ca.vertcat(*(ca.mtimes([qd.T, plane, qd]) for plane in self.hessians))


@dataclass(frozen=True, eq=False, kw_only=True)
class Standing(FixedBase):
    """A robot whose root link, the foot, stands on the ground and is not fastened to it.

    Besides what a FixedBase has (`robot`, `translation`, `rotation` of the foot's frame in the world):

    Attributes:
        support: Region of the ground under the foot.
        gravity: m/s^2, downwards.
        most_stable_point: (x, y) at which the stability index is 1; the middle of the support's bounding box if
            None. Shape (2,), m.
        half_widths: Distances in x and y at which the index falls to 0; those of the bounding box if None. Shape
            (2,), m.

    Raises:
        ModelError: No moving joint, no mass, no Support, wrong sizes, a gravity or a half-width that is not positive.
    """

    support: Support
    gravity: float = 9.81
    most_stable_point: ArrayInput = None
    half_widths: ArrayInput = None

    def __post_init__(self) -> None:
        super().__post_init__()
        owner = "standing machine"
        if not isinstance(self.support, Support):
            message = f"{owner}: support must be a Support, as rectangle(...) gives, not {self.support!r}"
            raise ModelError(message, name="support", value=self.support)
        if self.robot.total_mass == 0:
            raise massless("nothing presses its foot on the ground")
        gravity = checked_number(self.gravity, owner, "gravity", positive=True, unit="m/s^2")
        object.__setattr__(self, "gravity", gravity)
        for what, default in (("most_stable_point", self.support.center), ("half_widths", self.support.half_widths)):
            value = default if getattr(self, what) is None else getattr(self, what)
            value = checked_array(value, (2,), owner, what, positive=what == "half_widths", unit="m")
            object.__setattr__(self, what, value)

    @property
    def weight(self) -> float:
        """N."""
        return self.robot.total_mass * self.gravity

    @property
    def gravity_in_world(self) -> Array:
        """Shape (3,), m/s^2."""
        return np.array([0.0, 0.0, -self.gravity])

    def bodies(self, wrenches: Sequence[Wrench] = ()) -> Robot:
        """The robot with one link for each moving joint, and those on which wrenches act: the same dynamics, sooner."""
        keep = frozenset(self.robot.link(wrench.link).name for wrench in checked_wrenches(wrenches))
        if keep not in self._bodies:
            self._bodies[keep] = simplified(self.robot, keep)
        return self._bodies[keep]

    @cached_property
    def _bodies(self) -> dict[frozenset[str], Robot]:
        return {}

    def ground_reaction(
        self, q: Expression, qd: Expression, qdd: Expression, wrenches: Sequence[Wrench] = ()
    ) -> Expression:
        """What the ground does to the foot: (moment about the world's origin, force). Shape (6, 1), N m and N."""
        robot = self.bodies(wrenches)
        return base_reaction(robot, q, qd, qdd, wrenches, self.gravity_in_world, self.world_from_base())

    def zero_moment_point(
        self, q: Expression, qd: Expression, qdd: Expression, wrenches: Sequence[Wrench] = ()
    ) -> Expression:
        """Point (x, y) of the ground about which its reaction has no horizontal moment, (2)-(3), (35)-(36) corrected.

        Shape (2, 1), m. Of use only while the vertical force is positive.
        """
        return center_of_pressure(self.ground_reaction(q, qd, qdd, wrenches))

    def joint_torques(
        self, q: Expression, qd: Expression, qdd: Expression, wrenches: Sequence[Wrench] = ()
    ) -> Expression:
        """Torques (forces) of the joints by inverse dynamics. Shape (n, 1), N m or N."""
        robot = self.bodies(wrenches)
        return inverse_dynamics(robot, q, qd, qdd, wrenches, self.gravity_in_world, self.world_from_base())

    def stability_index(self, point: Expression) -> Expression:
        """1 - ((point - most stable point) / half-width)^2 for x and y, (5)-(6). Shape (2, 1)."""
        offset = checked_vector(point, 2, "point", "x and y on the ground") - ca.DM(self.most_stable_point)
        return 1 - (offset / ca.DM(self.half_widths)) ** 2

    def zmp_rows(self, q: Expression, qd: Expression, point: Expression, wrenches: Sequence[Wrench] = ()) -> ZmpRows:
        """The rows of (18) for the zero moment point at `point`, by differentiating its equation.

        Args:
            q, qd: Shape (n, 1) each.
            point: (x, y) on the ground. Shape (2,), m.
            wrenches: From outside; they enter C.
        """
        outside = external_wrench(self.robot, q, wrenches, self.world_from_base())
        point = checked_vector(point, 2, "point", "x and y on the ground")
        q, qd = joint_vector(self.robot, q), joint_vector(self.robot, qd, "qd")
        jacobian, first, second, right = self._zmp_rows(q, qd, point, outside)
        return ZmpRows(jacobian, (first, second), right)

    @cached_property
    def _zmp_rows(self) -> Any:
        n = self.joint_size
        q, qd, qdd = (ca.SX.sym(name, n) for name in ("q", "qd", "qdd"))
        point, outside = ca.SX.sym("point", 2), ca.SX.sym("outside", 6)
        x, y = ca.vertsplit(point)

        def moments(velocity: Expression, acceleration: Expression) -> Expression:
            """Over the point, in the order and with the signs of (11)-(12). Shape (2, 1)."""
            reaction = self.ground_reaction(q, velocity, acceleration) - outside
            return ca.vertcat(-reaction[1] - x * reaction[5], reaction[0] - y * reaction[5])

        rest = ca.DM.zeros(n)
        jacobian = ca.jacobian(moments(qd, qdd), qdd)
        moving, at_rest = moments(qd, rest), moments(rest, rest)
        planes = [ca.hessian(moving[i], qd)[0] / 2 for i in (0, 1)]
        outputs = [ca.densify(part) for part in (jacobian, *planes, -at_rest)]
        return ca.Function("zmp_rows", [q, qd, point, outside], outputs, {"cse": True})

    @cached_property
    def _reached(self) -> Array:
        """Zero moment points of a few motions without wrenches. Shape (5, 2), m."""
        rng = np.random.default_rng(0)
        points = [ca.DM(self.zero_moment_point(*rng.normal(size=(3, self.joint_size)))) for _ in range(5)]
        return np.array([np.array(point).ravel() for point in points])

    @cached_property
    def moving_directions(self) -> Array:
        """Directions on the ground in which motion can move the zero moment point, orthonormal. Shape (k, 2).

        Both axes for k = 2; one direction for a machine that moves in a vertical plane, whichever plane that is.
        """
        _, sizes, directions = np.linalg.svd(self._reached - self._reached.mean(axis=0))
        count = int((sizes > 1e-9 * max(1.0, sizes[0])).sum())
        if count == 2:
            return np.eye(2)
        found = np.where(np.abs(directions[:count]) < 1e-9, 0.0, directions[:count])
        return np.asarray(found * np.sign(found[np.arange(count), np.abs(found).argmax(axis=1)])[:, None])

    @property
    def moving_axes(self) -> tuple[int, ...]:
        """Which coordinates of the zero moment point motion can change: (0, 1), or one of them, or none."""
        return tuple(axis for axis in (0, 1) if self.moving_directions[:, axis].any())

    def nearest_reachable(self, point: ArrayInput) -> Array:
        """The place nearest to `point` to which motion alone can move the zero moment point. Shape (2,), m."""
        given = checked_array(point, (2,), "standing machine", "point")
        along = self.moving_directions.T @ self.moving_directions
        return np.asarray(along @ given + (np.eye(2) - along) @ self._reached.mean(axis=0))

    def tip_wrench(self, force: Expression, moment: Expression = (0.0, 0.0, 0.0)) -> Wrench:
        """A force (N) and a moment (N m) in world axes at the tip. Shape (3,) each."""
        return Wrench(self.robot.tip_link, force, moment, self.robot.tip_translation)


def center_of_pressure(reaction: Expression) -> Expression:
    """Zero moment point (x, y) of a ground reaction (moment about the world's origin, force). Shape (2, 1), m."""
    reaction = checked_vector(reaction, 6, "reaction", "moment about the world's origin and force")
    return ca.vertcat(-reaction[1], reaction[0]) / reaction[5]


def tip_spring(machine: Standing, stiffness: ArrayInput, rest: ArrayInput) -> External:
    """A spring at the tip: force -stiffness (tip - rest), axis by axis.

    Args:
        stiffness: Along world x, y, z. Shape (3,), N/m.
        rest: Position of the tip where the spring is relaxed. Shape (3,), m.
    """
    checked_instance(machine, Standing, "tip spring", "machine")
    k = checked_array(stiffness, (3,), "tip spring", "stiffness")
    relaxed = checked_array(rest, (3,), "tip spring", "rest")
    return lambda time, tip: [machine.tip_wrench(-ca.DM(k) * (tip - ca.DM(relaxed)))]
