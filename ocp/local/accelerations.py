"""Instantaneous redundancy resolution of a standing machine at acceleration level, simulated and reported.

The method of Yoo et al. 2004 that optimal plans are compared with. A stability index of 1 is no success by itself:
pinning the zero moment point leaves an inverted pendulum, which falls while the index stays 1. So every run reports
the vertical ground force, the place of the zero moment point in the foot, joint limits and rates, and stops with a
reason where the foot would lift off or the motion diverges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np

from models.arrays import Array
from models.machines.standing import External, Standing
from models.machines.standing_motion import StandingMotion, evaluate, motion_function
from ocp.console import interruptible
from ocp.curves import rk4_step
from ocp.errors import ProblemError, checked_choice, checked_flag, checked_instance, checked_positive
from ocp.local.laws import Law, Layer, Stabiliser, accelerations, checked_law
from ocp.tasks.checks import check_length, checked_configuration, checked_horizon, checked_numbers, checked_tasks
from ocp.tasks.equations import bind
from ocp.tasks.tip_task import TipTask
from ocp.tasks.tracks import on_symbols
from ocp.tasks.zmp_rules import checked_place

__all__ = ["AccelerationSolution", "Layer", "Stabiliser", "Stop", "resolve_accelerations"]


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
        found = evaluate(self._motion, times, q, qd, qdd)
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
