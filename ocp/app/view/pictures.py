"""Draw pictures of a motion for a report: the robot and obstacles at several times, and joint curves with limits."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import HalfSpace, Machine, MovingObstacle
from models.checks import Array
from models.shapes.hull import convex_hull
from models.shapes.shapes import Shape
from ocp.app.check.interpolation import Motion
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
from ocp.app.view.rendering import PICTURE_STYLE, Camera, Floor, Layer, parts_in_world, render, tube
from ocp.audit.clearance import separation_frames
from ocp.motion.plan import Plan
from ocp.motion.result.path_plan import PathPlan
from ocp.motion.tasks.limits import JointBounds
from ocp.problem.problem import Problem
from ocp.problem.separation import Separation
from ocp.solution import Solution

__all__ = [
    "STYLE",
    "Obstacle",
    "Solid",
    "add_legend",
    "as_svg",
    "draw_curves",
    "draw_joints",
    "draw_limits",
    "draw_scene",
    "line_style",
    "obstacles_of",
    "obstacles_of_plan",
    "obstacles_of_shapes",
]

Solid = tuple[Array, NDArray[np.intp]]
"""Corners (k, 3), m, and triangles as their indices (f, 3)."""


class Obstacle(NamedTuple):
    """A body, the convex hull of points inflated by a radius, or a half-space.

    Attributes:
        core: Points. Shape (k, 3), m; for a half-space one point of its plane.
        radius: m.
        normal: Outward normal of a half-space, shape (3,); otherwise None.
        rotations, positions: Frame of the body in world at the times of a motion, shapes (M, 3, 3) and (M, 3), m; None
            if it is static, with points in world.
    """

    core: Array
    radius: float = 0.0
    normal: Array | None = None
    rotations: Array | None = None
    positions: Array | None = None

    def solid(self, points: Array) -> Solid:
        """Return the surface in the body's own frame; for a half-space a square near points (k, 3)."""
        if self.normal is None:
            offsets = np.zeros((1, 3))
            if self.radius > 0:
                u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 13)[:-1], np.linspace(-np.pi / 2, np.pi / 2, 7))
                unit = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], axis=-1)
                offsets = self.radius * unit.reshape(-1, 3)
            hull = convex_hull((np.asarray(self.core)[:, None] + offsets).reshape(-1, 3))
            return np.asarray(hull.vertices), hull.faces
        low, high = points.min(axis=0), points.max(axis=0)
        middle = (low + high) / 2
        middle = middle - self.normal * (self.normal @ (middle - self.core[0]))
        side = np.cross(self.normal, np.eye(3)[int(np.abs(self.normal).argmin())])
        side /= np.linalg.norm(side)
        sides = SURFACE_STYLE.patch * float(np.linalg.norm(high - low)) * np.stack([side, np.cross(self.normal, side)])
        return middle + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ sides, np.array([[0, 1, 2], [0, 2, 3]])


def obstacles_of_shapes(shapes: Iterable[Shape]) -> list[Obstacle]:
    """Return static obstacles of shapes in world."""
    return [
        Obstacle(np.asarray(shape.point, dtype=float)[None], 0.0, np.asarray(shape.normal, dtype=float))
        if isinstance(shape, HalfSpace)
        else Obstacle(np.asarray(shape.core), shape.swept_radius)
        for shape in shapes
    ]


def obstacles_of(parts: Sequence[tuple[Solution, str, Array]]) -> list[Obstacle]:
    """Return the obstacles in the problems of solutions.

    A moving obstacle is attached to a frame that depends on time but on no state.

    Args:
        parts: Parts of a motion in sequence: a solution, whose problem declares the separations; the suffix of the
            names of its states, "" for a single part; and the times in the solution, shape (K,), s, to evaluate.
    """
    static: dict[str, Obstacle] = {}
    moving: dict[str, list[tuple[Any, Array, Array]]] = {}
    for solution, suffix, times in parts:
        problem = solution.problem
        if problem is None:
            continue
        placements: list[tuple[Separation, Any]] | None = None
        for separation in problem.declared.apart.values():
            if not all(name.endswith(suffix) for name in separation.movers):
                continue
            frames_of_hulls = {hull.frame for hull in separation.hulls.values()}
            moving_frames = [frame for frame in frames_of_hulls if _moves(problem, separation, frame)]
            for name, hull in separation.hulls.items():
                if hull.frame < 0:
                    static[name] = Obstacle(hull.core, hull.radius, hull.normal if hull.normal.size else None)
                elif hull.frame in moving_frames:
                    if placements is None:
                        placements = separation_frames(problem, solution, times, suffix)
                    frames = next(frames for one, frames in placements if one is separation)
                    poses = frames.rotations[:, hull.frame], frames.positions[:, hull.frame]
                    moving.setdefault(name, []).append((hull, *poses))
    obstacles = list(static.values())
    for segments in moving.values():
        hull = segments[0][0]
        rotations, positions = (np.concatenate([segment[k] for segment in segments]) for k in (1, 2))
        if len(positions) == sum(len(times) for *_, times in parts):
            obstacles.append(Obstacle(hull.core, hull.radius, None, rotations, positions))
    return obstacles


def obstacles_of_plan(plan: Plan, times: Array) -> list[Obstacle]:
    """Return the obstacles of a plan at increasing times (M,), s."""
    if isinstance(plan, PathPlan):
        obstacles = () if plan.constraints is None else plan.constraints.scene.obstacles
        return obstacles_of_shapes(shape for shape in obstacles if not isinstance(shape, MovingObstacle))
    return obstacles_of(plan.solved_parts(times))


def _moves(problem: Problem, separation: Separation, frame: int) -> bool:
    """Return whether a frame moves by time alone."""
    if frame < 0:
        return False
    rows = separation.placements[12 * frame : 12 * frame + 12]
    states = ca.vertcat(*(ca.vec(state.symbol) for state in problem.declared.states.values()))
    return bool(ca.depends_on(rows, problem.time)) and not ca.depends_on(rows, states)


STYLE: Any = {"font.size": 7.5, "axes.titlesize": 8.5, "axes.spines.top": False, "axes.spines.right": False}
"""Settings of matplotlib."""
STYLE |= {"text.parse_math": False}  # a joint's name may contain a dollar
DASHES: tuple[Any, ...] = ((0, (1, 1)), (0, (5, 1.5)), (0, (4, 1.2, 1, 1.2)))
"""Line styles of the motions compared with a plan, so that colour is not the only distinction."""


def draw_scene(
    machine: Machine, motion: Motion, bases: Array | None, obstacles: Sequence[Obstacle], folders: Sequence[Any] = ()
) -> bytes:
    """Return a PNG of the robot at several times (the last one solid), its tip path, and obstacles.

    Moving obstacles are drawn at the final time; `obstacles` has them at uniform times of the motion.
    """
    from matplotlib.colors import to_rgb
    from matplotlib.image import imsave

    times = np.linspace(motion.t[0], motion.t[-1], PICTURE_STYLE.curve_points)
    base = None if bases is None else np.column_stack([np.interp(times, motion.t, column) for column in bases.T])
    frames = frames_along(machine, motion.position.at(times), base)
    appearance = appearance_of(machine.robot, folders)
    poses = [
        parts_in_world(appearance, frames, int(k))
        for k in np.linspace(0, PICTURE_STYLE.curve_points - 1, PICTURE_STYLE.poses)
    ]
    points = [part.vertices for parts in poses for part in parts]
    robot_points, static = np.vstack(points), []
    for obstacle in obstacles:
        corners, faces = obstacle.solid(robot_points)
        if obstacle.rotations is not None and obstacle.positions is not None:
            corners = corners @ obstacle.rotations[-1].T + obstacle.positions[-1]
        static.append(part_of("", corners, faces, (*to_rgb(SCENE), 1.0)))
        if obstacle.normal is None:
            points.append(corners)
    if machine.robot.tip is not None:
        points.append(frames.tip)
    all_points = np.vstack(points)
    low, high = all_points.min(axis=0), all_points.max(axis=0)
    size = float((high - low).max())
    if machine.robot.tip is not None:
        static.append(tube(frames.tip, PICTURE_STYLE.line * size, to_rgb(TIP)))
    transparent = [Layer(parts, 0.12 + 0.08 * k, to_rgb(PLAN)) for k, parts in enumerate(poses[:-1])]
    floor = None if machine.base_size else Floor(low[2], tuple((low + high)[:2] / 2), 1.1 * size, 0.1)
    layers = [Layer(poses[-1]), Layer(static), *transparent]
    picture = render(layers, Camera.around(all_points, PICTURE_STYLE.size), floor=floor)
    stream = io.BytesIO()
    imsave(stream, picture, format="png")
    return stream.getvalue()


def draw_curves(
    motion: Motion, names: Sequence[str], units: Sequence[str], bounds: JointBounds, faults: Sequence[Any]
) -> str:
    """Return an SVG of position, velocity and acceleration of every joint with its limits and faults."""
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
    """Draw position, velocity and acceleration of every joint over time into an empty figure, with limits and faults.

    The first of several motions is the plan; the others are compared with it.
    """
    import matplotlib

    kinds = [("position", ""), ("velocity", "/s"), ("acceleration", "/s²")]
    with matplotlib.rc_context(STYLE):
        grid: Any = figure.subplots(len(names), 3, squeeze=False, sharex=True)
        for column, (kind, per) in enumerate(kinds):
            samples = []
            for number, motion in reversed([*enumerate(motions.values())]):  # the plan last, on top
                own_times = motion.t[:: len(motion.t) // PICTURE_STYLE.curve_points + 1]
                times = np.unique(
                    np.concatenate([np.linspace(motion.t[0], motion.t[-1], PICTURE_STYLE.curve_points), own_times])
                )
                quantity = motion.quantity(kind)
                samples.append((number, times, None if quantity is None else quantity.pieces.at(times)))
            limit = getattr(bounds, kind, None)
            lower, upper = (bounds.lower, bounds.upper) if limit is None else (-limit, limit)
            min_range = PICTURE_STYLE.flat * max(
                (np.abs(values).max() for _, _, values in samples if values is not None), default=1.0
            )
            grid[0, column].set_title(kind)
            for row, name in enumerate(names):
                ax = grid[row, column]
                for number, times, values in samples:
                    if values is not None:
                        ax.plot(times, values[:, row], **line_style(number))
                draw_limits(ax, lower[row], upper[row], min_range)
                for fault in faults:
                    if fault.name == name and fault.kind == kind and fault.time is not None:
                        ax.axvline(fault.time, color=FAULT, lw=1.6)
                ax.set_ylabel(f"{name if column == 0 else ''}\n{units[row]}{per}", fontsize=7)
                ax.margins(x=0.01)
        for ax in grid[-1]:
            ax.set_xlabel("time, s")
        if len(motions) > 1:
            add_legend(figure, list(motions))


def draw_limits(ax: Any, lower: float, upper: float, min_range: float) -> None:
    """Draw the limits of the curves in an axes: dashed if they are close, as text if they are far.

    Curves with a range smaller than `min_range` are drawn as constant.
    """
    low, high = ax.dataLim.y0, ax.dataLim.y1
    if not np.isfinite([low, high]).all():
        low = high = 0.0
    span = max(high - low, min_range) or 1.0
    distant = []
    for limit in (lower, upper):
        if low - PICTURE_STYLE.limit_distance * span <= limit <= high + PICTURE_STYLE.limit_distance * span:
            ax.axhline(limit, color=LIMIT, lw=0.9, ls=(0, (5, 2)))
            low, high = min(low, limit), max(high, limit)
        elif np.isfinite(limit):
            distant.append(f"{limit:.3g}")
    if distant:
        words = f"limit{'s' if len(distant) > 1 else ''} {', '.join(distant)}"
        ax.annotate(words, (0.99, 0.97), xycoords="axes fraction", ha="right", va="top", color=LIMIT, fontsize=6)
    margin = max(0.06 * (high - low), 0.55 * (span - (high - low)))
    ax.set_ylim(low - margin, high + margin + (0.1 * span if distant else 0.0))


def line_style(number: int) -> dict[str, Any]:
    """Return the line style of a plan, number 0, or of a motion compared with it."""
    return {"color": PLAN, "lw": 1.4} if number == 0 else {"color": COMPARED, "lw": 1.1, "ls": DASHES[number % 3]}


def add_legend(figure: Any, names: Sequence[str]) -> None:
    """Add a legend below a figure: the name of the plan, and those of the motions compared with it."""
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], **line_style(number)) for number in range(len(names))]
    figure.legend(lines, names, loc="outside lower center", ncols=len(names), frameon=False, fontsize=8)


def as_svg(figure: Any) -> str:
    """Return a figure as an `svg` element for a page."""
    import matplotlib

    stream = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "selfmotion"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    text = stream.getvalue()
    return text[text.index("<svg") :]
