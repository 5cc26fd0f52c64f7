"""The page on files from strangers says the limits that the readers have."""

from __future__ import annotations

import re
from pathlib import Path

from models.arrays import LONGEST_NAME
from models.input_files import MOST_ELEMENTS
from models.robot import urdf
from models.shapes.triangles import MOST_BYTES, MOST_FACES
from ocp import storage
from ocp.files import entries, lines, mcap, trees
from ocp.problem import function_reader
from ocp.schedule import trajectory

ROOT = Path(__file__).parents[3]
MB = 2**20
LIMITS = {
    "URDF, SRDF": urdf.MOST_BYTES / MB,
    "elements and attributes of an XML document": MOST_ELEMENTS,
    "STL": MOST_BYTES["binary"] / MB,
    "OBJ, DAE, text of STL": MOST_BYTES["text"] / MB,
    "triangles of a mesh": MOST_FACES,
    "waypoints, trajectory (CSV, JSON, YAML), G-code": lines.LARGEST_FILE / MB,
    "lines of a text": lines.MOST_LINES,
    "characters of a line": lines.LONGEST_LINE,
    "sampled trajectory of a schedule (CSV)": trajectory.LARGEST_FILE / MB,
    "task and obstacle files": entries.LARGEST_TOML / MB,
    "parts of a name, containers within containers": trees.DEEPEST,
    "values of a JSON or YAML file": trees.MOST_VALUES,
    "MCAP, as it is and unpacked": mcap.LARGEST_LOG / MB,
    "a record or chunk of it, unpacked": mcap.LARGEST_RECORD / MB,
    "its messages of joints": mcap.MOST_OF_JOINTS / MB,
    "plan or solution, as it is and unpacked": storage.MOST_BYTES / MB,
    "elementary operations of its expressions": function_reader.MAX_OPERATIONS,
    "entries of the arguments and results of its functions": function_reader.MAX_ENTRIES,
    "operations of one evaluation, calls included": function_reader.MAX_WORK,
    "characters of a name of a link or joint": LONGEST_NAME,
}


def test_the_table_of_limits_is_that_of_the_code() -> None:
    page = (ROOT / "scripts/site/guide/security.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (.+?) \| (\d+)( MB)? \|$", page[page.index("## Limits") :], re.MULTILINE)
    assert {what: float(number) for what, number, _ in rows} == LIMITS
    assert mcap.LARGEST_LOG == mcap.MOST_UNPACKED


def test_the_example_of_a_cluster_is_open_to_nobody() -> None:
    for name in ("README.md", "scripts/site/tutorials/batch.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        assert not re.search(r"tcp://(?!127\.0\.0\.1)", text), name
        assert "dask scheduler --host 127.0.0.1" in text
        assert "TLS" in text
