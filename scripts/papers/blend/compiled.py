"""The mappings of the blend paper through the machine's C compiler: parameters and time of one control sample."""

from __future__ import annotations

from typing import Any

import numpy as np

from models.arrays import Array
from scripts.timing.compiled import compiled, least, pointers

__all__ = ["march_compiled", "place_compiled"]

RUNS = 20
"""For each repeat."""
MARCH = """
#include "kernel.h"
int run(const double* coefficients, const double* steps, double* out, int count) {{
  static long long iw[{name}_SZ_IW + 1];
  static double w[{name}_SZ_W + 1];
  const double* arg[{name}_SZ_ARG];
  double* res[{name}_SZ_RES];
  double state[2] = {{0, 0}}, next[2];
  int i;
  for (i = 0; i < count; ++i) {{
    arg[0] = state; arg[1] = coefficients; arg[2] = steps + 2 * i;
    res[0] = next;
    if ({name}(arg, res, iw, w, 0)) return 1;
    state[0] = next[0]; state[1] = next[1]; out[i] = next[1];
  }}
  return 0;
}}
"""
PLACE = """
#include "kernel.h"
int run(const double* unused, const double* distances, double* out, int count) {{
  static long long iw[{name}_SZ_IW + 1];
  static double w[{name}_SZ_W + 1];
  const double* arg[{name}_SZ_ARG];
  double* res[{name}_SZ_RES];
  int i;
  for (i = 0; i < count; ++i) {{
    arg[0] = distances + i;
    res[0] = out + 12 * i; res[1] = res[0] + 3; res[2] = res[0] + 6; res[3] = res[0] + 9;
    if ({name}(arg, res, iw, w, 0)) return 1;
  }}
  return 0;
}}
"""


def march_compiled(mapping: Any, coefficients: Array, distances: Array, repeats: int = 5) -> tuple[Array, float]:
    """What models.paths.march does, each sample from the one before, in one loop of C.

    Args:
        mapping: Of predictor_corrector or gauss_newton.
        coefficients: Of one blend. Shape (6, 3).
        distances: From its start, increasing. Shape (M,), m.

    Returns:
        Parameters, shape (M,), and the least time of several runs, ns a sample.
    """
    given = np.diff(distances, prepend=0.0)
    steps = np.stack([np.concatenate([[0.0], given[:-1]]), given], axis=1)
    out = np.empty(len(distances))
    entries = np.ascontiguousarray(coefficients.ravel()[: mapping.numel_in(1)])
    return out, _timed(mapping, MARCH, entries, steps, out, repeats)


def place_compiled(function: Any, distances: Array, repeats: int = 5) -> tuple[Array, float]:
    """A `models.paths.path_function` at distances in any order. Shape (M,) to (M, 12), and ns a sample."""
    out = np.empty((len(distances), 12))
    return out, _timed(function, PLACE, np.zeros(1), np.ascontiguousarray(distances), out, repeats)


def _timed(function: Any, driver: str, first: Array, second: Array, out: Array, repeats: int) -> float:
    # many short runs: the least of them is one that nothing else disturbed
    loops = max(1, 10_000 // len(out))
    places = pointers(first, second, out)
    with compiled(function, driver) as run:

        def work() -> None:
            for _ in range(loops):
                if run(*places, len(out)):
                    raise RuntimeError(f"{function.name()}: the compiled function failed")

        return 1e9 * least(work, RUNS * repeats) / (loops * len(out))
