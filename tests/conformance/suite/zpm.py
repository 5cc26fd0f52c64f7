"""Zero-propellant manoeuvre of the space station by its control-moment gyros.

Attitude q relative to the orbital frame (scalar first), angular rate w, momentum h of the gyros; the control is the
attitude qc that the feedback u = J (2 Kp Tc(qc)^T q + Kd (w - w0(qc))) is asked for. q' = T(q) (w - w0(q)) / 2, J w' =
gravity gradient - w x J w - u, h' = u - w x h, 7200 s between two torque-equilibrium attitudes; |h|^2 <= gamma, |h'| <=
200 ft lb, |qc|^2 within 2e-4 of 1, and the ends of q within 1e-4. Least 0.1 gamma + int |u|^2 dt. Bhatt, 2007; PSOPT,
example zpm, case 2, which its solvers do not end within 120 s; the library reports 6.680107e6 after 153 s.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import PSOPT, Entry, line

RATE, PROPORTIONAL, DERIVATIVE, GYROS = 1.1475e-3, 0.000128, 0.015846, 3 * 3600.0
INERTIA = np.array([
    [18836544.0, 3666370.0, 2965301.0], [3666370.0, 27984088.0, -1129004.0], [2965301.0, -1129004.0, 39442649.0],
])  # fmt: skip
START, END = [0.98996, 0.02650, -0.07891, 0.11422], [0.70531, -0.06201, -0.03518, -0.70531]
MOMENTA = [1000.0, -500.0, -4200.0], [-9.0, -3557.0, -135.0]  # ft lb s
DURATION, SLACK, NORM_SLACK, TORQUE = 7200.0, 1e-4, 2e-4, 200.0
MOMENTUM = 1e3  # ft lb s, the unit of the momentum
GAMMA = 0.1


def rows(q: Any) -> Any:
    """Matrix T of the kinematics of a quaternion, (4, 3)."""
    return ca.vertcat(
        ca.horzcat(-q[1], -q[2], -q[3]), ca.horzcat(q[0], -q[3], q[2]), ca.horzcat(q[3], q[0], -q[1]),
        ca.horzcat(-q[2], q[1], q[0]),
    )  # fmt: skip


def orbital_rate(q: Any) -> Any:
    """Angular rate of the orbital frame in that of the body."""
    return -RATE * ca.vertcat(
        2 * (q[1] * q[2] + q[0] * q[3]), 1 - 2 * (q[1] ** 2 + q[3] ** 2), 2 * (q[2] * q[3] - q[0] * q[1])
    )


def build() -> Problem:
    rates = [np.array(ca.DM(orbital_rate(ca.DM(q)))).ravel() for q in (START, END)]
    inertia = ca.DM(INERTIA)
    problem = Problem("zero-propellant manoeuvre")
    q = problem.state(
        "q", 4, lower=[-1.0, -0.2, -0.2, -1.0], upper=[1.0, 0.2, 0.2, 1.0], guess=line(START, END, DURATION)
    )
    w = problem.state("w", initial=rates[0], terminal=rates[1], lower=-1e-2, upper=1e-2, scale=1e-3, unit="rad/s")
    scaled = [np.array(value) / MOMENTUM for value in MOMENTA]
    h = problem.state("h", initial=scaled[0], terminal=scaled[1], lower=-8.0, upper=8.0, unit="1000 ft lb s")
    gamma = problem.free_parameter("gamma", lower=0.0, upper=(GYROS / MOMENTUM) ** 2, guess=(GYROS / MOMENTUM) ** 2)
    c = problem.control("qc", 4, lower=-1.0, upper=1.0, guess=line(START, END, DURATION))
    problem.horizon(DURATION)
    torque = inertia @ (PROPORTIONAL * 2 * rows(c).T @ q + DERIVATIVE * (w - orbital_rate(c)))
    down = ca.vertcat(2 * (q[1] * q[3] - q[0] * q[2]), 2 * (q[2] * q[3] + q[0] * q[1]), 1 - 2 * (q[1] ** 2 + q[2] ** 2))
    gradient = 3 * RATE**2 * ca.cross(down, inertia @ down)
    momentum_rate = torque - ca.cross(w, MOMENTUM * h)
    problem.dynamics(q, rows(q) @ (w - orbital_rate(q)) / 2)
    problem.dynamics(w, ca.solve(inertia, gradient - ca.cross(w, inertia @ w) - torque))
    problem.dynamics(h, momentum_rate / MOMENTUM)
    problem.start("attitude", q, np.array(START) - SLACK, np.array(START) + SLACK)
    problem.end("attitude at the end", q, np.array(END) - SLACK, np.array(END) + SLACK)
    problem.path("norm", ca.sumsqr(q), 1 - NORM_SLACK, 1 + NORM_SLACK)
    problem.path("norm of the command", ca.sumsqr(c), 1 - NORM_SLACK, 1 + NORM_SLACK)
    problem.path("momentum", ca.sumsqr(h) - gamma, upper=0.0)
    problem.path("torque", ca.sumsqr(momentum_rate / TORQUE), upper=1.0)
    problem.minimize(running=ca.sumsqr(torque), terminal=GAMMA * MOMENTUM**2 * gamma)
    return problem


ENTRY = Entry(
    "zpm", (PSOPT,), build, {PSOPT: "6.680107e6"}, method=Collocation(40, 4), second=Collocation(60, 3, "legendre")
)
