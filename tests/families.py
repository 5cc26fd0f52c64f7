"""Families of tests: a few members in every run, all of them where tests may take long."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def some(family: Iterable[Any], daily: int | Iterable[Any]) -> list[Any]:
    """Parameters of a family: the daily members as they are, the others marked long.

    Args:
        family: Parameters, each of one value, or as `pytest.param`.
        daily: Which ones, or how many, spread evenly over the family.
    """
    members = list(family)
    if isinstance(daily, int):
        step = len(members) / min(daily, len(members))
        chosen = [members[int(k * step)] for k in range(min(daily, len(members)))]
    else:
        chosen = list(daily)
    return [member if _value(member) in map(_value, chosen) else _long(member) for member in members]


def _value(member: Any) -> Any:
    return member.values[0] if hasattr(member, "values") and hasattr(member, "marks") else member


def _long(member: Any) -> Any:
    if hasattr(member, "values") and hasattr(member, "marks"):
        return pytest.param(*member.values, id=member.id, marks=[*member.marks, pytest.mark.long])
    return pytest.param(member, marks=pytest.mark.long)
