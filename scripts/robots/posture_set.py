"""All postures that do a task over its time, what the best motion through each costs, and the ways of three planners.

The picture that explains redundancy: a UR5 runs a seam with the roll of its tool free. At each time the postures that
do the task form curves, one part of the picture for each family that no motion leaves; the roll tells them apart.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import ListedColormap, Normalize
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from models import CollisionScene, FixedBase, Robot
from models.checks import Array
from models.paths import rest_to_rest
from ocp import Limits, SolveError, TipTask, inverse_kinematics, resolve
from ocp import plan as planned
from ocp.app.view.appearance import frames_along
from ocp.motion.search.charts import Charts, SelfMotionManifolds, TimeSample
from ocp.motion.search.joint_space import JointSpace
from ocp.motion.search.search import AtlasSearch
from ocp.motion.search.steps import SquaredRates, Steps
from ocp.motion.tasks.equations import bind
from scripts.drawing import COLORS, VIRIDIS, sheet
from scripts.robots.results import FINE, Example
from scripts.robots.robots import TOOL_ANGLE, UR5
from scripts.robots.ur5 import roll

DURATION = 6.0  # s
BEGIN, END = np.array([0.6, -0.35, 0.1]), np.array([0.2, 0.5, 0.4])  # m, of the seam
BOW = 0.1  # m, of the seam to the side
TILT = np.radians(40.0)  # of the tool, leaning back along the seam
COSTS = ListedColormap(VIRIDIS(np.linspace(0.95, 0.25, 256)))
"""The cheapest brightest."""
SAMPLE_COUNT = 49
STARTS = 24
"""Of inverse kinematics at each instant."""
MOST = 3.0
"""Costs are shown up to so many times that of the plan."""
HALVINGS = 2
"""Of the charts that cover the postures: the smaller, the less is lost of the costs."""
FAMILIES = 4
"""Parts of the picture at most, the cheapest first."""


def seam() -> TipTask:
    """A bowed seam from rest to rest, the tool leaning back: five rows."""

    def position(time: Any) -> Any:
        s = rest_to_rest(time / DURATION)
        return ca.DM(BEGIN) + s * ca.DM(END - BEGIN) + ca.vertcat(4 * BOW * s * (1 - s), 0, 0)

    return TipTask(position=position, direction=(0.0, np.sin(TILT), -np.cos(TILT)), duration=DURATION)


def plan(coarse: bool = False) -> Example:
    """The cheapest of all motions, the motion by the pseudo-inverse and the best plan from where that begins."""
    machine, task = FixedBase(UR5.read()), seam()
    best = planned(machine, task, search="global")
    first = inverse_kinematics(machine, task, scene=CollisionScene(machine))[0]
    local = resolve(machine, task, DURATION, start=first.joints, samples=FINE)
    try:
        near = planned(machine, task, search="start")
    except SolveError:
        near = None
    charts, cost, family = landscape(machine, task, 9 if coarse else SAMPLE_COUNT, best.cost)
    facts = {
        "bound": best.bound,
        "cost_from_the_best_conditioned_start": None if near is None else near.cost,
        "postures": len(charts),
    }
    more = {"best": best, "near": near, "charts": charts, "through": cost, "family": family}
    return Example(UR5, machine, task, local, best.solution, best.audit(), facts, more)


def landscape(machine: FixedBase, task: TipTask, count: int, known: float) -> tuple[Charts, Array, Array]:
    """Charts of all postures at some times, their layers the times' numbers.

    Returns:
        The charts; what the best motion through each costs at least, inf where none passes, shape (N,); and the number
        of the family, within which motions lead from one posture to another, shape (N,).
    """
    robot, times = machine.robot, np.linspace(0.0, DURATION, count)
    bounds = Limits().bounds(machine)
    space = JointSpace(machine, bounds.lower, bounds.upper, np.ones(robot.dof))
    equations = bind(machine, task)
    sets = SelfMotionManifolds(space, equations, np.array(equations.target_function().map(count)(times[None])).T)

    def seeds(k: int) -> Array:
        result = inverse_kinematics(machine, task, time=float(times[k]), seed=k, starts=STARTS)
        return np.array([one.joints for one in result])

    limits = bounds.velocity * np.diff(times)[:, None]
    options: dict[str, Any] = {"seeds": seeds, "scene": CollisionScene(machine)}
    time_samples = [TimeSample(sets, k) for k in range(count)]
    search = AtlasSearch(space, time_samples, Steps(times, SquaredRates(np.ones(robot.dof)), limits), **options)
    layers = search.layers
    for _ in range(HALVINGS):
        layers = [search.without_collisions(search.split_charts(charts, k), k) for k, charts in enumerate(layers)]
    graph = search.graph(layers, np.full(count - 1, MOST * known))
    passed, cost_to_go = graph.cost_to_come(), graph.cost_to_go()
    cost = np.concatenate([graph.cost_through(passed, cost_to_go, k) for k in range(count)])
    first = np.concatenate([[0], np.cumsum([len(charts) for charts in layers])])
    steps = [
        (first[k] + i[alive], first[k + 1] + j[alive])
        for k in range(count - 1)
        for i, j in graph.edges(k, k + 1)
        if (alive := np.isfinite(cost[first[k] + i]) & np.isfinite(cost[first[k + 1] + j])).any()
    ]
    rows, columns = (np.concatenate(part) for part in zip(*steps, strict=True))
    joined = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(cost), len(cost)))
    family = connected_components(joined, directed=False)[1]
    whole = Charts(*(np.concatenate([getattr(part, name) for part in layers]) for name in Charts.__dataclass_fields__))
    return whole, cost, family


def draw(example: Example, folder: Path, *, animation: bool = True) -> None:
    """posture_set.png and posture_set.npz; the picture tells of all times, there is no animation."""
    robot, more = example.machine.robot, example.more
    charts, through, family = more["charts"], more["through"], more["family"]
    best, near, local = more["best"], more["near"], example.local
    count = int(charts.layer.max()) + 1
    times = np.linspace(0.0, DURATION, count)
    ends = [charts.centers + charts.tangents[:, :, 0] * end for end in (charts.low, charts.high)]
    low, high = (rolls_of(robot, joints) for joints in ends)
    high = low + np.remainder(high - low + 180.0, 360.0) - 180.0
    t = np.linspace(0.0, DURATION, FINE)
    ways = [("pseudo-inverse", local.joints, "orange", float(local.cost[-1]))]
    if near is not None:
        ways.append(("best from the same start", near.at(t)["joints"], "green", near.cost))
    ways.append(("plan", best.at(t)["joints"], "blue", best.cost))
    space = JointSpace(example.machine, robot.lower, robot.upper, np.ones(robot.dof))
    homes = [family[_nearest(space, charts, joints[[0, FINE // 2]], (0, count // 2))] for _, joints, _, _ in ways]
    least = {number: through[family == number].min() for number in np.unique(family[np.isfinite(through)]).tolist()}
    shown = sorted(least, key=lambda number: (not any(number in home for home in homes), least[number]))[:FAMILIES]
    shown.sort(key=lambda number: least[number])
    left = len(least) - len(shown)
    note = (
        f"A UR5, its tool at {np.degrees(TOOL_ANGLE):.0f}° to the flange, follows a bowed seam of "
        f"{np.linalg.norm(END - BEGIN):.1f} m in {DURATION:g} s with free roll; coloured: all configurations that "
        "perform the task. No motion leads from one family to another. Joints are within their limits, links do not "
        "collide. Each column holds all configurations at one time, found by continuation. The colour of a "
        "configuration is a lower bound of the cost of all motions through "
        f"it{f'; {left} costlier families are left out' if left else ''}. Cost: integral of half the squared joint "
        f"velocities, rad²/s; no motion costs less than {best.bound:.4g}."
    )
    excess = 100 * (ways[-2][3] / best.cost - 1)
    title = (
        f"The start configuration decides: from the best-conditioned one, the best motion costs {excess:.0f} % more "
        "than from the start that the search finds"
    )
    size = (3.0 * len(shown) + 1.2, 4.2)
    with sheet(folder / "posture_set.png", (1, len(shown)), size, note, title=title) as (figure, axes):
        for ax, number in zip(np.ravel(axes), shown, strict=True):
            own = np.flatnonzero(family == number)
            own = own[np.argsort(-through[own], kind="stable")]  # the cheapest on top
            width = DURATION / (count - 1)
            bars = [
                [(x, y), (x + width, y), (x + width, z), (x, z)]
                for x, y, z in zip(times[charts.layer[own]] - width / 2, low[own], high[own], strict=True)
            ]
            share = np.minimum(through[own] / best.cost, MOST)
            collection = PolyCollection(
                bars, array=share, cmap=COSTS, norm=Normalize(1.0, MOST), linewidths=0.3, edgecolors="face"
            )
            collection.set_rasterized(True)  # thousands of them, 10 MB of SVG
            ax.add_collection(collection)
            for (name, joints, color, cost), home in zip(ways, homes, strict=True):
                if number in home:
                    angles = rolls_of(robot, joints)
                    angles[np.abs(np.diff(angles, append=angles[-1])) > 180.0] = np.nan
                    ax.plot(t, angles, color="white", lw=3.6)
                    ax.plot(t, angles, color=COLORS[color], lw=1.8, label=f"{name}: {cost:.3f}")
            ax.set(xlim=(0, DURATION), ylim=(-180, 180), yticks=range(-180, 181, 90), xlabel="time, s")
            ax.set_title(f"family {shown.index(number) + 1}: cost ≥ {least[number]:.3f}")
            ax.grid(visible=False)
            if ax.get_legend_handles_labels()[0]:
                ax.legend(loc="lower left", fontsize=7)
        np.ravel(axes)[0].set_ylabel("roll of the tool, deg")
        figure.colorbar(collection, ax=axes, label="lower bound / cost of the plan", pad=0.01)
    example.save(folder / "posture_set.npz")


def rolls_of(robot: Robot, joints: Array) -> Array:
    """Roll of the tool in degrees, within half a turn. Shape (M,)."""
    return np.asarray(np.degrees(np.angle(np.exp(1j * roll(frames_along(FixedBase(robot), joints))))))


def _nearest(space: JointSpace, charts: Charts, joints: Array, layers: Any) -> Array:
    """Which charts joints (M, n) at some instants lie in. Shape (M,)."""
    _, result = space.tree(charts.centers, charts.layer).query(space.tree_points(joints, np.array(layers)))
    return np.asarray(result)
