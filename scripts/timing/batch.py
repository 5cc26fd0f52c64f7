"""Many plans: two workers beside one, a Dask cluster beside one, and what 10 000 tasks cost that do nothing.

Two cores that share their units, or that others use too, give no two processes twice the work of one: so the same plans
are also made by plain processes that know of no batch, one and two of them, and gains are told as shares of theirs.
"""

from __future__ import annotations

import importlib.util
import tempfile
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from ocp.app.batch import Batch, run_batch
from scripts import drawing
from scripts.papers.run import progress, text_table
from scripts.timing.measure import against, timed
from scripts.timing.placing import nothing, placed

PLANS = 64
SHORT = 10_000
CUT = 1000
"""Of the short tasks, the first and the last, whose pace is compared."""
GOALS = {
    "two workers": (1.8, "times one"),
    "Dask, two workers": (1.6, "times one"),
    "two workers, share": (0.9, "of the gain of two plain processes, at least"),
    "Dask, two workers, share": (0.8, "of the gain of two plain processes, at least"),
    "overhead": (5.0, "ms at most"),
}
PLAIN = {1: "one plain process", 2: "two plain processes"}


def places(count: int) -> list[dict[str, float]]:
    """Places of the part on a square grid, m."""
    side = int(np.ceil(np.sqrt(count)))
    grid = [(x, y) for x in np.linspace(0.48, 0.62, side) for y in np.linspace(-0.2, 0.0, side)]
    return [{"x": float(x), "y": float(y)} for x, y in grid[:count]]


def plans(workers: int | str, count: int, folder: Path) -> tuple[Batch, float]:
    """Plans by so many workers, or by a cluster at an address, and the wall time, s."""
    return timed(lambda: run_batch(placed, places(count), folder / str(len(list(folder.iterdir()))), cluster=workers))


def each(tasks: list[dict[str, float]]) -> None:
    """Plans one after the other, which nobody keeps."""
    for task in tasks:
        placed(task)


def plain(processes: int, count: int) -> float:
    """Wall time of the same plans by so many processes that share them evenly, their starts included, s."""
    tasks = places(count)
    own = [get_context("spawn").Process(target=each, args=(tasks[k::processes],)) for k in range(processes)]

    def work() -> None:
        for process in own:
            process.start()
        for process in own:
            process.join()
            if process.exitcode:
                raise RuntimeError(f"a plain process ended with {process.exitcode}")

    return timed(work)[1]


def measure_methods(count: int, folder: Path) -> dict[str, tuple[Batch, float]]:
    """The same plans by one worker, by two, and by a Dask cluster of two where Dask is installed."""
    by_name = {"one worker": plans(1, count, folder), "two workers": plans(2, count, folder)}
    if importlib.util.find_spec("distributed") is not None:
        from distributed import LocalCluster

        with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
            by_name["Dask, two workers"] = plans(cluster.scheduler_address, count, folder)
    return by_name


def pace(folder: Path) -> list[float]:
    """When the records of a folder were written, s, the first at 0."""
    times = np.sort([file.stat().st_mtime_ns for file in folder.glob("results/*/*.json")])
    return [float(time) for time in (times - times[0]) * 1e-9]


def run(repeats: int = 5) -> dict[str, Any]:
    """Least time of each way, of as many runs as `repeats` but two at most, and the pace of short tasks."""
    runs, alone = [], []
    with tempfile.TemporaryDirectory() as name:
        for _ in progress(range(max(1, min(repeats, 2))), "plans"):
            runs.append(measure_methods(PLANS, Path(name)))
            alone.append({path: plain(processes, PLANS) for processes, path in PLAIN.items()})
        short = Path(name) / "short"
        run_batch(nothing, [{"x": float(i)} for i in range(SHORT)], short, cluster=1)
        written = pace(short)
    least = {path: min(run[path][1] for run in runs) for path in runs[0]}
    bare = {path: min(times[path] for times in alone) for path in PLAIN.values()}
    options = bare[PLAIN[1]] / bare[PLAIN[2]]
    costs = {path: [result.cost for result in batch] for path, (batch, _) in runs[0].items()}
    rows = [
        {
            "way": path,
            "plans": PLANS,
            "passed": sum(result.verdict is True for result in runs[0][path][0]),
            "seconds": seconds,
            "times_one_worker": least["one worker"] / seconds,
            "busy_workers": sum(result.seconds for result in runs[0][path][0]) / runs[0][path][1],
            "same_costs": costs[path] == costs["one worker"],
        }
        for path, seconds in least.items()
    ]
    first, last = written[CUT - 1] - written[0], written[-1] - written[-CUT]
    steps = {"first": first / (CUT - 1) * 1e3, "last": last / (CUT - 1) * 1e3}
    gains = {path: least["one worker"] / seconds for path, seconds in least.items()}
    shares = {f"{path}, share": gain / options for path, gain in gains.items()}
    figures = gains | shares | {"overhead": written[-1] / (len(written) - 1) * 1e3}
    goals = {name: {"figure": figures.get(name), "goal": goal, "unit": unit} for name, (goal, unit) in GOALS.items()}
    times = [{"record": i, "seconds": written[i]} for i in range(0, len(written), max(1, len(written) // 200))]
    return {"rows": rows, "plain": {**bare, "gain": options}, "short": times, "ms_a_short_task": steps, "goals": goals}


def report(numbers: dict[str, Any]) -> str:
    """The times in words."""
    steps = numbers["ms_a_short_task"]
    words = (
        f"of {SHORT} short tasks one takes {steps['first']:.3g} ms at the beginning, {steps['last']:.3g} ms at the end"
    )
    plain = f"two plain processes make the same plans {numbers['plain']['gain']:.3g} times as fast as one"
    return "\n".join([text_table(numbers["rows"], 4), plain, words, against(numbers["goals"], "goal")])


def plot(path: Path, numbers: dict[str, Any]) -> None:
    """Times of the ways, and records over time."""
    note = f"{PLANS} plans of a UR5's seam, starts of workers included; short tasks by one worker. One machine."
    with drawing.sheet(path, (1, 2), (7.0, 2.8), note) as (_, axes):
        paths, records = np.ravel(axes)
        names = [row["way"] for row in numbers["rows"]]
        paths.barh(names, [row["seconds"] for row in numbers["rows"]], 0.5, color=drawing.COLORS["blue"])
        paths.invert_yaxis()
        paths.set(xlabel="time, s")
        times = numbers["short"]
        records.plot([row["seconds"] for row in times], [row["record"] for row in times], color=drawing.COLORS["green"])
        records.set(xlabel="time, s", ylabel="results kept")
