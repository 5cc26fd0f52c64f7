"""First guess of a standing plan: the task done locally, with the spare freedom damped."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from models.machines.standing import External, Standing
from ocp.direct.guess import Samples
from ocp.errors import ProblemError
from ocp.local.accelerations import resolve_accelerations
from ocp.tasks.start import Array
from ocp.tasks.tip_path import Path

__all__ = ["local_guess"]

DAMPING = 2.0  # 1/s, of the joint velocities in the null space
STEPS = 400
RACING = 100.0  # rad/s or m/s, of a local motion near a singularity


def local_guess(
    machine: Standing,
    tip_path: Path,
    rows: Sequence[int],
    joints: Array,
    horizon: float,
    by_parameter: bool,
    external: External | None,
) -> dict[str, Any]:
    """Guesses by name; where the local motion breaks down or races, the last posture before that is kept."""

    def timed(time: Any) -> Any:
        return tip_path(smooth(time / horizon)) if by_parameter else tip_path(time)

    times, parts = np.zeros(1), [joints[None, :], np.zeros((1, joints.size)), np.zeros((1, joints.size))]
    try:
        found = resolve_accelerations(
            machine,
            timed,
            rows,
            joints,
            horizon,
            null_damping=DAMPING,
            external=external,
            step=horizon / STEPS,
            stop_at_lift_off=False,
            speed_limit=RACING,
        ).motion
    except ProblemError:  # the task and the start are checked: the start is singular, which a plan may still leave
        pass
    else:
        racing = np.asarray((np.abs(found.joint_velocities) > RACING / 2).any(axis=1))
        sound = int(racing.argmax()) if racing.any() else len(racing)
        times = found.t[:sound]
        parts = [part[:sound] for part in (found.joints, found.joint_velocities, found.joint_accelerations)]
    if times[-1] < horizon * (1 - 1e-9):
        still = np.zeros((1, joints.size))
        parts = [np.vstack([part, more]) for part, more in zip(parts, (parts[0][-1:], still, still), strict=True)]
        times = np.append(times, times[-1] + horizon / STEPS)
    names = ("joints", "velocities", "accelerations")
    guess: dict[str, Any] = {name: Samples(times, part) for name, part in zip(names, parts, strict=True)}
    at = np.linspace(0.0, 1.0, STEPS + 1)
    along = (smooth(at), 30 * (at * (1 - at)) ** 2 / horizon, (60 * at - 180 * at**2 + 120 * at**3) / horizon**2)
    for name, values in zip(("path", "path_rate", "path_acceleration"), along, strict=True):
        guess[name] = Samples(at * horizon, values[:, None])
    return guess


def smooth(fraction: Any) -> Any:
    """From 0 to 1, at rest and without acceleration at both ends."""
    return fraction**3 * (10 - 15 * fraction + 6 * fraction**2)
