"""How fast the captive trajectory rig's inverse kinematics is: compiled, mapped, from Python, and by other means."""

from __future__ import annotations

import importlib
import time
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import optimal_inverse, reference_rig, reference_tunnel
from models.checks import Array
from models.cts.rig import HOME, forward, inverse
from scripts import drawing
from scripts.papers.cts.iterations import combined, null_space
from scripts.papers.cts.results import PAPER_TIMES, sweep_targets
from scripts.papers.run import text_table
from scripts.timing.measure import FLAGS, against, compiled, has_compiler, least

LIMITS: dict[str, Any] = {"lower": (0.05, -3.0, -2.2, -1.3, 0.2, -3.1), "upper": (1.6, -0.1, 2.2, 1.3, 2.8, 3.1)}
COUNT = 200
PEER_COUNT = 40
SEED = 3


def random_reachable(count: int) -> Array:
    """Targets of random joints within the limits. Shape (count, 5)."""
    rng = np.random.default_rng(SEED)
    q = ca.SX.sym("q", 6)
    inside = [(low, high) for low, high in zip(LIMITS["lower"], LIMITS["upper"], strict=True)]
    joints = np.array([rng.uniform(low, high, count) for low, high in inside])
    return np.array(ca.Function("f", [q], [forward(reference_rig(), q)]).map(count)(joints))[:5].T


def run(repeats: int = 5) -> dict[str, Any]:
    """All times of one run on one machine.

    Returns:
        "rows": ns a target by method, mean over the targets and of the slowest target, and the share of targets solved.
        "goals": each with its figure. "peer": what ikpy does, or "not installed". "flags": of the compiler.
    """
    tunnel, targets = reference_tunnel(), sweep_targets(COUNT)
    spread = random_reachable(COUNT)
    rigs = {"reach": reference_rig(), "joint limits": reference_rig(**LIMITS)}
    rows: list[dict[str, Any]] = []

    def add(what: str, on: str, seconds: float, success: float, slowest: float | None = None) -> None:
        times = {"ns_per_target": 1e9 * seconds, "slowest_ns": None if slowest is None else 1e9 * slowest}
        rows.append({"method": what, "targets": on, **times, "solved": success})

    cases = {
        "I1, limits off": optimal_inverse(rigs["reach"], tunnel, limits=False),
        "I1, reach": optimal_inverse(rigs["reach"], tunnel),
        "I1, joint limits": optimal_inverse(rigs["joint limits"], tunnel),
        "I2, reach": optimal_inverse(rigs["reach"], tunnel, rate_weight=5.0),
        "I2, joint limits": optimal_inverse(rigs["joint limits"], tunnel, rate_weight=5.0),
    }
    for name, function in cases.items():
        for on, rows_in in (("sweep", targets), ("random", spread)):
            if has_compiler():
                result, mean, worst = compiled_inverse(function, rows_in, repeats)
                add(f"compiled, {name}", on, mean, float(np.mean(result[:, 8] == 0)), worst)
            many = function.map(COUNT)
            inputs = [ca.DM(rows_in.T), ca.DM.zeros(1, COUNT)]
            status = np.array(many.call(inputs)[3])
            seconds = least(lambda many=many, inputs=inputs: many.call(inputs), repeats) / COUNT  # type: ignore[misc]
            add(f"map, {name}", on, seconds, float(np.mean(status == 0)))
    one = cases["I1, reach"]
    seconds = least(lambda: [one(row, 0.0) for row in targets], repeats) / COUNT
    add("one call from Python, I1, reach", "sweep", seconds, 1.0)

    first = np.array(inverse(rigs["reach"], ca.DM(targets[0]), ca.DM(0), HOME)[0]).ravel()
    newton = combined(rigs["reach"], tunnel, targets)
    add("Newton of Table 4, Python", "sweep", least(lambda: combined(rigs["reach"], tunnel, targets), 2) / COUNT, 1.0)
    jacobian = null_space(rigs["reach"], tunnel, targets, first, gain=20.0)
    seconds = least(lambda: null_space(rigs["reach"], tunnel, targets, first, gain=20.0), 2) / COUNT
    add("Jacobian of Table 3, gain 20, Python", "sweep", seconds, float(jacobian.converged.mean()))
    times_by = {(row["method"], row["targets"]): row["ns_per_target"] for row in rows}
    goals = {
        "compiled_limits_off_ns": {"figure": times_by.get(("compiled, I1, limits off", "sweep")), "goal": 250.0},
        "compiled_joint_limits_ns": {"figure": times_by.get(("compiled, I1, joint limits", "random")), "goal": 1000.0},
    }
    if compiled_ns := times_by.get(("compiled, I1, reach", "sweep")):
        ratio = PAPER_TIMES["combined"] / (COUNT * 1e-9 * compiled_ns)
        goals["paper_time_over_compiled"] = {"figure": ratio, "goal": 100.0}
    peers = peer_times(random_reachable(PEER_COUNT))
    for peer in peers or []:
        add(f"{peer['name']} {peer['version']}, {peer['task']}", "random", peer["seconds"], peer["success"])
    return {
        "rows": rows,
        "goals": goals,
        "newton_iterations": float(newton.iterations.mean()),
        "peer": peers or "not installed",
        "flags": list(FLAGS),
    }


def compiled_inverse(function: Any, targets: Array, repeats: int = 5) -> tuple[Array, float, float]:
    """An optimal_inverse function in C over targets, shape (M, 5), from roll 0.

    Returns:
        Joints, index, code of the active constraint, code of the status, shape (M, 9); the time of a target, s, the
        mean over all of them; the same of the slowest target alone, run again and again.
    """
    previous = np.zeros((1, 1))
    with compiled(function) as rows:
        # short runs: one of many is undisturbed
        result, mean = rows([targets, previous], max(1, 2000 // len(targets)), 10 * repeats)
        # calls from Python, only to find the slowest
        alone = [rows([target, previous], 1, 20)[1] for target in targets]
        slowest = np.tile(targets[int(np.argmax(alone))], (100, 1))
        return result, mean, rows([slowest, previous], 20, 10 * repeats)[1]


def peer_times(targets: Array) -> list[dict[str, Any]] | None:
    """ikpy on the same chain: by position alone, as it does by default, and with the direction of the store, roll free.

    None where it is not installed. A target is solved where the tool is within 0.1 mm of it, and, for the direction,
    within 1e-3 of each component of the store's axis.
    """
    try:
        chains, links = importlib.import_module("ikpy.chain"), importlib.import_module("ikpy.link")
        version = importlib.import_module("ikpy").__version__
    except ImportError:
        return None
    rig, half = reference_rig(), np.pi / 2
    rows = [  # translation and rpy of each joint in the frame of the one before, axis, whether it slides
        ((0, 0, 0), (half, 0, half), True),
        ((0, 0, 0), (-half, 0, 0), False),
        ((rig.yaw_link_1, 0, 0), (0, 0, 0), False),
        ((rig.yaw_link_2, 0, 0), (-half, 0, 0), False),
        ((rig.pitch_link, 0, rig.yaw_offset), (0, 0, 0), False),
        ((0, 0, 0), (half, 0, 0), False),
    ]
    results = [links.OriginLink()]
    for k, (shift, turn, slides) in enumerate(rows):
        axis: dict[str, Any] = (
            {"translation": [0, 0, 1], "joint_type": "prismatic"} if slides else {"rotation": [0, 0, 1]}
        )
        bounds = (LIMITS["lower"][k], LIMITS["upper"][k])
        results.append(links.URDFLink(f"joint {k + 1}", shift, turn, bounds=bounds, **axis))
    tool = ((rig.goose_neck, 0, rig.sting), (0, -half, 0))
    results.append(links.URDFLink("tool", *tool, joint_type="fixed"))
    chain = chains.Chain(results, active_links_mask=[False, *[True] * 6, False])
    home = np.array([0, 0.5, -half, 0.0, 0.0, half, 0.0, 0])
    q = np.array([0.4, -1.8, 0.3, 0.1, 1.4, 0.7])
    ours = np.array(ca.DM(forward(rig, ca.DM(q))))[:3, 0]
    if np.abs(chain.forward_kinematics([0, *q, 0])[:3, 3] - ours).max() > 1e-9:
        raise RuntimeError("the chain given to ikpy is not the rig")
    sources: list[dict[str, Any]] = []
    for task, mode in (("position", None), ("position and direction", "X")):
        good, began = 0, time.perf_counter()
        for x, y, z, yaw, pitch in targets:
            direction = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
            aim = {"target_orientation": direction, "orientation_mode": mode} if mode else {}
            solutions = chain.inverse_kinematics([x, y, z], initial_position=home, **aim)
            pose = chain.forward_kinematics(solutions)
            there = np.abs(pose[:3, 3] - [x, y, z]).max() < 1e-4
            good += bool(there and (not mode or np.abs(pose[:3, 0] - direction).max() < 1e-3))
        seconds = (time.perf_counter() - began) / len(targets)
        named = {"name": "ikpy", "version": version, "task": task}
        sources.append({**named, "seconds": seconds, "success": good / len(targets), "optimal_roll": False})
    return sources


def report(summary: dict[str, Any]) -> str:
    """The times, and the figures beside their goals."""
    return f"{text_table(summary['rows'], 4)}\n{against(summary['goals'], 'goal')}"


def plot(path: Path, summary: dict[str, Any]) -> None:
    """Time of a target by every method, on a logarithmic axis."""
    rows = [row for row in summary["rows"] if row["targets"] == "random" or "Table" in row["method"]]
    rows = sorted(rows, key=lambda row: -row["ns_per_target"])
    note = (
        "Blue: compiled; light: not compiled; whiskers: the slowest target. 200 random targets within the joint limits "
        "(Tables 3 and 4: the paper's sweep), one core, least of several runs of one run, mean over the targets. "
        "Compiled: cc " + " ".join(summary["flags"])
    )
    best = min(rows, key=lambda row: (row["solved"] < 1, row["ns_per_target"]))
    title = f"The rig's inverse kinematics takes {best['ns_per_target']:.0f} ns a target where all are solved"
    with drawing.sheet(path, (1, 1), (8.2, 5.0), note, title=title) as (_, axes):
        ax = axes[0, 0]
        shades = ["blue" if "compiled" in row["method"] else "sky" for row in rows]
        drawing.dots(ax, [row["ns_per_target"] for row in rows], [row["method"] for row in rows], shades)
        plain = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
        for k, row in enumerate(rows):
            right = row["ns_per_target"]
            if row["slowest_ns"] is not None:
                ax.plot([right, row["slowest_ns"]], [k, k], "-|", color=drawing.COLORS["black"], lw=1)
                right = max(right, row["slowest_ns"])
            solved = "" if row["solved"] == 1 else f", {100 * row['solved']:.3g} % solved"
            ax.text(right * 1.35, k, f"{row['ns_per_target']:,.0f} ns{solved}", va="center", fontsize=7, bbox=plain)
        ax.set_xlim(100, 100 * max(row["ns_per_target"] for row in rows))
        ax.axvline(
            1e9 * PAPER_TIMES["combined"] / 200, color=drawing.COLORS["orange"], ls="--", label="paper, combined"
        )
        ax.set(xlabel="ns a target")
        ax.legend(loc="upper right")
