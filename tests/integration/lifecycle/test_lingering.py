"""The worker server stays a while when the last environment is closed, and never outlives us."""

import os
import threading
from pathlib import Path

import psutil
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.sandboxes.pool import stop_idle
from tests.faults.remains.clients import finish, is_clean, left, line, start
from tests.faults.remains.traces import temporary_root
from tests.support.processes import descendants, eventually
from tests.support.repositories import STILL, write_repository
from tests.support.samples import sample

_ONLY_SERVER = 3  # the server, and its zygote's two
_BEFORE: set[int] = set()
"""What ran below this process before the test: other tests' Hubs, say."""


@pytest.fixture(autouse=True)
def _known() -> None:
    """Its manifest is remembered, and no server is there, when a test begins."""
    with make_env(sample("counter"), n_envs=2, timeouts={"server_idle_s": 0}):
        pass
    stop_idle()
    assert eventually(lambda: not _servers())
    _BEFORE.clear()
    _BEFORE.update(descendants())


def started() -> set[int]:
    return descendants() - _BEFORE


def used(server_idle_s: float | None, **options: object) -> None:
    timeouts = {"server_idle_s": server_idle_s}
    with make_env(sample("counter"), n_envs=2, timeouts=timeouts, **options) as suites:
        suites.env.reset(seed=0)


def _servers() -> set[int]:
    """Pids of this process's worker servers, by the system's word."""
    found = set()
    for child in psutil.Process().children():
        try:
            if "serve" in child.cmdline() and child.status() != psutil.STATUS_ZOMBIE:
                found.add(child.pid)
        except psutil.NoSuchProcess:
            continue
    return found


_TELLING = """
import os

class Telling(Still):
    def cores(self):
        return sorted(os.sched_getaffinity(0))
"""


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="this machine has a single core")
def test_a_program_that_has_fewer_cores_now_gets_another(tmp_path: Path) -> None:
    """New processes of an environment have the cores of the program, as if it had forked them."""
    folder, every = write_repository(tmp_path, STILL + _TELLING), os.sched_getaffinity(0)
    seen = []
    try:
        for own in (every, {max(every)}):
            os.sched_setaffinity(0, own)
            with make_env(folder) as suites:
                seen.append(set(suites.env.call("cores")[0]))
    finally:
        os.sched_setaffinity(0, every)
        stop_idle()
    assert seen == [every, {max(every)}]


def test_a_suite_that_is_not_closed_holds_it() -> None:
    """Between two of its tasks, for longer than a server lingers; the last close lets it go."""
    tasks = {"tasks": 3}
    with make_env(sample("many_tasks"), env_kwargs=tasks):
        pass
    stop_idle()
    timeouts = {"server_idle_s": 0.05}
    suites = make_env(sample("many_tasks"), env_kwargs=tasks, timeouts=timeouts)
    first, second, third = suites["rooms"].values()
    first.reset()
    [server] = _servers()
    first.close()
    assert not eventually(lambda: not _servers(), 1.0)  # twenty times what it would linger
    second.reset()
    assert _servers() == {server}
    second.close()
    third.close()
    assert eventually(lambda: not started())
    suites.close()


def test_many_times_open_and_closed_leaves_one_server_and_nothing_else() -> None:
    """No thread, no descriptor, no process more than after the first time."""
    used(600)
    [server] = _servers()
    process = psutil.Process(server)
    assert eventually(lambda: len(started()) == _ONLY_SERVER)
    ours, its = _descriptors(os.getpid()), process.num_fds()
    threads = threading.active_count()
    for _ in range(12):
        used(600)
    assert _servers() == {server}
    assert eventually(lambda: threading.active_count() <= threads)
    assert eventually(lambda: _descriptors(os.getpid()) <= ours)
    assert eventually(lambda: process.num_fds() <= its)
    assert eventually(lambda: len(started()) == _ONLY_SERVER)
    stop_idle()
    assert not started()


ENDS = {
    "returns": "",
    "os._exit": "os._exit(4)",
    "kills itself": "os.kill(os.getpid(), signal.SIGKILL)",
    "exits in a fork, too": "if os.fork() == 0:\n    sys.exit(0)\nos.wait()",
}


@pytest.mark.parametrize("how", ENDS)
def test_it_never_outlives_its_client(how: str) -> None:
    """However that ends, at once: it has ten minutes left, and nobody waits for them."""
    with temporary_root() as folder:
        client = start(
            folder,
            f"""
suites = made(timeouts={{"server_idle_s": 600}})
suites.close()
import psutil
while len(psutil.Process().children(recursive=True)) != {_ONLY_SERVER}:
    time.sleep(0.05)
say("lingers")
{ENDS[how]}
""",
        )
        assert line(client) == "lingers"
        said = finish(client)
        assert "Exception ignored" not in said
        assert is_clean(folder), left(folder)


def test_a_run_of_the_command_line_does_not_wait_for_it() -> None:
    """``envhub run`` ends with its last line, and its server with it."""
    with temporary_root() as folder:
        client = start(
            folder,
            """
            from envhub_sandbox import Timeouts
            from envhub_sandbox.cli import main
            Timeouts.__record__.defaults["server_idle_s"] = lambda: 600
            sys.argv = ["envhub", "run", REPOSITORY, "--steps", "3"]
            main()
            """,
        )
        finish(client)  # long before a server would have ended by itself
        assert client.returncode == 0
        assert is_clean(folder), left(folder)


def _descriptors(pid: int) -> int:
    return len(os.listdir(f"/proc/{pid}/fd"))
