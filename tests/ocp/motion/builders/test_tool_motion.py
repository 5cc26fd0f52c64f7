"""The horizon in stretches of the same tasks, and which joints nothing depends on."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import FixedBase, FreeFloating, Link, planar_chain
from ocp import Collocation, Limits, ProblemError, TipTask, solve
from ocp.motion.builders.dynamics import Actuation
from ocp.motion.builders.tool_motion import ToolMotionSetup, stretches_of, tool_motion_problem
from ocp.motion.tasks.checks import ignorable_joints
from ocp.motion.tasks.equations import bind
from tests.ocp.motion.tasks.space_tasks import floating_panda, panda, ur5

ARM = FixedBase(planar_chain([1.0, 0.8, 0.6], [1.0] * 3))
HORIZON = 10.0


def interval(times: tuple[float, float | None], number: int = 0) -> TipTask:
    begin, end = times
    duration = None if end is None else end - begin
    breaks = () if duration is None else np.linspace(0, duration, 4)
    return TipTask(velocity=[0.1 * number], rows=[3], begin=begin, duration=duration, breaks=breaks)


tenths = st.integers(0, 10).map(float)
intervals = st.lists(
    st.tuples(tenths, st.one_of(tenths, st.none())).filter(lambda p: p[0] < (HORIZON if p[1] is None else p[1])),
    min_size=1,
    max_size=5,
)


@given(times=intervals)
def test_stretches_tile_the_horizon_and_tasks_are_active_where_they_are(
    times: list[tuple[float, float | None]],
) -> None:
    tasks = [interval(each, number) for number, each in enumerate(times)]
    result = stretches_of(ARM, tasks, HORIZON)
    assert result[0].begin == 0.0
    assert result[-1].end == HORIZON
    assert [a.end for a in result[:-1]] == [b.begin for b in result[1:]]
    assert all(stretch.duration > 0 for stretch in result)
    assert len({stretch.suffix for stretch in result}) == len(result)
    for stretch in result:
        for t in np.linspace(stretch.begin, stretch.end, 9)[1:-1]:
            assert stretch.tasks == tuple(i for i, task in enumerate(tasks) if task.begin < t < task.end)
        assert (stretch.equations is None) == (not stretch.tasks)
        for i, new in zip(stretch.tasks, stretch.new, strict=True):
            assert new == (tasks[i].begin == stretch.begin)
        wanted = {t for i in stretch.tasks for t in tasks[i].begin + np.asarray(tasks[i].breaks)}
        inside = sorted(t for t in wanted if stretch.begin + 1e-6 < t < stretch.end - 1e-6)
        assert all(np.abs(stretch.breaks - t).min() < 1e-9 for t in inside)
        assert ((stretch.breaks > stretch.begin) & (stretch.breaks < stretch.end)).all()
    changes = [a.tasks != b.tasks or True in b.new for a, b in pairwise(result)]
    assert all(changes)


@given(shift=st.floats(-1e-9, 1e-9))
def test_times_that_differ_by_rounding_are_one(shift: float) -> None:
    tasks = [interval((0.0, 4.0)), interval((max(4.0 + shift, 0), 10.0))]
    result = stretches_of(ARM, tasks, HORIZON)
    assert [stretch.tasks for stretch in result] == [(0,), (1,)]


@pytest.mark.parametrize("times", [(0.0, 10.5), (10.0, 11.0), (12.0, None), (10.0, None)])
def test_a_task_outside_the_horizon_is_refused_by_its_number(times: Any) -> None:
    with pytest.raises(ProblemError, match="task 1") as caught:
        stretches_of(ARM, [interval((0.0, 2.0)), interval(times)], HORIZON)
    assert (caught.value.name, caught.value.limit) == ("task 1", (0.0, HORIZON))


# ---- joints on which nothing depends ---------------------------------------------------------------------------------

PLACE = np.array([0.4, 0.1, 0.5])
DOWN = (0.0, 0.0, -1.0)
FLOATING = FreeFloating(planar_chain([1.0, 0.8, 0.6], [1.0] * 3, base=Link("base", 20.0, inertia=np.eye(3))))


def joints_of(machine: Any, *tasks: TipTask) -> list[int]:
    return np.flatnonzero(ignorable_joints(bind(machine, list(tasks)), machine.base_home())).tolist()


def test_the_roll_of_a_tool_about_the_last_joint_is_ignorable() -> None:
    """The axis of the hand is that of the last joint, and the tip lies on it."""
    for machine in (panda(), ur5()):
        last = machine.joint_size - 1
        assert joints_of(machine, TipTask(position=PLACE, direction=DOWN)) == [last]
        assert joints_of(machine, TipTask(position=PLACE, direction=DOWN, within=0.2)) == [last]
        assert joints_of(machine, TipTask(position=PLACE)) == [last]
        assert joints_of(machine, TipTask(position=PLACE, orientation=(1, 0, 0, 0))) == []
        assert joints_of(machine, TipTask(position=PLACE, direction=DOWN, tool_axis=(0, 1, 1))) == []


def test_joints_beyond_the_tip_are_ignorable() -> None:
    """A task of the second link of a chain says nothing of what comes after it."""
    task = TipTask(velocity=[0.1, 0.2], rows=(3, 4), link="link2", point=(0.8, 0.0, 0.0))
    assert joints_of(ARM, task) == [2]


def test_the_first_joint_is_ignorable_for_quantities_that_rotate_with_it() -> None:
    """Rows along the tip's own axes of a planar arm, and of motion relative to its first link, do not see it."""
    own = TipTask(velocity=[0.1, 0.2], rows=(3, 4), axes="tip")
    assert joints_of(ARM, own) == [0]
    assert joints_of(ARM, TipTask(velocity=[0.1, 0.2], rows=(3, 4))) == []
    relative = TipTask(velocity=[0.1], rows=[5 - 1], relative_to="link1", axes="reference")
    assert joints_of(ARM, relative) == [0]


def test_no_joint_of_a_floating_arm_is_ignorable_that_moves_the_base() -> None:
    """The roll of the last joint turns the base, too; a chain's tip in world depends on every joint."""
    assert joints_of(floating_panda(), TipTask(position=PLACE, direction=DOWN)) == []
    assert joints_of(FLOATING, TipTask(velocity=[0.1, 0.2], rows=(3, 4))) == []


# ---- tasks held by accelerations -------------------------------------------------------------------------------------


def test_accelerations_hold_a_velocity_that_changes_in_each_stretch_of_the_time() -> None:
    """Two stretches of unequal length, so that the time of the problem is not that of the tasks."""
    machine = FixedBase(planar_chain([0.5, 0.4], [2.0, 1.5]))

    def velocity(begin: float) -> Any:
        return lambda time: ca.vertcat(-0.3 * ca.sin(2 * (begin + time)), 0.1 * (begin + time))

    tasks = [
        TipTask(velocity=velocity(0.0), rows=(3, 4), duration=0.5),
        TipTask(velocity=velocity(0.5), rows=(3, 4), begin=0.5, duration=1.0),
    ]
    motion = tool_motion_problem(
        machine,
        stretches_of(machine, tasks, 1.5),
        ToolMotionSetup(
            base=np.zeros(0),
            start=np.array([0.4, 0.9]),
            reference=np.array([0.4, 0.9]),
            cyclic=False,
            weights=np.ones(2),
            bounds=Limits(acceleration=50.0).bounds(machine),
            actuation=Actuation(),
        ),
    )
    solution = solve(motion.problem, Collocation(8), options={"max_iter": 60})
    for stretch in motion.stretches:
        fractions = np.linspace(0.0, 1.0, 9)
        sample, t = solution.at_fraction(fractions), stretch.begin + fractions * stretch.duration
        joints, rates = sample[f"joints{stretch.suffix}"], sample[f"velocities{stretch.suffix}"]
        twists = [np.array(ca.DM(machine.tip_jacobian((), q))) @ w for q, w in zip(joints, rates, strict=True)]
        wanted = np.column_stack([-0.3 * np.sin(2 * t), 0.1 * t])
        np.testing.assert_allclose(np.array(twists)[:, 3:5], wanted, atol=1e-6)
