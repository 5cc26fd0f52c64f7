"""The example robots of the package against Pinocchio and closed forms."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from models import CollisionScene, FixedBase, ModelError, example_robot, mass_matrix

NAMES = {"six_axis": 6, "seven_axis": 7}


@pytest.mark.parametrize("name", NAMES)
def test_pinocchio_reads_the_same_arm(name: str, tmp_path: Path) -> None:
    robot, file = example_robot(name), tmp_path / "robot.urdf"
    robot.to_urdf(file)
    model = pin.buildModelFromUrdf(str(file))
    data = model.createData()
    assert list(model.names)[1:] == list(robot.joint_names) == [f"joint_{k}" for k in range(1, NAMES[name] + 1)]
    for inertia in model.inertias:
        ixx, iyy, izz = np.linalg.eigvalsh(inertia.inertia)
        assert inertia.mass > 0
        assert 0 < ixx <= iyy <= izz < ixx + iyy
    rng = np.random.default_rng(3)
    for q in rng.uniform(robot.lower, robot.upper, size=(5, robot.dof)):
        pin.framesForwardKinematics(model, data, q)
        frame = data.oMf[model.getFrameId("tool0")]
        pose = FixedBase(robot).tip_pose((), q)
        assert ca.DM(pose.position).full().ravel() == pytest.approx(frame.translation, abs=1e-12)
        assert ca.DM(pose.rotation).full() == pytest.approx(frame.rotation, abs=1e-12)
        assert ca.DM(mass_matrix(robot, q)).full() == pytest.approx(pin.crba(model, data, q), abs=1e-10)


@pytest.mark.parametrize("name", NAMES)
def test_bodies_are_homogeneous_and_apart_at_zero_and_every_joint_is_limited(name: str, tmp_path: Path) -> None:
    robot, file = example_robot(name), tmp_path / "robot.urdf"
    robot.to_urdf(file)
    for link in robot.links[:-1]:
        (shape,) = link.collisions
        radius, length = shape.size
        axis = np.asarray(shape.rotation)[:, 2]
        across = link.mass * (3 * radius**2 + length**2) / 12
        inertia = across * (np.eye(3) - np.outer(axis, axis)) + link.mass * radius**2 / 2 * np.outer(axis, axis)
        assert link.inertia == pytest.approx(inertia, abs=1e-12)
        assert link.center_of_mass == pytest.approx(shape.translation)
    assert np.isfinite([robot.lower, robot.upper, robot.velocity, robot.effort]).all()
    assert (robot.lower < 0).all()
    assert (robot.upper > 0).all()
    model = pin.buildModelFromUrdf(str(file))
    shapes = pin.buildGeomFromUrdf(model, str(file), pin.GeometryType.COLLISION)
    names = [link.name for link in robot.links]
    for one, two in combinations(range(shapes.ngeoms), 2):
        links = [shapes.geometryObjects[k].name.rsplit("_", 1)[0] for k in (one, two)]
        if abs(names.index(links[0]) - names.index(links[1])) > 1:
            shapes.addCollisionPair(pin.CollisionPair(one, two))
    data, outcome = model.createData(), pin.GeometryData(shapes)
    pin.computeDistances(model, data, shapes, outcome, np.zeros(model.nq))
    assert min(result.min_distance for result in outcome.distanceResults) > 0.005
    around = CollisionScene(FixedBase(robot))
    assert np.array(around.distances(np.zeros(0), np.zeros(robot.dof))).min() > 0


@pytest.mark.parametrize("name", NAMES)
def test_the_tool_axis_points_out_of_the_arm_and_the_reach_is_exact(name: str) -> None:
    robot = example_robot(name)
    shoulder = [0.0, 0.0, 0.09] if name == "six_axis" else [0.0, 0.0, 0.34]
    rng = np.random.default_rng(1)
    tips = ca.SX.sym("q", robot.dof)
    pose = FixedBase(robot).tip_pose((), tips)
    place = ca.Function("place", [tips], [pose.position, pose.rotation])
    far = np.array(place.map(20000)(rng.uniform(robot.lower, robot.upper, size=(20000, robot.dof)).T)[0]).T - shoulder
    assert 0.85 < np.linalg.norm(far, axis=1).max() < 1.0
    last = np.asarray(robot.joint(robot.joint_names[-1]).axis)
    assert np.array(place(np.zeros(robot.dof))[1])[:, 2] == pytest.approx(last)


@pytest.mark.parametrize("name", ["five_axis", "", None, 6, ["six_axis"]])
def test_another_name_is_refused_with_those_that_there_are(name: object) -> None:
    with pytest.raises(ModelError, match="'six_axis' or 'seven_axis'") as caught:
        example_robot(name)  # type: ignore[arg-type]
    assert (caught.value.name, caught.value.value) == ("name", name)
