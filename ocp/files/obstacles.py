"""Obstacles from a file: shapes in world, one under each [[obstacle]] of a TOML file.

[[obstacle]]
shape = "box"                       # or sphere, capsule, cylinder, halfspace, mesh
size = [0.06, 0.06, 0.3]            # m
position = [0.55, 0.0, 0.45]        # m
rpy = [0, 0, 0.5]                   # rad, optional: turns about the world's x, then y, then z
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from models import Box, Capsule, Cylinder, HalfSpace, Mesh, ModelError, Sphere
from models.arrays import Array
from models.shapes.shapes import Shape
from models.spatial import rotation_from_rpy
from ocp.files.entries import REQUIRED, Entries, read_entries
from ocp.files.lines import FileName

__all__ = ["obstacles_of", "read_obstacles", "turn_of"]

SHAPES = ("box", "sphere", "capsule", "cylinder", "halfspace", "mesh")


def read_obstacles(file: FileName) -> tuple[Shape, ...]:
    """The shapes in a file, in its order.

    Raises:
        ProblemError: By line, what is wrong and what was expected.
    """
    entries = read_entries(file)
    found = obstacles_of(entries, Path(file).parent)
    entries.done()
    if not found:
        raise entries.missing("obstacle", 'tables headed [[obstacle]], each with shape = "box" or another')
    return found


def obstacles_of(entries: Entries, folder: Path) -> tuple[Shape, ...]:
    """The shapes under [[obstacle]]; files of meshes are looked for from a folder."""
    found = []
    for one in entries.tables("obstacle"):
        shape = one.choice("shape", SHAPES, REQUIRED)
        try:
            found.append(_shape(one, shape, folder))
        except ModelError as error:
            name = error.name if error.name is not None and error.name in one else None
            raise one.wrong(name, str(error)) from error
        one.done()
    return tuple(found)


def turn_of(entries: Entries) -> Array:
    """The rotation that `rpy` says, none where it is not there. Shape (3, 3)."""
    told = entries.vector("rpy", 3, "three angles, rad", (0.0, 0.0, 0.0))
    return np.array(rotation_from_rpy(*(float(angle) for angle in told)), dtype=float)


def _shape(one: Entries, shape: str, folder: Path) -> Shape:
    def place(name: str = "position") -> Any:
        return one.vector(name, 3, "three numbers, m", REQUIRED)

    def length(name: str) -> Any:
        return one.number(name, "a number above 0, m", REQUIRED, least=0.0)

    if shape == "box":
        return Box(one.vector("size", 3, "three lengths, m", REQUIRED), place(), turn_of(one))
    if shape == "sphere":
        return Sphere(length("radius"), place())
    if shape == "capsule":
        return Capsule(length("radius"), place("start"), place("end"))
    if shape == "cylinder":
        return Cylinder(length("radius"), length("length"), place(), turn_of(one))
    if shape == "halfspace":
        return HalfSpace(one.vector("normal", 3, "three numbers: out of what is solid", REQUIRED), place("point"))
    name = one.text("file", "the name of an STL, OBJ or DAE file", REQUIRED)
    scale = one.number("scale", "a number above 0: m for each unit of the file", 1.0, least=0.0)
    position = one.vector("position", 3, "three numbers, m", (0.0, 0.0, 0.0))
    return Mesh(file=folder / name, position=position, rotation=turn_of(one), scale=scale)
