"""A plan that somebody changed is judged by its machine and by what it was asked, not by what else its file says."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models import Box, FixedBase, MovingObstacle, Sphere, planar_chain
from ocp import Collocation, Limits, Plan, Problem, ProblemError, Scene, StorageWarning, TipTask, plan, solve
from ocp.__main__ import main
from ocp.app.check.verdict import verdict_of
from ocp.app.view.animation import animate_plan
from ocp.app.view.report import report_of_plan
from ocp.motion.result.solved_plan import Part, SolvedPlan
from tests.ocp.motion.plan import test_path_plan, test_segmented_plan
from tests.ocp.motion.plan.motions import planned

pytestmark = pytest.mark.xdist_group("plan seam_ur5")


def swing() -> SolvedPlan:
    """A plan of a UR5 whose problem knows no limits: 9 rad in 0.1 s."""
    machine, n = planned("seam_ur5").machine, 6
    problem = Problem("fast")
    joints = problem.state("joints", n, initial=np.zeros(n), terminal=np.full(n, 9.0), unit="rad")
    rates = problem.control("rates", n, unit="rad/s")
    problem.dynamics(joints, rates)
    problem.horizon(0.1)
    problem.minimize(running=rates.T @ rates)
    solution = solve(problem, Collocation(4))
    assert solution.audit().passed
    return SolvedPlan(machine, solution, (Part(0.0, 0.1, ""),))


def test_a_problem_without_limits_does_not_excuse_a_motion_beyond_those_of_its_machine(tmp_path: Path) -> None:
    path, page = tmp_path / "fast.npz", tmp_path / "fast.html"
    swing().save(path)
    for fast in (swing(), Plan.load(path)):
        audit, verdict = fast.audit(), verdict_of(fast, fast.sample(0.01), "fast")
        assert not audit.feasible
        assert {finding.name.split(" ")[0] for finding in audit.failures} == {"joints", "rates"}
        assert audit["rates of the machine, 'shoulder_pan_joint'"].value == pytest.approx(90 - np.pi, rel=0.01)
        assert not verdict.passed
        assert verdict.sentence.startswith("must not be run")
    shown = animate_plan(fast)
    assert ("must not be run" in shown.verdict, shown.passed) == (True, False)
    assert main(["report", str(path), str(page)]) == 1
    assert main(["view", str(path), "--page", str(tmp_path / "view.html")]) in (0, 1)
    assert "may be run" not in page.read_text()


@pytest.mark.long
def test_limits_of_a_request_beyond_those_of_the_machine_are_no_licence(tmp_path: Path) -> None:
    chain = planar_chain([0.5, 0.4], [1.0, 1.0])
    slow = replace(chain, joints=tuple(replace(joint, velocity=0.2) for joint in chain.joints))
    task = TipTask(rows=(3,), velocity=(-0.3,))
    fast = plan(FixedBase(slow), task, 0.5, start=(0.6, 0.9), limits=Limits(velocity=50.0), search="start")
    assert fast.audit().passed, "the limits that were asked are held"
    fast.save(tmp_path / "fast.npz")
    again = Plan.load(tmp_path / "fast.npz")
    assert again.audit().passed
    verdict = verdict_of(again, again.sample(0.01), "fast")
    assert not verdict.passed
    assert verdict.sentence.startswith("must not be run: it breaks the limits of its machine")
    assert "may be run" not in report_of_plan(again, 0.01, "fast").html()


def test_a_changed_motion_is_audited_against_its_request(tmp_path: Path) -> None:
    path = tmp_path / "seam.npz"
    planned("seam_ur5").save(path)
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    edits: dict[str, Any] = {
        "states": {name: arrays[name] + 0.01 for name in ("states/joints", "state_interpolant/values")},
        "half a plan": {name: arrays[name] * 0.5 for name in ("states/joints", "state_interpolant/values")},
        "controls": {name: arrays[name] * 1.02 for name in ("controls/rates", "control_interpolant/values")},
    }
    for what, changes in edits.items():
        np.savez(tmp_path / "changed.npz", **{**arrays, **changes})
        assert not Plan.load(tmp_path / "changed.npz").audit().passed, what


def test_no_problem_of_the_file_takes_the_place_of_the_request(tmp_path: Path) -> None:
    """A problem that is put into the file beside the request is not the one that is audited."""
    planned("seam_ur5").save(tmp_path / "seam.npz")
    planned("seam_ur5").solution.save(tmp_path / "solution.npz")
    with np.load(tmp_path / "seam.npz") as seam, np.load(tmp_path / "solution.npz") as solution:
        arrays = {**{name: seam[name] for name in seam.files}, **{k: solution[k] for k in solution.files}}
    np.savez(tmp_path / "both.npz", **arrays)
    both = Plan.load(tmp_path / "both.npz")
    assert isinstance(both, SolvedPlan)
    assert both.request is not None
    assert both.solution.problem is not None
    assert both.solution.problem.origin is both.request


def test_obstacles_that_stand_or_move_and_the_bodies_of_meshes_are_rebuilt(tmp_path: Path) -> None:
    """The audit of a loaded plan proves the same distances, and finds what was moved into the way."""
    arm = FixedBase(planar_chain([0.5, 0.4, 0.3], [1.0] * 3))
    balls = [
        MovingObstacle(Sphere(0.05, (0, 0, 0)), lambda t: (2.0, 1.0 + 0.3 * t, 0.0)),
        Box((0.1, 0.1, 0.1), position=(0, -2, 0)),
    ]
    task = TipTask(rows=(3, 4), velocity=(-0.05, 0.02))
    result = plan(arm, task, 1.0, start=(0.3, 0.6, 0.5), scene=Scene(obstacles=balls), search="start")
    result.save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    assert str(again.audit()) == str(result.audit())


def test_a_request_with_python_callbacks_warns_when_it_is_saved(tmp_path: Path) -> None:
    import casadi as ca

    class Own(ca.Callback):  # type: ignore[misc]
        def __init__(self) -> None:
            ca.Callback.__init__(self)
            self.construct("own", {"enable_fd": True})

        def eval(self, arguments: list[Any]) -> list[Any]:
            return [arguments[0] * 0.01]

    seam = planned("seam_ur5")
    assert seam.request is not None
    own = Own()
    task = replace(seam.request.tasks[0], position=lambda time: ca.vertcat(own(time), 0, 0))
    problem = seam.solution.problem
    changed = replace(seam.request, arguments={**seam.request.arguments, "tasks": (task,)})
    kept, problem.origin = problem.origin, changed
    try:
        with pytest.warns(StorageWarning, match=r"instead of the request: .*'own' of kind CallbackInternal"):
            seam.save(tmp_path / "plan.npz")
    finally:
        problem.origin = kept
    again = Plan.load(tmp_path / "plan.npz")
    assert isinstance(again, SolvedPlan)
    assert again.request is None
    assert again.audit().passed, "its problem is in the file, and its machine's limits hold"


FORGED_PATHS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "no machine": lambda head: head["request"]["arguments"]["pool"].pop(0),
    "no limits": lambda head: head["request"]["arguments"]["pool"].pop(1),
    "limits that are none": lambda head: head["request"]["arguments"]["pool"][1].__setitem__(1, 3),
    "a scene that is none": lambda head: head["request"]["arguments"]["pool"][2].__setitem__(1, [1.0]),
    "no joints": lambda head: head.pop("joints"),
    "joints of another number": lambda head: head.update(joints=head["poses"]["rotations"]),
    "a step for none": lambda head: head["poses"].update(step=head["joints"]),
    "no positions": lambda head: head["poses"].pop("positions"),
    "poses that are a number": lambda head: head.update(poses=3),
    "a bound that is a word": lambda head: head.update(bound="low"),
    "a reconfiguration after the end": lambda head: head.update(reconfigurations=[test_path_plan.COUNT - 1]),
    "a reconfiguration before the start": lambda head: head.update(reconfigurations=[-1]),
    "reconfigurations that are a number": lambda head: head.update(reconfigurations=3),
    "a candidate of nothing": lambda head: head.update(candidates=[[]]),
}
FORGED_SEGMENTS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "no times": lambda head: head.pop("start_times"),
    "no segments": lambda head: head.update(start_times=[]),
    "a segment more": lambda head: head.update(start_times=[0.0, 1.0, 2.0]),
    "another time": lambda head: head["start_times"].__setitem__(1, 0.5),
    "times that are words": lambda head: head.update(start_times=["a", "b"]),
    "another time of the reconfiguration": lambda head: head["reconfigurations"][0].__setitem__(0, 0.5),
    "no reconfigurations": lambda head: head.update(reconfigurations=[]),
    "a reconfiguration of nothing": lambda head: head.update(reconfigurations=[[]]),
    "joints of another number": lambda head: head["reconfigurations"][0].__setitem__(1, [0.0]),
    "a number of words": lambda head: head.update(fewest="few"),
}
FORGED = {
    **{("path", what): (test_path_plan.arrays, change) for what, change in FORGED_PATHS.items()},
    **{("segments", what): (test_segmented_plan.arrays, change) for what, change in FORGED_SEGMENTS.items()},
}


@pytest.mark.parametrize(("head_name", "what"), FORGED)
def test_a_file_that_does_not_fit_together_is_refused(head_name: str, what: str, tmp_path: Path) -> None:
    arrays_of, change = FORGED[head_name, what]
    head = json.loads(arrays_of()[head_name].tobytes())
    change(head)
    forged: dict[str, Any] = {**arrays_of(), head_name: np.frombuffer(json.dumps(head).encode(), np.uint8)}
    np.savez(tmp_path / "forged.npz", **forged)
    with pytest.raises(ProblemError, match=r"forged\.npz") as refused:
        Plan.load(tmp_path / "forged.npz")
    assert refused.value.name
