"""Detect trajectory files in which the unit of the times or the names of the columns are probably wrong.

A suspicion is not a fault: the motion may be correct as it is. But if the suspicion is true, the robot would execute a
motion that was not checked. The verdict is therefore undetermined until the unit of the times or the order of the
joints is confirmed.
"""

from __future__ import annotations

from itertools import combinations

import casadi as ca
import numpy as np

from models import FixedBase, Robot
from models.checks import Array
from ocp.app.check.data_checks import SMALL_UNITS, THRESHOLDS, Fault, likely_unit
from ocp.app.check.interpolation import Indices, Motion
from ocp.problem.values import Sampler

__all__ = ["doubtful_times", "exchanged_joints"]


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
    """Return a suspicion if the columns of two joints seem exchanged, because swapping them makes the motion far
    simpler.

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
    """Return the suspicion that two columns of the file are exchanged."""
    both = " and ".join(names[k] for k in pair)
    text = f"the columns of {both} look exchanged: then {evidence}, which is far from true as written"
    return Fault("suspicion", both, f"{text}; correct the names, or pass --names-confirmed")
