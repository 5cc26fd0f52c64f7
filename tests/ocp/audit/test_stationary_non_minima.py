"""Plans that meet every first-order condition and are no minimum: none passes, by whatever method it was made."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, Joint, Link, Robot
from ocp import Collocation, Indirect, MultipleShooting, Problem, certificate, solve
from tests.ocp.audit.drawn import holds, is_no_minimum, is_no_proven_minimum, random_program

pytestmark = pytest.mark.filterwarnings("ignore::models.errors.ModelWarning")  # arms of a kilometre are meant

METHODS: dict[str, Any] = {
    "radau": Collocation(20),
    "radau-held": Collocation(40, control="held"),
    "legendre": Collocation(20, scheme="legendre"),
    "held": MultipleShooting(40),
    "linear": MultipleShooting(40, control="linear"),
    "indirect": Indirect(),
}
every_method = pytest.mark.parametrize("method", METHODS)


def to_rest(horizon: float, stiffness: float = 1.0, unit: float = 1.0, price: float = 1.0, order: int = 1) -> Problem:
    """min int u^2 - k x^2 between zeros: a minimum until the conjugate point, unbounded below after it.

    For x' = u it comes at sqrt(k) T = pi; for x'' = u at k^(1/4) T = 4.7300, the first root of cos cosh = 1 (the beam
    clamped at both ends).
    """
    problem = Problem("between zeros")
    states = [problem.state(name, initial=0.0, terminal=0.0) for name in ("x", "v")[:order]]
    u = problem.control("u")
    for state, rate in zip(states, [*states[1:], u], strict=True):
        problem.dynamics(state, rate)
    problem.horizon(horizon)
    problem.minimize(price * (u**2 - stiffness * states[0] ** 2) / unit**2)
    return problem


@every_method
@pytest.mark.parametrize(
    ("order", "share", "stiffness", "unit", "price"),
    [(1, 1.02, 1.0, 1.0, 1.0), (1, 1.6, 30.0, 1e-3, 1e3), (1, 2.4, 0.1, 1e3, 1e-6), (2, 1.05, 1.0, 1.0, 1.0)],
)
def test_a_plan_past_its_conjugate_point_does_not_pass(
    method: str, order: int, share: float, stiffness: float, unit: float, price: float
) -> None:
    first = np.pi if order == 1 else 4.730040744862704
    for factor, verdict in ((share, is_no_minimum), (0.97, holds)):
        problem = to_rest(factor * first / stiffness ** (1 / (2 * order)), stiffness, unit, price, order)
        plan = solve(problem, METHODS[method], check=False)
        if plan.success or factor < 1:  # a method may see for itself that there is no minimum
            verdict(plan.audit())


def test_no_agreement_of_methods_certifies_a_plan_past_its_conjugate_point() -> None:
    problem = to_rest(3.4)
    plans = [solve(problem, METHODS[name], check=False) for name in ("radau", "legendre", "linear")]
    assert not certificate(problem, plans).passed


@pytest.mark.parametrize("bounds", [{}, {"lower": -1.0, "upper": 1.0}], ids=["free", "bounded"])
@pytest.mark.parametrize("end", [0.0, None], ids=["to zero", "free end"])
@pytest.mark.parametrize("size", [1, 3])
def test_the_greatest_cost_is_not_the_least(bounds: dict[str, Any], end: float | None, size: int) -> None:
    """min int -u^2 standing still: every other motion is cheaper."""
    problem = Problem("greatest effort")
    x = problem.state("x", size, initial=0.0, terminal=end)
    u = problem.control("u", size, **bounds)
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize(-ca.sumsqr(u))
    still = np.zeros(size).tolist()
    is_no_minimum(random_program(problem, {"x": still}, {"u": still}, {"x": still}, 1.0).audit())


def test_one_control_that_curves_downwards_is_found_among_others_that_curve_upwards() -> None:
    problem = Problem("one of three")
    x = problem.state("x", 3, initial=0.0, terminal=0.0)
    u = problem.control("u", 3)
    problem.dynamics(x, u)
    problem.horizon(1.0)
    for sign, verdict in ((1.0, holds), (-1.0, is_no_minimum)):
        problem.declared.running = None
        problem.minimize(u[0] ** 2 + 1e3 * u[1] ** 2 + sign * 1e-2 * u[2] ** 2)
        still = [0.0, 0.0, 0.0]
        verdict(random_program(problem, {"x": still}, {"u": still}, {"x": still}, 1.0).audit())


def test_a_hamiltonian_that_is_a_saddle_in_two_controls_is_no_minimum() -> None:
    """H_uu = [[1, 2], [2, 1]] has a negative eigenvalue, though its diagonal is positive."""
    problem = Problem("coupled")
    x = problem.state("x", 2, initial=0.0, terminal=0.0)
    u = problem.control("u", 2)
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize(ca.bilin(ca.DM([[1.0, 2.0], [2.0, 1.0]]), u, u) / 2)
    still = [0.0, 0.0]
    is_no_minimum(random_program(problem, {"x": still}, {"u": still}, {"x": still}, 1.0).audit())


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("bounds", [{}, {"lower": -1.0, "upper": 1.0}], ids=["free", "bounded"])
def test_standing_on_a_hilltop_is_no_minimum(unit: float, bounds: dict[str, Any]) -> None:
    """v' = u from rest, cost -x(T)^2 and a price of u that is worth it, or none at all."""
    for price in (0.1, 0.0):
        problem = Problem("hilltop")
        x, v = problem.state("x", initial=0.0), problem.state("v", initial=0.0)
        scaled: dict[str, Any] = {side: value * unit for side, value in bounds.items()}
        u = problem.control("u", **scaled)
        problem.dynamics(x, v)
        problem.dynamics(v, u)
        problem.horizon(1.0)
        problem.minimize(price * (u / unit) ** 2, -((x / unit) ** 2))
        still = {"x": 0.0, "v": 0.0}
        is_no_proven_minimum(random_program(problem, still, {"u": 0.0}, still, 1.0).audit())


def test_an_end_cost_of_small_negative_curvature_is_a_minimum() -> None:
    """min int u^2 - c x(T)^2 from 0: x(T)^2 (1 / T - c)."""
    for bend, verdict in ((0.9, holds), (1.1, is_no_minimum), (50.0, is_no_minimum)):
        problem = Problem("bent end")
        x, u = problem.state("x", initial=0.0), problem.control("u")
        problem.dynamics(x, u)
        problem.horizon(1.0)
        problem.minimize(u**2, -bend * x**2)
        verdict(random_program(problem, {"x": 0.0}, {"u": 0.0}, {"x": 0.0}, 1.0).audit())


# ---- geodesics and films ---------------------------------------------------------------------------------------------


def surface(turn: float, axis: float, order: str) -> Problem:
    """From one point of the equator of an ellipsoid of revolution (radius 1, half its height ``axis``) to another."""
    problem = Problem("ellipsoid")
    ends = {"pan": (0.3, 0.3 + turn), "tilt": (0.0, 0.0)}
    states = {name: problem.state(name, initial=ends[name][0], terminal=ends[name][1]) for name in order.split()}
    rates = {name: problem.control(f"rate of {name}") for name in reversed(order.split())}
    for name, state in states.items():
        problem.dynamics(state, rates[name])
    tilt = states["tilt"]
    stretch = ca.sin(tilt) ** 2 + (axis * ca.cos(tilt)) ** 2
    problem.horizon(1.0)
    problem.minimize((ca.cos(tilt) * rates["pan"]) ** 2 + stretch * rates["tilt"] ** 2)
    return problem


@pytest.mark.parametrize("axis", [0.6, 1.0, 1.5])
@pytest.mark.parametrize("order", ["pan tilt", "tilt pan"])
def test_the_equator_is_the_shortest_path_up_to_the_conjugate_point(axis: float, order: str) -> None:
    """Jacobi: with the Gauss curvature 1 / axis^2 of the equator, the conjugate point comes after pi axis."""
    for share, verdict in ((0.95, holds), (1.05, is_no_minimum), (1.7, is_no_minimum), (-1.3, is_no_minimum)):
        turn = share * np.pi * axis
        problem = surface(turn, axis, order)
        plan = random_program(
            problem,
            {"pan": lambda t, turn=turn: 0.3 + turn * t, "tilt": 0.0},
            {"rate of pan": turn, "rate of tilt": 0.0},
            {"pan": -2 * turn, "tilt": 0.0},
            1.0,
        )
        verdict(plan.audit())


def test_of_two_soap_films_between_rings_the_deep_one_is_no_minimum() -> None:
    """r = c cosh(t / c) between rings of radius 1 at -1/2 and 1/2: int r sqrt(1 + r'^2), two c, one of them a film."""
    roots = []
    for low, high in ((0.5 / 5, 0.5 / 1.19968), (0.5 / 1.19968, 5.0)):
        for _ in range(200):
            middle = (low + high) / 2
            left, right = (c * np.cosh(0.5 / c) - 1 for c in (low, middle))
            low, high = (low, middle) if left * right <= 0 else (middle, high)
        roots.append(low)
    deep, shallow = roots
    assert deep < shallow
    problem = Problem("soap film")
    r, slope = problem.state("r", initial=1.0, terminal=1.0), problem.control("slope")
    problem.dynamics(r, slope)
    problem.horizon(1.0)
    problem.minimize(r * ca.sqrt(1 + slope**2))
    for c, verdict in ((shallow, holds), (deep, is_no_minimum)):
        plan = random_program(
            problem,
            {"r": lambda t, c=c: c * np.cosh((t - 0.5) / c)},
            {"slope": lambda t, c=c: np.sinh((t - 0.5) / c)},
            {"r": lambda t, c=c: -c * np.sinh((t - 0.5) / c)},
            1.0,
            60,
        )
        verdict(plan.audit())


def test_the_farthest_point_of_a_circle_is_no_nearest() -> None:
    """To the circle of radius 1 from (c, 0) inside it: (1, 0) is the nearest point, (-1, 0) the farthest."""
    for radius in (1e-3, 1.0, 1e3):
        for side, verdict in ((1.0, holds), (-1.0, is_no_minimum)):
            problem = Problem("to a circle")
            place = problem.state("place", 2, initial=[0.3 * radius, 0.0])
            rate = problem.control("rate", 2)
            problem.dynamics(place, rate)
            problem.horizon(1.0)
            problem.end("circle", ca.sumsqr(place), radius**2, radius**2)
            problem.minimize(ca.sumsqr(rate) / 2)
            path = (side - 0.3) * radius
            plan = random_program(
                problem,
                {"place": lambda t, w=path, r=radius: np.column_stack([0.3 * r + w * t, 0 * t])},
                {"rate": [path, 0.0]},
                {"place": [-path, 0.0]},
                1.0,
            )
            verdict(plan.audit())


def test_the_longest_horizon_has_not_the_lowest_cost() -> None:
    """x from 0 to 1 at int u^2 / 2 + (T - 1) / 2 - b (T - 1)^2 / 2: stationary at T = 1, a minimum for b < 1."""
    for bend, verdict in ((0.5, holds), (1.5, is_no_minimum)):
        problem = Problem("horizon")
        x, u = problem.state("x", initial=0.0, terminal=1.0), problem.control("u")
        problem.dynamics(x, u)
        horizon = problem.horizon(lower=0.1, upper=10.0, guess=1.0)
        problem.minimize(u**2 / 2, (horizon - 1) / 2 - bend * (horizon - 1) ** 2 / 2)
        verdict(random_program(problem, {"x": lambda t: t}, {"u": 1.0}, {"x": -1.0}, 1.0).audit())


# ---- robots ----------------------------------------------------------------------------------------------------------


def head(length: float) -> FixedBase:
    """A pan-tilt head: its camera on the horizon at zero, a lens of some length along x."""
    links = [Link("stand", 1.0), Link("yoke", 1.0), Link("camera", 1.0)]
    joints = [
        Joint("pan", "continuous", "stand", "yoke", axis=(0, 0, 1)),
        Joint("tilt", "continuous", "yoke", "camera", axis=(0, 1, 0)),
    ]
    return FixedBase(Robot(tuple(links), tuple(joints), tip_translation=(length, 0, 0)))


@pytest.mark.parametrize("length", [0.01, 1.0, 1e3])
@pytest.mark.parametrize("turn", [2.9, 3.4, 5.0, -4.0])
def test_a_longer_homotopy_class_is_no_minimum(length: float, turn: float) -> None:
    """The least square of the lens's speed: great circles are shortest up to half a turn."""
    machine = head(length)
    problem = Problem("head")
    joints = problem.state("joints", 2, initial=[0.0, 0.0], terminal=[turn, 0.0])
    rates = problem.control("rates", 2)
    problem.dynamics(joints, rates)
    problem.horizon(1.0)
    tip = ca.vertcat(machine.tip_pose((), joints).position)
    speed = ca.mtimes(ca.jacobian(tip, joints), rates)
    problem.minimize(ca.sumsqr(speed) / length**2)
    plan = random_program(
        problem,
        {"joints": lambda t: np.column_stack([turn * t, 0 * t])},
        {"rates": [turn, 0.0]},
        {"joints": [-2 * turn, 0.0]},
        1.0,
    )
    (holds if abs(turn) < np.pi else is_no_minimum)(plan.audit())


# ---- random ----------------------------------------------------------------------------------------------------------


def indefinite(rng: np.random.Generator) -> tuple[Problem, float]:
    """A random indefinite linear-quadratic problem between zeros, and the least curvature of standing still.

    Decided by the dense matrix of the cost on piecewise constant controls, integrated exactly and reduced to those that
    end at zero: with them, past a conjugate point, the cost is unbounded below.
    """
    n = int(rng.integers(1, 4))
    a, b, q = rng.normal(size=(n, n)), rng.normal(size=(n, 1)), rng.normal(size=(n, n))
    q = 4.0 * (q + q.T) / 2
    horizon, segments = float(rng.uniform(0.5, 3.0)), 160
    step = horizon / segments
    # exact step of (x, u held): exponentials by squaring of the augmented matrix, and the cost by Simpson's rule
    from scipy.linalg import expm

    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[:n, n:] = a, b
    half, full = expm(whole * step / 2), expm(whole * step)
    reach = np.zeros((segments + 1, n, segments))
    hessian = np.eye(segments) * step
    for k in range(segments):
        own = np.zeros((1, segments))
        own[0, k] = 1.0
        reach[k + 1] = full[:n, :n] @ reach[k] + full[:n, n:] @ own
        middle = half[:n, :n] @ reach[k] + half[:n, n:] @ own
        for share, part in ((1, reach[k]), (4, middle), (1, reach[k + 1])):
            hessian += step * share / 6 * part.T @ q @ part
    _, sizes, right = np.linalg.svd(reach[-1])
    basis = right[int((sizes > 1e-9 * sizes[0]).sum()) :].T
    least = float(np.linalg.eigvalsh(basis.T @ hessian @ basis)[0]) / step
    problem = Problem("indefinite")
    x = problem.state("x", n, initial=np.zeros(n), terminal=np.zeros(n))
    u = problem.control("u")
    problem.dynamics(x, ca.mtimes(a, x) + ca.mtimes(b, u))
    problem.horizon(horizon)
    problem.minimize(u**2 / 2 + ca.bilin(ca.DM(q), x, x) / 2)
    return problem, least


@pytest.mark.long
def test_of_random_indefinite_problems_no_non_minimum_passes_and_the_minima_do() -> None:
    rng = np.random.default_rng(20)
    counts = {True: 0, False: 0}
    for k in range(24):
        problem, least = indefinite(rng)
        if abs(least) < 0.02:
            continue  # too near to the conjugate point to be told by held controls
        counts[least > 0] += 1
        name = ("radau", "legendre", "linear")[k % 3]
        plan = solve(problem, METHODS[name], check=False)
        if least > 0:
            holds(plan.audit())
        else:  # the solver may see for itself that it is none
            assert not plan.audit().passed
    assert min(counts.values()) >= 4
