"""What a message is: a record with a kind, and fields of fixed names and types."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.records import About, FrozenRecord

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform
else:

    def dataclass_transform(**_: object) -> Callable[[type], type]:
        """Tells type checkers of a constructor; here it has nothing to do."""
        return lambda cls: cls


VERSION = 1
"""The version of the protocol. Both sides must speak the same one (``Hello``)."""
FIRST_RUNNER_KIND = 64
"""Kinds from here on are between client and runner; a runner may send no other."""


# a field's annotation, and the types that a decoded value of it may have
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

    ``FIELDS`` are what a class annotates, in the order in which they travel. ``HANDED`` are those
    that are the caller's own: they arrive exactly as they are, pickled if need be. ``ASKS`` is what
    the caller calls it, for errors; with the name of what is called, if the message has one.
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
    """Whether decoded values are fields of this message. Trust: input from the other side.
    Raises ``RemoteProtocolError``: they are too many, too few, or of another type.
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
