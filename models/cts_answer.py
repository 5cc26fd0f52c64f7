"""What the search for the best roll answers with: joints, cost, the active constraint, or the reason for none."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from models.cts import Branch, Rig, corner_circle, joints_of, posture_at
from models.cts_convex import unrolled
from models.cts_roll import level_points, sharp_level, simple_ends, verdict, yaw_chart, yaw_levels
from models.harmonics import Point
from models.spatial import Expression

SIZE = 6
"""Entries of a state of the search: cost, cosine, sine and code of the best roll, and the least costs of rolls that
meet everything but the lower, or upper, limit of joint 1."""


def finish(rig: Rig, branch: Branch) -> Any:
    """Function (target, previous, state) -> answer with the best roll."""
    target, previous, state = ca.SX.sym("target", 5), ca.SX.sym("previous"), ca.SX.sym("state", SIZE)
    cost, c, s, code = ca.vertsplit(state[:4])
    found = answer(rig, branch, target, previous, c, s, cost, code, 0)
    return ca.Function("finish", [target, previous, state], ca.cse([found]))


def reason(rig: Rig, branch: Branch) -> Any:
    """Function (target) -> answer where no roll will do: without joints, with the status that tells why."""
    target, rig = ca.SX.sym("target", 5), rig.unlimited()
    axle, e_c, _ = corner_circle(rig, target)
    pitch = ca.fabs(axle[2]) - rig.goose_neck * ca.fabs(e_c[2]) <= rig.pitch_link
    points: list[Point] = [(1.0, 0.0)]
    points += [(end.c, end.s) for end in simple_ends(rig, target, branch)]
    chart = yaw_chart(rig, branch)
    for level in yaw_levels(rig, target, branch):
        rough, above = level_points(rig, target, level.cosine), 1 if level.above else -1
        points += [sharp_level(rig, chart, target, level.cosine, above, point) for point in rough]
    yaw: Expression = 0
    for c, s in points:
        posture = posture_at(rig, target, c, s, branch)
        yaw = ca.logic_or(yaw, verdict(rig, target, posture, c, s).relaxed())
    status = ca.if_else(pitch, ca.if_else(yaw, 4, 3), 2)
    result = ca.vertcat(ca.DM.ones(7) * np.nan, 0, status)
    return ca.Function("reason", [target], ca.cse([result]))


def answer(
    rig: Rig,
    branch: Branch,
    target: Expression,
    previous: Expression,
    c: Expression,
    s: Expression,
    cost: Expression,
    code: Expression,
    status: Expression,
) -> Expression:
    """Joints and index, nan unless the status is 0, code of ACTIVE and of STATUS. Shape (9, 1)."""
    roll = unrolled(rig, c, s, previous)
    joints = joints_of(rig, target, roll, posture_at(rig, target, c, s, branch))
    spoilt = ca.if_else(ca.SX(status) == 0, 0, np.nan)
    return ca.vertcat(joints + spoilt, cost + spoilt, code, status)
