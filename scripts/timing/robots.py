"""Robots read from URDF: time to load them and to build their functions, and the generalized Jacobian of a space arm.

The files come with the distributions example-robot-data and spartpy, the comparison with pin; what is not installed
is left out.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import (
    FreeFloating,
    Robot,
    center_of_mass,
    center_of_mass_jacobian,
    inverse_dynamics,
    link_frames,
    link_jacobians,
    simplify,
    tip_jacobian,
)
from models.checks import Array
from scripts import drawing
from scripts.papers.run import text_table
from scripts.robots.robots import packaged
from scripts.timing.measure import FLAGS as FAST
from scripts.timing.measure import compiled, has_compiler, least

DATA = "example-robot-data"
ROBOTS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "UR5": (DATA, "ur_description/urdf/ur5_robot.urdf", {"tip": "tool0"}),
    "space arm": ("spartpy", "SPARTpy/urdf/floating_7dof_manipulator.urdf", {}),
    "Panda": (DATA, "panda_description/urdf/panda.urdf", {"tip": "panda_hand_tcp", "mimic": "free"}),
    "ANYmal with Kinova": (
        DATA,
        "anymal_b_simple_description/robots/anymal-kinova.urdf",
        {"tip": "j2s6s200_end_effector", "inertia": "as_given"},
    ),
    "B1 with Z1": (DATA, "b1_description/urdf/b1-z1.urdf", {"tip": "gripperMover", "inertia": "as_given"}),
    "TALOS reduced": (DATA, "talos_data/robots/talos_reduced.urdf", {"tip": "gripper_left_base_link"}),
    "TALOS": (DATA, "talos_data/robots/talos_full_v2.urdf", {"tip": "gripper_left_base_link", "mimic": "free"}),
    "TIAGo": (DATA, "tiago_description/robots/tiago.urdf", {"tip": "wrist_ft_tool_link", "inertia": "as_given"}),
    "TIAGo, two arms": (
        DATA,
        "tiago_description/robots/tiago_dual.urdf",
        {"tip": "wrist_right_ft_tool_link", "inertia": "as_given"},
    ),
}
"""Distribution, end of the file's path, and what Robot.from_urdf needs to be told."""

FLAGS = {"-O2": ("-O2",), "-O3, this processor": FAST}
COUNT = 100
SEED = 11
GOALS = {"generalized Jacobian": 1.0, "its derivative": 5.0}
"""us."""


def urdf_file(package: str, ending: str) -> Path | None:
    """A file of a distribution; None where that is not installed."""
    try:
        return packaged(package, ending)
    except FileNotFoundError:
        return None


def build(robot: Robot) -> dict[str, Any]:
    """The functions that planning needs, by name."""
    machine = FreeFloating(robot)
    base = ca.SX.sym("base", 7)
    q, qd, qdd = (ca.SX.sym(name, robot.dof) for name in ("q", "qd", "qdd"))
    frames = [ca.horzcat(*frame) for frame in link_frames(robot, q).values()]
    return {
        "frames": ca.Function("frames", [q], frames),
        "jacobians": ca.Function("jacobians", [q], list(link_jacobians(robot, q).values())),
        "tip_jacobian": ca.Function("tip_jacobian", [q], [tip_jacobian(robot, q)]),
        "center": ca.Function("center", [q], [center_of_mass(robot, q), center_of_mass_jacobian(robot, q)]),
        "momentum": ca.Function("momentum", [base, q], list(machine.momentum_matrices(base, q))),
        "generalized_jacobian": ca.Function("generalized_jacobian", [base, q], [machine.tip_jacobian(base, q)]),
        "base_rate": ca.Function("base_rate", [base, q, qd], [machine.base_rate(base, q, qd)]),
        "inverse_dynamics": ca.Function("inverse_dynamics", [q, qd, qdd], [inverse_dynamics(robot, q, qd, qdd)]),
    }


def loading(repeats: int) -> list[dict[str, Any]]:
    """Seconds to load each robot and to build its functions."""
    rows = []
    for name, (package, ending, options) in ROBOTS.items():
        path = urdf_file(package, ending)
        if path is None:
            continue
        robot = Robot.from_urdf(path, **options)
        load = least(lambda path=path, options=options: Robot.from_urdf(path, **options), repeats)  # type: ignore[misc]
        functions = least(lambda robot=robot: build(robot), min(repeats, 3))  # type: ignore[misc]
        rows.append(
            {
                "robot": name,
                "joints": robot.dof,
                "links": len(robot.links),
                "load_s": load,
                "build_s": functions,
                "total_s": load + functions,
            }
        )
    return rows


def space_arm(repeats: int) -> list[dict[str, Any]]:
    """The generalized Jacobian of the free-floating arm of seven joints by several means, us a call."""
    path = urdf_file(*ROBOTS["space arm"][:2])
    if path is None:
        return []
    options = Robot.from_urdf(path)
    robot = simplify(options)
    machine = FreeFloating(robot)
    rng = np.random.default_rng(SEED)
    base = np.column_stack([rng.normal(size=(COUNT, 3)), rng.normal(size=(COUNT, 4))])
    base[:, 3:] /= np.linalg.norm(base[:, 3:], axis=1, keepdims=True)
    q = rng.uniform(-np.pi, np.pi, (COUNT, robot.dof))
    x, y = ca.SX.sym("base", 7), ca.SX.sym("q", robot.dof)
    jacobian = machine.tip_jacobian(x, y)
    value = ca.Function("value", [x, y], [jacobian])
    derivative = ca.Function("derivative", [x, y], [ca.jacobian(jacobian, ca.vertcat(x, y))])
    rows: list[dict[str, Any]] = []

    def add(what: str, by: str, seconds: float, instructions: int = 0) -> None:
        rows.append({"function": what, "by": by, "us": 1e6 * seconds, "instructions": instructions})

    many, columns = value.map(COUNT), [ca.DM(base.T), ca.DM(q.T)]
    result = np.array(many.call(columns)[0]).reshape(6, COUNT, -1).transpose(1, 0, 2)
    if has_compiler():
        for name, flags in FLAGS.items():
            for what, function in (("generalized Jacobian", value), ("its derivative", derivative)):
                with compiled(function, flags) as called:
                    # bursts of about a millisecond: on a busy machine some of many run undisturbed
                    out, seconds = called([base, q], 10, 100 * repeats)
                if function is value:
                    check(out.reshape(COUNT, robot.dof, 6).transpose(0, 2, 1), result, name)
                add(what, f"compiled, {name}", seconds, function.n_instructions())
    add("generalized Jacobian", "map in CasADi", least(lambda: many.call(columns), repeats) / COUNT)
    one = [[ca.DM(base[i]), ca.DM(q[i])] for i in range(COUNT)]
    seconds = least(lambda: [value.call(each) for each in one], repeats) / COUNT
    add("generalized Jacobian", "one call from Python", seconds)
    if (peer := pinocchio_jacobian(path, options)) is not None:
        theirs = np.array([peer(base[i], q[i]) for i in range(COUNT)])
        check(theirs, result, "Pinocchio")
        seconds = least(lambda: [peer(base[i], q[i]) for i in range(COUNT)], 10 * repeats) / COUNT
        version = importlib.import_module("pinocchio").__version__
        add("generalized Jacobian", f"Pinocchio {version} and numpy", seconds)
    return rows


def check(values: Array, expected: Array, what: str) -> None:
    """RuntimeError when two ways to compute the same differ by more than rounding."""
    error = float(np.abs(values - expected).max() / np.abs(expected).max())
    if error > 1e-10:
        raise RuntimeError(f"{what}: the generalized Jacobian differs by {error:.1e} relative")


def pinocchio_jacobian(path: Path, robot: Robot) -> Callable[[Array, Array], Array] | None:
    """G(base, q), rows (angular, linear), from Pinocchio's joint-space inertia; None where it is not installed."""
    try:
        pin = importlib.import_module("pinocchio")
    except ImportError:
        return None
    text = path.read_text(encoding="utf-8").replace('"revolute"', '"continuous"')  # it wants limits of revolute joints
    model = pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
    data = model.createData()
    frame = model.getFrameId(robot.tip_link)
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    rows = [3, 4, 5, 0, 1, 2]
    configuration = np.empty(model.nq)
    order = [model.joints[model.getJointId(name)].idx_q for name in robot.joint_names]
    if order != list(range(7, 7 + 2 * robot.dof, 2)):
        raise RuntimeError("Pinocchio orders the joints of the space arm otherwise")

    def jacobian(base: Array, q: Array) -> Array:
        configuration[0:3], configuration[3:6], configuration[6] = base[0:3], base[4:7], base[3]
        configuration[7::2], configuration[8::2] = np.cos(q), np.sin(q)
        inertia = pin.crba(model, data, configuration)  # its upper triangle
        tip = pin.computeFrameJacobian(model, data, configuration, frame, world)
        coupling = inertia[:6, 6:]
        locked = np.triu(inertia[:6, :6])
        locked += np.triu(locked, 1).T
        result: Array = (tip[:, 6:] - tip[:, :6] @ np.linalg.solve(locked, coupling))[rows]
        return result

    return jacobian


def run(repeats: int = 5) -> dict[str, Any]:
    """All times of one run on one machine."""
    rows, arm = loading(repeats), space_arm(repeats)
    summary: dict[str, Any] = {"loading": rows, "space_arm": arm, "goals_us": GOALS}
    values = [row for row in arm if row["function"] == "generalized Jacobian"]
    ours = [row["us"] for row in values if row["by"] == "compiled, -O2"]
    theirs = [row["us"] for row in values if row["by"].startswith("Pinocchio")]
    if ours and theirs:
        summary["pinocchio_over_compiled"] = theirs[0] / ours[0]
    return summary


def report(summary: dict[str, Any]) -> str:
    """The times, as far as there are any."""
    parts = [text_table(summary[key], 4) for key in ("loading", "space_arm") if summary[key]]
    if ratio := summary.get("pinocchio_over_compiled"):
        parts.append(f"Pinocchio and numpy take {ratio:.0f} x the generalized Jacobian compiled by -O2")
    return "\n".join(parts)


def plot(path: Path, summary: dict[str, Any]) -> None:
    """Left: seconds to load and to build, by robot. Right: us of a generalized Jacobian by each means."""
    rows, arm = summary["loading"], summary["space_arm"]
    note = (
        "One core, least of several runs in one run; compiled functions are called from C, the others from Python. "
        "Built: frames and Jacobians of all links, tip Jacobian, centre of mass, momentum matrices, generalized "
        f"Jacobian, base rate, inverse dynamics. Space arm: seven joints, {COUNT} random configurations."
    )
    peers = [row["us"] for row in arm if row["by"].startswith("Pinocchio")]
    ours = [row["us"] for row in arm if row["by"].startswith("compiled") and "derivative" not in row["function"]]
    title = (
        f"A robot of {rows[-1]['joints'] if rows else 0} joints is ready in {rows[-1]['total_s'] if rows else 0:.1f} s"
    )
    if peers and ours:
        title += f"; a generalized Jacobian takes {min(ours):.2g} µs, by Pinocchio and numpy {min(peers):.3g} µs"
    with drawing.sheet(path, (1, 2), (9.4, 4.2), note, title=title) as (_, axes):
        left, right = axes[0]
        for k, row in enumerate(reversed(rows)):
            left.barh(k, row["load_s"], color=drawing.COLORS["sky"], label="load" if k == 0 else None)
            left.barh(
                k, row["build_s"], left=row["load_s"], color=drawing.COLORS["blue"], label="build" if k == 0 else None
            )
            left.text(row["total_s"], k, f" {row['total_s']:.2g}", va="center", fontsize=7)
        left.set_yticks(range(len(rows)), [f"{row['robot']}, {row['joints']}" for row in reversed(rows)], fontsize=7)
        left.set(xlabel="s", title="Load a robot and build its functions (robot, joints)")
        left.margins(x=0.15)
        left.legend(loc="upper right")
        shades = ["orange" if row["by"].startswith("Pinocchio") else "blue" for row in reversed(arm)]
        labels = [f"{row['function']}:\n{row['by']}" for row in reversed(arm)]
        drawing.dots(right, [row["us"] for row in reversed(arm)], labels, shades)
        for k, row in enumerate(reversed(arm)):
            right.text(row["us"] * 1.3, k, f"{row['us']:.3g}", va="center", fontsize=7)
        right.set(xlabel="μs a call", title="Generalized Jacobian of a free-floating arm")
        if arm:
            right.set_xlim(0.1, 6 * max(row["us"] for row in arm))
