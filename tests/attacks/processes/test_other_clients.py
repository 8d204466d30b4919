"""One jail against another client's: its jail, its worker server, and what it keeps on disk.
The other client is of the same user, or (started as root) of another one. Either has a server of
its own. The controls aim the same payloads at a process and at files of the caller's."""

import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.transport.shared_memory import attachment
from tests.attacks.harness import HOSTILE, Arena, OpenJail, token
from tests.attacks.network.listeners import listening, sends
from tests.attacks.processes.neighbour import Pair
from tests.attacks.processes.victim import READS, SIGNALS, WORD, Victim, victim
from tests.support.interpreter import can_run

FAMILY = "Other jails"
SOMEBODY = 61999
# Only root can be another user, who then needs the host's permission to read the interpreter.
_OTHERS = ["another user"] if os.geteuid() == 0 and can_run("no-userns") else []
WHOSE = ["same user", *_OTHERS]


@dataclass(frozen=True)
class Stranger(Victim):
    """A client of another process; the other fields are of its jail."""

    path: str
    server: str
    cache: str


@contextmanager
def stranger(arena: Arena, title: str, folder: Path, secret: str) -> Iterator[Stranger]:
    """Another client, whose jail holds ``secret``. Its folders are open to everybody."""
    user = os.geteuid() if title == "same user" else SOMEBODY
    os.chown(folder, user, -1 if user == os.geteuid() else user)
    program = "tests.attacks.processes.other_client"
    process = subprocess.Popen(
        [sys.executable, "-m", program, str(user), arena.profile, secret],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=HOSTILE.parents[2],
        env={
            "HOME": str(folder),
            "TMPDIR": str(folder),
            "ENVHUB_CACHE": f"{folder}/cache",
            "PATH": os.environ["PATH"],
            "PYTHONDONTWRITEBYTECODE": "1",
        },
    )
    try:
        yield Stranger(process, secret, **json.loads(process.stdout.readline()))
    finally:
        process.communicate()  # the end of its input ends it


def raid_processes(jail: OpenJail, pair: Pair) -> None:
    """Its jail's memory, descriptors and signals."""
    for title, (payload, names) in READS.items():
        jail.steal(title, payload, pair.secret, **pair.at(*names))
    jail.attack("ptrace", "ptrace_poke", pair.written, word=WORD, **pair.at("pid", "address"))
    for way in SIGNALS:
        pair.signal(jail, f"signal: {way}", way=way, **pair.at("pid"))


def raid_files(jail: OpenJail, mine: Victim, other: Stranger) -> None:
    """What it and its server have on disk, the modes of which permit everybody to read."""
    secret = other.secret
    for title, folder in (
        ("folder of the server", other.server),
        ("store", f"{other.cache}/snapshots"),
        ("crash bundles", f"{other.cache}/crashes"),
    ):
        path = Path(folder, "secret")
        open_to_all(path.parent, other.cache)
        path.write_text(secret)
        path.chmod(0o644)
        jail.steal(title, "read_file", secret, path=str(path))
    scratch = f"/proc/{other.pid}/root{other.path}"
    assert secret in Path(scratch).read_text()
    own = f"/proc/{mine.pid}/fd/{mine.fd}"
    for title, inside in (("scratch", other.path), ("scratch by /proc/<pid>/root", scratch)):
        jail.steal(title, "read_file", secret, path=own, inside={"path": inside})
    shared = Path(f"/dev/shm/envhub-{other.process.pid}")
    with ExitStack() as after:
        after.callback(shared.unlink, missing_ok=True)
        shared.write_text(secret)
        shared.chmod(0o644)
        jail.steal("shared memory", "read_file", secret, path=str(shared))


def raid_sockets(jail: OpenJail, other: Stranger) -> None:
    """A socket beside those of its server, the modes of which permit everybody to connect."""
    path = Path(other.server, "canary")
    with listening(socket.AF_UNIX, socket.SOCK_STREAM, str(path)) as listener:
        path.chmod(0o777)
        sends(jail, "socket of the server", "unix_stream", listener, path=str(path))


def open_to_all(folder: Path, *others: str) -> None:
    """Make a folder that is missing, and let everybody pass: modes shall not be what stops."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in (folder, *map(Path, others)):
        path.chmod(0o755)


@pytest.mark.parametrize("title", WHOSE)
def test_other_clients_are_out_of_reach(arena: Arena, home: Path, title: str) -> None:
    secret = token()
    with ExitStack() as held:
        mine = held.enter_context(victim(secret))
        folder = Path(held.enter_context(tempfile.TemporaryDirectory(dir=home.parent)))
        folder.chmod(0o755)
        other = held.enter_context(stranger(arena, title, folder, secret))
        env = held.enter_context(arena.environment())
        jail = OpenJail(arena, env, f"another client's, {title}: ")
        raid_processes(jail, Pair(mine, other))
        raid_files(jail, mine, other)
        raid_sockets(jail, other)


def test_deposits_need_the_session(strict: Arena, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever reached the socket for descriptors would have to know a random number as well."""
    known: list[tuple[str, bytes, int, int]] = []
    deposit = attachment.deposit

    def noted(path: str, session: bytes, jail: int, runner: int, fds: Any, wait_s: float) -> int:
        known.append((path, session, jail, runner))
        return deposit(path, session, jail, runner, fds, wait_s)

    monkeypatch.setattr(attachment, "deposit", noted)
    with strict.environment() as env, ExitStack() as held:
        env.reset()
        fds = [os.memfd_create("mine") for _ in range(5)]
        for fd in fds:
            held.callback(os.close, fd)
        path, session, jail, runner = known[-1]
        os.close(deposit(path, session, jail, runner, fds))  # the control: with it they are taken
        near = session[:-1] + bytes([session[-1] ^ 1])
        for guess in (b"", os.urandom(len(session)), session[:-1], near):
            with pytest.raises(OSError, match="did not take"):
                deposit(path, guess, jail, runner, fds)
