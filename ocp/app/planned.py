"""Plans of task files, and plans written as others read them."""

from __future__ import annotations

import json
from collections.abc import Callable
from glob import escape
from pathlib import Path
from typing import Any

from models import FixedBase
from ocp.app.files import write_mcap
from ocp.app.files.outputs import MARK, SUFFIXES, checked_output
from ocp.app.files.task_file import Task
from ocp.errors import MAX_COUNT, ProblemError, checked_instance, checked_positive
from ocp.motion.plan import Plan, SegmentedPlan, plan, plan_in_segments
from ocp.storage import write_text

__all__ = ["EXPORTED", "check_period", "export", "run_task"]

TOLD = ("name", "value", "limit", "unit", "time", "passed", "verdict", "note")
"""Of a finding of the audit."""


def run_task(
    task: Task, output: Path | None, progress: Callable[[str], None], force: bool = False
) -> tuple[int, str, Any]:
    """Plan, audit, write: exit status, text, and what JSON shows.

    Args:
        output: Of the plan, wherever it is; None: as the task says. force: Whether files are overwritten that
            selfmotion did not write.

    Raises:
        ProblemError: What is asked does not fit, or is out of reach; an output may not be written.
        SolveError: There is no motion that passes its audit; says why.
    """
    outputs = task.outputs if output is None else task.outputs | {"plan": output}
    anywhere = () if output is None else ("plan",)

    def checked(kind: str, file: Path) -> Path:
        return checked_output(kind, file, None if kind in anywhere else task.output_folder, force)

    def write(made: Plan, files: dict[str, Path]) -> None:
        for kind, place in {kind: checked(kind, file) for kind, file in files.items()}.items():
            progress(f"writing {place.name}")
            WRITERS[kind](made, place, task.period, task.file)

    for kind, file in outputs.items():  # before anybody waits for the plan
        numbered = file.parent.glob(f"{escape(file.stem)}-*{escape(file.suffix)}") if task.in_pieces else ()
        for taken in (file, *numbered):
            checked(kind, taken)
    if task.in_pieces:
        found = plan_in_segments(checked_instance("machine", task.machine, FixedBase), task.task, **task.options)
        if found.reconfigurations:
            return _in_pieces(task, found, outputs, progress, write)
        made = found.pieces[0]
    else:
        made = plan(task.machine, task.task, **task.options)
    check_period(made, task.period)
    progress("audit")
    audit = made.audit()
    write(made, outputs)
    lines = [str(made), f"The plan {audit.sentence}.", *_written(list(outputs.values()))]
    told = {
        "passed": audit.passed,
        "verdict": audit.sentence,
        "cost": made.cost,
        "bound": made.bound,
        "duration": made.horizon,
        "joints": made.names,
        "start": made.at(0.0)["joints"],
        "candidates": [
            {"cost": one.cost, "reason": None if one.reason is None else str(one.reason)} for one in made.candidates
        ],
        "audit": [{name: getattr(finding, name) for name in TOLD} for finding in audit.findings],
        "written": {kind: str(file) for kind, file in outputs.items()},
    }
    return (0 if audit.passed else 1), "\n".join(lines), told


def _in_pieces(
    task: Task,
    found: SegmentedPlan,
    outputs: dict[str, Path],
    progress: Callable[[str], None],
    write: Callable[[Plan, dict[str, Path]], None],
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
        write(made, own)
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


def _written(files: list[Path]) -> list[str]:
    nothing = "nothing is written: give -o FILE.npz, or [output] in the task file"
    return [f"written: {file}" for file in files] or [nothing]


def export(made: Plan, file: Path, period: float, force: bool = False) -> None:
    """Write a plan by the end of the file's name.

    Raises:
        ProblemError: A name with another end, a period that is not positive, a file that selfmotion did not write,
            unless `force`.
    """
    kind = next((kind for kind in EXPORTED if file.suffix.lower() in SUFFIXES[kind]), None)
    if kind is None:
        known = tuple(SUFFIXES[kind][0] for kind in EXPORTED)
        words = f"{file}: a plan is written as {', '.join(known)}; end the name with one of these"
        raise ProblemError(words, name="file", value=str(file), limit=known)
    place = checked_output(kind, file, force=force)
    check_period(made, period)
    WRITERS[kind](made, place, period, "")


def check_period(made: Plan, period: float) -> None:
    """Raise ProblemError for a period that is not positive, or gives more than MOST samples."""
    checked_positive("period", period)
    if made.horizon / period > MAX_COUNT:
        words = f"a period of {period:g} s gives {made.horizon / period:.3g} samples, at most {MAX_COUNT} are written"
        raise ProblemError(words, name="period", value=period, limit=made.horizon / MAX_COUNT)


def _yaml(made: Plan, file: Path, period: float) -> None:
    try:
        import yaml
    except ImportError as error:
        words = "YAML is written by the package pyyaml: pip install 'selfmotion[yaml]'"
        raise ProblemError(words, name="yaml") from error
    write_text(file, f"# {MARK}\n{yaml.safe_dump(made.to_ros(period), sort_keys=False)}")


def _report(made: Plan, file: Path, period: float, title: str) -> None:
    from ocp.app.view.report import report_of_plan  # draws, which takes a while to import

    write_text(file, report_of_plan(made, period, title).html())


WRITERS: dict[str, Callable[[Plan, Path, float, str], Any]] = {
    "plan": lambda made, file, period, title: made.save(file),
    "csv": lambda made, file, period, title: made.write_csv(file, period),
    "json": lambda made, file, period, title: write_text(file, json.dumps(made.to_ros(period)) + "\n"),
    "yaml": lambda made, file, period, title: _yaml(made, file, period),
    "mcap": lambda made, file, period, title: write_mcap(made, file, period),
    "urdf": lambda made, file, period, title: write_text(file, made.machine.robot.to_urdf()),
    "report": _report,
}
"""What writes each kind of output: a plan, a file, the period of samples in s, and a title."""
EXPORTED = ("csv", "json", "yaml", "mcap", "urdf")
