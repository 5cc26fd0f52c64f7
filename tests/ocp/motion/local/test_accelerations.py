from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy
from hypothesis import given, settings

from models import STANDING_STARTS, FixedBase, ModelError, Standing, momentum
from models.robot.kinematics import jacobian_manipulability, joint_limit_index
from ocp import AccelerationOptions, ProblemError, Start, TipTask, resolve, resolve_accelerations
from ocp.motion.local.accelerations import AccelerationSolution, Law, Layer, Stabiliser, accelerations
from ocp.motion.tasks.equations import bind, task_errors
from ocp.motion.tasks.tracks import pose_line, track_expression
from tests.models.machines.standing_machines import planar_machine, random_standing
from tests.models.robot.trees import Array, numeric, seeds
from tests.ocp.motion.builders.standing_tasks import (
    ARM_HORIZON,
    ARM_START,
    HORIZON,
    ROWS,
    SIX_START,
    TWO_START,
    arm,
    arm_task,
    led,
    machine,
    six,
    spring,
    table_task,
    tip_at,
    tip_error,
    tool,
    two,
    two_tasks,
)
from tests.ocp.motion.tasks.space_tasks import pose, turned


def table(number: int, **settings: Any) -> AccelerationSolution:
    wrenches = spring() if number == 2 else ()
    start = STANDING_STARTS[number]
    return resolve_accelerations(machine(), table_task(number), HORIZON, start=start, wrenches=wrenches, **settings)


def law(standing: Standing, task: TipTask, **settings: Any) -> Any:
    """(time, q, q') -> q'' of a law, the zero moment point at the most stable point."""
    n = standing.joint_size
    state = ca.SX.sym("time"), ca.SX.sym("q", n), ca.SX.sym("qd", n)
    result = accelerations(standing, bind(standing, task), state=state, **settings)
    return ca.Function("law", list(state), [result])


def near(rng: np.random.Generator, start: Array) -> tuple[float, Array, Array]:
    return float(rng.uniform(0, 1)), start + rng.normal(scale=0.2, size=len(start)), rng.normal(size=len(start))


def test_the_plain_pseudo_inverse_tips_over() -> None:
    result = table(1)
    zmp = result.motion.zero_moment_point[:, 1]
    assert result.stopped is None
    assert zmp.min() == pytest.approx(-0.066, abs=5e-4)
    assert zmp.max() == pytest.approx(0.250, abs=5e-4)
    assert result.motion.index.min() == pytest.approx(-5.3, abs=0.05)
    assert not result.motion.stands
    assert not result.succeeded
    assert result.tip_error.max() < 1e-9
    assert tip_error(machine(), result.motion, table_task(1)) < 1e-9


@pytest.mark.parametrize("name", ["augmented", "null_space"])
def test_pinning_the_zero_moment_point_lifts_off_although_its_index_is_1(name: Any) -> None:
    result = table(1, law=name)
    assert result.stopped is not None
    assert result.stopped.reason == "lift_off"
    assert result.stopped.time == pytest.approx(1.13, abs=5e-3)
    assert result.motion.t[-1] == result.stopped.time
    assert result.motion.ground_force[-1, 2] < 0 < result.motion.ground_force[:-1, 2].min()
    assert result.motion.index.min() == pytest.approx(1.0, abs=1e-9)
    assert not result.succeeded
    assert "lifts off at 1.13" in str(result)


def test_carried_on_past_the_lift_off_it_diverges() -> None:
    result = table(1, law="augmented", options=AccelerationOptions(stop_at_lift_off=False))
    assert result.stopped is not None
    assert result.stopped.reason == "divergence"
    assert result.stopped.time == pytest.approx(1.26, abs=5e-3)
    assert np.abs(result.motion.joint_velocities[-1]).max() > 20
    assert "diverges" in result.stopped.message


@pytest.mark.parametrize("number", [1, 2])
def test_the_augmented_and_the_null_space_form_are_equal(number: int) -> None:
    options = AccelerationOptions(stop_at_lift_off=False, speed_limit=5.0)
    both = [table(number, law=name, options=options) for name in ("augmented", "null_space")]
    for what in ("joints", "joint_velocities", "joint_accelerations"):
        matches = [getattr(solution.motion, what) for solution in both]
        np.testing.assert_allclose(matches[0], matches[1], rtol=0, atol=1e-9)
    laws = [law(arm(), arm_task(), wrenches=tool, law=name) for name in ("augmented", "null_space")]
    rng = np.random.default_rng(1)
    for _ in range(5):
        at = near(rng, ARM_START)
        np.testing.assert_allclose(numeric(laws[0](*at)), numeric(laws[1](*at)), rtol=1e-9, atol=1e-9)


def test_the_augmented_law_is_the_least_acceleration_that_does_both() -> None:
    """(20) by numpy's pseudo-inverse of the stacked rows, on a spatial arm with a wrench at the tool."""
    standing, rng = arm(), np.random.default_rng(2)
    result = law(standing, arm_task(), wrenches=tool, law="augmented")
    n = standing.joint_size
    q, qd, t = ca.SX.sym("q", n), ca.SX.sym("qd", n), ca.SX.sym("t")
    jacobian = standing.tip_jacobian((), q)[3:6, :]
    bias = ca.jtimes(ca.mtimes(jacobian, qd), q, qd)
    wanted = ca.jacobian(ca.jacobian(track_expression(arm_task().position, t, (3, 1)), t), t)
    rows = standing.zmp_rows(q, qd, (0, 0), tool(t, standing.tip_pose((), q).position))
    stack = [ca.vertcat(jacobian, rows.jacobian), ca.vertcat(wanted - bias, rows.needed(qd))]
    stacked = ca.Function("stacked", [t, q, qd], stack)
    for _ in range(5):
        at = near(rng, ARM_START)
        left, right = (numeric(part) for part in stacked(*at))
        np.testing.assert_allclose(numeric(result(*at)), np.linalg.pinv(left) @ right, rtol=1e-8, atol=1e-8)


def index_and_slope(q: Any, name: str) -> tuple[Any, Any]:
    standing = machine()
    if name == "joint_limits":
        index = joint_limit_index(standing.robot, q)
    else:
        index = jacobian_manipulability(standing.tip_jacobian((), q), ROWS)
    return index, ca.jacobian(index, q)


def printed_sequence(time: float, q0: Array, qd0: Array, delta: tuple[float, float]) -> Array:
    """(34) with the corrections: K1 = B1 (I - G+ G), K4 = B2 (I - G+ G)(I - K1+ K1), K5 with K1+ and D of (29)."""
    standing = machine()
    q, qd, t = ca.SX.sym("q", 5), ca.SX.sym("qd", 5), ca.SX.sym("t")
    jacobian = standing.tip_jacobian((), q)[ROWS, :]
    wanted = ca.jacobian(ca.jacobian(track_expression(table_task(1).position, t, (2, 1)), t), t)
    rows = standing.zmp_rows(q, qd, (0, 0))
    parts: list[Any] = [ca.vertcat(jacobian, rows.jacobian[1, :])]
    bias = ca.jtimes(ca.mtimes(jacobian, qd), q, qd)
    parts.append(ca.vertcat(wanted - bias, rows.needed(qd)[1]))
    p1, B1 = index_and_slope(q, "joint_limits")
    p2, B2 = index_and_slope(q, "manipulability")
    determinant = ca.det(ca.mtimes(jacobian, jacobian.T))
    H2, D = ca.hessian(determinant, q)[0] / (2 * p2), -(ca.mtimes(B2, qd) ** 2) / p2
    parts += [B1, ca.mtimes([qd.T, ca.hessian(p1, q)[0], qd]), B2, ca.mtimes([qd.T, H2, qd]) + D]
    values = [numeric(part) for part in ca.Function("parts", [t, q, qd], parts)(time, q0, qd0)]
    G, task, B1, bend1, B2, bend2 = values
    plus = np.linalg.pinv
    free = np.eye(5) - plus(G) @ G
    K1 = B1 @ free
    first = plus(K1) @ (delta[0] - B1 @ plus(G) @ task - bend1)
    K4 = B2 @ free @ (np.eye(5) - plus(K1) @ K1)
    K5 = B2 @ plus(G) @ task + B2 @ first + bend2
    return plus(G) @ task + first + plus(K4) @ (delta[1] - K5)


def test_layers_in_sequence_follow_the_corrected_printed_form_and_their_tasks() -> None:
    layers = (Layer("joint_limits", -0.3), Layer("manipulability", 0.2))
    result = law(machine(), table_task(1), law="augmented", options=AccelerationOptions(layers=layers))
    q, qd, qdd = (ca.SX.sym(name, 5) for name in ("q", "qd", "qdd"))
    second = []
    for name in ("joint_limits", "manipulability"):
        rate = ca.mtimes(index_and_slope(q, name)[1], qd)
        second.append(ca.jtimes(rate, ca.vertcat(q, qd), ca.vertcat(qd, qdd)))
    request = ca.Function("asked", [q, qd, qdd], second)
    rng = np.random.default_rng(3)
    for _ in range(5):
        time, q0, qd0 = near(rng, STANDING_STARTS[1])
        push = numeric(result(time, q0, qd0)).ravel()
        expected = printed_sequence(time, q0, qd0, (-0.3, 0.2)).ravel()
        np.testing.assert_allclose(push, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())
        np.testing.assert_allclose([float(part) for part in request(q0, qd0, push)], [-0.3, 0.2], atol=1e-6)


@pytest.mark.long
def test_both_forms_are_equal_on_random_trees_and_starts() -> None:
    """The least acceleration that does both tasks, whichever is written first; where the tasks are independent."""
    rng, tried = np.random.default_rng(11), 0
    while tried < 5:
        standing = random_standing(rng, 8)
        q0, qd0, push = *rng.normal(size=(2, standing.joint_size)), rng.normal(size=3)
        if standing.joint_size < 5:
            continue
        rows = ca.vertcat(standing.tip_jacobian((), q0)[4:6, :], standing.zmp_rows(q0, qd0, (0, 0)).jacobian)
        values = np.linalg.svd(numeric(rows), compute_uv=False)
        if values[-1] < 1e-2 * values[0]:
            continue
        tried += 1
        outside = {"wrenches": lambda t, tip: [standing.tip_wrench(ca.DM(push) * (1 + t) - tip)]}  # noqa: B023
        start = standing.tip_pose((), q0).position[1:3]
        matches = [
            numeric(law(standing, led(lambda t: start + ca.sin(3 * t)), law=name, **outside)(0.3, q0, qd0))  # noqa: B023
            for name in ("augmented", "null_space")
        ]
        np.testing.assert_allclose(matches[0], matches[1], rtol=1e-9, atol=1e-9 * np.abs(matches[0]).max())


@pytest.mark.parametrize("name", ["arm", "chain"])
def test_layers_accelerate_their_indices_as_requested(name: str) -> None:
    """(23)-(34) on other machines: along q + q' t + q'' t^2 / 2 each index curves by its demand."""
    if name == "arm":  # joint limits take the one degree of freedom that a task of two rows leaves on seven joints
        standing, start, rows = arm(), ARM_START, (3, 5)
    else:
        standing, rows = planar_machine(6), ROWS
        start = np.array([2.0, -1.4, 1.2, -0.4, -0.3, 0.2])
    tip = tip_at(standing, start)[[row - 3 for row in rows]]
    layers = (Layer("joint_limits", -0.4), Layer("manipulability", 0.1))
    task = led(lambda t: [tip[0] + 0.1 * ca.sin(t), tip[1]], rows)
    result = law(standing, task, law="augmented", options=AccelerationOptions(layers=layers))
    middle, width = (standing.robot.lower + standing.robot.upper) / 2, standing.robot.upper - standing.robot.lower

    def indices(q: Array) -> Array:
        jacobian = numeric(standing.tip_jacobian((), q))[list(rows)]
        return np.array([(((q - middle) / width) ** 2).sum(), np.sqrt(np.linalg.det(jacobian @ jacobian.T))])

    rng, step = np.random.default_rng(5), 2e-4
    for _ in range(4):
        time, q, qd = near(rng, start)
        qdd = numeric(result(time, q, qd)).ravel()
        motion = [indices(q + qd * t + qdd * t**2 / 2) for t in (-step, 0.0, step)]
        curve = (motion[0] - 2 * motion[1] + motion[2]) / step**2
        np.testing.assert_allclose(curve, [-0.4, 0.1], atol=2e-5 * max(1.0, np.abs(qdd).max()))


@pytest.mark.parametrize(("name", "sign"), [("joint_limits", -1.0), ("manipulability", 1.0)])
def test_a_gradient_layer_improves_its_index_without_disturbing_the_tasks(name: Any, sign: float) -> None:
    plain = law(machine(), table_task(1), law="augmented")
    options = AccelerationOptions(layers=(Layer(name, sign, "gradient"),))
    driven = law(machine(), table_task(1), law="augmented", options=options)
    q, rng = ca.SX.sym("q", 5), np.random.default_rng(4)
    slope = ca.Function("slope", [q], [index_and_slope(q, name)[1]])
    for _ in range(5):
        at = near(rng, STANDING_STARTS[1])
        added = numeric(driven(*at)) - numeric(plain(*at))
        assert sign * (numeric(slope(at[1])) @ added).item() > 0
        np.testing.assert_allclose(numeric(machine().tip_jacobian((), at[1]))[list(ROWS)] @ added, 0, atol=1e-9)
        balance = numeric(machine().zmp_rows(at[1], at[2], (0, 0)).jacobian)[1] @ added
        np.testing.assert_allclose(balance, 0, atol=1e-9)


@pytest.mark.parametrize("layer", [Layer("joint_limits", -0.1), Layer("manipulability", 0.05)])
def test_the_layers_do_not_stop_the_pinned_pendulum_from_falling(layer: Layer) -> None:
    result = table(1, law="augmented", options=AccelerationOptions(layers=(layer,)))
    assert result.stopped is not None
    assert result.stopped.time < 2.0


def test_the_stabilised_law_stands_on_table_1() -> None:
    """Page: |q'| 0.99, index 1, Fz >= 589 N, no limit violation, by poles (4, 4, 4) and damping 2."""
    result = table(1, law="stabilised")
    assert result.succeeded
    motion = result.motion
    assert motion.index.min() == pytest.approx(1.0, abs=1e-9)
    assert np.abs(motion.joint_velocities).max() == pytest.approx(0.99, rel=0.05)
    assert motion.ground_force[:, 2].min() >= 589
    assert result.tip_error.max() < 1e-9


def test_slower_poles_ask_less_of_the_joints() -> None:
    """The page's 5.9 rad/s^2 is that of poles of 3.5 1/s: the peak stands at the start, where k1 alone decides."""
    stabiliser = Stabiliser((3.5, 3.5, 3.5), gradient=1.0)
    motion = table(1, law="stabilised", options=AccelerationOptions(stabiliser=stabiliser)).motion
    assert motion.stands
    assert motion.stays_in_limits
    assert np.abs(motion.joint_accelerations).max() == pytest.approx(5.9, rel=0.05)
    assert np.abs(motion.joint_velocities).max() == pytest.approx(0.99, rel=0.05)
    assert motion.ground_force[:, 2].min() >= 589


def test_the_stabilised_law_fails_on_table_2() -> None:
    result = table(2, law="stabilised")
    assert not result.succeeded
    assert result.failures
    assert result.failures[0] in str(result)


def test_an_index_of_1_is_no_success_where_the_ground_would_pull_or_a_joint_is_beyond_its_limits() -> None:
    """The pinned pendulum carried on past its lift-off, but stopped before it diverges; and tighter joint limits."""
    flies = resolve_accelerations(
        machine(),
        table_task(1),
        1.2,
        start=STANDING_STARTS[1],
        law="augmented",
        options=AccelerationOptions(stop_at_lift_off=False),
    )
    assert flies.stopped is None
    assert flies.motion.index.min() == pytest.approx(1.0, abs=1e-9)
    assert flies.motion.stays_in_foot
    assert flies.failures[0] == "lift_off"
    assert not flies.succeeded

    standing = machine()
    joints = [replace(joint, upper=min(joint.upper, 3.0)) if i == 0 else joint for i, joint in
              enumerate(standing.robot.joints)]  # fmt: skip
    joints[3] = replace(joints[3], lower=STANDING_STARTS[1][3] - 0.01, upper=STANDING_STARTS[1][3] + 0.01)
    narrow = replace(standing, robot=replace(standing.robot, joints=tuple(joints)))
    perturbed = resolve_accelerations(
        narrow, table_task(1), HORIZON, start=STANDING_STARTS[1], law="stabilised", step=5e-3
    )
    assert perturbed.stopped is None
    assert perturbed.motion.index.min() == pytest.approx(1.0, abs=1e-9)
    assert perturbed.motion.stands
    assert perturbed.failures == ("joint_limits",)
    assert "joint_limits" in str(perturbed)


def test_a_tip_that_is_lost_by_long_steps_is_no_success() -> None:
    """Held still by a path that swings faster than the steps see."""
    _, y, z = tip_at(machine(), STANDING_STARTS[1])
    swinging, options = led(lambda t: [y, z + 0.02 * ca.sin(40 * t) ** 2]), AccelerationOptions(null_damping=2.0)
    result = resolve_accelerations(machine(), swinging, 0.5, start=STANDING_STARTS[1], step=0.05, options=options)
    assert result.tip_error.max() > 1e-3
    assert "leaves_path" in result.failures


@pytest.mark.long
@given(seeds)
@settings(max_examples=8)
def test_random_machines_stop_for_a_named_reason_or_reach_the_horizon_with_sound_numbers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    standing = planar_machine(int(rng.integers(4, 7)))
    start = rng.uniform(-2.5, 2.5, size=standing.joint_size)
    _, y, z = tip_at(standing, start)
    laws: tuple[Law, ...] = ("augmented", "null_space", "pseudo_inverse")
    law = laws[int(rng.integers(3))]

    def path(t: Any) -> list[Any]:
        return [y + 0.1 * ca.sin(t) ** 2, z]

    result = resolve_accelerations(standing, led(path), 1.0, start=start, law=law, step=1e-2)
    motion = result.motion
    assert np.isfinite(np.hstack([motion.joints, motion.joint_velocities, motion.joint_accelerations])).all()
    if result.stopped is None:
        assert motion.t[-1] == pytest.approx(1.0)
    else:
        assert result.failures[0] == result.stopped.reason
        assert f"{result.stopped.time:.4g} s" in result.stopped.message
    sound = (motion.ground_force[:, 2] > 0).all() and (motion.foot_margin >= -1e-9).all()
    assert result.succeeded <= (sound and (motion.joint_excess <= 1e-9).all() and result.stopped is None)


def test_the_pinned_pendulum_obeys_its_equation() -> None:
    """dL/dt = -M g (y_c - p), along the augmented and the stabilised motion alike."""
    for name in ("augmented", "stabilised"):
        result = table(1, law=name).motion
        standing, inner = machine(), slice(0, 1000)
        q, qd = ca.SX.sym("q", 5), ca.SX.sym("qd", 5)
        total = momentum(standing.robot, q, qd, world_from_base=standing.world_from_base())
        function = ca.Function("spin", [q, qd], [total[0]]).map(1000)
        spin = numeric(function(result.joints[inner].T, result.joint_velocities[inner].T)).ravel()
        rate = np.gradient(spin, result.t[inner])
        expected = -standing.weight * result.center_of_mass[inner, 1]
        np.testing.assert_allclose(rate[1:-1], expected[1:-1], atol=2e-2)


def test_null_space_damping_keeps_the_pseudo_inverse_inside_the_foot() -> None:
    assert table(1, options=AccelerationOptions(null_damping=2.0)).motion.stands


def test_a_moving_reference_is_followed() -> None:
    options = AccelerationOptions(zmp=lambda t: [0.0, 0.05 * ca.sin(3 * t)])
    result = table(1, law="augmented", options=options)
    t = result.motion.t[:500]
    np.testing.assert_allclose(result.motion.zero_moment_point[:500, 1], 0.05 * np.sin(3 * t), atol=1e-9)


def test_the_integration_is_of_fourth_order_toward_the_solution_of_scipy() -> None:
    standing = machine()
    n, function = standing.joint_size, law(standing, table_task(1), law="pseudo_inverse")
    at_rest = np.concatenate([STANDING_STARTS[1], np.zeros(n)])

    def rate(time: float, x: Array) -> Array:
        return np.concatenate([x[n:], numeric(function(time, x[:n], x[n:])).ravel()])

    exact = scipy.integrate.solve_ivp(rate, (0.0, HORIZON), at_rest, "DOP853", rtol=1e-12, atol=1e-12)
    errors = [np.abs(table(1, step=step).motion.joints[-1] - exact.y[:n, -1]).max() for step in (0.2, 0.1)]
    assert errors[1] < 1e-5
    assert 3.3 < np.log2(errors[0] / errors[1]) < 4.7


def test_a_spatial_arm_with_a_wrench_at_the_tool_is_resolved_and_tips() -> None:
    result = resolve_accelerations(arm(), arm_task(), ARM_HORIZON, start=ARM_START, wrenches=tool, step=2e-3)
    assert result.stopped is None
    assert result.tip_error.max() < 1e-9
    assert result.motion.index.min() < -0.3
    np.testing.assert_allclose(result.motion.external_force[:, 2], -25 - 20 * result.motion.t, atol=1e-9)


def test_an_arm_that_runs_into_a_singularity_breaks_down_or_diverges() -> None:
    """The tip of Table 1 moved on beyond the stretched arm."""
    _, y, z = tip_at(machine(), STANDING_STARTS[1])

    def path(t: Any) -> list[Any]:
        return [y + (1.8 - y) * t**2, z * (1 - t**2)]

    result = resolve_accelerations(
        machine(), led(path), 1.0, start=STANDING_STARTS[1], options=AccelerationOptions(stop_at_lift_off=False)
    )
    assert result.stopped is not None
    assert result.stopped.reason in ("divergence", "breakdown")
    assert np.isfinite(result.motion.joint_accelerations).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"law": "magic"}, "law must be .* not 'magic'"),
        ({"step": 0.0}, "step must be positive"),
        ({"step": "short"}, "step must be positive"),
        ({"options": AccelerationOptions(zmp=lambda t: t), "law": "augmented"}, "zmp must be two numbers"),
        ({"tasks": TipTask(velocity=(0.0, 0.0), rows=(1, 4))}, r"no joint moves the tip in rows \[1\]"),
        ({"start": Start(STANDING_STARTS[1], velocity=(1.0,))}, "start: velocity has shape .1,., expected .5,."),
        ({"start": None}, "start is missing"),
        ({"options": {"zmp": (0.0, 0.0)}}, "options must be"),
        ({"options": AccelerationOptions(zmp=(0.0,))}, "zmp must be two numbers"),
        ({"tasks": led(lambda t: [0.0, 0.5])}, "'link5' is .* away from where its task begins"),
        ({"tasks": led(lambda t: [0.0])}, r"position has shape \(1, 1\), expected \(3, 1\) or \(2, 1\)"),
        (
            {
                "law": "stabilised",
                "options": AccelerationOptions(layers=(Layer("joint_limits", -1.0), Layer("manipulability", 1.0))),
            },
            "needs 6 joints .* there are 5",
        ),
    ],
)
def test_requests_that_cannot_be_right_are_refused(changes: dict[str, Any], message: str) -> None:
    arguments = {"tasks": table_task(1), "start": STANDING_STARTS[1], "horizon": 1.0, **changes}
    with pytest.raises(ProblemError, match=message) as caught:
        resolve_accelerations(machine(), **arguments)
    assert (caught.value.name or "unnamed") in str(caught.value)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Layer("reach", 1.0), "index must be .* not 'reach'"),  # type: ignore[arg-type]
        (lambda: Layer("joint_limits", 1.0, "soft"), "form must be .* not 'soft'"),  # type: ignore[arg-type]
        (lambda: Layer("joint_limits", np.nan), "demand must be a finite number"),
        (lambda: Stabiliser((4.0, 4.0, -1.0)), "poles .* is not positive"),
        (lambda: Stabiliser("fast"), "poles .* is not numeric"),  # type: ignore[arg-type]
        (lambda: AccelerationOptions(speed_limit=-1.0), "speed_limit must be positive"),
        (lambda: AccelerationOptions(null_damping=-1.0), "null_damping must be"),
        (lambda: AccelerationOptions(layers=("limits",)), "layers must be a list of Layer"),  # type: ignore[arg-type]
        (lambda: AccelerationOptions(stabiliser=3), "stabiliser must be"),  # type: ignore[arg-type]
        (lambda: Stabiliser(damping=-1.0), "damping must be a finite number, zero or above"),
    ],
)
def test_options_that_cannot_be_right_are_refused(make: Any, message: str) -> None:
    with pytest.raises(ProblemError, match=message) as caught:
        make()
    assert (caught.value.name or "unnamed") in str(caught.value)


@pytest.mark.parametrize(
    ("wrenches", "message"),
    [
        (3, "wrenches must be a list"),
        (lambda time, tip: None, "wrenches must be a list"),
        (lambda time, tip: machine().tip_wrench((0, 0, 1)), "wrenches must be a list"),
    ],
)
def test_functions_without_wrenches_are_refused(wrenches: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        resolve_accelerations(machine(), table_task(1), 1.0, start=STANDING_STARTS[1], wrenches=wrenches)


def test_a_force_that_is_no_number_breaks_the_motion_down() -> None:
    def push(time: Any, tip: Any) -> Any:
        return [machine().tip_wrench((0, 0, ca.sqrt(0.1 - time)))]

    result = resolve_accelerations(machine(), table_task(1), 0.3, start=STANDING_STARTS[1], wrenches=push, step=0.01)
    assert result.stopped is not None
    assert result.stopped.reason == "breakdown"
    assert result.stopped.time == pytest.approx(0.11)
    assert np.isfinite(result.motion.ground_force).all()


def test_a_pose_that_fixes_all_joints_determines_the_motion() -> None:
    """Six rows on six joints leave no choice: both levels of one task have the same joint motion."""
    rotation, position = pose(six(), (), SIX_START)
    goal = rotation @ turned((1, 2, 0.5), 0.4), position + np.array([0.02, 0.15, -0.1])
    line = pose_line((rotation, position), goal, 1.0)
    task = TipTask(position=line.position, orientation=line.orientation)
    slow = resolve(FixedBase(six().robot), task, 1.0, start=SIX_START, samples=11)
    fast = resolve_accelerations(six(), task, 1.0, start=SIX_START, step=0.01)
    assert fast.tip_error.max() < 1e-8
    np.testing.assert_allclose(fast.motion.joints[::10], slow.joints, atol=1e-7)
    np.testing.assert_allclose(fast.motion.joint_velocities[::10], slow.joint_rates, atol=1e-6)


def test_the_feedback_of_accelerations_closes_a_gap_critically_damped() -> None:
    """e'' + 2 g e' + g^2 e = 0 from rest: e = e0 (1 + g t) exp(-g t)."""
    _, y, z = tip_at(machine(), STANDING_STARTS[1])
    task = TipTask(position=(y + 0.003, z - 0.004), rows=ROWS, gain=3.0, start_gap=0.01)
    result = resolve_accelerations(machine(), task, 1.0, start=STANDING_STARTS[1], step=0.01)
    expected = 0.005 * (1 + 3 * result.motion.t) * np.exp(-3 * result.motion.t)
    np.testing.assert_allclose(result.tip_error, expected, atol=1e-9)


def test_two_tips_are_led_at_once() -> None:
    """A hand that is told nothing moves with the body; both stay on their paths where both are told."""
    tasks = two_tasks((0.1, 0.0, 0.1), (0.0, -0.1, 0.0))
    one, both = (resolve_accelerations(two(), some, 0.5, start=TWO_START, step=0.01) for some in (tasks[0], tasks))
    np.testing.assert_allclose(both.tip_error, 0, atol=1e-8)
    errors = task_errors(two(), tasks, one.motion.t, one.motion.joints)
    assert np.abs(errors[:, :3]).max() < 1e-8
    assert np.abs(errors[:, 3:]).max() > 1e-3
