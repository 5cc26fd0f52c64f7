"""Which task begins from whose result: a tree of neighbours that the tasks alone decide.

Tasks are put into an order that looks random, that of their keys, and parted in generations of 1, 1, 2, 4, 8 ...; a
task's neighbour is the nearest of all generations before its own. So neighbours come nearer as the tasks get denser,
a generation may be done side by side, no chain is longer than log2 of the number of tasks, and the same tasks have the
same neighbours whoever does them in whatever order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from models.arrays import Array
from ocp.errors import NOT_NUMBERS, ProblemError, floats

__all__ = ["neighbours"]


def neighbours(tasks: Mapping[str, Any], names: Sequence[str]) -> dict[str, str | None]:
    """The neighbour's key of every key, in an order in which neighbours come first; None of the first.

    Args:
        tasks: By key.
        names: Of the numbers (or lists of numbers) in the tasks by which they are near. Each is divided by its range.

    Raises:
        ProblemError: A task has no such numbers, or not as many as the others; names it.
    """
    order = sorted(tasks)
    each = [place_of(tasks[key], names) for key in order]
    for key, place in zip(order, each, strict=True):
        if len(place) != len(each[0]):
            words = f"near: {len(place)} numbers in the task {tasks[key]!r}, {len(each[0])} in another"
            raise ProblemError(words, name="near", value=len(place), limit=len(each[0]))
    places = np.array(each)
    spread = np.ptp(places, axis=0) if order else np.ones(0)
    places = places / np.where(spread > 0, spread, 1.0)
    found: dict[str, str | None] = {}
    begin, end = 0, 1
    while begin < len(order):
        keys = order[begin:end]
        if begin:
            nearest = cKDTree(places[:begin]).query(places[begin:end])[1]
            found |= {key: order[int(i)] for key, i in zip(keys, nearest, strict=True)}
        else:
            found |= dict.fromkeys(keys)
        begin, end = end, 2 * end
    return found


def place_of(task: Any, names: Sequence[str]) -> Array:
    """The numbers of a task by which it is near to others. Shape (n,)."""
    parts = []
    for name in names:
        value = task.get(name) if isinstance(task, Mapping) else None
        try:
            part = floats(value).ravel()
        except NOT_NUMBERS as error:
            words = f"near: {name!r} is no number and no list of numbers in the task {task!r}"
            raise ProblemError(words, name=name, value=value) from error
        parts.append(part)
    return np.concatenate(parts) if parts else np.zeros(0)
