"""What readers of mesh files have in common: triangles with colours, numbers in texts, and what is too much."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from models.arrays import Array
from models.errors import ModelError
from models.input_files import INPUT_LIMITS

Faces: TypeAlias = NDArray[np.intp]


class Triangles(NamedTuple):
    """A mesh.

    Attributes:
        vertices: Shape (n, 3), m.
        faces: Corners of each triangle as indices. Shape (m, 3).
        colors: Red, green, blue and opacity of each triangle, 0 to 1; nan where the file says none. Shape (m, 4).
    """

    vertices: Array
    faces: Faces
    colors: Array


def bare(vertices: Array, faces: Faces) -> Triangles:
    """Triangles without colours."""
    return Triangles(vertices, faces, np.full((len(faces), 4), np.nan))


def together(parts: Sequence[Triangles]) -> Triangles:
    """All parts as one mesh."""
    if not parts:
        return bare(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.intp))
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + offset for part, offset in zip(parts, offsets, strict=False)]
    colors = [part.colors for part in parts]
    return Triangles(np.concatenate([part.vertices for part in parts]), np.concatenate(faces), np.concatenate(colors))


def wrong(file: Path, what: str, value: object = None, limit: object = None) -> ModelError:
    """What is wrong with a mesh file."""
    bound = f", limit {limit}" if isinstance(limit, int) else ""
    return ModelError(f"mesh {str(file)!r}: {what}{bound}", name=str(file), value=value, limit=limit)


def lines_of(file: Path, data: bytes) -> Iterator[tuple[int, str]]:
    """Numbers from 1 and texts of the lines of a text that is not too long, one after the other."""
    if len(data) > INPUT_LIMITS.mesh_text_bytes:
        raise wrong(file, f"it has {len(data)} bytes of text", len(data), INPUT_LIMITS.mesh_text_bytes)
    return enumerate(TextIOWrapper(BytesIO(data), "utf-8", errors="replace"), start=1)


def numbers(file: Path, words: Sequence[str], where: Callable[[], str]) -> list[float]:
    """Words as numbers; ModelError, with the place, for one that is none."""
    try:
        return [float(word) for word in words]
    except ValueError:
        strange = next((word for word in words if not _is_number(word)), "")
        raise wrong(file, f"{where()}: {strange!r} is no number", strange) from None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
