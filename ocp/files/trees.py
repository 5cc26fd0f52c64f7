"""JSON and YAML as trees of mappings, lists, texts and numbers, of bounded size and depth.

An alias of YAML counts for all that it stands for, so that whoever walks a tree ends in time.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from models.input_files import INPUT_LIMITS
from ocp.errors import ProblemError
from ocp.files.lines import FileName, read_lines

__all__ = ["checked_depth", "parts_of", "read_tree"]

NUMBER = re.compile(r"[-+]?(?:\d[\d_]*(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?")
WORDS: dict[str, Any] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **{
        word: value for value, text in ((True, "true"), (False, "false")) for word in (text, text.title(), text.upper())
    },
    **{word: float(word.replace(".", "")) for word in (".inf", "+.inf", "-.inf", ".nan")},
}
"""What plain scalars of YAML stand for that are no numbers and no texts."""
TAGS = {None, "!", *(f"tag:yaml.org,2002:{kind}" for kind in ("str", "int", "float", "bool", "null", "seq", "map"))}
TOO_DEEP = f"containers stand in each other more than {INPUT_LIMITS.nesting} deep"
_NO_KEY = object()


def read_tree(file: FileName, kind: str) -> Any:
    """Return what a JSON file, or the first document of a YAML file, holds.

    Raises:
        ProblemError: It cannot be read, is not of its kind, has too many values or too many containers within each
            other, or for YAML, the package pyyaml is not installed.
    """
    text = "\n".join(read_lines(file, longest=None))
    try:
        return _json(text) if kind == "json" else _yaml(text)
    except RecursionError as error:
        raise ProblemError(
            f"{file} is nested too deep", name="file", value=str(file), limit=INPUT_LIMITS.nesting
        ) from error
    except ValueError as error:
        if isinstance(error, ProblemError):
            raise
        raise ProblemError(f"{file} is no {kind.upper()}: {error}", name="file", value=str(file)) from error


def _json(text: str) -> Any:
    _check_count(sum(text.count(sign) for sign in ",[{"))
    return checked_depth(json.loads(text))


def _yaml(text: str) -> Any:
    try:
        import yaml
    except ImportError as error:
        words = "YAML is read by the package pyyaml: pip install 'selfmotion[yaml]'"
        raise ProblemError(words, name="yaml") from error
    try:
        return _first_document(yaml.parse(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader)))
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error


class _Container:
    """A list or mapping of which the end has not been read, and the number of values in it."""

    def __init__(self, value: Any, anchor: str | None) -> None:
        self.value, self.anchor, self.count, self.key = value, anchor, 1, _NO_KEY

    def add(self, value: Any, count: int) -> None:
        self.count += count
        _check_count(self.count)
        if isinstance(self.value, list):
            self.value.append(value)
        elif self.key is _NO_KEY:
            if isinstance(value, list | dict):
                raise ValueError("a key must be a text or a number")
            if value == "<<":
                raise ValueError("merged mappings (<<) are not read; write their entries")
            self.key = value
        else:
            self.value[self.key], self.key = value, _NO_KEY


def _first_document(events: Any) -> Any:
    """Build the tree of the first document from the events of a parser; None where there is none."""
    known: dict[str, tuple[Any, int]] = {}
    root = _Container([], None)
    waiting = [root]
    for event in events:
        name = type(event).__name__
        if name == "DocumentEndEvent":
            break
        if name in ("SequenceEndEvent", "MappingEndEvent"):
            ended = waiting.pop()
            value, count, anchor = ended.value, ended.count, ended.anchor
        elif name == "AliasEvent":
            if event.anchor not in known:
                raise ValueError(f"the alias *{event.anchor} stands before the end of what it stands for")
            (value, count), anchor = known[event.anchor], None
        elif name == "ScalarEvent":
            value, count, anchor = _scalar(event), 1, event.anchor
        elif name in ("SequenceStartEvent", "MappingStartEvent"):
            waiting.append(_Container([] if name[0] == "S" else {}, _checked_tag(event).anchor))
            if len(waiting) > INPUT_LIMITS.nesting:
                raise ValueError(TOO_DEEP)
            continue
        else:
            continue
        if anchor is not None:
            known[anchor] = value, count
        waiting[-1].add(value, count)
    return root.value[0] if root.value else None


def _scalar(event: Any) -> Any:
    text = str(_checked_tag(event).value)
    if not event.implicit[0]:  # in quotes, or with a tag
        return text
    if text in WORDS:
        return WORDS[text]
    return float(text) if len(text) < 400 and NUMBER.fullmatch(text) else text


def _checked_tag(event: Any) -> Any:
    if event.tag not in TAGS:
        raise ValueError(f"the tag {event.tag!r} is not read")
    return event


def _check_count(count: int) -> None:
    if count > INPUT_LIMITS.tree_values:
        raise ValueError(f"it holds {count} values, at most {INPUT_LIMITS.tree_values} are read")


def checked_depth(tree: Any) -> Any:
    """Return a tree; raise ValueError where its containers stand in each other more than INPUT_LIMITS.nesting deep."""
    level = [tree]
    for _ in range(INPUT_LIMITS.nesting + 1):
        level = [part for one in level for part in parts_of(one)]
    if level:
        raise ValueError(TOO_DEEP)
    return tree


def parts_of(value: Any) -> list[Any]:
    """Return the values of a mapping or list; of anything else none."""
    return list(value.values()) if isinstance(value, Mapping) else value if isinstance(value, list) else []
