"""A public benchmark of redundant arms that follow pose paths: its robots and problems; see README.md there."""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from models import Box, CollisionShape, FixedBase, ModelWarning, Robot, link_frames
from models.checks import Array
from models.robot.rebuild import lock_joints

FOLDER = Path(__file__).resolve().parent
ROBOTS = ("fetch", "fetch_arm", "panda")
PROBLEMS = (
    "fetch_arm__hello",
    "fetch_arm__s",
    "fetch_arm__square",
    "fetch__square",
    "panda__1cube",
    "panda__flappy_bird",
)


@dataclass(frozen=True, eq=False)
class Benchmark:
    """One of the problems.

    Attributes:
        machine: The robot on its base frame, which is the world; with the capsules as its collision shapes.
        positions: Of the tip at the waypoints, in the base frame. Shape (N, 3), m.
        quaternions: Of the tip there, [w, x, y, z]. Shape (N, 4).
        boxes: Obstacles, in the base frame.
        ignored: Pairs of links that are not checked.
        torm_length_rad, torm_length_m: Of TORM's plan, None where it found none.
    """

    machine: FixedBase
    positions: Array
    quaternions: Array
    boxes: tuple[Box, ...]
    ignored: tuple[tuple[str, str], ...]
    torm_length_rad: float | None
    torm_length_m: float | None


@cache
def robot_of(name: str) -> Robot:
    """One of ROBOTS: its joints those that the benchmark moves, each link's capsule its collision shape."""
    options = _read("robots.json")[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # of the file's own attributes
        whole = Robot.from_urdf(FOLDER / options["urdf"], tip=options["tip"], root=options["base"])
    standing = {joint: 0.0 for joint in whole.joint_names if joint not in options["joints"]}
    robot = lock_joints(whole, standing | options.get("locked", {}))
    assert robot.joint_names == tuple(options["joints"])
    links = tuple(
        replace(link, collisions=(_capsule(options["capsules"][link.name]),))
        if link.name in options["capsules"]
        else link
        for link in robot.links
    )
    return replace(robot, links=links)


def ignored_pairs(robot: str) -> tuple[tuple[str, str], ...]:
    """Pairs of links of a robot that are not checked."""
    return tuple((one, other) for one, other in _read("robots.json")[robot]["ignored_pairs"])


@cache
def problem_of(name: str) -> Benchmark:
    """One of PROBLEMS."""
    options = _read("problems.json")[name]
    robot = robot_of(options["robot"])
    rows = np.loadtxt(FOLDER / options["path"], delimiter=",", skiprows=1)
    turn = np.array(options["rotation"], dtype=float)
    origin = np.zeros(3)
    if options["offset_frame"] != "world":
        frames = link_frames(robot, ca.DM.zeros(robot.dof))
        origin = np.array(ca.DM(frames[options["offset_frame"]].position)).ravel()
    facing = Rotation.from_quat(rows[:, [5, 6, 7, 4]]) * Rotation.from_matrix(turn)
    return Benchmark(
        machine=FixedBase(robot),
        positions=np.array(options["offset"]) + origin + rows[:, 1:4] @ turn.T,
        quaternions=facing.as_quat()[:, [3, 0, 1, 2]],
        boxes=tuple(Box(box["size"], box["center"]) for box in options["boxes_in_base"]),
        ignored=ignored_pairs(options["robot"]),
        torm_length_rad=options["torm_length_rad"],
        torm_length_m=options["torm_length_m"],
    )


def tip_and_file(name: str) -> tuple[str, str, str]:
    """Link of the tip, name of the URDF file and link of the base of a problem's robot."""
    options = _read("robots.json")[_read("problems.json")[name]["robot"]]
    return options["tip"], options["urdf"], options["base"]


def _read(file: str) -> Any:
    return json.loads((FOLDER / file).read_text(encoding="utf-8"))


def _capsule(numbers: list[float]) -> CollisionShape:
    """Two end points and a radius, m, as a capsule along z of a frame of its own."""
    start, end, radius = np.array(numbers[:3]), np.array(numbers[3:6]), numbers[6]
    length = float(np.linalg.norm(end - start))
    turn = Rotation.align_vectors((end - start)[None], [(0.0, 0.0, 1.0)])[0].as_matrix()
    return CollisionShape("capsule", (radius, length), translation=(start + end) / 2, rotation=turn)
