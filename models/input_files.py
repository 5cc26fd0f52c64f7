"""Input files from anybody: regular files alone, none beyond a limit, and XML without entities.

A pipe would be waited for, a device read without end, and a file of another kind may do something when it is opened.
"""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader
from xml.etree import ElementTree

__all__ = ["MOST_ELEMENTS", "UnfitFile", "open_regular", "parse_xml", "read_regular"]

MOST_ELEMENTS = 2**20
"""Elements and attributes of an XML document: each takes some 200 bytes of memory."""


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
        ValueError, LookupError: It declares entities, has more than MOST_ELEMENTS elements and attributes, or its
            encoding is unknown.
    """
    plain = data.encode(errors="surrogatepass") if isinstance(data, str) else data.replace(b"\0", b"")  # of UTF-16
    if b"<!ENTITY" in plain:
        raise ValueError("it declares entities, which are not read")
    count = plain.count(b"<") - plain.count(b"</") + plain.count(b"=")
    if count > MOST_ELEMENTS:
        raise ValueError(f"it has {count} elements and attributes, at most {MOST_ELEMENTS} are read")
    return ElementTree.fromstring(data)
