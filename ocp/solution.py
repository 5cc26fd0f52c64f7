"""The solution of an optimal control problem as plain arrays, with interpolation, files and audit."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field, replace
from dataclasses import fields as dataclass_fields
from typing import Any, TypeAlias

import numpy as np

from ocp.console import interruptible
from ocp.curves import PiecewisePolynomial, gauss_points
from ocp.errors import AuditError, ProblemError, SolverStatus, StorageWarning, values_within
from ocp.problem.formulation import Formulation
from ocp.problem.phases import parts_of_phase
from ocp.problem.problem import Problem
from ocp.problem.record_reader import ARRAY_NAMES, RECORD_ERRORS, unpack_record
from ocp.problem.record_writer import pack_record
from ocp.solution_data import (
    ARRAY_FIELDS,
    CURVE_FIELDS,
    HEAD,
    INTERPOLANTS,
    MAX_HEAD_BYTES,
    POOLS,
    Refinement,
    Sample,
    Sensitivity,
    call_registered,
    check_finite,
    check_structure,
    check_variables_match,
    entry_named,
    match_order,
    plain,
    read_head,
    read_status,
    unstack,
)
from ocp.storage import read_arrays, write_arrays

ByName: TypeAlias = Mapping[str, Any] | None  # parameters, options of a solver
Guess: TypeAlias = "Solution | Mapping[str, Any] | None"
VERSION = 3
MAX_LINES = 15  # of a printed solution


@dataclass(frozen=True, eq=False)
class Solution:
    """The result of a solve: states, controls, costates and multipliers of a plan.

    Attributes:
        name: Name of the problem.
        method: The method, as a dictionary of its settings.
        solver: ``ipopt``, ``fatrop``, ...; ``newton`` for a solve that corrected an earlier plan.
        success: Whether the solver reports an optimum within its tolerance.
        status: How the solver ended. message: What to try after a failure, or another remark; may be "".
        cost: Value of the cost. iterations: Number of solver iterations. horizon: Final time, s.
        t: Reported times, s; first 0, last the horizon. Shape (M,).
        states, controls, costates: Values at the reported times by name, each (M, n). Costates are d(optimal
            cost)/d(state), so that H = running cost + costate . derivative.
        parameters: Their values by name. cost_gradients: Derivatives of the optimal cost with respect to them, by name.
        state_interpolant, control_interpolant, costate_interpolant: Stacked states (controls, costates) over fractions
            0..1 of the horizon.
        variables, multipliers: Variables of the nonlinear program and multipliers of its rows, for warm starts.
        seconds: Wall time of ``build`` and ``solve``.
        problem: The problem, or None if it could not be saved. problem_lost: The reason, or "".
        refinement: Record of the mesh refinement, or None.
        bound_tightening: By how much the lower and the upper bounds were tightened in each interval, in the order
            states, controls, path rows of the problem. A quantity that two intervals share at a node is tightened by
            the larger of both; a control that may jump there, and rows with it, are not shared. Equalities are not
            tightened. None for a plan under the problem's own bounds. Shape (2, N, nx + nu + path rows).
        tightening_cost: Cost increase over the plan of the same mesh without tightening: an estimate of the excess over
            the optimum, not a bound.
        start: Starting point of the successful solve: ``guess``, ``displaced guess`` (by seeded random amounts),
            ``zeros``, ``roll-out`` (simulation of the dynamics with the controls of the guess), ``elastic plan`` (of
            least constraint violation) or ``downhill`` (next to a stationary plan that is not a minimum).
        regularised: Whether the solver found the cost not convex at the end: the plan may not be a minimum.
    """

    name: str
    method: dict[str, Any]
    solver: str
    success: bool
    status: SolverStatus
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
    problem_lost: str = field(default="", compare=False, repr=False)
    refinement: Refinement | None = None
    bound_tightening: np.ndarray | None = None
    tightening_cost: float = 0.0
    start: str = "guess"
    regularised: bool = False
    message: str = ""

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the values of the state or control of a given name at the reported times. Shape (M, n)."""
        return entry_named("state or control", name, {**self.states, **self.controls})

    def __repr__(self) -> str:
        return (
            f"<Solution of {self.name!r} by {self.method.get('type')} and {self.solver}: {self._verdict}, "
            f"cost {self.cost:.6g}, {self.horizon:.6g} s, {len(self.t)} times>"
        )

    def __str__(self) -> str:
        """Return a summary of at most 15 lines: method, solver, cost, and the ranges of states and controls."""
        head = f"Solution of {self.name!r} by {self.method.get('type')} and {self.solver}: {self._verdict} after "
        head += f"{self.iterations} iterations; cost {self.cost:.10g}, {self.horizon:.6g} s, {len(self.t)} times"
        if self.tightening_cost:
            head += f"; limits between the nodes take about {self.tightening_cost:.2g} of the cost"
        pools, lines = {**self.states, **self.controls}, [head]
        width = max(map(len, pools), default=0)
        for name, values in list(pools.items())[: MAX_LINES - 2]:
            kind = "state" if name in self.states else "control"
            span = f"{values.min():.5g} to {values.max():.5g}" if values.size else "nothing"
            lines.append(f"  {name:<{width}}  {kind:<7}  {values.shape[1]} wide, {span}")
        if len(pools) > MAX_LINES - 2:
            lines.append(f"  {len(pools) - MAX_LINES + 2} more")
        return "\n".join(lines)

    @property
    def _verdict(self) -> str:
        return "solved" if self.success else self.message or str(self.status)

    @property
    def has_no_multipliers(self) -> bool:
        """Whether the motion comes from a method that computes no multipliers, which tests of optimality need."""
        return not (self.success or self.multipliers.size)

    def plot(self, against: Any = None, *, figure: Any = None) -> Any:
        """Plot states and controls over time, with their bounds; see :func:`ocp.app.view.plots.plot_solution`.

        The solution is blue. What it is compared with is orange: another solution of the same states and controls, the
        output of ``resolve`` for the same joints, or several by name. A notebook shows the figure,
        ``.savefig("a.png")`` writes it, and ``figure=plt.figure()`` draws into a window.

        Raises:
            ProblemError: An object that cannot be compared, or one with other states and controls.
        """
        return call_registered("plot_solution", self, against, figure)

    def _repr_html_(self) -> str:
        return str(call_registered("html_of_solution", self))

    def table(self) -> dict[str, np.ndarray]:
        """Return times, states and controls as columns by name, from which pandas, polars or pyarrow make a table.

        The times are called ``time`` (s), the entries of a vector ``NAME[k]``. Shape (M,) each.
        """
        columns = {"time": self.t}
        for name, values in {**self.states, **self.controls}.items():
            several = values.shape[1] > 1
            columns |= {f"{name}[{k}]" if several else name: column for k, column in enumerate(values.T)}
        return columns

    def costate(self, name: str) -> np.ndarray:
        """Return the costate of a state, d(optimal cost)/d(state), at the reported times. Shape (M, n)."""
        return entry_named("state", name, self.costates)

    @interruptible
    def sensitivity(self, name: str) -> Sensitivity:
        """Return the derivatives of this plan with respect to a parameter, and the parameter range in which they hold.

        It solves one linear system in the derivatives of variables and multipliers, with the active limits fixed, for
        plans of direct methods. In the range the active limits do not change. See :mod:`ocp.direct.sensitivity`.

        Raises:
            ProblemError: An unknown parameter; not an optimum of a direct method under the bounds of its problem; or
                active limits that become inconsistent when the parameter changes.
        """
        computed: Sensitivity = call_registered("sensitivity", self, name)
        return computed

    def cost_gradient(self, name: str) -> np.ndarray:
        """Return the derivative of the optimal cost with respect to a parameter, from the multipliers. Shape (n,)."""
        return entry_named("parameter", name, self.cost_gradients)

    def at(self, time: Any) -> Sample:
        """Return the interpolated states and controls at one or several times (s). Shape (n,) or (M, n) each.

        Raises:
            ProblemError: A time outside 0 to the horizon, or not finite.
        """
        words = f"s is outside the plan, 0 to {self.horizon:g} s"
        return self.at_fraction(values_within(time, self.horizon, "time", words) / self.horizon)

    def at_fraction(self, fraction: Any) -> Sample:
        """Return the interpolated states and controls at one or several fractions 0..1 of the horizon."""
        at = values_within(fraction, 1.0, "fraction", "of the horizon is outside 0 to 1")
        values: dict[str, np.ndarray] = {}
        for pool, interpolant in ((self.states, self.state_interpolant), (self.controls, self.control_interpolant)):
            values |= unstack(pool, interpolant(np.atleast_1d(at)))
        return Sample({name: v[0] if at.ndim == 0 else v for name, v in values.items()})

    @property
    def phases(self) -> dict[str, tuple[float, float]]:
        """Start and end times, s, of all phases by name; empty for a problem without phases."""
        declared = {} if self.problem is None else self.problem.declared.phases
        parts = [part for phase in declared.values() for part in (phase.begin, phase.duration)]
        times = [float(value.item()) for value in self._sample(parts, np.ones(1))] if parts else []
        return {name: (b, b + n) for name, b, n in zip(declared, times[::2], times[1::2], strict=True)}

    def phase(self, name: str) -> Solution:
        """Return one phase as a solution over the time from 0 to its duration, with the variable names of the phase.

        Its cost is the cost of the phase alone. It has no problem, as only the whole plan can be audited.

        Raises:
            ProblemError: There is no such phase.
        """
        times = self.phases
        begin, end = entry_named("phase", name, times)
        pools = ("states", "controls", "costates")
        parts: dict[str, Any] = {pool: parts_of_phase(name, getattr(self, pool)) for pool in pools}
        for pool, kind in zip(pools, INTERPOLANTS, strict=True):
            columns = [own.startswith(f"{name}.") for own in getattr(self, pool)]
            sizes = np.array([values.shape[1] for values in getattr(self, pool).values()], int)
            curve = getattr(self, kind)
            parts[kind] = replace(curve, values=curve.values[:, :, np.repeat(np.array(columns, bool), sizes)])
        phase = self.problem.declared.phases[name]
        grid = np.union1d(self.state_interpolant.breaks, self.control_interpolant.breaks)
        at, shares = gauss_points(grid, 8)
        density = self._sample([phase.running], at.ravel())[0].reshape(at.shape)
        cost = float((density * shares).sum()) + float(self._sample([phase.terminal], np.ones(1))[0].item())
        return replace(
            self,
            name=f"{self.name}: {name}",
            cost=cost,
            horizon=end - begin,
            t=self.t / self.horizon * (end - begin),
            **parts,
            cost_gradients={},
            variables=np.zeros(0),
            multipliers=np.zeros(0),
            problem=None,
            problem_lost=f"phase {name!r} is audited as a part of {self.name!r}",
            refinement=None,
            bound_tightening=None,
            tightening_cost=0.0,
        )

    def _sample(self, expressions: list[Any], fractions: np.ndarray) -> list[np.ndarray]:
        """Evaluate expressions of declared symbols along the plan at M fractions of the horizon. Shape (M, n) each."""
        form = Formulation.of(self.problem)
        plan = match_order(form, self)
        x, u = plan.state_interpolant(fractions), plan.control_interpolant(fractions)
        p = form.parameter_vector(self.parameters)
        first = (form.x0, plan.state_interpolant(np.zeros(1))[0]), (form.u0, plan.control_interpolant(np.zeros(1))[0])
        flat = [form.flat(expression) for expression in expressions]
        return form.sampled(flat, x, u, fractions * self.horizon, self.horizon, p, *first)

    @interruptible
    def audit(self, problem: Any = None, **settings: Any) -> Any:
        """Check the plan independently of its solver; see :func:`ocp.audit.audit.audit`.

        Raises:
            AuditError: The solution has no problem, and none is given; states the reason.
        """
        audited = problem if problem is not None else self.problem
        if audited is None:
            why = f" ({self.problem_lost})" if self.problem_lost else ""
            words = f"plan {self.name!r} has no problem{why}; call audit(problem)"
            raise AuditError(words, name=self.name)
        return call_registered("audit", audited, self, **settings)

    def with_problem(self, problem: Any) -> Solution:
        """Return a copy of the solution that refers to another problem, or to none."""
        return replace(self, problem=problem, problem_lost="")

    def tied_to(self, problem: Problem) -> Solution:
        """Return the plan with the problem of its file attached; raise ProblemError if their variables do not match."""
        try:
            check_variables_match(Formulation.of(problem), self)
        except ProblemError:
            raise
        except RECORD_ERRORS as error:
            raise ProblemError(f"the saved problem is damaged: {error}", name="problem") from error
        return self.with_problem(problem)

    # ---- files -----------------------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the plan and its problem as arrays and JSON to one ``.npz`` file, which is pure data.

        The file is written atomically and is on the disk when this returns. The mode of an existing file is kept, links
        are followed, and leftovers of killed saves of the same file are removed.

        A problem whose expressions are not elementary, such as one that calls a Python function, is left out with a
        warning.

        Warns:
            StorageWarning: The problem is left out; states the reason.

        Raises:
            ProblemError: path is a folder, a pipe or a device, or the plan or its head is larger than :meth:`load`
                accepts.
            OSError: The file cannot be written.
        """
        write_arrays(path, self.arrays(path))

    def arrays(self, path: str | os.PathLike[str], why_none: str = "") -> dict[str, np.ndarray]:
        """Return the arrays that :meth:`save` writes to a file at ``path``, by name.

        Args:
            why_none: Reason to leave out the problem; "" to include it.

        Raises:
            ProblemError: The head of the plan is larger than :meth:`load` accepts.
        """
        arrays: dict[str, np.ndarray] = {name: getattr(self, name) for name in ARRAY_FIELDS}
        for kind in POOLS:
            arrays |= {f"{kind}/{name}": values for name, values in getattr(self, kind).items()}
        for kind in INTERPOLANTS:
            arrays |= {f"{kind}/{part}": getattr(getattr(self, kind), part) for part in CURVE_FIELDS}
        head = {"version": VERSION, **{key: getattr(self, key) for key in HEAD}, "status": self.status.value}
        head["order"] = {k: list(getattr(self, k)) for k in POOLS}
        if self.refinement is not None:
            head["refinement"] = self.refinement.__dict__
        if self.bound_tightening is not None:
            arrays["bound_tightening"] = self.bound_tightening
        written, head["problem_lost"] = (None, why_none) if why_none else self._written_problem()
        if written is None and self.problem is not None and not why_none:
            words = f"{path} is saved without its problem and cannot be audited: {head['problem_lost']}"
            warnings.warn(StorageWarning(words), stacklevel=3)
        head["problem"], numbers = pack_record(written)
        arrays |= {f"problem/{name}": values for name, values in numbers.items()}
        arrays["head"] = np.frombuffer(json.dumps(head, default=plain).encode(), dtype=np.uint8)
        if arrays["head"].nbytes > MAX_HEAD_BYTES:
            words = f"{path}: the settings of the plan take more than {MAX_HEAD_BYTES:.3g} bytes"
            raise ProblemError(words, name="head", value=arrays["head"].nbytes, limit=MAX_HEAD_BYTES)
        return arrays

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Solution:
        """Read a plan and its problem from a file that :meth:`save` wrote; guesses given as functions are not stored.

        The file is pure data. Its problem is rebuilt from checked operations, and none of it is executed.

        Raises:
            FileNotFoundError: There is no such file.
            ProblemError: The file cannot be read, is not a saved plan, is too large, of an unknown version or
                incomplete; names the part.
        """
        return cls.of_arrays(path, read_arrays(path))

    @classmethod
    def of_arrays(cls, path: str | os.PathLike[str], arrays: dict[str, np.ndarray]) -> Solution:
        """Build a solution from the arrays of a file, and remove them from ``arrays``; raise the errors of `load`."""
        try:
            head = read_head(path, arrays.pop("head"))
            version = head.pop("version")
            if isinstance(version, bool) or version != VERSION:
                words = f"{path}: format version {version}, but this package reads version {VERSION}"
                raise ProblemError(words, name="version", value=version, limit=VERSION)
            order = head.pop("order")
            if set(order) != set(POOLS):
                raise ValueError(f"it has {', '.join(order)}, not {', '.join(POOLS)}")
            fields: dict[str, Any] = {
                kind: {name: arrays.pop(f"{kind}/{name}") for name in names} for kind, names in order.items()
            }
            fields |= {
                kind: PiecewisePolynomial(*(arrays.pop(f"{kind}/{part}") for part in CURVE_FIELDS))
                for kind in INTERPOLANTS
            }
            refinement = head.pop("refinement", None)
            if refinement is not None:
                errors = {kind: tuple(values) for kind, values in refinement["errors"].items()}
                fields["refinement"] = Refinement(
                    tuple(refinement["intervals"]), errors, refinement["tolerance"], refinement["reached"]
                )
            fields["bound_tightening"] = arrays.pop("bound_tightening", None)
            fields |= {name: arrays.pop(name) for name in ARRAY_FIELDS}
            numbers = {name: arrays.pop(f"problem/{name}") for name in ARRAY_NAMES}
            written = unpack_record(head.pop("problem"), numbers)
            parts = [name for name in arrays if "/" in name]  # other entries belong to other readers
            if parts:
                words = f"{path} holds {', '.join(parts)}, which is not part of a plan"
                raise ProblemError(words, name=parts[0], value=str(path))
            head["status"] = read_status(path, head["status"])
            solution = cls(**head, **fields)
            check_structure(solution)
            check_finite(solution)
            return solution if written is None else solution.tied_to(Problem.from_record(written))
        except ProblemError:
            raise
        except Exception as error:  # JSON and wrong types raise many kinds of errors
            raise ProblemError(f"{path} is not a saved solution: {error}", name="path", value=str(path)) from error

    # ---- with and without its problem ------------------------------------------------------------------------

    def _written_problem(self) -> tuple[dict[str, Any] | None, str]:
        """Return the problem as data and an empty text, or None and the reason why the problem cannot be saved."""
        if self.problem is None:
            return None, self.problem_lost
        try:
            return self.problem.__getstate__(), ""
        except ProblemError as error:
            return None, str(error)

    def __getstate__(self) -> dict[str, Any]:
        """Return the data for pickling, with the problem, or with the reason why the problem cannot be saved."""
        written, why = self._written_problem()
        return {**self.__dict__, "problem": written, "problem_lost": why}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the solution from the data of :meth:`__getstate__`."""
        problem = state["problem"]
        self.__dict__.update({**state, "problem": None if problem is None else Problem.from_record(problem)})

    def __copy__(self) -> Solution:
        """Return a solution that shares its arrays and its problem with this one."""
        return replace(self)

    def __deepcopy__(self, memo: Any) -> Solution:
        """Return a solution with its own arrays and a copy of the problem."""
        return replace(self, **{f.name: deepcopy(getattr(self, f.name), memo) for f in dataclass_fields(self)})
