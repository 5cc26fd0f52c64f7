"""Plans by search over all motions: the cheapest, with a bound."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, planar_chain
from ocp import BoundWarning, Candidate, Cost, Plan, ProblemError, TipTask, Unreachable, plan
from ocp.motion.plan.candidate_solver import CandidateSolver
from ocp.motion.result.candidate import Reason, Rejection
from ocp.motion.search.search import AtlasSearch, checked_bound
from ocp.motion.search.steps import SquaredRates
from ocp.motion.search.task_search import choose_samples
from tests.families import some
from tests.ocp.motion.search.test_charts import moved, planar
from tests.ocp.motion.tasks.space_tasks import PANDA_START, UR5_START, panda, ur5


@pytest.mark.parametrize(
    ("machine", "start", "rows"),
    [(panda(), PANDA_START, "pose"), pytest.param(ur5(), UR5_START, "axis", marks=pytest.mark.long)],
    ids=["panda", "ur5"],
)
def test_the_lowest_cost_motion_has_a_bound_near_its_cost(machine, start, rows, tmp_path) -> None:  # type: ignore[no-untyped-def]
    task = moved(machine, start, rows)
    result = plan(machine, task, search="global", scene=False)
    others = plan(machine, task, search="configurations", scene=False)
    assert result.audit().passed
    assert result.bound is not None
    assert 0.98 * result.cost <= result.bound <= result.cost
    assert result.cost <= others.cost * (1 + 1e-6)
    assert result.bound <= others.cost
    assert all(result.bound <= one.cost * (1 + 1e-4) for one in result.candidates if np.isfinite(one.cost))
    assert f"lower bound {result.bound:.6g}" in str(result)
    result.save(tmp_path / "plan.npz")
    assert Plan.load(tmp_path / "plan.npz").bound == result.bound


@pytest.mark.long
def test_from_a_fixed_start_the_bound_is_that_of_motions_from_there() -> None:
    task = moved(panda(), PANDA_START, "pose")
    result = plan(panda(), task, start=PANDA_START, search="global", scene=False)
    free = plan(panda(), task, search="global", scene=False)
    assert result.bound is not None
    assert free.cost < result.bound <= result.cost <= result.bound / 0.98
    assert result["joints"][0] == pytest.approx(PANDA_START, abs=1e-9)


@pytest.mark.long
def test_the_bound_follows_weights_and_pace() -> None:
    machine, start = planar(np.array([0.5, 0.4, 0.3])), np.array([0.5, 1.2, -1.4])
    task = moved(machine, start, "place")
    one = plan(machine, task, search="global", scene=False)
    heavy = plan(machine, task, search="global", scene=False, cost=Cost(weights=np.full(3, 5.0)))
    assert heavy.cost == pytest.approx(5 * one.cost, rel=1e-6)
    assert one.bound is not None
    assert heavy.bound == pytest.approx(5 * one.bound, rel=0.01)


def test_where_the_lowest_cost_classes_fail_all_others_are_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    machine, start = planar(np.array([0.5, 0.4, 0.3]), 2.5), np.array([0.5, 1.2, -1.4])
    request, failed = list[bool](), list[Candidate]()

    def followed(search: AtlasSearch, most: float, every: bool) -> list[np.ndarray]:
        request.append(every)
        return motions(search, most, every)

    def failing(solver: CandidateSolver, candidate: Candidate) -> list[Candidate]:
        if request[-1]:
            return advance(solver, candidate)
        failed.append(candidate)
        return [candidate.with_rejection(Reason(Rejection.AUDIT, "fails"))]

    motions, advance = AtlasSearch.class_representatives, CandidateSolver.advance
    monkeypatch.setattr(AtlasSearch, "class_representatives", followed)
    monkeypatch.setattr(CandidateSolver, "advance", failing)
    result = plan(machine, moved(machine, start, "place"), search="global", scene=False)
    assert request == [False, True]
    assert failed
    assert result.audit().passed
    assert result.bound is not None
    assert 0.98 * result.cost <= result.bound <= result.cost


def winding(lengths: list[float], start: list[float], paths: list[list[float]], seconds: float) -> Any:
    """A planar arm whose tip goes along a line, to one side of it and then to the other, and its task."""
    machine = FixedBase(planar_chain(lengths, np.ones(len(lengths))))
    first = np.array(ca.DM(machine.tip_pose((), np.array(start)).position)).ravel()[:2]

    def place(t: Any) -> Any:
        share = t / seconds
        return ca.DM(first) + share * ca.DM(paths[0]) + ca.sin(2 * np.pi * share) * ca.DM(paths[1])

    return machine, TipTask(position=place, rows=[3, 4], duration=seconds)


def test_the_motion_that_the_search_found_is_solved_where_a_coarse_mesh_loses_it() -> None:
    """Near its reach the arm whips round at last; with a free start a coarse mesh finds nothing but a dearer class."""
    paths = [[-0.6585, 0.3798], [-0.3619, 0.0052]]
    machine, task = winding([0.4428, 0.4788, 0.5695], [2.4578, -2.2448, 2.2583], paths, 3.4005)
    result = plan(machine, task, search="global", scene=False)
    assert result.audit().passed
    assert result.bound is not None
    assert result.bound <= result.cost <= 1.05 * result.bound
    held = plan(machine, task, start=result.at(0.0)["joints"], scene=False)
    assert result.cost <= held.cost * (1 + 1e-6)


def test_a_bound_above_the_cost_of_a_motion_is_no_bound_and_warned_of(monkeypatch: pytest.MonkeyPatch) -> None:
    """In use a warning, in these tests, where warnings are errors, a failure."""

    def best(search: AtlasSearch, most: float) -> tuple[np.ndarray | None, float]:
        path, bound = right(search, most)
        return path, 2 * bound

    right = AtlasSearch.solve
    machine, start = planar(np.array([0.5, 0.4, 0.3]), 2.5), np.array([0.5, 1.2, -1.4])
    task = moved(machine, start, "place")
    cost = plan(machine, task, search="global", scene=False).cost
    monkeypatch.setattr(AtlasSearch, "solve", best)
    with pytest.raises(BoundWarning):
        plan(machine, task, search="global", scene=False)
    with pytest.warns(BoundWarning, match="less than its lower bound") as caught:
        result = plan(machine, task, search="global", scene=False)
    assert result.cost == pytest.approx(cost)
    assert result.bound is None
    warning = caught[0].message
    assert isinstance(warning, BoundWarning)
    assert warning.value == result.cost < warning.limit
    with pytest.warns(BoundWarning):
        assert checked_bound(1.0, 0.9) is None
    assert checked_bound(1.0, 1.0 - 1e-12) == 1.0


def test_where_the_solution_set_is_discrete_branches_are_compared() -> None:
    task = moved(ur5(), UR5_START, "pose")
    result = plan(ur5(), task, search="global", scene=False)
    others = plan(ur5(), task, search="configurations", scene=False)
    assert result.cost == pytest.approx(others.cost, rel=1e-6)
    assert result.bound is not None
    assert 0.98 * result.cost <= result.bound <= result.cost


def test_unsupported_searches_are_refused() -> None:
    task = moved(panda(), PANDA_START, "pose")
    loose = TipTask(position=[0.4, 0.0, 0.4], duration=1.0)
    turning = TipTask(velocity=[0.01, 0.0, 0.0], rows=[3, 4, 5], duration=1.0)
    cases: list[tuple[FixedBase, TipTask, dict[str, Any], str]] = [
        (panda(), loose, {"search": "segments"}, "leave 4 degrees of freedom"),
        (panda(), turning, {"start": PANDA_START, "search": "global"}, "needs poses"),
        (panda(), task, {"horizon": "free", "search": "global"}, "needs a fixed horizon"),
    ]
    for machine, request, options, words in cases:
        with pytest.raises(ProblemError, match=words):
            plan(machine, request, scene=False, **options)
    with pytest.raises(Unreachable):
        plan(panda(), TipTask(position=[3.0, 0.0, 0.4], direction=[0, 0, -1], duration=1.0), search="global")


NONE = np.zeros(2, dtype=bool)
"""No joint turns without end."""


def test_time_samples_are_omitted_up_to_a_share_of_the_cost() -> None:
    t = np.linspace(0, 2, 81)
    perturbed = np.column_stack([np.abs(t - 1), np.where(t < 1, 0.0, 2 * (t - 1))])
    assert choose_samples(t, perturbed, SquaredRates(np.ones(2)), 1e-9, min_steps=2, periodic=NONE) == pytest.approx(
        [0, 1, 2]
    )
    round_way = np.column_stack([np.sin(3 * t), np.cos(3 * t)])
    weights = np.array([1.0, 1.0])

    def cost(times: np.ndarray) -> float:
        at = np.column_stack([np.sin(3 * times), np.cos(3 * times)])
        return float((weights * np.diff(at, axis=0) ** 2 / (2 * np.diff(times)[:, None])).sum())

    for share in (0.1, 0.01):
        kept = choose_samples(t, round_way, SquaredRates(weights), share, min_steps=2, periodic=NONE)
        assert cost(kept) >= (1 - share) * cost(t)
        assert len(kept) <= 2 * np.sqrt(3 * 3 * 4 / (24 * share)) + 3
    assert len(choose_samples(t, round_way, SquaredRates(weights), 0.9, min_steps=10, periodic=NONE)) == 11


def test_a_joint_without_end_turns_by_less_than_half_a_turn_in_a_step() -> None:
    """Else which way round it turned would be lost: 5 rad in steady motion."""
    t = np.linspace(0.0, 1.0, 65)
    turning = np.column_stack([5.0 * t, 0.0 * t])
    kept = choose_samples(t, turning, SquaredRates(np.ones(2)), 1e-3, min_steps=2, periodic=~NONE)
    assert np.abs(np.diff(np.interp(kept, t, turning[:, 0]))).max() <= np.pi / 2
    assert len(choose_samples(t, turning, SquaredRates(np.ones(2)), 1e-3, min_steps=2, periodic=NONE)) == 3


def line(first: np.ndarray, way: tuple[float, float], seconds: float) -> Any:
    return lambda t: ca.DM(first) + t / seconds * ca.DM(way)


@pytest.mark.parametrize("case", some(["gap", "longer than its task", "round", "cyclic"], 1))
def test_stretches_of_time_are_searched_together(case: str) -> None:
    machine, start = planar(np.array([0.5, 0.4, 0.3])), np.array([0.5, 1.2, -1.4])
    at = np.array(ca.DM(machine.tip_pose((), start).position)).ravel()[:2]
    first = TipTask(position=line(at, (0.1, -0.2), 2.0), rows=[3, 4], duration=2.0)
    later = TipTask(position=line(at - [0.2, 0.0], (0.0, 0.2), 2.0), rows=[3, 4], begin=3.0, duration=2.0)

    def circle(t: Any) -> Any:
        angle = 2 * np.pi * t / 4
        return ca.DM(at) + 0.1 * ca.vertcat(ca.cos(angle) - 1, ca.sin(angle))

    closed = TipTask(position=circle, rows=[3, 4], duration=4.0)
    tasks, more = {
        "gap": ([first, later], {}),
        "longer than its task": ([first], {"horizon": 4.0}),
        "round": ([closed], {}),
        "cyclic": ([closed], {"cyclic": True}),
    }[case]
    result = plan(machine, tasks, search="global", scene=False, **more)  # type: ignore[arg-type]
    others = plan(machine, tasks, search="configurations", scene=False, **more)  # type: ignore[arg-type]
    assert result.bound is not None
    assert result.cost <= others.cost * (1 + 1e-6)
    assert 0.97 * result.cost <= result.bound <= result.cost
