"""Animations of the standing machine: foot, zero moment point and centre of mass, and the instant at which it fails."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from models.machines.standing import StandingMotion
from scripts.drawing import COLORS, add_note, gif, sheet
from scripts.papers.run import progress
from scripts.papers.standing.cases import ASSUMED, HORIZON, Local, machine
from scripts.papers.standing.drawing import arm_points, axes_frame, foot, nearest
from scripts.papers.standing.plans import LIFT_SETTINGS, SETTINGS, Plan

SYMBOLS = "◆ zero moment point, + centre of mass, grey: the foot; orange: from where the motion fails."
DPI = 110
COLORS_USED = 128  # all of the first frame, which gives the palette
FRAME = 0.1  # s between two pictures of the tables
LIFT_FRAME = 0.01  # s between two of the lifts
SLOWER = 10.0  # than in truth the lifts are shown
BARE = 0.36  # m beside the foot that the diagrams show


@dataclass(frozen=True)
class Scene:
    """One column of an animation: a motion, and from when and why it is no success."""

    title: str
    motion: StandingMotion
    verdict: str = ""
    fails: float = np.inf


def draw_animations(
    folder: Path, local: Mapping[str, Mapping[str, Local]], plans: Mapping[str, Mapping[str, Plan]]
) -> None:
    """Table 1 in real time, and the fastest lifts ten times slowed down."""
    one, best = local["table1"], plans["table1"]
    names = {"pseudo_inverse": "pseudo-inverse", "augmented": "ZMP pinned (20)", "stabilised": "stabilised law"}
    scenes = [_scene(title, one[name]) for name, title in names.items()]
    scenes.append(Scene("optimal, in the foot", best["optimal_range"].motion))
    times = np.arange(0.0, HORIZON + FRAME / 2, FRAME)
    _animate(folder / "motion.gif", scenes, times.tolist(), FRAME, f"{SYMBOLS} {ASSUMED}. {SETTINGS}.")
    scenes = [
        Scene(f"{plan.request.title}\n{plan.solution.horizon:.3f} s", plan.motion, *_tips(plan.motion))
        for plan in plans["minimum_time"].values()
    ]
    last = max(scene.motion.t[-1] for scene in scenes)
    times = np.append(np.arange(0.0, last, LIFT_FRAME), last)
    note = f"{SLOWER:g} times slower than it is. {SYMBOLS} {ASSUMED}. {LIFT_SETTINGS}."
    _animate(folder / "lift.gif", scenes, times.tolist(), SLOWER * LIFT_FRAME, note)


def _scene(title: str, result: Local) -> Scene:
    if result.reason in ("stands", "joint_limit"):
        return Scene(title, result.shown)
    words = {"tips": "tips", "lift_off": "lifts off", "divergence": "diverges"}.get(result.reason, "breaks down")
    return Scene(title, result.shown, f"{words} at {result.time:.2f} s", result.time)


def _tips(motion: StandingMotion) -> tuple[str, float]:
    outside = motion.foot_margin < 0
    if not outside.any():
        return "", np.inf
    time = float(motion.t[outside][0])
    return f"tips at {time:.3f} s", time


def _animate(path: Path, scenes: Sequence[Scene], times: Iterable[float], seconds: float, note: str) -> None:
    """What stands still is drawn once, as the background of a figure that holds what moves."""
    size = (1.75 * len(scenes) + 1.1, 4.5)
    with sheet(None, (2, len(scenes)), size, sharey="row", height_ratios=(2.6, 1)) as (figure, axes):
        figure.set_dpi(DPI)
        last = max(scene.motion.t[-1] for scene in scenes)
        for (above, below), scene in zip(axes.T, scenes, strict=True):
            _still(above, below, scene, last)
        axes[0, 0].set_ylabel("z, m")
        axes[1, 0].set_ylabel("ZMP y, m")
        figure.suptitle(" ", fontsize=9)  # room for the time
        add_note(figure, note)
        canvas: Any = figure.canvas
        canvas.draw()
        background = np.asarray(canvas.buffer_rgba()).copy()
        front = Figure(figsize=size, dpi=DPI)
        front.figimage(background, zorder=-1)
        moving = [
            _moving(_over(front, above), _over(front, below), scene)
            for (above, below), scene in zip(axes.T, scenes, strict=True)
        ]
        title = front.text(0.5, 0.985, "", ha="center", va="top", fontsize=9)

    def frames() -> Iterator[Figure]:
        for time in progress(times, "animation"):
            for show in moving:
                show(time)
            title.set_text(f"time {time:.2f} s")
            yield front

    gif(path, frames(), seconds=seconds, colors=COLORS_USED)


def _over(front: Figure, ax: Any) -> Any:
    """Axes without frame or ticks in the place and with the scales of others, as they have been drawn."""
    over = front.add_axes(ax.get_position().bounds, xlim=ax.get_xlim(), ylim=ax.get_ylim())
    over.set_axis_off()
    return over


def _still(above: Any, below: Any, scene: Scene, last: float) -> None:
    """Ground, foot, path of the tip and the zero moment point over time."""
    motion = scene.motion
    foot(above)
    above.plot(motion.tip_in_world[:, 1], motion.tip_in_world[:, 2], color=COLORS["sky"], lw=1.6, alpha=0.6)
    axes_frame(above)
    above.set_title(scene.title, fontsize=8.5)
    edges = machine().support.vertices[:, 1]
    below.axhspan(edges.min(), edges.max(), color=COLORS["grey"], alpha=0.18, lw=0)
    below.plot(motion.t, motion.zero_moment_point[:, 1], color=COLORS["green"], lw=1.2)
    if np.isfinite(scene.fails):
        below.axvline(scene.fails, color=COLORS["orange"], lw=2.4)
    below.set(xlabel="time, s", xlim=(0.0, last), ylim=(edges.min() - BARE, edges.max() + BARE))


def _moving(above: Any, below: Any, scene: Scene) -> Callable[[float], None]:
    """What moves; the returned function puts it where it is at a time."""
    motion, zmp = scene.motion, scene.motion.zero_moment_point[:, 1]
    (links,) = above.plot([], [], "-o", color=COLORS["black"], lw=2.0, ms=3.2)
    (mass,) = above.plot([], [], "+", color=COLORS["blue"], ms=8, mew=1.8, zorder=6)
    (point,) = above.plot([], [], "D", color=COLORS["green"], ms=5.5, mec="white", mew=0.6, zorder=7)
    verdict = above.text(0.5, 0.02, "", transform=above.transAxes, ha="center", fontsize=8, color=COLORS["orange"])
    (cursor,) = below.plot([], [], "D", color=COLORS["green"], ms=5, mec="white", mew=0.6)

    def show(time: float) -> None:
        k = nearest(motion.t, time)
        failed = time >= scene.fails
        links.set_data(*arm_points(motion.joints[k]).T)
        links.set_color(COLORS["orange" if failed else "black"])
        mass.set_data([motion.center_of_mass[k, 1]], [motion.center_of_mass[k, 2]])
        point.set_data([zmp[k]], [0.0])
        cursor.set_data([motion.t[k]], [zmp[k]])
        verdict.set_text(scene.verdict if failed else "")

    return show
