"""The check of anybody's trajectory: everything that is looked at, in one table, with a verdict in a sentence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from models import CollisionScene, FixedBase, FreeFloating, Machine, Robot, Standing, Support, footprint
from models.arrays import Array, ArrayInput
from models.robot.dynamics import GRAVITY
from models.shapes.mesh_files import find_mesh
from models.shapes.shapes import Shape
from ocp.app.check.collisions import clearance_rows, path_rows, with_wide_limits
from ocp.app.check.data_checks import CleanedTrajectory, Fault, clean_trajectory
from ocp.app.check.interpolation import Motion, Rule
from ocp.app.check.joint_limits import (
    Row,
    RowVerdict,
    integrate_base,
    limit_rows,
    momentum_rows,
    standing_rows,
    torque_rows,
)
from ocp.app.check.suspicions import doubtful_times, exchanged_joints
from ocp.app.files import RawTrajectory, Waypoints
from ocp.app.files.trajectory import UNITS
from ocp.console import check_time, interruptible
from ocp.errors import (
    ProblemError,
    checked_choice,
    checked_instance,
    checked_mapping,
    checked_nonnegative,
    checked_positive,
    real,
    unknown_name,
)
from ocp.motion.tasks.limits import JointBounds, unknown_limits
from ocp.tolerances import LIMIT_SHARE, ORIENTATION_TOLERANCE_RAD
from ocp.tolerances import path_tolerance as default_tolerance

__all__ = ["BaseKind", "Check", "Fault", "Limit", "Row", "bounds_of", "check_trajectory"]

BaseKind: TypeAlias = Literal["fixed", "standing", "floating"]
Limit: TypeAlias = float | Mapping[str, float] | None
"""One number for all joints, or numbers by name; "" is the name of all others. None: the robot's own."""


@dataclass(frozen=True, eq=False)
class Check:
    """What was found about a trajectory.

    Attributes:
        file, robot: Their names. joints: Of the motion. samples: Of the file. duration: s.
        rule: How the samples are joined: "linear", "cubic" or "quintic".
        rows: Everything that was looked at. faults: What is wrong.
        suspicions: What the file may mean other than it says; the verdict stays open until that is stated.
        unlimited: What nothing limits. unseen: What was not looked at, and why. notes: What was taken otherwise than
            it stands, or passed over.
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
        """Whether nothing that was looked at is wrong, or suspected to mean something else."""
        return not self.faults and not self.suspicions

    @property
    def sentence(self) -> str:
        """The verdict."""
        open_ = [row.name for row in self.rows if row.verdict is RowVerdict.UNDECIDED]
        but = f"; not decided: {', '.join(open_[:3])}{' ...' if len(open_) > 3 else ''}" if open_ else ""
        without = f"; not looked at: {'; '.join(self.unchecked)}" if self.unchecked else ""
        if self.passed:
            return f"holds all that was looked at{but}{without}"
        if not self.faults:
            return f"is undetermined: {'; '.join(one.text for one in self.suspicions)}{without}"
        count = len(self.faults)
        return f"must not be run: {count} {'fault' if count == 1 else 'faults'}, first {self.faults[0]}{without}"

    def __str__(self) -> str:
        joined = {
            "linear": "straight lines between samples (of positions alone)",
            "cubic": "cubics between samples (of positions and velocities)",
            "quintic": "quintics between samples (of positions, velocities, accelerations)",
        }[self.rule]
        verdict = "FAILED" if self.faults else "undetermined" if self.suspicions else "passed"
        lines = [
            f"Check of {self.file} for {self.robot}: {verdict}",
            f"  {self.samples} samples, {self.duration:.6g} s, {len(self.joints)} joints; {joined}",
        ]
        if self.faults:
            lines.append("faults:")
            lines += [f"  {fault}" for fault in self.faults]
        shown = [row for row in self.rows if row.verdict is not RowVerdict.UNLIMITED]
        if shown:
            width = max(len(row.name) for row in shown)
            lines.append(f"  {'':<{width}}  {'worst':>11}  {'limit':>10}  {'unit':<8}{'at, s':>10}")
            for row in shown:
                limit = "" if row.limit is None else f"{row.limit:.4g}"
                time = "" if row.time is None else f"{row.time:.5g}"
                line = f"  {row.name:<{width}}  {row.value:>11.5g}  {limit:>10}  {row.unit:<8}{time:>10}  {row.verdict}"
                lines.append(f"{line}  {row.note}".rstrip())
        if self.unlimited:
            lines.append("unlimited: " + "; ".join(self.unlimited))
        lines += map(str, self.suspicions)
        lines += [f"not looked at: {one}" for one in self.unchecked]
        lines += [f"note: {one}" for one in self.notes]
        return "\n".join([*lines, f"The trajectory {self.sentence}."])

    def to_dict(self) -> dict[str, Any]:
        """What JSON can hold: everything but the samples."""
        progress = {name: getattr(self, name) for name in ("file", "robot", "joints", "samples", "duration", "rule")}
        progress |= {"passed": self.passed, "verdict": self.sentence}
        progress |= {name: [asdict(one) for one in getattr(self, name)] for name in ("faults", "suspicions", "rows")}
        progress |= {name: list(getattr(self, name)) for name in ("unlimited", "unchecked", "notes")}
        return progress


@dataclass(frozen=True, eq=False)
class CheckRequest:
    """What a check is asked for, arguments as of `check_trajectory`."""

    base: BaseKind
    translation: Array
    rotation: Array
    gravity: Array
    foot: Support | None
    friction: float
    obstacles: tuple[Shape, ...]
    clearance: float | None
    ignored: tuple[tuple[str, str], ...]
    srdf: str | Path | None
    folders: tuple[str | Path, ...]
    missing: Literal["raise", "skip"]
    path: Waypoints | None
    path_tolerance: float
    path_angle: float
    share: float


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
    progress: Callable[[str], None] = lambda what: None,
) -> Check:
    """Check anybody's trajectory for a robot.

    Between samples it is what a controller makes of them, see `check.pieces`; positions, velocities, accelerations
    and jerks are looked at there at all times, and bodies are proven apart. Torques, the zero moment point and the tip
    are looked at several times between two samples.

    Args:
        robot: With its limits. trajectory: As `read_trajectory` reads it.
        velocity, acceleration, jerk, torque: Limits beside, or instead of, those of the robot, rad/s or m/s, ...
        base: "fixed"; "standing" unfastened on the ground; "floating" in space, from rest.
        translation, rotation: Of a base that does not float, in world. gravity: m/s^2, in world.
        foot: That it stands on; from its collision shapes if None. friction: Of the ground.
        obstacles, clearance, ignored, srdf, folders, missing: As of `ocp.plan`; clearance None: nothing is looked at.
        path: Waypoints that the tip is to pass on straight lines. path_tolerance: m; None: the smaller of 0.1 mm and a
            thousandth of the path's extent. path_angle: rad, by which its z axis may lean from the one that they tell.
        share: Of a limit, by which it may be passed.
        rule: How the controller joins the samples, "linear", "cubic" or "quintic". None: by all that they tell, and a
            velocity, acceleration or jerk between them counts only as far as every motion through them needs it.
        time_unit: Of the file's times, "s", "ms", "us" or "ns", or the seconds from one sample number to the next.
            None: seconds, unless they look otherwise.
        unwrap: Take joints with limits whose values were wrapped by whole turns as turning on.
        names_confirmed: Do not suspect columns to be exchanged.
        progress: Is called with what comes next.

    Raises:
        ProblemError, ModelError: What is given does not fit the robot, or no sample can be read.
    """
    checked_instance("robot", robot, Robot)
    checked_instance("trajectory", trajectory, RawTrajectory)
    checked_choice("base", base, ("fixed", "standing", "floating"))
    checked_nonnegative("share", share)
    if path_tolerance is None:
        path_tolerance = default_tolerance(np.zeros((1, 3)) if path is None else path.positions)
    checked_positive("path_tolerance", path_tolerance)
    for what, value in (("path_angle", path_angle), ("friction", friction)):
        if not real(value) > 0:  # which may be infinite
            raise ProblemError(f"{what} must be a number above 0, not {value!r}", name=what, value=value, limit=0.0)
    notes: list[str] = []
    bounds = bounds_of(robot, velocity, acceleration, jerk, torque, notes)
    progress("reading")
    if time_unit is not None:
        units = ("s", "ms", "us", "ns")
        size = time_unit if not isinstance(time_unit, str) else UNITS[checked_choice("time_unit", time_unit, units)]
        checked_positive("time_unit", size)
        trajectory = replace(trajectory, t=trajectory.t * size)
    found = clean_trajectory(trajectory, robot, *bounds[:3], time_unit is not None, unwrap)
    if rule is not None:
        checked_choice("rule", rule, get_args(Rule))
        found = replace(found, motion=found.motion.by(rule))
    motion, whole = found.motion, len(found.joints) == robot.dof
    rows: list[Row] = []
    faults, unchecked = list(found.faults), []

    def add(made: tuple[list[Row], list[Fault]]) -> None:
        rows.extend(made[0])
        faults.extend(made[1])
        check_time()

    progress("limits")
    more, wrong, left = limit_rows(motion, robot, found.joints, bounds, share)
    add((more, wrong))
    unchecked += left
    add(_efforts(found, robot, bounds, share))
    if not whole:
        unchecked.append("torques, clearance and the tip, as joints are missing")
    else:
        asked = CheckRequest(
            base,
            np.asarray(translation, dtype=float),
            np.eye(3) if rotation is None else np.asarray(rotation, dtype=float),
            np.asarray(gravity, dtype=float),
            foot,
            friction,
            tuple(obstacles),
            clearance,
            tuple(ignored),
            srdf,
            tuple(folders),
            missing,
            path,
            path_tolerance,
            path_angle,
            share,
        )
        notes += _machine_rows(robot, found, bounds, asked, add, unchecked, progress)
    suspicions: list[Fault] = []
    if time_unit is None and not any(fault.kind == "units" and fault.name == "time" for fault in faults):
        suspicions += doubtful_times(motion, bounds.velocity[found.joints])
    if not names_confirmed:
        suspicions += exchanged_joints(motion, robot, found.joints, whole and base != "floating")
    unlimited = _unlimited(rows)
    order = {
        kind: k for k, kind in enumerate(("unknown joint", "missing joint", "times", "not a number", "units", "jump"))
    }
    faults.sort(key=lambda fault: order.get(fault.kind, len(order)))
    return Check(
        trajectory.file,
        robot.name,
        tuple(robot.joint_names[k] for k in found.joints),
        found.samples,
        float(motion.t[-1] - motion.t[0]),
        motion.rule,
        tuple(rows),
        tuple(faults),
        tuple(suspicions),
        unlimited,
        tuple(unchecked),
        (*found.notes, *notes),
        found,
    )


def _machine_rows(
    robot: Robot,
    found: CleanedTrajectory,
    bounds: JointBounds,
    asked: CheckRequest,
    add: Callable[[tuple[list[Row], list[Fault]]], None],
    unchecked: list[str],
    progress: Callable[[str], None],
) -> list[str]:
    """Everything that takes the whole robot; what was taken otherwise than told."""
    motion, notes = found.motion, []
    machine: Any
    bases: Array | None = None
    if asked.base == "floating":
        planar = found.base is not None and found.base.shape[1] == 3
        machine = FreeFloating(robot, "planar" if planar else "spatial")
        progress("momentum")
        if found.base is not None:
            bases = found.base
            add(momentum_rows(machine, motion, bases))
        else:
            bases, rows = integrate_base(machine, motion)
            add((rows, []))
    elif asked.base == "standing":
        foot, place = asked.foot, asked.translation
        if foot is None:
            under = footprint(robot, q=motion.q[0], rotation=asked.rotation)
            foot, place = under.support, under.translation
            notes.append(f"it stands on {', '.join(under.links)}")
        down = -float(asked.gravity[2])
        machine = Standing(robot=robot, translation=place, rotation=asked.rotation, support=foot, gravity=down)
        progress("ground")
        add(standing_rows(machine, motion, asked.friction))
    else:
        machine = FixedBase(robot, asked.translation, asked.rotation)
    if robot.total_mass == 0:
        unchecked.append("torques, as the robot has no masses")
    else:
        progress("torques")
        add(torque_rows(motion, machine, bounds, asked.gravity, asked.share, check_time))
    if asked.path is not None:
        progress("path")
        add(path_rows(machine, motion, bases, asked.path, asked.path_tolerance, asked.path_angle))
    progress("clearance")
    _look_around(machine, motion, bases, asked, add, unchecked)
    return notes


def _look_around(
    machine: Machine,
    motion: Motion,
    bases: Array | None,
    asked: CheckRequest,
    add: Callable[[tuple[list[Row], list[Fault]]], None],
    unchecked: list[str],
) -> None:
    """What the machine may touch."""
    robot = machine.robot
    if asked.clearance is None:
        unchecked.append("clearance, as told")
        return
    if not any(link.collisions for link in robot.links):
        unchecked.append("clearance, as the robot has no collision shapes")
        return
    if asked.missing == "skip":
        shapes = [(link.name, shape) for link in robot.links for shape in link.collisions if shape.kind == "mesh"]
        lost = [name for name, shape in shapes if find_mesh(shape.file, shape.folder or None, asked.folders) is None]
        if lost:
            unchecked.append(f"clearance of {', '.join(dict.fromkeys(lost))}, whose meshes are missing")
    around = CollisionScene(
        with_wide_limits(machine, motion),
        asked.obstacles,
        asked.clearance,
        asked.ignored,
        asked.srdf,
        asked.folders,
        asked.missing,
    )
    add(clearance_rows(around, motion, bases if asked.obstacles else None))


def bounds_of(
    robot: Robot,
    velocity: Limit = None,
    acceleration: Limit = None,
    jerk: Limit = None,
    torque: Limit = None,
    notes: list[str] | None = None,
) -> JointBounds:
    """Limits of the joint vector: what is told, else the robot's own; where that is 0 there is none, which is noted."""
    free = np.full(robot.dof, np.inf)
    given = {}
    for what, own, progress in (
        ("velocity", robot.velocity, velocity),
        ("acceleration", free, acceleration),
        ("jerk", free, jerk),
        ("torque", robot.effort, torque),
    ):
        limits = own.copy()
        if notes is not None and (names := unknown_limits(robot, what)):
            notes.append(f"the robot gives {', '.join(names)} a {what} limit of 0: taken as none")
        by_name = progress if isinstance(progress, Mapping) else {} if progress is None else {"": progress}
        for name, value in checked_mapping(what, by_name).items():
            if not real(value) > 0:
                words = f"{what} of {name or 'all joints'} must be a number above 0, not {value!r}"
                raise ProblemError(words, name=what, value=value, limit=0.0)
            if name and name not in robot.joint_names:
                raise unknown_name(f"joint in {what}", name, robot.joint_names)
        for k, name in enumerate(robot.joint_names):
            limits[k] = by_name.get(name, by_name.get("", limits[k]))
        given[what] = limits
    return JointBounds(robot.lower, robot.upper, power=free, **given)


def _efforts(
    found: CleanedTrajectory, robot: Robot, bounds: JointBounds, share: float
) -> tuple[list[Row], list[Fault]]:
    """Torques that the file itself tells, at its samples."""
    rows: list[Row] = []
    faults: list[Fault] = []
    if found.efforts is None:
        return rows, faults
    for column, joint in enumerate(found.joints):
        name = robot.joint_names[joint]
        unit, limit = robot.joint(name).effort_unit, float(bounds.torque[joint])
        k = int(np.abs(found.efforts[:, column]).argmax())
        value, time = float(found.efforts[k, column]), float(found.motion.t[k])
        failed = abs(value) > limit * (1 + share)
        verdict = RowVerdict.FAILED if failed else RowVerdict.OK if np.isfinite(limit) else RowVerdict.UNLIMITED
        progress = limit if np.isfinite(limit) else None
        rows.append(Row(f"told torque of {name}", value, progress, unit, time, verdict, "as the file has it"))
        if failed:
            text = f"the file has {value:.5g} {unit} at {time:.6g} s, limit {limit:.5g}"
            faults.append(Fault("torque", name, text, time, time, value, limit, unit))
    return rows, faults


def _unlimited(rows: Sequence[Row]) -> tuple[str, ...]:
    """What nothing limits, joints of one kind of limit together."""
    joints: dict[str, list[str]] = {}
    counts: dict[str, int] = {}
    for row in rows:
        what, _, name = row.name.partition(" of ")
        counts[what] = counts.get(what, 0) + 1
        if row.verdict is RowVerdict.UNLIMITED:
            joints.setdefault(what, []).append(name)
    return tuple(
        f"{what} of {'every joint' if len(names) == counts[what] and len(names) > 1 else ', '.join(names)}"
        for what, names in joints.items()
    )
