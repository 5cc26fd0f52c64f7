"""Standing machines through `plan`: the ground's reaction by Newton's law of rods, and laws of the cost."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio
import pytest

from models import STANDING_STARTS, Standing, Support, rectangle, standing_example
from models.paths import rest_to_rest
from ocp import Cost, InFoot, Limits, ProblemError, Scene, TipTask
from ocp.motion.builders.standing.problem import Weights
from ocp.motion.plan import Plan, plan
from tests.models.machines.standing_machines import planar_machine
from tests.models.robot.trees import Array
from tests.ocp.motion.builders.standing_tasks import ROWS, led, planar_start, tip_at

pytestmark = pytest.mark.xdist_group("plans to stand")  # one process, so that every motion is planned once

SIZE, SECONDS = 5, 2.0
LENGTHS = 1.9 * np.linspace(1.3, 0.7, SIZE) / SIZE
MASSES = 50.0 * np.linspace(1.3, 0.7, SIZE) ** 2 / (np.linspace(1.3, 0.7, SIZE) ** 2).sum()
GRAVITY = 9.81
EDGES = (-0.12, 0.2)
"""Of the foot, m."""
EFFORT = Weights(acceleration=0.01, velocity=0.0, joint_limits=0.0, manipulability=0.0)
SHIFT = np.array([0.2, -0.3])
"""What the tip is moved by, ahead and up, m."""


def machine(edges: tuple[float, float] = EDGES) -> Standing:
    options = planar_machine(SIZE)
    return replace(options, support=rectangle((-0.1, 0.1), edges), most_stable_point=None, half_widths=None)


def first() -> Array:
    return planar_start(SIZE)


def moved(start: Any, by: Any, seconds: float = SECONDS) -> TipTask:
    """The tip by so many m, ahead and up, from rest to rest."""
    place, step = ca.DM(tip_at(planar_machine(SIZE), start)[1:]), ca.DM(by)
    return led(lambda t: place + step * rest_to_rest(t / seconds), ROWS)


@cache
def reached(edges: tuple[float, float] = EDGES, seconds: float = SECONDS) -> Plan:
    task = moved(first(), SHIFT, seconds)
    return plan(machine(edges), task, seconds, start=first(), cost=EFFORT)


def bodies(joints: Array) -> tuple[Array, Array, Array]:
    """Centres of rods (M, n, 2) and their angles (M, n), and tips (M, 2), in y and z; from the joints (M, n)."""
    angles = np.cumsum(joints, axis=1)
    along = np.stack([np.cos(angles), np.sin(angles)], axis=2) * LENGTHS[:, None]
    ends = np.cumsum(along, axis=1)
    return ends - along / 2, angles, ends[:, -1]


def zero_moment_points(result: Plan, times: Array, step: float = 1e-4) -> tuple[Array, Array]:
    """Where the ground's reaction acts, m, and its vertical force, N, by differences of the rods' places."""
    before, at, after = (bodies(result.at(times + shift)["joints"]) for shift in (-step, 0.0, step))
    pull, turning = ((b - 2 * a + c) / step**2 for b, a, c in zip(before[:2], at[:2], after[:2], strict=True))
    weight = MASSES * (pull[:, :, 1] + GRAVITY)
    y, z = at[0][:, :, 0], at[0][:, :, 1]
    moment = (y * weight - z * MASSES * pull[:, :, 0] + MASSES * LENGTHS**2 / 12 * turning).sum(axis=1)
    force = weight.sum(axis=1)
    return moment / force, force


def inside(result: Plan, count: int = 301) -> Array:
    """Times that are no nodes, s."""
    return np.linspace(0.0, result.horizon, count + 2)[1:-1] + 1.3e-4


def effort(result: Plan) -> float:
    """The integral of the squared accelerations, from what the plan says of them."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    kinks = result.solution.state_interpolant.breaks * result.horizon
    half = np.diff(kinks) / 2
    times = (kinks[:-1] + half)[:, None] + half[:, None] * nodes
    second = result.sampled(times.ravel()).accelerations.reshape(*times.shape, -1)
    return float(np.einsum("k,g,kgn->", half, weights, second**2))


def test_the_machine_stands_by_newtons_law_and_its_tip_is_where_it_should_be() -> None:
    result = reached()
    assert result.audit().passed
    times = inside(result)
    place, force = zero_moment_points(result, times)
    assert (force > 0).all()
    assert EDGES[0] - 1e-4 < place.min()
    assert place.max() < EDGES[1] + 1e-4
    tips = bodies(result.at(times)["joints"])[2]
    share = np.array([float(rest_to_rest(t / SECONDS)) for t in times])
    begin = tip_at(planar_machine(SIZE), first())[1:]
    assert np.abs(tips - begin - share[:, None] * SHIFT).max() < 1e-5


def test_it_begins_and_ends_at_rest_and_keeps_its_limits() -> None:
    result, robot = reached(), machine().robot
    assert np.abs(result.at([0.0, result.horizon])["rates"]).max() < 1e-6
    at = result.at(inside(result))
    assert (at["joints"] > robot.lower - 1e-6).all()
    assert (at["joints"] < robot.upper + 1e-6).all()
    assert (np.abs(at["rates"]) < robot.velocity + 1e-6).all()
    np.testing.assert_allclose(result["joints"][0], first(), atol=1e-9)


def test_the_cost_is_the_integral_of_squared_accelerations() -> None:
    assert reached().cost == pytest.approx(EFFORT.acceleration * effort(reached()), rel=1e-6)


@pytest.mark.long
def test_a_narrow_foot_is_used_to_its_edge_and_a_wider_one_never_costs_more() -> None:
    """Where no edge is reached its place does not matter."""
    wide, wider = reached((-3.0, 3.0)), reached((-6.0, 6.0))
    assert wider.cost == pytest.approx(wide.cost, rel=1e-6)
    swing = zero_moment_points(wide, inside(wide))[0]
    edges = float(swing.min()) + 0.01, 0.5
    narrow = reached(edges)
    assert narrow.audit().passed
    assert narrow.cost > wide.cost * (1 + 1e-5)
    place = zero_moment_points(narrow, inside(narrow))[0]
    assert edges[0] - 1e-3 < place.min() < edges[0] + 1e-3


def test_twice_the_time_costs_an_eighth_where_the_foot_is_wide() -> None:
    """Accelerations fall with the square of the time: their squares' integral with its cube."""
    wide, slow = reached((-3.0, 3.0)), reached((-3.0, 3.0), 2 * SECONDS)
    assert slow.cost == pytest.approx(wide.cost / 8, rel=1e-6)
    share = np.linspace(0.0, 1.0, 51)
    paths = [one.at(share * one.horizon)["joints"] for one in (wide, slow)]
    np.testing.assert_allclose(paths[1], paths[0], atol=1e-5)


def test_the_reversed_motion_costs_no_more() -> None:
    """A film of it played backwards stands as well: reactions depend on accelerations and squares of rates."""
    there = reached()
    end = there["joints"][-1]
    back = plan(machine(), moved(end, -SHIFT), SECONDS, start=end, cost=EFFORT)
    assert back.audit().passed
    assert back.cost <= there.cost * (1 + 1e-6)


def test_a_machine_in_another_plane_and_place_moves_alike() -> None:
    options, angle = machine(), np.radians(90.0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    shift = np.array([0.4, -0.3, 0.0])
    corners = options.support.vertices @ turn[:2, :2].T + shift[:2]
    other = replace(options, rotation=turn @ np.asarray(options.rotation), translation=shift, support=Support(corners))
    begin = ca.DM(tip_at(other, first())[[0, 2]])
    by = ca.DM([-SHIFT[0], SHIFT[1]])
    task = led(lambda t: begin + by * rest_to_rest(t / SECONDS), (3, 5))
    result = plan(other, task, SECONDS, start=first(), cost=EFFORT)
    assert result.cost == pytest.approx(reached().cost, rel=1e-5)
    times = np.linspace(0.0, SECONDS, 51)
    np.testing.assert_allclose(result.at(times)["joints"], reached().at(times)["joints"], atol=1e-4)


def test_a_start_that_is_searched_stands_and_does_the_same() -> None:
    result = plan(machine(), moved(first(), SHIFT), SECONDS, search="start", cost=EFFORT)
    assert result.audit().passed
    place = zero_moment_points(result, inside(result))[0]
    assert EDGES[0] - 1e-4 < place.min()
    assert place.max() < EDGES[1] + 1e-4
    tips = bodies(result.at([0.0, SECONDS])["joints"])[2]
    begin = tip_at(planar_machine(SIZE), first())[1:]
    np.testing.assert_allclose(tips, [begin, begin + SHIFT], atol=1e-5)
    assert result.candidates[0].reason is None


def test_tasks_with_speed_at_their_ends_do_not_begin_at_rest() -> None:
    """A tip at constant speed: joints are free to move at both ends."""
    begin = ca.DM(tip_at(planar_machine(SIZE), first())[1:])
    task = led(lambda t: begin + ca.DM(SHIFT) * t / SECONDS, ROWS)
    result = plan(machine(), task, SECONDS, start=first(), cost=EFFORT)
    assert result.audit().passed
    assert np.abs(result.at([0.0, SECONDS])["rates"]).max(axis=1).min() > 0.05
    tips = bodies(result.at([0.5, 1.5])["joints"])[2]
    np.testing.assert_allclose(np.diff(tips, axis=0)[0], SHIFT / SECONDS, atol=2e-5)


def test_a_saved_plan_is_the_same_motion(tmp_path: Path) -> None:
    reached().save(tmp_path / "stands.npz")
    again = Plan.load(tmp_path / "stands.npz")
    assert again.audit().passed
    times = inside(again)
    np.testing.assert_array_equal(again.at(times)["joints"], reached().at(times)["joints"])


def published_model() -> Any:
    """Return the five rods of Yoo et al. 2004 in Pinocchio, by their printed lengths and masses."""
    model, parent, place = pinocchio.Model(), 0, pinocchio.SE3.Identity()
    data = zip((0.44, 0.44, 0.52, 0.26, 0.18), (6.02, 14.0, 35.0, 3.92, 2.38), strict=True)
    for k, (length, mass) in enumerate(data):
        parent = model.addJoint(parent, pinocchio.JointModelRX(), place, f"joint{k}")
        rod = mass * length**2 / 12 * np.diag([1.0, 0.0, 1.0])
        model.appendBodyToJoint(
            parent, pinocchio.Inertia(mass, np.array([0, length / 2, 0]), rod), pinocchio.SE3.Identity()
        )
        place = pinocchio.SE3(np.eye(3), np.array([0.0, length, 0.0]))
    model.addFrame(pinocchio.Frame("tip", parent, place, pinocchio.FrameType.OP_FRAME))
    return model


@pytest.mark.parametrize(
    ("force", "width", "breaks"),
    [
        (20.0, 0.3, ()),
        pytest.param(200.0, 0.3, (), marks=pytest.mark.long),
        (200.0, 0.1, ()),
        pytest.param(200.0, 0.003, (2.991, 3.0, 3.009), marks=pytest.mark.long),
    ],
)
def test_a_hand_that_is_pushed_for_a_moment_goes_on_and_stands_by_pinocchio(
    force: float, width: float, breaks: tuple[float, ...]
) -> None:
    """A push of Gaussian shape, N, 3 s after the start, while the hand is lifted by 0.8 m and lowered again.

    The mesh resolves pushes of some width, s, by itself. A shorter one lies between all its samples without `breaks`.
    """
    robot, start, margin = standing_example(), STANDING_STARTS[1], 0.02
    place = tip_at(robot, start)[1:]

    def push(t: Any) -> Any:
        return force * ca.exp(-(((t - 3.0) / width) ** 2) / 2)

    def height(t: Any) -> Any:
        return place[1] + 0.4 * (1 - ca.cos(t))

    result = plan(
        robot,
        TipTask(position=lambda t: [place[0], height(t)], rows=ROWS, breaks=breaks),
        2 * np.pi,
        start=start,
        limits=Limits(velocity=6.0, acceleration=60.0, zmp=InFoot(margin=margin)),
        scene=Scene(wrenches=lambda t, tip: [robot.tip_wrench((0.0, push(t), 0.0))]),
    )
    assert result.audit().passed

    fine = np.sort([*inside(result), *3.0 + width * np.linspace(-3.0, 3.0, 601)])
    motion = result.sampled(fine)
    histories = (motion.joints, motion.rates, motion.accelerations)
    for values, rates in pairwise(histories):  # the accelerations are those of the motion: by the trapezoidal rule
        error = np.diff(values, axis=0) - np.diff(fine)[:, None] * (rates[1:] + rates[:-1]) / 2
        assert np.abs(error.cumsum(axis=0)).max() < 1e-3 * np.ptp(values, axis=0).max()

    model, points, forces = published_model(), [], []
    data, tip = model.createData(), model.getFrameId("tip")
    for t, q, velocities, accelerations in zip(fine, *histories, strict=True):
        change = pinocchio.computeCentroidalMomentumTimeVariation(model, data, q, velocities, accelerations)
        pinocchio.updateFramePlacements(model, data)
        hand, centre = data.oMf[tip].translation, data.com[0]
        np.testing.assert_allclose(hand[1:], [place[0], float(height(t))], atol=1e-5)
        weight, outside = data.mass[0] * np.array([0, 0, -GRAVITY]), np.array([0.0, float(push(t)), 0.0])
        ground = change.linear - weight - outside
        moment = np.cross(centre, change.linear) + change.angular - np.cross(centre, weight) - np.cross(hand, outside)
        points.append(moment[0] / ground[2])
        forces.append(ground[2])
    assert min(forces) > 0
    excess = max(-0.1 + margin - min(points), max(points) - 0.2 + margin)
    assert excess < result.audit()["zero moment point"].value + 1e-5  # of the requested margin
    assert result.audit()["zero moment point"].value < 0.1 * margin


def test_a_foot_beside_the_plane_in_which_all_moves_is_refused() -> None:
    beside = replace(machine(), support=rectangle((0.05, 0.2), EDGES), most_stable_point=None, half_widths=None)
    with pytest.raises(ProblemError, match="zero moment point"):
        plan(beside, moved(first(), SHIFT), SECONDS, start=first(), cost=EFFORT)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("cyclic", {"cyclic": True}),
        ("horizon", {"horizon": None}),
        ("horizon", {"horizon": "free"}),
        ("task 0", {"tasks": TipTask(position=[0.5, 1.0], rows=ROWS, begin=1.0)}),
        ("cost", {"cost": Cost(weights=np.ones(SIZE))}),
        ("start", {"tasks": TipTask(velocity=[0.1, 0.0], rows=ROWS), "start": None}),
        ("velocity", {"limits": Limits(velocity=[1.0, 2.0])}),
    ],
)
def test_options_unsupported_by_standing_plans_are_refused_by_name(name: str, changes: dict[str, Any]) -> None:
    options: dict[str, Any] = {"tasks": moved(first(), SHIFT), "horizon": SECONDS, "start": first(), "cost": EFFORT}
    with pytest.raises(ProblemError) as caught:
        plan(machine(), **{**options, **changes})
    assert caught.value.name == name
