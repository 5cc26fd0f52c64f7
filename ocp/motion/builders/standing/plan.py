"""Planners of the motions and footsteps of standing machines: they solve a problem and audit the plan.

`solve_steps` first checks on a coarse mesh whether the steps are possible in their durations, because a solver may
search long for steps that are too fast. With durations that may grow, at a price that outweighs the rest of the cost, a
solution nearly always exists. It is a local minimum, hence no proof: steps are refused only if a solve with the
requested durations fails, too. Otherwise the coarse solution is the guess.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import casadi as ca
import numpy as np

from models.machines.standing import Standing
from ocp.audit.audit import Audit
from ocp.console import interruptible, time_left
from ocp.direct.discretisation import Collocation, MultipleShooting
from ocp.errors import ProblemError, RefinementWarning, SolveError, SolverStatus, require
from ocp.methods import solve
from ocp.motion.builders.clearance import ClearanceConstraints, collision_error, solve_with_clearance
from ocp.motion.builders.dynamics_plan import SolveSettings, audit_error
from ocp.motion.builders.standing.problem import FreeTime, StandingSetup, Weights, standing_problem
from ocp.motion.builders.standing.stances import Steps
from ocp.motion.builders.standing.steps import StepWeights, steps_problem
from ocp.motion.tasks.equations import bind, task_errors
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.formulation import Formulation
from ocp.problem.phases import DURATION, Phases
from ocp.problem.problem import Problem
from ocp.refinement import refine
from ocp.solution import Solution
from ocp.tightening import tighten

COARSE = Collocation(4, degree=2, scheme="legendre")
COARSE_IPOPT = {"tol": 1e-4, "acceptable_tol": 1e-3, "acceptable_iter": 5}
"""IPOPT options of the solves on a coarse mesh, which determine durations to about a percent."""


@dataclass(frozen=True)
class PaceSettings:
    """Settings of the check, on a coarse mesh, whether footsteps are possible in their requested durations."""

    iterations: int = 60  # largest number of iterations with the requested durations; solvable cases took 31 to 51
    error: float = 0.05  # relative error of a duration on so coarse a mesh; 3 and 12 intervals differ by up to 0.016
    price: float = 1e4  # cost of doubling a duration, over that of accelerations and rates of 1 rad in that time
    guess: float = 5.0  # guess of a duration, over the requested one
    longest: float = 50.0  # upper bound of a duration, over the requested one
    samples: int = 21  # number of samples of a phase at which active limits are searched
    active: float = 0.01  # distance from a limit, per range along the motion, at which it counts as active
    names: int = 3  # largest number of limits named in a message


PACE = PaceSettings()


def guess_in_time(
    steps: Steps, start: Any, step_options: Mapping[str, Any], options: Mapping[str, Any]
) -> dict[str, Any] | None:
    """Solve a footstep motion in the requested durations on a coarse mesh, as an initial guess; return None on failure.

    Raises:
        SolveError: The quickest steps take longer than requested: `name` is the phase with the largest extension,
            `value` and `limit` its quickest and requested durations, s. Or no steps were found in any durations; then
            `conflicts` has the constraints that would have to be relaxed.
    """
    seconds = {
        name: phase.seconds
        for name, phase in zip(steps.names, steps.phases, strict=True)
        if not isinstance(phase.duration, FreeTime)
    }
    problem = _extensible_problem(steps, start, step_options, seconds)
    coarse = solve(problem, COARSE, options={**options, **COARSE_IPOPT}, check=False)
    if not coarse.success:
        if time_left() > 0:
            _check_conflicts(problem, coarse)
        return None
    spans = {name: end - begin for name, (begin, end) in coarse.phases.items()}
    if any(spans[name] > (1 + PACE.error) * each for name, each in seconds.items()):
        # another local minimum may be quicker
        limited_options = {**options, **COARSE_IPOPT, "max_iter": PACE.iterations}
        requested = steps_problem(steps, start=start, **step_options)
        in_time = solve(requested, COARSE, options=limited_options, check=False)
        if not in_time.success:
            raise _too_fast_error(problem, coarse, seconds, spans)
        coarse = in_time
    durations = [f"{name}.{DURATION}" for name in seconds]
    return {
        name: lambda share, name=name: coarse.at_fraction(share)[name]
        for name in (*coarse.states, *coarse.controls)
        if name not in durations
    }


def _extensible_problem(
    steps: Steps, start: Any, step_options: Mapping[str, Any], seconds: Mapping[str, float]
) -> Phases:
    """Declare the problem of footsteps that may take longer than requested, at a cost that outweighs all others."""
    phases = [
        replace(phase, duration=FreeTime(each, PACE.longest * each, PACE.guess * each))
        if (each := seconds.get(name)) is not None
        else phase
        for name, phase in zip(steps.names, steps.phases, strict=True)
    ]
    unit = float(np.mean([phase.seconds for phase in steps.phases]))
    default = StepWeights()
    weights = StepWeights(
        acceleration=default.acceleration * unit**3,
        velocity=default.velocity * unit,
        joint_limits=default.joint_limits / unit,
        load=default.load / unit,
    )
    slower = replace(steps, phases=tuple(phases))
    problem = steps_problem(slower, start=start, **{**step_options, "cost": weights})
    extension = sum(problem[name].duration / each for name, each in seconds.items())
    problem.minimize(0, PACE.price * default.acceleration * extension)
    return problem


def _check_conflicts(problem: Phases, coarse: Solution) -> None:
    """Raise SolveError, naming conflicting constraints, if footsteps are impossible whatever their durations."""
    try:
        solve(problem, COARSE, options={"max_iter": 0})  # searches for conflicts at once
    except SolveError as error:
        if not error.conflicts:
            return
        lines = [
            f"  {each.label} would have to exceed its {each.side} bound {each.bound:.4g} by {each.amount:.3g}, at "
            f"{100 * each.fraction:.0f} % of its phase"
            for each in error.conflicts[: PACE.names]
        ]
        words = "no steps were found in any durations; near the guess"
        worst = error.conflicts[0]
        details = {"name": worst.label, "value": worst.amount, "limit": worst.bound}
        raise SolveError("\n".join([words, *lines]), coarse, error.conflicts, **details) from None


def _too_fast_error(
    problem: Phases, coarse: Solution, seconds: Mapping[str, float], spans: Mapping[str, float]
) -> SolveError:
    """Return an error that footsteps need more time than requested, naming the slow phases and their active limits."""
    late = sorted(seconds, key=lambda name: -spans[name] / seconds[name])
    late = [name for name in late if spans[name] > (1 + PACE.error) * seconds[name]]
    lines = [
        f"  phase {name!r}: {spans[name]:.3g} s, {seconds[name]:.3g} s are requested; "
        f"{_describe_active_limits(problem, coarse, name)}"
        for name in late
    ]
    words = "too fast: the quickest steps take longer than requested; give them more time, or shorten them"
    worst = late[0]
    slow = replace(coarse, success=False, status=SolverStatus.REJECTED, message="too fast")
    return SolveError("\n".join([words, *lines]), slow, name=worst, value=spans[worst], limit=seconds[worst])


def _describe_active_limits(problem: Phases, coarse: Solution, phase: str) -> str:
    """Describe which limits are active in a phase of a coarse solution, and for what part of the phase."""
    form = Formulation.of(problem)
    at = np.linspace(0.0, 1.0, PACE.samples)
    x, u = coarse.state_interpolant(at), coarse.control_interpolant(at)
    p = form.parameter_vector({})
    rows = form.sampled([form.path.expression], x, u, at, coarse.horizon, p)[0]
    places = np.concatenate([form.bounds.places["state"], form.bounds.places["control"], form.path.bounds])
    low, high = (side[places] for side in form.bound_values(p))
    values = np.hstack([x, u, rows])
    active = np.minimum(values - low, high - values) <= PACE.active * np.ptp(values, axis=0)
    active[:, low == high] = False
    names = [label.partition("[")[0] for label in (*form.state_labels, *form.control_labels, *form.path.labels)]
    shares = {
        name.removeprefix(f"{phase}."): float(
            active[:, [k for k, each in enumerate(names) if each == name]].any(axis=1).mean()
        )
        for name in dict.fromkeys(names)
        if name.startswith(f"{phase}.") and name != f"{phase}.{DURATION}"
    }
    largest = sorted((name for name in shares if shares[name] > 0), key=lambda name: -shares[name])[: PACE.names]
    return "at their limits " + ", ".join(f"{name} for {100 * shares[name]:.0f} % of it" for name in largest)


POINTS = Collocation(20, degree=5, scheme="legendre")
"""Mesh with controls at the collocation points, for smooth plans, which pass the audit with few intervals."""
LINEAR = MultipleShooting(50, control="linear")
"""Mesh with controls linear between the nodes, for plans that switch between limits, such as those of least time."""
STEPS = Collocation(12, degree=3, scheme="legendre")  # first mesh of each phase in `solve_steps`
MESHES = 3  # largest number of meshes for each formulation; a mesh is twice as fine as the mesh before
POSE_TOLERANCE = 1e-5  # largest pose error of the re-integrated plan, m and rad, unless a task has a larger gap

Level = Literal["position", "acceleration"]
Trial = tuple[Level | None, Collocation | MultipleShooting]


@interruptible
def solve_standing(
    machine: Standing,
    tasks: TipTask | Sequence[TipTask],
    horizon: float | FreeTime,
    *,
    start: Any,
    weights: Weights | None = None,
    limits: Limits | None = None,
    setup: StandingSetup | None = None,
    settings: SolveSettings | None = None,
) -> Solution:
    """Solve several formulations of `standing_problem` until the audit accepts a plan of a standing machine.

    The first plan that passes its audit with pose errors below 1e-5 (m, rad) everywhere is returned. Accelerations at
    the collocation points are tried first, or, if the final time is free, accelerations linear between the nodes. Jerks
    are at the points. If the only failures of a plan are limits exceeded between the points, these limits are tightened
    there. Then the first mesh is refined where the audit finds errors, such as at a short push. Other plans are solved
    again from themselves on up to two meshes, each twice as fine.

    The `tip_level` of the setup is chosen here, and the `control` of a given mesh selects the only formulation tried.

    Raises:
        SolveError: No attempt passes. The message has the result of each; the fields are those of the last failure.
        ProblemError: As `standing_problem`.
    """
    solving = SolveSettings() if settings is None else require.instance("settings", settings, SolveSettings)
    setup = StandingSetup() if setup is None else require.instance("solve_standing: setup", setup, StandingSetup)
    along_parameter = setup.along == "parameter"
    judge = partial(_audited, solving.tolerances, partial(_error_of_tips, machine, tasks, along_parameter))
    timed = not (isinstance(horizon, FreeTime) or along_parameter)
    breaks = breaks_of(tasks, require.positive("horizon", horizon)) if timed else []
    formulations = _formulations(setup.control, isinstance(horizon, FreeTime), solving.method)
    trials = [(level, mesh.with_nodes_at(breaks)) for level, mesh in formulations]

    def run(clearance_constraints: ClearanceConstraints | None) -> Solution:
        def declare(level: Level | None) -> Problem:
            own = replace(setup, tip_level=level or "position", clearance_constraints=clearance_constraints)
            return standing_problem(machine, tasks, horizon, start=start, weights=weights, limits=limits, setup=own)

        return _first_accepted(declare, trials, solving.ipopt_options, judge)

    return solve_with_clearance(setup.clearance_constraints, run)


@interruptible
def solve_steps(
    steps: Steps,
    *,
    start: Any,
    cost: StepWeights | None = None,
    limits: Limits | None = None,
    settings: SolveSettings | None = None,
) -> Solution:
    """Plan the footsteps of `steps_problem` and audit the plan; refine the mesh until a plan is feasible.

    The audit may leave the optimality of the plan undetermined.

    Raises:
        SolveError: The quickest steps take longer than requested; names the phase and its duration. Or no steps exist
            in any durations; names the conflicting constraints. Or no attempt passes; has the result of each.
        ProblemError: As `steps_problem`.
    """
    solving = SolveSettings() if settings is None else require.instance("settings", settings, SolveSettings)
    require.instance("solve_steps: steps", steps, Steps)
    options: dict[str, Any] = {"cost": cost, "limits": limits}
    guess = guess_in_time(steps, start, options, solving.ipopt_options)
    options["start"] = start
    judge = partial(_audited, solving.tolerances, lambda *_: None)
    trials: list[Trial] = [(None, solving.method or STEPS)]
    return _first_accepted(lambda _: steps_problem(steps, **options), trials, solving.ipopt_options, judge, guess)


def breaks_of(tasks: TipTask | Sequence[TipTask], horizon: float) -> Sequence[float]:
    """Return the times at which tasks have kinks or jumps, as fractions of the horizon."""
    tasks = (tasks,) if isinstance(tasks, TipTask) else require.each("tasks", tasks, TipTask)
    times = np.unique(np.concatenate([np.zeros(0), *(task.begin + np.asarray(task.breaks) for task in tasks)]))
    return [float(at) for at in times / horizon if 0 < at < 1]


def _first_accepted(
    declare: Callable[[Level | None], Problem],
    trials: Sequence[Trial],
    settings: Mapping[str, Any],
    judge: Callable[..., tuple[Solution | SolveError, bool]],
    guess: Mapping[str, Any] | None = None,
) -> Solution:
    """Try formulations and meshes in turn, and return the first plan that the audit accepts; raise SolveError or
    ProblemError if there is none, or if a plan fails only because of collisions.
    """
    reasons, refused = list[str](), list[ProblemError]()
    failure, last = SolveError(), None
    for level, mesh in trials:
        label = "" if level is None else f"tip {level}, "
        try:
            problem = declare(level)
        except ProblemError as error:  # one formulation may leave freedom where the other leaves none
            refused.append(error)
            reasons.append(f"{label}{error}")
            if len(refused) == len(trials):
                raise refused[0] from None
            continue
        diagnosed = guess is None and level == trials[-1][0]
        for name, attempt in _attempts(problem, mesh, settings, judge, guess, diagnosed=diagnosed):
            if isinstance(attempt, Solution):
                return attempt
            last, failure = attempt.solution or last, attempt
            reasons.append(f"{label}{name}: {attempt}")
    raise SolveError(
        "no standing plan passes its audit:\n" + "\n".join(reasons), last, failure.conflicts,
        name=failure.name, value=failure.value, limit=failure.limit, time=failure.time,
    )  # fmt: skip


def _formulations(control: str, free_time: bool, method: Collocation | None) -> list[Trial]:
    """Return the formulations to try and the first mesh of each; the most promising formulation comes first."""
    at_points: Trial = ("acceleration" if control == "acceleration" else "position", method or POINTS)
    if method is not None:
        return [("position", method) if method.control == "held" else at_points]
    if control == "jerk":
        return [at_points]
    linear: Trial = ("position", LINEAR)
    return [linear, at_points] if free_time else [at_points, linear]


def _attempts(
    problem: Problem,
    mesh: Collocation | MultipleShooting,
    settings: Mapping[str, Any],
    judge: Callable[..., tuple[Solution | SolveError, bool]],
    guess: Solution | Mapping[str, Any] | None,
    *,
    diagnosed: bool,
) -> Iterator[tuple[str, Solution | SolveError]]:
    """Solve and audit a problem on finer and finer meshes; yield a name and the plan or the error of each solve.

    With `diagnosed`, a first solve that fails searches for conflicting constraints, which takes long.
    """
    for k in range(MESHES):
        name, first = f"{mesh.intervals} intervals", diagnosed and k == 0
        run = partial(solve, problem, mesh, options=settings, guess=guess, check=first)
        attempt, exceeded = judge(name, problem, run)
        yield name, attempt
        guess = attempt.solution if isinstance(attempt, SolveError) else attempt
        if guess is None or not guess.success or time_left() <= 0:
            return
        if exceeded:
            tightened = partial(tighten, problem, mesh, options=settings, guess=guess)
            yield f"{name}, tightened", judge(f"{name}, tightened", problem, tightened)[0]
        if k == 0:  # equal intervals as narrow as the shortest event, a push, would be far more
            refined = partial(refine, problem, mesh, options=settings, guess=guess)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RefinementWarning)
                attempt, _ = judge(f"{name}, refined", problem, refined)
            yield f"{name}, refined", attempt
        mesh = mesh.halve()


def _audited(
    tolerances: Mapping[str, float] | None,
    pose_error: Callable[[Audit, Solution], SolveError | None],
    name: str,
    problem: Problem,
    run: Callable[[], Solution],
) -> tuple[Solution | SolveError, bool]:
    """Run a solver and audit the plan; `pose_error` rejects plans that pass but deviate from their tasks.

    Return the plan or the error, and whether only inequalities are violated, between the points of the grid.
    """
    try:
        solution = run()
    except SolveError as error:
        return error, False
    if not solution.success:
        if solution.status is SolverStatus.INTERRUPTED:
            raise SolveError(f"interrupted during the solve with {name}", solution, name=name)
        ended = f"ipopt ended with {solution.status}"
        return SolveError(ended, solution, name="ipopt", value=solution.message), False
    audit = solution.audit(tolerances=tolerances)
    if not audit.passed and audit.failures:  # a plan of undetermined optimality is accepted
        if collision := collision_error(audit, solution):
            raise collision
        exceeded = all(_is_inequality(problem, finding.name) for finding in audit.failures)
        return audit_error(audit, solution), exceeded
    return pose_error(audit, solution) or solution, False


def _error_of_tips(
    machine: Standing, tasks: TipTask | Sequence[TipTask], along_parameter: bool, audit: Audit, solution: Solution
) -> SolveError | None:
    """Return an error if a tip of the re-integrated motion deviates from its task, else None."""
    progress = audit.states["path"][:, 0] if along_parameter else audit.t
    errors = np.abs(task_errors(machine, tasks, progress, audit.states["joints"])).max(axis=0)
    gaps = bind(machine, tasks).by_row(lambda task: task.start_gap)
    if (errors > np.maximum(gaps, POSE_TOLERANCE)).any():
        words = f"a tip deviates from its task by {errors.max():.2g} (m or rad)"
        return SolveError(words, solution, name="tip", value=errors.max())
    return None


def _is_inequality(problem: Problem, finding: str) -> bool:
    """Return whether an audit finding concerns bounds of variables, or a path constraint of inequalities only."""
    rows = problem.declared.path.get(finding)
    if rows is None:
        return finding.startswith("bounds of ")
    return bool((np.array(ca.DM(rows.lower)) < np.array(ca.DM(rows.upper))).all())
