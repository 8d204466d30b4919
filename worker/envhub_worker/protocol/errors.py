"""Errors of the wire. ``envhub_sandbox.errors`` prints the whole tree.

``UNTRUSTED`` is the context in which whatever a peer's input raises is the peer's error. Readers
check for known lies, and say what is wrong. An unknown one, such as a key that cannot be hashed or
a mask that is longer than its values, comes up as a ``TypeError`` or an ``IndexError`` from
somewhere below. ``UNTRUSTED`` stands around each place where input is handled, and makes
``RemoteProtocolError`` of it, with the place in ``__cause__``.

It must not stand around a wait: what a signal handler of the caller's raises there is his.
"""

from __future__ import annotations

import struct
from types import TracebackType


class EnvHubError(Exception):
    """Base of every error of this project.

    Attributes:
        denied: What the jail was denied that it ends, in the words of
            ``env.sandbox.denials()``; None where it is not recorded, or no jail has ended.
        env_ids: Of ``send`` and ``recv``: the sub-environments of the worker that it is about.
    """

    denied: tuple[str, ...] | None = None
    env_ids: tuple[int, ...] = ()


class ProtocolError(EnvHubError):
    """A message broke the rules of the wire; the subclass says whose fault it was."""


class LocalProtocolError(ProtocolError):
    """We were asked to send something that the wire cannot carry. Nothing was sent."""


class RemoteProtocolError(ProtocolError):
    """The peer sent something that the rules forbid. Trust: input from the worker."""


class MessageTooLargeError(RemoteProtocolError):
    """The peer's message is over a named limit; it was refused before it was allocated."""


class VersionMismatchError(RemoteProtocolError):
    """Client and worker share no protocol version; the text says which side to upgrade."""


FAULTS: tuple[type[Exception], ...] = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    BlockingIOError,
    BufferError,
    LookupError,
    MemoryError,
    RuntimeError,
    StopIteration,
    struct.error,
    SystemError,
    TypeError,
    ValueError,
    Warning,
)
"""What code raises about the values that it meets. No interrupt, no library's own."""
_MAX_CHARS = 500


class UntrustedInput:
    """A context in which a peer's input is handled; keeps nothing, so one serves all.

    Raises:
        MessageTooLargeError: There was not enough memory for it.
        RemoteProtocolError: Anything of ``FAULTS`` came up. Errors of this project pass.
    """

    __slots__ = ()

    def __enter__(self) -> None:
        """Do nothing: a step enters this context several times."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is not None and is_fault(error):
            raise blamed(error) from error


UNTRUSTED = UntrustedInput()


def is_fault(error: BaseException) -> bool:
    """Whether that is what handling a peer's input may raise, and no error of this project yet."""
    return isinstance(error, FAULTS) and not isinstance(error, EnvHubError)


def blamed(error: BaseException) -> RemoteProtocolError:
    """The error to raise for it. Trust: its text may hold the peer's own."""
    if isinstance(error, MemoryError):
        return MessageTooLargeError("there is not enough memory for the peer's message")
    # it brings inspect, and a server starts its zygote before that
    from envhub_worker.protocol.codec.inert import one_line

    try:
        text = one_line(str(error), _MAX_CHARS)
    except Exception:  # a text is made of values, and these are the peer's
        text = "..."
    return RemoteProtocolError(
        f"the peer's message cannot be handled: {type(error).__name__}: {text}"
    )
