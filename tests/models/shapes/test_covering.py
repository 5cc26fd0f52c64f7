"""Covers of meshes: everything inside, at every cut; the same for a mesh moved or scaled; kept and read back."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy import spatial

from models import ModelError
from models import files as cache
from models.checks import Array
from models.shapes import covering
from models.shapes.bodies import capsule_around
from models.shapes.covering import Cover, cover, exceedance, fit_cover, split_triangles
from models.shapes.hull import convex_hull
from models.shapes.mesh_files import Faces
from models.shapes.shapes import Box, Capsule
from tests.families import some

pytestmark = pytest.mark.xdist_group("covers")  # one process, so that the plate is covered once

ROUNDING = 1e-12


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "selfmotion"


def dumbbell() -> tuple[Array, Faces]:
    """A thin rod between two thick discs: what one capsule covers badly."""
    rod = trimesh.creation.cylinder(radius=0.02, height=0.5, sections=24)
    parts = [rod, *(trimesh.creation.cylinder(radius=0.06, height=0.1, sections=24) for _ in range(2))]
    for part, z in zip(parts[1:], (-0.25, 0.25), strict=True):
        part.apply_translation([0.0, 0.0, z])
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=False)])
    return np.concatenate([part.vertices for part in parts]), faces


def blob(seed: int) -> tuple[Array, Faces]:
    """Random points, joined to random triangles: no closed surface at all."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(40, 3)) * rng.uniform(0.05, 1.0, 3)
    return points, rng.integers(0, 40, (60, 3))


def plate() -> tuple[Array, Faces]:
    mesh = trimesh.creation.box(extents=(0.4, 0.3, 0.02))
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


MESHES = {"dumbbell": dumbbell, "blob": lambda: blob(1), "another blob": lambda: blob(2), "plate": plate}


def volume(covers: tuple[Cover, ...]) -> float:
    """Sum over the shapes, m^3."""
    total = 0.0
    for each in covers:
        if isinstance(each.shape, Box):
            total += float(np.prod(each.shape.size))
        else:
            length = np.linalg.norm(np.subtract(each.shape.end, each.shape.start))
            total += float(np.pi * each.shape.radius**2 * (length + 4 / 3 * each.shape.radius))
    return total


def surface_points(vertices: Array, faces: Faces, count: int = 20_000) -> Array:
    rng = np.random.default_rng(0)
    shares = rng.dirichlet(np.ones(3), count)
    return np.asarray(np.einsum("nk,nkj->nj", shares, vertices[faces[rng.integers(0, len(faces), count)]]))


@pytest.mark.parametrize("mesh", MESHES)
def test_no_point_of_the_surface_is_outside(mesh: str) -> None:
    vertices, faces = MESHES[mesh]()
    covers = fit_cover(vertices[faces])
    for points in (vertices[np.unique(faces)], surface_points(vertices, faces)):
        assert np.min([exceedance(each.shape, points) for each in covers], axis=0).max() <= 0


def test_the_interior_of_a_closed_surface_is_covered() -> None:
    """Also where the surface itself is covered in parts: random points inside the dumbbell's rod and discs."""
    vertices, faces = dumbbell()
    covers = fit_cover(vertices[faces])
    assert len(covers) > 1
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.06, -0.06, -0.3], [0.06, 0.06, 0.3], (40_000, 3))
    across, along = np.hypot(points[:, 0], points[:, 1]), np.abs(points[:, 2])
    solid = (across < 0.019) | ((across < 0.059) & (along > 0.2))
    assert np.min([exceedance(each.shape, points[solid]) for each in covers], axis=0).max() <= 0


def test_parts_cover_less_than_one_capsule() -> None:
    vertices, faces = dumbbell()
    one = capsule_around(0.06, 0.6)[0]
    assert volume(fit_cover(vertices[faces])) < 0.8 * one


def test_a_plate_gets_a_box_of_its_own_size() -> None:
    vertices, faces = plate()
    (only,) = fit_cover(vertices[faces])
    assert isinstance(only.shape, Box)
    np.testing.assert_allclose(np.sort(only.shape.size), [0.02, 0.3, 0.4], rtol=1e-6)
    assert only.overhang < 1e-6


def test_a_capsule_is_covered_by_itself() -> None:
    mesh = trimesh.creation.capsule(radius=0.1, height=0.5, count=[24, 24])
    (only,) = fit_cover(np.asarray(mesh.vertices)[mesh.faces])
    assert isinstance(only.shape, Capsule)
    assert volume((only,)) == pytest.approx(np.pi * 0.01 * (0.5 + 4 / 3 * 0.1), rel=0.01)
    assert only.overhang < 0.003  # the mesh is a polyhedron within the capsule


def test_a_cylinder_is_covered_as_the_closed_form_says() -> None:
    radius, length = 0.05, 0.6
    mesh = trimesh.creation.cylinder(radius=radius, height=length, sections=64)
    covers = fit_cover(np.asarray(mesh.vertices)[mesh.faces])
    assert len(covers) == 1
    assert volume(covers) == pytest.approx(capsule_around(radius, length)[0], rel=0.01)


@pytest.mark.parametrize("mesh", some([*MESHES], ["dumbbell", "plate"]))
def test_the_cover_moves_and_grows_with_the_mesh(mesh: str) -> None:
    vertices, faces = MESHES[mesh]()
    rng = np.random.default_rng(3)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    here, there = fit_cover(vertices[faces]), fit_cover((2.5 * vertices @ turn.T + [1.0, -2.0, 0.5])[faces])
    assert volume(there) == pytest.approx(2.5**3 * volume(here), rel=0.15)
    assert len(there) == len(here)
    scaled = fit_cover((2.0 * vertices)[faces])  # a power of two: the same arithmetic
    assert volume(scaled) == pytest.approx(8 * volume(here), rel=1e-9)
    np.testing.assert_allclose([each.overhang for each in scaled], [2 * each.overhang for each in here], rtol=1e-9)


def test_the_overhang_is_the_farthest_point_from_the_hull() -> None:
    """By an independent way: the distance of many points of the cover from the hull, by trimesh."""
    vertices, faces = blob(4)
    hull = trimesh.convex.convex_hull(vertices[np.unique(faces)])
    for each in fit_cover(vertices[faces]):
        assert isinstance(each.shape, Capsule)
        rng = np.random.default_rng(0)
        around = rng.normal(size=(3000, 3))
        around /= np.linalg.norm(around, axis=1, keepdims=True)
        along = np.subtract(each.shape.end, each.shape.start)
        ends = np.where((around @ along > 0)[:, None], each.shape.end, each.shape.start)
        points = ends + each.shape.radius * around
        equations = spatial.ConvexHull(hull.vertices).equations
        outside = points[(points @ equations[:, :3].T + equations[:, 3]).max(axis=1) > 0]
        _, distances, _ = trimesh.proximity.closest_point_naive(hull, outside)  # type: ignore[no-untyped-call]
        assert each.overhang <= distances.max() + 0.02 * each.shape.radius
        assert each.overhang >= 0.9 * distances.max()


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (3.0, -2.0, 5.0), (-4.0, -4.0, -4.0)])
def test_covers_of_interior_points_stay_within_the_hull(shift: tuple[float, float, float]) -> None:
    """Of capsules from the middle of a cube of 2 m on, one that ends in it, and two beyond a face by 0.1 m and 3 m."""
    cube = convex_hull(np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T + shift)
    for beyond, out in ((0.3, 0.0), (0.8, 0.1), (3.7, 3.0)):
        for axis in np.vstack([np.eye(3), -np.eye(3)]):
            result = covering._overhang(Capsule(0.3, shift, shift + beyond * axis), cube.vertices)
            assert 0.9 * out <= result <= out + 1e-12


@pytest.mark.long
def test_flat_and_tiny_meshes_are_covered() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    point = np.zeros((3, 3))
    for vertices, faces in [(square, [[0, 1, 2], [0, 2, 3]]), (line, [[0, 1, 2]]), (point, [[0, 1, 2]])]:
        for scale in (1.0, 1e-6, 1e3):
            moved = scale * vertices + 5.0
            covers = fit_cover(moved[np.array(faces)])
            assert np.min([exceedance(each.shape, moved) for each in covers], axis=0).max() <= 0


def test_cut_triangles_are_on_their_sides_and_keep_their_area() -> None:
    rng = np.random.default_rng(0)
    triangles = rng.normal(size=(200, 3, 3))
    axis = np.array([0.6, 0.0, 0.8])
    low, high = split_triangles(triangles, axis, 0.1)
    assert (low @ axis).max() <= 0.1 + ROUNDING
    assert (high @ axis).min() >= 0.1 - ROUNDING

    def area(each: Array) -> float:
        return float(np.linalg.norm(np.cross(each[:, 1] - each[:, 0], each[:, 2] - each[:, 0]), axis=1).sum())

    assert area(low) + area(high) == pytest.approx(area(triangles), rel=1e-12)


def test_large_meshes_are_covered_too() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.2)  # 5120 triangles
    mesh.apply_scale([1.0, 1.0, 3.0])
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    covers = fit_cover(vertices[faces])
    assert np.min([exceedance(each.shape, vertices) for each in covers], axis=0).max() <= 0
    assert volume(covers) < 2 * 4 / 3 * np.pi * 0.2**2 * 0.6


def same(one: tuple[Cover, ...], other: tuple[Cover, ...]) -> bool:
    return [covering._to_json(each) for each in one] == [covering._to_json(each) for each in other]


def test_the_cached_cover_is_the_fitted_one(own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = dumbbell()
    first = cover(vertices, faces)
    assert len(list(own_cache.iterdir())) == 1
    assert same(first, fit_cover(vertices[faces]))
    monkeypatch.setattr(covering, "fit_cover", lambda triangles: pytest.fail("fitted again"))
    assert same(cover(vertices, faces), first)
    assert same(cover(vertices.tolist(), faces.tolist()), first)


@functools.cache
def covers_of_plate() -> tuple[Cover, ...]:
    vertices, faces = plate()
    return fit_cover(vertices[faces])


@pytest.mark.parametrize(
    "contents", ["", "{", "null", "[]", '[{"radius": 1}]', "[3]", "[[[[", '{"a": 1}', '[{"radius": "x"}]']
)
def test_a_broken_cache_is_no_error(own_cache: Path, contents: str, monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = plate()
    monkeypatch.setattr(covering, "fit_cover", lambda triangles: covers_of_plate())
    first = cover(vertices, faces)
    (file,) = own_cache.iterdir()
    file.write_text(contents, encoding="utf-8")
    assert same(cover(vertices, faces), first)
    assert json.loads(file.read_text(encoding="utf-8").partition("\n")[2])  # mended


def test_a_cover_that_does_not_hold_the_mesh_is_not_taken(own_cache: Path) -> None:
    vertices, faces = dumbbell()
    first = cover(vertices, faces)
    (file,) = own_cache.iterdir()
    cache.store_value(file.stem, [each | {"radius": 0.9 * each["radius"]} for each in cache.load_value(file.stem)])
    assert same(cover(vertices, faces), first)


def test_an_unwritable_cache_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("", encoding="utf-8")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    vertices, faces = plate()
    assert len(cover(vertices, faces)) == 1
    monkeypatch.setattr(Path, "expanduser", lambda self: (_ for _ in ()).throw(RuntimeError("no home")))
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert len(cover(vertices, faces)) == 1


def test_a_failed_write_leaves_no_file(own_cache: Path) -> None:
    cache.store_value("a", {"x": [1.5, "y"]})
    assert cache.load_value("a") == {"x": [1.5, "y"]}
    (own_cache / "b.json").mkdir()
    cache.store_value("b", 1)
    assert cache.load_value("b") is None
    assert sorted(file.name for file in own_cache.iterdir()) == ["a.json", "b.json"]


def test_keys_tell_contents_and_versions_apart() -> None:
    one = np.arange(6.0)
    keys = {
        cache.cache_key("1", one),
        cache.cache_key("2", one),
        cache.cache_key("1", one.reshape(2, 3)),
        cache.cache_key("1", one + 1),
    }
    assert len(keys) == 4
    assert cache.cache_key("1", one) == cache.cache_key("1", one.copy()[::1])


def test_a_version_changes_with_a_module_and_all_that_it_imports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once, by way of another, or within a function; not with what it does not import."""
    monkeypatch.syspath_prepend(str(tmp_path))
    package = tmp_path / "whole"
    package.mkdir()
    texts = {
        "__init__": "",
        "a": "from whole.b import x",
        "b": "def f():\n    from whole.c import (\n        y,\n    )",
        "c": "from whole.a import z",
        "d": "from whole.a import z",
    }
    for name, text in texts.items():
        (package / f"{name}.py").write_text(text, encoding="utf-8")
    results = [cache.source_version("whole.a")]
    for name in "abcd":
        (package / f"{name}.py").write_text(texts[name] + "\n", encoding="utf-8")
        cache.source_version.cache_clear()
        results.append(cache.source_version("whole.a"))
    assert len(set(results)) == 4
    assert results[3] == results[4]
    kinds = [cache.source_version(f"models.shapes.{name}") for name in ("hull", "covering", "pairs")]
    assert len(set(kinds)) == 3


@pytest.mark.parametrize(
    ("vertices", "faces", "name"),
    [
        (np.zeros((3, 2)), [[0, 1, 2]], "vertices"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], "vertices"),
        (np.zeros((3, 3)), [[0, 1, 3]], "faces"),
        (np.zeros((3, 3)), [[0, 1]], "faces"),
        (np.zeros((3, 3)), np.zeros((0, 3), dtype=int), "faces"),
        (np.zeros((3, 3)), "abc", "faces"),
        (None, None, "vertices"),
    ],
)
def test_bad_meshes_are_named(vertices: object, faces: object, name: str) -> None:
    with pytest.raises(ModelError) as caught:
        cover(vertices, faces)
    assert caught.value.name == name


def test_the_hull_of_a_part_is_in_its_capsule() -> None:
    vertices, faces = blob(5)
    (only, *more) = fit_cover(vertices[faces])
    if not more:
        assert exceedance(only.shape, convex_hull(vertices[np.unique(faces)]).vertices).max() <= 0
