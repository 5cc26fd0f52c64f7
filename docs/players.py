"""Players in pages: ```` ```{player} panda ```` shows results/gallery/panda.npz as `selfmotion view --page` writes it.

Beside the plan plays what it is compared with, NAME.local.csv, where there is one. The pages are written while the site
is read, into its folder players/.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive

__all__ = ["command", "setup"]

ROOT = Path(__file__).resolve().parents[1]
PLANS = ROOT / "results" / "gallery"
FOLDER = "players"
NOT_PASSED = 1
"""Exit status where the audit of what is shown does not pass, which its page says."""


def command(plan: Path, file: Path) -> list[str]:
    """What writes the page of a plan, and of what it is compared with."""
    beside = plan.with_name(f"{plan.stem}.local.csv")
    names = ["--name", "plan"]
    if beside.exists():
        names += ["--name", "local resolution"]
    motions = [str(plan), *([str(beside)] if beside.exists() else [])]
    return [sys.executable, "-m", "ocp", "view", *motions, "--page", str(file), "--quiet", *names]


class Player(Directive):  # type: ignore[misc]
    """A frame that plays a plan of the gallery, and a link to it alone."""

    required_arguments = 1

    def run(self) -> list[Any]:
        name = self.arguments[0]
        if not (PLANS / f"{name}.npz").is_file():
            raise self.error(f"there is no plan {name} in {PLANS}")
        depth = self.state.document.settings.env.docname.count("/")
        page = f"{'../' * depth}{FOLDER}/{name}.html"
        frame = f'<iframe class="player" src="{page}" title="{name}" loading="lazy"></iframe>'
        return [nodes.raw("", f'{frame}\n<p><a href="{page}">{name}, on a page of its own</a></p>', format="html")]


def setup(app: Any) -> dict[str, bool]:
    """For Sphinx."""
    running: dict[str, subprocess.Popen[str]] = {}

    def begin(app: Any) -> None:
        folder = Path(app.outdir) / FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        for plan in sorted(PLANS.glob("*.npz")):
            words = command(plan, folder / f"{plan.stem}.html")
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
