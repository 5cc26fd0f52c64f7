"""Plans in Rerun: every joint and the tip, at the times of the sample."""

from __future__ import annotations

import numpy as np
import pytest

from ocp import ProblemError
from ocp.app.files import log_rerun
from tests.ocp.app.files.recorder import recorder
from tests.ocp.app.files.test_mcap import motion


def test_rerun_receives_every_joint_and_the_path_of_the_tip() -> None:
    module = recorder()
    log_rerun(motion(), module, 0.05, entity="arm")
    sample = motion().sample(0.05)
    kinds = {"position": sample.joints, "velocity": sample.rates, "acceleration": sample.accelerations}
    wanted = {f"arm/{kind}/{name}" for kind in kinds for name in motion().names}
    assert set(module.noted) == wanted | {"arm/tip", "arm/tip_path"}
    for kind, values in kinds.items():
        for name, column in zip(motion().names, values.T, strict=True):
            ((timeline, times),), columns = module.noted[f"arm/{kind}/{name}"]
            assert timeline == "time"
            np.testing.assert_array_equal(times, sample.t)
            np.testing.assert_array_equal(columns["scalars"], column)
    np.testing.assert_array_equal(module.noted["arm/tip_path"][0], sample.tip[:, :3])


def test_modules_that_lack_functions_of_rerun_are_refused_by_name() -> None:
    with pytest.raises(ProblemError, match="send_columns"):
        log_rerun(motion(), object())
