"""G-code: programs of many dialects go through or are refused by line; LinuxCNC makes the same of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path as File
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from models import Arc, Helix, ModelWarning, Path, SmoothPath
from ocp import ProblemError
from ocp.app.files import Cut, Pause, Program, read_gcode
from tests.models.paths.task_paths import seeds
from tests.ocp.app.files.canonical import differences, of_canonical, of_program

Array = NDArray[np.float64]
FOLDER = File(__file__).parent / "gcode"
PROGRAMS = sorted(file for file in FOLDER.iterdir() if file.suffix != ".canon")
GOOD = [file for file in PROGRAMS if not file.name.startswith("refused")]
UNSUPPORTED_CODES = [file for file in PROGRAMS if file.name.startswith("refused")]
MM = 1e-3
STEP = 1e-5  # m, of samples

few = settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])


def read(file: File, text: str, **options: Any) -> Program:
    file.write_text(text, encoding="utf-8")
    return read_gcode(file, **options)


@pytest.fixture
def program(tmp_path: File) -> Callable[..., Program]:
    return lambda text, **options: read(tmp_path / "program.ngc", text, **options)


def sampled(path: Path | SmoothPath, step: float = STEP) -> Array:
    """Points no further apart than `step`. Shape (M, 3), m."""
    if isinstance(path, SmoothPath):
        # many in the cells of a sharp corner, too
        return path.at(
            np.append(np.linspace(0, path.length, int(path.length / step) + 2), path.sample_distances(64))
        ).position
    places = [np.linspace(0, length, int(length / step) + 2) for length in path.lengths]
    index = np.repeat(np.arange(len(places)), [len(each) for each in places])
    return path.at(index, np.concatenate(places))[0]


def strayed(one: Path | SmoothPath, other: Path | SmoothPath) -> float:
    """Largest distance of the samples of either from the nearest of many more of the other. m."""
    pairs = ((sampled(one), sampled(other, STEP / 4)), (sampled(other), sampled(one, STEP / 4)))
    return max(float(cKDTree(many).query(few)[0].max()) for few, many in pairs)


def test_there_are_many_programs_of_many_dialects() -> None:
    assert len(GOOD) >= 30
    assert len(UNSUPPORTED_CODES) >= 30


@pytest.mark.parametrize("file", GOOD, ids=lambda file: file.stem)
@pytest.mark.parametrize("tolerance", [2e-5, 2e-4])
def test_a_program_goes_through_and_its_path_stays_within_the_tolerance(file: File, tolerance: float) -> None:
    result = read_gcode(file)
    assert result.paths
    for cut, smooth in zip(result.cuts, result.smooth(tolerance), strict=True):
        message = np.fmin(cut.tolerances.min(initial=np.inf, where=~np.isnan(cut.tolerances)), tolerance)
        # half a step beside the nearest point, where the curve bends away
        assert strayed(cut.path, smooth) ** 2 <= (1.001 * max(message, tolerance)) ** 2 + 2 * (STEP / 8) ** 2
        assert smooth.at([0.0, smooth.length]).position[0] == pytest.approx(cut.path.segments[0].start, abs=1e-12)
        assert smooth.curvature_jumps().max(initial=0.0) < 1e-6 * (
            1 + smooth.curvature(smooth.sample_distances()).max()
        )


@pytest.mark.parametrize("file", UNSUPPORTED_CODES, ids=lambda file: file.stem)
def test_an_unsupported_program_is_refused_with_line_and_advice(file: File) -> None:
    head = file.read_text(encoding="utf-8").splitlines()[0]
    where, _, words = head.strip("()").removeprefix("refused: ").rpartition(": ")
    with pytest.raises(ProblemError, match=words) as caught:
        read_gcode(file)
    assert caught.value.name == (where or "file")
    assert not where or f"{file}, {where}, " in str(caught.value)


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.canon")), ids=lambda file: file.stem)
def test_linuxcnc_makes_the_same_of_it(file: File) -> None:
    text = file.read_text(encoding="utf-8")
    digits = 1.01e-4 * (25.4 if "INCH" in text else 1.0) * MM  # as printed
    theirs = of_canonical(text)
    assert len(theirs) > 0
    assert differences(of_program(read_gcode(file.with_suffix(".ngc"))), theirs, digits) == []


class Move(NamedTuple):
    """Of a random program; mm."""

    code: int
    end: Array
    center: Array
    turns: int


def random_moves(rng: np.random.Generator, count: int, plane: tuple[int, int, int] = (0, 1, 2)) -> list[Move]:
    """Rapids, lines, arcs and helices from the origin, in one plane; they never turn straight back."""
    here, moves = np.zeros(3), []
    a, b, n = plane
    for _ in range(count):
        code = int(rng.choice([0, 1, 1, 2, 3]))
        end, center, turns = here + rng.uniform(-20, 20, 3), here.copy(), 1
        if code > 1:
            radius, first, sweep = rng.uniform(1, 30), rng.uniform(-np.pi, np.pi), rng.uniform(0.2, 6.0)
            center[[a, b]] -= radius * np.array([np.cos(first), np.sin(first)])
            last = first + (sweep if code == 3 else -sweep)
            end = here.copy()
            end[[a, b]] = center[[a, b]] + radius * np.array([np.cos(last), np.sin(last)])
            end[n] += rng.choice([0.0, rng.uniform(-5, 5)])
            turns = int(rng.choice([1, 1, 2, 4]))
        moves.append(Move(code, end, center, turns))
        here = end
    return moves


def written(
    moves: list[Move],
    rng: np.random.Generator,
    *,
    inch: bool = False,
    incremental: bool = False,
    absolute_centers: bool = False,
    by_radius: bool = False,
    modal: bool = False,
    tight: bool = False,
    plane: int = 17,
    feed: float = 600.0,
) -> str:
    """The moves as G-code of a dialect; by_radius where one turn and no half turn makes that exact."""
    unit = 25.4 if inch else 1.0
    axes = {17: (0, 1, 2), 18: (2, 0, 1), 19: (1, 2, 0)}[plane]
    head = f"G{20 if inch else 21} G{91 if incremental else 90} G{plane}" + (" G90.1" if absolute_centers else "")
    lines, here, last = [head, f"F{feed / unit:.9f}"], np.zeros(3), -1
    for number, move in enumerate(moves):
        values = move.end - here if incremental else move.end
        words = [] if modal and move.code == last else [f"G{move.code}" if rng.random() < 0.5 else f"G0{move.code}"]
        keep = [i for i in range(3) if not modal or move.end[i] != here[i] or move.code > 1]
        words += [f"{'XYZ'[i]}{values[i] / unit:.12f}" for i in keep]
        if move.code > 1:
            chord = float(np.linalg.norm((move.end - here)[list(axes[:2])]))
            radius = float(np.linalg.norm((here - move.center)[list(axes[:2])]))
            first, second = (here - move.center)[list(axes[:2])], (move.end - move.center)[list(axes[:2])]
            angle = np.arctan2(first[0] * second[1] - first[1] * second[0], first @ second)
            sweep = (angle if move.code == 3 else -angle) % (2 * np.pi)
            if by_radius and chord > 0.2 * radius and abs(sweep - np.pi) > 0.3:
                words.append(f"R{(radius if sweep < np.pi else -radius) / unit:.12f}")
            else:
                offset = move.center if absolute_centers else move.center - here
                words += [f"{'IJK'[i]}{offset[i] / unit:.12f}" for i in axes[:2]]
            words += [f"P{move.turns}"] if move.turns > 1 else []
        rest = words[1:] if words and words[0][0] == "G" else words
        lead = words[: len(words) - len(rest)]
        rng.shuffle(rest)
        line = [f"N{10 * number}"] if rng.random() < 0.2 else []
        text = ("" if tight else " ").join([*line, *lead, *rest])
        if tight:
            text = text.lower()
        lines.append(text + (" (a comment; of two kinds)" if rng.random() < 0.1 else ""))
        here, last = move.end, move.code
    return "\n".join([*lines, "M2", ""])


def shape_of(result: Program) -> list[tuple[float, ...]]:
    """Of each segment and rapid: ends and centre, sweep, length, feed."""
    rows = []
    for section in result.sections:
        if not isinstance(section, Cut):
            assert not isinstance(section, Pause)
            rows.append((*section.end, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
            continue
        for segment, feed in zip(section.path.segments, section.feeds, strict=True):
            center = segment.center if isinstance(segment, Arc | Helix) else np.zeros(3)
            sweep = segment.sweep if isinstance(segment, Arc | Helix) else 0.0
            rows.append((*segment.end, *center, sweep, segment.length, 0.01 * float(feed)))
    return rows


DIALECTS: list[dict[str, Any]] = [
    {"inch": True},
    {"incremental": True},
    {"absolute_centers": True},
    {"by_radius": True},
    {"modal": True},
    {"tight": True},
    {"inch": True, "incremental": True, "by_radius": True, "modal": True, "tight": True},
    {"inch": True, "incremental": True, "absolute_centers": True, "tight": True},
]


@few
@given(seeds, st.integers(1, 12), st.sampled_from(DIALECTS), st.sampled_from([17, 18, 19]))
def test_the_same_moves_in_another_dialect_are_the_same_path(
    program: Callable[..., Program], seed: int, count: int, dialect: dict[str, Any], plane: int
) -> None:
    rng = np.random.default_rng(seed)
    moves = random_moves(rng, count, {17: (0, 1, 2), 18: (2, 0, 1), 19: (1, 2, 0)}[plane])
    plain = shape_of(program(written(moves, rng, plane=plane)))
    other = shape_of(program(written(moves, rng, plane=plane, **dialect)))
    assert np.array(other) == pytest.approx(np.array(plain), abs=1e-9)
    # and they are the moves that were written
    assert np.array(plain)[:, :3] == pytest.approx(MM * np.array([move.end for move in moves]), abs=1e-12)
    turning = [move for move in moves if move.code > 1]
    centers = np.array([row[3:6] for row in plain if row[6] > 0]).reshape(-1, 3)
    assert centers == pytest.approx(MM * np.array([move.center for move in turning]).reshape(-1, 3), abs=1e-9)
    full = 2 * np.pi * np.array([move.turns for move in turning])
    sweeps = np.array([row[6] for row in plain if row[6] > 0])
    assert ((sweeps <= full) & (sweeps > full - 2 * np.pi)).all()


@few
@given(seeds, st.integers(1, 10), st.sampled_from([(18, (2, 0, 1)), (19, (1, 2, 0))]))
def test_another_plane_turns_the_coordinates_round(
    program: Callable[..., Program], seed: int, count: int, plane: tuple[int, tuple[int, int, int]]
) -> None:
    rng = np.random.default_rng(seed)
    moves = random_moves(rng, count)
    where = list(plane[1])  # the axis that X, Y, Z of G17 becomes

    def turned(point: Array) -> Array:
        result = np.empty(3)
        result[where] = point
        return result

    there = [Move(move.code, turned(move.end), turned(move.center), move.turns) for move in moves]
    flat = np.array(shape_of(program(written(moves, rng))))
    other = np.array(shape_of(program(written(there, rng, plane=plane[0]))))
    assert other[:, where] == pytest.approx(flat[:, :3], abs=1e-9)
    assert other[:, 3 + np.array(where)] == pytest.approx(flat[:, 3:6], abs=1e-9)
    assert other[:, 6:] == pytest.approx(flat[:, 6:], abs=1e-9)


@few
@given(seeds, st.integers(1, 10))
def test_a_mirror_swaps_g2_and_g3(program: Callable[..., Program], seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    moves, mirror = random_moves(rng, count), np.array([-1.0, 1.0, 1.0])
    swapped = {2: 3, 3: 2}
    there = [Move(swapped.get(m.code, m.code), mirror * m.end, mirror * m.center, m.turns) for m in moves]
    one, other = (np.array(shape_of(program(written(each, rng)))) for each in (moves, there))
    assert other[:, :3] == pytest.approx(mirror * one[:, :3], abs=1e-9)
    assert other[:, 6:] == pytest.approx(one[:, 6:], abs=1e-9)


@given(
    st.floats(0.5, 50), st.floats(-20, 20).map(lambda rise: round(rise, 6)), st.integers(1, 9), st.sampled_from([2, 3])
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
def test_a_helix_has_the_length_of_its_development(
    program: Callable[..., Program], radius: float, micrometres: int, turns: int, code: int
) -> None:
    rise = micrometres * 1e-3
    text = f"G21 F100 G0 X{radius:.12f}\nG{code} X{radius:.12f} Z{rise:.12f} I{-radius:.12f} J0 P{turns}\n"
    result = program(text)
    expected = np.hypot(2 * np.pi * turns * radius, rise) * MM
    assert result.length == pytest.approx(expected, rel=1e-9)
    segment = result.paths[0].segments[0]
    assert np.sign(segment.torsion) == np.sign(rise) * (1 if code == 3 else -1)


@given(st.floats(0.3, 4.5), st.floats(0, 2 * np.pi), st.sampled_from([2, 3]), st.floats(-0.02, 0.02))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
def test_a_rounded_centre_is_moved_the_least_and_no_gap_is_left(
    program: Callable[..., Program], sweep: float, first: float, code: int, off: float
) -> None:
    radius, turn = 20.0, sweep if code == 3 else -sweep
    start = radius * np.array([np.cos(first), np.sin(first)])
    end = (radius + off) * np.array([np.cos(first + turn), np.sin(first + turn)])
    text = f"G21 F100\nG0 X{start[0]:.10f} Y{start[1]:.10f}\n"
    text += f"G{code} X{end[0]:.10f} Y{end[1]:.10f} I{-start[0]:.10f} J{-start[1]:.10f}\nG1 X99 Y99\n"
    path = program(text).paths[0]
    assert len(path.segments) == 2  # no tiny line
    arc = path.segments[0]
    assert isinstance(arc, Arc)
    assert np.asarray(arc.end)[:2] == pytest.approx(MM * end, abs=1e-12)
    assert np.asarray(path.segments[1].start) == pytest.approx(np.asarray(arc.end), abs=1e-12)
    # the centre lies on the line that halves the chord, and the way to it along the chord
    chord, moved = MM * (end - start), np.asarray(arc.center)[:2]
    assert (moved - MM * (start + end) / 2) @ chord == pytest.approx(0, abs=1e-12)
    across = np.array([-chord[1], chord[0]]) / np.linalg.norm(chord)
    assert moved @ across == pytest.approx(0, abs=1e-12)
    # a spiral about the centre that is written, as LinuxCNC runs it
    angle = np.linspace(0, turn, 400)
    r = MM * (radius + off * np.linspace(0, 1, 400))
    spiral = np.column_stack([r * np.cos(first + angle), r * np.sin(first + angle), 0 * angle])
    ours = sampled(Path((arc,)), 1e-5)
    assert cKDTree(ours).query(spiral)[0].max() <= max(3 * abs(off), 0.0285) * MM + 5e-6


@given(
    st.floats(0, 2 * np.pi), st.floats(-0.02, 0.02), st.floats(-0.09, 0.09), st.sampled_from([2, 3]), st.integers(1, 3)
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
def test_a_nearly_closed_circle_with_unequal_radii_becomes_two_halves(
    program: Callable[..., Program], first: float, short: float, off: float, code: int, turns: int
) -> None:
    """No one circle near the one that is written goes through both ends."""
    off = off if abs(off) > 0.03 else 0.03
    radius, sense = 100.0, 1 if code == 3 else -1
    sweep = 2 * np.pi - abs(short)
    start, end = (
        (radius + more) * np.array([np.cos(first + turn), np.sin(first + turn)])
        for more, turn in ((0.0, 0.0), (off, sense * sweep))
    )
    text = f"G21 F100\nG0 X{start[0]:.10f} Y{start[1]:.10f}\nG{code} X{end[0]:.10f} Y{end[1]:.10f} Z-2 "
    path = program(f"{text} I{-start[0]:.10f} J{-start[1]:.10f} P{turns}\n", gap=1e-5).paths[0]
    one, other = path.segments
    assert isinstance(one, Helix)
    assert isinstance(other, Helix)
    assert np.asarray(other.end) == pytest.approx([*(MM * end), -0.002], abs=1e-12)
    assert one.sweep == pytest.approx(sweep / 2, abs=3e-3)
    assert one.sweep + other.sweep == pytest.approx(sweep + 2 * np.pi * (turns - 1), abs=5e-3)
    assert one.rise / one.sweep == pytest.approx(other.rise / other.sweep, rel=5e-3)
    middle = MM * (radius + off / 2) * np.array([np.cos(first + sense * sweep / 2), np.sin(first + sense * sweep / 2)])
    assert np.asarray(one.end)[:2] == pytest.approx(middle, abs=1e-9)
    assert path.corner_angles() == pytest.approx(np.pi, abs=3e-3)
    for half in (one, other):
        assert np.hypot(*np.asarray(half.center)[:2]) <= 0.6 * abs(off) * MM


@pytest.mark.parametrize(
    ("unit", "off", "fits"),
    [("G21", 0.028, True), ("G21", 0.029, False), ("G20", 0.0028, True), ("G20", 0.0029, False)],
)
def test_the_largest_gap_is_that_of_the_digits_of_its_unit(
    program: Callable[..., Program], unit: str, off: float, fits: bool
) -> None:
    """0.01 mm and 0.001 inch, each of two points off by half a digit each way, seen along the diagonal."""
    text = f"{unit} F100\nG0 X1\nG3 X0 Y{1 + off} I-1 J0\n"
    if fits:
        program(text)
        return
    with pytest.raises(
        ProblemError, match=r"from the centre: a difference of .*; correct it, or read with gap="
    ) as caught:
        program(text)
    assert caught.value.name == "line 3"
    larger = float(str(caught.value).rpartition("gap=")[2])
    program(text, gap=larger)
    with pytest.raises(ProblemError, match="a difference of"):
        program(text, gap=0.9 * larger)


def test_a_thousandth_of_the_radius_is_rounding_too(program: Callable[..., Program]) -> None:
    program("G21 F100\nG0 X100\nG3 X0 Y100.09 I-100 J0\n")
    with pytest.raises(ProblemError, match="a difference of"):
        program("G21 F100\nG0 X100\nG3 X0 Y100.11 I-100 J0\n")


def test_a_radius_too_short_by_rounding_makes_half_a_circle(program: Callable[..., Program]) -> None:
    arc = program("G21 F100\nG2 X20 R9.999\n").paths[0].segments[0]
    assert isinstance(arc, Arc)
    assert arc.sweep == pytest.approx(np.pi)
    assert arc.radius == pytest.approx(0.01)


def test_feeds_are_metres_a_second(program: Callable[..., Program]) -> None:
    text = "G21 G1 X10 F600\nG20 X1 F10\nG93 X2 F2\nG3 X3 Y1 J1 F0.5\nG94 G21 X5 G1 F60\n"
    feeds = program(text).feeds[0]
    expected = [0.01, 10 * 0.0254 / 60, 0.0254 * 2 / 60, np.pi / 2 * 0.0254 * 0.5 / 60, 0.001]
    assert feeds == pytest.approx(expected, rel=1e-12)
    assert program("G21 G1 X10\n", feed=0.02).feeds[0] == pytest.approx([0.02])


@pytest.mark.parametrize("text", ["G1 X1 F100\n", "F100\nG0 X1\nG1 X2\n"])
def test_a_unit_that_nobody_says_is_warned_of(program: Callable[..., Program], text: str) -> None:
    with pytest.warns(ModelWarning, match="neither G20 nor G21; lengths are read as mm") as message:
        result = program(text)
    assert len(message) == 1
    assert result.notes[-1].text.startswith("no G20 or G21")
    one, other = (program(text, unit=unit).paths[0].length for unit in ("mm", "inch"))
    assert (one, other / one) == pytest.approx((result.paths[0].length, 25.4))


def test_a_path_ends_at_a_reversal_or_gets_a_bulb(program: Callable[..., Program]) -> None:
    text = "G21 F300\nG1 X10\nX4 F200\nG2 X0 Y4 I0 J4\nG3 X4 Y0 I4 J0\n"
    split = program(text)
    assert [len(path.segments) for path in split.paths] == [1, 2, 1]
    wide = program(text, reversal=0.001)
    assert [len(path.segments) for path in wide.paths] == [1 + 3 + 2 + 3 + 1]
    assert wide.feeds[0][:5] == pytest.approx([0.005] * 4 + [200 / 60 * MM])
    assert wide.cuts[0].lines.tolist() == [2, 2, 2, 2, 3, 4, 4, 4, 4, 5]
    assert wide.length == pytest.approx(split.length + 2 * 7 * np.pi / 3 * 0.0005, rel=1e-12)


def test_home_is_passed_over_at_the_ends_and_gone_to_where_it_is_known(program: Callable[..., Program]) -> None:
    between = "G21 F100\nG0 X5\nG1 X10\nG28 Z2\nG1 X0\n"
    with pytest.raises(ProblemError, match="home=") as caught:
        program(between)
    assert caught.value.name == "line 4"
    result = program(between, home=(0.0, 0.1, 0.2))
    assert [rapid.end.tolist() for rapid in result.rapids[1:]] == [[0.01, 0.0, 0.002], [0.01, 0.0, 0.2]]
    ends = program("G21 F100\nG91 G28 Z0\nG90 G0 X5\nG1 X10\nG53 G0 Z0\nG28\nM30\n")
    assert len(ends.sections) == 2
    assert [note.lines for note in ends.notes if "machine" in note.text] == [(2, 6), (5,)]


def test_notes_name_ignored_words_with_their_lines(program: Callable[..., Program]) -> None:
    result = program("G21 F100 S9 M3\nG0 X1 T2\nG1 X5 S8\nM8\nG43 H2\nM30\n")
    message = {note.text.partition(":")[0]: note.lines for note in result.notes}
    assert message == {"S": (1, 3), "M3": (1,), "T": (2,), "M8": (4,), "G43": (5,), "H": (5,)}
    assert str(result.notes[0]).startswith("lines 1, 3: S: spindle speed")
    assert "1 path of 4 mm in all, 1 rapid" in str(result)


def test_block_delete_is_a_switch(program: Callable[..., Program]) -> None:
    text = "G21 F100\n/G1 X1\n/2 G1 X2\nG1 X3\n"
    assert len(program(text).paths[0].segments) == 3
    assert len(program(text, block_delete=True).paths[0].segments) == 1


def test_ten_thousand_lines_are_read_in_seconds(program: Callable[..., Program]) -> None:
    lines = "\n".join(f"X{0.1 * i:.3f} Y{i % 7:.3f}" for i in range(1, 10_001))
    assert len(program(f"G21 F100 G1\n{lines}\n").paths[0].segments) == 10_000


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        (b"", "empty"),
        (b" \r\n\t\n", "empty"),
        (b"\xef\xbb\xbf", "empty"),
        (b"G21\0G1", "zero bytes"),
        (b"PK\x03\x04\x14", "not a G-code word"),
        (b"G1" + b"X1" * 6000, "longer than 10000 characters"),
        (b"\n" * 600_000, "600001 lines, at most 500000"),
        (b" " * (2**25 + 1), "longer than 32 MB"),
        (b"<html>", "expressions"),
        (b"G1 X" + b"9" * 400 + b"\n", "more than 32 digits"),
        (b"G1.55 X1", "not a code"),
        (b"G21 G1 X1 F-3", "negative"),
        (b"G21 G1 F3 X1\nG64 P-1", "negative"),
        (b"G21 G4 P-1", "negative"),
        (b"G21 G92 F1\n", "names no axis"),
        (b"G21 G0 X1\nG53 G0 X3", "own coordinates"),
        (b"G21 G53 G1 X0 F3", "G0 only"),
        (b"G28.1", "stores"),
        (b"G10 L2 P1 X0", "offsets"),
        (b"G21 F9 G90.1 G2 X1 I3", "give I and J"),
        (b"G21 F9 G2 X1 I0 J0", "is the start or the end"),
        (b"G21 F9 G1 X1 A3", "A moves"),
        (b"M99", "subroutines"),
        (b"G21 F9 G1 X1 P2", "belongs to no code"),
    ],
    ids=lambda value: str(value[:20]),
)
def test_bytes_that_are_no_program_are_refused_by_name(tmp_path: File, raw: bytes, words: str) -> None:
    (tmp_path / "bad.nc").write_bytes(raw)
    with pytest.raises(ProblemError, match=words) as caught:
        read_gcode(tmp_path / "bad.nc")
    assert caught.value.name


@given(st.binary(max_size=60))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=200)
@pytest.mark.filterwarnings("ignore::models.errors.ModelWarning")
def test_no_bytes_raise_anything_foreign(tmp_path: File, raw: bytes) -> None:
    _try_to_read(tmp_path, raw)


CODES = "G0 G1 G2 G3 G17 G18 G20 G21 G61 G90 G91 G92 G28 G4 G64 G93 M2"
WORDS = st.lists(st.sampled_from([*f"{CODES} X1 Y-2 Z.5 I3 J-1 K2 R4 P2 F60 %".split(), "\n"]), max_size=25)


@given(WORDS)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)
@pytest.mark.filterwarnings("ignore::models.errors.ModelWarning")
def test_no_words_raise_anything_foreign(tmp_path: File, words: list[str]) -> None:
    _try_to_read(tmp_path, " ".join(words).encode())


def _try_to_read(tmp_path: File, raw: bytes) -> None:
    (tmp_path / "some.nc").write_bytes(raw)
    try:
        read_gcode(tmp_path / "some.nc")
    except ProblemError as error:
        assert error.name  # noqa: PT017
