"""Whether a plan is a local minimum: its costates and multipliers found anew, what it loses, how the cost curves.

The multipliers that fit a plan best: a convex program dual to the plan's own linearisation.

Where controls rest on their limits the costates are not given by the plan alone: one that switches from limit to limit
where its mesh allows it fits a whole set of them, and a solver reports some point of it, whose switching functions need
not have their zeros where the plan switches. What a plan loses is the least over all multipliers that meet the costate
equation and the conditions at the ends (weak duality): what they win over the gaps to their limits, and what is left of
the slope of the Hamiltonian, by its square over the curvature.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ocp.audit.accessory import AccessoryProblem
from ocp.audit.costates import Adjoint, EndLimits, Ends, adjoint, end_limits, ends_of_intervals
from ocp.audit.curvature import Curvature, curvature
from ocp.audit.linearisation import Limits, Linearisation
from ocp.audit.principle import Hamiltonian, hamiltonian, lost, reduced_slope, turning
from ocp.audit.sizes import sizes
from ocp.problem.formulation import Bounds, Formulation
from ocp.solution import Solution
from ocp.tolerances import FLAT_SHARE, LIMIT_SHARE, RESOLVED_SHARE

__all__ = ["Fit", "Optimality", "best_multipliers", "optimality"]

NEARNESS = 1e-5
"""Weight of the mean square distance from the costates reported, by their size, among multipliers that lose as much."""
SOLVER = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.max_iter": 200,
    "ipopt.mu_strategy": "adaptive",
    "ipopt.perturb_always_cd": "yes",  # multipliers of dependent limits are not unique
    "print_time": False,
    "error_on_fail": False,
}


class Fit(NamedTuple):
    """Multipliers that lose least.

    Attributes:
        lost: What the plan loses by them in each interval, its ends apart, in units of cost. Shape (N,).
        adjoint: The multipliers. Errors are those of the costates reported, as they were.
        distance: Of the costates reported from these, largest of all nodes, in units of cost; 0 beside equalities of
            the states, where costates are known up to multiples of the gradients of these.
    """

    lost: np.ndarray
    adjoint: Adjoint
    distance: float


def best_multipliers(along: Linearisation, known: Adjoint, curved: np.ndarray, cost: float) -> Fit | None:
    """The multipliers of a plan that lose least; None where none are found.

    Args:
        along: The plan. known: Multipliers that are known already.
        curved: T H_uu of these. Shape (M, nu, nu).
        cost: A size of the cost.
    """
    dual = _Dual(along, curved, cost)
    x = dual.program.solve()
    return None if x is None else dual.fit(x * cost, known)


class _Program:
    """A sparse program: least price . x + weight . x^2 / 2 where rows x = right and low <= x."""

    def __init__(self) -> None:
        self._variables: list[np.ndarray] = []  # low, price and weight of each, (3, count)
        self._right: list[np.ndarray] = []
        self._entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def variables(self, count: int, low: Any = -np.inf, price: Any = 0.0, weight: Any = 0.0) -> np.ndarray:
        """Indices of so many more."""
        first = sum(part.shape[1] for part in self._variables)
        self._variables.append(np.array([np.broadcast_to(value, (count,)) for value in (low, price, weight)], float))
        return np.arange(first, first + count)

    def equations(self, right: np.ndarray) -> np.ndarray:
        """Indices of more, in the shape of their right sides."""
        first = sum(part.size for part in self._right)
        self._right.append(right)
        return np.arange(first, first + right.size).reshape(right.shape)

    def add(self, rows: Any, columns: Any, values: Any) -> None:
        """Entries, of arrays that are broadcast to one shape."""
        rows, columns, values = np.broadcast_arrays(rows, columns, values)
        keep = values.ravel() != 0
        self._entries.append((rows.ravel()[keep], columns.ravel()[keep], values.ravel()[keep]))

    def solve(self) -> np.ndarray | None:
        """The best x; None where there is none."""
        rows, columns, values = (np.concatenate(part) for part in zip(*self._entries, strict=True))
        low, price, weight = np.hstack(self._variables)
        right = np.concatenate([part.ravel() for part in self._right])
        matrix = ca.DM.triplet(rows.tolist(), columns.tolist(), ca.DM(values), len(right), len(low))
        x = ca.MX.sym("x", len(low))
        paid = ca.dot(ca.DM(price), x) + ca.dot(ca.DM(weight), x**2) / 2
        solver = ca.nlpsol("dual", "ipopt", {"x": x, "f": paid, "g": ca.mtimes(matrix, x)}, SOLVER)
        found = solver(x0=np.where(np.isfinite(low), 1e-2, 0.0), lbx=low, ubx=np.inf, lbg=right, ubg=right)
        if not solver.stats()["success"]:
            return None
        return np.asarray(np.maximum(found["x"].full().ravel(), low))


@dataclass
class _Pushes:
    """Multipliers of limits, at least zero, each priced by the gap to its limit.

    Attributes:
        point, limit: Where each is, and of what. sign: 1 at an upper limit, -1 at a lower one. Shape (K,) each.
        slope: Of what is limited, times the sign, over ``reach``. Shape (K, n).
        reach: What a multiplier of one moves, in units of cost. price: Gap over reach. Shape (K,) each.
        index: In the program. Shape (K,).
    """

    point: np.ndarray
    limit: np.ndarray
    sign: np.ndarray
    slope: np.ndarray
    reach: np.ndarray
    price: np.ndarray
    index: np.ndarray

    @classmethod
    def of(cls, program: _Program, limits: Limits, chosen: np.ndarray, slopes: np.ndarray, size: np.ndarray,
           share: Any = 1.0) -> _Pushes:  # fmt: skip
        """Both sides of ``chosen`` limits (M, m), bool, with their derivatives (M, m, n) in what has these sizes (n,).

        Those per unit of s cost their gap times the ``share`` (M,) of their point.
        """
        reach = (np.abs(slopes) * size).sum(axis=2)
        sides = []
        for sign, gap in ((1.0, limits.above), (-1.0, limits.below)):
            point, limit = np.nonzero(chosen & np.isfinite(gap) & (reach > 0))
            sides.append((point, limit, np.full(len(point), sign), gap[point, limit]))
        point, limit, signs, gaps = (np.concatenate(part) for part in zip(*sides, strict=True))
        moved = reach[point, limit]
        price = np.broadcast_to(share, len(slopes))[point] * gaps / moved
        slope = slopes[point, limit] * (signs / moved)[:, None]
        return cls(point, limit, signs, slope, moved, price, program.variables(len(point), 0.0, price))

    def table(self, x: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Multipliers with their signs. Shape (M, m)."""
        found = np.zeros(shape)
        np.add.at(found, (self.point, self.limit), self.sign * x[self.index] / self.reach)
        return found


class _Dual:
    """The program for the multipliers of a plan; costates times the sizes of their states, all in units of cost."""

    def __init__(self, along: Linearisation, curved: np.ndarray, cost: float) -> None:
        self.along, self.cost, self.program = along, cost, _Program()
        (n, q), nx, nu = along.shape, along.form.nx, along.form.nu
        self.interval = np.arange(n * q) // q
        self.costate = self.program.variables(n * q * nx).reshape(n * q, nx)
        first, last = ends_of_intervals(along)
        self.told = np.vstack([first, last[-1:]]) * along.state_size
        near = NEARNESS / (n + 1) / max(1.0, float(np.abs(self.told).max()) / cost)
        price = -near * self.told.ravel() / cost
        self.nodes = self.program.variables(self.told.size, price=price, weight=near).reshape(n + 1, nx)

        # a step no shorter than the way between limits leaves it to their gaps to say what it costs
        width = (along.high - along.low).max(axis=0, initial=0.0)
        self.step = np.where(np.isfinite(width), np.maximum(width, along.sizes.control), along.sizes.control)
        driven = np.einsum("k,kij,j->i", along.share, np.abs(along.rate_y[:, :, nx + 1 :]), self.step)
        self.far = max(1.0, float((driven / along.state_size).max(initial=0.0)))
        # what pushes along arcs of the states is among their own limits
        held = along.hold.near & (np.arange(along.hold_u.shape[1]) < nu + len(along.mixed))
        held[:, :nu] = True
        self.hold = _Pushes.of(self.program, along.hold, held, along.hold_u, self.step, along.share)
        wide = np.append(along.state_size, 0.0)
        self.stand = _Pushes.of(self.program, along.stand, along.stand.near, along.stand_x, wide)
        inner = along.node_stand.near & (along.nodal | ~along.node_stand.equal)
        inner[[0, -1]] = False  # the conditions at the ends have their own
        self.node = _Pushes.of(self.program, along.node_stand, inner, along.node_stand_x, wide)
        self.beside = np.zeros((len(self.hold.point), nx + 1))  # derivatives of path rows that hold controls, in (x, T)
        path = self.hold.limit >= nu
        row = along.mixed[self.hold.limit[path] - nu]
        self.beside[path] = along.row_y[self.hold.point[path], row, : nx + 1]
        self.beside *= (self.hold.sign / self.hold.reach)[:, None]
        self._costate_equation()
        self._stationarity(curved)
        self._ends()

    def _costate_equation(self) -> None:
        """lambda' = -dH/dx over every interval, backwards from behind its last node to behind its first."""
        along, program, hold, stand, node = self.along, self.program, self.hold, self.stand, self.node
        (n, q), nx, size = along.shape, along.form.nx, along.state_size
        fed = (along.rate_y[:, :, :nx] * size / size[:, None]).transpose(0, 2, 1)
        given = (along.cost_y[:, :nx] * size / self.cost).reshape(n, q, nx)
        before = node.point - 1  # the interval in front of a node meets its push too
        steps = [(self.costate.reshape(n, q, nx)[:, i], along.weight - along.matrix[i]) for i in range(q)]
        for left, weight in [*steps, (self.nodes[:-1], along.weight)]:
            rows = program.equations(along.width[:, None] * np.einsum("j,kja->ka", weight, given))
            program.add(rows, left, 1.0)
            program.add(rows, self.nodes[1:], -1.0)
            program.add(rows[before], node.index[:, None], -node.slope[:, :nx] * size)
            by_point, at_once = np.outer(along.width, weight).ravel(), np.tile(weight / along.weight, n)
            mine = rows[self.interval]
            program.add(mine[:, :, None], self.costate[:, None, :], -by_point[:, None, None] * fed)
            force = by_point[hold.point, None] * self.beside[:, :nx] * size
            program.add(mine[hold.point], hold.index[:, None], -force)
            force = at_once[stand.point, None] * stand.slope[:, :nx] * size
            program.add(mine[stand.point], stand.index[:, None], -force)

    def _stationarity(self, curved: np.ndarray) -> None:
        """dH/du is what is left of it: paid by its square where the Hamiltonian curves, else for a step.

        A step is as large as the control is along the plan, or, where it has limits, as the way between them.
        """
        along, program, hold = self.along, self.program, self.hold
        nx, unit, share = along.form.nx, self.step, along.share[:, None]
        rows = program.equations(-along.cost_y[:, nx + 1 :] * unit / self.cost)
        rate = along.rate_y[:, :, nx + 1 :] * unit / along.state_size[:, None]
        program.add(rows[:, :, None], self.costate[:, None, :], rate.transpose(0, 2, 1))
        program.add(rows[hold.point], hold.index[:, None], hold.slope * unit)
        bends, vectors = np.linalg.eigh(curved * unit * unit[:, None] / self.cost)
        solid = bends > FLAT_SHARE * float(np.abs(bends).max(initial=0.0))
        self.price = np.where(solid, 0.0, share)
        self.weight = np.where(solid, share / np.where(solid, bends, 1.0), 0.0)
        self.left = []
        for sign in (-1.0, 1.0):
            part = program.variables(rows.size, 0.0, self.price.ravel(), self.weight.ravel()).reshape(rows.shape)
            program.add(rows[:, :, None], part[:, None, :], sign * vectors)
            self.left.append(part)

    def _ends(self) -> None:
        """What is left of the conditions at the ends is paid for a step as far as controls could drive the states."""
        along, program, nx = self.along, self.program, self.along.form.nx
        form, (low, high), horizon = along.form, along.bounds, along.solution.horizon
        places, share = form.bounds.places, along.share
        given = [low[places[k]] == high[places[k]] for k in ("terminal", "initial")]
        self.free = ~np.append(np.concatenate(given), not form.horizon_is_free)
        self.scale = np.concatenate([along.state_size, along.state_size, [horizon]])
        self.ends: EndLimits = end_limits(along)
        self.reach = np.abs(self.ends.slope) @ self.scale
        self.grip = program.variables(
            len(self.reach), np.where(self.ends.equal, -np.inf, 0.0), self.ends.gap / self.reach
        )
        right = along.final_y * self.scale / self.cost
        right[-1] += horizon / self.cost * float(share @ along.cost_y[:, nx])
        rows = np.full(2 * nx + 1, -1)
        rows[self.free] = program.equations(right[self.free])
        own = np.flatnonzero(self.free[:-1])
        at_ends = np.concatenate([self.nodes[-1], self.nodes[0]])
        program.add(rows[own], at_ends[own], np.where(own < nx, 1.0, -1.0))
        slope = self.ends.slope * (self.ends.sign / self.reach)[:, None] * self.scale
        program.add(rows[self.free], self.grip[:, None], -slope[:, self.free])
        if form.horizon_is_free:
            program.add(rows[-1], self.costate, -horizon * share[:, None] * along.rate_y[:, :, nx] / along.state_size)
            program.add(rows[-1], self.hold.index, -horizon * share[self.hold.point] * self.beside[:, nx])
            for pushes in (self.stand, self.node):
                program.add(rows[-1], pushes.index, -horizon * pushes.slope[:, nx])
        self.missed = []
        for sign in (-1.0, 1.0):
            self.missed.append(program.variables(int(self.free.sum()), 0.0, self.far))
            program.add(rows[self.free], self.missed[-1], sign)

    def fit(self, x: np.ndarray, known: Adjoint) -> Fit:
        """What a solution of the program, in units of cost, says."""
        along, (n, q), nx, size = self.along, self.along.shape, self.along.form.nx, self.along.state_size
        lost = np.zeros(n)
        for part in self.left:
            paid = self.price * x[part] + self.weight * x[part] ** 2 / (2 * self.cost)
            np.add.at(lost, self.interval, paid.sum(axis=1))
        for pushes, place in ((self.hold, self.interval), (self.stand, self.interval), (self.node, np.arange(-1, n))):
            np.add.at(lost, place[pushes.point], pushes.price * x[pushes.index])
        standing = self.stand.table(x, along.stand.lower.shape) / along.share[:, None]
        at_nodes = self.node.table(x, along.node_stand.lower.shape)
        standing.reshape(n, q, -1)[:, -1] += at_nodes[1:] / along.share.reshape(n, q)[:, -1:]
        slope = np.zeros(2 * nx + 1)
        slope[self.free] = (x[self.missed[1]] - x[self.missed[0]]) / self.scale[self.free]
        end, start = self.ends.table(x[self.grip] / self.reach)
        charge = float(self.ends.gap / self.reach @ x[self.grip])
        behind = x[self.nodes]
        before = behind.copy()
        np.add.at(before, self.node.point, self.node.slope[:, :nx] * size * x[self.node.index, None])
        off = np.minimum(np.abs(self.told - behind), np.abs(self.told - before))[:-1].sum(axis=1)
        return Fit(
            lost,
            replace(
                known,
                costate=x[self.costate] / size,
                holding=self.hold.table(x, along.hold.lower.shape),
                standing=standing,
                ends=known.ends._replace(slope=slope[nx:], charge=charge, end=end, start=start),
            ),
            0.0 if along.stand.equal.any() else float(off.max()),
        )


@dataclass(frozen=True)
class Optimality:
    """First and second order conditions along a plan.

    Attributes:
        lost: What the plan could cost less, to second order, in each interval; those at its ends in the first. (N,)
        cost_size: What it is judged against, in units of cost: the cost, or where that is next to nothing what
            changes of the controls that are just told apart would cost.
        error_size: What errors of the costates are judged against, in units of cost. They cost by their square.
        stationarity: Largest slope of the Hamiltonian that nothing holds at the Gauss points, relative to the sizes
            of its parts. t: their times, s. Both (N q,).
        known_to: Share of the cost up to which a transcription that loses as much in its controls knows its costates.
        unfit: Error of the costates reported, as a share of the cost, where others fit the plan better: their distance
            from these, or what they lose more, by its root. flat: Whether H does not curve along some control.
        adjoint: Costates and multipliers. hamiltonian: Along the plan. curvature: The second variation.
    """

    lost: np.ndarray
    cost_size: float
    error_size: float
    t: np.ndarray
    stationarity: np.ndarray
    adjoint: Adjoint
    hamiltonian: Hamiltonian
    curvature: Curvature
    known_to: float
    unfit: float
    flat: bool


def optimality(
    form: Formulation,
    solution: Solution,
    p: np.ndarray,
    bounds: Bounds,
    along: Linearisation | None = None,
    allowed: float = LIMIT_SHARE,
) -> Optimality:
    """Look for the multipliers of a plan, for what it loses and for how the cost curves.

    Args:
        form, p, bounds: The problem, its parameters and its bounds at these.
        solution: The plan. along: Its first derivatives, where they are known already.
        allowed: Share of the cost from which on it is worth looking for multipliers that fit the plan better than the
            costates reported.
    """
    along = along or Linearisation(form, solution, p, bounds, sizes(form, solution, p, bounds))
    if not (along.finite and np.isfinite(solution.cost)):
        return undefined(along, hamiltonian(form, solution, p))
    cost = abs(solution.cost) or along.slope_size or 1.0
    curved = _curved(along)
    first = adjoint(along, curved, cost)
    if first.lumps.any():
        found, told = first, _told(along, first, curved)
        for _ in range(4):  # each finds pushes at single nodes better by the width of an interval
            found = adjoint(along, curved, cost, found.lumps)
            now = _told(along, found, curved)
            if now >= told:
                break
            first, told = found, now
    accessory = AccessoryProblem(along, first)
    spread = accessory.spread
    cost = max(abs(solution.cost), LIMIT_SHARE * accessory.price, LIMIT_SHARE**2 * along.slope_size)
    cost = cost if cost > 0 else 1.0
    total = lost(along, first.costate, first.holding, accessory.curved)
    total, best = np.maximum(total, 0.0) + first.charge, first
    told, unfit = _won(total, first), 0.0
    several = along.several or bool(accessory.flat.any())
    if told > allowed * cost and several:
        fit = best_multipliers(along, first, accessory.curved, cost)
        if fit is not None and _won(fit.lost, fit.adjoint) < told:
            best = fit.adjoint
            total = np.maximum(fit.lost + turning(along, best.costate, accessory.curved), 0.0)
            unfit = min(fit.distance / cost, float(np.sqrt((told - _won(total, best)) / cost)))
            accessory = AccessoryProblem(along, best)
    total[0] += best.ends.charge
    loses = float(total.sum()) if unfit else told
    known_to = float(np.sqrt(loses / cost)) if np.isfinite(loses) else 0.0
    second = curvature(accessory)
    if second.upwards and second.won is not None:  # near a conjugate point states that follow win more
        more = float(second.won.sum() - total.sum())
        total += max(more, 0.0) * second.won / (float(second.won.sum()) or 1.0)
    total[0] += second.lost(accessory.start_slope)
    return Optimality(
        total,
        cost,
        max(float(np.sqrt(cost * max(cost, spread))), RESOLVED_SHARE**2 * accessory.magnitude),
        along.t,
        reduced_slope(along, best.costate, best.holding),
        best,
        hamiltonian(form, solution, p),
        second,
        known_to,
        unfit,
        bool(accessory.flat.any()),
    )


def _won(by_interval: np.ndarray, multipliers: Adjoint) -> float:
    """What a plan loses with these multipliers but for its start, in units of cost."""
    return float(by_interval.sum() + multipliers.ends.charge)


def _told(along: Linearisation, found: Adjoint, curved: np.ndarray | None) -> float:
    """What a plan loses and errs by with these multipliers, in units of cost."""
    assert curved is not None
    won = lost(along, found.costate, found.holding, curved).sum() + found.charge.sum() + found.ends.charge
    return float(won + found.total + found.ends.transversality)


def _curved(along: Linearisation) -> np.ndarray | None:
    """T H_uu at the points but for its path constraints, (M, nu, nu), where what pushes at single points needs it."""
    form = along.form
    near = along.stand.near.any() or along.node_stand.near.any()
    single = along.nodal and (along.mixed.size > 0 or near)
    if form.path.equality[along.mixed].all() and not single:
        return None
    lam = form.sym("lam", form.nx)

    def outputs() -> list[Any]:
        return [ca.hessian(along.scaled[0] + ca.dot(lam, along.scaled[1]), form.u)[0]]

    (curved,) = form.sampled(outputs, *along.here, (lam, along.costate), cache_as="curvature in the controls")
    return np.asarray(curved.reshape(-1, form.nu, form.nu))


def undefined(along: Linearisation, values: Hamiltonian) -> Optimality:
    """What is found where the problem is not a number along the plan: nothing that would pass."""
    (n, _), m = along.shape, len(along.s)
    nothing, form = np.full(n, np.inf), along.form
    ends = Ends(
        np.inf, np.inf, np.full(form.nx + 1, np.nan), np.inf, np.zeros(len(form.end)), np.zeros(len(form.start))
    )
    t = along.mesh * along.solution.horizon
    shapes = form.nx, along.hold_u.shape[1], along.stand_x.shape[1]
    costate, holding, standing = (np.full((m, k), np.nan) for k in shapes)
    curved = Curvature(np.nan, None, "the problem is not a number along the plan", None, along.t)
    return Optimality(
        nothing,
        1.0,
        1.0,
        along.t,
        np.full(m, np.inf),
        Adjoint(t, costate, holding, standing, nothing, np.inf, nothing, nothing, np.zeros((n + 1, form.nx)), ends),
        values,
        curved,
        0.0,
        0.0,
        False,
    )
