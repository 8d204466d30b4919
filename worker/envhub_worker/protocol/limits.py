"""Hard caps on what one message may hold. They are security limits, not tuning knobs."""

from __future__ import annotations

from functools import lru_cache

from envhub_worker.protocol.records import dataclass

KIB = 1024
MIB = 1024 * KIB
MAX_NUM_ENVS = 65_536
"""Sub-environments of one vector environment."""


@dataclass(frozen=True, kw_only=True)
class WireLimits:
    """What a receiver accepts, checked before anything of that size is allocated.

    Attributes:
        header_bytes: The header frame: structure, text, scalars, small arrays. Decoded Python
            objects take some ten times as much memory as their bytes on the wire.
        frame_bytes: One raw buffer, that is one large array (eight 4K RGB images are 199 MB).
        message_bytes: All frames of one message together, as held in memory at once.
        frames: Number of frames; each costs a socket part and a Python object.
        depth: Nesting of containers. Code that walks a decoded value recurses; Python's own
            limit is 1000 frames.
        items: Elements of all containers together, a map's key and value counting as two.
            An empty map takes one byte on the wire and about 70 in memory. Also rows of all
            arrays without elements, which take no bytes at all.
        text_bytes: One string in UTF-8. One wide character makes Python store four bytes each.
        int_bytes: One integer beyond 64 bit. Printing one takes quadratic time.
        hashed_keys: Keys of large maps, and elements of large sets, that are not text. Python
            randomises the hash of text only: other keys can be made to collide.
    """

    header_bytes: int = 8 * MIB
    frame_bytes: int = 256 * MIB
    message_bytes: int = 256 * MIB
    frames: int = 4096
    depth: int = 32
    items: int = 200_000
    text_bytes: int = 4 * MIB
    int_bytes: int = 1 * KIB
    hashed_keys: int = 10_000


DEFAULT_LIMITS = WireLimits()


@lru_cache(maxsize=256)  # a client on another host chooses them
def limits_for(message_bytes: int) -> WireLimits:
    """The limits of one jail. Equal limits are the same object, which ``Forms`` compares."""
    return WireLimits(frame_bytes=message_bytes, message_bytes=message_bytes)


MAX_IN_FLIGHT = 16
"""Requests that one runner may owe the answers to. A client sends further steps before the answer
to the first, and a late answer after a timeout may still be under way."""
LARGE_BYTES = 64 * KIB
"""Frames below this are copied when they are sent: a copy is cheaper than to keep their owner."""
