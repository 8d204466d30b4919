"""Errors of the wire. ``envhub_sandbox.errors`` prints the whole tree.

In the context ``UNTRUSTED`` every error that a peer's input raises is the peer's error. Readers
check for known lies and name them. An unforeseen lie, such as an unhashable key or a mask longer
than its values, raises a ``TypeError`` or an ``IndexError`` somewhere below. Each reader of input
runs in ``UNTRUSTED``, which raises ``RemoteProtocolError`` from that error, so ``__cause__`` shows
the line.

Do not wait inside this context: an error that the caller's signal handler raises is not the peer's.
"""

from __future__ import annotations

import struct
from types import TracebackType


class EnvHubError(Exception):
    """Base of every error of this project.

    Attributes:
        denied: Denials before the jail ended, as ``env.sandbox.denials()`` words them; None if
            denials are not recorded or no jail has ended.
        env_ids: For ``send`` and ``recv``: the sub-environments of the worker that failed.
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
    """The context in which a peer's input is handled. It has no state: one instance serves all.

    Raises:
        MessageTooLargeError: There was not enough memory for the input.
        RemoteProtocolError: The block raised one of ``FAULTS``. This project's errors pass.
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
    """Whether ``error`` is one that a peer's input may cause and that has no class of ours yet."""
    return isinstance(error, FAULTS) and not isinstance(error, EnvHubError)


def blamed(error: BaseException) -> RemoteProtocolError:
    """Returns the error to raise instead. Trust: its text may quote the peer."""
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
