"""Time parametrisation of paths: jerk-limited motions at the requested speed wherever the limits allow it."""

from ocp.motion.schedule.limits import JointLimits, JointPath, JointRates, LineLimits, PathLike, ToolLimits, TorqueRates
from ocp.motion.schedule.planner import Dip, Schedule, schedule
from ocp.motion.schedule.ramps import peak_acceleration
from ocp.motion.schedule.trajectory import JointTrajectory, joint_motion, joint_trajectory
from ocp.motion.tasks.speed_profile import LineMotion, SpeedProfile, ramp_distance, ramp_time

__all__ = [
    "Dip", "JointLimits", "JointPath", "JointRates", "JointTrajectory", "LineLimits", "LineMotion", "PathLike",
    "Schedule", "SpeedProfile", "ToolLimits", "TorqueRates", "joint_motion", "joint_trajectory",
    "peak_acceleration", "ramp_distance", "ramp_time", "schedule",
]  # fmt: skip
