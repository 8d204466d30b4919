"""Messages to frames and back.

A message is the value ``[kind, id, field, ...]`` in the codec's encoding: one msgpack header and
raw buffers. ``unpack`` checks the kind, the number of fields and each field's type, so that a
decoded message is what its class says. Trust: what comes from a jail is hostile.

The id ties a reply to its request. Between client and runner it is 0: packets have their own ids.
Between client and server it was the second item up to version 7. From version 8 on that is 0 too,
and the id stands in front of the header, so that a message that recurs is the same bytes again.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import msgpack  # type: ignore[import-untyped]

from envhub_worker.protocol.codec import plain, templates
from envhub_worker.protocol.codec.frames import split
from envhub_worker.protocol.codec.kinds import DOCUMENT_BYTES, Buffer
from envhub_worker.protocol.errors import LocalProtocolError, RemoteProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from envhub_worker.protocol.messages.base import KINDS, Message, check_fields, values_of
from envhub_worker.protocol.untrusted import UNTRUSTED

if TYPE_CHECKING:
    from envhub_worker.protocol.codec.decoder import ThingReader, Unpickler
    from envhub_worker.protocol.codec.encoder import Describer
    from envhub_worker.protocol.codec.exact import Pickler

FIRST_NUMBERED_VERSION = 8
_HEAD_BYTES = 64
"""Enough for the length of a document, its kind and its id."""
_NUMBER = struct.Struct(">IQ")
"""What stands in front of a numbered header: the mark, and the id, whose first byte is below 0x80.
In other headers there is the head of a msgpack array, which is not: ``compression`` looks there."""
_MARK = 0xFFFFFFFF
"""No document is so long: a header without a number begins with its document's length."""
_MOST = (1 << 63) - 1
_OUTGOING: templates.Forms[Any, templates.Outgoing] = templates.Forms()
_INCOMING: templates.Forms[bytes, templates.Incoming[Message]] = templates.Forms()


def pack(
    message: Message,
    request_id: int = 0,
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
    found = None if request_id else templates.outline(values)
    if found is None:
        return _encoded(message, request_id, values, pickler, limits, describer)
    outline, arrays = found
    form = _OUTGOING.get((cls, outline))
    if form is not None and form.limits is limits:
        return form.frames(arrays)
    frames = _encoded(message, request_id, values, pickler, limits)
    _OUTGOING.met((cls, outline), lambda: templates.Outgoing(frames, arrays, limits))
    return frames


def _handed(
    message: Message, values: list[Any], pickler: Pickler, limits: WireLimits
) -> list[object]:
    """The fields as they are sent."""
    from envhub_worker.protocol.codec.exact import handed_over
    from envhub_worker.protocol.codec.explain import unpicklable

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
    if _without_numpy():
        frame = plain.encode(value, limits)
        if frame is not None:
            return [frame]
    from envhub_worker.protocol.codec.codec import encode

    try:
        how: Any = {"limits": limits, "names": names, "describer": describer}
        return encode(value, pickler=pickler, **how)
    except LocalProtocolError as error:
        raise LocalProtocolError(f"{_asked(message)}{error}") from error.__cause__


def _without_numpy() -> bool:
    """A server does without until it has to handle an array; all others have it already."""
    return "numpy" not in sys.modules


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
        form = _INCOMING.get(document)
        if form is not None and form.limits is limits:
            return 0, form.message(tail, buffers)
        how = (limits, unpickler, tensors, things)
        request_id, message = _decode(document, tail, buffers, *how)
        if not request_id and len(document) <= templates.MAX_DOCUMENT_BYTES:
            _INCOMING.met(document, lambda: templates.Incoming(document, type(message), limits))
        return request_id, message


class Header(NamedTuple):
    """What stands in the first frame of client or server.

    Attributes:
        number: The id.
        message: The message.
        numbered: Whether the id stands in front, as it does from version 8 on.
    """

    number: int
    message: Message
    numbered: bool


def pack_header(message: Message, number: int, *, numbered: bool) -> list[Buffer]:
    """The frames of a message between client and server."""
    if not numbered:
        return pack(message, number)
    header, *buffers = pack(message)
    return [_NUMBER.pack(_MARK, number) + header, *buffers]


def unpack_header(frame: Buffer, *, limits: WireLimits = DEFAULT_LIMITS) -> Header:
    """The opposite of ``pack_header``. Trust: input from the other side.

    Raises:
        RemoteProtocolError: The peer broke the rules.
    """
    number = _number(frame)
    if number is None:
        return Header(*unpack([frame], limits=limits), numbered=False)
    rest = frame if type(frame) is bytes else memoryview(frame).cast("B")
    inner, message = unpack([rest[_NUMBER.size :]], limits=limits)
    if inner or not 0 < number <= _MOST:
        raise RemoteProtocolError(f"nobody can answer under the id {number}")
    return Header(number, message, numbered=True)


def id_of(frame: Buffer) -> tuple[int, bool] | None:
    """The id of a header that cannot be read otherwise, and whether it is numbered.

    None if it has none. Trust: input from the other side. Only the first bytes are looked at.
    """
    in_front = _number(frame)
    number = _number_in_document(frame) if in_front is None else in_front
    if type(number) is not int or not 0 < number <= _MOST:
        return None
    return number, in_front is not None


def _number(frame: Buffer) -> int | None:
    """What stands in front of a header, if it is numbered."""
    plain = frame if type(frame) is bytes else memoryview(frame).cast("B")
    if len(plain) < _NUMBER.size:
        return None
    mark, number = _NUMBER.unpack_from(plain)
    return number if mark == _MARK else None


def _number_in_document(frame: Buffer) -> object:
    head = msgpack.Unpacker(max_buffer_size=_HEAD_BYTES)
    head.feed(bytes(memoryview(frame).cast("B")[DOCUMENT_BYTES.size : _HEAD_BYTES]))
    try:
        items, kind, number = head.read_array_header(), head.unpack(), head.unpack()
    except Exception:  # whatever a decoder makes of noise
        return None
    return number if items >= 2 and type(kind) is int else None


def _decode(
    document: bytes,
    tail: Buffer,
    buffers: list[Buffer],
    limits: WireLimits,
    unpickler: Unpickler | None,
    tensors: Callable[[Any, str], object] | None,
    things: ThingReader | None,
) -> tuple[int, Message]:
    value = plain.NOT_PLAIN
    if _without_numpy() and not tail and not buffers:
        value = plain.decode(document, limits)
    if value is plain.NOT_PLAIN:
        from envhub_worker.protocol.codec.codec import decode_parts

        value = decode_parts(document, tail, buffers, limits, unpickler, tensors, things)
    if type(value) is not list or len(value) < 2:
        raise RemoteProtocolError("a message is a list that starts with its kind and its id")
    kind, request_id, *rest = value
    cls = KINDS.get(kind) if type(kind) is int else None
    if cls is None or type(request_id) is not int or request_id.bit_length() > 63:
        raise RemoteProtocolError(f"unknown message kind {str(kind)[:40]!r}")
    check_fields(cls, rest)
    return request_id, cls(*rest)
