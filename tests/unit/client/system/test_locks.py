"""Locks: who holds one, for how long, and that a fork does not."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from envhub_sandbox.system.locks import LifeLock, SharedLock, held, is_held, lock, sharers
from tests.support.processes import open_descriptors

SHARE = """
import sys, time
from pathlib import Path
from envhub_sandbox.system.locks import SharedLock
lock = SharedLock(Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.read()
"""


def test_a_lock_is_held_until_its_context_ends(tmp_path: Path) -> None:
    """Another waits for as long as it wants to, and is called once before it waits."""
    path, waits = tmp_path / "lock", []
    with held(path):
        assert is_held(path)
        with (
            pytest.raises(TimeoutError, match="another process holds"),
            held(path, wait_s=0.3, on_wait=lambda: waits.append(1)),
        ):
            pass
    assert waits == [1]
    assert not is_held(path)
    with held(path):
        path.unlink()  # the next makes another, and holds that
        with held(path):
            assert is_held(path)
    lock = LifeLock(tmp_path / "life")
    assert is_held(tmp_path / "life")
    for _ in range(2):
        lock.release()
    assert not is_held(tmp_path / "life")
    SharedLock(tmp_path / "record").release()
    assert not (tmp_path / "record").exists(), "no file is made, and none is needed"


def test_a_lock_of_a_replaced_file_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever comes next would have one as well: of the file that has the name now."""
    path, taken = tmp_path / "lock", []

    def take(descriptor: int, **how: bool) -> None:
        lock(descriptor, **how)
        if not taken:  # its holder has removed it, and another has made it anew
            path.unlink()
            path.touch()
        taken.append(descriptor)

    monkeypatch.setattr("envhub_sandbox.system.locks.lock", take)
    with held(path, wait_s=60):
        assert is_held(path)


def test_an_interrupted_wait_leaves_no_descriptor(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with held(path):
        for _ in range(3):
            with pytest.raises(TimeoutError), held(path):
                pass
        assert open_descriptors(path) == 1
    with pytest.raises(OSError, match="No such file"), held(tmp_path / "none" / "lock"):
        pass
    assert open_descriptors(path) == 0


def test_a_link_is_no_lock(tmp_path: Path) -> None:
    (tmp_path / "lock").symlink_to(tmp_path / "elsewhere")
    for asked in (lambda: held(tmp_path / "lock").__enter__(), lambda: is_held(tmp_path / "lock")):
        with pytest.raises(OSError, match="symbolic links"):
            asked()
    assert not (tmp_path / "elsewhere").exists()


def test_a_life_lock_is_not_held_by_a_fork_nor_by_a_program(tmp_path: Path) -> None:
    source = """
import os, signal, subprocess, sys
from pathlib import Path
from envhub_sandbox.system.locks import LifeLock
lock = LifeLock(Path(sys.argv[1]), "who")
sleeper = subprocess.Popen(["sleep", "600"], stdout=subprocess.DEVNULL, close_fds=False)
if os.fork() == 0:
    lock.release()
    os.write(1, b"here\\n")  # whole lines: two processes write them
    sys.stdin.read()
    os._exit(0)
os.write(1, b"holds %d\\n" % sleeper.pid)
signal.pause()
"""
    path = tmp_path / "life"
    with subprocess.Popen(
        [sys.executable, "-c", source, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        said = dict((*process.stdout.readline().split(), "")[:2] for _ in range(2))
        assert set(said) == {"here", "holds"}
        assert path.read_text() == "who"
        assert is_held(path)
        process.kill()
        process.wait()
        assert not is_held(path)
        os.kill(int(said["holds"]), signal.SIGKILL)


def test_what_several_share_none_has_alone(tmp_path: Path) -> None:
    """Until the last one gives it back, or has gone; the kernel says who they are."""
    path = tmp_path / "record"
    path.touch()
    words = [sys.executable, "-c", SHARE, str(path)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"held\n"
        mine = SharedLock(path)
        assert set(sharers(path)) == {os.getpid(), process.pid}
        mine.release()
        mine.release()
        [(pid, command)] = sharers(path).items()
        assert pid == process.pid
        assert command.startswith(f"{sys.executable} -c")
        with pytest.raises(TimeoutError), held(path):
            pass
        process.kill()
    with held(path):
        pass


def test_a_shared_lock_ends_with_its_object_and_not_with_a_fork(tmp_path: Path) -> None:
    path = tmp_path / "record"
    path.touch()
    lock = SharedLock(path)
    pid = os.fork()
    if pid == 0:
        lock.release()
        os._exit(0)
    os.waitpid(pid, 0)
    with pytest.raises(TimeoutError), held(path):
        pass
    del lock
    with held(path):
        pass
