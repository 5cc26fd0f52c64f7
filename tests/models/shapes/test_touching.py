"""A body is put as near to a place as another lets it: IPOPT converges on rounded distances, at second order.

In all of these the nearest points are not one pair: capsules and boxes come to lie flush with faces, edges, each other.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import Box, Capsule, Cylinder, Frame, HalfSpace, Mesh
from models.shapes.distance import distance
from models.shapes.shapes import Shape
from models.spatial import skew

ROUNDING, CLEARANCE = 0.02, 0.02
ROD = Capsule(0.1, (-0.4, 0, 0), (0.4, 0, 0))
CUBE = Box((1, 1, 1))
ALONG_X = Capsule(0.1, (-0.5, 0, 0), (0.5, 0, 0))
CONTACTS: dict[str, tuple[Shape, Shape, list[float]]] = {
    "a rod flush with a face": (ROD, CUBE, [0, 0, 0, 0, 0, 0.5]),
    "a tilted rod on a face": (ROD, CUBE, [0, 0.2, 0, 0, 0, 0.5]),
    "a rod over the rim of a face": (ROD, CUBE, [0, 0, 0.3, 0.5, 0.1, 0.45]),
    "parallel rods": (ROD, ALONG_X, [0, 0, 0, 0, 0.03, 0.05]),
    "parallel rods, one farther along": (ROD, ALONG_X, [0, 0, 0, 0.6, 0.03, 0.05]),
    "crossed rods": (ROD, Capsule(0.1, (0, -0.5, 0), (0, 0.5, 0)), [0, 0, 0, 0.1, 0.03, 0.05]),
    "a box flush with a face": (Box((0.4, 0.4, 0.4)), CUBE, [0, 0, 0, 0.1, 0.05, 0.5]),
    "a box over an edge": (Box((0.4, 0.4, 0.4)), CUBE, [0, 0, 0.3, 0.6, 0.05, 0.55]),
    "a rod on the floor": (ROD, HalfSpace((0, 0, 1), (0, 0, 0)), [0, 0, 0, 0, 0, 0]),
    "a rod on a mesh": (ROD, Mesh(CUBE.core), [0, 0, 0, 0, 0, 0.5]),
    "a rod on a drum": (ROD, Cylinder(0.5, 1.0, (0, 0, 0)), [0, 0, 0, 0.1, 0, 0.4]),
}
STARTS = ([0.05, 0.1, -0.1, 0.1, 0.2, 0.8], [0.1, 0.2, 0.2, -0.2, 0.1, 1.0])


def program(one: Shape, other: Shape, target: list[float], rounding: float) -> tuple[Any, Any, Any]:
    """Pose of the one (vector of the turn, shift), its square from the target, and the distance."""
    x = ca.SX.sym("x", 6)
    angle = ca.sqrt(ca.sumsqr(x[:3]) + 1e-30)
    turned = skew(x[:3])
    turn = ca.DM.eye(3) + ca.sin(angle) / angle * turned + (1 - ca.cos(angle)) / angle**2 * ca.mtimes(turned, turned)
    return x, ca.sumsqr(x - ca.DM(target)), distance(one, other, Frame(turn, x[3:]), rounding=rounding)


def placed(one: Shape, other: Shape, target: list[float], start: list[float], rounding: float) -> tuple[Any, Any, Any]:
    """The nearest pose to a target that is clear, the multiplier of the distance, and what IPOPT says of its way."""
    x, cost, gap = program(one, other, target, rounding)
    quiet = {"print_time": 0, "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 100, "tol": 1e-9}}
    solver = ca.nlpsol("solver", "ipopt", {"x": x, "f": cost, "g": gap}, quiet)
    result = solver(x0=start, lbg=CLEARANCE, ubg=ca.inf)
    return np.array(result["x"]).ravel(), float(result["lam_g"]), solver.stats()


@pytest.mark.parametrize("start", STARTS, ids=("one side", "the other"))
@pytest.mark.parametrize("what", CONTACTS)
def test_ipopt_converges_where_bodies_lie_flush(what: str, start: list[float]) -> None:
    one, other, target = CONTACTS[what]
    x, _, stats = placed(one, other, target, start, ROUNDING)
    assert stats["success"]
    assert stats["iter_count"] <= 40
    before, last = stats["iterations"]["d_norm"][-2:]
    assert last < 0.05 * before
    exact = float(distance(one, other, _frame(x)))
    assert CLEARANCE - 1e-7 <= exact <= CLEARANCE + 3 * ROUNDING


@pytest.mark.parametrize("what", CONTACTS)
def test_newtons_method_has_order_two_where_bodies_lie_flush(what: str) -> None:
    """On the conditions of the optimum: each error is at most a constant times the square of the one before."""
    one, other, target = CONTACTS[what]
    known, multiplier, _ = placed(one, other, target, STARTS[0], ROUNDING)
    x, cost, gap = program(one, other, target, ROUNDING)
    price = ca.SX.sym("price")
    z = ca.vertcat(x, price)
    rest = ca.vertcat(ca.gradient(cost + price * gap, x), gap - CLEARANCE)
    step = ca.Function("step", [z], [rest, ca.jacobian(rest, z)])
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(4):
        at = np.append(known, multiplier) + 1e-5 * rng.normal(size=7)
        path = [at]
        for _ in range(7):
            value, slope = (np.array(part) for part in step(path[-1]))
            path.append(path[-1] - np.linalg.solve(slope, value).ravel())
        errors.append(np.linalg.norm(np.array(path[:-1]) - path[-1], axis=1))
    for first in errors:
        assert first[-1] < 1e-11
        large = first[first > 1e-8]
        following = first[1 : len(large) + 1]
        assert (following <= 2e3 * large**2 + 1e-12).all(), first


def test_without_rounding_it_goes_back_and_forth() -> None:
    one, other, target = CONTACTS["parallel rods"]
    assert not placed(one, other, target, STARTS[0], 0.0)[2]["success"]


def _frame(x: Any) -> Frame:
    angle = max(float(np.linalg.norm(x[:3])), 1e-300)
    axis = x[:3] / angle
    turned = np.array(ca.DM(skew(axis)))
    turn = np.eye(3) + np.sin(angle) * turned + (1 - np.cos(angle)) * turned @ turned
    return Frame(turn, x[3:].reshape(3, 1))
