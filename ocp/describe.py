"""A declared problem as text."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca

if TYPE_CHECKING:
    from ocp.problem import Constraint, Declarations, Variable

__all__ = ["describe"]

WIDTH = 100


def describe(name: str, declared: Declarations) -> str:
    """States, controls, parameters, horizon, dynamics, constraints and cost by name, one a line."""
    lines = [f"Problem {name!r}"]
    horizon = declared.horizon
    if horizon is None:
        lines.append("  horizon      not declared")
    elif horizon.fixed:
        lines.append(f"  horizon      {column(horizon.lower)} s")
    else:
        lines.append(f"  horizon      free in [{column(horizon.lower)}, {column(horizon.upper)}] s")
    for state in declared.states.values():
        ends = [f"{k} {column(v)}" for k, v in (("initial", state.initial), ("terminal", state.terminal)) if set_(v)]
        lines.append(f"  state        {variable(state)}{''.join('; ' + end for end in ends)}")
    lines += [f"  control      {variable(control)}" for control in declared.controls.values()]
    lines += [f"  parameter    {p.name} ({p.size})" for p in declared.parameters.values()]
    lines += [f"  d{state}/dt = {short(rate)}" for state, rate in declared.dynamics.items()]
    for kind in ("path", "start", "end"):
        lines += [f"  {kind:<12} {constraint(c)}" for c in getattr(declared, kind).values()]
    if declared.running is not None:
        lines.append(f"  minimize     integral of {short(declared.running)} dt + {short(declared.terminal)}")
    return "\n".join(lines)


def variable(item: Variable) -> str:
    bounds = "" if unbounded(item) else f" in [{column(item.lower)}, {column(item.upper)}]"
    return f"{item.name} ({item.size}){bounds}"


def constraint(item: Constraint) -> str:
    return f"{item.name} ({item.size}): {column(item.lower)} <= {short(item.expression)} <= {column(item.upper)}"


def unbounded(item: Variable) -> bool:
    return column(item.lower) == "-inf" and column(item.upper) == "inf"


def set_(value: Any) -> bool:
    return column(value) != "nan"


def column(value: Any) -> str:
    """A column of numbers or expressions; one number where all entries are the same."""
    if isinstance(value, ca.MX):
        if ca.symvar(value):
            return short(str(value))
        value = ca.evalf(value)
    entries = [str(entry) for entry in ca.vertsplit(value)]
    return entries[0] if len(set(entries)) == 1 else short("[" + ", ".join(entries) + "]")


def short(expression: Any) -> str:
    """An expression on one line of bounded length. SX prints its shared parts first; only bounded text is kept."""
    if not isinstance(expression, str) and ca.Function("size", ca.symvar(expression), [expression]).n_nodes() > 60:
        return f"expression of {', '.join(s.name() for s in ca.symvar(expression)[:8])}, ..."
    text = " ".join(str(expression).split())
    return text if len(text) <= WIDTH else text[: WIDTH - 3] + "..."
