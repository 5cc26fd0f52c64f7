"""Write an HTML report with a verdict, pictures, curves with limits, and tables of all checked quantities.

The page loads nothing from another host.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, NamedTuple

import numpy as np

from models import Machine
from models.checks import Array
from ocp.app.check.joint_limits import Motion, Row, RowVerdict, interpolate
from ocp.app.check.verdict import Check, audit_rows, verdict_of
from ocp.app.view.appearance import (
    FAULT,
    LIMIT,
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
from ocp.app.view.rendering import PICTURE_STYLE, Camera, Floor, Layer, encode_png, parts_in_world, render, tube
from ocp.motion.plan import Plan
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.motion.tasks.goals import Cost, Scene
from ocp.motion.tasks.limits import JointBounds, Limits

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""Content security policy of a report, under which no script runs and nothing is loaded."""
SHOWN_ROWS = 8
"""Number of rows of a table that are shown at once, if not more are near their limits."""
NEAR_LIMIT = 0.9
"""Share of a limit from which a value counts as near it."""
KINDS = {"position": "", "velocity": "/s", "acceleration": "/s²"}
"""Quantities of a joint that are drawn over time, and the suffix that turns rad or m into the unit of the quantity."""
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
.curves text { font: 9.5px system-ui, sans-serif; text-anchor: end } .curves path { fill: none; stroke: #000 }
.curves .middle { text-anchor: middle } .curves .title { font-size: 11px } .curves .limit { font-size: 8px }
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
        draw_curves(motion, bounds, names=check.joints, units=units, faults=check.faults),
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
    base_path = plan.at(sample.t)["base"] if machine.base_size else None
    units = [joint.unit for joint in robot.moving_joints]
    cost = f"cost {plan.cost:.5g}" + ("" if plan.bound is None else f", none below {plan.bound:.5g}")
    request = plan.request if isinstance(plan, SolvedPlan) else None
    if request is not None and isinstance(request.cost, Cost):
        cost += f", of {' and '.join(request.cost.terms)}"
    count = [f"{len(plan.candidates)} candidates"] if len(plan.candidates) > 1 else []
    heading = f"Samples every {period:g} s against the limits"
    return Report(
        title,
        f"The plan {verdict.sentence}." + (f" It {verdict.margin}." if verdict.margin else ""),
        verdict.passed,
        (robot.name, f"{plan.horizon:.5g} s", f"{robot.dof} joints", cost, *count),
        tuple(str(fault) for fault in check.faults),
        draw_scene(machine, motion, base_path, obstacles_of_plan(plan, sample.t)),
        draw_curves(motion, plan.joint_bounds, names=check.joints, units=units, faults=check.faults),
        (("The audit", tuple(audit_rows(audit))), (heading, check.limited_rows)),
        tuple(f"unlimited: {quantity}" for quantity in check.unlimited),
    )


class LimitView(NamedTuple):
    """Range of the vertical axis of a diagram, limits drawn as lines, and a text about limits outside of the range."""

    low: float
    high: float
    lines: tuple[float, ...]
    text: str
    text_below: bool


def limits_in_view(low: float, high: float, lower: float, upper: float, *, min_range: float) -> LimitView:
    """Return which limits of a diagram are drawn as lines or given as text, for curves between `low` and `high`.

    Limits near the curves are drawn as lines, limits far away are given as text, to keep the shape of the curves
    visible. Curves with a range smaller than `min_range` are drawn as constant.
    """
    if not np.isfinite([low, high]).all():
        low = high = 0.0
    span = max(high - low, min_range) or 1.0
    lines, distant = [], []
    for limit in (lower, upper):
        if low - PICTURE_STYLE.limit_distance * span <= limit <= high + PICTURE_STYLE.limit_distance * span:
            lines.append(float(limit))
            low, high = min(low, limit), max(high, limit)
        elif np.isfinite(limit):
            distant.append(f"{limit:.3g}")
    text = f"limit{'s' if len(distant) > 1 else ''} {', '.join(distant)}" if distant else ""
    below, space = bool(high == upper), 0.1 * span if distant else 0.0
    margin = max(0.06 * (high - low), 0.55 * (span - (high - low)))
    ends = low - margin - space * below, high + margin + space * (not below)
    return LimitView(*ends, tuple(lines), text, below)


def curve_samples(motion: Motion, kind: str) -> tuple[Array, Array | None]:
    """Return times (K,), s, at which to draw a quantity of a motion, and the values (K, n) or None if unknown."""
    own_times = motion.t[:: len(motion.t) // PICTURE_STYLE.curve_points + 1]
    times = np.union1d(np.linspace(motion.t[0], motion.t[-1], PICTURE_STYLE.curve_points), own_times)
    quantity = motion.quantity(kind)
    return times, None if quantity is None else quantity.pieces.at(times)


def bounds_of(bounds: JointBounds, kind: str) -> tuple[Array, Array]:
    """Return the lower and upper joint limits of one kind of quantity, such as "velocity". Shape (n,) each."""
    limit = getattr(bounds, kind, None)
    return (bounds.lower, bounds.upper) if limit is None else (-limit, limit)


def draw_curves(
    motion: Motion, bounds: JointBounds, *, names: Sequence[str], units: Sequence[str], faults: Sequence[Any] = ()
) -> str:
    """Return an SVG with position, velocity and acceleration of every joint over time, with their limits and faults.

    matplotlib is not used, because it takes longer to import than everything else in a report.
    """
    width, height, left, gap, top, pitch = 165.0, 92.0, 72.0, 56.0, 18.0, 108.0  # px: diagrams and what is around them
    parts = []

    def place_of(time: Any) -> Any:
        """Return the horizontal positions of one or several times (s) in a diagram, px."""
        return width * (time - motion.t[0]) / (motion.t[-1] - motion.t[0])

    for column, (kind, per) in enumerate(KINDS.items()):
        times, values = curve_samples(motion, kind)
        lower, upper = bounds_of(bounds, kind)
        min_range = PICTURE_STYLE.flat * (1.0 if values is None else float(np.abs(values).max()))
        marks = [(place_of(time), f"{time:.6g}") for time in _round_numbers(motion.t[0], motion.t[-1])]
        for row, name in enumerate(names):
            curve = np.full(1, np.nan) if values is None else values[:, row]
            ranges = float(curve.min()), float(curve.max()), float(lower[row]), float(upper[row])
            view = limits_in_view(*ranges, min_range=min_range)
            scale = height / (view.high - view.low)
            parts.append(f'<g transform="translate({left + column * (width + gap):g} {top + row * pitch:g})">')
            ticks = [(height - scale * (value - view.low), f"{value:.6g}") for value in _round_numbers(*view[:2])]
            axes = f"M0 0V{height:g}H{width:g}" + "".join(f"M0 {y:.1f}h-3" for y, _ in ticks)
            parts.append(f'<path d="{axes}{"".join(f"M{place:.1f} {height:g}v3" for place, _ in marks)}"/>')
            parts += [f'<text x="-5" y="{y + 3:.1f}">{text}</text>' for y, text in ticks]
            for limit in view.lines:
                y = height - scale * (limit - view.low)
                parts.append(f'<path d="M0 {y:.1f}H{width:g}" style="stroke:{LIMIT};stroke-dasharray:5 2"/>')
            for fault in faults:
                if fault.name == name and fault.kind == kind and fault.time is not None:
                    x = place_of(fault.time)
                    parts.append(f'<path d="M{x:.1f} 0v{height:g}" style="stroke:{FAULT};stroke-width:2"/>')
            if values is not None:
                points = np.column_stack([place_of(times), height - scale * (curve - view.low)]).tolist()
                line = "L".join(f"{a:.1f} {b:.1f}" for a, b in points)
                parts.append(f'<path d="M{line}" style="stroke:{PLAN};stroke-width:1.6"/>')
            if view.text:
                y = height - 4 if view.text_below else 7
                parts.append(f'<text class="limit" x="{width:g}" y="{y:g}" fill="{LIMIT}">{view.text}</text>')
            labels = [(14 - gap, f"{units[row]}{per}"), *([(12 - left, name)] if column == 0 else [])]
            for place, text in labels:
                turned = f'transform="translate({place:g} {height / 2:g}) rotate(-90)"'
                parts.append(f'<text class="middle" {turned}>{escape(text)}</text>')
            if row == 0:
                parts.append(f'<text class="middle title" x="{width / 2:g}" y="-6">{kind}</text>')
            if row == len(names) - 1:
                y = height + 14
                parts += [f'<text class="middle" x="{place:.1f}" y="{y:g}">{text}</text>' for place, text in marks]
                parts.append(f'<text class="middle" x="{width / 2:g}" y="{height + 27:g}">time, s</text>')
            parts.append("</g>")
    size = f"0 0 {left + 3 * width + 2 * gap + 12:g} {top + len(names) * pitch + 16:g}"
    return f'<svg class="curves" viewBox="{size}" xmlns="http://www.w3.org/2000/svg">{"".join(parts)}</svg>'


def _round_numbers(low: float, high: float) -> list[float]:
    """Return three to eight multiples of 1, 2 or 5 times a power of ten between two numbers, for the ticks of axes."""
    power = 10.0 ** np.floor(np.log10((high - low) / 3))
    step = power * max((factor for factor in (1, 2, 5) if factor * power <= (high - low) / 3), default=1)
    return [float(k * step) for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]


def draw_scene(
    machine: Machine, motion: Motion, bases: Array | None, obstacles: Sequence[Obstacle], *, folders: Sequence[Any] = ()
) -> bytes:
    """Return a PNG picture of the robot at several times (solid at the last), of its tip path and of the obstacles.

    Moving obstacles are drawn at the final time; `obstacles` has them at uniform times of the motion.
    """
    times = np.linspace(motion.t[0], motion.t[-1], PICTURE_STYLE.curve_points)
    base = None if bases is None else interpolate(times, motion.t, bases)
    frames = frames_along(machine, motion.position.at(times), base)
    appearance = appearance_of(machine.robot, folders)
    samples = np.linspace(0, PICTURE_STYLE.curve_points - 1, PICTURE_STYLE.poses)
    poses = [parts_in_world(appearance, frames, int(k)) for k in samples]
    points = [part.vertices for parts in poses for part in parts]
    robot_points, static = np.vstack(points), []
    for obstacle in obstacles:
        corners, faces = obstacle.solid(robot_points)
        if obstacle.rotations is not None and obstacle.positions is not None:
            corners = corners @ obstacle.rotations[-1].T + obstacle.positions[-1]
        static.append(part_of("", corners, faces, (*_rgb(SCENE), 1.0)))
        if obstacle.normal is None:
            points.append(corners)
    if machine.robot.tip is not None:
        points.append(frames.tip)
    all_points = np.vstack(points)
    low, high = all_points.min(axis=0), all_points.max(axis=0)
    size = float((high - low).max())
    if machine.robot.tip is not None:
        static.append(tube(frames.tip, PICTURE_STYLE.line * size, _rgb(TIP)))
    transparent = [Layer(parts, 0.12 + 0.08 * k, _rgb(PLAN)) for k, parts in enumerate(poses[:-1])]
    floor = None if machine.base_size else Floor(low[2], tuple((low + high)[:2] / 2), 1.1 * size, 0.1)
    layers = [Layer(poses[-1]), Layer(static), *transparent]
    return encode_png(render(layers, Camera.around(all_points, PICTURE_STYLE.size), floor=floor))


def _rgb(color: str) -> tuple[float, float, float]:
    """Return red, green and blue, 0 to 1, of a colour in the form #RRGGBB."""
    red, green, blue = bytes.fromhex(color[1:])
    return red / 255, green / 255, blue / 255
