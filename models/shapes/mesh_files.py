"""Triangle meshes from files: STL (binary and text), OBJ and Collada, found by the names that URDF gives them.

Where the surface is and what colour its materials have is read; normals and textures are passed over. Collada is read
by pycollada, the others by numpy alone; a file is refused before it fills the memory.

What readers of mesh files have in common: triangles with colours, numbers in texts, and what is too much.

Collada documents (.dae) as triangles, with the colours of their materials, read by pycollada, of the extra `meshes`.

It is given a tree without entities, pictures, cameras and skins, opens no file, and never sees what it would read in
part, as something else, or without end. <unit> is applied, so that lengths are in m, <up_axis> is not, see
`models.shapes.mesh_files`. Positions have single precision, 6e-8 of their size. Of a material its diffuse colour is
taken; where that is an image there is none.
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
from typing import NamedTuple, TypeAlias
from urllib.parse import unquote, urlparse
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from models.arrays import Array, checked_text
from models.errors import ModelError
from models.input_files import INPUT_LIMITS, UnfitFile, parse_xml, read_regular

__all__ = ["read_collada"]

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


def without_colors(vertices: Array, faces: Faces) -> Triangles:
    """Triangles without colours."""
    return Triangles(vertices, faces, np.full((len(faces), 4), np.nan))


def join_meshes(parts: Sequence[Triangles]) -> Triangles:
    """All parts as one mesh."""
    if not parts:
        return without_colors(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.intp))
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


STL_HEAD = 84  # bytes
RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def find_mesh(
    file: str, folder: str | os.PathLike[str] | None, folders: Sequence[str | os.PathLike[str]] = ()
) -> Path | None:
    """The file that a URDF calls by a relative or absolute path, file:// or package://; None where there is none.

    package://NAME/REST is DIR/REST where DIR is called NAME, the package itself, else DIR/NAME/REST, for DIR of the
    folders, which may be the package whatever they are called, then of the URDF file's folder and those above it, and
    last of where packages are installed: those of ROS as ROS_PACKAGE_PATH and AMENT_PREFIX_PATH name them, and those
    that pip installed beside this one (share/). A relative path starts in any of the folders.

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
        candidates = []
        for place in [*places, *_installed()]:
            candidates += [place / rest] if place.name == address.netloc else []
            candidates += [place / address.netloc / rest]
            candidates += [place / rest] if place in given else []
    elif address.scheme == "file":
        candidates = [Path(unquote(address.path))]
    else:
        candidates = [place / file for place in [*own[:1], *places]] or [Path(file)]
    return next((path for path in candidates if _is_file(path)), None)


def _installed() -> list[Path]:
    """Folders of installed packages."""
    ros = [Path(place) for place in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if place]
    ament = [Path(place, "share") for place in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if place]
    pip = [Path(place, name) for place in sys.path for name in ("share", "cmeel.prefix/share") if place]
    return [*ros, *ament, *pip, Path(sys.prefix, "share")]


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name too long, with a null in it
        return False


def read_mesh(path: str | os.PathLike[str]) -> tuple[Array, Faces]:
    """Corners and triangles of a mesh file, as `read_painted_mesh`.

    Returns:
        Vertices, shape (n, 3), m, all of them finite and used; corners of each triangle as indices, shape (m, 3).
    """
    vertices, faces, _ = read_painted_mesh(path)
    return vertices, faces


def read_painted_mesh(path: str | os.PathLike[str]) -> Triangles:
    """Corners, triangles and colours of a mesh file, in the file's own axes.

    The name's ending says the format: .stl, .obj or .dae. Collada's <unit> is applied, so that lengths are in m; its
    <up_axis> is not, nor is it by RViz, MoveIt and other readers of URDF, for which robots' files are made. Polygons
    become fans of triangles; lines and points are left out.

    Args:
        path: Of the file.

    Returns:
        All vertices are finite and used. STL knows no colours, and of an OBJ file they are those of the libraries of
        materials beside it, where they are found.

    Raises:
        ModelError: No such file, an unknown ending, contents that are not the format's (with the line or element),
            no triangle, more than INPUT_LIMITS.
    """
    if not isinstance(path, str | os.PathLike):
        raise ModelError(f"mesh: path must be a path, not {path!r}", name="path", value=path)
    file = Path(path)
    reader = READERS.get(file.suffix.lower())
    if reader is None:
        message = f"mesh {str(file)!r}: only the endings {', '.join(READERS)} are read; convert the file to one of them"
        raise ModelError(message, name=str(file), value=file.suffix, limit=tuple(READERS))
    try:
        data = read_regular(
            file, INPUT_LIMITS.mesh_bytes if file.suffix.lower() == ".stl" else INPUT_LIMITS.mesh_text_bytes
        )
    except (OSError, ValueError) as error:
        size, most = (error.value, error.limit) if isinstance(error, UnfitFile) else (path, None)
        reason = getattr(error, "strerror", None) or error
        raise ModelError(
            f"mesh {str(file)!r} cannot be read: {reason}", name=str(file), value=size, limit=most
        ) from error
    vertices, faces, colors = reader(file, data)
    if not len(faces):
        raise wrong(file, "it has no triangle", 0, 1)
    if not np.isfinite(vertices).all():
        row = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise wrong(file, f"vertex {row} {vertices[row].tolist()} is not finite", vertices[row])
    used, faces = np.unique(faces, return_inverse=True)
    return Triangles(vertices[used], faces.reshape(-1, 3), colors)


# ------------------------------------------------------------------------------------------------------------- STL


def _read_stl(file: Path, data: bytes) -> Triangles:
    """A text begins with "solid", but so do binary files of some programs: the count of triangles decides."""
    count = int.from_bytes(data[STL_HEAD - 4 : STL_HEAD], "little") if len(data) >= STL_HEAD else -1
    exact = count >= 0 and len(data) == STL_HEAD + RECORD.itemsize * count
    if not exact and data[:512].lstrip()[:5].lower() == b"solid":
        return _read_stl_text(file, data)
    if count < 0 or len(data) < STL_HEAD + RECORD.itemsize * count:
        message = f"it is no STL text and, as binary, cut off: {len(data)} bytes, {max(count, 0)} triangles announced"
        raise wrong(file, message, len(data), STL_HEAD + RECORD.itemsize * max(count, 0))
    if count > INPUT_LIMITS.mesh_triangles:
        raise wrong(file, f"it has {count} triangles", count, INPUT_LIMITS.mesh_triangles)
    corners = np.frombuffer(data, RECORD, count, STL_HEAD)["corners"].reshape(-1, 3).astype(float)
    return _joined(corners)


def _read_stl_text(file: Path, data: bytes) -> Triangles:
    places = array("d")
    corners, last = 0, 0
    for number, line in lines_of(file, data):
        entries = line.split()
        if not entries:
            continue
        word = entries[0].lower()
        if word == "vertex":
            if len(entries) != 4:
                raise wrong(file, f"line {number}: a vertex of {len(entries) - 1} numbers", line.strip())
            places.extend(numbers(file, entries[1:], lambda number=number: f"line {number}"))  # type: ignore[misc]
            corners, last = corners + 1, number
        elif word == "endfacet":
            if corners != 3:
                raise wrong(file, f"line {number}: a facet of {corners} corners", corners, 3)
            corners = 0
            if len(places) > 9 * INPUT_LIMITS.mesh_triangles:
                raise wrong(file, f"line {number}: too many triangles", len(places) // 9, INPUT_LIMITS.mesh_triangles)
    if corners:
        raise wrong(file, f"line {last}: the file ends within a facet", corners)
    return _joined(np.array(places).reshape(-1, 3))


def _joined(corners: Array) -> Triangles:
    """Corners of triangles, three rows each, with those at the same place made one."""
    vertices, faces = np.unique(corners, axis=0, return_inverse=True)
    return without_colors(vertices, faces.reshape(-1, 3).astype(np.intp))


# ------------------------------------------------------------------------------------------------------------- OBJ


def _read_obj(file: Path, data: bytes) -> Triangles:
    vertices, count = array("d"), 0
    faces, paints, paint = array("q"), array("q"), 0
    library: dict[str, tuple[int, Array]] = {"": (0, np.full(4, np.nan))}
    for number, line in lines_of(file, data.replace(b"\\\n", b" ")):
        entries = line.partition("#")[0].split()
        if entries and entries[0] == "mtllib":
            for name, color in _library(file, line.split(None, 1)[1].strip() if len(entries) > 1 else ""):
                library.setdefault(name, (len(library), color))
        elif entries and entries[0] == "usemtl":
            paint = library.get(line.split(None, 1)[1].strip() if len(entries) > 1 else "", (0,))[0]
        if not entries or entries[0] not in ("v", "f"):
            continue
        place = f"line {number}"
        if entries[0] == "v":
            if len(entries) < 4:
                raise wrong(file, f"{place}: a vertex of {len(entries) - 1} numbers", line.strip())
            vertices.extend(numbers(file, entries[1:4], lambda place=place: place))  # type: ignore[misc]
            count += 1
            continue
        if len(entries) < 4:
            raise wrong(file, f"{place}: a face of {len(entries) - 1} corners", line.strip(), 3)
        corners = [_corner(file, entry, count, place) for entry in entries[1:]]
        for one, other in pairwise(corners[1:]):
            faces.extend((corners[0], one, other))
            paints.append(paint)
        if len(paints) > INPUT_LIMITS.mesh_triangles:
            raise wrong(file, f"{place}: too many triangles", len(paints), INPUT_LIMITS.mesh_triangles)
    found = np.array(faces, dtype=np.intp).reshape(-1, 3)
    if found.size and found.max() >= count:
        raise wrong(file, f"a face names vertex {int(found.max()) + 1} of {count}", int(found.max()) + 1)
    colors = np.array([color for _, color in library.values()])[np.array(paints, dtype=int)]
    return Triangles(np.array(vertices, dtype=float).reshape(-1, 3), found, colors)


def _library(file: Path, name: str) -> Iterator[tuple[str, Array]]:
    """Names and diffuse colours of a library of materials beside an OBJ file; nothing where it cannot be read."""
    try:
        data = read_regular(file.parent / name, INPUT_LIMITS.mesh_text_bytes)
    except (OSError, ValueError):
        return
    lines = data.decode("utf-8", errors="replace").splitlines()
    material = ""
    for line in lines:
        word, _, rest = line.strip().partition(" ")
        if word == "newmtl":
            material = rest.strip()
        elif word == "Kd" and material:
            with suppress(ValueError):
                color = np.array(rest.split()[:3], dtype=float)
                if color.shape == (3,) and np.isfinite(color).all():
                    yield material, np.append(np.clip(color, 0.0, 1.0), 1.0)


def _corner(file: Path, entry: str, count: int, place: str) -> int:
    """Index of v, v/vt or v/vt/vn: from one up, or from the last vertex so far down."""
    word = entry.partition("/")[0]
    try:
        index = int(word)
    except ValueError:
        raise wrong(file, f"{place}: {entry!r} is no corner of a face", entry) from None
    index = count + index if index < 0 else index - 1
    if not 0 <= index < 2**31:
        raise wrong(file, f"{place}: {entry!r} names no vertex of {count}", entry, (1, count))
    return index


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
    return join_meshes(parts)


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


READERS: dict[str, Callable[[Path, bytes], Triangles]] = {".stl": _read_stl, ".obj": _read_obj, ".dae": read_collada}
