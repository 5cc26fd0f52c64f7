"""The indirect method: Pontryagin's minimum principle as a boundary value problem, solved by shooting.

States and costates are integrated with a tight tolerance. Newton's method meets the continuity conditions between
segments and the conditions at the ends and switches. It converges locally, so a direct solution seeds it.

These equations also hold for a maximum or a saddle of the Hamiltonian, or for a wrong order of bang-bang arcs. So the
controls of each extremal are tested to minimise the Hamiltonian, to first and second order and at their bounds. Bryson,
Ho 1975, section 3.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy

from ocp.console import interruptible, time_limited
from ocp.curves import PiecewisePolynomial
from ocp.direct.discretisation import Collocation
from ocp.direct.nlp import SOLVERS
from ocp.errors import Interrupted, ProblemError, SolveError, SolverStatus, checked_time_limit, require
from ocp.indirect.boundary import LOBATTO, BoundaryProblem, NewtonResult, evaluate, newton
from ocp.indirect.hamiltonian import Extremal, Hamiltonian, cost_gradient
from ocp.indirect.seed import ControlArcs, read_arcs, read_unknowns
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.invariants import bounds_to_solve
from ocp.problem.problem import Problem
from ocp.problem.values import evaluate_at_samples
from ocp.solution import ByName, Guess, Solution
from ocp.solution_data import check_variables_match, match_order
from ocp.tolerances import FLAT_SHARE, ROUNDING_SHARE, SOLVER_SHARE


def hamiltonian_defect(ham: Hamiltonian, path: Extremal, p: np.ndarray, bounds: Bounds) -> str:
    """Return the reason why the controls of an extremal do not minimise the Hamiltonian, or "" if they do.

    At each sample H must be stationary in the free controls, must not fall when a control leaves its bound, and must
    not curve downwards (Legendre-Clebsch condition).
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
    slope, parts, curvature, rows, by_control = control_derivatives(ham, path, p)
    if not all(np.all(np.isfinite(v)) for v in (slope, curvature, rows)):
        return "the Hamiltonian is not finite along the plan"

    violation = np.where(at_low, np.maximum(-slope, 0.0), np.where(at_high, np.maximum(slope, 0.0), np.abs(slope)))
    # all terms may vanish at the optimum; then the scale is the change of slope over the control's own size
    scale = float(np.max(parts)) + float(np.max(np.abs(curvature))) * max(ROUNDING_SHARE, float(np.max(np.abs(u))))
    violation = np.where(at_low & at_high, 0.0, violation) / max(scale, np.finfo(float).tiny)
    k, i = np.unravel_index(int(np.argmax(violation)), violation.shape)
    if violation[k, i] > SOLVER_SHARE:
        label, time = form.control_labels[i], path.t.ravel()[k]
        if i in ham.linear:
            return (
                f"control {label!r} is at the wrong bound at {time:.4g} s: the Hamiltonian is smaller at the other; "
                "the seed has other switches, a singular arc or chattering; use a finer seed or a direct method with "
                "held controls"
            )
        return f"the Hamiltonian is not minimal in control {label!r} at {time:.4g} s"
    if len(form.path) and np.max(np.abs(rows)) > SOLVER_SHARE * max(1.0, float(np.max(np.abs(u)))):
        return "the path equalities are not met"
    free = ~(at_low | at_high)
    for k in np.flatnonzero(free.any(axis=1)):
        inside = curvature[k][np.ix_(free[k], free[k])]
        tangent = scipy.linalg.null_space(by_control[k][:, free[k]], rcond=1e-12)
        least = np.min(np.linalg.eigvalsh(tangent.T @ inside @ tangent), initial=0.0)
        # an extremal is accurate to rounding, unlike a direct plan, for which FLAT_SHARE is meant
        if least < -0.1 * FLAT_SHARE * np.max(np.abs(curvature[k])):
            names = ", ".join(repr(form.control_labels[i]) for i in np.flatnonzero(free[k]))
            return f"the Hamiltonian is stationary but not minimal in control {names} at {path.t.ravel()[k]:.4g} s"
    return ""


def control_derivatives(ham: Hamiltonian, path: Extremal, p: np.ndarray) -> list[np.ndarray]:
    """Return derivatives of the Hamiltonian in the controls, and the path equalities, at K samples of an extremal.

    These are dH/du (K, nu), the sum of absolute terms of dH/du (K, nu), d2H/du2 (K, nu, nu), the path equalities (K, m)
    and their Jacobian (K, m, nu).
    """
    form = ham.form
    by_state_rates = ca.mtimes(ca.fabs(ca.jacobian(form.f, form.u)).T, ca.fabs(ham.lam))
    hessian, slope = ca.hessian(ham.value, form.u)
    terms = ca.fabs(ca.gradient(form.running, form.u)) + by_state_rates
    outputs = [slope, terms, hessian, ham.rows, ca.jacobian(ham.rows, form.u)]
    slopes, sizes, hessians, rows, jacobians = path.sampled(ham, outputs, p)
    shapes = (-1, form.nu, form.nu), (len(rows), form.nu, len(form.path))
    return [slopes, sizes, hessians.reshape(shapes[0]), rows, jacobians.reshape(shapes[1]).transpose(0, 2, 1)]


@dataclass(frozen=True)
class Indirect:
    """Indirect method, which solves the equations of Pontryagin's minimum principle by multiple or backward shooting.

    Attributes:
        segments: Number of segments, distributed over the arcs between switches of bang-bang controls.
        shooting: ``multiple`` (forward, all problems) or ``backward`` (from a free end state; fixed start and horizon).
        tolerance: Relative and absolute tolerance of the integrator (cvodes).
        residual: Largest residual of a solution, relative to the size of states and costates.
        seed: The direct method whose solution is the initial guess (seed) if the user gives no solution as guess.

    Raises:
        ProblemError: An invalid value.
    """

    segments: int = 20
    shooting: str = "multiple"
    tolerance: float = 1e-12
    residual: float = 1e-9
    seed: Collocation = dataclasses.field(default_factory=lambda: Collocation(40))

    def __post_init__(self) -> None:
        require.count("Indirect: segments", self.segments)
        require.choice("Indirect: shooting", self.shooting, ("multiple", "backward"))
        for name in ("tolerance", "residual"):
            require.positive(f"Indirect: {name}", getattr(self, name), below=1.0)
        if not isinstance(self.seed, Collocation):
            words = f"Indirect: seed must be a Collocation(...), not {self.seed!r}"
            raise ProblemError(words, name="seed", value=self.seed)

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
        """Derive the Hamiltonian system of a problem once, for repeated solves; see :func:`ocp.methods.prepare`.

        ``solver``, ``options``, ``compiled`` and ``scaling`` apply to the direct solution that is its initial guess.
        """
        require.choice("solver", solver, SOLVERS)
        options = require.mapping("options", options)
        seeding = {"solver": solver, "options": options, "compiled": compiled, "scaling": scaling}
        return PreparedIndirect(problem, self, seeding)


class PreparedIndirect:
    """A problem and its Hamiltonian system, derived once for repeated solves by the indirect method.

    Attributes:
        formulation, hamiltonian, boundary: The derived system. seconds: Wall time of the derivation.
    """

    def __init__(self, problem: Problem, method: Indirect, seeding: dict[str, Any]) -> None:
        began = time.monotonic()
        self.problem, self.method, self._seeding = problem, method, seeding
        self.formulation = Formulation.of(problem)
        for name in self.formulation.signals:
            words = f"problem {problem.name!r}: the indirect method does not support signals, such as {name!r}"
            raise ProblemError(words, name=name)
        self.hamiltonian = Hamiltonian.of(self.formulation)
        backward = method.shooting == "backward"
        self.boundary = BoundaryProblem(self.hamiltonian, backward=backward, tolerance=method.tolerance)
        self._lock = threading.RLock()  # casadi's functions are not reentrant
        self.seconds = time.monotonic() - began

    def __reduce__(self) -> Any:
        """Return the class and the arguments from which pickle and copy prepare the problem again."""
        return type(self), (self.problem, self.method, self._seeding)

    @interruptible
    def solve(
        self, parameters: ByName = None, guess: Guess = None, check: bool = True, *, time_limit: float | None = None
    ) -> Solution:
        """Solve the problem with given parameters, from a direct solution as initial guess (seed).

        A solution as ``guess`` is the seed; another guess serves to compute a seed.

        Raises:
            ProblemError: Invalid parameters or guess. SolveError: Newton's method failed, or a control has a singular
                arc.
        """
        with time_limited(checked_time_limit(time_limit)), self._lock:
            return self._solve(parameters, guess, check)

    def _solve(self, parameters: ByName, guess: Guess, check: bool) -> Solution:
        form = self.formulation
        p = form.parameter_vector(require.mapping("parameters", parameters))
        bounds = bounds_to_solve(form, p)
        note = ""
        if isinstance(guess, Solution):
            seed = guess
            check_variables_match(form, seed)
            missing = [name for name in form.states if name not in seed.costates]
            if missing:
                words = f"the guess, plan {seed.name!r}, has no costates of {', '.join(missing)}"
                raise ProblemError(words, name=missing[0])
            seed = match_order(form, seed)
        else:
            direct = self.method.seed
            if self.hamiltonian.linear:  # bang-bang controls oscillate between free collocation points
                direct = dataclasses.replace(direct, control="held")
            try:
                seed = direct.prepare(self.problem, **self._seeding).solve(parameters, guess)
            except SolveError as error:
                return self._reject_seed("the direct solution for its seed failed: ", error, error.solution, check)
            note = f"; seeded by its own direct solution ({seed.method['type']}, {direct.intervals} intervals)"
        began = time.monotonic()
        try:
            count = self.method.segments
            arcs = read_arcs(self.hamiltonian, self.boundary.outputs, seed, p, bounds=bounds, segments=count)
        except SolveError as error:
            return self._reject_seed("", error, seed, check)
        system = self.boundary.system(arcs)
        start, data = read_unknowns(self.hamiltonian, seed, arcs, p, bounds=bounds, backward=self.boundary.backward)
        root = newton(system, start, data, scale=float(max(1.0, np.max(np.abs(start)))), tolerance=self.method.residual)
        root = self._check_order(root, arcs, bounds)
        solution = self._solution(root, arcs, data, p, bounds, note, time.monotonic() - began)
        if root.status is SolverStatus.INTERRUPTED:
            words = f"problem {self.problem.name!r}: interrupted after {root.steps} Newton steps"
            raise Interrupted(words, solution)
        if check and not solution.success:
            raise SolveError(
                f"problem {self.problem.name!r}: the indirect method failed: {solution.message} after {root.steps} "
                f"Newton steps, residual {root.residual:.2e}\n  try a finer direct solution as guess, more segments, "
                "or a direct method",
                solution,
                name="residual",
                value=root.residual,
                limit=self.method.residual,
            )
        return solution

    def _reject_seed(self, why: str, error: SolveError, seed: Solution | None, check: bool) -> Solution:
        """Raise SolveError about an unusable seed or, if ``check`` is false, return the seed as a failed solution."""
        if check or seed is None:
            words = f"problem {self.problem.name!r}: the indirect method failed: {why}{error}"
            details = {"name": error.name, "value": error.value, "limit": error.limit, "time": error.time}
            raise SolveError(words, seed, error.conflicts, **details) from error
        status = seed.status if not seed.success else SolverStatus.REJECTED
        return dataclasses.replace(seed, success=False, status=status, message=f"{why}{error}")

    def _check_order(self, root: NewtonResult, arcs: ControlArcs, bounds: Bounds) -> NewtonResult:
        """Reject a result of Newton's method with bang-bang switches out of order or a horizon outside its bounds."""
        if self.method.shooting == "backward" or not root.success:
            return root
        at = self.boundary.layout(arcs)
        horizon = np.inf
        if self.formulation.horizon_is_free:
            horizon = float(root.unknowns[at["horizon"]][0])
            place = self.formulation.bounds.places["horizon"][0]
            low, high = bounds[0][place], bounds[1][place]
            if not low * (1 - ROUNDING_SHARE) <= horizon <= high * (1 + ROUNDING_SHARE):
                words = (
                    f"the horizon is {horizon:.6g} s, outside its bounds {low:g} to {high:g} s; if a bound is active, "
                    "fix the horizon there"
                )
                return dataclasses.replace(root, status=SolverStatus.REJECTED, message=words)
        switches = root.unknowns[at["switches"]]
        knots = np.concatenate([[0.0], switches, [horizon]])
        # two controls may switch simultaneously
        if np.all(np.diff(knots) > -ROUNDING_SHARE * np.max(np.abs(switches), initial=0.0)):
            return root
        words = f"the switches are not in order within the horizon: {np.round(knots[1:], 6).tolist()} s"
        return dataclasses.replace(root, status=SolverStatus.REJECTED, message=words)

    def _solution(
        self,
        root: NewtonResult,
        arcs: ControlArcs,
        data: np.ndarray,
        p: np.ndarray,
        bounds: Bounds,
        note: str,
        seconds: float,
    ) -> Solution:
        """Return the solution from the last Newton iterate; reject one that does not minimise the Hamiltonian."""
        form, ham = self.formulation, self.hamiltonian
        y, inputs, switches, horizon = self.boundary.unpack(root.unknowns, arcs, data)
        segments = self._segments(y, inputs, bounds)
        count = len(segments) * len(LOBATTO)
        samples_y = np.full((len(segments), len(LOBATTO), 2 * form.nx), np.nan)
        cost = 0.0
        for i, (first, segment) in enumerate(segments):
            samples_y[i, 0] = first
            states, integrals = evaluate(self.boundary.dense, first, segment)
            samples_y[i, 1:], cost = states.T, cost + float(integrals[0, 0])
        q: np.ndarray = np.array([segment for _, segment in segments]).T
        times = q[0][:, None] + q[1][:, None] * LOBATTO
        flat = samples_y.reshape(count, -1)
        arguments = self.boundary.arguments(flat.T, times.reshape(1, -1), horizon, np.repeat(q, len(LOBATTO), axis=1))
        columns = [value.T if np.ndim(value) else value for value in arguments]
        control, multiplier = evaluate_at_samples(self.boundary.outputs, *columns)[:2]
        ends = flat[-1, : form.nx], flat[0, : form.nx], np.zeros(form.nu)
        cost += form.terminal_cost(*ends, horizon=horizon, p=p)

        shape = (len(segments), len(LOBATTO))
        at = self.boundary.layout(arcs)
        nu_start, nu_end = (
            np.zeros(0) if self.boundary.backward else root.unknowns[at[end]] for end in ("start", "end")
        )
        x, lam = samples_y[..., : form.nx], samples_y[..., form.nx :]
        u, mu = control.reshape(*shape, form.nu), multiplier.reshape(*shape, len(form.path))
        extremal = Extremal(LOBATTO, q[1], times, x, lam, u, mu, horizon, nu_start, nu_end)
        if root.success:
            reason = hamiltonian_defect(ham, extremal, p, bounds)
            if reason:
                root = dataclasses.replace(root, status=SolverStatus.REJECTED, message=reason)
        by_parameter = cost_gradient(ham, extremal, p, bounds) if form.np else np.zeros(0)
        breaks = np.concatenate([q[0], [horizon]]) / horizon
        is_reported = np.ones(shape, dtype=bool)
        is_reported[:-1, -1] = False  # the end of a segment is the start of the next
        keep = is_reported.ravel()
        reported = times.ravel()[keep]
        reported[-1] = horizon
        interpolants = [PiecewisePolynomial(breaks, LOBATTO, values) for values in (x, u, lam)]
        settings = dataclasses.asdict(self.method)
        return Solution(
            name=form.name,
            method={"type": "Indirect", **settings, "control": ham.solved, "switches": switches.tolist()},
            solver="newton",
            success=root.success and bool(np.isfinite(cost)),
            status=root.status,
            message=root.message + note,
            cost=cost,
            iterations=root.steps,
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
            variables=root.unknowns,
            multipliers=np.zeros(0),
            seconds={"build": self.seconds, "solve": seconds},
            problem=self.problem,
        )

    def _segments(self, y: np.ndarray, inputs: np.ndarray, bounds: Bounds) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return start values and data of all shooting segments, which are split where a control reaches a bound."""
        index = self.formulation.bounds.places["control"]
        low, high = bounds[0][index], bounds[1][index]

        def at_bound(position: float, first: np.ndarray, q: np.ndarray) -> np.ndarray:
            y = self.boundary.advance(first, q, position)
            arguments = self.boundary.arguments(y, q[0] + position * q[1], q[2], q)
            u = np.asarray(self.boundary.outputs(*arguments)[0].full()).reshape(-1)
            return np.asarray((u <= low) | (u >= high))

        def change(position: float, first: np.ndarray, q: np.ndarray, before: np.ndarray) -> float:
            return 0.5 - np.array_equal(at_bound(position, first, q), before)

        segments: list[tuple[np.ndarray, np.ndarray]] = []
        for first, q in zip(y.T[:-1], inputs.T, strict=True):
            splits = [0.0]
            if self.hamiltonian.solved != "quadratic":
                at_bounds = [at_bound(position, first, q) for position in LOBATTO]
                for a, b, before, after in zip(LOBATTO, LOBATTO[1:], at_bounds, at_bounds[1:], strict=False):
                    if np.any(before != after):
                        splits.append(scipy.optimize.bisect(change, a, b, args=(first, q, before), xtol=1e-13))
            splits = [split for split in splits if split < 1.0 - 1e-9]
            if abs(q[1]) <= ROUNDING_SHARE * (abs(q[0]) + abs(q[1])):
                continue  # an empty arc between simultaneous switches
            for a, b in zip(splits, [*splits[1:], 1.0], strict=True):
                segment = np.concatenate([[q[0] + a * q[1], (b - a) * q[1]], q[2:]])
                segments.append((self.boundary.advance(first, q, a), segment))
        return segments
