"""C code of functions: derivatives of a program, compiled once into shared libraries that are cached between runs.

A library is identified by its source data, the compiler and its flags, so that meshes, processes and runs share it
(:mod:`models.files`). Compiled functions return exactly the numbers of interpreted ones: the same operations in the
same order, without fused operations. The compiler is that of the environment's CC, else `cc`; without one, functions
are interpreted.
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
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import casadi as ca

from models import files as cache
from ocp.console import LOG, casadi_silenced, check_time
from ocp.direct import assembly
from ocp.direct.assembly import SIZES, Derivatives, Transcription, derivatives

__all__ = ["CompilerError", "Library", "block_derivatives", "build_library", "generate_code"]


VERSION = "1"  # of the generated code
FLAGS = ("-fPIC", "-shared", "-w", "-ffp-contract=off", *(("-Wl,-z,defs",) if sys.platform == "linux" else ()))
"""Undefined symbols are errors at link time; otherwise a call would crash Python."""
LINK = "-lm"  # must follow the source file
SERIALISED = "casadi:"  # prefix of a serialised function
WATCHED = """
exec 3<&0
(trap "" TERM; read -r _ <&3; kill 0; rm -rf "$PWD"; kill -9 0) &
exec "$@" </dev/null 3<&-
"""
"""Shell script that runs a command; when its input closes, as when Python dies, it kills it and removes its folder."""


class CompilerError(RuntimeError):
    """C code that cannot be generated, compiled or loaded, with the reason."""


@dataclass(frozen=True)
class CodeSizes:
    """Limits on the C code, in characters.

    Attributes:
        optimized: Largest code that is optimised, which takes minutes for more and saves a third of the running time.
        accepted: Largest code that is compiled: gcc takes 130 bytes of memory for each character.
    """

    optimized: int = 300_000
    accepted: int = 8_000_000


CODE_SIZES = CodeSizes()


# ---- libraries ---------------------------------------------------------------------------------------------------


def generate_code(functions: Iterable[Any]) -> str:
    """Return the C code of casadi Functions, each under its name.

    Raises:
        CompilerError: One of them has no C code.
    """
    try:
        with tempfile.TemporaryDirectory() as place, casadi_silenced():
            generator = ca.CodeGenerator("unit.c")
            for function in functions:
                generator.add(function)
            generator.generate(f"{place}/")
            text = (Path(place) / "unit.c").read_text(encoding="utf-8")
    except RuntimeError as error:
        raise CompilerError(str(error).strip().splitlines()[-1]) from error
    if gap := re.search(r"^ *#error (.*)", text, re.MULTILINE):
        raise CompilerError(gap[1])
    # for an empty map CasADi adds to a null pointer, which is an error for gcc from version 14 on
    return text.replace("0+ i*0", "0")


@dataclass(frozen=True)
class Library:
    """A shared library.

    Attributes:
        contents: The data that determine its C code, such as serialised functions.
        text: Generates the C code; not called if the library is in the cache.
    """

    contents: tuple[str, ...]
    text: Callable[[], str]

    @property
    def key(self) -> str:
        """Its name in the cache; raises CompilerError if there is no compiler."""
        machine = (platform.machine(), sys.platform, ca.__version__, str(CODE_SIZES.optimized))
        return cache.cache_key(VERSION, *machine, *compiler(), *FLAGS, LINK, *self.contents)


def build_library(library: Library) -> Path:
    """Return the path of a library, compiled if it is not cached. Ctrl-C and time limits end the wait.

    Raises:
        CompilerError: There is no compiler, or it rejects the code.
        TimeLimitReached: The time limit is reached.
    """
    key = library.key
    path = _OWN.get(key) or cache.load_library(key)
    if path is not None:
        return path
    with cache.exclusive(key, check_time):
        path = _OWN.get(key) or cache.load_library(key)  # another process may have compiled it meanwhile
        if path is not None:
            return path
        content = _compile(library.text())
        path = cache.store_library(key, content)
    if path is None:  # for this process only
        path = Path(_own_folder().name) / f"{key}.so"
        path.write_bytes(content)
        _OWN[key] = path
    return path


_OWN: dict[str, Path] = {}
"""Libraries of this process, if the cache is not writable."""


@lru_cache(1)
def _own_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="selfmotion-")


# ---- the compiler ------------------------------------------------------------------------------------------------


def compiler() -> tuple[str, str]:
    """Return the compiler's command and its version text.

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
    """Return the version text of a compiler on the path; "" if it has none."""
    try:
        words = [*shlex.split(command), "--version"]
        result = subprocess.run(words, capture_output=True, stdin=subprocess.DEVNULL, timeout=10, check=True)
        return result.stdout.decode(errors="replace").strip()
    except (OSError, ValueError, IndexError, subprocess.SubprocessError):
        return ""


def _compile(text: str) -> bytes:
    """Return the shared library that the compiler makes of C code; raise as :func:`build_library`."""
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
    """Run a command in a folder, which also receives its output, until its input is closed."""
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
    """Return the serialised text of a casadi Function; if it has none, a name that is unique in this process."""
    try:
        return SERIALISED + str(function.serialize())
    except RuntimeError:  # of a Callback, say
        return str(id(function))


@lru_cache
def warn_interpreted(reason: str) -> None:
    """Log once why functions are interpreted."""
    LOG.warning("functions are interpreted, which is slower: %s", reason)


# ---- derivatives of blocks ---------------------------------------------------------------------------------------

RECIPE = hashlib.sha256(Path(assembly.__file__).read_bytes()).hexdigest()
"""Hash of the code that derives block functions: part of the key of a compiled library."""


def block_derivatives(transcription: Transcription, compiled: bool) -> list[Derivatives]:
    """Return the derivatives of each block; blocks with the same function share them.

    Args:
        transcription: The program.
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
            by_text[text] = _compiled(block.function, text) if is_compiled else derivatives(block.function)
    return [by_text[text] for text in texts]


def _compiled(function: Any, text: str) -> Derivatives:
    """Return the derivatives of a function from a compiled library, or interpreted if compilation fails."""
    try:
        path = build_library(Library((RECIPE, text), lambda: generate_code(derivatives(function))))
        return Derivatives(*(ca.external(name, str(path)) for name in Derivatives._fields))
    except (CompilerError, RuntimeError) as error:
        warn_interpreted(str(error))
        return derivatives(function)
