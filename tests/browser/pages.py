"""Laws of the pages of the viewer, of a report and of the site, on a desktop, on a phone and in dark mode.

A page complains of nothing, loads nothing from another host, and shows its pictures within the width of the window. In
dark mode its plots are dark. A player plays, scrubs and switches plans.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any
from urllib.parse import unquote, urlparse

import numpy as np
from matplotlib.image import imread

from ocp import Plan
from ocp.app.files import read_trajectory
from ocp.app.view.animation import Animation, animate_plan, animate_trajectory
from ocp.app.view.appearance import TIP_FRAME, frames_along
from ocp.app.view.player import PageServer, build_page
from ocp.app.view.report import report_of_plan

__all__ = ["Look", "failures"]

SLOW = 60_000
"""ms: the pictures are made without a graphics card."""
SETTINGS: dict[str, dict[str, Any]] = {
    "desktop": {"viewport": {"width": 1280, "height": 900}},
    "phone": {"viewport": {"width": 390, "height": 844}},
    "dark": {"viewport": {"width": 1280, "height": 900}, "color_scheme": "dark"},
}
TALLEST = 16384
"""px: the tallest picture that Chromium draws."""
DARK = 0.3
"""Largest median brightness of a dark plot, between 0 (black) and 1 (white)."""
BRIGHT = 0.6
"""Least brightness of the brightest hundredth of a dark plot: of its text and its lines."""
GALLERY = {
    "panda": "Panda: a circle, cyclic, beside the pseudo-inverse",
    "space_arm": "A free-flying arm, beside the pseudo-inverse",
    "mobile_manipulator": "TIAGo on its wheels, a rope in its hand",
}
PLOTS = """[...document.querySelectorAll("div.output svg, figure:not(.chart) > svg")].map((one) => {
    const box = one.getBoundingClientRect();
    return [box.left, box.top + scrollY, box.right, box.bottom + scrollY].map(Math.round); })"""
CUT_CODE = """[...document.querySelectorAll("div.highlight-python3 pre, div.highlight-python pre")]
    .filter((one) => one.scrollWidth > one.clientWidth).map((one) => one.textContent.slice(0, 60))"""
LOOSE = {"mobile_manipulator": {"tolerances": {"tip": 0.06, "velocities": 1e-3, "zero moment point": 1e-3}}}
"""As scripts/robots/standing.py has them."""


@dataclass
class Look:
    """A browser, where its pictures go, and what was wrong.

    Attributes:
        browser: Of playwright. folder: Of the pictures. told: What did not hold.
    """

    browser: Any
    folder: Path
    messages: list[str] = field(default_factory=list)

    def check(self, holds: object, words: str) -> None:
        """Tell what does not hold."""
        if not holds:
            self.messages.append(words)

    @contextmanager
    def opened(self, address: str, name: str, **settings: Any) -> Iterator[Any]:
        """A page; whatever it complains of, and whomever else it asks, is told."""
        context = self.browser.new_context(**{"viewport": {"width": 1180, "height": 760}, **settings})
        opened = context.new_page()
        opened.set_default_timeout(SLOW)
        opened.on(
            "console", lambda message: self.check(message.type not in ("error", "warning"), f"{name}: {message.text}")
        )
        opened.on("pageerror", lambda error: self.check(False, f"{name}: {error}"))
        own = urlparse(address).netloc
        opened.on("request", lambda request: self.check(_own(request.url, own), f"{name} asks {request.url}"))
        try:
            opened.goto(address)
            yield opened
        except Exception as error:  # of the driver: what did not come in time
            self.messages.append(f"{name}: {type(error).__name__}: {str(error).splitlines()[0]}")
        finally:
            context.close()

    def picture(self, opened: Any, name: str) -> bytes:
        """Of the whole window, kept; without the name of a file of the scene alone, not kept."""
        return bytes(opened.screenshot(path=self.folder / f"{name}.png"))


def _own(address: str, own: str) -> bool:
    parts = urlparse(address)
    return parts.scheme in ("data", "blob", "file") or (parts.netloc == own and own != "")


def failures(look: Look, root: Path) -> list[str]:
    """Open all pages; what does not hold."""
    for name, title in GALLERY.items():
        print(f"browser: {title}", flush=True)
        file = root / "results" / "gallery" / f"{name}.npz"
        plan = Plan.load(file)
        raw = read_trajectory(file.with_suffix(".local.csv"), joints=plan.names)
        shown = [
            animate_plan(plan, "optimum", **LOOSE.get(name, {})),
            animate_trajectory(raw, plan.machine, "compared"),
        ]
        text = build_page(shown, title=title).text
        target = look.folder / f"{name}.html"
        target.write_text(text, encoding="utf-8")
        look.check(len(text.encode()) <= 8_000_000, f"{name}: the page has {len(text.encode())} bytes")
        with look.opened(target.as_uri(), name) as opened:
            player(look, opened, name, shown[0], ends=name == "space_arm")
        for setting in ("phone", "dark"):
            with look.opened(target.as_uri(), f"{name}, {setting}", **SETTINGS[setting]) as opened:
                ready(opened)
                layout(look, opened, f"{name}_{setting}", setting)
        if name == "panda":
            with PageServer(text) as served, look.opened(served.address, "served") as opened:
                player(look, opened, "served", shown[0], ends=False)
            report = look.folder / "report.html"
            report.write_text(report_of_plan(plan, 0.01, title).html(), encoding="utf-8")
            for setting, options in SETTINGS.items():
                with look.opened(report.as_uri(), f"report, {setting}", **options) as opened:
                    layout(look, opened, f"report_{setting}", setting)
    site(look, root / "build" / "site")
    return look.messages


def ready(opened: Any) -> None:
    """Wait until the page is drawn."""
    until(opened, "document.documentElement.dataset.ready === 'yes'")
    opened.wait_for_timeout(300)


def until(opened: Any, holds: str) -> None:
    """Wait until an expression holds; asked from outside, as the page's policy forbids to evaluate texts in it."""
    end = monotonic() + SLOW / 1000
    while not opened.evaluate(holds):
        if monotonic() > end:
            raise TimeoutError(f"{holds}: not within {SLOW / 1000:g} s")
        opened.wait_for_timeout(20)


def layout(look: Look, opened: Any, name: str, setting: str) -> None:
    """Check the width, the pictures and the plots of a page, and keep a picture of the whole of it."""
    wide, window = opened.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    look.check(wide <= window, f"{name}: the page is {wide} px wide in a window of {window} px")
    missing = opened.evaluate("[...document.images].filter((one) => !one.naturalWidth).map((one) => one.src)")
    look.check(not missing, f"{name}: pictures are not loaded: {missing}")
    if setting == "desktop":
        cut = opened.evaluate(CUT_CODE)
        look.check(not cut, f"{name}: code is cut off at the right: {cut}")
    tall = opened.evaluate("document.documentElement.scrollHeight")
    clip = {"x": 0, "y": 0, "width": window, "height": min(tall, TALLEST)}
    picture = opened.screenshot(path=look.folder / f"{name}.png", full_page=True, clip=clip)
    if setting == "dark":
        pixels = imread(io.BytesIO(picture))[..., :3].mean(-1)
        page = float(np.median(pixels))
        look.check(page < DARK, f"{name}: the page has the brightness {page:.2f} in dark mode")
        for number, (left, top, right, bottom) in enumerate(opened.evaluate(PLOTS)):
            plot = pixels[top:bottom, left:right]
            paper, ink = float(np.median(plot)), float(np.quantile(plot, 0.99))
            words = f"{name}: plot {number + 1} has paper of the brightness {paper:.2f} and marks of {ink:.2f}"
            look.check(paper < DARK and ink > BRIGHT, f"{words} in dark mode")


def player(look: Look, opened: Any, name: str, first: Animation, *, ends: bool) -> None:
    """Play, pause, scrub, switch plans, with `ends` to the end and over it; the drawn poses are those of the model."""
    ready(opened)
    scene = opened.locator("#scene")
    begin = scene.screenshot()
    opened.click("#play")
    until(opened, "player.time > 0.4")
    opened.click("#play")
    time = opened.evaluate("player.time")
    look.check(not opened.evaluate("player.playing"), f"{name}: pause does not stop it")
    opened.wait_for_timeout(300)
    look.check(opened.evaluate("player.time") == time, f"{name}: it goes on while paused")
    look.check(scene.screenshot() != begin, f"{name}: playing moves nothing")
    horizon = opened.evaluate("player.horizon")
    opened.locator("#scrub").evaluate(
        "(one, to) => { one.value = to; one.dispatchEvent(new Event('input')); }", 0.6 * horizon
    )
    opened.wait_for_timeout(300)
    clock = opened.inner_text("#clock")
    look.check(
        clock.startswith(f"{0.6 * horizon:.2f}"), f"{name}: scrubbed to {0.6 * horizon:.2f} s the clock says {clock}"
    )
    shift = opened.locator(".chart .cursor").first.get_attribute("transform") or ""
    look.check(not shift.startswith("translate(42.00 "), f"{name}: the cursor of the curves does not follow: {shift}")
    look.picture(opened, f"{name}_over")
    poses(look, opened, name, first)
    chart = opened.locator(".chart svg").first.bounding_box()
    opened.mouse.click(chart["x"] + 0.5 * chart["width"], chart["y"] + 0.5 * chart["height"])
    share = opened.evaluate("player.time") / horizon
    look.check(0.35 < share < 0.55, f"{name}: a click in the middle of a curve goes to {share:.2f} of the time")
    if ends:
        opened.uncheck("#loop")
        opened.select_option("#speed", "10")
        opened.evaluate("player.seek(0.95 * player.horizon); player.play()")
        until(opened, "!player.playing")
        look.check(
            opened.evaluate("player.time === player.horizon"), f"{name}: without loop it does not end at the end"
        )
        opened.check("#loop")
        opened.evaluate("player.play()")
        until(opened, "player.time > 0.5 * player.horizon")
        until(opened, "player.time < 0.5 * player.horizon")
    opened.evaluate("player.stop(); player.seek(0.3 * player.horizon)")
    opened.wait_for_timeout(300)
    over = scene.screenshot()
    opened.locator("#options select[aria-label=shown]").select_option("side")
    opened.check("#show-ghosts")
    opened.wait_for_timeout(500)
    look.picture(opened, f"{name}_side")
    look.check(scene.screenshot() != over, f"{name}: side by side is as over each other")
    opened.locator("#options select[aria-label=shown]").select_option("alone")
    opened.wait_for_timeout(300)
    alone, verdict = scene.screenshot(), opened.inner_text("#verdict")
    look.check(first.verdict in verdict, f"{name}: the verdict is not told: {verdict}")
    look.check(opened.locator("#audit tr").count() > 5, f"{name}: the audit has no table")
    look.picture(opened, f"{name}_alone")
    opened.locator("#options select[aria-label=plan]").select_option("1")
    opened.wait_for_timeout(300)
    look.check(scene.screenshot() != alone, f"{name}: switching plans changes nothing")
    look.check(opened.inner_text("#verdict") != verdict, f"{name}: switching plans keeps the verdict")
    opened.evaluate("window.scrollTo(0, document.body.scrollHeight)")
    opened.wait_for_timeout(200)
    look.picture(opened, f"{name}_below")


def poses(look: Look, opened: Any, name: str, first: Animation) -> None:
    """What the page draws between its times, against the model."""
    robot = first.machine.robot
    for time in np.random.default_rng(0).uniform(0.0, first.t[-1], 5):
        displayed = np.array(opened.evaluate("(time) => [...player.motions[0].at(time)]", time)).reshape(-1, 7)
        joints, base = (
            np.array([[np.interp(time, first.t, column) for column in values.T]])
            for values in (first.joints, first.base)
        )
        frames = frames_along(first.machine, joints, base)
        wanted = np.array([frames.positions[link.name][0] for link in robot.links])
        off = np.abs(displayed[: len(wanted), :3] - wanted).max()  # moving obstacles come between links and tip
        if robot.tip is not None:
            off = max(off, np.abs(displayed[-1, :3] - frames.positions[TIP_FRAME][0]).max())
        look.check(off < 2e-3, f"{name}: at {time:.3f} s a link is drawn {off:.2g} m from where it is")


def site(look: Look, folder: Path) -> None:
    """Check every page of the site, if it has been built: its layout in all settings, its links and its players."""
    pages = sorted(folder.rglob("*.html")) if folder.is_dir() else []
    print(f"browser: {len(pages)} pages of the site", flush=True)
    anchors: dict[Path, set[str]] = {}

    def known(file: Path) -> set[str]:
        if file not in anchors:
            anchors[file] = set(re.findall(r"\bid=[\"']?([^\"'\s>]+)", file.read_text(encoding="utf-8")))
        return anchors[file]

    for file in pages:
        name = file.relative_to(folder).with_suffix("").as_posix()
        for setting, options in SETTINGS.items():
            with look.opened(file.as_uri(), f"{name}, {setting}", **options) as opened:
                opened.wait_for_load_state("load")
                if file.parent.name == "players":
                    ready(opened)
                layout(look, opened, f"site_{name.replace('/', '_')}_{setting}", setting)
                for closed in opened.locator("details.player").all():  # its player is loaded when it is opened
                    closed.locator("summary").click()
                    ready(closed.locator("iframe").element_handle().content_frame())
                    closed.locator("summary").click()
                if setting == "desktop":
                    links = opened.eval_on_selector_all("a[href]", "(all) => all.map((one) => one.href)")
                    for link in dict.fromkeys(links):
                        _resolves(look, name, link, known)


def _resolves(look: Look, name: str, link: str, known: Callable[[Path], set[str]]) -> None:
    parts = urlparse(link)
    if parts.scheme != "file":
        return
    target = Path(unquote(parts.path))
    target = target / "index.html" if target.is_dir() else target
    if not target.is_file():
        look.check(False, f"{name}: the link {link} leads nowhere")
    elif parts.fragment and target.suffix == ".html":
        look.check(unquote(parts.fragment) in known(target), f"{name}: there is no #{parts.fragment} in {target.name}")
