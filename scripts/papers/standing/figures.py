"""Figures 4, 5, 6, 7, 9, 10 and 11 of the standing paper: the local laws as far as they go, and the optimal plans."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from models.machines.standing_motion import StandingMotion
from scripts.drawing import COLORS, sheet
from scripts.papers.standing.cases import ASSUMED, CHOSEN, GAINS, HORIZON, STIFFNESS, Array, Local, start_tip
from scripts.papers.standing.drawing import Curve, curve_of, curves, strobe, time_bar
from scripts.papers.standing.plans import SETTINGS, Plan

__all__ = ["draw"]

MARKS = "▼ lifts off, ✖ a joint passes 20 rad/s; past the ▼ the law is shown as if the foot were fastened"
SYMBOLS = "○ tip, + centre of mass, ◆ zero moment point, grey bar: the foot, | in it: most stable point"
Quantity = tuple[str, Callable[[StandingMotion], Array], tuple[float, float]]

INDEX: Quantity = ("stability index", lambda m: m.index[:, 1], (-5.7, 1.6))
NEAR: Quantity = ("stability index", lambda m: m.index[:, 1], (0.2, 1.1))
FORCE: Quantity = ("vertical ground force, N", lambda m: m.ground_force[:, 2], (-600.0, 1300.0))
LIMIT_INDEX: Quantity = ("joint-limit index p1", lambda m: m.joint_limit_index, (0.0, 1.3))
MANIPULABILITY: Quantity = ("manipulability p2, m²", lambda m: m.manipulability, (0.15, 0.85))


def draw(
    folder: Path, local: Mapping[str, Mapping[str, Local]], plans: Mapping[str, Mapping[str, Plan]], weight: float
) -> None:
    """Write the figures of the paper."""
    one, best = local["table1"], plans["table1"]
    pinned = curve_of(best["optimal_pinned_points"], "black", 3)
    in_range = curve_of(best["optimal_range"], "sky", 0)
    plain = curve_of(one["augmented"], "blue", 0)
    _compared(
        folder / "fig04_zmp_index.png",
        "figure 4",
        [
            curve_of(one["pseudo_inverse"], "orange", 1),
            plain,
            curve_of(one["as_printed"], "purple", 2),
            curve_of(one["stabilised"], "green", 0),
            pinned,
            in_range,
        ],
        (INDEX, FORCE),
        f"{ASSUMED}. {GAINS}. {SETTINGS}. Weight {weight:.1f} N. Pinning the zero moment point leaves an inverted "
        "pendulum: its index is 1 by construction, and it falls.",
    )
    _compared(
        folder / "fig05_joint_limits.png",
        "figure 5",
        [plain, curve_of(one["joint_limits"], "orange", 1), pinned, in_range],
        (NEAR, LIMIT_INDEX),
        f"{ASSUMED}. {CHOSEN}; others in layers.csv fall as well. {SETTINGS}.",
    )
    _compared(
        folder / "fig06_all_layers.png",
        "figure 6",
        [plain, curve_of(one["all_layers"], "orange", 1), pinned, in_range],
        (NEAR, LIMIT_INDEX, MANIPULABILITY),
        f"{ASSUMED}. {CHOSEN}; others in layers.csv fall as well. {SETTINGS}.",
    )
    _draw_motions(folder, one, best)
    _draw_spring(folder, local["table2"], plans["table2"])


def _compared(path: Path, title: str, shown: Sequence[Curve], quantities: Sequence[Quantity], note: str) -> None:
    """Quantities in rows, the first moments beside the whole motion."""
    last = max(one.diverges or 0.0 for one in shown)
    size = (8.4, 2.1 + 1.75 * len(quantities))
    with sheet(path, rows=len(quantities), columns=2, size=size, note=f"{note} {MARKS}.", sharey="row") as (fig, axes):
        for row, (label, of, ends) in zip(axes, quantities, strict=True):
            for ax, end in zip(row, (1.1 * last, HORIZON), strict=True):
                lines = curves(ax, shown, of)
                ax.set(xlim=(0.0, end), ylim=ends)
                if label.startswith("vertical"):
                    ax.axhspan(ends[0], 0.0, color=COLORS["orange"], alpha=0.12, lw=0)
            row[0].set_ylabel(label)
        axes[0, 0].set_title(f"{title}: as the local laws fail")
        axes[0, 1].set_title("the whole motion")
        for ax in axes[-1]:
            ax.set_xlabel("time, s")
        fig.legend(handles=lines, loc="outside upper left", ncols=2)


def _draw_motions(folder: Path, one: Mapping[str, Local], best: Mapping[str, Plan]) -> None:
    heads = {
        "pseudo_inverse": "(a) pseudo-inverse",
        "augmented": "(b) ZMP",
        "joint_limits": "(c) ZMP, joint limits",
        "manipulability": "(d) ZMP, manipulability",
        "all_layers": "(e) all three",
        "stabilised": "stabilised law",
    }
    pictures: list[tuple[str, str, StandingMotion, float]] = []
    for name, head in heads.items():
        found = one[name]
        whole = found.diverges is None
        pictures.append((head, _short(found), found.shown, HORIZON if whole else found.diverges or 0.0))
    for name, head in (("optimal_pinned_points", "optimal, pinned at 0"), ("optimal_range", "optimal, in the foot")):
        pictures.append((head, "stands to the end", best[name].motion, HORIZON))
    note = f"{SYMBOLS}. Only joint limits keep the arm out of the ground. {ASSUMED}. {CHOSEN}. {GAINS}. {SETTINGS}."
    with sheet(folder / "fig07_motions.png", rows=2, columns=4, size=(9.4, 6.9), note=note, sharey=True) as (fig, axes):
        for ax, (head, verdict, motion, until) in zip(axes.flat, pictures, strict=True):
            strobe(ax, motion, until, HORIZON if until == HORIZON else until)
            ax.set_title(f"{head}\n{verdict}", fontsize=8.5)
        for ax in axes[:, 0]:
            ax.set_ylabel("z, m")
        for ax in axes[1]:
            ax.set_xlabel("y, m")
        time_bar(fig, axes, 1.0)
        fig.axes[-1].set_ylabel("share of the time shown: to the end, or until it diverges")
        fig.suptitle("figure 7: motions of Table 1", fontsize=9.5)


def _short(found: Local) -> str:
    if found.reason == "lift_off":
        return f"lifts off {found.time:.3f} s, diverges {found.diverges:.3f} s"
    return found.words.split(" (")[0]


def _draw_spring(folder: Path, two: Mapping[str, Local], best: Mapping[str, Plan]) -> None:
    plan, pinned = best["optimal_spring"], best["optimal_spring_pinned_points"]
    rest = start_tip(2)[1]
    with sheet(folder / "fig09_spring.png", columns=2, size=(8.2, 3.2), note=f"{ASSUMED}.") as (_, axes):
        left, right = axes[0]
        motion = plan.motion
        left.plot(motion.tip_in_world[:, 1] - rest, motion.external_force[:, 1], color=COLORS["blue"])
        left.set(xlabel="tip beyond its start, m", ylabel="force on the tip, N")
        left.set_title(f"figure 9: spring of {STIFFNESS:g} N/m")
        curves(right, [curve_of(plan, "blue", 0)], lambda m: m.external_force[:, 1])
        right.set(xlabel="time, s", ylabel="force on the tip, N", xlim=(0.0, HORIZON), title="in the task of Table 2")

    free, bound = two["pseudo_inverse"], two["pseudo_inverse_spring"]
    note = (
        f"{SYMBOLS}. {ASSUMED}. The caption and the text of the figure differ in whether the spring pulls: both shown. "
        "The index falls below 0 at ±0.1 m although the foot reaches 0.2 m."
    )
    with sheet(folder / "fig10_no_zmp.png", columns=2, size=(8.2, 4.4), note=note) as (fig, axes):
        left, right = axes[0]
        strobe(left, free.motion, HORIZON, HORIZON)
        left.set(xlabel="y, m", ylabel="z, m", title="figure 10: pseudo-inverse, without the ZMP law")
        time_bar(fig, [left], HORIZON)
        curves(right, [curve_of(free, "orange", 0), curve_of(bound, "blue", 1)], lambda m: m.index[:, 1])
        right.axhline(0.0, color=COLORS["grey"], lw=0.8)
        right.set(xlabel="time, s", ylabel="stability index", xlim=(0.0, HORIZON), ylim=(-8.4, 3.4))
        right.legend(loc="upper left", fontsize=7.5)

    held, upright = two["augmented_spring"], two["stabilised_spring"]
    shown = [
        curve_of(held, "blue", 0),
        curve_of(upright, "green", 1),
        curve_of(pinned, "black", 3),
        curve_of(plan, "sky", 0),
    ]
    note = f"{SYMBOLS}. {MARKS}. {ASSUMED}. {GAINS}. {SETTINGS}."
    with sheet(folder / "fig11_spring.png", rows=2, columns=3, size=(9.2, 7.4), note=note) as (fig, axes):
        pictures: tuple[tuple[str, Any, float], ...] = (
            (f"(a) augmented law\n{_short(held)}", held.shown, held.diverges or HORIZON),
            ("optimal, pinned at 0\nstands to the end", pinned.motion, HORIZON),
            ("optimal, in the foot\nstands to the end", plan.motion, HORIZON),
        )
        for ax, (title, moves, until) in zip(axes[0], pictures, strict=True):
            strobe(ax, moves, until, until)
            ax.set_title(title, fontsize=8.5)
            ax.set_xlabel("y, m")
        axes[0, 0].set_ylabel("z, m")
        time_bar(fig, list(axes[0]), 1.0)
        fig.axes[-1].set_ylabel("share of the time shown")
        kinds: tuple[tuple[str, Callable[[StandingMotion], Array], tuple[float, float] | None], ...] = (
            ("(b) stability index", lambda m: m.index[:, 1], (0.2, 1.1)),
            ("vertical ground force, N", lambda m: m.ground_force[:, 2], (-600.0, 1300.0)),
            ("(c) force of the spring, N", lambda m: m.external_force[:, 1], None),
        )
        for ax, (label, of, ends) in zip(axes[1], kinds, strict=True):
            lines = curves(ax, shown, of)
            ax.set(xlabel="time, s", ylabel=label, xlim=(0.0, HORIZON), ylim=ends)
        fig.legend(handles=lines, loc="outside upper left", ncols=2)
        largest = float(np.abs(plan.motion.external_force[:, 1]).max())
        axes[1, 2].set_title(f"figure 11: at most {largest:.0f} N")
