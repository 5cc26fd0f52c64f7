"""Best-first search over candidates whose costs are known: the cheapest is found, and no work is wasted."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import FixedBase, planar_chain
from ocp import SolveError, TipTask, plan
from ocp.console import TimeLimitReached, time_limited
from ocp.motion.plan.candidate_queue import CandidateQueue, Solver
from ocp.motion.result.candidate import Candidate, Reason, Rejection, Seed, Stage
from ocp.motion.search.configurations import PlannerSettings

SETTINGS = PlannerSettings(max_failures=3)
FAILS = Reason(Rejection.AUDIT, "row 2", "row", 2.0, 1.0, 0.5)


class Known(Solver):
    """Motion `number` has a coarse cost, a fine one, and passes or not; candidates of one number are one motion."""

    def __init__(self, coarse: list[float], fine: list[float], passes: list[bool]) -> None:
        self.coarse, self.fine, self.passes = coarse, fine, passes
        self.done: list[tuple[int, Stage]] = []
        self.limited, self.turning = False, (0, 1)

    def advance(self, candidate: Candidate) -> list[Candidate]:
        number = int(candidate.start[0])
        self.done.append((number, candidate.stage))
        if candidate.stage is Stage.REFINED:
            return [replace(candidate, stage=Stage.AUDITED) if self.passes[number] else candidate.with_rejection(FAILS)]
        if candidate.stage is Stage.FINE:
            return [replace(candidate, stage=Stage.REFINED)]
        cost = (self.coarse if candidate.stage is Stage.SEED else self.fine)[number]
        stage = Stage.COARSE if candidate.stage is Stage.SEED else Stage.FINE
        solution: Any = SimpleNamespace(cost=cost, number=number)
        return [replace(candidate, stage=stage, cost=cost, solution=solution)]

    def same_path(self, one: Any, other: Any) -> bool:
        return bool(one.number == other.number)

    def reaches_limits(self, solution: Any) -> bool:
        return self.limited

    def plan(self, candidates: Any) -> Any:
        return candidates


def seeds(numbers: Any) -> list[Candidate]:
    return [Candidate(np.array([number]), seed=Seed(cost=1.0)) for number in numbers]


@st.composite
def motions(draw: Any) -> Known:
    count = draw(st.integers(1, 6))
    coarse = [1 + k / 100 for k in draw(st.lists(st.integers(0, 100), min_size=count, max_size=count, unique=True))]
    more = draw(st.lists(st.floats(0.0, 0.5), min_size=count, max_size=count))
    passes = draw(st.lists(st.booleans(), min_size=count, max_size=count))
    return Known(coarse, [cost + rise for cost, rise in zip(coarse, more, strict=True)], passes)


@given(motions(), st.integers(1, 2))
def test_the_plan_has_the_lowest_cost_and_no_costlier_candidate_is_solved(known: Known, times: int) -> None:
    queue = CandidateQueue(known, SETTINGS)
    count = len(known.coarse)
    queue.run(seeds([*range(count)] * times))
    assert len(queue.candidates) == times * count
    costs = [cost for cost, passes in zip(known.fine, known.passes, strict=True) if passes]
    if not costs:
        with pytest.raises(SolveError, match="candidates: fails the audit: row 2"):
            queue.plan()
        return
    best: Any = queue.plan()
    assert best[0].reason is None
    assert best[0].cost <= min(costs) * (1 + SETTINGS.same_cost)
    assert all(one.reason is not None for one in best[1:])
    audited = [number for number, stage in known.done if stage is Stage.REFINED]
    assert all(known.fine[number] <= min(costs) * (1 + SETTINGS.same_cost) for number in audited)
    assert len({*audited}) == len(audited) or not all(known.passes)


def test_where_a_motion_is_rejected_the_next_of_those_that_are_one_goes_on_in_its_place_a_few_times() -> None:
    known = Known([1.0], [1.1], [False])
    queue = CandidateQueue(known, SETTINGS)
    queue.run(seeds([0] * 10))
    assert [stage for _, stage in known.done].count(Stage.REFINED) == SETTINGS.max_failures
    kinds = [one.reason.kind for one in queue.candidates if one.reason is not None]
    assert kinds.count(Rejection.AUDIT) == SETTINGS.max_failures
    assert kinds.count(Rejection.DUPLICATE) == 10 - SETTINGS.max_failures
    with pytest.raises(SolveError, match="7 of 10 candidates: the same motion or cost"):
        queue.plan()


def test_every_requested_motion_is_reported_once_with_its_cost() -> None:
    known = Known([1.0, 1.2, 1.4, 30.0], [1.1, 1.3, 1.5, 31.0], [True] * 4)
    queue = CandidateQueue(known, PlannerSettings())
    queue.run(seeds([3, 1, 2, 0, 1]), include_costlier=True)
    result: Any = queue.plan()
    assert [one.cost for one in result if one.stage is Stage.AUDITED] == [1.1, 1.3, 1.5]
    kinds = [one.reason and one.reason.kind for one in result]
    assert kinds.count(Rejection.DUPLICATE) == 1
    assert kinds.count(Rejection.COSTLIER) == 3


def test_local_motions_that_lose_their_tasks_or_are_far_costlier_are_not_solved_where_another_is() -> None:
    known = Known([1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [True] * 3)
    first, lost, far = seeds(range(3))
    lost = replace(lost, seed=Seed(cost=0.5, tracked=False))
    far = replace(far, seed=Seed(cost=1.01 * SETTINGS.max_cost_ratio))
    queue = CandidateQueue(known, SETTINGS)
    queue.run([first, far, lost])
    assert {number for number, _ in known.done} == {0}
    kinds = {int(one.start[0]): one.reason and one.reason.kind for one in queue.candidates}
    assert kinds == {0: None, 1: Rejection.UNTRACKED, 2: Rejection.COSTLIER}
    CandidateQueue(known, SETTINGS).run([lost])
    assert (1, Stage.SEED) in known.done


def stages_of(known: Known, number: int) -> set[Stage]:
    return {stage for each, stage in known.done if each == number}


@pytest.mark.parametrize("size", [1.0, 1e3])
@pytest.mark.parametrize(("coarse", "solved"), [(1.59, True), (1.61, False)])
def test_a_coarse_cost_prunes_beyond_twice_the_error_of_the_coarse_mesh(
    size: float, coarse: float, solved: bool
) -> None:
    """The best has 1.0 on the coarse mesh and 1.2 on the fine one: twice its error is a third of its cost."""
    known = Known([size, coarse * size], [1.2 * size, 5.0 * size], [True, True])
    CandidateQueue(known, SETTINGS).run(seeds([0, 1]))
    assert (Stage.COARSE in stages_of(known, 1)) == solved


@pytest.mark.parametrize(("share", "refined"), [(0.75, False), (1.25, True)])
def test_on_the_fine_mesh_a_motion_must_cost_less_by_more_than_the_tolerance(share: float, refined: bool) -> None:
    fine = 2.0 * (1 - share * SETTINGS.same_cost)
    known = Known([1.0, 2.5], [2.0, fine], [True, True])  # the first has passed before the second is solved
    queue = CandidateQueue(known, SETTINGS)
    queue.run(seeds([0, 1]))
    assert (Stage.FINE in stages_of(known, 1)) == refined
    assert queue.cost == (fine if refined else 2.0)


@pytest.mark.parametrize(("share", "kind"), [(0.75, Rejection.DUPLICATE), (1.25, Rejection.COSTLIER)])
def test_equal_motions_are_reported_as_duplicates(share: float, kind: Rejection) -> None:
    known = Known([1.0, 1.5], [2.0, 2.0 * (1 + share * SETTINGS.same_cost)], [True, True])
    queue = CandidateQueue(known, SETTINGS)
    queue.run(seeds([0, 1]), include_costlier=True)
    result: Any = queue.plan()
    assert [one.reason and one.reason.kind for one in result] == [None, kind]
    assert Stage.FINE in stages_of(known, 1)  # which may change what it costs
    assert (Stage.REFINED in stages_of(known, 1)) == (kind is Rejection.COSTLIER)


@pytest.mark.parametrize("size", [0.5, 1.0, 1e3])
@pytest.mark.parametrize(("share", "once"), [(0.75, True), (1.25, False)])
def test_motions_of_one_coarse_cost_are_one_in_whatever_unit(size: float, share: float, once: bool) -> None:
    costs = [size, size * (1 + share * SETTINGS.same_cost)]
    known = Known(costs, [2 * size, 1.5 * size], [True, True])
    CandidateQueue(known, SETTINGS).run(seeds([0, 1]))
    assert (Stage.COARSE not in stages_of(known, 1)) == once


@pytest.mark.parametrize(("ratio", "wanted"), [(0.95, True), (1.05, False)])
def test_where_all_are_wanted_those_are_that_cost_no_more_than_so_many_times_the_best(
    ratio: float, wanted: bool
) -> None:
    costly = 2.0 * SETTINGS.max_cost_ratio * ratio
    known = Known([2.0, costly], [2.0, costly], [True, True])
    CandidateQueue(known, SETTINGS).run(seeds([0, 1]), include_costlier=True)
    assert (Stage.REFINED in stages_of(known, 1)) == wanted


def test_after_many_failures_collisions_are_not_repaired_and_clear_motions_continue() -> None:
    count = SETTINGS.max_failures
    colliding = Reason(Rejection.COLLISION, "a link and a box")

    class Colliding(Known):
        def collision(self, candidate: Candidate) -> Reason | None:
            return colliding if candidate.start[0] in (0, count) else None

    costs = [1.0 + k / 10 for k in range(count + 2)]
    known = Colliding(costs, costs, [False] * count + [True, True])
    queue = CandidateQueue(known, SETTINGS)
    queue.run(seeds(range(count + 2)))
    assert Stage.REFINED in stages_of(known, 0)  # there were none yet
    assert stages_of(known, count) == {Stage.SEED}
    reasons = {int(one.start[0]): one.reason for one in queue.candidates}
    assert reasons[count] == colliding
    assert reasons[count + 1] is None


def test_a_reason_is_read_as_it_was_written_and_not_where_it_is_damaged() -> None:
    assert Reason.of_record(FAILS.record()) == FAILS
    assert str(FAILS) == "fails the audit: row 2"
    plain = Reason(Rejection.DUPLICATE)
    assert Reason.of_record(plain.record()) == plain
    damages: list[dict[str, Any]] = [
        {"kind": "os.system"},
        {"kind": 3},
        {"value": "much"},
        {"limit": [1]},
        {"time": {}},
    ]
    for damage in damages:
        with pytest.raises((KeyError, TypeError, ValueError)):
            Reason.of_record({**FAILS.record(), **damage})
    for name in FAILS.record():
        with pytest.raises(KeyError):
            Reason.of_record({key: value for key, value in FAILS.record().items() if key != name})


def turned(number: int, turns: tuple[int, int], shift: float = 0.0) -> Candidate:
    """Candidate of a motion with its joints shifted by full turns."""
    joints = np.linspace([0.1, -0.4], [0.7, 0.2], 5)[None] + number + shift + 2 * np.pi * np.array(turns)
    local: Any = SimpleNamespace(t=np.arange(5.0), joints=joints, base=np.zeros((1, 5, 0)))
    return Candidate(np.array([number]), seed=Seed(cost=1.0, local=[local]))


@pytest.mark.parametrize(("passes", "limited", "solved"), [(True, False, 1), (True, True, 3), (False, False, 3)])
def test_seeds_that_differ_by_full_turns_are_solved_if_limits_intervene_or_the_first_fails(
    passes: bool, limited: bool, solved: int
) -> None:
    known = Known([1.0], [1.2], [passes])
    known.limited = limited
    queue = CandidateQueue(known, replace(SETTINGS, max_failures=9))
    queue.run([turned(0, turns) for turns in ((0, 0), (1, 0), (-1, 1))])
    assert known.done.count((0, Stage.SEED)) == solved
    assert len(queue.candidates) == 3
    assert queue.passed == passes
    kinds = [each.reason.kind for each in queue.candidates if each.reason is not None]
    assert kinds == ([Rejection.DUPLICATE] * 2 if passes else [Rejection.AUDIT] * 3)


def test_seeds_are_turned_by_full_turns_of_turning_joints_alone() -> None:
    first = turned(0, (0, 0)).seed
    assert first.is_turned(turned(0, (2, -1)).seed, (0, 1))
    assert first.is_turned(first, (0, 1))
    assert not first.is_turned(turned(0, (1, 0), shift=1e-6).seed, (0, 1))
    assert not first.is_turned(turned(1, (0, 0)).seed, (0, 1))
    assert not first.is_turned(replace(first, fixed=True), (0, 1))
    assert not first.is_turned(Seed(), (0, 1))
    fewer: Any = SimpleNamespace(t=np.arange(3.0), joints=np.zeros((1, 3, 2)), base=np.zeros((1, 3, 0)))
    assert not first.is_turned(Seed(local=[fewer]), (0, 1))
    assert not first.is_turned(turned(0, (2, -1)).seed, (0,))  # joint 1 has a follower, say


@pytest.mark.parametrize("seconds", [0.0, 1.0])
def test_after_the_refusal_time_the_rest_is_not_tried(seconds: float, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [1000.0]
    monkeypatch.setattr("ocp.motion.plan.candidate_queue.time.thread_time", lambda: clock[0])

    class Slow(Known):
        def advance(self, candidate: Candidate) -> list[Candidate]:
            clock[0] += seconds
            return super().advance(candidate)

    for limit in (None, 1e6):
        slow = Slow([1.0, 1.1, 1.2, 1.3], [2.0] * 4, [False] * 4)
        with time_limited(limit):
            queue = CandidateQueue(slow, replace(SETTINGS, max_failures=9, refusal_time=8.5))
            queue.run(seeds(range(4)))
        kinds = [each.reason.kind for each in queue.candidates if each.reason is not None]
        assert len(kinds) == 4
        assert Rejection.AUDIT in kinds
        assert (Rejection.NOT_TRIED in kinds) == (seconds > 0 and limit is None)  # its place is taken


@pytest.mark.parametrize("passes", [False, True])
def test_after_the_time_limit_nothing_is_solved(passes: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """What passed before is the plan; without any, the error is that of the time limit and has the others as cause."""
    clock = [1000.0]
    monkeypatch.setattr("ocp.console.time.monotonic", lambda: clock[0])

    class Slow(Known):
        def advance(self, candidate: Candidate) -> list[Candidate]:
            clock[0] += 1.0
            return super().advance(candidate)

    slow = Slow([1.0, 1.1, 1.2, 1.3], [2.0, 2.1, 2.2, 2.3], [passes] * 4)
    with time_limited(10.5):
        queue = CandidateQueue(slow, replace(SETTINGS, max_failures=9), include_costlier=True)
        queue.run(seeds(range(4)))
        assert clock[0] == 1011.0
        late = [c for c in queue.candidates if c.reason is not None and c.reason.kind is Rejection.NOT_TRIED]
        assert late
        assert all("the time limit passed" in str(c.reason) for c in late)
        if passes:
            assert queue.passed
        else:
            with pytest.raises(TimeLimitReached) as caught:
                queue.plan()
            assert isinstance(caught.value.__cause__, SolveError)


def test_a_plan_without_time_names_the_time_limit() -> None:
    task = TipTask(position=[0.9, 0.2, 0.0], rows=[3, 4], duration=1.0)
    with pytest.raises(SolveError, match="within the time limit of 1e-06 s; raise time_limit") as caught:
        plan(FixedBase(planar_chain([0.5, 0.4, 0.3], [1.0, 1.0, 1.0])), task, 1.0, time_limit=1e-6)
    assert (caught.value.name, caught.value.limit) == ("time_limit", 1e-6)
    assert {each.reason.kind for each in caught.value.candidates if each.reason} == {Rejection.NOT_TRIED}
    assert caught.value.candidates
