"""Tables of data as smooth functions: interpolating splines that continue beyond their edges.

Aerodynamic coefficients, engine maps and atmospheres are given as tables. Optimisation needs functions with two
continuous derivatives wherever an iterate or an integrator may go, also beyond the data. Inside its points a
:class:`Table` is the interpolating cubic spline with the condition "not a knot" (de Boor, A Practical Guide to Splines,
chapter IV), of fourth order. Beyond them it continues with the value, slope and curvature of the edge. In several
arguments it is the tensor product of such splines.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import factorial
from typing import Any

import casadi as ca
import numpy as np
import scipy

from ocp.errors import ProblemError, require

DEGREE = 3


class Table:
    """Spline function of one or several arguments that interpolates a table of data; :func:`table` builds it.

    Attributes:
        points: Points of each argument, increasing. Shape (n,) each.
        values: Values at the points, one axis for each argument.
        bounds: Smallest and largest point of each argument, for ``problem.watch("in the table", mach, *bounds[0])``:
            then the audit checks that the plan stays within the data.
    """

    def __init__(self, points: Sequence[np.ndarray], values: np.ndarray) -> None:
        self.points, self.values = tuple(points), values
        self.bounds = tuple((float(axis[0]), float(axis[-1])) for axis in self.points)
        arguments = [ca.SX.sym(f"x{i}") for i in range(len(self.points))]
        # one argument after another: the values at all points of the others
        remaining: Any = ca.SX(ca.DM(values.reshape(len(self.points[0]), -1)))
        for k, (axis, argument) in enumerate(zip(self.points, arguments, strict=True)):
            row = _weights(axis, argument).T @ remaining
            if k + 1 < len(self.points):
                count = len(self.points[k + 1])
                remaining = ca.reshape(row, row.numel() // count, count).T
        self.function = ca.Function("table", arguments, [row], {"cse": True})

    def __call__(self, *arguments: Any) -> Any:
        """Return the value for numbers or for scalar expressions, SX or MX; a float if all arguments are numbers."""
        if len(arguments) != len(self.points):
            words = f"the table has {len(self.points)} arguments, not {len(arguments)}"
            raise ProblemError(words, name="arguments", value=len(arguments), limit=len(self.points))
        value = self.function(*arguments)
        return float(value) if isinstance(value, ca.DM) else value

    def __repr__(self) -> str:
        return f"<Table of {' x '.join(str(len(axis)) for axis in self.points)} values>"


def table(points: Any, values: Any) -> Table:
    """Return a spline function, with two continuous derivatives, that interpolates a table of data.

    Args:
        points: Points of the argument, increasing, (n,); for several arguments a tuple of such arrays.
        values: Values at the points: one axis for each argument, (n,) or (n, m).

    Raises:
        ProblemError: Points that do not increase, fewer than two points, another shape of the values, or an entry that
            is not finite.
    """
    axes = points if isinstance(points, tuple) else (points,)
    arrays = [require.array(f"points of argument {k}", axis, ("n",), least=2) for k, axis in enumerate(axes)]
    for k, axis in enumerate(arrays):
        if not (np.diff(axis) > 0).all():
            words = f"the points of argument {k} must increase, not {axis.tolist()}"
            raise ProblemError(words, name="points", value=axis.tolist())
    data = require.array("values", values, tuple(len(axis) for axis in arrays))
    return Table(arrays, data)


def _weights(points: np.ndarray, x: Any) -> Any:
    """Return the weights of the data at n points in the value of the interpolating spline at ``x``. Shape (n, 1).

    The coefficients of the piece that contains ``x`` are the first ones plus the differences at the knots passed, whose
    derivatives vanish.
    """
    degree = min(DEGREE, len(points) - 1)
    spline = scipy.interpolate.make_interp_spline(points, np.eye(len(points)), k=degree)
    starts = np.unique(spline.t)[:-1]  # the knots at the ends are repeated
    origins = np.concatenate([points[:1], starts, points[-1:]])
    taylor = np.array([spline(origins, order) / factorial(order) for order in range(max(degree, 2) + 1)])
    taylor[3:, [0, -1]] = 0.0  # beyond the edges it continues with value, slope and curvature
    passed = [ca.SX(1), *(x >= float(knot) for knot in origins[1:])]
    origin = sum(ca.SX(float(step)) * flag for step, flag in zip(np.diff(origins, prepend=0.0), passed, strict=True))
    local, result, power = x - origin, ca.SX(len(points), 1), ca.SX(1)
    for steps in np.diff(taylor, axis=1, prepend=0.0):  # of the coefficients, at the knots
        result += power * (ca.SX(ca.DM(steps.T)) @ ca.vertcat(*passed))
        power = power * local
    return result
