"""Figures of the blend paper, 3 to 9 and 13 to 18; mapping errors, curvature, limits; and the arm in motion."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from models import SmoothPath
from models.checks import Array
from models.paths.blends import BlendKind, polynomial
from ocp.motion.schedule import joint_motion
from scripts.drawing import COLORS, DASHES, add_note, caption, gif, legend_below, sheet
from scripts.papers.blend.example import (
    ARM,
    CENTRIPETAL,
    JOINT_LIMITS,
    MM,
    NOTE,
    PAPER_TIMES,
    PERIOD,
    POINTS,
    REMAINING,
    SPEED,
    corner,
)
from scripts.papers.blend.results import Results, exit_steps

TIME = "time, s"
JOINTS = ("shoulder", "elbow", "quill", "wrist")
MAPPINGS = {"predictor_corrector": "the paper's mapping", "gauss_newton": "Gauss-Legendre and Newton"}
SHAPES: tuple[tuple[float, BlendKind], ...] = ((1.0, "cubic"), (3.0, "cubic"), (1.5, "quintic"))
FRAME = 0.04  # s
ROUNDING = 1e-11
"""Errors below it, exact zeros too, are drawn here."""


def draw(results: Results, folder: Path) -> None:
    """Write the paper's figures, those of what it leaves out, and the animation."""
    _shapes(folder)
    _differences(folder)
    for one in (_path, _tool, _joints, _line_speed, _mapping, _curvature, _limits, _animation):
        one(folder, results)


def _corner(ax: Any, path: SmoothPath, **style: Any) -> None:
    blend = path.blend(0)
    points = path.at(np.linspace(blend.start, blend.end, 200)).position / MM
    ax.plot(points[:, 0], points[:, 1], **style)


def _legs(ax: Any, degrees: float, length: float) -> None:
    angle = np.radians(degrees)
    x, y = [-length, 0, -length * np.cos(angle)], [0, 0, length * np.sin(angle)]
    ax.plot(x, y, color=COLORS["grey"], lw=0.8, ls=DASHES[3])
    ax.set_aspect("equal", "datalim")
    ax.set_xlabel("x, mm")


def _shapes(folder: Path) -> None:
    sizes = (30, 25, 20, 15)
    title = "Figures 3, 5 and 6: shape factor, remaining length and angle determine the curve"
    with sheet(folder / "fig03_06_shapes.png", (1, 3), (8.2, 3.7), title=title) as (_, axes):
        cases = (
            ("α = 30 mm, 90° (figure 3)", 90.0, 30.0),
            ("λ = 1, 90° (figure 5)", 90.0, None),
            ("λ = 1, 45° (figure 6)", 45.0, None),
        )
        for ax, (title, degrees, alpha) in zip(axes[0], cases, strict=True):
            _legs(ax, degrees, 33)
            for size, dash in zip(sizes, DASHES, strict=True):
                _corner(
                    ax, corner(degrees, size * MM, alpha / size if alpha else 1.0), ls=dash, label=f"$L_r$ = {size} mm"
                )
            ax.set_title(title)
        axes[0, 0].set_ylabel("y, mm")
        axes[0, 0].legend(loc="upper left")
    title = (
        "Figures 4 and 7: equal shape factors yield similar curves; the greater the factor, the closer to the corner"
    )
    with sheet(folder / "fig04_07_similarity.png", (1, 2), (7.8, 4.0), title=title) as (_, axes):
        left, right = axes[0]
        _legs(left, 90, 33)
        for size, dash in ((30, DASHES[0]), (15, DASHES[1])):
            path = corner(90, size * MM, 1.0)
            middle = polynomial(path.coefficients[0], np.array(0.5)) / MM
            _corner(left, path, ls=dash, label=f"$L_r$ = {size} mm, $L_s$ = {np.hypot(*middle[:2]):.2f} mm")
            left.plot([0, middle[0]], [0, middle[1]], "o-", ms=3, lw=0.8, color=COLORS["grey"])
        left.set_title("Similar curves, γ = 0.530 (figure 4)")
        left.set_ylabel("y, mm")
        left.legend(loc="upper left")
        _legs(right, 90, 33)
        for (shape, kind), dash in zip(SHAPES, DASHES, strict=False):
            _corner(right, corner(90, 30 * MM, shape, kind), ls=dash, label=f"{kind}, λ = {shape:g}")
        right.set_title("λ = 1 and 3 (figure 7), and the quintic")
        right.legend(loc="upper left")


def _differences(folder: Path) -> None:
    note = (
        "90° corner, Lr = 30 mm, sampled at every mm along the path: V = first, A = second difference of the position."
    )
    title = "Figures 8 and 9: with λ = 1 the curvature jumps where a blend begins and ends, with λ = 3 it does not"
    titles = ("λ = 1 (figure 8)", "λ = 3 (figure 9)", "quintic, λ = 1.5")
    by_name: dict[str, Any] = {"title": title, "sharey": "row", "sharex": True}
    with sheet(folder / "fig08_09_differences.png", (2, 3), (8.2, 4.7), note, **by_name) as (_, axes):
        for column, (shape, kind), title in zip(axes.T, SHAPES, titles, strict=True):
            path = corner(90, 30 * MM, shape, kind)
            count = int(path.length / MM)
            position = path.at(np.arange(count + 1) * MM).position / MM
            first = np.diff(position, axis=0)
            second = np.diff(first, axis=0)
            blend = path.blend(0)
            for ax, values, start in ((column[0], first, 1), (column[1], second, 2)):
                for axis, dash in zip((0, 1), DASHES, strict=False):
                    ax.plot(np.arange(len(values)) + start, values[:, axis], ls=dash, label="xy"[axis])
                for edge in (blend.start, blend.end):
                    ax.axvline(edge / MM, color=COLORS["grey"], lw=0.8, ls=DASHES[3])
            column[0].set_title(title)
            column[1].set_xlabel("distance, mm")
        axes[0, 0].set_ylabel("V, mm")
        axes[1, 0].set_ylabel("A, mm")
        axes[0, 0].legend()


def _path(folder: Path, results: Results) -> None:
    """The path from above and its height, and how far its blends stay from the corners."""
    task, path = results.cubic.path, results.cubic
    s = np.linspace(0, path.length, 2000)
    smooth = path.at(s).position / MM
    off = [float(np.linalg.norm(smooth - point / MM, axis=1).min()) for point in POINTS]
    by_name: dict[str, Any] = {
        "title": f"Figure 13: two cubic blends round the path's corners, {off[1]:.0f} and {off[2]:.0f} mm inside them",
        "width_ratios": (1.25, 1),
    }
    grey = {"color": COLORS["grey"], "lw": 1.1, "ls": DASHES[3]}
    note = "Cubic blends with λ = 3, Lr = 150 mm; thick: the blends"
    with sheet(folder / "fig13_path.png", (1, 2), (8.4, 3.9), note, **by_name) as (_, axes):
        above, height = axes[0]
        done = 0.0
        for i, length in enumerate(task.lengths):
            own = np.linspace(0, length, 60)
            places = task.at(np.full(60, i), own)[0].T / MM
            above.plot(*places[:2], **grey, label="task" if i == 0 else None)
            done += length
        above.plot(*smooth[:, :2].T, color=COLORS["blue"], lw=1.4, label="path")
        height.plot(s / MM, smooth[:, 2], color=COLORS["blue"], lw=1.4)
        for begin, end in zip(path.bounds[1:5:2], path.bounds[2:5:2], strict=True):
            inside = (s >= begin) & (s <= end)
            above.plot(*smooth[inside, :2].T, color=COLORS["blue"], lw=4.0, alpha=0.6)
            height.plot(s[inside] / MM, smooth[inside, 2], color=COLORS["blue"], lw=4.0, alpha=0.6)
        above.plot(*(POINTS[:, :2].T / MM), "o", ms=4.5, color=COLORS["orange"], label="given points")
        above.set(xlabel="x, mm", ylabel="y, mm", aspect="equal", title="from above")
        above.legend(loc="best")
        height.set(xlabel="distance along the path, mm", ylabel="z, mm", title="height")


def _mark(ax: Any, edges: Array) -> None:
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        ax.axvspan(begin, end, color=COLORS["grey"], alpha=0.13, lw=0)


def _tool(folder: Path, results: Results) -> None:
    plan, path = results.mean, results.cubic
    t = np.linspace(0, plan.duration, 2001)
    motion = plan.at(t)
    place = path.at(motion.distance)
    edges = plan.time_at(path.bounds[1:5])
    velocity = place.tangent * motion.speed[:, None]
    acceleration = place.curvature * motion.speed[:, None] ** 2 + place.tangent * motion.acceleration[:, None]
    paper = ", ".join(f"{time:.3f}" for time in PAPER_TIMES)
    ours = ", ".join(f"{time:.4f}" for time in edges)
    note = f"Shaded: the blends. They begin and end at {ours} s; printed: {paper} s."
    title = "Figure 14: the tool's position"
    with sheet(folder / "fig14_position.png", (1, 1), (6.3, 3.6), note, title=title) as (_, axes):
        for i, dash in zip(range(3), DASHES, strict=False):
            axes[0, 0].plot(t, place.position[:, i] / MM, ls=dash, label="xyz"[i])
        _mark(axes[0, 0], edges)
        axes[0, 0].set(xlabel=TIME, ylabel="position, mm")
        axes[0, 0].legend()
    title = "Figure 15: the tool's velocity and acceleration"
    with sheet(folder / "fig15_velocity.png", (1, 2), (8.2, 3.7), note, title=title) as (_, axes):
        for ax, values, label in zip(
            axes[0], (velocity, acceleration), ("velocity, mm/s", "acceleration, m/s²"), strict=True
        ):
            scale = MM if "mm" in label else 1.0
            for i, dash in zip(range(3), DASHES, strict=False):
                ax.plot(t, values[:, i] / scale, ls=dash, label="xyz"[i])
            _mark(ax, edges)
            ax.set(xlabel=TIME, ylabel=label)
        axes[0, 0].set_title("velocity")
        axes[0, 1].set_title("acceleration")
        axes[0, 0].legend()


def _joints(folder: Path, results: Results) -> None:
    plan = results.mean
    t = np.linspace(0, plan.duration, 4001)
    position, velocity, acceleration, _ = joint_motion(results.joints, plan.at(t))
    edges = plan.time_at(results.cubic.bounds[1:5])
    kinds: tuple[tuple[str, str, tuple[Array, ...], tuple[str, ...], tuple[str, ...]], ...] = (
        (
            "fig16_joint_angles.png",
            "Figure 16: the joints follow the blended path smoothly",
            (position,),
            ("angle, deg",),
            ("quill, mm",),
        ),
        (
            "fig17_joint_rates.png",
            "Figure 17: joint rates are smooth, their derivatives have kinks where blends begin and end",
            (velocity, acceleration),
            ("velocity, deg/s", "acceleration, deg/s²"),
            ("quill, mm/s", "quill, mm/s²"),
        ),
    )
    for file, title, values, labels, quills in kinds:
        shape, size = (len(values), 2), (8.2, 2.9 * len(values))
        by_name: dict[str, Any] = {"title": title, "sharex": True, "xlabel": TIME}
        with sheet(folder / file, shape, (size[0], size[1] + 0.3), NOTE, **by_name) as (_, axes):
            for row, value, label, quill in zip(axes, values, labels, quills, strict=True):
                for joint, dash in zip((0, 1, 3), DASHES, strict=False):
                    row[0].plot(t, np.degrees(value[:, joint]), ls=dash, label=JOINTS[joint])
                row[1].plot(t, value[:, 2] / MM)
                row[0].set_ylabel(label)
                row[1].set_ylabel(quill)
                for ax in row:
                    _mark(ax, edges)
            axes[0, 0].set_title("shoulder, elbow, wrist")
            axes[0, 1].set_title("quill, the vertical axis")
            axes[0, 0].legend()


def _line_speed(folder: Path, results: Results) -> None:
    plan, path = results.mean, results.cubic
    motion = plan.sample(PERIOD)
    points = path.at(motion.distance).position
    step = np.diff(motion.t)
    speed = np.linalg.norm(np.diff(points, axis=0), axis=1) / step
    middle = (motion.t[1:] + motion.t[:-1]) / 2
    acceleration = np.diff(speed) / np.diff(middle)
    edges = plan.time_at(path.bounds[1:5])
    exits = exit_steps(results)
    mapped, ours = (float(np.abs(_within(results, edges, mapping)).max()) for mapping in MAPPINGS)
    by_name: dict[str, Any] = {
        "title": f"Figure 18: on the blends the line speed stays within {ours:.2g} mm/s of 1000 mm/s, by the paper's "
        f"mapping within {mapped:.2g} mm/s"
    }
    note = (
        "Differences of positions 2 ms apart; shaded: the blends. Right: speed minus planned speed. The default "
        "mapping leaves only the difference between chord and arc. The paper's mapping drifts, which appears as one "
        f"step of {exits[0]:+.1f} and {exits[1]:+.1f} mm/s (beyond the axis) where its blends end."
    )
    with sheet(folder / "fig18_line_speed.png", (1, 3), (9.4, 3.8), note, **by_name) as (_, axes):
        left, centre, right = axes[0]
        left.plot(middle, speed / MM)
        left.set(xlabel=TIME, ylabel="line speed, mm/s", title="line speed")
        centre.plot(motion.t[1:-1], acceleration)
        centre.set(xlabel=TIME, ylabel="line acceleration, m/s²", title="line acceleration")
        for (mapping, name), color, dash in zip(MAPPINGS.items(), ("orange", "blue"), DASHES, strict=False):
            right.plot(results.speed_error_times, results.speed_errors[mapping], COLORS[color], ls=dash, label=name)
        right.set(xlabel=TIME, ylabel="line speed error, mm/s", ylim=(-0.95, 0.2), title="speed minus planned speed")
        right.legend(loc="lower left")
        for ax in axes[0]:
            _mark(ax, edges)


def _within(results: Results, edges: Array, mapping: str) -> Array:
    """Errors of the line speed by a mapping inside the blends, but for the steps at their ends, mm/s."""
    t, errors = np.asarray(results.speed_error_times), np.asarray(results.speed_errors[mapping])
    inside = np.zeros(len(t), dtype=bool)
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        inside |= (t > begin + 2 * PERIOD) & (t < end - 2 * PERIOD)
    return np.asarray(errors[inside])


def _mapping(folder: Path, results: Results) -> None:
    note = "90° corner at 1000 mm/s; cubic with λ = 3, quintic with λ = 1.5. Below 1e-9 the curves show rounding."
    title = "The smaller the blend, the more the paper's mapping drifts; Gauss-Legendre and Newton hardly do"
    by_name: dict[str, Any] = {"title": title, "sharex": True, "sharey": "row"}
    with sheet(folder / "mapping_errors.png", (2, 2), (8.6, 6.1), note, **by_name) as (figure, axes):
        for row, key, label in (
            (axes[0], "drift_um", "|drift| at the blend's end, µm"),
            (axes[1], "true_speed_error_mm_s", "worst |speed error|, mm/s"),
        ):
            row[0].set_ylabel(label)
            for ax, kind in zip(row, ("cubic", "quintic"), strict=True):
                for (mapping, name), color in zip(MAPPINGS.items(), ("orange", "blue"), strict=True):
                    for period, dash, marker in zip((1, 2, 4), DASHES, "osD", strict=False):
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
        legend_below(figure, axes[0, 0].get_legend_handles_labels()[0], 2)


def _curvature(folder: Path, results: Results) -> None:
    title = "The cubic's curvature jumps where a blend meets the arc, the quintic's does not"
    with sheet(folder / "curvature.png", (1, 1), (6.6, 3.6), title=title) as (_, axes):
        ax = axes[0, 0]
        kinds = ((results.cubic, "orange", DASHES[0]), (results.quintic, "blue", DASHES[1]))
        for (path, color, dash), name in zip(kinds, ("cubic, λ = 3", "quintic, λ = 1.5"), strict=True):
            s = np.unique(np.concatenate([np.linspace(0, path.length, 6001), path.bounds, path.bounds[1:-1] - 1e-9]))
            ax.plot(s / MM, path.curvature(s) * MM * REMAINING / MM, color=COLORS[color], ls=dash, label=name)
        ax.set(xlabel="distance, mm", ylabel="curvature × $L_r$")
        ax.legend(loc="upper left")
        jump = results.cubic.curvature_jumps()
        at = int(jump.argmax())
        inset = ax.inset_axes((0.74, 0.42, 0.24, 0.42))
        place = results.cubic.bounds[at + 1]
        for path, color, dash in kinds:
            centre = path.bounds[at + 1]
            for side in (np.linspace(-0.012, -1e-9, 60), np.linspace(0, 0.012, 60)):
                inset.plot(side / MM, path.curvature(centre + side) * REMAINING, ls=dash, color=COLORS[color])
        inset.set_title(f"end at {place / MM:.0f} mm", fontsize=7)
        inset.tick_params(labelsize=6)


def _limits(folder: Path, results: Results) -> None:
    note = (
        "Thick: the schedule; thin: by optimal control. Its jerk is held over intervals, which costs up to 1 %. "
        f"Centripetal acceleration at most "
        f"{CENTRIPETAL:g} m/s². Joint limits (chosen) of shoulder, elbow, quill, wrist: {joint_limits()}. "
        "The curvature of the cubic blend jumps, so that no joint jerk limit can be satisfied."
    )
    title = "The limits determine the duration: curvature and joints require a lower speed in the blends"
    with sheet(folder / "limits.png", (2, 2), (9.0, 5.9), note, title=title, sharey="row") as (_, axes):
        for (upper, lower), kind in zip(axes.T, ("cubic", "quintic"), strict=True):
            mine = {name: plan for name, plan in results.plans.items() if name.startswith(kind)}
            for (name, plan), color, dash in zip(mine.items(), ("grey", "blue", "green"), DASHES, strict=False):
                durations = f"{plan.schedule.duration:.3f} s, optimal control {plan.fastest.duration:.3f} s"
                label = f"{name.split(', ')[1]}: {durations}"
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
            lower.axhline(CENTRIPETAL, color=COLORS["black"], lw=0.8, ls=DASHES[3])
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


def _animation(folder: Path, results: Results) -> None:
    """The arm drawing the path, in real time."""
    plan = results.mean
    times = np.append(np.arange(0, plan.duration, FRAME), plan.duration)
    motion = plan.at(times)
    joints = results.joints.at(motion.distance).position
    fine = plan.at(np.linspace(0, plan.duration, 1001))
    whole = results.cubic.at(fine.distance).position / MM
    edges = plan.time_at(results.cubic.bounds[1:5])

    with sheet(None, (2, 2), (8.0, 4.4), width_ratios=(1.5, 1), sharex="col") as (figure, axes):
        figure.set_dpi(90)
        for ax in axes[:, 0]:
            ax.remove()
        ax = figure.add_subplot(axes[0, 0].get_gridspec()[:, 0])
        ax.plot(whole[:, 0], whole[:, 1], color=COLORS["grey"], lw=0.8, ls=DASHES[3], label="path")
        (picture,) = ax.plot([], [], color=COLORS["green"], lw=2, label="drawn")
        (arm,) = ax.plot([], [], "o-", color=COLORS["blue"], lw=5, ms=8, mfc="white", alpha=0.8, label="arm")
        ax.set_aspect("equal")
        ax.set(xlim=(-480, 860), ylim=(-60, 800), xlabel="x, mm", ylabel="y, mm")
        ax.legend(loc="upper right")
        title = ax.set_title("")
        moving: list[tuple[Any, Any]] = []
        rows = ((axes[0, 1], fine.speed / MM, "line speed, mm/s"), (axes[1, 1], whole[:, 2], "height z, mm"))
        for right, values, label in rows:
            right.plot(fine.t, values, color=COLORS["grey"], lw=0.8)
            _mark(right, edges)
            right.set_ylabel(label)
            moving.append((right.plot([], [], "o", color=COLORS["blue"], ms=5)[0], values))
        axes[1, 1].set_xlabel(TIME)
        axes[0, 1].set_title("Shaded: the blends")
        add_note(figure, "Seen from above; link lengths 400 mm each and the side of the elbow are assumed")

    def frames() -> Iterator[Figure]:
        for time, q in zip(times, joints, strict=True):
            done = int(np.searchsorted(fine.t, time, side="right"))
            elbow = ARM.upper_arm * np.array([np.cos(q[0]), np.sin(q[0])]) / MM
            tip = elbow + ARM.forearm * np.array([np.cos(q[0] + q[1]), np.sin(q[0] + q[1])]) / MM
            arm.set_data([0, elbow[0], tip[0]], [0, elbow[1], tip[1]])
            picture.set_data(whole[:done, 0], whole[:done, 1])
            for dot, values in moving:
                dot.set_data([time], [np.interp(time, fine.t, values)])
            title.set_text(f"t = {time:.2f} s")
            yield figure

    artists = [picture, arm, *(dot for dot, _ in moving), title]
    gif(folder / "motion.gif", frames(), seconds=FRAME, moving=artists)
    caption(folder / "motion.gif", "A SCARA arm follows the path with its two blends, in real time", NOTE)
