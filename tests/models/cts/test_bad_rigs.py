"""Whatever is wrong with a rig, its tunnel or its targets is refused by name."""

from __future__ import annotations

import numpy as np
import pytest

from models import Box, Rig, Tunnel, optimal_inverse, reference_rig, reference_tunnel, solve_table
from models.cts.clearance import Avoidance, CollisionScene, Radii, clearances, collision_free_inverse
from models.cts.rig import INCH, Branch
from models.cts.table import reachable_rolls
from tests.bad_values import (
    FINITE,
    FLAG,
    INF,
    INSTANCE,
    NONNEGATIVE,
    NOTHING,
    POSITIVE,
    SEQUENCE,
    Bad,
    Case,
    array,
    assert_refused,
    but,
    good_calls,
    panel,
)

LENGTHS = dict.fromkeys(("yaw_link_1", "yaw_link_2", "yaw_offset", "pitch_link", "sting", "goose_neck"), 0.5)
OPEN = but(array(6), "inf")
RIG, TUNNEL = reference_rig(), reference_tunnel()
TARGET = INCH * np.array([100.0, 6.0, -15.0, 0.0, 0.0])
BRANCH: Bad = INSTANCE | {"no sign": Branch(2, 0), "text": ("a", "b")}
WALLS = CollisionScene(walls=Box((10, 10, 10)))
CASES = [
    Case(
        "Rig",
        Rig,
        LENGTHS,
        {
            **dict.fromkeys(LENGTHS, POSITIVE | NOTHING),
            "lower": OPEN | {"never": (INF,) * 6},
            "upper": OPEN | {"never": (-INF,) * 6},
        },
    ),
    Case("reference_rig", reference_rig, {}, {"lower": OPEN, "upper": OPEN}),
    Case(
        "Tunnel",
        Tunnel,
        {"center": (0, 0, 0), "ranges": (1, 1, 1)},
        {
            "center": array(3),
            "ranges": array(3) | {"zero": (0, 1, 1), "negative": (-1, 1, 1)},
            "weights": array(3) | {"negative": (-1, 1, 1)},
        },
    ),
    Case(
        "optimal_inverse",
        optimal_inverse,
        {"rig": RIG, "tunnel": TUNNEL},
        {"rig": INSTANCE, "tunnel": INSTANCE, "branch": BRANCH, "rate_weight": NONNEGATIVE | NOTHING, "limits": FLAG},
    ),
    Case(
        "solve_table",
        solve_table,
        {"rig": RIG, "tunnel": TUNNEL, "targets": [TARGET]},
        {
            "rig": INSTANCE,
            "tunnel": INSTANCE,
            "targets": but(array(1, 5), "nan", "inf") | {"none": np.zeros((0, 5)), "flat": TARGET},
            "branches": SEQUENCE | {"empty": [], "no sign": [Branch(2, 0)]},
            "previous": FINITE | NOTHING | {"two": [0.0, 0.0]},
            "in_sequence": FLAG,
            "rate_weight": NONNEGATIVE | NOTHING,
            "avoidance": but(INSTANCE, "None") | {"empty": Avoidance(CollisionScene())},
        },
    ),
    Case(
        "Avoidance",
        Avoidance,
        {"scene": WALLS},
        {
            "scene": INSTANCE,
            "clearance": but(FINITE, "minus inf") | NOTHING,
            "weight": NONNEGATIVE | NOTHING,
            "width": POSITIVE | NOTHING,
            "softness": POSITIVE | NOTHING,
            "radii": but(INSTANCE, "None"),
        },
    ),
    Case(
        "collision_free_inverse",
        collision_free_inverse,
        {"rig": RIG, "tunnel": TUNNEL, "avoidance": Avoidance(WALLS)},
        {
            "rig": INSTANCE,
            "tunnel": INSTANCE,
            "branch": BRANCH,
            "avoidance": INSTANCE | {"empty": Avoidance(CollisionScene())},
            "rate_weight": NONNEGATIVE | NOTHING,
        },
    ),
    Case(
        "clearances",
        clearances,
        {"rig": RIG, "q": np.zeros(6), "scene": WALLS},
        {
            "rig": INSTANCE,
            "q": array(6),
            "scene": INSTANCE | {"empty": CollisionScene()},
            "radii": but(INSTANCE, "None"),
        },
    ),
    Case(
        "CollisionScene",
        CollisionScene,
        {"walls": Box((10, 10, 10))},
        {"walls": but(INSTANCE, "None"), "solids": SEQUENCE | {"alone": Box((1, 1, 1))}, "capsules": SEQUENCE},
    ),
    Case("Radii", Radii, {}, dict.fromkeys(("yaw", "pitch", "sting"), NONNEGATIVE | NOTHING)),
    Case(
        "reachable_rolls",
        reachable_rolls,
        {"rig": RIG, "target": TARGET},
        {"rig": INSTANCE, "target": array(5), "branch": BRANCH},
    ),
]


@pytest.mark.parametrize("case", good_calls(CASES))
def test_valid_values_are_accepted(case: Case) -> None:
    case.call(**case.good)


@pytest.mark.parametrize(("case", "argument"), panel(CASES))
def test_bad_input_is_refused_by_name(case: Case, argument: str) -> None:
    assert_refused(case, argument)
