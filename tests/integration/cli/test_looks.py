"""``envhub diff`` and ``envhub replay`` print facts and tables, in terminals and in a pipe."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.command_line import COMMAND
from tests.support.output.bundles import crashed
from tests.support.output.ci import log_of
from tests.support.repositories import write_repository
from tests.support.samples import sample

pytestmark = pytest.mark.same_for("users")

_OLD = "def make_env(n_envs=1): pass\n"
_NEW = "import requests\ndef make_env(n_envs=1, size=(64, 64), level='of some forty words'): pass\n"
_WAYS = [(80, {}), (120, {}), (80, {"NO_COLOR": "1"}), (None, {})]
_FACTS = ("from ", "to ", "repository ")
_COLOURS = re.compile("\x1b\\[[\\d;]*3\\d")
_DRAWN = re.compile("\x1b\\[[0-9;?]*[A-Za-z]|[^\n]*\r(?!\n)")


@pytest.fixture(params=_WAYS, ids=["80", "120", "plain", "pipe"])
def shown(request: pytest.FixtureRequest) -> Callable[..., list[str]]:
    """The lines of a command whose exit code is this, without colours and progress."""
    columns, variables = request.param

    def run(code: int, *arguments: str | Path) -> list[str]:
        terminal = {"TERM": "xterm-256color", **variables}
        done, text = log_of([*COMMAND, *map(str, arguments)], columns, terminal)
        assert done == code, text
        assert bool(_COLOURS.search(text)) == (columns is not None and not variables)
        lines = _DRAWN.sub("", text.replace("\r\n", "\n")).splitlines()
        begin = next(n for n, line in enumerate(lines) if line.startswith(_FACTS))
        table = [line for line in lines[begin:] if not line.startswith(_FACTS)]
        assert all(len(line) <= (columns or 1000) for line in table)
        return lines[begin:]

    return run


def test_changes_are_a_table(tmp_path: Path, shown: Callable[..., list[str]]) -> None:
    """A row each, of which a terminal wraps the last cell."""
    papers = {"README__md": "# x", "LICENSE": "MIT"}
    old = write_repository(tmp_path / "old", _OLD, **papers)
    new = write_repository(tmp_path / "new", _NEW, **papers)
    _from, _to, _, head, *rows, count = shown(7, "diff", old, new)
    assert head == "change   what    details"
    assert [row.split()[:2] for row in rows if not row.startswith(" ")] == [
        *(["changed", "file"], ["changed", "entry"], ["new", "import"], ["new", "note"])
    ]
    assert count == "4 changes."


def test_a_replay_is_a_table_beside_what_was_recorded(
    tmp_path: Path, shown: Callable[..., list[str]]
) -> None:
    """Both in the same columns, and what follows from them."""
    bundle = crashed(tmp_path, sample("faulty"))
    _repository, _, *rows, _, conclusion = shown(0, "replay", bundle)
    assert rows == [
        "          request  step  how it ended",
        "recorded        4     3  exit (exit code 7)",
        "replayed        4     3  exit (exit code 7)",
    ]
    assert conclusion == "It died again, in the same way and at the same request."
