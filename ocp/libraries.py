"""C code compiled by the machine's compiler, once: shared libraries that are kept between runs.

A library is known by what it is made of, by the compiler and by its flags, so meshes, processes and runs share it (see
`models.cache`). Compiled functions return the very numbers that interpreted ones do: the same operations in the same
order, none of them fused. The compiler is that of the environment's CC, else `cc`; without one, functions are
interpreted.
"""

from __future__ import annotations

import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import casadi as ca

from models import cache
from ocp.console import LOG, casadi_silenced, check_time

__all__ = ["CompilerError", "Library", "build_library", "generate_c", "generate_code"]

VERSION = "1"  # of what is made of contents
FLAGS = ("-fPIC", "-shared", "-w", "-ffp-contract=off", *(("-Wl,-z,defs",) if sys.platform == "linux" else ()))
"""What is not defined is an error here, where it is the end of Python when it is called."""
LINK = "-lm"  # behind the C
SERIALISED = "casadi:"  # before the text of a function
WATCHED = """
exec 3<&0
(trap "" TERM; read -r _ <&3; kill 0; rm -rf "$PWD"; kill -9 0) &
exec "$@" </dev/null 3<&-
"""
"""Shell words that run a command; when their input ends, as where Python is killed, they end it, its folder too."""


class CompilerError(RuntimeError):
    """C code that cannot be made, compiled or loaded, and why."""


@dataclass(frozen=True)
class CodeSizes:
    """Characters of C.

    Attributes:
        optimized: The most that are optimized: more take minutes, and without it half as long again to run.
        accepted: The most that are compiled: gcc takes 130 bytes of memory for each.
    """

    optimized: int = 300_000
    accepted: int = 8_000_000


SIZES = CodeSizes()


# ---- libraries ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Library:
    """A shared library.

    Attributes:
        contents: All that its C follows from, such as serialised functions. text: Makes the C; not called where the
            library is kept.
    """

    contents: tuple[str, ...]
    text: Callable[[], str]

    @property
    def key(self) -> str:
        """Its name in the cache.

        Raises:
            CompilerError: There is no compiler.
        """
        machine = (platform.machine(), sys.platform, ca.__version__, str(SIZES.optimized))
        return cache.key_of(VERSION, *machine, *compiler(), *FLAGS, LINK, *self.contents)


def generate_code(functions: Iterable[Any]) -> str:
    """C of casadi Functions, each by its name.

    Raises:
        CompilerError: One of them has no C.
    """
    return generate_c(functions, "unit", header=False)[0]


def generate_c(functions: Iterable[Any], name: str, *, header: bool = True) -> list[str]:
    """The texts NAME.c and NAME.h of casadi Functions.

    Raises:
        CompilerError: One of them has no C.
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
    # where nothing is mapped CasADi adds to a null pointer, which gcc takes for an error from version 14 on
    return [text.replace("0+ i*0", "0") for text in texts]


def build_library(library: Library) -> Path:
    """A library, compiled where it is not kept. It is waited for; Ctrl-C and time limits end that.

    Raises:
        CompilerError: There is no compiler, or it takes the C for wrong.
        TimeLimitReached: The time limit is over.
    """
    key = library.key
    found = _OWN.get(key) or cache.kept_library(key)
    if found is not None:
        return found
    with cache.alone(key, check_time):
        found = _OWN.get(key) or cache.kept_library(key)  # another process may have made it meanwhile
        if found is not None:
            return found
        content = _compiled(library)
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


def _compiled(library: Library) -> bytes:
    """What the compiler makes of the C of a library.

    Raises:
        CompilerError: It fails, or there is no C. OutOfTime: The time limit is over.
    """
    text = library.text()
    if len(text) > SIZES.accepted:
        raise CompilerError(f"{len(text)} characters of C are more than {SIZES.accepted}")
    speed = "-O1" if len(text) <= SIZES.optimized else "-O0"
    place = Path(tempfile.mkdtemp(prefix="selfmotion-"))
    process = None
    try:
        (place / "unit.c").write_text(text, encoding="utf-8")
        words = [*shlex.split(compiler()[0]), speed, *FLAGS, "unit.c", "-o", "unit.so", LINK]
        process = begun(words, place)
        if wait(process):
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


def begun(words: list[str], place: Path) -> subprocess.Popen[bytes]:
    """A command that runs in a folder, where what it says is kept too, until its input is closed."""
    with open(place / "words", "wb") as told:
        return subprocess.Popen(
            ["sh", "-c", WATCHED, "sh", *words],
            cwd=place,
            env={**os.environ, "TMPDIR": str(place)},
            stdin=subprocess.PIPE,
            stdout=told,
            stderr=told,
            start_new_session=True,
        )


def wait(process: subprocess.Popen[bytes]) -> int:
    """The exit status of a process. The time limit is looked at every 50 ms."""
    while True:
        check_time()
        with suppress(subprocess.TimeoutExpired):
            return process.wait(0.05)


def function_key(function: Any) -> str:
    """The text of a casadi Function, by which it is known again; a name for this process where it has none."""
    try:
        return SERIALISED + str(function.serialize())
    except RuntimeError:  # of a Callback, say
        return str(id(function))


@lru_cache
def warn_interpreted(words: str) -> None:
    """Say once why functions are interpreted."""
    LOG.warning("functions are interpreted, which is slower: %s", words)
