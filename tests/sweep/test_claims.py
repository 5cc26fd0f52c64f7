"""Pages claim what the committed results say."""

from __future__ import annotations

import csv
import math
import re
from pathlib import Path

import numpy as np
import pytest

from scripts.papers.reproduced import read_tables
from tests.sweep.results import rows_of

ROOT = Path(__file__).resolve().parents[2]


def test_the_guide_to_goals_has_the_numbers_of_the_rows() -> None:
    rows = rows_of(ROOT / "results" / "sweeps" / "motion_bench_maker.jsonl").values()
    shortest = [row for row in rows if not row["kind"].endswith("time")]
    fastest = [row for row in rows if row["kind"].endswith("time")]
    assert not [row for row in rows if row["wrong"]]
    page = " ".join((ROOT / "docs" / "tutorials" / "goals.md").read_text(encoding="utf-8").split())
    claims = re.search(
        r"has (\d+) problems .* path length is ([\d.]+) rad\. The median processor time of a plan is ([\d.]+) s, the "
        r"longest (\d+) s .* For all (\d+) problems a motion was found; (\d+) motions last at most 0\.3 %",
        page,
    )
    assert claims is not None
    near = sum(row["cost"] <= 1.003 * row["bound"] for row in fastest)
    numbers = [len(shortest), round(float(np.mean([row["length"] for row in shortest])), 2)]
    numbers += [round(float(np.median([row["cpu"] for row in shortest])), 1)]
    numbers += [round(max(row["cpu"] for row in shortest)), len(fastest), near]
    assert [float(claim) for claim in claims.groups()] == numbers


def test_pages_have_the_number_of_reproduced_results() -> None:
    tables = read_tables(ROOT / "results").values()
    verdicts = [row["reproduced"] for rows in tables for row in rows]
    counts = [len(verdicts), verdicts.count("yes")]
    for name in ("README.md", "CHANGELOG.md", "docs/papers.md"):
        page = " ".join((ROOT / name).read_text(encoding="utf-8").split())
        claims = re.search(r"Of the (\d+) results that the papers print as numbers, (\d+) are reproduced", page)
        assert claims is not None, name
        assert [int(claim) for claim in claims.groups()] == counts, name
    claims = re.search(r"are reproduced\. (\d+) differ", page)
    assert claims is not None
    assert int(claims[1]) == verdicts.count("no")


CAPTION = "results/{}.caption.txt"


def words(name: str) -> str:
    """The text of a file with single spaces."""
    return " ".join((ROOT / name).read_text(encoding="utf-8").split())


def table(name: str) -> list[dict[str, str]]:
    with (ROOT / "results" / "benchmark" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def claimed(page: str, pattern: str) -> list[float]:
    """The numbers that the groups of a pattern find on a page."""
    match = re.search(pattern, words(page))
    assert match is not None, f"{page} does not say: {pattern}"
    return [float(group) for group in match.groups()]


def two_digits(value: float) -> float:
    return float(f"{value:.2g}")


def test_the_page_of_bounds_has_the_gaps_and_times_of_the_rows() -> None:
    rows = [row for row in rows_of(ROOT / "results" / "sweeps" / "global_plans.jsonl").values() if row["passed"]]
    for redundant, kinds in (("one", ["panda", "ur5"]), ("two", ["planar"])):
        own = [row for row in rows if row["kind"] in kinds]
        counts = [sum(row["kind"] == kind for row in own) for kind in kinds]
        gaps = [round(100 * (row["cost"] / row["bound"] - 1), 1) for row in own]
        times = [round(row["seconds"], 1) for row in own]
        tasks = " .*?".join([r"(\d+) of a"] * len(kinds))
        pattern = rf"\| {redundant} \| {tasks}[^|]*" + r"\| ([\d.]+) to ([\d.]+) % \| ([\d.]+) to ([\d.]+) s"
        assert claimed("docs/theory/bound.md", pattern) == [*counts, min(gaps), max(gaps), min(times), max(times)]
        largest = rf"exceeded the bound by .*?at most ([\d.]+) % with {redundant}"
        assert claimed("docs/tutorials/waypoints.md", largest) == [max(gaps)]
    excess = max(row["cost"] / row["best"] - 1 for row in rows if "best" in row)
    assert claimed("docs/theory/bound.md", r"cost over ([\d.]+) % more than the best") == [
        math.ceil(1e5 * excess) / 1e3
    ]


def test_the_page_of_waypoints_has_the_lengths_and_gaps_of_the_rows() -> None:
    rows = rows_of(ROOT / "results" / "sweeps" / "redundancy.jsonl").values()
    *close, largest = sorted(100 * ((row["rad"] + row["m"]) / row["bound"] - 1) for row in rows)
    pattern = r"exceeds the bound by at most ([\d.]+) %, and in `fetch square` .*? by ([\d.]+) %"
    assert claimed("docs/tutorials/waypoints.md", pattern) == [round(max(close), 1), round(largest, 1)]
    *usual, slowest = sorted(round(row["seconds"]) for row in rows)
    times = claimed("docs/tutorials/waypoints.md", r"takes (\d+) to (\d+) s of processor time, .*? (\d+) s")
    assert times == [usual[0], usual[-1], slowest]
    for row in rows:
        name = row["kind"].replace("__", " ")
        extra = r" and ([\d.]+) m" if row["m"] > 0.0 else ""
        *lengths, bound = claimed(
            "docs/tutorials/waypoints.md", rf"\| {name}[^|]*\|[^|]*\| ([\d.]+){extra} \| ([\d.]+)[^|]*\|"
        )
        numbers = [float(f"{value:.4g}") for value in (row["rad"], row["m"], row["bound"]) if value]
        assert [*lengths, bound] == numbers, name


@pytest.mark.parametrize(
    ("line", "tool"),
    [
        (r"`controller\.step`", "controller, Gauss-Newton"),
        (r"`controller\.step`, exact Hessian", "controller, exact"),
        (r"the same as the first in C, from `to_c`", "controller in C"),
        (r"`prepared\.solve`", "solve"),
        (r"fatrop, by `prepare\(solver=\"fatrop\"\)`", "fatrop"),
        ("acados, exact Hessian", "acados, exact"),
        ("acados, Gauss-Newton", "acados, Gauss-Newton"),
        (r"aligator, C\+\+", "aligator"),
    ],
)
def test_the_table_of_latencies_is_that_of_the_last_run(line: str, tool: str) -> None:
    rows = [row for row in table("controllers") if row["tool"] == tool]
    assert len(rows) == 4
    cells = r" \| ".join([r"([\d.]+) / ([\d.]+)(?: \(\d+ %\))?"] * len(rows))
    numbers = [two_digits(float(row[name])) for row in rows for name in ("median_ms", "worst_ms")]
    page = claimed("docs/tutorials/replanning.md", rf"\| {line} \| {cells} \|")
    assert [two_digits(value) for value in page] == numbers


def test_the_slowest_control_steps_are_those_of_the_last_long_run() -> None:
    worst = [two_digits(float(row["worst_ms"])) for row in table("controllers_long")]
    pattern = (
        r"cart-pole takes ([\d.]+) ms in Python and ([\d.]+) ms in C, that of the Panda ([\d.]+) ms and ([\d.]+) ms"
    )
    assert claimed("docs/tutorials/replanning.md", pattern) == worst


def test_the_time_of_all_distances_is_that_of_the_last_run() -> None:
    (row,) = [
        row
        for row in table("distances")
        if row["shapes"] == "arm" and row["function"].endswith("wrenches") and row["by"] == "interpreted"
    ]
    page = claimed("docs/tutorials/clearance.md", r"For (\d+) pairs of bodies.*? it takes about (\d+) μs")
    assert page == [float(row["pairs"]), float(f"{float(row['us']):.1g}")]


def test_the_times_of_schedules_are_those_of_the_last_run() -> None:
    rows = {(row["limits"], row["tool"].partition(",")[0]): row for row in table("schedules_peers")}
    median = {key: round(float(row["median_ms"])) for key, row in rows.items()}
    page = claimed("docs/coming_from.md", r"median time is (\d+) ms for `schedule` .*?, (\d+) ms for toppra")
    assert page == [median["acceleration", "selfmotion"], median["acceleration", "toppra"]]
    page = claimed("docs/coming_from.md", r"`schedule` takes (\d+) ms in the median and (\d+) ms at most")
    assert page == [median["jerk", "selfmotion"], round(float(rows["jerk", "selfmotion"]["worst_ms"]))]
    page = claimed("docs/coming_from.md", r"With torque limits, `schedule` takes (\d+) ms for a Panda")
    assert page == [median["torque", "selfmotion"]]


def test_the_figures_beside_toppra_and_copp_are_those_of_the_last_run() -> None:
    rows = {(row["limits"], row["tool"]): row for row in table("schedules_peers")}
    own, fine = rows["acceleration", "selfmotion"], rows["acceleration", "copp-py, 4001 points"]
    coarse = [rows["acceleration", f"{tool}, 1001 points"] for tool in ("toppra", "copp-py")]
    page = claimed("docs/coming_from.md", r"toppra \(1001 points\), and ([\d.]+) ms and ([\d.]+) ms for copp-py")
    assert page == [two_digits(float(row["median_ms"])) for row in (coarse[1], fine)]
    assert float(own["excess_worst"]) < 0.0  # all motions take no longer than those of copp-py on 4001 points
    page = claimed(
        "docs/coming_from.md",
        r"exceed limits by at most ([\d.]+) %. On 1001 points, .*? up to ([\d.]+) % longer .*? by up to ([\d.]+) %\.",
    )
    longer, usage = (
        max(float(row[name]) for row in coarse) for name in ("excess_over_shortest_worst", "largest_usage")
    )
    assert page == [
        round(100 * (float(own["largest_usage"]) - 1), 3),
        round(100 * longer, 1),
        round(100 * (usage - 1), 2),
    ]
    own, fine = rows["jerk", "selfmotion"], rows["jerk", "copp-py, 4001 points"]
    graded = rows["jerk", "copp-py, 1001 graded points"]
    page = claimed(
        "docs/coming_from.md",
        r"copp-py takes ([\d.]+) s and fails on (\d+) of the (\d+) paths. On the other (\d+), .*? ([\d.]+) % shorter "
        r"in the median, and at most ([\d.]+) % longer. .*? takes ([\d.]+) s and finds motions that are up to ([\d.]+) "
        r"% shorter .*? between its points by up to ([\d.]+) %",
    )
    failed, count = int(fine["failed"]), int(own["paths"])
    excess = [two_digits(100 * float(own[name])) for name in ("excess_median", "excess_worst")]
    times = [two_digits(float(row["median_ms"]) / 1e3) for row in (fine, graded)]
    shorter = round(100 * float(own["excess_over_shortest_worst"]), 2)
    usage = max(float(row["largest_usage"]) for row in (fine, graded))
    numbers = [times[0], failed, count, count - failed, -excess[0], excess[1], times[1], shorter]
    assert page == [*numbers, round(100 * (usage - 1), 1)]


def test_pages_repeat_the_captions_of_their_figures() -> None:
    claims = {  # page and pattern, caption and pattern
        (
            "docs/tutorials/satellite.md",
            r"is (\d+) deg/s by the pseudo-inverse and (\d+) deg/s in the optimal motion",
        ): ("free_floating/fig07_12_joint_velocity", r"(\d+) deg/s by the pseudo-inverse, (\d+) deg/s in the optimum"),
        ("docs/gallery/pick_and_place.md", r"joint 2 needs (\d+) % of its torque limit"): (
            "gallery/pick_and_place",
            r"joint 2 needs (\d+) % of its torque limit",
        ),
        ("docs/gallery/steps.md", r"a static walk takes (\d+) s, a dynamic one (\d+) s"): (
            "gallery/talos",
            r"TALOS needs (?=[\d.]+ s instead of ([\d.]+) s)([\d.]+) s",
        ),
    }
    for (page, pattern), (figure, caption) in claims.items():
        assert claimed(page, pattern) == claimed(CAPTION.format(figure), caption), page
    least, most = claimed(CAPTION.format("gallery/ur5"), r"([\d.]+) to ([\d.]+) by the pseudo-inverse from the 4")
    saved, more = claimed(
        CAPTION.format("gallery/ur5"),
        r"costs (\d+) % less than the pseudo-inverse.*costs ([\d.]+) % more than the plan",
    )
    shares = claimed(
        "docs/index.md", r"it costs ([\d.]+) times as much as the plan; .* it costs ([\d.]+) times as much"
    )
    assert shares == [round(1 / (1 - saved / 100), 1), round(most / least, 1)]
    assert more == 0.0


def test_the_page_of_clearance_has_the_times_of_the_rows() -> None:
    with (ROOT / "results" / "benchmark" / "clearance_peers.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    names = {"seven joints": "7 joints", "twelve joints": "two arms, 12 joints"}
    for row in rows:
        pattern = rf"\| {names[row['robot']]} \| (\d+) \| {row['degree']} \| ([\d.]+) s \| ([\d.]+) s \|"
        numbers = [float(row["pairs"]), round(float(row["ours_s"]), 2), round(float(row["squares_s"]), 1)]
        assert claimed("docs/tutorials/clearance.md", pattern) == numbers
        assert row["pairs"] == row["ours_pairs"] == row["squares_pairs"]
        assert float(row["ours_least_m"]) == float(row["squares_least_m"]) == 1e-6
    regions = [(int(row["iris_pairs"]), float(row["iris_s"])) for row in rows if row["iris_pairs"]]
    for count, spent in regions:
        assert claimed("docs/tutorials/clearance.md", rf"\| {count} pairs in (\d+) s \|") == [spent]
