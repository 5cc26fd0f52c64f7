"""Ends of the reachable arcs of roll by the limits of joint 1: roots of a trigonometric polynomial of degree 4."""

from __future__ import annotations

from typing import Any

import casadi as ca

from models.cts import Branch, Rig, corner_circle
from models.cts_roll import ANGLE_INSET, sharper, yaw_chart
from models.harmonics import polish
from models.series import Series, added, product, series_roots
from models.spatial import Expression


def slide_ends(rig: Rig, branch: Branch, upper: bool) -> Any:
    """Function of the target -> ends of the reachable arcs by one limit of joint 1, and points that mean nothing.

    Output shape (2, 8): rows cosine and sine of the roll.
    """
    t, points = ca.SX.sym("target", 5), ca.SX.sym("points", 2, 8)
    slope = sharper(yaw_chart(rig, branch), t, 2, slide_limit(rig, upper))
    sharp = [ca.vertcat(*polish((points[0, k], points[1, k]), slope)) for k in range(8)]
    polished = ca.Function("polished", [t, points], [ca.horzcat(*sharp)])
    target = ca.MX.sym("target", 5)
    found = polished(target, slide_points(rig, upper)(target))
    return ca.Function("slide_ends", [target], [found], ["target"], ["points"])


def slide_limit(rig: Rig, upper: bool) -> float:
    """Position of joint 1 just inside one of its limits, m."""
    return float((rig.upper if upper else rig.lower)[0] + (-1 if upper else 1) * ANGLE_INSET)


def slide_points(rig: Rig, upper: bool) -> Any:
    """Function of the target -> points near the ends of arcs by one limit of joint 1. Output shape (2, 8)."""
    limit = slide_limit(rig, upper)
    t = ca.SX.sym("target", 5)
    axle, e_c, e_s = corner_circle(rig, t)
    s_yaw, c_yaw = ca.sin(t[3]), ca.cos(t[3])
    lg = rig.goose_neck

    def first(constant: Expression, row: int) -> Series:
        return [(constant, 0.0), (lg * e_c[row], lg * e_s[row])]

    x = first(axle[0] - rig.yaw_link_2 * c_yaw + rig.yaw_offset * s_yaw - limit, 0)
    y = first(axle[1] - rig.yaw_link_2 * s_yaw - rig.yaw_offset * c_yaw, 1)
    height = product(first(axle[2], 2), first(axle[2], 2))
    stretched = added([(rig.pitch_link**2, 0.0)], height, -1)
    known = added(added(product(x, x), product(y, y)), added(stretched, [(rig.yaw_link_1**2, 0.0)], -1))
    along = added([(c_yaw * a, c_yaw * b) for a, b in x], [(s_yaw * a, s_yaw * b) for a, b in y])
    f = added(product(known, known), product(stretched, product(along, along)), -4)
    outputs = ca.cse([ca.vertcat(ca.horzcat(*[a for a, _ in f]), ca.horzcat(*[b for _, b in f]))])
    coefficients = ca.Function("slide", [t], outputs)
    target = ca.MX.sym("target", 5)
    return ca.Function("slide_points", [target], [series_roots(4)(coefficients(target))], ["target"], ["points"])
