"""What a refusal for want of room says, and what is made of one that says anything else."""

from __future__ import annotations

import pytest

from envhub_worker.protocol.messages.busy import LONGEST_S, Busy


def test_a_refusal_arrives_as_it_was() -> None:
    assert Busy.read("jails", Busy("jails", 3, 4, 2.5).words()) == Busy("jails", 3, 4, 2.5)
    assert Busy.read("jails", "3 4 9999").retry_s == LONGEST_S


@pytest.mark.parametrize(
    ("quota", "words"),
    [
        *(("jails", text) for text in ("", "3 4", "3 4 -1", "3 4 nan", "9" * 19 + " 1 1")),
        *((name, "3 4 1") for name in ("", "Jails", "a" * 33, "\x1b[2J")),
    ],
)
def test_anything_else_says_nothing(quota: str, words: str) -> None:
    assert Busy.read(quota, words) == Busy("", 0, 0, 1.0)
