"""Errors of the wire. ``envhub_sandbox.errors`` prints the whole tree."""

from __future__ import annotations


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
