"""Bad values by what is asked for, and the law that each is refused by name: the panels of bad input share them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import ModelError
from ocp import ProblemError

Bad = dict[str, Any]

NAN, INF = float("nan"), float("inf")
NOTHING: Bad = {"None": None}
STRANGE: Bad = {"word": "a", "digits": "3", "bytes": b"3", "dictionary": {"a": 1}, "object": object(), "complex": 1j}
SYMBOL: Bad = {"symbol": ca.SX.sym("strange")}
NUMBER: Bad = STRANGE | SYMBOL | {"nan": NAN, "truth": True, "empty": [], "ragged": [[1, 2], [3]], "huge": 10**400}
FINITE: Bad = NUMBER | {"inf": INF, "minus inf": -INF}
NONNEGATIVE: Bad = FINITE | {"negative": -1.0}
POSITIVE: Bad = NONNEGATIVE | {"zero": 0.0}
LIMIT: Bad = NUMBER | {"negative": -1.0, "zero": 0.0}  # which may be infinite
SHARE: Bad = POSITIVE | {"one": 1.0}
WHOLE: Bad = FINITE | {"half": 1.5, "negative": -1}
COUNT: Bad = WHOLE | {"zero": 0}
NAME: Bad = NOTHING | {"number": 3, "empty": "", "bytes": b"a", "list": ["a"], "object": object(), "truth": True}
UNKNOWN: Bad = NAME | {"unknown": "nobody"}
TEXT: Bad = {"number": 3, "bytes": b"a", "list": ["a"], "object": object()}
CHOICE: Bad = NOTHING | {"unknown": "sideways", "number": 3, "list": ["a"], "dictionary": {}, "object": object()}
FLAG: Bad = NOTHING | {"word": "yes", "number": 2, "list": [], "nan": NAN, "object": object()}
MAPPING: Bad = {"word": "a", "number": 3, "list": ["a"], "pairs": [("a", 1)], "object": object()}
INSTANCE: Bad = {
    "None": None,
    "word": "a",
    "number": 3,
    "list": [],
    "dictionary": {},
    "object": object(),
    "type": float,
}
SEQUENCE: Bad = {"number": 3, "word": "a", "numbers": [1, 2], "nothing in it": [None], "object": object()}
CALLABLE: Bad = {"word": "a", "number": 3, "list": [1.0], "object": object()}


def array(*shape: int) -> Bad:
    """What is no array of finite numbers of that shape."""
    wrong = np.ones((*shape[:-1], shape[-1] + 1))
    holed, endless = np.ones(shape), np.ones(shape)
    holed.flat[-1], endless.flat[0] = NAN, INF
    texts, turned = np.full(shape, "1").tolist(), np.full(shape, 1 + 1j).tolist()
    return STRANGE | {
        "wrong shape": wrong,
        "empty": [],
        "ragged": [[1, 2], [3]],
        "nan": holed,
        "inf": endless,
        "digits in a list": texts,
        "complex in a list": turned,
        "truths": np.ones(shape, dtype=bool),
    }


def rotation() -> Bad:
    """What is no rotation matrix."""
    return array(3, 3) | {"stretched": 2 * np.eye(3), "mirrored": np.diag([1.0, 1.0, -1.0]), "zero": np.zeros((3, 3))}


def but(bad: Bad, *labels: str) -> Bad:
    """The same without what is good at that place."""
    return {label: value for label, value in bad.items() if label not in labels}


@dataclass(frozen=True)
class Case:
    """A public call, arguments with which it is good, and bad ones for each argument that is looked at."""

    what: str
    call: Callable[..., Any]
    good: Mapping[str, Any]
    bad: Mapping[str, Bad]


def method(owner: Callable[[], Any], name: str, good: Mapping[str, Any], /, **bad: Bad) -> Case:
    """A method of what ``owner`` makes, which is asked for when it is called."""
    return Case(f"{owner.__name__}.{name}", lambda **options: getattr(owner(), name)(**options), good, bad)


def panel(cases: Iterable[Case]) -> list[Any]:
    """Every argument that is looked at, as parameters of a test."""
    return [pytest.param(case, argument, id=f"{case.what}-{argument}") for case in cases for argument in case.bad]


def good_calls(cases: Iterable[Case]) -> list[Any]:
    """The calls with nothing bad in them."""
    return [pytest.param(case, id=case.what) for case in cases]


def refusal(case: Case, argument: str, value: Any) -> str:
    """ "" where the value is refused by an error of the package that names something, else what happens."""
    try:
        case.call(**{**case.good, argument: value})
    except (ModelError, ProblemError) as error:
        return "" if error.name and isinstance(error.name, str) else f"names nothing: {error}"
    except Exception as error:
        return repr(error)
    return "is taken"


def assert_refused(case: Case, argument: str) -> None:
    """Each bad value of the argument ends in an error of the package that names something."""
    by_name = {label: refusal(case, argument, value) for label, value in case.bad[argument].items()}
    assert {label: word for label, word in by_name.items() if word} == {}
