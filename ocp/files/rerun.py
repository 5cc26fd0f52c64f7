"""Plans in Rerun's viewer, by the module `rerun` that the caller gives: nothing here asks for that package."""

from __future__ import annotations

from typing import Any

import numpy as np

from ocp.errors import ProblemError, checked_instance, checked_text
from ocp.planning import Plan

__all__ = ["log_rerun"]

NEEDED = ("LineStrips3D", "Points3D", "Scalars", "TimeColumn", "log", "send_columns")
"""What is called of the module (0.23 or later)."""


def log_rerun(plan: Plan, rerun: Any, period: float = 0.01, *, entity: str = "plan", timeline: str = "time") -> None:
    """Log joints, velocities and accelerations every `period` s as scalars, and the tip as a point on its way.

    They stand under `ENTITY/position/JOINT`, `ENTITY/velocity/JOINT`, `ENTITY/acceleration/JOINT`, `ENTITY/tip` and
    `ENTITY/tip_path`, in rad or m, per s and s^2, and m in the world. What is recorded and where to is the caller's:
    `import rerun; rerun.init("seam", spawn=True); log_rerun(plan, rerun)`.

    Args:
        plan: To be shown. period: s.
        rerun: The module `rerun`, or what has its `log`, `send_columns` and archetypes.
        entity: What the paths of the entities begin with. timeline: The name of the time, from 0 s.

    Raises:
        ProblemError: No plan, a period that is not positive, or something without what is called of the module.
    """
    checked_instance("plan", plan, Plan)
    checked_text("entity", entity)
    checked_text("timeline", timeline)
    missing = [name for name in NEEDED if not callable(getattr(rerun, name, None))]
    if missing:
        words = f"the module rerun is expected (0.23 or later), not {rerun!r}, which has no {', '.join(missing)}"
        raise ProblemError(words, name="rerun", value=rerun, limit=NEEDED)
    sample = plan.sample(period)
    times = [rerun.TimeColumn(timeline, duration=sample.t)]
    kinds = {"position": sample.joints, "velocity": sample.rates, "acceleration": sample.accelerations}
    for kind, values in kinds.items():
        for name, column in zip(plan.names, values.T, strict=True):
            columns = rerun.Scalars.columns(scalars=np.ascontiguousarray(column))
            rerun.send_columns(f"{entity}/{kind}/{name}", indexes=times, columns=columns)
    if np.isfinite(sample.tip).all():
        places = np.ascontiguousarray(sample.tip[:, :3])
        rerun.log(f"{entity}/tip_path", rerun.LineStrips3D([places]), static=True)
        rerun.send_columns(f"{entity}/tip", indexes=times, columns=rerun.Points3D.columns(positions=places))
