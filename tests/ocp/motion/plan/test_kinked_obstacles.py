"""Plans beside an obstacle whose motion has a kink: no visit of the arm, however short, passes as proven."""

from __future__ import annotations

from typing import Any

import casadi as ca
import pytest

from models import MovingObstacle, Path, Sphere, smooth
from ocp import Scene, SolveError, TipTask, plan
from tests.ocp.motion.tasks.space_tasks import ur5


@pytest.mark.long
@pytest.mark.parametrize("half", [pytest.param(0.03, marks=pytest.mark.long), 0.1])
def test_a_ball_that_darts_through_the_forearm_is_no_proven_clearance(half: float) -> None:
    """It comes and goes at constant speed within 60 or 200 ms, for as long as its height is 1 of its way."""

    def position(time: Any) -> Any:
        away = ca.fabs(time - 4.03)
        return ca.vertcat(0.4, 0, 0.3 + 0.6 * ca.if_else(away < half, away / half, 1))

    seam = smooth(Path.through([(0.4, -0.2, 0.3), (0.4, 0.2, 0.3)]), deviation=0.002)
    task = TipTask.along(seam, 0.05, steady=True, direction=(0, 0, -1))
    with pytest.raises(SolveError, match=r"obstacle 0"):
        plan(ur5(), task, scene=Scene(obstacles=[MovingObstacle(Sphere(0.05, (0, 0, 0)), position)]), search="start")
