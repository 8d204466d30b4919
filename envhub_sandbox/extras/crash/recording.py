"""Requests as they are kept: in memory by ``History``, in a file by ``bundle_writer``."""

from __future__ import annotations

from typing import NamedTuple

from envhub_sandbox.errors import EnvHubError
from envhub_worker.protocol import messages as m


class RecordedRequest(NamedTuple):
    """A request that is no step.

    Attributes:
        frames: Without anything pickled.
        exact: Whether these are its very values.
        lasts: Whether its effect outlasts a reset.
    """

    frames: list[bytes]
    exact: bool
    lasts: bool = False


class Recording(NamedTuple):
    """What was asked of an environment since it was last seeded, in order.

    Attributes:
        complete: Whether the same requests again are all that its jail was asked.
        seeded: Whether the last reset of all has seeded every sub-environment.
    """

    requests: list[RecordedRequest]
    complete: bool
    seeded: bool


def encoded(message: m.Message) -> RecordedRequest:
    """A message as it can be kept, with descriptions in place of what only pickle could carry."""
    for pickler in (_refuse, None):
        try:
            frames = m.pack(message, pickler=pickler)
        except EnvHubError:
            continue
        return RecordedRequest([*map(bytes, frames)], exact=pickler is not None)
    return RecordedRequest([*map(bytes, m.pack(m.Done()))], exact=False)


def _refuse(value: object) -> bytes:
    raise TypeError(f"{type(value).__name__} has no plain form")
