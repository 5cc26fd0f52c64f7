"""Bodies that time alone moves: no point strays, or leaves its chord, by more than is said, across kinks and jumps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Problem, ProblemError
from ocp.problem.enclosures import PrescribedMotion
from ocp.problem.hulls import Hull, Separation

T = ca.SX.sym("t")
EYE = ca.DM.eye(3).reshape((9, 1))
CORE = np.array([[0.2, 0.0, 0.0], [-0.1, 0.1, 0.0], [0.0, 0.0, 0.3], [0.05, -0.2, -0.1]])
ONE = np.zeros(1, dtype=int)


def turned(angle: Any) -> Any:
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(c, s, 0, -s, c, 0, 0, 0, 1)


MOTIONS: dict[str, Callable[[Any], Any]] = {
    "smooth": lambda t: ca.vertcat(turned(3 * t), ca.sin(2 * t), t**2, 0.1 * t),
    "still but for a spike of a millisecond": lambda t: ca.vertcat(
        EYE, ca.if_else(ca.fabs(t - 0.3217) < 5e-4, 1 - ca.fabs(t - 0.3217) / 5e-4, 0), 0, 0
    ),
    "a zigzag": lambda t: ca.vertcat(EYE, ca.fabs(ca.fmod(7 * t, 2) - 1), ca.fmin(t, 0.4), ca.fmax(t, 1 - t)),
    "a zigzag that turns": lambda t: ca.vertcat(turned(ca.remainder(9 * t, 2)), 0, ca.sqrt(ca.fabs(t - 0.5)), 0),
    "steps": lambda t: ca.vertcat(turned(ca.floor(4 * t)), ca.sign(t - 0.37), ca.ceil(5 * t) / 5, 0),
    "across a cut": lambda t: ca.vertcat(EYE, ca.atan2(t - 0.6, -1), ca.copysign(0.2, t - 0.1), 0),
    "a pole": lambda t: ca.vertcat(EYE, ca.tan(3 * t), 0, 0),
}


def motion_of(frame: Any) -> PrescribedMotion:
    hulls = {"body": Hull(0, CORE, 0.02), "post": Hull(-1, np.zeros((1, 3)))}
    nothing = np.zeros((1, 0))
    apart = Separation("apart", frame, hulls, np.array([[0, 1, -1]]), np.zeros(1), {}, nothing, nothing)
    return PrescribedMotion(apart, frame, T, parameters=[], values=[])


@pytest.mark.parametrize("name", MOTIONS)
def test_deviations_and_chord_distances_are_within_their_bounds(name: str) -> None:
    frame = MOTIONS[name](T)
    motion, sampled = motion_of(frame), ca.Function("frame", [T], [frame])
    tight = {"stray": 0.0, "bow": 0.0}
    for count in (3, 40, 500):
        marks = np.linspace(0, 1, count + 1)
        pair = np.zeros(count, dtype=int)
        deviations, bows = motion.bounds(pair, marks[:-1], marks[1:])
        times = marks[:-1, None] + np.linspace(0, 1, 41) / count
        entries = np.array(sampled(times.ravel()[None])).T.reshape(count, 41, 12)
        turns, places = entries[..., :9].reshape(count, 41, 3, 3), entries[..., None, 9:]
        points = np.einsum("vj,ktji->ktvi", CORE, turns) + places
        share = np.linspace(0, 1, 41)[None, :, None, None]
        chord = (1 - share) * points[:, :1] + share * points[:, -1:]
        for what, bound, off in (("stray", deviations, points - points[:, 20:21]), ("bow", bows, points - chord)):
            largest = np.linalg.norm(off, axis=3).max(axis=(1, 2))
            assert (largest <= bound * (1 + 1e-9) + 1e-9).all(), what
            result = np.isfinite(bound) & (largest > 1e-6)
            tight[what] = max(tight[what], (largest[result] / bound[result]).max(initial=0.0))
    assert tight["stray"] > 0.25  # and the bounds are no idle ones


def test_smooth_motions_deviate_from_their_chord_quadratically() -> None:
    motion = motion_of(MOTIONS["smooth"](T))
    bows = [motion.bounds(ONE, np.array([0.4]), np.array([0.4 + h]))[1][0] for h in (0.1, 0.01, 0.001)]
    assert bows[1] < 0.012 * bows[0]
    assert bows[2] < 0.012 * bows[1]


def test_a_kink_is_bounded_by_its_slopes_and_a_jump_by_its_height() -> None:
    kink, jump = motion_of(ca.vertcat(EYE, ca.fabs(T), 0, 0)), motion_of(ca.vertcat(EYE, 0.3 * (T > 0), 0, 0))
    ends = np.array([-0.01]), np.array([0.01])
    np.testing.assert_allclose(kink.bounds(ONE, *ends), [[0.01], [0.01]], rtol=1e-9)
    deviation, bow = jump.bounds(ONE, *ends)
    np.testing.assert_allclose(deviation, 0.3, rtol=1e-9)
    assert np.isinf(bow).all()


def test_unprovable_separations_are_refused_by_name() -> None:
    problem = Problem("moved")
    q, p = problem.state("q", 3), problem.parameter("p")
    hulls = {"a": Hull(0, np.zeros((1, 3)), 0.1), "b": Hull(1, np.zeros((1, 3)), 0.1)}
    by_name: dict[str, Any] = {"levers": {"q": np.ones((1, 3))}, "turns": {"q": np.zeros((1, 3))}}
    frame = ca.vertcat(EYE, q)
    for other, seen, word in (
        (ca.vertcat(EYE, q + problem.time), -1, "frame 1 depends on time and on states"),
        (ca.vertcat(EYE, ca.erf(problem.time), p, 0), -1, "operation 'erf' has no bounds"),
        (ca.vertcat(EYE, problem.time, p, 0), 0, "observed from the world"),
    ):
        with pytest.raises(ProblemError, match=word):
            problem.separate("apart", ca.vertcat(frame, other), hulls, [[0, 1, seen]], least=0.0, **by_name)
    problem.separate("apart", ca.vertcat(frame, EYE, p * problem.time, p, 0), hulls, [[0, 1, -1]], least=0.0, **by_name)
