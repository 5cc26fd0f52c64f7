"""What stands or moves around a machine, for pictures and for the view: bodies, half-spaces as pieces of a plane."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import HalfSpace
from models.arrays import Array
from models.shapes.hull import convex_hull
from models.shapes.shapes import Shape
from ocp.app.appearance import SURFACE_STYLE
from ocp.audit.clearance import placements_along
from ocp.planning import Plan
from ocp.problem.problem import Problem
from ocp.problem.separation import Separation
from ocp.solution import Solution

__all__ = ["Obstacle", "Solid", "looks_of", "obstacles_of", "of_shapes"]

Solid = tuple[Array, NDArray[np.intp]]
"""Corners (k, 3), m, and triangles of them (f, 3)."""


class Obstacle(NamedTuple):
    """A body, the hull of points swelled by a radius, or all that lies behind a plane.

    Attributes:
        core: Points. Shape (k, 3), m; of a half-space one of its plane.
        radius: m.
        normal: Of a half-space, out of it, shape (3,); else None.
        rotations, positions: Of the frame in world at the times of a motion, shapes (M, 3, 3) and (M, 3), m; None where
            it stands still, its points in world.
    """

    core: Array
    radius: float = 0.0
    normal: Array | None = None
    rotations: Array | None = None
    positions: Array | None = None

    def solid(self, before: Array) -> Solid:
        """Its surface, in its own frame; of a half-space a square of its plane before which points (k, 3) move."""
        if self.normal is None:
            around = np.zeros((1, 3))
            if self.radius > 0:
                u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 13)[:-1], np.linspace(-np.pi / 2, np.pi / 2, 7))
                unit = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], axis=-1)
                around = self.radius * unit.reshape(-1, 3)
            hull = convex_hull((np.asarray(self.core)[:, None] + around).reshape(-1, 3))
            return np.asarray(hull.vertices), hull.faces
        low, high = before.min(axis=0), before.max(axis=0)
        middle = (low + high) / 2
        middle = middle - self.normal * (self.normal @ (middle - self.core[0]))
        one = np.cross(self.normal, np.eye(3)[int(np.abs(self.normal).argmin())])
        one /= np.linalg.norm(one)
        sides = SURFACE_STYLE.patch * float(np.linalg.norm(high - low)) * np.stack([one, np.cross(self.normal, one)])
        return middle + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ sides, np.array([[0, 1, 2], [0, 2, 3]])


def of_shapes(shapes: Iterable[Shape]) -> list[Obstacle]:
    """Shapes that stand still in world."""
    return [
        Obstacle(np.asarray(one.point, dtype=float)[None], 0.0, np.asarray(one.normal, dtype=float))
        if isinstance(one, HalfSpace)
        else Obstacle(np.asarray(one.core), one.swelling)
        for one in shapes
    ]


def obstacles_of(solution: Solution, parts: Sequence[tuple[str, Array]]) -> list[Obstacle]:
    """Obstacles as the problem of a solution knows them.

    Those that move ride on a frame that depends on the time and on no state.

    Args:
        solution: Its problem says what has to stay apart; without one nothing is known.
        parts: Of a motion, one after the other: the suffix of the names of its states, "" of a whole, and the times in
            the solution, shape (K,), s, at which it is looked at.
    """
    problem = solution.problem
    if problem is None:
        return []
    still: dict[str, Obstacle] = {}
    moving: dict[str, list[tuple[Any, Array, Array]]] = {}
    for suffix, times in parts:
        placed: list[tuple[Separation, Any]] | None = None
        for apart in problem.declared.apart.values():
            if not all(name.endswith(suffix) for name in apart.movers):
                continue
            riding = [frame for frame in {hull.frame for hull in apart.hulls.values()} if _moves(problem, apart, frame)]
            for name, hull in apart.hulls.items():
                if hull.frame < 0:
                    still[name] = Obstacle(hull.core, hull.radius, hull.normal if hull.normal.size else None)
                elif hull.frame in riding:
                    if placed is None:
                        placed = placements_along(problem, solution, times, suffix)
                    frames = next(frames for one, frames in placed if one is apart)
                    at = frames.rotations[:, hull.frame], frames.positions[:, hull.frame]
                    moving.setdefault(name, []).append((hull, *at))
    found = list(still.values())
    for pieces in moving.values():
        hull = pieces[0][0]
        rotations, positions = (np.concatenate([piece[k] for piece in pieces]) for k in (1, 2))
        if len(positions) == sum(len(times) for _, times in parts):
            found.append(Obstacle(hull.core, hull.radius, None, rotations, positions))
    return found


def looks_of(plan: Plan, times: Array) -> list[tuple[str, Array]]:
    """Ascending times of a plan (M,), s, part by part: the suffix of its states, and the times in its solution."""
    begins = [part.begin for part in plan.parts]
    which = np.clip(np.searchsorted(begins, times, "right") - 1, 0, len(begins) - 1)
    return [
        (part.suffix, plan._fractions(part, times[which == k]) * plan.solution.horizon)
        for k, part in enumerate(plan.parts)
    ]


def _moves(problem: Problem, apart: Separation, frame: int) -> bool:
    """Whether a frame moves by the time alone."""
    if frame < 0:
        return False
    rows = apart.placements[12 * frame : 12 * frame + 12]
    states = ca.vertcat(*(ca.vec(one.symbol) for one in problem.declared.states.values()))
    return bool(ca.depends_on(rows, problem.time)) and not ca.depends_on(rows, states)
