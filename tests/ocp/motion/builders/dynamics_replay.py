"""Plans by their drives in MuJoCo: its torques and energies at the plan's own states, and the plan's torques replayed.

A plan has its derivatives at the collocation points alone, so that is where it is compared; Gauss' weights add up what
is between. A replay integrates MuJoCo's accelerations itself, by the classical Runge-Kutta steps with the torques of
every stage's own time: `mj_step` would hold them over a step, which is of the first order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import mujoco
import numpy as np

from models import FixedBase, FreeFloating, simplify
from models.checks import Array
from ocp import Solution, joint_torques
from ocp.curves import quadrature_weights
from scripts.robots.simulation import mujoco_model


@dataclass(frozen=True)
class Replay:
    """What MuJoCo makes of a plan.

    Attributes:
        inverse: Largest difference at the collocation points: of its torques from the plan's, N m, where the base is
            fixed, else of the accelerations that the torques of the plan make, rad/s^2.
        work: What the plan's torques do from node to node. Shape (N,), J.
        energy: Kinetic and potential energy that MuJoCo finds at the plan's nodes. Shape (N + 1,), J.
        replayed: The same along the replay. Shape (N + 1,), J.
        momentum: Largest total momentum in the replay, angular about the centre of mass, and linear; N m s, N s.
        off: Largest difference of a joint from the plan at a node of the replay, rad.
    """

    inverse: float
    work: Array
    energy: Array
    replayed: Array
    momentum: float
    off: float


def replay(machine: FixedBase | FreeFloating, plan: Solution, steps: int = 80) -> Replay:
    """A plan of `dynamics_problem` by Legendre collocation, nothing but the joints' torques acting.

    Args:
        steps: Of Runge-Kutta in each interval.
    """
    fixed = isinstance(machine, FixedBase)
    robot = simplify(machine.robot)
    model = mujoco_model(robot, fixed=fixed)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    if not fixed:
        model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    columns = [model.joint(name).dofadr[0] for name in robot.joint_names]
    places = [model.joint(name).qposadr[0] for name in robot.joint_names]
    function, twist_of = _functions(machine)
    curve, control = plan.state_interpolant, plan.control_interpolant
    breaks, width, horizon = control.breaks, np.diff(control.breaks), plan.horizon
    begin, at = 0, {}
    for name, values in plan.states.items():
        at[name] = slice(begin, begin + values.shape[1])
        begin += values.shape[1]

    def along(k: int, fractions: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Base, joints, rates, accelerations and torques inside an interval."""
        x = curve(breaks[k] + width[k] * fractions)
        base = x[:, at["base"]] if machine.base_size else np.zeros((len(x), 0))
        second = control.within(np.full(len(fractions), k), fractions)
        joints, rates = x[:, at["joints"]], x[:, at["velocities"]]
        return base, joints, rates, second, np.array(function(base.T, joints.T, rates.T, second.T)).T

    def put(base: Array, joints: Array, rates: Array) -> None:
        data.qpos[places], data.qvel[columns] = joints, rates
        if not fixed:
            twist = np.array(twist_of(base, joints, rates)).ravel()
            turn = np.array(ca.DM(machine.world_from_base(base).rotation))
            data.qpos[:7], data.qvel[:3], data.qvel[3:6] = base, twist[3:], turn.T @ twist[:3]

    def energy() -> float:
        mujoco.mj_forward(model, data)
        return float(data.energy.sum())

    def slope(position: Array, velocity: Array, torques: Array) -> tuple[Array, Array]:
        data.qpos[:], data.qvel[:] = position, velocity
        data.qfrc_applied[columns] = torques
        mujoco.mj_forward(model, data)
        rate = velocity
        if not fixed:
            w, x, y, z = position[3:7]
            spin = np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]) @ velocity[3:6] / 2
            rate = np.concatenate([velocity[:3], spin, velocity[6:]])
        return rate, np.array(data.qacc)

    worst, work, energies = 0.0, [], []
    for k in range(len(width)):
        base, joints, rates, second, torques = along(k, control.nodes)
        for i in range(len(joints)):
            put(base[i], joints[i], rates[i])
            if fixed:
                data.qacc[columns] = second[i]
                mujoco.mj_inverse(model, data)
                result = data.qfrc_inverse[columns]
                worst = max(worst, float(np.abs(result - torques[i]).max()))
            else:  # the base accelerates as it must: forward dynamics give the joints' accelerations back
                data.qfrc_applied[columns] = torques[i]
                mujoco.mj_forward(model, data)
                worst = max(worst, float(np.abs(data.qacc[columns] - second[i]).max()))
        work.append(horizon * width[k] * (quadrature_weights(control.nodes) @ (torques * rates).sum(axis=1)))
    data.qfrc_applied[:] = 0.0
    nodes = [along(min(k, len(width) - 1), np.array([float(k == len(width))])) for k in range(len(breaks))]
    for base, joints, rates, *_ in nodes:
        put(base[0], joints[0], rates[0])
        energies.append(energy())

    put(*(part[0] for part in nodes[0][:3]))
    replayed, momentum, off = [energy()], 0.0, 0.0
    position, velocity = np.array(data.qpos), np.array(data.qvel)
    for k in range(len(width)):
        torques = along(k, np.linspace(0.0, 1.0, 2 * steps + 1))[-1]
        step = horizon * width[k] / steps
        for i in range(steps):
            first = slope(position, velocity, torques[2 * i])
            half = [slope(*_moved(position, velocity, first, step / 2), torques[2 * i + 1])]
            half.append(slope(*_moved(position, velocity, half[0], step / 2), torques[2 * i + 1]))
            last = slope(*_moved(position, velocity, half[1], step), torques[2 * i + 2])
            mean = [(first[j] + 2 * half[0][j] + 2 * half[1][j] + last[j]) / 6 for j in (0, 1)]
            position, velocity = _moved(position, velocity, (mean[0], mean[1]), step)
        data.qpos[:], data.qvel[:] = position, velocity
        replayed.append(energy())
        off = max(off, float(np.abs(position[places] - nodes[k + 1][1][0]).max()))
        if not fixed:
            mujoco.mj_subtreeVel(model, data)
            total = np.concatenate([data.subtree_angmom[0], data.subtree_linvel[0] * model.body_subtreemass[0]])
            momentum = max(momentum, float(np.abs(total).max()))
    return Replay(worst, np.array(work), np.array(energies), np.array(replayed), momentum, off)


def _moved(position: Array, velocity: Array, slopes: tuple[Array, Array], step: float) -> tuple[Array, Array]:
    return position + step * slopes[0], velocity + step * slopes[1]


def _functions(machine: Any) -> tuple[Any, Any]:
    """Torques of columns of base, joints, rates and accelerations; twist of the base."""
    symbols = [ca.SX.sym("z", size) for size in (machine.base_size, *[machine.joint_size] * 3)]
    twist = machine.base_twist(*symbols[:3]) if machine.base_size else ca.DM(0, 1)
    torques = ca.Function("torques", symbols, [joint_torques(machine, (*symbols,))])
    return torques, ca.Function("twist", symbols[:3], [ca.densify(ca.SX(twist))])
