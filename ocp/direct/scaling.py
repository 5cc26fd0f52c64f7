"""Scaling of a nonlinear program by the sizes of its variables, constraints and cost; removal of redundant limits.

A solver's tolerances are absolute and suit numbers near 1. Each variable is divided by its size; each row and the cost
by their change when the variables change by their sizes. Scaling is linear and keeps the optimum. Scales are powers of
two, so that nothing is rounded. Sizes within a factor of 1000 of 1 are not scaled, so that scaling does not affect
plans in usual units, unless the problem declares a size.

Sizes come from fixed ends and guesses. A variable with neither takes the size that the dynamics imply, since a state
changes by its rate times the horizon: the least-squares solution over all couplings (Curtis, Reid 1972). Next in order
are the size of its bounds, and 1.

Some states evolve independently of the controls. A clock state, c' = 1 from c(0) = 0, leaves a solver no choice, so
that a limit on it, or a fixed end, is one condition more than there are unknowns. Such limits are removed for the solve
and checked afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ocp.direct.assembly import Program, Transcription
from ocp.direct.nlp import SOLVER_RESIDUAL, Outcome
from ocp.errors import SolverStatus
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.values import dependence
from ocp.tolerances import ROUNDING_SHARE

SIDES = ("lbx", "ubx", "lbg", "ubg")


@dataclass(frozen=True)
class ScalingSettings:
    """Thresholds and weights for the scaling of a nonlinear program.

    Attributes:
        usual: Sizes from 1/usual to usual are not scaled: tolerances of 1e-10 leave seven digits there.
        rounding: Share of the largest size below which a value is the rounding of a zero, such as the sine of pi in a
            guess.
        weak: Weight of the bounds relative to the dynamics in the least-squares fit, and of the size 1 relative to the
            bounds.
        beside: Displacement from the guess at which derivatives that vanish there are evaluated, as a share of the
            range of each state and control.
    """

    usual: float = 1e3
    rounding: float = 1e-13
    weak: float = 1e-3
    beside: float = 0.1

    @property
    def bad(self) -> float:
        """Ratio of magnitudes, or of a state's change to its magnitude, above which a problem is badly scaled."""
        return self.usual**2


SCALING = ScalingSettings()


@dataclass(frozen=True)
class Scales:
    """Scales of a nonlinear program, by which its n variables, its m constraints and its cost are divided."""

    variables: np.ndarray
    rows: np.ndarray
    cost: float

    def scale_arguments(self, arguments: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the solver's arguments (initial point, parameters, bounds) in the units of the scaled program."""
        units = {"x": self.variables, "g": self.rows}
        result = {key: arguments[key] / units[key[-1]] for key in SIDES}
        p = np.concatenate([arguments["p"], self.variables, self.rows, [self.cost]])
        return {**result, "x0": arguments["x0"] / self.variables, "p": p}

    def unscale(self, outcome: Outcome) -> Outcome:
        """Convert a solver's result for the scaled program to the units of the problem."""
        return replace(
            outcome,
            variables=outcome.variables * self.variables,
            rows=outcome.rows * self.rows,
            cost=outcome.cost * self.cost,
            multipliers=outcome.multipliers * self.cost / self.rows,
        )


@dataclass(frozen=True)
class Sizes:
    """Typical magnitudes of the nx states, of the nu controls and of the horizon (s)."""

    states: np.ndarray
    controls: np.ndarray
    horizon: float

    def of_variables(self, transcription: Transcription) -> np.ndarray:
        """Return the typical magnitude of each variable of a nonlinear program; 1 for auxiliary variables."""
        result = np.ones(transcription.size)
        for role, sizes in (("state", self.states), ("control", self.controls), ("horizon", np.array([self.horizon]))):
            chosen = transcription.variable_role == role
            result[chosen] = sizes[transcription.variable_entry[chosen]]
        return result


class Pattern:
    """Sparsity structure of a nonlinear program, determined once for repeated computation of the program's scales.

    Attributes:
        rows, columns: Row and column of each nonzero of the Jacobian.
        to, source: For each nonzero the state whose rate the row contains, and the entry of (states, controls) of its
            column; -1 for other rows and for the state itself.
        width: Width of the interval of each row, as a fraction of the horizon.
        label: Number of the label of each row; rows of one label have one scale.
    """

    def __init__(self, form: Formulation, transcription: Transcription, program: Program) -> None:
        self.form, self.transcription, self.program = form, transcription, program
        self.rows, self.columns = rows, columns = program.jacobian_entries
        kinds = ("dynamics", "continuity")
        states = {f"{kind} of {label}": i for kind in kinds for i, label in enumerate(form.state_labels)}
        owner = np.array([states.get(label, -1) for label in transcription.row_labels], dtype=np.int32)
        to = np.where(transcription.row_bounds == form.bounds.places["zero"][0], owner, -1)[rows]
        role = transcription.variable_role[columns]
        source = transcription.variable_entry[columns] + np.where(role == "control", form.nx, 0)
        inner = (to >= 0) & ((role == "state") | (role == "control")) & (to != source)
        self.to, self.source = (np.where(inner, index, -1).astype(np.int32) for index in (to, source))
        self.width = np.diff(transcription.mesh)[np.clip(transcription.row_stages, 0, len(transcription.mesh) - 2)]
        _, self.label = np.unique(transcription.row_labels, return_inverse=True)


def unit_scales(transcription: Transcription) -> Scales:
    """Return scales that are all 1, for a nonlinear program that is not scaled."""
    return Scales(np.ones(transcription.size), np.ones(transcription.n_rows), 1.0)


def scaled_program(program: Program) -> Program:
    """Return the nonlinear program with variables, constraints and cost divided by scales, which become parameters.

    The variables are x / a, the rows g / b, the cost f / c and the parameters (p, a, b, c). Only the functions that
    solvers use are replaced.
    """
    n, m, k = (program.nlp[key].numel() for key in ("x", "g", "p"))
    x, q = ca.MX.sym("x", n), ca.MX.sym("p", k + n + m + 1)
    sigma, lam = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", m)
    p, a, b, c = q[:k], q[k : k + n], q[k + n : k + n + m], q[k + n + m]
    v = x * a
    f, slope = program.gradient(v, p)
    g, jacobian = program.jacobian(v, p)
    hessian = program.hessian(v, p, sigma / c, lam / b)
    value, rows = program.values(v, p)
    row, column = jacobian.sparsity().get_triplet()
    first, second = hessian.sparsity().get_triplet()
    of_rows, by_row = map(ca.vec, (jacobian.nz[:], b[row]))  # for a single row casadi returns a row vector
    scaled_jacobian = ca.MX(jacobian.sparsity(), of_rows * a[column] / by_row)
    scaled_hessian = ca.MX(hessian.sparsity(), hessian.nz[:] * a[first] * a[second])
    names = ["x", "p", "lam_f", "lam_g"]
    return replace(
        program,
        nlp={"x": x, "p": q, "f": value / c, "g": rows / b},
        gradient=ca.Function("nlp_grad_f", [x, q], [f / c, slope * a / c], ["x", "p"], ["f", "grad_f_x"]),
        jacobian=ca.Function("nlp_jac_g", [x, q], [g / b, scaled_jacobian], ["x", "p"], ["g", "jac_g_x"]),
        hessian=ca.Function("nlp_hess_l", [x, q, sigma, lam], [scaled_hessian], names, ["triu_hess_gamma_x_x"]),
        values=ca.Function("values", [x, q], [value / c, rows / b]),
    )


def sizes_along(
    pattern: Pattern, point: np.ndarray, intended: Collection[str], *, bounds: Bounds, p: np.ndarray
) -> Sizes:
    """Return the typical magnitudes of states, controls and horizon, derived from the solver's initial point.

    Args:
        point: Values of the variables.
        intended: Names of states, controls and ``horizon`` whose values in ``point`` are intended rather than defaults.
            Fixed ends always count.
        bounds, p: Bounds, and the parameters.
    """
    form, transcription = pattern.form, pattern.transcription
    nx, nu, places = form.nx, form.nu, form.bounds.places
    low, high = bounds
    largest = np.zeros(nx + nu + 1)
    for role, offset, names in (("state", 0, form.states), ("control", nx, form.controls)):
        chosen = transcription.variable_role == role
        np.maximum.at(largest, offset + transcription.variable_entry[chosen], np.abs(point[chosen]))
        for name, entries in names.items():
            if name not in intended:
                largest[offset + entries.start : offset + entries.stop] = 0.0
    for end in ("initial", "terminal"):
        index = places[end]
        largest[:nx] = np.maximum(largest[:nx], np.where(low[index] == high[index], np.abs(low[index]), 0.0))
    horizon = transcription.duration(form, point, p)
    if transcription.horizon is None or "horizon" in intended:
        largest[-1] = horizon
    index = np.concatenate([places["state"], places["control"], places["horizon"]])
    ends = np.abs([low[index], high[index]])
    ends[0, -1] = 0.0  # the lower bound of the horizon is no size
    reach = np.where(np.isfinite(ends), ends, 0.0).max(axis=0)
    # values at rounding level of their limits, or of all values without limits, do not count
    known = largest > SCALING.rounding * np.where(reach > 0, reach, largest.max())
    if known.all():
        return Sizes(largest[:nx], largest[nx:-1], horizon)

    # log s_i = log a_ij + log s_j + log T / T_0 of every coupling a_ij at the horizon T_0
    coupling = couplings(pattern, point, p)
    beside = couplings(pattern, _displaced(pattern, point, largest, (low[index], high[index])), p)
    coupling = np.where(coupling < ROUNDING_SHARE * beside, beside, coupling)
    to, source = np.nonzero(coupling)
    equations = np.zeros((len(to), len(largest)))
    equations[np.arange(len(to)), to] += 1.0
    equations[np.arange(len(to)), source] -= 1.0
    equations[:, -1] -= 1.0
    logs = np.log(np.where(known, largest, 1.0))
    right = np.log(coupling[to, source]) - np.log(horizon) - equations @ logs
    bounded = np.flatnonzero((reach > 0) & ~known)
    eye = np.eye(len(largest))
    rows = np.vstack([equations, SCALING.weak * eye[bounded], SCALING.weak**2 * eye[~known]])[:, ~known]
    values = np.concatenate([right, SCALING.weak * np.log(reach[bounded]), np.zeros(int(np.sum(~known)))])
    logs[~known] = np.linalg.lstsq(rows, values, rcond=None)[0]
    sizes = np.exp(logs)
    return Sizes(sizes[:nx], sizes[nx:-1], float(sizes[-1]))


def _displaced(pattern: Pattern, point: np.ndarray, sizes: np.ndarray, ends: Bounds) -> np.ndarray:
    """Return a point with each state and control displaced by a share of its magnitude or, if unknown, of its range.

    A derivative such as the cosine of a right angle may vanish at the guess, but not at a displaced point.

    Args:
        sizes: Known sizes of states, controls and horizon, 0 if unknown. ends: Their bounds.
    """
    width = ends[1] - ends[0]
    unit = np.where(sizes > 0, sizes, np.where(np.isfinite(width), width, 1.0))
    share = SCALING.beside * np.random.default_rng(0).uniform(0.5, 1.0, len(unit))
    result = point.copy()
    for role, offset in (("state", 0), ("control", pattern.form.nx)):
        chosen = pattern.transcription.variable_role == role
        entry = offset + pattern.transcription.variable_entry[chosen]
        moved = point[chosen] + (share * unit)[entry]
        result[chosen] = np.where(moved > ends[1][entry], 2 * point[chosen] - moved, moved)
    return result


def couplings(pattern: Pattern, point: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the largest derivatives of state rates with respect to other states and controls, times the horizon.

    They are absolute values, over all intervals, at the given values of the variables. Shape (nx, nx + nu).
    """
    result = np.zeros((pattern.form.nx, pattern.form.nx + pattern.form.nu))
    slopes = _evaluate(pattern.program.numbers.first, point, p)
    if slopes is not None:
        entries = np.abs(slopes[1].data)
        used = (pattern.to >= 0) & np.isfinite(entries) & (entries > 0)
        # a row contains the rate times the width of its interval
        width = pattern.width[pattern.rows[used]]
        np.maximum.at(result, (pattern.to[used], pattern.source[used]), entries[used] / width)
    return result


def compute_scales(pattern: Pattern, sizes: Sizes, point: np.ndarray, p: np.ndarray) -> Scales:
    """Compute the scales of a nonlinear program from the magnitudes of the variables and derivatives at a point."""
    program, size_of_variable = pattern.program, sizes.of_variables(pattern.transcription)
    # squares of smaller sizes underflow
    size_of_variable = np.where(size_of_variable > np.sqrt(np.finfo(float).tiny), size_of_variable, 1.0)
    largest = np.zeros(pattern.transcription.n_rows)  # of all rows with one label, so that scales are constant in time
    slopes = _evaluate(program.numbers.first, point, p)
    if slopes is not None:
        with np.errstate(invalid="ignore"):
            entries = np.abs(slopes[1].data) * size_of_variable[pattern.columns]
        np.maximum.at(largest, pattern.label[pattern.rows], np.where(np.isfinite(entries), entries, 0.0))
    changes = []
    for place in (point, point + size_of_variable):  # also beside a start at the minimum of the cost
        slope = _evaluate(program.numbers.gradient, place, p)
        if slope is not None:
            with np.errstate(invalid="ignore"):
                changes.append(float(np.abs(slope * size_of_variable).sum()))
    usual = [change for change in changes if np.isfinite(change) and change > 0]
    cost = min(usual, default=1.0)
    # a slope that is large at the start may be small at the optimum: scale it only to the edge of the usual range
    cost = cost / SCALING.usual if cost > SCALING.usual else cost if cost < 1 / SCALING.usual else 1.0
    largest = np.where(largest > SCALING.rounding * largest.max(initial=0.0), largest, 1.0)
    variables = _with_declared_sizes(pattern, _powers(size_of_variable))
    return Scales(variables, _powers(largest[pattern.label]), float(2.0 ** np.round(np.log2(cost))))


def scaling_fault(pattern: Pattern, point: np.ndarray, p: np.ndarray, *, scales: Scales, sizes: Sizes) -> str:
    """Return a description of how a solved nonlinear program is badly scaled; "" if the scaling is good."""
    form, transcription = pattern.form, pattern.transcription
    scaled_size = sizes.of_variables(transcription) / scales.variables
    deviation = np.abs(np.log(scaled_size))
    if scaled_size.size and deviation.max() > np.log(SCALING.bad):
        k = int(np.argmax(deviation))
        role, entry = str(transcription.variable_role[k]), int(transcription.variable_entry[k])
        label = {"state": form.state_labels, "control": form.control_labels}.get(role, ("",))[entry]
        return f"{role} {label}".strip() + f" is of size {scaled_size[k]:.1g} to the solver, not near 1"
    coupling = couplings(pattern, point, p)
    sizes_of_inputs = np.concatenate([sizes.states, sizes.controls])
    change = (coupling * sizes_of_inputs / sizes.states[:, None]).max(axis=1, initial=0.0)
    if form.horizon_is_free:
        change *= sizes.horizon / point[transcription.horizon]
    deviation = np.abs(np.log(np.where(change > 0, change, 1.0)))
    if deviation.max(initial=0.0) > np.log(SCALING.bad):
        i = int(np.argmax(deviation))
        return f"state {form.state_labels[i]} moves by {change[i]:.1g} times its size {sizes.states[i]:.1g}"
    return ""


def _with_declared_sizes(pattern: Pattern, scales: np.ndarray) -> np.ndarray:
    """Replace the computed scales of variables by their declared magnitudes, if any, rounded to powers of two."""
    form = pattern.form
    declared = Sizes(form.scales[: form.nx], form.scales[form.nx :], 1.0).of_variables(pattern.transcription)
    declared[~np.isin(pattern.transcription.variable_role, ("state", "control"))] = np.nan
    return np.where(np.isnan(declared), scales, np.exp2(np.round(np.log2(declared))))


def _powers(sizes: np.ndarray) -> np.ndarray:
    """Return scales: the nearest power of two for unusually large or small magnitudes, and 1 for all others."""
    unusual = (sizes < 1 / SCALING.usual) | (sizes > SCALING.usual)
    return np.where(unusual, np.exp2(np.round(np.log2(np.where(unusual, sizes, 1.0)))), 1.0)


def _evaluate(function: Callable[..., Any], point: np.ndarray, p: np.ndarray) -> Any:
    """Return the values of a function of the nonlinear program; None if an integrator fails."""
    try:
        return function(point, p)
    except RuntimeError:
        return None


class PredeterminedVariables:
    """Variables of a program that the initial state determines regardless of the controls, and limits on them.

    Variables that are joined to a fixed variable, as the end of the last interval is to a fixed end, are known too.
    """

    def __init__(self, form: Formulation, transcription: Transcription, program: Program) -> None:
        state = transcription.variable_role == "state"
        independent = uncontrolled_states(form)
        self.variables = np.zeros(transcription.size, dtype=bool)
        self.variables[state] = independent[transcription.variable_entry[state]]
        self.later = self.variables & (transcription.variable_fraction > 0)
        declared = np.concatenate([form.bounds.places[kind] for kind in ("path", "start", "end")])
        self.declared = np.isin(transcription.row_bounds, declared)
        self.rows, self.columns = program.jacobian_entries
        # linear rows of two variables, such as those that join the end of an interval to the next node
        linear, column, _ = transcription.linear
        is_pair = [np.bincount(index, minlength=transcription.n_rows)[linear] == 2 for index in (linear, self.rows)]
        joining = np.flatnonzero(is_pair[0] & is_pair[1])
        pairs = joining[np.argsort(linear[joining], kind="stable")].reshape(-1, 2)
        self.joins, self.joined = linear[pairs[:, 0]], column[pairs]

    def relaxed(self, arguments: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the solver arguments without limits that involve only predetermined variables."""
        known = arguments["lbx"] == arguments["ubx"]
        equal = arguments["lbg"][self.joins] == arguments["ubg"][self.joins]
        known[self.joined[equal & known[self.joined].any(axis=1)]] = True
        unknown = ~(self.variables | known)
        redundant = self.declared & (np.bincount(self.rows, unknown[self.columns], len(self.declared)) == 0)
        result = dict(arguments)
        for key, mask in (("x", self.later), ("g", redundant)):
            result[f"lb{key}"] = np.where(mask, -np.inf, arguments[f"lb{key}"])
            result[f"ub{key}"] = np.where(mask, np.inf, arguments[f"ub{key}"])
        return result

    def checked(self, outcome: Outcome, arguments: dict[str, np.ndarray], scales: Scales) -> Outcome:
        """Return a solver's result, marked infeasible if variables that the initial state determines violate limits.

        Args:
            scales: Units in which violations are judged.
        """
        v = outcome.variables
        clipped = np.where(self.later, np.clip(v, arguments["lbx"], arguments["ubx"]), v)
        violation = np.abs(clipped - v) / (scales.variables + np.abs(v))
        row_violation = np.maximum(arguments["lbg"] - outcome.rows, outcome.rows - arguments["ubg"])
        row_violation = np.where(self.declared, row_violation, 0.0) / (scales.rows + np.abs(outcome.rows))
        if not outcome.success or max(violation.max(initial=0.0), row_violation.max(initial=0.0)) <= SOLVER_RESIDUAL:
            return replace(outcome, variables=clipped) if outcome.success else outcome
        return replace(outcome, status=SolverStatus.INFEASIBLE, message=SolverStatus.INFEASIBLE.message)


def uncontrolled_states(form: Formulation) -> np.ndarray:
    """Return which states depend only on the initial state and time, not on controls. Shape (nx,), bool."""
    if form.horizon_is_free:
        return np.zeros(form.nx, dtype=bool)
    independent = form.initial_is_fixed & ~dependence(form.f, form.u).any(axis=1)
    states = dependence(form.f, form.x)
    while (dependent := independent & (states & ~independent).any(axis=1)).any():
        independent = independent & ~dependent
    return np.asarray(independent)
