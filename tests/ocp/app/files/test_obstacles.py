"""Every shape of an [[obstacle]] table is read as the shape of its name, with its numbers."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models import Box, Capsule, Cylinder, HalfSpace, Mesh, Sphere
from models.spatial import rotation_from_rpy
from ocp.app.files.settings import SHAPES, read_obstacles

TURN = np.array(rotation_from_rpy(0.1, -0.2, 0.3), dtype=float)
CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], dtype=float)
FACES = ((1, 3, 2), (1, 2, 4), (1, 4, 3), (2, 3, 4))
WRITTEN: dict[str, tuple[str, Any]] = {
    "box": (
        "size = [0.1, 0.2, 0.3]\nposition = [1, 2, 3]\nrpy = [0.1, -0.2, 0.3]",
        Box((0.1, 0.2, 0.3), (1, 2, 3), TURN),
    ),
    "sphere": ("radius = 0.4\nposition = [1, 2, 3]", Sphere(0.4, (1, 2, 3))),
    "capsule": ("radius = 0.1\nstart = [0, 0, 1]\nend = [0, 1, 1]", Capsule(0.1, (0, 0, 1), (0, 1, 1))),
    "cylinder": (
        "radius = 0.1\nlength = 0.7\nposition = [1, 2, 3]\nrpy = [0.1, -0.2, 0.3]",
        Cylinder(0.1, 0.7, (1, 2, 3), TURN),
    ),
    "halfspace": ("normal = [0, 0, 1]\npoint = [0, 0, -0.2]", HalfSpace((0, 0, 1), (0, 0, -0.2))),
}


def same(one: Any, other: Any) -> bool:
    """Whether two shapes are of one kind, with the same numbers."""
    pairs = [(getattr(one, field.name), getattr(other, field.name)) for field in fields(other)]
    return type(one) is type(other) and all(np.array_equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("shape", sorted(set(SHAPES) - {"mesh"}))
def test_a_shape_is_that_of_its_name_and_numbers(shape: str, tmp_path: Path) -> None:
    words, expected = WRITTEN[shape]
    (tmp_path / "a.toml").write_text(f"[[obstacle]]\nshape = '{shape}'\n{words}\n")
    (read,) = read_obstacles(tmp_path / "a.toml")
    assert same(read, expected)


def test_a_mesh_is_its_file_scaled_and_placed(tmp_path: Path) -> None:
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS] + [f"f {a} {b} {c}" for a, b, c in FACES]
    (tmp_path / "a.obj").write_text("\n".join(lines) + "\n")
    words = "file = 'a.obj'\nscale = 0.5\nposition = [1, 2, 3]\nrpy = [0.1, -0.2, 0.3]"
    (tmp_path / "a.toml").write_text(f"[[obstacle]]\nshape = 'mesh'\n{words}\n")
    (read,) = read_obstacles(tmp_path / "a.toml")
    assert isinstance(read, Mesh)
    expected = 0.5 * CORNERS @ TURN.T + (1, 2, 3)
    gaps = np.linalg.norm(read.core[:, None] - expected, axis=2).min(axis=1)
    assert (len(read.core), gaps.max()) == (4, pytest.approx(0, abs=1e-12))
