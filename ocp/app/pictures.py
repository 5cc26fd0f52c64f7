"""Pictures of a motion for a report: the robot's bodies at several times, and the curves of its joints with limits."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import Machine, Robot, link_frames
from models.arrays import Array
from models.shapes.bodies import bodies_of
from models.shapes.hull import convex_hull
from ocp.app.colors import COMPARED, FAULT, LIMIT, PLAN, SURROUNDINGS, TIP
from ocp.app.pieces import Motion
from ocp.problem.formulation import Sampler
from ocp.problem.hulls import frames_of
from ocp.solution import Solution
from ocp.tasks.limits import JointBounds

__all__ = [
    "STYLE",
    "Solid",
    "add_names",
    "as_svg",
    "curves",
    "draw_joints",
    "look",
    "obstacles_of",
    "scene",
    "show_limits",
    "solids_of",
]

Solid = tuple[Array, NDArray[np.intp]]
"""Corners (k, 3), m, and triangles of them (f, 3)."""

SHOWN = 4
"""Times at which the robot is shown."""
POINTS = 400
"""Of a curve."""
FAR = 1.5
"""Of the span of a curve: limits further from it would leave nothing of its shape to see."""
NOTHING = 1e-3
"""Of the largest value of a kind: what changes by less is rounding."""
WIDTH = 7.4
"""Of a picture, inches."""
STYLE: Any = {"font.size": 7.5, "axes.titlesize": 8.5, "axes.spines.top": False, "axes.spines.right": False}
DASHES: tuple[Any, ...] = ((0, (1, 1)), (0, (5, 1.5)), (0, (4, 1.2, 1, 1.2)))
"""Of what a plan is compared with, so that nothing is known by its colour alone."""


def solids_of(robot: Robot, folders: Sequence[Any] = ()) -> list[tuple[str, Solid]]:
    """Convex bodies of a robot's links, in the frames of the links; of meshes their hulls, once each."""
    found: list[tuple[str, Solid]] = []
    seen = set()
    for body in bodies_of(robot, folders=tuple(folders), missing="skip"):
        shape: Any = body.shape
        if body.mesh is not None:
            if id(body.mesh) in seen:
                continue
            seen.add(id(body.mesh))
            shape = body.mesh.hull
        found.append((body.link, solid_of(shape.core, shape.swelling)))
    return found


def solid_of(core: Array, radius: float) -> Solid:
    """The hull of points swelled by a radius."""
    around = np.zeros((1, 3))
    if radius > 0:
        u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 13)[:-1], np.linspace(-np.pi / 2, np.pi / 2, 7))
        around = radius * np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], axis=-1).reshape(-1, 3)
    hull = convex_hull((np.asarray(core)[:, None] + around).reshape(-1, 3))
    return np.asarray(hull.vertices), hull.faces


def obstacles_of(solution: Solution) -> tuple[Solid, ...]:
    """Obstacles that stand still, as the problem of a solution knows them; no half-spaces."""
    if solution.problem is None:
        return ()
    found = {}
    for apart in solution.problem.declared.apart.values():
        for name, hull in apart.hulls.items():
            if hull.frame < 0 and not hull.normal.size:
                found[name] = solid_of(hull.core, hull.radius)
    return tuple(found.values())


def scene(
    machine: Machine, motion: Motion, bases: Array | None, around: Sequence[Solid], folders: Sequence[Any] = ()
) -> bytes:
    """The robot at several times, the last boldest, its tip's way, and what stands around; a PNG."""
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

    robot = machine.robot
    base, q = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", machine.joint_size)
    frames = link_frames(robot, q, machine.world_from_base(base))
    tip = ca.SX(0, 1) if robot.tip is None else machine.tip_pose(base, q).position
    placed = ca.vertcat(*(ca.vertcat(ca.vec(frame.rotation), frame.position) for frame in frames.values()))
    sampler = Sampler([base, q], [placed, tip])
    times = np.linspace(motion.t[0], motion.t[-1], POINTS)
    places = np.zeros((POINTS, 0))
    if bases is not None:
        places = np.column_stack([np.interp(times, motion.t, column) for column in bases.T])
    placements, tips = sampler(places, motion.position.at(times))
    rotations, positions = frames_of(placements)
    numbers = {name: k for k, name in enumerate(frames)}
    solids = solids_of(robot, folders)
    figure = Figure(figsize=(WIDTH, 5.2))
    axes: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d")
    clouds = [positions[:, :-1].reshape(-1, 3)]
    for number, k in enumerate(np.linspace(0, POINTS - 1, SHOWN).astype(int)):
        shade = 0.16 + 0.74 * (number / (SHOWN - 1)) ** 2
        for link, (corners, faces) in solids:
            i = numbers[link]
            world = corners @ rotations[k, i].T + positions[k, i]
            clouds.append(world)
            axes.add_collection3d(Poly3DCollection(world[faces], facecolors=PLAN, alpha=shade, shade=True))
        if not solids:
            lines = [[positions[k, numbers[j.parent]], positions[k, numbers[j.child]]] for j in robot.joints]
            for line in np.array(lines):
                axes.plot(*line.T, "-o", color=PLAN, alpha=shade, lw=2, ms=3)
    for corners, faces in around:
        clouds.append(corners)
        axes.add_collection3d(Poly3DCollection(corners[faces], facecolors=SURROUNDINGS, alpha=0.35, shade=True))
    if tips.shape[1]:
        clouds.append(tips)
        axes.plot(*tips.T, color=TIP, lw=2.5, label="way of the tip")
        axes.legend(loc="upper left", frameon=False)
    cloud = np.vstack(clouds)
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    room = 0.02 * float((high - low).max()) + 1e-6
    axes.set(xlim=(low[0] - room, high[0] + room), ylim=(low[1] - room, high[1] + room))
    axes.set(zlim=(low[2] - room, high[2] + room), xlabel="x, m", ylabel="y, m", zlabel="z, m")
    axes.set_box_aspect(high - low + 2 * room, zoom=1.05)
    axes.view_init(22, -58)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=130, metadata={"Software": None})
    return stream.getvalue()


def curves(
    motion: Motion, names: Sequence[str], units: Sequence[str], bounds: JointBounds, faults: Sequence[Any]
) -> str:
    """Position, velocity and acceleration of every joint with its limits, and where faults are; an SVG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, 0.4 + 1.15 * len(names)), layout="constrained")
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
                spread = motion.t[:: len(motion.t) // POINTS + 1]
                times = np.unique(np.concatenate([np.linspace(motion.t[0], motion.t[-1], POINTS), spread]))
                one = motion.along(kind)
                drawn.append((number, times, None if one is None else one.pieces.at(times)))
            most = getattr(bounds, kind, None)
            lower, upper = (bounds.lower, bounds.upper) if most is None else (-most, most)
            least = NOTHING * max((np.abs(values).max() for _, _, values in drawn if values is not None), default=1.0)
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
        if low - FAR * span <= limit <= high + FAR * span:
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
