"""Plan the motion of a task file, and write plans in other formats."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from models.files import INPUT_LIMITS
from ocp.app.files import write_mcap
from ocp.app.files.outputs import MARK, SUFFIXES, checked_output
from ocp.app.files.task_file import Task
from ocp.app.files.text_files import missing_package
from ocp.errors import ProblemError, require
from ocp.motion.plan import Plan, plan
from ocp.motion.result.segmented_plan import SegmentedPlan
from ocp.storage import write_text

__all__ = ["EXPORT_KINDS", "check_period", "export_plan", "run_task"]

FINDING_FIELDS = ("name", "value", "limit", "unit", "time", "passed", "verdict", "note")
"""Fields of the audit's findings that JSON shows."""


def run_task(
    task: Task, output: Path | None, progress: Callable[[str], None], force: bool = False
) -> tuple[int, str, Any]:
    """Plan, audit and write; return the exit status, a text, and the contents of JSON.

    Args:
        task: Contents of the task file.
        output: File of the plan, anywhere; None: as in the task.
        progress: Is called with the name of each stage.
        force: Whether files that selfmotion did not write are overwritten.

    Raises:
        ProblemError: The task is infeasible or invalid, or an output may not be written.
        SolveError: No motion passes its audit; the message gives the reasons.
    """
    outputs = task.outputs if output is None else task.outputs | {"plan": output}
    unrestricted = () if output is None else ("plan",)

    def checked(kind: str, file: Path) -> Path:
        return checked_output(kind, file, None if kind in unrestricted else task.output_folder, force)

    def write(result: Plan, files: dict[str, Path]) -> None:
        for kind, path in {kind: checked(kind, file) for kind, file in files.items()}.items():
            progress(f"writing {path.name}")
            WRITERS[kind](result, path, task.period, task.file)

    for kind, file in outputs.items():  # check the outputs before the user waits for the plan
        checked(kind, file)
    result = plan(task.machine, task.task, **task.options, progress=progress)
    check_period(result, task.period)
    progress("audit")
    audit = result.audit()
    write(result, outputs)
    lines = [str(result), f"The plan {audit.sentence}.", *_output_lines(list(outputs.values()))]
    data = {
        "passed": audit.passed,
        "verdict": audit.sentence,
        "cost": result.cost,
        "bound": result.bound,
        "duration": result.horizon,
        "joints": result.names,
        "start": result.at(0.0)["joints"],
        "candidates": [
            {"cost": candidate.cost, "reason": None if candidate.reason is None else str(candidate.reason)}
            for candidate in result.candidates
        ],
        "audit": [{name: getattr(finding, name) for name in FINDING_FIELDS} for finding in audit.findings],
        **_segments(result),
        "written": {kind: str(file) for kind, file in outputs.items()},
    }
    return (0 if audit.passed else 1), "\n".join(lines), data


def _segments(result: Plan) -> dict[str, Any]:
    """Return the segments of a plan, and the motions between them, if it has several."""
    if not isinstance(result, SegmentedPlan):
        return {}
    names = ("time", "before", "after", "duration", "failure")
    return {
        "fewest": result.fewest,
        "segments": [
            {"begin": begin, "duration": segment.horizon, "cost": segment.cost, "bound": segment.bound}
            for begin, segment in zip(result.start_times, result.segments, strict=True)
        ],
        "reconfigurations": [{name: getattr(each, name) for name in names} for each in result.reconfigurations],
    }


def _output_lines(files: list[Path]) -> list[str]:
    hint = "no file is written: give -o FILE.npz, or [output] in the task file"
    return [f"written: {file}" for file in files] or [hint]


def export_plan(plan: Plan, file: Path, period: float, force: bool = False) -> None:
    """Write a plan in the format of the file's suffix.

    Raises:
        ProblemError: The suffix is unknown, the period is not positive, or selfmotion did not write an existing file
            and `force` is False.
    """
    kind = next((kind for kind in EXPORT_KINDS if file.suffix.lower() in SUFFIXES[kind]), None)
    if kind is None:
        known = tuple(SUFFIXES[kind][0] for kind in EXPORT_KINDS)
        words = f"{file}: a plan can be exported as {', '.join(known)}; end the name with one of these"
        raise ProblemError(words, name="file", value=str(file), limit=known)
    path = checked_output(kind, file, force=force)
    check_period(plan, period)
    WRITERS[kind](plan, path, period, "")


def check_period(plan: Plan, period: float) -> None:
    """Raise ProblemError if a sampling period is not positive or gives more than INPUT_LIMITS.count samples."""
    require.positive("period", period)
    most = INPUT_LIMITS.count
    if plan.horizon / period > most:
        words = f"a period of {period:g} s gives {plan.horizon / period:.3g} samples; at most {most} can be written"
        raise ProblemError(words, name="period", value=period, limit=plan.horizon / most)


def _yaml(plan: Plan, file: Path, period: float) -> None:
    try:
        import yaml
    except ImportError as error:
        raise missing_package("writing YAML", "pyyaml", "yaml") from error
    write_text(file, f"# {MARK}\n{yaml.safe_dump(plan.to_ros(period), sort_keys=False)}")


def _report(plan: Plan, file: Path, period: float, title: str) -> None:
    from ocp.app.view.report import report_of_plan  # imports matplotlib, which is slow

    write_text(file, report_of_plan(plan, period, title).html())


WRITERS: dict[str, Callable[[Plan, Path, float, str], Any]] = {
    "plan": lambda plan, file, period, title: plan.save(file),
    "csv": lambda plan, file, period, title: plan.write_csv(file, period),
    "json": lambda plan, file, period, title: write_text(file, json.dumps(plan.to_ros(period)) + "\n"),
    "yaml": lambda plan, file, period, title: _yaml(plan, file, period),
    "mcap": lambda plan, file, period, title: write_mcap(plan, file, period),
    "urdf": lambda plan, file, period, title: write_text(file, plan.machine.robot.to_urdf()),
    "report": _report,
}
"""Writers of each kind of output; arguments are the plan, the file, the sampling period in s, and a title."""
EXPORT_KINDS = ("csv", "json", "yaml", "mcap", "urdf")
