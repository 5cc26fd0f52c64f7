"""The run of a paper's script that its tests read: each script runs once a session."""

from __future__ import annotations

from typing import Any

import pytest

from tests.scripts.papers.script_run import Run, Summary, run_script


@pytest.fixture(scope="session")
def runs() -> dict[str, Run[Any]]:
    """By paper, as far as they have been asked for."""
    return {}


@pytest.fixture(scope="module")
def run(request: pytest.FixtureRequest, runs: dict[str, Run[Any]], tmp_path_factory: Any) -> Run[Any]:
    """The script of the module's PAPER, run into a temporary folder; on the module's SAMPLE of its cases, if any."""
    paper = request.module.PAPER
    if paper.name not in runs:
        runs[paper.name] = run_script(paper, tmp_path_factory.mktemp("results"), getattr(request.module, "SAMPLE", {}))
    return runs[paper.name]


@pytest.fixture(scope="module")
def summary(run: Run[Any]) -> Summary:
    return run.summary
