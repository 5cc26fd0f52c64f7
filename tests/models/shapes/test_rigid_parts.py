"""How far a body at the end of a chain may come from the axes of its joints: exact stretched out, never less."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import Joint, Link, Mimic, Robot, link_frames
from models.checks import Array
from models.shapes.bodies import JointStep, RigidParts, lever_arms
from models.shapes.shapes import Box, Capsule, Shape, Sphere


def chain_of(joints: list[dict[str, Any]]) -> tuple[Robot, list[JointStep]]:
    """Links on joints one after the other, and the steps from the first to the last."""
    links = tuple(Link(f"link{k}") for k in range(len(joints) + 1))
    matches = [Joint(f"joint{k}", parent=f"link{k}", child=f"link{k + 1}", **each) for k, each in enumerate(joints)]
    robot = Robot(links, tuple(matches))
    return robot, RigidParts.of(robot).path("link0", f"link{len(joints)}")[1]


def test_the_reach_of_a_stretched_chain_is_exact() -> None:
    """0.2 m along x to a turn, 0.3 m to a slide of -0.1 to 0.5 m, 0.4 m to a turn, and there a rod of 0.6 m."""
    rotation, slide = {"kind": "revolute", "axis": (0, 0, 1), "lower": -2, "upper": 2}, {"kind": "prismatic"}
    robot, steps = chain_of(
        [
            {**rotation, "translation": (0.2, 0, 0)},
            {**slide, "axis": (1, 0, 0), "lower": -0.1, "upper": 0.5, "translation": (0.3, 0, 0)},
            {**rotation, "translation": (0.4, 0, 0)},
        ]
    )
    rod = Capsule(0.05, (0.1, 0, 0), (0.6, 0, 0))
    own, reach = lever_arms(robot, [(step, True) for step in steps], rod, robot.lower, robot.upper)
    end = 0.6 + 0.05
    assert own == pytest.approx([0.3 + 0.5 + 0.4 + end, 0.0 + end, end])
    assert reach == pytest.approx(0.2 + 0.3 + 0.5 + 0.4 + end)
    # the other way round: a rod on the first link, seen from behind the last joint
    start = Capsule(0.05, (0.1, 0, 0), (-0.6, 0, 0))
    own, _ = lever_arms(robot, [(step, False) for step in steps[::-1]], start, robot.lower, robot.upper)
    assert own == pytest.approx([0.4 + 0.5 + 0.3 + 0.2 + end, 0.2 + end, 0.2 + end])
    own, reach = lever_arms(robot, [], rod, robot.lower, robot.upper)
    assert not own
    assert reach == pytest.approx(end)


def test_over_a_fork_it_is_as_far_as_its_joints_are_from_each_other() -> None:
    """From one arm, whose joint is 1 m to one side, to the other, 2 m to the other side, with a ball 0.5 m on."""
    links = tuple(Link(name) for name in ("base", "left", "right"))
    rotation: dict[str, Any] = {"axis": (0, 0, 1), "lower": -2, "upper": 2}
    joints = (
        Joint("one", "revolute", "base", "left", (-1, 0, 0), **rotation),
        Joint("other", "revolute", "base", "right", (2, 0, 0), **rotation),
    )
    robot = Robot(links, joints, tip="right")
    up, down = RigidParts.of(robot).path("left", "right")
    chain = [(up[0], False), (down[0], True)]
    own, _ = lever_arms(robot, chain, Sphere(0.1, (0.5, 0, 0)), robot.lower, robot.upper)
    assert own == pytest.approx([3.0 + 0.6, 0.6])
    assert RigidParts.of(robot).common_part("left", "right") == "base"


def test_a_slide_that_follows_goes_as_far_as_it_follows() -> None:
    """Led from -0.2 to 0.6 m, by -0.5 times that and 0.3 m on: from 0.4 m down to 0."""
    links = tuple(Link(f"link{k}") for k in range(4))
    slide: dict[str, Any] = {"axis": (1, 0, 0)}
    joints = (
        Joint("turn", "revolute", "link0", "link1", axis=(0, 0, 1), lower=-2, upper=2),
        Joint("leads", "prismatic", "link1", "link2", lower=-0.2, upper=0.6, **slide),
        Joint("follows", "prismatic", "link2", "link3", mimic=Mimic("leads", -0.5, 0.3), **slide),
    )
    robot = Robot(links, joints)
    steps = RigidParts.of(robot).path("link0", "link3")[1]
    own, _ = lever_arms(robot, [(step, True) for step in steps], Sphere(0.1, (0, 0, 0)), robot.lower, robot.upper)
    assert own == pytest.approx([0.6 + 0.4 + 0.1, 0.4 + 0.1, 0.1])


def test_lever_arms_are_zero_along_the_axis_and_full_across_it() -> None:
    joint = {"kind": "revolute", "lower": -2, "upper": 2}
    robot, steps = chain_of(
        [
            {**joint, "axis": (1, 0, 0), "translation": (0.2, 0.1, 0)},
            {**joint, "axis": (1, 0, 0), "translation": (3, 4, 0)},
        ]
    )
    box = Box((0.2, 0.6, 0.8))
    own, reach = lever_arms(robot, [(step, True) for step in steps], box, robot.lower, robot.upper)
    assert own == pytest.approx([4.0 + np.hypot(0.5, 0.1), 0.5])
    assert reach == pytest.approx(np.hypot(0.2, 0.1) + 5.0 + np.hypot(0.5, 0.1))


@pytest.mark.parametrize("seed", range(6))
def test_no_configuration_exceeds_the_distance_bounds_from_an_axis(seed: int) -> None:
    """Up from one link of a random tree, down to another: of points of the body in 300 postures."""
    rng = np.random.default_rng(seed)
    links, joints = tuple(Link(f"link{k}") for k in range(6)), []
    for k in range(1, 6):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        kind: Any = "prismatic" if k in (2, 5) else "revolute"
        low, high = np.sort(rng.uniform(-0.5, 0.5, 2) if kind == "prismatic" else rng.uniform(-3, 3, 2))
        parent = {4: "link0"}.get(k, f"link{k - 1}")  # 0-1-2-3 and 0-4-5
        pose: dict[str, Any] = {"translation": rng.normal(size=3), "rotation": rotation * np.linalg.det(rotation)}
        joints.append(
            Joint(f"joint{k}", kind, parent, f"link{k}", axis=rng.normal(size=3), lower=low, upper=high, **pose)
        )
    robot = Robot(links, tuple(joints), tip="link5")
    above = [(step, False) for step in RigidParts.of(robot).path("link3", "link0")[0]]
    first = Box(rng.uniform(0.1, 1, 3), rng.normal(size=3))
    axis = np.asarray(above[-1][0].rotation @ above[-1][0].joint.axis)
    away = np.linalg.norm(np.cross(first.core - above[-1][0].translation, axis), axis=1).max()
    assert lever_arms(robot, above, first, robot.lower, robot.upper)[0][-1] == pytest.approx(away, rel=1e-12)
    up, down = RigidParts.of(robot).path("link3", "link5")
    chain = [*((step, False) for step in up), *((step, True) for step in down)]
    end = Box(rng.uniform(0.1, 1, 3), rng.normal(size=3)) if seed % 2 else Capsule(0.2, *rng.normal(size=(2, 3)))
    own, _ = lever_arms(robot, chain, end, robot.lower, robot.upper)
    assert len(own) == 5
    result = farthest(robot, [step for step, _ in chain], "link5", end, rng)
    assert (result <= np.array(own) + 1e-9).all()
    assert result[-1] == pytest.approx(own[-1], rel=1e-9)
    assert (result > 0.2 * np.array(own)).all()


def farthest(robot: Robot, steps: list[JointStep], link: str, body: Shape, rng: np.random.Generator) -> Array:
    """Of points of a body of a link from the axis of each joint, in random postures."""
    q = ca.SX.sym("q", robot.dof)
    frames = link_frames(robot, q)
    points = ca.mtimes(frames[link].rotation, ca.DM(body.core.T)) + ca.repmat(frames[link].position, 1, len(body.core))
    each = []
    for step in steps:
        frame = frames[step.joint.child]
        axis = ca.mtimes(frame.rotation, ca.DM(step.joint.axis))
        away = [ca.norm_2(ca.cross(axis, points[:, k] - frame.position)) for k in range(len(body.core))]
        each.append(ca.mmax(ca.vertcat(*away)) + body.swept_radius)
    configurations = rng.uniform(robot.lower, robot.upper, (300, robot.dof)).T
    return np.asarray(np.array(ca.Function("away", [q], [ca.vertcat(*each)])(configurations)).max(axis=1))
