"""The two iterations of the paper (Lee, Lee 2017): Newton on the roll (Table 4) and the null-space method (Table 3).

They are here to be compared with: Newton ends at whatever stationary point is near, a maximum more often than not, and
the null-space step is a gradient step of fixed length, stable only while gain n6^2 I'' < 2, n being the unit vector of
the null space. `cts_optimal` has neither fault.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models import ModelError, Rig, Tunnel
from models.checks import Array, ArrayInput, require
from models.cts.rig import HOME, INCH, Branch, forward, inverse, task_jacobian
from models.cts.roll import checked_gain, index_harmonics
from models.cts.table import checked_targets
from models.spatial import Expression, solve_spd

TOLERANCE, MOST_STEPS = 1e-6, 100  # Table 5


@dataclass(frozen=True, eq=False)
class Run:
    """A sequence of targets, each solved from the result of the one before.

    Attributes:
        joints: Shape (samples, 6), m and rad; nan where the iteration left the numbers.
        iterations: Shape (samples,).
        converged: Whether the last step was below the tolerance. Shape (samples,).
    """

    joints: Array
    iterations: Array
    converged: Array


def index(rig: Rig, tunnel: Tunnel, target: Expression, roll: Expression, previous: Expression, gain: float) -> Any:
    """I2 of (38) with k = w4 / (2 pi) = gain; I1 of (36) for gain 0. Shape (1, 1)."""
    return index_harmonics(rig, tunnel, target).value(ca.cos(roll), ca.sin(roll)) + gain * (roll - previous) ** 2


def newton_step(rig: Rig, tunnel: Tunnel, rate_weight: float = 0.0) -> Any:
    """Function (target, roll, previous) -> (next roll, I', I''), (43)."""
    gain = checked_gain(rate_weight)
    target, roll, previous = ca.SX.sym("target", 5), ca.SX.sym("roll"), ca.SX.sym("previous")
    cost = index(rig, tunnel, target, roll, previous, gain)
    slope = ca.gradient(cost, roll)
    bend = ca.gradient(slope, roll)
    names = ["target", "roll", "previous"], ["next", "slope", "bend"]
    return ca.Function("newton_step", [target, roll, previous], [roll - slope / bend, slope, bend], *names)


def null_space_step(rig: Rig, tunnel: Tunnel, rate_weight: float = 0.0, gain: float = 1.0, unit: float = INCH) -> Any:
    """Function (target, joints, previous roll) -> (next joints, n6^2 I''): one pass of Table 3, (42).

    The Jacobian is the 5x6 one of the target; the null-space term descends the index of roll alone, times `gain`. The
    second output times `gain` must stay below 2 for the iteration to converge.

    The pseudo-inverse weighs a length against an angle, so that the iteration depends on the unit of joint 1: `unit`,
    m, is the length that counts as much as a radian. The paper's is the inch.
    """
    k = checked_gain(rate_weight)
    if not (np.isfinite(gain) and gain > 0):
        raise ModelError(f"gain {gain} of the null-space term must be positive and finite")
    target, q, previous = ca.SX.sym("target", 5), ca.SX.sym("q", 6), ca.SX.sym("previous")
    if not (np.isfinite(unit) and unit > 0):
        raise ModelError(f"unit {unit} m must be positive and finite")
    units = ca.DM([unit, 1, 1, 1, 1, 1])
    jacobian = ca.mtimes(task_jacobian(rig, q), ca.diag(units))
    cost = index(rig, tunnel, target, q[5], previous, k)
    slope = ca.gradient(cost, q[5])
    error = target - forward(rig, q)[:5]
    descent = ca.vertcat(ca.SX.zeros(5), -gain * slope)
    # J+ dx + (1 - J+ J) d = d + J+ (dx - J d), with J+ = J' (J J')^-1
    step = descent + ca.mtimes(
        jacobian.T, solve_spd(ca.mtimes(jacobian, jacobian.T), error - ca.mtimes(jacobian, descent))
    )
    unit = ca.vertcat(ca.SX.zeros(5), 1)
    share = 1 - ca.mtimes(jacobian.T, solve_spd(ca.mtimes(jacobian, jacobian.T), ca.mtimes(jacobian, unit)))[5]
    names = ["target", "joints", "previous"], ["next", "stiffness"]
    outputs = [q + units * step, share * ca.gradient(slope, q[5])]
    return ca.Function("null_space_step", [target, q, previous], outputs, *names)


def combined(
    rig: Rig,
    tunnel: Tunnel,
    targets: ArrayInput,
    *,
    rate_weight: float = 0.0,
    start_roll: float = 0.0,
    branch: Branch = HOME,
) -> Run:
    """Table 4 over a sequence of targets: Newton on the roll, then the closed form for the other joints.

    Args:
        targets: Shape (samples, 5).
        start_roll: Roll before the first target, rad.

    Raises:
        ModelError: Targets of another shape or not finite.
    """
    rows = checked_targets(targets)
    step = newton_step(rig, tunnel, rate_weight)
    x, r = ca.SX.sym("target", 5), ca.SX.sym("roll")
    close = ca.Function("close", [x, r], list(inverse(rig, x, r, branch)))

    def joints_of(target: Array, roll: float) -> Array:
        result, reach = close(target, roll)
        return np.array(result).ravel() if float(ca.mmin(reach)) >= 0 else np.full(6, np.nan)

    return _iterated(
        rows,
        start_roll,
        lambda target, roll, previous: float(step(target, roll, previous)[0]),
        lambda moved: abs(moved) < TOLERANCE,
        lambda roll: not np.isfinite(roll),
        joints_of,
    )


def null_space(
    rig: Rig,
    tunnel: Tunnel,
    targets: ArrayInput,
    start: ArrayInput,
    *,
    rate_weight: float = 0.0,
    gain: float = 1.0,
    unit: float = INCH,
) -> Run:
    """Table 3 over a sequence of targets, from the joints `start`, shape (6,), at the first.

    The iteration ends when no joint moves by 1e-6, joint 1 counted in `unit` (m). Where a joint passes 10^6 it has
    diverged, and the next target starts from the last sound joints.

    Raises:
        ModelError: Targets or start of another shape or not finite, a gain that is not positive.
    """
    rows = checked_targets(targets)
    step = null_space_step(rig, tunnel, rate_weight, gain, unit)
    units = np.array([unit, 1, 1, 1, 1, 1])
    return _iterated(
        rows,
        np.array(require.array("null_space: start", start, (6,))),
        lambda target, q, before: np.array(step(target, q, before[5])[0]).ravel(),
        lambda moved: (np.abs(moved) / units).max() < TOLERANCE,
        lambda q: not np.abs(q).max() < 1e6,
        lambda target, q: q,
    )


def _iterated(
    rows: Array,
    start: Any,
    step: Callable[[Array, Any, Any], Any],
    small: Callable[[Any], bool],
    diverged: Callable[[Any], bool],
    joints_of: Callable[[Array, Any], Array],
) -> Run:
    """Steps (target, state, state before this target) -> state, from the last sound state, until one is small."""
    joints, counts, done = np.full((len(rows), 6), np.nan), np.zeros(len(rows)), np.zeros(len(rows), dtype=bool)
    state = start
    for i, target in enumerate(rows):
        before = state
        for count in range(1, MOST_STEPS + 1):
            last, state = state, step(target, state, before)
            counts[i] = count
            done[i] = small(state - last)
            if done[i] or diverged(state):
                break
        if diverged(state):
            state = before
        else:
            joints[i] = joints_of(target, state)
    return Run(joints, counts, done)
