"""A Hub that lies and fails on demand: a small HTTP server that speaks the Hub's API.
It serves ``StubRepository`` objects truthfully until a test plants a lie in one, or a fault that
answers the requests it matches instead."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit


def git_blob_id(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


@dataclass
class StubRepository:
    """A repository with one commit, and what it was before.

    Attributes:
        files: The true content by path.
        commit: The full commit that every ref names.
        earlier: The content at earlier commits, which no ref names.
        refs: The revisions that exist besides the commit.
        served: Lies: other bytes for a path than the listing says.
        listed: Lies: fields of the listing's entry of a path (``{"size": 3}``).
        truncated: Paths whose download ends half way.
        head_headers: Further headers of the answers to HEAD and GET of files.
        token: Without it there is no such repository.
        gated: Without a token there are no files, but all else.
    """

    files: dict[str, bytes]
    commit: str = "c0ffee" + "0" * 34
    earlier: dict[str, dict[str, bytes]] = field(default_factory=dict)
    refs: set[str] = field(default_factory=lambda: {"main"})
    served: dict[str, bytes] = field(default_factory=dict)
    listed: dict[str, dict[str, Any]] = field(default_factory=dict)
    truncated: set[str] = field(default_factory=set)
    head_headers: dict[str, str] = field(default_factory=dict)
    token: str = ""
    gated: bool = False

    def at(self, revision: str) -> StubRepository:
        if revision not in self.earlier:
            return self
        return replace(self, commit=revision, files=self.earlier[revision])

    def tree(self) -> list[dict[str, Any]]:
        parents = (PurePosixPath(path).parents for path in self.files)
        folders = {str(parent) for above in parents for parent in above} - {".", "/"}
        rows: list[dict[str, Any]] = [
            {"type": "directory", "oid": "d" * 40, "size": 0, "path": path}
            for path in sorted(folders)
        ]
        for path, content in self.files.items():
            row = {"type": "file", "oid": git_blob_id(content), "size": len(content), "path": path}
            rows.append({**row, **self.listed.get(path, {})})
        return rows


@dataclass
class Fault:
    """An answer for requests that match, instead of the true one.

    Attributes:
        pattern: A regular expression that is searched in ``"GET /path"``.
        status: The HTTP status; 0 closes the connection without an answer.
        headers: Further headers (``X-Error-Code``).
        stall: Hold the request until the stub is stopped.
        times: How many requests get it; -1 is all.
        pieces: The body, in chunks; what of it was taken is counted in ``StubHub.sent``.
    """

    pattern: str
    status: int = 500
    headers: Mapping[str, str] = field(default_factory=dict)
    stall: bool = False
    times: int = -1
    pieces: Callable[[], Iterable[bytes]] | None = None


class StubHub:
    """The server. Use as a context manager; ``endpoint`` is what huggingface_hub takes."""

    def __init__(self) -> None:
        self.repositories: dict[tuple[str, str], StubRepository] = {}
        self.faults: list[Fault] = []
        self.requests: list[str] = []
        self.authorizations: list[str | None] = []
        self.page_size: int | None = None
        self.sent = 0
        self.stopped = threading.Event()
        self.noting = threading.Lock()
        hub = self

        class Handler(_Handler):
            stub = hub

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.endpoint = f"http://127.0.0.1:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))

    def __enter__(self) -> StubHub:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        if not self.stopped.is_set():
            self.stopped.set()
            self._server.shutdown()
            self._server.server_close()
            self._thread.join()

    def add(
        self, repo_id: str, files: Mapping[str, bytes | str], repo_type: str = "model"
    ) -> StubRepository:
        content = {p: c.encode() if isinstance(c, str) else c for p, c in files.items()}
        repository = StubRepository(content)
        self.repositories[repo_type, repo_id] = repository
        return repository

    def fail(self, pattern: str, status: int = 500, **rest: Any) -> Fault:
        fault = Fault(pattern, status, **rest)
        self.faults.append(fault)
        return fault

    def fault_for(self, request: str) -> Fault | None:
        for fault in self.faults:
            if fault.times != 0 and re.search(fault.pattern, request):
                fault.times -= 1
                return fault
        return None


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    stub: StubHub

    def do_GET(self) -> None:
        self._answer()

    def do_HEAD(self) -> None:
        self._answer()

    def log_message(self, *_: object) -> None:
        pass

    def _answer(self) -> None:
        request = f"{self.command} {self.path}"
        with self.stub.noting:  # clients ask for several things at once; who asked with what?
            self.stub.requests.append(request)
            self.stub.authorizations.append(self.headers.get("authorization"))
            fault = self.stub.fault_for(request)
        if fault is not None:
            self._misbehave(fault)
            return
        split = urlsplit(self.path)
        steps = [unquote(step) for step in split.path.strip("/").split("/")]
        if steps[0] == "api":
            self._answer_api(steps[1:], parse_qs(split.query))
        else:
            self._answer_file(steps)

    def _misbehave(self, fault: Fault) -> None:
        if fault.stall:
            self.stub.stopped.wait()
        if fault.stall or fault.status == 0:
            self.close_connection = True
            return
        if fault.pieces is not None:
            self._send_pieces(fault.status, fault.pieces(), fault.headers)
            return
        self._send(fault.status, b'{"error": "planted"}', dict(fault.headers))

    def _send_pieces(
        self, status: int, pieces: Iterable[bytes], headers: Mapping[str, str]
    ) -> None:
        self.send_response(status)
        for name, value in {**headers, "Transfer-Encoding": "chunked"}.items():
            self.send_header(name, value)
        self.end_headers()
        self.close_connection = True
        with contextlib.suppress(OSError):  # the client has had enough
            for piece in pieces:
                self.wfile.write(b"%x\r\n%b\r\n" % (len(piece), piece))
                self.stub.sent += len(piece)
            self.wfile.write(b"0\r\n\r\n")

    def _send(self, status: int, body: bytes, headers: Mapping[str, str] | None = None) -> None:
        self.send_response(status)
        fields = {"Content-Length": str(len(body)), **(headers or {})}
        for name, value in fields.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def _absent(self, code: str, status: int = 404) -> None:
        self._send(status, b"{}", {"X-Error-Code": code, "X-Error-Message": code})

    def _answer_api(self, steps: list[str], query: dict[str, list[str]]) -> None:
        repo_type, repo_id, rest = steps[0].removesuffix("s"), "/".join(steps[1:3]), steps[3:]
        repository = self.stub.repositories.get((repo_type, repo_id))
        if repository is None or not self._may_see(repository):
            self._absent("RepoNotFound", 401)
        elif len(rest) > 1 and not self._known(repository, rest[1]):
            self._absent("RevisionNotFound")
        elif rest and rest[0] == "tree":
            self._answer_tree(repository.at(rest[1]), query)
        else:
            self._answer_info(repository.at(rest[-1]) if rest else repository, repo_id)

    def _may_see(self, repository: StubRepository) -> bool:
        return self.headers.get("authorization", "").endswith(repository.token)

    def _known(self, repository: StubRepository, revision: str) -> bool:
        known = revision in repository.refs or revision in repository.earlier
        return known or repository.commit.startswith(revision)

    def _answer_info(self, repository: StubRepository, repo_id: str) -> None:
        siblings = [{"rfilename": path} for path in repository.files]
        info = {"id": repo_id, "sha": repository.commit, "siblings": siblings, "tags": []}
        info |= {
            "private": False,
            "gated": repository.gated,
            "disabled": False,
            "lastModified": "2024-05-31T12:00:00.000Z",
            "downloads": 0,
            "likes": 0,
        }
        self._send(200, json.dumps(info).encode(), {"Content-Type": "application/json"})

    def _answer_tree(self, repository: StubRepository, query: dict[str, list[str]]) -> None:
        rows, start = repository.tree(), int(query.get("cursor", ["0"])[0])
        size = self.stub.page_size or len(rows) or 1
        headers = {"Content-Type": "application/json"}
        if start + size < len(rows):
            # Another host: a client that follows it would hand over its token.
            path = urlsplit(self.path).path
            following = f"http://elsewhere.invalid{path}?recursive=true&cursor={start + size}"
            headers["Link"] = f'<{following}>; rel="next"'
        self._send(200, json.dumps(rows[start : start + size]).encode(), headers)

    def _answer_file(self, steps: list[str]) -> None:
        repo_type = steps[0].removesuffix("s") if steps[0] in ("spaces", "datasets") else "model"
        steps = steps if repo_type == "model" else steps[1:]
        named = self.stub.repositories.get((repo_type, "/".join(steps[:2])))
        repository = named and named.at("".join(steps[3:4]))
        path = "/".join(steps[4:])
        if repository is None or not self._may_see(repository):
            self._absent("RepoNotFound", 401)
        elif repository.gated and "authorization" not in self.headers:
            self._absent("GatedRepo", 401)
        elif path not in repository.files:
            self._absent("EntryNotFound")
        else:
            self._send_file(repository, path)

    def _send_file(self, repository: StubRepository, path: str) -> None:
        body = repository.served.get(path, repository.files[path])
        etag = repository.listed.get(path, {}).get("oid") or git_blob_id(repository.files[path])
        headers = {"X-Repo-Commit": repository.commit, "ETag": f'"{etag}"'}
        headers |= repository.head_headers
        if path in repository.truncated and self.command == "GET":
            headers["Content-Length"] = str(len(body))
            body = body[: len(body) // 2]
            self.close_connection = True
        self._send(200, body, headers)
