"""Every invalid machine or argument is refused by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from models import (
    CollisionScene,
    CollisionShape,
    FixedBase,
    Foot,
    Foothold,
    FreeFloating,
    Link,
    MovingObstacle,
    Path,
    Scara,
    Sphere,
    Stance,
    Standing,
    Support,
    find_wheels,
    footprint,
    planar_chain,
    rectangle,
    scara_along,
    smooth,
    with_wheels,
)
from models.machines.machine import with_tip
from models.machines.standing import tip_spring
from tests.bad_values import (
    CALLABLE,
    CHOICE,
    FINITE,
    FLAG,
    INF,
    INSTANCE,
    LIMIT,
    MAPPING,
    NAME,
    NONNEGATIVE,
    NOTHING,
    POSITIVE,
    SEQUENCE,
    UNKNOWN,
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
from tests.models.machines.armoured import armoured_arm

ARMOURED = FixedBase(armoured_arm())
CHAIN = planar_chain([1.0, 0.8], [2.0, 1.0], base=Link("hull", 20.0, inertia=np.eye(3)))
BOLTED = FixedBase(CHAIN)
FLOATING = FreeFloating(CHAIN, "planar")
SUPPORT = rectangle((-1.0, 1.0), (-1.0, 1.0))
STANDING = Standing(CHAIN, support=SUPPORT)
ARM = Scara(0.4, 0.35)
PATH = smooth(Path.through([(0.3, 0.0, 0.0), (0.5, 0.0, 0.0), (0.5, 0.2, 0.0)]), 0.05)
FOOT = Link("foot", 2.0, inertia=np.eye(3), collisions=(CollisionShape("box", (0.2, 0.2, 0.1)),))
FOOTED = planar_chain([1.0], [1.0], base=FOOT)
NOT_EMPTY = but(array(3), "empty")
ROWS: Bad = but(SEQUENCE, "numbers") | {
    "empty": [],
    "twice": [3, 3],
    "high": [6],
    "half": [1.5],
    "digits": ["3"],
    "truths": [True],
}
ENDLESS = but(array(4), "inf")
PLACED: dict[str, Bad] = {"base": array(3), "q": array(2)}
AT = {"base": [0.0, 0.0, 0.0], "q": [0.3, 0.5]}
MOVING = {**AT, "joint_rates": [0.1, 0.1]}
DRIVEN: dict[str, Any] = {"q": [0.3, 0.5], "qd": [0.0, 0.0], "qdd": [0.0, 0.0]}
JOINTS: dict[str, Bad] = {"q": array(2), "qd": array(2), "qdd": array(2)}


def bolted() -> FixedBase:
    return BOLTED


def floating() -> FreeFloating:
    return FLOATING


def standing() -> Standing:
    return STANDING


def ground() -> Support:
    return SUPPORT


def arm() -> Scara:
    return ARM


BOLTED_CASES = [
    Case(
        "CollisionScene",
        lambda **options: CollisionScene(**options),
        {"machine": ARMOURED, "obstacles": [Sphere(0.1, (2.0, 0.0, 0.0))], "clearance": 0.01},
        {
            "obstacles": SEQUENCE | {"array": np.ones(3), "two": [Sphere(0.1, (2.0, 0.0, 0.0)), 1.0]},
            "clearance": NONNEGATIVE,
            "ignored": SEQUENCE | {"unknown": [("link2", "nobody")], "three": [("link2", "link4", "link6")]},
            "srdf": {"number": 3, "list": ["a"], "object": object(), "nowhere": "/nowhere/at/all.srdf"},
            "folders": {"number": 3, "word": "a", "numbers": [1, 2], "object": object()},
            "missing": CHOICE,
            "limits": FLAG,
        },
    ),
    Case(
        "MovingObstacle",
        MovingObstacle,
        {"shape": Sphere(0.1, (0.0, 0.0, 0.0)), "position": lambda time: (time, 0.0, 0.0)},
        {
            "shape": INSTANCE,
            "position": CALLABLE | {"two": lambda time: (time, 0.0), "breaks": lambda time: 1 / 0},
            "rotation": but(CALLABLE, "None") | {"two": lambda time: np.eye(2), "words": lambda time: "a"},
        },
    ),
    Case(
        "FixedBase", FixedBase, {"robot": CHAIN}, {"robot": INSTANCE, "translation": array(3), "rotation": rotation()}
    ),
    method(bolted, "world_from_base", {"base": ()}, base=NOT_EMPTY),
    *[
        method(bolted, name, {"base": (), "q": [0.3, 0.5]}, base=NOT_EMPTY, q=array(2))
        for name in ("tip_pose", "tip_jacobian")
    ],
    *[method(bolted, name, {**MOVING, "base": ()}, joint_rates=array(2)) for name in ("tip_twist", "base_rate")],
    method(bolted, "manipulability", {"base": (), "q": [0.3, 0.5], "rows": (3, 4)}, q=array(2), rows=ROWS),
    Case(
        "with_tip",
        with_tip,
        {"machine": BOLTED, "link": "link1"},
        {"machine": INSTANCE, "link": UNKNOWN, "translation": array(3)},
    ),
]
FLOATING_CASES = [
    Case(
        "FreeFloating",
        FreeFloating,
        {"robot": CHAIN, "base": "planar"},
        {"robot": INSTANCE, "base": CHOICE, "conserved_momentum": array(3)},
    ),
    method(floating, "world_from_base", {"base": [0, 0, 0]}, base=array(3)),
    *[
        method(floating, name, AT, **PLACED)
        for name in ("tip_pose", "tip_jacobian", "momentum_matrices", "jacobians", "manipulability")
    ],
    *[
        method(floating, name, MOVING, **PLACED, joint_rates=array(2))
        for name in ("tip_twist", "base_twist", "base_rate")
    ],
    method(floating, "twist_of_rate", {"base": [0, 0, 0], "base_rate": [0, 0, 1]}, base=array(3), base_rate=array(3)),
    method(
        floating, "momentum", {**MOVING, "base_twist": [0, 0, 1]}, **PLACED, joint_rates=array(2), base_twist=array(3)
    ),
    method(
        floating,
        "momentum_residual",
        {**MOVING, "base_rate": [0, 0, 1]},
        **PLACED,
        joint_rates=array(2),
        base_rate=array(3),
    ),
]
ACTUATOR_CASES = [
    Case(
        "with_wheels",
        with_wheels,
        {"robot": CHAIN, "axes": np.eye(3), "inertia": 0.02},
        {
            "robot": INSTANCE,
            "axes": but(array(3, 3), "wrong shape") | {"of two": np.eye(2), "zero": np.zeros((3, 3))},
            "inertia": POSITIVE,
            "momentum": LIMIT,
            "torque": LIMIT,
            "mass": NONNEGATIVE,
            "translations": array(3, 3),
            "link": but(UNKNOWN, "None"),
        },
    ),
    Case("find_wheels", find_wheels, {"robot": CHAIN}, {"robot": INSTANCE}),
]
STANDING_CASES = [
    Case(
        "Standing",
        Standing,
        {"robot": CHAIN, "support": SUPPORT},
        {
            "robot": INSTANCE,
            "support": INSTANCE,
            "gravity": POSITIVE | NOTHING,
            "most_stable_point": array(2),
            "half_widths": array(2) | {"zero": (0, 1), "negative": (-1, 1)},
            "translation": array(3),
            "rotation": rotation(),
        },
    ),
    *[
        method(standing, name, DRIVEN, **JOINTS, wrenches=SEQUENCE)
        for name in ("ground_reaction", "zero_moment_point", "joint_torques")
    ],
    method(
        standing,
        "zmp_rows",
        {"q": [0.3, 0.5], "qd": [0.0, 0.0], "point": (0.0, 0.0)},
        q=array(2),
        qd=array(2),
        point=array(2),
        wrenches=SEQUENCE,
    ),
    *[
        method(standing, name, {"point": (0.0, 0.0)}, point=array(2))
        for name in ("stability_index", "nearest_reachable")
    ],
    method(standing, "tip_wrench", {"force": (0, 0, 1)}, force=array(3), moment=array(3)),
    Case(
        "tip_spring",
        tip_spring,
        {"machine": STANDING, "stiffness": (1, 1, 1), "rest": (0, 0, 0)},
        {"machine": INSTANCE, "stiffness": array(3), "rest": array(3)},
    ),
    Case(
        "Support",
        Support,
        {"vertices": [(0, 0), (1, 0), (0, 1)]},
        {
            "vertices": array(3, 2)
            | {
                "flat": [(0, 0), (1, 0), (2, 0)],
                "two": [(0, 0), (1, 0)],
                "twice": [(0, 0), (0, 0), (1, 1), (0, 1)],
                "hollow": [(0, 0), (1, 0), (0.1, 0.1), (0, 1)],
                "crossed": [(0, 0), (1, 1), (1, 0), (0, 1)],
            }
        },
    ),
    *[method(ground, name, {"point": (0, 0)}, point=array(2)) for name in ("distances", "margin")],
    Case(
        "rectangle",
        rectangle,
        {"x": (-1, 1), "y": (-1, 1)},
        {"x": array(2) | {"backwards": (1, -1)}, "y": array(2) | {"flat": (1, 1)}},
    ),
    Case(
        "footprint",
        footprint,
        {"robot": FOOTED},
        {
            "robot": INSTANCE,
            "q": array(1),
            "rotation": rotation(),
            "links": SEQUENCE | {"unknown": ["nobody"], "empty": []},
            "depth": NONNEGATIVE | NOTHING,
        },
    ),
]
SCARA_CASES = [
    Case(
        "Scara",
        Scara,
        {"upper_arm": 0.4, "forearm": 0.3},
        {
            "upper_arm": POSITIVE | NOTHING,
            "forearm": POSITIVE | NOTHING,
            "mount": array(3),
            "lower": ENDLESS | {"never": (INF,) * 4},
            "upper": ENDLESS | {"never": (-INF,) * 4},
            "names": SEQUENCE | {"twice": ("a", "a", "b", "c"), "empty": ("", "b", "c", "d"), "one word": "abcd"},
        },
    ),
    method(
        arm,
        "inverse",
        {"position": (0.4, 0.2, 0.0)},
        position=array(3) | {"far": (2, 0, 0), "near": (0, 0, 0)},
        yaw=FINITE | NOTHING,
        elbow=CHOICE,
    ),
    method(arm, "forward", {"joints": (0.1, 0.2, 0, 0)}, joints=array(4)),
    method(arm, "inverse_expression", {"pose": (0.4, 0.2, 0, 0)}, pose=array(4), elbow=CHOICE),
    method(arm, "inverse_rates", {}, elbow=CHOICE),
    Case(
        "scara_along",
        scara_along,
        {"scara": ARM, "path": PATH},
        {"scara": INSTANCE, "path": INSTANCE, "elbow": CHOICE, "clearance": NONNEGATIVE | NOTHING},
    ),
]
ON_FEET: dict[str, Any] = {
    "robot": FOOTED,
    "feet": {"only": Foot("foot", SUPPORT)},
    "footholds": {"only": Foothold((0, 0, 0))},
}


def stance() -> Stance:
    return Stance.on(**ON_FEET)


STANCE_CASES = [
    Case(
        "Foot",
        Foot,
        {"link": "foot"},
        {"link": NAME, "sole": but(INSTANCE, "None"), "translation": array(3), "rotation": rotation()},
    ),
    Case("Foot.of", Foot.of, {"robot": FOOTED, "link": "foot"}, {"robot": INSTANCE, "link": UNKNOWN}),
    Case("Foothold", Foothold, {"position": (0.0, 0.0, 0.0)}, {"position": array(3) | NOTHING, "rotation": rotation()}),
    Case(
        "Foothold.level",
        Foothold.level,
        {"x": 0.0, "y": 0.0},
        dict.fromkeys(("x", "y", "heading", "height"), FINITE | NOTHING),
    ),
    Case(
        "Stance.on",
        Stance.on,
        ON_FEET,
        {
            "robot": INSTANCE,
            "feet": MAPPING | {"none": {}, "of words": {"only": "foot"}},
            "footholds": MAPPING
            | {"none": {}, "of words": {"only": "here"}, "unknown": {"other": Foothold((0, 0, 0))}},
            "gravity": POSITIVE | NOTHING,
        },
    ),
    method(stance, "sole_frame", {"name": "only", "q": [0.0]}, name=UNKNOWN, q=array(1)),
    method(stance, "sole_corners", {"name": "only", "q": [0.0]}, name=UNKNOWN, q=array(1)),
    method(stance, "center_of_mass", {"q": [0.0]}, q=array(1)),
    *[
        method(stance, name, {"q": [0.0], "qd": [0.0], "qdd": [0.0], "others": {}}, q=array(1), others=MAPPING)
        for name in ("loads", "joint_torques")
    ],
]
CASES = [*BOLTED_CASES, *FLOATING_CASES, *ACTUATOR_CASES, *STANDING_CASES, *STANCE_CASES, *SCARA_CASES]


@pytest.mark.parametrize("case", good_calls(CASES))
def test_valid_values_are_accepted(case: Case) -> None:
    case.call(**case.good)


@pytest.mark.parametrize(("case", "argument"), panel(CASES))
def test_bad_input_is_refused_by_name(case: Case, argument: str) -> None:
    assert_refused(case, argument)
