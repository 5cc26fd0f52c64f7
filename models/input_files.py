"""Input files from anybody: regular files alone, none beyond a limit, and XML without entities.

A pipe would be waited for, a device read without end, and a file of another kind may do something when it is opened.
"""

from __future__ import annotations

import errno
import os
import stat
from dataclasses import dataclass
from io import BufferedReader
from xml.etree import ElementTree

__all__ = ["INPUT_LIMITS", "InputLimits", "UnfitFile", "open_regular", "parse_xml", "read_regular"]


@dataclass(frozen=True)
class InputLimits:
    """Limits of the input that is read: several times the largest that is known, and small enough for the memory.

    Attributes:
        count: Of what a user counts, nodes say: more take longer than anybody waits.
        array_entries: Of one array that a user gives.
        name_characters: Of the name of a link or joint.
        description_bytes: Of URDF and SRDF: the largest public ones have 1 MB.
        xml_elements: Elements and attributes of a document: each takes some 200 bytes of memory.
        mesh_bytes, mesh_text_bytes: Of a mesh; numbers in a text take several times their bytes while they are read.
        mesh_triangles: After all instances in a scene are placed.
        scene_nodes: Of a Collada scene, each counted as often as it is borrowed.
        text_bytes, text_lines, line_characters: Of waypoints, trajectories and G-code: a path takes 1 or 2 kB a line.
        number_characters: Of a number of G-code.
        task_bytes: Of a task or obstacle file.
        nesting: Containers within containers, nodes within nodes, parts of a name.
        tree_values: Values and keys of a JSON or YAML file.
        log_bytes: Of an MCAP file, and of all that it unpacks to.
        log_record_bytes: Of a record or chunk of it, unpacked.
        log_message_bytes: Of all its messages of joints, which take five times as much memory.
    """

    count: int = 100_000
    array_entries: int = 2**22
    name_characters: int = 500
    description_bytes: int = 2**23
    xml_elements: int = 2**20
    mesh_bytes: int = 2**28
    mesh_text_bytes: int = 2**26
    mesh_triangles: int = 2**22
    scene_nodes: int = 2**12
    text_bytes: int = 2**25
    text_lines: int = 500_000
    line_characters: int = 10_000
    number_characters: int = 32
    task_bytes: int = 2**20
    nesting: int = 64
    tree_values: int = 2**21
    log_bytes: int = 2**30
    log_record_bytes: int = 2**26
    log_message_bytes: int = 2**26


INPUT_LIMITS = InputLimits()


class UnfitFile(OSError):
    """A file that is not read: it is not a regular file, is too large, or is not the user's own.

    Attributes:
        value: The size in bytes of a file that is too large, else None. limit: The largest size that is read.
    """

    value: int | None = None
    limit: int | None = None


def open_regular(path: str | os.PathLike[str], most: int, own: bool = False, links: bool = True) -> BufferedReader:
    """Open a regular file of at most `most` bytes for reading.

    The file is looked at before it is opened, as opening a device may already do something. It is looked at again when
    it is open, as it may have been replaced meanwhile, and opening waits for nothing.

    Args:
        own: Whether only a file is opened that belongs to this user, that nobody else may write, and that is no link.
        links: Whether a link is followed.

    Raises:
        UnfitFile: It is a folder, a pipe, a socket or a device, is larger, or is not the user's own.
        OSError, ValueError: It cannot be opened.
    """
    name = os.fspath(path)
    follows = links and not own
    _check(os.stat(name, follow_symlinks=follows), name, most, False)
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY | (0 if follows else os.O_NOFOLLOW)
    stream = open(name, "rb", opener=lambda file, _: os.open(file, flags))  # noqa: SIM115
    try:
        _check(os.fstat(stream.fileno()), name, most, own)
    except BaseException:
        stream.close()
        raise
    return stream


def read_regular(path: str | os.PathLike[str], most: int, own: bool = False) -> bytes:
    """Return the contents of a regular file of at most `most` bytes; arguments and errors are those of `open_regular`.

    A file that grows while it is read, or whose size the system does not know, is held to the same limit.
    """
    with open_regular(path, most, own) as stream:
        data = stream.read(most + 1)
    if data is None:
        raise UnfitFile(errno.EAGAIN, "it has nothing to be read yet", str(path))
    _check_size(len(data), str(path), most)
    return data


def _check(status: os.stat_result, name: str, most: int, own: bool) -> None:
    if not stat.S_ISREG(status.st_mode):
        if stat.S_ISLNK(status.st_mode):
            raise UnfitFile(errno.ELOOP, "it is a link, which is not followed", name)
        code = errno.EISDIR if stat.S_ISDIR(status.st_mode) else errno.EINVAL
        raise UnfitFile(code, "it is no file, but a folder, a pipe or a device", name)
    if own and (status.st_uid != os.geteuid() or status.st_mode & 0o022):
        raise UnfitFile(errno.EPERM, "it belongs to somebody else, or others may write it", name)
    _check_size(status.st_size, name, most)


def _check_size(size: int, name: str, most: int) -> None:
    if size > most:
        error = UnfitFile(errno.EFBIG, f"it has {size} bytes, at most {most} are read", name)
        error.value, error.limit = size, most
        raise error


def parse_xml(data: str | bytes) -> ElementTree.Element:
    """Return the root element of an XML document.

    Raises:
        ElementTree.ParseError: It is not well-formed.
        ValueError, LookupError: It declares entities, has too many elements and attributes, or its
            encoding is unknown.
    """
    plain = data.encode(errors="surrogatepass") if isinstance(data, str) else data.replace(b"\0", b"")  # of UTF-16
    if b"<!ENTITY" in plain:
        raise ValueError("it declares entities, which are not read")
    count = plain.count(b"<") - plain.count(b"</") + plain.count(b"=")
    if count > INPUT_LIMITS.xml_elements:
        raise ValueError(f"it has {count} elements and attributes, at most {INPUT_LIMITS.xml_elements} are read")
    return ElementTree.fromstring(data)
