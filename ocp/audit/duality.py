"""The multipliers that fit a plan best: a convex program dual to the plan's own linearisation.

Where controls rest on their limits the costates are not given by the plan alone: one that switches from limit to limit
where its mesh allows it fits a whole set of them, and a solver reports some point of it, whose switching functions need
not have their zeros where the plan switches. What a plan loses is the least over all multipliers that meet the costate
equation and the conditions at the ends (weak duality): what they win over the gaps to their limits, and what is left of
the slope of the Hamiltonian, by its square over the curvature.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ocp.audit.costates import Adjoint, end_limits, ends_of_intervals
from ocp.audit.linearisation import Limits, Linearisation
from ocp.audit.principle import FLAT

__all__ = ["best_multipliers"]

NEARNESS = 1e-6
"""Weight of the mean square distance from the costates reported, among multipliers that lose as much."""
SOLVER = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-7,
    "ipopt.max_iter": 200,
    "ipopt.mu_strategy": "adaptive",
    "ipopt.perturb_always_cd": "yes",  # multipliers of dependent limits are not unique
    "print_time": False,
    "error_on_fail": False,
}


@dataclass
class _Columns:
    """Nonnegative multipliers of limits: the point and the limit of each, its sign, and its gap."""

    point: np.ndarray
    limit: np.ndarray
    sign: np.ndarray
    gap: np.ndarray

    @classmethod
    def of(cls, limits: Limits, chosen: np.ndarray) -> _Columns:
        """Both sides of ``chosen`` limits, where there is a limit at all. Shape (M, m), bool."""
        sides = []
        for sign, gap in ((1.0, limits.above), (-1.0, limits.below)):
            point, limit = np.nonzero(chosen & np.isfinite(gap))
            sides.append((point, limit, np.full(len(point), sign), gap[point, limit]))
        return cls(*(np.concatenate(parts) for parts in zip(*sides, strict=True)))

    def __len__(self) -> int:
        return len(self.point)

    def table(self, values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Multipliers with their signs. Shape (M, m)."""
        found = np.zeros(shape)
        np.add.at(found, (self.point, self.limit), self.sign * values)
        return found


class _Program:
    """A sparse program: least price . x + weight . x^2 / 2 where rows x = right, low <= x."""

    def __init__(self) -> None:
        self.size, self.rows = 0, 0
        self._low: list[np.ndarray] = []
        self._price: list[np.ndarray] = []
        self._weight: list[np.ndarray] = []
        self._right: list[np.ndarray] = []
        self._entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def variables(self, count: int, low: Any = -np.inf, price: Any = 0.0, weight: Any = 0.0) -> np.ndarray:
        """Indices of so many more."""
        for pool, value in ((self._low, low), (self._price, price), (self._weight, weight)):
            pool.append(np.broadcast_to(np.asarray(value, float), (count,)))
        self.size += count
        return np.arange(self.size - count, self.size)

    def equations(self, right: np.ndarray) -> np.ndarray:
        """Indices of so many more."""
        self._right.append(right)
        self.rows += len(right)
        return np.arange(self.rows - len(right), self.rows)

    def add(self, rows: Any, columns: Any, values: Any) -> None:
        """Entries, of arrays that are broadcast to one shape."""
        rows, columns, values = np.broadcast_arrays(rows, columns, values)
        keep = values.ravel() != 0
        self._entries.append((rows.ravel()[keep], columns.ravel()[keep], values.ravel()[keep]))

    def solve(self) -> np.ndarray | None:
        """The best x; None where there is none."""
        rows, columns, values = (np.concatenate(part) for part in zip(*self._entries, strict=True))
        matrix = ca.DM.triplet(rows.tolist(), columns.tolist(), ca.DM(values), self.rows, self.size)
        x, right = ca.MX.sym("x", self.size), np.concatenate(self._right)
        price, weight = ca.DM(np.concatenate(self._price)), ca.DM(np.concatenate(self._weight))
        solver = ca.nlpsol(
            "dual",
            "ipopt",
            {"x": x, "f": ca.dot(price, x) + ca.dot(weight, x**2) / 2, "g": ca.mtimes(matrix, x)},
            SOLVER,
        )
        low = np.concatenate(self._low)
        found = solver(x0=np.where(np.isfinite(low), 1e-2, 0.0), lbx=low, ubx=np.inf, lbg=right, ubg=right)
        if not solver.stats()["success"]:
            return None
        return np.maximum(np.asarray(found["x"].full()).ravel(), low)


def best_multipliers(
    along: Linearisation, known: Adjoint, curved: np.ndarray, cost: float
) -> tuple[np.ndarray, Adjoint, float] | None:
    """What a plan loses in each interval by the multipliers that lose least; these; how far reported costates are off.

    None where none are found.

    Args:
        along: The plan. known: Multipliers that are known already, whose errors of the costates stay.
        curved: T H_uu of these. Shape (M, nu, nu).
        cost: A size of the cost.
    """
    form, (n, q), nx, nu = along.form, along.shape, along.form.nx, along.form.nu
    m, mixed, horizon = n * q, along.mixed, along.solution.horizon
    size, unit, share = along.state_size, along.sizes.control, along.share
    program = _Program()
    # costates at the points, and behind each node; all in units of cost
    costate = program.variables(m * nx).reshape(m, nx)
    first, last = ends_of_intervals(along)
    told = np.vstack([first, last[-1:]]) * size / cost
    near = NEARNESS / (n + 1)
    nodes = program.variables((n + 1) * nx, price=-near * told.ravel(), weight=near).reshape(n + 1, nx)
    point = np.arange(m)
    interval = point // q

    held = along.hold.near.copy()
    held[:, :nu], held[:, nu + len(mixed) :] = True, False  # what pushes along arcs of states is among their limits
    held &= np.abs(along.hold_u).max(axis=2) > 0
    hold = _Columns.of(along.hold, held)
    across = along.hold_u[hold.point, hold.limit] * unit
    reach = np.abs(across).max(axis=1)
    force = program.variables(len(hold), 0.0, share[hold.point] * hold.gap / reach)
    beside = np.zeros((len(hold), nx + 1))
    path = hold.limit >= nu
    beside[path] = along.row_y[hold.point[path], mixed[hold.limit[path] - nu], : nx + 1]
    beside *= (hold.sign / reach)[:, None]

    stand = _Columns.of(along.stand, along.stand.near)
    inner = along.node_stand.near.copy()
    inner[[0, -1]] = False  # the conditions at the ends have their own
    inner &= ~along.node_stand.equal if not along.nodal else True
    node = _Columns.of(along.node_stand, inner)
    slopes = [
        table[limits.point, limits.limit] for table, limits in ((along.stand_x, stand), (along.node_stand_x, node))
    ]
    lengths = [np.abs(slope[:, :nx]) @ size for slope in slopes]
    push, atom = (
        program.variables(len(limits), 0.0, limits.gap / np.where(length > 0, length, 1.0))
        for limits, length in zip((stand, node), lengths, strict=True)
    )
    pushed, struck = (
        slope * (limits.sign / np.where(length > 0, length, 1.0))[:, None]
        for slope, limits, length in zip(slopes, (stand, node), lengths, strict=True)
    )

    # lambda' = - dH/dx, backwards over every interval
    rate_x = along.rate_y[:, :, :nx] * size / size[:, None]
    given = along.cost_y[:, :nx] * size / cost
    ahead = along.weight - along.matrix
    at_points = program.equations(np.einsum("k,ij,kja->kia", along.width, ahead, given.reshape(n, q, nx)).ravel())
    at_nodes = program.equations(np.einsum("k,j,kja->ka", along.width, along.weight, given.reshape(n, q, nx)).ravel())
    at_points, at_nodes = at_points.reshape(m, nx), at_nodes.reshape(n, nx)
    program.add(at_points, costate, 1.0)
    program.add(at_points, nodes[interval + 1], -1.0)
    program.add(at_nodes, nodes[:-1], 1.0)
    program.add(at_nodes, nodes[1:], -1.0)
    before = node.point - 1  # the interval in front of a node meets its atom too
    for j in range(q):
        program.add(at_points[before * q + j], atom[:, None], -struck[:, :nx] * size)
    program.add(at_nodes[before], atom[:, None], -struck[:, :nx] * size)
    weights = [(at_points.reshape(n, q, nx)[:, i], ahead[i]) for i in range(q)] + [(at_nodes, along.weight)]
    for rows, weight in weights:
        by_point = along.width[interval] * weight[point % q]
        program.add(
            rows[interval][:, :, None], costate[:, None, :], -by_point[:, None, None] * rate_x.transpose(0, 2, 1)
        )
        program.add(rows[interval[hold.point]], force[:, None], -by_point[hold.point][:, None] * beside[:, :nx] * size)
        at_once = (weight / along.weight)[stand.point % q]
        program.add(rows[interval[stand.point]], push[:, None], -at_once[:, None] * pushed[:, :nx] * size)

    # dH/du = what is left of it, paid for by its square where the Hamiltonian curves
    rate_u = along.rate_y[:, :, nx + 1 :] * unit / size[:, None]
    stationary = program.equations((-along.cost_y[:, nx + 1 :] * unit / cost).ravel()).reshape(m, nu)
    program.add(stationary[:, :, None], costate[:, None, :], rate_u.transpose(0, 2, 1))
    program.add(stationary[hold.point], force[:, None], across * (hold.sign / reach)[:, None])
    bends, vectors = np.linalg.eigh(curved * unit * unit[:, None] / cost)
    solid = bends > FLAT * float(np.abs(bends).max(initial=0.0))
    price = np.where(solid, 0.0, share[:, None])
    weight = np.where(solid, share[:, None] / np.where(solid, bends, 1.0), 0.0)
    left = [program.variables(m * nu, 0.0, price.ravel(), weight.ravel()).reshape(m, nu) for _ in range(2)]
    for sign, part in zip((-1.0, 1.0), left, strict=True):
        program.add(stationary[:, :, None], part[:, None, :], sign * vectors)

    # the conditions at the ends
    low, high = along.bounds
    places = form.bounds.places
    scale = np.concatenate([size, size, [horizon]])
    ends = end_limits(along)
    reach_end = np.abs(ends.slope) @ scale
    low_end = np.where(ends.equal, -np.inf, 0.0)
    grip = program.variables(len(ends.sign), low_end, ends.gap / reach_end)
    right = np.concatenate([along.final_y[:nx], along.final_y[nx:]]) * scale / cost
    right[-1] += horizon / cost * float(share @ along.cost_y[:, nx])
    free = np.append(
        np.concatenate([low[places[k]] < high[places[k]] for k in ("terminal", "initial")]), form.horizon_is_free
    )
    total = np.concatenate([nodes[-1], nodes[0]])
    rows = np.full(2 * nx + 1, -1)
    rows[free] = program.equations(right[free])
    own = np.flatnonzero(free[: 2 * nx])
    program.add(rows[own], total[own], np.where(own < nx, 1.0, -1.0))
    program.add(rows[free][None], grip[:, None], (-ends.slope * (ends.sign / reach_end)[:, None] * scale)[:, free])
    if form.horizon_is_free:
        program.add(rows[-1], costate, -horizon * share[:, None] * along.rate_y[:, :, nx] / size)
        program.add(rows[-1], force, -horizon * share[hold.point] * beside[:, nx])
        program.add(rows[-1], push, -horizon * pushed[:, nx])
        program.add(rows[-1], atom, -horizon * struck[:, nx])
    missed = [program.variables(int(free.sum()), 0.0, 1.0) for _ in range(2)]
    for sign, part in zip((-1.0, 1.0), missed, strict=True):
        program.add(rows[free], part, sign)

    x = program.solve()
    if x is None:
        return None
    x *= cost
    paid = np.zeros(n)
    for part in left:
        rest = x[part]
        np.add.at(paid, interval, (price * rest + weight * rest**2 / (2 * cost)).sum(axis=1))
    np.add.at(paid, interval[hold.point], share[hold.point] * hold.gap / reach * x[force])
    np.add.at(paid, interval[stand.point], stand.gap / lengths[0] * x[push])
    np.add.at(paid, before, node.gap / lengths[1] * x[atom])
    holding = hold.table(x[force] / reach, held.shape)
    at_nodes_pushed = node.table(x[atom] / lengths[1], along.node_stand.lower.shape)
    standing = stand.table(x[push] / lengths[0], along.stand.lower.shape) / share[:, None]
    standing.reshape(n, q, -1)[:, -1] += at_nodes_pushed[1:] / share.reshape(n, q)[:, -1, None]
    slope = np.zeros(2 * nx + 1)
    slope[free] = (x[missed[1]] - x[missed[0]]) / scale[free]
    multipliers = ends.table(x[grip] / reach_end)
    behind = x[nodes] / size
    before_node = behind.copy()
    for k, push_x in zip(node.point, struck[:, :nx] * x[atom][:, None], strict=True):
        before_node[k] += push_x
    off = np.minimum(np.abs(first - behind[:-1]), np.abs(first - before_node[:-1])) @ size
    found = replace(
        known,
        costate=x[costate] / size,
        holding=holding,
        standing=standing,
        ends=known.ends._replace(
            slope=slope[nx:], charge=float(ends.gap / reach_end @ x[grip]), end=multipliers[0], start=multipliers[1]
        ),
    )
    # beside equalities of the states costates are known up to multiples of the gradients of these
    return paid, found, 0.0 if along.stand.equal.any() else float(off.max())
