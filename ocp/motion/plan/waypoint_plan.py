"""Joint path through a sequence of tool poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models import FixedBase
from models.arrays import Array
from ocp.audit.clearance import Clearance

__all__ = ["WaypointPlan"]


@dataclass(frozen=True, eq=False)
class WaypointPlan:
    """Joint path through a sequence of tool poses, with a lower bound of its cost.

    Attributes:
        machine: The arm.
        joints: Joints at the waypoints. Shape (N, n), rad or m.
        cost: Cost of the path, without reconfigurations.
        bound: Lower bound of the cost of any path with at most as many segments; 0 if unknown.
        candidates: Costs of all paths found, and the reasons why they are not the plan.
        clearance: Verified clearance on straight joint motions between waypoints, without reconfigurations; its times
            are waypoint numbers. None without a collision check.
        reconfigurations: Waypoints from which the arm moves to the next one in another configuration, by a motion that
            is not planned.
    """

    machine: FixedBase
    joints: Array
    cost: float
    bound: float
    candidates: tuple[tuple[float, str], ...] = ()
    clearance: Clearance | None = None
    reconfigurations: tuple[int, ...] = ()

    @property
    def steps(self) -> Array:
        """Largest step of each joint between waypoints, without reconfigurations. Shape (n,), rad or m."""
        steps = np.delete(np.abs(np.diff(self.joints, axis=0)), list(self.reconfigurations), axis=0)
        return np.asarray(steps.max(axis=0, initial=0.0))

    def __repr__(self) -> str:
        return (
            f"<WaypointPlan through {len(self.joints)} waypoints: cost {self.cost:.6g}, lower bound {self.bound:.6g}>"
        )

    def __str__(self) -> str:
        lines = [
            f"path through {len(self.joints)} waypoints of {', '.join(self.machine.robot.joint_names)}: "
            f"cost {self.cost:.6g}, lower bound {self.bound:.6g}"
        ]
        if self.reconfigurations:
            places = ", ".join(map(str, self.reconfigurations))
            count = f"{len(self.reconfigurations)} time{'s' if len(self.reconfigurations) > 1 else ''}"
            lines.append(f"  the arm reconfigures {count}, after waypoint {places}")
        if self.clearance is not None and self.clearance.worst is not None:
            closest = self.clearance.worst
            verdict = "too close" if closest.missed else "verified, closest"
            distance = (
                f"{closest.distance:.4g} m apart, {closest.required:g} m required, at waypoint {closest.time:.4g}"
            )
            lines.append(f"  straight lines between waypoints {verdict}: {' and '.join(closest.bodies)}, {distance}")
        return "\n".join(lines + [f"  {cost:10.6g}  {why or 'the plan'}" for cost, why in self.candidates])
