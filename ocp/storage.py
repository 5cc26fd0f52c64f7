"""Files of named arrays: written whole or not at all, and looked at before anything of them is unpacked.

Tables as CSV: names and texts in them mean nothing to a spreadsheet or a shell, and are read back.
"""

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

from models.input_files import UnfitFile, open_regular
from ocp.errors import ProblemError

__all__ = [
    "MOST_BYTES",
    "cell",
    "column_name",
    "joint_name",
    "read_arrays",
    "table_head",
    "table_joints",
    "write_arrays",
    "write_text",
]

MOST_BYTES = 2**28  # of all arrays of a file, unpacked: 30 million numbers
MOST_ENTRIES = 2**20  # bytes of an archive's table of contents
PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
END = b"PK\x05\x06"  # of an archive, in its last 22 bytes; before it, of a longer one, stands LONG
LONG = b"PK\x06\x07"


# ---- writing -----------------------------------------------------------------------------------------------------


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray]) -> None:
    """Write one compressed ``.npz`` file, as :func:`write_whole` does.

    Raises:
        ProblemError: path is no path, no file but a folder, a pipe or a device, or the arrays are larger than is read
            again.
        OSError: The file cannot be written.
    """
    checked_path(path)
    size = sum(array.nbytes for array in arrays.values())
    if size > MOST_BYTES:
        words = f"{path}: {size:.3g} bytes of arrays, at most {MOST_BYTES:.3g} are written"
        raise ProblemError(words, name="path", value=size, limit=MOST_BYTES)
    write_whole(path, lambda stream: np.savez_compressed(stream, **arrays))  # type: ignore[arg-type]


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text in UTF-8, as :func:`write_whole` does."""
    write_whole(path, lambda stream: stream.write(text.encode()))


def write_whole(path: str | os.PathLike[str], write: Callable[[IO[bytes]], Any], synced: bool = True) -> None:
    """Write a file whole or not at all, and see it on the disk, where ``synced``.

    Without, a file that a reader can tell to be whole is there some ms sooner, and after a loss of power perhaps empty.

    A link is followed, the mode of a file that is there kept. Until it is whole the file bears a name of its own,
    ``NAME.xxxxxxxx.part``, and is locked; one that is not locked any more, because who wrote it was killed, is removed.

    Raises:
        ProblemError: path is no path, no file but a folder, a pipe or a device.
        OSError: The file cannot be written.
    """
    checked_path(path)
    target = Path(os.path.realpath(path))
    mode = None
    with suppress(FileNotFoundError):
        status = target.stat()
        check_regular(path, status)
        mode = stat.S_IMODE(status.st_mode)
    remove_left(target)
    stream = new_part(target)
    try:
        with stream:
            if mode is not None:
                os.fchmod(stream.fileno(), mode)
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
    with suppress(PermissionError):  # a folder that may be written, not read
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def new_part(target: Path) -> IO[bytes]:
    """A new file beside the target, locked."""
    while True:
        stream = open(target.with_name(f"{target.name}.{secrets.token_hex(4)}.part"), "xb")  # noqa: SIM115
        with suppress(OSError):  # a file system without locks
            fcntl.flock(stream, fcntl.LOCK_EX)
        with suppress(FileNotFoundError):
            if os.path.samestat(os.stat(stream.name), os.fstat(stream.fileno())):
                return stream
        stream.close()  # removed as one that was left, before it was locked


def remove_left(target: Path) -> None:
    """Remove what killed writers of the target have left."""
    begin = f"{target.name}."
    with suppress(OSError):
        for name in os.listdir(target.parent):
            if name.startswith(begin) and re.fullmatch(r"[0-9a-f]{8}\.part", name.removeprefix(begin)):
                left = target.with_name(name)
                with suppress(OSError), open_regular(left, sys.maxsize) as stream:
                    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises while its writer lives
                    left.unlink()


# ---- reading -----------------------------------------------------------------------------------------------------


def read_arrays(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz`` file by name, of real numbers each.

    Sizes are looked at before anything is unpacked, so that memory is bounded by twice ``MOST_BYTES``.

    Raises:
        FileNotFoundError: There is no such file.
        ProblemError: It cannot be read, is no such file, or is larger than ``MOST_BYTES``.
    """
    told: dict[str, Any] = {"name": "path", "value": str(checked_path(path))}
    try:
        with open_regular(path, MOST_BYTES) as stream:
            check_contents(path, stream, os.fstat(stream.fileno()).st_size)
            with zipfile.ZipFile(stream) as archive:
                members = archive.infolist()
                size = sum(member.file_size for member in members)
                if size > MOST_BYTES:
                    words = f"{path} is not a saved solution: it unpacks to {size:.3g} bytes, {MOST_BYTES:.3g} at most"
                    raise ProblemError(words, name="path", value=size, limit=MOST_BYTES)
                if len({member.filename for member in members}) < len(members):
                    raise ValueError("a name stands in it twice")
                return {name_of(member): array_of(archive, member) for member in members}
    except (FileNotFoundError, ProblemError):
        raise
    except UnfitFile as error:
        raise ProblemError(f"{path} is not a saved solution: {error.strerror}", **told, limit=error.limit) from error
    except OSError as error:
        raise ProblemError(f"{path} cannot be read: {error.strerror or error}", **told) from error
    except Exception as error:  # what zip, zlib and numpy say of broken bytes is of many kinds
        raise ProblemError(f"{path} is not a saved solution: {error}", **told) from error


def open_unlinked(path: str | os.PathLike[str]) -> io.BufferedReader:
    """Open a file of a folder that others may write: a regular one, of at most ``MOST_BYTES``, that is no link.

    Raises:
        OSError: It cannot be opened.
        ProblemError: It is another one.
    """
    try:
        return open_regular(path, MOST_BYTES, links=False)
    except UnfitFile as error:
        raise ProblemError(f"{path}: {error.strerror}", name="path", value=str(path), limit=error.limit) from error


def checked_path(path: Any) -> str | os.PathLike[str]:
    """``path``, or ProblemError unless it is the path of a file: a number would be an open file's, 0 the terminal."""
    if not isinstance(path, str | os.PathLike):
        raise ProblemError(f"a path is expected, not {path!r}", name="path", value=path)
    return path


def check_regular(path: Any, status: os.stat_result) -> None:
    """Raise ProblemError where something is no file but a folder, a pipe or a device."""
    if not stat.S_ISREG(status.st_mode):
        raise ProblemError(f"{path} is no file, but a folder, a pipe or a device", name="path", value=str(path))


def check_contents(path: Any, stream: IO[bytes], size: int) -> None:
    """Raise where an archive's table of contents is too large, or it does not end as one that was saved."""
    stream.seek(max(0, size - 42))
    tail = stream.read(42)
    if tail[-22:-18] != END or tail.startswith(LONG):
        raise ValueError("it is no archive, or not whole")
    if int.from_bytes(tail[-10:-6], "little") > MOST_ENTRIES:
        raise ValueError("its table of contents is too long")


def name_of(member: zipfile.ZipInfo) -> str:
    name, dot, kind = member.filename.rpartition(".")
    if not dot or kind != "npy":
        raise ValueError(f"{member.filename!r} is no array")
    return name


def array_of(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """An array of real numbers, whose size is looked at before it is made."""
    if member.compress_type not in PACKED:
        raise ValueError(f"{member.filename!r} is packed in another way than is written")
    with archive.open(member) as packed:
        data = packed.read(member.file_size + 1)  # never more than was told
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
    shape, by_columns, kind = read_header(stream)
    if kind.kind not in "fiu" or kind.itemsize > 8:
        part = name_of(member)
        words = f"{archive.filename} is not a saved solution: {part!r} holds {kind}, no real numbers"
        raise ProblemError(words, name=part, value=str(kind))
    count, left = 1, len(data) - stream.tell()
    for length in shape:
        count *= length
    if min(shape, default=0) < 0 or count * kind.itemsize != left:
        raise ValueError(f"{member.filename!r} has {left} bytes for shape {shape} of {kind}")
    array = np.frombuffer(data, kind, count, stream.tell()).reshape(shape, order="F" if by_columns else "C")
    return array.astype(kind.newbyteorder("="), order="C")


ENDS = ("", ".velocity", ".acceleration")
STRANGE = re.compile(r"[^\w./: -]|^[^\w]| $")
"""What is written as %XX: all but letters, digits and signs that mean nothing within a name.

At the beginning `-` would begin a formula, `/` a command, and blanks at the ends would be lost.
"""


FORMULA = re.compile(r"^[=+\-@\t\r%]")
"""What begins a formula in a spreadsheet, and the sign by which it is written in a cell."""


def column_name(name: str) -> str:
    """Return a joint's name as it stands in the head of a table, with strange characters as %XX of their UTF-8."""
    return STRANGE.sub(_quoted, name)


def cell(value: Any) -> Any:
    """Return a value as it stands in a cell: a text that a spreadsheet would take for a formula begins with %XX."""
    return FORMULA.sub(_quoted, value) if isinstance(value, str) else value


def _quoted(sign: re.Match[str]) -> str:
    return "".join(f"%{byte:02X}" for byte in sign[0].encode(errors="surrogatepass"))


def joint_name(column: str) -> str:
    """Return the name that :func:`column_name` wrote."""
    return unquote(column, errors="surrogatepass")


def table_head(names: Sequence[str]) -> list[str]:
    """Return the head of the table of a plan: time, and positions, velocities and accelerations of joints."""
    return ["time", *(column_name(name) + end for end in ENDS for name in names)]


def table_joints(head: Sequence[str]) -> tuple[str, ...]:
    """Return the joints of a head that :func:`table_head` made; none where another program or person wrote it."""
    try:
        names = tuple(map(joint_name, head[1 : 1 + len(head) // 3]))
    except UnicodeDecodeError:
        return ()
    return names if list(head) == table_head(names) and len(set(names)) == len(names) else ()
