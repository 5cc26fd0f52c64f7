"""Which constraints cannot hold together, where, and by how much: the least that would have to give way.

A solver that fails leaves its last iterate, whose residuals are spread over constraints and dynamics alike. Here the
dynamics and the given ends hold, and every constraint and bound may be missed by an amount of its own, the same at all
times: the plan with the least sum of these amounts, each relative to the size of its constraint, is the answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.assembly import Program, sparse
from ocp.fragment import Fragment
from ocp.problem.formulation import Formulation

__all__ = ["Conflict", "conflicts"]

IPOPT = {"tol": 1e-6, "max_iter": 300, "print_level": 0, "sb": "yes"}
COST = 1e-3  # share of the problem's own cost, which makes the plan unique
TASK = 10.0  # how much dearer it is to miss an equality, which is what is asked for, than a limit
LEAST = 1e-5  # amount below which a constraint holds, relative to its size


@dataclass(frozen=True)
class Conflict:
    """A constraint that has to give way.

    Attributes:
        label: Of the constraint, or of the state or control whose bound it is.
        amount: By how much, in its own unit. bound: The bound that is missed, and its side, ``lower`` or ``upper``.
        fraction: Of the horizon where it is missed most.
        horizon: Of the plan, s.
    """

    label: str
    amount: float
    bound: float
    side: str
    fraction: float
    horizon: float

    def __str__(self) -> str:
        time = f" at {self.fraction * self.horizon:.4g} s" if self.label != "horizon" else ""
        return f"{self.label} would have to go {self.amount:.3g} beyond its {self.side} bound {self.bound:.4g}{time}"


def conflicts(
    form: Formulation, fragment: Fragment, program: Program, arguments: dict[str, np.ndarray], horizon: float
) -> list[Conflict] | None:
    """What has to give way, the largest share first; [] where all can hold; None where no answer is found.

    Args:
        arguments: Of the solver: x0, p and the bounds lbx, ubx, lbg, ubg.
        horizon: The fixed final time, s; not used where it is free.
    """
    soft = _Soft(form, fragment, arguments)
    n, m, k = fragment.size, fragment.n_rows, len(soft.labels)
    x, p = ca.MX.sym("x", n + k), program.nlp["p"]
    v, slack = x[:n], x[n:]
    rows, columns = soft.picks(n, m, k)
    with np.errstate(all="ignore"):
        size = float(program.values(arguments["x0"], arguments["p"])[0])
    share = COST / max(1.0, abs(size)) if np.isfinite(size) else 0.0
    lam, sigma = ca.MX.sym("lam", rows.shape[0]), ca.MX.sym("sigma")
    cost, slope = program.gradient(v, p)
    values, jacobian = program.jacobian(v, p)
    f = share * cost + ca.dot(ca.DM(soft.prices), slack)
    g = ca.mtimes(rows, values) + ca.mtimes(columns, x)
    jac = ca.horzcat(ca.mtimes(rows, jacobian), ca.DM(rows.shape[0], k)) + columns
    curved = program.hessian(v, p, share * sigma, ca.mtimes(rows.T, lam))
    options = {
        "grad_f": ca.Function("g", [x, p], [f, ca.vertcat(share * slope, soft.prices)], ["x", "p"], ["f", "g"]),
        "jac_g": ca.Function("j", [x, p], [g, jac], ["x", "p"], ["g", "j"]),
        "hess_lag": ca.Function("h", [x, p, sigma, lam], [ca.diagcat(curved, ca.DM(k, k))]),
        "print_time": False,
        "error_on_fail": False,
        "show_eval_warnings": False,
        "ipopt": IPOPT,
    }
    lower, upper = soft.limits(arguments)
    try:
        solver = ca.nlpsol("elastic", "ipopt", {"x": x, "p": p, "f": f, "g": g}, options)
        result = solver(
            x0=np.concatenate([arguments["x0"], np.zeros(k)]),
            p=arguments["p"],
            lbx=np.concatenate([soft.low, np.zeros(k)]),
            ubx=np.concatenate([soft.high, np.full(k, np.inf)]),
            lbg=lower,
            ubg=upper,
        )
    except RuntimeError:  # an integrator breaks down
        return None
    if not solver.stats()["success"]:
        return None
    plan = np.asarray(result["x"].full()).ravel()[:n]
    found = np.asarray(program.values(plan, arguments["p"])[1].full()).ravel()
    end = horizon if fragment.horizon is None else float(plan[fragment.horizon])
    return soft.read(np.concatenate([found, plan]), arguments, end)


class _Soft:
    """Which rows and bounds may be missed: all but the dynamics, the given ends and the least horizon.

    Rows are numbered before variables. Those of one label share a slack.
    """

    def __init__(self, form: Formulation, fragment: Fragment, arguments: dict[str, np.ndarray]) -> None:
        places = form.bounds.places
        names = {"state": form.state_labels, "control": form.control_labels, "horizon": ("horizon",)}
        variables = [
            names[role][entry] if role else ""
            for role, entry in zip(fragment.variable_role, fragment.variable_entry, strict=True)
        ]
        owner = np.array([*fragment.row_labels, *variables])
        low = np.concatenate([arguments["lbg"], arguments["lbx"]])
        high = np.concatenate([arguments["ubg"], arguments["ubx"]])
        declared = np.concatenate([places[kind] for kind in ("path", "start", "end")])
        is_soft = np.concatenate([np.isin(fragment.row_bounds, declared), arguments["lbx"] < arguments["ubx"]])
        self.lower = np.flatnonzero(is_soft & np.isfinite(low) & (owner != "horizon"))
        self.upper = np.flatnonzero(is_soft & np.isfinite(high))
        self.hard = np.flatnonzero(~is_soft[: fragment.n_rows])
        self.labels, index = np.unique(owner[np.concatenate([self.lower, self.upper])], return_inverse=True)
        self.slack_of_lower, self.slack_of_upper = index[: len(self.lower)], index[len(self.lower) :]
        with np.errstate(invalid="ignore"):
            width = high - low
        bound = np.maximum(np.where(np.isfinite(low), np.abs(low), 0), np.where(np.isfinite(high), np.abs(high), 0))
        size = np.where(np.isfinite(width) & (width > 0), width, np.where(bound > 0, bound, 1.0))
        self.sizes = np.full(len(self.labels), np.inf)
        np.minimum.at(self.sizes, index, size[np.concatenate([self.lower, self.upper])])
        self.prices = 1 / self.sizes
        self.prices[index[(low == high)[np.concatenate([self.lower, self.upper])]]] *= TASK
        relaxed = is_soft[fragment.n_rows :]
        horizon = fragment.variable_role == "horizon"
        self.low = np.where(relaxed & ~horizon, -np.inf, arguments["lbx"])
        self.high = np.where(relaxed, np.inf, arguments["ubx"])
        self.fractions = np.concatenate([fragment.row_fractions, fragment.variable_fraction])

    def picks(self, n: int, m: int, k: int) -> tuple[Any, Any]:
        """Constant matrices R, C: the elastic rows are R g(v) + C (v, slack)."""
        chosen = np.concatenate([self.hard, self.lower, self.upper])
        number = np.arange(len(chosen))
        of_rows = chosen < m
        rows = sparse(number[of_rows], chosen[of_rows], np.ones(of_rows.sum()), (len(chosen), m))
        first, second = len(self.hard), len(self.hard) + len(self.lower)
        at = np.concatenate([number[~of_rows], number[first:second], number[second:]])
        columns = np.concatenate([chosen[~of_rows] - m, n + self.slack_of_lower, n + self.slack_of_upper])
        signs = np.concatenate([np.ones((~of_rows).sum()), np.ones(len(self.lower)), -np.ones(len(self.upper))])
        return rows, sparse(at, columns, signs, (len(chosen), n + k))

    def limits(self, arguments: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the elastic rows."""
        low = np.concatenate([arguments["lbg"], arguments["lbx"]])
        high = np.concatenate([arguments["ubg"], arguments["ubx"]])
        free = np.full(max(len(self.lower), len(self.upper)), np.inf)
        lower = np.concatenate([low[self.hard], low[self.lower], -free[: len(self.upper)]])
        return lower, np.concatenate([high[self.hard], free[: len(self.lower)], high[self.upper]])

    def read(self, values: np.ndarray, arguments: dict[str, np.ndarray], horizon: float) -> list[Conflict]:
        low = np.concatenate([arguments["lbg"], arguments["lbx"]])
        high = np.concatenate([arguments["ubg"], arguments["ubx"]])
        found: dict[int, Conflict] = {}
        for side, index, slack in (
            ("lower", self.lower, self.slack_of_lower),
            ("upper", self.upper, self.slack_of_upper),
        ):
            miss = low[index] - values[index] if side == "lower" else values[index] - high[index]
            bound = (low if side == "lower" else high)[index]
            for i in np.argsort(-miss):
                j = int(slack[i])
                if miss[i] <= LEAST * self.sizes[j]:
                    break
                if j not in found or miss[i] > found[j].amount:
                    at = float(self.fractions[index[i]])
                    found[j] = Conflict(str(self.labels[j]), float(miss[i]), float(bound[i]), side, at, horizon)
        return [found[j] for j in sorted(found, key=lambda j: -found[j].amount / self.sizes[j])]
