"""`make installed`: build the wheel, install it with its extras into a new environment, and use it as a user would.

A task file is planned, the plan checked, exported, viewed and reported; wrong task files are told by line, with what
was expected. The status is 0 when all holds, 1 otherwise.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import venv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from docs.executed import blocks
from tests.readme import steps

ROOT = Path(__file__).resolve().parents[2]
EXTRAS = "completion,gallery,mcap,meshes,yaml"
PATIENCE = 1200
"""s, for any one command."""
ROBOT = """
from importlib.metadata import files
print(next(file.locate() for file in files("example-robot-data") if file.name == "ur5_robot.urdf"))
"""
TASK = """[robot]
urdf = "ur5_robot.urdf"
tip = "tool0"
[path]
points = [[0.4, -0.2, 0.3], [0.4, 0.1, 0.3], [0.55, 0.15, 0.32]]
speed = 0.05
direction = [0, 0, -1]
[[obstacle]]
shape = "halfspace"
normal = [0, 0, 1]
point = [0, 0, -0.05]
[output]
plan = "seam.npz"
csv = "seam.csv"
report = "planned.html"
"""
WRONG = {
    ("urdf =", "urfd ="): ("line 2", "urdf"),
    ("ur5_robot.urdf", "no.urdf"): ("line 2", "no file", "the robot's URDF"),
    ("tool0", "tool9"): ("line 3", "did you mean 'tool0'"),
    ("[path]", "[paht]"): ("line 4", "did you mean path"),
    ("0.55, 0.15, 0.32]", "0.55, 0.15]"): ("line 5", "three numbers"),
    ("speed = 0.05", "speed = -1"): ("line 6", "a number above 0, m/s"),
    ("speed = 0.05", 'speed = "slow"'): ("line 6", "a number above 0, m/s"),
    ("speed = 0.05", "speed ="): ("line 6", "name = value"),
    ("[0, 0, -1]", "[0, 0]"): ("line 7", "three numbers"),
    ("halfspace", "halfpipe"): ("line 9", "halfspace"),
    ("normal = [0, 0, 1]", "normal = [0, 0, 0]"): ("line 10", "direction"),
    ('csv = "seam.csv"', 'cvs = "seam.csv"'): ("line 14", "csv"),
}
"""What is changed in the task file: what is said of it."""


class User:
    """Somebody with an environment and a folder of their own.

    Attributes:
        home: The folder. bin: Of the environment. told: What did not hold.
    """

    def __init__(self, home: Path, bin: Path) -> None:
        self.home, self.bin, self.messages = home, bin, list[str]()

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """A program of the environment, in the folder, with nothing of this process's paths."""
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
        program = [str(self.bin / words[0]), *words[1:]]
        return subprocess.run(
            program, cwd=self.home, env=kept, capture_output=True, text=True, timeout=PATIENCE, check=False
        )

    def holds(self, what: str, good: bool, shown: str = "") -> None:
        """Say whether something holds."""
        print(f"{'ok' if good else 'FAILED'}  {what}", flush=True)
        if not good:
            self.messages.append(f"{what}: {shown}")

    def does(self, *words: str, makes: str = "") -> str:
        """Run `selfmotion`; it succeeds, and leaves a file."""
        done = self.run("selfmotion", *words)
        there = not makes or ((self.home / makes).is_file() and (self.home / makes).stat().st_size > 0)
        self.holds(f"selfmotion {' '.join(words)}", done.returncode == 0 and there, f"{done.stdout}\n{done.stderr}")
        return done.stdout


def main() -> int:
    """Build, install and use it."""
    words = argparse.ArgumentParser(prog="make installed", description=__doc__)
    words.add_argument("--wheel", type=Path, help="of this wheel, instead of a new one")
    options = words.parse_args()
    with tempfile.TemporaryDirectory(prefix="selfmotion-installed-") as folder:
        home = Path(folder)
        wheel = options.wheel.resolve() if options.wheel else built(home)
        report = read_on(home, wheel)
        venv.create(home / "env", with_pip=True)
        user = User(home / "user", home / "env" / "bin")
        user.home.mkdir()
        done = user.run("python", "-m", "pip", "install", "--quiet", f"{wheel}[{EXTRAS}]")
        user.holds(f"pip install {wheel.name}[{EXTRAS}]", done.returncode == 0, done.stderr)
        if not user.messages:
            used(user)
        user.messages += report
    for failure in user.messages:
        print(f"FAILED: {failure}", file=sys.stderr)
    print(f"{len(user.messages)} failures")
    return 1 if user.messages else 0


def read_on(folder: Path, wheel: Path) -> list[str]:
    """Run the pages without extras, then do what the README says, in a folder that is empty; what did not hold."""
    venv.create(folder / "core", with_pip=True)
    user = User(folder / "reader", folder / "core" / "bin")
    user.home.mkdir()
    done = user.run("python", "-m", "pip", "install", "--quiet", str(wheel))
    user.holds(f"pip install {wheel.name}, without extras", done.returncode == 0, done.stderr)
    for page, line, source in standalone():
        (user.home / "block.py").write_text(source, encoding="utf-8")
        done = user.run("python", "block.py")
        user.holds(f"{page}, line {line}", done.returncode == 0, f"{done.stdout}\n{done.stderr}")
    for step in steps():
        if step.extras:
            done = user.run("python", "-m", "pip", "install", "--quiet", f"{wheel}[{step.extras}]")
            user.holds(f"pip install {wheel.name}[{step.extras}]", done.returncode == 0, done.stderr)
        if step.file:
            (user.home / step.file).write_text(step.text, encoding="utf-8")
        if step.words:
            done = user.run(*step.words)
            user.holds(f"README: {' '.join(step.words)}", done.returncode == 0, f"{done.stdout}\n{done.stderr}")
    return user.messages


def standalone() -> Iterator[tuple[str, int, str]]:
    """Blocks of the site's pages that run alone and name no extra in their first line."""
    for page in sorted((ROOT / "docs").rglob("*.md")):
        for line, alone, source in blocks(page.read_text(encoding="utf-8")):
            if alone and not source.startswith("# needs"):
                yield str(page.relative_to(ROOT)), line, source


def built(folder: Path) -> Path:
    """A wheel of the tree."""
    words = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT)]
    subprocess.run(words, check=True, timeout=PATIENCE)
    return next(folder.glob("*.whl"))


def used(user: User) -> None:
    """All that the command does, one after the other."""
    place = user.run("python", "-c", "import models, ocp; print(models.__file__, ocp.__file__)").stdout.split()
    user.holds("what is imported is what was installed", all(user.bin.parent in Path(one).parents for one in place))
    urdf = Path(user.run("python", "-c", ROBOT).stdout.strip())
    (user.home / "ur5_robot.urdf").write_bytes(urdf.read_bytes())  # its meshes are found in the installed package
    (user.home / "seam.toml").write_text(TASK, encoding="utf-8")
    user.does("--version")
    user.does("plan", "seam.toml", makes="seam.npz")
    user.does("check", "ur5_robot.urdf", "seam.csv", "--tip", "tool0")
    for ending in ("csv", "json", "yaml", "mcap", "urdf"):
        user.does("export", "seam.npz", f"out.{ending}", makes=f"out.{ending}")
    for ending in ("json", "yaml", "mcap"):
        message = json.loads(user.does("check", "out.urdf", f"out.{ending}", "--json"))
        user.holds(f"out.{ending} passes its check", message["passed"] is True, str(message.get("faults")))
    user.does("view", "seam.npz", "--page", "seam.html", makes="seam.html")
    text = (user.home / "seam.html").read_text(encoding="utf-8")
    user.holds("the page has at most 8 MB, and the meshes", 500_000 < len(text) < 8_000_000, f"{len(text)} bytes")
    user.does("report", "seam.npz", "seam_report.html", makes="seam_report.html")
    text = (user.home / "seam_report.html").read_text(encoding="utf-8")
    user.holds("the report says the verdict and holds a picture", "may be run" in text and "image/png" in text)
    user.does("completion", "bash")
    user.does("cache")
    for (good, wrong), expected in WRONG.items():
        with changed(user.home / "wrong.toml", good, wrong):
            done = user.run("selfmotion", "plan", "wrong.toml")
        last = done.stderr.strip().splitlines()[-1:]
        fits = done.returncode == 2 and all(word in "".join(last) for word in expected)
        user.holds(f"{wrong!r} is told with {', '.join(map(repr, expected))}", fits, f"{done.returncode}: {last}")


@contextmanager
def changed(file: Path, good: str, wrong: str) -> Iterator[None]:
    """A task file with a fault."""
    assert TASK.count(good) == 1, good
    file.write_text(TASK.replace(good, wrong), encoding="utf-8")
    yield
    file.unlink()


if __name__ == "__main__":
    sys.exit(main())
