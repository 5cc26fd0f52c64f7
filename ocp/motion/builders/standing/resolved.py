"""Steps as the pseudo-inverse takes them, beside plans: each foot on its way, the least joint rates at every instant.

Nothing looks at what the ground can bear. With all feet held nothing moves; where the zero moment point leaves the
soles, or a sole would have to pull, the machine falls.

What a motion over changing support asks of the feet, the ground and the joints, at sampled times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from models.arrays import Array
from models.machines.stance import Stance
from models.paths import rest_to_rest
from models.robot.kinematics import link_frames
from models.spatial import rotation
from ocp.errors import ProblemError, SolveError, checked_count, checked_instance, checked_nonnegative
from ocp.motion.builders.standing.stances import Steps, Swing, check_placed, foot_task
from ocp.motion.local.rates import resolve
from ocp.motion.tasks.checks import checked_numbers
from ocp.motion.tasks.tip_task import TipTask
from ocp.solution import Solution

__all__ = ["StepsMotion", "resolve_steps", "steps_motion"]

SAMPLES = 101


@dataclass(frozen=True, eq=False)
class StepsMotion:
    """A motion of a machine over its stances at M times; where a phase meets the next both sides are there.

    Attributes:
        steps: The machine and its stances.
        t: Times. Shape (M,), s. phase: Which phase each belongs to. Shape (M,).
        joints, joint_velocities, joint_accelerations, joint_torques: In the robot's order. Shape (M, n).
        root_position, root_rotation: Frame of the robot's root link in the world. Shapes (M, 3), m, and (M, 3, 3).
        center_of_mass: Shape (M, 3), m.
        loads: By foot, (moment about the origin of its sole's frame, force), world axes; zero in the air. (M, 6).
        sole_position, sole_rotation: By foot, of its sole's frame. Shapes (M, 3), m, and (M, 3, 3).
        zero_moment_point: Of the sum of the loads, (x, y). Shape (M, 2), m.
        margin: Its distance from the edge of the hull of the soles, positive inside; nan with a grip. Shape (M,), m.
        balance: The same of the center of mass. Shape (M,), m.

    Loads besides the first foot's are given, those planned say; the first bears the rest.
    """

    steps: Steps
    t: Array
    phase: Array
    joints: Array
    joint_velocities: Array
    joint_accelerations: Array
    joint_torques: Array
    root_position: Array
    root_rotation: Array
    center_of_mass: Array
    loads: Mapping[str, Array]
    sole_position: Mapping[str, Array]
    sole_rotation: Mapping[str, Array]
    zero_moment_point: Array
    margin: Array
    balance: Array

    def held(self, foot: str) -> NDArray[np.bool_]:
        """When a foot is held. Shape (M,), bool."""
        held = np.array([foot in phase.footholds for phase in self.steps.phases], dtype=bool)
        return np.asarray(held[self.phase.astype(int)], dtype=bool)

    def center_of_pressure(self, foot: str) -> Array:
        """In the plane of the sole, x and y of its frame; nan in the air. Shape (M, 2), m."""
        turn, load = self.sole_rotation[foot], self.loads[foot]
        moment, force = (np.einsum("kji,kj->ki", turn, part) for part in (load[:, :3], load[:, 3:]))
        with np.errstate(divide="ignore", invalid="ignore"):
            points = np.column_stack([-moment[:, 1], moment[:, 0]]) / force[:, 2:]
        points[~self.held(foot)] = np.nan
        return np.asarray(points)

    def _force(self, foot: str) -> Array:
        """On a foot, in the axes of its sole. Shape (M, 3), N."""
        return np.asarray(np.einsum("kji,kj->ki", self.sole_rotation[foot], self.loads[foot][:, 3:]))

    def friction(self, foot: str) -> Array:
        """Force along the sole over that which presses it: the coefficient it takes; nan in the air. Shape (M,)."""
        force = self._force(foot)
        with np.errstate(divide="ignore", invalid="ignore"):
            needed = np.linalg.norm(force[:, :2], axis=1) / force[:, 2]
        return np.asarray(np.where(self.held(foot), needed, np.nan))

    def summary(self) -> dict[str, float]:
        """The extremes, by name."""
        soles = [name for name, foot in self.steps.feet.items() if foot.sole is not None]
        return {
            "duration_s": float(self.t[-1]),
            "zmp_margin_min_m": float(np.nanmin(self.margin)),
            "com_margin_min_m": float(np.nanmin(self.balance)),
            "pressure_min_n": float(min(self._force(name)[self.held(name), 2].min() for name in soles)),
            "friction_max": float(max(np.nanmax(self.friction(name)) for name in soles)),
            "peak_joint_velocity": float(np.abs(self.joint_velocities).max()),
            "peak_joint_torque": float(np.abs(self.joint_torques).max()),
        }


def steps_motion(steps: Steps, solution: Solution, samples: int = SAMPLES) -> StepsMotion:
    """A plan of `steps_problem`, sampled.

    Args:
        steps: What it was planned for.
        solution: The plan.
        samples: In each phase, both of its ends among them.

    Raises:
        ProblemError: A plan of other phases.
    """
    checked_instance("steps_motion: steps", steps, Steps)
    checked_instance("steps_motion: solution", solution, Solution)
    count = checked_count("steps_motion: samples", samples, least=2)
    times = solution.phases
    if tuple(times) != steps.names:
        words = f"steps_motion: the plan has the phases {list(times)}, the steps {list(steps.names)}"
        raise ProblemError(words, name="solution", value=tuple(times), limit=steps.names)
    parts: list[dict[str, Array]] = []
    share = np.linspace(0.0, 1.0, count)
    for k, name in enumerate(steps.names):
        stance = steps.stances[k]
        values = solution.phase(name).at_fraction(share)
        others = {foot: values[f"{foot} load"] for foot in stance.other_feet}
        motion = tuple(values[part] for part in ("joints", "velocities", "accelerations"))
        found = sampled(steps, stance, motion, others)
        begin, end = times[name]
        parts.append({"t": begin + (end - begin) * share, "phase": np.full(count, float(k)), **found})
    return motion_of(steps, parts)


def motion_of(steps: Steps, parts: Sequence[Mapping[str, Array]]) -> StepsMotion:
    """The whole of what `sampled` found in the phases, with "t" and "phase"."""
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def feet(what: str) -> dict[str, Array]:
        return {foot: whole.pop(f"{foot} {what}") for foot in steps.feet}

    loads, places, turns = feet("load"), feet("position"), feet("rotation")
    return StepsMotion(steps, loads=loads, sole_position=places, sole_rotation=turns, **whole)


def sampled(steps: Steps, stance: Stance, motion: tuple[Array, ...], others: Mapping[str, Array]) -> dict[str, Array]:
    """What a motion (q, q', q'') in one stance takes, in its order; `others` in the rows that are held. (M, ...)."""
    q, qd, qdd = motion
    function, names = _function(steps, stance)
    stacked = np.column_stack([np.zeros((len(q), 0)), *others.values()])
    outputs = function.map(len(q))(q.T, qd.T, qdd.T, stacked.T)
    values = {name: np.array(ca.DM(value)).T for name, value in zip(names, outputs, strict=True)}
    order = steps.order(stance)
    for name, part in (("joints", q), ("joint_velocities", qd), ("joint_accelerations", qdd)):
        values[name] = steps.in_order(stance, part)
    values["joint_torques"] = values["joint_torques"][:, np.argsort(order)]
    for name, value in values.items():
        if name.endswith("rotation"):
            values[name] = value.reshape(-1, 3, 3).transpose(0, 2, 1)
    for name, points in (("margin", values["zero_moment_point"]), ("balance", values["center_of_mass"][:, :2])):
        support = stance.support
        corners = np.zeros((0, 2)) if support is None else np.asarray(support.vertices)
        inside = np.full((len(q), 1), np.nan)
        if support is not None:
            inside = points @ support.normals.T - (support.normals * corners).sum(axis=1)
        values[name] = inside.min(axis=1)
    return values


def _function(steps: Steps, stance: Stance) -> tuple[Any, list[str]]:
    n = stance.joint_size
    q, qd, qdd = (ca.SX.sym(name, n) for name in ("q", "qd", "qdd"))
    given = {name: ca.SX.sym("load", len(stance.load_rows[name])) for name in stance.other_feet}
    others = {name: stance.full_load(name, rows) for name, rows in given.items()}
    loads = stance.loads(q, qd, qdd, others)
    root = link_frames(stance.robot, q, stance.world_from_base())[steps.robot.root]
    outputs = {
        "joint_torques": stance.joint_torques(q, qd, qdd, others),
        "root_position": root.position,
        "root_rotation": ca.vec(root.rotation),
        "center_of_mass": stance.center_of_mass(q),
        "zero_moment_point": stance.zero_moment_point(loads),
    }
    for name in steps.feet:
        frame = stance.sole_frame(name, q)
        outputs[f"{name} load"] = loads.get(name, ca.DM.zeros(6))
        outputs[f"{name} position"] = frame.position
        outputs[f"{name} rotation"] = ca.vec(frame.rotation)
    inputs = [q, qd, qdd, ca.vertcat(ca.SX(0, 1), *given.values())]
    return ca.Function("motion", inputs, [ca.densify(v) for v in outputs.values()], {"cse": True}), list(outputs)


def resolve_steps(steps: Steps, start_joints: Any, *, clearance: float = 0.02, samples: int = SAMPLES) -> StepsMotion:
    """Take the stances one after the other with the least joint rates at every instant (`resolve`).

    A foot that is lifted goes to its next foothold from rest to rest, straight when it is seen from above, raised by
    64 s^3 (1 - s)^3 of the clearance at the share s of its way; one that lands nowhere goes where the others take it.
    Feet that hold share the load by the least squares of their loads.

    Args:
        steps: The robot and its stances; a duration that is free is taken as guessed.
        start_joints: In the robot's order, with the feet on their footholds. Shape (n,).
        clearance: Height of a sole above its way in the middle, m.
        samples: In each phase, both of its ends among them.

    Raises:
        ProblemError: Sizes or values that do not fit, a start off the footholds.
        SolveError: The motion breaks down, at a leg that is stretched say; names the phase and the time in it.
    """
    checked_instance("resolve_steps: steps", steps, Steps)
    height = checked_nonnegative("resolve_steps: clearance", clearance)
    count = checked_count("resolve_steps: samples", samples, least=2)
    joints = checked_numbers(start_joints, steps.robot.dof, "start_joints", "one entry for each joint")
    check_placed(steps.stances[0], joints[steps.order(steps.stances[0])])
    parts, begin = [], 0.0
    for k, stance in enumerate(steps.stances):
        t = np.linspace(0.0, steps.phases[k].seconds, count)
        motion = _phase(steps, k, joints[steps.order(stance)], t, height)
        found = sampled(steps, stance, motion, _shared(stance, motion))
        joints = found["joints"][-1]
        parts.append({"t": begin + t, "phase": np.full(count, float(k)), **found})
        begin += t[-1]
    return motion_of(steps, parts)


def _phase(steps: Steps, k: int, joints: Array, t: Array, clearance: float) -> tuple[Array, Array, Array]:
    """Joints, their rates and accelerations in the order of the stance of phase k, (M, n) each."""
    stance = steps.stances[k]
    swings = [swing for swing in steps.swings(k) if swing.lifted is not None and swing.landing is not None]
    if not swings:
        still = np.zeros((len(t), len(joints)))
        return still + joints, still, still
    tasks = [
        foot_task(stance, name, place.position, place.rotation)
        for name, place in stance.footholds.items()
        if name in stance.other_feet
    ]
    tasks += [_on_its_way(stance, swing, t[-1], clearance) for swing in swings]
    found = resolve(stance, tasks=tasks, start_joints=joints, horizon=t[-1], samples=t)
    if found.stopped is not None:
        words = f"phase {steps.names[k]!r}: the pseudo-inverse breaks down at {found.t[-1]:.4g} s: {found.stopped}"
        raise SolveError(words, name=steps.names[k], time=float(found.t[-1]))
    return found.joints, found.joint_rates, CubicSpline(t, found.joint_rates).derivative()(t)


def _on_its_way(stance: Stance, swing: Swing, seconds: float, clearance: float) -> TipTask:
    """A foot from where it lifts to where it lands, from rest to rest."""
    assert swing.lifted is not None
    assert swing.landing is not None
    lifted, landing = swing.lifted, swing.landing
    first, last = np.asarray(lifted.rotation), np.asarray(landing.rotation)
    turn = Rotation.from_matrix(last @ first.T).as_rotvec()
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle else np.array([0.0, 0.0, 1.0])

    def position(t: Any) -> Any:
        s = t / seconds
        way = rest_to_rest(s) * ca.DM(np.asarray(landing.position) - np.asarray(lifted.position))
        return ca.DM(np.asarray(lifted.position)) + way + 64 * (s * (1 - s)) ** 3 * clearance * ca.DM(last[:, 2])

    def orientation(t: Any) -> Any:
        return ca.mtimes(rotation(ca.DM(axis), angle * rest_to_rest(t / seconds)), ca.DM(first))

    return foot_task(stance, swing.name, position, orientation if angle else last, duration=seconds)


def _shared(stance: Stance, motion: tuple[Array, Array, Array]) -> dict[str, Array]:
    """Loads of the feet besides the first, in the rows that are held, (M, k): the least squares of all of them."""
    sizes = {name: len(stance.load_rows[name]) for name in stance.other_feet}
    if not sizes:
        return {}
    q, qd, qdd = (ca.SX.sym(name, stance.joint_size) for name in ("q", "qd", "qdd"))
    given = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    others = {name: stance.full_load(name, rows) for name, rows in given.items()}
    every = ca.vertcat(*stance.loads(q, qd, qdd, others).values())
    free = ca.vertcat(*given.values())
    slope = ca.jacobian(every, free)
    rest = ca.substitute(every, free, ca.DM.zeros(free.shape))
    least = -ca.solve(ca.mtimes(slope.T, slope), ca.mtimes(slope.T, rest))
    function = ca.Function("shared", [q, qd, qdd], [ca.densify(least)], {"cse": True})
    values = np.array(function.map(len(motion[0]))(*(part.T for part in motion))).T
    return dict(zip(sizes, np.split(values, np.cumsum([*sizes.values()])[:-1], axis=1), strict=True))
