"""What a server says that a jail was denied is input from elsewhere."""

from __future__ import annotations

from typing import Any

import pytest

from envhub_sandbox.session.jails.denials import read_denials


@pytest.mark.parametrize("told", [None, "ptrace", ["ptrace"], {"ptrace": 1}, 7])
def test_what_is_no_list_of_texts_is_none(told: Any) -> None:
    """As where nobody records it."""
    assert read_denials(told) is None


def test_what_is_no_attempt_is_left_out() -> None:
    """Only forms that there are; nothing that a terminal would obey, nothing long, and not many."""
    good = ("ptrace", "socket AF_INET", "write /home/other/x\\x1b")
    bad = (b"ptrace", 7, None, ("ptrace",), "Ptrace", "read x", "read /\x1b[2J", "a" * 41)
    assert read_denials((*bad, *good, "read /" + "x" * 401)) == good
    assert len(read_denials(("ptrace",) * 100_000) or ()) == 64
