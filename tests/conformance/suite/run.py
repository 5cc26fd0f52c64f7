"""One problem of a suite: solved, refined, audited, confirmed by a second method, and solved by rockit.

Each problem is done by a process of its own, forked from one that has solved a problem, so that seconds contain no
imports. It sends what it has after every stage: what a limit of processor time ends leaves the stages before it.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import resource
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from ocp import Collocation, Indirect, MultipleShooting, Problem, RefinementSettings, Solution, refine, solve
from ocp.console import time_limited

from .entry import Entry, Method

MOST_SECONDS = 100
"""Of the processor for all stages of a problem; what is not done by then stays out."""
FINER = 4
"""How many times as many intervals as the given mesh a refined one may have."""
DEVIATION = 1e-4
"""Relative deviation from a printed cost that counts as agreement, if its digits promise no less."""
AUTOMATIC_SECONDS = 60
"""Limit of the processor time of one solve without a method, s."""
SHARE = 0.1
"""Of a deviation from a printed cost, the most by which two methods may differ that confirm it."""
Row = dict[str, Any]


def refined(problem: Problem, method: Method, guess: Solution | None = None) -> Solution:
    """The plan on a mesh that is refined by its audits; by the minimum principle where that is the method.

    It may lose as much cost as costs may differ that agree.
    """
    if isinstance(method, Indirect):
        return solve(problem, method)
    settings = RefinementSettings(limits={"lost": DEVIATION}, max_intervals=FINER * method.intervals)
    return refine(problem, method, settings=settings, guess=guess)


def confirmed(entry: Entry, first: Solution) -> Row:
    """Cost by the second method from the guess of the problem; from the first plan if that ends elsewhere."""
    row: Row = {"second": named(entry.second), "second_start": "guess"}
    try:
        cost = refined(entry.build(), entry.second).cost
    except Exception as error:  # the first plan is another start
        cost = math.nan
        row["second_failed"] = words(error)
    if not digits(first.cost, cost) >= 2 and not isinstance(entry.second, Indirect):
        row |= {"second_start": "first plan", "second_from_guess": cost}
        try:
            cost = refined(entry.build(), entry.second, first).cost
        except Exception as error:
            row["second_failed"] = words(error)
    return row | {"second_cost": cost, "digits": digits(first.cost, cost)}


def digits(one: float, other: float) -> float:
    """How many leading digits two costs have in common; absolute where they are less than 1e-6; nan without one."""
    if not math.isfinite(one) or not math.isfinite(other):
        return math.nan
    size = max(abs(one), abs(other))
    return min(-math.log10(max(abs(one - other) / (size if size > 1e-6 else 1.0), 1e-15)), 15.0)


def verdict(cost: float, printed: float | str | None, second: float) -> str:
    """What the cost says of a printed one: "agrees", "below" or "above" if both methods say so, else "open".

    Without a printed cost "confirmed" or "open", by whether both methods agree within DEVIATION.
    """
    if printed is None:
        return "confirmed" if digits(cost, second) >= -math.log10(DEVIATION) else "open"
    published = float(printed)
    if abs(cost - published) <= max(DEVIATION * abs(published), last_digit(printed) / 2, 1e-9):
        return "agrees"
    if not abs(cost - second) <= SHARE * abs(cost - published):
        return "open"
    return "below" if cost < published else "above"


def last_digit(number: float | str) -> float:
    """The unit of the last digit of a number as it is printed."""
    mantissa, _, exponent = str(number).partition("e")
    return float(10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2])))


def named(method: Method) -> str:
    """Scheme, degree and number of intervals."""
    if isinstance(method, Collocation):
        return f"{method.scheme} {method.degree}, {method.intervals}" + ", held" * (method.control == "held")
    if isinstance(method, MultipleShooting):
        return f"shooting, {method.intervals}, {method.control}"
    return "minimum principle"


def words(error: Exception) -> str:
    """The kind of an error and the first line of what it says."""
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"[:200]


def stages(entry: Entry) -> list[Callable[[Row, dict[str, Any]], Row]]:
    """What is done for a problem, in order; each takes the row so far and what stages hand on, and adds to the row."""

    def solved(row: Row, kept: dict[str, Any]) -> Row:
        began = time.process_time()
        kept["plan"] = plan = solve(entry.build(), entry.method)
        seconds = time.process_time() - began
        return {"method": named(entry.method), "cost": plan.cost, "seconds": seconds, "iterations": plan.iterations}

    def finer(row: Row, kept: dict[str, Any]) -> Row:
        began = time.process_time()
        with contextlib.suppress(Exception):
            kept["plan"] = plan = refined(entry.build(), entry.method)
            row |= {"refined_cost": plan.cost, "intervals": plan.method["intervals"]}
        return {"refined_seconds": time.process_time() - began}

    def audited(row: Row, kept: dict[str, Any]) -> Row:
        audit = kept["plan"].audit()
        failed = "; ".join(finding.name for finding in audit.failures)
        reason = failed or ("" if audit.optimal is True else str(audit.undecided or ""))
        return {"feasible": audit.feasible, "optimal": audit.optimal, "reason": reason[:300]}

    def again(row: Row, kept: dict[str, Any]) -> Row:
        cost = kept["plan"].cost
        second = confirmed(entry, kept["plan"])
        printed = next(iter(entry.published.values()), None)
        return second | {"verdict": verdict(cost, printed, second["second_cost"])}

    def peer(row: Row, kept: dict[str, Any]) -> Row:
        if not isinstance(entry.method, Collocation):
            return {"rockit_failed": "not posed: a mesh of shooting"}
        from .peer import rockit_cost

        began = time.process_time()
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                cost = rockit_cost(entry.build(), entry.method)
        except Exception as error:
            return {"rockit_failed": words(error), "rockit_seconds": time.process_time() - began}
        return {"rockit_cost": cost, "rockit_seconds": time.process_time() - began}

    return [solved, finer, audited, again, peer]


def warm_up(known: Mapping[str, Entry]) -> None:
    """Solve a problem by every tool, so that what they import is there."""
    warnings.simplefilter("ignore")
    entry = known["mineng_di"]
    solve(entry.build(), entry.method).audit()
    with contextlib.suppress(Exception), contextlib.redirect_stdout(io.StringIO()):
        from .peer import rockit_cost

        rockit_cost(entry.build(), Collocation(2, 2))


def done(entry: Entry) -> Row:
    """All stages of a problem, in a process of its own."""
    rows = _forked(MOST_SECONDS, lambda send: _stages(entry, send))
    return rows[-1] if rows else {"failed": f"no plan within {MOST_SECONDS} s of the processor"}


def automatic(entry: Entry, cost: float) -> Row:
    """Solve a problem without a method: without any guess and, if that fails, with the guess of its source.

    ``cost`` is the cost of the row, which the automatic plan has to reach.
    """
    row: Row = {}
    for start in ("no guess", "guess"):
        rows = _forked(AUTOMATIC_SECONDS + 5, partial(_automatic, entry, start == "no guess"))
        row = rows[-1] if rows else {"automatic_failed": f"no plan within {AUTOMATIC_SECONDS} s of the processor"}
        row["automatic_start"] = start
        own_cost = row.get("automatic_cost", math.nan)
        feasible = row.pop("automatic_feasible", False)
        row["automatic"] = feasible and reached(own_cost, cost)
        if row["automatic"]:
            break
        row.setdefault("automatic_failed", f"{'' if feasible else 'not feasible, '}cost {own_cost:.8g}")
    return row


def reached(automatic_cost: float, cost: float) -> bool:
    """Return whether a cost is that of the row, or a lower one."""
    return automatic_cost - cost <= max(DEVIATION * abs(cost), 1e-9)


def _automatic(entry: Entry, unguessed: bool, send: Callable[[Row], None]) -> None:
    """Send cost, mesh, seconds and feasibility of a solve without a method."""
    began = time.process_time()
    try:
        with time_limited(AUTOMATIC_SECONDS, processor=True):
            plan = solve(without_guess(entry.build()) if unguessed else entry.build())
    except Exception as error:
        send({"automatic_failed": words(error), "automatic_seconds": time.process_time() - began})
        return
    row: Row = {"automatic_cost": plan.cost, "automatic_intervals": plan.method["intervals"]}
    row["automatic_seconds"] = time.process_time() - began
    send(row | {"automatic_feasible": plan.audit(only_feasible=True).feasible})


def without_guess(problem: Problem) -> Problem:
    """Return a problem without the guesses that it declares."""
    declared = problem.declared
    for pool in (declared.states, declared.controls):
        for name, variable in pool.items():
            pool[name] = replace(variable, guess=None)
    if declared.horizon is not None:
        declared.horizon.guess = None
    return problem


def _forked(seconds: int, work: Callable[[Callable[[Row], None]], None]) -> list[Row]:
    """Return what work in a process of its own sends within a limit of the processor time, s."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5))
        with os.fdopen(writer, "w") as sink:
            work(lambda row: print(json.dumps(row), file=sink, flush=True))
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as source:
        lines = source.read().splitlines()
    os.waitpid(child, 0)
    return [json.loads(line) for line in lines if line.endswith("}")]


def _stages(entry: Entry, send: Callable[[Row], None]) -> None:
    """Do every stage and send the row so far after each."""
    row: Row = {"name": entry.name}
    kept: dict[str, Any] = {}
    for stage in stages(entry):
        try:
            row |= stage(row, kept)
        except Exception as error:
            row["failed"] = f"{stage.__name__}: {words(error)}"
            if "plan" not in kept:
                break
        send(row)
    send(row)
