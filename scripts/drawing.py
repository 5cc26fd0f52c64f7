"""What figures and animations have in common: colours, line styles, the sheet they are drawn on."""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from PIL import Image

from ocp.app.view.appearance import COMPARED, PLAN
from scripts.papers.run import write, written

COLORS = {
    "blue": PLAN,
    "orange": COMPARED,
    "green": "#009E73",
    "purple": "#CC79A7",
    "sky": "#56B4E9",
    "yellow": "#E69F00",
    "grey": "#6E6E6E",
    "black": "#000000",
}
"""Okabe, Ito 2008: told apart with every kind of colour vision.

Where a plan stands beside what it is compared with (pseudo-inverse, local law, the paper's method), the plan is blue
and the other orange, as in `ocp.app.view.appearance`.
"""

DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (4, 1.2, 1, 1.2)), (0, (1, 1)))
"""Line styles in the order of the curves, so that no curve is known by its colour alone."""

VIRIDIS: Any = matplotlib.colormaps["viridis"]
TIME_COLORS = ListedColormap(VIRIDIS(np.linspace(0.0, 0.88, 256)))
"""Of postures, by their time; its yellow would be too pale."""

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
    "svg.fonttype": "path",  # the same letters everywhere
    "svg.hashsalt": "selfmotion",
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
}

TITLE_SIZE = 10.0
TITLE_CHARACTERS_PER_INCH = 13.0
NOTE_SIZE = 7.0
NOTE_CHARACTERS_PER_INCH = 19.0  # of the note's font
NOTE_LINE = 0.2  # inches


@contextmanager
def sheet(
    path: Path | None,
    shape: tuple[int, int] = (1, 1),
    size: tuple[float, float] = (6.3, 3.4),
    note: str = "",
    *,
    title: str = "",
    xlabel: str = "",
    **subplots: Any,
) -> Iterator[tuple[Figure, Any]]:
    """A figure of rows by columns of axes in the house style, saved when the block ends.

    Beside `path`, a PNG, lie the same picture as SVG and NAME.caption.txt with the title and the whole note.

    Args:
        path: PNG file; None to keep the figure and save nothing.
        shape: Rows and columns of axes.
        size: Width and height, inches.
        note: The assumptions it rests on. Its first sentence stands below the figure, the whole in the caption.
        title: What the figure shows, in a sentence, above it.
        xlabel: Under the lowest axes.
        subplots: Passed to Figure.subplots, for example sharey=True.

    Yields:
        The figure, and its axes as an array of that shape.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)  # draws to memory: needs no display, opens no window
        axes = figure.subplots(*shape, squeeze=False, **subplots)
        for ax in axes[-1]:
            ax.set_xlabel(xlabel)
        if title:
            figure.suptitle(textwrap.fill(title, int(size[0] * TITLE_CHARACTERS_PER_INCH)), fontsize=TITLE_SIZE)
        yield figure, axes
        add_note(figure, note)
        if path is not None:
            save(figure, path)
            caption(path, title, note)


def save(figure: Figure, path: Path) -> None:
    """A figure as PNG and, beside it, as SVG; the same bytes whenever it is drawn."""
    for ending, metadata in ((".png", {"Software": None}), (".svg", {"Date": None, "Creator": None})):
        with written(path.with_suffix(ending)) as temporary:
            figure.savefig(temporary, format=ending[1:], metadata=metadata)


def reduce_colors(path: Path, colors: int) -> None:
    """Write a PNG anew with at most some colours, which makes a large picture of thin lines several times smaller."""
    with Image.open(path) as picture:
        reduced = picture.convert("RGB").quantize(colors, dither=Image.Dither.NONE)
    with written(path) as temporary:
        reduced.save(temporary, format="PNG", optimize=True)


def caption(path: Path, title: str, note: str) -> None:
    """What is to be said of a picture, into a file beside it, NAME.caption.txt."""
    text = "\n\n".join(textwrap.fill(part, 120) for part in (title, note) if part)
    if text:
        write(path.with_suffix(".caption.txt"), text + "\n")


def add_note(figure: Figure, note: str) -> None:
    """The first sentence of a note below a figure, wrapped to its width."""
    if note:
        line = f"{note.rstrip('.')}. ".split(". ")[0]
        text = textwrap.fill(f"{line}.", int(figure.get_figwidth() * NOTE_CHARACTERS_PER_INCH))
        for legend in figure.legends:
            if getattr(legend, "_outside_loc", None) == "lower":  # the layout leaves no room for both
                low = NOTE_LINE * (1 + 0.6 * text.count("\n")) / figure.get_figheight()
                legend.set_bbox_to_anchor((0.0, low, 1.0, 1.0 - low))
                rows = -(-len(legend.get_texts()) // getattr(legend, "_ncols", 1))
                text = "\n" * (2 * rows) + text
        figure.supxlabel(text, x=0.01, ha="left", fontsize=NOTE_SIZE, color=COLORS["grey"])


def draw_arm(ax: Any, arm: Any, color: Any, width: float = 4.0) -> None:
    """An arm in a plane: links as bars, joints as white dots, the tip as a dot of its colour.

    Args:
        arm: Points from the first joint to the tip. Shape (n + 1, 2).
        color: Of the bars. width: Of them, points.
    """
    ax.plot(*arm.T, color="white", lw=width + 1.2, solid_capstyle="round", solid_joinstyle="round")
    ax.plot(*arm.T, color=color, lw=width, solid_capstyle="round", solid_joinstyle="round")
    ax.plot(*arm[:-1].T, "o", color="white", ms=0.5 * width, ls="none")
    ax.plot(*arm[-1], "o", color=color, ms=1.5 * width, mec="white", mew=0.8)


def legend_below(figure: Figure, handles: Any, ncols: int) -> None:
    """A legend under all axes, above the note, which moves it."""
    figure.legend(handles=handles, loc="outside lower center", ncols=ncols, fontsize=7.5)


def dots(ax: Any, values: Sequence[float], names: Sequence[str], colors: Sequence[str]) -> None:
    """Numbers by name on a logarithmic axis, the first at the bottom: dots, since bars there have no length to compare.

    Args:
        colors: Of each, names of COLORS.
    """
    places = range(len(values))
    ax.set_xscale("log")
    ax.scatter(values, places, s=34, color=[COLORS[color] for color in colors], zorder=3)
    ax.set_yticks(places, names, fontsize=7)
    ax.set_ylim(-0.7, len(values) - 0.3)
    ax.grid(visible=True, axis="y", ls=DASHES[3])


def time_bar(figure: Figure, axes: Any, horizon: float, *, fraction: float = 0.03, pad: float = 0.01) -> None:
    """The colours of postures from time 0 to the horizon, beside axes that give up a fraction of their width."""
    scale = ScalarMappable(Normalize(0.0, horizon), TIME_COLORS)
    figure.colorbar(scale, ax=axes, label="time, s", fraction=fraction, pad=pad)


def gif(
    path: Path,
    frames: Iterable[Figure],
    *,
    seconds: float,
    colors: int = 64,
    hold: float = 1.0,
    moving: Collection[Artist] = (),
) -> None:
    """Write an endless animation.

    Args:
        path: GIF file.
        frames: The figure at each instant; the same one, changed, may come again and again.
        seconds: Between two frames.
        colors: Of the palette that all frames share: fewer make a smaller file.
        hold: How long the last frame stays, s.
        moving: Where all frames are one figure, what changes in it: the rest is drawn once, behind these.
    """
    pictures: list[Image.Image] = []
    canvas: Any = None
    still: Any = None
    palette: Image.Image | None = None
    with matplotlib.rc_context(STYLE):
        for figure in frames:
            if moving and canvas is not None:
                canvas.restore_region(still)
            else:
                for artist in moving:
                    artist.set_animated(True)  # is left out by `draw`
                canvas = FigureCanvasAgg(figure)
                canvas.draw()
                still = canvas.copy_from_bbox(figure.bbox)
            for artist in moving:
                figure.draw_artist(artist)
            picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
            if palette is None:
                palette = _with_house_colors(picture).quantize(colors)
            pictures.append(picture.quantize(colors, palette=palette, dither=Image.Dither.NONE))
    durations = [round(1000 * seconds)] * len(pictures)
    durations[-1] += round(1000 * hold)
    settings: Any = {"append_images": pictures[1:], "duration": durations, "loop": 0, "optimize": True}
    with written(path) as temporary:
        pictures[0].save(temporary, format="GIF", save_all=True, **settings)


def _with_house_colors(picture: Image.Image) -> Image.Image:
    """A picture above a strip of COLORS, so that a palette made of it has them, however little of each is drawn."""
    width, height = picture.size
    result = Image.new("RGB", (width, height + height // 8), "white")
    result.paste(picture, (0, 0))
    step = width // len(COLORS)
    for k, color in enumerate(COLORS.values()):
        result.paste(Image.new("RGB", (step, height // 8), color), (k * step, height))
    return result
