"""Fields of the models' exceptions, and messages of the argument checks."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from models import ModelError
from models.arrays import checked_array, checked_broadcast, checked_choice, checked_number, checked_rotation


def test_a_pickled_error_keeps_its_message_and_its_fields() -> None:
    error = ModelError("joint 'elbow' is at 3 rad", name="elbow", value=3.0, limit=(-2.0, 2.0), time=0.5)
    copy = pickle.loads(pickle.dumps(error))
    assert (type(copy), str(copy), copy.args) == (ModelError, str(error), error.args)
    assert (copy.name, copy.value, copy.limit, copy.time) == ("elbow", 3.0, (-2.0, 2.0), 0.5)
    assert vars(ModelError("bare")) == {"name": None, "value": None, "limit": None, "time": None}


def test_arrays_are_read_only_copies_and_free_dimensions_take_any_length() -> None:
    options = np.ones((4, 3))
    array = checked_array(options, ("points", 3), "path", "points", least=2, positive=True)
    options[0, 0] = 7.0
    assert array.shape == (4, 3)
    assert array.max() == 1.0
    with pytest.raises(ValueError, match="read-only"):
        array[0, 0] = 2.0
    assert checked_array(2.0, ("times",), "motion", "t").tolist() == [2.0]
    assert np.isnan(checked_array([np.nan, 1], (2,), "a", "b", nan=True)[0])
    assert checked_broadcast(0.5, 3, "path", "speed", "segments").tolist() == [0.5] * 3
    assert checked_number(1e-3, "rig", "length", positive=True, unit="m") == 1e-3
    assert checked_choice("left", ("left", "right"), "scara", "elbow") == "left"


@pytest.mark.parametrize(
    ("check", "message", "name", "limit"),
    [
        (lambda: checked_array("x", (1,), "a", "b"), "a: b 'x' is not numeric", "b", None),
        (lambda: checked_array([1], ("n", 3), "a", "b", least=2), r"\(1,\), expected \(n, 3\), 2 at", "b", ("n", 3)),
        (lambda: checked_array([[1, 2], [3, np.inf]], (2, 2), "a", "b"), r"b \(row 1\) \[3.0, inf\] is not", "b", None),
        (lambda: checked_array([1, np.inf], (2,), "a", "b", nan=True), r"a: b \[1.0, inf\] is not finite", "b", None),
        (lambda: checked_array([1.0] * 30 + [-2], ("n",), "a", "b", positive=True), r"\(entry 30\) -2.0", "b", 0.0),
        (lambda: checked_array([1, np.nan], (2,), "a", "b", finite=False), "is not finite", "b", None),
        (lambda: checked_number(-1, "a", "b", positive=True, unit="m"), "a: b -1.0 m is not positive", "b", 0.0),
        (lambda: checked_broadcast([1, 2], 3, "a", "b", "joints"), "or one for each of the 3 joints", "b", (3,)),
        (lambda: checked_rotation(2 * np.eye(3), "a", "b"), "is not a rotation matrix", "b", None),
        (lambda: checked_rotation(np.diag([1, 1, -1]), "a", "b"), "is not a rotation matrix", "b", None),
        (lambda: checked_rotation(np.eye(3)[[1, 0, 2]], "a", "b"), "is not a rotation matrix", "b", None),
        (lambda: checked_choice("c", "de", "a", "b"), r"'c' is unknown; use one of \['d', 'e'\]", "b", ("d", "e")),
    ],
)  # fmt: skip
def test_a_check_names_the_invalid_value(check: Callable[[], Any], message: str, name: str, limit: Any) -> None:
    with pytest.raises(ModelError, match=message) as caught:
        check()
    assert (caught.value.name, caught.value.limit) == (name, limit)


NUMBERS: tuple[Any, ...] = (1, 0, -2, True, 0.0, -0.0, 2.5, -1e-300, np.inf, -np.inf, np.nan)
NUMBERS += ("3", "x", None, [1.0], np.float64(4), np.float32(np.nan), np.array(7.0))


@pytest.mark.parametrize("finite", [True, False])
@pytest.mark.parametrize("positive", [True, False])
@pytest.mark.parametrize("value", NUMBERS, ids=repr)
def test_a_number_is_checked_as_an_array_without_dimensions_is(value: Any, positive: bool, finite: bool) -> None:
    def outcome(check: Callable[..., Any], *shape: Any) -> tuple[type, str]:
        try:
            return float, repr(float(check(value, *shape, "rig", "length", positive=positive, finite=finite, unit="m")))
        except ModelError as error:
            return ModelError, str(error)

    assert outcome(checked_number) == outcome(checked_array, ())
    if outcome(checked_number)[0] is float:
        assert type(checked_number(value, "rig", "length", positive=positive, finite=finite)) is float
