"""The laws of the built site tell every planted breach, and nothing of a sound one."""

from __future__ import annotations

from pathlib import Path

import pytest

from docs.links import broken, main

HEAD = '<html><head><link rel="stylesheet" href="look/a.css"><link rel="canonical" href="https://a.org/x"></head><body>'
SOUND = {
    "index.html": HEAD
    + '<a href="more/b.html#place">b</a><a href="#top" id="top">up</a><a href="https://a.org">out</a>'
    '<img src="data:image/png;base64,AA=="><img src="more/a%20b.png" srcset="more/a%20b.png 2x"><a href="more/">b</a>',
    "more/b.html": '<p id="place"><a href="../index.html">home</a><script>fetch("b.html")</script>',
    "more/index.html": '<a name="x" href="b.html">b</a><svg><use href="#x"/></svg>',
    "more/a b.png": "",
    "look/a.css": "p { background: url(../more/a%20b.png) }",
    "look/a.js": 'import("./b.js")',
}
PLANTED = {
    "a page that is not there": ("index.html", '<a href="gone.html">x</a>', "gone.html"),
    "a place that is not there": ("index.html", '<a href="more/b.html#gone">x</a>', "#gone"),
    "a place in the page itself": ("more/b.html", '<a href="#nowhere">x</a>', "#nowhere"),
    "a picture that is not there": ("index.html", '<img src="gone.png">', "gone.png"),
    "a picture of two that is not there": ("index.html", '<img src="more/a%20b.png" srcset="gone.png 2x">', "gone.png"),
    "outside the site": ("index.html", '<a href="../secret.txt">x</a>', "secret.txt"),
    "a script of another host": ("index.html", '<script src="https://cdn.org/a.js"></script>', "cdn.org"),
    "a host without its scheme": ("index.html", '<script src="//cdn.org/a.js"></script>', "cdn.org"),
    "a style of another host": ("more/b.html", '<link rel="stylesheet" href="https://cdn.org/a.css">', "cdn.org"),
    "a font asked beforehand": ("index.html", '<link rel="preconnect" href="https://fonts.org">', "fonts.org"),
    "a frame of another host": ("index.html", '<iframe src="http://a.org"></iframe>', "a.org"),
    "a picture by its style": ("index.html", '<p style="background: url(https://a.org/a.png)">', "a.org"),
    "a style in the page": ("index.html", '<style>@import "https://a.org/a.css";</style>', "a.org"),
    "a request in a script": ("index.html", '<script>fetch("https://a.org/a.json")</script>', "fetch"),
    "a font in a style": ("look/a.css", "@font-face { src: url('https://fonts.org/a.woff') }", "fonts.org"),
    "a font that is not there": ("look/a.css", "@font-face { src: url(gone.woff) }", "gone.woff"),
    "a request in a file": ("look/a.js", "importScripts('//a.org/a.js')", "importScripts"),
}


def site_of(folder: Path, files: dict[str, str]) -> Path:
    site = folder / "site"
    (folder / "secret.txt").write_text("", encoding="utf-8")
    for name, text in files.items():
        (site / name).parent.mkdir(parents=True, exist_ok=True)
        (site / name).write_text(text, encoding="utf-8")
    return site


def test_a_sound_site_breaks_no_law(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert broken(site_of(tmp_path, SOUND)) == []
    assert main([str(tmp_path / "site")]) == 0
    assert "every link" in capsys.readouterr().out


@pytest.mark.parametrize("what", PLANTED)
def test_a_planted_breach_is_reported_with_file_and_link(what: str, tmp_path: Path) -> None:
    file, text, report = PLANTED[what]
    result = broken(site_of(tmp_path, {**SOUND, file: SOUND[file] + text}))
    assert len(result) == 1, result
    assert result[0].startswith(file)
    assert report in result[0]
    assert main([str(tmp_path / "site")]) == 1


def test_a_site_without_pages_is_none(tmp_path: Path) -> None:
    assert broken(tmp_path)
