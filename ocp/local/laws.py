"""Laws that give the joint accelerations of a standing machine at an instant (Yoo et al. 2004), blind to the future.

Each builds q'' task by task: what a task needs is done with the least accelerations that leave the earlier tasks
alone, (20), (22), (26), (33)-(34) corrected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

import casadi as ca
import numpy as np

from models.machines.standing import External, Standing, wrenches_at
from models.robot.indices import joint_limit_index, manipulability_of
from models.robot.motion import center_of_mass_motion, momentum
from ocp.errors import ProblemError, checked_choice, checked_nonnegative
from ocp.local.rates import least_rates
from ocp.tasks.equations import TaskEquations
from ocp.tasks.zmp_rules import is_finite

__all__ = ["Law", "Layer", "Stabiliser", "accelerations", "checked_law"]

Law: TypeAlias = Literal["pseudo_inverse", "augmented", "null_space", "stabilised"]


@dataclass(frozen=True)
class Layer:
    """A posture index that spare freedom drives, below the task and the zero moment point.

    Attributes:
        index: ``joint_limits``, p1 (23), to be kept small; ``manipulability`` of the tasks' rows, p2 (27), to be kept
            large.
        demand: What is asked: negative makes p1 fall, positive makes p2 grow.
        form: ``assigned``: the second derivative of the index is the demand, (25)-(26), (29)-(33); takes one degree of
            freedom, and accelerations without bound where the index cannot be changed. ``gradient``: demand times the
            projected gradient; bounded, takes all that is left.
    """

    index: Literal["joint_limits", "manipulability"]
    demand: float
    form: Literal["assigned", "gradient"] = "assigned"

    def __post_init__(self) -> None:
        checked_choice("layer: index", self.index, ("joint_limits", "manipulability"))
        checked_choice("layer: form", self.form, ("assigned", "gradient"))
        if not is_finite(self.demand):
            words = f"layer {self.index!r}: demand must be a number, not {self.demand!r}"
            raise ProblemError(words, name="demand", value=self.demand)


@dataclass(frozen=True)
class Stabiliser:
    """Gains of the law that keeps the inverted pendulum over a pinned zero moment point upright.

    The centre of mass is commanded y'' = -k2 y' - k1 (y - y*) + k0 L, with L the moment of momentum about the point,
    which obeys dL/dt = -M g (y - y*): the characteristic polynomial is s^3 + k2 s^2 + k1 s + k0 M g.

    Attributes:
        poles: Minus its roots, three positive numbers, 1/s.
        damping: Of the joint velocities in the freedom that is left, 1/s.
        gradient: Of the joint-limit index p1 in the freedom that is left, 1/s^2.
    """

    poles: tuple[float, float, float] = (4.0, 4.0, 4.0)
    damping: float = 2.0
    gradient: float = 0.0

    def __post_init__(self) -> None:
        poles = self.poles if isinstance(self.poles, Sequence | np.ndarray) else ()
        if len(poles[:4]) != 3 or not all(is_finite(pole) and pole > 0 for pole in poles):
            words = f"stabiliser: poles must be three positive numbers, not {self.poles!r}"
            raise ProblemError(words, name="poles", value=self.poles, limit=0.0)
        for what in ("damping", "gradient"):
            checked_nonnegative(f"stabiliser: {what}", getattr(self, what))


class _Stack:
    """Joint accelerations built task by task, each in the null space of those before."""

    def __init__(self, size: int) -> None:
        self.accelerations: Any = ca.DM.zeros(size)
        self.free: Any = ca.DM.eye(size)

    def do(self, rows: Any, wanted: Any) -> None:
        """Make rows q'' = wanted with the least change."""
        within = ca.mtimes(rows, self.free)
        inverse = least_rates(within, ca.DM.eye(rows.shape[0]))
        self.accelerations = self.accelerations + ca.mtimes(inverse, wanted - ca.mtimes(rows, self.accelerations))
        self.free = self.free - ca.mtimes(inverse, within)

    def push(self, direction: Any) -> None:
        """Add a vector in the freedom that is left."""
        self.accelerations = self.accelerations + ca.mtimes(self.free, direction)


def checked_law(machine: Standing, size: int, law: Law, layers: Sequence[Layer], damping: float) -> None:
    """Raise ProblemError for an unknown law, or one that asks for more than the machine has joints.

    Args:
        size: Rows of all tasks.
    """
    checked_choice("law", law, get_args(Law))
    checked_nonnegative("null_damping", damping)
    if not isinstance(layers, list | tuple) or not all(isinstance(layer, Layer) for layer in layers):
        raise ProblemError(f"layers must be a list of Layer(...), not {layers!r}", name="layers", value=layers)
    axes = len(machine.moving_directions)
    tasks = {"the tip": size, "the zero moment point": 0 if law == "pseudo_inverse" else axes}
    tasks |= {"the centre of mass": axes if law == "stabilised" else 0}
    tasks |= {"the assigned layers": sum(layer.form == "assigned" for layer in layers)}
    needed, size = sum(tasks.values()), machine.joint_size
    if needed > size:
        asked = ", ".join(f"{count} for {what}" for what, count in tasks.items() if count)
        words = f"law {law!r} needs {needed} joints ({asked}), there are {size}"
        raise ProblemError(words, name="law", value=needed, limit=size)


def accelerations(
    machine: Standing,
    equations: TaskEquations,
    law: Law,
    time: Any,
    q: Any,
    qd: Any,
    *,
    zmp: Callable[[Any], Any],
    external: External | None = None,
    layers: Sequence[Layer] = (),
    stabiliser: Stabiliser | None = None,
    null_damping: float = 0.0,
) -> Any:
    """Joint accelerations of a law. Shape (n, 1).

    Args:
        equations: What the tips do.
        law: ``pseudo_inverse``: the tasks alone. ``augmented``: tasks and zero moment point together, (20).
            ``null_space``: the zero moment point in the null space of the tasks, (21)-(22). ``stabilised``: as
            augmented, with the centre of mass commanded in their null space.
        time, q, qd: Symbols of one kind.
        zmp: Where the zero moment point is to be, (x, y) of the time, m, in the directions in which motion moves it.
        layers: Applied in this order after the law.
        null_damping: Of the joint velocities in the freedom that is left at last, 1/s.
    """
    directions, none = ca.DM(machine.moving_directions), ca.DM(0, 1)
    wrenches = wrenches_at(external, time, machine.tip_pose((), q).position)
    jacobian = equations.jacobian(none, q)
    task = -equations.acceleration(none, q, qd, ca.DM(machine.joint_size, 1), time)
    place = zmp(time)
    zmp_rows = machine.zmp_rows(q, qd, place, wrenches)
    balance, needed = ca.mtimes(directions, zmp_rows.jacobian), ca.mtimes(directions, zmp_rows.needed(qd))

    stack = _Stack(machine.joint_size)
    if law in ("pseudo_inverse", "null_space"):
        stack.do(jacobian, task)
    if law == "null_space":
        stack.do(balance, needed)
    if law in ("augmented", "stabilised"):
        stack.do(ca.vertcat(jacobian, balance), ca.vertcat(task, needed))
    for layer in layers:
        _apply(layer, stack, _index(layer, machine, jacobian, q), q, qd)
    if law == "stabilised":
        gains = stabiliser or Stabiliser()
        stack.do(*_upright(machine, gains, q, qd, place, zmp_rows.right))
        stack.push(-gains.damping * qd - gains.gradient * ca.gradient(joint_limit_index(machine.robot, q), q))
    if null_damping:
        stack.push(-null_damping * qd)
    return stack.accelerations


def _index(layer: Layer, machine: Standing, jacobian: Any, q: Any) -> Any:
    if layer.index == "joint_limits":
        return joint_limit_index(machine.robot, q)
    return manipulability_of(jacobian)


def _apply(layer: Layer, stack: _Stack, index: Any, q: Any, qd: Any) -> None:
    slope = ca.jacobian(index, q)
    if layer.form == "gradient":
        stack.push(layer.demand * slope.T)
    else:
        stack.do(slope, layer.demand - ca.jtimes(ca.mtimes(slope, qd), q, qd))


def _upright(machine: Standing, gains: Stabiliser, q: Any, qd: Any, place: Any, right: Any) -> tuple[Any, Any]:
    """Rows and values of the commanded acceleration of the centre of mass.

    `right` is C of (18), minus the moment of weight and wrenches over the place: it vanishes for a centre of mass
    at y*, and C / (M g) is how far the centre of mass is beyond y*, with its sign turned.
    """
    a, b, c = gains.poles
    k2, k1, k0 = a + b + c, a * b + b * c + c * a, a * b * c / machine.weight
    rest = ca.DM.zeros(machine.joint_size)
    motion = center_of_mass_motion(machine.robot, q, qd, rest, machine.world_from_base())
    rows = ca.jacobian(motion.position, q)[:2, :]
    about = ca.vertcat(place, 0)
    spin = momentum(machine.robot, q, qd, about, machine.world_from_base())
    lean = ca.vertcat(-spin[1], spin[0])  # grows with the fall towards -x, -y
    wanted = -k2 * motion.velocity[:2] + k1 * right / machine.weight + k0 * lean - motion.acceleration[:2]
    directions = ca.DM(machine.moving_directions)
    return ca.mtimes(directions, rows), ca.mtimes(directions, wanted)
