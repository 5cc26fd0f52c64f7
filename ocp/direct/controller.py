"""Export of a prepared problem as C for controllers, and compiled derivatives of its blocks.

The exported C needs a compiler and the mathematics library; it uses no Python and allocates no memory. The folder
contains:

    plan.c, plan.h  functions by CasADi, called (arg, res, iw, w, 0) as in its manual; x are the plan's variables:
                    plan_objective (x, p) -> cost, gradient
                    plan_constraints (x, p) -> rows, Jacobian
                    plan_hessian (x, p, lam_f, lam_g) -> upper triangle of the Hessian of the Lagrangian
                    plan_bounds (p) -> lower and upper bounds of x, of the rows
                    plan_guess (p) -> x
                    plan_curves (x, p) -> horizon, states, controls
    curves.h        states and controls at a time, from the output of plan_curves
    problem.h       sizes, names, and breaks of the curves
    main.c          a program that turns parameters, and optionally x, into a table of states and controls over time
    Makefile        builds it with `make`

Compiled derivatives are libraries of :mod:`ocp.libraries`, cached between runs. They return exactly the numbers of the
interpreted functions.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ocp.direct import assembly
from ocp.direct.assembly import SIZES, Derivatives, Transcription, assemble, derivatives, gather
from ocp.errors import ProblemError
from ocp.libraries import (
    SERIALISED,
    CompilerError,
    Library,
    build_library,
    function_key,
    generate_c,
    generate_code,
    warn_interpreted,
)
from ocp.problem.formulation import Formulation
from ocp.storage import write_text

__all__ = ["block_derivatives", "write_controller"]


def controller_functions(form: Formulation, transcription: Transcription, guess: np.ndarray) -> list[Any]:
    """Return the exported functions, in the units of the problem.

    Args:
        guess: Variables that `plan_guess` clips to the bounds at its parameters. Shape (size,).
    """
    program = assemble(transcription, form.np)
    x, p = ca.MX.sym("x", transcription.size), ca.MX.sym("p", form.np)
    sigma, lam = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", transcription.n_rows)
    lower, upper = form.bounds.function(p)
    at_x, at_g = transcription.variable_bounds.tolist(), transcription.row_bounds.tolist()
    bounds = [ca.densify(ca.vec(side)[at]) for at in (at_x, at_g) for side in (lower, upper)]
    start = ca.fmin(ca.fmax(ca.DM(guess), bounds[0]), bounds[1])

    curves = transcription.interpolants
    horizon = ca.MX(form.horizon_at(p)) if transcription.horizon is None else x[transcription.horizon]
    states = gather(x, curves.variables)
    if curves.values is not None:
        states = curves.mapped(states, ca.DM(curves.data), horizon, p)
    controls = gather(x, curves.controls)
    outputs = [horizon, ca.vec(states), ca.vec(controls)]
    functions: list[tuple[str, dict[str, Any], dict[str, Any]]] = [
        ("objective", {"x": x, "p": p}, dict(zip(("f", "grad_f"), program.gradient(x, p), strict=True))),
        ("constraints", {"x": x, "p": p}, dict(zip(("g", "jac_g"), program.jacobian(x, p), strict=True))),
        ("hessian", {"x": x, "p": p, "lam_f": sigma, "lam_g": lam}, {"hess": program.hessian(x, p, sigma, lam)}),
        ("bounds", {"p": p}, dict(zip(("lbx", "ubx", "lbg", "ubg"), bounds, strict=True))),
        ("guess", {"p": p}, {"x": start}),
        ("curves", {"x": x, "p": p}, dict(zip(("horizon", "states", "controls"), outputs, strict=True))),
    ]
    return [
        ca.Function(f"plan_{name}", [*arguments.values()], [*results.values()], [*arguments], [*results])
        for name, arguments, results in functions
    ]


def write_controller(form: Formulation, transcription: Transcription, guess: np.ndarray, folder: Path) -> Path:
    """Write the folder described in this module; each file is written completely or not at all.

    Raises:
        ProblemError: Some part of the problem has no C, such as an integrator of variable step.
        OSError: The folder cannot be written.
    """
    try:
        plan = generate_c(controller_functions(form, transcription, guess), "plan")
    except CompilerError as error:
        raise ProblemError(f"problem {form.name!r} has no C: {error}", name="method", value=form.name) from error
    texts = dict(zip(("plan.c", "plan.h"), plan, strict=True))
    texts |= {"curves.h": CURVES, "main.c": MAIN, "Makefile": MAKEFILE}
    texts["problem.h"] = problem_header(form, transcription)
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        write_text(folder / name, text)
    return folder


def problem_header(form: Formulation, transcription: Transcription) -> str:
    """Return problem.h: sizes, names, and breaks and nodes of the curves."""
    curves = transcription.interpolants
    labels = [
        f"{name}[{i}]" if s.stop - s.start > 1 else name
        for name, s in form.parameters.items()
        for i in range(s.stop - s.start)
    ]
    sizes = {
        "VARIABLES": transcription.size,
        "ROWS": transcription.n_rows,
        "PARAMETERS": form.np,
        "STATES": form.nx,
        "CONTROLS": form.nu,
        "PIECES": len(curves.breaks) - 1,
        "NODES": len(curves.nodes),
        "CONTROL_PIECES": len(curves.mesh) - 1,
        "CONTROL_NODES": len(curves.control_nodes),
    }
    title = quoted(form.name).replace("*/", "* /")
    lines = [f"/* {title} */", *(f"#define PLAN_{name} {size}" for name, size in sizes.items())]
    tables = {"breaks": curves.breaks, "nodes": curves.nodes, "mesh": curves.mesh, "samples": curves.control_nodes}
    for name, values in tables.items():
        lines.append(f"static const double plan_{name}[] = {{{', '.join(f'{value:.17g}' for value in values)}}};")
    for name, words in (("parameters", labels), ("columns", [*form.state_labels, *form.control_labels])):
        lines.append(f"static const char *const plan_{name}[] = {{{', '.join([*map(quoted, words), '0'])}}};")
    return "\n".join([*lines, ""])


def quoted(text: str) -> str:
    """Return a text as a C string literal, with the UTF-8 bytes of non-ASCII characters escaped."""
    plain = "".join(
        chr(byte) if 32 <= byte < 127 and chr(byte) not in '"\\?' else f"\\{byte:03o}" for byte in text.encode()
    )
    return f'"{plain}"'


CURVES = """\
/* States and controls of a plan at a time. */
#ifndef PLAN_CURVES_H
#define PLAN_CURVES_H
#include "problem.h"

/* Values of `width` polynomials at a fraction of the horizon: pieces between breaks, each given at nodes in 0..1. */
static void plan_curve(const double *breaks, int pieces, const double *nodes, int count, const double *values,
                       int width, double fraction, double *out) {
  int low = 0, high = pieces, i, j, k;
  double place;
  while (high - low > 1) {
    int middle = (low + high) / 2;
    if (breaks[middle] <= fraction) low = middle; else high = middle;
  }
  place = (fraction - breaks[low]) / (breaks[low + 1] - breaks[low]);
  place = place < 0 ? 0 : place > 1 ? 1 : place;
  for (k = 0; k < width; ++k) out[k] = 0;
  for (i = 0; i < count; ++i) {
    double weight = 1;
    for (j = 0; j < count; ++j)
      if (j != i) weight *= (place - nodes[j]) / (nodes[i] - nodes[j]);
    for (k = 0; k < width; ++k) out[k] += weight * values[((long)low * count + i) * width + k];
  }
}

/* What plan_curves returned, at a time in s from the start; x has PLAN_STATES numbers, u PLAN_CONTROLS. */
static void plan_at(double horizon, const double *states, const double *controls, double time, double *x, double *u) {
  const double fraction = time / horizon;
  plan_curve(plan_breaks, PLAN_PIECES, plan_nodes, PLAN_NODES, states, PLAN_STATES, fraction, x);
  plan_curve(plan_mesh, PLAN_CONTROL_PIECES, plan_samples, PLAN_CONTROL_NODES, controls, PLAN_CONTROLS, fraction, u);
}
#endif
"""

MAIN = """\
/* plan PERIOD: reads the parameters, then, if there are more numbers, the variables of a plan (else takes the guess);
   writes a table of states and controls every PERIOD s, and to stderr the cost and by how much a limit is missed.
   Ends with 1 where that is more than 1e-6, with 2 where the input is wrong. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "curves.h"
#include "plan.h"

#define MOST(a, b) ((a) > (b) ? (a) : (b))
#define SIZE(what) MOST(MOST(MOST(plan_objective_SZ_##what, plan_constraints_SZ_##what), \\
                             MOST(plan_bounds_SZ_##what, plan_guess_SZ_##what)), plan_curves_SZ_##what)

static double p[PLAN_PARAMETERS + 1], x[PLAN_VARIABLES + 1], g[PLAN_ROWS + 1];
static double lbx[PLAN_VARIABLES + 1], ubx[PLAN_VARIABLES + 1], lbg[PLAN_ROWS + 1], ubg[PLAN_ROWS + 1];
static double states[PLAN_PIECES * PLAN_NODES * PLAN_STATES + 1];
static double controls[PLAN_CONTROL_PIECES * PLAN_CONTROL_NODES * PLAN_CONTROLS + 1];
static casadi_int iw[SIZE(IW) + 1];
static casadi_real w[SIZE(W) + 1];
static const casadi_real *arg[SIZE(ARG) + 1];
static casadi_real *res[SIZE(RES) + 1];

static double missed(const double *value, const double *lower, const double *upper, int count) {
  double worst = 0;
  int i;
  for (i = 0; i < count; ++i) {
    if (isnan(value[i])) return INFINITY; /* fmax leaves it out */
    worst = fmax(worst, fmax(lower[i] - value[i], value[i] - upper[i]));
  }
  return worst;
}

static int failed(const char *words) {
  fprintf(stderr, "%s\\n", words);
  return 2;
}

int main(int count, char **words) {
  double cost, horizon, worst, at[PLAN_STATES + PLAN_CONTROLS + 1], period = count == 2 ? atof(words[1]) : 0;
  long i, k, given;
  if (!(period > 0)) return failed("usage: plan PERIOD < numbers");
  for (i = 0; i < PLAN_PARAMETERS; ++i)
    if (scanf("%lf", p + i) != 1) return failed("a number is missing for a parameter");
  for (given = 0; given < PLAN_VARIABLES && scanf("%lf", x + given) == 1;) ++given;
  if (given && given < PLAN_VARIABLES) return failed("a number is missing for a variable of the plan");

  arg[0] = p;
  res[0] = lbx, res[1] = ubx, res[2] = lbg, res[3] = ubg;
  if (plan_bounds(arg, res, iw, w, 0)) return failed("plan_bounds failed");
  if (!given) {
    res[0] = x;
    if (plan_guess(arg, res, iw, w, 0)) return failed("plan_guess failed");
  }
  arg[0] = x, arg[1] = p;
  res[0] = &cost, res[1] = 0;
  if (plan_objective(arg, res, iw, w, 0)) return failed("plan_objective failed");
  arg[0] = x, arg[1] = p;
  res[0] = g, res[1] = 0;
  if (plan_constraints(arg, res, iw, w, 0)) return failed("plan_constraints failed");
  arg[0] = x, arg[1] = p;
  res[0] = &horizon, res[1] = states, res[2] = controls;
  if (plan_curves(arg, res, iw, w, 0)) return failed("plan_curves failed");
  worst = fmax(missed(x, lbx, ubx, PLAN_VARIABLES), missed(g, lbg, ubg, PLAN_ROWS));
  fprintf(stderr, "cost %.17g, a limit is missed by %.3g\\n", cost, worst);

  printf("time");
  for (k = 0; plan_columns[k]; ++k) printf(",%s", plan_columns[k]);
  for (i = 0; i == 0 || (i - 1) * period < horizon; ++i) {
    const double time = fmin(i * period, horizon);
    plan_at(horizon, states, controls, time, at, at + PLAN_STATES);
    printf("\\n%.17g", time);
    for (k = 0; k < PLAN_STATES + PLAN_CONTROLS; ++k) printf(",%.17g", at[k]);
  }
  printf("\\n");
  return !(worst <= 1e-6);
}
"""

MAKEFILE = """\
CC     ?= cc
CFLAGS ?= -O1 -ffp-contract=off

plan: main.c plan.c plan.h curves.h problem.h
\t$(CC) $(CFLAGS) main.c plan.c -o $@ -lm
"""


RECIPE = hashlib.sha256(Path(assembly.__file__).read_bytes()).hexdigest()
"""Hash of the code that derives block functions: part of the key of a compiled library."""


def block_derivatives(transcription: Transcription, compiled: bool) -> list[Derivatives]:
    """Return the derivatives of each block; blocks with the same function share them.

    Args:
        transcription: The program.
        compiled: Whether to compile. Functions that cannot be compiled are interpreted, with one warning.

    Raises:
        TimeLimitReached: The time limit is over.
    """
    texts = [function_key(block.function) for block in transcription.blocks]
    by_text: dict[str, Derivatives] = {}
    for text, block in zip(texts, transcription.blocks, strict=True):
        if text not in by_text:
            is_compiled = compiled and _can_be_compiled(block.function, text)
            by_text[text] = _compiled(block.function, text) if is_compiled else derivatives(block.function)
    return [by_text[text] for text in texts]


def _can_be_compiled(function: Any, text: str) -> bool:
    """Return whether a function can be identified by its text and is long enough to compile."""
    is_short = function.is_a("SXFunction") and function.n_instructions() <= SIZES.called
    return text.startswith(SERIALISED) and not is_short


def _compiled(function: Any, text: str) -> Derivatives:
    """Return the derivatives of a function from a compiled library, or interpreted if compilation fails."""
    try:
        path = build_library(Library((RECIPE, text), lambda: generate_code(derivatives(function))))
        return Derivatives(*(ca.external(name, str(path)) for name in Derivatives._fields))
    except (CompilerError, RuntimeError) as error:
        warn_interpreted(str(error))
        return derivatives(function)
