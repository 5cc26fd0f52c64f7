"""Models of machines: symbolic kinematics, geometry and dynamics, independent of optimisation problems and solvers."""

from models.cts.best_roll import optimal_inverse
from models.cts.rig import Rig, Tunnel
from models.cts.table import solve_table
from models.errors import ModelError, ModelWarning
from models.examples import (
    STANDING_STARTS,
    example_robot,
    paper_example,
    reference_rig,
    reference_tunnel,
    standing_example,
)
from models.machines.collision_scene import CollisionScene
from models.machines.free_floating import FreeFloating
from models.machines.machine import FixedBase, Machine, find_wheels, with_wheels
from models.machines.scara import Scara, scara_along
from models.machines.stance import Foot, Foothold, Stance
from models.machines.standing import Standing
from models.machines.support import Footprint, Support, footprint, rectangle
from models.paths import Arc, Helix, Line, Path, SmoothPath, smooth
from models.robot.dynamics import (
    Wrench,
    base_reaction,
    center_of_mass_jacobian,
    center_of_mass_motion,
    inverse_dynamics,
    mass_matrix,
    momentum,
    momentum_matrix,
    robot_inertia,
)
from models.robot.kinematics import (
    center_of_mass,
    centers_of_mass,
    frame_jacobian,
    link_frames,
    link_jacobians,
    tip_jacobian,
    tip_pose,
)
from models.robot.mjcf import excluded_pairs
from models.robot.parts import CollisionShape, Joint, Link, Mimic, VisualShape
from models.robot.rebuild import (
    add_prefix,
    attach_tool,
    lock_joints,
    merge_robots,
    mount_on_rail,
    move_tip,
    prune,
    reroot,
    simplify,
    subtree,
    with_load,
)
from models.robot.robot import Robot, named_states, planar_chain
from models.robot.urdf import expand_xacro
from models.shapes.shapes import Box, Capsule, Cylinder, HalfSpace, Mesh, MovingObstacle, Sphere
from models.spatial import Frame

__all__ = [
    "STANDING_STARTS", "Arc", "Box", "Capsule", "CollisionScene", "CollisionShape", "Cylinder", "FixedBase", "Foot",
    "Foothold", "Footprint", "Frame", "FreeFloating", "HalfSpace", "Helix", "Joint", "Line", "Link", "Machine", "Mesh",
    "Mimic", "ModelError", "ModelWarning", "MovingObstacle", "Path", "Rig", "Robot", "Scara", "SmoothPath", "Sphere",
    "Stance", "Standing", "Support", "Tunnel", "VisualShape", "Wrench", "add_prefix", "attach_tool", "base_reaction",
    "center_of_mass", "center_of_mass_jacobian", "center_of_mass_motion", "centers_of_mass", "example_robot",
    "excluded_pairs", "expand_xacro", "find_wheels", "footprint", "frame_jacobian", "inverse_dynamics", "link_frames",
    "link_jacobians", "lock_joints", "mass_matrix", "merge_robots", "momentum", "momentum_matrix", "mount_on_rail",
    "move_tip", "named_states", "optimal_inverse", "paper_example", "planar_chain", "prune", "rectangle",
    "reference_rig", "reference_tunnel", "reroot", "robot_inertia", "scara_along", "simplify", "smooth", "solve_table",
    "standing_example", "subtree", "tip_jacobian", "tip_pose", "with_load", "with_wheels",
]  # fmt: skip
