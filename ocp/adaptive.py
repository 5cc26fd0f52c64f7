"""Adaptive collocation: a problem is solved without a mesh and without a guess, to a requested accuracy of its cost.

Coarse meshes forgive bad guesses: a nonlinear program of a few hundred variables has few stationary points, and its
solution is the guess on the finer mesh. The solver starts from the guess (without one: straight lines between fixed
ends, the middle of bounds) and from the guess displaced by seeded random amounts, because the straight lines share the
symmetries of a problem, along which a stationary plan may be a saddle. Starts that end at different costs show several
local minima. The plan of lowest cost is refined once two starts have found this cost, or two meshes have plans.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from ocp.console import interruptible, report, shown_progress, time_left, time_limited
from ocp.direct.discretisation import Collocation, MultipleShooting
from ocp.direct.guess import guessed_names
from ocp.direct.prepared import DirectMethod, Prepared
from ocp.errors import RefinementWarning, SolveError, checked_time_limit, require
from ocp.methods import descend
from ocp.problem.formulation import Formulation
from ocp.problem.problem import Problem
from ocp.refinement import RefinementSettings, refine
from ocp.solution import ByName, Guess, Solution
from ocp.tolerances import LIMIT_SHARE, SOLVER_SHARE

FIRST_MESHES: tuple[DirectMethod, ...] = (
    Collocation(12), Collocation(20), MultipleShooting(40, steps=2), Collocation(40), Collocation(120, 4)
)  # fmt: skip
"""First meshes in the order in which they are tried. Shooting holds the dynamics at every iterate of its integrator."""
FIRST_OPTIONS = {"max_iter": 500}
"""Options of the solver on the first meshes: a start that succeeds there takes tens to a few hundred iterations."""
FIRST_STARTS = ("guess", "displaced guess")


@dataclass(frozen=True)
class AdaptiveCollocation:
    """Direct collocation on a mesh that is refined until the cost is accurate; the default method of ``solve``.

    Attributes:
        accuracy: Accuracy of the cost: largest relative cost that the controls may lose, and largest relative
            integration error.
        max_intervals: Maximum number of intervals.
        progress: As of :func:`ocp.motion.plan.plan`: a function that is called with the name of each stage, True for a
            line on the terminal, False for no report; None shows the line after two seconds.

    Raises:
        ProblemError: accuracy is not between 0 and 1, or max_intervals is smaller than that of the finest
            first mesh, 120.
    """

    accuracy: float = SOLVER_SHARE
    max_intervals: int = 400
    progress: Callable[[str], Any] | bool | None = None

    def __post_init__(self) -> None:
        require.positive("AdaptiveCollocation: accuracy", self.accuracy, below=1.0)
        least = max(mesh.intervals for mesh in FIRST_MESHES)
        require.count("AdaptiveCollocation: max_intervals", self.max_intervals, least=least)

    def prepare(
        self,
        problem: Problem,
        *,
        solver: str = "ipopt",
        options: ByName = None,
        compiled: bool = False,
        scaling: bool = True,
    ) -> AdaptiveProblem:
        """Return an object that solves the given problem with the given options; see :func:`ocp.methods.prepare`.

        ``compiled`` and ``scaling`` apply to the first mesh, where most of the iterations take place.
        """
        own = require.mapping("options", options)
        return AdaptiveProblem(problem, self, own, {"solver": solver, "compiled": compiled, "scaling": scaling})


def default_method() -> AdaptiveCollocation:
    """Return the method that :func:`ocp.methods.solve` uses if the caller gives none."""
    return AdaptiveCollocation()


class AdaptiveProblem:
    """An optimal control problem with the options by which :class:`AdaptiveCollocation` solves it."""

    def __init__(
        self, problem: Problem, method: AdaptiveCollocation, options: dict[str, Any], how: dict[str, Any]
    ) -> None:
        self.problem, self.method, self.formulation = problem, method, Formulation.of(problem)
        self._options, self._how = options, how

    @interruptible
    def solve(
        self, parameters: ByName = None, guess: Guess = None, check: bool = True, *, time_limit: float | None = None
    ) -> Solution:
        """Solve the problem, refine its mesh, and return the last plan, whose ``refinement`` records all rounds.

        Args:
            parameters, guess, time_limit: As of :func:`ocp.methods.solve`.
            check: Without effect: every solve on the way is checked.

        Raises:
            SolveError: No plan on any of the first meshes; states what each solve ended with, and what to try.

        Warns:
            RefinementWarning: As of :func:`ocp.refinement.refine`.
        """
        title = f"solve {self.problem.name!r}"
        with time_limited(checked_time_limit(time_limit)), shown_progress(title, self.method.progress):
            ends: list[str] = []
            best: Solution | None = None
            plans: list[tuple[DirectMethod, Solution]] = []
            for mesh in FIRST_MESHES:
                plans += [(mesh, plan) for plan in self._first_plans(mesh, parameters, (guess, best), ends)]
                plans.sort(key=lambda pair: pair[1].cost)
                best = plans[0][1] if plans else best
                costs = [plan.cost for _, plan in plans]
                agree = len(plans) > 1 and costs[1] - costs[0] <= LIMIT_SHARE * abs(costs[0])
                if plans and (agree or len({id(of) for of, _ in plans}) > 1 or mesh is FIRST_MESHES[-1]):
                    first, plan = plans[0]
                    try:
                        return self._refined(first, plan, parameters)
                    except SolveError as error:
                        ends.append(f"{_label(first)}, refined: {str(error).splitlines()[0]}")
                        plans.clear()
                if time_left() <= 0:
                    break
            if best is not None:
                words = f"problem {self.problem.name!r}: no refinement of the plan succeeded; its accuracy is unknown"
                warnings.warn(RefinementWarning("\n".join([words, *ends]), name="accuracy"), stacklevel=2)
                return best
            mesh = Collocation(20)
            try:  # with all starts, and a report of conflicting constraints
                plan = self._prepared(mesh).solve(parameters, guess)
            except SolveError as error:
                raise self._failure(error, guess, ends) from error
            return self._refined(mesh, plan, parameters)

    def _prepared(self, mesh: DirectMethod) -> Prepared:
        return mesh.prepare(self.problem, options={**FIRST_OPTIONS, **self._options}, **self._how)

    def _refined(self, mesh: DirectMethod, plan: Solution, parameters: ByName) -> Solution:
        """Solve by collocation on finer and finer meshes, starting from a plan; return the plan on the last mesh."""
        report(f"refining a plan of cost {plan.cost:.6g}")
        settings = RefinementSettings(
            limits={"lost": self.method.accuracy}, max_intervals=self.method.max_intervals, solver=self._how["solver"]
        )
        options = {"max_iter": FIRST_OPTIONS["max_iter"], **self._options}
        result = refine(
            self.problem,
            mesh if isinstance(mesh, Collocation) else Collocation(mesh.intervals),
            tolerance=self.method.accuracy,
            parameters=parameters,
            options=options,
            guess=plan,
            settings=settings,
        )
        return replace(result, start=plan.start)

    def _first_plans(
        self, mesh: DirectMethod, parameters: ByName, guesses: tuple[Guess, Solution | None], ends: list[str]
    ) -> list[Solution]:
        """Solve the problem on a first mesh from several initial guesses, and return the plans.

        ``guesses`` are the user's, and the plan of a coarser mesh, if any. How each start ended is added to ``ends``.
        """
        try:
            prepared = self._prepared(mesh)
        except SolveError as error:  # the time ran out during the build; plans of coarser meshes remain
            ends.append(f"{_label(mesh)}: {str(error).splitlines()[0]}")
            return []
        starts: list[tuple[str, Guess]] = [(start, guesses[0]) for start in FIRST_STARTS]
        if guesses[1] is not None:
            starts = [("guess", guesses[1]), *starts]
        plans = []
        for start, guess in starts:
            report(f"{_label(mesh)} from the {start}")
            try:
                plan = prepared.solve(parameters, guess, check=False, start=start)
            except SolveError as error:
                ends.append(f"{_label(mesh)} from the {start}: {str(error).splitlines()[0]}")
                continue
            ends.append(f"{_label(mesh)} from the {start}: {plan.status} after {plan.iterations} iterations")
            if plan.success:
                with suppress(SolveError):  # a saddle point without a lower plan beside it is kept
                    plan = descend(prepared, plan)
                plans.append(plan)
            elif time_left() <= 0:
                break
        return plans

    def _failure(self, cause: SolveError, guess: Guess, ends: list[str]) -> SolveError:
        """Return the SolveError, with the conflicting constraints, for a problem that has no plan on any first mesh."""
        lines = [f"problem {self.problem.name!r} has no plan on any of the meshes tried", *str(cause).splitlines()]
        unknown = [name for name in self.formulation.states if name not in guessed_names(self.formulation, guess)]
        hint = f" states {', '.join(unknown)} have no guess" if unknown else ""
        free = self.formulation.horizon_is_free and "horizon" not in guessed_names(self.formulation, guess)
        hint += ", the free horizon has none either" if free else ""
        advice = (
            f"give a guess ({hint.strip(', ')}), bounds on both sides of what may grow without bound" if hint else ""
        )
        lines += [*ends, advice or "give another guess, or a method: solve(problem, Collocation(...), guess=...)"]
        details = {"name": cause.name, "value": cause.value, "limit": cause.limit, "time": cause.time}
        return SolveError("\n".join(lines), cause.solution, cause.conflicts, **details)


def _label(mesh: DirectMethod) -> str:
    return f"{type(mesh).__name__}({mesh.intervals})"
