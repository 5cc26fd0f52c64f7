"""Solutions: shapes, interpolation, and files that hold the whole plan or are not there."""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import warnings
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp import (
    AuditError,
    Collocation,
    MultipleShooting,
    Problem,
    ProblemError,
    RefinementSettings,
    RefinementWarning,
    Solution,
    refine,
    solve,
)
from tests.ocp.problems import EVERY_METHOD, SWING, energy, swing, van_der_pol

pytestmark = pytest.mark.xdist_group("solutions")  # one process, so that every plan is solved once

POOLS = ("states", "controls", "costates", "parameters", "cost_gradients")


@cache
def plan(method: str) -> Solution:
    """The swing problem by every method; cvodes solves a smaller one, because its second derivatives are slow."""
    if method.startswith("cvodes"):
        return solve(van_der_pol(), EVERY_METHOD[method])
    return solve(swing(), EVERY_METHOD[method], parameters=SWING)


# ---- reading -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", EVERY_METHOD)
def test_times_begin_at_zero_and_end_at_the_horizon(method: str) -> None:
    solution = plan(method)
    assert solution.t[0] == 0.0
    assert solution.t[-1] == solution.horizon
    assert np.all(np.diff(solution.t) > 0)


@pytest.mark.parametrize("method", EVERY_METHOD)
def test_everything_is_reported_at_the_same_times(method: str) -> None:
    solution = plan(method)
    m = len(solution.t)
    sizes = {"x": 2, "u": 1} if method.startswith("cvodes") else {"x": 2, "w": 1, "u": 1, "b": 2}
    for name, size in sizes.items():
        assert solution[name].shape == (m, size)
        assert solution[name].dtype == np.float64
    for name in solution.states:
        assert solution.costate(name).shape == (m, sizes[name])
    assert set(solution.states) | set(solution.controls) == set(sizes)


@pytest.mark.parametrize("method", EVERY_METHOD)
def test_the_interpolant_passes_through_the_reported_states(method: str) -> None:
    solution = plan(method)
    for name in solution.states:
        np.testing.assert_allclose(solution.at(solution.t)[name], solution[name], atol=1e-9)
    steps = np.diff(solution.t) / 2
    inner = solution.t[:-1] + steps
    one_by_one = np.array([solution.at(t)["x"] for t in inner])
    np.testing.assert_array_equal(one_by_one, solution.at(inner)["x"])


@pytest.mark.parametrize("method", EVERY_METHOD)
def test_reported_controls_are_those_of_their_interval(method: str) -> None:
    """Continuous from the right at the nodes, from the left at the end."""
    solution = plan(method)
    np.testing.assert_allclose(solution["u"][-1], solution.at(solution.horizon)["u"], atol=1e-12)
    np.testing.assert_allclose(solution["u"][0], solution.at(0.0)["u"], atol=1e-9)
    interior = np.array([t for t in solution.t if np.min(np.abs(mesh_times(solution) - t)) > 1e-9])
    if interior.size:
        at = np.isin(solution.t, interior)
        np.testing.assert_allclose(solution["u"][at], solution.at(interior)["u"], atol=1e-9)


def mesh_times(solution: Solution) -> np.ndarray:
    return np.asarray(solution.control_interpolant.breaks * solution.horizon)


@pytest.mark.parametrize("method", ["radau", "legendre-held", "rk4-linear", "cvodes-held"])
@given(fraction=st.floats(0.0, 1.0))
@settings(max_examples=15)
def test_at_is_defined_everywhere_and_stays_near_its_neighbours(method: str, fraction: float) -> None:
    solution = plan(method)
    here = solution.at(fraction * solution.horizon)
    assert set(here) == set(solution.states) | set(solution.controls)
    for name, value in here.items():
        assert value.shape == (solution[name].shape[1],)
        assert np.all(np.isfinite(value))
    step = 1e-9 * solution.horizon
    there = solution.at(min(fraction * solution.horizon + step, solution.horizon))
    np.testing.assert_allclose(here["x"], there["x"], atol=1e-6)
    np.testing.assert_allclose(here["x"], solution.at_fraction(fraction)["x"], atol=1e-12)
    assert "x" in here
    assert "nothing" not in here


def test_at_takes_one_time_or_many() -> None:
    solution = plan("radau")
    assert solution.at(0)["x"].shape == (2,)
    assert solution.at([0.1])["x"].shape == (1, 2)
    assert solution.at(np.linspace(0, solution.horizon, 7))["b"].shape == (7, 2)
    assert solution.at([])["w"].shape == (0, 1)
    assert len(solution.at(0.1)) == 4
    assert solution.at(solution.horizon * (1 + 1e-13))["x"].shape == (2,)  # rounding of a caller


@pytest.mark.parametrize("time", [-0.1, 99.0, np.nan, np.inf, [0.0, 99.0], None, "now", [[0.0], [0.1, 0.2]]])
def test_times_outside_are_named(time: Any) -> None:
    with pytest.raises(ProblemError, match="time"):
        plan("radau").at(time)


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda s: s["y"], "state or control 'y' does not exist; known: x, w, u, b"),
        (lambda s: s.at(0.1)["y"], "state or control 'y' does not exist"),
        (lambda s: s.costate("u"), "state 'u' does not exist; known: x, w"),
        (lambda s: s.cost_gradient("q"), "parameter 'q' does not exist; known: k"),
    ],
)
def test_unknown_names_are_named(ask: Callable[[Solution], Any], message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        ask(plan("radau"))


def test_a_name_may_be_requested_with_a_default() -> None:
    sample = plan("radau").at(0.1)
    assert "base" not in sample
    assert sample.get("base") is None
    assert sample.get("base", 3.0) == 3.0
    np.testing.assert_array_equal(sample.get("x"), sample["x"])


def test_a_solution_cannot_be_changed_by_accident() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        plan("radau").cost = 0.0  # type: ignore[misc]


# ---- files -------------------------------------------------------------------------------------------------------


def assert_identical(a: Solution, b: Solution) -> None:
    """Every field the same, arrays bit by bit."""
    for field in dataclasses.fields(Solution):
        if field.name in ("problem", "problem_lost"):
            continue
        one, two = getattr(a, field.name), getattr(b, field.name)
        if field.name in POOLS:
            assert list(one) == list(two)
            for name in one:
                assert one[name].tobytes() == two[name].tobytes()
                assert one[name].shape == two[name].shape
        elif field.name.endswith("interpolant"):
            for part in ("breaks", "nodes", "values"):
                assert getattr(one, part).tobytes() == getattr(two, part).tobytes()
                assert getattr(one, part).shape == getattr(two, part).shape
        elif isinstance(one, np.ndarray):
            assert one.tobytes() == two.tobytes()
        elif field.name == "method":
            assert json.loads(json.dumps(one)) == json.loads(json.dumps(two))
        else:
            assert one == two, field.name
            assert type(one) is type(two), field.name


@pytest.mark.parametrize("method", EVERY_METHOD)
def test_a_plan_comes_back_from_its_file_bit_by_bit(method: str, tmp_path: Path) -> None:
    solution = plan(method)
    solution.save(tmp_path / "plan.npz")
    loaded = Solution.load(tmp_path / "plan.npz")
    assert_identical(solution, loaded)
    assert str(loaded.problem) == str(solution.problem)
    t = np.linspace(0, solution.horizon, 50)
    assert loaded.at(t)["x"].tobytes() == solution.at(t)["x"].tobytes()


def test_a_refinement_comes_back_too(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RefinementWarning)
        solution = refine(
            van_der_pol(), Collocation(2, 2), tolerance=1e-9, settings=RefinementSettings(max_intervals=7)
        )
    solution.save(tmp_path / "plan.npz")
    loaded = Solution.load(tmp_path / "plan.npz")
    assert loaded.refinement == solution.refinement
    assert loaded.refinement is not None
    assert not loaded.refinement.reached
    assert_identical(solution, loaded)


@pytest.mark.parametrize(
    "method",
    [
        Collocation(np.int64(3), np.int64(2)),  # type: ignore[arg-type]
        Collocation(2, mesh=np.array([0.0, 0.3, 1.0])),  # type: ignore[arg-type]
        MultipleShooting(2, mesh=[0, np.float64(0.3), 1]),  # type: ignore[arg-type]
    ],
    ids=["numpy integers", "array mesh", "list mesh"],
)
def test_methods_declared_with_numpy_are_saved(method: Any, tmp_path: Path) -> None:
    solution = solve(energy(), method)
    solution.save(tmp_path / "plan.npz")
    assert_identical(solution, Solution.load(tmp_path / "plan.npz"))


def test_unsuccessful_plans_and_odd_numbers_are_saved(tmp_path: Path) -> None:
    failed = solve(van_der_pol(), Collocation(3), options={"max_iter": 1}, check=False)
    odd = dataclasses.replace(failed, cost=np.inf, states={"x": np.full_like(failed["x"], np.nan)})
    odd.save(tmp_path / "odd.npz")
    loaded = Solution.load(tmp_path / "odd.npz")
    assert not loaded.success
    assert loaded.cost == np.inf
    assert np.isnan(loaded["x"]).all()


@pytest.mark.parametrize("name", ["a/b", "../q", "x y", "ü", "head", ".", "a\\b", "t", "file", "states/q", "q.npy"])
def test_any_name_of_a_state_survives_the_file(name: str, tmp_path: Path) -> None:
    problem = Problem(f"named {name}")
    if name == "t":  # reserved among states, but a problem may be called so
        problem, name = Problem("t"), "q"
    x = problem.state(name, initial=1.0)
    u = problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize(u**2 + x**2)
    solution = solve(problem, Collocation(2))
    solution.save(tmp_path / "plan.npz")
    assert_identical(solution, Solution.load(tmp_path / "plan.npz"))
    assert [path.name for path in tmp_path.iterdir()] == ["plan.npz"]


@pytest.mark.parametrize("name", ["plan.npz", "plan", "plan.dat", "plän ü.npz"])
def test_a_file_has_the_requested_name(name: str, tmp_path: Path) -> None:
    plan("radau").save(str(tmp_path / name))
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert Solution.load(str(tmp_path / name)).cost == plan("radau").cost


def test_a_file_may_be_read_by_those_who_may_read_any_new_file(tmp_path: Path) -> None:
    plan("radau").save(tmp_path / "plan.npz")
    (tmp_path / "other").write_text("x")
    assert (tmp_path / "plan.npz").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_files_hold_plain_arrays_and_json(tmp_path: Path) -> None:
    plan("radau").save(tmp_path / "plan.npz")
    with np.load(tmp_path / "plan.npz", allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    assert all(array.dtype.kind in "fiu" for array in arrays.values())
    head = json.loads(arrays["head"].tobytes())
    assert head["version"] == 3
    assert head["name"] == "swing"


def test_saving_replaces_the_old_file_whole(tmp_path: Path) -> None:
    plan("legendre").save(tmp_path / "plan.npz")
    plan("radau").save(tmp_path / "plan.npz")
    assert_identical(plan("radau"), Solution.load(tmp_path / "plan.npz"))


@pytest.mark.parametrize("broken", ["os.replace", "numpy.savez_compressed"])
@pytest.mark.parametrize("error", [OSError("no space left"), KeyboardInterrupt()])
def test_a_failed_save_leaves_nothing_behind(
    broken: str, error: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan("legendre").save(tmp_path / "plan.npz")
    before = (tmp_path / "plan.npz").read_bytes()

    def fail(*arguments: Any, **settings: Any) -> None:
        raise error

    monkeypatch.setattr(broken, fail)
    with pytest.raises(type(error)):
        plan("radau").save(tmp_path / "plan.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["plan.npz"]
    assert (tmp_path / "plan.npz").read_bytes() == before


def test_data_that_json_cannot_write_leave_no_file(tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        dataclasses.replace(plan("radau"), method={"type": object()}).save(tmp_path / "plan.npz")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="nowhere"):
        plan("radau").save(tmp_path / "nowhere" / "plan.npz")
    with pytest.raises(FileNotFoundError, match="absent"):
        Solution.load(tmp_path / "absent.npz")


# ---- broken files ------------------------------------------------------------------------------------------------


def refused(path: Path) -> None:
    with pytest.raises(ProblemError, match=path.name):
        Solution.load(path)


@pytest.mark.parametrize("share", [0.0, 0.0005, 0.01, 0.1, 0.5, 0.9, 0.99, 0.9999])
def test_a_truncated_file_is_refused(share: float, tmp_path: Path) -> None:
    plan("radau").save(tmp_path / "plan.npz")
    data = (tmp_path / "plan.npz").read_bytes()
    (tmp_path / "short.npz").write_bytes(data[: int(share * len(data))])
    refused(tmp_path / "short.npz")


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=150)
def test_a_damaged_file_is_refused_or_whole(seed: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    """One byte changed: either nothing that matters was hit, or the file is refused by name."""
    folder = tmp_path_factory.getbasetemp()
    plan("radau-held").save(folder / "plan.npz")
    data = bytearray((folder / "plan.npz").read_bytes())
    rng = np.random.default_rng(seed)
    data[rng.integers(len(data))] ^= int(rng.integers(1, 256))
    (folder / "damaged.npz").write_bytes(bytes(data))
    try:
        loaded = Solution.load(folder / "damaged.npz")
    except ProblemError:
        return
    assert_identical(plan("radau-held"), loaded)


@pytest.mark.parametrize(
    "content",
    [b"", b"hello", b"PK\x03\x04", pickle.dumps({"a": 1}), b"\x93NUMPY", bytes(1000)],
    ids=["empty", "text", "zip head", "pickle", "npy head", "zeros"],
)
def test_garbage_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "garbage.npz").write_bytes(content)
    refused(tmp_path / "garbage.npz")


def test_files_of_others_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    refused(tmp_path / "other.npz")
    np.save(tmp_path / "other.npy", np.zeros(3))
    refused(tmp_path / "other.npy")
    np.savez(tmp_path / "pickled.npz", head=np.array([{}], dtype=object))
    refused(tmp_path / "pickled.npz")
    with zipfile.ZipFile(tmp_path / "text.npz", "w") as archive:
        archive.writestr("head", "{}")
    refused(tmp_path / "text.npz")
    (tmp_path / "folder.npz").mkdir()
    refused(tmp_path / "folder.npz")


def edited(path: Path, edit: Callable[[dict[str, Any], dict[str, np.ndarray]], Any]) -> None:
    """Change head and arrays of a saved plan."""
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    head = json.loads(arrays.pop("head").tobytes())
    edit(head, arrays)
    np.savez(path, head=np.frombuffer(json.dumps(head).encode(), dtype=np.uint8), **arrays)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda h, a: h.update(version=2), "format version 2, but this package reads version 3"),
        (lambda h, a: h.update(version="1"), "this package reads version 3"),
        (lambda h, a: h.update(version=None), "this package reads version 3"),
        (lambda h, a: h.pop("version"), "is not a saved solution"),
        (lambda h, a: h.pop("cost"), "is not a saved solution"),
        (lambda h, a: h.update(colour="red"), "is not a saved solution"),
        (lambda h, a: h.pop("order"), "is not a saved solution"),
        (lambda h, a: h.update(order=3), "is not a saved solution"),
        (lambda h, a: h["order"].update(states=["y"]), "is not a saved solution"),
        (lambda h, a: h["order"].pop("controls"), "is not a saved solution"),
        (lambda h, a: h.update(refinement=3), "is not a saved solution"),
        (lambda h, a: h.update(refinement={"errors": []}), "is not a saved solution"),
        (lambda h, a: a.pop("t"), "is not a saved solution"),
        (lambda h, a: a.pop("states/x"), "is not a saved solution"),
        (lambda h, a: a.pop("state_interpolant/nodes"), "is not a saved solution"),
        (lambda h, a: h.clear(), "is not a saved solution"),
    ],
)
def test_incomplete_files_are_refused(edit: Any, message: str, tmp_path: Path) -> None:
    plan("radau").save(tmp_path / "plan.npz")
    edited(tmp_path / "plan.npz", edit)
    with pytest.raises(ProblemError, match=message):
        Solution.load(tmp_path / "plan.npz")


def test_a_refused_file_is_closed_again(tmp_path: Path) -> None:
    (tmp_path / "plan.npz").write_bytes(b"PK\x03\x04 no archive")
    before = len(os.listdir("/dev/fd"))
    for _ in range(5):
        refused(tmp_path / "plan.npz")
    assert len(os.listdir("/dev/fd")) == before


# ---- audits of loaded plans --------------------------------------------------------------------------------------


def test_a_plan_that_lost_its_problem_is_audited_with_it(tmp_path: Path) -> None:
    solution = solve(van_der_pol(), Collocation(10))
    solution.with_problem(None).save(tmp_path / "plan.npz")
    loaded = Solution.load(tmp_path / "plan.npz")
    with pytest.raises(AuditError, match=r"'van der Pol' has no problem; call audit\(problem\)"):
        loaded.audit()
    assert str(loaded.audit(van_der_pol())) == str(solution.audit())
    assert loaded.with_problem(van_der_pol()).audit().passed


WRONG: list[tuple[str, Callable[[dict[str, Any], dict[str, np.ndarray]], Any]]] = [
    ("name", lambda h, a: h.update(name=3)),
    ("method", lambda h, a: h.update(method="radau")),
    ("method", lambda h, a: h["method"].pop("type")),
    ("solver", lambda h, a: h.update(solver=None)),
    ("success", lambda h, a: h.update(success="no")),
    ("success", lambda h, a: h.update(success=1)),
    ("status", lambda h, a: h.update(status=[])),
    ("cost", lambda h, a: h.update(cost="6")),
    ("cost", lambda h, a: h.update(cost=float("nan"))),
    ("iterations", lambda h, a: h.update(iterations=1.5)),
    ("iterations", lambda h, a: h.update(iterations=True)),
    ("start", lambda h, a: h.update(start=0)),
    ("regularised", lambda h, a: h.update(regularised=1)),
    ("bound_tightening", lambda h, a: a.update(bound_tightening=np.ones(3))),
    (
        "bound_tightening",
        lambda h, a: a.update(bound_tightening=np.full((2, len(a["control_interpolant/breaks"]) - 1, 9), -1.0)),
    ),
    ("horizon", lambda h, a: h.update(horizon=float("inf"))),
    ("horizon", lambda h, a: h.update(horizon=[1.0])),
    ("seconds", lambda h, a: h.update(seconds=1.0)),
    ("t", lambda h, a: a.update(t=a["t"][::-1])),
    ("t", lambda h, a: a.update(t=a["t"][:0])),
    ("t", lambda h, a: a.update(t=np.full_like(a["t"], np.nan))),
    ("state 'x'", lambda h, a: a.update({"states/x": a["states/x"][:-1]})),
    ("state 'x'", lambda h, a: a.update({"states/x": a["states/x"].ravel()})),
    ("state 'x'", lambda h, a: a.update({"states/x": a["states/x"] * np.nan})),
    ("control 'u'", lambda h, a: a.update({"controls/u": a["controls/u"] * np.inf})),
    ("costate 'w'", lambda h, a: a.update({"costates/w": a["costates/w"] * np.nan})),
    ("parameter 'k'", lambda h, a: a.update({"parameters/k": np.ones((2, 2))})),
    ("cost gradient 'k'", lambda h, a: a.update({"cost_gradients/k": np.ones((2, 2))})),
    ("variables", lambda h, a: a.update(variables=a["variables"][None])),
    ("multipliers", lambda h, a: a.update(multipliers=a["multipliers"] * np.nan)),
    ("state_interpolant.breaks", lambda h, a: a.update({"state_interpolant/breaks": np.zeros(2)})),
    ("state_interpolant.nodes", lambda h, a: a.update({"state_interpolant/nodes": np.array([])})),
    ("control_interpolant.values", lambda h, a: a.update({"control_interpolant/values": np.zeros((1, 1, 1))})),
    (
        "costate_interpolant",
        lambda h, a: a.update({"costate_interpolant/values": a["costate_interpolant/values"] * np.inf}),
    ),
    ("problem", lambda h, a: h["problem"].pop("declared")),
    ("problem", lambda h, a: h["problem"].update(expressions=99)),
    ("path", lambda h, a: a.update({"problem/integers": a["problem/integers"][:-3]})),
    ("problem", lambda h, a: a.update({"problem/integers": a["problem/integers"] + 1})),
    ("states/z", lambda h, a: a.update({"states/z": np.zeros(3)})),
    ("states/y", lambda h, a: a.update({"states/y": np.zeros(3)})),
]


@pytest.mark.parametrize(("name", "edit"), WRONG)
def test_errors_in_a_file_are_named(name: str, edit: Any, tmp_path: Path) -> None:
    plan("radau").save(tmp_path / "plan.npz")
    edited(tmp_path / "plan.npz", edit)
    with pytest.raises(ProblemError) as caught:
        Solution.load(tmp_path / "plan.npz")
    assert caught.value.name == name


def test_missing_values_of_an_unsuccessful_plan_may_be_nan(tmp_path: Path) -> None:
    failed = dataclasses.replace(plan("radau"), success=False, cost=np.nan)
    failed.save(tmp_path / "plan.npz")
    assert np.isnan(Solution.load(tmp_path / "plan.npz").cost)
