"""Signed distances of shapes: those of coal and of hulls of differences, their derivatives, what leaves them alone."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import combinations_with_replacement, pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from models import Box, Capsule, Cylinder, Frame, HalfSpace, Mesh, ModelError, Sphere
from models.shapes.distance import COLUMNS, column, distance, pair_function, pair_wrenches
from models.shapes.shapes import SIDES, Shape
from tests.families import some
from tests.models.shapes.shape_oracles import by_coal, by_differences, moved_distance, random_frame, random_shape

pytestmark = pytest.mark.xdist_group("distances")  # one process, so that pairs are drawn once

EXACT = (Sphere, Capsule, Box)
EXACT_PAIRS = list(combinations_with_replacement(EXACT, 2))
PAIRS = [
    pair
    for pair in combinations_with_replacement((Sphere, Capsule, Box, HalfSpace, Mesh, Cylinder), 2)
    if pair != (HalfSpace, HalfSpace)
]
ROUNDINGS = (1e-3, 0.03, 0.2)


def names(pair: Any) -> str:
    return "-".join(kind.__name__ for kind in pair)


def number(value: Any) -> float:
    return float(ca.DM(value))


def draws(pair: tuple[type, type], count: int) -> int:
    """How many to draw of a pair: one in five of two hulls, whose distances have thousands of operations each."""
    return max(1, count // 5) if set(pair) <= {Mesh, Cylinder} else count


@cache
def random_pairs(pair: tuple[type, type], count: int, seed: int, apart: float = 1.0) -> list[tuple[Any, Any]]:
    rng = np.random.default_rng(seed)
    spreads = apart * rng.uniform(0.05, 1.0, count)
    return [(random_shape(pair[0], rng, 0.1), random_shape(pair[1], rng, spread)) for spread in spreads]


def in_bulk(pairs: list[tuple[Any, Any]], rounding: float = 0.0) -> Any:
    """Distances of pairs of the same two kinds, all at once."""
    function = pair_function(type(pairs[0][0]), type(pairs[0][1]), rounding).map(len(pairs))
    return np.array(function(*(ca.horzcat(*map(column, side)) for side in zip(*pairs, strict=True)))).ravel()


@pytest.mark.parametrize("count", [2000, pytest.param(16700, marks=pytest.mark.long)])
@pytest.mark.parametrize("pair", EXACT_PAIRS, ids=names)
def test_distances_of_many_random_pairs_are_those_of_coal(pair: tuple[type, type], count: int) -> None:
    """1e5 in all. Of deep boxes coal's search for the depth ends short of it now and then: there it is a bound."""
    pairs = random_pairs(pair, count, seed=1)
    result, known = in_bulk(pairs), np.array([by_coal(*both) for both in pairs])
    assert (known < 0).mean() > 0.15
    assert (known > 0).mean() > 0.15
    assert (result - known).max() <= 1e-6
    apart = known > 0 if Box in pair else np.full(len(known), True)
    np.testing.assert_allclose(result[apart], known[apart], atol=1e-6, rtol=0)
    assert np.mean(np.abs(result - known) < 1e-6) > 0.995


@pytest.mark.parametrize("pair", [(Sphere, Box), (Capsule, Box), (Box, Box)], ids=names)
def test_depths_and_gaps_are_those_of_the_hull_of_differences(pair: tuple[type, type]) -> None:
    pairs = random_pairs(pair, 400, seed=2, apart=0.7)
    known = np.array([by_differences(*both) for both in pairs])
    np.testing.assert_allclose(in_bulk(pairs), known, atol=2e-7, rtol=0)


def special_poses(rng: np.random.Generator) -> tuple[Any, Any]:
    """Whole and half numbers, turned by right angles: parallel, aligned, touching, crossing, one in the other."""
    grid = np.arange(-4, 5) / 4
    quarter = np.eye(3)[rng.permutation(3)] * rng.choice([-1.0, 1.0], 3)[:, None]
    turn = quarter * np.linalg.det(quarter)
    start = rng.choice(grid, 3)
    end = start + rng.choice([0.0, 0.25, 0.5, 1.0], 3) * (rng.random(3) < 0.5)
    return Capsule(0.125, start, end), Box(rng.choice([0.5, 1.0], 3), rng.choice(grid, 3), turn)


@pytest.mark.long
def test_aligned_adjacent_and_crossing_shapes_have_exact_distances() -> None:
    rng = np.random.default_rng(3)
    cases = [special_poses(rng) for _ in range(1500)]
    rods, boxes = zip(*cases, strict=True)
    for pairs in (cases, list(pairwise(rods)), list(pairwise(boxes))):
        known = np.array([by_coal(*both) if _has_length(both) else np.nan for both in pairs])
        result = in_bulk(pairs)
        assert np.isfinite(result).all()
        apart = known > 1e-9
        np.testing.assert_allclose(result[apart], known[apart], atol=1e-6, rtol=0)
        assert (result[known < -1e-6] < 0).all()
        assert np.nanmax(result - known) < 1e-6


def _has_length(shapes: tuple[Any, ...]) -> bool:
    return all(not isinstance(shape, Capsule) or (shape.start != shape.end).any() for shape in shapes)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 10.0])
def test_a_capsule_nearly_along_an_edge_is_as_near_as_its_nearest_point(scale: float) -> None:
    """Tilted by 1e-15 to .1, most of them by less than 1e-12: no point is nearer than is told, and one is as near."""
    rng = np.random.default_rng(18)
    count = 600
    box = Box(scale * np.array([0.4, 0.7, 1.1]))
    tilts = rng.normal(size=(count, 3)) * 10.0 ** np.where(
        rng.random((count, 1)) < 0.7, rng.uniform(-15, -12, size=(count, 1)), rng.uniform(-12, -1, size=(count, 1))
    )
    middles = scale * rng.normal(size=(count, 3))
    paths = scale * (np.eye(3)[rng.integers(3, size=count)] * rng.uniform(0.1, 2.0, size=(count, 1)) + tilts)
    s = np.linspace(-0.5, 0.5, 1001)
    over = np.maximum(np.abs(middles[:, None] + s[:, None] * paths[:, None]) - box.size / 2, 0.0)
    known = np.linalg.norm(over, axis=2).min(axis=1)
    result = in_bulk([(Capsule(0.1 * scale, m - w / 2, m + w / 2), box) for m, w in zip(middles, paths, strict=True)])
    apart = known > 1e-3 * scale
    assert apart.sum() > count / 2
    missed = (known - 0.1 * scale - result)[apart] / scale
    assert missed.min() > -1e-9
    assert missed.max() < 2.0 / 1000


def test_a_capsule_without_length_is_a_sphere() -> None:
    rng = np.random.default_rng(4)
    for kind in (Sphere, Capsule, Box, HalfSpace, Mesh):
        other, ball = random_shape(kind, rng), random_shape(Sphere, rng)
        known = number(distance(ball, other))
        assert number(distance(Capsule(ball.radius, ball.position, ball.position), other)) == pytest.approx(
            known, abs=1e-9
        )


@pytest.mark.parametrize("kind", [Sphere, Capsule, Box, Mesh, Cylinder], ids=lambda kind: kind.__name__)
def test_height_above_a_half_space_is_that_of_the_lowest_point(kind: type) -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        ground, shape = random_shape(HalfSpace, rng), random_shape(kind, rng)
        known = ((shape.core - ground.point) @ ground.normal).min() - shape.swept_radius
        assert number(distance(shape, ground)) == pytest.approx(known, abs=1e-12)
        assert number(distance(ground, shape)) == pytest.approx(known, abs=1e-12)


@pytest.mark.parametrize("other", some([Sphere, Capsule, Box, Mesh, Cylinder], 2), ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("kind", [Mesh, Cylinder], ids=lambda kind: kind.__name__)
def test_beside_a_mesh_or_a_cylinder_it_is_a_bound_from_below(kind: type, other: type) -> None:
    """Of the distance of the hulls, by coal where they are apart; near it more often than not."""
    rng = np.random.default_rng(6)
    gaps = []
    for _ in range(draws((kind, other), 50)):
        one, two = random_shape(kind, rng, 0.1), random_shape(other, rng, 1.2)
        result, known, true = number(distance(one, two)), by_differences(one, two), by_coal(one, two)
        assert result <= known + 1e-7
        assert true < 0 or result <= true + 1e-6
        gaps.append(result - known)
    assert np.median(gaps) > -0.2
    assert max(gaps) > -1e-3


def test_beside_the_face_of_a_mesh_or_the_end_of_a_cylinder_it_is_exact() -> None:
    corners = Box((1, 2, 3)).core
    turn = random_frame(np.random.default_rng(7)).rotation
    ball = Sphere(0.25, turn @ (1.5, 0.2, -0.3))
    assert number(distance(Mesh(corners, rotation=turn), ball)) == pytest.approx(0.75, abs=1e-12)
    assert number(distance(ball, Cylinder(0.5, 2.0, (0, 0, 0), turn))) == pytest.approx(0.75, abs=1e-12)
    assert number(distance(Sphere(0.5, turn @ (0, 0, 2.0)), Cylinder(0.5, 2.0, (0, 0, 0), turn))) == pytest.approx(0.5)
    inside = Sphere(0.25, turn @ (0.4, 0, 0))
    assert number(distance(Mesh(corners, rotation=turn), inside)) == pytest.approx(-0.35, abs=1e-12)


def test_the_prism_holds_the_cylinder_and_stands_out_by_two_percent() -> None:
    rod = Cylinder(0.5, 2.0, (1, 2, 3), random_frame(np.random.default_rng(8)).rotation)
    own = (rod.core - rod.position) @ rod.rotation
    around = np.linalg.norm(own[:, :2], axis=1)
    assert (around > 0.5).all()
    assert (around < 0.51).all()
    np.testing.assert_allclose(np.abs(own[:, 2]), 1.0)
    heights = rod.hull.normals @ own.T - rod.hull.offsets[:, None]
    assert len(rod.hull.normals) == SIDES + 2
    assert heights.max() < 1e-12
    np.testing.assert_allclose(rod.hull.offsets, np.where(np.abs(rod.hull.normals[:, 2]) > 0.5, 1.0, 0.5))


# ---- what motions, sizes and order leave alone --------------------------------------------------------------------


@pytest.mark.parametrize("rounding", [0.0, 0.05])
@pytest.mark.parametrize("pair", some(PAIRS, 8), ids=names)
def test_order_and_a_motion_of_both_change_nothing(pair: tuple[type, type], rounding: float) -> None:
    rng = np.random.default_rng(9)
    for _ in range(draws(pair, 3)):
        one, other = (random_shape(kind, rng) for kind in pair)
        known = number(distance(one, other, rounding=rounding))
        assert number(distance(other, one, rounding=rounding)) == pytest.approx(known, abs=1e-9)
        frame = random_frame(rng)
        both = number(distance(one, other, frame, frame, rounding=rounding))
        placed = (shape.placed(frame.rotation, frame.position.ravel()) for shape in (one, other))
        assert both == pytest.approx(known, abs=1e-9)
        assert number(distance(*placed, rounding=rounding)) == pytest.approx(known, abs=1e-9)


def scaled(shape: Any, factor: float) -> Shape:
    if isinstance(shape, Sphere):
        return Sphere(factor * shape.radius, factor * shape.position)
    if isinstance(shape, Capsule):
        return Capsule(factor * shape.radius, factor * shape.start, factor * shape.end)
    if isinstance(shape, Box):
        return Box(factor * shape.size, factor * shape.position, shape.rotation)
    if isinstance(shape, Cylinder):
        return Cylinder(factor * shape.radius, factor * shape.length, factor * shape.position, shape.rotation)
    if isinstance(shape, HalfSpace):
        return HalfSpace(factor * shape.normal, factor * shape.point)
    return Mesh(shape.vertices, shape.faces, factor * shape.position, shape.rotation, scale=factor * shape.scale)


@pytest.mark.parametrize("pair", PAIRS, ids=names)
def test_a_larger_scene_has_larger_distances(pair: tuple[type, type]) -> None:
    rng = np.random.default_rng(10)
    for factor in (0.25, 3.0):
        one, other = (random_shape(kind, rng) for kind in pair)
        for rounding in (0.0, 0.05):
            known = factor * number(distance(one, other, rounding=rounding))
            grown = distance(scaled(one, factor), scaled(other, factor), rounding=factor * rounding)
            assert number(grown) == pytest.approx(known, abs=1e-8)


@pytest.mark.parametrize("pair", PAIRS, ids=names)
def test_numbers_and_both_kinds_of_symbols_agree(pair: tuple[type, type]) -> None:
    rng = np.random.default_rng(11)
    one, other = (random_shape(kind, rng) for kind in pair)
    frame, other_frame = random_frame(rng), random_frame(rng)
    known = distance(one, other, frame, other_frame, rounding=0.02)
    assert isinstance(known, ca.DM)
    assert known.shape == (1, 1)
    for kind in (ca.SX, ca.MX):
        parts = [kind.sym("turn", 3, 3), kind.sym("place", 3), kind.sym("turn", 3, 3), kind.sym("place", 3)]
        result = distance(one, other, Frame(*parts[:2]), Frame(*parts[2:]), rounding=0.02)
        assert number(ca.Function("gap", parts, [result])(*frame, *other_frame)) == pytest.approx(
            number(known), abs=1e-10
        )
    half = distance(one, other, Frame(parts[0], parts[1]), other_frame, rounding=0.02)
    assert number(ca.Function("gap", parts[:2], [half])(*frame)) == pytest.approx(number(known), abs=1e-10)


def test_small_shapes_have_equally_exact_distances() -> None:
    rng = np.random.default_rng(17)
    for pair in EXACT_PAIRS:
        one, other = (random_shape(kind, rng) for kind in pair)
        known = 1e-4 * number(distance(one, other))
        assert number(distance(scaled(one, 1e-4), scaled(other, 1e-4))) == pytest.approx(known, abs=2e-12)
    rod, crossing = (
        Capsule(1e-5, (0, 0, 0), (1e-3, 0, 0)),
        Capsule(1e-5, (2e-4, -2.5e-5, 1e-4), (1.2e-3, 2.5e-5, 1e-4)),
    )
    assert number(distance(rod, crossing)) == pytest.approx(8e-5, abs=2e-12)


@pytest.mark.parametrize("angle", [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 0.0])
@pytest.mark.parametrize("share", [0.0, 0.2, 0.7, 1.0])
def test_distances_of_crossing_rods_are_no_upper_estimates(angle: float, share: float) -> None:
    """Two of 2 m that meet in a point, a share of their length on: missed by at most 3e-7 of it."""
    along, turned = np.array([1.0, 0, 0]), np.array([np.cos(angle), np.sin(angle), 0.0])
    rods = [Capsule(0.25, -2 * share * each, 2 * (1 - share) * each) for each in (along, turned)]
    for one, other in (rods, rods[::-1]):
        assert -1e-11 <= number(distance(one, other)) + 0.5 <= 2 * 3.2e-7


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e3])
@pytest.mark.parametrize("slope", [-2.0, 0.0, 0.5])
def test_a_rod_across_an_edge_is_as_deep_as_it_is_at_any_size(scale: float, slope: float) -> None:
    """0.01 beyond the edge at x = y = 0.1 of a box along z, square to it; the nearest face is 0.05 and more away."""
    out, across = np.array([1.0, 1.0, 0.0]) / np.sqrt(2), np.array([1.0, -1.0, slope])
    middle = np.array([0.1, 0.1, 0.05]) - 0.01 * out
    rod = Capsule(0.02, middle - 0.1 * across, middle + 0.08 * across)
    for one, other in ((Box((0.2, 0.2, 0.6)), rod), (rod, Box((0.2, 0.2, 0.6)))):
        result = number(distance(scaled(one, scale), scaled(other, scale)))
        assert result == pytest.approx(-0.03 * scale, rel=1e-9, abs=2e-12)


# ---- rounding -----------------------------------------------------------------------------------------------------


def between_boxes(one: Box, other: Box) -> float:
    """The largest gap along axes and across edges, and of the distances of either box to the one around the other."""
    axes, others = one.rotation.T, other.rotation.T
    across = np.cross(axes[:, None], others[None]).reshape(9, 3)
    tried = np.concatenate([axes, others, across / np.linalg.norm(across, axis=1)[:, None]])
    here, there = tried @ one.core.T, tried @ other.core.T
    gaps = np.maximum(there.min(axis=1) - here.max(axis=1), here.min(axis=1) - there.max(axis=1))
    sizes = [np.linalg.norm(np.maximum(part, 0)) for part in (gaps[:3], gaps[3:6])]
    return float(max(gaps.max(), *sizes)) if gaps.max() > 0 else float(gaps.max())


@pytest.mark.parametrize("rounding", ROUNDINGS)
@pytest.mark.parametrize("pair", some(EXACT_PAIRS, 3), ids=names)
def test_rounded_distances_underestimate_by_the_stated_bound(pair: tuple[type, type], rounding: float) -> None:
    pairs = random_pairs(pair, 2000, seed=12)
    known, result = in_bulk(pairs), in_bulk(pairs, rounding)
    apart = known + [one.swept_radius + other.swept_radius for one, other in pairs]
    assert (result <= known + 1e-9).all()
    if pair == (Box, Box):
        seen = np.array([between_boxes(*both) for both in pairs])
        assert (result >= seen - 4 * rounding).all()
        missed = (known - seen) / np.maximum(known, 1e-9)
        assert missed.max() < 0.3
        assert np.percentile(missed[known > 1e-6], 75) < 0.02
    else:
        assert (result >= known - 0.84 * rounding).all()
    if Sphere in pair:
        np.testing.assert_array_equal(result, known)
    elif Capsule in pair:
        assert (result >= known - rounding**2 / np.maximum(apart, 1e-12)).all()


@pytest.mark.parametrize("rounding", ROUNDINGS)
@pytest.mark.parametrize("pair", some([pair for pair in PAIRS if pair not in EXACT_PAIRS], 5), ids=names)
def test_rounded_bounds_are_lower_by_at_most_the_stated_bound(pair: tuple[type, type], rounding: float) -> None:
    rng = np.random.default_rng(13)
    for _ in range(draws(pair, 4)):
        one, other = (random_shape(kind, rng) for kind in pair)
        known, result = number(distance(one, other)), number(distance(one, other, rounding=rounding))
        assert known - 3 * rounding <= result <= known + 1e-9


def test_the_bound_is_attained_within_a_fifth_where_segments_cross() -> None:
    """What is said of the shortage is not too generous: crossing segments are short by e/sqrt(2)."""
    one, other = Capsule(0.1, (-0.5, 0, 0), (0.5, 0, 0)), Capsule(0.1, (0, -0.5, 0), (0, 0.5, 0))
    assert number(distance(one, other)) == pytest.approx(-0.2, abs=1e-9)
    assert number(distance(one, other, rounding=0.1)) == pytest.approx(-0.2 - 0.1 / np.sqrt(2), abs=1e-3)


# ---- derivatives --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rounding", [0.0, 0.05])
@pytest.mark.parametrize("pair", some(PAIRS, 8), ids=names)
def test_gradients_are_those_of_finite_differences(pair: tuple[type, type], rounding: float) -> None:
    """Away from kinks: where the differences of two steps agree; kinks are rare."""
    rng = np.random.default_rng(14)
    kept, worst, shapes = 0, 0.0, draws(pair, 6)
    for _ in range(shapes):
        one, other = random_shape(pair[0], rng), random_shape(pair[1], rng, 0.8)
        function, _ = moved_distance(one, other, rounding)
        for x in rng.normal(size=(8, 6)) * [1.0, 1.0, 1.0, 0.4, 0.4, 0.4]:
            slope = np.array(function(x)[1]).ravel()
            assert np.isfinite(slope).all()
            rough, fine = (_differences(lambda at, f=function: number(f(at)[0]), x, step) for step in (2e-5, 1e-5))
            if np.abs(rough - fine).max() < 1e-7:
                kept, worst = kept + 1, max(worst, float(np.abs(slope - fine).max()))
    assert kept > 5 * shapes
    assert worst < 1e-6


@pytest.mark.parametrize("rounding", [0.0, 0.05])
@pytest.mark.parametrize("pair", EXACT_PAIRS, ids=names)
def test_second_derivatives_are_those_of_finite_differences(pair: tuple[type, type], rounding: float) -> None:
    rng = np.random.default_rng(15)
    kept, worst = 0, 0.0
    for _ in range(6):
        one, other = random_shape(pair[0], rng), random_shape(pair[1], rng, 0.8)
        function, perturbed = moved_distance(one, other, rounding)
        for x in rng.normal(size=(6, 6)) * [1.0, 1.0, 1.0, 0.4, 0.4, 0.4]:
            values = np.array(perturbed(x))
            assert np.isfinite(values).all()
            rough, fine = (_differences(lambda at, f=function: np.array(f(at)[1]).ravel(), x, h) for h in (2e-5, 1e-5))
            if np.abs(rough - fine).max() < 1e-5 * (1 + np.abs(fine).max()):
                kept += 1
                worst = max(worst, float(np.abs(values - fine).max() / (1 + np.abs(fine).max())))
    assert kept > 18
    assert worst < 1e-4


@pytest.mark.parametrize("rounding", [0.0, 0.05])
@pytest.mark.parametrize("pair", [pair for pair in PAIRS if set(pair) <= COLUMNS.keys()], ids=names)
def test_wrenches_are_the_rates_of_distances(pair: tuple[type, type], rounding: float) -> None:
    """By a twist of the first shape, in either order, side by side; away from kinks."""
    rng = np.random.default_rng(18)
    for kinds in {pair, pair[::-1]}:
        shapes = [(random_shape(kinds[0], rng, 0.5), random_shape(kinds[1], rng, 0.5)) for _ in range(30)]
        sides = [ca.horzcat(*map(column, side)).T for side in zip(*shapes, strict=True)]
        gaps, wrenches = (np.array(part) for part in pair_wrenches(*kinds, rounding, 30)(*sides))
        np.testing.assert_allclose(gaps.ravel(), in_bulk(shapes, rounding), atol=1e-12)
        twists = rng.normal(size=(30, 6))

        def moved(step: float, shapes: Any = shapes, twists: Any = twists) -> Any:
            turns = [Rotation.from_rotvec(step * twist[:3]).as_matrix() for twist in twists]
            paths = zip(shapes, turns, twists, strict=True)
            return in_bulk(
                [(one.placed(turn, step * twist[3:]), other) for (one, other), turn, twist in paths], rounding
            )

        rough, fine = ((moved(h) - moved(-h)) / (2 * h) for h in (2e-5, 1e-5))
        sure = np.abs(rough - fine) < 1e-7
        assert sure.sum() > 20
        np.testing.assert_allclose((wrenches * twists).sum(axis=1)[sure], fine[sure], atol=1e-6)


def _differences(function: Any, x: Any, step: float) -> Any:
    return np.array([(function(x + step * e) - function(x - step * e)) / (2 * step) for e in np.eye(len(x))])


def test_second_derivatives_of_an_aligned_capsule_are_those_of_one_nearly_aligned() -> None:
    """A slab that the segment neither enters nor leaves must not lose its share of them."""
    box = Box((1.0, 2.0, 3.0))
    for rounding in (0.0, 0.05):
        straight, tilted = (
            np.array(
                moved_distance(Capsule(0.1, (1.2, -0.3, 0.1), (1.9, -0.3 + e, 0.1 + e)), box, rounding)[1](np.zeros(6))
            )
            for e in (0.0, 1e-7)
        )
        assert np.isfinite(straight).all()
        np.testing.assert_allclose(straight, tilted, atol=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("rounding", some([0.0, 0.05], [0.05]))
def test_no_derivative_is_ever_spoilt(rounding: float) -> None:
    """Coincident points, parallel, crossing and bare-point capsules, boxes one in the other, symmetric poses."""
    here, along = (0, 0, 0), (1, 0, 0)
    shapes: list[Shape] = [
        Sphere(0.1, here),
        Capsule(0.1, here, along),
        Capsule(0.1, here, here),
        Capsule(0.1, (0, -1, 0), (0, 1, 0)),
        Capsule(0.1, (0, 0, 1), (1, 0, 1)),
        Capsule(0.1, (0.5, 0, 0), (0.5 + 1e-13, 0, 0)),
        Box((1, 1, 1)),
        Box((2, 1, 1), (1, 1, 0)),
        Mesh(Box((1, 1, 1)).core),
        Cylinder(0.5, 1.0, here),
        HalfSpace((0, 0, 1), here),
    ]
    for one, other in combinations_with_replacement(shapes, 2):
        if isinstance(one, HalfSpace) and isinstance(other, HalfSpace):
            continue
        function, perturbed = moved_distance(one, other, rounding)
        for x in (np.zeros(6), np.array([0, 0, 0, 0.5, 0, 0]), np.array([0, 0, 0, 0, 0, 1.0])):
            assert all(np.isfinite(np.array(part)).all() for part in (*function(x), perturbed(x))), (one, other, x)


@pytest.mark.parametrize("rounding", [0.0, 0.02])
@pytest.mark.parametrize("pair", [p for p in PAIRS if p not in ((Sphere, Sphere), (Capsule, Capsule))], ids=names)
def test_the_gradient_leads_out_of_an_overlap(pair: tuple[type, type], rounding: float) -> None:
    """A step along it as long as the depth, again where that was short, ends apart."""
    rng = np.random.default_rng(16)
    tried = 0
    while tried < draws(pair, 5):
        one, other = random_shape(pair[0], rng, 0.1), random_shape(pair[1], rng, 0.2)
        function, _ = moved_distance(one, other, rounding)
        x = np.zeros(6)
        if number(function(x)[0]) > -0.05:
            continue
        tried += 1
        for _ in range(40):
            gap, slope = number(function(x)[0]), np.array(function(x)[1]).ravel()[3:]
            if gap > 0:
                break
            x[3:] += (1e-3 - gap) * slope / max(float(slope @ slope), 0.1)
        assert gap > 0
        assert np.linalg.norm(x) < 4


def test_the_kinds_without_a_column_are_named() -> None:
    calls: list[Callable[[], Any]] = [
        lambda: pair_function(Mesh, Box),
        lambda: pair_function(Box, Cylinder),
        lambda: pair_function(HalfSpace, HalfSpace),
        lambda: pair_function(Box, []),  # type: ignore[arg-type]
        lambda: pair_function(Box, Box, -1.0),
        lambda: column(Cylinder(1, 1, (0, 0, 0))),
        lambda: column("box"),  # type: ignore[arg-type]
    ]
    for call in calls:
        with pytest.raises(ModelError):
            call()


def test_a_mesh_is_seen_past_its_edges_and_corners() -> None:
    """A cube of corners beside a ball: exact across faces, edges and corners, never nearer than 0.8 of the box's."""
    cube = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])
    mesh, box = Mesh(cube), Box((0.2, 0.2, 0.2))
    for path in ((1, 0, 0), (0, -1, 1), (1, 1, -1)):
        ball = Sphere(0.05, np.abs(path) * 0.1 * np.sign(path) + 0.3 * np.array(path) / np.linalg.norm(path))
        assert float(ca.DM(distance(mesh, ball))) == pytest.approx(0.25, abs=1e-9)
    for path in np.random.default_rng(0).normal(size=(50, 3)):
        ball = Sphere(1e-3, 0.5 * path / np.linalg.norm(path))
        report, true = (float(ca.DM(distance(body, ball))) for body in (mesh, box))
        assert 0.8 * true <= report <= true + 1e-9
