"""Records of closed control loops, and their figures."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from models.checks import Array
from ocp.direct.controller import ControlStep
from scripts.drawing import COLORS, sheet
from scripts.robots.simulation import Simulation

__all__ = ["Loop", "draw"]


@dataclass
class Loop:
    """What happened in a control loop.

    Attributes:
        period: Of the controller, s.
        places, targets: Tip and target after each step, m. Shape (M, 3) each as arrays.
        joints, rates: After each step.
        seconds: Wall time of each step of the controller.
        converged: Whether each step converged. violation: Largest violation that each step reported.
        violations: Number of steps of the simulation at which a limit of the robot was exceeded.
    """

    period: float
    places: list[Array] = field(default_factory=list)
    targets: list[Array] = field(default_factory=list)
    joints: list[Array] = field(default_factory=list)
    rates: list[Array] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    converged: list[bool] = field(default_factory=list)
    violation: list[float] = field(default_factory=list)
    captures: list[bool] = field(default_factory=list)
    violations: int = 0

    def add(self, step: ControlStep, simulation: Simulation, place: Array, target: Array) -> None:
        """Add a step of the controller and the state after it."""
        self.places.append(place)
        self.targets.append(target)
        self.joints.append(simulation.joints)
        self.rates.append(simulation.rates)
        self.seconds.append(step.seconds)
        self.converged.append(step.converged)
        self.violation.append(step.violation)

    @property
    def distances(self) -> Array:
        """Distance of tip and target after each step, m. Shape (M,)."""
        return np.linalg.norm(np.array(self.places) - np.array(self.targets), axis=1)
