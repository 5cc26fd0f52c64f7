"""What is dear to compute and depends on nothing but its input, kept in files between runs.

The folder is $XDG_CACHE_HOME/selfmotion, else ~/.cache/selfmotion. A file that cannot be read, is broken or cannot be
written is no error: then the work is done again.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np

MOST_BYTES = 2**20  # of a file: ours have a few hundred


def key_of(version: str, *arrays: Any) -> str:
    """A name for the contents of arrays and the version of what is done with them: hexadecimal digits of SHA-256."""
    digest = hashlib.sha256(version.encode())
    for array in arrays:
        plain = np.ascontiguousarray(array)
        digest.update(f"|{plain.dtype.str}{plain.shape}|".encode())
        digest.update(plain.tobytes())
    return digest.hexdigest()


def folder() -> Path:
    """Where the files lie; it need not exist."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    place = Path(given) if given and Path(given).is_absolute() else Path("~/.cache").expanduser()
    return place / "selfmotion"


def files() -> list[Path]:
    """All that is kept, and parts that were left by who was killed."""
    try:
        place = folder()
        return sorted(file for file in place.iterdir() if file.is_file() and file.suffix in (".json", ".part"))
    except (OSError, RuntimeError):
        return []


def kept(key: str) -> Any:
    """What was kept under a key: lists, dictionaries, texts, numbers; None where there is nothing or nothing whole."""
    try:
        file = folder() / f"{key}.json"
        if file.stat().st_size > MOST_BYTES:
            return None
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RuntimeError, RecursionError):  # RuntimeError: there is no home
        return None


def keep(key: str, value: Any) -> None:
    """Keep a value of JSON under a key; a file there is replaced as a whole."""
    part = None
    try:
        place = folder()
        place.mkdir(parents=True, exist_ok=True)
        with NamedTemporaryFile("w", encoding="utf-8", dir=place, suffix=".part", delete=False) as file:
            part = Path(file.name)
            json.dump(value, file)
        part.replace(place / f"{key}.json")
    except (OSError, ValueError, RuntimeError):
        if part is not None:
            part.unlink(missing_ok=True)
