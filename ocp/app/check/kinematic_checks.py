"""Checks that need the kinematics of a robot: clearance, the path of its tip, and signs that a file was misread.

Clearance is proven between the samples. That the unit of the times or the names of the columns are probably wrong is a
suspicion and not a fault: the motion may be correct as it is. But if the suspicion is true, the robot would execute a
motion that was not checked. The verdict is therefore undetermined until the unit of the times or the order of the
joints is confirmed.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import casadi as ca
import numpy as np

from models import CollisionScene, FixedBase, Machine, Robot
from models.checks import Array
from ocp.app.check.data_checks import SMALL_UNITS, THRESHOLDS, Fault, likely_unit
from ocp.app.check.interpolation import Indices, Motion, interpolate
from ocp.app.check.joint_limits import Row, RowVerdict
from ocp.app.files import Waypoints
from ocp.audit.clearance import Clearance
from ocp.motion.builders.clearance import clearance_of
from ocp.motion.local.collisions import distances_along
from ocp.problem.values import Sampler
from ocp.tolerances import CLEARANCE_TOLERANCE_M

MAX_REPORTED_PAIRS = 20
"""Largest number of pairs of bodies that are listed in the table of clearances."""


def with_wide_limits(machine: Machine, motion: Motion) -> Machine:
    """Return the machine with joint limits widened to contain a motion, and finite limits of all prismatic joints."""
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
    """Return the smallest distance found for each pair of bodies along a joint motion, and its proven lower bound.

    The base is stationary.
    """
    start, horizon = float(motion.t[0]), float(motion.t[-1] - motion.t[0])
    rates = motion.velocity.greatest
    seconds = np.zeros_like(rates) if motion.acceleration is None else motion.acceleration.greatest
    smooth, breaks = motion.acceleration is not None, (motion.t - start) / horizon
    return clearance_of(
        scene,
        lambda at: motion.position.at(start + at * horizon),
        breaks,
        horizon,
        rates=rates,
        seconds=seconds,
        smooth=smooth,
    )


def clearance_rows(scene: CollisionScene, motion: Motion, bases: Array | None) -> tuple[list[Row], list[Fault]]:
    """Check the clearance between bodies along a motion, and return the table rows and the faults.

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
        return [none, *ignored], []
    if bases is not None:
        rows, faults = _sampled_rows(scene, motion, bases)
        return [*rows, *ignored], faults
    pairs = prove_clearance(scene, motion).pairs
    start = float(motion.t[0])
    rows, faults = [], []
    proven = min(pair.least for pair in pairs)
    for pair in sorted(pairs, key=lambda pair: pair.distance - pair.required)[:MAX_REPORTED_PAIRS]:
        bodies = " and ".join(pair.bodies)
        time = start + pair.time
        if pair.distance < pair.required - CLEARANCE_TOLERANCE_M:
            verdict, note = RowVerdict.FAILED, "in collision" if pair.distance < 0 else "too close"
            between = "" if np.isclose(motion.t, time, rtol=0, atol=1e-12).any() else ", between two samples"
            text = f"{_distance_text(pair.distance)} at {time:.6g} s{between}, at least {pair.required:g} m required"
            faults.append(Fault("clearance", bodies, text, time, None, pair.distance, pair.required, "m"))
        elif pair.missed > CLEARANCE_TOLERANCE_M:
            verdict, note = RowVerdict.UNDECIDED, f"at least {pair.least:.4g} m is proven"
        else:
            least = "" if faults else f": no two bodies ever come closer than {proven:.4g} m"
            verdict, note = RowVerdict.OK, f"proven{least}"
        rows.append(Row(f"clearance of {bodies}", pair.distance, pair.required, "m", time, verdict, note))
        if verdict == "ok":
            break  # pairs that are farther apart are proven as well, or listed below as undetermined
    reported = {row.name for row in rows}
    faults = _with_beginnings(scene, motion, faults)
    for pair in pairs:
        name = f"clearance of {' and '.join(pair.bodies)}"
        violated = pair.distance < pair.required - CLEARANCE_TOLERANCE_M
        if pair.missed > CLEARANCE_TOLERANCE_M and not violated and name not in reported:
            note = f"at least {pair.least:.4g} m is proven"
            rows.append(Row(name, pair.distance, pair.required, "m", start + pair.time, RowVerdict.UNDECIDED, note))
    return [*rows, *ignored], faults


def _distance_text(distance: float) -> str:
    return f"overlap by {-distance:.4g} m" if distance < 0 else f"are {distance:.4g} m apart"


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
        first = float(times[violated[0]]) if violated.size else fault.time
        dated_faults.append(replace(fault, first=first))
    return dated_faults


def _sampled_rows(scene: CollisionScene, motion: Motion, bases: Array) -> tuple[list[Row], list[Fault]]:
    """Check distances between bodies at the samples and halfway between samples; return table rows and faults."""
    middles = (motion.t[1:] + motion.t[:-1]) / 2
    times = np.concatenate([motion.t, middles])
    joints = motion.position.at(times)
    base_samples = np.concatenate([bases, (bases[1:] + bases[:-1]) / 2])
    distances = distances_along(scene, base_samples, joints, times)
    rows, faults = [], []
    for column in np.argsort(distances.min(axis=0))[:MAX_REPORTED_PAIRS]:
        k = int(distances[:, column].argmin())
        bodies = " and ".join(scene.labels[column])
        value, time = float(distances[k, column]), float(times[k])
        failed = value < scene.clearance - CLEARANCE_TOLERANCE_M
        note = "at samples and midway; not proven between them"
        rows.append(Row(f"clearance of {bodies}", value, scene.clearance, "m", time, RowVerdict.of(failed), note))
        if not failed:
            break
        text = f"{_distance_text(value)} at {time:.6g} s, at least {scene.clearance:g} m required"
        faults.append(Fault("clearance", bodies, text, time, None, value, scene.clearance, "m"))
    return rows, faults


# ---- the path ----------------------------------------------------------------------------------------------------


def path_rows(
    machine: Machine, motion: Motion, bases: Array | None, path: Waypoints, *, tolerance: float, angle: float
) -> tuple[list[Row], list[Fault]]:
    """Check the distance of the tip from a path and the direction of the tool axis; return table rows and faults.

    The tip is sampled four times in every interval, and more finely at the largest distance. The path consists of
    straight lines between the waypoints. The angle is that of the z axes, if the waypoints have orientations.

    Args:
        machine: The machine.
        motion: Motion of all joints.
        bases: Configurations of a moving base at the samples, or None.
        path: The waypoints.
        tolerance: Allowed distance, m.
        angle: Allowed angle, rad.
    """
    base, q = ca.SX.sym("base", machine.base_size), ca.SX.sym("q", machine.joint_size)
    pose = machine.tip_pose(base, q)
    sampler = Sampler([base, q], [pose.position, pose.rotation[:, 2]])
    quarters = np.arange(4) / 4
    interval = np.repeat(np.arange(len(motion.t) - 1), len(quarters))
    fraction = np.tile(quarters, len(motion.t) - 1)
    times = np.append(motion.t[interval] + fraction * np.diff(motion.t)[interval], motion.t[-1])

    def tips(at: Array) -> list[Array]:
        """Return positions and z axes of the tip at times (K,). Shape (K, 3) each."""
        base_path = np.zeros((len(at), 0)) if bases is None else interpolate(at, motion.t, bases)
        if base_path.shape[1] == 7:
            base_path[:, 3:] /= np.linalg.norm(base_path[:, 3:], axis=1)[:, None]
        return sampler(base_path, motion.position.at(at))

    corners = path.positions
    tip_path, axes = tips(times)
    distance, parameter = _distances(tip_path, corners)
    worst = int(distance.argmax())
    finer = np.linspace(times[max(worst - 1, 0)], times[min(worst + 1, len(times) - 1)], 65)
    near = _distances(tips(finer)[0], corners)[0]
    value, time = max((float(distance[worst]), float(times[worst])), (float(near.max()), float(finer[near.argmax()])))
    link = machine.robot.tip_link
    rows, faults = [_row("distance of the tip from the path", value, tolerance, "m", time)], []
    if value > tolerance:
        first = float(times[np.flatnonzero(distance > tolerance)[0]]) if (distance > tolerance).any() else time
        between = "" if time in motion.t else ", between two samples"
        text = f"the tip is {value:.4g} m from its path at {time:.6g} s{between}, {tolerance:g} m allowed"
        faults.append(Fault("path", link, text, time, first, value, tolerance, "m"))
    miss = _distances(corners, tip_path)[0]
    k = int(miss.argmax())
    rows.append(_row("distance of a waypoint from the tip's path", float(miss[k]), tolerance, "m", None))
    if miss[k] > tolerance:
        more = int((miss > tolerance).sum()) - 1
        text = f"the tip comes no closer than {miss[k]:.4g} m, {tolerance:g} m allowed"
        text += f"; {more} others are also missed" if more else ""
        name = f"waypoint {k + 1} (line {int(path.lines[k])})"
        faults.append(Fault("path", name, text, None, None, float(miss[k]), tolerance, "m"))
    if path.orientations is not None:
        required = _axes(path, parameter)
        angles = np.arccos(np.clip((required * axes).sum(axis=1), -1.0, 1.0))
        k = int(angles.argmax())
        value, time = float(angles[k]), float(times[k])
        rows.append(_row("angle of the tool axis from the path's", value, angle, "rad", time))
        if value > angle:
            first = float(times[np.flatnonzero(angles > angle)[0]])
            text = f"its z axis deviates by {value:.4g} rad at {time:.6g} s, {angle:g} rad allowed"
            faults.append(Fault("path", link, text, time, first, value, angle, "rad"))
    return rows, faults


def _row(name: str, value: float, limit: float, unit: str, time: float | None) -> Row:
    """Return the row, in the table of a check, of a value and its upper limit, which may be infinite."""
    bounded = bool(np.isfinite(limit))
    verdict = RowVerdict.of(value > limit) if bounded else RowVerdict.INFO
    return Row(name, value, limit if bounded else None, unit, time, verdict)


def _axes(path: Waypoints, parameter: Array) -> Array:
    """Return the z axes (K, 3) that waypoints require of the tool at points, given as fractional numbers (K,)."""
    assert path.orientations is not None
    w, x, y, z = path.orientations.T
    at_waypoints = np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    axes = interpolate(parameter, np.arange(float(len(at_waypoints))), at_waypoints)
    return np.asarray(axes / np.maximum(np.linalg.norm(axes, axis=1), 1e-12)[:, None])


def _distances(points: Array, corners: Array) -> tuple[Array, Array]:
    """Return distances of points (K, 3) from a polyline with corners (M, 3), and the closest points on the polyline.

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


def doubtful_times(motion: Motion, velocity: Array) -> list[Fault]:
    """Return a suspicion if times given as seconds look like a smaller unit or like sample numbers; else an empty list.

    A smaller unit: the samples are a second or more apart, no joint is faster than 0.5 % of its velocity limit, and the
    motion is plausible in that unit. Sample numbers: 50 or more, spaced by one, and no joint is faster than 10 %.
    """
    t, steps = motion.t, np.diff(motion.t)
    step, whole = float(np.median(steps)), bool((np.abs(t - np.rint(t)) <= 1e-9 * np.abs(t)).all())
    unit, used = likely_unit(t, motion.q, velocity)
    enumerated = whole and len(t) >= 50 and np.ptp(steps) < 1e-6 and abs(step - 1) < 1e-6 and 1e-5 < used < 0.1
    small = bool(unit) and step >= 1 and used < 5e-3 and len(t) >= (3 if whole else 10)
    likely = [word for word, fits in ((unit, small), ("sample numbers", enumerated)) if fits]
    faster = f", in {unit} {100 * used * SMALL_UNITS[unit]:.3g} %" if small else ""
    text = (
        f"times look like {' or '.join(likely)}: {step:.6g} apart, and in seconds the fastest joint is at "
        f"{100 * used:.2g} % of its limit{faster}; pass --time-unit s, ms, us, ns, or seconds from sample to sample"
    )
    return [Fault("suspicion", "time", text)] if likely else []


def exchanged_joints(motion: Motion, robot: Robot, columns: Indices, tip: bool = True) -> list[Fault]:
    """Return a suspicion if the columns of two joints seem exchanged: swapping them makes the motion far simpler.

    Either one joint is outside its limits most of the time, and all are inside after the exchange. Or the tip moves
    straight or at constant speed only after the exchange. The latter requires three joints that do not move in
    proportion, because motions between two configurations are simple by chance.

    Args:
        motion: Motion of the joints.
        robot: The robot.
        columns: Indices of the joints in its joint vector.
        tip: Whether the tip can be checked: all joints are known, and the base does not float.
    """
    names, lower, upper = [robot.joint_names[k] for k in columns], robot.lower[columns], robot.upper[columns]
    kinds = [robot.joint(name).kind == "prismatic" for name in names]
    pairs = [(i, j) for i, j in combinations(range(len(names)), 2) if kinds[i] == kinds[j]]
    outside = ((motion.q[:, :, None] < lower) | (motion.q[:, :, None] > upper)).mean(axis=0)  # of column i for joint j
    current, identity = outside.diagonal(), np.arange(len(names))
    repairs = [
        p
        for p in pairs
        if current[[*p]].max() > 0.5 and not current[~np.isin(identity, p)].any() and not outside[p] + outside[p[::-1]]
    ]
    if len(repairs) == 1:
        return [_exchange_fault(names, repairs[0], "all joints are inside their limits")]
    rows = np.unique(np.linspace(0, len(motion.t) - 1, THRESHOLDS.tip_samples).astype(int))
    joints = motion.q[rows]
    reach = np.ptp(joints, axis=0)
    if not tip or robot.tip is None or len(rows) < 10 or (reach > 0.1 * reach.max()).sum() < 3:
        return []
    sizes = np.linalg.svd(joints - joints.mean(axis=0), compute_uv=False)
    if sizes[1] < 1e-3 * sizes[0]:
        return []
    q = ca.SX.sym("q", robot.dof)
    sampler = Sampler([q], [FixedBase(robot).tip_pose((), q).position])
    orders = np.tile(identity, (len(pairs) + 1, 1))
    for order, pair in zip(orders[1:], pairs, strict=True):
        order[[*pair]] = pair[::-1]
    tips = sampler(np.concatenate([joints[:, order] for order in orders]))[0].reshape(-1, len(rows), 3)
    centred = tips - tips.mean(axis=1, keepdims=True)
    line = np.linalg.svd(centred, full_matrices=False)[2][:, :1]
    distance = np.linalg.norm(centred - (centred * line).sum(axis=2, keepdims=True) * line, axis=2).max(axis=1)
    steps = np.linalg.norm(np.diff(tips, axis=1), axis=2)
    length = np.maximum(steps.sum(axis=1), 1e-12)
    speeds = (steps / np.diff(motion.t[rows]))[:, len(rows) // 5 : -(len(rows) // 5)]  # without its ends
    measure = np.column_stack([distance / length, speeds.std(axis=1) / np.maximum(speeds.mean(axis=1), 1e-12)])
    measure /= [THRESHOLDS.straight, THRESHOLDS.even]
    measure[length < max(0.01, 0.1 * length[0])] = np.inf  # m: hardly a motion of the tip
    best, criterion = divmod(int(measure.argmin()), 2)
    if measure[best, criterion] > min(1.0, measure[0, criterion] / 20) or measure[0].min() < 3:
        return []
    return [_exchange_fault(names, pairs[best - 1], ("the tip goes straight", "the tip keeps its speed")[criterion])]


def _exchange_fault(names: list[str], pair: tuple[int, int], evidence: str) -> Fault:
    """Return the suspicion that the columns of two joints, given by their indices, are exchanged in a file."""
    both = " and ".join(names[k] for k in pair)
    text = f"the columns of {both} look exchanged: then {evidence}, which is far from true as written"
    return Fault("suspicion", both, f"{text}; correct the names, or pass --names-confirmed")
