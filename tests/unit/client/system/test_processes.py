"""A process that ends with the one that started it, and knows its forks."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

import envhub_sandbox
import envhub_worker
from envhub_sandbox.system.platform import OwnerProcess, fork_error_text, pidfd
from envhub_sandbox.system.threads import Calls
from tests.support.command_line import python, runs
from tests.support.processes import eventually

_PARENT = """
import fcntl, resource, subprocess, sys, threading, time
from envhub_sandbox.system.platform import end_with, pidfd

def start():
    with pidfd() as ourselves:
        number = ourselves
        if sys.argv[1] == "high":  # beyond what select() can wait for
            _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
            resource.setrlimit(resource.RLIMIT_NOFILE, (min(most, 2048), most))
            number = fcntl.fcntl(ourselves, fcntl.F_DUPFD, 1500)
        command = [sys.executable, "-I", "-c", sys.argv[2], str(number), sys.argv[1]]
        subprocess.Popen(command, pass_fds=(number,), start_new_session=True)

thread = threading.Thread(target=start)  # which is no reason to end
thread.start()
thread.join()
time.sleep(3600)
"""
_CHILD = """
import os, signal, subprocess, sys, time
from envhub_sandbox.system.platform import end_with, pidfd

def end(*_):
    open("ended", "x").close()
    os._exit(7)

how = sys.argv[2]
signal.signal(signal.SIGTERM, signal.SIG_IGN if how == "stubborn" else end)
below = subprocess.Popen([sys.executable, "-I", "-c", "import time; time.sleep(3600)"])
if how != "nobody":
    patience = {"at once": 0.0, "stubborn": 0.1}.get(how, 600.0)
    end_with(int(sys.argv[1]), patience)
print(os.getpid(), below.pid, flush=True)
time.sleep(3600)
"""


@contextlib.contextmanager
def family(how: str, folder: Path) -> Iterator[tuple[subprocess.Popen[str], list[psutil.Process]]]:
    command = [sys.executable, "-I", "-c", _PARENT, how, _CHILD]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder) as parent:
        below = [psutil.Process(int(word)) for word in parent.stdout.readline().split()]
        try:
            assert len(below) == 2
            yield parent, below
        finally:
            for one in (parent, *below):
                with contextlib.suppress(psutil.NoSuchProcess):
                    one.kill()


@pytest.mark.parametrize("how", ["high", "at once", "stubborn"])
def test_it_ends_when_its_parent_is_killed(how: str, tmp_path: Path) -> None:
    """Not when the thread ends that started it; as SIGTERM says if it may, by force if it must."""
    with family(how, tmp_path) as (parent, (child, below)):
        assert runs(child)
        parent.kill()
        assert eventually(lambda: not runs(child), 120)
        cleaned = how == "high"
        assert (tmp_path / "ended").exists() is cleaned
        if not cleaned:
            assert eventually(lambda: not runs(below), 120), "it is in the group"


def test_without_it_it_would_stay(tmp_path: Path) -> None:
    """The control: another's end is told to nobody."""
    with family("nobody", tmp_path) as (parent, (child, _)):
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        assert runs(child)
        assert not (tmp_path / "ended").exists()


def test_a_fork_is_another_process() -> None:
    with pidfd() as ourselves:  # for one alone: not for who is started meanwhile
        assert not os.get_inheritable(ourselves)
    owner = OwnerProcess()
    assert owner.is_here
    child = os.fork()
    if child == 0:  # pragma: no cover
        os._exit(0 if not owner.is_here and str(os.getpid()) in fork_error_text(owner.pid) else 1)
    assert os.waitpid(child, 0)[1] == 0
    assert f"belongs to process {owner.pid}" in fork_error_text(owner.pid)
    assert "belongs to another process" in fork_error_text()


# --- Calls side by side: all are waited for, and each keeps what it returned or raised


DEADLINE_S = 60.0


def test_calls_run_at_the_same_time() -> None:
    """Each waits for the others, so that one after the other would never end."""
    barrier = threading.Barrier(8)
    calls = Calls([lambda: barrier.wait(DEADLINE_S)] * 8)
    assert calls.wait(DEADLINE_S)
    assert sorted(one.result() for one in calls.each) == list(range(8))


def test_each_keeps_its_own_failure() -> None:
    def fails() -> int:
        raise ValueError("this one")

    calls = Calls([lambda: 1, fails, lambda: 3])
    assert calls.wait(DEADLINE_S)
    assert [one.value for one in calls.each] == [1, None, 3]
    with pytest.raises(ValueError, match="this one"):
        calls.each[1].result()
    with pytest.raises(ValueError, match="this one"):
        calls.results()
    assert Calls([lambda: 1, lambda: 2, lambda: 3], at_once=1).results() == [1, 2, 3]


def test_without_a_thread_for_each_no_call_begins_later(monkeypatch: pytest.MonkeyPatch) -> None:
    go_on, begun, threads = threading.Event(), threading.Event(), []

    def start(thread: threading.Thread) -> None:
        if threads:
            raise RuntimeError("can't start new thread")
        threads.append(thread)
        begin(thread)

    begin = threading.Thread.start
    monkeypatch.setattr(threading.Thread, "start", start)
    with pytest.raises(RuntimeError):
        Calls([lambda: go_on.wait(DEADLINE_S), begun.set])
    go_on.set()
    threads[0].join()
    assert not begun.is_set()


def test_a_wait_may_end_before_the_calls() -> None:
    go_on = threading.Event()
    calls = Calls([lambda: go_on.wait(DEADLINE_S)])
    assert not calls.wait(0.05)
    assert not calls.each[0].done
    go_on.set()
    assert calls.wait(DEADLINE_S)
    assert Calls([]).wait(), "nothing to do is done, without any thread"


def test_a_program_of_ours_is_this_code_and_need_not_be_installed(tmp_path: Path) -> None:
    for package in (envhub_sandbox, envhub_worker):
        (tmp_path / package.__name__).symlink_to(Path(package.__file__).parent)
    (tmp_path / "told.py").write_text(
        "import envhub_sandbox, sys\nprint(envhub_sandbox.__file__, __name__, *sys.argv[1:])"
    )
    start = "import subprocess\nfrom envhub_sandbox.system.platform import program\n"
    start += "subprocess.run([*program('told'), 'word'], check=True)"
    # the folder goes before the variable, and may be a checkout
    done = python("-c", start, cwd=Path("/"), PYTHONPATH=str(tmp_path))
    assert done.stdout.split() == [f"{tmp_path}/envhub_sandbox/__init__.py", "__main__", "word"]
