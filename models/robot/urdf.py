"""Reading of robot descriptions in URDF, the XML format of ROS, also from files of its macro language xacro.

<transmission>, <gazebo>, <safety_controller>, <dynamics>, unknown elements and invalid <visual> elements are skipped.
Faults that other readers accept are left out with a warning that names them. Mesh files are recorded by name and
folder; `models.shapes.bodies` reads them.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from math import copysign, cos, inf, isfinite, sin
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar, get_args
from warnings import warn
from xml.etree import ElementTree

import numpy as np

from models.checks import MAX_LISTED, Array, require, warn_of_degrees
from models.errors import ModelError, ModelWarning
from models.files import INPUT_LIMITS, parse_xml, read_regular
from models.robot.parts import MOMENTS, SHAPES, UNLIMITED, CollisionShape, Joint, Kind, Link, Mimic, VisualShape
from models.robot.tree import replace_floating, replace_planar

Source: TypeAlias = str | os.PathLike[str]
InertiaRule: TypeAlias = Literal["warn", "as_given"]
_Shape = TypeVar("_Shape", bound=CollisionShape)

MOVING: dict[str, Kind] = {"revolute": "revolute", "continuous": "continuous", "prismatic": "prismatic"}
COMPOSITE = ("planar", "floating")
"""Kinds of joints with several degrees of freedom."""
XACRO_EXTRA = 'the extra xacro: pip install "selfmotion[xacro]", or from a clone pip install ".[xacro]"'
XACRO = (
    "this is xacro, the macro language that URDF files are made from; expand it first: xacro FILE > FILE.urdf, or, if "
    "you trust the file, since xacro evaluates its Python expressions: Robot.from_urdf(expand_xacro(FILE)), with "
    + XACRO_EXTRA
)
XACRO_WORDS = {
    "arg", "attribute", "call", "element", "if", "include", "insert_block", "macro", "property", "unless",
}  # fmt: skip
"""Elements of xacro's own language. Any other element of its namespace calls a macro."""
BLANK = "\ufeff \t\r\n"
"""Characters, such as a byte order mark, that may precede the first "<" of a URDF text."""
ATTRIBUTES: dict[str, tuple[str, ...]] = {
    "limit": ("lower", "upper", "velocity", "effort"),
    "mimic": ("joint", "multiplier", "offset"),
    "origin": ("xyz", "rpy"),
    "axis": ("xyz",),
    "mass": ("value",),
    "inertia": MOMENTS,
    "box": ("size",),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
    "mesh": ("filename", "scale"),
}
"""Known attributes of those URDF elements that are checked for misspelt attributes, by element."""


@dataclass(frozen=True, eq=False)
class Description:
    """Content of a robot description (URDF or MJCF): name, links, joints and tip."""

    name: str  # name of the robot; "robot" if the file has none
    links: tuple[Link, ...]  # in the order of the file
    joints: tuple[Joint, ...]  # in the order of the file
    tip: str | None = None  # link that carries the tip, from the non-standard element <tip link="NAME"/>, or None


def read_urdf(source: Source, *, inertia: InertiaRule = "warn") -> Description:
    """Read the description of a robot in URDF, the XML format of ROS, from a text or a file.

    Missing data have the default values of the format: a zero origin, the axis x, no inertia. A revolute or prismatic
    joint whose <limit> has only one of lower and upper has 0 for the other; with neither, or without <limit>, it has no
    position limits. The same holds for effort and velocity, and a limit of `UNLIMITED` is none. A floating joint
    between a massless root and its only child means that the robot floats: both are omitted, and the base of
    `FreeFloating` moves in their place. Any other floating or planar joint becomes a chain of joints with one degree of
    freedom, without limits, see `models.robot.tree`. A <mimic> of a fixed joint is ignored.

    Left out with one warning that names them, as other readers load such files: collision shapes with an edge, radius,
    length or scale of zero; all shapes of a <geometry> but the first; misspelt and unknown attributes, for which the
    defaults apply; elements and attributes whose namespace prefix is not declared; calls of macros that a file expanded
    from xacro still contains.

    Args:
        source: The text, recognised by its first character "<", or the path of a file.
        inertia: Treatment of physically impossible inertias: accept them with a warning ("warn") or silently
            ("as_given").

    Raises:
        ModelError: No such file, malformed XML, xacro, missing or non-numeric attributes, duplicate elements,
            unsupported kinds of joints or shapes, impossible masses, limits or shapes.

    Warns:
        ModelWarning: Parts that are left out; physically impossible inertias; angles that look like degrees, lengths
            that look like millimetres (see `models.checks.warn_of_degrees`); collision shapes of an omitted root link.
    """
    require.choice("URDF: inertia", inertia, get_args(InertiaRule))
    omitted: list[str] = []
    tree = parse_urdf(source, omitted)
    is_file = isinstance(source, os.PathLike) or not source.lstrip(BLANK).startswith("<")
    folder = str(Path(source).resolve().parent) if is_file else ""
    omitted += [note for kind in ("link", "joint") for part in tree.findall(kind) for note in _unknown_attributes(part)]
    links = _links(tree, inertia, folder, omitted)
    described = [(each, _joint(each)) for each in tree.findall("joint")]
    joints = tuple(joint for _, joint in described)
    for element, joint in described:
        if (kind := element.get("type")) == "floating":
            links, joints = replace_floating(joint, links, joints)
        elif kind == "planar":
            links, joints = replace_planar(joint, _axis(element), links, joints)
    omission_warning(omitted, f"file {os.fspath(source)!r}" if is_file else "the given text")
    tip = _only(tree, "tip", "the robot")
    tip_name = None if tip is None else text_of(tip, "link", "the robot")
    return Description(tree.get("name") or "robot", links, joints, tip_name)


def omission_warning(omitted: Sequence[str], origin: str) -> None:
    """Warn about the parts of a robot description that are left out, if there are any, and name the description."""
    if omitted := list(dict.fromkeys(omitted)):
        more = f"; and {len(omitted) - MAX_LISTED} more" if len(omitted) > MAX_LISTED else ""
        message = f"{origin}: these parts are left out: {'; '.join(omitted[:MAX_LISTED])}{more}"
        warn(ModelWarning(message, name=omitted[0], value=tuple(omitted)), stacklevel=4)


def expand_xacro(file: str | os.PathLike[str]) -> str:
    """Return the URDF text that a xacro file describes, for `Robot.from_urdf`.

    Needs the package `xacrodoc`, the extra `xacro`. The file can include others and evaluates Python expressions, so
    expand only files that you trust. Relative names of meshes are completed with the folder of the file.

    Raises:
        ModelError: There is no such file, xacro cannot expand it, or the package is not installed.
    """
    if not isinstance(file, str | os.PathLike):
        raise ModelError(f"expand_xacro: a file name is expected, not {file!r}", name="file", value=file)
    try:
        import xacrodoc  # lets xacro find packages without ROS
        from xacro import process_file
    except ImportError as error:
        message = f"expanding xacro needs the package xacrodoc, {XACRO_EXTRA}"
        raise ModelError(message, name="xacro", value="xacrodoc") from error
    try:
        read_regular(file, INPUT_LIMITS.description_bytes)  # only to refuse what is no file
        xacrodoc.packages.walk_up_from(file)
        document = process_file(os.fspath(file))
        for mesh in document.getElementsByTagName("mesh"):
            if "://" not in (name := mesh.getAttribute("filename")):
                mesh.setAttribute("filename", os.path.join(os.path.dirname(os.path.abspath(file)), name))
        return str(document.toxml())
    except Exception as error:  # of any kind: the expressions are the file's own
        name = f"file {os.fspath(file)!r}"
        raise ModelError(f"{name} cannot be expanded by xacro: {error}", name=name, value=file) from error


def parse_urdf(source: Source, omitted: list[str] | None = None) -> ElementTree.Element:
    """Return the <robot> element of a URDF or SRDF text or file, without namespaces and undeclared prefixes.

    Descriptions of omitted prefixes and of calls of macros are appended to `omitted`.

    Raises:
        ModelError: The source is unreadable, or xacro.
    """
    unbound: list[str] = []
    tree, origin = parse_file(source, "URDF", unbound)
    namespace = tree.tag[: tree.tag.rfind("}") + 1]
    macros = [name.partition(":")[2] for name in unbound if name.startswith("xacro:")]
    for element in tree.iter():
        if namespace and element.tag.startswith(namespace):
            element.tag = element.tag[len(namespace) :]
        elif "xacro" in element.tag.rpartition("}")[0]:
            macros.append(element.tag.rpartition("}")[2])
    for tag in macros:
        if tag in XACRO_WORDS or tree.find("link") is None:
            raise ModelError(f"{origin} has the element <xacro:{tag}>: {XACRO}", name=tag, value=tag)
    if omitted is not None:
        omitted += [f"{name}, whose prefix is not declared" for name in unbound if not name.startswith("xacro:")]
        omitted += [f"<xacro:{tag}>, a macro that is not defined" for tag in macros]
    if tree.tag != "robot":
        hint = "; Robot.from_mjcf reads MJCF" if tree.tag in ("mujoco", "sdf") else ""
        message = f"{origin} is not URDF: its root element is <{tree.tag}>, not <robot>{hint}"
        raise ModelError(message, name=origin, value=tree.tag, limit="robot")
    return tree


def parse_file(source: Source, kind: str, unbound: list[str] | None = None) -> tuple[ElementTree.Element, str]:
    """Return the root element of an XML text or file, and a phrase that names this source in error messages.

    Args:
        source: The text, recognised by its first character "<", or the path of a file.
        kind: Name of the format, for messages.
        unbound: As in `models.files.parse_xml`.

    Raises:
        ModelError: The source is unreadable or malformed.
    """
    text, lines_before = "", 0
    if isinstance(source, str):
        text = source.lstrip(BLANK)
        lines_before = source[: len(source) - len(text)].count("\n")
        if not text:
            message = f"source: an empty text cannot be read as {kind}; give the XML or the path of a file"
            raise ModelError(message, name="source", value=source)
    elif not isinstance(source, os.PathLike):
        message = f"a {kind} source is a text or a path, not {type(source).__name__}"
        raise ModelError(message, name="source", value=source)
    is_text = text.startswith("<")
    origin = "the given text" if is_text else f"file {os.fspath(source)!r}"
    try:
        data: str | bytes = text if is_text else read_regular(source, INPUT_LIMITS.description_bytes)
        return parse_xml(data, unbound), origin
    except ElementTree.ParseError as error:
        line, column = error.position
        reason = str(error).split(": line")[0]
        message = f"{origin} is not well-formed XML: {reason}, line {line + lines_before}, column {column}"
        raise ModelError(message, name=origin, value=(line + lines_before, column)) from error
    except OSError as error:
        message = f"{origin} cannot be read: {error.strerror or error}; a {kind} text begins with '<'"
        raise ModelError(message, name=origin, value=source) from error
    except (ValueError, LookupError) as error:
        raise ModelError(f"{origin} cannot be read: {error}", name=origin, value=source) from error


def _links(tree: ElementTree.Element, rule: InertiaRule, folder: str, omitted: list[str]) -> tuple[Link, ...]:
    links, reasons = [], []
    colors = {each.get("name"): color for each in tree.findall("material") if (color := _color(each)) is not None}
    for arguments in (_link_arguments(element, folder, colors, omitted) for element in tree.findall("link")):
        try:
            links.append(Link(**arguments))
            continue
        except ModelError as error:
            reasons.append(str(error))
        links.append(Link(**arguments, any_inertia=True))  # raises for any error but the inertia
    if reasons and rule == "warn":
        words = f"inertias that no body can have are taken as given: {'; '.join(reasons)}. Correct the file, or "
        warn(f"{words}silence this warning: from_urdf(..., inertia='as_given')", ModelWarning, 4)
    if not links:
        raise ModelError(f"the robot {tree.get('name') or ''!r} has no <link>", name="link", value=0, limit=1)
    return tuple(links)


def _link_arguments(
    element: ElementTree.Element, folder: str, colors: dict[str | None, Array], omitted: list[str]
) -> dict[str, Any]:
    """Return the arguments of `Link` that a <link> element describes; append omitted collision shapes to `omitted`."""
    name = name_of(element)
    owner = f"link {name!r}"
    shapes: list[CollisionShape] = []
    for each in element.findall("collision"):
        shapes += _shape(each, owner, folder, CollisionShape, omitted)
    visuals: list[VisualShape] = []
    for each in element.findall("visual"):
        material = each.find("material")
        color = None if material is None else _color(material)
        if color is None and material is not None:
            color = colors.get(material.get("name"))
        with suppress(ModelError):
            visuals += _shape(each, owner, folder, VisualShape, [], color=color)
    body = _only(element, "inertial", owner)
    if body is None:
        return {"name": name, "collisions": tuple(shapes), "visuals": tuple(visuals)}
    center, orientation = origin_of(body, owner)
    mass = number_of(child_of(body, "mass", owner), "value", owner)
    moments = child_of(body, "inertia", owner)
    xx, xy, xz, yy, yz, zz = (number_of(moments, key, owner) for key in MOMENTS)
    inertia = orientation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ orientation.T
    arguments = {"name": name, "mass": mass, "center_of_mass": center, "inertia": inertia}
    return {**arguments, "collisions": tuple(shapes), "visuals": tuple(visuals)}


def _color(material: ElementTree.Element) -> Array | None:
    """Return red, green, blue and opacity, each 0 to 1, of a <material> element, or None without a valid colour."""
    try:
        color = np.array((material.find("color").get("rgba") or "").split(), dtype=float)  # type: ignore[union-attr]
    except (AttributeError, ValueError):
        return None
    return np.clip(color, 0.0, 1.0) if color.shape == (4,) and np.isfinite(color).all() else None


def _shape(
    element: ElementTree.Element, owner: str, folder: str, shape_type: type[_Shape], omitted: list[str], **options: Any
) -> list[_Shape]:
    """Return a list with the shape of a <collision> or <visual> element; it is empty if the shape has no volume."""
    shapes: list[Any] = list(child_of(element, "geometry", owner))
    if not shapes:
        raise ModelError(f"{owner}: <geometry> has 0 shapes, not one", name="geometry", value=0, limit=1)
    shape = shapes[0]
    omitted += [f"{owner}: <{each.tag}>, since its <geometry> begins with <{shape.tag}>" for each in shapes[1:]]
    kind = require.choice(f"{owner}: shape", shape.tag, SHAPES)
    file = text_of(shape, "filename", owner) if kind == "mesh" else ""
    if kind in ("box", "mesh"):
        key = "size" if kind == "box" else "scale"
        size = np.ones(3) if kind == "mesh" and key not in shape.attrib else numbers_of(shape, key, owner, 3)
    else:
        size = np.array([number_of(shape, key, owner) for key in ("radius", "length")[: SHAPES[kind]]])
    empty = not size.all() and np.isfinite(size).all() and (kind == "mesh" or size.min() >= 0)
    checked_size = np.where(size == 0, 1.0, size) if empty else size  # so that all else is checked
    try:
        result = shape_type(kind, checked_size, file, *origin_of(element, owner), folder if file else "", **options)
    except ModelError as error:
        raise ModelError(f"{owner}: {error}", name=error.name, value=error.value, limit=error.limit) from None
    if empty:
        omitted.append(f"{owner}: collision {kind} {file!r} of size {size.tolist()}".replace(" '' ", " "))
        return []
    return [result]


def _joint(element: ElementTree.Element) -> Joint:
    name = name_of(element)
    owner = f"joint {name!r}"
    kind = text_of(element, "type", owner)
    kinds = ("fixed", *MOVING, *COMPOSITE)
    if kind not in kinds:
        message = f"{owner} is of the type {kind!r}, which is not supported; use one of {', '.join(kinds)}"
        raise ModelError(message, name="type", value=kind, limit=kinds)
    parent, child = (text_of(child_of(element, role, owner), "link", owner) for role in ("parent", "child"))
    translation, rotation = origin_of(element, owner)
    if kind not in MOVING:
        return Joint(name, "fixed", parent, child, translation, rotation)
    axis = _axis(element)
    axis = np.array([1.0, 0.0, 0.0]) if axis is None else axis
    limits: dict[str, float] = {}
    if (limit := _only(element, "limit", owner)) is not None:
        limits = {key: number_of(limit, key, owner) for key in ATTRIBUTES["limit"] if key in limit.attrib}
        limits = {key: copysign(inf, value) if abs(value) == UNLIMITED else value for key, value in limits.items()}
        if kind == "continuous":
            limits = {key: value for key, value in limits.items() if key in ("velocity", "effort")}
        elif "lower" in limits or "upper" in limits:
            limits = {"lower": 0.0, "upper": 0.0, **limits}
    mimic = None
    if (tie := _only(element, "mimic", owner)) is not None:
        numbers = {key: number_of(tie, key, owner) for key in ("multiplier", "offset") if key in tie.attrib}
        mimic = Mimic(text_of(tie, "joint", owner), **numbers)
    return Joint(name, MOVING[kind], parent, child, translation, rotation, axis, mimic=mimic, **limits)


def _axis(element: ElementTree.Element) -> Array | None:
    """Return the axis of a <joint> element, shape (3,), or None if the element gives no axis."""
    owner = f"joint {name_of(element)!r}"
    axis = _only(element, "axis", owner)
    return None if axis is None else numbers_of(axis, "xyz", owner, 3)


def _unknown_attributes(owner: ElementTree.Element) -> list[str]:
    """Return descriptions of unknown attributes in a <link> or <joint> element that may be misspelt known ones.

    An attribute that resembles a missing known one, or nearly equals any known one, is taken for a misspelling. Other
    unknown attributes of an element that has all known ones are an extension and are skipped.
    """
    unknown = []
    parents = [part for path in ("inertial", "collision", "collision/geometry") for part in owner.findall(path)]
    for element in (each for part in (owner, *parents) for each in part):
        known = ATTRIBUTES.get(element.tag, ())
        missing = [word for word in known if word not in element.attrib]
        for key in [key for key in element.attrib if known and key not in known and "}" not in key]:
            place = f"{owner.tag} {name_of(owner)!r}: {key}={element.get(key)!r} of <{element.tag}>"
            word = key.casefold()
            # stricter if the known attribute is present too: `iyx` besides `ixy` is no misspelling
            if similar := get_close_matches(word, missing, 1) or get_close_matches(word, known, 1, 0.8):
                unknown.append(f"{place} (did you mean {similar[0]!r}?)")
            elif missing:
                unknown.append(place)
    return unknown


def origin_of(element: ElementTree.Element, owner: str) -> tuple[Array, Array]:
    """Return position (3,), m, and rotation (3, 3) of a URDF element's <origin>; warn if angles look like degrees."""
    origin = _only(element, "origin", owner)
    shift, angles = np.zeros(3), np.zeros(3)
    if origin is not None:
        shift = numbers_of(origin, "xyz", owner, 3) if "xyz" in origin.attrib else shift
        angles = numbers_of(origin, "rpy", owner, 3) if "rpy" in origin.attrib else angles
    warn_of_degrees(f"{owner}: rpy", angles, owner.partition(" ")[2].strip("'"))
    (cr, sr), (cp, sp), (cy, sy) = ((cos(angle), sin(angle)) for angle in angles.tolist())  # a file has hundreds
    rotation = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return shift, np.array(rotation)


def _only(element: ElementTree.Element, tag: str, owner: str) -> ElementTree.Element | None:
    """Return the only child of an XML element with a given tag, or None; raise ModelError if there are several."""
    children = element.findall(tag)
    if len(children) > 1:
        message = f"{owner} has {len(children)} <{tag}> elements in <{element.tag}>; it takes one at most"
        raise ModelError(message, name=tag, value=len(children), limit=1)
    return children[0] if children else None


def name_of(element: ElementTree.Element) -> str:
    """Return the attribute "name" of an XML element; raise ModelError if it is missing or empty."""
    return text_of(element, "name", f"a <{element.tag}> of children {[child.tag for child in element]}")


def child_of(element: ElementTree.Element, tag: str, owner: str) -> ElementTree.Element:
    """Return the only child of an XML element with a given tag; raise ModelError unless there is exactly one."""
    child = _only(element, tag, owner)
    if child is None:
        raise ModelError(f"{owner}: <{element.tag}> has no <{tag}>", name=tag, value=0, limit=1)
    return child


def text_of(element: ElementTree.Element, key: str, owner: str) -> str:
    """Return an attribute of an XML element as text; raise ModelError if it is missing or empty."""
    value = element.get(key)
    if not value:
        similar = [word for word in element.attrib if get_close_matches(word.casefold(), [key], 1)]
        hint = f", but {similar[0]!r}: is it misspelt?" if similar and value is None else ""
        raise ModelError(f"{owner}: <{element.tag}> has no attribute {key!r}{hint}", name=key, value=value)
    return value


def number_of(element: ElementTree.Element, key: str, owner: str) -> float:
    """Return an attribute of an XML element as a number, possibly inf or nan; raise ModelError for other text."""
    return float(numbers_of(element, key, owner, 1, finite=False)[0])


def numbers_of(element: ElementTree.Element, key: str, owner: str, count: int, *, finite: bool = True) -> Array:
    """Return an attribute of an XML element as an array of `count` numbers; raise ModelError for any other content."""
    text = text_of(element, key, owner)
    place = f"{owner}: {key}={text!r} of <{element.tag}>"
    try:
        if "_" in text:  # Python would read 1_0 as ten
            raise ValueError
        values = [float(word) for word in text.split()]
    except ValueError:
        hint = ": write decimal points, and blanks between numbers" if "," in text else ""
        hint = f": {XACRO}" if "${" in text or "$(" in text else hint
        raise ModelError(f"{place} is not numeric{hint}", name=key, value=text) from None
    if len(values) != count:
        raise ModelError(f"{place} has {len(values)} numbers, not {count}", name=key, value=text, limit=count)
    if finite and not all(map(isfinite, values)):
        raise ModelError(f"{place} is not finite", name=key, value=text)
    return np.array(values)
