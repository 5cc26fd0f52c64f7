"""The indirect method: Pontryagin's minimum principle as a boundary value problem, solved by shooting.

States and costates are integrated together with a tight tolerance; Newton's method makes the segments meet and the
conditions at the ends and at the switches hold. It converges from near: a direct solution seeds it.

Does the control found for an extremal make the Hamiltonian least? First and second order, and at its bounds.

Newton's method makes the Hamiltonian stationary and switches where told; a maximum, a saddle or a wrong order of
bang-bang arcs solves these equations as well. Bryson, Ho 1975, section 3.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from ocp.console import interruptible, time_limited
from ocp.curves import PiecewisePolynomial
from ocp.direct.collocation import Collocation
from ocp.direct.nlp import SOLVERS
from ocp.errors import (
    Interrupted,
    ProblemError,
    SolveError,
    checked_choice,
    checked_count,
    checked_mapping,
    checked_positive,
    checked_time_limit,
)
from ocp.indirect.boundary import LOBATTO, BoundaryProblem, NewtonResult, newton
from ocp.indirect.hamiltonian import Hamiltonian
from ocp.indirect.seed import ControlArcs, read_arcs, read_unknowns
from ocp.indirect.sensitivity import Extremal, cost_gradient
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.invariants import bounds_to_solve
from ocp.problem.problem import Problem
from ocp.problem.values import evaluate_at_samples
from ocp.solution import ByName, Guess, Solution, check_variables_match
from ocp.status import SolverStatus
from ocp.tolerances import FLAT_SHARE, ROUNDING_SHARE, SOLVER_SHARE

__all__ = ["Indirect", "PreparedIndirect", "hamiltonian_defect"]


def hamiltonian_defect(ham: Hamiltonian, path: Extremal, p: np.ndarray, bounds: Bounds) -> str:
    """What keeps the controls of an extremal from making the Hamiltonian least, or "".

    Each sample must be stationary in the free controls, push those at a bound outwards, and not curve downwards.
    """
    form = ham.form
    if not form.nu:
        return ""
    u = path.controls.reshape(-1, form.nu)
    index = form.bounds.places["control"]
    low, high = bounds[0][index], bounds[1][index]
    with np.errstate(invalid="ignore"):
        width = np.where(np.isfinite(high - low), high - low, 1.0)
    at_low, at_high = u <= low + ROUNDING_SHARE * width, u >= high - ROUNDING_SHARE * width
    slope, parts, curvature, rows, by_control = samples(ham, path, p)
    if not all(np.all(np.isfinite(v)) for v in (slope, curvature, rows)):
        return "the Hamiltonian is not finite along the plan"

    wrong = np.where(at_low, np.maximum(-slope, 0.0), np.where(at_high, np.maximum(slope, 0.0), np.abs(slope)))
    # all parts may vanish at the optimum; then the slope is judged by what a change of the control's own size makes
    scale = float(np.max(parts)) + float(np.max(np.abs(curvature))) * max(ROUNDING_SHARE, float(np.max(np.abs(u))))
    wrong = np.where(at_low & at_high, 0.0, wrong) / max(scale, np.finfo(float).tiny)
    k, i = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
    if wrong[k, i] > SOLVER_SHARE:
        label, time = form.control_labels[i], path.t.ravel()[k]
        if i in ham.linear:
            return (
                f"control {label!r} is at the wrong bound at {time:.4g} s: the Hamiltonian would be less at the other; "
                "its switches are not those of the seed, or it has a singular arc or chatters; seed it more finely or "
                "use a direct method with held controls"
            )
        return f"the Hamiltonian is not least in control {label!r} at {time:.4g} s"
    if len(form.path) and np.max(np.abs(rows)) > SOLVER_SHARE * max(1.0, float(np.max(np.abs(u)))):
        return "the path equalities are not met"
    free = ~(at_low | at_high)
    for k in np.flatnonzero(free.any(axis=1)):
        inside = curvature[k][np.ix_(free[k], free[k])]
        tangent = null_space(by_control[k][:, free[k]])
        least = np.min(np.linalg.eigvalsh(tangent.T @ inside @ tangent), initial=0.0)
        # Newton leaves an extremal rounding alone: it is known better than a plan, of which FLAT_SHARE is said
        if least < -0.1 * FLAT_SHARE * np.max(np.abs(curvature[k])):
            names = ", ".join(
                repr(label) for label, is_free in zip(form.control_labels, free[k], strict=True) if is_free
            )
            return f"the Hamiltonian is stationary but not least in control {names} at {path.t.ravel()[k]:.4g} s"
    return ""


def samples(ham: Hamiltonian, path: Extremal, p: np.ndarray) -> list[np.ndarray]:
    """At K samples: dH/du and the sum of sizes of its parts (K, nu), d2H/du2 (K, nu, nu), path (K, m), its Jacobian."""
    form = ham.form
    by_control = ca.jacobian(ham.rows, form.u)
    parts = ca.fabs(ca.gradient(form.running, form.u)) + ca.mtimes(
        ca.fabs(ca.jacobian(form.f, form.u)).T, ca.fabs(ham.lam)
    )
    hessian, slope = ca.hessian(ham.value, form.u)
    outputs = [slope, parts, hessian, ham.rows, by_control]
    first, size, second, rows, jacobian = path.sampled(ham, outputs, p)
    count = path.t.size
    square = second.reshape(count, form.nu, form.nu)
    return [first, size, square, rows, jacobian.reshape(count, form.nu, len(form.path)).transpose(0, 2, 1)]


def null_space(rows: np.ndarray) -> Any:
    """Orthonormal directions (n, k) that ``rows`` (m, n) do not see."""
    if rows.shape[0] == 0:
        return np.eye(rows.shape[1])
    _, sizes, directions = np.linalg.svd(rows)
    rank = int(np.sum(sizes > 1e-12 * max(1.0, float(np.max(sizes, initial=0.0)))))
    return directions[rank:].T


@dataclass(frozen=True)
class Indirect:
    """The minimum principle, solved by multiple or backward shooting.

    Attributes:
        segments: Number of segments, shared out among the arcs between switches of bang-bang controls.
        shooting: ``multiple`` (forward, all problems) or ``backward`` (from a free end state; fixed start and horizon).
        tolerance: Relative and absolute tolerance of the integrator (cvodes).
        residual: Largest residual, relative to the size of states and costates, that counts as solved.
        seed: The direct method that seeds it where no solution is given as guess.

    Raises:
        ProblemError: For a value that cannot be right.
    """

    segments: int = 20
    shooting: str = "multiple"
    tolerance: float = 1e-12
    residual: float = 1e-9
    seed: Collocation = dataclasses.field(default_factory=lambda: Collocation(40))

    def __post_init__(self) -> None:
        checked_count("Indirect: segments", self.segments)
        checked_choice("Indirect: shooting", self.shooting, ("multiple", "backward"))
        for name in ("tolerance", "residual"):
            checked_positive(f"Indirect: {name}", getattr(self, name), below=1.0)
        if not isinstance(self.seed, Collocation):
            raise ProblemError(
                f"Indirect: seed must be a Collocation(...), not {self.seed!r}", name="seed", value=self.seed
            )

    @interruptible
    def prepare(
        self,
        problem: Problem,
        *,
        solver: str = "ipopt",
        options: ByName = None,
        compiled: bool = False,
        scaling: bool = True,
    ) -> PreparedIndirect:
        """Derive the Hamiltonian system of a problem once; see :func:`ocp.methods.prepare`.

        ``solver``, ``options``, ``compiled`` and ``scaling`` are for the direct solution that seeds it.
        """
        checked_choice("solver", solver, SOLVERS)
        how = {
            "solver": solver,
            "options": checked_mapping("options", options),
            "compiled": compiled,
            "scaling": scaling,
        }
        return PreparedIndirect(problem, self, how)


class PreparedIndirect:
    """A problem with its Hamiltonian system derived once, to be solved many times.

    Attributes:
        formulation, hamiltonian, boundary: What was derived. seconds: Wall time of it.
    """

    def __init__(self, problem: Problem, method: Indirect, seeding: dict[str, Any]) -> None:
        began = time.monotonic()
        self.problem, self.method, self._seeding = problem, method, seeding
        self.formulation = Formulation.of(problem)
        for name in self.formulation.signals:
            words = f"problem {problem.name!r}: the indirect method takes no signals; {name!r} is one"
            raise ProblemError(words, name=name)
        self.hamiltonian = Hamiltonian.of(self.formulation)
        backward = method.shooting == "backward"
        self.boundary = BoundaryProblem(self.hamiltonian, backward=backward, tolerance=method.tolerance)
        self._lock = threading.RLock()  # casadi's functions take one caller at a time
        self.seconds = time.monotonic() - began

    def __reduce__(self) -> Any:
        """Pickled and copied as what it was prepared of, to be prepared again."""
        return type(self), (self.problem, self.method, self._seeding)

    @interruptible
    def solve(
        self, parameters: ByName = None, guess: Guess = None, check: bool = True, *, time_limit: float | None = None
    ) -> Solution:
        """Solve with these parameters; a solution as ``guess`` seeds states and costates, anything else its own seed.

        Raises:
            ProblemError: Wrong parameters or guess. SolveError: Newton failed, or a control has a singular arc.
        """
        with time_limited(checked_time_limit(time_limit)), self._lock:
            return self._solve(parameters, guess, check)

    def _solve(self, parameters: ByName, guess: Guess, check: bool) -> Solution:
        form = self.formulation
        p = form.parameter_vector(checked_mapping("parameters", parameters))
        bounds = bounds_to_solve(form, p)
        note = ""
        if isinstance(guess, Solution):
            seed = guess
            check_variables_match(form, seed)
            missing = [name for name in form.states if name not in seed.costates]
            if missing:
                words = f"the guess, plan {seed.name!r}, has no costates of {', '.join(missing)}"
                raise ProblemError(words, name=missing[0])
        else:
            direct = self.method.seed
            if self.hamiltonian.linear:  # bang-bang controls ring between free collocation points
                direct = dataclasses.replace(direct, control="held")
            try:
                seed = direct.prepare(self.problem, **self._seeding).solve(parameters, guess)
            except SolveError as error:
                return self._no_seed("the direct solution that was to seed it failed: ", error, error.solution, check)
            note = f"; seeded by its own direct solution ({seed.method['type']}, {direct.intervals} intervals)"
        began = time.monotonic()
        try:
            arcs = read_arcs(self.hamiltonian, self.boundary.outputs, seed, p, bounds, self.method.segments)
        except SolveError as error:
            return self._no_seed("", error, seed, check)
        system = self.boundary.system(arcs)
        start, data = read_unknowns(self.hamiltonian, seed, arcs, p, bounds, backward=self.boundary.backward)
        found = newton(system, start, data, float(max(1.0, np.max(np.abs(start)))), self.method.residual)
        found = self._check_order(found, arcs, bounds)
        solution = self._solution(found, arcs, data, p, bounds, note, time.monotonic() - began)
        if found.status is SolverStatus.INTERRUPTED:
            words = f"problem {self.problem.name!r}: interrupted after {found.steps} Newton steps"
            raise Interrupted(words, solution)
        if check and not solution.success:
            raise SolveError(
                f"problem {self.problem.name!r}: the indirect method failed: {solution.message} after {found.steps} "
                f"Newton steps, residual {found.residual:.2e}\n  try a finer direct solution as guess, more segments, "
                "or a direct method",
                solution,
                name="residual",
                value=found.residual,
                limit=self.method.residual,
            )
        return solution

    def _no_seed(self, why: str, error: SolveError, seed: Solution | None, check: bool) -> Solution:
        """Raise SolveError because of a seed that cannot be used, or return that seed as no success."""
        if check or seed is None:
            words = f"problem {self.problem.name!r}: the indirect method failed: {why}{error}"
            told = {"name": error.name, "value": error.value, "limit": error.limit, "time": error.time}
            raise SolveError(words, seed, error.conflicts, **told) from error
        status = seed.status if not seed.success else SolverStatus.REJECTED
        return dataclasses.replace(seed, success=False, status=status, message=f"{why}{error}")

    # ---- before and after ------------------------------------------------------------------------------------

    def _check_order(self, found: NewtonResult, arcs: ControlArcs, bounds: Bounds) -> NewtonResult:
        """A root whose switches are out of order, or whose horizon is beyond its bounds, is no plan."""
        if self.method.shooting == "backward" or not found.success:
            return found
        at = self.boundary.layout(arcs)
        horizon = np.inf
        if self.formulation.horizon_is_free:
            horizon = float(found.unknowns[at["horizon"]][0])
            place = self.formulation.bounds.places["horizon"][0]
            low, high = bounds[0][place], bounds[1][place]
            if not low * (1 - ROUNDING_SHARE) <= horizon <= high * (1 + ROUNDING_SHARE):
                words = (
                    f"the horizon comes out as {horizon:.6g} s, beyond its bounds {low:g} .. {high:g} s; where a bound "
                    "holds it, fix it there"
                )
                return dataclasses.replace(found, status=SolverStatus.REJECTED, message=words)
        switches = found.unknowns[at["switches"]]
        knots = np.concatenate([[0.0], switches, [horizon]])
        # two controls may switch at once
        if np.all(np.diff(knots) > -ROUNDING_SHARE * np.max(np.abs(switches), initial=0.0)):
            return found
        words = f"the switches are not in order within the horizon: {np.round(knots[1:], 6).tolist()} s"
        return dataclasses.replace(found, status=SolverStatus.REJECTED, message=words)

    def _solution(
        self,
        found: NewtonResult,
        arcs: ControlArcs,
        data: np.ndarray,
        p: np.ndarray,
        bounds: Bounds,
        note: str,
        seconds: float,
    ) -> Solution:
        form, ham = self.formulation, self.hamiltonian
        y, inputs, switches, horizon = self.boundary.unpack(found.unknowns, arcs, data)
        pieces = self._pieces(y, inputs, bounds)
        count = len(pieces) * len(LOBATTO)
        dense = np.full((len(pieces), len(LOBATTO), 2 * form.nx), np.nan)
        cost = 0.0
        for i, (first, piece) in enumerate(pieces):
            dense[i, 0] = first
            states, spent = self.boundary.integrate(self.boundary.dense, first, piece)
            dense[i, 1:], cost = states.T, cost + float(spent[0])
        q: np.ndarray = np.array([piece for _, piece in pieces]).T
        times = q[0][:, None] + q[1][:, None] * LOBATTO
        flat = dense.reshape(count, -1)
        arguments = self.boundary.arguments(flat.T, times.reshape(1, -1), horizon, np.repeat(q, len(LOBATTO), axis=1))
        columns = [value.T if np.ndim(value) else value for value in arguments]
        control, multiplier = evaluate_at_samples(self.boundary.outputs, *columns)[:2]
        ends = flat[-1, : form.nx], flat[0, : form.nx], np.zeros(form.nu)
        cost += form.terminal_cost(*ends, horizon, p)

        shape = (len(pieces), len(LOBATTO))
        nu_start, nu_end = self.boundary.end_multipliers(found.unknowns, arcs)
        x, lam = dense[..., : form.nx], dense[..., form.nx :]
        u, mu = control.reshape(*shape, form.nu), multiplier.reshape(*shape, len(form.path))
        extremal = Extremal(LOBATTO, q[1], times, x, lam, u, mu, horizon, nu_start, nu_end)
        if found.success:
            reason = hamiltonian_defect(ham, extremal, p, bounds)
            if reason:
                found = dataclasses.replace(found, status=SolverStatus.REJECTED, message=reason)
        by_parameter = cost_gradient(ham, extremal, p, bounds) if form.np else np.zeros(0)
        breaks = np.concatenate([q[0], [horizon]]) / horizon
        own = np.ones(shape, dtype=bool)
        own[:-1, -1] = False  # the end of a piece is the start of the next
        keep = own.ravel()
        reported = times.ravel()[keep]
        reported[-1] = horizon
        interpolants = [PiecewisePolynomial(breaks, LOBATTO, values) for values in (x, u, lam)]
        settings = dataclasses.asdict(self.method)
        return Solution(
            name=form.name,
            method={"type": "Indirect", **settings, "control": ham.how, "switches": switches.tolist()},
            solver="newton",
            success=found.success and bool(np.isfinite(cost)),
            status=found.status,
            message=found.message + note,
            cost=cost,
            iterations=found.steps,
            horizon=horizon,
            t=reported,
            states={name: flat[keep][:, s] for name, s in form.states.items()},
            controls={name: control[keep][:, s] for name, s in form.controls.items()},
            costates={name: flat[keep][:, form.nx :][:, s] for name, s in form.states.items()},
            parameters={name: p[s] for name, s in form.parameters.items()},
            cost_gradients={name: by_parameter[s] for name, s in form.parameters.items()},
            state_interpolant=interpolants[0],
            control_interpolant=interpolants[1],
            costate_interpolant=interpolants[2],
            variables=found.unknowns,
            multipliers=np.zeros(0),
            seconds={"build": self.seconds, "solve": seconds},
            problem=self.problem,
        )

    def _pieces(self, y: np.ndarray, inputs: np.ndarray, bounds: Bounds) -> list[tuple[np.ndarray, np.ndarray]]:
        """(first y, q) of every reported piece: the segments, cut where a control meets its bound."""
        index = self.formulation.bounds.places["control"]
        low, high = bounds[0][index], bounds[1][index]

        def at_bound(first: np.ndarray, q: np.ndarray, place: float) -> np.ndarray:
            y = self.boundary.advance(first, q, place)
            arguments = self.boundary.arguments(y, q[0] + place * q[1], q[2], q)
            u = np.asarray(self.boundary.outputs(*arguments)[0].full()).reshape(-1)
            return np.asarray((u <= low) | (u >= high))

        pieces: list[tuple[np.ndarray, np.ndarray]] = []
        for first, q in zip(y.T[:-1], inputs.T, strict=True):
            cuts = [0.0]
            if self.hamiltonian.how != "quadratic":
                marks = [at_bound(first, q, place) for place in LOBATTO]
                for a, b, before, after in zip(LOBATTO, LOBATTO[1:], marks, marks[1:], strict=False):
                    if np.any(before != after):
                        cuts.append(bisect(partial(at_bound, first, q), a, b, before))
            cuts = [cut for cut in cuts if cut < 1.0 - 1e-9]
            if abs(q[1]) <= ROUNDING_SHARE * (abs(q[0]) + abs(q[1])):
                continue  # an arc between two switches at once
            for a, b in zip(cuts, [*cuts[1:], 1.0], strict=True):
                piece = np.concatenate([[q[0] + a * q[1], (b - a) * q[1]], q[2:]])
                pieces.append((self.boundary.advance(first, q, a), piece))
        return pieces


def bisect(marks: Callable[[float], np.ndarray], low: float, high: float, before: np.ndarray) -> float:
    """Where in low..high the marks stop being ``before``."""
    for _ in range(40):
        middle = 0.5 * (low + high)
        if np.array_equal(marks(middle), before):
            low = middle
        else:
            high = middle
    return high
