"""Messages to frames and back.

A message is the value ``[kind, field, ...]`` in the codec's encoding: one msgpack header and raw
buffers. ``unpack`` checks the kind, the number of fields and each field's type, so that a decoded
message is what its class says. Trust: what comes from a jail is hostile.

Between client and server an id ties a reply to its request. It stands in front of the header, so
that a message that recurs is the same bytes again. Packets to a runner have ids of their own.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

from envhub_worker.protocol.codec import forms
from envhub_worker.protocol.codec.codec import encode
from envhub_worker.protocol.codec.decoder import Decoder, TensorMaker, ThingReader, Unpickler
from envhub_worker.protocol.codec.encoder import Describer, Pickler
from envhub_worker.protocol.codec.frames import split_frames
from envhub_worker.protocol.codec.kinds import DOCUMENT_BYTES, Buffer
from envhub_worker.protocol.errors import LocalProtocolError, RemoteProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from envhub_worker.protocol.messages.base import KINDS, Message, check_fields, values_of
from envhub_worker.protocol.untrusted import UNTRUSTED

_NUMBER = struct.Struct(">Q")
"""The id in front of a header between client and server; 0 for ``CompressionHeader`` alone."""
_MOST = (1 << 63) - 1
_OUTGOING: forms.Forms[Any, forms.Outgoing] = forms.Forms()
_INCOMING: forms.Forms[bytes, forms.Incoming[Message]] = forms.Forms()
_HEADERS: forms.Forms[bytes, forms.Incoming[Message]] = forms.Forms()
"""The same by the whole header, where that is nothing but the document."""


def pack(
    message: Message,
    *,
    pickler: Pickler | None = None,
    limits: WireLimits = DEFAULT_LIMITS,
    describer: Describer | None = None,
    reduces: bool = False,
) -> list[Buffer]:
    """The frames of a message.

    With a pickler, what the caller hands over (``Message.HANDED``) arrives exactly as it is.
    ``reduces``: as ``encode`` has it.
    Raises ``LocalProtocolError``: a field holds what the wire cannot carry; nothing was sent.
    """
    cls = type(message)
    values = values_of(message)
    if pickler is not None and cls.HANDED:
        values = _handed(message, values, pickler, limits)
    outline = forms.outline(values)
    if outline is None:
        return _encoded(message, values, pickler, limits, describer, reduces=reduces)
    form = _OUTGOING.get((cls, outline))
    if form is not None and form.limits is limits:
        return list(form.frames)
    try:
        frames = _encoded(message, values, pickler, limits)
    except LocalProtocolError:
        if not reduces:
            raise
        return _encoded(message, values, pickler, limits, describer, reduces=True)
    _OUTGOING.met((cls, outline), lambda: forms.Outgoing(list(frames), limits))
    return frames


def _handed(
    message: Message, values: list[Any], pickler: Pickler, limits: WireLimits
) -> list[object]:
    """The fields as they are sent."""
    from envhub_worker.protocol.codec.explain import unpicklable
    from envhub_worker.protocol.codec.handed_over import handed_over

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
    values: list[Any],
    pickler: Pickler | None,
    limits: WireLimits,
    describer: Describer | None = None,
    *,
    reduces: bool = False,
) -> list[Buffer]:
    value, names = [message.kind, *values], ("kind", *message.FIELDS)
    options: dict[str, Any] = {"describer": describer, "reduces": reduces}
    try:
        return encode(value, pickler=pickler, limits=limits, names=names, **options)
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
    tensors: TensorMaker | None = None,
    things: ThingReader | None = None,
) -> Message:
    """The message of some frames. Raises ``RemoteProtocolError``: the peer broke the rules."""
    with UNTRUSTED:
        document, tail, buffers = split_frames(frames, limits)
        bare = not (tail or buffers)
        form = _INCOMING.get(document) if bare else None
        if form is not None and form.limits is limits:
            return form.message()
        decoder = Decoder(tail, buffers, limits, unpickler, tensors, things)
        message = _checked(decoder.value(document))
        if bare and len(document) <= forms.MAX_DOCUMENT_BYTES:
            _INCOMING.met(document, lambda: forms.Incoming(document, type(message), limits))
        return message


def pack_header(message: Message, number: int) -> list[Buffer]:
    """The frames of a message between client and server, with its id in front."""
    header, *buffers = pack(message)
    return [with_id(header, number), *buffers]


def with_id(header: Buffer, number: int) -> Buffer:
    """A header with the id of its request in front."""
    return _NUMBER.pack(number) + header


def unpack_header(frame: Buffer, *, limits: WireLimits = DEFAULT_LIMITS) -> tuple[int, Message]:
    """The id and the message of a header. Trust: input from the other side.
    Raises ``RemoteProtocolError``: the peer broke the rules.
    """
    number = id_of(frame)
    if number is None:
        raise RemoteProtocolError("a header starts with the id of its request")
    header = without_id(frame)
    if type(header) is not bytes:
        return number, unpack([header], limits=limits)
    known = _HEADERS.get(header)
    if known is not None and known.limits is limits:
        return number, known.message()
    message = unpack([header], limits=limits)
    form = _INCOMING.get(header[DOCUMENT_BYTES.size :])
    if form is not None:
        _HEADERS.met(header, lambda: form)
    return number, message


def without_id(frame: Buffer) -> Buffer:
    """What comes after the id of a header."""
    return frame[_NUMBER.size :] if type(frame) is bytes else memoryview(frame)[_NUMBER.size :]


def id_of(frame: Buffer) -> int | None:
    """The id in front of a header; None if there is none. Trust: input from the other side."""
    number = number_of(frame)
    return number if number is not None and 0 < number <= _MOST else None


def number_of(frame: Buffer) -> int | None:
    """The first bytes of a header as a number, 0 included; None if there are too few."""
    return _NUMBER.unpack_from(frame)[0] if len(frame) >= _NUMBER.size else None


def _checked(value: object) -> Message:
    if type(value) is not list or not value:
        raise RemoteProtocolError("a message is a list that starts with its kind")
    kind, *fields = value
    cls = KINDS.get(kind) if type(kind) is int else None
    if cls is None:
        raise RemoteProtocolError(f"unknown message kind {str(kind)[:40]!r}")
    check_fields(cls, fields)
    return cls(*fields)
