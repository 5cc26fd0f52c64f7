"""Gallery: a Panda runs a ring about its own foot, the hand held one way, and has to reconfigure on the way.

The hand points down and keeps its heading, while the arm comes round it: the last joint turns back by as much as the
first ones turn, and no motion has room for the whole ring. The picture shows why: over the time of the task the
postures that can be reached from its beginning, and those from which its end can be, have none in common. The task is
planned in the fewest pieces, here two, and the arm goes from the one to the other while the ring waits.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch
from numpy.typing import NDArray

import ocp
from models import CollisionScene, FixedBase
from models.checks import Array
from models.paths import rest_to_rest
from ocp import Audit, Limits, Reconfiguration, TipTask, inverse_kinematics
from ocp.app.view.appearance import frames_along
from ocp.app.view.rendering import tube
from ocp.motion.result.segmented_plan import SegmentedPlan
from ocp.motion.search.charts import Charts, SelfMotionManifolds, TimeSample
from ocp.motion.search.joint_space import JointSpace
from ocp.motion.search.search import AtlasSearch
from ocp.motion.search.steps import SquaredRates, Steps
from ocp.motion.search.value import ChartGraph
from ocp.motion.tasks.equations import bind, task_errors
from scripts.drawing import COLORS, DASHES, sheet
from scripts.robots.drawing import Scene, animate, draw_scene
from scripts.robots.robots import PANDA

__all__ = ["Reached", "configurations", "draw", "plan", "ring"]

RADIUS, HEIGHT = 0.6, 0.2  # m, of the ring about the first joint's axis
DURATION = 12.0  # s
DOWN = np.diag([1.0, -1.0, -1.0])
"""The hand, with one heading all along."""
SAMPLE_COUNT, COARSE = 97, 25
"""Times at which all postures are shown."""
STARTS = 24
"""Of inverse kinematics at each of them."""
FINE = 401  # times of a motion
VIEW = (32.0, -150.0)  # deg: the side on which the ring begins and ends
FRAMES, PACE = 120, 0.12  # pictures of the film, and s from each to the next
FROM_THE_BEGINNING, TO_THE_END, NEITHER = "blue", "green", "grey"
PALE: dict[str, Any] = {
    color: tuple(0.35 * part + 0.65 for part in to_rgb(COLORS[color])) for color in ("blue", "green", "grey")
}
LINE = 0.004  # m, radius of the ring that is drawn


@dataclass(frozen=True, eq=False)
class Reached:
    """All postures that do a task at some times, within limits and clear.

    Attributes:
        times: s. Shape (K,).
        charts: Parts of the set; their layers are the numbers of times. Shape (N,).
        from_the_beginning: Which are reached by motions from the first time on. to_the_end: From which motions lead to
            the last one. Shape (N,).
    """

    times: Array
    charts: Charts
    from_the_beginning: NDArray[np.bool_]
    to_the_end: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class InPieces:
    """A task in pieces, and all postures that do it.

    Attributes:
        machine, task: What moves, and what it does.
        segmented: Its segments and the motions between them.
        reached: All configurations.
    """

    machine: FixedBase
    task: TipTask
    segmented: SegmentedPlan
    reached: Reached

    @property
    def audits(self) -> list[Audit]:
        """Of the pieces, and of the ways between them."""
        ways = [one.motion for one in self.segmented.reconfigurations if one.motion is not None]
        return [motion.audit() for motion in (*self.segmented.segments, *ways)]

    @property
    def audit(self) -> Audit:
        """Of a motion that is not sound, if one is not, else of the first one."""
        return next((audit for audit in self.audits if not audit.passed), self.audits[0])

    def summary(self) -> dict[str, Any]:
        """A row of the summary."""
        segmented = self.segmented
        return {
            "robot": PANDA.name,
            "dof": self.machine.joint_size,
            "task_rows": self.task.size,
            "duration_s": segmented.horizon,
            "cost_local": None,
            "cost_optimal": segmented.cost,
            "tip_error": max(self._tip_error(number) for number in range(len(segmented.segments))),
            "joint_return_rad": None,
            "audit_passed": all(audit.passed for audit in self.audits),
            "reconfigurations": len(segmented.reconfigurations),
            "fewest_reconfigurations": segmented.fewest,
            "reconfigured_at_s": [one.time for one in segmented.reconfigurations],
            "reconfigured_in_s": [one.duration for one in segmented.reconfigurations],
        }

    def _tip_error(self, number: int) -> float:
        piece, begin = self.segmented.segments[number], self.segmented.start_times[number]
        times = np.linspace(0.0, piece.horizon, FINE)
        errors = task_errors(self.machine, self.task, begin + times, piece.at(times)["joints"])
        return float(np.abs(errors).max())


def ring() -> TipTask:
    """Once round the foot, from rest to rest, behind the arm first and last: six rows."""

    def position(time: Any) -> Any:
        angle = np.pi * (2 * rest_to_rest(time / DURATION) - 1)
        return ca.vertcat(RADIUS * ca.cos(angle), RADIUS * ca.sin(angle), HEIGHT)

    return TipTask(position=position, orientation=DOWN, duration=DURATION)


def plan(coarse: bool = False) -> InPieces:
    """The task in the fewest pieces, and all postures that do it; `coarse` at fewer times."""
    machine, task = FixedBase(PANDA.read()), ring()
    segmented = ocp.plan(machine, task, search="segments")
    assert isinstance(segmented, SegmentedPlan)
    return InPieces(machine, task, segmented, configurations(machine, task, COARSE if coarse else SAMPLE_COUNT))


def configurations(machine: FixedBase, task: TipTask, count: int) -> Reached:
    """All postures at so many times."""
    n, times = machine.joint_size, np.linspace(0.0, DURATION, count)
    bounds, equations = Limits().bounds(machine), bind(machine, task)
    space = JointSpace(machine, bounds.lower, bounds.upper, np.ones(n))
    sets = SelfMotionManifolds(space, equations, np.array(equations.target_function().map(count)(times[None])).T)

    def seeds(k: int) -> Array:
        result = inverse_kinematics(machine, task, time=float(times[k]), seed=k, starts=STARTS)
        return np.array([one.joints for one in result])

    limits = bounds.velocity * np.diff(times)[:, None]
    options: dict[str, Any] = {"seeds": seeds, "scene": CollisionScene(machine)}
    search = AtlasSearch(
        space, [TimeSample(sets, k) for k in range(count)], Steps(times, SquaredRates(np.ones(n)), limits), **options
    )
    layers = [search.without_collisions(search.split_charts(charts, k), k) for k, charts in enumerate(search.layers)]
    graph = search.graph(layers, np.full(count - 1, np.inf))
    ahead, back = (_led(graph, order) for order in (range(count), range(count - 1, -1, -1)))
    whole = Charts(*(np.concatenate([getattr(part, name) for part in layers]) for name in Charts.__dataclass_fields__))
    return Reached(times, whole, ahead, back)


def _led(graph: ChartGraph, order: range) -> NDArray[np.bool_]:
    """Which charts steps lead to from those of the first instant of an order. Shape (N,)."""
    result = [np.full(len(charts), k == order[0]) for k, charts in enumerate(graph.layers)]
    for k, other in pairwise(order):
        for i, j in graph.edges(k, other):
            result[other][j[result[k][i]]] = True
    return np.concatenate(result)


def draw(example: InPieces, folder: Path, *, animation: bool = True) -> None:
    """reconfiguration.png and .gif."""
    segmented = example.segmented
    change = segmented.reconfigurations[0]
    joint = int(np.abs(change.after - change.before).argmax())
    far = np.degrees(abs(change.after[joint] - change.before[joint]))
    note = (
        f"The hand of a Panda moves along a ring of radius {RADIUS:g} m around its base in {DURATION:g} s, pointing "
        "down with constant heading. Each column of the diagram shows all configurations at one time; one degree of "
        "freedom is redundant. Joints are within their limits of position and velocity, links do not collide. No plan "
        f"has fewer segments than two. With the change at {change.time:.3g} s their cost is lowest: "
        f"{segmented.cost:.3f} rad²/s together, the integral of half the squared joint velocities, without the motion "
        "between them."
    )
    title = f"No single motion follows the ring: on the way, joint {joint + 1} has to turn back by {far:.0f}°"
    with sheet(folder / "reconfiguration.png", (2, 2), (7.6, 6.4), note, title=title, height_ratios=(1, 1)) as (
        figure,
        axes,
    ):
        grid = axes[0, 0].get_subplotspec().get_gridspec()
        for ax in axes.flat:
            ax.remove()
        scenes = [
            _scene(example, f"before, at {change.time:.2f} s", "blue", change.before[None]),
            _scene(example, f"after, {change.duration:.2g} s later", "green", change.after[None]),
        ]
        for place, scene in enumerate(scenes):
            draw_scene(figure.add_subplot(grid[0, place]), scene, 1, (790, 560), scenes)
        _landscape(figure.add_subplot(grid[1, :]), example, change, joint)
    if animation:
        scene = _scene(example, f"a ring in {len(segmented.segments)} segments", "blue", *_motion(segmented))
        options = f"The ring waits at {change.time:.2f} s, for {change.duration:.2g} s, while the arm reconfigures"
        animate(folder / "reconfiguration.gif", [scene], frames=FRAMES, seconds=PACE, note=options)


def _landscape(ax: Any, example: InPieces, change: Reconfiguration, joint: int) -> None:
    """The postures by one of their joints over time, the pieces, and where one gives way to the other."""
    segmented, reached, robot = example.segmented, example.reached, example.machine.robot
    charts, times = reached.charts, reached.times[reached.charts.layer]
    ends = [charts.centers[:, joint] + charts.tangents[:, joint, 0] * end[:, 0] for end in (charts.low, charts.high)]
    half = np.diff(reached.times).mean() / 2
    corners = [(times + side, ends[end]) for side, end in ((-half, 0), (half, 0), (half, 1), (-half, 1))]
    bars = np.stack([np.column_stack([t, np.degrees(angles)]) for t, angles in corners], axis=1)
    ahead, back = reached.from_the_beginning, reached.to_the_end
    for own, color in ((~ahead & ~back, NEITHER), (ahead, FROM_THE_BEGINNING), (back, TO_THE_END)):
        columns = PolyCollection(list(bars[own]), facecolors=PALE[color], edgecolors="face", linewidths=0.3)
        columns.set_rasterized(True)  # thousands of them
        ax.add_collection(columns)
    for name, color, piece, begin in (
        ("first segment", FROM_THE_BEGINNING, segmented.segments[0], segmented.start_times[0]),
        ("last segment", TO_THE_END, segmented.segments[-1], segmented.start_times[-1]),
    ):
        t = np.linspace(0.0, piece.horizon, FINE)
        angle = np.degrees(piece.at(t)["joints"][:, joint])
        ax.plot(begin + t, angle, color="white", lw=3.6)
        ax.plot(begin + t, angle, color=COLORS[color], lw=1.8, label=f"{name}: {piece.cost:.3f} rad²/s")
    before, after = (np.degrees(at[joint]) for at in (change.before, change.after))
    arrow = {"arrowstyle": "-|>", "color": COLORS["black"], "lw": 1.2, "shrinkA": 4, "shrinkB": 4}
    ax.annotate("", (change.time, after), (change.time, before), arrowprops=arrow)
    ax.text(
        change.time + 0.15, 0.0, f"the arm reconfigures,\n{change.duration:.2g} s", ha="left", va="center", fontsize=8
    )
    for limit in (robot.lower[joint], robot.upper[joint]):
        ax.axhline(np.degrees(limit), color=COLORS["black"], lw=0.8, ls=DASHES[1])
    ax.set(xlim=(0, DURATION), ylim=(-180, 180), yticks=range(-180, 181, 90), xlabel="time of the task, s")
    ax.set_ylabel(f"angle of joint {joint + 1}, deg")
    ax.set_title("All configurations that perform the task; dashed: limits of the joint")
    ax.grid(visible=False)
    handles, labels = ax.get_legend_handles_labels()
    names = ("can be reached from the start", "can reach the end", "neither")
    for color, label in zip((FROM_THE_BEGINNING, TO_THE_END, NEITHER), names, strict=True):
        handles.append(Patch(color=PALE[color]))
        labels.append(label)
    ax.legend(handles, labels, loc="upper left", fontsize=7.5, bbox_to_anchor=(0.0, 0.94))


def _scene(example: InPieces, title: str, color: str, joints: Array, t: Array | None = None) -> Scene:
    """Joints (M, n) at times (M,), s, and the ring."""
    machine, x = example.machine, np.linspace(0.0, 2 * np.pi, 121)
    way = np.column_stack([RADIUS * np.cos(x), RADIUS * np.sin(x), np.full(len(x), HEIGHT)])
    wire = tube(way, LINE, to_rgb(COLORS["grey"]))
    times = np.arange(len(joints), dtype=float) if t is None else t
    return Scene(
        title, machine.robot, frames_along(machine, joints), times, color, view=VIEW, floor=0.0, solids=(wire,)
    )


def _motion(segmented: SegmentedPlan) -> tuple[Array, Array]:
    """All joints from the beginning to the end, the ways between the pieces too, and their times, s."""
    times = np.linspace(0.0, segmented.horizon, FINE * len(segmented.pieces))
    return segmented.at(times)["joints"], times
