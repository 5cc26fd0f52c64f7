"""Reading of robot descriptions in MJCF, the XML format of MuJoCo; MuJoCo's own compiler resolves classes and frames.

A file from a stranger is reduced before the compiler sees it to the parts that describe bodies, joints, shapes and
actuators, so that it loads no plugin, simulates nothing and expands no repetition. Files are opened here, and included
files must be inside the folder of the first one.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from models.checks import Array
from models.errors import ModelError
from models.files import INPUT_LIMITS, read_regular
from models.robot.parts import CollisionShape, Joint, Kind, Link, Mimic, ShapeKind, VisualShape
from models.robot.tree import replace_floating
from models.robot.urdf import Description, Source, omission_warning, parse_file

MUJOCO_EXTRA = 'the extra mujoco: pip install "selfmotion[mujoco]", or from a clone pip install ".[mujoco]"'
ACTUATORS = ("general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder")
BODY_PARTS = ("body", "frame", "inertial", "joint", "freejoint", "geom", "site")
READ: dict[str, tuple[str, ...]] = {
    "mujoco": ("compiler", "default", "asset", "worldbody", "contact", "equality", "actuator"),
    "default": ("default", "mesh", "material", "joint", "geom", "site", "equality", *ACTUATORS),
    "asset": ("mesh", "material"),
    "worldbody": BODY_PARTS,
    "body": BODY_PARTS,
    "frame": BODY_PARTS,
    "contact": ("exclude",),
    "equality": ("joint",),
    "actuator": ACTUATORS,
}
"""The elements that are read, by the element that contains them."""
CODE = ("extension", "plugin")
ELLIPSOID = 4
"""Number of this kind of geom in MuJoCo."""
EXPANDED = ("replicate", "composite", "flexcomp", "attach")
FOLDERS = ("assetdir", "meshdir", "texturedir", "strippath")
"""Attributes of <compiler> that say where the compiler itself would look for files."""


def read_mjcf(source: Source) -> Description:
    """Read the description of a robot in MJCF, the XML format of MuJoCo, from a text or a file.

    Links are the bodies, in their own frames, the world, and the named sites; a site or an anchor of a joint becomes a
    link without mass. Joint positions are those of MuJoCo. A free joint that is all that the world carries means that
    the robot floats, as in `models.robot.urdf.read_urdf`; any other becomes a chain of joints. Effort limits are the
    smaller magnitude of `actuatorfrcrange` and of what the actuators of the joint can exert by `forcerange`, or by
    `ctrlrange` of a motor, times `gear`. MJCF has no velocity limits. A linear equality constraint of two joints makes
    the first one a mimic joint, one without a second joint locks it. Geoms that collide with nothing are for display.
    Elements that describe no robot, such as sensors and cameras, are skipped.

    Args:
        source: The text, recognised by its first character "<", or the path of a file.

    Raises:
        ModelError: No such file, malformed XML, a plugin, a repetition, an included file outside the folder, a ball
            joint, whatever MuJoCo refuses, or the package is not installed.

    Warns:
        ModelWarning: Parts that are left out or replaced: planes, height fields, primitives fitted to meshes, meshes
            that are not in a file, ellipsoids (replaced by the boxes around them), other equality constraints.
    """
    omitted: list[str] = []
    reduced = _reduce(source, omitted)
    origin = reduced.origin
    model, meshes = _compile(reduced)
    shapes = _body_shapes(model, meshes, reduced, omitted)
    names = [model.body(k).name or f"body{k}" for k in range(model.nbody)]
    links = [
        Link(name, model.body_mass[k], model.body_ipos[k], turn @ np.diag(model.body_inertia[k]) @ turn.T, **shapes[k])
        for k, name in enumerate(names)
        for turn in [_rotation(model.body_iquat[k])]
    ]
    mimics, locked = _equalities(model, omitted)
    joints: list[Joint] = []
    floating: list[Joint] = []
    for k, name in list(enumerate(names))[1:]:
        parent, shift, turn = names[model.body_parentid[k]], model.body_pos[k], _rotation(model.body_quat[k])
        first, count = int(model.body_jntadr[k]), int(model.body_jntnum[k])
        for j in range(first, first + count):
            joint_name = _joint_name(model, j)
            kind = ("free", "ball", "slide", "hinge")[model.jnt_type[j]]
            if kind == "ball":
                message = f"{origin}: joint {joint_name!r} is a ball joint; replace it by three hinges"
                raise ModelError(message, name=joint_name, value=kind, limit=("free", "slide", "hinge"))
            if kind == "free":
                floating.append(Joint(joint_name, "fixed", parent, name))
                joints.append(floating[-1])
                parent, shift, turn = name, np.zeros(3), np.eye(3)
                continue
            anchor = model.jnt_pos[j] if kind == "hinge" else np.zeros(3)
            at_zero = Joint("zero", _kind(model, j), "a", "b", shift + turn @ anchor, turn, model.jnt_axis[j])
            turn, shift = at_zero.placed(-model.qpos0[model.jnt_qposadr[j]])
            child = name
            if anchor.any() or j < first + count - 1:
                child = f"{name}_{joint_name}"
                links.append(Link(child))
            limits = {"effort": _effort(model, j)}
            if model.jnt_limited[j]:
                limits |= dict(zip(("lower", "upper"), model.jnt_range[j].tolist(), strict=True))
            mimic = mimics.get(j)
            joint = Joint(joint_name, at_zero.kind, parent, child, shift, turn, at_zero.axis, mimic=mimic, **limits)
            joints.append(joint.locked(locked[j]) if j in locked else joint)
            parent, shift, turn = child, -anchor, np.eye(3)
        if parent != name:
            joints.append(Joint(f"{name}_fixed", "fixed", parent, name, shift, turn))
    taken = {link.name for link in links}
    for site in (model.site(k) for k in range(model.nsite)):
        if site.name:
            child = site.name if site.name not in taken else f"{site.name}_site"
            links.append(Link(child))
            place = site.pos, _rotation(site.quat)
            joints.append(Joint(f"{child}_fixed", "fixed", names[site.bodyid[0]], child, *place))
    parts = tuple(links), tuple(joints)
    for joint in floating:
        parts = replace_floating(joint, *parts)
    omission_warning(omitted, origin)
    return Description(reduced.name, *parts)


def excluded_pairs(source: Source) -> list[tuple[str, str]]:
    """Return the pairs of bodies that an MJCF description excludes from contact, for `Scene(ignored=...)`.

    Raises:
        ModelError: As read_mjcf, as far as the file is no MJCF.
    """
    elements = ElementTree.fromstring(_reduce(source, []).text).findall("contact/exclude")
    return [(each.get("body1", ""), each.get("body2", "")) for each in elements]


class _ReducedFile(NamedTuple):
    """An MJCF description reduced to the elements that describe bodies, joints, shapes and actuators."""

    text: str  # MJCF
    name: str  # name of the model
    folder: str  # folder of the file, "" for a text
    files: dict[str, Path]  # files of the meshes, relative to the folder, by their names in the text
    origin: str  # description of the source, for messages


def _reduce(source: Source, omitted: list[str]) -> _ReducedFile:
    """Read an MJCF description, keep only elements that describe a robot, and append omitted parts to `omitted`."""
    tree, origin = parse_file(source, "MJCF")
    if tree.tag != "mujoco":
        hint = "; read URDF with Robot.from_urdf" if tree.tag == "robot" else ""
        message = f"{origin} is not MJCF: its root element is <{tree.tag}>, not <mujoco>{hint}"
        raise ModelError(message, name=origin, value=tree.tag, limit="mujoco")
    is_file = origin.startswith("file ")
    folder = Path(source).resolve().parent if is_file else None
    _include(tree, folder, {Path(source).resolve()} if is_file else set(), origin)
    for part in tree.iter():
        if part.tag in (*CODE, *EXPANDED):
            does = "could run code" if part.tag in CODE else "is written out by MuJoCo's compiler, without a bound"
            message = (
                f"{origin} has the element <{part.tag}>, which {does}, and is not read; if you trust the file, save it "
                "with MuJoCo (mj_saveLastXML) and read the result"
            )
            raise ModelError(message, name=part.tag, value=part.tag)
    for part in tree.iterfind("equality/*"):
        if part.tag not in READ["equality"]:
            omitted.append(f"the equality constraint <{part.tag}> {part.get('name', '')!r}".replace(" ''", ""))
    _prune(tree, origin)
    if sum(part.tag in BODY_PARTS for part in tree.iter()) > INPUT_LIMITS.scene_nodes:
        message = f"{origin} has more than {INPUT_LIMITS.scene_nodes} bodies, joints, geoms and sites"
        raise ModelError(message, name=origin, value=source, limit=INPUT_LIMITS.scene_nodes)
    settings = {key: each.attrib.pop(key) for each in tree.iter("compiler") for key in FOLDERS if key in each.attrib}
    files: dict[str, Path] = {}
    for k, mesh in enumerate(tree.iterfind("asset/mesh")):
        if file := mesh.get("file"):
            name = Path(file).name if settings.get("strippath") == "true" else file
            files[f"{k}{Path(file).suffix}"] = Path(settings.get("meshdir", settings.get("assetdir", "")), name)
            mesh.attrib |= {"name": mesh.get("name") or Path(file).stem, "file": f"{k}{Path(file).suffix}"}
    text = ElementTree.tostring(tree, encoding="unicode")
    return _ReducedFile(text, tree.get("model") or "robot", str(folder or ""), files, origin)


def _include(element: ElementTree.Element, folder: Path | None, known: set[Path], origin: str) -> None:
    """Replace each <include> in an MJCF document by the contents of its file, which must be inside a given folder."""
    for parent in list(element.iter()):
        for k in reversed([k for k, child in enumerate(parent) if child.tag == "include"]):
            name = parent[k].get("file", "")
            file = None if folder is None else Path(os.path.realpath(folder / name))
            if file is None or folder not in file.parents or file in known or len(known) > INPUT_LIMITS.nesting:
                reason = "without a folder" if file is None else "from outside its folder"
                if file is not None and folder in file.parents:
                    reason = "a second time" if file in known else f"after {INPUT_LIMITS.nesting} others"
                message = f"{origin} includes the file {name!r} {reason}, which is not read; insert its contents"
                raise ModelError(message, name=name or "include", value=name)
            included, _ = parse_file(file, "MJCF")
            known.add(file)
            _include(included, folder, known, origin)
            parent[k : k + 1] = list(included)
            if sum(1 for _ in element.iter()) > INPUT_LIMITS.xml_elements:
                message = f"{origin} has more than {INPUT_LIMITS.xml_elements} elements with the files that it includes"
                raise ModelError(message, name=origin, value=name, limit=INPUT_LIMITS.xml_elements)


def _prune(element: ElementTree.Element, origin: str, depth: int = 0) -> None:
    """Remove from an MJCF element, at any depth, elements that the reader does not use, and references to textures."""
    if depth > INPUT_LIMITS.nesting:
        message = f"{origin} nests elements more than {INPUT_LIMITS.nesting} deep"
        raise ModelError(message, name=origin, value=depth, limit=INPUT_LIMITS.nesting)
    element[:] = [part for part in element if _is_read(part, element.tag)]
    element.attrib.pop("texture", None)
    for part in element:
        _prune(part, origin, depth + 1)


def _is_read(part: ElementTree.Element, parent: str) -> bool:
    generated = parent == "asset" and part.tag == "mesh" and not {"file", "vertex"} & part.attrib.keys()
    elsewhere = parent == "actuator" and not {"joint", "jointinparent"} & part.attrib.keys()
    return part.tag in READ.get(parent, ()) and not generated and not elsewhere


def _compile(reduced: _ReducedFile) -> tuple[Any, dict[int, Any]]:
    """Return MuJoCo's compiled model, in which spheres replace meshes, and the replaced meshes, by index of the geom.

    The mesh is None for height fields and fitted primitives. Mesh files are opened only if masses follow from them.
    """
    try:
        import mujoco
    except ImportError as error:
        message = f"reading MJCF needs the package mujoco, {MUJOCO_EXTRA}"
        raise ModelError(message, name="mujoco", value="mujoco") from error
    warned = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda words: None)  # else they are written to a file in the current folder
    try:
        spec = mujoco.MjSpec.from_string(reduced.text)
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT  # the compiler tries a step
        spec.compiler.fusestatic = spec.compiler.discardvisual = False
        spec.compiler.LRopt.mode = mujoco.mjtLRMode.mjLRMODE_NONE
        original, weighed = spec.copy(), spec.copy()
        by_geoms = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
        geoms = _replace_meshes(spec, lambda _: False)
        _replace_meshes(weighed, lambda body: body.name != "world" and (by_geoms or not body.explicitinertial))
        model = spec.compile()
        if any(geom.meshname for geom in weighed.geoms):
            weighed.assets = {
                mesh.file: read_regular(Path(reduced.folder, reduced.files[mesh.file]), INPUT_LIMITS.mesh_bytes)
                for mesh in weighed.meshes
                if mesh.file in reduced.files
            }
            weights = weighed.compile()
            for field in ("body_mass", "body_ipos", "body_iquat", "body_inertia"):
                getattr(model, field)[:] = getattr(weights, field)
    except Exception as error:  # of several kinds, also of files
        reason = re.sub(r",? line \d+|\(line = .*?\)", "", str(error)).removeprefix("Error: ").strip()
        message = f"{reduced.origin} cannot be read by MuJoCo: {reason}"
        raise ModelError(message, name=reduced.origin, value=reduced.origin) from error
    finally:
        mujoco.set_mju_user_warning(warned)
    meshes = {mesh.name: mesh for mesh in original.meshes}
    return model, {geom.id: meshes.get(name) for geom, name in geoms}


def _replace_meshes(spec: Any, is_kept: Callable[[Any], bool]) -> list[tuple[Any, str]]:
    """Replace meshes and height fields by spheres, except on `is_kept` bodies; return replaced geoms and mesh names.

    The compiler would move a mesh to its centre of mass. A primitive that is fitted to a mesh has the mesh name "".
    """
    replaced = []
    for geom in (each for each in spec.geoms if (each.meshname or each.hfieldname) and not is_kept(each.parent)):
        replaced.append((geom, geom.meshname if geom.type.name == "mjGEOM_MESH" else ""))
        geom.type, geom.meshname, geom.hfieldname, geom.size = type(geom.type).mjGEOM_SPHERE, "", "", [0.1, 0, 0]
    kept = {geom.meshname for geom in spec.geoms}
    for mesh in [mesh for mesh in spec.meshes if mesh.name not in kept]:
        spec.delete(mesh)
    return replaced


def _body_shapes(model: Any, meshes: dict[int, Any], reduced: _ReducedFile, omitted: list[str]) -> list[dict[str, Any]]:
    """Return each body's shapes as arguments of `Link`, from results of `_compile`; add skipped shapes to `omitted`."""
    shapes: list[dict[str, Any]] = [{"collisions": (), "visuals": ()} for _ in range(model.nbody)]
    for k in range(model.ngeom):
        parts = shapes[model.geom_bodyid[k]]
        collides = bool(model.geom_contype[k] or model.geom_conaffinity[k])
        note = omitted if collides else []
        name = f"body {model.body(model.geom_bodyid[k]).name!r}: geom {model.geom(k).name!r}".replace(" ''", "")
        kind, size = _primitive(int(model.geom_type[k]), model.geom_size[k])
        arguments: dict[str, Any] = {"kind": kind, "size": size}
        mesh = meshes.get(k)
        if mesh is not None and mesh.file in reduced.files and not any([*mesh.refpos, *mesh.refquat[1:]]):
            files = {"file": str(reduced.files[mesh.file]), "folder": reduced.folder}
            arguments = {"kind": "mesh", "size": mesh.scale, **files}
        elif k in meshes or not size:
            note.append(f"{name}, since {'it is no mesh as its file has it' if k in meshes else 'a plane is no body'}")
            continue
        elif model.geom_type[k] == ELLIPSOID:
            note.append(f"{name}, an ellipsoid, for which the box around it is taken")
        arguments |= {"translation": model.geom_pos[k], "rotation": _rotation(model.geom_quat[k])}
        if collides:
            parts["collisions"] += (CollisionShape(**arguments),)
        else:
            material = model.geom_matid[k]
            color = model.geom_rgba[k] if material < 0 else model.mat_rgba[material]
            parts["visuals"] += (VisualShape(**arguments, color=np.clip(color, 0.0, 1.0)),)
    return shapes


def _primitive(number: int, size: Array) -> tuple[ShapeKind, tuple[float, ...]]:
    """Return kind and size of a shape from a geom's type number and half sizes in MuJoCo; a plane has no size."""
    a, b, c = size.tolist()
    kinds: dict[int, tuple[ShapeKind, tuple[float, ...]]] = {
        2: ("sphere", (a,)),
        3: ("capsule", (a, 2 * b)),
        ELLIPSOID: ("box", (2 * a, 2 * b, 2 * c)),
        5: ("cylinder", (a, 2 * b)),
        6: ("box", (2 * a, 2 * b, 2 * c)),
    }
    return kinds.get(number, ("box", ()))


def _rotation(quaternion: Array) -> Array:
    w, v = quaternion[0], quaternion[1:]
    return np.asarray((w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) - 2 * w * np.cross(v, np.eye(3)))


def _joint_name(model: Any, j: int) -> str:
    body = int(model.jnt_bodyid[j])
    return model.joint(j).name or f"{model.body(body).name or f'body{body}'}_joint{j - int(model.body_jntadr[body])}"


def _kind(model: Any, j: int) -> Kind:
    return "prismatic" if model.jnt_type[j] == 2 else "revolute" if model.jnt_limited[j] else "continuous"


def _effort(model: Any, j: int) -> float:
    """Return the effort limit of a joint, N m or N, from force ranges of joint and actuators; inf without any range."""
    limits = []
    for k in range(model.nu):
        if model.actuator_trntype[k] > 1 or model.actuator_trnid[k, 0] != j:
            continue
        is_motor = model.actuator_gaintype[k] == model.actuator_biastype[k] == model.actuator_dyntype[k] == 0
        scale = abs(model.actuator_gear[k, 0])
        if model.actuator_forcelimited[k]:
            limits.append(scale * np.abs(model.actuator_forcerange[k]).min())
        elif model.actuator_ctrllimited[k] and is_motor:
            limits.append(scale * abs(model.actuator_gainprm[k, 0]) * np.abs(model.actuator_ctrlrange[k]).min())
        else:
            limits.append(np.inf)
    total = float(sum(limits)) if limits else np.inf
    return min(total, float(np.abs(model.jnt_actfrcrange[j]).min())) if model.jnt_actfrclimited[j] else total


def _equalities(model: Any, omitted: list[str]) -> tuple[dict[int, Mimic], dict[int, float]]:
    """Return couplings and locked positions of joints, by joint number; append other constraints to `omitted`."""
    mimics: dict[int, Mimic] = {}
    locked: dict[int, float] = {}
    for k in (k for k in range(model.neq) if model.eq_active0[k]):
        first, second = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        offset, multiplier, *rest = model.eq_data[k, :5].tolist()
        offset += model.qpos0[model.jnt_qposadr[first]]
        if second < 0:
            locked[first] = offset
        elif any(rest) or first in mimics:
            kind = "nonlinear" if any(rest) else "second"
            omitted.append(f"the {kind} equality constraint of joint {_joint_name(model, first)!r}")
        else:
            zero = model.qpos0[model.jnt_qposadr[second]]
            mimics[first] = Mimic(_joint_name(model, second), multiplier, offset - multiplier * zero)
    return mimics, locked
