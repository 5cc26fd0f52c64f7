"""Plans and solutions drawn: their curves with limits, beside what they are compared with; and what a notebook shows.

`Plan.plot` and `Solution.plot` ask for these when they are called. Figures are matplotlib's, of no window: a notebook
shows them, `figure.savefig` writes them, and one of pyplot's may be drawn into instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from models.arrays import Array
from ocp.app.check.interpolation import Motion
from ocp.app.view.pictures import STYLE, add_legend, as_svg, draw_joints, draw_limits, line_style
from ocp.app.view.rendering import PICTURE_STYLE
from ocp.errors import ProblemError, checked_instance
from ocp.motion.local.accelerations import AccelerationSolution
from ocp.motion.local.rates import LocalSolution
from ocp.motion.plan.motion import Plan
from ocp.motion.schedule.trajectory import JointTrajectory
from ocp.motion.tasks.limits import Limits
from ocp.problem.formulation import Formulation
from ocp.solution import Solution
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["Picture", "html_of_plan", "html_of_solution", "plot_plan", "plot_solution"]


class Picture(Figure):
    """A figure that a notebook shows as it is."""

    def _repr_svg_(self) -> str:
        return as_svg(self)


# ---- plans -------------------------------------------------------------------------------------------------------


def plot_plan(plan: Plan, against: Any = None, figure: Any = None) -> Any:
    """Position, velocity and acceleration of every joint over time, with the robot's limits.

    Args:
        plan: In blue.
        against: What it is compared with, in orange: a plan, what `resolve` or `resolve_accelerations` made, a
            trajectory of joints; or several by name.
        figure: An empty figure of matplotlib's to draw into, for example pyplot's, for a window; a new one if None.

    Returns:
        The figure.

    Raises:
        ProblemError: Nothing that can be compared, or of other joints.
    """
    names = plan.names
    others = {name: _compared(name, one, names) for name, one in _named(against).items()}
    motions = {"plan": _motion_of(plan), **{name: motion for name, (motion, _) in others.items()}}
    made = _figure(figure, (PICTURE_STYLE.width, 0.9 + 1.15 * len(names)))
    robot = plan.machine.robot
    units = [joint.unit for joint in robot.moving_joints]
    draw_joints(made, motions, names, units, Limits().bounds(plan.machine))
    costs = "".join(f", that of {name} {cost:.4g}" for name, (_, cost) in others.items() if cost is not None)
    made.suptitle(f"{robot.name}: cost {plan.cost:.4g} in {plan.horizon:.4g} s{costs}", fontsize=9.5)
    return made


def html_of_plan(plan: Plan) -> str:
    """A plan as a notebook shows it: what it costs, what its audit says where it was asked, its curves."""
    lines = str(plan).splitlines()
    parts = [f"<p><b>{escape(lines[0])}</b></p>"]
    if plan.audits:
        parts.append(f"<p>The plan {escape(plan.audits[0].sentence)}.</p>")
    parts.append(as_svg(plot_plan(plan)))
    if len(lines) > 1:
        rest = escape("\n".join(lines[1:]))
        parts.append(f"<details><summary>the motions that were looked at</summary><pre>{rest}</pre></details>")
    return f'<div style="max-width: 56rem">{"".join(parts)}</div>'


def _motion_of(plan: Plan) -> Motion:
    sample = plan.sample(plan.horizon / PICTURE_STYLE.curve_points)
    return Motion(sample.t, sample.joints, sample.rates, sample.accelerations)


def _compared(name: str, other: Any, names: tuple[str, ...]) -> tuple[Motion, float | None]:
    """The motion of what a plan of these joints is compared with, and what it costs, where that is known."""
    cost: float | None = None
    if isinstance(other, Plan):
        told, motion, cost = other.names, _motion_of(other), other.cost
    elif isinstance(other, LocalSolution):
        told, motion, cost = names, Motion(other.t, other.joints, other.joint_rates), float(other.cost[-1])
    elif isinstance(other, AccelerationSolution):
        moved = other.motion
        told, motion = names, Motion(moved.t, moved.joints, moved.joint_velocities, moved.joint_accelerations)
    elif isinstance(other, JointTrajectory):
        told, motion = other.names, Motion(other.t, other.positions, other.velocities, other.accelerations)
    else:
        words = (
            f"plot: {name!r} is a {type(other).__name__}; a plan is compared with a plan, with what resolve or "
            "resolve_accelerations made, or with a JointTrajectory"
        )
        raise ProblemError(words, name="against", value=other)
    if told != names or motion.q.shape[1] != len(names) or len(motion.t) < 2:
        words = (
            f"plot: {name!r} has joints {', '.join(told)} at {len(motion.t)} times; the plan's are {', '.join(names)}"
        )
        raise ProblemError(words, name="against", value=told, limit=names)
    return motion, cost


# ---- solutions ---------------------------------------------------------------------------------------------------


def plot_solution(solution: Solution, against: Any = None, figure: Any = None) -> Any:
    """States and controls over time, each entry with its bounds where the solution has its problem.

    Args:
        solution: In blue.
        against: A solution of the same states and controls, what `resolve` made of the same joints, or several by name,
            in orange. Costs are told; what `resolve` tells is the integral of half the squared joint rates.
        figure: As of a plan.

    Returns:
        The figure.

    Raises:
        ProblemError: Nothing that can be compared, or of other states and controls.
    """
    others = _named(against)
    shapes = _widths(solution)
    for name, other in others.items():
        told = _widths(other) if isinstance(other, Solution) else _local_widths(name, other)
        wanted = {what: shapes.get(what) for what in (told if isinstance(other, LocalSolution) else shapes)}
        if told != wanted:
            words = f"plot: {name!r} has {told}, the solution has {shapes}"
            raise ProblemError(words, name="against", value=told, limit=shapes)
    entries = [(name, k) for name, width in shapes.items() for k in range(width)]
    left_out, entries = entries[PICTURE_STYLE.entries :], entries[: PICTURE_STYLE.entries]
    bounds, units = _bounds(solution)
    rows = -(-len(entries) // PICTURE_STYLE.columns)
    made = _figure(figure, (PICTURE_STYLE.width, 0.9 + 1.35 * rows))
    import matplotlib

    with matplotlib.rc_context(STYLE):
        grid: Any = made.subplots(rows, min(PICTURE_STYLE.columns, len(entries)), squeeze=False, sharex=True)
        for ax in grid.ravel()[len(entries) :]:
            ax.remove()
        curves = [_along(one) for one in (solution, *others.values())]
        for ax, (name, k) in zip(grid.ravel(), entries, strict=False):
            for number, curve in reversed([*enumerate(curves)]):
                if name in curve:
                    times, values = curve[name]
                    ax.plot(times, values[:, k], **line_style(number))
            lower, upper = bounds[name][:, k] if name in bounds else (-np.inf, np.inf)
            draw_limits(
                ax, lower, upper, PICTURE_STYLE.flat * max(np.abs(c[name][1]).max() for c in curves if name in c)
            )
            ax.set_title(name if shapes[name] == 1 else f"{name} [{k}]")
            ax.set_ylabel(units.get(name, ""), fontsize=7)
            ax.margins(x=0.01)
        for ax in grid.ravel()[max(0, len(entries) - grid.shape[1]) : len(entries)]:
            ax.set_xlabel("time, s")
            ax.tick_params(labelbottom=True)
        if others:
            add_legend(made, ["solution", *others])
    costs = "".join(f", that of {name} {np.ravel(other.cost)[-1]:.6g}" for name, other in others.items())
    rest = f"; {len(left_out)} entries are not drawn" if left_out else ""
    made.suptitle(f"{solution.name}: cost {solution.cost:.6g}{costs}{rest}", fontsize=9.5)
    return made


def html_of_solution(solution: Solution) -> str:
    """A solution as a notebook shows it."""
    head, *rest = str(solution).splitlines()
    table = f"<pre>{escape(chr(10).join(rest))}</pre>"
    return f'<div style="max-width: 56rem"><p><b>{escape(head)}</b></p>{as_svg(plot_solution(solution))}{table}</div>'


def _widths(solution: Solution) -> dict[str, int]:
    return {name: values.shape[1] for name, values in {**solution.states, **solution.controls}.items()}


def _local_widths(name: str, other: Any) -> dict[str, int]:
    """What is known of a motion that `resolve` made, by the names that `minimum_velocity_problem` gives."""
    if not isinstance(other, LocalSolution):
        words = (
            f"plot: {name!r} is a {type(other).__name__}; a solution is compared with a solution, or what resolve made"
        )
        raise ProblemError(words, name="against", value=other)
    return {what: values.shape[1] for what, values in _local(other).items()}


def _local(other: LocalSolution) -> dict[str, Array]:
    named = {"base": other.base, "joints": other.joints, "rates": other.joint_rates}
    return {what: values for what, values in named.items() if values.shape[1]}


def _along(one: Any) -> dict[str, tuple[Array, Array]]:
    """By name times, both sides of every node of a solution among them, s, and the values there.

    States and controls of a phase are told over its own stretch of time.
    """
    if isinstance(one, LocalSolution):
        return {name: (one.t, values) for name, values in _local(one).items()}
    nodes = one.control_interpolant.breaks[1:-1]
    even = np.linspace(0.0, 1.0, PICTURE_STYLE.curve_points + 1)
    at = np.unique(np.concatenate([even, nodes - ROUNDING_SHARE, nodes + ROUNDING_SHARE]))
    spans = one.phases
    found = {}
    for name, values in one.at_fraction(at).items():
        begin, end = spans.get(name.partition(".")[0], (0.0, one.horizon))
        found[name] = (begin + (end - begin) * at, values)
    return found


def _bounds(solution: Solution) -> tuple[dict[str, Array], dict[str, str]]:
    """Lower and upper bounds (2, n) and units of states and controls by name; none without the problem."""
    if solution.problem is None:
        return {}, {}
    form = Formulation.of(solution.problem)
    both = np.array(form.bound_values(form.parameter_vector(solution.parameters)))
    found: dict[str, Array] = {}
    for kind, pool in (("state", form.states), ("control", form.controls)):
        found |= {name: both[:, form.bounds.places[kind]][:, place] for name, place in pool.items()}
    return found, form.units


# ---- both --------------------------------------------------------------------------------------------------------


def _named(against: Any) -> dict[str, Any]:
    """What something is compared with, by name."""
    if against is None:
        return {}
    if isinstance(against, Mapping):
        named = {str(name): one for name, one in against.items()}
    elif isinstance(against, list | tuple):
        named = {f"other {number}": one for number, one in enumerate(against, 1)}
    else:
        named = {"the other": against}
    if not named:
        words = f"plot: nothing to compare with in {against!r}; give a motion, several, or none at all"
        raise ProblemError(words, name="against", value=against)
    return named


def _figure(given: Any, size: tuple[float, float]) -> Any:
    """A new figure, or the one that is given; ProblemError where it is none or not empty."""
    if given is None:
        return Picture(figsize=size, layout="constrained")
    checked_instance("plot: figure", given, Figure)
    if given.axes:
        words = "plot: the figure has axes already; give an empty one"
        raise ProblemError(words, name="figure", value=given)
    given.set_layout_engine("constrained")
    given.set_size_inches(size)
    return given
