"""Files of named arrays, written atomically and checked before they are unpacked, and column names of CSV tables."""

from __future__ import annotations

import fcntl
import io
import os
import re
import secrets
import stat
import sys
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any
from urllib.parse import unquote

import numpy as np

from models.files import UnfitFile, open_regular
from ocp.errors import ProblemError

MAX_FILE_BYTES = 2**28  # of all arrays of a file, unpacked: 30 million numbers
MAX_DIRECTORY_BYTES = 2**20  # of an archive's table of contents
COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
END_RECORD = b"PK\x05\x06"  # begins the last 22 bytes of an archive
ZIP64_LOCATOR = b"PK\x06\x07"  # precedes it in a larger archive


# ---- writing -----------------------------------------------------------------------------------------------------


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays to a compressed ``.npz`` file atomically; raise ProblemError if they are too large."""
    checked_path(path)
    size = sum(array.nbytes for array in arrays.values())
    if size > MAX_FILE_BYTES:
        words = f"{path}: {size:.3g} bytes of arrays, at most {MAX_FILE_BYTES:.3g} are written"
        raise ProblemError(words, name="path", value=size, limit=MAX_FILE_BYTES)
    write_whole(path, lambda stream: np.savez_compressed(stream, **arrays))  # type: ignore[arg-type]


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file in UTF-8 atomically; see :func:`write_whole`."""
    write_whole(path, lambda stream: stream.write(text.encode()))


def write_whole(path: str | os.PathLike[str], write: Callable[[IO[bytes]], Any], synced: bool = True) -> None:
    """Write a file atomically; if ``synced`` is true, return only after the file is on the disk.

    Without ``synced`` the file may be empty after a loss of power; use it for files whose readers detect this. Links
    are followed, and the mode of an existing file is kept. Until it is complete the file is called
    ``NAME.xxxxxxxx.part`` and is locked. Such files without a lock, left by killed processes, are removed.

    Raises:
        ProblemError: path is not the path of a file.
        OSError: The file cannot be written.
    """
    checked_path(path)
    target = Path(os.path.realpath(path))
    mode = None
    with suppress(FileNotFoundError):
        mode = target.stat().st_mode
        if not stat.S_ISREG(mode):
            words = f"{path} is not a file, but a folder, a pipe or a device"
            raise ProblemError(words, name="path", value=str(path))
    remove_abandoned(target)
    stream = open_part(target)
    try:
        with stream:
            if mode is not None:
                os.fchmod(stream.fileno(), stat.S_IMODE(mode))
            write(stream)
            stream.flush()
            if synced:
                os.fsync(stream.fileno())
            os.replace(stream.name, target)
    except BaseException:
        Path(stream.name).unlink(missing_ok=True)
        raise
    if not synced:
        return
    with suppress(PermissionError):  # a folder may be writable but not readable
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def open_part(target: Path) -> IO[bytes]:
    """Create a locked temporary file in the folder of a target file, which replaces the target once complete."""
    while True:
        stream = open(target.with_name(f"{target.name}.{secrets.token_hex(4)}.part"), "xb")  # noqa: SIM115
        with suppress(OSError):  # some file systems have no locks
            fcntl.flock(stream, fcntl.LOCK_EX)
        with suppress(FileNotFoundError):
            if os.path.samestat(os.stat(stream.name), os.fstat(stream.fileno())):
                return stream
        stream.close()  # another writer removed the file before it was locked


def remove_abandoned(target: Path) -> None:
    """Remove partial versions of a target file that interrupted writers have left behind."""
    prefix = f"{target.name}."
    with suppress(OSError):
        for name in os.listdir(target.parent):
            if name.startswith(prefix) and re.fullmatch(r"[0-9a-f]{8}\.part", name.removeprefix(prefix)):
                part = target.with_name(name)
                with suppress(OSError), open_regular(part, sys.maxsize) as stream:
                    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises while its writer is alive
                    part.unlink()


# ---- reading -----------------------------------------------------------------------------------------------------


def read_arrays(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Return the arrays of an ``.npz`` file by name; only real numbers are accepted.

    Sizes are checked before anything is unpacked, so memory is bounded by twice ``MAX_FILE_BYTES``. Raise
    FileNotFoundError if there is no file, and ProblemError if it cannot be read or is no such file.
    """
    details: dict[str, Any] = {"name": "path", "value": str(checked_path(path))}
    try:
        with open_regular(path, MAX_FILE_BYTES) as stream:
            check_contents(path, stream, os.fstat(stream.fileno()).st_size)
            with zipfile.ZipFile(stream) as archive:
                members = archive.infolist()
                size = sum(member.file_size for member in members)
                if size > MAX_FILE_BYTES:
                    words = (
                        f"{path} is not a saved solution: it unpacks to {size:.3g} bytes, {MAX_FILE_BYTES:.3g} at most"
                    )
                    raise ProblemError(words, name="path", value=size, limit=MAX_FILE_BYTES)
                if len({member.filename for member in members}) < len(members):
                    raise ValueError("a name occurs twice")
                return {name_of(member): array_of(archive, member) for member in members}
    except (FileNotFoundError, ProblemError):
        raise
    except UnfitFile as error:
        raise ProblemError(f"{path} is not a saved solution: {error.strerror}", **details, limit=error.limit) from error
    except OSError as error:
        raise ProblemError(f"{path} cannot be read: {error.strerror or error}", **details) from error
    except Exception as error:  # zip, zlib and numpy raise many kinds of errors for damaged bytes
        raise ProblemError(f"{path} is not a saved solution: {error}", **details) from error


def open_unlinked(path: str | os.PathLike[str]) -> io.BufferedReader:
    """Open a regular file of at most ``MAX_FILE_BYTES`` for reading; refuse links, which another user may have made.

    Raises OSError if it cannot be opened, and ProblemError if it is a link, not regular, or too large.
    """
    try:
        return open_regular(path, MAX_FILE_BYTES, links=False)
    except UnfitFile as error:
        raise ProblemError(f"{path}: {error.strerror}", name="path", value=str(path), limit=error.limit) from error


def checked_path(path: Any) -> str | os.PathLike[str]:
    """Return ``path``; raise ProblemError unless it is a string or path, since a number would be a file descriptor."""
    if not isinstance(path, str | os.PathLike):
        raise ProblemError(f"a path is expected, not {path!r}", name="path", value=path)
    return path


def check_contents(path: Any, stream: IO[bytes], size: int) -> None:
    """Raise an error if an archive's table of contents is too large, or if the end of the archive is missing."""
    stream.seek(max(0, size - 42))
    tail = stream.read(42)
    if tail[-22:-18] != END_RECORD or tail.startswith(ZIP64_LOCATOR):
        raise ValueError("it is not an archive, or incomplete")
    if int.from_bytes(tail[-10:-6], "little") > MAX_DIRECTORY_BYTES:
        raise ValueError("its table of contents is too long")


def name_of(member: zipfile.ZipInfo) -> str:
    """Return the name of an array from its member in an archive; raise ValueError if the member is no array."""
    name, dot, kind = member.filename.rpartition(".")
    if not dot or kind != "npy":
        raise ValueError(f"{member.filename!r} is not an array")
    return name


def array_of(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Return an array of real numbers from an archive; its size is checked before memory is allocated."""
    if member.compress_type not in COMPRESSIONS:
        raise ValueError(f"{member.filename!r} has an unknown compression")
    with archive.open(member) as packed:
        data = packed.read(member.file_size + 1)  # never more than declared
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
    shape, by_columns, kind = read_header(stream)
    if kind.kind not in "fiu" or kind.itemsize > 8:
        part = name_of(member)
        words = f"{archive.filename} is not a saved solution: {part!r} holds {kind}, not real numbers"
        raise ProblemError(words, name=part, value=str(kind))
    count, remaining = 1, len(data) - stream.tell()
    for length in shape:
        count *= length
    if min(shape, default=0) < 0 or count * kind.itemsize != remaining:
        raise ValueError(f"{member.filename!r} has {remaining} bytes for shape {shape} of {kind}")
    array = np.frombuffer(data, kind, count, stream.tell()).reshape(shape, order="F" if by_columns else "C")
    return array.astype(kind.newbyteorder("="), order="C")


SUFFIXES = ("", ".velocity", ".acceleration")
ESCAPED = re.compile(r"[^\w./: -]|^[^\w]| $")
"""Characters of joint names that tables contain as %XX: all but letters, digits and harmless punctuation. A leading `-`
would start a formula, a leading `/` a command, and spaces at the ends would be lost."""
FORMULA = re.compile(r"^[=+\-@\t\r%]")
"""Characters with which a spreadsheet formula can begin, and the escape character itself."""


def column_name(name: str) -> str:
    """Encode a joint name for a table header: each UTF-8 byte of a special character becomes %XX."""
    return ESCAPED.sub(_quote, name)


def cell(value: Any) -> Any:
    """Return a value for a CSV cell; if a text looks like a formula, its first character is encoded as %XX."""
    return FORMULA.sub(_quote, value) if isinstance(value, str) else value


def _quote(match: re.Match[str]) -> str:
    return "".join(f"%{byte:02X}" for byte in match[0].encode(errors="surrogatepass"))


def joint_name(column: str) -> str:
    """Decode a joint name from a table header, which :func:`column_name` has encoded."""
    return unquote(column, errors="surrogatepass")


def table_head(names: Sequence[str]) -> list[str]:
    """Return the column names for the table of a plan: time, then joint positions, velocities and accelerations."""
    return ["time", *(column_name(name) + suffix for suffix in SUFFIXES for name in names)]


def table_joints(head: Sequence[str]) -> tuple[str, ...]:
    """Return the joint names in a table header; empty for a header that :func:`table_head` has not produced."""
    try:
        names = tuple(map(joint_name, head[1 : 1 + len(head) // 3]))
    except UnicodeDecodeError:
        return ()
    return names if list(head) == table_head(names) and len(set(names)) == len(names) else ()
