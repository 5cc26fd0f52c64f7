"""Peers of the controller in `scripts.timing.controllers`, each with the settings that were the fastest here.

They read the functions of the problem from CasADi files, so that all solve the same nonlinear program.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import io
import os
import subprocess
import tempfile
import time
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from scripts.timing.controllers import summary

TOLERANCE = 1e-7
PENALTY = 1e-6
"""First penalty of aligator."""


def acados(tool: str, folder: Path) -> dict[str, Any]:
    """SQP with HPIPM, partially condensed to a quarter of the intervals."""
    package = importlib.import_module("acados")
    installed = Path(str(package.__file__)).parent
    for name in ("blasfeo", "hpipm", "qpOASES_e", "acados"):
        ctypes.CDLL(str(installed / f"install/lib/lib{name}.so"), mode=ctypes.RTLD_GLOBAL)
    source = folder / "acados"  # the layout of its sources, which its templates expect
    (source / "interfaces/acados_template").mkdir(parents=True, exist_ok=True)
    links = {"include": "install/include", "lib": "install/lib", "bin": "install/bin"}
    for name, at in (links | {"interfaces/acados_template/acados_template": "acados_template"}).items():
        with contextlib.suppress(FileExistsError):
            (source / name).symlink_to(installed / at)
    os.environ["ACADOS_SOURCE_DIR"] = str(source)
    template = importlib.import_module("acados.acados_template")

    case, exact = np.load(folder / "case.npz"), "exact" in tool
    nx, n, sequence = int(case["nx"]), int(case["intervals"]), case["sequence"]
    stage, end = (ca.Function.load(str(folder / f"{name}.casadi")) for name in ("stage", "end"))
    x, u, p = (ca.SX.sym(name, stage.size1_in(i)) for i, name in enumerate("xup"))
    ocp, model = template.AcadosOcp(), template.AcadosModel()
    cost, following = stage(x, u, p)
    model.name, model.x, model.u, model.p = "peer", x, u, p
    model.disc_dyn_expr, model.cost_expr_ext_cost, model.cost_expr_ext_cost_0 = following, cost, cost
    model.cost_expr_ext_cost_e = end(x, p)
    if not exact:
        for kind, arguments, end_of in (("stage", (x, u, p), ""), ("end", (x, p), "_e")):
            hessian = ca.Function.load(str(folder / f"{kind}_hessian.casadi"))(*arguments)
            if kind == "stage":  # acados orders controls before states
                order = [*range(nx, hessian.shape[0]), *range(nx)]
                hessian = hessian[order, order]
                model.cost_expr_ext_cost_custom_hess_0 = hessian
            setattr(model, f"cost_expr_ext_cost_custom_hess{end_of}", hessian)
    ocp.model, ocp.dims.N, ocp.parameter_values = model, n, sequence[0]
    ocp.cost.cost_type = ocp.cost.cost_type_0 = ocp.cost.cost_type_e = "EXTERNAL"
    limits = ocp.constraints
    low, high = case["lower"], case["upper"]
    bounded = np.flatnonzero(np.isfinite(low[:nx]))
    limits.idxbx = limits.idxbx_e = bounded
    limits.lbx, limits.ubx = low[bounded], high[bounded]
    limits.lbx_e, limits.ubx_e = low[bounded], high[bounded]
    limits.idxbu, limits.lbu, limits.ubu = np.arange(u.numel()), low[nx:], high[nx:]
    limits.x0 = sequence[0][:nx]
    options = ocp.solver_options
    options.tf = float(n)  # the stage's cost is not multiplied by its duration
    options.integrator_type, options.qp_solver = "DISCRETE", "PARTIAL_CONDENSING_HPIPM"
    options.qp_solver_cond_N, options.nlp_solver_type = n // 4, "SQP"
    options.hessian_approx = "EXACT" if exact else "GAUSS_NEWTON"
    options.nlp_solver_max_iter, options.tol, options.print_level = 50, TOLERANCE, 0
    options.qp_solver_warm_start = 0
    ocp.code_export_directory = str(folder / f"code{exact}")
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()):
        solver = template.AcadosOcpSolver(ocp, json_file=str(folder / f"ocp{exact}.json"), verbose=False)

    def solve(data: Any) -> float:
        began = time.process_time()
        for k in range(n + 1):
            solver.set(k, "p", data)
        solver.set(0, "lbx", data[:nx])
        solver.set(0, "ubx", data[:nx])
        solver.solve()
        return time.process_time() - began

    for k in range(n + 1):
        solver.set(k, "x", sequence[0][:nx])
    solve(sequence[0])
    seconds, costs, iterations = [], [], []
    for data in sequence[1:]:
        seconds.append(solve(data))
        costs.append(solver.get_cost())
        iterations.append(float(solver.get_stats("sqp_iter")[0]))
    return summary(seconds, costs, iterations, folder)


def aligator(tool: str, folder: Path) -> dict[str, Any]:
    """ProxDDP; its wheel is a C++ library, so that the program beside this file is built against it by g++."""
    place = Path(str(distribution("libaligator").locate_file("cmeel.prefix")))
    case = np.load(folder / "case.npz")
    nx, sequence = int(case["nx"]), case["sequence"]
    stage, end = (ca.Function.load(str(folder / f"{name}.casadi")) for name in ("stage", "end"))
    x, u, p = (ca.SX.sym(name, stage.size1_in(i)) for i, name in enumerate("xup"))
    functions = [ca.Function.load(str(folder / f"{name}_hessian.casadi")) for name in ("stage", "end")]
    v = ca.vertcat(x, u)
    cost, following = stage(x, u, p)
    last = end(x, p)
    outputs = [cost, ca.gradient(cost, v), functions[0](x, u, p), following, ca.jacobian(following, v)]
    ends = [last, ca.gradient(last, x), functions[1](x, p)]
    generator = ca.CodeGenerator("functions.c")
    generator.add(ca.Function("stage_value", [x, u, p], [cost, following]))
    generator.add(ca.Function("stage_all", [x, u, p], [ca.densify(each) for each in outputs]))
    generator.add(ca.Function("end_all", [x, p], [ca.densify(each) for each in ends]))
    with tempfile.TemporaryDirectory() as build:
        generator.generate(f"{build}/")
        lines = [f"{nx} {u.numel()} {p.numel()} {int(case['intervals'])} {len(sequence)}"]
        lines += [" ".join(repr(float(np.clip(v, -1e20, 1e20))) for v in row) for row in (case["lower"], case["upper"])]
        lines += [" ".join(repr(float(v)) for v in row) for row in sequence]
        subprocess.run(["cc", "-O2", "-c", "functions.c"], cwd=build, check=True)
        include, library = place / "include", place / "lib"
        eigen = Path(ca.__file__).parent / "include/eigen3"  # the wheel of aligator has no Eigen
        words = [
            "g++",
            "-std=c++17",
            "-O2",
            "-w",
            f"-I{include}",
            f"-I{eigen}",
            "-DNDEBUG",
            f"-DTOLERANCE={TOLERANCE}",
            "-DMU=1e-2",
        ]
        words += [str(Path(__file__).with_name("aligator.cpp")), f"{build}/functions.o", "-o", f"{build}/peer"]
        words += [f"-L{library}", f"-Wl,-rpath,{library}", "-laligator", "-lfmt"]
        subprocess.run(words, check=True)
        ran = subprocess.run(
            [f"{build}/peer", repr(TOLERANCE), repr(PENALTY)],
            input="\n".join(lines),
            capture_output=True,
            text=True,
            check=True,
        )
    table = np.array([[float(word) for word in line.split()] for line in ran.stdout.splitlines()])
    return summary(table[1:, 0], table[1:, 1], table[1:, 2], folder)
