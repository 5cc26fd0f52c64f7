"""Pictures of surfaces, drawn by a z-buffer in numpy: they need no display, no graphics card and no system library.

Of all triangles that cover a place of the picture the nearest is seen (Catmull 1974); what is seen is shaded with
normals interpolated over its triangle (Phong 1975), lit from the sky, by a lamp at the eye and by a sun, whose shadows
are those of a depth map (Williams 1978). Each pixel is the mean of several places.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.arrays import Array
from ocp.app.view.appearance import Appearance, Frames, Part
from ocp.errors import ProblemError

__all__ = ["PICTURE_STYLE", "Camera", "Floor", "Layer", "PictureStyle", "parts_in_world", "render", "tube"]


@dataclass(frozen=True)
class PictureStyle:
    """How pictures and curves look.

    Attributes:
        size: Of a rendered picture, pixels. most_pixels: Of any.
        half_view: Angle under which half of a picture's height is seen, rad.
        finer: Places along each side of a pixel, of which it is the mean.
        at_once: Places that are looked at together, for the sake of memory.
        fading: Share of the lesser side of a picture within which the floor fades towards its edge.
        sun: Azimuth from the camera's, to its left, and elevation, rad.
        shadow_map: Places along each side of the map of shadows, of the pixels along the greater side of the picture.
        shadow_blur: Places of that map around one at which it is looked at.
        shadow_bias: How far off a surface its shadow is asked for, places of that map.
        behind: A veil that is less than this share of its distance before what is solid counts as behind it.
        tube_sides: Of a round line. line: Its radius, of the size of what a picture shows.
        poses: Times at which the robot is shown.
        curve_points: Of a curve.
        limit_room: Limits further from a curve than this many of its spans would leave nothing of its shape to see.
        flat: Share of the largest value of a kind: what changes by less is rounding.
        width: Of a figure, inches. columns: Of solutions' curves in it. entries: Of states and controls in it at most.
    """

    size: tuple[int, int] = (960, 680)
    most_pixels: int = 2**24
    half_view: float = 0.22
    finer: int = 2
    at_once: int = 1_000_000
    fading: float = 0.1
    sun: tuple[float, float] = (np.deg2rad(38.0), np.deg2rad(52.0))
    shadow_map: float = 1.25
    shadow_blur: tuple[int, ...] = (-2, 0, 2)
    shadow_bias: float = 6.0
    behind: float = 3e-3
    tube_sides: int = 10
    line: float = 0.003
    poses: int = 4
    curve_points: int = 400
    limit_room: float = 1.5
    flat: float = 1e-3
    width: float = 7.4
    columns: int = 3
    entries: int = 60

    @property
    def lens(self) -> float:
        """The distance at which a picture is seen over half its height."""
        return float(1 / np.tan(self.half_view))


PICTURE_STYLE = PictureStyle()


class Camera(NamedTuple):
    """Where a picture is taken from, in perspective.

    Attributes:
        eye: In world. Shape (3,), m.
        axes: Unit vectors to the right, up and back towards the eye, as rows, in world. Shape (3, 3).
        size: Width and height of the picture, pixels.
    """

    eye: Array
    axes: Array
    size: tuple[int, int]

    @classmethod
    def around(
        cls, points: Any, size: tuple[int, int], elevation: float = 22.0, azimuth: float = -58.0, room: float = 0.04
    ) -> Camera:
        """The nearest camera, looking from a side, that sees all points (k, 3), m; angles in degrees.

        `room` is left at every edge, a share of the picture. Each edge of the picture is a plane through the eye that
        must leave all points on its inner side, so that the eye's place is known in closed form.
        """
        most, lens = PICTURE_STYLE.most_pixels, PICTURE_STYLE.lens
        if min(size) < 1 or size[0] * size[1] > most:
            text = f"a picture of {size[0]} by {size[1]} pixels: from 1 to {most} in all"
            raise ProblemError(text, name="size", value=size, limit=most)
        rise, turn = np.deg2rad(elevation), np.deg2rad(azimuth)
        back = np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
        right = np.array([-np.sin(turn), np.cos(turn), 0.0])
        axes = np.stack([right, np.cross(back, right), back])
        x, y, z = axes @ np.asarray(points, dtype=float).reshape(-1, 3).T
        eye = np.zeros(3)
        for k, (along, slope) in enumerate(((x, lens * size[1] / size[0]), (y, lens))):
            slope /= 1 - 2 * room
            upper, lower = (z + slope * along).max(), (z - slope * along).max()
            eye[k], eye[2] = (upper - lower) / (2 * slope), max(eye[2] if k else -np.inf, (upper + lower) / 2)
        return cls(eye @ axes, axes, size)

    def seen(self, points: Any) -> tuple[Array, Array]:
        """Where points (..., 3) are in the picture, pixels from its upper left corner, (..., 2), and how far, m."""
        x, y, z = np.moveaxis((np.asarray(points, dtype=float) - self.eye) @ self.axes.T, -1, 0)
        far = np.maximum(-z, 1e-9)
        width, height = self.size
        scale = PICTURE_STYLE.lens * height / 2 / far
        return np.stack([width / 2 + scale * x, height / 2 - scale * y], axis=-1), far

    def rays(self, cells: NDArray[np.intp]) -> Array:
        """Ways from the eye through the middles of cells, numbered row by row, one m deep each. Shape (k, 3), m."""
        width, height = self.size
        row, column = np.divmod(cells, width)
        step = 2 / (PICTURE_STYLE.lens * height)
        x, y = (column + 0.5 - width / 2) * step, (height / 2 - row - 0.5) * step
        return np.asarray(x[:, None] * self.axes[0] + y[:, None] * self.axes[1] - self.axes[2])


class Layer(NamedTuple):
    """Surfaces that are seen together, in world.

    Attributes:
        parts: Surfaces.
        opacity: Below 1 it is a veil: of it the nearest surface alone is seen, it casts no shadow, it never covers what
            is solid in the first layer, and veils lie over each other in the order in which they are given.
        tint: Red, green and blue that take the place of the parts' own colours.
    """

    parts: Sequence[Part]
    opacity: float = 1.0
    tint: tuple[float, float, float] | None = None


class Floor(NamedTuple):
    """Level ground with a square grid, which fades away from its middle.

    Attributes:
        height: m. middle: x and y, m. radius: Where it has faded, m. grid: Between two lines, m.
    """

    height: float
    middle: tuple[float, float]
    radius: float
    grid: float


def parts_in_world(looks: Appearance, frames: Frames, k: int) -> list[Part]:
    """What a robot looks like at sample k of a motion, in world."""
    found = []
    for part in looks.parts:
        turn, shift = frames.rotations[part.link][k], frames.positions[part.link][k]
        found.append(replace(part, vertices=part.vertices @ turn.T + shift, normals=part.normals @ turn.T))
    return found


def tube(points: Any, radius: float, color: tuple[float, float, float]) -> Part:
    """A round line through points (k, 3), m, of a radius, m, and a colour, red, green and blue."""
    line = np.asarray(points, dtype=float)
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-9 * max(float(np.ptp(line, axis=0).max()), 1e-12)
    line = line[np.append(True, steps)]
    if len(line) < 2:
        line = line[:1] + np.array([[-1e-6, 0, 0], [1e-6, 0, 0]])
    along = np.gradient(line, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-12)[:, None]
    side = np.cross(along[0], np.eye(3)[int(np.abs(along[0]).argmin())])
    sides = np.empty_like(line)
    for k, one in enumerate(along):  # carried along without a twist
        side = side - one * (one @ side)
        side /= np.linalg.norm(side)
        sides[k] = side
    count = PICTURE_STYLE.tube_sides
    angle = np.arange(count) * (2 * np.pi / count)
    around = np.cos(angle)[:, None] * sides[:, None] + np.sin(angle)[:, None] * np.cross(along, sides)[:, None]
    rings, places = (one.ravel() for one in np.meshgrid(np.arange(len(line) - 1), np.arange(count), indexing="ij"))
    a, b = rings * count + places, rings * count + (places + 1) % count
    faces = np.concatenate([np.stack([a, b, b + count], axis=1), np.stack([a, b + count, a + count], axis=1)])
    flat = around.reshape(-1, 3)
    return Part("", (line[:, None] + radius * around).reshape(-1, 3), flat, faces, (*color, 1.0))


def render(
    layers: Sequence[Layer], camera: Camera, *, floor: Floor | None = None, finer: int = PICTURE_STYLE.finer
) -> NDArray[np.uint8]:
    """The picture, on white, each pixel the mean of `finer` places to a side. Shape (height, width, 3)."""
    width, height = camera.size
    fine = camera._replace(size=(finer * width, finer * height))
    solid = _Mesh.of([part for layer in layers if layer.opacity >= 1 for part in layer.parts if part.color[3] >= 1])
    sun = _Sun.on(solid, camera) if len(solid.faces) else None
    picture = np.ones((fine.size[0] * fine.size[1], 3), dtype=np.float32)
    nearness, faces = _nearest(*_projected(fine, solid), fine.size)
    if floor is not None:
        _lay(picture, floor, fine, sun)
    first = sum(len(part.faces) for part in layers[0].parts if part.color[3] >= 1) if layers else 0
    nearness = np.where((faces >= 0) & (faces < first), np.inf, nearness)
    cells = np.flatnonzero(faces >= 0)
    picture[cells] = _shaded(solid, faces[cells], fine.rays(cells), fine, sun)
    for layer in layers:
        for opacity in sorted({part.color[3] for part in layer.parts}, reverse=True):
            if opacity >= 1 and layer.opacity >= 1:
                continue
            veil = _Mesh.of([part for part in layer.parts if part.color[3] == opacity], layer.tint)
            near, faces = _nearest(*_projected(fine, veil), fine.size)
            cells = np.flatnonzero((faces >= 0) & (near > (1 + PICTURE_STYLE.behind) * nearness))
            share = np.float32(layer.opacity * opacity)
            lit = _shaded(veil, faces[cells], fine.rays(cells), fine, None)
            picture[cells] = (1 - share) * picture[cells] + share * lit
    small = picture.reshape(height, finer, width, finer, 3).mean(axis=(1, 3))
    return np.asarray(np.round(255 * np.clip(small, 0.0, 1.0)), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class _Mesh:
    """Triangles in world: corners and normals (n, 3) each, faces (f, 3), their colours (f, 3)."""

    corners: Array
    normals: Array
    faces: NDArray[np.intp]
    colors: Array

    @classmethod
    def of(cls, parts: Sequence[Part], tint: tuple[float, float, float] | None = None) -> _Mesh:
        mesh = cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), dtype=np.intp), np.zeros((0, 3)))
        if not parts:
            return mesh
        first = np.cumsum([0, *(len(part.vertices) for part in parts)])
        colors = [np.tile(part.color[:3] if tint is None else tint, (len(part.faces), 1)) for part in parts]
        faces = [part.faces + shift for part, shift in zip(parts, first, strict=False)]
        corners, normals = (np.concatenate([getattr(part, name) for part in parts]) for name in ("vertices", "normals"))
        return cls(corners, normals, np.concatenate(faces), np.concatenate(colors))


def _projected(camera: Camera, mesh: _Mesh) -> tuple[Array, Array]:
    """Places of the corners of all triangles (f, 3, 2), and one over their depths (f, 3), linear in the picture."""
    places, far = camera.seen(mesh.corners)
    return places[mesh.faces], (1.0 / far)[mesh.faces]


def _nearest(places: Array, near: Array, size: tuple[int, int]) -> tuple[Array, NDArray[np.intp]]:
    """How near the nearest triangle is at the middle of every cell, -inf where there is none, and its number, -1.

    Args:
        places: Corners (f, 3, 2), in cells from the upper left. near: Of the corners (f, 3), linear over a triangle.
        size: Columns and rows of cells, which are numbered row by row.
    """
    width, height = size
    depth, number = np.full(height * width, -np.inf), np.full(height * width, -1, dtype=np.intp)
    one, two = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    area = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    top = np.clip(np.ceil(places[..., 1].min(axis=1) - 0.5), 0, height).astype(np.int64)
    rows = np.clip(np.floor(places[..., 1].max(axis=1) - 0.5) + 1, 0, height).astype(np.int64) - top
    kept = np.flatnonzero((rows > 0) & (np.abs(area) > 1e-12) & (near < 1e8).all(axis=1))
    one, two, start, rows = one[kept], two[kept], places[kept, 0], rows[kept]
    second = (
        np.column_stack([two[:, 1], -two[:, 0]]) / area[kept, None]
    )  # slopes of the second and third corners' shares
    third = np.column_stack([-one[:, 1], one[:, 0]]) / area[kept, None]
    slope = (near[kept, 1] - near[kept, 0])[:, None] * second + (near[kept, 2] - near[kept, 0])[:, None] * third
    which, step = _counted(rows)
    row = top[kept][which] + step
    dy = row + 0.5 - start[which, 1]
    least, most = np.full(len(which), -0.5), np.full(len(which), width - 0.5)
    b, c = second[which, 1] * dy, third[which, 1] * dy  # of each row, where x is that of the first corner
    for value, rise in ((b, second[which, 0]), (c, third[which, 0]), (1 - b - c, -(second + third)[which, 0])):
        with np.errstate(divide="ignore", invalid="ignore"):  # shares are nowhere negative in a triangle
            end = start[which, 0] - value / rise - 0.5
        least = np.where(rise > 0, np.maximum(least, end), least)
        most = np.where(rise < 0, np.minimum(most, end), np.where((rise == 0) & (value < 0), -1.0, most))
    first = np.ceil(least).astype(np.int64)
    lengths = np.maximum(np.floor(most).astype(np.int64) - first + 1, 0)
    value = near[kept[which], 0] + slope[which, 1] * dy + slope[which, 0] * (first + 0.5 - start[which, 0])
    rise, cell, which = slope[which, 0], row * width + first, kept[which]
    for begin, end in _lots(lengths):
        own, step = _counted(lengths[begin:end])
        own += begin
        cells, values = cell[own] + step, value[own] + rise[own] * step
        np.maximum.at(depth, cells, values)
        best = np.flatnonzero(values == depth[cells])
        number[cells[best]] = which[own[best]]
    return depth, number


def _counted(counts: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """The numbers 0, 1, ... each so often as told, and which time it is."""
    which = np.repeat(np.arange(len(counts)), counts)
    return which, np.arange(len(which)) - (np.cumsum(counts) - counts)[which]


def _lots(counts: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Ranges whose counts are at most `at_once` together, or little more."""
    ends = np.cumsum(counts)
    begin = 0
    while begin < len(counts):
        end = min(int(np.searchsorted(ends, ends[begin] - counts[begin] + PICTURE_STYLE.at_once)) + 1, len(counts))
        yield begin, end
        begin = end


@dataclass(frozen=True, eq=False)
class _Sun:
    """Light from one side: the way to it (3,), and the map of what it meets first."""

    way: Array
    axes: Array
    low: Array
    step: float
    places: int
    height: Array

    @classmethod
    def on(cls, mesh: _Mesh, camera: Camera) -> _Sun:
        back = camera.axes[2]
        turn, rise = np.arctan2(back[1], back[0]) - PICTURE_STYLE.sun[0], PICTURE_STYLE.sun[1]
        way = np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
        right = np.array([-np.sin(turn), np.cos(turn), 0.0])
        axes = np.stack([right, np.cross(way, right), way])
        points, places = mesh.corners @ axes.T, round(PICTURE_STYLE.shadow_map * max(camera.size)) + 16
        low = points.min(axis=0)[:2]
        step = float((points.max(axis=0)[:2] - low).max()) / (places - 8) or 1.0
        low = low - 4 * step
        height, _ = _nearest(((points[:, :2] - low) / step)[mesh.faces], points[:, 2][mesh.faces], (places, places))
        return cls(way, axes, low, step, places, height)

    def lit(self, points: Array) -> Array:
        """Share of the sun that reaches points (k, 3), 0 to 1."""
        x, y, z = self.axes @ points.T
        column, row = (
            np.floor((one - at) / self.step).astype(np.int64) for one, at in zip((x, y), self.low, strict=True)
        )
        found = np.zeros(len(points), dtype=np.float32)
        for i in PICTURE_STYLE.shadow_blur:
            for j in PICTURE_STYLE.shadow_blur:
                inside = (row + i >= 0) & (row + i < self.places) & (column + j >= 0) & (column + j < self.places)
                cell = np.where(inside, (row + i) * self.places + column + j, 0)
                found += ~(inside & (self.height[cell] > z + self.step))
        return np.asarray(found / len(PICTURE_STYLE.shadow_blur) ** 2)


def _lay(picture: NDArray[np.float32], floor: Floor, camera: Camera, sun: _Sun | None) -> None:
    """The floor, with the shadows on it, into an empty picture."""
    below = np.flatnonzero(camera.rays(np.arange(len(picture)))[:, 2] * (floor.height - camera.eye[2]) > 0)
    ray = camera.rays(below)
    place = camera.eye + ray * ((floor.height - camera.eye[2]) / ray[:, 2])[:, None]
    fade = 1.35 - 1.35 * np.linalg.norm(place[:, :2] - floor.middle, axis=1) / floor.radius
    near = np.flatnonzero(fade > 0)
    place, (column, row) = place[near], np.divmod(below[near], camera.size[0])[::-1]
    edge = np.minimum(np.minimum(row, camera.size[1] - 1 - row), np.minimum(column, camera.size[0] - 1 - column))
    fade = np.minimum(fade[near], 1.0) * np.minimum(edge / (PICTURE_STYLE.fading * min(camera.size)), 1.0)
    lines = np.abs((place[:, :2] / floor.grid + 0.5) % 1.0 - 0.5).min(axis=1) < 0.011
    tone = (0.965 - 0.1 * lines) * (1.0 if sun is None else 0.8 + 0.2 * sun.lit(place))
    picture[below[near]] = (1 - fade * (1 - tone))[:, None]


def _shaded(mesh: _Mesh, faces: NDArray[np.intp], ray: Array, camera: Camera, sun: _Sun | None) -> Array:
    """Colours of triangles (k,) of a mesh where rays from the eye (k, 3) meet them. Shape (k, 3)."""
    a, b, c = (mesh.corners[mesh.faces[:, k]] for k in range(3))
    one, two, to = b - a, c - a, camera.eye - a
    # shares of the second and of the third corner (Moeller, Trumbore 1997)
    across, beside, normal = np.cross(to, one), np.cross(two, to), np.cross(one, two)
    whole = _dot(ray, normal[faces])
    whole = -np.where(np.abs(whole) > 1e-30, whole, 1e-30)
    u, v = _dot(ray, beside[faces]) / whole, _dot(ray, across[faces]) / whole
    u, v = np.clip(u, 0, 1)[:, None], np.clip(v, 0, 1)[:, None]
    place = a[faces] + u * one[faces] + v * two[faces]
    first, second, third = (mesh.normals[mesh.faces[faces, k]] for k in range(3))
    normal = first + u * (second - first) + v * (third - first)
    normal /= np.maximum(np.sqrt(_dot(normal, normal)), 1e-12)[:, None]
    back = -ray / np.sqrt(_dot(ray, ray))[:, None]
    facing = _dot(normal, back)
    normal *= np.where(facing < 0, -1.0, 1.0)[:, None]
    way = camera.axes[2] if sun is None else sun.way
    reaches = (
        1.0
        if sun is None
        else sun.lit(place + PICTURE_STYLE.shadow_bias * sun.step * np.sign(normal @ way)[:, None] * normal)
    )
    key = np.maximum(normal @ way, 0.0)
    gloss = np.maximum(2 * key * np.abs(facing) - back @ way, 0.0)
    light = 0.44 + 0.1 * normal[:, 2] + 0.44 * key * reaches + 0.12 * np.abs(facing)
    return np.asarray(mesh.colors[faces] * light[:, None] + (0.12 * reaches * gloss**24)[:, None])


def _dot(one: Array, other: Array) -> Array:
    return np.asarray(np.einsum("ij,ij->i", one, other))
