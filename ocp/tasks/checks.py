"""Checks of tasks against a machine and a start, before anything is solved."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp.errors import ProblemError
from ocp.tasks.equations import TaskEquations
from ocp.tasks.geometry import is_holonomic, target_size
from ocp.tasks.start import Array
from ocp.tasks.tip_task import ANGULAR, TipTask

__all__ = ["check_closed", "checked_tasks", "dependent_rows"]

SAMPLES = 201
FINE = 2001
CLOSED = 1e-6
"""Largest gap of a closed path, m and rad."""


def checked_tasks(equations: TaskEquations, base: Array, joints: Array, horizon: float, *, start: bool = True) -> None:
    """Raise ProblemError where tasks ask for what no joint moves, what cannot be asked at once, or a jump at the start.

    Args:
        start: Whether the pose at the start is checked.
    """
    place, q = ca.SX.sym("base", len(base)), ca.SX.sym("joints", len(joints))
    rows = _rows_by_name(equations)
    jacobian = equations.jacobian(place, q)
    if equations.size > len(joints):
        raise ProblemError(f"the task fixes {equations.size} rows {rows} but the machine has only {len(joints)} joints")
    unmoved = [row for i, row in enumerate(rows) if all(entry.is_zero() for entry in ca.horzsplit(jacobian[i, :]))]
    if unmoved:
        raise ProblemError(f"rows {rows}: no joint moves the tip in rows {unmoved}; leave them out of the task")
    numeric = ca.Function("jacobian", [place, q], [jacobian])
    rng = np.random.default_rng(0)
    places = [joints, *rng.normal(size=(5, len(joints)))]
    if not any(_has_full_rank(np.array(numeric(base, at))) for at in places):
        raise ProblemError(
            f"the {equations.size} rows of the task are linearly dependent in every configuration tried: they ask for "
            "the same motion twice or for more than the machine can do; leave out rows"
        )
    if not any(part.task.is_pose for part in equations.bound):
        return
    times = np.linspace(0.0, horizon, SAMPLES)
    values = np.array(equations.target_function().map(SAMPLES)(times[None, :]))
    if not (finite := np.isfinite(values).all(axis=0)).all():
        raise ProblemError(f"the task's targets are not finite at {times[~finite][0]:g} s")
    _check_rotations(equations, values, times)
    if start:
        for part in equations.bound:
            if not part.task.is_pose:
                continue
            alone = TaskEquations(equations.machine, (part,))
            misfit = np.array(alone.misfit(base, joints, alone.target_function()(0.0)))
            gap = float(np.abs(misfit).max())
            if gap > part.task.start_gap:
                name = part.task.link or part.tip.robot.tip
                raise ProblemError(
                    f"at the start joints {joints.tolist()} the frame of {name!r} is {gap:.3g} (m or rad) away from "
                    f"where its task begins, more than start_gap = {part.task.start_gap:g}; start from "
                    "inverse_kinematics(machine, task), or allow the gap for the feedback to close"
                )


def dependent_rows(equations: TaskEquations, base: Array, joints: Array) -> str | None:
    """The task's name where its rows are linearly dependent there, to rounding; None where they are not."""
    values = np.linalg.svd(np.array(ca.DM(equations.jacobian(base, joints))), compute_uv=False)
    return f"the task of rows {_rows_by_name(equations)}" if values[-1] <= 1e-12 * values[0] else None


def _rows_by_name(equations: TaskEquations) -> list[int]:
    """The twist rows of a single task; else the numbers of the stacked rows."""
    alone = equations.bound[0].task
    if len(equations.bound) == 1 and alone.direction is None:
        return list(alone.chosen)
    return list(range(equations.size))


def _check_rotations(equations: TaskEquations, values: Array, times: Array) -> None:
    at = 0
    for part in equations.bound:
        if part.task.orientation is not None:
            first = at + (6 if part.task.position is not None else 0)
            turn = values[first : first + 9].T.reshape(-1, 3, 3)
            wrong = np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) > 1e-6
            wrong |= np.linalg.det(turn) < 0
            if wrong.any():
                raise ProblemError(f"orientation is no rotation at {times[wrong][0]:g} s: {turn[wrong][0].T.tolist()}")
        at += target_size(part.task)


def _has_full_rank(jacobian: Array) -> bool:
    values = np.linalg.svd(jacobian, compute_uv=False)
    return bool(np.isfinite(values).all() and values[-1] > 1e-9 * values[0])


def check_closed(equations: TaskEquations, horizon: float) -> None:
    """Raise ProblemError where a task does not end where it began, as far as that does not depend on the way.

    Poses by their targets, velocities by their integrals.
    """
    times = np.linspace(0.0, horizon, FINE)
    values = np.array(equations.target_function().map(FINE)(times[None, :]))
    at = 0
    for part in equations.bound:
        task, size = part.task, target_size(part.task)
        mine, at = values[at : at + size], at + size
        if task.is_pose:
            rates = _rate_rows(task)
            gap = np.abs(np.delete(mine[:, -1] - mine[:, 0], rates)).max()
        else:
            closes = is_holonomic(part)
            whole = [mine[list(task.chosen).index(row)] if row in task.chosen else np.zeros(FINE) for row in ANGULAR]
            linear = [i for i, row in enumerate(task.chosen) if row not in ANGULAR and closes[i]]
            moved = _integral(mine[linear], times[1])
            turned = _turn(np.array(whole), times[1]) if closes[[row in ANGULAR for row in task.chosen]].any() else 0.0
            gap = max(float(np.abs(moved).max(initial=0.0)), turned)
        if gap > CLOSED:
            raise ProblemError(
                f"cyclic: the task of {task.link or part.tip.robot.tip!r} is not closed: it ends {gap:.3g} (m or rad) "
                "from where it began, and the joints cannot return; close the path"
            )


def _rate_rows(task: TipTask) -> list[int]:
    """Which entries of a pose task's targets are velocities."""
    kinds = [(task.position, [3, 4, 5], 6), (task.orientation, [9, 10, 11], 12), (task.direction, [3, 4, 5], 6)]
    rows, at = [], 0
    for track, mine, size in kinds:
        if track is not None:
            rows += [at + row for row in mine]
            at += size
    return rows


def _integral(values: Array, step: float) -> Array:
    """Simpson's rule over an odd number of samples. Shapes (k, FINE) to (k,)."""
    weights = np.ones(FINE)
    weights[1:-1:2], weights[2:-1:2] = 4, 2
    return np.asarray(values @ weights * step / 3)


def _turn(spin: Array, step: float) -> float:
    """Angle (rad) by which an angular velocity in world axes, shape (3, FINE), turns a body in all."""
    turn = np.eye(3)
    for k in range(0, FINE - 1, 2):  # Magnus' expansion of fourth order over two steps by Simpson's rule
        first, middle, last = spin[:, k], spin[:, k + 1], spin[:, k + 2]
        width = 2 * step
        vector = width / 6 * (first + 4 * middle + last) + width**2 / 12 * np.cross(last, first)
        angle = float(np.linalg.norm(vector))
        if angle > 0:
            cross = np.array(ca.DM(ca.skew(ca.DM(vector / angle))))
            turn = (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross) @ turn
    axial = np.array([turn[i, j] - turn[j, i] for i, j in ((2, 1), (0, 2), (1, 0))])
    return float(np.arctan2(np.linalg.norm(axial) / 2, (np.trace(turn) - 1) / 2))
