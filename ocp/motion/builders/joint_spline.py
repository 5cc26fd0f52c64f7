"""Joints along a path from any plan, for schedule: a spline through its samples, and the torques of the machine.

The spline has degree 5, so that the third derivative by the distance, which joint jerks need, is continuous. Torques
are linear in the line's acceleration and squared speed: with joints q(s), inverse dynamics tau(q, rate, acceleration)
without gravity, and rest that of gravity alone,

    torque = tau(q, 0, q') a + tau(q, q', q'') v^2 + rest(q).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial
from typing import Any, NamedTuple, Protocol

import casadi as ca
import numpy as np

from models import FixedBase, Machine
from models.robot.dynamics import GRAVITY, inverse_dynamics
from ocp.errors import NOT_NUMBERS, ProblemError, checked_count, checked_each, checked_instance, floats
from ocp.motion.schedule import PathLike
from ocp.motion.schedule.profile import Array
from ocp.solution import Solution

__all__ = ["PlannedJoints", "joint_path"]

DEGREE = 5
DERIVATIVES = 3
ON_ROWS = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_NEG: np.negative,
    ca.OP_SQ: np.square,
    ca.OP_SQRT: np.sqrt,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_TWICE: lambda of, into: np.add(of, of, into),
}
"""Instructions that dynamics consist of, on rows of numbers: of the operands, into the last."""


@dataclass(frozen=True)
class SplineSettings:
    """How the joints of a plan are made a spline.

    Attributes:
        on_path: Share of a path's length by which tasks that run along it may be off it.
        at_once: Places whose torques are computed side by side.
    """

    on_path: float = 1e-6
    at_once: int = 1024


SPLINE = SplineSettings()


class _Along(NamedTuple):
    """Joints and three derivatives by the distance. Shape (M, n) each."""

    position: Array
    first: Array
    second: Array
    third: Array


class _Torques(NamedTuple):
    """inertia a + drag v^2 + rest. Shape (M, n) each, Nm or N."""

    inertia: Array
    drag: Array
    rest: Array


class PlanLike(Protocol):
    """What is asked of a plan of tasks: `ocp.Plan` has it."""

    @property
    def horizon(self) -> float: ...
    @property
    def targets(self) -> Sequence[Any]: ...
    def task_share(self, times: Any) -> Array: ...
    def at(self, time: Any) -> dict[str, Array]: ...


@dataclass(frozen=True, eq=False)
class PlannedJoints:
    """Joints of a machine as functions of the distance along a path. Made by `joint_path`.

    Attributes:
        machine: Whose joints.
        names: Of the joints.
        length: Of the path, m.
        error: Largest difference (rad or m) at the samples between them and a spline through every second one: more
            than the spline between them errs.
    """

    machine: Machine
    names: tuple[str, ...]
    length: float
    error: float
    curves: _Pieces
    forces: _OnRows | None

    def at(self, distance: Any) -> _Along:
        """Joints and their derivatives at distances from the start. Shape (M,), m.

        Raises:
            ProblemError: nan, or a distance off the path by more than rounding.
        """
        return _Along(*self.curves(self._checked(distance)))

    def torques(self, distance: Any) -> _Torques:
        """Torques at distances from the start, as a linear form of the line's motion. Shape (M,), m.

        Raises:
            ProblemError: A machine whose base moves; distances as in `at`.
        """
        if self.forces is None:
            message = f"torques along a path need a machine on a fixed base, not a {type(self.machine).__name__}"
            raise ProblemError(message, name="machine", value=self.machine)
        along = self.at(distance)
        return _Torques(*self.forces(along.position, along.first, along.second))

    def _checked(self, distance: Any) -> Array:
        try:
            s = np.atleast_1d(floats(distance))
        except NOT_NUMBERS as error:
            raise ProblemError(f"distance {distance!r} is not numeric", name="distance", value=distance) from error
        slack = 1e-9 * self.length
        wrong = s[~((s >= -slack) & (s <= self.length + slack))]
        if s.ndim != 1 or wrong.size:
            message = f"distance {s.ravel()[:3].tolist()} m is no row on the path, which is {self.length:g} m long"
            raise ProblemError(message, name="distance", value=distance, limit=self.length)
        return np.asarray(np.clip(s, 0.0, self.length))


def joint_path(
    machine: Machine,
    plan: PlanLike | Solution | tuple[Any, Any],
    path: PathLike,
    *,
    samples: int = 400,
    names: Sequence[str] | None = None,
) -> PlannedJoints:
    """Joints along a path from a plan that runs it at constant speed, or from samples over the distance.

    Args:
        machine: Whose joints they are.
        plan: What `plan` made of tasks that run along the path at one speed from its begin to its end, in one part or
            several, its horizon free or not; or a solution with states "joints", the path's distance in proportion to
            its time; or (distances (M,), joints (M, n)), the first distance 0 and the last the path's length.
        path: What the tool runs along.
        samples: Of a plan or a solution, evenly in time.
        names: Of the joints; the robot's if None.

    Raises:
        ProblemError: A plan without joints, or whose tasks do not run along the path at one speed; samples of other
            shapes, too few, not increasing or not from end to end.
    """
    checked_count("samples", samples, 2 * DEGREE + 3)
    for part in ("robot", "joint_size"):
        if isinstance(machine, type) or not hasattr(machine, part):
            raise ProblemError(f"{machine!r} is no machine; it has no {part}", name="machine", value=machine)
    length = getattr(path, "length", None)
    if not isinstance(length, float | int) or not length > 0:
        raise ProblemError(f"the path {path!r} has no length", name="path", value=path)
    if hasattr(plan, "task_share"):
        plan = _planned(plan, path, float(length), samples)
    s, joints = _samples(plan, float(length), samples, machine.joint_size)
    own = checked_each("joints along a path: names", machine.robot.joint_names if names is None else names, str)
    if len(own) != machine.joint_size:
        message = f"{len(own)} names for {machine.joint_size} joints"
        raise ProblemError(message, name="names", value=own, limit=machine.joint_size)
    curves = _spline(s, joints)
    half = np.arange(0, len(s), 2)
    half = half if half[-1] == len(s) - 1 else np.append(half, len(s) - 1)
    coarse = _spline(s[half], joints[half])(s)[0]
    error = float(np.abs(coarse - joints).max())
    return PlannedJoints(machine, own, float(length), error, curves, _forces(machine))


def _planned(plan: Any, path: Any, length: float, samples: int) -> tuple[Array, Array]:
    """Return distances (M,) and joints (M, n) of a plan, whose tasks are seen to run along the path at one speed."""
    if plan.targets and hasattr(path, "at"):
        t = plan.targets[0].t
        along = path.at(np.clip(length * plan.task_share(t), 0.0, length)).position
        apart = np.array([one.position - along for one in plan.targets])
        asked = np.isfinite(apart).any(axis=2)
        off = np.where(asked, np.linalg.norm(np.nan_to_num(apart), axis=2), np.inf).min(axis=0)
        worst = int(off.argmax())
        if asked.any() and not off[worst] <= SPLINE.on_path * length:
            found = f"are {off[worst]:.3g} m off the path" if off[worst] < np.inf else "ask for no position"
            words = f"the plan's tasks {found} at {t[worst]:.6g} s: they do not run along all of it at one speed; "
            words += "give (distances, joints) instead of the plan"
            told = {"value": float(off[worst]), "limit": SPLINE.on_path * length, "time": float(t[worst])}
            raise ProblemError(words, name="plan", **told)
    times = np.linspace(0.0, plan.horizon, samples)
    return length * plan.task_share(times), plan.at(times)["joints"]


def _samples(plan: Any, length: float, samples: int, size: int) -> tuple[Array, Array]:
    """Distances (M,) and joints (M, n) of a plan, checked."""
    if isinstance(plan, tuple):
        try:
            s, joints = (floats(part) for part in plan)
        except NOT_NUMBERS as error:
            raise ProblemError(f"samples are not numeric: {error}", name="plan", value=plan) from error
    else:
        checked_instance("plan", plan, Solution)
        fractions = np.linspace(0.0, 1.0, samples)
        try:
            joints = np.asarray(plan.at_fraction(fractions)["joints"], dtype=float)
        except KeyError as error:
            message = f"the plan {plan.name!r} has no states 'joints'"
            raise ProblemError(message, name="joints", value=plan.name) from error
        s = length * fractions
    if s.ndim != 1 or joints.shape != (len(s), size) or len(s) < 2 * DEGREE + 3:
        message = f"samples have shapes {s.shape} and {joints.shape}; expected (M,) and (M, {size}), M at least 13"
        raise ProblemError(message, name="plan", value=joints.shape, limit=size)
    if not (np.isfinite(s).all() and np.isfinite(joints).all()) or (np.diff(s) <= 0).any():
        raise ProblemError("samples must be finite, at increasing distances", name="plan", value=s)
    if abs(s[0]) > 1e-9 * length or abs(s[-1] - length) > 1e-9 * length:
        message = f"samples go from {s[0]:g} to {s[-1]:g} m, the path from 0 to {length:g} m"
        raise ProblemError(message, name="plan", value=(float(s[0]), float(s[-1])), limit=length)
    s = s.copy()
    s[0], s[-1] = 0.0, length
    return s, joints


class _Pieces:
    """A spline as one polynomial a piece, about its middle.

    Args:
        breaks: Where pieces meet. Shape (K + 1,), m.
        derivatives: Of order 0 to DEGREE in the middle of each piece, by `unit`. Shape (DEGREE + 1, K, n).
        unit: m.
    """

    def __init__(self, breaks: Array, derivatives: Array, unit: float) -> None:
        self.breaks, self.middle, self.unit = breaks, (breaks[:-1] + breaks[1:]) / 2, unit
        self.derivatives = np.ascontiguousarray(derivatives.transpose(1, 0, 2))
        # the k-th derivative at x from the middle is the sum of the m-th there times x^(m - k) / (m - k)!
        orders = np.arange(DEGREE + 1) - np.arange(DERIVATIVES + 1)[:, None]
        self.power = np.maximum(orders, 0)
        self.weight = np.array([[1 / factorial(m) if m >= 0 else 0.0 for m in row] for row in orders.tolist()])
        self.weight /= unit ** np.arange(DERIVATIVES + 1)[:, None]

    def __call__(self, distance: Array) -> Array:
        """Values and three derivatives at distances (M,). Shape (4, M, n)."""
        piece = np.clip(np.searchsorted(self.breaks, distance, side="right") - 1, 0, len(self.middle) - 1)
        x = (distance - self.middle[piece]) / self.unit
        powers = x[:, None] ** np.arange(DEGREE + 1)
        return np.asarray((self.weight * powers[:, self.power] @ self.derivatives[piece]).transpose(1, 0, 2))


class _OnRows:
    """A casadi SX Function of vectors at many places at once: each of its instructions works on a row of numbers."""

    def __init__(self, function: Any) -> None:
        self.sizes = [function.size1_out(k) for k in range(function.n_out())]
        # rows: the function's own memory, its inputs, its outputs, its constants
        size = [function.size1_in(k) for k in range(function.n_in())]
        seats = np.cumsum([function.sz_w(), *size, *self.sizes]).tolist()
        inputs, outputs, self.rows = seats[: len(size)], seats[len(size) : -1], seats[-1]
        self.inputs, self.outputs = slice(inputs[0], outputs[0]), slice(outputs[0], self.rows)
        self.constants: list[float] = []
        self.steps: list[tuple[Any, ...]] = []
        self.tables: list[tuple[Array, list[tuple[Any, list[Array]]]]] = []
        seat: dict[int, int] = {}  # the row of what each place of the memory holds
        for k in range(function.n_instructions()):
            kind, of, into = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
            if kind == ca.OP_INPUT:
                seat[into[0]] = inputs[of[0]] + of[1]
            elif kind == ca.OP_CONST:
                seat[into[0]] = self.rows + len(self.constants)
                self.constants.append(function.instruction_constant(k))
            elif kind == ca.OP_OUTPUT:
                self.steps.append((np.copyto, outputs[into[0]] + into[1], seat[of[0]]))
            else:
                self.steps.append((ON_ROWS[kind], *(seat[place] for place in of), into[0]))
                seat[into[0]] = into[0]

    def __call__(self, *inputs: Array) -> list[Array]:
        """Its outputs at inputs, shape (M, n) each."""
        given = np.concatenate([value.T for value in inputs])
        count = given.shape[1]
        found = np.empty((sum(self.sizes), count))
        try:
            table, steps = self.tables.pop()
        except IndexError:  # the first call, or another thread has it
            table, steps = self._table()
        for first in range(0, count, SPLINE.at_once):
            here = min(SPLINE.at_once, count - first)
            table[self.inputs, :here] = given[:, first : first + here]
            for operation, places in steps:
                operation(*places)
            found[:, first : first + here] = table[self.outputs, :here]
        self.tables.append((table, steps))
        return [part.T for part in np.split(found, np.cumsum(self.sizes)[:-1])]

    def _table(self) -> tuple[Array, list[tuple[Any, list[Array]]]]:
        """Rows of numbers, and the instructions on them."""
        table = np.zeros((self.rows + len(self.constants), SPLINE.at_once))
        table[self.rows :] = np.array(self.constants).reshape(-1, 1)
        rows = list(table)
        return table, [(step[0], [rows[place] for place in step[1:]]) for step in self.steps]


def _spline(s: Array, joints: Array) -> _Pieces:
    """The spline through samples."""
    # in units of the length, which keeps the derivatives of the fit in range
    unit = float(s[-1])
    fit = ca.interpolant("fit", "bspline", [(s / unit).tolist()], joints.ravel().tolist(), {"degree": [DEGREE]})
    place = ca.MX.sym("distance")
    values = [fit(place)]
    for _ in range(DEGREE):
        values.append(ca.jacobian(values[-1], place))
    found = ca.Function("joints", [place], values).map(len(s) - 1)(((s[:-1] + s[1:]) / 2 / unit)[None])
    return _Pieces(s, np.array([value.full().T for value in found]), unit)


def _forces(machine: Machine) -> _OnRows | None:
    """(q, q', q'') -> inertia, drag and rest; None where the base is not fixed."""
    if not isinstance(machine, FixedBase):
        return None
    q, first, second = (ca.SX.sym(name, machine.joint_size) for name in ("q", "first", "second"))
    still = ca.SX.zeros(machine.joint_size)

    def torque(rate: Any, acceleration: Any, gravity: Any = (0.0, 0.0, 0.0)) -> Any:
        base = machine.world_from_base(ca.DM(0, 1))
        return inverse_dynamics(machine.robot, q, rate, acceleration, gravity=gravity, world_from_base=base)

    # what gravity asks is the same in all three: without it the first two are less work
    values = ca.cse(
        [ca.densify(each) for each in (torque(still, first), torque(first, second), torque(still, still, GRAVITY))]
    )
    return _OnRows(ca.Function("torques", [q, first, second], values))
