"""The robots of the gallery: URDF files of optional packages, and how each is read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import numpy as np

from models import Robot


def packaged(package: str, ending: str) -> Path:
    """A file of an installed distribution.

    Raises:
        FileNotFoundError: The distribution is not installed, or has no such file; says what to install.
    """
    try:
        owner = distribution(package)
    except PackageNotFoundError:
        raise FileNotFoundError(f"{ending} comes with the package {package!r}: pip install {package}") from None
    result = [file for file in owner.files or [] if f"/{file.as_posix()}".endswith(f"/{ending}")]
    if not result:
        raise FileNotFoundError(f"the installed package {package!r} has no file {ending}: pip install -U {package}")
    return Path(str(owner.locate_file(result[0])))


@dataclass(frozen=True)
class RobotFile:
    """A URDF file of an installed distribution.

    Attributes:
        name: What the robot is called in tables and figures.
        package: The distribution. ending: The end of the file's path in it.
        options: Of Robot.from_urdf.
    """

    name: str
    package: str
    ending: str
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def path(self) -> Path:
        """The file; FileNotFoundError, which says what to install, where it is not."""
        return packaged(self.package, self.ending)

    def read(self) -> Robot:
        """The robot."""
        return Robot.from_urdf(self.path, **self.options)


TOOL_ANGLE = np.deg2rad(45.0)
"""Of the sanding tool's axis to the axis of the UR5's flange: with 0 its roll would be that of the last joint alone."""
_COSINE, _SINE = float(np.cos(TOOL_ANGLE)), float(np.sin(TOOL_ANGLE))

SPACE_ARM = RobotFile(
    "SPART 7-joint space manipulator", "spartpy", "SPARTpy/urdf/floating_7dof_manipulator.urdf", {"tip": "Link_EE"}
)
PANDA = RobotFile(
    "Franka Panda",
    "example-robot-data",
    "panda_description/urdf/panda.urdf",
    {"tip": "panda_hand_tcp", "lock": {"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.02}},
)
UR5 = RobotFile(
    "UR5 with an angled tool",
    "example-robot-data",
    "ur_description/urdf/ur5_robot.urdf",
    {
        "tip": "tool0",
        "tip_translation": [0.0, -0.06, 0.14],
        "tip_rotation": [[1.0, 0.0, 0.0], [0.0, _COSINE, -_SINE], [0.0, _SINE, _COSINE]],
    },
)
TALOS = RobotFile(
    "TALOS",
    "example-robot-data",
    "talos_data/robots/talos_reduced_box.urdf",
    {"tip": "base_link", "inertia": "as_given"},
)


def missing(packages: Iterable[str]) -> list[str]:
    """Those of some distributions that are not installed."""

    def absent(package: str) -> bool:
        try:
            distribution(package)
        except PackageNotFoundError:
            return True
        return False

    return [package for package in dict.fromkeys(packages) if absent(package)]
