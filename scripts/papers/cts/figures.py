"""Figures of the captive trajectory script."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from matplotlib.figure import Figure

from models import Rig
from models.arrays import Array
from models.cts.clearance import rig_capsules
from models.cts.rig import INCH
from scripts.drawing import COLORS, DASHES, gif, sheet
from scripts.papers.cts.plan import draw_plan
from scripts.papers.cts.results import GAINS, NOTE, SCALE, Results, corners, surroundings

UNITS = ("in", *["deg"] * 5)
ITERATIONS = (("combined", 0.0, "combined"), *(("jacobian", gain, f"Jacobian, gain {gain:g}") for gain in GAINS))
METHOD_COLORS = ("orange", "green", "purple")


def skeleton(rig: Rig, joints: Array) -> Array:
    """Points along the rig for every row of joints. Shape (samples, 7, 3), in."""
    q = ca.SX.sym("q", 6)
    links = list(rig_capsules(rig, q).values())
    points = ca.horzcat(links[0].start, *[link.end for link in links])
    function = ca.Function("skeleton", [q], [points])
    return np.array([np.array(function(row)).T for row in joints]) / INCH


def shown(joints: Array) -> Array:
    """Joints in the units of the figures."""
    return np.asarray(joints * [1 / INCH, *[180 / np.pi] * 5])


def draw(results: Results, folder: Path) -> None:
    """Figures 6 to 9, the store release, and the plan of the whole sweep."""
    _rig(folder / "fig06_rig.png", results)
    _joints(folder, results)
    _iterations(folder / "fig08_iterations.png", results)
    _release(folder, results)
    draw_plan(folder / "plan.png", results.plan)


def _joints(folder: Path, results: Results) -> None:
    z = results.targets[:, 2] / INCH
    for number, name in ((7, "i1"), (9, "i2")):
        closed = shown(results.optimal[name].joints)
        title = f"Figure {number}: joints over the sweep, index {'$I_1$' if name == 'i1' else '$I_2$'}"
        path = folder / f"fig0{number}_joints_{name}.png"
        with sheet(path, (2, 3), (9.0, 5.0), NOTE, sharex=True, xlabel="target z, in") as (figure, axes):
            for k, ax in enumerate(axes.flat):
                ax.plot(z, closed[:, k], color=COLORS["blue"], lw=2.5, alpha=0.4, label="global optimum")
                for (method, gain, label), color, dash in zip(ITERATIONS, METHOD_COLORS, DASHES, strict=False):
                    joints = shown(results.runs[name, method, gain].joints)
                    ax.plot(z, joints[:, k], ls=dash, color=COLORS[color], lw=1.2, label=label)
                low, high = closed[:, k].min(), closed[:, k].max()
                ax.set_ylim(low - 0.5 * (high - low) - 1, high + 0.5 * (high - low) + 1)
                ax.set_ylabel(f"$q_{k + 1}$, {UNITS[k]}")
            handles, labels = axes[0, 0].get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside right upper")
            bounds = [f"gain {gain:g}: {results.stability[name, gain]:.3g}" for gain in GAINS]
            stable = "largest gain $n_6^2 I''$, stable below 2: " + ", ".join(bounds)
            figure.suptitle(f"{title}\n{stable}", fontsize=10)


def _iterations(path: Path, results: Results) -> None:
    z = results.targets[:, 2] / INCH
    note = NOTE + " The closed form has no iterations."
    with sheet(path, (1, 2), (8.2, 3.6), note, sharey=True, xlabel="target z, in") as (_, axes):
        for ax, name in zip(axes[0], ("i1", "i2"), strict=True):
            for (method, gain, label), color, dash in zip(ITERATIONS, METHOD_COLORS, DASHES, strict=False):
                run = results.runs[name, method, gain]
                text = f"{label}: {int(run.converged.sum())} of {len(z)} converge"
                ax.plot(z, run.iterations, color=COLORS[color], ls=dash, label=text)
            ax.set(title=f"Figure 8: iterations, index $I_{name[1]}$", yscale="log", ylim=(0.8, 900))
            ax.legend(loc="upper left")
        axes[0, 0].set_ylabel("iterations to a target")


def _rig(path: Path, results: Results) -> None:
    table = results.optimal["i1"]
    places = corners(results, table) / INCH
    rows = np.linspace(0, len(places) - 1, 5).astype(int)
    lines = skeleton(results.rig, table.joints[rows])
    with sheet(path, (1, 2), (9.0, 3.8), NOTE) as (_, axes):
        for ax, (i, k) in zip(axes[0], ((0, 2), (1, 2)), strict=True):
            for line, row, color in zip(lines, rows, ("blue", "sky", "green", "yellow", "orange"), strict=True):
                label = f"z = {results.targets[row, 2] / INCH:.1f} in"
                ax.plot(line[:, i], line[:, k], "-o", ms=3, color=COLORS[color], label=label)
            ax.plot(places[:, i], places[:, k], color=COLORS["black"], ls=DASHES[3], label="path of $P_G$")
            center = results.tunnel.center / INCH
            ax.plot(center[i], center[k], "+", ms=10, color=COLORS["black"], label="$P_C$")
            ax.set(xlabel=f"{'xyz'[i]}, in", ylabel="z, in", aspect="equal")
        axes[0, 0].set_title("Figure 6: the rig over the sweep, from the side")
        axes[0, 1].set_title("from the front")
        axes[0, 1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _release(folder: Path, results: Results) -> None:
    """The store release: curves, and the rig in motion."""
    found = results.release
    note = f"Store, ejectors and air chosen, model scale {SCALE:g}; walls and wing chosen. " + NOTE
    with sheet(folder / "release.png", (2, 2), (8.2, 5.0), note, sharex=True, xlabel="time at full size, s") as (
        _,
        axes,
    ):
        move = found.table.targets[:, :3] - found.table.targets[0, :3]
        for k, (label, dash) in enumerate(zip("xyz", DASHES, strict=False)):
            axes[0, 0].plot(found.t, move[:, k] / INCH, ls=dash, label=label)
        for k, (label, dash) in enumerate(zip(("yaw", "pitch, nose down"), DASHES, strict=False)):
            axes[0, 1].plot(found.t, np.degrees(found.table.targets[:, 3 + k]), ls=dash, label=label)
        axes[1, 0].plot(found.t, np.degrees(found.table.joints[:, 5]), label="roll")
        axes[1, 1].plot(found.t, found.clearance / INCH, label=f"least: {found.nearest[0]} to {found.nearest[1]}")
        labels = ("displacement in the tunnel, in", "attitude, deg", "roll $q_6$, deg", "clearance of the rig, in")
        for ax, label in zip(axes.flat, labels, strict=True):
            ax.set_ylabel(label)
            ax.legend(loc="best")
        axes[1, 1].set_ylim(0, None)
    _animate(folder / "release.gif", results)


def _animate(path: Path, results: Results) -> None:
    found = results.release
    lines = skeleton(results.rig, found.table.joints)
    places = corners(results, found.table) / INCH
    around = surroundings()
    assert around.walls is not None
    wing = around.solids[0]
    with sheet(None, (1, 2), (8.0, 3.6)) as (figure, axes):
        drawn: list[tuple[Any, Any, Any, Any, int, int]] = []
        for ax, (i, k) in zip(axes[0], ((0, 2), (1, 2)), strict=True):
            half = around.walls.size / (2 * INCH)
            for side in (-1, 1):
                ax.axhline(side * half[2], color=COLORS["grey"], lw=2)
                if i == 1:
                    ax.axvline(side * half[1], color=COLORS["grey"], lw=2)
            c, h = wing.position / INCH, wing.size / (2 * INCH)
            ax.fill_between([c[i] - h[i], c[i] + h[i]], c[k] - h[k], c[k] + h[k], color=COLORS["sky"])
            (rig,) = ax.plot([], [], "-o", color=COLORS["black"], ms=3.5)
            (store,) = ax.plot([], [], "-", color=COLORS["orange"], lw=6, solid_capstyle="round")
            (trail,) = ax.plot([], [], ls=DASHES[3], color=COLORS["blue"])
            (spot,) = ax.plot([], [], "o", color=COLORS["blue"], ms=5)
            ax.set(xlabel=f"{'xyz'[i]}, in", ylabel="z, in", aspect="equal", ylim=(-32, 32))
            ax.set_xlim(*((0, 125) if i == 0 else (-38, 38)))
            drawn.append((rig, store, trail, spot, i, k))
        axes[0, 0].set_title("store release, from the side (blue: $P_G$)")
        axes[0, 1].set_title("from the front")
        chosen = "Store, ejectors, air, walls, wing and link lengths chosen."
        title = figure.suptitle(" ", fontsize=9)  # room for the time
        figure.supxlabel(chosen, x=0.01, ha="left", fontsize=6, color=COLORS["grey"])
        yaw, pitch = found.table.targets[:, 3:].T
        axis = np.column_stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
        length = SCALE * 2.2 / INCH
        ends = np.stack([lines[:, -1] - 0.2 * length * axis, lines[:, -1] + 0.8 * length * axis], axis=1)

        def frames() -> Iterator[Figure]:
            for row, time in enumerate(found.t):
                for rig, store, trail, spot, i, k in drawn:
                    rig.set_data(lines[row, :, i], lines[row, :, k])
                    store.set_data(ends[row, :, i], ends[row, :, k])
                    trail.set_data(places[: row + 1, i], places[: row + 1, k])
                    spot.set_data(places[row : row + 1, i], places[row : row + 1, k])
                title.set_text(f"{time:.2f} s, slowed down")
                yield figure

        artists = [artist for rig, store, trail, spot, *_ in drawn for artist in (rig, store, trail, spot)]
        gif(path, frames(), seconds=0.08, moving=[*artists, title])
