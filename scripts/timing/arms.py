"""A Panda beside peers: its local motion (pink, mink), its postures (ikpy) and its timing (toppra, ruckig).

Each is asked what it is made for, and what it finds is measured by this package's kinematics. What is not installed is
left out; times are of the processor, toppra's and those beside it of the wall.
"""

from __future__ import annotations

import importlib
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase, paths, smooth
from models.checks import Array
from ocp import RateOptions, TipTask, Unreachable, inverse_kinematics, resolve
from ocp.motion.schedule import JointLimits, LineLimits, schedule
from scripts import drawing
from scripts.papers.run import text_table
from scripts.robots.panda import HOME, LAP, circling
from scripts.robots.robots import PANDA
from scripts.timing.measure import least_of_processor as least
from scripts.timing.measure import timed
from scripts.timing.optimal_control import installed
from scripts.timing.schedules import JOINTS, Along, largest, random_arm

STEPS = (60, 600, 6000)
"""Of a lap, for those that go from step to step."""
TOLERANCES = (1e-4, 1e-7, 1e-10)
"""Of the package's integrator."""
POSES = 60
MOVES = 12
REACHED = 1e-4
"""Misfit at which a posture counts, m and rad."""
DISTRIBUTIONS = {name: name for name in ("mink", "ikpy", "toppra", "ruckig")} | {"pink": "pin-pink"}


def run(repeats: int = 5) -> dict[str, Any]:
    """Rows of each kind: "local", "postures", "toppra", "ruckig"; "versions" of the peers."""
    repeats = min(repeats, 2)
    return {
        "local": local_rows(repeats),
        "postures": configuration_rows(),
        "toppra": [row for seed in range(5) if (row := toppra_row(seed)) is not None],
        "ruckig": ruckig_rows(),
        "versions": {name: installed(of) for name, of in DISTRIBUTIONS.items()},
    }


def tip_function() -> Any:
    """q -> place of the tip (3,) and its axes (3, 3)."""
    q = ca.SX.sym("q", 7)
    pose = FixedBase(PANDA.read()).tip_pose((), q)
    return ca.Function("tip", [q], [pose.position, pose.rotation])


def targets(times: Array) -> tuple[Array, Array]:
    """Places (M, 3) and axes (M, 3, 3) of the lap."""
    task, t = circling(), ca.SX.sym("t")
    assert task.position is not None
    assert task.orientation is not None
    of: Any = ca.Function("target", [t], [task.position(t), task.orientation(t)])
    matches = [of(time) for time in times]
    return np.array([each[0].full().ravel() for each in matches]), np.array([each[1].full() for each in matches])


def pose_error(joints: Array, places: Array, axes: Array) -> tuple[float, float]:
    """Largest distance (m) and angle (rad) of the tip to where it should be."""
    tip, worst = tip_function(), np.zeros(2)
    for q, place, axis in zip(joints, places, axes, strict=True):
        at, turned = tip(q)
        gap = turned.full().T @ axis
        sine = np.linalg.norm(gap - gap.T) / np.sqrt(8)  # accurate near none, unlike the cosine
        worst = np.maximum(
            worst, [np.linalg.norm(at.full().ravel() - place), np.arctan2(sine, (np.trace(gap) - 1) / 2)]
        )
    return float(worst[0]), float(worst[1])


# ---- local motion ------------------------------------------------------------------------------------------------


def local_rows(repeats: int) -> list[dict[str, Any]]:
    """A lap by each tool, finer and finer: time and largest misfit of the tip, at the steps or at 61 times."""
    machine = FixedBase(PANDA.read())
    task = circling()
    start = inverse_kinematics(machine, task, near=HOME, starts=0)[0].joints
    rows = []
    for tolerance in TOLERANCES:

        def work(tolerance: float = tolerance) -> Any:
            return resolve(
                machine, task, LAP, start=start, samples=STEPS[0] + 1, options=RateOptions(tolerance=tolerance)
            )

        motion = work()
        rows.append(_local_row("selfmotion", f"tolerance {tolerance:g}", least(work, repeats), motion.joints, motion.t))
    for name, make in (("pink", pink_stepper), ("mink", mink_stepper)):
        if installed(DISTRIBUTIONS[name]) == "not installed":
            continue
        for count in STEPS:
            times = np.linspace(0.0, LAP, count + 1)
            march = make(start, *targets(times), LAP / count)
            rows.append(_local_row(name, f"{count} steps", least(march, 1 if count > 600 else repeats), march(), times))
    return rows


def _local_row(name: str, how: str, seconds: float, joints: Array, times: Array) -> dict[str, Any]:
    which = np.linspace(0, len(times) - 1, STEPS[0] + 1).astype(int)
    place, angle = pose_error(joints[which], *targets(times[which]))
    return {"tool": name, "how": how, "seconds": seconds, "misfit_m": place, "misfit_rad": angle}


def pink_stepper(start: Array, places: Array, axes: Array, dt: float) -> Callable[[], Array]:
    """Pink: a frame task with gain 1, which asks for the next pose at the end of the step."""
    pink, pin = importlib.import_module("pink"), importlib.import_module("pinocchio")
    whole = pin.buildModelFromUrdf(str(PANDA.path))
    fingers = [whole.getJointId(name) for name in PANDA.options["lock"]]
    at = pin.neutral(whole)
    at[-2:] = list(PANDA.options["lock"].values())
    model = pin.buildReducedModel(whole, fingers, at)
    aims = [pin.SE3(axis, place) for place, axis in zip(places[1:], axes[1:], strict=True)]

    def march() -> Array:
        configuration = pink.Configuration(model, model.createData(), start)
        task = pink.tasks.FrameTask("panda_hand_tcp", position_cost=1.0, orientation_cost=1.0, gain=1.0)
        joints = [start]
        for aim in aims:
            task.set_target(aim)
            rate = pink.solve_ik(configuration, [task], dt, solver="daqp", damping=1e-12)
            configuration.integrate_inplace(rate, dt)
            joints.append(configuration.q.copy())
        return np.array(joints)

    return march


def mink_stepper(start: Array, places: Array, axes: Array, dt: float) -> Callable[[], Array]:
    """Mink: the same; its model is the URDF without what only touches or is seen."""
    mink, mujoco = importlib.import_module("mink"), importlib.import_module("mujoco")
    root = ET.parse(PANDA.path).getroot()
    for link in root.iter("link"):
        for kind in ("visual", "collision"):
            for part in link.findall(kind):
                link.remove(part)
    for joint in root.iter("joint"):
        if joint.get("name") in PANDA.options["lock"]:
            joint.set("type", "fixed")
    compiler = ET.SubElement(ET.SubElement(root, "mujoco"), "compiler")
    compiler.attrib.update(fusestatic="false", inertiafromgeom="false", balanceinertia="true", boundmass="1e-6")
    compiler.set("boundinertia", "1e-9")
    model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    turns = [
        mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(a), p) for p, a in zip(places, axes, strict=True)
    ]

    def march() -> Array:
        configuration = mink.Configuration(model)
        configuration.update(start)
        task = mink.FrameTask("panda_hand_tcp", "body", position_cost=1.0, orientation_cost=1.0, gain=1.0)
        joints = [start]
        for aim in turns[1:]:
            task.set_target(aim)
            rate = mink.solve_ik(configuration, [task], dt, solver="daqp", damping=1e-12, limits=[])
            configuration.integrate_inplace(rate, dt)
            joints.append(configuration.q.copy())
        return np.array(joints)

    return march


# ---- postures ----------------------------------------------------------------------------------------------------


def configuration_rows() -> list[dict[str, Any]]:
    """Random poses that can be reached, from the ready posture: share found, time and misfit of those."""
    machine, tip = FixedBase(PANDA.read()), tip_function()
    robot, rng = machine.robot, np.random.default_rng(0)
    wanted = [tip(rng.uniform(robot.lower, robot.upper)) for _ in range(POSES)]
    poses = [(place.full().ravel(), axes.full()) for place, axes in wanted]
    finders: dict[str, Callable[[Array, Array], Array | None]] = {}
    for starts in (0, 4):

        def ours(place: Array, axes: Array, starts: int = starts) -> Array | None:
            task = TipTask(position=place, orientation=axes)
            try:
                return inverse_kinematics(machine, task, near=HOME, starts=starts)[0].joints
            except Unreachable:
                return None

        finders[f"selfmotion, {starts} more starts"] = ours
    if installed("ikpy") != "not installed":
        finders["ikpy"] = ikpy_finder()
    rows = []
    for name, find in finders.items():
        results: list[Array | None] = []
        find(*poses[0])
        seconds = least(lambda find=find, results=results: results.extend(find(*pose) for pose in poses), 1)  # type: ignore[misc]
        fits = [
            max(pose_error(q[None], place[None], axes[None]))
            for q, (place, axes) in zip(results, poses, strict=True)
            if q is not None
        ]
        inside = [fit for fit in fits if fit < REACHED]
        rows.append(
            {
                "tool": name,
                "poses": POSES,
                "found": len(inside) / POSES,
                "seconds": seconds / POSES,
                "misfit": float(np.median(inside)) if inside else None,
            }
        )
    return rows


def ikpy_finder() -> Callable[[Array, Array], Array]:
    """Ikpy, place and axes, from the ready posture."""
    chain_of = importlib.import_module("ikpy.chain").Chain
    elements = ["panda_link0"]
    for k in range(1, 8):
        elements += [f"panda_joint{k}", f"panda_link{k}"]
    elements += [
        "panda_joint8",
        "panda_link8",
        "panda_hand_joint",
        "panda_hand",
        "panda_hand_tcp_joint",
        "panda_hand_tcp",
    ]
    chain = chain_of.from_urdf_file(str(PANDA.path), base_elements=elements)
    moving = [link.joint_type != "fixed" for link in chain.links]
    chain.active_links_mask = np.array(moving)
    home = np.zeros(len(chain.links))
    home[moving] = HOME

    def find(place: Array, axes: Array) -> Array:
        solutions = chain.inverse_kinematics(place, axes, orientation_mode="all", initial_position=home)
        return np.asarray(solutions[moving])

    return find


# ---- timing ------------------------------------------------------------------------------------------------------


def toppra_row(seed: int) -> dict[str, Any] | None:
    """Compare the schedule of a random arm without jerk limits with that of toppra; None if it is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            toppra, constraint, algorithm = (
                importlib.import_module(f"toppra{part}") for part in ("", ".constraint", ".algorithm")
            )
    except ImportError:
        return None
    toppra.setup_logging("ERROR")
    path, joints, limits = random_arm(seed)
    assert limits.joints is not None
    bounds = JointLimits(limits.joints.velocity, limits.joints.acceleration)
    free = LineLimits(100.0, 1000.0, np.inf, joints=bounds)
    plan, seconds = timed(lambda: schedule(path, free, joints=joints))
    s = np.linspace(0.0, path.length, 1000)
    both = np.array([[-1.0, 1.0]])
    velocity, acceleration = (np.asarray(each)[:, None] * both for each in (bounds.velocity, bounds.acceleration))

    def planned() -> Any:
        curve = toppra.SplineInterpolator(s, joints.at(s).position)
        limited = [constraint.JointVelocityConstraint(velocity), constraint.JointAccelerationConstraint(acceleration)]
        return algorithm.TOPPRA(limited, curve, gridpoints=s).compute_trajectory(0, 0)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        motion, peer_seconds = timed(planned)
        rates = np.abs(motion(np.linspace(0.0, motion.duration, 50_001), 2)).max(axis=0)
    return {
        "seed": seed,
        "seconds": seconds,
        "toppra_s": peer_seconds,
        "longer": float(plan.duration / motion.duration - 1),
        "largest_demand": largest(plan, joints),
        "toppra_acceleration_over_limit": float((rates / acceleration[:, 1]).max()),
    }


class Straight(Along):
    """All joints in proportion to the distance along a path of 1 m."""

    def __init__(self, first: Array, last: Array) -> None:
        self.names, self.first, self.move = tuple(f"joint{k}" for k in range(len(first))), first, last - first

    def at(self, distance: Any) -> Any:
        """Joints and three derivatives. Shape (M, n) each."""
        s = np.asarray(distance, dtype=float)[:, None]
        nothing = np.zeros((len(s), len(self.move)))
        rates = {"position": self.first + s * self.move, "first": nothing + self.move}
        return type("Rates", (), rates | {"second": nothing, "third": nothing})


def ruckig_rows() -> list[dict[str, Any]]:
    """Straight moves from rest to rest between random postures, within velocity, acceleration and jerk, by both.

    ruckig solves this in closed form; the package schedules any path, of which this is one.
    """
    try:
        ruckig = importlib.import_module("ruckig")
    except ImportError:
        return []
    robot, rng, rows = PANDA.read(), np.random.default_rng(0), []
    limits = JointLimits(JOINTS.velocity, JOINTS.acceleration, JOINTS.jerk)
    line = smooth(paths.Path.through([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]), deviation=1e-3)
    for number in range(MOVES):
        first, last = rng.uniform(robot.lower, robot.upper, (2, robot.dof))
        joints, wide = Straight(first, last), LineLimits(1e3, 1e5, 1e8, joints=limits)

        def ours(joints: Straight = joints, wide: LineLimits = wide) -> Any:
            return schedule(line, wide, joints=joints)

        def peer(first: Array = first, last: Array = last) -> Any:
            request, result = ruckig.InputParameter(robot.dof), ruckig.Trajectory(robot.dof)
            request.current_position, request.target_position = first.tolist(), last.tolist()
            for name in ("velocity", "acceleration", "jerk"):
                setattr(request, f"max_{name}", np.asarray(getattr(limits, name), dtype=float).tolist())
            request.synchronization = ruckig.Synchronization.Phase
            ruckig.Ruckig(robot.dof).calculate(request, result)
            return result

        plan, motion = ours(), peer()
        places = np.array([motion.at_time(t)[0] for t in np.linspace(0.0, motion.duration, 201)]) - first
        path = (last - first) / np.linalg.norm(last - first)
        rows.append(
            {
                "move": number,
                "seconds": least(ours, 1),
                "ruckig_s": least(peer, 20),
                "duration_s": plan.duration,
                "longer": float(plan.duration / motion.duration - 1),
                "ruckig_off_line_rad": float(np.abs(places - np.outer(places @ path, path)).max()),
                "largest_demand": largest(plan, joints),
            }
        )
    return rows


# ---- the page ----------------------------------------------------------------------------------------------------


def report(numbers: dict[str, Any]) -> str:
    """The tables."""
    tables = [text_table(numbers[name], 4) for name in ("local", "postures", "toppra", "ruckig") if numbers[name]]
    return "\n\n".join([*tables, ", ".join(f"{name} {of}" for name, of in numbers["versions"].items())])


def plot(path: Path, numbers: dict[str, Any]) -> None:
    """Misfit over time of local motions; share and time of postures; times of schedules."""
    note = (
        f"Left: a lap of {LAP:g} s, six rows; pink and mink at {', '.join(map(str, STEPS))} steps, the package's "
        f"integrator at tolerances {', '.join(f'{each:g}' for each in TOLERANCES)}. Middle: {POSES} random poses from "
        f"one posture. Right: schedules of the same paths and limits; toppra without jerk, ruckig's moves straight."
    )
    with drawing.sheet(path, (1, 3), (10.0, 3.4), note) as (_, axes):
        left, middle, right = np.ravel(axes)
        for name, color, mark in (("selfmotion", "blue", "o"), ("pink", "purple", "s"), ("mink", "orange", "D")):
            mine = [row for row in numbers["local"] if row["tool"] == name]
            if mine:
                times, misfits = ([row[key] for row in mine] for key in ("seconds", "misfit_m"))
                left.loglog(times, misfits, marker=mark, color=drawing.COLORS[color], ms=4, label=name)
        left.set(xlabel="time, s", ylabel="largest position error of the tip, m", title="local motion")
        left.legend()
        for row, color in zip(numbers["postures"], ("blue", "sky", "orange"), strict=False):
            middle.semilogx(
                1e3 * row["seconds"], 100 * row["found"], "o", color=drawing.COLORS[color], label=row["tool"]
            )
        middle.set(xlabel="time a pose, ms", ylabel="poses solved, %", title="inverse kinematics", ylim=(0, 105))
        middle.legend(loc="lower right")
        for name, color, mark in (("toppra", "green", "^"), ("ruckig", "purple", "s")):
            if rows := numbers[name]:
                theirs = [row[f"{name}_s"] for row in rows]
                right.loglog(
                    theirs, [row["seconds"] for row in rows], mark, color=drawing.COLORS[color], ms=4, label=name
                )
        right.set(
            xlabel="duration by the other library, s", ylabel="duration by selfmotion, s", title="timing of paths"
        )
        right.legend()
