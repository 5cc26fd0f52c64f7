"""Machines that stand on several feet, each fixed on a foothold: contact loads and conditions for lasting contact.

While the feet do not move, the machine is one on a fixed base, rooted at its first foot. The loads of the other feet
close the kinematic loops, and the first foot bears the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import casadi as ca
import numpy as np

from models.checks import ROUNDING, Array, ArrayInput, require, set_fields
from models.errors import ModelError
from models.machines.machine import FixedBase
from models.machines.support import Support, convex_hull, footprint
from models.robot.dynamics import Wrench, base_reaction, inverse_dynamics
from models.robot.kinematics import center_of_mass, checked_vector, frame_jacobian, link_frames
from models.robot.parts import massless_error
from models.robot.rebuild import reroot, simplify, subtree
from models.robot.robot import Robot
from models.spatial import Expression, Frame, cross

SAMPLES = 5
"""Number of random motions sampled to find which load components and centers of pressure the joints can change."""


@dataclass(frozen=True, eq=False)
class Foot:
    """A part of a robot that can stand on a foothold.

    Attributes:
        link: Name of the link that carries it.
        sole: Contact polygon in axes x and y of the sole's frame; None for a grip, which can bear any load.
        translation: Origin of the sole's frame in the link's frame. Shape (3,), m.
        rotation: Its axes, as columns, in the link's frame, z out of the ground. Shape (3, 3).

    Raises:
        ModelError: Wrong sizes, an invalid rotation, a sole that is not a Support.
    """

    link: str
    sole: Support | None = None
    translation: ArrayInput = (0.0, 0.0, 0.0)
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        owner = f"foot {require.name('foot: link', self.link)!r}"
        if self.sole is not None:
            require.instance(f"{owner}: sole", self.sole, Support)
        set_fields(self, translation=require.array(f"{owner}: translation", self.translation, (3,)))
        set_fields(self, rotation=require.rotation(f"{owner}: rotation", self.rotation))

    @classmethod
    def of(cls, robot: Robot, link: str, rotation: ArrayInput = None) -> Self:
        """Return the foot whose sole is the support polygon (`footprint`) of a link's lowest collision shapes.

        The origin of the sole's frame is below that of the link's frame.

        Args:
            robot: Robot with the link and its shapes.
            rotation: Axes of the link's frame, as columns, where the sole is level, z upwards; the identity if None.
        """
        ground = footprint(subtree(robot, link), rotation=rotation, links=[link])
        turn = np.asarray(ground.rotation).T
        return cls(link, ground.support, -turn @ ground.translation, turn)

    @cached_property
    def corners(self) -> Array:
        """Corners of the sole in the sole's frame, or that frame's origin for a grip without sole. Shape (k, 3), m."""
        if self.sole is None:
            return np.zeros((1, 3))
        plane = np.asarray(self.sole.vertices)
        return np.column_stack([plane, np.zeros(len(plane))])


@dataclass(frozen=True, eq=False)
class Foothold:
    """Pose in the world of the sole frame of a foot while the foot is fixed on the ground.

    Attributes:
        position: Origin of the frame in the world. Shape (3,), m.
        rotation: Axes of the frame, as columns, in the world, z out of the ground. Shape (3, 3).
    """

    position: ArrayInput
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        set_fields(self, position=require.array("foothold: position", self.position, (3,), unit="m"))
        set_fields(self, rotation=require.rotation("foothold: rotation", self.rotation))

    @classmethod
    def level(cls, x: float, y: float, heading: float = 0.0, height: float = 0.0) -> Self:
        """Return a foothold on level ground at (x, y, height), m, rotated by a heading (rad) about the vertical."""
        numbers = {"x": x, "y": y, "heading": heading, "height": height}
        x, y, heading, height = (require.number(f"foothold: {name}", value) for name, value in numbers.items())
        turn = [[np.cos(heading), -np.sin(heading), 0.0], [np.sin(heading), np.cos(heading), 0.0], [0.0, 0.0, 1.0]]
        return cls((x, y, height), turn)


@dataclass(frozen=True, eq=False, kw_only=True)
class Stance(FixedBase):
    """A robot standing on some of its feet: a machine on a fixed base whose root link is the first standing foot.

    Create it by `Stance.on`. A load of a foot is the wrench (moment about the origin of its sole's frame, force) that
    the foothold exerts on it, in world axes, shape (6, 1), N m and N. In addition to the attributes of FixedBase
    (`robot`, rooted at the foot of the first foothold, and its pose):

    Attributes:
        feet: All feet, by name, including those in the air.
        footholds: Footholds of the standing feet, by their names.
        gravity: m/s^2, downwards.
    """

    feet: Mapping[str, Foot]
    footholds: Mapping[str, Foothold]
    gravity: float = 9.81

    @classmethod
    def on(
        cls, robot: Robot, feet: Mapping[str, Foot], footholds: Mapping[str, Foothold], gravity: float = 9.81
    ) -> Self:
        """Return the stance of a robot whose feet stand on given footholds.

        Raises:
            ModelError: No foothold, a foothold without a foot, two feet on one link, an unknown link, a robot without
                mass or moving joints, a gravity that is not positive.
        """
        owner = "stance"
        require.instance(f"{owner}: robot", robot, Robot)
        for argument, mapping, kind in (("feet", feet, Foot), ("footholds", footholds, Foothold)):
            for name, value in require.mapping(f"{owner}: {argument}", mapping).items():
                require.instance(f"{owner}: {name!r}: {argument}", value, kind)
        if not footholds:
            raise ModelError(f"{owner}: no footholds are given; give at least one", name="footholds")
        for name in footholds:
            if name not in feet:
                raise require.unknown("foot", name, feet)
        links = [robot.link(foot.link).name for foot in feet.values()]
        if shared := [link for link in links if links.count(link) > 1]:
            raise ModelError(f"{owner}: link {shared[0]!r} is two feet; join their soles", name="feet", value=shared)
        if robot.total_mass == 0:
            raise massless_error("nothing presses its feet on the ground")
        first = next(iter(footholds))
        foot, place = feet[first], footholds[first]
        turn = np.asarray(place.rotation) @ np.asarray(foot.rotation).T
        return cls(
            robot=reroot(robot, foot.link),
            translation=place.position - turn @ foot.translation,
            rotation=turn,
            feet=dict(feet),
            footholds=dict(footholds),
            gravity=require.positive(f"{owner}: gravity", gravity, unit="m/s^2"),
        )

    @property
    def weight(self) -> float:
        """Weight of the robot, N."""
        return self.robot.total_mass * self.gravity

    @cached_property
    def bodies(self) -> Robot:
        """The robot with links on fixed joints merged into their parents: the same dynamics, evaluated faster."""
        return simplify(self.robot, {foot.link for foot in self.feet.values()})

    def foot(self, name: str) -> Foot:
        """Return the foot with a given name; raise ModelError, which lists similar names, if there is none."""
        if not isinstance(name, str) or name not in self.feet:
            raise require.unknown("foot", name, self.feet)
        return self.feet[name]

    @property
    def other_feet(self) -> tuple[str, ...]:
        """Names of the standing feet except the first."""
        return tuple(self.footholds)[1:]

    def sole_frame(self, name: str, q: Expression) -> Frame:
        """Return the frame of a foot's sole in the world, whether the foot stands or is in the air."""
        foot = self.foot(name)
        link = link_frames(self.bodies, q, self.world_from_base())[foot.link]
        return Frame(ca.mtimes(link.rotation, ca.DM(foot.rotation)), link.point(ca.DM(foot.translation)))

    def sole_corners(self, name: str, q: Expression) -> Expression:
        """Return the corners of a standing or lifted foot's sole in the world, as columns. Shape (3, k), m."""
        frame = self.sole_frame(name, q)
        corners = ca.DM(self.foot(name).corners.T)
        return ca.mtimes(frame.rotation, corners) + ca.repmat(frame.position, 1, corners.shape[1])

    def center_of_mass(self, q: Expression) -> Expression:
        """Return the robot's centre of mass in the world. Shape (3, 1), m."""
        return center_of_mass(self.bodies, q, self.world_from_base())

    def loads(
        self, q: Expression, qd: Expression, qdd: Expression, others: Mapping[str, Expression]
    ) -> dict[str, Expression]:
        """Return the loads (contact wrenches) of all standing feet in a motion, given all loads but the first."""
        reaction = base_reaction(self.bodies, q, qd, qdd, **self._forces(others))
        first = next(iter(self.footholds))
        moment, force = reaction[:3], reaction[3:]
        first_load = ca.vertcat(moment - cross(ca.DM(self.footholds[first].position), force), force)
        return {first: first_load, **{name: others[name] for name in self.other_feet}}

    def joint_torques(
        self, q: Expression, qd: Expression, qdd: Expression, others: Mapping[str, Expression]
    ) -> Expression:
        """Return the joint torques (or forces) of a motion, given the loads of all feet but the first. Shape (n, 1)."""
        return inverse_dynamics(self.bodies, q, qd, qdd, **self._forces(others))

    def _forces(self, others: Mapping[str, Expression]) -> dict[str, Any]:
        """Return keyword arguments of `base_reaction` and `inverse_dynamics`: contact wrenches, gravity, root pose."""
        others = require.mapping("stance: others", others)
        if set(others) != set(self.other_feet):
            message = f"stance: loads of the feet {list(self.other_feet)} are needed, not of {list(others)}"
            raise ModelError(message, name="others", value=tuple(others), limit=self.other_feet)
        wrenches = []
        for name, load in others.items():
            load = checked_vector(f"load of {name!r}", load, 6, "moment about the sole's origin and force")
            foot = self.feet[name]
            wrenches.append(Wrench(foot.link, load[3:], load[:3], foot.translation))
        return {"wrenches": wrenches, "gravity": (0.0, 0.0, -self.gravity), "world_from_base": self.world_from_base()}

    @cached_property
    def load_rows(self) -> dict[str, tuple[int, ...]]:
        """Indices of the load components, for each foot but the first, along which the joints can move the foot.

        In world axes, these are all six, or three for a planar robot. The other components of a load are taken as zero.

        Raises:
            ModelError: These rows of the Jacobian are always dependent, as the robot's plane is oblique to the axes.
        """
        rng = np.random.default_rng(0)
        rows_of_feet = {}
        for name, foot in self.feet.items():
            if name == next(iter(self.footholds)):
                continue
            q = ca.SX.sym("q", self.joint_size)
            place = self.world_from_base()
            matrix = frame_jacobian(self.bodies, q, foot.link, point=foot.translation, world_from_base=place)
            function = ca.Function("jacobian", [q], [matrix])
            jacobians = [np.array(function(rng.normal(size=self.joint_size))) for _ in range(SAMPLES)]
            magnitudes = np.max([np.abs(sample).max(axis=1) for sample in jacobians], axis=0)
            rows = tuple(int(i) for i in np.flatnonzero(magnitudes > ROUNDING * magnitudes.max(initial=0.0)))
            ranks = [np.linalg.matrix_rank(sample[list(rows)], tol=ROUNDING * magnitudes.max()) for sample in jacobians]
            if not rows or max(ranks) < len(rows):
                message = (
                    f"foot {name!r}: the joints move it in {max(ranks, default=0)} directions only, which are not "
                    "along axes of the world; put the robot's plane along them"
                )
                raise ModelError(message, name=name, value=max(ranks, default=0), limit=len(rows))
            rows_of_feet[name] = rows
        return rows_of_feet

    def full_load(self, name: str, rows: Expression) -> Expression:
        """Return all six components, (6, 1), of a foot's load from the components `load_rows`; the others are zero."""
        return ca.mtimes(ca.DM.eye(6)[:, list(self.load_rows[name])], rows)

    def load_in_sole(self, name: str, load: Expression) -> tuple[Expression, Expression]:
        """Return moment and force of a foot's load in the axes of its foothold. Shape (3, 1) each."""
        turn = ca.DM(np.asarray(self.footholds[name].rotation).T)
        return ca.mtimes(turn, load[:3]), ca.mtimes(turn, load[3:])

    def pressure(self, name: str, load: Expression) -> Expression:
        """Return the force that presses a foot's sole on its foothold, positive in contact. Shape (1, 1), N."""
        return self.load_in_sole(name, load)[1][2]

    def edge_moments(self, name: str, load: Expression, margin: float = 0.0) -> Expression:
        """Return the moments, (k, 1), of a foot's load about its sole's edges, nonnegative while the foot does not tip.

        Each is the distance of the center of pressure from an edge, less a margin (m), times the pressure, N m. Only
        edges from which motion can change that distance count; a grip has none.

        Raises:
            ModelError: The center of pressure is beyond another edge in every motion.
        """
        sole = self.feet[name].sole
        if sole is None:
            return ca.DM(0, 1)
        moment, force = self.load_in_sole(name, load)
        arm = ca.vertcat(-moment[1], moment[0])  # center of pressure times pressure
        rows = ca.mtimes(ca.sparsify(ca.DM(sole.normals)), arm) - ca.DM(sole.offsets + margin) * force[2]
        return rows[self._edges(name, margin)]

    def _edges(self, name: str, margin: float) -> list[int]:
        """Return the indices of the sole's edges whose distance from the center of pressure depends on the motion."""
        sole = self.feet[name].sole
        assert sole is not None
        distances = self._sampled_pressures[name] @ sole.normals.T - sole.offsets
        movable = np.ptp(distances, axis=0) > ROUNDING
        for i in np.flatnonzero(~movable):
            if distances[0, i] < margin - ROUNDING:
                message = (
                    f"foot {name!r}: the center of pressure is {margin - distances[0, i]:.4g} m beyond an edge of the "
                    "sole, less its margin, whatever the joints do"
                )
                raise ModelError(message, name=name, value=float(margin - distances[0, i]), limit=0.0)
        return [int(i) for i in np.flatnonzero(movable)]

    @cached_property
    def _sampled_pressures(self) -> dict[str, Array]:
        """Centers of pressure of each standing foot, in its sole's frame, for random motions. Shape (samples, 2), m."""
        rng = np.random.default_rng(0)
        points_by_foot: dict[str, list[Array]] = {name: [] for name in self.footholds}
        for _ in range(SAMPLES):
            loads = {}
            for name in self.other_feet:
                rows = rng.normal(size=len(self.load_rows[name]))
                loads[name] = ca.DM(self.full_load(name, rows)) + ca.DM([0, 0, 0, 0, 0, 10])
            q, qd, qdd = rng.normal(size=(3, self.joint_size))
            for name, load in self.loads(q, qd, qdd, loads).items():
                moment, force = (np.array(ca.DM(rows)).ravel() for rows in self.load_in_sole(name, load))
                points_by_foot[name].append(np.array([-moment[1], moment[0]]) / force[2])
        return {name: np.array(points) for name, points in points_by_foot.items()}

    def friction_margin(self, name: str, load: Expression, friction: float) -> Expression:
        """Return the squared friction limit minus the squared friction load, N^2; negative if the sole slips or turns.

        (mu f_z)^2 - f_x^2 - f_y^2 - (m_z / c)^2 with the moment m_z about the normal through the middle of the sole and
        c two thirds of the radius of the largest circle in it: the ellipsoid of Howe and Cutkosky (1996). Shape (1, 1);
        (0, 1) for a grip.
        """
        sole = self.feet[name].sole
        if sole is None:
            return ca.DM(0, 1)
        moment, force = self.load_in_sole(name, load)
        x, y = sole.center
        torsion = moment[2] - (x * force[1] - y * force[0])
        arm = 2 / 3 * sole.inner_radius  # of a disc under uniform pressure: torsional limit over friction and load
        return (friction * force[2]) ** 2 - force[0] ** 2 - force[1] ** 2 - (torsion / arm) ** 2

    @cached_property
    def support(self) -> Support | None:
        """Convex hull of the soles of all standing feet, seen from above; None if one of these feet is a grip."""
        if any(self.feet[name].sole is None for name in self.footholds):
            return None
        points = [
            (np.asarray(place.position) + self.feet[name].corners @ np.asarray(place.rotation).T)[:, :2]
            for name, place in self.footholds.items()
        ]
        return Support(convex_hull(np.vstack(points)))

    def zero_moment_point(self, loads: Mapping[str, Expression]) -> Expression:
        """Return the zero moment point of the loads in the horizontal plane of the first foothold. Shape (2, 1), m."""
        moment, force = ca.DM(3, 1), ca.DM(3, 1)
        positions = [np.asarray(self.footholds[name].position) for name in loads]
        for position, load in zip(positions, loads.values(), strict=True):
            moment = moment + load[:3] + cross(ca.DM(position - [0.0, 0.0, positions[0][2]]), load[3:])
            force = force + load[3:]
        return ca.vertcat(-moment[1], moment[0]) / force[2]
