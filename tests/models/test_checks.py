"""Fields of the models' exceptions, and laws of the argument checks."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from models import ModelError
from models.checks import Checks, floats, require, short_repr
from ocp import ProblemError
from ocp.errors import require as require_of_ocp


def test_a_pickled_error_keeps_its_message_and_its_fields() -> None:
    error = ModelError("joint 'elbow' is at 3 rad", name="elbow", value=3.0, limit=(-2.0, 2.0), time=0.5)
    copy = pickle.loads(pickle.dumps(error))
    assert (type(copy), str(copy), copy.args) == (ModelError, str(error), error.args)
    assert (copy.name, copy.value, copy.limit, copy.time) == ("elbow", 3.0, (-2.0, 2.0), 0.5)
    assert vars(ModelError("bare")) == {"name": None, "value": None, "limit": None, "time": None}


def test_arrays_are_read_only_copies_and_free_dimensions_take_any_length() -> None:
    points = np.ones((4, 3))
    array = require.array("path: points", points, ("points", 3), least=2, sign="positive")
    points[0, 0] = 7.0
    assert array.shape == (4, 3)
    assert array.max() == 1.0
    with pytest.raises(ValueError, match="read-only"):
        array[0, 0] = 2.0
    assert require.array("t", 2.0, ("times",)).tolist() == [2.0]
    assert require.array("t", [[1.0], [2.0]], (2,)).tolist() == [1.0, 2.0]
    assert require.array("t", np.zeros((2, 1, 4))).shape == (2, 1, 4)
    assert np.isnan(require.array("t", [np.nan, np.inf], (2,), entries="any")[0])
    assert require.array("t", [-np.inf], (1,), entries="numbers") == -np.inf
    assert require.array("t", [0.0, 1.0], sign="nonnegative").tolist() == [0.0, 1.0]
    assert require.broadcast("speed", 0.5, 3, "segments").tolist() == [0.5] * 3
    assert require.broadcast("speed", [1, 2], 2, "segments").tolist() == [1.0, 2.0]


def test_values_that_pass_are_returned_in_their_checked_form() -> None:
    assert require.choice("elbow", "left", ("left", "right")) == "left"
    assert require.each("names", iter("ab"), str) == ("a", "b")
    assert require.mapping("options", None) == {}
    assert require.mapping("margins", {3: 1.0}, keys=int) == {3: 1.0}
    assert require.count("count", np.int64(3)) == 3
    assert require.count("seed", 0, 0, 2**70) == 0
    assert require.flag("limits", np.True_) is True
    assert require.positive("share", 0.5, below=1.0) == 0.5
    assert require.indices("faces", [[0, 2]], 3).tolist() == [[0, 2]]


TOO_MANY = range(2**40)
REFUSED: list[tuple[Callable[[Checks], Any], str, str, Any]] = [
    (lambda c: c.array("a: b", "x", (1,)), "a: b 'x' is not numeric", "b", None),
    (lambda c: c.array("a: b", TOO_MANY), "is not numeric", "b", None),
    (lambda c: c.array("a: b", [1], ("n", 3), least=2), r"\(1,\), expected \(n, 3\), 2 at", "b", ("n", 3)),
    (lambda c: c.array("b", [1, 2], (3,), meaning="x, y, z"), r"has shape \(2,\), expected \(3,\): x, y, z", "b", (3,)),
    (lambda c: c.array("b", [[1, 2]], (2,)), r"has shape \(1, 2\), expected \(2,\)", "b", (2,)),
    (lambda c: c.array("a: b", [[1, 2], [3, np.inf]], (2, 2)), r"b \(row 1\) \[3.0, inf\] is not finite", "b", None),
    (lambda c: c.array("a: b", [1, np.nan], (2,), entries="numbers"), r"a: b \[1.0, nan\] is not finite", "b", None),
    (lambda c: c.array("b", [1.0] * 30 + [-2], ("n",), sign="positive"), r"\(entry 30\) -2.0 is not pos", "b", 0.0),
    (lambda c: c.array("b", [1, 0], sign="positive", unit="m"), r"b \[1.0, 0.0\] m is not positive", "b", 0.0),
    (lambda c: c.array("b", [1, -1], sign="nonnegative"), r"b \[1.0, -1.0\] is negative", "b", 0.0),
    (lambda c: c.broadcast("a: b", [1, 2], 3, "joints"), "one number or one for each of the 3 joints", "b", (3,)),
    (lambda c: c.number("a: b", "3"), "a: b must be a finite number, not '3'", "b", None),
    (lambda c: c.number("a: b", np.inf), r"a: b must be a finite number, not inf", "b", None),
    (lambda c: c.number("a: b", np.nan, finite=False), "a: b must be a number, not nan", "b", None),
    (lambda c: c.number("a: b", True), "not True", "b", None),
    (lambda c: c.positive("a: b", 0, unit="m"), r"a: b must be positive and finite \(in m\), not 0", "b", 0.0),
    (lambda c: c.positive("b", np.inf), "b must be positive and finite, not inf", "b", 0.0),
    (lambda c: c.positive("b", 1.0, below=1.0), "b must be between 0 and 1, not 1.0", "b", (0.0, 1.0)),
    (lambda c: c.nonnegative("b", -1e-300), "b must be a finite number, zero or above, not -1e-300", "b", 0.0),
    (lambda c: c.nonnegative("b", np.inf), "zero or above, not inf", "b", 0.0),
    (lambda c: c.count("b", 0), "b must be a whole number, 1 to 1000000, not 0", "b", (1, 1000000)),
    (lambda c: c.count("b", 8, 2, 7), "b must be a whole number, 2 to 7, not 8", "b", (2, 7)),
    (lambda c: c.count("b", 2.0), "not 2.0", "b", (1, 1000000)),
    (lambda c: c.count("b", True), "not True", "b", (1, 1000000)),
    (lambda c: c.indices("b", [0, 3], 3), r"b must be whole numbers from 0, below 3, not \[0, 3\]", "b", (0, 3)),
    (lambda c: c.indices("b", [-1], 3), "below 3", "b", (0, 3)),
    (lambda c: c.indices("b", [0.0], 3), "below 3", "b", (0, 3)),
    (lambda c: c.rotation("a: b", 2 * np.eye(3)), "is not a rotation matrix", "b", None),
    (lambda c: c.rotation("a: b", np.diag([1, 1, -1])), "is not a rotation matrix", "b", None),
    (lambda c: c.rotation("a: b", np.eye(3)[[1, 0, 2]]), "is not a rotation matrix", "b", None),
    (lambda c: c.choice("a: b", "c", "de"), "a: b must be 'd' or 'e', not 'c'", "b", ("d", "e")),
    (lambda c: c.choice("b", 3.0, (3, 5)), "b must be 3 or 5, not 3.0", "b", (3, 5)),
    (lambda c: c.flag("b", 1), "b must be True or False, not 1", "b", (True, False)),
    (lambda c: c.text("b", b"x"), "b must be a string, not b'x'", "b", "str"),
    (lambda c: c.name("link 'b'", ""), "must be a name, a string that is not empty, not ''", "b", None),
    (lambda c: c.name("b", "a\x1b"), "printable characters", "b", 500),
    (lambda c: c.name("b", "a" * 501), "at most 500 printable characters", "b", 500),
    (lambda c: c.instance("b", "x", int), "b must be a int, not 'x'", "b", "int"),
    (lambda c: c.each("b", ["x", 2], str), "b must be a str, not 2", "b", "str"),
    (lambda c: c.each("b", 3, str), "b must be a list of str, not 3", "b", "str"),
    (lambda c: c.each("b", TOO_MANY, int), "b must be a list of int", "b", "int"),
    (lambda c: c.mapping("b", [1]), r"b must be a dictionary by name, not \[1\]", "b", None),
    (lambda c: c.mapping("b", {1: 2}), "b must be a dictionary by name", "b", None),
]


@pytest.mark.parametrize(("checks", "kind"), [(require, ModelError), (require_of_ocp, ProblemError)])
@pytest.mark.parametrize(("check", "message", "name", "limit"), REFUSED)
def test_a_check_names_the_invalid_value(
    check: Callable[[Checks], Any], message: str, name: str, limit: Any, checks: Checks, kind: type[Exception]
) -> None:
    with pytest.raises(kind, match=message) as caught:
        check(checks)
    error: Any = caught.value
    assert (error.name, error.limit) == (name, limit)


@pytest.mark.parametrize(
    ("name", "known", "message"),
    [
        ("torqe", ["torque", "speed"], "control 'torqe' does not exist; did you mean 'torque'?"),
        ("SPEED", ["torque", "speed"], "control 'SPEED' does not exist; did you mean 'speed'?"),
        ("z", ["torque", "speed"], "control 'z' does not exist; known: torque, speed"),
        ("z", [], "control 'z' does not exist; known: none"),
        (3, ["torque"], "control 3 does not exist; known: torque"),
        ("z", [f"a{k}" for k in range(14)], "a10, a11 and 2 more"),
    ],
)
def test_an_unknown_name_comes_with_the_most_similar_names(name: object, known: list[str], message: str) -> None:
    error = require.unknown("control", name, known)
    assert message in str(error)
    assert (error.name, error.value, error.limit) == (str(name), name, tuple(known))


NUMBERS: tuple[Any, ...] = (1, 0, -2, True, 0.0, -0.0, 2.5, -1e-300, np.inf, -np.inf, np.nan, Fraction(1, 3), 10**400)
NUMBERS += ("3", "x", None, [1.0], np.float64(4), np.float32(np.nan), np.array(7.0), np.array([7.0]), np.int8(3), 1j)


@pytest.mark.parametrize("value", NUMBERS, ids=lambda value: repr(value)[:20])
def test_a_number_is_accepted_as_an_array_without_dimensions_is(value: Any) -> None:
    """Both read the same number, and both refuse; so do `positive` and `nonnegative` by the sign."""

    def outcome(check: Callable[[], Any]) -> float | None:
        try:
            return float(check())
        except ModelError:
            return None

    any_number = outcome(lambda: require.number("a", value, finite=False))
    assert any_number == outcome(lambda: require.array("a", value, (), entries="numbers"))
    number = outcome(lambda: require.number("a", value))
    assert number == outcome(lambda: require.array("a", value, ()))
    assert outcome(lambda: require.positive("a", value)) == (number if number is not None and number > 0 else None)
    assert outcome(lambda: require.nonnegative("a", value)) == (number if number is not None and number >= 0 else None)
    if number is not None:
        assert type(require.number("a", value)) is float
        assert floats(value) == number


@dataclass(frozen=True)
class Described:
    name: str
    values: Any = None
    weight: float = 1.0
    hidden: Any = field(default=0, repr=False)


def test_the_short_text_of_an_object_has_one_line_whatever_it_holds() -> None:
    assert repr_of(Described("a", np.zeros((400, 3)))) == "Described(name='a', values=<array of shape (400, 3)>)"
    assert repr_of(Described("b", np.arange(3.0), 2.0)) == "Described(name='b', values=[0., 1., 2.], weight=2.0)"
    assert repr_of(Described("c", [0.5] * 99, hidden="x")) == "Described(name='c', values=<list of 99>)"
    assert repr_of(Described("d" * 99, print)) == "Described(name=<str>, values=<built-in function print>)"
    nested = repr_of(Described("e", tuple(np.eye(9) for _ in range(3))))
    assert nested == "Described(name='e', values=<tuple of 3>)"


def repr_of(value: Any) -> str:
    text = short_repr(value)
    assert "\n" not in text
    return text
