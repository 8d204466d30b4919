"""What a message is: a kind, and fields of fixed names and types that nobody changes any more.

Messages look like frozen dataclasses and are made by hand, because each of some fifty dataclasses
would be compiled anew in every process that imports them, which was an eighth of a server's start.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn, TypeVar

from envhub_worker.protocol.errors import RemoteProtocolError

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
class Message:
    """Base of all messages; ``kind`` is its number on the wire and never changes.

    ``FIELDS`` are what a class annotates, in the order in which they travel. ``HANDED`` are those
    that are the caller's own: they arrive exactly as they are, pickled if need be. ``ASKS`` is what
    the caller calls it, for errors; with the name of what is called, if the message has one.
    """

    kind: ClassVar[int]
    HANDED: ClassVar[tuple[str, ...]] = ()
    ASKS: ClassVar[str] = ""
    FIELDS: ClassVar[tuple[str, ...]] = ()
    _checks: ClassVar[tuple[tuple[str, frozenset[type] | None], ...]] = ()

    def __init_subclass__(cls, *, kind: int, asks: str = "", handed: tuple[str, ...] = ()) -> None:
        cls.kind = kind
        cls.ASKS, cls.HANDED = asks, handed
        KINDS[kind] = cls
        own = cls.__annotations__
        cls.FIELDS += tuple(own)
        cls._checks += tuple((name, _ACCEPTED[text]) for name, text in own.items())

    def __init__(self, *values: Any, **named: Any) -> None:
        names = self.FIELDS
        if named or len(values) != len(names):
            values = _completed(type(self), values, named)
        self.__dict__.update(zip(names, values))  # noqa: B905 - as many: it was just seen

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError(f"{type(self).__name__}.{name}: a message stays what was checked")

    def __delattr__(self, name: str) -> NoReturn:
        raise AttributeError(f"{type(self).__name__}.{name}: a message stays what was checked")

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self.__dict__ == other.__dict__

    def __hash__(self) -> int:
        return hash((type(self), *self.__dict__.values()))

    def __repr__(self) -> str:
        fields = ", ".join(f"{name}={value!r}" for name, value in self.__dict__.items())
        return f"{type(self).__name__}({fields})"


M = TypeVar("M", bound=Message)


def replace(message: M, **changes: Any) -> M:
    """The same message with some fields changed."""
    return type(message)(**{**message.__dict__, **changes})


def values_of(message: Message) -> list[Any]:
    """The fields, in the order in which they travel."""
    return [*message.__dict__.values()]


def check_fields(cls: type[Message], values: list[object]) -> None:
    """Whether decoded values are fields of this message. Trust: input from the other side.

    Raises:
        RemoteProtocolError: They are too many, too few, or of another type.
    """
    checks = cls._checks
    if len(values) != len(checks):
        raise RemoteProtocolError(
            f"{cls.__name__} has {len(checks)} fields, the peer sent {len(values)}"
        )
    for (name, accepted), value in zip(checks, values, strict=True):
        if accepted is not None and type(value) not in accepted:
            raise RemoteProtocolError(
                f"{cls.__name__}.{name} cannot be of type {type(value).__name__}"
            )


def _completed(
    cls: type[Message], values: tuple[Any, ...], named: dict[str, Any]
) -> tuple[Any, ...]:
    """All fields in order: those given in order, those given by name, and defaults."""
    names = cls.FIELDS
    if len(values) > len(names) or not set(named) <= set(names[len(values) :]):
        raise TypeError(f"{cls.__name__} takes {names}, not {len(values)} and {sorted(named)}")
    rest = names[len(values) :]
    missing = [name for name in rest if name not in named and not hasattr(cls, name)]
    if missing:
        raise TypeError(f"{cls.__name__} needs {missing}")
    return (*values, *(named[name] if name in named else getattr(cls, name) for name in rest))
