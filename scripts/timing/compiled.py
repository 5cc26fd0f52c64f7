"""Functions through the machine's C compiler, and the least time of many runs."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from models.arrays import Array
from models.cts.export import export

__all__ = ["FLAGS", "compiled", "has_compiler", "least", "pointers"]

FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fno-semantic-interposition", "-std=gnu89")
"""None of them lets the compiler assume numbers finite or reorder sums (no -ffast-math): nan must stay nan. The last
two let it put the generated helpers inline: in C89 casadi writes minimum and maximum as comparisons, not as calls."""


def has_compiler() -> bool:
    """Whether there is a C compiler named cc."""
    return shutil.which("cc") is not None


@contextmanager
def compiled(function: Any, driver: str, flags: tuple[str, ...] = FLAGS) -> Iterator[Callable[..., int]]:
    """The C function `run` of a driver that loops over calls of a casadi Function; gone when the block ends.

    Args:
        function: Written to kernel.c and kernel.h, which the driver includes.
        driver: C text, a format of {name}, the function's name.
        flags: Of the compiler.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        export([function], folder / "kernel.c")
        (folder / "driver.c").write_text(driver.format(name=function.name()), encoding="utf-8")
        library = folder / "kernel.so"
        sources = [str(folder / "kernel.c"), str(folder / "driver.c")]
        subprocess.run(["cc", *flags, "-fPIC", "-shared", *sources, "-o", str(library), "-lm"], check=True)
        yield ctypes.CDLL(str(library)).run


def pointers(*arrays: Array) -> list[Any]:
    """To the first entries of contiguous arrays, which have to be kept alive."""
    return [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]


def least(work: Callable[[], Any], repeats: int) -> float:
    """Least wall time of a number of runs, s."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)
