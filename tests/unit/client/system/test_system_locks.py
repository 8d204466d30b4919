"""Locks: who holds one, for how long, and that a fork does not."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from envhub_sandbox.system.locks import LifeLock, held, is_held


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
    with (
        held(path, shared=True),
        held(path, shared=True),
        pytest.raises(TimeoutError),
        held(path),
    ):
        pass


def test_the_holder_may_remove_the_file(tmp_path: Path) -> None:
    """The next makes another, and holds that."""
    path = tmp_path / "lock"
    with held(path):
        path.unlink()
        with held(path):
            assert is_held(path)


def test_an_interrupted_wait_leaves_no_descriptor(tmp_path: Path) -> None:
    """Nor does a lock that was not free."""
    path, before = tmp_path / "lock", len(os.listdir("/proc/self/fd"))
    with held(path):
        for _ in range(3):
            with pytest.raises(TimeoutError), held(path):
                pass
    with pytest.raises(OSError, match="No such file"), held(tmp_path / "none" / "lock"):
        pass
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_link_is_no_lock(tmp_path: Path) -> None:
    """Nobody makes us open, or create, what lies elsewhere."""
    (tmp_path / "lock").symlink_to(tmp_path / "elsewhere")
    for asked in (lambda: held(tmp_path / "lock").__enter__(), lambda: is_held(tmp_path / "lock")):
        with pytest.raises(OSError, match="symbolic links"):
            asked()
    assert not (tmp_path / "elsewhere").exists()


def test_a_life_lock_is_not_held_by_a_fork_nor_by_a_program(tmp_path: Path) -> None:
    """It ends with its holder, although both live on."""
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
        assert process.stdout is not None
        said = dict((*process.stdout.readline().split(), "")[:2] for _ in range(2))
        assert set(said) == {"here", "holds"}
        assert path.read_text() == "who"
        assert is_held(path)
        process.kill()
        process.wait()
        assert not is_held(path)
        os.kill(int(said["holds"]), signal.SIGKILL)


def test_a_life_lock_can_be_given_back(tmp_path: Path) -> None:
    """And again, which does nothing."""
    lock = LifeLock(tmp_path / "life")
    assert is_held(tmp_path / "life")
    for _ in range(2):
        lock.release()
    assert not is_held(tmp_path / "life")
