"""Figures 4 to 11 of the standing paper: the local laws as far as they go; the optimal plans, the lift, convergence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from models.machines.standing import StandingMotion
from scripts.drawing import COLORS, legend_below, sheet, time_bar
from scripts.papers.run import Row
from scripts.papers.standing.animation import draw_animations
from scripts.papers.standing.cases import ASSUMED, CHOSEN, GAINS, HORIZON, STIFFNESS, Local, machine, start_tip
from scripts.papers.standing.drawing import Curve, Quantity, curve_of, curves, diagrams, strobe
from scripts.papers.standing.plans import LIFT_LIMITS, LIFT_SETTINGS, SETTINGS, Plan
from scripts.papers.standing.results import Results

SYMBOLS = "Dot: tip, + centre of mass, ◆ zero moment point, grey bar: the foot, | in it: most stable point"
MARKS = "▼ lifts off, ✖ a joint passes 20 rad/s; past the ▼ the law is shown as if the foot were fastened"
INDEX: Quantity = ("stability index", lambda m: m.index[:, 1], (-5.7, 1.6))
NEAR: Quantity = ("stability index", lambda m: m.index[:, 1], (0.2, 1.1))
FORCE: Quantity = ("vertical ground force, N", lambda m: m.ground_force[:, 2], (-600.0, 1300.0))
LIMIT_INDEX: Quantity = ("joint-limit index p1", lambda m: m.joint_limit_index, (0.0, 1.3))
MANIPULABILITY: Quantity = ("manipulability p2, m²", lambda m: m.manipulability, (0.15, 0.85))


ZMP: Quantity = ("zero moment point y, m", lambda m: m.zero_moment_point[:, 1], None)
STYLES = {
    "no ZMP rule": ("orange", 1),
    "in the foot less 0.02 m": ("blue", 0),
    "index ≥ 0.5": ("green", 2),
    "index ≥ 0.9": ("purple", 1),
    "pinned at 0": ("black", 3),
}
"""Colour and line style by title."""


def draw(results: Results, folder: Path) -> None:
    """Write the figures of the paper, those of the plans and the animations."""
    one, best = results.local["table1"], results.plans["table1"]
    pinned = curve_of(best["optimal_pinned_points"], "black", 3)
    in_range = curve_of(best["optimal_range"], "blue", 0)
    plain = curve_of(one["augmented"], "yellow", 0)
    _compared(
        folder / "fig04_zmp_index.png",
        "Figure 4: the pseudo-inverse and the law that pins the zero moment point fall; the plan stands",
        [
            curve_of(one["pseudo_inverse"], "orange", 1),
            plain,
            curve_of(one["as_printed"], "purple", 2),
            curve_of(one["stabilised"], "green", 1),
            pinned,
            in_range,
        ],
        (INDEX, FORCE),
        f"{ASSUMED}. {GAINS}. {SETTINGS}. Weight {machine().weight:.1f} N. Pinning the zero moment point leaves an "
        "inverted pendulum: its index is 1 by construction, and it falls.",
    )
    _compared(
        folder / "fig05_joint_limits.png",
        "Figure 5: keeping from the joints' limits, the pinned law falls even sooner; the plan keeps from both",
        [plain, curve_of(one["joint_limits"], "orange", 1), pinned, in_range],
        (NEAR, LIMIT_INDEX),
        f"{ASSUMED}. {CHOSEN}; others in layers.csv fall as well. {SETTINGS}.",
    )
    _compared(
        folder / "fig06_all_layers.png",
        "Figure 6: with all layers the pinned law falls soonest; the plan has them all and stands",
        [plain, curve_of(one["all_layers"], "orange", 1), pinned, in_range],
        (NEAR, LIMIT_INDEX, MANIPULABILITY),
        f"{ASSUMED}. {CHOSEN}; others in layers.csv fall as well. {SETTINGS}.",
    )
    _draw_motions(folder, one, best)
    _draw_spring(folder, results.local["table2"], results.plans["table2"])
    _draw_plans(folder, results.plans)
    _draw_convergence(folder, results.convergence)
    draw_animations(folder, results.local, results.plans)


def _compared(path: Path, title: str, shown: Sequence[Curve], quantities: Sequence[Quantity], note: str) -> None:
    """Quantities in rows, the first moments beside the whole motion."""
    last = max(one.diverges or 0.0 for one in shown)
    size = (8.4, 2.1 + 1.75 * len(quantities))
    by_name: dict[str, Any] = {"title": title, "sharey": "row", "xlabel": "time, s"}
    with sheet(path, (len(quantities), 2), size, f"{MARKS}. {note}", **by_name) as (fig, axes):
        for column, end in zip(axes.T, (1.1 * last, HORIZON), strict=True):
            lines = diagrams(column, shown, quantities, end)
        for ax in axes[:, 1]:
            ax.set_ylabel("")
        for row, quantity in zip(axes, quantities, strict=True):
            for ax in row if quantity is FORCE else ():
                ax.axhspan(ax.get_ylim()[0], 0.0, color=COLORS["grey"], alpha=0.18, lw=0)
                ax.text(0.02, 0.06, "lifts off", transform=ax.transAxes, fontsize=7.5)
        axes[0, 0].set_title("until the local methods fail")
        axes[0, 1].set_title("the whole motion")
        legend_below(fig, lines, 2)


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
        result = one[name]
        whole = result.diverges is None
        pictures.append((head, _short(result), result.shown, HORIZON if whole else result.diverges or 0.0))
    for name, head in (("optimal_pinned_points", "optimal, pinned at 0"), ("optimal_range", "optimal, in the foot")):
        pictures.append((head, "stands to the end", best[name].motion, HORIZON))
    note = f"{SYMBOLS}. Only joint limits keep the arm out of the ground. {ASSUMED}. {CHOSEN}. {GAINS}. {SETTINGS}."
    fallen = sum(one[name].diverges is not None or one[name].reason == "tips" for name in heads)
    title = f"Figure 7: {fallen} of the {len(heads)} local laws fall, the two plans stand to the end"
    by_name: dict[str, Any] = {"title": title, "sharey": True, "xlabel": "y, m"}
    with sheet(folder / "fig07_motions.png", (2, 4), (9.4, 7.0), note, **by_name) as (fig, axes):
        for ax, (head, verdict, motion, until) in zip(axes.flat, pictures, strict=True):
            strobe(ax, motion, until, HORIZON if until == HORIZON else until)
            ax.set_title(f"{head}\n{verdict}", fontsize=8.5)
        for ax in axes[:, 0]:
            ax.set_ylabel("z, m")
        time_bar(fig, axes, 1.0)
        fig.axes[-1].set_ylabel("share of the time shown: to the end, or until it diverges")


def _short(result: Local) -> str:
    if result.reason == "lift_off":
        return f"lifts off {result.time:.3f} s, diverges {result.diverges:.3f} s"
    return result.words.split(" (")[0]


def _draw_spring(folder: Path, two: Mapping[str, Local], best: Mapping[str, Plan]) -> None:
    plan, pinned = best["optimal_spring"], best["optimal_spring_pinned_points"]
    rest = start_tip(2)[1]
    title = f"Figure 9: the spring of {STIFFNESS:g} N/m pulls the tip back in proportion to its way"
    with sheet(folder / "fig09_spring.png", (1, 2), (8.2, 3.5), f"{ASSUMED}.", title=title) as (_, axes):
        left, right = axes[0]
        motion = plan.motion
        left.plot(motion.tip_in_world[:, 1] - rest, motion.external_force[:, 1], color=COLORS["blue"])
        left.set(xlabel="tip beyond its start, m", ylabel="force on the tip, N")
        left.set_title("along the path of the tip")
        curves(right, [curve_of(plan, "blue", 0)], lambda m: m.external_force[:, 1])
        right.set(xlabel="time, s", ylabel="force on the tip, N", xlim=(0.0, HORIZON), title="in the task of Table 2")

    free, bound = two["pseudo_inverse"], two["pseudo_inverse_spring"]
    note = (
        f"{SYMBOLS}. {ASSUMED}. The caption and the text of the figure differ in whether the spring pulls: both shown. "
        "The index falls below 0 at ±0.1 m although the foot reaches 0.2 m."
    )
    title = "Figure 10: without a law for the zero moment point the pseudo-inverse leaves the foot"
    with sheet(folder / "fig10_no_zmp.png", (1, 2), (8.2, 4.6), note, title=title) as (fig, axes):
        left, right = axes[0]
        strobe(left, free.motion, HORIZON, HORIZON)
        left.set(xlabel="y, m", ylabel="z, m", title="pseudo-inverse")
        time_bar(fig, [left], HORIZON)
        curves(right, [curve_of(free, "black", 0), curve_of(bound, "grey", 1)], lambda m: m.index[:, 1])
        right.axhline(0.0, color=COLORS["grey"], lw=0.8)
        right.set(xlabel="time, s", ylabel="stability index", xlim=(0.0, HORIZON), ylim=(-8.4, 3.4))
        right.legend(loc="upper left", fontsize=7.5)

    by_name: dict[str, Any] = {}
    held, upright = two["augmented_spring"], two["stabilised_spring"]
    laws = [curve_of(held, "yellow", 0), curve_of(upright, "green", 1)]
    shown = [*laws, curve_of(pinned, "black", 3), curve_of(plan, "blue", 0)]
    note = f"{SYMBOLS}. {MARKS}. {ASSUMED}. {GAINS}. {SETTINGS}."
    largest = float(np.abs(plan.motion.external_force[:, 1]).max())
    title = f"Figure 11: pulled by a spring of up to {largest:.0f} N the pinned laws fall; planned, the robot stands"
    by_name |= {"title": title, "xlabel": "time, s"}
    with sheet(folder / "fig11_spring.png", (2, 3), (9.2, 7.4), note, **by_name) as (fig, axes):
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
        index: Quantity = ("(b) stability index", *NEAR[1:])
        spring: Quantity = ("(c) force of the spring, N", lambda m: m.external_force[:, 1], None)
        lines = diagrams(axes[1], shown, (index, FORCE, spring), HORIZON)
        legend_below(fig, lines, 2)


def _draw_plans(folder: Path, plans: Mapping[str, Mapping[str, Plan]]) -> None:
    """Write the figures of the plans of each task."""
    for task in ("table1", "table2"):
        plotted = [plan for plan in plans[task].values() if plan.request.has_figure]
        shown = [curve_of(plan, *STYLES[plan.request.title]) for plan in plotted]
        _draw_task(folder / f"optimal_{task}.png", f"Table {task[-1]}", shown)
    _draw_lift(folder, plans["minimum_time"])


def _draw_task(path: Path, title: str, shown: Sequence[Curve]) -> None:
    kinds: tuple[Quantity, ...] = (
        ZMP,
        ("fastest joint, rad/s", lambda m: np.abs(m.joint_velocities).max(axis=1), None),
        ("joint-limit index p1", lambda m: m.joint_limit_index, None),
        ("manipulability p2, m²", lambda m: m.manipulability, None),
    )
    title = f"{title} by optimal control: pinned, the joints turn fastest; without a rule the point leaves the foot"
    _four(path, title, f"{ASSUMED}. {SETTINGS}.", shown, kinds, HORIZON, 3)


def _four(
    path: Path,
    title: str,
    note: str,
    shown: Sequence[Curve],
    kinds: Sequence[Quantity],
    end: float,
    legend_columns: int,
) -> None:
    """Four quantities of every motion, the first of them the zero moment point over the foot."""
    with sheet(path, (2, 2), (8.4, 6.0), note, title=title, xlabel="time, s") as (fig, axes):
        lines = diagrams(axes.flat, shown, kinds, end)
        edges = machine().support.vertices[:, 1]
        axes[0, 0].axhspan(edges.min(), edges.max(), color=COLORS["grey"], alpha=0.15, lw=0, zorder=0)
        axes[0, 0].text(0.98, 0.04, "grey: the foot", transform=axes[0, 0].transAxes, fontsize=7.5, ha="right")
        legend_below(fig, lines, legend_columns)


def _draw_lift(folder: Path, lifts: Mapping[str, Plan]) -> None:
    shown = []
    for plan in lifts.values():
        line = curve_of(plan, *STYLES[plan.request.title])
        shown.append(Curve(f"{line.label}: {plan.solution.horizon:.4f} s", line.motion, line.color, line.dash))
    longest = max(one.motion.t[-1] for one in shown)
    effort = LIFT_LIMITS.bounds(machine()).torque
    kinds: tuple[Quantity, ...] = (
        ZMP,
        ("tip height, m", lambda m: m.tip_in_world[:, 2], None),
        ("largest share of a torque limit", lambda m: np.abs(m.joint_torques / effort).max(axis=1), (0.0, 1.05)),
        ("vertical ground force, N", lambda m: m.ground_force[:, 2], None),
    )
    note = f"{ASSUMED}. {LIFT_SETTINGS}. Local optima."
    free, *kept = (plan.solution.horizon for plan in lifts.values())
    slower = " and ".join(f"{100 * (one / free - 1):.0f} %" for one in kept)
    title = f"To stay on its foot the fastest lift of 0.8 m takes {slower} longer"
    _four(folder / "minimum_time.png", title, note, shown, kinds, longest, 3)
    note = f"{SYMBOLS}. {note}"
    by_name: dict[str, Any] = {"title": title, "sharey": True}
    with sheet(folder / "minimum_time_motion.png", (1, 3), (9.0, 4.7), note, **by_name) as (fig, axes):
        for ax, plan in zip(axes[0], lifts.values(), strict=True):
            strobe(ax, plan.motion, plan.solution.horizon, longest, poses=3)
            ax.plot(plan.motion.zero_moment_point[:, 1], 0 * plan.motion.t - 0.1, color="black", lw=1.5)
            ax.text(0.05, -0.2, "path of the zero moment point", fontsize=6.5, ha="center")
            ax.set_title(f"{plan.request.title}: {plan.solution.horizon:.4f} s")
            ax.set_xlabel("y, m")
        axes[0, 0].set_ylabel("z, m")
        time_bar(fig, axes, longest)


def _draw_convergence(folder: Path, rows: Sequence[Row]) -> None:
    """Distance of the cost from the finest mesh against the number of intervals."""
    kinds = {"table1": "Table 1", "table2": "Table 2", "minimum_time": "lift"}
    names = {(row["task"], row["plan"]): None for row in rows}
    colors = ("sky", "green", "black", "blue", "orange", "purple", "yellow")
    note = (
        "Costs against those of Legendre 3 at 40 intervals; grey line: 1 %. Lifts (cost T + 1e-5 ∫|q''|² dt) against "
        "linear ones at 100. Held accelerations converge with about the first order where a constraint of the ground "
        "is active."
    )
    title = "With accelerations free at points the cost is right to 0.1 % at 20 intervals; held ones need more"
    with sheet(folder / "convergence.png", (1, 1), (8.4, 4.1), note, title=title) as (_, axes):
        ax = axes[0, 0]
        for (task, plan), color in zip(names, colors, strict=False):
            for marker, dash, method in (("o", "-", "held"), ("s", "--", "points"), ("^", ":", "linear")):
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
        ax.set(xlabel="intervals", ylabel="cost off by, %")
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7.5)
