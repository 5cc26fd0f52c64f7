"""Every invalid URDF description or argument is refused by name."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from models import ModelError, Robot, excluded_pairs, expand_xacro, named_states
from tests.bad_values import (
    CHOICE,
    INSTANCE,
    MAPPING,
    NAN,
    UNKNOWN,
    Case,
    array,
    assert_refused,
    but,
    good_calls,
    panel,
    rotation,
)

ORIGIN = '<origin xyz="0 0 1" rpy="0 0 0"/>'
LIMIT = '<limit lower="-1" upper="1" velocity="2" effort="3"/>'
MASS = '<mass value="1"/>'
INERTIA = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
SHAPE = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
URDF = f"""<robot name="arm">
<link name="base"/><link name="tool"><inertial>{ORIGIN}{MASS}{INERTIA}</inertial>{SHAPE}</link>
<joint name="turn" type="revolute"><parent link="base"/><child link="tool"/>{ORIGIN}<axis xyz="0 0 1"/>{LIMIT}</joint>
</robot>"""

SOURCE = {
    "None": None,
    "number": 3,
    "list": [URDF],
    "bytes": URDF.encode(),
    "object": object(),
    "no file": "nowhere.urdf",
    "folder": ".",
    "empty": "",
    "zero byte": "a\0b",
    "long name": "a" * 5000,
    "torn": URDF[:-9],
    "no robot": "<sdf/>",
    "no link": "<robot/>",
}
OPTIONS = Case(
    "from_urdf",
    Robot.from_urdf,
    {"source": URDF},
    {
        "source": SOURCE,
        "tip": but(UNKNOWN, "None"),
        "tip_translation": array(3),
        "tip_rotation": rotation(),
        "root": but(UNKNOWN, "None"),
        "lock": MAPPING
        | {"unknown": {"nobody": 0.0}, "digits": {"turn": "1"}, "nan": {"turn": NAN}, "none": {"turn": None}},
        "mimic": CHOICE,
        "inertia": CHOICE,
    },
)
STATES = Case(
    "named_states",
    named_states,
    {"srdf": "<robot/>", "robot": Robot.from_urdf(URDF)},
    {"srdf": {name: bad for name, bad in SOURCE.items() if name != "no link"}, "robot": INSTANCE},
)

MJCF = """<mujoco><worldbody><body name="tool"><joint name="turn"/><geom size="1"/></body></worldbody>
<contact><exclude body1="world" body2="tool"/></contact></mujoco>"""
MJCF_SOURCE = {name: bad for name, bad in SOURCE.items() if name != "no link"} | {"list": [MJCF], "URDF": URDF}
MUJOCO = [
    Case(
        "from_mjcf",
        Robot.from_mjcf,
        {"source": MJCF},
        {**{key: bad for key, bad in OPTIONS.bad.items() if key != "inertia"}, "source": MJCF_SOURCE},
    ),
    Case("excluded_pairs", excluded_pairs, {"source": MJCF}, {"source": MJCF_SOURCE}),
]


def expanded(**options: Any) -> str:
    with TemporaryDirectory() as folder:
        (Path(folder) / "arm.xacro").write_text(URDF)
        return expand_xacro(**{"file": Path(folder) / "arm.xacro", **options})


XACRO = Case("expand_xacro", expanded, {}, {"file": {k: v for k, v in SOURCE.items() if k != "no link"}})
TEXTS = {
    "two limits": (LIMIT, LIMIT * 2),
    "two origins": (ORIGIN, ORIGIN * 2),
    "two masses": (MASS, MASS * 2),
    "two inertias": (INERTIA, INERTIA * 2),
    "two axes": ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/>' * 2),
    "two parents": ('<parent link="base"/>', '<parent link="base"/>' * 2),
    "mass of a word": (MASS, '<mass value="a"/>'),
    "mass of two": (MASS, '<mass value="1 2"/>'),
    "mass negative": (MASS, '<mass value="-1"/>'),
    "mass of nan": (MASS, '<mass value="nan"/>'),
    "mass of underscores": (MASS, '<mass value="1_0"/>'),
    "mass without value": (MASS, "<mass/>"),
    "mass misspelt": (MASS, '<mass valu="1"/>'),
    "no mass": (MASS, ""),
    "no inertia": (INERTIA, ""),
    "origin of two": (ORIGIN, '<origin xyz="0 0"/>'),
    "origin of inf": (ORIGIN, '<origin xyz="0 0 inf"/>'),
    "origin of commas": (ORIGIN, '<origin xyz="0,0,1"/>'),
    "xacro": (ORIGIN, '<origin xyz="${x} 0 0"/>'),
    "zero axis": ('xyz="0 0 1"/><limit', 'xyz="0 0 0"/><limit'),
    "limits crossed": ('lower="-1"', 'lower="2"'),
    "limit of a word": ('lower="-1"', 'lower="a"'),
    "speed negative": ('velocity="2"', 'velocity="-2"'),
    "unknown kind": ('type="revolute"', 'type="ball"'),
    "no kind": ('type="revolute"', ""),
    "unknown parent": ('parent link="base"', 'parent link="nobody"'),
    "child without link": ('<child link="tool"/>', "<child/>"),
    "no child": ('<child link="tool"/>', ""),
    "link without name": ('<link name="base"/>', "<link/>"),
    "link twice": ('<link name="base"/>', '<link name="base"/><link name="base"/>'),
    "nobody followed": (LIMIT, LIMIT + '<mimic joint="nobody"/>'),
    "follows itself": (LIMIT, LIMIT + '<mimic joint="turn"/>'),
    "unknown shape": ('<box size="1 1 1"/>', '<cone size="1 1 1"/>'),
    "shape without size": ('<box size="1 1 1"/>', "<box/>"),
    "shape misspelt": ('<box size="1 1 1"/>', '<box siize="2 2 2"/>'),
    "no shape": ('<box size="1 1 1"/>', ""),
    "box of zero and less": ('<box size="1 1 1"/>', '<box size="0 -1 1"/>'),
    "ball of nan": ('<box size="1 1 1"/>', '<sphere radius="nan"/>'),
    "cylinder of zero and nan": ('<box size="1 1 1"/>', '<cylinder radius="0" length="nan"/>'),
    "mesh without file": ('<box size="1 1 1"/>', '<mesh scale="0 0 0"/>'),
}


@pytest.mark.parametrize("case", good_calls([OPTIONS, STATES, XACRO, *MUJOCO]))
def test_valid_values_are_accepted(case: Case) -> None:
    case.call(**case.good)


@pytest.mark.parametrize(("case", "argument"), panel([OPTIONS, STATES, XACRO, *MUJOCO]))
def test_bad_options_are_refused_by_name(case: Case, argument: str) -> None:
    assert_refused(case, argument)


@pytest.mark.parametrize(("part", "bad"), TEXTS.values(), ids=list(TEXTS))
def test_bad_files_are_refused_by_name(part: str, bad: str) -> None:
    assert part in URDF
    with pytest.raises(ModelError) as caught:
        Robot.from_urdf(URDF.replace(part, bad))
    assert caught.value.name


def test_a_file_that_is_no_text_is_refused_by_name(tmp_path: Any) -> None:
    file = tmp_path / "arm.urdf"
    file.write_bytes(b"\x00\xff\xfe\x80<robot/>")
    with pytest.raises(ModelError) as caught:
        Robot.from_urdf(file)
    assert caught.value.name


@pytest.mark.parametrize("file", [3, [], object(), b"arm.urdf", True])
def test_a_place_to_write_to_is_a_path(file: Any) -> None:
    with pytest.raises(ModelError) as caught:
        Robot.from_urdf(URDF).to_urdf(file)
    assert caught.value.name == "file"
