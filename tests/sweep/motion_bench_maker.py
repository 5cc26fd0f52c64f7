"""MotionBenchMaker's problems of the Panda, planned among the scenes' boxes and cylinders, and checked independently.

python -m tests.sweep.motion_bench_maker --out FILE --data FOLDER [--only cage] [--minutes 60] [--again]

The folder holds `panda_spherized.urdf`, `panda.srdf` and `problems.tar.bz2` of the public repository KavrakiLab/vamp,
`resources/panda`. Each of 7 scenes has 100 problems, planned for the least length in joint space; "SCENE time" are ten
of them, planned for the least time within the limits of the Panda's data sheet. Starts and goals that collide by up
to a few mm are replaced by a configuration nearby that is clear.
"""

from __future__ import annotations

import tarfile
import tempfile
import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from models import Box, CollisionScene, Cylinder, FixedBase, Robot, Sphere
from models.checks import Array
from ocp import Cost, Limits, Plan, SolveError
from ocp.app.files.safe_files import read_tree
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.plan.goal_motions import GoalRequest
from ocp.motion.plan.goal_plan import plan_to_goal
from ocp.motion.sampling.joint_paths import StraightMotions
from tests.sweep.results import Row, Sweep, parser

SCENES = ("bookshelf_small", "bookshelf_tall", "bookshelf_thin", "box", "cage", "table_pick", "table_under_pick")
COUNTS = {**dict.fromkeys(SCENES, 100), **{f"{scene} time": 10 for scene in SCENES}}
PANDA = Limits(
    acceleration=[15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0],
    jerk=[7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0],
)
"""rad/s^2 and rad/s^3, data sheet; the URDF has the rates and torques."""
SECONDS = 60.0
"""Of one problem, at most."""
SPARE = 2e-4
"""m, clearance of a replaced start or goal."""


@cache
def folder_of(data: str) -> Path:
    """Return a folder with the extracted problems."""
    target = Path(tempfile.mkdtemp(prefix="motion_bench_maker_"))
    with tarfile.open(Path(data) / "problems.tar.bz2") as archive:
        archive.extractall(target, filter="data")
    return target / "problems"


@cache
def machine_of(data: str) -> FixedBase:
    return FixedBase(Robot.from_urdf(Path(data) / "panda_spherized.urdf"))


def obstacles_of(scene: Any) -> list[Box | Cylinder | Sphere]:
    """Return the shapes of a scene, in world."""
    shapes: list[Box | Cylinder | Sphere] = []
    for thing in scene["world"]["collision_objects"]:
        for shape, pose in zip(thing["primitives"], thing["primitive_poses"], strict=True):
            size, position = [float(x) for x in shape["dimensions"]], [float(x) for x in pose["position"]]
            x, y, z, w = (float(x) for x in pose["orientation"])
            rotation = pin.Quaternion(w, x, y, z).normalized().toRotationMatrix()
            if shape["type"] == "box":
                shapes.append(Box(size, position, rotation))
            elif shape["type"] == "cylinder":
                shapes.append(Cylinder(size[1], size[0], position, rotation))
            else:
                shapes.append(Sphere(size[0], position))
    return shapes


def problem_of(data: str, scene: str, number: int) -> tuple[CollisionScene, Array, Array]:
    """Return the collision scene, the start and the goals, shape (K, n), of a problem."""
    machine, folder = machine_of(data), folder_of(data) / f"{scene}_panda"
    tree = read_tree(folder / f"scene{number:04d}.yaml", "yaml")
    request = read_tree(folder / f"request{number:04d}.yaml", "yaml")
    state = request["start_state"]["joint_state"]
    start = dict(zip(state["name"], state["position"], strict=True))
    goals = [
        {c["joint_name"]: c["position"] for c in goal["joint_constraints"]} for goal in request["goal_constraints"]
    ]
    names = machine.robot.joint_names
    collision_scene = CollisionScene(machine, obstacles_of(tree), srdf=Path(data) / "panda.srdf")
    ends = [np.array([float(values[name]) for name in names]) for values in (start, *goals)]
    return collision_scene, ends[0], np.array(ends[1:])


def moved_clear(motions: StraightMotions, joints: Array) -> Array:
    """Return the configuration itself if it is clear, or one nearby, by steps along the gradients of distances."""
    for _ in range(50):
        if not motions.collisions(joints):
            break
        _, _, distance, gradient = motions.near_pairs(joints[None], SPARE)
        joints = joints + np.linalg.pinv(gradient, rcond=1e-2) @ np.maximum(SPARE - distance, 0.0)
    return joints


def least_distance(data: str, obstacles: Sequence[Any], joints: Array) -> float:
    """Return the least distance of the Panda's spheres from the obstacles in configurations (N, n), by Pinocchio."""
    model, _, geometry = pin.buildModelsFromUrdf(
        str(Path(data) / "panda_spherized.urdf"), geometry_types=[pin.GeometryType.COLLISION] * 2
    )[:3]
    state, shapes = model.createData(), geometry.createData()
    radii = np.array([thing.geometry.radius for thing in geometry.geometryObjects])
    fixed = np.array([thing.parentJoint == 0 for thing in geometry.geometryObjects])
    least = np.inf
    for q in joints:
        pin.updateGeometryPlacements(model, state, geometry, shapes, q)
        centres = np.array([placement.translation for placement in shapes.oMg])[~fixed]
        for shape in obstacles:
            local = (centres - shape.position) @ (np.eye(3) if isinstance(shape, Sphere) else shape.rotation)
            if isinstance(shape, Box):
                excess = np.abs(local) - np.asarray(shape.size) / 2
            elif isinstance(shape, Cylinder):
                around, along = np.hypot(local[:, 0], local[:, 1]), np.abs(local[:, 2])
                excess = np.column_stack([around - shape.radius, along - shape.length / 2])
            else:
                excess = np.linalg.norm(local, axis=1)[:, None] - shape.radius
            distance = np.linalg.norm(np.maximum(excess, 0.0), axis=1) + np.minimum(excess.max(axis=1), 0.0)
            least = min(least, float((distance - radii[~fixed]).min()))
    return least


def result(data: str, kind: str, seed: int) -> Row:
    """Return the row of one problem, planned and checked."""
    scene_name, _, mode = kind.partition(" ")
    scene, start, goals = problem_of(data, scene_name, 10 * seed + 1 if mode else seed + 1)
    motions = StraightMotions(scene)
    ends = [moved_clear(motions, joints) for joints in (start, *goals)]
    moved = float(np.abs(np.array(ends) - np.vstack([start, goals])).max())
    options: dict[str, Any] = {"cost": Cost(velocity=0.0, length=1.0), "time_limit": SECONDS - 1.0}
    if mode:
        options = {"limits": PANDA, "cost": Cost(velocity=0.0, time=1.0), "time_limit": SECONDS - 1.0}
    begin, used = time.perf_counter(), time.process_time()
    row, wrong = Row(), list[str]()
    try:
        constraints = ClearanceConstraints(scene)
        plan = plan_to_goal(
            GoalRequest(machine_of(data), ends[0], np.array(ends[1:]), clearance_constraints=constraints, **options)
        )
        row = {"seconds": time.perf_counter() - begin, "cpu": time.process_time() - used}
        wrong += faults(data, scene, plan)
        row |= {"cost": plan.cost, "bound": plan.bound, "optimal": plan.audit().optimal}
        joints = plan.at(np.linspace(0.0, plan.horizon, 2001))["joints"]
        row |= {"length": float(np.linalg.norm(np.diff(joints, axis=0), axis=1).sum()), "time": plan.horizon}
    except SolveError as error:
        row = {"seconds": time.perf_counter() - begin, "cpu": time.process_time() - used}
        wrong.append(str(error))
    wrong += ["slow"] * (row["seconds"] > SECONDS)
    return row | {"moved": moved, "wrong": wrong}


def faults(data: str, scene: CollisionScene, plan: Plan) -> list[str]:
    """Return what is wrong with a plan by its audit, and by Pinocchio at samples."""
    audit = plan.audit()
    wrong = [] if audit.feasible else [audit.sentence]
    joints = plan.at(np.linspace(0.0, plan.horizon, 201))["joints"]
    least = least_distance(data, scene.obstacles, joints)
    return wrong + [f"overlaps by {-least:.2g} m"] * (least < -1e-6)


def main() -> None:
    arguments = parser(__doc__, COUNTS)
    arguments.add_argument("--data", required=True, help="folder of the robot and the problems")
    options = arguments.parse_args()
    sweep, rows = Sweep(__file__, options, COUNTS), []
    for row in sweep.rows(lambda kind, seed, _: result(options.data, kind, seed)):
        rows.append(row)
        print(row, flush=True)
    print(sweep.summary(rows))
    for mode in ("", " time"):
        planned = [row for row in rows if row["kind"].endswith(" time") == bool(mode) and "length" in row]
        if planned:
            seconds = [row["seconds"] for row in planned]
            lengths, times = ([row[name] for row in planned] for name in ("length", "time"))
            print(
                f"{len(planned)} planned{mode}: mean length {np.mean(lengths):.4g} rad, {np.mean(times):.4g} s;"
                f" found in {np.median(seconds):.3g} s (median), {max(seconds):.3g} s at most"
            )


if __name__ == "__main__":
    main()
