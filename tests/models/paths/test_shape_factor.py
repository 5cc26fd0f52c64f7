"""The default shape of a quintic: least peak curvature at each corner, against a search of another kind."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from models import Arc, Helix, Line, Path, SmoothPath, smooth
from models.paths.blends import corner_shape, polynomial
from tests.models.paths.task_paths import peak_curvature, random_path, seeds

few = settings(max_examples=40)
pytestmark = pytest.mark.filterwarnings("ignore:overlap='shrink'")


def peaks(path: SmoothPath) -> Any:
    """Largest curvature of each blend. Shape (V,), 1/m."""
    u = np.linspace(0, 1, 2001)
    curve = path.coefficients[:, None]
    first, second = (polynomial(curve, u, order) for order in (1, 2))
    return (np.linalg.norm(np.cross(first, second), axis=2) / np.linalg.norm(first, axis=2) ** 3).max(axis=1)


@pytest.mark.parametrize("degrees", [0.01, 1, 5, 20, 45, 70, 90, 120, 150, 175, 179.9])
def test_between_two_lines_no_shape_bends_less(degrees: float) -> None:
    angle = np.radians(degrees)
    ours = float(corner_shape(np.array([angle]))[0])
    chord = 2 * np.sin(angle / 2)
    best = minimize_scalar(
        lambda share: peak_curvature(share * chord, angle, 1.0, "quintic"),
        bounds=(0.5, min(3, 4 / chord)),
        method="bounded",
    )
    assert peak_curvature(ours, angle, 1.0, "quintic") <= 1.001 * best.fun


def test_the_law_is_the_same_for_every_size_and_continuous_in_the_angle() -> None:
    angles = np.linspace(1e-5, np.pi, 5001)
    over_chord = corner_shape(angles) / (2 * np.sin(angles / 2))
    assert np.abs(np.diff(over_chord)).max() < 3e-3
    assert over_chord.min() > 0.85
    assert over_chord.max() < 2.5
    for scale in (1e-3, 1.0, 1e2):
        path = smooth(Path.through(scale * np.array([(-1, 0, 0), (0, 0, 0), (0, 1, 0)])), 0.3 * scale)
        assert path.shape == pytest.approx(corner_shape(np.array([np.pi / 2])), rel=1e-9)


@pytest.mark.parametrize(
    ("degrees", "how"),
    [(each, "remaining") for each in (0.01, 2, 30, 90)] + [(each, "deviation") for each in (1, 10, 30)],
)
@pytest.mark.parametrize("side", ["out", "in"])
def test_a_tangent_joint_of_line_and_arc_permits_the_speed_of_the_arc(how: str, degrees: float, side: str) -> None:
    """v^2 curvature is the centripetal acceleration: the speed is as one over the root of the curvature.

    Deviations are up to 1 % of the radius.
    """
    radius = 0.2
    arc = Arc.about((0, 0, 0), (0, radius, 0), (0, 0, 1), 1.8)
    line = Line((-1, 0, 0), (0, 0, 0))
    segments: tuple[Any, ...] = (line, arc)
    if side == "in":
        back = Arc.about(arc.end, arc.center, -np.asarray(arc.axis), 1.8)
        segments = (back, Line((0, 0, 0), (-1, 0, 0)))
    remaining = radius * np.radians(degrees) / 2
    request: dict[str, Any] = {"remaining": remaining}
    if how == "deviation":
        request = {"deviation": remaining**2 / radius / 8}
    path = smooth(Path(segments), **request)
    assert (1 / radius / peaks(path)[0]) ** 0.5 >= 0.99
    old = smooth(Path(segments), **request, shape=1.5)
    assert (1 / radius / peaks(old)[0]) ** 0.5 == pytest.approx(0.79, abs=5e-3)


def test_arcs_and_helices_that_go_on_are_left_as_they_are() -> None:
    first = Arc.about((0, 0, 0), (0, 0.1, 0), (0, 0, 1), 1.0)
    second = Arc.about(first.end, (0, 0.1, 0), (0, 0, 1), 1.0)
    path = smooth(Path((first, second)), 0.03)
    assert peaks(path) * 0.1 == pytest.approx(1, abs=2e-3)
    screw = Helix((0, 0, 0), (0, 0.1, 0), (0, 0, 1), 2.0, 0.02)
    more = Helix(screw.end, (0, 0.1, 0.02), (0, 0, 1), 2.0, 0.02)
    path = smooth(Path((screw, more)), deviation=1e-6)
    assert peaks(path) == pytest.approx(screw.curvature, rel=2e-3)


@few
@given(seeds, st.integers(2, 8), st.floats(-3, -1.5))
def test_no_other_shape_is_better_anywhere(seed: int, count: int, exponent: float) -> None:
    rng = np.random.default_rng(seed)
    path = random_path(rng, count, helices=0.2)
    ours = smooth(path, 10**exponent)
    best = peaks(ours)
    for share in rng.uniform(0.6, 1.6, 4):
        other = smooth(path, ours.remaining, shape=np.minimum(share * ours.shape, 4.0))
        assert (best <= 1.02 * peaks(other)).all()


def test_a_cubic_keeps_the_shape_of_the_paper() -> None:
    path = Path.through([(0, 0, 0), (1, 0, 0), (1, 1, 0), (2, 2, 0)])
    assert smooth(path, 0.1, kind="cubic").shape == pytest.approx([3.0, 3.0])
