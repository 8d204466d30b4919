"""What clients ask a server for, in which order, and what their jails use of it."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from envhub_worker.access import package_program, packages
from envhub_worker.access.audit import usage
from envhub_worker.access.places import Line
from envhub_worker.access.quotas import Quotas
from envhub_worker.access.store import uploads
from envhub_worker.protocol import messages as m
from envhub_worker.supervisor.records import RefusedError
from tests.support.processes import eventually


class Clock:
    """One that stands still."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_who_has_asked_twice_stands_before_who_comes_later() -> None:
    line = Line(Clock())
    line.wait(b"key", b"first")
    assert (line.waiting, line.ahead(b"key", b"second")) == (0, 0)
    line.wait(b"key", b"first")
    line.wait(b"key", b"second")
    assert (line.waiting, line.ahead(b"key", b"second")) == (1, 1)
    assert line.ahead(b"key", b"first") == line.ahead(b"another key", b"second") == 0
    line.leave(b"key", b"first")
    assert (line.waiting, line.ahead(b"key", b"second")) == (0, 0)


def test_who_asks_no_more_is_forgotten() -> None:
    clock = Clock()
    line = Line(clock)
    for _ in range(2):
        line.wait(b"key", b"gone")
    clock.now = 6.0
    assert (line.waiting, line.ahead(b"key", b"other")) == (0, 0)
    for number in range(5_000):
        line.wait(b"crowd", str(number).encode())
        line.wait(b"crowd", str(number).encode())
    assert line.waiting == 1024


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("/etc/passwd", "absolute"),
        ("a/../b", "'..' step"),
        ("a//b", "empty"),
        ("./a", "'.' or"),
        ("", "empty"),
        ("a\\b", "backslash"),
        ("a\nb", "control character"),
        ("a\udcff", "not UTF-8"),
        ("a/" * 200 + "b", "too deep"),
        ("a" * 300, "too long"),
        ("env.py", ""),
        ("sub/ünïcode name.py", ""),
    ],
)
def test_paths_of_clients_stay_below_their_snapshot(path: str, why: str) -> None:
    said = uploads.wrong_with_path(path)
    assert why in said
    assert bool(said) == bool(why)


def listed(*paths: str, size: Any = 3) -> tuple[Any, ...]:
    return tuple((path, size, b"\0" * 32) for path in paths)


@pytest.mark.parametrize(
    "files",
    [
        (),
        listed("a", "a"),
        listed("a", "a/b"),
        listed("../a"),
        listed("a", size=-1),
        listed("a", size="3"),
        listed("a", size=1 << 60),
        (("a", 3, b"short"),),
        (3,),
    ],
)
def test_listings_that_break_a_rule_are_refused(files: tuple[Any, ...]) -> None:
    with pytest.raises(RefusedError):
        uploads.checked_listing(files, Quotas())


def test_a_snapshot_has_the_name_of_its_sorted_listing() -> None:
    one = uploads.checked_listing(listed("b", "a/c"), Quotas())
    assert [file.path for file in one] == ["a/c", "b"]
    other = uploads.checked_listing(listed("a/c", "b"), Quotas())
    assert uploads.digest_of(one) == uploads.digest_of(other)
    more = uploads.checked_listing(listed("a/c", "b", size=4), Quotas())
    assert uploads.digest_of(more) != uploads.digest_of(one)
    with pytest.raises(RefusedError, match="--max-upload-files"):
        uploads.checked_listing(listed("a", "b"), replace(Quotas(), upload_files=1))


def order(**fields: Any) -> m.NeedPackages:
    nothing: dict[str, Any] = dict.fromkeys(
        ("requirements", "guesses", "constraints", "override", "without"), ()
    )
    texts = dict.fromkeys(("supports", "python", "exclude_newer"), "")
    return m.NeedPackages(**{**nothing, **texts, "always": False, "gpu": False, **fields})


def test_an_order_is_taken_as_plain_values() -> None:
    made = packages.checked(order(requirements=(("numpy", "env.py"),), python="3.11"))
    assert made["requirements"] == [["numpy", "env.py"]]
    assert made["python"] == "3.11"


@pytest.mark.parametrize(
    "fields",
    [
        {"requirements": (("numpy",),)},
        {"requirements": (("numpy", 3),)},
        {"requirements": (("x" * 3_000, "env.py"),)},
        {"requirements": (("numpy", "env.py"),) * 1_001},
        {"without": (3,)},
        {"python": "3" * 3_000},
    ],
)
def test_orders_without_bounds_are_refused(fields: dict[str, Any]) -> None:
    with pytest.raises(RefusedError, match="an order has at most"):
        packages.checked(order(**fields))


def test_the_program_is_of_this_interpreter() -> None:
    command = package_program.command()
    assert command[0] == sys.executable
    assert {"-I", package_program.PROGRAM} <= set(command)
    assert package_program.why_impossible() == ""


def test_what_processes_use_is_added_up_by_client(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of each first one and all below it; processor time stays when they have gone."""
    monkeypatch.setattr(usage, "EVERY_S", 3600.0)
    shell = ["sh", "-c", "i=0; while [ $i -lt 200000 ]; do i=$((i+1)); done; cat; :"]
    with subprocess.Popen(shell, stdin=subprocess.PIPE) as process:
        taken = usage.Usage(pytest.fail)
        assert eventually(lambda: len(usage.children(process.pid)) == 1)
        found = usage.look_at(process.pid)
        assert found is not None
        assert (found.pid, found.memory_bytes > 0, found.cpu_s >= 0) == (process.pid, True, True)
        taken.watch({process.pid: "client"})
        taken.look()
        assert set(taken.memory_bytes) == {"client"}
        assert taken.memory_bytes["client"] >= found.memory_bytes // 2
        before = taken.cpu_s["client"]
        assert before > 0
        process.communicate()
    assert usage.look_at(process.pid) is None
    taken.look()
    assert taken.memory_bytes == {}
    assert taken.cpu_s["client"] == before
    taken.close()


def test_ourselves_among_processes() -> None:
    """The time at which a process was started tells it from a later one of its number."""
    first, second = (usage.look_at(os.getpid()) for _ in range(2))
    assert first is not None
    assert second is not None
    assert first.started == second.started
    assert Path(f"/proc/{first.pid}").exists()
