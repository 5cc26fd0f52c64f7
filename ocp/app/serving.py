"""A page served on this machine alone, until Ctrl-C.

A request must name this machine as its host: the page of a stranger whose own name was made to lead here names another.
"""

from __future__ import annotations

import errno
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Event, Thread
from types import TracebackType
from typing import Self

from ocp.errors import ProblemError

__all__ = ["Served"]

TRIED = 20
"""Ports after the one that is wanted."""
HOST = "127.0.0.1"


class Served:
    """A page on a server, which runs as long as the block.

    Attributes:
        address: Where a browser finds it.
    """

    def __init__(self, text: str, port: int = 0) -> None:
        """Listen, on the port or the next that is free; 0 for any.

        Raises:
            ProblemError: No port is free, or it is none.
        """
        self._server = _listening(text.encode(), port)
        self.address = f"http://{HOST}:{self._server.server_address[1]}"
        self._thread = Thread(target=self._server.serve_forever, name="page", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._server.server_close()

    def wait(self) -> None:
        """Until Ctrl-C, which ends it and goes no further."""
        try:
            Event().wait()
        except KeyboardInterrupt:
            return


def _listening(page: bytes, port: int) -> ThreadingHTTPServer:
    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            known = (self.headers.get("Host") or "").rpartition(":")[0] in (HOST, "localhost")
            found = known and self.path.partition("?")[0] == "/"
            self.send_response(200 if found else 404 if known else 421)
            self.send_header("Content-Type", "text/html; charset=utf-8" if found else "text/plain")
            self.send_header("Content-Length", str(len(page) if found else 0))
            self.end_headers()
            if found:
                self.wfile.write(page)

        def log_message(self, *words: object) -> None:
            """Nothing: who serves a page to himself reads no log."""

    if not 0 <= port < 65536:
        raise ProblemError(f"port {port} is none, 0 to 65535", name="port", value=port, limit=(0, 65535))
    for tried in range(port, min(port + TRIED, 65536)) if port else (0,):
        try:
            return ThreadingHTTPServer((HOST, tried), Answer)
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
    words = f"no port from {port} to {port + TRIED - 1} is free; name another one: --port 0 takes any"
    raise ProblemError(words, name="port", value=port)
