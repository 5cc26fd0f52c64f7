"""Sizes of states, controls, horizon, constraints and cost, by which a program is scaled before it is solved.

A solver's tolerances are absolute: they suit numbers near 1. Each variable is divided by its size, each row and the
cost by how far they move when the variables move by theirs. Scaling is linear, so the optimum stays the same; sizes are
powers of two, so nothing is rounded; and what lies within a thousand of 1 is left alone, so that plans in usual units
do not depend on it at all, but for what the problem tells the size of.

Sizes are those of given ends and guesses. What has none of these takes the size that the dynamics give it, since a
state moves by its derivative times the horizon, in the least-squares sense over all couplings (Curtis, Reid 1972), then
that of its bounds, then 1.

What is known before anything is solved: states that run by themselves, and limits that touch nothing else.

A clock kept as a state, c' = 1 from c(0) = 0, leaves a solver nothing to choose, so a limit on it, or its given end, is
one condition more than there are unknowns. Such limits are let go while solving, and looked at afterwards.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ocp.direct.assembly import Program, Transcription
from ocp.direct.nlp import SOLVER_RESIDUAL, Outcome
from ocp.problem.formulation import Bounds, Formulation
from ocp.status import SolverStatus

__all__ = [
    "SCALING",
    "Pattern",
    "Predetermined",
    "Scales",
    "Sizes",
    "compute_scales",
    "scaled_program",
    "scaling_fault",
    "sizes_along",
    "unit_scales",
]

SIDES = ("lbx", "ubx", "lbg", "ubg")


@dataclass(frozen=True)
class ScalingSettings:
    """Which sizes are told from others.

    Attributes:
        usual: Sizes from 1/usual to usual are left alone: the tolerances of 1e-10 leave seven digits there.
        rounding: Of the largest size: what is smaller is the rounding of a zero, such as the sine of pi in a guess.
        weak: Weight of the bounds against the dynamics where a size is sought, and of the size 1 against the bounds.
    """

    usual: float = 1e3
    rounding: float = 1e-13
    weak: float = 1e-3

    @property
    def bad(self) -> float:
        """Factor between sizes, or between a state and what drives it, from which on a program is badly scaled."""
        return self.usual**2


SCALING = ScalingSettings()


@dataclass(frozen=True)
class Scales:
    """What the variables (n,), the rows (m,) and the cost of a program are divided by."""

    variables: np.ndarray
    rows: np.ndarray
    cost: float

    def inside(self, arguments: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Arguments of a solver (x0, p and bounds) for the scaled program."""
        units = {"x": self.variables, "g": self.rows}
        own = {key: arguments[key] / units[key[-1]] for key in SIDES}
        p = np.concatenate([arguments["p"], self.variables, self.rows, [self.cost]])
        return {**own, "x0": arguments["x0"] / self.variables, "p": p}

    def outside(self, outcome: Outcome) -> Outcome:
        """What a solver returned of the scaled program, in the units of the problem."""
        return replace(
            outcome,
            variables=outcome.variables * self.variables,
            rows=outcome.rows * self.rows,
            cost=outcome.cost * self.cost,
            multipliers=outcome.multipliers * self.cost / self.rows,
        )


@dataclass(frozen=True)
class Sizes:
    """Sizes of the entries of the states (nx,) and controls (nu,), and of the horizon, s."""

    states: np.ndarray
    controls: np.ndarray
    horizon: float

    def of_variables(self, transcription: Transcription) -> np.ndarray:
        """The size of each variable of a program; 1 of a copy that a stage carries of nothing declared."""
        found = np.ones(transcription.size)
        for role, sizes in (("state", self.states), ("control", self.controls), ("horizon", np.array([self.horizon]))):
            mine = transcription.variable_role == role
            found[mine] = sizes[transcription.variable_entry[mine]]
        return found


class Pattern:
    """What sizes are read from, of a program that is scaled many times.

    Attributes:
        rows, columns: Of the nonzeros of the Jacobian. to, source: Of each the state whose rate the row is, and the
            entry of (states, controls) that it is derived in; -1 where there is none, or it is the state itself.
        width: Of the interval of each row, as a fraction. label: A number for the label of each.
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
        self.to, self.source = (np.where(inner, each, -1).astype(np.int32) for each in (to, source))
        self.width = np.diff(transcription.mesh)[np.clip(transcription.row_stages, 0, len(transcription.mesh) - 2)]
        _, self.label = np.unique(transcription.row_labels, return_inverse=True)


def unit_scales(transcription: Transcription) -> Scales:
    """Scales of one: the program as it is."""
    return Scales(np.ones(transcription.size), np.ones(transcription.n_rows), 1.0)


def scaled_program(program: Program) -> Program:
    """The program in variables x / a with rows g / b and cost f / c, where its parameters are (p, a, b, c).

    Of the functions only those that solvers ask for are made anew.
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
    of_rows, by_row = map(ca.vec, (jacobian.nz[:], b[row]))  # of a single row casadi makes rows
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


# ---- sizes -------------------------------------------------------------------------------------------------------


def sizes_along(pattern: Pattern, point: np.ndarray, given: Collection[str], bounds: Bounds, p: np.ndarray) -> Sizes:
    """Sizes of what varies along a start.

    Args:
        point: Values of the variables.
        given: Names of states, controls and ``horizon`` whose values there are meant, not filled in; given ends count
            anyhow.
        bounds, p: At the parameters.
    """
    form, transcription = pattern.form, pattern.transcription
    nx, nu, places = form.nx, form.nu, form.bounds.places
    low, high = bounds
    seen = np.zeros(nx + nu + 1)
    for role, offset, pool in (("state", 0, form.states), ("control", nx, form.controls)):
        mine = transcription.variable_role == role
        np.maximum.at(seen, offset + transcription.variable_entry[mine], np.abs(point[mine]))
        for name, place in pool.items():
            if name not in given:
                seen[offset + place.start : offset + place.stop] = 0.0
    for end in ("initial", "terminal"):
        index = places[end]
        seen[:nx] = np.maximum(seen[:nx], np.where(low[index] == high[index], np.abs(low[index]), 0.0))
    horizon = float(form.horizon_at(p) if transcription.horizon is None else point[transcription.horizon])
    if transcription.horizon is None or "horizon" in given:
        seen[-1] = horizon
    index = np.concatenate([places["state"], places["control"], places["horizon"]])
    ends = np.abs([low[index], high[index]])
    ends[0, -1] = 0.0  # the least horizon is a fence, no size
    reach = np.where(np.isfinite(ends), ends, 0.0).max(axis=0)
    # what is rounding beside its own limits, or beside all else where it has none, has not been seen
    known = seen > SCALING.rounding * np.where(reach > 0, reach, seen.max())
    if known.all():
        return Sizes(seen[:nx], seen[nx:-1], horizon)

    # log s_i = log a_ij + log s_j + log T / T_0 of every coupling a_ij at the horizon T_0
    pull = couplings(pattern, point, p)
    to, source = np.nonzero(pull)
    equations = np.zeros((len(to), len(seen)))
    equations[np.arange(len(to)), to] += 1.0
    equations[np.arange(len(to)), source] -= 1.0
    equations[:, -1] -= 1.0
    logs = np.log(np.where(known, seen, 1.0))
    right = np.log(pull[to, source]) - np.log(horizon) - equations @ logs
    bounded = np.flatnonzero((reach > 0) & ~known)
    eye = np.eye(len(seen))
    rows = np.vstack([equations, SCALING.weak * eye[bounded], SCALING.weak**2 * eye[~known]])[:, ~known]
    values = np.concatenate([right, SCALING.weak * np.log(reach[bounded]), np.zeros(int(np.sum(~known)))])
    logs[~known] = np.linalg.lstsq(rows, values, rcond=None)[0]
    sizes = np.exp(logs)
    return Sizes(sizes[:nx], sizes[nx:-1], float(sizes[-1]))


def couplings(pattern: Pattern, point: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Horizon times the largest derivative of each state's rate in each other state and control. (nx, nx + nu)."""
    found = np.zeros((pattern.form.nx, pattern.form.nx + pattern.form.nu))
    slopes = _slopes(pattern.program, point, p)
    if slopes is not None:
        entries = np.abs(slopes[1].data)
        keep = (pattern.to >= 0) & np.isfinite(entries) & (entries > 0)
        # a row sees the rate over its interval
        width = pattern.width[pattern.rows[keep]]
        np.maximum.at(found, (pattern.to[keep], pattern.source[keep]), entries[keep] / width)
    return found


def compute_scales(pattern: Pattern, sizes: Sizes, point: np.ndarray, p: np.ndarray) -> Scales:
    """Scales of a program for variables of these sizes; rows and cost by how far they move from a start."""
    program, by = pattern.program, sizes.of_variables(pattern.transcription)
    # below, squares are no numbers any more, so that a cost has no size to fit
    by = np.where(by > np.sqrt(np.finfo(float).tiny), by, 1.0)
    largest = np.zeros(pattern.transcription.n_rows)  # of all rows of a label, the same at all times
    slopes = _slopes(program, point, p)
    if slopes is not None:
        with np.errstate(invalid="ignore"):
            entries = np.abs(slopes[1].data) * by[pattern.columns]
        np.maximum.at(largest, pattern.label[pattern.rows], np.where(np.isfinite(entries), entries, 0.0))
    moves = []
    for place in (point, point + by):  # where a start rests on the least of the cost, beside it
        slope = _slope(program, place, p)
        if slope is not None:
            with np.errstate(invalid="ignore"):
                moves.append(float(np.abs(slope * by).sum()))
    usual = [move for move in moves if np.isfinite(move) and move > 0]
    cost = min(usual, default=1.0)
    # a large slope at the start may be small where the cost is least, so it is brought to the edge of the usual only
    cost = cost / SCALING.usual if cost > SCALING.usual else cost if cost < 1 / SCALING.usual else 1.0
    largest = np.where(largest > SCALING.rounding * largest.max(initial=0.0), largest, 1.0)
    return Scales(_told(pattern, _powers(by)), _powers(largest[pattern.label]), float(2.0 ** np.round(np.log2(cost))))


def scaling_fault(pattern: Pattern, point: np.ndarray, p: np.ndarray, scales: Scales, sizes: Sizes) -> str:
    """What makes a program badly scaled as it was solved, in words; "" where nothing does."""
    form, transcription = pattern.form, pattern.transcription
    by = sizes.of_variables(transcription) / scales.variables
    off = np.abs(np.log(by))
    if by.size and off.max() > np.log(SCALING.bad):
        k = int(np.argmax(off))
        role, entry = str(transcription.variable_role[k]), int(transcription.variable_entry[k])
        label = {"state": form.state_labels, "control": form.control_labels}.get(role, ("",))[entry]
        return f"{role} {label}".strip() + f" is of size {by[k]:.1g} to the solver, not near 1"
    pull = couplings(pattern, point, p)
    inner = np.concatenate([sizes.states, sizes.controls])
    drive = (pull * inner / sizes.states[:, None]).max(axis=1, initial=0.0)
    if form.horizon_is_free:
        drive *= sizes.horizon / point[transcription.horizon]
    off = np.abs(np.log(np.where(drive > 0, drive, 1.0)))
    if off.max(initial=0.0) > np.log(SCALING.bad):
        i = int(np.argmax(off))
        return f"state {form.state_labels[i]} moves by {drive[i]:.1g} times its size {sizes.states[i]:.1g}"
    return ""


def _told(pattern: Pattern, found: np.ndarray) -> np.ndarray:
    """The sizes of variables with those, as powers of two, that the problem tells."""
    form = pattern.form
    told = Sizes(form.scales[: form.nx], form.scales[form.nx :], 1.0).of_variables(pattern.transcription)
    told[~np.isin(pattern.transcription.variable_role, ("state", "control"))] = np.nan
    return np.where(np.isnan(told), found, np.exp2(np.round(np.log2(told))))


def _powers(sizes: np.ndarray) -> np.ndarray:
    """The nearest powers of two of sizes out of the usual; 1 of the others."""
    odd = (sizes < 1 / SCALING.usual) | (sizes > SCALING.usual)
    return np.where(odd, np.exp2(np.round(np.log2(np.where(odd, sizes, 1.0)))), 1.0)


def _slope(program: Program, point: np.ndarray, p: np.ndarray) -> Any:
    """Gradient of the program; None where an integrator breaks down."""
    try:
        return program.numbers.gradient(point, p)
    except RuntimeError:
        return None


def _slopes(program: Program, point: np.ndarray, p: np.ndarray) -> Any:
    """Gradient and Jacobian of the program; None where an integrator breaks down."""
    try:
        return program.numbers.first(point, p)
    except RuntimeError:
        return None


class Predetermined:
    """Which variables of a program are known in advance, and which rows only look at such.

    What is joined to a given variable, as the end of the last interval is to a given end, is known too.
    """

    def __init__(self, form: Formulation, transcription: Transcription, program: Program) -> None:
        state = transcription.variable_role == "state"
        alone = uncontrolled_states(form)
        self.variables = np.zeros(transcription.size, dtype=bool)
        self.variables[state] = alone[transcription.variable_entry[state]]
        self.later = self.variables & (transcription.variable_fraction > 0)
        self.declared = np.isin(
            transcription.row_bounds, np.concatenate([form.bounds.places[kind] for kind in ("path", "start", "end")])
        )
        self.rows, self.columns = program.jacobian_entries
        # rows of two variables, linear, as those that join the end of an interval to the next node
        linear, column, _ = transcription.linear
        alike = [np.bincount(index, minlength=transcription.n_rows)[linear] == 2 for index in (linear, self.rows)]
        both = np.flatnonzero(alike[0] & alike[1])
        pairs = both[np.argsort(linear[both], kind="stable")].reshape(-1, 2)
        self.joins, self.joined = linear[pairs[:, 0]], column[pairs]

    def relaxed(self, arguments: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Arguments of a solver without the limits that only look at what is known."""
        given = arguments["lbx"] == arguments["ubx"]
        equal = arguments["lbg"][self.joins] == arguments["ubg"][self.joins]
        given[self.joined[equal & given[self.joined].any(axis=1)]] = True
        unknown = ~(self.variables | given)
        idle = self.declared & (np.bincount(self.rows, unknown[self.columns], len(self.declared)) == 0)
        own = dict(arguments)
        for key, mask in (("x", self.later), ("g", idle)):
            own[f"lb{key}"] = np.where(mask, -np.inf, arguments[f"lb{key}"])
            own[f"ub{key}"] = np.where(mask, np.inf, arguments[f"ub{key}"])
        return own

    def checked(self, outcome: Outcome, arguments: dict[str, np.ndarray], scales: Scales) -> Outcome:
        """An outcome held against the limits that were let go; no success where one is missed.

        Args:
            scales: By which a miss is judged.
        """
        v = outcome.variables
        inside = np.where(self.later, np.clip(v, arguments["lbx"], arguments["ubx"]), v)
        miss = np.abs(inside - v) / (scales.variables + np.abs(v))
        beyond = np.maximum(arguments["lbg"] - outcome.rows, outcome.rows - arguments["ubg"])
        beyond = np.where(self.declared, beyond, 0.0) / (scales.rows + np.abs(outcome.rows))
        if not outcome.success or max(miss.max(initial=0.0), beyond.max(initial=0.0)) <= SOLVER_RESIDUAL:
            return replace(outcome, variables=inside) if outcome.success else outcome
        return replace(outcome, status=SolverStatus.INFEASIBLE, message=SolverStatus.INFEASIBLE.message)


def uncontrolled_states(form: Formulation) -> np.ndarray:
    """Which states follow from the start and the time alone, whatever the controls do. Shape (nx,), bool."""
    if form.horizon_is_free:
        return np.zeros(form.nx, dtype=bool)

    def uses(symbol: ca.SX | ca.MX) -> np.ndarray:
        pattern = np.asarray(ca.DM(ca.jacobian_sparsity(form.f, symbol), 1).full()) != 0
        return np.asarray(pattern.reshape(form.nx, -1))

    alone = form.initial_is_fixed & ~uses(form.u).any(axis=1)
    states = uses(form.x)
    while (waiting := alone & (states & ~alone).any(axis=1)).any():
        alone = alone & ~waiting
    return np.asarray(alone)
