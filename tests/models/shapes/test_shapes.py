"""Shapes as hulls of points, swelled: moved, reached, and the hull of a mesh against that of qhull."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from models import Box, Capsule, Cylinder, HalfSpace, Mesh, Sphere
from models.shapes.hull import convex_hull
from tests.models.shapes.shape_oracles import random_frame, random_shape

KINDS = (Sphere, Capsule, Cylinder, Box, Mesh)
seeds = st.integers(0, 2**32 - 1)


@pytest.mark.parametrize("kind", [*KINDS, HalfSpace], ids=lambda kind: kind.__name__)
def test_a_placed_shape_has_the_moved_core(kind: Any) -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        shape, frame = random_shape(kind, rng), random_frame(rng)
        moved = shape.placed(frame.rotation, frame.position.ravel())
        assert type(moved) is kind
        assert moved.swept_radius == shape.swept_radius
        np.testing.assert_allclose(moved.core, shape.core @ frame.rotation.T + frame.position.ravel(), atol=1e-12)
        if isinstance(shape, HalfSpace):
            np.testing.assert_allclose(moved.normal, frame.rotation @ shape.normal, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_reach_is_the_distance_of_the_farthest_point(kind: type) -> None:
    """Of points drawn over the shape: none is farther, one is nearly as far."""
    rng = np.random.default_rng(2)
    shape, point = random_shape(kind, rng), rng.normal(size=3)
    shares = rng.dirichlet(np.full(len(shape.core), 0.05), 4000)
    away = rng.normal(size=(4000, 3))
    inside = shares @ shape.core + shape.swept_radius * away / np.linalg.norm(away, axis=1, keepdims=True)
    farthest = np.linalg.norm(inside - point, axis=1).max()
    assert farthest <= shape.reach(point) + 1e-9
    assert farthest >= 0.95 * shape.reach(point)


def test_a_mesh_around_a_hull_is_that_of_its_points() -> None:
    points = np.random.default_rng(3).normal(size=(50, 3))
    mesh = Mesh.around(convex_hull(points))
    np.testing.assert_array_equal(mesh.core, Mesh(points).core)
    turn, shift = random_frame(np.random.default_rng(4)).rotation, (1.0, 2.0, 3.0)
    np.testing.assert_array_equal(mesh.placed(turn, shift).core, Mesh(points).placed(turn, shift).core)


def test_the_hull_of_a_finely_meshed_ball_keeps_every_corner_and_holds_all_points() -> None:
    points = np.random.default_rng(5).normal(size=(3000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    hull = convex_hull(points)
    assert len(hull.vertices) == len(points)
    assert (points @ hull.normals.T <= hull.offsets).all()


def test_the_corners_of_a_box_are_listed_along_z_first_then_y_then_x() -> None:
    turn = np.array([(0.0, -1, 0), (1, 0, 0), (0, 0, 1)])
    core = Box((2, 4, 6), (10, 20, 30), turn).core
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-2, 2) for z in (-3, 3)])
    np.testing.assert_allclose(core, corners @ turn.T + (10, 20, 30), atol=1e-12)


def test_unbounded_shapes_have_no_reach() -> None:
    assert HalfSpace((0, 0, 1), (0, 0, 0)).reach((0, 0, 0)) == np.inf
    assert Box((np.inf, 1, 1)).reach((0, 0, 0)) == np.inf
    assert Box((2, 2, 1)).reach((0, 0, 0)) == pytest.approx(1.5)


def test_shapes_keep_their_own_read_only_numbers() -> None:
    start = np.zeros(3)
    rod, wall = Capsule(0.1, start, (0, 0, 1)), HalfSpace((0, 0, 2), (0, 0, 1))
    start[0] = 5
    assert rod.start[0] == 0
    np.testing.assert_array_equal(wall.normal, (0, 0, 1))
    for array in (rod.start, wall.normal, wall.point, Box((1, 1, 1)).size):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def volume(vertices: Any, faces: Any) -> float:
    a, b, c = (vertices[faces[:, k]] - vertices.mean(axis=0) for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def assert_hull(points: Any) -> None:
    hull, known = convex_hull(points), ConvexHull(points)
    size = np.ptp(points)
    assert volume(hull.vertices, hull.faces) == pytest.approx(known.volume, rel=1e-9)
    assert (points @ hull.normals.T <= hull.offsets + 1e-12 * (1 + np.abs(points).max())).all()
    np.testing.assert_allclose(np.linalg.norm(hull.normals, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose((hull.vertices @ hull.normals.T).max(axis=0), hull.offsets, atol=1e-9 * size)
    edges = np.sort(np.concatenate([hull.faces[:, [0, 1]], hull.faces[:, [1, 2]], hull.faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # closed
    assert len(hull.vertices) - len(edges) // 2 + len(hull.faces) == 2  # Euler


@given(seeds, st.integers(4, 60), st.sampled_from([1e-3, 1.0, 1e3]))
@settings(max_examples=60)
def test_the_hull_of_a_cloud_is_that_of_qhull(seed: int, count: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    assert_hull(size * rng.normal(size=(count, 3)) * rng.uniform(0.05, 1, 3) + rng.normal(size=3))


@given(seeds, st.integers(2, 6), st.booleans())
@settings(max_examples=40)
def test_the_hull_of_points_in_common_planes_is_that_of_qhull(seed: int, count: int, turned: bool) -> None:
    """Grids, prisms and their halves, as drawing programs make them: many points on a face, an edge, twice."""
    rng = np.random.default_rng(seed)
    grid = np.array(np.meshgrid(*[np.arange(count)] * 3)).reshape(3, -1).T.astype(float)
    grid = grid[rng.random(len(grid)) < 0.7] if count > 2 else grid
    angles = np.arange(4 * count) * np.pi / (2 * count)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    prism = np.vstack([np.column_stack([r * ring, np.full(len(ring), z)]) for z in (0.0, 1, 2) for r in (1.0, 0.5, 1)])
    turn = random_frame(rng).rotation if turned else np.eye(3)
    for points in (grid, prism):
        assert_hull(points @ turn.T)


def test_a_hull_far_away_is_the_same_hull_moved() -> None:
    """What is flat is so beside the size of the points, not beside how far away they are."""
    rng = np.random.default_rng(6)
    points, shift = rng.normal(size=(60, 3)), np.array([4e5, -3e5, 2e5])
    near, far = convex_hull(points), convex_hull(points + shift)
    np.testing.assert_array_equal(far.faces, near.faces)
    np.testing.assert_allclose(far.vertices - shift, near.vertices, atol=1e-9)
    np.testing.assert_allclose(far.normals, near.normals, atol=1e-9)
    plate = np.vstack([points[:, :2] @ np.eye(2, 3), points[:, :2] @ np.eye(2, 3) + (0, 0, 1e-6)])
    assert np.ptp(convex_hull(plate + 1e4).vertices[:, 2]) == pytest.approx(1e-6, abs=1e-11)


def test_the_faces_of_a_box_and_of_a_drum_are_counted_once() -> None:
    assert len(convex_hull(Box((1, 2, 3), (4, 5, 6)).core).normals) == 6
    assert len(Cylinder(0.3, 1.0, (0, 0, 0)).hull.normals) == 18


CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (9, 9, 9)], dtype=float)
TRIANGLES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]


def test_vertices_of_no_triangle_do_not_count() -> None:
    assert len(Mesh(CORNERS).core) == 5
    assert sorted(map(tuple, Mesh(CORNERS, TRIANGLES).core)) == sorted(map(tuple, CORNERS[:4]))


def test_a_mesh_is_scaled_turned_and_moved_in_this_order() -> None:
    turn = np.array([(0.0, -1, 0), (1, 0, 0), (0, 0, 1)])
    mesh = Mesh(CORNERS[:4], TRIANGLES, (1, 2, 3), turn, scale=(2, 3, -4))
    known = (CORNERS[:4] * (2, 3, -4)) @ turn.T + (1, 2, 3)
    np.testing.assert_allclose(np.sort(mesh.core, axis=0), np.sort(known, axis=0), atol=1e-12)
    assert Mesh(CORNERS[:4], scale=0.5).reach((0, 0, 0)) == pytest.approx(0.5)


def test_a_mesh_is_read_from_its_file(tmp_path: Path) -> None:
    file = tmp_path / "corner.obj"
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in TRIANGLES]
    file.write_text("\n".join(lines), encoding="utf-8")
    for name in (file, str(file)):
        np.testing.assert_array_equal(Mesh(file=name, scale=2).core, Mesh(CORNERS, TRIANGLES, scale=2).core)
