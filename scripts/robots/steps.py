"""Gallery: a planar biped takes two steps, statically and dynamically.

53 kg on two legs of hip, knee and ankle; its left foot stays while the right one is set forward, then the other way
round. Statically, its center of mass never leaves the soles that are held, so that it could stop anywhere. Dynamically,
only the zero moment point stays there: it falls forward from foot to foot, in a fraction of the time. The pseudo-
inverse sets the feet as far with the least joint rates; its zero moment point leaves the soles, and the biped falls.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import ocp
from models import Foot, Foothold, FreeFloating, Joint, Link, Robot, VisualShape, rectangle
from models.checks import Array
from ocp import Audit, Limits, Solution
from ocp.app.view.appearance import frames_along
from ocp.motion.builders.standing.stances import StancePhase, Steps, standing_configuration, walk
from ocp.motion.builders.standing.steps import StepsMotion, resolve_steps, steps_motion
from scripts.drawing import COLORS
from scripts.robots.drawing import Scene, animate, page

__all__ = [
    "FRICTION", "SIDES", "Walks", "alternating", "crouched", "draw", "plan", "planar_biped", "planar_feet",
    "planar_steps", "scenes_of", "walks_of",
]  # fmt: skip

SIDES = ("left", "right")
SOLE = ((-0.08, 0.14), (-0.05, 0.05))  # m, in the frame of an ankle
HEEL = 0.08  # of the ankle above the ground, m
LENGTH = 0.25  # of a step, m
FRICTION = 0.6
MARGIN = 0.01  # m
CLEARANCE = 0.02  # of a sole in the middle of its way, m
KINDS: dict[str, dict[str, Any]] = {
    "static walk": {"balance": "static", "margin": 2 * MARGIN, "times": (1.5, 1.5), "color": "orange"},
    "dynamic walk": {"balance": "dynamic", "margin": MARGIN, "times": (0.5, 0.6), "color": "blue"},
}
"""Requirements on the static and on the dynamic walk; durations of both feet held and of one in the air, s."""
VIEW = (9.0, -74.0)  # deg
METAL, DARK = (0.80, 0.82, 0.86, 1.0), (0.25, 0.27, 0.31, 1.0)


@dataclass(frozen=True, eq=False)
class Walks:
    """Two walks over the same footholds, a static and a dynamic one.

    Attributes:
        plans, motions, audits: By the walks' names, as in KINDS.
    """

    plans: dict[str, Solution]
    motions: dict[str, StepsMotion]
    audits: dict[str, Audit]

    @property
    def audit(self) -> Audit:
        """Of the plan in which a fault was found, if there is one, else of the dynamic one."""
        return next((audit for audit in self.audits.values() if audit.failures), [*self.audits.values()][-1])

    def summary(self) -> dict[str, Any]:
        """A row of the summary."""
        careful, whole = (self.motions[name] for name in KINDS)
        slow, fast = careful.summary(), whole.summary()
        robot = whole.steps.robot
        share = np.abs(whole.joint_torques).max(axis=0) / robot.effort
        return {
            "robot": robot.name,
            "dof": robot.dof,
            "task_rows": None,
            "duration_s": fast["duration_s"],
            "duration_static_s": slow["duration_s"],
            "cost_local": None,
            "cost_optimal": float(self.plans["dynamic walk"].cost),
            "tip_error": None,
            "joint_return_rad": None,
            "audit_passed": all(audit.passed for audit in self.audits.values()),
            "audit_feasible": all(audit.feasible for audit in self.audits.values()),
            "zmp_margin_optimal_m": fast["zmp_margin_min_m"],
            "com_margin_optimal_m": fast["com_margin_min_m"],
            "com_margin_static_m": slow["com_margin_min_m"],
            "friction": fast["friction_max"],
            "peak_joint_torque": fast["peak_joint_torque"],
            "peak_torque_share": float(share.max()),
        }


@dataclass(frozen=True, eq=False)
class StepsExample(Walks):
    """The walks of the planar biped.

    Attributes:
        local: The steps of the dynamic one by the pseudo-inverse.
    """

    local: StepsMotion

    def summary(self) -> dict[str, Any]:
        """A row of the summary."""
        return super().summary() | {"zmp_margin_local_m": self.local.summary()["zmp_margin_min_m"]}


def planar_biped() -> Robot:
    """53 kg in the plane y = 0: trunk, thighs and shanks of 0.4 m, feet; hip, knee and ankle of each leg about y."""
    trunk = (
        VisualShape("box", (0.16, 0.24, 0.42), translation=(0.0, 0.0, 0.27), color=METAL),
        VisualShape("sphere", (0.09,), translation=(0.0, 0.0, 0.60), color=METAL),
    )
    links = [Link("trunk", 30.0, (0.0, 0.0, 0.25), np.diag([0.9, 0.8, 0.3]), visuals=trunk)]
    joints = []
    strong: dict[str, Any] = {"axis": (0, 1, 0), "velocity": 6.0, "effort": 200.0}
    for side, aside in zip(SIDES, (0.08, -0.08), strict=True):
        hip, knee, ankle = (f"{side}_{name}" for name in ("hip", "knee", "ankle"))
        thigh, shank, foot = (f"{side}_{name}" for name in ("thigh", "shank", "foot"))
        links += [_limb(thigh, 6.0, 0.4, 0.06, aside), _limb(shank, 4.0, 0.4, 0.045, aside)]
        shoe = VisualShape("box", (0.22, 0.1, 0.05), translation=(0.03, aside, 0.025 - HEEL), color=DARK)
        links += [Link(foot, 1.5, (0.03, 0.0, -0.05), np.diag([0.002, 0.006, 0.006]), visuals=(shoe,))]
        down = (0.0, 0.0, -0.4)
        joints += [Joint(hip, "revolute", "trunk", thigh, lower=-1.6, upper=0.8, **strong)]
        joints += [Joint(knee, "revolute", thigh, shank, down, lower=0.0, upper=2.4, **strong)]
        joints += [Joint(ankle, "revolute", shank, foot, down, lower=-1.2, upper=0.9, **strong)]
    return Robot(tuple(links), tuple(joints), name="planar biped", tip="trunk")


def _limb(name: str, mass: float, length: float, radius: float, aside: float) -> Link:
    """A rod downwards, 0.1 m thick; drawn beside the plane in which it moves."""
    side = mass * (length**2 + 0.1**2) / 12
    middle = (0.0, aside, -length / 2)
    looks = (
        VisualShape("capsule", (radius, length), translation=middle, color=METAL),
        VisualShape("sphere", (1.15 * radius,), translation=(0.0, aside, 0.0), color=DARK),
    )
    inertia = np.diag([side, side, mass * 0.1**2 / 6])
    return Link(name, mass, (0.0, 0.0, -length / 2), inertia, visuals=looks)


def planar_feet() -> dict[str, Foot]:
    """Soles of the planar biped."""
    return {side: Foot(f"{side}_foot", rectangle(*SOLE), (0.0, 0.0, -HEEL)) for side in SIDES}


def planar_steps(count: int, shift: float, swing: float, *, first: str = "right", length: float = LENGTH) -> Steps:
    """Steps of the planar biped; see `alternating`."""
    return Steps(planar_biped(), planar_feet(), alternating(count, shift, swing, first=first, length=length))


def alternating(
    count: int, shift: float, swing: float, *, first: str = "right", length: float = LENGTH, wide: float = 0.0
) -> tuple[StancePhase, ...]:
    """Steps forward, each foot set a length (m) beyond where the other one stands.

    Args:
        shift, swing: Durations with both feet held and with one in the air, s.
        first: Foot of the first step. wide: Of the feet from the middle, m.
    """
    sides = dict(zip(SIDES, (wide, -wide), strict=True))
    order = [first, *(side for side in SIDES if side != first)]
    steps = [(order[k % 2], Foothold.level((k + 1) * length, sides[order[k % 2]])) for k in range(count)]
    start = {side: Foothold.level(0.0, sides[side]) for side in reversed(order)}
    return walk(start, steps, shift=shift, swing=swing)


def crouched(steps: Steps, knee: float = 0.8) -> Array:
    """A start on both feet with knees bent (rad), in balance, in the robot's order."""
    near = np.zeros(steps.robot.dof)
    pitches = [i for i, joint in enumerate(steps.robot.moving_joints) if abs(joint.axis[1]) > 0.5]
    near[pitches] = np.tile([-knee / 2, knee, -knee / 2], 2)
    stance = steps.stances[0]
    result = standing_configuration(stance, near[steps.order(stance)], steps.balanced(0))
    return np.asarray(steps.in_order(stance, result[None])[0])


def plan(coarse: bool = False) -> StepsExample:
    """Both walks, audited; on one mesh only, `coarse` or not."""
    walks = walks_of(planar_steps, KINDS, CLEARANCE)
    steps = walks.motions["dynamic walk"].steps
    return StepsExample(**vars(walks), local=resolve_steps(steps, start=crouched(steps)))


def walks_of(make_steps: Callable[..., Steps], kinds: dict[str, dict[str, Any]], clearance: float) -> Walks:
    """Two steps as each of some kinds asks for them, planned and audited.

    Args:
        make_steps: Steps of a robot, as `planar_steps`.
        kinds: As KINDS.
        clearance: Of a sole in the middle of its way, m.
    """
    plans, motions = {}, {}
    for name, kind in kinds.items():
        steps = replace(
            make_steps(2, *kind["times"]), balance=kind["balance"], margin=kind["margin"], clearance=clearance
        )
        start = crouched(steps)[steps.order(steps.stances[0])]
        plans[name] = ocp.plan(steps.stances[0], steps, start=start, limits=Limits(friction=FRICTION)).solution
        motions[name] = steps_motion(steps, plans[name])
    return Walks(plans, motions, {name: plan.audit() for name, plan in plans.items()})


def scenes_of(walks: Walks, view: tuple[float, float], footprint: Array | None = None) -> list[Scene]:
    """Both walks, the zero moment point marked.

    Args:
        view: Elevation and azimuth, deg.
        footprint: Corners (4, 2) of what is marked on the ground, m.
    """
    result = []
    for name, motion in walks.motions.items():
        turn = Rotation.from_matrix(motion.root_rotation).as_quat(scalar_first=True)
        machine = FreeFloating(motion.steps.robot)
        frames = frames_along(machine, motion.joints, np.column_stack([motion.root_position, turn]))
        result.append(
            Scene(
                f"{name}: {motion.t[-1]:.1f} s", motion.steps.robot, frames, motion.t, KINDS[name]["color"], view=view,
                floor=0.0, footprint=footprint, mark=motion.zero_moment_point,
            )
        )  # fmt: skip
    return result


def draw(example: StepsExample, folder: Path, *, animation: bool = True) -> None:
    """steps.png and steps.gif."""
    careful, whole = (example.motions[name] for name in KINDS)
    out, fallen = -whole.summary()["com_margin_min_m"], -example.local.summary()["zmp_margin_min_m"]
    title = (
        f"Two steps take {whole.t[-1]:.1f} s instead of {careful.t[-1]:.1f} s if the centre of mass may leave the "
        f"feet, here by {1000 * out:.0f} mm"
    )
    note = (
        f"A planar biped of {whole.steps.robot.total_mass:.0f} kg takes two steps of {LENGTH:g} m; earlier "
        "configurations are pale; disc: zero moment point. It is drawn up to the middle of the second step. In the "
        f"static walk, the centre of mass stays {2000 * MARGIN:g} mm inside the soles on the ground; in the dynamic "
        f"walk, only the zero moment point stays inside, by {1000 * MARGIN:g} mm. Friction at most {FRICTION:g}, "
        "torques at most 200 N m, feet land at rest; the durations are given, and both walks have the lowest cost by "
        "the same weights. Dotted: the same steps in the same time with the least joint velocities, by the "
        f"pseudo-inverse; its zero moment point is up to {1000 * fallen:.0f} mm outside the soles, and in a contact "
        "simulation it falls. Masses and limits are our own; the legs move in one plane and are drawn beside each "
        "other."
    )
    low, high = SOLE[0][0], SOLE[0][1] + 2 * LENGTH
    scenes = scenes_of(example, VIEW, np.array([[low, -0.15], [high, -0.15], [high, 0.15], [low, 0.15]]))
    shown = [np.linspace(0.0, motion.t[motion.phase == 3].mean(), 5) for motion in (careful, whole)]
    with page(folder / "steps.png", scenes, shown, height=6.0, share=1.15, note=note, title=title) as axes:
        for ax, name in zip(axes, KINDS, strict=False):
            _balance(ax, name, example.motions[name])
        local = example.local
        line = axes[1].plot(local.t, local.zero_moment_point[:, 0], color="black", ls=":", lw=0.9)
        axes[1].sharex(axes[0])  # the same times and places: that the one walk is shorter is to be seen
        axes[1].sharey(axes[0])
        axes[0].set_ylim(-0.35, 1.15)
        axes[0].legend(loc="upper left", fontsize=6.5)
        axes[1].legend(line, ["zero moment point,\npseudo-inverse"], loc="upper right", fontsize=6.5)
        axes[0].set_ylabel("forward, m; grey: support")
        _loads(axes[2], whole)
    if animation:
        animate(folder / "steps.gif", scenes, frames=44, seconds=0.1, note=note)


def _balance(ax: Any, name: str, motion: StepsMotion) -> None:
    """Where the support is along the way, over time, and the two points that it is to hold."""
    low, high = SOLE[0]
    for k, phase in enumerate(motion.steps.phases):
        inside = motion.phase == k
        at = [float(np.asarray(place.position)[0]) for place in phase.footholds.values()]
        ax.fill_between(motion.t[inside], min(at) + low, max(at) + high, color=COLORS["grey"], alpha=0.22, lw=0)
    ax.plot(motion.t, motion.zero_moment_point[:, 0], color=COLORS[KINDS[name]["color"]], label="zero moment point")
    ax.plot(motion.t, motion.center_of_mass[:, 0], color="black", ls="--", lw=1.1, label="centre of mass")
    ax.set(title=name, xlabel="time, s")


def _loads(ax: Any, motion: StepsMotion) -> None:
    """What each foot bears, over the weight."""
    weight = motion.steps.stances[0].weight
    for side, dashes in zip(SIDES, ("-", "--"), strict=True):
        ax.plot(motion.t, motion.loads[side][:, 5] / weight, color=COLORS["blue"], ls=dashes, label=f"{side} foot")
    ax.set(title="dynamic walk: load", xlabel="time, s", ylabel="load of a foot / weight", ylim=(-0.05, 1.45))
    ax.legend(loc="upper center", ncols=2, fontsize=6.5)
