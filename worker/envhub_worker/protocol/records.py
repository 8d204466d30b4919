"""``@dataclass(frozen=True)`` without the compiler.

The standard library writes five or six methods for each such class as text, and compiles them in
every process that imports it: some 0.4 ms a class, and a server and its zygote import forty each
before anything runs. Here all classes share one of each method. The fields are the standard
library's own, so ``asdict``, ``replace`` and ``fields`` work, and type checkers see its decorator.

Making a record takes about a microsecond longer: what is made in every step stays with the
standard library, and so does what may change.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass
else:

    def dataclass(
        *, frozen: bool, kw_only: bool = False, repr: bool = True
    ) -> Callable[[type], type]:
        """As the standard library's, for frozen classes."""
        assert frozen
        return lambda cls: _completed(cls, kw_only=kw_only, shown=repr)


class _About(NamedTuple):
    """A class's fields.

    Attributes:
        positional: Those that may be given in order.
        names: All of them.
        defaults: What makes those that need not be given.
        compared: Those that equality and hash go by.
        shown: Those of its ``repr``.
    """

    positional: tuple[str, ...]
    names: frozenset[str]
    defaults: dict[str, Callable[[], Any]]
    compared: tuple[str, ...]
    shown: tuple[str, ...]


def _completed(cls: Any, *, kw_only: bool, shown: bool) -> Any:
    dataclasses.dataclass(init=False, repr=False, eq=False, match_args=False, kw_only=kw_only)(cls)
    fields = dataclasses.fields(cls)
    above = getattr(cls, "__record__", None)
    cls.__record__ = _About(
        tuple(field.name for field in fields if not field.kw_only),
        frozenset(field.name for field in fields),
        {field.name: make for field in fields if (make := _default(field)) is not None},
        tuple(field.name for field in fields if field.compare),
        tuple(field.name for field in fields if field.repr) if shown or not above else above.shown,
    )
    own = set(vars(cls))
    cls.__init__, cls.__setattr__, cls.__delattr__ = _init, _refuse_to_set, _refuse_to_delete
    for name, method in (("__eq__", _eq), ("__hash__", _hash), ("__repr__", _repr)):
        if name not in own and (shown or method is not _repr):
            setattr(cls, name, method)
    return cls


def _default(field: dataclasses.Field[Any]) -> Callable[[], Any] | None:
    if field.default is not dataclasses.MISSING:
        value = field.default
        return lambda: value
    factory: Any = field.default_factory
    return None if factory is dataclasses.MISSING else factory


def _init(self: Any, *values: Any, **named: Any) -> None:
    about: _About = self.__record__
    state = dict(zip(about.positional, values))  # noqa: B905 - too many are refused below
    if (
        len(values) > len(about.positional)
        or named.keys() & state.keys()
        or named.keys() - about.names
    ):
        raise TypeError(
            f"{type(self).__name__} takes {', '.join(sorted(about.names))}; it was given "
            f"{len(values)} in order, and {', '.join(named) or 'none'} by name"
        )
    state.update(named)
    if len(state) < len(about.names):
        for name, make in about.defaults.items():
            if name not in state:
                state[name] = make()
        missing = about.names - state.keys()
        if missing:
            raise TypeError(f"{type(self).__name__} needs {', '.join(sorted(missing))}")
    self.__dict__.update(state)


def _refuse_to_set(self: Any, name: str, value: object) -> NoReturn:
    raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")


def _refuse_to_delete(self: Any, name: str) -> NoReturn:
    raise dataclasses.FrozenInstanceError(f"cannot delete field {name!r}")


def _compared(record: Any) -> tuple[Any, ...]:
    return tuple([getattr(record, name) for name in record.__record__.compared])


def _eq(self: Any, other: object) -> Any:
    return _compared(self) == _compared(other) if type(self) is type(other) else NotImplemented


def _hash(self: Any) -> int:
    return hash(_compared(self))


def _repr(self: Any) -> str:
    shown = ", ".join(f"{name}={getattr(self, name)!r}" for name in self.__record__.shown)
    return f"{type(self).__qualname__}({shown})"
