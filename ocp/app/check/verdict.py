"""Check a joint trajectory from any source: all quantities in one table, and a verdict in one sentence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from models import CollisionScene, FixedBase, FreeFloating, Robot, Standing, Support, footprint
from models.checks import Array, ArrayInput, real
from models.robot.dynamics import GRAVITY
from models.shapes.mesh_files import find_mesh
from models.shapes.shapes import Shape
from ocp.app.check.collisions import clearance_rows, path_rows, with_wide_limits
from ocp.app.check.data_checks import CleanedTrajectory, Fault, clean_trajectory
from ocp.app.check.interpolation import Rule
from ocp.app.check.joint_limits import Row, RowVerdict, floating_base_rows, limit_rows, standing_rows, torque_rows
from ocp.app.check.suspicions import doubtful_times, exchanged_joints
from ocp.app.files import RawTrajectory, Waypoints
from ocp.app.files.trajectory import UNITS
from ocp.console import check_time, interruptible
from ocp.errors import ProblemError, require
from ocp.motion.tasks.limits import JointBounds, unknown_limits
from ocp.tolerances import LIMIT_SHARE, ORIENTATION_TOLERANCE_RAD
from ocp.tolerances import path_tolerance as default_tolerance

__all__ = ["BaseKind", "Check", "Fault", "Limit", "Row", "bounds_of", "check_trajectory"]

BaseKind: TypeAlias = Literal["fixed", "standing", "floating"]
Limit: TypeAlias = float | Mapping[str, float] | None
"""One number for all joints, or numbers by name with "" for all other joints. None: the robot's own limit."""


@dataclass(frozen=True, eq=False)
class Check:
    """Result of a check.

    Attributes:
        file, robot: Names of the file and of the robot.
        joints: Joints of the motion.
        samples: Number of samples in the file.
        duration: s.
        rule: Interpolation: "linear", "cubic" or "quintic".
        rows: All checked quantities.
        faults: Violations.
        suspicions: Other likely meanings of the file; the verdict is undetermined until they are excluded.
        unlimited: Quantities without a limit.
        unchecked: Quantities that were not checked, and why.
        notes: What was ignored or interpreted.
        cleaned: The motion that was checked.
    """

    file: str
    robot: str
    joints: tuple[str, ...]
    samples: int
    duration: float
    rule: str
    rows: tuple[Row, ...]
    faults: tuple[Fault, ...]
    suspicions: tuple[Fault, ...]
    unlimited: tuple[str, ...]
    unchecked: tuple[str, ...]
    notes: tuple[str, ...]
    cleaned: CleanedTrajectory

    @property
    def passed(self) -> bool:
        """Whether there are neither faults nor suspicions."""
        return not self.faults and not self.suspicions

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        names = [row.name for row in self.rows if row.verdict is RowVerdict.UNDECIDED]
        but = f"; undetermined: {', '.join(names[:3])}{' ...' if len(names) > 3 else ''}" if names else ""
        unchecked = f"; not checked: {'; '.join(self.unchecked)}" if self.unchecked else ""
        if self.passed:
            return f"meets all checked requirements{but}{unchecked}"
        if not self.faults:
            return f"is undetermined: {'; '.join(one.text for one in self.suspicions)}{unchecked}"
        count = len(self.faults)
        return f"must not be run: {count} {'fault' if count == 1 else 'faults'}, first {self.faults[0]}{unchecked}"

    def __str__(self) -> str:
        rule = {
            "linear": "linear interpolation (of positions alone)",
            "cubic": "cubic interpolation (of positions and velocities)",
            "quintic": "quintic interpolation (of positions, velocities, accelerations)",
        }[self.rule]
        verdict = "FAILED" if self.faults else "undetermined" if self.suspicions else "passed"
        lines = [
            f"Check of {self.file} for {self.robot}: {verdict}",
            f"  {self.samples} samples, {self.duration:.6g} s, {len(self.joints)} joints; {rule}",
        ]
        if self.faults:
            lines.append("faults:")
            lines += [f"  {fault}" for fault in self.faults]
        limited = [row for row in self.rows if row.verdict is not RowVerdict.UNLIMITED]
        if limited:
            width = max(len(row.name) for row in limited)
            lines.append(f"  {'':<{width}}  {'worst':>11}  {'limit':>10}  {'unit':<8}{'at, s':>10}")
            for row in limited:
                limit = "" if row.limit is None else f"{row.limit:.4g}"
                time = "" if row.time is None else f"{row.time:.5g}"
                line = f"  {row.name:<{width}}  {row.value:>11.5g}  {limit:>10}  {row.unit:<8}{time:>10}  {row.verdict}"
                lines.append(f"{line}  {row.note}".rstrip())
        if self.unlimited:
            lines.append("unlimited: " + "; ".join(self.unlimited))
        lines += map(str, self.suspicions)
        lines += [f"not checked: {one}" for one in self.unchecked]
        lines += [f"note: {one}" for one in self.notes]
        return "\n".join([*lines, f"The trajectory {self.sentence}."])

    def to_dict(self) -> dict[str, Any]:
        """Return the result without the samples, as JSON can represent it."""
        data = {name: getattr(self, name) for name in ("file", "robot", "joints", "samples", "duration", "rule")}
        data |= {"passed": self.passed, "verdict": self.sentence}
        data |= {name: [asdict(one) for one in getattr(self, name)] for name in ("faults", "suspicions", "rows")}
        data |= {name: list(getattr(self, name)) for name in ("unlimited", "unchecked", "notes")}
        return data


FAULT_ORDER = {
    kind: place
    for place, kind in enumerate(("unknown joint", "missing joint", "times", "not a number", "units", "jump"))
}
"""Kinds of faults that explain others, in the order of reporting."""


@interruptible
def check_trajectory(
    robot: Robot,
    trajectory: RawTrajectory,
    *,
    velocity: Limit = None,
    acceleration: Limit = None,
    jerk: Limit = None,
    torque: Limit = None,
    base: BaseKind = "fixed",
    translation: ArrayInput = (0.0, 0.0, 0.0),
    rotation: ArrayInput = None,
    gravity: ArrayInput = GRAVITY,
    foot: Support | None = None,
    friction: float = np.inf,
    obstacles: Sequence[Shape] = (),
    clearance: float | None = 0.0,
    ignored: Sequence[tuple[str, str]] = (),
    srdf: str | Path | None = None,
    folders: Sequence[str | Path] = (),
    missing: Literal["raise", "skip"] = "raise",
    path: Waypoints | None = None,
    path_tolerance: float | None = None,
    path_angle: float = ORIENTATION_TOLERANCE_RAD,
    share: float = LIMIT_SHARE,
    rule: Rule | None = None,
    time_unit: str | float | None = None,
    unwrap: bool = False,
    names_confirmed: bool = False,
    progress: Callable[[str], None] = lambda name: None,
) -> Check:
    """Check a joint trajectory for a robot.

    Between samples the motion is interpolated as controllers do, see `check.interpolation`. Positions, velocities,
    accelerations and jerks are bounded there at all times, and clearance is proven. Torques, the zero moment point and
    the tip are evaluated several times between two samples.

    Args:
        robot: With its limits.
        trajectory: As read by `read_trajectory`.
        velocity, acceleration, jerk, torque: Limits in addition to, or instead of, those of the robot, rad/s or m/s,
            ...
        base: "fixed"; "standing" on the ground without fastening; "floating" in space, from rest.
        translation, rotation: Pose of a base that does not float, in world.
        gravity: m/s^2, in world.
        foot: Contact area; None: from the collision shapes.
        friction: Coefficient of friction of the ground.
        obstacles, clearance, ignored, srdf, folders, missing: As in `ocp.plan`. clearance=None: clearance is not
            checked.
        path: Waypoints that the tip must follow on straight lines.
        path_tolerance: Allowed distance from the path, m. None: the smaller of 0.1 mm and a thousandth of the path's
            extent.
        path_angle: Allowed angle of the tip's z axis from that of the waypoints, rad.
        share: Tolerance relative to a limit.
        rule: Interpolation of the controller, "linear", "cubic" or "quintic". None: the highest that the data allow; a
            velocity, acceleration or jerk between samples then counts only as far as every motion through them needs
            it.
        time_unit: Unit of the file's times, "s", "ms", "us" or "ns", or the seconds from one sample number to the next.
            None: seconds, unless they look otherwise.
        unwrap: Whether joints with limits are unwrapped by whole turns.
        names_confirmed: Whether the order of the columns is certain.
        progress: Is called with the name of each stage.

    Raises:
        ProblemError, ModelError: An argument does not fit the robot, or no sample is valid.
    """
    require.instance("robot", robot, Robot)
    require.instance("trajectory", trajectory, RawTrajectory)
    require.choice("base", base, ("fixed", "standing", "floating"))
    require.nonnegative("share", share)
    if path_tolerance is None:
        path_tolerance = default_tolerance(np.zeros((1, 3)) if path is None else path.positions)
    require.positive("path_tolerance", path_tolerance)
    for name, value in (("path_angle", path_angle), ("friction", friction)):
        if not real(value) > 0:  # infinity is allowed
            raise ProblemError(f"{name} must be a number above 0, not {value!r}", name=name, value=value, limit=0.0)
    notes: list[str] = []
    bounds = bounds_of(robot, velocity, acceleration, jerk, torque, notes)
    progress("reading")
    if time_unit is not None:
        trajectory = replace(trajectory, t=trajectory.t * _seconds(time_unit))
    cleaned = clean_trajectory(trajectory, robot, *bounds[:3], time_unit is not None, unwrap)
    if rule is not None:
        require.choice("rule", rule, get_args(Rule))
        cleaned = replace(cleaned, motion=cleaned.motion.by(rule))
    motion, complete = cleaned.motion, len(cleaned.joints) == robot.dof
    rows: list[Row] = []
    faults, unchecked = list(cleaned.faults), []

    def add(result: tuple[list[Row], list[Fault]]) -> None:
        rows.extend(result[0])
        faults.extend(result[1])
        check_time()

    progress("limits")
    limit_table, limit_faults, unlimited_orders = limit_rows(motion, robot, cleaned.joints, bounds, share)
    add((limit_table, limit_faults))
    unchecked += unlimited_orders
    add(_efforts(cleaned, robot, bounds, share))
    if not complete:
        unchecked.append("torques, clearance and the tip, because joints are missing")
    else:
        gravity = np.asarray(gravity, dtype=float)
        pose = (
            np.asarray(translation, dtype=float),
            np.asarray(np.eye(3) if rotation is None else rotation, dtype=float),
        )
        machine = _machine_of(robot, cleaned, base, pose, gravity, foot, notes)
        bases = None
        if base == "floating":
            progress("momentum")
            bases, base_rows, base_faults = floating_base_rows(machine, motion, cleaned.base)
            add((base_rows, base_faults))
        elif base == "standing":
            progress("ground")
            add(standing_rows(machine, motion, friction))
        if robot.total_mass == 0:
            unchecked.append("torques, because the robot has no masses")
        else:
            progress("torques")
            add(torque_rows(motion, machine, bounds, gravity, share, check_time))
        if path is not None:
            progress("path")
            add(path_rows(machine, motion, bases, path, path_tolerance, path_angle))
        progress("clearance")
        if clearance is None:
            unchecked.append("clearance, as requested")
        elif not any(link.collisions for link in robot.links):
            unchecked.append("clearance, because the robot has no collision shapes")
        else:
            unchecked += _missing_meshes(robot, folders) if missing == "skip" else []
            wide, others = with_wide_limits(machine, motion), tuple(obstacles)
            scene = CollisionScene(wide, others, clearance, tuple(ignored), srdf, tuple(folders), missing)
            add(clearance_rows(scene, motion, bases if others else None))
    suspicions: list[Fault] = []
    if time_unit is None and not any(fault.kind == "units" and fault.name == "time" for fault in faults):
        suspicions += doubtful_times(motion, bounds.velocity[cleaned.joints])
    if not names_confirmed:
        suspicions += exchanged_joints(motion, robot, cleaned.joints, complete and base != "floating")
    unlimited = _unlimited(rows)
    faults.sort(key=lambda fault: FAULT_ORDER.get(fault.kind, len(FAULT_ORDER)))
    return Check(
        trajectory.file,
        robot.name,
        tuple(robot.joint_names[k] for k in cleaned.joints),
        cleaned.samples,
        float(motion.t[-1] - motion.t[0]),
        motion.rule,
        tuple(rows),
        tuple(faults),
        tuple(suspicions),
        unlimited,
        tuple(unchecked),
        (*cleaned.notes, *notes),
        cleaned,
    )


def _seconds(time_unit: str | float) -> float:
    """Return a time unit in s."""
    if isinstance(time_unit, str):
        return UNITS[require.choice("time_unit", time_unit, ("s", "ms", "us", "ns"))]
    return require.positive("time_unit", time_unit)


def _machine_of(
    robot: Robot,
    cleaned: CleanedTrajectory,
    base: BaseKind,
    pose: tuple[Array, Array],
    gravity: Array,
    foot: Support | None,
    notes: list[str],
) -> Any:
    """Return the robot on its base."""
    if base == "floating":
        planar = cleaned.base is not None and cleaned.base.shape[1] == 3
        return FreeFloating(robot, "planar" if planar else "spatial")
    translation, rotation = pose
    if base == "fixed":
        return FixedBase(robot, translation, rotation)
    if foot is None:
        contact = footprint(robot, q=cleaned.motion.q[0], rotation=rotation)
        foot, translation = contact.support, contact.translation
        notes.append(f"it stands on {', '.join(contact.links)}")
    down = -float(gravity[2])
    return Standing(robot=robot, translation=translation, rotation=rotation, support=foot, gravity=down)


def _missing_meshes(robot: Robot, folders: Sequence[str | Path]) -> list[str]:
    """Return a sentence about the links whose meshes are missing, if there are any."""
    shapes = [(link.name, shape) for link in robot.links for shape in link.collisions if shape.kind == "mesh"]
    names = [name for name, shape in shapes if find_mesh(shape.file, shape.folder or None, folders) is None]
    return [f"clearance of {', '.join(dict.fromkeys(names))}, whose meshes are missing"] if names else []


def bounds_of(
    robot: Robot,
    velocity: Limit = None,
    acceleration: Limit = None,
    jerk: Limit = None,
    torque: Limit = None,
    notes: list[str] | None = None,
) -> JointBounds:
    """Return the limits of the joint vector: the given ones, else the robot's own.

    A limit of 0 in the robot's description means none; it is added to `notes`.
    """
    free = np.full(robot.dof, np.inf)
    limits = {}
    for quantity, own, override in (
        ("velocity", robot.velocity, velocity),
        ("acceleration", free, acceleration),
        ("jerk", free, jerk),
        ("torque", robot.effort, torque),
    ):
        values = own.copy()
        if notes is not None and (names := unknown_limits(robot, quantity)):
            notes.append(f"the robot gives {', '.join(names)} a {quantity} limit of 0: treated as none")
        by_name = override if isinstance(override, Mapping) else {} if override is None else {"": override}
        for name, value in require.mapping(quantity, by_name).items():
            if not real(value) > 0:
                words = f"{quantity} of {name or 'all joints'} must be a number above 0, not {value!r}"
                raise ProblemError(words, name=quantity, value=value, limit=0.0)
            if name and name not in robot.joint_names:
                raise require.unknown(f"joint in {quantity}", name, robot.joint_names)
        for k, name in enumerate(robot.joint_names):
            values[k] = by_name.get(name, by_name.get("", values[k]))
        limits[quantity] = values
    return JointBounds(robot.lower, robot.upper, power=free, **limits)


def _efforts(
    cleaned: CleanedTrajectory, robot: Robot, bounds: JointBounds, share: float
) -> tuple[list[Row], list[Fault]]:
    """Check the torques in the file, at its samples."""
    rows: list[Row] = []
    faults: list[Fault] = []
    if cleaned.efforts is None:
        return rows, faults
    for column, joint in enumerate(cleaned.joints):
        name = robot.joint_names[joint]
        unit, limit = robot.joint(name).effort_unit, float(bounds.torque[joint])
        k = int(np.abs(cleaned.efforts[:, column]).argmax())
        value, time = float(cleaned.efforts[k, column]), float(cleaned.motion.t[k])
        failed = abs(value) > limit * (1 + share)
        verdict = RowVerdict.FAILED if failed else RowVerdict.OK if np.isfinite(limit) else RowVerdict.UNLIMITED
        row_limit = limit if np.isfinite(limit) else None
        rows.append(Row(f"given torque of {name}", value, row_limit, unit, time, verdict, "as given in the file"))
        if failed:
            text = f"the file has {value:.5g} {unit} at {time:.6g} s, limit {limit:.5g}"
            faults.append(Fault("torque", name, text, time, time, value, limit, unit))
    return rows, faults


def _unlimited(rows: Sequence[Row]) -> tuple[str, ...]:
    """Return the quantities without a limit, joints of one kind together."""
    joints: dict[str, list[str]] = {}
    counts: dict[str, int] = {}
    for row in rows:
        quantity, _, name = row.name.partition(" of ")
        counts[quantity] = counts.get(quantity, 0) + 1
        if row.verdict is RowVerdict.UNLIMITED:
            joints.setdefault(quantity, []).append(name)
    return tuple(
        f"{quantity} of {'every joint' if len(names) == counts[quantity] and len(names) > 1 else ', '.join(names)}"
        for quantity, names in joints.items()
    )
