"""Receding-horizon controllers, which solve a prepared problem again in every control cycle with a bounded effort.

The solver is sequential quadratic programming: CasADi's ``sqpmethod`` linearises the program, and ``qrqp``, an
active-set method with a sparse QR factorisation, solves the quadratic program from the active limits of the last one.
The numbers of iterations of both are limited. Neither allocates memory, and both have C code, so that the whole
controller can be exported to C. If the result violates dynamics or limits, as when the active limits of the last step
are dependent for the new data, a second attempt starts without active limits.

By default the Hessian is that of Gauss and Newton: squares in the cost lose the curvature of their residuals, and
constraints lose theirs. It is positive semidefinite if the rest of the cost is convex, far from the optimum as well
(Nocedal, Wright 2006, Numerical Optimization, sections 10.3 and 18.3).
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ocp.curves import lagrange
from ocp.direct.active_set import at_limit
from ocp.direct.assembly import ArrayFunction, assemble, build_function, derivatives, gather
from ocp.direct.code_generation import c_strings, compile_functions, function_key, write_c
from ocp.direct.guess import shifted_indices
from ocp.direct.nlp import Outcome
from ocp.errors import ProblemError, SolveError, SolverStatus, require
from ocp.problem.values import symbols_of
from ocp.solution import ByName, Solution
from ocp.storage import checked_path

HESSIANS = ("gauss-newton", "exact")
QUIET = {"print_header": False, "print_iteration": False, "print_status": False, "print_time": False}
QUIET_QP = {"print_header": False, "print_iter": False, "print_info": False, "error_on_fail": False}
MEASURES = ("dynamics_violation", "limit_violation", "residual")
OUTPUTS = ("control", "x", "lam_x", "lam_g", "cost", "rows", *MEASURES)


@dataclass(frozen=True)
class ControllerSettings:
    """Settings of a model predictive controller, as :meth:`ocp.direct.prepared.Prepared.controller` documents them."""

    iterations: int = 5
    qp_iterations: int = 100
    hessian: str = "gauss-newton"
    tolerance: float = 1e-6
    shift: int = 1

    def __post_init__(self) -> None:
        require.count("controller: iterations", self.iterations)
        require.count("controller: qp_iterations", self.qp_iterations)
        require.choice("controller: hessian", self.hessian, HESSIANS)
        require.positive("controller: tolerance", self.tolerance)


@dataclass(frozen=True)
class ControlStep:
    """Result of one step of a :class:`Controller`: the control to apply, with its cost and its violations.

    Attributes:
        control: Controls at the begin of the horizon, by name; they keep the bounds of the controls. Shape (n,) each.
        cost: Cost of the predicted motion.
        converged: Whether all violations and the residual are within the controller's tolerance. Otherwise the
            iterations or the quadratic programs reached their limit.
        dynamics_violation: Largest violation of the discretised dynamics, in the units of the problem.
        limit_violation: Largest violation of a bound or of a path, start or end constraint by the prediction.
        residual: Largest residual of the first-order conditions: gradient of the Lagrangian, and complementarity.
        iterations: Number of iterations of the last attempt. seconds: Wall time of the step, s.
        held: Whether the new iterate is not finite. ``control`` and ``prediction`` are then those of the last step.
    """

    control: dict[str, np.ndarray]
    cost: float
    converged: bool
    dynamics_violation: float
    limit_violation: float
    residual: float
    iterations: int
    seconds: float
    held: bool
    _solution: Callable[[], Solution] = field(repr=False)

    def __str__(self) -> str:
        state = "held" if self.held else "converged" if self.converged else "not converged"
        return f"{state}, {self.iterations} iterations: violation {self.violation:.1e}, residual {self.residual:.1e}"

    @property
    def violation(self) -> float:
        """The larger of the violations of the dynamics and of the limits."""
        return max(self.dynamics_violation, self.limit_violation)

    @cached_property
    def prediction(self) -> Solution:
        """The predicted motion over the horizon, which is built when it is first used (a few milliseconds)."""
        return self._solution()


class Controller:
    """Model predictive controller: each step solves the problem over a horizon that recedes with time.

    A step depends only on its arguments and on the steps before. Only one thread may use a controller.

    Attributes:
        settings: The settings.
    """

    def __init__(self, prepared: Any, plan: Solution, settings: ControllerSettings) -> None:
        self.settings, self._prepared = settings, prepared
        shift = require.count("controller: shift", settings.shift, least=0, most=prepared.method.intervals - 1)
        if shift and prepared.method.mesh is not None:
            words = "controller: shift requires equal intervals; use shift=0"
            raise ProblemError(words, name="shift", value=shift)
        self._functions = program_functions(prepared, settings.hessian)
        functions = self._functions
        if prepared.compiled:
            keys, names = [function_key(f) for f in functions], [f.name() for f in functions]
            functions = ProgramFunctions(*compile_functions(keys, names, lambda: self._functions))
        self._solver, function = self._build(functions)
        bounds = prepared.formulation.bounds.function
        self._run, self._bounds = ArrayFunction(function, kept=True), ArrayFunction(bounds, kept=True)
        self.reset(plan)

    def reset(self, plan: Solution) -> None:
        """Restart the controller from a plan, which the next step uses without a shift in time.

        Raises:
            ProblemError: The plan is not a solution of the prepared problem.
        """
        prepared = self._prepared
        if not prepared.is_own_plan(plan) or not np.all(np.isfinite(plan.multipliers)):
            words = (
                f"controller: plan must be a solution of the prepared problem {prepared.problem.name!r}, not {plan!r}"
            )
            raise ProblemError(words, name="plan", value=plan)
        form, v, of_rows = prepared.formulation, plan.variables, plan.multipliers
        p = form.parameter_vector(plan.parameters)
        limits = prepared.transcription.arguments(p, form.bound_values(p))
        slope, jacobian = prepared.program.numbers.first(v, p)
        _, rows = prepared.program.numbers.values(v, p)
        of_bounds = -(slope + jacobian.T @ of_rows)
        # the multipliers of an interior-point method are never zero, but qrqp starts from all that are not zero
        of_bounds = np.where(at_limit(v, limits["lbx"], limits["ubx"], of_bounds), of_bounds, 0.0)
        of_rows = np.where(at_limit(rows, limits["lbg"], limits["ubg"], of_rows), of_rows, 0.0)
        self._state = v, of_bounds, of_rows
        self._shift, self._last = np.zeros(1), list[np.ndarray]()  # no shift in the first step

    def step(self, parameters: ByName = None) -> ControlStep:
        """Solve the problem for new parameters, such as the measured state, starting from the shifted last result.

        Raises:
            ProblemError: A parameter is missing, unknown, of a wrong size or not finite, or a bound is not a number or
                exceeds its upper bound at these parameters. The controller stays as it was.
            SolveError: A function of the problem is not finite in the first step. In later steps the result of the last
                one is held.
        """
        began = time.perf_counter()
        form, tolerance = self._prepared.formulation, self.settings.tolerance
        p = form.parameter_vector(require.mapping("parameters", parameters))
        lower, upper = self._bounds(p)
        if not (lower <= upper).all():
            form.bound_values(p)  # raises an error that names the bound
        measures, held = [np.inf] * len(MEASURES), True
        with suppress(RuntimeError):  # a function of the problem is not finite, or cannot be evaluated
            outputs = self._run(p, *self._state, self._shift)
            measures = [float(value[0]) for value in outputs[-len(MEASURES) :]]
            held = not math.isfinite(sum(measures))
        if held and not self._last:
            words = f"controller: a function of problem {form.name!r} is not finite at these parameters, and no earlier"
            raise SolveError(f"{words} step can be held; start again from a plan: reset(plan)", name=form.name)
        if not held:
            self._last, self._state = outputs, tuple(outputs[1:4])
        self._shift = np.ones(1)
        control, x, _, lam_g, cost, rows = self._last[: -len(MEASURES)]
        iterations, value = int(self._solver.stats(1)["iter_count"]), float(cost[0])
        dynamics, limits, residual = measures
        converged, seconds = max(measures) <= tolerance and not held, time.perf_counter() - began
        status = SolverStatus.SOLVED if converged else SolverStatus.ITERATION_LIMIT

        def prediction() -> Solution:
            outcome = Outcome(x, value, rows, lam_g, status, "", iterations, seconds, solver="sqpmethod")
            solution: Solution = self._prepared.solution_from(outcome, p, "last step")
            return solution

        controls = {name: control[place] for name, place in form.controls.items()}
        return ControlStep(
            controls, value, converged, dynamics, limits, residual, iterations, seconds, held, prediction
        )

    def to_c(self, folder: str | os.PathLike[str]) -> Path:
        """Write the controller with its solver as C: code, an example main program, and a Makefile that builds both.

        The C performs the operations of :meth:`step` in the same order. It needs a compiler and the mathematics
        library. The folder is created, and files of the same names are replaced:

            controller.c, controller.h
                            controller_step (p, x0, lam_x0, lam_g0, shift) -> control, x, lam_x, lam_g, cost, rows,
                            dynamics_violation, limit_violation, residual; called (arg, res, iw, w, 0) as in CasADi's
                            manual
            start.h         sizes, names of the parameters, and x, lam_x, lam_g of the present state of the controller
            main.c          a program that reads parameters, step after step, and writes controls and violations
            Makefile        builds it with `make`

        Raises:
            ProblemError: A part of the problem cannot be written as C code, such as cvodes.
            OSError: The folder cannot be written.
        """
        place = Path(checked_path(folder))
        form, transcription = self._prepared.formulation, self._prepared.transcription
        sizes = {
            "PARAMETERS": form.np,
            "CONTROLS": form.nu,
            "VARIABLES": transcription.size,
            "ROWS": transcription.n_rows,
        }
        lines = [f"#define CONTROLLER_{name} {size}" for name, size in sizes.items()]
        for name, values in zip(("x", "lam_x", "lam_g"), self._state, strict=True):
            numbers = [f"{value:.17g}" for value in (*values, 0.0)]
            lines += [f"static double {name}[] = {{", *(f"  {number}," for number in numbers), "};"]
        lines += [c_strings("parameters", form.parameter_labels), c_strings("controls", form.control_labels), ""]
        texts = {"start.h": "\n".join(lines), "main.c": MAIN, "Makefile": MAKEFILE}
        return write_c(form, [self._build(self._functions)[1]], "controller", folder=place, texts=texts)

    def _build(self, functions: ProgramFunctions) -> tuple[Any, Any]:
        """Return the solver, and a casadi Function of a control step that solves again if a result is infeasible."""
        transcription, form, settings = self._prepared.transcription, self._prepared.formulation, self.settings
        x, p = ca.MX.sym("x", transcription.size), ca.MX.sym("p", form.np)
        cost, rows = functions.values(x, p)
        options = {
            **QUIET,
            "qpsol": "qrqp",
            "qpsol_options": {**QUIET_QP, "max_iter": settings.qp_iterations},
            "max_iter": settings.iterations,
            "tol_pr": settings.tolerance,
            "tol_du": settings.tolerance,
            "jac_fg": functions.first,
            "hess_lag": functions.hessian,
            "no_nlp_grad": True,
            "calc_lam_p": False,
            "error_on_fail": False,
            "show_eval_warnings": False,
        }
        solver = ca.nlpsol("controller", "sqpmethod", {"x": x, "p": p, "f": cost, "g": rows}, options)
        attempt = self._attempt(solver, functions)

        lam_x, lam_g, is_shifted = (ca.MX.sym(name, *attempt.size_in(i)) for i, name in ((2, "x"), (3, "g"), (4, "s")))
        outputs = [ca.MX.sym(name, *attempt.size_out(i)) for i, name in enumerate(OUTPUTS)]
        second = attempt(p, x, 0, 0, is_shifted)
        choice = ca.Function.if_else(
            "choice",
            ca.Function("second", [p, x, is_shifted, *outputs], second),
            ca.Function("first", [p, x, is_shifted, *outputs], outputs),
        )
        first = dict(zip(OUTPUTS, attempt(p, x, lam_x, lam_g, is_shifted), strict=True))
        is_infeasible = ca.fmax(first["dynamics_violation"], first["limit_violation"]) > settings.tolerance
        final = choice(is_infeasible, p, x, is_shifted, *first.values())
        names = ["p", "x0", "lam_x0", "lam_g0", "shift"]
        return solver, ca.Function("controller_step", [p, x, lam_x, lam_g, is_shifted], final, names, list(OUTPUTS))

    def _attempt(self, solver: Any, functions: ProgramFunctions) -> Any:
        """Return a casadi Function that solves the program once from the last result and measures the violations."""
        transcription, form = self._prepared.transcription, self._prepared.formulation
        x, p, is_shifted = ca.MX.sym("x", transcription.size), ca.MX.sym("p", form.np), ca.MX.sym("shift")
        lam_x, lam_g = ca.MX.sym("lam_x", transcription.size), ca.MX.sym("lam_g", transcription.n_rows)
        table = form.bounds.function(p)
        places = transcription.variable_bounds, transcription.row_bounds
        (low, high), (low_g, high_g) = ([ca.densify(ca.vec(side)[at.tolist()]) for side in table] for at in places)
        at_x, at_g = (index.tolist() for index in shifted_indices(transcription, self.settings.shift))

        def shifted(vector: Any, index: list[int]) -> Any:
            return (1 - is_shifted) * vector + is_shifted * vector[index]

        start = ca.fmin(ca.fmax(shifted(x, at_x), low), high)
        duals = {"lam_x0": shifted(lam_x, at_x), "lam_g0": shifted(lam_g, at_g)}
        result = solver(x0=start, p=p, lbx=low, ubx=high, lbg=low_g, ubg=high_g, **duals)
        end, of_bounds, of_rows = ca.fmin(ca.fmax(result["x"], low), high), result["lam_x"], result["lam_g"]
        cost, slope, rows, jacobian = functions.first(end, p)
        dynamics = np.flatnonzero(transcription.row_bounds == form.bounds.places["zero"][0]).tolist()
        limits = np.setdiff1d(np.arange(transcription.n_rows), dynamics).tolist()
        gradient = slope + ca.mtimes(jacobian.T, of_rows) + of_bounds
        # a multiplier is zero, or the limit of its sign is active (natural residual of complementarity)
        gaps = [
            ca.fmin(ca.fmax(sign * multiplier, 0), sign * (limit - value))
            for value, multiplier, sides in ((end, of_bounds, (low, high)), (rows, of_rows, (low_g, high_g)))
            for sign, limit in zip((-1, 1), sides, strict=True)
        ]
        invalid = 0 * (ca.sum1(result["x"]) + ca.sum1(gradient) + cost)  # nan if one of them is not finite
        measures = (
            ca.norm_inf(ca.vertcat(0, rows[dynamics])),
            ca.mmax(ca.vertcat(0, low - end, low_g[limits] - rows[limits], rows[limits] - high_g[limits])),
            ca.norm_inf(ca.vertcat(gradient, *gaps)),
        )
        curves, bounds = transcription.interpolants, form.bounds.places["control"].tolist()
        weights = lagrange(curves.control_nodes, np.zeros(1))
        control = ca.mtimes(gather(end, curves.controls[:, 0].reshape(-1, form.nu).T), ca.DM(weights.T))
        control = ca.fmin(ca.fmax(control, ca.vec(table[0])[bounds]), ca.vec(table[1])[bounds])
        outputs = [control, end, of_bounds, of_rows, cost, rows]
        outputs += [measure + invalid for measure in measures]
        return ca.Function("attempt", [p, x, lam_x, lam_g, is_shifted], [ca.densify(each) for each in outputs])


# ---- functions of the nonlinear program ------------------------------------------------------------------------------


class ProgramFunctions(NamedTuple):
    """The casadi Functions of the nonlinear program of a controller, named as casadi's solver sqpmethod requires.

    Attributes:
        values: (x, p) -> cost, rows.
        first: (x, p) -> cost, its gradient, rows, their Jacobian.
        hessian: (x, p, lam_f, lam_g) -> Hessian of the Lagrangian, or its approximation, both triangles.
    """

    values: Any
    first: Any
    hessian: Any


def program_functions(prepared: Any, hessian: str) -> ProgramFunctions:
    """Return the functions of a prepared problem's nonlinear program, with an exact or a Gauss-Newton Hessian."""
    transcription, form = prepared.transcription, prepared.formulation
    blocks = [derivatives(block.function) for block in transcription.blocks]
    if hessian == "gauss-newton":
        blocks = [block._replace(hessian=gauss_newton_hessian(block.value)) for block in blocks]
    program = assemble(transcription, form.np, blocks)
    x, p = ca.MX.sym("x", transcription.size), ca.MX.sym("p", form.np)
    sigma, lam = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", transcription.n_rows)
    (cost, slope), (rows, jacobian) = program.gradient(x, p), program.jacobian(x, p)
    both = ca.triu2symm(program.hessian(x, p, sigma, lam))
    outputs, symbols = ["f", "grad:f:x", "g", "jac:g:x"], ["x", "p", "lam_f", "lam_g"]
    return ProgramFunctions(
        ca.Function("nlp_fg", [x, p], [*program.values(x, p)], ["x", "p"], ["f", "g"]),
        ca.Function("nlp_jac_fg", [x, p], [cost, slope, rows, jacobian], ["x", "p"], outputs),
        ca.Function("nlp_hess_l", [x, p, sigma, lam], [both], symbols, ["hess:gamma:x:x"]),
    )


def gauss_newton_hessian(function: Any) -> Any:
    """Return a casadi Function that evaluates the Gauss-Newton Hessian (upper triangle) of the cost of a block.

    ``function`` is that of a :class:`ocp.direct.assembly.Block`. If its cost is w r^2 + ... + c, the Hessian is
    2 w r' r'^T + ... plus the exact Hessian of c, the part without squares. Functions that cannot be expanded to
    scalar operations keep the exact Hessian of their cost.
    """
    with suppress(RuntimeError):
        function = function.expand()
    symbol = symbols_of(function).sym
    v, d, p = (symbol(name, function.numel_in(i)) for i, name in enumerate(("v", "d", "p")))
    cost, rows = function(v, d, p)
    sigma, lam = symbol("sigma"), symbol("lam", rows.numel())
    residuals, weights, remainder = split_squares(cost, v) if function.is_a("SXFunction") else ([], [], cost)
    slope = ca.jacobian(ca.vertcat(*residuals), v) if residuals else symbol("none", 0, v.numel())
    squares = 2 * ca.mtimes(slope.T, ca.mtimes(ca.diag(ca.vertcat(*weights)), slope)) if residuals else 0
    upper = ca.triu(sigma * (squares + ca.hessian(remainder, v)[0]))
    return build_function("hessian", [v, d, p, sigma, lam], [upper])


def split_squares(cost: Any, variables: Any) -> tuple[list[Any], list[Any], Any]:
    """Split an SX cost into ``sum w r^2 + c``, up to a constant, with residuals r, weights w and a remainder c.

    Only the weights do not depend on the variables. A square that is multiplied by an expression of the variables
    belongs to the remainder.
    """
    residuals, weights, remainder, terms = list[Any](), list[Any](), ca.SX(0), [(cost, ca.SX(1))]
    while terms:
        term, weight = terms.pop()
        if not ca.depends_on(term, variables):
            continue
        kind = term.op() if term.n_dep() else None
        parts = [term.dep(i) for i in range(term.n_dep())]
        if kind in (ca.OP_ADD, ca.OP_SUB):
            terms += [(parts[0], weight), (parts[1], weight if kind == ca.OP_ADD else -weight)]
        elif kind in (ca.OP_NEG, ca.OP_TWICE):
            terms.append((parts[0], (-1 if kind == ca.OP_NEG else 2) * weight))
        elif kind == ca.OP_SQ:
            residuals.append(parts[0])
            weights.append(weight)
        elif kind == ca.OP_MUL and not all(ca.depends_on(part, variables) for part in parts):
            factor, rest = sorted(parts, key=lambda part: ca.depends_on(part, variables))
            terms.append((rest, weight * factor))
        elif kind == ca.OP_DIV and not ca.depends_on(parts[1], variables):
            terms.append((parts[0], weight / parts[1]))
        else:
            remainder += weight * term
    return residuals, weights, remainder


MAIN = """\
/* controller < numbers: reads the parameters of one step after the other, and writes for each step the controls, the
   cost, the violations of dynamics and of limits, and the residual. Ends with 2 if the input is wrong, with 3 if the
   first step fails. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "controller.h"
#include "start.h"

static casadi_int iw[controller_step_SZ_IW + 1];
static casadi_real w[controller_step_SZ_W + 1];
static const casadi_real *arg[controller_step_SZ_ARG + 1];
static casadi_real *res[controller_step_SZ_RES + 1];

int main(void) {
  static double p[CONTROLLER_PARAMETERS + 1], control[CONTROLLER_CONTROLS + 1], rows[CONTROLLER_ROWS + 1];
  static double next_x[CONTROLLER_VARIABLES + 1], next_lam_x[CONTROLLER_VARIABLES + 1], next_lam_g[CONTROLLER_ROWS + 1];
  static double next_control[CONTROLLER_CONTROLS + 1];
  double shift = 0, cost = 0, dynamics = 0, limits = 0, residual = 0;
  long i;
  int failed;
  for (i = 0; controls[i]; ++i) printf("%s,", controls[i]);
  printf("cost,dynamics_violation,limit_violation,residual\\n");
  for (;;) {
    for (i = 0; i < CONTROLLER_PARAMETERS; ++i)
      if (scanf("%lf", p + i) != 1) {
        if (i || !feof(stdin)) {
          fprintf(stderr, "a number is missing for parameter %s\\n", parameters[i]);
          return 2;
        }
        return 0;
      }
    arg[0] = p, arg[1] = x, arg[2] = lam_x, arg[3] = lam_g, arg[4] = &shift;
    res[0] = next_control, res[1] = next_x, res[2] = next_lam_x, res[3] = next_lam_g, res[4] = &cost, res[5] = rows;
    res[6] = &dynamics, res[7] = &limits, res[8] = &residual;
    failed = controller_step(arg, res, iw, w, 0) || !(dynamics + limits + residual < HUGE_VAL);
    if (failed) { /* the controller and its control stay as they were */
      dynamics = limits = residual = HUGE_VAL;
      if (!shift) return 3;
    } else {
      memcpy(control, next_control, sizeof control);
      memcpy(x, next_x, sizeof x);
      memcpy(lam_x, next_lam_x, sizeof lam_x);
      memcpy(lam_g, next_lam_g, sizeof lam_g);
    }
    for (i = 0; controls[i]; ++i) printf("%.17g,", control[i]);
    printf("%.17g,%.17g,%.17g,%.17g\\n", cost, dynamics, limits, residual);
    shift = 1;
  }
}
"""

MAKEFILE = """\
CC     ?= cc
CFLAGS ?= -O2 -ffp-contract=off

controller: main.c controller.c controller.h start.h
\t$(CC) $(CFLAGS) main.c controller.c -o $@ -lm
"""
