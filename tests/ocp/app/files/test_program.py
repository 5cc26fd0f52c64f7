"""A program over time: one trajectory of all its stretches, continuous, at its feeds, from rest to rest."""

from __future__ import annotations

from pathlib import Path as File

import numpy as np
import pytest
from hypothesis import given, settings

from models import Arc, Line, ModelError, Path
from models.paths import Segment, split_at_reversals
from ocp import ProblemError
from ocp.app.files import Cut, Pause, Program, Rapid, TimedProgram, read_gcode
from ocp.motion.schedule import JointLimits, LineLimits
from tests.models.paths.task_paths import seeds, turned

LIMITS = LineLimits(0.5, 2.0, 100.0, 1.0)
TEXT = """G21 G90 G64 P.1
G0 X10 Y0 Z5
G1 Z0 F600
X60 F3000
G3 X60 Y40 J20 F1200
G1 X10
G4 P.25
G0 Z5
M0
G0 X0 Y0
G1 X5 Z0 F300
G2 X5 Y0 Z-3 I4 P2
M2
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Program:
    file = tmp_path_factory.mktemp("programs") / "two.ngc"
    file.write_text(TEXT)
    return read_gcode(file)


@pytest.fixture(scope="module")
def timed(program: Program) -> TimedProgram:
    return program.schedule(LIMITS, rapid=0.4)


def test_curves_keep_the_acceleration_without_a_centripetal_limit_too(program: Program) -> None:
    for each in program.schedule(LineLimits(0.5, 0.02, 2.0)).schedules:
        if each is not None:
            motion = each.at(np.linspace(0, each.duration, 20001))
            across = motion.speed**2 * each.path.curvature(motion.distance)
            assert max(np.abs(motion.acceleration).max(), across.max()) <= 0.02 * 1.001


def test_the_stretches_are_those_of_the_file(program: Program, timed: TimedProgram) -> None:
    kinds = [type(each) for each in program.sections]
    assert kinds == [Rapid, Cut, Pause, Rapid, Pause, Rapid, Cut]
    assert timed.names == (
        "rapid, line 2",
        "cut, lines 3 to 6",
        "pause G4, line 7",
        "rapid, line 8",
        "pause M0, line 9",
        "rapid, line 10",
        "cut, lines 11 to 12",
    )
    assert [len(path.segments) for path in program.paths] == [4, 2]
    assert [feeds.tolist() for feeds in program.feeds] == [pytest.approx([0.01, 0.05, 0.02, 0.02]), [0.005, 0.005]]
    assert len(program.rapids) == 3


def test_the_durations_add_up_and_every_stretch_is_from_rest_to_rest(timed: TimedProgram) -> None:
    parts = [
        0.25 if each is None and i == 2 else 0.0 if each is None else each.duration
        for i, each in enumerate(timed.schedules)
    ]
    assert timed.duration == pytest.approx(sum(parts), rel=1e-14)
    assert np.diff(timed.bounds) == pytest.approx(parts, abs=1e-12)
    at = timed.at(timed.bounds)
    assert at.speed == pytest.approx(0, abs=1e-9)
    assert at.section.tolist() == [0, 1, 2, 3, 5, 5, 6, 6]  # a stop of no duration is passed
    assert at.position[0] == pytest.approx([0, 0, 0])
    assert at.position[-1] == pytest.approx([0.005, 0, -0.003], abs=1e-9)


def test_the_position_is_the_integral_of_the_speed_along_the_tangent(timed: TimedProgram) -> None:
    t = np.linspace(0, timed.duration, 40_001)
    motion = timed.at(t)
    step = t[1]
    assert np.linalg.norm(np.diff(motion.position, axis=0), axis=1).max() <= 1.001 * step * motion.speed.max()
    middle = timed.at((t[1:] + t[:-1]) / 2)
    difference = np.diff(motion.position, axis=0) / step
    expected = middle.speed[:, None] * middle.tangent
    assert np.abs(difference - expected).max() < 20 * step  # the acceleration times a step
    assert np.median(np.linalg.norm(difference - expected, axis=1)) < 1e-6


def test_a_time_may_be_beyond_the_end_by_rounding_of_its_own_size_and_no_more(program: Program) -> None:
    slow = program.schedule(LineLimits(1e-4, 2.0, 100.0, 1.0), rapid=1e-4)
    end = slow.duration
    assert end > 100.0
    np.testing.assert_array_equal(slow.at(end * (1 + 9e-10)).position, slow.at(end).position)
    np.testing.assert_array_equal(slow.at(-9e-10 * end).position, slow.at(0.0).position)
    for beyond in (end * (1 + 2e-9), -2e-9 * end):
        with pytest.raises(ProblemError, match="outside the program"):
            slow.at(beyond)


def test_no_feed_and_no_limit_is_exceeded(program: Program, timed: TimedProgram) -> None:
    motion = timed.at(np.linspace(0, timed.duration, 20_001))
    for i, section in enumerate(program.sections):
        here = motion.section == i
        if not here.any():
            continue
        most = {Rapid: 0.4, Pause: 0.0}.get(type(section), max(section.feeds) if isinstance(section, Cut) else 0.0)
        assert motion.speed[here].max() <= most * (1 + 1e-9)
        if isinstance(section, Rapid):
            assert np.abs(np.cross(motion.position[here] - section.start, section.end - section.start)).max() < 1e-12
    assert np.abs(motion.acceleration).max() <= 2.0 * (1 + 1e-9)
    assert np.abs(motion.jerk).max() <= 100.0 * (1 + 1e-9)
    assert motion.speed[motion.section == 1].max() == pytest.approx(0.05)


def test_the_speed_of_the_limits_is_the_most_a_feed_may_be(program: Program) -> None:
    slow = program.schedule(LineLimits(0.004, 2.0, 100.0))
    assert slow.at(np.linspace(0, slow.duration, 5001)).speed.max() == pytest.approx(0.004)


def test_the_tolerance_of_the_file_and_of_the_caller_both_hold(program: Program) -> None:
    largest = [path.remaining.max() for path in program.smooth()]
    small, same = program.smooth(1e-5), program.smooth(1.0)
    assert [path.remaining.max() for path in same] == pytest.approx(largest)
    assert all(one.remaining.max() < 0.5 * other for one, other in zip(small, largest, strict=True))
    assert program.smooth(kind="cubic", shape=3.0)[0].kind == "cubic"


def test_a_spline_has_one_feed(tmp_path: File) -> None:
    angle = np.linspace(0, np.pi, 601)
    lines = [f"G1 X{50 * np.cos(a):.3f} Y{50 * np.sin(a):.3f} F{600 if a < np.pi / 2 else 1200}" for a in angle]
    (tmp_path / "arc.nc").write_text("\n".join(["G21 G90", "G0 X50 Y0", *lines, "M2"]))
    timed = read_gcode(tmp_path / "arc.nc").schedule(LineLimits(1.0, 2.0, 100.0))
    motion = timed.at(np.linspace(0, timed.duration, 20_001))
    cut = np.array([isinstance(each, Cut) for each in timed.program.sections])[motion.section]
    assert motion.speed[cut & (motion.position[:, 0] > 1e-4)].max() == pytest.approx(0.01, rel=1e-6)
    assert motion.speed[cut].max() == pytest.approx(0.02, rel=1e-6)
    schedule = timed.schedules[1]
    assert schedule is not None
    assert len(schedule.path.bounds) < 30


@settings(max_examples=20)
@given(seeds)
def test_a_program_that_is_placed_is_the_same_elsewhere(program: Program, seed: int) -> None:
    rng = np.random.default_rng(seed)
    vector, shift = rng.normal(size=3), rng.normal(size=3)
    angle = float(np.linalg.norm(vector))
    axis = vector / angle
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    matrix = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k  # Rodrigues
    there = program.placed(shift, turned(vector))
    assert there.start == pytest.approx(shift)
    for one, other in zip(program.sections, there.sections, strict=True):
        if isinstance(one, Rapid) and isinstance(other, Rapid):
            assert other.start == pytest.approx(shift + matrix @ one.start, abs=1e-12)
            assert other.end == pytest.approx(shift + matrix @ one.end, abs=1e-12)
        if isinstance(one, Cut) and isinstance(other, Cut):
            index = rng.integers(0, len(one.path.segments), 20)
            along = rng.uniform(0, 1, 20) * one.path.lengths[index]
            for order, (mine, theirs) in enumerate(
                zip(one.path.at(index, along), other.path.at(index, along), strict=True)
            ):
                moved = mine @ matrix.T + (shift if order == 0 else 0)
                assert theirs == pytest.approx(moved, abs=1e-9 * max(1.0, float(np.abs(mine).max())))
            assert other.feeds is one.feeds
            # the tool was not turned in the program, and is turned with it
            assert np.abs(other.path.orientation @ turned(vector)) == pytest.approx(1, abs=1e-12)


THERE = Arc.about((1, 0, 0), (0, 0, 0), (0, 0, 1), 1.0)
SMALL = Arc.about((0.3, 0, 0), (0, 0, 0), (0, 1, 0), 1.0)


@pytest.mark.parametrize(
    ("segments", "width"),
    [
        ((Line((0, 0, 0), (1, 0, 0)), Line((1, 0, 0), (0.2, 0, 0))), 0.1),
        ((Line((0, 0, 1), (0, 0, 0)), Line((0, 0, 0), (0, 0, 0.5))), 0.02),
        ((Line((0, 0, 0), (1, 2, 2)), Line((1, 2, 2), (0.5, 1, 1))), 0.1),
        ((THERE, Arc.about(THERE.end, (0, 0, 0), (0, 0, -1), 0.4)), 0.05),
        ((SMALL, Arc.about(SMALL.end, (0, 0, 0), (0, -1, 0), 0.9)), 0.05),
    ],
)
def test_a_bulb_leaves_a_vertex_as_it_was_reached_and_comes_back(segments: tuple[Segment, ...], width: float) -> None:
    parts = split_at_reversals(segments)
    assert [index.tolist() for _, index in parts] == [[0], [1]]
    ((path, index),) = split_at_reversals(segments, width)
    assert index.tolist() == [0, 0, 0, 0, 1]
    assert path.corner_angles() == pytest.approx(np.pi, abs=2e-6)
    assert path.lengths[1:4].sum() == pytest.approx(7 * np.pi / 3 * width / 2)
    vertex = np.asarray(segments[0].end)
    bulb = np.concatenate([path.at(np.full(200, i), np.linspace(0, path.lengths[i], 200))[0] for i in (1, 2, 3)])
    ahead = path.at([0], [path.lengths[0]])[1][0]
    assert ((bulb - vertex) @ ahead).max() == pytest.approx((1 + np.sqrt(3)) / 2 * width, rel=1e-4)
    across = bulb - vertex - np.outer((bulb - vertex) @ ahead, ahead)
    assert 2 * np.linalg.norm(across, axis=1).max() == pytest.approx(width, rel=1e-4)
    assert np.linalg.matrix_rank(bulb - vertex, tol=1e-9) == 2


@pytest.mark.parametrize("wrong", ["join", 0.0, -1.0, float("nan"), None, True])
def test_a_reversal_that_is_neither_a_word_nor_a_width_is_a_named_error(wrong: object) -> None:
    with pytest.raises(ModelError, match="reversal"):
        split_at_reversals([Line((0, 0, 0), (1, 0, 0))], wrong)  # type: ignore[arg-type]


def test_limits_that_a_program_does_not_take_are_named_errors(program: Program, timed: TimedProgram) -> None:
    with pytest.raises(ProblemError, match="speed must be one number"):
        program.schedule(LineLimits([1.0, 2.0], 1.0, 10.0))
    with pytest.raises(ProblemError, match="joints must be None"):
        program.schedule(LineLimits(1.0, 1.0, 10.0, joints=JointLimits(1.0)))
    with pytest.raises(ProblemError, match="unknown option 'remaining'"):
        program.smooth(remaining=0.1)
    with pytest.raises(ProblemError, match="overlap"):
        program.smooth(overlap="cross")
    for wrong in (-1.0, timed.duration + 1, float("nan"), "a", [[0.1]]):
        with pytest.raises(ProblemError, match="time"):
            timed.at(wrong)


def test_a_pause_before_anything_moves_stands_at_the_start(tmp_path: File) -> None:
    (tmp_path / "wait.nc").write_text("G21 G4 P1\nG0 X5\nG4 P2\nM2\n")
    result = read_gcode(tmp_path / "wait.nc", start=(0.1, 0.2, 0.3)).schedule(LIMITS)
    at = result.at([0.5, result.duration - 0.5])
    assert at.position == pytest.approx(np.array([[0.1, 0.2, 0.3], [0.005, 0.2, 0.3]]))
    assert not at.speed.any()
    assert not at.tangent.any()


def test_the_length_of_a_program_is_that_of_its_cuts(program: Program) -> None:
    assert program.length == pytest.approx(sum(path.length for path in program.paths))
    assert Path.through([(0, 0, 0), (1, 0, 0)]).placed((1, 2, 3)).segments[0].end == pytest.approx([2, 2, 3])
