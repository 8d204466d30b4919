"""Taking what others share: files that are read, and what the kernel counts per user.
A jail of root's runs as a user of its own; one of a plain user's runs as that user, and what the
kernel gives to a user, the caller's other programs share with it."""

import contextlib
import fcntl
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.attacks.harness import ANSWER, USER, Arena, Run, token
from tests.support.turns import LONGEST_S, turn

FAMILY = "What others share"
MIB = 1 << 20


@pytest.fixture
def granted(home: Path) -> Path:
    folder = home / "granted"
    folder.mkdir()
    (folder / "model.bin").write_text("weights")
    return folder


def held(path: Path, way: str) -> bool:
    """Whether somebody else would have to wait for a file."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except BlockingIOError:
        return True
    try:
        if way == "flock":
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(fd)
    return False


@pytest.mark.parametrize("way", ["lease", "flock"])
def test_readable_files_are_not_held(arena: Arena, granted: Path, way: str) -> None:
    path = granted / "model.bin"
    arena.attack(
        f"hold a readable file: {way}",
        "hold_file",
        lambda run: held(path, way),
        policy={"readable": (str(granted),)},
        path=str(path),
        way=way,
    )


@contextlib.contextmanager
def opened_again_and_again(path: Path) -> Iterator[None]:
    """What somebody does next to the jail: opening, reading and changing a file."""
    done = threading.Event()

    def work() -> None:
        while not done.wait(0.02):
            path.write_text(path.read_text())

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


@pytest.mark.parametrize("way", ["inotify", "F_NOTIFY"])
def test_nobody_is_watched(arena: Arena, granted: Path, way: str) -> None:
    secret = f"name-{token()}"
    (granted / secret).write_text("x")
    by_name = way == "inotify"
    with opened_again_and_again(granted / secret):
        arena.attack(
            f"watch what others do: {way}",
            "watch_folder",
            (lambda run: secret in run.text) if by_name else (lambda run: run.value is True),
            policy={"readable": (str(granted),)},
            inside={"seconds": 1.0},
            judged="outside" if by_name else ANSWER,
            folder=str(granted),
            way=way,
            seconds=30.0,
        )


def test_pipes_keep_their_size(arena: Arena) -> None:
    def large(run: Run) -> bool:
        return any(
            os.readlink(path).startswith("pipe:") and capacity(path) >= MIB
            for pid in run.pids()
            for path in (f"/proc/{pid}/fd/{fd}" for fd in os.listdir(f"/proc/{pid}/fd"))
        )

    arena.attack("enlarge a pipe", "large_pipe", large, size=MIB)


def capacity(path: str) -> int:
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        return fcntl.fcntl(fd, fcntl.F_GETPIPE_SZ)
    finally:
        os.close(fd)


# Each ends with 1 where the quota is used up.
PROBES = {
    "inotify instances": "sys.exit(libc.inotify_init1(0) < 0)",
    "queued signals": """
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGRTMIN])
sys.exit(libc.sigqueue(os.getpid(), signal.SIGRTMIN, None) < 0)
""",
    "message queues": """
name = b"/" + sys.argv[1].encode()
made = libc.mq_open(name, os.O_CREAT | os.O_RDWR, 0o600, None)
libc.mq_unlink(name)
sys.exit(made < 0)
""",
    "descriptors in flight": """
resource.setrlimit(resource.RLIMIT_NOFILE, (256, 256))
ours, theirs = socket.socketpair()
try:
    socket.send_fds(ours, [b"x"], [0])
except OSError:
    sys.exit(1)
""",
    "pages of pipes": "sys.exit(fcntl.fcntl(os.pipe()[0], fcntl.F_GETPIPE_SZ) < 65536)",
}
_MODULES = "import ctypes, fcntl, os, resource, signal, socket, sys\nlibc = ctypes.CDLL(None)\n"


def used_up(kind: str) -> bool:
    """Whether another program of this user gets nothing of a kind any more."""
    source = _MODULES + PROBES[kind]
    done = subprocess.run([sys.executable, "-ISc", source, f"probe-{token()}"], check=False)
    assert done.returncode in (0, 1)
    return done.returncode == 1


@pytest.fixture
def _quotas() -> Iterator[None]:
    """They are one user's: what one test uses up, another one would find used up."""
    with turn("quotas"):
        yield


@pytest.mark.timeout(LONGEST_S + 300)
@pytest.mark.usefixtures("_quotas")
@pytest.mark.parametrize("kind", PROBES)
def test_the_users_quotas_are_left_to_others(arena: Arena, kind: str) -> None:
    assert not used_up(kind), "this user's other programs have used it up before"
    arena.attack(
        f"use up the user's {kind}",
        "use_up",
        lambda run: used_up(kind),
        limits={"open_files": 4096},
        impossible="a jail of root's runs as a user of its own" if USER == "root" else "",
        kind=kind,
        name=f"attack-{token()}",
    )
