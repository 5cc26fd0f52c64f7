"""Linear quadratic regulators with random matrices, constant or varying in time.

x' = A(t) x + B(t) u from x0, 2 s, end free, least 1/2 x(T)' F x(T) + int 1/2 (x' Q x + 2 x' S u + u' R u) dt. The
optimal cost from (t, x) is x' P(t) x / 2, with P from the Riccati equation integrated backwards from F; the costate
is P x and u = -R^-1 (B' P + S') x. Bryson & Ho, Applied Optimal Control, 1975, section 5.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp import Problem

from .case import Array, Case, Extremal, Run, legendre, radau, shooting, within
from .flow import flow

HORIZON = 2.0
N, M = 4, 2


@dataclass(frozen=True)
class Regulator:
    """A stable pair and its weights; `swing` of A and of B oscillates.

    Attributes:
        a, b: Shapes (N, N), (N, M).
        q, s, r, f: Weights. Shapes (N, N), (N, M), (M, M), (N, N).
        x0: Start. Shape (N,).
        swing: Share of A and B that varies with time.
        runs: Methods and the errors they are entitled to.
    """

    a: Array
    b: Array
    q: Array
    s: Array
    r: Array
    f: Array
    x0: Array
    swing: float
    runs: tuple[Run, ...]

    def share(self, t: Any) -> Any:
        return 1 + self.swing * ca.sin(3 * t)

    def gain(self, t: float, p: Array) -> Array:
        return np.asarray(np.linalg.solve(self.r, (self.share(t) * self.b).T @ p + self.s.T))

    def build(self) -> Problem:
        problem = Problem("quadratic regulator")
        x = problem.state("x", initial=self.x0)
        u = problem.control("u", M)
        problem.horizon(HORIZON)
        problem.dynamics(x, self.share(problem.time) * (ca.DM(self.a) @ x + ca.DM(self.b) @ u))
        q, s, r, f = (ca.DM(weight) for weight in (self.q, self.s, self.r, self.f))
        running = x.T @ q @ x / 2 + x.T @ s @ u + u.T @ r @ u / 2
        problem.minimize(running=running, terminal=x.T @ f @ x / 2)
        return problem

    def case(self, name: str) -> Case:
        def riccati(t: float, y: Array) -> Array:
            p, a = y.reshape(N, N), self.share(t) * self.a
            k = self.gain(t, p)
            return np.asarray(-(a.T @ p + p @ a + self.q - k.T @ self.r @ k)).ravel()

        cost_to_go = flow(riccati, self.f.ravel(), (HORIZON, 0.0))

        def closed_loop(t: float, x: Array) -> Array:
            p = cost_to_go(np.array(t)).reshape(N, N)
            return np.asarray(self.share(t) * (self.a @ x - self.b @ (self.gain(t, p) @ x)))

        trajectory = flow(closed_loop, self.x0, (0.0, HORIZON))

        def optimum(t: Array) -> Extremal:
            x = trajectory(t).T
            p = cost_to_go(t).T.reshape(-1, N, N)
            u = np.array([-self.gain(ti, pi) @ xi for ti, pi, xi in zip(t, p, x, strict=True)])
            return Extremal(state={"x": x}, control={"u": u}, costate={"x": np.einsum("kij,kj->ki", p, x)})

        cost = float(self.x0 @ cost_to_go(np.array(0.0)).reshape(N, N) @ self.x0) / 2
        return Case(name, self.build, cost, self.runs, HORIZON, optimum)


def draw(seed: int, swing: float, runs: tuple[Run, ...]) -> Regulator:
    """A regulator drawn from a seed: A is shifted to be stable, the weights are positive definite."""
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((N, N))
    a -= (np.linalg.eigvals(a).real.max() + 0.5) * np.eye(N)
    root = rng.standard_normal((N + M, N + M))
    weight = root @ root.T / (N + M) + 0.1 * np.eye(N + M)
    end = rng.standard_normal((N, N))
    b = rng.standard_normal((N, M))
    q, s, r, f = weight[:N, :N], weight[:N, N:], weight[N:, N:], end @ end.T / N
    return Regulator(a, b, q, s, r, f, rng.standard_normal(N), swing, runs)


CONSTANT = (
    *within(radau(30, degree=5), cost=(1e-12, 1e-12), state=1e-9, control=1e-7, costate=2e-8),
    *within(legendre(30, degree=4), cost=(1e-12, 1e-12), state=6e-8, control=4e-6, costate=1e-8),
    *within(shooting(50, "linear"), cost=(1e-9, 7e-6), state=2e-5, control=6e-3, costate=8e-6),
    *within(shooting(50, "held"), cost=(1e-9, 7e-4), state=8e-4, control=0.2, costate=8e-4),
)
VARYING = (
    *within(radau(30, degree=5), cost=(1e-12, 1e-12), state=2e-8, control=2e-6, costate=6e-8),
    *within(legendre(30, degree=4), cost=(1e-12, 1e-12), state=2e-7, control=3e-5, costate=6e-8),
    *within(shooting(50, "linear"), cost=(1e-9, 2e-5), state=5e-5, control=1e-2, costate=2e-5),
    *within(shooting(50, "held"), cost=(1e-9, 2e-3), state=5e-3, control=0.5, costate=2e-3),
)

CASES = (
    *(draw(seed, 0.0, CONSTANT).case(f"quadratic regulator, seed {seed}") for seed in range(3)),
    draw(3, 0.5, VARYING).case("quadratic regulator, varying in time"),
)
