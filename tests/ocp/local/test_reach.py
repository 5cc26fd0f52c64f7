"""Tasks out of reach are refused by name before anything is optimised; what is in reach is not."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, FreeFloating, Joint, Link, Robot, planar_chain
from models.spatial import rotation
from ocp import Collocation, SolveError, TipTask, Unreachable, plan_minimum_velocity, resolve
from ocp.local.floating_reach import check_floating_reach
from ocp.local.inverse_kinematics import check_reach
from tests.models.robot.trees import seven_joint_arm

START = np.deg2rad([60.0, -100.0, -20.0])
SHORT = Collocation(intervals=10, degree=3)


def arm() -> FixedBase:
    return FixedBase(planar_chain([1.0, 0.5, 0.5], [1.0] * 3))


def tip(joints: Any) -> Any:
    return np.array(arm().tip_pose((), joints).position).ravel()


@pytest.mark.parametrize("kind", ["constant", "function", "pose"])
def test_a_plan_out_of_reach_says_when_and_by_how_much(kind: str) -> None:
    """The tip moves 3 m in x within 3 s; with 2 m of arm it is out of reach from where |tip| = 2 m on."""
    place = tip(START)
    tasks: dict[str, dict[str, Any]] = {
        "constant": {"tip_velocity": (1.0, 0.0), "rows": (3, 4)},
        "function": {"tip_velocity": lambda time: [1.0 + 0 * time, 0.0], "rows": (3, 4)},
        "pose": {"task": TipTask(position=lambda t: ca.vertcat(place[0] + t, place[1], 0), rows=(3, 4))},
    }
    with pytest.raises(Unreachable, match=r"at 1\.\d+ s no joint positions put \['link3'\]") as caught:
        plan_minimum_velocity(arm(), method=SHORT, start_joints=START, horizon=3.0, **tasks[kind])
    leaving = np.sqrt(4 - place[1] ** 2) - place[0]
    grid = 3.0 / 8
    time = caught.value.time
    assert leaving < time <= leaving + grid
    miss = np.hypot(place[0] + time, place[1]) - 2.0
    angle = np.arctan2(place[1], place[0] + time)
    assert caught.value.misfit == pytest.approx(miss * max(np.cos(angle), np.sin(angle)), rel=1e-3)


def slides(speed: float) -> FixedBase:
    """Two slides along x, one on the other, 0 to 0.5 m each."""
    names = [("one", "a", "b"), ("two", "b", "c")]
    limits = {"axis": (1.0, 0.0, 0.0), "lower": 0.0, "upper": 0.5, "velocity": speed}
    joints = tuple(Joint(name, "prismatic", parent, child, **limits) for name, parent, child in names)  # type: ignore[arg-type]
    return FixedBase(Robot((Link("a"), Link("b"), Link("c")), joints))


def test_a_plan_that_is_too_fast_is_refused_with_what_would_have_to_give_way() -> None:
    """Two slides of 0.1 m/s cannot move the tip at 0.25 m/s."""
    asked: dict[str, Any] = {"tip_velocity": (0.25,), "rows": (3,), "start_joints": (0.1, 0.2), "horizon": 1.0}
    with pytest.raises(SolveError) as caught:
        plan_minimum_velocity(slides(0.1), method=SHORT, **asked)
    assert "damping 0.005, 10 intervals: ipopt ended with" in str(caught.value)
    assert "would have to go" in str(caught.value)
    assert str(caught.value).count("not all constraints can hold together") == 1


def test_limits_decide_what_is_within_reach_only_where_they_hold() -> None:
    machine = slides(10.0)
    asked: dict[str, Any] = {"tip_velocity": (0.5,), "rows": (3,), "start_joints": (0.1, 0.2), "horizon": 2.0}
    assert (resolve(machine, **asked).joints > machine.robot.upper).any()
    with pytest.raises(Unreachable, match=r"at 1\.5 s .*\['one', 'two'\] at their limits"):
        plan_minimum_velocity(machine, method=SHORT, **asked)
    plan = plan_minimum_velocity(machine, method=SHORT, limits=False, **asked)
    np.testing.assert_allclose(plan["joints"][-1], [0.6, 0.7], atol=1e-8)


def test_a_singular_passage_within_reach_is_no_refusal() -> None:
    """From stretched to folded the arm passes where its Jacobian loses rank; poses beyond it exist."""
    machine, place = arm(), tip(START)
    tasks = [TipTask(velocity=lambda t: [0.3 * ca.cos(t), -0.2], rows=(3, 4))]
    check_reach(machine, tasks, START, 1.0, True, START)
    turning = TipTask(position=place, orientation=lambda t: rotation((0, 0, 1), START.sum() + 0.2 * t), rows=(2, 3, 4))
    check_reach(machine, [turning], START, 1.0, True, START)


def test_of_what_depends_on_the_way_or_on_a_floating_base_nothing_is_said() -> None:
    far = TipTask(position=(50.0, 0.0, 0.0), start_gap=100.0)
    along_the_tip = TipTask(velocity=(9.0, 0.0), rows=(3, 4), axes="tip")
    spin = TipTask(velocity=(9.0,), rows=(2,))
    for task in (far, along_the_tip, spin):
        check_reach(arm(), [task], START, 3.0, True, START)
    floating = FreeFloating(seven_joint_arm())
    check_reach(floating, [TipTask(position=(50.0, 0.0, 0.0))], np.zeros(7), 3.0, True, np.zeros(7))


def test_velocities_are_summed_up_only_along_axes_in_which_the_place_is_told() -> None:
    """Along the axes of the link that it is relative to a steady velocity leads out of reach; along the world's it
    need not, since the link may turn: the tip then goes round in a circle.
    """
    asked: dict[str, Any] = {"velocity": (0.4, 0.0), "rows": (3, 4), "relative_to": "link1"}
    check_reach(arm(), [TipTask(axes="world", **asked)], START, 10.0, True, START)
    with pytest.raises(Unreachable):
        check_reach(arm(), [TipTask(axes="reference", **asked)], START, 10.0, True, START)


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_floating_arm_reaches_as_far_as_its_centre_of_mass_allows(share: float) -> None:
    """A base of 2 kg, its joint 0.3 m off; a rod of 1 kg, 0.6 m long: stretched, the centre of all is 0.2 m from the
    base's and 0.7 m from the tip, in whichever direction.
    """
    base = Link("base", 2.0, inertia=0.02 * np.eye(3))
    rod = Link("rod", 1.0, (0.3, 0.0, 0.0), np.diag([1e-4, 0.03, 0.03]))
    joint = Joint("turn", "revolute", "base", "rod", (0.3, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    machine = FreeFloating(Robot((base, rod), (joint,), tip_translation=(0.6, 0.0, 0.0)))
    home = np.asarray(machine.base_home(), dtype=float)
    centre = (2.0 * np.zeros(3) + np.array([0.3 + 0.3 * np.cos(1.0), 0.3 * np.sin(1.0), 0.0])) / 3
    task = TipTask(position=centre + share * 0.7 * np.array([0.0, 0.6, 0.8]))
    bounds: dict[str, Any] = {"lower": np.array([-np.pi]), "upper": np.array([np.pi])}
    if share < 1:
        check_floating_reach(machine, [task], home, np.array([1.0]), 0.0, 1.0, **bounds)
        return
    with pytest.raises(Unreachable) as caught:
        check_floating_reach(machine, [task], home, np.array([1.0]), 0.0, 1.0, **bounds)
    assert 0.07 / np.sqrt(3) <= caught.value.misfit <= 0.07  # the largest entry of a miss of 0.07 m
