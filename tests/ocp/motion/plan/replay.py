"""Plans replayed by Pinocchio: where its tip is, with a base that moves as momentum says, against numbers of the path.

Nothing of the library's kinematics and none of its tracks takes part: robots are read again from their files, wanted
places come from `SmoothPath.at` and `SmoothPath.turn`, and a floating base is integrated from the joint rates alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pinocchio
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from models import SmoothPath
from ocp.motion.plan import Plan
from tests.models.robot.pinocchio_robots import ROBOTS, urdf_file
from tests.models.robot.trees import Array


@dataclass(frozen=True)
class Arm:
    """An arm of a machine as Pinocchio reads it from its file.

    Attributes:
        model: On a free joint.
        prefix: Of its joints' names in the machine.
        frame: The tip's link in the file.
        offset: The tip in that frame.
        place: Of its root: in the world, on a base that is fixed; in the base, on one that floats.
    """

    model: Any
    prefix: str
    frame: str
    offset: Any
    place: Any

    @classmethod
    def of(
        cls,
        robot: str,
        frame: str,
        *,
        prefix: str = "",
        offset: tuple[Any, Any] = (np.eye(3), np.zeros(3)),
        place: Any = (0, 0, 0),
    ) -> Arm:
        at = pinocchio.SE3(np.eye(3), np.asarray(place, dtype=float))
        return cls(_model(robot), prefix, frame, pinocchio.SE3(*(np.asarray(part) for part in offset)), at)

    def columns(self, names: tuple[str, ...]) -> list[tuple[int, Any]]:
        """Of a plan's joints those that are the arm's, and Pinocchio's joints."""
        mine = [(i, name.removeprefix(self.prefix)) for i, name in enumerate(names) if name.startswith(self.prefix)]
        return [(i, self.model.joints[self.model.getJointId(name)]) for i, name in mine]

    def configuration(self, columns: list[tuple[int, Any]], base: Any, joints: Array) -> Array:
        result = pinocchio.neutral(self.model)
        result[:7] = pinocchio.SE3ToXYZQUAT(base)
        for i, joint in columns:
            result[joint.idx_q : joint.idx_q + joint.nq] = _turn(joint, joints[i])
        return np.asarray(result)

    def tips(self, plan: Plan, times: Array, bases: list[Any] | None = None) -> tuple[Array, Array]:
        """Positions (M, 3) and rotations (M, 3, 3) in the world."""
        data, columns = self.model.createData(), self.columns(plan.names)
        frame = self.model.getFrameId(self.frame)
        positions, turns = [], []
        for k, joints in enumerate(plan.at(times)["joints"]):
            base = self.place if bases is None else bases[k]
            pinocchio.framesForwardKinematics(self.model, data, self.configuration(columns, base, joints))
            tip = data.oMf[frame] * self.offset
            positions.append(tip.translation.copy())
            turns.append(tip.rotation.copy())
        return np.array(positions), np.array(turns)

    def drift(self, plan: Plan, times: Array) -> list[Any]:
        """Where a floating base goes, from rest, by conservation of momentum; SE3 at each of the times.

        Base and joints are integrated together, from the joint rates alone, between the kinks of the rates.
        """
        data, columns = self.model.createData(), self.columns(plan.names)
        velocities = [joint.idx_v for _, joint in columns]
        order = [i for i, _ in columns]

        def rate(t: float, state: Array) -> Array:
            place, turn, joints = state[:3], Rotation.from_quat(state[3:7]), state[7:]
            q = self.configuration(columns, pinocchio.SE3(turn.as_matrix(), place), joints)
            matrix = pinocchio.computeCentroidalMap(self.model, data, q)
            rates = plan.at(min(t, plan.horizon))["rates"]
            own = np.linalg.solve(matrix[:, :6], -matrix[:, velocities] @ rates[order])
            x, w, spin = state[3:6], state[6], own[3:]
            turning = [*(w * spin + np.cross(x, spin)) / 2, -x @ spin / 2]
            return np.concatenate([turn.apply(own[:3]), turning, rates])

        first = plan.at(0.0)
        base = first["base"]
        state = np.concatenate([base[:3], np.roll(base[3:], -1), first["joints"]])
        kinks = plan.horizon * plan.solution.state_interpolant.breaks
        results: list[Any] = []
        for begin, end in pairwise(kinks):
            last = end == kinks[-1]
            inside = times[(times >= begin) & ((times < end) | last)]
            motion = solve_ivp(rate, (begin, end), state, "DOP853", np.union1d(inside, end), rtol=1e-10, atol=1e-12)
            results += [_base(at) for at in motion.y.T[: len(inside)]]
            state = motion.y[:, -1]
        return results


class Deviation(NamedTuple):
    """How far a tip is from what it is asked at most: m, and rad where turning is asked."""

    position: float
    axis: float
    orientation: float


def deviation_of(
    plan: Plan,
    arm: Arm,
    path: SmoothPath,
    distance: Callable[[Array], Array],
    *,
    times: Array,
    direction: Any = None,
    tool_axis: Any = (0.0, 0.0, 1.0),
) -> Deviation:
    """Between the samples, of a path run along by a distance over time; `direction` in the world, or the path's own."""
    bases = arm.drift(plan, times) if plan.machine.base_size else None
    position, turn = arm.tips(plan, times, bases)
    s = np.clip(distance(times), 0.0, path.length)
    wanted = Rotation.from_quat(np.roll(path.turn(s).quaternion, -1, axis=1))
    goal = wanted.apply(tool_axis) if direction is None else np.asarray(direction) / np.linalg.norm(direction)
    axis = np.einsum("mij,j->mi", turn, np.asarray(tool_axis, dtype=float))
    goal = np.broadcast_to(goal, axis.shape)
    angle = np.arctan2(np.linalg.norm(np.cross(axis, goal), axis=1), np.einsum("mi,mi->m", axis, goal))
    turned = (wanted.inv() * Rotation.from_matrix(turn)).magnitude()
    off = np.linalg.norm(position - path.at(s).position, axis=1)
    return Deviation(float(off.max()), float(angle.max()), float(turned.max()))


@cache
def _model(robot: str) -> Any:
    text = urdf_file(*ROBOTS[robot][:2]).read_text(encoding="utf-8")
    if "<limit" not in text:  # without limits Pinocchio takes no revolute joint: such joints are continuous to it
        text = text.replace('"revolute"', '"continuous"')
    return pinocchio.buildModelFromXML(text, pinocchio.JointModelFreeFlyer())


def _turn(joint: Any, value: float) -> list[float]:
    return [value] if joint.nq == 1 else [float(np.cos(value)), float(np.sin(value))]


def _base(state: Array) -> Any:
    return pinocchio.SE3(Rotation.from_quat(state[3:7]).as_matrix(), state[:3])
