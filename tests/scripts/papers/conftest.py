"""Runs that several test modules read: each script runs once a session."""

from __future__ import annotations

import pytest

from scripts import free_floating
from scripts.papers.free_floating import results as free_floating_results
from scripts.papers.free_floating.results import Results
from tests.scripts.papers.free_floating_run import Run


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The free-floating script, run into a temporary folder."""
    out = tmp_path_factory.mktemp("results")
    computed: list[Results] = []

    def compute() -> Results:
        computed.append(free_floating_results.compute())
        return computed[-1]

    with pytest.MonkeyPatch.context() as patch, pytest.MonkeyPatch.context() as printing:
        lines: list[str] = []
        patch.setattr(free_floating, "compute", compute)
        printing.setattr("builtins.print", lambda *parts, **_: lines.append(" ".join(map(str, parts))))
        status = free_floating.main(["--out", str(out)])
    return Run(out / "free_floating", "\n".join(lines), status, computed[0])
