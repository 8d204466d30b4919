"""How a command prints: what is printed is text and no more, whoever chose it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence

import pytest

from envhub_sandbox.cli.shared import console
from envhub_sandbox.cli.shared.console import guarded, show_rows
from tests.support.output.ci import obeyed
from tests.support.processes import eventually

_ROWS = [("layer", "what it does"), ("memory", "8192 MiB, counted by the kernel; not file-locks")]


@pytest.fixture
def shown_in_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[[Sequence[Sequence[str]]], list[str]]:
    """The lines of a table in a terminal of 32 columns, without colours."""

    def shown(rows: Sequence[Sequence[str]]) -> list[str]:
        monkeypatch.setenv("TERM", "dumb")
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
        monkeypatch.setattr("shutil.get_terminal_size", lambda: os.terminal_size((32, 40)))
        show_rows(rows)
        return capsys.readouterr().out.splitlines()

    return shown


def test_a_terminal_wraps_the_last_column_below_itself(
    shown_in_a_terminal: Callable[..., list[str]],
) -> None:
    assert shown_in_a_terminal(_ROWS) == [
        "layer   what it does",
        "memory  8192 MiB, counted by the",
        "        kernel; not file-locks",
    ]
    narrow = [("x" * 20, "one two three four five")]
    assert len(shown_in_a_terminal(narrow)) == 1, "the terminal wraps it by itself"


def test_a_wrapped_line_begins_no_command(
    shown_in_a_terminal: Callable[..., list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    """A CI system skips blanks; the control is the same without the guard."""
    rows = [("a", "a layer of a hostile server ::error::forged")]
    assert obeyed("\n".join(shown_in_a_terminal(rows))) == ["::error::forged"]
    with guarded():
        show_rows(rows)
    shown = capsys.readouterr().out
    assert len(shown.splitlines()) == 2
    assert obeyed(shown) == []


def test_what_takes_long_has_lines_in_a_log(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """It says what and for how long, and again; nothing of what was over before."""
    written: list[str] = []

    def lines() -> list[str]:
        written.append(capfd.readouterr().err)
        return "".join(written).splitlines()

    with console.ProgressBar(quiet=True, long_s=0.05) as bar:
        bar.begin("brief")
        bar.begin("a / 0: ::error::8 resets, round 1 of 4")
        assert eventually(lambda: len(lines()) >= 2)
    assert all("a / 0: " in line and line.endswith(" so far") for line in lines())
