"""The command `selfmotion`: what is typed, what is printed, and the exit status.

0 when all holds, 1 when a check fails or stays open, or there is no plan, 2 for bad input, 130 after Ctrl-C.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from models import ModelError, ModelWarning
from ocp.app.arguments import CommandFunction, subcommands
from ocp.app.progress import Progress
from ocp.errors import AuditError, ProblemError, SolveError, checked_each

__all__ = ["main", "parser"]

ABOUT = """Plan the motion of robot arms with more freedom than their task needs, and check anybody's motion."""
PART = re.compile(r"\.[0-9a-f]{8}\.part$")
"""Of a file's name while it is written."""
CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
EXAMPLES = """examples:
  selfmotion check robot.urdf motion.csv --acceleration 15 --obstacles cell.toml
  selfmotion plan seam.toml -o seam.npz
  selfmotion export seam.npz seam.csv --period 0.004
  selfmotion report seam.npz seam.html

Exit status: 0 all holds, 1 a check fails or stays open, or there is no plan, 2 bad input, 130 Ctrl-C.
`selfmotion COMMAND --help` shows more examples."""


def parser() -> argparse.ArgumentParser:
    """Of the whole command line."""
    made = argparse.ArgumentParser(
        prog="selfmotion", description=ABOUT, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument("--version", action="version", version=f"selfmotion {_version()}")
    subcommands(made)
    return made


def _version() -> str:
    try:
        return version("selfmotion")
    except PackageNotFoundError:
        return "(from a tree that is not installed)"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit status.

    Raises:
        ProblemError: The arguments are no list of texts.
    """
    if isinstance(arguments, str):
        raise ProblemError(f"arguments must be a list of texts, not {arguments!r}", name="arguments", value=arguments)
    arguments = None if arguments is None else checked_each("arguments", arguments, str)
    options = parser().parse_args(arguments)
    try:
        return _run(options)
    except BrokenPipeError:  # who reads has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141


def _run(options: argparse.Namespace) -> int:
    asked: CommandFunction = options.run
    try:
        with warnings.catch_warnings(), Progress(f"selfmotion {options.command}", options.quiet) as progress:
            warnings.simplefilter("default", ModelWarning)
            warnings.showwarning = lambda message, *_, **__: progress.say(_printable(f"warning: {message}"))
            status, text, told = asked(options, progress)
        print(json.dumps(_plain(told), indent=1, allow_nan=False) if options.json else _printable(text), flush=True)
        return status
    except KeyboardInterrupt:
        print(f"selfmotion {options.command}: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:
        raise
    except (ModelError, ProblemError, AuditError, OSError) as error:
        return _refused(options, error, 2)
    except SolveError as error:
        return _refused(options, error, 1)


def _refused(options: argparse.Namespace, error: Exception, status: int) -> int:
    """Say what is wrong, on the error stream, with --json also as JSON."""
    words = str(error)
    if isinstance(error, OSError) and error.filename is not None:
        words = f"{PART.sub('', str(error.filename))}: {error.strerror}"
    for argument, option in options.called.items():
        words = words.replace(argument, option)
    print(f"selfmotion {options.command}: {_printable(words)}", file=sys.stderr)
    if options.json:
        found = {name: getattr(error, name, None) for name in ("name", "value", "limit", "time")}
        print(json.dumps(_plain({"error": words, **found}), indent=1, allow_nan=False), flush=True)
    return status


def _printable(text: str) -> str:
    """Return a text without the control characters of files that it quotes, on which a terminal would act."""
    return CONTROLS.sub(lambda sign: repr(sign[0])[1:-1], text)


def _plain(value: Any) -> Any:
    """As JSON can hold it; what is not finite is null, what is something else its text."""
    if isinstance(value, dict):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if value is None or isinstance(value, str | bool | int):
        return value
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if abs(value) < float("inf") else None
    return str(value)


if __name__ == "__main__":
    sys.exit(main())
