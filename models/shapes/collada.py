"""Collada documents (.dae) as triangles, with the colours of their materials.

Parts are found by the ids that others call them by. <unit> is applied, so that lengths are in m, <up_axis> is not, see
`models.shapes.mesh_files`. Of a material its diffuse colour is taken; where that is an image there is none.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from models.arrays import Array
from models.errors import ModelError
from models.input_files import parse_xml
from models.shapes.triangles import MOST_FACES, Faces, Triangles, bare, numbers, together, wrong

__all__ = ["read_collada"]

DEEPEST = 64
"""Of nodes within nodes in a scene."""
WORDS = re.compile(r"\S.{0,65535}\S*", re.DOTALL)
"""Some of the words of a long text, which are read one part after the other."""
INSTANCE = 64
"""Triangles that a borrowed node counts for: one that borrows others, which borrow others, ends in time."""


def read_collada(file: Path, data: bytes) -> Triangles:
    """All instances of geometries in the scene; of all geometries where there is no scene."""
    try:
        tree = parse_xml(data)
    except ElementTree.ParseError as error:
        raise wrong(file, f"it is not well-formed XML: {error}", error.position) from error
    except (ValueError, LookupError) as error:
        raise wrong(file, f"it cannot be read: {error}") from error
    for element in tree.iter():
        if isinstance(element.tag, str):
            element.tag = element.tag.rpartition("}")[2]
    if tree.tag != "COLLADA":
        raise wrong(file, f"its root element is <{tree.tag}>, not <COLLADA>", tree.tag, "COLLADA")
    with np.errstate(all="ignore"):  # what is not finite is refused with its vertex
        return _Collada(file, tree).triangles()


class _Collada:
    """A document: its elements by id, and the triangles of its scene."""

    def __init__(self, file: Path, tree: ElementTree.Element) -> None:
        self.file, self.tree = file, tree
        self.by_id = {element.get("id"): element for element in tree.iter() if element.get("id")}
        self.read: dict[int, list[tuple[str, Triangles]]] = {}
        self.colors: dict[str, Array] = {}
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
            parts += [self._moved(geometry, start, {}) for geometry in self.tree.iter("geometry")]
        return together(parts)

    def _wrong(self, element: ElementTree.Element, what: str, value: object = None, limit: object = None) -> ModelError:
        name = element.get("id") or element.get("url") or element.get("source") or ""
        return wrong(self.file, f"<{element.tag}>{f' {name!r}' if name else ''}: {what}", value, limit)

    def _values(self, text: str | None, count: int | None, element: ElementTree.Element) -> Array:
        values = array("d")
        for part in WORDS.finditer(text or ""):
            where = f"<{element.tag}> {element.get('id') or ''}".strip()
            values.extend(numbers(self.file, part[0].split(), lambda where=where: where))  # type: ignore[misc]
        if count is not None and len(values) != count:
            raise self._wrong(element, f"{len(values)} numbers, not {count}", len(values))
        return np.array(values)

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
                yield self._moved(self._named(child), place, self._materials(child))
            elif child.tag == "instance_controller":
                skin = self._named(child).find("skin")
                if skin is not None:
                    yield self._moved(self._named(skin, "source"), place, self._materials(child))

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

    def _materials(self, instance: ElementTree.Element) -> dict[str, str]:
        """What an instance calls its materials, to their ids."""
        bound = instance.iter("instance_material")
        return {each.get("symbol", ""): each.get("target", "").removeprefix("#") for each in bound}

    def _color(self, material: str) -> Array:
        """Diffuse colour of a material, and opacity. Shape (4,); nan where it has none."""
        if material not in self.colors:
            self.colors[material] = self._found_color(material)
        return self.colors[material]

    def _found_color(self, material: str) -> Array:
        own = self.by_id.get(material)
        effect = None if own is None else own.find("instance_effect")
        effect = None if effect is None else self.by_id.get(effect.get("url", "").removeprefix("#"))
        said = None if effect is None else effect.find("profile_COMMON/technique/*/diffuse/color")
        if said is None:
            return np.full(4, np.nan)
        color = self._values(said.text, 4, said)
        return np.asarray(np.clip(np.append(color[:3], 1.0), 0.0, 1.0))  # programs do not agree what an opacity means

    def _moved(self, geometry: ElementTree.Element, place: Array, materials: dict[str, str]) -> Triangles:
        if id(geometry) not in self.read:
            self.read[id(geometry)] = self._geometry(geometry)
        parts = self.read[id(geometry)]
        self._counted(geometry, sum(len(part.faces) + len(part.vertices) // 3 for _, part in parts))
        painted = [
            Triangles(
                vertices @ place[:3, :3].T + place[:3, 3],
                faces,
                np.tile(self._color(materials.get(symbol, symbol)), (len(faces), 1)),
            )
            for symbol, (vertices, faces, _) in parts
        ]
        return together(painted)

    def _geometry(self, geometry: ElementTree.Element) -> list[tuple[str, Triangles]]:
        """Sets of triangles, and what they call their material."""
        mesh = geometry.find("mesh")
        found: list[tuple[str, Triangles]] = []
        for part in () if mesh is None else mesh:
            if part.tag not in ("triangles", "polylist", "polygons", "tristrips", "trifans"):
                continue
            points, stride, column = self._positions(part)
            faces = self._faces(part, stride, column)
            if faces.size and (faces.min() < 0 or faces.max() >= len(points)):
                raise self._wrong(part, f"an index outside its {len(points)} points", int(faces.max()))
            found.append((part.get("material", ""), bare(points, faces)))
        return found

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
