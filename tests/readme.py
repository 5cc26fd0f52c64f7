"""The README's blocks as a reader runs them: saved under the names that the text gives them, commands in order."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

README = Path(__file__).resolve().parent.parent / "README.md"
BLOCK = re.compile(r"(?P<before>[^\n]*)\n```(?P<kind>\w*)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL)
EXTRAS = re.compile(r'`pip install "\.\[([\w,]+)\]"`')
NAMED = re.compile(r"`([\w.]+\.(?:py|toml))`")
MAKE_COMMAND = "make "
"""Commands of a clone, which have tests of their own."""


class Step(NamedTuple):
    """A file to write, or the words of a program to run; what it says of how it ends is its status 0.

    ``extras``: What the line before the block says that it needs beside `pip install .`, with commas.
    """

    file: str
    text: str
    words: tuple[str, ...]
    extras: str = ""


def steps() -> list[Step]:
    """What a reader does who follows the README from its first block to its last, in a folder that is empty.

    The batch is of one place instead of ten thousand.
    """
    results = []
    for block in BLOCK.finditer(README.read_text(encoding="utf-8")):
        text, name, extras = block["text"], NAMED.search(block["before"]), EXTRAS.search(block["before"])
        if text.startswith(MAKE_COMMAND):
            continue
        if text.startswith("selfmotion "):
            results += [Step("", "", tuple(line.partition("#")[0].split())) for line in text.splitlines()]
            continue
        file = name[1] if name else "first.py"
        if file == "places.py":
            assert text.count("range(100)") == 2
            text = text.replace("range(100)", "range(1)")
        results.append(Step(file, text, ("python", file) if file.endswith(".py") else (), extras[1] if extras else ""))
    return results
