"""Mutated files for every reader: none crashes, hangs, fills the memory, writes elsewhere or raises what is not ours.

python -m tests.sweep.fuzz [--count 2000] [--only urdf,csv] [--seed 0] [--keep FOLDER]

Valid files are changed at random: bits, pieces, ends, lines, numbers, types, and values that have broken other readers.
Each is read in a forked process of its own, within 2 s of processor time and 500 MB, in a folder whose other files, and
those above it, must not change. A kind of file is one line of KINDS.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import resource
import signal
import struct
import sys
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias
from xml.etree import ElementTree

import casadi as ca
import numpy as np
import yaml
from mcap.writer import CompressionType
from mcap_ros2.writer import Writer

from models import Box, FixedBase, ModelError, MovingObstacle, Robot, Sphere, example_robot, planar_chain
from models.shapes.mesh_files import read_mesh
from models.shapes.pairs import checked_pairs
from ocp import AuditError, Collocation, Plan, Problem, ProblemError, Scene, Solution, SolveError, TipTask, plan, solve
from ocp.app.files import read_gcode, read_trajectory, read_waypoints, write_robot_program
from ocp.app.files.exchange import DEFINITIONS, STATE
from ocp.app.files.settings import read_obstacles
from ocp.app.files.task_file import read_task
from ocp.motion.schedule import JointTrajectory
from tests.ocp.app.motions import NAMES, URDF, smooth
from tests.ocp.motion.plan.test_path_plan import path
from tests.ocp.motion.plan.test_segmented_plan import segmented_plan

Random: TypeAlias = np.random.Generator
Mutator: TypeAlias = Callable[[bytes, Random], bytes]

SECONDS, BYTES = 2, 500 * 2**20
"""Of processor time, and of memory beyond what a process has before it reads."""
WAITED = 60
"""s, after which a process that uses no time waits for something that does not come."""
OURS = (ModelError, ProblemError, SolveError, AuditError, FileNotFoundError)
"""What may be raised; that a file is not there is said as it is where that is documented."""
OUTCOMES = ("read", "refused", "foreign", "memory", "hang", "crash", "written")
GOOD = ("read", "refused")
VALUES = (
    *[
        "nan",
        "inf",
        "-inf",
        "1e308",
        "-1e308",
        "1e-320",
        "-1",
        "0",
        "2147483648",
        "18446744073709551616",
        "1e9",
        "0x7f",
        "a",
        "null",
        "true",
        "[]",
        "{}",
        "'",
        '"',
        "\\",
        "%s%n",
    ],
    *[
        "../../victim",
        "/dev/zero",
        "/dev/tty",
        "package://a/../../victim",
        "file:///dev/zero",
        "`id>PWNED`",
        "&a;",
        "*a",
        "<<",
        "é",
        "\x00",
        "\u202e",
    ],
    *("", "9" * 400, "A" * 9999, "\x1b[2J", "$(touch PWNED)", "1 2 3", "0 0 0", "1e308 1e308 1e308", "-1 nan inf"),
    "!!python/object/apply:os.system ['touch PWNED']",
    "__import__('os').system('touch PWNED')",
)
"""Crafted: numbers at the ends of their kinds, words of other types, paths that lead elsewhere, code."""
NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
WORD = re.compile(rb"[A-Za-z_][\w.]*")


# ---- mutations -----------------------------------------------------------------------------------------------------


def flipped(data: bytes, rng: Random) -> bytes:
    """One to twenty bits."""
    whole = bytearray(data)
    for place in rng.integers(0, len(whole) or 1, rng.integers(1, 21)):
        if whole:
            whole[place] ^= 1 << int(rng.integers(8))
    return bytes(whole)


def spliced(data: bytes, rng: Random) -> bytes:
    """A piece over or between others."""
    a, b, c, d = sorted(int(k) for k in rng.integers(0, len(data) + 1, 4))
    return data[:a] + data[c:d] + data[b if rng.random() < 0.5 else a :]


def cut(data: bytes, rng: Random) -> bytes:
    return data[: int(rng.integers(0, len(data) + 1))]


def repeated(data: bytes, rng: Random) -> bytes:
    """A piece many times, up to some 100 kB."""
    a, b = sorted(int(k) for k in rng.integers(0, len(data) + 1, 2))
    segment = data[a : a + min(b - a, 200)]
    return data[:a] + segment * int(rng.integers(2, 500)) + data[a:]


def crafted(data: bytes, rng: Random) -> bytes:
    """A number or a word that becomes one of VALUES."""
    results = [*(NUMBER if rng.random() < 0.6 else WORD).finditer(data)]
    if not results:
        return data
    chosen = results[int(rng.integers(len(results)))]
    value = VALUES[int(rng.integers(len(VALUES)))].encode()
    return data[: chosen.start()] + value + data[chosen.end() :]


def shuffled(data: bytes, rng: Random) -> bytes:
    """Lines left out, doubled or exchanged."""
    lines = data.split(b"\n")
    for _ in range(int(rng.integers(1, 4))):
        a, b = (int(k) for k in rng.integers(0, len(lines), 2))
        lines[a : a + 1] = [[], [lines[a]] * 2, [lines[b]]][int(rng.integers(3))]
        lines = lines or [b""]
    return b"\n".join(lines)


def overwritten(data: bytes, rng: Random) -> bytes:
    """Whole numbers or floats of other sizes: counts, lengths and offsets of binary formats."""
    kind, values = [
        ("<I", (0, 1, 2**31 - 1, 2**32 - 1)),
        ("<Q", (0, 2**32, 2**63, 2**64 - 1)),
        ("<H", (0, 2**16 - 1)),
        ("<d", (np.nan, np.inf, 1e308, 5e-324)),
        ("<f", (np.nan, -np.inf, 3e38, 1e-45)),
    ][int(rng.integers(5))]
    segment = struct.pack(kind, values[int(rng.integers(len(values)))])
    place = int(rng.integers(0, max(1, len(data) - len(segment))))
    return data[:place] + segment + data[place + len(segment) :]


BYTES_CHANGED: tuple[Mutator, ...] = (flipped, spliced, cut, repeated, overwritten)
TEXT_CHANGED: tuple[Mutator, ...] = (flipped, spliced, cut, repeated, crafted, crafted, crafted, shuffled)


def mostly(mutator: Mutator) -> tuple[Mutator, ...]:
    return (*[mutator] * 2 * len(TEXT_CHANGED), *TEXT_CHANGED)


def changed_xml(data: bytes, rng: Random) -> bytes:
    """A document that stays well-formed: other attributes and texts, elements that are gone or moved."""
    root = ElementTree.fromstring(data)
    for _ in range(int(rng.integers(1, 4))):
        elements = [*root.iter()]
        one, other = (elements[int(k)] for k in rng.integers(0, len(elements), 2))
        value = VALUES[int(rng.integers(len(VALUES)))].replace("\0", "").replace("\x1b", "")
        what = rng.random()
        if what < 0.6 and one.attrib:
            one.set([*one.attrib][int(rng.integers(len(one.attrib)))], value)
        elif what < 0.7:
            one.text = value
        elif what < 0.8:
            one.tag = other.tag
        elif what < 0.9 and len(one):
            one.remove(one[int(rng.integers(len(one)))])
        elif other is not root and one not in other.iter():
            one.append(other)
    return bytes(ElementTree.tostring(root))


def changed_json(data: bytes, rng: Random) -> bytes:
    return json.dumps(changed_tree(json.loads(data), rng)).encode()


def changed_yaml(data: bytes, rng: Random) -> bytes:
    return str(yaml.safe_dump(changed_tree(yaml.load(data, yaml.CSafeLoader), rng))).encode()


def in_archive(mend: Callable[[dict[str, bytes]], dict[str, bytes]] = lambda members: members) -> tuple[Mutator, ...]:
    """Mutators of members of an archive of arrays, which stays whole; `mend` makes what its members say of each other
    right again, such as digests."""

    def changed(data: bytes, rng: Random) -> bytes:
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                members = {member: archive.read(member) for member in archive.namelist()}
            name = sorted(members)[int(rng.integers(len(members)))]
            array = np.lib.format.read_array(io.BytesIO(members[name]), allow_pickle=False)
        except Exception:  # another mutator broke it before
            return data
        if array.dtype == np.uint8 and array.tobytes()[:1] in (b"{", b"["):
            text = ""
            if rng.random() < 0.7:
                with suppress(ValueError):
                    text = json.dumps(changed_tree(json.loads(array.tobytes()), rng))
            array = np.frombuffer(text.encode() or TEXT_CHANGED[int(rng.integers(8))](array.tobytes(), rng), np.uint8)
        elif rng.random() < 0.5:
            values = np.array([np.nan, np.inf, -1, 0, 2**31, 1e308], dtype=float)
            array = array.copy()
            if array.size:
                with np.errstate(all="ignore"):
                    array.flat[int(rng.integers(array.size))] = values.astype(array.dtype)[int(rng.integers(6))]
        else:
            count = int(rng.integers(0, 2 * array.size + 2))
            array = np.resize(array, (count,) if rng.random() < 0.5 else (count, 1))
        stream = io.BytesIO()
        np.lib.format.write_array(stream, np.ascontiguousarray(array), allow_pickle=False)
        members[name] = stream.getvalue()
        if rng.random() < 0.1:
            del members[sorted(members)[int(rng.integers(len(members)))]]
        whole = io.BytesIO()
        with zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as archive:
            for member, content in mend(members).items():
                archive.writestr(member, content)
        return whole.getvalue()

    return (changed, changed, changed, *BYTES_CHANGED)


def changed_tree(tree: Any, rng: Random) -> Any:
    """A tree of JSON with one part that has another value or type, or is gone."""
    if isinstance(tree, dict | list) and tree and rng.random() < 0.9:
        keys = list(tree) if isinstance(tree, dict) else range(len(tree))
        key = keys[int(rng.integers(len(keys)))]
        copy = type(tree)(tree)
        if rng.random() < 0.1:
            del copy[key]
        else:
            copy[key] = changed_tree(tree[key], rng)
        return copy
    others: tuple[Any, ...] = (
        *VALUES,
        None,
        True,
        -1,
        0,
        1e308,
        float("nan"),
        2**70,
        [],
        {},
        [tree],
        {"a": tree},
        [[]] * 1000,
    )
    return others[int(rng.integers(len(others)))]


# ---- kinds of files ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        suffix: Of its names. make: Contents of a valid file. read: Reads a file; what is made of it is let go.
        mutators: What changes contents.
    """

    suffix: str
    make: Callable[[], bytes]
    read: Callable[[Path], Any]
    mutators: Sequence[Mutator] = TEXT_CHANGED


CUBE = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
FACES = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4)]
GCODE = "G21 G90\nG0 X0 Y0 Z5\nF600\nG1 Z0\nG1 X10\nG2 X20 Y10 I10 J0\nG3 X30 Y20 R10\nG1 X0 Y0 (home)\nG4 P1\nM30\n"
TASK = """[robot]
urdf = "robot.urdf"
tip = "finger"
lock = { slide = 0.1 }
[path]
points = [[0.75, 0.1, 0.3], [0.75, 0.3, 0.3], [0.7, 0.3, 0.3]]
rounding = 0.002
speed = 0.1
acceleration = 1.0
direction = [0, 0, -1]
[limits]
velocity = { elbow = 1.5 }
[search]
kind = "start"
seed = 1
[[obstacle]]
shape = "box"
size = [0.1, 0.1, 0.1]
position = [0.2, -0.5, 0.3]
[output]
csv = "seam.csv"
period = 0.02
"""


def stl() -> bytes:
    corners = [struct.pack("<12fH", 0, 0, 0, *(c for k in face for c in CUBE[k]), 0) for face in FACES]
    return bytes(80) + struct.pack("<I", len(FACES)) + b"".join(corners)


def stl_text() -> bytes:
    facets = [
        "facet normal 0 0 1\nouter loop\n"
        + "\n".join("vertex {} {} {}".format(*CUBE[k]) for k in face)
        + "\nendloop\nendfacet\n"
        for face in FACES
    ]
    return ("solid cube\n" + "".join(facets) + "endsolid\n").encode()


def obj() -> bytes:
    lines = ["mtllib cube.mtl", *("v {} {} {}".format(*c) for c in CUBE), "usemtl red"]
    return "\n".join([*lines, *("f {} {} {}".format(*(k + 1 for k in face)) for face in FACES), ""]).encode()


def dae() -> bytes:
    places = " ".join(str(c) for corner in CUBE for c in corner)
    corners = " ".join(str(k) for face in FACES for k in face)
    return f"""<?xml version="1.0"?><COLLADA><asset><unit meter="0.01"/></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="24">{places}</float_array><technique_common><accessor source="#a" count="8"
stride="3"><param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/></accessor>
</technique_common></source><vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="{len(FACES)}"><input semantic="VERTEX" source="#v" offset="0"/><p>{corners}</p></triangles></mesh>
</geometry></library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">
<matrix>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</matrix><rotate>0 0 1 30</rotate><instance_geometry url="#g"/></node>
<node><instance_node url="#n"/></node>
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>""".encode()


@cache
def motion() -> JointTrajectory:
    t, q, v, a = (part[::40] for part in smooth())
    return JointTrajectory(NAMES, t, q, v, a)


def table() -> bytes:
    rows = np.column_stack([motion().t, motion().positions, motion().velocities])
    head = ["time [s]", *NAMES, *(f"{name}.velocity" for name in NAMES)]
    return "\n".join([",".join(head), *(",".join(map(repr, row)) for row in rows.tolist()), ""]).encode()


def sampled() -> bytes:
    with TemporaryDirectory() as folder:
        motion().write_csv(f"{folder}/a.csv")
        return Path(folder, "a.csv").read_bytes()


def log(packed: CompressionType) -> bytes:
    stream = io.BytesIO()
    writer: Any = Writer(stream, chunk_size=1000, compression=packed)
    schema = writer.register_msgdef(STATE, DEFINITIONS[STATE])
    for t, q, v in zip(motion().t, motion().positions.tolist(), motion().velocities.tolist(), strict=True):
        header = {"stamp": {"sec": int(t), "nanosec": int(t % 1 * 1e9)}, "frame_id": ""}
        state = {"header": header, "name": list(NAMES), "position": q, "velocity": v, "effort": []}
        writer.write_message("/joint_states", schema, state, int(t * 1e9))
    writer.finish()
    return stream.getvalue()


def program(suffix: str) -> Callable[[], bytes]:
    """A program of an industrial robot of six joints."""

    def contents() -> bytes:
        with TemporaryDirectory() as folder:
            file = Path(folder) / f"motion{suffix}"
            arm = example_robot("six_axis")
            q = np.tile(motion().positions[:, :3], 2)
            write_robot_program(JointTrajectory(tuple(arm.joint_names), motion().t, q, q, q), file, robot=arm)
            return file.read_bytes()

    return contents


def waypoints() -> bytes:
    rows = [(0.1 * k, 0.2, 0.3, 0, 0.1 * k, 1) for k in range(8)]
    return "\n".join(["x,y,z [m],ax,ay,az", *(",".join(map(str, row)) for row in rows)]).encode()


SRDF = "<robot name='bars'>" + "".join(
    f"<disable_collisions link1='{a}' link2='{b}' reason='Never'/>" for a, b in (("upper", "hand"), ("fore", "finger"))
)


@cache
def bars() -> Robot:
    return Robot.from_urdf(URDF)


def read_robot(file: Path) -> Any:
    robot = Robot.from_urdf(file)
    return Robot.from_urdf(robot.to_urdf()), FixedBase(robot)


def saved(thing: Plan | Solution) -> bytes:
    with TemporaryDirectory() as folder:
        thing.save(Path(folder) / "thing.npz")
        return (Path(folder) / "thing.npz").read_bytes()


@cache
def plan_file() -> bytes:
    """A plan among obstacles that stand and move."""
    arm = FixedBase(planar_chain([0.5, 0.4, 0.3], [1.0] * 3))
    ball = MovingObstacle(Sphere(0.05, (0, 0, 0)), lambda time: (2.0, 1.0 + 0.3 * time, 0.0))
    around = [ball, Box((0.1, 0.1, 0.1), position=(0, -2, 0))]
    task = TipTask(rows=(3, 4), velocity=(-0.05, 0.02))
    return saved(plan(arm, task, 1.0, start=(0.3, 0.6, 0.5), scene=Scene(obstacles=around), search="start"))


@cache
def solution_file() -> bytes:
    """A solution whose problem calls tables, splines, a linear system, an integrator and other functions."""
    grid = np.linspace(-3.0, 3.0, 9)
    table = ca.interpolant("table", "linear", [grid], grid**2)
    spline = ca.interpolant("spline", "bspline", [grid], np.cosh(grid))
    decay = {"x": (y := ca.MX.sym("y")), "p": (rate := ca.MX.sym("p")), "ode": -y * rate}
    run = ca.integrator("run", "rk", decay, 0.0, 1.0, {"number_of_finite_elements": 2})
    problem = Problem("calls", ca.MX)
    x, u = problem.state("x", 2, initial=[1.0, 0.5]), problem.control("u", 2)
    cell = ca.low(ca.DM(grid), x[0])
    problem.dynamics(x, ca.solve(ca.MX(ca.DM([[2.0, 1.0], [1.0, 3.0]])) + ca.diag(x**2), u))
    problem.horizon(1.0)
    problem.path("limits", u, lower=-9, upper=9)
    running = spline(x[0]) + table(x[1]) + run(x0=x[0], p=1.0)["xf"] ** 2 + 1e-3 * cell + ca.sumsqr(u)
    problem.minimize(running=running)
    return saved(solve(problem, Collocation(3)))


KINDS: dict[str, Kind] = {
    "plan": Kind(".npz", plan_file, lambda file: Plan.load(file).audit(), in_archive()),
    "path": Kind(".npz", lambda: saved(path()), lambda file: Plan.load(file).audit(), in_archive()),
    "segments": Kind(".npz", lambda: saved(segmented_plan()), lambda file: Plan.load(file).audit(), in_archive()),
    # the audit of a problem whose dynamics were changed into stiff ones may rightly take longer than a reader
    "solution": Kind(".npz", solution_file, Solution.load, in_archive()),
    "urdf": Kind(".urdf", URDF.encode, read_robot, mostly(changed_xml)),
    "srdf": Kind(
        ".srdf", (SRDF + "</robot>").encode, lambda file: checked_pairs(bars(), [], srdf=file), mostly(changed_xml)
    ),
    "stl": Kind(".stl", stl, read_mesh, BYTES_CHANGED),
    "stl text": Kind(".stl", stl_text, read_mesh),
    "obj": Kind(".obj", obj, read_mesh),
    "dae": Kind(".dae", dae, read_mesh, mostly(changed_xml)),
    "gcode": Kind(".ngc", GCODE.encode, read_gcode),
    "waypoints": Kind(".csv", waypoints, lambda file: read_waypoints(file).smooth(1e-3)),
    "csv": Kind(".csv", table, read_trajectory),
    "sampled": Kind(".csv", sampled, JointTrajectory.read_csv),
    "json": Kind(".json", lambda: json.dumps(motion().to_ros()).encode(), read_trajectory, mostly(changed_json)),
    "yaml": Kind(".yaml", lambda: yaml.safe_dump(motion().to_ros()).encode(), read_trajectory, mostly(changed_yaml)),
    "mcap": Kind(".mcap", lambda: log(CompressionType.NONE), read_trajectory, BYTES_CHANGED),
    "mcap zstd": Kind(".mcap", lambda: log(CompressionType.ZSTD), read_trajectory, BYTES_CHANGED),
    "mcap lz4": Kind(".mcap", lambda: log(CompressionType.LZ4), read_trajectory, BYTES_CHANGED),
    **{
        name: Kind(name, program(name), lambda file: read_trajectory(file, period=0.1))
        for name in (".script", ".src", ".mod")
    },
    "task": Kind(".toml", TASK.encode, read_task),
    "obstacles": Kind(".toml", TASK[TASK.index("[[ob") : TASK.index("[out")].encode, read_obstacles),
}


# ---- one file, in a process of its own -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Trial:
    """What became of a file: one of OUTCOMES, and what was raised or found."""

    outcome: str
    words: str = ""


def planted(folder: Path) -> Path:
    """A folder to read files in, with others beside and above it that nobody may change."""
    place = folder / "far" / "in"
    place.mkdir(parents=True)
    for file in (folder / "victim", folder / "far" / "victim", place / "victim", place / "seam.csv"):
        file.write_text("mine")
    (place / "robot.urdf").write_text(URDF)
    (place / "cube.mtl").write_text("newmtl red\nKd 1 0 0\n")
    return place


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def tried(kind: Kind, data: bytes, place: Path) -> Trial:
    """Read a file with these contents in a planted folder."""
    file, root = place / f"file{kind.suffix}", place.parents[1]
    file.write_bytes(data)
    before = contents(root)
    source, sink = os.pipe()
    child = os.fork()
    if not child:
        os.close(source)
        _read_in_child(kind, file, sink)
    os.close(sink)
    with os.fdopen(source, "rb") as stream:
        report = stream.read().decode(errors="replace")
    _, status = os.waitpid(child, 0)
    after = contents(root)
    if after != before:
        changed = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
        for name in changed:
            (root / name).write_bytes(before[name]) if name in before else (root / name).unlink()
        return Trial("written", ", ".join(changed))
    if os.WIFSIGNALED(status):
        name = signal.Signals(os.WTERMSIG(status)).name
        return Trial("hang" if name in ("SIGPROF", "SIGALRM", "SIGXCPU") else "crash", f"{name} {report}")
    outcome, _, words = report.partition("\n")
    return Trial(outcome, words) if outcome in OUTCOMES else Trial("crash", f"status {status} {report}")


def _read_in_child(kind: Kind, file: Path, sink: int) -> None:
    outcome, words = "read", ""
    try:
        os.chdir(file.parent)
        os.environ["HOME"], os.environ["XDG_CACHE_HOME"] = str(file.parents[2]), str(file)  # where nothing can be kept
        pages = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (pages + BYTES, pages + BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for number in (signal.SIGPROF, signal.SIGALRM):
            signal.signal(number, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        signal.alarm(WAITED)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            kind.read(file)
    except OURS as error:
        outcome, words = "refused", str(error)[:200]
    except MemoryError:
        outcome = "memory"
    except BaseException:
        outcome, words = "foreign", traceback.format_exc()[-3000:]
    os.write(sink, f"{outcome}\n{words}".encode(errors="replace"))
    os._exit(0)


def trials(kind: Kind, count: int, seed: int) -> Iterator[tuple[bytes, Trial]]:
    """Mutated files and what became of them; one in four is changed more than once."""
    valid, rng = kind.make(), np.random.default_rng(seed)
    with TemporaryDirectory() as folder:
        place = planted(Path(folder))
        yield valid, tried(kind, valid, place)
        for _ in range(count):
            data = valid
            for _ in range(1 if rng.random() < 0.75 else int(rng.integers(2, 5))):
                with suppress(
                    ElementTree.ParseError, yaml.YAMLError, ValueError, zipfile.BadZipFile
                ):  # of what is broken by now
                    data = kind.mutators[int(rng.integers(len(kind.mutators)))](data, rng)
            yield data, tried(kind, data, place)


def fuzzed(name: str, count: int, seed: int, keep: Path | None = None) -> Counter[str]:
    """Count the outcomes of a kind; print what is not good, and keep its files in a folder."""
    result: Counter[str] = Counter()
    for number, (data, trial) in enumerate(trials(KINDS[name], count, seed)):
        result[trial.outcome] += 1
        if trial.outcome not in GOOD or (not number and trial.outcome != "read"):
            print(f"{name} {number}: {trial.outcome}: {trial.words}", file=sys.stderr)
            if keep is not None:
                keep.mkdir(parents=True, exist_ok=True)
                (keep / f"{name.replace(' ', '_')}-{number}{KINDS[name].suffix}").write_bytes(data)
    return result


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--count", type=int, default=2000, help="mutated files of each kind (default: 2000)")
    options.add_argument("--only", default=",".join(KINDS), help=f"kinds: {', '.join(KINDS)} (default: all)")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--keep", type=Path, help="folder for files that are not read as they should be")
    arguments = options.parse_args()
    bad = 0
    print(f"{'':12}" + "".join(f"{outcome:>9}" for outcome in OUTCOMES))
    for name in arguments.only.split(","):
        result = fuzzed(name, arguments.count, arguments.seed, arguments.keep)
        bad += sum(count for outcome, count in result.items() if outcome not in GOOD)
        print(f"{name:12}" + "".join(f"{result[outcome]:9}" for outcome in OUTCOMES), flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
