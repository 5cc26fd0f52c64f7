"""Solved plans edited at random: what the audit lets pass is what an independent look finds unharmed.

``make frauds`` edits eight plans 33 times each, in memory or through a file: states, controls and costates changed
everywhere or in one interval, times warped, costs and horizons changed, plans of narrower bounds passed off as those of
wider ones (with what tightened them forged, their multipliers with it or not), plans of other problems, and arrays that
do not fit. Whether an edit matters is measured without the audit: by an integration of every interval with small steps
of equal length, by bounds and constraints at many places, and by the cost beside the known optimum.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import files
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase, Joint, Link, Robot, smooth
from models import Path as Line
from ocp import (
    Collocation,
    MultipleShooting,
    Phases,
    Problem,
    ProblemError,
    Solution,
    TipTask,
    minimum_velocity_problem,
    solve,
)
from ocp.problem.formulation import Formulation
from tests.ocp.problems import Array, double_integrator
from tests.sweep.results import Row, Sweep, parser

MATTERS = 1e-3
"""Share of a size, or of the optimal cost, from which on an edit matters."""
TIP = 1e-4
"""m, by which a tip may be off its task."""
STEPS, PLACES = 40, 41
"""Of the integration of an interval, and at which bounds are looked at."""
STILL = 1e-9
"""Share of the largest value: what moves less stands still."""
EACH = 33
"""Edits of a plan."""


# ---- the plans -------------------------------------------------------------------------------------------------------


def obstacle(radius: float = 0.3) -> Problem:
    """A mass in the plane round a disc, at the least squared force."""
    problem = Problem("obstacle")
    q = problem.state("q", 2, initial=[0.0, 0.0], terminal=[2.0, 0.0], guess=lambda t: [t, 0.8 * ca.sin(np.pi * t / 2)])
    v, u = problem.state("v", 2, initial=0.0, terminal=0.0), problem.control("u", 2)
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    problem.horizon(2.0)
    problem.path("disc", ca.sumsqr(q - ca.DM([1.0, -0.05])), lower=radius**2)
    problem.minimize(running=ca.sumsqr(u))
    return problem


def cart_pole(reach: float = 2.0) -> Problem:
    """A pole swung up by a cart."""
    problem = Problem("cart-pole")
    x = problem.state("x", 2, initial=0.0, terminal=[1.0, np.pi], lower=[-reach, -np.inf], upper=[reach, np.inf],
                      guess=lambda t: [t / 2, np.pi * t / 2])  # fmt: skip
    v, u = problem.state("v", 2, initial=0.0, terminal=0.0), problem.control("u", lower=-20.0, upper=20.0)
    s, c, rate = ca.sin(x[1]), ca.cos(x[1]), v[1]
    lean = 1.0 + 0.3 * s**2
    push = u + 0.3 * s * (0.5 * rate**2 + 9.81 * c)
    problem.dynamics(x, v)
    problem.dynamics(v, ca.vertcat(push, -(u * c + 0.15 * rate**2 * c * s + 1.3 * 9.81 * s) / 0.5) / lean)
    problem.horizon(2.0)
    problem.minimize(running=u**2)
    return problem


def timed(limit: float = 20.0) -> Problem:
    """A free horizon, priced by a parameter."""
    problem, _, _, u = double_integrator("timed", horizon=None, limit=limit)
    horizon, price = problem.horizon(lower=0.2, upper=10.0, guess=2.0), problem.parameter("price")
    problem.minimize(running=u**2 / 2, terminal=price * horizon)
    return problem


def spending(budget: float = 8.0) -> Problem:
    """The farthest way within a budget of squared force."""
    problem = Problem("spending")
    q, v = problem.state("q", initial=0.0), problem.state("v", initial=0.0, terminal=0.0)
    u = problem.control("u")
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    problem.horizon(1.0)
    problem.integral("spent", u**2, upper=budget)
    problem.minimize(running=1e-3 * u**2, terminal=-q)
    return problem


def two_phases(by: float = 0.7) -> Problem:
    """A mass that weighs more from half of the time on."""
    parts = {}
    for name, ends, mass in (("light", ([0.0, 0.0], None), 1.0), ("heavy", (None, [1.0, 0.0]), 3.0)):
        problem = Problem(name)
        x = problem.state("x", 2, initial=ends[0], terminal=ends[1])
        u = problem.control("u")
        problem.dynamics(x, ca.vertcat(x[1], u / mass))
        problem.horizon(0.5)
        problem.minimize(running=u**2)
        if name == "light":
            problem.end("passed", x[0], upper=by)
        parts[name] = problem
    phases = Phases("phases", parts)
    phases.join("light", "heavy", {"x": phases["light"].at_end("x")})
    return phases


def saturated(limit: float = 4.5) -> Problem:
    """A push that rests on its limits."""
    problem, _, _, u = double_integrator("saturated", limit=limit)
    problem.minimize(running=u**2 / 2)
    return problem


def arm(fast: float = 10.0) -> Problem:
    """A Panda whose hand goes straight, the roll about it free."""
    urdf = next(file.locate() for file in files("example-robot-data") or [] if file.name == "panda.urdf")
    robot = Robot.from_urdf(urdf, tip="panda_hand_tcp", lock={"panda_finger_joint1": 0.02})
    start = np.array([0.0, -0.6, 0.1, -2.2, 0.2, 1.7, 0.7])
    begin = np.array(ca.DM(FixedBase(robot).tip_pose(np.zeros(0), start).position)).ravel()
    task = TipTask.along(
        smooth(Line.through([begin, begin + np.array([0.1, 0.12, -0.06])]), deviation=1e-3), 0.1, steady=True
    )
    request: dict[str, Any] = {"start": start, "horizon": task.duration}
    return minimum_velocity_problem(FixedBase(robot), tasks=task, **request)


def gantry(fast: float = 10.0) -> Problem:
    """Rails along a path of 10 m, one more than it asks for."""
    names = ["floor", "bridge", "trolley", "slide", "tool"]
    joints = [
        Joint(f"rail{k}", "prismatic", names[k], names[k + 1], axis=axis, lower=-50, upper=50)
        for k, axis in enumerate([(1, 0, 0), (0, 1, 0), (1, 0, 0), (0, 0, 1)])
    ]
    machine = FixedBase(Robot(tuple(Link(name, mass=1.0) for name in names), tuple(joints), tip="tool"))
    task = TipTask.along(smooth(Line.through([(0, 0, 0), (10, 2, 0)]), deviation=1e-3), 1.0, steady=True, gain=0.0)
    return minimum_velocity_problem(machine, tasks=task, start=np.zeros(4), horizon=task.duration)


LINEAR = MultipleShooting(40, control="linear")
PLANS: dict[str, tuple[Callable[..., Problem], Any, tuple[float, ...]]] = {
    "obstacle": (obstacle, MultipleShooting(60, control="linear"), (0.33, 0.4)),
    "cart-pole": (cart_pole, Collocation(40), (1.02, 1.0)),
    "timed": (timed, Collocation(20), (1.2, 1.5)),
    "spending": (spending, Collocation(20), (7.0, 4.0)),
    "phases": (two_phases, Collocation(16), (0.35, 0.25)),
    "saturated": (saturated, LINEAR, (4.2, 4.4)),
    "arm": (arm, Collocation(8, 4), ()),
    "gantry": (gantry, Collocation(8, 4), ()),
}
"""Problem, method, and what narrower or other problems of the same kind ask."""


@dataclass(frozen=True)
class Subject:
    """A plan that passes, its problem, plans of narrower problems, and what it is measured by.

    Attributes:
        optimum: Known of a mesh twice as fine. sizes: Spreads of states and controls. rows: Sizes of path rows.
    """

    problem: Problem
    plan: Solution
    others: tuple[Solution, ...]
    optimum: float
    sizes: tuple[Array, Array]
    rows: Array


@cache
def subject(kind: str) -> Subject:
    make, method, others = PLANS[kind]
    report: dict[str, Any] = {"parameters": {"price": 2.0}} if kind == "timed" else {}
    problem = make()
    plan = solve(problem, method, **report)
    if not plan.audit().passed:
        raise ValueError(f"the plan {kind} does not pass as it is: {plan.audit()}")
    best = solve(problem, method.halve(), guess=plan, **report).cost
    narrower = tuple(solve(make(other), method, guess=plan, **report) for other in others)
    places = np.linspace(0.0, 1.0, 2001)
    x, u = plan.state_interpolant(places), plan.control_interpolant(places)
    sizes = tuple(spread(values) for values in (x, u))
    form = Formulation.of(problem)
    function = ca.Function("slope", inputs(form), [ca.jacobian(form.path.expression, ca.vertcat(form.x, form.u))])
    slopes = [np.abs(np.array(function(*at(form, plan, s)))) for s in places[::100]]
    return Subject(problem, plan, narrower, best, (sizes[0], sizes[1]), np.max(slopes, axis=0) @ np.concatenate(sizes))


def spread(values: Array) -> Array:
    """Of each column (M, n), or how large it is where it stands still. Shape (n,)."""
    moves, largest = np.ptp(values, axis=0), np.abs(values).max(axis=0)
    return np.asarray(np.where(moves > STILL * largest, moves, largest * (largest > STILL * largest.max())))


# ---- the measure -----------------------------------------------------------------------------------------------------


def inputs(form: Formulation) -> list[Any]:
    return [form.x, form.u, form.t, form.T, form.p, form.w]


def at(form: Formulation, plan: Solution, s: Any) -> list[Any]:
    """The inputs at fractions of the horizon, a column each."""
    s = np.atleast_1d(s)
    x, u = plan.state_interpolant(s).T, plan.control_interpolant(s).T
    t, p = s * plan.horizon, form.parameter_vector(plan.parameters)
    return [x, u, t[None], plan.horizon, p, form.signals_at(t).T]


def measured(options: Subject, plan: Solution) -> float:
    """By how much a plan misses its problem, the largest of all shares over MATTERS: 1 and more matters."""
    form = Formulation.of(options.problem)
    mesh, (size_x, size_u) = plan.control_interpolant.breaks, options.sizes
    n, p, horizon = len(mesh) - 1, form.parameter_vector(plan.parameters), plan.horizon
    rates = ca.Function("rates", inputs(form), [ca.vertcat(form.f, form.running)]).map(n)
    low, high = form.bound_values(p)
    width, segments = np.diff(mesh), np.arange(n)

    def flow(y: Array, place: float) -> Array:
        s = mesh[:-1] + width * place
        u = plan.control_interpolant.within(segments, np.full(n, place)).T
        result = rates(y[:-1], u, (s * horizon)[None], np.full((1, n), horizon), np.tile(p[:, None], n),
                      form.signals_at(s * horizon).T)  # fmt: skip
        return np.array(result) * width * horizon

    y = np.vstack([plan.state_interpolant(mesh[:-1] + 1e-13).T, np.zeros(n)])
    step, off = 1.0 / STEPS, [0.0]
    for k in range(STEPS):
        a = flow(y, k * step)
        b = flow(y + step / 2 * a, (k + 0.5) * step)
        c = flow(y + step / 2 * b, (k + 0.5) * step)
        d = flow(y + step * c, (k + 1) * step)
        y = y + step / 6 * (a + 2 * b + 2 * c + d)
        there = plan.state_interpolant(mesh[:-1] + width * (k + 1) * step - 1e-13).T
        off.append(float((np.abs(y[:-1] - there).max(axis=1) / np.where(size_x > 0, size_x, np.inf)).max()))
    ends = plan.state_interpolant(np.array([0.0, 1.0]))
    final = form.terminal_cost(ends[1], ends[0], plan.control_interpolant(np.zeros(1))[0], horizon=horizon, p=p)
    cost = float(y[-1].sum()) + final
    shares = [max(off), abs(plan.cost - cost) / abs(options.optimum), (cost - options.optimum) / abs(options.optimum)]

    s = (mesh[:-1, None] + width[:, None] * np.linspace(0.0, 1.0, PLACES)).ravel()
    rows = ca.Function("rows", inputs(form), [form.path.expression]).map(len(s))
    x, u, t, *_ = at(form, plan, s)
    u = plan.control_interpolant.within(np.repeat(segments, PLACES), np.tile(np.linspace(0.0, 1.0, PLACES), n)).T
    many = np.full((1, len(s)), horizon), np.tile(p[:, None], len(s)), form.signals_at(s * horizon).T
    g = np.array(rows(x, u, t, *many)).reshape(len(form.path), len(s))
    places = form.bounds.places

    def beyond(values: Array, index: Array, size: Array, only: Any = True) -> None:
        miss = np.maximum(low[index][:, None] - values, values - high[index][:, None]).max(axis=1, initial=0.0)
        shares.append(
            float(np.max(np.where((size > 0) & only, miss / np.where(size > 0, size, 1.0), 0.0), initial=0.0))
        )

    beyond(x, places["state"], size_x)
    beyond(u, places["control"], size_u)
    beyond(g, form.path.bounds, options.rows)
    for end, k in (("initial", 0), ("terminal", 1)):
        beyond(ends[k][:, None], places[end], size_x, low[places[end]] == high[places[end]])
    begin, after = (form.start, ends[0]), (form.end, ends[1])
    for which, here in (begin, after):
        function = ca.Function("ends", [*inputs(form), form.x0, form.u0], [which.expression])
        controls = plan.control_interpolant(np.array([0.0, 1.0]))
        value = np.array(function(here, controls[-1], horizon, horizon, p, form.signals_at(np.zeros(1)).T, ends[0],
                                  controls[0]))  # fmt: skip
        beyond(value.reshape(-1, 1), which.bounds, np.full(len(which), float(size_x.max())))
    if "task position" in form.watch.names:
        tip = ca.Function("tip", [*inputs(form), form.x0, form.u0], [form.watch.expression]).map(len(s))
        one = [np.tile(values[:, None], len(s)) for values in (ends[0], u[:, 0])]
        missed = np.abs(np.array(tip(x, u, t, *many, *one)))[form.watch.of("task position")]
        shares.append(float(missed.max()) / TIP * MATTERS)
    index = places["horizon"][0]
    shares.append(max(low[index] - horizon, horizon - high[index], abs(plan.t[-1] - horizon), 0.0) / horizon)
    return float(np.max(np.nan_to_num(shares, nan=np.inf))) / MATTERS


# ---- the edits -------------------------------------------------------------------------------------------------------

CURVES = {"states": "state_interpolant", "controls": "control_interpolant", "costates": "costate_interpolant"}


def redrawn(plan: Solution, pool: str, change: Callable[[Array, Array, Array], Array]) -> Solution:
    """A plan whose curves of one pool are changed, and what it reports of them alike.

    Args:
        change: (fractions, values (M, n), intervals of these) -> values (M, n).
    """
    curve = getattr(plan, CURVES[pool])
    count, nodes, columns = curve.values.shape
    s = (curve.breaks[:-1, None] + np.diff(curve.breaks)[:, None] * curve.nodes).ravel()
    values = change(s, curve.values.reshape(-1, columns).copy(), np.repeat(np.arange(count), nodes))
    curve = replace(curve, values=values.reshape(count, nodes, columns))
    by_name = {name: options.copy() for name, options in getattr(plan, pool).items()}
    seen = curve(np.clip(plan.t / plan.horizon, 0.0, 1.0))
    before = getattr(plan, CURVES[pool])(np.clip(plan.t / plan.horizon, 0.0, 1.0))
    offset = 0
    for name, options in by_name.items():
        columns = slice(offset, offset + options.shape[1])
        by_name[name] = options + (seen - before)[:, columns]
        offset += options.shape[1]
    changes: dict[str, Any] = {pool: by_name, CURVES[pool]: curve}
    return replace(plan, **changes)


def tightened(options: Subject, rng: Any, size: float) -> Solution:
    """The plan of a narrower problem, whose bounds are said to have been tightened."""
    if not options.others:
        return replace(options.plan, bound_tightening=np.full(random_shape(options), size))
    other = options.others[rng.integers(len(options.others))]
    tightening = np.zeros(random_shape(options))
    form, narrow = Formulation.of(options.problem), Formulation.of(other.problem)
    index = np.concatenate([form.bounds.places[kind] for kind in ("state", "control", "path")])
    p = form.parameter_vector(other.parameters)
    for side, sign in ((0, -1.0), (1, 1.0)):
        wide, own = form.bound_values(p)[side][index], narrow.bound_values(p)[side][index]
        with np.errstate(invalid="ignore"):
            by = np.nan_to_num(sign * (wide - own), nan=0.0, posinf=0.0, neginf=0.0)
        tightening[side] = np.maximum(by, 0.0)
    result = replace(other, problem=options.problem, bound_tightening=tightening)
    return without_multipliers(result) if rng.random() < 0.5 else result


def random_shape(options: Subject) -> tuple[int, int, int]:
    form = Formulation.of(options.problem)
    return 2, len(options.plan.control_interpolant.breaks) - 1, form.nx + form.nu + len(form.path)


def without_multipliers(plan: Solution) -> Solution:
    return replace(redrawn(plan, "costates", lambda s, v, k: 0 * v), multipliers=0 * plan.multipliers)


def edited(options: Subject, kind: str, rng: Any, size: float) -> Solution:
    """The plan after an edit of some size, of the spread of what is edited."""
    plan = options.plan
    pool = ["states", "controls"][rng.integers(2)]
    spread = options.sizes[pool == "controls"]
    column = int(rng.integers(len(spread)))
    by = size * float(spread[column]) * rng.choice([-1.0, 1.0])

    def added(values: Array, what: Any) -> Array:
        values[:, column] += what
        return values

    if kind == "moved":
        return redrawn(plan, pool, lambda s, v, k: added(v, by))
    if kind == "bulged":
        return redrawn(plan, pool, lambda s, v, k: added(v, by * np.sin(np.pi * s) ** 2))
    if kind == "drifted":  # a state and the control that drives it
        column = min(column, len(options.sizes[1]) - 1, len(options.sizes[0]) - 1)
        by = size * float(options.sizes[0][column])
        moved = redrawn(plan, "states", lambda s, v, k: added(v, by * s))
        return redrawn(moved, "controls", lambda s, v, k: added(v, by / plan.horizon))
    if kind == "one interval":
        where = int(rng.integers(len(getattr(plan, CURVES[pool]).breaks) - 1))
        return redrawn(plan, pool, lambda s, v, k: added(v, by * (k == where) * 4))
    if kind == "costates":
        return redrawn(plan, "costates", lambda s, v, k: (1 + by) * v)
    if kind == "shifted":  # what comes later comes now
        curve = plan.control_interpolant
        return redrawn(plan, "controls", lambda s, v, k: curve(np.clip(s + size / 10, 0.0, 1.0)))
    if kind == "warped":
        return replace(plan, horizon=plan.horizon * (1 + size), t=plan.t * (1 + size))
    if kind == "horizon":
        return replace(plan, horizon=plan.horizon * (1 + size))
    if kind == "cost":
        return replace(plan, cost=plan.cost * (1 - size) if rng.random() < 0.8 else float(rng.choice([np.nan, np.inf])))
    if kind == "tightened":
        return tightened(options, rng, size)
    if kind == "tightened elsewhere":
        return replace(plan, bound_tightening=rng.random(random_shape(options)) * size)
    if kind == "tightened without rows":
        form = Formulation.of(options.problem)
        return replace(plan, bound_tightening=np.full((*random_shape(options)[:2], form.nx + form.nu), size))
    if kind == "another problem's" and options.others:
        other = options.others[int(rng.integers(len(options.others)))]
        return replace(other, problem=options.problem)
    if kind == "parameters" and plan.parameters:
        return replace(plan, parameters={name: value * (1 + size) for name, value in plan.parameters.items()})
    if kind == "not a number":
        return redrawn(plan, pool, lambda s, v, k: added(v, np.where(k == 0, np.nan, 0.0)))
    if kind == "cut":
        name = next(iter(plan.states))
        return replace(plan, states={**plan.states, name: plan.states[name][:-1]})
    return replace(plan, multipliers=plan.multipliers * (1 + by), variables=plan.variables + by)


KINDS = (
    ["moved", "bulged", "drifted", "one interval", "costates", "shifted", "warped", "horizon", "cost", "parameters"]
    + ["tightened"] * 4
    + ["tightened elsewhere", "tightened without rows", "another problem's", "not a number", "cut", "unused"]
)


def tried(kind: str, seed: int) -> Row:
    """What became of an edit: "caught", "harmless", and what is promised and broken in ``wrong``."""
    options, began = subject(kind), time.process_time()
    rng = np.random.default_rng([7, seed, sorted(PLANS).index(kind)])
    what, size = KINDS[int(rng.integers(len(KINDS)))], float(10 ** rng.uniform(-5.0, 0.0))
    wrong: list[str] = []
    share, outcome = np.nan, "refused"
    plan = edited(options, what, rng, size)
    try:
        if rng.random() < 0.3:
            with tempfile.TemporaryDirectory() as folder:
                plan.save(Path(folder) / "plan.npz")
                plan = Solution.load(Path(folder) / "plan.npz")
        passed = plan.audit().passed
    except ProblemError:
        passed = False
    except Exception as error:
        passed = False
        wrong.append(f"foreign {type(error).__name__}")
    else:
        outcome = "harmless" if passed else "caught"
    if passed:
        share = measured(options, plan)
        if share > 1.0:
            wrong.append("passes though it matters")
    seconds = time.process_time() - began
    return {"seconds": seconds, "edit": what, "size": size, "outcome": outcome, "share": share, "wrong": wrong}


def main(arguments: Sequence[str] | None = None) -> int:
    counts = dict.fromkeys(PLANS, EACH)
    options = parser(__doc__, counts).parse_args(arguments)
    sweep = Sweep(__file__, options, counts)
    rows = list(sweep.rows(lambda kind, seed, _: tried(kind, seed)))
    for kind in PLANS:
        own = [row for row in rows if row["kind"] == kind]
        matches = [f"{sum(row['outcome'] == word for row in own)} {word}" for word in ("caught", "refused", "harmless")]
        print(f"{kind:<10} {', '.join(matches)}, {sum(bool(row['wrong']) for row in own)} wrong")
    print(sweep.summary(rows))
    return int(any(row["wrong"] for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
