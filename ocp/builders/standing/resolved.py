"""Steps as the pseudo-inverse takes them, beside plans: each foot on its way, the least joint rates at every instant.

Nothing looks at what the ground can bear. With all feet held nothing moves; where the zero moment point leaves the
soles, or a sole would have to pull, the machine falls.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from models.arrays import Array
from models.machines.stance import Stance
from models.paths import rest_to_rest
from models.spatial import rotation
from ocp.builders.standing.loads import SAMPLES, StepsMotion, motion_of, sampled
from ocp.builders.standing.postures import check_placed, foot_task
from ocp.builders.standing.stances import Steps, Swing
from ocp.errors import SolveError, checked_count, checked_instance, checked_nonnegative
from ocp.local.rates import resolve
from ocp.tasks.checks import checked_numbers
from ocp.tasks.tip_task import TipTask

__all__ = ["resolve_steps"]


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
        if name in stance.others
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
    sizes = {name: len(stance.held_rows[name]) for name in stance.others}
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
