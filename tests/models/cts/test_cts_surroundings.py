"""A free body under gravity and ejectors, and distances between capsules, boxes and walls."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from models import Box, Capsule, Link, ModelError, reference_rig
from models.cts.best_roll import CollisionScene, clearances, rig_capsules
from models.cts.rig import dh_frames
from models.shapes.distance import soft_minimum
from scripts.papers.cts.release import GRAVITY, Ejector, SlenderAir, Store, release, yaw_pitch

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=50)
BODY = Link("store", 240.0, inertia=np.diag([6.0, 75.0, 80.0]))
REST = np.array([0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0.0])


def number(value: Any) -> float:
    return float(ca.DM(value))


def turns(quaternions: Any) -> Any:
    return Rotation.from_quat(np.asarray(quaternions)[:, [1, 2, 3, 0]]).as_matrix()


def starting(**changes: Any) -> Any:
    """A body at rest but for entries of its state, by their slices."""
    state = REST.copy()
    for name, value in changes.items():
        state[{"quaternion": slice(3, 7), "velocity": slice(7, 10), "spin": slice(10, 13)}[name]] = value
    return state


def test_a_body_in_a_vacuum_falls_by_the_closed_form() -> None:
    t = np.linspace(0, 2, 21)
    states = release(Store(BODY), starting(velocity=(3.0, -1.0, 2.0)), t)
    np.testing.assert_allclose(states[:, 2], 2 * t - GRAVITY * t**2 / 2, atol=1e-12)
    np.testing.assert_allclose(states[:, :2], np.outer(t, [3.0, -1.0]), atol=1e-12)


def test_a_tumbling_body_keeps_its_angular_momentum_and_energy() -> None:
    states = release(Store(BODY), starting(spin=(4.0, 2.0, -3.0)), np.linspace(0, 2, 201), steps=10)
    momentum = np.einsum("nij,nj->ni", turns(states[:, 3:7]), states[:, 10:13] @ BODY.inertia)
    energy = np.einsum("ni,ij,nj->n", states[:, 10:13], BODY.inertia, states[:, 10:13]) / 2
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), rtol=1e-8, atol=1e-5)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-9)


def test_ejectors_give_their_impulse_and_its_moment() -> None:
    force, duration, arm = 5000.0, 0.05, 0.4
    store = Store(BODY, (Ejector(force, duration, (arm, 0, 0)),), gravity=0.0)
    last = release(store, REST, [0, 0.025, 0.05, 0.06], steps=200)[-1]
    impulse = force * duration / 2  # integral of sin^2
    assert last[9] == pytest.approx(-impulse / BODY.mass, rel=1e-9)
    assert last[11] == pytest.approx(arm * impulse / BODY.inertia[1, 1], rel=1e-4)  # it turns a little meanwhile


def test_air_turns_a_stable_store_into_the_wind_and_slows_it() -> None:
    air = SlenderAir(wind=(-100.0, 0, 0))
    start = starting(quaternion=(np.cos(0.05), 0, np.sin(0.05), 0))
    moment, force = air(ca.DM(3, 1), ca.DM(turns(start[None, 3:7])[0]), ca.DM(3, 1), ca.DM(3, 1))
    assert number(moment[1]) < 0  # nose down by 0.1 rad: the moment lifts it
    assert number(force[0]) < 0
    pitch = yaw_pitch(release(Store(BODY, air=air, gravity=0.0), start, np.linspace(0, 3, 301))[:, 3:7])[:, 1]
    assert np.abs(pitch[200:]).max() < 0.7 * pitch[0]


def test_yaw_and_pitch_are_those_of_the_rig() -> None:
    assert yaw_pitch([np.cos(0.1), 0, np.sin(0.1), 0])[0] == pytest.approx([0, 0.2])
    assert yaw_pitch([np.cos(0.15), 0, 0, np.sin(0.15)])[0] == pytest.approx([0.3, 0])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Store(Link("nothing")), "mass"),
        (lambda: Ejector(1.0, 0.0, (0, 0, 0)), "duration"),
        (lambda: release(Store(BODY), REST, [0, 1, 1]), "times"),
        (lambda: release(Store(BODY), np.zeros(13), [0, 1]), "quaternion"),
        (lambda: release(Store(BODY), np.full(13, np.nan), [0, 1]), "start"),
        (lambda: clearances(reference_rig(), ca.DM.zeros(6), CollisionScene()), "empty"),
        (lambda: Box((1, 0, 1)), "size .* m is not positive"),
        (lambda: Box((np.inf,) * 3), "no outside"),
        (lambda: soft_minimum([ca.DM(1)], 0.0), "width"),
        (lambda: soft_minimum([], 1.0), "a list of 1 to"),
    ],
)
def test_impossible_targets_are_refused_by_name(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        make()


# ---- distances -------------------------------------------------------------------------------------------------


@few
@given(seeds)
def test_clearances_are_the_distances_of_the_capsules_points(seed: int) -> None:
    """Between the links and random obstacles, by dense samples of the segments; overlaps only have the same sign."""
    rng = np.random.default_rng(seed)
    rig, q = reference_rig(), rng.uniform(-1, 1, 6)
    turn = turns(rng.normal(size=(1, 4)))[0]
    box = Box(rng.uniform(0.2, 2, 3), rng.normal(size=3), turn)
    other = Capsule(float(rng.uniform(0.01, 0.2)), *rng.normal(size=(2, 3)))
    gaps = clearances(rig, q, CollisionScene(solids=(box,), capsules=(other,)))
    share = np.linspace(0, 1, 801)[:, None]
    beside = other.start + share[::4] * (other.end - other.start)
    for name, link in rig_capsules(rig, q).items():
        start, end = (np.array(ca.DM(point)).ravel() for point in (link.start, link.end))
        points = start + share * (end - start)
        over = np.abs((points - box.position) @ turn) - box.size / 2
        sampled = (np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(axis=1), 0)).min()
        result = number(gaps[name, "solid 0"]) + link.radius
        assert result == pytest.approx(sampled, abs=2e-3) or max(result, sampled) < 1e-9
        assert result <= sampled + 1e-7
        sampled = np.linalg.norm(points[:, None] - beside[None], axis=2).min()
        result = number(gaps[name, "capsule 0"]) + link.radius + other.radius
        assert sampled - 0.02 <= result <= sampled + 1e-9


def test_a_box_without_ends_has_walls_only() -> None:
    rig = reference_rig()
    link = rig_capsules(rig, np.zeros(6))["sting"]
    high, low = float(link.start[2]), float(link.end[2])
    size = 2 * (max(abs(high), abs(low)) + link.radius + 0.4)
    gaps = clearances(rig, np.zeros(6), CollisionScene(walls=Box((np.inf, np.inf, size))))
    assert number(gaps["sting", "walls"]) == pytest.approx(0.4)
    with pytest.raises(ModelError, match="size"):
        clearances(rig, np.zeros(6), CollisionScene(solids=(Box((np.inf, 1.0, 1.0)),)))


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=20), st.floats(1e-3, 1.0))
def test_soft_minimum_is_a_lower_bound_and_near(values: list[float], width: float) -> None:
    soft = number(soft_minimum([ca.DM(v) for v in values], width))
    assert min(values) - width * np.log(len(values)) - 1e-9 <= soft <= min(values) + 1e-9


def test_the_capsules_join_the_frames_of_the_rig() -> None:
    rig = reference_rig()
    q = ca.DM([0.3, -1.8, 0.3, 0.2, 1.4, 0.9])
    links, frames = rig_capsules(rig, q), dh_frames(rig, q)
    chain = list(links.values())
    for one, other in pairwise(chain):
        np.testing.assert_allclose(np.array(one.end), np.array(other.start), atol=1e-12)
    np.testing.assert_allclose(np.array(chain[-1].end), np.array(frames[-1].position), atol=1e-12)
    lengths = [float(ca.norm_2(link.end - link.start)) for link in chain]
    known = [rig.yaw_link_1, rig.yaw_link_2, rig.yaw_offset, rig.pitch_link, rig.goose_neck, rig.sting]
    assert lengths == pytest.approx(known, abs=1e-12)


def test_every_link_is_held_against_everything_around() -> None:
    around = CollisionScene(Box((np.inf, 2, 2)), (Box((2, 2, 0.2), (2, 0, 1)),), (Capsule(0.2, (0, 0, 2), (3, 0, 2)),))
    result = clearances(reference_rig(), ca.DM([0.3, -1.8, 0.3, 0.2, 1.4, 0.9]), around)
    assert len(result) == 6 * 3
    assert all(np.isfinite(number(gap)) for gap in result.values())
