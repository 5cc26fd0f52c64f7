"""Kim, Kim 2011 as printed: recursive Algorithms 1-4 and the costate equation, in numpy with loops.

An independent oracle of what the package gets by automatic differentiation, and the thing that it beats: nothing here
is symbolic, and every derivative is the paper's own. Symbols, signs and the numbering from 1 (0 is the inertial frame,
E the end effector) are the paper's. Eight of the printed equations, (21), (22), (37), (38), (39), (43), (51) and the
boundary value (35), do not hold as printed; what stands here is corrected and says so.

Motion and momentum vectors are (angular, linear) in inertial axes: the twist of the end effector is its angular
velocity and the velocity of its origin, momenta are taken about the inertial origin. x = (x1, x2) are the coordinates
of a VirtualChain, lam = (lambda1, lambda2) the costates, shape (N,) both. `rows` are the rows of the twist that the
task fixes (angular 0..2, linear 3..5) and `tip_velocity` is v_E in them, shape (m,), rad/s and m/s.

A costate rate takes about 13 ms for a spatial base with seven joints, the compiled AD form 4 us.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from models.errors import ModelError
from models.machine import checked_rows
from models.parts import Array, ArrayInput, checked_array
from models.virtual_chain import VirtualChain, motion_cross, transforms

__all__ = [
    "D",
    "J",
    "Partials",
    "Resolution",
    "VirtualChain",
    "costate_rate",
    "dD",
    "dJ",
    "generalized_jacobian",
    "hamiltonian",
    "optimal_control",
    "partials",
    "resolution",
    "state_rate",
]

ONE = np.eye(6)
ZERO = np.zeros((6, 6))
SINGULAR = 1e-12
"""Ratio of least to greatest singular value below which a matrix is refused as singular."""


class _Momentum(NamedTuple):
    """What Algorithm 1 leaves to Algorithm 3. Entry i belongs to link i, entry 0 to the inertial frame."""

    X: list[Array]  # iX_{i-1}
    A: list[Array]  # iX_0^T
    B: list[Array]  # inertia of the links from i on, in frame i
    D: Array  # (6, N)


class _Tip(NamedTuple):
    """What Algorithm 2 leaves to Algorithm 4. Entry i belongs to link i, entry 0 to the inertial frame."""

    X: list[Array]
    U: list[Array]  # iX_0
    C: list[Array]  # EX_i
    R: Array  # ER_0
    r: Array  # [r_E x], inertial axes
    R_dot: list[Array]  # dER_0/dq_i
    v: list[Array]  # [v_E,i x], inertial axes
    J: Array  # (6, N)


def D(chain: VirtualChain, q: ArrayInput) -> Array:
    """Momentum (moment about the inertial origin, linear) per unit rate of each joint, (7). Shape (6, N).

    Algorithm 1. ModelError when q is not of shape (N,).
    """
    return _algorithm_1(chain, q).D


def J(chain: VirtualChain, q: ArrayInput) -> Array:
    """End-effector Jacobian, twist of the tip per unit rate of each joint, base and arm independent. Shape (6, N).

    Algorithm 2, with (20)-(22) corrected. ModelError when q is not of shape (N,).
    """
    return _algorithm_2(chain, q).J


def dD(chain: VirtualChain, q: ArrayInput) -> Array:
    """Partials of D: entry [k, :, i] is dD_i/dq_k, counted from 0. Shape (N, 6, N).

    Algorithm 3, with (43) corrected. ModelError when q is not of shape (N,).
    """
    computed = _algorithm_1(chain, q)
    return np.array([_algorithm_3(chain, computed, k) for k in range(1, chain.N + 1)])


def dJ(chain: VirtualChain, q: ArrayInput) -> Array:
    """Partials of J: entry [k, :, i] is dJ_i/dq_k, counted from 0. Shape (N, 6, N).

    Algorithm 4, with (51) corrected. ModelError when q is not of shape (N,).
    """
    computed = _algorithm_2(chain, q)
    return np.array([_algorithm_4(chain, computed, k) for k in range(1, chain.N + 1)])


def _algorithm_1(chain: VirtualChain, q: ArrayInput) -> _Momentum:
    N, S, H = chain.N, _numbered(chain.S), _numbered(chain.H)
    X = _numbered(transforms(chain, q))
    A, B, columns = [ONE], [ZERO] * (N + 1), [np.zeros(6)] * (N + 1)  # (8)
    for i in range(1, N + 1):
        A.append(A[i - 1] @ X[i].T)  # (9)
    for i in range(N, 0, -1):
        B[i] = H[i] if i == N else H[i] + X[i + 1].T @ B[i + 1] @ X[i + 1]  # (10)
        columns[i] = A[i] @ B[i] @ S[i]  # (11)
    return _Momentum(X, A, B, np.column_stack(columns[1:]))


def _algorithm_2(chain: VirtualChain, q: ArrayInput) -> _Tip:
    N, S = chain.N, _numbered(chain.S)
    X = _numbered(transforms(chain, q))
    U = [ONE]  # (16)
    for i in range(1, N + 1):
        U.append(X[i] @ U[i - 1])  # (17)
    U_E = chain.X_tip @ U[N]  # (18)
    R = U_E[:3, :3]
    r = -R.T @ U_E[3:, :3]
    C, R_dot, v = [ZERO] * (N + 1), [ZERO] * (N + 1), [ZERO] * (N + 1)
    columns = [np.zeros(6)] * (N + 1)
    for i in range(N, 0, -1):
        C[i] = chain.X_tip if i == N else C[i + 1] @ X[i + 1]  # (19)
        Y = -C[i] @ motion_cross(S[i]) @ U[i]  # (20)
        R_dot[i] = Y[:3, :3]
        omega = -R.T @ R_dot[i]  # (21), corrected: inertial axes
        v[i] = -R.T @ (Y[3:, :3] + R_dot[i] @ r)  # (22), with v_E,i taken out of (20)
        columns[i] = np.concatenate([_vector(omega), _vector(v[i])])  # (23)
    return _Tip(X, U, C, R, r, R_dot, v, np.column_stack(columns[1:]))


def _algorithm_3(chain: VirtualChain, computed: _Momentum, k: int) -> Array:
    """dD/dq_k, k from 1. Shape (6, N)."""
    N, S = chain.N, _numbered(chain.S)
    X, A, B, _ = computed
    X_ = [ZERO] * (N + 1)  # an underscore is the paper's tilde, the partial by q_k
    X_[k] = -motion_cross(S[k]) @ X[k]  # (41)
    A_, B_, columns = [ZERO], [ZERO] * (N + 1), [np.zeros(6)] * (N + 1)  # (40)
    for i in range(1, N + 1):
        A_.append(A_[i - 1] @ X[i].T + A[i - 1] @ X_[i].T)  # (42)
    for i in range(N, 0, -1):
        if i < N:
            j = i + 1
            # (43), the third term corrected: X^T B X~
            B_[i] = X_[j].T @ B[j] @ X[j] + X[j].T @ B_[j] @ X[j] + X[j].T @ B[j] @ X_[j]
        columns[i] = (A_[i] @ B[i] + A[i] @ B_[i]) @ S[i]  # (44)
    return np.column_stack(columns[1:])


def _algorithm_4(chain: VirtualChain, computed: _Tip, k: int) -> Array:
    """dJ/dq_k, k from 1. Shape (6, N)."""
    N, S = chain.N, _numbered(chain.S)
    X, U, C, R, r, R_dot, v, _ = computed
    X_ = [ZERO] * (N + 1)
    X_[k] = -motion_cross(S[k]) @ X[k]  # (46)
    U_ = [ZERO]  # (45)
    for i in range(1, N + 1):
        U_.append(X_[i] @ U[i - 1] + X[i] @ U_[i - 1])  # (47)
    U_E = chain.X_tip @ U_[N]  # (48)
    R_ = U_E[:3, :3]
    r_ = -R.T @ (U_E[3:, :3] + R_ @ r)
    C_, columns = [ZERO] * (N + 1), [np.zeros(6)] * (N + 1)
    for i in range(N, 0, -1):
        if i < N:
            C_[i] = C_[i + 1] @ X[i + 1] + C[i + 1] @ X_[i + 1]  # (49)
        cross = motion_cross(S[i])
        Y = -C_[i] @ cross @ U[i] - C[i] @ cross @ U_[i]  # (50)
        R_hat, zeta = Y[:3, :3], Y[3:, :3]
        omega = -(R_.T @ R_dot[i] + R.T @ R_hat)  # (51), corrected as (21)
        v_ = -R.T @ (zeta + R_hat @ r + R_dot[i] @ r_ + R_ @ v[i])  # (52), from (54)
        columns[i] = np.concatenate([_vector(omega), _vector(v_)])  # (53)
    return np.column_stack(columns[1:])


class Resolution(NamedTuple):
    """The redundancy resolved at one x. n base coordinates, n2 = N - n joints, m task rows.

    Attributes:
        E1: Momentum by base rates (24). Shape (n, n).
        E2: Momentum by joint rates (24). Shape (n, n2).
        F1: Task velocity by base rates (25). Shape (m, n).
        F2: Task velocity by joint rates (25). Shape (m, n2).
        reaction: E1^-1 E2. Shape (n, n2).
        G: Generalized Jacobian (25). Shape (m, n2).
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
    F = J(chain, x)
    return F[:, chain.n :] - F[:, : chain.n] @ _reaction(chain, x, D(chain, x))


def resolution(chain: VirtualChain, x: ArrayInput, tip_velocity: ArrayInput, rows: Sequence[int]) -> Resolution:
    """E1, E2, F1, F2, G, G#, Gamma and Phi of (24)-(26).

    Raises:
        ModelError: Wrong shapes or rows; E1 singular (the base's Euler angle b is +-pi/2) or G of too low a rank.
    """
    rows = checked_rows(rows)
    v_E = checked_array(tip_velocity, (len(rows),), "recursion", "tip_velocity")
    momentum = D(chain, x)
    F = J(chain, x)[rows]
    n = chain.n
    reaction = _reaction(chain, x, momentum)
    G = F[:, n:] - F[:, :n] @ reaction
    singular_values = np.linalg.svd(G, compute_uv=False)
    if len(rows) > G.shape[1] or singular_values[-1] <= SINGULAR * singular_values[0]:
        raise ModelError(
            f"the task of rows {rows} is singular at x = {np.asarray(x).tolist()}: G has the singular values "
            f"{singular_values.tolist()} for {G.shape[1]} joints; fix fewer rows or move away"
        )
    G_pinv = G.T @ np.linalg.inv(G @ G.T)
    E = momentum[chain.momentum_rows]
    return Resolution(
        E[:, :n], E[:, n:], F[:, :n], F[:, n:], reaction, G, G_pinv, np.eye(G.shape[1]) - G_pinv @ G, G_pinv @ v_E
    )


def optimal_control(chain: VirtualChain, x: ArrayInput, lam: ArrayInput) -> Array:
    """u* = E2^T E1^-T lambda1 - lambda2 (31), which minimises the Hamiltonian whatever the task. Shape (N - n,).

    Raises:
        ModelError: Wrong shapes; E1 singular, which is where the base's Euler angle b is +-pi/2.
    """
    lam = checked_array(lam, (chain.N,), "recursion", "lam")
    return _control(_reaction(chain, x, D(chain, x)), lam)


def state_rate(
    chain: VirtualChain, x: ArrayInput, lam: ArrayInput, tip_velocity: ArrayInput, rows: Sequence[int]
) -> Array:
    """x' = (-E1^-1 E2 x2', x2') with x2' = Gamma u* + Phi, (34). Shape (N,). Raises as `resolution`."""
    lam = checked_array(lam, (chain.N,), "recursion", "lam")
    at = resolution(chain, x, tip_velocity, rows)
    joint_rates = at.Gamma @ _control(at.reaction, lam) + at.Phi
    return np.concatenate([-at.reaction @ joint_rates, joint_rates])


def hamiltonian(
    chain: VirtualChain, x: ArrayInput, lam: ArrayInput, tip_velocity: ArrayInput, rows: Sequence[int]
) -> float:
    """H* (32), the least of 1/2 |x2'|^2 + lam . x' over all joint rates that do the task. Raises as `resolution`."""
    lam = checked_array(lam, (chain.N,), "recursion", "lam")
    at = resolution(chain, x, tip_velocity, rows)
    u = _control(at.reaction, lam)
    return float(-u @ at.Gamma @ u / 2 + at.Phi @ at.Phi / 2 - u @ at.Phi)


def partials(
    chain: VirtualChain, x: ArrayInput, lam: ArrayInput, tip_velocity: ArrayInput, rows: Sequence[int]
) -> Partials:
    """Partials (36)-(39), of which (37)-(39) are corrected. Raises as `resolution`."""
    return _partials(chain, x, lam, tip_velocity, rows)[1]


def costate_rate(
    chain: VirtualChain, x: ArrayInput, lam: ArrayInput, tip_velocity: ArrayInput, rows: Sequence[int]
) -> Array:
    """lam' = -dH*/dx (33), lam and x independent. Shape (N,). Raises as `resolution`.

    With a free end state the boundary value is lam(t_f) = 0; the paper's (35) asks no less of the motion and leaves the
    part J^T mu of lam(t_f), which no motion depends on, undetermined.
    """
    at, by = _partials(chain, x, lam, tip_velocity, rows)
    u = _control(at.reaction, np.asarray(lam, dtype=float))
    joint_rates = at.Gamma @ u + at.Phi
    return np.array(
        [
            joint_rates @ by.u[j] + u @ by.Gamma[j] @ u / 2 + (u - at.Phi) @ by.Phi[j]  # (33)
            for j in range(chain.N)
        ]
    )


def _partials(
    chain: VirtualChain, x: ArrayInput, lam: ArrayInput, tip_velocity: ArrayInput, rows: Sequence[int]
) -> tuple[Resolution, Partials]:
    lam = checked_array(lam, (chain.N,), "recursion", "lam")
    at = resolution(chain, x, tip_velocity, rows)
    v_E, n = np.asarray(tip_velocity, dtype=float), chain.n
    E_x, F_x = dD(chain, x)[:, chain.momentum_rows], dJ(chain, x)[:, list(rows)]
    E1_inverse, GG_inverse = np.linalg.inv(at.E1), np.linalg.inv(at.G @ at.G.T)
    u, Phi, Gamma, G = [], [], [], []
    for j in range(chain.N):
        E1_x, E2_x, F1_x, F2_x = E_x[j, :, :n], E_x[j, :, n:], F_x[j, :, :n], F_x[j, :, n:]
        reaction_x = E1_inverse @ (E2_x - E1_x @ at.reaction)
        G_x = F2_x - F1_x @ at.reaction - at.F1 @ reaction_x  # (39), corrected: F1, not F2, in the last two terms
        GG_x = G_x @ at.G.T + at.G @ G_x.T
        u.append(reaction_x.T @ lam[:n])  # (36)
        Phi.append((G_x.T @ GG_inverse - at.G_pinv @ GG_x @ GG_inverse) @ v_E)  # (37), corrected bracket
        Gamma.append(-G_x.T @ at.G_pinv.T + at.G_pinv @ (GG_x @ at.G_pinv.T - G_x))  # (38), corrected
        G.append(G_x)
    return at, Partials(np.array(u), np.array(Phi), np.array(Gamma), np.array(G))


def _reaction(chain: VirtualChain, x: ArrayInput, momentum: Array) -> Array:
    """E1^-1 E2 of (24), from D. Shape (n, N - n)."""
    E = momentum[chain.momentum_rows]
    E1 = E[:, : chain.n]
    singular_values = np.linalg.svd(E1, compute_uv=False)
    if singular_values[-1] <= SINGULAR * singular_values[0]:
        raise ModelError(
            f"E1 is singular at base coordinates {np.asarray(x)[: chain.n].tolist()}: the fifth of six, an Euler angle, "
            "is +-pi/2, or the machine lacks inertia; describe the base in other axes"
        )
    reaction: Array = np.linalg.solve(E1, E[:, chain.n :])
    return reaction


def _control(reaction: Array, lam: Array) -> Array:
    n = len(reaction)
    return reaction.T @ lam[:n] - lam[n:]


def _numbered(arrays: Array) -> list[Array]:
    """Arrays of links 1..N under their numbers; entry 0, the inertial frame's, is zero."""
    return [np.zeros(arrays.shape[1:]), *arrays]


def _vector(matrix: Array) -> Array:
    """a of a matrix [a x]. Shape (3,)."""
    return np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2
