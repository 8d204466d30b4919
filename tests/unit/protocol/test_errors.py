"""What the handling of a peer's input raises is the peer's fault; nothing else is."""

import struct

import pytest

from envhub_worker.protocol.errors import UNTRUSTED, MessageTooLargeError, RemoteProtocolError


class Mute(ValueError):
    """Its text is made of the peer's values."""

    def __str__(self) -> str:
        raise RuntimeError


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        *((one("x"), RemoteProtocolError) for one in (TypeError, IndexError, ValueError, KeyError)),
        *((one("x"), RemoteProtocolError) for one in (struct.error, RecursionError, Mute)),
        (MemoryError(), MessageTooLargeError),
    ],
)
def test_faults_are_blamed_on_the_peer(error: Exception, kind: type[Exception]) -> None:
    with pytest.raises(RemoteProtocolError) as caught, UNTRUSTED:
        raise error
    assert type(caught.value) is kind
    assert caught.value.__cause__ is error


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError("no"), RemoteProtocolError("lie")])
def test_others_pass_as_they_are(error: BaseException) -> None:
    with pytest.raises(type(error)) as caught, UNTRUSTED:
        raise error
    assert caught.value is error


def test_what_is_said_is_one_short_line() -> None:
    with pytest.raises(RemoteProtocolError) as caught, UNTRUSTED:
        raise ValueError("\x1b[2J\n" * 10_000)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1_000
