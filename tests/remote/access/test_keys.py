"""Keys as text and as files, what a server says when it starts, and who may ask it."""

import contextlib
import dataclasses
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from envhub_sandbox import RemoteSandbox, make_env
from envhub_sandbox.errors import PolicyError, SandboxUnavailableError
from envhub_sandbox.extras.remote import sandbox as remote
from envhub_worker.extras.access import keys
from envhub_worker.protocol.keys import key_text
from tests.remote.listening import WORKER, Listening, listening, worker
from tests.support.command_line import below, gone
from tests.support.processes import eventually
from tests.support.started import started


@pytest.mark.short
def test_a_server_says_what_its_client_has_to_write(
    server: Listening, monkeypatch: pytest.MonkeyPatch, repository: Path
) -> None:
    """The printed line, executed, is a sandbox that works; so are the variables."""
    said = server.said()
    line = next(line for line in said.splitlines() if "RemoteSandbox(" in line)
    expression = line.strip().removeprefix("sandbox=envhub_sandbox.")
    sandbox: Any = eval(expression, {"RemoteSandbox": RemoteSandbox})
    assert sandbox == server.sandbox()
    assert server.client_key not in repr(sandbox)
    words = dict(word.split("=") for word in said.split() if word.startswith("ENVHUB_"))
    assert set(words) == {"ENVHUB_SERVER_KEY", "ENVHUB_CLIENT_KEY"}
    for name, value in words.items():
        monkeypatch.setenv(name, value.strip("'"))
    with started(repository, sandbox=server.endpoint):
        pass


def test_a_second_start_keeps_the_keys_and_does_not_print_the_secret(tmp_path: Path) -> None:
    with listening(tmp_path / "same") as first:
        assert first.client_key in first.said()
    with listening(tmp_path / "same") as second:
        assert (second.public, second.client_key) == (first.public, first.client_key)
        assert second.client_key not in second.said()


def test_a_server_for_one_client_has_its_keys_in_memory_alone(
    tmp_path: Path, repository: Path, wait_no_more: Callable[[], None]
) -> None:
    """Who starts it reads its endpoint and its key; another client is refused; nothing is left."""
    ours, stranger = keys.generate(), keys.generate()
    ready, ready_end = os.pipe()
    with os.fdopen(ready) as answer, started_for_one(tmp_path, ours, ready_end) as process:
        endpoint, public = answer.readline().split()
        place = RemoteSandbox(endpoint, server_key=public, client_key=key_text(ours.secret))
        with started(repository, sandbox=place):
            jails = below(process.pid)
            assert jails
            wrong = dataclasses.replace(place, client_key=key_text(stranger.secret))
            with pytest.raises(SandboxUnavailableError, match="does not know our key"):
                remote.ask_facts(wrong)
            assert not list(tmp_path.rglob("*.key"))
            assert not (tmp_path / "state" / "endpoint").exists()
            # an own process stands for the one that started it: its end is the server's
            process.parents()[0].kill()
            assert eventually(lambda: gone([process, *jails]))
            wait_no_more()


@contextlib.contextmanager
def started_for_one(folder: Path, client: keys.KeyPair, ready: int) -> Iterator[psutil.Process]:
    """A server as a program starts it for a client; its parent can be killed."""
    words = [
        *(*WORKER, "listen", "--bind", "tcp://127.0.0.1:*", "--state-dir", str(folder / "state")),
        *("--only-client", key_text(client.public), "--ready-fd", str(ready)),
    ]
    starter = (
        "import os, subprocess, sys\n"
        "ended = os.pidfd_open(os.getpid())\n"
        "given = [*sys.argv[2:], '--client-pidfd', str(ended)]\n"
        "subprocess.run(given, pass_fds=(int(sys.argv[1]), ended))\n"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", starter, str(ready), *words], pass_fds=(ready,)
    )
    try:
        os.close(ready)
        assert eventually(lambda: bool(below(parent.pid)))
        yield below(parent.pid)[0]
    finally:
        parent.kill()
        parent.wait(60)


def test_keys_are_found_in_the_configuration_folder(
    server: Listening, repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``known_hosts`` and ``client.key``; without them the error says where they belong."""
    monkeypatch.setenv("ENVHUB_CONFIG", str(tmp_path))
    with pytest.raises(SandboxUnavailableError, match="known_hosts"):
        make_env(repository, sandbox=server.endpoint)
    address = server.endpoint.removeprefix("tcp://")
    (tmp_path / "known_hosts").write_text(f"other:5555 {'0' * 64}\n{address} {server.public}\n")
    with pytest.raises(SandboxUnavailableError, match="envhub-worker keygen"):
        make_env(repository, sandbox=server.endpoint)
    (tmp_path / "client.key").write_text(f"{server.client_key}\n")
    with started(repository, sandbox=server.endpoint):
        pass


@pytest.mark.parametrize(
    "options",
    [
        {"sandbox": "tcp://nowhere"},
        {"sandbox": "tcp://host:99999"},
        {"sandbox": "tcp://host:1/path"},
        {"sandbox": "tcp://host:1 0123 no key"},
    ],
)
def test_what_nobody_reaches_is_refused_at_once(repository: Path, options: dict[str, str]) -> None:
    with pytest.raises(PolicyError):
        make_env(repository, **options)


def test_status_says_what_jails_do(server: Listening, repository: Path, tmp_path: Path) -> None:
    """For people, as its operator; a client sees itself. Without a server it fails, for scripts."""
    absent = worker("status", "--state-dir", tmp_path)
    assert absent.returncode == 1
    assert "no 'envhub-worker listen'" in absent.stderr
    with started(repository, sandbox=server.sandbox()):

        def told() -> str:
            return worker("status", "--state-dir", server.state).stdout

        # a loaded machine may not have put it to sleep yet
        assert eventually(lambda: "repository:env.py: waiting" in told())
        assert "the one client" in told()
        # whoever asks is none of them; of who was there before the server may not know yet
        assert eventually(lambda: "1 session" in told())
        done = worker("status", *server.as_client())
        assert done.returncode == 0, done.stderr
        assert "operator" not in done.stdout
        assert "1 session" in done.stdout


def test_health_asks_the_server_and_not_only_its_port(tmp_path: Path) -> None:
    """0 while it answers requests by key, 1 when it is stopped; refusals are no part of that."""
    own = keys.save(keys.generate(), tmp_path / "own", "mine")[0]
    with listening(tmp_path / "server", "--key", str(own)) as server:

        def is_healthy() -> bool:
            return worker("health", "--state-dir", server.state).returncode == 0

        # who is asked while the machine stands still has no answer in time
        assert eventually(is_healthy)
        assert "refused" not in server.said()
        assert "unknown_key" not in server.said()
        server.process.send_signal(signal.SIGSTOP)
        assert not is_healthy()
        server.process.send_signal(signal.SIGCONT)


@pytest.mark.parametrize("bind", ["a taken port", "tcp://192.0.2.1:5555"])
def test_an_address_that_cannot_be_had_is_said_in_a_line(bind: str, tmp_path: Path) -> None:
    with contextlib.closing(socket.create_server(("127.0.0.1", 0))) as taken:
        if bind == "a taken port":
            bind = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        done = worker("listen", "--bind", bind, "--state-dir", tmp_path / "state")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert f"--bind {bind}: " in done.stderr
    assert not (tmp_path / "state/endpoint").exists()
