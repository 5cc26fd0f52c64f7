"""A peer of `ocp.motion.plan.waypoints`: Descartes, the ladder graph over samples in the wheel `tesseract-robotics`.

The wheel lists postures in closed form for arms of two classes of six joints only; of others it has numerical inverse
kinematics, one posture from one guess, the joints' zeros. So the joints nearest to the base are sampled as those of a
positioner, the six behind them are solved for, and zeros are put in the middle of the joints' limits. The wheel lets
nothing be told of its edges: they cost the root of the summed squares, and a joint may go any way from waypoint to
waypoint. Other turns of joints without end are left out, which take several times the memory and changed no verdict.

`python -m scripts.timing.descartes FOLDER` plans what `write_problem` wrote there and writes joints.npy beside it; a
process of its own, since the graph's memory grows with the square of the samples.
"""

from __future__ import annotations

import json
import os
import sys
import xml.etree.ElementTree as ET
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from models.checks import Array

KIN = """kinematic_plugins:
  search_paths: [{libraries}]
  search_libraries: [{kdl}, {core}]
  fwd_kin_plugins:
    arm:
      default: FwdKin
      plugins:
        FwdKin: {{class: KDLFwdKinChainFactory, config: {{base_link: {base}, tip_link: {tip}}}}}
  inv_kin_plugins:
    arm:
      default: InvKin
      plugins:
        InvKin:
          class: ROPInvKinFactory
          config:
            manipulator_reach: 10.0
            positioner_sample_resolution: {samples}
            positioner: {{class: KDLFwdKinChainFactory, config: {{base_link: {base}, tip_link: {split}}}}}
            manipulator: {{class: KDLInvKinChainLMAFactory, config: {{base_link: {split}, tip_link: {tip}}}}}
"""
CONTACTS = """contact_manager_plugins:
  search_paths: [{libraries}]
  search_libraries: [{bullet}]
  discrete_plugins:
    default: Bullet
    plugins:
      Bullet: {{class: BulletDiscreteBVHManagerFactory}}
"""
WRIST = 6
"""Joints that inverse kinematics solve for."""


def is_installed() -> bool:
    """Whether the peer is there."""
    return find_spec("tesseract_robotics") is not None


def _library(folder: Path, name: str) -> str:
    """A library of the wheel, in whose names there is a hash."""
    return next(folder.glob(f"lib{name}-*")).name.removeprefix("lib").removesuffix(".so")


def write_problem(name: str, resolution: float, folder: Path) -> None:
    """Write a problem of the benchmark as the peer reads it, joints sampled so finely (rad; m: a tenth of it)."""
    from scipy.spatial.transform import Rotation

    from models import CollisionScene
    from tests.redundancy_benchmark import FOLDER, problem_of, tip_and_file

    problem = problem_of(name)
    robot, (tip, file, base) = problem.machine.robot, tip_and_file(name)
    root = ET.parse(FOLDER / file).getroot()
    links: dict[Any, Any] = {link.get("name"): link for link in root.findall("link")}
    middle = dict[str, float]()
    for joint in root.findall("joint"):
        own = str(joint.get("name"))
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
        if own not in robot.joint_names:
            joint.set("type", "fixed")  # all that do not move stand at 0
            continue
        limit = joint.find("limit")
        if limit is None or joint.get("type") == "continuous":
            continue
        low, high = (float(limit.get(side, 0)) for side in ("lower", "upper"))
        middle[own] = (low + high) / 2
        limit.set("lower", repr((low - high) / 2))
        limit.set("upper", repr((high - low) / 2))
        origin = joint.find("origin")
        origin = ET.SubElement(joint, "origin") if origin is None else origin
        place, turn = (np.array(origin.get(key, "0 0 0").split(), dtype=float) for key in ("xyz", "rpy"))
        axis = np.array(joint.find("axis").get("xyz").split(), dtype=float)  # type: ignore[union-attr]
        moved = Rotation.from_euler("xyz", turn)
        if joint.get("type") == "prismatic":
            place += moved.apply(axis * middle[own])
        else:
            moved = moved * Rotation.from_rotvec(axis / np.linalg.norm(axis) * middle[own])
        origin.set("xyz", _words(place))
        origin.set("rpy", _words(moved.as_euler("xyz")))
    for part in robot.links:
        for capsule in part.collisions:
            _add_shape(links[part.name], capsule.translation, Rotation.from_matrix(capsule.rotation)).append(
                ET.Element("capsule", radius=repr(float(capsule.size[0])), length=repr(float(capsule.size[1])))
            )
    for k, box in enumerate(problem.boxes):
        link = ET.SubElement(root, "link", name=f"obstacle {k}")
        _add_shape(link, box.position, Rotation.identity()).append(ET.Element("box", size=_words(box.size)))
        joint = ET.SubElement(root, "joint", name=f"to obstacle {k}", type="fixed")
        ET.SubElement(joint, "parent", link=base)
        ET.SubElement(joint, "child", link=f"obstacle {k}")
    checked = {
        frozenset(pair) for pair in CollisionScene(problem.machine, problem.boxes, ignored=problem.ignored).labels
    }
    bodies = [link.name for link in robot.links if link.collisions] + [
        f"obstacle {k}" for k in range(len(problem.boxes))
    ]
    moving = [joint for joint in robot.path_to(tip) if joint.name in robot.joint_names]
    first = moving[: len(moving) - WRIST]
    words = [f'<robot name="{root.get("name")}" version="1.0.0">']
    words += [f'<group name="arm"><chain base_link="{base}" tip_link="{tip}"/></group>']
    words += [
        f'<disable_collisions link1="{one}" link2="{other}" reason="Never"/>'
        for one, other in combinations(bodies, 2)
        if frozenset((one, other)) not in checked
    ]
    spec = find_spec("tesseract_robotics")
    assert spec is not None
    assert spec.origin is not None
    libraries = Path(spec.origin).parents[1] / "tesseract_robotics.libs"
    named = {
        "kdl": _library(libraries, "tesseract_kinematics_kdl_factories"),
        "core": _library(libraries, "tesseract_kinematics_core_factories"),
        "bullet": _library(libraries, "tesseract_collision_bullet_factories"),
    }
    fine = [{"name": j.name, "value": resolution / (10 if j.kind == "prismatic" else 1)} for j in first]
    by_name: dict[str, Any] = {"libraries": libraries, "base": base, "tip": tip, "split": first[-1].child}
    for kind, text in (("kinematics", KIN), ("contact_managers", CONTACTS)):
        (folder / f"{kind}.yaml").write_text(
            text.format(**named, **by_name, samples=json.dumps(fine)), encoding="utf-8"
        )
        words += [f'<{kind}_plugin_config filename="file://{folder}/{kind}.yaml"/>']
    (folder / "robot.srdf").write_text("\n".join([*words, "</robot>"]), encoding="utf-8")
    ET.ElementTree(root).write(folder / "robot.urdf", encoding="unicode")
    poses = np.column_stack([problem.positions, problem.quaternions]).tolist()
    names = list(robot.joint_names)
    options = {"joints": names, "middle": [middle.get(name, 0.0) for name in names], "base": base, "tip": tip}
    (folder / "problem.json").write_text(json.dumps(options | {"poses": poses}), encoding="utf-8")


def _words(numbers: Any) -> str:
    return " ".join(repr(float(number)) for number in np.ravel(numbers))


def _add_shape(link: Any, place: Any, turn: Any) -> Any:
    """The geometry of a new shape of a link."""
    shape = ET.SubElement(link, "collision")
    ET.SubElement(shape, "origin", xyz=_words(place), rpy=_words(turn.as_euler("xyz")))
    return ET.SubElement(shape, "geometry")


def plan_written(folder: Path) -> Array | None:
    """Joints at the waypoints of a problem that was written, (N, n), or None where none were found."""
    import tesseract_robotics.tesseract_command_language as language
    from tesseract_robotics import tesseract_common as common
    from tesseract_robotics import tesseract_motion_planners as planners
    from tesseract_robotics import tesseract_motion_planners_descartes as descartes
    from tesseract_robotics.tesseract_environment import Environment

    options = json.loads((folder / "problem.json").read_text(encoding="utf-8"))
    environment = Environment()
    texts = [(folder / f"robot.{kind}").read_text(encoding="utf-8") for kind in ("urdf", "srdf")]
    if not environment.init(*texts, common.GeneralResourceLocator()):
        raise RuntimeError("the robot cannot be read")
    arm = common.ManipulatorInfo()
    arm.manipulator, arm.tcp_frame, arm.working_frame = "arm", options["tip"], options["base"]
    program = language.CompositeInstruction()
    program.setManipulatorInfo(arm)
    for pose in options["poses"]:
        place = common.Isometry3d.Identity() * common.Translation3d(*pose[:3]) * common.Quaterniond(*pose[3:])
        point = language.CartesianWaypointPoly_wrap_CartesianWaypoint(language.CartesianWaypoint(place))
        move = language.MoveInstruction(point, language.MoveInstructionType_LINEAR, "profile", arm)
        program.appendMoveInstruction(language.MoveInstructionPoly_wrap_MoveInstruction(move))
    profile = descartes.DescartesDefaultPlanProfileD()
    profile.target_pose_fixed, profile.enable_collision, profile.allow_collision = True, True, False

    profiles = language.ProfileDictionary()
    profiles.addProfile("Descartes", "profile", descartes.cast_DescartesPlanProfileD(profile))
    request = planners.PlannerRequest()
    request.instructions, request.env, request.profiles = program, environment, profiles
    response = descartes.DescartesMotionPlannerD("Descartes").solve(request)
    if not response.successful:
        return None
    results = []
    for instruction in response.results.flatten():
        move = language.InstructionPoly_as_MoveInstructionPoly(instruction)
        state = language.WaypointPoly_as_StateWaypointPoly(move.getWaypoint())
        values = dict(zip(state.getNames(), np.ravel(state.getPosition()), strict=True))
        results.append([values[name] for name in options["joints"]])
    return np.asarray(np.array(results) + options["middle"])


if __name__ == "__main__":
    joints = plan_written(Path(sys.argv[1]))
    if joints is not None:
        np.save(Path(sys.argv[1]) / "joints.npy", joints)
    sys.stdout.flush()
    os._exit(0)  # the wheel's objects are torn down in an order that may crash
