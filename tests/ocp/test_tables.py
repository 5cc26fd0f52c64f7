"""No cell that is written as CSV is a formula to a spreadsheet."""

from __future__ import annotations

import ast
import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocp.motion.schedule import JointTrajectory
from ocp.storage import cell, column_name, joint_name

ROOT = Path(__file__).parents[2]
SIGNS = "=+-@\t\r"
FORMULAS = st.builds(str.__add__, st.sampled_from(SIGNS), st.text(st.characters(codec="utf-8")))


@given(FORMULAS)
def test_a_cell_never_begins_a_formula(text: str) -> None:
    assert cell(text)[0] == "%"
    assert column_name(text)[0] == "%"
    assert joint_name(cell(text)[:3]) + text[1:] == text


@given(st.one_of(st.integers(), st.floats(), st.none(), st.booleans()))
def test_numbers_stay_numbers(value: object) -> None:
    assert cell(value) is value


@pytest.mark.parametrize("name", ["=1+1", "+a", "-a", "@SUM(A1)", "%3D"])
def test_a_trajectory_is_a_table_without_formulas(name: str, tmp_path: Path) -> None:
    values = np.array([[0.0], [-1.0]])
    JointTrajectory((name,), np.array([0.0, 1.0]), values, values, values).write_csv(tmp_path / "a.csv")
    with open(tmp_path / "a.csv", newline="") as stream:
        head, *rows = csv.reader(stream)
    assert all(text[0] not in SIGNS for text in head)
    assert [[float(text) for text in row] for row in rows] == [[0.0] * 4, [1.0, -1.0, -1.0, -1.0]]
    assert JointTrajectory.read_csv(tmp_path / "a.csv").names == (name,)


@pytest.mark.long
def test_every_writer_of_tables_names_its_columns_here() -> None:
    """A module with a method `write_csv`, or that uses a writer of csv or numpy, takes names or cells from here."""
    writers = []
    for file in sorted([*ROOT.glob("ocp/**/*.py"), *ROOT.glob("models/**/*.py")]):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        calls = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        methods = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        if calls & {"writerow", "writerows", "DictWriter", "savetxt"} or "write_csv" in methods:
            taken = [
                node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module == "ocp.storage"
            ]
            assert {name.name for node in taken for name in node.names} & {"cell", "column_name", "table_head"}, file
            writers.append(file.name)
    assert len(writers) > 2
