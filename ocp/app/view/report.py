"""One HTML file to show a colleague: the verdict in a sentence, pictures, curves with limits, every row with its unit.

Nothing in it is asked from another host.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from models import Machine
from ocp.app.check.interpolation import Motion
from ocp.app.check.joint_limits import Row, RowVerdict, audit_rows
from ocp.app.check.plan_verdict import verdict_of
from ocp.app.check.verdict import Check, bounds_of
from ocp.app.view.pictures import Obstacle, draw_curves, draw_scene, obstacles_of, times_by_part
from ocp.motion.plan import Plan
from ocp.motion.tasks.limits import JointBounds

__all__ = ["Report", "report_of_check", "report_of_plan"]

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""Of the page: no script runs, and nothing is asked from anywhere."""
STYLE = """
:root { color-scheme: light dark; --ink: #1b1f24; --paper: #fff; --soft: #f3f5f7; --line: #d5dae0;
  --good: #00734f; --bad: #b23b00 }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e9ed; --paper: #15181c; --soft: #20252b; --line: #3a424b;
  --good: #4cc79b; --bad: #ff9a62 } }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 60rem;
  margin: 0 auto; padding: 1rem 1.2rem 3rem }
h1 { font-size: 1.5rem; margin: 1rem 0 .3rem } h2 { font-size: 1.1rem; margin: 2rem 0 .5rem }
.verdict { font-size: 1.1rem; padding: .7rem 1rem; border-left: .4rem solid; background: var(--soft) }
.good { color: var(--good) } .bad { color: var(--bad) }
.facts { display: flex; flex-wrap: wrap; gap: .4rem 2rem; padding: 0; list-style: none }
figure { margin: 0; background: #fff; border: 1px solid var(--line); padding: .3rem }
figure img, figure svg { width: 100%;
  height: auto; display: block }
figcaption { font-size: .85rem; color: #444; padding: .2rem .4rem }
.scroll { overflow-x: auto } table { border-collapse: collapse; font-size: .85rem; width: 100% }
th, td { text-align: left; padding: .25rem .6rem; border-bottom: 1px solid var(--line); vertical-align: top }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap }
footer { margin-top: 3rem; font-size: .8rem; opacity: .7 }
"""


@dataclass(frozen=True)
class Report:
    """What a report says.

    Attributes:
        title, verdict: In words. passed: Whether it is good.
        facts: Short ones. faults: In words.
        picture: A PNG, or b"". plots: An SVG.
        tables: Titles, and rows.
        notes: Below.
    """

    title: str
    verdict: str
    passed: bool
    facts: tuple[str, ...]
    faults: tuple[str, ...]
    picture: bytes
    plots: str
    tables: tuple[tuple[str, tuple[Row, ...]], ...]
    notes: tuple[str, ...]

    def html(self) -> str:
        """The whole file."""
        mood = "good" if self.passed else "bad"
        parts = [
            f'<p class="verdict {mood}">{escape(self.verdict)}</p>',
            '<ul class="facts">' + "".join(f"<li>{escape(fact)}</li>" for fact in self.facts) + "</ul>",
        ]
        if self.faults:
            listed = "".join(f"<li>{escape(fault)}</li>" for fault in self.faults)
            parts.append(f'<h2>Faults</h2><ol class="bad">{listed}</ol>')
        if self.picture:
            data = base64.b64encode(self.picture).decode()
            parts.append(
                "<h2>The motion</h2><figure>"
                f'<img alt="the robot at several times" src="data:image/png;base64,{data}">'
                "<figcaption>The robot at four times, at the last one solid; the way of its tip in green, obstacles in "
                "grey.</figcaption></figure>"
            )
        parts.append(
            f"<h2>The joints</h2><figure>{self.plots}<figcaption>Blue: the motion, between its samples as a controller "
            "makes it. Grey: limits, dashed or, far off, in words. Purple: where they are passed.</figcaption></figure>"
        )
        parts += [f"<h2>{escape(title)}</h2>{_table(rows)}" for title, rows in self.tables]
        if self.notes:
            parts.append("<h2>Notes</h2><ul>" + "".join(f"<li>{escape(note)}</li>" for note in self.notes) + "</ul>")
        body = "\n".join(parts)
        return (
            '<!doctype html>\n<html lang="en"><head><meta name="generator" content="selfmotion">'
            '<meta charset="utf-8">'
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{escape(self.title)}</title><style>{STYLE}</style></head><body>\n"
            f"<h1>{escape(self.title)}</h1>\n{body}\n"
            "<footer>Made by selfmotion. SI units, radians.</footer></body></html>\n"
        )


def _table(rows: Sequence[Row]) -> str:
    head = "<tr><th>looked at</th><th class=n>worst</th><th class=n>limit</th><th>unit</th><th class=n>at, s</th>"
    lines = [
        f"<tr><td>{escape(row.name)}</td><td class=n>{row.value:.5g}</td>"
        f"<td class=n>{'' if row.limit is None else f'{row.limit:.4g}'}</td><td>{escape(row.unit)}</td>"
        f"<td class=n>{'' if row.time is None else f'{row.time:.5g}'}</td>"
        f'<td class="{"bad" if row.verdict is RowVerdict.FAILED else ""}">{escape(row.verdict)}</td>'
        f"<td>{escape(row.note)}</td></tr>"
        for row in rows
    ]
    return f"<div class=scroll><table>{head}<th></th><th></th></tr>{''.join(lines)}</table></div>"


def report_of_check(
    check: Check, machine: Machine, bounds: JointBounds, around: Sequence[Obstacle] = (), folders: Sequence[Any] = ()
) -> Report:
    """Of a check. The limits are those that it held the motion against."""
    motion, robot = check.cleaned.motion, machine.robot
    whole = len(check.joints) == robot.dof
    bases = check.cleaned.base if machine.base_size else None
    if machine.base_size and bases is None:
        bases = np.repeat(machine.base_home()[None], len(motion.t), axis=0)
    columns = check.cleaned.joints
    taken = JointBounds(*(one[columns] for one in bounds))
    units = [robot.joint(name).unit for name in check.joints]
    picture = draw_scene(machine, motion, bases, around, folders) if whole else b""
    shown = [row for row in check.rows if row.verdict is not RowVerdict.UNLIMITED]
    return Report(
        f"{check.file} for {robot.name}",
        f"The trajectory {check.sentence}.",
        check.passed,
        (f"{check.samples} samples", f"{check.duration:.5g} s", f"{len(check.joints)} joints", f"{check.rule} between"),
        tuple(str(fault) for fault in check.faults),
        picture,
        draw_curves(motion, check.joints, units, taken, check.faults),
        (("What was looked at", tuple(shown)),),
        (
            *(f"unlimited: {one}" for one in check.unlimited),
            *(f"not looked at: {one}" for one in check.unchecked),
            *check.notes,
        ),
    )


def report_of_plan(plan: Plan, period: float, title: str) -> Report:
    """Of a plan: its audit, and its samples held against the robot's limits."""
    machine, robot = plan.machine, plan.machine.robot
    sample = plan.sample(period)
    motion = Motion(sample.t, sample.joints, sample.rates, sample.accelerations)
    verdict = verdict_of(plan, sample, title)
    audit, check = verdict.audit, verdict.check
    bounds = bounds_of(robot)
    bases = plan.at(sample.t)["base"] if machine.base_size else None
    units = [joint.unit for joint in robot.moving_joints]
    cost = f"cost {plan.cost:.5g}" + ("" if plan.bound is None else f", none below {plan.bound:.5g}")
    told = [row for row in check.rows if row.verdict is not RowVerdict.UNLIMITED]
    return Report(
        title,
        f"The plan {verdict.sentence}.",
        verdict.passed,
        (robot.name, f"{plan.horizon:.5g} s", f"{robot.dof} joints", cost, f"{len(plan.candidates)} motions found"),
        tuple(str(fault) for fault in check.faults),
        draw_scene(machine, motion, bases, obstacles_of(plan.solution, times_by_part(plan, sample.t))),
        draw_curves(motion, plan.names, units, bounds, check.faults),
        (("The audit", tuple(audit_rows(audit))), (f"Samples of {period:g} s against the robot's limits", tuple(told))),
        tuple(f"unlimited: {one}" for one in check.unlimited),
    )
