"""How long work takes: the least or the median time of many runs, and of functions through the C compiler."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from models.checks import Array
from models.cts.table import export

FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fno-semantic-interposition", "-std=gnu89")
"""None of them lets the compiler assume numbers finite or reorder sums (no -ffast-math): nan must stay nan. The last
two let it put the generated helpers inline: in C89 casadi writes minimum and maximum as comparisons, not as calls."""

Rows: TypeAlias = Callable[[Sequence[Array], int, int], tuple[Array, float]]
"""(inputs, loops, runs) -> outputs side by side at every row of the inputs, shape (M, n), and the time of one row, s:
the least of `runs` runs of so many loops over all rows. An input of one row is the same for all."""

DRIVER = """
#include "kernel.h"
int run(const double** in, const int* widths, double* out, int count, int loops) {{
  static long long iw[{name}_SZ_IW + 1];
  static double w[{name}_SZ_W + 1];
  static const double zeros[{width} + 1];
  const double* arg[{name}_SZ_ARG + 1];
  double* res[{name}_SZ_RES + 1];
  int i, k;
  for (k = 0; k < loops; ++k)
    for (i = 0; i < count; ++i) {{
      {places}
      if ({name}(arg, res, iw, w, 0)) return 1;
    }}
  return 0;
}}
"""


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """Result and wall time, s."""
    began = time.perf_counter()
    result = work()
    return result, time.perf_counter() - began


def least(work: Callable[[], Any], repeats: int) -> float:
    """Least wall time of a number of runs, s."""
    return min(timed(work)[1] for _ in range(repeats))


def least_of_processor(work: Callable[[], Any], repeats: int) -> float:
    """Least time of the processor of a number of runs, s."""
    times = []
    for _ in range(max(1, repeats)):
        began = time.process_time()
        work()
        times.append(time.process_time() - began)
    return min(times)


def median(work: Callable[[], Any], repeats: int) -> float:
    """Median wall time of a number of runs, s."""
    return float(np.median([timed(work)[1] for _ in range(repeats)]))


def against(figures: Mapping[str, Mapping[str, Any]], goal: str) -> str:
    """Lines of each figure, "-" where there is none, and what it is for, the entry named `goal`."""
    return "\n".join(
        f"{name}: {one['figure']:.4g}, {goal} {one[goal]:g}" if one["figure"] else f"{name}: -"
        for name, one in figures.items()
    )


def has_compiler() -> bool:
    """Whether there is a C compiler named cc."""
    return shutil.which("cc") is not None


@contextmanager
def compiled(function: Any, flags: Sequence[str] = FLAGS, *, marching: bool = False) -> Iterator[Rows]:
    """A casadi Function through the machine's C compiler, called from a loop in C; gone when the block ends.

    Args:
        function: With vectors as inputs and outputs.
        flags: Of the compiler.
        marching: The first input of a row is the first output of the row before, zero in the first; whatever is given
            for it is not used.
    """
    starts = np.cumsum([0, *(function.nnz_out(k) for k in range(function.n_out()))])
    width = starts[-1]
    places = [f"arg[{k}] = in[{k}] + widths[{k}] * i;" for k in range(function.n_in())]
    places += [f"res[{k}] = out + {width} * i + {start};" for k, start in enumerate(starts[:-1])]
    if marching:
        places[0] = f"arg[0] = i ? out + {width} * (i - 1) : zeros;"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        export([function], folder / "kernel.c")
        driver = DRIVER.format(name=function.name(), width=width, places="\n      ".join(places))
        (folder / "driver.c").write_text(driver, encoding="utf-8")
        library = folder / "kernel.so"
        sources = [str(folder / "kernel.c"), str(folder / "driver.c")]
        subprocess.run(["cc", *flags, "-fPIC", "-shared", *sources, "-o", str(library), "-lm"], check=True)
        run = ctypes.CDLL(str(library)).run

        def rows(inputs: Sequence[Array], loops: int, runs: int) -> tuple[Array, float]:
            options = [np.ascontiguousarray(np.atleast_2d(each), dtype=float) for each in inputs]
            count = max(len(each) for each in options)
            out = np.empty((count, width))
            widths = (ctypes.c_int * len(options))(*(each.shape[1] if len(each) > 1 else 0 for each in options))
            pointers = (ctypes.c_void_p * len(options))(*(each.ctypes.data for each in options))
            place = out.ctypes.data_as(ctypes.c_void_p)

            def work() -> None:
                if run(pointers, widths, place, count, loops):
                    raise RuntimeError(f"{function.name()}: the compiled function failed")

            return out, least(work, runs) / (loops * count)

        yield rows
