"""What stands in on macOS and Windows for what Linux alone has, in processes that pretend to run
there; ``tests/unit/client/system/test_platform.py`` has what needs none."""

import json
import subprocess
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.support.elsewhere import interpreter
from tests.support.elsewhere.kit import SYSTEMS, command, elsewhere
from tests.support.processes import eventually

_FACES = ("envhub_sandbox.integrations",)  # of libraries that look at the platform themselves
_LOOKS = """
import importlib, json, pkgutil, sys
import envhub_sandbox
alone, gone = map(json.loads, sys.argv[1:])
for one in pkgutil.walk_packages(envhub_sandbox.__path__, "envhub_sandbox."):
    if not any(f"{one.name}.".startswith(f"{name}.") for name in alone):
        importlib.import_module(one.name)
from envhub_sandbox.hub.reference import is_local
from envhub_sandbox.system import platform
found = [sorted(sys.modules), is_local("C:\\\\env"), sorted(platform.own_variables())]
there = []
for text in gone:
    try:
        exec(text, {"__name__": "envhub_sandbox.pretended"})
        there.append(text)
    except (AttributeError, ImportError, OSError):
        pass
print(json.dumps([*found, there]))
"""
_GONE = {
    "darwin": (
        *("import os; os.memfd_create", "import os; os.pidfd_open", "import os; os.eventfd"),
        *("import os; os.sched_getaffinity", "import socket; socket.SO_PEERCRED"),
        *("import ctypes; ctypes.CDLL(None).prctl", "open('/proc/self/status')"),
        *("import os; os.stat('/proc/self')", "from pathlib import Path; Path('/sys').stat()"),
    ),
    "win32": (
        *("import fcntl", "import pwd", "import resource", "import os; os.fork"),
        *("import os; os.geteuid", "import os; os.register_at_fork", "import os; os.O_NOFOLLOW"),
        *("import socket; socket.AF_UNIX", "import signal; signal.SIGALRM"),
        *("import select; select.poll", "import os; os.open('/tmp', os.O_RDONLY)"),
    ),
}
_HOLDS = """
import sys
from pathlib import Path
from envhub_sandbox.system.locks import LifeLock, held
path = Path(sys.argv[1])
life = LifeLock(path / "alive", "words")
with held(path / "lock"):
    print("holds", flush=True)
    sys.stdin.read()
"""
_ASKS = """
import sys
from pathlib import Path
from envhub_sandbox.system.locks import held, is_held
path = Path(sys.argv[1])
for _ in range(2):
    taken = [is_held(path / name) for name in ("alive", "lock")]
    try:
        with held(path / "lock"):
            taken.append(False)
    except TimeoutError:
        taken.append(True)
    print(taken, (path / "alive").read_text(), flush=True)
    sys.stdin.readline()
"""
_STARTS = """
import os, subprocess, sys, time
from envhub_sandbox.system.platform import end_with, pidfd
with pidfd() as ourselves:
    command = [sys.executable, "-I", "-c", sys.argv[1], str(ourselves)]
    child = subprocess.Popen(command, pass_fds=(ourselves,), start_new_session=True)
fork = os.fork()
if fork == 0:
    os.dup2(os.open(os.devnull, os.O_RDWR), 1)
    time.sleep(3600)
print(child.pid, fork, flush=True)
time.sleep(3600)
"""
_FOLLOWS = """
import sys, time
from envhub_sandbox.system.platform import end_with, pidfd
end_with(int(sys.argv[1]), 0.0)
time.sleep(3600)
"""
_ALARMED = """
import _thread, threading, time
from envhub_sandbox.extras.judge.command.deadline import DeadlineReached, deadline_alarm

def wait():  # Windows interrupts one sleep, Linux only what follows it
    for _ in range(600):
        time.sleep(0.1)

try:
    with deadline_alarm(0.2):
        wait()
except DeadlineReached:
    print("reached")
with deadline_alarm(60):
    try:
        threading.Timer(0.2, _thread.interrupt_main).start()
        wait()
    except DeadlineReached:
        print("wrong")
    except KeyboardInterrupt:
        print("interrupted")
"""
_PARSES = """
import time
from envhub_sandbox.extras.sources import parser
parser.CPU_S = 5.0
whole = parser.described
parser.described = lambda data: time.sleep(60) if b"slow" in data else whole(data)
parser.main()
"""


@pytest.mark.parametrize("system", SYSTEMS)
def test_every_module_can_be_imported(system: str) -> None:
    """And none of them imports what only Linux uses, which is not there; the control finds it here.
    A folder with a drive is here on Windows, where no program starts without some variables; of the
    others of the environment nothing is handed on."""
    alone = interpreter.LINUX_ALONE
    for text in _GONE[system]:
        exec(text, {"__name__": "envhub_sandbox.pretended"})
    given = json.dumps([*alone, *_FACES]), json.dumps([*_GONE[system], "import os"])
    answer = json.loads(elsewhere(system, _LOOKS, *given, HF_TOKEN="secret"))
    found, has_drives, variables, there = answer
    assert "envhub_sandbox.extras.docker.published" in found
    assert not [name for name in found if name in alone]
    assert there == ["import os"]
    assert has_drives is (system == "win32")
    assert ("SYSTEMROOT" in variables) is (system == "win32")
    assert "HF_TOKEN" not in variables


def test_locks_hold_between_processes_on_windows(tmp_path: Path) -> None:
    """And are given back by the end of the one that had them; what a file holds can be read. On
    macOS they are those of Linux, which ``test_locks`` has."""

    def started(program: str) -> subprocess.Popen[str]:
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        return subprocess.Popen(command("win32", "-c", program, tmp_path), text=True, **pipes)

    with started(_HOLDS) as holder:
        assert holder.stdout.readline() == "holds\n"
        with started(_ASKS) as asking:
            assert asking.stdout.readline() == "[True, True, True] words\n"
            holder.kill()
            holder.wait()
            asking.stdin.write("\n\n")
            asking.stdin.flush()
            assert asking.stdout.readline() == "[False, False, False] words\n"


def test_a_child_on_macos_ends_with_its_parent() -> None:
    """By a pipe in place of a pidfd, which a fork of the parent does not keep open."""
    words = command("darwin", "-c", _STARTS, _FOLLOWS)
    parent = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    with parent:
        child, fork = map(int, parent.stdout.readline().split())
        assert psutil.pid_exists(child)
        parent.kill()
    try:
        assert eventually(lambda: not psutil.pid_exists(child))
        assert psutil.pid_exists(fork)
    finally:
        psutil.Process(fork).kill()


def test_a_deadline_comes_on_windows_too() -> None:
    assert elsewhere("win32", _ALARMED).split() == ["reached", "interrupted"]


def test_a_parser_ends_on_windows_too() -> None:
    texts = [b"import numpy", b"slow", b"import torch"]
    given = b"".join(len(text).to_bytes(4, "big") + text for text in texts)
    done = subprocess.run(
        command("win32", "-c", _PARSES), input=given, capture_output=True, timeout=120, check=False
    )
    assert done.returncode != 0
    [line] = done.stdout.splitlines()
    assert json.loads(line)["imports"][0][2] == ["numpy"]
