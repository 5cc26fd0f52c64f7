"""Obstacles that move: a shape whose place is a function of time, look-up tables included."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from math import factorial
from typing import Any

import casadi as ca
import numpy as np
from scipy.interpolate import BSpline

from models.arrays import ROUNDING, Array, checked_array, checked_rotation
from models.errors import ModelError
from models.shapes.shapes import HalfSpace, Shape, checked_shape
from models.spatial import Expression, Frame, expression

LINEAR = re.compile(r"casadi_interpn\(res\[0\], 1, (\w+), \w+, (\w+), arg\[0\]")
SPLINE = re.compile(r"nd_boor_eval\)?\([^;]*?,1,(\w+),\w+,(\w+),\w+,(\w+),")
NUMBERS = re.compile(r"static const casadi_(?:real|int) (\w+)\[\d+\] =\s*\{([^}]*)\}")


@dataclass(frozen=True, eq=False)
class MovingObstacle:
    """An obstacle that moves: a part on a conveyor, a target that tumbles.

    Attributes:
        shape: In a frame of its own; no half-space.
        position: Time (s), a casadi symbol -> origin of that frame in world, shape (3,), m. Tables of one argument
            (`casadi.interpolant`, "linear" or "bspline") are written out as polynomials.
        rotation: The same of its axes, as columns. Shape (3, 3). None: those of the world.

    Raises:
        ModelError: No shape, a half-space, functions that give something else, or that change with anything but time;
            a rotation that is none.
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
        for what, given, shape in (("position", self.position, (3, 1)), ("rotation", self.rotation, (3, 3))):
            if given is None and what == "rotation":
                parts.append(ca.SX.eye(3))
                continue
            if not callable(given):
                message = f"moving: {what} must be a function of time, not {given!r}"
                raise ModelError(message, name=what, value=given)
            try:
                value = expand_tables(ca.densify(ca.SX(expression(given(time)))))
            except Exception as error:  # of the function's own, too
                message = f"moving: {what} is no function of a casadi symbol, the time: {error}"
                raise ModelError(message, name=what, value=given) from error
            if value.shape != shape or any(not ca.is_equal(symbol, time) for symbol in ca.symvar(value)):
                message = (
                    f"moving: {what} gives {value.shape} of {ca.symvar(value)}; {shape} of the time alone expected"
                )
                raise ModelError(message, name=what, value=value.shape, limit=shape)
            parts.append(value)
        object.__setattr__(self, "_at", ca.Function("moving", [time], [parts[1], parts[0]]))
        for what, part in zip(("position", "rotation"), parts, strict=True):
            if not ca.symvar(part):
                checked_array(ca.DM(part).full(), part.shape, "moving", what)
        turn = self._at(0.0)[0].full()
        if np.isfinite(turn).all():
            checked_rotation(turn, "moving", "rotation")

    def frame(self, time: Expression) -> Frame:
        """Of its shape in world, at a time (s)."""
        return Frame(*self._at(time))

    def check(self, begin: float, end: float) -> None:
        """Raise ModelError where the position is no number, or the rotation none, at a time between two, s."""
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
    """Return a matrix of SX with its look-up tables written out in elementary operations.

    Raises:
        ModelError: A function that is no table of one argument.
    """
    codes = ca.Function("values", ca.symvar(values), [values])
    if ca.OP_CALL not in {codes.instruction_id(k) for k in range(codes.n_instructions())}:
        return values
    known: dict[int, Any] = {}

    def written(node: Any) -> Any:
        if (key := node.element_hash()) not in known:
            if node.is_output():
                call = node.dep(0)
                inputs = [written(call.dep(k)) for k in range(call.n_dep())]
                known[key] = _table(call.which_function(), inputs)[node.which_output()]
            else:
                parts = [written(node.dep(k)) for k in range(node.n_dep())]
                make = ca.SX.binary if len(parts) == 2 else ca.SX.unary
                known[key] = make(node.op(), *parts) if parts else node
        return known[key]

    return ca.reshape(ca.vertcat(*map(written, ca.vertsplit(ca.vec(values)))), *values.shape)


def _table(function: Any, inputs: list[Any]) -> list[Any]:
    """The values of a table of one argument, polynomials between its knots. Casadi tells its numbers in C alone."""
    code = ca.CodeGenerator("table")
    code.add(function)
    text = code.dump()
    found = {name: np.array(numbers.split(","), dtype=float) for name, numbers in NUMBERS.findall(text)}
    linear = LINEAR.search(text)
    numbers = linear or SPLINE.search(text)
    if len(inputs) != 1 or numbers is None:
        message = f"{function.name()!r}, a {function.class_name()}, is no table of one argument; write it out"
        raise ModelError(message, name=function.name(), value=function.class_name())
    knots, *degree, values = (found[name] for name in numbers.groups())
    order = int(degree[0][0]) if degree else 1
    if linear:  # as a spline of degree 1
        knots = np.concatenate([knots[:1], knots, knots[-1:]])
    curve = BSpline(knots, values.reshape(len(knots) - order - 1, -1), order)
    marks = np.unique(knots)
    pieces = np.array(
        [curve.derivative(k)(marks[:-1]) / factorial(k) if k else curve(marks[:-1]) for k in range(order + 1)]
    )
    x = ca.SX.sym("x")
    table = ca.Function("table", [x], [_polynomials(marks, pieces, x, beyond=bool(linear))])
    tried = np.concatenate([marks, (marks[1:] + marks[:-1]) / 2, marks[:1] - 1.0, marks[-1:] + 1.0])[None]
    one, other = np.array(function(tried)), np.array(table(tried))
    if not np.abs(one - other).max() <= ROUNDING * (1 + np.abs(one).max()):
        message = f"the table {function.name()!r} is written by casadi in a way that is not known; write it out"
        raise ModelError(message, name=function.name(), value=float(np.abs(one - other).max()))
    return list(ca.vertsplit(table(inputs[0])))


def _polynomials(marks: Array, pieces: Array, x: Any, *, beyond: bool) -> Any:
    """The sum of what each piece adds between its ends, where x is held; beyond all ends the outer pieces, or zero."""
    last = len(marks) - 2
    total = ca.SX(ca.DM(pieces[0, 0]))
    for k in range(last + 1):
        held = x if beyond and k == last else ca.fmin(x, marks[k + 1])
        held = held if beyond and k == 0 else ca.fmax(held, marks[k])
        rise = 0.0
        for coefficients in pieces[:0:-1, k]:
            rise = (rise + ca.DM(coefficients)) * (held - marks[k])
        total += rise
    return total if beyond else ca.if_else(ca.logic_and(x >= marks[0], x <= marks[-1]), total, 0.0)
