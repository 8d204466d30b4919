"""Changes in front of a reply: found, bounded, and nothing else."""

from __future__ import annotations

import pytest

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.codec import Buffer
from envhub_worker.protocol.errors import MessageTooLargeError, RemoteProtocolError
from envhub_worker.protocol.messages import changed, warned

REPLY = m.pack(m.Value(1))
TOLD = (1, "task")


def frame(*attributes: object) -> Buffer:
    """What stands in front of a reply, whatever it holds."""
    return m.pack(m.Changed(tuple(attributes)))[0]


def test_what_was_put_in_front_is_read() -> None:
    """Also where warnings stand behind it."""
    frames = changed.in_front([TOLD, (2, "x")], warned.in_front([("W", "slow")], REPLY))
    assert changed.stand_in_front(frames)
    assert changed.read(frames[0]) == [TOLD, (2, "x")]
    assert warned.stand_in_front(frames[1:])
    assert not changed.stand_in_front(frames[1:])
    assert frames[2:] == REPLY


@pytest.mark.parametrize(
    "frames", [REPLY, [*REPLY, b""], [*REPLY, *REPLY], [b"", b""], [frame(TOLD)]]
)
def test_other_frames_are_a_reply(frames: list[Buffer]) -> None:
    """Only a ``Changed`` with something behind it stands in front of a reply."""
    assert not changed.stand_in_front(frames)


@pytest.mark.parametrize(
    "lie",
    [
        frame(*[TOLD] * (changed.MOST + 1)),
        frame("task"),
        frame((1,)),
        frame((1, 2)),
        frame(("1", "task")),
        frame((True, "task")),
        frame([1, "task"]),
        REPLY[0],
        b"",
    ],
)
def test_anything_else_is_refused(lie: Buffer) -> None:
    """Too many, of other types, or no changes at all."""
    with pytest.raises(RemoteProtocolError):
        changed.read(lie)


def test_a_giant_is_refused_unread() -> None:
    """By its size, before anything of it is decoded."""
    largest = frame(*[(2**62, "é" * changed.MAX_NAME)] * changed.MOST)
    assert len(changed.read(largest)) == changed.MOST
    with pytest.raises(MessageTooLargeError):
        changed.read(bytes(1 << 20))
