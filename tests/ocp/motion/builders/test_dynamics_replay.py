"""Plans by their drives in MuJoCo: the same torques, energies that are what the torques did, momentum that stays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ocp import Collocation, Cost, dynamics_problem, solve
from tests.ocp.motion.builders.dynamics_replay import replay
from tests.ocp.motion.tasks.space_tasks import PANDA_START, floating_manipulator, panda, two_pandas

MOVED = np.array([0.5, 0.4, -0.3, 0.4, 0.3, -0.4, 0.3])
MACHINES: dict[str, tuple[Any, Any, float, Cost, int]] = {
    "panda": (panda, PANDA_START, 1.0, Cost(velocity=0.0, effort=1.0, acceleration=1.0), 10),
    "floating manipulator": (
        floating_manipulator,
        np.linspace(-0.4, 0.5, 7),
        4.0,
        Cost(velocity=0.0, acceleration=1.0),
        6,
    ),
    "two arms": (two_pandas, np.tile(PANDA_START, 2), 4.0, Cost(velocity=0.0, acceleration=1.0), 4),
}
"""Machine, start, duration, what costs, intervals; the floating arms go half the way."""


@pytest.mark.parametrize("name", MACHINES)
def test_the_work_of_torques_is_the_energy_in_mujoco(name: str) -> None:
    """At the plan's own states, and where its torques alone take a machine that MuJoCo integrates."""
    make, start, horizon, effort, intervals = MACHINES[name]
    machine = make()
    end = start + np.resize(MOVED, len(start)) * (0.5 if machine.base_size else 1.0)
    problem = dynamics_problem(machine, (), horizon, start=start, end=end, cost=effort)
    result = replay(machine, solve(problem, Collocation(intervals, degree=5, scheme="legendre")))
    size = np.ptp(result.energy)
    assert size > 1e-3
    assert result.inverse < 1e-8
    assert np.abs(np.diff(result.energy) - result.work).max() < 1e-8 * size
    assert np.abs(result.replayed - result.energy).max() < 1e-6 * size
    assert result.off < 1e-6
    assert result.momentum < 1e-8
