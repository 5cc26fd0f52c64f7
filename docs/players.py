"""Players in pages: ```` ```{player} panda ```` shows results/gallery/panda.npz as `selfmotion view --page` writes it.

Beside the plan plays what it is compared with, NAME.local.csv, where there is one, and NAME.obj is the workpiece. The
title is the heading above the player. The pages are written while the site is read, into its folder players/.
"""

from __future__ import annotations

import re
import subprocess
import sys
from html import escape
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive

__all__ = ["command", "setup"]

ROOT = Path(__file__).resolve().parents[1]
PLANS = ROOT / "results" / "gallery"
GALLERY = ROOT / "docs" / "gallery.md"
FOLDER = "players"
NOT_PASSED = 1
"""Exit status where the audit of what is shown does not pass, which its page says."""


def titles() -> dict[str, str]:
    """The heading of the gallery above each player, by the player's name."""
    result, heading = {}, ""
    for line in GALLERY.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            heading = line.strip("# ")
        elif match := re.match(r"```\{player\} (\w+)", line):
            result[match[1]] = heading
    return result


def command(plan: Path, file: Path, title: str = "") -> list[str]:
    """What writes the page of a plan, and of what it is compared with."""
    beside = plan.with_name(f"{plan.stem}.local.csv")
    names = ["--name", "plan"]
    if beside.exists():
        names += ["--name", "local resolution"]
    motions = [str(plan), *([str(beside)] if beside.exists() else [])]
    if (workpiece := plan.with_suffix(".obj")).exists():
        names += ["--workpiece", str(workpiece)]
    return [sys.executable, "-m", "ocp", "view", *motions, "--page", str(file), "--quiet", "--title", title, *names]


class Player(Directive):  # type: ignore[misc]
    """The picture of a plan of the gallery, below it a player, closed until it is asked for, and a link to it alone."""

    required_arguments = 1

    def run(self) -> list[Any]:
        name = self.arguments[0]
        if not (PLANS / f"{name}.npz").is_file():
            raise self.error(f"there is no plan {name} in {PLANS}")
        depth = self.state.document.settings.env.docname.count("/")
        page = f"{'../' * depth}{FOLDER}/{name}.html"
        title = escape(titles().get(name, name))
        frame = f'<iframe class="player" src="{page}" title="{title}" loading="lazy"></iframe>'
        frame = f'<details class="player"><summary>Play the motion here</summary>{frame}</details>'
        link = f'<p><a href="{page}">Play it on a page of its own</a></p>'
        picture = nodes.image(uri=f"{'../' * (depth + 1)}results/gallery/{name}.png", alt=title)
        return [picture, nodes.raw("", f"{frame}\n{link}", format="html")]


def setup(app: Any) -> dict[str, bool]:
    """For Sphinx."""
    running: dict[str, subprocess.Popen[str]] = {}

    def begin(app: Any) -> None:
        folder = Path(app.outdir) / FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        headings = titles()
        for plan in sorted(PLANS.glob("*.npz")):
            words = command(plan, folder / f"{plan.stem}.html", headings.get(plan.stem, plan.stem))
            running[plan.stem] = subprocess.Popen(
                words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
            )

    def finish(app: Any, error: Exception | None) -> None:
        for name, process in running.items():
            told, _ = process.communicate()
            if error is None and process.returncode not in (0, NOT_PASSED):
                raise RuntimeError(f"the player of {name} is not written: exit status {process.returncode}\n{told}")

    app.add_directive("player", Player)
    app.connect("builder-inited", begin)
    app.connect("build-finished", finish)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
