"""C code of a problem: compiled derivatives for its nonlinear program, and export of the problem to controllers.

Derivatives are compiled into shared libraries, each identified by its source data, the compiler and its flags, so that
meshes, processes and runs share it (:mod:`models.files`). Compiled functions return exactly the numbers of interpreted
ones: the same operations in the same order, without fused operations. The compiler is that of the environment's CC,
else `cc`; without one, functions are interpreted.

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
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import files as cache
from ocp.console import LOG, casadi_silenced, check_time
from ocp.direct import assembly
from ocp.direct.assembly import SIZES, Derivatives, Transcription, assemble, derivatives, gather
from ocp.errors import ProblemError
from ocp.problem.formulation import Formulation
from ocp.storage import write_text

VERSION = "1"  # of the generated code
FLAGS = ("-fPIC", "-shared", "-w", "-ffp-contract=off", *(("-Wl,-z,defs",) if sys.platform == "linux" else ()))
"""Flags of the C compiler; undefined symbols are errors at link time, because otherwise a call would crash Python."""
LINK = "-lm"  # must follow the source file
SERIALISED = "casadi:"  # prefix of a serialised function
WATCHED = """
exec 3<&0
(trap "" TERM; read -r _ <&3; kill 0; rm -rf "$PWD"; kill -9 0) &
exec "$@" </dev/null 3<&-
"""
"""Shell script that runs a command until the standard input of the script closes, as when Python dies. The script then
kills the command and removes the working folder."""


class CompilerError(RuntimeError):
    """Error raised when C code cannot be generated, compiled or loaded; its message states the reason."""


@dataclass(frozen=True)
class CodeSizes:
    """Largest lengths, in characters, at which generated C code is optimised, and at which it is compiled at all.

    Attributes:
        optimized: Largest code that is optimised, which takes minutes for more and saves a third of the running time.
        accepted: Largest code that is compiled: gcc takes 130 bytes of memory for each character.
    """

    optimized: int = 300_000
    accepted: int = 8_000_000


CODE_SIZES = CodeSizes()


def generate_c(functions: Sequence[Any], name: str, *, header: bool = True) -> list[str]:
    """Return the C code and the C header (NAME.c and NAME.h) of casadi Functions as texts.

    Raises:
        CompilerError: One of them has no C code.
    """
    files = [f"{name}.c", f"{name}.h"] if header else [f"{name}.c"]
    try:
        with tempfile.TemporaryDirectory() as place, casadi_silenced():
            generator = ca.CodeGenerator(files[0], {"with_header": header})
            for function in functions:
                generator.add(function)
            generator.generate(f"{place}/")
            texts = [(Path(place) / file).read_text(encoding="utf-8") for file in files]
    except RuntimeError as error:
        raise CompilerError(str(error).strip().splitlines()[-1]) from error
    if gap := re.search(r"^ *#error (.*)", texts[0], re.MULTILINE):
        raise CompilerError(gap[1])
    # for an empty map CasADi adds to a null pointer, which is an error for gcc from version 14 on
    return [text.replace("0+ i*0", "0") for text in texts]


def build_library(contents: Sequence[str], text: Callable[[], str]) -> Path:
    """Compile C code to a shared library, unless the library is in the cache, and return the path of the library.

    Ctrl-C and time limits end the compiler.

    Args:
        contents: The data that determine the C code, such as serialised functions.
        text: Function that generates the C code; not called if the library is in the cache.

    Raises:
        CompilerError: There is no compiler, or it rejects the code.
        TimeLimitReached: The time limit is reached.
    """
    key = library_key(contents)
    path = _OWN.get(key) or cache.load_library(key)
    if path is not None:
        return path
    with cache.exclusive(key, check_time):
        path = _OWN.get(key) or cache.load_library(key)  # another process may have compiled it meanwhile
        if path is not None:
            return path
        content = _compile(text())
        path = cache.store_library(key, content)
    if path is None:  # for this process only
        path = Path(_own_folder().name) / f"{key}.so"
        path.write_bytes(content)
        _OWN[key] = path
    return path


def library_key(contents: Sequence[str]) -> str:
    """Return the name in the cache of a library with given contents; raise CompilerError if there is no compiler."""
    machine = (platform.machine(), sys.platform, ca.__version__, str(CODE_SIZES.optimized))
    return cache.cache_key(VERSION, *machine, *compiler(), *FLAGS, LINK, *contents)


_OWN: dict[str, Path] = {}
"""Paths of libraries that are compiled for this process alone because the cache is not writable, by library key."""


@lru_cache(1)
def _own_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="selfmotion-")


def compiler() -> tuple[str, str]:
    """Return the command that calls the C compiler, and its version text.

    Raises:
        CompilerError: There is none.
    """
    command = os.environ.get("CC") or "cc"
    version = _version(command, os.environ.get("PATH", ""))
    if not version:
        raise CompilerError(f"there is no C compiler {command!r}")
    return command, version


@lru_cache
def _version(command: str, path: str) -> str:
    """Return the version text that a compiler command on a search path prints; "" if the command cannot be run."""
    try:
        words = [*shlex.split(command), "--version"]
        result = subprocess.run(words, capture_output=True, stdin=subprocess.DEVNULL, timeout=10, check=True)
        return result.stdout.decode(errors="replace").strip()
    except (OSError, ValueError, IndexError, subprocess.SubprocessError):
        return ""


def _compile(text: str) -> bytes:
    """Compile C code and return the contents of the shared library; raise the same errors as `build_library`."""
    if len(text) > CODE_SIZES.accepted:
        raise CompilerError(f"{len(text)} characters of C are more than {CODE_SIZES.accepted}")
    speed = "-O1" if len(text) <= CODE_SIZES.optimized else "-O0"
    place = Path(tempfile.mkdtemp(prefix="selfmotion-"))
    process = None
    try:
        (place / "unit.c").write_text(text, encoding="utf-8")
        words = [*shlex.split(compiler()[0]), speed, *FLAGS, "unit.c", "-o", "unit.so", LINK]
        process = _start_process(words, place)
        if _exit_status(process):
            output = (place / "words").read_text(errors="replace").strip().splitlines()
            raise CompilerError(f"{words[0]} fails: {output[-1] if output else 'without a message'}")
        return (place / "unit.so").read_bytes()
    except OSError as error:  # no space, or no process
        raise CompilerError(f"the compiler cannot run: {error}") from error
    finally:
        if process is not None and process.stdin is not None:
            process.stdin.close()
            process.wait()
        shutil.rmtree(place, ignore_errors=True)


def _start_process(words: list[str], place: Path) -> subprocess.Popen[bytes]:
    """Start a command that writes its output to a file in its working folder and ends when its input is closed."""
    with open(place / "words", "wb") as output:
        return subprocess.Popen(
            ["sh", "-c", WATCHED, "sh", *words],
            cwd=place,
            env={**os.environ, "TMPDIR": str(place)},
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )


def _exit_status(process: subprocess.Popen[bytes]) -> int:
    """Wait for a process, checking the time limit every 50 ms, and return its exit status."""
    while True:
        check_time()
        with suppress(subprocess.TimeoutExpired):
            return process.wait(0.05)


def function_key(function: Any) -> str:
    """Return a text that identifies a casadi Function: its serialised form or, failing that, its id in this process."""
    try:
        return SERIALISED + str(function.serialize())
    except RuntimeError:  # of a Callback, say
        return str(id(function))


@lru_cache
def warn_interpreted(reason: str) -> None:
    """Log once the reason why casadi Functions are interpreted instead of compiled."""
    LOG.warning("functions are interpreted, which is slower: %s", reason)


def problem_functions(form: Formulation, transcription: Transcription, guess: np.ndarray) -> list[Any]:
    """Return the casadi Functions of a problem that are exported to C, in the units of the problem.

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


def write_problem(form: Formulation, transcription: Transcription, guess: np.ndarray, folder: Path) -> Path:
    """Write the C files of a problem to a folder, and return the folder; errors are those of `write_c`."""
    texts = {"curves.h": CURVES, "problem.h": problem_header(form, transcription), "main.c": MAIN, "Makefile": MAKEFILE}
    return write_c(form, problem_functions(form, transcription, guess), "plan", folder=folder, texts=texts)


def write_c(form: Formulation, functions: list[Any], name: str, *, folder: Path, texts: dict[str, str]) -> Path:
    """Write functions of a problem to a folder as NAME.c and NAME.h, with further files, and return the folder.

    Each file is written completely or not at all; files of the same names are replaced.

    Args:
        texts: Contents of the further files by name.

    Raises:
        ProblemError: A part of the problem cannot be written as C code, such as an integrator of variable step.
        OSError: The folder cannot be written.
    """
    try:
        code, header = generate_c(functions, name)
    except CompilerError as error:
        raise ProblemError(f"problem {form.name!r} has no C: {error}", name="method", value=form.name) from error
    folder.mkdir(parents=True, exist_ok=True)
    for file, text in ({f"{name}.c": code, f"{name}.h": header} | texts).items():
        write_text(folder / file, text)
    return folder


def problem_header(form: Formulation, transcription: Transcription) -> str:
    """Return the text of the C header problem.h: sizes, names, and the breaks and nodes of the interpolants."""
    curves = transcription.interpolants
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
    lines = [f"/* {c_string(form.name).replace('*/', '* /')} */"]
    lines += [f"#define PLAN_{name} {size}" for name, size in sizes.items()]
    tables = {"breaks": curves.breaks, "nodes": curves.nodes, "mesh": curves.mesh, "samples": curves.control_nodes}
    for name, values in tables.items():
        lines.append(f"static const double plan_{name}[] = {{{', '.join(f'{value:.17g}' for value in values)}}};")
    lines.append(c_strings("plan_parameters", form.parameter_labels))
    lines.append(c_strings("plan_columns", [*form.state_labels, *form.control_labels]))
    return "\n".join([*lines, ""])


def c_strings(name: str, texts: Sequence[str]) -> str:
    """Return the C definition of a null-terminated array of strings."""
    return f"static const char *const {name}[] = {{{', '.join([*map(c_string, texts), '0'])}}};"


def c_string(text: str) -> str:
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
"""Hash of the source code that derives the functions of blocks, which is part of the key of a compiled library."""


def block_derivatives(transcription: Transcription, compiled: bool) -> list[Derivatives]:
    """Return the derivatives of each block of a transcription; blocks with the same function share derivatives.

    Args:
        transcription: The transcription.
        compiled: Whether to compile. Functions that cannot be compiled are interpreted, with one warning.

    Raises:
        TimeLimitReached: The time limit is over.
    """
    texts = [function_key(block.function) for block in transcription.blocks]
    by_text: dict[str, Derivatives] = {}
    for text, block in zip(texts, transcription.blocks, strict=True):
        if text not in by_text:
            is_short = block.function.is_a("SXFunction") and block.function.n_instructions() <= SIZES.called
            is_compiled = compiled and text.startswith(SERIALISED) and not is_short
            build = partial(derivatives, block.function)
            functions = compile_functions((RECIPE, text), Derivatives._fields, build) if is_compiled else build()
            by_text[text] = Derivatives(*functions)
    return [by_text[text] for text in texts]


def compile_functions(contents: Sequence[str], names: Sequence[str], build: Callable[[], Sequence[Any]]) -> list[Any]:
    """Return compiled casadi Functions or, with a warning, interpreted Functions if they cannot be compiled.

    Args:
        contents: As of :func:`build_library`.
        names, build: Names of the functions, and what returns them; not called if the library is in the cache.
    """
    try:
        path = build_library(contents, lambda: generate_c(build(), "unit", header=False)[0])
        return [ca.external(name, str(path)) for name in names]
    except (CompilerError, RuntimeError) as error:
        warn_interpreted(str(error))
        return list(build())
