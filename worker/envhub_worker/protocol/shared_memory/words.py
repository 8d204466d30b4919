"""The header of a slab: 64-bit words, by their numbers. No numpy: the server reads these, too.

Each slab starts with one. Words that the other side polls have a cache line of their own.
"""

from __future__ import annotations

from typing import Any

LINE = 64
"""Bytes of a cache line: words that two cores poll must not share one."""
INFO_BYTES = 64 * 1024
"""Room for a step's infos, or for what it raised, or for a message or its answer. What is larger
goes through the server."""

# A word has 8 bytes, a cache line holds 8 words.
SEQUENCE = 0
"""Counts requests, or replies; polled by the other side."""
PARKED = 8
"""1 while this slab's writer sleeps in poll and wants its doorbell rung."""
OUTCOME = 16
"""Reply: ``DONE``, ``RAISED``, ``FETCH``, ``COLUMNS`` or ``FORMED``."""
LENGTH = 17
"""Reply: bytes of the encoded infos, or of what was raised; 0 for an empty info. Where a step is a
message: of the answer, or of its scalars if it is columns. If ``FORMED``: of the infos' scalars."""
OFFERED = 18
"""Reply: the ``digest`` of the columns that the client should derive from this answer, or 0."""
FORM = 19
"""Reply: which of ``FORMS`` forms the offered columns or the results have."""
FORMS = 2
"""Forms that are kept: that of most steps, and that of steps which end an episode."""
SPIN = 16
"""Request: nanoseconds that the shard may wait for the next request without sleeping; of more
than ``MAX_SPIN_NS`` it takes so many."""
MAX_SPIN_NS = 400_000
"""The client may use the time between two requests, and the core, for other work."""
SLOT = 17
"""Request: the slot of the observation slab that the shard writes."""
CPU = 18
"""Request: one more than the number of the core that the shard should keep to; 0 for any. With
``AVOIDED`` added: that it should not run on."""
CHANGES = 19
"""Request: grows with every change of ``SPIN``, ``SLOT``, ``CPU`` and the dtypes."""
MESSAGE = 20
"""Request: bytes of the encoded message; 0 for a step."""
KNOWN = 21
"""Request: bytes of the infos that the client knows the columns of. For the server alone, where it
takes the steps: so much it sends of infos that came as columns."""
TO_SLOT = 22
"""Request: one more than the slot of the observation slab that the answer to a message is written
into; 0 for the reply slab."""
DERIVED = 23
"""Request: the ``SEQUENCE`` of the step whose answer the client has derived columns from, or 0."""
WRITTEN = 24
"""Request: grows with every message. If it is the same, the message is, too, but for the bytes of
the array of actions in it."""
DTYPES = 32
"""Request: the dtype code of each action leaf, one word each, up to ``MAX_LEAVES``."""
MAX_LEAVES = 64
HEADER_WORDS = DTYPES + MAX_LEAVES
HEADER_BYTES = HEADER_WORDS * 8

AVOIDED = 1 << 32

DONE, RAISED, FETCH, COLUMNS, FORMED = 1, 2, 3, 4, 5
"""Results and encoded infos are in the slab; an encoded ``RaisedException`` is; the infos must be
fetched; the infos are columns (see ``slabs``), or all results of a step that is a message are (see
``columns``); the infos are such columns as those, in the area of answers."""

INFOS = HEADER_BYTES
"""Offset of the encoded infos in a reply slab."""
ANSWER = INFOS + INFO_BYTES
"""Offset of the answer to a message in a reply slab."""
REPLY_BYTES = ANSWER + INFO_BYTES
OWN_BYTES = SPIN * 8
"""Where the client's own words begin in the request slab. Before them stand those of who announces
the request: the client, or the server in its place."""
_MAX_SERVED_REQUEST_BYTES = 1 << 20
_MAX_SERVED_BYTES = 1 << 26


def words(buffer: Any) -> memoryview:
    """The header of a mapped slab."""
    return memoryview(buffer)[:HEADER_BYTES].cast("Q")


def served(leaves: int, request_bytes: int, observation_bytes: int, message_bytes: int) -> bool:
    """Whether a server makes slabs of these sizes for a runner and takes its steps.

    Args:
        leaves: Number of action leaves. A client sends the slab's words, which include one dtype
            for each leaf, and the actions.
        message_bytes: Maximum size of a message between client and runner.
    """
    least, most = HEADER_BYTES + INFO_BYTES, min(_MAX_SERVED_BYTES, message_bytes)
    return (
        0 <= leaves <= MAX_LEAVES
        and least <= request_bytes <= _MAX_SERVED_REQUEST_BYTES
        and 0 < observation_bytes <= most - INFO_BYTES
    )
