"""Values on a limit, and beyond it by rounding: taken as on it by whoever takes joints at an end."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import FixedBase, Joint, Robot, planar_chain
from models.checks import Array
from ocp import DynamicsSetup, Goal, Limits, Problem, ProblemError, TipTask, minimum_velocity_problem, plan
from ocp.errors import format_distinct
from tests.ocp.motion.goal_solves import solve_goals

LOW, HIGH = np.array([-0.0175, -2.0]), np.array([3.7525, 2.0])


def limited_arm() -> FixedBase:
    arm = planar_chain([0.5, 0.4], [1.0, 1.0])
    bounds = zip(arm.joints, LOW, HIGH, strict=True)
    joints = [Joint(j.name, j.kind, j.parent, j.child, j.translation, lower=a, upper=b) for j, a, b in bounds]
    return FixedBase(Robot(arm.links, tuple(joints), tip_translation=arm.tip_translation))


MACHINE = limited_arm()


def leaving(joints: Array) -> TipTask:
    first = np.array(ca.DM(MACHINE.tip_pose((), joints).position)).ravel()[:2]
    on = np.array(ca.DM(MACHINE.tip_pose((), np.array([0.3, 0.9])).position)).ravel()[:2]
    return TipTask(position=lambda t: ca.DM(first) + (t / 2) ** 2 * ca.DM(on - first), rows=[3, 4], duration=1.0)


def planned(joints: Array) -> float:
    return float(plan(MACHINE, leaving(joints), start=joints, scene=False).at(0.0)["joints"][0])


def moved(joints: Array) -> float:
    return float(solve_goals(MACHINE, Goal(joints=[0.3, 0.9]), 1.0, start=joints).at(0.0)["joints"][0])


def arrived(joints: Array) -> float:
    return float(solve_goals(MACHINE, Goal(joints=joints), 1.0, start=[0.3, 0.9]).at(1.0)["joints"][0])


def declared(joints: Array) -> float:
    problem = minimum_velocity_problem(MACHINE, start=joints, horizon=1.0, tasks=leaving(joints))
    return float(np.array(ca.DM(problem.declared.states["joints"].initial)).ravel()[0])


@pytest.mark.parametrize("entry", [planned, moved, arrived, declared])
def test_a_joint_beyond_its_limit_by_rounding_is_on_it(entry: Callable[[Array], float]) -> None:
    assert entry(np.array([np.nextafter(LOW[0], -1), 0.8])) >= LOW[0] - 1e-9
    with pytest.raises(ProblemError, match=r"-0\.0175001, outside its limits -0\.0175 \.\. 3\.7525") as caught:
        entry(np.array([LOW[0] - 1e-7, 0.8]))
    assert caught.value.name == "joint1"
    assert caught.value.limit == (LOW[0], HIGH[0])


def test_velocities_beyond_their_limit_by_rounding_are_on_it() -> None:
    goal, limits = Goal(joints=[1.5, 0.9]), Limits(velocity=1.1)
    setup = DynamicsSetup(start_velocity=[np.nextafter(1.1, 2), 0.0])
    fast = solve_goals(MACHINE, goal, 2.0, start=[0.3, 0.9], limits=limits, setup=setup)
    assert fast.at(0.0)["velocities"][0] == pytest.approx(1.1, abs=1e-9)
    with pytest.raises(ProblemError, match=r"'joint1' starts at 1\.1000001, outside its limits -1\.1 \.\. 1\.1;"):
        solve_goals(
            MACHINE, goal, 2.0, start=[0.3, 0.9], limits=limits, setup=DynamicsSetup(start_velocity=[1.1000001, 0.0])
        )


def test_a_value_just_beyond_a_bound_is_reported_with_differing_digits() -> None:
    with pytest.raises(ProblemError, match=r"1\.0000000001 is outside the bounds \[0, 1\]"):
        Problem("p").state("x", initial=1 + 1e-10, lower=0.0, upper=1.0)


@given(st.lists(st.floats(allow_nan=False), min_size=2, max_size=4))
def test_numbers_that_differ_look_different(numbers: list[float]) -> None:
    report = format_distinct(*numbers)
    for one, text in zip(numbers, report, strict=True):
        for other, beside in zip(numbers, report, strict=True):
            assert (text == beside) == (repr(one) == repr(other))


def test_six_digits_suffice_for_large_differences() -> None:
    assert format_distinct(-0.0175, 3.75251234) == ["-0.0175", "3.75251"]
