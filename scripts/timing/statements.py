"""Six optimal control problems whose optimum is known, each with a parameter, as formulas that any tool takes.

Brachistochrone, van der Pol and Goddard stand in `tests/conformance` with their closed forms or shooting; cart-pole is
Kelly's (2017, section 6, with the masses and the length printed there); the paper's arm and a Panda's lap are those of
`scripts/papers/free_floating` and `scripts/robots/panda`, with a weight on the first joint's rate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase
from models.checks import Array
from ocp import Collocation, Problem, inverse_kinematics, prepare
from ocp.motion.builders.joint_motion import minimum_velocity_problem
from ocp.problem.formulation import Formulation
from scripts.papers.free_floating.formulations import problem as free_floating
from scripts.robots.panda import HOME, LAP, circling
from scripts.robots.robots import PANDA
from tests.conformance import brachistochrone, goddard, van_der_pol

STATEMENTS: dict[str, Callable[[], Statement]] = {}
GUESSED = 20  # intervals of the mesh on which every tool's first guess is told


@dataclass(frozen=True)
class Statement:
    """What every tool is asked.

    Attributes:
        problem: With one parameter, "p". p, then: Its value in the cold solve, and in the solve after it.
        optimum: Least cost at ``p``; None where only the finest mesh tells.
        held: Controls constant over each interval, where free ones ring.
    """

    problem: Problem
    p: float
    then: float
    optimum: float | None = None
    held: bool = False

    @cached_property
    def form(self) -> Formulation:
        """The problem flattened."""
        return Formulation.of(self.problem)

    @cached_property
    def formulas(self) -> dict[str, Any]:
        """casadi Functions of (x, u, t, T, p): "rates", "running", "equal" (zero all along), "below" (not above zero
        all along), "start" (zero at time 0); and "terminal", of (x, T)."""
        form, symbolic = self.form, self.form.bounds.function(self.form.p)
        rows, upper = form.path, symbolic[1]
        gap = ca.vertcat(form.sym("none", 0), *[rows.expression[i] - upper[int(k)] for i, k in enumerate(rows.bounds)])
        equal, below = (np.flatnonzero(which).tolist() for which in (rows.equality, ~rows.equality))
        outputs = {
            "rates": form.f,
            "running": form.running,
            "equal": gap[equal],
            "below": gap[below],
            "start": form.start.expression,
        }
        by_name = {name: form.function(name, [ca.densify(of)], [name]) for name, of in outputs.items()}
        return by_name | {"terminal": ca.Function("terminal", [form.x, form.T], [form.terminal])}

    @property
    def is_cyclic(self) -> bool:
        """Whether what "end" asks is that the joints, the first states, return."""
        return bool(self.form.end.expression.numel())

    def bounds(self, kind: str) -> tuple[Array, Array]:
        """Lower and upper bounds: kind "state", "control", "initial", "terminal" or "horizon"."""
        lower, upper = self.form.bound_values(np.array([self.p]))
        place = self.form.bounds.places[kind]
        return lower[place], upper[place]

    @cached_property
    def guess(self) -> tuple[float, Callable[[Array], Array], Callable[[Array], Array]]:
        """Horizon, states and controls at fractions 0..1, that the package begins with."""
        start = prepare(self.problem, Collocation(GUESSED), options={"max_iter": 0}, compiled=False, scaling=False)
        plan = start.solve({"p": self.p}, check=False)
        return plan.horizon, plan.state_interpolant, plan.control_interpolant


def named(name: str) -> Callable[[Callable[[], Statement]], Callable[[], Statement]]:
    """Put a statement into the list."""

    def put(make: Callable[[], Statement]) -> Callable[[], Statement]:
        STATEMENTS[name] = make
        return make

    return put


@named("brachistochrone")
def _brachistochrone() -> Statement:
    """Its parameter is the gravity, m/s^2."""
    problem = Problem("brachistochrone")
    x = problem.state("x", initial=0.0, terminal=brachistochrone.ACROSS, guess=lambda t: 5.0 * t)
    y = problem.state("y", initial=0.0, terminal=brachistochrone.DOWN, guess=lambda t: 2.5 * t)
    v = problem.state("v", initial=0.0, guess=lambda t: 5.0 * t)
    a = problem.control("a", lower=0.0, upper=np.pi, guess=lambda t: 0.1 + 0.7 * t)
    g = problem.parameter("p")
    horizon = problem.horizon(lower=0.5, upper=10.0, guess=2.0)
    problem.dynamics(x, v * ca.sin(a))
    problem.dynamics(y, v * ca.cos(a))
    problem.dynamics(v, g * ca.cos(a))
    problem.minimize(terminal=horizon)
    return Statement(problem, brachistochrone.G, 9.6, brachistochrone.HORIZON)


@named("van der Pol")
def _van_der_pol() -> Statement:
    """Its parameter is the damping."""
    problem = Problem("van der Pol")
    x, u = problem.state("x", initial=[1.0, 0.0]), problem.control("u")
    damping = problem.parameter("p")
    problem.horizon(van_der_pol.HORIZON)
    problem.dynamics(x, ca.vertcat(x[1], damping * (1 - x[0] ** 2) * x[1] - x[0] + u))
    problem.minimize(running=(ca.sumsqr(x) + u**2) / 2)
    return Statement(problem, 1.0, 1.1, van_der_pol.CASE.cost)


@named("Goddard")
def _goddard() -> Statement:
    """Its parameter is the drag."""
    problem = Problem("Goddard")
    h = problem.state("h", initial=1.0, guess=1.0)
    v = problem.state("v", initial=0.0, guess=lambda t: 2.5 * t * (0.2 - t) * 4)
    m = problem.state("m", initial=1.0, terminal=0.6, guess=lambda t: 1 - 2 * t)
    thrust = problem.control("F", lower=0.0, upper=goddard.THRUST, guess=1.0)
    density = problem.parameter("p")
    problem.horizon(lower=0.05, upper=1.0, guess=0.2)
    problem.dynamics(h, v)
    problem.dynamics(v, (thrust - density * v**2 * ca.exp(-500 * (h - 1))) / m - 1 / h**2)
    problem.dynamics(m, -2 * thrust)
    problem.minimize(terminal=-h)
    return Statement(problem, 310.0, 320.0, goddard.CASE.cost, held=True)


@named("cart-pole")
def _cart_pole() -> Statement:
    """A pole swung up in 2 s while its cart goes 1 m, least squared force. Its parameter is the pole's mass, kg."""
    cart, length, gravity = 1.0, 0.5, 9.81
    problem = Problem("cart-pole")
    x = problem.state(
        "x",
        initial=np.zeros(4),
        terminal=[1.0, np.pi, 0.0, 0.0],
        guess=lambda t: np.array([t / 2, np.pi * t / 2, 0.0, 0.0]),
    )
    u = problem.control("u", lower=-20.0, upper=20.0)
    pole = problem.parameter("p")
    problem.horizon(2.0)
    s, c, w = ca.sin(x[1]), ca.cos(x[1]), x[3]
    moved = cart + pole * s**2
    problem.dynamics(
        x,
        ca.vertcat(
            x[2],
            w,
            (length * pole * s * w**2 + u + pole * gravity * c * s) / moved,
            -(length * pole * c * s * w**2 + u * c + (cart + pole) * gravity * s) / (length * moved),
        ),
    )
    problem.minimize(running=u**2)
    return Statement(problem, 0.3, 0.31)


def _weighed(problem: Problem) -> Statement:
    """How much more the first joint's rate costs than the others', as the parameter."""
    rates = problem.declared.controls["rates"].symbol
    running, problem.declared.running = problem.declared.running, None
    problem.minimize(running=running + problem.parameter("p") * rates[0] ** 2 / 2)
    return Statement(problem, 0.5, 0.6)


@named("paper's arm")
def _arm() -> Statement:
    return _weighed(free_floating())


@named("Panda lap")
def _lap() -> Statement:
    machine = FixedBase(PANDA.read())
    start = inverse_kinematics(machine, circling(), near=HOME, starts=0)[0].joints
    return _weighed(minimum_velocity_problem(machine, circling(), horizon=LAP, near=start, cyclic=True))


def with_reference(statement: Statement, intervals: int = 80) -> Statement:
    """The statement with the optimum of a fine mesh where no other is known."""
    if statement.optimum is not None:
        return statement
    plan = prepare(statement.problem, Collocation(intervals, 5), options={"tol": 1e-11}).solve({"p": statement.p})
    return replace(statement, optimum=plan.cost)
