"""Checks of a motion at sample times: torques, the ground, momentum, clearance, and the path of the tip.

Torques and the conditions of a standing base are evaluated several times in every interval, the tip four times.
Clearance is proven between the samples if the base stands still.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from models import (
    CollisionScene,
    FixedBase,
    FreeFloating,
    Machine,
    Robot,
    Standing,
    inverse_dynamics,
    momentum,
    robot_inertia,
    simplify,
)
from models.checks import Array
from models.machines.standing import center_of_pressure
from models.robot.dynamics import GRAVITY
from models.spatial import cross
from ocp.app.check.data_checks import CleanedTrajectory
from ocp.app.check.joint_limits import Fault, Motion, Row, RowVerdict, interpolate
from ocp.app.files import Waypoints
from ocp.audit.clearance import Clearance, ClosestPair
from ocp.console import check_time
from ocp.curves import rk4_step
from ocp.motion.builders.clearance import clearance_of
from ocp.motion.local.collisions import distances_along
from ocp.motion.tasks.limits import JointBounds
from ocp.problem.values import Sampler
from ocp.tolerances import CLEARANCE_TOLERANCE_M, MOMENTUM_SHARE, ROUNDING_SHARE

MAX_REPORTED_PAIRS = 20
"""Largest number of pairs of bodies that are listed in the table of clearances."""
INSIDE = np.linspace(0.0, 1.0, 5)
"""Fractions of an interval at which torques and the forces of the ground are evaluated."""


@dataclass(frozen=True, eq=False)
class Quantity:
    """Samples of a quantity, and the largest permitted magnitude or the least permitted value.

    Attributes:
        name, unit, note: Name and unit of the quantity, and method of the check.
        times, values: Times, s, and values. Shape (K,).
        limit: Largest magnitude, infinite if unlimited; the least value if `least` is set.
        share: Tolerance relative to the limit.
        blur: Error of the samples: a violation by less is undetermined.
    """

    name: str
    times: Array
    values: Array
    limit: float
    unit: str
    least: bool = False
    share: float = 0.0
    blur: float = 0.0
    note: str = ""


@dataclass(eq=False)
class Findings:
    """Table rows and faults that the checks of a trajectory find; each check appends to them."""

    rows: list[Row] = field(default_factory=list)
    faults: list[Fault] = field(default_factory=list)

    def judge(self, each: Quantity, fault: tuple[str, str], text: str, details: Mapping[str, Array] = {}) -> None:
        """Compare samples of a quantity with its limit; append a table row and, if the limit is violated, a fault.

        `fault` is the kind and name of the fault. `text` describes it with the fields value, time, first (time), limit
        and unit, and those of `details`, which has further samples (K,).
        """
        size = -each.values if each.least else np.abs(each.values)
        excess = each.limit - each.values if each.least else size - each.limit
        k, bounded = int(size.argmax()), bool(np.isfinite(each.limit))
        value, time, limit = float(each.values[k]), float(each.times[k]), each.limit if bounded else None
        allowed = each.share * each.limit
        beyond, certain = ~(excess <= allowed), ~(excess <= allowed + each.blur)
        verdict = RowVerdict.of(certain.any(), beyond.any()) if bounded else RowVerdict.UNLIMITED
        self.rows.append(Row(each.name, value, limit, each.unit, time, verdict, each.note))
        if verdict is RowVerdict.FAILED:
            first = float(each.times[np.flatnonzero(certain)[0]])
            samples = {key: float(column[k]) for key, column in details.items()}
            words = text.format(value=value, time=time, first=first, limit=limit, unit=each.unit, **samples)
            self.faults.append(Fault(*fault, words, time, first, value, limit, each.unit))


# ---- torques -----------------------------------------------------------------------------------------------------


def check_efforts(
    findings: Findings, cleaned: CleanedTrajectory, robot: Robot, bounds: JointBounds, *, share: float
) -> None:
    """Check torques that the file gives at the samples against the torque limits."""
    text = "the file has {value:.5g} {unit} at {time:.6g} s, limit {limit:.5g}"
    for joint, values in zip(cleaned.joints, () if cleaned.efforts is None else cleaned.efforts.T, strict=False):
        name, limit = robot.joint_names[joint], float(bounds.torque[joint])
        t, unit, note = cleaned.motion.t, robot.joint(name).effort_unit, "as given in the file"
        torque = Quantity(f"given torque of {name}", t, values, limit, unit, share=share, note=note)
        findings.judge(torque, ("torque", name), text)


def check_torques(
    findings: Findings, machine: FixedBase | FreeFloating, motion: Motion, bounds: JointBounds, *, share: float
) -> None:
    """Check joint torques from inverse dynamics at five times of every interval.

    With linear interpolation they are evaluated at the samples, with velocities and accelerations by differences. A
    floating base moves as the joints drive it, from rest, without gravity.
    """
    robot = machine.robot
    q, v, a = (ca.SX.sym(name, robot.dof) for name in ("q", "v", "a"))
    torque = torque_expression(machine, q, v, a)
    sampler = Sampler([q, v, a], [torque])
    times, *values = torque_samples(motion)
    if not len(times):
        return
    check_time()
    torques = sampler(*values)[0]
    # torques are linear in accelerations
    inertia = np.abs(np.array(ca.Function("inertia", [q], [ca.jacobian(torque, a)])(motion.q.mean(axis=0))))
    acceleration = motion.quantity("acceleration")
    blurs = inertia @ (np.zeros(robot.dof) if acceleration is None else np.median(acceleration.blur, axis=0))
    text = "{value:.5g} {unit} at {time:.6g} s, limit {limit:.5g}"
    for name, column, limit, blur in zip(robot.joint_names, torques.T, bounds.torque.tolist(), blurs, strict=True):
        options: dict[str, Any] = {"share": share, "blur": blur, "note": _sampling_note(motion)}
        each = Quantity(f"torque of {name}", times, column, limit, robot.joint(name).effort_unit, **options)
        findings.judge(each, ("torque", name), text)


def _sampling_note(motion: Motion) -> str:
    return "at samples, by differences" if motion.rule == "linear" else "at five times of every interval"


def torque_expression(machine: Machine, q: ca.SX, v: ca.SX, a: ca.SX) -> ca.SX:
    """Return the joint torques (n, 1) of a machine without external forces as functions of its joint motion.

    A floating base moves so that momentum is conserved.
    """
    if not isinstance(machine, FreeFloating):
        gravity = getattr(machine, "gravity_in_world", GRAVITY)
        frame = machine.world_from_base(())
        return inverse_dynamics(simplify(machine.robot), q, v, a, wrenches=(), gravity=gravity, world_from_base=frame)
    base = ca.SX.sym("base", machine.base_size)
    twist = ca.mtimes(ca.SX(ca.DM.eye(6)[:, machine.twist_rows]), machine.base_twist(base, q, v))
    change = ca.jtimes(twist, ca.vertcat(base, q, v), ca.vertcat(machine.base_rate(base, q, v), v, a))
    frame = machine.world_from_base(base)
    zero = (0.0, 0.0, 0.0)
    torque = inverse_dynamics(machine.robot, q, v, a, gravity=zero, world_from_base=frame, base_motion=(twist, change))
    return ca.substitute(torque, base, ca.SX(ca.DM(machine.base_home())))


def torque_samples(motion: Motion) -> tuple[Array, Array, Array, Array]:
    """Return times (K,), s, and joint positions, velocities and accelerations (K, n) to compute torques from."""
    t, h = motion.t, np.diff(motion.t)
    if motion.acceleration is None:
        if len(t) < 3:
            return t[:0], motion.q[:0], motion.q[:0], motion.q[:0]
        slope = np.diff(motion.q, axis=0) / h[:, None]
        left, right = h[:-1, None], h[1:, None]
        v = (slope[:-1] * right + slope[1:] * left) / (left + right)
        return t[1:-1], motion.q[1:-1], v, 2 * np.diff(slope, axis=0) / (left + right)
    interval, fraction = np.repeat(np.arange(len(h)), len(INSIDE)), np.tile(INSIDE, len(h))
    q, v, a = (curve.within(interval, fraction) for curve in (motion.position, motion.velocity, motion.acceleration))
    needed = np.broadcast_to(motion.needed("acceleration")[0], (len(h), a.shape[1]))[interval]
    return t[interval] + fraction * h[interval], q, v, np.clip(a, -needed, needed)


# ---- the base ----------------------------------------------------------------------------------------------------


def check_ground(findings: Findings, machine: Standing, motion: Motion, friction: float) -> None:
    """Check ground force, zero moment point and friction of a standing machine."""
    q, v, a = (ca.SX.sym(name, machine.joint_size) for name in ("q", "v", "a"))
    reaction = machine.ground_reaction(q, v, a)
    point = center_of_pressure(reaction)
    margin = machine.support.margin(point)
    sampler = Sampler([q, v, a], [ca.vertcat(margin, reaction[5], ca.norm_2(reaction[3:5]), point)])
    times, *samples = torque_samples(motion)
    if not len(times):
        return
    margin, push, slide, x, y = sampler(*samples)[0].T
    details = {"pull": -push, "outside": -margin, "slide": slide, "push": push, "x": x, "y": y}
    checks = [
        ("vertical force of the ground", push, "N", "the ground would have to pull with {pull:.4g} N"),
        ("zero moment point", margin, "m", "it is {outside:.4g} m outside the foot, at ({x:.4g}, {y:.4g}) m,"),
    ]
    if np.isfinite(friction):
        words = "the foot slips: {slide:.4g} N along the ground, {push:.4g} N on it,"
        checks.append(("friction", friction * push - slide, "N", words))
    for name, values, unit, words in checks:
        text = f"{words} at {{time:.6g}} s, first at {{first:.6g}} s"
        quantity = Quantity(name, times, values, 0.0, unit, least=True, note=_sampling_note(motion))
        findings.judge(quantity, (name, machine.robot.root), text, details)


def integrate_base(machine: FreeFloating, motion: Motion) -> tuple[Array, list[Row]]:
    """Integrate the base motion; return base configurations (M, base_size) and table rows of displacement and rotation.

    The base starts at its home and moves so that momentum stays zero. The classical Runge-Kutta method takes one step
    in every interval.
    """
    n, size = machine.joint_size, machine.base_size
    base, h = ca.SX.sym("base", size), ca.SX.sym("h")
    q, v = ca.SX.sym("q", n, 3), ca.SX.sym("v", n, 3)

    def rate(place: float, value: ca.SX) -> ca.SX:
        return machine.base_rate(value, q[:, int(2 * place)], v[:, int(2 * place)])

    next_base = rk4_step(rate, base, h)
    if size == 7:
        next_base = ca.vertcat(next_base[:3], next_base[3:] / ca.norm_2(next_base[3:]))
    count = len(motion.t) - 1
    interval, fraction = np.repeat(np.arange(count), 3), np.tile([0.0, 0.5, 1.0], count)
    stacked = [curve.within(interval, fraction).T for curve in (motion.position, motion.velocity)]
    step = ca.Function("step", [base, q, v, h], [next_base], {"cse": True})
    steps = step.mapaccum(count)(machine.base_home(), *stacked, np.diff(motion.t)[None])
    bases = np.vstack([machine.base_home(), np.array(steps).T])
    position = bases[:, :2] if size == 3 else bases[:, :3]
    distance = np.linalg.norm(position - position[0], axis=1)
    turns = np.abs(bases[:, 2] - bases[0, 2]) if size == 3 else 2 * np.arccos(np.clip(np.abs(bases[:, 3]), 0.0, 1.0))
    rows = []
    for name, values, unit in (("displacement", distance, "m"), ("rotation", turns, "rad")):
        k, note = int(values.argmax()), "integrated so that momentum is conserved"
        rows.append(Row(f"{name} of the base", float(values[k]), None, unit, float(motion.t[k]), RowVerdict.INFO, note))
    return bases, rows


def check_momentum(findings: Findings, machine: FreeFloating, motion: Motion, bases: Array) -> None:
    """Check that the total momentum is constant under the given base motion, by central differences."""
    if len(motion.t) < 3:
        return
    robot, size = machine.robot, machine.base_size
    q, v = ca.SX.sym("q", robot.dof), ca.SX.sym("v", robot.dof)
    base, rate = ca.SX.sym("base", size), ca.SX.sym("rate", size)
    frame = machine.world_from_base(base)
    plane = ca.DM.eye(6)[:, machine.twist_rows]
    spin, speed = ca.vertsplit(ca.mtimes(plane, machine.twist_of_rate(base, rate)), 3)
    twist = ca.vertcat(spin, speed - cross(spin, frame.position))
    joints = momentum(robot, q, v, world_from_base=frame)
    total = joints + ca.mtimes(robot_inertia(robot, q, frame), twist)
    times, width = motion.t[1:-1], (motion.t[2:] - motion.t[:-2])[:, None]
    rates = (bases[2:] - bases[:-2]) / width
    speeds = motion.v[1:-1] if motion.v is not None else (motion.q[2:] - motion.q[:-2]) / width
    whole, carried = Sampler([q, v, base, rate], [total, joints])(motion.q[1:-1], speeds, bases[1:-1], rates)
    for quantity, part, unit in (("moment of momentum", slice(0, 3), "N m s"), ("momentum", slice(3, 6), "N s")):
        change = np.linalg.norm(whole[:, part] - np.median(whole[:, part], axis=0), axis=1)
        own = float(np.linalg.norm(carried[:, part], axis=1).max())
        text = f"{quantity} changes by {{value:.4g}} {unit} at {{time:.6g}} s; that of the joints is {own:.4g}: "
        text += "the given motion of the base is inconsistent"
        limit, name = MOMENTUM_SHARE * own + ROUNDING_SHARE, f"change of {quantity}"
        findings.judge(Quantity(name, times, change, limit, unit, note="base as given"), ("momentum", robot.root), text)


# ---- clearance ---------------------------------------------------------------------------------------------------


def with_wide_limits(machine: Machine, motion: Motion) -> Machine:
    """Return the machine with joint limits wide enough for a motion, and finite for all prismatic joints."""
    robot = machine.robot
    low, high = (getattr(motion.position.coefficients, side)(axis=(0, 1)) for side in ("min", "max"))
    joints = []
    for joint in robot.joints:
        if joint.moves and joint.kind != "continuous":
            column, ratio, offset = robot.couplings[joint.name]
            ends = sorted((ratio * float(low[column]) + offset, ratio * float(high[column]) + offset))
            lower, upper = min(joint.lower, ends[0]), max(joint.upper, ends[1])
            if joint.kind == "prismatic":
                lower, upper = (own if np.isfinite(own) else end for own, end in zip((lower, upper), ends, strict=True))
            if (lower, upper) != (joint.lower, joint.upper):
                joint = replace(joint, lower=lower, upper=upper)
        joints.append(joint)
    if all(new is old for new, old in zip(joints, robot.joints, strict=True)):
        return machine
    widened: Machine = replace(machine, robot=replace(robot, joints=tuple(joints)))  # type: ignore[type-var]
    return widened


def prove_clearance(scene: CollisionScene, motion: Motion) -> Clearance:
    """Return the closest approach of each pair of bodies along a motion of a machine whose base stands still."""
    start, horizon = float(motion.t[0]), float(motion.t[-1] - motion.t[0])
    rates = motion.velocity.greatest
    seconds = np.zeros_like(rates) if motion.acceleration is None else motion.acceleration.greatest

    def joints(fractions: Array) -> Array:
        return motion.position.at(start + fractions * horizon)

    smooth, breaks = motion.acceleration is not None, (motion.t - start) / horizon
    return clearance_of(scene, joints, breaks, horizon, rates=rates, seconds=seconds, smooth=smooth)


def _sampled_pairs(scene: CollisionScene, motion: Motion, bases: Array) -> list[ClosestPair]:
    """Return the closest approach of each pair of bodies at the samples and halfway between samples."""
    times = np.concatenate([motion.t, (motion.t[1:] + motion.t[:-1]) / 2])
    placements = np.concatenate([bases, (bases[1:] + bases[:-1]) / 2])
    distances = distances_along(scene, placements, motion.position.at(times), times)
    places, unknown = times[distances.argmin(axis=0)] - motion.t[0], np.full((2, 3), np.nan)
    rows = zip(scene.labels, distances.min(axis=0).tolist(), places.tolist(), strict=True)
    return [ClosestPair(bodies, gap, gap, time, unknown, scene.clearance) for bodies, gap, time in rows]


def check_clearance(findings: Findings, scene: CollisionScene, motion: Motion, bases: Array | None) -> None:
    """Check the clearance between bodies along a motion.

    If the base moves, with configurations `bases` (M, base_size) at the samples, distances are computed at the samples
    and midway between them, without a proof.
    """
    assumptions = [f"{pair} ({why})" for pair, why in scene.assumed.items()]
    ignored = []
    if assumptions:
        note = f"ignored by assumption: {', '.join(assumptions)}"
        ignored = [Row("pairs not checked", len(assumptions), None, "", None, RowVerdict.INFO, note)]
    if not len(scene.pairs):
        none = Row("clearance", np.inf, scene.clearance, "m", None, RowVerdict.INFO, "no pairs that can collide")
        findings.rows += [none, *ignored]
        return
    pairs = prove_clearance(scene, motion).pairs if bases is None else _sampled_pairs(scene, motion, bases)
    rows, faults = list[Row](), list[Fault]()
    proven = min(pair.least for pair in pairs)
    for pair in sorted(pairs, key=lambda pair: pair.distance - pair.required)[:MAX_REPORTED_PAIRS]:
        bodies, time = " and ".join(pair.bodies), float(motion.t[0]) + pair.time
        verdict = _verdict(pair)
        if verdict is RowVerdict.FAILED:
            note = "in collision" if pair.distance < 0 else "too close"
            between = "" if np.isclose(motion.t, time, rtol=0, atol=1e-12).any() else ", between two samples"
            apart = f"overlap by {-pair.distance:.4g} m" if pair.distance < 0 else f"are {pair.distance:.4g} m apart"
            text = f"{apart} at {time:.6g} s{between}, at least {pair.required:g} m required"
            faults.append(Fault("clearance", bodies, text, time, None, pair.distance, pair.required, "m"))
        elif verdict is RowVerdict.UNDECIDED:
            note = f"at least {pair.least:.4g} m is proven"
        else:
            note = "proven" if faults else f"proven: no two bodies ever come closer than {proven:.4g} m"
        if bases is not None:
            note = "at samples and midway; not proven between them"
        rows.append(Row(f"clearance of {bodies}", pair.distance, pair.required, "m", time, verdict, note))
        if verdict is RowVerdict.OK:
            break  # pairs that are farther apart are proven as well, or listed below as undetermined
    reported = {row.name for row in rows}
    for pair in pairs:
        name, time = f"clearance of {' and '.join(pair.bodies)}", float(motion.t[0]) + pair.time
        if _verdict(pair) is RowVerdict.UNDECIDED and name not in reported:
            note = f"at least {pair.least:.4g} m is proven"
            rows.append(Row(name, pair.distance, pair.required, "m", time, RowVerdict.UNDECIDED, note))
    findings.rows += [*rows, *ignored]
    findings.faults += faults if bases is not None else _with_beginnings(scene, motion, faults)


def _verdict(pair: ClosestPair) -> RowVerdict:
    """Return the verdict on the distance between two bodies, which may be a tolerance below the required distance."""
    return RowVerdict.of(pair.distance < pair.required - CLEARANCE_TOLERANCE_M, pair.missed > CLEARANCE_TOLERANCE_M)


def _with_beginnings(scene: CollisionScene, motion: Motion, faults: list[Fault]) -> list[Fault]:
    """Return clearance faults that also state the time at which the clearance is first violated."""
    if not faults:
        return []
    worst_times = np.array([fault.time for fault in faults])
    times = np.unique(np.concatenate([motion.t[:: len(motion.t) // 1000 + 1], worst_times]))
    base = scene.machine.base_home()
    distances = distances_along(scene, base, motion.position.at(times), times, cutoff=scene.clearance)
    columns = {" and ".join(pair): k for k, pair in enumerate(scene.labels)}
    dated_faults = []
    for fault in faults:
        violated = np.flatnonzero(distances[:, columns[fault.name]] < scene.clearance - CLEARANCE_TOLERANCE_M)
        dated_faults.append(replace(fault, first=float(times[violated[0]]) if violated.size else fault.time))
    return dated_faults


# ---- the path ----------------------------------------------------------------------------------------------------


def check_path(
    findings: Findings,
    machine: Machine,
    motion: Motion,
    bases: Array | None,
    *,
    path: Waypoints,
    tolerance: float,
    angle: float,
) -> None:
    """Check the distance of the tip from a path and the direction of the tool axis.

    The tip is sampled four times in every interval, and more finely at the largest distance. The path consists of
    straight lines between the waypoints. The angle is that of the z axes, if the waypoints have orientations. `bases`
    has the configurations of a moving base at the samples.
    """
    base, q = ca.SX.sym("base", machine.base_size), ca.SX.sym("q", machine.joint_size)
    pose = machine.tip_pose(base, q)
    sampler = Sampler([base, q], [pose.position, pose.rotation[:, 2]])
    steps = np.arange(4) / 4 * np.diff(motion.t)[:, None]
    times = np.append((motion.t[:-1, None] + steps).ravel(), motion.t[-1])

    def tips(at: Array) -> list[Array]:
        """Return the positions and the z axes of the tip at times (K,) of a motion. Shape (K, 3) each."""
        base_path = np.zeros((len(at), 0)) if bases is None else interpolate(at, motion.t, bases)
        if base_path.shape[1] == 7:
            base_path[:, 3:] /= np.linalg.norm(base_path[:, 3:], axis=1)[:, None]
        return sampler(base_path, motion.position.at(at))

    corners, link = path.positions, machine.robot.tip_link
    tip_path, axes = tips(times)
    distance, parameter = _distances(tip_path, corners)
    worst = int(distance.argmax())
    finer = np.linspace(times[max(worst - 1, 0)], times[min(worst + 1, len(times) - 1)], 65)
    order = np.argsort(every := np.append(times, finer))
    distance = np.append(distance, _distances(tips(finer)[0], corners)[0])
    between = "" if every[distance.argmax()] in motion.t else ", between two samples"
    text = f"the tip is {{value:.4g}} m from its path at {{time:.6g}} s{between}, {{limit:g}} m allowed"
    name, fault = "distance of the tip from the path", ("path", link)
    findings.judge(Quantity(name, every[order], distance[order], tolerance, "m"), fault, text)
    miss = _distances(corners, tip_path)[0]
    k, more = int(miss.argmax()), int((miss > tolerance).sum()) - 1
    name, value = "distance of a waypoint from the tip's path", float(miss[k])
    findings.rows.append(Row(name, value, tolerance, "m", None, RowVerdict.of(value > tolerance)))
    if value > tolerance:
        text = f"the tip comes no closer than {value:.4g} m, {tolerance:g} m allowed"
        text += f"; {more} others are also missed" if more else ""
        name = f"waypoint {k + 1} (line {int(path.lines[k])})"
        findings.faults.append(Fault("path", name, text, None, None, value, tolerance, "m"))
    if path.orientations is not None:
        angles = np.arccos(np.clip((_axes(path, parameter) * axes).sum(axis=1), -1.0, 1.0))
        text = "its z axis deviates by {value:.4g} rad at {time:.6g} s, {limit:g} rad allowed"
        name = "angle of the tool axis from the path's"
        findings.judge(Quantity(name, times, angles, angle, "rad"), fault, text)
        if not np.isfinite(angle):
            findings.rows[-1] = replace(findings.rows[-1], verdict=RowVerdict.INFO)


def _axes(path: Waypoints, parameter: Array) -> Array:
    """Return the z axes (K, 3) that the tool must have at waypoint indices (K,), interpolated between waypoints."""
    assert path.orientations is not None
    w, x, y, z = path.orientations.T
    at_waypoints = np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    axes = interpolate(parameter, np.arange(float(len(at_waypoints))), at_waypoints)
    return np.asarray(axes / np.maximum(np.linalg.norm(axes, axis=1), 1e-12)[:, None])


def _distances(points: Array, corners: Array) -> tuple[Array, Array]:
    """Return the distances of points (K, 3) from a polyline with corners (M, 3), and the closest points on it.

    The closest point is given by the number of the corner before it plus the fraction of the edge. Shape (K,) each.
    """
    if len(corners) == 1:
        return np.asarray(np.linalg.norm(points - corners[0], axis=1)), np.zeros(len(points))
    distances, parameters = np.full(len(points), np.inf), np.zeros(len(points))
    begin, edges = corners[:-1], np.diff(corners, axis=0)
    squared_lengths = (edges * edges).sum(axis=1)
    batch = max(1, 4_000_000 // len(begin))
    for first in range(0, len(points), batch):
        part = points[first : first + batch]
        to = part[:, None] - begin
        fraction = np.clip((to * edges).sum(axis=2) / np.where(squared_lengths > 0, squared_lengths, 1.0), 0.0, 1.0)
        distance = np.linalg.norm(to - fraction[:, :, None] * edges, axis=2)
        k = distance.argmin(axis=1)
        rows = np.arange(len(part))
        distances[first : first + batch], parameters[first : first + batch] = distance[rows, k], k + fraction[rows, k]
    return distances, parameters
