"""Boundary value problem of the minimum principle for shooting methods, and Newton's method for its equations.

Its equations are the canonical equations, the end conditions, and the transversality conditions on the costates.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.console import casadi_silenced, reason_to_stop, stop_requests_polled
from ocp.curves import integrator
from ocp.errors import ProblemError, SolverStatus
from ocp.indirect.hamiltonian import Hamiltonian, numeric_bounds
from ocp.indirect.seed import ControlArcs
from ocp.problem.formulation import Formulation
from ocp.problem.values import symbols_of

LOBATTO = 0.5 - 0.5 * np.cos(np.pi * np.arange(10) / 9)  # Chebyshev-Lobatto nodes of a reported segment, 0..1


class BoundaryProblem:
    """Boundary value problem of the states x and costates lambda, y = [x; lambda], in consecutive shooting segments.

    Each segment is integrated from its own y with data q = [start time, duration, horizon, p, bang values, guess].

    Attributes:
        form, ham: The problem and its Hamiltonian system. backward: Whether to shoot backwards from the end state.
        outputs: Function of the Hamiltonian system -> (u, mu, H, dH/du of the linear controls).
        step, dense: Functions (y, q) -> (y at the end, or at LOBATTO behind the first; integrals of L and dH/dT).
    """

    def __init__(self, ham: Hamiltonian, *, backward: bool, tolerance: float) -> None:
        self.ham, self.form, self.backward, self.tolerance = ham, ham.form, backward, tolerance
        if backward:
            check_backward(ham)
        self.outputs = ham.outputs()
        self.step = self._integrator(np.array([1.0]))
        self.dense = self._integrator(LOBATTO[1:])
        self._ends = end_conditions(ham.form)
        self._systems: dict[tuple[int, ...], tuple[Any, ...]] = {}

    def system(self, arcs: ControlArcs) -> tuple[Any, ...]:
        """Return the CasADi Functions of the residual of the boundary value problem and of the residual's Jacobian.

        They depend on the numbers of segments of the arcs, by which they are cached.
        """
        key = tuple(arcs.segments)
        if key not in self._systems:
            build = self._backward_shooting if self.backward else self._multiple_shooting
            z, data, residual = build(arcs)
            jacobian = ca.jacobian(residual, z)
            named = (("residual", residual), ("jacobian", jacobian))
            self._systems[key] = tuple(ca.Function(name, [z, data], [value]) for name, value in named)
        return self._systems[key]

    def _multiple_shooting(self, arcs: ControlArcs) -> tuple[Any, Any, Any]:
        """Return unknowns, data and residuals of multiple shooting: continuity, switching and end conditions."""
        form = self.form
        at, of = self.layout(arcs), self._data_layout(arcs)
        z, data = ca.MX.sym("z", at["end"].stop), ca.MX.sym("data", of["guess"].stop)
        total = sum(arcs.segments)
        y = ca.reshape(z[at["y"]], 2 * form.nx, total + 1)
        horizon = z[at["horizon"]] if form.horizon_is_free else data[of["horizon"]]
        inputs = self._segment_data(z[at["switches"]], horizon, data, arcs)
        ends, quads = self.step.map(total)(y[:, :-1], inputs)
        residuals = [ca.vec(y[:, 1:] - ends)]
        last = inputs[:, -1]
        for i, (component, node) in enumerate(zip(arcs.components, arcs.nodes, strict=True)):
            y_switch = y[:, int(node)]
            values = self.outputs(*self.arguments(y_switch, z[at["switches"]][i], horizon, inputs[:, int(node) - 1]))
            residuals.append(values[3][component])
        values = self.outputs(*self.arguments(y[:, -1], horizon, horizon, last))
        multipliers = z[at["start"]], z[at["end"]]
        conditions, by_horizon = self._ends(y[:, 0], y[:, -1], horizon, data[of["p"]], *multipliers, data[of["ends"]])
        residuals.append(conditions)
        if form.horizon_is_free:
            residuals.append(values[2] + by_horizon + ca.sum2(quads[1, :]))
        return z, data, ca.vertcat(*residuals)

    def _backward_shooting(self, arcs: ControlArcs) -> tuple[Any, Any, Any]:
        """Return unknowns, data and residuals of backward shooting from an unknown end state to the given start."""
        nx, of = self.form.nx, self._data_layout(arcs)
        z, data = ca.MX.sym("z", nx), ca.MX.sym("data", of["guess"].stop)
        return z, data, self._integrate_backwards(z, data, arcs)[-1][:nx, :] - data[of["ends"]][nx : 2 * nx]

    def _integrate_backwards(self, state: Any, data: Any, arcs: ControlArcs) -> list[Any]:
        """Integrate states and costates backwards from an end state; return them at all nodes, last node first."""
        form, of = self.form, self._data_layout(arcs)
        horizon = data[of["horizon"]]
        gradient = ca.gradient(form.terminal, form.x)
        terminal = ca.Function("terminal", [form.x, form.t, form.T, form.p], [gradient])
        y = ca.vertcat(state, terminal(state, horizon, horizon, data[of["p"]]))
        inputs = self._segment_data(ca.MX(0, 1), horizon, data, arcs)
        nodes = [y]
        for k in reversed(range(sum(arcs.segments))):
            q = ca.vertcat(inputs[0, k] + inputs[1, k], -inputs[1, k], inputs[2:, k])
            nodes.append(self.step(nodes[-1], q)[0])
        return nodes

    def _segment_data(self, switches: Any, horizon: Any, data: Any, arcs: ControlArcs) -> Any:
        """Return the data that the integrator takes for all shooting segments, as the columns of a matrix."""
        of, total = self._data_layout(arcs), sum(arcs.segments)
        knots = ca.vertcat(0, switches, horizon)
        begins, lengths = [], []
        for a, count in enumerate(arcs.segments):
            length = (knots[a + 1] - knots[a]) / count
            begins += [knots[a] + j * length for j in range(count)]
            lengths += [length] * count
        sizes = self.ham.sizes
        return ca.vertcat(
            ca.horzcat(*begins),
            ca.horzcat(*lengths),
            ca.repmat(ca.vertcat(horizon, data[of["p"]]), 1, total),
            ca.reshape(data[of["bang"]], sizes[5], total),
            ca.reshape(data[of["guess"]], sizes[6], total),
        )

    def arguments(self, y: Any, at: Any, horizon: Any, q: Any) -> list[Any]:
        """Split the states and costates ``y`` and data ``q`` of segments into arguments of the Hamiltonian system.

        ``at`` are the times, s.
        """
        sizes = self.ham.sizes
        cuts = np.cumsum([3, *sizes[4:]])
        tail = [q[int(a) : int(b)] for a, b in itertools.pairwise(cuts)]
        return [y[: sizes[0]], y[sizes[0] :], at, horizon, *tail]

    def layout(self, arcs: ControlArcs) -> dict[str, slice]:
        """Return, by name, the slice of every part of the vector of unknowns, such as the switch times."""
        form = self.form
        sizes = {"y": 2 * form.nx * (sum(arcs.segments) + 1), "switches": len(arcs.switches)}
        ends = {"start": len(form.start), "end": len(form.end)}
        return side_by_side({**sizes, "horizon": int(form.horizon_is_free), **ends})

    def _data_layout(self, arcs: ControlArcs) -> dict[str, slice]:
        """Return, by name, the slice of every part of the data vector, such as parameters, fixed values and guesses."""
        sizes = self.ham.sizes
        total = sum(arcs.segments)
        parts = {"horizon": 1, "p": sizes[4], "ends": 4 * sizes[0], "bang": sizes[5] * total, "guess": sizes[6] * total}
        return side_by_side(parts)

    def _integrator(self, places: np.ndarray) -> Any:
        """Return the CasADi Function that integrates states, costates and running cost over a shooting segment.

        (y, q) -> (y at ``places``, integrals of L and dH/dT).
        """
        ham = self.ham
        sizes = ham.sizes
        flow = ham.flow()
        sym = symbols_of(flow).sym
        y, position = sym("y", 2 * sizes[0]), sym("place")
        q = sym("q", 3 + sum(sizes[4:]))
        x_rate, lam_rate, cost, by_horizon = flow(*self.arguments(y, q[0] + position * q[1], q[2], q))
        ode, quad = q[1] * ca.vertcat(x_rate, lam_rate), q[1] * ca.vertcat(cost, by_horizon)
        dae = {"x": y, "t": position, "p": q, "ode": ode, "quad": quad}
        flow_integrator = integrator("flow", dae, places.tolist(), tolerance=self.tolerance)
        y, q = ca.MX.sym("y", 2 * sizes[0]), ca.MX.sym("q", q.numel())
        result = flow_integrator(x0=y, p=q)
        return ca.Function("segment", [y, q], [result["xf"], result["qf"][:, -1]])

    def advance(self, y: np.ndarray, q: np.ndarray, place: float) -> np.ndarray:
        """Return states and costates at a position 0..1 of a segment that has the start values ``y``. Shape (2 nx,)."""
        if place == 0.0:
            return y
        return evaluate(self.step, y, np.concatenate([[q[0], place * q[1]], q[2:]]))[0][:, -1]

    def unpack(
        self, z: np.ndarray, arcs: ControlArcs, data: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Convert the unknowns to states and costates at the S + 1 nodes, segment data, switch times and horizon."""
        form, total = self.form, sum(arcs.segments)
        horizon, switches = float(data[0]), np.zeros(0)
        if self.backward:
            symbols = ca.MX.sym("z", form.nx), ca.MX.sym("data", data.size)
            chain = ca.Function("chain", symbols, [ca.horzcat(*reversed(self._integrate_backwards(*symbols, arcs)))])
            (y,) = evaluate(chain, z, data)
        else:
            at = self.layout(arcs)
            y = z[at["y"]].reshape(total + 1, 2 * form.nx).T
            switches = z[at["switches"]]
            horizon = float(z[at["horizon"]][0]) if form.horizon_is_free else horizon
        w, at_end, numbers = ca.MX.sym("w", switches.size), ca.MX.sym("T"), ca.MX.sym("data", data.size)
        inputs = ca.Function("q", [w, at_end, numbers], [self._segment_data(w, at_end, numbers, arcs)])
        return y, np.asarray(inputs(switches, horizon, data).full()), switches, horizon


def evaluate(function: Any, *arguments: np.ndarray, failed: float = np.nan) -> list[np.ndarray]:
    """Return the outputs of a CasADi function as arrays, filled with ``failed`` if an integrator in it fails."""
    try:
        with casadi_silenced():
            return [np.asarray(output.full()) for output in function.call(arguments)]
    except RuntimeError:
        return [np.full(function.size_out(i), failed) for i in range(function.n_out())]


def side_by_side(sizes: dict[str, int]) -> dict[str, slice]:
    """Return, by name, the slices of a stacked vector that consecutive parts of given sizes occupy."""
    cuts = np.cumsum([0, *sizes.values()]).tolist()
    return {name: slice(a, b) for name, (a, b) in zip(sizes, itertools.pairwise(cuts), strict=True)}


def check_backward(ham: Hamiltonian) -> None:
    """Raise ProblemError, with the reasons, if backward shooting does not support the problem."""
    form = ham.form
    low, high = numeric_bounds(form)
    fixed = {end: low[form.bounds.places[end]] == high[form.bounds.places[end]] for end in ("initial", "terminal")}
    reasons = {
        "start constraints": len(form.start) > 0,
        "end constraints": len(form.end) > 0,
        "a free horizon": form.horizon_is_free,
        "a cost that ties both ends": form.ties_ends,
        "controls that switch": len(ham.linear) > 0,
        "a state that is free at the start": not np.all(fixed["initial"]),
        "a state that is given at the end": bool(np.any(fixed["terminal"])),
    }
    unsupported = [reason for reason, holds in reasons.items() if holds]
    if unsupported:
        raise ProblemError(
            f"backward shooting does not support {', '.join(unsupported)}: it needs a given start, a free end state "
            "and a fixed horizon; use Indirect(shooting='multiple')",
            name="shooting",
            value="backward",
        )


def end_conditions(form: Formulation) -> Any:
    """Return the CasADi Function of the residuals of the start, end and transversality conditions.

    (y0, yN, T, p, nu0, nu1, ends) -> (residuals, dPhi/dT). ``ends`` contains, for initial and then for terminal states,
    flags of the fixed entries and their values. For free entries the costate is the gradient of
    Phi = terminal cost + nu . constraints (with a minus sign at the start).
    """
    sym = form.sym
    nx = form.nx
    y0, y1, ends = sym("y0", 2 * nx), sym("y1", 2 * nx), sym("ends", 4 * nx)
    nu0, nu1 = sym("nu0", len(form.start)), sym("nu1", len(form.end))
    low = form.bounds.function(form.p)[0]
    level0 = ca.vertcat(form.problem.symbols(0, 1), *[low[int(i)] for i in form.start.bounds])
    level1 = ca.vertcat(form.problem.symbols(0, 1), *[low[int(i)] for i in form.end.bounds])
    begin = ca.substitute([form.start.expression - level0], [form.x, form.t], [form.x0, 0])[0]
    end, terminal = ca.substitute([form.end.expression - level1, form.terminal], [form.t], [form.T])
    phi = terminal + ca.dot(nu0, begin) + ca.dot(nu1, end)
    parts = [ca.gradient(phi, form.x0), ca.gradient(phi, form.x), ca.gradient(phi, form.T), begin, end]
    parts = ca.substitute([ca.densify(part) for part in parts], [form.x0, form.x], [y0[:nx], y1[:nx]])
    fixed0, value0, fixed1, value1 = (ends[i * nx : (i + 1) * nx] for i in range(4))
    first = ca.if_else(fixed0, y0[:nx] - value0, y0[nx:] + parts[0])
    last = ca.if_else(fixed1, y1[:nx] - value1, y1[nx:] - parts[1])
    conditions = ca.vertcat(first, last, parts[3], parts[4])
    return ca.Function("ends", [y0, y1, form.T, form.p, nu0, nu1, ends], [conditions, parts[2]])


@dataclass(frozen=True)
class NewtonSettings:
    """Criteria for the termination of Newton's method.

    Attributes:
        steps: Maximum number of steps. halvings: Maximum number of halvings of a step.
        descent: Required reduction, as a share of the one predicted for the step length (Armijo's rule).
    """

    steps: int = 40
    halvings: int = 12
    descent: float = 1e-4


SETTINGS = NewtonSettings()


@dataclass(frozen=True)
class NewtonResult:
    """Last iterate of Newton's method, its residual, the number of steps, and the status with a message."""

    unknowns: np.ndarray
    residual: float
    steps: int
    status: SolverStatus
    message: str

    @property
    def success(self) -> bool:
        """Whether Newton's method converged, and no later check rejected the result."""
        return self.status.is_success


def newton(
    system: tuple[Any, ...], start: np.ndarray, data: np.ndarray, *, scale: float, tolerance: float
) -> NewtonResult:
    """Solve a sparse nonlinear system of equations by damped Newton steps, each halved until the residual decreases."""
    residual, jacobian = system

    def residual_at(z: np.ndarray) -> np.ndarray:
        return evaluate(residual, z, data, failed=np.inf)[0].ravel()

    z, value, polished, stopped = start, residual_at(start), False, None
    with stop_requests_polled():
        for steps in range(SETTINGS.steps + 1):
            size = float(np.max(np.abs(value), initial=0.0))
            if not np.isfinite(size):
                return NewtonResult(z, size, steps, SolverStatus.NOT_FINITE, "the integration fails at the seed")
            if size <= tolerance * scale and polished:
                return NewtonResult(z, size, steps, SolverStatus.SOLVED, f"Converged in {steps} Newton steps")
            polished = size <= tolerance * scale  # one more step costs little and gains digits
            stopped = reason_to_stop()
            if stopped or steps == SETTINGS.steps:
                break
            try:
                with casadi_silenced():
                    step = np.asarray(ca.solve(jacobian(z, data), ca.DM(-value), "qr").full()).reshape(-1)
            except RuntimeError:
                step = np.full(z.size, np.nan)
            if not np.all(np.isfinite(step)):
                word = "Newton's matrix is singular, so that the plan is not unique, or its integration fails"
                if polished:
                    word = f"Converged in {steps} Newton steps; {word}"
                status = SolverStatus.SOLVED if polished else SolverStatus.STEP_FAILED
                return NewtonResult(z, size, steps, status, word)
            length = 1.0
            for _ in range(SETTINGS.halvings):
                trial = z + length * step
                trial_value = residual_at(trial)
                if np.linalg.norm(trial_value) < (1.0 - SETTINGS.descent * length) * np.linalg.norm(value) or polished:
                    break
                length *= 0.5
            else:
                words = "no step along Newton's direction reduces the residual"
                return NewtonResult(z, size, steps, SolverStatus.STEP_FAILED, words)
            if polished and np.max(np.abs(trial_value)) > size:
                return NewtonResult(z, size, steps, SolverStatus.SOLVED, f"Converged in {steps} Newton steps")
            z, value = trial, trial_value
    if stopped is not None:
        return NewtonResult(z, size, steps, stopped, str(stopped))
    return NewtonResult(z, size, steps, SolverStatus.ITERATION_LIMIT, f"not converged in {SETTINGS.steps} Newton steps")
