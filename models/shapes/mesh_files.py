"""Triangle meshes from files: STL (binary and text), OBJ and Collada, located by the names that a URDF gives them.

The readers return the surface and its diffuse colours, and ignore normals and textures. STL and OBJ are read by numpy
alone, Collada (.dae) by pycollada, of the extra `meshes`. It receives a document without entities, images, cameras and
skins, and opens no file. Elements that it would read in part, misinterpret, or expand without bound are removed or
refused beforehand.
"""

from __future__ import annotations

import os
import sys
import warnings
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from io import BytesIO, TextIOWrapper
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias
from urllib.parse import unquote, urlparse
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from models.checks import Array, require
from models.errors import ModelError
from models.files import INPUT_LIMITS, UnfitFile, parse_xml, read_regular

Faces: TypeAlias = NDArray[np.intp]

STL_HEADER_BYTES = 84
"""Number of bytes before the first record of a binary STL file."""
STL_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


class Triangles(NamedTuple):
    """A triangle mesh: vertices, triangles and their colours."""

    vertices: Array  # shape (n, 3), m
    faces: Faces  # triangles as indices of vertices. Shape (m, 3).
    colors: Array  # red, green, blue and opacity of each triangle, 0 to 1; nan if the file gives none. Shape (m, 4).


def without_colors(vertices: Array, faces: Faces) -> Triangles:
    """Return a triangle mesh of given vertices and faces whose colours are unknown."""
    return Triangles(vertices, faces, np.full((len(faces), 4), np.nan))


def join_meshes(parts: Sequence[Triangles]) -> Triangles:
    """Join several triangle meshes into one mesh."""
    if not parts:
        return without_colors(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.intp))
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + offset for part, offset in zip(parts, offsets, strict=False)]
    colors = [part.colors for part in parts]
    return Triangles(np.concatenate([part.vertices for part in parts]), np.concatenate(faces), np.concatenate(colors))


def mesh_error(file: Path, fault: str, value: object = None, limit: object = None) -> ModelError:
    """Return the ModelError about a mesh file; `fault` states what is wrong."""
    bound = f", limit {limit}" if isinstance(limit, int) else ""
    return ModelError(f"mesh {str(file)!r}: {fault}{bound}", name=str(file), value=value, limit=limit)


def numbered_lines(file: Path, data: bytes) -> Iterator[tuple[int, str]]:
    """Return an iterator over (line number from 1, line) of a text file; raise ModelError if the file is too long."""
    if len(data) > INPUT_LIMITS.mesh_text_bytes:
        raise mesh_error(file, f"it has {len(data)} bytes of text", len(data), INPUT_LIMITS.mesh_text_bytes)
    return enumerate(TextIOWrapper(BytesIO(data), "utf-8", errors="replace"), start=1)


def parse_numbers(file: Path, words: Sequence[str], line: int) -> list[float]:
    """Convert words of a line to numbers; raise a ModelError, which names the line, if a word is not a number."""
    values = []
    for word in words:
        try:
            values.append(float(word))
        except ValueError:
            raise mesh_error(file, f"line {line}: {word!r} is no number", word) from None
    return values


def find_mesh(
    file: str, folder: str | os.PathLike[str] | None, folders: Sequence[str | os.PathLike[str]] = ()
) -> Path | None:
    """Return the path of a mesh file that a URDF names, or None if there is no such file.

    A name is a relative or absolute path, file://PATH, or package://NAME/REST. A package is searched in `folders`, then
    in the URDF file's folder and its parents, last in installed packages: those of ROS by ROS_PACKAGE_PATH and
    AMENT_PREFIX_PATH, and those of pip (share/). In a folder DIR it is DIR/REST if DIR is called NAME, else
    DIR/NAME/REST, or for one of `folders` DIR/REST whatever its name. A relative path may start in any of the folders.

    Args:
        file: Name in the URDF.
        folder: Folder of the URDF file; None if unknown.
        folders: Folders to search first.

    Raises:
        ModelError: The name is no text, or a folder is no path.
    """
    require.text("mesh: file", file)
    try:
        searched = [Path(each) for each in folders]
        urdf_folders = [] if not folder else [Path(folder).resolve(), *Path(folder).resolve().parents]
    except TypeError as error:
        message = f"mesh {file!r}: folders must be paths, not {folders!r}"
        raise ModelError(message, name="folders", value=folders) from error
    url = urlparse(file)
    if url.scheme in ("package", "model"):
        rest = unquote(url.path).lstrip("/")
        candidates = []
        for parent in [*searched, *urdf_folders, *_package_folders()]:
            candidates += [parent / rest] if parent.name == url.netloc else []
            candidates += [parent / url.netloc / rest]
            candidates += [parent / rest] if parent in searched else []
    elif url.scheme == "file":
        candidates = [Path(unquote(url.path))]
    else:
        candidates = [parent / file for parent in [*urdf_folders[:1], *searched, *urdf_folders]] or [Path(file)]
    return next((path for path in candidates if _is_file(path)), None)


def _package_folders() -> list[Path]:
    """Return the folders that are searched for installed ROS and pip packages."""
    ros = [Path(folder) for folder in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if folder]
    ament = [Path(folder, "share") for folder in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if folder]
    pip = [Path(folder, name) for folder in sys.path for name in ("share", "cmeel.prefix/share") if folder]
    return [*ros, *ament, *pip, Path(sys.prefix, "share")]


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # the name is too long or contains a null character
        return False


def read_mesh(path: str | os.PathLike[str]) -> tuple[Array, Faces]:
    """Return the vertices, (n, 3), m, and the triangles, (m, 3), of a mesh file, read by `read_painted_mesh`."""
    return read_painted_mesh(path)[:2]


def read_painted_mesh(path: str | os.PathLike[str]) -> Triangles:
    """Return vertices, triangles and colours of a mesh file; coordinates are in the axes of the file.

    The suffix tells the format: .stl, .obj or .dae. Collada's <unit> is applied, so that lengths are in m. Its
    <up_axis> is ignored, as by RViz, MoveIt and other readers of URDF, for which robots' files are made. Polygons
    become fans of triangles; lines and points are ignored.


    Returns:
        The mesh; all vertices are finite and referenced. STL has no colours. The colours of an OBJ file are those of
        the material libraries beside it, if found.

    Raises:
        ModelError: The file does not exist, its suffix is unknown, its content is invalid (with the line or element),
            it has no triangle, or it exceeds INPUT_LIMITS.
    """
    if not isinstance(path, str | os.PathLike):
        raise ModelError(f"mesh: path must be a path, not {path!r}", name="path", value=path)
    file = Path(path)
    reader = READERS.get(file.suffix.lower())
    if reader is None:
        message = f"mesh {str(file)!r}: only the endings {', '.join(READERS)} are read; convert the file to one of them"
        raise ModelError(message, name=str(file), value=file.suffix, limit=tuple(READERS))
    max_bytes = INPUT_LIMITS.mesh_bytes if file.suffix.lower() == ".stl" else INPUT_LIMITS.mesh_text_bytes
    try:
        data = read_regular(file, max_bytes)
    except (OSError, ValueError) as error:
        size, limit = (error.value, error.limit) if isinstance(error, UnfitFile) else (path, None)
        message = f"mesh {str(file)!r} cannot be read: {getattr(error, 'strerror', None) or error}"
        raise ModelError(message, name=str(file), value=size, limit=limit) from error
    vertices, faces, colors = reader(file, data)
    if not len(faces):
        raise mesh_error(file, "it has no triangle", 0, 1)
    if not np.isfinite(vertices).all():
        row = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise mesh_error(file, f"vertex {row} {vertices[row].tolist()} is not finite", vertices[row])
    used, faces = np.unique(faces, return_inverse=True)
    return Triangles(vertices[used], faces.reshape(-1, 3), colors)


def _read_stl(file: Path, data: bytes) -> Triangles:
    """Read a binary or text STL file; the size of the file decides which, since both kinds may begin with "solid"."""
    header = data[:STL_HEADER_BYTES]
    count = int.from_bytes(header[-4:], "little") if len(header) == STL_HEADER_BYTES else -1
    exact = count >= 0 and len(data) == STL_HEADER_BYTES + STL_RECORD.itemsize * count
    if not exact and data[:512].lstrip()[:5].lower() == b"solid":
        return _read_stl_text(file, data)
    if count < 0 or len(data) < STL_HEADER_BYTES + STL_RECORD.itemsize * count:
        message = (
            f"it is neither an STL text nor a complete binary STL: {len(data)} bytes for {max(count, 0)} "
            "triangles by its header"
        )
        raise mesh_error(file, message, len(data), STL_HEADER_BYTES + STL_RECORD.itemsize * max(count, 0))
    if count > INPUT_LIMITS.mesh_triangles:
        raise mesh_error(file, f"it has {count} triangles", count, INPUT_LIMITS.mesh_triangles)
    corners = np.frombuffer(data, STL_RECORD, count, STL_HEADER_BYTES)["corners"].reshape(-1, 3).astype(float)
    return _merge_vertices(corners)


def _read_stl_text(file: Path, data: bytes) -> Triangles:
    coordinates = array("d")
    corners, last = 0, 0
    for number, line in numbered_lines(file, data):
        entries = line.split()
        if not entries:
            continue
        word = entries[0].lower()
        if word == "vertex":
            if len(entries) != 4:
                raise mesh_error(file, f"line {number}: a vertex of {len(entries) - 1} numbers", line.strip())
            coordinates.extend(parse_numbers(file, entries[1:], number))
            corners, last = corners + 1, number
        elif word == "endfacet":
            if corners != 3:
                raise mesh_error(file, f"line {number}: a facet of {corners} corners", corners, 3)
            corners, count = 0, len(coordinates) // 9
            if count > INPUT_LIMITS.mesh_triangles:
                raise mesh_error(file, f"line {number}: too many triangles", count, INPUT_LIMITS.mesh_triangles)
    if corners:
        raise mesh_error(file, f"line {last}: the file ends within a facet", corners)
    return _merge_vertices(np.array(coordinates).reshape(-1, 3))


def _merge_vertices(corners: Array) -> Triangles:
    """Return a triangle mesh, given three rows of `corners` for each triangle; coincident corners are merged."""
    first, faces = distinct_rows(corners)
    return without_colors(corners[first], faces.reshape(-1, 3))


def distinct_rows(rows: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of a table's distinct rows in sorted order, and each row's number among the distinct rows.

    Several times faster than `np.unique` with an axis.
    """
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    is_new = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1))[: len(rows)]
    which = np.empty(len(rows), dtype=np.intp)
    which[order] = np.cumsum(is_new) - 1
    return order[is_new], which


def _read_obj(file: Path, data: bytes) -> Triangles:
    vertices, count = array("d"), 0
    corners, materials, material = array("q"), array("q"), 0
    library: dict[str, tuple[int, Array]] = {"": (0, np.full(4, np.nan))}
    for number, line in numbered_lines(file, data.replace(b"\\\n", b" ")):
        entries = line.partition("#")[0].split()
        keyword = entries[0] if entries else ""
        argument = line.split(None, 1)[1].strip() if len(entries) > 1 else ""
        if keyword == "mtllib":
            for name, color in _material_colors(file, argument):
                library.setdefault(name, (len(library), color))
        elif keyword == "usemtl":
            material = library.get(argument, (0,))[0]
        elif keyword == "v":
            if len(entries) < 4:
                raise mesh_error(file, f"line {number}: a vertex of {len(entries) - 1} numbers", line.strip())
            vertices.extend(parse_numbers(file, entries[1:4], number))
            count += 1
        elif keyword == "f":
            if len(entries) < 4:
                raise mesh_error(file, f"line {number}: a face of {len(entries) - 1} corners", line.strip(), 3)
            polygon = [_vertex_index(file, entry, count, number) for entry in entries[1:]]
            for second, third in pairwise(polygon[1:]):
                corners.extend((polygon[0], second, third))
                materials.append(material)
            if len(materials) > INPUT_LIMITS.mesh_triangles:
                message = f"line {number}: too many triangles"
                raise mesh_error(file, message, len(materials), INPUT_LIMITS.mesh_triangles)
    faces = np.array(corners, dtype=np.intp).reshape(-1, 3)
    if faces.size and faces.max() >= count:
        raise mesh_error(file, f"a face names vertex {int(faces.max()) + 1} of {count}", int(faces.max()) + 1)
    colors = np.array([color for _, color in library.values()])[np.array(materials, dtype=int)]
    return Triangles(np.array(vertices, dtype=float).reshape(-1, 3), faces, colors)


def _material_colors(file: Path, name: str) -> Iterator[tuple[str, Array]]:
    """Yield names and diffuse colours of the materials in an OBJ file's library, or nothing if it is unreadable."""
    try:
        data = read_regular(file.parent / name, INPUT_LIMITS.mesh_text_bytes)
    except (OSError, ValueError):
        return
    material = ""
    for line in data.decode("utf-8", errors="replace").splitlines():
        word, _, rest = line.strip().partition(" ")
        if word == "newmtl":
            material = rest.strip()
        elif word == "Kd" and material:
            with suppress(ValueError):
                color = np.array(rest.split()[:3], dtype=float)
                if color.shape == (3,) and np.isfinite(color).all():
                    yield material, np.append(np.clip(color, 0.0, 1.0), 1.0)


def _vertex_index(file: Path, entry: str, count: int, line: int) -> int:
    """Return the vertex index, from zero, of a face corner "v", "v/vt" or "v/vt/vn"; negative v count from the end."""
    try:
        index = int(entry.partition("/")[0])
    except ValueError:
        raise mesh_error(file, f"line {line}: {entry!r} is no corner of a face", entry) from None
    index = count + index if index < 0 else index - 1
    if not 0 <= index < 2**31:
        raise mesh_error(file, f"line {line}: {entry!r} names no vertex of {count}", entry, (1, count))
    return index


def read_collada(file: Path, data: bytes) -> Triangles:
    """Return the triangles of a Collada file's scene, or of all geometries if the file has no scene."""
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
        tree, scale = _simplify(file, data)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", DeprecationWarning)  # numpy's only report of a text that is not all numbers
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
                    raise mesh_error(file, f"{count} triangles in the scene", count, INPUT_LIMITS.mesh_triangles)
                if not len(triangles):
                    continue
                faces = np.asarray(triangles.vertex_index, dtype=np.intp).reshape(-1, 3)
                if faces.min() < 0:  # pycollada itself refuses indices that are too large
                    raise mesh_error(file, f"a triangle names vertex {faces.min()}", int(faces.min()), 0)
                material = primitive.material or document.materials.get(primitive.original.material)
                color = np.array(material.effect.diffuse if material and material.effect.diffuse else [np.nan] * 4)
                vertices = scale * np.asarray(triangles.vertex, dtype=float)
                parts.append(Triangles(vertices, faces, np.tile(color, (len(faces), 1))))
    except ModelError:
        raise
    except Exception as error:  # pycollada raises many kinds
        raise mesh_error(file, f"it is no Collada document that can be read: {error}", type(error).__name__) from error
    return join_meshes(parts)


def _simplify(file: Path, data: bytes) -> tuple[ElementTree.Element, float]:
    """Return a Collada document reduced to elements that pycollada reads correctly, and its unit of length, m."""
    try:
        document = parse_xml(data)
    except ElementTree.ParseError as error:
        raise mesh_error(file, f"it is not well-formed XML: {error}", error.position) from error
    except (ValueError, LookupError) as error:
        raise mesh_error(file, f"it cannot be read: {error}") from error
    for each in document.iter():
        each.tag = each.tag.rpartition("}")[2]
    if document.tag != "COLLADA":
        raise mesh_error(file, f"its root element is <{document.tag}>, not <COLLADA>", document.tag, "COLLADA")
    unit = document.find("asset/unit")
    scale = 1.0 if unit is None else float(unit.get("meter", 1.0))
    _check_numbers(file, document)
    _resolve_instances(file, document)
    root = _materials_document(document)
    root.set("xmlns", "http://www.collada.org/2005/11/COLLADASchema")
    root.extend(part for part in document if part.tag in ("library_geometries", "library_visual_scenes", "scene"))
    return root, scale


def _check_numbers(file: Path, root: ElementTree.Element) -> None:
    """Raise ModelError for elements of a Collada document that pycollada misreads; normalise the axes of rotations."""
    for part in root.iter():
        several = part.tag in ("triangles", "polylist") and len(part.findall("p")) > 1
        if several or part.tag in ("lookat", "skew", "ph"):
            raise mesh_error(file, f"a <{part.tag}> of this kind is not supported; convert the file to STL", part.tag)
    for part in root.iter("rotate"):
        *axis, angle = (float(word) for word in (part.text or "").split())
        length = float(np.linalg.norm(axis))
        if not 0 < length < np.inf:
            raise mesh_error(file, f"<rotate>: the axis {axis} has no direction", tuple(axis))
        part.text = " ".join(str(value) for value in [*(np.array(axis) / length).tolist(), angle])
    for source in root.iter("source"):
        accessor = source.find("technique_common/accessor")
        if accessor is not None:
            stride, offset = int(accessor.get("stride", 1)), int(accessor.get("offset", 0))
            if offset or stride != len(accessor.findall("param")):
                message = f"an <accessor> of stride {stride}, offset {offset}: each <param> of it must be one number"
                raise mesh_error(file, message, (stride, offset))
        if "nan" in (source.findtext("float_array") or "").lower():
            raise mesh_error(file, f"<source> {source.get('id')!r}: a number is not finite")
    for part in root.iter("polylist"):
        counts = np.array((part.findtext("vcount") or "").split(), dtype=np.int64)
        stride = 1 + max((int(each.get("offset", 0)) for each in part.findall("input")), default=0)
        corners = len((part.findtext("p") or "").split()) / stride
        if (counts < 3).any() or counts.sum() != corners:
            message = f"<vcount> announces {counts.sum()} corners, the polygons have {corners:g}"
            raise mesh_error(file, message, int(counts.sum()))


def _resolve_instances(file: Path, root: ElementTree.Element) -> None:
    """Replace node instances in a Collada document by copies of the nodes; raise ModelError if copies are too many."""
    nodes = {each.get("id"): each for each in root.iter("node")}
    counts: dict[ElementTree.Element, int] = {}

    def count(node: ElementTree.Element, depth: int) -> int:
        if depth > INPUT_LIMITS.nesting:
            raise mesh_error(file, f"nodes are nested more than {INPUT_LIMITS.nesting} deep, or in a cycle", depth)
        if node in counts:
            return counts[node]
        children = [child for child in node if child.tag not in ("instance_camera", "instance_light")]
        for k, child in enumerate(children):
            if child.tag == "instance_node":
                url = child.get("url", "").removeprefix("#")
                if url not in nodes:
                    raise mesh_error(file, f"<instance_node>: {url!r} names nothing in the file", url)
                children[k] = nodes[url]
        node[:] = children
        counts[node] = 1 + sum(count(child, depth + 1) for child in children if child.tag == "node")
        return counts[node]

    total = sum(count(node, 0) for node in root.findall("library_visual_scenes/visual_scene/node"))
    if total > INPUT_LIMITS.scene_nodes:
        raise mesh_error(file, f"{total} nodes in the scene", total, INPUT_LIMITS.scene_nodes)


def _materials_document(document: ElementTree.Element) -> ElementTree.Element:
    """Return a reduced Collada document: only materials and their diffuse colours, opaque and without images."""
    root = ElementTree.Element("COLLADA")
    effects = {each.get("id"): each for each in document.iter("effect")}
    libraries = [ElementTree.SubElement(root, f"library_{kind}") for kind in ("effects", "materials")]
    known = {each.get("id", ""): each for each in document.iter("material")}
    for k, (name, material) in enumerate(known.items()):
        instance = material.find("instance_effect")
        effect = None if instance is None else effects.get(instance.get("url", "").removeprefix("#"))
        color = None if effect is None else effect.findtext("profile_COMMON/technique/*/diffuse/color")
        element = ElementTree.SubElement(libraries[0], "effect", id=f"effect{k}")
        for tag in ("profile_COMMON", "technique", "lambert", "diffuse", "color")[: 5 if color else 3]:
            element = ElementTree.SubElement(element, tag)
        if color:
            element.text = " ".join(str(min(max(float(word), 0.0), 1.0)) for word in [*color.split()[:3], "1"])
        element = ElementTree.SubElement(libraries[1], "material", id=name)
        ElementTree.SubElement(element, "instance_effect", url=f"#effect{k}")
    for bound in document.iter("technique_common"):
        for each in bound.findall("instance_material"):
            if each.get("target", "").removeprefix("#") not in known:
                bound.remove(each)
    return root


READERS: dict[str, Callable[[Path, bytes], Triangles]] = {".stl": _read_stl, ".obj": _read_obj, ".dae": read_collada}
