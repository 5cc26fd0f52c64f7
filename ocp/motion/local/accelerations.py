"""Instantaneous redundancy resolution of a standing machine at acceleration level (Yoo et al. 2004), simulated.

Each law builds q'' task by task: the least accelerations that do a task and leave the earlier tasks unchanged,
equations (20), (22), (26), (33)-(34) corrected. Pinning the zero moment point leaves an inverted pendulum, which falls
while the stability index stays 1. Every run therefore reports the vertical ground force, the zero moment point, joint
limits and rates, and stops with a reason where the foot would lift off or the motion diverges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

import casadi as ca
import numpy as np

from models.arrays import Array
from models.machines.standing import External, Standing, StandingMotion, evaluate_motion, motion_function, wrenches_at
from models.robot.indices import joint_limit_index, manipulability_of
from models.robot.kinematics import center_of_mass_motion, momentum
from ocp.console import interruptible
from ocp.curves import rk4_step
from ocp.errors import (
    ProblemError,
    checked_choice,
    checked_flag,
    checked_instance,
    checked_nonnegative,
    checked_positive,
)
from ocp.motion.local.rates import least_rates
from ocp.motion.tasks.checks import check_length, checked_configuration, checked_horizon, checked_numbers, checked_tasks
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.tip_task import TipTask
from ocp.motion.tasks.tracks import on_symbols
from ocp.motion.tasks.zmp_rules import checked_place, is_finite

__all__ = [
    "AccelerationSolution",
    "Law",
    "Layer",
    "Stabiliser",
    "Stop",
    "accelerations",
    "checked_law",
    "resolve_accelerations",
]

Law: TypeAlias = Literal["pseudo_inverse", "augmented", "null_space", "stabilised"]


@dataclass(frozen=True)
class Layer:
    """A posture index that spare freedom drives, below the task and the zero moment point.

    Attributes:
        index: ``joint_limits``, p1 (23), to be kept small; ``manipulability`` of the tasks' rows, p2 (27), to be kept
            large.
        demand: What is asked: negative makes p1 fall, positive makes p2 grow.
        form: ``assigned``: the second derivative of the index is the demand, (25)-(26), (29)-(33); takes one degree of
            freedom, and accelerations without bound where the index cannot be changed. ``gradient``: demand times the
            projected gradient; bounded, takes all that is left.
    """

    index: Literal["joint_limits", "manipulability"]
    demand: float
    form: Literal["assigned", "gradient"] = "assigned"

    def __post_init__(self) -> None:
        checked_choice("layer: index", self.index, ("joint_limits", "manipulability"))
        checked_choice("layer: form", self.form, ("assigned", "gradient"))
        if not is_finite(self.demand):
            words = f"layer {self.index!r}: demand must be a number, not {self.demand!r}"
            raise ProblemError(words, name="demand", value=self.demand)


@dataclass(frozen=True)
class Stabiliser:
    """Gains of the law that keeps the inverted pendulum over a pinned zero moment point upright.

    The centre of mass is commanded y'' = -k2 y' - k1 (y - y*) + k0 L, with L the moment of momentum about the point,
    which obeys dL/dt = -M g (y - y*): the characteristic polynomial is s^3 + k2 s^2 + k1 s + k0 M g.

    Attributes:
        poles: Minus its roots, three positive numbers, 1/s.
        damping: Of the joint velocities in the freedom that is left, 1/s.
        gradient: Of the joint-limit index p1 in the freedom that is left, 1/s^2.
    """

    poles: tuple[float, float, float] = (4.0, 4.0, 4.0)
    damping: float = 2.0
    gradient: float = 0.0

    def __post_init__(self) -> None:
        poles = self.poles if isinstance(self.poles, Sequence | np.ndarray) else ()
        if len(poles[:4]) != 3 or not all(is_finite(pole) and pole > 0 for pole in poles):
            words = f"stabiliser: poles must be three positive numbers, not {self.poles!r}"
            raise ProblemError(words, name="poles", value=self.poles, limit=0.0)
        for what in ("damping", "gradient"):
            checked_nonnegative(f"stabiliser: {what}", getattr(self, what))


class _Stack:
    """Joint accelerations built task by task, each in the null space of those before."""

    def __init__(self, size: int) -> None:
        self.accelerations: Any = ca.DM.zeros(size)
        self.free: Any = ca.DM.eye(size)

    def do(self, rows: Any, wanted: Any) -> None:
        """Make rows q'' = wanted with the least change."""
        within = ca.mtimes(rows, self.free)
        inverse = least_rates(within, ca.DM.eye(rows.shape[0]))
        self.accelerations = self.accelerations + ca.mtimes(inverse, wanted - ca.mtimes(rows, self.accelerations))
        self.free = self.free - ca.mtimes(inverse, within)

    def push(self, direction: Any) -> None:
        """Add a vector in the freedom that is left."""
        self.accelerations = self.accelerations + ca.mtimes(self.free, direction)


def checked_law(machine: Standing, size: int, law: Law, layers: Sequence[Layer], damping: float) -> None:
    """Raise ProblemError for an unknown law, or one that asks for more than the machine has joints.

    Args:
        size: Rows of all tasks.
    """
    checked_choice("law", law, get_args(Law))
    checked_nonnegative("null_damping", damping)
    if not isinstance(layers, list | tuple) or not all(isinstance(layer, Layer) for layer in layers):
        raise ProblemError(f"layers must be a list of Layer(...), not {layers!r}", name="layers", value=layers)
    axes = len(machine.moving_directions)
    tasks = {"the tip": size, "the zero moment point": 0 if law == "pseudo_inverse" else axes}
    tasks |= {"the centre of mass": axes if law == "stabilised" else 0}
    tasks |= {"the assigned layers": sum(layer.form == "assigned" for layer in layers)}
    needed, size = sum(tasks.values()), machine.joint_size
    if needed > size:
        asked = ", ".join(f"{count} for {what}" for what, count in tasks.items() if count)
        words = f"law {law!r} needs {needed} joints ({asked}), there are {size}"
        raise ProblemError(words, name="law", value=needed, limit=size)


def accelerations(
    machine: Standing,
    equations: TaskEquations,
    law: Law,
    time: Any,
    q: Any,
    qd: Any,
    *,
    zmp: Callable[[Any], Any],
    external: External | None = None,
    layers: Sequence[Layer] = (),
    stabiliser: Stabiliser | None = None,
    null_damping: float = 0.0,
) -> Any:
    """Joint accelerations of a law. Shape (n, 1).

    Args:
        equations: What the tips do.
        law: ``pseudo_inverse``: the tasks alone. ``augmented``: tasks and zero moment point together, (20).
            ``null_space``: the zero moment point in the null space of the tasks, (21)-(22). ``stabilised``: as
            augmented, with the centre of mass commanded in their null space.
        time, q, qd: Symbols of one kind.
        zmp: Where the zero moment point is to be, (x, y) of the time, m, in the directions in which motion moves it.
        layers: Applied in this order after the law.
        null_damping: Of the joint velocities in the freedom that is left at last, 1/s.
    """
    directions, none = ca.DM(machine.moving_directions), ca.DM(0, 1)
    wrenches = wrenches_at(external, time, machine.tip_pose((), q).position)
    jacobian = equations.jacobian(none, q)
    task = -equations.acceleration(none, q, qd, ca.DM(machine.joint_size, 1), time)
    place = zmp(time)
    zmp_rows = machine.zmp_rows(q, qd, place, wrenches)
    balance, needed = ca.mtimes(directions, zmp_rows.jacobian), ca.mtimes(directions, zmp_rows.needed(qd))

    stack = _Stack(machine.joint_size)
    if law in ("pseudo_inverse", "null_space"):
        stack.do(jacobian, task)
    if law == "null_space":
        stack.do(balance, needed)
    if law in ("augmented", "stabilised"):
        stack.do(ca.vertcat(jacobian, balance), ca.vertcat(task, needed))
    for layer in layers:
        _apply(layer, stack, _index(layer, machine, jacobian, q), q, qd)
    if law == "stabilised":
        gains = stabiliser or Stabiliser()
        stack.do(*_upright(machine, gains, q, qd, place, zmp_rows.right))
        stack.push(-gains.damping * qd - gains.gradient * ca.gradient(joint_limit_index(machine.robot, q), q))
    if null_damping:
        stack.push(-null_damping * qd)
    return stack.accelerations


def _index(layer: Layer, machine: Standing, jacobian: Any, q: Any) -> Any:
    if layer.index == "joint_limits":
        return joint_limit_index(machine.robot, q)
    return manipulability_of(jacobian)


def _apply(layer: Layer, stack: _Stack, index: Any, q: Any, qd: Any) -> None:
    slope = ca.jacobian(index, q)
    if layer.form == "gradient":
        stack.push(layer.demand * slope.T)
    else:
        stack.do(slope, layer.demand - ca.jtimes(ca.mtimes(slope, qd), q, qd))


def _upright(machine: Standing, gains: Stabiliser, q: Any, qd: Any, place: Any, right: Any) -> tuple[Any, Any]:
    """Rows and values of the commanded acceleration of the centre of mass.

    `right` is C of (18), minus the moment of weight and wrenches over the place: it vanishes for a centre of mass
    at y*, and C / (M g) is how far the centre of mass is beyond y*, with its sign turned.
    """
    a, b, c = gains.poles
    k2, k1, k0 = a + b + c, a * b + b * c + c * a, a * b * c / machine.weight
    rest = ca.DM.zeros(machine.joint_size)
    motion = center_of_mass_motion(machine.robot, q, qd, rest, machine.world_from_base())
    rows = ca.jacobian(motion.position, q)[:2, :]
    about = ca.vertcat(place, 0)
    spin = momentum(machine.robot, q, qd, about, machine.world_from_base())
    lean = ca.vertcat(-spin[1], spin[0])  # grows with the fall towards -x, -y
    wanted = -k2 * motion.velocity[:2] + k1 * right / machine.weight + k0 * lean - motion.acceleration[:2]
    directions = ca.DM(machine.moving_directions)
    return ca.mtimes(directions, rows), ca.mtimes(directions, wanted)


@dataclass(frozen=True)
class StepSettings:
    """How a motion by accelerations is integrated and looked at.

    Attributes:
        chunk: Steps between two looks at the motion.
        tip_tolerance: m and rad, by which the tip may miss its task before the motion stops.
        cvodes_steps: Of the integrator between two samples.
    """

    chunk: int = 50
    tip_tolerance: float = 1e-3
    cvodes_steps: int = 5000


STEPPING = StepSettings()


@dataclass(frozen=True)
class Stop:
    """Why a motion ends before its horizon.

    Attributes:
        reason: ``lift_off``: the ground would have to pull. ``divergence``: a joint is faster than the speed limit.
            ``breakdown``: the accelerations, the integration or the forces are not finite: a task cannot be done
            there, or `external` gives no number.
        time: When, s.
        message: The same in words, with the numbers.
    """

    reason: Literal["lift_off", "divergence", "breakdown"]
    time: float
    message: str


@dataclass(frozen=True)
class AccelerationSolution:
    """A motion by instantaneous resolution.

    Attributes:
        law: What made it.
        motion: Positions, velocities, accelerations and what they take, at every step up to the end or the stop, the
            instant of which is the last where it has finite numbers.
        tip_error: Norm of the pose errors in the tasks' rows, m and rad; zero for velocities. Shape (M,).
        stopped: Why it ends before the horizon; None when it does not.
    """

    law: Law
    motion: StandingMotion
    tip_error: Array
    stopped: Stop | None

    @property
    def failures(self) -> tuple[str, ...]:
        """What is wrong with the motion, () if nothing: a reason to stop, or one of those that do not end it.

        ``lift_off``, ``divergence``, ``breakdown`` as for Stop; ``leaves_foot``: the zero moment point does;
        ``joint_limits``; ``leaves_path``: a tip leaves its pose, by more than 1e-3 (m or rad).
        """
        motion = self.motion
        wrong = {
            "lift_off": not motion.stays_on_ground,
            "leaves_foot": not motion.stays_in_foot,
            "joint_limits": not motion.stays_in_limits,
            "leaves_path": not bool((self.tip_error <= STEPPING.tip_tolerance).all()),
        }
        first = () if self.stopped is None else (self.stopped.reason,)
        return (*first, *(name for name, is_wrong in wrong.items() if is_wrong and name not in first))

    @property
    def succeeded(self) -> bool:
        """Whether it reaches the horizon on the ground, inside the foot, within the joint limits and on its path."""
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
    start_joints: Any,
    horizon: float,
    *,
    law: Law = "pseudo_inverse",
    start_velocities: Any = None,
    zmp: Callable[[Any], Any] | Any = None,
    external: External | None = None,
    layers: Sequence[Layer] = (),
    stabiliser: Stabiliser | None = None,
    null_damping: float = 0.0,
    step: float = 1e-3,
    integrator: Literal["rk4", "cvodes"] = "rk4",
    tolerance: float = 1e-10,
    stop_at_lift_off: bool = True,
    speed_limit: float = 20.0,
) -> AccelerationSolution:
    """Simulate a law from the start to the horizon, or until it fails.

    Args:
        machine: A Standing machine.
        tasks: A TipTask, or several that are done at once.
        start_joints: Shape (n,), rad or m.
        horizon: Final time, s.
        law: ``pseudo_inverse``, ``augmented`` (20), ``null_space`` (21)-(22) or ``stabilised``.
        start_velocities: Shape (n,); at rest if None.
        zmp: (x, y) where the laws other than the first keep the zero moment point, or a function of a casadi time that
            returns it; the machine's most stable point if None.
        external: Wrenches from outside as a function of time and tip position.
        layers: Posture indices driven by the freedom that is left, in sequence, (23)-(34).
        stabiliser: Gains of the stabilised law.
        null_damping: Damping of the joint velocities in the freedom left at last, 1/s.
        step: Of the fixed-step integration, and between samples, s.
        integrator: ``rk4`` with fixed steps or ``cvodes`` with error control.
        tolerance: Absolute and relative, of cvodes.
        stop_at_lift_off: Whether a vertical ground force that is not positive ends the motion.
        speed_limit: Joint speed, rad/s or m/s, above which the motion counts as diverged.

    Raises:
        ProblemError: Something does not fit the machine, or the tasks cannot be done even at the start.
    """
    equations, duration = bind(checked_instance("machine", machine, Standing), tasks), checked_horizon(horizon)
    checked_flag("stop_at_lift_off", stop_at_lift_off)
    joints, base = checked_configuration(machine, start_joints, None)
    checked_law(machine, equations.size, law, layers, null_damping)
    for what, number in (("step", step), ("tolerance", tolerance), ("speed_limit", speed_limit)):
        checked_positive(what, number)
    checked_choice("integrator", integrator, ("rk4", "cvodes"))
    checked_tasks(equations, base, joints, duration)
    check_length(equations, base, duration)
    n = machine.joint_size
    given = np.zeros(n) if start_velocities is None else start_velocities
    velocities = checked_numbers(given, n, "start_velocities", "one entry for each joint")
    if not isinstance(stabiliser, Stabiliser | None):
        words = f"stabiliser must be a Stabiliser(...), not {stabiliser!r}"
        raise ProblemError(words, name="stabiliser", value=stabiliser)
    place = _target(machine.most_stable_point if zmp is None else zmp)

    def law_function(symbols: Any) -> Any:
        time, q, qd = symbols.sym("time"), symbols.sym("q", n), symbols.sym("qd", n)
        qdd = accelerations(
            machine, equations, law, time, q, qd, zmp=place, external=external, layers=layers,
            stabiliser=stabiliser, null_damping=null_damping,
        )  # fmt: skip
        gap = ca.norm_2(equations.error(ca.DM(0, 1), q, equations.targets(time)))
        return ca.Function("law", [time, q, qd], [ca.densify(qdd), gap], {"cse": True})

    function = on_symbols(law_function)
    if not np.isfinite(np.array(function(0.0, joints, velocities)[0])).all():
        words = (
            f"law {law!r} has no accelerations at the start joints {joints.tolist()}: a task, the zero moment "
            "point or a layer cannot be moved there; start elsewhere or ask for less"
        )
        raise ProblemError(words, name="law", value=law, time=0.0)
    steps = max(int(np.ceil(duration / step - 1e-9)), 1)
    simulate = _Simulation(function, n, duration / steps, integrator, tolerance)
    reported = motion_function(machine, external, lambda q: equations.jacobian(ca.DM(0, 1), q))
    watch = _Watch(reported, function, stop_at_lift_off, speed_limit)
    state, done = np.concatenate([joints, velocities]), 0
    stopped = watch.look(np.zeros(1), state[None, :])
    while done < steps and stopped is None:
        count = min(STEPPING.chunk, steps - done)
        times = np.asarray((done + np.arange(1, count + 1)) * simulate.step, dtype=float)
        stopped = watch.look(times, simulate.advance(done * simulate.step, state, count))
        state, done = watch.state, done + count
    return AccelerationSolution(law, watch.motion(), watch.gaps(), stopped)


def _target(zmp: Callable[[Any], Any] | Any) -> Callable[[Any], Any]:
    if callable(zmp):
        return lambda time: checked_place(zmp(time), "zmp")
    point = checked_place(zmp, "zmp")
    return lambda time: point


class _Simulation:
    """Advances the state (q, q') by a fixed step, many at a time."""

    def __init__(self, law: Any, n: int, step: float, integrator: str, tolerance: float) -> None:
        self.step, self._law, self._n = step, law, n
        time, state = ca.MX.sym("time"), ca.MX.sym("state", 2 * n)

        def rate(at: Any, x: Any) -> Any:
            return ca.vertcat(x[n:], law(at, x[:n], x[n:])[0])

        if integrator == "cvodes":
            fraction = ca.MX.sym("fraction")
            problem = {"t": fraction, "x": state, "p": time, "ode": step * rate(time + step * fraction, state)}
            options = {
                "abstol": tolerance,
                "reltol": tolerance,
                "max_num_steps": STEPPING.cvodes_steps,
                "disable_internal_warnings": True,
                "show_eval_warnings": False,
            }
            solver = ca.integrator("motion", "cvodes", problem, 0.0, 1.0, options)
            after = solver(x0=state, p=time)["xf"]
        else:
            after = rk4_step(lambda place, x: rate(time + place * step, x), state, step)
        self._once = ca.Function("step", [state, time], [after])
        self._many: dict[int, Any] = {}

    def advance(self, time: float, state: Array, count: int) -> Array:
        """States after each of `count` steps, nan from where the integration fails. Shape (count, 2 n)."""
        times = time + self.step * np.arange(count)
        if count not in self._many:
            self._many[count] = self._once.mapaccum("steps", count)
        try:
            return np.array(self._many[count](state, times[None, :])).T
        except RuntimeError:  # the integrator gives up somewhere: go step by step
            reached = np.full((count, 2 * self._n), np.nan)
            for i, at in enumerate(times):
                try:
                    state = np.array(self._once(state, at)).ravel()
                except RuntimeError:
                    break
                reached[i] = state
            return reached


class _Watch:
    """Evaluates what has been reached, keeps what is sound and says why the rest is not."""

    def __init__(self, motion: Any, law: Any, stop_at_lift_off: bool, speed_limit: float) -> None:
        self._motion, self._law = motion, law
        self._stop_at_lift_off, self._speed_limit = stop_at_lift_off, speed_limit
        self._kept: list[dict[str, Array]] = []
        self.state = np.zeros(0)

    def look(self, times: Array, states: Array) -> Stop | None:
        n = states.shape[1] // 2
        q, qd = states[:, :n], states[:, n:]
        qdd, gap = (np.array(part).T for part in self._law.map(len(times))(times[None, :], q.T, qd.T))
        found = evaluate_motion(self._motion, times, q, qd, qdd)
        lost = ~np.isfinite(np.hstack([states, qdd, found["ground_force"]])).all(axis=1)
        vertical = found["ground_force"][:, 2]
        speed = np.abs(qd).max(axis=1)
        fast = speed > self._speed_limit
        lifted = (vertical <= 0) & self._stop_at_lift_off
        bad = lost | fast | lifted
        end = int(bad.argmax()) if bad.any() else len(times)
        kept = end + 1 if bad.any() and not lost[end] else end  # show what goes wrong where it has numbers
        motion = {"t": times, "joints": q, "joint_velocities": qd, "joint_accelerations": qdd, "gap": gap[:, 0]}
        self._kept.append({name: value[:kept] for name, value in {**motion, **found}.items()})
        self.state = states[-1]
        if end == len(times):
            return None
        at = float(times[end])
        if lost[end]:
            words = f"breaks down at {at:.4g} s: accelerations that do the tasks, or forces, are not finite"
            return Stop("breakdown", at, words)
        if lifted[end]:
            words = f"lifts off at {at:.4g} s: the vertical ground force falls to {vertical[end]:.4g} N"
            return Stop("lift_off", at, words)
        words = f"diverges at {at:.4g} s: a joint reaches {speed[end]:.4g} rad/s (or m/s), above {self._speed_limit:g}"
        return Stop("divergence", at, words)

    def _joined(self) -> dict[str, Array]:
        return {name: np.concatenate([part[name] for part in self._kept]) for name in self._kept[0]}

    def motion(self) -> StandingMotion:
        return StandingMotion(**{name: value for name, value in self._joined().items() if name != "gap"})

    def gaps(self) -> Array:
        return self._joined()["gap"]
