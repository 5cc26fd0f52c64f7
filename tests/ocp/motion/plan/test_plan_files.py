"""Plans outlive their process: files are read again as they were, or refused by name, and are written whole."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.interpolate import BPoly

from models import FixedBase, FreeFloating, Link, Machine, Mimic, Standing, planar_chain, rectangle
from ocp import ProblemError, Solution, TipTask
from ocp.motion.plan import Candidate, Plan, Reason, Rejection
from ocp.motion.result.request import restored_request, stored_request
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.motion.schedule import JointTrajectory
from ocp.problem.record_reader import unpack_record
from ocp.problem.record_writer import pack_record
from tests.models.robot.trees import numeric
from tests.ocp.motion.plan.motions import DOWN, curved_seam, plan_bare, planned
from tests.ocp.motion.tasks.space_tasks import floating_manipulator, floating_panda, panda, two_pandas, ur5
from tests.ocp.test_faults import run

pytestmark = pytest.mark.xdist_group("plan seam_ur5")  # one process, so that it is planned once

Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("plans") / "seam.npz"
    planned("seam_ur5").save(path)
    return path


# ---- plans -----------------------------------------------------------------------------------------------------------


def test_a_saved_plan_is_audited_in_another_process(saved: Path) -> None:
    result, audit = planned("seam_ur5"), planned("seam_ur5").audit()
    done = run(f"""
        from ocp.motion.plan import Plan
        plan = Plan.load({str(saved)!r})
        audit = plan.audit()
        print(audit.passed, repr(plan.cost), plan.names, repr(plan.sample(0.5).tip.tolist()))
    """)
    assert done.stdout.strip() == (
        f"{audit.passed} {result.cost!r} {result.names} {result.sample(0.5).tip.tolist()!r}"
    ), done.stderr


def test_a_plan_is_read_as_it_was_written(saved: Path, tmp_path: Path) -> None:
    result, again = planned("seam_ur5"), Plan.load(saved)
    assert isinstance(again, SolvedPlan)
    for name in ("joints", "rates"):
        np.testing.assert_array_equal(again[name], result[name])
    np.testing.assert_array_equal(again.t, result.t)
    assert (again.horizon, again.bound, again.parts) == (result.horizon, result.bound, result.parts)
    assert [description_of(each) for each in again.candidates] == [description_of(each) for each in result.candidates]
    np.testing.assert_array_equal(again.candidates[0].start, result.candidates[0].start)
    assert again.candidates[0].solution is again.solution
    assert str(again) == str(result)
    again.save(tmp_path / "again.npz")
    assert Plan.load(tmp_path / "again.npz").cost == result.cost


def description_of(candidate: Candidate) -> str:
    return repr((candidate.cost, candidate.stage, candidate.reason))


def edited(saved: Path, tmp_path: Path, edit: Callable[[Arrays], Arrays]) -> Path:
    with np.load(saved) as stored:
        arrays = {name: stored[name] for name in stored}
    path = tmp_path / "edited.npz"
    changed: dict[str, Any] = dict(edit(arrays))
    np.savez_compressed(path, **changed)
    return path


def forge_candidate(change: Callable[[dict[str, Any]], Any]) -> Callable[[Arrays], Arrays]:
    """An edit of what is told of the plan."""

    def edit(arrays: Arrays) -> Arrays:
        record = json.loads(arrays["plan"].tobytes())
        return {**arrays, "plan": np.frombuffer(json.dumps(change(record)).encode(), dtype=np.uint8)}

    return edit


def machine_in(record: dict[str, Any]) -> dict[str, Any]:
    """The record of the machine in what is told of a plan."""
    return dict(record["request"]["arguments"]["pool"])["machine"]  # type: ignore[no-any-return]


def having(record: dict[str, Any], machine: Any) -> dict[str, Any]:
    """What is told of a plan with another record of the machine."""
    pool = [[name, machine if name == "machine" else value] for name, value in record["request"]["arguments"]["pool"]]
    return {**record, "request": {**record["request"], "arguments": {"pool": pool}}}


def recorded(machine: Machine) -> Any:
    return machine_in({"request": pack_record(stored_request("", {"machine": machine}))[0]})


def without(name: str) -> Callable[[dict[str, Any]], Any]:
    return lambda record: {key: value for key, value in record.items() if key != name}


def without_in_request(name: str) -> Callable[[dict[str, Any]], Any]:
    return lambda record: {**record, "request": {k: v for k, v in record["request"].items() if k != name}}


def with_machine(**changes: Any) -> Callable[[dict[str, Any]], Any]:
    def change(record: dict[str, Any]) -> Any:
        machine = machine_in(record)
        return having(record, {**machine, "fields": {**machine["fields"], **changes}})

    return change


def with_links(change: Callable[[Any], Any]) -> Callable[[dict[str, Any]], Any]:
    """An edit of the links of the robot."""

    def edit(record: dict[str, Any]) -> Any:
        robot = machine_in(record)["fields"]["robot"]
        links = change(robot["fields"]["links"])
        return with_machine(robot={**robot, "fields": {**robot["fields"], "links": links}})(record)

    return edit


DAMAGES: dict[str, Callable[[Arrays], Arrays]] = {
    "no text": lambda arrays: {**arrays, "plan": np.array([255, 254], dtype=np.uint8)},
    "no JSON": lambda arrays: {**arrays, "plan": np.frombuffer(b"{", dtype=np.uint8)},
    "numbers": lambda arrays: {**arrays, "plan": np.array([1.0, 2.0])},
    "a list": forge_candidate(lambda record: [1, 2]),
    "nothing": forge_candidate(lambda record: None),
    **{f"no {name}": forge_candidate(without(name)) for name in ("request", "parts", "candidates", "bound", "targets")},
    **{
        f"a request without {name}": forge_candidate(without_in_request(name))
        for name in ("builder", "arguments", "functions")
    },
    "another builder": forge_candidate(
        lambda record: {**record, "request": {**record["request"], "builder": "os.system"}}
    ),
    "no parts at all": forge_candidate(lambda record: {**record, "parts": []}),
    "a part too short": forge_candidate(lambda record: {**record, "parts": [[0.0, 1.0]]}),
    "a part of words": forge_candidate(lambda record: {**record, "parts": [["a", "b", ""]]}),
    "a part of another plan": forge_candidate(lambda record: {**record, "parts": [[*record["parts"][0][:2], " 7"]]}),
    "a part that ends before it begins": forge_candidate(lambda record: {**record, "parts": [[5.0, 1.0, ""]]}),
    "a part that never ends": forge_candidate(lambda record: {**record, "parts": [[0.0, math.nan, ""]]}),
    "parts apart": forge_candidate(lambda record: {**record, "parts": [[0.0, 5.0, ""], [6.0, 7.0, ""]]}),
    "another horizon": forge_candidate(lambda record: {**record, "parts": [[0.0, 2 * record["parts"][0][1], ""]]}),
    "a candidate of words": forge_candidate(lambda record: {**record, "candidates": ["abcd"]}),
    "a candidate of another stage": forge_candidate(lambda record: {**record, "candidates": [[[0.0], 1.0, 99, None]]}),
    "a candidate of an unknown reason": forge_candidate(
        lambda record: {
            **record,
            "candidates": [[[0.0], 1.0, 3, {**Reason(Rejection.AUDIT).record(), "kind": "os.system"}]],
        }
    ),
    "a candidate of half a reason": forge_candidate(
        lambda record: {**record, "candidates": [[[0.0], 1.0, 3, {"kind": "AUDIT"}]]}
    ),
    "a bound of words": forge_candidate(lambda record: {**record, "bound": "low"}),
    "a machine of words": forge_candidate(lambda record: having(record, "UR5")),
    "a machine of another kind": forge_candidate(lambda record: having(record, {**machine_in(record), "kind": "Rig"})),
    "a machine without a kind": forge_candidate(lambda record: having(record, {"fields": {}})),
    "a machine without fields": forge_candidate(lambda record: having(record, {"kind": "FixedBase"})),
    "a machine that is a robot": forge_candidate(lambda record: having(record, machine_in(record)["fields"]["robot"])),
    "a link less": forge_candidate(with_links(lambda links: links[:-1])),
    "a link twice": forge_candidate(with_links(lambda links: [*links, links[0]])),
    "a link of words": forge_candidate(with_links(lambda links: ["hand", *links[1:]])),
    "links of words": forge_candidate(with_links(lambda links: "links")),
    "links a number": forge_candidate(with_links(lambda links: 3)),
    "a machine with more": forge_candidate(with_machine(wings=2)),
    "a machine without a robot": forge_candidate(with_machine(robot=None)),
    "another robot": forge_candidate(lambda record: having(record, recorded(panda()))),
    "a machine out of shape": forge_candidate(with_machine(rotation=[[2, 0, 0], [0, 1, 0], [0, 0, 1]])),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_plan_is_refused_by_name(damage: str, saved: Path, tmp_path: Path) -> None:
    with pytest.raises(ProblemError) as caught:
        Plan.load(edited(saved, tmp_path, DAMAGES[damage]))
    assert caught.value.name


def test_files_that_are_no_plans_are_refused_by_name(saved: Path, tmp_path: Path) -> None:
    planned("seam_ur5").solution.save(tmp_path / "solution.npz")
    with pytest.raises(ProblemError, match=r"a solution and no plan"):
        Plan.load(tmp_path / "solution.npz")
    (tmp_path / "words.npz").write_text("words")
    (tmp_path / "short.npz").write_bytes(saved.read_bytes()[:1000])
    np.savez(tmp_path / "numbers.npz", numbers=np.arange(3))
    for name in ("words", "short", "numbers"):
        with pytest.raises(ProblemError) as caught:
            Plan.load(tmp_path / f"{name}.npz")
        assert caught.value.name
    with pytest.raises(FileNotFoundError):
        Plan.load(tmp_path / "nobody.npz")
    for nothing in (None, 3, object()):
        with pytest.raises(ProblemError):
            Plan.load(nothing)  # type: ignore[arg-type]


def test_a_plan_file_is_a_solution_file_too(saved: Path) -> None:
    assert Solution.load(saved).cost == planned("seam_ur5").cost


def test_nothing_half_written_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = planned("seam_ur5")
    path, table = tmp_path / "plan.npz", tmp_path / "plan.csv"
    path.write_text("before")
    table.write_text("before")

    def fails(*_: Any) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.fsync", fails)
    with pytest.raises(OSError, match="disk full"):
        result.save(path)
    with pytest.raises(OSError, match="disk full"):
        result.write_csv(table)
    assert (path.read_text(), table.read_text()) == ("before", "before")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["plan.csv", "plan.npz"]


def test_a_plan_of_a_machine_of_ones_own_is_not_written(tmp_path: Path) -> None:
    class Own(FixedBase):
        """Not one of models'."""

    result = planned("seam_ur5")
    with pytest.raises(ProblemError, match="Own") as caught:
        replace(result, machine=Own(result.machine.robot)).save(tmp_path / "own.npz")
    assert caught.value.name == "machine"
    assert not list(tmp_path.iterdir())


# ---- tables and messages ---------------------------------------------------------------------------------------------


def test_a_table_is_read_back_bit_for_bit(tmp_path: Path) -> None:
    result, path = planned("seam_ur5"), tmp_path / "seam.csv"
    result.write_csv(path, 0.25)
    with path.open(newline="", encoding="utf-8") as stream:
        head, *rows = csv.reader(stream)
    names = result.names
    assert head == ["time", *names, *(f"{n}.velocity" for n in names), *(f"{n}.acceleration" for n in names)]
    sample = result.sample(0.25)
    table = np.array([[float(cell) for cell in row] for row in rows])
    report = np.column_stack([sample.t, sample.joints, sample.rates, sample.accelerations])
    np.testing.assert_array_equal(table, report)
    np.testing.assert_allclose(np.diff(sample.t)[:-1], 0.25)
    assert sample.t[-1] == result.horizon


def test_a_message_is_read_back() -> None:
    result = planned("seam_ur5")
    message = result.to_ros(0.5)
    again, instance = JointTrajectory.from_ros(json.loads(json.dumps(message))), result.trajectory(0.5)
    assert again.names == instance.names == result.names
    np.testing.assert_allclose(again.t, instance.t, atol=1e-9)
    for kind in ("positions", "velocities", "accelerations"):
        np.testing.assert_array_equal(getattr(again, kind), getattr(instance, kind))


def test_a_controller_that_interpolates_a_message_of_eight_milliseconds_follows_the_plan() -> None:
    """Quintic polynomials between points, as the JointTrajectoryController of ROS 2 has them, from rest to rest."""
    task = TipTask.along(curved_seam(), 0.1, acceleration=0.5, jerk=5.0, direction=DOWN)
    result = plan_bare(ur5(), task, search="start")
    points = result.to_ros(0.008)["points"]
    times = [point["time_from_start"]["sec"] + 1e-9 * point["time_from_start"]["nanosec"] for point in points]
    np.testing.assert_allclose(times[:-1], 0.008 * np.arange(len(times) - 1), atol=1e-9)
    kinds = ("positions", "velocities", "accelerations")
    values = np.array([[point[kind] for kind in kinds] for point in points])
    np.testing.assert_allclose(values[[0, -1], 1:], 0.0, atol=1e-5)
    quintic = BPoly.from_derivatives(times, values)
    fine = np.linspace(0.0, result.horizon, 20_001)
    motion = result.at(fine)
    np.testing.assert_allclose(quintic(np.minimum(fine, times[-1])), motion["joints"], atol=1e-6)
    np.testing.assert_allclose(quintic.derivative()(np.minimum(fine, times[-1])), motion["rates"], atol=1e-3)


@pytest.mark.parametrize("name", ["seam_ur5", "seam_space_arm"])
def test_samples_are_derivatives_of_each_other_and_tips_those_of_the_machine(name: str) -> None:
    result = planned(name)
    breaks = result.solution.state_interpolant.breaks * result.horizon
    times = (breaks[:-1] + breaks[1:]) / 2
    step = 1e-5
    before, at, after = (result.sampled(times + shift) for shift in (-step, 0.0, step))
    np.testing.assert_allclose((after.joints - before.joints) / (2 * step), at.rates, atol=2e-6)
    np.testing.assert_allclose((after.rates - before.rates) / (2 * step), at.accelerations, atol=1e-6)
    base = result.at(times).get("base", np.zeros((len(times), 0)))
    for row, place, joints in zip(at.tip, base, at.joints, strict=True):
        pose = result.machine.tip_pose(place, joints)
        np.testing.assert_allclose(row[:3], numeric(pose.position).ravel(), atol=1e-12)
        assert np.linalg.norm(row[3:]) == pytest.approx(1)
        turn = numeric(pose.rotation)
        w, x = row[3], row[4:]
        again = np.eye(3) * (w * w - x @ x) + 2 * np.outer(x, x) + 2 * w * numeric(ca.skew(ca.DM(x)))
        np.testing.assert_allclose(again, turn, atol=1e-12)


# ---- machines --------------------------------------------------------------------------------------------------------


def follower() -> Machine:
    """A chain whose last joint follows the first one."""
    chain = planar_chain([0.5, 0.4, 0.3], [1.0, 2.0, 3.0])
    last = replace(chain.joints[-1], mimic=Mimic(chain.joints[0].name, 0.5, 0.1))
    return FixedBase(replace(chain, joints=(*chain.joints[:-1], last)), translation=(0.1, 0.2, 0.3))


def standing() -> Machine:
    chain = planar_chain([1.0, 0.8, 0.6], [1.0] * 3, base=Link("foot", 30.0, inertia=np.eye(3)))
    upright = [(0, 0, 1), (1, 0, 0), (0, 1, 0)]
    return Standing(chain, rotation=upright, support=rectangle((-0.3, 0.3), (-0.3, 0.3)))


MACHINES: dict[str, Callable[[], Machine]] = {
    "fixed": panda,
    "floating": floating_manipulator,
    "with momentum": lambda: floating_panda((0.5, -0.3, 0.4, 1.0, -2.0, 1.5)),
    "two arms": two_pandas,
    "planar": lambda: FreeFloating(planar_chain([1.0, 0.5], [1.0, 1.0], base=Link("base", 5.0, inertia=np.eye(3)))),
    "standing": standing,
    "follower": follower,
}


def alike(first: Any, second: Any) -> bool:
    """Whether two machines are the same in every field."""
    if is_dataclass(first):
        if type(first) is not type(second):
            return False
        return all(alike(getattr(first, f.name), getattr(second, f.name)) for f in fields(first) if f.init)
    if isinstance(first, tuple | list):
        return len(first) == len(second) and all(map(alike, first, second))
    if isinstance(first, np.ndarray):
        return np.array_equal(first, second)
    return bool(first == second)


@pytest.mark.parametrize("kind", MACHINES)
def test_a_machine_is_read_as_it_was_written(kind: str) -> None:
    machine = MACHINES[kind]()
    record, arrays = pack_record(stored_request("", {"machine": machine}))
    again = restored_request(unpack_record(json.loads(json.dumps(record)), arrays)).machine
    assert alike(machine, again)
    rng = np.random.default_rng(3)
    q, qd = rng.normal(size=(2, machine.joint_size))
    base = machine.base_home()
    np.testing.assert_array_equal(
        numeric(again.tip_pose(base, q).position), numeric(machine.tip_pose(base, q).position)
    )
    np.testing.assert_array_equal(numeric(again.base_rate(base, q, qd)), numeric(machine.base_rate(base, q, qd)))


def test_invalid_machines_are_refused_by_name() -> None:
    value: Any
    for value in (
        None,
        3,
        "UR5",
        [],
        {},
        {"kind": "Robot"},
        {"kind": "os"},
        {"kind": []},
        {"kind": "FixedBase", "fields": 3},
    ):
        with pytest.raises(ProblemError) as caught:
            restored_request({"builder": "", "functions": [], "arguments": {"pool": [["machine", value]]}})
        assert caught.value.name == "request"
