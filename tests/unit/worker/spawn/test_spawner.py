"""The server's side of zygote, inits and runners, against real processes."""

import errno
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import psutil
import pytest

from envhub_worker import bootstrap
from envhub_worker.lockdown.mechanisms import procfs
from envhub_worker.protocol.confinement import LACKS_PACKAGES, Confinement
from envhub_worker.protocol.runtime import OWN, Runtime
from envhub_worker.spawn import jail_init
from envhub_worker.spawn.channel import Channel
from envhub_worker.spawn.spawner import Spawner, ZygoteDied
from envhub_worker.spawn.zygote import Zygote
from envhub_worker.spawn.zygote_process import ZygoteProcess
from tests.support import inside
from tests.support.confinement_kit import (
    Cell,
    JailExited,
    RunnerExited,
    RunnerStarted,
    make_snapshot,
    new_cell,
    open_folder,
    spawner_in,
    wait_until,
)
from tests.support.interpreter import profiles
from tests.support.processes import eventually

STRICT = Confinement()


@pytest.fixture(scope="module", params=profiles("strict", "no-userns"))
def confinement(request: pytest.FixtureRequest) -> Confinement:
    """Both structures: with a pid namespace that ends everything, and without."""
    return Confinement(profile=request.param, environment={"GRANTED": "yes"})


@pytest.fixture(scope="module")
def zygote(confinement: Confinement) -> Iterator[tuple[Spawner, str]]:
    with open_folder() as folder, spawner_in(folder, confinement) as spawner:
        yield spawner, make_snapshot(folder)


@pytest.fixture
def cell(zygote: tuple[Spawner, str], confinement: Confinement) -> Iterator[Cell]:
    cell = new_cell(*zygote, confinement)
    cell.start()
    yield cell
    cell.jail.kill()
    cell.wait_for(JailExited)  # and so the next one does not hear of it


@pytest.fixture
def folder() -> Iterator[Path]:
    with open_folder() as folder:
        yield folder


def processes_that_mention(text: str) -> list[int]:
    """Pids of other processes with ``text`` in their command line."""
    others = [pid for pid in procfs.pids() if pid != os.getpid()]
    return [pid for pid in others if text.encode() in procfs.content(f"/proc/{pid}/cmdline")]


def test_runner_has_private_home_and_shows_the_snapshot(cell: Cell) -> None:
    """HOME, TMPDIR and the working directory are the jail's own; the snapshot shows through. No
    other user of the host may enter them, where they lie in its folders, or put others there."""
    source = """
import os, tempfile
open('new.txt', 'w').write('x')
home = os.path.expanduser('~')
open(home + '/.config-file', 'w').write('x')
result = [os.listdir(home), tempfile.gettempdir() == os.environ['TMPDIR'],
          open('assets/a.txt').read(), open('env.py').read(),
          [os.stat(path).st_mode & 0o777 for path in (home, os.environ['TMPDIR'])],
          os.stat(home + '/../..').st_mode & 0o022]
"""
    result = cell.run(source)["result"]
    assert result == [[".config-file"], True, "asset", "VALUE = 7\n", [0o700, 0o700], 0]
    assert not (Path(cell.jail.spec.snapshot) / "new.txt").exists()


def test_runners_draw_different_random_numbers(cell: Cell) -> None:
    second = cell.start()
    source = "import random, numpy; result = [random.random(), float(numpy.random.rand())]"
    first_draw, second_draw = cell.run(source), cell.run(source, second)
    assert first_draw["result"][0] != second_draw["result"][0]
    assert first_draw["result"][1] != second_draw["result"][1]


def test_runners_share_a_session_and_lead_groups_of_their_own(cell: Cell) -> None:
    """Linux divides busy cores among sessions: with one each, every wake-up would queue."""
    source = "import os; result = [os.getsid(0), os.getpgrp() == os.getpid()]"
    first, second = cell.run(source)["result"], cell.run(source, cell.start())["result"]
    assert first == second == [first[0], True]
    assert first[0] > 0  # 0 would be a session from outside of the jail


@pytest.mark.parametrize("killed", [True, False])
def test_a_runner_that_ends_takes_children_along(cell: Cell, folder: Path, killed: bool) -> None:
    second = cell.start()
    mark = str(folder / "mark")
    child = f"['/bin/sh', '-c', 'sleep 1000; : {mark}'], start_new_session={killed}"
    cell.run(f"import subprocess; subprocess.Popen({child})")
    wait_until(lambda: processes_that_mention(mark), "the child never came")
    if killed:
        cell.jail.kill_runner(1)
    else:
        cell.hang_up()
    exited = cell.wait_for(RunnerExited)
    assert (exited.runner, exited.reason) == (1, "killed" if killed else "exit")
    wait_until(lambda: not processes_that_mention(mark), "the child lived on")
    assert cell.run("result = 1", second) == {"result": 1}


DAEMON = """
import os, time
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        os.execv('/bin/sh', ['/bin/sh', '-c', 'sleep 1000; : {mark}'])
    os._exit(0)
"""


@pytest.mark.parametrize("end", ["the jail is killed", "its last runner ends"])
def test_no_daemon_outlives_its_jail(cell: Cell, folder: Path, end: str) -> None:
    """A double-forked one in its own session dies with it, or with the last runner."""
    mark = str(folder / "mark")
    cell.run(DAEMON.format(mark=mark))
    wait_until(lambda: processes_that_mention(mark), "the daemon never came")
    if end == "the jail is killed":
        cell.jail.kill()
        cell.jail.kill()
        cell.wait_for(JailExited)
    else:
        cell.hang_up()
        cell.wait_for(RunnerExited)
    wait_until(lambda: not processes_that_mention(mark), "the daemon lived on")


def test_a_process_that_started_ahead_is_used(folder: Path) -> None:
    ahead = ZygoteProcess(OWN, folder, {}, ahead=True)
    with spawner_in(folder, STRICT, ahead=ahead) as spawner:
        cell = new_cell(spawner, make_snapshot(folder), STRICT)
        cell.start()
        assert cell.run("import sys; result = 'gymnasium' in sys.modules") == {"result": True}
        assert inside.zygote_pid(spawner) == ahead.pid
        report = cell.wait_for(RunnerStarted).report
        layers = {layer["layer"] for layer in report if layer["enforced"]}
        assert {"self-test", "seccomp"} <= layers
    assert not os.path.exists(f"/proc/{ahead.pid}")


def test_a_process_of_another_interpreter_is_not(folder: Path) -> None:
    ahead = ZygoteProcess(OWN, folder, {}, ahead=True)
    other = folder / "python"
    other.symlink_to(sys.executable)
    spawner = Spawner(
        STRICT, runtime_dir=folder, readable_roots=[], runtime=Runtime(str(other)), ahead=ahead
    )
    assert inside.zygote_pid(spawner) != ahead.pid
    assert not os.path.exists(f"/proc/{ahead.pid}")
    assert not ahead.folder.exists()
    spawner.close()


def test_a_process_that_nobody_uses_ends_with_its_server(folder: Path) -> None:
    for ending in (signal.SIGTERM, signal.SIGKILL):
        runtime = folder / ending.name
        serve = ["serve", "--endpoint", f"ipc://{folder}/{ending.name}.sock", "--ahead"]
        command = bootstrap.command(sys.executable, "worker", *serve, "--runtime-dir", str(runtime))
        ready, tells = os.pipe()
        server = subprocess.Popen([*command, "--ready-fd", str(tells)], pass_fds=[tells])
        os.close(tells)
        assert os.read(ready, 16)
        os.close(ready)
        [zygote] = psutil.Process(server.pid).children()
        server.send_signal(ending)
        server.wait(60)
        assert eventually(lambda: not zygote.is_running())  # noqa: B023 - asked at once
        assert runtime.exists() == (ending is signal.SIGKILL)


@pytest.mark.parametrize("starved", [False, True])
def test_dead_zygote_is_told_with_its_log(folder: Path, starved: bool) -> None:
    """Without it if no descriptor is left: whoever waits for its jails hears of it all the same."""
    bare = folder / "bare"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(bare)], check=True)
    runtime = Runtime(str(bare / "bin/python"))
    spawner = Spawner(STRICT, runtime_dir=folder, readable_roots=[], runtime=runtime)
    seen: list[Any] = []
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3 if starved else soft, hard))
    try:
        wait_until(lambda: bool(seen.extend(spawner.poll()) or seen), "it lives")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    [died] = seen
    assert isinstance(died, ZygoteDied)
    assert died.code == LACKS_PACKAGES
    assert ("ModuleNotFoundError" in died.log) is not starved
    assert ("pip install cloudpickle gymnasium msgpack numpy pyzmq" in died.log) is not starved
    assert "Traceback" not in died.log
    spawner.close()


def test_requests_wait_for_the_zygote(folder: Path) -> None:
    with spawner_in(folder, STRICT) as spawner:
        snapshot = make_snapshot(folder)
        cells = [new_cell(spawner, snapshot, STRICT) for _ in range(5)]
        for cell in cells:
            cell.start()
        assert [cell.run("result = 1") for cell in cells] == [{"result": 1}] * 5


def test_what_is_not_announced_ends_alone_and_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    """Others of its user may have all the descriptors on their way that the kernel permits."""

    def refuse(channel: Channel, message: dict[str, Any], pid: int) -> None:
        if message["event"] == "spawned":
            raise OSError(errno.ETOOMANYREFS, "Too many references")
        channel.send(message)

    monkeypatch.setattr(jail_init, "run", lambda *_: signal.pause())
    monkeypatch.setattr(Channel, "send_pidfd", refuse)
    server, theirs = Channel.pair()
    output, written = os.pipe()
    zygote = os.fork()
    if zygote == 0:
        server.close()
        Zygote(Channel(theirs), mock.Mock(namespaced=False)).run()
        os._exit(0)
    theirs.close()
    server.send({"op": "spawn", "id": 1}, [output, written])
    os.close(written)
    seen: list[Any] = []
    wait_until(lambda: seen.extend(server.drain()[0]) or len(seen) == 2, "the jail lives")
    assert seen[1] == ({"event": "exited", "id": 1, "code": None, "signal": signal.SIGKILL}, [])
    assert b"Too many references" in os.read(output, 4096)
    server.close()
    assert os.waitpid(zygote, 0)[1] == 0
    os.close(output)
