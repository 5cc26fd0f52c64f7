"""Reorientation of an asymmetric rigid body in least time.

q' = (w, 0) o q / 2 (scalar last), J w' = u - w x J w, |u| <= 50, by 150 degrees about the first axis, rest to rest.
Turning about that axis alone is an extremal of 34.3 s, but no minimum. Betts, 2010; PSOPT, example reorientation, where
the last entry of q is a control beside the unit norm; here it is a state, whose norm the dynamics keep.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import PSOPT, Entry, line

INERTIA = np.array([5621.0, 4547.0, 2364.0])
ANGLE = np.deg2rad(150.0)


def build() -> Problem:
    start, end = [0.0, 0.0, 0.0, 1.0], [np.sin(ANGLE / 2), 0.0, 0.0, np.cos(ANGLE / 2)]
    problem = Problem("reorientation")
    q = problem.state("q", initial=start, terminal=end, lower=-1.0, upper=1.0, guess=line(start, end, 40.0))
    w = problem.state("w", initial=np.zeros(3), terminal=np.zeros(3), lower=-0.5, upper=0.5, unit="rad/s")
    u = problem.control("u", 3, lower=-50.0, upper=50.0, guess=50.0)
    horizon = problem.horizon(lower=25.0, upper=35.0, guess=30.0)
    vector, scalar = q[:3], q[3]
    problem.dynamics(q, ca.vertcat(scalar * w + ca.cross(vector, w), -ca.dot(vector, w)) / 2)
    problem.dynamics(w, (u - ca.cross(w, INERTIA * w)) / INERTIA)
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry(
    "reorientation", (PSOPT,), build, {PSOPT: 28.63041}, method=Collocation(60, 3),
    second=Collocation(85, 3, "legendre"),
)  # fmt: skip
