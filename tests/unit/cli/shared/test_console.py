"""What commands print: facts, tables and their last column, in a terminal and in a pipe."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence

import pytest

from envhub_sandbox.cli.shared.console import guarded, show, show_rows
from tests.support.output.ci import obeyed

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
    """At blanks only: a name stays whole."""
    assert shown_in_a_terminal(_ROWS) == [
        "layer   what it does",
        "memory  8192 MiB, counted by the",
        "        kernel; not file-locks",
    ]


def test_a_column_that_is_too_narrow_is_not_wrapped(
    shown_in_a_terminal: Callable[..., list[str]],
) -> None:
    """The terminal wraps the line by itself."""
    assert len(shown_in_a_terminal([("x" * 20, "one two three four five")])) == 1


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


def test_a_pipe_has_a_line_for_each_row(capsys: pytest.CaptureFixture[str]) -> None:
    """Also a long one, for programs that read lines."""
    show_rows([*_ROWS, ("long", "word " * 30)])
    assert len(capsys.readouterr().out.splitlines()) == 3


def test_a_fact_is_on_the_stream_that_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    """With its word in front, and the text on one line."""
    show("packages", "7\nof them")
    show("in", "/cache", stderr=True)
    shown = capsys.readouterr()
    assert shown.out == "packages     7 of them\n"
    assert shown.err == "in           /cache\n"
