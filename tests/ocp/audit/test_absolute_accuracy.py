"""A tip is where its task wants it to so many metres and radians, however long the path is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, Joint, Link, Path, Robot, smooth
from ocp import Collocation, Problem, ProblemError, Solution, TipTask, minimum_velocity_problem, solve
from tests.ocp.audit.drawn import holds

SECONDS = 10.0


def gantry(length: float) -> FixedBase:
    """Two rails along x, one on the other, and one along y: one more than the plane of the path asks for."""
    names = ["floor", "bridge", "trolley", "slide", "tool"]
    axes = [(1, 0, 0), (0, 1, 0), (1, 0, 0), (0, 0, 1)]
    joints = [
        Joint(f"rail{k}", "prismatic", names[k], names[k + 1], axis=axis, lower=-5 * length, upper=5 * length)
        for k, axis in enumerate(axes)
    ]
    return FixedBase(Robot(tuple(Link(name, mass=1.0) for name in names), tuple(joints), tip="tool"))


@cache
def along(length: float, tolerance: tuple[float, float] | None = None) -> Solution:
    """A plan along a straight path."""
    corners = np.array([(0.0, 0.0, 0.0), (1.0, 0.5, 0.0)]) * length
    path = smooth(Path.through(corners), deviation=0.05 * length)
    speed = path.length / SECONDS
    report: dict[str, Any] = {} if tolerance is None else {"tolerance": tolerance}
    task = TipTask.along(path, speed, steady=True, gain=0.0, **report)
    problem = minimum_velocity_problem(gantry(length), tasks=task, start=np.zeros(4), horizon=task.duration)
    return solve(problem, Collocation(12, 4).with_nodes_at(np.asarray(task.breaks) / task.duration))


def drifting(plan: Solution, off: float) -> Solution:
    """The same, its first rail so much farther at the end, at rates that say so."""
    changes: dict[str, Any] = {}
    for pool, curve, rates in (("states", "state_interpolant", False), ("controls", "control_interpolant", True)):
        own = getattr(plan, curve)
        name = "rates" if rates else "joints"
        at = own.breaks[:-1, None] + np.diff(own.breaks)[:, None] * own.nodes
        values, columns = own.values.copy(), list(getattr(plan, pool))
        first = sum(getattr(plan, pool)[each].shape[1] for each in columns[: columns.index(name)])
        values[:, :, first] += off / plan.horizon if rates else off * at
        by_name = {key: value.copy() for key, value in getattr(plan, pool).items()}
        by_name[name][:, 0] += off / plan.horizon if rates else off * plan.t / plan.horizon
        changes |= {pool: by_name, curve: replace(own, values=values)}
    return replace(plan, **changes)


@pytest.mark.parametrize("length", [1.0, 10.0, 100.0])
def test_a_long_path_is_followed_to_a_tenth_of_a_millimetre(length: float) -> None:
    plan = along(length)
    holds(plan.audit())
    for off in (3e-4, 9e-4 * length):
        row = drifting(plan, off).audit()["task position"]
        assert not row.passed
        assert row.value == pytest.approx(off, rel=0.05)
        assert row.limit == pytest.approx(1e-4)
    assert drifting(plan, 0.5e-4).audit()["task position"].passed


def test_reported_joints_are_those_executed() -> None:
    """Joints may deviate from their integrated rates by a thousandth of their spread, here 5 mm; the tip may not."""
    plan = along(10.0)
    curve = plan.state_interpolant
    values = curve.values.copy()
    values[5, :, 0] += 1e-3
    edited = replace(plan, state_interpolant=replace(curve, values=values))
    audit = edited.audit()
    assert audit["integration error, relative"].passed
    assert not audit["task position"].passed
    assert audit["task position"].value == pytest.approx(1e-3 / np.sqrt(1.25), rel=0.2)


@pytest.mark.parametrize("length", [1e-6, 1e-3, 1e-1])
def test_a_short_path_is_followed_to_a_thousandth_of_it(length: float) -> None:
    plan = along(length)
    holds(plan.audit())
    row = drifting(plan, 3e-3 * length).audit()["task position"]
    assert not row.passed
    assert row.limit < 2e-3 * length


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize(("off", "passes"), [(5e-4, True), (3e-3, False)])
def test_a_tolerance_goes_with_the_unit_of_length(scale: float, off: float, passes: bool) -> None:
    """A machine of 10 m, in any unit, may be off by 1 mm."""
    plan = along(10.0 * scale, (1e-3 * scale, 1e-3))
    row = drifting(plan, off * scale).audit()["task position"]
    assert row.passed == passes
    assert row.limit == pytest.approx(1e-3 * scale)


@pytest.mark.parametrize("wrong", [(0.0, 1e-3), (1e-4, -1.0), (np.nan, 1e-3), (1e-4,), 1e-4, ("a", 1), None])
def test_a_tolerance_is_two_positive_numbers(wrong: Any) -> None:
    with pytest.raises(ProblemError, match="tolerance") as caught:
        TipTask(position=(0, 0, 0), tolerance=wrong)
    assert caught.value.name == "tolerance"


def test_a_tolerance_of_the_task_is_one_of_numbers() -> None:
    assert TipTask(position=(0, 0, 0)).tolerance == (1e-4, 1e-3)
    assert TipTask(position=(0, 0, 0), tolerance=np.array([1, 2])).tolerance == (1.0, 2.0)


# ---- any constraint ----------------------------------------------------------------------------------------------


def straight(kind: str, tolerance: Any) -> Problem:
    """From 0 to 100 in 1 s, with a condition that the plan without it violates by 0.01 of 100."""
    problem = Problem("straight")
    x, u = problem.state("x", initial=0.0, terminal=100.0), problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize(running=u**2)
    both = ca.vertcat(x - 100 * problem.time, ca.sin(x))
    if kind:
        getattr(problem, kind)("row", both, [0.01, -1.0], np.inf, tolerance=tolerance)
    return problem


@pytest.mark.parametrize(("kind", "tolerance"), [("path", [5e-3, 1.0]), ("watch", 5e-3)])
def test_a_constraint_may_have_a_tolerance_of_its_own(kind: str, tolerance: Any) -> None:
    plan = solve(straight("", None), Collocation(5))
    assert plan.audit().passed
    for allowed, passes in ((None, True), (tolerance, False)):
        row = replace(plan, problem=straight(kind, allowed)).audit()["row"]
        assert row.value == pytest.approx(0.01)
        assert row.passed == passes
        assert passes or row.limit == pytest.approx(5e-3)


@pytest.mark.parametrize("wrong", [0.0, -1.0, [1.0, 1.0, 1.0], "a", np.nan])
@pytest.mark.parametrize("kind", ["path", "watch"])
def test_a_tolerance_that_is_none_is_refused(kind: str, wrong: Any) -> None:
    with pytest.raises(ProblemError, match="row"):
        straight(kind, wrong)


def test_a_tolerance_comes_back_from_a_file(tmp_path: Any) -> None:
    plan = replace(solve(straight("", None), Collocation(5)), problem=straight("watch", [5e-3, 1.0]))
    plan.save(tmp_path / "plan.npz")
    row = Solution.load(tmp_path / "plan.npz").audit()["row"]
    assert not row.passed
    assert row.limit == pytest.approx(5e-3)
