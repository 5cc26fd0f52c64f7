"""Figures of the blend paper, 3 to 9 and 13 to 18."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from models.paths import SmoothPath
from models.paths.blends import BlendKind, polynomial
from ocp.schedule import joint_motion
from scripts.drawing import COLORS, DASHES, sheet
from scripts.papers.blend.example import MM, NOTE, PAPER_TIMES, PERIOD, POINTS, Array, corner
from scripts.papers.blend.results import Results, exit_steps

__all__ = ["LINES", "MAPPINGS", "draw_paper"]

TIME = "time, s"
LINES: tuple[Any, ...] = DASHES
JOINTS = ("shoulder", "elbow", "quill", "wrist")
MAPPINGS = {"predictor_corrector": "the paper's mapping", "gauss_newton": "Gauss-Legendre and Newton"}


def draw_paper(folder: Path, results: Results) -> None:
    """Write the paper's figures."""
    _shapes(folder)
    _differences(folder)
    _path(folder, results)
    _tool(folder, results)
    _joints(folder, results)
    _line_speed(folder, results)


SHAPES: tuple[tuple[float, BlendKind], ...] = ((1.0, "cubic"), (3.0, "cubic"), (1.5, "quintic"))


def _corner(ax: Any, path: SmoothPath, **style: Any) -> None:
    blend = path.blend(0)
    points = path.at(np.linspace(blend.start, blend.end, 200)).position / MM
    ax.plot(points[:, 0], points[:, 1], **style)


def _legs(ax: Any, degrees: float, length: float) -> None:
    angle = np.radians(degrees)
    x, y = [-length, 0, -length * np.cos(angle)], [0, 0, length * np.sin(angle)]
    ax.plot(x, y, color=COLORS["grey"], lw=0.8, ls=LINES[3])
    ax.set_aspect("equal", "datalim")
    ax.set_xlabel("x, mm")


def _shapes(folder: Path) -> None:
    sizes = (30, 25, 20, 15)
    with sheet(folder / "fig03_06_shapes.png", columns=3, size=(8.2, 3.4)) as (_, axes):
        cases = (
            ("α = 30 mm, 90° (figure 3)", 90.0, 30.0),
            ("λ = 1, 90° (figure 5)", 90.0, None),
            ("λ = 1, 45° (figure 6)", 45.0, None),
        )
        for ax, (title, degrees, alpha) in zip(axes[0], cases, strict=True):
            _legs(ax, degrees, 33)
            for size, dash in zip(sizes, LINES, strict=True):
                _corner(
                    ax, corner(degrees, size * MM, alpha / size if alpha else 1.0), ls=dash, label=f"$L_r$ = {size} mm"
                )
            ax.set_title(title)
        axes[0, 0].set_ylabel("y, mm")
        axes[0, 0].legend(loc="upper left")
    with sheet(folder / "fig04_07_similarity.png", columns=2, size=(7.4, 3.6)) as (_, axes):
        left, right = axes[0]
        _legs(left, 90, 33)
        for size, dash in ((30, LINES[0]), (15, LINES[1])):
            path = corner(90, size * MM, 1.0)
            middle = polynomial(path.coefficients[0], np.array(0.5)) / MM
            _corner(left, path, ls=dash, label=f"$L_r$ = {size} mm, $L_s$ = {np.hypot(*middle[:2]):.2f} mm")
            left.plot([0, middle[0]], [0, middle[1]], "o-", ms=3, lw=0.8, color=COLORS["grey"])
        left.set_title("Similar curves, γ = 0.530 (figure 4)")
        left.set_ylabel("y, mm")
        left.legend(loc="upper left")
        _legs(right, 90, 33)
        for (shape, kind), dash in zip(SHAPES, LINES, strict=False):
            _corner(right, corner(90, 30 * MM, shape, kind), ls=dash, label=f"{kind}, λ = {shape:g}")
        right.set_title("λ = 1 and 3 (figure 7), and the quintic")
        right.legend(loc="upper left")


def _differences(folder: Path) -> None:
    note = (
        "90° corner, Lr = 30 mm, sampled at every mm along the path: V = first, A = second difference of the position."
    )
    titles = ("λ = 1 (figure 8)", "λ = 3 (figure 9)", "quintic, λ = 1.5")
    with sheet(
        folder / "fig08_09_differences.png", rows=2, columns=3, size=(8.2, 4.4), note=note, sharey="row", sharex=True
    ) as (_, axes):
        for column, (shape, kind), title in zip(axes.T, SHAPES, titles, strict=True):
            path = corner(90, 30 * MM, shape, kind)
            count = int(path.length / MM)
            position = path.at(np.arange(count + 1) * MM).position / MM
            first = np.diff(position, axis=0)
            second = np.diff(first, axis=0)
            blend = path.blend(0)
            for ax, values, start in ((column[0], first, 1), (column[1], second, 2)):
                for axis, dash in zip((0, 1), LINES, strict=False):
                    ax.plot(np.arange(len(values)) + start, values[:, axis], ls=dash, label="xy"[axis])
                for edge in (blend.start, blend.end):
                    ax.axvline(edge / MM, color=COLORS["grey"], lw=0.8, ls=LINES[3])
            column[0].set_title(title)
            column[1].set_xlabel("distance, mm")
        axes[0, 0].set_ylabel("V, mm")
        axes[1, 0].set_ylabel("A, mm")
        axes[0, 0].legend()


def _path(folder: Path, results: Results) -> None:
    task = results.cubic.path
    grey = {"color": COLORS["grey"], "lw": 0.9, "ls": LINES[3]}
    note = "Heights are drawn four times as large as the other lengths."
    kind = {"projection": "3d"}
    with sheet(folder / "fig13_path.png", size=(6.0, 4.2), note=note, subplot_kw=kind) as (_, axes):
        ax = axes[0, 0]
        for i, length in enumerate(task.lengths):
            s = np.linspace(0, length, 60)
            ax.plot(*(task.at(np.full(60, i), s)[0].T / MM), **grey, label="task" if i == 0 else None)
        smooth = results.cubic.at(np.linspace(0, results.cubic.length, 800)).position / MM
        ax.plot(*smooth.T, color=COLORS["blue"], label="cubic blends, λ = 3, $L_r$ = 150 mm")
        ax.plot(*(POINTS.T / MM), "o", ms=3.5, color=COLORS["orange"], label="given points")
        ax.set(xlabel="x, mm", ylabel="y, mm", title="Global path (figure 13)")
        ax.set_zlabel("z, mm")
        spans = [np.ptp(limits) for limits in (ax.get_xlim(), ax.get_ylim(), ax.get_zlim())]
        ax.set_box_aspect((spans[0], spans[1], 4 * spans[2]), zoom=1.1)
        ax.set_zticks([0, 20, 40, 60])
        ax.view_init(32, -62)
        ax.legend(loc="upper left")


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
    note = f"Shaded: the blends, which begin and end at {ours} s; printed: {paper} s."
    with sheet(folder / "fig14_position.png", size=(6.3, 3.4), note=note) as (_, axes):
        for i, dash in zip(range(3), LINES, strict=False):
            axes[0, 0].plot(t, place.position[:, i] / MM, ls=dash, label="xyz"[i])
        _mark(axes[0, 0], edges)
        axes[0, 0].set(xlabel=TIME, ylabel="position, mm", title="Tool position (figure 14)")
        axes[0, 0].legend()
    with sheet(folder / "fig15_velocity.png", columns=2, size=(8.2, 3.4), note=note) as (_, axes):
        for ax, values, label in zip(
            axes[0], (velocity, acceleration), ("velocity, mm/s", "acceleration, m/s²"), strict=True
        ):
            scale = MM if "mm" in label else 1.0
            for i, dash in zip(range(3), LINES, strict=False):
                ax.plot(t, values[:, i] / scale, ls=dash, label="xyz"[i])
            _mark(ax, edges)
            ax.set(xlabel=TIME, ylabel=label)
        axes[0, 0].set_title("Tool velocity (figure 15)")
        axes[0, 1].set_title("Tool acceleration (figure 15)")
        axes[0, 0].legend()


def _joints(folder: Path, results: Results) -> None:
    plan = results.mean
    t = np.linspace(0, plan.duration, 4001)
    position, velocity, acceleration, _ = joint_motion(results.joints, plan.at(t))
    edges = plan.time_at(results.cubic.bounds[1:5])
    kinds: tuple[tuple[str, str, tuple[Array, ...], tuple[str, ...], tuple[str, ...]], ...] = (
        ("fig16_joint_angles.png", "Joint angles (figure 16)", (position,), ("angle, deg",), ("quill, mm",)),
        (
            "fig17_joint_rates.png",
            "Joint rates (figure 17)",
            (velocity, acceleration),
            ("velocity, deg/s", "acceleration, deg/s²"),
            ("quill, mm/s", "quill, mm/s²"),
        ),
    )
    for file, title, values, labels, quills in kinds:
        with sheet(
            folder / file, rows=len(values), columns=2, size=(8.2, 2.9 * len(values)), note=NOTE, sharex=True
        ) as (_, axes):
            for row, value, label, quill in zip(axes, values, labels, quills, strict=True):
                for joint, dash in zip((0, 1, 3), LINES, strict=False):
                    row[0].plot(t, np.degrees(value[:, joint]), ls=dash, label=JOINTS[joint])
                row[1].plot(t, value[:, 2] / MM)
                row[0].set_ylabel(label)
                row[1].set_ylabel(quill)
                for ax in row:
                    _mark(ax, edges)
            axes[0, 0].set_title(title)
            axes[0, 1].set_title("Quill, the vertical axis")
            axes[0, 0].legend()
            for ax in axes[-1]:
                ax.set_xlabel(TIME)


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
    note = (
        "Differences of positions 2 ms apart. Shaded: the blends. Right: speed less the planned one; the default "
        "mapping leaves the chord against the arc alone, the paper's drifts, which shows as one step of "
        f"{exits[0]:+.1f} and {exits[1]:+.1f} mm/s (beyond the axis) where its blends end."
    )
    with sheet(folder / "fig18_line_speed.png", columns=3, size=(9.4, 3.4), note=note) as (_, axes):
        left, centre, right = axes[0]
        left.plot(middle, speed / MM)
        left.set(xlabel=TIME, ylabel="line speed, mm/s", title="Line speed (figure 18)")
        centre.plot(motion.t[1:-1], acceleration)
        centre.set(xlabel=TIME, ylabel="line acceleration, m/s²", title="Line acceleration (figure 18)")
        for (mapping, name), color, dash in zip(MAPPINGS.items(), ("orange", "blue"), LINES, strict=False):
            right.plot(results.speed_error_times, results.speed_errors[mapping], COLORS[color], ls=dash, label=name)
        right.set(xlabel=TIME, ylabel="line speed error, mm/s", ylim=(-0.75, 0.2), title="Speed error, enlarged")
        right.legend(loc="lower left")
        for ax in axes[0]:
            _mark(ax, edges)
