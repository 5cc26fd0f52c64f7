"""What is watched: judged by the audit at every time, held by no method."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, Joint, Link, Robot
from ocp import Collocation, MultipleShooting, Problem, ProblemError, TipTask, minimum_velocity_problem, solve
from ocp.problem.formulation import Formulation


def runner(pace: float = 1.0, length: float = 1.0, watched: bool = True, **watch: Any) -> Problem:
    """A cart asked to go at 1 length a second, held to that within half a per cent, that prefers a pace."""
    problem = Problem("runner")
    x, u = problem.state("x", initial=0.0), problem.control("u")
    problem.dynamics(x, u * length)
    problem.horizon(2.0)
    problem.path("pace", u - 1, -5e-3, 5e-3)
    if watched:
        problem.watch("way", length * (u - 1), 0, 0, **{"integral": True, "way": length * u, "unit": "m", **watch})
    problem.minimize((u - pace) ** 2)
    return problem


@pytest.mark.parametrize("length", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("method", [Collocation(5), MultipleShooting(10)], ids=["points", "held"])
def test_accumulating_errors_of_a_velocity_are_detected(length: float, method: Any) -> None:
    assert solve(runner(1.0005, length), method).audit().feasible
    audit = solve(runner(1.004, length), method).audit()
    assert {f.name for f in audit.failures if f.verdict == "feasible"} == {"way"}
    assert audit.constraints["way"] == pytest.approx(8e-3 * length, rel=1e-4)
    assert audit["way"].limit == pytest.approx(1e-3 * 2.008 * length, rel=1e-4)
    assert audit["way"].unit == "m"
    assert audit["way"].time == pytest.approx(2.0)


def test_no_method_constrains_watched_quantities() -> None:
    plain, watched = (solve(runner(1.004, watched=which), Collocation(5)) for which in (False, True))
    np.testing.assert_array_equal(plain.variables, watched.variables)
    assert len(plain.multipliers) == len(watched.multipliers)


def test_a_tolerance_by_name_is_in_the_unit_of_its_quantity() -> None:
    plan = solve(runner(1.004), Collocation(5))
    assert plan.audit(tolerances={"way": 9e-3}).feasible
    assert not plan.audit(tolerances={"way": 7e-3}).feasible


def test_watched_quantities_may_be_bounded_like_a_path() -> None:
    problem = Problem("watched")
    x, u = problem.state("x", initial=0.0, terminal=1.0), problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.watch("below", x - problem.at_start(x), upper=0.9)
    problem.minimize(u**2)
    audit = solve(problem, Collocation(4)).audit()
    assert not audit["below"].passed
    assert audit.constraints["below"] == pytest.approx(0.1)


def test_the_problem_shows_watched_quantities() -> None:
    text = str(runner())
    assert "  watch        way (1): 0 <= integral of (u-1) dt <= 0 m" in text.splitlines()
    form = Formulation(runner())
    assert form.watch.names == ("way",)
    assert form.units["way"] == "m"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"integral": 1}, "integral must be True or False"),
        ({"way": [1.0, 2.0]}, "way has 2 entries, the expression has 1"),
        ({"way": ca.SX.sym("z")}, "uses the symbol 'z'"),
    ],
)
def test_invalid_watched_quantities_are_named(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(ProblemError, match=words) as caught:
        runner(**arguments)
    assert caught.value.name == "way"


def test_a_name_is_taken_once() -> None:
    problem = runner()
    with pytest.raises(ProblemError, match="exists already"):
        problem.path("way", problem.declared.controls["u"].symbol, upper=1.0)
    with pytest.raises(ProblemError, match="neither lower nor upper"):
        problem.watch("other", problem.declared.controls["u"].symbol)


def planar() -> FixedBase:
    links, joints = [Link("base", 1.0)], []
    for i in range(3):
        links.append(Link(f"link{i}", 1.0, (0.5, 0, 0), np.diag([0.01, 0.1, 0.1])))
        joints.append(
            Joint(f"joint{i}", "revolute", links[i].name, links[i + 1].name, (min(i, 1), 0, 0), axis=(0, 0, 1))
        )
    return FixedBase(Robot(tuple(links), tuple(joints), tip_translation=(1.0, 0, 0)))


def test_the_builders_watch_where_the_tips_are() -> None:
    machine, start = planar(), [0.3, 0.8, 0.9]
    place = np.array(ca.DM(machine.tip_pose((), np.array(start)).position)).ravel()
    request: dict[str, Any] = {"start": start, "horizon": 1.0}
    moving = TipTask(position=lambda t: [place[0] - 0.1 * t, place[1]], rows=(3, 4))
    for task, names in (
        (moving, ("task position",)),
        (TipTask(velocity=[-0.1, 0.0, 0.1], rows=(2, 3, 4)), ("task displacement", "task rotation")),
    ):
        problem = minimum_velocity_problem(machine, tasks=task, **request)
        assert tuple(problem.declared.watch) == names
        audit = solve(problem, Collocation(10)).audit()
        for name in names:
            assert audit[name].passed
            assert audit[name].limit == pytest.approx(1e-4, rel=0.5)  # a thousandth of the way
