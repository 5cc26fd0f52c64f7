"""Gallery: a Panda picks a load up, carries it over and puts it down, at the least effort within its torques.

Seven legs, each a phase of one problem: over the load, down to it, up with it, across, down, up without it, home. The
arm is at rest at the end of each, so that the load changes hands at rest. The same motion is planned
without the load, and shown with the torques that the load requires then.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import ocp
from models import FixedBase, Link, Robot, VisualShape, attach_tool, with_load
from models.checks import Array
from ocp import Audit, Cost, Goal, Solution, TipTask, inverse_kinematics, joint_torques
from ocp.app.view.appearance import TIP_FRAME, Frames, frames_along
from scripts.drawing import COLORS
from scripts.robots.drawing import LEGEND, Scene, animate, page
from scripts.robots.panda import HOME
from scripts.robots.robots import PANDA

__all__ = ["LOAD", "SIZE", "Motion", "carried", "draw", "legs", "plan"]

LOAD = 4.0  # kg
SIZE = (0.08, 0.04, 0.12)  # of the load, along the axes of the hand, m
PICK, PLACE = (0.6, -0.7, 0.06), (0.6, 0.7, 0.26)
"""Where the middle of the load is: distance from the arm's first axis, m; direction, rad; height, m."""
ABOVE = 0.15  # m, of the points above the load and its place
WAY, DOWN, ACROSS = 1.6, 0.4, 1.6  # durations of legs, s
EFFORT = Cost(velocity=0.0, effort=1.0, acceleration=2.0)
FINE = 81  # times of a leg
HANDED = ("lift", "carry", "set down")
"""Legs with the load in hand."""
KINDS = {"planned without the load": "orange", "planned with the load": "blue"}
VIEW = (20.0, 12.0)  # deg
LOADED: dict[int, tuple[str, Any]] = {1: ("purple", "-"), 5: ("green", "--")}
"""Colour and line of the joints whose torques the load changes most; their numbers from 0."""
STEEL, SHELF = (0.55, 0.35, 0.20, 1.0), (0.72, 0.72, 0.70, 1.0)


@dataclass(frozen=True, eq=False)
class Motion:
    """A plan at FINE times of each leg, with the torques that it takes with the load in hand.

    Attributes:
        t: s. Shape (M,).
        leg: Which one. Shape (M,).
        joints, velocities, accelerations: Shape (M, 7).
        torques: With the load, where it is in hand; empty: without it. Shape (M, 7), N m.
    """

    t: Array
    leg: Array
    joints: Array
    velocities: Array
    accelerations: Array
    torques: Array
    empty: Array

    @property
    def in_hand(self) -> Array:
        """Where the load is in hand. Shape (M,)."""
        return np.asarray(np.isin(self.leg, [k for k, (name, *_) in enumerate(ROUTE) if name in HANDED]))


ROUTE = (
    ("reach", "over the load", WAY),
    ("lower", "at the load", DOWN),
    ("lift", "over the load", DOWN),
    ("carry", "over the place", ACROSS),
    ("set down", "at the place", DOWN),
    ("let go", "over the place", DOWN),
    ("return", "home", WAY),
)
"""Legs: name, posture at the end, duration, s."""


@dataclass(frozen=True, eq=False)
class PickAndPlace:
    """The motion planned with the load and without, by their names in KINDS.

    Attributes:
        plans: Audited. motions: What they take. audits: Of each.
    """

    plans: dict[str, Solution]
    motions: dict[str, Motion]
    audits: dict[str, Audit]

    @property
    def audit(self) -> Audit:
        """Of the plan that is not sound, if one is not, else of the one that knows the load."""
        return next((audit for audit in self.audits.values() if not audit.passed), self.audits["planned with the load"])

    def share(self, name: str) -> Array:
        """Largest torque of each joint over its limit, of a plan. Shape (7,)."""
        return np.asarray(np.abs(self.motions[name].torques).max(axis=0) / arm().robot.effort)

    def summary(self) -> dict[str, Any]:
        """A row of the summary."""
        known = self.motions["planned with the load"]
        return {
            "robot": PANDA.name,
            "dof": arm().joint_size,
            "task_rows": None,
            "duration_s": float(known.t[-1]),
            "cost_local": None,
            "cost_optimal": float(self.plans["planned with the load"].cost),
            "tip_error": None,
            "joint_return_rad": float(np.abs(known.joints[-1] - known.joints[0]).max()),
            "audit_passed": all(audit.passed for audit in self.audits.values()),
            "load_kg": LOAD,
            "torque_share_with_the_load": self.share("planned with the load").tolist(),
            "torque_share_without_the_load": self.share("planned without the load").tolist(),
        }


@cache
def arm() -> FixedBase:
    """The arm with nothing in its hand."""
    return FixedBase(PANDA.read())


def carried() -> FixedBase:
    """The arm with the load: a block of steel, its middle where the hand grips."""
    robot = arm().robot
    squares = np.square(SIZE)
    inertia = LOAD / 12 * np.diag(squares.sum() - squares)
    return FixedBase(with_load(robot, robot.tip_link, LOAD, robot.tip_translation, inertia=inertia))


@cache
def configurations() -> dict[str, Array]:
    """Joints at the points of the way, by name, rad: the hand points down, one finger inwards."""
    result = {"home": np.array(HOME)}
    for name, (far, direction, height) in (("load", PICK), ("place", PLACE)):
        near = np.array(HOME)
        for which, above in ((f"over the {name}", ABOVE), (f"at the {name}", 0.0)):
            goal = ca.DM([far, 0.0, height + above])
            task = TipTask(position=lambda t, at=goal: at, orientation=lambda t: ca.DM(np.diag([1.0, -1.0, -1.0])))
            near = inverse_kinematics(arm(), task, near=near, starts=0)[0].joints
            result[which] = near + direction * np.eye(len(near))[0]
    return result


def legs(known: bool) -> list[Goal]:
    """Of the way, with the load where it is known and in hand."""
    result = []
    for k, (name, end, horizon) in enumerate(ROUTE):
        machine = carried() if known and name == HANDED[0] else arm() if k == 0 or name == "let go" else None
        result.append(Goal(joints=configurations()[end], duration=horizon, machine=machine, name=name))
    return result


def plan(coarse: bool = False) -> PickAndPlace:
    """Both plans, audited; `coarse` changes nothing."""
    plans, motions, audits = {}, {}, {}
    for name in KINDS:
        goals = legs(name == "planned with the load")
        plans[name] = ocp.plan(arm(), goals, start=HOME, cost=EFFORT, scene=False).solution
        motions[name], audits[name] = motion_of(plans[name]), plans[name].audit()
    return PickAndPlace(plans, motions, audits)


def motion_of(solution: Solution) -> Motion:
    """A plan at many times, and its torques."""
    parts: dict[str, list[Array]] = {name: [] for name in ("joints", "velocities", "accelerations")}
    times, leg, torques, empty, begin = [], [], [], [], 0.0
    full, bare = (torque_function(machine) for machine in (carried(), arm()))
    for k, (name, *_) in enumerate(ROUTE):
        phase = solution.phase(name)
        at = phase.at_fraction(np.linspace(0.0, 1.0, FINE))
        for what, values in parts.items():
            values.append(at[what])
        columns = [at[what].T for what in parts]
        empty.append(np.array(bare(*columns)).T)
        torques.append(np.array(full(*columns)).T if name in HANDED else empty[-1])
        times.append(begin + phase.horizon * np.linspace(0.0, 1.0, FINE))
        leg.append(np.full(FINE, k))
        begin += phase.horizon
    stacked = {what: np.vstack(values) for what, values in parts.items()}
    return Motion(
        np.concatenate(times), np.concatenate(leg), **stacked, torques=np.vstack(torques), empty=np.vstack(empty)
    )


def torque_function(machine: FixedBase) -> Any:
    """Joints, velocities and accelerations to torques, columns side by side."""
    symbols = [ca.SX.sym(name, machine.joint_size) for name in ("q", "v", "a")]
    return ca.Function("torques", symbols, [joint_torques(machine, (ca.DM(0, 1), *symbols))])


def scene_of(name: str, example: PickAndPlace) -> Scene:
    """A motion with the load beside the arm, in its hand, or where it was put."""
    motion, robot = example.motions[name], arm().robot
    most = example.share(name).max()
    frames = frames_along(arm(), motion.joints)
    first, last = np.flatnonzero(motion.in_hand)[[0, -1]]
    number = np.clip(np.arange(len(motion.t)), first, last)
    frames.rotations["load"], frames.positions["load"] = (
        part[TIP_FRAME][number] for part in (frames.rotations, frames.positions)
    )
    for what in (frames.rotations, frames.positions):
        what["stands"] = what[robot.root]
    title = f"{name}: {100 * most:.0f} % torque"
    return Scene(
        title, furnished(robot), Frames(frames.rotations, frames.positions), motion.t, KINDS[name], view=VIEW, floor=0.0
    )


def furnished(robot: Robot) -> Robot:
    """The arm with the load and what it is put on, for pictures."""
    block = Link("load", visuals=(VisualShape("box", SIZE, color=STEEL),))
    far, direction, height = PLACE
    tall = height - SIZE[2] / 2
    place = (far * np.cos(direction), far * np.sin(direction), tall / 2)
    shelf = Link("stands", visuals=(VisualShape("box", (0.2, 0.2, tall), translation=place, color=SHELF),))
    for each in (block, shelf):
        robot = attach_tool(robot, each, robot.root, keep_tip=True)
    return robot


def draw(example: PickAndPlace, folder: Path, *, animation: bool = True) -> None:
    """pick_and_place.png and pick_and_place.gif."""
    robot, blind, known = arm().robot, *(example.share(name) for name in KINDS)
    title = (
        f"Planned without the load of {LOAD:g} kg, joint {blind.argmax() + 1} needs {100 * blind.max():.0f} % of its "
        f"torque limit; planned with it, {100 * known.max():.0f} %"
    )
    note = (
        f"{PANDA.name}: over a load of {LOAD:g} kg, down, up with it, across, down, and home in {len(ROUTE)} legs and "
        f"{example.motions['planned with the load'].t[-1]:g} s, from rest to rest on each; earlier configurations are "
        "pale. The load is a block of steel, heavier than the 3 kg for which the arm is specified. Limits of torque, "
        f"from its description: {', '.join(f'{value:g}' for value in robot.effort)} N m. Both plans minimise the "
        f"squared torques plus {EFFORT.acceleration:g} (N m)² s⁴/rad² times the squared accelerations, within the "
        "limits of positions, velocities and torques. One of them is planned for an empty hand; the figure shows the "
        "torques that its motion requires with the load. Durations are given; joints have no friction."
    )
    scenes = [scene_of(name, example) for name in KINDS]
    ends = np.cumsum([0.0, *(horizon for *_, horizon in ROUTE)])
    with page(
        folder / "pick_and_place.png",
        scenes,
        [float(at) for at in ends[[1, 2, 4, 5]]],
        height=6.4,
        share=1.35,
        note=note,
        title=title,
    ) as axes:
        for ax, name in zip(axes, KINDS, strict=False):
            motion = example.motions[name]
            shares = motion.torques / robot.effort
            ax.plot(motion.t, np.delete(shares, list(LOADED), axis=1), color=COLORS["grey"], lw=0.6)
            ax.lines[0].set_label("other joints")
            for k, (color, dashes) in LOADED.items():
                ax.plot(motion.t, shares[:, k], color=COLORS[color], ls=dashes, label=f"joint {k + 1}")
            _limits(ax, motion)
            ax.set(title=name, xlabel="time, s")
        axes[0].set_ylabel("torque, limits = ±1")
        axes[0].legend(ncols=2, **LEGEND)
        motion = example.motions["planned with the load"]
        for k, (color, dashes) in LOADED.items():
            part = motion.torques[:, k] - motion.empty[:, k]
            axes[2].plot(motion.t, part / robot.effort[k], color=COLORS[color], ls=dashes)
        _limits(axes[2], motion)
        axes[2].set(title="due to the load alone", xlabel="time, s")
        axes[2].text(motion.t[motion.in_hand].mean(), -0.96, "load in hand", ha="center", fontsize=7)
    if animation:
        animate(folder / "pick_and_place.gif", scenes, frames=48, seconds=0.12, note=note)


def _limits(ax: Any, motion: Motion) -> None:
    """The limits of torque, and when the load is in hand."""
    for low, high in ((-9.0, -1.0), (1.0, 9.0)):
        ax.axhspan(low, high, color=COLORS["grey"], alpha=0.25, lw=0)
    held = motion.t[motion.in_hand]
    ax.fill_between(held[[0, -1]], -1.0, 1.0, color=COLORS["yellow"], alpha=0.15, lw=0)
    ax.set_ylim(-1.5, 1.2)  # with room for a legend
