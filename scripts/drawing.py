"""What the paper scripts share: the look of figures, tables, and files that are written whole or not at all."""

from __future__ import annotations

import csv
import json
import os
import tempfile
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

__all__ = [
    "COLORS",
    "DASHES",
    "STYLE",
    "add_note",
    "gif",
    "sheet",
    "text_table",
    "write_json",
    "write_table",
    "written",
]

Row: TypeAlias = Mapping[str, Any]

COLORS = {
    "blue": "#0072B2",
    "orange": "#D55E00",
    "green": "#009E73",
    "purple": "#CC79A7",
    "sky": "#56B4E9",
    "yellow": "#E69F00",
    "grey": "#6E6E6E",
    "black": "#000000",
}
"""Okabe, Ito 2008: told apart with every kind of colour vision."""

DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (4, 1.2, 1, 1.2)), (0, (1, 1)))
"""Line styles in the order of the curves, so that no curve is known by its colour alone."""

STYLE: Any = {
    "axes.grid": True,
    "axes.labelsize": 9,
    "axes.prop_cycle": cycler(color=[COLORS[c] for c in ("blue", "orange", "green", "purple", "yellow")]),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 9.5,
    "figure.constrained_layout.h_pad": 0.06,
    "figure.constrained_layout.w_pad": 0.06,
    "figure.dpi": 150,
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same figure everywhere
    "font.size": 9,
    "grid.alpha": 0.35,
    "grid.linewidth": 0.5,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.5,
    "savefig.dpi": 150,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
}

NOTE_SIZE = 7.0
NOTE_CHARACTERS_PER_INCH = 19.0  # of the note's font


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` to write to; it takes the name `path` when the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)  # mkstemp's files are the user's alone
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextmanager
def sheet(
    path: Path | None,
    *,
    rows: int = 1,
    columns: int = 1,
    size: tuple[float, float] = (6.3, 3.4),
    note: str = "",
    **subplots: Any,
) -> Iterator[tuple[Figure, Any]]:
    """A figure of `rows` by `columns` axes in the house style, saved as `path` when the block ends.

    Args:
        path: PNG file; None to keep the figure and save nothing.
        rows, columns: Of axes.
        size: Width and height, inches.
        note: Fine print under the figure, wrapped to its width: the assumptions it rests on.
        subplots: Passed to Figure.subplots, for example sharey=True.

    Yields:
        The figure, and its axes as an array of shape (rows, columns).
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)  # draws to memory: needs no display, opens no window
        axes = figure.subplots(rows, columns, squeeze=False, **subplots)
        yield figure, axes
        if note:
            add_note(figure, note)
        if path is not None:
            with written(path) as temporary:
                figure.savefig(temporary, format="png", metadata={"Software": None})


def add_note(figure: Figure, note: str) -> None:
    """Fine print under a figure, wrapped to its width."""
    text = textwrap.fill(note, int(figure.get_figwidth() * NOTE_CHARACTERS_PER_INCH))
    figure.supxlabel(text, x=0.01, ha="left", fontsize=NOTE_SIZE, color=COLORS["grey"])


def gif(path: Path, frames: Iterable[Figure], *, seconds: float, colors: int = 64, hold: float = 1.0) -> None:
    """Write an endless animation.

    Args:
        path: GIF file.
        frames: The figure at each instant; the same one, changed, may come again and again.
        seconds: Between two frames.
        colors: Of the palette that all frames share: fewer make a smaller file.
        hold: How long the last frame stays, s.
    """
    pictures: list[Image.Image] = []
    with matplotlib.rc_context(STYLE):
        for figure in frames:
            canvas: Any = FigureCanvasAgg(figure)
            canvas.draw()
            picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
            palette = pictures[0] if pictures else None
            pictures.append(picture.quantize(colors, palette=palette, dither=Image.Dither.NONE))
    durations = [round(1000 * seconds)] * len(pictures)
    durations[-1] += round(1000 * hold)
    settings: Any = {"append_images": pictures[1:], "duration": durations, "loop": 0, "optimize": True}
    with written(path) as temporary:
        pictures[0].save(temporary, format="GIF", save_all=True, **settings)


def write_table(path: Path, rows: Sequence[Row], digits: int = 10) -> None:
    """Write rows as CSV, the columns being the keys of the first row; floats to `digits` significant digits."""
    with written(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        table = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows({name: _cell(value, digits) for name, value in row.items()} for row in rows)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write nested dictionaries of numbers, text, lists and arrays as JSON; a number that is not finite is an error."""
    with written(path) as temporary:
        temporary.write_text(
            json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False, default=_plain) + "\n", encoding="utf-8"
        )


def text_table(rows: Sequence[Row], digits: int = 6) -> str:
    """Rows as aligned text with a head; numbers to the right, `digits` significant digits."""
    names = list(rows[0])
    cells = [[_cell(row[name], digits) for name in names] for row in rows]
    widths = [max(len(line[i]) for line in [names, *cells]) for i in range(len(names))]
    right = [all(isinstance(row[name], int | float | np.number) for row in rows) for name in names]

    def line(texts: Sequence[str]) -> str:
        parts = [t.rjust(w) if r else t.ljust(w) for t, w, r in zip(texts, widths, right, strict=True)]
        return "  ".join(parts).rstrip()

    return "\n".join([line(names), line(["-" * width for width in widths]), *map(line, cells)])


def _cell(value: Any, digits: int) -> str:
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return f"{value:.{digits}g}"
    return str(value)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")
