"""The indirect method: Pontryagin's minimum principle as a boundary value problem, solved by shooting.

States and costates are integrated together with a tight tolerance; Newton's method makes the segments meet and the
conditions at the ends and at the switches hold. It converges from near: a direct solution seeds it.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.collocation import Collocation
from ocp.errors import ProblemError, SolveError
from ocp.formulation import Formulation
from ocp.hamiltonian import Hamiltonian
from ocp.interpolation import PiecewisePolynomial
from ocp.nlp import Interrupt, interruptible
from ocp.problem import Problem
from ocp.solution import Solution
from ocp.switching import Arcs, read_arcs

__all__ = ["Indirect", "PreparedIndirect"]

NODES = 0.5 - 0.5 * np.cos(np.pi * np.arange(10) / 9)  # of the reported interpolant in a segment, Chebyshev-Lobatto
HALVINGS = 12
STEPS = 40


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
        if isinstance(self.segments, bool) or not isinstance(self.segments, int | np.integer) or self.segments < 1:
            raise ProblemError(f"Indirect: segments must be a positive integer, not {self.segments!r}")
        if self.shooting not in ("multiple", "backward"):
            raise ProblemError(f"Indirect: shooting must be 'multiple' or 'backward', not {self.shooting!r}")
        for name in ("tolerance", "residual"):
            value = getattr(self, name)
            if not (np.isfinite(value) and 0 < value < 1):
                raise ProblemError(f"Indirect: {name} must be between 0 and 1, not {value!r}")


Seeder = Callable[[Problem, Any, Any, Any], Solution]  # problem, method, parameters, guess


class PreparedIndirect:
    """A problem with its Hamiltonian system derived once, to be solved many times.

    Attributes:
        formulation, hamiltonian: What was derived. seconds: Wall time of it.
    """

    def __init__(self, problem: Problem, method: Indirect, seeder: Seeder) -> None:
        began = time.monotonic()
        self.problem, self.method, self._seeder = problem, method, seeder
        self.formulation = Formulation(problem)
        self.hamiltonian = Hamiltonian.of(self.formulation)
        self._outputs = self.hamiltonian.outputs()
        self._step = self._integrator(np.array([1.0]))
        self._dense = self._integrator(NODES[1:])
        self._ends = end_conditions(self.formulation)
        self._systems: dict[tuple[int, ...], tuple[Any, Any]] = {}
        self.seconds = time.monotonic() - began

    def solve(
        self,
        parameters: Mapping[str, Any] | None = None,
        guess: Solution | Mapping[str, Any] | None = None,
        check: bool = True,
    ) -> Solution:
        """Solve with these parameters; a solution as ``guess`` seeds states and costates, anything else its own seed.

        Raises:
            ProblemError: Wrong parameters or guess. SolveError: Newton failed, or a control has a singular arc.
        """
        form = self.formulation
        p = form.parameter_vector(dict(parameters or {}))
        bounds = form.bound_values(p)
        note = ""
        if isinstance(guess, Solution):
            seed = guess
            if set(seed.costates) != set(form.states):
                raise ProblemError(f"the guess, plan {seed.name!r}, has no costates of {sorted(form.states)}")
        else:
            seed = self._seeder(self.problem, self.method.seed, parameters, guess)
            note = f"; seeded by its own direct solution ({seed.method['type']}, {self.method.seed.intervals} intervals)"
        began = time.monotonic()
        arcs = read_arcs(self.hamiltonian, self._outputs, seed, p, bounds, self.method.segments)
        system = self._system(arcs)
        start, data = self._start(seed, arcs, p, bounds)
        found = newton(system, start, data, self._scale(start, arcs), self.method.residual)
        solution = self._solution(found, arcs, data, p, note, time.monotonic() - began)
        if check and not found.success:
            raise SolveError(self._diagnosis(found, solution), solution)
        return solution

    # ---- the boundary value problem --------------------------------------------------------------------------

    def _integrator(self, places: np.ndarray) -> Any:
        """Function (y, q) -> (y at ``places``, integrals of L and dH/dT); q = [t0, duration, T, p, bang, guess]."""
        ham = self.hamiltonian
        sizes = ham.sizes
        flow = ham.flow()
        sym = (ca.SX if flow.is_a("SXFunction") else ca.MX).sym
        y, place = sym("y", 2 * sizes[0]), sym("place")
        q = sym("q", 3 + sum(sizes[4:]))
        cuts = np.cumsum([3, *sizes[4:]])
        tail = [q[int(a) : int(b)] for a, b in zip(cuts, cuts[1:], strict=False)]
        x_rate, lam_rate, cost, by_horizon = flow(y[: sizes[0]], y[sizes[0] :], q[0] + place * q[1], q[2], *tail)
        ode, quad = q[1] * ca.vertcat(x_rate, lam_rate), q[1] * ca.vertcat(cost, by_horizon)
        tolerance = self.method.tolerance
        options = {
            "reltol": tolerance,
            "abstol": tolerance,
            "max_num_steps": 50_000,
            "quad_err_con": True,
            "linear_multistep_method": "adams",
            "show_eval_warnings": False,
        }
        dae = {"x": y, "t": place, "p": q, "ode": ode, "quad": quad}
        integrator = ca.integrator("flow", "cvodes", dae, 0.0, places.tolist(), options)
        y, q = ca.MX.sym("y", 2 * sizes[0]), ca.MX.sym("q", q.numel())
        result = integrator(x0=y, p=q)
        return ca.Function("segment", [y, q], [result["xf"], result["qf"][:, -1]])

    def _system(self, arcs: Arcs) -> tuple[Any, Any]:
        """Residual and its Jacobian as functions of (unknowns, data), for a number of segments in every arc."""
        key = tuple(arcs.segments)
        if key not in self._systems:
            build = self._backward if self.method.shooting == "backward" else self._multiple
            z, data, residual = build(arcs)
            jacobian = ca.jacobian(residual, z)
            self._systems[key] = (
                ca.Function("residual", [z, data], [residual]),
                ca.Function("jacobian", [z, data], [jacobian]),
            )
        return self._systems[key]

    def _layout(self, arcs: Arcs) -> dict[str, slice]:
        """Where everything stands in the vector of unknowns."""
        form = self.formulation
        total = sum(arcs.segments)
        sizes = {
            "y": 2 * form.nx * (total + 1),
            "switches": len(arcs.switches),
            "horizon": int(form.horizon_is_free),
            "start": len(form.start),
            "end": len(form.end),
        }
        cuts = np.cumsum([0, *sizes.values()])
        return {name: slice(int(a), int(b)) for name, a, b in zip(sizes, cuts, cuts[1:], strict=False)}

    def _data(self, arcs: Arcs) -> dict[str, slice]:
        """Where everything stands in the vector of data: horizon if fixed, p, end values, bang values, guesses."""
        sizes = self.hamiltonian.sizes
        total = sum(arcs.segments)
        parts = {"horizon": 1, "p": sizes[4], "ends": 4 * sizes[0], "bang": sizes[5] * total, "guess": sizes[6] * total}
        cuts = np.cumsum([0, *parts.values()])
        return {name: slice(int(a), int(b)) for name, a, b in zip(parts, cuts, cuts[1:], strict=False)}

    def _multiple(self, arcs: Arcs) -> tuple[Any, Any, Any]:
        """Forward multiple shooting: unknown y at every segment's start and at the end."""
        form, ham = self.formulation, self.hamiltonian
        at, of = self._layout(arcs), self._data(arcs)
        z, data = ca.MX.sym("z", at["end"].stop), ca.MX.sym("data", of["guess"].stop)
        total = sum(arcs.segments)
        y = ca.reshape(z[at["y"]], 2 * form.nx, total + 1)
        horizon = z[at["horizon"]] if form.horizon_is_free else data[of["horizon"]]
        inputs = self._segment_data(z[at["switches"]], horizon, data, arcs)
        ends, quads = self._step.map(total)(y[:, :-1], inputs)
        residuals = [ca.vec(y[:, 1:] - ends)]
        last = inputs[:, -1]
        for i, (component, node) in enumerate(zip(arcs.components, arcs.nodes, strict=True)):
            here = y[:, int(node)]
            values = self._outputs(*self._arguments(here, z[at["switches"]][i], horizon, inputs[:, int(node) - 1]))
            residuals.append(values[3][component])
        values = self._outputs(*self._arguments(y[:, -1], horizon, horizon, last))
        multipliers = z[at["start"]], z[at["end"]]
        conditions, by_horizon = self._ends(y[:, 0], y[:, -1], horizon, data[of["p"]], *multipliers, data[of["ends"]])
        residuals.append(conditions)
        if form.horizon_is_free:
            residuals.append(values[2] + by_horizon + ca.sum2(quads[1, :]))
        return z, data, ca.vertcat(*residuals)

    def _backward(self, arcs: Arcs) -> tuple[Any, Any, Any]:
        """Backward shooting: unknown end state only; the start must be met."""
        form = self.formulation
        if len(form.end) or len(form.start) or form.horizon_is_free or arcs.components or form.ties_ends:
            raise ProblemError(
                "backward shooting takes problems with a given start, a free end state, a fixed horizon and no switches; "
                "use Indirect(shooting='multiple')"
            )
        of = self._data(arcs)
        total = sum(arcs.segments)
        z, data = ca.MX.sym("z", form.nx), ca.MX.sym("data", of["guess"].stop)
        _, y_start = self._chain(z, data, arcs, total)
        return z, data, y_start[: form.nx] - data[of["ends"]][: form.nx]

    def _chain(self, state: Any, data: Any, arcs: Arcs, total: int) -> tuple[list[Any], Any]:
        """y at all nodes from the end to the start, integrated backwards from an end state."""
        form, of = self.formulation, self._data(arcs)
        horizon = data[of["horizon"]]
        gradient = ca.gradient(form.terminal, form.x)
        terminal = ca.Function("terminal", [form.x, form.t, form.T, form.p], [gradient])
        y = ca.vertcat(state, terminal(state, horizon, horizon, data[of["p"]]))
        inputs = self._segment_data(ca.MX(0, 1), horizon, data, arcs)
        nodes = [y]
        for k in reversed(range(total)):
            q = ca.vertcat(inputs[0, k] + inputs[1, k], -inputs[1, k], inputs[2:, k])
            y = self._step(y, q)[0]
            nodes.append(y)
        return nodes, y

    def _segment_data(self, switches: Any, horizon: Any, data: Any, arcs: Arcs) -> Any:
        """The q of every segment side by side."""
        of, total = self._data(arcs), sum(arcs.segments)
        knots = ca.vertcat(0, switches, horizon)
        begins, lengths = [], []
        for a, count in enumerate(arcs.segments):
            length = (knots[a + 1] - knots[a]) / count
            begins += [knots[a] + j * length for j in range(count)]
            lengths += [length] * count
        sizes = self.hamiltonian.sizes
        return ca.vertcat(
            ca.horzcat(*begins),
            ca.horzcat(*lengths),
            ca.repmat(ca.vertcat(horizon, data[of["p"]]), 1, total),
            ca.reshape(data[of["bang"]], sizes[5], total),
            ca.reshape(data[of["guess"]], sizes[6], total),
        )

    def _arguments(self, y: Any, at: Any, horizon: Any, q: Any) -> list[Any]:
        sizes = self.hamiltonian.sizes
        cuts = np.cumsum([3, *sizes[4:]])
        tail = [q[int(a) : int(b)] for a, b in zip(cuts, cuts[1:], strict=False)]
        return [y[: sizes[0]], y[sizes[0] :], at, horizon, *tail]

    # ---- before and after ------------------------------------------------------------------------------------

    def _start(
        self, seed: Solution, arcs: Arcs, p: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Unknowns and data from the seed."""
        form = self.formulation
        horizon = seed.horizon if form.horizon_is_free else float(form.horizon_at(p))
        stretch = seed.horizon / horizon
        times = arcs.times(horizon)
        fractions = times / horizon
        sample = seed.at_fraction(fractions)
        x = np.hstack([sample[name] for name in form.states])
        stacked = np.hstack([seed.costates[name] for name in form.states])
        lam = np.column_stack([np.interp(fractions * seed.horizon, seed.t, column) for column in stacked.T])
        del stretch
        low, high = bounds
        places = form.bounds.places
        ends = np.concatenate([low[places[k]] if side == 0 else high[places[k]]
                               for k in ("initial", "terminal") for side in (0, 1)])  # fmt: skip
        ends = np.where(np.isfinite(ends), ends, 1e300)
        middle = seed.at_fraction(0.5 * (fractions[:-1] + fractions[1:]))
        control = np.hstack([middle[name] for name in form.controls]) if form.controls else np.zeros((len(times) - 1, 0))
        guess = np.hstack([control[:, list(self.hamiltonian.smooth)], np.zeros((len(times) - 1, len(form.path)))])
        data = np.concatenate([[horizon], p, ends, arcs.bang.ravel(), guess.ravel()])
        if self.method.shooting == "backward":
            return x[-1], data
        y = np.hstack([x, lam])
        free = [horizon] if form.horizon_is_free else []
        multipliers = np.zeros(len(form.start) + len(form.end))
        return np.concatenate([y.ravel(), arcs.switches * horizon, free, multipliers]), data

    def _scale(self, start: np.ndarray, arcs: Arcs) -> float:
        return float(max(1.0, np.max(np.abs(start))))

    def _solution(
        self, found: Found, arcs: Arcs, data: np.ndarray, p: np.ndarray, note: str, seconds: float
    ) -> Solution:
        form, ham = self.formulation, self.hamiltonian
        at = self._layout(arcs)
        total = sum(arcs.segments)
        z = found.unknowns
        if self.method.shooting == "backward":
            symbols = ca.MX.sym("z", form.nx), ca.MX.sym("data", data.size)
            chain = ca.Function("chain", symbols, [ca.horzcat(*reversed(self._chain(*symbols, arcs, total)[0]))])
            y = np.asarray(chain(z, data).full())
            switches, horizon = np.zeros(0), float(data[0])
        else:
            y = z[at["y"]].reshape(total + 1, 2 * form.nx).T
            switches = z[at["switches"]]
            horizon = float(z[at["horizon"]][0]) if form.horizon_is_free else float(data[0])
        inputs = np.asarray(ca.evalf(self._segment_data(ca.DM(switches), ca.DM(horizon), ca.DM(data), arcs)).full())
        dense = np.full((total, len(NODES), 2 * form.nx), np.nan)
        dense[:, 0] = y[:, :-1].T
        cost = 0.0
        for k in range(total):
            try:
                states, quads = self._dense(y[:, k], inputs[:, k])
                dense[k, 1:], cost = states.full().T, cost + float(quads[0])
            except RuntimeError:
                cost = float("nan")
        times = inputs[0][:, None] + inputs[1][:, None] * NODES
        count = times.size
        repeated = np.repeat(inputs, len(NODES), axis=1)
        flat = dense.reshape(count, -1)
        arguments = self._arguments(flat.T, times.reshape(1, -1), repeated[2:3], repeated)
        control = np.asarray(self._outputs.map(count)(*arguments)[0].full()).reshape(form.nu, count).T
        terminal = ca.Function("terminal", [form.x, form.x0, form.u0, form.t, form.T, form.p], [form.terminal])
        cost += float(terminal(flat[-1, : form.nx], flat[0, : form.nx], np.zeros(form.nu), horizon, horizon, p))

        breaks = np.concatenate([inputs[0], [horizon]]) / horizon
        keep = np.ones((total, len(NODES)), dtype=bool)
        keep[:-1, -1] = False  # the end of a segment is the start of the next
        keep = keep.ravel()
        reported = times.ravel()[keep]
        reported[-1] = horizon
        settings = dataclasses.asdict(self.method)
        return Solution(
            name=form.name,
            method={"type": "Indirect", **settings, "control": ham.how, "switches": switches.tolist()},
            solver="newton",
            success=found.success and bool(np.isfinite(cost)) and horizon > 0,
            status=found.status + note,
            cost=cost,
            iterations=found.steps,
            horizon=horizon,
            t=reported,
            states={name: flat[keep][:, s] for name, s in form.states.items()},
            controls={name: control[keep][:, s] for name, s in form.controls.items()},
            costates={name: flat[keep][:, form.nx :][:, s] for name, s in form.states.items()},
            parameters={name: p[s] for name, s in form.parameters.items()},
            state_interpolant=PiecewisePolynomial(breaks, NODES, dense[:, :, : form.nx]),
            control_interpolant=PiecewisePolynomial(breaks, NODES, control.reshape(total, len(NODES), form.nu)),
            variables=z,
            multipliers=np.zeros(0),
            seconds={"build": self.seconds, "solve": seconds},
            problem=self.problem,
        )

    def _diagnosis(self, found: Found, solution: Solution) -> str:
        return (
            f"problem {self.problem.name!r}: the indirect method failed: {found.status} after {found.steps} Newton steps, "
            f"residual {found.residual:.2e}\n  try a finer direct solution as guess, more segments, or a direct method"
        )


def end_conditions(form: Formulation) -> Any:
    """Function (y0, yN, T, p, nu0, nu1, ends) -> (2 nx + n_start + n_end conditions, dPhi/dT).

    ``ends`` are lower and upper values of initial, then of terminal states; an entry whose two values agree is given,
    elsewhere the costate there is the gradient of Phi = terminal cost + nu . constraints (with minus at the start).
    """
    sym = form.problem.symbols.sym
    nx = form.nx
    y0, y1, ends = sym("y0", 2 * nx), sym("y1", 2 * nx), sym("ends", 4 * nx)
    nu0, nu1 = sym("nu0", len(form.start)), sym("nu1", len(form.end))
    low = form.bounds.function(form.p)[0]
    level0 = ca.vertcat(form.problem.symbols(0, 1), *[low[int(i)] for i in form.start.bounds])
    level1 = ca.vertcat(form.problem.symbols(0, 1), *[low[int(i)] for i in form.end.bounds])
    begin = ca.substitute([form.start.expression - level0], [form.x, form.t], [form.x0, 0])[0]
    end, terminal = ca.substitute([form.end.expression - level1, form.terminal], [form.t], [form.T])
    phi = terminal + ca.dot(nu0, begin) + ca.dot(nu1, end)
    parts = [ca.gradient(phi, form.x0), ca.gradient(phi, form.x), ca.gradient(phi, form.T), begin, end]
    parts = ca.substitute([ca.densify(part) for part in parts], [form.x0, form.x], [y0[:nx], y1[:nx]])
    given = [ends[2 * i * nx : (2 * i + 1) * nx] for i in (0, 1)]
    fixed = [ends[2 * i * nx : (2 * i + 1) * nx] == ends[(2 * i + 1) * nx : (2 * i + 2) * nx] for i in (0, 1)]
    first = ca.if_else(fixed[0], y0[:nx] - given[0], y0[nx:] + parts[0])
    last = ca.if_else(fixed[1], y1[:nx] - given[1], y1[nx:] - parts[1])
    conditions = ca.vertcat(first, last, parts[3], parts[4])
    return ca.Function("ends", [y0, y1, form.T, form.p, nu0, nu1, ends], [conditions, parts[2]])


# ---- Newton --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Found:
    """Where Newton's method ended."""

    unknowns: np.ndarray
    residual: float
    steps: int
    success: bool
    status: str


def newton(system: tuple[Any, Any], start: np.ndarray, data: np.ndarray, scale: float, tolerance: float) -> Found:
    """Damped Newton's method on a sparse system; the step is halved until the residual falls."""
    residual, jacobian = system

    def evaluate(z: np.ndarray) -> np.ndarray:
        try:
            return np.asarray(residual(z, data).full()).reshape(-1)
        except RuntimeError:  # the integration broke down: as bad as can be
            return np.full(z.size, np.inf)

    z, value = start, evaluate(start)
    if value.size != start.size:
        raise ProblemError(f"the boundary value problem has {value.size} conditions for {start.size} unknowns")
    interrupt = Interrupt()
    polished = False
    with interruptible(interrupt):
        for steps in range(STEPS + 1):
            size = float(np.max(np.abs(value), initial=0.0))
            if not np.isfinite(size):
                return Found(z, size, steps, False, "the integration broke down at the seed")
            if size <= tolerance * scale and polished:
                return Found(z, size, steps, True, f"Converged in {steps} Newton steps")
            polished = size <= tolerance * scale  # one more step: it costs little and gains digits
            if interrupt.stop or steps == STEPS:
                break
            try:
                step = np.asarray(ca.solve(jacobian(z, data), ca.DM(-value), "qr").full()).reshape(-1)
            except RuntimeError:
                return Found(z, size, steps, False, "the integration of the sensitivities broke down")
            if not np.all(np.isfinite(step)):
                return Found(z, size, steps, False, "Newton's matrix is singular: the conditions do not determine the plan")
            length = 1.0
            for _ in range(HALVINGS):
                trial = z + length * step
                new = evaluate(trial)
                if np.linalg.norm(new) < (1.0 - 1e-4 * length) * np.linalg.norm(value) or polished:
                    break
                length *= 0.5
            else:
                return Found(z, size, steps, False, "no step along Newton's direction makes the residual smaller")
            if polished and np.max(np.abs(new)) > size:
                return Found(z, size, steps, True, f"Converged in {steps} Newton steps")
            z, value = trial, new
    return Found(z, size, steps, False, "interrupted" if interrupt.stop else f"not converged in {STEPS} Newton steps")
