"""Robot descriptions in URDF, the XML format of ROS, read into links and joints, and written.

Kinematics, inertias, limits, mimicry, collision and visual shapes are read; <transmission>, <gazebo>,
<safety_controller>, <dynamics> and unknown elements are passed over, and so is a <visual> that says nothing that can be
shown: how a robot looks never keeps it from moving. Meshes are named, with the folder of the file that
names them, and no file of theirs is looked for here (`models.shapes.bodies` does). The standard library's parser is
enough: the libraries that read URDF bring mesh and XML packages along, which a core without meshes spares.
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

from models.arrays import Array, checked_choice, warn_of_degrees
from models.errors import ModelError, ModelWarning
from models.input_files import INPUT_LIMITS, parse_xml, read_regular
from models.robot.parts import SHAPES, CollisionShape, Joint, Kind, Link, Mimic, VisualShape

Source: TypeAlias = str | os.PathLike[str]
InertiaRule: TypeAlias = Literal["warn", "as_given"]
_Shape = TypeVar("_Shape", bound=CollisionShape)

MOVING: dict[str, Kind] = {"revolute": "revolute", "continuous": "continuous", "prismatic": "prismatic"}
XACRO = "this is xacro, the macro language that URDF files are made from; expand it first: xacro FILE > FILE.urdf"
BLANK = "\ufeff \t\r\n"
"""What may stand before a text's first character."""
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
"""Elements in which a misspelt attribute would go unseen, and the attributes that they have."""


@dataclass(frozen=True, eq=False)
class Description:
    """What a URDF file says of a robot.

    Attributes:
        name: Of the robot; "robot" where the file gives none.
        links, joints: In the order of the file.
        tip: Link that carries the tip, where the file says so by <tip link="NAME"/>, which is no part of the format.
    """

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    tip: str | None = None


def read_urdf(source: Source, *, inertia: InertiaRule = "warn") -> Description:
    """Read a URDF description.

    What is left out has the meaning of the format: an origin of zeros, the axis x, no inertia. A revolute or
    prismatic joint whose <limit> gives only one of lower and upper has 0 for the other; with neither, or without
    <limit>, it has no position limits. Likewise for effort and velocity. A floating joint between a massless root and
    its only child says that the robot floats: both are left out. A fixed joint follows none, whatever it mimics.

    Args:
        source: The text, recognised by its first character "<", or the path of a file.
        inertia: What to say about an inertia that no body can have: "warn", or nothing and take it "as_given".

    Raises:
        ModelError: No such file, malformed XML, xacro, missing, misspelt or non-numeric attributes, elements given
            twice, kinds of joints or shapes that are not supported, impossible masses, limits or shapes.

    Warns:
        ModelWarning: Inertias that no body can have; attributes that mean nothing in URDF; angles that look like
            degrees, lengths that look like millimetres (see `models.arrays.warn_of_degrees`); collision shapes of a
            root link that is left out.
    """
    checked_choice(inertia, get_args(InertiaRule), "URDF", "inertia")
    tree = parse_urdf(source)
    own = isinstance(source, os.PathLike) or not source.lstrip(BLANK).startswith("<")
    folder = str(Path(source).resolve().parent) if own else ""
    if unread := [each for owner in (*tree.findall("link"), *tree.findall("joint")) for each in _unread(owner)]:
        warn(f"attributes that mean nothing in URDF are not read: {'; '.join(unread)}", ModelWarning, 3)
    links = _links(tree, inertia, folder)
    joints = [(name_of(each), each.get("type"), _joint(each)) for each in tree.findall("joint")]
    for name in [name for name, kind, _ in joints if kind == "floating"]:
        links = _without_world(name, links, joints)
        joints = [each for each in joints if each[0] != name]
    tip = _only(tree, "tip", "the robot")
    named = None if tip is None else text_of(tip, "link", "the robot")
    return Description(tree.get("name") or "robot", links, tuple(joint for *_, joint in joints), named)


def _without_world(name: str, links: tuple[Link, ...], joints: list[tuple[str, str | None, Joint]]) -> tuple[Link, ...]:
    """The links but for the massless root from which a floating joint lets the whole robot float."""
    virtual = next(joint for each, _, joint in joints if each == name)
    base = next((link for link in links if link.name == virtual.parent), None)
    neighbours = [joint for *_, joint in joints if virtual.parent in (joint.parent, joint.child)]
    if base is None or base.mass or len(neighbours) > 1 or base.inertia.any():
        message = (
            f"joint {name!r} is floating, which is supported only as the joint between a massless root link and "
            "the whole robot; make it fixed, or read its two sides as two robots"
        )
        raise ModelError(message, name=name, value="floating")
    if base.collisions:
        message = (
            f"link {base.name!r}, from which joint {name!r} lets the robot float, is left out with its "
            "<collision> shapes: give them as obstacles"
        )
        warn(ModelWarning(message, name=base.name, value=len(base.collisions)), stacklevel=4)
    return tuple(link for link in links if link is not base)


def urdf_text(
    name: str, links: Sequence[Link], joints: Sequence[Joint], tip: str | None, translation: Array, rotation: Array
) -> str:
    """A robot as URDF text, of which `read_urdf` makes the same links, joints and tip, numbers to the last digit.

    A tip that does not stand in its link's own frame, (3,) and (3, 3) as of Robot, becomes a link "LINK_tip" on a fixed
    joint. The tip is named by <tip link="NAME"/>, which is no part of the format and which other readers pass over. A
    limit that there is not is left out, which urdfdom, and so ROS and Pinocchio, does not accept of revolute and
    prismatic joints: give such a robot limits of effort and velocity, and of position on both sides or none, first.
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
    for seen in link.visuals:
        visual = _write_shape(element, "visual", seen)
        if seen.color is not None:
            material = ElementTree.SubElement(visual, "material", name="")
            ElementTree.SubElement(material, "color", rgba=_text(seen.color))
    for shape in link.collisions:
        _write_shape(element, "collision", shape)


def _write_joint(robot: ElementTree.Element, joint: Joint) -> None:
    element = ElementTree.SubElement(robot, "joint", name=joint.name, type=joint.kind)
    _write_origin(element, joint.translation, joint.rotation)
    ElementTree.SubElement(element, "parent", link=joint.parent)
    ElementTree.SubElement(element, "child", link=joint.child)
    if not joint.moves:
        return
    ElementTree.SubElement(element, "axis", xyz=_text(joint.axis))
    given = [what for what in ("effort", "velocity") if np.isfinite(getattr(joint, what))]
    given += ["lower", "upper"] if np.isfinite([joint.lower, joint.upper]).any() else []
    if given:
        ElementTree.SubElement(element, "limit", {what: _text(getattr(joint, what)) for what in given})
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
    """No rpy where nothing is turned, so that zeros stay exact."""
    turned = {} if np.array_equal(rotation, np.eye(3)) else {"rpy": _text(_rpy(rotation))}
    ElementTree.SubElement(element, "origin", {"xyz": _text(translation)} | turned)


def _rpy(rotation: Array) -> Array:
    """Angles about the fixed x, y, z that make a rotation. Shape (3,), rad.

    At pitch = +-pi/2 yaw is whatever rounding says, and roll, which is measured with this yaw taken back, makes up for
    it: exact to rounding there too.
    """
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    across = np.array([-np.sin(yaw), np.cos(yaw)]) @ rotation[:2]  # y of the frame that is turned by yaw alone
    return np.array([np.arctan2(-across[2], across[1]), pitch, yaw])


def _text(numbers: Any) -> str:
    return " ".join(repr(float(number)) for number in np.ravel(numbers))


def parse_urdf(source: Source) -> ElementTree.Element:
    """The <robot> element of a URDF text or file, namespaces removed; ModelError where there is none to read."""
    text, above = "", 0
    data: str | bytes = b""
    if isinstance(source, str):
        data = text = source.lstrip(BLANK)
        above = source[: len(source) - len(text)].count("\n")
    try:
        if isinstance(source, str) and not text:
            message = "source: an empty text cannot be read as URDF; give the XML or the path of a file"
            raise ModelError(message, name="source", value=source)
        if text.startswith("<"):
            where = "the given text"
        else:
            where = f"file {os.fspath(source)!r}" if isinstance(source, str | os.PathLike) else repr(source)
            if not isinstance(source, str | os.PathLike):
                message = f"a URDF source is a text or a path, not {type(source).__name__}"
                raise ModelError(message, name="source", value=source)
            data = read_regular(source, INPUT_LIMITS.description_bytes)
        tree = parse_xml(data)
    except ElementTree.ParseError as error:
        line, column = error.position
        reason = str(error).split(": line")[0]
        hint = f"; {XACRO}" if "unbound prefix" in reason and "xacro" in str(data) else ""
        message = f"{where} is not well-formed XML: {reason}, line {line + above}, column {column}{hint}"
        raise ModelError(message, name=where, value=(line + above, column)) from error
    except OSError as error:
        message = f"{where} cannot be read: {error.strerror or error}; a URDF text begins with '<'"
        raise ModelError(message, name=where, value=source) from error
    except ModelError:
        raise
    except (ValueError, LookupError) as error:
        raise ModelError(f"{where} cannot be read: {error}", name=where, value=source) from error
    space = tree.tag[: tree.tag.rfind("}") + 1]
    for element in tree.iter():
        if isinstance(element.tag, str):
            if "xacro" in element.tag:
                tag = element.tag.rpartition("}")[2]
                raise ModelError(f"{where} has the element <{tag}>: {XACRO}", name=tag, value=element.tag)
            if space and element.tag.startswith(space):
                element.tag = element.tag[len(space) :]
    if tree.tag != "robot":
        message = f"{where} is not URDF: its root element is <{tree.tag}>, not <robot>"
        raise ModelError(message, name=where, value=tree.tag, limit="robot")
    return tree


def _links(tree: ElementTree.Element, rule: InertiaRule, folder: str) -> tuple[Link, ...]:
    links, refused = [], []
    colors = {each.get("name"): color for each in tree.findall("material") if (color := _color(each)) is not None}
    for said in (_said_of_link(each, folder, colors) for each in tree.findall("link")):
        try:
            links.append(Link(**said))
            continue
        except ModelError as error:
            refused.append(str(error))
        links.append(Link(**said, any_inertia=True))  # raises what is wrong beside the inertia
    if refused and rule == "warn":
        warn(
            f"inertias that no body can have are taken as given: {'; '.join(refused)}. Correct the file, or have no "
            "more said of it: from_urdf(..., inertia='as_given')",
            ModelWarning,
            4,
        )
    if not links:
        raise ModelError(f"the robot {tree.get('name') or ''!r} has no <link>", name="link", value=0, limit=1)
    return tuple(links)


def _said_of_link(element: ElementTree.Element, folder: str, colors: dict[str | None, Array]) -> dict[str, Any]:
    """Attributes of Link, by name; `colors` are those of the robot's materials."""
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
    center, turn = origin_of(body, owner)
    mass = number_of(child_of(body, "mass", owner), "value", owner)
    given = child_of(body, "inertia", owner)
    xx, xy, xz, yy, yz, zz = (number_of(given, key, owner) for key in MOMENTS)
    inertia = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
    told = {"name": name, "mass": mass, "center_of_mass": center, "inertia": inertia}
    return {**told, "collisions": shapes, "visuals": tuple(visuals)}


def _color(material: ElementTree.Element) -> Array | None:
    """Red, green, blue and opacity, each 0 to 1; None where the element does not say them."""
    try:
        color = np.array((material.find("color").get("rgba") or "").split(), dtype=float)  # type: ignore[union-attr]
    except (AttributeError, ValueError):
        return None
    return np.clip(color, 0.0, 1.0) if color.shape == (4,) and np.isfinite(color).all() else None


def _shape(element: ElementTree.Element, owner: str, folder: str, kind_of: type[_Shape], **more: Any) -> _Shape:
    found: list[Any] = list(child_of(element, "geometry", owner))
    if len(found) != 1:
        message = f"{owner}: <geometry> has {len(found)} shapes, not one"
        raise ModelError(message, name="geometry", value=len(found), limit=1)
    (shape,) = found
    kind = checked_choice(shape.tag, SHAPES, owner, "shape")
    file = text_of(shape, "filename", owner) if kind == "mesh" else ""
    if kind in ("box", "mesh"):
        key = "size" if kind == "box" else "scale"
        size = np.ones(3) if kind == "mesh" and key not in shape.attrib else numbers_of(shape, key, owner, 3)
    else:
        size = np.array([number_of(shape, key, owner) for key in ("radius", "length")[: SHAPES[kind]]])
    try:
        return kind_of(kind, size, file, *origin_of(element, owner), folder if file else "", **more)
    except ModelError as error:
        raise ModelError(f"{owner}: {error}", name=error.name, value=error.value, limit=error.limit) from None


def _joint(element: ElementTree.Element) -> Joint:
    name = name_of(element)
    owner = f"joint {name!r}"
    kind = text_of(element, "type", owner)
    if kind not in (*MOVING, "fixed", "floating"):
        message = (
            f"{owner} is of the type {kind!r}, which is not supported; use one of fixed, {', '.join(MOVING)} (a robot "
            "whose base moves in the plane is made by FreeFloating(robot, base='planar'))"
        )
        raise ModelError(message, name="type", value=kind, limit=("fixed", *MOVING))
    parent, child = (text_of(child_of(element, role, owner), "link", owner) for role in ("parent", "child"))
    shift, turn = origin_of(element, owner)
    if kind not in MOVING:
        return Joint(name, "fixed", parent, child, shift, turn)
    stated = _only(element, "axis", owner)
    axis = np.array([1.0, 0.0, 0.0]) if stated is None else numbers_of(stated, "xyz", owner, 3)
    limits: dict[str, float] = {}
    if (limit := _only(element, "limit", owner)) is not None:
        given = [key for key in ATTRIBUTES["limit"] if key in limit.attrib]
        limits = {key: number_of(limit, key, owner) for key in given}
        if kind == "continuous":
            limits = {key: value for key, value in limits.items() if key in ("velocity", "effort")}
        elif "lower" in limits or "upper" in limits:
            limits = {"lower": 0.0, "upper": 0.0, **limits}
    mimic = None
    if (tie := _only(element, "mimic", owner)) is not None:
        numbers = {key: number_of(tie, key, owner) for key in ("multiplier", "offset") if key in tie.attrib}
        mimic = Mimic(text_of(tie, "joint", owner), **numbers)
    return Joint(name, MOVING[kind], parent, child, shift, turn, axis, mimic=mimic, **limits)


def _unread(owner: ElementTree.Element) -> list[str]:
    """Attributes below a link or a joint that are none of URDF's, where one is lacking that they may stand for.

    Beside all of URDF's they are an extension, and passed over as unknown elements are. ModelError for an attribute
    that looks like one that is lacking, or nearly is another one.
    """
    found = []
    parts = [part for path in ("inertial", "collision", "collision/geometry") for part in owner.findall(path)]
    for element in (each for part in (owner, *parts) for each in part):
        known = ATTRIBUTES.get(element.tag, ())
        lacking = [word for word in known if word not in element.attrib]
        for key in [key for key in element.attrib if known and key not in known and "}" not in key]:
            where = f"{owner.tag} {name_of(owner)!r}: {key}={element.get(key)!r} of <{element.tag}>"
            word = key.casefold()
            # so alike to one that is given too is misspelt, but not `iyx` beside `ixy`
            if near := get_close_matches(word, lacking, 1) or get_close_matches(word, known, 1, 0.8):
                message = f"{where} is no attribute of URDF; did you mean {near[0]!r}?"
                raise ModelError(message, name=key, value=element.get(key), limit=known)
            found += [where] if lacking else []
    return found


def origin_of(element: ElementTree.Element, owner: str) -> tuple[Array, Array]:
    """Position (3,) and rotation (3, 3) of an <origin>; warns where its rpy look like degrees."""
    origin = _only(element, "origin", owner)
    shift, angles = np.zeros(3), np.zeros(3)
    if origin is not None:
        shift = numbers_of(origin, "xyz", owner, 3) if "xyz" in origin.attrib else shift
        angles = numbers_of(origin, "rpy", owner, 3) if "rpy" in origin.attrib else angles
    warn_of_degrees(angles, owner, owner.partition(" ")[2].strip("'"), "rpy")
    (cr, sr), (cp, sp), (cy, sy) = ((cos(angle), sin(angle)) for angle in angles.tolist())  # a file has hundreds
    turn = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return shift, np.array(turn)


def _only(element: ElementTree.Element, tag: str, owner: str) -> ElementTree.Element | None:
    """The child of that tag, None without; ModelError naming `owner` where there are several."""
    found = element.findall(tag)
    if len(found) > 1:
        message = f"{owner} has {len(found)} <{tag}> elements in <{element.tag}>; it takes one at most"
        raise ModelError(message, name=tag, value=len(found), limit=1)
    return found[0] if found else None


def name_of(element: ElementTree.Element) -> str:
    """Its attribute "name"; ModelError without."""
    return text_of(element, "name", f"a <{element.tag}> of children {[child.tag for child in element]}")


def child_of(element: ElementTree.Element, tag: str, owner: str) -> ElementTree.Element:
    """The one child of that tag; ModelError naming `owner` without, or with several."""
    found = _only(element, tag, owner)
    if found is None:
        raise ModelError(f"{owner}: <{element.tag}> has no <{tag}>", name=tag, value=0, limit=1)
    return found


def text_of(element: ElementTree.Element, key: str, owner: str) -> str:
    """An attribute; ModelError naming `owner` without, or when it is empty."""
    value = element.get(key)
    if not value:
        raise ModelError(f"{owner}: <{element.tag}> has no attribute {key!r}", name=key, value=value)
    return value


def number_of(element: ElementTree.Element, key: str, owner: str) -> float:
    """An attribute of one number, inf and nan among them; ModelError naming `owner` otherwise."""
    return _numbers(element, key, owner, 1)[0]


def numbers_of(element: ElementTree.Element, key: str, owner: str, count: int) -> Array:
    """An attribute of `count` finite numbers, shape (count,); ModelError naming `owner` otherwise."""
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
