"""What is denied can be recorded; who is recorded gets no further by it, and hides nothing."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import DependencyError, LoadError, WorkerDiedError
from tests.attacks.repositories import PLAIN, write_environment
from tests.support import inside
from tests.support.interpreter import profiles
from tests.support.repositories import write_repository

_ATTEMPTS = """
import ctypes, os, socket

LIBC = ctypes.CDLL(None, use_errno=True)

def answer(call, *arguments):
    return 0 if call(*arguments) == 0 else ctypes.get_errno()

def inet():
    try:
        socket.socket(socket.AF_INET).close()
    except OSError as error:
        return error.errno
    return 0

def attempts():
    return [
        inet(),
        answer(LIBC.unshare, 0x10000000),
        answer(LIBC.ptrace, 16, os.getppid(), 0, 0),
        answer(LIBC.mount, b"none", b"/tmp", b"tmpfs", 0, 0),
    ]

class Attempts(Plain):
    observation_space = gym.spaces.Box(0, 200, (4,), np.int64)

    def step(self, action):
        if action == 0:
            for _ in range(2000):
                inet()
        return np.array(attempts(), np.int64), 0.0, False, False, {}
"""


def attempts(denied: Sequence[str]) -> list[str]:
    """Without what allocators and pools of threads try on their way."""
    assert len(set(denied)) == len(denied)
    return sorted(set(denied) - inside.HARMLESS_DENIALS)


def test_a_recorded_jail_is_refused_the_same(tmp_path: Path) -> None:
    """With the same errors; each attempt is told once, however often, and only where it is asked.
    The control is the jail that records nothing, and the reset that tries nothing: the jail's own
    test of its denials is no attempt of the repository."""
    folder = write_environment(tmp_path / "attempts", _ATTEMPTS)
    answers = {}
    for recorded in (False, True):
        with make_env(str(folder), policy={"record_denials": recorded}) as suites:
            env = suites.env
            env.reset(seed=0)
            denied = env.sandbox.denials()
            assert (attempts(denied) if recorded else denied) == ([] if recorded else None)
            answers[recorded] = env.step([1])[0].tolist()
            env.step([0])
            told = env.sandbox.denials()
        assert env.sandbox.denials() is None, "it does not run any more"
    assert 0 not in answers[True][0]
    assert answers[True] == answers[False]
    assert attempts(told) == ["mount", "ptrace", "socket AF_INET", "unshare"]


_PROCESSES = """
import os, signal

def answer(act, *arguments):
    try:
        act(*arguments)
    except OSError as error:
        return error.errno
    return 0

class Processes(Plain):
    def own(self):
        child = os.fork()
        if child == 0:
            signal.pause()
            os._exit(0)
        os.close(os.pidfd_open(child))
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setscheduler(child, os.SCHED_OTHER, os.sched_param(0))
        os.kill(os.getpid(), signal.SIGURG)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return [answer(os.kill, child, signal.SIGTERM), answer(os.kill, os.getppid(), 0)]

    def others(self, number):
        idle = os.SCHED_IDLE, os.sched_param(0)
        return [
            answer(os.kill, os.getppid(), signal.SIGURG),
            answer(os.kill, number, signal.SIGURG),
            answer(os.sched_setscheduler, os.getppid(), *idle),
            answer(os.setpriority, os.PRIO_PROCESS, os.getppid(), 5),
            answer(open, f"/proc/{number}/cmdline"),
        ]
"""
_NOBODY = 1 << 30


@pytest.mark.parametrize("profile", profiles("strict", "no-userns"))
def test_who_names_a_process_that_is_not_its_own_is_told(home: Path, profile: str) -> None:
    """And is answered as ever; of its own ones, and of one that has ended, nothing is told.
    The controls are the jail that records nothing, and what the repository does with its own."""
    folder = write_environment(home / "processes", _PROCESSES)
    answers, told = {}, {}
    for recorded in (False, True):
        policy = {"profile": profile, "record_denials": recorded}
        with make_env(str(folder), policy=policy) as suites:
            env = suites.env
            env.reset(seed=0)
            own = env.call("own")
            told[recorded] = env.sandbox.denials()
            answers[recorded] = own, env.call("others", _NOBODY)
            after = env.sandbox.denials()
    assert answers[True] == answers[False]
    assert told[False] is None
    assert attempts(told[True] or ()) == []
    assert attempts(after) == [
        "kill OTHER_PROCESS",
        f"read /proc/{_NOBODY}/cmdline",
        "sched_setscheduler OTHER_PROCESS",
        "setpriority OTHER_PROCESS",
    ]


_GREEDY = """
import os, threading

kept = []

def until_refused(take):
    try:
        while True:
            kept.append(take())
    except (OSError, RuntimeError):
        return len(kept)

class Greedy(Plain):
    def threads(self):
        def take():
            threading.Thread(target=threading.Event().wait, daemon=True).start()
        return until_refused(take)

    def bytes(self):
        file = os.open("large", os.O_WRONLY | os.O_CREAT)
        return until_refused(lambda: os.write(file, bytes(1 << 20)))

    def files(self):
        def take():
            os.close(os.open(f"file-{len(kept)}", os.O_WRONLY | os.O_CREAT))
        os.unlink("large")
        return until_refused(take)

    def descriptors(self):
        return until_refused(lambda: os.open("env.py", os.O_RDONLY))
"""
_FEW = {"processes": 64, "disk_bytes": 64 << 20, "disk_files": 2000, "open_files": 256}


@pytest.mark.parametrize("profile", profiles("strict"))
def test_limits_that_are_used_up_are_told(home: Path, profile: str) -> None:
    """By what the kernel and the file system say; the control is the same jail before each."""
    folder = write_environment(home / "greedy", _GREEDY)
    expected: set[str] = set()
    policy = {"profile": profile, "record_denials": True}
    with make_env(str(folder), policy=policy, limits=_FEW) as suites:
        env = suites.env
        env.reset(seed=0)
        for deed, limit in (
            ("threads", "PROCESSES"),
            ("bytes", "DISK_BYTES"),
            ("files", "DISK_FILES"),
            ("descriptors", "OPEN_FILES"),
        ):
            assert set(attempts(env.sandbox.denials() or ())) == expected
            env.call(deed)
            expected.add(f"limit {limit}")
        assert set(attempts(env.sandbox.denials() or ())) == expected


_FILES = """
import ctypes, os, socket, threading

LIBC = ctypes.CDLL(None, use_errno=True)

def answer(act):
    try:
        act()
    except OSError as error:
        return error.errno
    return 0

def race(own, foreign, rounds):
    \"\"\"Open what is its own while another thread writes another's name over it.\"\"\"
    path = ctypes.create_string_buffer(4096)
    going = True
    def swap():
        while going:
            path.value = foreign.encode()
            path.value = own.encode()
    thread = threading.Thread(target=swap)
    thread.start()
    for _ in range(rounds):
        fd = LIBC.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        if fd >= 0:
            os.write(fd, b"written")
            os.close(fd)
    going = False
    thread.join()
    return rounds

class Files(Plain):
    def reset(self, **given):
        with open("own", "w") as file:
            file.write("x")
        os.rename("own", "mine")
        os.unlink("mine")
        return super().reset(**given)

    def attempts(self, folder):
        return [
            answer(lambda: open(f"{folder}/x\\x1b", "a")),
            answer(lambda: os.unlink(f"{folder}/y")),
            answer(lambda: os.rename(f"{folder}/a", f"{folder}/b")),
            answer(lambda: open("/root/.netrc")),
        ]

    def flood(self, folder):
        for number in range(200):
            answer(lambda: open(f"{folder}/{number}", "a"))
        for family in range(3, 46):
            answer(lambda: socket.socket(family))
            answer(lambda: socket.socketpair(family))
        LIBC.unshare(0x10000000)

    def race(self, folder, rounds):
        return race(os.path.abspath("own"), f"{folder}/there", rounds)
"""


def test_files_that_are_asked_for_are_told(tmp_path: Path) -> None:
    """As they are refused anyway; of a flood of files or sockets a few, and it hides nothing else.
    The controls are the jail that records nothing, and what the repository does with its own."""
    folder = write_environment(tmp_path / "files", _FILES)
    answers = {}
    for recorded in (False, True):
        with make_env(str(folder), policy={"record_denials": recorded}) as suites:
            env = suites.env
            env.reset(seed=0)
            assert env.sandbox.denials() == (() if recorded else None)
            answers[recorded] = env.call("attempts", "/home/other")
            told = env.sandbox.denials()
            env.call("flood", "/home/other")
            after = env.sandbox.denials()
    assert 0 not in answers[True][0]
    assert answers[True] == answers[False]
    assert told == (
        "write /home/other/x\\x1b",
        "unlink /home/other/y",
        "rename /home/other/a",
        "rename /home/other/b",
        "read /root/.netrc",
    )
    assert "unshare" in after
    assert len([one for one in after if "/" in one]) == 32
    assert len([one for one in after if " AF_" in one]) == 32


_ENDINGS = {
    "raises": ("raise RuntimeError('it failed')", LoadError, ""),
    "wants more": ("import nothing_of_this_name", DependencyError, "module"),
    "is killed": ("os.kill(os.getpid(), 9)", WorkerDiedError, "signal"),
    "crashes": ("ctypes.string_at(0)", WorkerDiedError, "signal"),
    "breaks the rules": (
        """
for fd in range(3, 256):
    try:
        os.write(fd, b"\\xff" * 64 if stat.S_ISSOCK(os.fstat(fd).st_mode) else b"")
    except OSError:
        continue
signal.pause()
""",
        WorkerDiedError,
        "protocol",
    ),
}
_ENDED = """
import ctypes, os, signal, socket, stat

for attempt in (lambda: socket.socket(socket.AF_INET), lambda: open("/home/other/file", "a")):
    try:
        attempt()
    except OSError:
        pass
"""


@pytest.mark.parametrize("ending", _ENDINGS)
def test_what_ends_a_jail_tells_what_it_was_denied(ending: str, tmp_path: Path) -> None:
    """In the error that it ends with, and in the bundle, however it ends while it loads.
    The control is the same where nothing is recorded."""
    text, kind, reason = _ENDINGS[ending]
    folder = write_repository(tmp_path / "ended", f"{_ENDED}\n{text}\n")
    for recorded in (True, False):
        policy = {"record_denials": recorded, "crash_folder": str(tmp_path / f"crashes-{recorded}")}
        with pytest.raises(kind) as raised:
            make_env(str(folder), policy=policy)
        error = raised.value
        expected = ("socket AF_INET", "write /home/other/file") if recorded else None
        assert error.denied == expected
        assert getattr(error, "reason", "") == reason
        if isinstance(error, WorkerDiedError):
            written = json.loads((Path(error.bundle) / "bundle.json").read_text())["denied"]
            assert written == (list(expected) if expected else None)


_SECOND = """
import os
import gymnasium as gym

made = []

class First(gym.Env):
    observation_space = action_space = gym.spaces.Discrete(2)

    def __init__(self):
        made.append(self)

class Second(First):
    def __init__(self):
        if not made:  # nor is it described
            try:
                open("/home/other/file", "a")
            except OSError:
                os.abort()

def make_env(n_envs=1, use_async_envs=False):
    return {
        "suite": {
            task: gym.vector.AsyncVectorEnv([kind] * n_envs)
            for task, kind in (("first", First), ("second", Second))
        }
    }
"""


def test_what_is_denied_while_a_known_environment_is_built_is_told(tmp_path: Path) -> None:
    """In a jail of its own, of which nobody but its server knows once it has died."""
    folder = write_repository(tmp_path / "second", _SECOND)
    with make_env(str(folder), policy={"prewarm": 0, "record_denials": True}) as suites:
        env = suites["suite"]["second"]
        with pytest.raises(WorkerDiedError) as raised:
            env.reset()
        assert raised.value.denied == ("write /home/other/file",)
        assert env.sandbox.denials() is None


@pytest.mark.parametrize("profile", profiles("no-userns"))
def test_who_is_seen_asking_gets_no_further(home: Path, profile: str) -> None:
    """The name that is looked at may be another than the one that is opened; the kernel decides.
    The control is the same race without a sandbox."""
    foreign = home / "there"
    foreign.touch()
    foreign.chmod(0o666)
    folder = write_environment(home / "files", _FILES)
    policy = {"profile": profile, "record_denials": True}
    with make_env(str(folder), policy=policy) as suites:
        suites.env.reset()
        assert list(suites.env.call("race", str(home), 100)) == [100]
    assert foreign.read_text() == ""
    outside = f"{PLAIN}{_FILES}\nwhile not os.path.getsize({str(foreign)!r}):\n"
    outside += f"    race({str(home / 'own')!r}, {str(foreign)!r}, 100)\n"
    subprocess.run([sys.executable, "-c", outside], check=True, timeout=300)
