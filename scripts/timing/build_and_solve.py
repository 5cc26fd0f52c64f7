"""How fast problems are built and solved, beside the obvious way: a loop of Opti constraints; and the import."""

from __future__ import annotations

import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ocp import Collocation, Problem, Solution, prepare
from ocp.curves import differentiation_matrix, quadrature_weights
from ocp.problem.formulation import Formulation
from scripts import drawing
from scripts.papers.free_floating.formulations import problem as free_floating
from scripts.papers.run import progress, text_table
from scripts.timing.measure import median, timed

ROOT = Path(__file__).resolve().parents[2]
INTERVALS = (50, 100, 200, 400, 800)
DEGREE = 3
IPOPT = {"tol": 1e-10, "print_level": 0, "sb": "yes"}


def run(repeats: int = 5) -> dict[str, Any]:
    """Build and solve times of the package and of the loop, for every number of intervals; the time of the import."""
    problem = free_floating()
    prepare(problem, Collocation(10)).solve(check=False)  # warm up
    rows = [compared_times(problem, n, repeats) for n in progress(INTERVALS, "build and solve")]
    at_100 = next(row for row in rows if row["intervals"] == 100)
    return {
        "rows": rows,
        "build_ratio_at_100": at_100["build_ratio"],
        "solve_ratio_at_100": at_100["solve_ratio"],
        "build_growth_over_linear": growth(rows, "build_s"),
        "solve_growth_over_linear": growth(rows, "solve_s", "iterations"),
        "import_ocp_s": import_seconds(repeats),
    }


def compared_times(problem: Problem, intervals: int, repeats: int) -> dict[str, Any]:
    """One row: times, iterations and costs of both ways."""
    method = Collocation(intervals, DEGREE)
    build = median(partial(prepare, problem, method), repeats)
    prepared = prepare(problem, method)
    ours = prepared.solve()
    solve = median(prepared.solve, repeats)
    start = prepare(problem, method, options={"max_iter": 0}).solve(check=False)
    loop = [opti_times(problem, intervals, start) for _ in range(max(1, repeats // 2))]
    opti = loop[-1][0]
    loop_build, loop_solve = (float(value) for value in np.median([times for _, times in loop], axis=0))
    return {
        "intervals": intervals,
        "build_s": build,
        "solve_s": solve,
        "iterations": ours.iterations,
        "opti_build_s": loop_build,
        "opti_solve_s": loop_solve,
        "opti_iterations": int(opti.stats()["iter_count"]),
        "build_ratio": loop_build / build,
        "solve_ratio": loop_solve / solve,
        "cost_difference": float(opti.value(opti.f)) - ours.cost,
    }


def opti_loop(problem: Problem, intervals: int, guess: Solution) -> Any:
    """The same Radau collocation written as a loop of Opti constraints.

    The stage function is one casadi Function of SX, as a careful user would write it; only the loop is naive.
    """
    form = Formulation(problem)
    stage = form.function("stage", [form.f, form.running, form.path.expression], ["f", "running", "path"])
    points = np.array(ca.collocation_points(DEGREE, "radau"))
    derivative = differentiation_matrix(np.concatenate([[0.0], points]))[1:]
    weights = quadrature_weights(points)
    horizon = guess.horizon
    h = horizon / intervals
    first = guess.state_interpolant(np.zeros(1))[0]

    opti = ca.Opti()
    cost: Any = 0
    x = opti.variable(form.nx)
    opti.subject_to(x == first)
    opti.set_initial(x, first)
    for k in range(intervals):
        states = [x, *[opti.variable(form.nx) for _ in range(DEGREE)]]
        for j in range(1, DEGREE + 1):
            u = opti.variable(form.nu)
            at = (k + points[j - 1]) * h
            rate, running, path = stage(states[j], u, at, horizon, [])
            slope = sum(float(derivative[j - 1, i]) * states[i] for i in range(DEGREE + 1))
            opti.subject_to(slope == h * rate)
            opti.subject_to(path == 0)
            cost += h * float(weights[j - 1]) * running
            fraction = np.array([at / horizon])
            opti.set_initial(states[j], guess.state_interpolant(fraction)[0])
            opti.set_initial(u, guess.control_interpolant(fraction)[0])
        x = states[-1]
    opti.minimize(cost)
    opti.solver("ipopt", {"print_time": False}, IPOPT)
    return opti


def opti_times(problem: Problem, intervals: int, guess: Solution) -> tuple[Any, tuple[float, float]]:
    """The loop and its times to build and to solve, s. Opti makes its solver in the first solve."""
    opti, result = timed(lambda: opti_loop(problem, intervals, guess))
    first = timed(opti.solve)[1]
    again = median(opti.solve, 3)
    return opti, (result + first - again, again)


def growth(rows: list[dict[str, Any]], what: str, per: str | None = None) -> float:
    """Time at the largest number of intervals over time at 100, over the ratio of the intervals: 1 is linear."""
    at = {row["intervals"]: row[what] / (row[per] if per else 1) for row in rows}
    last = max(at)
    return float(at[last] / at[100] / (last / 100))


def import_seconds(repeats: int) -> float:
    """Median time of `import ocp` beyond that of casadi and numpy, in fresh interpreters, s."""
    code = (
        "import sys, time; sys.path.insert(0, sys.argv[1]); import casadi, numpy; "
        "t = time.perf_counter(); import ocp; print(time.perf_counter() - t)"
    )
    command = [sys.executable, "-c", code, str(ROOT)]
    runs = [subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(repeats)]
    return float(np.median([float(seconds) for seconds in runs]))


def report(summary: dict[str, Any]) -> str:
    """The times in words."""
    build, solve = summary["build_growth_over_linear"], summary["solve_growth_over_linear"]
    return (
        f"{text_table(summary['rows'], 4)}\n"
        f"at 100 intervals: build {summary['build_ratio_at_100']:.1f} x, "
        f"solve {summary['solve_ratio_at_100']:.2f} x less\n"
        f"growth from 100 to {max(INTERVALS)} intervals over linear: build {build:.2f}, solve (an iteration) "
        f"{solve:.2f}\nimport of ocp beyond casadi: {summary['import_ocp_s']:.3f} s"
    )


def plot(path: Path, summary: dict[str, Any]) -> None:
    """Times to build and to solve over the number of intervals."""
    rows = summary["rows"]
    n = [row["intervals"] for row in rows]
    note = (
        "Free-floating example, t_f = 5 s, Radau-3, the same guess, IPOPT with MUMPS, tolerance 1e-10. Opti: a loop of "
        "constraints round one SX stage function. Medians of one run on one machine."
    )
    title = "Built by one mapped function a problem is ready many times sooner than by a loop of constraints"
    with drawing.sheet(path, (1, 2), (7.0, 3.6), note, title=title, sharey=True) as (_, axes):
        for axis, what in zip(axes[0], ("build", "solve"), strict=True):
            axis.loglog(n, [row[f"{what}_s"] for row in rows], "o-", label="selfmotion")
            axis.loglog(n, [row[f"opti_{what}_s"] for row in rows], "s--", label="loop of Opti constraints")
            first = rows[0][f"{what}_s"]
            axis.loglog(n, [first * k / n[0] for k in n], ":", color=drawing.COLORS["grey"], label="linear growth")
            axis.set(title=what, xlabel="intervals", xticks=n, xticklabels=[str(k) for k in n])
            axis.minorticks_off()
        axes[0, 0].set_ylabel("time, s")
        axes[0, 0].legend()
