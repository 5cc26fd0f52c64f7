"""The verdict on a plan: its audit, and a check of its samples against the limits of its machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from models import FreeFloating, Machine, Robot
from models.checks import Array
from ocp.app.check.joint_limits import Row, RowVerdict
from ocp.app.check.verdict import Check, check_trajectory
from ocp.app.files import RawTrajectory
from ocp.audit.audit import Audit
from ocp.motion.plan import Plan, PlanSample
from ocp.motion.result.path_plan import PathPlan
from ocp.motion.result.segmented_plan import Piece, SegmentedPlan

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
    return PlanVerdict(plan.audit(**settings), _check(plan, sample, name))


def _check(plan: Plan, sample: PlanSample, name: str) -> Check:
    """Return the check of a plan between the times at which its rates jump, where no acceleration is defined."""
    if isinstance(plan, SegmentedPlan):
        return _worst([_check_piece(piece, sample.t, name) for piece in plan.pieces])
    if isinstance(plan, PathPlan):  # constant rates between waypoints
        joints = tuple(replace(joint, effort=np.inf) for joint in plan.machine.robot.joints)
        times = np.union1d(sample.t, plan.t)
        robot = replace(plan.machine.robot, joints=joints)
        return _check_samples(plan.machine, robot, (times, plan.at(times)["joints"], None, None), name)
    values = (sample.t, sample.joints, sample.rates, sample.accelerations)
    return _check_samples(plan.machine, plan.machine.robot, values, name)


def _check_piece(piece: Piece, times: Array, name: str) -> Check:
    """Return the check of one motion of a plan in segments at those of the times that it covers, and at its ends."""
    plan, local = piece.plan, times - piece.begin
    inside = local[(local > 0) & (local < plan.horizon)]
    sample = plan.sampled(np.concatenate([[0.0], inside, [plan.horizon]]))
    values = (sample.t + piece.begin, sample.joints, sample.rates, sample.accelerations)
    return _check_samples(plan.machine, plan.machine.robot, values, name)


def _check_samples(
    machine: Machine, robot: Robot, values: tuple[Array, Array, Array | None, Array | None], name: str
) -> Check:
    """Return the check of times (M,), joints, rates and accelerations (M, n), the last two or None."""
    raw = RawTrajectory(tuple(robot.joint_names), *values, None, np.arange(1, len(values[0]) + 1), True, (), name)
    base: Any = "floating" if isinstance(machine, FreeFloating) else "fixed"
    options: dict[str, Any] = {} if machine.base_size else _mount(machine)
    options |= {"time_unit": "s", "names_confirmed": True}  # both are certain for a plan
    return check_trajectory(robot, raw, base=base, clearance=None, **options)


def _worst(checks: Sequence[Check]) -> Check:
    """Return the checks of several motions as one: all faults, and the worst row of each quantity."""
    rows: dict[str, Row] = {}
    for row in (row for check in checks for row in check.rows):
        if row.name not in rows or _severity(row) > _severity(rows[row.name]):
            rows[row.name] = row
    joined: dict[str, Any] = {
        name: tuple(dict.fromkeys(each for check in checks for each in getattr(check, name)))
        for name in ("suspicions", "unlimited", "unchecked", "notes", "faults")
    }
    samples, duration = (sum(getattr(check, name) for check in checks) for name in ("samples", "duration"))
    return replace(checks[0], rows=tuple(rows.values()), samples=samples, duration=duration, **joined)


def _severity(row: Row) -> tuple[bool, bool, float]:
    """Return a key by which rows of one quantity are compared."""
    size = abs(row.limit) if row.limit else 1.0
    return row.verdict is RowVerdict.FAILED, row.verdict is RowVerdict.UNDECIDED, abs(row.value) / size


def _mount(machine: Machine) -> dict[str, Array]:
    """Return the pose of a fixed base."""
    frame = machine.world_from_base(())
    return {
        "translation": np.array(frame.position, dtype=float).ravel(),
        "rotation": np.array(frame.rotation, dtype=float),
    }
