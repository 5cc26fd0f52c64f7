"""A robot of four joints, smooth motions of it, and files of them, for the tests of the command."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from models import Machine, Robot
from ocp import Scene
from ocp.app import Check, check_trajectory
from ocp.app.check.joint_limits import CHECKED_LIMITS, limits_by_name
from ocp.app.check.verdict import CheckTolerances, Interpretation
from ocp.app.files import RawTrajectory

NAMES = ("shoulder", "elbow", "wrist", "slide")
MIDDLE, SWING = np.array([0.3, 0.8, -0.5, 0.15]), np.array([0.4, 0.3, 0.5, 0.05])
TURNS = 2 * np.pi * np.array([0.25, 0.5, 0.25, 0.5])
"""rad/s of the sines that the joints go."""


def link(name: str, length: float, mass: float) -> str:
    """Along x, with a bar of its length to collide."""
    across = mass * length**2 / 12
    moments = f'ixx="{across / 2}" iyy="{across}" izz="{across}" ixy="0" ixz="0" iyz="0"'
    return f"""
  <link name="{name}">
    <inertial><origin xyz="{length / 2} 0 0"/><mass value="{mass}"/><inertia {moments}/></inertial>
    <collision><origin xyz="{length / 2} 0 0"/><geometry><box size="{length} 0.04 0.04"/></geometry></collision>
  </link>"""


def joint(
    name: str, kind: str, parent: str, child: str, x: float, limits: str, axis: str = "0 0 1", more: str = ""
) -> str:
    return f"""
  <joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{x} 0 0"/>
    <axis xyz="{axis}"/><limit {limits}/>{more}</joint>"""


URDF = (
    '<robot name="bars"><link name="world"/>'
    + link("upper", 0.5, 3.0)
    + link("fore", 0.4, 2.0)
    + link("hand", 0.2, 1.0)
    + link("finger", 0.1, 0.2)
    + joint("shoulder", "revolute", "world", "upper", 0.0, 'lower="-2" upper="2" velocity="2" effort="60"', "0 -1 0")
    + joint("elbow", "revolute", "upper", "fore", 0.5, 'lower="-3.1" upper="3.1" velocity="3" effort="30"')
    + joint("wrist", "revolute", "fore", "hand", 0.4, 'lower="-2.5" upper="2.5" velocity="3" effort="10"')
    + joint("slide", "prismatic", "hand", "finger", 0.2, 'lower="0" upper="0.3" velocity="0.5" effort="50"', "1 0 0")
    + "</robot>"
)
"""Three joints that turn, the first about a level axis, and a slide."""


def smooth(count: int = 401, duration: float = 4.0) -> tuple[Any, Any, Any, Any]:
    """Times, positions, velocities and accelerations of sines. Shape (M,), (M, 4) each."""
    t = np.linspace(0.0, duration, count)
    phase = np.outer(t, TURNS)
    return t, MIDDLE + SWING * np.sin(phase), SWING * TURNS * np.cos(phase), -SWING * TURNS**2 * np.sin(phase)


def write_robot(folder: Path, text: str = URDF) -> Path:
    file = folder / "robot.urdf"
    file.write_text(text)
    return file


def write_table(file: Path, t: Any, q: Any, v: Any = None, a: Any = None, *, names: tuple[str, ...] = NAMES) -> Path:
    """A CSV as the package writes it."""
    head, columns = ["time", *names], [t, q]
    for word, values in (("velocity", v), ("acceleration", a)):
        if values is not None:
            head += [f"{name}.{word}" for name in names]
            columns.append(values)
    rows = np.column_stack(columns).tolist()
    file.write_text("\n".join([",".join(head), *(",".join(map(repr, row)) for row in rows)]) + "\n")
    return file


def check_motion(machine: Machine | Robot, raw: RawTrajectory, **options: Any) -> Check:
    """The check of a trajectory, with all limits, tolerances and interpretations as options; see check_trajectory."""
    robot = machine if isinstance(machine, Robot) else machine.robot

    def group(*names: str) -> dict[str, Any]:
        return {name: options.pop(name) for name in names if name in options}

    limits = group(*CHECKED_LIMITS)
    by_name = {name: limits.pop(name) for name in [*limits] if isinstance(limits[name], dict)}
    bounds = replace(limits_by_name(robot, by_name), **limits, **group("friction"))
    interpretation = Interpretation(**group("rule", "time_unit", "unwrap", "names_confirmed"))
    tolerances = CheckTolerances(**group("share", "tip_distance", "tip_angle"))
    scene = Scene(**group("obstacles", "clearance", "ignored", "srdf", "folders", "missing"))
    details: dict[str, Any] = {"interpretation": interpretation, "tolerances": tolerances, **options}
    return check_trajectory(machine, raw, limits=bounds, **({"scene": scene} | details))
