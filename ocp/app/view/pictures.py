"""Pictures of a motion for a report: the robot as it looks at several times, the curves of its joints with limits.

What stands or moves around a machine, for pictures and for the view: bodies, half-spaces as pieces of a plane.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import HalfSpace, Machine
from models.arrays import Array
from models.shapes.hull import convex_hull
from models.shapes.shapes import Shape
from ocp.app.check.pieces import Motion
from ocp.app.view.appearance import (
    COMPARED,
    FAULT,
    LIMIT,
    PLAN,
    SCENE,
    SURFACE_STYLE,
    TIP,
    appearance_of,
    frames_along,
    part_of,
)
from ocp.app.view.rendering import PICTURE_STYLE, Camera, Floor, Layer, placed, render, tube
from ocp.audit.clearance import separation_frames
from ocp.motion.plan import Plan
from ocp.motion.tasks.limits import JointBounds
from ocp.problem.problem import Problem
from ocp.problem.separation import Separation
from ocp.solution import Solution

__all__ = [
    "STYLE",
    "Obstacle",
    "Solid",
    "add_names",
    "as_svg",
    "curves",
    "draw_joints",
    "look",
    "looks_of",
    "obstacles_of",
    "of_shapes",
    "scene",
    "show_limits",
]

Solid = tuple[Array, NDArray[np.intp]]
"""Corners (k, 3), m, and triangles of them (f, 3)."""


class Obstacle(NamedTuple):
    """A body, the hull of points swelled by a radius, or all that lies behind a plane.

    Attributes:
        core: Points. Shape (k, 3), m; of a half-space one of its plane.
        radius: m.
        normal: Of a half-space, out of it, shape (3,); else None.
        rotations, positions: Of the frame in world at the times of a motion, shapes (M, 3, 3) and (M, 3), m; None where
            it stands still, its points in world.
    """

    core: Array
    radius: float = 0.0
    normal: Array | None = None
    rotations: Array | None = None
    positions: Array | None = None

    def solid(self, before: Array) -> Solid:
        """Its surface, in its own frame; of a half-space a square of its plane before which points (k, 3) move."""
        if self.normal is None:
            around = np.zeros((1, 3))
            if self.radius > 0:
                u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 13)[:-1], np.linspace(-np.pi / 2, np.pi / 2, 7))
                unit = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], axis=-1)
                around = self.radius * unit.reshape(-1, 3)
            hull = convex_hull((np.asarray(self.core)[:, None] + around).reshape(-1, 3))
            return np.asarray(hull.vertices), hull.faces
        low, high = before.min(axis=0), before.max(axis=0)
        middle = (low + high) / 2
        middle = middle - self.normal * (self.normal @ (middle - self.core[0]))
        one = np.cross(self.normal, np.eye(3)[int(np.abs(self.normal).argmin())])
        one /= np.linalg.norm(one)
        sides = SURFACE_STYLE.patch * float(np.linalg.norm(high - low)) * np.stack([one, np.cross(self.normal, one)])
        return middle + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ sides, np.array([[0, 1, 2], [0, 2, 3]])


def of_shapes(shapes: Iterable[Shape]) -> list[Obstacle]:
    """Shapes that stand still in world."""
    return [
        Obstacle(np.asarray(one.point, dtype=float)[None], 0.0, np.asarray(one.normal, dtype=float))
        if isinstance(one, HalfSpace)
        else Obstacle(np.asarray(one.core), one.swept_radius)
        for one in shapes
    ]


def obstacles_of(solution: Solution, parts: Sequence[tuple[str, Array]]) -> list[Obstacle]:
    """Obstacles as the problem of a solution knows them.

    Those that move ride on a frame that depends on the time and on no state.

    Args:
        solution: Its problem says what has to stay apart; without one nothing is known.
        parts: Of a motion, one after the other: the suffix of the names of its states, "" of a whole, and the times in
            the solution, shape (K,), s, at which it is looked at.
    """
    problem = solution.problem
    if problem is None:
        return []
    still: dict[str, Obstacle] = {}
    moving: dict[str, list[tuple[Any, Array, Array]]] = {}
    for suffix, times in parts:
        placed: list[tuple[Separation, Any]] | None = None
        for apart in problem.declared.apart.values():
            if not all(name.endswith(suffix) for name in apart.movers):
                continue
            riding = [frame for frame in {hull.frame for hull in apart.hulls.values()} if _moves(problem, apart, frame)]
            for name, hull in apart.hulls.items():
                if hull.frame < 0:
                    still[name] = Obstacle(hull.core, hull.radius, hull.normal if hull.normal.size else None)
                elif hull.frame in riding:
                    if placed is None:
                        placed = separation_frames(problem, solution, times, suffix)
                    frames = next(frames for one, frames in placed if one is apart)
                    at = frames.rotations[:, hull.frame], frames.positions[:, hull.frame]
                    moving.setdefault(name, []).append((hull, *at))
    found = list(still.values())
    for pieces in moving.values():
        hull = pieces[0][0]
        rotations, positions = (np.concatenate([piece[k] for piece in pieces]) for k in (1, 2))
        if len(positions) == sum(len(times) for _, times in parts):
            found.append(Obstacle(hull.core, hull.radius, None, rotations, positions))
    return found


def looks_of(plan: Plan, times: Array) -> list[tuple[str, Array]]:
    """Ascending times of a plan (M,), s, part by part: the suffix of its states, and the times in its solution."""
    begins = [part.begin for part in plan.parts]
    which = np.clip(np.searchsorted(begins, times, "right") - 1, 0, len(begins) - 1)
    return [
        (part.suffix, plan._fractions(part, times[which == k]) * plan.solution.horizon)
        for k, part in enumerate(plan.parts)
    ]


def _moves(problem: Problem, apart: Separation, frame: int) -> bool:
    """Whether a frame moves by the time alone."""
    if frame < 0:
        return False
    rows = apart.placements[12 * frame : 12 * frame + 12]
    states = ca.vertcat(*(ca.vec(one.symbol) for one in problem.declared.states.values()))
    return bool(ca.depends_on(rows, problem.time)) and not ca.depends_on(rows, states)


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
        still.append(part_of("", corners, faces, (*to_rgb(SCENE), 1.0)))
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
