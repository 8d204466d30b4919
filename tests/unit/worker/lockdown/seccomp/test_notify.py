"""Calls that ask init before they are made: no signal interrupts them, and a caller may go."""

import errno
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import envhub_worker
from envhub_worker.lockdown.seccomp import filter, notify
from envhub_worker.lockdown.seccomp.policy import policy_table, watched_calls
from tests.support.processes import eventually

_ROUNDS = 20
_OPENING = """
import ctypes, errno, os, signal, socket, sys
from envhub_worker.lockdown.mechanisms import process
from envhub_worker.lockdown.seccomp import filter

number, filter.WAIT_KILLABLE, rounds = map(int, sys.argv[1:])
channel = socket.socket(fileno=number)
opened = ctypes.CDLL(None, use_errno=True).open
program = filter.compile_filter(namespaced=True, network="none", record=True)
signal.signal(signal.SIGURG, lambda *_: None)
process.set_no_new_privileges()
listener = filter.install(program, brokered=True)
socket.send_fds(channel, [b"x"], [listener])
os.close(listener)
answers = []
for _ in range(rounds):
    fd = opened(b"/dev/null", os.O_RDONLY)
    answers.append("opened" if fd >= 0 else errno.errorcode[ctypes.get_errno()])
    if fd >= 0:
        os.close(fd)
os.write(1, " ".join(answers).encode())
os._exit(0)
"""


def is_known() -> bool:
    """Whether this kernel has the flag: Linux 5.19 and later."""
    release = os.uname().release.split(".")
    return (int(release[0]), int(release[1].split("-")[0])) >= (5, 19)


def opens(flag: int) -> list[str]:
    """What comes of opening a file, where a signal comes each time before the answer does."""
    ours, theirs = socket.socketpair()
    command = [sys.executable, "-c", _OPENING, str(theirs.fileno()), str(flag), str(_ROUNDS)]
    environment = {**os.environ, "PYTHONPATH": str(Path(envhub_worker.__file__).parents[1])}
    with subprocess.Popen(
        command, env=environment, pass_fds=[theirs.fileno()], stdout=subprocess.PIPE
    ) as child:
        theirs.close()
        ours.settimeout(120)
        _, listeners, _, _ = socket.recv_fds(ours, 1, 1)
        ours.close()

        def note(request: notify.Request) -> None:
            os.kill(child.pid, signal.SIGURG)
            if not flag:  # the answer would come too early for some
                eventually(lambda: not _waits(request))

        _answer(listeners[0], note)
        return child.communicate(timeout=120)[0].decode().split()


def _waits(request: notify.Request) -> bool:
    try:
        request.still_waits()
    except OSError:
        return False
    return True


def _answer(listener: int, note: Callable[[notify.Request], None]) -> None:
    poller = select.poll()
    poller.register(listener, select.POLLIN)
    permitted = watched_calls(policy_table(namespaced=True, network="none"))
    try:
        while any(events & select.POLLIN for _, events in poller.poll(120_000)):
            notify.serve(listener, permitted, note)
    finally:
        os.close(listener)


def test_a_signal_interrupts_no_call_that_asks() -> None:
    """The control is the same without the flag: each is interrupted, which no program expects."""
    assert opens(0) == ["EINTR"] * _ROUNDS
    if is_known():
        assert opens(filter.WAIT_KILLABLE) == ["opened"] * _ROUNDS


def test_an_older_kernel_is_asked_without_it() -> None:
    """One that does not know the flag refuses it; whoever asks is heard all the same."""
    assert len(opens(1 << 30)) == _ROUNDS


@pytest.mark.parametrize("to", ["its group", "init"])
def test_a_caller_that_has_gone_since_ends_nobody(to: str) -> None:
    """It was killed between its call and our look at its group: the answer reaches nobody."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    target = -gone.pid if to == "its group" else 1
    asked = notify.Request(gone.pid, gone.pid, "kill", (target, 15, 0))
    assert notify.decide(asked, list) == errno.ESRCH


@pytest.mark.parametrize("way", ["kill", "kill its group", "tkill", "tgkill"])
def test_a_signal_goes_to_processes_of_the_jail_only(way: str) -> None:
    """Init sends it, or refuses: the kernel goes on with what a caller sends to itself alone."""
    one, other = (subprocess.Popen(["/bin/sleep", "99"], start_new_session=True) for _ in range(2))
    call, pid = way.partition(" ")[0], one.pid
    words = {"kill": (pid if way == "kill" else -pid, 15, 0), "tkill": (pid, 15, 0)}
    asked = notify.Request(os.getpid(), os.getpid(), call, words.get(call, (pid, pid, 15)))
    refused = errno.ESRCH if way == "kill its group" else errno.EPERM
    assert notify.decide(asked, lambda: [other.pid]) == refused
    assert [one.poll(), other.poll()] == [None, None]
    assert notify.decide(asked, lambda: [one.pid, other.pid]) == 0
    assert one.wait(20) == -signal.SIGTERM
    assert other.poll() is None
    other.kill()
    other.wait()


@pytest.mark.parametrize(("group", "refused"), [(os.getpgrp(), True), (0, False), (1, False)])
def test_no_process_joins_the_group_of_init(group: int, refused: bool) -> None:
    """The kernel itself sends a signal to the caller's group, whoever is in it."""
    asked = notify.Request(os.getpid(), os.getpid(), "setpgid", (0, group, 0))
    assert (notify.decide(asked, list) == errno.EPERM) is refused
