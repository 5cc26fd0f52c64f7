"""Units travel from the declaration to who reads the plan; ready problems declare theirs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from models import FixedBase, FreeFloating, Joint, Link, Robot, planar_chain, reference_rig, reference_tunnel
from ocp import Limits, Problem, ProblemError, TipTask, minimum_velocity_problem, roll_problem, standing_problem
from ocp.problem.formulation import Formulation
from tests.models.machines.standing_machines import standing_arm
from tests.ocp.motion.builders.standing_tasks import ARM_HORIZON, ARM_START, arm_task
from tests.ocp.motion.builders.test_cts import falling


def cart(**end: Any) -> Problem:
    problem = Problem("cart")
    x = problem.state("x", initial=0.0, lower=-1.0, upper=1.0, unit="m")
    a = problem.state("a", unit="rad")
    f = problem.control("f", unit="N")
    problem.dynamics(x, a)
    problem.dynamics(a, f)
    problem.horizon(1.0)
    problem.path("speed", a, upper=1.0, unit="rad/s")
    problem.start("push", f, 0, 0, unit="N")
    problem.end("place", x, 0, 0, **end)
    return problem


def test_units_are_kept_by_name_of_state_control_and_constraint() -> None:
    units = Formulation(cart()).units
    assert units == {"x": "m", "a": "rad", "f": "N", "speed": "rad/s", "push": "N", "place": ""}


def test_units_are_shown_where_the_problem_is() -> None:
    lines = str(cart(unit="m")).splitlines()
    assert "  state        x (1) in [-1, 1] m; initial 0" in lines
    assert "  control      f (1) N" in lines
    assert "  path         speed (1): -inf <= a <= 1 rad/s" in lines
    assert "  end          place (1): 0 <= x <= 0 m" in lines


def test_a_name_that_two_bear_has_a_unit_only_where_it_is_one() -> None:
    problem = cart()
    problem.path("x", 2 * problem.declared.states["x"].symbol, upper=1.0)
    problem.path("f", 2 * problem.declared.controls["f"].symbol, upper=1.0, unit="kN")
    units = Formulation(problem).units
    assert (units["x"], units["f"]) == ("m", "")


@pytest.mark.parametrize("unit", [None, 3, b"m", ["m"], ("rad", "m")])
@pytest.mark.parametrize("kind", ["state", "control", "path", "start", "end"])
def test_a_unit_is_a_string(kind: str, unit: Any) -> None:
    problem = Problem("units")
    x = problem.state("x")
    options: tuple[Any, ...] = () if kind in ("state", "control") else (x, 0)
    with pytest.raises(ProblemError, match="unit must be a string") as caught:
        getattr(problem, kind)("y", *options, unit=unit)
    assert (caught.value.name, caught.value.value) == ("unit", unit)


def slide_and_turn() -> Robot:
    links = [Link("base", 5.0, inertia=np.eye(3)), Link("slide", 1.0), Link("arm", 1.0, inertia=np.eye(3))]
    joints = [
        Joint("slide", "prismatic", "base", "slide", axis=(1, 0, 0), velocity=1.0),
        Joint("turn", "revolute", "slide", "arm", velocity=2.0),
    ]
    return Robot(tuple(links), tuple(joints), tip_translation=(0.5, 0, 0))


def planar() -> Problem:
    task = TipTask(velocity=[0.1, 0.0], rows=(3, 4))
    chain = FreeFloating(planar_chain([1.0, 0.8, 0.6], [1.0] * 3, base=Link("hull", 9.0, inertia=np.eye(3))), "planar")
    return minimum_velocity_problem(chain, tasks=task, start=[0.3, 0.6, 0.9], horizon=1.0)


def mixed() -> Problem:
    task = TipTask(velocity=[0.1, 0.2], rows=(2, 3))
    return minimum_velocity_problem(FixedBase(slide_and_turn()), tasks=task, start=[0.1, 0.2], horizon=1.0)


def standing() -> Problem:
    limits = Limits(torque=80.0, friction=0.5)
    return standing_problem(standing_arm(), arm_task(), ARM_HORIZON, start=ARM_START, limits=limits)


def roll() -> Problem:
    rig = reference_rig()
    return roll_problem(rig, reference_tunnel(), falling, 10.0)


@pytest.mark.parametrize(
    ("declare", "expected"),
    [
        (planar, {"base": "m, rad", "joints": "rad", "rates": "rad/s", "task": "m/s"}),
        (mixed, {"joints": "m, rad", "rates": "m/s, rad/s", "task": "rad/s, m/s"}),
        (standing, {"joints": "rad", "velocities": "rad/s", "accelerations": "rad/s^2", "torques": "N m"}),
        (standing, {"tip": "m", "vertical force": "N", "friction": "", "zero moment point": "m"}),
        (roll, {"roll": "rad", "rate": "rad/s", "acceleration": "rad/s^2", "reach": ""}),
    ],
)
def test_ready_problems_declare_their_units(declare: Callable[[], Problem], expected: dict[str, str]) -> None:
    units = Formulation(declare()).units
    assert {name: units[name] for name in expected} == expected
