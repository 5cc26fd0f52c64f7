"""Proofs of clearance beside those of others: sums of squares along the motion, and Drake's C-IRIS around it.

Let s(t) be a polynomial on [-1, 1] and q = q0 + 2 atan(s) the joints. The points of all bodies are then rational
functions of t, and a separating plane that is affine in t certifies that two bodies stay apart if, for each corner, a
polynomial in t is nonnegative (Amice, Werner, Tedrake 2024, Certifying Bimanual RRT Motion Plans in a Second). One
semidefinite program for each pair of bodies, solved by Clarabel, finds it. The paper's own program was never released;
this one is written anew. C-IRIS (Amice, Dai, Werner, Zhang, Tedrake 2022) certifies a polytope of joint positions: here
the tube around a straight motion in s, by ``CspaceFreePolytope`` of Drake. All bodies are boxes, the same for all.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import multiprocessing
import resource
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from queue import Empty
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy.sparse

from models import Box, CollisionScene, CollisionShape, FixedBase, Link, Robot, example_robot, link_frames, merge_robots
from models.checks import Array, ArrayInput
from models.shapes.shapes import CORNERS
from ocp.audit.clearance import Clearance
from ocp.motion.builders.clearance import clearance_of
from scripts.timing.measure import least_of_processor

DEGREES, SEED = (1, 3), 0
SEGMENTS = 16
"""Number of intervals on which the rates of a motion are bounded."""
SWING = 0.25
"""Largest coefficient of a motion in s."""
DISTANCES_M = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5, 1e-6)
"""Smallest distances of bodies, in the order in which they are tried until a proof fails."""
TIMED_M = 1e-2
"""Smallest distance of the scenes whose proofs are timed."""
OBSTACLES = 6
HALVINGS = 60
"""Largest number of bisections of the line on which an obstacle is moved: its share is then exact to rounding."""
ROOM_M = 0.15
"""Distance from the motion of obstacles other than the nearest one."""
TUBE = 1e-3
"""Half the width of the tube in s that C-IRIS certifies."""
PATIENCE_S = 120.0
"""Processor time after which C-IRIS is stopped."""


def boxed(robot: Robot) -> Robot:
    """Return a robot with boxes for its cylinders, slimmer so that only neighbours overlap."""
    links = []
    for link in robot.links:
        boxes = [
            CollisionShape(
                "box", (1.6 * radius, 1.6 * radius, length), translation=shape.translation, rotation=shape.rotation
            )
            for shape in link.collisions
            for radius, length in [shape.size]
        ]
        links.append(dataclasses.replace(link, collisions=tuple(boxes)))
    return dataclasses.replace(robot, links=tuple(links))


def machines() -> dict[str, tuple[Robot, Array]]:
    """Return the robots of the comparison, and the positions q0 about which their joints move."""
    arm = boxed(example_robot("six_axis"))
    bases = {"left_": (0.0, 0.35, 0.0), "right_": (0.0, -0.35, 0.0)}
    half = [-0.6, 1.6, -0.7, 0.3, 0.4]
    return {
        "seven joints": (boxed(example_robot("seven_axis")), np.array([0.3, 0.7, 0.2, 1.2, -0.3, 0.8, 0.1])),
        "twelve joints": (
            merge_robots(Link("floor"), {"left_": arm, "right_": arm}, translations=bases),
            np.array([0.1, *half, -0.1, *half]),
        ),
    }


class Motion(NamedTuple):
    """Motion of a robot, polynomial in s = tan((q - q0) / 2), on t from -1 to 1.

    Attributes:
        robot: Robot on a fixed base.
        middle: Joint positions q0. Shape (n,), rad.
        coefficients: Coefficients of s in powers of t, the lowest first. Shape (degree + 1, n).
    """

    robot: Robot
    middle: Array
    coefficients: Array

    def s(self, t: Array) -> Array:
        """Return s at times (M,). Shape (M, n)."""
        return np.asarray(np.polynomial.polynomial.polyval(t, self.coefficients).T)

    def joints(self, t: Array) -> Array:
        """Return joint positions at times (M,). Shape (M, n), rad."""
        return np.asarray(self.middle + 2 * np.arctan(self.s(t)))

    def rates(self) -> tuple[Array, Array]:
        """Return bounds of the first and second derivatives of the joints by t, on each segment. Shapes (N, n).

        With |q'| = 2 |s'| / (1 + s^2), |q''| <= 2 |s''| + c s'^2, where c = 3 sqrt(3) / 4 is the largest value of
        4 |s| / (1 + s^2)^2.
        """
        ends = np.linspace(-1.0, 1.0, SEGMENTS + 1)
        half, centre = np.diff(ends)[:, None] / 2, (ends[:-1] + ends[1:]) / 2
        bounds = []
        for order in (1, 2):
            # Taylor series about the middle of a segment
            total, factor = np.zeros((SEGMENTS, self.coefficients.shape[1])), 1.0
            for k in range(order, len(self.coefficients)):
                value = np.polynomial.polynomial.polyval(centre, np.polynomial.polynomial.polyder(self.coefficients, k))
                total += np.abs(value.T) * half ** (k - order) / factor
                factor *= k - order + 1
            bounds.append(total)
        return 2 * bounds[0], 2 * bounds[1] + 0.75 * np.sqrt(3.0) * bounds[0] ** 2


def proof(around: CollisionScene, motion: Motion, pairs: Sequence[int] | None = None) -> Clearance:
    """Return the proof of this package, for all or given pairs of bodies."""

    def joints(at: Array) -> Array:
        return motion.joints(2 * at - 1)

    rates, seconds = motion.rates()
    breaks = np.linspace(0.0, 1.0, SEGMENTS + 1)
    return clearance_of(around, joints, breaks, 2.0, rates=rates, seconds=seconds, smooth=True, pairs=pairs)


class Certificates:
    """Sum-of-squares certificates that the pairs of bodies of a scene stay apart during a motion.

    Args:
        around: Scene of boxes on the robot of the motion.
        motion: The motion.
    """

    def __init__(self, around: CollisionScene, motion: Motion) -> None:
        self.around, self.motion = around, motion
        robot = motion.robot
        q = ca.SX.sym("q", robot.dof)
        frames = link_frames(robot, q)
        self._names = [link.name for link in robot.links]
        poses = [ca.horzcat(frames[name].rotation, frames[name].position) for name in self._names]
        self._poses = ca.Function("poses", [q], [ca.horzcat(*poses)])
        parents = {joint.child: joint for joint in robot.joints}
        self._above: dict[str, list[Any]] = {}
        for name in self._names:
            chain, link = list[Any](), name
            while link in parents:
                chain.append(parents[link])
                link = parents[link].parent
            self._above[name] = [joint for joint in chain if joint.kind != "fixed"]
        self._joint_index = {name: k for k, name in enumerate(robot.joint_names)}

    def corners(self, label: str) -> tuple[str | None, Array]:
        """Return the link of a body, None for the world, and the corners of its box in this frame. Shape (8, 3), m."""
        if label.startswith("obstacle "):
            box = boxes_of(self.around)[int(label.split()[1])]
            return None, box_corners(box.size, box.position, box.rotation)
        shape = self.motion.robot.links[self._names.index(label)].collisions[0]
        return label, box_corners(shape.size, shape.translation, shape.rotation)

    def count(self) -> int:
        """Return how many pairs of bodies are certified."""
        return sum(self.certify(*pair) for pair in self.around.labels)

    def certify(self, first: str, second: str) -> bool:
        """Return whether the solver finds a certificate for a pair of bodies.

        The bodies are observed from the link that halves the chain of joints between them, which keeps the degrees
        low. The joints from there to a body give the denominators (1 + s^2) of its points.
        """
        bodies = [self.corners(label) for label in (first, second)]
        chains = self._chains(first, second)
        path = chains[0] + chains[1][::-1]
        half = len(path) // 2
        observer = path[half].child if half < len(chains[0]) else path[half].parent
        between = path[:half], path[half:]
        degree_of_s = len(self.motion.coefficients) - 1
        conditions = []
        for sign, (link, corners), joints in zip((1.0, -1.0), bodies, between, strict=True):
            degree = 2 * degree_of_s * len(joints) + 1
            t = np.cos((np.arange(degree + 1) + 0.5) * np.pi / (degree + 1))
            points = self._observed(t, link, corners, observer)
            s = self.motion.s(t)[:, [self._joint_index[joint.name] for joint in joints]]
            conditions.append((sign, t, points, (1 + s**2).prod(axis=1), degree))
        return separable(conditions)

    def _chains(self, first: str, second: str) -> list[list[Any]]:
        """Return the joints from each of two bodies up to the link that carries both."""
        chains = [[] if link is None else self._above[link] for link, _ in map(self.corners, (first, second))]
        while chains[0] and chains[1] and chains[0][-1] is chains[1][-1]:
            chains = [chain[:-1] for chain in chains]
        return chains

    def joints_between(self, first: str, second: str) -> int:
        """Return the number of joints between two bodies."""
        return sum(map(len, self._chains(first, second)))

    def _observed(self, t: Array, link: str | None, corners: Array, observer: str) -> Array:
        """Return the corners of a body in the frame of a link at times (M,). Shape (M, 8, 3), m."""
        result = np.empty((len(t), len(corners), 3))
        for k, q in enumerate(self.motion.joints(t)):
            poses = np.asarray(self._poses(q)).reshape(3, -1, 4)
            there = poses[:, self._names.index(observer)]
            world = corners
            if link is not None:
                pose = poses[:, self._names.index(link)]
                world = corners @ pose[:, :3].T + pose[:, 3]
            result[k] = (world - there[:, 3]) @ there[:, :3]
        return result


def boxes_of(scene: CollisionScene) -> list[Box]:
    """Return the obstacles of a scene, all of which are boxes."""
    return [each for each in scene.obstacles if isinstance(each, Box)]


def box_corners(size: ArrayInput, centre: ArrayInput, axes: ArrayInput) -> Array:
    """Return the corners of a box with given edges, centre and axes as columns. Shape (8, 3), m."""
    return np.asarray(centre + (CORNERS * np.asarray(size) / 2) @ np.asarray(axes).T)


def separable(conditions: list[tuple[float, Array, Array, Array, int]]) -> bool:
    """Return whether Clarabel finds a plane a(t) . x + b(t), affine in t, between two bodies for all t from -1 to 1.

    For each corner x of a body and its denominator d, d (+-(a . x + b) - 1) is nonnegative. A polynomial of odd degree
    is nonnegative on [-1, 1] exactly if it is (1 + t) times a sum of squares plus (1 - t) times another one (Lukacs).
    Both sides are compared at as many times as the polynomial has coefficients.

    Args:
        conditions: For each body: sign, times (M,), corners then (M, m, 3), denominators (M,), degree.
    """
    clarabel = importlib.import_module("clarabel")
    blocks, sides, cones, columns = [], [], [], 8
    for _, _, points, _, degree in conditions:
        columns += points.shape[1] * 2 * triangle((degree + 1) // 2)
    start = 8
    for sign, t, points, denominators, degree in conditions:
        size = (degree + 1) // 2
        basis = np.polynomial.chebyshev.chebvander(t, size - 1)
        upper = np.triu_indices(size)
        order = np.lexsort((upper[0], upper[1]))  # column by column
        i, j = upper[0][order], upper[1][order]
        squares = basis[:, i] * basis[:, j] * np.where(i == j, 1.0, np.sqrt(2.0))
        scale = denominators.max()
        for k in range(points.shape[1]):
            weight = sign * (denominators / scale)[:, None]
            affine = np.column_stack([points[:, k], np.ones(len(t))])
            plane = np.hstack([weight * affine, weight * affine * t[:, None]])
            width = squares.shape[1]
            place = [
                scipy.sparse.csr_array((len(t), start - 8)),
                -(1 + t[:, None]) * squares,
                -(1 - t[:, None]) * squares,
            ]
            blocks.append(
                scipy.sparse.hstack([plane, *place, scipy.sparse.csr_array((len(t), columns - start - 2 * width))])
            )
            sides.append(denominators / scale)
            cones += [clarabel.PSDTriangleConeT(size)] * 2
            start += 2 * width
    equal = scipy.sparse.vstack(blocks)
    cone_rows = scipy.sparse.hstack([scipy.sparse.csr_array((columns - 8, 8)), -scipy.sparse.eye_array(columns - 8)])
    matrix = scipy.sparse.csc_matrix(scipy.sparse.vstack([equal, cone_rows]))
    side = np.concatenate([*sides, np.zeros(columns - 8)])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    solver = clarabel.DefaultSolver(
        scipy.sparse.csc_matrix((columns, columns)),
        np.zeros(columns),
        matrix,
        side,
        [clarabel.ZeroConeT(equal.shape[0]), *cones],
        settings,
    )
    return str(solver.solve().status) == "Solved"


def triangle(size: int) -> int:
    """Return the number of entries of the triangle of a symmetric matrix."""
    return size * (size + 1) // 2


def random_motion(robot: Robot, middle: Array, degree: int, seed: int) -> Motion:
    """Return a random motion about given joint positions, of given degree in s."""
    rng = np.random.default_rng(seed)
    powers = rng.uniform(-SWING, SWING, (degree + 1, robot.dof)) / np.arange(1, degree + 2)[:, None]
    return Motion(robot, middle, powers)


def obstacles_beside(motion: Motion, seed: int) -> list[Box]:
    """Return boxes in the reach of a motion that it stays clear of."""
    rng = np.random.default_rng(seed)
    boxes = list[Box]()
    while len(boxes) < OBSTACLES:
        box = Box(rng.uniform(0.05, 0.2, 3), rng.uniform((-0.8, -0.8, 0.0), (0.8, 0.8, 1.0)))
        result = proof(CollisionScene(FixedBase(motion.robot), [box]), motion)
        beside = [pair for pair in result.pairs if any("obstacle" in body for body in pair.bodies)]
        if min(pair.distance for pair in beside) > ROOM_M:
            boxes.append(box)
    return boxes


def with_nearest(motion: Motion, boxes: list[Box], distance: float) -> CollisionScene:
    """Return a scene in which the first box is moved until the motion comes as near to it as asked, m.

    The box moves along a fixed line, on which the smallest distance is found by bisection to a hundredth.
    """
    first = next(
        pair
        for pair in sorted(
            proof(CollisionScene(FixedBase(motion.robot), boxes), motion).pairs, key=lambda p: p.distance
        )
        if "obstacle 0" in pair.bodies
    )
    link, obstacle = first.points if first.bodies[1] == "obstacle 0" else first.points[::-1]
    step = link - obstacle
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        share = (low + high) / 2
        moved = dataclasses.replace(boxes[0], position=boxes[0].position + share * step)
        scene = CollisionScene(FixedBase(motion.robot), [moved, *boxes[1:]])
        nearest = min(pair.distance for pair in proof(scene, motion).pairs if "obstacle 0" in pair.bodies)
        if abs(nearest - distance) <= 0.01 * distance:
            return scene
        low, high = (share, high) if nearest > distance else (low, share)
    raise RuntimeError(f"no place of the obstacle is {distance:g} m from the motion")


def run_peers(repeats: int) -> list[dict[str, Any]]:
    """Return a row for each robot and motion: pairs proven, processor times, and the least distance that is proven."""
    rows = []
    for name, (robot, middle) in machines().items():
        for degree in DEGREES:
            motion = random_motion(robot, middle, degree, SEED)
            boxes = obstacles_beside(motion, SEED)
            scenes = {distance: with_nearest(motion, boxes, distance) for distance in DISTANCES_M}
            scene = scenes[TIMED_M]
            row: dict[str, Any] = {"robot": name, "degree": degree, "pairs": len(scene.labels)}
            row |= {"ours_s": least_of_processor(partial(proof, scene, motion), repeats)}
            row["ours_pairs"] = sum(pair.missed == 0 for pair in proof(scene, motion).pairs)
            row["ours_least_m"] = least_proven(scenes, partial(is_proven, motion))
            if has_clarabel():
                certificates = Certificates(scene, motion)
                began = time.process_time()
                count = certificates.count()
                row["squares_s"] = time.process_time() - began
                row |= {"squares_pairs": count, "squares_least_m": least_proven(scenes, partial(all_certified, motion))}
            if degree == 1 and has_drake():
                row |= iris(motion, scene)
            rows.append(row)
    return rows


def is_proven(motion: Motion, scene: CollisionScene) -> bool:
    """Return whether the package proves that no bodies touch."""
    worst = proof(scene, motion).worst
    return worst is None or not worst.missed


def all_certified(motion: Motion, scene: CollisionScene) -> bool:
    """Return whether the solver finds certificates for all pairs that hold the nearest obstacle."""
    certificates = Certificates(scene, motion)
    return all(certificates.certify(*pair) for pair in scene.labels if "obstacle 0" in pair)


def least_proven(scenes: Mapping[float, CollisionScene], proves: Callable[[CollisionScene], bool]) -> float:
    """Return the smallest distance, m, down to which all proofs succeed; nan if the first one fails."""
    least = np.nan
    for distance, scene in scenes.items():
        if not proves(scene):
            break
        least = distance
    return least


def iris(motion: Motion, scene: CollisionScene) -> dict[str, Any]:
    """Return how many pairs C-IRIS certifies in the tube around a straight motion within the patience, and its time.

    Pairs are certified one by one, those with the fewest joints between them first.
    """
    context = multiprocessing.get_context("spawn")
    queue: Any = context.Queue()
    process = context.Process(target=certify_tube, args=(motion, scene, queue), daemon=True)
    process.start()
    count, spent, finished = 0, PATIENCE_S, False
    while not finished and (process.is_alive() or not queue.empty()):
        with suppress(Empty):
            count, seconds, finished = queue.get(timeout=1.0)
            spent = seconds if finished else PATIENCE_S
    process.kill()
    process.join()
    return {"iris_s": spent, "iris_pairs": count, "iris_finished": finished}


def certify_tube(motion: Motion, scene: CollisionScene, queue: Any) -> None:
    """Certify the pairs of a scene in the tube around a straight motion; send the count and the seconds after each."""
    resource.setrlimit(resource.RLIMIT_CPU, (int(PATIENCE_S), int(PATIENCE_S)))
    mathematics = importlib.import_module("pydrake.math")
    geometry = importlib.import_module("pydrake.geometry")
    optimization = importlib.import_module("pydrake.geometry.optimization")
    plants, parsing, framework = (
        importlib.import_module(f"pydrake.{part}")
        for part in ("multibody.plant", "multibody.parsing", "systems.framework")
    )
    solvers, common = importlib.import_module("pydrake.solvers"), importlib.import_module("pydrake.common")
    builder = framework.DiagramBuilder()
    plant, graph = plants.AddMultibodyPlantSceneGraph(builder, 0.0)
    parsing.Parser(plant).AddModelsFromString(motion.robot.to_urdf(), "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(motion.robot.links[0].name))
    for k, box in enumerate(boxes_of(scene)):
        pose = mathematics.RigidTransform(mathematics.RotationMatrix(box.rotation), box.position)
        shape, name = geometry.Box(*box.size), f"obstacle {k}"
        plant.RegisterCollisionGeometry(plant.world_body(), pose, shape, name, plants.CoulombFriction())
    plant.Finalize()
    diagram = builder.Build()
    columns = [plant.GetJointByName(joint.name).position_start() for joint in motion.robot.moving_joints]
    middle = np.zeros(plant.num_positions())
    middle[columns] = motion.middle
    free = optimization.CspaceFreePolytope(plant, graph, optimization.SeparatingPlaneOrder.kAffine, middle)

    inspector = graph.model_inspector()
    planes = dict[tuple[Any, Any], frozenset[str]]()
    for plane in free.separating_planes():
        one, other = sorted((plane.positive_side_geometry.id(), plane.negative_side_geometry.id()))
        planes[one, other] = frozenset(body_name(inspector, each) for each in (one, other))
    joints_between = Certificates(scene, motion).joints_between
    wanted = {frozenset(pair): joints_between(*pair) for pair in scene.labels}
    order = sorted((ids for ids, names in planes.items() if names in wanted), key=lambda ids: wanted[planes[ids]])

    # the tube: an orthonormal basis whose first vector points along the motion
    ends = motion.s(np.array([-1.0, 1.0]))
    along = (ends[1] - ends[0]) / 2
    basis = np.linalg.qr(np.column_stack([along, np.eye(len(along))[:, 1:]]))[0]
    half = np.array([np.linalg.norm(along), *[TUBE] * (len(along) - 1)])
    normals = np.zeros((2 * len(along), plant.num_positions()))
    normals[:, columns] = np.vstack([basis.T, -basis.T])
    middle_of_tube = basis.T @ ends.mean(axis=0)
    sides = np.concatenate([middle_of_tube + half, half - middle_of_tube])
    options = free.FindSeparationCertificateGivenPolytopeOptions()
    options.solver_id, options.parallelism = solvers.ClarabelSolver.id(), common.Parallelism(1)
    began, count = time.process_time(), 0
    for ids in order:
        success, _ = free.FindSeparationCertificateGivenPolytope(normals, sides, set(planes) - {ids}, options)
        count += bool(success)
        queue.put((count, time.process_time() - began, ids == order[-1]))
    del diagram  # it owns the plant and had to live until here


def body_name(inspector: Any, geometry_id: Any) -> str:
    """Return the name of the link or obstacle to which a geometry of Drake belongs."""
    name = str(inspector.GetName(geometry_id))
    frame = str(inspector.GetName(inspector.GetFrameId(geometry_id)))
    return (name if "obstacle" in name else frame).split("::")[-1]


def has_clarabel() -> bool:
    """Return whether the solver of semidefinite programs is installed."""
    return importlib.util.find_spec("clarabel") is not None


def has_drake() -> bool:
    """Return whether Drake is installed."""
    return importlib.util.find_spec("pydrake") is not None
