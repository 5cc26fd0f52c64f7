"""Re-integration of a nearly exact plan by Newton's method, which corrects the states of the plan.

The defects of the plan in its own dynamics, integrated over the samples of its fine grid and over further samples
between them, drive the linear equation of its error (Ascher, Mattheij, Russell 1995, chapter 8). All intervals are
treated at once. The corrected plan is sampled again until the correction is negligible. No step depends on the one
before, so that this takes a fraction of the time of an integration. There is no result if the quadrature misses the
tolerance of the integration, for example for a force pulse between two points, or if the corrections do not decrease.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from ocp.audit.linearisation import Linearisation, quadrature
from ocp.audit.sizes import plan_at
from ocp.console import check_time
from ocp.curves import lagrange


@dataclass(frozen=True)
class IntegrationSettings:
    """Accuracy of the re-integration of a plan, and limits of its computational effort.

    Attributes:
        tolerance: Error over one grid cell (interval of the fine grid), relative to the size of each state.
        rounding: Rounding error, relative to the value of a state.
        corrections: Largest number of corrections.
        remainder: Largest remaining correction, relative to the sizes: ten times the tolerance.
        contraction: Largest ratio of successive corrections.
        order: Order of the error of a step in its width.
        splits: Largest number of parts that a step is split into at once: the error of an unstable step does not tell
            its width.
        rounds: Largest number of rounds of splitting.
        steps: Largest number of simultaneous steps. Stiffer or chattering dynamics count as a breakdown within seconds.
        block: Number of steps in one call of the step function.
        blocks: Number of calls between two checks of the time limit.
        inline: Number of instructions of the dynamics up to which a step is one function of scalar symbols.
        growth: Factor between the deviation and the sum of the defects above which the dynamics are unstable.
    """

    tolerance: float = 1e-11
    rounding: float = 4 * float(np.finfo(float).eps)
    corrections: int = 5
    remainder: float = 1e-10
    contraction: float = 0.1
    order: int = 5
    splits: int = 4
    rounds: int = 40
    steps: int = 300_000
    block: int = 512
    blocks: int = 8
    inline: int = 1000
    growth: float = 10.0


SETTINGS = IntegrationSettings()
INNER = np.array([0.46, 0.53, 0.44, 0.55, 0.48])
"""Positions of the samples inside five successive grid cells, as fractions of the cell. They are uneven, so that
oscillations in phase with the grid show. One polynomial integrates five cells; an interval has a multiple of five."""
POINTS = np.append(np.ravel([np.arange(5), np.arange(5) + INNER], "F") / 5, 1.0)
"""Positions of all samples of five successive grid cells, as fractions of their total length."""
LENGTH = len(POINTS[1:])
RULE, ROUGH = (quadrature(POINTS, POINTS[1:], degree).T for degree in (LENGTH, LENGTH - 2))
"""Quadrature weights from 0 to each later position in POINTS, and such weights of a lower degree. The difference of
both estimates the error."""


class IntegratedMotion(NamedTuple):
    """States and running cost that follow from the controls of a plan, on the fine grid of the plan.

    Attributes:
        local: States integrated over each interval from the plan's own state at its start. Shape (N, cells + 1, nx).
        states: States integrated over the whole horizon. Shape (N, cells + 1, nx).
        local_cost, cost: Integrals of the running cost along ``local`` and ``states``.
    """

    local: np.ndarray
    states: np.ndarray
    local_cost: float
    cost: float


def corrected_motion(along: Linearisation) -> IntegratedMotion | None:
    """Return the motion under the controls of a plan, by Newton corrections of the states; None without convergence."""
    if not along.finite:
        return None
    newton = _Newton(along)
    if (continuous := newton.converged(True)) is None:
        return None
    states, cost, rate = continuous
    if (by_interval := newton.converged(False, rate)) is None:
        return None
    local, local_cost, _ = by_interval
    return IntegratedMotion(local[:, ::2], states[:, ::2], local_cost, cost)


class _Newton:
    """Newton's method that corrects the states of a plan, on the plan's fine grid, until they satisfy the dynamics."""

    def __init__(self, along: Linearisation) -> None:
        self.along, form, grid = along, along.form, along.grid
        (n, q), nx, cells = along.shape, form.nx, grid.samples - 1
        self.width = along.width[:, None, None]
        panels = cells // len(INNER)
        places = np.append(np.add.outer(np.arange(panels), POINTS[:-1]).ravel() / panels, 1.0)
        inner = plan_at(along.solution, places[1::2])
        self.x, self.u, self.t = (
            _interleave(part.reshape(n, cells + 1, size), between.reshape(n, cells, size))
            for part, between, size in zip((grid.states, grid.controls, grid.t), inner, (nx, form.nu, 1), strict=True)
        )
        self.unit = np.append(along.sizes.state, along.sizes.cost)
        self.largest = np.hstack([np.abs(grid.states.reshape(n, cells + 1, nx)).max(axis=1), np.zeros((n, 1))])

        self.rule, self.doubt = RULE / panels, (RULE - ROUGH) / panels
        panel_of = np.minimum((along.places * panels).astype(int), panels - 1)
        self.at_gauss = np.zeros((q, 2 * cells + 1))
        for row, panel, place in zip(self.at_gauss, panel_of, along.places, strict=True):
            row[LENGTH * panel :][: LENGTH + 1] = lagrange(POINTS, np.array([place * panels - panel]))[0]
        self.rising = quadrature(along.places, places)

        self.feed = along.width[:, None, None, None] * along.rate_y[:, :, :nx].reshape(n, q, nx, nx)
        by_sample = lagrange(along.places, places) @ self.feed.reshape(n, q, nx * nx)
        self.feed_at_samples = by_sample.reshape(n, 2 * cells + 1, nx, nx)
        system = np.einsum("ij,kjab->kiajb", along.matrix, self.feed).reshape(n, q * nx, q * nx)
        self.inverse = np.linalg.inv(np.eye(q * nx) - system)
        self.carried = (self.inverse @ np.tile(np.eye(nx), (q, 1))).reshape(n, q, nx, nx)
        self.transition = np.eye(nx) + (along.weight[:, None, None] * (self.feed @ self.carried)).sum(axis=1)
        self.first = self._integral(self.x)

    def _integral(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Integrate state rates and running cost at given states ``x`` from the start of each interval to all samples.

        Also return the error of the states that arises inside each interval. Shapes (N, 2 cells + 1, nx + 1), (N,
        2 cells + 1, nx). None if the quadrature error exceeds the tolerance.
        """
        check_time()
        form, (n, samples) = self.along.form, x.shape[:2]
        states, controls, t = (part.reshape(n * samples, part.shape[2]) for part in (x, self.u, self.t))
        point = states, controls, t, self.along.solution.horizon, self.along.p
        (flow,) = form.sampled(lambda: [ca.vertcat(form.f, form.running)], *point, cache_as="flow")
        flow = flow.reshape(n, samples, -1) * (self.width * self.along.solution.horizon)
        panels = _panels(flow)
        doubt = np.abs(panels @ self.doubt).max(axis=1).reshape(n, -1, flow.shape[2]).max(axis=1)
        allowed = len(INNER) * SETTINGS.tolerance * self.unit + SETTINGS.rounding * self.largest
        if not (doubt <= allowed).all():
            return None
        integral = self._cumulative(panels, flow.shape)
        return integral, self._own_error(integral, x)

    def _cumulative(self, panels: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Integrate sampled rates, arranged by ``_panels``, from the start of each interval to every sample.

        ``shape`` is that of the rates and of the result, (N, 2 cells + 1, m).
        """
        n, samples, m = shape
        parts = (panels @ self.rule).reshape(n, -1, m, LENGTH).transpose(0, 1, 3, 2)
        parts[:, 1:] += np.cumsum(parts[:, :-1, -1], axis=1)[:, :, None]
        integral = np.zeros(shape)
        integral[:, 1:] = parts.reshape(n, samples - 1, m)
        return integral

    def converged(self, chained: bool, rate: float = 1.0) -> tuple[np.ndarray, float, float] | None:
        """Return corrected states, their running cost, and the ratio of successive corrections; None if these diverge.

        With `chained`, one motion starts from the plan's first state, otherwise a separate one in every interval. The
        ratio `rate` is that of an earlier call.
        """
        nx, x, current, last = self.along.form.nx, self.x, self.first, np.inf
        for _ in range(SETTINGS.corrections):
            if current is None:
                break
            integral, error = current
            change = error + self._propagate(error[:, -1], x) if chained else error
            size = float(np.abs(change).reshape(-1, nx).max(axis=0) @ (1 / self.unit[:nx]))
            if not size < SETTINGS.contraction * last:
                break
            rate = size / last if np.isfinite(last) else rate
            x = x + change
            if rate * size <= SETTINGS.remainder:
                return x, float(integral[:, -1, nx].sum()) + self._cost_change(change), rate
            current, last = self._integral(x), size
        return None

    def _cost_change(self, change: np.ndarray) -> float:
        """Return the first-order change of the running cost for a change of the states."""
        along, (n, q) = self.along, self.along.shape
        slope = along.cost_y[:, : along.form.nx].reshape(n, q, -1)
        return float(np.einsum("k,j,kji,kji->", along.width, along.weight, slope, self.at_gauss @ change))

    def _own_error(self, integral: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return the first-order error of states ``x`` that arises inside each interval, not in earlier intervals."""
        (n, q), nx = self.along.shape, self.along.form.nx
        defect = integral[..., :nx] - (x - x[:, :1])
        at_gauss = self.at_gauss @ defect
        drive = np.einsum("ij,kjab,kjb->kia", self.along.matrix, self.feed, at_gauss)
        response = at_gauss + (self.inverse @ drive.reshape(n, q * nx, 1)).reshape(n, q, nx)
        error = defect + self.rising @ np.einsum("kjab,kjb->kja", self.feed, response)
        # oscillations between the Gauss points feed the error too
        fed = np.einsum("kjab,kjb->kja", self.feed_at_samples, error)
        return np.asarray(defect + self._cumulative(_panels(fed), fed.shape))

    def _propagate(self, ends: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Propagate errors ``ends`` (N, nx) of intervals, and jumps of ``x`` between these, by linearised dynamics."""
        start = np.zeros(ends.shape)
        jumps = ends[:-1] + x[:-1, -1] - x[1:, 0]
        for k in range(len(jumps)):
            start[k + 1] = self.transition[k] @ start[k] + jumps[k]
        source = np.einsum("kjab,kjb->kja", self.feed, (self.carried @ start[:, None, :, None])[..., 0])
        return np.asarray(start[:, None] + self.rising @ source)


def _panels(values: np.ndarray) -> np.ndarray:
    """Arrange samples (N, 2 cells + 1, m) in groups of five grid cells for quadrature. Shape (N m cells / 5, 11)."""
    windows = np.lib.stride_tricks.sliding_window_view(values, LENGTH + 1, axis=1)
    return windows[:, ::LENGTH].reshape(-1, LENGTH + 1)


def _interleave(ends: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Interleave values at the ends of grid cells (N, cells + 1, n) with values inside the cells (N, cells, n)."""
    values = np.empty((len(ends), ends.shape[1] + inside.shape[1], ends.shape[2]))
    values[:, ::2], values[:, 1::2] = ends, inside
    return values
