"""What a motion must keep clear of: obstacles, and the robot's own links."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

__all__ = ["Scene"]


@dataclass(frozen=True, eq=False)
class Scene:
    """Obstacles around a machine and the distance that it keeps from them and between its own links.

    The values are checked when a motion is planned in the scene, together with the machine; see
    `models.CollisionScene`.

    Attributes:
        obstacles: Shapes in world, or `MovingObstacle` ones.
        clearance: Least distance to obstacles and between links, m; 0 excludes contact.
        ignored: Pairs of links, or of a link and an obstacle, that are not checked.
        srdf: SRDF file whose disabled pairs are ignored; None for none.
        folders: Folders of the robot's meshes.
        missing: "raise" if a mesh is missing, or "skip" to leave it out.
    """

    obstacles: Any = ()
    clearance: float = 0.0
    ignored: Any = ()
    srdf: Any = None
    folders: Any = ()
    missing: Literal["raise", "skip"] = "raise"
