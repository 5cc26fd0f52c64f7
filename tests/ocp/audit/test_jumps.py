from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ocp import Collocation, MultipleShooting, Problem, Solution, solve
from tests.ocp.problems import Array

METHODS = [
    Collocation(40),
    Collocation(30, scheme="legendre"),
    Collocation(40, control="held"),
    MultipleShooting(60, control="linear"),
    MultipleShooting(60),
    MultipleShooting(40, steps=2),
]


def chase(
    sign: float = 1.0, rate: float = 2.0, effort: float = 0.01, gain: float = 0.0, terminal: Any = None
) -> Problem:
    """Follow a ramp that runs beyond a bound of 0.6; a free end at the bound. Mirrored for sign -1."""
    problem = Problem("chase")
    lower, upper = (-np.inf, 0.6) if sign > 0 else (-0.6, np.inf)
    q = problem.state("q", initial=0.0, terminal=terminal, lower=lower, upper=upper)
    u = problem.control("u")
    problem.dynamics(q, u)
    problem.horizon(1.0)
    problem.minimize(running=(q - sign * rate * problem.time) ** 2 + effort * u**2, terminal=-gain * sign * q)
    return problem


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_a_bound_that_is_active_at_a_free_end_is_no_fault(method: Any, sign: float) -> None:
    if method.control == "linear":  # their costates go to and fro along a bound: told 1.3e-4 on 60, a quarter on 120
        method = replace(method, intervals=120)
    audit = solve(chase(sign), method).audit()
    assert audit.passed, str(audit)
    assert audit["cost lost, relative"].value < 1e-4


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_a_final_cost_that_presses_on_the_bound_is_no_fault(method: Any) -> None:
    """The costate before the end is that of the bound's own force, far from the gradient of the final cost."""
    audit = solve(chase(gain=1.0), method).audit()
    assert audit.passed, str(audit)


@pytest.mark.parametrize("other", [{"rate": 1.6}, {"effort": 0.02}, {"rate": 2.2, "effort": 0.012}], ids=str)
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_the_plan_of_another_problem_does_not_pass(method: Any, other: dict[str, float]) -> None:
    """It ends at the same bound."""
    plan = solve(chase(**other), method)
    assert plan["q"][-1] == pytest.approx(0.6, abs=1e-6)
    assert not plan.audit(chase()).passed


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_a_plan_forced_to_the_bound_does_not_pass_where_the_end_is_free(method: Any) -> None:
    """The ramp is left behind on the way to 0.6: the bound would have to pull."""
    if method.control == "held":  # 40 held controls cost 2.3e-3 more than the optimum, 120 cost 2.6e-4
        method = replace(method, intervals=120)
    plan = solve(chase(rate=0.2, terminal=0.6), method)
    assert plan.audit().passed
    audit = plan.audit(chase(rate=0.2))
    assert {finding.name for finding in audit.failures} == {"transversality, relative"}


def shifted(plan: Solution, amount: float) -> Solution:
    """The same plan with costates that are off by a constant while it is at the bound."""
    costates = plan.costates["q"] + amount * (plan["q"] > 0.6 - 1e-6)
    interpolant = plan.costate_interpolant
    at = interpolant.breaks[:-1, None] + np.diff(interpolant.breaks)[:, None] * interpolant.nodes
    on_bound = plan.at_fraction(at.ravel())["q"].reshape(interpolant.values.shape) > 0.6 - 1e-6
    values = interpolant.values + amount * on_bound
    return replace(plan, costates={"q": costates}, costate_interpolant=replace(interpolant, values=values))


@pytest.mark.parametrize("amount", [0.02, -0.02])
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_costates_that_are_wrong_along_the_bound_do_not_pass(method: Any, amount: float) -> None:
    if method.control == "held":  # 0.02 is what the atom of one of 40 nodes makes
        method = replace(method, intervals=2 * method.intervals)
    plan = shifted(solve(chase(), method), amount)
    assert not plan.audit(chase()).passed


HORIZON, CONTACT, EFFORT = 1.5, 0.375, 0.01
LARGEST = 2 * (2 * HORIZON - 0.5) * HORIZON / 60  # atom of the bound, at the last of 60 nodes


def pushed(sign: float, gain: float) -> tuple[Problem, Any]:
    """Follow 2 t, at nearly the speed w, below a bound that is met at CONTACT: the problem, and the costate over time.

    Before it q'' = (q - 2 t) / EFFORT + w', on it q' = 0, and the costate is 2 EFFORT (w - q') all along: its force
    keeps it so whatever the final cost -gain q is.
    """
    rate, wish = 2.0, (0.5, 3.0)
    k, b = EFFORT**-0.5, EFFORT * wish[1]
    a = -(rate + b * k * np.sinh(k * CONTACT)) / (k * np.cosh(k * CONTACT))
    bound = rate * CONTACT - b + a * np.sinh(k * CONTACT) + b * np.cosh(k * CONTACT)

    def costate(t: Array) -> Array:
        free = np.minimum(t, CONTACT)
        speed = np.where(t < CONTACT, rate + k * (a * np.cosh(k * free) + b * np.sinh(k * free)), 0.0)
        return np.asarray(sign * 2 * EFFORT * (wish[0] + wish[1] * t - speed))

    problem = Problem("pushed")
    lower, upper = (-np.inf, bound) if sign > 0 else (-bound, np.inf)
    q = problem.state("q", initial=0.0, lower=lower, upper=upper)
    u = problem.control("u")
    problem.dynamics(q, u)
    problem.horizon(HORIZON)
    time = problem.time
    running = (q - sign * rate * time) ** 2 + EFFORT * (u - sign * (wish[0] + wish[1] * time)) ** 2
    problem.minimize(running=running, terminal=-gain * sign * q)
    return problem, costate


def means(plan: Solution) -> tuple[Array, Array, Array]:
    """Starts of the intervals, s (N,); the audit's costates of q against falling and rising hats there. Both (N,)."""
    optimality = plan.audit().optimality
    n = len(plan.control_interpolant.breaks) - 1
    costate = optimality.adjoint.costate.reshape(n, -1)
    nodes, weights = np.polynomial.legendre.leggauss(costate.shape[1])
    places, weights = (nodes + 1) / 2, weights / 2
    return optimality.adjoint.t[:-1], costate @ (weights * (1 - places)), costate @ (weights * places)


@pytest.mark.parametrize("gain", [0.0, 0.3])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("scheme", ["radau", "legendre"])
def test_costates_up_to_a_free_end_at_a_bound_are_those_of_the_closed_form(
    scheme: Any, sign: float, gain: float
) -> None:
    problem, costate = pushed(sign, gain)
    plan = solve(problem, Collocation(40, scheme=scheme))
    audit = plan.audit()
    assert audit.passed, str(audit)
    off = (audit.optimality.adjoint.costate[:, 0] - costate(audit.optimality.t)).reshape(40, -1)
    contact = round(40 * CONTACT / HORIZON)  # the solver knows the multiplier of its first point to its tolerance only
    assert off[np.arange(40) != contact] == pytest.approx(0, abs=2e-6)
    assert off[contact] == pytest.approx(0, abs=3e-4)
    assert abs(plan.costates["q"][-1, 0] - costate(np.array(HORIZON))) > 1e-3  # as reported it has the atom of the end


@pytest.mark.parametrize("gain", [0.0, 0.3])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_costates_between_nodes_at_a_bound_are_those_of_the_closed_form(sign: float, gain: float) -> None:
    """In the mean over the interval that a held control has a say in."""
    problem, costate = pushed(sign, gain)
    plan = solve(problem, MultipleShooting(60, control="held"))
    times, falling, rising = means(plan)
    times, result = times + HORIZON / 120, falling + rising
    assert result == pytest.approx(costate(times), abs=LARGEST / 50)
    on_bound = plan.t[:-1] > CONTACT + HORIZON / 60
    assert np.abs(plan.costates["q"][:-1, 0] - costate(plan.t[:-1]))[on_bound].max() > LARGEST / 5  # as reported


@pytest.mark.parametrize("gain", [0.0, 0.3])
@pytest.mark.parametrize("control", ["held", "linear"])
def test_the_loss_of_a_shooting_plan_along_a_bound_is_its_excess(control: Any, gain: float) -> None:
    """Atoms at the nodes belong to the transcription and lose no cost.

    Those between linear controls go to and fro, and their spread is told too high by the square of the width.
    """
    problem, _ = pushed(1.0, gain)
    best = solve(problem, Collocation(120, scheme="legendre")).cost
    plan = solve(problem, MultipleShooting({"held": 60, "linear": 300}[control], control=control))
    audit = plan.audit()
    assert audit.passed, str(audit)
    assert audit.lost.sum() == pytest.approx(plan.cost - best, abs=1e-4 * abs(best))
