"""Warnings and changes in front of a reply: found, bounded, and nothing else."""

from typing import Any

import pytest

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import MessageTooLargeError
from envhub_worker.protocol.messages.prefix import (
    CHANGES,
    MAX_ATTRIBUTE,
    MAX_CATEGORY,
    MAX_TEXT,
    SHARED_CATEGORY,
    WARNINGS,
    Prefix,
)
from tests.support.wire import not_refused

REPLY = m.pack(m.Value(1))
WARNING = ("UserWarning", "slow")
CHANGE = (1, "task")


def warned(*things: object) -> Buffer:
    return m.pack(m.Warnings(tuple(things)))[0]


def changed(*things: object) -> Buffer:
    return m.pack(m.Changes(tuple(things)))[0]


def test_what_was_put_in_front_is_read() -> None:
    frames = CHANGES.put([CHANGE, (2, "x")], WARNINGS.put([WARNING, WARNING], REPLY))
    changes, rest = CHANGES.read(frames)
    assert changes == [CHANGE, (2, "x")]
    assert CHANGES.read(rest) == ([], rest)
    assert WARNINGS.read(rest) == ([WARNING, WARNING], REPLY)


@pytest.mark.parametrize("prefix", [WARNINGS, CHANGES])
@pytest.mark.parametrize(
    "frames",
    [REPLY, [*REPLY, b""], [*REPLY, *REPLY], [b"", b""], [warned(WARNING)], [changed(CHANGE)]],
    ids=["a reply", "with arrays", "two replies", "nothing", "only warnings", "only changes"],
)
def test_other_frames_are_a_reply(prefix: Prefix[Any], frames: list[Buffer]) -> None:
    assert prefix.read(frames) == ([], frames)


def test_anything_else_is_refused() -> None:
    lies = [
        *(warned(*[WARNING] * (WARNINGS.most + 1)), warned()[:-1]),
        *map(warned, ("slow", ("UserWarning",), ("UserWarning", 1), (None, "slow"))),
        *map(warned, (["UserWarning", "slow"], (["UserWarning"], ["slow"]))),
        *map(warned, (("x" * (MAX_CATEGORY + 1), "slow"), ("UserWarning", "x" * (MAX_TEXT + 1)))),
        warned((SHARED_CATEGORY, "\x1b[2Jall your files")),
        *(changed(*[CHANGE] * (CHANGES.most + 1)), changed()[:-1]),
        *map(changed, ("task", (1,), (1, 2), ("1", "task"), (True, "task"), [1, "task"])),
    ]
    assert not_refused(lambda lie: WARNINGS.read(CHANGES.read([lie, *REPLY])[1]), lies) == []


@pytest.mark.parametrize(
    ("prefix", "largest"),
    [(WARNINGS, ("é" * MAX_CATEGORY, "é" * MAX_TEXT)), (CHANGES, (2**62, "é" * MAX_ATTRIBUTE))],
)
def test_a_giant_is_refused_unread(prefix: Prefix[Any], largest: Any) -> None:
    frames = prefix.put([largest] * prefix.most, REPLY)
    assert prefix.read(frames) == ([largest] * prefix.most, REPLY)
    with pytest.raises(MessageTooLargeError):
        prefix.read([bytes(frames[0]) + bytes(1 << 20), *REPLY])
