"""Kim, Kim 2011, equations (24)-(39): the minimum principle of a free-floating arm, from the recursive Algorithms 1-4.

In plain numpy, every derivative the paper's own: the oracle and the opponent of the costate equation that the package
gets by automatic differentiation. Equations (37)-(39) and the boundary value (35) do not hold, or not well, as printed;
what stands here is corrected and says so.

x = (x1, x2) are the coordinates of a VirtualChain, lam = (lambda1, lambda2) the costates d(least cost)/dx; shape (N,)
both. `rows` are the rows of the tip's twist that the task fixes (angular 0..2, linear 3..5, inertial axes), and
`tip_velocity` is v_E in them, shape (m,), rad/s and m/s.

A costate rate takes about 12 ms for a spatial base with seven joints; automatic differentiation, compiled, takes 4 us.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from models import ModelError
from models.checks import Array, ArrayInput, require
from models.robot.kinematics import checked_rows
from scripts.papers.free_floating.recursion import D, J, dD, dJ
from scripts.papers.free_floating.virtual_chain import VirtualChain

WORST_CONDITION = 1e14
"""Condition number above which a matrix counts as singular."""


class Resolution(NamedTuple):
    """The redundancy resolved at one x. n base coordinates, n2 = N - n joints, m task rows.

    Attributes:
        E1: Momentum by base rates (24). Shape (n, n).
        E2: Momentum by joint rates (24). Shape (n, n2).
        F1: Task velocity by base rates (25). Shape (m, n).
        F2: Task velocity by joint rates (25). Shape (m, n2).
        reaction: E1^-1 E2. Shape (n, n2).
        G: Generalized Jacobian of the task (25). Shape (m, n2).
        G_pinv: G# = G^T (G G^T)^-1. Shape (n2, m).
        Gamma: 1 - G# G (26). Shape (n2, n2).
        Phi: G# v_E (26). Shape (n2,).
    """

    E1: Array
    E2: Array
    F1: Array
    F2: Array
    reaction: Array
    G: Array
    G_pinv: Array
    Gamma: Array
    Phi: Array

    def control(self, lam: Array) -> Array:
        """u* (31) of the costates. Shape (n2,)."""
        n = len(self.E1)
        control: Array = self.reaction.T @ lam[:n] - lam[n:]
        return control


class Partials(NamedTuple):
    """Partials by the N coordinates x, the first index, of what the Hamiltonian (32) is made of.

    Attributes:
        u: Of u* (36). Shape (N, n2).
        Phi: (37). Shape (N, n2).
        Gamma: (38). Shape (N, n2, n2).
        G: (39). Shape (N, m, n2).
    """

    u: Array
    Phi: Array
    Gamma: Array
    G: Array


def generalized_jacobian(chain: VirtualChain, x: ArrayInput) -> Array:
    """Generalized Jacobian G = F2 - F1 E1^-1 E2 (25), joint rates to the twist of the tip. Shape (6, N - n).

    Raises:
        ModelError: x of a wrong shape; E1 singular, which is where the base's Euler angle b is +-pi/2.
    """
    _, _, reaction = _base_reaction(chain, x)
    F = J(chain, x)
    jacobian: Array = F[:, chain.n :] - F[:, : chain.n] @ reaction
    return jacobian


def resolution(chain: VirtualChain, x: ArrayInput, tip_velocity: ArrayInput, rows: Sequence[int]) -> Resolution:
    """E1, E2, F1, F2, G, G#, Gamma and Phi of (24)-(26).

    Raises:
        ModelError: Wrong shapes or rows; E1 singular (the base's Euler angle b is +-pi/2); G of too low a rank.
    """
    rows = checked_rows(rows)
    v_E = require.array("tip: tip_velocity", tip_velocity, (len(rows),))
    E1, E2, reaction = _base_reaction(chain, x)
    F = J(chain, x)[rows]
    F1, F2 = F[:, : chain.n], F[:, chain.n :]
    G = F2 - F1 @ reaction
    GG = G @ G.T
    if np.linalg.cond(GG) > WORST_CONDITION:
        raise ModelError(
            f"the task of rows {rows} is singular at x = {np.asarray(x).tolist()}: G has the singular values "
            f"{np.linalg.svd(G, compute_uv=False).tolist()}; fix fewer rows or start elsewhere"
        )
    G_pinv = G.T @ np.linalg.inv(GG)
    return Resolution(E1, E2, F1, F2, reaction, G, G_pinv, np.eye(G.shape[1]) - G_pinv @ G, G_pinv @ v_E)


def optimal_control(chain: VirtualChain, x: ArrayInput, lam: ArrayInput) -> Array:
    """u* = E2^T E1^-T lambda1 - lambda2 (31), which minimises the Hamiltonian whatever the task. Shape (N - n,).

    Raises:
        ModelError: Wrong shapes; E1 singular, which is where the base's Euler angle b is +-pi/2.
    """
    lam = _checked_costates(chain, lam)
    _, _, reaction = _base_reaction(chain, x)
    control: Array = reaction.T @ lam[: chain.n] - lam[chain.n :]
    return control


def state_rate(
    chain: VirtualChain, x: ArrayInput, lam: ArrayInput, tip_velocity: ArrayInput, rows: Sequence[int]
) -> Array:
    """x' = (-E1^-1 E2 x2', x2') with x2' = Gamma u* + Phi, (34). Shape (N,). Raises as `resolution`."""
    at = resolution(chain, x, tip_velocity, rows)
    joint_rates = at.Gamma @ at.control(_checked_costates(chain, lam)) + at.Phi
    return np.concatenate([-at.reaction @ joint_rates, joint_rates])


def hamiltonian(
    chain: VirtualChain, x: ArrayInput, lam: ArrayInput, tip_velocity: ArrayInput, rows: Sequence[int]
) -> float:
    """H* (32), the least of 1/2 |x2'|^2 + lam . x' over all joint rates that do the task. Raises as `resolution`."""
    at = resolution(chain, x, tip_velocity, rows)
    u = at.control(_checked_costates(chain, lam))
    return float(-u @ at.Gamma @ u / 2 + at.Phi @ at.Phi / 2 - u @ at.Phi)


def partials(
    chain: VirtualChain, x: ArrayInput, lam: ArrayInput, tip_velocity: ArrayInput, rows: Sequence[int]
) -> Partials:
    """Partials (36)-(39), of which (37)-(39) are corrected. Raises as `resolution`."""
    lam = _checked_costates(chain, lam)
    return _partials(chain, x, lam, tip_velocity, rows, resolution(chain, x, tip_velocity, rows))


def costate_rate(
    chain: VirtualChain, x: ArrayInput, lam: ArrayInput, tip_velocity: ArrayInput, rows: Sequence[int]
) -> Array:
    """lam' = -dH*/dx (33), x and lam taken as independent. Shape (N,). Raises as `resolution`.

    When the end of the motion is free but for the task, lam(t_f) = 0. The paper's (35) also admits every
    lam(t_f) = [F1 F2]^T mu. Where the task fixes all or none of the angular rows, or the machine is planar, these
    change no motion, but leave the boundary value problem without an isolated solution; where it fixes some of the
    angular rows they do change the motion, and (35) is not a condition of optimality.
    """
    lam = _checked_costates(chain, lam)
    at = resolution(chain, x, tip_velocity, rows)
    by = _partials(chain, x, lam, tip_velocity, rows, at)
    u = at.control(lam)
    joint_rates = at.Gamma @ u + at.Phi
    rate = np.empty(chain.N)
    for j in range(chain.N):
        rate[j] = joint_rates @ by.u[j] + u @ by.Gamma[j] @ u / 2 + (u - at.Phi) @ by.Phi[j]  # (33)
    return rate


def _partials(
    chain: VirtualChain, x: ArrayInput, lam: Array, tip_velocity: ArrayInput, rows: Sequence[int], at: Resolution
) -> Partials:
    v_E, n = np.asarray(tip_velocity, dtype=float), chain.n
    E_x, F_x = dD(chain, x)[:, chain.momentum_rows], dJ(chain, x)[:, list(rows)]
    E1_inverse, GG_inverse = np.linalg.inv(at.E1), np.linalg.inv(at.G @ at.G.T)
    u, Phi, Gamma, G = [], [], [], []
    for j in range(chain.N):
        E1_x, E2_x, F1_x, F2_x = E_x[j, :, :n], E_x[j, :, n:], F_x[j, :, :n], F_x[j, :, n:]
        reaction_x = -E1_inverse @ E1_x @ at.reaction + E1_inverse @ E2_x
        G_x = F2_x - F1_x @ at.reaction - at.F1 @ reaction_x  # (39), corrected: F1, not F2, before E1^-1
        GG_x = G_x @ at.G.T + at.G @ G_x.T
        u.append(reaction_x.T @ lam[:n])  # (36)
        Phi.append((G_x.T @ GG_inverse - at.G_pinv @ GG_x @ GG_inverse) @ v_E)  # (37), corrected bracket
        Gamma.append(-G_x.T @ at.G_pinv.T + at.G_pinv @ (GG_x @ at.G_pinv.T - G_x))  # (38), corrected
        G.append(G_x)
    return Partials(np.array(u), np.array(Phi), np.array(Gamma), np.array(G))


def _base_reaction(chain: VirtualChain, x: ArrayInput) -> tuple[Array, Array, Array]:
    """E1, E2 of (24) and E1^-1 E2."""
    E = D(chain, x)[chain.momentum_rows]
    E1, E2 = E[:, : chain.n], E[:, chain.n :]
    if np.linalg.cond(E1) > WORST_CONDITION:
        raise ModelError(
            f"E1 is singular at the base coordinates {np.asarray(x)[: chain.n].tolist()}: the fifth of six is an Euler "
            "angle at +-pi/2, or the machine lacks inertia; turn the inertial axes"
        )
    reaction: Array = np.linalg.solve(E1, E2).astype(float)
    return E1, E2, reaction


def _checked_costates(chain: VirtualChain, lam: ArrayInput) -> Array:
    return require.array("costates: lam", lam, (chain.N,))
