"""Support polygons computed from the collision shapes of robot descriptions."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from models import ModelError, Robot, footprint, link_frames, simplify
from models.machines.support import convex_hull
from tests.models.robot.pinocchio_robots import ROBOTS, urdf_file
from tests.models.robot.trees import numeric

PLATFORM = """
<robot name="cart">
  <link name="base"><inertial><mass value="40"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
    <collision><origin xyz="0 0 0.2"/><geometry><box size="0.6 0.4 0.2"/></geometry></collision></link>
  {parts}
</robot>"""


def cart(*parts: str) -> str:
    return PLATFORM.format(parts="\n".join(parts))


def part(name: str, place: str, shape: str, rpy: str = "0 0 0") -> str:
    return (
        f'<link name="{name}"><collision><geometry>{shape}</geometry></collision></link>'
        f'<joint name="{name}_joint" type="fixed"><parent link="base"/><child link="{name}"/>'
        f'<origin xyz="{place}" rpy="{rpy}"/></joint>'
    )


def wheels_and_ball() -> str:
    wheel = '<cylinder length="0.04" radius="0.1"/>'
    return cart(
        part("left", "0.2 0.25 0.05", wheel, f"{np.pi / 2} 0 0"),
        part("right", "0.2 -0.25 0.05", wheel, f"{np.pi / 2} 0 0"),
        part("caster", "-0.25 0 -0.022", '<sphere radius="0.03"/>'),
    )


def area(corners: np.ndarray) -> float:
    x, y = corners.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def test_wheels_stand_on_their_lowest_lines_and_a_ball_on_its_lowest_point() -> None:
    text = wheels_and_ball()
    result = footprint(Robot.from_urdf(text))
    assert result.links == ("left", "right", "caster")
    assert result.translation[2] == pytest.approx(0.052, abs=1e-15)
    expected = {(0.2, 0.27), (0.2, -0.27), (-0.25, 0.0)}
    assert {tuple(np.round(v, 12)) for v in result.support.vertices} == expected


def test_points_above_the_contact_depth_are_not_in_contact() -> None:
    text = wheels_and_ball()
    robot = Robot.from_urdf(text)
    with pytest.raises(ModelError, match=r"'caster'.*one point or line"):
        footprint(robot, depth=0.001)  # the wheels are 2 mm higher
    held_up = footprint(robot, links=["left", "right", "base"], depth=0.2)
    assert held_up.support.area == pytest.approx((0.27 * 2 + 0.4) * 0.1 / 2 + 0.5 * 0.4, rel=0.2)


def test_a_standing_cylinder_gives_a_polygon_inside_its_rim() -> None:
    text = cart(part("foot", "0.1 -0.2 -0.3", '<cylinder length="0.5" radius="0.15"/>'))
    result = footprint(Robot.from_urdf(text))
    away = np.linalg.norm(result.support.vertices - [0.1, -0.2], axis=1)
    np.testing.assert_allclose(away, 0.15, atol=1e-14)
    assert 0.99 * np.pi * 0.15**2 < result.support.area < np.pi * 0.15**2
    assert result.translation[2] == pytest.approx(0.55)


def test_the_pose_of_the_legs_counts() -> None:
    leg = (
        '<link name="{n}"><collision><origin xyz="0 0 -0.3"/><geometry><sphere radius="0.02"/></geometry></collision>'
        '</link><joint name="{n}_hip" type="revolute"><parent link="base"/><child link="{n}"/>'
        '<origin xyz="{x} {y} 0"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>'
    )
    text = cart(*(leg.format(n=f"leg{x}{y}", x=0.3 * x, y=0.2 * y) for x in (-1, 1) for y in (-1, 1)))
    robot = Robot.from_urdf(text)
    straight, spread = footprint(robot), footprint(robot, q=[0.5, 0.5, -0.5, -0.5])
    assert straight.translation[2] == pytest.approx(0.32)
    assert spread.translation[2] == pytest.approx(0.3 * np.cos(0.5) + 0.02)
    np.testing.assert_allclose(straight.support.half_widths, [0.3, 0.2], atol=1e-12)
    np.testing.assert_allclose(spread.support.half_widths, [0.3 + 0.3 * np.sin(0.5), 0.2], atol=1e-12)


@given(st.lists(st.tuples(st.integers(-8, 8), st.integers(-8, 8)), min_size=3, max_size=40))
def test_the_hull_is_that_of_an_independent_library(points: list[tuple[int, int]]) -> None:
    cloud = np.unique(np.array(points, dtype=float), axis=0)
    hull = convex_hull(points)
    spread = np.linalg.matrix_rank(cloud - cloud[0])
    if spread < 2:
        assert len(hull) < 3
    else:
        assert area(hull) == pytest.approx(ConvexHull(cloud).volume)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ('<mesh filename="package://a/b.stl"/>', r"only meshes, in \['foot'\].*give the support yourself"),
        ('<sphere radius="-0.1"/>', r"link 'foot': .*sphere: size \[-0.1\] is not positive"),
        ('<box size="0.1 -1 0.1"/>', r"link 'foot': .*box: size .* is not positive"),
        ('<cylinder radius="0.1"/>', r"link 'foot': <cylinder> has no attribute 'length'"),
        ('<cone radius="0.1"/>', "link 'foot': shape must be .*, not 'cone'"),
        ("", "link 'foot': <geometry> has 0 shapes"),
    ],
)
def test_shapes_that_are_not_read_are_named(shape: str, message: str) -> None:
    text = cart(part("foot", "0 0 -1", shape))
    with pytest.raises(ModelError, match=message):
        footprint(Robot.from_urdf(text), links=["foot"])


def test_unknown_links_and_impossible_depths_are_named() -> None:
    text = cart()
    robot = Robot.from_urdf(text)
    with pytest.raises(ModelError, match=r"link 'bace' does not exist; did you mean 'base'"):
        footprint(robot, links=["bace"])
    with pytest.raises(ModelError, match=r"depth must be .*, not -1"):
        footprint(robot, depth=-1)


def test_a_root_link_that_is_not_upright_is_set_upright() -> None:
    text = wheels_and_ball()
    lying = text.replace(
        "</robot>",
        f"""<link name="lying"/><joint name="turn" type="fixed"><parent link="lying"/>
        <child link="base"/><origin xyz="0.3 0.1 0.2" rpy="{np.pi / 2} 0 0"/></joint></robot>""",
    )
    turned = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    upright = footprint(Robot.from_urdf(text))
    robot = Robot.from_urdf(lying)
    result = footprint(robot, rotation=turned)
    shift = turned @ [0.3, 0.1, 0.2]
    np.testing.assert_allclose(result.support.vertices, upright.support.vertices + shift[:2], atol=1e-12)
    assert result.translation[2] == pytest.approx(upright.translation[2] - shift[2])
    frames = link_frames(robot, [], (ca.DM(result.rotation), ca.DM(result.translation)))
    assert float(frames["caster"].position[2]) == pytest.approx(0.03)  # its radius: it touches z = 0
    with pytest.raises(ModelError, match="not a rotation"):
        footprint(robot, rotation=2 * np.eye(3))


def test_a_simplified_robot_stands_on_the_same_shapes() -> None:
    robot = Robot.from_urdf(wheels_and_ball())
    result, whole = footprint(simplify(robot)), footprint(robot)
    assert (result.links, whole.links) == (("base",), ("left", "right", "caster"))
    np.testing.assert_allclose(result.support.vertices, whole.support.vertices, atol=1e-15)


def test_a_mesh_below_all_shapes_is_refused() -> None:
    text = cart(part("foot", "0.1 0 -0.4", '<mesh filename="package://a/b.stl"/>'))
    robot = Robot.from_urdf(text)
    with pytest.raises(ModelError, match=r"mesh of link 'foot' begins 0.5 m lower than all shapes"):
        footprint(robot)
    np.testing.assert_allclose(footprint(robot, links=["base"]).support.half_widths, [0.3, 0.2])


def test_footprints_of_real_robots() -> None:
    """TIAGo on two wheels and four casters, ANYmal on the lowest points of its four feet: figures of their files."""
    package, ending, options = ROBOTS["tiago"]
    file = urdf_file(package, ending)
    result = footprint(Robot.from_urdf(file, **options))
    corners = {(-0.1895, 0.102), (-0.1895, -0.102), (0.0, 0.2222), (0.0, -0.2222), (0.1535, 0.102), (0.1535, -0.102)}
    assert {tuple(v + 0.0) for v in result.support.vertices.round(9)} == corners
    assert abs(result.translation[2]) < 1e-9
    package, ending, options = ROBOTS["anymal-kinova"]
    file = urdf_file(package, ending)
    robot = Robot.from_urdf(file, **options)
    feet = ["LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT"]
    q = np.random.default_rng(4).uniform(-0.02, 0.02, robot.dof)
    result = footprint(robot, q=q, links=feet, depth=0.1)
    frames = link_frames(robot, q)
    centers = [numeric(frames[foot].point(ca.DM([0, 0, 0.02325])))[:2, 0] for foot in feet]
    np.testing.assert_allclose(sorted(map(tuple, result.support.vertices)), sorted(map(tuple, centers)), atol=1e-12)


def test_source_may_be_a_file(tmp_path: Path) -> None:
    file = tmp_path / "cart.urdf"
    file.write_text(wheels_and_ball())
    assert footprint(Robot.from_urdf(file)).links == ("left", "right", "caster")
