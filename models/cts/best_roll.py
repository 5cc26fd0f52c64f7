"""Inverse kinematics of the captive trajectory rig at the optimal roll angle, also among obstacles.

The optimal roll on a set of arcs is a stationary point of the index inside an arc, or an end of an arc. Stationary
points are in closed form for I1 (`trigonometric.least_point`), and by Newton's method on intervals of convexity for I2.
Ends are only computed where a roll outside the arcs costs less.

Among obstacles, the lowest minima of a grid of rolls and the best roll without obstacles are refined by a pattern
search. A finer grid finds a minimum that it misses. Either way the number of operations is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.checks import require, set_fields
from models.cts.rig import (
    HOME,
    INCH,
    Branch,
    Rig,
    RigConfiguration,
    Tunnel,
    checked_branch,
    configuration_at,
    dh_frames,
    joints_of,
)
from models.cts.roll import (
    ACTIVE,
    STATUS,
    check_constraints,
    checked_gain,
    closed_form_ends,
    convex_minima,
    index_harmonics,
    infeasibility_code,
    inside_limit,
    limit_code,
    slide_ends,
    unwrap_roll,
    yaw_level_ends,
)
from models.cts.trigonometric import least_point, polish, roots
from models.errors import ModelError
from models.robot.kinematics import checked_vector
from models.shapes.distance import column, pair_function, soft_minimum
from models.shapes.shapes import Box, Capsule
from models.spatial import FULL_TURN, Expression


def optimal_inverse(
    rig: Rig, tunnel: Tunnel, branch: Branch = HOME, *, rate_weight: float = 0.0, limits: bool = True
) -> Any:
    """Return the casadi Function that computes the rig's joint positions for a target at the roll angle of least cost.

    Args:
        rig: Dimensions and joint limits.
        tunnel: Centre, ranges and weights of the index.
        branch: Branch of inverse kinematics.
        rate_weight: w4 of I2 = I1 + w4 / (2 pi) (roll - previous)^2, equation (37) of the paper; 0 for I1.
        limits: Whether reach and joint limits constrain the roll. Without them the minimum of the index is returned, in
            closed form, and the status says whether the pose is within reach and limits.

    Returns:
        The Function (target, previous) -> (joints, cost, active, status). Inputs: target (x, y, z, yaw, pitch), shape
        (5,); previous roll, rad. Outputs: joint positions, shape (6,), nan unless the status is 0; the index; code of
        the active constraint in roll.ACTIVE; code in roll.STATUS. The roll is given in the turn nearest to the previous
        roll that the limits of joint 6 allow or, if they are less than a full turn apart, between them.

    Raises:
        ModelError: The rate weight is negative or not finite, or limits=False has a rate weight.
    """
    require.instance("rig: rig", rig, Rig)
    require.instance("rig: tunnel", tunnel, Tunnel)
    branch, limits = checked_branch(branch), require.flag("rig: limits", limits)
    gain = checked_gain(rate_weight)
    if gain and not limits:
        message = "limits=False is for the closed form of I1; with a rate weight leave limits on"
        raise ModelError(message, name="limits", value=limits)
    return _build_inverse(rig, tunnel, branch, gain, limits)


@lru_cache(maxsize=32)
def _build_inverse(rig: Rig, tunnel: Tunnel, branch: Branch, gain: float, limits: bool) -> Any:
    search = _RollSearch(rig, tunnel, branch, gain)
    target, previous = ca.MX.sym("target", 5), ca.MX.sym("previous")
    solution = (search.best_roll if limits else search.closed_form)()(target, previous)
    name = f"optimal_inverse_{'i2' if gain else 'i1'}{'' if limits else '_free'}"
    parts = ca.vertsplit(solution, [0, 6, 7, 8, 9])
    return ca.Function(name, [target, previous], parts, ["target", "previous"], ["joints", "cost", "active", "status"])


class _RollSearch:
    """Search for the best roll angle; its methods return casadi Functions of (target, previous roll).

    A roll is a column (cosine, sine, code of the active constraint in roll.ACTIVE). A solution is the column (joint
    positions (6), cost, code in roll.ACTIVE, code in roll.STATUS).
    """

    def __init__(self, rig: Rig, tunnel: Tunnel, branch: Branch, gain: float) -> None:
        self.rig, self.tunnel, self.branch, self.gain = rig, tunnel, branch, gain
        self.target, self.previous = ca.SX.sym("target", 5), ca.SX.sym("previous")
        self.inputs = [self.target, self.previous]
        self.index = index_harmonics(rig, tunnel, self.target)
        self.is_finite = ca.fabs(ca.sum1(self.target) + self.previous) < ca.inf

    def closed_form(self) -> Any:
        """Return the Function that computes the solution at the least index I1 of all rolls."""
        c, s = least_point(self.index)
        check = check_constraints(self.rig, self.target, self._configuration(c, s), c=c, s=s)
        angles = ca.logic_and(check.pitch_angles, check.yaw_angles)
        status = ca.if_else(ca.logic_and(check.slide, angles), 0, 4)
        status = ca.if_else(check.pitch, ca.if_else(check.yaw, status, 3), 2)
        status = ca.if_else(self.is_finite, status, 1)
        solution = self._solution(ca.vertcat(c, s, 0), self.index.value(c, s), status)
        return ca.Function("closed_form", self.inputs, ca.cse([solution]))

    def best_roll(self) -> Any:
        """Return the Function that computes the solution at the feasible roll of least cost.

        Constraints are added in the order of the effort for the ends of their arcs. After each stage, the least cost of
        the rolls that satisfy the constraints so far is known; if that roll is feasible, it is optimal.
        """
        target, previous = ca.MX.sym("target", 5), ca.MX.sym("previous")
        best = self._compare(self._minima())(target, previous, ca.DM([1, 0, 0, *[ca.inf] * 4]))
        for relaxed_cost, rolls in enumerate((self._pitch_ends(), self._yaw_ends(), self._slide_ends()), start=4):
            if rolls.size2_out(0):
                is_optimal = best[relaxed_cost] >= best[3]
                best = evaluate_unless(self._compare(rolls))(is_optimal, best, target, previous, best)
        roll, cost = ca.SX.sym("roll", 3), ca.SX.sym("cost")
        finish = ca.Function("finish", [*self.inputs, roll, cost], ca.cse([self._solution(roll, cost, 0)]))
        reason = ca.if_else(self.is_finite, infeasibility_code(self.rig, self.target, self.branch), 1)
        nowhere = ca.vertcat(ca.DM.ones(7) * np.nan, 0, reason)
        infeasible = evaluate_unless(ca.Function("infeasible", self.inputs, ca.cse([nowhere])))
        solution = infeasible(best[3] < ca.inf, finish(target, previous, best[:3], best[3]), target, previous)
        return ca.Function("best_roll", [target, previous], [solution])

    def _minima(self) -> Any:
        """Return the Function of rolls that include the minimum of the index; for I2, all its minima."""
        if not self.gain:
            return ca.Function("minimum", self.inputs, ca.cse([ca.vertcat(*least_point(self.index), 0)]))
        target, previous = ca.MX.sym("target", 5), ca.MX.sym("previous")
        angles = convex_minima(self.rig, self.tunnel, self.gain)(target, previous).T
        rolls = [ca.vertcat(ca.cos(angles), ca.sin(angles), ca.DM.zeros(1, angles.shape[1]))]
        if np.isfinite(self.rig.limit(6, False)):  # the penalty on the change may drive the roll to a limit of joint 6
            for upper in (False, True):
                angle = inside_limit(self.rig, 6, upper)
                rolls.append(ca.DM([np.cos(angle), np.sin(angle), limit_code(6, upper)]))
        return ca.Function("minima", [target, previous], [ca.horzcat(*rolls)])

    def _pitch_ends(self) -> Any:
        """Return the Function of the arcs' ends due to the pitch link and joints 4 to 6, for I1 with the other
        stationary rolls.
        """
        rolls = [ca.vertcat(*end) for end in closed_form_ends(self.rig, self.target, self.branch)]
        if not self.gain:
            slope = self.index.derivative()
            bend = slope.derivative()
            for point in roots(slope, steps=0):
                rolls.append(ca.vertcat(*polish(point, lambda c, s: (slope.value(c, s), bend.value(c, s))), 0))
        return ca.Function("pitch_ends", self.inputs, ca.cse([ca.horzcat(*rolls)]))

    def _yaw_ends(self) -> Any:
        """Return the Function of the arcs' ends at the reach of the yaw link and the limits of joints 2 and 3."""
        ends = [ca.vertcat(*end) for end in yaw_level_ends(self.rig, self.target, self.branch)]
        return ca.Function("yaw_ends", self.inputs, ca.cse([ca.horzcat(*ends)]))

    def _slide_ends(self) -> Any:
        """Return the Function of the arcs' ends at the limits of joint 1."""
        target, previous = ca.MX.sym("target", 5), ca.MX.sym("previous")
        return ca.Function("slide_ends", [target, previous], [slide_ends(self.rig, self.branch)(target)])

    def _compare(self, rolls: Any) -> Any:
        """Return the Function (target, previous, best) -> best that compares the best roll so far with others.

        `best` is the column (roll (3), its cost, least costs of any roll, of rolls with reachable pitch, and of rolls
        that violate at most the limits of joint 1).
        """
        roll = ca.SX.sym("roll", 3)
        c, s, _ = ca.vertsplit(roll)
        cost = self.index.value(c, s)
        if self.gain:
            cost += self.gain * (unwrap_roll(self.rig, c, s, self.previous) - self.previous) ** 2
        check = check_constraints(self.rig, self.target, self._configuration(c, s), c=c, s=s)
        all_but_slide = check.all_but_slide()
        feasible = ca.logic_and(all_but_slide, check.slide)
        costs = [ca.if_else(holds, cost, ca.inf) for holds in (feasible, 1, check.is_pitch_reachable(), all_but_slide)]
        evaluate = ca.Function("costs", [*self.inputs, roll], ca.cse([ca.vertcat(*costs)]))

        target, previous, best = ca.MX.sym("target", 5), ca.MX.sym("previous"), ca.MX.sym("best", 7)
        points = rolls(target, previous)
        levels = ca.horzcat(best[3:], evaluate.map(points.shape[1])(target, previous, points))
        points = ca.horzcat(best[:3], points)
        lowest, least = select_lowest(3, points.shape[1])(points, levels[0, :])
        relaxed = [ca.mmin(levels[k, :]) for k in (1, 2, 3)]
        return ca.Function("compare", [target, previous, best], [ca.vertcat(lowest, least, *relaxed)])

    def _configuration(self, c: Expression, s: Expression) -> RigConfiguration:
        return configuration_at(self.rig, self.target, c, s, branch=self.branch)

    def _solution(self, roll: Expression, cost: Expression, status: Expression) -> Expression:
        c, s, code = ca.vertsplit(roll)
        joints = joints_of(self.rig, self.target, unwrap_roll(self.rig, c, s, self.previous), self._configuration(c, s))
        spoilt = ca.if_else(ca.SX(status) == 0, 0, np.nan)
        return ca.vertcat(joints + spoilt, cost + spoilt, code, status)


def select_lowest(size: int, count: int) -> Any:
    """Return the casadi Function (columns, values) -> (first column of least value, least value)."""
    columns, values = ca.SX.sym("columns", size, count), ca.SX.sym("values", 1, count)
    best, least = columns[:, 0], values[0]
    for k in range(1, count):
        best, least = ca.if_else(values[k] < least, columns[:, k], best), ca.fmin(values[k], least)
    return ca.Function("select_lowest", [columns, values], [best, least])


def evaluate_unless(alternative: Any) -> Any:
    """Return the Function (settled, known, *arguments) -> `known` if `settled` is true, else alternative(*arguments).

    The alternative is only evaluated if needed; casadi.if_else would also evaluate what its arguments depend on.
    """
    known = ca.MX.sym("known", *alternative.size_out(0))
    inputs = [ca.MX.sym(f"x{i}", alternative.sparsity_in(i)) for i in range(alternative.n_in())]
    keep = ca.Function("keep", [known, *inputs], [known])
    call = ca.Function("call", [known, *inputs], alternative.call(inputs))
    return ca.Function.if_else("choose", keep, call)


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
    """Settings of the search for the roll angle of least cost at which the rig collides with nothing."""

    samples: int = 72  # number of rolls in the grid
    softness: float = 2e-3  # width of the smooth minimum of all distances, m; see `soft_minimum`
    minima: int = 4  # number of local minima on the grid that are refined
    steps: int = 44  # steps of the pattern search
    shrink: float = 0.62  # ratio of successive step sizes; 0.62^44 is 7e-10
    penalty: float = 1e3  # penalty on missing clearance in the merit function, 1/m
    inset: float = 1e-10  # distance beyond the least clearance that the search aims for, m
    active_tolerance: float = 1e-6  # distance from the least clearance below which the constraint counts as active, m


SEARCH = ClearanceSearch()


@dataclass(frozen=True)
class Radii:
    """Radii of the capsules that represent yaw links, pitch link, goose-neck and sting of the rig, m."""

    yaw: float = 2.0 * INCH
    pitch: float = 1.5 * INCH
    sting: float = 0.75 * INCH

    def __post_init__(self) -> None:
        for what, radius in vars(self).items():
            require.nonnegative(f"radii: {what}", radius, unit="m")


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
        for what, kind in (("solids", Box), ("capsules", Capsule)):
            set_fields(self, **{what: require.each(f"scene: {what}", getattr(self, what), kind)})


def rig_capsules(rig: Rig, q: Expression, radii: Radii | None = None) -> dict[str, LinkCapsule]:
    """Return the capsules that represent the rig's links, from yaw link 1 to the sting, by name of the link."""
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
        message = "clearances: the scene is empty; give walls, solids or capsules"
        raise ModelError(message, name="scene", value=scene)
    return distances


def proximity_cost(gap: Expression, weight: float, width: float) -> Expression:
    """Return a cost term that grows as the gap between rig and obstacles closes: weight exp(-gap / width), both in m.

    Raises:
        ModelError: The weight is negative or not finite, or the width is not positive.
    """
    require.nonnegative("clearance: weight", weight)
    require.positive("clearance: width", width, unit="m")
    return weight * ca.exp(-gap / width)


def checked_clearance(clearance: float) -> float:
    """Return a required clearance, m; raise a ModelError unless it is finite, or -inf for no constraint."""
    if require.number("rig: clearance", clearance, finite=False) == np.inf:
        message = f"clearance {clearance} m must be a finite distance or -inf for none"
        raise ModelError(message, name="clearance", value=clearance)
    return clearance


@dataclass(frozen=True)
class Avoidance:
    """Settings of obstacle avoidance for the rig: clearance as a constraint, as a term of the cost index, or both.

    Attributes:
        scene: Obstacles.
        clearance: Least distance of the rig from the scene, m; -inf for no constraint.
        weight, width: Weight and width (m) of the term weight exp(-gap / width) of the index.
        radii: Radii of the rig's capsules; the default ones if None.

    Raises:
        ModelError: A clearance that is nan or inf, a negative weight, a width that is not positive.
    """

    scene: CollisionScene
    clearance: float = -np.inf
    weight: float = 0.0
    width: float = 0.05
    radii: Radii | None = None

    def __post_init__(self) -> None:
        require.instance("avoidance: scene", self.scene, CollisionScene)
        checked_clearance(self.clearance)
        require.nonnegative("avoidance: weight", self.weight)
        require.positive("avoidance: width", self.width, unit="m")
        if self.radii is not None:
            require.instance("avoidance: radii", self.radii, Radii)


def collision_free_inverse(
    rig: Rig, tunnel: Tunnel, avoidance: Avoidance, branch: Branch = HOME, *, rate_weight: float = 0.0
) -> Any:
    """Return the casadi Function that computes the joint positions for a target at the best collision-free roll angle.

    Args:
        avoidance: Obstacles, clearance and proximity term.
        rate_weight: w4 of I2; 0 for I1.

    Returns:
        The Function (target, previous) -> (joints, cost, active, status, gap): the outputs of `optimal_inverse` and
            the smooth least distance, m. `active` is "clearance" if this constraint is active, else as at the roll
            without obstacles if that is the best, else "free". The status "clearance" means that every roll within
            the limits collides.

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
    gap = soft_minimum(list(clearances(rig, joints, avoidance.scene, avoidance.radii).values()), SEARCH.softness)
    cost = index_harmonics(rig, tunnel, target).value(c, s) + gain * (roll - previous) ** 2
    cost += proximity_cost(gap, avoidance.weight, avoidance.width)
    check = check_constraints(rig, target, configuration, c=c, s=s)
    within_limits = ca.logic_and(check.all_but_slide(), check.slide)
    feasible = ca.logic_and(within_limits, gap >= clearance)
    inputs = [target, previous, angle]
    value = ca.Function("value", inputs, ca.cse([ca.if_else(feasible, cost, ca.inf)]))
    short: Any = ca.fmax(clearance + SEARCH.inset - gap, 0) if np.isfinite(clearance) else 0.0
    penalised = ca.if_else(within_limits, cost + SEARCH.penalty * short, ca.inf)
    merit = ca.Function("merit", inputs, ca.cse([penalised]))
    joints_and_gap = ca.Function("joints_and_gap", inputs, ca.cse([joints, gap]))

    x, before = ca.MX.sym("target", 5), ca.MX.sym("previous")
    closed, _, closed_active, closed_status = optimal_inverse(rig, tunnel, branch, rate_weight=rate_weight)(x, before)
    reached = closed_status == 0
    closed_roll = ca.if_else(reached, closed[5], 0.0)
    grid = ca.DM(np.linspace(-np.pi, np.pi, samples, endpoint=False)).T
    starts = ca.Function("starts", *_grid_minima(samples))(merit.map(samples)(x, before, grid))
    states = ca.horzcat(starts, ca.vertcat(closed_roll, merit(x, before, closed_roll), FULL_TURN / samples))
    refined = _pattern_search(merit)(states, ca.repmat(ca.vertcat(x, before), 1, SEARCH.minima + 1))
    count = SEARCH.minima + 2
    angles = ca.horzcat(closed_roll, refined[0, :])
    codes = ca.horzcat(closed_active, ca.DM.zeros(1, count - 1))
    best, least = select_lowest(2, count)(ca.vertcat(angles, codes), value.map(count)(x, before, angles))
    q, distance = joints_and_gap(x, before, best[0])
    status = ca.if_else(reached, ca.if_else(least < ca.inf, 0, STATUS.index("clearance")), closed_status)
    invalid = ca.if_else(status == 0, 0, np.nan)
    active = ca.if_else(distance - clearance < SEARCH.active_tolerance, ACTIVE.index("clearance"), best[1])
    outputs = [q + invalid, least + invalid, active, status, distance + invalid]
    labels = ["target", "previous"], ["joints", "cost", "active", "status", "gap"]
    return ca.Function("collision_free_inverse", [x, before], outputs, *labels)


def _grid_minima(samples: int) -> tuple[list[Any], list[Any]]:
    """Return inputs and outputs of the Function (merits on a grid) -> lowest minima, columns (angle, merit, step)."""
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


def _pattern_search(merit: Any) -> Any:
    """Return the Function (states, inputs) -> states that minimises the merit by pattern searches from several roll
    angles.

    A state is (angle, merit, step); the inputs are target and previous roll.
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
