"""How fast the costate right-hand side of a spatial base with n joints is: compiled, by CasADi, and by other means."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import FreeFloating, Joint, Link, Robot
from ocp import Limits, TipTask, minimum_velocity_problem
from ocp.indirect.hamiltonian import Hamiltonian
from ocp.problem.formulation import Formulation
from scripts import drawing
from scripts.papers.free_floating.costates import costate_rate
from scripts.papers.free_floating.virtual_chain import VirtualChain
from scripts.papers.run import progress, text_table
from scripts.timing.measure import compiled, median

JOINTS = (3, 7, 14, 28)
ROWS = [3, 4, 5]
SEED = 7
STEP = 1e-6  # of the finite differences


def run(repeats: int = 5) -> dict[str, Any]:
    """Microseconds a call by four ways, for every number of joints."""
    rng = np.random.default_rng(SEED)
    rows = [times(n, rng, repeats) for n in progress(JOINTS, "costates")]
    at_7 = next(row for row in rows if row["joints"] == 7)
    return {"rows": rows, "recursion_over_compiled_at_7": at_7["recursion_over_compiled"]}


def times(joints: int, rng: np.random.Generator, repeats: int) -> dict[str, Any]:
    """One row."""
    machine = serial_arm(joints)
    rate, value = costate_function(machine, ROWS)
    x = np.concatenate([machine.base_home(), rng.uniform(0.2, 0.8, joints)])
    lam = rng.normal(size=len(x))
    vm = microseconds(rate, np.tile(x, (200, 1)), lam, repeats) / 200
    with compiled(rate, ("-O2",)) as called:
        native = 1e6 * called([np.tile(x, (2000, 1)), lam], 1, repeats)[1]
    points = np.vstack([x + s * e for e in np.eye(len(x)) * STEP for s in (1.0, -1.0)])
    finite = microseconds(value, points, lam, repeats)
    chain = VirtualChain.from_machine(machine)
    place = np.concatenate([np.zeros(6), x[7:]])
    own = rng.normal(size=len(place))
    call = partial(costate_rate, chain, place, own, np.full(3, 0.05), ROWS)
    recursion = 1e6 * median(call, max(3, repeats))
    return {
        "joints": joints,
        "casadi_vm_us": vm,
        "compiled_us": native,
        "recursion_numpy_us": recursion,
        "finite_differences_us": finite,
        "recursion_over_compiled": recursion / native,
        "finite_differences_over_vm": finite / vm,
        "instructions": rate.n_instructions(),
    }


def microseconds(function: Any, states: np.ndarray, costate: np.ndarray, repeats: int) -> float:
    """Median time of a map over states, shape (M, n), which leaves out the cost of Python, microseconds."""
    many = function.map(len(states), "serial")
    inputs = [ca.DM(states.T), ca.DM(np.tile(costate[:, None], (1, len(states))))]
    many.call(inputs)
    return 1e6 * median(lambda: many.call(inputs), repeats)


def serial_arm(joints: int) -> FreeFloating:
    """A satellite with an arm of ``joints`` revolute joints about alternate axes."""
    links = [Link("satellite", 100.0, (0.0, 0.0, 0.0), np.diag([60.0, 60.0, 66.0]))]
    results = []
    for i in range(joints):
        links.append(Link(f"link {i}", 4.0, (0.2, 0.0, 0.02), np.diag([0.02, 0.06, 0.06])))
        axis = [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)][i % 3]
        shift = (1.0, 0.2, 0.1) if i == 0 else (0.4, 0.0, 0.05)
        results.append(Joint(f"joint {i}", "revolute", links[i].name, links[i + 1].name, shift, axis=axis))
    return FreeFloating(Robot(tuple(links), tuple(results), tip_translation=(0.4, 0.0, 0.0)), base="spatial")


def costate_function(machine: FreeFloating, rows: list[int]) -> tuple[Any, Any]:
    """Functions (state, costate) -> costate rate and -> H of the redundancy problem, the control eliminated."""
    start = np.linspace(0.3, 0.6, machine.joint_size)
    velocity = np.full(len(rows), 0.05)
    problem = minimum_velocity_problem(
        machine, TipTask(rows=rows, velocity=velocity), 0.1, start=start, limits=Limits(velocity=np.inf, joints=False)
    )
    ham = Hamiltonian.of(Formulation(problem))
    x, lam = ca.SX.sym("x", ham.sizes[0]), ca.SX.sym("lam", ham.sizes[0])
    rest = [0, 1, [], [], np.zeros(ham.sizes[-1])]
    rate = ham.flow()(x, lam, *rest)[1]
    value = ham.outputs()(x, lam, *rest)[2]
    return ca.Function("costate_rate", [x, lam], [rate]), ca.Function("hamiltonian", [x, lam], [value])


def report(summary: dict[str, Any]) -> str:
    """The times in words."""
    ratio = summary["recursion_over_compiled_at_7"]
    return f"{text_table(summary['rows'], 4)}\ncompiled costate rate, 7 joints: {ratio:.0f} x the recursion in numpy"


def plot(path: Path, summary: dict[str, Any]) -> None:
    """Time of one call over the number of joints, by each way."""
    rows = summary["rows"]
    n = [row["joints"] for row in rows]
    note = (
        "Costate right-hand side of problem (27), spatial base and n joints, three task rows. Recursion: Algorithms "
        "1-4 and (33)-(39) of the paper in numpy; the others: automatic differentiation, base attitude as a quaternion."
    )
    names = {
        "recursion_numpy_us": "the paper's recursion, numpy",
        "finite_differences_us": "finite differences of H",
        "casadi_vm_us": "CasADi virtual machine",
        "compiled_us": "compiled C",
    }
    gain = rows[-1]["recursion_numpy_us"] / rows[-1]["compiled_us"]
    title = f"Compiled, the costates' right-hand side is {gain:,.0f} times as fast as the recursion in numpy"
    with drawing.sheet(path, (1, 1), (6.6, 3.8), note, title=title) as (_, axes):
        axis = axes[0, 0]
        for marker, color, (key, label) in zip("osD^", ("orange", "yellow", "sky", "blue"), names.items(), strict=True):
            axis.loglog(n, [row[key] for row in rows], f"{marker}-", color=drawing.COLORS[color], label=label)
        axis.set(xlabel="joints", ylabel="time of one call, µs", xticks=n, xticklabels=[str(k) for k in n])
        axis.minorticks_off()
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
