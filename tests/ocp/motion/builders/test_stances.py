"""Stances one after the other: who is held when, whose foot swings, and joint vectors in either order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import Foothold
from ocp import ProblemError
from ocp.motion.builders.standing.stances import StancePhase, Steps, walk
from scripts.robots.steps import planar_biped, planar_feet, planar_steps

FEET = ("left", "right", "hand")


def at(place: float) -> Foothold:
    return Foothold((place, 0.0, 0.0))


@given(st.lists(st.tuples(st.sampled_from(FEET), st.floats(-1, 1)), min_size=1, max_size=6))
def test_a_walk_lifts_one_foot_at_a_time_and_places_it_on_its_foothold(steps: list[tuple[str, float]]) -> None:
    start = {name: at(0.1 * k) for k, name in enumerate(FEET)}
    phases = walk(start, [(name, at(place)) for name, place in steps], shift=0.5, swing=0.7)
    assert [phase.seconds for phase in phases] == [0.5, *[0.7, 0.5] * len(steps)]
    here = {name: hold.position[0] for name, hold in start.items()}
    for k, (name, place) in enumerate(steps):
        in_air, landed = phases[2 * k + 1].footholds, phases[2 * k + 2].footholds
        assert set(in_air) == set(FEET) - {name}
        here[name] = place
        assert {foot: hold.position[0] for foot, hold in landed.items()} == here
        assert all(in_air[foot] is landed[foot] for foot in in_air)


def test_a_foot_swings_from_where_it_lifted_to_where_it_lands_while_the_other_stands() -> None:
    steps = planar_steps(2, 0.6, 0.7)
    assert len(steps.stances) == len(steps.phases) == len(steps.names) == 5
    for k, phase in enumerate(steps.phases):
        swings = steps.swings(k)
        assert {swing.name for swing in swings} == set(steps.feet) - set(phase.footholds)
        for swing in swings:
            assert swing.lifted is steps.phases[k - 1].footholds[swing.name]
            assert swing.landing is steps.phases[k + 1].footholds[swing.name]
        soles = [hold for name, hold in phase.footholds.items()]
        low, high = (pick([hold.position[0] for hold in soles]) for pick in (min, max))
        assert low - 0.08 <= steps.balanced(k)[0] <= high + 0.14


def test_joints_of_a_stance_and_of_the_robot_are_one_vector_in_two_orders() -> None:
    steps, rng = planar_steps(2, 0.6, 0.7), np.random.default_rng(0)
    for stance in steps.stances:
        q = rng.normal(size=(3, steps.robot.dof))
        order = steps.order(stance)
        assert [steps.robot.joint_names[k] for k in order] == list(stance.robot.joint_names)
        np.testing.assert_array_equal(steps.in_order(stance, q[:, order]), q)


def test_stances_that_leap_or_slide_are_refused_by_name() -> None:
    robot, feet = planar_biped(), planar_feet()
    left, right = ({name: at(0.0)} for name in ("left", "right"))
    with pytest.raises(ProblemError, match="no foot is held from phase 0 to phase 1: the machine would leap"):
        Steps(robot, feet, [StancePhase(left, 1.0), StancePhase(right, 1.0)])
    with pytest.raises(ProblemError, match="foot 'left' is held from phase 0 to phase 1, but its foothold moves"):
        Steps(robot, feet, [StancePhase(left, 1.0), StancePhase({"left": at(0.1)}, 1.0)])
    with pytest.raises(ProblemError, match="footholds are missing"):
        StancePhase({}, 1.0)
    with pytest.raises(ProblemError, match="hand"):
        walk(left, [("hand", at(0.2))], shift=0.5, swing=0.5)
