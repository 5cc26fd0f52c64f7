"""Files: tool paths from waypoints and from G-code, plans as logs."""

from ocp.files.gcode import read_gcode
from ocp.files.mcap import write_mcap
from ocp.files.program import Cut, Note, Pause, Program, ProgramMotion, Rapid, Stretch, TimedProgram
from ocp.files.waypoints import Waypoints, read_waypoints

__all__ = [
    "Cut",
    "Note",
    "Pause",
    "Program",
    "ProgramMotion",
    "Rapid",
    "Stretch",
    "TimedProgram",
    "Waypoints",
    "read_gcode",
    "read_waypoints",
    "write_mcap",
]
