"""Tasks of a machine some of whose joints are held."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from ocp.tasks.equations import TaskEquations

__all__ = ["Held"]


@dataclass(frozen=True, eq=False)
class Held(TaskEquations):
    """Equations of tasks and last rows: some joints are to be where the last of the targets say.

    Attributes:
        held: Numbers of these joints.
    """

    held: tuple[int, ...]

    @property
    def size(self) -> int:
        return super().size + len(self.held)

    def _rows(self, joints: Any, targets: Any) -> Any:
        return targets[targets.numel() - len(self.held) :] - joints[list(self.held)]

    def error(self, base: Any, joints: Any, targets: Any) -> Any:
        return ca.vertcat(super().error(base, joints, targets), self._rows(joints, targets))

    def misfit(self, base: Any, joints: Any, targets: Any) -> Any:
        return ca.vertcat(super().misfit(base, joints, targets), self._rows(joints, targets))

    def jacobian(self, base: Any, joints: Any) -> Any:
        rows = ca.DM.eye(self.machine.joint_size)[list(self.held), :]
        return ca.vertcat(super().jacobian(base, joints), rows)

    @property
    def _symbols(self) -> tuple[Any, Any, Any]:
        base, joints, targets = super()._symbols
        return base, joints, ca.SX.sym("targets", targets.numel() + len(self.held))
