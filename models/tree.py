"""Order of a kinematic tree: which link is the root, which joint comes first."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from models.errors import ModelError


def require_unique(names: Iterable[str], what: str) -> None:
    """Raise ModelError when a name occurs twice."""
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise ModelError(f"{what} name {repeated[0]!r} is used more than once; give every {what} its own name")


def find_root(links: Sequence[str], edges: Sequence[tuple[str, str, str]]) -> str:
    """Name of the only link that is no joint's child.

    Args:
        links: Names of the links, unique.
        edges: (joint, parent link, child link) of every joint.

    Raises:
        ModelError: Unknown link name, a link with two parents, no root (a loop), more than one root.
    """
    if not links:
        raise ModelError("a robot needs at least one link")
    known = set(links)
    parent_joint: dict[str, str] = {}
    for joint, parent, child in edges:
        for role, link in (("parent", parent), ("child", child)):
            if link not in known:
                raise ModelError(f"joint {joint!r}: {role} link {link!r} does not exist; the links are {sorted(known)}")
        if parent == child:
            raise ModelError(f"joint {joint!r} connects link {child!r} to itself: a loop")
        if child in parent_joint:
            raise ModelError(
                f"link {child!r} is the child of joints {parent_joint[child]!r} and {joint!r}: "
                "a loop; a kinematic tree gives each link one parent"
            )
        parent_joint[child] = joint
    roots = [link for link in links if link not in parent_joint]
    if not roots:
        raise ModelError(f"links {sorted(known)} form a loop: every link has a parent, so there is no root")
    if len(roots) > 1:
        raise ModelError(
            f"links {roots} have no parent joint; a kinematic tree has one root: join or remove the others"
        )
    return roots[0]


def tree_order(root: str, edges: Sequence[tuple[str, str, str]]) -> list[int]:
    """Indices of the joints such that every parent link is reached before its children.

    The order of declaration is kept wherever it already is such an order.

    Raises:
        ModelError: Some links form a loop that the root does not reach.
    """
    reached, order, waiting = {root}, [], list(range(len(edges)))
    while waiting:
        ready = next((i for i in waiting if edges[i][1] in reached), None)
        if ready is None:
            names = [edges[i][0] for i in waiting]
            raise ModelError(f"joints {names} form a loop that is not connected to the root link {root!r}")
        waiting.remove(ready)
        reached.add(edges[ready][2])
        order.append(ready)
    return order
