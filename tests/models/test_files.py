"""The cache ignores files that others own or may write, and files that are damaged or of another key."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path

import pytest

from models import files as cache

KEY = cache.cache_key("1", "an input")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    cache._log_once.cache_clear()
    return tmp_path / "cache" / "selfmotion"


def filled(place: Path) -> tuple[Path, Path]:
    """Files of a value and a library, both of which are taken."""
    cache.store_value(KEY, [1.5])
    library = cache.store_library(KEY, b"compiled")
    assert library is not None
    assert (cache.load_value(KEY), cache.load_library(KEY)) == ([1.5], library)
    return place / f"{KEY}.json", library


def make_foreign(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a path somebody else's: root gives it away, any other user becomes another one."""
    if os.geteuid() == 0:
        os.chown(path, 12345, -1, follow_symlinks=False)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)


def test_the_folder_is_made_for_its_owner_alone(place: Path) -> None:
    assert cache.load_value(KEY) is None
    assert cache.cache_files() == []
    assert not place.exists()  # looking makes nothing
    place.parent.mkdir()
    old = os.umask(0)
    try:
        filled(place)
    finally:
        os.umask(old)
    assert place.stat().st_mode & 0o777 == 0o700
    assert {file.stat().st_mode & 0o077 for file in place.iterdir()} == {0}


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777, 0o1777, 0o720])
def test_a_folder_that_others_may_write_is_not_used(place: Path, mode: int, caplog: pytest.LogCaptureFixture) -> None:
    value, library = filled(place)
    place.chmod(mode)
    with caplog.at_level(logging.WARNING):
        assert (cache.load_value(KEY), cache.load_library(KEY)) == (None, None)
        cache.store_value(KEY, [2.5])
        assert cache.store_library("b" * 64, b"compiled") is None
        with cache.exclusive(KEY):
            assert sorted(place.iterdir()) == sorted([value, library])
    assert cache.cache_files() == []
    (record,) = caplog.records
    assert "other users may write it" in record.getMessage()
    assert str(place) in record.getMessage()
    place.chmod(0o700)
    assert cache.load_value(KEY) == [1.5]


@pytest.mark.parametrize("whose", ["folder", "above"])
def test_a_folder_of_somebody_else_is_not_used(place: Path, whose: str, monkeypatch: pytest.MonkeyPatch) -> None:
    filled(place)
    make_foreign(place if whose == "folder" else place.parent, monkeypatch)
    assert (cache.load_value(KEY), cache.load_library(KEY)) == (None, None)


def test_a_folder_that_others_may_rename_is_not_used(place: Path) -> None:
    filled(place)
    place.parent.chmod(0o777)
    assert (cache.load_value(KEY), cache.load_library(KEY)) == (None, None)
    place.parent.chmod(0o1777)  # as /tmp is: names in it belong to who made them
    assert cache.load_value(KEY) == [1.5]


def test_a_link_is_not_followed(place: Path, tmp_path: Path) -> None:
    value, library = filled(place)
    for file in (value, library):
        file.rename(tmp_path / file.name)
        file.symlink_to(tmp_path / file.name)
    assert (cache.load_value(KEY), cache.load_library(KEY)) == (None, None)
    other = tmp_path / "other"
    place.rename(other)
    place.symlink_to(other)
    assert cache.cache_files() == []


@pytest.mark.parametrize("how", ["somebody else's", "others may write", "pipe"])
def test_a_file_of_others_is_not_believed(place: Path, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for file in filled(place):
        if how == "pipe":
            file.unlink()
            os.mkfifo(file)
        elif how == "others may write":
            file.chmod(0o620)
        else:
            make_foreign(file, monkeypatch)
    assert (cache.load_value(KEY), cache.load_library(KEY)) == (None, None)


def test_a_value_carries_a_digest_of_itself_and_of_its_key(place: Path) -> None:
    """So that no value that was changed, or that other code or another input made, is taken."""
    value, _ = filled(place)
    whole = value.read_bytes()
    for changed in (whole.replace(b"1.5", b"2.5"), whole[:-1], b"x" + whole[1:], json.dumps([1.5]).encode(), b""):
        value.write_bytes(changed)
        assert cache.load_value(KEY) is None
    other = cache.cache_key("2", "an input")
    (place / f"{other}.json").write_bytes(whole)
    assert cache.load_value(other) is None
    value.write_bytes(whole)
    assert cache.load_value(KEY) == [1.5]
