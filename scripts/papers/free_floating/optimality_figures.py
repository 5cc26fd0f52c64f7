"""Figures of what makes the plan an optimum: costates, Hamiltonian, and the extremals at other horizons."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scripts.drawing import COLORS, DASHES, sheet
from scripts.papers.free_floating.extremals import CONFIRMED, Search
from scripts.papers.free_floating.motion import Array
from scripts.papers.free_floating.optimality import Agreement, costate_difference, costates, hamiltonians

__all__ = ["draw_costates", "draw_extremals", "draw_hamiltonian"]

PARTS = (("base", ("x", "y", "angle")), ("joints", ("joint 1", "joint 2", "joint 3")))
PALETTE = ("blue", "orange", "green")
MARKED = 16  # reported points between two markers of the direct solution
FLOOR = 1e-17  # a logarithm needs more than zero
BINS = 100
PANEL, LINE = 170.0, 9.5  # height of the panel of costs, and of a line of its labels, points


def draw_costates(folder: Path, found: Agreement, note: str) -> None:
    """Costates of the direct plan on those of the minimum principle, above their difference."""
    direct, indirect = found.plan, found.multiple
    fine = np.linspace(0.0, 1.0, 501)
    solved, reported = costates(indirect, fine), costates(direct)
    off = np.abs(costate_difference(direct, indirect))
    settings = {"sharex": True, "sharey": "row", "height_ratios": (3, 2)}
    with sheet(folder / "costates.png", rows=2, columns=2, size=(8.2, 5.4), note=note, **settings) as (figure, axes):
        figure.suptitle(
            "Costates: lines minimum principle, markers direct (Legendre 3, 100 intervals).\n"
            f"Largest difference, relative to the largest costate: {off.max():.1e}",
            fontsize=9.5,
        )
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


def draw_hamiltonian(folder: Path, found: Agreement, note: str) -> None:
    """How far H strays from its mean along the solution of every method."""
    colors = ("black", "purple", "blue", "green", "yellow", "orange", "sky")
    with sheet(folder / "hamiltonian.png", size=(8.2, 4.4), note=note) as (figure, axes):
        ax = axes[0, 0]
        for k, ((name, (t, value)), color) in enumerate(zip(hamiltonians(found).items(), colors, strict=True)):
            mean = value.mean()
            label = f"{name}\nmean H = {mean:.12f}"
            dash = DASHES[(k + k // 4) % 4]  # curves that cover each other get different ones
            ax.semilogy(*_tops(t, np.abs(value - mean)), color=COLORS[color], ls=dash, label=label)
        ax.set(xlabel="time, s", ylim=(1e-14, 1e-3), xlim=(0, found.plan.horizon))
        width = found.plan.horizon / BINS
        ax.set_ylabel(f"|H − its mean|, rad$^2$/s$^2$, largest in every {width:g} s")
        ax.set_title("The Hamiltonian is constant")
        figure.legend(loc="outside right center", fontsize=7)


def draw_extremals(folder: Path, searches: Sequence[Search], note: str) -> None:
    """Cost of every extremal against the horizon, above the joint velocities of the best of each."""
    settings = {"sharey": "row", "height_ratios": (5, 4)}
    columns = len(searches)
    path = folder / "extremals.png"
    with sheet(path, rows=2, columns=columns, size=(8.2, 5.8), note=note, **settings) as (figure, axes):
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
        ("best found", [e for e in everything if e.best], "*", "orange", 11.0),
        ("other extremals", [e for e in everything if e.verdict == CONFIRMED and not e.best], "o", "blue", 4.5),
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
            text, place = f"{e.cost:.5f} ({e.found}×)", (8, above - height)
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
