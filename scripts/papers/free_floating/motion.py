"""Motions of the free-floating machine on a time grid, and the laws they are held against."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import FreeFloating, centers_of_mass, link_frames
from ocp import Audit, Solution
from ocp.curves import PiecewisePolynomial, differentiation_matrix
from ocp.local.rates import LocalSolution, least_rates

__all__ = ["Laws", "Motion", "laws", "momentum", "motion_of_local", "motion_of_plan", "outline", "total_center_of_mass"]

Array: TypeAlias = NDArray[np.float64]


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

    def at(self, time: float) -> int:
        """Index of the grid time nearest to `time`."""
        return int(np.abs(self.t - time).argmin())


def motion_of_local(machine: FreeFloating, local: LocalSolution, tip_velocity: Array, rows: Sequence[int]) -> Motion:
    """The pseudo-inverse motion x2' = G# v; its accelerations by differentiating G# v along the motion."""
    base, joints = _symbols(machine)
    rates = least_rates(machine.tip_jacobian(base, joints)[list(rows), :], ca.DM(tip_velocity))
    flow = ca.vertcat(machine.base_rate(base, joints, rates), rates)
    accelerations = ca.jtimes(rates, ca.vertcat(base, joints), flow)
    found = _along(ca.Function("accelerations", [base, joints], [accelerations]), local.base, local.joints)
    return Motion(
        local.t,
        local.base,
        local.joints,
        local.base_rates,
        local.joint_rates,
        found,
        local.tip_in_world[:, :2],
        local.manipulability,
    )


def motion_of_plan(
    machine: FreeFloating, plan: Solution, times: Array, rows: Sequence[int], extremal: Solution
) -> Motion:
    """A plan with the control "rates" at any times, by its own interpolants.

    The accelerations are those of `extremal`, the same optimum by the minimum principle: the slope of a collocation
    plan's control, a polynomial of degree 2 in every interval, is right to a few digits only.
    """
    sample = plan.at(times)
    base, joints = _symbols(machine)
    jacobian = machine.tip_jacobian(base, joints)[list(rows), :]
    size = ca.sqrt(ca.det(ca.mtimes(jacobian, jacobian.T)))
    return Motion(
        times,
        sample["base"],
        sample["joints"],
        _base_rates(machine, sample["base"], sample["joints"], sample["rates"]),
        sample["rates"],
        _derivative(extremal.control_interpolant, extremal.horizon)(times / extremal.horizon),
        _tip(machine, sample["base"], sample["joints"]),
        _along(ca.Function("manipulability", [base, joints], [size]), sample["base"], sample["joints"])[:, 0],
    )


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
    total = momentum(machine, base, joints, _base_rates(machine, base, joints, rates), rates)
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
    symbols = *_symbols(machine), ca.SX.sym("base_rate", machine.base_size), ca.SX.sym("rates", machine.joint_size)
    configuration, rate = ca.vertcat(*symbols[:2]), ca.vertcat(*symbols[2:])
    placement = machine.world_from_base(symbols[0])
    frames = link_frames(machine.robot, symbols[1], placement)
    centers = centers_of_mass(machine.robot, symbols[1], placement)
    total: Any = ca.SX(3, 1)
    for link in machine.robot.links:
        center, turn = centers[link.name], frames[link.name].rotation
        velocity = ca.jtimes(center, configuration, rate)
        spin = ca.dot(turn[:, 1], ca.jtimes(turn[:, 0], configuration, rate))  # y . dx/dt: rotation about z
        turning = link.mass * (center[0] * velocity[1] - center[1] * velocity[0]) + link.inertia[2, 2] * spin
        total += ca.vertcat(turning, link.mass * velocity[:2])
    return _along(ca.Function("momentum", list(symbols), [total]), base, joints, base_rates, joint_rates)


def total_center_of_mass(machine: FreeFloating, base: Array, joints: Array) -> Array:
    """Centre of mass of the whole machine in world, which stands still while the momentum is zero. Shape (M, 2), m."""
    symbols = _symbols(machine)
    centers = centers_of_mass(machine.robot, symbols[1], machine.world_from_base(symbols[0]))
    moment = sum(link.mass * centers[link.name] for link in machine.robot.links)
    return _along(ca.Function("center", list(symbols), [moment / machine.robot.total_mass]), base, joints)[:, :2]


def outline(machine: FreeFloating, plate: float) -> Callable[[Array, Array], tuple[Array, Array]]:
    """A function of one (base, joints) that gives what to draw, in world.

    Args:
        machine: The planar machine.
        plate: Side of its square base, m.

    Returns:
        Function whose results are the corners of the base, first one repeated, shape (5, 2), and the arm from its
        mount over the joints to the tip, shape (n + 1, 2).
    """
    symbols = _symbols(machine)
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


def _symbols(machine: FreeFloating) -> tuple[Any, Any]:
    return ca.SX.sym("base", machine.base_size), ca.SX.sym("joints", machine.joint_size)


def _base_rates(machine: FreeFloating, *motion: Array) -> Array:
    """Derivative of the base configuration at M samples of (base, joints, joint rates). Shape (M, 3)."""
    symbols = *_symbols(machine), ca.SX.sym("rates", machine.joint_size)
    return _along(ca.Function("base_rates", list(symbols), [machine.base_rate(*symbols)]), *motion)


def _tip(machine: FreeFloating, *configuration: Array) -> Array:
    """Tip at M samples of (base, joints). Shape (M, 2), m."""
    symbols = _symbols(machine)
    return _along(ca.Function("tip", list(symbols), [machine.tip_pose(*symbols).position[:2]]), *configuration)


def _along(function: Any, *samples: Array) -> Array:
    """A casadi function at M samples of its arguments, each (M, n). Shape (M, m)."""
    return np.array(function.map(len(samples[0]))(*(sample.T for sample in samples))).T


def _derivative(curve: PiecewisePolynomial, horizon: float) -> PiecewisePolynomial:
    """Time derivative of a curve over fractions of the horizon."""
    by_place = np.einsum("ij,kjn->kin", differentiation_matrix(curve.nodes), curve.values)
    widths = np.diff(curve.breaks)[:, None, None] * horizon
    return PiecewisePolynomial(curve.breaks, curve.nodes, by_place / widths)
