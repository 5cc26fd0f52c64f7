"""Steps: the feet stay where they are held, bear what they can, and the machine stands in the contact simulation."""

from __future__ import annotations

import re
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import Foot, Foothold, Joint, Link, Robot, Stance, rectangle
from ocp import Collocation, Limits, ProblemError, Solution, SolveError, solve
from ocp.console import time_limited
from ocp.motion.builders.dynamics_plan import SolveSettings
from ocp.motion.builders.standing.plan import guess_in_time, solve_steps
from ocp.motion.builders.standing.stances import StancePhase, Steps, standing_configuration, walk
from ocp.motion.builders.standing.steps import (
    StepsMotion,
    StepWeights,
    motion_of,
    resolve_steps,
    sample_stance,
    steps_motion,
    steps_problem,
)
from ocp.problem.formulation import Formulation
from scripts.robots.steps import SIDES, crouched, planar_biped, planar_feet, planar_steps
from scripts.robots.talos import talos_steps
from tests.models.robot.trees import numeric, numeric_poses
from tests.ocp.motion.builders.bipeds import FRICTION, mirrored, resized
from tests.ocp.motion.builders.steps_replay import replay
from tests.ocp.problem.test_phases import failed, moved

pytestmark = pytest.mark.xdist_group("steps")  # one process, so that the step is planned once

MARGIN = 0.01
FIRM = 0.03  # m: with this much TALOS stands still on the corner of a sole, see below; a walk in balance stays there
GROUND: dict[str, Any] = {"limits": Limits(friction=FRICTION)}


def planned(steps: Steps, method: Collocation | None = None, **request: Any) -> tuple[Solution, StepsMotion]:
    steps = with_margin(steps, **request)
    plan = solve_steps(steps, start=crouched(steps), settings=SolveSettings(method), **GROUND)
    return plan, steps_motion(steps, plan)


def with_margin(steps: Steps, **request: Any) -> Steps:
    """The same steps, the centers of pressure a margin inside the edges."""
    return replace(steps, **{"margin": MARGIN, **request})


def assert_stands(motion: StepsMotion, planar: bool, slip: float = 3e-3, lean: float = 0.03) -> None:
    """In the contact simulation it does not fall, feet that are held stay flat and where they are."""
    result = replay(motion, FRICTION, planar)
    assert not result.fell
    assert result.lean.max() < lean
    assert result.slip < slip
    assert result.lifted < slip + 2e-3


def assert_feet_hold(steps: Steps, motion: StepsMotion, margin: float = MARGIN) -> None:
    """Held soles stay on their footholds, press, do not slip, their center of pressure inside; others are clear."""
    for name, foot in steps.feet.items():
        assert foot.sole is not None
        held = motion.held(name)
        for k, phase in enumerate(steps.phases):
            inside = motion.phase == k
            if name in phase.footholds:
                gap = motion.sole_position[name][inside] - np.asarray(phase.footholds[name].position)
                assert np.abs(gap).max() < 1e-5
        assert motion.loads[name][held, 5].min() > -1e-3 * steps.stances[0].weight
        assert np.nanmax(motion.friction(name)) < FRICTION * 1.01
        share = motion.loads[name][held, 5] / steps.stances[0].weight
        points = motion.center_of_pressure(name)[held]
        distances = (points @ foot.sole.normals.T - (foot.sole.normals * foot.sole.vertices).sum(axis=1)).min(axis=1)
        assert ((distances - margin) * share).min() > -1e-3
        assert motion.sole_position[name][:, 2].min() > -5e-4
    assert motion.margin.min() > margin - 1e-3


@pytest.fixture(scope="module")
def step() -> tuple[Steps, Solution, StepsMotion]:
    """One dynamic step of the planar biped."""
    steps = planar_steps(1, 0.6, 0.7)
    return steps, *planned(steps, method=Collocation(8, degree=3, scheme="legendre"))


def test_a_dynamic_step_holds_between_the_nodes_and_stands(step: tuple[Steps, Solution, StepsMotion]) -> None:
    steps, plan, motion = step
    audit = plan.audit()
    assert audit.feasible, str(audit)
    assert_feet_hold(steps, motion)
    assert motion.summary()["peak_joint_torque"] <= 200.0
    assert_stands(motion, planar=True)


def test_joints_torques_and_bodies_are_those_of_the_robot(step: tuple[Steps, Solution, StepsMotion]) -> None:
    """Joints and rates go on through the phases, and the root link carries the feet where the plan has them."""
    steps, _, motion = step
    joins = np.flatnonzero(np.diff(motion.phase))
    assert len(joins) == 2
    for part in (motion.joints, motion.joint_velocities, motion.root_position, motion.center_of_mass):
        np.testing.assert_allclose(part[joins], part[joins + 1], rtol=0, atol=1e-8)
    for k in np.linspace(0, len(motion.t) - 1, 7).astype(int):
        poses = numeric_poses(steps.robot, motion.joints[k], (motion.root_rotation[k], motion.root_position[k]))
        for name, foot in steps.feet.items():
            turn, position = poses[foot.link]
            np.testing.assert_allclose(position + turn @ foot.translation, motion.sole_position[name][k], atol=1e-9)
    total = motion.loads["left"] + motion.loads["right"]
    first = motion.phase == 0
    push = np.gradient(np.gradient(motion.center_of_mass[first, 2], motion.t[first]), motion.t[first])
    np.testing.assert_allclose(total[first, 5][5:-5], steps.robot.total_mass * (9.81 + push[5:-5]), rtol=2e-2)


def test_planted_faults_of_steps_are_detected(step: tuple[Steps, Solution, StepsMotion]) -> None:
    _, plan, _ = step
    first, second, third = plan.phases
    loose, stricter = copy(plan.problem), copy(plan.problem)
    del loose.declared.path[f"{third}.feet"]
    slipped = failed(solve(loose, Collocation(3, degree=3, scheme="legendre")).audit(plan.problem))
    assert {f"{third}.feet", f"{third}.feet position"} <= slipped
    gap = failed(moved(plan, f"{second}.joints", lambda x, s: x + 0.01 * (1 - s)).audit())
    assert f"{first} to {second}: joints" in gap
    tipping, slipping = f"{second}.left center of pressure", f"{second}.left friction"
    for name, room in ((tipping, 0.04), (slipping, FRICTION**2)):
        stricter.path(name, stricter.declared.path.pop(name).expression, lower=room)
    outside = failed(plan.audit(stricter))
    assert {tipping, slipping} <= outside


@pytest.mark.long
def test_a_step_of_the_other_foot_is_the_mirrored_step() -> None:
    """Other links are roots, other joints come first: the same costs, and the same motion by the other legs."""
    coarse = Collocation(4, degree=3, scheme="legendre")
    plans = []
    for steps in (planar_steps(1, 0.8, 0.8), mirrored(planar_steps(1, 0.8, 0.8))):
        plan = solve(steps_problem(with_margin(steps), start=crouched(steps), **GROUND), coarse)
        plans.append((plan.cost, steps_motion(steps, plan, 11)))
    (cost, right), (again, left) = plans
    assert again == pytest.approx(cost, rel=1e-7)
    np.testing.assert_allclose(left.joints[:, [3, 4, 5, 0, 1, 2]], right.joints, rtol=0, atol=1e-6)
    np.testing.assert_allclose(left.loads["left"], right.loads["right"], rtol=0, atol=1e-3)


@pytest.mark.long
def test_a_machine_of_another_size_takes_the_same_steps_at_the_same_cost() -> None:
    """Lengths times s, masses s^3, torques s^4, times sqrt(s): all that is asked scales, and so does the motion."""
    steps, coarse = planar_steps(1, 0.6, 0.7), Collocation(4, degree=3, scheme="legendre")
    start, plans = crouched(steps), []
    for size in (1.0, 3.0):
        unit = np.sqrt(size)
        weights = StepWeights(acceleration=0.01 * unit**3, velocity=0.01 * unit, joint_limits=1 / unit, load=0.0)
        request = {**GROUND, "cost": weights}
        larger = with_margin(resized(steps, size), margin=MARGIN * size, clearance=0.02 * size)
        plans.append(solve(steps_problem(larger, start=start, **request), coarse))
    one, large = plans
    assert large.cost == pytest.approx(one.cost, rel=1e-7)
    for name in ("1 left + right.joints", "2 left.joints", "3 left + right.joints"):
        np.testing.assert_allclose(large[name], one[name], rtol=0, atol=1e-5)


def docking_arm() -> tuple[Robot, dict[str, Foot]]:
    """Four joints in the plane y = 0 on a loose base; its hand is a grip."""
    links = [Link("base", 10.0, (0.0, 0.0, 0.05), 0.1 * np.eye(3))]
    joints = []
    for k in range(4):
        links.append(Link(f"link{k}", 3.0, (0.0, 0.0, 0.15), np.diag([0.025, 0.025, 0.002])))
        limits: dict[str, Any] = {"lower": -2.5, "upper": 2.5, "velocity": 3.0, "effort": 100.0}
        place = (0.0, 0.0, 0.1 if k == 0 else 0.3)
        joints.append(Joint(f"joint{k}", "revolute", links[-2].name, f"link{k}", place, axis=(0, 1, 0), **limits))
    feet = {"base": Foot("base", rectangle((-0.15, 0.15), (-0.1, 0.1))), "hand": Foot("link3", None, (0.0, 0.0, 0.3))}
    return Robot(tuple(links), tuple(joints), tip="link3"), feet


@pytest.mark.long
def test_an_arm_docks_and_then_holds_on_by_its_hand() -> None:
    """It reaches out on its base, docks at a wall, and leans further than its base alone would bear."""
    robot, feet = docking_arm()
    start = np.array([-0.3, 0.9, 0.6, 0.3])
    stance = Stance.on(robot, feet, {"base": Foothold.level(0, 0)})
    target = stance.sole_frame("hand", np.array([0.35, 0.9, 0.2, 0.1]))
    dock = Foothold(numeric(target.position).ravel(), numeric(target.rotation))
    base = Foothold.level(0.0, 0.0)
    phases = [StancePhase({"base": base}, 1.5), StancePhase({"base": base, "hand": dock}, 1.0)]
    steps = Steps(robot, feet, phases, margin=0.01)
    mesh = Collocation(10, degree=3, scheme="legendre")
    plan = solve_steps(steps, start=start, settings=SolveSettings(mesh), limits=Limits(friction=FRICTION))
    motion = steps_motion(steps, plan)
    assert plan.audit().feasible
    docked = motion.phase == 1
    assert np.abs(motion.sole_position["hand"][docked] - np.asarray(dock.position)).max() < 1e-6
    assert np.isnan(motion.margin[docked]).all()
    assert np.abs(motion.loads["hand"][docked]).max() > 1.0
    assert not motion.loads["hand"][~docked].any()


# ---- by the pseudo-inverse -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", ["planar", pytest.param("talos", marks=pytest.mark.long)])
def test_the_pseudo_inverse_keeps_the_feet_on_their_paths_and_falls(robot: str) -> None:
    """The zero moment point leaves the soles, and the contact simulation falls soon after it did."""
    steps = planar_steps(2, 0.5, 0.6) if robot == "planar" else talos_steps(2, 0.8, 0.8)
    clearance = 0.03
    motion = resolve_steps(replace(steps, clearance=clearance), start=crouched(steps))
    for name in steps.feet:
        for k, phase in enumerate(steps.phases):
            if name in phase.footholds:
                gap = motion.sole_position[name][motion.phase == k] - np.asarray(phase.footholds[name].position)
                assert np.abs(gap).max() < 1e-7
        assert motion.sole_position[name][:, 2].max() == pytest.approx(clearance, abs=1e-7)
    assert motion.margin.min() < -0.1
    out = motion.t[np.flatnonzero(motion.margin < 0)[0]]
    result = replay(motion, FRICTION, planar=robot == "planar")
    assert result.fell
    assert out < result.t[-1] < out + 2.0


def test_the_walk_of_the_pseudo_inverse_has_the_least_rates_and_loads() -> None:
    """Of all rates that move the foot as it goes, and of all loads that sum up to what the motion takes."""
    steps = planar_steps(1, 0.5, 0.6)
    motion = resolve_steps(steps, start=crouched(steps))
    stance, inside = steps.stances[1], motion.phase == 1
    order = steps.order(stance)
    for q, rates in zip(motion.joints[inside][::25, order], motion.joint_velocities[inside][::25, order], strict=True):
        symbol = ca.SX.sym("q", len(q))
        place = stance.sole_frame("right", symbol)
        pitch = ca.atan2(place.rotation[0, 2], place.rotation[2, 2])
        rows = ca.vertcat(place.position[0], place.position[2], pitch)
        jacobian = numeric(ca.Function("J", [symbol], [ca.jacobian(rows, symbol)])(q))
        np.testing.assert_allclose(np.linalg.pinv(jacobian) @ (jacobian @ rates), rates, atol=1e-8)
    assert not motion.joint_velocities[motion.phase == 0].any()
    still = motion.loads["left"][0] + motion.loads["right"][0]
    assert still[5] == pytest.approx(steps.stances[0].weight)
    np.testing.assert_allclose(motion.loads["left"][0], motion.loads["right"][0], atol=1e-9)  # side by side
    chain = (motion.joints, motion.joint_velocities, motion.joint_accelerations)
    for value, slope in pairwise(part[inside] for part in chain):
        np.testing.assert_allclose(np.trapezoid(slope, motion.t[inside], axis=0), value[-1] - value[0], atol=2e-3)


def test_the_pseudo_inverse_says_in_which_phase_a_leg_is_stretched() -> None:
    steps = planar_steps(1, 0.5, 0.6, length=2.0)
    with pytest.raises(SolveError, match="'2 left': the pseudo-inverse breaks down at"):
        resolve_steps(steps, start=crouched(steps))


@pytest.mark.parametrize("height", [0.05, 0.0, -0.05])
def test_a_sole_may_rest_where_it_lifts_and_lands_on_other_ground(height: float) -> None:
    """What it has to clear does not move while the sole is still, or already, at rest; and is below it in between."""
    feet = {side: Foothold.level(0, 0) for side in SIDES}
    phases = walk(feet, [("right", Foothold.level(0.2, 0, height=height))], shift=0.5, swing=0.8)
    steps = Steps(planar_biped(), planar_feet(), phases)
    form = Formulation.of(steps_problem(steps, start=crouched(steps)))
    lands = standing_configuration(steps.standing(2), crouched(steps)[steps.order(steps.stances[1])])
    states, controls = np.zeros((3, form.nx)), np.zeros((3, form.nu))
    states[:, form.states["2 left.joints"]] = crouched(steps)[steps.order(steps.stances[1])]
    states[2, form.states["2 left.joints"]] = lands
    share = np.array([0.02, 0.5, 0.98])
    rows = form.sampled([form.path.expression], states, controls, share, 1.0, form.parameter_vector({}))[0]
    room = rows[:, form.path.of("2 left.right clearance")]
    assert room[[0, 2]].min() > 0
    assert room[1].min() == pytest.approx(-0.02 - max(height, 0.0), abs=1e-9)


def on_the_corner_of_a_sole(steps: Steps, margin: float, seconds: float) -> StepsMotion:
    """Nothing moves: the first foot is held, the center of mass this far inside its rear and right edges."""
    stance = steps.stances[1]
    assert stance.support is not None
    over = np.asarray(stance.support.vertices).min(axis=0) + margin
    configuration = standing_configuration(stance, crouched(steps)[steps.order(stance)], over)[None].repeat(2, axis=0)
    still = np.zeros_like(configuration)
    one = Steps(steps.robot, steps.feet, [StancePhase(steps.phases[1].footholds, seconds)])
    motion = (configuration, still, still)
    return motion_of(one, [sample_stance(one, 0, np.array([0.0, seconds]), motion, foot_loads={})])


@pytest.mark.long
def test_soft_ground_reduces_the_margin_at_the_corner_of_a_sole() -> None:
    """It is as good as rigid to the plan; in the simulation it sinks by a millimeter, and joints on servos give too."""
    steps = talos_steps(1, 1.0, 1.0)
    least = on_the_corner_of_a_sole(steps, MARGIN, 2.5)
    assert least.balance.min() == pytest.approx(MARGIN, abs=1e-3)
    assert replay(least, FRICTION).fell
    assert_stands(on_the_corner_of_a_sole(steps, FIRM, 2.5), planar=False)


# ---- what is refused -------------------------------------------------------------------------------------------------


def test_steps_that_cannot_be_are_refused_by_name(step: tuple[Steps, Solution, StepsMotion]) -> None:
    steps, plan, _ = step
    start = crouched(steps)
    robot, feet = planar_biped(), planar_feet()
    here, there = Foothold.level(0, 0), Foothold.level(0.2, 0)
    refusals: list[tuple[Callable[[], Any], str]] = [
        (lambda: steps_problem(steps, start=start + 0.1 * np.eye(6)[3]), "away from its foothold"),
        (
            lambda: steps_problem(planar_steps(1, 0.5, 0.6, length=3.0), start=start),
            "no configuration within the joint limits",
        ),
        (lambda: steps_problem(replace(steps, margin=0.2), start=start), "center of mass is .* outside the support"),
        (lambda: steps_problem(steps, start=start, limits=Limits(jerk=1.0)), "have no limit of jerk"),
        (lambda: Steps(robot, feet, []), "no phases"),
        (lambda: Steps(robot, feet, [StancePhase({"lefd": here}, 1.0)]), "lefd"),
        (
            lambda: Steps(robot, feet, [StancePhase({"left": here}, 1.0), StancePhase({"right": here}, 1.0)]),
            "the machine would leap",
        ),
        (
            lambda: Steps(robot, feet, [StancePhase({"left": here}, 1.0), StancePhase({"left": there}, 1.0)]),
            "but its foothold moves",
        ),
        (lambda: walk({"left": here}, [("right", there)], shift=1.0, swing=1.0), "right"),
        (lambda: steps_motion(planar_steps(2, 0.5, 0.6), plan), "the plan has the phases"),
    ]
    for call, words in refusals:
        with pytest.raises(ProblemError, match=words):
            call()


@pytest.mark.long
def test_a_step_that_is_too_fast_is_refused_with_the_time_that_it_takes() -> None:
    """Given that time, it can be taken."""
    fast = planar_steps(1, 0.05, 0.06)
    with pytest.raises(SolveError, match="too fast") as refusal:
        solve_steps(with_margin(fast), start=crouched(fast), **GROUND)
    error = refusal.value
    assert (error.name, error.limit) == ("2 left", 0.06)
    assert re.search(
        r"phase '2 left': 0\.\d+ s, 0\.06 s are requested; at their limits .*(torques|velocities)", str(error)
    )
    assert error.value > 1.3 * 0.06
    assert guess_in_time(with_margin(planar_steps(1, 0.05, 1.05 * error.value)), crouched(fast), GROUND, {}) is not None


@pytest.mark.long
def test_infeasible_steps_are_refused_with_the_constraint_to_relax() -> None:
    steps = planar_steps(1, 0.5, 0.6)
    joints = tuple(replace(joint, effort=3.0) for joint in steps.robot.joints)
    weak = replace(steps, robot=replace(steps.robot, joints=joints))
    settings = SolveSettings(options={"max_iter": 100})
    with pytest.raises(SolveError, match="no steps were found in any durations") as refusal:
        solve_steps(with_margin(weak), start=crouched(weak), settings=settings, **GROUND)
    error = refusal.value
    assert error.conflicts
    assert error.conflicts[0].label == error.name
    assert error.value > 0


@pytest.mark.long
def test_steps_of_talos_that_are_too_fast_are_refused() -> None:
    fast = talos_steps(2, 0.05, 0.08)
    with pytest.raises(SolveError, match="too fast") as refusal:
        solve_steps(with_margin(fast, clearance=0.04), start=crouched(fast), **GROUND)
    assert refusal.value.name == "4 right"


@pytest.mark.long
def test_steps_near_the_quickest_are_planned_in_the_time_that_they_may_have() -> None:
    """From the guess of a plan slower than they are, no plan is found within 300 iterations."""
    steps = planar_steps(2, 0.1, 0.2)
    coarse = Collocation(12, degree=3, scheme="legendre")
    problem = steps_problem(with_margin(steps), start=crouched(steps), **GROUND)
    guess = guess_in_time(with_margin(steps), crouched(steps), GROUND, {})
    assert solve(problem, coarse, guess=guess, options={"max_iter": 300}, check=False).success
    with time_limited(2.0), pytest.raises(SolveError, match="12 intervals"):
        solve_steps(with_margin(steps), start=crouched(steps), **GROUND)


# ---- two steps -------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(("balance", "shift", "swing"), [("dynamic", 0.5, 0.6), ("static", 1.5, 1.5)])
def test_two_steps_of_the_planar_biped_stand(balance: str, shift: float, swing: float) -> None:
    steps = planar_steps(2, shift, swing)
    plan, motion = planned(steps, balance=balance)
    assert plan.audit().feasible
    assert_feet_hold(steps, motion)
    assert (motion.balance.min() > MARGIN - 1e-3) == (balance == "static")
    assert_stands(motion, planar=True)


@pytest.mark.long
@pytest.mark.parametrize(
    ("balance", "shift", "swing", "margin"), [("dynamic", 0.8, 0.8, MARGIN), ("static", 2.0, 2.0, FIRM)]
)
def test_two_steps_of_talos_stand(balance: str, shift: float, swing: float, margin: float) -> None:
    steps = talos_steps(2, shift, swing)
    plan, motion = planned(steps, balance=balance, margin=margin, clearance=0.04)
    assert plan.audit().feasible
    assert_feet_hold(steps, motion, margin)
    assert (motion.balance.min() > margin - 1e-3) == (balance == "static")
    assert_stands(motion, planar=False)
