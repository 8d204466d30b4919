"""Which files a waiting call asks for, read out of memory: here, out of this process's own. And
whether one is about a process of the jail's own: here, this process's children."""

import ctypes
import mmap
import os
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from envhub_worker.extras.denials.paths import OwnPaths, asked
from envhub_worker.extras.denials.targets import is_another_target, never_a_target

_OWN = OwnPaths(changed=("/sandbox/work", "/dev/null"), read=("/home/me/python",))
_HERE = -100 & 0xFFFFFFFFFFFFFFFF
_WRITING = os.O_WRONLY | os.O_CREAT


def ask(
    call: str, *words: int | bytes, waits: Callable[[], object] = lambda: None, own: OwnPaths = _OWN
) -> list[tuple[str, str]]:
    """What a call of this thread's is seen to ask for; bytes stand where their address would."""
    buffers = [ctypes.create_string_buffer(one) for one in words if isinstance(one, bytes)]
    places = iter(buffers)
    registers = [ctypes.addressof(next(places)) if isinstance(one, bytes) else one for one in words]
    padded = (*registers, 0, 0, 0, 0, 0, 0)[:6]
    return asked(call, padded, threading.get_native_id(), own, waits)


@pytest.mark.parametrize(
    ("call", "words", "expected"),
    [
        ("openat", (_HERE, b"/srv/x", _WRITING), [("write", "/srv/x")]),
        ("openat", (_HERE, b"/root/.netrc", os.O_RDONLY), [("read", "/root/.netrc")]),
        ("open", (b"//home/../home/a/b", os.O_RDONLY), [("read", "/home/a/b")]),
        ("open", (b"/home/me/python/os.py", os.O_RDWR), [("write", "/home/me/python/os.py")]),
        ("open", (b"/sandbox/work/../x", os.O_RDWR), [("write", "/sandbox/x")]),
        ("open", (b"/sandbox/workers", os.O_RDWR), [("write", "/sandbox/workers")]),
        ("open", (b"/proc/7/environ", os.O_RDONLY), [("read", "/proc/7/environ")]),
        ("creat", (b"/srv/x",), [("write", "/srv/x")]),
        ("rename", (b"/dev/null", b"/srv/x"), [("rename", "/srv/x")]),
        (
            "linkat",
            (_HERE, b"/etc/shadow", _HERE, b"/srv/x"),
            [("linkat", "/etc/shadow"), ("linkat", "/srv/x")],
        ),
        ("symlink", (b"/etc/shadow", b"/srv/x"), [("symlink", "/srv/x")]),
        ("unlink", (b"/a\x1b]0;\n\xff/" + b"b" * 400,), [("unlink", None)]),
        ("connect", (3, b"\1\0/run/docker.sock", 22), [("connect", "/run/docker.sock")]),
        # its own, what is read by chance, and what names nothing
        ("openat", (_HERE, b"/srv/x", os.O_RDONLY), []),
        *(
            ("open", (path, os.O_RDONLY), [])
            for path in (b"/home/me/python/os.py", b"/proc/7/stat")
        ),
        *(("open", (b"/sandbox/work/y", os.O_RDWR), []), ("utimensat", (_HERE, 0), [])),
        *(("unlink", (path,), []) for path in (b"", 3, 1 << 63, b"/" + b"b" * 5000)),
        *(("connect", (3, b"\1\0/run/nscd/socket", 22), []), ("connect", (3, b"\1\0\0ab", 6), [])),
        ("connect", (3, b"\2\0/run/docker.sock", 22), []),
        ("connect", (3, b"\1\0/sandbox/work/s", 1 << 31), []),
    ],
)
def test_what_is_not_its_own_is_told(
    call: str, words: Sequence[int | bytes], expected: list[tuple[str, str | None]]
) -> None:
    """Changes of all but its own folders, and reading what is private; shown, of bounded length."""
    found = ask(call, *words)
    assert [deed for deed, _ in found] == [deed for deed, _ in expected]
    for (_, shown), (_, path) in zip(found, expected, strict=True):
        assert path in (None, shown)
        assert shown.isprintable()
        assert len(shown) <= 300


def test_a_path_starts_where_its_caller_stands(tmp_path: Path) -> None:
    folder = os.open(tmp_path, os.O_RDONLY)
    ends = os.pipe()
    try:
        assert ask("unlinkat", folder, b"x") == [("unlinkat", f"{tmp_path}/x")]
        assert ask("unlinkat", ends[0], b"x") == []
        assert ask("unlinkat", 1 << 30, b"x") == []
    finally:
        for one in (folder, *ends):
            os.close(one)
    assert ask("unlinkat", _HERE, b"x") == [("unlinkat", f"{os.getcwd()}/x")]


def test_a_path_goes_through_the_entries_of_processes(tmp_path: Path) -> None:
    folder = os.open(tmp_path, os.O_RDONLY)
    try:
        for own in ("self", "thread-self", f"self/task/{os.getpid()}", str(os.getpid())):
            assert ask("unlink", f"/proc/{own}/root/srv/x".encode()) == [("unlink", "/srv/x")]
        assert ask("unlink", b"/proc/self/cwd/x") == [("unlink", f"{os.getcwd()}/x")]
        assert ask("unlink", b"/proc/self/fd/%d/x" % folder) == [("unlink", f"{tmp_path}/x")]
        through = b"/proc/self/root" * 3 + b"/srv/x"
        assert ask("unlink", through) == [("unlink", "/srv/x")]
        assert len(ask("unlink", b"/proc/self/root" * 50 + b"/sandbox/work/x")) == 1
    finally:
        os.close(folder)


def test_a_path_may_end_where_memory_does() -> None:
    """It is read to the end of its page, and the next is looked at only where it goes on."""
    pages = mmap.mmap(-1, 2 * mmap.PAGESIZE)
    start = ctypes.addressof(ctypes.c_char.from_buffer(pages))
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.mprotect(ctypes.c_void_p(start + mmap.PAGESIZE), mmap.PAGESIZE, 0) == 0
    pages[mmap.PAGESIZE - 7 : mmap.PAGESIZE] = b"/srv/x\0"
    assert ask("unlink", start + mmap.PAGESIZE - 7) == [("unlink", "/srv/x")]
    assert libc.mprotect(ctypes.c_void_p(start + mmap.PAGESIZE), mmap.PAGESIZE, 3) == 0
    pages[mmap.PAGESIZE - 7 : mmap.PAGESIZE + 1] = b"/srv/xy\0"
    assert ask("unlink", start + mmap.PAGESIZE - 7) == [("unlink", "/srv/xy")]


def test_nothing_is_read_of_who_has_gone() -> None:
    def waits() -> None:
        raise FileNotFoundError

    assert ask("unlink", b"/srv/x") == [("unlink", "/srv/x")], "the control"
    assert ask("unlink", b"/srv/x", waits=waits) == []


def test_a_link_of_its_own_is_told_as_where_it_leads(tmp_path: Path) -> None:
    """Where the call follows it; whatever lies there, and whatever lies outside of its folders."""
    own = OwnPaths(changed=(str(tmp_path),), read=(), scratch=(str(tmp_path),))
    for name, target in (
        ("key", "/home/other/key"),
        ("folder", "/home/other"),
        ("self", "self"),
        ("twice", "inner/key"),
        ("mine", "here"),
    ):
        os.symlink(target, tmp_path / name)
    (tmp_path / "inner").mkdir()
    os.symlink("../folder/key", tmp_path / "inner" / "key")

    def said(call: str, name: str, *more: int) -> list[str]:
        place = f"{tmp_path}/{name}".encode()
        at = (_HERE,) if call.endswith("at") else ()
        return [path for _, path in ask(call, *at, place, *more, own=own)]

    key = ["/home/other/key"]
    for name in ("key", "folder/key", "twice", "inner/key", "inner/../key", "folder/../other/key"):
        assert said("open", name, os.O_RDONLY) == key
    assert said("truncate", "key") == said("chmod", "key") == said("fchmodat", "key") == key
    assert said("unlink", "folder/key") == key
    for call, *more in (("unlink",), ("lchown",), ("open", _WRITING | os.O_EXCL), ("rename",)):
        assert said(call, "key", *more) == []
    assert said("open", "key", os.O_RDONLY | os.O_NOFOLLOW) == []
    assert said("utimensat", "key", 0, 0x100) == said("open", "mine", os.O_RDWR) == []
    assert said("utimensat", "key", 0, 0) == key
    assert said("open", "self/x", os.O_RDWR)[0].startswith("/..."), "it has no end"
    deep = tmp_path.joinpath(*["a"] * 20)
    deep.mkdir(parents=True)
    os.symlink("/home/other/key", deep / "key")
    assert said("open", f"{'a/' * 20}key", os.O_RDONLY) == [], "so far down nobody looks"


_NOBODY = 1 << 30
"""Numbers end long before."""


@pytest.fixture(scope="module")
def children() -> Iterator[tuple[int, int]]:
    both = [subprocess.Popen(["sleep", "600"]) for _ in range(2)]
    yield both[0].pid, both[1].pid
    for one in both:
        one.kill()
        one.wait()


@pytest.mark.parametrize(
    ("call", "place"),
    [
        *((name, 0) for name in ("kill", "tkill", "tgkill", "rt_sigqueueinfo", "pidfd_open")),
        *(("sched_setscheduler", 0), ("sched_setaffinity", 0)),
        *(("setpriority", 1), ("ioprio_set", 1)),
    ],
)
def test_what_is_not_below_init_is_other(call: str, place: int, children: tuple[int, int]) -> None:
    """Also what cannot have been there; not so the caller, nor what lives with it."""
    first, second = children

    def about(number: int, *, init: int) -> bool:
        before = (1,) if call == "ioprio_set" else (0,) * place
        words = (*before, number, signal.SIGTERM, signal.SIGTERM)
        return is_another_target(call, words[:3], first, init)

    assert not about(first, init=os.getpid())
    assert not about(second, init=os.getpid())
    assert not about(0, init=os.getpid())
    assert about(second, init=first)
    assert about(_NOBODY, init=os.getpid())
    assert about(os.getpid(), init=os.getpid()) == (call != "pidfd_open")


def test_who_only_looks_signals_nobody(children: tuple[int, int]) -> None:
    """Groups and everybody are named by numbers below zero; a group of one's own may have ended."""
    first, second = children
    assert not is_another_target("kill", (second, 0, 0), first, first)
    assert is_another_target("kill", (-1, 15, 0), first, os.getpid())
    assert is_another_target("kill", (-_NOBODY, 15, 0), first, os.getpid())
    assert not is_another_target("kill", (-second, 15, 0), first, os.getpid())
    assert not is_another_target("setpriority", (1, _NOBODY, 0), first, os.getpid())


def test_who_has_ended_may_have_been_its_own() -> None:
    ended = subprocess.Popen(["true"])
    ended.wait()
    assert not is_another_target("kill", (ended.pid, 15, 0), os.getpid(), os.getpid())
    assert not never_a_target(f"/proc/{ended.pid}/stat")


def test_a_path_names_a_process_that_nobody_can_have_met() -> None:
    assert never_a_target(f"/proc/{_NOBODY}/cmdline")
    assert never_a_target(f"/proc/{_NOBODY}")
    for path in (f"/proc/{os.getpid()}/cmdline", "/proc/self/cmdline", f"/home/{_NOBODY}"):
        assert not never_a_target(path)
    assert not never_a_target(f"/proc/{'9' * 5000}/cmdline")


def test_a_namespace_of_ones_own_has_come_to_fewer_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its first process knows the last one; elsewhere they may have begun again since."""
    most = int(Path("/proc/sys/kernel/pid_max").read_text())
    assert not never_a_target(f"/proc/{most - 1}/cmdline")
    monkeypatch.setattr(os, "getpid", lambda: 1)
    assert never_a_target(f"/proc/{most}/cmdline")
    assert not never_a_target("/proc/1/cmdline")
