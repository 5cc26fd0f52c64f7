"""Pontryagin's minimum principle for an optimal control problem, derived by automatic differentiation.

H = L + lambda . f + mu . h with running cost L, dynamics f and path equalities h that contain the control. The costates
obey lambda' = -dH/dx, and the control minimises H. Bryson, Ho, Applied Optimal Control, 1975, chapters 2 and 3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ocp.curves import quadrature_weights
from ocp.errors import ProblemError, error_names
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.values import symbols_of
from ocp.tolerances import ROUNDING_SHARE


@dataclass(frozen=True)
class Hamiltonian:
    """Hamiltonian system of an optimal control problem: the Hamiltonian H and the controls that minimise H.

    Attributes:
        form: The problem.
        lam, mu: Symbols of the costates (nx, 1) and of the multipliers of the path equalities (m, 1).
        rows: Residuals of the path equalities. Shape (m, 1).
        value: H. Scalar expression of x, u, lam, mu, t, T, p.
        smooth, linear: Indices of the controls in which H is curved, and of those in which it is linear.
        unknowns: Function (x, lam, t, T, p, bang, guess) -> w = [smooth controls; mu] that minimises H. ``bang`` are
            the values of the linear controls, each at one of its bounds; ``guess`` starts an iteration for w.
        solved: ``quadratic`` (symbolically), ``projected`` (then projected on the bounds) or ``iterated`` (by Newton).
    """

    form: Formulation
    lam: Any
    mu: Any
    rows: Any
    value: Any
    smooth: tuple[int, ...]
    linear: tuple[int, ...]
    unknowns: Any
    solved: str

    @classmethod
    def of(cls, form: Formulation) -> Hamiltonian:
        """Derive the Hamiltonian system of an optimal control problem, with the controls that minimise H.

        Raises:
            ProblemError: An unsupported constraint, a control without bounds in which H is linear, or a control that H
                does not determine; names it.
        """
        check_constraints(form)
        sym = form.sym
        levels = [form.bounds.function(form.p)[0][int(i)] for i in form.path.bounds]
        rows = form.path.expression - ca.vertcat(form.problem.symbols(0, 1), *levels)
        lam, mu = sym("lam", form.nx), sym("mu", len(form.path))
        value = form.running + ca.dot(lam, form.f) + ca.dot(mu, rows)
        symbols = [form.x, form.u, lam, mu, form.t, form.T, form.p]
        patterns = nonzero_pattern(ca.hessian(value, form.u)[0], symbols), ca.jacobian_sparsity(rows, form.u)
        curved = {column for pattern in patterns for column in pattern.get_col()}
        smooth, linear = ([i for i in range(form.nu) if (i in curved) == kind] for kind in (True, False))
        system = cls(form, lam, mu, rows, value, tuple(smooth), tuple(linear), None, "")
        unknowns, solved = system._solve()
        return replace(system, unknowns=unknowns, solved=solved)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Sizes of the arguments of the functions `unknowns`, `flow` and `outputs`, in the order of the arguments."""
        form = self.form
        return (form.nx, form.nx, 1, 1, form.np, len(self.linear), len(self.smooth) + len(form.path))

    def flow(self) -> Any:
        """Return the CasADi Function of state rates, costate rates and running cost under the optimal control.

        (x, lam, t, T, p, bang, guess) -> (x', lambda', L, dH/dT).
        """
        form = self.form
        # H is stationary in u and mu, so both are constant in its derivatives
        outputs = [form.f, -ca.gradient(self.value, form.x), form.running, ca.gradient(self.value, form.T)]
        return self._eliminate("flow", outputs)

    def outputs(self) -> Any:
        """Return the CasADi Function of optimal controls, multipliers, Hamiltonian and switching functions.

        (x, lam, t, T, p, bang, guess) -> (u, mu, H, dH/du of the linear controls).
        """
        slope = ca.gradient(self.value, self.form.u)
        switching = slope[list(self.linear)] if self.linear else slope[:0, :]
        return self._eliminate("outputs", [self.form.u, self.mu, self.value, switching])

    def multipliers(
        self, free: np.ndarray, x: np.ndarray, u: np.ndarray, lam: np.ndarray, *, t: np.ndarray, horizon: float, p: Any
    ) -> np.ndarray:
        """Return multipliers (K, m) of the path equalities with which H is almost stationary in the ``free`` controls.

        ``free`` (K, nu) masks the controls off their bounds at K samples of states, controls and costates.
        """
        form, count = self.form, len(u)
        slope = ca.substitute([ca.gradient(self.value, form.u)], [self.mu], [ca.DM.zeros(len(form.path))])[0]
        outputs = [slope, ca.jacobian(self.rows, form.u)]
        slopes, rows = form.sampled(outputs, x, u, t, horizon, p, (self.lam, lam))
        mu = np.zeros((count, len(form.path)))
        for k in range(count):
            columns = rows[k].reshape(form.nu, -1)[free[k]]
            if np.all(np.isfinite(columns)) and np.all(np.isfinite(slopes[k])):
                mu[k] = np.linalg.lstsq(columns, -slopes[k][free[k]], rcond=None)[0]
        return mu

    def _eliminate(self, name: str, outputs: list[Any]) -> Any:
        """Return a CasADi Function that evaluates expressions at the minimum of the Hamiltonian over the controls."""
        form = self.form
        sym = form.sym
        w, bang = sym("w", self.sizes[-1]), sym("bang", self.sizes[-2])
        control = _assemble_control(form, self.smooth, self.linear, w, bang)
        outputs = [ca.densify(out) for out in outputs]
        outputs = ca.substitute(outputs, [form.u, self.mu], [control, w[len(self.smooth) :, :]])
        inner = ca.Function(name, [form.x, self.lam, form.t, form.T, form.p, bang, w], outputs, {"cse": True})
        sym = symbols_of(self.unknowns, inner).sym
        arguments = [sym(f"a{i}", size) for i, size in enumerate(self.sizes)]
        results = inner.call([*arguments[:-1], self.unknowns.call(arguments)[0]])
        return ca.Function(name, arguments, results, {"cse": True})

    def _solve(self) -> tuple[Any, str]:
        """Return the CasADi Function of optimal controls and multipliers, and the name of the solution method.

        Its arguments are (x, lam, t, T, p, bang, guess).
        """
        form, n, m = self.form, len(self.smooth), len(self.form.path)
        sym = form.sym
        self._check_linear()
        w, bang, guess = sym("w", n + m), sym("bang", len(self.linear)), sym("guess", n + m)
        known = [form.x, self.lam, form.t, form.T, form.p, bang]
        gradient = ca.gradient(self.value, form.u)[list(self.smooth)] if n else form.problem.symbols(0, 1)
        control = _assemble_control(form, self.smooth, self.linear, w, bang)
        stationarity = ca.densify(ca.vertcat(gradient, self.rows))
        residual = ca.substitute([stationarity], [form.u, self.mu], [control, w[n:, :]])[0]
        matrix = ca.jacobian(residual, w) if n + m else self.form.problem.symbols(0, 0)
        pattern = nonzero_pattern(matrix, [*known, w])
        if isinstance(matrix, ca.SX):
            matrix = ca.sparsify(matrix)
        self._check_regular(matrix, [*known, w])
        index = form.bounds.places["control"][list(self.smooth)].tolist()
        bounded = bool(np.isfinite([bound[index] for bound in numeric_bounds(form)]).any())
        low, high = (bound[index] for bound in form.bounds.function(form.p))
        separate = m == 0 and pattern.is_diag()
        if not ca.depends_on(matrix, w) and (not bounded or separate):
            offset = ca.substitute([residual], [w], [ca.DM.zeros(n + m)])[0]
            solution = -symmetric_solve(matrix, offset, n) if n + m else w
            if bounded:
                solution = ca.fmax(low, ca.fmin(high, solution))
            return ca.Function("unknowns", [*known, guess], [solution]), "projected" if bounded else "quadratic"
        if bounded:  # stationary or at a bound: u is the projection of u - H_u on the bounds
            inside = ca.fmax(low, ca.fmin(high, w[:n, :] - residual[:n, :]))
            residual = ca.vertcat(w[:n, :] - inside, residual[n:, :])
        equations = ca.Function("stationary", [w, ca.vertcat(*known)], [residual])
        options = {"abstol": 1e-13, "max_iter": 50, "error_on_fail": False, "show_eval_warnings": False}
        finder = ca.rootfinder("control", "newton", equations, options)
        symbols = [ca.MX.sym(f"a{i}", s.numel()) for i, s in enumerate([*known, guess])]
        return ca.Function("unknowns", symbols, [finder(symbols[-1], ca.vertcat(*symbols[:-1]))]), "iterated"

    def _check_linear(self) -> None:
        """Raise ProblemError if a control in which the Hamiltonian is linear is not bounded on both sides."""
        low, high = numeric_bounds(self.form)
        for i in self.linear:
            at = self.form.bounds.places["control"][i]
            if not (np.isfinite(low[at]) and np.isfinite(high[at])):
                raise ProblemError(
                    f"the Hamiltonian is linear in control {self.form.control_labels[i]!r}, which is not bounded on "
                    "both sides, so it has no minimum; bound the control or add a quadratic term to the cost",
                    name=self.form.control_labels[i],
                    value=(float(low[at]), float(high[at])),
                )

    def _check_regular(self, matrix: Any, symbols: list[Any]) -> None:
        """Raise ProblemError if the stationarity equations of the control are singular at a random point."""
        if 0 in matrix.shape:
            return
        rng = np.random.default_rng(0)
        sample = random_values(matrix, symbols, rng)
        singular = np.linalg.svd(sample, compute_uv=False) if np.all(np.isfinite(sample)) else np.ones(1)
        if singular[-1] < ROUNDING_SHARE * singular[0]:
            raise ProblemError(
                "the Hamiltonian does not determine the control: its second derivative is singular on the null space "
                "of the path equalities; add a quadratic term in the control to the cost",
                name="control",
                value=float(singular[-1]),
                limit=float(ROUNDING_SHARE * singular[0]),
            )


def _assemble_control(form: Formulation, smooth: Any, linear: Any, w: Any, bang: Any) -> Any:
    """Assemble the control vector from smooth controls (first entries of ``w``) and bang-bang controls ``bang``."""
    order = {index: w[i] for i, index in enumerate(smooth)} | {index: bang[i] for i, index in enumerate(linear)}
    return ca.densify(ca.vertcat(form.problem.symbols(0, 1), *[order[i] for i in range(form.nu)]))


def check_constraints(form: Formulation) -> None:
    """Raise ProblemError, naming the constraint, if the indirect method does not support a constraint."""
    for name, place in form.states.items():
        index = form.bounds.places["state"][place]
        low, high = (bound[index] for bound in numeric_bounds(form))
        if np.any(np.isfinite(low) | np.isfinite(high)):
            raise ProblemError(
                f"the indirect method does not support the bounds of state {name!r}: path constraints must be bounds "
                "of controls or equalities that contain a control; drop them or use a direct method",
                name=name,
            )
    path = form.path
    for owner, label, equality, uses in zip(path.owners, path.labels, path.equality, path.uses_control, strict=True):
        with error_names(owner):
            if not equality:
                words = f"the indirect method does not support the path inequality {label!r}"
                raise ProblemError(f"{words}; drop it or use a direct method")
            if not uses:
                raise ProblemError(
                    f"the indirect method does not support the path equality {label!r}, which contains no control; "
                    "differentiate it until one appears or use a direct method"
                )
    if form.nu and ca.depends_on(form.terminal, form.u0):
        words = "the indirect method does not support a terminal cost on the control at the start"
        raise ProblemError(words, name="terminal cost")
    controls = ca.vertcat(form.u, form.u0)
    for kind, rows in (("start", form.start), ("end", form.end)):
        for i, (owner, label, equality) in enumerate(zip(rows.owners, rows.labels, rows.equality, strict=True)):
            with error_names(owner):
                if not equality:
                    raise ProblemError(f"the indirect method does not support the {kind} inequality {label!r}")
                if form.nu and ca.depends_on(rows.expression[i], controls):
                    words = f"the indirect method does not support {kind} constraint {label!r} on the control"
                    raise ProblemError(words)


def nonzero_pattern(matrix: Any, symbols: list[Any]) -> Any:
    """Return the sparsity pattern of the entries of a matrix that are not identically zero.

    Of an MX expression these are the entries that are nonzero at one of three random points.
    """
    if isinstance(matrix, ca.SX):
        return ca.sparsify(matrix).sparsity()
    rng = np.random.default_rng(0)
    size = np.abs([random_values(matrix, symbols, rng) for _ in range(3)]).max(axis=0)  # nan counts as nonzero
    return ca.sparsify(ca.DM(np.where(size == 0, 0.0, 1.0))).sparsity()


def numeric_bounds(form: Formulation) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper bounds with every parameter set to 1, to know which of the bounds are finite."""
    lower, upper = (np.asarray(v.full()).reshape(-1) for v in form.bounds.function(np.ones(form.np)))
    return lower, upper


def random_values(matrix: Any, symbols: list[Any], rng: np.random.Generator) -> np.ndarray:
    """Return the value of a matrix expression at random values of its symbols between 0.1 and 1."""
    function = ca.Function("matrix", symbols, [ca.densify(matrix)])
    return np.asarray(function.call([ca.DM(rng.uniform(0.1, 1.0, s.numel())) for s in symbols])[0].full())


def symmetric_solve(matrix: Any, rhs: Any, n: int) -> Any:
    """Solve the symbolic equations of an equality-constrained quadratic program for controls and multipliers.

    [[W, A'], [A, 0]] w = rhs. If the block W (n, n) is positive definite, the matrix has a factorisation L D L' without
    pivoting (Vanderbei 1995).
    """
    if not isinstance(matrix, ca.SX):
        return ca.solve(matrix, rhs)
    curvature = matrix[:n, :n]
    values = np.linalg.eigvalsh(random_values(curvature, ca.symvar(curvature), np.random.default_rng(0)))
    if np.isfinite(values).all() and values[0] > ROUNDING_SHARE * values[-1]:
        return ca.ldl_solve(rhs, *ca.ldl(matrix, False))
    return ca.solve(ca.densify(matrix), rhs)


@dataclass(frozen=True)
class Extremal:
    """Samples of an extremal (a solution of the equations of the minimum principle) in each of its segments.

    Attributes:
        places: Positions of the samples in each segment, 0..1. Shape (m,). widths: of the segments, s. Shape (K,).
        t: Times, s. Shape (K, m).
        states, costates, controls, multipliers: Shapes (K, m, .); multipliers of the path equalities.
        horizon: s. nu_start, nu_end: Multipliers of the start and end constraints.
    """

    places: np.ndarray
    widths: np.ndarray
    t: np.ndarray
    states: np.ndarray
    costates: np.ndarray
    controls: np.ndarray
    multipliers: np.ndarray
    horizon: float
    nu_start: np.ndarray
    nu_end: np.ndarray

    def sampled(self, ham: Hamiltonian, outputs: list[Any], p: np.ndarray) -> list[np.ndarray]:
        """Return the values of given expressions at all samples of the extremal. Shape (K m, size) each."""
        count = self.t.size
        x, u, lam, mu = (v.reshape(count, -1) for v in (self.states, self.controls, self.costates, self.multipliers))
        return ham.form.sampled(outputs, x, u, self.t.ravel(), self.horizon, p, (ham.lam, lam), (ham.mu, mu))


def cost_gradient(ham: Hamiltonian, path: Extremal, p: np.ndarray, bounds: Bounds) -> np.ndarray:
    """Return the gradient of the optimal cost with respect to the parameters of the problem. Shape (np,)."""
    form = ham.form
    slopes = [ca.gradient(ham.value, s) for s in (form.p, form.T, form.u)]
    by_p, by_horizon, by_control, value = path.sampled(ham, [*slopes, ham.value], p)
    weights = (path.widths[:, None] * quadrature_weights(path.places)).ravel()

    x0, x1 = path.states[0, 0], path.states[-1, -1]
    phi_p, phi_horizon, phi_x0, phi_x1 = _end_gradients(ham, path, x0, x1, p)
    places = form.bounds.places
    multipliers = np.zeros((2, len(bounds[0])))  # multipliers of lower and upper bounds, with the sign of f + lam . g
    controls = path.controls.reshape(len(weights), -1)
    low, high = (bound[places["control"]] for bound in bounds)
    middle = 0.5 * (np.where(np.isfinite(low), low, controls) + np.where(np.isfinite(high), high, controls))
    multipliers[0, places["control"]] = -weights @ (by_control * (controls <= middle))
    multipliers[1, places["control"]] = -weights @ (by_control * (controls > middle))
    multipliers[0, form.start.bounds], multipliers[0, form.end.bounds] = path.nu_start, path.nu_end
    multipliers[0, places["initial"]] = -(path.costates[0, 0] + phi_x0)
    multipliers[0, places["terminal"]] = path.costates[-1, -1] - phi_x1
    for end in ("initial", "terminal"):  # free entries have no multiplier
        multipliers[0, places[end]] *= bounds[0][places[end]] == bounds[1][places[end]]
    if not form.horizon_is_free:
        multipliers[0, places["horizon"]] = -(value[-1, 0] + phi_horizon + float(weights @ by_horizon[:, 0]))
    return np.asarray(weights @ by_p + phi_p - form.bounds.pullback(p, multipliers))


def _end_gradients(
    ham: Hamiltonian, path: Extremal, x0: np.ndarray, x1: np.ndarray, p: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """Differentiate terminal cost plus weighted end constraints with respect to parameters, horizon and end states."""
    form = ham.form
    begin = ca.substitute([form.start.expression], [form.x, form.t], [form.x0, 0])[0]
    end, terminal = ca.substitute([form.end.expression, form.terminal], [form.t], [form.T])
    phi = terminal + ca.dot(ca.DM(path.nu_start), begin) + ca.dot(ca.DM(path.nu_end), end)
    symbols = [form.x0, form.x, form.T, form.p]
    gradients = [ca.densify(ca.gradient(phi, s)) for s in (form.p, form.T, form.x0, form.x)]
    values = [np.asarray(v.full()).reshape(-1) for v in ca.Function("phi", symbols, gradients)(x0, x1, path.horizon, p)]
    return values[0], float(values[1][0]), values[2], values[3]
