"""A statement as each tool poses it: this package, rockit, Dymos and Drake, every one with settings that suit it.

A tool is a function (statement, intervals) -> (solve, what), where solve(p) -> cost solves from the guess when it is
called first, from the plan before when it is called again. It is imported in the function: none but the first need be
there. `python -m scripts.timing.tools TOOL PROBLEM MESHES` prints a row of JSON for each mesh, in a process of its own.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from ocp import Collocation, prepare
from scripts.timing.statements import STATEMENTS, Statement, with_reference

TOLERANCE = 1e-9
DEGREE = 4  # of the polynomials of this package, rockit and Dymos; Drake's are cubic
MOST_SECONDS = 40
"""Of the processor, for all meshes of a tool and a problem; what is not done by then stays out."""
FINE = 1e-9  # relative: meshes finer than one that comes so near are left out

Posed: TypeAlias = tuple[Callable[[float], float], str]


def selfmotion(statement: Statement, intervals: int) -> Posed:
    """By ipopt, functions interpreted, as by default."""
    method = Collocation(intervals, DEGREE, control="held" if statement.held else "points")
    prepared, last = prepare(statement.problem, method, options={"tol": TOLERANCE}), list[Any]()

    def solve(p: float) -> float:
        plan = prepared.solve({"p": p}, last[0] if last else None)
        last[:] = [plan]
        return float(plan.cost)

    return solve, f"Radau {DEGREE}, ipopt"


def rockit(statement: Statement, intervals: int) -> Posed:
    """Its collocation; controls that are free at every point are algebraic variables, which none of its own is."""
    import rockit as peer

    formulas, form = statement.formulas, statement.form
    horizon, states, controls = statement.guess
    low, high = statement.bounds("horizon")
    problem = peer.Ocp(T=peer.FreeTime(horizon) if low[0] < high[0] else float(low[0]))
    x = problem.state(form.nx)
    u = problem.control(form.nu) if statement.held else problem.algebraic(form.nu)
    p = problem.parameter()
    at = (x, u, problem.t, problem.T, p)
    problem.set_der(x, formulas["rates"](x, u, 0, 0, p))  # time is in none of these
    problem.add_objective(problem.integral(formulas["running"](x, u, 0, 0, p)))
    problem.add_objective(problem.at_tf(formulas["terminal"](x, problem.T)))
    everywhere: dict[str, Any] = {"grid": "integrator_roots"}
    for kind, over in (("state", x), ("control", u)):
        for i, (lower, upper) in enumerate(zip(*statement.bounds(kind), strict=True)):
            if np.isfinite([lower, upper]).any():
                problem.subject_to(problem_between(lower, over[i], upper), **everywhere)
    if low[0] < high[0]:
        problem.subject_to(problem_between(low[0], problem.T, high[0]))
    if formulas["equal"].numel_out(0):
        problem.subject_to(formulas["equal"](*at) == 0, **everywhere)
    if formulas["below"].numel_out(0):
        problem.subject_to(formulas["below"](*at) <= 0, **everywhere)
    for kind, place in (("initial", problem.at_t0), ("terminal", problem.at_tf)):
        lower, upper = statement.bounds(kind)
        for i in np.flatnonzero(lower == upper).tolist():
            problem.subject_to(place(x[i]) == lower[i])
    if formulas["start"].numel_out(0):
        problem.subject_to(problem.at_t0(formulas["start"](x, np.zeros(form.nu), 0, 0, p)) == 0)
    if statement.is_cyclic:
        joints = list(range(form.nu))
        problem.subject_to(problem.at_tf(x[joints]) == problem.at_t0(x[joints]))
    nodes = np.linspace(0.0, 1.0, 20 * intervals + 1)
    for over, curve in ((x, states), (u, controls)):
        guess = ca.interpolant("guess", "linear", [nodes * horizon], curve(nodes).ravel())
        problem.set_initial(over, guess(problem.t))
    quiet = {"print_time": False, "expand": True, "ipopt": {"print_level": 0, "sb": "yes", "tol": TOLERANCE}}
    problem.solver("ipopt", quiet)
    problem.method(peer.DirectCollocation(N=intervals, degree=DEGREE))
    problem.set_value(p, statement.p)
    last = list[Any]()

    def solve(value: float) -> float:
        problem.set_value(p, value)
        if last:
            opti = problem._method.opti
            opti.set_initial(opti.x, last[0].sol.value(opti.x))
        last[:] = [problem.solve()]
        return float(last[0].value(problem.objective))

    return solve, f"Radau {DEGREE}, ipopt"


def problem_between(lower: float, middle: Any, upper: float) -> Any:
    """A bound as opti reads it."""
    if np.isneginf(lower):
        return middle <= upper
    return lower <= middle if np.isposinf(upper) else ((lower <= middle) <= upper)


def dymos(statement: Statement, intervals: int) -> Posed:
    """Its Radau phases with exact sparse derivatives, by SciPy's SLSQP: its driver of IPOPT is in no registry."""
    import dymos as peer
    import openmdao.api as om

    form, horizon, states, controls = statement.form, *statement.guess
    outputs = _along(statement)
    sizes = {"x": form.nx, "u": form.nu, "t": 1, "c": 1, "p": 1, "first": form.nu}
    shared = ("p", "first")  # by all nodes
    symbols = [ca.SX.sym(name, size) for name, size in sizes.items()]
    values = outputs.call(symbols)
    pairs = [(i, k) for i in range(len(values)) for k in range(len(symbols)) if ca.depends_on(values[i], symbols[k])]
    slopes = [ca.densify(ca.jacobian(values[i], symbols[k])) for i, k in pairs]
    names = list(outputs.name_out())
    inner = outputs, ca.Function("slopes", symbols, slopes)

    class Formulas(om.ExplicitComponent):  # type: ignore[misc, unused-ignore]
        def initialize(self) -> None:
            self.options.declare("num_nodes", types=int)

        def setup(self) -> None:
            n = self.options["num_nodes"]
            self.mapped = [f.map("all", "serial", n, [4, 5], []) for f in inner]
            for name, size in sizes.items():
                self.add_input(name, np.zeros(size if name in shared else (n, size)))
            for name, value in zip(names, values, strict=True):
                self.add_output(name, np.zeros((n, value.numel())))
            for i, k in pairs:
                m, width = values[i].numel(), symbols[k].numel()
                rows = np.repeat(np.arange(n * m), width)
                columns = np.arange(n * width).reshape(n, 1, width)
                columns = np.broadcast_to(columns if list(sizes)[k] not in shared else columns[:1], (n, m, width))
                self.declare_partials(names[i], list(sizes)[k], rows=rows, cols=columns.ravel())

        def columns_of(self, inputs: Any) -> list[Any]:
            return [ca.DM(inputs[name] if name in shared else inputs[name].T) for name in sizes]

        def compute(self, inputs: Any, outputs: Any) -> None:
            for name, value in zip(names, self.mapped[0].call(self.columns_of(inputs)), strict=True):
                outputs[name] = value.full().T

        def compute_partials(self, inputs: Any, partials: Any) -> None:
            outcome = self.mapped[1].call(self.columns_of(inputs))
            for (i, k), slope in zip(pairs, outcome, strict=True):  # n matrices (m, width) side by side
                of = slope.full().reshape(values[i].numel(), -1, symbols[k].numel())
                partials[names[i], list(sizes)[k]] = of.transpose(1, 0, 2).ravel()

    low, high = statement.bounds("horizon")
    problem = om.Problem(reports=False)
    problem.driver = om.ScipyOptimizeDriver(optimizer="SLSQP", tol=TOLERANCE, maxiter=1000, disp=False)
    problem.driver.declare_coloring(show_summary=False)
    trajectory = problem.model.add_subsystem("trajectory", peer.Trajectory())
    phase = peer.Phase(ode_class=Formulas, transcription=peer.Radau(num_segments=intervals, order=DEGREE))
    trajectory.add_phase("phase", phase)
    ends: dict[str, Any] = {"duration_bounds": (low[0], high[0])} if low[0] < high[0] else {"fix_duration": True}
    phase.set_time_options(fix_initial=True, targets=["t"], **ends)
    fixed = [statement.bounds(kind) for kind in ("initial", "terminal")]
    is_fixed = [(lower == upper).tolist() for lower, upper in fixed]
    by_name: dict[str, Any] = {"fix_initial": is_fixed[0], "fix_final": is_fixed[1]}
    phase.add_state("x", shape=(form.nx,), rate_source="rates", targets=["x"], **by_name)
    phase.add_control("u", shape=(form.nu,), targets=["u"], continuity=False)
    phase.add_parameter("p", val=statement.p, static_target=True, targets=["p"])
    phase.add_state("c", shape=(1,), rate_source="running", targets=["c"], fix_initial=True)
    if statement.is_cyclic:
        phase.add_parameter("first", shape=(form.nu,), opt=True, static_target=True, targets=["first"])
    wanted: list[tuple[str, Callable[[], Any]]] = [
        # a state that stays at 0: as path constraints there would be more of them than controls
        ("equal", lambda: phase.add_state("e", shape=(outputs.size1_out("equal"),), rate_source="equal", opt=False)),
        ("below", lambda: phase.add_path_constraint("below", upper=0.0)),
        ("inside", lambda: phase.add_path_constraint("inside", lower=-1.0, upper=1.0)),
        ("start", lambda: phase.add_boundary_constraint("start", loc="initial", equals=0.0)),
        ("ends", lambda: phase.add_boundary_constraint("ends", loc="initial", equals=0.0)),
        ("ends", lambda: phase.add_boundary_constraint("ends", loc="final", equals=0.0)),
    ]
    for name, add in wanted:
        if name in names:
            add()
    phase.add_objective("total", loc="final")
    phase.add_timeseries_output("total")
    with _silence():
        problem.setup()
        nodes = np.linspace(0.0, 1.0, 20 * intervals + 1)
        phase.set_time_val(0.0, horizon)
        phase.set_state_val("x", states(nodes), time_vals=nodes * horizon)
        phase.set_state_val("c", [0.0, 1.0])
        phase.set_control_val("u", controls(nodes), time_vals=nodes * horizon)
        if statement.is_cyclic:
            phase.set_parameter_val("first", states(np.zeros(1))[0, : form.nu])

    def solve(p: float) -> float:
        with _silence():
            phase.set_parameter_val("p", p)
            result = problem.run_driver()
        if not result.success:
            raise RuntimeError(f"SLSQP: {result.exit_status}")
        return float(problem.get_val("trajectory.phase.timeseries.total")[-1].item())

    return solve, f"Radau {DEGREE}, SLSQP"


def _along(statement: Statement) -> Any:
    """The formulas as a casadi Function of (x, u, t, cost so far, p, joints at time 0), by name, without empty ones."""
    formulas, form = statement.formulas, statement.form
    names = ("x", "u", "t", "c", "p", "first")
    x, u, t, c, p, first = options = [
        ca.SX.sym(n, k) for n, k in zip(names, (form.nx, form.nu, 1, 1, 1, form.nu), strict=True)
    ]
    by_name = {name: of(x, u, t, 0, p) for name, of in formulas.items() if name != "terminal" and of.numel_out(0)}
    by_name["total"] = c + formulas["terminal"](x, t)
    sides = [np.concatenate(side) for side in zip(statement.bounds("state"), statement.bounds("control"), strict=True)]
    if (
        which := np.flatnonzero(np.isfinite(sides[0]) & np.isfinite(sides[1]))
    ).size:  # Dymos bounds no vector entry by entry
        lower, upper = (side[which] for side in sides)
        middle, half = (upper + lower) / 2, (upper - lower) / 2
        by_name["inside"] = (ca.vertcat(x, u)[which.tolist()] - middle) / half
    if statement.is_cyclic:
        by_name["ends"] = x[list(range(form.nu))] - first
    return ca.Function("along", options, list(by_name.values()), list(names), list(by_name))


def drake(statement: Statement, intervals: int) -> Posed:
    """Its direct collocation of cubics with the cost as a state, by SNOPT, else IPOPT."""
    from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
    from pydrake.planning import DirectCollocation
    from pydrake.solvers import IpoptSolver, SnoptSolver
    from pydrake.systems.framework import BasicVector_, InputPortIndex, LeafSystem_
    from pydrake.systems.scalar_conversion import TemplateSystem
    from pydrake.trajectories import PiecewisePolynomial

    formulas, form, (horizon, states, controls) = statement.formulas, statement.form, statement.guess
    now = [statement.p]

    def both(symbols: list[Any], value: Any) -> Any:
        """Value and slope in all symbols but the last, p."""
        return ca.Function("both", symbols, [value, ca.jacobian(value, ca.vertcat(*symbols[:-1]))])

    def called(of: Any, *parts: Any) -> Any:
        """A function of numbers, or of numbers with derivatives, at the parameter that holds now."""
        whole = np.concatenate(parts)
        if whole.dtype != object:
            return of(*parts, now[0])[0].full().ravel()
        split = np.cumsum([len(part) for part in parts])[:-1]
        value, slope = of(*np.split(ExtractValue(whole).ravel(), split), now[0])
        return InitializeAutoDiff(value.full(), slope.full() @ ExtractGradient(whole)).ravel()

    x, u, p = (ca.SX.sym(n, k) for n, k in zip("xup", (form.nx, form.nu, 1), strict=True))
    motion = both([x, u, p], ca.vertcat(formulas["rates"](x, u, 0, 0, p), formulas["running"](x, u, 0, 0, p)))

    @TemplateSystem.define("Motion_")  # type: ignore[untyped-decorator, unused-ignore]
    def Motion_(T: Any) -> Any:
        class Motion(LeafSystem_[T]):  # type: ignore[misc, unused-ignore]
            def _construct(self, *, converter: Any = None) -> None:
                LeafSystem_[T].__init__(self, converter)
                self.DeclareVectorInputPort("u", BasicVector_[T](form.nu))
                self.DeclareContinuousState(form.nx + 1)

            def _construct_copy(self, other: Any, converter: Any = None) -> None:
                Motion._construct(self, converter=converter)

            def DoCalcTimeDerivatives(self, context: Any, derivatives: Any) -> None:
                state = context.get_continuous_state_vector().CopyToVector()[: form.nx]
                derivatives.get_mutable_vector().SetFromVector(
                    called(motion, state, self.get_input_port().Eval(context))
                )

        return Motion

    system = Motion_[None]()
    low, high = statement.bounds("horizon")
    is_free = low[0] < high[0]
    steps = [float(side) / intervals for side in (low[0], high[0])]
    collocation = DirectCollocation(
        system, system.CreateDefaultContext(), intervals + 1, *steps, input_port_index=InputPortIndex(0)
    )
    program = collocation.prog()
    knots = range(intervals + 1)
    if is_free:
        collocation.AddEqualTimeIntervalsConstraints()
    for kind, variables in (("state", collocation.state), ("control", collocation.input)):
        lower, upper = statement.bounds(kind)
        for k in knots:
            program.AddBoundingBoxConstraint(lower, upper, variables(k)[: len(lower)])
    for kind, k in (("initial", 0), ("terminal", intervals)):
        lower, upper = statement.bounds(kind)
        which = np.flatnonzero(lower == upper)
        program.AddBoundingBoxConstraint(lower[which], upper[which], collocation.state(k)[which])
    program.AddBoundingBoxConstraint(0.0, 0.0, collocation.state(0)[form.nx :])
    for kind, side in (("equal", 0.0), ("below", -np.inf)):
        m = formulas[kind].numel_out(0)
        for k in knots if m else ():
            of = both([x, u, p], formulas[kind](x, u, k / intervals * horizon, 0, p))
            variables = np.concatenate([collocation.state(k)[: form.nx], collocation.input(k)])
            program.AddConstraint(
                lambda v, of=of: called(of, v[: form.nx], v[form.nx :]), np.full(m, side), np.zeros(m), variables
            )
    if formulas["start"].numel_out(0):
        of = both([x, p], formulas["start"](x, np.zeros(form.nu), 0, 0, p))
        zero = np.zeros(formulas["start"].numel_out(0))
        program.AddConstraint(lambda v: called(of, v), zero, zero, collocation.state(0)[: form.nx])
    if statement.is_cyclic:
        program.AddLinearConstraint(
            np.hstack([np.eye(form.nu), -np.eye(form.nu)]),
            np.zeros(form.nu),
            np.zeros(form.nu),
            np.concatenate([collocation.state(k)[: form.nu] for k in (0, intervals)]),
        )
    end = collocation.state(intervals)
    cost = end[form.nx]
    if is_free:
        slope = ca.DM(ca.evalf(_terminal_slope(statement))).full().ravel()  # these costs are linear
        times = [collocation.time_step(k)[0] for k in range(intervals)]
        cost = cost + sum(float(s) * v for s, v in zip(slope[:-1], end, strict=False) if s)
        cost = cost + (float(slope[-1]) * sum(times) if slope[-1] else 0.0)
    program.AddLinearCost(cost)
    nodes = np.linspace(0.0, 1.0, intervals + 1)
    started = np.column_stack([states(nodes), np.zeros(len(nodes))]).T
    curves = (PiecewisePolynomial.FirstOrderHold(nodes * horizon, each) for each in (controls(nodes).T, started))
    collocation.SetInitialTrajectory(*curves)
    last = [program.initial_guess()]

    def solve(value: float) -> float:
        now[0] = value
        for solver in (SnoptSolver(), IpoptSolver()):  # the first often ends in error 41: no better point is found
            result = solver.Solve(program, last[0])
            if result.is_success():
                break
        else:
            raise RuntimeError("SNOPT and IPOPT fail")
        last[0] = result.get_x_val()
        return float(result.get_optimal_cost())

    return solve, "Hermite-Simpson, SNOPT or IPOPT"


def _terminal_slope(statement: Statement) -> Any:
    """Slope of the terminal cost in the states and the horizon."""
    form = statement.form
    x, horizon = ca.MX.sym("x", form.nx), ca.MX.sym("T")
    both = ca.vertcat(x, horizon)
    return ca.substitute(ca.jacobian(statement.formulas["terminal"](x, horizon), both), both, ca.DM.zeros(form.nx + 1))


TOOLS = {"selfmotion": selfmotion, "rockit": rockit, "Dymos": dymos, "Drake": drake}


@contextlib.contextmanager
def _silence() -> Any:
    """What tools print goes nowhere."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def measured(tool: str, statement: Statement, intervals: int) -> dict[str, Any]:
    """A row: seconds of the processor to pose and solve, to solve again with the other parameter, and the error."""
    assert statement.optimum is not None
    began = time.process_time()
    solve, what = TOOLS[tool](statement, intervals)
    cost = solve(statement.p)
    cold = time.process_time() - began
    began = time.process_time()
    again = solve(statement.then)
    warm = time.process_time() - began
    error = abs(cost / statement.optimum - 1)
    row = {"intervals": intervals, "how": what, "cold_s": cold, "warm_s": warm, "error": error}
    return row | {"cost": cost, "cost_then": again}


def main(tool: str, name: str, *meshes: str) -> int:
    """Print a row for each mesh."""
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_SECONDS, MOST_SECONDS + 5))
    warnings.simplefilter("ignore")
    statement = with_reference(STATEMENTS[name]())
    _ = statement.formulas, statement.guess
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)  # some write reports
        with contextlib.suppress(Exception):
            measured(tool, statement, 5)  # imports
        for intervals in map(int, meshes):
            try:
                row = measured(tool, statement, intervals)
            except Exception as error:
                row = {"intervals": intervals, "failed": f"{type(error).__name__}: {str(error)[:300]}"}
            print(json.dumps({"tool": tool, "problem": name, **row}), file=sys.__stdout__, flush=True)
            if row.get("error", 1.0) < FINE:
                break
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
