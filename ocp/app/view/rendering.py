"""Render surfaces with a z-buffer in numpy, without a display, a graphics card or a system library.

The nearest triangle at each sample of the picture is visible (Catmull 1974). It is shaded with interpolated normals
(Phong 1975) by light from the sky, a lamp at the eye and a sun, whose shadows come from a depth map (Williams 1978).
Each pixel is the mean of several samples.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.checks import Array
from ocp.app.view.appearance import Appearance, Frames, Part
from ocp.errors import ProblemError


@dataclass(frozen=True)
class PictureStyle:
    """Style of rendered pictures and of plotted curves.

    Attributes:
        size, max_pixels: Size of a rendered picture, and its largest number of pixels.
        half_field_of_view: Half of the vertical field of view, rad.
        side_samples: Samples along each side of a pixel.
        batch_size: Samples that are processed together: their arrays fit into the cache of a processor.
        fading: Fraction of the smaller side of a picture within which the floor fades towards the edge.
        sun: Azimuth to the left of the camera's, and elevation, rad.
        shadow_map: Samples along each side of the shadow map, relative to the pixels along the picture's longer side.
        shadow_blur: Offsets around a sample of the shadow map that are averaged.
        shadow_bias: Distance from a surface at which its shadow is looked up, in samples of the map.
        behind: Distance from a solid surface, relative to the depth, below which a transparent one is behind it.
        tube_sides, line: Number of sides of a round line, and its radius relative to the size of the scene.
        poses: Number of times at which the robot is shown.
        curve_points: Number of points of a curve.
        limit_distance: Limits farther from a curve than this many of its ranges are given in words.
        flat: Change of a curve, relative to the largest value of its quantity, below which it is a rounding error.
        width, columns: Width of a figure, inches, and number of columns in a figure of a solution.
        entries: Largest number of states and controls in a figure of a solution.
    """

    size: tuple[int, int] = (960, 680)
    max_pixels: int = 2**24
    half_field_of_view: float = 0.22
    side_samples: int = 2
    batch_size: int = 2**16
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
    limit_distance: float = 1.5
    flat: float = 1e-3
    width: float = 7.4
    columns: int = 3
    entries: int = 60

    @property
    def lens(self) -> float:
        """Focal length of the camera in units of half the picture's height."""
        return float(1 / np.tan(self.half_field_of_view))


PICTURE_STYLE = PictureStyle()


class Camera(NamedTuple):
    """A perspective camera.

    Attributes:
        eye: Position in world. Shape (3,), m.
        axes: Unit vectors to the right, up and back towards the eye, as rows, in world. Shape (3, 3).
        size: Width and height of the picture, pixels.
    """

    eye: Array
    axes: Array
    size: tuple[int, int]

    @classmethod
    def around(
        cls, points: Any, size: tuple[int, int], elevation: float = 22.0, azimuth: float = -58.0, *, room: float = 0.04
    ) -> Camera:
        """Return the camera nearest to points (k, 3), m, that sees them all in a given direction (angles in degrees).

        Each edge of the picture is a plane through the eye with all points on its inner side, which gives the position
        in closed form. `room` is the margin at every edge, relative to the picture.
        """
        max_pixels, lens = PICTURE_STYLE.max_pixels, PICTURE_STYLE.lens
        if min(size) < 1 or size[0] * size[1] > max_pixels:
            text = f"a picture of {size[0]} by {size[1]} pixels: from 1 to {max_pixels} in all"
            raise ProblemError(text, name="size", value=size, limit=max_pixels)
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
        """Project points (..., 3); return their pixels (..., 2), from the upper left corner, and their depths, m."""
        x, y, z = np.moveaxis((np.asarray(points, dtype=float) - self.eye) @ self.axes.T, -1, 0)
        depth = np.maximum(-z, 1e-9)
        width, height = self.size
        scale = PICTURE_STYLE.lens * height / 2 / depth
        return np.stack([width / 2 + scale * x, height / 2 - scale * y], axis=-1), depth

    def rays(self, cells: NDArray[np.intp]) -> Array:
        """Return vectors from the eye to a depth of 1 m through pixels numbered row by row. Shape (k, 3), m."""
        width, height = self.size
        row, column = np.divmod(cells.astype(np.int32), np.int32(width))  # single precision is enough for pictures
        step = np.float32(2 / (PICTURE_STYLE.lens * height))
        x, y = (column - np.float32(width / 2 - 0.5)) * step, (np.float32(height / 2 - 0.5) - row) * step
        right, up, back = self.axes.astype(np.float32)
        return np.stack([x * right[k] + (y * up[k] - back[k]) for k in range(3)], axis=1)


class Layer(NamedTuple):
    """Surfaces in the world frame that are rendered together.

    Attributes:
        parts: Surfaces to render.
        opacity: Below 1 the layer is transparent: only its nearest surface is visible, it casts no shadow, it never
            covers solid surfaces of the first layer, and layers are blended in the given order.
        tint: Red, green and blue that replace the colours of the parts.
    """

    parts: Sequence[Part]
    opacity: float = 1.0
    tint: tuple[float, float, float] | None = None


class Floor(NamedTuple):
    """Level ground with a square grid: height, middle (x, y), radius at which it fades out, and grid spacing, all m."""

    height: float
    middle: tuple[float, float]
    radius: float
    grid: float


def parts_in_world(appearance: Appearance, frames: Frames, k: int) -> list[Part]:
    """Return the surfaces of a robot in the world frame at the sample of index `k` of a motion."""
    parts = []
    for part in appearance.parts:
        rotation, position = frames.rotations[part.link][k], frames.positions[part.link][k]
        parts.append(replace(part, vertices=part.vertices @ rotation.T + position, normals=part.normals @ rotation.T))
    return parts


def tube(points: Any, radius: float, color: tuple[float, float, float]) -> Part:
    """Return the surface of a tube of given radius (m) and colour around the polyline through points (k, 3), m."""
    line = np.asarray(points, dtype=float)
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-9 * max(float(np.ptp(line, axis=0).max()), 1e-12)
    line = line[np.append(True, steps)]
    if len(line) < 2:
        line = line[:1] + np.array([[-1e-6, 0, 0], [1e-6, 0, 0]])
    tangents = np.gradient(line, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1), 1e-12)[:, None]
    side = np.cross(tangents[0], np.eye(3)[int(np.abs(tangents[0]).argmin())])
    sides = np.empty_like(line)
    for k, tangent in enumerate(tangents):  # parallel transport
        side = side - tangent * (tangent @ side)
        side /= np.linalg.norm(side)
        sides[k] = side
    count = PICTURE_STYLE.tube_sides
    angle = np.arange(count)[:, None] * (2 * np.pi / count)
    offsets = np.cos(angle) * sides[:, None] + np.sin(angle) * np.cross(tangents, sides)[:, None]
    corners = np.arange(len(line) * count).reshape(-1, count)
    a, b = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    inner = a < a.size - count
    a, b = a[inner], b[inner]
    faces = np.concatenate([np.stack([a, b, b + count], axis=1), np.stack([a, b + count, a + count], axis=1)])
    return Part("", (line[:, None] + radius * offsets).reshape(-1, 3), offsets.reshape(-1, 3), faces, (*color, 1.0))


def render(
    layers: Sequence[Layer],
    camera: Camera,
    *,
    floor: Floor | None = None,
    side_samples: int = PICTURE_STYLE.side_samples,
) -> NDArray[np.uint8]:
    """Render layers of surfaces on a white background and return the picture. Shape (height, width, 3).

    Each pixel is the mean of `side_samples` squared samples.
    """
    width, height = camera.size
    fine = camera._replace(size=(side_samples * width, side_samples * height))
    solid = _Mesh.of([part for layer in layers if layer.opacity >= 1 for part in layer.parts if part.color[3] >= 1])
    sun = _Sun.on(solid, camera) if len(solid.faces) else None
    picture = np.ones((fine.size[0] * fine.size[1], 3), dtype=np.float32)
    nearness, faces = _nearest(*_project(fine, solid), fine.size)
    if floor is not None:
        for cells in _blocks(np.flatnonzero(faces < 0)):
            _draw_floor(picture, floor, fine, sun, cells)
    first = sum(len(part.faces) for part in layers[0].parts if part.color[3] >= 1) if layers else 0
    cells = np.flatnonzero(faces >= 0)
    _shade(picture, solid, faces, cells, fine, sun=sun)
    nearness[cells[faces[cells] < first]] = np.inf
    for layer in layers:
        for opacity in sorted({part.color[3] for part in layer.parts}, reverse=True):
            if opacity >= 1 and layer.opacity >= 1:
                continue
            veil = _Mesh.of([part for part in layer.parts if part.color[3] == opacity], layer.tint)
            near, faces = _nearest(*_project(fine, veil), fine.size)
            cells = np.flatnonzero(faces >= 0)
            cells = cells[near[cells] > (1 + PICTURE_STYLE.behind) * nearness[cells]]
            _shade(picture, veil, faces, cells, fine, alpha=layer.opacity * opacity)
    samples, sides = picture.reshape(height, side_samples, width, side_samples, 3), range(side_samples)
    pixels = sum(samples[:, i, :, j] for i in sides for j in sides) / np.float32(side_samples**2)
    return np.asarray(np.round(255 * np.clip(pixels, 0.0, 1.0)), dtype=np.uint8)


def encode_png(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture (height, width, 3) as a PNG file, whose rows are stored as differences from the row above."""
    height, width, _ = picture.shape
    rows = np.full((height, 1 + 3 * width), 2, dtype=np.uint8)  # the filter "up" of the PNG specification
    rows[:, 1:] = np.diff(picture.reshape(height, -1), axis=0, prepend=np.zeros((1, 3 * width), dtype=np.uint8))
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)  # 8 bits, red green blue
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(rows.tobytes(), 6)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )


@dataclass(frozen=True, eq=False)
class _Mesh:
    """Triangles in the world: corners and normals (n, 3), corner indices of faces (f, 3), and face colours (f, 3)."""

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


def _project(camera: Camera, mesh: _Mesh) -> tuple[Array, Array]:
    """Project the corners of all triangles; return their picture positions (f, 3, 2) and inverse depths (f, 3)."""
    positions, depths = camera.seen(mesh.corners)
    return positions[mesh.faces], (1.0 / depths)[mesh.faces]


def _nearest(places: Array, near: Array, size: tuple[int, int]) -> tuple[Array, NDArray[np.intp]]:
    """Return inverse depth and index of the nearest triangle at each pixel centre; -inf and -1 where there is none.

    `places` (f, 3, 2) has the corners of the triangles in pixels from the upper left, `near` (f, 3) their inverse
    depths, which are linear over a triangle. Pixels are numbered row by row.
    """
    width, height = size
    depth, number = np.full(height * width, -np.inf), np.full(height * width, -1, dtype=np.intp)
    ab, ac = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    top = np.clip(np.ceil(places[..., 1].min(axis=1) - 0.5), 0, height).astype(np.int64)
    rows = np.clip(np.floor(places[..., 1].max(axis=1) - 0.5) + 1, 0, height).astype(np.int64) - top
    valid = np.flatnonzero((rows > 0) & (np.abs(area) > 1e-12) & (near < 1e8).all(axis=1))
    ab, ac, start, rows = ab[valid], ac[valid], places[valid, 0], rows[valid]
    # gradients of the barycentric coordinates of the second and third corners
    second = np.column_stack([ac[:, 1], -ac[:, 0]]) / area[valid, None]
    third = np.column_stack([-ab[:, 1], ab[:, 0]]) / area[valid, None]
    fourth = -(second + third)[:, 0]
    slope = (near[valid, 1] - near[valid, 0])[:, None] * second + (near[valid, 2] - near[valid, 0])[:, None] * third
    for first_face, last_face in _batches(rows):
        which, step = _repeat_numbers(rows[first_face:last_face])
        which += first_face
        row = top[valid[which]] + step
        dy = row + 0.5 - start[which, 1]
        least, most = np.full(len(which), -0.5), np.full(len(which), width - 0.5)
        b, c = second[which, 1] * dy, third[which, 1] * dy  # in each row, at the x of the first corner
        for value, rise in ((b, second[which, 0]), (c, third[which, 0]), (1 - b - c, fourth[which])):
            with np.errstate(divide="ignore", invalid="ignore"):  # barycentric coordinates are not negative
                end = start[which, 0] - value / rise - 0.5
            least = np.where(rise > 0, np.maximum(least, end), least)
            most = np.where(rise < 0, np.minimum(most, end), np.where((rise == 0) & (value < 0), -1.0, most))
        first = np.ceil(least).astype(np.int64)
        lengths = np.maximum(np.floor(most).astype(np.int64) - first + 1, 0)
        value = near[valid[which], 0] + slope[which, 1] * dy + slope[which, 0] * (first + 0.5 - start[which, 0])
        rise, cell, which = slope[which, 0], row * width + first, valid[which]
        for begin, end in _batches(lengths):
            own, step = _repeat_numbers(lengths[begin:end])
            own += begin
            cells, values = cell[own] + step, value[own] + rise[own] * step
            np.maximum.at(depth, cells, values)
            best = np.flatnonzero(values == depth[cells])
            number[cells[best]] = which[own[best]]
    return depth, number


def _repeat_numbers(counts: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Repeat each number i = 0, 1, ... `counts[i]` times; return the numbers and the index of each repetition."""
    which = np.repeat(np.arange(len(counts)), counts)
    return which, np.arange(len(which)) - (np.cumsum(counts) - counts)[which]


def _batches(counts: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Yield ranges (first, last + 1) of consecutive items whose counts sum to about `batch_size`."""
    ends = np.cumsum(counts)
    begin = 0
    while begin < len(counts):
        end = min(int(np.searchsorted(ends, ends[begin] - counts[begin] + PICTURE_STYLE.batch_size)) + 1, len(counts))
        yield begin, end
        begin = end


def _blocks(cells: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Split the indices of picture samples into blocks of at most `batch_size` indices."""
    return np.array_split(cells, len(cells) // PICTURE_STYLE.batch_size + 1)


@dataclass(frozen=True, eq=False)
class _Sun:
    """Directional light of a scene (the sun), with a depth map of the surfaces that its light meets first."""

    to_sun: Array
    axes: Array
    low: Array
    step: float
    places: int
    height: Array

    @classmethod
    def on(cls, mesh: _Mesh, camera: Camera) -> _Sun:
        """Return the sun of a scene, whose direction is relative to the camera, with the depth map for its shadows."""
        back = camera.axes[2]
        azimuth, elevation = np.arctan2(back[1], back[0]) - PICTURE_STYLE.sun[0], PICTURE_STYLE.sun[1]
        to_sun = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        axes = np.stack([right, np.cross(to_sun, right), to_sun])
        points, places = mesh.corners @ axes.T, round(PICTURE_STYLE.shadow_map * max(camera.size)) + 16
        low = points.min(axis=0)[:2]
        margin = max(PICTURE_STYLE.shadow_blur) + 4  # empty, so that no point beyond the map is in a shadow
        step = float((points.max(axis=0)[:2] - low).max()) / (places - 2 * margin) or 1.0
        low = low - margin * step
        height, _ = _nearest(((points[:, :2] - low) / step)[mesh.faces], points[:, 2][mesh.faces], (places, places))
        return cls(to_sun, axes, low, step, places, height.astype(np.float32))

    def lit(self, points: Array) -> Array:
        """Return the fraction of direct light that reaches points (k, 3), from 0 (shadow) to 1."""
        blur = PICTURE_STYLE.shadow_blur
        x, y, z = (points @ self.axes.T.astype(points.dtype)).T
        column, row = (
            np.clip((coordinate - corner) / self.step, max(blur), self.places - 1 - max(blur)).astype(np.int32)
            for coordinate, corner in zip((x, y), self.low.tolist(), strict=True)
        )
        cell, top = row * np.int32(self.places) + column, z + np.float32(self.step)
        share = np.zeros(len(points), dtype=np.uint8)
        for offset in (i * self.places + j for i in blur for j in blur):
            share += self.height[cell + np.int32(offset)] <= top
        return np.asarray(share / np.float32(len(blur) ** 2))


def _draw_floor(
    picture: NDArray[np.float32], floor: Floor, camera: Camera, sun: _Sun | None, bare: NDArray[np.intp]
) -> None:
    """Draw the floor and the shadows on it at those samples of a picture, `bare`, that no surface covers."""
    ray, eye = camera.rays(bare), camera.eye.astype(np.float32)
    depth = np.float32(floor.height - camera.eye[2]) / ray[:, 2]
    x, y = (eye[k] + depth * ray[:, k] for k in range(2))
    squares = (x - np.float32(floor.middle[0])) ** 2 + (y - np.float32(floor.middle[1])) ** 2
    near = np.flatnonzero((depth > 0) & (squares < np.float32(floor.radius**2)))
    x, y, cells = x[near], y[near], bare[near]
    row, column = np.divmod(cells.astype(np.int32), np.int32(camera.size[0]))
    edge = np.minimum(np.minimum(row, camera.size[1] - 1 - row), np.minimum(column, camera.size[0] - 1 - column))
    margin = np.float32(PICTURE_STYLE.fading * min(camera.size))
    fade = np.float32(1.35) * (1 - np.sqrt(squares[near]) / np.float32(floor.radius))
    fade = np.minimum(fade, 1) * np.minimum(edge / margin, 1)
    grid = np.float32(1 / floor.grid)
    is_line = np.minimum(*(np.abs(place - np.rint(place)) for place in (grid * x, grid * y))) < 0.011
    tone = np.where(is_line, np.float32(0.865), np.float32(0.965))
    if sun is not None:
        place = np.stack([x, y, np.full_like(x, floor.height)], axis=1)
        tone *= np.float32(0.8) + np.float32(0.2) * sun.lit(place)
    picture[cells] = (1 - fade * (1 - tone))[:, None]


def _shade(
    picture: NDArray[np.float32],
    mesh: _Mesh,
    faces: NDArray[np.intp],
    cells: NDArray[np.intp],
    camera: Camera,
    *,
    sun: _Sun | None = None,
    alpha: float = 1.0,
) -> None:
    """Blend the colours of the triangles that are nearest at given samples into a picture (M, 3).

    `faces` (M,) has the index of the nearest triangle at each sample, and `cells` the numbers of the samples to draw.
    Without a sun the light comes from the camera and there are no shadows. `alpha` is the opacity of the triangles.
    """
    a, b, c = (mesh.corners[mesh.faces[:, k]] for k in range(3))
    sides = b - a, c - a, camera.eye - a
    ab, ac, to, origin = (each.astype(np.float32) for each in (*sides, a))
    # barycentric coordinates of the second and third corners (Moeller, Trumbore 1997)
    across, beside, flat_normals = np.cross(to, ab), np.cross(ac, to), np.cross(ab, ac)
    normals, colors = mesh.normals.astype(np.float32), mesh.colors.astype(np.float32)
    to_light = (camera.axes[2] if sun is None else sun.to_sun).astype(np.float32)
    opacity = np.float32(alpha)
    for block in _blocks(cells):
        face, ray = faces[block], camera.rays(block)
        whole = _dot(ray, flat_normals[face])
        whole = -np.where(np.abs(whole) > 1e-30, whole, 1e-30)
        u, v = _dot(ray, beside[face]) / whole, _dot(ray, across[face]) / whole
        u, v = np.clip(u, 0, 1)[:, None], np.clip(v, 0, 1)[:, None]
        first, second, third = (normals[mesh.faces[face, k]] for k in range(3))
        normal = first + u * (second - first) + v * (third - first)
        normal /= np.maximum(np.sqrt(_dot(normal, normal)), 1e-12)[:, None]
        back = -ray / np.sqrt(_dot(ray, ray))[:, None]
        facing = _dot(normal, back)
        normal *= np.where(facing < 0, -1.0, 1.0)[:, None]
        incidence = normal @ to_light
        reaches: Any = 1.0
        if sun is not None:
            place = origin[face] + u * ab[face] + v * ac[face]
            bias = np.float32(PICTURE_STYLE.shadow_bias * sun.step)
            reaches = sun.lit(place + bias * np.sign(incidence)[:, None] * normal)
        key = np.maximum(incidence, 0.0)
        gloss = np.maximum(2 * key * np.abs(facing) - back @ to_light, 0.0)
        gloss **= 2
        gloss **= 2
        gloss **= 2  # squares take a tenth of the time of other powers
        light = 0.44 + 0.1 * normal[:, 2] + 0.44 * key * reaches + 0.12 * np.abs(facing)
        lit = colors[face] * light[:, None] + (0.12 * reaches * gloss * gloss**2)[:, None]
        picture[block] = (1 - opacity) * picture[block] + opacity * lit if alpha < 1 else lit


def _dot(first: Any, second: Any) -> Any:
    """Return the scalar products of corresponding rows of two arrays."""
    return np.einsum("ij,ij->i", first, second)
