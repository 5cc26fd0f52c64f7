"""Standing plans of robots that nobody here described: TIAGo on its wheels, ANYmal with an arm on its four feet.

Footprint, inertias and limits from their URDF; what the ground and the joints bear checked by Pinocchio, which reads
the same files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio
import pytest

from models import ModelWarning, Robot, Standing, Wrench, rectangle, simplify, standing_example, with_load
from models.machines.standing import StandingMotion
from ocp import AccelerationOptions, Collocation, ProblemError, Solution, resolve_accelerations, solve
from ocp.motion.builders.standing.problem import standing_problem
from ocp.motion.tasks.equations import task_errors
from ocp.motion.tasks.limits import Anywhere, Limits, Pinned
from scripts.robots import pushing
from scripts.robots import standing as gallery
from tests.models.robot.pinocchio_robots import Peer, State
from tests.models.robot.trees import Array, numeric
from tests.ocp.motion.builders.standing_tasks import moved_task, sampled, tip_error

pytestmark = [pytest.mark.xdist_group("standing robots"), pytest.mark.long]

ROWS = (3, 4, 5)
RELATIVE = 1e-9


@dataclass(frozen=True)
class Peered:
    """A motion of a robot with most joints locked, for Pinocchio to judge.

    Attributes:
        file: The URDF. machine: The robot that moves. held: Positions of the joints that do not, by name; 0 if not
            named.
        load: kg, at the tip.
    """

    file: Path
    machine: Standing
    held: Mapping[str, float]
    load: float

    def needed(self, motion: StandingMotion, k: int, wrench: Wrench) -> tuple[Array, Array]:
        """(torques, reaction of the ground about the world's origin), by Pinocchio. Shapes (n,) and (6,)."""
        robot = self.machine.robot
        whole = Robot.from_urdf(self.file, tip=robot.tip, inertia="as_given")
        peer = Peer.of(self.file, whole)
        tip = peer.model.frames[peer.model.getFrameId(robot.tip_link)]
        point = pinocchio.Inertia(self.load, np.zeros(3), np.zeros((3, 3)))
        peer.model.appendBodyToJoint(tip.parentJoint, point, tip.placement)
        full = []
        for values, rest in (
            (motion.joints[k], self.held),
            (motion.joint_velocities[k], {}),
            (motion.joint_accelerations[k], {}),
        ):
            options = {**rest, **dict(zip(robot.joint_names, values, strict=True))}
            full.append(np.array([options.get(name, 0.0) for name in whole.joint_names]))
        zero, turn = np.zeros(6), np.asarray(self.machine.rotation)
        state = State(turn, np.asarray(self.machine.translation), full[0], zero, full[1], zero, full[2])
        q = peer.configuration(state)
        data = peer.model.createData()
        pinocchio.framesForwardKinematics(peer.model, data, q)
        place = data.oMi[tip.parentJoint]
        hand = (place * tip.placement).translation
        force = numeric(wrench.force).ravel()
        outside = [pinocchio.Force.Zero() for _ in range(peer.model.njoints)]
        outside[tip.parentJoint] = place.actInv(pinocchio.Force(force, np.cross(hand, force)))
        result = pinocchio.rnea(peer.model, data, q, peer.velocity(state), peer.acceleration(state), outside)
        names = [whole.joint_names.index(name) for name in robot.joint_names]
        push, moment = turn @ result[:3], turn @ result[3:6]
        return result[peer.columns][names], np.concatenate([moment + np.cross(self.machine.translation, push), push])


def assert_pinocchio_agrees(peered: Peered, motion: StandingMotion, wrenches: Any) -> None:
    for k in np.linspace(0, len(motion.t) - 1, 7).astype(int):
        (wrench,) = wrenches(ca.DM(motion.t[k]), ca.DM(motion.tip_in_world[k]))
        torques, reaction = peered.needed(motion, k, wrench)
        scale = np.abs(torques).max()
        np.testing.assert_allclose(motion.joint_torques[k], torques, rtol=0, atol=RELATIVE * scale)
        np.testing.assert_allclose(motion.ground_force[k, 2], reaction[5], rtol=RELATIVE)
        place = np.array([-reaction[1], reaction[0]]) / reaction[5]
        np.testing.assert_allclose(motion.zero_moment_point[k], place, rtol=0, atol=RELATIVE)


def assert_in_limits(robot: Robot, motion: StandingMotion) -> None:
    """Within what the URDF says, everywhere."""
    assert motion.joint_excess.max() <= 0
    assert (np.abs(motion.joint_velocities) <= robot.velocity).all()
    assert (np.abs(motion.joint_torques) <= robot.effort).all()


@pytest.fixture(scope="module")
def tiago() -> gallery.Results:
    return gallery.plan()


@pytest.fixture(scope="module")
def anymal() -> Peered:
    machine, _ = pushing.anymal()
    return Peered(pushing.ANYMAL.path, machine, pushing.LEGS, pushing.LOAD)


@pytest.fixture(scope="module")
def anymal_solution(anymal: Peered) -> Solution:
    return solve(pushing.problem(anymal.machine), pushing.METHOD)


def test_tiago_stands_where_instantaneous_resolution_tips_it(tiago: gallery.Results) -> None:
    assert not tiago.local.stands
    assert tiago.local.foot_margin.min() < -0.003
    motion = tiago.motion
    assert motion.stands
    assert motion.foot_margin.min() > gallery.MARGIN - 1e-3
    assert motion.friction.max() <= 0.6
    assert_in_limits(tiago.robot, motion)
    assert tip_error(tiago.machine, motion, gallery.from_rest(gallery.circle(tiago.machine))) < 1e-5
    np.testing.assert_allclose(np.linalg.norm(motion.external_force, axis=1), gallery.PULL, rtol=1e-12)
    audit = tiago.solution.audit(tolerances=gallery.TOLERANCES)
    assert audit.passed, str(audit)


def test_pinning_the_zero_moment_point_where_it_starts_makes_tiago_lift_off(tiago: gallery.Results) -> None:
    place = tiago.local.zero_moment_point[0]
    task = gallery.from_rest(gallery.circle(tiago.machine))
    settings: dict[str, Any] = {"law": "augmented", "wrenches": tiago.wrenches, "step": 5e-3}
    settings["options"] = AccelerationOptions(zmp=place)
    result = resolve_accelerations(tiago.machine, task, gallery.SECONDS, start=gallery.START, **settings)
    assert result.stopped is not None
    assert result.stopped.reason == "lift_off"


def test_pinocchio_finds_the_loads_of_the_plan_of_tiago(tiago: gallery.Results) -> None:
    peered = Peered(tiago.file, tiago.machine, {}, gallery.LOAD)
    assert_pinocchio_agrees(peered, tiago.motion, tiago.wrenches)


def test_tiago_with_its_time_law_free_costs_less(tiago: gallery.Results) -> None:
    solution = solve(gallery.problem(tiago.machine, along="parameter"), gallery.METHOD)
    assert solution.cost < tiago.solution.cost
    motion = gallery.sampled(tiago.machine, solution, tiago.wrenches)
    assert motion.stands
    assert_in_limits(tiago.robot, motion)
    audit = solution.audit(tolerances=gallery.TOLERANCES)
    assert audit.passed, str(audit)
    shares = solution.at_fraction(np.linspace(0, 1, len(motion.t)))["path"][:, 0]
    errors = task_errors(tiago.machine, gallery.circle(tiago.machine), shares, motion.joints)
    assert np.abs(errors).max() < 1e-5


def test_anymal_stands_where_instantaneous_resolution_tips_it(anymal: Peered, anymal_solution: Solution) -> None:
    machine = anymal.machine
    settings: dict[str, Any] = {"wrenches": pushing.reaction(machine), "step": 1e-2}
    task = pushing.task(machine)
    local = resolve_accelerations(machine, task, pushing.SECONDS, start=pushing.START, **settings).motion
    assert not local.stands
    audit = anymal_solution.audit()
    assert audit.passed, str(audit)
    motion = sampled(machine, anymal_solution, pushing.reaction(machine), ROWS)
    assert motion.foot_margin.min() > 0.009
    assert motion.friction.max() <= 0.7
    assert_in_limits(machine.robot, motion)
    assert tip_error(machine, motion, task) < 1e-6
    assert_pinocchio_agrees(anymal, motion, pushing.reaction(machine))


def test_anymal_with_its_time_law_free_costs_less(anymal: Peered, anymal_solution: Solution) -> None:
    solution = solve(pushing.problem(anymal.machine, along="parameter"), pushing.METHOD)
    assert solution.audit().passed
    assert solution.cost < anymal_solution.cost
    motion = sampled(anymal.machine, solution, pushing.reaction(anymal.machine), ROWS)
    assert motion.foot_margin.min() > 0.009
    assert_pinocchio_agrees(anymal, motion, pushing.reaction(anymal.machine))


def test_a_simplified_robot_has_the_same_plan(anymal: Peered, anymal_solution: Solution) -> None:
    machine = replace(anymal.machine, robot=simplify(anymal.machine.robot))
    assert solve(pushing.problem(machine), pushing.METHOD).cost == pytest.approx(anymal_solution.cost, rel=1e-9)


def changed(machine: Standing, name: str, **limits: Any) -> Standing:
    joints = tuple(replace(j, **limits) if j.name == name else j for j in machine.robot.joints)
    return replace(machine, robot=replace(machine.robot, joints=joints))


def test_joints_without_limits_are_free_to_move(anymal: Peered, anymal_solution: Solution) -> None:
    free = np.inf
    loose = changed(anymal.machine, "j2s6s200_joint_1", lower=-free, upper=free, velocity=free, effort=free)
    solution = solve(pushing.problem(loose), pushing.METHOD)
    assert solution.cost <= anymal_solution.cost + 1e-6  # its share of the joint-limit index is gone


def test_a_start_at_a_limit_to_rounding_is_taken(anymal: Peered, anymal_solution: Solution) -> None:
    """At a joint that the plan only ever moves away from where it starts."""
    away = anymal_solution["joints"] - pushing.START
    i = int(np.flatnonzero((away.min(axis=0) > -1e-9) | (away.max(axis=0) < 1e-9))[0])
    side, inwards = ("lower", 1) if away[:, i].max() > 1e-3 else ("upper", -1)
    edge = changed(anymal.machine, anymal.machine.robot.joint_names[i], **{side: pushing.START[i] + inwards * 1e-10})
    solution = solve(pushing.problem(edge), pushing.METHOD)
    assert (inwards * (solution["joints"][:, i] - pushing.START[i])).min() >= -1e-7


@pytest.mark.parametrize(
    ("name", "limits", "message"),
    [
        ("j2s6s200_joint_3", {"lower": 1.744, "upper": 1.744}, "'j2s6s200_joint_3' cannot move .* lock it there"),
        ("j2s6s200_joint_3", {"lower": 1.8}, "'j2s6s200_joint_3' starts at 1.744, outside its limits 1.8"),
    ],
)
def test_limits_that_leave_nothing_are_named(anymal: Peered, name: str, limits: dict[str, float], message: str) -> None:
    with pytest.raises(ProblemError, match=message) as caught:
        pushing.problem(changed(anymal.machine, name, **limits))
    assert (caught.value.name or "unnamed") in str(caught.value)


@pytest.mark.parametrize(("what", "message"), [("velocity", "velocity"), ("effort", "torque")])
def test_a_limit_of_0_is_unknown_and_none_holds(anymal: Peered, what: str, message: str) -> None:
    name = "j2s6s200_joint_3"
    with pytest.warns(ModelWarning, match=f"gives {name} a {message} limit of 0, which is read as unknown") as caught:
        unknown = pushing.problem(changed(anymal.machine, name, **{what: 0.0}))
    assert caught[0].message.name == name  # type: ignore[union-attr]
    free = pushing.problem(changed(anymal.machine, name, **{what: np.inf}))
    assert str(unknown) == str(free)


def test_a_load_that_no_motion_holds_at_the_start_is_named(anymal: Peered) -> None:
    machine = anymal.machine
    heavy = replace(machine, robot=with_load(machine.robot, machine.robot.tip_link, 60.0))
    with pytest.raises(
        ProblemError,
        match=r"no joint accelerations satisfy the limits there: .*the torque of 'j2s6s200_joint_\d', at most",
    ):
        pushing.problem(heavy, zmp=Anywhere())
    weak = replace(machine, support=rectangle((-0.3, 0.3), (-0.5, -0.3)))
    with pytest.raises(ProblemError, match="the place of the zero moment point, by"):
        pushing.problem(weak, zmp=Pinned((0.0, -0.4)), limits=Limits(acceleration=5.0))


def test_motions_may_start_in_a_singular_configuration() -> None:
    """The arm of the paper stretched straight up: no local motion leaves there, the first guess is to stay."""
    machine, start = standing_example(), np.array([np.pi / 2, 0.0, 2 * np.pi, 2 * np.pi, 0.0])
    _, y, z = numeric(machine.tip_pose((), start).position).ravel()
    limits = Limits(joints=False, velocity=6.0, acceleration=60.0)
    problem = standing_problem(machine, moved_task(machine, start, (0.0, -0.1), 2.0), 2.0, start=start, limits=limits)
    solution = solve(problem, Collocation(16, degree=3, scheme="legendre", control="held"))
    end = numeric(machine.tip_pose((), solution["joints"][-1]).position).ravel()
    np.testing.assert_allclose(end, [0, y, z - 0.1], atol=1e-7)


def test_the_picture_of_the_gallery_is_written(tiago: gallery.Results, tmp_path: Path) -> None:
    gallery.figure(tmp_path / "mobile_manipulator.png", tiago, note="A note.", title="A title")
    assert (tmp_path / "mobile_manipulator.png").stat().st_size > 20_000


def test_a_missing_package_of_robots_is_named() -> None:
    with pytest.raises(ModuleNotFoundError, match="pip install no-such-robots"):
        gallery.robot_file(package="no-such-robots")
    with pytest.raises(FileNotFoundError, match=r"has no file a/b\.urdf"):
        gallery.robot_file("a/b.urdf")
