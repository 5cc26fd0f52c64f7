"""Joint trajectories sampled over time, and their exchange as CSV files and as ROS 2 JointTrajectory messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike as FilePath
from typing import Any

import numpy as np

from models.checks import Array, floats
from models.files import read_regular
from ocp.errors import ProblemError, require
from ocp.motion.schedule.limits import JointPath, check_joints, rates_along
from ocp.motion.schedule.planner import Schedule
from ocp.motion.tasks.speed_profile import LineMotion
from ocp.storage import checked_path, column_name, joint_name, write_text

MAX_FILE_BYTES = 2**26
KINDS = ("positions", "velocities", "accelerations")


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """Joint positions, velocities and accelerations, sampled over time.

    Attributes:
        names: Names of the n joints.
        t: Increasing times from the start, s. Shape (M,).
        positions, velocities, accelerations: Shape (M, n) each, rad or m, and per s, s^2.

    Raises:
        ProblemError: A shape is wrong, a value is not finite, times do not increase, or names repeat.
    """

    names: tuple[str, ...]
    t: Array
    positions: Array
    velocities: Array
    accelerations: Array

    def __post_init__(self) -> None:
        names = require.each("trajectory: names", self.names, str)
        if isinstance(self.names, str) or not names or len(set(names)) != len(names):
            message = f"trajectory: joint names {list(names)} must be given and distinct"
            raise ProblemError(message, name="names", value=names)
        object.__setattr__(self, "names", names)
        t = require.array("trajectory: times", self.t, ("times",))
        if (np.diff(t) <= 0).any():
            raise ProblemError("trajectory: times must be increasing", name="times", value=t)
        object.__setattr__(self, "t", t)
        for kind in KINDS:
            values = require.array(f"trajectory: {kind}", getattr(self, kind), (len(t), len(names)))
            object.__setattr__(self, kind, values)

    def __repr__(self) -> str:
        return f"<JointTrajectory of {', '.join(self.names)} at {len(self.t)} times, {self.t[0]:g} to {self.t[-1]:g} s>"

    def write_csv(self, path: str | FilePath[str]) -> None:
        """Write the times, and the positions, velocities and accelerations of all joints, as CSV in full precision."""
        head = ["t", *(f"{column_name(name)}.{kind}" for kind in KINDS for name in self.names)]
        rows = np.column_stack([self.t, self.positions, self.velocities, self.accelerations])
        write_text(path, "\n".join([",".join(head), *(",".join(map(repr, row)) for row in rows.tolist()), ""]))

    @classmethod
    def read_csv(cls, path: str | FilePath[str]) -> JointTrajectory:
        """Read a CSV file that `write_csv` has written, in full precision; raise ProblemError for any other file."""
        try:
            text = read_regular(checked_path(path), MAX_FILE_BYTES).decode()
        except (OSError, ValueError) as error:
            words = f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"
            raise ProblemError(words, name="path", value=path) from error
        rows = [line.split(",") for line in text.splitlines()]
        head = rows[0] if rows else []
        count = (len(head) - 1) // 3
        columns = [column.removesuffix(f".{KINDS[0]}") for column in head[1 : count + 1]]
        if count < 1 or head != ["t", *(f"{name}.{kind}" for kind in KINDS for name in columns)]:
            message = f"{path}: the head {head[:4]} is not that of a joint trajectory"
            raise ProblemError(message, name=str(path), value=head)
        try:
            table = np.array([[float(cell) for cell in row] for row in rows[1:]]).reshape(-1, len(head))
        except ValueError as error:
            message = f"{path}: a cell is not a number, or a row is not complete: {error}"
            raise ProblemError(message, name=str(path)) from error
        return cls(tuple(map(joint_name, columns)), table[:, 0], *np.split(table[:, 1:], 3, axis=1))

    def to_ros(self) -> dict[str, Any]:
        """Return the fields of trajectory_msgs/msg/JointTrajectory as a dictionary; times are whole nanoseconds.

        Raises:
            ProblemError: Times are less than a nanosecond apart.
        """
        nanoseconds = np.round(self.t * 1e9).astype(np.int64)
        if (np.diff(nanoseconds) <= 0).any():
            at = int((np.diff(nanoseconds) <= 0).argmax())
            first, second = self.t[at : at + 2].tolist()
            message = f"trajectory: times {first} and {second} s are the same nanosecond"
            raise ProblemError(message, name="times", value=second, time=first)
        values = {kind: getattr(self, kind).tolist() for kind in KINDS}
        points = [
            {kind: rows[k] for kind, rows in values.items()}
            | {"effort": [], "time_from_start": {"sec": ns // 10**9, "nanosec": ns % 10**9}}
            for k, ns in enumerate(nanoseconds.tolist())
        ]
        header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
        return {"header": header, "joint_names": list(self.names), "points": points}

    @classmethod
    def from_ros(cls, message: Mapping[str, Any]) -> JointTrajectory:
        """Convert a message, as returned by `to_ros`, to a trajectory; raise ProblemError if a field is missing."""
        try:
            points = message["points"]
            stamps = [p["time_from_start"] for p in points]
            t = np.array([(stamp["sec"] * 10**9 + stamp["nanosec"]) / 1e9 for stamp in stamps])
            values = [floats([p[kind] for p in points]) for kind in KINDS]
            names = tuple(message["joint_names"])
        except (KeyError, IndexError, TypeError, ValueError) as error:
            text = f"this is not a joint trajectory message: {error!r}"
            raise ProblemError(text, name="message", value=message) from error
        return cls(names, t, *values)


def joint_motion(joints: JointPath, motion: LineMotion) -> tuple[Array, Array, Array, Array]:
    """Return joint positions, velocities, accelerations and jerks for a motion along a path. Shape (M, n) each.

    Rates are q' v, q'' v^2 + q' a and q''' v^3 + 3 q'' v a + q' j; q' is the derivative with respect to distance.
    """
    require.instance("motion", motion, LineMotion)
    rates = rates_along(joints, motion.distance)
    v, a, j = (value[:, None] for value in (motion.speed, motion.acceleration, motion.jerk))
    velocity = rates.first * v
    acceleration = rates.second * v**2 + rates.first * a
    return rates.position, velocity, acceleration, rates.third * v**3 + 3 * rates.second * v * a + rates.first * j


def joint_trajectory(schedule: Schedule, joints: JointPath, period: float) -> JointTrajectory:
    """Return the joint trajectory of a schedule, sampled every `period` s; raise ProblemError for an invalid period.

    Times are whole nanoseconds, those of the ROS message, and the joint positions are those at these times. The last
    time is the first one at or after the end, at rest.
    """
    require.instance("schedule", schedule, Schedule)
    check_joints(joints)
    whole = np.round(schedule.sample(period).t * 1e9)
    whole[-1] = np.ceil(schedule.duration * 1e9)
    t = np.unique(whole) / 1e9
    motion = schedule.at(np.minimum(t, schedule.duration))
    return JointTrajectory(tuple(joints.names), t, *joint_motion(joints, motion)[:3])
