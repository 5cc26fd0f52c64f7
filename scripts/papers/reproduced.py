"""Every number that the papers print of their results, beside ours, read from the summaries that the scripts write.

A number counts as reproduced if ours is within 1 % of it or within a unit of its last printed digit. Otherwise the row
gives the reason. Inputs that a paper prints and figures without numbers are not counted; of figures that show a motion
to its end, the time of that end is.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scripts.papers.blend.example import PAPER_GAMMA, PAPER_SPEED_ERROR, PAPER_TIMES
from scripts.papers.run import Row, Table, text_table, write

__all__ = ["READERS", "SHARE", "Printed", "committed", "read", "read_tables", "table", "text", "write_tables"]

SHARE = 0.01
"""Of a printed number, by which ours may differ."""
END = 6.283
"""2π s, at which the motions of the standing machine end."""


@dataclass(frozen=True)
class Printed:
    """A number of a paper and ours.

    Attributes:
        paper: Name of the paper's script.
        place: Table or figure.
        quantity: Description of the number, with its unit.
        printed, ours: The values.
        decimals: Number of decimals that the paper prints.
        why: Reason of the difference, reported if the number is not reproduced.
        timed: Whether ours is a measured duration, which differs from run to run.
    """

    paper: str
    place: str
    quantity: str
    printed: float
    ours: float
    decimals: int
    why: str = ""
    timed: bool = False

    @property
    def reproduced(self) -> bool:
        """Whether ours is within 1 % or a unit of the last printed digit."""
        return abs(self.ours - self.printed) <= max(SHARE * abs(self.printed), 10.0**-self.decimals)


def _free_floating(report: Mapping[str, Any]) -> Iterator[Printed]:
    printed, caveats = report["paper"], report["caveats"]
    ours = {"pseudo-inverse": report["pseudo_inverse"], "optimum": report["optimal"]}
    reasons = {
        "pseudo-inverse": "link length and mounting are not printed: links 2.1 mm longer explain the first peak",
        "optimum": "the horizon is not printed, ours is 5 s; no extremal found at other horizons has these peaks",
    }
    for method, why in reasons.items():
        key = "peak_joint_velocity_deg_s"
        pairs = zip(printed[key][method], ours[method][key], strict=True)
        for joint, (value, result) in enumerate(pairs, 1):
            quantity = f"{method}: peak velocity of joint {joint}, deg/s"
            yield Printed("free_floating", "Table 1", quantity, value, result, 3, why)
    for method, decimals in (("pseudo-inverse", 1), ("optimum", 4)):
        values = printed["joint_acceleration_at_peak_deg_s2"][method]
        pairs = zip(values, ours[method]["joint_acceleration_at_peak_deg_s2"], strict=True)
        why = caveats["accelerations"][method]
        for joint, (value, result) in enumerate(pairs, 1):
            quantity = f"{method}: acceleration of joint {joint} at that peak, deg/s²"
            yield Printed("free_floating", "Table 2", quantity, value, result, decimals, why)
    result = report["pseudo_inverse"]["min_manipulability_time_s"]
    yield Printed("free_floating", "Figure 13", "pseudo-inverse: least manipulability at, s", 3.0, result, 0)


def _standing(report: Mapping[str, Any]) -> Iterator[Printed]:
    why = (
        "prescribing the zero moment point by joint accelerations is unstable: {} at our time. With the sign of C as "
        "printed in equation (22), the motion of Figure 4 continues, but its stability index is not 1"
    )
    words = {"lift_off": "the machine lifts off", "divergence": "the joint rates diverge"}
    cases = {
        "Figure 4": ("table1", "augmented", "zero moment point"),
        "Figure 5": ("table1", "joint_limits", "zero moment point and joint limits"),
        "Figure 6": ("table1", "all_layers", "zero moment point, joint limits, manipulability"),
        "Figure 11": ("table2", "augmented_spring", "zero moment point against a spring"),
    }
    for place, (group, law, title) in cases.items():
        result = report[group][law]
        reason = why.format(words.get(result["reason"], result["reason"]))
        yield Printed("standing", place, f"{title}: stands until, s", END, result["reaches_s"], 3, reason)


def _blend(report: Mapping[str, Any]) -> Iterator[Printed]:
    columns = ("alpha 30 mm, 90 deg", "lambda 1, 90 deg", "lambda 1, 45 deg")
    for remaining, *result in report["gamma_table"]:
        for name, value, ours in zip(columns, PAPER_GAMMA[remaining], result, strict=True):
            yield Printed("blend", "Table 2", f"gamma, Lr {remaining} mm, {name}", value, ours, 3)
    why = (
        "no interpretation of the mean acceleration yields all four times, and the ramp before the first blend is not "
        "printed. The durations of both blends agree to 2.5 ms"
    )
    for number, (value, ours) in enumerate(zip(PAPER_TIMES, report["blend_times_s"], strict=True), 1):
        yield Printed("blend", "Figure 14", f"begin or end of a blend, {number} of 4, s", value, ours, 3, why)
    errors = report["speed_error_mm_s"]
    ours = errors["predictor_corrector_2ms"]
    yield Printed("blend", "Figure 18", "largest error of the line speed, mm/s", PAPER_SPEED_ERROR, ours, 1)


def _cts(report: Mapping[str, Any]) -> Iterator[Printed]:
    printed, ours = report["paper"]["table6_s"], report["arithmetic_seconds_of_200_targets"]
    why = "computing times of different computers; ours is that of the compiled arithmetic alone"
    for name, mine in (("jacobian", "jacobian, gain 20"), ("combined", "combined")):
        yield Printed("cts", "Table 6", f"200 targets, {name}, s", printed[name], ours[mine], 4, why, timed=True)
    why = (
        "the number of iterations depends on the link lengths and on the gain in the null space, which are not printed"
    )
    ratio = report["time_ratio_jacobian_over_combined"]
    quotient = printed["jacobian"] / printed["combined"]
    yield Printed("cts", "Table 6", "times of both, ratio", quotient, ratio, 2, why, timed=True)


READERS: Mapping[str, Callable[[Mapping[str, Any]], Iterator[Printed]]] = {
    "free_floating": _free_floating,
    "standing": _standing,
    "blend": _blend,
    "cts": _cts,
}


def read(out: Path, papers: Sequence[str] = tuple(READERS)) -> tuple[list[Printed], list[str]]:
    """The numbers of the papers whose summaries lie in `out`, and what is missing, in words."""
    results: list[Printed] = []
    missing = []
    for name in papers:
        if name not in READERS:
            continue
        file = out / name / "summary.json"
        try:
            results += READERS[name](json.loads(file.read_text(encoding="utf-8")))
        except OSError:
            missing.append(f"{name}: there is no {file}")
        except (ValueError, KeyError, TypeError) as error:
            missing.append(f"{name}: {file} is not what its script writes: {type(error).__name__} {error}")
    return results, missing


def table(result: Sequence[Printed]) -> list[Row]:
    """Rows of all numbers."""
    return [
        {
            "paper": one.paper,
            "place": one.place,
            "quantity": one.quantity,
            "printed": one.printed,
            "ours": one.ours,
            "difference": one.ours - one.printed,
            "reproduced": one.reproduced,
            "why": "" if one.reproduced else one.why,
        }
        for one in result
    ]


def text(result: Sequence[Printed], missing: Sequence[str]) -> str:
    """The table for the terminal: every number, the reasons below it once each, and how many are reproduced."""
    lines = []
    if result:
        rows = table(result)
        reasons = list(dict.fromkeys(row["why"] for row in rows if row["why"]))
        marks = {why: f"({number})" for number, why in enumerate(reasons, 1)}
        shown = [{**{k: v for k, v in row.items() if k != "why"}, "why": marks.get(row["why"], "")} for row in rows]
        lines += [text_table(shown, digits=5), ""]
        lines += [f"{mark} {why}" for why, mark in marks.items()]
    lines += [f"missing: {words}" for words in missing]
    count = sum(one.reproduced for one in result)
    lines.append(f"{count} of {len(result)} numbers of the papers are reproduced, to 1 % or a unit of their last digit")
    return "\n".join(lines)


def committed(numbers: Sequence[Printed]) -> list[dict[str, str]]:
    """Return the rows of a paper's table in the repository: rounded as the paper rounds, and without durations."""
    return [
        {
            "place": number.place,
            "quantity": number.quantity,
            "printed": f"{number.printed:.{number.decimals}f}",
            "ours": "" if number.timed else f"{round(number.ours, number.decimals) + 0.0:.{number.decimals}f}",
            "reproduced": "" if number.timed else "yes" if number.reproduced else "no",
            "why": "" if number.reproduced and not number.timed else number.why,
        }
        for number in numbers
    ]


def write_tables(out: Path, numbers: Sequence[Printed]) -> None:
    """Write the rows of each paper to `out`/PAPER/numbers.csv."""
    for paper in dict.fromkeys(number.paper for number in numbers):
        write(out / paper / "numbers.csv", Table(committed([n for n in numbers if n.paper == paper])))


def read_tables(out: Path) -> dict[str, list[dict[str, str]]]:
    """Return the rows of OUT/PAPER/numbers.csv by paper.

    Raises:
        OSError: A table is missing.
    """
    tables = {}
    for paper in READERS:
        with (out / paper / "numbers.csv").open(encoding="utf-8", newline="") as stream:
            tables[paper] = list(csv.DictReader(stream))
    return tables
