"""Frames of a message, and the number in front of a header."""

from __future__ import annotations

import pytest

from envhub_worker.protocol.errors import ProtocolError
from envhub_worker.protocol.messages import packing, runner, server


@pytest.mark.parametrize("message", [server.GetStatus(), runner.Value([1, {"a": b"x"}])])
def test_a_message_arrives_as_it_was(message: packing.Message) -> None:
    """By itself, and with a number of one or more."""
    assert packing.unpack(packing.pack(message)) == message
    for number in (1, 7, 1 << 40):
        [frame] = packing.pack_header(message, number)
        assert packing.unpack_header(frame) == (number, message)
        assert packing.number_of(frame) == packing.id_of(frame) == number
        assert bytes(packing.without_id(frame)) == bytes(packing.pack(message)[0])


@pytest.mark.parametrize("frame", [b"", b"\0\0\0"])
def test_a_header_without_a_number_has_none(frame: bytes) -> None:
    """No error of another kind than the protocol's."""
    assert packing.number_of(frame) is None
    assert packing.id_of(frame) is None
    assert packing.id_of(b"\0" * 20) is None
    with pytest.raises(ProtocolError):
        packing.unpack_header(frame)
