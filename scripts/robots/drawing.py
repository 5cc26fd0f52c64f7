"""Arms drawn as lines in space, for the figures and animations of the gallery."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection  # type: ignore[import-untyped]

from models import Robot
from models.arrays import Array
from ocp.app.frames import TIP, Frames, chain
from scripts.drawing import COLORS, DASHES, add_note, gif, sheet

JOINT_COLORS = [COLORS[name] for name in ("blue", "orange", "green", "purple", "yellow", "sky", "black")]
DPI = 100
PALETTE = 256  # with fewer a thin line may lose its colour
RECT = (0.0, 0.0, 0.97, 1.0)
"""Share of a figure that is used: the layout does not see the labels of solid axes."""
VIEW = (22.0, -58.0)  # elevation, azimuth, deg


@dataclass(frozen=True, eq=False)
class Scene:
    """A motion to draw.

    Attributes:
        title: Above it.
        robot: What moves.
        frames: Along the motion. t: Times of them, s. Shape (M,).
        color: Of the arm, a name of drawing.COLORS.
        boxes: Links drawn as boxes.
        surface: Points of a surface (x, y, z), (k, l) each, that is worked on.
        view: Elevation and azimuth, deg.
        outline: Points of a closed line that is drawn too. Shape (k, 3), m.
        mark: A point that moves. Shape (M, 3), m.
        nearest_points: Of two bodies, where they come nearest to each other along the motion. Shape (2, 3), m.
        tool: Length of the tip's z axis drawn, m.
    """

    title: str
    robot: Robot
    frames: Frames
    t: Array
    color: str
    boxes: tuple[str, ...] = ()
    surface: tuple[Array, Array, Array] | None = None
    view: tuple[float, float] = VIEW
    tool: float = 0.0
    outline: Array | None = None
    mark: Array | None = None
    nearest_points: Array | None = None
    points: Array = field(init=False)

    def __post_init__(self) -> None:
        """Points of the arm, root first. Shape (M, links + 1, 3), m."""
        points = [self.frames.positions[name] for name in chain(self.robot)]
        object.__setattr__(self, "points", np.stack(points, axis=1))

    def nearest(self, time: float) -> int:
        """Number of the sample nearest to a time."""
        return int(np.abs(self.t - time).argmin())

    def edges(self, k: int) -> Array:
        """Edges of the boxes at sample k. Shape (12 x boxes, 2, 3)."""
        found = [np.zeros((0, 2, 3))]
        for name in self.boxes:
            if (box := inertia_box(self.robot, name)) is not None:
                size, turn, center = box
                signs = np.array(list(product((-0.5, 0.5), repeat=3)))
                corners = center + (signs * size) @ turn.T
                corners = self.frames.positions[name][k] + corners @ self.frames.rotations[name][k].T
                pairs = [(i, j) for i in range(8) for j in range(i) if np.sum(signs[i] != signs[j]) == 1]
                found.append(np.array([[corners[i], corners[j]] for i, j in pairs]))
        return np.concatenate(found)

    def axis(self, k: int) -> Array:
        """The tool's axis at sample k, ending at the tip. Shape (2, 3)."""
        tip = self.frames.tip[k]
        return np.stack([tip - self.tool * self.frames.rotations[TIP][k][:, 2], tip])


def inertia_box(robot: Robot, name: str) -> tuple[Array, Array, Array] | None:
    """The box of even density that has a link's mass and inertia.

    Returns:
        Edge lengths (3,), m; its axes (3, 3), as columns, and its centre (3,), in the link's frame. None for a link
        without mass or whose inertia no body can have.
    """
    link = robot.link(name)
    if link.mass <= 0:
        return None
    moments, axes = np.linalg.eigh(np.asarray(link.inertia, dtype=float))
    squares = 6 / link.mass * (moments.sum() - 2 * moments)
    if not (np.isfinite(squares).all() and (squares >= -1e-9 * max(float(np.abs(squares).max()), 1e-12)).all()):
        return None
    if np.linalg.det(axes) < 0:
        axes = axes * [1, 1, -1]
    return np.sqrt(np.maximum(squares, 0)), axes, np.asarray(link.center_of_mass, dtype=float)


@contextmanager
def page(
    path: Path, scenes: Sequence[Scene], instants: int | Sequence[float], *, height: float, share: float, note: str
) -> Iterator[tuple[Any, Any, Any]]:
    """A figure of two scenes at some instants, with equal scales, above three diagrams, whose axes are yielded.

    Args:
        path: PNG file, saved when the block ends.
        instants: Number of instants, or times, s; see draw_scene.
        height: Of the figure, inches. share: Height of the scenes over that of the diagrams.
        note: Fine print.
    """
    with sheet(path, (2, 6), (7.6, height), note, height_ratios=(share, 1)) as (figure, axes):
        layout: Any = figure.get_layout_engine()
        layout.set(rect=RECT)
        grid = axes[0, 0].get_subplotspec().get_gridspec()
        for ax in axes.flat:
            ax.remove()
        for scene, place in zip(scenes, (slice(0, 3), slice(3, 6)), strict=True):
            ax = figure.add_subplot(grid[0, place], projection="3d")
            frame_up(ax, scenes, 1.12)
            draw_scene(ax, scene, instants)
        first, second, third = (figure.add_subplot(grid[1, place : place + 2]) for place in (0, 2, 4))
        yield first, second, third


def joint_curves(ax: Any, t: Array, values: Array, names: Iterable[str], **legend: Any) -> None:
    """A quantity of every joint over time, shape (M, n), each in its colour; a legend where it is given options."""
    for i, name in enumerate(names):
        ax.plot(t, values[:, i], color=JOINT_COLORS[i], ls=DASHES[i % 4], lw=1.1, label=name)
    if legend:
        ax.legend(**{"loc": "lower center", "handlelength": 1.6, "columnspacing": 0.8} | legend)


def frame_up(ax: Any, scenes: Sequence[Scene], zoom: float = 1.0) -> None:
    """Limits around all of the scenes, equal scales, quiet panes."""
    clouds = [scene.points.reshape(-1, 3) for scene in scenes]
    clouds += [scene.edges(k).reshape(-1, 3) for scene in scenes for k in (0, len(scene.t) // 2, len(scene.t) - 1)]
    clouds += [np.stack([part.ravel() for part in s.surface], axis=1) for s in scenes if s.surface is not None]
    clouds += [part for scene in scenes for part in (scene.outline, scene.mark) if part is not None]
    points = np.vstack(clouds)
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.03 * float((high - low).max())
    low, high = low - margin, high + margin
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    ax.set_box_aspect(high - low, zoom=zoom)
    ax.view_init(*scenes[0].view)
    ax.patch.set_alpha(0.0)  # solid axes overlap
    for name, axis, extent in zip("xyz", (ax.xaxis, ax.yaxis, ax.zaxis), high - low, strict=True):
        axis.set_major_locator(MaxNLocator(5 if extent > 0.6 * (high - low).max() else 3, prune="both"))
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis._axinfo["grid"].update(linewidth=0.4, color=(0.8, 0.8, 0.8, 1.0))
        axis.set_label_text(f"{name}, m", fontsize=7.5)
        axis.labelpad = -6
    ax.tick_params(labelsize=6.5, pad=-2)


def draw_scene(ax: Any, scene: Scene, instants: int | Sequence[float]) -> None:
    """The arm at some instants, the last one boldest, and the path of its tip."""
    _surface(ax, scene)
    times = np.linspace(scene.t[0], scene.t[-1], instants) if isinstance(instants, int) else np.asarray(instants)
    for number, time in enumerate(times):
        k, shade = scene.nearest(time), 0.25 + 0.75 * number / max(len(times) - 1, 1)
        ax.plot(*scene.points[k].T, "-o", color=COLORS[scene.color], lw=1.6, ms=2.4, alpha=shade)
        if scene.boxes:
            ax.add_collection3d(Line3DCollection(scene.edges(k), colors=COLORS["grey"], linewidths=0.7, alpha=shade))
        if scene.tool:
            ax.plot(*scene.axis(k).T, color=COLORS["black"], lw=1.4, alpha=shade)
    ax.plot(*scene.frames.tip.T, color=COLORS["green"], lw=1.4)
    ax.set_title(scene.title, y=1.0, pad=0)


def animate(path: Path, scenes: Sequence[Scene], *, frames: int, seconds: float, note: str) -> None:
    """The scenes side by side, moving together; a GIF.

    Args:
        frames: How many pictures. seconds: Between two of them.
        note: Fine print.
    """
    size = (3.6 * len(scenes), 3.9)
    with sheet(None, (1, len(scenes)), size, subplot_kw={"projection": "3d"}) as (figure, axes):
        figure.set_dpi(DPI)
        layout: Any = figure.get_layout_engine()
        layout.set(rect=RECT)
        moving = []
        for ax, scene in zip(axes[0], scenes, strict=True):
            frame_up(ax, scenes)
            _surface(ax, scene)
            if scene.nearest_points is not None:
                ax.plot(*scene.nearest_points.T, "-o", color=COLORS["purple"], lw=2.0, ms=4.0)
            ax.plot(*scene.frames.tip.T, color=COLORS["green"], ls=":", lw=1.2)
            ax.set_title(scene.title, y=1.0, pad=0)
            (arm,) = ax.plot([], [], [], "-o", color=COLORS[scene.color], lw=2.2, ms=3.2)
            (trace,) = ax.plot([], [], [], color=COLORS["green"], lw=2.4, label="path of the tip")
            (tool,) = ax.plot([], [], [], color=COLORS["black"], lw=1.8)
            spot = None if scene.mark is None else ax.plot([], [], [], "D", color=COLORS["black"], ms=5)[0]
            boxes = Line3DCollection(scene.edges(0), colors=COLORS["grey"], linewidths=0.9)
            if scene.boxes:
                ax.add_collection3d(boxes)
            moving.append((scene, arm, trace, tool, boxes, spot))
        # the first picture gives the palette: every colour is in it
        figure.legend(handles=[moving[0][2]], loc="upper left", fontsize=7)
        clock = figure.suptitle("time 0.0 s", fontsize=9)
        add_note(figure, note)

        def pictures() -> Iterator[Figure]:
            for time in np.linspace(scenes[0].t[0], scenes[0].t[-1], frames):
                for scene, arm, trace, tool, boxes, spot in moving:
                    k = scene.nearest(time)
                    arm.set_data_3d(*scene.points[k].T)
                    trace.set_data_3d(*scene.frames.tip[: k + 1].T)
                    if scene.tool:
                        tool.set_data_3d(*scene.axis(k).T)
                    if spot is not None and scene.mark is not None:
                        spot.set_data_3d(*scene.mark[k : k + 1].T)
                    if scene.boxes:
                        boxes.set_segments(scene.edges(k))
                clock.set_text(f"time {time:.1f} s")
                yield figure

        gif(path, pictures(), seconds=seconds, colors=PALETTE)


def _surface(ax: Any, scene: Scene) -> None:
    if scene.surface is not None:
        ax.plot_surface(*scene.surface, color=COLORS["grey"], alpha=0.18, lw=0, shade=False)
    if scene.outline is not None:
        ax.plot(*scene.outline.T, color=COLORS["grey"], lw=1.4)
