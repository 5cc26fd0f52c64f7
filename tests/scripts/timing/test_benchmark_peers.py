"""What is compared with peers is the same problem, and the README's table is that of the last run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from PIL import Image

from ocp import Collocation, prepare
from scripts import benchmark
from scripts.robots.panda import HOME
from scripts.timing import arms, optimal_control, tools
from scripts.timing.statements import STATEMENTS

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize("name", ["brachistochrone", "van der Pol", "Goddard", "cart-pole", "paper's arm"])
def test_the_formulas_for_peers_hold_along_our_plan(name: str) -> None:
    statement = STATEMENTS[name]()
    method = Collocation(10, 5, control="held" if statement.held else "points")
    plan = prepare(statement.problem, method, compiled=False).solve({"p": statement.p})
    formulas, h = statement.formulas, 1e-5
    for fraction in (0.23, 0.57, 0.81):  # inside intervals
        s = fraction + np.array([-h, 0.0, h])
        x, u = plan.state_interpolant(s), plan.control_interpolant(s)
        slope = (x[2] - x[0]) / (2 * h * plan.horizon)
        at = (x[1], u[1], fraction * plan.horizon, plan.horizon, statement.p)
        size = 1 + np.abs(slope).max()
        assert formulas["rates"](*at).full().ravel() == pytest.approx(slope, abs=1e-2 * size)
        assert np.abs(formulas["equal"](*at).full()).max(initial=0.0) < 1e-2
    for kind, at_end in (("initial", 0.0), ("terminal", 1.0)):
        lower, upper = statement.bounds(kind)
        fixed = lower == upper
        assert plan.state_interpolant(np.array([at_end]))[0][fixed] == pytest.approx(lower[fixed], abs=1e-8)
    x = plan.state_interpolant(np.array([1.0]))[0]
    assert float(formulas["terminal"](x, plan.horizon)) == pytest.approx(
        plan.cost if name in ("brachistochrone", "Goddard") else 0.0, abs=1e-9
    )


def test_a_tool_is_measured_against_the_known_optimum() -> None:
    row = tools.measured("selfmotion", STATEMENTS["van der Pol"](), 10)
    assert row["error"] < 1e-8
    assert row["cost_then"] > row["cost"]  # more damping is dearer
    assert min(row["cold_s"], row["warm_s"]) > 0


def test_the_formulas_for_dymos_are_the_same() -> None:
    """Bounds as one row each, inside -1 .. 1; the cost as it adds up."""
    statement = STATEMENTS["brachistochrone"]()
    along = tools._along(statement)
    result = along.call({"x": [1.0, 2.0, 3.0], "u": np.pi / 4, "t": 0.5, "c": 0.25, "p": 9.8})
    assert float(result["inside"]) == pytest.approx(-0.5)
    assert float(result["total"]) == pytest.approx(0.75)
    assert result["rates"].full().ravel() == pytest.approx([3 * 0.5**0.5, 3 * 0.5**0.5, 9.8 * 0.5**0.5])


def test_the_first_accurate_mesh_is_reported_and_failures_are_blank() -> None:
    def row(tool: str, intervals: int, error: float | None) -> dict[str, Any]:
        return {"problem": "p", "tool": tool, "intervals": intervals, "error": error, "cold_s": 0.012, "warm_s": 0.0034}

    rows = [
        row("a", 20, 1e-9),
        row("a", 10, 1e-7),
        row("a", 5, 1e-3),
        row("b", 5, 2e-4),
        row("b", 10, 1e-5),
        row("c", 0, None),
    ]
    first = optimal_control.first_within(rows)
    assert [(one["tool"], one["intervals"], one["reached"]) for one in first] == [
        ("a", 10, True),
        ("b", 10, False),
        ("c", 0, False),
    ]
    table = optimal_control.readme_table(first)
    assert table.splitlines()[-1] == "| p | 12 / 3.4 | 12 / 3.4 (1e-5) | - |"


def test_the_readme_has_the_table_of_the_last_run(tmp_path: Path) -> None:
    first = json.loads((ROOT / "results/benchmark/optimal_control.json").read_text(encoding="utf-8"))["first"]
    readme = ROOT / "README.md"
    assert optimal_control.readme_table(first) in readme.read_text(encoding="utf-8")
    copy = tmp_path / "README.md"
    copy.write_text(readme.read_text(encoding="utf-8"), encoding="utf-8")
    optimal_control.write_readme(copy, first)
    assert copy.read_text(encoding="utf-8") == readme.read_text(encoding="utf-8")


def test_a_peer_that_is_not_installed_is_left_out_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimal_control, "installed", lambda _: "not installed")
    monkeypatch.setattr(optimal_control, "STATEMENTS", ["van der Pol"])
    request: list[str] = []

    def rows_of(tool: str, *_: Any) -> list[Any]:
        request.append(tool)
        return []

    monkeypatch.setattr(optimal_control, "rows_of", rows_of)
    numbers = optimal_control.run()
    assert request == ["selfmotion"]
    assert numbers["versions"] == {"rockit": "not installed", "Dymos": "not installed", "Drake": "not installed"}
    assert "rockit: not installed" in optimal_control.report({**numbers, "rows": [], "first": [{"tool": "-"}]})


@pytest.mark.long
def test_pages_are_drawn(tmp_path: Path) -> None:
    for module, name in ((optimal_control, "optimal_control"), (arms, "arms")):
        numbers = json.loads((ROOT / f"results/benchmark/{name}.json").read_text(encoding="utf-8"))
        module.plot(tmp_path / f"{name}.png", numbers)
        with Image.open(tmp_path / f"{name}.png") as picture:
            assert picture.size[0] > 500
        assert name in benchmark.PARTS


def test_the_pose_error_of_a_configuration_is_its_distance_and_angle() -> None:
    place, axes = arms.tip_function()(ca.DM(HOME))
    turn = np.array([[np.cos(0.01), -np.sin(0.01), 0], [np.sin(0.01), np.cos(0.01), 0], [0, 0, 1]])
    result = arms.pose_error(
        np.array([HOME]), place.full().T + np.array([0.0, 0.003, 0.004]), (axes.full() @ turn)[None]
    )
    assert result == pytest.approx((0.005, 0.01), rel=1e-6)
