"""Standing motions, solved and audited: a plan that holds, or what became of every attempt at one.

Whether steps can be taken in the times that are asked: the quickest ones on a coarse mesh, and a guess out of them.

A step that is asked too fast has no plan, and a solver that looks for one may look for long. With durations that may
be longer than asked, at a price beside which all else is small, there nearly always is one: with the durations that
are asked where that can be, else with the least that have to be longer. A few intervals tell them to a percent or two.
What is found is a local minimum, as plans are, so that it is no proof, but it holds everything else that is asked; and
steps are refused only where a solver that starts from the times that are asked finds none there either.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypedDict, Unpack

import casadi as ca
import numpy as np

from models.machines.standing import External, Standing
from ocp.audit.audit import Audit
from ocp.console import interruptible, time_left, time_limited
from ocp.direct.collocation import Collocation
from ocp.direct.shooting import MultipleShooting
from ocp.errors import ProblemError, SolveError, checked_instance, checked_mapping, checked_time_limit
from ocp.methods import solve
from ocp.motion.builders.clearance import ClearanceConstraints, collision_error, solve_with_clearance
from ocp.motion.builders.standing.problem import FreeTime, Weights, standing_problem
from ocp.motion.builders.standing.stances import Steps
from ocp.motion.builders.standing.steps import StepWeights, steps_problem
from ocp.motion.tasks.checks import checked_horizon
from ocp.motion.tasks.equations import bind, task_errors
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask
from ocp.motion.tasks.zmp_rules import ZmpRule
from ocp.problem.formulation import Formulation
from ocp.problem.phases import DURATION, Phases
from ocp.problem.problem import Problem
from ocp.solution import Solution
from ocp.status import SolverStatus
from ocp.tightening import tighten

__all__ = ["Asked", "AskedOfSteps", "Attempt", "guess_in_time", "plan_standing", "plan_steps"]

COARSE = Collocation(4, degree=2, scheme="legendre")
ROUGHLY = {"tol": 1e-4, "acceptable_tol": 1e-3, "acceptable_iter": 5}
"""Of IPOPT: what is wanted are durations to a percent."""


@dataclass(frozen=True)
class PaceSettings:
    """How it is found out whether steps can be taken in their times, on a coarse mesh.

    Attributes:
        iterations: For steps in the times that are asked, where longer ones are found; those that exist took 31 to 51.
        near: Share of a duration by which so coarse a mesh may be wrong: 3 and 12 intervals differ by up to .016.
        price: Of a duration once more, over those of accelerations and rates of a radian in that time.
        longer: Durations of the guess, over those that are asked.
        longest: The longest durations, over those that are asked.
        samples: Of a phase, at which it is looked what is at its limit.
        met: Distance from a limit, over the way that it has along the motion, at which a row counts as at its limit.
        told: Limits that are named, at most.
    """

    iterations: int = 60
    near: float = 0.05
    price: float = 1e4
    longer: float = 5.0
    longest: float = 50.0
    samples: int = 21
    met: float = 0.01
    told: int = 3


PACE = PaceSettings()


def guess_in_time(
    steps: Steps, start_joints: Any, asked: Mapping[str, Any], options: Mapping[str, Any]
) -> dict[str, Any] | None:
    """A guess for `steps_problem`: steps in the times that are asked, on a coarse mesh; None where none are found.

    Args:
        asked: Options of steps_problem. options: Of IPOPT.

    Raises:
        SolveError: The quickest steps that were found take longer, and none were found in the times that are asked:
            `name` is the phase that takes longest for what is asked, `value` and `limit` its durations found and asked,
            s. Or however long they take, something else has to give way, which its `conflicts` tell.
    """
    seconds = {
        name: phase.seconds
        for name, phase in zip(steps.names, steps.phases, strict=True)
        if not isinstance(phase.duration, FreeTime)
    }
    problem = _unhurried(steps, start_joints, asked, seconds)
    found = solve(problem, COARSE, options={**options, **ROUGHLY}, check=False)
    if not found.success:
        if time_left() > 0:
            _check_conflicts(problem, found)
        return None
    spans = {name: end - begin for name, (begin, end) in found.phases.items()}
    if any(spans[name] > (1 + PACE.near) * each for name, each in seconds.items()):
        # a minimum beside may be quicker
        brief = {**options, **ROUGHLY, "max_iter": PACE.iterations}
        asked_for = solve(steps_problem(steps, start_joints, **asked), COARSE, options=brief, check=False)
        if not asked_for.success:
            raise _too_fast(problem, found, seconds, spans)
        found = asked_for
    told = [f"{name}.{DURATION}" for name in seconds]
    return {
        name: lambda share, name=name: found.at_fraction(share)[name]
        for name in (*found.states, *found.controls)
        if name not in told
    }


def _unhurried(steps: Steps, start_joints: Any, asked: Mapping[str, Any], seconds: Mapping[str, float]) -> Phases:
    """The same steps with durations of at least so many seconds; prices in units of their mean, at any scale alike."""
    phases = [
        replace(phase, duration=FreeTime(each, PACE.longest * each, PACE.longer * each))
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
    problem = steps_problem(slower, start_joints, **{**asked, "weights": weights})
    problem.minimize(
        0, PACE.price * default.acceleration * sum(problem[name].duration / each for name, each in seconds.items())
    )
    return problem


def _check_conflicts(problem: Phases, found: Solution) -> None:
    """Raise SolveError where more time does not help, of what would have to give way."""
    try:
        solve(problem, COARSE, options={"max_iter": 0})  # looks for it at once
    except SolveError as error:
        if not error.conflicts:
            return
        lines = [
            f"  {each.label} would have to go {each.amount:.3g} beyond its {each.side} bound {each.bound:.4g}, at "
            f"{100 * each.fraction:.0f} % of its phase"
            for each in error.conflicts[: PACE.told]
        ]
        words = "no steps were found, however long they may take; near the guess"
        worst = error.conflicts[0]
        details = {"name": worst.label, "value": worst.amount, "limit": worst.bound}
        raise SolveError("\n".join([words, *lines]), found, error.conflicts, **details) from None


def _too_fast(problem: Phases, found: Solution, seconds: Mapping[str, float], spans: Mapping[str, float]) -> SolveError:
    """That the quickest steps take longer, in which phases, and what they meet there."""
    late = sorted(seconds, key=lambda name: -spans[name] / seconds[name])
    late = [name for name in late if spans[name] > (1 + PACE.near) * seconds[name]]
    lines = [
        f"  phase {name!r}: {spans[name]:.3g} s, {seconds[name]:.3g} s are asked; {_met(problem, found, name)}"
        for name in late
    ]
    words = "too fast: the quickest steps that were found take longer; give them more time, or ask for shorter ones"
    worst = late[0]
    slow = replace(found, success=False, status=SolverStatus.REJECTED, message="too fast")
    return SolveError("\n".join([words, *lines]), slow, name=worst, value=spans[worst], limit=seconds[worst])


def _met(problem: Phases, found: Solution, phase: str) -> str:
    """What is at its limits in a phase, and for which share of it, in words."""
    form = Formulation.of(problem)
    at = np.linspace(0.0, 1.0, PACE.samples)
    x, u = found.state_interpolant(at), found.control_interpolant(at)
    p = form.parameter_vector({})
    rows = form.sampled([form.path.expression], x, u, at, found.horizon, p)[0]
    places = np.concatenate([form.bounds.places["state"], form.bounds.places["control"], form.path.bounds])
    low, high = (side[places] for side in form.bound_values(p))
    values = np.hstack([x, u, rows])
    near = np.minimum(values - low, high - values) <= PACE.met * np.ptp(values, axis=0)
    near[:, low == high] = False
    names = [label.partition("[")[0] for label in (*form.state_labels, *form.control_labels, *form.path.labels)]
    shares = {
        name.removeprefix(f"{phase}."): float(
            near[:, [k for k, each in enumerate(names) if each == name]].any(axis=1).mean()
        )
        for name in dict.fromkeys(names)
        if name.startswith(f"{phase}.") and name != f"{phase}.{DURATION}"
    }
    most = sorted((name for name in shares if shares[name] > 0), key=lambda name: -shares[name])[: PACE.told]
    return "at their limits " + ", ".join(f"{name} for {100 * shares[name]:.0f} % of it" for name in most)


POINTS = Collocation(20, degree=5, scheme="legendre")
"""Controls at the points: smooth plans, certified on few intervals."""
LINEAR = MultipleShooting(50, control="linear")
"""Controls linear between the nodes: plans that switch between limits, as those of least time do."""
STEPS = Collocation(12, degree=3, scheme="legendre")
"""Of each phase."""
MESHES = 3
"""Of each formulation, each twice as fine as the one before."""
STRAY = 1e-5
"""Pose error, m and rad, that the re-integrated plan may have anywhere, if its task allows no gap at the start."""
IPOPT = {"max_iter": 300}

Level = Literal["position", "acceleration"]
Trial = tuple[Level | None, Collocation | MultipleShooting]


class Asked(TypedDict, total=False):
    """The options of standing_problem that say what is asked: all but how the tips are kept to their tasks."""

    zmp: ZmpRule | None
    external: External | None
    weights: Weights | None
    limits: Limits | None
    control: Literal["acceleration", "jerk"]
    along: Literal["time", "parameter"]
    start: Literal["rest", "free"]
    end: Literal["rest", "free"]
    end_joints: Any
    symbols: Any


class AskedOfSteps(TypedDict, total=False):
    """The options of steps_problem."""

    balance: Literal["dynamic", "static"]
    margin: float
    clearance: float
    weights: StepWeights | None
    limits: Limits | None


@dataclass(frozen=True)
class Attempt:
    """One solve, and what became of it.

    Attributes:
        name: Trial, mesh, and whether bounds were tightened.
        solution: The plan, or the last iterate; None where there is none.
        failure: Why it is no plan, which is not raised; None where it is one.
        exceeded: Whether nothing is wrong with it but inequalities exceeded between the points of the grid.
        touching: That bodies touch, where this alone is wrong with it.
    """

    name: str
    solution: Solution | None
    failure: SolveError | None = None
    exceeded: bool = False
    touching: SolveError | None = None


@interruptible
def plan_standing(
    machine: Standing,
    tasks: TipTask | Sequence[TipTask],
    start_joints: Any,
    horizon: float | FreeTime,
    *,
    method: Collocation | None = None,
    options: Mapping[str, Any] | None = None,
    tolerances: Mapping[str, float] | None = None,
    clearance_constraints: ClearanceConstraints | None = None,
    **asked: Unpack[Asked],
) -> Solution:
    """Solve `standing_problem` and audit the plan, by the formulation that works for it.

    The first plan that passes its audit, its tips nowhere further than 1e-5 (m, rad) from their poses, is returned.
    Accelerations at collocation points come first, accelerations linear between the nodes where the final time is
    free; jerks are at points. A plan that does no more than exceed its limits between the points of its grid is
    tightened there; one that fails otherwise is solved again from itself on up to two meshes, each twice as fine.

    Args:
        machine, tasks, start_joints, horizon, asked: As for standing_problem.
        method: The first mesh, and by its `control` the only formulation that is tried.
        options: Of IPOPT.
        tolerances: Of the audit, by name, see `ocp.audit.audit.audit`.
        clearance_constraints: Colliding bodies are held apart, and the motion is planned anew.

    Raises:
        SolveError: No attempt leads to a plan that passes; says what became of each, and carries what the last one
            lacks.
        ProblemError: As standing_problem.
    """
    if method is not None:
        checked_instance("method", method, Collocation)
    options = checked_mapping("options", options)
    along_parameter = asked.get("along") == "parameter"
    judge = _Judge(tolerances, partial(_stray, machine, tasks, along_parameter))
    settings = {**IPOPT, **options}
    breaks = [] if isinstance(horizon, FreeTime) or along_parameter else _breaks(machine, tasks, horizon)
    trials = [
        (level, mesh.with_nodes_at(breaks))
        for level, mesh in _formulations(asked.get("control", "acceleration"), isinstance(horizon, FreeTime), method)
    ]

    def run(clearance_constraints: ClearanceConstraints | None) -> Solution:
        def declare(level: Level | None) -> Problem:
            held = level or "position"
            return standing_problem(
                machine,
                tasks,
                start_joints,
                horizon,
                tip_level=held,
                clearance_constraints=clearance_constraints,
                **asked,
            )

        return _first_that_holds(declare, trials, settings, judge)

    return solve_with_clearance(clearance_constraints, run)


@interruptible
def plan_steps(
    steps: Steps,
    start_joints: Any,
    *,
    method: Collocation | None = None,
    options: Mapping[str, Any] | None = None,
    tolerances: Mapping[str, float] | None = None,
    time_limit: float | None = None,
    **asked: Unpack[AskedOfSteps],
) -> Solution:
    """Solve `steps_problem` and audit the plan; tightened and on finer meshes as `plan_standing` does.

    The first plan that holds is returned; of one that is not decided to be a minimum its audit says so. First a coarse
    mesh tells whether the steps can be taken in their times at all (`ocp.motion.builders.standing.plan`).

    Args:
        steps, start_joints, asked: As for steps_problem.
        method: The first mesh, of each phase; 12 intervals of degree 3 if None.
        options, tolerances: As for plan_standing.
        time_limit: After so many seconds it gives up, solvers between two iterations. None for no limit.

    Raises:
        SolveError: The quickest steps that were found take longer than asked: names the phase, and how long it takes.
            However long they may take there are none: names what would have to give way. Or no attempt leads to a plan
            that holds; says what became of each.
        ProblemError: As steps_problem.
    """
    if method is not None:
        checked_instance("method", method, Collocation)
    checked_instance("plan_steps: steps", steps, Steps)
    settings = {**IPOPT, **checked_mapping("options", options)}
    trials: list[Trial] = [(None, method or STEPS)]
    judge = _Judge(tolerances, lambda _: None)
    with time_limited(checked_time_limit(time_limit)):
        guess = guess_in_time(steps, start_joints, asked, settings)
        return _first_that_holds(lambda _: steps_problem(steps, start_joints, **asked), trials, settings, judge, guess)


def _first_that_holds(
    declare: Callable[[Level | None], Problem],
    trials: Sequence[Trial],
    settings: Mapping[str, Any],
    judge: _Judge,
    guess: Mapping[str, Any] | None = None,
) -> Solution:
    """The plan that `plan_standing` returns, of the formulations that are tried, from a guess where there is one.

    Raises:
        SolveError, ProblemError: As it does; at once where a plan is sound but for bodies that touch.
    """
    reasons: list[str] = []
    why = SolveError()
    refused: list[ProblemError] = []
    last: Solution | None = None
    for level, mesh in trials:
        try:
            problem = declare(level)
        except ProblemError as error:  # one formulation may leave freedom where the other has none
            refused.append(error)
            reasons.append(f"{_tip(level)}{error}")
            if len(refused) == len(trials):
                raise refused[0] from None
            continue
        diagnosed = guess is None and level == trials[-1][0]
        for attempt in _attempts(problem, level, mesh, settings, judge, guess, diagnosed=diagnosed):
            if attempt.failure is None and attempt.solution is not None:
                return attempt.solution
            if attempt.touching:
                raise attempt.touching
            last = attempt.solution or last
            reasons.append(f"{attempt.name}: {attempt.failure}")
            why = attempt.failure or why
    raise SolveError(
        "no standing plan passes its audit:\n" + "\n".join(reasons), last, why.conflicts,
        name=why.name, value=why.value, limit=why.limit, time=why.time,
    )  # fmt: skip


def _breaks(machine: Standing, tasks: TipTask | Sequence[TipTask], horizon: float) -> list[float]:
    """Fractions of the horizon at which the tasks are less smooth."""
    times = [task.begin + np.asarray(task.breaks) for task in (part.task for part in bind(machine, tasks).bound)]
    inside = np.unique(np.concatenate(times)) / checked_horizon(horizon)
    return [float(at) for at in inside if 0 < at < 1]


def _formulations(control: str, free_time: bool, method: Collocation | None) -> list[Trial]:
    """How the tips are kept to their tasks, and the first mesh, in the order in which they are worth their time."""
    at_points: Trial = ("acceleration" if control == "acceleration" else "position", method or POINTS)
    if method is not None:
        return [("position", method) if method.control == "held" else at_points]
    if control == "jerk":
        return [at_points]
    linear: Trial = ("position", LINEAR)
    return [linear, at_points] if free_time else [at_points, linear]


def _attempts(
    problem: Problem,
    level: Level | None,
    mesh: Collocation | MultipleShooting,
    settings: Mapping[str, Any],
    judge: _Judge,
    guess: Solution | Mapping[str, Any] | None,
    *,
    diagnosed: bool,
) -> Iterator[Attempt]:
    """Attempts at one formulation; whoever takes them stops at the first that holds.

    Args:
        guess: Of the first; None: that of the problem.
        diagnosed: Whether a first solve that fails looks for what conflicts, which takes long.
    """
    for k in range(MESHES):
        name = f"{_tip(level)}{mesh.intervals} intervals"
        first = diagnosed and k == 0
        attempt = judge(name, problem, partial(solve, problem, mesh, options=settings, guess=guess, check=first))
        yield attempt
        guess = attempt.solution
        if attempt.solution is None or not attempt.solution.success or time_left() <= 0:
            return
        if attempt.exceeded:
            bound_tightening = partial(tighten, problem, mesh, options=settings, guess=guess)
            yield judge(f"{name}, tightened", problem, bound_tightening)
        mesh = mesh.halved()


def _tip(level: Level | None) -> str:
    return "" if level is None else f"tip {level}, "


@dataclass(frozen=True)
class _Judge:
    """Solves, and says what became of it.

    Attributes:
        tolerances: Of the audit.
        stray: What is wrong with a plan that passes its audit, None where nothing is.
    """

    tolerances: Mapping[str, float] | None
    stray: Callable[[Audit], SolveError | None]

    def __call__(self, name: str, problem: Problem, run: Callable[[], Solution]) -> Attempt:
        try:
            solution = run()
        except SolveError as error:
            return Attempt(name, error.solution, error)
        if not solution.success:
            if solution.status is SolverStatus.INTERRUPTED:
                raise SolveError(f"interrupted in the solve with {name}", solution, name=name)
            ended = SolveError(f"ipopt ended with {solution.status}", name="ipopt", value=solution.message)
            return Attempt(name, solution, ended)
        audit = solution.audit(tolerances=self.tolerances)
        if not audit.passed and audit.failures:  # what is not decided to be a minimum may be run; its audit says so
            worst = max(audit.failures, key=lambda finding: finding.value / finding.limit if finding.limit else np.inf)
            exceeded = all(_is_inequality(problem, finding.name) for finding in audit.failures)
            details = {"value": worst.value, "limit": worst.limit, "time": worst.time}
            failure = SolveError(f"the audit fails, {worst.name} {worst.value:.2g}", name=worst.name, **details)
            return Attempt(name, solution, failure, exceeded, collision_error(audit, solution))
        return Attempt(name, solution, self.stray(audit))


def _stray(
    machine: Standing, tasks: TipTask | Sequence[TipTask], along_parameter: bool, audit: Audit
) -> SolveError | None:
    """That a tip strays from its task in the re-integrated motion, where it does."""
    progress = audit.states["path"][:, 0] if along_parameter else audit.t
    errors = np.abs(task_errors(machine, tasks, progress, None, audit.states["joints"])).max(axis=0)
    parts = bind(machine, tasks).bound
    gaps = np.repeat([part.task.start_gap for part in parts], [part.task.size for part in parts])
    if (errors > np.maximum(gaps, STRAY)).any():
        words = f"a tip strays from its task by {errors.max():.2g} (m or rad)"
        return SolveError(words, name="tip", value=errors.max())
    return None


def _is_inequality(problem: Problem, finding: str) -> bool:
    """Whether a finding is of bounds, or of a path constraint of which no row is an equality."""
    rows = problem.declared.path.get(finding)
    if rows is None:
        return finding.startswith("bounds of ")
    return bool((np.array(ca.DM(rows.lower)) < np.array(ca.DM(rows.upper))).all())
