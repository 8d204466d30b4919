"""Keys as text and as files, what a server says when it starts, and who may ask it."""

from __future__ import annotations

import argparse
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
import zmq
from zmq.utils import z85

from envhub_sandbox import RemoteSandbox, make_env
from envhub_sandbox.errors import PolicyError, SandboxUnavailableError
from envhub_sandbox.sandboxes import remote
from envhub_worker.access import keys
from envhub_worker.access.audit.log import CLIENT_LINES, LINES, Log
from envhub_worker.access.keys import AuthorizedClients
from envhub_worker.cli import identity as identities
from envhub_worker.cli import listen_options, state_folder, status
from envhub_worker.protocol.keys import key_text, parse_key
from tests.remote.listening import WORKER, Listening, listening, worker
from tests.support import inside
from tests.support.command_line import below, gone
from tests.support.processes import eventually
from tests.support.started import started

pytestmark = pytest.mark.short


def test_keys_are_read_in_both_forms() -> None:
    for _ in range(20):
        public, secret = zmq.curve_keypair()
        assert parse_key(public.decode()) == z85.decode(public)
        assert parse_key(f" {z85.decode(secret).hex()}\n") == z85.decode(secret)
        assert keys.from_secret(z85.decode(secret)).public == z85.decode(public)


@pytest.mark.parametrize("text", ["", "00", "g" * 64, "0" * 63, " " * 40, "~" * 40, "#" * 40])
def test_what_is_no_key_is_refused_without_being_repeated(text: str) -> None:
    with pytest.raises(ValueError, match="64 hexadecimal digits") as caught:
        parse_key(text)
    assert not text.strip() or text not in str(caught.value)


def test_the_list_of_clients_knows_names_and_comments(tmp_path: Path) -> None:
    """A key in Z85 may begin like a comment; a line that is none is named."""
    one, other = keys.generate(), keys.generate()
    path = tmp_path / "clients"
    path.write_text(
        f"# comment\n#comment\n\n{key_text(one.public)} alice in lab 3\n"
        f"{z85.encode(other.public).decode()}\n"
    )
    clients = AuthorizedClients(path, {})
    assert clients.name_of(one.public) == "alice in lab 3"
    assert clients.name_of(other.public) == key_text(other.public)[:8]
    assert clients.name_of(keys.generate().public) is None
    path.write_text("no key\n")
    with pytest.raises(ValueError, match="line 1"):
        clients.refresh()
    assert clients.name_of(one.public) is not None


@pytest.mark.parametrize(("abi", "default"), [(0, "strict"), (1, "container")])
def test_a_container_without_landlock_permits_no_weak_profile_by_itself(
    monkeypatch: pytest.MonkeyPatch, abi: int, default: str
) -> None:
    """A jail of the profile ``container`` is the server's user: it would read every store."""
    monkeypatch.setattr(*inside.CONTAINER_MARKS, ("/",))
    monkeypatch.setattr("envhub_worker.lockdown.mechanisms.landlock.version", lambda: abi)
    parser = argparse.ArgumentParser()
    listen_options.add_options(parser)
    assert parser.parse_args([]).weakest_profile == default
    assert ("no jail can be opened" in identities.unusable("container", default)) is (abi == 0)


def test_without_landlock_a_weak_profile_is_for_one_client(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the start, and when the list grows later; with Landlock it may be as long as it likes."""
    one, other = key_text(keys.generate().public), key_text(keys.generate().public)
    path = tmp_path / "clients"
    path.write_text(f"{one}\n{other}\n")
    parser = argparse.ArgumentParser()
    listen_options.add_options(parser)
    options = parser.parse_args(
        ["--weakest-profile", "container", "--authorized-clients", str(path)]
    )
    identity = identities.Identity(keys.generate(), path)
    monkeypatch.setattr("envhub_worker.lockdown.mechanisms.landlock.version", lambda: 0)
    with pytest.raises(ValueError, match="without Landlock"):
        inside.gate_of(options, tmp_path, identity)
    path.write_text(f"{one}\n")
    inside.gate_of(options, tmp_path, identity)
    few = AuthorizedClients(path, {}, 1)
    path.write_text(f"{one}\n{other}\n")
    with pytest.raises(ValueError, match="2 clients"):
        few.refresh()
    assert few.name_of(parse_key(other)) is None
    monkeypatch.setattr("envhub_worker.lockdown.mechanisms.landlock.version", lambda: 1)
    inside.gate_of(options, tmp_path, identity)


@pytest.mark.parametrize("bind", ["tcp://", "5555", "ipc:///tmp/x", "tcp://127.0.0.1:http"])
def test_only_tcp_addresses_are_bound(bind: str) -> None:
    """Anything else is a mistake; nobody listens on all interfaces without saying so."""
    with pytest.raises(identities.UsageError, match="--bind takes"):
        identities.check_bind(bind, False)
    parser = argparse.ArgumentParser()
    listen_options.add_options(parser)
    assert parser.parse_args([]).bind.startswith("tcp://127.0.0.1:")


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


def test_the_line_names_the_profile_where_the_default_cannot_be_had() -> None:
    """In most containers: what is printed must work when it is pasted."""
    identity = identities.Identity(
        keys.generate(), None, keys.generate(), Path("x"), True, "no-userns"
    )
    said = identities.announcement("tcp://0.0.0.0:5555", identity)
    assert said.count("policy={'profile': 'no-userns'}") == 2
    assert 'RemoteSandbox("tcp://127.0.0.1:5555"' in said
    strict = dataclasses.replace(identity, profile="strict")
    assert "policy=" not in identities.announcement("tcp://127.0.0.1:1", strict)


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
        {"sandbox": "tcp://host:1", "server_key": "no key"},
        {"sandbox": "process", "server_key": "0" * 64},
    ],
)
def test_what_cannot_be_reached_is_refused_at_once(
    repository: Path, options: dict[str, str]
) -> None:
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
        assert "1 session" in told()  # nor is whoever asks one of them
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


def test_a_log_cannot_be_filled() -> None:
    """A few lines of a kind in a minute, then how many more there were. A client has many of its
    own; what it wastes is neither another's nor a stranger's."""
    now, lines = [0.0], list[str]()
    log = Log(lines.append, lambda: now[0])
    for _ in range(1000):
        log.say("unknown_key", why="noise")
    log.say("stopped", why="something else")
    assert len(lines) == LINES + 1
    now[0] = 61
    log.tick()
    assert lines[-1].endswith(f"left_out of=unknown_key lines={1000 - LINES}")
    lines.clear()
    for _ in range(CLIENT_LINES + 5):
        log.say("refused", whose="a" * 64, client="mallory")
    assert len(lines) == CLIENT_LINES
    log.say("refused", whose="b" * 64, client="alice")
    log.say("refused", why="a stranger")
    assert len(lines) == CLIENT_LINES + 2
    now[0] = 122
    log.tick()
    assert lines[-1].endswith(f"left_out of=refused lines=5 key={'a' * 16}")


def test_a_log_that_nobody_reads_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its stream is closed, or a pipe whose reader has gone."""
    read, write = os.pipe()
    os.close(read)
    broken = open(write, "w", buffering=1)  # noqa: SIM115
    monkeypatch.setattr("sys.stderr", broken)
    Log().say("refused", why="to a pipe without a reader")
    with contextlib.suppress(BrokenPipeError):
        broken.close()
    Log().say("refused", why="to a closed stream")


def test_a_state_folder_of_somebody_else_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The temporary folder is everybody's: what others may write there is none of ours. Jails are
    made elsewhere: a relative folder is where one stands."""
    monkeypatch.setenv("XDG_STATE_HOME", "/proc/nowhere")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    folder = tmp_path / f"envhub-worker-{os.getuid()}"
    assert state_folder.state_dir(None, create=True) == folder
    folder.chmod(0o777)
    assert state_folder.state_dir(None, create=True) is None
    monkeypatch.chdir(tmp_path)
    assert state_folder.state_dir(Path("here"), create=True) == tmp_path / "here"


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


def test_a_name_is_no_line_of_the_status() -> None:
    jail = {"name": "evil\n0 sessions", "states": ["idle"], "operation": "", "busy_s": 0.0}
    one = {"client": "a", "session": "1", "heard_s": 0.0, "connections": 1, "upload_bytes": 0}
    many = [{**jail, "name": "x" * 512} for _ in range(40)]
    sessions = [{**one, "jails": (jail, *many)}, {**one, "client": "bob", "jails": ()}]
    lines = status.table(sessions).splitlines()
    assert not [line for line in lines if line.startswith("0 sessions")]
    assert [line for line in lines if "bob" in line]
