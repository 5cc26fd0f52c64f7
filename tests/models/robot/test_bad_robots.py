"""Every invalid robot, part or argument is refused by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import models
from models import CollisionShape, Joint, Link, Mimic, Robot, VisualShape, Wrench, example_robot, planar_chain
from tests.bad_values import (
    CHOICE,
    FINITE,
    FLAG,
    INF,
    INSTANCE,
    LIMIT,
    MAPPING,
    NAME,
    NAN,
    NONNEGATIVE,
    NOTHING,
    NUMBER,
    SEQUENCE,
    TEXT,
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

HULL = Link("hull", 20.0, inertia=np.eye(3))
CHAIN = planar_chain([1.0, 0.8], [2.0, 1.0], base=HULL)
TURN = Joint("turn", "revolute", "a", "b")
WELD = Joint("weld", "fixed", "a", "b")
SPATIAL = array(3)
PLACEMENT: Bad = but(INSTANCE, "None") | {"short": (np.eye(3),), "no turn": (np.zeros((2, 2)), (0, 0, 0))}
KINEMATICS: dict[str, Bad] = {"robot": INSTANCE, "q": array(2), "world_from_base": PLACEMENT}
MOTION: dict[str, Bad] = {"q": array(2), "qd": array(2), "qdd": array(2)}
DYNAMICS: dict[str, Bad] = {
    "wrenches": SEQUENCE | {"unknown link": [Wrench("nobody")]},
    "gravity": SPATIAL,
    "base_motion": but(SEQUENCE, "None") | {"short": (np.zeros(6),), "no twist": (np.zeros(3), np.zeros(6))},
}


def chain() -> Robot:
    return CHAIN


def turn() -> Joint:
    return TURN


def crate() -> CollisionShape:
    return CollisionShape("box", (1, 1, 1))


def of(name: str, good: dict[str, Any], /, **bad: Bad) -> Case:
    """A function of a robot, by its name in the face."""
    return Case(name, getattr(models, name), {"robot": CHAIN, **good}, {"robot": INSTANCE, **bad})


AT = {"q": [0.3, 0.5]}
MOVING = {**AT, "qd": [0.1, 0.2]}
DRIVEN = {**MOVING, "qdd": [0.0, 0.0]}

PARTS = [
    Case(
        "Link",
        Link,
        {"name": "arm", "mass": 1.0},
        {
            "name": NAME,
            "mass": NONNEGATIVE | NOTHING,
            "center_of_mass": SPATIAL,
            "inertia": array(3, 3)
            | {"skewed": np.triu(np.ones((3, 3))), "negative": -np.eye(3), "no triangle": np.diag([1.0, 0.0, 0.0])},
            "any_inertia": FLAG,
            "collisions": SEQUENCE | {"alone": crate()},
            "visuals": SEQUENCE | {"alone": crate(), "collisions": [crate()]},
        },
    ),
    Case(
        "CollisionShape",
        CollisionShape,
        {"kind": "box", "size": (1, 1, 1)},
        {
            "kind": CHOICE,
            "size": SPATIAL | {"negative": (1, -1, 1), "zero": (0, 1, 1)},
            "file": TEXT,
            "translation": SPATIAL,
            "rotation": rotation(),
        },
    ),
    Case(
        "VisualShape",
        VisualShape,
        {"kind": "box", "size": (1, 1, 1)},
        {
            "kind": CHOICE,
            "size": SPATIAL | {"negative": (1, -1, 1), "zero": (0, 1, 1)},
            "file": TEXT,
            "translation": SPATIAL,
            "rotation": rotation(),
            "color": array(4) | {"above 1": (1, 1, 1, 2), "negative": (-0.1, 0, 0, 1)},
        },
    ),
    method(
        crate, "placed", {"rotation": np.eye(3), "translation": np.zeros(3)}, rotation=rotation(), translation=SPATIAL
    ),
    Case("Mimic", Mimic, {"joint": "a"}, {"joint": NAME, "multiplier": FINITE | NOTHING, "offset": FINITE | NOTHING}),
    Case(
        "Joint",
        Joint,
        {"name": "turn", "kind": "revolute", "parent": "a", "child": "b"},
        {
            "name": NAME,
            "kind": CHOICE,
            "parent": NAME,
            "child": NAME,
            "translation": SPATIAL,
            "rotation": rotation(),
            "axis": SPATIAL | {"zero": (0, 0, 0)},
            "lower": NUMBER | NOTHING | {"inf": INF},
            "upper": NUMBER | NOTHING | {"minus inf": -INF},
            "velocity": but(LIMIT, "zero") | NOTHING,
            "effort": but(LIMIT, "zero") | NOTHING,
            "mimic": but(INSTANCE, "None"),
        },
    ),
    method(turn, "locked", {"position": 0.1}, position=FINITE | NOTHING),
    method(turn, "placed", {"position": 0.1}, position=FINITE | NOTHING),
    Case(
        "Robot",
        Robot,
        {"links": (Link("a"), Link("b")), "joints": (TURN,)},
        {
            "links": SEQUENCE | {"empty": (), "twice": (Link("a"), Link("a")), "few": (Link("a"),), "alone": Link("a")},
            "joints": SEQUENCE
            | {
                "empty": (),
                "alone": TURN,
                "twice": (WELD, WELD),
                "unknown": (Joint("weld", "fixed", "a", "c"),),
                "to itself": (Joint("weld", "fixed", "a", "a"),),
                "follows nobody": (Joint("turn", "revolute", "a", "b", mimic=Mimic("nobody")),),
            },
            "tip": but(UNKNOWN, "None"),
            "tip_translation": SPATIAL,
            "tip_rotation": rotation(),
            "name": NOTHING | TEXT,
        },
    ),
    method(chain, "unit", {"per": "/s"}, per=NOTHING | TEXT),
    method(chain, "link", {"name": "hull"}, name=UNKNOWN),
    method(chain, "joint", {"name": "joint1"}, name=UNKNOWN),
    method(chain, "path_to", {"name": "link2"}, name=UNKNOWN),
    Case("example_robot", example_robot, {"name": "six_axis"}, {"name": CHOICE}),
    Case(
        "planar_chain",
        planar_chain,
        {"lengths": [1.0, 0.8], "masses": [1.0, 1.0]},
        {
            "lengths": array(2) | {"negative": [1.0, -1.0], "zero": [0.0, 1.0]},
            "masses": array(2) | {"negative": [1.0, -1.0]},
            "inertias": array(2) | {"negative": [1.0, -1.0]},
            "mount": array(2),
            "base": but(INSTANCE, "None"),
        },
    ),
]

REBUILT = [
    of(
        "lock_joints",
        {"positions": {"joint1": 0.1}},
        positions=but(MAPPING | NOTHING, "None")
        | {"unknown": {"joint9": 0.0}, "nan": {"joint1": NAN}, "digits": {"joint1": "1"}, "number": {1: 0.0}},
    ),
    of("move_tip", {"tip": "link1"}, tip=UNKNOWN, translation=SPATIAL, rotation=rotation()),
    of(
        "with_load",
        {"link": "link1", "mass": 1.0},
        link=UNKNOWN,
        mass=NONNEGATIVE | NOTHING,
        center_of_mass=SPATIAL,
        inertia=array(3, 3),
    ),
    of(
        "attach_tool",
        {"tool": Link("tool")},
        tool=INSTANCE,
        link=but(UNKNOWN, "None"),
        translation=SPATIAL,
        rotation=rotation(),
        prefix=NOTHING | TEXT,
        keep_tip=FLAG,
    ),
    Case(
        "merge_robots",
        models.merge_robots,
        {"base": HULL, "arms": {"left_": planar_chain([1.0], [1.0])}},
        {
            "base": INSTANCE,
            "arms": MAPPING | NOTHING | {"empty": {}, "no robot": {"a_": 3}, "no prefix": {3: CHAIN}},
            "links": MAPPING | {"unknown arm": {"a_": "hull"}, "unknown link": {"left_": "nobody"}},
            "translations": MAPPING | {"word": {"left_": "a"}},
            "rotations": MAPPING | {"zero": {"left_": np.zeros((3, 3))}},
        },
    ),
    of(
        "mount_on_rail",
        {"axis": (0, 1, 0), "lower": -1.0, "upper": 1.0},
        axis=SPATIAL | {"zero": (0, 0, 0)},
        lower=NUMBER | {"above": 2.0},
        upper=NUMBER | {"below": -2.0},
        velocity=NUMBER | {"negative": -1.0},
        name=NAME | {"in use": "hull"},
    ),
    of("add_prefix", {"prefix": "a_"}, prefix=NOTHING | TEXT),
    of("reroot", {"root": "link2"}, root=UNKNOWN),
    of("subtree", {"root": "link1"}, root=UNKNOWN, tip=but(UNKNOWN, "None")),
    of("prune", {}, keep=SEQUENCE | {"unknown": ["nobody"]}),
    of("simplify", {}, keep=SEQUENCE | {"unknown": ["nobody"]}),
]

POSES = (
    "center_of_mass",
    "center_of_mass_jacobian",
    "centers_of_mass",
    "link_frames",
    "link_jacobians",
    "momentum_matrix",
    "robot_inertia",
    "tip_jacobian",
    "tip_pose",
)
MOTIONS = [
    *[of(name, AT, **KINEMATICS) for name in POSES],
    of("mass_matrix", AT, q=array(2)),
    of("frame_jacobian", {**AT, "link": "link1"}, **KINEMATICS, link=UNKNOWN, point=SPATIAL),
    of("momentum", MOVING, **KINEMATICS, qd=array(2), about=SPATIAL),
    of("center_of_mass_motion", DRIVEN, **{**KINEMATICS, **MOTION}),
    *[of(name, DRIVEN, **{**KINEMATICS, **MOTION, **DYNAMICS}) for name in ("inverse_dynamics", "base_reaction")],
    Case(
        "Wrench",
        Wrench,
        {"link": "link1", "force": (0, 0, 1.0)},
        {"link": NAME, "force": SPATIAL, "moment": SPATIAL, "point": SPATIAL},
    ),
]
CASES = [*PARTS, *REBUILT, *MOTIONS]


@pytest.mark.parametrize("case", good_calls(CASES))
def test_valid_values_are_accepted(case: Case) -> None:
    case.call(**case.good)


@pytest.mark.parametrize(("case", "argument"), panel(CASES))
def test_bad_input_is_refused_by_name(case: Case, argument: str) -> None:
    assert_refused(case, argument)
