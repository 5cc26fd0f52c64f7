"""A page that plays motions: robots as they look, paths, curves with limits and a time cursor, the audit.

The page holds all it needs, geometry and script, and its policy forbids the browser to ask any host for anything: it
plays from a file, without a server. What `selfmotion view` serves is the same page.

Scene and curves are drawn by scripts of our own (ocp/app/page/): the clients of viewer libraries play recordings, but
offer neither the time that they show nor a way to set it, which curves beside them need, and weigh more than this page.

A page served on this machine alone, until Ctrl-C.

A request must name this machine as its host: the page of a stranger whose own name was made to lead here names another.
"""

from __future__ import annotations

import base64
import errno
import gzip
import json
import re
from collections.abc import Sequence
from html import escape
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from threading import Event, Thread
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from models import Robot
from models.arrays import Array
from models.spatial import quaternion_from_rotation
from ocp.app.view.animation import PAGE_SETTINGS, Animation
from ocp.app.view.appearance import TIP_FRAME, Appearance, Frames, appearance_of, frames_along
from ocp.errors import ProblemError

__all__ = ["Buffers", "Page", "PageServer", "build_page", "unpack_page"]

SCRIPTS = ("scene.js", "curves.js", "player.js")


class Buffers:
    """Arrays one after the other, which a description refers to by their place."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0

    def put(self, values: Any, kind: str) -> dict[str, Any]:
        """Keep an array as numbers of a kind, "f4", "u2", "i1", "u4"; what a description holds instead."""
        array = np.ascontiguousarray(values, dtype=f"<{kind}" if kind != "i1" else kind)
        data = array.tobytes()
        told = {"at": self.size, "kind": kind, "shape": list(array.shape)}
        data += b"\0" * (-len(data) % 4)
        self.parts.append(data)
        self.size += len(data)
        return told


class Page(NamedTuple):
    """A page.

    Attributes:
        text: HTML.
        missing: Meshes that it does not show, as the descriptions name them, and why.
    """

    text: str
    missing: dict[str, str]


def build_page(
    shown: Sequence[Animation], *, title: str = "", folders: Sequence[Any] = (), meshes: bool = True
) -> Page:
    """The page of one motion, or of several, the first held against the others.

    Args:
        shown: The motions.
        title: The first motion's name if "".
        folders: Where meshes are looked for first.
        meshes: Whether files of meshes are read; else what links touch with is shown.

    Raises:
        ProblemError: Nothing to show, or a page that is too large.
    """
    if not shown:
        raise ProblemError("a page shows at least one motion", name="shown", value=0)
    buffers = Buffers()
    robots: list[tuple[Robot, dict[str, Any]]] = []
    motions, missing = [], dict[str, str]()
    for one in shown:
        robot = one.machine.robot
        number = next((k for k, (known, _) in enumerate(robots) if _alike(known, robot)), None)
        if number is None:
            looks = appearance_of(robot, folders, meshes=meshes)
            missing |= looks.missing
            robots.append((robot, _robot(robot, looks, buffers)))
            number = len(robots) - 1
        motions.append({**_motion(one, buffers), "robot": number})
    name = title or shown[0].name
    told = {"title": name, "robots": [one for _, one in robots], "motions": motions, "missing": missing}
    head = json.dumps(told, allow_nan=False, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    whole = len(head).to_bytes(4, "little") + head + b"".join(buffers.parts)
    data = base64.b64encode(gzip.compress(whole, 9, mtime=0)).decode()
    text = _filled(name, shown[0], data)
    size, most = len(text.encode()), PAGE_SETTINGS.most_bytes
    if size > most:
        words = f"the page has {size / 1e6:.3g} MB, at most {most / 1e6:g} are written; show fewer motions"
        raise ProblemError(words, name="page", value=size, limit=most)
    return Page(text, missing)


def unpack_page(text: str) -> tuple[dict[str, Any], dict[int, NDArray[Any]]]:
    """What a page holds: its description, and the arrays by their places."""
    mark = '<script id="data" type="text/plain">'
    begin = text.index(mark) + len(mark)
    whole = gzip.decompress(base64.b64decode(text[begin : text.index("</script>", begin)]))
    size = int.from_bytes(whole[:4], "little")
    told, body = json.loads(whole[4 : 4 + size]), whole[4 + size :]
    arrays: dict[int, NDArray[Any]] = {}

    def look(value: Any) -> None:
        if isinstance(value, dict) and set(value) == {"at", "kind", "shape"}:
            count = int(np.prod(value["shape"]))
            found = np.frombuffer(body, f"<{value['kind']}" if value["kind"] != "i1" else "i1", count, value["at"])
            arrays[value["at"]] = found.reshape(value["shape"])
        elif isinstance(value, dict):
            for part in value.values():
                look(part)
        elif isinstance(value, list):
            for part in value:
                look(part)

    look(told)
    return told, arrays


def _filled(title: str, first: Animation, data: str) -> str:
    """The page's text."""
    source = files("ocp.app.view").joinpath("page")
    text = source.joinpath("page.html").read_text(encoding="utf-8")
    script = "\n".join(source.joinpath(name).read_text(encoding="utf-8") for name in SCRIPTS)
    style = source.joinpath("page.css").read_text(encoding="utf-8")
    given = {"TITLE": escape(title), "STYLE": style, "SCRIPT": script, "DATA": data, "VERDICT": escape(first.verdict)}
    return re.sub(f"@({'|'.join(given)})@", lambda mark: given[mark[1]], text)


def _alike(one: Robot, other: Robot) -> bool:
    """Whether two robots look the same."""
    if one is other:
        return True
    names = [[part.name for part in robot.links] for robot in (one, other)]
    if names[0] != names[1] or one.tip != other.tip or not np.array_equal(one.tip_translation, other.tip_translation):
        return False
    looks = [
        [(shape.kind, shape.file, tuple(np.ravel(shape.translation))) for link in robot.links for shape in link.visuals]
        for robot in (one, other)
    ]
    return looks[0] == looks[1] and all(a.moves == b.moves for a, b in zip(one.joints, other.joints, strict=True))


def _carriers(robot: Robot) -> dict[str, tuple[str, Array, Array]]:
    """Of each link the moving link that it is fixed to, or the root, and its placement there."""
    found = {robot.root: (robot.root, np.eye(3), np.zeros(3))}
    for joint in robot.joints:
        if joint.moves:
            found[joint.child] = (joint.child, np.eye(3), np.zeros(3))
            continue
        carrier, turn, shift = found[joint.parent]
        found[joint.child] = (carrier, turn @ joint.rotation, shift + turn @ np.asarray(joint.translation))
    return found


def _movers(robot: Robot) -> list[str]:
    return [robot.root, *(joint.child for joint in robot.joints if joint.moves)]


def _robot(robot: Robot, looks: Appearance, buffers: Buffers) -> dict[str, Any]:
    """Surfaces, in the frames of the links that move."""
    carriers, movers = _carriers(robot), _movers(robot)
    parts = []
    for part in looks.parts:
        carrier, turn, shift = carriers[part.link]
        parts.append(
            {
                "mover": movers.index(carrier),
                "link": part.link,
                "color": [round(float(value), 4) for value in part.color],
                **_surface(part.vertices @ turn.T + shift, part.normals @ turn.T, part.faces, buffers),
            }
        )
    return {"name": robot.name, "movers": movers, "parts": parts}


def _surface(vertices: Array, normals: Array, faces: NDArray[np.intp], buffers: Buffers) -> dict[str, Any]:
    """Corners to a 65535th of the size of their box, normals to a 127th."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    step = np.maximum(high - low, 1e-9) / 65535
    padded = np.zeros((len(vertices), 4))
    padded[:, :3] = np.round((vertices - low) / step)
    turned = np.zeros((len(normals), 4))
    turned[:, :3] = np.round(normals * 127)
    return {
        "low": low.tolist(),
        "step": step.tolist(),
        "vertices": buffers.put(padded, "u2"),
        "normals": buffers.put(turned, "i1"),
        "faces": buffers.put(faces, "u2" if len(vertices) < 65536 else "u4"),
    }


def _poses(frames: Frames, names: Sequence[str]) -> Array:
    """Positions and quaternions, each no farther from the one before than its opposite. Shape (M, k, 7)."""
    found = []
    for name in names:
        turns = quaternion_from_rotation(frames.rotations[name])
        flips = np.where((turns[1:] * turns[:-1]).sum(axis=1) < 0, -1.0, 1.0)
        turns[1:] *= np.cumprod(flips)[:, None]
        found.append(np.column_stack([frames.positions[name], turns]))
    return np.stack(found, axis=1)


def _motion(one: Animation, buffers: Buffers) -> dict[str, Any]:
    rows = np.unique(np.linspace(0, len(one.t) - 1, min(len(one.t), PAGE_SETTINGS.poses)).round().astype(int))
    frames = frames_along(one.machine, one.joints[rows], one.base[rows])
    tip = one.machine.robot.tip is not None
    before = np.vstack([*frames.positions.values()])
    movers = _movers(one.machine.robot)
    around = []
    for number, obstacle in enumerate(one.around):
        mover = None
        if obstacle.rotations is not None and obstacle.positions is not None:
            mover, name = len(movers), f"what moves by itself, {number}"
            movers.append(name)
            frames.rotations[name], frames.positions[name] = obstacle.rotations[rows], obstacle.positions[rows]
        around.append({**_solid(*obstacle.solid(before), buffers), "mover": mover})
    names = [*movers, *([TIP_FRAME] if tip else [])]
    told: dict[str, Any] = {
        "name": one.name,
        "verdict": one.verdict,
        "passed": one.passed,
        "cost": one.cost,
        "horizon": float(one.t[-1]),
        "t": buffers.put(one.t[rows], "f4"),
        "poses": buffers.put(_poses(frames, names), "f4"),
        "tip": tip,
        "floats": bool(one.machine.base_size),
        "time": buffers.put(one.t, "f4"),
        "curves": [
            {
                "group": curve.group,
                "name": curve.name,
                "unit": curve.unit,
                "values": buffers.put(curve.values, "f4"),
                "lower": float(curve.lower) if np.isfinite(curve.lower) else None,
                "upper": float(curve.upper) if np.isfinite(curve.upper) else None,
            }
            for curve in one.curves
        ],
        "targets": [
            {
                "t": buffers.put(target.t, "f4"),
                "position": buffers.put(target.position, "f4"),
                "rotation": buffers.put(target.rotation.reshape(-1, 9), "f4"),
            }
            for target in one.targets
            if np.isfinite(target.position).any()
        ],
        "around": around,
        "rows": [
            [row.name, _plain(row.value), _plain(row.limit), row.unit, _plain(row.time), row.verdict, row.note]
            for row in one.rows
        ],
    }
    if one.footing is not None:
        told["footing"] = {
            "corners": one.footing.corners.tolist(),
            "points": buffers.put(one.footing.points, "f4"),
            "forces": one.footing.forces,
        }
    if one.near is not None:
        bodies = list(dict.fromkeys(one.near.bodies))
        told["near"] = {
            "t": buffers.put(one.near.t, "f4"),
            "points": buffers.put(one.near.points, "f4"),
            "distances": buffers.put(one.near.distances, "f4"),
            "bodies": [list(pair) for pair in bodies],
            "which": [bodies.index(pair) for pair in one.near.bodies],
        }
    return told


def _solid(vertices: Array, faces: NDArray[np.intp], buffers: Buffers) -> dict[str, Any]:
    from ocp.app.view.appearance import part_of

    part = part_of("", vertices, faces, (0.0, 0.0, 0.0, 1.0))
    return _surface(part.vertices, part.normals, part.faces, buffers)


def _plain(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)


TRIED = 20
"""Ports after the one that is wanted."""
HOST = "127.0.0.1"


class PageServer:
    """A page on a server, which runs as long as the block.

    Attributes:
        address: Where a browser finds it.
    """

    def __init__(self, text: str, port: int = 0) -> None:
        """Listen, on the port or the next that is free; 0 for any.

        Raises:
            ProblemError: No port is free, or it is none.
        """
        self._server = _listening(text.encode(), port)
        self.address = f"http://{HOST}:{self._server.server_address[1]}"
        self._thread = Thread(target=self._server.serve_forever, name="page", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._server.server_close()

    def wait(self) -> None:
        """Until Ctrl-C, which ends it and goes no further."""
        try:
            Event().wait()
        except KeyboardInterrupt:
            return


def _listening(page: bytes, port: int) -> ThreadingHTTPServer:
    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            known = (self.headers.get("Host") or "").rpartition(":")[0] in (HOST, "localhost")
            found = known and self.path.partition("?")[0] == "/"
            self.send_response(200 if found else 404 if known else 421)
            self.send_header("Content-Type", "text/html; charset=utf-8" if found else "text/plain")
            self.send_header("Content-Length", str(len(page) if found else 0))
            self.end_headers()
            if found:
                self.wfile.write(page)

        def log_message(self, *words: object) -> None:
            """Nothing: who serves a page to himself reads no log."""

    if not 0 <= port < 65536:
        raise ProblemError(f"port {port} is none, 0 to 65535", name="port", value=port, limit=(0, 65535))
    for tried in range(port, min(port + TRIED, 65536)) if port else (0,):
        try:
            return ThreadingHTTPServer((HOST, tried), Answer)
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
    words = f"no port from {port} to {port + TRIED - 1} is free; name another one: --port 0 takes any"
    raise ProblemError(words, name="port", value=port)
