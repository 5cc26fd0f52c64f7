"""Gallery: TALOS takes two steps, statically and dynamically.

90 kg on two legs of six joints each; its arms are held still. The walks of the planar biped (`scripts.robots.steps`) in
space: the zero moment point goes from sole to sole, sideways too.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from models import Foot, Robot
from models.checks import Array
from ocp.motion.builders.standing.stances import Steps
from ocp.motion.builders.standing.steps import StepsMotion
from scripts.drawing import COLORS
from scripts.robots.drawing import animate, page
from scripts.robots.robots import TALOS
from scripts.robots.steps import FRICTION, SIDES, Walks, alternating, scenes_of, walks_of

__all__ = ["HELD", "draw", "plan", "talos", "talos_steps"]

HELD = {
    f"arm_{side}_{joint}_joint": angle * sign
    for side, sign in (("left", 1), ("right", -1))
    for joint, angle in (("1", 0.25), ("2", 0.17), ("4", -0.6 * sign))
}
"""Joints of the arms that do not hang straight down, rad."""
WIDE = 0.085  # of the feet from the middle, m
LENGTH = 0.2  # of a step, m
CLEARANCE = 0.04  # of a sole in the middle of its way, m
KINDS: dict[str, dict[str, Any]] = {
    "static walk": {"balance": "static", "margin": 0.03, "times": (2.0, 2.0), "color": "orange"},
    "dynamic walk": {"balance": "dynamic", "margin": 0.01, "times": (0.8, 0.8), "color": "blue"},
}
"""Requirements on the static and on the dynamic walk; durations of both feet held and of one in the air, s.

The margin of the first is what ground and servos that give take at the corner of a sole, where it stands long."""
VIEW = (13.0, -58.0)  # deg


def talos() -> Robot:
    """TALOS with its legs free: 90 kg, 12 joints.

    Raises:
        FileNotFoundError: It is not installed; says what to install.
    """
    names = TALOS.read().joint_names
    held = {name: HELD.get(name, 0.0) for name in names if not name.startswith("leg")}
    return replace(Robot.from_urdf(TALOS.path, lock=held, **TALOS.options), name=TALOS.name)


def talos_steps(count: int, shift: float, swing: float, *, first: str = "right", length: float = LENGTH) -> Steps:
    """Steps of TALOS; see `scripts.robots.steps.alternating`."""
    robot = talos()
    feet = {side: Foot.of(robot, f"leg_{side}_6_link") for side in SIDES}
    return Steps(robot, feet, alternating(count, shift, swing, first=first, length=length, wide=WIDE))


def plan(coarse: bool = False) -> Walks:
    """Both walks, audited; from one mesh, `coarse` or not."""
    return walks_of(talos_steps, KINDS, CLEARANCE)


def draw(example: Walks, folder: Path, *, animation: bool = True) -> None:
    """talos.png and talos.gif."""
    careful, whole = (example.motions[name] for name in KINDS)
    out = -whole.summary()["com_margin_min_m"]
    title = (
        f"TALOS needs {whole.t[-1]:.1f} s instead of {careful.t[-1]:.1f} s if its centre of mass may "
        f"leave its feet, here by {1000 * out:.0f} mm"
    )
    note = (
        f"TALOS, {whole.steps.robot.total_mass:.0f} kg, takes two steps; earlier configurations are pale; disc: zero "
        f"moment point. Its arms are held still, its legs have twelve joints; steps of {LENGTH:g} and {2 * LENGTH:g} "
        "m, soles of 210 by 130 mm. In the static walk, its centre of mass stays "
        f"{1000 * KINDS['static walk']['margin']:g} mm inside the soles on the ground; in the dynamic walk, only the "
        f"zero moment point stays inside, by {1000 * KINDS['dynamic walk']['margin']:g} mm. Friction at most "
        f"{FRICTION:g}, torques and velocities within its description, soles {1000 * CLEARANCE:g} mm above the ground "
        "in the middle of their way, feet land at rest; the durations are given, and both walks have the lowest cost "
        "found by the same weights."
    )
    scenes = scenes_of(example, VIEW)
    with page(folder / "talos.png", scenes, 4, height=6.8, share=1.55, note=note, title=title) as (above, loads, mass):
        _seen_from_above(above, example)
        _loads(loads, whole)
        _momentum(mass, whole)
    if animation:
        animate(folder / "talos.gif", scenes, frames=44, seconds=0.12, note=note)


def _seen_from_above(ax: Any, example: Walks) -> None:
    """The soles on the ground, the zero moment point of the dynamic walk, and both centers of mass."""
    whole = example.motions["dynamic walk"]
    soles = {
        (name, tuple(place.position)): (place, foot)
        for phase in whole.steps.phases
        for name, place in phase.footholds.items()
        if (foot := whole.steps.feet[name])
    }
    for number, (place, foot) in enumerate(soles.values()):
        corners = np.asarray(place.position) + foot.corners @ np.asarray(place.rotation).T
        ax.fill(corners[:, 0], corners[:, 1], color=COLORS["grey"], alpha=0.3, lw=0)
        name = f"step {number - 1}" if number > 1 else "start"
        ax.text(*corners[:, :2].max(axis=0) - 0.005, name, fontsize=6, ha="right", va="top")
    points = whole.zero_moment_point
    ax.plot(points[:, 0], points[:, 1], color=COLORS["blue"], lw=1.1, label="zero moment point")
    for name, dashes in zip(KINDS, (":", "--"), strict=True):
        way = example.motions[name].center_of_mass
        ax.plot(way[:, 0], way[:, 1], color=COLORS[KINDS[name]["color"]] if dashes == ":" else "black", ls=dashes,
                lw=1.1, label=f"centre of mass, {name}")  # fmt: skip
    ax.set(
        title="soles, from above", xlabel="forward, m", ylabel="to the left, m", xlim=(-0.14, 0.54), ylim=(-0.2, 0.38)
    )
    ax.set_aspect("equal")
    ax.legend(loc="upper left", fontsize=6.0, handlelength=1.6)


def _loads(ax: Any, motion: StepsMotion) -> None:
    """What each foot bears, over the weight: pressing, and along the ground."""
    weight = motion.steps.stances[0].weight
    for side, color in zip(SIDES, ("blue", "orange"), strict=True):
        force = motion.loads[side][:, 3:] / weight
        ax.plot(motion.t, force[:, 2], color=COLORS[color], lw=1.2, label=f"{side}, normal")
        ax.plot(
            motion.t, np.hypot(force[:, 0], force[:, 1]), color=COLORS[color], ls=":", lw=1.2, label=f"{side}, friction"
        )
    ax.set(title="dynamic walk: forces", xlabel="time, s", ylabel="force of a foot / weight", ylim=(-0.05, 1.75))
    ax.legend(loc="upper center", ncols=2, fontsize=6.3, handlelength=1.6)


def _momentum(ax: Any, motion: StepsMotion) -> None:
    """Momentum of the whole, by its mass and the velocity of its center."""
    mass = motion.steps.robot.total_mass
    parts: list[Array] = []
    for k in range(len(motion.steps.phases)):
        inside = motion.phase == k
        parts.append(mass * np.gradient(motion.center_of_mass[inside], motion.t[inside], axis=0, edge_order=2))
    momentum = np.vstack(parts)
    for i, (name, color, dashes) in enumerate(
        (("forward", "blue", "-"), ("to the left", "orange", "--"), ("up", "black", ":"))
    ):
        line = "black" if color == "black" else COLORS[color]
        ax.plot(motion.t, momentum[:, i], color=line, ls=dashes, lw=1.2, label=name)
    ax.set(title="dynamic walk: momentum", xlabel="time, s", ylabel="momentum, kg m/s")
    ax.legend(loc="upper left", fontsize=6.3, handlelength=1.6)
