"""Collision-free inverse kinematics of the rig, with clearance as a constraint, as a term of the cost, or both.

With clearances the index has no closed form. The rolls of a fixed grid are compared, with a penalty on insufficient
clearance. The lowest local minima of the grid, and the best roll of the closed form, are refined by a pattern search
with shrinking steps. The number of operations is fixed. A minimum between the grid points may be missed; a finer grid
finds it.

The rig's links are capsules, whose distances from boxes and other capsules are those of `models.shapes.distance`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.checks import require, set_fields
from models.cts.best_roll import optimal_inverse
from models.cts.rig import HOME, INCH, Branch, Rig, Tunnel, checked_branch, configuration_at, dh_frames, joints_of
from models.cts.roll import ACTIVE, STATUS, check_constraints, checked_gain, index_harmonics, unwrap_roll
from models.errors import ModelError
from models.robot.kinematics import checked_vector
from models.shapes.distance import column, pair_function, soft_minimum
from models.shapes.shapes import Box, Capsule
from models.spatial import FULL_TURN, Expression


class LinkCapsule(NamedTuple):
    """A capsule that represents a link of the rig: its radius, m, and the world positions of its ends, (3, 1), m."""

    radius: float
    start: Expression
    end: Expression


def _distance_to_walls(capsule: LinkCapsule, walls: Box) -> Expression:
    """Return the signed distance of a capsule inside a hollow box from the nearest wall of the box. Shape (1, 1), m."""
    finite = np.flatnonzero(np.isfinite(walls.size)).tolist()
    axes, half = ca.DM(walls.rotation[:, finite].T), ca.DM(walls.size[finite] / 2)
    ends = (ca.mtimes(axes, end - ca.DM(walls.position)) for end in (capsule.start, capsule.end))
    return ca.mmin(ca.vertcat(*(half - ca.fabs(end) for end in ends))) - capsule.radius


@dataclass(frozen=True)
class ClearanceSearch:
    """Settings of the search for the roll angle of least cost at which the rig is free of collisions.

    Attributes:
        samples: Number of rolls in the grid.
        minima: Number of local minima on the grid that are refined.
        steps, shrink: Number of steps of the pattern search, and ratio of successive step sizes; the last step is
            0.62^44 = 7e-10 of the grid's step.
        penalty: Penalty on missing clearance in the merit function, 1/m.
        inset: Distance beyond the least clearance that the search aims for, m.
        active_tolerance: Distance from the least clearance below which the constraint counts as active, m.
    """

    samples: int = 72
    minima: int = 4
    steps: int = 44
    shrink: float = 0.62
    penalty: float = 1e3
    inset: float = 1e-10
    active_tolerance: float = 1e-6


SEARCH = ClearanceSearch()


@dataclass(frozen=True)
class Radii:
    """Radii of the capsules that represent yaw links, pitch link, goose-neck and sting of the rig, m."""

    yaw: float = 2.0 * INCH
    pitch: float = 1.5 * INCH
    sting: float = 0.75 * INCH

    def __post_init__(self) -> None:
        for name, radius in vars(self).items():
            require.nonnegative(f"radii: {name}", radius, unit="m")


@dataclass(frozen=True)
class CollisionScene:
    """Obstacles around the rig: tunnel walls, boxes and capsules.

    Attributes:
        walls: The hollow tunnel, a box whose edges may be infinite; its floor is a wall. None for no walls.
        solids: Boxes with finite edges, such as fittings of the floor and the parent aircraft.
        capsules: Capsules in world.
    """

    walls: Box | None = None
    solids: tuple[Box, ...] = ()
    capsules: tuple[Capsule, ...] = ()

    def __post_init__(self) -> None:
        if self.walls is not None:
            require.instance("scene: walls", self.walls, Box)
        for name, kind in (("solids", Box), ("capsules", Capsule)):
            set_fields(self, **{name: require.each(f"scene: {name}", getattr(self, name), kind)})


def rig_capsules(rig: Rig, q: Expression, radii: Radii | None = None) -> dict[str, LinkCapsule]:
    """Return the capsules that represent the rig's links at joint positions q, keyed by link name."""
    require.instance("rig: rig", rig, Rig)
    radii = Radii() if radii is None else require.instance("rig: radii", radii, Radii)
    frames = dh_frames(rig, checked_vector("q", q, 6, "one entry for each joint of the rig"))
    joint2, joint3, joint4 = (frames[k].position for k in (1, 2, 3))
    side = frames[3].point((0, 0, rig.yaw_offset))
    corner, tool = frames[4].position, frames[7]
    behind = tool.point((-rig.sting, 0, 0))
    return {
        "yaw link 1": LinkCapsule(radii.yaw, joint2, joint3),
        "yaw link 2": LinkCapsule(radii.yaw, joint3, joint4),
        "yaw offset": LinkCapsule(radii.yaw, joint4, side),
        "pitch link": LinkCapsule(radii.pitch, side, corner),
        "goose-neck": LinkCapsule(radii.sting, corner, behind),
        "sting": LinkCapsule(radii.sting, behind, tool.position),
    }


def clearances(
    rig: Rig, q: Expression, scene: CollisionScene, radii: Radii | None = None
) -> dict[tuple[str, str], Expression]:
    """Return the signed distance of every link from every obstacle, keyed by (link, obstacle). Shape (1, 1) each, m.

    Raises:
        ModelError: The scene is empty, or a solid box has an infinite edge.
    """
    require.instance("clearances: scene", scene, CollisionScene)
    distances: dict[tuple[str, str], Expression] = {}
    for name, capsule in rig_capsules(rig, q, radii).items():
        own = ca.vertcat(capsule.start, capsule.end, capsule.radius)
        if scene.walls is not None:
            distances[name, "walls"] = _distance_to_walls(capsule, scene.walls)
        obstacles: dict[str, Box | Capsule] = {f"solid {k}": box for k, box in enumerate(scene.solids)}
        obstacles |= {f"capsule {k}": obstacle for k, obstacle in enumerate(scene.capsules)}
        for label, obstacle in obstacles.items():
            distances[name, label] = pair_function(Capsule, type(obstacle))(own, column(obstacle))
    if not distances:
        raise ModelError("clearances: the scene is empty; give walls, solids or capsules", name="scene", value=scene)
    return distances


@dataclass(frozen=True)
class Avoidance:
    """Settings of obstacle avoidance for the rig: clearance as a constraint, as a term of the cost index, or both.

    Attributes:
        scene: Obstacles.
        clearance: Least distance of the rig from the scene, m; -inf for no constraint.
        weight, width: Weight and width (m) of the term weight exp(-gap / width) of the index.
        softness: Width of the smooth minimum of all distances, m; see `soft_minimum`.
        radii: Radii of the rig's capsules; the default ones if None.

    Raises:
        ModelError: A clearance that is nan or inf, a negative weight, a width or softness that is not positive.
    """

    scene: CollisionScene
    clearance: float = -np.inf
    weight: float = 0.0
    width: float = 0.05
    softness: float = 2e-3
    radii: Radii | None = None

    def __post_init__(self) -> None:
        require.instance("avoidance: scene", self.scene, CollisionScene)
        if require.number("avoidance: clearance", self.clearance, finite=False) == np.inf:
            message = f"avoidance: clearance {self.clearance} m must be a finite distance or -inf for none"
            raise ModelError(message, name="clearance", value=self.clearance)
        require.nonnegative("avoidance: weight", self.weight)
        require.positive("avoidance: width", self.width, unit="m")
        require.positive("avoidance: softness", self.softness, unit="m")
        if self.radii is not None:
            require.instance("avoidance: radii", self.radii, Radii)

    def gap(self, rig: Rig, q: Expression) -> Expression:
        """Return the smooth least distance of the rig from the scene at joint positions q. Shape (1, 1), m."""
        return soft_minimum(list(clearances(rig, q, self.scene, self.radii).values()), self.softness)

    def cost(self, gap: Expression) -> Expression:
        """Return the term of the cost index that grows as the gap (m) between rig and obstacles closes."""
        return self.weight * ca.exp(-gap / self.width)


def collision_free_inverse(
    rig: Rig, tunnel: Tunnel, avoidance: Avoidance, branch: Branch = HOME, *, rate_weight: float = 0.0
) -> Any:
    """Return the CasADi Function that computes the joint positions for a target at the best collision-free roll angle.

    (target, previous) -> (joints, cost, active, status, gap).

    Args:
        avoidance: Obstacles, clearance and proximity term.
        rate_weight: w4 of I2; 0 for I1.

    Returns:
        A CasADi Function with the outputs of `optimal_inverse` and the smooth least distance, m. `active` is the code
        of "clearance" if this constraint is active, else that of the closed form if its roll is best, else that of
        "free". The status "clearance" means that a roll reaches the target within limits, but none without collision.

    Raises:
        ModelError: The rate weight is out of range, or the scene is empty.
    """
    gain = checked_gain(rate_weight)
    require.instance("rig: rig", rig, Rig)
    require.instance("rig: tunnel", tunnel, Tunnel)
    branch = checked_branch(branch)
    clearance = require.instance("rig: avoidance", avoidance, Avoidance).clearance
    samples = SEARCH.samples
    target, previous, angle = ca.SX.sym("target", 5), ca.SX.sym("previous"), ca.SX.sym("angle")
    c, s = ca.cos(angle), ca.sin(angle)
    configuration = configuration_at(rig, target, c, s, branch=branch)
    roll = unwrap_roll(rig, c, s, previous)
    joints = joints_of(rig, target, roll, configuration)
    gap = avoidance.gap(rig, joints)
    cost = index_harmonics(rig, tunnel, target).value(c, s) + gain * (roll - previous) ** 2
    cost += avoidance.cost(gap)
    check = check_constraints(rig, target, configuration, c=c, s=s)
    within_limits = ca.logic_and(check.all_but_slide(), check.slide())
    feasible = ca.logic_and(within_limits, gap >= clearance)
    inputs = [target, previous, angle]
    value = ca.Function("value", inputs, ca.cse([ca.if_else(feasible, cost, ca.inf)]))
    short: Any = ca.fmax(clearance + SEARCH.inset - gap, 0) if np.isfinite(clearance) else 0.0
    merit = ca.Function("merit", inputs, ca.cse([ca.if_else(within_limits, cost + SEARCH.penalty * short, ca.inf)]))
    joints_and_gap = ca.Function("joints_and_gap", inputs, ca.cse([joints, gap]))

    x, before = ca.MX.sym("target", 5), ca.MX.sym("previous")
    closed, _, closed_active, closed_status = optimal_inverse(rig, tunnel, branch, rate_weight=rate_weight)(x, before)
    reached = closed_status == 0
    closed_roll = ca.if_else(reached, closed[5], 0.0)
    grid = ca.DM(np.linspace(-np.pi, np.pi, samples, endpoint=False)).T
    starts = ca.Function("starts", *_grid_minima(samples))(merit.map(samples)(x, before, grid))
    states = ca.horzcat(starts, ca.vertcat(closed_roll, merit(x, before, closed_roll), FULL_TURN / samples))
    refined = _pattern_search(merit)(states, ca.repmat(ca.vertcat(x, before), 1, SEARCH.minima + 1))
    angles = ca.horzcat(closed_roll, refined[0, :])
    values = value.map(SEARCH.minima + 2)(x, before, angles)
    best, least, from_closed = ca.Function("choice", *_least_value(SEARCH.minima + 2))(angles, values)
    q, distance = joints_and_gap(x, before, best)
    status = ca.if_else(reached, ca.if_else(least < ca.inf, 0, STATUS.index("clearance")), closed_status)
    invalid = ca.if_else(status == 0, 0, np.nan)
    active = ca.if_else(from_closed, closed_active, 0)
    active = ca.if_else(distance - clearance < SEARCH.active_tolerance, ACTIVE.index("clearance"), active)
    outputs = [q + invalid, least + invalid, active, status, distance + invalid]
    labels = ["target", "previous"], ["joints", "cost", "active", "status", "gap"]
    return ca.Function("collision_free_inverse", [x, before], outputs, *labels)


def _grid_minima(samples: int) -> tuple[list[Any], list[Any]]:
    """Return symbolic inputs and outputs of a Function that selects the lowest local minima of a merit on a roll grid.

    (merits) -> columns (angle, merit, step of the grid), one for each minimum.
    """
    merits = ca.SX.sym("merits", 1, samples)
    angles = np.linspace(-np.pi, np.pi, samples, endpoint=False)
    remaining = []
    for k in range(samples):
        is_minimum = ca.logic_and(merits[k] <= merits[k - 1], merits[k] <= merits[(k + 1) % samples])
        remaining.append(ca.if_else(is_minimum, merits[k], ca.inf))
    columns = []
    for _ in range(SEARCH.minima):
        best, least = ca.SX(0), ca.SX(ca.inf)
        for angle, merit in zip(angles, remaining, strict=True):
            best, least = ca.if_else(merit < least, angle, best), ca.fmin(merit, least)
        remaining = [ca.if_else(best == angle, ca.inf, merit) for angle, merit in zip(angles, remaining, strict=True)]
        columns.append(ca.vertcat(best, least, FULL_TURN / samples))
    return [merits], [ca.horzcat(*columns)]


def _least_value(count: int) -> tuple[list[Any], list[Any]]:
    """Return symbolic inputs and outputs of a Function that selects, of several roll angles, the angle of least cost.

    (angles, values) -> (best angle, least value, whether the first angle is the best).
    """
    angles, values = ca.SX.sym("angles", 1, count), ca.SX.sym("values", 1, count)
    best, least, is_first = angles[0], values[0], ca.SX(1)
    for k in range(1, count):
        better = values[k] < least
        best, least = ca.if_else(better, angles[k], best), ca.fmin(values[k], least)
        is_first = ca.if_else(better, 0, is_first)
    return [angles, values], [best, least, is_first]


def _pattern_search(merit: Any) -> Any:
    """Return the CasADi Function that minimises a merit function of the roll by pattern searches from several rolls.

    (states, inputs) -> states. A state is (angle, merit, step); the inputs are target and previous roll.
    """
    state, inputs = ca.MX.sym("state", 3), ca.MX.sym("inputs", 6)
    angle, least, step = ca.vertsplit(state)
    for side in (-0.5, 0.5):
        trial = state[0] + side * step
        value = merit(inputs[:5], inputs[5], trial)
        better = value < least
        angle, least = ca.if_else(better, trial, angle), ca.if_else(better, value, least)
    once = ca.Function("once", [state, inputs], [ca.vertcat(angle, least, step * SEARCH.shrink)])
    last = once.mapaccum(SEARCH.steps)(state, ca.repmat(inputs, 1, SEARCH.steps))[:, -1]
    return ca.Function("pattern", [state, inputs], [last]).map(SEARCH.minima + 1)
