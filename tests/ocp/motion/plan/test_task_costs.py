"""Tip tasks at costs beside the squared rates, and in free time within actuator limits."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pinocchio
import pytest

from models import FixedBase, Joint, Link, Robot, planar_chain
from models.checks import Array
from ocp import Cost, Limits, Plan, ProblemError, TipTask, joint_torques, plan
from tests.families import some

TWO, THREE = FixedBase(planar_chain([0.5, 0.4], [2.0, 1.5])), FixedBase(planar_chain([0.5, 0.4, 0.3], [2.0, 1.5, 1.0]))


def line(share: Any) -> TipTask:
    """A straight line of 0.4 m in a second, at a share of it that is a function of time."""
    return TipTask(position=lambda t: ca.vertcat(0.6, -0.2 + 0.4 * share(t), 0.0), rows=(3, 4), duration=1.0)


UNIFORM, SWINGING = line(lambda t: t), line(lambda t: 3 * t**2 - 2 * t**3)


def torques_along(machine: FixedBase, joints: Array, rates: Array, accelerations: Array) -> Array:
    symbols = [ca.SX.sym("v", machine.joint_size) for _ in range(3)]
    at = ca.Function("torques", symbols, [joint_torques(machine, (ca.DM(0, 1), *symbols))])
    return np.array(at.map(len(joints))(joints.T, rates.T, accelerations.T)).T


def integral(cost: Cost, planned: Plan) -> float:
    """The cost of a plan on a fixed base from its samples, jerks by differences."""
    sample = planned.sampled(np.linspace(0.0, planned.horizon, 4001))
    machine = planned.machine
    assert isinstance(machine, FixedBase)
    torques = torques_along(machine, sample.joints, sample.rates, sample.accelerations)
    jerks = np.gradient(sample.accelerations, sample.t, axis=0)
    squares = (sample.rates**2).sum(axis=1)
    running = cost.velocity / 2 * squares + cost.length * np.sqrt(squares) + cost.effort * (torques**2).sum(axis=1)
    running += cost.acceleration * (sample.accelerations**2).sum(axis=1) + cost.jerk * (jerks**2).sum(axis=1)
    running += cost.energy * np.maximum(torques * sample.rates, 0.0).sum(axis=1)
    return float(np.trapezoid(running, sample.t) + cost.time * planned.horizon)


COSTS = {
    "effort": Cost(velocity=0.0, effort=2.0),
    "length": Cost(velocity=0.0, length=1.0),
    "acceleration": Cost(velocity=0.0, acceleration=0.1),
    "jerk": Cost(velocity=0.0, jerk=1e-3, acceleration=1e-2),
    "all": Cost(velocity=0.5, length=0.2, effort=1.0, acceleration=0.02),
}


@pytest.mark.parametrize("name", COSTS)
def test_the_cost_of_a_plan_is_the_integral_of_its_terms_and_no_higher_than_that_of_least_rates(name: str) -> None:
    cost = COSTS[name]
    planned = plan(THREE, SWINGING, cost=cost, scene=False, search="start")
    assert planned.audit().passed
    assert planned.cost == pytest.approx(integral(cost, planned), rel=2e-3)
    least_rates = plan(THREE, SWINGING, scene=False, search="start", limits=Limits(acceleration=1e3))
    assert planned.cost <= integral(cost, least_rates) * (1 + 1e-3)


def test_where_the_tasks_leave_no_freedom_the_cost_is_that_of_the_only_motion() -> None:
    kinematic = plan(TWO, SWINGING, scene=False, search="start")
    for cost in (COSTS["effort"], COSTS["acceleration"], Cost(velocity=1.0, effort=0.5)):
        planned = plan(TWO, SWINGING, cost=cost, scene=False, start=kinematic.at(0.0)["joints"])
        assert planned.cost == pytest.approx(integral(cost, kinematic), rel=1e-3)
        times = np.linspace(0.0, 1.0, 101)
        np.testing.assert_allclose(planned.at(times)["joints"], kinematic.at(times)["joints"], atol=1e-5)


def test_of_all_configurations_the_one_of_least_effort_is_chosen() -> None:
    def place(t: Any) -> Any:
        share = 3 * t**2 - 2 * t**3
        return ca.vertcat(0.7 - 0.4 * share, 0.3 * share, 0.0)

    cost, task = Cost(velocity=0.0, effort=1.0), TipTask(position=place, rows=(3, 4), duration=1.0)
    whole = plan(TWO, task, cost=cost, scene=False)
    each = [plan(TWO, task, cost=cost, scene=False, start=candidate.start) for candidate in starts_of(whole)]
    assert len(each) == 2
    assert whole.cost == pytest.approx(min(one.cost for one in each), rel=1e-6)
    assert max(one.cost for one in each) > whole.cost * 1.01


def starts_of(planned: Plan) -> list[Any]:
    """The candidates that were solved."""
    return [candidate for candidate in planned.candidates if candidate.solution is not None]


@pytest.mark.long
def test_a_global_search_bounds_a_cost_by_its_squared_rates() -> None:
    least = plan(THREE, UNIFORM, scene=False, search="global")
    planned = plan(THREE, UNIFORM, scene=False, search="global", cost=Cost(effort=1.0, acceleration=0.05))
    assert planned.bound == pytest.approx(least.bound, rel=1e-6)
    assert planned.bound is not None
    assert planned.bound <= planned.cost
    assert plan(THREE, UNIFORM, scene=False, search="global", cost=Cost(velocity=0.0, effort=1.0)).bound is None


def slide() -> FixedBase:
    """A mass of 2 kg on a horizontal rail."""
    rail = Joint(
        "rail", "prismatic", "base", "mass", axis=(1, 0, 0), lower=-5.0, upper=5.0, velocity=10.0, effort=100.0
    )
    body = Link("mass", 2.0, (0.0, 0.0, 0.0), np.eye(3) * 0.01)
    return FixedBase(Robot((Link("base"), body), (rail,), tip="mass"))


def test_in_free_time_a_uniform_motion_takes_the_time_of_the_closed_form() -> None:
    """At pace z the cost is time z + 1 / (2 z), least at z = (2 time)^-1/2: 2 s and 0.5 for time = 1/8."""
    task = TipTask(position=lambda t: ca.vertcat(t, 0.0, 0.0), rows=(3,), duration=1.0)
    for limits in (None, Limits(acceleration=3.0)):
        planned = plan(slide(), task, "free", cost=Cost(time=0.125), limits=limits, scene=False)
        assert planned.horizon == pytest.approx(2.0, rel=1e-3)
        assert planned.cost == pytest.approx(0.5, rel=1e-3)
        assert planned.audit().passed


@pytest.mark.parametrize(
    "limits", some([Limits(torque=3.0), Limits(acceleration=1.5), Limits(1.5, 1.5, 40.0, 4.0, 9.0)], 1)
)
def test_in_free_time_a_tool_is_slowed_down_until_its_actuators_can_follow(limits: Limits) -> None:
    """x = (1 - cos 2 pi s) / 2 needs 2 pi^2 m/s^2 of a mass of 2 kg in 1 s, and a quarter of it in 2 s."""
    task = TipTask(position=lambda t: ca.vertcat((1 - ca.cos(2 * np.pi * t)) / 2, 0.0, 0.0), rows=(3,), duration=1.0)
    planned = plan(slide(), task, "free", cost=Cost(time=5.0), limits=limits, scene=False)
    assert planned.audit().feasible
    sample = planned.sampled(np.linspace(0.0, planned.horizon, 4001))
    assert np.abs(sample.accelerations).max() <= 1.5 * (1 + 1e-3)
    # from x = 0 over 1 to 0 within 1.5 m/s^2, from and to any velocity, but not slower than it must be
    assert 1.0 < planned.horizon < np.sqrt(2 * np.pi**2 / 1.5) * 1.001
    share = planned.task_share(sample.t)
    np.testing.assert_allclose(sample.joints[:, 0], (1 - np.cos(2 * np.pi * share)) / 2, atol=1e-4)


@pytest.mark.parametrize(
    ("cost", "horizon", "name"),
    [
        (Cost(turning=1.0), None, "turning"),
        (Cost(time=1.0), None, "time"),
        (Cost(effort=1.0), "free", "time"),
        (Cost(weights=[1.0, 2.0]), None, "weights"),
    ],
)
def test_what_is_undefined_is_refused_by_name(cost: Cost, horizon: Any, name: str) -> None:
    with pytest.raises(ProblemError) as refused:
        plan(THREE, UNIFORM, horizon, cost=cost, scene=False)
    assert refused.value.name == name


def test_the_torques_of_a_plan_of_least_effort_are_those_of_pinocchio() -> None:
    planned = plan(THREE, SWINGING, cost=COSTS["effort"], scene=False, search="start")
    robot = THREE.robot
    model = pinocchio.Model()
    parent = 0
    for joint in robot.moving_joints:
        place = pinocchio.SE3(np.eye(3), np.asarray(joint.translation, dtype=float))
        parent = model.addJoint(parent, pinocchio.JointModelRZ(), place, joint.name)
        link = robot.link(joint.child)
        inertia = pinocchio.Inertia(link.mass, np.array(link.center_of_mass), np.array(link.inertia))
        model.appendBodyToJoint(parent, inertia, pinocchio.SE3.Identity())
    data = model.createData()
    sample = planned.sampled(np.linspace(0.0, 1.0, 401))
    model.gravity.linear = np.array([0.0, 0.0, -9.80665])
    torques = [pinocchio.rnea(model, data, *(each[k] for each in sample[1:4])) for k in range(401)]
    effort = 2.0 * np.trapezoid((np.array(torques) ** 2).sum(axis=1), sample.t)
    assert planned.cost == pytest.approx(effort, rel=2e-3)
