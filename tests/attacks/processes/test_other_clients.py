"""One jail against another client's: its jail, its worker server, and what it keeps on disk.

The other client is of the same user, or (started as root) of another one. Either has a server of
its own. The controls aim the same payloads at a process and at files of the caller's.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.transport.shared_memory import attachment
from tests.attacks.harness import HOSTILE, Arena, Run, call, control_run, new_alias, token
from tests.attacks.network.listeners import listening
from tests.attacks.processes.victim import Victim, victim
from tests.support.interpreter import can_run
from tests.support.processes import eventually

FAMILY = "Other jails"
SOMEBODY = 61999
# Only root can be another user, who then needs the host's permission to read the interpreter.
_OTHERS = ["another user"] if os.geteuid() == 0 and can_run("no-userns") else []
WHOSE = ["same user", *_OTHERS]
_GRACE_S = 0.3
_HEARD_S = 60.0


@dataclass(frozen=True)
class Stranger:
    """A client of another process.

    Attributes:
        process: Our end of it.
        title: Whose it is, for the table.
        pid: The process of its jail.
        address: Where in its memory the secret lies.
        size: Length of the secret.
        fd: Its descriptor of a file that holds the secret.
        path: That file, as the jail calls it.
        server: The folder of its worker server.
        cache: Its store, with its crash bundles.
    """

    process: subprocess.Popen[str]
    title: str
    pid: int
    address: int
    size: int
    fd: int
    path: str
    server: str
    cache: str

    def state(self) -> dict[str, Any]:
        """``text``, what its jail's memory holds now, and ``signals``, how many have come."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return dict(json.loads(self.process.stdout.readline()))


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
    assert process.stdout is not None
    try:
        yield Stranger(process, title, **json.loads(process.stdout.readline()))
    finally:
        process.communicate()  # the end of its input ends it


class Raid:
    """All attacks on one stranger, from one jail, with a control each."""

    def __init__(self, arena: Arena, env: Any, other: Stranger, mine: Victim) -> None:
        self._arena, self._env, self._other, self._mine = arena, env, other, mine

    def attack(
        self,
        title: str,
        payload: str,
        succeeded: Any,
        outside: Mapping[str, Any],
        inside: Mapping[str, Any] | None = None,
    ) -> None:
        """Run it outside, where it must succeed, and in the jail, where it must not."""
        with control_run(payload, outside) as control:
            assert succeeded(control), f"the control of {title!r} failed: {control.text}"
        run = Run(new_alias(), True)
        call(self._env, run, payload, inside or outside)
        through = bool(succeeded(run))
        self._arena.judge(
            f"another client's, {self._other.title}: {title}", "succeeds", through, run.text
        )

    def processes(self, secret: str) -> None:
        """Its jail's memory, descriptors and signals."""
        other, mine = self._other, self._mine
        for title, payload, names in (
            ("process_vm_readv", "process_vm_read", ("pid", "address", "size")),
            ("/proc/<pid>/mem", "proc_mem_read", ("pid", "address", "size")),
            ("/proc/<pid>/fd", "proc_fd", ("pid", "fd")),
            ("pidfd_getfd", "pidfd_getfd", ("pid", "fd")),
        ):
            at = [{name: getattr(target, name) for name in names} for target in (mine, other)]
            self.attack(title, payload, lambda run: secret in run.text, *at)
        word = {"word": int.from_bytes(b"attacked", "little")}
        at = [{"pid": one.pid, "address": one.address, **word} for one in (mine, other)]
        self.attack(
            "ptrace", "ptrace_poke", lambda run: "attacked" in self._aim(run).state()["text"], *at
        )
        for way in ("kill", "sigqueue", "pidfd", "F_SETOWN"):
            self._signal(way)

    def _aim(self, run: Run) -> Stranger | Victim:
        return self._other if run.inside else self._mine

    def _signal(self, way: str) -> None:
        before = {True: self._other.state()["signals"], False: self._mine.state()["signals"]}

        def came(run: Run) -> bool:
            patience_s = _GRACE_S if run.inside else _HEARD_S
            return eventually(
                lambda: self._aim(run).state()["signals"] > before[run.inside], patience_s
            )

        at = [{"pid": one.pid, "way": way} for one in (self._mine, self._other)]
        self.attack(f"signal: {way}", "signal_one", came, *at)

    def files(self, secret: str) -> None:
        """What it and its server have on disk, the modes of which permit everybody to read."""
        for title, folder in (
            ("folder of the server", self._other.server),
            ("store", f"{self._other.cache}/snapshots"),
            ("crash bundles", f"{self._other.cache}/crashes"),
        ):
            path = Path(folder, "secret")
            open_to_all(path.parent, self._other.cache)
            path.write_text(secret)
            path.chmod(0o644)
            self.attack(title, "read_file", lambda run: secret in run.text, {"path": str(path)})
        scratch = f"/proc/{self._other.pid}/root{self._other.path}"
        assert secret in Path(scratch).read_text()
        mine = f"/proc/{self._mine.pid}/fd/{self._mine.fd}"
        for title, path_in in (
            ("scratch", self._other.path),
            ("scratch by /proc/<pid>/root", scratch),
        ):
            self.attack(
                title,
                "read_file",
                lambda run: secret in run.text,
                {"path": mine},
                {"path": path_in},
            )
        shared = Path(f"/dev/shm/envhub-{self._other.process.pid}")
        with ExitStack() as after:
            after.callback(shared.unlink, missing_ok=True)
            shared.write_text(secret)
            shared.chmod(0o644)
            at = {"path": str(shared)}
            self.attack("shared memory", "read_file", lambda run: secret in run.text, at)

    def sockets(self) -> None:
        """A socket beside those of its server, the modes of which permit everybody to connect."""
        path = Path(self._other.server, "canary")
        messages = {True: token(), False: token()}
        with listening(socket.AF_UNIX, socket.SOCK_STREAM, str(path)) as listener:
            path.chmod(0o777)

            def heard(run: Run) -> bool:
                return listener.heard(messages[run.inside], wait=not run.inside)

            at = [{"path": str(path), "message": messages[inside]} for inside in (False, True)]
            self.attack("socket of the server", "unix_stream", heard, *at)


def open_to_all(folder: Path, *others: str) -> None:
    """Make a folder that is missing, and let everybody pass: modes shall not be what stops."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in (folder, *map(Path, others)):
        path.chmod(0o755)


@pytest.mark.parametrize("title", WHOSE)
def test_other_clients_are_out_of_reach(arena: Arena, home: Path, title: str) -> None:
    """Neither their jails, nor their servers, nor their files."""
    secret = token()
    with ExitStack() as held:
        mine = held.enter_context(victim(secret))
        folder = Path(held.enter_context(tempfile.TemporaryDirectory(dir=home.parent)))
        folder.chmod(0o755)
        other = held.enter_context(stranger(arena, title, folder, secret))
        env = held.enter_context(arena.environment())
        raid = Raid(arena, env, other, mine)
        raid.processes(secret)
        raid.files(secret)
        raid.sockets()


def test_deposits_need_the_session(arena: Arena, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever reached the socket for descriptors would have to know a random number as well."""
    known: list[tuple[str, bytes, int, int]] = []
    deposit = attachment.deposit

    def noted(path: str, session: bytes, jail: int, runner: int, fds: Any, wait_s: float) -> int:
        known.append((path, session, jail, runner))
        return deposit(path, session, jail, runner, fds, wait_s)

    monkeypatch.setattr(attachment, "deposit", noted)
    with arena.environment() as env, ExitStack() as held:
        env.reset()
        fds = [os.memfd_create("mine") for _ in range(5)]
        for fd in fds:
            held.callback(os.close, fd)
        path, session, jail, runner = known[-1]
        os.close(deposit(path, session, jail, runner, fds))  # the control: with it they are taken
        for guess in (
            b"",
            os.urandom(len(session)),
            session[:-1],
            session[:-1] + bytes([session[-1] ^ 1]),
        ):
            with pytest.raises(OSError, match="did not take"):
                deposit(path, guess, jail, runner, fds)
