"""A lock that several share: as long as one has it, another cannot have it alone."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from envhub_sandbox.system.locks import held
from envhub_sandbox.system.shared_lock import SharedLock, sharers

USE = """
import sys, time
from pathlib import Path
from envhub_sandbox.system.shared_lock import SharedLock
lock = SharedLock(Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.read()
"""


def test_what_several_share_none_has_alone(tmp_path: Path) -> None:
    """Until the last one gives it back, or has gone; the kernel says who they are."""
    path = tmp_path / "record"
    path.touch()
    words = [sys.executable, "-c", USE, str(path)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
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
    """A fork that ends gives nothing back, and one that stays holds nothing."""
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


def test_nothing_is_shared_where_there_is_nothing(tmp_path: Path) -> None:
    """No file is made, and none is needed."""
    SharedLock(tmp_path / "record").release()
    assert list(tmp_path.iterdir()) == []
