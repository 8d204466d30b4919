"""Errors become one message and a documented exit code; strangers' text does no harm."""

import errno
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from envhub_sandbox import errors
from envhub_sandbox.cli.shared.console import plain, print_json, safe_line
from envhub_sandbox.cli.shared.exits import Exit, UsageError, code_for, describe, reported
from envhub_sandbox.cli.shared.results import TaskResult, returns_of, statistics, task_document
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.play.episodes import Episode, Rollout, RolloutError
from envhub_worker.protocol.text import quoted

CODES = {
    2: (errors.HubReferenceError, errors.PolicyError, UsageError, errors.VideoError),
    3: (
        *(errors.SnapshotError, errors.SnapshotTooLargeError, errors.SnapshotIntegrityError),
        errors.RepositoryUnavailableError,
    ),
    4: (errors.LoadError, errors.DependencyError),
    5: (
        *(errors.WorkerStartupError, errors.WorkerDiedError, errors.WorkerTimeoutError),
        errors.RemoteProtocolError,
    ),
    6: (errors.SandboxUnavailableError,),
    1: (RolloutError,),
}


def test_every_error_has_its_code(checkout: Path) -> None:
    """As the table of ``docs/cli.md`` says. A remote ValueError is the environment's; one of this
    process is ours."""
    for code, kinds in CODES.items():
        assert [code_for(kind("text")) for kind in kinds] == [code] * len(kinds)
    assert code_for(errors.remote_error("ValueError", "ValueError", "x")) == Exit.ENVIRONMENT
    assert code_for(ValueError("x")) == Exit.BUG
    assert code_for(KeyboardInterrupt()) == Exit.INTERRUPTED
    table = re.findall(r"^\| (\d+) \|", (checkout / "docs" / "cli.md").read_text(), re.MULTILINE)
    assert {int(code) for code in table} == {int(code) for code in Exit}


def test_a_message_carries_no_traceback_and_no_escape_sequence() -> None:
    """The worker's traceback is for --debug; of its output the last lines are those that help."""
    error: EnvHubError = errors.LoadError("repo: bad \x1b[31mred\n  File x, line 1")
    vars(error)["__notes__"] = ["Traceback ..."]
    assert describe(error) == "repo: bad \\x1b[31mred\n  File x, line 1"
    tail = "\n".join(f"line {number}" for number in range(100))
    error = errors.WorkerDiedError(f"it died\nIts last output:\n{quoted(tail)}", log_tail=tail)
    lines = describe(error).splitlines()
    assert lines[:2] == ["it died", "Its last output:"]
    assert lines[2:] == [f"  | line {number}" for number in range(90, 100)]


def fail(error: BaseException, *, debug: bool) -> int:
    with pytest.raises(typer.Exit) as caught, reported(debug=debug):
        raise error
    return caught.value.exit_code


def test_a_failure_is_one_message(capsys: pytest.CaptureFixture[str]) -> None:
    """On stderr, with a hint at --debug, which shows both tracebacks, where there is more to see.
    Nothing of a bug of ours is blamed on the environment."""
    assert fail(UsageError("say [red]this[/red]"), debug=False) == 2
    assert capsys.readouterr() == ("", "Error: say [red]this[/red]\n")
    theirs = errors.remote_error("BrokenPipeError", "BrokenPipeError", "x", "far \x1b away")
    assert fail(theirs, debug=False) == 1
    assert "(--debug shows the traceback)" in capsys.readouterr().err
    fail(theirs, debug=True)
    shown = capsys.readouterr().err
    assert "Traceback (most recent call last)" in shown
    assert "far \\x1b away" in shown
    assert fail(KeyError("x"), debug=False) == 70
    assert "a bug in envhub: KeyError" in capsys.readouterr().err


_ENDS = """
import sys, typer
from envhub_sandbox.cli.shared.console import say
from envhub_sandbox.cli.shared.exits import reported

try:
    with reported(debug=False):
        if sys.argv[1] == "interrupted":
            raise KeyboardInterrupt
        say("a line about progress")
        print("x" * 100_000)
except typer.Exit as end:
    sys.exit(end.exit_code)
"""


@pytest.mark.parametrize(
    ("how", "to", "code"),
    [
        ("told", "full", Exit.USAGE),
        ("told", "nobody", Exit.PIPE),
        ("interrupted", "nobody", Exit.INTERRUPTED),
        ("interrupted", "full", Exit.INTERRUPTED),
    ],
)
def test_where_nothing_can_be_written_the_code_is_the_same(how: str, to: str, code: Exit) -> None:
    if to == "full":
        end = os.open("/dev/full", os.O_WRONLY)
    else:
        nobody, end = os.pipe()
        os.close(nobody)
    try:
        command = [sys.executable, "-I", "-c", _ENDS, how]
        done = subprocess.run(command, stdout=end, stderr=end, timeout=120)
    finally:
        os.close(end)
    assert done.returncode == code


def test_a_full_disk_is_no_bug() -> None:
    assert describe(OSError(errno.ENOSPC, "full")).startswith("no space is left for what is print")
    assert "left for /x/y;" in describe(OSError(errno.EDQUOT, "full", "/x/y"))
    assert code_for(OSError(errno.ENOSPC, "full")) is Exit.USAGE
    assert code_for(OSError(errno.EBADF, "bad")) is Exit.BUG


def test_a_line_stays_a_line() -> None:
    assert safe_line("a\nb\tc\x1b[2J\u202e") == "a b c\\x1b[2J\\u202e"
    assert len(safe_line("x" * 1_000_000, 50)) == 50


def test_json_is_valid_whatever_is_in_it(capsys: pytest.CaptureFixture[str]) -> None:
    """Arrays become lists, numbers that JSON lacks null, and anything else text."""
    document: dict[Any, Any] = {
        "nan": float("nan"),
        "inf": [np.float32("inf"), -np.inf],
        "array": np.arange(4).reshape(2, 2),
        "scalar": np.float64(0.5),
        "flag": np.bool_(True),
        "tuple": (1, None),
        "bytes": b"\x00",
        3: object,
    }
    print_json(document)
    read = json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(name))
    assert read["nan"] is None
    assert (read["inf"], read["array"]) == ([None, None], [[0, 1], [2, 3]])
    assert (read["scalar"], read["flag"], read["tuple"]) == (0.5, True, [1, None])
    assert read["3"] == "<class 'object'>"
    value = {"a": [1, 2.5, "ü", None, True]}
    assert plain(value) == value


def test_statistics_are_the_population_s() -> None:
    spread = pytest.approx(1.8708286)
    assert statistics([1, 2, 3, 6]) == {"mean": 3.0, "std": spread, "min": 1.0, "max": 6.0}
    assert statistics([]) is None


def result(*returns: tuple[float, ...]) -> TaskResult:
    fields: dict[str, Any] = {"sub_env": 0, "length": 3, "terminated": True, "success": None}
    rollout = Rollout(episodes=[Episode(returns=value, **fields) for value in returns])
    task: dict[str, Any] = {"suite": "s", "task": 0, "num_envs": 1, "autoreset_mode": None}
    return TaskResult(rollout=rollout, video=None, **task)


def test_vector_returns_are_lists() -> None:
    two = task_document(result((1.0, -1.0), (3.0, -3.0)))
    assert [component["mean"] for component in two["return"]] == [2.0, -2.0]
    assert [list(episode["return"]) for episode in two["episodes"]] == [[1.0, -1.0], [3.0, -3.0]]
    one = task_document(result((1.0,), (3.0,)))
    assert one["return"]["mean"] == 2.0
    assert [episode["return"] for episode in one["episodes"]] == [1.0, 3.0]
    assert returns_of(result().rollout) == [None], "there is nothing to average"
    assert task_document(result())["success_rate"] is None
