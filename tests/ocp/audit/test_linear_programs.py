"""Linear programs in time: the loss of the best multipliers is exactly the excess cost of a plan.

Strong duality: of a plan that keeps its limits the least loss over all multipliers is its excess, no more, no less.
The truth is a linear program of another make: controls held over many short intervals, their effects by the exponential
of a matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

from ocp import MultipleShooting, Problem, Solution, solve
from ocp.curves import PiecewisePolynomial
from tests.families import some
from tests.ocp.audit.test_duality import fitted, lost, without_costates
from tests.ocp.problems import Array

pytestmark = pytest.mark.xdist_group("linear programs")

SECONDS, MOST = 1.5, 1.0
METHOD = MultipleShooting(40, steps=2)
STEPS = 600
"""Of the truth."""


@dataclass(frozen=True)
class Linear:
    """x' = A x + B u, |u| <= MOST, from zero, at the least integral of c x + d u, plus e x at the end."""

    A: Array
    B: Array
    c: Array
    d: Array
    e: Array
    end: Array | None

    @classmethod
    def random(cls, seed: int, ends: str) -> Linear:
        rng = np.random.default_rng(seed)
        sizes = ((2, 2), (2, 2), 2, 2, 2, 2)
        A, B, c, d, e, goal = (rng.normal(size=size) for size in sizes)
        return cls(A, B, c, d, e, 0.06 * goal if ends == "fixed" else None)

    def least(self) -> float:
        """The least cost: by the effect of each control in each short interval on the cost and on the end."""
        h = SECONDS / STEPS
        whole = np.zeros((5, 5))  # states, their cost, controls
        whole[:2, :2], whole[:2, 3:], whole[2, :2], whole[2, 3:] = self.A, self.B, self.c, self.d
        step = expm(h * whole)
        onward, price = np.eye(3), np.append(self.e, 1.0)
        effects = []
        for _ in range(STEPS):  # from the last interval to the first
            effects.append(onward @ step[:3, 3:])
            onward = onward @ step[:3, :3]
        rows = np.hstack(effects)
        fixed = {} if self.end is None else {"A_eq": rows[:2], "b_eq": self.end}
        result = linprog(price @ rows, bounds=(-MOST, MOST), **fixed)
        assert result.success
        return float(result.fun)

    def problem(self, soft: bool = False, unit: float = 1.0, second: float = 1.0, turned: bool = False) -> Problem:
        """It, or with a `soft` cost beside it; in other units; or `turned`, its states and controls the other way."""
        order = [1, 0] if turned else [0, 1]
        problem = Problem("linear in time")
        states: list[Any] = [None, None]
        controls: list[Any] = [None, None]
        for i in order:
            ends = {} if self.end is None else {"terminal": unit * self.end[i]}
            states[i] = problem.state(f"x{i}", initial=0.0, **ends)
        for i in order:
            controls[i] = problem.control(f"u{i}", lower=-MOST * unit / second, upper=MOST * unit / second)
        x, u = ca.vertcat(*states) / unit, ca.vertcat(*controls) * second / unit
        problem.horizon(SECONDS * second)
        rate = (ca.mtimes(ca.DM(self.A), x) + ca.mtimes(ca.DM(self.B), u)) * unit / second
        for i in order:
            problem.dynamics(states[i], rate[i])
        running = ca.dot(ca.DM(self.c), x) + ca.dot(ca.DM(self.d), u)
        if soft:
            running = running + 5 * ca.sumsqr(u) + ca.sumsqr(x)
        problem.minimize(running=running / second, terminal=ca.dot(ca.DM(self.e), x))
        return problem

    def cost(self, plan: Solution) -> float:
        """Of a plan in these units."""
        at = plan.at_fraction(np.linspace(0.0, 1.0, 20001))
        x, u = (np.column_stack([at[f"{name}{i}"] for i in range(2)]) for name in "xu")
        t = np.linspace(0.0, SECONDS, 20001)
        return float(np.trapezoid(x @ self.c + u @ self.d, t) + x[-1] @ self.e)

    def judged(self, kind: str, **report: Any) -> Solution:
        """Return a feasible plan of this program: its optimum, or the optimum of another cost."""
        if kind == "another":
            rng = np.random.default_rng(99)
            c, d, e = (rng.normal(size=2) for _ in range(3))
            plan = solve(replace(self, c=c, d=d, e=e).problem(**report), METHOD)
        else:
            plan = solve(self.problem(kind == "soft", **report), METHOD)
        cost = self.cost(solve(self.problem(kind == "soft"), METHOD) if report else plan)
        return replace(plan, problem=self.problem(**report), cost=cost)


KINDS = ("own", "soft", "another")
every_program = pytest.mark.parametrize(
    ("seed", "ends"),
    [pytest.param(s, ends, marks=pytest.mark.long if s else ()) for s in range(3) for ends in ("free", "fixed")],
)


@every_program
@pytest.mark.parametrize("kind", KINDS)
def test_the_loss_is_the_excess(seed: int, ends: str, kind: str) -> None:
    program = Linear.random(seed, ends)
    plan = program.judged(kind)
    result, excess = lost(fitted(plan)), plan.cost - program.least()
    # where a control switches within one of 40 intervals its points see more of the gaps, or less
    assert result == pytest.approx(excess, rel=1e-2, abs=2e-3 * (abs(plan.cost) + 0.1))
    assert result > 0.05 or kind != "soft"


@every_program
def test_the_loss_does_not_depend_on_the_reported_costates(seed: int, ends: str) -> None:
    plan = Linear.random(seed, ends).judged("soft")
    curve = plan.costate_interpolant
    wild = replace(plan, costate_interpolant=replace(curve, values=1e4 * (curve.values + 1)))
    for report in (without_costates(plan), wild):
        assert lost(fitted(report)) == pytest.approx(lost(fitted(plan)), rel=1e-3)


@every_program
@pytest.mark.parametrize("report", [{"unit": 1e3}, {"unit": 1e-3, "second": 60.0}, {"turned": True}], ids=str)
def test_units_and_the_order_of_declaration_change_nothing(seed: int, ends: str, report: dict[str, Any]) -> None:
    program = Linear.random(seed, ends)
    one, other = (lost(fitted(program.judged("soft", **options))) for options in ({}, report))
    assert other == pytest.approx(one, rel=1e-3)


@pytest.mark.parametrize("seed", some(range(3), 1))
def test_a_film_played_backwards_loses_as_much(seed: int) -> None:
    """From the end to the start: x' = -(A x + B u), the same controls at the time that is left."""
    there = Linear.random(seed, "fixed")
    assert there.end is not None
    # its own start is zero: the way back begins at the end, which is moved to zero: x = end + y
    plan = there.judged("soft")
    back = Problem("linear in time, backwards")
    x = [back.state(f"x{i}", initial=there.end[i], terminal=0.0) for i in range(2)]
    u = [back.control(f"u{i}", lower=-MOST, upper=MOST) for i in range(2)]
    back.horizon(SECONDS)
    rate = -(ca.mtimes(ca.DM(there.A), ca.vertcat(*x)) + ca.mtimes(ca.DM(there.B), ca.vertcat(*u)))
    for i in range(2):
        back.dynamics(x[i], rate[i])
    back.minimize(running=ca.dot(ca.DM(there.c), ca.vertcat(*x)) + ca.dot(ca.DM(there.d), ca.vertcat(*u)))

    def turned(curve: PiecewisePolynomial) -> PiecewisePolynomial:
        return PiecewisePolynomial(1 - curve.breaks[::-1], 1 - curve.nodes[::-1], curve.values[::-1, ::-1])

    backwards = replace(
        plan,
        problem=back,
        state_interpolant=turned(plan.state_interpolant),
        control_interpolant=turned(plan.control_interpolant),
        costate_interpolant=turned(plan.costate_interpolant),
        states={name: values[::-1] for name, values in plan.states.items()},
        controls={name: values[::-1] for name, values in plan.controls.items()},
        t=plan.horizon - plan.t[::-1],
        cost=plan.cost - float(there.e @ there.end),
    )
    assert lost(fitted(backwards)) == pytest.approx(lost(fitted(plan)), rel=2e-2)


def test_of_multipliers_that_lose_as_much_the_nearest_to_those_reported_are_taken() -> None:
    """A metre in a second at a metre a second at most: every costate from the cost's slope down fits."""
    problem = Problem("no choice")
    x = problem.state("x", initial=0.0, terminal=1.0)
    u = problem.control("u", lower=-1.0, upper=1.0)
    problem.horizon(1.0)
    problem.dynamics(x, u)
    problem.minimize(running=0.2 * u + x)
    plan = solve(problem, METHOD)
    curve = plan.costate_interpolant
    for least in (-0.5, -1.5, -4.5):
        values = curve.values - curve.values.max() + least
        result = fitted(replace(plan, costate_interpolant=replace(curve, values=values)))
        assert result.distance < 0.05
        assert lost(result) < 1e-4 * plan.cost
