"""Local motions from many postures at once: on their tasks, inside the limits, as cheap as what `resolve` finds."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from models import FixedBase, Machine, Path, planar_chain, smooth
from ocp import RateOptions, TipTask, inverse_kinematics, resolve
from ocp.motion.local.rates import LocalMotion, track_tasks
from ocp.motion.tasks.equations import bind
from tests.models.robot.trees import Array, numeric
from tests.ocp.motion.tasks.space_tasks import PANDA_START, floating_panda, panda, pose, ur5

DOWN = (0.0, 0.0, -1.0)
LINE = smooth(Path.through([(0.45, -0.15, 0.3), (0.45, 0.1, 0.3), (0.55, 0.15, 0.35)]), deviation=0.01)


def task(**options: Any) -> TipTask:
    return TipTask.along(LINE, 0.1, steady=True, **{"direction": DOWN, **options})


def followed(
    machine: Machine, request: TipTask, joints: Array, *, base: Any = None, steps: int = 64, **arguments: Any
) -> LocalMotion:
    robot = machine.robot
    options = {"weights": np.ones(machine.joint_size), "damping": 1e-6, "lower": robot.lower, "upper": robot.upper}
    home = machine.base_home() if base is None else base
    times = np.union1d(np.linspace(0, request.duration or 1.0, steps + 1), request.breaks)
    return track_tasks(
        bind(machine, request), joints, np.tile(home, (len(joints), 1)), times, **{**options, **arguments}
    )


def start_configurations(machine: Machine, request: TipTask, **options: Any) -> Array:
    return np.array([p.joints for p in inverse_kinematics(machine, request, seed=1, **{"starts": 12, **options})])


def test_poses_are_kept_and_joints_stay_inside_their_limits() -> None:
    for machine in (panda(), ur5()):
        result = followed(machine, task(), start_configurations(machine, task()))
        follows = result.pose_error < 1e-6
        assert follows.sum() >= len(follows) / 2
        equations = bind(machine, task())
        for joints in result.joints[follows]:
            assert np.abs(equations.errors(result.t, None, joints)).max() < 2e-6
        assert (result.joints >= machine.robot.lower).all()
        assert (result.joints <= machine.robot.upper).all()


def test_each_motion_is_the_one_that_is_followed_alone() -> None:
    """Side by side they do not know of each other."""
    starts = start_configurations(panda(), task())[:4]
    together = followed(panda(), task(), starts, damping=0.01)
    for number, start in enumerate(starts):
        alone = followed(panda(), task(), start[None], damping=0.01)
        np.testing.assert_allclose(alone.joints[0], together.joints[number], atol=1e-9)
        assert alone.cost[0] == pytest.approx(together.cost[number])
        assert alone.worst_time[0] == together.worst_time[number] or together.pose_error[number] < 1e-9


def test_the_cost_is_the_one_of_the_least_rates_at_every_time() -> None:
    """`resolve` integrates the same law with small steps; weights are those of the metric."""
    (start, *_) = [
        q for q in start_configurations(panda(), task()) if followed(panda(), task(), q[None]).pose_error[0] < 1e-6
    ]
    weights = np.array([9.0, 1, 1, 4, 1, 1, 0.5])
    result = followed(panda(), task(), start[None], steps=256, weights=weights)
    horizon = task().duration
    local = resolve(panda(), task(), horizon, start=start, samples=401, options=RateOptions(weights=weights))
    assert local.stopped is None
    effort = 0.5 * np.trapezoid((np.asarray(local.joint_rates) ** 2) @ weights, local.t)
    assert result.cost[0] == pytest.approx(effort, rel=2e-3)
    np.testing.assert_allclose(result.joints[0, -1], local.joints[-1], atol=2e-3)


def test_finer_steps_converge_to_one_motion() -> None:
    start = start_configurations(panda(), task())[:1]
    ends = [followed(panda(), task(), start, steps=steps).joints[0, -1] for steps in (32, 64, 128, 256)]
    gaps = [np.abs(a - b).max() for a, b in pairwise(ends)]
    # of second order: three quarters of the error go with each halving, where corners let them
    assert gaps[0] > 2.5 * gaps[1] > 6 * gaps[2] or gaps[0] < 1e-6


def test_rates_are_those_of_the_joints() -> None:
    start = start_configurations(panda(), task())[:2]
    result = followed(panda(), task(), start)
    moved = np.diff(result.joints, axis=1)
    np.testing.assert_allclose(result.rates[:, :-1] * np.diff(result.t)[:, None], moved, atol=1e-12)
    np.testing.assert_array_equal(result.rates[:, -1], result.rates[:, -2])
    cost = np.einsum("kmn,m->k", result.rates[:, :-1] ** 2, np.diff(result.t)) / 2
    np.testing.assert_allclose(result.cost, cost, rtol=1e-12)


def test_a_joint_at_its_limit_stays_there_and_the_others_do_the_task() -> None:
    """With a narrow range for its first joint the chain of four goes on by the three others."""
    arm = FixedBase(planar_chain([0.8, 0.6, 0.5, 0.4], [1.0] * 4))
    start = np.array([0.3, 0.5, 0.4, 0.3])
    place = numeric(arm.tip_pose((), start).position).ravel()
    line = smooth(Path.through([place, place + np.array([0.1, -0.5, 0.0])]), deviation=0.01)
    request = TipTask.along(line, 0.2, steady=True, rows=(3, 4))
    free = followed(arm, request, start[None], lower=np.full(4, -np.inf), upper=np.full(4, np.inf))
    assert free.pose_error[0] < 1e-6
    lower, upper = np.full(4, -np.inf), np.full(4, np.inf)
    moves = free.joints[0, :, 0] - start[0]
    assert np.abs(moves).max() > 0.03
    lower[0], upper[0] = start[0] - 0.02, start[0] + 0.02
    tight = followed(arm, request, start[None], lower=lower, upper=upper)
    assert tight.pose_error[0] < 1e-6
    assert (tight.joints[0, :, 0] >= lower[0]).all()
    assert (tight.joints[0, :, 0] <= upper[0]).all()
    assert np.abs(np.abs(tight.joints[0, :, 0] - start[0]) - 0.02).min() < 1e-4
    assert tight.cost[0] > free.cost[0]


def test_the_end_of_the_reach_along_a_path_is_reported() -> None:
    """A line that leaves the reach of 2.4 m after some time, and comes back."""
    arm = FixedBase(planar_chain([1.0, 0.8, 0.6], [1.0] * 3))
    line = smooth(Path.through([(1.5, -1.0, 0.0), (2.6, 0.0, 0.0), (1.5, 1.0, 0.0)]), deviation=0.01)
    request = TipTask.along(line, 0.5, steady=True, rows=(3, 4))
    result = followed(arm, request, start_configurations(arm, request, starts=4), damping=0.05)
    assert (result.pose_error > 0.1).all()
    distance = np.linalg.norm(line.at(np.clip(0.5 * result.worst_time, 0, line.length)).position, axis=1)
    assert (distance > 2.4).all()
    assert (result.pose_error >= (distance - 2.4) / np.sqrt(2)).all()  # of the larger coordinate


def test_axes_that_may_lean_are_turned_back_only_where_they_lean_too_far() -> None:
    request = task(within=0.2)
    start = start_configurations(panda(), task())[:6]
    result = followed(panda(), request, start, damping=0.01)
    free = followed(panda(), TipTask.along(LINE, 0.1, steady=True), start, damping=0.01)
    follows = (result.pose_error < 1e-5) & (free.pose_error < 1e-5)
    assert follows.any()
    equations, within = bind(panda(), task(within=1e-6)), 0.2
    for lean, loose in zip(result.joints[follows], free.joints[follows], strict=True):
        assert equations.cone_violations(result.t, None, lean).max() < within + 1e-3
        if equations.cone_violations(free.t, None, loose).max() < within - 0.01:
            np.testing.assert_allclose(lean, loose, atol=1e-6)


@pytest.mark.parametrize("momentum", [None, (0.5, -0.3, 0.4, 1.0, -2.0, 1.5)])
def test_a_floating_base_goes_where_its_momentum_says(momentum: Any) -> None:
    """As `resolve` integrates it; with momentum on board the base drifts though the joints rest."""
    machine = floating_panda(momentum)
    _, place = pose(machine, machine.base_home(), PANDA_START)
    line = smooth(Path.through([place, place + np.array([0.05, -0.08, 0.06])]), deviation=0.01)
    request = TipTask.along(line, 0.05, steady=True)
    result = followed(machine, request, PANDA_START[None], steps=256)
    local = resolve(machine, request, request.duration, start=PANDA_START, samples=257)
    assert result.pose_error[0] < 1e-6
    np.testing.assert_allclose(result.base[0, -1], local.base[-1], atol=2e-4)
    np.testing.assert_allclose(result.joints[0, -1], local.joints[-1], atol=2e-4)
    assert np.abs(result.base[0, -1] - result.base[0, 0]).max() > 1e-3


def test_diverging_motions_are_infinite_and_affect_no_other() -> None:
    start = start_configurations(panda(), task())[:2]
    bad = np.vstack([start, np.full(7, np.nan)])
    result = followed(panda(), task(), bad)
    alone = followed(panda(), task(), start)
    assert np.isinf(result.pose_error[2])
    np.testing.assert_allclose(result.joints[:2], alone.joints, atol=1e-9)
