"""Smuggling open files in and out of a jail."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from envhub_sandbox import snapshot_store
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.sandboxes.process import PROCESS
from tests.attacks.harness import (
    Arena,
    Run,
    call,
    control_run,
    new_alias,
    start_control,
    token,
)
from tests.support.processes import eventually

FAMILY = "Open files"
PATIENCE = 3000
"""Requests in which the server must have noticed the noise."""


@pytest.fixture
def inherited(home: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A secret file that is open here, and marked for children to inherit; a server since then."""
    secret = token()
    (home / "private").write_text(secret)
    fd = os.open(home / "private", os.O_RDONLY)
    os.set_inheritable(fd, True)
    monkeypatch.setenv("ENVHUB_CACHE", str(home / "cache"))
    server = PROCESS.acquire(snapshot_store.cache_root() / "snapshots")
    yield secret
    PROCESS.release(server)
    os.close(fd)


def test_open_files_are_not_inherited(arena: Arena, inherited: str) -> None:
    """What the client has open, even for children to inherit, no jail is born with."""
    alias = new_alias()
    process = start_control("inherited_descriptors", {}, alias, close_fds=False)
    answer, _ = process.communicate(b"\n")
    assert inherited.encode() in answer, "the control of inheriting failed"
    with arena.inside("inherited_descriptors", {}) as run:
        arena.judge("read inherited descriptors", "succeeds", inherited in run.text, run.text)


def test_descriptors_cannot_be_pushed_into_the_server(arena: Arena, home: Path) -> None:
    """What a jail attaches to its messages is never received: the server's table does not grow."""
    name = f"pushed-{token()[:8]}"
    path = home / "receiver"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen()
        with control_run("send_descriptor", {"name": name, "path": str(path)}):
            peer, _ = listener.accept()
            with peer:
                _, fds, _, _ = socket.recv_fds(peer, 16, 8)
            received = [os.readlink(f"/proc/self/fd/{fd}") for fd in fds]
            for fd in fds:
                os.close(fd)
    assert any(name in link for link in received), "the control of pushing failed"
    with arena.environment() as other:
        other.reset()
        with arena.environment() as env:
            run = Run(new_alias(), True)
            call(env, run, "send_descriptor", {"name": name, "path": ""})
            held = [link for process in servers() for link in open_files(process)]
        other.reset()
    pushed = any(name in link for link in held)
    arena.judge("push descriptors over the stream (SCM_RIGHTS)", "succeeds", pushed, run.text)


def open_files(pid: int) -> list[str]:
    """What a process has open."""
    links = []
    for fd in os.listdir(f"/proc/{pid}/fd"):
        try:
            links.append(os.readlink(f"/proc/{pid}/fd/{fd}"))
        except OSError:
            continue
    return links


@pytest.mark.parametrize(
    "noise",
    [
        pytest.param(b"\xff" * 4096, id="ff"),
        pytest.param(b"\0" * 4096, id="zeros"),
        pytest.param(b"GET / HTTP/1.1\r\n\r\n" * 100, id="http"),
        pytest.param(
            (1).to_bytes(4, "little") + b"\0" * 4 + (1).to_bytes(8, "little") + b"\xff" * 8,
            id="endless-frame",
        ),
        pytest.param(
            (4096).to_bytes(4, "little")
            + b"\0" * 4
            + (1).to_bytes(8, "little")
            + (1 << 27).to_bytes(8, "little") * 4096,
            id="huge-frames",
        ),
        pytest.param(
            (1).to_bytes(4, "little") + b"\0" * 4 + (99).to_bytes(8, "little") + b"\1" + b"\0" * 8,
            id="unasked-answer",
        ),
    ],
)
def test_noise_on_the_stream_ends_only_its_jail(arena: Arena, noise: bytes) -> None:
    """A jail that writes past our code to its stream is killed; server and neighbours go on."""
    with arena.environment() as other:
        other.reset()
        with arena.environment() as env:
            env.reset()
            before = [psutil.Process(pid).memory_info().rss for pid in servers()]
            run = Run(new_alias(), True)
            with pytest.raises(EnvHubError) as caught:
                make_noise(env, noise, run)
            after = [psutil.Process(pid).memory_info().rss for pid in servers()]
            assert eventually(lambda: not run.pids()), "the noisy jail lives on"
        other.step([0])
    grown = max(late - early for late, early in zip(after, before, strict=True))
    text = str(caught.value)
    through = grown > 64 << 20 or "rules" not in text
    arena.judge("write noise to the stream", "succeeds", through, f"{text} (grew {grown})")


def make_noise(env: Any, noise: bytes, run: Run) -> None:
    """Until its jail's death is met: the answer itself may have come another way before it."""
    env.call("attack", "garbage_on_streams", {"data": noise.hex()}, run.alias)
    for _ in range(PATIENCE):
        env.get_attr("render_mode")
        time.sleep(0.01)


def servers() -> list[int]:
    """This process and the worker servers."""
    return [os.getpid(), *(process.pid for process in psutil.Process().children())]
