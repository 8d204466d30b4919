"""What is printed of what takes long, where no terminal looks."""

from __future__ import annotations

import pytest

from envhub_sandbox.cli.shared import progress
from tests.support.processes import eventually


def test_what_takes_long_has_lines_in_a_log(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """It says what and for how long, and again; nothing of what was over before."""
    written: list[str] = []

    def lines() -> list[str]:
        written.append(capfd.readouterr().err)
        return "".join(written).splitlines()

    with progress.ProgressBar(quiet=True, long_s=0.05) as bar:
        bar.begin("brief")
        bar.begin("a / 0: ::error::8 resets, round 1 of 4")
        assert eventually(lambda: len(lines()) >= 2)
    assert all("a / 0: " in line and line.endswith(" so far") for line in lines())
