"""Figures of the free-floating paper: 3 to 13, and what makes the plan an optimum.

Convergence of the methods, false optima, costates, Hamiltonian, the extremals at other horizons, the animation.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure

from models import FreeFloating
from models.checks import Array
from scripts.drawing import COLORS, DASHES, TIME_COLORS, add_note, caption, draw_arm, gif, sheet, time_bar
from scripts.papers.free_floating.extremals import CONFIRMED, NOT_GLOBAL, Search
from scripts.papers.free_floating.false_optima import EXTREMAL, FALSE, HORIZON, Trial
from scripts.papers.free_floating.motion import Motion, outline
from scripts.papers.free_floating.optimality import Agreement, costate_difference, costates, hamiltonians
from scripts.papers.free_floating.results import ASSUMED, NOTE, Results
from scripts.papers.run import Row, progress

Quantity: TypeAlias = tuple[str, Sequence[str], Callable[[Motion], Array]]
"""Label, names of the columns, and the columns of a motion."""

PLATE = 2.0  # side of the base, m; printed
STROBE = 1.0  # s between two pictures of the arm
NAMES = ("pseudo-inverse", "optimum")
FRAME = 0.05  # s between two frames of the animation
PARTS = (("base", ("x", "y", "angle")), ("joints", ("joint 1", "joint 2", "joint 3")))
PALETTE = ("blue", "orange", "green")
MARKED = 16  # reported points between two markers of the direct solution
FLOOR = 1e-17  # a logarithm needs more than zero
BINS = 100
PANEL, LINE = 170.0, 9.5  # height of the panel of costs, and of a line of its labels, points


def draw(results: Results, folder: Path) -> None:
    """Write every figure and the animation."""
    _motions(folder, results.machine, results.local, results.optimal)
    _convergence(folder, results.convergence)
    _false_optima(folder, results.trials)
    _costates(folder, results.agreement)
    _hamiltonian(folder, results.agreement)
    _extremals(folder, results.searches)
    _animation(folder, results.machine, results.local, results.optimal)


def _motions(folder: Path, machine: FreeFloating, local: Motion, optimal: Motion) -> None:
    """The figures of both motions, the paper's two of a kind side by side on equal axes."""
    motions, note = (local, optimal), NOTE
    costs = [float(np.trapezoid((m.joint_rates**2).sum(axis=1) / 2, m.t)) for m in motions]
    title = (
        f"On the same line the optimum costs {100 * costs[1] / costs[0]:.0f} % of the pseudo-inverse (integral of half "
        "the squared joint rates)"
    )
    by_name: dict[str, Any] = {"title": title, "xlabel": "x, m", "sharey": True}
    with sheet(folder / "fig03_08_motion.png", (1, 2), (8.2, 5.6), note, **by_name) as (figure, axes):
        for ax, motion, name, number in zip(axes[0], motions, NAMES, (3, 8), strict=True):
            _strobe(ax, machine, motion)
            ax.set_title(f"{name} (figure {number})")
        axes[0, 0].set_ylabel("y, m")
        axes[0, 0].legend(loc="lower right")
        time_bar(figure, axes, local.t[-1], fraction=0.04, pad=0.02)
    turn = np.degrees(np.ptp(optimal.base[:, 2]))
    title = f"Optimum: the tip follows its line, the free base turns by {turn:.0f}°"
    with sheet(folder / "optimal_motion.png", (1, 1), (5.4, 5.8), note, title=title) as (figure, axes):
        _strobe(axes[0, 0], machine, optimal)
        axes[0, 0].set(xlabel="x, m", ylabel="y, m")
        axes[0, 0].legend(loc="lower right")
        time_bar(figure, axes, optimal.t[-1], fraction=0.04, pad=0.02)

    joints = [f"joint {i + 1}" for i in range(local.joints.shape[1])]
    pose: list[Quantity] = [
        ("position, m", ("x", "y"), lambda m: m.base[:, :2]),
        ("angle, deg", ("angle",), lambda m: np.degrees(m.base[:, 2:])),
    ]
    velocity: list[Quantity] = [
        ("velocity, m/s", ("x", "y"), lambda m: m.base_rates[:, :2]),
        ("angular velocity, deg/s", ("angle",), lambda m: np.degrees(m.base_rates[:, 2:])),
    ]
    angles: Quantity = ("joint angle, deg", joints, lambda m: np.degrees(m.joints))
    rates: Quantity = ("joint velocity, deg/s", joints, lambda m: np.degrees(m.joint_rates))
    turns, peaks = (
        [float(np.degrees(np.abs(of(m)).max())) for m in motions] for of in (_turn, lambda m: m.joint_rates)
    )
    title = f"The base turns by up to {turns[0]:.0f}° by the pseudo-inverse, by up to {turns[1]:.0f}° in the optimum"
    _pair(folder / "fig04_09_base_pose.png", motions, (4, 9), 4.8, pose, title)
    title = "Near a singularity the base moves abruptly by the pseudo-inverse, and smoothly in the optimum"
    _pair(folder / "fig06_11_base_velocity.png", motions, (6, 11), 4.8, velocity, title)
    title = "Near a singularity the joints turn fast by the pseudo-inverse, and evenly in the optimum"
    _pair(folder / "fig05_10_joint_angles.png", motions, (5, 10), 3.5, [angles], title)
    title = f"The fastest joint: {peaks[0]:.0f} deg/s by the pseudo-inverse, {peaks[1]:.0f} deg/s in the optimum"
    _pair(folder / "fig07_12_joint_velocity.png", motions, (7, 12), 3.5, [rates], title)
    least = int(local.manipulability.argmin())
    title = f"The pseudo-inverse nearly reaches a singularity at {local.t[least]:.2f} s; the optimum avoids it"
    with sheet(folder / "fig13_manipulability.png", (1, 1), (6.3, 3.6), note, title=title) as (_, axes):
        ax = axes[0, 0]
        for motion, name, color, dash in zip(motions, NAMES, ("orange", "blue"), DASHES[1::-1], strict=True):
            ax.plot(motion.t, motion.manipulability, color=COLORS[color], ls=dash, label=name)
        where = (local.t[least], local.manipulability[least])
        ax.plot(*where, "o", color=COLORS["orange"], ms=4)
        text = f"{where[1]:.3f} at {where[0]:.3f} s"
        ax.annotate(text, where, xytext=(-8, 2), textcoords="offset points", fontsize=8, ha="right")
        ax.set(xlabel="time, s", ylabel="manipulability $\\sqrt{\\det GG^T}$, m$^2$", ylim=(0, None))
        ax.set_xlim(local.t[0], local.t[-1])
        ax.set_title("Manipulability (figure 13)")
        ax.legend(loc="best")


def _turn(motion: Motion) -> Array:
    return np.asarray(motion.base[:, 2] - motion.base[0, 2])


def _convergence(folder: Path, rows: Sequence[Row]) -> None:
    """Distance of the cost from the reference against the number of intervals, one curve a method."""
    title, note = "The cost converges with the order of each method", NOTE
    with sheet(folder / "convergence.png", (1, 1), (8.2, 4.0), note, title=title) as (_, axes):
        ax = axes[0, 0]
        direct = [row for row in rows if row["intervals"] and row["order"]]
        colors = ("blue", "green", "orange", "purple")
        methods = dict.fromkeys(row["method"] for row in direct)
        for method, color, marker, dash in zip(methods, colors, "osD^", DASHES, strict=True):
            mine = [row for row in direct if row["method"] == method]
            intervals = [row["intervals"] for row in mine]
            errors = [abs(row["difference"]) for row in mine]
            label = f"{method}, order {mine[0]['order']}"
            ax.loglog(intervals, errors, marker=marker, ms=4.5, color=COLORS[color], ls=dash, label=label)
        ax.set_xticks([25, 50, 100, 200], ["25", "50", "100", "200"])
        ax.set_xticks([], minor=True)
        ax.set(xlabel="intervals", ylabel="|J − J$_{ref}$|, rad$^2$/s", title="horizon 5 s")
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _false_optima(folder: Path, trials: Sequence[Trial]) -> None:
    """Cost and largest jump of every plan that the solver calls optimal, and what such a jump looks like."""
    note = f"{ASSUMED}; horizon {HORIZON:g} s (chosen, not printed)."
    passed = [t for t in trials if t.audit]
    false = sorted((t for t in trials if t.verdict == FALSE), key=lambda t: t.cost)
    title = (
        f"Of {len(trials)} plans that the solver reports as optimal, {len(false)} are not: the audit finds their jumps"
    )
    with sheet(folder / "false_optima.png", (1, 2), (8.2, 4.0), note, title=title) as (_, axes):
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
        left.set_title("every plan")
        left.legend(loc="upper left")
        if false:
            shown = false[len(false) // 2]
            names = [f"joint {i + 1}" for i in range(shown.joint_rates.shape[1])]
            _curves(right, shown.t, np.degrees(shown.joint_rates), names)
            guess = "constant guess" if shown.seed < 0 else f"{shown.guess} guess, seed {shown.seed}"
            right.set_title(f"one that fails: {guess}, J = {shown.cost:.1f}")
            right.set(xlabel="time, s", ylabel="joint velocity, deg/s", xlim=(0, HORIZON))
            right.legend(loc="best")


def _costates(folder: Path, result: Agreement) -> None:
    """Costates of the direct plan on those of the minimum principle, above their difference."""
    direct, indirect = result.plan, result.multiple
    fine = np.linspace(0.0, 1.0, 501)
    solved, reported = costates(indirect, fine), costates(direct)
    off = np.abs(costate_difference(direct, indirect))
    settings: dict[str, Any] = {"sharex": True, "sharey": "row", "height_ratios": (3, 2)}
    note = f"Lines: minimum principle; markers: direct (Legendre 3, 100 intervals). {NOTE}"
    title = f"The direct plan's costates are those of the minimum principle to {off.max():.1e} of the largest"
    with sheet(folder / "costates.png", (2, 2), (8.2, 5.6), note, title=title, **settings) as (_, axes):
        for part, (above, below, (title, names)) in enumerate(zip(*axes, PARTS, strict=True)):
            for i, (name, color, dash) in enumerate(zip(names, PALETTE, DASHES, strict=False)):
                entry, shade = 3 * part + i, COLORS[color]
                above.plot(fine * indirect.horizon, solved[:, entry], color=shade, ls=dash, label=name)
                place = slice(5 * i, None, MARKED)  # not all at the same times: x and y are both zero
                above.plot(direct.t[place], reported[place, entry], "osD"[i], color=shade, ms=4, mfc="none")
                if off[:, entry].max() > FLOOR:
                    below.semilogy(*_tops(direct.t, off[:, entry]), color=shade, ls=dash, label=name)
            above.set_title(title)
            above.legend(loc="lower right", ncols=3)
            below.set_xlabel("time, s")
            below.set_xlim(0.0, direct.horizon)
            below.legend(loc="upper right", ncols=3)
        axes[0, 0].set_ylabel("costate ∂J/∂state, rad$^2$/s\nper m (x, y) or rad")
        axes[1, 0].set_ylabel(f"|direct − indirect| / largest,\nlargest in every {direct.horizon / BINS:g} s")
        axes[1, 0].set_ylim(1e-11, 1e-6)
        text = "x and y are zero: J does not\ndepend on where the machine is"
        axes[0, 0].text(0.03, 0.92, text, transform=axes[0, 0].transAxes, fontsize=8, va="top")


def _hamiltonian(folder: Path, result: Agreement) -> None:
    """How far H strays from its mean along the solution of every method."""
    colors = ("black", "purple", "blue", "green", "yellow", "orange", "sky")
    title, note = "Every method keeps the Hamiltonian constant, as far as its order allows", NOTE
    with sheet(folder / "hamiltonian.png", (1, 1), (8.2, 4.6), note, title=title) as (figure, axes):
        ax = axes[0, 0]
        for k, ((name, (t, value)), color) in enumerate(zip(hamiltonians(result).items(), colors, strict=True)):
            mean = value.mean()
            label = f"{name}\nmean H = {mean:.12f}"
            dash = DASHES[(k + k // 4) % 4]  # curves that cover each other get different ones
            ax.semilogy(*_tops(t, np.abs(value - mean)), color=COLORS[color], ls=dash, label=label)
        ax.set(xlabel="time, s", ylim=(1e-14, 1e-3), xlim=(0, result.plan.horizon))
        width = result.plan.horizon / BINS
        ax.set_ylabel(f"|H − its mean|, rad$^2$/s$^2$, largest in every {width:g} s")
        figure.legend(loc="outside right center", fontsize=7)


def _extremals(folder: Path, searches: Sequence[Search]) -> None:
    """Cost of every extremal against the horizon, above the joint velocities of the best of each."""
    note = f"{ASSUMED}; horizons chosen, not printed. {NOT_GLOBAL}."
    title = "Each horizon has several extremals: the best found is not the only minimum"
    settings: dict[str, Any] = {"sharey": "row", "height_ratios": (5, 4)}
    columns = len(searches)
    path = folder / "extremals.png"
    with sheet(path, (2, columns), (8.2, 6.0), note, title=title, **settings) as (figure, axes):
        grid = axes[0, 0].get_gridspec()
        for ax in axes[0]:
            ax.remove()
        _costs(figure.add_subplot(grid[0, :]), searches)
        for ax, one in zip(axes[1], searches, strict=True):
            best = one.best
            for i, (column, dash) in enumerate(zip(best.joint_rates.T, DASHES, strict=False)):
                ax.plot(best.t, np.degrees(column), ls=dash, label=f"joint {i + 1}")
            ax.set(xlim=(0, best.horizon), xlabel="time, s")
            ax.set_title(f"best found, horizon {best.horizon:g} s\nJ = {best.indirect_cost:.6f}")
        axes[1, 0].set_ylabel("joint velocity, deg/s")
        axes[1, -1].legend(loc="best", fontsize=7)


def _costs(ax: Any, searches: Sequence[Search]) -> None:
    """Every extremal's cost against its horizon, with how often it was found."""
    everything = [e for one in searches for e in one.extremals]
    kinds = (
        ("best found", [e for e in everything if e.best], "*", "blue", 11.0),
        ("other extremals", [e for e in everything if e.verdict == CONFIRMED and not e.best], "o", "sky", 4.5),
        ("not confirmed by the minimum principle", [e for e in everything if e.verdict != CONFIRMED], "x", "grey", 5.0),
    )
    for label, mine, marker, color, size in kinds:
        if mine:
            costs = [e.cost for e in mine]
            ax.semilogy([e.horizon for e in mine], costs, marker, color=COLORS[color], ms=size, label=label)
    low, high = min(e.cost for e in everything) / 1.15, max(e.cost for e in everything) * 1.2
    first, last = searches[0].horizon, searches[-1].horizon
    ax.set(xlim=(first - 0.15, last + 0.45), xticks=[one.horizon for one in searches], ylim=(low, high))
    marks = [mark for mark in (1, 1.5, 2, 3, 5, 10, 20, 50, 100) if low < mark < high]
    ax.set_yticks(marks, [f"{mark:g}" for mark in marks])
    ax.set_yticks([], minor=True)
    for one in searches:
        above = -np.inf
        for e in one.extremals:  # by cost: a label that would cover the one below moves up
            height = PANEL * np.log(e.cost / low) / np.log(high / low)
            above = max(height, above + LINE)
            text, place = f"{e.cost:.5f} ({e.guess_count}×)", (8, above - height)
            ax.annotate(text, (e.horizon, e.cost), place, textcoords="offset points", fontsize=7.5, va="center")
    ax.set(xlabel="horizon, s", ylabel="cost J, rad$^2$/s")
    ax.set_title(f"Extremals from {searches[0].starts} first guesses at each horizon (how often each was found)")
    ax.legend(loc="upper right")


def _tops(t: Array, values: Array) -> tuple[Array, Array]:
    """The largest value in each of 100 equal parts of the time, and their middles: the values swing from 0 to these."""
    parts = np.minimum((BINS * t / t[-1] + 1e-9).astype(int), BINS - 1)
    tops = np.full(BINS, FLOOR)
    np.maximum.at(tops, parts, values)
    return (np.arange(BINS) + 0.5) * t[-1] / BINS, tops


def _animation(folder: Path, machine: FreeFloating, local: Motion, optimal: Motion) -> None:
    """Both motions side by side in real time, above their joint velocities."""
    times = np.arange(0.0, local.t[-1] + FRAME / 2, FRAME)
    with sheet(None, (2, 2), (5.0, 4.9), sharey="row", height_ratios=(3, 1)) as (figure, axes):
        moving = [_animated(axes[:, i], machine, m, NAMES[i]) for i, m in enumerate((local, optimal))]
        axes[0, 0].set_ylabel("y, m")
        axes[1, 0].set_ylabel("joint rates, deg/s")
        curves = axes[1, 1].lines[: local.joints.shape[1]]
        names = [f"joint {i + 1}" for i in range(len(curves))]
        axes[1, 1].legend(curves, names, loc="upper right", fontsize=6, ncols=3, columnspacing=0.8, handlelength=1.8)
        title = figure.suptitle("time 0.00 s", fontsize=9)
        add_note(figure, NOTE)  # now, not when the block ends: the frames are drawn before
        figure.canvas.draw()
        figure.set_layout_engine("none")  # as laid out now: nothing that moves changes it, and it takes half the time

        def frames() -> Iterator[Figure]:
            for time in progress(times.tolist(), "animation"):
                for _, show in moving:
                    show(time)
                title.set_text(f"time {time:.2f} s")
                yield figure

        artists = [artist for mine, _ in moving for artist in mine]
        gif(folder / "motion.gif", frames(), seconds=FRAME, moving=[*artists, title])
    caption(folder / "motion.gif", "The pseudo-inverse and the optimum in real time", NOTE)


def _pair(
    path: Path, motions: Sequence[Motion], numbers: Sequence[int], height: float, rows: Sequence[Quantity], title: str
) -> None:
    """Quantities of both motions over time, a row of axes each."""
    size = (8.2, height)
    by_name: dict[str, Any] = {"xlabel": "time, s", "sharex": True, "sharey": "row", "title": title}
    with sheet(path, (len(rows), 2), size, NOTE, **by_name) as (_, axes):
        for line, (label, names, of) in zip(axes, rows, strict=True):
            for ax, motion in zip(line, motions, strict=True):
                _curves(ax, motion.t, of(motion), names)
            line[0].set_ylabel(label)
        for ax, name, number in zip(axes[0], NAMES, numbers, strict=True):
            ax.set_title(f"{name} (figure {number})")
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
        ax.fill(*square.T, facecolor=(*color[:3], 0.13 if ends else 0.0), edgecolor=color, lw=1.4 if ends else 0.6)
        draw_arm(ax, arm, color, 4.5)
    ax.set_aspect("equal")


def _animated(
    column: Any, machine: FreeFloating, motion: Motion, name: str
) -> tuple[list[Artist], Callable[[float], None]]:
    """Draw one motion's still parts; the others, from back to front, and a function that moves them to a time."""
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

    return [trace, plate, links, cursor], show
