"""Capture of a tumbling body: approach, grasp and detumbling as two phases of one optimal control problem.

Chaser and target both float. The target has no joints and no external forces act on it. Its pose alone is a state
(attitude R, centre of mass c), with constant inertia I, mass m, angular momentum L and linear momentum P:

    R' = [R I^-1 R^T L x] R,    c' = P / m,

and its tip is the grasped frame, which the chaser's tip reaches with the same twist. From then on both are one machine,
with their total momentum. At the end neither joints nor base turn, relative to the centre of mass of the pair, and the
wheels hold the momentum. Virgili-Llop and Romano 2019 (Frontiers in Robotics and AI 6:14) also plan both objectives
together, but without wheels: there the chaser's momentum cancels that of the target.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from models import FreeFloating, center_of_mass, find_wheels
from models.checks import Array
from models.spatial import Expression, Frame
from ocp.console import interruptible
from ocp.direct.discretisation import Collocation
from ocp.errors import ProblemError, require
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics import DynamicsSetup, JointFriction, dynamics_problem, end_velocities
from ocp.motion.builders.dynamics_plan import SolveSettings, within_limits
from ocp.motion.builders.space.pair import (
    State,
    checked_pair,
    grasp_wrench,
    guess_approach,
    guess_braking,
    motion_of,
    pair_momentum,
    require_capacity,
    require_reach,
    wheel_capacity,
)
from ocp.motion.builders.standing.problem import FreeTime
from ocp.motion.tasks.checks import checked_configuration
from ocp.motion.tasks.goals import Cost, Start
from ocp.motion.tasks.limits import Limits
from ocp.problem.phases import Phases
from ocp.problem.problem import Problem, remembers_request
from ocp.solution import Solution

APPROACH, DETUMBLE = "approach", "detumble"
POINTS = Collocation(8, degree=4, scheme="legendre")


@dataclass(frozen=True)
class Cone:
    """Approach cone, fixed in the grasped frame, to which the chaser's tip is confined when it is near the grasp.

    Attributes:
        direction: Direction from the grasp to the approaching tip, in the grasped frame. Shape (3,).
        half_angle: Half opening angle of the cone, rad.
        length: Distance from the grasp up to which it is a cone, m. At twice this distance it is open to all
            directions.
        depth: Distance of the apex behind the grasp, m. It leaves play at the grasp itself.

    Raises:
        ProblemError: The direction is zero, the angle is not between 0 and pi/2, or a length is not positive.
    """

    direction: Any
    half_angle: float
    length: float
    depth: float = 0.01

    def __post_init__(self) -> None:
        direction = require.array("cone: direction", self.direction, (3,))
        if not direction.any():
            raise ProblemError("cone: direction must not be zero", name="direction", value=self.direction)
        object.__setattr__(self, "direction", direction / np.linalg.norm(direction))
        require.positive("cone: half_angle", self.half_angle, below=np.pi / 2)
        require.positive("cone: length", self.length)
        require.positive("cone: depth", self.depth)

    def inside(self, place: Expression) -> Expression:
        """Return a constraint function, positive inside the cone, of a tip position (3, 1) in the grasped frame, m."""
        from_apex = place + self.depth * ca.DM(self.direction)
        share = ca.fmin(ca.fmax((ca.sumsqr(place) / self.length**2 - 1) / 3, 0), 1)
        opened = share**2 * (3 - 2 * share)
        least = np.cos(self.half_angle) * (1 - opened) - 2 * opened
        return ca.dot(ca.DM(self.direction), from_apex) - least * ca.norm_2(from_apex)


@dataclass(frozen=True)
class Grasp:
    """Load limits of the hand that holds the target.

    Attributes:
        force, moment: Largest norms at the tip, N and N m; inf for no limit.

    Raises:
        ProblemError: A limit is not positive.
    """

    force: float = np.inf
    moment: float = np.inf

    def __post_init__(self) -> None:
        for name, limit in vars(self).items():
            require.array(f"grasp: {name}", limit, (), entries="numbers", sign="positive")


@dataclass(frozen=True, eq=False)
class Capture:
    """Approach, grasp and detumbling of a tumbling body by a free-floating chaser whose tip moves to the grasped frame.

    Attributes:
        target: Machine of one link without joints, on the same kind of base as the chaser, with its momentum. Its tip
            is the grasped frame, which the chaser's tip meets axis by axis.
        approach, detumble: Durations of the phases, s, or FreeTime(...).
        target_base: Configuration of the target at the start; home if None. Shape (base_size,).
        cone: Approach cone. The tip starts at twice its length or farther, or inside it.
        grasp: Load limits of the hand during detumbling.
        friction: Friction in the joints of the chaser.
        end: Joint positions at the end of the detumbling. Shape (n,), nan where free, for example for wheels.
        rest: Whether base and joints, except wheels, are at rest at the end.
    """

    target: FreeFloating
    approach: float | FreeTime
    detumble: float | FreeTime
    target_base: Any = None
    cone: Cone | None = None
    grasp: Grasp | None = None
    friction: JointFriction | None = None
    end: Any = None
    rest: bool = True

    def __post_init__(self) -> None:
        for name, kind in (("cone", Cone), ("grasp", Grasp), ("friction", JointFriction)):
            if getattr(self, name) is not None:
                require.instance(f"capture: {name}", getattr(self, name), kind)
        require.flag("capture: rest", self.rest)


@remembers_request("capture")
@interruptible
def capture_problem(
    chaser: FreeFloating,
    capture: Capture,
    *,
    start: Any,
    limits: Limits | None = None,
    cost: Cost | None = None,
    clearance_constraints: ClearanceConstraints | None = None,
) -> Phases:
    """Declare the optimal control problem of the capture of a tumbling body at the least total cost of both phases.

    The phases "approach" and "detumble" have the states and controls of `dynamics_problem`. The configuration of the
    target is the state "target" of the first, and follows from that of the chaser in the second. Wheel angles count
    from the start of each phase.

    Args:
        chaser: Chaser with its arm, and wheels among its joints (`models.with_wheels`), with its momentum at the start.
        start: Joint positions of the chaser, shape (n,), rad or m, or a `Start` with base and velocities.
        limits, cost: Arguments of `dynamics_problem` for both phases.
        clearance_constraints: Collision avoidance of the chaser during the approach, without the target.

    Raises:
        ProblemError: Machines, sizes or values are invalid, see `dynamics_problem`, or the target has joints. With name
            "momentum": the wheels cannot hold the momentum of both at rest; `value` is its norm and `limit` the largest
            that they hold, N m s. With name "reach": `value` is the distance of the target and `limit` the reach of the
            arm, m.
    """
    own = _Capture.checked(chaser, capture, start, {"limits": limits, "cost": cost})
    second, first = own.declare_second_phase(None), own.approach(clearance_constraints)
    guesses = (first.declared.states[name].guess for name in ("joints", "velocities", "base"))
    guess_braking(second, own.pair, tuple(guess.values[-1] for guess in guesses))
    problem = Phases("capture", {APPROACH: first, DETUMBLE: second})
    before, after = problem[APPROACH], problem[DETUMBLE]
    end = {name: before.at_end(name) for name in ("base", "target", "joints")}
    base, joints, rates = (after.at_start(name) for name in ("base", "joints", "velocities"))
    initial = {
        "joints": ca.DM(own.arm_mask) * end["joints"], "velocities": before.at_end("velocities"),
        "base": own.base_after(end["base"], end["joints"], before.duration),
    }  # fmt: skip
    problem.join(APPROACH, DETUMBLE, initial)
    own.grasp(problem, base, joints, rates, end["target"])
    return problem


@interruptible
def solve_capture(
    chaser: FreeFloating,
    capture: Capture,
    *,
    clearance_constraints: ClearanceConstraints | None = None,
    method: Collocation = POINTS,
    **options: Any,
) -> Solution:
    """Solve `capture_problem` so that limits hold between the mesh nodes as well, starting on the mesh `method`."""

    def declare(constraints: ClearanceConstraints | None) -> Problem:
        return capture_problem(chaser, capture, clearance_constraints=constraints, **options)

    machines = dict.fromkeys((APPROACH, DETUMBLE), (chaser, options.get("limits")))
    return within_limits(declare, clearance_constraints, machines, settings=SolveSettings(method))


@interruptible
def chained_capture(
    chaser: FreeFloating,
    capture: Capture,
    *,
    start: Any,
    limits: Limits | None = None,
    cost: Cost | None = None,
    clearance_constraints: ClearanceConstraints | None = None,
    method: Collocation = POINTS,
) -> tuple[Solution, Solution]:
    """Plan a capture phase by phase: the approach at the lowest cost, then the detumbling from the end of the approach.

    The total cost exceeds that of `capture_problem`, which has the same arguments.

    Args:
        method: First mesh of both phases, with controls at the points; 8 Legendre intervals of degree 4 by default.

    Returns:
        Both solutions, each with its own audit.

    Raises:
        ProblemError: As `capture_problem`.
        SolveError: No motion satisfies its limits.
    """
    settings = SolveSettings(require.instance("method", method, Collocation))
    own = _Capture.checked(chaser, capture, start, {"limits": limits, "cost": cost})
    own.declare_second_phase(None)  # raises before the approach is solved

    def declare_approach(constraints: ClearanceConstraints | None) -> Problem:
        problem = own.approach(constraints)
        own.grasp(problem, *motion_of(problem), problem.declared.states["target"].symbol)
        return problem

    first = within_limits(declare_approach, clearance_constraints, {"": (chaser, limits)}, settings=settings)
    end = dict(first.at_fraction(1.0))
    end["joints"] = own.arm_mask * end["joints"]
    end["base"] = np.array(ca.DM(_of_unit_length(chaser, end["base"]))).ravel()

    def declare_detumbling(_: ClearanceConstraints | None) -> Problem:
        problem = own.declare_second_phase(end)
        guess_braking(problem, own.pair, (end["joints"], end["velocities"], end["base"]))
        return problem

    return first, within_limits(declare_detumbling, None, {"": (own.pair, limits)}, settings=settings)


def capture_machines(chaser: FreeFloating, target: FreeFloating) -> tuple[FreeFloating, FreeFloating]:
    """Return the machines of both phases of a capture: the chaser, and chaser and target as one machine."""
    return chaser, replace(chaser, robot=checked_pair(chaser, target))


@dataclass(frozen=True, eq=False)
class _Capture:
    """Checked arguments of a capture, and the machine that consists of chaser and target with their total momentum."""

    chaser: FreeFloating
    capture: Capture
    pair: FreeFloating
    start: State
    shared: Mapping[str, Any]

    @classmethod
    def checked(cls, chaser: FreeFloating, capture: Capture, start: Any, shared: Mapping[str, Any]) -> _Capture:
        target = require.instance("capture", capture, Capture).target
        robot = checked_pair(chaser, target)
        begin, joints, base = Start.of(start, chaser, known=True)
        target_base = checked_configuration(target, np.zeros(0), capture.target_base)[1]
        configurations = {"base": base, "target_base": target_base, "joints": joints}
        momentum = np.array(ca.DM(pair_momentum(chaser, target, **configurations))).ravel()
        pair = replace(chaser, robot=robot, conserved_momentum=momentum)
        rates = end_velocities("start_velocity", begin.velocity, chaser.joint_size)
        times = (capture.approach, capture.detumble)
        latest = [time.upper if isinstance(time, FreeTime) else require.positive("horizon", time) for time in times]
        state = State(base, joints, rates, target_base, *latest)
        if capture.rest:
            bounds = (shared["limits"] or Limits()).bounds(chaser)
            require_capacity(chaser, momentum, wheel_capacity(chaser, bounds, state, capture.friction is None))
        return cls(chaser, capture, pair, state, shared)

    @property
    def arm_mask(self) -> Array:
        """Mask with 1 for arm joints and 0 for reaction wheels, whose angles count from 0 again in the detumbling."""
        wheels = find_wheels(self.chaser.robot)
        return np.array([float(name not in wheels) for name in self.chaser.robot.joint_names])

    def approach(self, clearance_constraints: ClearanceConstraints | None) -> Problem:
        """Declare the problem of the approach, with the target's pose as a state and the tip confined to a cone."""
        chaser, target, duration, start = self.chaser, self.capture.target, self.capture.approach, self.start
        setup = DynamicsSetup(
            start_velocity=start.velocities,
            end_velocity="free",
            start_base=start.base,
            friction=self.capture.friction,
            clearance_constraints=clearance_constraints,
        )
        problem = dynamics_problem(chaser, (), duration, start=start.joints, setup=setup, **self.shared)
        require_reach(chaser, target, start, duration.lower if isinstance(duration, FreeTime) else duration)
        base, joints, _ = motion_of(problem)
        none, begin, cone = ca.DM(0, 1), start.target_base, self.capture.cone
        goal = problem.state("target", target.base_size, initial=begin, guess=begin, unit="m, rad")
        problem.dynamics(goal, target.base_rate(goal, none, none))
        if cone is not None:
            self._require_inside(cone)
            problem.path("cone", cone.inside(self.tip_in_grasp(base, joints, goal).position), lower=0.0, unit="m")
        out = np.zeros(3) if cone is None else cone.length * cone.direction
        guess_approach(problem, chaser, target, start, out=out)
        return problem

    def tip_in_grasp(self, base: Any, joints: Any, goal: Any) -> Frame:
        """Return the pose of the chaser's tip in the grasped frame of a target with base configuration `goal`."""
        tip, grasped = self.chaser.tip_pose(base, joints), self.capture.target.tip_pose(goal, ca.DM(0, 1))
        back = grasped.rotation.T
        return Frame(ca.mtimes(back, tip.rotation), ca.mtimes(back, tip.position - grasped.position))

    def _require_inside(self, cone: Cone) -> None:
        """Raise ProblemError if the tip starts near the grasp but outside the cone of approach."""
        place = ca.DM(self.tip_in_grasp(self.start.base, self.start.joints, self.start.target_base).position)
        distance, inside = float(ca.norm_2(place)), float(cone.inside(place))
        if inside < 0:
            words = f"capture: the tip starts {distance:.4g} m from the grasp and {-inside:.4g} m outside the cone, "
            words += f"which is open to all directions at {2 * cone.length:.4g} m; start farther away or inside it"
            raise ProblemError(words, name="cone", value=inside, limit=0.0)

    def declare_second_phase(self, start: Mapping[str, Array] | None) -> Problem:
        """Declare the problem of the detumbling; its initial state is free if `start` is None."""
        pair, capture = self.pair, self.capture
        wheels, rest = find_wheels(pair.robot), capture.rest
        still = np.array([np.nan if name in wheels else 0.0 for name in pair.robot.joint_names])
        setup = DynamicsSetup(
            start_velocity="free" if start is None else start["velocities"],
            end_velocity=still if rest else "free",
            start_base=np.full(pair.base_size, np.nan) if start is None else start["base"],
            friction=capture.friction,
        )
        begin = None if start is None else start["joints"]
        problem = dynamics_problem(pair, (), capture.detumble, start=begin, end=capture.end, setup=setup, **self.shared)
        grasp = capture.grasp or Grasp()
        for name, value in zip(("force", "moment"), grasp_wrench(pair, capture.target, problem), strict=True):
            largest = float(getattr(grasp, name))
            if np.isfinite(largest):
                problem.path(f"grasp {name}", ca.sumsqr(value) / largest**2, upper=1.0)
        if rest and wheels:
            angular = [k for k, row in enumerate(pair.twist_rows) if row < 3]
            problem.end("base turns", pair.base_twist(*motion_of(problem))[angular], 0.0, 0.0, unit="rad/s")
        return problem

    def grasp(self, problem: Problem, base: Any, joints: Any, rates: Any, goal: Any) -> None:
        """Add the end condition that the chaser's tip has the pose and the twist of the grasped frame."""
        tip, rows, none = self.tip_in_grasp(base, joints, goal), self.chaser.twist_rows, ca.DM(0, 1)
        problem.end("grasp pose", ca.vertcat(ca.inv_skew(tip.rotation), tip.position)[rows], 0, 0, unit="rad, m")
        problem.end("grasp side", ca.trace(tip.rotation), lower=1.0)  # excludes half a turn
        twist = self.chaser.tip_twist(base, joints, rates) - self.capture.target.tip_twist(goal, none, none)
        problem.end("grasp twist", twist[rows], 0.0, 0.0, unit="rad/s, m/s")

    def base_after(self, base: Any, joints: Any, time: Any) -> Any:
        """Return the base configuration at a time: its position follows from uniform motion of the centre of mass.

        The dynamics conserve this motion and the norm of the quaternion. Their continuity would be a condition that no
        control influences, and would leave the second-order conditions undetermined.
        """
        chaser, size = self.chaser, len(self.chaser.twist_rows) // 2 + (self.chaser.base == "planar")
        attitude = _of_unit_length(chaser, base)[size:]
        there = chaser.world_from_base(ca.vertcat(ca.DM(size, 1), attitude))
        begin = center_of_mass(chaser.robot, ca.DM(self.start.joints), chaser.world_from_base(ca.DM(self.start.base)))
        drift = np.asarray(chaser.conserved_momentum)[-size:] / chaser.robot.total_mass
        place = (begin - center_of_mass(chaser.robot, joints, there))[:size] + drift * time
        return ca.vertcat(place, attitude)


def _of_unit_length(machine: FreeFloating, base: Any) -> Any:
    """Scale the quaternion of a base configuration to unit length; return planar configurations unchanged."""
    if machine.base == "planar":
        return base
    return ca.vertcat(base[:3], base[3:] / ca.norm_2(base[3:]))
