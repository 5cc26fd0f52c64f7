"""What is drawn is what was planned; what is printed is short; what a notebook shows stands alone."""

from __future__ import annotations

import csv
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from models import FixedBase, Joint, Robot, planar_chain
from ocp import (
    Collocation,
    Limits,
    Phases,
    Problem,
    ProblemError,
    Solution,
    TipTask,
    certificate,
    minimum_velocity_problem,
    plan,
    resolve,
    solve,
)
from ocp.app.check.joint_limits import Fault, Motion
from ocp.app.view.animation import animate_plan
from ocp.app.view.appearance import COMPARED, FAULT, LIMIT, PLAN
from ocp.app.view.report import draw_curves
from ocp.motion.local.rates import LocalSolution
from ocp.motion.plan import Candidate, Reason, Rejection
from ocp.motion.result.candidate import Stage
from ocp.motion.result.path_plan import PathPlan
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.motion.search.lengths import PathLength
from ocp.motion.search.shortening import PathPoses

START = np.array([0.3, 0.7, 0.5])
TASK = TipTask(rows=(3, 4), velocity=(-0.1, 0.05))


@cache
def arm() -> FixedBase:
    """Three joints, the first near a limit of its velocity and far from those of its position."""
    chain = planar_chain([0.5, 0.4, 0.3], [1.0, 1.0, 1.0])

    def limited(joint: Joint) -> Joint:
        return replace(joint, lower=-6.0, upper=6.0, velocity=0.6) if joint.moves else joint

    return FixedBase(Robot(chain.links, tuple(map(limited, chain.joints)), tip=chain.tip, name="three bars"))


@cache
def motion() -> SolvedPlan:
    result = plan(arm(), TASK, 1.0, start=START)
    assert isinstance(result, SolvedPlan)
    return result


@cache
def local() -> LocalSolution:
    return resolve(arm(), TASK, 1.0, start=START)


@cache
def sprint() -> Solution:
    problem = Problem("sprint")
    q, v = problem.state("q", 2, initial=0.0, terminal=1.0, unit="m"), problem.state("v", 2, initial=0.0, terminal=0.0)
    u = problem.control("u", 2, lower=-10.0, upper=6.5)
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    problem.horizon(1.0)
    problem.minimize(u.T @ u / 2)
    return solve(problem, Collocation(intervals=4, degree=3))


def curves(ax: Any, color: str) -> list[Any]:
    return [line for line in ax.lines if to_hex(line.get_color()) == color.lower()]


def test_the_curves_of_a_plan_are_its_joints_and_their_derivatives() -> None:
    axes = motion().plot().axes
    assert len(axes) == 9
    for number, ax in enumerate(axes):
        joint, kind = divmod(number, 3)
        (line,) = curves(ax, PLAN)
        assert not curves(ax, COMPARED)
        times, values = line.get_data()
        assert (times[0], times[-1]) == (0.0, motion().horizon)
        sampled = motion().sampled(times)
        wanted = (sampled.joints, sampled.rates, sampled.accelerations)[kind][:, joint]
        np.testing.assert_allclose(values, wanted, atol=1e-4 * max(1e-3, np.abs(wanted).max()))


def test_near_limits_are_lines_and_far_ones_words_and_both_the_robots() -> None:
    for number, ax in enumerate(motion().plot().axes):
        matches = [text.get_text() for text in ax.texts]
        at = sorted(line.get_ydata()[0] for line in curves(ax, LIMIT))
        if number % 3 == 0:
            assert not at
            assert matches == ["limits -6, 6"]
        elif number % 3 == 2:
            assert not at
            assert not matches  # the robot tells none of accelerations
        else:
            far = [
                float(word)
                for text in matches
                for word in text.removeprefix("limits ").removeprefix("limit ").split(", ")
            ]
            assert sorted([*at, *far]) == [-0.6, 0.6]
            low, high = ax.get_ylim()
            assert all(low < one < high for one in at)
            assert all(not low < one < high for one in far)


def test_limits_that_are_stated_are_drawn_where_they_are_tighter_than_the_robots() -> None:
    """In a figure, in a report and in a page; and again after the plan is read from its file."""
    stated = Limits(velocity=[0.3, 0.9, 0.5], acceleration=[2.0, np.inf, 4.0])
    result = plan(arm(), TASK, 1.0, start=motion().at(0.5)["joints"], limits=stated)
    assert isinstance(result, SolvedPlan)
    bounds = result.joint_bounds
    np.testing.assert_array_equal(bounds.velocity, [0.3, 0.6, 0.5])
    np.testing.assert_array_equal(bounds.acceleration, [2.0, np.inf, 4.0])
    np.testing.assert_array_equal(bounds.upper, 6.0)
    words = [" ".join(text.get_text() for text in ax.texts) for ax in result.plot().axes]
    lines = [[line.get_ydata()[0] for line in curves(ax, LIMIT)] for ax in result.plot().axes]
    for joint, most in enumerate(bounds.velocity):
        assert f"{most:g}" in words[3 * joint + 1] or most in lines[3 * joint + 1]
    assert "2" in words[2] or 2.0 in lines[2]
    assert not words[5]
    assert not lines[5]
    shown = {curve.name: curve.upper for curve in animate_plan(result).curves if curve.group == "Joint velocities"}
    assert list(shown.values()) == [0.3, 0.6, 0.5]


def test_the_compared_motion_is_orange_and_costs_more() -> None:
    figure = motion().plot({"pseudo-inverse": local()})
    for joint, ax in enumerate(figure.axes[::3]):
        (line,) = curves(ax, COMPARED)
        times, values = line.get_data()
        wanted = [local().at(time)["joints"][joint] for time in times]
        np.testing.assert_allclose(values, wanted, atol=1e-6)
    assert f"that of pseudo-inverse {local().cost[-1]:.4g}" in figure.get_suptitle()
    assert local().cost[-1] >= motion().cost * (1 - 1e-6)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["plan", "pseudo-inverse"]


def test_everything_that_moves_the_same_joints_is_compared() -> None:
    others = [motion(), motion().trajectory(0.02), local()]
    for ax in motion().plot(others).axes:
        assert len(curves(ax, COMPARED)) == len(others)


def test_a_compared_motion_may_have_the_name_of_the_plan() -> None:
    first = motion().plot({"plan": local()}).axes[0]
    assert len(curves(first, PLAN)) == len(curves(first, COMPARED)) == 1


def test_a_plan_is_drawn_into_a_passed_figure() -> None:
    mine = Figure()
    assert motion().plot(figure=mine) is mine
    assert len(mine.axes) == 9


def test_the_curves_of_a_solution_are_its_states_and_controls_with_their_bounds() -> None:
    axes = sprint().plot().axes
    assert [ax.get_title() for ax in axes] == [f"{name} [{k}]" for name in ("q", "v", "u") for k in range(2)]
    assert [ax.get_ylabel() for ax in axes] == ["m", "m", "", "", "", ""]
    for number, ax in enumerate(axes):
        (line,) = curves(ax, PLAN)
        times, values = line.get_data()
        name, k = "qvu"[number // 2], number % 2
        np.testing.assert_array_equal(values, sprint().at(np.clip(times, 0.0, 1.0))[name][:, k])
        at = sorted(line.get_ydata()[0] for line in curves(ax, LIMIT))
        assert at == ([-10.0, 6.5] if name == "u" else [])  # u goes from 6 to -6


def test_phases_are_drawn_at_their_times() -> None:
    def leg(**place: Any) -> Problem:
        problem = Problem("leg")
        x, u = problem.state("x", **place), problem.control("u")
        problem.dynamics(x, u)
        problem.horizon(2.0)
        problem.minimize(running=u**2)
        return problem

    both = Phases("way", {"there": leg(initial=0.0, terminal=1.0), "back": leg(terminal=0.0)})
    both.join("there", "back")
    axes = {ax.get_title(): ax for ax in solve(both, Collocation(intervals=3, degree=2)).plot().axes}
    for name, ends, values in (("there.x", (0.0, 2.0), (0.0, 1.0)), ("back.x", (2.0, 4.0), (1.0, 0.0))):
        (line,) = curves(axes[name], PLAN)
        times, result = line.get_data()
        np.testing.assert_allclose((times[0], times[-1]), ends)
        np.testing.assert_allclose((result[0], result[-1]), values, atol=1e-7)


def test_a_solution_without_its_problem_is_drawn_without_bounds_and_beside_another() -> None:
    bare = sprint().with_problem(None)
    for ax in bare.plot([sprint(), sprint()]).axes:
        assert not curves(ax, LIMIT)
        assert len(curves(ax, COMPARED)) == 2


def test_a_solution_is_compared_with_the_pseudo_inverse_in_common_quantities() -> None:
    problem = minimum_velocity_problem(arm(), tasks=TASK, start=START, horizon=1.0)
    solution = solve(problem, Collocation(intervals=8, degree=3))
    figure = solution.plot(local())
    assert f"that of the other {local().cost[-1]:.6g}" in figure.get_suptitle()
    for ax in figure.axes:
        name, k = ax.get_title()[:-1].split(" [")
        (line,) = curves(ax, COMPARED)
        wanted = {"joints": local().joints, "rates": local().joint_rates}[name][:, int(k)]
        np.testing.assert_array_equal(line.get_data(), [local().t, wanted])
    with pytest.raises(ProblemError, match="has"):
        sprint().plot(local())


@pytest.mark.parametrize("wrong", [3, "plan", object(), [None], {"one": 2.0}])
def test_incomparable_motions_are_refused_by_name(wrong: Any) -> None:
    for one in (motion(), sprint()):
        with pytest.raises(ProblemError) as caught:
            one.plot(wrong)
        assert caught.value.name


def test_motions_of_other_joints_are_refused() -> None:
    other = plan(FixedBase(planar_chain([0.5, 0.4], [1.0, 1.0])), TASK, 0.5, start=START[:2])
    for wrong in (other, other.trajectory(0.1)):
        with pytest.raises(ProblemError, match="joints") as caught:
            motion().plot(wrong)
        assert caught.value.name == "against"
    with pytest.raises(ProblemError, match="the solution has"):
        sprint().plot(motion().solution)


@pytest.mark.parametrize("wrong", [3, "a.png", object()])
def test_only_an_empty_figure_is_drawn_into(wrong: Any) -> None:
    full = Figure()
    full.subplots()
    for figure in (wrong, full):
        with pytest.raises(ProblemError, match="figure"):
            motion().plot(figure=figure)


@pytest.mark.long
def test_notebook_output_is_one_valid_element_without_requests() -> None:
    for shown in (motion()._repr_html_(), sprint()._repr_html_(), sprint().plot()._repr_svg_()):
        root = ElementTree.fromstring(shown)
        assert "svg" in shown
        request = [value for one in root.iter() for key, value in one.attrib.items() if key.endswith(("href", "src"))]
        assert all(value.startswith("#") for value in request)
    assert motion().audit().sentence in "".join(ElementTree.fromstring(motion()._repr_html_()).itertext())


# ---- print -----------------------------------------------------------------------------------------------------------


def test_a_plan_of_many_candidates_is_printed_in_fifteen_lines_that_count_every_one() -> None:
    kept = motion().candidates[0]
    for reasons in (1, 12, 13, 14, 60):
        others = [Candidate(START, 2.0 + k, Reason(Rejection.AUDIT, f"row {k % reasons}")) for k in range(180)]
        report = str(replace(motion(), candidates=(kept, *others))).splitlines()
        assert len(report) == min(2 + reasons, 15)
        assert report[0].endswith("1 of 181 motions solved")
        counts = [int(line.split(" motions: ")[0].split()[-1]) for line in report if " motions: " in line]
        more = [int(line.split()[0]) for line in report if "more" in line]
        alone = [line for line in report[1:] if " motions: " not in line and "more" not in line]
        assert sum(counts) + sum(more) + len(alone) == 181


def test_costs_of_motions_that_are_not_solved_to_the_end_are_printed_as_estimates() -> None:
    plan = motion()
    for stage in (Stage.SEED, Stage.COARSE, Stage.FINE):
        other = Candidate(START, 0.5 * plan.cost, Reason(Rejection.INFEASIBLE, "lost"), stage)
        first, second = str(replace(plan, candidates=(plan.candidates[0], other))).splitlines()[1:]
        assert "about" not in first
        assert ("about" in second) == (stage < Stage.FINE)
        same = replace(other, reason=Reason(Rejection.DUPLICATE))
        line = str(replace(plan, candidates=(plan.candidates[0], same))).splitlines()[2]
        assert line.split()[0] == "-"  # an estimate says nothing about a motion that is known


def test_failed_solutions_are_printed_without_cost() -> None:
    lost = [Candidate(START, cost, Reason(Rejection.INFEASIBLE, "lost")) for cost in (np.nan, 3.0, np.nan, 4.5)]
    report = str(replace(motion(), candidates=(motion().candidates[0], *lost)))
    assert "3 to 4.5" in report
    assert "4 motions: the solver found no motion: lost" in report
    assert str(replace(motion(), candidates=tuple(lost[:1]))).splitlines()[1].split()[0] == "-"


def test_errors_at_a_prompt_take_one_line() -> None:
    poses = PathPoses(np.zeros((400, 3)), np.zeros((400, 3, 3)), np.ones(3))
    path = PathPlan(arm(), np.zeros((400, 3)), Limits(), None, poses, PathLength(np.ones(3)), bound=1.9)
    audit = sprint().audit()
    results: list[Any] = [
        motion(),
        motion().candidates[0],
        motion().sample(0.1),
        local(),
        path,
        motion().trajectory(0.1),
    ]
    results += [
        sprint(),
        sprint().state_interpolant,
        audit,
        certificate(sprint().problem, [sprint(), sprint()]),
        arm().robot,
    ]
    for one in results:
        assert len(repr(one).splitlines()) == 1, one
        assert len(repr(one)) < 250, one
    assert len(str(sprint()).splitlines()) == 4
    assert f"{sprint().cost:.10g}" in str(sprint())
    assert "passed" in repr(audit)


# ---- tables ------------------------------------------------------------------------------------------------


def test_the_table_of_a_plan_is_its_file(tmp_path: Path) -> None:
    motion().write_csv(tmp_path / "a.csv", 0.03)
    with (tmp_path / "a.csv").open(encoding="utf-8") as stream:
        head, *rows = csv.reader(stream)
    table = motion().table(0.03)
    assert list(table) == head
    np.testing.assert_array_equal(np.array(rows, dtype=float), np.column_stack([*table.values()]))


def test_the_table_of_a_solution_has_a_column_for_every_entry() -> None:
    table = sprint().table()
    assert list(table) == ["time", "q[0]", "q[1]", "v[0]", "v[1]", "u[0]", "u[1]"]
    assert {len(column) for column in table.values()} == {len(sprint().t)}
    np.testing.assert_array_equal(table["v[1]"], sprint()["v"][:, 1])


def test_curves_of_a_report_pass_through_the_motion_in_the_scale_of_their_axes() -> None:
    t = np.linspace(2.0, 5.0, 31)
    moving = Motion(t, np.sin(t)[:, None], np.cos(t)[:, None])
    free = np.array([np.inf])
    bounds = Limits().bounds(arm())._replace(lower=np.array([-1.2]), upper=np.array([40.0]), velocity=free)
    fault = Fault("velocity", "a<b", "too fast", time=3.5)
    root = ElementTree.fromstring(draw_curves(moving, bounds, names=["a<b"], units=["rad"], faults=[fault]))
    tag = "{http://www.w3.org/2000/svg}"
    diagrams = root.findall(f"{tag}g")
    assert len(diagrams) == 3
    for diagram, kind in zip(diagrams, ("position", "velocity", "acceleration"), strict=True):
        texts = diagram.findall(f"{tag}text")
        rows = [(float(one.attrib["y"]) - 3, float(str(one.text))) for one in texts if one.attrib.get("x") == "-5"]
        marks = [one for one in texts if one.attrib.get("y") == "106"]
        columns = [(float(one.attrib["x"]), float(str(one.text))) for one in marks]
        assert 3 <= len(rows) <= 8
        value_of, time_of = (
            np.poly1d(np.polyfit([place for place, _ in one], [value for _, value in one], 1))
            for one in (rows, columns)
        )
        paths = {one.attrib.get("style", "")[7:14]: one.attrib["d"] for one in diagram.findall(f"{tag}path")}
        points = np.array([one.split() for one in paths[PLAN][1:].split("L")], dtype=float)
        quantity = moving.quantity(kind)
        assert quantity is not None
        curve = quantity.pieces.at(np.clip(time_of(points[:, 0]), 2.0, 5.0))[:, 0]
        np.testing.assert_allclose(value_of(points[:, 1]), curve, atol=0.02 * np.ptp(curve))
        words = " ".join(str(one.text) for one in texts)
        assert ("a<b" in words) == (kind == "position")
        assert ("limit 40" in words) == (kind == "position")
        if kind == "position":
            assert value_of(float(paths[LIMIT].split()[1].partition("H")[0])) == pytest.approx(-1.2, abs=0.02)
        if kind == "velocity":
            assert time_of(float(paths[FAULT][1:].split()[0])) == pytest.approx(3.5, abs=0.01)
        assert (FAULT in paths) == (kind == "velocity")
