"""A machine that stands on some of its feet, each held on its foothold: what each foot bears, and whether it holds.

As long as the feet do not move the machine is one on a fixed base, hung up at one of them; what the others bear closes
the loops, and the first bears the rest. A foot is a sole on a foothold, which pushes and does not pull, or a grip,
which bears whatever comes, as that of a base that docks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import casadi as ca
import numpy as np

from models.arrays import (
    ROUNDING,
    Array,
    ArrayInput,
    checked_array,
    checked_instance,
    checked_mapping,
    checked_name,
    checked_number,
    checked_rotation,
)
from models.errors import ModelError
from models.machines.machine import FixedBase
from models.machines.support import Support, convex_hull, footprint
from models.robot.dynamics import Wrench, base_reaction, inverse_dynamics
from models.robot.kinematics import center_of_mass, checked_vector, frame_jacobian, link_frames
from models.robot.parts import massless_error
from models.robot.rebuild import reroot, simplify, subtree
from models.robot.robot import Robot
from models.robot.tree import unknown_name
from models.spatial import Expression, Frame, cross

__all__ = ["Foot", "Foothold", "Stance"]

SAMPLES = 5
"""Random motions in which it is looked at what the joints move."""


@dataclass(frozen=True, eq=False)
class Foot:
    """A part of a robot that it may stand on.

    Attributes:
        link: Name of the link that carries it.
        sole: What touches, in axes x and y of the sole's frame; None for a grip, which bears whatever comes.
        translation: Origin of the sole's frame in the link's frame. Shape (3,), m.
        rotation: Its axes, as columns, in the link's frame, z out of the ground. Shape (3, 3).

    Raises:
        ModelError: Sizes that do not fit, a rotation that is none, a sole that is no Support.
    """

    link: str
    sole: Support | None = None
    translation: ArrayInput = (0.0, 0.0, 0.0)
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        owner = f"foot {checked_name(self.link, 'foot', 'link')!r}"
        if self.sole is not None:
            checked_instance(self.sole, Support, owner, "sole")
        object.__setattr__(self, "translation", checked_array(self.translation, (3,), owner, "translation"))
        object.__setattr__(self, "rotation", checked_rotation(self.rotation, owner, "rotation"))

    @classmethod
    def of(cls, robot: Robot, link: str, rotation: ArrayInput = None) -> Self:
        """The lowest of a link's collision shapes as `models.footprint` finds it, below the origin of the link's frame.

        Args:
            robot: With the link and its shapes.
            link: Its name.
            rotation: Axes of the link's frame, as columns, where the sole is level, z upwards; no turn if None.
        """
        ground = footprint(subtree(robot, link), rotation=rotation, links=[link])
        turn = np.asarray(ground.rotation).T
        return cls(link, ground.support, -turn @ ground.translation, turn)

    @cached_property
    def corners(self) -> Array:
        """Corners of the sole in the sole's frame; its origin for a grip. Shape (k, 3), m."""
        if self.sole is None:
            return np.zeros((1, 3))
        plane = np.asarray(self.sole.vertices)
        return np.column_stack([plane, np.zeros(len(plane))])


@dataclass(frozen=True, eq=False)
class Foothold:
    """Where a sole's frame is while the foot is held.

    Attributes:
        position: Of its origin in the world. Shape (3,), m.
        rotation: Its axes, as columns, in the world, z out of the ground. Shape (3, 3).
    """

    position: ArrayInput
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", checked_array(self.position, (3,), "foothold", "position", unit="m"))
        object.__setattr__(self, "rotation", checked_rotation(self.rotation, "foothold", "rotation"))

    @classmethod
    def level(cls, x: float, y: float, heading: float = 0.0, height: float = 0.0) -> Self:
        """On level ground: at x and y (m), turned to the left by a heading (rad), at a height (m) above z = 0."""
        given = {"x": x, "y": y, "heading": heading, "height": height}
        x, y, heading, height = (checked_number(value, "foothold", name) for name, value in given.items())
        turn = [[np.cos(heading), -np.sin(heading), 0.0], [np.sin(heading), np.cos(heading), 0.0], [0.0, 0.0, 1.0]]
        return cls((x, y, height), turn)


@dataclass(frozen=True, eq=False, kw_only=True)
class Stance(FixedBase):
    """A robot held on some of its feet: a machine on a fixed base, rooted at the first of them. Made by `Stance.on`.

    Besides what a FixedBase has (`robot`, rooted at the first foothold's foot, and its place):

    Attributes:
        feet: All feet, by name, those in the air too.
        footholds: Where the feet that are held are, by their names.
        gravity: m/s^2, downwards.

    A load of a foot is (moment about the origin of its sole's frame, force) that the foothold does to it, in world
    axes, shape (6, 1), N m and N.
    """

    feet: Mapping[str, Foot]
    footholds: Mapping[str, Foothold]
    gravity: float = 9.81

    @classmethod
    def on(
        cls, robot: Robot, feet: Mapping[str, Foot], footholds: Mapping[str, Foothold], gravity: float = 9.81
    ) -> Self:
        """A robot on footholds, of which there is at least one.

        Raises:
            ModelError: No foothold, a foothold of no foot, two feet of one link, a link that the robot does not have,
                a robot without mass or moving joints, a gravity that is not positive.
        """
        owner = "stance"
        checked_instance(robot, Robot, owner, "robot")
        for what, given, kind in (("feet", feet, Foot), ("footholds", footholds, Foothold)):
            for name, value in checked_mapping(given, owner, what).items():
                checked_instance(value, kind, f"{owner}: {name!r}", what)
        if not footholds:
            raise ModelError(f"{owner}: no footholds are given; nothing stands on nothing", name="footholds")
        for name in footholds:
            if name not in feet:
                raise unknown_name("foot", name, feet)
        links = [robot.link(foot.link).name for foot in feet.values()]
        if twice := [link for link in links if links.count(link) > 1]:
            raise ModelError(f"{owner}: link {twice[0]!r} is two feet; join their soles", name="feet", value=twice)
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
            gravity=checked_number(gravity, owner, "gravity", positive=True, unit="m/s^2"),
        )

    @property
    def weight(self) -> float:
        """N."""
        return self.robot.total_mass * self.gravity

    @cached_property
    def bodies(self) -> Robot:
        """The robot with one link for each moving joint, and the feet: the same dynamics, sooner."""
        return simplify(self.robot, {foot.link for foot in self.feet.values()})

    def foot(self, name: str) -> Foot:
        """A foot by its name; ModelError, which says what names come near, when there is none."""
        if not isinstance(name, str) or name not in self.feet:
            raise unknown_name("foot", name, self.feet)
        return self.feet[name]

    @property
    def other_feet(self) -> tuple[str, ...]:
        """Names of the feet that are held besides the first."""
        return tuple(self.footholds)[1:]

    def sole_frame(self, name: str, q: Expression) -> Frame:
        """Frame of the sole of any foot, held or in the air, in the world."""
        foot = self.foot(name)
        link = link_frames(self.bodies, q, self.world_from_base())[foot.link]
        return Frame(ca.mtimes(link.rotation, ca.DM(foot.rotation)), link.point(ca.DM(foot.translation)))

    def sole_corners(self, name: str, q: Expression) -> Expression:
        """Corners of any foot's sole in the world, one column each. Shape (3, k), m."""
        frame = self.sole_frame(name, q)
        corners = ca.DM(self.foot(name).corners.T)
        return ca.mtimes(frame.rotation, corners) + ca.repmat(frame.position, 1, corners.shape[1])

    def center_of_mass(self, q: Expression) -> Expression:
        """In the world. Shape (3, 1), m."""
        return center_of_mass(self.bodies, q, self.world_from_base())

    def loads(
        self, q: Expression, qd: Expression, qdd: Expression, others: Mapping[str, Expression]
    ) -> dict[str, Expression]:
        """Loads of all feet that are held, in a motion and with those of the others: the first bears what is left."""
        given = base_reaction(self.bodies, q, qd, qdd, self._wrenches(others), self._fall, self.world_from_base())
        first = next(iter(self.footholds))
        moment, force = given[:3], given[3:]
        left = ca.vertcat(moment - cross(ca.DM(self.footholds[first].position), force), force)
        return {first: left, **{name: others[name] for name in self.other_feet}}

    def joint_torques(
        self, q: Expression, qd: Expression, qdd: Expression, others: Mapping[str, Expression]
    ) -> Expression:
        """Torques (forces) of the joints by inverse dynamics, with the loads of the other feet. Shape (n, 1)."""
        return inverse_dynamics(self.bodies, q, qd, qdd, self._wrenches(others), self._fall, self.world_from_base())

    @property
    def _fall(self) -> Array:
        return np.array([0.0, 0.0, -self.gravity])

    def _wrenches(self, others: Mapping[str, Expression]) -> list[Wrench]:
        others = checked_mapping(others, "stance", "others")
        if set(others) != set(self.other_feet):
            message = f"stance: loads of the feet {list(self.other_feet)} are needed, not of {list(others)}"
            raise ModelError(message, name="others", value=tuple(others), limit=self.other_feet)
        found = []
        for name, load in others.items():
            load = checked_vector(load, 6, f"load of {name!r}", "moment about the sole's origin and force")
            foot = self.feet[name]
            found.append(Wrench(foot.link, load[3:], load[:3], foot.translation))
        return found

    @cached_property
    def load_rows(self) -> dict[str, tuple[int, ...]]:
        """Rows of the twist of each foot, world axes, that the joints move: all six, or three in a plane.

        For every foot but the first, in the air or held. Its load has these rows, too: the others nothing resists.

        Raises:
            ModelError: These rows depend on each other whatever the posture: a plane askew to the axes.
        """
        rng = np.random.default_rng(0)
        first = next(iter(self.footholds))
        found = {}
        for name, foot in self.feet.items():
            if name == first:
                continue
            q = ca.SX.sym("q", self.joint_size)
            frames = ca.Function(
                "jacobian",
                [q],
                [frame_jacobian(self.bodies, q, foot.link, foot.translation, world_from_base=self.world_from_base())],
            )
            sampled = [np.array(frames(rng.normal(size=self.joint_size))) for _ in range(SAMPLES)]
            sizes = np.max([np.abs(each).max(axis=1) for each in sampled], axis=0)
            rows = tuple(int(i) for i in np.flatnonzero(sizes > ROUNDING * sizes.max(initial=0.0)))
            ranks = [np.linalg.matrix_rank(each[list(rows)], tol=ROUNDING * sizes.max()) for each in sampled]
            if not rows or max(ranks) < len(rows):
                message = (
                    f"foot {name!r}: the joints move it in {max(ranks, default=0)} directions only, which are not "
                    "along axes of the world; put the robot's plane along them"
                )
                raise ModelError(message, name=name, value=max(ranks, default=0), limit=len(rows))
            found[name] = rows
        return found

    def full_load(self, name: str, rows: Expression) -> Expression:
        """A load of which only the `load_rows` are given. Shape (6, 1)."""
        return ca.mtimes(ca.DM.eye(6)[:, list(self.load_rows[name])], rows)

    def load_in_sole(self, name: str, load: Expression) -> tuple[Expression, Expression]:
        """Moment and force of a load in the axes of the foothold. Shape (3, 1) each."""
        turn = ca.DM(np.asarray(self.footholds[name].rotation).T)
        return ca.mtimes(turn, load[:3]), ca.mtimes(turn, load[3:])

    def pressure(self, name: str, load: Expression) -> Expression:
        """Force that presses a sole on its foothold, positive where it holds. Shape (1, 1), N."""
        return self.load_in_sole(name, load)[1][2]

    def edge_moments(self, name: str, load: Expression, margin: float = 0.0) -> Expression:
        """Moments of a load about the edges of its sole, drawn in by a margin: none negative where it does not tip.

        Distance of the center of pressure from the edge times the pressure, N m, for each edge that motion can bring
        the center of pressure nearer to. Shape (k, 1); none for a grip.

        Raises:
            ModelError: The center of pressure is beyond another edge whatever the joints do.
        """
        sole = self.feet[name].sole
        if sole is None:
            return ca.DM(0, 1)
        moment, force = self.load_in_sole(name, load)
        offsets = (sole.normals * sole.vertices).sum(axis=1) + margin
        rows = (
            ca.mtimes(ca.sparsify(ca.DM(sole.normals)), ca.vertcat(-moment[1], moment[0])) - ca.DM(offsets) * force[2]
        )
        return rows[self._edges(name, margin)]

    def _edges(self, name: str, margin: float) -> list[int]:
        """Edges of a sole that motion can bring the center of pressure nearer to, or farther from."""
        sole = self.feet[name].sole
        assert sole is not None
        distances = self._pressed[name] @ sole.normals.T - (sole.normals * sole.vertices).sum(axis=1)
        moved = np.ptp(distances, axis=0) > ROUNDING
        for i in np.flatnonzero(~moved):
            if distances[0, i] < margin - ROUNDING:
                message = (
                    f"foot {name!r}: the center of pressure is {margin - distances[0, i]:.4g} m beyond an edge of the "
                    "sole, less its margin, whatever the joints do"
                )
                raise ModelError(message, name=name, value=float(margin - distances[0, i]), limit=0.0)
        return [int(i) for i in np.flatnonzero(moved)]

    @cached_property
    def _pressed(self) -> dict[str, Array]:
        """Centers of pressure of a few motions, in each sole. Shape (samples, 2) each, m."""
        rng = np.random.default_rng(0)
        found: dict[str, list[Array]] = {name: [] for name in self.footholds}
        for _ in range(SAMPLES):
            drawn = {}
            for name in self.other_feet:
                part = rng.normal(size=len(self.load_rows[name]))
                drawn[name] = ca.DM(self.full_load(name, part)) + ca.DM([0, 0, 0, 0, 0, 10])
            q, qd, qdd = rng.normal(size=(3, self.joint_size))
            values = self.loads(q, qd, qdd, drawn)
            for name, load in values.items():
                moment, force = (np.array(ca.DM(part)).ravel() for part in self.load_in_sole(name, load))
                found[name].append(np.array([-moment[1], moment[0]]) / force[2])
        return {name: np.array(points) for name, points in found.items()}

    def friction_margin(self, name: str, load: Expression, friction: float) -> Expression:
        """What friction holds less what it gives, squares, N^2, not negative where the sole does not slip or turn.

        (mu f_z)^2 - f_x^2 - f_y^2 - (m_z / c)^2 with the moment m_z about the normal through the middle of the sole and
        c two thirds of the radius of the largest circle in it: the ellipsoid of Howe and Cutkosky (1996). Nothing for a
        grip. Shape (1, 1) or (0, 1).
        """
        sole = self.feet[name].sole
        if sole is None:
            return ca.DM(0, 1)
        moment, force = self.load_in_sole(name, load)
        x, y = sole.center
        turning = moment[2] - (x * force[1] - y * force[0])
        arm = 2 / 3 * sole.inner_radius  # of a disc evenly pressed: the moment that it bears over friction and load
        return (friction * force[2]) ** 2 - force[0] ** 2 - force[1] ** 2 - (turning / arm) ** 2

    @cached_property
    def support(self) -> Support | None:
        """Convex hull of all soles that are held, seen from above; None where there is a grip besides."""
        if any(self.feet[name].sole is None for name in self.footholds):
            return None
        points = [
            (np.asarray(place.position) + self.feet[name].corners @ np.asarray(place.rotation).T)[:, :2]
            for name, place in self.footholds.items()
        ]
        return Support(convex_hull(np.vstack(points)))

    def zero_moment_point(self, loads: Mapping[str, Expression]) -> Expression:
        """Where the sum of the loads has no horizontal moment, at the height of the first foothold. Shape (2, 1), m."""
        moment, force = ca.DM(3, 1), ca.DM(3, 1)
        places = [np.asarray(self.footholds[name].position) for name in loads]
        for place, load in zip(places, loads.values(), strict=True):
            moment = moment + load[:3] + cross(ca.DM(place - [0.0, 0.0, places[0][2]]), load[3:])
            force = force + load[3:]
        return ca.vertcat(-moment[1], moment[0]) / force[2]
