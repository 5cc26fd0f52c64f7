"""Re-solving in a receding horizon: this package's controller beside acados, aligator, fatrop and ipopt.

All tools solve the same nonlinear programs, whose functions this package writes as CasADi files: a cart-pole on its
track and a Panda that reaches for a point, 20 and 50 intervals each. The data are the steps of one closed loop with
disturbances; every fiftieth step has a push, or a jump of the target. Each tool starts from its last solution. Times
are of the processor, so that other processes on the machine hardly count. What does not run says why.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import tip_pose
from models.checks import Array, ArrayInput
from ocp import MultipleShooting, Problem, prepare
from ocp.direct.controller import gauss_newton_hessian
from scripts import drawing
from scripts.papers.run import progress, text_table
from scripts.robots.robots import PANDA

ROOT = Path(__file__).resolve().parents[2]
INTERVALS = (20, 50)
STEPS, LONG = 100, 10_000
"""Steps of each tool, and of the controller alone."""
SAME_COST = 1e-6
"""Largest difference of cost from ipopt's optimum, relative to the cost or 1, at which a step counts as solved."""
TOOLS = (
    "controller, exact",
    "controller, Gauss-Newton",
    "controller in C",
    "solve",
    "fatrop",
    "acados, exact",
    "acados, Gauss-Newton",
    "aligator",
)
HOME = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7])  # rad


def cart_pole(intervals: int) -> Problem:
    """A pole of 0.8 m and 0.1 kg on a cart of 1 kg, upright at angle 0. State: position, angle and their rates."""
    cart, pole, length, gravity = 1.0, 0.1, 0.8, 9.81
    problem = Problem("cart-pole")
    start, track = problem.parameter("start", 4), [1.5, np.inf, np.inf, np.inf]
    x = problem.state("x", 4, initial=start, lower=[-bound for bound in track], upper=track)
    u = problem.control("u", 1, lower=-15.0, upper=15.0)
    sine, cosine, spin = ca.sin(x[1]), ca.cos(x[1]), x[3]
    mass = cart + pole - pole * cosine**2
    along = (u - pole * length * sine * spin**2 + pole * gravity * sine * cosine) / mass
    turning = u * cosine - pole * length * sine * cosine * spin**2 + (cart + pole) * gravity * sine
    problem.dynamics(x, ca.vertcat(x[2], spin, along, turning / (length * mass)))
    problem.horizon(1.0)
    cost = 2 * x[0] ** 2 + 20 * x[1] ** 2 + 0.02 * x[2] ** 2 + 0.02 * x[3] ** 2
    problem.minimize(running=cost + 0.02 * u**2, terminal=5 * cost)
    return problem


def reach(intervals: int) -> Problem:
    """A Panda moves its tip to a point by limited accelerations of its joints."""
    robot = PANDA.read()
    problem, n = Problem("Panda reach"), robot.dof
    start, target = problem.parameter("start", 2 * n), problem.parameter("target", 3)
    low, high = np.concatenate([robot.lower, -robot.velocity]), np.concatenate([robot.upper, robot.velocity])
    x = problem.state("x", 2 * n, initial=start, lower=low, upper=high)
    a = problem.control("a", n, lower=-10.0, upper=10.0)
    problem.dynamics(x, ca.vertcat(x[n:], a))
    problem.horizon(1.0)
    miss = ca.sumsqr(tip_pose(robot, x[:n]).position - target)
    problem.minimize(running=0.1 * ca.sumsqr(x[n:]) + 0.01 * ca.sumsqr(a), terminal=100 * miss + ca.sumsqr(x[n:]))
    return problem


PROBLEMS: dict[str, Callable[[int], Problem]] = {"cart-pole": cart_pole, "Panda reach": reach}


def run(repeats: int = 5, *, steps: int = STEPS, long: int = LONG) -> dict[str, Any]:
    """Return "rows": time by problem, intervals and tool; "long": of the controller over many steps."""
    rows, many = [], []
    cases = [(name, intervals) for name in PROBLEMS for intervals in INTERVALS]
    for name, intervals in progress(cases, "controllers"):
        with tempfile.TemporaryDirectory() as folder:
            write_case(Path(folder), name, intervals, steps)
            rows += [row_of(tool, Path(folder), name, intervals) for tool in TOOLS]
        if intervals > INTERVALS[0]:
            continue
        with tempfile.TemporaryDirectory() as folder:
            write_case(Path(folder), name, intervals, long, reference=False)
            many += [row_of(tool, Path(folder), name, intervals) for tool in TOOLS[1:3]]
    return {"rows": rows, "long": many}


def write_case(folder: Path, name: str, intervals: int, steps: int, *, reference: bool = True) -> None:
    """Write what all tools read: functions of a stage and of the end as CasADi files, bounds, and data of the steps."""
    problem = PROBLEMS[name](intervals)
    prepared: Any = prepare(problem, MultipleShooting(intervals), compiled=True)
    stage, *_, end = (block.function for block in prepared.transcription.blocks)
    form, random = prepared.formulation, np.random.default_rng(0)
    nx, nu = form.nx, form.nu
    x, u, p = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("p", form.np)
    data = prepared.transcription.blocks[0].data[:, 0]
    zero = np.zeros(end.size1_in(1))
    cost, minus = stage(ca.vertcat(x, u), data, p)
    move = ca.Function("move", [x, u, p], [cost, ca.densify(-minus)])
    move.save(str(folder / "stage.casadi"))
    ca.Function("end", [x, p], [end(x, zero, p)[0]]).save(str(folder / "end.casadi"))
    one = ca.SX(1)
    none = [ca.SX.zeros(function.size1_out(1)) for function in (stage, end)]
    curved = gauss_newton_hessian(stage)(ca.vertcat(x, u), data, p, one, none[0])
    last = gauss_newton_hessian(end)(x, zero, p, one, none[1])
    for kind, arguments, outputs in (("stage", [x, u, p], curved), ("end", [x, p], last)):
        ca.Function("hessian", arguments, [ca.densify(ca.triu2symm(outputs))]).save(
            str(folder / f"{kind}_hessian.casadi")
        )

    # the closed loop; the start is all of the parameters but the target
    p = np.zeros(form.np)
    p[:nx] = np.concatenate([HOME, np.zeros(7)]) if name == "Panda reach" else [0.5, 0.2, 0.0, 0.0]
    p[nx:] = [0.4, 0.3, 0.4][: form.np - nx]

    def named(vector: Array) -> dict[str, Array]:
        return {key: vector[place] for key, place in form.parameters.items()}

    plan = prepared.solve(named(p))
    controller = prepared.controller(plan, shift=1, iterations=20)
    sequence = [p]
    for k in range(steps):
        control = np.concatenate(list(controller.step(named(p)).control.values()))
        p = p.copy()
        p[:nx] = np.array(move(p[:nx], control, p)[1]).ravel()
        push = 1.0 if k % 50 == 49 else 0.05
        if name == "cart-pole":
            p[2:4] += push * random.uniform(-1, 1, 2)
        else:
            p[nx:] = np.clip(p[nx:] + 0.1 * push * random.uniform(-1, 1, 3), [0.3, -0.3, 0.3], [0.5, 0.3, 0.6])
        sequence.append(p)
    costs = [np.nan] * (steps + 1)
    if reference:
        last_plan = plan
        for k, p in enumerate(sequence):
            last_plan = prepared.solve(named(p), last_plan)
            costs[k] = last_plan.cost
    at = prepared.transcription.arguments(sequence[0], form.bound_values(sequence[0]))
    inside = slice(nx + nu, 2 * nx + nu)
    np.savez(
        folder / "case.npz",
        sequence=np.array(sequence),
        costs=np.array(costs),
        intervals=intervals,
        lower=np.concatenate([at["lbx"][inside], at["lbx"][nx : nx + nu]]),
        upper=np.concatenate([at["ubx"][inside], at["ubx"][nx : nx + nu]]),
        nx=nx,
    )


def row_of(tool: str, folder: Path, name: str, intervals: int) -> dict[str, Any]:
    """Return the row of a tool, which runs in a process of its own; "failed" says why there is none."""
    command = [sys.executable, "-W", "ignore", "-m", "scripts.timing.controllers", tool, str(folder), name]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    blank = {"problem": name, "intervals": intervals, "tool": tool, "median_ms": None, "worst_ms": None}
    blank |= {"iterations": None, "solved": None, "failed": ""}
    ran = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, check=False)
    rows = [json.loads(line[4:]) for line in ran.stdout.splitlines() if line.startswith("row ")]
    last = ran.stderr.strip().splitlines()[-1:] or [f"ended with {ran.returncode}"]
    return blank | (rows[-1] if rows else {"failed": last[0][:200]})


def summary(seconds: ArrayInput, costs: ArrayInput, iterations: ArrayInput, folder: Path) -> dict[str, Any]:
    """Return the numbers of a row: times in ms, iterations in the mean, and the share of steps with ipopt's cost."""
    expected = np.load(folder / "case.npz")["costs"][1:]
    gap = np.abs(np.asarray(costs) - expected) / np.maximum(1.0, np.abs(expected))
    return {
        "median_ms": 1e3 * float(np.median(seconds)),
        "worst_ms": 1e3 * float(np.max(seconds)),
        "iterations": float(np.mean(iterations)) if np.size(iterations) else None,
        "solved": None if np.isnan(expected).all() else float(np.mean(gap <= SAME_COST)),
    }


def selfmotion(tool: str, folder: Path, name: str) -> dict[str, Any]:
    """Run a tool of this package: the controller, the exported C, repeated solves, or fatrop by `prepare`."""
    case = np.load(folder / "case.npz")
    intervals, sequence = int(case["intervals"]), case["sequence"]
    solver = "fatrop" if tool == "fatrop" else "ipopt"
    method = MultipleShooting(intervals)
    prepared: Any = prepare(PROBLEMS[name](intervals), method, solver=solver, compiled=True)
    steps = [{k: p[place] for k, place in prepared.formulation.parameters.items()} for p in sequence]
    plan = prepared.solve(steps[0])
    hessian = "exact" if "exact" in tool else "gauss-newton"
    if tool == "controller in C":
        controller = prepared.controller(plan, iterations=30, shift=0)
        return run_c(controller.to_c(folder / "c"), sequence, folder)
    controller = prepared.controller(plan, iterations=30, shift=0, hessian=hessian) if "controller" in tool else None
    seconds, costs, iterations, last = [], [], [], plan
    for p in steps[1:]:
        began = time.process_time()
        if controller is not None:
            result = controller.step(p)
        else:
            result = last = prepared.solve(p, last, check=False)
        seconds.append(time.process_time() - began)
        costs.append(result.cost)
        iterations.append(result.iterations)
    return summary(seconds, costs, iterations, folder)


CLOCK = """
#include <time.h>
static double processor_time(void) {
  struct timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return t.tv_sec + 1e-9 * t.tv_nsec;
}
"""


def run_c(place: Path, sequence: Array, folder: Path) -> dict[str, Any]:
    """Build the exported controller with cc, with a clock around each step, and run it."""
    main = (place / "main.c").read_text(encoding="utf-8")
    main = main.replace("int main", CLOCK + "\nint main", 1)
    call = "    failed = controller_step("
    main = main.replace(call, f"    double began = processor_time();\n{call}")
    main = main.replace("    if (failed)", "    began = processor_time() - began;\n    if (failed)")
    main = main.replace('"%.17g,%.17g,%.17g,%.17g\\n", cost,', '"%.17g,%.17g,%.17g,%.17g,%.17g\\n", began, cost,')
    (place / "main.c").write_text("#define _POSIX_C_SOURCE 199309L\n" + main, encoding="utf-8")
    subprocess.run(["make"], cwd=place, check=True, capture_output=True)
    numbers = "\n".join(" ".join(repr(float(v)) for v in p) for p in sequence[1:])
    ran = subprocess.run([str(place / "controller")], input=numbers, capture_output=True, text=True, check=True)
    table = np.array([[float(v) for v in line.split(",")] for line in ran.stdout.splitlines()[1:]])
    return summary(table[:, -5], table[:, -4], [], folder)


def main(tool: str, folder: str, name: str) -> None:
    """Print the row of a tool."""
    from scripts.timing import controller_peers as peers

    foreign = next((peer for peer in ("acados", "aligator") if tool.startswith(peer)), None)
    row = getattr(peers, foreign)(tool, Path(folder)) if foreign else selfmotion(tool, Path(folder), name)
    print("\nrow " + json.dumps(row))


def report(numbers: dict[str, Any]) -> str:
    """The tables, and what did not run."""
    rows = numbers["rows"] + numbers["long"]
    lines = [f"{row['tool']}, {row['problem']}, {row['intervals']}: {row['failed']}" for row in rows if row["failed"]]
    return "\n\n".join([text_table(numbers["rows"], 4), text_table(numbers["long"], 4), *lines])


def plot(path: Path, numbers: dict[str, Any]) -> None:
    """Median and worst time of each tool, by problem and intervals."""
    note = "Bars: median time of a step; lines to the worst of all steps. Time of the processor, one run, one machine."
    with drawing.sheet(path, (2, 2), (9.0, 5.4), note) as (_, axes):
        for ax, (name, count) in zip(axes.flat, [(p, n) for p in PROBLEMS for n in INTERVALS], strict=True):
            mine = [r for r in numbers["rows"] if (r["problem"], r["intervals"]) == (name, count) and not r["failed"]]
            labels = [row["tool"] for row in mine]
            ax.barh(labels, [row["median_ms"] for row in mine], color=drawing.COLORS["blue"])
            for place, row in enumerate(mine):
                ax.plot([row["median_ms"], row["worst_ms"]], [place, place], color=drawing.COLORS["black"], lw=1)
            ax.set(title=f"{name}, {count} intervals", xscale="log", xlabel="ms a step")
            ax.invert_yaxis()


if __name__ == "__main__":
    main(*sys.argv[1:])
