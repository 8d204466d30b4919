"""What init measures, where control groups are, and what removes a stranger's files."""

import mmap
import os
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from envhub_worker.lockdown.limits import cgroups, watchdog
from envhub_worker.lockdown.limits.cgroups import Group, Hierarchy, SurroundingLimit, Tree
from envhub_worker.lockdown.limits.watchdog import (
    MemoryWatch,
    folder_usage,
    seconds_to_next_look,
    unlinked_bytes,
)
from envhub_worker.lockdown.mechanisms.environment import jail_environment, zygote_environment
from envhub_worker.lockdown.mechanisms.scratch import remove_tree
from envhub_worker.protocol.confinement import GIB, MIB, Limits
from tests.support import inside

V1_MOUNTS = """\
30 29 0:26 / /sys/fs/cgroup/memory rw,relatime shared:9 - cgroup cgroup rw,memory
31 29 0:27 / /sys/fs/cgroup/pids rw - cgroup cgroup rw,pids
32 29 0:28 / /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu,cpuacct
33 29 0:29 / /sys/fs/cgroup/unified rw - cgroup2 cgroup2 rw
"""
V1_OWN = "9:name=systemd:/\n8:pids:/\n4:memory:/box/1\n0::/\n"
V2_MOUNTS = "30 29 0:26 / /sys/fs/cgroup rw,nosuid shared:4 - cgroup2 cgroup2 rw,nsdelegate\n"
V2_OWN = "0::/user.slice/user-1000.slice/user@1000.service/app.slice/run-1.scope\n"


@pytest.mark.parametrize(
    ("mounts", "own", "root", "found"),
    [
        (
            V1_MOUNTS,
            V1_OWN,
            True,
            Hierarchy("cgroup-v1", ("/sys/fs/cgroup/memory/box/1", "/sys/fs/cgroup/pids")),
        ),
        (V1_MOUNTS, V1_OWN, False, Hierarchy("cgroup-v2", ("/sys/fs/cgroup/unified",))),
        (V2_MOUNTS, V2_OWN, True, Hierarchy("cgroup-v2", ("/sys/fs/cgroup",))),
        (
            V2_MOUNTS,
            V2_OWN,
            False,
            Hierarchy("cgroup-v2", ("/sys/fs/cgroup" + V2_OWN[3:].rstrip(),)),
        ),
        ("", "", True, None),
    ],
)
def test_hierarchy_is_found(mounts: str, own: str, root: bool, found: Hierarchy | None) -> None:
    """v1 as root below our own group; v2 at the top as root, else what was delegated."""
    assert cgroups.find(mounts, own, root=root) == found


def test_v2_tree_enables_and_sets_limits(tmp_path: Path) -> None:
    (tmp_path / "cgroup.subtree_control").write_text("memory")
    real = os.mkdir

    def mkdir(path: str, mode: int = 0o777) -> None:
        real(path, mode)
        Path(path, "cgroup.subtree_control").write_text("")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cgroups.os, "mkdir", mkdir)
        (tmp_path / "cgroup.procs").write_text("")
        tree = Tree(Hierarchy("cgroup-v2", (str(tmp_path),)), "zygote-1")
        tree.group("jail-1", Limits(memory_bytes=GIB, processes=7))
    [folder] = tmp_path.glob("envhub_*_zygote-1")
    # A real control file takes one controller at a time and keeps all.
    assert (tmp_path / "cgroup.subtree_control").read_text() == "+pids"
    assert (folder / "cgroup.subtree_control").read_text() == "+pids"
    written = {path.name: path.read_text() for path in (folder / "jail-1").iterdir()}
    assert written == {
        "cgroup.subtree_control": "",
        "memory.max": str(GIB),
        "memory.swap.max": "0",
        "memory.oom.group": "1",
        "pids.max": "7",
    }


def test_v2_processes_in_the_way_move_to_a_leaf(tmp_path: Path) -> None:
    """A group with processes of its own may not give controllers to the groups below it."""
    (tmp_path / "cgroup.procs").write_text("7\n8\n")
    (tmp_path / "cgroup.type").write_text("domain\n")
    moved = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(*inside.CGROUP_WRITE, lambda path, text: moved.append((path, text)))
        inside.step_aside(str(tmp_path))
    leaf = f"{tmp_path}/envhub_{os.getpid()}_leaf/cgroup.procs"
    assert moved == [(leaf, "7"), (leaf, "8")]


@pytest.mark.parametrize("refused", ["memory.limit_in_bytes", "memory.max", "pids.max"])
def test_group_that_cannot_be_limited_is_not_left_behind(tmp_path: Path, refused: str) -> None:
    def write(path: str, text: str) -> None:
        if path.endswith(f"/{refused}"):
            raise PermissionError(path)

    kind = "cgroup-v2" if refused == "memory.max" else "cgroup-v1"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(*inside.CGROUP_WRITE, write)
        with pytest.raises(PermissionError):
            Group(kind, [str(tmp_path / "jail"), str(tmp_path / "pids")], Limits())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "before"),
    [
        ("memory.events", "low 0\noom 2\n"),
        ("memory/memory.oom_control", "oom_kill_disable 0\nunder_oom 0\n"),
    ],
)
def test_each_kill_is_one_death(tmp_path: Path, name: str, before: str) -> None:
    """What the kernel had counted before the server came is nobody's; there may be no such file."""
    assert not SurroundingLimit(tmp_path / "nowhere").killed_one()
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"{before}oom_kill 3\n")
    limit = SurroundingLimit(tmp_path)
    assert not limit.killed_one()
    path.write_text(f"{before}oom_kill 5\n")
    assert [limit.killed_one() for _ in range(3)] == [True, True, False]
    limit.close()
    limit.close()
    assert not limit.killed_one()


def test_next_look_comes_sooner_near_the_limit() -> None:
    assert seconds_to_next_look(0, 100 * GIB) == 1.0
    assert seconds_to_next_look(7 * GIB, 8 * GIB) == pytest.approx(0.125)
    assert seconds_to_next_look(8 * GIB, 8 * GIB) == 0.01
    assert seconds_to_next_look(9 * GIB, 8 * GIB) == 0.01


def look(limit: int = 2**62) -> int:
    """What the watch says of this very process."""
    return MemoryWatch(limit, None).look([os.getpid()])[0]


def test_shared_anonymous_memory_is_measured_also_after_it_left_the_page_tables() -> None:
    """MADV_DONTNEED hides it from the resident size; the mapping still holds it."""
    before = look()
    with mmap.mmap(-1, 64 * MIB) as shared:
        shared.write(bytes(64 * MIB))
        shared.madvise(mmap.MADV_DONTNEED)
        assert look() - before >= 60 * MIB
    assert look() - before < 32 * MIB


def test_memfd_is_measured_without_being_mapped_unless_it_is_the_clients() -> None:
    before = look()
    fd = os.memfd_create("test")
    os.write(fd, bytes(64 * MIB))
    assert look() - before >= 60 * MIB
    watch = MemoryWatch(2**62, None)
    watch.ignore([fd])
    assert watch.look([os.getpid()])[0] - before < 32 * MIB
    os.close(fd)


def test_reserved_memory_counts_no_more_than_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over the limit by the upper bound, what all programs together share decides."""
    monkeypatch.setattr(watchdog, "shared_of_the_machine", lambda: 64 * MIB)
    with mmap.mmap(-1, 4 * GIB):
        assert look() > 4 * GIB
        assert look(limit=GIB) < GIB


def test_shared_memory_out_of_the_page_tables_counts_when_it_matters() -> None:
    before = look(limit=0)
    with mmap.mmap(-1, 256 * MIB) as shared:
        for at in range(0, len(shared), MIB):
            shared[at : at + MIB] = bytes(MIB)
        shared.madvise(mmap.MADV_DONTNEED)
        assert look(limit=0) - before >= 240 * MIB


def test_changed_pages_of_a_mapped_file_count_when_it_matters(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.touch()
    os.truncate(path, 128 * MIB)
    before = look(limit=0)
    with open(path, "r+b") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY) as area:
        for at in range(0, len(area), mmap.PAGESIZE):
            area[at] = 1
        assert look() - before >= 120 * MIB
        assert look(limit=0) - before >= 120 * MIB


def test_page_tables_are_measured() -> None:
    """Reading the zero page in one place of each table costs a page of it, and no memory."""
    before = look()
    private = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
    with mmap.mmap(-1, 64 * GIB, flags=private, prot=mmap.PROT_READ) as area:
        area.madvise(mmap.MADV_NOHUGEPAGE)
        for at in range(0, len(area), 2 * MIB):
            area[at]
        assert look() - before >= 100 * MIB


def test_small_shared_memory_counts_with_what_may_have_been_unmapped() -> None:
    """Of a piece that the filter lets be made, all is kept while one page is mapped."""
    before = look()
    with mmap.mmap(-1, mmap.PAGESIZE):
        assert look() - before >= watchdog.SHARED_BYTES


def test_sockets_and_pipes_count_with_what_they_may_hold() -> None:
    before = look()
    pair, pipe = socket.socketpair(), os.pipe()
    assert look() - before >= 2 * watchdog.socket_bytes() + 64 * 1024
    for fd in pipe:
        os.close(fd)
    for one in pair:
        one.close()
    assert look() - before < watchdog.socket_bytes()


def test_sockets_that_nobody_has_count_in_a_network_of_their_own() -> None:
    """The kernel counts them for the network namespace, those under way in a socket included."""
    script = (
        "import os, socket\n"
        "from envhub_worker.lockdown.mechanisms import kernel\n"
        "from envhub_worker.lockdown.limits.watchdog import MemoryWatch, socket_bytes\n"
        "kernel.unshare(kernel.CLONE_NEWUSER | kernel.CLONE_NEWNET)\n"
        "watch = MemoryWatch(2**62, None, own_network=True)\n"
        "before = watch.look([os.getpid()])[0]\n"
        "way = socket.socketpair()\n"
        "for _ in range(20):\n"
        "    pair = socket.socketpair()\n"
        "    socket.send_fds(way[0], [b'x'], [one.fileno() for one in pair])\n"
        "    for one in pair: one.close()\n"
        "grown = watch.look([os.getpid()])[0] - before\n"
        "assert grown >= 42 * socket_bytes(), grown\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    if "unshare" in done.stderr and "OSError" in done.stderr:
        pytest.skip("this host forbids user namespaces")
    assert done.returncode == 0, done.stderr


def test_files_in_a_scratch_of_memory_are_measured() -> None:
    watch = MemoryWatch(2**62, "/dev/shm")
    before = watch.look([])[0]
    with tempfile.TemporaryFile(dir="/dev/shm") as file:
        file.write(bytes(32 * MIB))
        file.flush()
        assert watch.look([])[0] - before >= 24 * MIB


def test_empty_folders_in_a_scratch_of_memory_are_measured() -> None:
    """The kernel keeps about 1 KiB of its own for each, which no block shows."""
    watch = MemoryWatch(2**62, "/dev/shm")
    before = watch.look([])[0]
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        for number in range(8000):
            os.mkdir(f"{folder}/{number}")
        assert watch.look([])[0] - before >= 7 * MIB


def test_open_files_without_a_name_are_found(tmp_path: Path) -> None:
    device = os.stat(tmp_path).st_dev
    before = unlinked_bytes([os.getpid()], device)
    with open(tmp_path / "file", "wb") as file:
        file.write(bytes(MIB))
        file.flush()
        os.fsync(file.fileno())
        assert unlinked_bytes([os.getpid()], device) == before
        os.unlink(file.name)
        assert unlinked_bytes([os.getpid()], device) - before >= MIB


def test_ended_process_measures_nothing() -> None:
    pid = os.fork()
    if pid == 0:
        os._exit(0)
    os.waitpid(pid, 0)
    assert MemoryWatch(GIB, None).look([pid]) == (0, [])


def test_folder_usage_counts_blocks_and_files(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "full").write_bytes(bytes(MIB))
    with open(tmp_path / "sparse", "wb") as file:
        file.truncate(GIB)
    (tmp_path / "loop").symlink_to(tmp_path)
    size, files = folder_usage(str(tmp_path), 1000)
    assert MIB <= size < 2 * MIB
    assert files == 4
    assert folder_usage(str(tmp_path), 1)[1] <= 4


def test_tree_of_any_depth_and_mode_is_removed(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "kept").write_text("x")
    tree = tmp_path / "tree"
    tree.mkdir()
    (tree / "link").symlink_to(outside)
    _nest(tree, 1500)
    (tree / "locked" / "inner").mkdir(parents=True)
    (tree / "locked" / "inner" / "file").write_text("x")
    (tree / "locked").chmod(0)
    remove_tree(str(tree))
    assert not tree.exists()
    tree.symlink_to(outside)
    with pytest.raises(OSError, match="Not a directory"):
        remove_tree(str(tree))
    tree.unlink()
    assert (outside / "kept").exists()
    remove_tree(str(tree))  # what is not there is no error


def _nest(tree: Path, depth: int) -> None:
    here = os.open(tree, os.O_RDONLY)
    for _ in range(depth):
        os.mkdir("d", dir_fd=here)
        below = os.open("d", os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = below
    os.close(here)


def test_zygote_environment_is_built() -> None:
    host = {"HF_TOKEN": "x", "LANG": "de_DE.UTF-8", "TZ": "UTC", "HOME": "/home/ann", "PATH": "/x"}
    built = zygote_environment(host, "/opt/py/bin/python", {"TZ": "CET"})
    assert {name: built[name] for name in ("LANG", "TZ", "HOME")} == {
        "LANG": "de_DE.UTF-8",
        "TZ": "CET",
        "HOME": "/nonexistent",
    }
    assert built["PATH"].startswith("/opt/py/bin:/usr/local/bin:")
    blas = {"OPENBLAS_NUM_THREADS", "OPENBLAS_THREAD_TIMEOUT"}
    assert set(built) == {"LANG", "TZ", "HOME", "PATH", *blas}


def test_jail_environment_grants_by_name() -> None:
    """The caller's variables win over ours; the zygote's own thread limit does not pass."""
    base = zygote_environment({"LANG": "C"}, "/usr/bin/python3", {"PYTHONHASHSEED": "0"})
    built = jail_environment(base, {"TOKEN": "t", "MPLBACKEND": "svg"}, "/h", "/t")
    assert (built["TOKEN"], built["MPLBACKEND"], built["HOME"]) == ("t", "svg", "/h")
    assert built["TMPDIR"] == "/t"
    assert (built["LANG"], built["PYTHONHASHSEED"]) == ("C", "0")
    assert built["SDL_VIDEODRIVER"] == "dummy"
    assert "OPENBLAS_NUM_THREADS" not in built
