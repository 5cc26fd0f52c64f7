"""C code compiled by the machine's compiler, once: libraries kept between runs, and the blocks of a program in them.

A library is known by what it is made of, by the compiler and by its flags, so meshes, processes and runs share it (see
`models.cache`). Compiled functions return the very numbers that interpreted ones do: the same operations in the same
order, none of them fused. The compiler is that of the environment's CC, else `cc`; without one, functions are
interpreted.
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
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import casadi as ca

from models import cache
from ocp.console import LOG, check_time, quiet
from ocp.direct import assembly
from ocp.direct.assembly import Derivatives, derivatives
from ocp.direct.fragment import Fragment

__all__ = ["Background", "Blocks", "CompilerError", "Library", "built", "code", "generated", "kept", "stop_compiling"]

VERSION = "1"  # of what is made of contents
FLAGS = ("-fPIC", "-shared", "-w", "-ffp-contract=off", *(("-Wl,-z,defs",) if sys.platform == "linux" else ()))
"""What is not defined is an error here, where it is the end of Python when it is called."""
LARGE = 300_000
"""Characters of C: more take minutes with optimization, and without it half as long again to run."""
MOST = 8_000_000
"""Characters of C: gcc takes 130 bytes of memory for each."""
FEW = 10  # instructions of a block, which take as long to call as to do
RECIPE = hashlib.sha256(Path(assembly.__file__).read_bytes()).hexdigest()
"""What tells how derivatives are made of a block: the text that does it."""
SERIALISED = "casadi:"  # before the text of a function
NICE = 10  # of the compiler in the background
SECONDS_A_LIBRARY, SECONDS_AN_INSTRUCTION = 0.2, 1.5e-4  # of what the compiler may take, with gcc 12 at -O1
WATCHED = """
exec 3<&0
(trap "" TERM; read -r _ <&3; kill 0; rm -rf "$PWD"; kill -9 0) &
exec "$@" </dev/null 3<&-
"""
"""Shell words that run a command; when their input ends, as where Python is killed, they end it, its folder too."""


class CompilerError(RuntimeError):
    """C code that cannot be made, compiled or loaded, and why."""


# ---- libraries ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Library:
    """A shared library.

    Attributes:
        contents: All that its C follows from, such as serialised functions. text: Makes the C; not called where the
            library is kept.
        include: Folders of headers. link: What the compiler is told behind the C, such as ``-lm``.
    """

    contents: tuple[str, ...]
    text: Callable[[], str]
    include: tuple[str, ...] = ()
    link: tuple[str, ...] = ("-lm",)

    @property
    def key(self) -> str:
        """Its name in the cache.

        Raises:
            CompilerError: There is no compiler.
        """
        machine = (platform.machine(), sys.platform, ca.__version__, str(LARGE))
        return cache.key_of(VERSION, *machine, *compiler(), *FLAGS, *self.include, *self.link, *self.contents)


def code(functions: Iterable[Any], source: str = "") -> str:
    """C of casadi Functions, each by its name, with a source behind it.

    Raises:
        CompilerError: One of them has no C.
    """
    return f"{generated(functions, 'unit', header=False)[0]}\n{source}"


def generated(functions: Iterable[Any], name: str, *, header: bool = True) -> list[str]:
    """The texts NAME.c and NAME.h of casadi Functions.

    Raises:
        CompilerError: One of them has no C.
    """
    files = [f"{name}.c", f"{name}.h"] if header else [f"{name}.c"]
    try:
        with tempfile.TemporaryDirectory() as place, quiet():
            generator = ca.CodeGenerator(files[0], {"with_header": header})
            for function in functions:
                generator.add(function)
            generator.generate(f"{place}/")
            texts = [(Path(place) / file).read_text(encoding="utf-8") for file in files]
    except RuntimeError as error:
        raise CompilerError(str(error).strip().splitlines()[-1]) from error
    if gap := re.search(r"^ *#error (.*)", texts[0], re.MULTILINE):
        raise CompilerError(gap[1])
    # where nothing is mapped CasADi adds to a null pointer, which gcc takes for an error from version 14 on
    return [text.replace("0+ i*0", "0") for text in texts]


def kept(library: Library) -> Path | None:
    """Where a library is kept; None where it is not, or there is no compiler that it could be of."""
    try:
        key = library.key
    except CompilerError:
        return None
    return _OWN.get(key) or cache.kept_library(key)


def built(library: Library) -> Path:
    """A library, compiled where it is not kept. It is waited for; Ctrl-C and time limits end that.

    Raises:
        CompilerError: There is no compiler, or it takes the C for wrong.
        OutOfTime: The time limit is over.
    """
    return kept(library) or _built(library.key, library.text(), library, check_time)


def _built(key: str, text: str, library: Library, ask: Callable[[], None], nice: int = 0) -> Path:
    with cache.alone(key, ask):
        found = _OWN.get(key) or cache.kept_library(key)  # another process may have made it meanwhile
        if found is not None:
            return found
        content = _compiled(text, library, ask, nice)
        found = cache.keep_library(key, content)
    if found is None:  # for this process only
        found = Path(_own_folder().name) / f"{key}.so"
        found.write_bytes(content)
        _OWN[key] = found
    return found


_OWN: dict[str, Path] = {}
"""Libraries of this process, where nothing can be kept."""


@lru_cache(1)
def _own_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="selfmotion-")


# ---- the compiler ------------------------------------------------------------------------------------------------


def compiler() -> tuple[str, str]:
    """The compiler's command, and what it says of its version.

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
    """What a compiler on the path says of its version; "" where it says nothing."""
    try:
        words = [*shlex.split(command), "--version"]
        told = subprocess.run(words, capture_output=True, stdin=subprocess.DEVNULL, timeout=10, check=True)
        return told.stdout.decode(errors="replace").strip()
    except (OSError, ValueError, IndexError, subprocess.SubprocessError):
        return ""


def _compiled(text: str, library: Library, ask: Callable[[], Any], nice: int) -> bytes:
    """What the compiler makes of C. ``ask`` is called every 50 ms, to raise where it is to end.

    Raises:
        CompilerError: It fails.
    """
    if len(text) > MOST:
        raise CompilerError(f"{len(text)} characters of C are more than {MOST}")
    speed = "-O1" if len(text) <= LARGE else "-O0"
    place = Path(tempfile.mkdtemp(prefix="selfmotion-"))
    process = None
    try:
        (place / "unit.c").write_text(text, encoding="utf-8")
        include = [f"-I{folder}" for folder in library.include]
        words = [*shlex.split(compiler()[0]), speed, *FLAGS, *include, "unit.c", "-o", "unit.so", *library.link]
        process = begun(words, place, nice)
        if wait(process, ask):
            told = (place / "words").read_text(errors="replace").strip().splitlines()
            raise CompilerError(f"{words[0]} fails: {told[-1] if told else 'it does not say why'}")
        return (place / "unit.so").read_bytes()
    except OSError as error:  # no room, or no process
        raise CompilerError(f"nothing can be compiled: {error}") from error
    finally:
        if process is not None and process.stdin is not None:
            process.stdin.close()
            process.wait()
        shutil.rmtree(place, ignore_errors=True)


def begun(words: list[str], place: Path, nice: int) -> subprocess.Popen[bytes]:
    """A command that runs in a folder, where what it says is kept too, until its input is closed."""
    with open(place / "words", "wb") as told:
        process = subprocess.Popen(
            ["sh", "-c", WATCHED, "sh", *words],
            cwd=place,
            env={**os.environ, "TMPDIR": str(place)},
            stdin=subprocess.PIPE,
            stdout=told,
            stderr=told,
            start_new_session=True,
        )
    with suppress(OSError):
        os.setpriority(os.PRIO_PGRP, process.pid, nice)
    return process


def wait(process: subprocess.Popen[bytes], ask: Callable[[], Any]) -> int:
    """The exit status of a process. ``ask`` is called every 50 ms, and may raise."""
    while True:
        ask()
        with suppress(subprocess.TimeoutExpired):
            return process.wait(0.05)


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
                    self.found[i] = _built(key, text, library, self._ask, NICE)
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


def serialised(function: Any) -> str:
    """The text of a casadi Function, by which it is known again; a name for this process where it has none."""
    try:
        return SERIALISED + str(function.serialize())
    except RuntimeError:  # of a Callback, say
        return str(id(function))


@lru_cache
def notice(words: str) -> None:
    """Say once why functions are interpreted."""
    LOG.warning("functions are interpreted, which is slower: %s", words)
