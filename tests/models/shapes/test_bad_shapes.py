"""Shapes of no size, without a place or of something that is no number are refused by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from models import Box, Capsule, Cylinder, Frame, HalfSpace, Mesh, ModelError, Sphere
from models.shapes.distance import distance, soft_minimum
from tests.bad_values import (
    INF,
    INSTANCE,
    NONNEGATIVE,
    NOTHING,
    POSITIVE,
    Bad,
    Case,
    array,
    assert_refused,
    but,
    good_calls,
    method,
    panel,
    rotation,
)

CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], dtype=float)
TRIANGLES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
PLACE: Bad = array(3) | NOTHING
TURN: Bad = rotation() | NOTHING
FRAME: Bad = but(INSTANCE, "None") | {
    "one part": (np.eye(3),),
    "flat": Frame(np.eye(2), np.zeros(2)),
    "nan": Frame(np.eye(3), np.array([0, 0, np.nan])),
    "words": Frame("a", "b"),
}


def a_box() -> Box:
    return Box((1, 2, 3))


def a_half_space() -> HalfSpace:
    return HalfSpace((0, 0, 1), (0, 0, 0))


CASES = [
    Case("Sphere", Sphere, {"radius": 0.1, "position": (0, 0, 0)}, {"radius": POSITIVE | NOTHING, "position": PLACE}),
    Case(
        "Capsule",
        Capsule,
        {"radius": 0.1, "start": (0, 0, 0), "end": (0, 0, 1)},
        {"radius": NONNEGATIVE | NOTHING, "start": PLACE, "end": PLACE},
    ),
    Case(
        "Capsule without radius", Capsule, {"radius": 0, "start": (0, 0, 0), "end": (0, 0, 1)}, {"end": {"0": (0,) * 3}}
    ),
    Case(
        "Cylinder",
        Cylinder,
        {"radius": 0.1, "length": 1, "position": (0, 0, 0)},
        {"radius": POSITIVE | NOTHING, "length": POSITIVE | NOTHING, "position": PLACE, "rotation": TURN},
    ),
    Case(
        "Box",
        Box,
        {"size": (1, 1, 1)},
        {
            "size": but(array(3), "inf") | {"zero": (0, 1, 1), "negative": (-1, 1, 1), "endless": (INF, INF, INF)},
            "position": PLACE,
            "rotation": TURN,
        },
    ),
    Case(
        "HalfSpace",
        HalfSpace,
        {"normal": (0, 0, 2), "point": (0, 0, 0)},
        {"normal": PLACE | {"zero": (0, 0, 0)}, "point": PLACE},
    ),
    Case(
        "Mesh",
        Mesh,
        {"vertices": CORNERS},
        {
            "vertices": array(4, 3)
            | NOTHING
            | {
                "three": CORNERS[:3],
                "flat": CORNERS * (1, 1, 0),
                "line": np.outer(range(9), (1, 2, 3)),
                "point": [[1] * 3] * 5,
            },
            "faces": {
                "beyond": [(0, 1, 4)],
                "before": [(0, 1, -1)],
                "square": [(0, 1, 2, 3)],
                "none": np.zeros((0, 3), int),
            }
            | {"half": [(0.5, 1, 2)], "words": "abc", "flat": [0, 1, 2], "a plane of them": [(0, 1, 2)]},
            "position": PLACE,
            "rotation": TURN,
            "scale": but(POSITIVE, "negative") | NOTHING | {"flat": (1, 1, 0), "two": (1, 1)},
            "file": {"both": "a.stl", "number": 3},
        },
    ),
    Case("Mesh of a file", Mesh, {}, {"file": {"number": 3, "empty": "", "bytes": b"a.stl", "object": object()}}),
    method(a_box, "placed", {"rotation": np.eye(3), "translation": (0, 0, 0)}, rotation=TURN, translation=PLACE),
    method(a_box, "reach", {"point": (0, 0, 0)}, point=PLACE),
    method(a_half_space, "reach", {"point": (0, 0, 0)}, point=PLACE),
    Case(
        "distance",
        distance,
        {"first": Box((1, 1, 1)), "second": Sphere(1.0, (2, 0, 0))},
        {
            "first": INSTANCE | {"endless": Box((INF, 1, 1))},
            "second": INSTANCE | {"endless": Box((INF, 1, 1))},
            "first_frame": FRAME,
            "second_frame": FRAME,
            "rounding": NONNEGATIVE | NOTHING,
        },
    ),
    Case(
        "distance of a half-space",
        distance,
        {"first": a_half_space(), "second": a_box()},
        {"second": {"too": a_half_space()}},
    ),
    Case(
        "soft_minimum", soft_minimum, {"values": [1.0, 2.0], "width": 0.1}, {"values": {"none": []}, "width": POSITIVE}
    ),
]
GOOD = [case for case in CASES if case.what != "Mesh of a file"]


@pytest.mark.parametrize("case", good_calls(GOOD))
def test_valid_values_are_accepted(case: Case) -> None:
    case.call(**case.good)


@pytest.mark.parametrize(("case", "argument"), panel(CASES))
def test_bad_input_is_refused_by_name(case: Case, argument: str) -> None:
    assert_refused(case, argument)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: Sphere(0.1), "position"),
        (lambda: Cylinder(0.1, 1.0), "position"),
        (lambda: HalfSpace((0, 0, 1)), "point"),
        (lambda: Box((1, 1, 1), None), "position"),
        (lambda: Box((np.inf, 1, 1)).core, "size"),
        (lambda: Capsule(0.0, (1, 0, 0), (1, 0, 0)), "radius"),
        (lambda: Mesh(), "vertices"),
        (lambda: Mesh(CORNERS[[0, 1, 2, 2]]), "vertices"),
        (lambda: Mesh(CORNERS, TRIANGLES, file="a.stl"), "file"),
        (lambda: HalfSpace((0, 0, 0), (0, 0, 0)), "normal"),
    ],
)
def test_no_size_and_no_place_are_named(make: Any, name: str) -> None:
    with pytest.raises(ModelError) as caught:
        make()
    assert caught.value.name == name
