"""Plot plans and solutions with limits, compare them with other motions, and display them in notebooks.

The figures are matplotlib figures without a window: a notebook displays them, and `figure.savefig` writes them.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from html import escape
from itertools import chain
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from models.checks import Array
from ocp.app.check.joint_limits import Motion
from ocp.app.view.appearance import COMPARED, LIMIT, PLAN
from ocp.app.view.rendering import PICTURE_STYLE
from ocp.app.view.report import KINDS, bounds_of, curve_samples, limits_in_view
from ocp.errors import ProblemError, require
from ocp.motion.local.accelerations import AccelerationSolution
from ocp.motion.local.rates import LocalSolution
from ocp.motion.result.plan import Plan
from ocp.motion.schedule.trajectory import JointTrajectory
from ocp.problem.formulation import Formulation
from ocp.solution import Solution
from ocp.tolerances import ROUNDING_SHARE

STYLE: Any = {"font.size": 7.5, "axes.titlesize": 8.5, "axes.spines.top": False, "axes.spines.right": False}
"""Settings of matplotlib for all figures."""
STYLE |= {"text.parse_math": False}  # a joint's name may contain a dollar
DASHES: tuple[Any, ...] = ((0, (1, 1)), (0, (5, 1.5)), (0, (4, 1.2, 1, 1.2)))
"""Line styles of the motions compared with a plan, so that colour is not the only distinction."""


class Diagram(NamedTuple):
    """A diagram of a figure.

    Attributes:
        title, label: Title, and label of the vertical axis.
        curves: For each curve the number of its motion, and its times and values. Shape (M,) each.
        lower, upper: Limits of the quantity, infinite if there are none.
        min_range: Curves with a smaller range are drawn as constant.
    """

    title: str
    label: str
    curves: Sequence[tuple[int, Array, Array]]
    lower: float
    upper: float
    min_range: float


def draw_diagrams(figure: Any, diagrams: Sequence[Diagram], columns: int, names: Sequence[str]) -> None:
    """Draw diagrams over time, row by row, into an empty figure.

    `names` are those of the motions; the first one is the plan, and the others are compared with it.
    """
    with matplotlib.rc_context(STYLE):
        grid = figure.subplots(-(-len(diagrams) // columns), columns, squeeze=False, sharex=True).ravel()
        for ax in grid[len(diagrams) :]:
            ax.remove()
        for ax, diagram in zip(grid, diagrams, strict=False):
            for number, times, values in reversed(diagram.curves):  # the plan last, on top
                ax.plot(times, values, **line_style(number))
            draw_limits(ax, diagram.lower, diagram.upper, diagram.min_range)
            ax.set_title(diagram.title)
            ax.set_ylabel(diagram.label, fontsize=7)
            ax.margins(x=0.01)
        for ax in grid[max(0, len(diagrams) - columns) : len(diagrams)]:
            ax.set_xlabel("time, s")
            ax.tick_params(labelbottom=True)
        if len(names) > 1:
            lines = [Line2D([], [], **line_style(number)) for number in range(len(names))]
            figure.legend(lines, names, loc="outside lower center", ncols=len(names), frameon=False, fontsize=8)


def draw_limits(ax: Any, lower: float, upper: float, min_range: float) -> None:
    """Draw the limits of the curves in a diagram as lines or, if they are distant, as text."""
    view = limits_in_view(ax.dataLim.y0, ax.dataLim.y1, lower, upper, min_range=min_range)
    for limit in view.lines:
        ax.axhline(limit, color=LIMIT, lw=0.9, ls=(0, (5, 2)))
    if view.text:
        place, side = (0.03, "bottom") if view.text_below else (0.97, "top")
        ax.annotate(view.text, (0.99, place), xycoords="axes fraction", ha="right", va=side, color=LIMIT, fontsize=6)
    ax.set_ylim(view.low, view.high)


def line_style(number: int) -> dict[str, Any]:
    """Return the line style of a plan (number 0), or of a motion compared with the plan (number 1, 2, ...)."""
    return {"color": PLAN, "lw": 1.4} if number == 0 else {"color": COMPARED, "lw": 1.1, "ls": DASHES[number % 3]}


def as_svg(figure: Any) -> str:
    """Return a figure as an `svg` element for a page."""
    stream = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "selfmotion"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    text = stream.getvalue()
    return text[text.index("<svg") :]


class Picture(Figure):
    """A figure that a notebook displays as SVG."""

    def _repr_svg_(self) -> str:
        return as_svg(self)


def plot_plan(plan: Plan, against: Any = None, figure: Any = None) -> Any:
    """Plot position, velocity and acceleration of every joint over time, with the limits of the plan.

    Args:
        plan: Plan, drawn in blue.
        against: Motion to compare with, in orange: a plan, a result of `resolve` or `resolve_accelerations`, a joint
            trajectory; or several by name.
        figure: Empty matplotlib figure to draw into, for example one of pyplot for a window; None: a new one.

    Returns:
        The figure.

    Raises:
        ProblemError: A motion cannot be compared, or has other joints.
    """
    names = plan.names
    others = {name: _comparison(name, motion, names) for name, motion in _motions_by_name(against).items()}
    motions = [_motion_of(plan), *(motion for motion, _ in others.values())]
    target = _figure(figure, (PICTURE_STYLE.width, 0.9 + 1.15 * len(names)))
    robot = plan.machine.robot
    columns: list[list[Diagram]] = []
    for kind, per in KINDS.items():
        samples = [(number, *curve_samples(motion, kind)) for number, motion in enumerate(motions)]
        known = [(number, times, values) for number, times, values in samples if values is not None]
        min_range = PICTURE_STYLE.flat * max((np.abs(values).max() for _, _, values in known), default=1.0)
        lower, upper = bounds_of(plan.joint_bounds, kind)
        columns.append([])
        for k, joint in enumerate(robot.moving_joints):
            curves = [(number, times, values[:, k]) for number, times, values in known]
            title, name = "" if k else kind, "" if per else joint.name
            columns[-1].append(Diagram(title, f"{name}\n{joint.unit}{per}", curves, lower[k], upper[k], min_range))
    draw_diagrams(target, list(chain(*zip(*columns, strict=True))), len(columns), ["plan", *others])
    costs = "".join(f", that of {name} {cost:.4g}" for name, (_, cost) in others.items() if cost is not None)
    target.suptitle(f"{robot.name}: cost {plan.cost:.4g} in {plan.horizon:.4g} s{costs}", fontsize=9.5)
    return target


def html_of_plan(plan: Plan) -> str:
    """Return a plan as HTML for a notebook, with its cost, its audit (if it has been computed) and its curves."""
    lines = str(plan).splitlines()
    parts = [f"<p><b>{escape(lines[0])}</b></p>"]
    if plan.audits:
        parts.append(f"<p>The plan {escape(plan.audits[0].sentence)}.</p>")
    parts.append(as_svg(plot_plan(plan)))
    if len(lines) > 1:
        rest = escape("\n".join(lines[1:]))
        parts.append(f"<details><summary>the candidates</summary><pre>{rest}</pre></details>")
    return f'<div style="max-width: 56rem">{"".join(parts)}</div>'


def _motion_of(plan: Plan) -> Motion:
    """Return samples of a plan, dense enough for smooth curves, as a joint motion."""
    sample = plan.sample(plan.horizon / PICTURE_STYLE.curve_points)
    return Motion(sample.t, sample.joints, sample.rates, sample.accelerations)


def _comparison(name: str, other: Any, names: tuple[str, ...]) -> tuple[Motion, float | None]:
    """Return the joint motion of an object that is plotted for comparison with a plan, and its cost or None."""
    cost: float | None = None
    joints = getattr(other, "names", names)
    if isinstance(other, Plan):
        motion, cost = _motion_of(other), other.cost
    elif isinstance(other, LocalSolution):
        motion, cost = Motion(other.t, other.joints, other.joint_rates), float(other.cost[-1])
    elif isinstance(other, AccelerationSolution):
        each = other.motion
        motion = Motion(each.t, each.joints, each.joint_velocities, each.joint_accelerations)
    elif isinstance(other, JointTrajectory):
        motion = Motion(other.t, other.positions, other.velocities, other.accelerations)
    else:
        words = f"plot: {name!r} is a {type(other).__name__}; a plan can be compared with a plan, a result of resolve "
        raise ProblemError(f"{words}or resolve_accelerations, or a JointTrajectory", name="against", value=other)
    if joints != names or motion.q.shape[1] != len(names) or len(motion.t) < 2:
        words = f"plot: {name!r} has joints {', '.join(joints)} at {len(motion.t)} times; the plan's: "
        raise ProblemError(words + ", ".join(names), name="against", value=joints, limit=names)
    return motion, cost


def plot_solution(solution: Solution, against: Any = None, figure: Any = None) -> Any:
    """Plot states and controls of a solution over time, with their bounds if the solution contains its problem.

    Args:
        solution: Solution, drawn in blue.
        against: Solution with the same states and controls, result of `resolve` for the same joints, or several by
            name, in orange. The title gives the costs; that of `resolve` is the integral of half the squared joint
            rates.
        figure: As in `plot_plan`.

    Returns:
        The figure.

    Raises:
        ProblemError: A motion cannot be compared, or has other states and controls.
    """
    others = _motions_by_name(against)
    curves = [_curves_over_time(name, motion) for name, motion in ((solution.name, solution), *others.items())]
    own_widths, *all_widths = ({name: samples.shape[1] for name, (_, samples) in each.items()} for each in curves)
    for (name, other), widths in zip(others.items(), all_widths, strict=True):
        expected = {name: own_widths.get(name) for name in (widths if isinstance(other, LocalSolution) else own_widths)}
        if widths != expected:
            words = f"plot: {name!r} has {widths}, the solution has {own_widths}"
            raise ProblemError(words, name="against", value=widths, limit=own_widths)
    entries = [(name, k) for name, width in own_widths.items() for k in range(width)]
    omitted, entries = entries[PICTURE_STYLE.entries :], entries[: PICTURE_STYLE.entries]
    bounds, units = _bounds(solution)
    diagrams = []
    for name, k in entries:
        known = [(number, *curve[name]) for number, curve in enumerate(curves) if name in curve]
        min_range = PICTURE_STYLE.flat * max(np.abs(values).max() for _, _, values in known)
        lower, upper = bounds[name][:, k] if name in bounds else (-np.inf, np.inf)
        title = name if own_widths[name] == 1 else f"{name} [{k}]"
        lines = [(number, times, values[:, k]) for number, times, values in known]
        diagrams.append(Diagram(title, units.get(name, ""), lines, lower, upper, min_range))
    columns = min(PICTURE_STYLE.columns, len(entries))
    target = _figure(figure, (PICTURE_STYLE.width, 0.9 + 1.35 * -(-len(entries) // columns)))
    draw_diagrams(target, diagrams, columns, ["solution", *others])
    costs = "".join(f", that of {name} {np.ravel(other.cost)[-1]:.6g}" for name, other in others.items())
    rest = f"; {len(omitted)} entries are omitted" if omitted else ""
    target.suptitle(f"{solution.name}: cost {solution.cost:.6g}{costs}{rest}", fontsize=9.5)
    return target


def html_of_solution(solution: Solution) -> str:
    """Return a solution as HTML for a notebook: its summary and its curves."""
    head, *rest = str(solution).splitlines()
    table = f"<pre>{escape(chr(10).join(rest))}</pre>"
    return f'<div style="max-width: 56rem"><p><b>{escape(head)}</b></p>{as_svg(plot_solution(solution))}{table}</div>'


def _curves_over_time(name: str, motion: Any) -> dict[str, tuple[Array, Array]]:
    """Return times, s, and values of each state and control by name, with both one-sided values at jumps.

    The base, joints and rates of a local (resolved-rate) motion have the names that they have in a solution.
    """
    if isinstance(motion, LocalSolution):
        samples = {"base": motion.base, "joints": motion.joints, "rates": motion.joint_rates}
        return {name: (motion.t, values) for name, values in samples.items() if values.shape[1]}
    if not isinstance(motion, Solution):
        words = f"plot: {name!r} is a {type(motion).__name__}; a solution can be compared with a solution or a result "
        raise ProblemError(f"{words}of resolve", name="against", value=motion)
    nodes = motion.control_interpolant.breaks[1:-1]
    uniform = np.linspace(0.0, 1.0, PICTURE_STYLE.curve_points + 1)
    fractions = np.unique(np.concatenate([uniform, nodes - ROUNDING_SHARE, nodes + ROUNDING_SHARE]))
    spans = motion.phases
    curves = {}
    for name, values in motion.at_fraction(fractions).items():
        begin, end = spans.get(name.partition(".")[0], (0.0, motion.horizon))
        curves[name] = (begin + (end - begin) * fractions, values)
    return curves


def _bounds(solution: Solution) -> tuple[dict[str, Array], dict[str, str]]:
    """Return lower and upper bounds (2, n) and units of states and controls by name; {} if the problem is unknown."""
    if solution.problem is None:
        return {}, {}
    form = Formulation.of(solution.problem)
    both = np.array(form.bound_values(form.parameter_vector(solution.parameters)))
    bounds: dict[str, Array] = {}
    for kind, pool in (("state", form.states), ("control", form.controls)):
        bounds |= {name: both[:, form.bounds.places[kind]][:, place] for name, place in pool.items()}
    return bounds, form.units


def _motions_by_name(against: Any) -> dict[str, Any]:
    """Return the motions that are compared with a plan or solution, keyed by name."""
    if isinstance(against, Mapping):
        named = {str(name): motion for name, motion in against.items()}
    elif isinstance(against, list | tuple):
        named = {f"other {number}": motion for number, motion in enumerate(against, 1)}
    else:
        return {} if against is None else {"the other": against}
    if not named:
        words = f"plot: {against!r} has no motion to compare with; pass a motion, several, or None"
        raise ProblemError(words, name="against", value=against)
    return named


def _figure(figure: Any, size: tuple[float, float]) -> Any:
    """Return a new matplotlib figure of a size in inches, or resize a given figure, which must be empty."""
    if figure is None:
        return Picture(figsize=size, layout="constrained")
    require.instance("plot: figure", figure, Figure)
    if figure.axes:
        raise ProblemError("plot: the figure already has axes; pass an empty one", name="figure", value=figure)
    figure.set_layout_engine("constrained")
    figure.set_size_inches(size)
    return figure
