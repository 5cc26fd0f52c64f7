"""The standing machine of Yoo et al. 2004 by local laws and by optimal control: what its script draws and tabulates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from scripts.papers.run import Row, progress
from scripts.papers.standing.cases import Local, layer_rows, local_motions, stabiliser_rows
from scripts.papers.standing.checks import check
from scripts.papers.standing.plans import PLANS, Held, Plan, convergence_rows, held_plans, make


@dataclass(frozen=True)
class Results:
    """Everything that is drawn, tabled and summarised.

    Attributes:
        local, plans: By task and summary key.
        held: The same plans with accelerations held, as the reference has them.
        checks: A row for each plan, between its nodes.
        layers, stabiliser, convergence: Rows of the tables.
    """

    local: Mapping[str, Mapping[str, Local]]
    plans: Mapping[str, Mapping[str, Plan]]
    held: Mapping[str, Mapping[str, Held]]
    checks: list[Row]
    layers: list[Row]
    stabiliser: list[Row]
    convergence: list[Row]


def compute() -> Results:
    """Simulate and solve everything."""
    requests = [(task, key) for task, group in PLANS.items() for key in group]
    plans: dict[str, dict[str, Plan]] = {task: {} for task in PLANS}
    for task, key in progress(requests, "plans"):
        plans[task][key] = make(PLANS[task][key])
    held = held_plans(plans)
    return Results(
        local=local_motions(),
        plans=plans,
        held=held,
        checks=[check(key, plan) for group in plans.values() for key, plan in group.items()],
        layers=layer_rows(),
        stabiliser=stabiliser_rows(),
        convergence=convergence_rows(plans, held),
    )
