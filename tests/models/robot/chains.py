"""Serial free-floating arms and their virtual chains, by automatic differentiation of link frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from models import FreeFloating, Joint, Link, Robot, link_frames, paper_example, tip_pose
from models.robot.parts import Kind
from models.spatial import rotation
from scripts.papers.free_floating.costates import generalized_jacobian
from scripts.papers.free_floating.virtual_chain import VirtualChain
from tests.models.robot.trees import (
    Array,
    Base,
    momentum_by_differentiation,
    numeric,
    random_inertia,
    random_rotation,
    twist_by_differentiation,
)

TOLERANCE = 1e-12
CLEARLY = 0.05
"""Relative error above which a formula is wrong, not inaccurate."""


def error(result: Any, expected: Any) -> float:
    """Greatest difference relative to the greatest entry expected."""
    result, expected = np.asarray(result), np.asarray(expected)
    assert result.shape == expected.shape
    return float(np.abs(result - expected).max() / np.abs(expected).max())


def serial_robot(rng: np.random.Generator, size: int, base: Base = "spatial") -> Robot:
    """Serial arm of `size` moving joints with fixed links between and beside them."""
    links, joints = [Link("base", 20.0, rng.normal(scale=0.2, size=3), random_inertia(rng, 40.0))], list[Joint]()

    def attach(name: str, kind: Kind, parent: str) -> None:
        mass = float(rng.uniform(0.5, 3.0))
        links.append(Link(name, mass, rng.normal(scale=0.3, size=3), random_inertia(rng, mass)))
        turn = random_rotation(rng)
        axis = rng.normal(size=3)
        if base == "planar":
            turn = Rotation.from_euler("z", rng.uniform(-3, 3)).as_matrix()
            axis = np.array([*rng.normal(size=2), 0.0] if kind == "prismatic" else [0.0, 0.0, rng.choice([-1.0, 1.0])])
        joints.append(Joint(f"to {name}", kind, parent, name, rng.normal(scale=0.6, size=3), turn, axis))

    attach("panel", "fixed", "base")
    above = "base"
    kinds: tuple[Kind, ...] = ("revolute", "continuous", "revolute", "prismatic")
    for i in range(size):
        if i % 3 == 1:
            attach(f"bracket{i}", "fixed", above)
            above = f"bracket{i}"
        attach(f"link{i}", kinds[i % 4], above)
        above = f"link{i}"
    attach("camera", "fixed", above)
    attach("tool", "fixed", above)
    turn = Rotation.from_euler("z", 0.4).as_matrix() if base == "planar" else random_rotation(rng)
    return Robot(tuple(links), tuple(joints), "tool", rng.normal(scale=0.3, size=3), turn)


@dataclass(frozen=True)
class Case:
    """A machine, its chain, a task, a point, and the symbolic truth by automatic differentiation of frames.

    `truth(x)` gives D, J, dD, dJ, the tip's R = ER_0 and r_E, and the partials of R and of -R [r_E x]; `principle(x,
    lam, v)` what the minimum principle makes of D and J, and `derivatives(x, lam, v)` the derivatives of that.
    """

    machine: FreeFloating
    chain: VirtualChain
    rows: list[int]
    x: Array
    lam: Array
    v: Array
    truth: Any
    principle: Any
    derivatives: Any

    @property
    def task(self) -> tuple[VirtualChain, Array, Array, Array, list[int]]:
        return self.chain, self.x, self.lam, self.v, self.rows


def by_index(jacobian: Any, shape: tuple[int, int]) -> Array:
    """Jacobian of a column-major matrix as partials with the variable's index first. Shape (N, *shape)."""
    return numeric(jacobian).T.reshape(-1, shape[1], shape[0]).transpose(0, 2, 1)


def placement(machine: FreeFloating, x1: Any) -> Any:
    """Frame of the base at the coordinates of the virtual joints."""
    if machine.base == "planar":
        return machine.world_from_base(x1)
    turn = ca.mtimes([rotation(axis, x1[3 + i]) for i, axis in enumerate(np.eye(3).tolist())])
    return turn, x1[0:3]


def make_case(machine: FreeFloating, rows: list[int], rng: np.random.Generator) -> Case:
    """Case at a random point where the task's Jacobian has a condition number below 20."""
    chain = VirtualChain.from_machine(machine)
    N, n = chain.N, chain.n
    size = N - n

    q, dq = ca.SX.sym("q", N), ca.SX.sym("dq", N)
    base = placement(machine, q[:n])
    frames, tip = link_frames(machine.robot, q[n:], base), tip_pose(machine.robot, q[n:], base)
    momentum = ca.cse(ca.jacobian(ca.cse(momentum_by_differentiation(machine.robot, frames, q, dq)), dq))
    jacobian = ca.jacobian(twist_by_differentiation(tip.rotation, tip.position, q, dq), dq)
    R, r = ca.densify(tip.rotation.T), ca.densify(tip.position)
    lower = -ca.mtimes(R, ca.skew(r))
    outputs = [momentum, jacobian, ca.jacobian(momentum, q), ca.jacobian(jacobian, q), R, r]
    outputs += [ca.jacobian(R, q), ca.jacobian(ca.jacobian(R, q), q), ca.jacobian(lower, q)]
    truth = ca.Function("truth", [q], [ca.densify(output) for output in outputs])
    matrices = ca.Function("matrices", [q], [ca.densify(momentum), ca.densify(jacobian)])

    xs, lam, v, u = ca.MX.sym("x", N), ca.MX.sym("lam", N), ca.MX.sym("v", len(rows)), ca.MX.sym("u", size)
    E, F = matrices(xs)
    E, F = E[chain.momentum_rows, :], F[rows, :]
    drift = -ca.solve(E[:, :n], E[:, n:])
    G = F[:, n:] + ca.mtimes(F[:, :n], drift)
    G_pinv = ca.solve(ca.mtimes(G, G.T), G).T
    Phi, Gamma = ca.mtimes(G_pinv, v), ca.MX.eye(size) - ca.mtimes(G_pinv, G)
    # The least of 1/2 |r|^2 + lam . x'(r) with G r = v, by its own optimality system: no u*, no projector.
    weight = lam[n:] + ca.mtimes(drift.T, lam[:n])
    system = ca.vertcat(ca.horzcat(ca.MX.eye(size), G.T), ca.horzcat(G, ca.MX(len(rows), len(rows))))
    rates = ca.solve(system, ca.vertcat(-weight, v))[:size]
    least = ca.dot(rates, rates) / 2 + ca.dot(weight, rates)
    options = ca.mtimes(Gamma, u) + Phi
    at_control = ca.dot(options, options) / 2 + ca.dot(weight, options)
    principle = ca.Function("principle", [xs, lam, v], [least, -weight, G, Gamma, Phi, rates])
    derivatives = ca.Function(
        "derivatives",
        [xs, lam, v, u],
        [-ca.gradient(least, xs), -ca.gradient(at_control, xs), ca.gradient(least, lam)]
        + [ca.jacobian(ca.vec(part), xs) for part in (-weight, Phi, Gamma, G)],
    )

    condition, point = np.inf, np.zeros(N)
    while condition > 20:
        point = np.concatenate([rng.normal(size=n), rng.uniform(-2, 2, size=size)])
        point[min(n - 1, 4)] *= 0.5  # keep clear of the Euler angle at pi/2
        condition = float(np.linalg.cond(generalized_jacobian(chain, point)[rows]))
    velocity = rng.normal(size=len(rows))
    return Case(machine, chain, rows, point, rng.normal(size=N), velocity, truth, principle, derivatives)


@cache
def spatial_case(size: int) -> Case:
    """6 + size joints; the task leaves at least one joint free, and all six rows when it can."""
    rng = np.random.default_rng(100 + size)
    rows = [3, 5] if size == 3 else [0, 4, 5] if size < 7 else list(range(6))
    return make_case(FreeFloating(serial_robot(rng, size)), rows, rng)


@cache
def planar_case(size: int) -> Case:
    rng = np.random.default_rng(200 + size)
    machine = FreeFloating(serial_robot(rng, size, "planar"), "planar")
    return make_case(machine, [3, 4] if size < 5 else [4, 2, 3], rng)


@cache
def example() -> Case:
    """The paper's own example at its start."""
    case = make_case(paper_example(), [3, 4], np.random.default_rng(0))
    return replace(case, x=np.deg2rad([0.0, 0.0, 0.0, 45.0, 60.0, -60.0]), v=np.array([-1.0, -1.0]))


SPATIAL = [pytest.param(spatial_case, size, id=f"6+{size}") for size in range(3, 11)]
PLANAR = [pytest.param(planar_case, size, id=f"3+{size}") for size in (3, 5)]
EXAMPLE = [pytest.param(lambda _: example(), 0, id="example")]
every_case = pytest.mark.parametrize(("build", "size"), SPATIAL + PLANAR + EXAMPLE)
