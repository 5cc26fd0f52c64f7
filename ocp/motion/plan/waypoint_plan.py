"""A way through waypoints: joints at each, their cost, and a bound of any way's cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models import FixedBase
from models.arrays import Array
from ocp.audit.clearance import Clearance

__all__ = ["WaypointPlan"]


@dataclass(frozen=True, eq=False)
class WaypointPlan:
    """A way through waypoints.

    Attributes:
        machine: What moves.
        joints: At the waypoints. Shape (N, n), rad or m.
        cost: Of the way, without what lies in reconfigurations.
        bound: Of the cost of any way through the waypoints, in no more pieces; 0 where none is known.
        ways: Costs of all ways that were found, and why they are not the plan.
        between: How near bodies come on straight lines of the joints from waypoint to waypoint, proven; its times are
            numbers of waypoints. None where nothing was to be looked at. Reconfigurations are left out.
        reconfigurations: Numbers of the waypoints from which the arm comes to the next one in another posture, by a way
            that is not planned.
    """

    machine: FixedBase
    joints: Array
    cost: float
    bound: float
    ways: tuple[tuple[float, str], ...] = ()
    between: Clearance | None = None
    reconfigurations: tuple[int, ...] = ()

    @property
    def steps(self) -> Array:
        """Largest way of each joint from one waypoint to the next, but for reconfigurations. Shape (n,), rad or m."""
        ways = np.delete(np.abs(np.diff(self.joints, axis=0)), list(self.reconfigurations), axis=0)
        return np.asarray(ways.max(axis=0, initial=0.0))

    def __repr__(self) -> str:
        return (
            f"<WaypointPlan through {len(self.joints)} waypoints: cost {self.cost:.6g}, at least {self.bound:.6g} any>"
        )

    def __str__(self) -> str:
        lines = [
            f"way through {len(self.joints)} waypoints of {', '.join(self.machine.robot.joint_names)}: "
            f"cost {self.cost:.6g}, at least {self.bound:.6g} any"
        ]
        if self.reconfigurations:
            places = ", ".join(map(str, self.reconfigurations))
            count = f"{len(self.reconfigurations)} time{'s' if len(self.reconfigurations) > 1 else ''}"
            lines.append(f"  the arm reconfigures {count}, after waypoint {places}")
        if self.between is not None and self.between.worst is not None:
            near = self.between.worst
            how = "too near" if near.missed else "proven clear, the nearest"
            apart = f"{near.distance:.4g} m apart, {near.required:g} m asked, at waypoint {near.time:.4g}"
            lines.append(f"  straight between waypoints {how}: {' and '.join(near.bodies)}, {apart}")
        return "\n".join(lines + [f"  {cost:10.6g}  {why or 'the plan'}" for cost, why in self.ways])
