"""A family of captures over the spin of the target: planned together, and by a chain of two optimisations.

The maneuver is that of Virgili-Llop and Romano 2019 (Frontiers in Robotics and AI 6:14), in the plane as in their
experiments on air bearings: an arm on a body that floats catches a body that turns, and stops it. Their chaser brings
the momentum against that of the target, so that both are at rest without a wheel; that is one member of the family,
a wheel that takes the momentum the other. Masses, lengths and times are our own choice, for theirs were not at hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import ocp
from models import FreeFloating, Link, Robot, planar_chain, with_wheels
from ocp import Capture, Collocation, Cost, Limits, chained_capture
from scripts.drawing import COLORS, sheet
from scripts.papers.run import Table, write

__all__ = ["SPINS", "Member", "draw", "plan", "planned", "request", "save"]

SPINS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3)  # rad/s
START = (1.2, -2.0, 0.6)  # rad
DURATION = 8.0  # of each phase, s
INERTIA, MASS = 3.0, 30.0  # of the target, kg m^2 and kg
MOUNT = (0.3, 0.0)  # of the arm, m from the middle of its body: there the body would turn without any effect
RATE = 0.8  # of the joints at most, rad/s
GRASPED = (2.05, 0.25)  # where the middle of the target is, m
METHOD = Collocation(12, degree=4, scheme="legendre")
KINDS = {"wheel": "a reaction wheel absorbs the momentum", "against": "the chaser brings the opposite momentum"}
"""What becomes of the target's momentum."""


@dataclass(frozen=True)
class Member:
    """One capture: costs (the weighted squares of torques and accelerations) of the plan and of the chain's two parts.

    Attributes:
        spin: Of the target, rad/s. kind: Of KINDS.
        together, chain: Cost. approach, detumble: Of the chain's parts. passed: Whether all audits passed.
    """

    spin: float
    kind: str
    together: float
    chain: float
    approach: float
    detumble: float
    passed: bool


def request(spin: float, kind: str) -> tuple[FreeFloating, Capture, dict[str, Any]]:
    """Return machine, task and further arguments; the target turns to the same attitude at the grasp at any spin."""
    hub = Link("hub", 60.0, (0, 0, 0), 6.0 * np.eye(3))
    robot = planar_chain([0.8, 0.7, 0.3], [4.0, 3.0, 1.0], base=hub, mount=MOUNT)
    carried, joints, weights, rates = [0.0, 0.0, 0.0], list(START), [1.0] * 3, [RATE] * 3
    if kind == "wheel":
        robot = with_wheels(robot, [[0, 0, 1]], 0.02, momentum=6.0, torque=1.0, mass=0.2)
        joints, weights, rates = [*joints, 0.0], [*weights, 0.0], [*rates, 300.0]
    else:
        carried[0] = -INERTIA * spin
    body = Link("target", MASS, (0, 0, 0), INERTIA * np.eye(3))
    target = Robot((body,), (), tip="target", tip_translation=(-0.4, 0, 0), name="target")
    floating = FreeFloating(target, "planar", conserved_momentum=[INERTIA * spin, 0.0, 0.0])
    capture = Capture(floating, DURATION, DURATION, target_base=[*GRASPED, -spin * DURATION])
    cost = Cost(velocity=0.0, effort=1.0, acceleration=weights)
    options = {"start": joints, "cost": cost, "limits": Limits(velocity=rates)}
    return FreeFloating(robot, "planar", conserved_momentum=carried), capture, options


def planned(spin: float, kind: str) -> Member:
    """Both plans of a member, audited."""
    machine, capture, options = request(spin, kind)
    together = ocp.plan(machine, capture, scene=False, **options)
    approach, detumble = chained_capture(machine, capture, method=METHOD, **options)
    passed = all(each.audit().passed for each in (together, approach, detumble))
    first, then = float(approach.cost), float(detumble.cost)
    return Member(spin, kind, float(together.cost), first + then, first, then, passed)


def plan(spins: Sequence[float] = SPINS) -> list[Member]:
    """The family."""
    return [planned(spin, kind) for kind in KINDS for spin in spins]


def save(members: Sequence[Member], path: Path) -> None:
    """As a table, a row for each."""
    write(path, Table([asdict(member) for member in members], 6))


def draw(members: Sequence[Member], path: Path) -> None:
    """The additional cost of a chain over the spin."""
    most = max(100 * (member.chain / member.together - 1) for member in members)
    title = f"Planning approach and detumbling one after the other costs up to {most:.1f} % more than together"
    note = (
        f"An arm of three joints on a body of 60 kg catches one of {MASS:g} kg and {INERTIA:g} kg m² in the plane, in "
        f"{DURATION:g} s, and stops it in {DURATION:g} s. Cost: squared torques and accelerations of the joints, "
        "torques of the wheel. The target has the same attitude at the grasp at each spin. One after the other: the "
        "approach has its own lowest cost, and the detumbling the lowest from there. A wheel absorbs the momentum, or "
        "the chaser brings the opposite one, as in Virgili-Llop and Romano 2019, whose masses, lengths and times were "
        "not at hand: these are our own choice. Plans are local optima, by their audits; those of the fastest spins "
        "lie on other branches than the rest."
    )
    with sheet(path, (1, 1), (7.0, 3.2), note, title=title) as (_, axes):
        ax = axes[0, 0]
        for kind, color, mark in zip(KINDS, ("blue", "orange"), "os", strict=True):
            own = [member for member in members if member.kind == kind]
            spins = np.degrees([member.spin for member in own])
            options: dict[str, Any] = {"color": COLORS[color], "marker": mark, "ms": 3.5}
            ax.plot(spins, [100 * (member.chain / member.together - 1) for member in own], label=KINDS[kind], **options)
        ax.set(xlabel="spin of the target, degrees per second", ylabel="additional cost, %", ylim=(-0.3, 12.0))
        ax.legend(loc="upper left")
