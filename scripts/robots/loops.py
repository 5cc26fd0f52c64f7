"""Records of closed control loops, and their figures."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from models import FixedBase, FreeFloating
from models.checks import Array
from ocp import ControlStep
from ocp.app.view.appearance import frames_along
from scripts.drawing import COLORS, sheet
from scripts.robots.drawing import JOINT_COLORS, Scene, draw_scene
from scripts.robots.simulation import Simulation

__all__ = ["Loop", "draw"]


@dataclass
class Loop:
    """What happened in a control loop.

    Attributes:
        machine: The robot. period: Of the controller, s.
        places, targets: Tip and target after each step, m. Shape (M, 3) each as arrays.
        joints, rates: After each step. bases: Poses of a floating base.
        seconds: Wall time of each step of the controller.
        converged, held: Of each step. violation: Largest violation that each step reported.
        captures: For each target, whether it was captured.
        violations: Number of steps of the simulation at which a limit of the robot was exceeded.
    """

    machine: FixedBase | FreeFloating
    period: float
    places: list[Array] = field(default_factory=list)
    targets: list[Array] = field(default_factory=list)
    joints: list[Array] = field(default_factory=list)
    rates: list[Array] = field(default_factory=list)
    bases: list[Array] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    converged: list[bool] = field(default_factory=list)
    held: list[bool] = field(default_factory=list)
    violation: list[float] = field(default_factory=list)
    captures: list[bool] = field(default_factory=list)
    violations: int = 0

    def add(self, step: ControlStep, simulation: Simulation, place: Array, target: Array) -> None:
        """Add a step of the controller and the state after it."""
        self.places.append(place)
        self.targets.append(target)
        self.joints.append(simulation.joints)
        self.rates.append(simulation.rates)
        self.bases.append(simulation.base if isinstance(self.machine, FreeFloating) else np.zeros(0))
        self.violations = simulation.violations
        self.seconds.append(step.seconds)
        self.converged.append(step.converged)
        self.held.append(step.held)
        self.violation.append(step.violation)

    @property
    def distances(self) -> Array:
        """Distance of tip and target after each step, m. Shape (M,)."""
        return np.asarray(np.linalg.norm(np.array(self.places) - np.array(self.targets), axis=1))


def draw(path: Path, loop: Loop, title: str, note: str) -> None:
    """Draw the robot, the coordinates of tip and target, their distance, and the joint velocities over their limits."""
    t = np.asarray(loop.period * np.arange(1.0, len(loop.places) + 1))
    joints, bases = np.array(loop.joints), np.array(loop.bases)
    frames = frames_along(loop.machine, joints, bases if bases.size else None)
    scene = Scene("simulated motion", loop.machine.robot, frames, t, "blue", view=(20.0, -50.0))
    with sheet(path, (2, 2), (8.2, 6.4), note, title=title) as (_, axes):
        draw_scene(axes[0, 0], scene, 4, (760, 620))
        for i, name in enumerate("xyz"):
            color = JOINT_COLORS[i]
            axes[0, 1].plot(t, np.array(loop.targets)[:, i], color=color, ls=":", lw=1.0)
            axes[0, 1].plot(t, np.array(loop.places)[:, i], color=color, lw=1.1, label=name)
        axes[0, 1].set(ylabel="tip (solid) and target (dotted), m", xlabel="time, s")
        axes[0, 1].legend(ncols=3)
        axes[1, 0].plot(t, 1000 * loop.distances, color=COLORS["blue"], lw=1.0)
        axes[1, 0].set(ylabel="distance of tip and target, mm", xlabel="time, s", ylim=(0, None))
        shares = np.array(loop.rates) / loop.machine.robot.velocity
        for i in range(shares.shape[1]):
            axes[1, 1].plot(t, shares[:, i], color=JOINT_COLORS[i], lw=0.8, label=str(i + 1))
        for side in (-1, 1):
            axes[1, 1].axhline(side, color=COLORS["grey"], lw=0.8, ls="--")
        axes[1, 1].set(ylabel="joint velocities over their limits", xlabel="time, s", ylim=(-1.4, 1.1))
        axes[1, 1].legend(ncols=shares.shape[1], loc="lower center", handlelength=1.0, columnspacing=0.8)
