"""Figures of the optimal plans of the standing machine: both tables, the fastest lift, convergence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from models.machines.standing_motion import StandingMotion
from scripts.drawing import COLORS, Row, sheet
from scripts.papers.standing.cases import ASSUMED, HORIZON, Array, machine
from scripts.papers.standing.drawing import Curve, curve_of, curves, strobe, time_bar
from scripts.papers.standing.figures import SYMBOLS
from scripts.papers.standing.plans import LIFT_LIMITS, LIFT_SETTINGS, SETTINGS, Plan

__all__ = ["draw_convergence", "draw_plans"]

STYLES = {
    "no ZMP rule": ("orange", 1),
    "in the foot less 0.02 m": ("sky", 0),
    "index ≥ 0.5": ("green", 2),
    "index ≥ 0.9": ("purple", 1),
    "pinned at 0": ("black", 3),
}
"""Colour and line style by title."""


def draw_plans(folder: Path, plans: Mapping[str, Mapping[str, Plan]]) -> None:
    """Write the figures of the plans of each task."""
    for task in ("table1", "table2"):
        drawn = [plan for plan in plans[task].values() if plan.request.drawn]
        shown = [curve_of(plan, *STYLES[plan.request.title]) for plan in drawn]
        _draw_task(folder / f"optimal_{task}.png", f"Table {task[-1]}", shown)
    _draw_lift(folder, plans["minimum_time"])


def _draw_task(path: Path, title: str, shown: Sequence[Curve]) -> None:
    kinds: tuple[tuple[str, Callable[[StandingMotion], Array]], ...] = (
        ("zero moment point y, m", lambda m: m.zero_moment_point[:, 1]),
        ("fastest joint, rad/s", lambda m: np.abs(m.joint_velocities).max(axis=1)),
        ("joint-limit index p1", lambda m: m.joint_limit_index),
        ("manipulability p2, m²", lambda m: m.manipulability),
    )
    with sheet(path, rows=2, columns=2, size=(8.4, 5.8), note=f"{ASSUMED}. {SETTINGS}.") as (fig, axes):
        for ax, (label, of) in zip(axes.flat, kinds, strict=True):
            lines = curves(ax, shown, of)
            ax.set(ylabel=label, xlim=(0.0, HORIZON))
        _foot_band(axes[0, 0])
        axes[0, 0].set_title(f"{title} by optimal control; grey: the foot")
        for ax in axes[1]:
            ax.set_xlabel("time, s")
        fig.legend(handles=lines, loc="outside upper left", ncols=3)


def _foot_band(ax: Any) -> None:
    edges = machine().support.vertices[:, 1]
    ax.axhspan(edges.min(), edges.max(), color=COLORS["grey"], alpha=0.15, lw=0, zorder=0)


def _draw_lift(folder: Path, lifts: Mapping[str, Plan]) -> None:
    shown = []
    for plan in lifts.values():
        line = curve_of(plan, *STYLES[plan.request.title])
        shown.append(Curve(f"{line.label}: {plan.solution.horizon:.4f} s", line.motion, line.color, line.dash))
    longest = max(one.motion.t[-1] for one in shown)
    effort = LIFT_LIMITS.bounds(machine()).torque
    kinds: tuple[tuple[str, Callable[[StandingMotion], Array]], ...] = (
        ("zero moment point y, m", lambda m: m.zero_moment_point[:, 1]),
        ("tip height, m", lambda m: m.tip_in_world[:, 2]),
        ("largest share of a torque limit", lambda m: np.abs(m.joint_torques / effort).max(axis=1)),
        ("vertical ground force, N", lambda m: m.ground_force[:, 2]),
    )
    note = f"{ASSUMED}. {LIFT_SETTINGS}. Local optima."
    with sheet(folder / "minimum_time.png", rows=2, columns=2, size=(8.4, 5.8), note=note) as (fig, axes):
        for ax, (label, of) in zip(axes.flat, kinds, strict=True):
            lines = curves(ax, shown, of)
            ax.set(ylabel=label, xlim=(0.0, longest))
        _foot_band(axes[0, 0])
        axes[0, 0].set_title("the fastest lift of 0.8 m; grey: the foot")
        axes[1, 0].set_ylim(0.0, 1.05)
        for ax in axes[1]:
            ax.set_xlabel("time, s")
        fig.legend(handles=lines, loc="outside upper left", ncols=2)
    note = f"{SYMBOLS}. {note}"
    with sheet(folder / "minimum_time_motion.png", columns=3, size=(9.0, 4.5), note=note, sharey=True) as (fig, axes):
        for ax, plan in zip(axes[0], lifts.values(), strict=True):
            strobe(ax, plan.motion, plan.solution.horizon, longest)
            ax.set_title(f"{plan.request.title}: {plan.solution.horizon:.4f} s")
            ax.set_xlabel("y, m")
        axes[0, 0].set_ylabel("z, m")
        time_bar(fig, axes, longest)


def draw_convergence(folder: Path, rows: Sequence[Row]) -> None:
    """Distance of the cost from the finest mesh against the number of intervals."""
    kinds = {"table1": "Table 1", "table2": "Table 2", "minimum_time": "lift"}
    names = {(row["task"], row["plan"]): None for row in rows}
    colors = ("sky", "green", "black", "blue", "orange", "purple", "yellow")
    note = (
        "Costs against those of Legendre 3 at 40 intervals; lifts (cost T + 1e-5 ∫|q''|² dt) against held ones at 100. "
        "Held accelerations converge with about the first order where a constraint of the ground is active."
    )
    with sheet(folder / "convergence.png", size=(8.4, 3.9), note=note) as (_, axes):
        ax = axes[0, 0]
        for (task, plan), color in zip(names, colors, strict=True):
            for marker, dash, method in (("o", "-", "held"), ("s", "--", "points")):
                mine = [
                    (row["intervals"], abs(row["percent"]))
                    for row in rows
                    if (row["task"], row["plan"]) == (task, plan) and method in row["method"] and row["difference"]
                ]
                if mine:
                    label = f"{kinds[task]}, {plan.removeprefix('optimal_').replace('_', ' ')}, {method}"
                    x, y = zip(*mine, strict=True)
                    ax.loglog(x, y, marker=marker, ms=4.5, color=COLORS[color], ls=dash, label=label)
        ax.axhline(1.0, color=COLORS["grey"], lw=0.8)
        ax.set_xticks([10, 20, 40, 80, 160], ["10", "20", "40", "80", "160"])
        ax.set_xticks([], minor=True)
        ax.set(xlabel="intervals", ylabel="cost off by, %", title="Convergence of the cost; grey line: 1 %")
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7.5)
