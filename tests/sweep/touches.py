"""Planted touches: obstacles that a moving arm certainly touches, none of which may be proven clear.

python -m tests.sweep.touches --out FILE [--only "seven joints"] [--count 20] [--minutes 60] [--again]

At a random time of a random motion, an obstacle is put beside a corner of the arm, perpendicular to its velocity, so
that the corner is in the obstacle, by 10 nm to 0.1 mm, for milliseconds or less. The distance of this pair is negative
then, and a proven lower bound must be negative as well.
"""

from __future__ import annotations

import time
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from models import Box, Capsule, CollisionScene, FixedBase, Mesh, Robot, Sphere
from models.checks import Array
from models.shapes.shapes import CORNERS, Shape
from ocp.motion.local.collisions import scene_hulls
from scripts.timing.clearance_peers import Motion, machines, proof, random_motion
from tests.sweep.results import Row, Sweep, parser

MOTIONS, PLANTED = 100, 10
"""Motions of a case, and touches of each."""
COUNTS = dict.fromkeys(["seven joints", "twelve joints"], 50)
DEPTHS_M = (1e-8, 1e-4)
STEP = 1e-4
"""Step of the differences that give velocity and acceleration of a corner."""


def obstacle_at(point: Array, inward: Array, depth: float, rng: np.random.Generator) -> Shape:
    """Return a random obstacle that contains a point at a given depth, m, below a surface with a given normal."""
    size = float(np.exp(rng.uniform(np.log(1e-3), np.log(0.3))))
    kind = int(rng.integers(4))
    if kind == 0:
        return Sphere(size, point + (size - depth) * inward)
    if kind == 1:
        near, far = (point + distance * inward for distance in (size / 4 - depth, 1.25 * size))
        return Capsule(size / 4, near, far)
    axes = np.linalg.qr(np.column_stack([inward, rng.normal(size=(3, 2))]))[0]
    axes[:, 0] = inward
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    edges = size * rng.uniform(0.2, 1.0, 3) + 2 * depth
    centre = point + axes @ np.array([edges[0] / 2 - depth, *rng.uniform(-0.4, 0.4, 2) * edges[1:]])
    if kind == 2:
        return Box(edges, centre, axes)
    return Mesh(centre + (CORNERS / 2 * edges) @ axes.T)


@cache
def arm(kind: str) -> tuple[Robot, Array, CollisionScene, Any]:
    """Return a robot, positions of its joints, a scene with one obstacle out of reach, and a function of its frames."""
    robot, middle = machines()[kind]
    scene = CollisionScene(FixedBase(robot), [Sphere(1e-3, (9.0, 9.0, 9.0))])
    q = ca.SX.sym("q", robot.dof)
    return robot, middle, scene, ca.Function("frames", [q], [ca.densify(ca.SX(scene.placements((), q, 0.0)))])


def grazed_corner(kind: str, motion: Motion, rng: np.random.Generator) -> tuple[str, Array, Array]:
    """Return a link, a corner of its box at a random time of a motion, and a direction in which an obstacle grazes it.

    The direction is perpendicular to the velocity of the corner, it points away from the box, and the corner retreats
    from it before and after.
    """
    _, _, scene, poses = arm(kind)
    hulls = tuple(scene_hulls(scene).values())
    beside = [k for k, pair in enumerate(scene.labels) if "obstacle 0" in pair]
    while True:
        pair = int(rng.choice(beside))
        number = scene.labels[pair].index("obstacle 0") ^ 1
        hull = hulls[int(scene.pairs[pair, number])]
        corner = hull.core[rng.integers(len(hull.core))]
        t = rng.uniform(-0.99, 0.99) + STEP * np.array([-1.0, 0.0, 1.0])
        frames = [np.asarray(poses(q)).T.reshape(-1, 4, 3) for q in motion.joints(t)]
        before, now, after = (frame[hull.frame, 3] + corner @ frame[hull.frame, :3] for frame in frames)
        velocity, acceleration = (after - before) / (2 * STEP), (after - 2 * now + before) / STEP**2
        cone = np.sign(corner - hull.middle) * np.abs(rng.normal(size=3))
        direction = cone @ frames[1][hull.frame, :3]
        direction -= velocity * (direction @ velocity) / (velocity @ velocity)
        direction /= np.linalg.norm(direction)
        leaves_box = ((frames[1][hull.frame, :3] @ direction) * (corner - hull.middle) > 0).all()
        if leaves_box and direction @ acceleration < 0:
            return scene.labels[pair][number], now, direction


def result(kind: str, seed: int) -> Row:
    """Return how many touches of a case are proven clear, and the largest lower bound of the distance of a touch."""
    began, row = time.process_time(), Row(wrong=[])
    robot, middle, *_ = arm(kind)
    largest, planted = -np.inf, 0
    for k in range(MOTIONS):
        number = seed * MOTIONS + k
        rng = np.random.default_rng(number)
        motion = random_motion(robot, middle, 1 + number % 4, number)
        links, obstacles = list[str](), list[Any]()
        for _ in range(PLANTED):
            link, point, direction = grazed_corner(kind, motion, rng)
            links.append(link)
            obstacles.append(obstacle_at(point, direction, float(np.exp(rng.uniform(*np.log(DEPTHS_M)))), rng))
        known = {(link, f"obstacle {i}") for i, link in enumerate(links)}
        scene = CollisionScene(FixedBase(robot), obstacles)
        numbers = [i for i, pair in enumerate(scene.labels) if pair in known or pair[::-1] in known]
        bounds = [proof(scene, motion, [i]).pairs[0].least for i in numbers]
        planted += len(bounds)
        largest = max(largest, *bounds)
        row["wrong"] += [f"proven clear, seed {number}"] * sum(bound >= 0 for bound in bounds)
    row["wrong"] += ["a touch has no pair"] * (planted < MOTIONS * PLANTED)
    return row | {"seconds": time.process_time() - began, "touches": planted, "largest_bound_m": largest}


def main() -> int:
    sweep, shown = Sweep(__file__, parser(__doc__, COUNTS).parse_args(), COUNTS), list[Row]()
    for row in sweep.rows(lambda kind, seed, _: result(kind, seed)):
        shown.append(row)
        print(row, flush=True)
    print(f"{sweep.summary(shown)}; {sum(row['touches'] for row in shown)} touches")
    return int(any(row["wrong"] for row in shown))


if __name__ == "__main__":
    raise SystemExit(main())
