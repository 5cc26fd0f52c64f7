"""The benchmark beside Descartes: what a process came to is told, and only valid ways are compared."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from scripts.timing import waypoints
from tests.redundancy_benchmark import PROBLEMS


def test_time_memory_and_end_of_a_process_are_reported() -> None:
    seconds, memory, message = waypoints.measured(
        [sys.executable, "-c", "x = bytearray(200_000_000); x[::4096] = b'1' * len(x[::4096]); print('well')"]
    )
    assert 0 < seconds < 10
    assert memory > 190
    assert message == "well"
    more = f"x = bytes({waypoints.MEMORY + 1} << 30)"
    assert waypoints.measured([sys.executable, "-c", more])[2] == f"more than {waypoints.MEMORY} GB"
    assert waypoints.measured([sys.executable, "-c", ""])[2] == "ended with 0"


def test_only_valid_motions_are_compared(tmp_path: Path) -> None:
    def row(by: str, rad: float, verdict: str) -> dict[str, Any]:
        by_name = {"problem": PROBLEMS[0], "by": by, "rad": rad, "m": 0.0, "published_rad": 9.0}
        return by_name | {"cpu_s": 1.0, "peak_mb": 100.0, "verdict": verdict}

    rows = [row(waypoints.OURS, 2.0, "valid"), row("Descartes, a", 3.0, "valid"), row("Descartes, b", 1.0, "touches")]
    numbers = {"rows": rows, "seconds": 1, "memory_gb": 1}
    assert "Descartes 1.5 times ours (Descartes, a)" in waypoints.report(numbers)
    numbers["rows"] = [rows[0], rows[2]]
    assert "none is valid" in waypoints.report(numbers)
    waypoints.plot(tmp_path / "plot.png", numbers)
    assert (tmp_path / "plot.png").stat().st_size > 1000
