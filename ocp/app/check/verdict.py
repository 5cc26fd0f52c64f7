"""Check a joint trajectory from any source, or a plan; report a table of all quantities and a verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from models import CollisionScene, FixedBase, FreeFloating, Machine, Robot, Standing
from models.checks import Array, real
from models.shapes.mesh_files import find_mesh
from ocp.app.check.data_checks import CleanedTrajectory, clean_trajectory, doubtful_times, exchanged_joints
from ocp.app.check.joint_limits import Fault, Motion, Row, RowVerdict, Rule, limit_rows, rest_row
from ocp.app.check.motion_checks import (
    Findings,
    check_clearance,
    check_efforts,
    check_ground,
    check_momentum,
    check_path,
    check_torques,
    integrate_base,
    with_wide_limits,
)
from ocp.app.files import RawTrajectory, Waypoints
from ocp.app.files.trajectory import UNITS
from ocp.audit.audit import Audit
from ocp.console import check_time, interruptible
from ocp.errors import ProblemError, require
from ocp.motion.plan import Plan, PlanSample
from ocp.motion.result.path_plan import PathPlan
from ocp.motion.result.plan import ENDS
from ocp.motion.result.segmented_plan import ConsecutivePlans, Piece
from ocp.motion.tasks.goals import Scene
from ocp.motion.tasks.limits import Limits, unknown_limits
from ocp.tolerances import LIMIT_SHARE, ORIENTATION_TOLERANCE_RAD
from ocp.tolerances import path_tolerance as default_tolerance


@dataclass(frozen=True, eq=False)
class Check:
    """Result of the check of a trajectory.

    Attributes:
        file, robot: Names of the file and of the robot.
        joints: Joints of the motion.
        samples: Number of samples in the file.
        duration: Duration of the motion, s.
        rule: Interpolation: "linear", "cubic" or "quintic".
        rows: All checked quantities.
        faults: Violations.
        suspicions: Other likely meanings of the file; the verdict is undetermined until they are excluded.
        unlimited: Quantities without a limit.
        unchecked: Quantities that were not checked, and why.
        notes: Remarks on data that were ignored or interpreted.
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
        """Whether the trajectory has no faults and no suspicions (signs that the file may have been misread)."""
        return not self.faults and not self.suspicions

    @property
    def limited_rows(self) -> tuple[Row, ...]:
        """Table rows of the checked quantities, except those that have no limit."""
        return tuple(row for row in self.rows if row.verdict is not RowVerdict.UNLIMITED)

    @property
    def sentence(self) -> str:
        """Verdict on the trajectory as the predicate of a sentence, such as "meets all checked requirements"."""
        names = [row.name for row in self.rows if row.verdict is RowVerdict.UNDECIDED]
        but = f"; undetermined: {', '.join(names[:3])}{' ...' if len(names) > 3 else ''}" if names else ""
        unchecked = f"; not checked: {'; '.join(self.unchecked)}" if self.unchecked else ""
        if self.passed:
            moving = [row.note for row in self.rows if row.name == ENDS and row.verdict is RowVerdict.INFO]
            return "; ".join([f"meets all checked requirements{but}{unchecked}", *(f"it {note}" for note in moving)])
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
        if self.limited_rows:
            width = max(len(row.name) for row in self.limited_rows)
            lines.append(f"  {'':<{width}}  {'worst':>11}  {'limit':>10}  {'unit':<8}{'at, s':>10}")
            for row in self.limited_rows:
                limit = "" if row.limit is None else f"{row.limit:.4g}"
                time = "" if row.time is None else f"{row.time:.5g}"
                line = f"  {row.name:<{width}}  {row.value:>11.5g}  {limit:>10}  {row.unit:<8}{time:>10}  {row.verdict}"
                lines.append(f"{line}  {row.note}".rstrip())
        if self.unlimited:
            lines.append("unlimited: " + "; ".join(self.unlimited))
        lines += map(str, self.suspicions)
        lines += [f"not checked: {quantity}" for quantity in self.unchecked]
        lines += [f"note: {note}" for note in self.notes]
        return "\n".join([*lines, f"The trajectory {self.sentence}."])

    def to_dict(self) -> dict[str, Any]:
        """Return the result of the check as a dictionary for JSON, without the samples of the motion."""
        data = {name: getattr(self, name) for name in ("file", "robot", "joints", "samples", "duration", "rule")}
        data |= {"passed": self.passed, "verdict": self.sentence}
        data |= {name: [asdict(one) for one in getattr(self, name)] for name in ("faults", "suspicions", "rows")}
        data |= {name: list(getattr(self, name)) for name in ("unlimited", "unchecked", "notes")}
        return data


FAULT_ORDER = ("unknown joint", "missing joint", "times", "not a number", "units", "jump")
"""Kinds of faults that are reported first, in this order, because they explain other faults."""


@dataclass(frozen=True)
class Interpretation:
    """Conventions of a trajectory file: interpolation, time unit, wrapped angles and order of the columns.

    Attributes:
        rule: Interpolation of the controller, "linear", "cubic" or "quintic". None: the highest that the data allow; a
            velocity, acceleration or jerk between samples then counts only as far as every motion through them needs
            it.
        time_unit: Unit of the file's times, "s", "ms", "us" or "ns", or the seconds from one sample number to the next.
            None: seconds, unless they look otherwise.
        unwrap: Whether joints with limits are unwrapped by whole turns.
        names_confirmed: Whether the order of the columns is certain.

    Raises:
        ProblemError: A value is unknown.
    """

    rule: Rule | None = None
    time_unit: str | float | None = None
    unwrap: bool = False
    names_confirmed: bool = False

    def __post_init__(self) -> None:
        if self.rule is not None:
            require.choice("rule", self.rule, get_args(Rule))
        if isinstance(self.time_unit, str):
            require.choice("time_unit", self.time_unit, ("s", "ms", "us", "ns"))
        elif self.time_unit is not None:
            require.positive("time_unit", self.time_unit)

    @property
    def seconds(self) -> float:
        """Duration, s, of one unit of the times in the trajectory file."""
        unit = self.time_unit
        return UNITS[unit] if isinstance(unit, str) else 1.0 if unit is None else float(unit)


@dataclass(frozen=True)
class CheckTolerances:
    """Tolerances of the check of a trajectory.

    Attributes:
        share: Tolerance relative to a limit.
        tip_distance: Allowed distance of the tip from its path, m. None: the smaller of 0.1 mm and a thousandth of the
            path's extent.
        tip_angle: Allowed angle of the tip's z axis from that of the waypoints, rad; infinite for no limit.

    Raises:
        ProblemError: A tolerance is not positive, or the share is negative.
    """

    share: float = LIMIT_SHARE
    tip_distance: float | None = None
    tip_angle: float = ORIENTATION_TOLERANCE_RAD

    def __post_init__(self) -> None:
        require.nonnegative("share", self.share)
        if self.tip_distance is not None:
            require.positive("tip_distance", self.tip_distance)
        if not real(self.tip_angle) > 0:  # infinity is allowed
            words = f"tip_angle must be a number above 0, not {self.tip_angle!r}"
            raise ProblemError(words, name="tip_angle", value=self.tip_angle, limit=0.0)


def _checked_machine(machine: Any) -> FixedBase | FreeFloating:
    """Return the machine to check; a robot is put on a fixed base, and other types raise ProblemError."""
    if isinstance(machine, Robot):
        return FixedBase(machine)
    if isinstance(machine, FixedBase | FreeFloating):
        return machine
    words = f"machine must be a robot on a fixed, floating or standing base, not {machine!r}"
    raise ProblemError(words, name="machine", value=machine)


def _checked_bases(findings: Findings, machine: FreeFloating, motion: Motion, base: Array | None) -> Array:
    """Return the configurations of a floating base: integrated or, if given, checked against the conserved momentum."""
    if base is None:
        bases, rows = integrate_base(machine, motion)
        findings.rows += rows
        return bases
    if (count := base.shape[1]) != machine.base_size:
        words = f"the file gives {count} entries of the base, the machine has {machine.base_size}"
        raise ProblemError(words, name="base", value=count, limit=machine.base_size)
    check_momentum(findings, machine, motion, base)
    return base


@interruptible
def check_trajectory(
    machine: Machine | Robot,
    trajectory: RawTrajectory,
    *,
    limits: Limits | None = None,
    scene: Scene | Literal[False] | None = None,
    path: Waypoints | None = None,
    interpretation: Interpretation = Interpretation(),
    tolerances: CheckTolerances = CheckTolerances(),
    progress: Callable[[str], None] = lambda name: None,
) -> Check:
    """Check a joint trajectory of a machine against limits, for collisions, and against the required path of the tip.

    Between samples the motion is interpolated as controllers do. Positions, velocities, accelerations and jerks are
    bounded there at all times, and clearance is proven. Torques, the zero moment point and the tip are evaluated
    several times between two samples. A floating base starts at rest. On a standing machine the ground may not pull,
    the zero moment point stays in the foot, and the foot does not slip.

    Args:
        machine: The machine, or a robot whose base is fixed at the world's origin.
        trajectory: Trajectory as read by `read_trajectory`.
        limits: Limits that replace those of the robot, and the friction of the ground; None: those of the robot. Power
            is not checked.
        scene: Obstacles and clearance, as in `ocp.plan`. None: the machine's own links; False: no distance is checked.
        path: Waypoints that the tip must follow on straight lines.
        interpretation: How the numbers of the file are interpreted.
        tolerances: Tolerances of limits and of the path.
        progress: Function that is called with the name of each stage.

    Raises:
        ProblemError, ModelError: An argument does not fit the machine, or no sample is valid.
    """
    machine = _checked_machine(machine)
    require.instance("trajectory", trajectory, RawTrajectory)
    robot, limits = machine.robot, require.instance("limits", Limits() if limits is None else limits, Limits)
    bounds = limits.bounds(machine)
    notes = [
        f"the robot gives {', '.join(names)} a {quantity} limit of 0: treated as none"
        for quantity in ("velocity", "torque")
        if (names := unknown_limits(robot, quantity))
    ]
    progress("reading")
    trajectory = replace(trajectory, t=trajectory.t * interpretation.seconds)
    unit_known = interpretation.time_unit is not None
    cleaned = clean_trajectory(trajectory, robot, bounds, unit_known=unit_known, unwrap=interpretation.unwrap)
    if interpretation.rule is not None:
        cleaned = replace(cleaned, motion=cleaned.motion.by(interpretation.rule))
    motion, complete = cleaned.motion, len(cleaned.joints) == robot.dof
    findings, share = Findings(faults=list(cleaned.faults)), tolerances.share
    progress("limits")
    rows, faults, unchecked = limit_rows(motion, robot, cleaned.joints, bounds, share=share)
    findings.rows += [*rows, rest_row(motion, robot, cleaned.joints)]
    findings.faults += faults
    check_efforts(findings, cleaned, robot, bounds, share=share)
    check_time()
    if not complete:
        unchecked.append("torques, clearance and the tip, because joints are missing")
    else:
        bases = None
        if isinstance(machine, FreeFloating):
            progress("momentum")
            bases = _checked_bases(findings, machine, motion, cleaned.base)
        elif isinstance(machine, Standing):
            progress("ground")
            check_ground(findings, machine, motion, limits.friction)
        if robot.total_mass == 0:
            unchecked.append("torques, because the robot has no masses")
        else:
            progress("torques")
            check_torques(findings, machine, motion, bounds, share=share)
        check_time()
        if path is not None:
            progress("path")
            default = default_tolerance(path.positions)
            tolerance = default if tolerances.tip_distance is None else tolerances.tip_distance
            check_path(findings, machine, motion, bases, path=path, tolerance=tolerance, angle=tolerances.tip_angle)
            check_time()
        progress("clearance")
        if scene is False:
            unchecked.append("clearance, as requested")
        elif not any(link.collisions for link in robot.links):
            unchecked.append("clearance, because the robot has no collision shapes")
        else:
            place: Scene = require.instance("scene", Scene() if scene is None else scene, Scene)
            unchecked += _missing_meshes(robot, place.folders) if place.missing == "skip" else []
            collisions = CollisionScene(with_wide_limits(machine, motion), **place.collision_options)
            check_clearance(findings, collisions, motion, bases if collisions.obstacles else None)
    suspicions: list[Fault] = []
    if not unit_known and not any(fault.kind == "units" and fault.name == "time" for fault in findings.faults):
        suspicions += doubtful_times(motion, bounds.velocity[cleaned.joints])
    if not interpretation.names_confirmed:
        is_fixed = complete and not isinstance(machine, FreeFloating)
        suspicions += exchanged_joints(motion, robot, cleaned.joints, is_fixed)
    findings.faults.sort(key=lambda fault: (*FAULT_ORDER, fault.kind).index(fault.kind))
    return Check(
        trajectory.file,
        robot.name,
        tuple(robot.joint_names[k] for k in cleaned.joints),
        cleaned.samples,
        float(motion.t[-1] - motion.t[0]),
        motion.rule,
        tuple(findings.rows),
        tuple(findings.faults),
        tuple(suspicions),
        _unlimited_quantities(findings.rows),
        tuple(unchecked),
        (*cleaned.notes, *notes),
        cleaned,
    )


def audit_rows(audit: Audit) -> list[Row]:
    """Return the findings of an audit as table rows."""
    verdicts = [RowVerdict.INFO if f.limit is None else RowVerdict.of(not f.passed) for f in audit.findings]
    return [
        Row(f.name, f.value, f.limit, f.unit, f.time, verdict, f.note)
        for f, verdict in zip(audit.findings, verdicts, strict=True)
    ]


def _missing_meshes(robot: Robot, folders: Sequence[str | Path]) -> list[str]:
    """Return a list with one text about the links whose meshes are missing; an empty list if none is missing."""
    shapes = [(link.name, shape) for link in robot.links for shape in link.collisions if shape.kind == "mesh"]
    names = [name for name, shape in shapes if find_mesh(shape.file, shape.folder or None, folders) is None]
    return [f"clearance of {', '.join(dict.fromkeys(names))}, whose meshes are missing"] if names else []


def _unlimited_quantities(rows: Sequence[Row]) -> tuple[str, ...]:
    """Return one text for each quantity without a limit, such as the jerk, which names the joints concerned."""
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


@dataclass(frozen=True, eq=False)
class PlanVerdict:
    """Audit of a plan against its problem, and check of the plan's samples against the limits of the machine.

    `margin` says what the plan withstands, with the plan as its subject; "" for a plan that fails.
    """

    audit: Audit
    check: Check
    margin: str = ""

    @property
    def passed(self) -> bool:
        """Whether the plan is feasible, a local minimum, and within the limits of its machine."""
        return self.audit.passed and self.check.passed

    @property
    def sentence(self) -> str:
        """Verdict on the plan as the predicate of a sentence, such as "must not be run: ..."."""
        if not self.audit.feasible or self.check.passed:
            return self.audit.sentence
        first, count = self.check.faults[0], len(self.check.faults)
        more = f"; {count - 1} more" if count > 1 else ""
        return f"must not be run: it breaks the limits of its machine, {first}{more}"


def verdict_of(plan: Plan, sample: PlanSample, name: str, **settings: Any) -> PlanVerdict:
    """Audit a plan, check samples of it against limits, and evaluate its margin; `settings` are those of the audit."""
    verdict = PlanVerdict(plan.audit(**settings), _check(plan, sample, name))
    return replace(verdict, margin=plan.margin().sentence) if verdict.passed else verdict


def _check(plan: Plan, sample: PlanSample, name: str) -> Check:
    """Check samples of a plan against the limits of its machine, separately for each segment if there are several."""
    if isinstance(plan, ConsecutivePlans):
        return _worst([_check_segment(piece, sample.t, name) for piece in plan.pieces])
    if isinstance(plan, PathPlan):  # constant rates between waypoints
        joints = tuple(replace(joint, effort=np.inf) for joint in plan.machine.robot.joints)
        times = np.union1d(sample.t, plan.t)
        robot = replace(plan.machine.robot, joints=joints)
        return _check_samples(plan.machine, robot, (times, plan.at(times)["joints"], None, None), name)
    values = (sample.t, sample.joints, sample.rates, sample.accelerations)
    return _check_samples(plan.machine, plan.machine.robot, values, name)


def _check_segment(piece: Piece, times: Array, name: str) -> Check:
    """Return the check of one segment of a plan against joint limits, at both ends and at given times inside."""
    plan, local = piece.plan, times - piece.begin
    inside = local[(local > 0) & (local < plan.horizon)]
    sample = plan.sampled(np.concatenate([[0.0], inside, [plan.horizon]]))
    values = (sample.t + piece.begin, sample.joints, sample.rates, sample.accelerations)
    return _check_samples(plan.machine, plan.machine.robot, values, name)


def _check_samples(
    machine: Machine, robot: Robot, values: tuple[Array, Array, Array | None, Array | None], name: str
) -> Check:
    """Check times (M,), positions and, unless None, rates and accelerations, (M, n) each, against a robot's limits."""
    raw = RawTrajectory(tuple(robot.joint_names), *values, None, np.arange(1, len(values[0]) + 1), True, (), name)
    if not isinstance(machine, FreeFloating):  # the forces on a standing machine are those of its problem
        frame = machine.world_from_base(())
        position, rotation = np.array(frame.position, dtype=float).ravel(), np.array(frame.rotation, dtype=float)
        machine = FixedBase(robot, position, rotation)
    certain = Interpretation(time_unit="s", names_confirmed=True)
    return check_trajectory(replace(machine, robot=robot), raw, scene=False, interpretation=certain)


def _worst(checks: Sequence[Check]) -> Check:
    """Merge the checks of several motions into one with all faults and, for each quantity, the worst table row."""
    rows: dict[str, Row] = {}
    for row in (row for check in checks for row in check.rows):
        if row.name not in rows or _severity(row) > _severity(rows[row.name]):
            rows[row.name] = row
    joined: dict[str, Any] = {
        name: tuple(dict.fromkeys(each for check in checks for each in getattr(check, name)))
        for name in ("suspicions", "unlimited", "unchecked", "notes", "faults")
    }
    samples, duration = (sum(getattr(check, name) for check in checks) for name in ("samples", "duration"))
    return replace(checks[0], rows=tuple(rows.values()), samples=samples, duration=duration, **joined)


def _severity(row: Row) -> tuple[bool, bool, float]:
    """Return the sort key of a table row: (whether failed, whether undetermined, value relative to the limit)."""
    size = abs(row.limit) if row.limit else 1.0
    return row.verdict is RowVerdict.FAILED, row.verdict is RowVerdict.UNDECIDED, abs(row.value) / size
