"""Compiled distances and their gradients: those of the interpreter, in threads and without a compiler, too."""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import (
    Box,
    Capsule,
    CollisionShape,
    Cylinder,
    FixedBase,
    FreeFloating,
    HalfSpace,
    Machine,
    Moving,
    Sphere,
    Surroundings,
)
from ocp import ProblemError, compiled_distances, libraries
from ocp.libraries import Library, built
from ocp.local.pair_gradients import SOURCE
from ocp.local.touching import distances_along
from tests.models.robot.trees import random_robot

SIZES = {"sphere": (0.08,), "capsule": (0.05, 0.3), "box": (0.1, 0.2, 0.3), "cylinder": (0.06, 0.3)}


@pytest.fixture(scope="module", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def crowd(seed: int, floating: bool = False) -> Surroundings:
    """A random tree of joints, slides and followers with bodies of all kinds, among obstacles of all kinds."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, 5, followers=True)
    kinds = [*SIZES, *rng.permutation(list(SIZES))]
    links = [
        replace(link, collisions=(CollisionShape(kinds[k % 8], SIZES[kinds[k % 8]], translation=rng.normal(size=3)),))
        for k, link in enumerate(robot.links)
    ]
    robot = replace(robot, links=tuple(links))
    machine: Machine = FreeFloating(robot) if floating else FixedBase(robot)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    obstacles: list[Any] = [
        Sphere(0.2, rng.normal(size=3)),
        Capsule(0.1, rng.normal(size=3), rng.normal(size=3)),
        Box((0.4, 0.3, 0.6), rng.normal(size=3), turn * np.linalg.det(turn)),
        Cylinder(0.2, 0.5, rng.normal(size=3)),
        HalfSpace((0, 0.6, 0.8), (0, 0, -1.0)),
        Moving(Box((0.2, 0.3, 0.4)), lambda t: (ca.sin(t), 0.3 * t, 0.5)),
    ]
    return Surroundings(machine, obstacles, limits=False)


def configurations(around: Surroundings, count: int, seed: int) -> Iterator[tuple[Any, Any, float]]:
    rng, machine = np.random.default_rng(seed), around.machine
    for _ in range(count):
        base = rng.normal(size=machine.base_size)
        if machine.base_size:
            base[3:] /= np.linalg.norm(base[3:])
        yield base, rng.uniform(-1.5, 1.5, machine.joint_size), float(rng.uniform(0, 2))


def agree(found: Any, known: Any) -> None:
    for one, other in zip(found, known, strict=True):
        np.testing.assert_allclose(np.array(one), np.array(other), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("seed", "floating", "rounding"), [(1, False, 0.01), (2, True, 0.0)])
def test_compiled_distances_and_gradients_are_the_interpreted_ones(seed: int, floating: bool, rounding: float) -> None:
    """Of a random machine and all kinds of pairs, in any order."""
    around = crowd(seed, floating)
    order = np.random.default_rng(seed).permutation(len(around.pairs))[:30].tolist()
    known = around.distance_gradients(pairs=order, rounding=rounding)
    found = compiled_distances(around, pairs=order, rounding=rounding)
    assert found.class_name() == "External"
    assert [found.name_in(k) for k in range(3)] == ["base", "q", "time"]
    kinds = {frozenset(type(around.bodies[body].shape) for body in pair[:2]) for pair in around.pairs[order]}
    assert len(kinds) > 9
    for given in configurations(around, 10, seed):
        agree(found(*given), known(*given))


@pytest.fixture(scope="module")
def few() -> tuple[Surroundings, list[int], Any]:
    """Some surroundings, pairs of them, and their compiled distances."""
    around = crowd(3)
    simple = (Sphere, Capsule, Box, HalfSpace)
    pairs = [
        k for k, both in enumerate(around.pairs) if all(isinstance(around.bodies[b].shape, simple) for b in both[:2])
    ]
    return around, pairs, compiled_distances(around, pairs=pairs, rounding=0.02)


def test_gradients_are_finite_differences_of_distances(few: tuple[Surroundings, list[int], Any]) -> None:
    """Along random rates, but for kinks, which are rare: there the differences of two steps do not agree."""
    around, _, function = few
    rng, kept = np.random.default_rng(4), 0
    for base, q, time in configurations(around, 10, 4):
        rates = rng.normal(size=len(q))

        def apart(step: float, *, base: Any = base, q: Any = q, time: float = time, rates: Any = rates) -> Any:
            return np.array(function(base, q + step * rates, time)[0]).ravel()

        rough, fine = ((apart(h) - apart(-h)) / (2 * h) for h in (2e-5, 1e-5))
        sure = np.abs(rough - fine) < 1e-7
        kept += sure.sum()
        slopes = np.array(function(base, q, time)[1]) @ rates
        np.testing.assert_allclose(slopes[sure], fine[sure], atol=1e-6)
    assert kept > 8 * len(rough)


def test_distances_along_a_motion_are_those_of_its_samples(few: tuple[Surroundings, list[int], Any]) -> None:
    """However many there are: they are measured side by side, and what is left over one by one."""
    around, pairs, _ = few
    known = around.distance_gradients(pairs=pairs)
    for count in (3, 64, 150):
        samples = list(configurations(around, count, count))
        base, joints, times = (np.array(part) for part in zip(*samples, strict=True))
        found = distances_along(around, base, joints, times)
        np.testing.assert_allclose(
            found[:, pairs].T, np.hstack([np.array(known(*one)[0]) for one in samples]), atol=1e-9
        )


def test_either_output_can_be_asked_for_alone(few: tuple[Surroundings, list[int], Any]) -> None:
    around, pairs, function = few
    q = ca.MX.sym("q", around.machine.joint_size)
    called = function.call([ca.MX(0, 1), q, 0.5])
    at = np.linspace(-1.0, 1.0, around.machine.joint_size)
    known = around.distance_gradients(pairs=pairs, rounding=0.02)((), at, 0.5)
    for k in range(2):
        agree([ca.Function("alone", [q], [called[k]])(at)], [known[k]])


def test_what_is_no_number_stays_none(few: tuple[Surroundings, list[int], Any]) -> None:
    around, pairs, function = few
    q = np.zeros(around.machine.joint_size)
    q[0] = np.nan
    known = np.array(around.distance_gradients(pairs=pairs, rounding=0.02)((), q, 0.0)[0]).ravel()
    values, slopes = (np.array(part) for part in function((), q, 0.0))
    lost = np.isnan(known)
    assert lost.any()
    assert np.isnan(values.ravel()[lost]).all()
    assert np.isnan(slopes[lost]).any(axis=1).all()


def test_threads_may_call_it_at_once(few: tuple[Surroundings, list[int], Any]) -> None:
    around, _, function = few
    mapped = function.map(100)
    lots = [list(configurations(around, 100, seed)) for seed in range(4)]
    given = [[np.array(part).T.reshape(-1, 100) for part in zip(*lot, strict=True)] for lot in lots]
    known = [mapped.call(each) for each in given]
    with ThreadPoolExecutor(4) as pool:
        for found, one in zip(pool.map(mapped.call, given * 5), known * 5, strict=True):
            for part, other in zip(found, one, strict=True):
                np.testing.assert_array_equal(np.array(part), np.array(other))


def test_without_a_compiler_it_is_interpreted_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, few: tuple[Surroundings, list[int], Any]
) -> None:
    around, pairs, compiled = few
    libraries.notice.cache_clear()
    monkeypatch.setenv("CC", "no-such-compiler")
    with caplog.at_level(logging.WARNING):
        functions = [compiled_distances(around, pairs=pairs, rounding=0.02) for _ in range(2)]
    assert [record.getMessage().count("no-such-compiler") for record in caplog.records] == [1]
    for given in configurations(around, 3, 5):
        agree(functions[0](*given), compiled(*given))


def test_a_library_that_is_damaged_is_made_again(few: tuple[Surroundings, list[int], Any], tmp_path: Path) -> None:
    around, pairs, _ = few
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path))
        chosen = pairs[:3]
        first = compiled_distances(around, pairs=chosen)
        (file,) = (tmp_path / "selfmotion").glob("*.so")
        whole = file.read_bytes()
        del first
        file.unlink()
        file.write_bytes(whole[: len(whole) // 2])
        again = compiled_distances(around, pairs=chosen)
    for given in configurations(around, 3, 6):
        agree(again(*given), around.distance_gradients(pairs=chosen)(*given))


def test_no_pairs_have_no_rows_and_no_surroundings_are_refused() -> None:
    around = crowd(1)
    q = np.zeros(around.machine.joint_size)
    values, slopes = compiled_distances(around, pairs=[])((), q, 0.0)
    assert (values.shape, slopes.shape) == ((0, 1), (0, len(q)))
    with pytest.raises(ProblemError, match="surroundings"):
        compiled_distances(around.machine)  # type: ignore[arg-type]


def test_exponentials_and_logarithms_are_those_of_the_library_of_c() -> None:
    """To two units in the last place, where distances need them; what is no number stays none."""
    lines = "".join(
        f"void many_{name}(const double *x, double *y, int n) {{ for (int k = 0; k < n; ++k) y[k] = {name}(x[k]); }}\n"
        for name in ("exponential", "logarithm")
    )
    text = f"#define SIDE 8\n#define TILE 8\n{SOURCE.read_text(encoding='utf-8')}{lines}"
    made = ctypes.CDLL(str(built(Library((text,), lambda: text, vectors=True))))
    rng = np.random.default_rng(8)
    for name, known, x in (
        ("exponential", np.exp, np.r_[rng.uniform(-700.0, 700.0, 4000), rng.uniform(-1.0, 0.0, 4000), 0.0, np.nan]),
        ("logarithm", np.log, np.r_[np.exp(rng.uniform(-600, 600, 4000)), rng.uniform(0.9, 30.0, 4000), 1.0, np.nan]),
    ):
        y = np.empty_like(x)
        getattr(made, f"many_{name}")(ctypes.c_void_p(x.ctypes.data), ctypes.c_void_p(y.ctypes.data), len(x))
        np.testing.assert_allclose(y, known(x), rtol=4.5e-16, atol=1e-19)
