"""Collada documents (.dae) as triangles, with the colours of their materials, read by pycollada, of the extra `meshes`.

It is given a tree without entities, pictures, cameras and skins, opens no file, and never sees what it would read in
part, as something else, or without end. <unit> is applied, so that lengths are in m, <up_axis> is not, see
`models.shapes.mesh_files`. Positions have single precision, 6e-8 of their size. Of a material its diffuse colour is
taken; where that is an image there is none.
"""

from __future__ import annotations

import warnings
from io import BytesIO
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from models.errors import ModelError
from models.input_files import INPUT_LIMITS, parse_xml
from models.shapes.triangles import Triangles, together, wrong

__all__ = ["read_collada"]


def read_collada(file: Path, data: bytes) -> Triangles:
    """All instances of geometries in the scene; all geometries where there is no scene.

    Raises:
        ModelError: pycollada is not installed, the file is no Collada or is too large, or it holds what would be read
            in part or as something else.
    """
    try:
        from collada import Collada
        from collada.lineset import BoundLineSet
    except ImportError as error:
        message = (
            f"mesh {str(file)!r}: Collada is read by the package pycollada: "
            'pip install "selfmotion[meshes]", or from a clone pip install ".[meshes]"'
        )
        raise ModelError(message, name=str(file), value=error.name) from error
    parts, count = [], 0
    try:
        tree, scale = _plain(file, data)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", DeprecationWarning)  # all that numpy says of a text that is not all numbers
            document = Collada(BytesIO(ElementTree.tostring(tree)))
            if document.scene is None:
                bodies = [geometry.bind(np.eye(4), {}) for geometry in document.geometries]
            else:
                bodies = document.scene.objects("geometry")
            for primitive in (part for body in bodies for part in body.primitives()):
                if isinstance(primitive, BoundLineSet):
                    continue
                triangles = primitive.triangleset() if hasattr(primitive, "triangleset") else primitive
                count += len(triangles)
                if count > INPUT_LIMITS.mesh_triangles:
                    raise wrong(file, f"{count} triangles in the scene", count, INPUT_LIMITS.mesh_triangles)
                if not len(triangles):
                    continue
                faces = np.asarray(triangles.vertex_index, dtype=np.intp).reshape(-1, 3)
                if faces.min() < 0:  # those that are too large are refused by pycollada
                    raise wrong(file, f"a triangle names vertex {faces.min()}", int(faces.min()), 0)
                material = primitive.material or document.materials.get(primitive.original.material)
                color = np.array(material.effect.diffuse if material and material.effect.diffuse else [np.nan] * 4)
                vertices = scale * np.asarray(triangles.vertex, dtype=float)
                parts.append(Triangles(vertices, faces, np.tile(color, (len(faces), 1))))
    except ModelError:
        raise
    except Exception as error:  # whatever pycollada stumbles over
        raise wrong(file, f"it is no Collada that can be read: {error}", type(error).__name__) from error
    return together(parts)


def _plain(file: Path, data: bytes) -> tuple[ElementTree.Element, float]:
    """The document with what pycollada shall read alone, and its unit, m.

    Borrowed nodes stand where they are borrowed, and effects are but a colour. What pycollada would read as something
    else than it says is refused.
    """
    try:
        given = parse_xml(data)
    except ElementTree.ParseError as error:
        raise wrong(file, f"it is not well-formed XML: {error}", error.position) from error
    except (ValueError, LookupError) as error:
        raise wrong(file, f"it cannot be read: {error}") from error
    for each in given.iter():
        each.tag = each.tag.rpartition("}")[2]
    if given.tag != "COLLADA":
        raise wrong(file, f"its root element is <{given.tag}>, not <COLLADA>", given.tag, "COLLADA")
    unit = given.find("asset/unit")
    scale = 1.0 if unit is None else float(unit.get("meter", 1.0))
    _check_numbers(file, given)
    _place_borrowed(file, given)
    root = _with_colors(given)
    root.set("xmlns", "http://www.collada.org/2005/11/COLLADASchema")
    root.extend(part for part in given if part.tag in ("library_geometries", "library_visual_scenes", "scene"))
    return root, scale


def _check_numbers(file: Path, root: ElementTree.Element) -> None:
    """Refuse what pycollada reads in part or as something else; make the axes of rotations unit vectors."""
    for part in root.iter():
        several = part.tag in ("triangles", "polylist") and len(part.findall("p")) > 1
        if several or part.tag in ("lookat", "skew", "ph"):
            raise wrong(file, f"a <{part.tag}> of this kind is not read: convert the file to STL", part.tag)
    for part in root.iter("rotate"):
        *axis, angle = (float(word) for word in (part.text or "").split())
        length = float(np.linalg.norm(axis))
        if not 0 < length < np.inf:
            raise wrong(file, f"<rotate>: the axis {axis} has no direction", tuple(axis))
        part.text = " ".join(str(value) for value in [*(np.array(axis) / length).tolist(), angle])
    for source in root.iter("source"):
        accessor = source.find("technique_common/accessor")
        if accessor is not None:
            stride, offset = int(accessor.get("stride", 1)), int(accessor.get("offset", 0))
            if offset or stride != len(accessor.findall("param")):
                message = f"an <accessor> of stride {stride}, offset {offset}: each <param> of it must be one number"
                raise wrong(file, message, (stride, offset))
        if "nan" in (source.findtext("float_array") or "").lower():
            raise wrong(file, f"<source> {source.get('id')!r}: a number is not finite")
    for part in root.iter("polylist"):
        counts = np.array((part.findtext("vcount") or "").split(), dtype=np.int64)
        stride = 1 + max((int(each.get("offset", 0)) for each in part.findall("input")), default=0)
        corners = len((part.findtext("p") or "").split()) / stride
        if (counts < 3).any() or counts.sum() != corners:
            raise wrong(file, f"<vcount> says {counts.sum()} corners, there are {corners:g}", int(counts.sum()))


def _place_borrowed(file: Path, root: ElementTree.Element) -> None:
    """Put nodes where they are borrowed, after how many they become is counted: those that borrow others double."""
    nodes = {each.get("id"): each for each in root.iter("node")}
    counts: dict[ElementTree.Element, int] = {}

    def count(node: ElementTree.Element, depth: int) -> int:
        if depth > INPUT_LIMITS.nesting:
            raise wrong(file, f"nodes within nodes, more than {INPUT_LIMITS.nesting} deep, or in a ring", depth)
        if node in counts:
            return counts[node]
        children = [child for child in node if child.tag not in ("instance_camera", "instance_light")]
        for k, child in enumerate(children):
            if child.tag == "instance_node":
                url = child.get("url", "").removeprefix("#")
                if url not in nodes:
                    raise wrong(file, f"<instance_node>: {url!r} names nothing in the file", url)
                children[k] = nodes[url]
        node[:] = children
        counts[node] = 1 + sum(count(child, depth + 1) for child in children if child.tag == "node")
        return counts[node]

    whole = sum(count(node, 0) for node in root.findall("library_visual_scenes/visual_scene/node"))
    if whole > INPUT_LIMITS.scene_nodes:
        raise wrong(file, f"{whole} nodes in the scene", whole, INPUT_LIMITS.scene_nodes)


def _with_colors(given: ElementTree.Element) -> ElementTree.Element:
    """A document of the materials of another alone, with their diffuse colours; where that is an image they have none.

    Programs do not agree what an opacity means: all are opaque.
    """
    root = ElementTree.Element("COLLADA")
    effects = {each.get("id"): each for each in given.iter("effect")}
    libraries = [ElementTree.SubElement(root, f"library_{what}") for what in ("effects", "materials")]
    known = {each.get("id", ""): each for each in given.iter("material")}
    for k, (name, material) in enumerate(known.items()):
        own = material.find("instance_effect")
        effect = None if own is None else effects.get(own.get("url", "").removeprefix("#"))
        said = None if effect is None else effect.findtext("profile_COMMON/technique/*/diffuse/color")
        plain = ElementTree.SubElement(libraries[0], "effect", id=f"effect{k}")
        for tag in ("profile_COMMON", "technique", "lambert", "diffuse", "color")[: 5 if said else 3]:
            plain = ElementTree.SubElement(plain, tag)
        if said:
            plain.text = " ".join(str(min(max(float(word), 0.0), 1.0)) for word in [*said.split()[:3], "1"])
        named = ElementTree.SubElement(libraries[1], "material", id=name)
        ElementTree.SubElement(named, "instance_effect", url=f"#effect{k}")
    for bound in given.iter("technique_common"):
        for each in bound.findall("instance_material"):
            if each.get("target", "").removeprefix("#") not in known:
                bound.remove(each)
    return root
