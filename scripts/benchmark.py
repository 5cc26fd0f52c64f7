"""How fast problems are built and solved, beside the same problem written as a loop of Opti constraints.

`python scripts/benchmark.py [--out results] [--repeats 5]` writes OUT/benchmark/summary.json and a plot. All figures are
of one run on one machine; what is claimed are the ratios and the growth, not the seconds.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import models  # noqa: E402
from ocp import Collocation, Problem, Solution, prepare  # noqa: E402
from ocp.builders import redundancy  # noqa: E402
from ocp.formulation import Formulation  # noqa: E402
from ocp.interpolation import differentiation_matrix  # noqa: E402
from scripts import drawing  # noqa: E402

INTERVALS = (50, 100, 200, 400, 800)
DEGREE = 3
IPOPT = {"tol": 1e-10, "print_level": 0, "sb": "yes"}


def free_floating() -> Problem:
    """The paper's example at t_f = 5 s."""
    start = np.deg2rad([45.0, 60.0, -60.0])
    return redundancy.minimum_velocity(models.paper_example(), [-1.0, -1.0], [3, 4], start, 5.0)


def opti_loop(problem: Problem, intervals: int, guess: Solution) -> tuple[Any, float]:
    """The same Radau collocation written as a loop of Opti constraints. Returns the Opti and its build time, s.

    The stage function is one casadi Function of SX, as a careful user would write it; only the loop is naive.
    """
    form = Formulation(problem)
    stage = form.function("stage", [form.f, form.running, form.path.expression], ["f", "running", "path"])
    points = np.array(ca.collocation_points(DEGREE, "radau"))
    derivative = differentiation_matrix(np.concatenate([[0.0], points]))[1:]
    weights = np.array(ca.collocation_coeff(points.tolist())[2].full()).ravel()
    horizon = guess.horizon
    h = horizon / intervals
    first = guess.state_interpolant(np.zeros(1))[0]

    began = time.perf_counter()
    opti = ca.Opti()
    cost: Any = 0
    x = opti.variable(form.nx)
    opti.subject_to(x == first)
    opti.set_initial(x, first)
    for k in range(intervals):
        states = [x, *[opti.variable(form.nx) for _ in range(DEGREE)]]
        for j in range(1, DEGREE + 1):
            u = opti.variable(form.nu)
            time_at = (k + points[j - 1]) * h
            rate, running, path = stage(states[j], u, time_at, horizon, [])
            slope = sum(float(derivative[j - 1, i]) * states[i] for i in range(DEGREE + 1))
            opti.subject_to(slope == h * rate)
            opti.subject_to(path == 0)
            cost += h * weights[j - 1] * running
            at = np.array([time_at / horizon])
            opti.set_initial(states[j], guess.state_interpolant(at)[0])
            opti.set_initial(u, guess.control_interpolant(at)[0])
        x = states[-1]
    opti.minimize(cost)
    opti.solver("ipopt", {"print_time": False}, IPOPT)
    # Opti builds its solver at the first call; ask for it without solving
    opti.to_function("built", [opti.x], [opti.x])
    return opti, time.perf_counter() - began


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    began = time.perf_counter()
    result = work()
    return result, time.perf_counter() - began
