"""The bodies of robots: what the description says, every point of a mesh inside, missing meshes named."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from models import CollisionScene, CollisionShape, FixedBase, Joint, Link, ModelError, ModelWarning, Robot
from models.checks import Array
from models.shapes.bodies import Body, capsule_around, collision_bodies
from models.shapes.covering import exceedance
from models.shapes.mesh_files import find_mesh, read_mesh
from models.shapes.shapes import Box, Capsule, Cylinder, HalfSpace, Mesh, Sphere
from tests.models.robot.pinocchio_robots import ROBOTS, urdf_file

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
PLACE = np.array([0.1, -0.2, 0.3])


def one_link(*shapes: CollisionShape) -> Robot:
    return Robot((Link("base", collisions=shapes),))


def shape(kind: Any, size: Any, **more: Any) -> CollisionShape:
    return CollisionShape(kind, size, translation=PLACE, rotation=TURN, **more)


def test_simple_shapes_have_their_known_supports() -> None:
    robot = one_link(shape("box", (0.1, 0.2, 0.3)), shape("sphere", (0.1,)), shape("capsule", (0.1, 0.4)))
    box, ball, rod = (body.shape for body in collision_bodies(robot))
    assert isinstance(box, Box)
    np.testing.assert_array_equal(box.size, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(box.rotation, TURN, atol=1e-15)
    assert isinstance(ball, Sphere)
    np.testing.assert_array_equal(ball.position, PLACE)
    assert isinstance(rod, Capsule)
    np.testing.assert_allclose(rod.start, PLACE - 0.2 * TURN[:, 2], atol=1e-15)
    np.testing.assert_allclose(rod.end, PLACE + 0.2 * TURN[:, 2], atol=1e-15)
    assert [body.overhang for body in collision_bodies(robot)] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(("radius", "length"), [(0.05, 0.6), (0.05, 0.11), (0.1, 0.02), (0.03, 0.06), (0.01, 1.0)])
def test_a_cylinder_lies_inside_its_hull(radius: float, length: float) -> None:
    (body,) = collision_bodies(one_link(shape("cylinder", (radius, length))))
    angles = np.linspace(0, 2 * np.pi, 500)
    rim = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.full(500, length / 2)])
    points = PLACE + np.concatenate([rim, rim * [1, 1, -1]]) @ TURN.T
    if isinstance(body.shape, Capsule):
        assert exceedance(body.shape, points).max() <= 0
        pole = np.linalg.norm(np.subtract(body.shape.end, body.shape.start)) / 2 + body.shape.radius - length / 2
        assert body.overhang == pytest.approx(pole)
        assert body.overhang >= body.shape.radius - radius
    else:
        assert isinstance(body.shape, Cylinder)
        assert (body.shape.radius, body.shape.length) == (radius, length)
        assert length < 4 * radius


def test_the_capsule_around_a_cylinder_has_the_least_volume() -> None:
    """Against every radius of a fine search of the closed form, and where length rules or does not."""
    for radius, length in [(0.05, 0.6), (0.1, 0.2), (0.1, 0.01)]:
        least, (wide, straight), _ = capsule_around(radius, length)
        tried = np.linspace(radius, np.hypot(radius, length / 2), 20_001)
        lengths = np.maximum(length - 2 * np.sqrt(tried**2 - radius**2), 0)
        assert least <= (np.pi * tried**2 * (lengths + 4 / 3 * tried)).min() * (1 + 1e-4)
        assert np.hypot(radius, length / 2 - straight / 2) <= wide


@pytest.fixture
def mesh_robot(tmp_path: Path) -> Path:
    """A URDF whose mesh is a package's, in millimetres, mirrored; the file."""
    package = tmp_path / "arm_description"
    for folder in ("meshes", "urdf"):
        (package / folder).mkdir(parents=True)
    mesh = trimesh.creation.capsule(radius=30.0, height=100.0, count=[16, 16])
    mesh.apply_translation([10.0, 20.0, 30.0])
    mesh.export(package / "meshes" / "upper.stl")
    file = package / "urdf" / "arm.urdf"
    file.write_text(
        """<robot name="arm"><link name="upper"><collision><origin xyz="0.1 0.2 0.3" rpy="0.4 0.5 0.6"/><geometry>
        <mesh filename="package://arm_description/meshes/upper.stl" scale="0.001 -0.001 0.001"/></geometry></collision>
        </link></robot>""",
        encoding="utf-8",
    )
    return file


def mesh_points(robot: Robot) -> dict[str, list[Array]]:
    """Vertices of the meshes of each link, scaled and placed, by an own way."""
    by_name: dict[str, list[Array]] = {}
    for link in robot.links:
        for each in link.collisions:
            if each.kind == "mesh":
                path = find_mesh(each.file, each.folder)
                assert path is not None
                points = read_mesh(path)[0] @ np.diag(each.size) @ np.asarray(each.rotation).T + each.translation
                by_name.setdefault(link.name, []).append(points)
    return by_name


def outside(bodies: tuple[Body, ...], link: str, points: Array) -> float:
    """How far the worst point is outside of all of a link's bodies that cover meshes, m."""
    shapes = [body.shape for body in bodies if body.link == link]
    return float(np.min([exceedance(each, points) for each in shapes if isinstance(each, Capsule | Box)], axis=0).max())


def test_a_mesh_is_found_scaled_mirrored_and_placed(mesh_robot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Robot.from_urdf(mesh_robot)
    (points,) = mesh_points(robot)["upper"]
    bodies = collision_bodies(robot)
    assert outside(bodies, "upper", points) <= 1e-12
    assert len(bodies) == 1
    assert isinstance(bodies[0].shape, Capsule)
    assert bodies[0].shape.radius == pytest.approx(0.03, rel=0.02)
    text = mesh_robot.read_text(encoding="utf-8")
    with pytest.raises(ModelError, match=r"'upper'.*upper\.stl.*folders"):
        collision_bodies(Robot.from_urdf(text))  # a text has no folder
    again = collision_bodies(Robot.from_urdf(text), folders=[mesh_robot.parents[2]])
    np.testing.assert_array_equal(again[0].shape.core, bodies[0].shape.core)


@pytest.mark.parametrize("flat", [(1, 1, 0), (0, 0, 1)], ids=["plate", "line"])
def test_planar_meshes_are_checked_as_plates_of_a_micrometre(tmp_path: Path, flat: tuple[float, ...]) -> None:
    """Of two links two joints apart, which are seen as hulls: of what has none, with next to no thickness."""
    corners = np.array(np.meshgrid(*[(-0.3, 0.3)] * 3)).reshape(3, -1).T * flat
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "f 1 2 3\nf 2 4 5\nf 6 7 8\n"
    (tmp_path / "flat.obj").write_text(text, encoding="utf-8")
    links = tuple(Link(f"link{k}", collisions=(CollisionShape("mesh", (1, 1, 1), "flat.obj"),)) for k in range(3))
    turn: dict[str, Any] = {"axis": (0, 1, 0), "translation": (0, 0, 0.2), "lower": -2, "upper": 2}
    joints = tuple(Joint(f"joint{k}", "revolute", f"link{k - 1}", f"link{k}", **turn) for k in (1, 2))
    around = CollisionScene(FixedBase(Robot(links, joints)), folders=[tmp_path])
    assert around.labels == (("link0 hull 1", "link2 hull 2"),)
    for body in around.bodies:
        if isinstance(body.shape, Mesh):
            wanted = np.maximum(np.ptp(corners, axis=0), 2e-6)
            np.testing.assert_allclose(np.ptp(body.shape.core, axis=0), wanted, atol=3e-6)
    assert np.isfinite(float(around.distances((), [1.5, -1.5])))


def test_a_missing_mesh_is_named_and_skipped_only_on_request(mesh_robot: Path) -> None:
    (mesh_robot.parents[1] / "meshes" / "upper.stl").unlink()
    robot = Robot.from_urdf(mesh_robot)
    with pytest.raises(ModelError, match=r"'upper'.*upper\.stl") as caught:
        collision_bodies(robot)
    assert caught.value.name == "package://arm_description/meshes/upper.stl"
    assert caught.value.value == "upper"
    with pytest.warns(ModelWarning, match=r"'upper'.*upper\.stl"):
        assert collision_bodies(robot, missing="skip") == ()


def test_a_broken_mesh_is_named_with_its_link(mesh_robot: Path) -> None:
    (mesh_robot.parents[1] / "meshes" / "upper.stl").write_bytes(b"solid\nvertex\n")
    robot = Robot.from_urdf(mesh_robot)
    with pytest.raises(ModelError, match=r"link 'upper': mesh .*line 2"):
        collision_bodies(robot)
    with pytest.warns(ModelWarning, match="line 2"):
        assert collision_bodies(robot, missing="skip") == ()


@pytest.mark.parametrize(
    "name", ["panda", "ur5", *(pytest.param(name, marks=pytest.mark.long) for name in ("tiago", "anymal-kinova"))]
)
def test_real_robots_are_covered(name: str) -> None:
    package, ending, options = ROBOTS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        robot = Robot.from_urdf(urdf_file(package, ending), **options)
    bodies = collision_bodies(robot)
    assert {body.link for body in bodies} == {link.name for link in robot.links if link.collisions}
    for link, meshes in mesh_points(robot).items():
        for points in meshes:
            assert outside(bodies, link, points) <= 1e-12, link


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"missing": "ignore"}, "missing"),
        ({"missing": None}, "missing"),
        ({"folders": "/tmp"}, "folders"),
        ({"folders": [3]}, "folders"),
        ({"folders": 3}, "folders"),
        ({"robot": "arm"}, "robot"),
        ({"robot": None}, "robot"),
    ],
)
def test_bad_requests_are_named(options: dict[str, Any], name: str) -> None:
    options = {"robot": one_link()} | options
    with pytest.raises(ModelError) as caught:
        collision_bodies(options.pop("robot"), **options)
    assert caught.value.name == name


BALL = Sphere(1.0, (0, 0, 0))
BAD = [(("", BALL), "link"), (("a", "b"), "shape"), (("a", HalfSpace((0, 0, 1), (0, 0, 0))), "shape")]


@pytest.mark.parametrize(("options", "name"), [*BAD, (("a", BALL, -1.0), "overhang")])
def test_bad_bodies_are_named(options: tuple[Any, ...], name: str) -> None:
    with pytest.raises(ModelError) as caught:
        Body(*options)
    assert caught.value.name == name
