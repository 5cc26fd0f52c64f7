"""A batch of 500 whose workers and drivers are killed, on processes and on a cluster, and a disk that is full.

`make faults`. The tests do the same with fewer (`tests/ocp/app/batch`).
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from tests.ocp.app.batch.drivers import check_disturbed, check_full_disk, check_killed_cluster, cluster

NUMBER = 500


def main(number: int = NUMBER) -> int:
    """Run all; 0, or an AssertionError."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("processes", "cluster", "full"):
            (folder / part).mkdir()
        killed = check_disturbed(folder / "processes" / "b", number, 25)
        print(
            f"{number} tasks, {killed} workers and 2 drivers killed: none lost or done twice, results the same",
            flush=True,
        )
        with cluster(2) as (address, processes):
            check_killed_cluster(folder / "cluster" / "b", number, 0.1, address, processes)
        print(f"{number} tasks, a worker and the scheduler of a cluster killed: the same", flush=True)
        print(check_full_disk(folder / "full"))
    return 0


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
