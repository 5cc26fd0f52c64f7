"""Keep CasADi from printing the inputs of a function that breaks down where that is expected and caught."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr

__all__ = ["quiet"]


@contextmanager
def quiet() -> Iterator[None]:
    """Swallow what CasADi writes to ``sys.stderr``; no option of its functions does."""
    with redirect_stderr(io.StringIO()):
        yield
