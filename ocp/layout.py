"""Where the variables of one phase stand in the vector of a nonlinear program."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Layout", "plain_layout", "staged_layout"]


@dataclass(frozen=True)
class Layout:
    """Indices of the variables of one phase with N intervals.

    Nodes stand between intervals. In the plain layout the end of interval k *is* node k + 1 and the horizon is one
    variable. In the staged layout (for structure-exploiting solvers) each stage owns its copies of the end of its
    interval, of the horizon and of the start, and linear rows tie them to the next node.

    Attributes:
        size: Number of variables.
        node: Variables of each node. Shape (n, N + 1).
        node_end: Variables at the end of each interval. Shape (n, N).
        interval: Variables inside each interval. Shape (m, N).
        horizon: The horizon as each node sees it, or None where it is fixed. Shape (N + 1,).
        initial: Node variables at the start as the first and the last node see them. Shape (n, 2).
        joins: (next node, its source in the stage before), each of shape (carried, N); None in the plain layout.
        stage_controls: Number of variables of a stage that are not its node. 0 in the plain layout.
    """

    size: int
    node: np.ndarray
    node_end: np.ndarray
    interval: np.ndarray
    horizon: np.ndarray | None
    initial: np.ndarray
    joins: tuple[np.ndarray, np.ndarray] | None = None
    stage_controls: int = 0


def plain_layout(intervals: int, node_size: int, interval_size: int, free_horizon: bool) -> Layout:
    """Node 0, interval 0, node 1, ..., node N, horizon."""
    stride = node_size + interval_size
    grid = np.arange(intervals * stride).reshape(intervals, stride).T
    node = np.column_stack([grid[:node_size], intervals * stride + np.arange(node_size)])
    size = intervals * stride + node_size
    horizon = np.full(intervals + 1, size) if free_horizon else None
    initial = np.column_stack([node[:, 0], node[:, 0]])
    return Layout(size + free_horizon, node, node[:, 1:], grid[node_size:], horizon, initial)


def staged_layout(intervals: int, node_size: int, interval_size: int, free_horizon: bool, keep_initial: bool) -> Layout:
    """Stage k: node k with its copies of horizon and start, then interval k with the copy of its end."""
    carried = node_size + free_horizon + node_size * keep_initial
    inputs = interval_size + node_size
    stride = carried + inputs
    grid = np.arange(intervals * stride).reshape(intervals, stride).T
    full = np.column_stack([grid[:carried], intervals * stride + np.arange(carried)])
    node_end = grid[carried + interval_size :]
    own = full[node_size + free_horizon :] if keep_initial else full[:node_size]
    return Layout(
        intervals * stride + carried,
        full[:node_size],
        node_end,
        grid[carried : carried + interval_size],
        full[node_size] if free_horizon else None,
        own[:, [0, -1]],
        (full[:, 1:], np.vstack([node_end, full[node_size:, :-1]])),
        inputs,
    )
