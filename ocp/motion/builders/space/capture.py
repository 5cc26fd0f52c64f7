"""Capture of a body that tumbles: approach, grasp and detumbling, two phases of one problem.

Chaser and target both float. The target has no joints and nothing acts on it, so that its pose alone is a state,

    R' = [R I^-1 R^T L x] R,    c' = P / m,

and its tip is the frame that is grasped. The chaser's tip reaches that frame with the same twist, at a time that may be
free. From there on both are one machine, the target a link on the chaser's tip: base and joints go on as they were, and
the momentum is that of both (`space.grasping`), a constant that is known before anything is planned. At the end
neither joints nor base turn: the momentum is in the wheels then, which have to be able to hold it
(`ocp.motion.builders.space.guess`). Rest is relative to the centre of mass of the pair, which goes on at P / m.

Virgili-Llop and Romano 2019 (Frontiers in Robotics and AI 6:14) plan both objectives at once, too, without wheels: the
chaser brings the momentum against that of the target, which is `conserved_momentum` here. Each phase at its own least
effort, one after the other, is `chained_capture`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypedDict, Unpack

import casadi as ca
import numpy as np

from models import FreeFloating, center_of_mass, wheels_of
from models.arrays import Array
from ocp.console import interruptible
from ocp.direct.collocation import Collocation
from ocp.errors import ProblemError, checked_instance
from ocp.motion.builders.actuator_limits import Effort, JointFriction
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics import DynamicsSetup, dynamics_problem, end_velocities
from ocp.motion.builders.dynamics_plan import within_limits
from ocp.motion.builders.space.grasping import Cone, Grasp, checked_pair, grasp_wrench, motion_of, pair_momentum
from ocp.motion.builders.space.guess import (
    Start,
    guess_approach,
    guess_braking,
    guessed,
    held_by_wheels,
    require_reach,
    require_room,
)
from ocp.motion.builders.standing.problem import FreeTime
from ocp.motion.tasks.checks import checked_configuration, checked_horizon
from ocp.motion.tasks.limits import Limits
from ocp.problem.phases import Phases
from ocp.problem.problem import Problem
from ocp.solution import Solution

__all__ = ["CaptureOptions", "capture_problem", "chained_capture", "plan_capture"]

APPROACH, DETUMBLE = "approach", "detumble"
POINTS = Collocation(8, degree=4, scheme="legendre")


class CaptureOptions(TypedDict, total=False):
    """Options of `capture_problem`, described there."""

    start_base: Any
    target_base: Any
    start_velocity: Any
    limits: Limits | None
    effort: Effort | None
    friction: JointFriction | None
    cone: Cone | None
    grasp: Grasp | None
    clearance_constraints: ClearanceConstraints | None
    end: Any
    rest: bool


@interruptible
def capture_problem(
    chaser: FreeFloating,
    target: FreeFloating,
    approach: float | FreeTime,
    detumble: float | FreeTime,
    *,
    start: Any,
    **asked: Unpack[CaptureOptions],
) -> Phases:
    """Approach, grasp and detumbling at the least effort of both together.

    Phases "approach" and "detumble", with the states and controls of `dynamics_problem`; the configuration of the
    target is the state "target" of the first, and follows from that of the chaser in the second. Angles of wheels are
    counted from the start of each phase.

    Args:
        chaser: With its arm, and wheels among its joints (`models.with_wheels`); its momentum is that at the start, of
            the wheels that spin, too.
        target: A machine of one link without joints, on the same kind of base, with its momentum; its tip is the frame
            that is grasped, which the chaser's tip meets axis by axis.
        approach, detumble: Durations of the phases, s, or FreeTime(...).
        start: Joints of the chaser. Shape (n,), rad or m.
        asked: start_base, target_base: configurations of both bases at the start; home if None. Shape (base_size,).
            start_velocity: Of the chaser's joints; at rest if None. Shape (n,), rad/s.
            limits, effort, friction: As of `dynamics_problem`, of both phases.
            cone: Of the approach. The tip begins at a distance of twice its length or more, or within it.
            grasp: What the hand bears while detumbling.
            clearance_constraints: Of the chaser while approaching, as of `dynamics_problem`; not the target.
            end: Joints at the end of the detumbling. Shape (n,), nan where free, as those of wheels.
            rest: Whether joints (but for wheels) and base turn no more at the end; True if not given.

    Raises:
        ProblemError: Machines that are none, a target with joints, sizes and values as of `dynamics_problem`; or
            "momentum": rest is asked for, and the wheels cannot take the momentum of both: `value` is its size, `limit`
            what they take at most, N m s; or "reach": the target is farther off, `value`, than the arm is long,
            `limit`, m.
    """
    given = _Capture.of(chaser, target, start, (approach, detumble), asked)
    begin, after = given.approach(approach), given.detumbling(detumble, None)
    given.guess_approach(begin)
    guess_braking(after, given.pair, *_end_of(begin))
    problem = Phases("capture", {APPROACH: begin, DETUMBLE: after})
    one, other = problem[APPROACH], problem[DETUMBLE]
    end = {name: one.at_end(name) for name in ("base", "target", "joints")}
    base, joints, rates = (other.at_start(name) for name in ("base", "joints", "velocities"))
    begins = {
        "joints": ca.DM(given.arm) * end["joints"], "velocities": one.at_end("velocities"),
        "base": given.base_after(end["base"], end["joints"], one.duration),
    }  # fmt: skip
    problem.join(APPROACH, DETUMBLE, begins)
    given.grasp(problem, base, joints, rates, end["target"])
    return problem


@interruptible
def plan_capture(
    chaser: FreeFloating,
    target: FreeFloating,
    approach: float | FreeTime,
    detumble: float | FreeTime,
    *,
    start: Any,
    method: Collocation | None = None,
    options: Mapping[str, Any] | None = None,
    tolerances: Mapping[str, float] | None = None,
    **asked: Unpack[CaptureOptions],
) -> Solution:
    """Solve `capture_problem` and audit the plan, whose limits hold between the nodes, too, as in `plan_dynamics`.

    Args:
        chaser, target, approach, detumble, start, asked: As of `capture_problem`.
        method: The first mesh of both phases, controls at the points; 8 Legendre intervals of degree 4 if None.
        options: Of IPOPT. tolerances: Of the audit, by name.

    Returns:
        The plan; `plan.phase("approach")` and `plan.phase("detumble")` are its phases over their own times.

    Raises:
        ProblemError: As of `capture_problem`.
        SolveError: As of `plan_dynamics`.
    """

    def declare(clearance_constraints: ClearanceConstraints | None) -> Problem:
        kept: CaptureOptions = {**asked, "clearance_constraints": clearance_constraints}
        return capture_problem(chaser, target, approach, detumble, start=start, **kept)

    mesh = POINTS if method is None else method
    driven = {phase: (chaser, asked.get("limits")) for phase in (APPROACH, DETUMBLE)}
    return within_limits(declare, asked.get("clearance_constraints"), mesh, (), options, tolerances, driven)


@interruptible
def chained_capture(
    chaser: FreeFloating,
    target: FreeFloating,
    approach: float | FreeTime,
    detumble: float | FreeTime,
    *,
    start: Any,
    method: Collocation | None = None,
    options: Mapping[str, Any] | None = None,
    tolerances: Mapping[str, float] | None = None,
    **asked: Unpack[CaptureOptions],
) -> tuple[Solution, Solution]:
    """The approach at its own least effort, then the detumbling from where that ends; `plan_capture` costs less.

    Args, Raises: As of `plan_capture`.

    Returns:
        Both plans, each audited by itself.
    """
    mesh = POINTS if method is None else method
    limits = asked.get("limits")
    given = _Capture.of(chaser, target, start, (approach, detumble), asked)
    given.detumbling(detumble, None)  # refused before the approach is solved

    def first(clearance_constraints: ClearanceConstraints | None) -> Problem:
        problem = replace(given, asked={**asked, "clearance_constraints": clearance_constraints}).approach(approach)
        given.grasp(problem, *motion_of(problem), problem.declared.states["target"].symbol)
        given.guess_approach(problem)
        return problem

    one = within_limits(
        first, asked.get("clearance_constraints"), mesh, (), options, tolerances, {"": (chaser, limits)}
    )
    end = dict(one.at_fraction(1.0))
    end["joints"] = given.arm * end["joints"]
    end["base"] = np.array(ca.DM(_of_unit_length(chaser, end["base"]))).ravel()

    def second(_: ClearanceConstraints | None) -> Problem:
        problem = given.detumbling(detumble, end)
        guess_braking(problem, given.pair, end["joints"], end["velocities"], end["base"])
        return problem

    return one, within_limits(second, None, mesh, (), options, tolerances, {"": (given.pair, limits)})


# ---- inside ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Capture:
    """What is asked, checked. `pair` is both as one machine, with their momentum at the start."""

    chaser: FreeFloating
    target: FreeFloating
    pair: FreeFloating
    joints: Array
    base: Array
    target_base: Array
    times: tuple[float | FreeTime, float | FreeTime]
    asked: CaptureOptions

    @classmethod
    def of(
        cls, chaser: FreeFloating, target: FreeFloating, start: Any, times: tuple[Any, Any], asked: CaptureOptions
    ) -> _Capture:
        robot = checked_pair(chaser, target)
        for what, kind in (("cone", Cone), ("grasp", Grasp), ("limits", Limits)):
            if asked.get(what) is not None:
                checked_instance(f"capture: {what}", asked.get(what), kind)
        joints, base = checked_configuration(chaser, start, asked.get("start_base"))
        _, there = checked_configuration(target, np.zeros(0), asked.get("target_base"))
        carried = np.array(ca.DM(pair_momentum(chaser, target, base, there, joints))).ravel()
        pair = replace(chaser, robot=robot, conserved_momentum=carried)
        found = cls(chaser, target, pair, joints, base, there, times, asked)
        if asked.get("rest", True):
            bounds = (asked.get("limits") or Limits()).bounds(chaser)
            held = held_by_wheels(chaser, bounds, found.start, asked.get("friction") is None)
            require_room(chaser, carried, held)
        return found

    @property
    def arm(self) -> Array:
        """1 of joints, 0 of wheels, whose angles do not matter: each phase counts them from zero. Shape (n,)."""
        wheels = wheels_of(self.chaser.robot)
        return np.array([float(name not in wheels) for name in self.chaser.robot.joint_names])

    @property
    def start(self) -> Start:
        """Where it begins, and until when it may take."""
        given = self.asked.get("start_velocity")
        rates = end_velocities("start_velocity", "rest" if given is None else given, self.chaser.joint_size)
        latest = [time.upper if isinstance(time, FreeTime) else checked_horizon(time) for time in self.times]
        return Start(self.base, self.joints, rates, self.target_base, *latest)

    @property
    def shared(self) -> dict[str, Any]:
        """Options of both phases."""
        asked: Mapping[str, Any] = self.asked
        return {name: asked[name] for name in ("limits", "effort") if name in asked}

    def approach(self, duration: float | FreeTime) -> Problem:
        """The first phase: the target's motion, and the grasp at the end."""
        chaser, target, asked = self.chaser, self.target, self.asked
        problem = dynamics_problem(
            chaser,
            (),
            duration,
            start=self.joints,
            setup=DynamicsSetup(
                start_velocity=self.start.velocities,
                end_velocity="free",
                start_base=self.base,
                friction=asked.get("friction"),
                clearance_constraints=asked.get("clearance_constraints"),
            ),
            **self.shared,
        )
        earliest = duration.lower if isinstance(duration, FreeTime) else duration
        require_reach(chaser, target, self.start, earliest)
        base, joints, _ = motion_of(problem)
        none = ca.DM(0, 1)
        goal = problem.state(
            "target", target.base_size, initial=self.target_base, guess=self.target_base, unit="m, rad"
        )
        problem.dynamics(goal, target.base_rate(goal, none, none))
        tip, grasped = chaser.tip_pose(base, joints), target.tip_pose(goal, none)
        place = ca.mtimes(grasped.rotation.T, tip.position - grasped.position)
        cone = asked.get("cone")
        if cone is not None:
            self._require_inside(cone)
            problem.path("cone", cone.inside(place), lower=0.0, unit="m")
        return problem

    def _require_inside(self, cone: Cone) -> None:
        """Raise where the tip starts near the grasp and not in the cone."""
        tip, grasped = self.chaser.tip_pose(self.base, self.joints), self.target.tip_pose(self.target_base, ca.DM(0, 1))
        place = np.array(ca.DM(ca.mtimes(grasped.rotation.T, tip.position - grasped.position)))
        inside = float(cone.inside(ca.DM(place)))
        if inside < 0:
            words = (
                f"capture: the tip starts {np.linalg.norm(place):.4g} m from the grasp and {-inside:.4g} m outside the "
                f"cone, which opens to all directions at {2 * cone.length:.4g} m; start farther away or within it"
            )
            raise ProblemError(words, name="cone", value=inside, limit=0.0)

    def detumbling(self, duration: float | FreeTime, start: Mapping[str, Array] | None) -> Problem:
        """The second phase, from the end of an approach, or free to be joined to one."""
        pair, asked = self.pair, self.asked
        wheels = wheels_of(pair.robot)
        rest = asked.get("rest", True)
        still = np.array([np.nan if name in wheels else 0.0 for name in pair.robot.joint_names])
        setup = DynamicsSetup(
            start_velocity="free" if start is None else start["velocities"],
            end_velocity=still if rest else "free",
            start_base=np.full(pair.base_size, np.nan) if start is None else start["base"],
            friction=asked.get("friction"),
        )
        begin = None if start is None else start["joints"]
        problem = dynamics_problem(pair, (), duration, start=begin, end=asked.get("end"), setup=setup, **self.shared)
        grasp = asked.get("grasp") or Grasp()
        for what, value in zip(("force", "moment"), grasp_wrench(pair, self.target, problem), strict=True):
            most = float(getattr(grasp, what))
            if np.isfinite(most):
                problem.path(f"grasp {what}", ca.sumsqr(value) / most**2, upper=1.0)
        if rest and wheels:
            angular = [k for k, row in enumerate(pair.twist_rows) if row < 3]
            problem.end("base turns", pair.base_twist(*motion_of(problem))[angular], 0.0, 0.0, unit="rad/s")
        return problem

    def grasp(self, problem: Problem, base: Any, joints: Any, rates: Any, goal: Any) -> None:
        """The tip of a chaser in some state on the frame that is grasped, with the same twist, when a problem ends."""
        chaser, target, none = self.chaser, self.target, ca.DM(0, 1)
        tip, grasped = chaser.tip_pose(base, joints), target.tip_pose(goal, none)
        turned = ca.mtimes(grasped.rotation.T, tip.rotation)
        half = ca.vertcat(turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]) / 2
        place = ca.mtimes(grasped.rotation.T, tip.position - grasped.position)
        rows = chaser.twist_rows
        problem.end("grasp pose", ca.vertcat(half, place)[rows], 0.0, 0.0, unit="rad, m")
        problem.end("grasp side", ca.trace(turned), lower=1.0)  # and not half a turn off
        twist = chaser.tip_twist(base, joints, rates) - target.tip_twist(goal, none, none)
        problem.end("grasp twist", twist[rows], 0.0, 0.0, unit="rad/s, m/s")

    def base_after(self, base: Any, joints: Any, time: Any) -> Any:
        """The base at a time by its attitude and the joints alone: nothing pushes the chaser's centre of mass.

        A plan keeps that, and the length of a quaternion, up to its own error. Told once more at the grasp, they would
        be conditions that no control moves, but for that error, and beside which no curvature is decided.
        """
        chaser, size = self.chaser, len(self.chaser.twist_rows) // 2 + (self.chaser.base == "planar")
        attitude = base[size:] if chaser.base == "planar" else base[size:] / ca.norm_2(base[size:])
        there = chaser.world_from_base(ca.vertcat(ca.DM(size, 1), attitude))
        begin = center_of_mass(chaser.robot, ca.DM(self.joints), chaser.world_from_base(ca.DM(self.base)))
        drift = np.asarray(chaser.conserved_momentum)[-size:] / chaser.robot.total_mass
        place = (begin - center_of_mass(chaser.robot, joints, there))[:size] + drift * time
        return ca.vertcat(place, attitude)

    def guess_approach(self, problem: Problem) -> None:
        cone = self.asked.get("cone")
        out = np.zeros(3) if cone is None else cone.length * cone.direction
        guess_approach(
            problem,
            self.chaser,
            self.target,
            self.joints,
            np.nan_to_num(self.start.velocities),
            self.base,
            self.target_base,
            out,
        )


def _end_of(problem: Problem) -> tuple[Array, Array, Array]:
    """Joints, velocities and base where the guess of an approach ends."""
    end = np.array([guessed(problem)])
    guesses = [problem.declared.states[name].guess for name in ("joints", "velocities", "base")]
    joints, rates, base = (np.asarray(guess(end)).ravel() for guess in guesses)
    return joints, rates, base


def _of_unit_length(machine: FreeFloating, base: Any) -> Any:
    """The configuration, its quaternion a unit one."""
    if machine.base == "planar":
        return base
    return ca.vertcat(base[:3], base[3:] / ca.norm_2(base[3:]))
