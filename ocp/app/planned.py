"""Plans of task files, and plans written as others read them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from models import FixedBase
from ocp.errors import MOST, ProblemError, checked_instance, checked_positive
from ocp.files import write_mcap
from ocp.files.task_file import Task
from ocp.planning import Plan, PlanInPieces, plan, plan_in_pieces
from ocp.storage import write_text

__all__ = ["WRITERS", "check_period", "export", "run_task"]


def run_task(task: Task, output: Path | None, progress: Callable[[str], None]) -> tuple[int, str, Any]:
    """Plan, audit, write: exit status, text, and what JSON shows.

    Raises:
        ProblemError: What is asked does not fit, or is out of reach.
        SolveError: There is no motion that passes its audit; says why.
    """
    outputs = task.outputs if output is None else task.outputs | {"plan": output}
    if task.in_pieces:
        found = plan_in_pieces(checked_instance("machine", task.machine, FixedBase), task.task, **task.options)
        if found.reconfigurations:
            return _in_pieces(task, found, outputs, progress)
        made = found.pieces[0]
    else:
        made = plan(task.machine, task.task, **task.options)
    check_period(made, task.period)
    progress("audit")
    audit = made.audit()
    _write(made, outputs, task, progress)
    lines = [str(made), f"The plan {audit.sentence}.", *_written(list(outputs.values()))]
    told = {
        "passed": audit.passed,
        "verdict": audit.sentence,
        "cost": made.cost,
        "bound": made.bound,
        "duration": made.horizon,
        "joints": made.names,
        "start": made.at(0.0)["joints"],
        "candidates": [{"cost": one.cost, "why": one.why} for one in made.candidates],
        "audit": [
            {
                "name": f.name,
                "value": f.value,
                "limit": f.limit,
                "unit": f.unit,
                "time": f.time,
                "passed": f.passed,
                "verdict": f.verdict,
                "note": f.note,
            }
            for f in audit.findings
        ],
        "written": {kind: str(file) for kind, file in outputs.items()},
    }
    return (0 if audit.passed else 1), "\n".join(lines), told


def _in_pieces(
    task: Task, found: PlanInPieces, outputs: dict[str, Path], progress: Callable[[str], None]
) -> tuple[int, str, Any]:
    """As `run_task`: pieces and the ways between them, their files numbered in the order in which they are run."""
    order: list[Plan | None] = [found.pieces[0]]
    for way, piece in zip(found.reconfigurations, found.pieces[1:], strict=True):
        order += [way.way, piece]
    lines, files, passed = [str(found)], list[Path](), None not in order
    for number, made in enumerate(order, 1):
        if made is None:
            continue
        check_period(made, task.period)
        progress(f"audit of motion {number}")
        audit = made.audit()
        passed &= audit.passed
        lines.append(f"Motion {number} {audit.sentence}.")
        own = {kind: file.with_stem(f"{file.stem}-{number}") for kind, file in outputs.items()}
        _write(made, own, task, progress)
        files += own.values()
    told = {
        "passed": passed,
        "cost": found.cost,
        "duration": found.duration,
        "joints": found.pieces[0].names,
        "fewest": found.fewest,
        "pieces": [
            {"begin": begin, "duration": one.horizon, "cost": one.cost, "bound": one.bound}
            for begin, one in zip(found.begins, found.pieces, strict=True)
        ],
        "reconfigurations": [
            {"time": one.time, "before": one.before, "after": one.after, "duration": one.duration, "why": one.why}
            for one in found.reconfigurations
        ],
        "written": [str(file) for file in files],
    }
    return (0 if passed else 1), "\n".join(lines + _written(files)), told


def _write(made: Plan, outputs: dict[str, Path], task: Task, progress: Callable[[str], None]) -> None:
    """A plan as files of some kinds."""
    for kind, file in outputs.items():
        progress(f"writing {file.name}")
        if kind == "report":
            from ocp.app.report import report_of_plan

            write_text(file, report_of_plan(made, task.period, f"{task.file}").html())
        elif kind == "plan":
            made.save(file)
        else:
            WRITERS[f".{kind}"](made, file, task.period)


def _written(files: list[Path]) -> list[str]:
    nothing = "nothing is written: give -o FILE.npz, or [output] in the task file"
    return [f"written: {file}" for file in files] or [nothing]


def export(made: Plan, file: Path, period: float) -> None:
    """Write a plan by the end of the file's name.

    Raises:
        ProblemError: A name with another end, a period that is not positive.
    """
    writer = WRITERS.get(file.suffix.lower())
    if writer is None:
        words = f"{file}: a plan is written as {', '.join(WRITERS)}; end the name with one of these"
        raise ProblemError(words, name="file", value=str(file), limit=tuple(WRITERS))
    check_period(made, period)
    writer(made, file, period)


def check_period(made: Plan, period: float) -> None:
    """Raise ProblemError for a period that is not positive, or gives more than MOST samples."""
    checked_positive("period", period)
    if made.horizon / period > MOST:
        words = f"a period of {period:g} s gives {made.horizon / period:.3g} samples, at most {MOST} are written"
        raise ProblemError(words, name="period", value=period, limit=made.horizon / MOST)


def _yaml(made: Plan, file: Path, period: float) -> None:
    try:
        import yaml
    except ImportError as error:
        words = "YAML is written by the package pyyaml: pip install 'selfmotion[yaml]'"
        raise ProblemError(words, name="yaml") from error
    write_text(file, yaml.safe_dump(made.to_ros(period), sort_keys=False))


WRITERS: dict[str, Callable[[Plan, Path, float], Any]] = {
    ".csv": lambda made, file, period: made.write_csv(file, period),
    ".json": lambda made, file, period: write_text(file, json.dumps(made.to_ros(period)) + "\n"),
    ".yaml": _yaml,
    ".mcap": write_mcap,
    ".urdf": lambda made, file, period: made.machine.robot.to_urdf(file),
}
