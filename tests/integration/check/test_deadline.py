"""``envhub check --deadline``: whatever takes too long, a report says what was not judged."""

import itertools
import json
import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from envhub_sandbox.extras.judge.command.deadline import DeadlineReached, deadline_alarm
from envhub_sandbox.extras.sources import parser
from envhub_worker.protocol.text import duration_text
from tests.corpus.entries import Entry
from tests.hub.stub_hub import StubHub
from tests.support.command_line import COMMAND, document
from tests.support.packages.wheels import Index
from tests.support.processes import descendants, eventually
from tests.support.repositories import STILL, write_repository

_LONG_S = 3600
"""So long that no test would wait for it."""
_NAME = b"it-hangs"
_ENV = f"""{STILL}
import time

hung = []
# LOAD
class Slow(Still):
    def reset(self, *, seed=None, options=None):
        # RESET
        return super().reset(seed=seed)
    def step(self, action):
        # STEP
        return super().step(action)
    def close(self):
        while hung:
            time.sleep(1)

def make_env(n_envs=1, use_async_envs=False):
    return {{"a": {{0: vector(Slow, n_envs), 1: vector(Slow, n_envs)}}}}
"""


def judged(
    folder: Path, *arguments: str | Path, reached: Callable[[], bool]
) -> tuple[int, dict[str, Any]]:
    """The exit code and the document of a check, whose alarm rings once this is reached.
    Its files are left in the folder."""
    files = [f"--{kind}={folder / kind}" for kind in ("junit", "sarif", "html")]
    words = ["check", "--json", *files, "--steps", "5", "--deadline", _LONG_S, *arguments]
    command = [*COMMAND, *map(str, words)]
    with (
        (folder / "out").open("w+") as out,
        subprocess.Popen(command, stdout=out, stderr=subprocess.PIPE, text=True) as process,
    ):
        try:
            assert eventually(lambda: reached() or process.poll() is not None)
            process.send_signal(signal.SIGALRM)
            _, said = process.communicate(timeout=240)
        finally:
            process.kill()
        out.seek(0)
        assert process.returncode in (1, 10), said
        return process.returncode, json.load(out)


def says_so(folder: Path, document: dict[str, Any], *, at: str, lacks: set[str]) -> None:
    """Assert that each form says that it was ended, where, and what was not judged."""
    [finding] = [one for one in document["findings"] if one["check"] == "deadline"]
    assert document["findings"][0] == finding, "the most severe comes first"
    assert at in finding["message"]
    assert set(document["unjudged"]["checks"]) >= lacks
    assert all(check in finding["message"] for check in lacks)
    assert document["passed"] is False
    root = ElementTree.fromstring((folder / "junit").read_text())
    skipped = {one.attrib["name"] for one in root if one.find("skipped") is not None}
    assert skipped >= lacks
    assert int(root.attrib["skipped"]) == sum(one.find("skipped") is not None for one in root)
    [run] = json.loads((folder / "sarif").read_text())["runs"]
    assert run["invocations"] == [{"executionSuccessful": False}]
    assert run["results"][0]["ruleId"] == "deadline"
    assert "not judged to its end" in (folder / "html").read_text()


def hanging(folder: Path, place: str) -> Path:
    """A repository that hangs there and when it is closed, in a process that has a name then."""
    hangs = f"hung.append(1); ctypes.CDLL(None).prctl(15, {_NAME!r}); time.sleep({_LONG_S})"
    return write_repository(folder / "slow", f"import ctypes\n{_ENV.replace(f'# {place}', hangs)}")


def hangs_now() -> bool:
    names = [Path(f"/proc/{pid}/comm") for pid in descendants()]
    return any(name.exists() and name.read_bytes().strip() == _NAME for name in names)


@pytest.mark.parametrize("place", ["LOAD", "RESET"])
def test_a_jail_that_hangs_is_ended(place: str, tmp_path: Path) -> None:
    """While it loads, resets or steps; nothing of it is left, and what was read is reported."""
    folder = hanging(tmp_path, place)
    before = descendants()
    code, found = judged(tmp_path, folder, reached=hangs_now)
    assert code == 10
    at = "loading it" if place == "LOAD" else "a / 0"
    says_so(tmp_path, found, at=at, lacks={"runs", "seeding", "leaks-memory"})
    assert {"card", "licence"} < {one["check"] for one in found["findings"]}
    if place != "LOAD":
        assert found["unjudged"]["tasks"] == ["a / 0", "a / 1"]
        assert found["confinement"]["profile"] == "strict"
    assert eventually(lambda: descendants() <= before)


def test_what_fails_before_the_deadline_fails(tmp_path: Path) -> None:
    """The exit code is that of a failure: it would not pass in any time."""
    folder = hanging(tmp_path, "STEP")
    (folder / "other.py").write_text("text = 'a\u202eb'\n", encoding="utf-8")
    options = ["--fail-on", "warning"]
    code, found = judged(tmp_path, folder, *options, reached=hangs_now)
    assert code == 1
    fails = {one["check"] for one in found["findings"] if one["fails"]}
    assert fails == {"deadline", "source-hidden"}


def trickle() -> Iterator[bytes]:
    for _ in itertools.count():
        yield b"x"
        time.sleep(0.05)


def test_a_hanging_download_ends(stub_hub: StubHub, snapshot_store: Path, tmp_path: Path) -> None:
    stub_hub.add("org/slow", {"env.py": _ENV})
    pattern = r"GET .*env\.py"
    stub_hub.fail(pattern, 200, pieces=trickle)
    words = ["org/slow", "--endpoint", stub_hub.endpoint]
    asked = lambda: any(re.search(pattern, one) for one in stub_hub.requests)  # noqa: E731
    code, found = judged(tmp_path, *words, reached=asked)
    assert code == 10
    says_so(tmp_path, found, at="reading org/slow", lacks={"loads", "licence", "requirements"})
    assert found["reference"] == "org/slow"


def test_packages_that_do_not_come_are_ended(index: Index, tmp_path: Path) -> None:
    index.hold("/simple")
    folder = write_repository(tmp_path / "slow", _ENV, requirements__txt="not-here==1\n")
    code, found = judged(tmp_path, folder, reached=index.held)
    assert code == 10
    at = "reading and installing what it declares"
    says_so(tmp_path, found, at=at, lacks={"requirements", "imports", "loads"})


def test_a_parser_that_hangs_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It computes nothing, so that no bound of its own ends it."""
    program = tmp_path / "parser.py"
    program.write_text(f"import time\ntime.sleep({_LONG_S})\n")
    monkeypatch.setattr(parser, "__file__", str(program))
    folder = write_repository(tmp_path / "slow", _ENV)
    before = descendants()
    found = document("check", folder, "--deadline", "2", code=10)
    assert {"source-hidden", "loads"} < set(found["unjudged"]["checks"])
    assert eventually(lambda: descendants() <= before)


def ring_once_it_hangs() -> None:
    """Ring the alarm of a check in this process; it listens, as what hangs has it wait."""
    if eventually(hangs_now):
        os.kill(os.getpid(), signal.SIGALRM)


def test_one_of_a_list_ends_no_other(tmp_path: Path) -> None:
    """What takes too long is not judged to its end, and the next is judged as ever."""
    folder = hanging(tmp_path, "STEP")
    Entry(group="honest").write(tmp_path / "quick")
    (tmp_path / "list").write_text(f"{folder}\n{tmp_path / 'quick'}\n")
    short = ("--steps", "2", "--resets", "0", "--deadline", str(_LONG_S))
    alarm = threading.Thread(target=ring_once_it_hangs)
    alarm.start()
    late, quick = document("check", "--all", tmp_path / "list", *short, code=10)["results"]
    alarm.join()
    assert (late["verdict"], quick["verdict"]) == ("not judged", "passed")
    assert f"ended after {duration_text(_LONG_S)}, at: " in late["report"]["findings"][0]["message"]
    assert late["report"]["unjudged"]["tasks"]


def wait_for_ever() -> None:
    threading.Event().wait(_LONG_S)


def test_the_alarm_rings_again_and_then_never() -> None:
    """What closes after the first is interrupted too; after the end nothing is."""
    rung = []

    def closes() -> None:
        try:
            wait_for_ever()
        finally:
            rung.append("first")
            signal.setitimer(signal.ITIMER_REAL, 0.05, 0.05)
            wait_for_ever()

    before = signal.getsignal(signal.SIGALRM)
    with pytest.raises(DeadlineReached), deadline_alarm(1.0):
        closes()
    assert rung == ["first"]
    assert signal.getsignal(signal.SIGALRM) is before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
