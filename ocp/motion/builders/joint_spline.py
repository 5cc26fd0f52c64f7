"""Joint positions and torques of a plan as functions of the distance along a path, for planning the path speed.

The positions are a spline of degree 5, so that its third derivative, which joint jerks need, is continuous. The torques
are linear in the acceleration a along the path and in the squared speed v^2. With joint positions q(s) at distance s,
inverse dynamics tau(q, rate, acceleration) without gravity, and rest(q) that of gravity alone,

    torque = tau(q, 0, q') a + tau(q, q', q'') v^2 + rest(q).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray

from models import FixedBase, Machine
from models.checks import NOT_NUMBERS, Array, floats
from models.robot.dynamics import GRAVITY, inverse_dynamics
from ocp.errors import ProblemError, require
from ocp.motion.schedule import PathLike
from ocp.motion.schedule.grid import subdivide
from ocp.solution import Solution
from ocp.tolerances import ROUNDING_SHARE

DEGREE = 5
ROW_OPERATIONS = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_NEG: np.negative,
    ca.OP_SQ: np.square,
    ca.OP_SQRT: np.sqrt,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_TWICE: lambda operand, out: np.add(operand, operand, out),
}
"""NumPy functions that execute the casadi operations of inverse dynamics on arrays, by casadi operation code.

They are called with the operands and the output array.
"""


@dataclass(frozen=True)
class SplineSettings:
    """Settings of the spline of joint positions along a path."""

    path_tolerance: float = 1e-6  # largest distance of a task from its path, as a share of the path's length
    # number of points of a path to which targets are compared, to find those that belong to the path
    path_samples: int = 200
    projections: int = 8  # number of Newton steps by which targets are projected onto the path
    samples: int = 400  # least number of samples of a plan
    # least number of samples of a plan in each segment of the path: the third derivative of a blend is then within
    # some percent, and the duration of a motion, which depends on its cube root, within 1e-3
    segment_samples: int = 24
    # number of path points whose torques are computed together, and of which the width of a work array is a multiple
    batch: int = 1024
    width: int = 256


SPLINE = SplineSettings()


class _Along(NamedTuple):
    """Joint positions along a path and their first three derivatives with respect to distance. Shape (M, n) each."""

    position: Array
    first: Array
    second: Array
    third: Array


class _Torques(NamedTuple):
    """Coefficients of joint torques as functions of path speed v and acceleration a: inertia a + drag v^2 + rest."""

    inertia: Array
    drag: Array
    rest: Array


@dataclass(frozen=True, eq=False)
class PlannedJoints:
    """Joint positions and torques of a machine as functions of the distance along a path, built by `joint_path`.

    Attributes:
        machine: Machine of the joints.
        names: Names of the joints.
        length: Length of the path, m.
        error: Upper bound of the interpolation error, rad or m: the largest difference at the samples from a spline
            through every second one.
    """

    machine: Machine
    names: tuple[str, ...]
    length: float
    error: float
    curves: Any
    forces: _BatchedFunction | None

    def at(self, distance: Any) -> _Along:
        """Return the joint positions and their derivatives at distances (M,) along the path, m.

        Raises:
            ProblemError: A distance is nan, or off the path by more than rounding.
        """
        places = self._check_distance(distance)
        return _Along(*(self.curves(places, order) for order in range(4)))

    def torques(self, distance: Any) -> _Torques:
        """Return coefficients of the joint torques (inertia, drag, rest) at path distances (M,), m. Shape (M, n) each.

        Raises:
            ProblemError: The base of the machine moves, or distances are invalid, see `at`.
        """
        if self.forces is None:
            message = f"torques along a path need a FixedBase, not a {type(self.machine).__name__}"
            raise ProblemError(message, name="machine", value=self.machine)
        places = self._check_distance(distance)
        return _Torques(*self.forces(*(self.curves(places, order) for order in range(3))))

    def _check_distance(self, distance: Any) -> Array:
        """Clip distances to the path; raise ProblemError if a distance is off the path by more than rounding errors."""
        s = np.atleast_1d(require.array("distance", distance, entries="any"))
        slack = 1e-9 * self.length
        wrong = s[~((s >= -slack) & (s <= self.length + slack))]
        if s.ndim != 1 or wrong.size:
            message = f"distance must be a row on the path of {self.length:g} m, not {s.ravel()[:3].tolist()} m"
            raise ProblemError(message, name="distance", value=distance, limit=self.length)
        return np.asarray(np.clip(s, 0.0, self.length))


def joint_path(machine: Machine, plan: Any, path: PathLike) -> PlannedJoints:
    """Return a spline of joint positions over the distance along a path, from a plan along the path or from samples.

    Args:
        machine: Machine of the joints.
        plan: A `Plan` of tasks that run along the whole path without a pause, in one part or several, with a fixed or
            free horizon. Or a solution with states "joints" at distances proportional to time. Or a tuple of distances
            (M,) from 0 to the path's length and joint positions (M, n); 24 samples resolve a segment of the path.
        path: Path of the tool.

    Raises:
        ProblemError: The plan has no joints, or its tasks do not run along the path; the samples have
            other shapes, are too few, do not increase, or do not reach both ends.
    """
    if isinstance(machine, type) or not (hasattr(machine, "robot") and hasattr(machine, "joint_size")):
        raise ProblemError(f"{machine!r} is no machine with a robot and joints", name="machine", value=machine)
    length = getattr(path, "length", None)
    if not isinstance(length, float | int) or not length > 0 or not hasattr(path, "bounds"):
        raise ProblemError(f"the path {path!r} has no length, or no bounds of segments", name="path", value=path)
    if hasattr(plan, "task_share"):
        plan = _samples_of_plan(plan, path)
    s, joints = _checked_samples(plan, path, machine.joint_size)
    half = np.union1d(np.arange(0, len(s), 2), len(s) - 1)
    error = float(np.abs(_interpolate(s[half], joints[half], path)(s) - joints).max())
    used = _informative_samples(s, joints, path)
    curves = _interpolate(s[used], joints[used], path)
    torques = _torque_function(machine) if isinstance(machine, FixedBase) else None
    return PlannedJoints(machine, tuple(machine.robot.joint_names), float(length), error, curves, torques)


def _interpolate(s: Array, joints: Array, path: Any) -> Any:
    """Return the spline through joint positions (M, n) at distances (M,) that is as smooth as the path."""
    return scipy.interpolate.make_interp_spline(s, joints, k=DEGREE, t=_knots(s, path))


def _informative_samples(s: Array, joints: Array, path: Any) -> NDArray[np.intp]:
    """Return the indices of the samples to interpolate; further samples would only add noise to the derivatives.

    Every second sample of a segment is left out while the spline through the others predicts it to 2^3 times its
    rounding error: of the third derivative, the error of interpolation is then below that of rounding, which falls with
    the cube of the distance between samples.
    """
    slopes, bounds = np.abs(np.diff(joints, axis=0)) / np.diff(s)[:, None], path.bounds
    tolerance = 2**3 * np.finfo(float).eps * (np.abs(joints).max() + s[-1] * slopes.max())
    used, segment = np.arange(len(s)), np.searchsorted(bounds[1:-1], s, side="right")
    while True:
        own = segment[used]
        counts = np.bincount(own, minlength=len(bounds) - 1)
        halved = counts >= 2 * (DEGREE + 1)
        odd = (np.arange(len(used)) - (np.cumsum(counts) - counts)[own]) % 2 == 1
        rest = ~(odd & halved[own]) | (used == used[-1])
        deviations = np.abs(_interpolate(s[used[rest]], joints[used[rest]], path)(s) - joints).max(axis=1)
        halved[segment[deviations > tolerance]] = False
        if not halved.any():
            return used
        used = used[rest | ~halved[own]]


def _knots(s: Array, path: Any) -> Array:
    """Return the knots of an interpolating spline that is as smooth as the path where path segments meet.

    The knots are at the samples (M,), except near a bound between two segments. There, knots are moved to the bound:
    three for continuous second derivatives, four where the curvature jumps. The next knots are moved halfway towards
    the bound's, so that two cells of 1.5 times the distance between samples begin there, not one of twice the distance,
    whose error would be larger. A bound with fewer samples nearby, because other bounds are nearer to them, has fewer
    knots.
    """
    inner = s[DEGREE // 2 + 1 : -(DEGREE // 2) - 1].copy()
    bounds = path.bounds[1:-1]
    if bounds.size:
        jumps = path.curvature_jumps()
        sharp = jumps > ROUNDING_SHARE * (1 + jumps.max())
        after, owner = np.searchsorted(inner, bounds), np.searchsorted((bounds[:-1] + bounds[1:]) / 2, inner)
        middles = (inner + np.append(inner[1:], inner[-1:])) / 2
        left = np.where(sharp, bounds, middles[np.maximum(after - 2, 0)])
        right = middles[np.minimum(after + 1, len(inner) - 1)]
        for shift, places in ((-2, left), (-1, bounds), (0, bounds), (1, bounds), (2, right)):
            at = np.clip(after + shift, 0, len(inner) - 1)
            own = (owner[at] == np.arange(len(bounds))) & (at == after + shift)
            inner[at[own]] = places[own]
    ends = np.ones(DEGREE + 1)
    return np.concatenate([s[0] * ends, inner, s[-1] * ends])


def _samples_of_plan(plan: Any, path: Any) -> tuple[Array, Array]:
    """Return path distances (M,) and joint positions (M, n) of a plan whose tasks run along the path; raise
    ProblemError if they do not.

    The times are chosen so that the distances are nearly evenly spaced, also where the tool speeds up from rest.
    """
    times, places = np.linspace(0.0, plan.horizon, SPLINE.samples), _sample_places(path)
    if not (plan.targets and hasattr(path, "at")):
        times = np.interp(places, path.length * plan.task_share(times), times)
        return path.length * plan.task_share(times), plan.at(times)["joints"]
    if not hasattr(plan, "targets_at"):
        words = f"{plan!r} consists of several motions: give (distances, joints) of one motion along the path instead"
        raise ProblemError(words, name="plan", value=type(plan).__name__)
    times = np.interp(places, _distances_of_targets(plan, path, times), times)
    return _distances_of_targets(plan, path, times), plan.at(times)["joints"]


def _sample_places(path: PathLike) -> Array:
    """Return distances along a path at which a plan is sampled, evenly spaced in each segment."""
    shares = (SPLINE.samples - 1) * np.diff(path.bounds) / path.length
    counts = np.maximum(np.ceil(shares * (1 - ROUNDING_SHARE)), SPLINE.segment_samples).astype(np.intp)
    return subdivide(path.bounds, counts)


def _distances_of_targets(plan: Any, path: Any, times: Array) -> Array:
    """Project the targets of a plan at given times onto a path, and return their distances along the path, m. Raise
    ProblemError unless the targets run along the whole path. Shape (M,).
    """
    length = path.length

    def fail(fault: str, at: int, value: float) -> ProblemError:
        words = f"the plan's tasks {fault} at {times[at]:.6g} s, but must run along all of the path, without a pause; "
        words += "give (distances, joints) instead of the plan"
        limit = SPLINE.path_tolerance * length
        return ProblemError(words, name="plan", value=value, limit=limit, time=float(times[at]))

    positions = np.array([target.position for target in plan.targets_at(times)])
    known = np.isfinite(positions)
    if not known.any(axis=(0, 2)).all():
        raise fail("have no position", int(known.any(axis=(0, 2)).argmin()), np.inf)
    line = path.at(np.linspace(0.0, length, SPLINE.path_samples)).position

    def gaps(to: Array, of: Array) -> Array:
        return np.asarray(np.linalg.norm(np.nan_to_num(of - to), axis=-1))

    # of targets at once, such as those of two arms, the nearest to the path counts
    nearest = np.array([np.min([gaps(point, target) for point in line], axis=0) for target in positions])
    chosen = np.where(known.any(axis=2), nearest, np.inf).argmin(axis=0)
    position = positions[chosen, np.arange(len(times))]
    covered = np.append(0.0, np.cumsum(gaps(position[1:], position[:-1])))
    distance = covered * (length / max(float(covered[-1]), np.finfo(float).tiny))
    for _ in range(SPLINE.projections):
        along = path.at(distance)
        step = np.nansum((position - along.position) * along.tangent, axis=1)
        squares = (np.where(np.isfinite(position), along.tangent, 0.0) ** 2).sum(axis=1)
        step /= np.maximum(squares, SPLINE.path_tolerance)
        distance = np.clip(distance + step, 0.0, length)
    errors = gaps(path.at(distance).position, position)
    worst = int(errors.argmax())
    if not errors[worst] <= SPLINE.path_tolerance * length:
        raise fail(f"are {errors[worst]:.3g} m off the path", worst, float(errors[worst]))
    for end, expected in ((0, 0.0), (-1, length)):
        if abs(distance[end] - expected) > SPLINE.path_tolerance * length:
            raise fail(f"are {distance[end]:.6g} m from the beginning of the path", end, float(distance[end]))
    distance[0], distance[-1] = 0.0, length
    if (still := np.diff(distance) <= 0).any():
        raise fail("stand still or go back", int(still.argmax()), 0.0)
    return np.asarray(distance)


def _checked_samples(plan: Any, path: PathLike, size: int) -> tuple[Array, Array]:
    """Return path distances (M,) and joint positions (M, n) of a solution or of given samples, after checking them."""
    length = float(path.length)
    if isinstance(plan, tuple):
        try:
            s, joints = (floats(part) for part in plan)
        except NOT_NUMBERS as error:
            raise ProblemError(f"samples are not numeric: {error}", name="plan", value=plan) from error
    else:
        require.instance("plan", plan, Solution)
        fractions = _sample_places(path) / length
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


class _BatchedFunction:
    """Evaluator of a casadi SX Function that applies each instruction to arrays of many inputs at once."""

    def __init__(self, function: Any) -> None:
        self.sizes = [function.size1_out(k) for k in range(function.n_out())]
        # rows of the table: the function's own memory, its inputs, its outputs, its constants
        size = [function.size1_in(k) for k in range(function.n_in())]
        offsets = np.cumsum([function.sz_w(), *size, *self.sizes]).tolist()
        inputs, outputs, self.rows = offsets[: len(size)], offsets[len(size) : -1], offsets[-1]
        self.inputs, self.outputs = slice(inputs[0], outputs[0]), slice(outputs[0], self.rows)
        self.constants: list[float] = []
        self.steps: list[tuple[Any, ...]] = []
        self.tables: dict[int, list[tuple[Array, list[tuple[Any, list[Array]]]]]] = {}  # by width
        row: dict[int, int] = {}  # row of each memory location
        for k in range(function.n_instructions()):
            kind, source, target = (
                function.instruction_id(k),
                function.instruction_input(k),
                function.instruction_output(k),
            )
            if kind == ca.OP_INPUT:
                row[target[0]] = inputs[source[0]] + source[1]
            elif kind == ca.OP_CONST:
                row[target[0]] = self.rows + len(self.constants)
                self.constants.append(function.instruction_constant(k))
            elif kind == ca.OP_OUTPUT:
                self.steps.append((np.copyto, outputs[target[0]] + target[1], row[source[0]]))
            else:
                self.steps.append((ROW_OPERATIONS[kind], *(row[place] for place in source), target[0]))
                row[target[0]] = target[0]

    def __call__(self, *inputs: Array) -> list[Array]:
        """Return the outputs of the function for M inputs at once; each argument is an array of shape (M, n)."""
        count = len(inputs[0])
        results = [np.empty((count, size)) for size in self.sizes]
        for first in range(0, count, SPLINE.batch):
            part = slice(first, min(first + SPLINE.batch, count))
            self._evaluate_batch([value[part] for value in inputs], [value[part] for value in results])
        return results

    def _evaluate_batch(self, inputs: list[Array], results: list[Array]) -> None:
        """Evaluate the function for at most `SPLINE.batch` inputs at once."""
        count = len(inputs[0])
        width = -(-count // SPLINE.width) * SPLINE.width  # operations on the work array take its whole width
        try:
            table, steps = self.tables.setdefault(width, []).pop()
        except IndexError:  # first call, or in use by another thread
            table, steps = self._allocate(width)
        np.concatenate([value.T for value in inputs], out=table[self.inputs, :count])
        for operation, places in steps:
            operation(*places)
        outputs = np.split(table[self.outputs, :count], np.cumsum(self.sizes)[:-1])
        for result, part in zip(results, outputs, strict=True):
            result[:] = part.T
        self.tables[width].append((table, steps))

    def _allocate(self, width: int) -> tuple[Array, list[tuple[Any, list[Array]]]]:
        """Return a new work array, with one row for each value in the Function, and the instructions on these rows."""
        table = np.zeros((self.rows + len(self.constants), width))
        table[self.rows :] = np.array(self.constants).reshape(-1, 1)
        rows = list(table)
        return table, [(step[0], [rows[place] for place in step[1:]]) for step in self.steps]


@lru_cache(maxsize=8)
def _torque_function(machine: FixedBase) -> _BatchedFunction:
    """Return a function of joint positions and their first two derivatives with respect to distance that computes the
    coefficients `_Torques` of the joint torques.
    """
    q, first, second = (ca.SX.sym(name, machine.joint_size) for name in ("q", "first", "second"))
    still = ca.SX.zeros(machine.joint_size)

    def torque(rate: Any, acceleration: Any, gravity: Any = (0.0, 0.0, 0.0)) -> Any:
        base = machine.world_from_base(ca.DM(0, 1))
        return inverse_dynamics(machine.robot, q, rate, acceleration, gravity=gravity, world_from_base=base)

    # gravity only in the third call makes the first two cheaper
    terms = torque(still, first), torque(first, second), torque(still, still, GRAVITY)
    values = ca.cse([ca.densify(each) for each in terms])
    return _BatchedFunction(ca.Function("torques", [q, first, second], values))
