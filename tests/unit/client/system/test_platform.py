"""What stands in on macOS and Windows for what Linux alone has, and which names are others there.
``tests/attacks/files/test_names.py`` has what the names are for."""

import configparser
import json
import os
import subprocess
from pathlib import Path
from typing import Any

import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox.system import platform
from envhub_sandbox.system.platform import ignores_case, taken_as_one, wrong_here, wrong_on_windows
from tests.support.elsewhere import interpreter
from tests.support.elsewhere.caseless import without_case
from tests.support.elsewhere.kit import SYSTEMS, command, elsewhere
from tests.support.processes import eventually

_SETTINGS = Path(__file__).parents[4] / ".ci" / "elsewhere.ini"
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


def test_type_checkers_know_the_same_modules() -> None:
    """What they pass over elsewhere is what no client there imports."""
    settings = configparser.ConfigParser()
    settings.read(_SETTINGS)
    named = {
        section.removeprefix("mypy-").removesuffix(".*")
        for section in settings.sections()
        if settings.getboolean(section, "ignore_errors", fallback=False)
    }
    assert named == set(interpreter.LINUX_ALONE)


def test_this_platform_is_linux() -> None:
    assert (platform.IS_LINUX, platform.IS_WINDOWS, platform.NAME) == (True, False, "linux")
    assert platform.user_id() == os.geteuid()
    assert platform.own_cpus() == sorted(os.sched_getaffinity(0))
    assert platform.open_flags("O_NOFOLLOW", "O_NONSENSE") == os.O_NOFOLLOW
    assert platform.own_variables() == {}
    assert platform.boot_id() == Path("/proc/sys/kernel/random/boot_id").read_text().strip()


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


@pytest.mark.parametrize("name", ["a:b", "C:/x", "con", "CON.py", "x/nul", "lpt\u00b3", "a.", "a "])
def test_windows_reads_it_as_another(name: str) -> None:
    """Here it is a name as any other; what only begins like a device is one there, too."""
    assert wrong_on_windows(name)
    assert wrong_here(name) is None
    for same in ("env.py", "a b/c.d", "\u0436.txt", ".hidden", "icon", "com"):
        assert wrong_on_windows(same) is None


@given(st.lists(st.text("aAbB/\u00e9", min_size=1, max_size=6), max_size=6, unique=True))
def test_what_is_one_without_case_is_found(paths: list[str]) -> None:
    """Whichever names there are: those that fold to the same are found, and no others."""
    paths = [path for path in paths if "" not in path.split("/")]
    prefixes = {
        "/".join(path.split("/")[:end]) for path in paths for end in range(1, path.count("/") + 2)
    }
    clash = len({prefix.casefold() for prefix in prefixes}) < len(prefixes)
    assert (taken_as_one(paths) is not None) is clash


def test_a_file_system_is_tried(tmp_path: Path) -> None:
    assert not ignores_case(tmp_path)
    with without_case(tmp_path):
        assert ignores_case(tmp_path)
    assert not list(tmp_path.iterdir())
