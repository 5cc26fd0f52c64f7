"""The paper's recursion against automatic differentiation of link frames, which shares nothing with it.

Errors are relative to the greatest entry of what is compared. The printed forms of the corrected equations stand here,
beside a proof that they fail.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, settings
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from models import FreeFloating, Joint, Link, ModelError, Robot, link_frames, paper_example, tip_pose
from models.costates import (
    costate_rate,
    generalized_jacobian,
    hamiltonian,
    optimal_control,
    partials,
    resolution,
    state_rate,
)
from models.parts import Kind
from models.recursion import D, J, dD, dJ
from models.spatial import rotation
from models.virtual_chain import VirtualChain, joint_transform, motion_cross, transforms
from tests.models.trees import (
    Array,
    Base,
    momentum_by_differentiation,
    numeric,
    random_inertia,
    random_robot,
    random_rotation,
    seeds,
    twist_by_differentiation,
    vee,
)

TOLERANCE = 1e-12
CLEARLY = 0.05
"""Relative error above which a formula is wrong, not inaccurate."""

LINEAR = [3, 4, 5]


def error(found: Any, expected: Any) -> float:
    """Greatest difference relative to the greatest entry expected."""
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.shape == expected.shape
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def serial_robot(rng: np.random.Generator, size: int, base: Base = "spatial") -> Robot:
    """Serial arm of `size` moving joints with fixed links between and beside them."""
    links, joints = [Link("base", 20.0, rng.normal(scale=0.2, size=3), random_inertia(rng, 40.0))], list[Joint]()

    def attach(name: str, kind: Kind, parent: str) -> None:
        mass = float(rng.uniform(0.5, 3.0))
        links.append(Link(name, mass, rng.normal(scale=0.3, size=3), random_inertia(rng, mass)))
        turn = random_rotation(rng)
        axis = rng.normal(size=3)
        if base == "planar":
            turn = Rotation.from_euler("z", rng.uniform(-3, 3)).as_matrix()
            axis = np.array([*rng.normal(size=2), 0.0] if kind == "prismatic" else [0.0, 0.0, rng.choice([-1.0, 1.0])])
        joints.append(Joint(f"to {name}", kind, parent, name, rng.normal(scale=0.6, size=3), turn, axis))

    attach("panel", "fixed", "base")
    above = "base"
    kinds: tuple[Kind, ...] = ("revolute", "continuous", "revolute", "prismatic")
    for i in range(size):
        if i % 3 == 1:
            attach(f"bracket{i}", "fixed", above)
            above = f"bracket{i}"
        attach(f"link{i}", kinds[i % 4], above)
        above = f"link{i}"
    attach("camera", "fixed", above)
    attach("tool", "fixed", above)
    turn = Rotation.from_euler("z", 0.4).as_matrix() if base == "planar" else random_rotation(rng)
    return Robot(tuple(links), tuple(joints), "tool", rng.normal(scale=0.3, size=3), turn)


@dataclass(frozen=True)
class Case:
    """A machine, its chain, a task, a point, and the symbolic truth by automatic differentiation of frames.

    `truth(x)` gives D, J, dD, dJ, the tip's R = ER_0 and r_E, and the partials of R and of -R [r_E x]; `principle(x,
    lam, v)` what the minimum principle makes of D and J, and `derivatives(x, lam, v)` the derivatives of that.
    """

    machine: FreeFloating
    chain: VirtualChain
    rows: list[int]
    x: Array
    lam: Array
    v: Array
    truth: Any
    principle: Any
    derivatives: Any

    @property
    def task(self) -> tuple[VirtualChain, Array, Array, Array, list[int]]:
        return self.chain, self.x, self.lam, self.v, self.rows


def by_index(jacobian: Any, shape: tuple[int, int]) -> Array:
    """Jacobian of a column-major matrix as partials with the variable's index first. Shape (N, *shape)."""
    return numeric(jacobian).T.reshape(-1, shape[1], shape[0]).transpose(0, 2, 1)


def placement(machine: FreeFloating, x1: Any) -> Any:
    """Frame of the base at the coordinates of the virtual joints."""
    if machine.base == "planar":
        return machine.world_from_base(x1)
    turn = ca.mtimes([rotation(axis, x1[3 + i]) for i, axis in enumerate(np.eye(3).tolist())])
    return turn, x1[0:3]


def make_case(machine: FreeFloating, rows: list[int], rng: np.random.Generator, x: Array | None = None) -> Case:
    chain = VirtualChain.from_machine(machine)
    N, n = chain.N, chain.n
    size = N - n

    q, dq = ca.SX.sym("q", N), ca.SX.sym("dq", N)
    base = placement(machine, q[:n])
    frames, tip = link_frames(machine.robot, q[n:], base), tip_pose(machine.robot, q[n:], base)
    momentum = ca.jacobian(momentum_by_differentiation(machine.robot, frames, q, dq), dq)
    jacobian = ca.jacobian(twist_by_differentiation(tip.rotation, tip.position, q, dq), dq)
    R, r = ca.densify(tip.rotation.T), ca.densify(tip.position)
    lower = -ca.mtimes(R, ca.skew(r))
    outputs = [momentum, jacobian, ca.jacobian(momentum, q), ca.jacobian(jacobian, q), R, r]
    outputs += [ca.jacobian(R, q), ca.jacobian(ca.jacobian(R, q), q), ca.jacobian(lower, q)]
    truth = ca.Function("truth", [q], [ca.densify(output) for output in outputs])
    matrices = ca.Function("matrices", [q], [ca.densify(momentum), ca.densify(jacobian)])

    xs, lam, v, u = ca.MX.sym("x", N), ca.MX.sym("lam", N), ca.MX.sym("v", len(rows)), ca.MX.sym("u", size)
    E, F = matrices(xs)
    E, F = E[chain.momentum_rows, :], F[rows, :]
    drift = -ca.solve(E[:, :n], E[:, n:])
    G = F[:, n:] + ca.mtimes(F[:, :n], drift)
    G_pinv = ca.solve(ca.mtimes(G, G.T), G).T
    Phi, Gamma = ca.mtimes(G_pinv, v), ca.MX.eye(size) - ca.mtimes(G_pinv, G)
    # The least of 1/2 |r|^2 + lam . x'(r) with G r = v, by its own optimality system: no u*, no projector.
    weight = lam[n:] + ca.mtimes(drift.T, lam[:n])
    system = ca.vertcat(ca.horzcat(ca.MX.eye(size), G.T), ca.horzcat(G, ca.MX(len(rows), len(rows))))
    rates = ca.solve(system, ca.vertcat(-weight, v))[:size]
    least = ca.dot(rates, rates) / 2 + ca.dot(weight, rates)
    given = ca.mtimes(Gamma, u) + Phi
    at_control = ca.dot(given, given) / 2 + ca.dot(weight, given)
    principle = ca.Function("principle", [xs, lam, v], [least, -weight, G, Gamma, Phi, rates])
    derivatives = ca.Function(
        "derivatives",
        [xs, lam, v, u],
        [-ca.gradient(least, xs), -ca.gradient(at_control, xs), ca.gradient(least, lam)]
        + [ca.jacobian(ca.vec(part), xs) for part in (-weight, Phi, Gamma, G)],
    )

    found = x
    while found is None:
        draw = np.concatenate([rng.normal(size=n), rng.uniform(-2, 2, size=size)])
        draw[min(n - 1, 4)] *= 0.5  # keep clear of the Euler angle at pi/2
        if np.linalg.cond(generalized_jacobian(chain, draw)[rows]) < 20:
            found = draw
    lam_at, v_at = rng.normal(size=N), rng.normal(size=len(rows))
    return Case(machine, chain, rows, found, lam_at, v_at, truth, principle, derivatives)


@cache
def spatial_case(size: int) -> Case:
    """6 + size joints; the task leaves at least one joint free, and all six rows when it can."""
    rng = np.random.default_rng(100 + size)
    rows = [3, 5] if size == 3 else [0, 4, 5] if size < 7 else list(range(6))
    return make_case(FreeFloating(serial_robot(rng, size)), rows, rng)


@cache
def planar_case(size: int) -> Case:
    rng = np.random.default_rng(200 + size)
    machine = FreeFloating(serial_robot(rng, size, "planar"), "planar")
    return make_case(machine, [3, 4] if size < 5 else [4, 2, 3], rng)


@cache
def example() -> Case:
    """The paper's own example at its start."""
    rng = np.random.default_rng(0)
    case = make_case(paper_example(), [3, 4], rng, np.deg2rad([0.0, 0.0, 0.0, 45.0, 60.0, -60.0]))
    case.v[:] = -1.0
    return case


SPATIAL = [pytest.param(spatial_case, size, id=f"6+{size}") for size in range(3, 11)]
PLANAR = [pytest.param(planar_case, size, id=f"3+{size}") for size in (3, 5)]
EXAMPLE = [pytest.param(lambda _: example(), 0, id="example")]
every_case = pytest.mark.parametrize(("build", "size"), SPATIAL + PLANAR + EXAMPLE)


# The chain


@every_case
def test_transforms_place_the_tip_where_the_tree_does(build: Any, size: int) -> None:
    """(12): EX_0 = [R, 0; -R [r_E x], R]."""
    case = build(size)
    X = case.chain.X_tip @ np.linalg.multi_dot(transforms(case.chain, case.x)[::-1])
    R, r = (numeric(part) for part in case.truth(case.x)[4:6])
    assert error(X[:3, :3], R) < TOLERANCE
    assert error(X[3:, 3:], R) < TOLERANCE
    assert error(X[3:, :3], -R @ numeric(ca.skew(r))) < TOLERANCE
    assert not X[:3, 3:].any()


def test_partials_of_a_joint_transform_are_the_papers() -> None:
    """(41): dX/dq = -[S x] X, by the exponential series of -[S x] q."""
    rng = np.random.default_rng(1)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    for S in (np.concatenate([axis, np.zeros(3)]), np.concatenate([np.zeros(3), axis])):
        term = series = np.eye(6)
        for power in range(1, 40):
            term = term @ motion_cross(S) * (-1.3 / power)
            series = series + term
        assert error(joint_transform(S, 1.3), series) < TOLERANCE


def test_virtual_links_are_massless_and_the_last_is_the_satellite() -> None:
    case = example()
    assert case.chain.N == 6
    assert case.chain.n == 3
    assert not case.chain.H[:2].any()
    assert case.chain.H[2, 3:, 3:].tolist() == (100.0 * np.eye(3)).tolist()
    assert case.chain.H[2, 2, 2] == 66.67
    assert sum(H[5, 5] for H in spatial_case(7).chain.H) == pytest.approx(spatial_case(7).machine.robot.total_mass)


# Algorithms 1-4


@every_case
def test_algorithm_1_is_the_momentum_of_differentiated_frames(build: Any, size: int) -> None:
    case = build(size)
    assert error(D(case.chain, case.x), numeric(case.truth(case.x)[0])) < TOLERANCE


@every_case
def test_algorithm_1_is_the_momentum_matrices_in_virtual_coordinates(build: Any, size: int) -> None:
    """E1, E2 of the models take a base twist; the rates of the virtual joints make that twist."""
    case = build(size)
    n, x1 = case.chain.n, case.x[: case.chain.n]
    if n == 3:
        base, twist_of_rates = x1, np.eye(3)[[2, 0, 1]]
    else:
        turn = Rotation.from_euler("XYZ", x1[3:])
        base = np.concatenate([x1[:3], turn.as_quat(scalar_first=True)])
        first = Rotation.from_euler("X", x1[3]).as_matrix()
        axes = [np.eye(3)[0], first[:, 1], turn.as_matrix()[:, 2]]
        twist_of_rates = np.block([[np.zeros((3, 3)), np.column_stack(axes)], [np.eye(3), np.zeros((3, 3))]])
    E1, E2 = (numeric(part) for part in case.machine.momentum_matrices(base, case.x[n:]))
    found = D(case.chain, case.x)[case.chain.momentum_rows]
    assert error(found, np.hstack([E1 @ twist_of_rates, E2])) < TOLERANCE
    expected = numeric(case.machine.tip_jacobian(base, case.x[n:]))
    assert error(generalized_jacobian(case.chain, case.x), expected) < TOLERANCE


@every_case
def test_algorithm_2_is_the_derivative_of_the_tip_frame(build: Any, size: int) -> None:
    case = build(size)
    assert error(J(case.chain, case.x), numeric(case.truth(case.x)[1])) < TOLERANCE


@every_case
def test_algorithm_3_is_the_derivative_of_the_momentum_matrix(build: Any, size: int) -> None:
    case = build(size)
    expected = by_index(case.truth(case.x)[2], (6, case.chain.N))
    assert error(dD(case.chain, case.x), expected) < TOLERANCE


@every_case
def test_algorithm_4_is_the_derivative_of_the_tip_jacobian(build: Any, size: int) -> None:
    case = build(size)
    expected = by_index(case.truth(case.x)[3], (6, case.chain.N))
    assert error(dJ(case.chain, case.x), expected) < TOLERANCE


# The minimum principle


@every_case
def test_hamiltonian_is_the_least_over_all_rates_that_do_the_task(build: Any, size: int) -> None:
    """(25), (26), (31), (32) against the optimality system of the pointwise minimisation."""
    case = build(size)
    least, u, G, Gamma, Phi, rates = (numeric(part) for part in case.principle(case.x, case.lam, case.v))
    at = resolution(case.chain, case.x, case.v, case.rows)
    assert error(hamiltonian(*case.task), least[0, 0]) < TOLERANCE
    assert error(optimal_control(case.chain, case.x, case.lam), u[:, 0]) < TOLERANCE
    assert error(at.G, G) < TOLERANCE
    assert error(at.Gamma, Gamma) < TOLERANCE
    assert error(at.Phi, Phi[:, 0]) < TOLERANCE
    assert error(state_rate(*case.task)[case.chain.n :], rates[:, 0]) < TOLERANCE


@every_case
def test_state_rate_keeps_momentum_zero_and_does_the_task(build: Any, size: int) -> None:
    case = build(size)
    rate = state_rate(*case.task)
    momentum = D(case.chain, case.x)
    flow = (momentum @ rate)[case.chain.momentum_rows]
    assert np.abs(flow).max() < TOLERANCE * np.abs(momentum).max() * np.abs(rate).max()
    assert error((J(case.chain, case.x) @ rate)[case.rows], case.v) < 10 * TOLERANCE


@every_case
def test_partials_are_those_of_automatic_differentiation(build: Any, size: int) -> None:
    """(36)-(39), corrected."""
    case = build(size)
    joints = case.chain.N - case.chain.n
    u = optimal_control(case.chain, case.x, case.lam)
    u_x, Phi_x, Gamma_x, G_x = case.derivatives(case.x, case.lam, case.v, u)[3:]
    found = partials(*case.task)
    assert error(found.u, by_index(u_x, (joints, 1))[:, :, 0]) < TOLERANCE
    assert error(found.Phi, by_index(Phi_x, (joints, 1))[:, :, 0]) < TOLERANCE
    assert error(found.Gamma, by_index(Gamma_x, (joints, joints))) < TOLERANCE
    assert error(found.G, by_index(G_x, (len(case.rows), joints))) < TOLERANCE


@every_case
def test_costate_rate_is_minus_the_derivative_of_the_hamiltonian(build: Any, size: int) -> None:
    """(33), with the minimising rates substituted before differentiation, and by the envelope theorem at fixed u*."""
    case = build(size)
    u = optimal_control(case.chain, case.x, case.lam)
    total, envelope, by_costates = (numeric(part)[:, 0] for part in case.derivatives(case.x, case.lam, case.v, u)[:3])
    assert error(costate_rate(*case.task), total) < TOLERANCE
    assert error(costate_rate(*case.task), envelope) < TOLERANCE
    assert error(state_rate(*case.task), by_costates) < TOLERANCE


@settings(max_examples=40)
@given(seeds)
def test_costate_rate_is_right_wherever_the_papers_example_may_be(seed: int) -> None:
    case, rng = example(), np.random.default_rng(seed)
    x = rng.uniform(-3, 3, size=6)
    assume(np.linalg.cond(generalized_jacobian(case.chain, x)[case.rows]) < 20)
    lam, v = rng.normal(size=6), rng.normal(size=2)
    u = optimal_control(case.chain, x, lam)
    expected = numeric(case.derivatives(x, lam, v, u)[0])[:, 0]
    assert error(costate_rate(case.chain, x, lam, v, case.rows), expected) < TOLERANCE


@every_case
def test_costates_of_the_base_position_are_constant(build: Any, size: int) -> None:
    """Space is the same everywhere, so the Hamiltonian does not contain the base position."""
    case = build(size)
    position = range(case.chain.n // 2 + case.chain.n % 2)
    rate = costate_rate(*case.task)
    assert np.abs(rate[position]).max() < TOLERANCE * np.abs(rate).max()


def flow(case: Case, x: Array, lam: Array, times: tuple[float, float]) -> tuple[Array, Array]:
    """x and lam at the end of the extremal (34) from the first time to the second."""
    N = case.chain.N

    def rate(_: float, y: Array) -> Array:
        at = case.chain, y[:N], y[N:], case.v, case.rows
        return np.concatenate([state_rate(*at), costate_rate(*at)])

    end = solve_ivp(rate, times, np.concatenate([x, lam]), method="DOP853", rtol=1e-10, atol=1e-11).y[:, -1]
    return end[:N], end[N:]


def test_the_hamiltonian_is_constant_along_an_extremal() -> None:
    """Time does not enter it."""
    case = example()
    x, lam = flow(case, case.x, 0.3 * case.lam, (0.0, 0.8))
    assert np.abs(x - case.x).max() > 0.3
    start = hamiltonian(case.chain, case.x, 0.3 * case.lam, case.v, case.rows)
    assert hamiltonian(case.chain, x, lam, case.v, case.rows) == pytest.approx(start, rel=1e-9)


# The equations that do not hold as printed, each on the same data as the corrected one


@pytest.mark.parametrize("size", [3, 7])
def test_equation_21_as_printed_is_minus_the_velocity_in_end_effector_axes(size: int) -> None:
    case = spatial_case(size)
    truth = case.truth(case.x)
    omega, R = numeric(truth[1])[:3], numeric(truth[4])
    R_x = by_index(truth[6], (3, 3))
    corrected = np.column_stack([numeric(vee(-R.T @ partial)) for partial in R_x])
    printed = np.column_stack([numeric(vee(partial @ R.T)) for partial in R_x])
    assert error(corrected, omega) < TOLERANCE
    assert error(printed, -R @ omega) < TOLERANCE
    assert error(printed, omega) > 0.5
    # A planar turn looks the same from both axes: there the printed form has the wrong sign only.
    truth = example().truth(example().x)
    R, R_x = numeric(truth[4]), by_index(truth[6], (3, 3))
    printed = np.column_stack([numeric(vee(partial @ R.T)) for partial in R_x])
    assert error(printed, -numeric(truth[1])[:3]) < TOLERANCE


@pytest.mark.parametrize("build", [lambda: spatial_case(7), example], ids=["6+7", "example"])
def test_equations_20_to_22_hold_for_the_inertial_velocity_only(build: Any) -> None:
    """Extracted in the axes of (21) as printed, those of the end effector, or about another point, v_E is no column."""
    case = build()
    truth = case.truth(case.x)
    linear, R, r = numeric(truth[1])[3:], numeric(truth[4]), numeric(ca.skew(truth[5]))
    R_x, lower_x = by_index(truth[6], (3, 3)), by_index(truth[8], (3, 3))
    inertial, end_effector, other_point = (np.zeros((3, case.chain.N)) for _ in range(3))
    for i in range(case.chain.N):
        Y = np.block([[R_x[i], np.zeros((3, 3))], [lower_x[i], R_x[i]]])  # (20), by automatic differentiation
        extracted = -R.T @ (Y[3:, :3] + Y[:3, :3] @ r)
        assert np.abs(extracted + extracted.T).max() < TOLERANCE * np.abs(Y).max()  # it is a [v x]
        inertial[:, i] = numeric(vee(extracted)).ravel()
        end_effector[:, i] = numeric(vee(-(Y[3:, :3] + Y[:3, :3] @ r) @ R.T)).ravel()
        other_point[:, i] = numeric(vee(-R.T @ Y[3:, :3])).ravel()
    assert error(inertial, linear) < TOLERANCE
    assert error(end_effector, R @ linear) < TOLERANCE
    assert error(end_effector, linear) > 0.5
    assert error(other_point, linear) > CLEARLY


@pytest.mark.parametrize("size", [3, 7])
def test_equation_51_as_printed_differentiates_equation_21_as_printed(size: int) -> None:
    case = spatial_case(size)
    N, truth = case.chain.N, case.truth(case.x)
    omega, omega_x = numeric(truth[1])[:3], by_index(truth[3], (6, N))[:, :3]
    R, R_x = numeric(truth[4]), by_index(truth[6], (3, 3))
    R_xx = numeric(truth[7]).T.reshape(N, N, 3, 3).transpose(0, 1, 3, 2)  # [k, i]
    corrected, printed, of_printed = (np.zeros((N, 3, N)) for _ in range(3))
    for k in range(N):
        for i in range(N):
            corrected[k, :, i] = numeric(vee(-(R_x[k].T @ R_x[i] + R.T @ R_xx[k, i]))).ravel()
            printed[k, :, i] = numeric(vee(R_xx[k, i] @ R.T + R_x[i] @ R_x[k].T)).ravel()
        of_printed[k] = -(R_x[k] @ omega + R @ omega_x[k])
    assert error(corrected, omega_x) < TOLERANCE
    assert error(printed, of_printed) < TOLERANCE
    assert error(printed, omega_x) > 0.5


def momentum_partials(case: Case, printed: bool) -> Array:
    """Algorithm 3 with (43) as printed, third term X~^T B X~, or corrected. Shape (N, 6, N)."""
    chain, N = case.chain, case.chain.N
    X = transforms(chain, case.x)
    result = np.zeros((N, 6, N))
    for k in range(N):
        X_ = [-motion_cross(chain.S[i]) @ X[i] if i == k else np.zeros((6, 6)) for i in range(N)]
        A, A_ = [X[0].T], [X_[0].T]
        for i in range(1, N):
            A_.append(A_[-1] @ X[i].T + A[-1] @ X_[i].T)
            A.append(A[-1] @ X[i].T)
        B, B_ = chain.H[-1], np.zeros((6, 6))
        for i in reversed(range(N)):
            if i < N - 1:
                left = X_[i + 1].T if printed else X[i + 1].T
                B_ = X_[i + 1].T @ B @ X[i + 1] + X[i + 1].T @ B_ @ X[i + 1] + left @ B @ X_[i + 1]
                B = chain.H[i] + X[i + 1].T @ B @ X[i + 1]
            result[k, :, i] = (A_[i] @ B + A[i] @ B_) @ chain.S[i]
    return result


@pytest.mark.parametrize("build", [lambda: spatial_case(7), example], ids=["6+7", "example"])
def test_equation_43_as_printed_misses_a_term(build: Any) -> None:
    case = build()
    expected = by_index(case.truth(case.x)[2], (6, case.chain.N))
    assert error(momentum_partials(case, printed=False), expected) < TOLERANCE
    assert error(momentum_partials(case, printed=True), expected) > CLEARLY


def basic_partials(case: Case) -> tuple[Array, Array, Array, Array]:
    """E1, E2, F1, F2 by each coordinate, by automatic differentiation."""
    N, n = case.chain.N, case.chain.n
    truth = case.truth(case.x)
    E_x = by_index(truth[2], (6, N))[:, case.chain.momentum_rows]
    F_x = by_index(truth[3], (6, N))[:, case.rows]
    return E_x[..., :n], E_x[..., n:], F_x[..., :n], F_x[..., n:]


@pytest.mark.parametrize("build", [lambda: spatial_case(6), lambda: planar_case(3), example])
def test_equation_39_holds_with_F1_not_the_printed_F2(build: Any) -> None:
    """With as many joints as base coordinates, so that the printed product exists."""
    case = build()
    at = resolution(case.chain, case.x, case.v, case.rows)
    u = optimal_control(case.chain, case.x, case.lam)
    expected = by_index(case.derivatives(case.x, case.lam, case.v, u)[6], at.G.shape)
    E1_inverse = np.linalg.inv(at.E1)

    def equation_39(F: Array) -> Array:
        return np.array(
            [
                F2_x - F1_x @ at.reaction + F @ E1_inverse @ (E1_x @ at.reaction - E2_x)
                for E1_x, E2_x, F1_x, F2_x in zip(*basic_partials(case), strict=True)
            ]
        )

    assert error(equation_39(at.F1), expected) < TOLERANCE
    assert error(equation_39(at.F2), expected) > CLEARLY


def test_equation_39_as_printed_has_no_meaning_when_joints_and_base_coordinates_differ_in_number() -> None:
    at = resolution(spatial_case(7).chain, spatial_case(7).x, spatial_case(7).v, spatial_case(7).rows)
    assert at.F1.shape[1] == len(at.E1)
    assert at.F2.shape[1] != len(at.E1)


@pytest.mark.parametrize("speed", [0.4, -2.0])
def test_equation_37_needs_the_velocity_behind_the_whole_bracket(speed: float) -> None:
    """A task of one row, where the printed difference of a matrix and a vector exists."""
    case = spatial_case(5)
    chain, x, lam, rows = case.chain, case.x, case.lam, [4]
    at = resolution(chain, x, [speed], rows)
    by = partials(chain, x, lam, [speed], rows)
    inverse = np.linalg.inv(at.G @ at.G.T)
    corrected, printed = [], []
    for G_x in by.G:
        first = G_x.T @ inverse
        second = at.G_pinv @ (G_x @ at.G.T + at.G @ G_x.T) @ inverse
        corrected.append((first - second) @ [speed])
        printed.append(first[:, 0] - second @ [speed])
        assert first.shape == (5, 1)  # (n2, m): no vector when the task has more rows
    step = 1e-5
    offsets = step * np.eye(chain.N)
    differences = [
        (resolution(chain, x + dx, [speed], rows).Phi - resolution(chain, x - dx, [speed], rows).Phi) / (2 * step)
        for dx in offsets
    ]
    assert error(corrected, by.Phi) < TOLERANCE
    assert error(corrected, differences) < 1e-7
    assert error(printed, by.Phi) > CLEARLY


def test_equation_38_as_printed_repeats_terms_outside_its_braces() -> None:
    """A task that leaves no freedom, where the printed sum exists: Gamma is zero everywhere, its partials too."""
    case = example()
    rows = [2, 3, 4]
    v = np.array([0.3, -1.0, -1.0])
    at = resolution(case.chain, case.x, v, rows)
    by = partials(case.chain, case.x, case.lam, v, rows)
    scale = np.abs(by.G).max() * np.abs(at.G_pinv).max()
    assert np.abs(at.Gamma).max() < 1e-14 * scale
    assert np.abs(by.Gamma).max() < 1e-13 * scale
    printed = []
    for G_x in by.G:
        braces = (G_x @ at.G.T + at.G @ G_x.T) @ at.G_pinv.T - G_x
        printed.append(
            -G_x.T @ at.G_pinv.T + at.G @ G_x.T @ at.G_pinv.T - G_x + at.G_pinv @ braces  # as printed
        )
    assert np.abs(printed).max() > CLEARLY * scale
    # With freedom left the printed sum adds (m, n2) to (n2, n2).
    free = resolution(case.chain, case.x, case.v, case.rows)
    assert free.G.shape != free.Gamma.shape


# The boundary value (35)


@pytest.mark.parametrize("size", [4, 7, 10])
def test_costates_in_the_range_of_the_constraint_jacobian_are_pure_gauge(size: int) -> None:
    """lam + J^T mu satisfies (35) if lam does, moves nothing, and stays of this form with the same mu.

    The tip's velocity is a gradient for its linear rows, whatever the base and the joints do.
    """
    case, rows = spatial_case(size), LINEAR
    chain, x, lam = case.chain, case.x, case.lam
    v, mu = np.array([0.7, -1.1, 0.4]), np.array([0.5, -0.8, 1.3])
    F = J(chain, x)[rows]
    shifted = lam + F.T @ mu
    projector = np.eye(chain.N) - np.linalg.pinv(F) @ F
    assert np.abs(projector @ (F.T @ mu)).max() < TOLERANCE * np.abs(F.T @ mu).max()
    assert np.linalg.matrix_rank(projector) == chain.N - len(rows)

    rate = state_rate(chain, x, lam, v, rows)
    assert error(state_rate(chain, x, shifted, v, rows), rate) < TOLERANCE
    along = np.einsum("k,kri,r->i", rate, dJ(chain, x)[:, rows], mu)  # d/dt (J^T mu)
    change = costate_rate(chain, x, shifted, v, rows) - costate_rate(chain, x, lam, v, rows)
    assert error(change, along) < 10 * TOLERANCE
    gain = hamiltonian(chain, x, shifted, v, rows) - hamiltonian(chain, x, lam, v, rows)
    assert gain == pytest.approx(mu @ v, rel=1e-11)


def test_the_printed_boundary_value_is_degenerate_and_zero_costates_are_not() -> None:
    """Along extremals of the paper's example: 2 of the 6 costates at the start are undetermined by (35)."""
    case = example()
    times, lam = (0.0, 0.5), 0.2 * case.lam

    def condition_35(x: Array, lam: Array) -> Array:
        F = J(case.chain, x)[case.rows]
        residual: Array = lam - np.linalg.pinv(F) @ F @ lam
        return residual

    F = J(case.chain, case.x)[case.rows]
    x_end, lam_end = flow(case, case.x, lam, times)
    residual = condition_35(x_end, lam_end)
    for mu in 0.5 * np.eye(2):
        x_same, lam_other = flow(case, case.x, lam + F.T @ mu, times)
        assert error(x_same, x_end) < 1e-8
        assert error(lam_other - lam_end, J(case.chain, x_end)[case.rows].T @ mu) < 1e-7
        assert error(condition_35(x_same, lam_other), residual) < 1e-7
    step = 1e-4
    columns = [
        np.subtract(flow(case, case.x, lam + dlam, times), flow(case, case.x, lam - dlam, times)) / (2 * step)
        for dlam in step * np.eye(6)
    ]
    sensitivity = np.array([column[1] for column in columns]).T
    values = np.linalg.svd(sensitivity, compute_uv=False)
    assert values[-1] > 0.01 * values[0]  # lam(t_f) = 0 determines all six


def test_any_end_allowed_by_the_constraint_jacobian_gives_the_motion_of_zero_costates() -> None:
    """(35) and lam(t_f) = 0 are equivalent: backward from the same end, the same motion."""
    case = example()
    end = case.x
    x_zero, lam_zero = flow(case, end, np.zeros(6), (0.5, 0.0))
    mu = np.array([0.6, -0.4])
    x_gauge, lam_gauge = flow(case, end, J(case.chain, end)[case.rows].T @ mu, (0.5, 0.0))
    assert error(x_gauge, x_zero) < 1e-8
    assert error(lam_gauge - lam_zero, J(case.chain, x_zero)[case.rows].T @ mu) < 1e-7
    assert np.abs(lam_gauge - lam_zero).max() > 0.1


def test_the_whole_end_effector_jacobian_in_equation_35_admits_ends_that_are_not_optimal() -> None:
    """J of Algorithm 2 has rows that the task leaves free; costates in their range do change the motion."""
    case = example()
    free = J(case.chain, case.x)[[2]]
    whole = J(case.chain, case.x)[[2, 3, 4]]
    lam = free[0]
    assert np.abs(lam - np.linalg.pinv(whole) @ whole @ lam).max() < TOLERANCE  # the printed condition holds
    rest = state_rate(case.chain, case.x, np.zeros(6), case.v, case.rows)
    moved = state_rate(case.chain, case.x, lam, case.v, case.rows)
    assert error(moved, rest) > CLEARLY


# What is refused


def test_arms_that_are_not_serial_are_refused() -> None:
    links = tuple(Link(name, 1.0, (0.2, 0, 0), np.eye(3)) for name in "abc")
    fork = Robot(links, (Joint("j", "revolute", "a", "b"), Joint("k", "revolute", "a", "c")), tip="c")
    with pytest.raises(ModelError, match="joint 'k' starts a branch at link 'a'"):
        VirtualChain.from_machine(FreeFloating(fork))
    early = Robot(links, (Joint("j", "revolute", "a", "b"), Joint("k", "revolute", "b", "c")), tip="b")
    with pytest.raises(ModelError, match="tip is on link 'b', before the joint 'k'"):
        VirtualChain.from_machine(FreeFloating(early))


def test_wrong_sizes_and_rows_are_named() -> None:
    chain, x, lam, v, rows = example().task
    for function in (D, J, dD, dJ, generalized_jacobian):
        with pytest.raises(ModelError, match=r"q has shape \(5,\), expected \(6,\)"):
            function(chain, x[:5])
    with pytest.raises(ModelError, match=r"lam has shape \(3,\)"):
        costate_rate(chain, x, lam[:3], v, rows)
    with pytest.raises(ModelError, match=r"tip_velocity has shape \(2,\), expected \(1,\)"):
        costate_rate(chain, x, lam, v, [3])
    with pytest.raises(ModelError, match="rows .* not all among"):
        costate_rate(chain, x, lam, v, [3, 6])
    with pytest.raises(ModelError, match="not finite"):
        costate_rate(chain, x * np.nan, lam, v, rows)


def test_singular_places_are_named() -> None:
    chain, x, lam, v, rows = example().task
    with pytest.raises(ModelError, match="task of rows .* is singular"):
        resolution(chain, np.array([0, 0, 0, 0.3, 0, 0]), v, rows)  # stretched, but the base reacts
