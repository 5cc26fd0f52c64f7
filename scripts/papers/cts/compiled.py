"""The rig's inverse kinematics through the machine's C compiler: joints and time of one target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from models.arrays import Array
from scripts.timing.compiled import FLAGS, compiled, least, pointers

__all__ = ["Compiled", "compiled_inverse"]

DRIVER = """
#include "kernel.h"
int run(const double* targets, const double* previous, double* out, int count) {{
  static long long iw[{name}_SZ_IW + 1];
  static double w[{name}_SZ_W + 1];
  const double* arg[{name}_SZ_ARG];
  double* res[{name}_SZ_RES];
  int i;
  for (i = 0; i < count; ++i) {{
    arg[0] = targets + 5 * i; arg[1] = previous + i;
    res[0] = out + 9 * i; res[1] = out + 9 * i + 6; res[2] = out + 9 * i + 7; res[3] = out + 9 * i + 8;
    if ({name}(arg, res, iw, w, 0)) return 1;
  }}
  return 0;
}}
"""


@dataclass(frozen=True)
class Compiled:
    """What a compiled function gives and how long it takes.

    Attributes:
        result: Joints, index, code of the active constraint, code of the status. Shape (samples, 9).
        nanoseconds: A target, the mean over all targets in one loop, the least of several runs.
        worst: The same of the slowest target alone, run again and again.
    """

    result: Array
    nanoseconds: float
    worst: float


def compiled_inverse(
    function: Any, targets: Array, previous: Array, repeats: int = 5, flags: tuple[str, ...] = FLAGS
) -> Compiled:
    """Compile an optimal_inverse function and run it over targets, shape (samples, 5), again and again."""
    rows = np.ascontiguousarray(targets, dtype=float)
    before = np.ascontiguousarray(np.broadcast_to(previous, len(rows)), dtype=float)
    out = np.empty((len(rows), 9))
    with compiled(function, DRIVER, flags) as run:

        def nanoseconds(rows: Array, before: Array, out: Array, loops: int, runs: int) -> float:
            places = pointers(rows, before, out)

            def work() -> None:
                for _ in range(loops):
                    run(*places, len(rows))

            return 1e9 * least(work, runs) / (loops * len(rows))

        # short runs: one of many is undisturbed
        mean = nanoseconds(rows, before, out, max(1, 2000 // len(rows)), 10 * repeats)
        result = out.copy()
        # calls from Python, only to find the slowest
        alone = [nanoseconds(rows[k : k + 1], before[k : k + 1], out, 1, 20) for k in range(len(rows))]
        slowest = int(np.argmax(alone))
        many, roll = np.repeat(rows[slowest : slowest + 1], 100, axis=0), np.repeat(before[slowest : slowest + 1], 100)
        worst = nanoseconds(many, roll, np.empty((100, 9)), 20, 10 * repeats)
    return Compiled(result, mean, worst)
