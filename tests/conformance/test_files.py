"""Plans of reference problems are audited after a file as before it: the same verdict, the same numbers."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ocp import Audit, Solution

from .case import Case
from .cases import CASES
from .test_conformance import RUNS, solved

FIRST = {case.name: run for case, run in reversed(RUNS)}
AUDIT = """
import json, sys
from ocp import Solution
audits = {path: Solution.load(path).audit() for path in sys.argv[1:]}
print(json.dumps({path: [a.passed, [[f.name, f.value, f.limit] for f in a.findings]] for path, a in audits.items()}))
"""


def compare(audit: Audit, passed: bool, findings: list[tuple[str, float, float | None]]) -> None:
    assert audit.passed == passed
    own = [(f.name, f.value, f.limit) for f in audit.findings]
    assert [name for name, *_ in own] == [name for name, *_ in findings]
    values = [np.array([row[1:] for row in rows], dtype=float) for rows in (own, findings)]
    np.testing.assert_allclose(values[1], values[0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    "case", [pytest.param(c, id=c.name, marks=pytest.mark.xdist_group(f"{c.name}: {FIRST[c.name]}")) for c in CASES]
)
def test_a_plan_is_audited_to_the_same_numbers_after_it_was_a_file(case: Case, tmp_path: Path) -> None:
    plan = solved(case, FIRST[case.name])
    plan.save(tmp_path / "plan.npz")
    again = Solution.load(tmp_path / "plan.npz")
    compare(plan.audit(), again.audit().passed, [(f.name, f.value, f.limit) for f in again.audit().findings])
    again.save(tmp_path / "again.npz")
    assert str(Solution.load(tmp_path / "again.npz").audit()) == str(again.audit()), (
        "what was read is written as it was"
    )


@pytest.mark.long
def test_all_plans_are_audited_to_the_same_numbers_in_another_process(tmp_path: Path) -> None:
    plans = {}
    for number, (case, run) in enumerate(RUNS):
        path = tmp_path / f"{number}.npz"
        plans[str(path)] = solved(case, run)
        plans[str(path)].save(path)
    done = subprocess.run([sys.executable, "-c", AUDIT, *plans], capture_output=True, text=True, check=True)
    for path, (passed, findings) in json.loads(done.stdout).items():
        compare(plans[path].audit(), passed, findings)
