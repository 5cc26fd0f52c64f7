"""The region of the ground that a foot rests on: a convex polygon."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import casadi as ca
import numpy as np

from models.arrays import ROUNDING, Array, ArrayInput, checked_array, frozen
from models.errors import ModelError
from models.robot.kinematics import checked_vector
from models.spatial import Expression


@dataclass(frozen=True, eq=False)
class Support:
    """Convex polygon on the ground, in world axes.

    Attributes:
        vertices: Corners in order, either way round; stored counter-clockwise, without those on a straight edge.
            Shape (k, 2), m.

    Raises:
        ModelError: Fewer than three corners, a polygon without area, one that is not convex or crosses itself.
    """

    vertices: ArrayInput

    def __post_init__(self) -> None:
        corners: Array = checked_array(self.vertices, ("corners", 2), "support", "vertices", least=3, unit="m")
        size = float(np.ptp(corners, axis=0).max())
        area = _area(corners)
        if abs(area) <= ROUNDING * size**2:
            message = f"support: the polygon {corners.tolist()} has no area; give corners that are not in line"
            raise ModelError(message, name="vertices", value=corners)
        if area < 0:
            corners = corners[::-1]
        edges = np.roll(corners, -1, axis=0) - corners
        lengths = np.linalg.norm(edges, axis=1)
        if lengths.min() <= ROUNDING * size:
            twice = corners[lengths.argmin()].tolist()
            raise ModelError(
                f"support: corner {twice} occurs twice in a row; give it once", name="vertices", value=twice
            )
        ahead = np.roll(edges, -1, axis=0)
        turns = np.arctan2(_cross(edges, ahead), (edges * ahead).sum(axis=1))
        worst = int(turns.argmin())
        if turns[worst] < -ROUNDING:
            corner = np.roll(corners, -1, axis=0)[worst]
            message = (
                f"support: the polygon {corners.tolist()} is not convex at {corner.tolist()}; "
                "the ground carries a foot on the convex hull of its contact points: give that"
            )
            raise ModelError(message, name="vertices", value=corner)
        if turns.sum() > 3 * np.pi:
            message = f"support: the polygon {corners.tolist()} crosses itself; give its corners in order"
            raise ModelError(message, name="vertices", value=corners)
        object.__setattr__(self, "vertices", frozen(corners[np.roll(turns, 1) > ROUNDING]))

    @property
    def area(self) -> float:
        """m^2."""
        return _area(self.vertices)

    @property
    def center(self) -> Array:
        """Middle of the bounding box. Shape (2,), m."""
        return np.asarray(self.vertices.max(axis=0) + self.vertices.min(axis=0)) / 2

    @property
    def half_widths(self) -> Array:
        """Half the sides of the bounding box. Shape (2,), m."""
        return np.asarray(np.ptp(self.vertices, axis=0)) / 2

    @cached_property
    def inner_radius(self) -> float:
        """Radius of the largest circle inside, m: the largest margin that any point has."""
        offsets = (self.normals * self.vertices).sum(axis=1)
        best = 0.0
        for chosen in combinations(range(len(offsets)), 3):  # it touches three edges (two parallel ones and another)
            edges = list(chosen)
            system = np.column_stack([self.normals[edges], -np.ones(3)])
            if abs(np.linalg.det(system)) > ROUNDING:
                *point, radius = np.linalg.solve(system, offsets[edges])
                if (self.normals @ point - offsets >= radius - ROUNDING).all():
                    best = max(best, float(radius))
        return best

    @cached_property
    def normals(self) -> Array:
        """Inward unit normals of the edges, edge i from corner i to the next. Shape (k, 2)."""
        edges = np.roll(self.vertices, -1, axis=0) - self.vertices
        return np.asarray(np.column_stack([-edges[:, 1], edges[:, 0]]) / np.linalg.norm(edges, axis=1)[:, None])

    def distances(self, point: Expression) -> Expression:
        """Signed distance of a point from every edge's line, positive inside. Shape (k, 1), m."""
        point = checked_vector(point, 2, "point", "x and y on the ground")
        offsets = (self.normals * self.vertices).sum(axis=1)
        return ca.mtimes(ca.sparsify(ca.DM(self.normals)), point) - ca.DM(offsets)

    def margin(self, point: Expression) -> Expression:
        """Least of :meth:`distances`: how far a point may move before it leaves the polygon. Shape (1, 1), m.

        Negative outside; there its size is the distance from the farthest line, at most that from the polygon.
        """
        return ca.mmin(ca.densify(self.distances(point)))


def rectangle(x: ArrayInput, y: ArrayInput) -> Support:
    """Rectangular support from (least, greatest) x and y, m.

    Raises:
        ModelError: Not two numbers each, a side without length.
    """
    x, y = checked_array(x, (2,), "rectangle", "x"), checked_array(y, (2,), "rectangle", "y")
    for what, (least, greatest) in (("x", x), ("y", y)):
        if not least < greatest:
            message = f"rectangle: {what} from {least:g} to {greatest:g} m has no length; least first"
            raise ModelError(message, name=what, value=(least, greatest))
    return Support([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])])


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _area(corners: Array) -> float:
    return float(_cross(corners, np.roll(corners, -1, axis=0)).sum() / 2)
