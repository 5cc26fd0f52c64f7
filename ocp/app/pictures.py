"""Pictures of a motion for a report: the robot as it looks at several times, the curves of its joints with limits."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from models import Machine
from models.arrays import Array
from ocp.app.appearance import appearance_of, part_of
from ocp.app.colors import COMPARED, FAULT, LIMIT, PLAN, SURROUNDINGS, TIP
from ocp.app.frames import frames_along
from ocp.app.obstacles import Obstacle
from ocp.app.pieces import Motion
from ocp.app.rendering import PICTURE_STYLE, Camera, Floor, Layer, placed, render, tube
from ocp.tasks.limits import JointBounds

__all__ = ["STYLE", "add_names", "as_svg", "curves", "draw_joints", "look", "scene", "show_limits"]

STYLE: Any = {"font.size": 7.5, "axes.titlesize": 8.5, "axes.spines.top": False, "axes.spines.right": False}
STYLE |= {"text.parse_math": False}  # a dollar in a joint's name is a dollar
DASHES: tuple[Any, ...] = ((0, (1, 1)), (0, (5, 1.5)), (0, (4, 1.2, 1, 1.2)))
"""Of what a plan is compared with, so that nothing is known by its colour alone."""


def scene(
    machine: Machine, motion: Motion, bases: Array | None, around: Sequence[Obstacle], folders: Sequence[Any] = ()
) -> bytes:
    """The robot as it looks at several times, at the last one solid, its tip's way, and what is around; a PNG.

    Obstacles that move stand where they are at the end; `around` has them at equal times of the motion.
    """
    from matplotlib.colors import to_rgb
    from matplotlib.image import imsave

    times = np.linspace(motion.t[0], motion.t[-1], PICTURE_STYLE.curve_points)
    places = None if bases is None else np.column_stack([np.interp(times, motion.t, column) for column in bases.T])
    frames = frames_along(machine, motion.position.at(times), places)
    looks = appearance_of(machine.robot, folders)
    shown = [placed(looks, frames, int(k)) for k in np.linspace(0, PICTURE_STYLE.curve_points - 1, PICTURE_STYLE.poses)]
    clouds = [part.vertices for parts in shown for part in parts]
    before, still = np.vstack(clouds), []
    for one in around:
        corners, faces = one.solid(before)
        if one.rotations is not None and one.positions is not None:
            corners = corners @ one.rotations[-1].T + one.positions[-1]
        still.append(part_of("", corners, faces, (*to_rgb(SURROUNDINGS), 1.0)))
        if one.normal is None:
            clouds.append(corners)
    if machine.robot.tip is not None:
        clouds.append(frames.tip)
    cloud = np.vstack(clouds)
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    size = float((high - low).max())
    if machine.robot.tip is not None:
        still.append(tube(frames.tip, PICTURE_STYLE.line * size, to_rgb(TIP)))
    pale = [Layer(parts, 0.12 + 0.08 * k, to_rgb(PLAN)) for k, parts in enumerate(shown[:-1])]
    floor = None if machine.base_size else Floor(low[2], tuple((low + high)[:2] / 2), 1.1 * size, 0.1)
    layers = [Layer(shown[-1]), Layer(still), *pale]
    picture = render(layers, Camera.around(cloud, PICTURE_STYLE.size), floor=floor)
    stream = io.BytesIO()
    imsave(stream, picture, format="png")
    return stream.getvalue()


def curves(
    motion: Motion, names: Sequence[str], units: Sequence[str], bounds: JointBounds, faults: Sequence[Any]
) -> str:
    """Position, velocity and acceleration of every joint with its limits, and where faults are; an SVG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(PICTURE_STYLE.width, 0.4 + 1.15 * len(names)), layout="constrained")
    draw_joints(figure, {"": motion}, names, units, bounds, faults)
    return as_svg(figure)


def draw_joints(
    figure: Any,
    motions: Mapping[str, Motion],
    names: Sequence[str],
    units: Sequence[str],
    bounds: JointBounds,
    faults: Sequence[Any] = (),
) -> None:
    """Position, velocity and acceleration of every joint over time into an empty figure, with limits and faults.

    Of several motions, by name, the first is the plan, and the others are what it is compared with.
    """
    import matplotlib

    kinds = [("position", ""), ("velocity", "/s"), ("acceleration", "/s²")]
    with matplotlib.rc_context(STYLE):
        grid: Any = figure.subplots(len(names), 3, squeeze=False, sharex=True)
        for column, (kind, per) in enumerate(kinds):
            drawn = []
            for number, motion in reversed([*enumerate(motions.values())]):  # the plan on top
                spread = motion.t[:: len(motion.t) // PICTURE_STYLE.curve_points + 1]
                times = np.unique(
                    np.concatenate([np.linspace(motion.t[0], motion.t[-1], PICTURE_STYLE.curve_points), spread])
                )
                one = motion.along(kind)
                drawn.append((number, times, None if one is None else one.pieces.at(times)))
            most = getattr(bounds, kind, None)
            lower, upper = (bounds.lower, bounds.upper) if most is None else (-most, most)
            least = PICTURE_STYLE.flat * max(
                (np.abs(values).max() for _, _, values in drawn if values is not None), default=1.0
            )
            grid[0, column].set_title(kind)
            for row, name in enumerate(names):
                ax = grid[row, column]
                for number, times, values in drawn:
                    if values is not None:
                        ax.plot(times, values[:, row], **look(number))
                show_limits(ax, lower[row], upper[row], least)
                for fault in faults:
                    if fault.name == name and fault.kind == kind and fault.time is not None:
                        ax.axvline(fault.time, color=FAULT, lw=1.6)
                ax.set_ylabel(f"{name if column == 0 else ''}\n{units[row]}{per}", fontsize=7)
                ax.margins(x=0.01)
        for ax in grid[-1]:
            ax.set_xlabel("time, s")
        if len(motions) > 1:
            add_names(figure, list(motions))


def show_limits(ax: Any, lower: float, upper: float, least: float) -> None:
    """Limits of the curves in some axes: dashed where they are near, and said in words where they are far.

    Curves that change by less than `least` are drawn as ones that do not.
    """
    low, high = ax.dataLim.y0, ax.dataLim.y1
    if not np.isfinite([low, high]).all():
        low = high = 0.0
    span = max(high - low, least) or 1.0
    far = []
    for limit in (lower, upper):
        if low - PICTURE_STYLE.limit_room * span <= limit <= high + PICTURE_STYLE.limit_room * span:
            ax.axhline(limit, color=LIMIT, lw=0.9, ls=(0, (5, 2)))
            low, high = min(low, limit), max(high, limit)
        elif np.isfinite(limit):
            far.append(f"{limit:.3g}")
    if far:
        words = f"limit{'s' if len(far) > 1 else ''} {', '.join(far)}"
        ax.annotate(words, (0.99, 0.97), xycoords="axes fraction", ha="right", va="top", color=LIMIT, fontsize=6)
    room = max(0.06 * (high - low), 0.55 * (span - (high - low)))
    ax.set_ylim(low - room, high + room + (0.1 * span if far else 0.0))


def look(number: int) -> dict[str, Any]:
    """How the curve of a plan, number 0, and those of what it is compared with are drawn."""
    return {"color": PLAN, "lw": 1.4} if number == 0 else {"color": COMPARED, "lw": 1.1, "ls": DASHES[number % 3]}


def add_names(figure: Any, names: Sequence[str]) -> None:
    """A legend below a figure: the plan's name, and those of what it is compared with."""
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], **look(number)) for number in range(len(names))]
    figure.legend(lines, names, loc="outside lower center", ncols=len(names), frameon=False, fontsize=8)


def as_svg(figure: Any) -> str:
    """A figure as the element `svg`, for a page."""
    import matplotlib

    stream = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "selfmotion"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    text = stream.getvalue()
    return text[text.index("<svg") :]
