"""Create a web page that plays motions and shows their curves and audits, and serve the page on this machine.

The page contains its geometry and scripts (ocp/app/view/page/), and its policy forbids requests to any host, so that it
plays from a file without a server. Clients of viewer libraries neither report the displayed time nor let it be set,
which the cursor of the curves needs. A request to the server must name this machine as its host, which excludes the
page of a stranger whose domain resolves to this machine.
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
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from models import Robot
from models.checks import Array
from models.spatial import quaternion_from_rotation
from ocp.app.files.waypoints import align_signs
from ocp.app.view.animation import PAGE_SETTINGS, Animation
from ocp.app.view.appearance import TIP_FRAME, Appearance, Frames, appearance_of, frames_along, part_of
from ocp.errors import ProblemError

SCRIPTS = ("scene.js", "curves.js", "player.js")


class Buffers:
    """Numerical data of a page: arrays in one block of bytes, in which an array is identified by its offset."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0

    def put(self, values: Any, kind: str) -> dict[str, Any]:
        """Append an array to the data of the page, as the NumPy type `kind` such as "f4"; return a reference to it."""
        array = np.ascontiguousarray(values, dtype=f"<{kind}" if kind != "i1" else kind)
        data = array.tobytes()
        reference = {"at": self.size, "kind": kind, "shape": list(array.shape)}
        data += b"\0" * (-len(data) % 4)
        self.parts.append(data)
        self.size += len(data)
        return reference


class Page(NamedTuple):
    """A web page that plays a motion: its HTML, and by file the reasons why meshes are not shown."""

    text: str
    missing: dict[str, str]


def build_page(
    shown: Sequence[Animation],
    *,
    title: str = "",
    folders: Sequence[Any] = (),
    meshes: bool = True,
    workpiece: tuple[Array, NDArray[np.intp]] | None = None,
) -> Page:
    """Return the page that plays one motion, or several motions for comparison.

    `folders` are searched first for meshes; if `meshes` is false, collision shapes are shown. `workpiece` is another
    body to show: vertices (k, 3) in world, m, and triangles (f, 3).

    Raises:
        ProblemError: There is no motion, or the page is too large.
    """
    if not shown:
        raise ProblemError("a page shows at least one motion", name="shown", value=0)
    buffers = Buffers()
    robots: list[tuple[Robot, dict[str, Any]]] = []
    motions, missing = [], dict[str, str]()
    for motion in shown:
        robot = motion.machine.robot
        number = next((k for k, (known, _) in enumerate(robots) if _look_alike(known, robot)), None)
        if number is None:
            appearance = appearance_of(robot, folders, meshes=meshes)
            missing |= appearance.missing
            robots.append((robot, _robot(robot, appearance, buffers)))
            number = len(robots) - 1
        motions.append({**_motion(motion, buffers), "robot": number})
        if workpiece is not None:
            motions[-1]["around"].append({**_solid(*workpiece, buffers), "mover": None})
    name = title or shown[0].name
    description = {"title": name, "robots": [motion for _, motion in robots], "motions": motions, "missing": missing}
    head = json.dumps(description, allow_nan=False, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    data_bytes = len(head).to_bytes(4, "little") + head + b"".join(buffers.parts)
    text = _fill_template(name, shown[0], base64.b64encode(gzip.compress(data_bytes, 9, mtime=0)).decode())
    size, most = len(text.encode()), PAGE_SETTINGS.most_bytes
    if size > most:
        words = f"the page has {size / 1e6:.3g} MB, at most {most / 1e6:g} are allowed; show fewer motions"
        raise ProblemError(words, name="page", value=size, limit=most)
    return Page(text, missing)


def _fill_template(title: str, first: Animation, data: str) -> str:
    """Return the HTML text of the page: the template with title, style, scripts and data inserted."""
    source = files("ocp.app.view").joinpath("page")
    text = source.joinpath("page.html").read_text(encoding="utf-8")
    script = "\n".join(source.joinpath(name).read_text(encoding="utf-8") for name in SCRIPTS)
    style = source.joinpath("page.css").read_text(encoding="utf-8")
    fields = {"TITLE": escape(title), "STYLE": style, "SCRIPT": script, "DATA": data, "VERDICT": escape(first.verdict)}
    return re.sub(f"@({'|'.join(fields)})@", lambda match: fields[match[1]], text)


def _look_alike(a: Robot, b: Robot) -> bool:
    """Return whether two robots look the same, so that they can share one set of surfaces."""
    if a is b:
        return True
    names = [[part.name for part in robot.links] for robot in (a, b)]
    if names[0] != names[1] or a.tip != b.tip or not np.array_equal(a.tip_translation, b.tip_translation):
        return False
    looks = [
        [(shape.kind, shape.file, tuple(np.ravel(shape.translation))) for link in robot.links for shape in link.visuals]
        for robot in (a, b)
    ]
    return looks[0] == looks[1]


def _robot(robot: Robot, appearance: Appearance, buffers: Buffers) -> dict[str, Any]:
    """Return a robot as JSON data of the web page: its surfaces, in the frames of its links, with their colours."""
    movers = [link.name for link in robot.links]
    parts = [
        {
            "mover": movers.index(part.link),
            "link": part.link,
            "color": [round(float(value), 4) for value in part.color],
            **_surface(part.vertices, part.normals, part.faces, buffers),
        }
        for part in appearance.parts
    ]
    return {"name": robot.name, "movers": movers, "parts": parts}


def _surface(vertices: Array, normals: Array, faces: NDArray[np.intp], buffers: Buffers) -> dict[str, Any]:
    """Return a surface as JSON data of the web page, with vertices rounded to 1/65535 of its bounding box."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    step = np.maximum(high - low, 1e-9) / 65535
    padded = np.zeros((len(vertices), 4))
    padded[:, :3] = np.round((vertices - low) / step)
    padded_normals = np.zeros((len(normals), 4))
    padded_normals[:, :3] = np.round(normals * 127)
    return {
        "low": low.tolist(),
        "step": step.tolist(),
        "vertices": buffers.put(padded, "u2"),
        "normals": buffers.put(padded_normals, "i1"),
        "faces": buffers.put(faces, "u2" if len(vertices) < 65536 else "u4"),
    }


def _poses(frames: Frames, names: Sequence[str]) -> Array:
    """Return the poses of k frames: positions, and quaternions with signs that do not jump in time. Shape (M, k, 7)."""
    poses = []
    for name in names:
        quaternions = align_signs(quaternion_from_rotation(frames.rotations[name]))
        poses.append(np.column_stack([frames.positions[name], quaternions]))
    return np.stack(poses, axis=1)


def _motion(motion: Animation, buffers: Buffers) -> dict[str, Any]:
    """Return a motion as JSON data of the web page; arrays are appended to the binary data `buffers`."""
    rows = np.unique(np.linspace(0, len(motion.t) - 1, min(len(motion.t), PAGE_SETTINGS.poses)).round().astype(int))
    frames = frames_along(motion.machine, motion.joints[rows], motion.base[rows])
    tip = motion.machine.robot.tip is not None
    points = np.vstack([*frames.positions.values()])
    movers = [link.name for link in motion.machine.robot.links]
    obstacles = []
    for number, obstacle in enumerate(motion.obstacles):
        mover = None
        if obstacle.rotations is not None and obstacle.positions is not None:
            mover, name = len(movers), f"what moves by itself, {number}"
            movers.append(name)
            frames.rotations[name], frames.positions[name] = obstacle.rotations[rows], obstacle.positions[rows]
        obstacles.append({**_solid(*obstacle.solid(points), buffers), "mover": mover})
    names = [*movers, *([TIP_FRAME] if tip else [])]
    description: dict[str, Any] = {
        "name": motion.name,
        "verdict": motion.verdict,
        "passed": motion.passed,
        "cost": motion.cost,
        "horizon": float(motion.t[-1]),
        "t": buffers.put(motion.t[rows], "f4"),
        "poses": buffers.put(_poses(frames, names), "f4"),
        "tip": tip,
        "floats": bool(motion.machine.base_size),
        "time": buffers.put(motion.t, "f4"),
        "curves": [
            {
                **vars(curve),
                "values": buffers.put(curve.values, "f4"),
                "lower": _plain(curve.lower),
                "upper": _plain(curve.upper),
            }
            for curve in motion.curves
        ],
        "targets": [
            {
                "t": buffers.put(target.t, "f4"),
                "position": buffers.put(target.position, "f4"),
                "rotation": buffers.put(target.rotation.reshape(-1, 9), "f4"),
            }
            for target in motion.targets
            if np.isfinite(target.position).any()
        ],
        "around": obstacles,
        "rows": [
            [row.name, _plain(row.value), _plain(row.limit), row.unit, _plain(row.time), row.verdict, row.note]
            for row in motion.rows
        ],
    }
    if motion.footing is not None:
        description["footing"] = {
            "corners": motion.footing.corners.tolist(),
            "points": buffers.put(motion.footing.points, "f4"),
            "forces": motion.footing.forces,
        }
    if motion.closest is not None:
        bodies = list(dict.fromkeys(motion.closest.bodies))
        description["near"] = {
            "t": buffers.put(motion.closest.t, "f4"),
            "points": buffers.put(motion.closest.points, "f4"),
            "distances": buffers.put(motion.closest.distances, "f4"),
            "bodies": [list(pair) for pair in bodies],
            "which": [bodies.index(pair) for pair in motion.closest.bodies],
        }
    return description


def _solid(vertices: Array, faces: NDArray[np.intp], buffers: Buffers) -> dict[str, Any]:
    """Return an obstacle's surface as JSON data of the web page; arrays are appended to the binary data `buffers`."""
    part = part_of("", vertices, faces, (0.0, 0.0, 0.0, 1.0))
    return _surface(part.vertices, part.normals, part.faces, buffers)


def _plain(value: float | None) -> float | None:
    """Return a number as a JSON value: None if the number is None or not finite."""
    return None if value is None or not np.isfinite(value) else float(value)


PORT_ATTEMPTS = 20
"""Number of ports that are tried, beginning with the requested port."""
HOST = "127.0.0.1"


class PageServer:
    """Context manager that serves one page by HTTP at `address` to browsers on this machine."""

    def __init__(self, text: str, port: int = 0) -> None:
        """Prepare to serve the HTML text of a page on the first free port from `port` on; 0 selects any free port."""
        self._server = _start_server(text.encode(), port)
        self.address = f"http://{HOST}:{self._server.server_address[1]}"
        self._thread = Thread(target=self._server.serve_forever, name="page", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def wait(self) -> None:
        """Wait until the user presses Ctrl-C, and catch the KeyboardInterrupt."""
        try:
            Event().wait()
        except KeyboardInterrupt:
            return


def _start_server(page: bytes, port: int) -> ThreadingHTTPServer:
    """Return a server for a page on the first free port; the caller must start the server."""

    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            is_local = (self.headers.get("Host") or "").rpartition(":")[0] in (HOST, "localhost")
            is_page = is_local and self.path.partition("?")[0] == "/"
            self.send_response(200 if is_page else 404 if is_local else 421)
            self.send_header("Content-Type", "text/html; charset=utf-8" if is_page else "text/plain")
            self.send_header("Content-Length", str(len(page) if is_page else 0))
            self.end_headers()
            if is_page:
                self.wfile.write(page)

        def log_message(self, *words: object) -> None:
            """Suppress the log of requests, because the user is the only visitor."""

    if not 0 <= port < 65536:
        raise ProblemError(f"port {port} is invalid; use 0 to 65535", name="port", value=port, limit=(0, 65535))
    for candidate in range(port, min(port + PORT_ATTEMPTS, 65536)) if port else (0,):
        try:
            return ThreadingHTTPServer((HOST, candidate), Answer)
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
    words = f"no port from {port} to {port + PORT_ATTEMPTS - 1} is free; choose another one, or --port 0 for any"
    raise ProblemError(words, name="port", value=port)
