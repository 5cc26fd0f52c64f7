"""Files: tool paths from waypoints and from G-code, anybody's trajectories, plans as logs and in Rerun."""

from ocp.files.gcode import read_gcode
from ocp.files.mcap import write_mcap
from ocp.files.program import Cut, Note, Pause, Program, ProgramMotion, Rapid, Stretch, TimedProgram
from ocp.files.rerun import log_rerun
from ocp.files.trajectory import RawTrajectory, read_trajectory
from ocp.files.waypoints import Waypoints, read_waypoints

__all__ = [
    "Cut",
    "Note",
    "Pause",
    "Program",
    "ProgramMotion",
    "Rapid",
    "RawTrajectory",
    "Stretch",
    "TimedProgram",
    "Waypoints",
    "log_rerun",
    "read_gcode",
    "read_trajectory",
    "read_waypoints",
    "write_mcap",
]
