"""What is refused at the time of solving, and the exceptions themselves."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

import ocp
from ocp import AuditError, Collocation, MultipleShooting, Problem, ProblemError, RefinementWarning, SolveError, solve
from tests.ocp.problems import energy, plant, van_der_pol


def with_parameter(size: int = 1) -> Problem:
    problem = energy()
    problem.parameter("mass", size)
    return problem


def test_exceptions_are_of_the_kinds_that_callers_expect() -> None:
    assert issubclass(ProblemError, ValueError)
    assert issubclass(SolveError, RuntimeError)
    assert issubclass(AuditError, RuntimeError)
    assert issubclass(RefinementWarning, UserWarning)
    assert SolveError("x").solution is None


@pytest.mark.parametrize("kind", [ProblemError, SolveError, AuditError, RefinementWarning])
def test_exceptions_are_pickled_with_their_fields(kind: Any) -> None:
    error = kind("too fast", name="speed", value=3.0, limit=(0.0, 2.0), time=0.5)
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert str(again) == "too fast"
    assert (again.name, again.value, again.limit, again.time) == ("speed", 3.0, (0.0, 2.0), 0.5)
    assert kind("nothing").name is kind("nothing").value is kind("nothing").limit is kind("nothing").time is None


@pytest.mark.parametrize("method", [Collocation(6), MultipleShooting(6)])
def test_a_failure_carries_the_constraint_to_relax(method: Any) -> None:
    """From 0 to 1 in 1 s at 0.4/s at most: 0.6 is missing, of the end or of the speed."""
    problem, x, u = plant("too far", initial=0.0, u={"lower": -0.4, "upper": 0.4})
    problem.dynamics(x, u)
    problem.minimize(running=u**2)
    problem.end("gate", x, lower=1.0)
    with pytest.raises(SolveError) as caught:
        solve(problem, method)
    error = pickle.loads(pickle.dumps(caught.value))
    (conflict,) = error.conflicts
    assert (error.name, error.value, error.limit, error.time) == (conflict.label, conflict.amount, conflict.bound,
                                                                  conflict.time)  # fmt: skip
    assert conflict.label in ("gate", "u")
    assert error.value == pytest.approx(0.6, abs=1e-3)
    assert str(conflict) in str(error)
    assert not error.solution.success
    np.testing.assert_array_equal(error.solution["x"], caught.value.solution["x"])


@pytest.mark.parametrize(
    ("raises", "name", "value"),
    [
        (lambda p: p.state("x", lower=2.0, upper=1.0), "x", 2.0),
        (lambda p: p.state("x", initial=[3.0, 1.0], upper=2.0), "x", 3.0),
        (lambda p: p.state("x", size=0), "size", 0),
        (lambda p: p.control("u", guess=np.nan), "u", np.nan),
        (lambda p: p.horizon(-1.0), "horizon", -1.0),
        (lambda p: p.path("wall", 1.0), "wall", None),
        (lambda p: Collocation(4, 12), "degree", 12),
        (lambda p: Collocation(4, scheme="gauss"), "scheme", "gauss"),
        (lambda p: MultipleShooting(0), "intervals", 0),
        (lambda p: MultipleShooting(2, mesh=(0.0, 1.0)), "mesh", (0.0, 1.0)),
        (lambda p: solve(energy(), Collocation(2), solver="snopt"), "solver", "snopt"),
        (lambda p: solve(energy(), Collocation(2), parameters={"mass": 1.0}), "mass", "mass"),
        (lambda p: solve(with_parameter(2), Collocation(2), parameters={"mass": np.ones(3)}), "mass", 3),
        (lambda p: solve(energy(), Collocation(2)).at(2.0), "time", 2.0),
        (lambda p: solve(energy(), Collocation(2)).audit(lost=-1.0), "lost", -1.0),
        (lambda p: solve(energy(), Collocation(2)).audit(tolerances={"spin": 1.0}), "spin", "spin"),
    ],
)
def test_the_offending_name_and_value_are_fields(raises: Any, name: str, value: Any) -> None:
    with pytest.raises(ProblemError) as caught:
        raises(Problem("fields"))
    assert caught.value.name == name
    np.testing.assert_equal(caught.value.value, value)


def test_everything_public_is_there() -> None:
    for name in ocp.__all__:
        assert getattr(ocp, name).__doc__, name


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (None, r"parameter 'mass' has no value; give parameters=\{'mass': ...\}"),
        ({}, "parameter 'mass' has no value"),
        ({"mas": 1.0}, "parameter 'mas' does not exist; did you mean 'mass'"),
        ({"mass": 1.0, "q": 2.0}, "parameter 'q' does not exist"),
        ({"mass": [1.0, 2.0, 3.0]}, "parameter 'mass' has 3 entries, 2 expected"),
        ({"mass": []}, "parameter 'mass' has 0 entries, 2 expected"),
        ({"mass": np.nan}, "parameter 'mass' is not finite"),
        ({"mass": [1.0, np.inf]}, "parameter 'mass' is not finite"),
        ({"mass": None}, "parameter 'mass'"),
        ({"mass": "heavy"}, "parameter 'mass': numbers"),
        ({"mass": "1"}, "parameter 'mass': numbers"),
        ({"mass": [[1.0], [2.0, 3.0]]}, "parameter 'mass': numbers"),
        ([1.0], "parameters must be a dictionary by name"),
        ("mass", "parameters must be a dictionary by name"),
    ],
)
def test_bad_parameters_are_named(parameters: Any, message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        solve(with_parameter(2), Collocation(2), parameters=parameters)


@pytest.mark.parametrize("value", [2.0, [2.0, 2.0], (2, 2), np.array([[2.0], [2.0]]), np.float32(2.0)])
def test_parameters_of_every_kind_are_taken(value: Any) -> None:
    solution = solve(with_parameter(2), Collocation(2), parameters={"mass": value})
    np.testing.assert_array_equal(solution.parameters["mass"], [2.0, 2.0])


@pytest.mark.parametrize(
    ("problem", "method", "message"),
    [
        (None, Collocation(2), "a Problem is expected, not NoneType"),
        (Collocation(2), energy(), "a Problem is expected, not Collocation"),
        (energy(), 3, r"a method such as Collocation\(...\) is expected, not 3"),
        (energy(), Collocation, "a method such as"),
        (energy(), "radau", "a method such as"),
        (energy(), {"intervals": 3}, "a method such as"),
    ],
)
def test_wrong_arguments_are_named(problem: Any, method: Any, message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        solve(problem, method)


@pytest.mark.parametrize("options", [["max_iter"], "max_iter", 3])
def test_options_that_are_no_dictionary_are_named(options: Any) -> None:
    with pytest.raises(ProblemError, match="options must be a dictionary by name"):
        solve(energy(), Collocation(2), options=options)


@pytest.mark.parametrize("method", [Collocation(3), MultipleShooting(3)])
def test_an_unsuccessful_solution_is_returned_without_check(method: Any) -> None:
    solution = solve(van_der_pol(), method, options={"max_iter": 1}, check=False)
    assert not solution.success
    assert np.all(np.isfinite(solution["x"]))
    assert solution.t[-1] == solution.horizon
    audit = solution.audit()
    assert not audit.passed
    assert audit.optimal is not True
    assert audit.undecided.startswith("the solver says")
