"""Write an HTML report with a verdict, pictures, curves with limits, and tables of all checked quantities.

The page loads nothing from another host.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from models import Machine
from models.checks import Array
from ocp.app.check.joint_limits import Motion, Row, RowVerdict, interpolate
from ocp.app.check.verdict import Check, audit_rows, verdict_of
from ocp.app.view.appearance import (
    PLAN,
    SCENE,
    TIP,
    Obstacle,
    appearance_of,
    frames_along,
    obstacles_of_plan,
    obstacles_of_shapes,
    part_of,
)
from ocp.app.view.rendering import PICTURE_STYLE, Camera, Floor, Layer, parts_in_world, render, tube
from ocp.motion.plan import Plan
from ocp.motion.tasks.goals import Scene
from ocp.motion.tasks.limits import JointBounds, Limits

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""Content security policy of a report, under which no script runs and nothing is loaded."""
SHOWN_ROWS = 8
"""Number of rows of a table that are shown at once, if not more are near their limits."""
NEAR_LIMIT = 0.9
"""Share of a limit from which a value counts as near it."""
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
figure { overflow-x: auto; margin: 0; border: 1px solid var(--line); padding: .3rem }
figure img, figure svg { width: 100%; height: auto; display: block; background: #fff } figure svg { min-width: 34rem }
@media (prefers-color-scheme: dark) { figure svg { filter: invert(.9) hue-rotate(180deg) }
  figure img { filter: brightness(.85) } }
figcaption { font-size: .85rem; padding: .2rem .4rem } summary { cursor: pointer; padding: .3rem 0 }
.scroll { overflow-x: auto } table { border-collapse: collapse; font-size: .85rem; width: 100% }
th, td { text-align: left; padding: .25rem .6rem; border-bottom: 1px solid var(--line); vertical-align: top }
td:last-child { min-width: 14rem }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap }
footer { margin-top: 3rem; font-size: .8rem; opacity: .7 }
"""


@dataclass(frozen=True)
class Report:
    """Contents of an HTML report on a trajectory or a plan.

    Attributes:
        title, verdict, passed: Title, verdict as text, and whether it is good.
        facts, faults, notes: Short facts, such as the duration, descriptions of the faults, and notes below the tables.
        picture, plots: Picture of the motion as a PNG, or b"", and curves of the joints as an SVG.
        tables: Title and rows of each table.
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
        """Return the HTML page of the report."""
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
                "<figcaption>The robot at four times, solid at the last one; its tip path in green, obstacles in "
                "grey.</figcaption></figure>"
            )
        parts.append(
            f"<h2>The joints</h2><figure>{self.plots}<figcaption>Blue: the motion, interpolated between its samples as "
            "by a controller. Grey: limits, dashed or, if far, as text. Purple: violations.</figcaption></figure>"
        )
        for heading, rows in self.tables:
            ordered = sorted(rows, key=lambda row: -row.urgency)
            count = max(SHOWN_ROWS, sum(row.urgency >= NEAR_LIMIT for row in rows))
            parts.append(f"<h2>{escape(heading)}</h2>{_table(ordered[:count])}")
            if len(ordered) > count:
                more = f"{len(ordered) - count} more values, all within {NEAR_LIMIT:.0%} of their limits"
                parts.append(f"<details><summary>{more}</summary>{_table(ordered[count:])}</details>")
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
    """Return rows of a check or an audit as an HTML table."""
    head = "<tr><th>quantity</th><th class=n>worst</th><th class=n>limit</th><th>unit</th><th class=n>at, s</th>"
    lines = [
        f"<tr><td>{escape(row.name)}</td><td class=n>{row.value:.5g}</td>"
        f"<td class=n>{'' if row.limit is None else f'{row.limit:.4g}'}</td><td>{escape(row.unit)}</td>"
        f"<td class=n>{'' if row.time is None else f'{row.time:.5g}'}</td>"
        f'<td class="{"bad" if row.verdict is RowVerdict.FAILED else ""}">{escape(row.verdict)}</td>'
        f"<td>{escape(row.note)}</td></tr>"
        for row in rows
    ]
    return f"<div class=scroll><table>{head}<th></th><th></th></tr>{''.join(lines)}</table></div>"


def report_of_check(check: Check, machine: Machine, limits: Limits, scene: Scene) -> Report:
    """Return the report of a trajectory check, with the limits and the scene that the check used."""
    motion, robot = check.cleaned.motion, machine.robot
    complete = len(check.joints) == robot.dof
    base_path = check.cleaned.base if machine.base_size else None
    if machine.base_size and base_path is None:
        base_path = np.repeat(machine.base_home()[None], len(motion.t), axis=0)
    columns = check.cleaned.joints
    bounds = JointBounds(*(item[columns] for item in limits.bounds(machine)))
    units = [robot.joint(name).unit for name in check.joints]
    obstacles = obstacles_of_shapes(scene.obstacles)
    picture = draw_scene(machine, motion, base_path, obstacles, folders=scene.folders) if complete else b""
    return Report(
        f"{check.file} for {robot.name}",
        f"The trajectory {check.sentence}.",
        check.passed,
        (f"{check.samples} samples", f"{check.duration:.5g} s", f"{len(check.joints)} joints", f"{check.rule} between"),
        tuple(str(fault) for fault in check.faults),
        picture,
        curves_of(motion, bounds, check, units),
        (("Checked quantities", check.limited_rows),),
        (
            *(f"unlimited: {item}" for item in check.unlimited),
            *(f"not checked: {item}" for item in check.unchecked),
            *check.notes,
        ),
    )


def report_of_plan(plan: Plan, period: float, title: str) -> Report:
    """Return the report of a plan: its audit, and a check of its samples against the robot's limits."""
    machine, robot = plan.machine, plan.machine.robot
    sample = plan.sample(period)
    motion = Motion(sample.t, sample.joints, sample.rates, sample.accelerations)
    verdict = verdict_of(plan, sample, title)
    audit, check = verdict.audit, verdict.check
    bounds = Limits().bounds(machine)
    base_path = plan.at(sample.t)["base"] if machine.base_size else None
    units = [joint.unit for joint in robot.moving_joints]
    cost = f"cost {plan.cost:.5g}" + ("" if plan.bound is None else f", none below {plan.bound:.5g}")
    count = [f"{len(plan.candidates)} candidates"] if len(plan.candidates) > 1 else []
    return Report(
        title,
        f"The plan {verdict.sentence}." + (f" It {verdict.margin}." if verdict.margin else ""),
        verdict.passed,
        (robot.name, f"{plan.horizon:.5g} s", f"{robot.dof} joints", cost, *count),
        tuple(str(fault) for fault in check.faults),
        draw_scene(machine, motion, base_path, obstacles_of_plan(plan, sample.t)),
        curves_of(motion, bounds, check, units),
        (
            ("The audit", tuple(audit_rows(audit))),
            (f"Samples every {period:g} s against the limits", check.limited_rows),
        ),
        tuple(f"unlimited: {one}" for one in check.unlimited),
    )


def curves_of(motion: Motion, bounds: JointBounds, check: Check, units: Sequence[str]) -> str:
    """Return an SVG with position, velocity and acceleration of every joint over time, with their limits and faults."""
    from ocp.app.view.plots import svg_of_joints  # with matplotlib, which no other part of the command needs

    return svg_of_joints(motion, bounds, names=check.joints, units=units, faults=check.faults)


def draw_scene(
    machine: Machine, motion: Motion, bases: Array | None, obstacles: Sequence[Obstacle], *, folders: Sequence[Any] = ()
) -> bytes:
    """Return a PNG picture of the robot at several times (solid at the last), of its tip path and of the obstacles.

    Moving obstacles are drawn at the final time; `obstacles` has them at uniform times of the motion.
    """
    from matplotlib.colors import to_rgb
    from matplotlib.image import imsave

    times = np.linspace(motion.t[0], motion.t[-1], PICTURE_STYLE.curve_points)
    base = None if bases is None else interpolate(times, motion.t, bases)
    frames = frames_along(machine, motion.position.at(times), base)
    appearance = appearance_of(machine.robot, folders)
    poses = [
        parts_in_world(appearance, frames, int(k))
        for k in np.linspace(0, PICTURE_STYLE.curve_points - 1, PICTURE_STYLE.poses)
    ]
    points = [part.vertices for parts in poses for part in parts]
    robot_points, static = np.vstack(points), []
    for obstacle in obstacles:
        corners, faces = obstacle.solid(robot_points)
        if obstacle.rotations is not None and obstacle.positions is not None:
            corners = corners @ obstacle.rotations[-1].T + obstacle.positions[-1]
        static.append(part_of("", corners, faces, (*to_rgb(SCENE), 1.0)))
        if obstacle.normal is None:
            points.append(corners)
    if machine.robot.tip is not None:
        points.append(frames.tip)
    all_points = np.vstack(points)
    low, high = all_points.min(axis=0), all_points.max(axis=0)
    size = float((high - low).max())
    if machine.robot.tip is not None:
        static.append(tube(frames.tip, PICTURE_STYLE.line * size, to_rgb(TIP)))
    transparent = [Layer(parts, 0.12 + 0.08 * k, to_rgb(PLAN)) for k, parts in enumerate(poses[:-1])]
    floor = None if machine.base_size else Floor(low[2], tuple((low + high)[:2] / 2), 1.1 * size, 0.1)
    layers = [Layer(poses[-1]), Layer(static), *transparent]
    stream = io.BytesIO()
    imsave(stream, render(layers, Camera.around(all_points, PICTURE_STYLE.size), floor=floor), format="png")
    return stream.getvalue()
