"""Plans by their drives: bang-bang where they must be, faster than along a given path, limits that hold everywhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
import toppra
from toppra.algorithm import TOPPRA
from toppra.constraint import JointTorqueConstraint

from models import (
    CollisionScene,
    CollisionShape,
    FixedBase,
    FreeFloating,
    Link,
    Sphere,
    center_of_mass,
    planar_chain,
    with_load,
)
from models.checks import Array
from ocp import (
    Collocation,
    Cost,
    DynamicsSetup,
    FreeTime,
    Goal,
    Limits,
    ProblemError,
    Solution,
    SolveError,
    dynamics_phases,
)
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics_plan import SolveSettings
from tests.ocp.motion.builders.test_dynamics import DISPLACEMENT, MASS, slider, torques_along
from tests.ocp.motion.goal_solves import solve_goals

MACHINE = FixedBase(planar_chain([0.5, 0.4], [2.0, 1.5]))
START, END = np.array([0.0, 0.3]), np.array([1.0, -0.5])
MOST = np.array([10.0, 4.0])
LEAST_TIME = Cost(velocity=0.0, time=1.0)
SOON = FreeTime(0.1, 5.0, 1.0)
GOAL = Goal(joints=END)


def demand(at: Array, toward: Array, perturbed: Array) -> tuple[Array, Array]:
    """Torques of a run along a path q(s): a s'' + b s'^2, each (K, n)."""

    def torques(rates: Array, second: Array) -> Array:
        return np.asarray(torques_along(MACHINE, {"joints": at, "velocities": rates, "accelerations": second}))

    return torques(0 * at, toward), torques(toward, perturbed)


def least_time_along(s: Array, at: Array) -> float:
    """Of a run from rest to rest through joints (K, n) at s (K,): passes back and forth, as TOPP-RA's."""
    toward = np.gradient(at, s, axis=0, edge_order=2)
    a, b = demand(at, toward, np.gradient(toward, s, axis=0, edge_order=2))

    def fastest(k: int, square: float, step: float, sign: int) -> float:
        """Largest s'^2 at the next place."""
        with np.errstate(divide="ignore"):
            low, high = (-MOST - b[k] * square) / a[k], (MOST - b[k] * square) / a[k]
        low, high = np.minimum(low, high), np.maximum(low, high)
        return float(square + 2 * step * (high.min() if sign > 0 else -low.max()))

    with np.errstate(divide="ignore"):  # where some s'' is within the torques at all
        squares = np.linspace(0.0, 400.0, 4001)
        lows = np.minimum(*[(sign * MOST - b[:, None] * squares[:, None]) / a[:, None] for sign in (-1, 1)]).max(axis=2)
        highs = np.maximum(*[(sign * MOST - b[:, None] * squares[:, None]) / a[:, None] for sign in (-1, 1)]).min(
            axis=2
        )
    most = squares[np.argmax(np.hstack([lows > highs, np.ones((len(s), 1), bool)]), axis=1) - 1]
    square = most.copy()
    square[[0, -1]] = 0.0
    for k in range(len(s) - 1):
        square[k + 1] = min(square[k + 1], fastest(k, square[k], s[k + 1] - s[k], 1))
    for k in range(len(s) - 1, 0, -1):
        square[k - 1] = min(square[k - 1], fastest(k, square[k], s[k] - s[k - 1], -1))
    return float(np.sum(2 * np.diff(s) / (np.sqrt(square[1:]) + np.sqrt(square[:-1]))))


@pytest.fixture(scope="module")
def fastest() -> Solution:
    return solve_goals(MACHINE, GOAL, SOON, start=START, limits=Limits(torque=MOST), cost=LEAST_TIME)


def fine(plan: Solution, times: int = 4001) -> Array:
    """Torques at many times, as shares of their limits. Shape (times, 2)."""
    return np.asarray(np.abs(torques_along(MACHINE, plan.at(np.linspace(0, plan.horizon, times)))) / MOST)


def test_a_plan_of_least_time_is_bang_bang_and_holds_its_limits(fastest: Solution) -> None:
    """Of two joints without a singular arc both torques are at a limit at all times."""
    assert fastest.audit().passed
    shares = fine(fastest)
    assert shares.max() <= 1 + 1e-5
    assert (shares.max(axis=1) > 0.999).mean() > 0.99
    assert (shares.min(axis=1) > 0.999).mean() > 0.95


@pytest.mark.long
def test_a_free_path_is_faster_than_any_fixed_path(fastest: Solution) -> None:
    """The straight path takes longer even in its own least time; along its own path the plan is as fast as can be."""
    s = np.linspace(0, 1, 2001)
    straight = least_time_along(s, START + s[:, None] * (END - START))
    assert fastest.horizon < 0.97 * straight
    t = (1 - np.cos(np.pi * s)) / 2  # slow at the ends, where s' of the path itself would be infinite
    own = least_time_along(s, fastest.at_fraction(t)["joints"])
    assert fastest.horizon * (1 - 1e-3) < own < fastest.horizon * 1.02  # the passes are of the first order


@pytest.mark.long
def test_a_path_that_is_free_is_faster_than_toppra_along_the_straight_one(fastest: Solution) -> None:
    """Within the same torques; what toppra takes there is what our own passes say, to a percent."""

    def torques(at: Array, rates: Array, second: Array) -> Array:
        sample = {"joints": at[None], "velocities": rates[None], "accelerations": second[None]}
        return np.asarray(torques_along(MACHINE, sample)[0])

    toppra.setup_logging("ERROR")
    path = toppra.SplineInterpolator(np.array([0.0, 0.5, 1.0]), np.array([START, (START + END) / 2, END]))
    limit = JointTorqueConstraint(torques, np.stack([-MOST, MOST], axis=1), np.zeros(2))
    result = TOPPRA([limit], path, gridpoints=np.linspace(0, 1, 201)).compute_trajectory(0, 0)
    s = np.linspace(0, 1, 2001)
    assert result.duration == pytest.approx(least_time_along(s, START + s[:, None] * (END - START)), rel=1e-2)
    assert fastest.horizon < 0.97 * result.duration


@pytest.mark.long
@pytest.mark.parametrize(("mesh", "most"), [((2, 2), np.inf), ((1, 3), 2.5)])
def test_limits_that_no_mesh_meets_are_tightened_at_their_cost(
    mesh: tuple[int, int], most: float, tmp_path: Path
) -> None:
    """Three meshes of low degree are too coarse; what the plan costs too much is told, about as a fine one finds it."""
    request: dict[str, Any] = {"limits": Limits(torque=MOST, velocity=most)}
    effort = Cost(velocity=0.0, effort=1e-4, time=1.0)
    best = solve_goals(MACHINE, GOAL, SOON, start=START, cost=effort, **request)
    method = Collocation(mesh[0], degree=mesh[1], scheme="legendre")
    plan = solve_goals(MACHINE, GOAL, SOON, start=START, cost=effort, settings=SolveSettings(method), **request)
    audit = plan.audit()
    assert audit.feasible
    assert not audit.passed
    assert fine(plan).max() <= 1 + 1e-5
    assert 0.5 * plan.tightening_cost <= plan.cost - best.cost <= 1.5 * plan.tightening_cost
    assert f"about {plan.tightening_cost:.2g} of the cost" in str(plan)
    plan.save(tmp_path / "plan.npz")
    assert Solution.load(tmp_path / "plan.npz").tightening_cost == plan.tightening_cost
    assert best.tightening_cost < 1e-3 * best.cost


def test_mixtures_lie_between_their_parts(fastest: Solution) -> None:
    request: dict[str, Any] = {"limits": Limits(torque=MOST)}
    mixed = solve_goals(MACHINE, GOAL, SOON, start=START, cost=Cost(velocity=0.0, effort=1e-3, time=1.0), **request)
    easy = solve_goals(MACHINE, GOAL, mixed.horizon, start=START, cost=Cost(velocity=0.0, effort=1e-3), **request)
    assert mixed.audit().passed
    assert mixed.horizon > fastest.horizon
    assert fine(mixed).max() <= 1 + 1e-5
    assert easy.cost + mixed.horizon == pytest.approx(mixed.cost, rel=1e-3)


def test_excessive_values_are_refused_by_name() -> None:
    with pytest.raises(SolveError, match="torques of 'joint1' would have to go") as caught:
        solve_goals(
            MACHINE,
            GOAL,
            0.4,
            start=START,
            limits=Limits(torque=MOST),
            settings=SolveSettings(options={"max_iter": 60}),
        )
    assert str(caught.value.name).startswith("torques of 'joint")
    assert caught.value.time is not None


# ---- goals -----------------------------------------------------------------------------------------------------------


def test_a_point_that_is_passed_is_passed_without_a_stop() -> None:
    """A mass that passes 0.5 m at a free time on its way to 0.8 m: no dearer than straight on, which does so too."""
    passed = Goal(joints=[0.5], duration=FreeTime(0.1, 1.0, 0.6), velocity="free")
    last = Goal(joints=[0.8], duration=FreeTime(0.1, 1.0, 0.4))
    plan = solve_goals(slider(), [passed, last], 1.0, start=[0.0])
    assert plan.cost == pytest.approx(12 * MASS**2 * DISPLACEMENT**2, rel=1e-7)
    first, second = plan.phase("leg 1"), plan.phase("leg 2")
    assert first.horizon + second.horizon == pytest.approx(1.0, abs=1e-9)
    assert first["velocities"][-1] == pytest.approx(second["velocities"][0], abs=1e-8)
    assert first["velocities"][-1] > 1.0
    assert plan.audit().passed


def test_a_floating_machine_that_picks_up_a_load_at_rest_keeps_its_momentum() -> None:
    """Without and with the load nothing moves the centre of mass; joints and base go on where they were."""
    robot = planar_chain([0.5, 0.4], [2.0, 1.5], base=Link("base", 8.0, (0, 0, 0), 0.5 * np.eye(3)))
    alone = FreeFloating(robot, "planar")
    loaded = FreeFloating(with_load(robot, robot.tip_link, 2.0, (0.4, 0, 0)), "planar")
    load = Goal(joints=[1.2, -0.4], duration=1.0, name="reach")
    place = Goal(joints=[0.2, 0.5], duration=1.5, machine=loaded, name="carry")
    plan = solve_goals(alone, [load, place], start=[0.2, 0.5])
    assert plan.audit().passed
    reach, carry = plan.phase("reach"), plan.phase("carry")
    assert carry["base"][0] == pytest.approx(reach["base"][-1], abs=1e-8)
    assert carry["joints"][0] == pytest.approx(reach["joints"][-1], abs=1e-8)
    for machine, leg in ((alone, reach), (loaded, carry)):
        q, qd, base = (leg[name] for name in ("joints", "velocities", "base"))
        for k in (0, len(q) // 3, -1):
            rate = machine.base_rate(base[k], q[k], qd[k])
            left = np.array(ca.DM(machine.momentum_residual(base[k], q[k], rate, qd[k])))
            assert np.abs(left).max() < 1e-9
        frames = [machine.world_from_base(place) for place in (base[0], base[-1])]
        centers = [
            np.array(ca.DM(center_of_mass(machine.robot, at, frame)))
            for at, frame in zip((q[0], q[-1]), frames, strict=True)
        ]
        assert centers[0] == pytest.approx(centers[1], abs=1e-7)


def test_goals_that_do_not_fit_are_refused() -> None:
    rest, other = Goal(joints=END, duration=1.0), FixedBase(planar_chain([0.5], [1.0]))
    back = Goal(joints=START, duration=1.0)
    heavy = FixedBase(with_load(MACHINE.robot, MACHINE.robot.tip_link, 1.0))
    for goals, more, words in (
        ([], {}, "at least one"),
        ([replace(rest, velocity="free"), replace(back, machine=heavy)], {}, "at rest"),
        ([rest, Goal(joints=[0.0], duration=1.0, machine=other)], {}, "1 joints"),
        ([rest, replace(back, name="leg 1")], {}, "not all different"),
        ([rest, replace(back, duration=None)], {}, "needs a duration"),
        ([replace(rest, joints=None, position=[0.5, 0.1, 0.0]), back], {}, "joints are needed"),
        ([rest], {"total": 1.0}, "has a fixed duration"),
        ([rest], {"setup": DynamicsSetup(end_velocity="free")}, "every goal has its own"),
    ):
        with pytest.raises(ProblemError, match=words):
            dynamics_phases(MACHINE, goals, start=START, **more)


def test_colliding_pairs_on_the_path_to_a_goal_are_separated() -> None:
    """The tip goes round a ball in its way, by plain geometry, on the way out and back to where it begins."""
    chain, tip, ball, sizes = planar_chain([0.5, 0.4], [2.0, 1.5]), np.array([0.4, 0.0, 0.0]), 0.06, 0.11
    shape = CollisionShape("sphere", (sizes - ball,), translation=tip)
    links = [replace(link, collisions=(shape,)) if link.name == "link2" else link for link in chain.links]
    machine = FixedBase(replace(chain, links=tuple(links)))
    legs = [Goal(joints=[0.6, 0.3], duration=1.0, velocity="free"), Goal(joints=START, duration=1.0)]

    def way(clearance_constraints: ClearanceConstraints | None) -> Array:
        """Of the tip, there and back. Shape (402, 3)."""
        plan = solve_goals(
            machine,
            legs,
            start=START,
            settings=SolveSettings(Collocation(6, 4, scheme="legendre")),
            setup=DynamicsSetup(clearance_constraints=clearance_constraints),
        )
        assert plan.audit().passed
        both = [plan.phase(name).at_fraction(np.linspace(0, 1, 201))["joints"] for name in ("leg 1", "leg 2")]
        return np.array([np.array(ca.DM(machine.tip_pose(ca.DM(0, 1), q).position)).ravel() for q in np.vstack(both)])

    free = way(None)
    place = free[100] * (1 + 0.08 / np.linalg.norm(free[100]))
    assert np.linalg.norm(free - place, axis=1).min() < sizes - 0.01
    held = way(ClearanceConstraints(CollisionScene(machine, [Sphere(ball, place)])))
    assert np.linalg.norm(held - place, axis=1).min() >= sizes - 1e-9
