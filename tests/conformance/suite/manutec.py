"""Manutec R3 robot: a motion of its first three joints of least control energy.

Three links of the model of Otter & Tuerk, DFVLR, 1988: the first turns about the vertical, the next two about parallel
horizontal axes, x in the frames of the links. Rotors turn with their gear ratios; the third is carried by the second
link, which couples both accelerations. Torques are (-126, 252, 72) Nm/V times the voltages, |u| <= 7.5 V. From (0,
-1.5, 0) to (1, -1.95, 1) rad, at rest, in 0.53 s, least int |u|^2 dt. Von Stryk & Schlemmer, 1994; PSOPT, example
manutec. The equations of motion are Lagrange's.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import PSOPT, Entry

GRAVITY = 9.81
MASSES, CENTRES = (56.5, 60.3), ([0.172, 0.0, 0.205], [0.028, 0.0, 0.202])  # kg, m
INERTIAS = (  # about the centres of mass, kg m^2
    np.array([[2.58, 0.0, -0.46], [0.0, 2.73, 0.0], [-0.46, 0.0, 0.64]]),
    np.array([[5.41, 0.0, 0.33], [0.0, 5.60, 0.0], [0.33, 0.0, 0.39]]),
)
LENGTH, BASE, ROTOR = 0.5, 1.16, 1.3e-3  # m, kg m^2, kg m^2
GEARS = (-105.0, 210.0, 60.0)
TORQUES = ca.DM([-126.0, 252.0, 72.0])  # Nm/V


def energies(q: Any, v: Any) -> tuple[Any, Any]:
    """Kinetic and potential energy of links and rotors at joint angles and rates."""
    kinetic = BASE * v[0] ** 2 / 2 + sum(ROTOR * g**2 * v[i] ** 2 / 2 for i, g in enumerate(GEARS))
    kinetic += ROTOR * GEARS[2] * v[1] * v[2]
    potential = 0.0
    tilt, turn = q[1], v[1]
    joint = joint_velocity = ca.SX.zeros(3)
    for mass, centre, inertia, k in zip(MASSES, CENTRES, INERTIAS, (1, 2), strict=True):
        if k == 2:
            tilt, turn = q[1] + q[2], v[1] + v[2]
        s, c = ca.sin(tilt), ca.cos(tilt)
        vertical = ca.vertcat(0, s, c)  # in the frame of the link
        spin = ca.vertcat(turn, s * v[0], c * v[0])
        velocity = joint_velocity if k == 1 else _tilted(joint_velocity, q[2])
        moving = velocity + ca.cross(spin, ca.DM(centre))
        kinetic += mass * ca.sumsqr(moving) / 2 + ca.dot(spin, ca.DM(inertia) @ spin) / 2
        potential += mass * GRAVITY * (joint[2] + ca.dot(vertical, ca.DM(centre)))
        if k == 1:
            arm = ca.DM([0.0, 0.0, LENGTH])
            joint, joint_velocity = ca.vertcat(0, 0, LENGTH * c), ca.cross(spin, arm)
    return kinetic, potential


def _tilted(vector: Any, angle: Any) -> Any:
    """A vector of the frame before a joint in the frame behind it."""
    s, c = ca.sin(angle), ca.cos(angle)
    return ca.vertcat(vector[0], c * vector[1] + s * vector[2], -s * vector[1] + c * vector[2])


def build() -> Problem:
    problem = Problem("Manutec R3")
    q = problem.state(
        "q", initial=[0.0, -1.5, 0.0], terminal=[1.0, -1.95, 1.0], lower=[-2.97, -2.01, -2.86], upper=[2.97, 2.01, 2.86]
    )
    v = problem.state("v", initial=np.zeros(3), terminal=np.zeros(3), lower=[-3.0, -1.5, -5.2], upper=[3.0, 1.5, 5.2])
    u = problem.control("u", 3, lower=-7.5, upper=7.5, guess=0.0, unit="V")
    problem.horizon(0.53)
    kinetic, potential = energies(q, v)
    momentum = ca.gradient(kinetic, v)
    inertia = ca.jacobian(momentum, v)
    force = TORQUES * u + ca.gradient(kinetic - potential, q) - ca.jacobian(momentum, q) @ v
    problem.dynamics(q, v)
    problem.dynamics(v, ca.solve(inertia, force))
    problem.minimize(running=ca.sumsqr(u))
    return problem


ENTRY = Entry("manutec", (PSOPT,), build, {PSOPT: 20.4061}, method=Collocation(20, 4))
