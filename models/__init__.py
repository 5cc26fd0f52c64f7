"""What a machine is: symbolic kinematics, geometry and momentum. Knows nothing of problems or solvers."""

from models.errors import ModelError
from models.machines.footprint import Footprint, footprint
from models.machines.free_floating import FreeFloating
from models.machines.machine import FixedBase, Machine
from models.machines.standing import Standing
from models.machines.support import Support, rectangle
from models.papers import paper_example
from models.robot.dynamics import Wrench, base_reaction, inverse_dynamics
from models.robot.kinematics import (
    center_of_mass,
    center_of_mass_jacobian,
    centers_of_mass,
    frame_jacobian,
    link_frames,
    link_jacobians,
    momentum_matrix,
    robot_inertia,
    tip_jacobian,
    tip_pose,
)
from models.robot.motion import center_of_mass_motion, link_motions, momentum, momentum_rate
from models.robot.parts import Joint, Link
from models.robot.rebuild import (
    attached,
    locked,
    merged,
    pruned,
    renamed,
    rerooted,
    retipped,
    simplified,
    subtree,
    with_load,
)
from models.robot.robot import Robot, planar_chain
from models.spatial import Frame

__all__ = [
    "FixedBase",
    "Footprint",
    "Frame",
    "FreeFloating",
    "Joint",
    "Link",
    "Machine",
    "ModelError",
    "Robot",
    "Standing",
    "Support",
    "Wrench",
    "attached",
    "base_reaction",
    "center_of_mass",
    "center_of_mass_jacobian",
    "center_of_mass_motion",
    "centers_of_mass",
    "footprint",
    "frame_jacobian",
    "inverse_dynamics",
    "link_frames",
    "link_jacobians",
    "link_motions",
    "locked",
    "merged",
    "momentum",
    "momentum_matrix",
    "momentum_rate",
    "paper_example",
    "planar_chain",
    "pruned",
    "rectangle",
    "renamed",
    "rerooted",
    "retipped",
    "robot_inertia",
    "simplified",
    "subtree",
    "tip_jacobian",
    "tip_pose",
    "with_load",
]
