"""Distances of a Panda from itself and from ten boxes, with their gradients."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import Box, CollisionScene, FixedBase, Robot
from ocp.motion.builders.clearance import ROUNDING
from scripts import drawing
from scripts.papers.run import text_table
from scripts.timing.robots import ROBOTS, urdf_file

BOXES = 10
SEED = 3
GOAL = 60.0
"""us, of distances with gradients."""
CALLS = 20
HAND = ("hand", "finger")
"""What the names of links of the hand hold."""


def scene() -> CollisionScene | None:
    """The arm and the boxes, at random but for half a metre about its axis; None where its URDF is not installed."""
    package, ending, options = ROBOTS["Panda"]
    file = urdf_file(package, ending)
    if file is None:
        return None
    rng = np.random.default_rng(SEED)
    boxes = list[Box]()
    while len(boxes) < BOXES:
        place = rng.uniform((-0.8, -0.8, 0.0), (0.8, 0.8, 1.0))
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        if np.hypot(*place[:2]) > 0.35:
            boxes.append(Box(rng.uniform(0.05, 0.3, size=3), place, turn * np.sign(np.linalg.det(turn))))
    return CollisionScene(FixedBase(Robot.from_urdf(file, **options)), boxes)


def functions(around: CollisionScene, pairs: list[int]) -> dict[str, Any]:
    """Functions of the joints, by what they tell and how."""
    q, base = ca.SX.sym("q", around.machine.joint_size), ca.DM(0, 1)
    apart = around.distances(base, q, pairs=pairs, rounding=ROUNDING)
    joints = ca.MX.sym("q", around.machine.joint_size)
    message = around.distance_gradients(pairs=pairs, rounding=ROUNDING)
    return {
        "distances, one expression": ca.Function("distances", [q], [apart]),
        "and gradients, differentiated": ca.Function("differentiated", [q], [apart, ca.jacobian(apart, q)]),
        "and gradients, by wrenches": ca.Function("wrenches", [joints], message.call([ca.MX(0, 1), joints, 0.0])),
    }


def run(repeats: int = 5) -> dict[str, Any]:
    """Processor time of one call by each means, us: the least of several bursts."""
    around = scene()
    rows: list[dict[str, Any]] = []
    if around is None:
        return {"rows": rows, "goal_us": GOAL}
    labels = around.labels
    arm = [k for k, pair in enumerate(labels) if not any(part in name for name in pair for part in HAND)]
    at = 0.3 * np.ones(around.machine.joint_size)
    for name, pairs in (("arm", arm), ("arm and hand", list(range(len(labels))))):
        result = functions(around, pairs)
        expected = [np.array(part) for part in result["and gradients, differentiated"].call([at])]
        check(result["and gradients, by wrenches"].call([at]), expected)
        for what, function in result.items():
            row = {"shapes": name, "pairs": len(pairs), "function": what}
            rows.append({**row, "us": 1e6 * least_of(function, at, repeats)})
    return {"rows": rows, "goal_us": GOAL}


def least_of(function: Any, at: np.ndarray, repeats: int) -> float:
    """Least processor time of a call, of bursts of some, s."""
    options, result = [ca.DM(at)], np.inf
    for _ in range(4 * repeats):
        began = time.process_time()
        for _ in range(CALLS):
            function.call(options)
        result = min(result, (time.process_time() - began) / CALLS)
    return result


def check(result: list[Any], expected: list[np.ndarray]) -> None:
    """RuntimeError where two ways to the same differ by more than rounding."""
    error = max(float(np.abs(np.array(one) - other).max()) for one, other in zip(result, expected, strict=True))
    if error > 1e-9:
        raise RuntimeError(f"distances by wrenches differ by {error:.1e}")


def report(numbers: dict[str, Any]) -> str:
    """The times, and what is asked."""
    return f"{text_table(numbers['rows'], 4)}\nasked of distances with gradients: {GOAL:g} us"


def plot(path: Path, numbers: dict[str, Any]) -> None:
    """Times of every function, with the goals."""
    note = (
        f"A Panda as its URDF describes it, from itself and {BOXES} boxes, distances rounded by {ROUNDING * 1e3:g} mm "
        "as planners hold them; one call, forward kinematics included, processor time, least of many. "
        "Black ticks: the goal."
    )
    rows = numbers["rows"]
    by = {(row["pairs"], row["function"]): row["us"] for row in rows}
    most = max((row["pairs"] for row in rows), default=0)
    title = "Distances and gradients of a Panda and ten boxes"
    if rows:
        before, after = (by[most, f"and gradients, {how}"] for how in ("differentiated", "by wrenches"))
        title += f": by wrenches {before / after:.0f} times faster"
    with drawing.sheet(path, (1, 1), (7.6, 3.4), note, title=title) as (_, axes):
        axis = np.ravel(axes)[0]
        names = [f"{row['shapes']}, {row['pairs']} pairs: {row['function']}" for row in reversed(rows)]
        shades = ["green" if "wrenches" in row["function"] else "blue" for row in reversed(rows)]
        drawing.dots(axis, [row["us"] for row in reversed(rows)], names, shades)
        for k, row in enumerate(reversed(rows)):
            axis.text(row["us"] * 1.2, k, f"{row['us']:.{1 if row['us'] < 100 else 0}f}", va="center", fontsize=7)
            if "wrenches" in row["function"]:
                axis.plot([GOAL] * 2, [k - 0.3, k + 0.3], color="black", lw=1)
        axis.set(xlabel="μs a call")
        if rows:
            axis.set_xlim(1.0, 4 * max(row["us"] for row in rows))
