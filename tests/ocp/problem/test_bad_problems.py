"""Whatever is wrong with a declaration, a method or what is asked of a solve is refused by name."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import (
    AdaptiveCollocation,
    Collocation,
    Indirect,
    MultipleShooting,
    Phases,
    Problem,
    RefinementSettings,
    Solution,
    certificate,
    prepare,
    refine,
    solve,
    table,
    tighten,
)
from tests.bad_values import (
    CHOICE,
    COUNT,
    FINITE,
    FLAG,
    INF,
    INSTANCE,
    MAPPING,
    NAME,
    NAN,
    NONNEGATIVE,
    NOTHING,
    NUMBER,
    POSITIVE,
    SHARE,
    STRANGE,
    TEXT,
    Bad,
    Case,
    array,
    assert_refused,
    but,
    good_calls,
    method,
    panel,
)

PLAN = Collocation(4)
STRANGER = ca.SX.sym("stranger")
VALUE: Bad = but(STRANGE, "dictionary") | {
    "mapping": {"a": 1},
    "stranger": STRANGER,
    "other symbols": ca.MX.sym("x"),
    "ragged": [[1, 2], [3]],
    "empty": [],
    "truth": True,
    "huge": 10**400,
    "texts": ["1", "2"],
}
BOUND = VALUE | {"nan": NAN}
FREE = VALUE | {"inf": INF}  # nan leaves an entry free
GUESS = but(VALUE, "stranger", "other symbols") | {"nan": NAN, "inf": INF}
EXPRESSION = VALUE | NOTHING | {"nan": NAN, "inf": INF}
UNIT = TEXT | NOTHING
RESERVED: Bad = NAME | {"reserved": "time", "taken": "x"}


def blank() -> Problem:
    """A problem that is not finished: one state without dynamics, and one control."""
    problem = Problem("blank")
    problem.state("x")
    problem.control("u")
    return problem


def line() -> Problem:
    """From 0 to p in the unit of time with the least effort."""
    problem = Problem("line")
    x = problem.state("x", initial=0.0)
    u = problem.control("u", lower=-9.0, upper=9.0)
    p = problem.parameter("p")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.end("there", x - p, 0, 0)
    problem.minimize(running=u**2)
    return problem


@cache
def solved_problem() -> tuple[Problem, Solution]:
    problem = line()
    return problem, solve(problem, PLAN, parameters={"p": 1.0})


def plan() -> Solution:
    return solved_problem()[1]


@cache
def plan_of_phases() -> Solution:
    return solve(Phases("a", {"one": line()}), PLAN, parameters={"p": 1.0})


def declared() -> Problem:
    return solved_problem()[0]


def about_blank(name: str, good: dict[str, Any], /, **bad: Bad) -> Case:
    """A declaration on a problem that has the state x and the control u; "x" stands for its symbol."""

    def call(**options: Any) -> Any:
        problem = blank()
        x = problem.declared.states["x"].symbol
        return getattr(problem, name)(
            **{k: x if isinstance(v, str) and v == "the state" else v for k, v in options.items()}
        )

    return Case(f"Problem.{name}", call, good, bad)


def about_phases(name: str, good: dict[str, Any], /, **bad: Bad) -> Case:
    """What is asked of two phases."""
    return Case(
        f"Phases.{name}",
        lambda **options: getattr(Phases("a", {"one": line(), "two": line()}), name)(**options),
        good,
        bad,
    )


PHASES: Bad = MAPPING | {"no problem": {"b": 1}, "half": {"b": blank()}, "dot": {"b.c": line()}, "number": {3: line()}}
DECLARATIONS = [
    Case("Problem", Problem, {"name": "a"}, {"name": NAME, "symbols": INSTANCE}),
    about_blank(
        "state",
        {"name": "y"},
        name=RESERVED,
        size=COUNT,
        initial=FREE,
        terminal=FREE,
        lower=BOUND | {"inf": INF},
        upper=BOUND | {"minus inf": -INF},
        guess=GUESS,
        scale=but(POSITIVE, "nan") | {"of two": [1.0, 2.0]},
        unit=UNIT,
    ),
    about_blank(
        "control",
        {"name": "y"},
        name=RESERVED,
        size=COUNT,
        lower=BOUND | {"inf": INF},
        upper=BOUND | {"minus inf": -INF},
        guess=GUESS,
        unit=UNIT,
    ),
    about_blank("parameter", {"name": "y"}, name=RESERVED, size=COUNT | NOTHING),
    about_blank(
        "horizon", {"value": 1.0}, value=BOUND | NONNEGATIVE | {"zero": 0.0}, guess={"both": 1.0}, lower={"both": 0.5}
    ),
    about_blank(
        "horizon",
        {"lower": 0.5, "upper": 2.0},
        lower=BOUND | {"zero": 0.0, "negative": -1.0, "above": 3.0},
        upper=BOUND | {"negative": -1.0},
        guess=but(NUMBER, "symbol") | {"inf": INF, "outside": 9.0, "negative": -1.0},
    ),
    about_blank("at_start", {"variable": "x"}, variable=EXPRESSION | {"unknown": "y"}),
    about_blank(
        "dynamics",
        {"state": "x", "derivative": 0.0},
        state=EXPRESSION | {"unknown": "y"},
        derivative=EXPRESSION | {"two": [1.0, 2.0]},
    ),
    *[
        about_blank(
            kind,
            {"name": "y", "expression": "the state", "lower": 0.0},
            name=NAME,
            expression=EXPRESSION,
            lower=BOUND | NOTHING | {"inf": INF},
            upper=BOUND | {"minus inf": -INF, "below": -1.0},
            unit=UNIT,
        )
        for kind in ("path", "start", "end")
    ],
    about_blank(
        "watch",
        {"name": "y", "expression": "the state", "lower": 0.0},
        name=NAME,
        expression=EXPRESSION,
        lower=BOUND | NOTHING | {"inf": INF},
        upper=BOUND | {"minus inf": -INF, "below": -1.0},
        integral=FLAG,
        way=but(EXPRESSION, "None") | {"two": [1.0, 2.0]},
        unit=UNIT,
    ),
    about_blank(
        "free_parameter",
        {"name": "y"},
        name=RESERVED,
        size=COUNT,
        lower=BOUND | {"inf": INF},
        upper=BOUND | {"minus inf": -INF},
        guess=GUESS | {"function": lambda t: t},
        unit=UNIT,
    ),
    about_blank(
        "integral",
        {"name": "y", "rate": "the state", "upper": 1.0},
        name=RESERVED,
        rate=EXPRESSION,
        lower=BOUND | {"inf": INF, "above": 2.0},
        upper=BOUND | {"minus inf": -INF},
        unit=UNIT,
    ),
    Case("Phases", Phases, {"name": "a", "phases": {"b": line()}}, {"name": NAME, "phases": PHASES}),
    about_phases(
        "join",
        {"before": "one", "after": "two"},
        before=NAME | {"unknown": "three"},
        after=NAME | {"unknown": "three"},
        states=but(MAPPING, "None") | {"unknown": {"y": 0.0}, "two": {"x": [0.0, 1.0]}, "text": {"x": "x"}},
    ),
    about_phases("minimize", {"terminal": 0.0}, running={"one": 1.0}, terminal=EXPRESSION | {"two": [1.0, 2.0]}),
    about_phases("__getitem__", {"name": "one"}, name=NAME | {"unknown": "three"}),
    about_phases("of", {"phase": "one"}, phase=NAME | {"unknown": "three"}),
    about_blank("minimize", {"running": "the state"}, running=EXPRESSION | {"two": [1.0, 2.0]}, terminal=EXPRESSION),
]

MESH: Bad = STRANGE | {
    "short": (0.0, 1.0),
    "falling": (0.0, 0.5, 0.4, 0.8, 1.0),
    "nan": (0, 0.2, NAN, 0.6, 1),
    "texts": tuple("01234"),
}
METHODS = [
    Case(
        "Collocation",
        Collocation,
        {"intervals": 4},
        {
            "intervals": COUNT | NOTHING,
            "degree": COUNT | NOTHING | {"ten": 10},
            "scheme": CHOICE,
            "control": CHOICE,
            "mesh": MESH,
        },
    ),
    Case("AdaptiveCollocation", AdaptiveCollocation, {}, {"accuracy": SHARE, "max_intervals": COUNT | {"few": 2}}),
    Case(
        "table",
        table,
        {"points": np.arange(4.0), "values": np.ones(4)},
        {"points": array(4) | {"falling": [0.0, 1.0, 3.0, 2.0], "repeated": [0.0, 1.0, 1.0, 2.0]}, "values": array(4)},
    ),
    Case(
        "MultipleShooting",
        MultipleShooting,
        {"intervals": 4},
        {"intervals": COUNT | NOTHING, "integrator": CHOICE, "steps": COUNT | NOTHING, "control": CHOICE, "mesh": MESH},
    ),
    Case(
        "Indirect",
        Indirect,
        {},
        {
            "segments": COUNT | NOTHING,
            "shooting": CHOICE,
            "tolerance": SHARE | NOTHING,
            "residual": SHARE | NOTHING,
            "seed": INSTANCE,
        },
    ),
]

OPTIONS: Bad = MAPPING | {
    "unknown": {"no_such": 1},
    "wrong type": {"max_iter": "a"},
    "number": {3: 4},
    "object": {"max_iter": object()},
}
PARAMETERS: Bad = (
    MAPPING
    | NOTHING
    | {
        "unknown": {"p": 1.0, "q": 2.0},
        "missing": {},
        "two": {"p": [1.0, 2.0]},
        "word": {"p": "a"},
        "nan": {"p": NAN},
        "none": {"p": None},
        "symbol": {"p": STRANGER},
        "truth": {"p": True},
        "digits": {"p": "1"},
        "complex": {"p": 1j},
    }
)
START: Bad = {
    "word": "a",
    "number": 3,
    "list": ["a"],
    "object": object(),
    "unknown": {"y": 1.0},
    "nan": {"x": NAN},
    "text": {"x": "a"},
    "shape": {"x": np.zeros((3, 2))},
    "horizon": {"horizon": -1.0},
    "horizon of a word": {"horizon": "a"},
    "function of nothing": {"x": lambda: 0.0},
    "function that fails": {"x": lambda t: 1 / 0},
    "function of a word": {"x": lambda t: "a"},
    "times fall": {"x": np.zeros((3, 1)), "t": [0, 2, 1]},
    "times of a word": {"x": np.zeros((3, 1)), "t": "a"},
    "number as name": {3: 1.0},
}
FRONT: dict[str, Bad] = {"problem": INSTANCE | {"unfinished": blank()}, "solver": CHOICE, "options": OPTIONS}
METHOD = {name: bad for name, bad in INSTANCE.items() if bad is not None}  # without a method solve chooses one
WITHOUT_SOLVER = {name: bad for name, bad in FRONT.items() if name != "solver"}
SOLVED = {"method": PLAN, "parameters": {"p": 1.0}}


def on_line(call: Any, good: dict[str, Any], /, **bad: Bad) -> Case:
    """A call that takes the problem of a line."""
    return Case(call.__name__, lambda **options: call(**{"problem": declared(), **options}), good, bad)


FRONTS = [
    on_line(prepare, {"method": PLAN}, **FRONT, method=INSTANCE, compiled=FLAG, scaling=FLAG),
    on_line(solve, SOLVED, **FRONT, method=METHOD, parameters=PARAMETERS, guess=START, check=FLAG, time_limit=POSITIVE),
    on_line(
        refine,
        SOLVED,
        **WITHOUT_SOLVER,
        method=INSTANCE | {"indirect": Indirect()},
        parameters=PARAMETERS,
        guess=START,
        tolerance=POSITIVE | NOTHING,
        settings=INSTANCE,
        time_limit=POSITIVE,
    ),
    on_line(
        tighten,
        SOLVED,
        **WITHOUT_SOLVER,
        method=INSTANCE | {"indirect": Indirect()},
        parameters=PARAMETERS,
        guess=START,
        tolerance=POSITIVE | NOTHING,
        time_limit=POSITIVE,
    ),
    Case(
        "RefinementSettings",
        RefinementSettings,
        {},
        {"max_intervals": COUNT | NOTHING, "limits": MAPPING | {"unknown": {"no_such": 1.0}}},
    ),
    Case(
        "Indirect.prepare",
        lambda **options: Indirect().prepare(**{"problem": declared(), **options}),
        {},
        {"problem": INSTANCE | {"unfinished": blank()}, "solver": CHOICE, "options": MAPPING},
    ),
    Case(
        "certificate",
        lambda **options: certificate(**{"problem": declared(), "solutions": [plan(), plan()], **options}),
        {},
        {
            "problem": INSTANCE | {"another": blank()},
            "tolerance": POSITIVE | NOTHING,
            "solutions": INSTANCE | {"none in it": [None, None], "one": {"a": 3}, "named by numbers": {1: 2, 3: 4}},
            "second_solver": FLAG,
        },
    ),
    Case(
        "certificate by a second solver",
        lambda **options: certificate(
            **{"problem": declared(), "solutions": [plan()], "second_solver": True, **options}
        ),
        {},
        {
            "problem": INSTANCE | {"another": blank()},
            "solutions": INSTANCE | {"none in it": [None, None], "one": {"a": 3}, "named by numbers": {1: 2, 3: 4}},
        },
    ),
    method(plan, "costate", {"name": "x"}, name=NAME | {"unknown": "y"}),
    method(plan, "cost_gradient", {"name": "p"}, name=NAME | {"unknown": "q"}),
    method(plan, "__getitem__", {"name": "x"}, name=NAME | {"unknown": "y"}),
    method(plan_of_phases, "phase", {"name": "one"}, name=NAME | {"unknown": "three"}),
    method(
        plan,
        "at",
        {"time": 0.5},
        time=but(FINITE, "empty") | NOTHING | {"after": 1.1, "before": -0.1, "list of texts": ["0.1"]},
    ),
    method(
        plan,
        "at_fraction",
        {"fraction": 0.5},
        fraction=but(FINITE, "empty") | NOTHING | {"after": 1.1, "before": -0.1, "truths": [True]},
    ),
    method(
        plan,
        "audit",
        {},
        problem=but(INSTANCE, "None") | {"unfinished": blank()},
        tolerances=MAPPING | {"unknown": {"y": 1.0}, "nan": {"x": NAN}, "word": {"x": "a"}, "negative": {"x": -1.0}},
        integration=but(NONNEGATIVE, "inf", "huge") | NOTHING,
        constraints=but(NONNEGATIVE, "inf", "huge") | NOTHING,
        lost=but(NONNEGATIVE, "inf", "huge") | NOTHING,
        costates=but(NONNEGATIVE, "inf", "huge"),  # None: by what the plan loses
    ),
    method(plan, "save", {"path": "/dev/null/x"}, path={"None": None, "number": 3, "list": [], "object": object()}),
    Case(
        "Solution.load",
        Solution.load,
        {"path": "x"},
        {"path": {"None": None, "number": -3, "list": [], "object": object(), "folder": "."}},
    ),
]
CASES = [*DECLARATIONS, *METHODS, *FRONTS]


@pytest.mark.parametrize("case", good_calls(case for case in CASES if case.what not in ("plan.save", "Solution.load")))
def test_valid_values_are_accepted(case: Case) -> None:
    case.call(**case.good)


@pytest.mark.parametrize(("case", "argument"), panel(CASES))
def test_bad_input_is_refused_by_name(case: Case, argument: str) -> None:
    assert_refused(case, argument)
