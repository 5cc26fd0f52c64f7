"""All problems of the public suites, solved, audited, confirmed and timed: the table of results/suite.

python -m tests.conformance.suite --out results/suite [--only NAME] [--minutes 60] [--again] [--automatic]

A row is added to OUT/suite.csv as soon as its problem is done; a problem that is there is not done again, except, with
--again, where it was done by other code. With --automatic only the solves without a method are done.
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path

from tests.sweep.results import code_of

from .entry import Entry
from .library import entries
from .run import Row, automatic, done, warm_up

TABLE = "suite.csv"
COLUMNS = (
    "name", "suites", "verdict", "cost", "published", "exact", "digits", "second", "second_start", "feasible",
    "optimal", "reason", "method", "intervals", "first_cost", "seconds", "refined_seconds", "rockit_seconds",
    "rockit_cost", "psopt_seconds", "failed", "automatic", "automatic_start", "automatic_cost", "automatic_seconds",
    "automatic_intervals", "automatic_failed", "automatic_code", "code",
)  # fmt: skip
AUTOMATIC = [name for name in COLUMNS if name.startswith("automatic")]
PSOPT_SECONDS = {
    "bioreactor": 29.1, "brac1": 1.2, "breakwell": 44.1, "bryson_denham": 1.2, "bryson_max_range": 0.3, "catmix": 0.8,
    "chain": 1.3, "chance_constraint": 0.7, "chance_covariance": 4.6, "climb": 16.8, "conic_sdp": 0.4, "conic_soc": 0.6,
    "control_rate": 1.9, "coulomb": 1.2, "cracking": 0.8, "dae_i3": 1.6, "delay1": 102.1, "f8": 1.9, "geodesic": 1.3,
    "glider": 2.7, "goddard": 1.3, "heat": 1.3, "hypersensitive": 0.6, "interior_point": 0.3, "isoperimetric": 0.6,
    "lambert": 0.9, "launch": 5.2, "lotka": 26.3, "lotka2": 33.3, "low_thrust": 43.5, "lqr_gauss": 0.2, "lts": 0.4,
    "manutec": 1.7, "mineng_di": 0.4, "mineng_free_vf": 0.6, "mineng_target_set": 0.6, "missile": 1.1, "mpec": 1.2,
    "obstacle": 6.8, "path_window": 34.1, "rayleigh": 0.6, "reorientation": 20.5, "shuttle_reentry": 4.5,
    "singular5": 8.6, "singular_di": 0.8, "stc1": 0.8, "steps": 0.2, "twoburn": 11.6, "twolinkarm": 1.0,
    "twophase_robot": 0.5, "twophase_schwartz": 0.4,
}  # fmt: skip
"""s, by IPOPT on two cores, as PSOPT publishes them (github.com/PSOPT/psopt, doc/SQP_ALL_EXAMPLES.csv)."""


def rows_of(folder: Path) -> dict[str, Row]:
    """The rows of the table in a folder by the name of their problem, as text."""
    file = folder / TABLE
    if not file.exists():
        return {}
    with file.open(newline="") as read:
        return {row["name"]: row for row in csv.DictReader(read)}


def write(folder: Path, rows: dict[str, Row]) -> None:
    """Write all rows at once, in the order of names."""
    folder.mkdir(parents=True, exist_ok=True)
    part = folder / "suite.part"
    with part.open("w", newline="") as written:
        writer = csv.DictWriter(written, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: rows[name].get(key, "") for key in COLUMNS} for name in sorted(rows))
    part.replace(folder / TABLE)


def row_of(entry: Entry) -> Row:
    """The row of a problem, done now."""
    row = done(entry)
    row["first_cost"] = row.get("cost", "")
    row["cost"] = row.get("refined_cost", row.get("cost", ""))
    row["rockit_cost"] = row.get("rockit_cost", row.get("rockit_failed", ""))
    row["failed"] = row.get("failed", "") or row.get("second_failed", "")
    row |= {
        "name": entry.name,
        "suites": "; ".join(entry.suites),
        "published": next(iter(entry.published.values()), ""),
        "exact": "" if entry.exact is None else entry.exact,
        "psopt_seconds": PSOPT_SECONDS.get(entry.name, ""),
    }
    return printed(row)


def automatic_row_of(entry: Entry, row: Row) -> Row:
    """The columns of a row about the solve without a method, done now."""
    return printed({**dict.fromkeys(AUTOMATIC, ""), **automatic(entry, float(row.get("cost") or "nan"))})


def printed(row: Row) -> Row:
    """A row with its numbers as text."""
    short = {key for key in row if key.endswith("seconds") or key == "digits"}
    return {
        key: f"{value:{'.3g' if key in short else '.10g'}}" if isinstance(value, float) else value
        for key, value in row.items()
    }


def main() -> None:
    known = entries()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the table")
    parser.add_argument("--only", choices=list(known), action="append", metavar="NAME")
    parser.add_argument("--minutes", type=float, default=90.0, help="after which no further problem is begun")
    parser.add_argument("--again", action="store_true", help="those whose rows are of other code once more")
    parser.add_argument("--automatic", action="store_true", help="only the solves without a method")
    options = parser.parse_args()
    warm_up(known)
    code, rows, end = code_of(Path(__file__)), rows_of(options.out), time.time() + 60 * options.minutes
    parts = [("automatic_code", automatic_row_of)]
    if not options.automatic:
        parts.insert(0, ("code", lambda entry, row: row_of(entry)))
    for name in options.only or known:
        for column, work in parts:
            row = rows.get(name, {})
            old = not row.get(column) or (row[column] != code and (options.again or options.only))
            if old and time.time() < end:
                done_now = {"name": name} | work(known[name], row) | {column: code}
                rows[name] = row | done_now
                write(options.out, rows)
                print({key: value for key, value in done_now.items() if value != ""}, flush=True)


if __name__ == "__main__":
    main()
