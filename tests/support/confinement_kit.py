"""Runs Python source in a runner of a real jail, and the same source without one as the control."""

import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from envhub_worker.lockdown.spec import JailSpec
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.spawn.jail import Jail, RunnerExited, RunnerStarted
from envhub_worker.spawn.spawner import JailExited, Spawner, ZygoteDied

DEADLINE_S = 60.0
KIT = os.path.abspath(__file__)
TARGET = f"{KIT}:serve_source"


def execute(source: str) -> dict[str, Any]:
    """Run ``source``; its ``result``, or the error's class, errno and text."""
    names = {"__name__": "probe"}
    try:
        exec(source, names)
    except BaseException as error:
        number = getattr(error, "errno", None)
        return {"error": type(error).__name__, "errno": number, "text": str(error)}
    return {"result": names.get("result")}


def serve_source(stream: socket.socket, spec: JailSpec, fds: list[int]) -> int:
    """In the runner: answer one line of JSON (source) with one line of JSON, until the end."""
    global STREAM, FDS
    STREAM, FDS = stream, fds
    with stream.makefile("rw") as lines:
        for line in lines:
            lines.write(json.dumps(execute(json.loads(line))) + "\n")
            lines.flush()
    return 0


def unconfined(source: str) -> dict[str, Any]:
    """The control: ``source`` in a plain interpreter as the current user."""
    import inspect  # not above, where each runner would import it, too

    code = f"from __future__ import annotations\nimport json, sys\n{inspect.getsource(execute)}"
    code += "\nprint(json.dumps(execute(sys.stdin.read())))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=source,
        capture_output=True,
        text=True,
        check=True,
        cwd=os.path.dirname(KIT),
        timeout=DEADLINE_S,
    )
    return json.loads(done.stdout.splitlines()[-1])


class Cell:
    """A jail and what is known of it. Not an API: a test's convenience."""

    def __init__(self, spawner: Spawner, jail: Jail) -> None:
        self.spawner = spawner
        self.jail = jail
        self.events: list[Any] = []
        self.output = b""
        self.streams: dict[int, Any] = {}

    def start(self, fds: tuple[int, ...] = ()) -> int:
        runner, stream = self.jail.start_runner(fds)
        stream.settimeout(DEADLINE_S)
        self.streams[runner] = stream.makefile("rw")
        stream.close()
        return runner

    def run(self, source: str, runner: int = 1) -> dict[str, Any]:
        lines = self.streams[runner]
        lines.write(json.dumps(source) + "\n")
        lines.flush()
        try:
            answer = lines.readline()
        except ConnectionError:
            answer = ""
        return json.loads(answer or '{"error": "the runner has gone"}')

    def hang_up(self, runner: int = 1) -> None:
        self.streams.pop(runner).close()

    def pump(self, timeout_s: float = 0.05) -> None:
        poller = select.poll()
        for fd in (self.spawner.fileno(), self.jail.fileno(), self.jail.output):
            if fd >= 0:
                poller.register(fd, select.POLLIN)
        poller.poll(timeout_s * 1000)
        self.events += self.spawner.poll() + self.jail.poll()
        try:
            while data := os.read(self.jail.output, 65536):
                self.output += data
        except BlockingIOError:
            pass

    def wait_for(self, kind: type) -> Any:
        deadline = time.monotonic() + DEADLINE_S
        while time.monotonic() < deadline:
            for event in self.events:
                if isinstance(event, kind):
                    return event
            died = [event for event in self.events if isinstance(event, ZygoteDied)]
            assert not died, died
            self.pump()
        raise AssertionError(f"no {kind.__name__} in {self.events}, output {self.output!r}")

    def wait_for_output(self, text: bytes) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while text not in self.output:
            assert time.monotonic() < deadline, self.output
            self.pump()


@contextmanager
def spawner_in(folder: Path, confinement: Confinement, **options: Any) -> Iterator[Spawner]:
    """A spawner whose runners run ``serve_source``."""
    options.setdefault("target", TARGET)
    confinement = with_kit(confinement)
    options.setdefault("readable_roots", [str(folder)])
    spawner = Spawner(confinement, runtime_dir=folder, **options)
    try:
        yield spawner
    finally:
        spawner.close()


def with_kit(confinement: Confinement) -> Confinement:
    """The same, and the jail may read this file."""
    return replace(confinement, readable=(*confinement.readable, KIT))


@contextmanager
def open_folder(place: str | None = None) -> Iterator[Path]:
    """A folder that other users may cross, unlike pytest's: under root a jail is another user."""
    with tempfile.TemporaryDirectory(prefix="confinement-", dir=place) as name:
        os.chmod(name, 0o755)
        yield Path(name)


def make_snapshot(folder: Path, link: str | None = None) -> str:
    """A tiny snapshot below ``folder``, read-only as in a store; ``link`` is where one leads."""
    snapshot = folder / "snapshot"
    (snapshot / "assets").mkdir(parents=True)
    (snapshot / "env.py").write_text("VALUE = 7\n")
    (snapshot / "assets" / "a.txt").write_text("asset")
    if link is not None:
        (snapshot / "link").symlink_to(link)
    for name, mode in (("env.py", 0o444), ("assets/a.txt", 0o444), ("assets", 0o555), (".", 0o555)):
        (snapshot / name).chmod(mode)
    return str(snapshot)


@contextmanager
def cell_in(folder: Path, confinement: Confinement, **options: Any) -> Iterator[Cell]:
    """A cell with one runner that runs what it is told."""
    with spawner_in(folder, confinement, **options) as spawner:
        cell = new_cell(spawner, make_snapshot(folder), confinement)
        cell.start()
        yield cell
        cell.jail.kill()


def new_cell(spawner: Spawner, snapshot: str, confinement: Confinement) -> Cell:
    """A further jail of ``spawner``, without runners."""
    spec = JailSpec(snapshot=snapshot, entry="env.py", confinement=with_kit(confinement))
    return Cell(spawner, spawner.spawn(spec))


def wait_until(condition: Any, what: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)


__all__ = [
    "KIT",
    "Cell",
    "JailExited",
    "RunnerExited",
    "RunnerStarted",
    "cell_in",
    "execute",
    "make_snapshot",
    "new_cell",
    "open_folder",
    "serve_source",
    "spawner_in",
    "unconfined",
    "wait_until",
]
