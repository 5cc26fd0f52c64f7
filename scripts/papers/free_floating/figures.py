"""Figures of the free-floating paper: 3 to 13, the convergence of the methods, the false optima, the animation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure

from models import FreeFloating
from scripts.drawing import COLORS, DASHES, Row, add_note, gif, sheet
from scripts.papers.free_floating.false_optima import EXTREMAL, FALSE, HORIZON, Trial
from scripts.papers.free_floating.motion import Array, Motion, outline

__all__ = ["draw", "draw_animation", "draw_convergence", "draw_false_optima"]

PLATE = 2.0  # side of the base, m; printed
VIRIDIS: Any = matplotlib.colormaps["viridis"]
TIME_COLORS = ListedColormap(VIRIDIS(np.linspace(0.0, 0.88, 256)))  # its yellow is too pale
STROBE = 0.5  # s between two pictures of the arm
NAMES = ("pseudo-inverse", "optimum")
FRAME = 0.05  # s between two frames of the animation


def draw(folder: Path, machine: FreeFloating, local: Motion, optimal: Motion, note: str) -> None:
    """Write the figures of both motions, the paper's two of a kind side by side on equal axes."""
    motions = (local, optimal)
    with sheet(folder / "fig03_08_motion.png", columns=2, size=(8.2, 5.2), note=note, sharey=True) as (figure, axes):
        for ax, motion, name, number in zip(axes[0], motions, NAMES, (3, 8), strict=True):
            _strobe(ax, machine, motion)
            ax.set_title(f"{name} (figure {number})")
            ax.set_xlabel("x, m")
        axes[0, 0].set_ylabel("y, m")
        axes[0, 0].legend(loc="lower right")
        _time_bar(figure, axes, local.t[-1])
    with sheet(folder / "optimal_motion.png", size=(4.6, 5.4), note=note) as (figure, axes):
        _strobe(axes[0, 0], machine, optimal)
        axes[0, 0].set(xlabel="x, m", ylabel="y, m", title="Optimal motion on a free-floating base")
        axes[0, 0].legend(loc="lower right")
        _time_bar(figure, axes, optimal.t[-1])

    joints = [f"joint {i + 1}" for i in range(local.joints.shape[1])]
    _pose(folder / "fig04_09_base_pose.png", motions, (4, 9), lambda m: m.base, ("position, m", "angle, deg"), note)
    units = ("velocity, m/s", "angular velocity, deg/s")
    _pose(folder / "fig06_11_base_velocity.png", motions, (6, 11), lambda m: m.base_rates, units, note)
    kinds: tuple[tuple[str, tuple[int, int], Callable[[Motion], Array], str], ...] = (
        ("fig05_10_joint_angles.png", (5, 10), lambda m: m.joints, "joint angle, deg"),
        ("fig07_12_joint_velocity.png", (7, 12), lambda m: m.joint_rates, "joint velocity, deg/s"),
    )
    for file, numbers, of, label in kinds:
        with sheet(folder / file, columns=2, size=(8.2, 3.3), note=note, sharey=True) as (_, axes):
            for ax, motion, name, number in zip(axes[0], motions, NAMES, numbers, strict=True):
                _curves(ax, motion.t, np.degrees(of(motion)), joints)
                ax.set(title=f"{name} (figure {number})", xlabel="time, s")
            axes[0, 0].set_ylabel(label)
            axes[0, 0].legend(loc="best")

    with sheet(folder / "fig13_manipulability.png", size=(6.3, 3.4), note=note) as (_, axes):
        ax = axes[0, 0]
        for motion, name, color, dash in zip(motions, NAMES, ("orange", "blue"), DASHES[1::-1], strict=True):
            ax.plot(motion.t, motion.manipulability, color=COLORS[color], ls=dash, label=name)
        least = int(local.manipulability.argmin())
        where = (local.t[least], local.manipulability[least])
        ax.plot(*where, "o", color=COLORS["orange"], ms=4)
        text = f"{where[1]:.3f} at {where[0]:.3f} s"
        ax.annotate(text, where, xytext=(-8, 2), textcoords="offset points", fontsize=8, ha="right")
        ax.set(xlabel="time, s", ylabel="manipulability $\\sqrt{\\det GG^T}$, m$^2$", ylim=(0, None))
        ax.set_xlim(local.t[0], local.t[-1])
        ax.set_title("Manipulability (figure 13)")
        ax.legend(loc="best")


def draw_convergence(folder: Path, rows: Sequence[Row], note: str) -> None:
    """Distance of the cost from the reference against the number of intervals, one curve a method."""
    with sheet(folder / "convergence.png", size=(8.2, 3.8), note=note) as (_, axes):
        ax = axes[0, 0]
        direct = [row for row in rows if row["intervals"] and row["order"]]
        colors = ("blue", "green", "orange", "purple")
        for method, color, marker, dash in zip(_methods(direct), colors, "osD^", DASHES, strict=True):
            mine = [row for row in direct if row["method"] == method]
            intervals = [row["intervals"] for row in mine]
            errors = [abs(row["difference"]) for row in mine]
            label = f"{method}, order {mine[0]['order']}"
            ax.loglog(intervals, errors, marker=marker, ms=4.5, color=COLORS[color], ls=dash, label=label)
        ax.set_xticks([25, 50, 100, 200], ["25", "50", "100", "200"])
        ax.set_xticks([], minor=True)
        ax.set(xlabel="intervals", ylabel="|J − J$_{ref}$|, rad$^2$/s", title="Convergence of the cost, horizon 5 s")
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def draw_false_optima(folder: Path, trials: Sequence[Trial], note: str) -> None:
    """Cost and largest jump of every plan that the solver calls optimal, and what such a jump looks like."""
    passed = [t for t in trials if t.audit]
    false = sorted((t for t in trials if t.verdict == FALSE), key=lambda t: t.cost)
    with sheet(folder / "false_optima.png", columns=2, size=(8.2, 3.7), note=note) as (_, axes):
        left, right = axes[0]
        kinds = {
            "passes its audit": (passed, "o", "blue"),
            "sound, but fails: mesh too coarse": (
                [t for t in trials if not t.audit and t.verdict not in (FALSE, EXTREMAL)],
                "s",
                "green",
            ),
            "fails its audit: false optimum": (false, "x", "orange"),
        }
        for label, (mine, marker, color) in kinds.items():
            if mine:
                costs, jumps = [t.cost for t in mine], [t.jump_deg_s for t in mine]
                left.loglog(jumps, costs, marker, color=COLORS[color], ms=6, label=f"{label} ({len(mine)})")
        reached = Counter(f"{t.cost:.5f}" for t in passed)
        text = "\n".join(f"J = {cost}: {count} times" for cost, count in sorted(reached.items()))
        left.text(0.3, 0.03, text, transform=left.transAxes, fontsize=8, color=COLORS["blue"])
        left.set(xlabel="largest jump of a joint velocity, deg/s", ylabel="cost J, rad$^2$/s")
        left.set_title(f"{len(trials)} plans that the solver calls optimal")
        left.legend(loc="upper left")
        if false:
            shown = false[len(false) // 2]
            names = [f"joint {i + 1}" for i in range(shown.joint_rates.shape[1])]
            _curves(right, shown.t, np.degrees(shown.joint_rates), names)
            guess = "constant guess" if shown.seed < 0 else f"{shown.guess} guess, seed {shown.seed}"
            right.set_title(f"one that fails: {guess}, J = {shown.cost:.1f}")
            right.set(xlabel="time, s", ylabel="joint velocity, deg/s", xlim=(0, HORIZON))
            right.legend(loc="best")


def draw_animation(
    folder: Path,
    machine: FreeFloating,
    local: Motion,
    optimal: Motion,
    note: str,
    progress: Callable[[Iterable[float]], Iterable[float]],
) -> None:
    """Both motions side by side in real time, above their joint velocities."""
    times = np.arange(0.0, local.t[-1] + FRAME / 2, FRAME)
    with sheet(None, rows=2, columns=2, size=(5.0, 4.9), sharey="row", height_ratios=(3, 1)) as (figure, axes):
        moving = [_animated(axes[:, i], machine, m, NAMES[i]) for i, m in enumerate((local, optimal))]
        axes[0, 0].set_ylabel("y, m")
        axes[1, 0].set_ylabel("joint rates, deg/s")
        curves = axes[1, 1].lines[: local.joints.shape[1]]
        names = [f"joint {i + 1}" for i in range(len(curves))]
        axes[1, 1].legend(curves, names, loc="upper right", fontsize=6, ncols=3, columnspacing=0.8, handlelength=1.8)
        title = figure.suptitle("time 0.00 s", fontsize=9)
        add_note(figure, note)  # now, not when the block ends: the frames are drawn before
        figure.canvas.draw()
        figure.set_layout_engine("none")  # as laid out now: nothing that moves changes it, and it takes half the time

        def frames() -> Iterator[Figure]:
            for time in progress(times.tolist()):
                for show in moving:
                    show(time)
                title.set_text(f"time {time:.2f} s")
                yield figure

        gif(folder / "motion.gif", frames(), seconds=FRAME)


def _pose(
    path: Path,
    motions: tuple[Motion, Motion],
    numbers: tuple[int, int],
    of: Callable[[Motion], Array],
    labels: tuple[str, str],
    note: str,
) -> None:
    """Two rows of axes: translation above rotation, of both motions."""
    with sheet(path, rows=2, columns=2, size=(8.2, 4.6), note=note, sharex=True, sharey="row") as (_, axes):
        for column, motion, name, number in zip(axes.T, motions, NAMES, numbers, strict=True):
            values = of(motion)
            _curves(column[0], motion.t, values[:, :2], ["x", "y"])
            _curves(column[1], motion.t, np.degrees(values[:, 2:]), ["angle"])
            column[0].set_title(f"{name} (figure {number})")
            column[1].set_xlabel("time, s")
        for ax, label in zip(axes[:, 0], labels, strict=True):
            ax.set_ylabel(label)
        axes[0, 0].legend(loc="best")


def _curves(ax: Any, t: Array, values: Array, names: Sequence[str]) -> None:
    for column, name, dash in zip(values.T, names, DASHES, strict=False):
        ax.plot(t, column, ls=dash, label=name)
    ax.set_xlim(t[0], t[-1])


def _strobe(ax: Any, machine: FreeFloating, motion: Motion) -> None:
    shape = outline(machine, PLATE)
    horizon = motion.t[-1]
    ax.plot(*motion.tip_in_world.T, color=COLORS["black"], ls=(0, (4, 2)), lw=1.0, label="path of the tip", zorder=4)
    for time in np.arange(0.0, horizon + STROBE / 2, STROBE):
        k = motion.at(time)
        color = TIME_COLORS(time / horizon)
        square, arm = shape(motion.base[k], motion.joints[k])
        ends = time in (0.0, horizon)  # the base hardly moves: only its first and last place stand out
        ax.fill(*square.T, facecolor="none", edgecolor=color, lw=1.4 if ends else 0.7, alpha=1.0 if ends else 0.45)
        ax.plot(*arm.T, "-o", color=color, lw=1.6, ms=3, solid_capstyle="round")
        ax.plot(*arm[-1], "o", color=color, ms=5, markeredgecolor="white", markeredgewidth=0.6, zorder=5)
    ax.set_aspect("equal")


def _time_bar(figure: Figure, axes: Any, horizon: float) -> None:
    scale = ScalarMappable(Normalize(0.0, horizon), TIME_COLORS)
    figure.colorbar(scale, ax=axes, label="time, s", fraction=0.04, pad=0.02)


def _methods(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(str(row["method"]) for row in rows))


def _animated(column: Any, machine: FreeFloating, motion: Motion, name: str) -> Callable[[float], None]:
    """Draw one motion's still parts; the returned function moves the others to a time."""
    above, below = column
    shape = outline(machine, PLATE)
    corners = [shape(b, q) for b, q in zip(motion.base[::50], motion.joints[::50], strict=True)]
    everything = np.vstack([np.vstack(parts) for parts in corners])
    (low_x, low_y), (high_x, high_y) = everything.min(axis=0) - 0.3, everything.max(axis=0) + 0.3
    above.plot(*motion.tip_in_world.T, color=COLORS["grey"], ls=(0, (4, 2)), lw=0.8)
    (trace,) = above.plot([], [], color=COLORS["orange"], lw=2.0)
    (plate,) = above.plot([], [], color=COLORS["grey"], lw=1.4)
    (links,) = above.plot([], [], "-o", color=COLORS["black"], lw=2.2, ms=4)
    above.set(xlim=(low_x, high_x), ylim=(low_y, high_y), aspect="equal", xlabel="x, m")
    above.set_title(name, fontsize=9)
    _curves(below, motion.t, np.degrees(motion.joint_rates), ["1", "2", "3"])
    cursor = below.axvline(0.0, color=COLORS["black"], lw=0.9)
    below.set_xlabel("time, s")

    def show(time: float) -> None:
        k = motion.at(time)
        square, arm = shape(motion.base[k], motion.joints[k])
        plate.set_data(*square.T)
        links.set_data(*arm.T)
        trace.set_data(*motion.tip_in_world[: k + 1].T)
        cursor.set_xdata([motion.t[k]])

    return show
