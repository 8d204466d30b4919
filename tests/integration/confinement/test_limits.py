"""Each limit of a jail stops what it names; the same source without a jail goes through."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import pytest

from envhub_worker.lockdown.limits import cgroups
from envhub_worker.protocol.confinement import MIB, Confinement, Limits
from tests.support.confinement_kit import (
    Cell,
    RunnerExited,
    RunnerStarted,
    cell_in,
    new_cell,
    open_folder,
    unconfined,
)
from tests.support.interpreter import needs, profiles

MEMORY = 200 * MIB
BOMB = 420 * MIB
HEAP = f"b = bytearray({BOMB}); b[::4096] = b'x' * len(b[::4096]); result = 'filled'"
SHARED = f"import mmap; m = mmap.mmap(-1, {BOMB}); m.write(bytes({BOMB})); result = 'filled'"
MEMFD = f"""
import os
fd = os.memfd_create("bomb")
for _ in range({BOMB // MIB}):
    os.write(fd, bytes({MIB}))
result = "filled"
"""
SYSTEM_V = f"""
import ctypes
libc = ctypes.CDLL(None, use_errno=True)
libc.shmat.restype = ctypes.c_void_p
key = libc.shmget(0, ctypes.c_size_t({BOMB}), 0o1600)
if key < 0:
    raise OSError(ctypes.get_errno(), "shmget")
place = libc.shmat(key, None, 0)
libc.shmctl(key, 0, None)
ctypes.memset(place, 1, {BOMB})
result = "filled"
"""
REFUSED = {SYSTEM_V: "OSError", SHARED: "PermissionError", MEMFD: "OSError"}
"""System V has none in any jail; init, where it measures, could not see the others."""
MANY_PROCESSES = f"""
import os, time
for _ in range(7):
    if os.fork() == 0:
        b = bytearray({BOMB // 7}); b[::4096] = b'x' * len(b[::4096])
        time.sleep(1000)
time.sleep(1000)
"""


@contextmanager
def limited(profile: str, **limits: int) -> Iterator[Cell]:
    confinement = Confinement(profile=profile, limits=Limits(**limits))
    with open_folder() as folder, cell_in(folder, confinement) as cell:
        cell.wait_for(RunnerStarted)
        yield cell


@cache
def _filled(bomb: str) -> bool:
    """The control, once for all profiles."""
    return unconfined(bomb) == {"result": "filled"}


@pytest.fixture(params=profiles("strict", "no-userns"))
def profile(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(params=["cgroup", "watchdog"])
def counted(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "watchdog":
        monkeypatch.setattr(cgroups, "discover", lambda: None)
    elif cgroups.discover() is None:
        pytest.skip("this user may not make control groups")
    return str(request.param)


@pytest.mark.parametrize("counted", ["watchdog"], indirect=True)  # else tests/attacks has them
def test_every_kind_of_memory_counts_or_cannot_be_had(profile: str, counted: str) -> None:
    """The runner ends as out of memory and knows."""
    with limited(profile, memory_bytes=MEMORY) as cell:
        for bomb, error in REFUSED.items():
            assert _filled(bomb)
            assert cell.run(bomb)["error"] == error
        assert _filled(HEAP)
        assert cell.run(HEAP) == {"error": "the runner has gone"}
        exited = cell.wait_for(RunnerExited)
    assert exited.reason == "out-of-memory"
    assert exited.detail


def test_memory_of_all_processes_counts_together(profile: str, counted: str) -> None:
    """Seven children that are each below the limit are over it together."""
    with limited(profile, memory_bytes=MEMORY) as cell:
        assert cell.run(MANY_PROCESSES) == {"error": "the runner has gone"}
        assert cell.wait_for(RunnerExited).reason in ("out-of-memory", "signal")


SHARED_BY_FORKS = """
import os, time
b = bytearray(100 * 2**20); b[::4096] = b'x' * len(b[::4096])
for _ in range(4):
    if os.fork() == 0:
        time.sleep(1000)
time.sleep(2)
result = "alive"
"""


def test_memory_that_forks_share_counts_once(counted: str) -> None:
    """Children that only share their parent's pages do not add up."""
    with limited("strict", memory_bytes=MEMORY) as cell:
        assert cell.run(SHARED_BY_FORKS) == {"result": "alive"}


FORKS = """
import os, time
children = 0
try:
    while children < 300:
        if os.fork() == 0:
            time.sleep(1000)
        children += 1
except OSError as error:
    result = [children, error.errno]
else:
    result = [children, 0]
"""


def test_jails_of_one_zygote_do_not_share_the_process_limit() -> None:
    """Another jail forks on while the first is at its limit."""
    confinement = Confinement(limits=Limits(processes=60))
    with open_folder() as folder, cell_in(folder, confinement) as first:
        assert first.run(FORKS)["result"][1]
        second = new_cell(first.spawner, first.jail.spec.snapshot, confinement)
        second.start()
        assert second.run("import os\npid = os.fork()\nif not pid: os._exit(3)\nresult = 1") == {
            "result": 1
        }


FILL = """
import os
written = 0
try:
    with open(os.path.join({folder}, "big"), "wb") as file:
        for _ in range({mib}):
            file.write(bytes(2**20)); file.flush(); written += 1
except OSError as error:
    result = [written, error.errno]
else:
    result = [written, 0]
"""
HOME = "os.path.expanduser('~')"


@needs("no-userns")
def test_disk_fill_ends_the_runner_without_a_mount_namespace() -> None:
    """There is no quota there; init counts and ends the runner."""
    source = FILL.format(folder=HOME, mib=15) + "\nimport time\n"
    more = source.replace('"big"', '"more"') + "time.sleep(1000)"
    with limited("no-userns", disk_bytes=20 * MIB) as cell:
        assert cell.run(source) == {"result": [15, 0]}
        assert cell.run(more) == {"error": "the runner has gone"}
        assert cell.wait_for(RunnerExited).reason == "disk-limit"


def test_open_files_stop_at_a_limit_that_cannot_be_raised_again(profile: str) -> None:
    """A runner is no more able to than any other process without privilege."""
    source = """
import resource
files = []
try:
    while len(files) < 500:
        files.append(open("/dev/null"))
except OSError as error:
    result = len(files)
files.clear()
"""
    raising = """
import resource
soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
resource.setrlimit(resource.RLIMIT_NOFILE, (hard + 1, hard + 1))
"""
    with limited(profile, open_files=100) as cell:
        assert 80 < cell.run(source)["result"] < 100
        assert cell.run(raising)["error"] == "ValueError"
