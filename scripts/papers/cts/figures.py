"""Figures of the captive trajectory script."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from models import Rig
from models.checks import Array
from models.cts.best_roll import rig_capsules
from models.cts.rig import INCH
from ocp.app.view.appearance import Part, part_of, rod
from ocp.app.view.rendering import Camera, Layer, render, tube
from scripts.drawing import COLORS, DASHES, TIME_COLORS, add_note, draw_arm, gif, legend_below, sheet
from scripts.papers.cts.plan import draw_plan
from scripts.papers.cts.results import GAINS, NOTE, SCALE, Results, corners, scene

UNITS = ("in", *["deg"] * 5)
ITERATIONS = (("combined", 0.0, "combined"), *(("jacobian", gain, f"Jacobian, gain {gain:g}") for gain in GAINS))
METHOD_COLORS = ("orange", "green", "purple")
METHOD_MARKS = "os^"


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
    """Joints over the sweep: the closed form as a line, the iterations as marks at different targets on it."""
    z = results.targets[:, 2] / INCH
    for number, name in ((7, "i1"), (9, "i2")):
        closed = shown(results.optimal[name].joints)
        path = folder / f"fig0{number}_joints_{name}.png"
        bounds = [f"{results.stability[name, gain]:.3g} with gain {gain:g}" for gain in GAINS]
        note = (
            f"{NOTE} The null-space step is stable while the largest gain n6² I'' is below 2: it is "
            f"{' and '.join(bounds)}."
        )
        lost = [gain for gain in GAINS if not results.runs[name, "jacobian", gain].converged.all()]
        title = f"Figure {number}: with index I{name[1]} " + (
            f"the Jacobian iteration of gain {' and '.join(f'{gain:g}' for gain in lost)} does not converge "
            "everywhere; the others reach the global optimum"
            if lost
            else "all iterations reach the global optimum, which the closed form gives at once"
        )
        by_name: dict[str, Any] = {"title": title, "sharex": True, "xlabel": "target z, in"}
        with sheet(path, (2, 3), (9.0, 5.4), note, **by_name) as (figure, axes):
            for k, ax in enumerate(axes.flat):
                ax.plot(z, closed[:, k], color=COLORS["blue"], lw=2.2, label="closed form: the global optimum")
                for i, ((method, gain, label), mark) in enumerate(zip(ITERATIONS, METHOD_MARKS, strict=True)):
                    run = results.runs[name, method, gain]
                    joints = np.where(run.converged[:, None], shown(run.joints), np.nan)
                    part = slice(5 * i, None, max(len(z) // 13, 1))
                    style: dict[str, Any] = {"ms": 5, "mfc": "none", "mew": 1.1, "color": COLORS["orange"]}
                    ax.plot(z[part], joints[part, k], mark, label=label, **style)
                low, high = closed[:, k].min(), closed[:, k].max()
                ax.set_ylim(low - 0.15 * (high - low), high + 0.15 * (high - low))
                ax.set_ylabel(f"$q_{k + 1}$, {UNITS[k]}")
            legend_below(figure, axes[0, 0].get_legend_handles_labels()[0], 4)


def _iterations(path: Path, results: Results) -> None:
    z = results.targets[:, 2] / INCH
    note = f"The closed form has no iterations. {NOTE}"
    title = "Figure 8: iterations that a target takes, of each law"
    with sheet(path, (1, 2), (8.2, 3.9), note, title=title, sharey=True, xlabel="target z, in") as (_, axes):
        for ax, name in zip(axes[0], ("i1", "i2"), strict=True):
            for (method, gain, label), color, dash in zip(ITERATIONS, METHOD_COLORS, DASHES, strict=False):
                run = results.runs[name, method, gain]
                text = f"{label}: {int(run.converged.sum())} of {len(z)} converge"
                ax.plot(z, run.iterations, color=COLORS[color], ls=dash, label=text)
            ax.set(title=f"index $I_{name[1]}$", yscale="log", ylim=(0.8, 900))
            ax.legend(loc="upper left")
        axes[0, 0].set_ylabel("iterations to a target")


def _rig(path: Path, results: Results) -> None:
    table = results.optimal["i1"]
    places = corners(results, table) / INCH
    rows = np.linspace(0, len(places) - 1, 5).astype(int)
    lines = skeleton(results.rig, table.joints[rows])
    turn = float(np.degrees(np.ptp(table.joints[:, 5])))
    by_name: dict[str, Any] = {
        "title": f"Figure 6: over the sweep the roll turns by {turn:.0f}°, and the goose-neck goes round the middle",
        "width_ratios": (5.5, 1),
        "sharey": True,
    }
    with sheet(path, (1, 2), (9.6, 3.2), NOTE, **by_name) as (_, axes):
        for ax, (i, k) in zip(axes[0], ((0, 2), (1, 2)), strict=True):
            for number, (line, row) in enumerate(zip(lines, rows, strict=True)):
                color = TIME_COLORS(number / (len(rows) - 1))
                draw_arm(ax, line[:, [i, k]], color, 3.6)
                ax.plot([], [], color=color, lw=3.6, label=f"z = {results.targets[row, 2] / INCH:.1f} in")
            ax.plot(places[:, i], places[:, k], color=COLORS["green"], lw=1.6, zorder=5, label="path of $P_G$")
            center = results.tunnel.center / INCH
            style: dict[str, Any] = {"ms": 11, "mew": 2, "color": COLORS["black"], "zorder": 6}
            ax.plot(center[i], center[k], "+", label="$P_C$, the middle", **style)
            ax.set(xlabel=f"{'xyz'[i]}, in", aspect="equal")
        axes[0, 0].set(title="from the side", ylabel="z, in")
        axes[0, 1].set_title("from the front")
        axes[0, 1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _release(folder: Path, results: Results) -> None:
    """The store release: the rig as it follows, curves, and an animation."""
    result = results.release
    around, closest = _Scene(results), int(result.clearance.argmin())
    note = (
        "The rig and the wing as capsules and a box; earlier postures pale; green: the path of the goose-neck's end. "
        f"Store, ejectors and air chosen, model scale {SCALE:g}; walls and wing chosen. {NOTE}"
    )
    title = (
        f"The rig takes the store along its free fall and comes no nearer to the wing or a wall than "
        f"{result.clearance[closest] / INCH:.1f} in"
    )
    with sheet(folder / "release.png", (2, 4), (9.6, 5.4), note, title=title) as (figure, axes):
        grid = axes[0, 0].get_gridspec()
        for ax in axes[:, :2].flat:
            ax.remove()
        big = figure.add_subplot(grid[:, :2])
        big.imshow(
            around.picture((0, len(result.t) // 2, len(result.t) - 1), (1000, 1000)), interpolation="antialiased"
        )
        big.set_axis_off()
        first, second, third, fourth = axes[0, 2], axes[0, 3], axes[1, 2], axes[1, 3]
        move = result.table.targets[:, :3] - result.table.targets[0, :3]
        for k, (label, dash) in enumerate(zip("xyz", DASHES, strict=False)):
            first.plot(result.t, move[:, k] / INCH, ls=dash, label=label)
        for k, (label, dash) in enumerate(zip(("yaw", "pitch, nose down"), DASHES, strict=False)):
            second.plot(result.t, np.degrees(result.table.targets[:, 3 + k]), ls=dash, label=label)
        third.plot(result.t, np.degrees(result.table.joints[:, 5]))
        fourth.plot(result.t, result.clearance / INCH)
        fourth.annotate(
            f"{result.nearest[0]} to {result.nearest[1]}", (0.04, 0.05), xycoords="axes fraction", fontsize=7.5
        )
        labels = ("displacement, in", "attitude, deg", "roll $q_6$, deg", "clearance of the rig, in")
        for ax, label in zip((first, second, third, fourth), labels, strict=True):
            ax.set_ylabel(label)
        for ax in (third, fourth):
            ax.set_xlabel("time at full size, s")
        first.legend(loc="lower left")
        second.legend(loc="upper left", fontsize=7)
        low, high = second.get_ylim()
        second.set_ylim(low, high + 0.35 * (high - low))
        fourth.set_ylim(0, None)
    _animate(folder / "release.gif", results, around)


class _Scene:
    """The rig, the store and the wing as solids, at every sample of the release; in inches."""

    def __init__(self, results: Results) -> None:
        result = results.release
        self.lines = skeleton(results.rig, result.table.joints)
        self.places = corners(results, result.table) / INCH
        q = ca.SX.sym("q", 6)
        self.radii = [link.radius / INCH for link in rig_capsules(results.rig, q).values()]
        yaw, pitch = result.table.targets[:, 3:].T
        axis = np.column_stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
        length = SCALE * 2.2 / INCH
        self.stores = np.stack([self.lines[:, -1] - 0.2 * length * axis, self.lines[:, -1] + 0.8 * length * axis], 1)
        wing = scene().solids[0]
        center, half = wing.position / INCH, wing.size / (2 * INCH)
        corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half + center
        quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
        faces = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
        self.still = [
            part_of("", corner, faces, (*to_rgb(COLORS["grey"]), 1.0)),
            tube(self.places, 0.35, to_rgb(COLORS["green"])),
        ]
        self.points = np.vstack([self.lines.reshape(-1, 3), self.stores.reshape(-1, 3), corner])

    def at(self, row: int) -> list[Part]:
        """The rig, blue, and the store, dark."""
        results = []
        for start, end, radius in zip(self.lines[row, :-1], self.lines[row, 1:], self.radii, strict=True):
            if np.linalg.norm(end - start) > 1e-6:
                bar = rod(start, end, radius)
                results.append(part_of("", bar.vertices, bar.faces, (*to_rgb(COLORS["blue"]), 1.0)))
        store = rod(self.stores[row, 0], self.stores[row, 1], 0.07 * SCALE * 2.2 / INCH)
        return [*results, part_of("", store.vertices, store.faces, (0.2, 0.2, 0.22, 1.0))]

    def picture(self, rows: Sequence[int], size: tuple[int, int]) -> Any:
        """At the last of some samples solid, at those before pale."""
        layers = [Layer(self.at(rows[-1])), Layer(self.still)]
        layers += [Layer(self.at(row), 0.25, to_rgb(COLORS["blue"])) for row in rows[:-1]]
        return render(layers, Camera.around(self.points, size, 14.0, -112.0))


def _animate(path: Path, results: Results, around: _Scene) -> None:
    result = results.release
    with sheet(None, (1, 1), (5.2, 4.6)) as (figure, axes):
        figure.set_dpi(100)
        ax = axes[0, 0]
        ax.set_axis_off()
        image = ax.imshow(around.picture((0,), (500, 400)))
        ax.set_title("The rig takes the store along its fall from the wing")
        title = figure.suptitle(" ", fontsize=9)  # room for the time
        add_note(figure, "Store, ejectors, air, walls, wing and link lengths chosen")

        def frames() -> Iterator[Figure]:
            for row, time in enumerate(result.t):
                image.set_data(around.picture((row,), (500, 400)))
                title.set_text(f"{time:.2f} s, slowed down")
                yield figure

        gif(path, frames(), seconds=0.08, colors=128, moving=[image, title])
