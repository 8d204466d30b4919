"""Messages to frames and back.

A message is the value ``[kind, id, field, ...]`` in the codec's encoding: one msgpack header and
raw buffers. ``id`` ties a reply to its request. ``unpack`` checks the kind, the number of fields
and each field's type, so that a decoded message is what its class says. Trust: what comes from a
jail is hostile.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import msgpack  # type: ignore[import-untyped]

from envhub_worker.protocol.codec import templates
from envhub_worker.protocol.codec.codec import Buffer, decode_parts, encode, split
from envhub_worker.protocol.codec.decoder import ThingReader, Unpickler
from envhub_worker.protocol.codec.encoder import Describer
from envhub_worker.protocol.codec.exact import Pickler, handed_over
from envhub_worker.protocol.codec.explain import unpicklable
from envhub_worker.protocol.codec.kinds import DOCUMENT_BYTES
from envhub_worker.protocol.errors import LocalProtocolError, RemoteProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from envhub_worker.protocol.messages.base import KINDS, Message, check_fields, values_of
from envhub_worker.protocol.untrusted import UNTRUSTED

_HEAD_BYTES = 64
"""Enough for the length of a document, its kind and its id."""
_OUTGOING: templates.Forms[Any, templates.Outgoing] = templates.Forms()
_INCOMING: templates.Forms[bytes, templates.Incoming[Message]] = templates.Forms()


def pack(
    message: Message,
    request_id: int,
    *,
    pickler: Pickler | None = None,
    limits: WireLimits = DEFAULT_LIMITS,
    describer: Describer | None = None,
) -> list[Buffer]:
    """The frames of a message.

    With a pickler, what the caller hands over (``Message.HANDED``) arrives exactly as it is.

    Raises:
        LocalProtocolError: A field holds what the wire cannot carry; nothing was sent.
    """
    cls = type(message)
    values = values_of(message)
    if pickler is not None and cls.HANDED:
        values = _handed(message, values, pickler, limits)
    found = templates.outline(values)
    if found is None:
        return _encoded(message, request_id, values, pickler, limits, describer)
    outline, arrays = found
    form = _OUTGOING.get((cls, outline))
    if form is not None and form.limits is limits:
        return form.frames(request_id, arrays)
    frames = _encoded(message, request_id, values, pickler, limits)
    _OUTGOING.met((cls, outline), lambda: templates.Outgoing(frames, arrays, limits))
    return frames


def _handed(
    message: Message, values: list[Any], pickler: Pickler, limits: WireLimits
) -> list[object]:
    """The fields as they are sent."""
    sent = list(values)
    for index, name in enumerate(message.FIELDS):
        if name not in message.HANDED:
            continue
        try:
            sent[index] = handed_over(values[index], pickler, limits)
        except Exception as error:  # whatever the caller's own classes raise
            text = unpicklable(name, values[index], error, pickler)
            raise LocalProtocolError(f"{_asked(message)}{text}") from error
    return sent


def _encoded(
    message: Message,
    request_id: int,
    values: list[Any],
    pickler: Pickler | None,
    limits: WireLimits,
    describer: Describer | None = None,
) -> list[Buffer]:
    value, names = [message.kind, request_id, *values], ("kind", "id", *message.FIELDS)
    try:
        how: Any = {"limits": limits, "names": names, "describer": describer}
        return encode(value, pickler=pickler, **how)
    except LocalProtocolError as error:
        raise LocalProtocolError(f"{_asked(message)}{error}") from error.__cause__


def _asked(message: Message) -> str:
    """What the caller asked for, to stand before an error about it."""
    name = getattr(message, "name", None) if message.ASKS else None
    if not message.ASKS:
        return ""
    return f"{message.ASKS}: " if name is None else f"{message.ASKS}({name!r}): "


def unpack(
    frames: Sequence[Buffer],
    *,
    limits: WireLimits = DEFAULT_LIMITS,
    unpickler: Unpickler | None = None,
    tensors: Callable[[Any, str], object] | None = None,
    things: ThingReader | None = None,
) -> tuple[int, Message]:
    """The request id and the message of some frames.

    Raises:
        RemoteProtocolError: The peer broke the rules.
    """
    with UNTRUSTED:
        document, tail, buffers = split(frames, limits)
        plain = templates.without_id(document)
        if plain is None:
            return _decode(document, tail, buffers, limits, unpickler, tensors, things)
        key, packed_id = plain
        form = _INCOMING.get(key)
        if form is not None and form.limits is limits:
            return templates.read_id(packed_id), form.message(tail, buffers)
        how = (limits, unpickler, tensors, things)
        request_id, message = _decode(document, tail, buffers, *how)
        _INCOMING.met(key, lambda: templates.Incoming(document, type(message), limits))
        return request_id, message


def id_of(frame: Buffer) -> int | None:
    """The id of a header that may be unreadable otherwise; None if there is none.

    Trust: input from the other side. Only the first bytes are looked at.
    """
    head = msgpack.Unpacker(max_buffer_size=_HEAD_BYTES)
    head.feed(bytes(memoryview(frame).cast("B")[DOCUMENT_BYTES.size : _HEAD_BYTES]))
    try:
        items, kind, number = head.read_array_header(), head.unpack(), head.unpack()
    except Exception:  # whatever a decoder makes of noise
        return None
    if items < 2 or type(kind) is not int or type(number) is not int:
        return None
    return number if 0 < number < 1 << 63 else None


def _decode(
    document: bytes,
    tail: Buffer,
    buffers: list[Buffer],
    limits: WireLimits,
    unpickler: Unpickler | None,
    tensors: Callable[[Any, str], object] | None,
    things: ThingReader | None,
) -> tuple[int, Message]:
    value = decode_parts(document, tail, buffers, limits, unpickler, tensors, things)
    if type(value) is not list or len(value) < 2:
        raise RemoteProtocolError("a message is a list that starts with its kind and its id")
    kind, request_id, *rest = value
    cls = KINDS.get(kind) if type(kind) is int else None
    if cls is None or type(request_id) is not int or request_id.bit_length() > 63:
        raise RemoteProtocolError(f"unknown message kind {str(kind)[:40]!r}")
    check_fields(cls, rest)
    return request_id, cls(*rest)
