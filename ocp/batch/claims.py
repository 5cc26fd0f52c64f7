"""Who is at which task: drivers on one folder share its tasks by claims.

A claim is a link ``claims/KEY`` to the name of its owner: made at once or not at all, by one of those who try. An owner
is a file ``owners/NAME`` that its process holds locked: when the process ends, whatever ends it, the system lets go of
the lock, and its claims are nobody's. Where locks do not reach, as from one machine to another, a driver counts as gone
after `SILENT` s without a sign, counted by the clock of who waits for it: no two clocks are ever compared.
"""

from __future__ import annotations

import fcntl
import os
import secrets
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ocp.errors import ProblemError
from ocp.storage import open_unlinked

__all__ = ["Claims"]

SIGN = 5.0
"""s between two signs of life."""
SILENT = 60.0
"""s without a sign after which a driver on another machine is gone."""


class Claims:
    """The claims of one driver in a folder; a context, at whose end it has none.

    Raises:
        OSError: The folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._claims, self._owners, self._lock = folder / "claims", folder / "owners", folder / "lock"
        for place in (self._claims, self._owners):
            place.mkdir(exist_ok=True)
        self._here = here()
        self._name = f"{self._here}.{secrets.token_hex(8)}"
        self._file = os.open(self._owners / self._name, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o644)
        with suppress(OSError):  # a file system without locks: signs alone
            fcntl.flock(self._file, fcntl.LOCK_EX)
        self._mine: set[str] = set()
        self._signed = time.monotonic()
        self._seen: dict[str, tuple[int, float]] = {}
        """Of other owners: their last sign, and when it was new to us."""

    def __enter__(self) -> Claims:
        return self

    def __exit__(self, *_: object) -> None:
        for key in list(self._mine):
            with suppress(OSError):
                self.release(key)
        with suppress(OSError):
            os.unlink(self._owners / self._name)
        os.close(self._file)

    def take(self, key: str) -> bool:
        """Whether the task is ours now; it was nobody's, or that of a driver that is gone."""
        claim = self._claims / key
        while True:
            try:
                os.symlink(self._name, claim)
                self._mine.add(key)
                return True
            except FileExistsError:
                owner = owner_of(claim)
            if owner is not None and self._lives(owner):
                return False
            if owner is not None:
                with self._locked():  # or two would remove it, the second one that is new
                    if owner_of(claim) == owner:
                        claim.unlink()

    def release(self, key: str) -> None:
        """The task is nobody's."""
        (self._claims / key).unlink(missing_ok=True)
        self._mine.discard(key)

    def sign(self) -> None:
        """Give a sign of life, if it is time for one."""
        if time.monotonic() - self._signed > SIGN:
            self._signed = time.monotonic()
            os.utime(self._file)

    def _lives(self, owner: str) -> bool:
        if owner in ("", ".", "..", self._name):
            return owner == self._name
        path, sure = self._owners / owner, owner.rpartition(".")[0] == self._here
        try:
            with open_unlinked(path) as stream:
                sign = os.fstat(stream.fileno()).st_mtime_ns
                try:
                    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    return True
                except OSError:  # a file system without locks
                    sure = False
        except (FileNotFoundError, ProblemError):  # it is gone, or no driver made it
            return False
        if not sure:
            last, since = self._seen.get(owner, (None, 0.0))
            if sign != last:
                self._seen[owner] = sign, time.monotonic()
                return True
            if time.monotonic() - since < SILENT:
                return True
        path.unlink(missing_ok=True)
        return False

    @contextmanager
    def _locked(self) -> Iterator[None]:
        with locked(self._lock):
            yield


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Alone among those who lock this file; where there are no locks, together with them."""
    file = os.open(path, os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW, 0o644)
    try:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
    finally:
        os.close(file)


def owner_of(claim: Path) -> str | None:
    """The name of who has a task; None where nobody has. A claim that names another place is nobody's: "" ."""
    try:
        name = os.readlink(claim)
    except FileNotFoundError:
        return None
    return name if os.path.basename(name) == name else ""


def here() -> str:
    """The name of this machine since it was started: within it locks can be relied upon."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return socket.gethostname().replace("/", "_") or "unnamed"
