"""How fast problems are built and solved, and costates evaluated, each beside the obvious way to do it.

`python scripts/benchmark.py [--out results] [--repeats 5]` writes OUT/benchmark/summary.json and plots. All figures are
of one run on one machine; what is claimed are ratios and growth, not seconds.
"""

from __future__ import annotations

import argparse
import importlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from tqdm import tqdm

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:  # run as a file
    sys.path.insert(0, str(ROOT))

from models import FreeFloating, Joint, Link, Robot, paper_example  # noqa: E402
from ocp import Collocation, Problem, Solution, prepare  # noqa: E402
from ocp.builders import redundancy  # noqa: E402
from ocp.curves import differentiation_matrix, quadrature_weights  # noqa: E402
from ocp.indirect.hamiltonian import Hamiltonian  # noqa: E402
from ocp.problem.formulation import Formulation  # noqa: E402
from scripts import drawing  # noqa: E402
from scripts.papers.free_floating.costates import costate_rate  # noqa: E402
from scripts.papers.free_floating.virtual_chain import VirtualChain  # noqa: E402

INTERVALS = (50, 100, 200, 400, 800)
DEGREE = 3
JOINTS = (3, 7, 14, 28)
IPOPT = {"tol": 1e-10, "print_level": 0, "sb": "yes"}
COMPILER = ["-O2", "-fPIC", "-shared"]
MODULES = ("cts", "blend", "robots")
"""scripts/benchmark_NAME.py, each with run(repeats) -> summary and plot(path, summary)."""


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """Result and wall time, s."""
    began = time.perf_counter()
    result = work()
    return result, time.perf_counter() - began


def median(work: Callable[[], Any], repeats: int) -> float:
    """Median wall time, s."""
    return float(np.median([timed(work)[1] for _ in range(repeats)]))


# ---- build and solve -----------------------------------------------------------------------------------------


def free_floating() -> Problem:
    """The paper's example at t_f = 5 s."""
    start = np.deg2rad([45.0, 60.0, -60.0])
    return redundancy.minimum_velocity_problem(paper_example(), [-1.0, -1.0], [3, 4], start, 5.0)


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
    opti, made = timed(lambda: opti_loop(problem, intervals, guess))
    first = timed(opti.solve)[1]
    again = median(opti.solve, 3)
    return opti, (made + first - again, again)


def build_and_solve(repeats: int, progress: Callable[[str], None]) -> list[dict[str, Any]]:
    """Build and solve times of the package and of the loop, for every number of intervals."""
    rows = []
    problem = free_floating()
    prepare(problem, Collocation(10)).solve(check=False)  # warm up
    for n in INTERVALS:
        progress(f"{n} intervals")
        build = median(partial(prepare, problem, Collocation(n, DEGREE)), repeats)
        prepared = prepare(problem, Collocation(n, DEGREE))
        ours = prepared.solve()
        solve = median(prepared.solve, repeats)
        start = prepare(problem, Collocation(n, DEGREE), options={"max_iter": 0}).solve(check=False)
        loop = [opti_times(problem, n, start) for _ in range(max(1, repeats // 2))]
        opti = loop[-1][0]
        both = [times for _, times in loop]
        loop_build, loop_solve = np.median(both, axis=0)
        rows.append(
            {
                "intervals": n,
                "build_s": build,
                "solve_s": solve,
                "iterations": ours.iterations,
                "opti_build_s": float(loop_build),
                "opti_solve_s": float(loop_solve),
                "opti_iterations": int(opti.stats()["iter_count"]),
                "build_ratio": float(loop_build) / build,
                "solve_ratio": float(loop_solve) / solve,
                "cost_difference": float(opti.value(opti.f)) - ours.cost,
            }
        )
    return rows


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
    runs = [
        float(
            subprocess.run([sys.executable, "-c", code, str(ROOT)], capture_output=True, text=True, check=True).stdout
        )
        for _ in range(repeats)
    ]
    return float(np.median(runs))


# ---- costates ------------------------------------------------------------------------------------------------


def serial_arm(joints: int) -> FreeFloating:
    """A satellite with an arm of ``joints`` revolute joints about alternate axes."""
    links = [Link("satellite", 100.0, (0.0, 0.0, 0.0), np.diag([60.0, 60.0, 66.0]))]
    made = []
    for i in range(joints):
        links.append(Link(f"link {i}", 4.0, (0.2, 0.0, 0.02), np.diag([0.02, 0.06, 0.06])))
        axis = [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)][i % 3]
        shift = (1.0, 0.2, 0.1) if i == 0 else (0.4, 0.0, 0.05)
        made.append(Joint(f"joint {i}", "revolute", links[i].name, links[i + 1].name, shift, axis=axis))
    return FreeFloating(Robot(tuple(links), tuple(made), tip_translation=(0.4, 0.0, 0.0)), base="spatial")


def costate_function(machine: FreeFloating, rows: list[int]) -> tuple[Any, Any]:
    """Functions (state, costate) -> costate rate and -> H of the redundancy problem, the control eliminated."""
    start = np.linspace(0.3, 0.6, machine.joint_size)
    velocity = np.full(len(rows), 0.05)
    problem = redundancy.minimum_velocity_problem(machine, velocity, rows, start, 0.1, limits=False)
    ham = Hamiltonian.of(Formulation(problem))
    x, lam = ca.SX.sym("x", ham.sizes[0]), ca.SX.sym("lam", ham.sizes[0])
    rest = [0, 1, [], [], np.zeros(ham.sizes[-1])]
    rate = ham.flow()(x, lam, *rest)[1]
    value = ham.outputs()(x, lam, *rest)[2]
    return ca.Function("costate_rate", [x, lam], [rate]), ca.Function("hamiltonian", [x, lam], [value])


def compiled(function: Any, folder: Path) -> Any:
    """The same function through the machine's C compiler."""
    source = Path(function.generate(f"{function.name()}.c", {}))
    target = folder / source.name
    source.replace(target)
    library = target.with_suffix(".so")
    subprocess.run(["cc", *COMPILER, str(target), "-o", str(library), "-lm"], check=True)
    return ca.external(function.name(), str(library))


def microseconds(function: Any, inputs: list[np.ndarray], repeats: int, count: int = 200) -> float:
    """Median time of one call, over a map that leaves out the cost of Python, microseconds."""
    many = function.map(count, "serial")
    tiled = [ca.DM(np.tile(v[:, None], (1, count))) for v in inputs]
    many.call(tiled)
    return 1e6 * median(lambda: many.call(tiled), repeats) / count


def costates(repeats: int, progress: Callable[[str], None]) -> list[dict[str, Any]]:
    """Costate right-hand side of a spatial base with n joints by four ways, microseconds a call."""
    table = []
    rows = [3, 4, 5]
    rng = np.random.default_rng(7)
    with tempfile.TemporaryDirectory() as folder:
        for n in JOINTS:
            progress(f"costates, {n} joints")
            machine = serial_arm(n)
            rate, value = costate_function(machine, rows)
            x = np.concatenate([machine.base_home(), rng.uniform(0.2, 0.8, n)])
            lam = rng.normal(size=len(x))
            vm = microseconds(rate, [x, lam], repeats)
            native = microseconds(compiled(rate, Path(folder)), [x, lam], repeats, 2000)

            step = 1e-6
            points = np.column_stack([x + s * e for e in np.eye(len(x)) * step for s in (1.0, -1.0)])
            differences = value.map(points.shape[1], "serial")
            tiled = [ca.DM(points), ca.DM(np.tile(lam[:, None], (1, points.shape[1])))]
            finite = 1e6 * median(partial(differences.call, tiled), repeats)

            chain = VirtualChain.from_machine(machine)
            place = np.concatenate([np.zeros(6), x[7:]])
            own = rng.normal(size=len(place))
            call = partial(costate_rate, chain, place, own, np.full(3, 0.05), rows)
            recursion = 1e6 * median(call, max(3, repeats))
            table.append(
                {
                    "joints": n,
                    "casadi_vm_us": vm,
                    "compiled_us": native,
                    "recursion_numpy_us": recursion,
                    "finite_differences_us": finite,
                    "recursion_over_compiled": recursion / native,
                    "finite_differences_over_vm": finite / vm,
                    "instructions": rate.n_instructions(),
                }
            )
    return table


# ---- other modules -------------------------------------------------------------------------------------------


def run_module(name: str, folder: Path, repeats: int) -> dict[str, Any]:
    """Runs scripts/benchmark_NAME.py and writes NAME.json, NAME.png and a table of every list of rows it returns.

    The list called "rows" becomes NAME.csv, another one NAME_LIST.csv.
    """
    module = importlib.import_module(f"scripts.benchmark_{name}")
    summary: dict[str, Any] = module.run(repeats)
    for key, value in summary.items():
        if isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
            drawing.write_table(folder / (f"{name}.csv" if key == "rows" else f"{name}_{key}.csv"), value, 6)
    drawing.write_json(folder / f"{name}.json", summary)
    module.plot(folder / f"{name}.png", summary)
    return summary


# ---- the page ------------------------------------------------------------------------------------------------


def plot_build_and_solve(path: Path, rows: list[dict[str, Any]]) -> None:
    n = [row["intervals"] for row in rows]
    note = (
        "Free-floating example, t_f = 5 s, Radau-3, the same guess, IPOPT with MUMPS, tolerance 1e-10. Opti: a loop of "
        "constraints round one SX stage function. Medians of one run on one machine."
    )
    with drawing.sheet(path, columns=2, size=(7.0, 3.2), note=note, sharey=True) as (_, axes):
        for axis, what in zip(axes[0], ("build", "solve"), strict=True):
            axis.loglog(n, [row[f"{what}_s"] for row in rows], "o-", label="selfmotion")
            axis.loglog(n, [row[f"opti_{what}_s"] for row in rows], "s--", label="loop of Opti constraints")
            first = rows[0][f"{what}_s"]
            axis.loglog(n, [first * k / n[0] for k in n], ":", color=drawing.COLORS["grey"], label="linear growth")
            axis.set(title=what, xlabel="intervals", xticks=n, xticklabels=[str(k) for k in n])
            axis.minorticks_off()
        axes[0, 0].set_ylabel("time, s")
        axes[0, 0].legend()


def plot_costates(path: Path, rows: list[dict[str, Any]]) -> None:
    n = [row["joints"] for row in rows]
    note = (
        "Costate right-hand side of problem (27), spatial base and n joints, three task rows. Recursion: Algorithms "
        "1-4 and (33)-(39) of the paper in numpy; the others: automatic differentiation, base attitude as a quaternion."
    )
    names = {
        "recursion_numpy_us": "the paper's recursion, numpy",
        "finite_differences_us": "finite differences of H",
        "casadi_vm_us": "CasADi virtual machine",
        "compiled_us": "compiled C",
    }
    with drawing.sheet(path, size=(5.2, 3.6), note=note) as (_, axes):
        axis = axes[0, 0]
        for marker, (key, label) in zip("osD^", names.items(), strict=True):
            axis.loglog(n, [row[key] for row in rows], f"{marker}-", label=label)
        axis.set(xlabel="joints", ylabel="time of one call, µs", xticks=n, xticklabels=[str(k) for k in n])
        axis.minorticks_off()
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def run(out: Path, repeats: int) -> dict[str, Any]:
    """All benchmarks; writes OUT/benchmark and returns the summary."""
    bar = tqdm(total=len(INTERVALS) + len(JOINTS) + 1 + len(MODULES), disable=None, file=sys.stderr)

    def progress(text: str) -> None:
        bar.set_description(text)
        bar.update()

    rows = build_and_solve(repeats, progress)
    table = costates(repeats, progress)
    progress("import")
    at_100 = next(row for row in rows if row["intervals"] == 100)
    at_7 = next(row for row in table if row["joints"] == 7)
    summary = {
        "build_and_solve": rows,
        "build_ratio_at_100": at_100["build_ratio"],
        "solve_ratio_at_100": at_100["solve_ratio"],
        "build_growth_over_linear": growth(rows, "build_s"),
        "solve_growth_over_linear": growth(rows, "solve_s", "iterations"),
        "import_ocp_s": import_seconds(repeats),
        "costate_rate": table,
        "recursion_over_compiled_at_7": at_7["recursion_over_compiled"],
    }
    folder = out / "benchmark"
    for name in MODULES:
        progress(name)
        run_module(name, folder, repeats)
    bar.close()
    drawing.write_table(folder / "build_and_solve.csv", rows, 6)
    drawing.write_table(folder / "costate_rate.csv", table, 6)
    plot_build_and_solve(folder / "build_and_solve.png", rows)
    plot_costates(folder / "costate_rate.png", table)
    drawing.write_json(folder / "summary.json", summary)
    return summary


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder for the results")
    parser.add_argument("--repeats", type=int, default=5, help="runs of which the median is taken")
    arguments = parser.parse_args()
    summary = run(arguments.out, arguments.repeats)
    print(drawing.text_table(summary["build_and_solve"], 4))
    print(drawing.text_table(summary["costate_rate"], 4))
    build, solve = summary["build_ratio_at_100"], summary["solve_ratio_at_100"]
    print(f"at 100 intervals: build {build:.1f} x, solve {solve:.2f} x less")
    print(
        f"growth from 100 to {max(INTERVALS)} intervals over linear: build {summary['build_growth_over_linear']:.2f}, "
        f"solve (an iteration) {summary['solve_growth_over_linear']:.2f}"
    )
    print(f"import of ocp beyond casadi: {summary['import_ocp_s']:.3f} s")
    print(f"compiled costate rate, 7 joints: {summary['recursion_over_compiled_at_7']:.0f} x the recursion in numpy")


if __name__ == "__main__":
    main()
