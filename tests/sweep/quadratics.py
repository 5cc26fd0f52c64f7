"""Indefinite linear-quadratic problems, their extremals in closed form, and whether these are minima.

x' = A x + B u, the cost int x'Qx/2 + x'Su + u'Ru/2 + x(T)'Fx(T)/2. Extremals follow (x, lambda)' = M (x, lambda) with
a constant Hamiltonian matrix M. One is a minimum if and only if no point of (0, T) or its start is conjugate to the end
(Jacobi): no solution that obeys the end conditions vanishes there. How many are is counted by the argument of the
Lagrangian frame that those solutions span (Arnold 1967; Morse's index theorem), which no double zero escapes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import expm

from ocp import Problem, Solution
from tests.ocp.audit.drawn import random_program
from tests.ocp.problems import Array

__all__ = ["KINDS", "Quadratic", "random_quadratic"]

KINDS = ("unbounded", "bounds inside", "held at a bound", "bounds met")
STEPS = 500  # of the frame over the horizon
NEAR = 0.04  # share of the horizon: a conjugate point nearer to its start than this is too near to be told


@dataclass(frozen=True)
class Quadratic:
    """A random problem.

    Attributes:
        a, b, q, s, r, f: Of dynamics and cost. fixed: Whether the end is given, at zero. start: Shape (n,).
        horizon: s. bound: Of every control, or inf.
        push: Of a further control that its bound holds at 1, on the states, (n,), or None. pull: What holds it there.
    """

    a: Array
    b: Array
    q: Array
    s: Array
    r: Array
    f: Array
    fixed: bool
    start: Array
    horizon: float
    bound: float
    push: Array | None
    pull: float

    @property
    def matrix(self) -> Array:
        """M: d(x, lambda)/dt along extremals whose controls are free, and a constant column where one is held."""
        back = np.linalg.solve(self.r, np.hstack([self.s.T, self.b.T]))
        n = len(self.a)
        feed, gain = back[:, :n], back[:, n:]
        drift = self.a - self.b @ feed
        return np.block([[drift, -self.b @ gain], [-(self.q - self.s @ feed), -drift.T]])

    def conjugate_points(self, until: float) -> int:
        """How many points of (T - until, T) are conjugate to the end, with multiplicity."""
        n = len(self.a)
        step = expm(-self.matrix * until / STEPS)
        frame = np.vstack([np.zeros((n, n)), np.eye(n)] if self.fixed else [np.eye(n), self.f])
        first, total, before = np.zeros(n), 0.0, np.eye(n, dtype=complex)
        for k in range(STEPS + 1):
            x, y = frame[:n], frame[n:]
            unitary = (y + 1j * x) @ np.linalg.inv(y - 1j * x)
            if k:
                total += float(np.angle(np.linalg.det(unitary @ before.conj().T)))
            elif not self.fixed:
                first = np.angle(np.linalg.eigvals(unitary)) % (2 * np.pi)
            before = unitary
            if k < STEPS:
                frame = np.linalg.qr(step @ frame)[0]
        last = np.angle(np.linalg.eigvals(before)) % (2 * np.pi)
        return round((float(np.sum(first)) + total - float(np.sum(last))) / (2 * np.pi))

    def longest_minimum(self, most: float) -> float:
        """The horizon up to which extremals are minima, s, by bisection; ``most`` where it is longer."""
        low, high = 0.0, most
        if self.conjugate_points(high) == 0:
            return most
        for _ in range(12):
            middle = (low + high) / 2
            low, high = (middle, high) if self.conjugate_points(middle) == 0 else (low, middle)
        return low

    def problem(self) -> Problem:
        n, m = self.b.shape
        problem = Problem("quadratic")
        x = problem.state("x", n, initial=self.start, terminal=np.zeros(n) if self.fixed else None, guess=0.0)
        limits: dict[str, Any] = {} if self.bound == np.inf else {"lower": -self.bound, "upper": self.bound}
        u = problem.control("u", m, guess=0.0, **limits)
        rate = ca.mtimes(self.a, x) + ca.mtimes(self.b, u)
        running = (
            ca.bilin(ca.DM(self.q), x, x) / 2 + ca.bilin(ca.DM(self.r), u, u) / 2 + ca.dot(x, ca.mtimes(self.s, u))
        )
        if self.push is not None:
            w = problem.control("w", lower=-1.0, upper=1.0, guess=0.9)
            rate, running = rate + ca.DM(self.push) * w, running - self.pull * w + w**2 / 2
        problem.dynamics(x, rate)
        problem.horizon(self.horizon)
        problem.minimize(running, ca.bilin(ca.DM(self.f), x, x) / 2)
        return problem

    def extremal(self) -> tuple[Any, Any]:
        """(states and costates of time (M,) -> (M, 2 n), their greatest size), by the matrix exponential."""
        n = len(self.a)
        whole = np.zeros((2 * n + 1, 2 * n + 1))
        whole[: 2 * n, : 2 * n] = self.matrix
        if self.push is not None:
            whole[:n, -1] = self.push
        over = expm(whole * self.horizon)
        target = np.zeros(n)
        ends = over[:n] if self.fixed else over[n : 2 * n] - self.f @ over[:n]
        known = ends[:, :n] @ self.start + ends[:, -1]
        first = np.concatenate([self.start, np.linalg.solve(ends[:, n : 2 * n], target - known), [1.0]])

        def along(t: Array) -> Array:
            return np.array([expm(whole * time) @ first for time in t])[:, : 2 * n]

        return along, float(np.abs(along(np.linspace(0, self.horizon, 101))).max())

    def plan(self, problem: Problem) -> Solution:
        """The extremal as a plan drawn by hand."""
        n = len(self.a)
        along, _ = self.extremal()

        def controls(t: Array) -> Array:
            x, lam = np.split(along(t), [n], axis=1)
            return np.asarray(-np.linalg.solve(self.r, self.s.T @ x.T + self.b.T @ lam.T).T)

        held = {} if self.push is None else {"w": 1.0}
        states, costates = {"x": lambda t: along(t)[:, :n]}, {"x": lambda t: along(t)[:, n:]}
        return random_program(problem, states, {"u": controls, **held}, costates, self.horizon, 40)


def random_quadratic(seed: int) -> tuple[Quadratic, bool, str]:
    """A problem of a seed, whether its extremal is a minimum, and of which kind it is.

    Drawn again until the verdict is the same for horizons a little shorter and longer, and the extremal is of ordinary
    size (near a conjugate point it is not).
    """
    rng = np.random.default_rng([20, seed])
    kind, fixed, minimum = KINDS[seed % 4], bool(seed // 4 % 2), bool(seed // 8 % 2)
    while True:
        n, m = int(rng.integers(1, 5)), int(rng.integers(1, 3))
        q, f, r = rng.normal(size=(n, n)), rng.normal(size=(n, n)), rng.normal(size=(m, m))
        instance = Quadratic(
            a=rng.normal(size=(n, n)),
            b=rng.normal(size=(n, m)),
            q=float(rng.uniform(0.5, 6.0)) * (q + q.T) / 2,
            s=0.3 * rng.normal(size=(n, m)),
            r=r @ r.T + 0.3 * np.eye(m),
            f=(f + f.T) / 2,
            fixed=fixed,
            start=np.zeros(n) if rng.random() < 0.3 else rng.normal(size=n),
            horizon=float(rng.uniform(0.3, 3.0)),
            bound=np.inf,
            push=rng.normal(size=n) if kind == "held at a bound" else None,
            pull=0.0,
        )
        if not controllable(instance) or np.linalg.eigvalsh(instance.q)[0] > 0:
            continue
        if seed // 16 % 2:  # near the first horizon at which it is no minimum any more
            first = instance.longest_minimum(4.0)
            if not 0.3 < first < 3.0:
                continue
            share = rng.uniform(2 * NEAR, 0.2)
            instance = replace(instance, horizon=first * (1 - share if minimum else 1 + share))
        counts = [instance.conjugate_points(instance.horizon)]
        if (counts[0] == 0) is not minimum:
            continue
        counts += [instance.conjugate_points(instance.horizon * (1 + share)) for share in (-NEAR, NEAR)]
        if len(set(counts)) > 1:
            continue
        along, size = instance.extremal()
        if size > 30:
            continue
        if kind == "held at a bound":  # pulled at so that it stays there
            costates = along(np.linspace(0, instance.horizon, 201))[:, n:]
            pull = 2.0 + 1.2 * float(np.abs(costates @ instance.push).max())
            instance = replace(instance, pull=pull)
        if kind == "bounds inside":
            path = along(np.linspace(0, instance.horizon, 201))
            u = np.linalg.solve(instance.r, instance.s.T @ path[:, :n].T + instance.b.T @ path[:, n:].T)
            instance = replace(instance, bound=1.5 * float(np.abs(u).max()) or 1.0)
        if kind == "bounds met":
            path = along(np.linspace(0, instance.horizon, 201))
            u = np.linalg.solve(instance.r, instance.s.T @ path[:, :n].T + instance.b.T @ path[:, n:].T)
            if not np.abs(u).max() > 0.1:
                continue
            instance = replace(instance, bound=0.8 * float(np.abs(u).max()))
        return instance, minimum, kind


def controllable(problem: Quadratic) -> bool:
    """Whether the controls reach every state, clearly."""
    n = len(problem.a)
    powers = [problem.b]
    for _ in range(n - 1):
        powers.append(problem.a @ powers[-1])
    sizes = np.linalg.svd(np.hstack(powers), compute_uv=False)
    return bool(sizes[n - 1] > 0.05 * sizes[0])


def least_curvature(problem: Quadratic, plan: Solution, segments: int = 160) -> float:
    """Least curvature of the cost over controls that are held on equal pieces, where the plan is inside its bounds.

    Dense and independent: exact steps of the linear system, the cost by Simpson's rule, ends that are given taken out
    by a singular value decomposition. Relative to the least curvature in the controls alone.
    """
    n, m = problem.b.shape
    step = problem.horizon / segments
    whole = np.zeros((n + m, n + m))
    whole[:n, :n], whole[:n, n:] = problem.a, problem.b
    half, full = expm(whole * step / 2), expm(whole * step)
    middle_times = (np.arange(segments) + 0.5) / segments
    values = plan.at_fraction(middle_times)["u"]
    edges = [plan.at_fraction(np.clip(middle_times + shift / segments, 0, 1))["u"] for shift in (-0.45, 0.45)]
    inside = np.all([np.abs(v) < problem.bound * (1 - 1e-4) for v in (values, *edges)], axis=0)
    cost = np.zeros((segments * m, segments * m))
    reach = np.zeros((n, segments * m))
    for k in range(segments):
        own = np.zeros((m, segments * m))
        own[:, k * m : (k + 1) * m] = np.eye(m)
        middle, after = half[:n, :n] @ reach + half[:n, n:] @ own, full[:n, :n] @ reach + full[:n, n:] @ own
        for share, x in ((1, reach), (4, middle), (1, after)):
            mixed = x.T @ problem.s @ own
            cost += step * share / 6 * (x.T @ problem.q @ x + mixed + mixed.T + own.T @ problem.r @ own)
        reach = after
    free = np.flatnonzero(inside.ravel())
    if not problem.fixed:
        cost += reach.T @ problem.f @ reach
    cost, reach = cost[np.ix_(free, free)], reach[:, free]
    if problem.fixed:
        if len(free) <= n:
            return float("inf")
        _, sizes, right = np.linalg.svd(reach)
        basis = right[int((sizes > 1e-8 * sizes[0]).sum()) :].T
        cost = basis.T @ cost @ basis
    if not len(cost):
        return float("inf")
    return float(np.linalg.eigvalsh(cost)[0] / step / np.linalg.eigvalsh(problem.r)[0])
