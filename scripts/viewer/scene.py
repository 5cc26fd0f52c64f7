"""The scene of a plan in the browser: the robot's links, the trace of its tip, and the controls that play it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np

from models.arrays import Array
from scripts.robots.frames import TIP, Frames, inertia_box
from scripts.viewer.meshes import Shapes, read_shapes
from scripts.viewer.plan import Played

TRACE_POINTS = 401
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "5", "10")
LINE = (60, 64, 72)
PATH = (86, 180, 233)
TRACE = (213, 94, 0)
NEAREST = (204, 121, 167)
BOX = (150, 156, 166)


class View:
    """A plan on a viser server: set `time` or the values of the controls, or call `advance`; a browser does the same.

    Attributes:
        server: The viser server, listening.
        links: Handles of the frames of all links and of the tip (key TIP), by name.
        slider: Of the time. play: Whether `advance` moves on. repeat: Whether it starts again from the end.
        speed: Seconds of the plan in a second, of SPEEDS.
        missing: Mesh files that are not shown, and why.
    """

    slider: Any
    play: Any
    speed: Any
    repeat: Any

    def __init__(
        self,
        played: Played,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        mesh_dirs: Sequence[Path] = (),
        meshes: bool = True,
    ) -> None:
        """Start the server and build the scene at time 0.

        Args:
            played: The plan and its robot.
            host: Address to listen on; only this machine can connect to 127.0.0.1.
            port: 0 for any free one.
            mesh_dirs: Where the meshes' packages are.
            meshes: Whether to show meshes at all.
        """
        import viser

        self.played = played
        self._lock = RLock()
        self._dense = played.frames(np.linspace(0.0, played.horizon, TRACE_POINTS))
        self._size = _extent(self._dense)
        shapes = read_shapes(played.urdf, mesh_dirs) if meshes else Shapes({}, {})
        self.missing = shapes.missing
        self.server = viser.ViserServer(host=host, port=port, label=played.solution.name)
        try:
            self._build(shapes)
            self._controls()
            self._show(0.0)
        except BaseException:
            self.server.stop()
            raise

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    @property
    def time(self) -> float:
        """Time of the plan that is shown, s."""
        return float(self.slider.value)

    @time.setter
    def time(self, value: float) -> None:
        clipped = float(np.clip(value, 0.0, self.played.horizon))
        self.slider.value = clipped
        self._show(clipped)

    def advance(self, seconds: float) -> None:
        """Play on for so many seconds of the clock; from the end it starts again, or stops there if not to repeat."""
        if not self.play.value:
            return
        later, end = self.time + float(self.speed.value) * seconds, self.played.horizon
        if later < end:
            self.time = later
        elif self.repeat.value and self.time >= end:
            self.time = 0.0
        else:
            self.time = end
            self.play.value = self.repeat.value

    def stop(self) -> None:
        """End the server."""
        self.server.stop()

    def _build(self, shapes: Shapes) -> None:
        scene, robot = self.server.scene, self.played.robot
        scene.set_up_direction("+z")
        axes = 0.12 * self._size
        low = float(min(values[:, 2].min() for values in self._dense.positions.values()))
        scene.add_grid("/grid", width=4 * self._size, height=4 * self._size, position=(0.0, 0.0, min(low, 0.0)))
        self.links: dict[str, Any] = {}
        for i, name in enumerate([link.name for link in robot.links]):
            self.links[name] = scene.add_frame(_node(i, name), show_axes=False)
        last = len(robot.links)
        self.links[TIP] = scene.add_frame(_node(last, "tip"), axes_length=axes, axes_radius=0.03 * axes)
        root = [link.name for link in robot.links].index(robot.root)
        if self.played.base is not None:
            scene.add_frame(f"{_node(root, robot.root)}/base", axes_length=2 * axes, axes_radius=0.04 * axes)
        for i, link in enumerate(robot.links):
            node = _node(i, link.name)
            if link.name in shapes.by_link:
                for k, shape in enumerate(shapes.by_link[link.name]):
                    _add_mesh(scene, f"{node}/visual{k}", shape)
            elif (box := inertia_box(robot, link.name)) is not None:
                size, turn, center = box
                place: dict[str, Any] = {"wxyz": _quaternion(turn), "position": center}
                scene.add_box(f"{node}/box", BOX, np.maximum(size, 0.005 * self._size), opacity=0.5, **place)
        # lines from joint to joint, where meshes do not show the links
        bare = {link.name for link in robot.links if link.name not in shapes.by_link}
        bare -= {link.name for link in robot.links if link.mass == 0} if shapes.by_link else set()
        self._bones = [
            (each.parent, each.child) for each in robot.joints if not bare.isdisjoint((each.parent, each.child))
        ]
        self._lines: Any = None
        if self._bones:
            nowhere = np.zeros((len(self._bones), 2, 3))
            self._lines = scene.add_line_segments("/lines", nowhere, LINE, thickness=0.008 * self._size)
        tip = self._dense.tip
        scene.add_line_segments("/path", np.stack([tip[:-1], tip[1:]], axis=1), PATH, thickness=0.004 * self._size)
        self._trace = scene.add_line_segments("/trace", np.zeros((1, 2, 3)), TRACE, thickness=0.007 * self._size)
        self._nearest: Any = None
        if self.played.nearest(0.0) is not None:
            self._nearest = scene.add_line_segments(
                "/nearest", np.zeros((1, 2, 3)), NEAREST, thickness=0.008 * self._size
            )
        camera = self.server.initial_camera
        middle = (tip.max(axis=0) + tip.min(axis=0)) / 2
        camera.look_at = middle
        camera.position = middle + self._size * np.array([1.1, -1.3, 0.8])

    def _controls(self) -> None:
        gui, played = self.server.gui, self.played
        gui.add_markdown(f"**{played.robot.name}**: {played.solution.name}")
        step = played.horizon / 1000
        self.slider = gui.add_slider("time, s", 0.0, played.horizon, step, 0.0)
        self.play = gui.add_checkbox("play", False)
        self.repeat = gui.add_checkbox("repeat", True)
        self.speed = gui.add_dropdown("speed", SPEEDS, initial_value="1")
        tracing = gui.add_checkbox("tip trace", True)
        framing = gui.add_checkbox("link frames", False)
        self._apart: Any = None if self._nearest is None else gui.add_markdown("")
        if self.missing:
            gui.add_markdown(f"{len(self.missing)} mesh files are not shown: see the terminal")

        self.slider.on_update(lambda _: self._show(float(self.slider.value)))

        @tracing.on_update
        def _traced(_: Any) -> None:
            self._trace.visible = bool(tracing.value)

        @framing.on_update
        def _framed(_: Any) -> None:
            for name, handle in self.links.items():
                if name != TIP:
                    handle.show_axes = bool(framing.value)
                    handle.axes_length, handle.axes_radius = 0.06 * self._size, 0.002 * self._size

    def _show(self, time: float) -> None:
        """Put everything where it is at a time."""
        with self._lock:  # a casadi function serves one thread at a time
            self._place(self.played.frames(time), time)

    def _place(self, frames: Frames, time: float) -> None:
        segments = np.array([[frames.positions[a][0], frames.positions[b][0]] for a, b in self._bones])
        share = time / self.played.horizon * (TRACE_POINTS - 1)
        passed = np.vstack([self._dense.tip[: int(share) + 1], frames.tip])
        with self.server.atomic():
            for name, handle in self.links.items():
                handle.position = frames.positions[name][0]
                handle.wxyz = _quaternion(frames.rotations[name][0])
            if self._lines is not None:
                self._lines.points = segments.astype(np.float32)
            self._trace.points = np.stack([passed[:-1], passed[1:]], axis=1).astype(np.float32)
            if self._nearest is not None and (near := self.played.nearest(time)) is not None:
                self._nearest.points = near.points[None].astype(np.float32)
                self._apart.content = f"nearest: {near.bodies[0]} and {near.bodies[1]}, {1000 * near.distance:.1f} mm"


def _add_mesh(scene: Any, node: str, shape: Any) -> None:
    if shape.color is None:
        scene.add_mesh_trimesh(node, shape.mesh)
        return
    *color, opacity = shape.color
    scene.add_mesh_simple(
        node,
        np.asarray(shape.mesh.vertices),
        np.asarray(shape.mesh.faces),
        color=tuple(round(255 * part) for part in color),
        opacity=None if opacity >= 1 else opacity,
        side="double",
    )


def _node(number: int, name: str) -> str:
    """A name of one level in viser's tree of scenes."""
    return f"/links/{number}_{name.replace('/', '_')}"


def _quaternion(turn: Array) -> Array:
    from viser.transforms import SO3

    return np.asarray(SO3.from_matrix(turn).wxyz)


def _extent(frames: Frames) -> float:
    """Size of what is seen, m."""
    points = np.vstack(list(frames.positions.values()))
    return max(float(np.linalg.norm(points.max(axis=0) - points.min(axis=0))) / 2, 0.05)
