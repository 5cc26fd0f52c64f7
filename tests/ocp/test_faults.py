"""Faults from outside: Ctrl-C, time limits, several threads, no file handles. They lose nothing, and are no verdict."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

import ocp.refinement
import ocp.tightening
from ocp import (
    Collocation,
    Indirect,
    MultipleShooting,
    Problem,
    ProblemError,
    RefinementSettings,
    RefinementWarning,
    SolveError,
    prepare,
    refine,
    solve,
    tighten,
)
from ocp.console import (
    TimeLimitReached,
    casadi_silenced,
    check_time,
    interruptible,
    report,
    shown_progress,
    time_left,
    time_limited,
)
from ocp.direct.prepared import Prepared
from ocp.errors import Interrupted, SolverStatus
from tests.families import some
from tests.ocp.problems import SOLVERS, energy, van_der_pol
from tests.ocp.test_tightening import beyond, walled

ROOT = Path(__file__).parents[2]


def run(code: str, timeout: float = 600.0) -> subprocess.CompletedProcess[str]:
    """Python code in a process of its own, from the root of the repository."""
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


# ---- Ctrl-C ------------------------------------------------------------------------------------------------------

INTERRUPTED = """
import os, signal, subprocess, sys, threading, time
import casadi as ca
import numpy as np
import ocp
from models import examples as papers
from models.paths import segments
from ocp import *
from tests.ocp.problems import van_der_pol
from tests.ocp.test_faults import solved_from_zeros

stopped = []


def noted(number, frame):
    stopped.append(time.process_time())
    raise KeyboardInterrupt


signal.signal(signal.SIGINT, noted)  # a shell starts background jobs with Ctrl-C ignored
SILENT = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
NEVER = {"tol": 1e-300, "acceptable_iter": 0, "max_iter": 1000000}  # keeps ipopt at work


def interrupted(name, call, after=0.3):
    # Ctrl-C comes from another process, for a thread may wait long for its turn; sooner where the call ends before it
    while True:
        stopped.clear()
        ticks, own = int(os.sysconf("SC_CLK_TCK") * (time.process_time() + after)), os.getpid()
        worked = f"$(awk '{{print $14 + $15}}' /proc/{own}/stat)"  # of the processor: others may hold it
        wait = f"while [ {worked} -lt {ticks} ]; do sleep 0.01; done; kill -INT {own}"
        sender = subprocess.Popen(["sh", "-c", wait], **SILENT)
        try:
            call()
            word = "returned"
            sender.kill()
        except KeyboardInterrupt as error:
            word = "KeyboardInterrupt" + (" with a plan" if getattr(error, "solution", None) is not None else "")
        except BaseException as error:
            word = type(error).__name__
        late = time.process_time() - stopped[0] if stopped else 0.0  # of work: others may hold the processor
        unsent = sender.wait() == -signal.SIGKILL
        for thread in threading.enumerate():  # what was left alone comes to its end
            if thread.name == "ocp":
                thread.join()
        if not (unsent and after > 0.01):
            return print(name, "|", word, "|", "at once" if late < 1.0 else f"{late:.1f} s late", flush=True)
        after /= 2
"""

DIRECT = """
long = van_der_pol((1.0, 0.0), horizon=20.0, upper=1.0, lower=-1.0)
ipopt = prepare(long, Collocation(1000, 4), options=NEVER)
interrupted("ipopt", ipopt.solve)
interrupted("ipopt without check", lambda: ipopt.solve(check=False))
fatrop = prepare(long, Collocation(1500, 4), solver="fatrop", options={"max_iter": 1000000})
interrupted("fatrop", fatrop.solve, 0.2)
again = prepare(solved_from_zeros(), Collocation(8000, 4))
interrupted("second start", again.solve)
stuck = van_der_pol(horizon=20.0, terminal=[9.0, 9.0], upper=0.1)
conflicts = prepare(stuck, Collocation(3000, 4), options={"max_iter": 1})
interrupted("what conflicts", conflicts.solve, 1.0)
sleqp = prepare(long, Collocation(120, 4), solver="sleqp")
interrupted("sleqp", sleqp.solve, 0.2)
interrupted("prepare", lambda: prepare(long, Collocation(20000, 4)))
many = RefinementSettings(max_intervals=4000)
interrupted("refine", lambda: refine(long, Collocation(150), tolerance=1e-13, settings=many))
interrupted("tighten", lambda: tighten(long, Collocation(1500)))
plan = solve(long, Collocation(300))
print(plan.success, ipopt.solve(guess=plan, check=False, time_limit=0.2).success)
"""

CHECKS = """
long = van_der_pol((1.0, 0.0), horizon=20.0, upper=1.0, lower=-1.0)
plan = solve(long, Collocation(16000))
interrupted("audit", lambda: plan.audit(), 0.1)
interrupted("audit again", lambda: plan.audit(), 0.3)
interrupted("certificate", lambda: certificate(long, [plan, plan]))
indirect = prepare(van_der_pol(horizon=6.0), Indirect(segments=800))
seed = solve(van_der_pol(horizon=6.0), Collocation(20))
interrupted("indirect", lambda: indirect.solve(guess=seed), 0.2)
interrupted("indirect with its own seed", lambda: Indirect(seed=Collocation(8000)).prepare(long).solve())
"""

MACHINES = """
arm, start = papers.paper_example(), [0.7, 0.6, 0.9]
task = TipTask(rows=(3, 4), velocity=(-1.0, -1.0))
accurate = ocp.RateOptions(tolerance=1e-12)
interrupted("local", lambda: ocp.resolve(arm, task, 1.0, start=start, samples=30000, options=accurate), 0.1)
pose = TipTask(position=[1.0, 1.0, 0.0], rows=(3, 4))
base = arm.base_home()
interrupted("inverse kinematics", lambda: inverse_kinematics(arm, pose, starts=300000))
interrupted("plan", lambda: ocp.plan(arm, task, 1.0, start=start, search='start'))
"""


DEAF = """
signal.signal(signal.SIGINT, signal.SIG_IGN)  # while Python ends, a late Ctrl-C would be its exit status,
exec("")  # and so would one that was caught after it ended an exec of Python's own, in an import or a dataclass
"""


def lines(code: str) -> list[list[str]]:
    done = run(f"{INTERRUPTED}\n{code}\n{DEAF}")
    assert done.returncode == 0, done.stderr
    assert "Exception" not in done.stderr
    return [line.split(" | ") for line in done.stdout.splitlines()]


@pytest.mark.long
def test_ctrl_c_ends_a_solve_at_once_with_its_iterate() -> None:
    *result, afterwards = lines(DIRECT)
    with_a_plan = ["ipopt", "ipopt without check", "fatrop"]
    others = ["second start", "what conflicts", "sleqp", "prepare", "refine", "tighten"]
    assert [name for name, _, _ in result] == with_a_plan + others
    assert {word for name, word, _ in result if name in with_a_plan} == {"KeyboardInterrupt with a plan"}
    assert {word.removesuffix(" with a plan") for _, word, _ in result} == {"KeyboardInterrupt"}
    assert {late for _, _, late in result} == {"at once"}
    assert afterwards == ["True False"]


@pytest.mark.long
def test_ctrl_c_during_a_check_is_no_verdict() -> None:
    result = lines(CHECKS)
    assert [name for name, _, _ in result] == [
        "audit", "audit again", "certificate", "indirect", "indirect with its own seed"
    ]  # fmt: skip
    assert {word.removesuffix(" with a plan") for _, word, _ in result} == {"KeyboardInterrupt"}
    assert {late for _, _, late in result} == {"at once"}


def test_ctrl_c_ends_planning_of_machines() -> None:
    result = lines(MACHINES)
    assert {word.removesuffix(" with a plan") for _, word, _ in result} == {"KeyboardInterrupt"}, result
    assert {late for _, _, late in result} == {"at once"}, result


def test_an_exception_of_a_signal_handler_ends_a_call() -> None:
    """An alarm, say: it is raised where the call was made, and the handler stays as it was."""

    class Alarm(Exception):
        pass

    def ring(number: int, frame: Any) -> None:
        raise Alarm

    @interruptible
    def waits() -> None:
        while True:
            time.sleep(0.01)

    before = signal.signal(signal.SIGALRM, ring)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.1)
        with pytest.raises(Alarm):
            waits()
        assert signal.getsignal(signal.SIGALRM) is ring
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    for thread in threading.enumerate():
        if thread.name == "ocp":  # it ends, or this waits for ever
            thread.join()


def test_a_call_returns_raises_and_warns_as_without_its_thread() -> None:
    @interruptible
    def half(value: float) -> float:
        """The half."""
        if value < 0:
            raise ProblemError("negative", name="value")
        with np.errstate():
            return float(np.sqrt(value) ** 2 / 2)

    assert half(3.0) == pytest.approx(1.5)
    assert half.__doc__ == "The half."
    with pytest.raises(ProblemError, match="negative") as caught:
        half(-1.0)
    assert caught.value.name == "value"
    with np.errstate(invalid="raise"), pytest.raises(FloatingPointError):  # the caller's own settings hold inside
        interruptible(lambda: np.sqrt(np.float64(-1.0)))()
    assert Interrupted("x").solution is None


# ---- time limits -------------------------------------------------------------------------------------------------

NEVER = {"tol": 1e-300, "acceptable_iter": 0, "max_iter": 1000000}


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_solve_ends_at_its_time_limit_and_says_so(solver: str) -> None:
    problem = van_der_pol((1.0, 0.0), horizon=20.0, upper=1.0, lower=-1.0)
    options = NEVER if solver == "ipopt" else {"max_iter": 1000000}
    prepared = prepare(problem, Collocation(300, 4), solver=solver, options=options)
    solution = prepared.solve(check=False, time_limit=0.02)
    with pytest.raises(SolveError, match="Maximum_WallTime_Exceeded: raise time_limit") as caught:
        prepared.solve(time_limit=0.02)
    for plan in (solution, caught.value.solution):
        assert not plan.success
        assert plan.status is SolverStatus.TIME_LIMIT
        assert plan["x"].shape == (1201, 2)
        assert np.all(np.isfinite(plan["x"]))
        assert np.isfinite(plan.cost)


def test_sleqp_ends_at_its_time_limit_and_works_again() -> None:
    prepared = prepare(van_der_pol((1.0, 0.0), horizon=20.0, upper=1.0, lower=-1.0), Collocation(60), solver="sleqp")
    stopped = prepared.solve(check=False, time_limit=0.05)
    assert not stopped.success
    assert stopped.status is SolverStatus.TIME_LIMIT
    assert np.all(np.isfinite(stopped["x"]))
    assert np.isfinite(stopped.cost)
    assert prepared.solve(check=False).success


def test_where_sleqp_fails_is_no_foreign_exception() -> None:
    """Its interface raises where it gives up."""
    problem = van_der_pol((1.0, 0.0), horizon=20.0, upper=1.0, lower=-1.0)
    plan = prepare(problem, Collocation(100, 4), solver="sleqp").solve(check=False)
    assert plan.success or plan.status is SolverStatus.STEP_FAILED
    assert np.all(np.isfinite(plan["x"]))


def solved_from_zeros() -> Problem:
    """No number at the guess, so that the solver fails there at once; solved from zeros."""
    problem = Problem("solved from zeros")
    x = problem.state("x", 2, initial=[1.0, 0.0])
    u = problem.control("u", guess=-2.0)
    problem.dynamics(x, ca.vertcat(x[1], (1 - x[0] ** 2) * x[1] - x[0] + u))
    problem.horizon(20.0)
    problem.minimize(running=ca.sumsqr(x) + u**2 + 1e-3 * ca.log(1 + u) ** 2)
    return problem


def test_one_time_limit_covers_all_starts() -> None:
    """What ran out of time is told of, whichever start it was at; behind it there is no other."""
    assert solve(solved_from_zeros(), Collocation(20)).start == "zeros"
    prepared = prepare(solved_from_zeros(), Collocation(4000, 4))
    with pytest.raises(SolveError, match="Maximum_WallTime_Exceeded: raise time_limit") as caught:
        prepared.solve(time_limit=0.3)
    report = str(caught.value).splitlines()
    assert next(line for line in report if line.startswith("from the ")).startswith("from the guess: Invalid_Number")
    assert "from the roll-out" not in str(caught.value)
    assert caught.value.solution.start == "zeros"
    assert caught.value.solution.status is SolverStatus.TIME_LIMIT


def test_the_time_limit_holds_for_all_of_a_solve() -> None:
    """The build counts, and so does the search for what conflicts behind a solve that fails."""
    with pytest.raises(SolveError, match="Maximum_WallTime_Exceeded"):
        solve(van_der_pol(horizon=20.0), Collocation(200), time_limit=1e-6)
    with pytest.raises(SolveError, match="Maximum_WallTime_Exceeded"):
        prepare(van_der_pol(), Indirect()).solve(time_limit=1e-6)
    seed = solve(van_der_pol(), Collocation(10))
    with pytest.raises(SolveError, match="Maximum_WallTime_Exceeded"):
        prepare(van_der_pol(), Indirect()).solve(guess=seed, time_limit=1e-6)
    assert solve(energy(), Collocation(3), time_limit=100.0).success


@pytest.mark.parametrize("limit", [0.0, -1.0, np.nan, np.inf, "soon", True])
def test_a_time_limit_that_cannot_be_right_is_named(limit: Any) -> None:
    for call in (solve, refine, tighten):
        with pytest.raises(ProblemError, match="time_limit must be positive and finite") as caught:
            call(energy(), Collocation(3), time_limit=limit)
        assert caught.value.name == "time_limit"


def test_an_outer_time_limit_holds_inside() -> None:
    assert time_left() == np.inf
    with time_limited(5.0):
        with time_limited(100.0):
            assert time_left() <= 5.0
        with time_limited(None):
            assert time_left() <= 5.0
        with time_limited(1.0):
            assert time_left() <= 1.0
    assert time_left() == np.inf
    check_time()
    with time_limited(1e-9), pytest.raises(TimeLimitReached, match="Maximum_WallTime_Exceeded"):
        check_time()


def long() -> Problem:
    """Bounded from both sides for a long time: a mesh that is good enough takes many rounds."""
    return van_der_pol((1.0, 0.0), horizon=20.0, upper=1.0, lower=-1.0)


@pytest.mark.parametrize("method", [Collocation(4000), MultipleShooting(4000)], ids=str)
def test_a_build_ends_at_the_time_limit(
    monkeypatch: pytest.MonkeyPatch, method: Collocation | MultipleShooting
) -> None:
    """After one of its parts: none is a large share of it, and the solver is never made."""
    results: list[str] = []
    monkeypatch.setattr("ocp.direct.prepared.build_solver", lambda *_: results.append("solver"))
    with pytest.raises(SolveError, match="still being built: Maximum_WallTime_Exceeded: raise time_limit") as caught:
        solve(van_der_pol(), method, time_limit=1e-9)
    assert (caught.value.name, caught.value.solution, results) == ("time_limit", None, [])


def overtaken(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, call: int, module: Any = ocp.refinement) -> None:
    """A function that the time limit, whatever it is, overtakes at that call; ``module`` looks at the time then."""
    real, calls = getattr(owner, name), []

    def slow(*arguments: Any, **named: Any) -> Any:
        calls.append(name)
        if len(calls) < call:
            return real(*arguments, **named)
        with time_limited(1e-9):
            return real(*arguments, **named)

    monkeypatch.setattr(owner, name, slow)
    monkeypatch.setattr(module, "time_left", lambda: -1.0 if len(calls) >= call else np.inf)


def test_refinement_ends_at_its_time_limit_with_the_plan_that_it_has() -> None:
    with pytest.warns(RefinementWarning, match="the time limit is reached: raise time_limit") as report:
        plan = refine(
            long(), Collocation(20), tolerance=1e-13, settings=RefinementSettings(max_intervals=100_000), time_limit=1.0
        )
    assert plan.success
    assert plan.refinement is not None
    assert not plan.refinement.reached
    assert len(plan.control_interpolant.breaks) == plan.refinement.intervals[-1] + 1
    warning = report[0].message
    assert isinstance(warning, RefinementWarning)
    assert warning.name
    assert warning.value > 1.0


@pytest.mark.parametrize("slow", ["solve", "judge"])
@pytest.mark.parametrize("rounds", [1, 2])
def test_refinement_keeps_the_last_audited_plan_whatever_the_limit_meets(
    slow: str, rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = van_der_pol()
    with pytest.warns(RefinementWarning):
        cut = refine(problem, Collocation(3), tolerance=1e-8, settings=RefinementSettings(limits={"lost": 0.0}))
    assert cut.refinement is not None
    assert len(cut.refinement.intervals) > rounds
    overtaken(monkeypatch, ocp.refinement, slow, rounds + 1)
    with pytest.warns(RefinementWarning, match="time_limit"):
        plan = refine(
            problem, Collocation(3), tolerance=1e-8, settings=RefinementSettings(limits={"lost": 0.0}), time_limit=100.0
        )
    assert plan.refinement is not None
    assert plan.refinement.intervals == cut.refinement.intervals[:rounds]
    assert {len(values) for values in plan.refinement.errors.values()} == {rounds}
    assert len(plan.control_interpolant.breaks) == plan.refinement.intervals[-1] + 1
    assert not plan.refinement.reached


def test_refinement_without_a_plan_at_its_time_limit_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SolveError, match="Maximum_WallTime_Exceeded: raise time_limit") as caught:
        refine(long(), Collocation(200), time_limit=1e-6)
    assert (caught.value.name, caught.value.solution) == ("time_limit", None)  # it was still being built
    overtaken(monkeypatch, ocp.refinement, "judge", 1)
    with pytest.raises(
        SolveError, match="audit of its first plan with Maximum_WallTime_Exceeded: raise time"
    ) as caught:
        refine(van_der_pol(), Collocation(3), time_limit=100.0)
    assert (caught.value.name, caught.value.value) == ("time_limit", 100.0)
    plan = caught.value.solution
    assert not plan.success
    assert plan.status is SolverStatus.TIME_LIMIT
    assert plan.cost == pytest.approx(solve(van_der_pol(), Collocation(3)).cost)


def test_a_failure_within_the_time_limit_is_no_matter_of_time() -> None:
    for call in (refine, tighten):
        with pytest.raises(SolveError, match="Maximum_Iterations_Exceeded") as caught:
            call(van_der_pol(), Collocation(3), options={"max_iter": 1}, time_limit=100.0)
        assert "time_limit" not in str(caught.value)


def test_tightening_ends_at_its_time_limit_with_its_best_plan() -> None:
    with pytest.raises(SolveError, match="Maximum_WallTime_Exceeded: raise time_limit") as caught:
        tighten(long(), Collocation(200), time_limit=1e-6)
    assert (caught.value.name, caught.value.solution) == ("time_limit", None)  # it was still being built


@pytest.mark.parametrize("rounds", [1, 2])
def test_interrupted_tightening_carries_its_best_plan(rounds: int, monkeypatch: pytest.MonkeyPatch) -> None:
    method = Collocation(10, scheme="legendre")  # takes four rounds
    overtaken(monkeypatch, Prepared, "solve", rounds + 1, ocp.tightening)
    with pytest.raises(
        SolveError, match=r"Maximum_WallTime_Exceeded: raise time_limit; .* still exceeds its bound"
    ) as report:
        tighten(walled(), method, tolerance=1e-10, time_limit=100.0)
    assert (report.value.name, report.value.value) == ("time_limit", 100.0)
    plan = report.value.solution
    assert not plan.success
    assert plan.status is SolverStatus.TIME_LIMIT
    assert (plan.bound_tightening is None) == (rounds == 1)  # under the bounds of its own round
    monkeypatch.undo()
    plain, tight = solve(walled(), method), tighten(walled(), method, tolerance=1e-10)
    assert beyond(tight) < beyond(plan)
    assert beyond(plan) == beyond(plain) if rounds == 1 else beyond(plan) < beyond(plain)


def test_enough_time_changes_nothing() -> None:
    for call in (refine, tighten):
        free, timed = (call(van_der_pol(upper=0.8), Collocation(8), time_limit=limit) for limit in (None, 100.0))
        assert timed.cost == free.cost
        np.testing.assert_array_equal(timed.variables, free.variables)


# ---- threads -----------------------------------------------------------------------------------------------------

THREADS = """
import sys, threading
import casadi as ca
import numpy as np
from ocp import *
from ocp.problem.formulation import Formulation
from tests.ocp.problems import van_der_pol

started = threading.Barrier(4)
results, errors = [], []


def together(call):
    def work():
        started.wait()
        try:
            results.append(call())
        except BaseException as error:
            errors.append(error)
    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads: thread.start()
    for thread in threads: thread.join()
"""

REPORT = """
assert not errors, errors
if isinstance(results[0][0], float):
    results = np.round(results, 9).tolist()
print(len(results), len({str(result) for result in results}))
"""

SHARED = {
    "ipopt": """
prepared = prepare(van_der_pol(), Collocation(40))
together(lambda: [prepared.solve().cost for _ in range(5)])
""",
    "fatrop": """
prepared = prepare(van_der_pol(), Collocation(40), solver="fatrop")
together(lambda: [prepared.solve().cost for _ in range(5)])
""",
    "indirect": """
prepared, seed = prepare(van_der_pol(), Indirect()), solve(van_der_pol(), Collocation(40))
together(lambda: [prepared.solve(guess=seed).cost for _ in range(2)])
""",
    "problem": """
problem = van_der_pol()
together(lambda: [solve(problem, Collocation(40)).cost for _ in range(3)])
""",
    "audit": """
plan = solve(van_der_pol(), Collocation(40))
together(lambda: [str(plan.audit()) for _ in range(3)])
""",
    "formulation": """
form = Formulation(van_der_pol())
x, u, t = np.ones((50, 2)), np.ones((50, 1)), np.ones(50)
p = np.zeros(0)
together(lambda: [float(form.sampled([form.f, form.running], x, u, t, 1.0, p)[0].sum()) for _ in range(40)])
""",
}


@pytest.mark.parametrize("what", some(SHARED, 2))
def test_threads_that_share_objects_get_the_same_results(what: str) -> None:
    done = run(f"{THREADS}\n{SHARED[what]}\n{REPORT}")
    assert done.returncode == 0, (done.returncode, done.stderr)
    assert done.stdout.split() == ["4", "1"]


# ---- words -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
def test_without_a_terminal_a_solve_logs_its_start_and_its_end(solver: str, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "ocp"):
        plan = solve(energy(), Collocation(4), solver=solver)
    start, end = (record.getMessage() for record in caplog.records)
    assert all(record.name == "ocp" for record in caplog.records)
    assert start == f"solving 'energy': {plan.variables.size} variables, {plan.multipliers.size} rows"
    assert end.startswith(f"solved 'energy': {plan.status}, cost {plan.cost:.6g}, {plan.iterations} iterations, ")
    caplog.clear()
    prepared = prepare(van_der_pol(horizon=20.0), Collocation(100), solver=solver)
    with caplog.at_level(logging.INFO, "ocp"):
        prepared.solve(time_limit=1e-3, check=False)
    assert "Maximum_WallTime_Exceeded" in caplog.records[-1].getMessage()


def test_a_silenced_thread_does_not_silence_another(capsys: pytest.CaptureFixture[str]) -> None:
    real = sys.stderr
    inside, leave = threading.Event(), threading.Event()

    def hushed() -> None:
        with casadi_silenced():
            print("of the thread", file=sys.stderr)
            inside.set()
            leave.wait(10.0)

    thread = threading.Thread(target=hushed)
    thread.start()
    inside.wait(10.0)
    with casadi_silenced():
        print("of the main thread, hushed", file=sys.stderr)
        with casadi_silenced():
            pass
        print("still hushed", file=sys.stderr)
    print("of the main thread", file=sys.stderr)
    leave.set()
    thread.join()
    assert sys.stderr is real
    assert capsys.readouterr().err == "of the main thread\n"


def test_a_limit_of_processor_time_passes_only_while_the_program_works() -> None:
    """Other programs, for which sleep stands here, use up a limit of the wall time, but not of the processor time."""
    with time_limited(0.1), time_limited(0.1, processor=True):
        time.sleep(0.05)
        assert time_left() < 0.06
    with time_limited(0.1, processor=True):
        time.sleep(0.15)
        assert time_left() > 0
        begun = time.process_time()
        while time.process_time() < begun + 0.11:
            pass
        assert time_left() < 0
        with pytest.raises(TimeLimitReached):
            check_time()
    assert time_left() == np.inf


def test_stages_are_logged_and_steps_of_a_stage_are_not(caplog: pytest.LogCaptureFixture) -> None:
    stages: list[str] = []
    with caplog.at_level(logging.INFO, "ocp"), shown_progress("plan", stages.append):
        report("collision scene")
        report("3 of 7 motions done", step=True)
    assert stages == ["collision scene", "3 of 7 motions done"]
    assert [each.getMessage() for each in caplog.records] == ["collision scene"]
