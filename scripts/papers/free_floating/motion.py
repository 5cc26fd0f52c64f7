"""Motions of the free-floating machine on a time grid, and the laws they are held against."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models import FreeFloating, centers_of_mass, link_frames
from models.checks import Array
from ocp import Audit, Solution
from ocp.curves import PiecewisePolynomial, differentiation_matrix
from ocp.motion.local.rates import LocalSolution, least_rates


@dataclass(frozen=True)
class Motion:
    """A motion at M times; the task fixes some rows of the tip's twist.

    Attributes:
        t: Shape (M,), s.
        base: Base pose (x, y, angle) in world. Shape (M, 3), m and rad.
        joints: Shape (M, n), rad.
        base_rates: Derivative of `base`. Shape (M, 3).
        joint_rates: Shape (M, n), rad/s.
        joint_accelerations: Shape (M, n), rad/s^2.
        tip_in_world: Shape (M, 2), m.
        manipulability: sqrt(det(G G')) of the task's rows. Shape (M,).
    """

    t: Array
    base: Array
    joints: Array
    base_rates: Array
    joint_rates: Array
    joint_accelerations: Array
    tip_in_world: Array
    manipulability: Array

    def peak_joint_rates(self) -> tuple[Array, Array]:
        """Signed joint rate that is largest in size, and its time, for each joint. Shapes (n,), rad/s and s."""
        where = np.abs(self.joint_rates).argmax(axis=0)
        return self.joint_rates[where, np.arange(len(where))], self.t[where]

    def accelerations_at_peaks(self) -> Array:
        """Acceleration of each joint when its own rate is largest in size. Shape (n,), rad/s^2."""
        where = np.abs(self.joint_rates).argmax(axis=0)
        return np.asarray(self.joint_accelerations[where, np.arange(len(where))])

    @property
    def largest_accelerations(self) -> Array:
        """Of each joint, in size. Shape (n,), rad/s^2."""
        return np.asarray(np.abs(self.joint_accelerations).max(axis=0))

    def at(self, time: float) -> int:
        """Index of the grid time nearest to `time`."""
        return int(np.abs(self.t - time).argmin())


def motion_of_local(machine: FreeFloating, local: LocalSolution, tip_velocity: Array, rows: Sequence[int]) -> Motion:
    """The pseudo-inverse motion x2' = G# v; its accelerations by differentiating G# v along the motion."""

    def accelerations(base: Any, joints: Any) -> Any:
        rates = least_rates(machine.tip_jacobian(base, joints)[list(rows), :], ca.DM(tip_velocity))
        flow = ca.vertcat(machine.base_rate(base, joints, rates), rates)
        return ca.jtimes(rates, ca.vertcat(base, joints), flow)

    places = local.base, local.joints
    derivatives = local.base_rates, local.joint_rates, _along(accelerations, *places)
    return Motion(local.t, *places, *derivatives, local.tip_in_world[:, :2], local.manipulability)


def motion_of_plan(
    machine: FreeFloating, plan: Solution, times: Array, rows: Sequence[int], extremal: Solution
) -> Motion:
    """A plan with the control "rates" at any times, by its own interpolants.

    The accelerations are those of `extremal`, the same optimum by the minimum principle: the slope of a collocation
    plan's control, a polynomial of degree 2 in every interval, is right to a few digits only.
    """

    def manipulability(base: Any, joints: Any) -> Any:
        jacobian = machine.tip_jacobian(base, joints)[list(rows), :]
        return ca.sqrt(ca.det(ca.mtimes(jacobian, jacobian.T)))

    base, joints, rates = (plan.at(times)[name] for name in ("base", "joints", "rates"))
    base_rates = _along(machine.base_rate, base, joints, rates)
    slopes = _derivative(extremal.control_interpolant, extremal.horizon)(times / extremal.horizon)
    size = _along(manipulability, base, joints)[:, 0]
    return Motion(times, base, joints, base_rates, rates, slopes, _tip(machine, base, joints), size)


@dataclass(frozen=True)
class Laws:
    """How well a re-integrated plan keeps the laws that it was made for.

    Attributes:
        tip_error: Largest distance of the tip from where the constant tip velocity would carry it, m.
        momentum_drift: Largest component of the momentum (Lz, Px, Py), kg m^2/s and kg m/s.
        center_of_mass_drift: Largest displacement of the total centre of mass, m.
    """

    tip_error: float
    momentum_drift: float
    center_of_mass_drift: float


def laws(machine: FreeFloating, audit: Audit, tip_velocity: Array) -> Laws:
    """Laws of the motion that an audit got by integrating the control "rates" anew."""
    base, joints, rates = audit.states["base"], audit.states["joints"], audit.controls["rates"]
    tip, center = _tip(machine, base, joints), total_center_of_mass(machine, base, joints)
    off_the_line = tip - (tip[0] + audit.t[:, None] * tip_velocity)
    total = momentum(machine, base, joints, _along(machine.base_rate, base, joints, rates), rates)
    return Laws(
        float(np.linalg.norm(off_the_line, axis=1).max()),
        float(np.abs(total).max()),
        float(np.linalg.norm(center - center[0], axis=1).max()),
    )


def momentum(machine: FreeFloating, base: Array, joints: Array, base_rates: Array, joint_rates: Array) -> Array:
    """Angular momentum about the world's origin and linear momentum (Lz, Px, Py), link by link.

    From the placements of the links alone, differentiated along the motion; no Jacobian, no momentum matrix and no
    spatial inertia of `models` takes part. Shape (M, 3), kg m^2/s and kg m/s.
    """

    def total(base: Any, joints: Any, base_rate: Any, rates: Any) -> Any:
        configuration, rate = ca.vertcat(base, joints), ca.vertcat(base_rate, rates)
        placement = machine.world_from_base(base)
        frames = link_frames(machine.robot, joints, placement)
        centers = centers_of_mass(machine.robot, joints, placement)
        result: Any = ca.SX(3, 1)
        for link in machine.robot.links:
            center, turn = centers[link.name], frames[link.name].rotation
            velocity = ca.jtimes(center, configuration, rate)
            spin = ca.dot(turn[:, 1], ca.jtimes(turn[:, 0], configuration, rate))  # y . dx/dt: rotation about z
            turning = link.mass * (center[0] * velocity[1] - center[1] * velocity[0]) + link.inertia[2, 2] * spin
            result += ca.vertcat(turning, link.mass * velocity[:2])
        return result

    return _along(total, base, joints, base_rates, joint_rates)


def total_center_of_mass(machine: FreeFloating, base: Array, joints: Array) -> Array:
    """Centre of mass of the whole machine in world, which stands still while the momentum is zero. Shape (M, 2), m."""

    def center(base: Any, joints: Any) -> Any:
        centers = centers_of_mass(machine.robot, joints, machine.world_from_base(base))
        return sum(link.mass * centers[link.name] for link in machine.robot.links) / machine.robot.total_mass

    return _along(center, base, joints)[:, :2]


def outline(machine: FreeFloating, plate: float) -> Callable[[Array, Array], tuple[Array, Array]]:
    """A function of one (base, joints) that gives what to draw, in world.

    Args:
        machine: The planar machine.
        plate: Side of its square base, m.

    Returns:
        Function whose results are the corners of the base, first one repeated, shape (5, 2), and the arm from its
        mount over the joints to the tip, shape (n + 1, 2).
    """
    symbols = ca.SX.sym("base", machine.base_size), ca.SX.sym("joints", machine.joint_size)
    placement = machine.world_from_base(symbols[0])
    corners = plate / 2 * np.array([[-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1], [0, 0, 0, 0, 0]])
    square = ca.horzcat(*(placement.point(ca.DM(corner)) for corner in corners.T))
    frames = link_frames(machine.robot, symbols[1], placement)
    arm = ca.horzcat(
        *(frames[joint.child].position for joint in machine.robot.moving_joints), machine.tip_pose(*symbols).position
    )
    function = ca.Function("outline", list(symbols), [square[:2, :].T, arm[:2, :].T])

    def draw(base: Array, joints: Array) -> tuple[Array, Array]:
        square, arm = function(base, joints)
        return np.array(square), np.array(arm)

    return draw


def _tip(machine: FreeFloating, base: Array, joints: Array) -> Array:
    """Tip at M samples. Shape (M, 2), m."""
    return _along(lambda b, q: machine.tip_pose(b, q).position[:2], base, joints)


def _along(of: Callable[..., Any], *samples: Array) -> Array:
    """An expression of symbols at M samples of them, each (M, n). Shape (M, m)."""
    symbols = [ca.SX.sym(f"x{k}", sample.shape[1]) for k, sample in enumerate(samples)]
    function = ca.Function("along", symbols, [of(*symbols)])
    return np.array(function.map(len(samples[0]))(*(sample.T for sample in samples))).T


def _derivative(curve: PiecewisePolynomial, horizon: float) -> PiecewisePolynomial:
    """Time derivative of a curve over fractions of the horizon."""
    by_place = np.einsum("ij,kjn->kin", differentiation_matrix(curve.nodes), curve.values)
    widths = np.diff(curve.breaks)[:, None, None] * horizon
    return PiecewisePolynomial(curve.breaks, curve.nodes, by_place / widths)
