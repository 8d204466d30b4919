"""Processes side by side: never more than there may be, and what ends one ends no other."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest

from envhub_sandbox.check.many.judgements import Outcome, judgements
from envhub_sandbox.errors import WorkerStartupError
from tests.support.command_line import runs
from tests.support.processes import eventually

_PROGRAMS = {
    "well": "print('a document')",
    "crash": "import os, sys; print('partly', file=sys.stderr, flush=True); os.abort()",
    "fail": "import sys; sys.exit('\\x1b[2Jit is wrong')",
    "hang": "import time; time.sleep(3600)",
    "flood": "import sys\nwhile True: sys.stdout.write('x' * 1_000_000)",
    "leave": (
        "import os, time\n"
        "if os.fork() == 0: time.sleep(3600)\n"
        "open('../left', 'w').write(str(os.getpid()))\n"
        "os.abort()"
    ),
    "stubborn": (
        "import os, signal, time\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "open('ready', 'w').close() if os.fork() else None\n"
        "time.sleep(3600)"
    ),
}


_HOW: dict[str, Any] = {"jobs": 2, "most_s": 300.0, "variables": {}}


def command(order: str, place: Path, _: int = -1) -> list[str]:
    """What is run for an order, in its folder."""
    program = f"import os; os.chdir({str(place)!r})\n{_PROGRAMS[order]}"
    return [sys.executable, "-I", "-c", program]


def run(folder: Path, *orders: str, **how: Any) -> dict[str, Outcome[str]]:
    with contextlib.closing(judgements(orders, command, folder=folder, **{**_HOW, **how})) as found:
        return {one.order: one for one in found}


def test_what_ends_one_ends_no_other(tmp_path: Path) -> None:
    """Each is told with its code, and the end of what it complained of."""
    found = run(tmp_path, "crash", "well", "fail")
    assert (found["well"].code, found["well"].out) == (0, b"a document\n")
    assert found["crash"].code == -6
    assert found["crash"].said == "a signal ended it: 6. partly"
    assert (found["fail"].code, found["fail"].said) == (1, "\\x1b[2Jit is wrong")
    assert list(tmp_path.iterdir()) == [], "their folders are gone"


@pytest.mark.parametrize(("order", "says"), [("hang", "--deadline"), ("flood", "printed more")])
def test_one_that_takes_or_says_too_much_is_ended(order: str, says: str, tmp_path: Path) -> None:
    most_s = 0.5 if order == "hang" else 300.0
    found = run(tmp_path, order, jobs=1, most_s=most_s)
    assert (found[order].code, says in found[order].said) == (None, True), found
    assert found[order].out == b""
    assert run(tmp_path, "well")["well"].code == 0


@pytest.mark.parametrize("jobs", [1, 3])
def test_there_are_never_more_than_there_may_be(jobs: int, tmp_path: Path) -> None:
    begun, ended, most = 0, 0, []

    def counted(order: int, place: Path, _: int) -> list[str]:
        nonlocal begun
        begun += 1
        most.append(begun - ended)
        return command("well", place)

    found = judgements(range(7), counted, folder=tmp_path, **{**_HOW, "jobs": jobs})
    for one in found:
        assert one.code == 0
        ended += 1
    assert (begun, ended, max(most)) == (7, 7, jobs)


def test_one_that_crashes_leaves_none(tmp_path: Path) -> None:
    assert run(tmp_path, "leave")["leave"].code == -6
    group = int((tmp_path / "left").read_text())
    assert eventually(lambda: not any(of_group(one, group) for one in psutil.process_iter()))


def of_group(process: psutil.Process, group: int) -> bool:
    """Whether it is one of a group, and has not ended."""
    with contextlib.suppress(ProcessLookupError):
        return os.getpgid(process.pid) == group and runs(process)
    return False


def test_what_cannot_be_started_is_told(tmp_path: Path) -> None:
    found = judgements(["x"], lambda *_: [str(tmp_path / "nothing")], folder=tmp_path, **_HOW)
    with pytest.raises(WorkerStartupError, match="no check can be started: No such file"):
        next(found)


def test_whoever_stops_leaves_none(tmp_path: Path) -> None:
    how = {**_HOW, "jobs": 3, "patience_s": 1.0}
    found = judgements(["well", "stubborn", "hang"], command, folder=tmp_path, **how)
    assert next(found).order == "well"
    assert eventually(lambda: (tmp_path / "1" / "ready").exists())
    children = psutil.Process().children(recursive=True)
    below = [one for one in children if str(tmp_path) in " ".join(one.cmdline())]
    assert len(below) == 3, "the control: two of ours, and one of theirs"
    found.close()
    assert eventually(lambda: not any(map(runs, below)))
