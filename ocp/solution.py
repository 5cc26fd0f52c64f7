"""A solved problem as plain arrays: read, interpolate, save, load, audit."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np

from ocp.curves import PiecewisePolynomial
from ocp.errors import NOT_NUMBERS, AuditError, ProblemError, floats, unknown_name

__all__ = [
    "ByName",
    "Guess",
    "Refinement",
    "Sample",
    "Solution",
    "check_belongs",
    "check_structure",
    "in_order_of",
    "stack",
    "unstack",
]

ByName: TypeAlias = Mapping[str, Any] | None  # parameters, options of a solver
Guess: TypeAlias = "Solution | Mapping[str, Any] | None"
VERSION = 1
SLACK = 1e-12  # relative, of what rounding may do to times
POOLS = ("states", "controls", "costates", "parameters", "cost_gradients")
PLAIN = ("t", "variables", "multipliers")
PARTS = ("breaks", "nodes", "values")  # of an interpolant
INTERPOLANTS = ("state_interpolant", "control_interpolant", "costate_interpolant")


class Sample(dict[str, np.ndarray]):
    """States and controls at one time (each (n,)) or at several (each (M, n)), by name."""

    def __missing__(self, name: str) -> np.ndarray:
        raise unknown_name("state or control", name, self)


@dataclass(frozen=True)
class Refinement:
    """How a mesh was refined.

    Attributes:
        intervals, errors: Number of intervals and relative integration error of every round.
        tolerance: What was asked. reached: Whether it was reached before the cap.
    """

    intervals: tuple[int, ...]
    errors: tuple[float, ...]
    tolerance: float
    reached: bool


@dataclass(frozen=True, eq=False)
class Solution:
    """The result of a solve.

    Attributes:
        name: Name of the problem.
        method: What solved it, as a dictionary of its settings.
        solver: ``ipopt``, ``fatrop``, ...
        success: Whether the solver reports an optimum within its tolerance.
        status: The solver's word, with what to try where it failed.
        cost: Value of the cost. iterations: of the solver. horizon: Final time, s.
        t: Reported times, s; first 0, last the horizon. Shape (M,).
        states, controls, costates: Values at the reported times by name, each (M, n). Costates are
            d(optimal cost)/d(state), so that H = running cost + costate . derivative.
        parameters: Their values by name. cost_gradients: Derivatives of the optimal cost in them, by name.
        state_interpolant, control_interpolant, costate_interpolant: Over fractions 0..1 of the horizon, of all states
            (controls, costates) stacked.
        variables, multipliers: Of the nonlinear program (its variables; its rows), for warm starts.
        seconds: Wall time of ``build`` and ``solve``.
        problem: The problem, or None after :meth:`load`. refinement: How the mesh came about, or None.
    """

    name: str
    method: dict[str, Any]
    solver: str
    success: bool
    status: str
    cost: float
    iterations: int
    horizon: float
    t: np.ndarray
    states: dict[str, np.ndarray]
    controls: dict[str, np.ndarray]
    costates: dict[str, np.ndarray]
    parameters: dict[str, np.ndarray]
    cost_gradients: dict[str, np.ndarray]
    state_interpolant: PiecewisePolynomial
    control_interpolant: PiecewisePolynomial
    costate_interpolant: PiecewisePolynomial
    variables: np.ndarray
    multipliers: np.ndarray
    seconds: dict[str, float]
    problem: Any = field(default=None, compare=False, repr=False)
    refinement: Refinement | None = None

    def __getitem__(self, name: str) -> np.ndarray:
        """Values of a state or control at the reported times. Shape (M, n)."""
        return by_name("state or control", name, {**self.states, **self.controls})

    def costate(self, name: str) -> np.ndarray:
        """Costate of a state at the reported times: d(optimal cost)/d(state). Shape (M, n)."""
        return by_name("state", name, self.costates)

    def cost_gradient(self, name: str) -> np.ndarray:
        """Derivative of the optimal cost in a parameter, from the multipliers. Shape (n,)."""
        return by_name("parameter", name, self.cost_gradients)

    def at(self, time: Any) -> Sample:
        """States and controls at a time (each (n,)) or at times (M,) (each (M, n)), by the method's own interpolant.

        Raises:
            ProblemError: A time outside 0 to the horizon, or not finite.
        """
        try:
            times = floats(time)
        except NOT_NUMBERS as error:
            raise ProblemError(
                f"a time or an array of times is expected, not {time!r}", name="time", value=time
            ) from error
        slack = SLACK * self.horizon
        if not np.all((times >= -slack) & (times <= self.horizon + slack)):
            words = f"time {time!r} is outside the plan, 0 to {self.horizon:g} s"
            raise ProblemError(words, name="time", value=time, limit=(0.0, self.horizon), time=time)
        return self.at_fraction(times / self.horizon)

    def at_fraction(self, fraction: Any) -> Sample:
        """As :meth:`at`, at fractions 0..1 of the horizon."""
        try:
            at = floats(fraction)
            inside = bool(((at >= -SLACK) & (at <= 1 + SLACK)).all())
        except NOT_NUMBERS:
            inside = False
        if not inside:
            words = f"fractions of the horizon, 0 to 1, are expected, not {fraction!r}"
            raise ProblemError(words, name="fraction", value=fraction, limit=(0.0, 1.0))
        flat = np.clip(at.reshape(-1), 0.0, 1.0)
        values: dict[str, np.ndarray] = {}
        for pool, interpolant in ((self.states, self.state_interpolant), (self.controls, self.control_interpolant)):
            values |= unstack(pool, interpolant(flat))
        return Sample({name: v[0] if at.ndim == 0 else v for name, v in values.items()})

    def audit(self, problem: Any = None, **settings: Any) -> Any:
        """Check the plan independently of the solver that made it; see :func:`ocp.audit.audit.audit`.

        Raises:
            AuditError: The solution was loaded from a file and no problem is given.
        """
        from ocp.audit.audit import audit

        known = problem if problem is not None else self.problem
        if known is None:
            words = f"plan {self.name!r} was loaded without its problem; call audit(problem)"
            raise AuditError(words, name=self.name)
        return audit(known, self, **settings)

    def with_problem(self, problem: Any) -> Solution:
        """The same solution tied to a problem, after :meth:`load`, or to None."""
        return replace(self, problem=problem)

    # ---- files -----------------------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write arrays and JSON (no pickle) to one ``.npz`` file, whole or not at all."""
        target = Path(checked_path(path))
        arrays: dict[str, np.ndarray] = {name: getattr(self, name) for name in PLAIN}
        for kind in POOLS:
            arrays |= {f"{kind}/{name}": values for name, values in getattr(self, kind).items()}
        for kind in INTERPOLANTS:
            arrays |= {f"{kind}/{part}": getattr(getattr(self, kind), part) for part in PARTS}
        simple = ("name", "method", "solver", "success", "status", "cost", "iterations", "horizon", "seconds")
        head = {"version": VERSION, **{key: getattr(self, key) for key in simple}}
        head["order"] = {k: list(getattr(self, k)) for k in POOLS}
        if self.refinement is not None:
            head["refinement"] = self.refinement.__dict__
        arrays["head"] = np.frombuffer(json.dumps(head, default=plain).encode(), dtype=np.uint8)
        temporary = target.with_name(f"{target.name}.{secrets.token_hex(4)}.part")
        try:
            with open(temporary, "xb") as stream:
                np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Solution:
        """Read a file written by :meth:`save`.

        Raises:
            ProblemError: The file is not such a file, or of an unknown version.
        """
        try:
            # opened here, because numpy leaves a broken archive open
            with open(checked_path(path), "rb") as stream, np.load(stream, allow_pickle=False) as archive:
                arrays = {key: archive[key] for key in archive.files}
            head = json.loads(arrays.pop("head").tobytes().decode())
            version = head.pop("version")
            if version != VERSION:
                words = f"{path}: written by another version of the format ({version}, not {VERSION})"
                raise ProblemError(words, name="version", value=version, limit=VERSION)
            order = head.pop("order")
            fields: dict[str, Any] = {
                kind: {name: arrays[f"{kind}/{name}"] for name in names} for kind, names in order.items()
            }
            fields |= {
                kind: PiecewisePolynomial(*(arrays[f"{kind}/{part}"] for part in PARTS)) for kind in INTERPOLANTS
            }
            past = head.pop("refinement", None)
            if past is not None:
                rounds = tuple(past["intervals"]), tuple(past["errors"])
                fields["refinement"] = Refinement(*rounds, past["tolerance"], past["reached"])
            solution = cls(**head, **fields, **{name: arrays[name] for name in PLAIN})
            check_structure(solution)
            return solution
        except (FileNotFoundError, ProblemError):
            raise
        except Exception as error:  # what zip, zlib, numpy and JSON say of broken bytes is of many kinds
            raise ProblemError(f"{path} is not a saved solution: {error}", name="path", value=str(path)) from error


def checked_path(path: Any) -> str | os.PathLike[str]:
    """``path``, or ProblemError unless it is the path of a file: a number would be an open file's, 0 the terminal."""
    if not isinstance(path, str | os.PathLike):
        raise ProblemError(f"a path is expected, not {path!r}", name="path", value=path)
    return path


def by_name(kind: str, name: Any, pool: Mapping[str, np.ndarray]) -> np.ndarray:
    """An entry of a pool; ProblemError, which lists the near ones, where nothing bears the name."""
    if not isinstance(name, str) or name not in pool:
        raise unknown_name(kind, name, pool)
    return pool[name]


def plain(value: Any) -> Any:
    """A number of numpy in the settings of a method as one of Python, for JSON."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{value!r} cannot be saved")


def stack(pool: Mapping[str, np.ndarray], like: int = 0) -> np.ndarray:
    """The arrays (M, n) of a pool side by side; without any, (``like``, 0)."""
    return np.hstack(list(pool.values())) if pool else np.zeros((like, 0))


def unstack(pool: dict[str, np.ndarray], stacked: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of stacked values (M, n) by name, in the order and sizes of ``pool``."""
    values, offset = {}, 0
    for name, like in pool.items():
        values[name] = stacked[:, offset : offset + like.shape[1]]
        offset += like.shape[1]
    return values


class Places(Protocol):
    """Where the states and controls of a problem stand in its vectors, by name."""

    name: str
    states: dict[str, slice]
    controls: dict[str, slice]


def check_belongs(form: Places, solution: Solution) -> None:
    """Raise ProblemError unless the states and controls of a plan are those of a problem, in whatever order."""
    for what in ("states", "controls"):
        have = {name: values.shape[1] for name, values in getattr(solution, what).items()}
        want = {name: place.stop - place.start for name, place in getattr(form, what).items()}
        if have != want:
            words = f"plan {solution.name!r} has {what} {have}, problem {form.name!r} has {want}"
            raise ProblemError(words, name=what, value=have, limit=want)


def in_order_of(form: Places, solution: Solution) -> Solution:
    """The same plan with its states and controls, which interpolants hold by position, in the order of a problem."""
    orders = {"states": list(form.states), "costates": list(form.states), "controls": list(form.controls)}
    changes: dict[str, Any] = {}
    for pool, interpolant in zip(("states", "controls", "costates"), INTERPOLANTS, strict=True):
        own, names = getattr(solution, pool), orders[pool]
        if list(own) == names:
            continue
        ends = dict(zip(own, np.cumsum([values.shape[1] for values in own.values()]), strict=True))
        columns = np.concatenate([np.arange(ends[name] - own[name].shape[1], ends[name]) for name in names])
        curve = getattr(solution, interpolant)
        changes[pool] = {name: own[name] for name in names}
        changes[interpolant] = replace(curve, values=curve.values[:, :, columns])
    return replace(solution, **changes) if changes else solution


def check_structure(solution: Solution) -> None:
    """Raise ProblemError, which names the part, unless the arrays of a plan are whole: sizes, order of times, breaks.

    Times run up from 0 and breaks from 0 to 1; every array has a row for each time, every interpolant a
    piece for each pair of breaks, nodes within 0..1, and as many columns as what it interpolates.
    """

    def refuse(name: str, words: str) -> ProblemError:
        return ProblemError(f"plan {solution.name!r}: {name} {words}", name=name)

    def real(name: str, value: Any, dimensions: int) -> np.ndarray:
        array = np.asarray(value)
        if array.dtype.kind not in "fiu" or array.ndim != dimensions:
            raise refuse(name, f"is no real array of {dimensions} dimensions, but {array.dtype} of shape {array.shape}")
        return array

    if set(solution.costates) != set(solution.states):
        words = f"plan {solution.name!r} has costates of {[*solution.costates]}, its states are {[*solution.states]}"
        raise ProblemError(words, name="costates", value=[*solution.costates], limit=[*solution.states])
    for name, number in (("horizon", solution.horizon), ("cost", solution.cost)):
        if isinstance(number, bool) or not isinstance(number, int | float | np.number):
            raise refuse(name, f"is no number: {number!r}")
    if not isinstance(solution.success, bool | np.bool_):
        raise refuse("success", f"is neither True nor False: {solution.success!r}")
    if not 0 < solution.horizon < np.inf:
        raise refuse("horizon", f"{solution.horizon!r} s is not positive and finite")
    t, slack = real("t", solution.t, 1), 1e-9 * solution.horizon
    if t.size < 2 or not (np.diff(t) >= -slack).all() or abs(t[0]) > slack:
        raise refuse("t", "does not increase from 0")
    for pool, interpolant in zip(("states", "controls", "costates"), INTERPOLANTS, strict=True):
        columns = 0
        for name, values in getattr(solution, pool).items():
            if len(real(f"{pool[:-1]} {name!r}", values, 2)) != t.size:
                raise refuse(f"{pool[:-1]} {name!r}", f"has {len(values)} rows for {t.size} times")
            columns += values.shape[1]
        curve = getattr(solution, interpolant)
        breaks, nodes = real(f"{interpolant}.breaks", curve.breaks, 1), real(f"{interpolant}.nodes", curve.nodes, 1)
        values = real(f"{interpolant}.values", curve.values, 3)
        if breaks.size < 2 or not (np.diff(breaks) > 0).all() or abs(breaks[0]) > 1e-12 or abs(breaks[-1] - 1) > 1e-12:
            raise refuse(f"{interpolant}.breaks", "do not increase from 0 to 1")
        if not nodes.size or not (np.diff(nodes) > 0).all() or nodes[0] < -1e-12 or nodes[-1] > 1 + 1e-12:
            raise refuse(f"{interpolant}.nodes", "do not increase within 0 to 1")
        if values.shape != (breaks.size - 1, nodes.size, columns):
            shape = (breaks.size - 1, nodes.size, columns)
            raise refuse(f"{interpolant}.values", f"have shape {values.shape}, not {shape}")
