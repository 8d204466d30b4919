"""A package index on loopback, of wheels that are made here: no network, and nothing large."""

import base64
import hashlib
import html
import json
import os
import threading
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.extras.packages.resolution.pylock import Lock, PylockPackage, Wheel
from tests.support.ports import QuietHandler, serving

WORKERS = {"cloudpickle": "3.1.0", "gymnasium": "1.2.0", "msgpack": "1.1.0", "numpy": "2.1.0"}
"""Versions of what the worker imports, which stand-ins of these names have."""
GYMNASIUMS = ("farama-notifications", "typing-extensions")
"""What Gymnasium needs besides."""


def make_wheel(
    folder: Path,
    name: str,
    version: str = "1.0",
    files: Mapping[str, str | bytes] | None = None,
    requires: Sequence[str] = (),
    *,
    tag: str = "py3-none-any",
    python: str = "",
) -> Path:
    distribution = name.replace("-", "_")
    given = {f"{distribution}/__init__.py": f"VERSION = {version!r}\n"} if files is None else files
    info = f"{distribution}-{version}.dist-info"
    lines = ["Metadata-Version: 2.1", f"Name: {name}", f"Version: {version}"]
    lines += [f"Requires-Dist: {one}" for one in requires]
    lines += [f"Requires-Python: {python}"] if python else []
    contents = {path: one.encode() if isinstance(one, str) else one for path, one in given.items()}
    contents[f"{info}/METADATA"] = "\n".join([*lines, "", ""]).encode()
    contents[f"{info}/WHEEL"] = (
        f"Wheel-Version: 1.0\nGenerator: tests\nRoot-Is-Purelib: true\nTag: {tag}\n".encode()
    )
    path = folder / f"{distribution}-{version}-{tag}.whl"
    _write(path, contents, info)
    return path


_LEFT_OUT = {"__pycache__", "tests", "f2py", "distutils", "include", "box2d", "mujoco", "toy_text"}
"""Folders of numpy and Gymnasium that are half of their files, and that no jail of ours imports."""


def repacked(folder: Path, name: str) -> Path:
    """A wheel of what is installed here under this name, as far as a jail needs it."""
    found = metadata.distribution(name)
    contents = {}
    for file in found.files or ():
        path = Path(str(found.locate_file(file)))
        if not {*file.parts} & {"..", *_LEFT_OUT} and path.is_file():
            contents[str(file)] = path.read_bytes()
    info = next(part for part in contents if part.endswith(".dist-info/METADATA")).split("/")[0]
    for extra in ("RECORD", "INSTALLER", "REQUESTED", "direct_url.json"):
        contents.pop(f"{info}/{extra}", None)
    lines = contents[f"{info}/WHEEL"].decode().splitlines()
    tags = [line[5:] for line in lines if line[:5] == "Tag: "]
    distribution = info.removesuffix(".dist-info")
    path = folder / f"{distribution}-{tags[0]}.whl"
    _write(path, contents, info)
    return path


def _write(path: Path, contents: Mapping[str, bytes], info: str) -> None:
    rows = []
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, data in contents.items():
            archive.writestr(name, data)
            digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
            rows.append(f"{name},sha256={digest},{len(data)}")
        archive.writestr(f"{info}/RECORD", "\n".join([*rows, f"{info}/RECORD,,", ""]))


def stand_ins(folder: Path) -> None:
    """Wheels of all that the worker needs, with nothing in them."""
    for name, version in WORKERS.items():
        make_wheel(folder, name, version)


@dataclass
class Index:
    """What is served.

    Attributes:
        folder: Its wheels and source distributions.
        url: The index, for ``UV_DEFAULT_INDEX``.
        asked: Paths of all requests so far.
        yanked: Names of files that were taken back.
        replaced: What is sent instead of a file, by its name; its hash stays that of the file.
        broken: Answers everything with this status, if it is one.
        uploaded: Days of files, by name; of others it says none.
    """

    folder: Path
    url: str = ""
    asked: list[str] = field(default_factory=list)
    yanked: set[str] = field(default_factory=set)
    replaced: dict[str, bytes] = field(default_factory=dict)
    broken: int = 0
    uploaded: dict[str, str] = field(default_factory=dict)
    _held_prefix: str = ""
    _waiting: threading.Event = field(default_factory=threading.Event)
    _free: threading.Event = field(default_factory=threading.Event)

    def hold(self, prefix: str) -> None:
        """Answer no request of this kind before ``let_go``."""
        self._held_prefix = prefix

    def held(self) -> bool:
        """Whether somebody waits for such an answer."""
        return self._waiting.is_set()

    def let_go(self) -> None:
        self._free.set()

    def page(self, name: str) -> bytes | None:
        rows, files = list[str](), list[dict[str, Any]]()
        for path in sorted(self.folder.iterdir()):
            if path.name.split("-")[0].lower().replace("_", "-") == name:
                digest = hashlib.sha256(path.read_bytes()).hexdigest()
                mark = ' data-yanked="broken"' if path.name in self.yanked else ""
                link = f"/files/{html.escape(path.name)}#sha256={digest}"
                rows.append(f'<a href="{link}"{mark}>{html.escape(path.name)}</a><br>')
                size = path.stat().st_size
                known = {
                    "filename": path.name,
                    "url": link,
                    "hashes": {"sha256": digest},
                    "size": size,
                }
                day = self.uploaded.get(path.name)
                files.append(known | ({"upload-time": f"{day}T00:00:00Z"} if day else {}))
        if self.uploaded and files:
            return json.dumps(
                {"meta": {"api-version": "1.1"}, "name": name, "files": files}
            ).encode()
        return "\n".join(["<!DOCTYPE html><html><body>", *rows]).encode() if rows else None

    def answer(self, path: str) -> bytes | None:
        """What a request gets; None for nothing."""
        self.asked.append(path)
        if self._held_prefix and path.startswith(self._held_prefix):
            self._waiting.set()
            self._free.wait()
        kind, _, name = path.strip("/").partition("/")
        if kind == "simple":
            return self.page(name.strip("/"))
        if name in self.replaced:
            return self.replaced[name]
        file = self.folder / name
        return file.read_bytes() if kind == "files" and file.is_file() else None


@contextmanager
def served(folder: Path) -> Iterator[Index]:
    index = Index(folder)

    class Handler(QuietHandler):
        def do_GET(self) -> None:
            body = None if index.broken else index.answer(self.path)
            self.send_response(index.broken or (200 if body is not None else 404))
            kind = "application/vnd.pypi.simple.v1+json" if index.uploaded else "text/html"
            page = self.path.startswith("/simple")
            self.send_header("Content-Type", kind if page else "application/octet-stream")
            self.send_header("Content-Length", str(len(body or b"")))
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(body or b"")

        do_HEAD = do_GET

    with serving(Handler) as where:
        index.url = f"{where}/simple"
        try:
            yield index
        finally:
            index.let_go()


@contextmanager
def only_index(folder: Path, wheels: Path) -> Iterator[Index]:
    """An index that is the only one that this process knows, and empty caches in a folder."""
    with served(wheels) as found, pytest.MonkeyPatch.context() as patch:
        for name in [name for name in os.environ if name.startswith(("UV_", "PIP_"))]:
            patch.delenv(name)
        for name, value in {
            "UV_DEFAULT_INDEX": found.url,
            "UV_CACHE_DIR": str(folder / "uv"),
            "UV_HTTP_RETRIES": "0",
            "UV_HTTP_TIMEOUT": "600",
            "ENVHUB_CACHE": str(folder / "cache"),
            "NO_PROXY": "127.0.0.1",
            "no_proxy": "127.0.0.1",
        }.items():
            patch.setenv(name, value)
        yield found


@pytest.fixture
def index(tmp_path: Path) -> Iterator[Index]:
    """One with stand-ins of what the worker needs."""
    folder = tmp_path / "wheels"
    folder.mkdir()
    stand_ins(folder)
    with only_index(tmp_path, folder) as found:
        yield found


@pytest.fixture(scope="module")
def real_index(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Index]:
    """One with what the worker needs, as it is installed here: a jail can run with it."""
    folder = tmp_path_factory.mktemp("real")
    wheels = folder / "wheels"
    wheels.mkdir()
    for name in (*WORKERS, *GYMNASIUMS):
        repacked(wheels, name)
    with only_index(folder, wheels) as found:
        yield found


def locked(*pins: str, sha256: str = "0" * 64) -> Lock:
    """A lock of packages that are only named."""
    rows = (pin.split("==") for pin in pins)
    return Lock(tuple(PylockPackage(*row, (Wheel(sha256),)) for row in rows))
