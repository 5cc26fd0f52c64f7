"""The command `selfmotion`: arguments, output and exit status.

The status is 0 if all requirements hold, 1 if a check fails or is undetermined or there is no plan, 2 for bad input,
and
130 after Ctrl-C.
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
from ocp.errors import AuditError, ProblemError, SolveError, require
from ocp.progress import Progress

__all__ = ["main", "parser"]

ABOUT = """Plan motions of kinematically redundant robot arms, and check joint trajectories from any source."""
PART = re.compile(r"\.[0-9a-f]{8}\.part$")
"""Suffix of a file's name while it is being written."""
CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
EXAMPLES = """examples:
  selfmotion check robot.urdf motion.csv --acceleration 15 --obstacles cell.toml
  selfmotion plan seam.toml -o seam.npz
  selfmotion export seam.npz seam.csv --period 0.004
  selfmotion report seam.npz seam.html

Exit status: 0 all holds, 1 a check fails or is undetermined, or there is no plan, 2 bad input, 130 Ctrl-C.
`selfmotion COMMAND --help` shows more examples."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    whole = argparse.ArgumentParser(
        prog="selfmotion", description=ABOUT, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    whole.add_argument("--version", action="version", version=f"selfmotion {_version()}")
    subcommands(whole)
    return whole


def _version() -> str:
    """Return the installed version."""
    try:
        return version("selfmotion")
    except PackageNotFoundError:
        return "(from a tree that is not installed)"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status.

    Raises:
        ProblemError: The arguments are not a list of texts.
    """
    if isinstance(arguments, str):
        raise ProblemError(f"arguments must be a list of texts, not {arguments!r}", name="arguments", value=arguments)
    arguments = None if arguments is None else require.each("arguments", arguments, str)
    options = parser().parse_args(arguments)
    try:
        return _run(options)
    except BrokenPipeError:  # the reader of the output has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141


def _run(options: argparse.Namespace) -> int:
    """Run a subcommand, print its result or its error, and return the exit status."""
    run: CommandFunction = options.run
    try:
        with warnings.catch_warnings(), Progress(f"selfmotion {options.command}", options.quiet) as progress:
            warnings.simplefilter("default", ModelWarning)
            warnings.showwarning = lambda message, *_, **__: progress.say(_printable(f"warning: {message}"))
            status, text, data = run(options, progress)
        print(json.dumps(_plain(data), indent=1, allow_nan=False) if options.json else _printable(text), flush=True)
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
    """Print an error, with --json also as JSON, and return the exit status."""
    message = str(error)
    if isinstance(error, OSError) and error.filename is not None:
        message = f"{PART.sub('', str(error.filename))}: {error.strerror}"
    for argument, option in options.called.items():
        message = message.replace(argument, option)
    print(f"selfmotion {options.command}: {_printable(message)}", file=sys.stderr)
    if options.json:
        fields = {name: getattr(error, name, None) for name in ("name", "value", "limit", "time")}
        print(json.dumps(_plain({"error": message, **fields}), indent=1, allow_nan=False), flush=True)
    return status


def _printable(text: str) -> str:
    """Escape the control characters in a text, because it may quote files and a terminal would interpret them."""
    return CONTROLS.sub(lambda match: repr(match[0])[1:-1], text)


def _plain(value: Any) -> Any:
    """Return a value as JSON can represent it: null if it is not finite, the text of any other object."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if value is None or isinstance(value, str | bool | int):
        return value
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if abs(value) < float("inf") else None
    return str(value)


if __name__ == "__main__":
    sys.exit(main())
