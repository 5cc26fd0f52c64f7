"""Both mappings from distance to curve parameter: the numbers checked, generated C, orders of convergence."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path as File
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

from models import ModelError, Path, SmoothPath, smooth
from models.paths import Blend, gauss_newton, march, path_function, predictor_corrector, turn_function
from models.paths.blends import arc_length, polynomial
from ocp.motion.schedule import LineLimits, SpeedProfile, peak_acceleration, schedule
from tests.models.paths.task_paths import random_path
from tests.models.paths.test_paths import example

pytestmark = pytest.mark.filterwarnings("ignore:overlap='shrink'")  # blends of random paths may overlap
MM = 1e-3


def right_angle(remaining: float, kind: Any = "cubic") -> Blend:
    return smooth(Path.through([(-1, 0, 0), (0, 0, 0), (0, 1, 0)]), remaining, kind=kind).blend(0)


def errors(mapping: Any, blend: Blend, distances: NDArray[Any], period: float) -> tuple[float, float, float]:
    """Drift at the last sample, mm; speed error of arc length and of chord that is largest in size, mm/s."""
    u = march(mapping, blend.coefficients, distances)
    planned = np.diff(distances)
    along = arc_length(blend.coefficients, u)
    true = (np.diff(along) - planned) / period
    points = polynomial(np.repeat(blend.coefficients[None], len(u), axis=0), u)
    chord = (np.linalg.norm(np.diff(points, axis=0), axis=1) - planned) / period
    worst = [float(e[np.abs(e).argmax()]) / MM for e in (true, chord)]
    return float(along[-1] - distances[-1]) / MM, worst[0], worst[1]


def profile(path: SmoothPath) -> SpeedProfile:
    return schedule(path, LineLimits(1.0, peak_acceleration(5.0, 1.0, 200.0), 200.0)).profile


def inside(blend: Blend, plan: SpeedProfile, period: float) -> NDArray[np.float64]:
    along = plan.at(np.arange(int(plan.duration / period) + 1) * period).distance - blend.start
    return np.asarray(along[(along > 0) & (along < blend.length)])


@pytest.mark.parametrize(
    ("period", "drift", "true", "chord"),
    [(1e-3, 3.73e-3, -0.079, -0.105), (2e-3, 14.9e-3, -0.316, -0.421), (4e-3, 59.5e-3, -1.25, -1.67)],
)
def test_the_papers_mapping_errs_as_checked(period: float, drift: float, true: float, chord: float) -> None:
    blend = right_angle(150 * MM)
    distances = np.arange(1, int(blend.length / period) + 1) * period
    result = errors(predictor_corrector(), blend, distances, period)
    assert abs(result[0]) == pytest.approx(drift, rel=5e-3)
    assert result[1] == pytest.approx(true, abs=6e-3)
    assert result[2] == pytest.approx(chord, abs=6e-3)


def test_the_examples_worst_speed_error_is_that_printed_for_one_mapping_and_none_for_the_other() -> None:
    path = example("cubic")
    plan = profile(path)
    chords = []
    for vertex in (0, 1):
        blend = path.blend(vertex)
        distances = inside(blend, plan, 2e-3)
        chords.append(errors(predictor_corrector(), blend, distances, 2e-3)[2])
        drift, true, _ = errors(gauss_newton(), blend, distances, 2e-3)
        assert abs(drift) < 1e-9
        assert abs(true) < 1e-6
    assert chords[0] == pytest.approx(-0.4207, abs=1e-4)
    assert chords[1] == pytest.approx(-0.4, abs=0.05)  # next to the arc


def test_the_default_mapping_hardly_drifts_in_a_small_blend_where_the_papers_does() -> None:
    blend = right_angle(5 * MM)
    distances = np.arange(1, int(blend.length / 1e-3) + 1) * 1e-3
    assert abs(errors(gauss_newton(), blend, distances, 1e-3)[0]) < 1e-4
    assert abs(errors(predictor_corrector(), blend, distances, 1e-3)[0]) == pytest.approx(0.105, abs=1e-3)
    assert errors(predictor_corrector(), blend, distances, 1e-3)[1] == pytest.approx(-53, abs=0.5)
    blend = right_angle(150 * MM)
    distances = np.arange(1, int(blend.length / 1e-3) + 1) * 1e-3
    assert abs(errors(gauss_newton(), blend, distances, 1e-3)[0]) < 1e-9


@pytest.mark.parametrize("kind", ["cubic", "quintic"])
def test_the_drift_shrinks_by_the_order_of_the_quadrature(kind: str) -> None:
    """Trapezoid rule: 2; three Gauss nodes: 6."""
    blend, degree = right_angle(0.1, kind), 3 if kind == "cubic" else 5

    def drift(mapping: Any, steps: int) -> float:
        # inside the blend: at its ends the errors of a whole smooth curve would cancel
        distances = 0.37 * blend.length * np.arange(1, steps + 1) / steps
        return abs(errors(mapping, blend, distances, 1.0)[0])

    for mapping, order, steps in ((predictor_corrector(degree, 30), 2, 40), (gauss_newton(degree, (3,) * 5), 6, 10)):
        assert np.log2(drift(mapping, steps) / drift(mapping, 2 * steps)) == pytest.approx(order, abs=0.5)


@pytest.mark.parametrize("kind", ["cubic", "quintic"])
@pytest.mark.parametrize("period", [1e-3, 2e-3, 4e-3])
@pytest.mark.parametrize("remaining", [5, 10, 20, 50, 150])
def test_the_default_mapping_is_exact_for_every_size_and_period(kind: str, period: float, remaining: float) -> None:
    """Up to two samples in a blend of 9 mm, wherever they lie."""
    blend, mapping = right_angle(remaining * MM, kind), gauss_newton(3 if kind == "cubic" else 5)
    for first in (0.2, 0.6, 1.0):
        distances = np.arange(first * period, blend.length, period)
        drift, true, _ = errors(mapping, blend, distances, period)
        assert abs(drift) < (1e-4 if remaining < 150 else 1e-9)
        assert abs(true) < (1e-6 if period < 4e-3 or remaining > 10 else 1e-3)


def test_few_nodes_are_not_enough_for_coarse_steps() -> None:
    blend = right_angle(5 * MM)
    distances = np.arange(1, 5) * 2e-3
    coarse, fine = (abs(errors(m, blend, distances, 2e-3)[0]) for m in (gauss_newton(3, (3, 3)), gauss_newton(3)))
    assert fine < 1e-7 < 1e-3 < coarse


@pytest.mark.parametrize("wrong", [[0.2, 0.1], [np.nan], [[0.1, 0.2]], [-0.1, 0.2]])
def test_distances_that_are_no_march_are_a_named_error(wrong: Any) -> None:
    blend = right_angle(0.1)
    assert march(gauss_newton(), blend.coefficients, []).shape == (0,)
    with pytest.raises(ModelError, match="march: distances"):
        march(gauss_newton(), blend.coefficients, wrong)


@pytest.mark.parametrize("nodes", [(), (0,), (2, 2.5)])
def test_quadratures_that_are_none_are_a_named_error(nodes: Any) -> None:
    with pytest.raises(ModelError, match="nodes"):
        gauss_newton(3, nodes)


def test_the_mapping_of_a_quintic_reaches_the_distances_of_the_exact_inverse() -> None:
    path = example("quintic")
    blend = path.blend(1)
    distances = np.linspace(0, blend.length, 300)[1:-1]
    u = march(gauss_newton(5), blend.coefficients, distances)
    assert u == pytest.approx(path.parameter(blend.start + distances), abs=1e-10)


def test_a_degree_that_no_blend_has_is_a_named_error() -> None:
    for mapping in (predictor_corrector, gauss_newton):
        with pytest.raises(ModelError, match=r"degree must be .* not 4"):
            mapping(4)


@pytest.mark.parametrize("seed", range(6))
def test_the_path_as_a_function_is_the_path(seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = smooth(
        random_path(rng, 1 + 2 * seed, turns=True, helices=0.3), 0.05, kind="cubic" if seed % 2 else "quintic"
    )
    s = np.concatenate([path.bounds, rng.uniform(0, path.length, 100)])
    for function, expected in ((path_function(path), path.at(s)), (turn_function(path), path.turn(s))):
        for value, known in zip(function.map(len(s))(s[None]), expected, strict=True):
            result = np.array(value).T
            assert result == pytest.approx(known, abs=1e-9 * (1 + np.abs(known).max()))
    ends = path.at([0.0, path.length]).position
    for s_off, end in ((-1.0, ends[0]), (path.length + 1, ends[1])):
        assert np.array(path_function(path)(s_off)[0]).ravel() == pytest.approx(end, abs=1e-12)


def test_geometry_mappings_and_time_generate_c_that_agrees(tmp_path: File) -> None:
    path = smooth(random_path(np.random.default_rng(4), 4, turns=True, helices=0.3), 0.05)
    plan = schedule(path, LineLimits(0.5, 5.0, 200.0, centripetal=2.0))
    blend = path.blend(0)
    step = [0.01 * blend.length] * 2
    state = [0.1, 0.11]
    curve = blend.coefficients.ravel()
    cases: list[tuple[Any, list[Any]]] = [
        (path_function(path), [0.3 * path.length]),
        (turn_function(path), [blend.start + 0.4 * blend.length]),
        (plan.function(), [0.6 * plan.duration]),
        (predictor_corrector(5), [state, curve, step]),
        (gauss_newton(5), [state, curve, step]),
    ]
    generator = ca.CodeGenerator("both.c")
    for function, _ in cases:
        generator.add(function)
    source, library = tmp_path / "both.c", tmp_path / "both.so"
    generator.generate(f"{tmp_path}/")
    text = source.read_text()
    assert all(f"int {function.name()}(" in text for function, _ in cases)
    assert "#include <math.h>" in text
    if shutil.which("cc") is None:
        return
    command = ["cc", "-O1", "-fPIC", "-shared", str(source), "-o", str(library), "-lm"]
    subprocess.run(command, check=True)
    for function, arguments in cases:
        compiled = ca.external(function.name(), str(library))
        for a, b in zip(compiled.call(arguments), function.call(arguments), strict=True):
            assert np.array(ca.DM(a)) == pytest.approx(np.array(ca.DM(b)), rel=1e-12, abs=1e-12)
