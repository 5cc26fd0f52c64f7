"""The standing machine of Yoo et al. 2004: its two tasks, the local laws it compares and what becomes of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import STANDING_STARTS, Standing, standing_example
from models.machines.machine import Wrenches
from models.machines.standing import StandingMotion, tip_spring
from ocp import AccelerationOptions, TipTask, resolve_accelerations
from ocp.motion.builders.standing.problem import motion_cost
from ocp.motion.local.accelerations import Law, Layer, Stabiliser
from scripts.papers.run import Row
from scripts.papers.standing.printed import printed_law

__all__ = [
    "ASSUMED",
    "CHOSEN",
    "HORIZON",
    "LOCAL",
    "NOTE",
    "ROWS",
    "STIFFNESS",
    "Local",
    "fails",
    "layer_rows",
    "local_motions",
    "machine",
    "spring",
    "stabiliser_rows",
    "table_task",
]

Array: TypeAlias = NDArray[np.float64]

ROWS = (4, 5)  # the tip's y and z
HORIZON = 2 * np.pi  # s, printed
STIFFNESS = 150.0  # N/m, printed
JOINT_LIMIT_DEMAND = -0.1  # delta1 (25), 1/s^2; chosen
MANIPULABILITY_DEMAND = 0.05  # delta2 (29), m^2/s^2; chosen
DAMPING = 2.0  # 1/s, of the damped pseudo-inverse; chosen

ASSUMED = (
    "Not printed in the paper: centres of mass at mid-link, slender rods, a massless foot, the ankle at the origin, "
    "joint limits 30..120, 0..165, 190..360, 135..360, 0..150 deg, angles relative to the link before. "
    "Foot -0.1..0.2 m (from the text), index of half-width 0.1 m about 0 (from the tables)"
)
CHOSEN = f"Layers: p1'' = {JOINT_LIMIT_DEMAND:g} 1/s², p2'' = {MANIPULABILITY_DEMAND:g} m²/s² (chosen, not printed)"
STABILISER = Stabiliser()
GAINS = (
    f"Stabilised law (not of the paper): poles {STABILISER.poles[0]:g}, {STABILISER.poles[1]:g}, "
    f"{STABILISER.poles[2]:g} 1/s, damping {STABILISER.damping:g} 1/s, gain of p1 {STABILISER.gradient:g} 1/s² "
    "(left open by the reference), as in stabiliser.csv"
)
NOTE = f"{ASSUMED}."

REASONS = {
    "stands": "stands to the end",
    "tips": "tips: zero moment point leaves the foot",
    "joint_limit": "stands, but leaves its joint limits",
    "lift_off": "lifts off: the ground would have to pull",
    "divergence": "diverges: a joint is faster than 20 rad/s",
    "breakdown": "breaks down: no finite accelerations",
}


@dataclass(frozen=True)
class Case:
    """A local law on one of the tasks.

    Attributes:
        table: 1 or 2. title: For the reader. law: The law.
        options: Options of resolve_accelerations.
        spring: Whether the spring pulls at the tip. printed: Whether (22) is taken with the sign that is printed.
    """

    table: int
    title: str
    law: Law = "pseudo_inverse"
    options: AccelerationOptions = field(default_factory=AccelerationOptions)
    spring: bool = False
    printed: bool = False


@dataclass(frozen=True)
class Local:
    """What a local law does.

    Attributes:
        case: What was run.
        motion: Up to where it fails first on the ground or breaks down, else to the horizon.
        shown: The same carried on past the lift-off until it diverges, as if the foot were fastened.
        cost: Of the motion as far as it goes, in the cost of the plans.
        tip_error: Greatest distance of the tip from its path, m.
        reason, time: Why it is no success and from when, s; "stands" and the horizon where it is one.
        diverges: When a joint passes 20 rad/s in `shown`, s; None if it never does.
    """

    case: Case
    motion: StandingMotion
    shown: StandingMotion
    cost: float
    tip_error: float
    reason: str
    time: float
    diverges: float | None

    @property
    def words(self) -> str:
        """The verdict in words."""
        if self.reason == "stands":
            return REASONS["stands"]
        start, *rest = REASONS[self.reason].split(":")
        return f"{start} at {self.time:.3f} s" + (f" ({rest[0].strip()})" if rest else "")


JOINT_LIMITS = Layer("joint_limits", JOINT_LIMIT_DEMAND)
MANIPULABILITY = Layer("manipulability", MANIPULABILITY_DEMAND)


def _augmented(table: int, title: str, *layers: Layer, spring: bool = False) -> Case:
    return Case(table, title, "augmented", AccelerationOptions(layers=layers), spring=spring)


LOCAL: Mapping[str, Mapping[str, Case]] = {
    "table1": {
        "pseudo_inverse": Case(1, "pseudo-inverse"),
        "damped": Case(1, "pseudo-inverse, damped null space", options=AccelerationOptions(null_damping=DAMPING)),
        "augmented": _augmented(1, "ZMP pinned, augmented (20)"),
        "null_space": Case(1, "ZMP pinned, null space (22)", "null_space"),
        "as_printed": Case(1, "(22) with the sign of C as printed", printed=True),
        "joint_limits": _augmented(1, "ZMP and joint limits", JOINT_LIMITS),
        "manipulability": _augmented(1, "ZMP and manipulability", MANIPULABILITY),
        "all_layers": _augmented(1, "ZMP, joint limits, manipulability", JOINT_LIMITS, MANIPULABILITY),
        "stabilised": Case(1, "ZMP pinned, stabilised", "stabilised", AccelerationOptions(stabiliser=STABILISER)),
    },
    "table2": {
        "pseudo_inverse": Case(2, "pseudo-inverse, no spring"),
        "pseudo_inverse_spring": Case(2, "pseudo-inverse, spring", spring=True),
        "augmented_spring": _augmented(2, "ZMP pinned, augmented, spring", spring=True),
        "stabilised_spring": Case(
            2, "ZMP pinned, stabilised, spring", "stabilised", AccelerationOptions(stabiliser=STABILISER), spring=True
        ),
    },
}
"""Local laws by summary key."""


@cache
def machine() -> Standing:
    """The five-link machine of the paper."""
    return standing_example()


def start_tip(table: int) -> Array:
    """Where the tip starts. Shape (3,), m."""
    return np.array(ca.DM(machine().tip_pose((), STANDING_STARTS[table]).position)).ravel()


def led(position: Callable[[Any], list[Any]]) -> TipTask:
    """The tip on a path (y, z), without feedback, as in the paper."""
    return TipTask(position=position, rows=ROWS, gain=0.0)


def table_task(table: int) -> TipTask:
    """zdot = 0.4 sin t (Table 1) or ydot = 0.2 sin t (Table 2), the other coordinate held."""
    _, y, z = start_tip(table)
    if table == 1:
        return led(lambda t: [y, z + 0.4 * (1 - ca.cos(t))])
    return led(lambda t: [y + 0.2 * (1 - ca.cos(t)), z])


def spring() -> Wrenches:
    """Along y, relaxed where the tip of Table 2 starts."""
    return tip_spring(machine(), (0, STIFFNESS, 0), start_tip(2))


def run_case(case: Case) -> Local:
    """Simulate one law."""
    task, start = table_task(case.table), STANDING_STARTS[case.table]
    if case.printed:
        motion, gap = printed_law(machine(), task, start, HORIZON)
        return Local(case, motion, motion, motion_cost(motion), gap, *fails(motion), None)
    wrenches = spring() if case.spring else ()

    def run(options: AccelerationOptions) -> Any:
        return resolve_accelerations(
            machine(), task, HORIZON, start=start, law=case.law, wrenches=wrenches, options=options
        )

    completed = run(case.options)
    beyond = run(replace(case.options, stop_at_lift_off=False)) if completed.stopped else completed
    reason, time = fails(completed.motion)
    if completed.stopped is not None and (completed.stopped.time <= time or reason == "joint_limit"):
        reason, time = completed.stopped.reason, completed.stopped.time
    return Local(
        case,
        completed.motion,
        beyond.motion,
        motion_cost(completed.motion),
        float(completed.tip_error.max()),
        reason,
        time,
        beyond.stopped.time if beyond.stopped else None,
    )


def fails(motion: StandingMotion) -> tuple[str, float]:
    """Why a motion that is carried out is no success, and from when, s; ("stands", its end) where it is one.

    What the ground cannot bear comes before joint limits, whenever it happens.
    """
    for reason, wrong in (
        ("lift_off", motion.ground_force[:, 2] <= 0),
        ("tips", motion.foot_margin < 0),
        ("joint_limit", motion.joint_excess > 1e-6),
    ):
        if wrong.any():
            return reason, float(motion.t[wrong][0])
    return "stands", float(motion.t[-1])


def local_motions() -> dict[str, dict[str, Local]]:
    """All laws of LOCAL."""
    return {task: {key: run_case(case) for key, case in cases.items()} for task, cases in LOCAL.items()}


def layer_rows() -> list[Row]:
    """Layers of other demands and forms on Table 1: whether any of them keeps the pinned machine from falling."""
    trials: list[tuple[Layer, ...]] = [()]
    trials += [(Layer("joint_limits", demand),) for demand in (0.0, -0.03, -0.1, -0.3, -1.0)]
    trials += [(Layer("manipulability", demand),) for demand in (0.0, 0.05, 0.2, 1.0)]
    trials += [(Layer("joint_limits", gain, "gradient"),) for gain in (-1.0, -10.0)]
    trials += [(Layer("manipulability", gain, "gradient"),) for gain in (1.0, 10.0)]
    trials += [
        (Layer("joint_limits", first), Layer("manipulability", second))
        for first, second in ((0.0, 0.0), (-0.1, 0.05), (-0.3, 0.2))
    ]
    rows: list[Row] = []
    for layers in trials:
        result = run_case(_augmented(1, "", *layers))
        rows.append(
            {
                "layers": "; ".join(f"{one.index} {one.form} {one.demand:g}" for one in layers) or "none",
                "reason": result.reason,
                "time_s": result.time,
                "diverges_s": "never" if result.diverges is None else result.diverges,
                "index_min": float(result.motion.index.min()),
            }
        )
    return rows


def stabiliser_rows() -> list[Row]:
    """The stabilised law on Table 1 with other gains: shown because the reference leaves one open, never chosen by."""
    rows: list[Row] = []
    for pole in (3.0, 3.5, 4.0, 5.0):
        for gain in (0.0, 1.0, 2.0):
            chosen = Stabiliser((pole, pole, pole), gradient=gain)
            result = run_case(Case(1, "", "stabilised", AccelerationOptions(stabiliser=chosen)))
            motion = result.motion
            rows.append(
                {
                    "poles_1_s": pole,
                    "damping_1_s": chosen.damping,
                    "p1_gain_1_s2": gain,
                    "reason": result.reason,
                    "cost": result.cost,
                    "index_min": float(motion.index.min()),
                    "peak_joint_velocity_rad_s": float(np.abs(motion.joint_velocities).max()),
                    "peak_joint_acceleration_rad_s2": float(np.abs(motion.joint_accelerations).max()),
                    "vertical_force_min_n": float(motion.ground_force[:, 2].min()),
                    "used": chosen == STABILISER,
                }
            )
    return rows
