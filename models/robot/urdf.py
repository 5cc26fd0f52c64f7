"""Robot descriptions in URDF, the XML format of ROS, read into links and joints.

Only kinematics, inertias and limits are read; <visual>, <collision>, <transmission>, <gazebo>, <safety_controller>,
<dynamics> and unknown elements are passed over, so that no mesh file is ever looked for. The standard library's
parser is enough: the libraries that read URDF bring mesh and XML packages along, which a core without meshes spares.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias
from xml.etree import ElementTree

import numpy as np

from models.arrays import Array
from models.errors import ModelError
from models.robot.parts import Joint, Kind, Link
from models.robot.tree import absent
from models.spatial import rotation_from_rpy

Source: TypeAlias = str | os.PathLike[str]
InertiaRule: TypeAlias = Literal["error", "as_given"]
MimicRule: TypeAlias = Literal["error", "lock", "free"]

MOVING: dict[str, Kind] = {"revolute": "revolute", "continuous": "continuous", "prismatic": "prismatic"}
XACRO = "this is xacro, the macro language that URDF files are made from; expand it first: xacro FILE > FILE.urdf"


@dataclass(frozen=True)
class Mimic:
    """The position of a joint as URDF ties it to another's: multiplier times that plus offset (rad or m)."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, eq=False)
class Description:
    """What a URDF file says of a robot.

    Attributes:
        name: Of the robot; "robot" where the file gives none.
        links, joints: In the order of the file.
        mimics: Of the joints that follow another one, by name.
    """

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    mimics: Mapping[str, Mimic]


def read_urdf(source: Source, *, inertia: InertiaRule = "error") -> Description:
    """Read a URDF description.

    What is left out has the meaning of the format: an origin of zeros, the axis x, no inertia. A revolute or
    prismatic joint whose <limit> gives only one of lower and upper has 0 for the other; with neither, or without
    <limit>, it has no position limits. Likewise for effort and velocity. A floating joint between a massless root and
    its only child says that the robot floats: both are left out.

    Args:
        source: The text, recognised by its first character "<", or the path of a file.
        inertia: What to do about an inertia that no body can have: refuse it, or take it "as_given".

    Raises:
        ModelError: No such file, malformed XML, xacro, missing or non-numeric attributes, kinds of joints that are not
            supported, impossible inertias, masses or limits.
    """
    if inertia not in ("error", "as_given"):
        raise ModelError(f"unknown inertia rule {inertia!r}; use 'error' or 'as_given'")
    tree = parsed(source)
    links = _links(tree, inertia)
    floating = {name_of(each) for each in tree.findall("joint") if each.get("type") == "floating"}
    pairs = [(name_of(each), _joint(each)) for each in tree.findall("joint")]
    for name in floating:
        virtual = next(joint for each, joint in pairs if each == name)
        base = next((link for link in links if link.name == virtual.parent), None)
        neighbours = [j for _, j in pairs if virtual.parent in (j.parent, j.child)]
        if base is None or base.mass or len(neighbours) > 1 or base.inertia.any():
            raise ModelError(
                f"joint {name!r} is floating, which is supported only as the joint between a massless root link and "
                "the whole robot; make it fixed, or read its two sides as two robots"
            )
        links = tuple(link for link in links if link is not base)
        pairs = [pair for pair in pairs if pair[0] != name]
    joints = tuple(joint for _, joint in pairs)
    return Description(tree.get("name") or "robot", links, joints, dict(_mimics(tree, joints)))


def held_by_mimicry(
    joints: tuple[Joint, ...], mimics: Mapping[str, Mimic], held: Mapping[str, float], rule: MimicRule
) -> dict[str, float]:
    """Positions (rad or m) at which joints that follow others are to be locked, by name.

    A joint that follows a joint held or fixed is held with it under "error" and "lock". Of the others, "lock" holds
    each where it is when the joint that it follows is at 0, and "free" makes all followers independent.

    Raises:
        ModelError: An unknown rule; a follower of a moving joint under "error"; of an unknown joint, or in a ring of
            followers, unless they are "free".
    """
    if rule not in ("error", "lock", "free"):
        raise ModelError(f"unknown mimic rule {rule!r}; use 'error', 'lock' or 'free'")
    kinds = {joint.name: joint.kind for joint in joints}
    places: dict[str, float] = {}
    moving: list[str] = []
    for name in mimics if rule != "free" else ():
        factor, shift, chain = 1.0, 0.0, [name]
        while (last := chain[-1]) in mimics and last not in held:
            tie = mimics[last]
            factor, shift = factor * tie.multiplier, shift + factor * tie.offset
            if tie.joint not in kinds:
                raise absent(f"joint {last!r}: <mimic> of the joint", tie.joint, kinds)
            if tie.joint in chain:
                raise ModelError(f"joints {chain} mimic each other in a ring; remove a <mimic> of one of them")
            chain.append(tie.joint)
        if len(chain) > 1:
            places[name] = shift + factor * float(held.get(last, 0.0))
            if last not in held and kinds[last] != "fixed":
                moving.append(f"{name!r} ({mimics[name].multiplier:g} x {mimics[name].joint!r})")
    if moving and rule == "error":
        raise ModelError(
            f"joints that mimic a moving joint are not supported: {', '.join(moving)}; lock the joint they follow, "
            "lock={...}, which locks them with it; or say mimic='lock' to hold each where the joint it follows is at "
            "0, or mimic='free' to make them independent"
        )
    return places


def parsed(source: Source) -> ElementTree.Element:
    """The <robot> element of a URDF text or file, namespaces removed; ModelError where there is none to read."""
    text, above = "", 0
    if isinstance(source, str):
        text = source.lstrip("\ufeff \t\r\n")
        above = source[: len(source) - len(text)].count("\n")
    try:
        if isinstance(source, str) and not text:
            raise ModelError("an empty text cannot be read as URDF; give the XML or the path of a file")
        if text.startswith("<"):
            where = "the given text"
            tree = ElementTree.fromstring(text)
        else:
            where = f"file {os.fspath(source)!r}" if isinstance(source, str | os.PathLike) else repr(source)
            if not isinstance(source, str | os.PathLike):
                raise ModelError(f"a URDF source is a text or a path, not {type(source).__name__}")
            tree = ElementTree.fromstring(Path(source).read_bytes())
    except ElementTree.ParseError as error:
        line, column = error.position
        reason = str(error).split(": line")[0]
        hint = f"; {XACRO}" if "unbound prefix" in reason and "xacro" in (text or _contents(source)) else ""
        raise ModelError(
            f"{where} is not well-formed XML: {reason}, line {line + above}, column {column}{hint}"
        ) from error
    except OSError as error:
        raise ModelError(f"{where} cannot be read: {error.strerror or error}; a URDF text begins with '<'") from error
    except (ValueError, LookupError) as error:
        raise error if isinstance(error, ModelError) else ModelError(f"{where} cannot be read: {error}") from error
    space = tree.tag[: tree.tag.rfind("}") + 1]
    for element in tree.iter():
        if isinstance(element.tag, str):
            if "xacro" in element.tag:
                raise ModelError(f"{where} has the element <{element.tag.rpartition('}')[2]}>: {XACRO}")
            if space and element.tag.startswith(space):
                element.tag = element.tag[len(space) :]
    if tree.tag != "robot":
        raise ModelError(f"{where} is not URDF: its root element is <{tree.tag}>, not <robot>")
    return tree


def _contents(source: Source) -> str:
    return Path(source).read_bytes().decode(errors="replace")


def _links(tree: ElementTree.Element, rule: InertiaRule) -> tuple[Link, ...]:
    links, refused = [], []
    for element in tree.findall("link"):
        link = _link(element)
        try:
            link = replace(link, any_inertia=False)
        except ModelError as error:
            refused.append(str(error))
        links.append(link)
    if refused and rule == "error":
        raise ModelError(
            "; ".join(refused) + ". Correct the file, or take such inertias unchecked: from_urdf(..., "
            "inertia='as_given')"
        )
    if not links:
        raise ModelError(f"the robot {tree.get('name') or ''!r} has no <link>")
    return tuple(links)


def _link(element: ElementTree.Element) -> Link:
    name = name_of(element)
    owner = f"link {name!r}"
    found = element.findall("inertial")
    if not found:
        return Link(name)
    if len(found) > 1:
        raise ModelError(f"{owner} has {len(found)} <inertial> elements; a link has one at most")
    center, turn = origin_of(found[0], owner)
    mass = number_of(child_of(found[0], "mass", owner), "value", owner)
    given = child_of(found[0], "inertia", owner)
    xx, xy, xz, yy, yz, zz = (number_of(given, key, owner) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    inertia = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
    return Link(name, mass, center, inertia, any_inertia=True)


def _joint(element: ElementTree.Element) -> Joint:
    name = name_of(element)
    owner = f"joint {name!r}"
    kind = text_of(element, "type", owner)
    if kind not in (*MOVING, "fixed", "floating"):
        raise ModelError(
            f"{owner} is of the type {kind!r}, which is not supported; use one of fixed, {', '.join(MOVING)} (a robot "
            "whose base moves in the plane is made by FreeFloating(robot, base='planar'))"
        )
    parent, child = (text_of(child_of(element, role, owner), "link", owner) for role in ("parent", "child"))
    shift, turn = origin_of(element, owner)
    if kind not in MOVING:
        return Joint(name, "fixed", parent, child, shift, turn)
    stated = element.find("axis")
    axis = np.array([1.0, 0.0, 0.0]) if stated is None else numbers_of(stated, "xyz", owner, 3)
    limits: dict[str, float] = {}
    if (limit := element.find("limit")) is not None:
        given = [key for key in ("lower", "upper", "velocity", "effort") if key in limit.attrib]
        limits = {key: number_of(limit, key, owner) for key in given}
        if kind == "continuous":
            limits = {key: value for key, value in limits.items() if key in ("velocity", "effort")}
        elif "lower" in limits or "upper" in limits:
            limits = {"lower": 0.0, "upper": 0.0, **limits}
    return Joint(name, MOVING[kind], parent, child, shift, turn, axis, **limits)


def _mimics(tree: ElementTree.Element, joints: tuple[Joint, ...]) -> Iterator[tuple[str, Mimic]]:
    moves = {joint.name: joint.moves for joint in joints}
    for element in tree.findall("joint"):
        name, tie = name_of(element), element.find("mimic")
        if tie is None or not moves.get(name):
            continue
        owner = f"joint {name!r}"
        followed = text_of(tie, "joint", f"{owner}: <mimic>")
        numbers = {key: number_of(tie, key, owner) for key in ("multiplier", "offset") if key in tie.attrib}
        yield name, Mimic(followed, **numbers)


def origin_of(element: ElementTree.Element, owner: str) -> tuple[Array, Array]:
    """Position (3,) and rotation (3, 3) of an <origin>."""
    origin = element.find("origin")
    shift, angles = np.zeros(3), np.zeros(3)
    if origin is not None:
        shift = numbers_of(origin, "xyz", owner, 3) if "xyz" in origin.attrib else shift
        angles = numbers_of(origin, "rpy", owner, 3) if "rpy" in origin.attrib else angles
    return shift, np.array(rotation_from_rpy(*angles)) if angles.any() else np.eye(3)


def name_of(element: ElementTree.Element) -> str:
    """Its attribute "name"; ModelError without."""
    return text_of(element, "name", f"a <{element.tag}> of children {[child.tag for child in element]}")


def child_of(element: ElementTree.Element, tag: str, owner: str) -> ElementTree.Element:
    """The first child of that tag; ModelError naming `owner` without."""
    found = element.find(tag)
    if found is None:
        raise ModelError(f"{owner}: <{element.tag}> has no <{tag}>")
    return found


def text_of(element: ElementTree.Element, key: str, owner: str) -> str:
    """An attribute; ModelError naming `owner` without, or when it is empty."""
    value = element.get(key)
    if not value:
        raise ModelError(f"{owner}: <{element.tag}> has no attribute {key!r}")
    return value


def number_of(element: ElementTree.Element, key: str, owner: str) -> float:
    """An attribute of one number; ModelError naming `owner` otherwise."""
    return float(numbers_of(element, key, owner, 1)[0])


def numbers_of(element: ElementTree.Element, key: str, owner: str, count: int) -> Array:
    """An attribute of `count` numbers, shape (count,); ModelError naming `owner` otherwise."""
    text = text_of(element, key, owner)
    words: list[Any] = text.split()
    try:
        if "_" in text:  # Python would read 1_0 as ten
            raise ValueError
        values = np.array([float(word) for word in words])
    except ValueError:
        hint = f": {XACRO}" if "${" in text or "$(" in text else ""
        raise ModelError(f"{owner}: {key}={text!r} of <{element.tag}> is not numeric{hint}") from None
    if count > 1 and not np.isfinite(values).all():
        raise ModelError(f"{owner}: {key}={text!r} of <{element.tag}> is not finite")
    if values.size != count:
        raise ModelError(f"{owner}: {key}={text!r} of <{element.tag}> has {values.size} numbers, not {count}")
    return values
