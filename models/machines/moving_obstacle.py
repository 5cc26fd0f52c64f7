"""Moving obstacles: shapes whose pose is a function of time, possibly given by look-up tables."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from math import factorial
from typing import Any

import casadi as ca
import numpy as np
import scipy

from models.arrays import ROUNDING, Array, checked_array, checked_rotation
from models.errors import ModelError
from models.shapes.shapes import HalfSpace, Shape, checked_shape
from models.spatial import Expression, Frame, expression

LINEAR = re.compile(r"casadi_interpn\(res\[0\], 1, (\w+), \w+, (\w+), arg\[0\]")
SPLINE = re.compile(r"nd_boor_eval\)?\([^;]*?,1,(\w+),\w+,(\w+),\w+,(\w+),")
NUMBERS = re.compile(r"static const casadi_(?:real|int) (\w+)\[\d+\] =\s*\{([^}]*)\}")


@dataclass(frozen=True, eq=False)
class MovingObstacle:
    """An obstacle with a prescribed motion, such as a part on a conveyor or a tumbling target.

    Attributes:
        shape: Shape in a frame of its own; not a half-space.
        position: Function from time (s, a CasADi symbol) to the origin of that frame in world, shape (3,), m. Tables
            with one argument (`casadi.interpolant`, "linear" or "bspline") are converted to polynomials.
        rotation: The same for its axes, as columns. Shape (3, 3). None: those of the world.

    Raises:
        ModelError: An invalid shape, a half-space, functions that return something else or depend on more than time, an
            invalid rotation.
    """

    shape: Shape
    position: Callable[[Any], Any]
    rotation: Callable[[Any], Any] | None = None
    _at: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if isinstance(checked_shape(self.shape, "moving", "shape"), HalfSpace):
            message = "moving: a half-space cannot move; give a box that is large enough"
            raise ModelError(message, name="shape", value=self.shape)
        time = ca.SX.sym("time")
        parts = []
        for name, function, shape in (("position", self.position, (3, 1)), ("rotation", self.rotation, (3, 3))):
            if function is None and name == "rotation":
                parts.append(ca.SX.eye(3))
                continue
            if not callable(function):
                message = f"moving: {name} must be a function of time, not {function!r}"
                raise ModelError(message, name=name, value=function)
            try:
                value = expand_tables(ca.densify(ca.SX(expression(function(time)))))
            except Exception as error:  # also errors inside the function
                message = f"moving: {name} is no function of a casadi symbol, the time: {error}"
                raise ModelError(message, name=name, value=function) from error
            if value.shape != shape or any(not ca.is_equal(symbol, time) for symbol in ca.symvar(value)):
                message = (
                    f"moving: {name} gives {value.shape} of {ca.symvar(value)}; {shape} of the time alone expected"
                )
                raise ModelError(message, name=name, value=value.shape, limit=shape)
            parts.append(value)
        object.__setattr__(self, "_at", ca.Function("moving", [time], [parts[1], parts[0]]))
        for name, part in zip(("position", "rotation"), parts, strict=True):
            if not ca.symvar(part):
                checked_array(ca.DM(part).full(), part.shape, "moving", name)
        turn = self._at(0.0)[0].full()
        if np.isfinite(turn).all():
            checked_rotation(turn, "moving", "rotation")

    def frame(self, time: Expression) -> Frame:
        """Return the frame of the shape in world at a time (s)."""
        return Frame(*self._at(time))

    def check(self, begin: float, end: float) -> None:
        """Raise ModelError if the pose is invalid at a sampled time between `begin` and `end` (s)."""
        times = np.linspace(begin, end, 513)
        turns, places = (np.array(part) for part in self._at(times[None]))
        broken = ~np.isfinite(places).all(axis=0)
        if broken.any():
            time = float(times[broken.argmax()])
            value = places[:, broken.argmax()].tolist()
            message = f"moving: position {value} is not finite, at {time:g} s"
            raise ModelError(message, name="position", value=value, time=time)
        for turn, time in zip(turns.reshape(3, -1, 3).transpose(1, 0, 2), times.tolist(), strict=True):
            try:
                checked_rotation(turn, "moving", "rotation")
            except ModelError as error:
                raise ModelError(f"{error}, at {time:g} s", **{**vars(error), "time": time}) from error


def expand_tables(values: Any) -> Any:
    """Return an SX matrix with its look-up tables written out in elementary operations.

    Raises:
        ModelError: It calls a function that is not a table of one argument.
    """
    instructions = ca.Function("values", ca.symvar(values), [values])
    if ca.OP_CALL not in {instructions.instruction_id(k) for k in range(instructions.n_instructions())}:
        return values
    expanded: dict[int, Any] = {}

    def expand(node: Any) -> Any:
        if (key := node.element_hash()) not in expanded:
            if node.is_output():
                call = node.dep(0)
                inputs = [expand(call.dep(k)) for k in range(call.n_dep())]
                expanded[key] = _table(call.which_function(), inputs)[node.which_output()]
            else:
                parts = [expand(node.dep(k)) for k in range(node.n_dep())]
                operation = ca.SX.binary if len(parts) == 2 else ca.SX.unary
                expanded[key] = operation(node.op(), *parts) if parts else node
        return expanded[key]

    return ca.reshape(ca.vertcat(*map(expand, ca.vertsplit(ca.vec(values)))), *values.shape)


def _table(function: Any, inputs: list[Any]) -> list[Any]:
    """Return the values of a table of one argument as polynomials. CasADi reveals its data only in generated C code."""
    code = ca.CodeGenerator("table")
    code.add(function)
    text = code.dump()
    arrays = {name: np.array(numbers.split(","), dtype=float) for name, numbers in NUMBERS.findall(text)}
    linear = LINEAR.search(text)
    numbers = linear or SPLINE.search(text)
    if len(inputs) != 1 or numbers is None:
        message = f"{function.name()!r}, a {function.class_name()}, is no table of one argument; write it out"
        raise ModelError(message, name=function.name(), value=function.class_name())
    knots, *degree, values = (arrays[name] for name in numbers.groups())
    order = int(degree[0][0]) if degree else 1
    if linear:  # as a spline of degree 1
        knots = np.concatenate([knots[:1], knots, knots[-1:]])
    curve = scipy.interpolate.BSpline(knots, values.reshape(len(knots) - order - 1, -1), order)
    breaks = np.unique(knots)
    coefficients = np.array(
        [curve.derivative(k)(breaks[:-1]) / factorial(k) if k else curve(breaks[:-1]) for k in range(order + 1)]
    )
    x = ca.SX.sym("x")
    table = ca.Function("table", [x], [_polynomials(breaks, coefficients, x, beyond=bool(linear))])
    samples = np.concatenate([breaks, (breaks[1:] + breaks[:-1]) / 2, breaks[:1] - 1.0, breaks[-1:] + 1.0])[None]
    expected, actual = np.array(function(samples)), np.array(table(samples))
    if not np.abs(expected - actual).max() <= ROUNDING * (1 + np.abs(expected).max()):
        message = f"the table {function.name()!r} is not generated by CasADi in a known form; write it out"
        raise ModelError(message, name=function.name(), value=float(np.abs(expected - actual).max()))
    return list(ca.vertsplit(table(inputs[0])))


def _polynomials(breaks: Array, coefficients: Array, x: Any, *, beyond: bool) -> Any:
    """Return a piecewise polynomial as a sum of the increments over its segments.

    Outside all breakpoints the end segments continue if `beyond`, else the value is zero.
    """
    last = len(breaks) - 2
    total = ca.SX(ca.DM(coefficients[0, 0]))
    for k in range(last + 1):
        clipped = x if beyond and k == last else ca.fmin(x, breaks[k + 1])
        clipped = clipped if beyond and k == 0 else ca.fmax(clipped, breaks[k])
        increment = 0.0
        for factors in coefficients[:0:-1, k]:
            increment = (increment + ca.DM(factors)) * (clipped - breaks[k])
        total += increment
    return total if beyond else ca.if_else(ca.logic_and(x >= breaks[0], x <= breaks[-1]), total, 0.0)
