"""Safe reading of untrusted files, and a private disk cache of expensive results.

Only regular files of bounded size are read: opening a pipe would block, a device can be read without end, and opening
other special files may have side effects.

The cache folder is $XDG_CACHE_HOME/selfmotion, else ~/.cache/selfmotion. A value is stored in KEY.json after a digest
of the key and the value; the key includes the version of the code that computed it. A shared library is stored in
KEY.DIGEST.so. Missing, damaged and unwritable files are not errors: the result is computed again. A digest proves that
a file is complete, not who wrote it. So the cache uses only folders and files that this user owns and that nobody else
may write.
"""

from __future__ import annotations

import errno
import fcntl
import functools
import hashlib
import json
import logging
import os
import re
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from io import BufferedReader
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO, Any
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np


@dataclass(frozen=True)
class InputLimits:
    """Largest accepted sizes of files and other input, several times the sizes of the largest known files."""

    count: int = 1_000_000  # any number that a user chooses, such as a number of nodes
    array_entries: int = 2**22  # entries of one array
    name_characters: int = 500  # characters of a link or joint name
    description_bytes: int = 2**23  # bytes of a URDF, SRDF or MJCF file; the largest public ones have 1 MB
    xml_elements: int = 2**20  # elements plus attributes of an XML document, each about 200 bytes of memory
    mesh_bytes: int = 2**28  # bytes of a binary mesh file
    mesh_text_bytes: int = 2**26  # bytes of a text mesh file, whose parsing takes several times its size
    mesh_triangles: int = 2**22  # triangles of a scene after all instances are placed
    scene_nodes: int = 2**12  # nodes of a Collada scene, counted once per instance; parts of bodies in an MJCF file
    text_bytes: int = 2**25  # bytes of waypoint, trajectory and G-code files; a path takes 1 or 2 kB a line
    text_lines: int = 500_000  # lines of such a file
    line_characters: int = 10_000  # characters of a line of such a file
    number_characters: int = 32  # characters of a G-code number
    task_bytes: int = 2**20  # bytes of a task or obstacle file
    nesting: int = 64  # depth of nested containers, nodes and dotted names
    tree_values: int = 2**21  # values plus keys of a JSON or YAML file
    log_bytes: int = 2**30  # bytes of an MCAP file, also after decompression
    log_record_bytes: int = 2**26  # bytes of a decompressed MCAP record or chunk
    log_message_bytes: int = 2**26  # bytes of all joint messages of a log, which take five times as much memory


INPUT_LIMITS = InputLimits()


class UnfitFile(OSError):
    """Error about a file that is refused: it is not regular, is too large, or other users own or may change it."""

    value: int | None = None  # size of a file that is too large, bytes; else None
    limit: int | None = None  # largest size that is read, bytes; else None


def open_regular(path: str | os.PathLike[str], most: int, own: bool = False, links: bool = True) -> BufferedReader:
    """Open a regular file (no folder, pipe or device) of at most `most` bytes for reading.

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


UNBOUND_PREFIX = expat.errors.codes[expat.errors.XML_ERROR_UNBOUND_PREFIX]


def parse_xml(data: str | bytes, unbound: list[str] | None = None) -> ElementTree.Element:
    """Return the root element of an XML document, after checking that it declares no entities and is not too large.

    If a list `unbound` is given, elements (with all their contents) and attributes below the root whose namespace
    prefix is not declared are left out, and their names are appended to it.

    Raises:
        ElementTree.ParseError: The document is not well-formed.
        ValueError, LookupError: It declares entities, has too many elements and attributes, or its encoding is
            unknown.
    """
    content = data.encode(errors="surrogatepass") if isinstance(data, str) else data.replace(b"\0", b"")  # of UTF-16
    if b"<!ENTITY" in content:
        raise ValueError("it declares entities, which are not read")
    count = content.count(b"<") - content.count(b"</") + content.count(b"=")
    if count > INPUT_LIMITS.xml_elements:
        raise ValueError(f"it has {count} elements and attributes, at most {INPUT_LIMITS.xml_elements} are read")
    try:
        return ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        if unbound is None or error.code != UNBOUND_PREFIX:
            raise
        return _parse_bound(data, unbound, error)


def _parse_bound(data: str | bytes, unbound: list[str], refusal: ElementTree.ParseError) -> ElementTree.Element:
    """Return the root of an XML document after removing elements and attributes with undeclared namespace prefixes.

    The parser ignores namespaces; names are resolved here as the standard library's parser does.

    Args:
        data, unbound: As in `parse_xml`.
        refusal: Error that is raised if the prefix of the root is not declared.
    """
    uris = {"": [""], "xml": ["http://www.w3.org/XML/1998/namespace"]}  # by prefix; the innermost declaration is last
    open_elements: list[tuple[str, list[str]]] = []  # resolved tag, "" if left out; prefixes declared by the element
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()

    def resolved(name: str, default: str = "") -> str:
        prefix, colon, local = name.rpartition(":")
        uri = (uris.get(prefix) or [""])[-1] if prefix else default
        return f"{{{uri}}}{local}" if uri and (prefix or not colon) else "" if colon else name

    def start(tag: str, attributes: dict[str, str]) -> None:
        declared = {key[6:]: uri for key, uri in attributes.items() if key == "xmlns" or key.startswith("xmlns:")}
        for prefix, uri in declared.items():
            uris.setdefault(prefix, []).append(uri)
        kept = not open_elements or open_elements[-1][0]
        name = resolved(tag, uris[""][-1]) if kept else ""
        if not name and not open_elements:
            raise refusal
        open_elements.append((name, list(declared)))
        if name:
            names = {key: resolved(key) for key in attributes if key != "xmlns" and not key.startswith("xmlns:")}
            unbound.extend(key for key in names if not names[key])
            builder.start(name, {names[key]: attributes[key] for key in names if names[key]})
        elif kept:
            unbound.append(tag)

    def end(_: str) -> None:
        name, declared = open_elements.pop()
        for prefix in declared:
            uris[prefix].pop()
        if name:
            builder.end(name)

    def text(characters: str) -> None:
        if open_elements[-1][0]:
            builder.data(characters)

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, text
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        malformed = ElementTree.ParseError(str(error))
        malformed.code, malformed.position = error.code, (error.lineno, error.offset)
        raise malformed from None
    return builder.close()


MAX_VALUE_BYTES = 2**20
MAX_LIBRARY_BYTES = 2**28
"""Total size of the cached shared libraries, bytes, beyond which the least recently used are removed."""
KINDS = (".json", ".so", ".lock", ".part")
UNREADABLE = (OSError, ValueError, RuntimeError, RecursionError)
"""Exceptions that reading a missing or damaged cache file can raise; RuntimeError stands for a missing home folder."""


def cache_key(version: str, *contents: Any) -> str:
    """Return a SHA-256 digest of a code version, arrays and strings as the key under which their result is cached."""
    digest = hashlib.sha256(version.encode())
    for content in contents:
        data = np.frombuffer(content.encode(), np.uint8) if isinstance(content, str) else np.ascontiguousarray(content)
        digest.update(f"|{data.dtype.str}{data.shape}|".encode())
        digest.update(data.tobytes())
    return digest.hexdigest()


@functools.cache
def source_version(module: str) -> str:
    """Return a digest of the source of a module and of all modules of its package that it imports, even indirectly.

    Imports must be written `from PACKAGE... import`.
    """
    sources: dict[str, str] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in sources:
            continue
        loader: Any = getattr(find_spec(name), "loader", None)
        sources[name] = loader.get_source(name) or ""
        waiting += re.findall(rf"^\s*from ({module.partition('.')[0]}[\w.]*) import", sources[name], re.MULTILINE)
    return hashlib.sha256(repr(sorted(sources.items())).encode()).hexdigest()


def cache_folder() -> Path:
    """Return the path of the folder of cached results, which need not exist."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if Path(base).is_absolute() else Path("~/.cache").expanduser()) / "selfmotion"


def private_folder(make: bool = False) -> Path:
    """Return the folder of cached results, created if `make`, after checking that only this user can change it.

    Raises:
        OSError: There is no folder, it is a link, or another user may change it or a folder above it.
        RuntimeError: The user has no home folder.
    """
    place = cache_folder()
    if make:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
    reason = _unsafe(place)
    if reason:
        _log_once(f"the cache in {place} is not used: {reason}")
        raise PermissionError(errno.EPERM, reason, str(place))
    return place


def _unsafe(place: Path) -> str:
    """Return the reason why other users could change files in a folder, or an empty string if they cannot."""
    status, me = place.lstat(), os.geteuid()
    if not stat.S_ISDIR(status.st_mode):
        return "it is a link or not a folder; set XDG_CACHE_HOME to another folder"
    if status.st_uid != me:
        return f"it belongs to user {status.st_uid}; set XDG_CACHE_HOME to a folder of your own"
    if status.st_mode & 0o022:
        return f"other users may write it; empty it, then chmod 700 {place}"
    for above in {*place.parents, *place.resolve().parents}:
        status = above.lstat()
        writable = status.st_mode & (stat.S_ISVTX | 0o002) == 0o002 and not stat.S_ISLNK(status.st_mode)
        if writable or status.st_uid not in (me, 0, os.stat("/").st_uid):
            return f"other users may change {above}; set XDG_CACHE_HOME to a folder elsewhere"
    return ""


@functools.cache
def _log_once(message: str) -> None:
    logging.getLogger("models").warning(message)


def cache_files() -> list[Path]:
    """Return the paths of all files of the disk cache, including incomplete files that interrupted writes have left."""
    try:
        return sorted(file for file in private_folder().iterdir() if file.is_file() and file.suffix in KINDS)
    except UNREADABLE:
        return []


def load_value(key: str) -> Any:
    """Return the JSON value that the disk cache stores under a key, or None if the value is missing or damaged."""
    try:
        digest, _, content = read_regular(private_folder() / f"{key}.json", MAX_VALUE_BYTES, own=True).partition(b"\n")
        return json.loads(content) if digest == _digest(key, content) else None
    except UNREADABLE:
        return None


def store_value(key: str, value: Any) -> None:
    """Store a JSON value under a key in the disk cache, atomically; do nothing if it cannot be written."""
    with suppress(*UNREADABLE):
        content = json.dumps(value).encode()
        _write(f"{key}.json", _digest(key, content) + b"\n" + content)


def _digest(key: str, content: bytes) -> bytes:
    return hashlib.sha256(key.encode() + b"\n" + content).hexdigest().encode()


def load_library(key: str) -> Path | None:
    """Return the path of the shared library that the disk cache stores under a key, or None; mark the library as used.

    Damaged libraries are removed; those that another user owns or may write are ignored.
    """
    with suppress(*UNREADABLE):
        place = private_folder()
        for name in os.listdir(place):
            if not (name.startswith(key) and name.endswith(".so")):
                continue
            file = place / name
            with suppress(*UNREADABLE):
                if file.name == _library_name(key, read_regular(file, MAX_LIBRARY_BYTES, own=True)):
                    with suppress(OSError):
                        os.utime(file)
                    return file
                file.unlink()
    return None


def store_library(key: str, library: bytes) -> Path | None:
    """Store a shared library under a key in the disk cache and return its path; return None if it cannot be written."""
    with suppress(*UNREADABLE):
        file = _write(_library_name(key, library), library)
        _evict(file)
        return file
    return None


@contextmanager
def exclusive(key: str, poll: Callable[[], Any] = lambda: None) -> Iterator[None]:
    """Lock a cache key for a `with` block, so that only one process or thread at a time computes its value.

    If the lock file cannot be created, the block runs without a lock. `poll` is called every 20 ms while waiting and
    may raise to stop waiting.
    """
    lock = None
    with suppress(*UNREADABLE):
        lock = _open_locked(private_folder(make=True) / f"{key}.lock", poll)
    try:
        yield
    finally:
        if lock is not None:
            with lock, suppress(OSError):
                os.unlink(lock.name)
                fcntl.flock(lock, fcntl.LOCK_UN)  # else a process forked meanwhile would keep the lock


def _open_locked(file: Path, poll: Callable[[], Any]) -> IO[bytes]:
    """Open a lock file, creating it if necessary, and wait until this process holds the lock."""
    while True:
        stream = open(file, "ab")  # noqa: SIM115
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.stat(file), os.fstat(stream.fileno())):
                return stream
        except (BlockingIOError, FileNotFoundError):  # locked by another process, or removed by its last owner
            pass
        except BaseException:
            stream.close()
            raise
        stream.close()
        poll()
        time.sleep(0.02)


def _library_name(key: str, library: bytes) -> str:
    return f"{key}.{hashlib.sha256(library).hexdigest()[:16]}.so"


def _evict(newest: Path) -> None:
    """Remove lock files of ended processes, and the least recently used libraries beyond MAX_LIBRARY_BYTES."""
    for lock in newest.parent.glob("*.lock"):
        with suppress(OSError), open(lock, "rb") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises while the lock is in use
            lock.unlink()
    libraries = []
    for file in newest.parent.glob("*.so"):
        with suppress(OSError):
            status = file.stat()
            libraries.append((file == newest, status.st_mtime, status.st_size, file))
    total = sum(size for _, _, size, _ in libraries)
    for is_newest, _, size, file in sorted(libraries):
        if total <= MAX_LIBRARY_BYTES or is_newest:
            break
        with suppress(OSError):
            file.unlink()
            total -= size


def _write(name: str, content: bytes) -> Path:
    """Write a file with a given name and content into the folder of cached results atomically, and return its path."""
    place = private_folder(make=True)
    part = None
    try:
        with NamedTemporaryFile("wb", dir=place, suffix=".part", delete=False) as file:
            part = Path(file.name)
            file.write(content)
        return part.replace(place / name)
    except BaseException:
        if part is not None:
            part.unlink(missing_ok=True)
        raise
