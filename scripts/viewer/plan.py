"""A saved plan put together with the robot that it moves, by the names of the joints."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import numpy as np

from models import Robot
from models.arrays import Array
from ocp import ProblemError, Solution
from ocp.audit.clearance import Nearest, nearest_at
from scripts.papers.run import written
from scripts.robots.frames import Frames, frames_function

RECORD = "robot"
"""Entry of the plan's file that says of which robot it is; `Solution.load` passes over it."""
BASES = (0, 3, 7)


@dataclass(frozen=True, eq=False)
class Played:
    """A plan and its robot.

    Attributes:
        robot: As the plan moves it.
        solution: The plan.
        urdf: The file that the robot was read from.
        joints: Name of the state of the joint positions. base: That of the base's configuration, or None.
        columns: Where the state of the joints has the joints of the robot, in the robot's order.
        translation, rotation: Of a fixed base in the world.
    """

    robot: Robot
    solution: Solution
    urdf: Path
    joints: str
    base: str | None
    columns: tuple[int, ...]
    translation: Array = field(default_factory=lambda: np.zeros(3))
    rotation: Array = field(default_factory=lambda: np.eye(3))

    @property
    def horizon(self) -> float:
        """s."""
        return self.solution.horizon

    def frames(self, times: Any) -> Frames:
        """Frames of all links and of the tip at times, (M,), s, clipped to the plan."""
        at = self.solution.at(np.clip(np.atleast_1d(np.asarray(times, dtype=float)), 0.0, self.horizon))
        base = None if self.base is None else at[self.base]
        return self._frames(at[self.joints][:, self.columns], base)

    def nearest(self, time: float) -> Nearest | None:
        """The two bodies that are nearest to each other at a time, s; None where the plan does not know of any."""
        problem = self.solution.problem
        return None if problem is None else nearest_at(problem, self.solution, time)

    @cached_property
    def _frames(self) -> Callable[[Any, Any], Frames]:
        size = 0 if self.base is None else self.solution.states[self.base].shape[1]
        return frames_function(self.robot, size, self.translation, self.rotation)


def save_plan(
    path: Path,
    solution: Solution,
    robot: Robot,
    options: Mapping[str, Any],
    *,
    package: tuple[str, str] | None = None,
    joints: str = "joints",
    base: str | None = None,
    translation: Any = (0.0, 0.0, 0.0),
    rotation: Any = None,
) -> None:
    """`solution.save`, and with it how the robot is read from its URDF file, so that `play` needs no more.

    Args:
        path: File to write, whole or not at all.
        solution: The plan.
        robot: What it moves.
        options: Of Robot.from_urdf, with which the robot was read.
        package: Installed distribution and the end of the path of the URDF file in it.
        joints, base: Names of the states, see Played.
        translation, rotation: Of a fixed base.
    """
    record = {
        "options": options,
        "package": package,
        "joint_names": robot.joint_names,
        "joints": joints,
        "base": base,
        "translation": translation,
        "rotation": np.eye(3) if rotation is None else rotation,
    }
    text = json.dumps(record, default=lambda value: np.asarray(value).tolist())
    entry = io.BytesIO()
    np.save(entry, np.frombuffer(text.encode(), dtype=np.uint8), allow_pickle=False)
    with written(path) as temporary:
        solution.save(temporary)
        with zipfile.ZipFile(temporary, "a", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(f"{RECORD}.npy", entry.getvalue())


def read_record(path: Path) -> dict[str, Any]:
    """What save_plan wrote of the robot; empty for a plan of `Solution.save` alone.

    Raises:
        ProblemError: The record is damaged.
    """
    with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as archive:
        if RECORD not in archive.files:
            return {}
        try:
            record = json.loads(archive[RECORD].tobytes().decode())
        except (ValueError, UnicodeDecodeError) as error:
            raise ProblemError(f"{path}: the record of the robot is damaged: {error}") from error
    if not isinstance(record, dict):
        raise ProblemError(f"{path}: the record of the robot is damaged")
    return record


def packaged(package: str, ending: str) -> Path:
    """A file of an installed distribution.

    Raises:
        FileNotFoundError: The distribution is not installed, or has no such file; says what to install.
    """
    try:
        owner = distribution(package)
    except PackageNotFoundError:
        raise FileNotFoundError(f"{ending} comes with the package {package!r}: pip install {package}") from None
    found = [file for file in owner.files or [] if f"/{file.as_posix()}".endswith(f"/{ending}")]
    if not found:
        raise FileNotFoundError(f"the installed package {package!r} has no file {ending}: pip install -U {package}")
    return Path(str(owner.locate_file(found[0])))


def play(
    plan: Path,
    urdf: Path | None = None,
    *,
    options: Mapping[str, Any] | None = None,
    joints: str | None = None,
    base: str | None = None,
    joint_names: Sequence[str] | None = None,
    translation: Any = None,
    rotation: Any = None,
) -> Played:
    """Read a plan and its robot.

    What is not given is taken from the plan's record (save_plan); without one, the robot is read with the defaults of
    Robot.from_urdf and the states are called "joints" and "base", or are the only ones of a fitting size.

    Args:
        plan: File of `Solution.save` or save_plan.
        urdf: The robot; the file that the record names if None.
        options: Of Robot.from_urdf; they go before those of the record, locked joints one by one.
        joints, base: Names of the states.
        joint_names: Of the columns of the joints' state; the robot's own order if neither given nor recorded.
        translation, rotation: Of a fixed base.

    Raises:
        ProblemError: No plan, no fitting state, or joints of other names than the robot's.
        FileNotFoundError: No such file.
        ModelError: The URDF cannot be read so.
    """
    solution, record = Solution.load(plan), read_record(plan)
    given = dict(options or {})
    settings = {**(record.get("options") or {}), **given}
    if "lock" in given:
        settings["lock"] = {**((record.get("options") or {}).get("lock") or {}), **(given["lock"] or {})}
    if urdf is None:
        if not record.get("package"):
            raise ProblemError(f"{plan} does not say of which robot it is; give its URDF file")
        urdf = packaged(*record["package"])
    try:
        robot = Robot.from_urdf(urdf, **settings)
    except TypeError as error:
        raise ProblemError(f"{plan}: options {settings} are not those of Robot.from_urdf: {error}") from error
    state, base_state = _states(plan, solution, robot, joints or record.get("joints"), base or record.get("base"))
    recorded = record.get("joint_names") if state == record.get("joints") else None
    columns = _columns(plan, robot, joint_names or recorded, solution.states[state].shape[1])
    place = translation if translation is not None else record.get("translation", np.zeros(3))
    turn = rotation if rotation is not None else record.get("rotation", np.eye(3))
    return Played(robot, solution, Path(urdf), state, base_state, columns, np.array(place), np.array(turn))


def _states(
    plan: Path, solution: Solution, robot: Robot, joints: str | None, base: str | None
) -> tuple[str, str | None]:
    """Names of the states of the joints and of the base."""
    sizes = {name: values.shape[1] for name, values in solution.states.items()}
    for name in (joints, base):
        if name is not None and name not in sizes:
            raise ProblemError(f"{plan} has no state {name!r}; its states and their sizes are {sizes}")
    if joints is None:
        fitting = [name for name, size in sizes.items() if size == robot.dof and name != base]
        joints = "joints" if "joints" in sizes else fitting[0] if len(fitting) == 1 else None
        if joints is None:
            raise ProblemError(
                f"{plan}: which state holds the {robot.dof} joints {list(robot.joint_names)}? The states and their "
                f"sizes are {sizes}; name it (--joints), and lock the joints that the plan does not move (--lock)"
            )
    if base is None and "base" in sizes and joints != "base":
        base = "base"
    if base == joints:
        raise ProblemError(f"{plan}: state {joints!r} cannot be both the joints and the base")
    if base is not None and sizes[base] not in BASES:
        raise ProblemError(f"{plan}: state {base!r} has {sizes[base]} entries, a base has one of {BASES}")
    return joints, base if base is not None and sizes[base] else None


def _columns(plan: Path, robot: Robot, names: Sequence[str] | None, size: int) -> tuple[int, ...]:
    own = list(robot.joint_names)
    named = own if names is None else list(names)
    if len(set(named)) < len(named):
        raise ProblemError(f"{plan}: joint names {named} repeat a name")
    missing = [name for name in own if name not in named]
    if missing and names is not None:
        raise ProblemError(f"{plan} does not move {missing} of the robot: lock them (--lock {missing[0]}=VALUE)")
    if strange := [name for name in named if name not in own]:
        near = get_close_matches(strange[0], own, 3, 0.0)
        raise ProblemError(f"{plan} moves {strange}, which are no moving joints of {robot.name!r}; near: {near}")
    if size != len(named):
        raise ProblemError(
            f"{plan} has {size} joints, but {robot.name!r} moves {len(own)}: {own}; lock those that the plan does not "
            "move (--lock NAME=VALUE)"
        )
    return tuple(named.index(name) for name in own)
