"""Whatever is wrong with a path, or with what is asked of it, is refused by name."""

from __future__ import annotations

import pytest

from models import Arc, Helix, Line, Path, SmoothPath, smooth
from models.paths import (
    Spline,
    fit_splines,
    gamma,
    gauss_newton,
    march,
    path_function,
    predictor_corrector,
    rest_to_rest,
    turn_function,
)
from tests.bad_values import (
    CHOICE,
    COUNT,
    FINITE,
    INSTANCE,
    NAN,
    NOTHING,
    POSITIVE,
    SEQUENCE,
    WHOLE,
    Bad,
    Case,
    array,
    assert_refused,
    but,
    good_calls,
    method,
    panel,
)

POINT = array(3)
LINE = Line((0, 0, 0), (1, 0, 0))
CORNER = Path.through([(0, 0, 0), (1, 0, 0), (1, 1, 0)])
ROUNDED = smooth(CORNER, 0.1)
QUATERNION: Bad = array(4) | {"zero": (0, 0, 0, 0), "long": (2, 0, 0, 0)}
ROUNDING: Bad = but(POSITIVE, "zero", "inf") | {"two": [0.1, 0.1], "list of texts": ["1"]}
DISTANCE: Bad = but(FINITE, "empty") | NOTHING | {"beyond": 9.0, "before": -1.0}
AT_CORNER = {"shape": 1.5, "angle": 1.5}


def corner() -> Path:
    return CORNER


def rounded() -> SmoothPath:
    return ROUNDED


CASES = [
    Case(
        "Line",
        Line,
        {"start": (0, 0, 0), "end": (1, 0, 0)},
        {
            "start": POINT | {"the end": (1, 0, 0)},
            "end": POINT,
            "start_orientation": QUATERNION,
            "end_orientation": QUATERNION,
        },
    ),
    Case(
        "Arc",
        Arc,
        {"start": (1, 0, 0), "center": (0, 0, 0), "axis": (0, 0, 1), "sweep": 1.0},
        {
            "start": POINT,
            "center": POINT | {"the start": (1, 0, 0)},
            "axis": POINT | {"zero": (0, 0, 0), "along the radius": (1, 0, 0)},
            "sweep": POSITIVE | NOTHING | {"two turns": 13.0},
            "start_orientation": QUATERNION,
        },
    ),
    Case(
        "Arc.about",
        Arc.about,
        {"start": (1, 0, 0), "center": (0, 0, 0), "axis": (0, 0, 1), "sweep": -1.0},
        {"start": POINT, "center": POINT, "axis": POINT, "sweep": but(POSITIVE, "negative") | NOTHING},
    ),
    Case(
        "Arc.through",
        Arc.through,
        {"start": (1, 0, 0), "via": (0, 1, 0), "end": (-1, 0, 0)},
        {"start": POINT, "via": POINT | {"in line": (0, 0, 0)}, "end": POINT | {"the start": (1, 0, 0)}},
    ),
    Case(
        "Helix",
        Helix,
        {"start": (1, 0, 0), "center": (0, 0, 0), "axis": (0, 0, 1), "sweep": 9.0, "rise": -0.1},
        {
            "start": POINT,
            "center": POINT | {"the start": (1, 0, 0)},
            "axis": POINT | {"zero": (0, 0, 0), "along the radius": (1, 0, 0)},
            "sweep": POSITIVE | NOTHING,
            "rise": FINITE | NOTHING,
            "start_orientation": QUATERNION,
        },
    ),
    Case(
        "Spline",
        Spline,
        {"coefficients": [[[0.0, 0, 0], [1, 0, 0], *[[0, 0, 0]] * 4]]},
        {"coefficients": array(1, 6, 3), "references": array(1, 4), "turns": array(1, 6, 3)},
    ),
    Case(
        "fit_splines",
        fit_splines,
        {"path": CORNER, "deviation": 0.01},
        {
            "path": INSTANCE,
            "deviation": but(POSITIVE, "inf") | NOTHING | {"two": [0.1, 0.1]},
            "angle": POSITIVE | NOTHING,
            "corners": {"high": [9], "low": [-1], "half": [0.5], "word": "a"},
        },
    ),
    Case(
        "Path",
        Path,
        {"segments": (LINE,)},
        {
            "segments": SEQUENCE
            | {
                "empty": (),
                "alone": LINE,
                "gap": (LINE, Line((2, 0, 0), (3, 0, 0))),
                "back": (LINE, Line((1, 0, 0), (0, 0, 0))),
            }
        },
    ),
    Case(
        "Path.through",
        Path.through,
        {"points": [(0, 0, 0), (1, 0, 0)]},
        {"points": array(2, 3) | {"one": [(0, 0, 0)], "twice": [(0, 0, 0)] * 2}, "orientations": array(2, 4)},
    ),
    Case(
        "smooth",
        smooth,
        {"path": CORNER, "remaining": 0.1},
        {
            "path": INSTANCE,
            "remaining": ROUNDING | NOTHING,
            "deviation": {"both": 0.1},
            "kind": CHOICE,
            "overlap": CHOICE,
            "shape": POSITIVE | {"cusp": 7.0},
        },
    ),
    *[method(rounded, name, {"distance": 0.1}, distance=DISTANCE) for name in ("at", "curvature", "turn", "parameter")],
    method(rounded, "blend", {"vertex": 0}, vertex=WHOLE | NOTHING | {"high": 9}),
    method(rounded, "sample_distances", {"per_cell": 4}, per_cell=COUNT | NOTHING, per_segment=COUNT | NOTHING),
    method(
        rounded, "by_piece", {"of_segments": 1.0}, of_segments=but(FINITE, "inf", "minus inf") | {"three": [1, 2, 3]}
    ),
    *[
        Case(function.__name__, function, {"path": ROUNDED}, {"path": INSTANCE})
        for function in (path_function, turn_function)
    ],
    Case("gamma", gamma, AT_CORNER, {"shape": POSITIVE, "angle": POSITIVE | {"turned": 4.0}, "kind": CHOICE}),
    Case("rest_to_rest", rest_to_rest, {"s": 0.5}, {"s": {"word": "a", "None": None, "mapping": {}, "nan": NAN}}),
    Case("predictor_corrector", predictor_corrector, {}, {"degree": COUNT, "corrections": WHOLE | NOTHING}),
    Case(
        "gauss_newton",
        gauss_newton,
        {},
        {
            "degree": COUNT,
            "nodes": but(SEQUENCE, "numbers") | {"zero": (0,), "half": (1.5,), "empty": (), "truth": (True,)},
        },
    ),
    Case(
        "march",
        march,
        {"mapping": predictor_corrector(5), "coefficients": ROUNDED.blend(0).coefficients, "distances": [0.0, 0.01]},
        {
            "mapping": INSTANCE,
            "coefficients": array(6, 3),
            "distances": but(array(2), "wrong shape", "empty") | {"falling": [0.1, 0.0], "negative": [-0.1]},
        },
    ),
    method(
        corner,
        "at",
        {"index": [0], "distance": [0.1]},
        index={"high": [7], "low": [-9], "half": [0.5], "word": "a", "None": None},
        distance=but(array(1), "wrong shape", "empty"),
    ),
]


@pytest.mark.parametrize("case", good_calls(CASES))
def test_valid_values_are_accepted(case: Case) -> None:
    case.call(**case.good)


@pytest.mark.parametrize(("case", "argument"), panel(CASES))
def test_bad_input_is_refused_by_name(case: Case, argument: str) -> None:
    assert_refused(case, argument)
