"""Stand-ins for values that cannot cross, and text that is safe to print."""

from __future__ import annotations

import re
from dataclasses import field
from enum import Enum
from typing import NoReturn

from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.text import printable

_ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")
MAX_NAME_CHARS = 256
MAX_REPR_CHARS = 1024


@dataclass(frozen=True)
class RemoteObject:
    """A value of the peer that has no form on the wire: its type and its ``repr``, as text.

    Attributes:
        type_name: Qualified class name, at most 256 characters.
        text: Bounded ``repr``; printable, on one line.
    """

    type_name: str
    text: str

    def __repr__(self) -> str:
        return f"<remote {self.type_name}: {self.text}>"

    def __getattr__(self, name: str) -> NoReturn:
        # While copy or pickle rebuilds an instance, its fields are not set yet.
        kind = self.__dict__.get("type_name", "object")
        raise AttributeError(
            f"a {type(self).__name__} has no attribute {name!r}: it is the description of a {kind} "
            "that stays in the worker. Use get_attr or call for a part of it that is plain data"
        )


@dataclass(frozen=True, repr=False)
class RemoteEnum(RemoteObject):
    """A member of an enumeration that lives in the peer; ``text`` is the member's name.

    Attributes:
        value: The member's value, decoded. Takes no part in comparison or hashing.
    """

    value: object = field(default=None, compare=False)


def one_line(text: str, max_chars: int = MAX_REPR_CHARS) -> str:
    """Returns text that a terminal or a log prints on one line and never obeys, bounded."""
    line = printable(text[:max_chars], max_chars).replace("\n", "\\n").replace("\t", "\\t")
    # An escape is longer than the character that it replaces, so cut again afterwards.
    return line if len(text) <= max_chars >= len(line) else line[:max_chars] + "..."


def inert_copy(value: object) -> RemoteObject:
    """Turns any object into its inert description. A ``__repr__`` that raises is reported."""
    try:
        # Without memory addresses, equal objects have equal texts.
        text = _ADDRESS.sub("", repr(value))
    except Exception as error:
        text = f"<repr failed with {type(error).__name__}>"
    return RemoteObject(type_name(type(value)), one_line(text))


def inert_enum(member: Enum) -> tuple[str, str]:
    """Returns the qualified class name and the name of a member, both printable."""
    name = member.name if isinstance(member.name, str) else str(member)
    return type_name(type(member)), one_line(name, MAX_NAME_CHARS)


def type_name(cls: type) -> str:
    """Returns ``module.QualName`` of a class, without the module for builtins."""
    module, name = str(cls.__module__), str(cls.__qualname__)
    return one_line(name if module == "builtins" else f"{module}.{name}", MAX_NAME_CHARS)
