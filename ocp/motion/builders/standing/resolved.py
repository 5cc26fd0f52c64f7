"""Sampled motions of legged machines whose support changes, from plans or from resolved-rate control.

`StepsMotion` has the loads of the feet, the zero moment point and the joint torques of a motion. `steps_motion` samples
a plan of `steps_problem`. `resolve_steps` tracks the same footholds with the least joint rates at every time, as a
baseline: it ignores what the ground can bear. The machine falls where the zero moment point leaves the soles, or where
a sole would have to pull.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray

from models.checks import Array
from models.machines.stance import Stance
from models.paths import rest_to_rest
from models.robot.kinematics import link_frames
from models.spatial import rotation
from ocp.errors import ProblemError, SolveError, require
from ocp.motion.builders.standing.stances import Steps, Swing, check_placed, foot_task
from ocp.motion.local.rates import resolve
from ocp.motion.tasks.tip_task import TipTask
from ocp.solution import Solution

SAMPLES = 101


@dataclass(frozen=True, eq=False)
class StepsMotion:
    """Motion of a legged machine through its stances (sets of feet on the ground) at M times.

    The time at which two phases meet occurs twice. The loads of all feet but the first are given, for example planned.
    The first foot bears the rest.

    Attributes:
        steps: Machine and its stances.
        t: Times. Shape (M,), s.
        phase: Index of the phase of each time. Shape (M,).
        joints, joint_velocities, joint_accelerations, joint_torques: In the robot's joint order. Shape (M, n).
        root_position, root_rotation: Frame of the robot's root link in world. Shapes (M, 3), m, and (M, 3, 3).
        center_of_mass: Its position in world. Shape (M, 3), m.
        loads: By foot: moment about the origin of its sole's frame, and force, in world axes; zero in the air. Shape
            (M, 6), N m and N.
        sole_position, sole_rotation: By foot: frame of its sole in world. Shapes (M, 3), m, and (M, 3, 3).
        zero_moment_point: (x, y) of the sum of the loads. Shape (M, 2), m.
        margin: Distance of the zero moment point from the edge of the hull of the soles, positive inside; nan with a
            grip. Shape (M,), m.
        balance: The same distance of the center of mass. Shape (M,), m.
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
        """Return at which of the M times a foot is on the ground. Shape (M,), bool."""
        by_phase = np.array([foot in phase.footholds for phase in self.steps.phases], dtype=bool)
        return np.asarray(by_phase[self.phase.astype(int)], dtype=bool)

    def center_of_pressure(self, foot: str) -> Array:
        """Return the center of pressure (x, y) of a foot in the frame of its sole; nan in the air. Shape (M, 2), m."""
        turn, load = self.sole_rotation[foot], self.loads[foot]
        moment, force = (np.einsum("kji,kj->ki", turn, part) for part in (load[:, :3], load[:, 3:]))
        with np.errstate(divide="ignore", invalid="ignore"):
            points = np.column_stack([-moment[:, 1], moment[:, 0]]) / force[:, 2:]
        points[~self.held(foot)] = np.nan
        return np.asarray(points)

    def _force(self, foot: str) -> Array:
        """Return the contact force on a foot in the axes of its sole. Shape (M, 3), N."""
        return np.asarray(np.einsum("kji,kj->ki", self.sole_rotation[foot], self.loads[foot][:, 3:]))

    def friction(self, foot: str) -> Array:
        """Return the tangential over the normal force of a foot, which friction bears; nan in the air. Shape (M,)."""
        force = self._force(foot)
        with np.errstate(divide="ignore", invalid="ignore"):
            needed = np.linalg.norm(force[:, :2], axis=1) / force[:, 2]
        return np.asarray(np.where(self.held(foot), needed, np.nan))

    def summary(self) -> dict[str, float]:
        """Return duration, smallest margins and largest loads of the motion by name, with their units."""
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
    """Sample a plan of footsteps at evenly spaced times of each phase, including foot loads and joint torques.

    Args:
        steps: Steps of the plan.
        solution: Plan.
        samples: Number of samples of each phase, both ends included.

    Raises:
        ProblemError: The plan has other phases.
    """
    require.instance("steps_motion: steps", steps, Steps)
    require.instance("steps_motion: solution", solution, Solution)
    count = require.count("steps_motion: samples", samples, least=2)
    times = solution.phases
    if tuple(times) != steps.names:
        words = f"steps_motion: the plan has the phases {list(times)}, the steps {list(steps.names)}"
        raise ProblemError(words, name="solution", value=tuple(times), limit=steps.names)
    parts: list[dict[str, Array]] = []
    share = np.linspace(0.0, 1.0, count)
    for k, name in enumerate(steps.names):
        stance = steps.stances[k]
        values = solution.phase(name).at_fraction(share)
        foot_loads = {foot: values[f"{foot} load"] for foot in stance.other_feet}
        motion = tuple(values[part] for part in ("joints", "velocities", "accelerations"))
        quantities = sample_stance(steps, stance, motion, foot_loads)
        begin, end = times[name]
        parts.append({"t": begin + (end - begin) * share, "phase": np.full(count, float(k)), **quantities})
    return motion_of(steps, parts)


def motion_of(steps: Steps, parts: Sequence[Mapping[str, Array]]) -> StepsMotion:
    """Join the quantities of each phase, as `sample_stance` returns them, into the motion of a legged machine."""
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def by_foot(quantity: str) -> dict[str, Array]:
        return {foot: whole.pop(f"{foot} {quantity}") for foot in steps.feet}

    loads, places, turns = by_foot("load"), by_foot("position"), by_foot("rotation")
    return StepsMotion(steps, loads=loads, sole_position=places, sole_rotation=turns, **whole)


def sample_stance(
    steps: Steps, stance: Stance, motion: tuple[Array, ...], foot_loads: Mapping[str, Array]
) -> dict[str, Array]:
    """Return, by name, the quantities (M, ...) of `StepsMotion` along a motion in one stance.

    The motion and the loads of all feet but the first, in the rows `Stance.load_rows`, are in the stance's joint order.
    """
    q, qd, qdd = motion
    function, names = _stance_function(steps, stance)
    stacked = np.column_stack([np.zeros((len(q), 0)), *foot_loads.values()])
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


def _stance_function(steps: Steps, stance: Stance) -> tuple[Any, list[str]]:
    """Return a casadi Function from joint motion and loads of all feet but the first to torques, loads and frames in a
    stance, and the names of its outputs.
    """
    n = stance.joint_size
    q, qd, qdd = (ca.SX.sym(name, n) for name in ("q", "qd", "qdd"))
    rows = {name: ca.SX.sym("load", len(stance.load_rows[name])) for name in stance.other_feet}
    foot_loads = {name: stance.full_load(name, part) for name, part in rows.items()}
    loads = stance.loads(q, qd, qdd, foot_loads)
    root = link_frames(stance.robot, q, stance.world_from_base())[steps.robot.root]
    outputs = {
        "joint_torques": stance.joint_torques(q, qd, qdd, foot_loads),
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
    inputs = [q, qd, qdd, ca.vertcat(ca.SX(0, 1), *rows.values())]
    return ca.Function("motion", inputs, [ca.densify(v) for v in outputs.values()], {"cse": True}), list(outputs)


def resolve_steps(steps: Steps, *, start: Any, samples: int = SAMPLES) -> StepsMotion:
    """Compute a motion through the stances of a legged machine by resolved-rate control with the least joint rates.

    A lifted foot moves to its next foothold from rest to rest. Seen from above its path is straight; at the share s of
    the path it is raised by 64 s^3 (1 - s)^3 times the steps' clearance. A foot without a next foothold follows the
    others. The held feet share the load so that the sum of the squared loads is least.

    Args:
        steps: Robot and its stances; a free duration takes its guess.
        start: Joint positions in the robot's order, with the feet on their footholds. Shape (n,), rad or m.
        samples: Number of samples of each phase, both ends included.

    Raises:
        ProblemError: Sizes or values do not fit, or a foot is off its foothold at the start.
        SolveError: The motion breaks down, for example at a stretched leg; names the phase and the time in it.
    """
    require.instance("resolve_steps: steps", steps, Steps)
    count = require.count("resolve_steps: samples", samples, least=2)
    joints = require.array("start", start, (steps.robot.dof,), meaning="one entry for each joint")
    check_placed(steps.stances[0], joints[steps.order(steps.stances[0])])
    parts, begin = [], 0.0
    for k, stance in enumerate(steps.stances):
        t = np.linspace(0.0, steps.phases[k].seconds, count)
        motion = _resolve_phase(steps, k, joints[steps.order(stance)], t, steps.clearance)
        values = sample_stance(steps, stance, motion, _least_loads(stance, motion))
        joints = values["joints"][-1]
        parts.append({"t": begin + t, "phase": np.full(count, float(k)), **values})
        begin += t[-1]
    return motion_of(steps, parts)


def _resolve_phase(steps: Steps, k: int, joints: Array, t: Array, clearance: float) -> tuple[Array, Array, Array]:
    """Return the resolved-rate motion in phase k: joint positions, rates and accelerations, in the stance's order."""
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
    tasks += [_swing_task(stance, swing, t[-1], clearance) for swing in swings]
    local = resolve(stance, tasks, t[-1], start=joints, samples=t)
    if local.stopped is not None:
        words = f"phase {steps.names[k]!r}: the pseudo-inverse breaks down at {local.t[-1]:.4g} s: {local.stopped}"
        raise SolveError(words, name=steps.names[k], time=float(local.t[-1]))
    return local.joints, local.joint_rates, scipy.interpolate.CubicSpline(t, local.joint_rates).derivative()(t)


def _swing_task(stance: Stance, swing: Swing, seconds: float, clearance: float) -> TipTask:
    """Return the task of moving a foot from one foothold to the next, from rest to rest."""
    assert swing.lifted is not None
    assert swing.landing is not None
    lifted, landing = swing.lifted, swing.landing
    first, last = np.asarray(lifted.rotation), np.asarray(landing.rotation)
    turn = scipy.spatial.transform.Rotation.from_matrix(last @ first.T).as_rotvec()
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle else np.array([0.0, 0.0, 1.0])

    def position(t: Any) -> Any:
        s = t / seconds
        displacement = rest_to_rest(s) * ca.DM(np.asarray(landing.position) - np.asarray(lifted.position))
        return (
            ca.DM(np.asarray(lifted.position)) + displacement + 64 * (s * (1 - s)) ** 3 * clearance * ca.DM(last[:, 2])
        )

    def orientation(t: Any) -> Any:
        return ca.mtimes(rotation(ca.DM(axis), angle * rest_to_rest(t / seconds)), ca.DM(first))

    return foot_task(stance, swing.name, position, orientation if angle else last, duration=seconds)


def _least_loads(stance: Stance, motion: tuple[Array, Array, Array]) -> dict[str, Array]:
    """Return the loads (M, k) of all feet but the first for which the sum of the squared loads of all feet is least."""
    sizes = {name: len(stance.load_rows[name]) for name in stance.other_feet}
    if not sizes:
        return {}
    q, qd, qdd = (ca.SX.sym(name, stance.joint_size) for name in ("q", "qd", "qdd"))
    rows = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    foot_loads = {name: stance.full_load(name, part) for name, part in rows.items()}
    every = ca.vertcat(*stance.loads(q, qd, qdd, foot_loads).values())
    free = ca.vertcat(*rows.values())
    slope = ca.jacobian(every, free)
    rest = ca.substitute(every, free, ca.DM.zeros(free.shape))
    least = -ca.solve(ca.mtimes(slope.T, slope), ca.mtimes(slope.T, rest))
    function = ca.Function("shared", [q, qd, qdd], [ca.densify(least)], {"cse": True})
    values = np.array(function.map(len(motion[0]))(*(part.T for part in motion))).T
    return dict(zip(sizes, np.split(values, np.cumsum([*sizes.values()])[:-1], axis=1), strict=True))
