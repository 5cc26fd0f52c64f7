"""Which members of a crossed family of tests run by default."""

from __future__ import annotations

from collections import defaultdict

import pytest


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark members of crossed families as long, except as many as contain every value of every parameter.

    A test with several lists of parameters runs for their whole product in `make long`. By default it runs for the
    diagonal: the first entries of all lists, the second entries, and so on, where a shorter list begins again.
    """
    families: dict[str, list[pytest.Function]] = defaultdict(list)
    for item in items:
        if isinstance(item, pytest.Function) and hasattr(item, "callspec"):
            families[item.nodeid.partition("[")[0]].append(item)
    for members in families.values():
        lists = [_names(mark) for mark in members[0].iter_markers("parametrize")]
        if len(lists) < 2:
            continue
        entries = [
            [tuple(id(member.callspec.params.get(name)) for name in names) for names in lists] for member in members
        ]
        numbers = [{entry: k for k, entry in enumerate(dict.fromkeys(column))} for column in zip(*entries, strict=True)]
        for member, entry in zip(members, entries, strict=True):
            places = [number[one] for number, one in zip(numbers, entry, strict=True)]
            last = max(range(len(lists)), key=lambda i: len(numbers[i]))
            if any(place != places[last] % len(number) for place, number in zip(places, numbers, strict=True)):
                member.add_marker(pytest.mark.long)


def _names(mark: pytest.Mark) -> list[str]:
    """Return the names of the parameters in one list."""
    names = mark.args[0]
    return [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
