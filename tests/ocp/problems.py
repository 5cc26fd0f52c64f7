"""Problems and methods that several tests of ocp share, with what is known of their optima."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from ocp import Collocation, MultipleShooting, Problem

Array: TypeAlias = npt.NDArray[np.float64]
Method: TypeAlias = Collocation | MultipleShooting

SOLVERS = ("ipopt", "fatrop")

# one of every kind of transcription, on few intervals
COLLOCATIONS: dict[str, Method] = {
    "radau": Collocation(4),
    "radau-held": Collocation(4, control="held"),
    "legendre": Collocation(4, scheme="legendre"),
    "legendre-held": Collocation(4, scheme="legendre", control="held"),
}
SHOOTINGS: dict[str, Method] = {
    "rk4-held": MultipleShooting(6, steps=2),
    "rk4-linear": MultipleShooting(6, steps=2, control="linear"),
}
CVODES: dict[str, Method] = {
    "cvodes-held": MultipleShooting(3, integrator="cvodes"),
    "cvodes-linear": MultipleShooting(3, integrator="cvodes", steps=3, control="linear"),
}
METHODS = {**COLLOCATIONS, **SHOOTINGS}
EVERY_METHOD = {**METHODS, **CVODES}

# the same on more intervals
FINE: dict[str, Method] = {
    "radau": Collocation(10),
    "radau-held": Collocation(10, 2, control="held"),
    "legendre": Collocation(10, scheme="legendre"),
    "rk4-held": MultipleShooting(12, steps=2),
    "rk4-linear": MultipleShooting(12, steps=2, control="linear"),
}


def plant(
    name: str,
    *,
    state: str = "x",
    size: int | None = None,
    u: Mapping[str, Any] | None = None,
    horizon: Any = 1.0,
    symbols: Any = ca.SX,
    **declared: Any,
) -> tuple[Problem, Any, Any]:
    """A problem of one state and one control, and their symbols; dynamics and cost are left to declare.

    ``declared`` and ``u`` are what is declared of the state and of the control; a horizon of None is left to declare.
    """
    problem = Problem(name, symbols)
    x = problem.state(state, size, **declared)
    control = problem.control(**{"name": "u", **(u or {})})
    if horizon is not None:
        problem.horizon(horizon)
    return problem, x, control


def double_integrator(
    name: str,
    start: tuple[float, float] = (0.0, 0.0),
    end: tuple[float, float] = (1.0, 0.0),
    horizon: float | None = 1.0,
    limit: float = np.inf,
    ceiling: float | None = None,
    **control: Any,
) -> tuple[Problem, Any, Any, Any]:
    """q' = v, v' = u between two states (q, v), |u| <= limit, q <= ceiling; a horizon of None is left to declare."""
    problem = Problem(name)
    q = problem.state("q", initial=start[0], terminal=end[0], upper=ceiling)
    v = problem.state("v", initial=start[1], terminal=end[1])
    u = problem.control("u", **{"lower": -limit, "upper": limit, **control})
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    if horizon is not None:
        problem.horizon(horizon)
    return problem, q, v, u


def energy(**control: Any) -> Problem:
    """Double integrator from (0, 0) to (1, 0) in 1 s with least energy: cost 6, costates at the start -12 and -6."""
    problem, _, _, u = double_integrator("energy", **control)
    problem.minimize(running=u**2 / 2)
    return problem


def van_der_pol(
    initial: Any = (1.0, 0.0), terminal: Any = None, lower: Any = None, upper: Any = None, horizon: Any = 2.0
) -> Problem:
    """Least int (x'x + u^2)/2 of van der Pol's oscillator: smooth, nonlinear, autonomous."""
    problem = Problem("van der Pol")
    x = problem.state("x", 2, initial=None if initial is None else list(initial), terminal=terminal)
    u = problem.control("u", lower=lower, upper=upper)
    problem.dynamics(x, ca.vertcat(x[1], (1 - x[0] ** 2) * x[1] - x[0] + u))
    problem.horizon(horizon)
    problem.minimize(running=(ca.sumsqr(x) + u**2) / 2)
    return problem


def started_anywhere(horizon: float = 2.0, upper: float = np.inf) -> Problem:
    """Van der Pol's oscillator whose initial state is the parameter ``x0``."""
    problem = Problem("van der Pol from anywhere")
    x0 = problem.parameter("x0", 2)
    x = problem.state("x", 2, initial=x0)
    u = problem.control("u", lower=-upper, upper=upper)
    problem.dynamics(x, ca.vertcat(x[1], (1 - x[0] ** 2) * x[1] - x[0] + u))
    problem.horizon(horizon)
    problem.minimize(running=(ca.sumsqr(x) + u**2) / 2, terminal=2 * x[0] ** 2 + ca.sin(x[1]))
    return problem


class LogarithmicRegulator:
    """The regulator z' = a z + u, cost int (z^2 + u^2)/2, written in y = exp(z): nonlinear, with a known optimum.

    With r = sqrt(a^2 + 1) and Y(s) = r cosh(r s) - a sinh(r s) over the time s that is left, the Riccati solution is
    P = sinh(r s)/Y(s): cost P(T) z0^2/2, z(t) = z0 Y(T - t)/Y(T), u = -z0 sinh(r (T - t))/Y(T), costate of z: -u.
    """

    def __init__(self, horizon: float = 1.0, z0: float = 1.0, a: float = 0.5) -> None:
        self.horizon, self.z0, self.a, self.r = horizon, z0, a, float(np.hypot(a, 1.0))

    def _y(self, left: Array | float) -> Any:
        return self.r * np.cosh(self.r * left) - self.a * np.sinh(self.r * left)

    @property
    def cost(self) -> float:
        return float(np.sinh(self.r * self.horizon) / self._y(self.horizon) * self.z0**2 / 2)

    def state(self, t: Array | float) -> Any:
        """The optimal y at times t, s."""
        return np.exp(self.z0 * self._y(self.horizon - t) / self._y(self.horizon))

    def control(self, t: Array | float) -> Any:
        """The optimal control at times t, s."""
        return -self.z0 * np.sinh(self.r * (self.horizon - t)) / self._y(self.horizon)

    def costate(self, t: Array | float) -> Any:
        """d(optimal cost)/dy = (d cost/dz) / y at times t, s."""
        return -self.control(t) / self.state(t)

    def build(self) -> Problem:
        problem = Problem("logarithmic regulator")
        y = problem.state("y", initial=np.exp(self.z0), guess=2.0)
        u = problem.control("u")
        problem.dynamics(y, y * (self.a * ca.log(y) + u))
        problem.horizon(self.horizon)
        problem.minimize(running=(ca.log(y) ** 2 + u**2) / 2)
        return problem


def swing(symbols: Any = ca.SX, *, control_ties: bool = False) -> Problem:
    """A cyclic swing in a free time: ties of both ends, path, start and end constraints, bounds, parameters."""
    problem = Problem("swing", symbols)
    k = problem.parameter("k", 2)
    x = problem.state("x", 2, lower=[-3.0, -3.0], upper=3.0)
    w = problem.state("w", initial=0.1 * k[0], lower=-5.0)
    u = problem.control("u", lower=-1.0, upper=1.0)
    b = problem.control("b", 2, lower=-2.0, upper=2.0)
    horizon = problem.horizon(lower=1.0, upper=8.0, guess=5.0)
    problem.dynamics(x, ca.vertcat(x[1] + 0.1 * b[0], u - k[1] * ca.sin(x[0])))
    problem.dynamics(w, u * x[0] - 0.2 * w + b[1] * problem.time / horizon)
    problem.path("speed", x[1] + 0.3 * u, lower=-1.5, upper=1.5)
    problem.path("place", x[0] ** 2 + 0.1 * w, upper=1.2)
    problem.path("balance", b[0] + b[1] - 0.2 * ca.cos(x[0]), 0, 0)
    problem.start("push", x[0] - 0.1 * x[1], 0.8, 0.8)
    problem.end("cyclic", x - problem.at_start(x), 0, 0)
    if control_ties:
        problem.end("smooth", u - problem.at_start(u) + b[0], lower=-0.2, upper=0.2)
    problem.minimize(
        running=u**2 + ca.sumsqr(b) + x[1] ** 2 + 0.1 * w**2,
        terminal=0.1 * horizon + problem.at_start(x)[1] ** 2 + 0.1 * w * x[0],
    )
    return problem


SWING = {"k": [1.0, 1.1]}


def order(widths: Array, errors: Array) -> float:
    """Slope of log(error) over log(width) by least squares."""
    return float(np.polyfit(np.log(widths), np.log(errors), 1)[0])


def relative(value: Any, reference: Any) -> float:
    """Largest difference, relative to the largest entry of the reference (at least 1)."""
    reference = np.asarray(reference)
    return float(np.max(np.abs(np.asarray(value) - reference)) / max(1.0, float(np.max(np.abs(reference)))))


def moved() -> Problem:
    """Bounds, an end and a horizon that are parameters; a cost of the end."""
    problem = Problem("moved")
    x, v = problem.state("x", initial=0.0), problem.state("v", initial=0.0, upper=problem.parameter("fastest"))
    u = problem.control("u", lower=-problem.parameter("strength"), upper=2.0)
    problem.dynamics(x, v)
    problem.dynamics(v, u - 0.3 * v * ca.fabs(v) - ca.sin(x))
    problem.horizon(problem.parameter("duration"))
    path = problem.parameter("way")
    problem.end("there", x, path, path)
    problem.path("power", u * v, upper=0.8)
    problem.minimize(running=u**2, terminal=v**2)
    return problem


MOVED = {"fastest": 0.75, "strength": 1.0, "duration": 3.0, "way": 1.4}
