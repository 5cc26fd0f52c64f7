"""Pictures of surfaces: what is seen is what rays from the eye meet first, where cameras, shadows and veils say."""

from __future__ import annotations

import io

import numpy as np
import pytest
from matplotlib.image import imread

from models.checks import Array
from ocp import ProblemError
from ocp.app.view.appearance import Part, part_of
from ocp.app.view.rendering import PICTURE_STYLE, Camera, Floor, Layer, encode_png, render, tube

RNG = np.random.default_rng(17)
PURE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def ball(radius: float, color: tuple[float, float, float] = (0.5, 0.5, 0.5), sides: int = 60) -> Part:
    v, u = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, sides), np.linspace(0, 2 * np.pi, 2 * sides), indexing="ij")
    points = radius * np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], axis=-1)
    i, j = (one.ravel() for one in np.meshgrid(np.arange(sides - 1), np.arange(2 * sides - 1), indexing="ij"))
    a = i * 2 * sides + j
    faces = np.concatenate(
        [np.stack([a, a + 1, a + 2 * sides], 1), np.stack([a + 1, a + 2 * sides + 1, a + 2 * sides], 1)]
    )
    return part_of("", points.reshape(-1, 3), faces, (*color, 1.0))


def plate(size: float, height: float) -> Part:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size / 2
    points = np.column_stack([corners, np.full(4, height)])
    return part_of("", points, np.array([[0, 1, 2], [0, 2, 3]]), (0.5, 0.5, 0.5, 1.0))


@pytest.mark.parametrize("seed", range(20))
def test_the_nearest_camera_sees_all_points_and_no_nearer_one_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(30, 3)) * rng.uniform(0.1, 3.0, size=3)
    size = tuple(rng.integers(50, 400, size=2).tolist())
    camera = Camera.around(points, size, rng.uniform(-80, 80), rng.uniform(-180, 180), room=0.05)
    places, far = camera.seen(points)
    assert (far > 0).all()
    share = places / size
    assert (share > 0.05 - 1e-9).all()
    assert (share < 0.95 + 1e-9).all()
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)
    nearer = camera._replace(eye=camera.eye - 1e-6 * camera.axes[2])
    share = nearer.seen(points)[0] / size
    assert not ((share > 0.05) & (share < 0.95)).all()


@pytest.mark.parametrize("seed", range(2))
def test_visible_surfaces_are_the_first_along_rays_from_the_eye(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1, 1, size=(40, 3, 3))
    tint = rng.integers(0, 3, size=40)
    parts = [
        part_of("", triangle, np.array([[0, 1, 2]]), (*PURE[color], 1.0))
        for triangle, color in zip(corners, tint, strict=True)
    ]
    camera = Camera.around(corners, (36, 27), 30.0, -40.0)
    picture = render([Layer(parts)], camera, side_samples=1).astype(int)
    # by the plane of each triangle and the sides on which the corners' cross products lie, ray by ray
    hit = np.full((27, 36), -1)
    for row in range(27):
        for column in range(36):
            ray = camera.rays(np.array([row * 36 + column]))[0]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            depth = ((corners[:, 0] - camera.eye) * normal).sum(axis=1) / (normal @ ray)
            place = camera.eye + depth[:, None] * ray
            sides = [
                (np.cross(corners[:, (k + 1) % 3] - corners[:, k], place - corners[:, k]) * normal).sum(axis=1)
                for k in range(3)
            ]
            inside = (np.min(sides, axis=0) >= 0) & (depth > 0)
            if inside.any():
                hit[row, column] = np.where(inside, depth, np.inf).argmin()
    white = (picture == 255).all(axis=2)
    np.testing.assert_array_equal(white, hit < 0)
    np.testing.assert_array_equal(picture.argmax(axis=2)[~white], tint[hit[~white]])


def test_a_ball_covers_the_disc_that_perspective_says() -> None:
    camera = Camera.around(np.zeros((1, 3)), (300, 300), 25.0, 40.0)
    distance = 3.0
    camera = camera._replace(eye=distance * camera.axes[2])
    picture = render([Layer([ball(0.5)])], camera)
    covered = (picture < 250).any(axis=2).sum()
    radius = PICTURE_STYLE.lens * 150 * 0.5 / np.sqrt(distance**2 - 0.5**2)
    assert covered == pytest.approx(np.pi * radius**2, rel=0.01)


def test_the_shadow_of_a_plate_lies_where_the_sun_puts_it() -> None:
    floor, size, height = Floor(0.0, (0.0, 0.0), 30.0, 1e-4), 0.6, 0.8
    camera = Camera.around(
        np.array([[-1.5, -1.5, 0], [1.5, 1.5, 1.0], [-1.5, 1.5, 0], [1.5, -1.5, 0]]), (240, 200), 60.0
    )
    picture = render([Layer([plate(size, height)])], camera, floor=floor).astype(float).mean(axis=2)
    turn, rise = np.deg2rad(-58.0) - PICTURE_STYLE.sun[0], PICTURE_STYLE.sun[1]
    shift = -height / np.tan(rise) * np.array([np.cos(turn), np.sin(turn)])

    def tone(x: float, y: float) -> float:
        column, row = camera.seen([x, y, 0.0])[0]
        return float(picture[int(row), int(column)])

    for x in (-0.2, 0.0, 0.2):
        for y in (-0.2, 0.0, 0.2):
            assert tone(x + shift[0], y + shift[1]) < 210
    checked = 0
    for path in range(8):
        spot = np.append(shift + 0.55 * np.array([np.cos(path * np.pi / 4), np.sin(path * np.pi / 4)]), 0.0)
        ray = spot - camera.eye
        through = camera.eye + ray * (height - camera.eye[2]) / ray[2]
        if np.abs(through[:2]).max() > 0.6 * size:  # not behind the plate
            assert tone(*spot[:2]) > 235
            checked += 1
    assert checked > 4


def test_shading_is_that_of_the_smooth_surface_which_triangles_stand_for() -> None:
    camera = Camera.around(ball(0.5).vertices, (120, 120))
    coarse, fine = (
        render([Layer([]), Layer([ball(0.5, sides=sides)], 0.999)], camera, side_samples=1) for sides in (16, 120)
    )
    row, column = np.mgrid[:120, :120] - 59.5
    inner = np.hypot(row, column) < 45
    assert np.abs(coarse.astype(int) - fine)[inner].max() <= 4
    assert np.ptp(fine[inner].astype(int)) > 60


def test_transparent_layers_blend_by_their_opacity_and_never_cover_solid_ones() -> None:
    veil, solid = ball(0.5, sides=20), ball(0.2, (1.0, 0.0, 0.0), sides=20)
    camera = Camera.around(veil.vertices, (80, 80))
    thin, thick = (255.0 - render([Layer([]), Layer([veil], share)], camera, side_samples=1) for share in (0.2, 0.6))
    np.testing.assert_allclose(3 * thin, thick, atol=2.1)  # rounded to whole numbers
    alone = render([Layer([solid])], camera, side_samples=1)
    both = render([Layer([solid]), Layer([veil], 0.5, (0.0, 0.0, 1.0))], camera, side_samples=1)
    inside = alone[..., 1] < 200
    assert inside.sum() > 100
    np.testing.assert_array_equal(both[inside], alone[inside])


def test_pictures_do_not_change_with_the_order_of_parts() -> None:
    parts = [ball(0.3, PURE[0], 12), plate(1.0, 0.05), ball(0.2, PURE[1], 12)]
    camera = Camera.around(np.vstack([part.vertices for part in parts]), (60, 60))
    one, other = (render([Layer(some)], camera) for some in (parts, parts[::-1]))
    assert np.abs(one.astype(int) - other).max() <= 1


@pytest.mark.parametrize("closed", [False, True])
def test_a_tube_keeps_its_radius_from_its_line_all_along(closed: bool) -> None:
    s = np.linspace(0, 2 * np.pi, 200)
    line: Array = np.stack([np.cos(s), np.sin(s), 0.2 * np.sin(3 * s) if closed else 0.3 * s], axis=1)
    result = tube(line, 0.01, PURE[2])
    far = np.linalg.norm(result.vertices[:, None] - line[None], axis=2).min(axis=1)
    np.testing.assert_allclose(far, 0.01, rtol=1e-6)
    corners = result.vertices[result.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    assert area == pytest.approx(2 * 10 * np.sin(np.pi / 10) * 0.01 * length, rel=1e-3)  # of ten sides
    assert np.isfinite(tube(np.zeros((3, 3)), 0.01, PURE[0]).vertices).all()  # a tip that stands still


@pytest.mark.parametrize("size", [(0, 10), (10, 0), (5000, 5000)])
def test_pictures_of_no_or_of_vast_size_are_refused(size: tuple[int, int]) -> None:
    with pytest.raises(ProblemError, match="pixels") as refused:
        Camera.around(np.zeros((1, 3)), size)
    assert refused.value.name == "size"


@pytest.mark.parametrize("shape", [(1, 1, 3), (7, 5, 3), (64, 96, 3)])
def test_a_written_picture_is_read_back_by_another_library(shape: tuple[int, ...]) -> None:
    picture = RNG.integers(0, 256, size=shape, dtype=np.uint8)
    read = imread(io.BytesIO(encode_png(picture)), format="png")
    np.testing.assert_array_equal(np.round(255 * read), picture)
