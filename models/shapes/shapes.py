"""Shapes of bodies and obstacles: spheres, capsules, cylinders, boxes, half-spaces and meshes, and moving obstacles.

Every bounded shape is the convex hull of a few points, its core, swept by a sphere. `models.shapes.distance` computes
distances from this representation. The coordinates of an obstacle are in world, those of a link's body in the link's
frame.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import cos, pi
from pathlib import Path
from typing import Any, ClassVar, Self, TypeAlias, get_args

import casadi as ca
import numpy as np

from models.checks import Array, ArrayInput, freeze, require, set_fields
from models.errors import ModelError
from models.shapes.hull import Hull, convex_hull
from models.spatial import Expression, Frame, expand_tables, expression

SIDES = 16
"""Number of sides of the prism that circumscribes a cylinder."""
CORNERS = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
"""Corners of the cube of half-edge 1. Shape (8, 3)."""


class _SweptCore:
    """A convex solid: all points within `swept_radius` of the convex hull of its core points.

    POINTS and AXES name the fields that are points, and directions or matrices of directions, in its frame.
    """

    POINTS: ClassVar[tuple[str, ...]] = ("position",)
    AXES: ClassVar[tuple[str, ...]] = ()

    @property
    def core(self) -> Array:
        """Points whose convex hull is the core of the shape. Shape (m, 3), m."""
        return np.array([getattr(self, name) for name in self.POINTS])

    @property
    def swept_radius(self) -> float:
        """Distance that the shape extends beyond the convex hull of its core, m."""
        return 0.0

    def placed(self, rotation: ArrayInput, translation: ArrayInput) -> Self:
        """Return the shape in a new frame, given the rotation (3, 3) and translation (3,), m, of its present frame."""
        turn = require.rotation("shape: rotation", rotation)
        shift = require.array("shape: translation", translation, (3,))
        own = copy(self)  # shares the hull, which is costly to compute
        for name in (*self.POINTS, *self.AXES):
            moved = turn @ getattr(self, name)
            set_fields(own, **{name: freeze(moved + shift if name in self.POINTS else moved)})
        return own

    def reach(self, point: ArrayInput) -> float:
        """Return the largest distance of the shape's points from a given point (3,), m; inf for an unbounded shape."""
        centre = require.array("shape: point", point, (3,))
        return float(np.linalg.norm(self.core - centre, axis=1).max()) + self.swept_radius


class Polytope(_SweptCore):
    """A shape with a pose of its own that distance computations replace by its `hull`, a convex polytope."""

    AXES: ClassVar[tuple[str, ...]] = ("rotation",)
    position: ArrayInput
    rotation: ArrayInput
    hull: Any

    @property
    def core(self) -> Array:
        """Vertices of the convex hull in the frame of the shape. Shape (m, 3), m."""
        return np.asarray(self.position + self.hull.vertices @ self.rotation.T)


@dataclass(frozen=True, eq=False)
class Sphere(_SweptCore):
    """A ball: all points within a radius of its centre.

    Attributes:
        radius: m.
        position: Centre. Shape (3,), m.

    Raises:
        ModelError: The radius is not positive, or the position is missing or not finite.
    """

    radius: float
    position: ArrayInput = None

    def __post_init__(self) -> None:
        set_fields(self, radius=require.positive("sphere: radius", self.radius, unit="m"))
        set_fields(self, position=_checked_position(self.position, "sphere"))

    @property
    def swept_radius(self) -> float:
        """Radius of the sphere, m."""
        return self.radius


@dataclass(frozen=True, eq=False)
class Capsule(_SweptCore):
    """A capsule: all points within a radius of a segment; a sphere if both ends coincide.

    Attributes:
        radius: m; 0 for a segment without thickness.
        start, end: Ends of the segment. Shape (3,), m.

    Raises:
        ModelError: The radius is negative, an end is not finite, or radius and length are both zero.
    """

    radius: float
    start: ArrayInput
    end: ArrayInput
    POINTS: ClassVar[tuple[str, ...]] = ("start", "end")

    def __post_init__(self) -> None:
        set_fields(self, radius=require.nonnegative("capsule: radius", self.radius, unit="m"))
        ends = ("start", "end")
        set_fields(self, **{name: require.array(f"capsule: {name}", getattr(self, name), (3,)) for name in ends})
        if self.radius == 0 and (self.start == self.end).all():
            message = "capsule: radius and length are zero; give a positive radius or two different ends"
            raise ModelError(message, name="radius", value=0.0, limit=0.0)

    @property
    def swept_radius(self) -> float:
        """Radius of the capsule, m."""
        return self.radius


@dataclass(frozen=True, eq=False)
class Cylinder(Polytope):
    """A solid cylinder about its own z axis.

    Distances use the circumscribed regular prism of SIDES sides. The edges of the prism exceed the cylinder by
    1/cos(pi / SIDES) - 1, 2 % of the radius; its ends and the centre lines of its sides lie on the cylinder.

    Attributes:
        radius: m.
        length: Along z, m.
        position: Centre. Shape (3,), m.
        rotation: Axes of the cylinder as columns. Shape (3, 3).

    Raises:
        ModelError: The radius or length is not positive, the position is missing, or the rotation is no rotation
            matrix.
    """

    radius: float
    length: float
    position: ArrayInput = None
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        for name in ("radius", "length"):
            set_fields(self, **{name: require.positive(f"cylinder: {name}", getattr(self, name), unit="m")})
        set_fields(self, position=_checked_position(self.position, "cylinder"))
        set_fields(self, rotation=require.rotation("cylinder: rotation", self.rotation))

    @cached_property
    def hull(self) -> Hull:
        """The prism that replaces the cylinder in the computation of distances, in the axes of the cylinder."""
        angles = 2 * pi / SIDES * (np.arange(SIDES) + 0.5)
        around = self.radius / cos(pi / SIDES) * np.column_stack([np.cos(angles), np.sin(angles)])
        half = np.full((SIDES, 1), self.length / 2)
        return convex_hull(np.vstack([np.hstack([around, -half]), np.hstack([around, half])]))


@dataclass(frozen=True, eq=False)
class Box(_SweptCore):
    """A solid box with a pose of its own and edges that may be infinite.

    Attributes:
        size: Full length of the edges. Shape (3,), m; inf along an axis without ends, as for walls of a wind tunnel.
            A box with an infinite edge has no core; it serves only as the walls around the captive trajectory rig.
        position: Centre. Shape (3,), m.
        rotation: Axes of the box as columns. Shape (3, 3).

    Raises:
        ModelError: An edge is not positive, every edge is infinite, the position is not finite, or the rotation is no
            rotation matrix.
    """

    size: ArrayInput
    position: ArrayInput = (0.0, 0.0, 0.0)
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))
    AXES: ClassVar[tuple[str, ...]] = ("rotation",)

    def __post_init__(self) -> None:
        size = require.array("box: size", self.size, (3,), unit="m", entries="numbers", sign="positive")
        set_fields(self, size=size)
        set_fields(self, position=_checked_position(self.position, "box"))
        set_fields(self, rotation=require.rotation("box: rotation", self.rotation))
        if np.isinf(size).all():
            raise ModelError("box: every edge is infinite; there is no outside", name="size", value=size)

    @property
    def core(self) -> Array:
        """Corners of the box, (8, 3), m; z varies fastest, x slowest. Raises ModelError for an infinite edge."""
        size = require.array("box: size", self.size, (3,), unit="m")
        return np.asarray(self.position + (CORNERS * size / 2) @ self.rotation.T)

    def reach(self, point: ArrayInput) -> float:
        """Return the largest distance of the box's points from a given point (3,), m; inf for an infinite box."""
        return super().reach(point) if np.isfinite(self.size).all() else np.inf


@dataclass(frozen=True, eq=False)
class HalfSpace(_SweptCore):
    """A half-space: all points on one side of a plane, such as a floor or a wall.

    Attributes:
        normal: Normal of the plane, pointing out of the solid; normalised. Shape (3,).
        point: A point on the plane. Shape (3,), m.

    Raises:
        ModelError: The normal has no length, the point is missing, or an entry is not finite.
    """

    normal: ArrayInput
    point: ArrayInput = None
    POINTS: ClassVar[tuple[str, ...]] = ("point",)
    AXES: ClassVar[tuple[str, ...]] = ("normal",)

    def __post_init__(self) -> None:
        normal = require.array("half-space: normal", self.normal, (3,))
        length = float(np.linalg.norm(normal))
        if not 0 < length < np.inf:
            raise ModelError(f"half-space: normal {normal.tolist()} has no direction", name="normal", value=normal)
        set_fields(self, normal=freeze(np.asarray(normal / length)))
        set_fields(self, point=_checked_position(self.point, "half-space", "point"))

    def reach(self, point: ArrayInput) -> float:
        """Return inf, because a half-space is unbounded."""
        require.array("half-space: point", point, (3,))
        return np.inf


@dataclass(frozen=True, eq=False)
class Mesh(Polytope):
    """The convex hull of a triangle mesh; cavities and holes are filled.

    Attributes:
        vertices: Shape (n, 3); None if a file is given.
        faces: Triangles as indices of vertices, or None to use every vertex. Unreferenced vertices are ignored. Shape
            (m, 3).
        position, rotation: Pose of the mesh's axes in the frame of the shape. Shapes (3,), m; (3, 3).
        file: STL, OBJ or DAE file that vertices and faces are read from, once.
        scale: m per unit of the vertices, a number or one for each axis; a negative factor mirrors.
        hull: Convex hull of the scaled vertices in the mesh's axes, m.

    Raises:
        ModelError: Both vertices and a file, or neither; an unreadable file; fewer than 4 vertices, or coplanar ones;
            faces of unknown vertices; a zero scale; a position that is not finite, or no rotation matrix.
    """

    vertices: ArrayInput = None
    faces: ArrayInput = None
    position: ArrayInput = (0.0, 0.0, 0.0)
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))
    file: str | Path | None = None
    scale: ArrayInput = 1.0
    hull: Hull = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.file is not None:
            if self.vertices is not None or self.faces is not None:
                raise ModelError("mesh: give vertices or a file, not both", name="file", value=self.file)
            if not isinstance(self.file, str | Path) or not str(self.file):
                raise ModelError(f"mesh: file {self.file!r} is not a path", name="file", value=self.file)
            from models.shapes.mesh_files import read_mesh

            vertices, faces = read_mesh(self.file)
            set_fields(self, vertices=vertices, faces=faces)
        elif self.vertices is None:
            raise ModelError("mesh: vertices are missing; give vertices or a file", name="vertices", value=None)
        vertices = require.array("mesh: vertices", self.vertices, ("vertices", 3), least=4)
        set_fields(self, vertices=vertices)
        if self.faces is not None:
            faces = require.indices("mesh: faces", self.faces, len(vertices))
            if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
                message = f"mesh: faces have shape {faces.shape}, expected (m, 3)"
                raise ModelError(message, name="faces", value=self.faces, limit=("m", 3))
            set_fields(self, faces=faces)
        scale = require.broadcast("mesh: scale", self.scale, 3, "axes")
        if not scale.all():
            message = f"mesh: scale {scale.tolist()} has a zero; every axis needs a nonzero factor"
            raise ModelError(message, name="scale", value=scale, limit=0.0)
        set_fields(self, scale=scale)
        set_fields(self, position=_checked_position(self.position, "mesh"))
        set_fields(self, rotation=require.rotation("mesh: rotation", self.rotation))
        used = vertices if self.faces is None else vertices[np.unique(self.faces)]
        set_fields(self, hull=convex_hull(used * scale))

    @classmethod
    def around(cls, hull: Hull) -> Mesh:
        """Return the mesh shape of a known convex hull, without computing the hull again."""
        mesh = object.__new__(cls)
        set_fields(mesh, vertices=hull.vertices, faces=hull.faces, file=None, scale=np.ones(3), hull=hull)
        set_fields(mesh, position=np.zeros(3), rotation=np.eye(3))
        return mesh


Shape: TypeAlias = Sphere | Capsule | Cylinder | Box | HalfSpace | Mesh
SHAPE_KINDS: tuple[type[Shape], ...] = get_args(Shape)


def checked_shape(label: str, value: Any) -> Shape:
    """Return the value after checking that it is a shape, such as a Box; raise ModelError otherwise."""
    if not isinstance(value, SHAPE_KINDS):
        names = ", ".join(kind.__name__ for kind in SHAPE_KINDS)
        raise require.invalid(label, f"a shape ({names})", value, names)
    return value


def enlarge_shape(shape: Shape, by: float) -> Shape:
    """Return a shape of the same kind that contains all points within a distance (m) of the given shape.

    Raises:
        ModelError: The shape is a mesh.
    """
    if isinstance(shape, HalfSpace):
        return replace(shape, point=shape.point + by * np.asarray(shape.normal))
    if isinstance(shape, Box):
        return replace(shape, size=shape.size + 2 * by)
    if isinstance(shape, Mesh):
        message = "a mesh cannot be enlarged; enclose it in boxes, capsules or cylinders"
        raise ModelError(message, name="obstacles", value=shape)
    if isinstance(shape, Cylinder):
        return replace(shape, radius=shape.radius + by, length=shape.length + 2 * by)
    return replace(shape, radius=shape.radius + by)


def _checked_position(value: ArrayInput, owner: str, what: str = "position") -> Array:
    if value is None:
        raise ModelError(f"{owner}: {what} is missing; give its coordinates, shape (3,), m", name=what, value=None)
    return require.array(f"{owner}: {what}", value, (3,))


@dataclass(frozen=True, eq=False)
class MovingObstacle:
    """An obstacle with a prescribed motion, such as a part on a conveyor or a tumbling target.

    Attributes:
        shape: Shape in a frame of its own; not a half-space.
        position: Function from time (s, a CasADi symbol) to the origin of that frame in world, shape (3,), m. Tables
            with one argument (`casadi.interpolant`, "linear" or "bspline") are converted to polynomials.
        rotation: Function from time to the frame's axes, as columns. Shape (3, 3). None: those of the world.

    Raises:
        ModelError: An invalid shape, a half-space, functions that return something else or depend on more than time, an
            invalid rotation.
    """

    shape: Shape
    position: Callable[[Any], Any]
    rotation: Callable[[Any], Any] | None = None
    _at: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if isinstance(checked_shape("moving: shape", self.shape), HalfSpace):
            message = "moving: a half-space cannot move; give a box that is large enough"
            raise ModelError(message, name="shape", value=self.shape)
        time = ca.SX.sym("time")
        parts = []
        for name, function, shape in (("position", self.position, (3, 1)), ("rotation", self.rotation, (3, 3))):
            if function is None and name == "rotation":
                parts.append(ca.SX.eye(3))
                continue
            if not callable(function):
                message = f"moving: {name} must be a function of time, not {function!r}"
                raise ModelError(message, name=name, value=function)
            try:
                value = expand_tables(ca.densify(ca.SX(expression(function(time)))))
            except Exception as error:  # also errors inside the function
                message = f"moving: {name} is no function of a casadi symbol, the time: {error}"
                raise ModelError(message, name=name, value=function) from error
            symbols = ca.symvar(value)
            if value.shape != shape or any(not ca.is_equal(symbol, time) for symbol in symbols):
                message = f"moving: {name} gives {value.shape} of {symbols}; {shape} of the time alone expected"
                raise ModelError(message, name=name, value=value.shape, limit=shape)
            parts.append(value)
        set_fields(self, _at=ca.Function("moving", [time], [parts[1], parts[0]]))
        for name, part in zip(("position", "rotation"), parts, strict=True):
            if not ca.symvar(part):
                require.array(f"moving: {name}", ca.DM(part).full(), part.shape)
        turn = self._at(0.0)[0].full()
        if np.isfinite(turn).all():
            require.rotation("moving: rotation", turn)

    def frame(self, time: Expression) -> Frame:
        """Return the pose of the moving shape's frame in the world at a time (s)."""
        return Frame(*self._at(time))

    def check(self, begin: float, end: float) -> None:
        """Raise ModelError if the obstacle's pose is invalid at a sampled time between `begin` and `end` (s)."""
        times = np.linspace(begin, end, 513)
        turns, places = (np.array(part) for part in self._at(times[None]))
        broken = ~np.isfinite(places).all(axis=0)
        if broken.any():
            time = float(times[broken.argmax()])
            value = places[:, broken.argmax()].tolist()
            message = f"moving: position {value} is not finite, at {time:g} s"
            raise ModelError(message, name="position", value=value, time=time)
        for turn, time in zip(turns.reshape(3, -1, 3).transpose(1, 0, 2), times.tolist(), strict=True):
            try:
                require.rotation("moving: rotation", turn)
            except ModelError as error:
                raise ModelError(f"{error}, at {time:g} s", **{**vars(error), "time": time}) from error
