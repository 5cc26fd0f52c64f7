"""A free-floating arm as a serial chain on an inertial frame, in plain numpy (Kim, Kim 2011, section 2).

The base is carried by massless virtual links, one for each of its freedoms, the last of which is the satellite itself;
the chain is then what Featherstone's spatial vectors (1)-(6) describe. Frame 0 is inertial, frame i is fixed in link i,
frame E is the end effector. Nothing here is shared with the symbolic kinematics of the package, which this checks.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from models import FreeFloating, Joint, Link, ModelError, Robot
from models.checks import Array, ArrayInput, require
from models.machines.free_floating import PLANAR_ROWS


@dataclass(frozen=True, eq=False)
class VirtualChain:
    """Serial chain of N one-freedom joints, the first n of which are the virtual joints of the base.

    Its coordinates are x = (x1, x2): x1 the base, (x, y, angle) or (x, y, z, a, b, c) with the rotation
    Rx(a) Ry(b) Rz(c) (m, rad), then x2 the joints. Make it with `VirtualChain.from_machine`.

    Attributes:
        n: Number of virtual joints, 3 (planar) or 6 (spatial).
        S: Motion vectors of the joints in their own link frames, (1). Shape (N, 6).
        X_tree: Transform from frame i - 1 to frame i at zero joint position, (3). Shape (N, 6, 6).
        H: Spatial inertias of the links in their own frames, (5). Shape (N, 6, 6).
        X_tip: Transform from frame N to the end effector, EX_N. Shape (6, 6).

    Raises:
        ModelError: Wrong shapes, no joint, a number of virtual joints that is not 3 or 6.
    """

    n: int
    S: Array
    X_tree: Array
    H: Array
    X_tip: Array

    def __post_init__(self) -> None:
        if self.n not in (3, 6):
            raise ModelError(f"virtual chain: n = {self.n} virtual joints; a planar base has 3, a spatial one 6")
        count = len(self.S)
        if count <= self.n:
            raise ModelError(f"virtual chain: {count} joints, {self.n} of them virtual, leave none to the arm")
        shapes = {"S": (count, 6), "X_tree": (count, 6, 6), "H": (count, 6, 6), "X_tip": (6, 6)}
        for field in fields(self)[1:]:
            array = require.array(f"virtual chain: {field.name}", getattr(self, field.name), shapes[field.name])
            object.__setattr__(self, field.name, array)

    @classmethod
    def from_machine(cls, machine: FreeFloating) -> VirtualChain:
        """Chain of a free-floating machine whose arm is serial; links on fixed joints join the link that carries them.

        The joints keep the order of `machine.robot.joint_names`; a planar base keeps its coordinates (x, y, angle).

        Raises:
            ModelError: A branch with a joint of its own, a tip that the last joint does not carry, a momentum that is
                not zero.
        """
        if np.any(machine.conserved_momentum):
            raise ModelError(
                f"virtual chain: the machine carries the momentum {np.asarray(machine.conserved_momentum).tolist()}, "
                "but (24) and what follows from it hold for zero momentum only"
            )
        axes = [3, 4, 2] if machine.base == "planar" else [3, 4, 5, 0, 1, 2]
        base, joints, bodies, X_tip = _serial_bodies(machine.robot)
        massless = [np.zeros((6, 6))] * (len(axes) - 1)
        return cls(
            n=len(axes),
            S=np.array([np.eye(6)[axis] for axis in axes] + [motion_axis(joint) for joint, _ in joints]),
            X_tree=np.array([np.eye(6)] * len(axes) + [X for _, X in joints]),
            H=np.array([*massless, base, *bodies]),
            X_tip=X_tip,
        )

    @property
    def N(self) -> int:
        """Number of joints, the virtual ones included."""
        return len(self.S)

    @property
    def momentum_rows(self) -> list[int]:
        """Rows of a spatial momentum that the base can balance: (Lz, Px, Py) if planar, else all six."""
        return PLANAR_ROWS if self.n == 3 else list(range(6))


def transforms(chain: VirtualChain, q: ArrayInput) -> Array:
    """Coordinate transforms iX_{i-1} (3) from each frame to the next, i = 1..N; shape (N, 6, 6).

    Raises:
        ModelError: `q` is not of shape (N,) or not finite.
    """
    q = require.array("virtual chain: q", q, (chain.N,))
    return np.array([joint_transform(S, qi) @ X for S, qi, X in zip(chain.S, q, chain.X_tree, strict=True)])


def joint_transform(S: Array, q: float) -> Array:
    """Transform across a revolute or prismatic joint with motion vector S at position q; shape (6, 6).

    It satisfies dX/dq = -[S x] X.
    """
    angular, linear = S[:3], S[3:]
    if not angular.any():
        return motion_transform(np.eye(3), linear * q)
    along = np.outer(angular, angular)
    turned = along + np.cos(q) * (np.eye(3) - along) - np.sin(q) * skew(angular)  # transpose of Rodrigues' formula
    return motion_transform(turned, np.zeros(3))


def motion_transform(jRi: Array, r: Array) -> Array:
    """jX_i (3) for a frame j with origin at r in frame i; jRi takes coordinates from i to j. Shape (6, 6)."""
    return np.block([[jRi, np.zeros((3, 3))], [-jRi @ skew(r), jRi]])


def motion_cross(v: Array) -> Array:
    """[v x] (2) of a motion vector. Shape (6, 6)."""
    return np.block([[skew(v[:3]), np.zeros((3, 3))], [skew(v[3:]), skew(v[:3])]])


def spatial_inertia(link: Link) -> Array:
    """H (5) of a link in its own frame. Shape (6, 6)."""
    c = skew(link.center_of_mass)
    m = link.mass
    return np.block([[link.inertia + m * c @ c.T, m * c], [m * c.T, m * np.eye(3)]])


def skew(a: Array) -> Array:
    """Matrix [a x] with [a x] b = a x b. Shape (3, 3)."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def motion_axis(joint: Joint) -> Array:
    """S of a moving joint, (axis, 0) or, prismatic, (0, axis). Shape (6,)."""
    still = np.zeros(3)
    return np.concatenate([still, joint.axis] if joint.kind == "prismatic" else [joint.axis, still])


def _serial_bodies(robot: Robot) -> tuple[Array, list[tuple[Joint, Array]], list[Array], Array]:
    """Rigid bodies of a serial robot: H of the base; moving joints with X_tree; H of the links; EX_N."""
    bodies = [spatial_inertia(robot.link(robot.root))]
    joints: list[tuple[Joint, Array]] = []
    place = {robot.root: (0, np.eye(6))}  # of each link: its body, and the transform from the body's frame to its own
    for joint in robot.joints:
        body, X = place[joint.parent]
        X = motion_transform(joint.rotation.T, joint.translation) @ X
        if joint.mimic is not None:
            raise ModelError(f"joint {joint.name!r} follows joint {joint.mimic.joint!r}; the recursion knows none")
        if joint.moves:
            if body != len(joints):
                raise ModelError(
                    f"joint {joint.name!r} starts a branch at link {joint.parent!r}; the recursion is for serial arms: "
                    "fix or remove the joints of all branches but one"
                )
            joints.append((joint, X))
            bodies.append(spatial_inertia(robot.link(joint.child)))
            place[joint.child] = (len(joints), np.eye(6))
        else:
            bodies[body] = bodies[body] + X.T @ spatial_inertia(robot.link(joint.child)) @ X
            place[joint.child] = (body, X)
    body, X = place[robot.tip_link]
    if body != len(joints):
        raise ModelError(
            f"the tip is on link {robot.tip!r}, before the joint {joints[body][0].name!r}; the recursion is for a tip "
            "that the last joint carries"
        )
    X_tip = motion_transform(robot.tip_rotation.T, np.asarray(robot.tip_translation)) @ X
    return bodies[0], joints, bodies[1:], X_tip
