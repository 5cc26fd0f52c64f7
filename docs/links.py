"""Laws of the built site: every internal link leads somewhere, and no page asks another host.

`python -m docs.links build/site` tells each breach, and exits with 1 where there is one.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

__all__ = ["Page", "broken", "main"]

ASKING = {
    "img": ("src", "srcset"),
    "script": ("src",),
    "link": ("href",),
    "iframe": ("src",),
    "source": ("src", "srcset"),
    "video": ("src", "poster"),
    "audio": ("src",),
    "object": ("data",),
    "embed": ("src",),
    "image": ("href", "xlink:href"),
    "use": ("href", "xlink:href"),
    "form": ("action",),
    "base": ("href",),
}
"""What a browser asks for when it opens a page."""
TOLD = {"canonical", "author", "license", "search", "index", "next", "prev"}
"""Kinds of `link` that are not asked for."""
IN_STYLE = re.compile(r"url\(\s*['\"]?([^'\")]+)|@import\s+['\"]([^'\"]+)")
IN_SCRIPT = re.compile(r"(?:fetch|importScripts|import|XMLHttpRequest|open)\s*\(\s*['\"](https?:)?//")


class Page(HTMLParser):
    """What a page has and what it asks for.

    Attributes:
        anchors: Its ids and names. links: What a click leads to. asked: What opening it asks for.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.asked: list[str] = []
        self._inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attributes}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if not (tag == "link" and set(given.get("rel", "").split()) <= TOLD):
            for name in ASKING.get(tag, ()):
                values = given.get(name, "").split(",") if name == "srcset" else [given.get(name, "")]
                self.asked += [value.split()[0] if name == "srcset" else value for value in values if value.strip()]
        else:
            self.links.append(given.get("href", ""))
        self.asked += _in_style(given.get("style", ""))
        self._inside = tag if tag in ("style", "script") else ""

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside == "style":
            self.asked += _in_style(data)
        elif self._inside == "script":
            self.asked += [match.group() for match in IN_SCRIPT.finditer(data)]


def _in_style(text: str) -> list[str]:
    return [first or second for first, second in IN_STYLE.findall(text)]


def broken(site: Path) -> list[str]:
    """Every breach, in words: the file, and what it asks for or leads to."""
    found = []
    pages = {file: Page(file.read_text(encoding="utf-8")) for file in sorted(site.rglob("*.html"))}
    if not pages:
        return [f"{site} has no page"]
    for file, page in pages.items():
        name = file.relative_to(site)
        for asked in page.asked:
            if _outside(asked):
                found.append(f"{name} asks another host: {asked[:80]}")
            elif why := _leads_nowhere(file, asked, site, pages):
                found.append(f"{name} asks for {asked}: {why}")
        for link in page.links:
            if not _outside(link) and (why := _leads_nowhere(file, link, site, pages)):
                found.append(f"{name} leads to {link}: {why}")
    for file in sorted(site.rglob("*.css")):
        for asked in _in_style(file.read_text(encoding="utf-8")):
            name = file.relative_to(site)
            if _outside(asked):
                found.append(f"{name} asks another host: {asked[:80]}")
            elif why := _leads_nowhere(file, asked, site, pages):
                found.append(f"{name} asks for {asked}: {why}")
    for file in sorted(site.rglob("*.js")):
        for match in IN_SCRIPT.finditer(file.read_text(encoding="utf-8")):
            found.append(f"{file.relative_to(site)} asks another host: {match.group()}")
    return found


def _outside(link: str) -> bool:
    parts = urlsplit(link)
    return parts.scheme not in ("", "data", "blob", "about", "javascript") or bool(parts.netloc) or "//" in link[:8]


def _leads_nowhere(file: Path, link: str, site: Path, pages: dict[Path, Page]) -> str:
    """Why, or ""."""
    parts = urlsplit(link)
    if parts.scheme:
        return ""  # data that stands in the page itself
    target = file if not parts.path else (file.parent / unquote(parts.path)).resolve()
    if target.is_dir():
        target /= "index.html"
    if not target.is_relative_to(site.resolve()) and target != file:
        return "it lies outside the site"
    if not target.is_file():
        return "there is no such file"
    fragment = unquote(parts.fragment)
    known = {each.resolve(): page for each, page in pages.items()}.get(target.resolve())
    if fragment and known is not None and fragment not in known.anchors:
        return "there is no such place in it"
    return ""


def main(arguments: list[str]) -> int:
    """Tell every breach; 1 where there is one."""
    site = Path(arguments[0] if arguments else "build/site")
    found = broken(site)
    print("\n".join(found) if found else f"{site}: every link leads somewhere, and no page asks another host")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
