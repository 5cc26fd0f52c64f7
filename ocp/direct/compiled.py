"""The blocks of a program, compiled: in the background, once solves have taken longer than compiling is expected to.

Libraries are those of :mod:`ocp.libraries`, kept between runs; compiled blocks return the very numbers that interpreted
ones do.
"""

from __future__ import annotations

import hashlib
import threading
import time
import weakref
from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca

from models import cache
from ocp.direct import assembly
from ocp.direct.assembly import Derivatives, derivatives
from ocp.direct.fragment import Fragment
from ocp.libraries import SERIALISED, CompilerError, Library, build, built, code, kept, notice, serialised

__all__ = ["Background", "Blocks", "stop_compiling"]

FEW = 10  # instructions of a block, which take as long to call as to do
RECIPE = hashlib.sha256(Path(assembly.__file__).read_bytes()).hexdigest()
"""What tells how derivatives are made of a block: the text that does it."""
NICE = 10  # of the compiler in the background
SECONDS_A_LIBRARY, SECONDS_AN_INSTRUCTION = 0.2, 1.5e-4  # of what the compiler may take, with gcc 12 at -O1


# ---- in the background -------------------------------------------------------------------------------------------


class Background(threading.Thread):
    """Libraries that are compiled one after the other while something else is done, by this process or another.

    It is done in the thread that makes it as far as CasADi does it. The process may end meanwhile, and what was being
    compiled ends with it.

    Attributes:
        found: Where each library is, None as long as it is not there, else why it will not be.
    """

    def __init__(self, libraries: Sequence[Library]) -> None:
        super().__init__(name="compiler", daemon=True)
        self.found: list[Path | CompilerError | None] = [None] * len(libraries)
        self.stopped = False
        self._work: list[tuple[int, str, str, Library]] = []
        for i, library in enumerate(libraries):
            try:
                self._work.append((i, library.key, library.text(), library))
            except CompilerError as error:
                self.found[i] = error
        _UNDER_WAY.add(self)
        self.start()

    def run(self) -> None:
        with suppress(Stopped), cache.alone("compiler", self._ask):  # one at a time on a machine
            for i, key, text, library in self._work:
                try:
                    self.found[i] = build(key, text, library, self._ask, NICE)
                except CompilerError as error:
                    self.found[i] = error

    def _ask(self) -> None:
        if self.stopped:
            raise Stopped


class Stopped(Exception):
    """What is done in the background is to end."""


_UNDER_WAY: weakref.WeakSet[Background] = weakref.WeakSet()


def stop_compiling() -> None:
    """End what is compiled in the background, as after Ctrl-C."""
    for work in list(_UNDER_WAY):
        work.stopped = True


# ---- blocks ------------------------------------------------------------------------------------------------------


class Blocks:
    """The derivatives of the blocks of a fragment: compiled where they are at hand, interpreted where they are not.

    Args:
        fragment: Whose blocks.
        compiled: True to compile now what is not kept; False to interpret all; ``auto`` to compile it in the background
            as soon as solves have taken longer than compiling is expected to.

    Attributes:
        seconds: Of all solves so far.

    Raises:
        OutOfTime: The time limit is over.
    """

    def __init__(self, fragment: Fragment, compiled: bool | str) -> None:
        self.seconds = 0.0
        self._is_auto = compiled == "auto"
        self._background: Background | None = None
        units: dict[str, _Unit] = {}
        self._units = []
        for block in fragment.blocks:
            text = serialised(block.function)
            self._units.append(units.setdefault(text, _Unit(block.function, text)))
        self._open = [unit for unit in units.values() if compiled is not False and unit.is_worth_it]
        for unit in list(self._open):
            try:
                self._take(unit, kept(unit.library) if self._is_auto else built(unit.library))
            except CompilerError as error:
                self._give_up(unit, error)

    @property
    def functions(self) -> list[Derivatives]:
        """Of each block."""
        return [unit.functions for unit in self._units]

    def worked(self, seconds: float) -> None:
        """A solve took so long."""
        self.seconds += seconds
        self._begin_if(self.seconds)

    def working(self, began: float) -> None:
        """A solve is under way that began at a reading of the monotonic clock, s."""
        self._begin_if(self.seconds + time.monotonic() - began)

    def renewed(self) -> bool:
        """Whether some of the functions are compiled now that were not before."""
        if self._background is None or self._background.is_alive():
            return False
        before = len(self._open)
        for unit, found in zip(list(self._open), self._background.found, strict=True):
            try:
                if isinstance(found, CompilerError):
                    raise found
                self._take(unit, found)
            except CompilerError as error:
                self._give_up(unit, error)
        self._background = None
        return any(unit.compiled for unit in self._units) and len(self._open) < before

    def _begin_if(self, seconds: float) -> None:
        if not self._is_auto or self._background is not None or not self._open:
            return
        if seconds > sum(unit.seconds for unit in self._open):
            self._background = Background([unit.library for unit in self._open])

    def _take(self, unit: _Unit, path: Path | None) -> None:
        if path is not None:
            unit.load(path)
            self._open.remove(unit)

    def _give_up(self, unit: _Unit, error: CompilerError) -> None:
        self._open.remove(unit)
        notice(str(error))


class _Unit:
    """A block's function with its derivatives, and the library that may hold them."""

    def __init__(self, function: Any, text: str) -> None:
        self.function, self.text = function, text
        self.compiled: Derivatives | None = None

    @cached_property
    def interpreted(self) -> Derivatives:
        return derivatives(self.function)

    @property
    def functions(self) -> Derivatives:
        return self.compiled or self.interpreted

    @property
    def library(self) -> Library:
        contents = (RECIPE, self.text)
        return Library(contents, lambda: code(self.interpreted))

    @property
    def is_worth_it(self) -> bool:
        """Whether it has a text, so that it can be known again, and does more than it takes to call it."""
        flat = self.function.is_a("SXFunction")
        return self.text.startswith(SERIALISED) and not (flat and self.function.n_instructions() <= FEW)

    @property
    def seconds(self) -> float:
        """What its compilation is expected to take."""
        count = sum(int(function.n_instructions()) for function in self.interpreted)
        return SECONDS_A_LIBRARY + SECONDS_AN_INSTRUCTION * count

    def load(self, path: Path) -> None:
        """Take the functions from a library.

        Raises:
            CompilerError: They cannot be loaded.
        """
        try:
            self.compiled = Derivatives(*(ca.external(name, str(path)) for name in Derivatives._fields))
        except RuntimeError as error:
            raise CompilerError(f"a compiled function cannot be loaded: {error}") from error
