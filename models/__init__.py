"""What a machine is: symbolic kinematics, geometry and momentum. Knows nothing of problems or solvers."""

from models.errors import ModelError
from models.free_floating import FreeFloating, paper_example
from models.kinematics import (
    center_of_mass,
    center_of_mass_jacobian,
    centers_of_mass,
    frame_jacobian,
    link_frames,
    momentum_matrix,
    robot_inertia,
    tip_jacobian,
    tip_pose,
)
from models.machine import FixedBase, Machine
from models.parts import Joint, Link
from models.robot import Robot, planar_chain
from models.spatial import Frame

__all__ = [
    "FixedBase",
    "Frame",
    "FreeFloating",
    "Joint",
    "Link",
    "Machine",
    "ModelError",
    "Robot",
    "center_of_mass",
    "center_of_mass_jacobian",
    "centers_of_mass",
    "frame_jacobian",
    "link_frames",
    "momentum_matrix",
    "paper_example",
    "planar_chain",
    "robot_inertia",
    "tip_jacobian",
    "tip_pose",
]
