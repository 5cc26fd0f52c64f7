"""Data classes and consistency checks of solutions, and a registry of functions that other packages implement.

The work of `Solution.audit`, `Solution.sensitivity` and the `plot` methods is done by packages that import `Solution`.
They register their functions here by name, so that imports run in one direction.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from ocp.errors import ProblemError, SolverStatus, require
from ocp.tolerances import ROUNDING_SHARE

T = TypeVar("T")
MAX_HEAD_BYTES = 2**24  # enough for a mesh of half a million intervals
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
NODE_TOLERANCE = 1e-12  # fraction of the horizon within which a point counts as a node
ARRAY_FIELDS = ("t", "variables", "multipliers")
CURVE_FIELDS = ("breaks", "nodes", "values")  # of an interpolant
INTERPOLANTS = ("state_interpolant", "control_interpolant", "costate_interpolant")


class Sample(dict[str, np.ndarray]):
    """States and controls by name, at one time or at several times. Shape (n,) or (M, n) each."""

    def __missing__(self, name: str) -> np.ndarray:
        raise require.unknown("state or control", name, self)


@dataclass(frozen=True)
class Refinement:
    """Record of a mesh refinement: the number of mesh intervals and the errors in each round.

    ``errors`` has the largest error of each kind divided by its limit: "integration", "equalities" and "limits" (bounds
    and inequalities) between the points, lost "cost", "other" rows of the audit. ``tolerance`` is that of integration,
    and ``reached`` says that all errors are within their limits and the audit passes.
    """

    intervals: tuple[int, ...]
    errors: dict[str, tuple[float, ...]]
    tolerance: float
    reached: bool


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivatives of a plan with respect to a parameter of k entries, and the parameter range in which they hold.

    Attributes:
        name, value: Name of the parameter, and its value. Shape (k,).
        t: The reported times, s. Shape (M,).
        states, controls: Derivatives with respect to the entries, at fixed fractions of the horizon. Shape (M, n, k).
        horizon, cost: Derivatives of the horizon, s, and of the optimal cost. Shape (k,) each.
        lower, upper: Range of an entry, the others fixed, in which the set of active limits does not change, to first
            order; infinite if unbounded. Shape (k,) each.
        limits: For each entry the limit that ends its range below and above, "" if there is none.
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
        """Return the derivative of a state or control with respect to the parameter, over time. Shape (M, n, k)."""
        return entry_named("state or control", name, {**self.states, **self.controls})

    def __str__(self) -> str:
        """Return a text with the range of each parameter entry in which the active limits stay the same."""
        lines = []
        for k, (below, above) in enumerate(self.limits):
            entry = self.name if len(self.value) == 1 else f"{self.name}[{k}]"
            why = "; ".join(f"{word} {what}" for word, what in (("below", below), ("above", above)) if what)
            lines.append(
                f"{entry} = {self.value[k]:.6g}: same active limits from {self.lower[k]:.6g} to {self.upper[k]:.6g}"
                + (f" ({why})" if why else "")
            )
        return "\n".join(lines)


def read_head(path: Any, text: np.ndarray) -> Any:
    """Return the header of a solution file, parsed from its JSON text; raise ProblemError if the text is too long.

    Parsing takes thirty times as much memory as the text.
    """
    if text.nbytes > MAX_HEAD_BYTES:
        words = f"{path} is not a saved solution: its head has {text.nbytes:.3g} bytes, {MAX_HEAD_BYTES:.3g} at most"
        raise ProblemError(words, name="head", value=text.nbytes, limit=MAX_HEAD_BYTES)
    return json.loads(text.tobytes().decode())


def read_status(path: Any, word: Any) -> SolverStatus:
    """Return the solver status that a file header names; raise ProblemError for an unknown name."""
    if word not in [status.value for status in SolverStatus]:
        raise ProblemError(f"{path}: {word!r} is not a solver status", name="status", value=word)
    return SolverStatus(word)


def entry_named(kind: str, name: Any, pool: Mapping[str, T]) -> T:
    """Return the entry of a dictionary with a given name, or raise ProblemError, which suggests similar names."""
    if not isinstance(name, str) or name not in pool:
        raise require.unknown(kind, name, pool)
    return pool[name]


def plain(value: Any) -> Any:
    """Convert NumPy numbers and arrays in the settings of a method to Python numbers and lists, for JSON."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{value!r} cannot be saved")


def stack(pool: Mapping[str, np.ndarray], like: int = 0) -> np.ndarray:
    """Stack the arrays (M, n) of a dictionary side by side; if it is empty, return an array of shape (``like``, 0)."""
    return np.hstack(list(pool.values())) if pool else np.zeros((like, 0))


def unstack(pool: dict[str, np.ndarray], stacked: np.ndarray) -> dict[str, np.ndarray]:
    """Split stacked columns (M, n) into arrays by name, with the order and the widths of the arrays in ``pool``."""
    values, offset = {}, 0
    for name, like in pool.items():
        values[name] = stacked[:, offset : offset + like.shape[1]]
        offset += like.shape[1]
    return values


def check_variables_match(form: Any, solution: Any) -> None:
    """Raise ProblemError unless a plan has the states and controls of a problem, in any order."""
    for what in ("states", "controls"):
        sizes = {name: values.shape[1] for name, values in getattr(solution, what).items()}
        expected = {name: place.stop - place.start for name, place in getattr(form, what).items()}
        if sizes != expected:
            words = f"plan {solution.name!r} has {what} {sizes}, problem {form.name!r} has {expected}"
            raise ProblemError(words, name=what, value=sizes, limit=expected)


def match_order(form: Any, solution: Any) -> Any:
    """Return a plan with its variables reordered as in the problem, because columns of interpolants have no names."""
    orders = {"states": list(form.states), "controls": list(form.controls), "costates": list(form.states)}
    changes: dict[str, Any] = {}
    for (pool, names), interpolant in zip(orders.items(), INTERPOLANTS, strict=True):
        values_by_name = getattr(solution, pool)
        if list(values_by_name) == names:
            continue
        widths = [values.shape[1] for values in values_by_name.values()]
        places = dict(zip(values_by_name, np.split(np.arange(sum(widths)), np.cumsum(widths)[:-1]), strict=True))
        columns = np.concatenate([places[name] for name in names])
        curve = getattr(solution, interpolant)
        changes[pool] = {name: values_by_name[name] for name in names}
        changes[interpolant] = replace(curve, values=curve.values[:, :, columns])
        if solution.bound_tightening is not None and pool != "costates":
            first = 0 if pool == "states" else sum(values.shape[1] for values in solution.states.values())
            tightening = changes.setdefault("bound_tightening", solution.bound_tightening.copy())
            tightening[:, :, first : first + len(columns)] = solution.bound_tightening[:, :, first + columns]
    return replace(solution, **changes) if changes else solution


def check_structure(solution: Any) -> None:
    """Raise ProblemError, with the name of the faulty array, if the arrays of a plan are inconsistent.

    Times increase from 0 and breaks from 0 to 1. Every array has a row for each time. Every interpolant has one
    polynomial between two breaks, nodes within 0..1, and as many columns as the interpolated pool.
    """
    _check_head(solution)
    for pool in ("parameters", "cost_gradients"):
        for name, values in getattr(solution, pool).items():
            _real(solution, f"{pool[:-1].replace('_', ' ')} {name!r}", values, 1)
    for name in ("variables", "multipliers"):
        _real(solution, name, getattr(solution, name), 1)
    t, slack = _real(solution, "t", solution.t, 1), ROUNDING_SHARE * solution.horizon
    if t.size < 2 or not (np.diff(t) >= -slack).all() or abs(t[0]) > slack:
        raise _invalid(solution, "t", "does not increase from 0")
    for pool, interpolant in zip(("states", "controls", "costates"), INTERPOLANTS, strict=True):
        columns = 0
        for name, values in getattr(solution, pool).items():
            if len(_real(solution, f"{pool[:-1]} {name!r}", values, 2)) != t.size:
                raise _invalid(solution, f"{pool[:-1]} {name!r}", f"has {len(values)} rows for {t.size} times")
            columns += values.shape[1]
        _check_interpolant(solution, interpolant, columns)
    if solution.bound_tightening is not None:
        _check_tightening(solution)


def _invalid(solution: Any, name: str, words: str) -> ProblemError:
    return ProblemError(f"plan {solution.name!r}: {name} {words}", name=name)


def _real(solution: Any, name: str, value: Any, dimensions: int) -> np.ndarray:
    """Return data of a plan as an array; raise ProblemError unless it is a real array with `dimensions` dimensions."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiu" or array.ndim != dimensions:
        words = f"is not a real array of {dimensions} dimensions, but {array.dtype} of shape {array.shape}"
        raise _invalid(solution, name, words)
    return array


def _check_head(solution: Any) -> None:
    """Raise ProblemError if fields of a plan that are not arrays have wrong types."""
    for pool in POOLS:
        if not isinstance(getattr(solution, pool), dict):
            words = f"must be a dictionary by name, not {type(getattr(solution, pool)).__name__}"
            raise _invalid(solution, pool, words)
    if set(solution.costates) != set(solution.states):
        words = f"plan {solution.name!r} has costates of {[*solution.costates]}, its states are {[*solution.states]}"
        raise ProblemError(words, name="costates", value=[*solution.costates], limit=[*solution.states])
    for name, kind in HEAD.items():
        value = getattr(solution, name)
        kinds: Any = {bool: bool | np.bool_, int: int | np.integer, float: int | float | np.number}.get(kind, kind)
        if not isinstance(value, kinds) or (kind is not bool and isinstance(value, bool)):
            required = {bool: "True or False", str: "a string", dict: "a dictionary", SolverStatus: "a SolverStatus"}
            raise _invalid(solution, name, f"must be {required.get(kind, 'a number')}, not {value!r}")
    if not isinstance(solution.method.get("type"), str):
        raise _invalid(solution, "method", f"has no type: {solution.method!r}")
    if not 0 < solution.horizon < np.inf:
        raise _invalid(solution, "horizon", f"must be positive and finite, not {solution.horizon!r} s")


def _check_interpolant(solution: Any, name: str, columns: int) -> None:
    """Raise ProblemError if an interpolant is inconsistent, or has a wrong number of columns."""
    curve = getattr(solution, name)
    breaks, nodes = (_real(solution, f"{name}.{part}", getattr(curve, part), 1) for part in ("breaks", "nodes"))
    values = _real(solution, f"{name}.values", curve.values, 3)
    increasing = breaks.size >= 2 and (np.diff(breaks) > 0).all()
    if not increasing or abs(breaks[0]) > NODE_TOLERANCE or abs(breaks[-1] - 1) > NODE_TOLERANCE:
        raise _invalid(solution, f"{name}.breaks", "do not increase from 0 to 1")
    increasing = nodes.size > 0 and np.isfinite(nodes).all() and (np.diff(nodes) > 0).all()
    if not increasing or nodes[0] < -NODE_TOLERANCE or nodes[-1] > 1 + NODE_TOLERANCE:
        raise _invalid(solution, f"{name}.nodes", "do not increase within 0 to 1")
    shape = (breaks.size - 1, nodes.size, columns)
    if values.shape != shape:
        raise _invalid(solution, f"{name}.values", f"have shape {values.shape}, not {shape}")


def _check_tightening(solution: Any) -> None:
    """Raise ProblemError unless the amount by which each bound of a plan was tightened is finite and nonnegative."""
    amounts = _real(solution, "bound_tightening", solution.bound_tightening, 3)
    entries = sum(values.shape[1] for pool in (solution.states, solution.controls) for values in pool.values())
    shape = (2, len(solution.control_interpolant.breaks) - 1, entries)
    fits = amounts.shape[:2] == shape[:2] and amounts.shape[2] >= entries
    if not fits or not (amounts >= 0).all() or np.isinf(amounts).any():
        words = f"must be finite and not negative, of shape {shape} or with additional path rows"
        raise _invalid(solution, "bound_tightening", words)


def check_finite(solution: Any) -> None:
    """Raise ProblemError, with the name of the value, if a plan that counts as solved contains nan or infinity."""
    if not solution.success:
        return
    parts: dict[str, Any] = {name: getattr(solution, name) for name in ("cost", "variables", "multipliers")}
    for pool in ("states", "controls", "costates", "parameters"):
        parts |= {f"{pool[:-1]} {name!r}": values for name, values in getattr(solution, pool).items()}
    parts |= {kind: getattr(solution, kind).values for kind in INTERPOLANTS}
    for name, values in parts.items():
        if not np.all(np.isfinite(values)):
            raise ProblemError(f"plan {solution.name!r}: {name} is not finite", name=name)


_FUNCTIONS: dict[str, str] = {}


def register(operation: str, module: str) -> None:
    """Make a function available to `call_registered` by name; the function's module is imported on the first call."""
    _FUNCTIONS[operation] = module


def call_registered(operation: str, *args: Any, **options: Any) -> Any:
    """Call a function that `register` has made available; raise LookupError for an unknown name."""
    if operation not in _FUNCTIONS:
        raise LookupError(f"no package has registered {operation!r}; import ocp, which registers all of them")
    function: Callable[..., Any] = getattr(importlib.import_module(_FUNCTIONS[operation]), operation)
    return function(*args, **options)
