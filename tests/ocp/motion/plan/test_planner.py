"""Plans of two slides, one on the other, whose optima are known in closed form, by each of the searches."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from models import FixedBase, Joint, Link, Robot
from models.examples import paper_example
from ocp import Candidate, Cost, Limits, Plan, SolveError, TipTask, Unreachable, plan
from ocp.motion.plan import planner
from ocp.motion.plan.candidate_solver import CandidateSolver
from ocp.motion.plan.planner import PlanOptions, checked_request
from ocp.motion.result.candidate import Reason, Rejection
from ocp.motion.search.configurations import local_motions_from

SPEED, SECONDS, MOST = 0.4, 1.0, 0.5
ALONG = TipTask(velocity=(SPEED,), rows=(3,))


def slides(velocity: float = 2.0) -> FixedBase:
    """Along x, 0 to 0.5 m each."""
    by_name: dict[str, Any] = {"axis": (1.0, 0.0, 0.0), "lower": 0.0, "upper": MOST, "velocity": velocity}
    ends = (("one", "a", "b"), ("two", "b", "c"))
    joints = tuple(Joint(name, "prismatic", parent, child, **by_name) for name, parent, child in ends)
    return FixedBase(Robot((Link("a"), Link("b"), Link("c")), joints))


def placed(metres: float) -> TipTask:
    """From 0.2 m on by so much in the time, wherever the slides are."""
    return TipTask(position=lambda time: [0.2 + metres / SECONDS * time, 0.0, 0.0], rows=(3,))


def moved(start: Any = (0.1, 0.2), **request: Any) -> Plan:
    result = plan(slides(), ALONG, SECONDS, start=start, **request)
    assert result.audit().passed
    return result


@pytest.mark.parametrize("weights", [(1.0, 1.0), (1.0, 3.0), (0.5, 0.3)])
def test_each_slide_moves_by_its_share_of_the_weights(weights: tuple[float, float]) -> None:
    """Least sum of w q'^2 / 2 with q1' + q2' = v: q' in inverse proportion to w, cost v^2 / 2 over the sum of 1 / w."""
    result, inverse = moved(cost=Cost(weights=weights)), 1 / np.array(weights)
    assert result.cost == pytest.approx(SPEED**2 * SECONDS / 2 / inverse.sum(), rel=1e-7)
    np.testing.assert_allclose(result["rates"], np.tile(SPEED * inverse / inverse.sum(), (len(result.t), 1)), atol=1e-6)


def test_a_slide_near_its_end_goes_as_far_as_it_may_at_a_steady_rate() -> None:
    result = moved((0.1, 0.45))
    np.testing.assert_allclose(result["joints"][-1], [0.45, MOST], atol=1e-6)
    assert result.cost == pytest.approx(((SPEED - 0.05) ** 2 + 0.05**2) / 2, rel=1e-6)


def test_a_limit_of_velocity_leaves_the_rest_to_the_other() -> None:
    result = moved(cost=Cost(weights=(1.0, 3.0)), limits=Limits(velocity=[0.25, 2.0]))
    np.testing.assert_allclose(result["rates"][:, 0], 0.25, atol=1e-6)
    assert result.cost == pytest.approx((0.25**2 + 3 * 0.15**2) / 2, rel=1e-6)


@pytest.mark.parametrize("search", ["start", "configurations", "global"])
def test_every_search_finds_the_least_cost_from_wherever_the_place_leaves_it(search: Any) -> None:
    result = plan(slides(), placed(SPEED * SECONDS), SECONDS, search=search)
    assert result.audit().passed
    assert result.cost == pytest.approx(SPEED**2 * SECONDS / 4, rel=1e-6)
    assert result["joints"].sum(axis=1) == pytest.approx(0.2 + SPEED * result.t, abs=1e-6)
    if search == "global":
        assert result.bound is not None
        assert 0.95 * result.cost < result.bound <= result.cost * (1 + 1e-9)


def test_samples_are_as_many_as_periods_fit_each_at_its_own_time() -> None:
    result = moved()
    for count in (1, 3, 7, 10, 49, 1000):
        sample = result.sample(SECONDS / count)
        assert len(sample.t) == count + 1
        assert (np.diff(sample.t) > 0.5 * SECONDS / count).all()
        assert sample.t[-1] == SECONDS
    assert len(result.sample(0.3).t) == 5


def test_unreachable_tasks_are_reported_with_a_time() -> None:
    """Stretched the slides reach 1 m, at 2 / 3 of the way to 1.4 m."""
    with pytest.raises(Unreachable) as caught:
        plan(slides(), placed(1.2), SECONDS)
    assert caught.value.time is not None
    assert 2 / 3 < caught.value.time <= SECONDS
    with pytest.raises(SolveError, match=r"misses its task by .* m, with '(one|two)' at its limit 0.5 m") as refused:
        plan(slides(), ALONG, 3.0, start=(0.1, 0.2))
    assert (refused.value.limit, refused.value.time) == (pytest.approx(0.5), pytest.approx(3.0))


def test_of_each_run_of_a_cell_search_the_motions_of_lowest_cost_are_tried_in_turns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """If all fail, a few of each run at a time, and no more than failures are allowed; the others are reported."""
    machine, task, start = paper_example(), TipTask(velocity=[-1.0, -1.0], rows=[3, 4], duration=1.0), [0.8, 1.0, -1.0]
    request = checked_request(machine, task, None, PlanOptions(start=start))
    most, batch = request.settings.max_failures, request.settings.batch
    (local,) = local_motions_from(request, np.array([start]))
    sizes = (most // 2 - 1, most + 3, most - 1, most)
    costs = [np.arange(100.0, 100.0 + size) + 100 * run for run, size in enumerate(sizes)]
    runs = [[replace(local.take(np.zeros(len(cost), dtype=np.intp)), cost=cost[::-1])] for cost in costs]
    tried = list[float]()

    class KnownRuns:
        def __init__(self, *_: Any) -> None: ...

        def local_motions(self) -> Any:
            return runs

    def fails(solver: CandidateSolver, candidate: Candidate) -> list[Candidate]:
        tried.append(candidate.cost)
        return [candidate.with_rejection(Reason(Rejection.AUDIT, "fails"))]

    monkeypatch.setattr(planner, "CellSearch", KnownRuns)
    monkeypatch.setattr(CandidateSolver, "advance", fails)
    with pytest.raises(SolveError, match=rf"3 of \d+ candidates: not tried: the {most} lowest-cost motions"):
        plan(machine, task, start=start, scene=False)
    turns = [each[begin : begin + batch] for begin in range(0, most, batch) for each in costs]
    assert tried[1:] == np.concatenate(turns).tolist()  # after the local motion
