"""A cache of decoded messages, by their msgpack documents.

Steps, calls and requests to a server recur. When a document comes for the second time, the decoded
message is kept as a *form*. The key is the whole document, so a form gives exactly the message that
the codec would decode. The bytes of arrays lie outside the document: each message reads and checks
its own.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from envhub_worker.protocol.codec.decoder import Decoder, TensorMaker
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.limits import WireLimits

if TYPE_CHECKING:
    from envhub_worker.protocol.codec.arrays import Array
    from envhub_worker.protocol.messages.message import Message

MAX_DOCUMENT_BYTES = 1024
_MAX_FORMS = 256
_CONSTANTS = frozenset({float, int, bool, str, bytes, type(None)})


class Forms:
    """Forms by document; a form is made when its document comes for the second time.

    Until then only a hash is kept: most documents that a server reads come once, with the number of
    a jail or a time in them. If two documents share a hash, the second gets its form one message
    earlier.
    """

    def __init__(self) -> None:
        self._forms: dict[bytes, Incoming] = {}
        self._once: set[int] = set()
        self.get = self._forms.get

    def met(self, document: bytes, make: Callable[[], Incoming]) -> None:
        """Note that a document came that has no form for these limits.

        The codec has already decoded the message. If ``make`` fails for any reason, there is no
        form, and the codec decodes the next message of this document, too.
        """
        hashed = hash(document)
        if hashed not in self._once and document not in self._forms:
            if len(self._once) >= _MAX_FORMS:
                self._once.clear()
            self._once.add(hashed)
            return
        self._once.discard(hashed)
        try:
            form = make()
        except Exception:
            return
        if len(self._forms) >= _MAX_FORMS:
            self._forms.clear()
        self._forms[document] = form


class Incoming:
    """The form of one document: makes messages of it without the codec.

    Args:
        document: The whole document.
        tail, buffers: The bytes of its arrays, from ``split_frames``.
        make: The class of the message.
        limits: The limits that the document was decoded within; the form holds for these only.

    Raises:
        Exception: The document has no form: it holds more than constants, tuples, lists, dicts,
            arrays of numbers and tensors.
    """

    __slots__ = ("_codec", "_constant", "_make", "_template", "limits")

    def __init__(
        self,
        document: bytes,
        tail: Buffer,
        buffers: Sequence[Buffer],
        make: type[Message],
        limits: WireLimits,
    ) -> None:
        self._make, self.limits = make, limits
        decoder = Decoder(tail, buffers, limits, None, _Tensor, borrows=True)
        notes: list[tuple[Array, bytes]] = []
        decoder.notes = notes
        value: Any = decoder.value(document)
        arrays = iter(notes)
        self._template = [_template(field, arrays) for field in value[1:]]
        if next(arrays, None) is not None:
            raise IrregularError
        self._codec: Any = sys.modules["envhub_worker.protocol.codec.arrays"] if notes else None
        self._constant = make(*value[1:]) if all(map(_is_constant, self._template)) else None

    def message(
        self,
        tail: Buffer = b"",
        buffers: Sequence[Buffer] = (),
        tensors: TensorMaker | None = None,
        *,
        borrows: bool = False,
    ) -> Message:
        """Returns a message whose mutable parts are new. Trust: input from the other side.
        ``borrows``: as for ``ArrayReader``.
        """
        if self._constant is not None and not tail and not buffers:
            return self._constant
        codec = self._codec
        if codec is None:
            if tail or buffers:
                raise RemoteProtocolError("The message has array bytes that nothing describes.")
            return self._make(*map(_fresh, self._template))
        reader = codec.ArrayReader(tail, buffers, self.limits, borrows=borrows)

        def read(part: _Array) -> object:
            array = reader.read(*part.described)
            return array if part.tensor is None else codec.tensor(array, part.tensor, tensors)

        fields = [_fresh(part, read) for part in self._template]
        reader.finish()
        return self._make(*fields)


class IrregularError(Exception):
    """The document has no form: the codec decodes each of its messages."""


class _Tensor:
    """Stands for a tensor while a form is made."""

    def __init__(self, array: Array, name: str) -> None:
        self.array, self.name = array, name


class _Array(NamedTuple):
    """Stands for an array, or for a tensor of this dtype, in a template: a form keeps no arrays."""

    described: tuple[Any, ...]
    tensor: str | None


def _template(value: Any, notes: Iterator[tuple[Array, bytes]]) -> Any:
    """Returns the value with an ``_Array`` in place of each array.
    ``notes``: the document's remaining arrays, in order, with their descriptors.
    """
    kind = type(value)
    if kind in _CONSTANTS:
        return value
    if kind is dict and {int, str}.issuperset(map(type, value)):
        return {key: _template(item, notes) for key, item in value.items()}
    if kind is tuple or kind is list:
        return kind([_template(item, notes) for item in value])
    from envhub_worker.protocol.codec.arrays import parse_descriptor

    own, tensor = (value.array, value.name) if kind is _Tensor else (value, None)
    array, descriptor = next(notes, (None, b""))
    if array is None or array is not own:
        raise IrregularError
    return _Array(parse_descriptor(descriptor), tensor)


def _is_constant(part: Any) -> bool:
    return type(part) in _CONSTANTS or (type(part) is tuple and all(map(_is_constant, part)))


def _fresh(part: Any, read: Callable[[_Array], object] | None = None) -> Any:
    """Makes a value of a template. Calls ``read`` for each array in the document's order."""
    kind = type(part)
    if kind in _CONSTANTS:
        return part
    if kind is _Array and read is not None:
        return read(part)
    if kind is dict:
        return {key: _fresh(item, read) for key, item in part.items()}
    return kind([_fresh(item, read) for item in part])
