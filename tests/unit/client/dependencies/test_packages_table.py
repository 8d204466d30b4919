"""The repositories of ``python -m benchmarks.packages`` are ones that could come up."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.packages import CASES, HEAD, Came, row
from envhub_sandbox.dependencies.declared import declared


@pytest.mark.parametrize("name", CASES)
def test_each_declares_what_can_be_taken(name: str, tmp_path: Path) -> None:
    """Plain requirements, and an entry file that is Python."""
    CASES[name].write(tmp_path / "repo")
    found = declared(tmp_path / "repo", "env.py")
    assert found is not None
    assert [wanted.hashes for wanted in found.wanted] == [()] * len(found.wanted)
    assert found.wanted
    compile((tmp_path / "repo/env.py").read_text(), "env.py", "exec")


@pytest.mark.parametrize(
    "came", [Came((9.0, 1.0, 1.0), 2**30, 12, ""), Came((), 0, 0, "no wheel | at all")]
)
def test_each_has_a_row_of_the_table(came: Came) -> None:
    """With as many cells as the head, whatever became of it."""
    cells = row("it", came).replace("\\|", "").count("|")
    assert cells == HEAD.splitlines()[0].count("|")
