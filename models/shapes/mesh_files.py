"""Triangle meshes from files: STL (binary and text), OBJ and Collada, found by the names that URDF gives them.

Only where the surface is counts here: colours, normals and textures are passed over. The standard library and numpy
read all of it; a file is refused before it fills the memory.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias
from urllib.parse import unquote, urlparse
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from models.arrays import Array, checked_text
from models.errors import ModelError

Faces: TypeAlias = NDArray[np.intp]
Triangles: TypeAlias = tuple[Array, Faces]

MOST_BYTES = {"binary": 2**28, "text": 2**26}
"""Of a file: numbers in a text take several times their bytes while they are read."""
MOST_FACES = 2**22
"""Of a mesh, after all its instances in a scene are placed."""
DEEPEST = 64
"""Of nodes within nodes in a scene."""
INSTANCE = 64
"""Triangles that a borrowed node counts for: one that borrows others, which borrow others, ends in time."""
STL_HEAD, STL_FACE = 84, 50  # bytes
RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def find_mesh(
    file: str, folder: str | os.PathLike[str] | None, folders: Sequence[str | os.PathLike[str]] = ()
) -> Path | None:
    """The file that a URDF calls by a relative or absolute path, file:// or package://; None where there is none.

    package://NAME/REST is DIR/NAME/REST, or DIR/REST where DIR is the package itself, for DIR of the folders and then
    of the URDF file's folder and those above it. A relative path starts in any of these.

    Args:
        file: As the URDF has it.
        folder: The URDF file's own; None where it is not known.
        folders: Where to look first.

    Raises:
        ModelError: A name that is no text, a folder that is no path.
    """
    checked_text(file, "mesh", "file")
    try:
        given = [Path(each) for each in folders]
        own = [] if not folder else [Path(folder).resolve(), *Path(folder).resolve().parents]
    except TypeError as error:
        message = f"mesh {file!r}: folders must be paths, not {folders!r}"
        raise ModelError(message, name="folders", value=folders) from error
    places = [*given, *own]
    address = urlparse(file)
    if address.scheme in ("package", "model"):
        rest = unquote(address.path).lstrip("/")
        packages = [place / rest for place in places if place in given or place.name == address.netloc]
        candidates = [place / address.netloc / rest for place in places] + packages
    elif address.scheme == "file":
        candidates = [Path(unquote(address.path))]
    else:
        candidates = [place / file for place in [*own[:1], *places]] or [Path(file)]
    return next((path for path in candidates if _is_file(path)), None)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name too long, with a null in it
        return False


def read_mesh(path: str | os.PathLike[str]) -> Triangles:
    """Corners and triangles of a mesh file, in the file's own axes.

    The name's ending says the format: .stl, .obj or .dae. Collada's <unit> is applied, so that lengths are in m; its
    <up_axis> is not, nor is it by RViz, MoveIt and other readers of URDF, for which robots' files are made. Polygons
    become fans of triangles; lines and points are left out.

    Args:
        path: Of the file.

    Returns:
        Vertices, shape (n, 3), m, all of them finite and used; corners of each triangle as indices, shape (m, 3).

    Raises:
        ModelError: No such file, an unknown ending, contents that are not the format's (with the line or element),
            no triangle, more than MOST_BYTES or MOST_FACES.
    """
    if not isinstance(path, str | os.PathLike):
        raise ModelError(f"mesh: path must be a path, not {path!r}", name="path", value=path)
    file = Path(path)
    reader = READERS.get(file.suffix.lower())
    if reader is None:
        message = f"mesh {str(file)!r}: only the endings {', '.join(READERS)} are read; convert the file to one of them"
        raise ModelError(message, name=str(file), value=file.suffix, limit=tuple(READERS))
    try:
        if file.stat().st_size > MOST_BYTES["binary"]:
            raise _wrong(file, f"it has {file.stat().st_size} bytes", file.stat().st_size, MOST_BYTES["binary"])
        data = file.read_bytes()
    except (OSError, ValueError) as error:
        if isinstance(error, ModelError):
            raise
        reason = getattr(error, "strerror", None) or error
        raise ModelError(f"mesh {str(file)!r} cannot be read: {reason}", name=str(file), value=path) from error
    vertices, faces = reader(file, data)
    if not len(faces):
        raise _wrong(file, "it has no triangle", 0, 1)
    if not np.isfinite(vertices).all():
        row = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise _wrong(file, f"vertex {row} {vertices[row].tolist()} is not finite", vertices[row])
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _wrong(file: Path, what: str, value: object = None, limit: object = None) -> ModelError:
    bound = f", limit {limit}" if isinstance(limit, int) else ""
    return ModelError(f"mesh {str(file)!r}: {what}{bound}", name=str(file), value=value, limit=limit)


def _text(file: Path, data: bytes) -> str:
    if len(data) > MOST_BYTES["text"]:
        raise _wrong(file, f"it has {len(data)} bytes of text", len(data), MOST_BYTES["text"])
    return data.decode("utf-8", errors="replace")


def _numbers(file: Path, words: Sequence[str], where: Callable[[], str]) -> Array:
    try:
        return np.array(words, dtype=float)
    except ValueError:
        wrong = next((word for word in words if not _is_number(word)), "")
        raise _wrong(file, f"{where()}: {wrong!r} is no number", wrong) from None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


# ------------------------------------------------------------------------------------------------------------- STL


def _read_stl(file: Path, data: bytes) -> Triangles:
    """A text begins with "solid", but so do binary files of some programs: the count of triangles decides."""
    count = int.from_bytes(data[STL_HEAD - 4 : STL_HEAD], "little") if len(data) >= STL_HEAD else -1
    exact = count >= 0 and len(data) == STL_HEAD + STL_FACE * count
    if not exact and data[:512].lstrip()[:5].lower() == b"solid":
        return _read_stl_text(file, data)
    if count < 0 or len(data) < STL_HEAD + STL_FACE * count:
        message = f"it is no STL text and, as binary, cut off: {len(data)} bytes, {max(count, 0)} triangles announced"
        raise _wrong(file, message, len(data), STL_HEAD + STL_FACE * max(count, 0))
    if count > MOST_FACES:
        raise _wrong(file, f"it has {count} triangles", count, MOST_FACES)
    corners = np.frombuffer(data, RECORD, count, STL_HEAD)["corners"].reshape(-1, 3).astype(float)
    return _joined(corners)


def _read_stl_text(file: Path, data: bytes) -> Triangles:
    words: list[str] = []
    corners, last = 0, 0
    for number, line in enumerate(_text(file, data).splitlines(), start=1):
        entries = line.split()
        if not entries:
            continue
        word = entries[0].lower()
        if word == "vertex":
            if len(entries) != 4:
                raise _wrong(file, f"line {number}: a vertex of {len(entries) - 1} numbers", line.strip())
            _numbers(file, entries[1:], lambda number=number: f"line {number}")  # type: ignore[misc]
            words += entries[1:]
            corners, last = corners + 1, number
        elif word == "endfacet":
            if corners != 3:
                raise _wrong(file, f"line {number}: a facet of {corners} corners", corners, 3)
            corners = 0
            if len(words) > 9 * MOST_FACES:
                raise _wrong(file, f"line {number}: too many triangles", len(words) // 9, MOST_FACES)
    if corners:
        raise _wrong(file, f"line {last}: the file ends within a facet", corners)
    return _joined(np.array(words, dtype=float).reshape(-1, 3))


def _joined(corners: Array) -> Triangles:
    """Corners of triangles, three rows each, with those at the same place made one."""
    vertices, faces = np.unique(corners + 0.0, axis=0, return_inverse=True)  # + 0.0: -0.0 is 0.0
    return vertices, faces.reshape(-1, 3).astype(np.intp)


# ------------------------------------------------------------------------------------------------------------- OBJ


def _read_obj(file: Path, data: bytes) -> Triangles:
    vertices: list[Array] = []
    faces: list[tuple[int, int, int]] = []
    for number, line in enumerate(_text(file, data).replace("\\\n", " ").splitlines(), start=1):
        entries = line.partition("#")[0].split()
        if not entries or entries[0] not in ("v", "f"):
            continue
        place = f"line {number}"
        if entries[0] == "v":
            if len(entries) < 4:
                raise _wrong(file, f"{place}: a vertex of {len(entries) - 1} numbers", line.strip())
            vertices.append(_numbers(file, entries[1:4], lambda place=place: place))  # type: ignore[misc]
            continue
        if len(entries) < 4:
            raise _wrong(file, f"{place}: a face of {len(entries) - 1} corners", line.strip(), 3)
        corners = [_corner(file, entry, len(vertices), place) for entry in entries[1:]]
        faces += [(corners[0], *pair) for pair in pairwise(corners[1:])]
        if len(faces) > MOST_FACES:
            raise _wrong(file, f"{place}: too many triangles", len(faces), MOST_FACES)
    found = np.array(faces, dtype=np.intp).reshape(-1, 3)
    if found.size and found.max() >= len(vertices):
        raise _wrong(file, f"a face names vertex {int(found.max()) + 1} of {len(vertices)}", int(found.max()) + 1)
    return np.array(vertices, dtype=float).reshape(-1, 3), found


def _corner(file: Path, entry: str, count: int, place: str) -> int:
    """Index of v, v/vt or v/vt/vn: from one up, or from the last vertex so far down."""
    word = entry.partition("/")[0]
    try:
        index = int(word)
    except ValueError:
        raise _wrong(file, f"{place}: {entry!r} is no corner of a face", entry) from None
    index = count + index if index < 0 else index - 1
    if index < 0:
        raise _wrong(file, f"{place}: {entry!r} names no vertex of {count}", entry, (1, count))
    return index


# --------------------------------------------------------------------------------------------------------- Collada


def _read_dae(file: Path, data: bytes) -> Triangles:
    """All instances of geometries in the scene; of all geometries where there is no scene."""
    if len(data) > MOST_BYTES["text"]:
        raise _wrong(file, f"it has {len(data)} bytes of text", len(data), MOST_BYTES["text"])
    if b"<!ENTITY" in data or b"<!DOCTYPE" in data:
        raise _wrong(file, "it declares a document type or entities, which are not read")
    try:
        tree = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise _wrong(file, f"it is not well-formed XML: {error}", error.position) from error
    except (ValueError, LookupError) as error:
        raise _wrong(file, f"it cannot be read: {error}") from error
    for element in tree.iter():
        if isinstance(element.tag, str):
            element.tag = element.tag.rpartition("}")[2]
    if tree.tag != "COLLADA":
        raise _wrong(file, f"its root element is <{tree.tag}>, not <COLLADA>", tree.tag, "COLLADA")
    with np.errstate(all="ignore"):  # what is not finite is refused with its vertex
        return _Collada(file, tree).triangles()


class _Collada:
    """A document: its elements by id, and the triangles of its scene."""

    def __init__(self, file: Path, tree: ElementTree.Element) -> None:
        self.file, self.tree = file, tree
        self.by_id = {element.get("id"): element for element in tree.iter() if element.get("id")}
        self.read: dict[int, Triangles] = {}
        self.count = 0

    def triangles(self) -> Triangles:
        unit = self.tree.find("asset/unit")
        scale = 1.0
        if unit is not None and "meter" in unit.attrib:
            scale = float(self._values(unit.get("meter", ""), 1, unit)[0])
        start = np.diag([scale, scale, scale, 1.0])
        parts: list[Triangles] = []
        scene = self.tree.find("scene/instance_visual_scene")
        if scene is not None:
            for node in self._named(scene).findall("node"):
                parts += self._placed(node, start, 0)
        else:
            parts += [self._moved(geometry, start) for geometry in self.tree.iter("geometry")]
        offsets = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
        if not parts:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.intp)
        faces = [faces + offset for (_, faces), offset in zip(parts, offsets, strict=False)]
        return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)

    def _wrong(self, element: ElementTree.Element, what: str, value: object = None, limit: object = None) -> ModelError:
        name = element.get("id") or element.get("url") or element.get("source") or ""
        return _wrong(self.file, f"<{element.tag}>{f' {name!r}' if name else ''}: {what}", value, limit)

    def _values(self, text: str | None, count: int | None, element: ElementTree.Element) -> Array:
        values = _numbers(self.file, (text or "").split(), lambda: f"<{element.tag}> {element.get('id') or ''}".strip())
        if count is not None and len(values) != count:
            raise self._wrong(element, f"{len(values)} numbers, not {count}", len(values))
        return values

    def _indices(self, text: str | None, element: ElementTree.Element) -> Faces:
        values = self._values(text, None, element)
        if not (np.isfinite(values).all() and (values == np.floor(values)).all() and (np.abs(values) < 2**31).all()):
            raise self._wrong(element, "indices must be whole numbers")
        return values.astype(np.intp)

    def _named(self, element: ElementTree.Element, key: str = "url") -> ElementTree.Element:
        name = element.get(key, "")
        found = self.by_id.get(name.removeprefix("#"))
        if found is None:
            raise self._wrong(element, f"{key} {name!r} names nothing in the file", name)
        return found

    def _placed(self, node: ElementTree.Element, above: Array, depth: int) -> Iterator[Triangles]:
        """Triangles of a node, of the nodes in it and of those that it borrows."""
        if depth > DEEPEST:
            raise self._wrong(node, f"nodes within nodes, more than {DEEPEST} deep, or in a ring", depth)
        place = above @ self._transform(node)
        for child in node:
            if child.tag == "node":
                yield from self._placed(child, place, depth + 1)
            elif child.tag == "instance_node":
                self._counted(child, INSTANCE)
                yield from self._placed(self._named(child), place, depth + 1)
            elif child.tag == "instance_geometry":
                yield self._moved(self._named(child), place)
            elif child.tag == "instance_controller":
                skin = self._named(child).find("skin")
                if skin is not None:
                    yield self._moved(self._named(skin, "source"), place)

    def _counted(self, element: ElementTree.Element, more: int) -> None:
        self.count += more
        if self.count > MOST_FACES:
            raise self._wrong(element, f"{self.count} triangles in the scene", self.count, MOST_FACES)

    def _transform(self, node: ElementTree.Element) -> Array:
        place = np.eye(4)
        for element in node:
            step = np.eye(4)
            if element.tag == "matrix":
                step = self._values(element.text, 16, element).reshape(4, 4)
            elif element.tag == "translate":
                step[:3, 3] = self._values(element.text, 3, element)
            elif element.tag == "scale":
                step[:3, :3] = np.diag(self._values(element.text, 3, element))
            elif element.tag == "rotate":
                *axis, angle = self._values(element.text, 4, element)
                step[:3, :3] = _turned(np.array(axis), np.deg2rad(angle))
            elif element.tag in ("lookat", "skew"):
                raise self._wrong(element, "this transform is not read; apply it in the program that wrote the file")
            place = place @ step
        return place

    def _moved(self, geometry: ElementTree.Element, place: Array) -> Triangles:
        if id(geometry) not in self.read:
            self.read[id(geometry)] = self._geometry(geometry)
        vertices, faces = self.read[id(geometry)]
        self._counted(geometry, len(faces) + len(vertices) // 3)
        return vertices @ place[:3, :3].T + place[:3, 3], faces

    def _geometry(self, geometry: ElementTree.Element) -> Triangles:
        mesh = geometry.find("mesh")
        vertices: list[Array] = []
        faces: list[Faces] = []
        offset = 0
        for part in () if mesh is None else mesh:
            if part.tag not in ("triangles", "polylist", "polygons", "tristrips", "trifans"):
                continue
            points, stride, column = self._positions(part)
            found = self._faces(part, stride, column)
            if found.size and (found.min() < 0 or found.max() >= len(points)):
                raise self._wrong(part, f"an index outside its {len(points)} points", int(found.max()))
            vertices.append(points)
            faces.append(found + offset)
            offset += len(points)
        if not faces:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.intp)
        return np.concatenate(vertices), np.concatenate(faces)

    def _positions(self, part: ElementTree.Element) -> tuple[Array, int, int]:
        """The points of a set of faces, how many indices a corner has, and which of them is that of the point."""
        inputs = part.findall("input")
        own = next((each for each in inputs if each.get("semantic") == "VERTEX"), None)
        if own is None:
            raise self._wrong(part, "no <input> of the semantic VERTEX")
        offsets = [int(self._indices(each.get("offset", "0"), each)[0]) for each in inputs]
        column = int(self._indices(own.get("offset", "0"), own)[0])
        if not 0 <= min(offsets) <= max(offsets) < DEEPEST:
            raise self._wrong(part, f"<input> offsets {offsets} are impossible", tuple(offsets))
        stride = max(offsets) + 1
        vertices = self._named(own, "source")
        where = next((each for each in vertices.findall("input") if each.get("semantic") == "POSITION"), None)
        if where is None:
            raise self._wrong(vertices, "no <input> of the semantic POSITION")
        source = self._named(where, "source")
        array = source.find("float_array")
        accessor = source.find("technique_common/accessor")
        if array is None:
            raise self._wrong(source, "no <float_array>")
        width = 3 if accessor is None else int(self._indices(accessor.get("stride", "1"), accessor)[0])
        start = 0 if accessor is None else int(self._indices(accessor.get("offset", "0"), accessor)[0])
        numbers = self._values(array.text, None, array)
        if width < 3 or start < 0:
            raise self._wrong(source, f"an <accessor> of stride {width}, offset {start}; three numbers make a point")
        rows = (len(numbers) - start) // width
        return numbers[start : start + max(rows, 0) * width].reshape(-1, width)[:, :3], stride, column

    def _faces(self, part: ElementTree.Element, stride: int, column: int) -> Faces:
        lists = [self._indices(each.text, part) for each in part.iter("p")]
        for each in lists:
            if len(each) % stride:
                raise self._wrong(part, f"{len(each)} indices, not a multiple of {stride}", len(each))
        corners = [each[column::stride] for each in lists]
        if part.tag == "triangles":
            whole = np.concatenate([*corners, np.zeros(0, dtype=np.intp)])
            if len(whole) % 3:
                raise self._wrong(part, f"{len(whole)} corners, not a multiple of 3", len(whole))
            return whole.reshape(-1, 3)
        if part.tag == "polylist":
            counts = part.find("vcount")
            sizes = self._indices(None if counts is None else counts.text, part)
            whole = np.concatenate([*corners, np.zeros(0, dtype=np.intp)])
            if (sizes < 0).any() or sizes.sum() != len(whole):
                raise self._wrong(part, f"<vcount> says {int(sizes.sum())} corners, there are {len(whole)}", len(whole))
            corners = np.split(whole, np.cumsum(sizes)[:-1]) if len(sizes) else []
        if part.tag == "tristrips":
            fans = [np.stack([each[:-2], each[1:-1], each[2:]], axis=1) for each in corners if len(each) > 2]
        else:
            fans = [
                np.stack([np.full(len(each) - 2, each[0]), each[1:-1], each[2:]], axis=1)
                for each in corners
                if len(each) > 2
            ]
        return np.concatenate([*fans, np.zeros((0, 3), dtype=np.intp)])


def _turned(axis: Array, angle: float) -> Array:
    """Rodrigues' rotation about an axis of any length but zero, which turns nothing. Shape (3, 3)."""
    length = float(np.linalg.norm(axis))
    if not length > 0:
        return np.eye(3)
    x, y, z = axis / length
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Array = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
    return rotation


READERS: dict[str, Callable[[Path, bytes], Triangles]] = {".stl": _read_stl, ".obj": _read_obj, ".dae": _read_dae}
