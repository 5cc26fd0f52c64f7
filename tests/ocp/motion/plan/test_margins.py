"""Margins of plans: closed forms, monotonicity, random draws inside, and the true range beyond, by models changed."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import (
    Box,
    CollisionScene,
    CollisionShape,
    FixedBase,
    HalfSpace,
    Sphere,
    Standing,
    example_robot,
    move_tip,
    planar_chain,
    with_load,
)
from models.checks import Array
from models.machines.machine import wrenches_at
from models.machines.standing import center_of_pressure
from models.spatial import quaternion_from_rotation
from ocp import Cost, Goal, Limits, Plan, ProblemError, Scene, SolveError, Waypoints, joint_torques, plan, plan_problem
from ocp.__main__ import main
from ocp.motion.local.collisions import distances_along
from ocp.motion.plan import dispatch
from ocp.motion.result.margin import Margin
from ocp.motion.result.segmented_plan import SequencePlan
from ocp.motion.search.dead_end import DeadEnd
from ocp.motion.tasks.targets import tip_poses
from ocp.problem.values import Sampler
from tests.ocp.motion.plan.test_plans_to_stand import reached

GRAVITY, LENGTH, MASS, TORQUE = 9.81, 0.8, 3.0, 40.0
SWING = planar_chain([LENGTH], [MASS])
UPRIGHT = [(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)]
"""Rotation that turns the plane of the chain upright: its y axis becomes the world's z axis."""
START, END = np.array([0.3, 0.4, 0.8, -0.6, 1.0, 0.2]), np.array([-0.5, 0.6, 1.1, -0.4, 0.8, 0.4])
WALL = HalfSpace((0.0, -1.0, 0.0), (0.0, 0.75, 0.0))
OBSTACLES = (WALL, Box((0.2, 0.2, 0.2), (0.6, 0.1, -0.75)), Sphere(0.05, (0.2, -0.6, 0.3)))


def slow_swing(torque: float = TORQUE) -> Plan:
    """A link through the horizontal, so slowly that its accelerations count for nothing."""
    machine = FixedBase(SWING, rotation=UPRIGHT)
    limits = Limits(torque=torque)
    return plan(machine, Goal(joints=[0.2]), 200.0, start=[-0.2], limits=limits, scene=False)


@cache
def reaching(torque: float = 90.0, clearance: float = 0.005) -> Plan:
    robot = example_robot("six_axis")
    tool = CollisionShape("sphere", (0.03,), translation=(0.0, 0.0, 0.05))
    links = [replace(each, collisions=(tool,)) if each.name == "tool0" else each for each in robot.links]
    limits = Limits(torque=[torque, torque, torque, 28.0, 28.0, 28.0])
    scene = Scene(OBSTACLES, clearance)
    return plan(FixedBase(replace(robot, links=tuple(links))), Goal(joints=END), 2.0, start=START, limits=limits,
                cost=Cost(velocity=1.0), scene=scene)  # fmt: skip


# ---- independent evaluation ------------------------------------------------------------------------------------------


@cache
def loads(result: Plan, payload: float, samples: int) -> tuple[Array, Array]:
    """Joint torques with a payload, shape (M, n), and of a standing machine distances of its point from the edges."""
    machine: Any = result.machine
    request: Any = result.request  # type: ignore[attr-defined]
    setup = None if request is None else request.arguments.get("setup")
    robot = machine.robot
    if payload:
        machine = replace(machine, robot=with_load(robot, robot.tip_link, payload, robot.tip_translation))
    sample = result.sampled(np.linspace(1e-9, result.horizon - 1e-9, samples))
    base, q, v, a = (ca.SX.sym("v", size) for size in (machine.base_size, *[robot.dof] * 3))
    time = ca.SX.sym("time")
    bases = result.at(sample.t)["base"] if machine.base_size else np.zeros((samples, 0))
    inside: Any = ca.SX(0, 1)
    if isinstance(machine, Standing):
        wrenches = wrenches_at(getattr(setup, "wrenches", ()), machine, (), q, time=time)
        torques = machine.joint_torques(q, v, a, wrenches)
        inside = machine.support.margin(center_of_pressure(machine.ground_reaction(q, v, a, wrenches)))
    else:
        torques = joint_torques(machine, (base, q, v, a))
    motion = bases, sample.joints, sample.rates, sample.accelerations, sample.t[:, None]
    first, second = Sampler([base, q, v, a, time], [torques, inside])(*motion)
    return first, second


def violates(
    result: Plan, sizes: dict[str, Any], tolerance: float = np.inf, *, samples: int = 400, torque: Any = None
) -> bool:
    """Whether the motion breaks a limit if the machine and the obstacles are changed themselves, by Newton and Euler.

    Args:
        result: A plan. sizes: Payload, shares of friction (n,), displacements (3,).
        tolerance: Of the tip, m. torque: Limits, if they are not those of the request.
    """
    machine: Any = result.machine
    request: Any = result.request  # type: ignore[attr-defined]
    arguments = {} if request is None else request.arguments
    robot, limits = machine.robot, arguments.get("limits") or Limits()
    sample = result.sampled(np.linspace(1e-9, result.horizon - 1e-9, samples))
    torques, inside = loads(result, float(sizes.get("payload", 0.0)), samples)
    most = limits.bounds(machine).torque if torque is None else np.full(robot.dof, torque)
    most = np.where([name in result.held for name in robot.joint_names], np.inf, most)
    friction = np.where(np.isfinite(most), most, 0.0) * np.asarray(sizes.get("friction", np.zeros(robot.dof)))
    if (np.abs(torques + friction) > most).any() or (inside < 0).any():
        return True
    displaced = {"base position", "obstacle position", "tool offset"} & set(sizes)
    base, tool = (np.asarray(sizes.get(name, np.zeros(3))) for name in ("base position", "tool offset"))
    moved = replace(machine, robot=move_tip(robot, robot.tip_link, robot.tip_translation + robot.tip_rotation @ tool))
    bases = result.at(sample.t)["base"] if machine.base_size else np.zeros((samples, 0))
    if machine.base_size == 7:
        bases = bases + np.concatenate([base, np.zeros(4)])
    elif not machine.base_size:
        moved = replace(moved, translation=machine.translation + base)
    if displaced:
        own = result.at(sample.t)["base"] if machine.base_size else bases
        tips = tip_poses(machine, own, sample.joints), tip_poses(moved, bases, sample.joints)
        if np.linalg.norm((tips[1] - tips[0])[:, :3], axis=1).max() > tolerance * (1 + 1e-9):
            return True
    apart = getattr(arguments.get("setup"), "clearance_constraints", None)
    if apart is None or not displaced or machine.base_size or isinstance(machine, Standing):
        return False
    shifts = sizes.get("obstacle position", np.zeros((len(apart.scene.obstacles), 3)))
    links = [
        replace(each, collisions=tuple(shape.placed(np.eye(3), tool) for shape in each.collisions))
        if each.name == robot.tip_link
        else each
        for each in robot.links
    ]
    obstacles = [each.placed(np.eye(3), by) for each, by in zip(apart.scene.obstacles, shifts, strict=True)]
    moved = replace(moved, robot=replace(moved.robot, links=tuple(links)))
    scene = CollisionScene(moved, obstacles, apart.scene.clearance, classified=apart.scene.classified)
    distances = distances_along(scene, np.zeros(0), sample.joints, sample.t)
    return bool((distances < apart.scene.clearance).any())


def draws(rng: np.random.Generator, sizes: dict[str, float], dof: int, obstacles: int, *, scale: float = 1.0) -> Any:
    """One random draw inside the sizes; half of all are on their boundary."""
    edge = rng.random() < 0.5
    errors: dict[str, Any] = {}
    for name, size in sizes.items():
        most = scale * size * (1.0 if edge else rng.random())
        if name == "payload":
            errors[name] = scale * size * rng.integers(1, 21) / 20  # few values, since each is a machine
        elif name == "friction":
            errors[name] = most * rng.choice([-1.0, 1.0], dof)
        else:
            count = (obstacles, 3) if name == "obstacle position" else (3,)
            step = rng.normal(size=count)
            errors[name] = most * step / np.linalg.norm(step, axis=-1, keepdims=True)
    return errors


# ---- closed forms ----------------------------------------------------------------------------------------------------


def test_payload_of_a_slow_arm_is_torque_over_lever() -> None:
    margin = slow_swing().margin({"payload": None})
    exact = (TORQUE - MASS * GRAVITY * LENGTH / 2) / (GRAVITY * LENGTH)
    assert exact * (1 - 1e-4) < margin["payload"].size <= exact
    assert margin["payload"].limit == "torque of joint1"
    assert margin["payload"].time == pytest.approx(100.0, abs=1.0)
    friction = 1 - MASS * GRAVITY * LENGTH / 2 / TORQUE
    assert friction * (1 - 1e-4) < slow_swing().margin({"friction": 0.1})["friction"].size <= friction
    assert margin.sentence == f"keeps all limits for payloads from 0 to {np.floor(exact * 10) / 10:.2g} kg"


def test_base_and_obstacles_share_the_distance_of_a_wall() -> None:
    """A ball at the end of a link passes a wall at 0.07 m; what is proven is 2 % less."""
    ball = CollisionShape("sphere", (0.05,), translation=(LENGTH, 0.0, 0.0))
    links = (SWING.links[0], replace(SWING.links[1], collisions=(ball,)), *SWING.links[2:])
    machine = FixedBase(replace(SWING, links=links))
    wall = HalfSpace((-1.0, 0.0, 0.0), (LENGTH + 0.05 + 0.09, 0.0, 0.0))
    result = plan(machine, Goal(joints=[0.3]), 2.0, start=[-0.3], scene=Scene([wall], clearance=0.02))
    both = result.margin({"base position": 0.01, "obstacle position": 0.02})
    for name in ("base position", "obstacle position"):
        assert 0.97 * 0.07 < both[name].size <= 0.07
    assert 0.97 * 0.07 < sum(both.together.values()) <= 0.07
    assert both.together["obstacle position"] == pytest.approx(2 * both.together["base position"])
    assert both.factor.size == pytest.approx(both.together["base position"] / 0.01)
    assert both.covers_stated
    assert "distance of" in both.factor.limit
    assert "the tip is then misplaced by as much" in both.sentence
    limited = result.margin({"base position": None, "tool offset": None}, tolerance=0.004)
    assert limited.together == {"base position": pytest.approx(0.002), "tool offset": pytest.approx(0.002)}
    assert limited["base position"].limit == "position of the tip"
    assert not result.margin({"base position": 0.005}, tolerance=0.004).covers_stated


# ---- laws ------------------------------------------------------------------------------------------------------------


def test_a_margin_never_grows_if_a_limit_is_tightened() -> None:
    """The same motion under tighter limits, by the same plan with other numbers."""
    result = reaching()
    margins = []
    for torque, clearance in ((90.0, 0.005), (80.0, 0.005), (80.0, 0.008), (70.0, 0.02)):
        arguments = dict(result.request.arguments)  # type: ignore[attr-defined]
        arguments["limits"] = Limits(torque=[torque, torque, torque, 28.0, 28.0, 28.0])
        setup = arguments["setup"]
        scene = replace(setup.clearance_constraints.scene, clearance=clearance)
        arguments["setup"] = replace(setup, clearance_constraints=replace(setup.clearance_constraints, scene=scene))
        request = replace(result.request, arguments=arguments)  # type: ignore[attr-defined]
        tighter = replace(result, solution=result.solution.with_problem(request.problem()))  # type: ignore[type-var]
        margins.append(tighter.margin())
    for before, after in pairwise(margins):
        for name in before.alone:
            assert after[name].size <= before[name].size * (1 + 1e-9)
    assert margins[-1]["payload"].size < margins[0]["payload"].size
    assert margins[-1]["base position"].size < margins[0]["base position"].size - 0.014


@pytest.mark.parametrize("count", [40, pytest.param(1000, marks=pytest.mark.long)])
def test_random_draws_inside_keep_all_limits(count: int) -> None:
    result, rng = reaching(), np.random.default_rng(40)
    margin = result.margin(tolerance=0.05)
    assert set(margin.alone) == {"payload", "friction", "base position", "obstacle position", "tool offset"}
    for k in range(count):
        sizes = dict(margin.together) if k % 2 else {name: margin[name].size for name in [[*margin.alone][k // 2 % 5]]}
        errors = draws(rng, sizes, result.machine.robot.dof, len(OBSTACLES))
        assert not violates(result, errors, 0.05, samples=100), errors


GALLERY = [file.stem for file in sorted((Path(__file__).parents[4] / "results" / "gallery").glob("*.npz"))]
OTHERS: dict[str, Any] = {"reached": reached, "reached briskly": lambda: reached((-0.12, 0.06)), "slow": slow_swing,
          "fast": lambda: fast_swing(None)}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("name", [*GALLERY, *OTHERS])
def test_random_draws_inside_the_margins_of_many_plans_keep_all_limits(name: str) -> None:
    """Six of the gallery and four others, 1000 draws each; obstacles have a test of their own."""
    file = Path(__file__).parents[4] / "results" / "gallery" / f"{name}.npz"
    result = OTHERS[name]() if name in OTHERS else Plan.load(file)
    margin, rng = result.margin(tolerance=0.003), np.random.default_rng(11)
    for k in range(1000):
        alone = [*margin.alone][k // 2 % len(margin.alone)]
        sizes = dict(margin.together) if k % 2 else {alone: margin[alone].size}
        errors = draws(rng, sizes, result.machine.robot.dof, 0)
        errors.pop("obstacle position", None)
        assert not violates(result, errors, 0.003, samples=300), errors


@pytest.mark.parametrize("name", ["payload", "friction", pytest.param("base position", marks=pytest.mark.long)])
def test_margins_cover_most_of_the_true_range(name: str) -> None:
    """What is true is found by bisection over the worst of directions: towards each obstacle and both signs."""
    result = reaching()
    margin = result.margin(dict.fromkeys(("payload", "friction", "base position")))
    directions = np.vstack([np.eye(3), -np.eye(3), np.random.default_rng(1).normal(size=(6, 3))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    worst: dict[str, list[Any]] = {
        "payload": [1.0],
        "friction": [np.ones(6), -np.ones(6)],
        "base position": [*directions],
    }
    low, high = 0.0, 4 * margin[name].size
    for _ in range(7):
        middle = (low + high) / 2
        broken = any(violates(result, {name: middle * np.asarray(way)}, samples=150) for way in worst[name])
        low, high = (low, middle) if broken else (middle, high)
    assert 0.8 * low <= margin[name].size <= high * (1 + 1e-9)


def test_standing_machine_tips_over_beyond_the_payload() -> None:
    result = reached((-0.12, 0.06))
    machine = result.machine
    assert isinstance(machine, Standing)
    margin = result.margin({"payload": None})
    size = margin["payload"].size
    assert margin["payload"].limit == "zero moment point"
    sample = result.sampled(np.linspace(1e-9, result.horizon - 1e-9, 600))

    def inside(payload: float) -> bool:
        robot = machine.robot
        loaded = replace(machine, robot=with_load(robot, robot.tip_link, payload, robot.tip_translation))
        q, v, a = (ca.SX.sym("q", robot.dof) for _ in range(3))
        point = center_of_pressure(loaded.ground_reaction(q, v, a))
        values: Array = Sampler([q, v, a], [machine.support.margin(point)])(
            sample.joints, sample.rates, sample.accelerations
        )[0]
        return bool((values >= 0).all())

    assert inside(size)
    assert not inside(size / 0.98)


# ---- robust plans ----------------------------------------------------------------------------------------------------


def fast_swing(robust: Any) -> Plan:
    limits = Limits(torque=TORQUE, robust=robust)
    machine = FixedBase(SWING, rotation=UPRIGHT)
    return plan(machine, Goal(joints=[1.2]), 2.0, start=[0.0], limits=limits, scene=False, cost=Cost(velocity=1.0))


def test_a_robust_plan_that_is_not_found_fails_with_the_error_of_its_planner(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> Plan:
        raise DeadEnd("the arm is stuck", name="slider", time=0.4)

    monkeypatch.setattr(dispatch, "_plan", refuse)
    with pytest.raises(DeadEnd, match=r"no motion covers payload 1: .*the arm is stuck") as caught:
        fast_swing({"payload": 1.0})
    assert (caught.value.name, caught.value.time) == ("slider", 0.4)


def test_robust_plans_cover_payload_and_friction_at_a_higher_cost(tmp_path: Path) -> None:
    sizes = {"payload": (0, 2.0), "friction": 0.05}
    plain, robust = fast_swing(None), fast_swing(sizes)
    assert not plain.margin(sizes).covers_stated
    assert robust.margin(sizes).covers_stated
    assert robust.audit().feasible
    assert plain.cost < robust.cost < 1.1 * plain.cost
    rng = np.random.default_rng(3)
    for _ in range(30):
        errors = draws(rng, {"payload": 2.0, "friction": 0.05}, 1, 0)
        assert not violates(robust, {name: value * 0.999 for name, value in errors.items()}, torque=TORQUE), errors
    robust.save(tmp_path / "robust.npz")
    again = Plan.load(tmp_path / "robust.npz")
    assert again.audit().feasible
    assert again.margin(sizes).factor.size == pytest.approx(robust.margin(sizes).factor.size, rel=1e-6)
    with pytest.raises(SolveError, match=r"no motion covers payload|no motion keeps all limits"):
        fast_swing({"payload": 20.0})


def test_robust_plans_keep_away_from_obstacles_that_may_be_misplaced() -> None:
    """A ball beside the way: the robust plan makes a detour that leaves room for the misplacements of the real ball."""
    ball = CollisionShape("sphere", (0.05,), translation=(0.3, 0.0, 0.0))
    chain = planar_chain([0.3, 0.3], [1.0, 1.0])
    links = tuple(replace(each, collisions=(ball,)) if each.name == "link2" else each for each in chain.links)
    machine = FixedBase(replace(chain, links=links))
    post = Sphere(0.05, (0.71, 0.0, 0.0))
    goal, start, sizes = Goal(joints=[0.9, 0.0]), [-0.9, 0.0], {"base position": 0.01, "obstacle position": 0.005}
    plain = plan(machine, goal, 2.0, start=start, scene=Scene(post))
    robust = plan(machine, goal, 2.0, start=start, scene=Scene(post), limits=Limits(robust=sizes))
    assert not plain.margin(sizes).covers_stated
    margin = robust.margin(sizes)
    assert margin.covers_stated
    assert margin.factor.size < 1.5
    assert plain.cost < robust.cost < 1.5 * plain.cost
    sample = robust.sample(0.005)
    distances = distances_along(CollisionScene(machine, [post]), np.zeros(0), sample.joints, sample.t)
    assert distances.min() >= 0.015 - 1e-6


def test_only_plan_takes_robust_limits() -> None:
    limits = Limits(robust={"payload": 1.0})
    with pytest.raises(ProblemError, match="taken by plan alone"):
        plan_problem(FixedBase(SWING), Goal(joints=[0.2]), 1.0, start=[0.0], limits=limits)
    with pytest.raises(ProblemError, match=r"Scene\(clearance=...\)"):
        plan(FixedBase(SWING), Waypoints(np.zeros((2, 3)), np.eye(4)[:2]), limits=limits)
    with pytest.raises(ProblemError, match="did you mean 'payload'"):
        plan(FixedBase(SWING), Goal(joints=[0.2]), 1.0, start=[0.0], limits=Limits(robust={"payloads": 1.0}))


# ---- kinds of plans, files and bad input -----------------------------------------------------------------------------


def test_margin_of_a_file_is_that_of_the_plan(tmp_path: Path) -> None:
    result = reaching()
    result.save(tmp_path / "plan.npz")
    again, margin = Plan.load(tmp_path / "plan.npz").margin(), result.margin()
    assert isinstance(margin, Margin)
    for name in margin.alone:
        assert again[name].size == pytest.approx(margin[name].size, rel=1e-6)
    assert again.sentence == margin.sentence


def test_consecutive_motions_have_the_least_of_their_margins() -> None:
    machine = FixedBase(SWING, rotation=UPRIGHT)
    goals = [Goal(joints=[0.2], duration=50.0), Goal(joints=[1.2], duration=50.0)]
    result = plan(machine, goals, start=[-0.2], limits=Limits(torque=TORQUE), scene=False)
    size = result.margin({"payload": None})["payload"].size
    assert isinstance(result, SequencePlan)
    own = [piece.plan.margin({"payload": None})["payload"] for piece in result.pieces]
    assert size == min(each.size for each in own)
    assert result.margin()["payload"].limit == "goal 2: torque of joint1"  # it speeds up more
    assert result.margin()["payload"].time == pytest.approx(50.0 + own[1].time)


def test_paths_through_waypoints_have_margins_of_distance() -> None:
    machine = FixedBase(example_robot("six_axis"))
    poses = [machine.tip_pose((), START + s * (END - START) / 20) for s in range(3)]
    positions = np.array([np.array(ca.DM(pose.position)).ravel() for pose in poses])
    quaternions = quaternion_from_rotation(np.array([np.array(ca.DM(pose.rotation)) for pose in poses]))
    result = plan(machine, Waypoints(positions, quaternions), scene=Scene([WALL]))
    margin = result.margin()
    assert set(margin.alone) == {"base position", "obstacle position"}
    least = result.audit().clearances["clearance"]
    assert margin["base position"].size <= min(pair.distance for pair in least.pairs if "obstacle 0" in pair.bodies)
    with pytest.raises(ProblemError, match=r"depends on the payload; the motion has no torque limits"):
        result.margin({"payload": 1.0})


def test_bad_uncertainties_are_refused_with_advice() -> None:
    result = slow_swing()
    for uncertainty, words in (
        ({"payloads": 1.0}, "did you mean 'payload'"),
        ({"payload": -1.0}, "positive and finite"),
        ({"payload": (0.5, 1.0)}, r"with_load"),
        ({"payload": "heavy"}, "positive and finite"),
        ({"base position": 0.01}, r"Scene\(obstacles=...\), or give the allowed deviation"),
        (3.0, "dictionary by name"),
    ):
        with pytest.raises(ProblemError, match=words):
            result.margin(uncertainty)  # type: ignore[arg-type]
    with pytest.raises(ProblemError, match="tolerance"):
        result.margin({"payload": 1.0}, tolerance=-1.0)
    weak = plan(FixedBase(SWING), Goal(joints=[0.2]), 1.0, start=[0.0], scene=False)
    with pytest.raises(ProblemError, match=r"Limits\(torque=...\)"):
        weak.margin({"payload": 1.0})
    assert weak.margin().sentence == "has no limits that payload, friction or misplacements can violate"


def test_command_tells_whether_a_plan_covers_sizes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "plan.npz"
    slow_swing().save(file)
    assert main(["margin", str(file), "--size", "payload=3"]) == 0
    assert "keeps all limits for payloads from 0 to 3.5 kg" in capsys.readouterr().out
    assert main(["margin", str(file), "--size", "payload=4", "--size", "tool-offset=0.001", "--tolerance", "0.01"]) == 1
    assert "does not cover payloads from 0 to 4 kg and a tool misplaced by up to 1 mm" in capsys.readouterr().out
    assert main(["margin", str(file), "--size", "base-position=0.001"]) == 2
    assert "--tolerance" in capsys.readouterr().err
