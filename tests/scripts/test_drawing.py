"""What the paper scripts share: files that are whole or not there, tables that say what they hold."""

from __future__ import annotations

import csv
import json
import stat
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from scripts.drawing import gif, sheet
from scripts.papers.run import Table, text_table, write, written

RESULTS = Path(__file__).resolve().parents[2] / "results"


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("old", encoding="utf-8")

    def fail() -> None:
        with written(path) as temporary:
            temporary.write_text("half", encoding="utf-8")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fail()
    assert path.read_text(encoding="utf-8") == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_written_file_is_whole_readable_by_all_and_alone(tmp_path: Path) -> None:
    path = tmp_path / "new" / "text.txt"
    with written(path) as temporary:
        temporary.write_text("whole", encoding="utf-8")
        assert not path.exists()
    assert path.read_text(encoding="utf-8") == "whole"
    assert stat.S_IMODE(path.stat().st_mode) == 0o644
    assert list(path.parent.iterdir()) == [path]


def test_a_table_reads_back_as_it_was_written(tmp_path: Path) -> None:
    rows = [{"name": "a, b", "value": 1 / 3, "good": True}, {"name": "c", "value": -2e-15, "good": False}]
    write(tmp_path / "table.csv", Table(rows))
    with (tmp_path / "table.csv").open(newline="", encoding="utf-8") as stream:
        read = list(csv.DictReader(stream))
    assert [row["name"] for row in read] == ["a, b", "c"]
    assert [row["good"] for row in read] == ["yes", "no"]
    assert [float(row["value"]) for row in read] == pytest.approx([1 / 3, -2e-15], rel=1e-9)


def test_json_accepts_arrays_and_refuses_infinite_numbers(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    write(path, {"peaks": np.array([1.5, -2.0]), "passed": np.bool_(True), "deep": {"count": np.int64(3)}})
    assert json.loads(path.read_text(encoding="utf-8")) == {"peaks": [1.5, -2.0], "passed": True, "deep": {"count": 3}}
    with pytest.raises(ValueError, match="not JSON compliant"):
        write(path, {"cost": float("nan")})
    with pytest.raises(TypeError, match="Figure cannot be written"):
        write(path, {"figure": Figure()})
    assert json.loads(path.read_text(encoding="utf-8"))["deep"] == {"count": 3}
    assert list(tmp_path.iterdir()) == [path]


def test_text_columns_line_up() -> None:
    lines = text_table(
        [{"name": "long name", "value": 1.0}, {"name": "b", "value": -123.456789}], digits=4
    ).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert lines[2].endswith("       1")
    assert lines[3].endswith("  -123.5")


def test_a_figure_has_the_requested_size_and_no_time_stamp(tmp_path: Path) -> None:
    for name in ("one.png", "two.png"):
        with sheet(tmp_path / name, (1, 2), (4.0, 2.0), "assumed. " * 30, title="It is found") as (_, axes):
            assert axes.shape == (1, 2)
            axes[0, 0].plot([0, 1], [0, 1])
    with Image.open(tmp_path / "one.png") as picture:
        assert picture.size == (600, 300)
    for ending in ("png", "svg", "caption.txt"):
        assert (tmp_path / f"one.{ending}").read_bytes() == (tmp_path / f"two.{ending}").read_bytes()
    text = (tmp_path / "one.caption.txt").read_text(encoding="utf-8")
    assert text.startswith("It is found\n")
    assert text.split().count("assumed.") == 30  # the whole, of which the figure shows the first sentence


def test_committed_pictures_are_small() -> None:
    pictures = [path for ending in ("png", "svg", "gif") for path in RESULTS.rglob(f"*.{ending}")]
    assert len(pictures) > 50
    for path in pictures:
        assert path.stat().st_size < 1.5e6, path


def test_a_figure_that_fails_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), sheet(tmp_path / "never.png"):
        _ = 1 / 0
    assert list(tmp_path.iterdir()) == []


def test_an_animation_has_every_frame_and_its_time(tmp_path: Path) -> None:
    path = tmp_path / "motion.gif"
    with sheet(None, (1, 1), (2.0, 2.0)) as (figure, axes):
        (dot,) = axes[0, 0].plot([0], [0], "o")

        def frames() -> Iterator[Figure]:
            for place in np.linspace(-0.05, 0.05, 5):
                dot.set_data([place], [place])
                yield figure

        gif(path, frames(), seconds=0.1, hold=0.5)
    durations = []
    with Image.open(path) as animation:
        for k in range(getattr(animation, "n_frames", 1)):
            animation.seek(k)
            durations.append(animation.info["duration"])
    assert durations == [100, 100, 100, 100, 600]
