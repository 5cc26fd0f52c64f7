"""Tasks that are faster than the joints could ever be are refused at once, and no others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, Path, planar_chain, smooth
from ocp import Limits, ProblemError, TipTask
from ocp.motion.plan import plan
from ocp.motion.tasks.checks import check_speed
from ocp.motion.tasks.equations import bind
from tests.models.robot.trees import Array, numeric
from tests.ocp.motion.plan.motions import DOWN, angled_ur5
from tests.ocp.motion.tasks.space_tasks import panda

MACHINES: dict[str, Callable[[], FixedBase]] = {
    "panda": panda,
    "ur5": angled_ur5,
    "chain": lambda: FixedBase(planar_chain([1.0, 0.8, 0.6], [1.0] * 3)),
}
ROWS = {"panda": range(6), "ur5": range(6), "chain": (2, 3, 4)}


def twist(machine: FixedBase, joints: Array, rates: Array) -> Array:
    return numeric(machine.tip_twist((), joints, rates)).ravel()


@pytest.mark.parametrize("name", MACHINES)
def test_every_speed_of_a_configuration_is_admitted(name: str) -> None:
    """Random postures and rates at their limits: what the tip does then may be asked for, as a velocity or a line."""
    machine, rng = MACHINES[name](), np.random.default_rng(1)
    most = rng.uniform(0.1, 2.0, size=machine.joint_size)
    for _ in range(200):
        joints, rates = rng.uniform(-np.pi, np.pi, size=len(most)), most * rng.choice([-1, 1], size=len(most))
        moving = twist(machine, joints, rates)
        for rows in ([row for row in ROWS[name] if row > 2], [row for row in ROWS[name] if row < 3]):
            check_speed(bind(machine, TipTask(velocity=moving[rows], rows=rows)), most, 0.0, 1.0)
        place = TipTask(position=line(moving[3:]), rows=(3, 4))
        check_speed(bind(machine, place), most, 0.0, 1.0)


def line(velocity: Array) -> Any:
    return lambda t: ca.DM(velocity) * t


def test_a_stretched_arm_that_turns_is_the_fastest() -> None:
    """All joints at their limits the same way: the bound is reached, and a hair beyond it is refused."""
    machine = MACHINES["chain"]()
    most = np.array([1.0, 2.0, 3.0])
    fastest = float(np.linalg.norm(twist(machine, np.zeros(3), most)[3:]))
    assert fastest == pytest.approx(2.4 + 2 * 1.4 + 3 * 0.6)
    for share, refused in ((0.999, False), (1.001, True)):
        for task in (
            TipTask(velocity=[0.0, share * fastest], rows=(3, 4)),
            TipTask(position=line(np.array([share * fastest, 0.0, 0.0])), rows=(3, 4)),
        ):
            request = bind(machine, task)
            if not refused:
                check_speed(request, most, 0.0, 1.0)
                continue
            with pytest.raises(ProblemError, match="slower") as caught:
                check_speed(request, most, 0.0, 1.0)
            assert caught.value.value == pytest.approx(share * fastest)
            assert caught.value.limit == pytest.approx(fastest)
            assert caught.value.name == machine.robot.tip_link


@pytest.mark.parametrize(
    "turn",
    [
        TipTask(velocity=[0.0, 0.0, 7.0], rows=(0, 1, 2)),
        TipTask(orientation=lambda t: ca.vertcat(ca.cos(3.5 * t), 0, 0, ca.sin(3.5 * t))),
        TipTask(direction=lambda t: ca.vertcat(ca.cos(7 * t), ca.sin(7 * t), 0)),
    ],
    ids=["velocity", "orientation", "direction"],
)
def test_a_tool_turns_no_faster_than_all_joints_together(turn: TipTask) -> None:
    """7 rad/s by six or seven joints."""
    for machine in (panda(), angled_ur5()):
        n = machine.joint_size
        check_speed(bind(machine, turn), np.full(n, 7.01 / n), 0.0, 1.0)
        with pytest.raises(ProblemError, match="rad/s") as caught:
            check_speed(bind(machine, turn), np.full(n, 6.99 / n), 0.0, 1.0)
        assert caught.value.value == pytest.approx(7.0)


def test_a_plan_whose_rates_cannot_suffice_is_refused_before_anything_is_searched() -> None:
    path = smooth(Path.through([(0.45, -0.1, 0.25), (0.45, 0.1, 0.25)]), deviation=0.004)
    with pytest.raises(ProblemError, match=r"0\.5 m/s") as caught:
        plan(
            angled_ur5(),
            TipTask.along(path, 0.5, steady=True, direction=DOWN),
            limits=Limits(velocity=np.full(6, 0.05)),
        )
    assert (caught.value.name, caught.value.value) == ("tool0", pytest.approx(0.5))
