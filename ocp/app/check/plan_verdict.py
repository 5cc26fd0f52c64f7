"""The verdict on a plan: its audit, and a check of its samples against the limits of its machine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from models import FreeFloating, Machine
from models.arrays import Array
from ocp.app.check.verdict import Check, check_trajectory
from ocp.app.files import RawTrajectory
from ocp.audit.audit import Audit
from ocp.motion.plan import Plan, PlanSample

__all__ = ["PlanVerdict", "verdict_of"]


@dataclass(frozen=True, eq=False)
class PlanVerdict:
    """Audit and check of a plan. A plan that breaks a limit of its machine must not be run, even if its task allows it.

    Attributes:
        audit: Audit of the plan against its problem.
        check: Check of its samples against the machine's limits of joints, velocities and torques.
    """

    audit: Audit
    check: Check

    @property
    def passed(self) -> bool:
        """Whether the plan is feasible, a local minimum, and within the limits of its machine."""
        return self.audit.passed and self.check.passed

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        if not self.audit.feasible or self.check.passed:
            return self.audit.sentence
        first, count = self.check.faults[0], len(self.check.faults)
        more = f"; {count - 1} more" if count > 1 else ""
        return f"must not be run: it breaks the limits of its machine, {first}{more}"


def verdict_of(plan: Plan, sample: PlanSample, name: str, **settings: Any) -> PlanVerdict:
    """Return the verdict on a plan.

    Args:
        plan: The plan.
        sample: Its samples at the times at which the limits of the machine are checked.
        name: Name of the plan.
        settings: Settings of the audit.
    """
    machine, derivatives = plan.machine, (sample.joints, sample.rates, sample.accelerations)
    lines = np.arange(1, len(sample.t) + 1)
    raw = RawTrajectory(plan.names, sample.t, *derivatives, None, lines, True, (), name)
    base: Any = "floating" if isinstance(machine, FreeFloating) else "fixed"
    options: dict[str, Any] = {} if machine.base_size else _mount(machine)
    options |= {"time_unit": "s", "names_confirmed": True}  # both are certain for a plan
    check = check_trajectory(machine.robot, raw, base=base, clearance=None, **options)
    return PlanVerdict(plan.audit(**settings), check)


def _mount(machine: Machine) -> dict[str, Array]:
    """Return the pose of a fixed base."""
    frame = machine.world_from_base(())
    return {
        "translation": np.array(frame.position, dtype=float).ravel(),
        "rotation": np.array(frame.rotation, dtype=float),
    }
