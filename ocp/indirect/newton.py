"""Newton's method for boundary value problems: sparse, damped, interruptible."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.console import listening, quiet, reason_to_stop
from ocp.errors import ProblemError
from ocp.status import SolverStatus

__all__ = ["Found", "newton"]


@dataclass(frozen=True)
class NewtonSettings:
    """When Newton's method gives up.

    Attributes:
        steps: The most steps. halvings: Of a step, before it counts as none.
        descent: Share of the fall that a step of this length promises which it must bring (Armijo's rule).
    """

    steps: int = 40
    halvings: int = 12
    descent: float = 1e-4


@dataclass(frozen=True)
class Found:
    """Where Newton's method ended."""

    unknowns: np.ndarray
    residual: float
    steps: int
    status: SolverStatus
    message: str

    @property
    def success(self) -> bool:
        """Whether it converged, and no check refused what it found."""
        return self.status.is_success


def newton(
    system: tuple[Any, ...],
    start: np.ndarray,
    data: np.ndarray,
    scale: float,
    tolerance: float,
    settings: NewtonSettings = NewtonSettings(),
) -> Found:
    """Damped Newton's method on a sparse system; the step is halved until the residual falls."""
    residual, jacobian = system

    def evaluate(z: np.ndarray) -> np.ndarray:
        try:
            with quiet():
                return np.asarray(residual(z, data).full()).reshape(-1)
        except RuntimeError:  # the integration broke down: as bad as can be
            return np.full(z.size, np.inf)

    z, value = start, evaluate(start)
    if value.size != start.size:
        words = f"the boundary value problem has {value.size} conditions for {start.size} unknowns"
        raise ProblemError(words, name="conditions", value=value.size, limit=start.size)
    polished, stopped = False, None
    with listening():
        for steps in range(settings.steps + 1):
            size = float(np.max(np.abs(value), initial=0.0))
            if not np.isfinite(size):
                return Found(z, size, steps, SolverStatus.NOT_FINITE, "the integration broke down at the seed")
            if size <= tolerance * scale and polished:
                return Found(z, size, steps, SolverStatus.SOLVED, f"Converged in {steps} Newton steps")
            polished = size <= tolerance * scale  # one more step: it costs little and gains digits
            stopped = reason_to_stop()
            if stopped or steps == settings.steps:
                break
            try:
                with quiet():
                    slopes = jacobian(z, data)
            except RuntimeError:
                status = SolverStatus.SOLVED if polished else SolverStatus.NOT_FINITE
                return Found(z, size, steps, status, "the integration of the sensitivities broke down")
            try:
                step = np.asarray(ca.solve(slopes, ca.DM(-value), "qr").full()).reshape(-1)
            except RuntimeError:
                step = np.full(z.size, np.nan)
            if not np.all(np.isfinite(step)):
                word = "Newton's matrix is singular: the plan is not determined"
                if polished:
                    return Found(z, size, steps, SolverStatus.SOLVED, f"Converged in {steps} Newton steps; {word}")
                return Found(z, size, steps, SolverStatus.STEP_FAILED, word)
            length = 1.0
            for _ in range(settings.halvings):
                trial = z + length * step
                new = evaluate(trial)
                if np.linalg.norm(new) < (1.0 - settings.descent * length) * np.linalg.norm(value) or polished:
                    break
                length *= 0.5
            else:
                words = "no step along Newton's direction makes the residual smaller"
                return Found(z, size, steps, SolverStatus.STEP_FAILED, words)
            if polished and np.max(np.abs(new)) > size:
                return Found(z, size, steps, SolverStatus.SOLVED, f"Converged in {steps} Newton steps")
            z, value = trial, new
    if stopped is not None:
        return Found(z, size, steps, stopped, str(stopped))
    return Found(z, size, steps, SolverStatus.ITERATION_LIMIT, f"not converged in {settings.steps} Newton steps")
