"""Paths through the poses of a public benchmark of redundant arms, beside Descartes: length, time and memory.

Every run is a process of its own, whose processor time and memory are limited; what it leaves is judged by the rules of
the benchmark with Pinocchio and coal. `python -m scripts.timing.waypoints PROBLEM FOLDER` is one run of ours.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.patches import Patch

from scripts import drawing
from scripts.papers.run import progress, text_table
from scripts.timing import descartes
from tests.redundancy_benchmark import PROBLEMS, problem_of

RESOLUTIONS = (0.1, 0.02)
"""rad, between the samples of Descartes."""
SECONDS, MEMORY = 240, 8
"""Limits of each run: s of processor time and GB; ours is asked for 60 s and 2 GB."""
OURS = "selfmotion"


def run(repeats: int = 5) -> dict[str, Any]:
    """All runs, once each."""
    runs = [(name, resolution) for name in PROBLEMS for resolution in (None, *RESOLUTIONS)]
    if not descartes.is_installed():
        runs = [one for one in runs if one[1] is None]
    return {"rows": [row(*one) for one in progress(runs, "waypoints")], "seconds": SECONDS, "memory_gb": MEMORY}


def row(name: str, resolution: float | None) -> dict[str, Any]:
    """One run: by ours, or by Descartes with samples so fine."""
    from tests.sweep.redundancy import faults, turning

    problem = problem_of(name)
    published = problem.torm_length_rad
    by = OURS if resolution is None else f"Descartes, {resolution:g} rad"
    with tempfile.TemporaryDirectory() as folder:
        if resolution is not None:
            descartes.write_problem(name, resolution, Path(folder))
        module = "waypoints" if resolution is None else "descartes"
        own = [name] if resolution is None else []
        seconds, memory, message = measured([sys.executable, "-m", f"scripts.timing.{module}", *own, folder])
        file = Path(folder) / "joints.npy"
        joints = np.load(file) if file.exists() else None
    by_name: dict[str, Any] = {"problem": name, "by": by, "rad": None, "m": None, "published_rad": published}
    verdict = message
    if joints is not None:
        paths, turns = np.abs(np.diff(joints, axis=0)).sum(axis=0), turning(problem)
        by_name |= {"rad": float(paths[turns].sum()), "m": float(paths[np.logical_not(turns)].sum())}
        verdict = "; ".join(faults(name, joints)) or "valid"
    return by_name | {"cpu_s": seconds, "peak_mb": memory, "verdict": " ".join(verdict.split())}


def measured(command: list[str]) -> tuple[float, float, str]:
    """Processor time, s, peak memory, MB, and why a process came to nothing, as far as it says."""

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY << 30, MEMORY << 30))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 1))

    with tempfile.TemporaryFile() as message:
        process = subprocess.Popen(
            command,
            preexec_fn=limited,
            stdout=message,
            stderr=subprocess.STDOUT,
            cwd=Path(__file__).resolve().parents[2],
        )
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        message.seek(0)
        text = message.read().decode(errors="replace")
    seconds = used.ru_utime + used.ru_stime
    if "bad_alloc" in text or "MemoryError" in text:
        printed = f"more than {MEMORY} GB"
    elif process.returncode == -signal.SIGXCPU or seconds >= SECONDS:
        printed = f"more than {SECONDS} s"
    elif "failed to build graph" in text:
        printed = "no posture was found at some waypoint, or none that is clear"
    else:
        printed = text.strip().splitlines()[-1][-200:] if text.strip() else f"ended with {process.returncode}"
    return seconds, used.ru_maxrss / 1024, printed


def report(numbers: dict[str, Any]) -> str:
    """The table, and how long the peer's shortest valid ways are."""
    rows, words = numbers["rows"], list[str]()
    for name in PROBLEMS:
        own = [row for row in rows if row["problem"] == name]
        valid = [row for row in own if row["verdict"] == "valid"]
        ours = next((row["rad"] for row in valid if row["by"] == OURS), None)
        peers = [row for row in valid if row["by"] != OURS]
        best = min(peers, key=lambda row: row["rad"], default=None)
        if len(own) > 1 and ours:
            message = "none is valid" if best is None else f"{best['rad'] / ours:.3g} times ours ({best['by']})"
            words.append(f"{name}: Descartes {message}")
    return "\n".join([text_table(rows, 4), *words])


def plot(path: Path, numbers: dict[str, Any]) -> None:
    """Lengths of valid ways, and memory of all runs."""
    kinds = list(dict.fromkeys(row["by"] for row in numbers["rows"]))
    note = (
        f"Joints' way, sum over those that turn; only what is valid by the benchmark's rules (Pinocchio, coal); black "
        f"lines: published. Each run in a process of its own of at most {numbers['seconds']} s and "
        f"{numbers['memory_gb']} GB."
    )
    valid = {by: sum(1 for row in numbers["rows"] if (row["by"], row["verdict"]) == (by, "valid")) for by in kinds}
    title = f"Paths through waypoints: {valid.get(OURS, 0)} problems solved, by Descartes at most " + str(
        max((count for by, count in valid.items() if by != OURS), default=0)
    )
    with drawing.sheet(path, (1, 2), (8.4, 3.9), note, title=title) as (figure, axes):
        lengths, memory = np.ravel(axes)
        for k, by in enumerate(kinds):
            color = drawing.COLORS["blue"] if by == OURS else drawing.COLORS["orange"]
            for row in (row for row in numbers["rows"] if row["by"] == by):
                at = PROBLEMS.index(row["problem"]) + 0.2 * (k - (len(kinds) - 1) / 2)
                shade = 1.0 if by == OURS else 1.0 - 0.25 * (len(kinds) - 1 - k)
                if row["verdict"] == "valid":
                    lengths.barh(at, row["rad"], 0.18, color=color, alpha=shade)
                memory.barh(at, row["peak_mb"] / 1000, 0.18, color=color, alpha=shade)
        for name in PROBLEMS:
            if published := problem_of(name).torm_length_rad:
                lengths.plot([published] * 2, PROBLEMS.index(name) + np.array([-0.4, 0.4]), color="black", lw=1)
        lengths.set(yticks=range(len(PROBLEMS)), yticklabels=PROBLEMS, xlabel="way, rad")
        memory.set(yticks=[], xlabel="peak memory, GB")
        for axis in (lengths, memory):
            axis.invert_yaxis()
        matches = [
            ("blue" if by == OURS else "orange", 1.0 if by == OURS else 1.0 - 0.25 * (len(kinds) - 1 - k), by)
            for k, by in enumerate(kinds)
        ]
        patches = [Patch(color=drawing.COLORS[color], alpha=alpha, label=by) for color, alpha, by in matches]
        drawing.legend_below(figure, patches, 3)


if __name__ == "__main__":
    from tests.sweep.redundancy import planned

    np.save(Path(sys.argv[2]) / "joints.npy", planned(problem_of(sys.argv[1])).joints)
