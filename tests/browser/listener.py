"""Servers on loopback: one that is told what a page runs and loads, and one of a folder."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

_PAGES = "pages"


class _Server(ThreadingHTTPServer):
    request_queue_size = 512  # a page of a hundred texts asks for all of them at once

    def handle_error(self, request: object, client_address: object) -> None:
        """A page that leads elsewhere hangs up."""


class Listener:
    """A server of pages, which notes whatever else it is asked for.

    A page is served, as one that lies beside it may load more than one from a disk.

    Attributes:
        asked: ``AT/NAME`` of each thing that was asked for.
        pages: Kind and content of each page, by name.
        root: Its address.
    """

    def __init__(self) -> None:
        self.asked: set[str] = set()
        self.pages: dict[str, tuple[str, bytes]] = {}
        listener = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                """Give a page, or note what is asked for."""
                path = self.path.partition("?")[0].strip("/")
                folder, _, name = path.partition("/")
                page = listener.pages.get(name) if folder == _PAGES else None
                if page is None:
                    listener.asked.add(path)
                kind, content = page or ("text/plain", b"")
                self.send_response(200 if page else 404)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                self.wfile.write(content)

            do_POST = do_GET

            def log_message(self, *_: object) -> None:
                """Say nothing."""

        self._server = _Server(("127.0.0.1", 0), Handler)
        self.root = f"http://127.0.0.1:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def serve(self, name: str, content: bytes, kind: str = "text/html; charset=utf-8") -> str:
        """The address of a page."""
        self.pages[name] = kind, content
        return f"{self.root}/{_PAGES}/{name}"

    def asked_by(self, page: str) -> set[str]:
        """What one page asked for, by the names of the texts."""
        prefix = f"{page}/"
        return {one.removeprefix(prefix) for one in tuple(self.asked) if one.startswith(prefix)}

    def close(self) -> None:
        """Listen no more."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Say nothing."""


@contextmanager
def serving(folder: Path) -> Iterator[str]:
    """The address of a folder's files."""
    handler = partial(_Quiet, directory=str(folder))
    with _Server(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()
