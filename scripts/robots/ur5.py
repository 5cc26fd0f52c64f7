"""A UR5 sands a curved panel in lanes with the roll of its tool free: chosen instantly, or over the whole motion."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase, Machine
from models.checks import Array
from models.paths import rest_to_rest
from ocp import (
    Collocation,
    Solution,
    SolveError,
    TipTask,
    VelocitySetup,
    inverse_kinematics,
    minimum_velocity_problem,
    resolve,
    solve,
)
from ocp.app.view.appearance import TIP_FRAME, Frames, frames_along
from ocp.motion.local.inverse_kinematics import IkSolution
from ocp.motion.local.rates import LocalSolution
from scripts.drawing import COLORS, DASHES
from scripts.papers.run import write
from scripts.robots.drawing import Scene, animate, joint_curves, page
from scripts.robots.results import FINE, Example
from scripts.robots.robots import TOOL_ANGLE, UR5

LANES = 5
LENGTH, WIDTH = 0.6, 0.28  # m, of the field
CENTER = (0.5, 0.25)  # m, x and z of the top of the panel
CURVE = 0.9  # m, radius of the panel about the x axis
DURATION = 20.0  # s
CLEARANCE = 0.05  # m, of elbow and wrist above the top of the panel at the start
BRANCHES = 4
"""How many starts are tried, the best conditioned first."""
CONDITIONED, BEST, PLANNED = "pseudo-inverse", f"from its best of {BRANCHES} starts", "plan"
STYLES: Mapping[str, Any] = {
    CONDITIONED: {"color": COLORS["orange"]},
    BEST: {"color": COLORS["orange"], "ls": DASHES[3], "zorder": 3},
    PLANNED: {"color": COLORS["blue"]},
}
OVERHEAD = ("forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link")


def raster() -> TipTask:
    """Lanes along y over a panel that is curved about x, from rest to rest, the tool along the normal: five rows."""

    def place(time: Any) -> tuple[Any, Any]:
        s = time / DURATION
        phase = np.pi * LANES * rest_to_rest(s)
        # sideways between the lanes: the integral of cos^6, so that the lanes are straight and the turns smooth
        advance = 10 * phase + 7.5 * ca.sin(2 * phase) + 1.5 * ca.sin(4 * phase) + ca.sin(6 * phase) / 6
        return -ca.cos(phase) * LENGTH / 2, (advance / (10 * np.pi * LANES) - 0.5) * WIDTH

    def position(time: Any) -> Any:
        along, across = place(time)
        return ca.vertcat(CENTER[0] + across, along, CENTER[1] - CURVE + ca.sqrt(CURVE**2 - along**2))

    def direction(time: Any) -> Any:
        along, _ = place(time)
        return ca.vertcat(0, -along, -ca.sqrt(CURVE**2 - along**2))

    return TipTask(position=position, direction=direction)


def plan(coarse: bool = False) -> Example:
    """Both motions from each of some starts; `coarse` for what a test can afford.

    The plan is the cheapest of all. It is compared with the cheapest motion by the pseudo-inverse, too, and told what
    that costs from the best conditioned start, which is where one begins who does not know better.
    """
    machine, task = FixedBase(UR5.read()), raster()
    method = Collocation(intervals=70 if coarse else 80, degree=5)
    tried: list[tuple[LocalSolution, Solution | None, Solution | None]] = []
    rows: list[dict[str, Any]] = []
    for configuration in starts(machine, task)[: 1 if coarse else BRANCHES]:
        local = resolve(machine, task, DURATION, start=configuration.joints, samples=FINE)
        same, free = (_planned(machine, task, configuration, method, free_start) for free_start in (False, True))
        tried.append((local, same, free))
        rows.append(
            {
                "start_rad": configuration.joints,
                "cost_local": float(local.cost[-1]),
                "local_arrives": local.stopped is None,
                "cost_optimal_same_start": None if same is None else float(same.cost),
                "cost_optimal_free_start": None if free is None else float(free.cost),
            }
        )
    plans = [free for _, _, free in tried if free is not None]
    if not plans:
        raise SolveError("no start of the raster leads to an audited plan")
    solution = min(plans, key=lambda result: result.cost)
    arrived = [local for local, _, _ in tried if local.stopped is None] or [local for local, _, _ in tried]
    local = min(arrived, key=lambda result: float(result.cost[-1]))
    motions = [
        (CONDITIONED, *_local_samples(tried[0][0])),
        (BEST, *_local_samples(local)),
        (PLANNED, *_motion(solution)),
    ]
    rolls = [roll(frames_along(machine, joints)) for _, _, joints, _ in motions]
    facts = {
        "starts": rows,
        "roll_range_local_deg": float(np.degrees(np.ptp(rolls[1]))),
        "roll_range_optimal_deg": float(np.degrees(np.ptp(rolls[-1]))),
    }
    return Example(UR5, machine, task, local, solution, solution.audit(), facts, {"motions": motions, "rolls": rolls})


def starts(machine: Machine, task: TipTask) -> list[IkSolution]:
    """Postures at the start of the task with elbow and wrist above the panel, the best conditioned first."""
    result = inverse_kinematics(machine, task)
    frames = frames_along(machine, [configuration.joints for configuration in result])
    height = np.min([frames.positions[link][:, 2] for link in OVERHEAD], axis=0)
    clearance_constraints = [
        configuration for configuration, low in zip(result, height, strict=True) if low > CENTER[1] + CLEARANCE
    ]
    return clearance_constraints or result


def _planned(
    machine: Machine, task: TipTask, start: IkSolution, method: Collocation, free_start: bool
) -> Solution | None:
    begin: dict[str, Any] = {"setup": VelocitySetup(near=start.joints)} if free_start else {"start": start.joints}
    try:
        result = solve(minimum_velocity_problem(machine, task, horizon=DURATION, **begin), method)
    except SolveError:
        return None
    return result if result.audit().feasible else None


def roll(frames: Frames) -> Array:
    """Angle of the tool about its axis: of its x axis to the lanes' direction, seen along the tool. Shape (M,), rad."""
    turn = frames.rotations[TIP_FRAME]
    axis, lanes = turn[:, :, 2], np.array([0.0, 1.0, 0.0])
    first = lanes - axis * axis[:, 1:2]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(axis, first)
    x = turn[:, :, 0]
    return np.unwrap(np.arctan2(np.sum(x * second, axis=1), np.sum(x * first, axis=1)))


def panel() -> tuple[Array, Array, Array]:
    """Points of the panel, (k, l) each, m."""
    across, along = np.meshgrid(np.linspace(-0.6, 0.6, 7) * WIDTH, np.linspace(-0.55, 0.55, 15) * LENGTH)
    return CENTER[0] + across, along, CENTER[1] - CURVE + np.sqrt(CURVE**2 - along**2)


def panel_mesh() -> str:
    """The panel as a mesh in OBJ, for `selfmotion view --workpiece`."""
    points = np.stack(panel(), axis=-1)
    rows, columns = points.shape[:2]
    corner = np.arange(rows * columns).reshape(rows, columns) + 1  # OBJ counts from 1
    faces = np.stack([corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]], axis=-1).reshape(-1, 4)
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in points.reshape(-1, 3)]
    return "\n".join([*lines, *(f"f {a} {b} {c} {d}" for a, b, c, d in faces)]) + "\n"


def draw(example: Example, folder: Path, *, animation: bool = True) -> None:
    """ur5.png, ur5.gif, ur5.npz, and ur5.obj, the panel."""
    robot, local, solution = example.machine.robot, example.local, example.plan
    at = solution.at(local.t)
    first, best = (motion[-1][-1] for motion in example.more["motions"][:2])
    look: dict[str, Any] = {"surface": panel(), "view": (24.0, -40.0), "floor": 0.0}
    scenes = [
        Scene(title, robot, frames_along(example.machine, joints), local.t, color, **look)
        for title, joints, color in (
            (f"pseudo-inverse: cost {first:.2f}", example.more["motions"][0][2], "orange"),
            (f"plan: cost {solution.cost:.2f}", at["joints"], "blue"),
        )
    ]
    tried = example.facts["starts"]
    costs = [row["cost_local"] for row in tried if row["local_arrives"]] or [float(local.cost[-1])]
    note = (
        f"A UR5 sands {LANES} lanes; earlier configurations are pale; the pseudo-inverse starts from the "
        f"best-conditioned of {len(tried)} configurations (solid line) or from the one with the lowest cost (dotted). "
        f"The tool is at {np.degrees(TOOL_ANGLE):.0f}° to the flange, the panel has a radius of {CURVE:g} m, the base "
        "is fixed. Position and axis of the tool are given, its roll is free. Cost: integral of half the squared joint "
        f"velocities, rad²/s; {min(costs):.3f} to {max(costs):.3f} by the pseudo-inverse from the {len(tried)} "
        f"configurations. From the best of them it costs {100 * (best / solution.cost - 1):.1f} % more than the plan, "
        "which chooses its start and its roll together. Collisions are not checked."
    )
    title = (
        f"Choosing start and roll together, the plan costs {100 * (1 - solution.cost / first):.0f} % less than the "
        "pseudo-inverse"
    )
    path, motions = folder / "ur5.png", zip(example.more["motions"], example.more["rolls"], strict=True)
    with page(path, scenes, 4, height=6.2, share=1.5, note=note, title=title) as (rolling, spent, joints):
        for (name, t, _, cost), angles in motions:
            style = STYLES[name]
            rolling.plot(t, np.degrees(angles - angles[0]), label=name, **style)
            spent.plot(t, cost, label=name, **style)
        rolling.set(xlabel="time, s", ylabel="change of tool roll, deg")
        spent.set(xlabel="time, s", ylabel="cost up to now, rad²/s")
        spent.set_ylim(top=1.6 * spent.get_ylim()[1])
        spent.legend(loc="upper left", fontsize=7)
        names = [name.removesuffix("_joint").replace("_", " ") for name in robot.joint_names]
        joint_curves(joints, local.t, at["joints"] - at["joints"][0], names, ncols=2, fontsize=6.3)
        low, high = joints.get_ylim()
        joints.set(xlabel="time, s", ylabel="change of joint angles, rad", ylim=(low - 0.45 * (high - low), high))
    example.save(folder / "ur5.npz")
    write(folder / "ur5.obj", panel_mesh())
    if animation:
        animate(folder / "ur5.gif", scenes, frames=50, seconds=0.1, note=note)


def _local_samples(local: LocalSolution) -> tuple[Array, Array, Array]:
    """Times, joints and the cost up to each time of a motion by the pseudo-inverse."""
    return local.t, local.joints, local.cost


def _motion(plan: Solution) -> tuple[Array, Array, Array]:
    """Times, joints and the cost up to each time of a plan."""
    t = np.linspace(0.0, plan.horizon, FINE)
    at = plan.at(t)
    running = (at["rates"] ** 2).sum(axis=1) / 2
    cost = np.concatenate([[0.0], np.cumsum(np.diff(t) * (running[:-1] + running[1:]) / 2)])
    return t, at["joints"], cost
