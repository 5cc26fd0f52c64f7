"""How the standing machine is drawn: arm, foot, zero moment point, centre of mass; curves that end as they fail."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from models import link_frames
from models.machines.standing import StandingMotion
from scripts.drawing import COLORS, DASHES, TIME_COLORS, draw_arm
from scripts.papers.standing.cases import Array, Local, machine
from scripts.papers.standing.plans import Plan

Quantity: TypeAlias = tuple[str, Callable[[StandingMotion], Array], tuple[float, float] | None]
"""Label, the quantity of a motion at its times, and the ends of the axis."""

POSES = 5
FRAME = ((-0.5, 0.86), (-0.3, 1.4))  # y and z of the pictures, m


@dataclass(frozen=True)
class Curve:
    """A motion in a diagram.

    Attributes:
        label: For the legend. motion: What is drawn.
        color: Of scripts.drawing.COLORS. dash: Line style.
        lifts, diverges: Times of the marks, s; None without.
    """

    label: str
    motion: StandingMotion
    color: str
    dash: Any
    lifts: float | None = None
    diverges: float | None = None


def curve_of(what: Local | Plan, color: str, dash: int) -> Curve:
    """A local motion, as far as it goes and marked where it fails, or a plan."""
    if isinstance(what, Plan):
        return Curve(f"optimal, {what.request.title}", what.motion, COLORS[color], DASHES[dash])
    label = what.case.title
    if what.reason in ("lift_off", "divergence", "breakdown", "tips"):
        label += f": {what.words.split(' (')[0]}"
    if what.reason == "lift_off" and what.diverges is not None:
        label += f", diverges at {what.diverges:.3f} s"
    lifts = what.time if what.reason == "lift_off" else None
    return Curve(label, what.shown, COLORS[color], DASHES[dash], lifts, what.diverges)


def curves(ax: Any, shown: Sequence[Curve], of: Callable[[StandingMotion], Array]) -> list[Any]:
    """Draw a quantity of each motion over time; a triangle where it lifts off, a cross where it diverges."""
    lines = []
    for one in shown:
        t, values = one.motion.t, of(one.motion)
        lines += ax.plot(t, values, color=one.color, ls=one.dash, label=one.label)
        for time, marker in ((one.lifts, "v"), (one.diverges, "X")):
            if time is not None:
                k = nearest(t, time)
                ax.plot(t[k], values[k], marker, color=one.color, ms=6, mec="white", mew=0.5, zorder=5)
    return lines


def diagrams(axes: Iterable[Any], shown: Sequence[Curve], quantities: Iterable[Quantity], end: float) -> list[Any]:
    """A quantity of every motion in each of the axes, from 0 to `end`, s; the lines of the last, for a legend."""
    lines: list[Any] = []
    for ax, (label, of, ends) in zip(axes, quantities, strict=True):
        lines = curves(ax, shown, of)
        ax.set(ylabel=label, xlim=(0.0, end), **({"ylim": ends} if ends else {}))
    return lines


def nearest(t: Array, time: float) -> int:
    """The sample nearest to a time."""
    return int(np.abs(t - time).argmin())


@cache
def _outline() -> Any:
    """joints -> the arm from its first joint to the tip in the y-z plane, (n + 1, 2)."""
    robot = machine().robot
    q = ca.SX.sym("q", robot.dof)
    frames = link_frames(robot, q, machine().world_from_base())
    points = [frames[joint.child].position for joint in robot.moving_joints]
    arm = ca.horzcat(*points, machine().tip_pose((), q).position)
    return ca.Function("outline", [q], [arm[1:, :].T])


def arm_points(joints: Array) -> Array:
    """The arm from its first joint to the tip in the y-z plane. Shape (n + 1, 2), m."""
    return np.array(_outline()(joints))


def lowest_point(joints: Array) -> float:
    """Height of the lowest joint or tip in a motion, joints of shape (M, n); m."""
    return float(np.array(_outline().map(len(joints))(joints.T))[:, 1::2].min())


def foot(ax: Any) -> None:
    """The ground, the foot on it and the most stable point."""
    low, high = machine().support.vertices[:, 1].min(), machine().support.vertices[:, 1].max()
    ax.axhline(0.0, color=COLORS["grey"], lw=0.7, zorder=0)
    ax.fill([low, high, high, low], [0.0, 0.0, -0.035, -0.035], color=COLORS["grey"], lw=0, alpha=0.75, zorder=1)
    ax.plot(machine().most_stable_point[1], -0.0175, "|", color="white", ms=5, mew=1.3, zorder=2)


def axes_frame(ax: Any) -> None:
    """The same piece of the world in every picture."""
    ax.set(xlim=FRAME[0], ylim=FRAME[1], aspect="equal")


def strobe(ax: Any, motion: StandingMotion, until: float, horizon: float, poses: int = POSES) -> None:
    """Configurations from the start to `until`, later ones thicker, coloured by their time out of the horizon."""
    foot(ax)
    for time, width in zip(np.linspace(0.0, until, poses), np.linspace(1.4, 3.6, poses), strict=True):
        k = nearest(motion.t, time)
        color = TIME_COLORS(time / horizon)
        arm = arm_points(motion.joints[k])
        draw_arm(ax, arm, color, float(width))
        ax.plot(motion.center_of_mass[k, 1], motion.center_of_mass[k, 2], "+", color=color, ms=6, mew=1.2, zorder=6)
        ax.plot(motion.zero_moment_point[k, 1], 0.0, "D", color=color, ms=3.6, mec="white", mew=0.4, zorder=7)
    axes_frame(ax)
