"""Gallery: a satellite with an arm of seven joints and three wheels catches a body that tumbles, and stops it.

The tip meets a handle on the body, at a time that is free, with the same twist and along the axis of the handle; then
both are one, and the wheels take the momentum until nothing turns. Both phases are planned at the least effort
together.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

import ocp
from models import FreeFloating, Link, Robot, VisualShape, with_wheels
from models.checks import Array
from ocp import Audit, Capture, Cone, Cost, DynamicsSetup, FreeTime, Grasp, Limits, Solution, dynamics_problem
from ocp.app.view.appearance import Frames, frames_along
from ocp.motion.builders.space.pair import grasp_wrench, join_target, motion_of, pair_momentum
from scripts.drawing import COLORS, DASHES
from scripts.robots import capture_family
from scripts.robots.capture_family import SPINS, Member
from scripts.robots.drawing import Scene, animate, joint_curves, page
from scripts.robots.robots import SPACE_ARM
from scripts.robots.space_arm import SATELLITE

__all__ = ["CaptureExample", "draw", "plan", "request"]

START = (0.3, 0.9, 0.2, -1.6, 0.3, 0.9, 0.4)  # rad
MASS, SIZE = 300.0, (1.2, 1.2, 1.6)  # of the target, kg and m
SPIN = np.radians((1.0, -1.5, 2.0))  # rad/s, axes of the target
AWAY = (0.3, -0.2, 0.62)  # of the handle from the tip at the start, axes of the tip, m
WHEEL, MOMENTUM, TORQUE = 0.1, 8.0, 0.4  # each: kg m^2, N m s, N m
RATE = 0.25  # of the joints, rad/s
JOINT_TORQUE = 100.0  # N m
GRASP = Grasp(force=60.0, moment=60.0)
CONE = Cone((0.0, 0.0, -1.0), 0.35, 0.3)
APPROACH, DETUMBLE = FreeTime(8.0, 60.0, 15.0), FreeTime(8.0, 60.0, 40.0)
VIEW = (20.0, -70.0)  # deg
GOLD, DARK = (0.86, 0.72, 0.40, 1.0), (0.20, 0.24, 0.36, 1.0)


@dataclass(frozen=True, eq=False)
class CaptureExample:
    """A capture that was planned.

    Attributes:
        chaser, capture, options: What was planned: machine, task and further arguments of `ocp.plan`.
        plan: Solution of both phases. audit: Its audit.
        family: Captures in the plane over the spin of the target, see `scripts.robots.capture_family`.
    """

    chaser: FreeFloating
    capture: Capture
    options: dict[str, Any]
    plan: Solution
    audit: Audit
    family: list[Member]

    def summary(self) -> dict[str, Any]:
        """A row of the summary."""
        begin, after = (self.plan.phase(name) for name in ("approach", "detumble"))
        force, moment = bearing(self, self.samples("detumble", 201))
        return {
            "robot": f"{SPACE_ARM.name} with three wheels",
            "dof": self.chaser.joint_size,
            "task_rows": None,
            "duration_s": float(begin.horizon + after.horizon),
            "grasp_s": float(begin.horizon),
            "cost_local": None,
            "cost_optimal": float(self.plan.cost),
            "tip_error": None,
            "joint_return_rad": None,
            "audit_passed": self.audit.passed,
            "target_momentum_Nms": float(np.linalg.norm(np.asarray(self.capture.target.conserved_momentum)[:3])),
            "wheel_momentum_largest_Nms": float(np.abs(self.wheels("detumble")).max()),
            "grasp_force_largest_N": float(np.linalg.norm(force, axis=1).max()),
            "grasp_moment_largest_Nm": float(np.linalg.norm(moment, axis=1).max()),
        }

    def samples(self, phase: str, count: int) -> dict[str, Array]:
        """States and controls of a phase at evenly spaced times."""
        return dict(self.plan.phase(phase).at_fraction(np.linspace(0, 1, count)))

    def wheels(self, phase: str, count: int = 201) -> Array:
        """Momenta of the wheels. Shape (count, 3), N m s."""
        return np.asarray(WHEEL * self.samples(phase, count)["velocities"][:, -3:])


def chaser() -> FreeFloating:
    """The arm on its satellite, with wheels along its axes."""
    robot = SPACE_ARM.read()
    return FreeFloating(with_wheels(robot, np.eye(3), WHEEL, momentum=MOMENTUM, torque=TORQUE))


def request(spin: Any = SPIN) -> tuple[FreeFloating, Capture, dict[str, Any]]:
    """Return machine, task and further arguments of `ocp.plan`, for a target of a spin, rad/s, in its own axes."""
    machine = chaser()
    joints = np.array([*START, 0.0, 0.0, 0.0])
    half = np.array(SIZE) / 2
    moments = MASS / 3 * np.diag(half @ half - half**2)
    panel = VisualShape("box", (0.9, 0.03, 1.2), translation=(0.0, half[1] + 0.7, 0.0), color=DARK)
    looks = (VisualShape("box", SIZE, color=GOLD), panel)
    body = Link("target", MASS, (0.0, 0.0, 0.0), moments, visuals=looks)
    robot = Robot((body,), (), name="target", tip="target", tip_translation=(0.0, 0.0, -half[2]))
    tip = machine.tip_pose(machine.base_home(), joints)
    turn = np.array(ca.DM(tip.rotation))
    center = np.array(ca.DM(tip.position)).ravel() + turn @ np.add(AWAY, (0.0, 0.0, half[2]))
    place = np.concatenate([center, quaternion(turn)])
    momentum = np.concatenate([turn @ moments @ np.asarray(spin), np.zeros(3)])
    capture = Capture(
        FreeFloating(robot, conserved_momentum=momentum),
        APPROACH,
        DETUMBLE,
        target_base=place,
        cone=CONE,
        grasp=GRASP,
        end=[*START, np.nan, np.nan, np.nan],
    )
    options = {
        "start": joints,
        "limits": Limits(velocity=[RATE] * 7 + [MOMENTUM / WHEEL] * 3, torque=[JOINT_TORQUE] * 7 + [TORQUE] * 3),
        "cost": Cost(velocity=0.0, effort=[0.01] * 7 + [10.0] * 3, acceleration=[100.0] * 7 + [0.0] * 3, time=0.05),
        "scene": False,
    }
    return machine, capture, options


def quaternion(turn: Array) -> Array:
    """Of axes, (w, x, y, z)."""
    return np.asarray(Rotation.from_matrix(turn).as_quat(scalar_first=True))


def plan(coarse: bool = False) -> CaptureExample:
    """The capture, audited, and the family; `coarse`: of one spin."""
    machine, capture, options = request()
    planned = ocp.plan(machine, capture, **options)
    family = capture_family.plan(SPINS[1:2] if coarse else SPINS)
    return CaptureExample(machine, capture, options, planned.solution, planned.audit(), family)


def bearing(example: CaptureExample, along: dict[str, Array]) -> tuple[Array, Array]:
    """Force and moment that the tip gives the target while detumbling. Shape (M, 3) each, N and N m."""
    pair = together(example)
    free = np.full(7, np.nan)
    problem = dynamics_problem(
        pair,
        (),
        1.0,
        start=None,
        limits=example.options["limits"],
        setup=DynamicsSetup(start_velocity="free", end_velocity="free", start_base=free),
    )
    second = problem.declared.controls["accelerations"].symbol
    base, joints, rates = motion_of(problem)
    result = ca.Function(
        "bearing", [base, joints, rates, second], list(grasp_wrench(pair, example.capture.target, problem))
    )
    names = ("base", "joints", "velocities", "accelerations")
    force, moment = result.map(len(along["base"]))(*(along[name].T for name in names))
    return np.array(force).T, np.array(moment).T


def together(example: CaptureExample) -> FreeFloating:
    """Both as one machine."""
    one, other = example.chaser, example.capture.target
    start = {"base": one.base_home(), "target_base": example.capture.target_base, "joints": example.options["start"]}
    carried = np.array(ca.DM(pair_momentum(one, other, **start))).ravel()
    return FreeFloating(join_target(one.robot, other.robot), conserved_momentum=carried)


def scenes_of(example: CaptureExample, count: int = 161) -> list[Scene]:
    """Both phases, chaser and target in both."""
    pair, result, begin = together(example), [], 0.0
    for phase, title, color in (("approach", "approach", "orange"), ("detumble", "grasped", "blue")):
        along, duration = example.samples(phase, count), example.plan.phase(phase).horizon
        frames = frames_along(pair, along["joints"], along["base"])
        if phase == "approach":
            own = frames_along(example.capture.target, np.zeros((count, 0)), along["target"])
            frames = Frames(
                {**frames.rotations, "target": own.rotations["target"]},
                {**frames.positions, "target": own.positions["target"]},
            )
        times = begin + np.linspace(0.0, duration, count)
        title = f"{title}: {begin:.0f} to {times[-1]:.0f} s"
        result.append(Scene(title, pair.robot, frames, times, color, view=VIEW, root_color=SATELLITE))
        begin = times[-1]
    return result


def draw(example: CaptureExample, folder: Path, *, animation: bool = True) -> None:
    """capture.png and capture.gif; of the family capture_family.png and .csv."""
    capture_family.save(example.family, folder / "capture_family.csv")
    capture_family.draw(example.family, folder / "capture_family.png")
    row, scenes = example.summary(), scenes_of(example)
    title = (
        f"A tumbling body is grasped without impact and stopped in {row['duration_s']:.0f} s; reaction wheels absorb "
        "its momentum"
    )
    spin = np.degrees(np.linalg.norm(SPIN))
    note = (
        f"{SPACE_ARM.name} of {example.chaser.robot.total_mass:.0f} kg, a body of {MASS:.0f} kg that turns by "
        f"{spin:.1f} degrees per second ({row['target_momentum_Nms']:.1f} N m s); earlier configurations are pale. "
        f"Wheels of {MOMENTUM:g} N m s and {TORQUE:g} N m each, joints of {np.degrees(RATE):.0f} degrees per second "
        f"and {JOINT_TORQUE:g} N m, a hand of {GRASP.force:g} N and {GRASP.moment:g} N m, a cone of "
        f"{np.degrees(CONE.half_angle):.0f} degrees over the last {CONE.length:g} m. Both durations are free and "
        "planned with the motion, at the lowest weighted effort; at the end the arm is as at the start, and nothing "
        "but the wheels turns. Masses of the target, wheels and limits are our own choice."
    )
    with page(folder / "capture.png", scenes, 4, height=6.0, share=1.4, note=note, title=title) as axes:
        _momenta(axes[0], example)
        _hand(axes[1], example)
        _rates(axes[2], example)
    if animation:
        one, other = scenes
        animate(folder / "capture.gif", [_whole(example, one, other)], frames=60, seconds=0.1, note=note)


def _whole(example: CaptureExample, one: Scene, other: Scene) -> Scene:
    """Both phases as one scene."""
    frames = Frames(
        {name: np.concatenate([turns, other.frames.rotations[name]]) for name, turns in one.frames.rotations.items()},
        {name: np.concatenate([places, other.frames.positions[name]]) for name, places in one.frames.positions.items()},
    )
    title = f"caught at {one.t[-1]:.0f} s, at rest at {other.t[-1]:.0f} s"
    return Scene(title, one.robot, frames, np.concatenate([one.t, other.t]), "blue", view=VIEW, root_color=SATELLITE)


def _timed(example: CaptureExample, count: int = 201) -> tuple[Array, Array]:
    """Times of both phases."""
    first, second = (example.plan.phase(name).horizon for name in ("approach", "detumble"))
    return np.linspace(0, first, count), first + np.linspace(0, second, count)


def _momenta(ax: Any, example: CaptureExample) -> None:
    for k, times in enumerate(_timed(example)):
        held = example.wheels(("approach", "detumble")[k])
        for i, (name, dash) in enumerate(zip("xyz", DASHES, strict=False)):
            color = COLORS[("blue", "orange", "green")[i]]
            ax.plot(times, held[:, i], color=color, ls=dash, label=f"wheel {name}" if not k else None)
    for side in (-MOMENTUM, MOMENTUM):
        ax.axhline(side, color=COLORS["grey"], lw=0.8)
    ax.text(0.98, MOMENTUM - 0.2, "limit", transform=ax.get_yaxis_transform(), fontsize=7, ha="right", va="top")
    _grasp(ax, example)
    ax.set(title="momentum of the wheels", xlabel="time, s", ylabel="N m s")
    ax.legend(loc="lower left", fontsize=6.5, bbox_to_anchor=(0.0, 0.06))


def _hand(ax: Any, example: CaptureExample) -> None:
    times = _timed(example)[1]
    force, moment = bearing(example, example.samples("detumble", len(times)))
    ax.plot(times, np.linalg.norm(force, axis=1), color=COLORS["blue"], label="force, N")
    ax.plot(times, np.linalg.norm(moment, axis=1), color=COLORS["orange"], ls="--", label="moment, N m")
    ax.set(title="load on the hand", xlabel="time, s", ylabel="N and N m", xlim=(0, times[-1]))
    ax.axvspan(0.0, times[0], color=COLORS["grey"], alpha=0.15, lw=0)
    ax.text(times[0] / 2, 0.6, "no contact", rotation=90, fontsize=7, ha="center", va="center")
    ax.legend(loc="upper right", fontsize=6.5)


def _rates(ax: Any, example: CaptureExample) -> None:
    for k, times in enumerate(_timed(example)):
        rates = example.samples(("approach", "detumble")[k], len(times))["velocities"][:, :7]
        options: dict[str, Any] = {} if k else {"ncols": 2, "fontsize": 6.0, "loc": "upper right", "title": "joint"}
        joint_curves(ax, times, rates, [f"{i + 1}" for i in range(7)], **options)
    _grasp(ax, example)
    ax.set(title="joint velocities", xlabel="time, s", ylabel="rad/s")


def _grasp(ax: Any, example: CaptureExample) -> None:
    """A line at the time of the grasp."""
    at = _timed(example)[0][-1]
    ax.axvline(at, color="black", lw=0.6)
    ax.text(at + 1.0, 0.88, "grasp", transform=ax.get_xaxis_transform(), fontsize=7, va="top")
