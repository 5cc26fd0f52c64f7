"""The page on files from strangers says the limits that the readers have."""

from __future__ import annotations

import re
from pathlib import Path

from models.files import INPUT_LIMITS
from ocp import storage
from ocp.motion.schedule import trajectory
from ocp.problem import record_reader

ROOT = Path(__file__).parents[2]
MB = 2**20
LIMITS = {
    "URDF, SRDF, MJCF": INPUT_LIMITS.description_bytes / MB,
    "elements and attributes of an XML document": INPUT_LIMITS.xml_elements,
    "STL": INPUT_LIMITS.mesh_bytes / MB,
    "OBJ, DAE, text of STL": INPUT_LIMITS.mesh_text_bytes / MB,
    "triangles of a mesh": INPUT_LIMITS.mesh_triangles,
    "bodies, joints, geoms and sites of an MJCF file": INPUT_LIMITS.scene_nodes,
    "waypoints, trajectory (CSV, JSON, YAML), robot program, G-code": INPUT_LIMITS.text_bytes / MB,
    "lines of a text": INPUT_LIMITS.text_lines,
    "characters of a line": INPUT_LIMITS.line_characters,
    "sampled trajectory of a schedule (CSV)": trajectory.MAX_FILE_BYTES / MB,
    "task and obstacle files": INPUT_LIMITS.task_bytes / MB,
    "parts of a dotted name, nested containers": INPUT_LIMITS.nesting,
    "values of a JSON or YAML file": INPUT_LIMITS.tree_values,
    "MCAP, as it is and unpacked": INPUT_LIMITS.log_bytes / MB,
    "a record or chunk of an MCAP file, unpacked": INPUT_LIMITS.log_record_bytes / MB,
    "messages with joints in an MCAP file": INPUT_LIMITS.log_message_bytes / MB,
    "plan or solution, as it is and unpacked": storage.MAX_FILE_BYTES / MB,
    "elementary operations of the expressions in a plan": record_reader.MAX_OPERATIONS,
    "entries of the arguments and results of functions in a plan": record_reader.MAX_ENTRIES,
    "operations of one evaluation of a function, calls included": record_reader.MAX_WORK,
    "characters of a name of a link or joint": INPUT_LIMITS.name_characters,
}


def test_the_table_of_limits_is_that_of_the_code() -> None:
    page = (ROOT / "docs/guide/security.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (.+?) \| (\d+)( MB)? \|$", page[page.index("## Limits") :], re.MULTILINE)
    assert {what: float(number) for what, number, _ in rows} == LIMITS


def test_the_example_of_a_cluster_is_open_to_nobody() -> None:
    for name in ("README.md", "docs/tutorials/batch.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        assert not re.search(r"tcp://(?!127\.0\.0\.1)", text), name
        assert "dask scheduler --host 127.0.0.1" in text
        assert "TLS" in text
