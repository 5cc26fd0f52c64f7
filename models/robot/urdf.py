"""Reading and writing of robot descriptions in URDF, the XML format of ROS.

Read are kinematics, inertias, limits, mimic joints, collision and visual shapes. <transmission>, <gazebo>,
<safety_controller>, <dynamics>, unknown elements and invalid <visual> elements are skipped. Mesh files are recorded by
name and folder but not opened here; `models.shapes.bodies` reads them. The standard library's XML parser suffices:
packages that read URDF depend on mesh and XML packages, which the core does without.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from math import cos, isfinite, sin
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar, get_args
from warnings import warn
from xml.etree import ElementTree

import numpy as np

from models.checks import Array, require, warn_of_degrees
from models.errors import ModelError, ModelWarning
from models.files import INPUT_LIMITS, parse_xml, read_regular
from models.robot.parts import SHAPES, CollisionShape, Joint, Kind, Link, Mimic, VisualShape
from models.robot.tree import floating_joint, planar_joint

Source: TypeAlias = str | os.PathLike[str]
InertiaRule: TypeAlias = Literal["warn", "as_given"]
_Shape = TypeVar("_Shape", bound=CollisionShape)

MOVING: dict[str, Kind] = {"revolute": "revolute", "continuous": "continuous", "prismatic": "prismatic"}
COMPOSITE = ("planar", "floating")
"""Kinds of joints with several degrees of freedom."""
XACRO = "this is xacro, the macro language that URDF files are made from; expand it first: xacro FILE > FILE.urdf"
BLANK = "\ufeff \t\r\n"
"""Characters, such as a byte order mark, that may precede the first "<" of a URDF text."""
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
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
    """The content of a URDF file.

    Attributes:
        name: Name of the robot; "robot" if the file has none.
        links, joints: In the order of the file.
        tip: Link that carries the tip, from the non-standard element <tip link="NAME"/>, or None.
    """

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    tip: str | None = None


def read_urdf(source: Source, *, inertia: InertiaRule = "warn") -> Description:
    """Read a URDF description from a text or a file.

    Missing data have the default values of the format: a zero origin, the axis x, no inertia. A revolute or prismatic
    joint whose <limit> has only one of lower and upper has 0 for the other; with neither, or without <limit>, it has no
    position limits. The same holds for effort and velocity. A floating joint between a massless root and its only child
    means that the robot floats: both are omitted, and the base of `FreeFloating` moves in their place. Any other
    floating or planar joint becomes a chain of joints with one degree of freedom, without limits, see
    `models.robot.tree`. A <mimic> of a fixed joint is ignored.

    Args:
        source: The text, recognised by its first character "<", or the path of a file.
        inertia: Treatment of physically impossible inertias: accept them with a warning ("warn") or silently
            ("as_given").

    Raises:
        ModelError: No such file, malformed XML, xacro, missing, misspelt or non-numeric attributes, duplicate elements,
            unsupported kinds of joints or shapes, impossible masses, limits or shapes.

    Warns:
        ModelWarning: Physically impossible inertias; attributes without meaning in URDF; angles that look like degrees,
            lengths that look like millimetres (see `models.checks.warn_of_degrees`); collision shapes of an omitted
            root link.
    """
    require.choice("URDF: inertia", inertia, get_args(InertiaRule))
    tree = parse_urdf(source)
    is_file = isinstance(source, os.PathLike) or not source.lstrip(BLANK).startswith("<")
    folder = str(Path(source).resolve().parent) if is_file else ""
    parts = (*tree.findall("link"), *tree.findall("joint"))
    if unknown := [attribute for part in parts for attribute in _unknown_attributes(part)]:
        warn(f"attributes that mean nothing in URDF are not read: {'; '.join(unknown)}", ModelWarning, 3)
    links = _links(tree, inertia, folder)
    described = [(each, _joint(each)) for each in tree.findall("joint")]
    joints: list[Joint] = []
    for element, joint in described:
        kind = element.get("type")
        if kind == "floating" and _is_virtual(joint, links, [each for _, each in described]):
            links = _without_world(joint, links)
        elif kind in COMPOSITE:
            added = floating_joint(joint) if kind == "floating" else planar_joint(joint, _axis(element))
            links, joints = (*links, *added.links), [*joints, *added.joints]
        else:
            joints.append(joint)
    tip = _only(tree, "tip", "the robot")
    tip_name = None if tip is None else text_of(tip, "link", "the robot")
    return Description(tree.get("name") or "robot", links, tuple(joints), tip_name)


def _is_virtual(floating: Joint, links: Sequence[Link], joints: Sequence[Joint]) -> bool:
    """Return whether a floating joint connects the whole robot to a massless root link; both can then be omitted."""
    base = next((link for link in links if link.name == floating.parent), None)
    alone = all(joint is floating for joint in joints if floating.parent in (joint.parent, joint.child))
    return base is not None and alone and not base.mass and not base.inertia.any()


def _without_world(floating: Joint, links: tuple[Link, ...]) -> tuple[Link, ...]:
    """Return the links without the massless root link to which a floating joint connects the robot."""
    base = next(link for link in links if link.name == floating.parent)
    if base.collisions:
        message = (
            f"link {base.name!r}, from which joint {floating.name!r} lets the robot float, is left out with its "
            "<collision> shapes: give them as obstacles"
        )
        warn(ModelWarning(message, name=base.name, value=len(base.collisions)), stacklevel=4)
    return tuple(link for link in links if link is not base)


def urdf_text(
    name: str, links: Sequence[Link], joints: Sequence[Joint], tip: str | None, *, translation: Array, rotation: Array
) -> str:
    """Return a robot as URDF text, from which `read_urdf` recreates links, joints and tip with all digits.

    A tip frame that differs from its link's frame, (3,) and (3, 3) as in Robot, becomes a link "LINK_tip" on a fixed
    joint. The tip is named by <tip link="NAME"/>, a non-standard element that other readers skip. Infinite limits are
    omitted, but urdfdom, and so ROS and Pinocchio, rejects revolute and prismatic joints without them: give such a
    robot limits of effort and velocity, and of position on both sides or none, before writing.
    """
    robot = ElementTree.Element("robot", name=name)
    if tip is not None and (translation.any() or not np.array_equal(rotation, np.eye(3))):
        taken = {link.name for link in links} | {joint.name for joint in joints}
        free = (f"{tip}_tip{i or ''}" for i in range(len(taken) + 1))
        end = next(name for name in free if name not in taken and f"{name}_fixed" not in taken)
        links, joints = [*links, Link(end)], [*joints, Joint(f"{end}_fixed", "fixed", tip, end, translation, rotation)]
        tip = end
    for link in links:
        _write_link(robot, link)
    for joint in joints:
        _write_joint(robot, joint)
    if tip is not None:
        ElementTree.SubElement(robot, "tip", link=tip)
    ElementTree.indent(robot)
    head = '<?xml version="1.0" encoding="utf-8"?>\n<!-- written by selfmotion -->\n'
    return head + ElementTree.tostring(robot, encoding="unicode") + "\n"


def _write_link(robot: ElementTree.Element, link: Link) -> None:
    element = ElementTree.SubElement(robot, "link", name=link.name)
    if link.mass or link.inertia.any() or link.center_of_mass.any():
        body = ElementTree.SubElement(element, "inertial")
        _write_origin(body, link.center_of_mass, np.eye(3))
        ElementTree.SubElement(body, "mass", value=_text(link.mass))
        moments = map(_text, link.inertia[np.triu_indices(3)])
        ElementTree.SubElement(body, "inertia", dict(zip(MOMENTS, moments, strict=True)))
    for visual in link.visuals:
        shape = _write_shape(element, "visual", visual)
        if visual.color is not None:
            material = ElementTree.SubElement(shape, "material", name="")
            ElementTree.SubElement(material, "color", rgba=_text(visual.color))
    for collision in link.collisions:
        _write_shape(element, "collision", collision)


def _write_joint(robot: ElementTree.Element, joint: Joint) -> None:
    element = ElementTree.SubElement(robot, "joint", name=joint.name, type=joint.kind)
    _write_origin(element, joint.translation, joint.rotation)
    ElementTree.SubElement(element, "parent", link=joint.parent)
    ElementTree.SubElement(element, "child", link=joint.child)
    if not joint.moves:
        return
    ElementTree.SubElement(element, "axis", xyz=_text(joint.axis))
    limits = [limit for limit in ("effort", "velocity") if np.isfinite(getattr(joint, limit))]
    limits += ["lower", "upper"] if np.isfinite([joint.lower, joint.upper]).any() else []
    if limits:
        ElementTree.SubElement(element, "limit", {limit: _text(getattr(joint, limit)) for limit in limits})
    if (tie := joint.mimic) is not None:
        numbers = {"multiplier": _text(tie.multiplier), "offset": _text(tie.offset)}
        ElementTree.SubElement(element, "mimic", {"joint": tie.joint} | numbers)


def _write_shape(link: ElementTree.Element, tag: str, shape: CollisionShape) -> ElementTree.Element:
    element = ElementTree.SubElement(link, tag)
    _write_origin(element, shape.translation, shape.rotation)
    if shape.kind == "mesh":
        sizes = {"filename": shape.file, "scale": _text(shape.size)}
    elif shape.kind == "box":
        sizes = {"size": _text(shape.size)}
    else:
        sizes = dict(zip(("radius", "length"), map(_text, shape.size), strict=False))  # a sphere has no length
    ElementTree.SubElement(ElementTree.SubElement(element, "geometry"), shape.kind, sizes)
    return element


def _write_origin(element: ElementTree.Element, translation: Array, rotation: Array) -> None:
    """Write an <origin> element; omit rpy if there is no rotation, so that zeros stay exact."""
    rpy = {} if np.array_equal(rotation, np.eye(3)) else {"rpy": _text(_rpy(rotation))}
    ElementTree.SubElement(element, "origin", {"xyz": _text(translation)} | rpy)


def _rpy(rotation: Array) -> Array:
    """Return roll, pitch and yaw (about the fixed x, y, z axes) of a rotation matrix. Shape (3,), rad.

    At pitch = +-pi/2 yaw is arbitrary; roll is computed relative to that yaw, so the rotation is exact to rounding
    there too.
    """
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    across = np.array([-np.sin(yaw), np.cos(yaw)]) @ rotation[:2]  # y axis of the frame rotated by yaw alone
    return np.array([np.arctan2(-across[2], across[1]), pitch, yaw])


def _text(numbers: Any) -> str:
    return " ".join(repr(float(number)) for number in np.ravel(numbers))


def parse_urdf(source: Source) -> ElementTree.Element:
    """Return the <robot> element of a URDF text or file, without namespaces; raise ModelError if it is unreadable."""
    text, lines_before = "", 0
    data: str | bytes = b""
    if isinstance(source, str):
        data = text = source.lstrip(BLANK)
        lines_before = source[: len(source) - len(text)].count("\n")
    try:
        if isinstance(source, str) and not text:
            message = "source: an empty text cannot be read as URDF; give the XML or the path of a file"
            raise ModelError(message, name="source", value=source)
        if text.startswith("<"):
            origin = "the given text"
        else:
            if not isinstance(source, str | os.PathLike):
                message = f"a URDF source is a text or a path, not {type(source).__name__}"
                raise ModelError(message, name="source", value=source)
            origin = f"file {os.fspath(source)!r}"
            data = read_regular(source, INPUT_LIMITS.description_bytes)
        tree = parse_xml(data)
    except ElementTree.ParseError as error:
        line, column = error.position
        reason = str(error).split(": line")[0]
        hint = f"; {XACRO}" if "unbound prefix" in reason and "xacro" in str(data) else ""
        message = f"{origin} is not well-formed XML: {reason}, line {line + lines_before}, column {column}{hint}"
        raise ModelError(message, name=origin, value=(line + lines_before, column)) from error
    except OSError as error:
        message = f"{origin} cannot be read: {error.strerror or error}; a URDF text begins with '<'"
        raise ModelError(message, name=origin, value=source) from error
    except ModelError:
        raise
    except (ValueError, LookupError) as error:
        raise ModelError(f"{origin} cannot be read: {error}", name=origin, value=source) from error
    namespace = tree.tag[: tree.tag.rfind("}") + 1]
    for element in tree.iter():
        if isinstance(element.tag, str):
            if "xacro" in element.tag:
                tag = element.tag.rpartition("}")[2]
                raise ModelError(f"{origin} has the element <{tag}>: {XACRO}", name=tag, value=element.tag)
            if namespace and element.tag.startswith(namespace):
                element.tag = element.tag[len(namespace) :]
    if tree.tag != "robot":
        message = f"{origin} is not URDF: its root element is <{tree.tag}>, not <robot>"
        raise ModelError(message, name=origin, value=tree.tag, limit="robot")
    return tree


def _links(tree: ElementTree.Element, rule: InertiaRule, folder: str) -> tuple[Link, ...]:
    links, reasons = [], []
    colors = {
        element.get("name"): color for element in tree.findall("material") if (color := _color(element)) is not None
    }
    for arguments in (_link_arguments(element, folder, colors) for element in tree.findall("link")):
        try:
            links.append(Link(**arguments))
            continue
        except ModelError as error:
            reasons.append(str(error))
        links.append(Link(**arguments, any_inertia=True))  # raises for any error but the inertia
    if reasons and rule == "warn":
        warn(
            f"inertias that no body can have are taken as given: {'; '.join(reasons)}. Correct the file, or silence "
            "this warning: from_urdf(..., inertia='as_given')",
            ModelWarning,
            4,
        )
    if not links:
        raise ModelError(f"the robot {tree.get('name') or ''!r} has no <link>", name="link", value=0, limit=1)
    return tuple(links)


def _link_arguments(element: ElementTree.Element, folder: str, colors: dict[str | None, Array]) -> dict[str, Any]:
    """Return the arguments of Link for a <link> element; `colors` are the colours of the robot's materials by name."""
    name = name_of(element)
    owner = f"link {name!r}"
    shapes = tuple(_shape(each, owner, folder, CollisionShape) for each in element.findall("collision"))
    visuals = []
    for each in element.findall("visual"):
        material = each.find("material")
        color = None if material is None else _color(material)
        if color is None and material is not None:
            color = colors.get(material.get("name"))
        with suppress(ModelError):
            visuals.append(_shape(each, owner, folder, VisualShape, color=color))
    body = _only(element, "inertial", owner)
    if body is None:
        return {"name": name, "collisions": shapes, "visuals": tuple(visuals)}
    center, orientation = origin_of(body, owner)
    mass = number_of(child_of(body, "mass", owner), "value", owner)
    moments = child_of(body, "inertia", owner)
    xx, xy, xz, yy, yz, zz = (number_of(moments, key, owner) for key in MOMENTS)
    inertia = orientation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ orientation.T
    arguments = {"name": name, "mass": mass, "center_of_mass": center, "inertia": inertia}
    return {**arguments, "collisions": shapes, "visuals": tuple(visuals)}


def _color(material: ElementTree.Element) -> Array | None:
    """Return red, green, blue and opacity, each 0 to 1, of a <material> element, or None without a valid colour."""
    try:
        color = np.array((material.find("color").get("rgba") or "").split(), dtype=float)  # type: ignore[union-attr]
    except (AttributeError, ValueError):
        return None
    return np.clip(color, 0.0, 1.0) if color.shape == (4,) and np.isfinite(color).all() else None


def _shape(element: ElementTree.Element, owner: str, folder: str, shape_type: type[_Shape], **arguments: Any) -> _Shape:
    """Return the shape that a <collision> or <visual> element describes, as an instance of `shape_type`."""
    shapes: list[Any] = list(child_of(element, "geometry", owner))
    if len(shapes) != 1:
        message = f"{owner}: <geometry> has {len(shapes)} shapes, not one"
        raise ModelError(message, name="geometry", value=len(shapes), limit=1)
    (shape,) = shapes
    kind = require.choice(f"{owner}: shape", shape.tag, SHAPES)
    file = text_of(shape, "filename", owner) if kind == "mesh" else ""
    if kind in ("box", "mesh"):
        key = "size" if kind == "box" else "scale"
        size = np.ones(3) if kind == "mesh" and key not in shape.attrib else numbers_of(shape, key, owner, 3)
    else:
        size = np.array([number_of(shape, key, owner) for key in ("radius", "length")[: SHAPES[kind]]])
    try:
        return shape_type(kind, size, file, *origin_of(element, owner), folder if file else "", **arguments)
    except ModelError as error:
        raise ModelError(f"{owner}: {error}", name=error.name, value=error.value, limit=error.limit) from None


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
    """Return descriptions of unknown attributes in a <link> or <joint> that may stand for missing known attributes.

    Unknown attributes of an element that has all known ones are an extension and are skipped, like unknown elements.

    Raises:
        ModelError: An unknown attribute that resembles a missing one, or nearly equals a known one: a misspelling.
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
                message = f"{place} is no attribute of URDF; did you mean {similar[0]!r}?"
                raise ModelError(message, name=key, value=element.get(key), limit=known)
            unknown += [place] if missing else []
    return unknown


def origin_of(element: ElementTree.Element, owner: str) -> tuple[Array, Array]:
    """Return position (3,), m, and rotation (3, 3) of an element's <origin>; warn if the angles look like degrees."""
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
    """Return the only child element with a given tag, or None; raise ModelError naming `owner` if there are several."""
    children = element.findall(tag)
    if len(children) > 1:
        message = f"{owner} has {len(children)} <{tag}> elements in <{element.tag}>; it takes one at most"
        raise ModelError(message, name=tag, value=len(children), limit=1)
    return children[0] if children else None


def name_of(element: ElementTree.Element) -> str:
    """Return the attribute "name" of an element; raise ModelError if there is none."""
    return text_of(element, "name", f"a <{element.tag}> of children {[child.tag for child in element]}")


def child_of(element: ElementTree.Element, tag: str, owner: str) -> ElementTree.Element:
    """Return the only child element with a given tag; raise ModelError naming `owner` unless there is exactly one."""
    child = _only(element, tag, owner)
    if child is None:
        raise ModelError(f"{owner}: <{element.tag}> has no <{tag}>", name=tag, value=0, limit=1)
    return child


def text_of(element: ElementTree.Element, key: str, owner: str) -> str:
    """Return an attribute of an element as text; raise ModelError naming `owner` if it is missing or empty."""
    value = element.get(key)
    if not value:
        raise ModelError(f"{owner}: <{element.tag}> has no attribute {key!r}", name=key, value=value)
    return value


def number_of(element: ElementTree.Element, key: str, owner: str) -> float:
    """Return an attribute of an element as one number, possibly inf or nan; raise ModelError if it is no number."""
    return _numbers(element, key, owner, 1)[0]


def numbers_of(element: ElementTree.Element, key: str, owner: str, count: int) -> Array:
    """Return an attribute of an element as `count` finite numbers; raise ModelError for any other content."""
    values = _numbers(element, key, owner, count)
    if not all(map(isfinite, values)):
        raise ModelError(f"{_where(element, key, owner)} is not finite", name=key, value=element.get(key))
    return np.array(values)


def _numbers(element: ElementTree.Element, key: str, owner: str, count: int) -> list[float]:
    text = text_of(element, key, owner)
    try:
        if "_" in text:  # Python would read 1_0 as ten
            raise ValueError
        values = [float(word) for word in text.split()]
    except ValueError:
        hint = f": {XACRO}" if "${" in text or "$(" in text else ""
        raise ModelError(f"{_where(element, key, owner)} is not numeric{hint}", name=key, value=text) from None
    if len(values) != count:
        message = f"{_where(element, key, owner)} has {len(values)} numbers, not {count}"
        raise ModelError(message, name=key, value=text, limit=count)
    return values


def _where(element: ElementTree.Element, key: str, owner: str) -> str:
    return f"{owner}: {key}={element.get(key)!r} of <{element.tag}>"
