"""Instantaneous redundancy resolution of a standing machine at acceleration level (Yoo et al. 2004).

Each law builds the joint accelerations task by task: the least that do a task and leave the earlier tasks unchanged,
equations (20), (22), (26), (33)-(34) corrected. Pinning the zero moment point leaves an inverted pendulum, which falls
while the stability index stays 1. Every simulation therefore reports vertical ground force, zero moment point, joint
limits and rates, and stops with a reason if the foot lifts off or the motion diverges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal, TypeAlias, get_args

import casadi as ca
import numpy as np

from models.checks import Array
from models.machines.machine import Wrenches, wrenches_at
from models.machines.standing import Standing, StandingMotion, evaluate_motion, motion_function
from models.robot.dynamics import center_of_mass_motion, momentum
from models.robot.kinematics import joint_limit_index, manipulability_of
from ocp.console import interruptible
from ocp.curves import rk4_step
from ocp.errors import ProblemError, require
from ocp.motion.local.rates import least_rates
from ocp.motion.tasks.checks import check_length, checked_tasks
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.goals import Start
from ocp.motion.tasks.limits import prescribed_point
from ocp.motion.tasks.tip_task import TipTask
from ocp.motion.tasks.tracks import on_symbols

Law: TypeAlias = Literal["pseudo_inverse", "augmented", "null_space", "stabilised"]


@dataclass(frozen=True)
class Layer:
    """Secondary objective: an index of the configuration that joint motion in the null space of the tasks improves.

    Attributes:
        index: ``joint_limits``, p1 of equation (23) of Yoo et al. 2004, to be decreased; ``manipulability`` of the rows
            of the tasks, p2 of (27), to be increased.
        demand: Negative to decrease p1, positive to increase p2.
        form: ``assigned``: the second derivative of the index equals the demand, (25)-(26), (29)-(33); takes one degree
            of freedom, with unbounded accelerations where the index is stationary. ``gradient``: demand times the
            projected gradient; bounded, takes all remaining freedom.
    """

    index: Literal["joint_limits", "manipulability"]
    demand: float
    form: Literal["assigned", "gradient"] = "assigned"

    def __post_init__(self) -> None:
        require.choice("layer: index", self.index, ("joint_limits", "manipulability"))
        require.choice("layer: form", self.form, ("assigned", "gradient"))
        require.number("layer: demand", self.demand)


@dataclass(frozen=True)
class Stabiliser:
    """Gains of the control law that keeps a machine upright over a fixed zero moment point, like an inverted pendulum.

    The centre of mass is commanded y'' = -k2 y' - k1 (y - y*) + k0 L, with L the angular momentum about the point,
    dL/dt = -M g (y - y*): the characteristic polynomial is s^3 + k2 s^2 + k1 s + k0 M g.

    Attributes:
        poles: Negated roots of the polynomial, three positive numbers, 1/s.
        damping: Damping of the joint velocities in the remaining freedom, 1/s.
        gradient: Gain of the gradient of the joint-limit index p1 in the remaining freedom, 1/s^2.
    """

    poles: tuple[float, float, float] = (4.0, 4.0, 4.0)
    damping: float = 2.0
    gradient: float = 0.0

    def __post_init__(self) -> None:
        require.array("stabiliser: poles", self.poles, (3,), sign="positive")
        for gain in ("damping", "gradient"):
            require.nonnegative(f"stabiliser: {gain}", getattr(self, gain))


@dataclass(frozen=True, eq=False)
class AccelerationOptions:
    """Options of a resolved-acceleration law and of its simulation.

    Attributes:
        zmp: Target (x, y) of the zero moment point, not for ``pseudo_inverse``, m, in the directions in which motion
            moves it, or a function of CasADi time that returns it; the machine's most stable point if None.
        layers: Configuration indices that the remaining freedom improves, in this order after the law, (23)-(34).
        stabiliser: Gains of the stabilised law.
        null_damping: Damping of the joint velocities in the freedom that remains at the end, 1/s.
        stop_at_lift_off: Whether a vertical ground force that is not positive ends the motion.
        speed_limit: Joint speed, rad/s or m/s, above which the motion counts as diverged.

    Raises:
        ProblemError: A value is invalid.
    """

    zmp: Callable[[Any], Any] | Any = None
    layers: Sequence[Layer] = ()
    stabiliser: Stabiliser = field(default_factory=Stabiliser)
    null_damping: float = 0.0
    stop_at_lift_off: bool = True
    speed_limit: float = 20.0

    def __post_init__(self) -> None:
        if not isinstance(self.layers, list | tuple) or not all(isinstance(layer, Layer) for layer in self.layers):
            words = f"layers must be a list of Layer(...), not {self.layers!r}"
            raise ProblemError(words, name="layers", value=self.layers)
        require.instance("stabiliser", self.stabiliser, Stabiliser)
        require.nonnegative("null_damping", self.null_damping)
        require.flag("stop_at_lift_off", self.stop_at_lift_off)
        require.positive("speed_limit", self.speed_limit)


class _TaskHierarchy:
    """Joint accelerations that perform tasks of decreasing priority, each in the null space of the tasks before."""

    def __init__(self, size: int) -> None:
        self.accelerations: Any = ca.DM.zeros(size)
        self.projector: Any = ca.DM.eye(size)

    def add_task(self, rows: Any, target: Any) -> None:
        """Add the task `rows` q'' = `target`, with the least change of q'' in the null space of all tasks before."""
        projected = ca.mtimes(rows, self.projector)
        inverse = least_rates(projected, ca.DM.eye(rows.shape[0]))
        self.accelerations = self.accelerations + ca.mtimes(inverse, target - ca.mtimes(rows, self.accelerations))
        self.projector = self.projector - ca.mtimes(inverse, projected)

    def add_free(self, direction: Any) -> None:
        """Add given joint accelerations after projecting them onto the null space of all tasks added before."""
        self.accelerations = self.accelerations + ca.mtimes(self.projector, direction)


def _check_law(machine: Standing, size: int, law: Law, layers: Sequence[Layer]) -> None:
    """Raise ProblemError if a control law is unknown, or needs more joints for `size` task rows than there are."""
    require.choice("law", law, get_args(Law))
    axes = len(machine.moving_directions)
    tasks = {"the tip": size, "the zero moment point": 0 if law == "pseudo_inverse" else axes}
    tasks |= {"the centre of mass": axes if law == "stabilised" else 0}
    tasks |= {"the assigned layers": sum(layer.form == "assigned" for layer in layers)}
    needed, size = sum(tasks.values()), machine.joint_size
    if needed > size:
        listed = ", ".join(f"{count} for {name}" for name, count in tasks.items() if count)
        words = f"law {law!r} needs {needed} joints ({listed}), there are {size}"
        raise ProblemError(words, name="law", value=needed, limit=size)


def accelerations(
    machine: Standing,
    equations: TaskEquations,
    law: Law,
    state: tuple[Any, Any, Any],
    *,
    wrenches: Wrenches = (),
    options: AccelerationOptions | None = None,
) -> Any:
    """Return the joint accelerations that a redundancy resolution law commands. Shape (n, 1).

    Args:
        law: ``pseudo_inverse``: the tasks alone. ``augmented``: tasks and zero moment point together, equation (20).
            ``null_space``: the zero moment point in the null space of the tasks, (21)-(22). ``stabilised``: like
            augmented, with the centre of mass commanded in their null space.
        state: Time, joint positions and joint velocities, symbols of one kind.
        wrenches: External wrenches: a list, or a function of time and tip position.
    """
    (time, q, qd), own = state, options or AccelerationOptions()
    directions, no_base = ca.DM(machine.moving_directions), ca.DM(0, 1)
    acting = wrenches_at(wrenches, machine, (), q, time=time)
    jacobian = equations.jacobian(no_base, q)
    task = -equations.acceleration(no_base, q, qd, ca.DM(machine.joint_size, 1), progress=(time,))
    place = prescribed_point(own.zmp, machine, time, "zmp")
    zmp_rows = machine.zmp_rows(q, qd, place, acting)
    balance, needed = ca.mtimes(directions, zmp_rows.jacobian), ca.mtimes(directions, zmp_rows.needed(qd))

    hierarchy = _TaskHierarchy(machine.joint_size)
    if law in ("pseudo_inverse", "null_space"):
        hierarchy.add_task(jacobian, task)
    if law == "null_space":
        hierarchy.add_task(balance, needed)
    if law in ("augmented", "stabilised"):
        hierarchy.add_task(ca.vertcat(jacobian, balance), ca.vertcat(task, needed))
    for layer in own.layers:
        limits = layer.index == "joint_limits"
        index = joint_limit_index(machine.robot, q) if limits else manipulability_of(jacobian)
        gradient = ca.jacobian(index, q)
        if layer.form == "gradient":
            hierarchy.add_free(layer.demand * gradient.T)
        else:
            hierarchy.add_task(gradient, layer.demand - ca.jtimes(ca.mtimes(gradient, qd), q, qd))
    if law == "stabilised":
        gains = own.stabiliser
        hierarchy.add_task(*_stabilising_task(machine, gains, q, qd, place, zmp_rows.right))
        hierarchy.add_free(-gains.damping * qd - gains.gradient * ca.gradient(joint_limit_index(machine.robot, q), q))
    if own.null_damping:
        hierarchy.add_free(-own.null_damping * qd)
    return hierarchy.accelerations


def _stabilising_task(machine: Standing, gains: Stabiliser, q: Any, qd: Any, place: Any, right: Any) -> tuple[Any, Any]:
    """Return matrix and right side of the equations for the joint accelerations that keep a machine upright.

    `right` is C of equation (18), minus the moment of weight and wrenches about `place`, y*: it vanishes for a centre
    of mass at y*, and -C / (M g) is the distance of the centre of mass beyond y*.
    """
    a, b, c = gains.poles
    k2, k1, k0 = a + b + c, a * b + b * c + c * a, a * b * c / machine.weight
    rest = ca.DM.zeros(machine.joint_size)
    motion = center_of_mass_motion(machine.robot, q, qd, rest, world_from_base=machine.world_from_base())
    rows = ca.jacobian(motion.position, q)[:2, :]
    pivot = ca.vertcat(place, 0)
    angular_momentum = momentum(machine.robot, q, qd, about=pivot, world_from_base=machine.world_from_base())
    momentum_xy = ca.vertcat(-angular_momentum[1], angular_momentum[0])  # grows as the machine falls towards -x, -y
    target = -k2 * motion.velocity[:2] + k1 * right / machine.weight + k0 * momentum_xy - motion.acceleration[:2]
    directions = ca.DM(machine.moving_directions)
    return ca.mtimes(directions, rows), ca.mtimes(directions, target)


TIP_TOLERANCE = 1e-3  # largest pose error up to which a motion counts as successful, m and rad
STEPS_PER_CALL = 50  # number of integration steps between two checks whether the motion fails


@dataclass(frozen=True)
class Stop:
    """Reason why a simulated motion ends before its horizon, and the time at which it ends.

    ``lift_off``: the vertical ground force is not positive. ``divergence``: a joint exceeds the speed limit.
    ``breakdown``: accelerations, states or forces are not finite: a task cannot be done, or `wrenches` are no numbers.
    """

    reason: Literal["lift_off", "divergence", "breakdown"]
    time: float
    message: str


@dataclass(frozen=True)
class AccelerationSolution:
    """Motion that results from an acceleration-level control law."""

    law: Law
    motion: StandingMotion  # at every step up to the end or the stop, whose sample is the last one if it is finite
    tip_error: Array  # norm of the pose errors in the rows of the tasks, m and rad; zero for velocities, (M,)
    stopped: Stop | None  # why the motion ends before the horizon; None if it does not

    @property
    def failures(self) -> tuple[str, ...]:
        """Names of the requirements that the motion fails; empty if the motion succeeds.

        ``lift_off``, ``divergence``, ``breakdown`` as for Stop; ``leaves_foot``: the zero moment point leaves the
        support; ``joint_limits``; ``leaves_path``: a tip leaves its pose by more than 1e-3 (m or rad).
        """
        motion = self.motion
        failed = {
            "lift_off": not motion.stays_on_ground,
            "leaves_foot": not motion.stays_in_foot,
            "joint_limits": not motion.stays_in_limits,
            "leaves_path": not bool((self.tip_error <= TIP_TOLERANCE).all()),
        }
        first = () if self.stopped is None else (self.stopped.reason,)
        return (*first, *(name for name, value in failed.items() if value and name not in first))

    @property
    def succeeded(self) -> bool:
        """Whether the motion reaches its horizon and none of the `failures` occurs."""
        return not self.failures

    def __repr__(self) -> str:
        return f"<AccelerationSolution by {self.law}: {', '.join(self.failures) or 'succeeds'}>"

    def __str__(self) -> str:
        end = "reaches the horizon" if self.stopped is None else self.stopped.message
        verdict = ", ".join(self.failures) or "succeeds"
        return f"law {self.law}: {end} ({verdict})\n{self.motion}"


@interruptible
def resolve_accelerations(
    machine: Standing,
    tasks: TipTask | Sequence[TipTask],
    horizon: float,
    *,
    start: Any,
    law: Law = "pseudo_inverse",
    wrenches: Wrenches = (),
    step: float = 1e-3,
    options: AccelerationOptions | None = None,
) -> AccelerationSolution:
    """Simulate a standing machine under a resolved-acceleration law up to the horizon, or until the motion fails.

    Args:
        tasks: A TipTask, or several that are done at once.
        horizon, step: Final time, and step of the integration and between samples, s.
        start: Start configuration, shape (n,), rad or m, or a `Start` with the joints and their velocities.
        law: ``pseudo_inverse``, ``augmented`` (20), ``null_space`` (21)-(22) or ``stabilised``.
        wrenches: External wrenches: a list, or a function of time and tip position.

    Raises:
        ProblemError: An argument does not fit the machine, or the tasks cannot be done at the start.
    """
    equations = bind(require.instance("machine", machine, Standing), tasks)
    duration, n = require.positive("horizon", horizon), machine.joint_size
    own = AccelerationOptions() if options is None else require.instance("options", options, AccelerationOptions)
    begin, joints, base = Start.of(start, machine, known=True)
    _check_law(machine, equations.size, law, own.layers)
    require.positive("step", step)
    checked_tasks(equations, base, joints, duration)
    check_length(equations, base, duration)
    at_rest = isinstance(begin.velocity, str) and begin.velocity == "rest"
    rates = np.zeros(n) if at_rest else begin.velocity
    velocities = require.array("start: velocity", rates, (n,), meaning="one entry for each joint")

    def law_function(symbols: Any) -> Any:
        time, q, qd = state = symbols.sym("time"), symbols.sym("q", n), symbols.sym("qd", n)
        qdd = accelerations(machine, equations, law, state, wrenches=wrenches, options=own)
        gap = ca.norm_2(equations.error(ca.DM(0, 1), q, equations.targets(time)))
        return ca.Function("law", [time, q, qd], [ca.densify(qdd), gap], {"cse": True})

    function = on_symbols(law_function)
    if not np.isfinite(np.array(function(0.0, joints, velocities)[0])).all():
        words = f"law {law!r} has no accelerations at the start joints {joints.tolist()}: a task, the zero moment "
        words += "point or a layer is singular there; start elsewhere or remove it"
        raise ProblemError(words, name="law", value=law, time=0.0)
    steps = max(int(np.ceil(duration / step - 1e-9)), 1)
    width, time, state = duration / steps, ca.MX.sym("time"), ca.MX.sym("state", 2 * n)

    def rate(place: float, x: Any) -> Any:
        return ca.vertcat(x[n:], function(time + place * width, x[:n], x[n:])[0])

    one_step = ca.Function("step", [state, time], [rk4_step(rate, state, width)])
    advance = cache(lambda count: one_step.mapaccum("steps", count))
    outputs = motion_function(machine, wrenches, lambda q: equations.jacobian(ca.DM(0, 1), q))
    states, done = np.concatenate([joints, velocities])[None, :], 0
    first, stopped = _samples(outputs, function, np.zeros(1), states, own)
    records = [first]
    while done < steps and stopped is None:
        count = min(STEPS_PER_CALL, steps - done)
        states = np.array(advance(count)(states[-1], (done * width + width * np.arange(count))[None, :])).T
        times = np.asarray((done + np.arange(1, count + 1)) * width)
        record, stopped = _samples(outputs, function, times, states, own)
        records.append(record)
        done += count
    whole = {name: np.concatenate([record[name] for record in records]) for name in first}
    gap = whole.pop("gap")
    return AccelerationSolution(law, StandingMotion(**whole), gap, stopped)


def _samples(
    motion: Any, law: Any, times: Array, states: Array, options: AccelerationOptions
) -> tuple[dict[str, Array], Stop | None]:
    """Return samples of a motion by name up to the first failure, and the reason: lift-off, too fast, or not finite.
    They include a failed sample that is finite; "gap" is the norm of the tips' pose errors.
    """
    q, qd = np.split(states, 2, axis=1)
    qdd, gap = (np.array(part).T for part in law.map(len(times))(times[None, :], q.T, qd.T))
    outputs = evaluate_motion(motion, times, q, qd, qdd=qdd)
    not_finite = ~np.isfinite(np.hstack([states, qdd, outputs["ground_force"]])).all(axis=1)
    vertical, speed = outputs["ground_force"][:, 2], np.abs(qd).max(axis=1)
    lifted = (vertical <= 0) & options.stop_at_lift_off
    bad = not_finite | (speed > options.speed_limit) | lifted
    end = int(bad.argmax()) if bad.any() else len(times)
    outputs |= {"t": times, "joints": q, "joint_velocities": qd, "joint_accelerations": qdd, "gap": gap[:, 0]}
    count = end + int(bad.any() and not not_finite[end])
    record = {name: value[:count] for name, value in outputs.items()}
    if end == len(times):
        return record, None
    at = float(times[end])
    if not_finite[end]:
        words = f"breaks down at {at:.4g} s: accelerations that do the tasks, or forces, are not finite"
        return record, Stop("breakdown", at, words)
    if lifted[end]:
        words = f"lifts off at {at:.4g} s: the vertical ground force falls to {vertical[end]:.4g} N"
        return record, Stop("lift_off", at, words)
    limit = options.speed_limit
    words = f"diverges at {at:.4g} s: a joint reaches {speed[end]:.4g} rad/s (or m/s), above {limit:g}"
    return record, Stop("divergence", at, words)
