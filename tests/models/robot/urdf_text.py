"""Robots written as URDF text, with each inertia given in axes of its own."""

from __future__ import annotations

from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from models import Robot
from tests.models.robot.trees import Array


def numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def origin(position: Any, rotation: Any) -> str:
    angles = Rotation.from_matrix(np.array(rotation)).as_euler("xyz")  # about fixed axes
    return f'<origin xyz="{numbers(position)}" rpy="{numbers(angles)}"/>'


def urdf_of(robot: Robot, rng: np.random.Generator) -> str:
    """Links, then joints in a shuffled order; massless links without <inertial>."""
    lines = []
    for link in robot.links:
        body = ""
        if link.mass or link.inertia.any():
            turn: Array = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
            tensor = turn.T @ link.inertia @ turn
            names = zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), tensor[np.triu_indices(3)], strict=True)
            moments = " ".join(f'{name}="{float(value)!r}"' for name, value in names)
            body = f'{origin(link.center_of_mass, turn)}<mass value="{link.mass!r}"/><inertia {moments}/>'
            body = f"<inertial>{body}</inertial>"
        mesh = '<visual><geometry><mesh filename="package://nowhere/there_is_none.dae"/></geometry></visual>'
        lines.append(f"<link name={quoteattr(link.name)}>{body}{mesh}</link>")
    joints = []
    for joint in robot.joints:
        body = f"{origin(joint.translation, joint.rotation)}<parent link={quoteattr(joint.parent)}/>"
        body += f'<child link={quoteattr(joint.child)}/><axis xyz="{numbers(2 * joint.axis)}"/>'
        if joint.moves:
            # In the format there is no joint without a greatest effort and speed.
            limits = {key: min(getattr(joint, key), 1e9) for key in ("effort", "velocity")}
            if joint.kind != "continuous":
                limits |= {"lower": max(joint.lower, -1e9), "upper": min(joint.upper, 1e9)}
            body += "<limit " + " ".join(f'{key}="{float(value)!r}"' for key, value in limits.items()) + "/>"
        joints.append(f"<joint name={quoteattr(joint.name)} type={quoteattr(joint.kind)}>{body}</joint>")
    lines += [joints[i] for i in rng.permutation(len(joints))]
    return f"<robot name={quoteattr(robot.name)}>\n" + "\n".join(lines) + "\n</robot>\n"
