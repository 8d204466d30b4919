"""What a message is, and its frames.

A message is a record with a kind, and fields of fixed names and types. It travels as the value
``[kind, field, ...]`` in the codec's encoding: one msgpack header and raw buffers. ``unpack``
checks the kind, the number of fields and each field's type, so that a decoded message is what its
class declares. Trust: messages from a jail are hostile.

Between client and server an id ties a reply to its request. It precedes the header, so that equal
messages have equal headers. Packets to a runner have ids of their own.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from envhub_worker.protocol.codec.decoder import Decoder, TensorMaker, ThingReader, Unpickler
from envhub_worker.protocol.codec.encoder import Describer, encode
from envhub_worker.protocol.codec.wire import DOCUMENT_BYTES, Buffer, Pickler, split_frames
from envhub_worker.protocol.errors import UNTRUSTED, LocalProtocolError, RemoteProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from envhub_worker.protocol.messages.forms import MAX_DOCUMENT_BYTES, Forms, Incoming
from envhub_worker.protocol.records import About, FrozenRecord

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform
else:

    def dataclass_transform(**_: object) -> Callable[[type], type]:
        """Tells type checkers that the class has a constructor; does nothing at run time."""
        return lambda cls: cls


VERSION = 1
"""The version of the protocol. Both sides must speak the same one (``Hello``)."""
FIRST_RUNNER_KIND = 64
"""Kinds from here on are between client and runner; a runner may send no other."""


# A field's annotation, and the types that its decoded value may have.
_ACCEPTED: dict[str, frozenset[type] | None] = {
    "int": frozenset({int}),
    "bool": frozenset({bool}),
    "str": frozenset({str}),
    "Reason": frozenset({str}),
    "bytes": frozenset({bytes}),
    "int | None": frozenset({int, type(None)}),
    "str | None": frozenset({str, type(None)}),
    "tuple[int, ...]": frozenset({tuple}),
    "tuple[object, ...]": frozenset({tuple}),
    "dict[str, object]": frozenset({dict}),
    "dict[object, object]": frozenset({dict}),
    "dict[str, object] | None": frozenset({dict, type(None)}),
    "object": None,
}
KINDS: dict[int, type[Message]] = {}


@dataclass_transform(frozen_default=True)
class Message(FrozenRecord):
    """Base of all messages; ``kind`` is its number on the wire and never changes.

    ``FIELDS`` are the annotated fields of a class, in the order in which they travel. ``HANDED``
    names the fields that hold the caller's own objects: they arrive exactly as they are, pickled if
    need be. ``ASKS`` is the caller's name for the request, which errors use; it may include the
    name of the called method.
    """

    kind: ClassVar[int]
    HANDED: ClassVar[tuple[str, ...]] = ()
    ASKS: ClassVar[str] = ""
    FIELDS: ClassVar[tuple[str, ...]] = ()
    _accepted: ClassVar[tuple[frozenset[type] | None, ...]] = ()

    def __init_subclass__(cls, *, kind: int, asks: str = "", handed: tuple[str, ...] = ()) -> None:
        cls.kind = kind
        cls.ASKS, cls.HANDED = asks, handed
        KINDS[kind] = cls
        cls.FIELDS = names = tuple(cls.__annotations__)
        cls._accepted = tuple(_ACCEPTED[text] for text in cls.__annotations__.values())
        defaults: dict[str, Any] = {
            name: partial(getattr, cls, name) for name in names if hasattr(cls, name)
        }
        cls.__order__ = names
        cls.__record__ = About(names, names, defaults, names, names)


M = TypeVar("M", bound=Message)


def replace(message: M, **changes: Any) -> M:
    """The same message with some fields changed."""
    return type(message)(**{**message.__dict__, **changes})


def values_of(message: Message) -> list[Any]:
    """The fields, in the order in which they travel."""
    return [*message.__dict__.values()]


def check_fields(cls: type[Message], values: list[object]) -> None:
    """Checks decoded values against the fields of a message. Trust: input from the other side.
    Raises ``RemoteProtocolError``: there are too many, too few, or one has another type.
    """
    names = cls.FIELDS
    if len(values) != len(names):
        raise RemoteProtocolError(
            f"{cls.__name__} has {len(names)} fields, the peer sent {len(values)}"
        )
    for name, accepted, value in zip(names, cls._accepted, values, strict=True):
        if accepted is not None and type(value) not in accepted:
            raise RemoteProtocolError(
                f"{cls.__name__}.{name} cannot be of type {type(value).__name__}"
            )


_NUMBER = struct.Struct(">Q")
"""The id in front of a header between client and server; 0 for ``CompressionHeader`` alone."""
_MOST = (1 << 63) - 1
_JOINED = 1 << 63
"""Marks an id whose message has one further frame, which follows the header in the same frame."""
_JOINED_BYTES = 8 * 1024
"""A frame below this joins the header: each frame is encrypted, sent and received for itself."""
_INCOMING = Forms()
"""By the document, with its length in front: the whole header, where there are no arrays."""


def pack(
    message: Message,
    *,
    pickler: Pickler | None = None,
    limits: WireLimits = DEFAULT_LIMITS,
    describer: Describer | None = None,
    reduces: bool = False,
) -> list[Buffer]:
    """Encodes a message as frames.

    With a pickler, the caller's own objects (``Message.HANDED``) arrive exactly as they are.
    ``reduces``: as for ``encode``.
    Raises ``LocalProtocolError``: a field holds what the wire cannot carry; nothing was sent.
    """
    cls = type(message)
    values, names = values_of(message), ("kind", *cls.FIELDS)
    try:
        if pickler is not None and cls.HANDED:
            from envhub_worker.protocol.codec.unsendable import handed_over

            values = handed_over(message.__dict__, cls.HANDED, pickler, limits)
        return encode([cls.kind, *values], pickler, limits, names, describer, reduces=reduces)
    except LocalProtocolError as error:
        if not cls.ASKS:
            raise
        # in front: which of the caller's calls it is about
        name = getattr(message, "name", None)
        asked = cls.ASKS if name is None else f"{cls.ASKS}({name!r})"
        raise LocalProtocolError(f"{asked}: {error}") from error.__cause__


def unpack(
    frames: Sequence[Buffer],
    *,
    limits: WireLimits = DEFAULT_LIMITS,
    unpickler: Unpickler | None = None,
    tensors: TensorMaker | None = None,
    things: ThingReader | None = None,
    borrows: bool = False,
) -> Message:
    """Decodes frames as a message; ``borrows``: as for ``Decoder``.
    Raises ``RemoteProtocolError``: the peer broke the rules.
    """
    with UNTRUSTED:
        header = _alone(frames)
        form = _INCOMING.get(header)
        if form is not None and form.limits is limits:
            return form.message(tensors=tensors)
        document, tail, buffers = split_frames(frames, limits)
        if len(document) <= MAX_DOCUMENT_BYTES:
            key = DOCUMENT_BYTES.pack(len(document)) + document
            form = _INCOMING.get(key)
            if form is not None and form.limits is limits:
                return form.message(tail, buffers, tensors, borrows=borrows)
        decoder = Decoder(tail, buffers, limits, unpickler, tensors, things, borrows=borrows)
        message = _checked(decoder.value(document))
        if len(document) <= MAX_DOCUMENT_BYTES:
            _INCOMING.met(key, partial(Incoming, document, tail, buffers, type(message), limits))
        return message


def _alone(frames: Sequence[Buffer]) -> bytes:
    """Returns the header if it is small and the only frame, else b"": such messages recur."""
    if len(frames) != 1:
        return b""
    header = frames[0] if type(frames[0]) is bytes else memoryview(frames[0]).cast("B")
    return bytes(header) if len(header) <= MAX_DOCUMENT_BYTES else b""


def pack_header(message: Message, number: int) -> list[Buffer]:
    """Encodes a message between client and server, with its id in front of the header."""
    header, *buffers = pack(message)
    return [_NUMBER.pack(number) + header, *buffers]


def with_id(header: Buffer, number: int, payload: Sequence[Buffer]) -> list[Buffer]:
    """Puts the id of a request in front of a header without arrays; joins a small payload to it."""
    if len(payload) == 1 and len(payload[0]) < _JOINED_BYTES:
        return [b"".join((_NUMBER.pack(number | _JOINED), header, payload[0]))]
    return [_NUMBER.pack(number) + header, *payload]


def unpack_header(frame: Buffer, *, limits: WireLimits = DEFAULT_LIMITS) -> tuple[int, Message]:
    """``unpack_with_id`` without the payload."""
    return unpack_with_id([frame], limits=limits)[:2]


def unpack_with_id(
    frames: Sequence[Buffer], *, limits: WireLimits = DEFAULT_LIMITS
) -> tuple[int, Message, list[Buffer]]:
    """Decodes an id, its message, and the payload. Trust: input from the other side.
    Raises ``RemoteProtocolError``: the peer broke the rules.
    """
    first, *payload = frames
    number = id_of(first)
    if number is None:
        raise RemoteProtocolError("the header does not start with the id of a request")
    if first[0] & 0x80:  # ``_JOINED``
        end = _NUMBER.size + DOCUMENT_BYTES.size
        if payload or len(first) < end:
            raise RemoteProtocolError("a frame is not the only one of its message, or too short")
        end += DOCUMENT_BYTES.unpack_from(first, _NUMBER.size)[0]
        if len(first) - end >= _JOINED_BYTES:  # before it is copied
            raise RemoteProtocolError("a frame that joins its header is too large for that")
        first, payload = first[:end], [first[end:]]
    header = without_id(first)
    form = _INCOMING.get(header) if type(header) is bytes else None
    if form is not None and form.limits is limits:  # as unpack, which a step need not call
        return number, form.message(), payload
    return number, unpack([header], limits=limits), payload


def without_id(frame: Buffer) -> Buffer:
    """Returns the header without the id in front."""
    return frame[_NUMBER.size :] if type(frame) is bytes else memoryview(frame)[_NUMBER.size :]


def id_of(frame: Buffer) -> int | None:
    """The id in front of a header; None if there is none. Trust: input from the other side."""
    number = number_of(frame)
    return number & _MOST or None if number is not None else None


def number_of(frame: Buffer) -> int | None:
    """The first bytes of a header as a number, 0 included; None if there are too few."""
    return _NUMBER.unpack_from(frame)[0] if len(frame) >= _NUMBER.size else None


def _checked(value: object) -> Message:
    if type(value) is not list or not value:
        raise RemoteProtocolError("the message is not a list that starts with its kind")
    kind, *fields = value
    cls = KINDS.get(kind) if type(kind) is int else None
    if cls is None:
        raise RemoteProtocolError(f"unknown message kind {str(kind)[:40]!r}")
    check_fields(cls, fields)
    return cls(*fields)
