"""Read and write files: tool paths from waypoints and G-code, joint trajectories, plans as logs and robot programs."""

from ocp.app.files.exchange import log_rerun, write_mcap, write_robot_program
from ocp.app.files.gcode import read_gcode
from ocp.app.files.program import Cut, Note, Pause, Program, ProgramMotion, Rapid, Section, TimedProgram
from ocp.app.files.settings import read_joint_limits
from ocp.app.files.trajectory import RawTrajectory, read_trajectory
from ocp.app.files.waypoints import Waypoints, read_waypoints

__all__ = [
    "Cut",
    "Note",
    "Pause",
    "Program",
    "ProgramMotion",
    "Rapid",
    "RawTrajectory",
    "Section",
    "TimedProgram",
    "Waypoints",
    "log_rerun",
    "read_gcode",
    "read_joint_limits",
    "read_trajectory",
    "read_waypoints",
    "write_mcap",
    "write_robot_program",
]
