"""What a jail holds open: every descriptor is known, and whom it could disturb with it.
Smuggling further ones in and out."""

import contextlib
import ctypes
import errno
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.sandboxes.process import PROCESS
from tests.attacks.expectations import SHARED
from tests.attacks.harness import (
    TIMEOUTS,
    USER,
    Arena,
    Run,
    control_run,
    new_alias,
    pids_named,
    run_in,
    start_control,
    token,
)
from tests.attacks.repositories import write_environment
from tests.attacks.runner.abuser import KEEP, watched
from tests.support.processes import eventually, most_grown, resident, unless_ended

FAMILY = "Open files"
PATIENCE = 3000
"""Requests in which the server must have noticed the noise."""
KEEPER = (
    KEEP
    + """
import ctypes

class Keeper(Plain):
    def name(self, alias):
        ctypes.CDLL(None).prctl(15, alias.encode(), 0, 0, 0)  # PR_SET_NAME
        return {str(fd): name for fd, name in zip(kept, NAMES)}

NAMES = (
    "slab: request", "slab: reply", "slab: observations",
    "what it hears: socket", "what it rings: eventfd",
)
"""
)
_KCMP = {"x86_64": 312, "aarch64": 272}
_KCMP_FILE = 0


@pytest.fixture
def inherited(home: Path, other_cache: Path) -> Iterator[str]:
    """A secret file that is open here, and marked for children to inherit; a server since then."""
    secret = token()
    (home / "private").write_text(secret)
    fd = os.open(home / "private", os.O_RDONLY)
    os.set_inheritable(fd, True)
    use = PROCESS.acquire(other_cache / "snapshots")
    yield secret
    use.release()
    os.close(fd)


@pytest.mark.short("strict")
def test_open_files_are_not_inherited(arena: Arena, inherited: str) -> None:
    alias = new_alias()
    process = start_control("inherited_descriptors", {}, alias, close_fds=False)
    answer, _ = process.communicate(b"\n")
    assert inherited.encode() in answer, "the control of inheriting failed"
    with arena.inside("inherited_descriptors", {}) as run:
        arena.judge("read inherited descriptors", "succeeds", inherited in run.text, run.text)


def test_descriptors_cannot_be_pushed_into_the_server(strict: Arena, home: Path) -> None:
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
    with strict.environment() as other:
        other.reset()
        with strict.environment() as env:
            run = run_in(env, "send_descriptor", name=name, path="")
            held = [link for process in servers() for link in open_files(process)]
        other.reset()
    pushed = any(name in link for link in held)
    strict.judge("push descriptors over the stream (SCM_RIGHTS)", "succeeds", pushed, run.text)


def open_files(pid: int) -> list[str]:
    """The files that a process has open; nothing, if it has ended."""
    links = []
    for fd in descriptors(pid):
        with contextlib.suppress(OSError):
            links.append(os.readlink(f"/proc/{pid}/fd/{fd}"))
    return links


def descriptors(pid: int) -> list[int]:
    """What a process has open; nothing, if it has ended, as a server does that has lingered."""
    with unless_ended(pid):
        return sorted(map(int, os.listdir(f"/proc/{pid}/fd")))
    return []


def test_every_descriptor_of_a_jail_is_known(arena: Arena, home: Path) -> None:
    repository, alias = write_environment(home / "keeper", KEEPER), new_alias()
    with make_env(repository, timeouts=TIMEOUTS, **arena.place({})) as suites:
        env = suites.env
        env.reset()
        [kept] = env.call("name", alias)
        [runner] = pids_named(alias)
        names = {0: "stdin", 1: "stdout", 2: "stderr"} | {int(fd): kept[fd] for fd in kept}
        held = {fd: open_file(runner, fd) for fd in descriptors(runner)}
        # what is kept are copies: of what serves the lane, and of the slabs, which it has closed
        copies = {
            fd
            for fd in held
            if fd not in names and any(same(runner, fd, runner, at) for at in names)
        }
        [stream] = set(held) - set(names) - copies
        names[stream] = "stream"
        found = {
            name if ": " in name else f"{name}: {held[fd]}": sharers(runner, fd, held[fd])
            for fd, name in names.items()
        }
    # only root can look into init and the zygote: they have made themselves opaque to their user
    visible = {"client", "server"} | ({"init", "zygote"} if USER == "root" else set())
    assert found == {name: who & visible for name, who in SHARED.items()}


def open_file(pid: int, fd: int) -> str:
    return os.readlink(f"/proc/{pid}/fd/{fd}").partition(":")[0]


def same(pid: int, fd: int, other: int, theirs: int) -> bool:
    """Whether two descriptors are of one open file description: see ``kcmp(2)``."""
    libc = ctypes.CDLL(None, use_errno=True)
    found = libc.syscall(_KCMP[os.uname().machine], pid, other, _KCMP_FILE, fd, theirs)
    if found < 0:
        error = ctypes.get_errno()
        kind = FileNotFoundError if error == errno.EBADF else OSError  # it is closed by now
        raise kind(error, "kcmp")
    return bool(found == 0)


def sharers(runner: int, fd: int, kind: str) -> set[str]:
    """Who holds it besides the runner: the client, the server, the jail's init, or the zygote."""
    init, found = psutil.Process(runner).ppid(), set()
    names = {os.getpid(): "client", init: "init", **dict.fromkeys(servers()[1:], "server")}
    for process in [psutil.Process(), *psutil.Process().children(recursive=True)]:
        if process.pid == runner or (
            USER != "root" and process.pid not in {os.getpid(), *servers()}
        ):
            continue
        if any(
            shares(runner, fd, kind, process.pid, theirs) for theirs in descriptors(process.pid)
        ):
            found.add(names.get(process.pid, "zygote"))
    return found


def shares(runner: int, fd: int, kind: str, pid: int, theirs: int) -> bool:
    """Whether another process has the same; not if it has closed it meanwhile."""
    with unless_ended(pid), contextlib.suppress(FileNotFoundError):
        return open_file(pid, theirs) == kind and same(runner, fd, pid, theirs)
    return False


def test_nobody_is_held_by_what_a_jail_does_to_its_descriptors(strict: Arena, home: Path) -> None:
    """To all of them at once: its client steps, closes and ends, and so does its neighbour's."""
    acts = ("fill", "block", "block_empty", "truncate", "seek", "shut", "push", "close")
    ended, said = watched(strict, home, acts, every=True, steps=[[1], [0]])
    assert ended, said


def words(*numbers: int, tail: bytes = b"") -> bytes:
    """The head of a packet: how many frames it has, its number, their sizes."""
    return b"".join(number.to_bytes(8, "little") for number in numbers) + tail


NOISE = {
    "ff": b"\xff" * 4096,
    "zeros": b"\0" * 4096,
    "http": b"GET / HTTP/1.1\r\n\r\n" * 100,
    "endless-frame": words(1, 1, tail=b"\xff" * 8),
    "huge-frames": words(4096, 1, *[1 << 27] * 4096),
    "unasked-answer": words(1, 99, tail=b"\1" + b"\0" * 8),
}


@pytest.mark.short("strict-ff")
@pytest.mark.parametrize("noise", NOISE.values(), ids=NOISE)
def test_noise_on_the_stream_ends_only_its_jail(strict: Arena, noise: bytes) -> None:
    """A jail that writes past our code to its stream is killed; server and neighbours go on."""
    with strict.environment() as other:
        other.reset()
        with strict.environment() as env:
            env.reset()
            before = resident()
            run = Run(new_alias(), True)
            with pytest.raises(EnvHubError) as caught:
                make_noise(env, noise, run)
            grown = most_grown(before)
            assert eventually(lambda: not run.pids()), "the noisy jail lives on"
        other.step([0])
    text = str(caught.value)
    through = grown > 64 << 20 or "rules" not in text
    strict.judge("write noise to the stream", "succeeds", through, f"{text} (grew {grown})")


def make_noise(env: Any, noise: bytes, run: Run) -> None:
    """Until its jail's death is met: the answer itself may have come another way before it."""
    env.call("attack", "garbage_on_streams", {"data": noise.hex()}, run.alias)
    for _ in range(PATIENCE):
        env.get_attr("render_mode")
        time.sleep(0.01)


def servers() -> list[int]:
    return [os.getpid(), *(process.pid for process in psutil.Process().children())]
