"""Waypoints: what the head says, in any order and unit; orientations by any of three ways; what is refused by line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path as File
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models import ModelWarning
from ocp import ProblemError
from ocp.app.files import Waypoints, read_waypoints
from tests.models.paths.task_paths import product, seeds, turned

Array = NDArray[np.float64]
few = settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
POINTS = np.array([[0.1, 0.2, 0.3], [0.4, 0.2, 0.3], [0.4, 0.5, 0.35]])


@pytest.fixture
def waypoints(tmp_path: File) -> Callable[..., Waypoints]:
    def read(text: str, **options: Any) -> Waypoints:
        (tmp_path / "points.csv").write_text(text, encoding="utf-8")
        return read_waypoints(tmp_path / "points.csv", **options)

    return read


def table(head: list[str], values: Any, delimiter: str = ",") -> str:
    rows = [delimiter.join(f"{value:.15g}" for value in row) for row in np.atleast_2d(values)]
    return "\n".join([delimiter.join(head), *rows, ""])


def axes_of(orientations: Any) -> Array:
    """z axes of quaternions [w, x, y, z]."""
    return np.asarray(Rotation.from_quat(np.asarray(orientations), scalar_first=True).apply([0.0, 0.0, 1.0]))


@few
@given(seeds, st.sampled_from([",", ";", "\t", " ", "  "]), st.booleans())
def test_columns_are_read_in_any_order_and_by_any_sign(
    waypoints: Callable[..., Waypoints], seed: int, delimiter: str, windows: bool
) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 9))
    quaternions = np.array([turned(rng.normal(size=3)) for _ in range(count)])
    values = np.column_stack([np.cumsum(rng.uniform(0.01, 1, count)), rng.normal(size=(count, 3)), quaternions])
    names = ["time", "x", "y", "z", "qw", "qx", "qy", "qz"]
    order = rng.permutation(8)
    text = "# a comment\n\n" + table([names[i] for i in order], values[:, order], delimiter) + "# the end\n"
    result = waypoints(text.replace("\n", "\r\n") if windows else text)
    assert result.positions == pytest.approx(values[:, 1:4], rel=1e-12)
    assert result.times == pytest.approx(values[:, 0], rel=1e-12)
    assert result.orientations is not None
    assert np.abs((result.orientations * quaternions).sum(axis=1)) == pytest.approx(1, abs=1e-12)
    assert ((result.orientations[1:] * result.orientations[:-1]).sum(axis=1) >= 0).all()
    assert result.axes is None
    assert not result.free_roll
    assert sorted(result.names) == sorted(names)
    assert result.lines.tolist() == list(range(4, 4 + count))


@pytest.mark.parametrize(
    ("head", "scale"),
    [
        ("x,y,z", 1.0),
        ("X, Y, Z", 1.0),
        ("x [m],y [m],z [m]", 1.0),
        ("x_mm,y_mm,z_mm", 1e-3),
        ("x (mm),y[mm],z/mm", 1e-3),
        ("pos_x cm,pos_y cm,pos_z cm", 1e-2),
        ("px,py,pz", 1.0),
        ("pose.position.x,pose.position.y,pose.position.z", 1.0),
        ("x_in,y_in,z_in", 0.0254),
    ],
)
def test_heads_and_units(waypoints: Callable[..., Waypoints], head: str, scale: float) -> None:
    result = waypoints(f"{head}\n" + "\n".join(",".join(map(str, row)) for row in POINTS))
    assert result.positions == pytest.approx(scale * POINTS)
    assert result.names == ("x", "y", "z")


@pytest.mark.parametrize("head", ["# x y z", "x [m] y [m] z (m)", "#x y z\n"])
def test_a_head_in_a_comment_or_with_units_between_blanks(waypoints: Callable[..., Waypoints], head: str) -> None:
    result = waypoints(f"# first a remark\n{head}\n" + "\n".join(" ".join(map(str, row)) for row in POINTS))
    assert result.positions == pytest.approx(POINTS)


def test_tables_of_numpy_are_read(tmp_path: File) -> None:
    poses = np.column_stack([POINTS[:, ::-1], [[1.0, 0, 0, 0]] * 3])
    np.savetxt(tmp_path / "numpy.txt", poses, header="z y x qw qx qy qz")
    result = read_waypoints(tmp_path / "numpy.txt")
    assert result.positions == pytest.approx(POINTS)
    assert result.orientations == pytest.approx(poses[:, 3:])


def test_a_unit_of_the_caller_holds_where_the_head_says_none(waypoints: Callable[..., Waypoints]) -> None:
    text = table(["x", "y", "z"], 1e3 * POINTS)
    assert waypoints(text, unit="mm").positions == pytest.approx(POINTS)
    with pytest.warns(ModelWarning, match="is it in millimetres") as message:
        waypoints(text)
    assert message[0].message.name == "unit"  # type: ignore[union-attr]
    assert waypoints(table(["x mm", "y mm", "z mm"], 1e3 * POINTS), unit="mm").positions == pytest.approx(POINTS)
    with pytest.raises(ProblemError, match=r"the header says 'x mm', the caller unit='m'; omit unit"):
        waypoints(table(["x mm", "y mm", "z mm"], 1e3 * POINTS), unit="m")


def test_angles_and_times_have_units_too(waypoints: Callable[..., Waypoints]) -> None:
    values = np.column_stack([POINTS, [[0, 0, 0], [0, 0, 90], [0, 90, 0]], [0, 500, 1000]])
    head = ["x", "y", "z", "rx [deg]", "ry [deg]", "rz [deg]", "t [ms]"]
    result = waypoints(table(head, values))
    assert result.times == pytest.approx([0, 0.5, 1])
    half = np.sqrt(0.5)
    assert result.orientations == pytest.approx(np.array([[1, 0, 0, 0], [half, 0, 0, half], [half, 0, half, 0]]))
    with pytest.warns(ModelWarning, match="is it in degrees"):
        waypoints(table(["x", "y", "z", "rx", "ry", "rz"], values[:, :6]))


@few
@given(seeds)
def test_rotation_vectors_and_quaternions_say_the_same(waypoints: Callable[..., Waypoints], seed: int) -> None:
    rng = np.random.default_rng(seed)
    vectors = rng.uniform(-1.8, 1.8, (5, 3))
    points = rng.normal(size=(5, 3))
    one = waypoints(table(["x", "y", "z", "rx", "ry", "rz"], np.column_stack([points, vectors])))
    quaternions = Rotation.from_rotvec(vectors).as_quat(scalar_first=True) * rng.choice([-1.0, 1.0], (5, 1))
    head = ["x", "y", "z", "qw", "qx", "qy", "qz"]
    other = waypoints(table(head, np.column_stack([points, quaternions])))
    assert np.abs((one.orientations * other.orientations).sum(axis=1)) == pytest.approx(1, abs=1e-12)  # type: ignore[operator]


@few
@given(
    seeds, st.sampled_from([("ax", "ay", "az"), ("nx", "ny", "nz"), ("i", "j", "k"), ("axis_x", "axis_y", "axis_z")])
)
def test_a_tool_axis_is_the_z_axis_and_turns_with_the_least_roll(
    waypoints: Callable[..., Waypoints], seed: int, names: tuple[str, str, str]
) -> None:
    rng = np.random.default_rng(seed)
    axes = np.array([0, 0, -1.0]) + 0.4 * np.cumsum(rng.normal(size=(6, 3)), axis=0)
    result = waypoints(table(["x", "y", "z", *names], np.column_stack([rng.normal(size=(6, 3)), axes])))
    assert result.free_roll
    unit = axes / np.linalg.norm(axes, axis=1)[:, None]
    assert result.axes == pytest.approx(unit)
    assert axes_of(result.orientations) == pytest.approx(unit, abs=1e-12)
    turns = Rotation.from_quat(result.orientations, scalar_first=True)
    least = np.arccos(np.clip((unit[1:] * unit[:-1]).sum(axis=1), -1, 1))
    assert (turns[1:] * turns[:-1].inv()).magnitude() == pytest.approx(least, abs=1e-7)


def test_an_axis_that_goes_round_a_cone_comes_back_rolled_by_the_solid_angle(
    waypoints: Callable[..., Waypoints],
) -> None:
    """Parallel transport: the roll after a round trip is the area that the axis goes about on the unit sphere."""
    tilt, count = 0.5, 2001
    angle = np.linspace(0, 2 * np.pi, count)
    cone = [np.sin(tilt) * np.cos(angle), np.sin(tilt) * np.sin(angle), np.full(count, np.cos(tilt))]
    values = np.column_stack([angle, 0 * angle, 0 * angle, *cone])
    result = waypoints(table(["x", "y", "z", "ax", "ay", "az"], values))
    first, *_, last = Rotation.from_quat(result.orientations, scalar_first=True)
    assert (first.inv() * last).as_rotvec() == pytest.approx([0, 0, 2 * np.pi * (1 - np.cos(tilt))], abs=1e-4)


def test_a_tool_that_always_points_down_is_rotated_about_x(waypoints: Callable[..., Waypoints]) -> None:
    result = waypoints(table(["x", "y", "z", "ax", "ay", "az"], [[0, 0, 0, 0, 0, -2], [1, 0, 0, 0, 0, -1]]))
    assert result.orientations == pytest.approx(np.array([[0, 1, 0, 0], [0, 1, 0, 0]]))


def test_without_a_header_three_columns_are_positions_and_seven_need_names(waypoints: Callable[..., Waypoints]) -> None:
    text = "\n".join(" ".join(map(str, row)) for row in POINTS)
    assert waypoints(text).positions == pytest.approx(POINTS)
    poses = "\n".join("0,0,0,1,0,0,0".replace("0", str(i), 1) for i in range(3))
    with pytest.raises(ProblemError, match=r"line 1, .*no header names the 7 columns; .* columns="):
        waypoints(poses)
    order = ("x", "y", "z", "qx", "qy", "qz", "qw")
    result = waypoints(poses.replace("1,0,0,0", "0,0,0,1"), columns=order)
    assert result.orientations == pytest.approx(np.array([[1.0, 0, 0, 0]] * 3))
    assert result.lines.tolist() == [1, 2, 3]


@pytest.mark.parametrize("head", [",0,1,2,3,4,5,6\n", "0,1,2,3,4,5,6,7\n", "no,1,2,3,4,5,6,7\n", ""])
def test_columns_that_the_caller_names_pass_over_a_head_of_numbers(
    waypoints: Callable[..., Waypoints], head: str
) -> None:
    """The public benchmark's paths have a row of column numbers and an index before each row."""
    rows = "0,0.45,0.0,0.0,1.0,0.0,0.0,0.0\n1,0.44547737,0.0,0.0,1.0,0.0,0.0,0.0\n"
    result = waypoints(head + rows, columns=["index", "x", "y", "z", "qw", "qx", "qy", "qz"])
    assert result.positions == pytest.approx(np.array([[0.45, 0, 0], [0.44547737, 0, 0]]))
    assert result.names == ("x", "y", "z", "qw", "qx", "qy", "qz")
    assert result.ignored == ()


def test_ignored_columns_are_reported(waypoints: Callable[..., Waypoints]) -> None:
    result = waypoints("index,x,y,z,speed,mark\n0,0,0,0,1,a\n1,1,0,0,2,b\n")
    assert result.ignored == ("speed", "mark")


def test_decimal_commas_between_semicolons(waypoints: Callable[..., Waypoints]) -> None:
    assert waypoints("x;y;z\n0,5;1;2\n1,5;1;2\n").positions[:, 0] == pytest.approx([0.5, 1.5])


@few
@given(seeds, st.integers(2, 8))
def test_the_path_goes_through_the_points_and_turns_the_tool(
    waypoints: Callable[..., Waypoints], seed: int, count: int
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3))
    quaternions = [turned(rng.normal(size=3))]
    for _ in range(count - 1):
        quaternions.append(product(quaternions[-1], turned(0.5 * rng.normal(size=3))))
    signs = rng.choice([-1.0, 1.0], (count, 1))
    values = np.column_stack([points, signs * np.array(quaternions)])
    double = np.repeat(values, rng.integers(1, 3, count), axis=0)  # the same place twice
    result = waypoints(table(["x", "y", "z", "qw", "qx", "qy", "qz"], double))
    path = result.path()
    assert len(path.segments) == count - 1
    assert path.start == pytest.approx(points[:-1], abs=1e-12)
    assert np.asarray(path.segments[-1].end) == pytest.approx(points[-1], abs=1e-12)
    assert np.abs((path.orientation * np.array(quaternions)[:-1]).sum(axis=1)) == pytest.approx(1, abs=1e-9)
    smooth = result.smooth(tolerance=1e-3)
    ends = smooth.turn([0.0, smooth.length]).quaternion
    assert np.abs((ends * np.array([quaternions[0], quaternions[-1]])).sum(axis=1)) == pytest.approx(1, abs=1e-9)
    assert smooth.at([0.0, smooth.length]).position == pytest.approx(points[[0, -1]], abs=1e-9)


def test_reversals_are_split_given_a_bulb_or_refused_by_line(waypoints: Callable[..., Waypoints]) -> None:
    result = waypoints("x,y,z\n0,0,0\n1,0,0\n0.5,0,0\n0.5,1,0\n")
    with pytest.raises(ProblemError, match=r"reverses its direction; use paths\(\)") as caught:
        result.path()
    assert caught.value.name == "line 3"
    assert [len(path.segments) for path in result.paths()] == [1, 2]
    assert len(result.path(reversal=0.01).segments) == 6
    smooth = result.smooth(1e-3, reversal=0.02)
    assert smooth.length == pytest.approx(2.5 + 7 * np.pi / 3 * 0.01, abs=2e-3)


@pytest.mark.parametrize(
    ("text", "name", "words"),
    [
        ("", "file", "empty"),
        ("# only a comment\n", "file", "only comments"),
        ("x,y,z\n", "file", "no waypoint"),
        ("x,y,z\n0,0,nan\n1,0,0\n", "line 2", "not finite"),
        ("x,y,z\n0,0,inf\n1,0,0\n", "line 2", "not finite"),
        ("x,y,z\n0,0,0\n1,0\n", "line 3", "2 columns, expected 3"),
        ("x,y,z\n0,0,0\n1,0,0,7\n", "line 3", "4 columns, expected 3"),
        ("x,y,z\n0,0,0\n1,0,north\n", "line 3", "'north' is not a number"),
        ("x,y,w\n0,0,0\n", "z", "no column z among 'x', 'y', 'w'"),
        ("x,y,z,qw,qx,qy\n0,0,0,1,0,0\n", "qz", "no column qz"),
        ("x,y,z,x\n0,0,0,1\n", "x", "two columns are named"),
        ("x [rad],y,z\n0,0,0\n", "x", "cannot be in rad"),
        ("t,x,y,z\n0,0,0,0\n2,1,0,0\n1,2,0,0\n", "line 4", "1 s is not after 2 s; sort"),
        ("t,x,y,z\n0,0,0,0\n0,1,0,0\n", "line 3", "0 s is not after 0 s"),
        ("x,y,z,qw,qx,qy,qz\n0,0,0,1,0,0,0\n1,0,0,1,1,0,0\n", "line 3", "norm 1.41421"),
        ("x,y,z,qw,qx,qy,qz\n0,0,0,0,0,0,0\n", "line 2", "norm 0"),
        ("x,y,z,ax,ay,az\n0,0,0,0,0,0\n1,0,0,0,0,1\n", "line 2", "axis is zero"),
        ("x,y,z,ax,ay,az\n0,0,0,0,0,1\n1,0,0,0,0,-1\n", "line 3", "opposite to that of line 2"),
    ],
)
def test_a_table_that_is_wrong_is_refused_by_line_or_column(
    waypoints: Callable[..., Waypoints], text: str, name: str, words: str
) -> None:
    with pytest.raises(ProblemError, match=words) as caught:
        waypoints(text)
    assert caught.value.name == name


@pytest.mark.parametrize(
    ("rows", "name", "words"),
    [
        (["0,0,0,0,0,0", "0,0,0,0,0,1"], "line 3", r"turns by 57\.3 deg in place"),
        (["0,0,0,0,0,0", "1,0,0,0,0,0", "1,0,0,0,0,3.14159265", "2,0,0,0,0,3.14159265"], "line 4", "180 deg in place"),
        (["0,0,0,0,0,0", "1,0,0,0,0,3.1415"], "line 3", "from line 2 to here .* ambiguous"),
        (["1,0,0,0,0,0", "1,0,0,0,0,0"], "positions", "all waypoints are at one place"),
        (["1,0,0,0,0,0"], "positions", "all waypoints are at one place"),
    ],
)
def test_a_path_whose_orientation_must_jump_says_where(
    waypoints: Callable[..., Waypoints], rows: list[str], name: str, words: str
) -> None:
    result = waypoints("\n".join(["x,y,z,rx,ry,rz", *rows]))
    with pytest.raises(ProblemError, match=words) as caught:
        result.path()
    assert caught.value.name == name


@given(st.text(alphabet="xyzqwrt0123456789.,;\t -en#[]m\n", max_size=80))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)
@pytest.mark.filterwarnings("ignore::models.errors.ModelWarning")
def test_no_text_raises_anything_foreign(waypoints: Callable[..., Waypoints], text: str) -> None:
    try:
        waypoints(text).paths()
    except ProblemError as error:
        assert error.name  # noqa: PT017
