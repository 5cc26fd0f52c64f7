"""The example of Lee, Ryu, Cheong 2006, what the paper prints of it, and what had to be chosen."""

from __future__ import annotations

import numpy as np

from models import Arc, Line, Path, Scara, SmoothPath, smooth
from models.machines.scara import Elbow
from models.paths.blends import BlendKind
from ocp.motion.schedule import JointLimits

MM = 1e-3

# printed
POINTS = MM * np.array([(700, 0, 50), (300, 0, 50), (300, 650, 0), (0, 650, 50), (-372, 650, 50)])
REMAINING = 150 * MM
SHAPE: dict[BlendKind, float] = {"cubic": 3.0, "quintic": 1.5}
"""The paper's cubic, and ours that stands beside it in every figure and table."""
SPEED, MEAN_ACCELERATION, JERK = 1.0, 5.0, 200.0  # m/s, m/s^2, m/s^3
REACH = 0.8  # m
PAPER_TIMES = (0.356, 0.628, 0.982, 1.254)  # s, Figure 14
PAPER_GAMMA = {
    30: (0.530, 0.530, 0.693),
    25: (0.495, 0.530, 0.693),
    20: (0.443, 0.530, 0.693),
    15: (0.354, 0.530, 0.693),
}
PAPER_SPEED_ERROR = -0.4  # mm/s
PERIOD = 2e-3  # s; all printed times are multiples of it

# not printed
ARM = Scara(REACH / 2, REACH / 2)
ELBOW: Elbow = "right"
CENTRIPETAL = 5.0  # m/s^2
JOINT_LIMITS = JointLimits([3.0, 3.0, 1.0, 6.0], [15.0, 15.0, 5.0, 30.0], [300.0, 300.0, 200.0, 800.0])

NOTE = (
    "Not printed in the paper: the link lengths (equal, 400 mm each, are assumed) and the side of the elbow (right). "
    "Mean acceleration 5000 mm/s² is read as the mean of the ramp, whose peak is then 5858 mm/s²."
)


def example() -> Path:
    """The paper's line, line and arc."""
    return Path((Line(POINTS[0], POINTS[1]), Line(POINTS[1], POINTS[2]), Arc.through(*POINTS[2:])))


def corner(degrees: float, remaining: float, shape: float, kind: BlendKind = "cubic") -> SmoothPath:
    """A blend between two lines, the vertex at the origin, the first line along -x."""
    angle, leg = np.radians(degrees), 1.5 * remaining
    points = [(-leg, 0, 0), (0, 0, 0), (-leg * np.cos(angle), leg * np.sin(angle), 0)]
    return smooth(Path.through(points), remaining, kind=kind, shape=shape)
