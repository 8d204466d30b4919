"""A client's place on a server: whose it is, and that whoever has gone takes none."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from envhub_worker.extras.access import keys
from envhub_worker.protocol import messages as m
from tests.remote.listening import Listening, listening, worker
from tests.remote.peers import peer
from tests.support.processes import eventually

_SHORT = """
import sys
from envhub_sandbox import RemoteSandbox, make_env
from tests.support import inside
for module, patience in inside.WAITS_FOR_A_SERVER:
    setattr(module, patience, 90.0)  # a busy machine takes longer than a user would wait
endpoint, server_key, client_key, repository, end = sys.argv[1:]
suites = make_env(repository, sandbox=RemoteSandbox(endpoint, server_key, client_key))
suites.env.reset()
print("ready", flush=True)
if end == "closes":
    suites.close()
if end == "waits":
    sys.stdin.read()
"""


@pytest.fixture(scope="module")
def narrow(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Listening]:
    """A server with one place for each key, which waits for ever for whoever says nothing."""
    quotas = ("--max-sessions", "1", "--max-jails", "1", "--idle-s", "0")
    with listening(tmp_path_factory.mktemp("narrow"), *quotas) as server:
        yield server


def program(server: Listening, repository: Path, end: str) -> subprocess.Popen[bytes]:
    words = server.endpoint, server.public, server.client_key, str(repository), end
    return subprocess.Popen(
        [sys.executable, "-c", _SHORT, *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )


def connected(server: Listening) -> bool:
    """Whether anybody is, as far as the server has noticed."""
    return any(one["connections"] for one in server.sessions())


@contextmanager
def at_work(server: Listening, repository: Path) -> Iterator[subprocess.Popen[bytes]]:
    assert eventually(lambda: not connected(server))  # whoever was there before is known to be gone
    client = program(server, repository, "waits")
    assert client.stdout.readline() == b"ready\n"
    yield client
    client.communicate(timeout=120)


@pytest.mark.parametrize("end", ["closes", "returns"])
def test_the_place_of_a_program_that_ends_is_free_at_once(
    end: str, narrow: Listening, repository: Path
) -> None:
    """Of one that closes, and of one that leaves that to its end: one after the other come in."""
    for _ in range(2):
        client = program(narrow, repository, end)
        said, _ = client.communicate(timeout=120)
        assert client.returncode == 0, said
        assert eventually(lambda: not narrow.sessions())


def test_a_killed_programs_place_is_for_others(narrow: Listening, repository: Path) -> None:
    """Its jail stays, for it may be cut off only; the next of its key gets the place of both. The
    control: nobody is pushed out who is still there. ``status``, asked with the client's own key,
    takes no place meanwhile, and holds none then."""
    with at_work(narrow, repository) as client:
        said, _ = program(narrow, repository, "closes").communicate(timeout=120)
        assert b"which is the server's quota" in said
        for _ in range(2):
            asked = worker("status", *narrow.as_client())
            assert asked.returncode == 0, asked.stderr
            assert "1 jail" in asked.stdout
        assert (narrow.jails(), client.poll()) == (1, None)
        client.kill()
    assert eventually(lambda: [one["connections"] for one in narrow.sessions()] == [0])
    assert narrow.jails() == 1
    said, _ = program(narrow, repository, "closes").communicate(timeout=120)
    assert said == b"ready\n"
    assert eventually(lambda: not narrow.sessions())


def test_connections_that_have_gone_take_no_session(narrow: Listening) -> None:
    """One after the other, each under a name of its own."""
    pair = keys.load(narrow.state / "client.key")

    def is_welcome(name: bytes) -> bool:
        with peer(narrow, pair) as found:
            return isinstance(found.ask(m.Hello(m.VERSION, name)), m.Welcome)

    for name in (b"one", b"two", b"three"):
        assert eventually(lambda: is_welcome(name))  # noqa: B023
