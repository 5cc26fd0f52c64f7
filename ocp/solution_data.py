"""What a solution is made of besides the class itself, and whether its arrays are whole."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np

from ocp.errors import ProblemError, unknown_name
from ocp.status import SolverStatus
from ocp.tolerances import ROUNDING_SHARE

__all__ = [
    "HEAD",
    "INTERPOLANTS",
    "MAX_HEAD_BYTES",
    "NODE_TOLERANCE",
    "PARTS",
    "PLAIN",
    "POOLS",
    "Refinement",
    "Sample",
    "Sensitivity",
    "check_finite",
    "check_structure",
    "check_variables_match",
    "entry_named",
    "match_order",
    "plain",
    "read_head",
    "read_status",
    "stack",
    "tightening_at",
    "unstack",
]

T = TypeVar("T")
MAX_HEAD_BYTES = 2**24  # bytes of its text: a mesh of half a million intervals
HEAD = {
    "name": str,
    "method": dict,
    "solver": str,
    "success": bool,
    "status": SolverStatus,
    "message": str,
    "cost": float,
    "iterations": int,
    "horizon": float,
    "seconds": dict,
    "start": str,
    "regularised": bool,
    "tightening_cost": float,
}
POOLS = ("states", "controls", "costates", "parameters", "cost_gradients")
NODE_TOLERANCE = 1e-12  # of the horizon: a fraction nearer to a node is the node
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
        intervals: Number of intervals of every round.
        errors: Of every round the worst error of each kind, as a share of its limit, so that 1 is what may be:
            "integration", "equalities" and "limits" (bounds and inequalities) between the points, "cost" that is lost,
            "other" rows of the audit.
        tolerance: Of the integration, as asked. reached: Whether no error is beyond its limit and the audit passes.
    """

    intervals: tuple[int, ...]
    errors: dict[str, tuple[float, ...]]
    tolerance: float
    reached: bool


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """How a plan moves with a parameter of k entries, to first order.

    Attributes:
        name, value: Of the parameter, (k,).
        t: The reported times, s. Shape (M,).
        states, controls: Derivatives in the entries of the parameter, at fixed fractions of the horizon. (M, n, k).
        horizon, cost: Derivatives of the horizon, s, and of the optimal cost. Shape (k,) each.
        lower, upper: Between which values of an entry, the others held, the same limits push and all others hold, to
            first order; infinite where nothing ends it. Shape (k,) each.
        limits: For each entry what ends this below and above, "" where nothing does.
    """

    name: str
    value: np.ndarray
    t: np.ndarray
    states: dict[str, np.ndarray]
    controls: dict[str, np.ndarray]
    horizon: np.ndarray
    cost: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    limits: tuple[tuple[str, str], ...]

    def __getitem__(self, name: str) -> np.ndarray:
        """Derivative of a state or control at the reported times. Shape (M, n, k)."""
        return entry_named("state or control", name, {**self.states, **self.controls})

    def __str__(self) -> str:
        """The valid range of each entry, a line each."""
        lines = []
        for k, (below, above) in enumerate(self.limits):
            entry = self.name if len(self.value) == 1 else f"{self.name}[{k}]"
            why = "; ".join(f"{word} {what}" for word, what in (("below", below), ("above", above)) if what)
            lines.append(
                f"{entry} = {self.value[k]:.6g}: the same limits push from {self.lower[k]:.6g} to {self.upper[k]:.6g}"
                + (f" ({why})" if why else "")
            )
        return "\n".join(lines)


def read_head(path: Any, text: np.ndarray) -> Any:
    """What stands in the head of a file; ProblemError where it is longer than that of any plan.

    JSON takes up to thirty times its length when it is read.
    """
    if text.nbytes > MAX_HEAD_BYTES:
        words = f"{path} is not a saved solution: its head has {text.nbytes:.3g} bytes, {MAX_HEAD_BYTES:.3g} at most"
        raise ProblemError(words, name="head", value=text.nbytes, limit=MAX_HEAD_BYTES)
    return json.loads(text.tobytes().decode())


def read_status(path: Any, word: Any) -> SolverStatus:
    """Return the status that stands in the head of a file; ProblemError where it is none."""
    if word not in [status.value for status in SolverStatus]:
        raise ProblemError(f"{path}: {word!r} is no status of a solver", name="status", value=word)
    return SolverStatus(word)


def entry_named(kind: str, name: Any, pool: Mapping[str, T]) -> T:
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


def check_variables_match(form: Places, solution: Any) -> None:
    """Raise ProblemError unless the states and controls of a plan are those of a problem, in whatever order."""
    for what in ("states", "controls"):
        have = {name: values.shape[1] for name, values in getattr(solution, what).items()}
        want = {name: place.stop - place.start for name, place in getattr(form, what).items()}
        if have != want:
            words = f"plan {solution.name!r} has {what} {have}, problem {form.name!r} has {want}"
            raise ProblemError(words, name=what, value=have, limit=want)


def match_order(form: Places, solution: Any) -> Any:
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
        if solution.bound_tightening is not None and pool != "costates":
            first = 0 if pool == "states" else sum(values.shape[1] for values in solution.states.values())
            drawn = changes.setdefault("bound_tightening", solution.bound_tightening.copy())
            drawn[:, :, first : first + len(columns)] = solution.bound_tightening[:, :, first + columns]
    return replace(solution, **changes) if changes else solution


def tightening_at(bound_tightening: np.ndarray, mesh: np.ndarray, at: np.ndarray) -> np.ndarray:
    """By how much bounds that are drawn in (2, N, m) on a mesh (N + 1,) are so at fractions ``at`` (M,).

    At a node between two intervals the larger of both, as holds for what they share. Shape (2, M, m).
    """
    last = len(mesh) - 2
    sides = (np.clip(np.searchsorted(mesh, at + slip) - 1, 0, last) for slip in (-NODE_TOLERANCE, NODE_TOLERANCE))
    left, right = (bound_tightening[:, side] for side in sides)
    return np.asarray(np.maximum(left, right))


def check_structure(solution: Any) -> None:
    """Raise ProblemError, which names the part, unless the arrays of a plan are whole: sizes, order of times, breaks.

    Times run up from 0 and breaks from 0 to 1; every array has a row for each time, every interpolant a
    piece for each pair of breaks, nodes within 0..1, and as many columns as what it interpolates.
    """
    _check_head(solution)
    for pool in ("parameters", "cost_gradients"):
        for name, values in getattr(solution, pool).items():
            _real(solution, f"{pool[:-1].replace('_', ' ')} {name!r}", values, 1)
    for name in ("variables", "multipliers"):
        _real(solution, name, getattr(solution, name), 1)
    t, slack = _real(solution, "t", solution.t, 1), ROUNDING_SHARE * solution.horizon
    if t.size < 2 or not (np.diff(t) >= -slack).all() or abs(t[0]) > slack:
        raise _refused(solution, "t", "does not increase from 0")
    for pool, interpolant in zip(("states", "controls", "costates"), INTERPOLANTS, strict=True):
        columns = 0
        for name, values in getattr(solution, pool).items():
            if len(_real(solution, f"{pool[:-1]} {name!r}", values, 2)) != t.size:
                raise _refused(solution, f"{pool[:-1]} {name!r}", f"has {len(values)} rows for {t.size} times")
            columns += values.shape[1]
        _check_interpolant(solution, interpolant, columns)
    if solution.bound_tightening is not None:
        _check_drawn_in(solution)


def _refused(solution: Any, name: str, words: str) -> ProblemError:
    return ProblemError(f"plan {solution.name!r}: {name} {words}", name=name)


def _real(solution: Any, name: str, value: Any, dimensions: int) -> np.ndarray:
    """Return a part of a plan; ProblemError unless it is an array of so many dimensions, of real numbers."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiu" or array.ndim != dimensions:
        words = f"is no real array of {dimensions} dimensions, but {array.dtype} of shape {array.shape}"
        raise _refused(solution, name, words)
    return array


def _check_head(solution: Any) -> None:
    """Raise ProblemError unless the fields that are no arrays are of their kinds."""
    for pool in POOLS:
        if not isinstance(getattr(solution, pool), dict):
            words = f"are no dictionary by name, but {type(getattr(solution, pool)).__name__}"
            raise _refused(solution, pool, words)
    if set(solution.costates) != set(solution.states):
        words = f"plan {solution.name!r} has costates of {[*solution.costates]}, its states are {[*solution.states]}"
        raise ProblemError(words, name="costates", value=[*solution.costates], limit=[*solution.states])
    for name, kind in HEAD.items():
        value = getattr(solution, name)
        kinds: Any = {bool: bool | np.bool_, int: int | np.integer, float: int | float | np.number}.get(kind, kind)
        if not isinstance(value, kinds) or (kind is not bool and isinstance(value, bool)):
            no = {bool: "is neither True nor False", str: "is no text", dict: "is no dictionary"}
            no[SolverStatus] = "is no SolverStatus"
            raise _refused(solution, name, f"{no.get(kind, 'is no number')}: {value!r}")
    if not isinstance(solution.method.get("type"), str):
        raise _refused(solution, "method", f"has no type: {solution.method!r}")
    if not 0 < solution.horizon < np.inf:
        raise _refused(solution, "horizon", f"{solution.horizon!r} s is not positive and finite")


def _check_interpolant(solution: Any, name: str, columns: int) -> None:
    """Raise ProblemError unless an interpolant of so many columns is whole."""
    curve = getattr(solution, name)
    breaks, nodes = (_real(solution, f"{name}.{part}", getattr(curve, part), 1) for part in ("breaks", "nodes"))
    values = _real(solution, f"{name}.values", curve.values, 3)
    rising = breaks.size >= 2 and (np.diff(breaks) > 0).all()
    if not rising or abs(breaks[0]) > NODE_TOLERANCE or abs(breaks[-1] - 1) > NODE_TOLERANCE:
        raise _refused(solution, f"{name}.breaks", "do not increase from 0 to 1")
    rising = nodes.size > 0 and np.isfinite(nodes).all() and (np.diff(nodes) > 0).all()
    if not rising or nodes[0] < -NODE_TOLERANCE or nodes[-1] > 1 + NODE_TOLERANCE:
        raise _refused(solution, f"{name}.nodes", "do not increase within 0 to 1")
    shape = (breaks.size - 1, nodes.size, columns)
    if values.shape != shape:
        raise _refused(solution, f"{name}.values", f"have shape {values.shape}, not {shape}")


def _check_drawn_in(solution: Any) -> None:
    """Raise ProblemError unless what the bounds are drawn in by has an entry for each of them, zero or above."""
    drawn = _real(solution, "bound_tightening", solution.bound_tightening, 3)
    entries = sum(values.shape[1] for pool in (solution.states, solution.controls) for values in pool.values())
    shape = (2, len(solution.control_interpolant.breaks) - 1, entries)
    if drawn.shape[:2] != shape[:2] or drawn.shape[2] < entries or not (drawn >= 0).all() or np.isinf(drawn).any():
        words = f"is no array of finite numbers, zero or above, of shape {shape} or with path rows behind"
        raise _refused(solution, "bound_tightening", words)


def check_finite(solution: Any) -> None:
    """Raise ProblemError, which names the part, where a plan that counts as a success holds what is not finite."""
    if not solution.success:
        return
    parts: dict[str, Any] = {
        "cost": solution.cost,
        "variables": solution.variables,
        "multipliers": solution.multipliers,
    }
    for pool in ("states", "controls", "costates", "parameters"):
        parts |= {f"{pool[:-1]} {name!r}": values for name, values in getattr(solution, pool).items()}
    parts |= {kind: getattr(solution, kind).values for kind in INTERPOLANTS}
    for name, values in parts.items():
        if not np.all(np.isfinite(values)):
            raise ProblemError(f"plan {solution.name!r}: {name} is not finite", name=name)
