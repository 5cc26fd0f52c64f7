"""Lines, arcs and their chain: geometry from first principles, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from models import Arc, Helix, Line, ModelError, Path, smooth
from models.paths.segments import rotation_vector
from tests.models.paths.task_paths import seeds, turned


def points_of(arc: Arc, count: int = 101) -> Any:
    return Path((arc,)).at(np.zeros(count, dtype=int), np.linspace(0, arc.length, count))[0]


@given(seeds)
def test_an_arc_goes_through_its_three_points_on_a_circle_in_their_plane(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, c = rng.normal(size=(3, 3)) * 10 ** rng.uniform(-2, 2)
    arc = Arc.through(a, b, c)
    size = float(np.linalg.norm(c - a))
    normal = np.cross(b - a, c - a)
    points = points_of(arc)
    assert arc.start == pytest.approx(a, abs=0)
    assert arc.end == pytest.approx(c, abs=1e-12 * (arc.radius + size))
    assert np.linalg.norm(points - arc.center, axis=1) == pytest.approx(arc.radius, rel=1e-12)
    assert (points - a) @ (normal / np.linalg.norm(normal)) == pytest.approx(0, abs=1e-9 * arc.radius)
    # b is on the way: the angle from a to b about the axis is less than the sweep
    first, to_b = a - arc.center, b - arc.center
    angle = np.arctan2(arc.axis @ np.cross(first, to_b), first @ to_b) % (2 * np.pi)
    assert np.linalg.norm(to_b) == pytest.approx(arc.radius, rel=1e-9)
    assert 0 < angle < arc.sweep


@pytest.mark.parametrize("height", 10.0 ** -np.arange(1, 9))
def test_an_arc_that_is_nearly_a_line_ends_at_its_end_to_rounding(height: float) -> None:
    a, c = np.array([0.3, -0.2, 0.7]), np.array([-0.4, 0.5, 0.1])
    across = np.cross(c - a, [1.0, 2.0, 3.0])
    via = (a + c) / 2 + height * across / np.linalg.norm(across)
    arc = Arc.through(a, via, c)
    assert np.linalg.norm(arc.end - c) < 1e-14
    sagitta, chord = height, float(np.linalg.norm(c - a))
    assert arc.radius == pytest.approx(sagitta / 2 + chord**2 / (8 * sagitta), rel=1e-7)


@given(seeds, st.floats(-1, 1))
def test_an_arc_about_a_center_turns_by_its_sweep(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    sweep = 2 * np.pi * share if abs(share) > 1e-3 else 2 * np.pi
    center, axis = rng.normal(size=3), rng.normal(size=3)
    across = np.cross(axis, rng.normal(size=3))
    arc = Arc.about(center + across, center, axis, sweep)
    unit = axis / np.linalg.norm(axis)
    # Rodrigues
    expected = center + across * np.cos(sweep) + np.cross(unit, across) * np.sin(sweep)
    assert arc.end == pytest.approx(expected, abs=1e-12 * (1 + arc.radius))
    assert arc.length == pytest.approx(abs(sweep) * np.linalg.norm(across), rel=1e-14)


def frenet(helix: Helix, angle: Any) -> Any:
    """Points of a helix from its definition: round the axis by an angle, up by its share of the rise. Shape (M, 3)."""
    unit = np.asarray(helix.axis)
    across = np.asarray(helix.start) - np.asarray(helix.center)
    a = np.asarray(angle)[:, None]
    round_it = across * np.cos(a) + np.cross(unit, across) * np.sin(a)  # Rodrigues
    return np.asarray(helix.center) + round_it + unit * helix.rise * a / helix.sweep


def random_helix(seed: int, share: float) -> Helix:
    rng = np.random.default_rng(seed)
    center, axis = rng.normal(size=3), rng.normal(size=3)
    across = np.cross(axis, rng.normal(size=3))
    return Helix(center + across, center, axis, 10 ** rng.uniform(-2, 2), share * 10 ** rng.uniform(-2, 1))


@given(seeds, st.floats(-1, 1))
def test_a_helix_is_the_curve_of_its_definition_by_its_length(seed: int, share: float) -> None:
    helix = random_helix(seed, share)
    radius, turned_by = helix.radius, np.linspace(0, 1, 33)
    assert helix.length == pytest.approx(np.sqrt((radius * helix.sweep) ** 2 + helix.rise**2), rel=1e-14)
    path = Path((helix,))
    position, tangent, bend, change = path.at(np.zeros(33, dtype=int), helix.length * turned_by)
    assert position == pytest.approx(frenet(helix, helix.sweep * turned_by), abs=1e-11 * (1 + helix.length))
    assert helix.end == pytest.approx(position[-1], abs=1e-12 * (1 + helix.length))
    # Frenet: |T| = 1, |T'| = k, (T x T') . T'' = k^2 w
    pitch = helix.rise / helix.sweep
    curvature, torsion = (each / (radius**2 + pitch**2) for each in (radius, pitch))
    assert np.linalg.norm(tangent, axis=1) == pytest.approx(1, rel=1e-12)
    assert np.linalg.norm(bend, axis=1) == pytest.approx(curvature, rel=1e-12)
    triple = np.einsum("mi,mi->m", np.cross(tangent, bend), change)
    assert triple == pytest.approx(curvature**2 * torsion, abs=1e-10 * curvature**2 * (curvature + abs(torsion)))
    assert (helix.curvature, helix.torsion) == pytest.approx((curvature, torsion), rel=1e-12)


@given(seeds)
def test_derivatives_of_a_helix_are_those_of_its_position(seed: int) -> None:
    helix = random_helix(seed, 0.8)
    path, index = Path((helix,)), np.zeros(5, dtype=int)
    h = 1e-4 / np.hypot(helix.curvature, helix.torsion)
    s = np.linspace(h, max(helix.length - h, h), 5)
    before, here, after = (path.at(index, s + k * h) for k in (-1, 0, 1))
    for order in range(3):
        scale = np.abs(here[order + 1]).max() + np.abs(here[order]).max() * 1e-9 / h
        assert (after[order] - before[order]) / (2 * h) == pytest.approx(here[order + 1], abs=2e-6 * scale)


@given(seeds, st.floats(0.01, 1))
def test_a_helix_without_a_rise_is_an_arc_and_turns_on(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    center, axis = rng.normal(size=3), rng.normal(size=3)
    start = center + np.cross(axis, rng.normal(size=3))
    arc, flat = Arc.about(start, center, axis, share * 2 * np.pi), Helix(start, center, axis, share * 2 * np.pi, 0.0)
    twice = Helix(start, center, axis, (share + 1) * 2 * np.pi, 0.0)
    places = np.linspace(0, arc.length, 11)
    for one, other in zip(*(Path((s,)).at(np.zeros(11, dtype=int), places) for s in (arc, flat)), strict=True):
        assert other == pytest.approx(one, abs=1e-12 * max(1.0, float(np.abs(one).max())))
    assert twice.end == pytest.approx(arc.end, abs=1e-12)
    assert twice.length == pytest.approx(arc.length + 2 * np.pi * arc.radius)


def test_a_helix_joins_its_neighbours_and_is_rounded() -> None:
    """A thread milled: in by a line, down by three turns and a quarter, out by another line."""
    down = Helix((0.01, 0, 0), (0, 0, 0), (0, 0, 1), 6.5 * np.pi, -0.004)
    path = Path((Line((0.01, -0.02, 0), (0.01, 0, 0)), down, Line((0, 0.01, -0.004), (-0.02, 0.01, -0.004))))
    smoothed = smooth(path, deviation=2e-5)
    first, last = smoothed.bounds[2:4]
    inside = smoothed.at(np.linspace(first, last, 1001)).position
    assert np.hypot(inside[:, 0], inside[:, 1]) == pytest.approx(0.01, abs=1e-12)
    angle = np.unwrap(np.arctan2(inside[:, 1], inside[:, 0]))
    assert inside[:, 2] == pytest.approx(-0.004 * angle / (6.5 * np.pi), abs=1e-12)
    assert smoothed.curvature_jumps().max() < 1e-9


def test_a_full_circle_closes_and_joins_its_neighbours() -> None:
    circle = Arc.about((1.0, 0.0, 0.0), (1.0, 0.3, 0.0), (0.0, 0.0, 1.0), 2 * np.pi)
    assert circle.end == pytest.approx([1.0, 0.0, 0.0], abs=1e-15)
    path = smooth(Path((Line((0, 0, 0), (1, 0, 0)), circle, Line((1, 0, 0), (2, 0, 0.5)))), 0.05)
    assert path.length == pytest.approx(1 + 0.6 * np.pi + np.hypot(1, 0.5), abs=0.02)
    assert path.curvature_jumps().max() < 1e-9


@given(seeds)
def test_the_path_of_a_segment_has_the_derivatives_of_its_position(seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = Path((Arc.through(*rng.normal(size=(3, 3))),))
    s, h = rng.uniform(0.1, 0.9, 5) * path.length, 1e-5 * path.length
    index = np.zeros(5, dtype=int)
    before, here, after = (path.at(index, s + k * h) for k in (-1, 0, 1))
    for order in range(3):
        difference = (after[order] - before[order]) / (2 * h)
        assert difference == pytest.approx(here[order + 1], abs=1e-7 * np.abs(here[order + 1]).max())


def test_rotation_vectors_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    first, vectors = Rotation.random(100, random_state=rng), rng.normal(size=(100, 3))
    vectors *= rng.uniform(0, 3.14, (100, 1)) / np.linalg.norm(vectors, axis=1, keepdims=True)
    last = first * Rotation.from_rotvec(vectors)
    pairs = zip(*(each.as_quat()[:, [3, 0, 1, 2]] for each in (first, last)), strict=True)
    np.testing.assert_allclose([rotation_vector(p, q) for p, q in pairs], vectors, rtol=0, atol=1e-13)


NAN = float("nan")
STEP = Line((0, 0, 0), (1, 0, 0))
TILTED = turned((1.0, 0, 0))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Line((0, 0, 0), (0, 0, 0)), "length 0 m"),
        (lambda: Line((0, 0, 0), (NAN, 0, 0)), "not finite"),
        (lambda: Line((0, 0), (1, 0, 0)), "shape"),
        (lambda: Line((0, 0, 0), (1, 0, 0), (2, 0, 0, 0)), "norm 2"),
        (lambda: Line((0, 0, 0), (1, 0, 0), (1, 0, 0, 0), (0, 1, 0, 0)), "180 deg"),
        (lambda: Arc.through((0, 0, 0), (1, 0, 0), (2, 0, 0)), "on a line"),
        (lambda: Arc.through((0, 0, 0), (1, 0, 0), (0, 0, 0)), "full circle"),
        (lambda: Arc.through((0, 0, 0), (NAN, 0, 0), (0, 1, 0)), "not finite"),
        (lambda: Arc.about((1, 0, 0), (1, 0, 0), (0, 0, 1), 1.0), "radius"),
        (lambda: Arc.about((1, 0, 0), (0, 0, 0), (0, 0, 0), 1.0), "no direction"),
        (lambda: Arc.about((1, 0, 0), (0, 0, 0), (1, 0, 1), 1.0), "perpendicular"),
        (lambda: Arc.about((1, 0, 0), (0, 0, 0), (0, 0, 1), 0.0), "sweep 0"),
        (lambda: Arc.about((1, 0, 0), (0, 0, 0), (0, 0, 1), 7.0), "sweep 7"),
        (lambda: Arc.about((1, 0, 0), (0, 0, 0), (0, 0, 1), NAN), "must be a finite number"),
        (lambda: Helix((1, 0, 0), (1, 0, 0), (0, 0, 1), 1.0, 0.1), "helix: .* radius"),
        (lambda: Helix((1, 0, 0), (0, 0, 0), (0, 0, 0), 1.0, 0.1), "helix: .* no direction"),
        (lambda: Helix((1, 0, 0), (0, 0, 0.1), (0, 0, 1), 1.0, 0.1), "helix: .* perpendicular"),
        (lambda: Helix((1, 0, 0), (0, 0, 0), (0, 0, 1), -1.0, 0.1), "sweep must be positive .*, not -1.0"),
        (lambda: Helix((1, 0, 0), (0, 0, 0), (0, 0, 1), 1e-10, 0.0), "remove it"),
        (lambda: Helix((1, 0, 0), (0, 0, 0), (0, 0, 1), 1.0, NAN), "rise must be .*, not nan"),
        (lambda: Path(()), "no segment"),
        (lambda: Path(3), "no sequence"),  # type: ignore[arg-type]
        (lambda: Path(("line",)), "segment 0"),  # type: ignore[arg-type]
        (lambda: Path((STEP, Line((1, 0, 1e-6), (2, 0, 0)))), "gap of 1e-06"),
        (lambda: Path((STEP, Line((1, 0, 0), (0.5, 0, 0)))), "180 deg"),
        (lambda: Path((STEP, Arc.about((1, 0, 0), (1, 1, 0), (0, 0, -1), 1.0))), "180 deg"),
        (lambda: Path((STEP, Line((1, 0, 0), (1, 1, 0), TILTED))), "orientation jumps by 57.3 deg"),
        (lambda: Path.through([(0, 0, 0)]), "expected .points, 3., 2 at least"),
        (lambda: Path.through([(0, 0, 0), (0, 0, 0), (1, 0, 0)]), "length 0 m"),
        (lambda: Path.through([(0, 0, 0), (1, 0, 0), (0, 0, 0)]), "180 deg"),
        (lambda: Path.through("points"), "not numeric"),
    ],
)
def test_invalid_paths_are_named_errors(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        make()
