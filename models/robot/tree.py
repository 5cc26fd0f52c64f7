"""Order of a kinematic tree: which link is the root, which joint comes first; and the same tree from another root."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from difflib import get_close_matches

import numpy as np

from models.arrays import MAX_LISTED
from models.errors import ModelError
from models.robot.parts import Joint, Link


def absent(what: str, name: object, known: Iterable[str]) -> ModelError:
    """The error that says a name does not exist and which ones come near it."""
    names = list(known)
    folded = {each.casefold(): each for each in reversed(names)}
    near = [folded[each] for each in get_close_matches(str(name).casefold(), folded, n=3, cutoff=0.5)]
    hint = f"did you mean {' or '.join(repr(each) for each in near)}? " if near else ""
    listed = f"{names[:MAX_LISTED]} and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else f"{names}"
    message = f"{what} {name!r} does not exist; {hint}there are {listed if names else 'none'}"
    return ModelError(message, name=str(name) or what, value=name, limit=tuple(names))


def require_unique(names: Iterable[str], what: str) -> None:
    """Raise ModelError when a name occurs twice."""
    for name, count in Counter(names).items():
        if count > 1:
            message = f"{what} name {name!r} is used more than once; give every {what} its own name"
            raise ModelError(message, name=name, value=count, limit=1)


def find_root(links: Sequence[str], edges: Sequence[tuple[str, str, str]]) -> str:
    """Name of the only link that is no joint's child.

    Args:
        links: Names of the links, unique.
        edges: (joint, parent link, child link) of every joint.

    Raises:
        ModelError: Unknown link name, a link with two parents, no root (a loop), more than one root.
    """
    if not links:
        raise ModelError("a robot needs at least one link", name="link", value=0, limit=1)
    known = set(links)
    parent_joint: dict[str, str] = {}
    for joint, parent, child in edges:
        for role, link in (("parent", parent), ("child", child)):
            if link not in known:
                raise absent(f"joint {joint!r}: {role} link", link, links)
        if parent == child:
            raise ModelError(f"joint {joint!r} connects link {child!r} to itself: a loop", name=joint, value=child)
        if child in parent_joint:
            message = (
                f"link {child!r} is the child of joints {parent_joint[child]!r} and {joint!r}: "
                "a loop; a kinematic tree gives each link one parent"
            )
            raise ModelError(message, name=child, value=(parent_joint[child], joint), limit=1)
        parent_joint[child] = joint
    roots = [link for link in links if link not in parent_joint]
    if not roots:
        message = f"links {sorted(known)} form a loop: every link has a parent, so there is no root"
        raise ModelError(message, name="links", value=tuple(sorted(known)))
    if len(roots) > 1:
        message = f"links {roots} have no parent joint; a kinematic tree has one root: join or remove the others"
        raise ModelError(message, name="links", value=tuple(roots), limit=1)
    return roots[0]


def tree_order(root: str, edges: Sequence[tuple[str, str, str]]) -> list[int]:
    """Indices of the joints such that every parent link is reached before its children.

    The order of declaration is kept wherever it already is such an order.

    Raises:
        ModelError: Some links form a loop that the root does not reach.
    """
    below = defaultdict(list)
    for i, (_, parent, _) in enumerate(edges):
        below[parent].append(i)
    order: list[int] = []
    ready = below[root][::]
    while ready:
        first = min(ready)
        ready.remove(first)
        ready += below[edges[first][2]]
        order.append(first)
    if len(order) < len(edges):
        names = [edges[i][0] for i in sorted(set(range(len(edges))) - set(order))]
        message = f"joints {names} form a loop that is not connected to the root link {root!r}"
        raise ModelError(message, name="joints", value=tuple(names))
    return order


def reroot(
    links: Sequence[Link], joints: Sequence[Joint], old: str, new: str
) -> tuple[tuple[Link, ...], tuple[Joint, ...]]:
    """The tree of root `old` hung up at the link `new`.

    Joints between the two change direction. Every link keeps its frame, and every joint its name, limits and the sign
    of its position: a moving joint J now carries a massless link "J_frame" at the joint's frame, on which the former
    parent is fixed by a joint "J_fixed". (Where parent and joint frame coincide, J carries the parent itself.)

    Raises:
        ModelError: The new root is no link; a name that is needed is taken.
    """
    names = [link.name for link in links]
    if not isinstance(new, str) or new not in names:
        raise absent("root link", new, names)
    above = {joint.child: joint for joint in joints}
    turned: dict[str, list[Joint]] = {}
    frames: list[Link] = []
    while new != old:
        joint = above[new]
        turn, shift = joint.rotation, joint.translation
        back = {"rotation": turn.T, "translation": -turn.T @ shift}
        together = not shift.any() and np.array_equal(turn, np.eye(3))
        at_origin = {"rotation": np.eye(3), "translation": np.zeros(3), "axis": -joint.axis}
        if not joint.moves:
            turned[joint.name] = [replace(joint, parent=joint.child, child=joint.parent, **back)]
        elif together:
            turned[joint.name] = [replace(joint, parent=joint.child, child=joint.parent, **at_origin)]
        else:
            frame = Link(f"{joint.name}_frame")
            frames.append(frame)
            turned[joint.name] = [
                replace(joint, parent=joint.child, child=frame.name, **at_origin),
                Joint(f"{joint.name}_fixed", "fixed", frame.name, joint.parent, **back),
            ]
        new = joint.parent
    result = [each for joint in joints for each in turned.get(joint.name, [joint])]
    require_unique((*names, *(frame.name for frame in frames)), "link")
    require_unique((joint.name for joint in result), "joint")
    return (*links, *frames), tuple(result)
