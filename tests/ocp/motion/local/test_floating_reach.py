"""How far a machine reaches whose base floats: no farther than where its centre of mass stays."""

from typing import Any

import numpy as np
import pytest

from models import FreeFloating, Joint, Link, Robot
from ocp import Limits, TipTask, Unreachable
from ocp.motion.search.reduced import check_floating_reach


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_floating_arm_reaches_as_far_as_its_centre_of_mass_allows(share: float) -> None:
    """A base of 2 kg, its joint 0.3 m off; a rod of 1 kg, 0.6 m long: stretched, the centre of all is 0.2 m from the
    base's and 0.7 m from the tip, in whichever direction.
    """
    base = Link("base", 2.0, inertia=0.02 * np.eye(3))
    rod = Link("rod", 1.0, (0.3, 0.0, 0.0), np.diag([1e-4, 0.03, 0.03]))
    joint = Joint("turn", "revolute", "base", "rod", (0.3, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    machine = FreeFloating(Robot((base, rod), (joint,), tip_translation=(0.6, 0.0, 0.0)))
    home = np.asarray(machine.base_home(), dtype=float)
    centre = (2.0 * np.zeros(3) + np.array([0.3 + 0.3 * np.cos(1.0), 0.3 * np.sin(1.0), 0.0])) / 3
    task = TipTask(position=centre + share * 0.7 * np.array([0.0, 0.6, 0.8]))
    bounds = Limits().bounds(machine)._replace(lower=np.array([-np.pi]), upper=np.array([np.pi]))
    options: dict[str, Any] = {"interval": (0.0, 1.0), "bounds": bounds}
    if share < 1:
        check_floating_reach(machine, [task], home, np.array([1.0]), **options)
        return
    with pytest.raises(Unreachable) as caught:
        check_floating_reach(machine, [task], home, np.array([1.0]), **options)
    assert 0.07 / np.sqrt(3) <= caught.value.pose_error <= 0.07  # the largest entry of a miss of 0.07 m
