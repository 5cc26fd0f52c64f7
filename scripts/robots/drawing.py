"""Robots as they look, for the figures and animations of the gallery: rendered with their meshes, without a display.

`Scene` is a motion to draw; `page` puts two of them, side by side and seen alike, above three diagrams; `draw_scene`
puts one into axes of any figure, and `animate` makes an endless film of them. The meshes, tools and frames are those
that the viewer shows (`view.appearance`), drawn by `view.rendering`. One colour is the plan's,
"blue", and one that of what it is compared with, "orange".
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from models import Robot
from models.checks import Array
from ocp.app.view.appearance import SURFACE_STYLE, Appearance, Frames, Part, appearance_of, part_of, rod
from ocp.app.view.rendering import Camera, Floor, Layer, parts_in_world, render, tube
from scripts.drawing import COLORS, DASHES, add_note, gif, sheet

JOINT_COLORS = [COLORS[name] for name in ("blue", "orange", "green", "purple", "yellow", "sky", "black")]
DPI = 100
PALETTE = 128
VIEW = (22.0, -58.0)  # elevation, azimuth, deg
SHARPER = 1.4
"""Pixels of a rendered picture for each of the figure that it stands in."""
LINE = 0.0028
"""Radius of a line, of the size of the scene."""
GHOSTS = (0.16, 0.34)
"""Opacity of the first and of the last of the earlier postures."""
FILM = 80_000
"""Faces of a robot in an animation."""
LEGEND: Any = {"fontsize": 6.3, "loc": "lower center", "handlelength": 1.6, "columnspacing": 0.8, "borderpad": 0.1}
"""Of many curves, in small letters."""
LOOKS = 9
"""Times at which a scene is measured."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A motion to draw.

    Attributes:
        title: Above it.
        robot: What moves.
        frames: Along the motion. t: Times of them, s. Shape (M,).
        color: Of the title, of earlier postures and of the mark; a name of drawing.COLORS.
        surface: Points of a surface (x, y, z), (k, l) each, that is worked on, m.
        view: Elevation and azimuth, deg.
        floor: Height of level ground, m; None where there is none.
        footprint: Corners of what the robot stands on, on the ground. Shape (k, 2), m.
        mark: A point on the ground that moves, such as the zero moment point. Shape (M, 2), m.
        nearest_points: Of two bodies, where they come nearest to each other along the motion. Shape (2, 3), m.
        solids: What stands around, in world.
        detail: Faces of the robot, at most.
        root_color: Of the root link, red, green, blue and opacity; None: that of its description.
    """

    title: str
    robot: Robot
    frames: Frames
    t: Array
    color: str
    surface: tuple[Array, Array, Array] | None = None
    view: tuple[float, float] = VIEW
    floor: float | None = None
    footprint: Array | None = None
    mark: Array | None = None
    nearest_points: Array | None = None
    solids: tuple[Part, ...] = ()
    detail: int = SURFACE_STYLE.max_faces
    root_color: tuple[float, float, float, float] | None = None

    @cached_property
    def looks(self) -> Appearance:
        """Of the robot; without the zones of its description that are no bodies."""
        looks = appearance_of(self.robot, most=self.detail)
        parts = [part for part in looks.parts if part.color != SURFACE_STYLE.zone]
        if self.root_color is not None:
            parts = [replace(p, color=self.root_color) if p.link == self.robot.root else p for p in parts]
        return Appearance(tuple(parts), looks.missing)

    @cached_property
    def corners(self) -> Array:
        """Of boxes around everything, at some times of the motion. Shape (k, 3), m."""
        clouds = [self.frames.tip, *(part.vertices for part in self.solids)]
        for k in np.linspace(0, len(self.t) - 1, LOOKS).astype(int):
            clouds += [_box(part.vertices) for part in parts_in_world(self.looks, self.frames, k)]
        if self.surface is not None:
            clouds.append(np.stack([np.ravel(part) for part in self.surface], axis=1))
        for flat in (self.footprint, self.mark):
            if flat is not None:
                clouds.append(np.column_stack([flat, np.full(len(flat), self.floor or 0.0)]))
        return np.vstack(clouds)

    @property
    def size(self) -> float:
        """Greatest extent, m."""
        return float(np.ptp(self.corners, axis=0).max())

    def nearest(self, time: float) -> int:
        """Number of the sample nearest to a time."""
        return int(np.abs(self.t - time).argmin())

    @cached_property
    def ground(self) -> Floor | None:
        """The floor, as far as it is seen."""
        if self.floor is None:
            return None
        low, high = self.corners.min(axis=0), self.corners.max(axis=0)
        x, y = (low + high)[:2] / 2
        return Floor(self.floor, (float(x), float(y)), 1.1 * self.size + 0.2, 0.1 if self.size < 1.6 else 0.25)

    @cached_property
    def still(self) -> list[Part]:
        """What does not move: the way of the tip, what is worked on, what the robot stands on."""
        radius, level = LINE * self.size, (self.floor or 0.0) + 1e-3
        result = [tube(self.frames.tip, radius, to_rgb(COLORS["green"])), *self.solids]
        if self.surface is not None:
            result.append(_plate(*self.surface))
        if self.footprint is not None:
            corners = np.column_stack([self.footprint, np.full(len(self.footprint), level)])
            for one, other in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                result.append(tube([one, other], radius, to_rgb(COLORS["grey"])))
        if self.nearest_points is not None:
            result.append(tube(self.nearest_points, 1.6 * radius, to_rgb(COLORS["purple"])))
        return result

    def at(self, k: int) -> list[Part]:
        """The robot at sample k, and its mark."""
        result = parts_in_world(self.looks, self.frames, k)
        if self.mark is not None:
            foot = np.append(self.mark[k], (self.floor or 0.0) + 1e-3)
            spot = rod(foot, foot + np.array([0.0, 0.0, 0.012]) * self.size, 0.014 * self.size)
            result.append(part_of("", spot.vertices, spot.faces, (*to_rgb(COLORS[self.color]), 1.0)))
        return result


def camera_of(scenes: Sequence[Scene], size: tuple[int, int]) -> Camera:
    """The nearest camera that sees the whole of all scenes, from the first one's side, into pixels of a size."""
    return Camera.around(np.vstack([scene.corners for scene in scenes]), size, *scenes[0].view)


def draw_scene(
    ax: Any, scene: Scene, moments: int | Sequence[float], size: tuple[int, int], beside: Sequence[Scene] = ()
) -> None:
    """The robot with its meshes at some times into axes: at the last one solid, before that pale, newer ones denser.

    Args:
        ax: Axes of matplotlib, which show nothing else then.
        moments: Number of times from begin to end, or times, s.
        size: Width and height of the picture, pixels.
        beside: Other scenes, which are to be seen from the same place.
    """
    times = np.linspace(scene.t[0], scene.t[-1], moments) if isinstance(moments, int) else np.asarray(moments)
    numbers = [scene.nearest(time) for time in times]
    layers = [Layer(scene.at(numbers[-1])), Layer(scene.still)]
    for k, opacity in zip(numbers[:-1], np.linspace(*GHOSTS, max(len(numbers) - 1, 1)), strict=False):
        body = [part for part in parts_in_world(scene.looks, scene.frames, k) if part.color[3] >= 1]
        layers.append(Layer(body, float(opacity), to_rgb(COLORS[scene.color])))
    picture = render(layers, camera_of([scene, *beside], size), floor=scene.ground)
    ax.imshow(picture, interpolation="antialiased")
    ax.set_axis_off()
    ax.set_title(scene.title, color=COLORS[scene.color], fontweight="bold")


@contextmanager
def page(
    path: Path,
    scenes: Sequence[Scene],
    moments: int | Sequence[float] | Sequence[Array],
    *,
    height: float,
    share: float,
    note: str,
    title: str = "",
) -> Iterator[tuple[Any, Any, Any]]:
    """A figure of two scenes at some instants, seen alike, above three diagrams, whose axes are yielded.

    Args:
        path: PNG file, saved when the block ends, with what `sheet` puts beside it.
        moments: Number of instants, or times, s; see draw_scene. Also times of each scene.
        height: Of the figure, inches. share: Height of the scenes over that of the diagrams.
        note: What is assumed; its first sentence stands below the figure.
        title: What the figure shows, a sentence.
    """
    with sheet(path, (2, 6), (7.6, height), note, title=title, height_ratios=(share, 1)) as (figure, axes):
        grid = axes[0, 0].get_subplotspec().get_gridspec()
        for ax in axes.flat:
            ax.remove()
        wide = 3.75
        tall = (height - 1.5) * share / (1 + share)
        size = round(SHARPER * 150 * wide), round(SHARPER * 150 * tall)
        own: Any = moments if np.ndim(moments) == 2 else [moments] * len(scenes)
        for scene, times, place in zip(scenes, own, (slice(0, 3), slice(3, 6)), strict=True):
            draw_scene(figure.add_subplot(grid[0, place]), scene, times, size, scenes)
        first, second, third = (figure.add_subplot(grid[1, place : place + 2]) for place in (0, 2, 4))
        yield first, second, third


def joint_curves(ax: Any, t: Array, values: Array, names: Iterable[str], **legend: Any) -> None:
    """A quantity of every joint over time, shape (M, n), each in its colour; a legend where it is given options."""
    for i, name in enumerate(names):
        ax.plot(t, values[:, i], color=JOINT_COLORS[i], ls=DASHES[i % 4], lw=1.1, label=name)
    if legend:
        ax.legend(**{"loc": "lower center", "handlelength": 1.6, "columnspacing": 0.8} | legend)


def animate(path: Path, scenes: Sequence[Scene], *, frames: int, seconds: float, note: str = "") -> None:
    """The scenes side by side, moving together, the robots with their meshes; a GIF.

    Args:
        frames: How many pictures. seconds: Between two of them.
        note: Its first sentence stands below.
    """
    wide, tall = 3.6, 3.5
    scenes = [replace(scene, detail=FILM) for scene in scenes]
    with sheet(None, (1, len(scenes)), (wide * len(scenes), tall + 0.4)) as (figure, axes):
        figure.set_dpi(DPI)
        camera = camera_of(scenes, (round(DPI * wide), round(DPI * (tall - 0.4))))
        shown = []
        for ax, scene in zip(axes[0], scenes, strict=True):
            shown.append(ax.imshow(np.full((camera.size[1], camera.size[0], 3), 255, dtype=np.uint8)))
            ax.set_axis_off()
            ax.set_title(scene.title, color=COLORS[scene.color], fontweight="bold")
        clock = figure.suptitle("time 0.0 s", fontsize=9)
        add_note(figure, note)

        def pictures() -> Iterator[Figure]:
            for time in np.linspace(scenes[0].t[0], scenes[0].t[-1], frames):
                for scene, image in zip(scenes, shown, strict=True):
                    layers = [Layer(scene.at(scene.nearest(time))), Layer(scene.still)]
                    image.set_data(render(layers, camera, floor=scene.ground))
                clock.set_text(f"time {time:.1f} s")
                yield figure

        gif(path, pictures(), seconds=seconds, colors=PALETTE, moving=[*shown, clock])


def _box(points: Array) -> Array:
    low, high = points.min(axis=0), points.max(axis=0)
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def _plate(x: Array, y: Array, z: Array) -> Part:
    """A surface given by a grid of points."""
    rows, columns = x.shape
    i, j = (one.ravel() for one in np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij"))
    a = i * columns + j
    faces = np.concatenate(
        [np.stack([a, a + 1, a + columns], axis=1), np.stack([a + 1, a + columns + 1, a + columns], axis=1)]
    )
    return part_of("", np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1), faces, (0.80, 0.81, 0.83, 1.0))
