"""Warnings in front of a reply: found, bounded, and nothing else."""

from __future__ import annotations

import pytest

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.codec import Buffer
from envhub_worker.protocol.errors import MessageTooLargeError, RemoteProtocolError
from envhub_worker.protocol.messages import warned

REPLY = m.pack(m.Value(1))
TOLD = ("UserWarning", "slow")


def frame(*warnings: object) -> Buffer:
    """What stands in front of a reply, whatever it holds."""
    return m.pack(m.Warned(tuple(warnings)))[0]


def test_what_was_put_in_front_is_read() -> None:
    """And the reply's frames are as they were."""
    frames = warned.in_front([TOLD, TOLD], REPLY)
    assert warned.stand_in_front(frames)
    assert warned.read(frames[0]) == [TOLD, TOLD]
    assert frames[1:] == REPLY


@pytest.mark.parametrize(
    "frames",
    [REPLY, [*REPLY, b""], [*REPLY, *REPLY], [b"", b""], [frame(TOLD)]],
    ids=["a reply", "a reply with arrays", "two replies", "nothing", "no reply"],
)
def test_other_frames_are_a_reply(frames: list[Buffer]) -> None:
    """Only a ``Warned`` with something behind it stands in front of a reply."""
    assert not warned.stand_in_front(frames)


@pytest.mark.parametrize(
    "lie",
    [
        frame(*[TOLD] * (warned.MOST_AT_ONCE + 1)),
        frame("slow"),
        frame(("UserWarning",)),
        frame(("UserWarning", 1)),
        frame((None, "slow")),
        frame(["UserWarning", "slow"]),
        frame(("x" * (warned.MAX_CATEGORY + 1), "slow")),
        frame(("UserWarning", "x" * (warned.MAX_TEXT + 1))),
        REPLY[0],
        b"",
    ],
)
def test_anything_else_is_refused(lie: Buffer) -> None:
    """Too many, too long, of other types, or no warnings at all."""
    with pytest.raises(RemoteProtocolError):
        warned.read(lie)


def test_a_giant_is_refused_unread() -> None:
    """By its size, before anything of it is decoded."""
    largest = frame(*[("é" * warned.MAX_CATEGORY, "é" * warned.MAX_TEXT)] * warned.MOST_AT_ONCE)
    assert len(warned.read(largest)) == warned.MOST_AT_ONCE
    with pytest.raises(MessageTooLargeError):
        warned.read(bytes(1 << 20))
