"""Does the control found for an extremal make the Hamiltonian least? First and second order, and at its bounds.

Newton's method makes the Hamiltonian stationary and switches where told; a maximum, a saddle or a wrong order of
bang-bang arcs solves these equations as well. Bryson, Ho 1975, section 3.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ocp.indirect.hamiltonian import Hamiltonian
from ocp.indirect.sensitivity import Extremal
from ocp.problem.formulation import Bounds
from ocp.tolerances import FLAT_SHARE, ROUNDING_SHARE, SOLVER_SHARE

__all__ = ["not_least"]


def not_least(ham: Hamiltonian, path: Extremal, p: np.ndarray, bounds: Bounds) -> str:
    """What keeps the controls of an extremal from making the Hamiltonian least, or "".

    Each sample must be stationary in the free controls, push those at a bound outwards, and not curve downwards.
    """
    form = ham.form
    if not form.nu:
        return ""
    u = path.controls.reshape(-1, form.nu)
    index = form.bounds.places["control"]
    low, high = bounds[0][index], bounds[1][index]
    with np.errstate(invalid="ignore"):
        width = np.where(np.isfinite(high - low), high - low, 1.0)
    at_low, at_high = u <= low + ROUNDING_SHARE * width, u >= high - ROUNDING_SHARE * width
    slope, parts, curvature, rows, by_control = samples(ham, path, p)
    if not all(np.all(np.isfinite(v)) for v in (slope, curvature, rows)):
        return "the Hamiltonian is not finite along the plan"

    wrong = np.where(at_low, np.maximum(-slope, 0.0), np.where(at_high, np.maximum(slope, 0.0), np.abs(slope)))
    # all parts may vanish at the optimum; then the slope is judged by what a change of the control's own size makes
    scale = float(np.max(parts)) + float(np.max(np.abs(curvature))) * max(ROUNDING_SHARE, float(np.max(np.abs(u))))
    wrong = np.where(at_low & at_high, 0.0, wrong) / max(scale, np.finfo(float).tiny)
    k, i = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
    if wrong[k, i] > SOLVER_SHARE:
        label, time = form.control_labels[i], path.t.ravel()[k]
        if i in ham.linear:
            return (
                f"control {label!r} is at the wrong bound at {time:.4g} s: the Hamiltonian would be less at the other; "
                "its switches are not those of the seed, or it has a singular arc or chatters; seed it more finely or "
                "use a direct method with held controls"
            )
        return f"the Hamiltonian is not least in control {label!r} at {time:.4g} s"
    if len(form.path) and np.max(np.abs(rows)) > SOLVER_SHARE * max(1.0, float(np.max(np.abs(u)))):
        return "the path equalities are not met"
    free = ~(at_low | at_high)
    for k in np.flatnonzero(free.any(axis=1)):
        inside = curvature[k][np.ix_(free[k], free[k])]
        tangent = null_space(by_control[k][:, free[k]])
        least = np.min(np.linalg.eigvalsh(tangent.T @ inside @ tangent), initial=0.0)
        # Newton leaves an extremal rounding alone: it is known better than a plan, of which FLAT_SHARE is said
        if least < -0.1 * FLAT_SHARE * np.max(np.abs(curvature[k])):
            names = ", ".join(
                repr(label) for label, is_free in zip(form.control_labels, free[k], strict=True) if is_free
            )
            return f"the Hamiltonian is stationary but not least in control {names} at {path.t.ravel()[k]:.4g} s"
    return ""


def samples(ham: Hamiltonian, path: Extremal, p: np.ndarray) -> list[np.ndarray]:
    """At K samples: dH/du and the sum of sizes of its parts (K, nu), d2H/du2 (K, nu, nu), path (K, m), its Jacobian."""
    form = ham.form
    by_control = ca.jacobian(ham.rows, form.u)
    parts = ca.fabs(ca.gradient(form.running, form.u)) + ca.mtimes(
        ca.fabs(ca.jacobian(form.f, form.u)).T, ca.fabs(ham.lam)
    )
    hessian, slope = ca.hessian(ham.value, form.u)
    outputs = [slope, parts, hessian, ham.rows, by_control]
    first, size, second, rows, jacobian = path.sampled(ham, outputs, p)
    count = path.t.size
    square = second.reshape(count, form.nu, form.nu)
    return [first, size, square, rows, jacobian.reshape(count, form.nu, len(form.path)).transpose(0, 2, 1)]


def null_space(rows: np.ndarray) -> Any:
    """Orthonormal directions (n, k) that ``rows`` (m, n) do not see."""
    if rows.shape[0] == 0:
        return np.eye(rows.shape[1])
    _, sizes, directions = np.linalg.svd(rows)
    rank = int(np.sum(sizes > 1e-12 * max(1.0, float(np.max(sizes, initial=0.0)))))
    return directions[rank:].T
