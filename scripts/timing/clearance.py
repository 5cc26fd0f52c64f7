"""What it costs to stay clear: the proof of a motion, and plans beside obstacles that bind and that do not."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import Box, CollisionScene, FixedBase, Robot, Sphere, link_frames
from models.checks import Array
from models.shapes.shapes import Shape
from ocp import Plan, Scene, plan
from ocp.audit.clearance import Clearance
from ocp.motion.builders.clearance import clearance_of
from ocp.motion.local.collisions import distances_along
from scripts import drawing
from scripts.papers.run import progress, text_table
from scripts.robots.robots import PANDA, UR5
from scripts.timing.clearance_peers import run_peers
from scripts.timing.distances import scene
from scripts.timing.planning import lanes

SECONDS, SEGMENT_COUNT, SEEDS = 10.0, 40, 6
"""Of the motions that are proven clear, or not."""
CLEARANCE = 0.01
SWING = 0.45
"""rad: by which joints swing about their places."""
FAR, INSIDE, BALL = 0.05, 0.005, 0.08
"""m: boxes that do not bind are at least so far from the plain motion; the ball that binds is nearer by so much than it
may be, and so large."""
SAMPLES = 401
CASES = {"UR5": (UR5, "forearm_link", np.radians(15.0)), "Panda": (PANDA, "panda_link4", None)}
"""Robots, the link beside whose frame the ball stands, and how far the tool may lean, rad; None: not."""
GOALS = {"proof": 0.5, "beside what does not bind": 1.5, "beside what binds": 4.0}
"""s, and times the plan that looks at nothing."""


def run(repeats: int = 5) -> dict[str, Any]:
    """Processor times, the least of some runs."""
    matches = [row for case in progress(CASES, "clearance") for row in plans(case, max(1, min(repeats, 3)))]
    return {"rows": matches, "proofs": proofs(repeats), "peers": run_peers(repeats), "goals": GOALS}


def proofs(repeats: int) -> list[dict[str, Any]]:
    """Of joints of a Panda that swing for ten seconds among ten boxes, each with two frequencies."""
    around = scene()
    if around is None:
        return []
    rows = []
    for seed in range(SEEDS):
        spent, result = least(partial(proven, around, *swing(around.machine.robot, seed)), repeats)
        row = {"seed": seed, "pairs": len(around.pairs), "looked": result.n_intervals, "proof_s": spent}
        rows.append({**row, "settled": result.settled, "least_m": result.worst.least})
    return rows


def swing(robot: Robot, seed: int) -> tuple[Array, Array, Array, Array]:
    """Places about which joints swing (n,), and of two swings of each its size, angular speed and phase (2, n)."""
    rng = np.random.default_rng(seed)
    middle = np.clip([0.0, -0.5, 0.0, -2.0, 0.0, 1.9, 0.8, *[0.02] * (robot.dof - 7)], robot.lower, robot.upper)
    room = np.minimum(middle - robot.lower, robot.upper - middle)
    sizes = np.minimum(SWING, room) * rng.uniform(0.2, 0.5, (2, robot.dof))
    return middle, sizes, rng.uniform(0.3, 1.5, (2, robot.dof)), rng.uniform(0.0, 2 * np.pi, (2, robot.dof))


def proven(around: CollisionScene, middle: Array, sizes: Array, speeds: Array, phases: Array) -> Clearance:
    """How near anything comes while joints swing."""

    def joints(at: Array) -> Array:
        return np.asarray(middle + (sizes * np.sin(SECONDS * at[:, None, None] * speeds + phases)).sum(axis=1))

    breaks = np.linspace(0.0, 1.0, SEGMENT_COUNT + 1)
    rates, seconds = (np.tile((sizes * speeds**k).sum(axis=0), (SEGMENT_COUNT, 1)) for k in (1, 2))
    return clearance_of(around, joints, breaks, SECONDS, rates=rates, seconds=seconds, smooth=True)


def plans(case: str, repeats: int) -> list[dict[str, Any]]:
    """From the start of a motion clear of itself: a plan that looks at nothing, one beside boxes, one beside a ball."""
    file, link, lean = CASES[case]
    machine, task = FixedBase(file.read()), lanes(2, 0.3, 0.05, within=lean)
    clearance_constraints = plan(machine, task, search="start", scene=Scene(clearance=CLEARANCE))
    planned = partial(plan, machine, task, start=clearance_constraints.at(0.0)["joints"], search="start")
    spent, plain = least(partial(planned, scene=False), repeats)
    rows = [{"robot": case, "plan": "plain", "plan_s": spent, "ratio": 1.0, "cost": plain.cost, "held": 0}]
    around: dict[str, Sequence[Shape]] = {
        "beside what does not bind": boxes(plain),
        "beside what binds": [ball(plain, link)],
    }
    for what, obstacles in around.items():
        spent, result = least(partial(planned, scene=Scene(obstacles, CLEARANCE)), repeats)
        held = result.solution.problem.declared.path.get("apart")
        rows.append({"robot": case, "plan": what, "plan_s": spent, "ratio": spent / rows[0]["plan_s"]})
        rows[-1] |= {"cost": result.cost, "held": 0 if held is None else held.size}
    return rows


def least(work: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Least processor time of a number of runs, s, and what the last gave."""
    spent, result = np.inf, None
    for _ in range(repeats):
        began = time.process_time()
        result = work()
        spent = min(spent, time.process_time() - began)
    return spent, result


def apart(result: Plan, obstacles: Sequence[Shape]) -> Array:
    """How near a motion comes to each of some obstacles at samples. Shape (SAMPLES, obstacles), m."""
    around = CollisionScene(result.machine, obstacles)
    times = np.linspace(0.0, result.horizon, SAMPLES)
    near = distances_along(around, np.zeros(0), result.at(times)["joints"], times)
    beside = np.array([other for _, other in around.labels])
    return np.stack([near[:, beside == f"obstacle {k}"].min(axis=1) for k in range(len(obstacles))], axis=1)


def boxes(plain: Plan) -> list[Box]:
    """Ten within reach that the plain motion stays far from."""
    rng = np.random.default_rng(5)
    some = [Box(rng.uniform(0.05, 0.2, 3), rng.uniform((-1.0, -1.0, 0.0), (1.0, 1.0, 1.0))) for _ in range(50)]
    return [some[k] for k in np.flatnonzero(apart(plain, some).min(axis=0) >= FAR)[:10]]


def ball(plain: Plan, link: str) -> Sphere:
    """Beside a link, which comes nearer to it than it may on the way, by about so much, and is clear of it before."""
    joints = plain.at(plain.horizon / 2)["joints"]
    place = np.array(ca.DM(link_frames(plain.machine.robot, ca.DM(joints))[link].position)).ravel()
    rng = np.random.default_rng(5)
    some = [Sphere(BALL, place + rng.uniform(-0.3, 0.3, size=3)) for _ in range(300)]
    near = apart(plain, some)
    inside = np.where(near[0] > 2 * CLEARANCE, np.abs(near.min(axis=0) - (CLEARANCE - INSIDE)), np.inf)
    return some[int(inside.argmin())]


def report(numbers: dict[str, Any]) -> str:
    """The times, and what is asked."""
    request = "required: a proof in 0.5 s, plans at most 1.5 times the plain one beside obstacles that do not bind, "
    tables = "\n".join(text_table(numbers[part], 4) for part in ("rows", "proofs", "peers"))
    return f"{tables}\n{request}4 times beside those that do"


def plot(path: Path, numbers: dict[str, Any]) -> None:
    """Times of the plans beside the plain one, and of the proofs, with the goals."""
    note = (
        "A tool along two lanes from a given start, with its audit; clearance "
        f"{CLEARANCE * 1e3:g} mm; ten boxes at least {FAR * 1e3:g} mm off, or a ball {INSIDE * 1e3:g} mm too near. "
        f"Right: a Panda with its hand, itself and ten boxes, joints that swing for {SECONDS:g} s. Processor time, "
        "least of some runs. Black ticks: the goals."
    )
    rows, proven = numbers["rows"], numbers["proofs"]
    worst = max(row["ratio"] for row in rows)
    title = f"With collision avoidance, planning takes up to {worst:.1f} times as long as without"
    with drawing.sheet(path, (1, 2), (7.6, 3.0), note, title=title) as (_, axes):
        left, right = np.ravel(axes)
        names = [f"{row['robot']}, {row['plan']}" for row in rows]
        left.barh(range(len(rows)), [row["ratio"] for row in rows], 0.6, color=drawing.COLORS["blue"])
        for k, row in enumerate(rows):
            left.text(0.05, k, f"{row['plan_s']:.2f} s", va="center", fontsize=7, color="white")
            if row["plan"] in GOALS:
                left.plot([GOALS[row["plan"]]] * 2, [k - 0.35, k + 0.35], color="black", lw=1)
        left.set(yticks=range(len(rows)), yticklabels=names, xlabel="times the plain plan", xlim=(0, 5))
        left.invert_yaxis()
        right.barh(range(len(proven)), [row["proof_s"] for row in proven], 0.6, color=drawing.COLORS["green"])
        right.axvline(GOALS["proof"], color="black", lw=1)
        right.set(yticks=range(len(proven)), yticklabels=[f"motion {row['seed']}" for row in proven], xlabel="proof, s")
        right.invert_yaxis()
