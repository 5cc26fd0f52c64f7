from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import (
    CollisionShape,
    FixedBase,
    FreeFloating,
    Joint,
    Link,
    Robot,
    add_prefix,
    attach_tool,
    lock_joints,
    planar_chain,
    prune,
    simplify,
    tip_jacobian,
    tip_pose,
)
from tests.models.robot.trees import numeric, random_inertia, random_robot, random_rotation, refused, seeds


def joint(name: str, parent: str, child: str, **fields: Any) -> Joint:
    return Joint(name, fields.pop("kind", "revolute"), parent, child, **fields)


def test_joints_are_sorted_so_that_parents_come_first() -> None:
    links = [Link(name) for name in "abcde"]
    joints = [
        joint("de", "d", "e"),
        joint("ab", "a", "b"),
        joint("bd", "b", "d", kind="fixed"),
        joint("ac", "a", "c", kind="prismatic"),
    ]
    robot = Robot(tuple(links), tuple(joints), tip="e")
    assert [j.name for j in robot.joints] == ["ab", "bd", "de", "ac"]
    assert robot.joint_names == ("ab", "de", "ac")
    assert robot.dof == 3
    assert robot.root == "a"
    assert [j.name for j in robot.path_to("e")] == ["ab", "bd", "de"]
    assert robot.path_to("a") == ()


@given(seeds, st.integers(1, 12))
def test_every_parent_precedes_its_children_and_a_valid_order_is_kept(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size)
    assert [j.name for j in robot.joints] == [f"joint{i}" for i in range(size)]
    shuffled = [robot.joints[i] for i in rng.permutation(size)]
    reached = {robot.root}
    for each in Robot(robot.links, tuple(shuffled), robot.tip).joints:
        assert each.parent in reached
        reached.add(each.child)
    assert reached == {link.name for link in robot.links}


def test_the_only_leaf_is_the_tip_unless_named() -> None:
    chain = planar_chain([1, 1], [1, 1])
    assert chain.tip == "link2"
    assert dataclasses.replace(chain, tip="link1").tip == "link1"
    assert Robot((Link("alone"),)).tip == "alone"


def test_a_tree_of_several_leaves_has_no_tip_and_says_so_where_one_is_needed() -> None:
    """Everything that does not need one works."""
    robot = Robot(
        tuple(Link(name, 1.0, inertia=np.eye(3)) for name in "abc"), (joint("j", "a", "b"), joint("k", "a", "c"))
    )
    assert robot.tip is None
    machine, rates = FreeFloating(robot), [1.0, 2.0]
    base, q = machine.base_home(), [0.3, 0.4]
    with_tip_b = FreeFloating(dataclasses.replace(robot, tip="b"))
    np.testing.assert_array_equal(
        numeric(machine.base_twist(base, q, rates)), numeric(with_tip_b.base_twist(base, q, rates))
    )
    assert [each.tip for each in (add_prefix(robot, "x_"), simplify(robot), lock_joints(robot, {"j": 0.0}))] == [
        None
    ] * 3
    assert prune(robot, "c").tip == "c"
    assert attach_tool(robot, Link("tool"), "b").tip == "tool"
    assert str(robot).startswith("robot of 3 links, 2 degrees of freedom, 3 kg, no tip")
    needing: list[Callable[[], Any]] = [
        lambda: tip_pose(robot, q),
        lambda: tip_jacobian(robot, q),
        lambda: FixedBase(robot).tip_twist([], q, rates),
        lambda: machine.tip_pose(base, q),
        lambda: machine.tip_jacobian(base, q),
        lambda: machine.jacobians(base, q),
        lambda: prune(robot),
        lambda: attach_tool(robot, Link("tool")),
    ]
    for use in needing:
        with refused(r"'robot' has no tip.*leaves \['b', 'c'\].*tip=NAME.*move_tip"):
            use()


def test_limits_are_arrays_of_the_moving_joints() -> None:
    robot = Robot(
        (Link("a"), Link("b"), Link("c"), Link("d")),
        (
            joint("ab", "a", "b", lower=-1.0, upper=2.0, velocity=3.0, effort=4.0),
            joint("bc", "b", "c", kind="fixed", lower=0.0, upper=0.0),
            joint("cd", "c", "d", kind="continuous", velocity=5.0),
        ),
    )
    np.testing.assert_array_equal(robot.lower, [-1.0, -np.inf])
    np.testing.assert_array_equal(robot.upper, [2.0, np.inf])
    np.testing.assert_array_equal(robot.velocity, [3.0, 5.0])
    np.testing.assert_array_equal(robot.effort, [4.0, np.inf])


def test_printing_shows_the_tree_with_masses_and_limits() -> None:
    robot = Robot(
        (Link("base", 100.0), Link("arm", 2.5), Link("panel", 7.0)),
        (
            joint("shoulder", "base", "arm", lower=-1.5, upper=2.0, velocity=0.5),
            joint("hinge", "base", "panel", kind="fixed"),
        ),
        tip="arm",
    )
    assert str(robot).splitlines() == [
        "robot of 3 links, 1 degrees of freedom, 109.5 kg, tip on arm",
        "base  100 kg",
        "├─ shoulder (revolute, -1.5 .. 2 rad, 0.5 rad/s) -> arm  2.5 kg",
        "└─ hinge (fixed) -> panel  7 kg",
    ]


def test_arrays_are_copied_read_only_and_axes_have_unit_length() -> None:
    center = np.array([1.0, 2.0, 3.0])
    link = Link("a", 1.0, center)
    center[0] = 9.0
    assert link.center_of_mass[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        link.center_of_mass[0] = 5.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        link.mass = 3.0  # type: ignore[misc]
    np.testing.assert_allclose(joint("j", "a", "b", axis=(0, 3, 4)).axis, [0, 0.6, 0.8])


def test_a_robot_survives_pickling() -> None:
    robot = random_robot(np.random.default_rng(1), 5)
    again = pickle.loads(pickle.dumps(robot))
    assert str(again) == str(robot)


def test_a_rotation_printed_to_six_digits_is_made_orthonormal() -> None:
    printed = np.round(random_rotation(np.random.default_rng(2)), 7)
    stored = joint("j", "a", "b", rotation=printed).rotation
    np.testing.assert_allclose(stored @ stored.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(stored, printed, atol=1e-6)


@given(seeds)
def test_inertias_of_real_bodies_are_accepted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    inertia = random_inertia(rng, 3.0)
    np.testing.assert_allclose(Link("a", 3.0, inertia=inertia).inertia, inertia, rtol=1e-14)
    turn = random_rotation(rng)
    for principal in ([0, 1, 1], [1, 1, 2], [0, 0, 0], [1, 2, 2.5]):  # rod, lamina, point, body
        Link("a", 1.0, inertia=turn @ np.diag(np.array(principal, dtype=float)) @ turn.T)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"mass": -1.0}, r"link 'a': mass must be a finite number, zero or above \(in kg\), not -1.0"),
        ({"mass": np.nan}, r"link 'a': mass must be a finite number, zero or above \(in kg\), not nan"),
        ({"mass": np.inf}, r"link 'a': mass must be a finite number, zero or above \(in kg\), not inf"),
        ({"mass": "heavy"}, r"link 'a': mass must be a finite number, zero or above \(in kg\), not 'heavy'"),
        ({"mass": [1.0, 2.0]}, r"link 'a': mass must be a finite number, zero or above"),
        ({"center_of_mass": (0.0, 0.0)}, r"link 'a': center_of_mass has shape \(2,\), expected \(3,\)"),
        ({"center_of_mass": (0.0, np.nan, 0.0)}, r"link 'a': center_of_mass .* not finite"),
        ({"inertia": np.ones(3)}, r"link 'a': inertia has shape \(3,\), expected \(3, 3\)"),
        ({"inertia": [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]}, r"link 'a': inertia .* not symmetric"),
        ({"inertia": np.diag([-0.1, 1, 1])}, r"link 'a': inertia has the negative principal moment -0.1"),
        ({"inertia": np.diag([1, 1, 2.1])}, r"link 'a': .* violate the triangle inequality"),
        ({"inertia": np.diag([np.inf, 1, 1])}, r"link 'a': inertia .* not finite"),
    ],
)
def test_an_impossible_link_is_refused(fields: dict[str, Any], message: str) -> None:
    with refused(message):
        Link("a", **fields)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"kind": "cone", "size": 1.0}, r"collision shape: kind must be 'box' or 'sphere'"),
        ({"kind": "box", "size": 1.0}, r"collision box: size has shape \(\), expected \(3,\)"),
        ({"kind": "sphere", "size": [0.0]}, r"collision sphere: size \[0.0\] is not positive"),
        ({"kind": "mesh", "size": [1, 1, 1]}, r"collision mesh: a mesh needs the name of its file"),
        ({"kind": "mesh", "size": [1, 0, 1], "file": "a"}, r"collision mesh: size .* scales it to nothing"),
        ({"kind": "sphere", "size": [1], "rotation": np.ones((3, 3))}, r"rotation .* is not a rotation matrix"),
    ],
)
def test_an_impossible_shape_is_refused(fields: dict[str, Any], message: str) -> None:
    with refused(message):
        CollisionShape(**fields)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"kind": "ball"}, r"joint 'j': kind must be 'fixed' or 'rev"),
        ({"axis": (0, 0, 0)}, r"joint 'j': axis .* has no direction"),
        ({"axis": (0, 1)}, r"joint 'j': axis has shape"),
        ({"axis": (0, 0, np.nan)}, r"joint 'j': axis .* not finite"),
        ({"translation": (0, 0)}, r"joint 'j': translation has shape"),
        ({"rotation": np.eye(2)}, r"joint 'j': rotation has shape"),
        ({"rotation": 2 * np.eye(3)}, r"joint 'j': rotation .* not a rotation matrix"),
        ({"rotation": np.diag([1, 1, -1])}, r"joint 'j': rotation .* not a rotation matrix"),
        ({"lower": 1.0, "upper": 0.0}, r"joint 'j': lower limit 1.0 is above upper limit 0.0"),
        ({"lower": np.nan}, r"joint 'j': lower must be a number, not nan"),
        ({"lower": np.inf}, r"joint 'j': limits inf .. inf leave no position"),
        ({"velocity": -1.0}, r"joint 'j': velocity limit -1.0 is negative"),
        ({"effort": -2.0}, r"joint 'j': effort limit -2.0 is negative"),
        ({"kind": "continuous", "lower": -1.0}, r"joint 'j': a continuous joint has no position limits"),
    ],
)
def test_an_impossible_joint_is_refused(fields: dict[str, Any], message: str) -> None:
    with refused(message):
        joint("j", "a", "b", **fields)


@pytest.mark.parametrize(
    ("links", "edges", "message"),
    [
        ("", [], r"at least one link"),
        ("aba", [("j", "a", "b")], r"link name 'a' is used more than once"),
        ("abc", [("j", "a", "b"), ("j", "b", "c")], r"joint name 'j' is used more than once"),
        ("ab", [("j", "a", "x")], r"joint 'j': child link 'x' does not exist"),
        ("ab", [("j", "x", "b")], r"joint 'j': parent link 'x' does not exist"),
        ("abc", [("j", "a", "b")], r"links \['a', 'c'\] have no parent joint"),
        ("abc", [("j", "a", "c"), ("k", "b", "c")], r"link 'c' is the child of joints 'j' and 'k': a loop"),
        ("ab", [("j", "a", "b"), ("k", "b", "a")], r"form a loop"),
        ("abc", [("j", "b", "c"), ("k", "c", "b")], r"joints \['j', 'k'\] form a loop .* root link 'a'"),
        ("a", [("j", "a", "a")], r"joint 'j' connects link 'a' to itself: a loop"),
    ],
)
def test_links_that_form_no_tree_are_refused(links: str, edges: list[tuple[str, str, str]], message: str) -> None:
    with refused(message):
        Robot(tuple(Link(name) for name in links), tuple(joint(*edge) for edge in edges))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"tip": "x"}, r"tip link 'x' does not exist"),
        ({"tip_translation": (1, 2)}, r"robot: tip_translation has shape"),
        ({"tip_rotation": np.ones((3, 3))}, r"robot: tip_rotation .* not a rotation"),
    ],
)
def test_an_impossible_tip_is_refused(fields: dict[str, Any], message: str) -> None:
    with refused(message):
        Robot((Link("a"),), **fields)


def test_unknown_links_are_named() -> None:
    robot = planar_chain([1.0], [1.0])
    with refused("link 'elbow' does not exist"):
        robot.link("elbow")
    with refused("link 'elbow' does not exist"):
        robot.path_to("elbow")


def test_planar_chain_is_made_of_slender_rods_by_default() -> None:
    robot = planar_chain([2.0, 1.0], [3.0, 4.0], mount=(0.5, -0.25), base=Link("satellite", 9.0))
    assert robot.root == "satellite"
    assert robot.total_mass == 16.0
    np.testing.assert_allclose([link.inertia[2, 2] for link in robot.links[1:]], [1.0, 4.0 / 12])
    np.testing.assert_allclose(robot.joints[0].translation, [0.5, -0.25, 0.0])
    np.testing.assert_allclose(robot.links[1].center_of_mass, [1.0, 0, 0])
    np.testing.assert_allclose(robot.tip_translation, [1.0, 0, 0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([], []), r"lengths has shape \(0,\), expected \(links,\), 1 at least"),
        (([[1.0, 1.0]], [1.0]), r"lengths has shape \(1, 2\), expected \(links,\)"),
        (([1.0, 1.0], [1.0]), r"masses has shape \(1,\), expected \(2,\)"),
        (([1.0], [1.0], [1.0, 2.0]), r"inertias has shape"),
        (([1.0], [-1.0], [1.0]), r"link 'link1': mass must be a finite number, zero or above \(in kg\), not -1.0"),
        (([np.nan], [1.0]), "lengths .* not finite"),
    ],
)
def test_an_impossible_planar_chain_is_refused(arguments: tuple[Any, ...], message: str) -> None:
    with refused(message):
        planar_chain(*arguments)
