"""Kim, Kim 2011, Algorithms 1-4: momentum, end-effector Jacobian and their partials by recursion over the links.

In plain numpy with loops, as printed: an independent oracle of what the package gets by automatic differentiation, and
the thing that it beats. Symbols, signs and the numbering from 1 (0 is the inertial frame, E the end effector) are the
paper's. Equations (20)-(22), (43) and (51) do not hold as printed; what stands here is corrected and says so.

Motion and momentum vectors are (angular, linear) in inertial axes: the twist of the end effector is its angular
velocity and the velocity of its origin, momenta are taken about the inertial origin. q are all N coordinates of a
VirtualChain, those of the base first: what scripts.papers.free_floating.costates calls x.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from models.checks import Array, ArrayInput
from scripts.papers.free_floating.virtual_chain import VirtualChain, motion_cross, transforms

ONE = np.eye(6)
ZERO = np.zeros((6, 6))


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


def _numbered(arrays: Array) -> list[Array]:
    """Arrays of links 1..N under their numbers; entry 0, the inertial frame's, is zero."""
    return [np.zeros(arrays.shape[1:]), *arrays]


def _vector(matrix: Array) -> Array:
    """a of a matrix [a x]. Shape (3,)."""
    return np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2
