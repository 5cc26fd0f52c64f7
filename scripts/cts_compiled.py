"""The rig's inverse kinematics through the machine's C compiler: joints and time of one target."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from models.cts_export import export
from models.parts import Array

__all__ = ["FLAGS", "Compiled", "compiled", "has_compiler"]

FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fno-semantic-interposition", "-std=gnu89")
"""None of them lets the compiler assume numbers finite or reorder sums (no -ffast-math): nan must stay nan. The last
two let it put the generated helpers inline: in C89 casadi writes minimum and maximum as comparisons, not as calls."""

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


def has_compiler() -> bool:
    """Whether there is a C compiler named cc."""
    return shutil.which("cc") is not None


def compiled(
    function: Any, targets: Array, previous: Array, repeats: int = 5, flags: tuple[str, ...] = FLAGS
) -> Compiled:
    """Compile an optimal_inverse function and run it over targets, shape (samples, 5), again and again."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        export([function], folder / "kernel.c")
        (folder / "driver.c").write_text(DRIVER.format(name=function.name()), encoding="utf-8")
        library = folder / "kernel.so"
        sources = [str(folder / "kernel.c"), str(folder / "driver.c")]
        subprocess.run(["cc", *flags, "-fPIC", "-shared", *sources, "-o", str(library), "-lm"], check=True)
        run = ctypes.CDLL(str(library)).run
        rows = np.ascontiguousarray(targets, dtype=float)
        before = np.ascontiguousarray(np.broadcast_to(previous, len(rows)), dtype=float)
        out = np.empty((len(rows), 9))

        def least(first: int, count: int, loops: int, times: int) -> float:
            pointers = [array[first:].ctypes.data_as(ctypes.c_void_p) for array in (rows, before, out)]
            spans = []
            for _ in range(times):
                began = time.perf_counter()
                for _ in range(loops):
                    run(*pointers, count)
                spans.append(time.perf_counter() - began)
            return 1e9 * min(spans) / (loops * count)

        mean = least(0, len(rows), max(1, 2000 // len(rows)), 10 * repeats)  # short runs: one is undisturbed
        run_again = [least(k, 1, 1, 20) for k in range(len(rows))]  # calls from Python: only to find the slowest
        slowest = int(np.argmax(run_again))
        many = np.repeat(rows[slowest : slowest + 1], 100, axis=0)
        rows, before, out_mean = many, np.repeat(before[slowest : slowest + 1], 100), out
        out = np.empty((100, 9))
        worst = least(0, 100, 20, 10 * repeats)
    return Compiled(out_mean, mean, worst)
