"""Blends: closed forms, arc length by independent quadrature, continuity, deviation and overlap on random paths."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.spatial import cKDTree

from models import Arc, Line, ModelError, ModelWarning, Path, SmoothPath, smooth
from models.paths import blends, gamma, rest_to_rest, rounding
from models.paths.blends import LARGEST_SHAPE, arc_length, polynomial
from tests.models.paths.task_paths import peak_curvature, random_path, seeds

pytestmark = pytest.mark.filterwarnings("ignore:overlap='shrink'")  # blends of random paths may overlap

ANGLES = (5.0, 11.0, 30.0, 45.0, 77.0, 90.0, 120.0, 150.0, 175.0, 179.0)


def corner(degrees: float, remaining: float, kind: Any, shape: float | None = None) -> SmoothPath:
    angle = np.radians(degrees)
    points = [(-1, 0, 0), (0, 0, 0), (-np.cos(angle), np.sin(angle), 0)]
    return smooth(Path.through(points), remaining, kind=kind, shape=shape)


def curvature_at(coefficients: Any, u: Any) -> Any:
    first, second = (polynomial(coefficients, np.asarray(u), order) for order in (1, 2))
    return np.linalg.norm(np.cross(first, second), axis=-1) / np.linalg.norm(first, axis=-1) ** 3


@pytest.mark.parametrize("degrees", ANGLES)
@pytest.mark.parametrize(("kind", "shape"), [("cubic", 1.0), ("cubic", 2.2), ("cubic", 3.0), ("quintic", 1.5)])
def test_the_closed_forms_are_those_of_the_curve(degrees: float, kind: str, shape: float) -> None:
    remaining, angle = 0.2, np.radians(degrees)
    curve = corner(degrees, remaining, kind, shape).coefficients[0]
    nearest = minimize_scalar(
        lambda u: np.linalg.norm(polynomial(curve, np.asarray(u))), bounds=(0.3, 0.7), options={"xatol": 1e-12}
    )
    assert gamma(shape, angle, kind) == pytest.approx(nearest.fun / remaining, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(
    ("degrees", "shape", "length"), [(90.0, 3.0, 1.8021), (90.0, 1.0, 1.4863), (45.0, 3.0, 1.6182)]
)
def test_lengths_over_the_remaining_distance_are_the_numbers_checked(
    degrees: float, shape: float, length: float
) -> None:
    assert corner(degrees, 0.15, "cubic", shape).blend(0).length / 0.15 == pytest.approx(length, abs=5e-5)


def test_a_blend_from_rest_to_rest_has_zero_end_velocity_and_acceleration() -> None:
    s = ca.SX.sym("s")
    path = rest_to_rest(s)
    speed = ca.jacobian(path, s)
    function = ca.Function("f", [s], [path, speed, ca.jacobian(speed, s)])
    assert [float(value) for value in function(0.0)] == [0.0, 0.0, 0.0]
    assert [float(value) for value in function(1.0)] == pytest.approx([1.0, 0.0, 0.0], abs=1e-14)
    assert rest_to_rest(np.array([0.0, 0.5, 1.0])) == pytest.approx([0.0, 0.5, 1.0])


def test_the_quintic_bends_less_than_the_cubic_as_stated() -> None:
    assert peak_curvature(1.5, np.pi / 2, 1.0, "quintic") == pytest.approx(1.172, abs=5e-4)
    assert gamma(1.5, np.pi / 2, "quintic") == pytest.approx(0.376, abs=5e-4)


@pytest.mark.parametrize("degrees", ANGLES)
@pytest.mark.parametrize(
    ("kind", "shape"),
    [("cubic", 0.5), ("cubic", 3.0), ("cubic", 5.0), ("quintic", 0.5), ("quintic", 1.5), ("quintic", 4.0)],
)
def test_arc_length_and_its_inverse_agree_with_adaptive_quadrature(degrees: float, kind: str, shape: float) -> None:
    path = corner(degrees, 0.3, kind, shape)
    blend, curve = path.blend(0), path.coefficients[0]

    def rate(u: float) -> float:
        return float(np.linalg.norm(polynomial(curve, np.asarray(u), 1)))

    breaks = [0, 0.2, 0.35, 0.4, 0.45, 0.49, 0.4999, 0.5, 0.5001, 0.51, 0.55, 0.6, 0.65, 0.8, 1]
    parts = [quad(rate, a, b, epsabs=0, epsrel=1e-13, limit=200)[0] for a, b in pairwise(breaks)]
    assert blend.length == pytest.approx(sum(parts), rel=1e-12)
    assert arc_length(curve, np.array(breaks)) == pytest.approx(np.cumsum([0, *parts]), rel=1e-11, abs=1e-13)
    u = path.parameter(blend.start + np.cumsum([0, *parts[:-1]]))
    along = arc_length(curve, u)
    assert along == pytest.approx(np.cumsum([0, *parts[:-1]]), rel=1e-10, abs=1e-12)


@pytest.mark.parametrize("degrees", [30.0, 90.0, 150.0])
@pytest.mark.parametrize(("kind", "shape"), [("cubic", 2.2), ("cubic", 3.0), ("quintic", 1.5)])
def test_a_step_towards_an_arc_length_cubes_the_error(
    degrees: float, kind: str, shape: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, result = corner(degrees, 0.3, kind, shape), list[Any]()
    for steps in (0, 1, 4):
        monkeypatch.setattr("models.paths.blends.MAX_STEPS", steps)
        result.append(path.parameter(path.sample_distances(40)))
    before, after = (np.nanmax(np.abs(each - result[2])) for each in result[:2])
    assert 1e-4 < before < 1e-2
    assert after < before**2.5


few = settings(max_examples=40)


@few
@given(seeds)
def test_the_curvature_is_that_of_the_place(seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = smooth(random_path(rng, 5, arcs=0.3, helices=0.3), 0.02)
    s = np.concatenate([path.sample_distances(), path.bounds])
    np.testing.assert_allclose(path.curvature(s), np.linalg.norm(path.at(s).curvature, axis=1), rtol=1e-12, atol=1e-9)


@pytest.mark.long
@few
@given(seeds, st.integers(2, 8), st.sampled_from(["cubic", "quintic"]), st.floats(-3.5, -1))
def test_random_paths_stay_within_the_deviation(seed: int, count: int, kind: Any, exponent: float) -> None:
    deviation = 10**exponent
    path = random_path(np.random.default_rng(seed), count, helices=0.3)
    smoothed = smooth(path, deviation=deviation, kind=kind)
    for vertex in range(count - 1):
        blend = smoothed.blend(vertex)
        points = smoothed.at(np.linspace(blend.start, blend.end, 1501)).position
        away = np.linspace(0, blend.remaining, 1501)
        one = np.ones(len(away), dtype=int)
        before = path.at(vertex * one, path.lengths[vertex] - away)[0]
        task = np.concatenate([before, path.at((vertex + 1) * one, away)[0]])
        # the nearest sample is farther than the nearest point by less than half a step in square
        for a, b, step in ((points, task, blend.remaining), (task, points, blend.length)):
            largest = cKDTree(b).query(a)[0].max()
            assert largest**2 <= (1.0005 * deviation) ** 2 + (step / 2000) ** 2


@few
@given(st.floats(5, 175), st.sampled_from(["cubic", "quintic"]), st.floats(0.1, 0.95), st.floats(-6, -2.5))
def test_a_blend_between_long_lines_takes_all_of_the_deviation(
    degrees: float, kind: Any, share: float, exponent: float
) -> None:
    shape, deviation, angle = share * LARGEST_SHAPE[kind], 10**exponent, np.radians(degrees)
    rays = np.array([(-1, 0, 0), (-np.cos(angle), np.sin(angle), 0)])
    smoothed = smooth(Path.through([rays[0], (0, 0, 0), rays[1]]), deviation=deviation, kind=kind, shape=shape)
    points = polynomial(smoothed.coefficients[0], np.linspace(0, 1, 8001))
    along = np.clip(points @ rays.T, 0, smoothed.remaining[0])
    away = np.linalg.norm(points[:, None] - along[..., None] * rays, axis=2).min(axis=1).max()
    taken = max(np.linalg.norm(points, axis=1).min(), away) / deviation
    assert smoothed.remaining[0] == 1 or 0.998 <= taken <= 1 + 1e-6


@few
@given(seeds, st.integers(2, 8), st.sampled_from(["cubic", "quintic"]), st.floats(-3, 0))
def test_random_paths_are_continuous_as_promised(seed: int, count: int, kind: Any, exponent: float) -> None:
    smoothed = smooth(random_path(np.random.default_rng(seed), count, helices=0.3), 10**exponent, kind=kind)
    at = smoothed.bounds[1:-1]
    step = 1e-12 * smoothed.length
    before, after = smoothed.at(at - step), smoothed.at(at + step)
    bend = smoothed.curvature(smoothed.sample_distances()).max()
    assert np.abs(after.position - before.position).max() < 4 * step
    assert np.abs(after.tangent - before.tangent).max() < 1e-12 + 4 * step * bend
    if kind == "quintic":
        assert smoothed.curvature_jumps().max() <= 1e-9 * max(bend, 1.0)


@few
@given(seeds, st.integers(1, 8))
def test_derivatives_by_the_distance_are_those_of_the_position(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    smoothed = smooth(random_path(rng, count, helices=0.3), 0.1)
    share = rng.uniform(0.05, 0.95, len(smoothed.piece_lengths))
    s, h = smoothed.bounds[:-1] + share * smoothed.piece_lengths, 1e-5 * smoothed.piece_lengths.min()
    before, here, after = (smoothed.at(s + k * h) for k in (-1, 0, 1))
    assert np.linalg.norm(here.tangent, axis=1) == pytest.approx(1, abs=1e-14)
    for order in range(3):
        scale = np.abs(here[order + 1]).max()
        assert (after[order] - before[order]) / (2 * h) == pytest.approx(here[order + 1], abs=2e-4 * scale)


@few
@given(seeds)
def test_at_segment_bounds_a_long_path_evaluates_the_following_segment(seed: int) -> None:
    smoothed = smooth(random_path(np.random.default_rng(seed), 25, arcs=0.2, helices=0.2), 0.01)
    at_bounds = smoothed.at(smoothed.bounds).position
    gaps = np.linalg.norm(np.diff(at_bounds, axis=0), axis=1)
    assert (gaps <= smoothed.piece_lengths * (1 + 1e-9)).all()
    starts = smoothed.coefficients[:, 0]
    assert at_bounds[:-1][smoothed.piece_blend >= 0] == pytest.approx(starts, abs=1e-12)


def test_blends_that_overlap_are_shrunk_to_meet_or_refused() -> None:
    points = [(0, 0, 0), (1, 0, 0), (1, 0.3, 0), (2, 0.3, 0)]
    smoothed = smooth(Path.through(points), 0.2)
    assert smoothed.remaining == pytest.approx([0.15, 0.15], rel=1e-15)
    with pytest.warns(ModelWarning, match=r"than requested at vertices 1, 2; at vertex 1 0\.15 of 0\.2 m") as message:
        smooth(Path.through(points), 0.2)
    assert [(each.message.name, each.message.value) for each in message] == [("vertex 1", (1, 2))]  # type: ignore[union-attr]
    with pytest.warns(ModelWarning, match=r"at vertices 3, 4; at vertex 3 0.025 of 0.03 m") as message:
        smooth(Path.through([*points, (2, 0.35, 0), (3, 0.35, 0)]), [0.05, 0.1, 0.03, 0.03])
    assert message[0].message.value == (3, 4)  # type: ignore[union-attr]
    assert len(smoothed.piece_lengths) == 4  # nothing is left of the middle segment
    assert smooth(Path.through(points), [0.2, 0.1]).remaining == pytest.approx([0.2, 0.1], rel=1e-15)
    with pytest.raises(ModelError, match=r"segment 1, 0\.3 m long"):
        smooth(Path.through(points), 0.2, overlap="refuse")


@given(seeds, st.floats(-3, 1))
def test_no_blends_cross(seed: int, exponent: float) -> None:
    path = random_path(np.random.default_rng(seed), 6, helices=0.2)
    remaining = np.concatenate([[0.0], smooth(path, 10**exponent).remaining, [0.0]])
    assert (remaining[:-1] + remaining[1:] <= path.lengths * (1 + 1e-12)).all()


def test_corners_in_parts_are_rounded_as_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    path = random_path(np.random.default_rng(11), 12, arcs=0.3, helices=0.4)
    whole = smooth(path, deviation=1e-3)
    monkeypatch.setattr(rounding, "SETTINGS", replace(rounding.SETTINGS, block=2))
    monkeypatch.setattr(blends, "SEARCH", replace(blends.SEARCH, block=2))
    parts = smooth(path, deviation=1e-3)
    assert parts.remaining == pytest.approx(whole.remaining, rel=1e-9)
    assert parts.shape == pytest.approx(whole.shape, rel=1e-9)


def test_a_vertex_without_a_corner_stays_straight() -> None:
    smoothed = smooth(Path.through([(0, 0, 0), (1, 0, 0), (3, 0, 0)]), deviation=1e-3)
    assert smoothed.length == pytest.approx(3, abs=1e-14)
    assert smoothed.curvature(smoothed.sample_distances()).max() < 1e-12


CORNER = Path.through([(0, 0, 0), (1, 0, 0), (1, 1, 0)])


@pytest.mark.parametrize(
    ("requested", "message"),
    [
        ({}, "either"),
        ({"remaining": 0.1, "deviation": 0.1}, "either"),
        ({"remaining": 0.0}, "remaining 0.0 m is not positive"),
        ({"remaining": float("nan")}, "remaining nan"),
        ({"remaining": [0.1, 0.1]}, "each of the 1 vertices"),
        ({"remaining": "wide"}, "not numeric"),
        ({"deviation": -1.0}, "deviation -1.0 m is not positive"),
        ({"remaining": 0.1, "kind": "septic"}, "septic"),
        ({"remaining": 0.1, "overlap": "cross"}, "cross"),
        ({"remaining": 0.1, "shape": 0.0}, "shape 0.0 is not positive"),
        ({"remaining": 0.1, "shape": 6.0, "kind": "cubic"}, "cusp"),
        ({"remaining": 0.1, "shape": float("nan")}, "shape nan"),
        ({"remaining": 0.1, "shape": "round"}, "not numeric"),
        ({"remaining": 0.1, "shape": [1.0, 2.0]}, "each of the 1 vertices"),
    ],
)
def test_a_blend_that_cannot_be_is_a_named_error(requested: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        smooth(CORNER, **requested)


@pytest.mark.parametrize("bad", [(0.0, 1.0), (3.0, 0.0), (3.0, 4.0), (3.0, float("nan"))])
def test_closed_forms_refuse_invalid_corners(bad: tuple[float, float]) -> None:
    with pytest.raises(ModelError, match=r"corner: .* (must be positive and finite|is above pi)"):
        gamma(*bad)


def test_distances_off_the_path_are_a_named_error() -> None:
    smoothed = smooth(Path((Line((0, 0, 0), (1, 0, 0)), Arc.through((1, 0, 0), (1, 1, 0), (0, 2, 0)))), 0.1)
    for wrong in (-0.1, smoothed.length + 0.1, float("nan")):
        for ask in (smoothed.at, smoothed.turn, smoothed.parameter, smoothed.curvature):
            with pytest.raises(ModelError, match="outside the path"):
                ask(wrong)
    with pytest.raises(ModelError, match="vertex 1"):
        smoothed.blend(1)
