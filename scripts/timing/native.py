"""The native stage solver: how it grows with the intervals; and what is solved again from a plan, beside IPOPT.

All times are of the processor. IPOPT from the plan's values with interpreted functions is what the first release's
`prepare` gave.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase
from ocp import Collocation, MultipleShooting, Problem, inverse_kinematics, prepare
from ocp.builders.redundancy import minimum_velocity_problem
from scripts import drawing
from scripts.papers.free_floating.results import problem as free_floating
from scripts.papers.run import progress, text_table
from scripts.robots.panda import HOME, LAP, circling
from scripts.robots.robots import PANDA
from scripts.timing.measure import against

INTERVALS = (100, 400, 1600, 6400)
AGAIN = 80  # intervals of what is solved again
LIMITED = 2
"""The joint whose speed backwards is limited below what it has without. Not the paper's arm's first: slower than it
wants to go it comes to a singular posture, where what that costs grows without end with the intervals."""
GOALS = {"prepare, 1000 intervals": (0.5, "s at most"), "8 states, 4 controls, 100 intervals": (10.0, "ms at most")}
FASTER = 8.0  # times, than IPOPT interpreted, where it is solved again


def run(repeats: int = 5) -> dict[str, Any]:
    """Rows by the number of intervals, and by what is solved again, and what is asked of single figures."""
    arm = free_floating()
    prepare(arm, Collocation(5), solver="native", compiled=True).solve()  # into the cache
    rows = [grown(arm, n, repeats) for n in progress(INTERVALS, "native")]
    first, last = rows[0], rows[-1]
    ratio = last["intervals"] / first["intervals"]
    small = prepare(chain(), MultipleShooting(100), solver="native", compiled=True)
    small.solve()
    figures = {
        "prepare, 1000 intervals": least(
            lambda: prepare(arm, Collocation(1000), solver="native", compiled=True), repeats
        ),
        "8 states, 4 controls, 100 intervals": 1e3 * least(small.solve, repeats),
    }
    return {
        "rows": rows,
        "again": [again(name, problem, method, repeats) for name, problem, method in cases()],
        "build_growth_over_linear": last["prepare_s"] / first["prepare_s"] / ratio,
        "solve_growth_over_linear": last["iteration_s"] / first["iteration_s"] / ratio,
        "figures": {name: {"figure": figures[name], goal: limit} for name, (limit, goal) in GOALS.items()},
    }


def grown(problem: Problem, intervals: int, repeats: int) -> dict[str, Any]:
    """One row: times on so many intervals, of a build with compiled functions at hand and of a cold solve."""
    made: list[Any] = []

    def build() -> None:
        made[:] = [prepare(problem, Collocation(intervals), solver="native", compiled=True)]

    before = resident()
    build()
    plan = made[0].solve()
    taken = resident() - before
    solved, built = least(made[0].solve, repeats), least(build, repeats)
    return {
        "intervals": intervals,
        "prepare_s": built,
        "solve_s": solved,
        "iterations": plan.iterations,
        "iteration_s": solved / plan.iterations,
        "kB_an_interval_and_state": taken / 1e3 / intervals / 6,
        "solver": plan.solver,
    }


def cases() -> list[tuple[str, Problem, Any]]:
    """Problems with a limit that is a parameter, "limit", near which they are."""
    machine = FixedBase(PANDA.read())
    start = inverse_kinematics(machine, circling(), near=HOME, starts=0)[0].joints
    lap = minimum_velocity_problem(
        machine, task=circling(), start_joints=start, horizon=LAP, cyclic=True, free_start=True
    )
    found = []
    for name, problem in (("Panda lap", lap), ("paper's arm", free_floating())):
        problem.path("own limit", -problem.declared.controls["rates"].symbol[LIMITED], upper=problem.parameter("limit"))
        found += [
            (f"{name}, {m.__class__.__name__}", problem, m) for m in (Collocation(AGAIN), MultipleShooting(AGAIN))
        ]
    return found


def again(name: str, problem: Problem, method: Any, repeats: int) -> dict[str, Any]:
    """One row: a solve by IPOPT interpreted from the values of an earlier plan; native cold, and from that plan."""
    loose = {"limit": 50.0}
    plain = prepare(problem, method, solver="ipopt", compiled=False)
    native = prepare(problem, method, solver="native", compiled=True)
    free = native.solve(loose)
    near, then = ({"limit": float(-share * free["rates"][:, LIMITED].min())} for share in (0.95, 0.949))
    plan = native.solve(near)
    values = {**plan.states, **plan.controls, "t": plan.t}  # which say nothing of limits
    times = {
        "ipopt_s": least(lambda: plain.solve(then, values), repeats),
        "cold_s": least(lambda: native.solve(then), repeats),
        "warm_s": least(lambda: native.solve(then, plan), repeats),
    }
    other, warm = plain.solve(then, values), native.solve(then, plan)
    return {
        "name": name,
        **times,
        "cold_ratio": times["ipopt_s"] / times["cold_s"],
        "warm_ratio": times["ipopt_s"] / times["warm_s"],
        "iterations": other.iterations,
        "warm_iterations": warm.iterations,
        "cost_difference": warm.cost - other.cost,
        "solver": warm.solver,
    }


def chain() -> Problem:
    """Four pendulums with drag and two path rows: 8 states, 4 controls."""
    problem = Problem("chain")
    x, u = problem.state("x", 8, initial=[1, 0, -1, 0, 0.5, 0, 0, 0]), problem.control("u", 4)
    problem.dynamics(x, ca.vertcat(x[4:], u - ca.sin(x[:4]) - 0.1 * x[4:] * ca.sumsqr(x[4:])))
    problem.horizon(5.0)
    problem.path("first", x[0] * x[1] + u[0], upper=2.0)
    problem.path("second", x[2] + x[5] ** 2, upper=3.0)
    problem.minimize(running=ca.sumsqr(x) + 0.1 * ca.sumsqr(u))
    return problem


def least(work: Callable[[], Any], repeats: int) -> float:
    """Least time of the processor of a number of runs, s."""
    times = []
    for _ in range(max(1, repeats)):
        began = time.process_time()
        work()
        times.append(time.process_time() - began)
    return min(times)


def resident() -> int:
    """Memory of this process, bytes; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * 4096
    except OSError:
        return 0


def report(summary: dict[str, Any]) -> str:
    """The figures in words."""
    told = {name: dict(one) for name, one in summary["figures"].items()}
    lines = [against({name: told[name]}, goal) for name, (_, goal) in GOALS.items()]
    return (
        f"{text_table(summary['rows'], 4)}\n{text_table(summary['again'], 4)}\n" + "\n".join(lines) + "\n"
        f"growth from {INTERVALS[0]} to {INTERVALS[-1]} intervals over linear: build "
        f"{summary['build_growth_over_linear']:.2f}, solve (an iteration) {summary['solve_growth_over_linear']:.2f}; "
        f"solved again: {FASTER:g} times asked"
    )


def plot(path: Path, summary: dict[str, Any]) -> None:
    """Times over the number of intervals."""
    rows = summary["rows"]
    n = [row["intervals"] for row in rows]
    note = "Free-floating example, t_f = 5 s, Radau-3, compiled functions at hand; processor time of one run."
    with drawing.sheet(path, (1, 1), (4.5, 3.2), note) as (_, axes):
        axis = np.ravel(axes)[0]
        for what, word in (("prepare_s", "build"), ("solve_s", "solve")):
            axis.loglog(n, [row[what] for row in rows], "o-", label=word)
        axis.loglog(n, [rows[0]["prepare_s"] * k / n[0] for k in n], ":", color=drawing.COLORS["grey"], label="linear")
        axis.set(xlabel="intervals", ylabel="time, s")
        axis.legend()
