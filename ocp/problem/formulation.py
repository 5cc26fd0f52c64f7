"""An optimal control problem in stacked vectors: the common form that all transcriptions and the audit read.

Time is the fraction ``s`` of the horizon, ``t = s * T``, so that a free final time is one additional unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from ocp.errors import ProblemError, error_names, require
from ocp.problem.declarations import Constraint, Declarations, Signal, Variable
from ocp.problem.problem import Problem, checked_problem
from ocp.problem.values import (
    Sampler,
    check_finite,
    check_horizon,
    check_inside,
    check_order,
    constant,
    dependence,
    numeric,
)

Bounds: TypeAlias = tuple[np.ndarray, np.ndarray]  # lower and upper values of a bound table, (n,) each


@dataclass(frozen=True)
class Rows:
    """Scalar constraints (rows) of one kind: path, start or end constraints, or constraints that only the audit checks.

    Attributes:
        expression: Shape (m, 1), in the symbols of the formulation.
        labels: Name of each row, ``corridor`` or ``corridor[2]``. owners: Name of its constraint, ``corridor``.
        bounds: Index of each row in the bound table. Shape (m,).
        equality: Whether lower and upper bound are one expression. Shape (m,), bool.
        uses_control: Whether the row contains a control. Shape (m,), bool.
        uses_state: Which states the row contains. Shape (m, nx), bool.
        tolerance: Largest violation that the audit accepts, infinite if none is declared. Shape (m,).
    """

    expression: Any
    labels: tuple[str, ...]
    owners: tuple[str, ...]
    bounds: np.ndarray
    equality: np.ndarray
    uses_control: np.ndarray
    uses_state: np.ndarray
    tolerance: np.ndarray

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the declared vector constraints to which the scalar constraints belong, in order of declaration."""
        return tuple(dict.fromkeys(self.owners))

    def of(self, name: str) -> np.ndarray:
        """Return the indices of the scalar constraints that belong to the declared constraint of a given name."""
        return np.array([i for i, owner in enumerate(self.owners) if owner == name])

    def select(self, mask: np.ndarray) -> Rows:
        """Return the scalar constraints that a boolean mask of shape (m,) selects."""
        keep = np.flatnonzero(mask)
        expression = self.expression[keep.tolist()] if keep.size else self.expression[:0, :]
        names, owners = (tuple(texts[i] for i in keep) for texts in (self.labels, self.owners))
        arrays = (self.bounds, self.equality, self.uses_control, self.uses_state, self.tolerance)
        return Rows(expression, names, owners, *(array[keep] for array in arrays))


@dataclass(frozen=True)
class BoundTable:
    """All lower and upper bounds of a problem as two vectors, whose entries are functions of the parameters.

    Attributes:
        function: Parameters -> (lower, upper), each of shape (n, 1).
        places: Indices of the entries by what they bound: ``free``, ``zero``, ``state``, ``initial``, ``terminal``,
            ``control``, ``horizon``, ``path``, ``start``, ``end``, ``watch``.
    """

    function: Any
    places: dict[str, np.ndarray]

    def pullback(self, p: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
        """Return the gradient of the sum of bounds times multipliers with respect to the parameters. Shape (np,).

        ``multipliers`` (2, n) are those of the lower and of the upper bounds.
        """
        return np.asarray(self._pullback(p, multipliers.T).full()).reshape(-1)

    @cached_property
    def _pullback(self) -> Any:
        count, n = self.function.numel_in(0), self.function.numel_out(0)
        parameters, multipliers = ca.MX.sym("p", count), ca.MX.sym("multipliers", n, 2)
        bounds = self.function(parameters)
        total = sum(ca.jtimes(bounds[i], parameters, multipliers[:, i], True) for i in (0, 1))
        return ca.Function("pullback", [parameters, multipliers], [total])


class Formulation:
    """A checked problem in the form of stacked vectors and functions, unaffected by later changes of the problem.

    Attributes:
        x, u, p, t, T: Symbols of states (nx, 1), controls (nu, 1), parameters (np, 1), time, horizon. sym: Creates
            symbols of the same type.
        w: Symbols of the signals (nw, 1) inside the horizon; at its ends they are numbers.
        x0, u0: Symbols of states and controls at the start, for expressions that couple both ends.
        f: State derivative. Shape (nx, 1).
        running, terminal: Running and terminal cost, scalars.
        path, start, end: Constraint rows. watch: Rows that only the audit checks.
        separations: Poses of the frames of separated bodies, by the name of the separation. Shape (12 F, 1) each.
        watch_integral: Which watched rows bound the integral over time. Shape (rows,), bool.
        watch_reference_rate: Rates of their reference path lengths, zero if there is none. Shape (rows, 1).
        states, controls, parameters: Slices of the vectors by name. state_labels, control_labels, parameter_labels: A
            name for every entry.
        units: Units of states, controls and constraints by name; empty if undeclared, or if a constraint and a variable
            of one name have different units.
        bounds: The bound table.
        horizon_is_free, horizon_value: Whether T is unknown; its value (an expression of p) if it is not.
        free_parameters: Which states have zero rate. Shape (nx,), bool.
        scales: Declared scales of states and controls, nan if undeclared. Shape (nx + nu,).
        initial_is_fixed: Which initial states are given. Shape (nx,), bool.
        ties_ends: Whether an end constraint or the terminal cost depends on the start.
        indifferent: Whether the cost is constant, so that every feasible plan is optimal.
        autonomous: Whether dynamics, running cost and path constraints are independent of time.
    """

    def __init__(self, problem: Problem) -> None:
        checked_problem(problem).check()
        declared = problem.declared
        self.sym = sym = problem.symbols.sym
        horizon = declared.horizon
        assert horizon is not None
        self.problem = problem
        self.name = problem.name
        self.states = slices(declared.states)
        self.controls = slices(declared.controls)
        self.parameters = slices(declared.parameters)
        pools = declared.states, declared.controls, declared.parameters
        self.state_labels, self.control_labels, self.parameter_labels = map(labels, pools)
        self.units = units(declared)
        self.nx, self.nu, self.np = (total(s) for s in (self.states, self.controls, self.parameters))
        self.x, self.u, self.p = sym("x", self.nx), sym("u", self.nu), sym("p", self.np)
        self.x0, self.u0 = sym("x0", self.nx), sym("u0", self.nu)
        self.t, self.T = sym("t"), sym("T")
        self.signals = slices(declared.signals)
        self.w = sym("w", total(self.signals))
        self._declared, self._entries = declared, entries_of(declared)
        self._cache: dict[Any, Any] = {}
        # an audit evaluates the signals at the same times repeatedly
        self._signals_at = lru_cache(maxsize=16)(self._evaluate_signals)
        self.horizon_is_free = not horizon.fixed
        self.horizon_guess = horizon.guess

        self.f = self.flat(ca.vertcat(*[declared.dynamics[name] for name in self.states]))
        self.free_parameters = np.array([rate.is_zero() for rate in ca.vertsplit(self.f)], dtype=bool)
        self.running = self.flat(0 if declared.running is None else declared.running)
        self.terminal = self.flat(0 if declared.terminal is None else declared.terminal)
        self.horizon_value = self.flat(horizon.lower)  # meaningful if the horizon is fixed
        self._signal = self._signal_function()
        self.indifferent = not ca.symvar(ca.vertcat(self.running, self.terminal))
        self.bounds = self._bound_table()
        self.path = self._rows("path", declared.path)
        if declared.phases and problem.symbols is ca.SX:  # substituted one by one, so subexpressions are duplicated
            self.f, self.running, rows = ca.cse([self.f, self.running, self.path.expression])
            self.path = replace(self.path, expression=rows)
        self.start = self._rows("start", declared.start, 0.0)
        self.end = self._rows("end", declared.end, 1.0)
        self.watch = self._rows("watch", declared.watch)
        self.separations = {name: self.flat(separation.placements) for name, separation in declared.apart.items()}
        watched = declared.watch.values()
        self.watch_integral = np.array([w.integral for w in watched for _ in range(w.size)], dtype=bool)
        rates = [problem.symbols(w.size, 1) if w.way is None else w.way for w in watched]
        self.watch_reference_rate = self.flat(ca.vertcat(problem.symbols(0, 1), *rates))
        inner = ca.vertcat(self.f, self.running, self.path.expression)
        self.autonomous = not ca.depends_on(inner, ca.vertcat(self.t, self.w))
        self.initial_is_fixed = ~np.concatenate([is_free(s.initial) for s in declared.states.values()])
        end_terms = ca.vertcat(self.end.expression, self.terminal)
        self.ties_ends = bool(ca.depends_on(end_terms, ca.vertcat(self.x0, self.u0)))
        variables = (*declared.states.values(), *declared.controls.values())
        self.scales = np.concatenate([np.full(v.size, np.nan) if v.scale is None else v.scale for v in variables])
        self.guesses = {v.name: v.guess for v in variables}

    @classmethod
    def of(cls, problem: Problem) -> Formulation:
        """Return the formulation cached in a problem, or a new formulation if the declarations have changed."""
        cached: Formulation | None = checked_problem(problem).formulated
        entries = entries_of(problem.declared)
        if cached is None or list(map(id, cached._entries)) != list(map(id, entries)):
            cached = problem.formulated = cls(problem)
        return cached

    def cached(self, name: Any, make: Callable[[], Any]) -> Any:
        """Return the value cached under ``name``; on the first call, compute the value by ``make``."""
        if name not in self._cache:
            self._cache[name] = make()
        return self._cache[name]

    def function(self, name: str, outputs: list[Any], names: list[str]) -> Any:
        """Return a casadi Function of state, control, time, horizon and parameters that evaluates given expressions.

        The function is of MX type if the expressions contain signals.
        """
        inputs, labels = [self.x, self.u, self.t, self.T, self.p], ["x", "u", "t", "T", "p"]
        if not (self.signals and ca.depends_on(ca.vertcat(*map(ca.vec, outputs)), self.w)):
            return ca.Function(name, inputs, outputs, labels, names)
        inner = ca.Function(name, [*inputs, self.w], outputs)
        symbols = [ca.MX.sym(label, part.numel()) for label, part in zip(labels, inputs, strict=True)]
        return ca.Function(name, symbols, inner.call([*symbols, self._signal(symbols[2])]), labels, names)

    def point_data(self, fractions: np.ndarray) -> np.ndarray:
        """Return horizon fractions and signals of K points, as :meth:`point_function` takes them. Shape (1 + nw, K)."""
        return np.vstack([np.reshape(fractions, (1, -1)), self.signals_at(np.ravel(fractions) * self.duration).T])

    def signals_at(self, times: np.ndarray, order: int = 0) -> np.ndarray:
        """Return the signals (known functions of time), or their time derivatives, at M times (s). Shape (M, nw)."""
        times = np.ravel(times).astype(float)
        return self._signals_at(order, times.tobytes()) if self.signals else np.zeros((len(times), 0))

    def _evaluate_signals(self, order: int, times: bytes) -> np.ndarray:
        """Evaluate the signals at times, which are given as bytes because the cache needs hashable arguments."""

        def make() -> Sampler:
            t = ca.MX.sym("t")
            value = self._signal(t)
            for _ in range(order):
                value = ca.jacobian(value, t)
            return Sampler([t], [ca.densify(value)])

        sampler: Sampler = self.cached(f"signals, order {order}", make)
        return sampler(np.frombuffer(times)[:, None])[0]

    @property
    def duration(self) -> float:
        """Horizon, s, if the problem has signals (known functions of time), which need a fixed horizon; 1 otherwise."""
        return float(self.horizon_value) if self.signals else 1.0

    def sampled(
        self, outputs: list[Any] | Callable[[], list[Any]], *point: Any, cache_as: Any = None
    ) -> list[np.ndarray]:
        """Evaluate expressions of the problem's symbols at M points of a trajectory. Shape (M, entries) each.

        The entries of an expression that is a matrix are in column-major order.

        Args:
            outputs: Expressions of the symbols x, u, t, T and p, or a function that returns them.
            point: States (M, nx), controls (M, nu), times (M,), s, horizon, s, and parameters (np,); then pairs of
                another symbol and its values, (M, n), or (n,) if they are constant.
            cache_as: Name under which the compiled function is cached; it must identify the outputs.
        """
        x, u, t, horizon, p, *more = point

        def make() -> Sampler:
            return self.sampler(outputs() if callable(outputs) else outputs, *(symbol for symbol, _ in more))

        function = make() if cache_as is None else self.cached(cache_as, make)
        times = np.reshape(t, (-1, 1))
        values = (value for _, value in more)
        return list(function(x, u, times, horizon, p, self.signals_at(times), *values))

    def sampler(self, outputs: list[Any], *more: Any) -> Sampler:
        """Return a function that evaluates expressions at many samples of the problem's symbols and further symbols.

        The arguments of the function are x, u, t, T, p, w and the further symbols ``more``.
        """
        symbols = self.problem.symbols
        inputs = [self.x, self.u, self.t, self.T, self.p, self.w, *more]
        return Sampler(inputs, [symbols(output) for output in outputs])

    def terminal_cost(self, x: np.ndarray, x0: np.ndarray, u0: np.ndarray, *, horizon: float, p: np.ndarray) -> float:
        """Return the terminal cost of a final state, given the states and controls at the start."""
        symbols = [self.x, self.x0, self.u0, self.t, self.T, self.p]
        function = self.cached("terminal", lambda: ca.Function("terminal", symbols, [self.terminal]))
        return float(function(x, x0, u0, horizon, horizon, p))

    def horizon_at(self, p: Any) -> Any:
        """Return the fixed horizon for given parameters, which may be numbers or symbols."""
        return self.bounds.function(p)[0][int(self.bounds.places["horizon"][0])]

    def point_function(self, name: str, d: Any, cost: Any, g: Any) -> Any:
        """Return the casadi Function that evaluates a cost and constraints at one point of a transcription.

        It maps (v, d, p) to (cost, g), with the variables v = [x; u; T if free]. ``cost`` and ``g`` are expressions of
        x, u, t, T, p, w and of the data ``d``, which begin with a column of :meth:`point_data`.
        """
        v = self.sym("v", self.nx + self.nu + self.horizon_is_free)
        inside = slice(self.nx, self.nx + self.nu)
        horizon = v[self.nx + self.nu] if self.horizon_is_free else self.horizon_value
        new = [v[: self.nx, :], v[inside, :], d[0] * horizon, horizon, d[1 : 1 + self.w.numel(), :]]
        symbols = self.problem.symbols
        outputs = ca.substitute([symbols(cost), symbols(g)], [self.x, self.u, self.t, self.T, self.w], new)
        return ca.Function(name, [v, d, self.p], outputs, {"cse": True})

    def parameter_vector(self, values: dict[str, Any] | None) -> np.ndarray:
        """Return the values of all parameters as one vector. Shape (np,).

        Raises:
            ProblemError: A parameter is missing, unknown, of the wrong size or not finite.
        """
        entries = dict(values or {})
        for name in entries:
            if name not in self.parameters:
                raise require.unknown("parameter", name, self.parameters)
        vector = np.zeros(self.np)
        for name, place in self.parameters.items():
            what, size = f"parameter {name!r}", place.stop - place.start
            with error_names(name):
                if name not in entries:
                    raise ProblemError(f"{what} has no value; give parameters={{{name!r}: ...}}")
                value = numeric(what, entries[name])
                if value.size not in (1, size):
                    words = f"{what} has {value.size} entries, {size} expected"
                    raise ProblemError(words, value=value.size, limit=size)
                check_finite(what, value)
            vector[place] = value
        return vector

    def bound_values(self, p: np.ndarray) -> Bounds:
        """Return the lower and upper bounds of the bound table for given parameters. Shape (n,) each.

        Raise ProblemError if bounds contradict each other, or if a bound or a fixed value is invalid.
        """
        lower, upper = (np.asarray(v.full()).reshape(-1) for v in self.bounds.function(p))
        places = self.bounds.places
        what = f"problem {self.name!r} at these parameters"
        for kind, pool in (("state", self.states), ("control", self.controls)):
            for name, entries in pool.items():
                index = places[kind][entries]
                with error_names(name):
                    check_order(f"{what}: {kind} {name!r}", lower[index], upper[index])
                    for end in ("initial", "terminal") if kind == "state" else ():
                        fixed = places[end][entries]
                        values = np.where(lower[fixed] == upper[fixed], lower[fixed], np.nan)
                        check_inside(f"{what}: {kind} {name!r}: {end}", values, lower[index], upper[index])
        for rows in (self.path, self.start, self.end, self.watch):
            for owner, label, index in zip(rows.owners, rows.labels, rows.bounds, strict=True):
                with error_names(owner):
                    check_order(f"{what}: constraint {label!r}", lower[[index]], upper[[index]])
        index = places["horizon"]
        with error_names("horizon"):
            check_horizon(f"{what}: horizon", lower[index])
            check_order(f"{what}: horizon", lower[index], upper[index])
        if np.any(np.isnan(lower)) or np.any(np.isnan(upper)):
            raise ProblemError(f"{what}: a bound is not a number")
        return lower, upper

    # ---- flattening ------------------------------------------------------------------------------------------

    def flat(self, expression: Any) -> Any:
        """Return an expression with the declared symbols replaced by entries of the stacked vectors."""
        d = self._declared
        old: list[Any] = [self.problem.time]
        new: list[Any] = [self.t]
        for pool, vector, places in (
            (d.states, self.x, self.states),
            (d.controls, self.u, self.controls),
            (d.parameters, self.p, self.parameters),
            (d.signals, self.w, self.signals),
        ):
            old += [variable.symbol for variable in pool.values()]
            new += [vector[places[name]] for name in pool]
        for name, symbol in d.at_start.items():
            old.append(symbol)
            new.append(self.x0[self.states[name]] if name in self.states else self.u0[self.controls[name]])
        if d.horizon is not None:
            old.append(d.horizon.symbol)
            new.append(self.T)
        return ca.densify(ca.substitute([self.problem.symbols(expression)], old, new)[0])

    def _signal_function(self) -> Any:
        """Return the casadi Function from time to all signals; raise ProblemError unless the horizon is a number."""
        if not self.signals:
            return None
        if self.horizon_is_free or ca.symvar(self.horizon_value):
            name = next(iter(self.signals))
            words = f"problem {self.name!r}: signal {name!r} needs a horizon that is a number"
            raise ProblemError(words, name=name)
        t = ca.MX.sym("t")
        parts = [signal.function(t) for signal in self._declared.signals.values()]
        return ca.Function("signals", [t], [ca.densify(ca.vertcat(*parts))])

    def _rows(self, kind: str, pool: dict[str, Constraint], end: float | None = None) -> Rows:
        """Return all scalar constraints of one kind, such as "path" or "end".

        ``end`` is 0 for constraints at the start and 1 at the end, where signals are replaced by their values; else
        None.
        """
        symbols = self.problem.symbols
        expression = self.flat(ca.vertcat(symbols(0, 1), *[c.expression for c in pool.values()]))
        if self.signals and end is not None:
            values = symbols(ca.DM(self.signals_at(np.array([end * self.duration]))[0]))
            expression = ca.densify(ca.substitute([expression], [self.w], [values])[0])
        names = labels(pool)
        lower = ca.vertcat(symbols(0, 1), *[c.lower for c in pool.values()])
        upper = ca.vertcat(symbols(0, 1), *[c.upper for c in pool.values()])
        equality = np.array([bool(ca.is_equal(lower[i], upper[i], 8)) for i in range(len(names))], dtype=bool)
        tolerances = [np.full(c.size, np.inf) if c.tolerance is None else c.tolerance for c in pool.values()]
        return Rows(
            expression,
            names,
            tuple(c.name for c in pool.values() for _ in range(c.size)),
            self.bounds.places[kind],
            equality,
            np.asarray(dependence(expression, self.u).any(axis=1)),
            dependence(expression, self.x),
            np.concatenate([np.zeros(0), *tolerances]),
        )

    def _bound_table(self) -> BoundTable:
        d = self._declared
        symbols = self.problem.symbols
        empty = symbols(0, 1)

        def stack(items: Any, what: str) -> Any:
            return ca.vertcat(empty, *[getattr(item, what) for item in items])

        states, controls = d.states.values(), d.controls.values()
        low, high = stack(states, "lower"), stack(states, "upper")
        parts: dict[str, Any] = {
            "free": (symbols(-np.inf), symbols(np.inf)),
            "zero": (symbols(0.0), symbols(0.0)),
            "state": (low, high),
            "control": (stack(controls, "lower"), stack(controls, "upper")),
        }
        for end in ("initial", "terminal"):
            value = stack(states, end)
            free = np.concatenate([is_free(getattr(state, end)) for state in states])  # free entries keep their bounds
            parts[end] = tuple(
                ca.vertcat(*[bound[i] if free[i] else value[i] for i in range(len(free))]) for bound in (low, high)
            )
        assert d.horizon is not None
        parts["horizon"] = (d.horizon.lower, d.horizon.upper)
        for kind in ("path", "start", "end", "watch"):
            pool = getattr(d, kind).values()
            parts[kind] = (stack(pool, "lower"), stack(pool, "upper"))
        offset, places = 0, {}
        for name, (lower, _) in parts.items():
            places[name] = np.arange(offset, offset + lower.numel())
            offset += lower.numel()
        table = [self.flat(ca.vertcat(*[part[i] for part in parts.values()])) for i in (0, 1)]
        return BoundTable(ca.Function("bounds", [self.p], table), places)


def entries_of(declared: Declarations) -> list[Any]:
    """Return all declarations of a problem (states, controls, parameters, constraints, cost, ...) in one list."""
    pools = [getattr(declared, kind.name) for kind in fields(declared)]
    return [entry for pool in pools for entry in (pool.values() if isinstance(pool, dict) else [pool])]


def slices(pool: Mapping[str, Variable | Signal]) -> dict[str, slice]:
    """Return, by name, the slice that each variable occupies in the stacked vector."""
    places, offset = {}, 0
    for name, variable in pool.items():
        places[name] = slice(offset, offset + variable.size)
        offset += variable.size
    return places


def labels(pool: dict[str, Any]) -> tuple[str, ...]:
    """Return a name for every entry of variables or constraints: ``q`` for a scalar, ``q[2]`` for a vector's entry."""
    return tuple(f"{v.name}[{i}]" if v.size > 1 else v.name for v in pool.values() for i in range(v.size))


def units(declared: Declarations) -> dict[str, str]:
    """Return the units of states, controls and constraints by name; "" for a name that has different units."""
    units_of: dict[str, set[str]] = {}
    for pool in (declared.states, declared.controls, declared.path, declared.start, declared.end, declared.watch):
        for name, item in pool.items():
            units_of.setdefault(name, set()).update([item.unit] if item.unit else [])
    return {name: next(iter(own)) if len(own) == 1 else "" for name, own in units_of.items()}


def is_free(end: Any) -> np.ndarray:
    """Return which entries of an initial or terminal value are free (nan). Shape (n,), bool."""
    numbers = np.array([not ca.symvar(entry) for entry in ca.vertsplit(end)])
    return np.asarray(numbers & np.isnan(constant(end)))


def total(places: dict[str, slice]) -> int:
    return max((place.stop for place in places.values()), default=0)
