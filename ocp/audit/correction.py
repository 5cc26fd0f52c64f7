"""What the controls of a plan do, where the plan is nearly right: by Newton's corrections of the plan itself.

What a plan leaves of its own dynamics, integrated over the samples of its fine grid and others between them, drives
the equation of its error, linear in it (Ascher, Mattheij, Russell 1995, chapter 8). All intervals are looked at side
by side. The corrected plan is sampled anew until what is left of a correction is nothing: no step follows another, so
that it takes a fraction of the time of an integration. Where the integrals do not come out to the tolerance of an
integration, as where a push falls between two points, or corrections do not fall, there is no answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from ocp.audit.linearisation import Linearisation, integrals
from ocp.audit.sizes import FineGrid, plan_at
from ocp.console import check_time
from ocp.curves import lagrange

__all__ = ["SETTINGS", "Corrected", "corrected"]


@dataclass(frozen=True)
class IntegrationSettings:
    """How the motion under the controls of a plan is found. Shares are relative.

    Attributes:
        tolerance: Of the error over one cell of the grid, relative to the size of each state.
        rounding: Of a state: its last digits.
        corrections: Of a plan, at most. left: What they may leave, of the sizes: ten times the tolerance.
        falling: Each correction is less than this share of the one before.
        order: Of the error of a step in its width.
        pieces: That a step is split into at once, at most: an unstable step tells no width. rounds: Of splitting.
        steps: At once, at most: what is stiffer than that, or chatters, breaks down within seconds.
        block: Steps in one call. blocks: Calls between two looks at the time.
        inline: Instructions of the dynamics up to which a step is one flat function.
        grown: Times what every interval adds: a plan that is so far off has been carried off by its dynamics.
    """

    tolerance: float = 1e-11
    rounding: float = 4 * float(np.finfo(float).eps)
    corrections: int = 5
    left: float = 1e-10
    falling: float = 0.1
    order: int = 5
    pieces: int = 4
    rounds: int = 40
    steps: int = 300_000
    block: int = 512
    blocks: int = 8
    inline: int = 1000
    grown: float = 10.0


SETTINGS = IntegrationSettings()
INNER = np.array([0.46, 0.53, 0.44, 0.55, 0.48])
"""Where each of five cells is looked at inside: unevenly, so that what swings in time with the grid is seen too. A
polynomial integrates the five together; the number of cells in an interval is a multiple of five."""
POINTS = np.append(np.ravel([np.arange(5), np.arange(5) + INNER], "F") / 5, 1.0)
"""The samples of five cells together, in 0..1."""
LENGTH = len(POINTS[1:])
RULE, ROUGH = (integrals(POINTS, POINTS[1:], degree).T for degree in (LENGTH, LENGTH - 2))
"""What integrates values there from 0 to each of the others, and nearly does: how well, their difference tells."""


class Corrected(NamedTuple):
    """The plan's motion at its fine grid over each interval and over the whole horizon, (N, cells + 1, nx) each.

    With the running cost along each.
    """

    local: np.ndarray
    states: np.ndarray
    local_cost: float
    cost: float


def corrected(along: Linearisation, grid: FineGrid) -> Corrected | None:
    """The motion under the controls of a plan; None where corrections of the plan do not lead to it."""
    if not along.finite:
        return None
    newton = _Newton(along, grid)
    whole = newton.settled(True)
    if whole is None:
        return None
    each = newton.settled(False, whole.rate)
    return None if each is None else Corrected(each.x[:, ::2], whole.x[:, ::2], each.cost, whole.cost)


class _Settled(NamedTuple):
    """States at the grid and inside its cells, the running cost along them, and by what share corrections fell."""

    x: np.ndarray
    cost: float
    rate: float


class _Newton:
    """A plan at its fine grid and inside its cells, and the equation of its error."""

    def __init__(self, along: Linearisation, grid: FineGrid) -> None:
        self.along, form = along, along.form
        (n, q), nx, cells = along.shape, form.nx, grid.samples - 1
        self.width = along.width[:, None, None]
        panels = cells // len(INNER)
        places = np.append(np.add.outer(np.arange(panels), POINTS[:-1]).ravel() / panels, 1.0)
        inner = plan_at(along.solution, places[1::2])
        self.x, self.u, self.t = (
            _woven(part.reshape(n, cells + 1, size), between.reshape(n, cells, size))
            for part, between, size in zip((grid.states, grid.controls, grid.t), inner, (nx, form.nu, 1), strict=True)
        )
        self.unit = np.append(along.sizes.state, along.sizes.cost)
        self.largest = np.hstack([np.abs(grid.states.reshape(n, cells + 1, nx)).max(axis=1), np.zeros((n, 1))])

        self.rule, self.doubt = RULE / panels, (RULE - ROUGH) / panels
        own = np.minimum((along.places * panels).astype(int), panels - 1)
        self.at_gauss = np.zeros((q, 2 * cells + 1))
        for row, panel, place in zip(self.at_gauss, own, along.places, strict=True):
            row[LENGTH * panel :][: LENGTH + 1] = lagrange(POINTS, np.array([place * panels - panel]))[0]
        self.rising = integrals(along.places, places)

        self.feed = along.width[:, None, None, None] * along.rate_y[:, :, :nx].reshape(n, q, nx, nx)
        by_sample = lagrange(along.places, places) @ self.feed.reshape(n, q, nx * nx)
        self.feed_at_samples = by_sample.reshape(n, 2 * cells + 1, nx, nx)
        system = np.einsum("ij,kjab->kiajb", along.matrix, self.feed).reshape(n, q * nx, q * nx)
        self.inverse = np.linalg.inv(np.eye(q * nx) - system)
        self.carried = (self.inverse @ np.tile(np.eye(nx), (q, 1))).reshape(n, q, nx, nx)
        self.transition = np.eye(nx) + (along.weight[:, None, None] * (self.feed @ self.carried)).sum(axis=1)
        self.first = self._integral(self.x)
        self.own = None if self.first is None else self._own_error(self.first, self.x)

    def _integral(self, x: np.ndarray) -> np.ndarray | None:
        """Of the derivatives of states and running cost along x, from the start of each interval to every sample.

        Shape (N, 2 cells + 1, nx + 1). None where it does not come out to the tolerance.
        """
        check_time()
        form, (n, samples) = self.along.form, x.shape[:2]
        states, controls, t = (part.reshape(n * samples, part.shape[2]) for part in (x, self.u, self.t))
        here = states, controls, t, self.along.solution.horizon, self.along.p
        (flow,) = form.sampled(lambda: [ca.vertcat(form.f, form.running)], *here, cache_as="flow")
        flow = flow.reshape(n, samples, -1) * (self.width * self.along.solution.horizon)
        panels = _panels(flow)
        doubt = np.abs(panels @ self.doubt).max(axis=1).reshape(n, -1, flow.shape[2]).max(axis=1)
        room = len(INNER) * SETTINGS.tolerance * self.unit + SETTINGS.rounding * self.largest
        return self._risen(panels, flow.shape) if (doubt <= room).all() else None

    def _risen(self, panels: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """The integral of values in ``_panels`` over the interval, from its start to every sample. (N, 2 cells + 1, m).

        ``shape`` is that of the values.
        """
        n, samples, m = shape
        pieces = (panels @ self.rule).reshape(n, -1, m, LENGTH).transpose(0, 1, 3, 2)
        pieces[:, 1:] += np.cumsum(pieces[:, :-1, -1], axis=1)[:, :, None]
        found = np.zeros(shape)
        found[:, 1:] = pieces.reshape(n, samples - 1, m)
        return found

    def settled(self, chained: bool, rate: float = 1.0) -> _Settled | None:
        """The motion from the plan's first state, or from its own at the start of every interval.

        Args:
            chained: Which of both. rate: By what share corrections fall, as far as is known.
        """
        nx, x, integral, own, last = self.along.form.nx, self.x, self.first, self.own, np.inf
        for _ in range(SETTINGS.corrections):
            if integral is None or own is None:
                break
            change = own + self._carried_on(own[:, -1], x) if chained else own
            size = float(np.abs(change).reshape(-1, nx).max(axis=0) @ (1 / self.unit[:nx]))
            if not size < SETTINGS.falling * last:
                break
            rate = size / last if np.isfinite(last) else rate
            x = x + change
            if rate * size <= SETTINGS.left:
                return _Settled(x, float(integral[:, -1, nx].sum()) + self._more(change), rate)
            integral, last = self._integral(x), size
            own = None if integral is None else self._own_error(integral, x)
        return None

    def _more(self, change: np.ndarray) -> float:
        """What a change of the states adds to the running cost."""
        along, (n, q) = self.along, self.along.shape
        slope = along.cost_y[:, : along.form.nx].reshape(n, q, -1)
        return float(np.einsum("k,j,kji,kji->", along.width, along.weight, slope, self.at_gauss @ change))

    def _own_error(self, integral: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The error of states x that each interval adds, to first order. Shape (N, 2 cells + 1, nx)."""
        (n, q), nx = self.along.shape, self.along.form.nx
        defect = integral[..., :nx] - (x - x[:, :1])
        here = self.at_gauss @ defect
        drive = np.einsum("ij,kjab,kjb->kia", self.along.matrix, self.feed, here)
        follows = here + (self.inverse @ drive.reshape(n, q * nx, 1)).reshape(n, q, nx)
        error = defect + self.rising @ np.einsum("kjab,kjb->kja", self.feed, follows)
        # what swings between the Gauss points feeds the error too
        fed = np.einsum("kjab,kjb->kja", self.feed_at_samples, error)
        return np.asarray(defect + self._risen(_panels(fed), fed.shape))

    def _carried_on(self, ends: np.ndarray, x: np.ndarray) -> np.ndarray:
        """What becomes of the errors (N, nx) at the ends of the intervals of states x, and of the jumps there."""
        start = np.zeros(ends.shape)
        left = ends[:-1] + x[:-1, -1] - x[1:, 0]
        for k in range(len(left)):
            start[k + 1] = self.transition[k] @ start[k] + left[k]
        push = np.einsum("kjab,kjb->kja", self.feed, (self.carried @ start[:, None, :, None])[..., 0])
        return np.asarray(start[:, None] + self.rising @ push)


def _panels(values: np.ndarray) -> np.ndarray:
    """Values (N, 2 cells + 1, m) of each five cells side by side. Shape (N cells / 5 m, 11)."""
    windows = np.lib.stride_tricks.sliding_window_view(values, LENGTH + 1, axis=1)
    return windows[:, ::LENGTH].reshape(-1, LENGTH + 1)


def _woven(ends: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Values at the ends of cells (N, cells + 1, n) and inside them (N, cells, n), in order."""
    found = np.empty((len(ends), ends.shape[1] + inside.shape[1], ends.shape[2]))
    found[:, ::2], found[:, 1::2] = ends, inside
    return found
