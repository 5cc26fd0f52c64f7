"""Figures of what the blend paper leaves out: mapping errors, curvature, limits; and the arm in motion."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from scripts.drawing import COLORS, STYLE, add_note, gif, sheet
from scripts.papers.blend.example import ARM, CENTRIPETAL, JOINT_LIMITS, MM, REMAINING, SPEED
from scripts.papers.blend.figures import LINES, MAPPINGS
from scripts.papers.blend.results import Results

__all__ = ["draw_animation", "draw_findings"]

FRAME = 0.04  # s
ROUNDING = 1e-11
"""Errors below it, exact zeros too, are drawn here."""


def draw_findings(folder: Path, results: Results) -> None:
    """Write the other figures."""
    _mapping(folder, results)
    _curvature(folder, results)
    _limits(folder, results)


def _mapping(folder: Path, results: Results) -> None:
    note = "90° corner at 1000 mm/s; cubic with λ = 3, quintic with λ = 1.5. Below 1e-9 the curves show rounding."
    with sheet(
        folder / "mapping_errors.png", rows=2, columns=2, size=(8.6, 5.8), note=note, sharex=True, sharey="row"
    ) as (figure, axes):
        for row, key, label in (
            (axes[0], "drift_um", "|drift| at the blend's end, µm"),
            (axes[1], "true_speed_error_mm_s", "worst |speed error|, mm/s"),
        ):
            row[0].set_ylabel(label)
            for ax, kind in zip(row, ("cubic", "quintic"), strict=True):
                for (mapping, name), color in zip(MAPPINGS.items(), ("orange", "blue"), strict=True):
                    for period, dash, marker in zip((1, 2, 4), LINES, "osD", strict=False):
                        wanted = {"blend": kind, "mapping": mapping, "period_ms": period}
                        mine = [r for r in results.small_blends if all(r[k] == v for k, v in wanted.items())]
                        x, y = [r["remaining_mm"] for r in mine], [max(abs(r[key]), ROUNDING) for r in mine]
                        style = {"ls": dash, "marker": marker, "ms": 3.5, "color": COLORS[color]}
                        ax.loglog(x, y, **style, label=f"{name}, {period} ms")
        ticks = sorted({row["remaining_mm"] for row in results.small_blends})
        for ax in axes[1]:
            ax.set(xlabel="$L_r$, mm", xticks=ticks, xticklabels=[f"{x:g}" for x in ticks])
            ax.minorticks_off()
        axes[0, 0].set_title("Cubic blend")
        axes[0, 1].set_title("Quintic blend")
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2)


def _curvature(folder: Path, results: Results) -> None:
    with sheet(folder / "curvature.png", size=(6.6, 3.4)) as (_, axes):
        ax = axes[0, 0]
        for path, name, dash in (
            (results.cubic, "cubic, λ = 3", LINES[0]),
            (results.quintic, "quintic, λ = 1.5", LINES[1]),
        ):
            s = np.unique(np.concatenate([np.linspace(0, path.length, 6001), path.bounds, path.bounds[1:-1] - 1e-9]))
            ax.plot(s / MM, path.curvature(s) * MM * REMAINING / MM, ls=dash, label=name)
        ax.set(xlabel="distance, mm", ylabel="curvature × $L_r$", title="Curvature along the example")
        ax.legend(loc="upper left")
        jump = results.cubic.curvature_jumps()
        at = int(jump.argmax())
        inset = ax.inset_axes((0.74, 0.42, 0.24, 0.42))
        place = results.cubic.bounds[at + 1]
        for path, dash in ((results.cubic, LINES[0]), (results.quintic, LINES[1])):
            centre = path.bounds[at + 1]
            for side in (np.linspace(-0.012, -1e-9, 60), np.linspace(0, 0.012, 60)):
                inset.plot(
                    side / MM,
                    path.curvature(centre + side) * REMAINING,
                    ls=dash,
                    color=COLORS["blue"] if path is results.cubic else COLORS["orange"],
                )
        inset.set_title(f"end at {place / MM:.0f} mm", fontsize=7)
        inset.tick_params(labelsize=6)


def _limits(folder: Path, results: Results) -> None:
    note = (
        f"Thick: the schedule; thin: the minimum time by optimal control. Centripetal acceleration at most "
        f"{CENTRIPETAL:g} m/s². Joint limits (chosen) of shoulder, elbow, quill, wrist: {joint_limits()}. "
        "The cubic's curvature jumps, so that it can keep no joint jerk limit."
    )
    with sheet(folder / "limits.png", rows=2, columns=2, size=(9.0, 5.6), note=note, sharey="row") as (_, axes):
        for (upper, lower), kind in zip(axes.T, ("cubic", "quintic"), strict=True):
            mine = {name: plan for name, plan in results.plans.items() if name.startswith(kind)}
            for (name, plan), color, dash in zip(mine.items(), ("grey", "blue", "orange"), LINES, strict=False):
                label = f"{name.split(', ')[1]}: {plan.schedule.duration:.3f} s, minimum {plan.fastest.duration:.3f} s"
                thick: dict[str, Any] = {"ls": dash, "label": label}
                thin: dict[str, Any] = {"lw": 0.8, "alpha": 0.8}
                for one, style in ((plan.schedule, thick), (plan.fastest.schedule, thin)):
                    motion = one.at(np.linspace(0, one.duration, 4001))
                    place = np.clip(motion.distance, 0, plan.path.length)
                    upper.plot(place / MM, motion.speed / MM, **style, color=COLORS[color])
                    centripetal = motion.speed**2 * plan.path.curvature(place)
                    lower.plot(place / MM, centripetal, **style, color=COLORS[color])
            upper.set(title=f"{kind.capitalize()} blends", ylim=(0, 1.05 * SPEED / MM))
            upper.legend(loc="lower center")
            lower.axhline(CENTRIPETAL, color=COLORS["black"], lw=0.8, ls=LINES[3])
            lower.set(xlabel="distance, mm")
        axes[0, 0].set_ylabel("line speed, mm/s")
        axes[1, 0].set_ylabel("centripetal acceleration, m/s²")


def joint_limits() -> str:
    """The chosen limits in words."""
    texts = []
    for kind, power in (("velocity", ""), ("acceleration", "²"), ("jerk", "³")):
        values = ", ".join(f"{value:g}" for value in np.asarray(getattr(JOINT_LIMITS, kind)))
        texts.append(f"{kind} {values} rad/s{power} (m/s{power})")
    return "; ".join(texts)


def draw_animation(folder: Path, results: Results) -> None:
    """The arm drawing the path, in real time."""
    plan = results.mean
    times = np.append(np.arange(0, plan.duration, FRAME), plan.duration)
    motion = plan.at(times)
    joints = results.joints.at(motion.distance).position
    fine = plan.at(np.linspace(0, plan.duration, 1001))
    whole = results.cubic.at(fine.distance).position / MM
    edges = plan.time_at(results.cubic.bounds[1:5])

    def frames() -> Iterator[Figure]:
        with matplotlib.rc_context(STYLE):
            figure = Figure(figsize=(8.0, 4.4), dpi=90, layout="constrained")
            FigureCanvasAgg(figure)
            axes = figure.subplots(2, 2, width_ratios=(1.5, 1), sharex="col")
            for ax in axes[:, 0]:
                ax.remove()
            ax = figure.add_subplot(axes[0, 0].get_gridspec()[:, 0])
            ax.plot(whole[:, 0], whole[:, 1], color=COLORS["grey"], lw=0.8, ls=LINES[3], label="path")
            (drawn,) = ax.plot([], [], color=COLORS["blue"], lw=2, label="drawn")
            (arm,) = ax.plot([], [], "o-", color=COLORS["orange"], lw=4, ms=7, label="arm")
            ax.set_aspect("equal")
            ax.set(xlim=(-480, 860), ylim=(-60, 800), xlabel="x, mm", ylabel="y, mm")
            ax.legend(loc="upper right")
            title = ax.set_title("")
            moving: list[tuple[Any, Any]] = []
            rows = ((axes[0, 1], fine.speed / MM, "line speed, mm/s"), (axes[1, 1], whole[:, 2], "height z, mm"))
            for right, values, label in rows:
                right.plot(fine.t, values, color=COLORS["grey"], lw=0.8)
                for begin, end in zip(edges[::2], edges[1::2], strict=True):
                    right.axvspan(begin, end, color=COLORS["grey"], alpha=0.13, lw=0)
                right.set_ylabel(label)
                moving.append((right.plot([], [], "o", color=COLORS["blue"], ms=5)[0], values))
            axes[1, 1].set_xlabel("time, s")
            axes[0, 1].set_title("Shaded: the blends")
            add_note(figure, "Seen from above; link lengths 400 mm each and the side of the elbow are assumed.")
        for time, q in zip(times, joints, strict=True):
            done = int(np.searchsorted(fine.t, time, side="right"))
            elbow = ARM.upper_arm * np.array([np.cos(q[0]), np.sin(q[0])]) / MM
            tip = elbow + ARM.forearm * np.array([np.cos(q[0] + q[1]), np.sin(q[0] + q[1])]) / MM
            arm.set_data([0, elbow[0], tip[0]], [0, elbow[1], tip[1]])
            drawn.set_data(whole[:done, 0], whole[:done, 1])
            for dot, values in moving:
                dot.set_data([time], [np.interp(time, fine.t, values)])
            title.set_text(f"t = {time:.2f} s")
            yield figure
            figure.set_layout_engine("none")  # laid out by the first drawing, costly in each

    gif(folder / "motion.gif", frames(), seconds=FRAME)
