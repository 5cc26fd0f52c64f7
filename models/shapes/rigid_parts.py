"""The rigid parts of a robot, the joints between them, and how far points that they carry are from a joint's axis."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from models.arrays import Array
from models.robot.parts import Joint
from models.robot.robot import Robot
from models.shapes.shapes import Shape


class Step(NamedTuple):
    """A moving joint between two rigid parts: its frame in the part above, whose child link is the part below."""

    joint: Joint
    turn: Array
    shift: Array
    above: str


@dataclass(frozen=True)
class RigidParts:
    """Links with no moving joint between them, each part named by its link nearest to the root.

    Attributes:
        of_link: The part of each link.
        place: Rotation and translation of each link in the frame of its part.
        step: The joint above each part but the root's.
    """

    of_link: dict[str, str]
    place: dict[str, tuple[Array, Array]]
    step: dict[str, Step]

    @classmethod
    def of(cls, robot: Robot) -> RigidParts:
        parts = cls({robot.root: robot.root}, {robot.root: (np.eye(3), np.zeros(3))}, {})
        for joint in robot.joints:
            turn, shift = parts.place[joint.parent]
            turn, shift = turn @ joint.rotation, shift + turn @ joint.translation
            if joint.moves:
                parts.of_link[joint.child], parts.place[joint.child] = joint.child, (np.eye(3), np.zeros(3))
                parts.step[joint.child] = Step(joint, turn, shift, parts.of_link[joint.parent])
            else:
                parts.of_link[joint.child] = parts.of_link[joint.parent]
                parts.place[joint.child] = turn, shift
        return parts

    def path(self, one: str, other: str) -> tuple[list[Step], list[Step]]:
        """Joints from one part up to where it meets the other's way, and from there down to the other."""
        up, down = self._above(one), self._above(other)
        while up and down and up[-1] is down[-1]:
            up, down = up[:-1], down[:-1]
        return up, down[::-1]

    def meeting(self, one: str, other: str) -> str:
        """The last part that carries both."""
        up = self.path(one, other)[0]
        return up[-1].above if up else one

    def _above(self, part: str) -> list[Step]:
        """Joints from a part up to the root."""
        found = []
        while part in self.step:
            found.append(self.step[part])
            part = found[-1].above
        return found

    def close(self, bodied: set[str]) -> set[frozenset[str]]:
        """Parts with bodies that a joint connects, or a chain of joints with no body in between."""
        next_to: dict[str, set[str]] = defaultdict(set)
        for part, step in self.step.items():
            next_to[part].add(step.above)
            next_to[step.above].add(part)
        found = set()
        for start in bodied:
            seen, waiting = {start}, list(next_to[start])
            while waiting:
                part = waiting.pop()
                if part in seen:
                    continue
                seen.add(part)
                if part in bodied:
                    found.add(frozenset((start, part)))
                else:
                    waiting += next_to[part]
        return found


def arms(
    robot: Robot, chain: Sequence[tuple[Step, bool]], end: Shape, low: Array, high: Array
) -> tuple[list[float], float]:
    """How far points of a body at the end of a chain are from each joint's axis at most, and from where it begins.

    Args:
        chain: Joints that are passed down (True) or up the tree, one after the other.
        end: The body, in the frame of the last rigid part.
        low, high: Limits of the joint vector. Shape (dof,).

    Returns:
        The arms, m; and the largest distance of the points from the origin of the first part, where the chain goes
        down, m; inf beyond a slide without limits.
    """
    found, beyond = [], 0.0  # beyond: how far those points are from the next joint's origin
    for k in range(len(chain) - 1, -1, -1):
        step, down = chain[k]
        # In the rigid part behind the joint, as seen along the chain: a point and the direction of its axis.
        origin = np.zeros(3) if down else step.shift
        axis = np.asarray(step.joint.axis) if down else step.turn @ step.joint.axis
        if k == len(chain) - 1:
            along = (end.core - origin) @ axis
            squares = ((end.core - origin) ** 2).sum(axis=1)
            found.append(float(np.sqrt(np.maximum(squares - along**2, 0)).max()) + end.swelling)
            reach = float(np.sqrt(squares).max()) + end.swelling
        else:
            following, going_down = chain[k + 1]
            hop = (following.shift if going_down else np.zeros(3)) - origin
            found.append(float(np.linalg.norm(hop - (hop @ axis) * axis)) + beyond)
            reach = float(np.linalg.norm(hop)) + beyond
        if step.joint.kind == "prismatic":
            column, ratio, offset = robot.drives[step.joint.name]
            ends = ratio * np.array([low[column], high[column]]) + offset
            reach += float(np.abs(ends).max())
        beyond = reach
    if not chain:
        return [], end.reach(np.zeros(3))
    step, down = chain[0]
    return found[::-1], beyond + (float(np.linalg.norm(step.shift)) if down else 0.0)
