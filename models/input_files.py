"""Safe reading of untrusted input files: regular files only, bounded size, XML without entities.

Opening a pipe would block, a device can be read without end, and opening other special files may have side effects.
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
    """Limits on input: several times the largest known files, and small enough for the available memory.

    Attributes:
        count: Any number that a user chooses, such as a number of nodes; larger values would run too long.
        array_entries: Entries of one array.
        name_characters: Characters of a link or joint name.
        description_bytes: Bytes of a URDF or SRDF file. The largest public ones have 1 MB.
        xml_elements: Elements plus attributes of an XML document. Each takes about 200 bytes of memory.
        mesh_bytes, mesh_text_bytes: Bytes of a binary and a text mesh file. Parsing text takes several times its size.
        mesh_triangles: Triangles of a scene after all instances are placed.
        scene_nodes: Nodes of a Collada scene, counted once per instance.
        text_bytes, text_lines, line_characters: Size of waypoint, trajectory and G-code files. A path takes 1 or 2 kB a
            line.
        number_characters: Characters of a G-code number.
        task_bytes: Bytes of a task or obstacle file.
        nesting: Depth of nested containers, nodes and dotted names.
        tree_values: Values plus keys of a JSON or YAML file.
        log_bytes: Bytes of an MCAP file, also after decompression.
        log_record_bytes: Bytes of a decompressed MCAP record or chunk.
        log_message_bytes: Bytes of all joint messages of a log, which take five times as much memory.
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
    """A file that is not read: it is not a regular file, is too large, or is not owned by the user.

    Attributes:
        value: Size of a file that is too large, bytes; else None.
        limit: Largest size that is read, bytes; else None.
    """

    value: int | None = None
    limit: int | None = None


def open_regular(path: str | os.PathLike[str], most: int, own: bool = False, links: bool = True) -> BufferedReader:
    """Open a regular file of at most `most` bytes for reading.

    The file is checked before opening, because opening a device may have side effects, and again afterwards, because it
    may have been replaced meanwhile. Opening never blocks.

    Args:
        own: Open only a file that belongs to this user, that nobody else may write, and that is not a link.
        links: Follow symbolic links.

    Raises:
        UnfitFile: A folder, pipe, socket or device, a file that is too large, or one that is not the user's own.
        OSError, ValueError: The file cannot be opened.
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

    The limit also holds for a file that grows while it is read, and for one of unknown size.
    """
    with open_regular(path, most, own) as stream:
        data = stream.read(most + 1)
    if data is None:
        raise UnfitFile(errno.EAGAIN, "it has no data yet", str(path))
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
        ElementTree.ParseError: The document is not well-formed.
        ValueError, LookupError: It declares entities, has too many elements and attributes, or its encoding is unknown.
    """
    content = (
        data.encode(errors="surrogatepass") if isinstance(data, str) else data.replace(b"\0", b"")
    )  # NUL bytes of UTF-16
    if b"<!ENTITY" in content:
        raise ValueError("it declares entities, which are not read")
    count = content.count(b"<") - content.count(b"</") + content.count(b"=")
    if count > INPUT_LIMITS.xml_elements:
        raise ValueError(f"it has {count} elements and attributes, at most {INPUT_LIMITS.xml_elements} are read")
    return ElementTree.fromstring(data)
