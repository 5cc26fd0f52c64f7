"""A solved problem as plain arrays: read, interpolate, save, load, audit."""

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
from ocp.curves import PiecewisePolynomial
from ocp.errors import NOT_NUMBERS, AuditError, ProblemError, StorageWarning, floats
from ocp.problem.formulation import Formulation
from ocp.problem.phases import own_of
from ocp.problem.problem import Problem
from ocp.problem.stored import ARRAY_NAMES, RECORD_ERRORS, pack_record, unpack_record
from ocp.registry import call_registered
from ocp.solution_data import (
    HEAD,
    INTERPOLANTS,
    MAX_HEAD_BYTES,
    NODE_TOLERANCE,
    PARTS,
    PLAIN,
    POOLS,
    Refinement,
    Sample,
    Sensitivity,
    check_finite,
    check_structure,
    check_variables_match,
    entry_named,
    match_order,
    plain,
    read_head,
    read_status,
    stack,
    tightening_at,
    unstack,
)
from ocp.status import SolverStatus
from ocp.storage import read_arrays, write_arrays

__all__ = [
    "NODE_TOLERANCE",
    "ByName",
    "Guess",
    "Refinement",
    "Sample",
    "Sensitivity",
    "Solution",
    "check_structure",
    "check_variables_match",
    "match_order",
    "read_head",
    "stack",
    "tightening_at",
    "unstack",
]

ByName: TypeAlias = Mapping[str, Any] | None  # parameters, options of a solver
Guess: TypeAlias = "Solution | Mapping[str, Any] | None"
VERSION = 3
MAX_LINES = 15  # of a solution that is printed


@dataclass(frozen=True, eq=False)
class Solution:
    """The result of a solve.

    Attributes:
        name: Name of the problem.
        method: What solved it, as a dictionary of its settings.
        solver: What solved it: ``ipopt``, ``fatrop``, ..., ``newton`` beside an earlier plan.
        success: Whether the solver reports an optimum within its tolerance.
        status: How the solver ended. message: What to try where it failed, or what
            else it says; may be "".
        cost: Value of the cost. iterations: of the solver. horizon: Final time, s.
        t: Reported times, s; first 0, last the horizon. Shape (M,).
        states, controls, costates: Values at the reported times by name, each (M, n). Costates are
            d(optimal cost)/d(state), so that H = running cost + costate . derivative.
        parameters: Their values by name. cost_gradients: Derivatives of the optimal cost in them, by name.
        state_interpolant, control_interpolant, costate_interpolant: Over fractions 0..1 of the horizon, of all states
            (controls, costates) stacked.
        variables, multipliers: Of the nonlinear program (its variables; its rows), for warm starts.
        seconds: Wall time of ``build`` and ``solve``.
        problem: The problem, or None where it could not be written to a file. problem_lost: Why, or "".
        refinement: How the mesh came about, or None.
        bound_tightening: By how much the lower and the upper bounds were drawn in, interval by interval, in the order
            states, controls, path rows of the problem. What two intervals share at a node, which is all but a control that may
            jump there and what contains it, is drawn in by the larger of both; equalities are not. None where the plan
            was solved under the problem's own bounds. Shape (2, N, nx + nu + path rows).
        tightening_cost: Of the cost what the bounds drawn in take, beside the plan of the same mesh that keeps them at
            the points of the grid alone: an estimate of how much too much it costs, not a bound.
        start: Where the solver started from when it found this: ``guess``, ``zeros``, ``roll-out`` (of the dynamics,
            with the controls of the guess), ``elastic plan`` (that misses the constraints least) or ``downhill``
            (beside a stationary plan that is no minimum).
        regularised: Whether the solver saw the cost not curve upwards where it ended: the plan may be no minimum.
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
        """Values of a state or control at the reported times. Shape (M, n)."""
        return entry_named("state or control", name, {**self.states, **self.controls})

    def __repr__(self) -> str:
        return (
            f"<Solution of {self.name!r} by {self.method.get('type')} and {self.solver}: {self._verdict}, "
            f"cost {self.cost:.6g}, {self.horizon:.6g} s, {len(self.t)} times>"
        )

    def __str__(self) -> str:
        """What solved it, what it costs, and between which values states and controls are; 15 lines at most."""
        lines = [
            f"Solution of {self.name!r} by {self.method.get('type')} and {self.solver}: {self._verdict} after "
            f"{self.iterations} iterations; cost {self.cost:.10g}, {self.horizon:.6g} s, {len(self.t)} times"
        ]
        if self.tightening_cost:
            lines[0] += f"; about {self.tightening_cost:.2g} of the cost are for limits held between the nodes"
        pools = {**self.states, **self.controls}
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

    def plot(self, against: Any = None, *, figure: Any = None) -> Any:
        """States and controls over time, with their bounds; see :func:`ocp.app.view.plots.plot_solution`.

        The solution is blue; what it is compared with, another one of the same states and controls or what ``resolve``
        made of the same joints, or several by name, orange. A notebook shows the figure, ``.savefig("a.png")`` writes
        it; ``figure=plt.figure()`` draws into a window.

        Raises:
            ProblemError: Nothing that can be compared, or of other states and controls.
        """
        return call_registered("plot_solution", self, against, figure)

    def _repr_html_(self) -> str:
        return str(call_registered("html_of_solution", self))

    def table(self) -> dict[str, np.ndarray]:
        """Columns by name, a row for every reported time: what pandas.DataFrame, polars.DataFrame, pyarrow.table take.

        ``time`` (s), states and controls; an entry of several is called ``NAME[k]``. Shape (M,) each.
        """
        columns = {"time": self.t}
        for name, values in {**self.states, **self.controls}.items():
            several = values.shape[1] > 1
            columns |= {f"{name}[{k}]" if several else name: column for k, column in enumerate(values.T)}
        return columns

    def costate(self, name: str) -> np.ndarray:
        """Costate of a state at the reported times: d(optimal cost)/d(state). Shape (M, n)."""
        return entry_named("state", name, self.costates)

    @interruptible
    def sensitivity(self, name: str) -> Sensitivity:
        """How this plan moves with a parameter, to first order, and from which to which value that is so.

        One linear system in the derivatives of variables and multipliers, with the limits that push held; for plans of
        direct methods. See :mod:`ocp.direct.sensitivity`.

        Raises:
            ProblemError: An unknown parameter; no optimum of a direct method under the bounds of its problem; or limits
                that contradict each other when the parameter moves.
        """
        computed: Sensitivity = call_registered("sensitivity", self, name)
        return computed

    def cost_gradient(self, name: str) -> np.ndarray:
        """Derivative of the optimal cost in a parameter, from the multipliers. Shape (n,)."""
        return entry_named("parameter", name, self.cost_gradients)

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
        slack = NODE_TOLERANCE * self.horizon
        if not np.all((times >= -slack) & (times <= self.horizon + slack)):
            words = f"time {time!r} is outside the plan, 0 to {self.horizon:g} s"
            raise ProblemError(words, name="time", value=time, limit=(0.0, self.horizon), time=time)
        return self.at_fraction(times / self.horizon)

    def at_fraction(self, fraction: Any) -> Sample:
        """As :meth:`at`, at fractions 0..1 of the horizon."""
        try:
            at = floats(fraction)
            inside = bool(((at >= -NODE_TOLERANCE) & (at <= 1 + NODE_TOLERANCE)).all())
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

    @property
    def phases(self) -> dict[str, tuple[float, float]]:
        """When each phase begins and ends, s, by name; empty of a problem without any (:mod:`ocp.problem.phases`)."""
        declared = {} if self.problem is None else self.problem.declared.phases
        if not declared:
            return {}
        times = self._sampled(
            [part for phase in declared.values() for part in (phase.begin, phase.duration)], np.ones(1)
        )
        begins, lengths = (np.ravel(times[k::2]) for k in (0, 1))
        return {name: (float(b), float(b + n)) for name, b, n in zip(declared, begins, lengths, strict=True)}

    def phase(self, name: str) -> Solution:
        """A phase as a plan over its own time, from 0 to its duration, states and controls by their names in it.

        Its cost is its own share; it comes without a problem: what is audited is the whole.

        Raises:
            ProblemError: There is no such phase.
        """
        times = self.phases
        begin, end = entry_named("phase", name, times)
        parts: dict[str, Any] = {pool: own_of(name, getattr(self, pool)) for pool in ("states", "controls", "costates")}
        for pool, kind in zip(("states", "controls", "costates"), INTERPOLANTS, strict=True):
            columns = [each.startswith(f"{name}.") for each in getattr(self, pool)]
            sizes = [values.shape[1] for values in getattr(self, pool).values()]
            curve = getattr(self, kind)
            parts[kind] = replace(curve, values=curve.values[:, :, np.repeat(columns, sizes)])
        own = self.problem.declared.phases[name]
        grid = np.union1d(self.state_interpolant.breaks, self.control_interpolant.breaks)
        places, weights = np.polynomial.legendre.leggauss(8)
        at = (grid[:-1, None] + np.diff(grid)[:, None] * (places + 1) / 2).ravel()
        density = self._sampled([own.running], at)[0].reshape(-1, len(places))
        cost = float(density @ weights @ np.diff(grid)) / 2 + float(self._sampled([own.terminal], np.ones(1))[0].item())
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
            problem_lost=f"phase {name!r} of {self.name!r} is audited with the whole",
            refinement=None,
            bound_tightening=None,
            tightening_cost=0.0,
        )

    def _sampled(self, expressions: list[Any], fractions: np.ndarray) -> list[np.ndarray]:
        """Expressions of what its problem declares, at fractions (M,) of the plan; each (M, n)."""
        form = Formulation.of(self.problem)
        plan = match_order(form, self)
        x, u = plan.state_interpolant(fractions), plan.control_interpolant(fractions)
        p = form.parameter_vector(self.parameters)
        first = (form.x0, plan.state_interpolant(np.zeros(1))[0]), (form.u0, plan.control_interpolant(np.zeros(1))[0])
        flat = [form.flat(expression) for expression in expressions]
        return form.sampled(flat, x, u, fractions * self.horizon, self.horizon, p, *first)

    @interruptible
    def audit(self, problem: Any = None, **settings: Any) -> Any:
        """Check the plan independently of the solver that made it; see :func:`ocp.audit.audit.audit`.

        Raises:
            AuditError: The solution comes without its problem, and none is given; says why.
        """
        known = problem if problem is not None else self.problem
        if known is None:
            why = f" ({self.problem_lost})" if self.problem_lost else ""
            words = f"plan {self.name!r} comes without its problem{why}; call audit(problem)"
            raise AuditError(words, name=self.name)
        return call_registered("audit", known, self, **settings)

    def with_problem(self, problem: Any) -> Solution:
        """The same solution tied to a problem, after :meth:`load`, or to None."""
        return replace(self, problem=problem, problem_lost="")

    def tied_to(self, problem: Problem) -> Solution:
        """Return the same solution tied to a problem that was read from a file.

        Raises:
            ProblemError: The problem is damaged, or has other states or controls.
        """
        try:
            check_variables_match(Formulation.of(problem), self)
        except ProblemError:
            raise
        except RECORD_ERRORS as error:
            raise ProblemError(f"the problem that was written is damaged: {error}", name="problem") from error
        return self.with_problem(problem)

    # ---- files -----------------------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the plan and its problem as arrays and JSON to one ``.npz`` file.

        The file is data: reading it runs nothing.

        The file is whole or as it was before, on the disk when this returns, of the mode that it had; a link is
        followed. What a killed save of the same file left behind is removed.

        A problem whose expressions are no elementary operations, such as one that calls a function of Python, is left
        out with a warning.

        Warns:
            StorageWarning: The problem is left out, and why.

        Raises:
            ProblemError: path is a folder, a pipe or a device, or the plan or its head is larger than :meth:`load`
                reads.
            OSError: The file cannot be written.
        """
        write_arrays(path, self.arrays(path))

    def arrays(self, path: str | os.PathLike[str], why_none: str = "") -> dict[str, np.ndarray]:
        """Return what :meth:`save` writes to a file at ``path``, by name.

        Args:
            why_none: Why the file shall hold no problem; "" where it shall.

        Raises:
            ProblemError: The head of the plan is larger than :meth:`load` reads.
        """
        arrays: dict[str, np.ndarray] = {name: getattr(self, name) for name in PLAIN}
        for kind in POOLS:
            arrays |= {f"{kind}/{name}": values for name, values in getattr(self, kind).items()}
        for kind in INTERPOLANTS:
            arrays |= {f"{kind}/{part}": getattr(getattr(self, kind), part) for part in PARTS}
        head = {"version": VERSION, **{key: getattr(self, key) for key in HEAD}, "status": self.status.value}
        head["order"] = {k: list(getattr(self, k)) for k in POOLS}
        if self.refinement is not None:
            head["refinement"] = self.refinement.__dict__
        if self.bound_tightening is not None:
            arrays["bound_tightening"] = self.bound_tightening
        written, head["problem_lost"] = (None, why_none) if why_none else self._written_problem()
        if written is None and self.problem is not None and not why_none:
            words = f"{path} is saved without its problem, so that nobody can audit it: {head['problem_lost']}"
            warnings.warn(StorageWarning(words), stacklevel=3)
        head["problem"], numbers = pack_record(written)
        arrays |= {f"problem/{name}": values for name, values in numbers.items()}
        arrays["head"] = np.frombuffer(json.dumps(head, default=plain).encode(), dtype=np.uint8)
        if arrays["head"].nbytes > MAX_HEAD_BYTES:
            words = f"{path}: the settings of the plan take more than the {MAX_HEAD_BYTES:.3g} bytes that are read"
            raise ProblemError(words, name="head", value=arrays["head"].nbytes, limit=MAX_HEAD_BYTES)
        return arrays

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Solution:
        """Read a file written by :meth:`save`, with its problem, whose guesses by functions are left out.

        The file is data. Its problem is rebuilt operation by operation, each of them checked: nothing of it is run.

        Raises:
            FileNotFoundError: There is no such file.
            ProblemError: The file cannot be read, is none, is larger than any plan, is of an unknown version or is not
                whole; names the part.
        """
        return cls.of_arrays(path, read_arrays(path))

    @classmethod
    def of_arrays(cls, path: str | os.PathLike[str], arrays: dict[str, np.ndarray]) -> Solution:
        """Return the solution whose arrays a file holds, as :meth:`load`; they are taken out of ``arrays``.

        Raises:
            ProblemError: As :meth:`load`.
        """
        try:
            head = read_head(path, arrays.pop("head"))
            version = head.pop("version")
            if isinstance(version, bool) or version != VERSION:
                words = f"{path}: written by another version of the format ({version}, not {VERSION})"
                raise ProblemError(words, name="version", value=version, limit=VERSION)
            order = head.pop("order")
            if set(order) != set(POOLS):
                raise ValueError(f"it has {', '.join(order)}, not {', '.join(POOLS)}")
            fields: dict[str, Any] = {
                kind: {name: arrays.pop(f"{kind}/{name}") for name in names} for kind, names in order.items()
            }
            fields |= {
                kind: PiecewisePolynomial(*(arrays.pop(f"{kind}/{part}") for part in PARTS)) for kind in INTERPOLANTS
            }
            past = head.pop("refinement", None)
            if past is not None:
                errors = past["errors"] if isinstance(past["errors"], dict) else {"integration": past["errors"]}
                rounds = tuple(past["intervals"]), {kind: tuple(values) for kind, values in errors.items()}
                fields["refinement"] = Refinement(*rounds, past["tolerance"], past["reached"])
            fields["bound_tightening"] = arrays.pop("bound_tightening", None)
            fields |= {name: arrays.pop(name) for name in PLAIN}
            numbers = {name: arrays.pop(f"problem/{name}") for name in ARRAY_NAMES}
            written = unpack_record(head.pop("problem"), numbers)
            parts = [name for name in arrays if "/" in name]  # what else stands in the file is somebody else's
            if parts:
                words = f"{path} holds {', '.join(parts)}, which no plan has"
                raise ProblemError(words, name=parts[0], value=str(path))
            head["status"] = read_status(path, head["status"])
            solution = cls(**head, **fields)
            check_structure(solution)
            check_finite(solution)
            return solution if written is None else solution.tied_to(Problem.from_record(written))
        except ProblemError:
            raise
        except Exception as error:  # what JSON and wrong types say is of many kinds
            raise ProblemError(f"{path} is not a saved solution: {error}", name="path", value=str(path)) from error

    # ---- with and without its problem ------------------------------------------------------------------------

    def _written_problem(self) -> tuple[dict[str, Any] | None, str]:
        """The problem as numbers and text, and ""; or None, and why there is none."""
        if self.problem is None:
            return None, self.problem_lost
        try:
            return self.problem.__getstate__(), ""
        except ProblemError as error:
            return None, str(error)

    def __getstate__(self) -> dict[str, Any]:
        """Pickled with its problem where that can be written, else without it, with the reason."""
        written, why = self._written_problem()
        return {**self.__dict__, "problem": written, "problem_lost": why}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """The same of what :meth:`__getstate__` gave."""
        problem = state["problem"]
        self.__dict__.update({**state, "problem": None if problem is None else Problem.from_record(problem)})

    def __copy__(self) -> Solution:
        """A solution of the same arrays and the same problem."""
        return replace(self)

    def __deepcopy__(self, memo: Any) -> Solution:
        """A solution of arrays of its own, of a copy of the problem."""
        return replace(self, **{f.name: deepcopy(getattr(self, f.name), memo) for f in dataclass_fields(self)})
