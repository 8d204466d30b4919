"""``@dataclass(frozen=True)`` without the compiler.

The standard library writes five or six methods for each such class as text, and compiles them in
every process that imports it: some 0.3 ms a class, and a server and its zygote import a hundred
before anything runs. Here all classes share one of each method. The fields are the standard
library's own, so ``asdict``, ``replace`` and ``fields`` work, and type checkers see its decorator.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, NoReturn

if TYPE_CHECKING:
    import inspect
    from dataclasses import dataclass as dataclass
else:

    def dataclass(
        *, frozen: bool, kw_only: bool = False, repr: bool = True
    ) -> Callable[[type], type]:
        """Like ``dataclasses.dataclass(frozen=True)``; see the module."""
        assert frozen
        return partial(_recorded, kw_only=kw_only, shown=repr)


class About(NamedTuple):
    """A class's fields.

    Attributes:
        names: All of them, in order.
        positional: Those that may be passed by position.
        defaults: For each optional field, a function that makes its default.
        compared: Those that ``==`` and ``hash`` use.
        shown: Those in its ``repr``.
    """

    names: tuple[str, ...]
    positional: tuple[str, ...]
    defaults: dict[str, Callable[[], Any]]
    compared: tuple[str, ...]
    shown: tuple[str, ...]


class _Signature:
    """The signature that ``inspect`` and notebooks show, made on first access."""

    def __get__(self, record: object, cls: Any) -> inspect.Signature:
        from inspect import Parameter, Signature

        defaults = cls.__record__.defaults
        return Signature(
            [
                Parameter(
                    field.name,
                    Parameter.KEYWORD_ONLY if field.kw_only else Parameter.POSITIONAL_OR_KEYWORD,
                    default=defaults[field.name]() if field.name in defaults else Parameter.empty,
                    annotation=field.type,
                )
                for field in dataclasses.fields(cls)
            ]
        )


class FrozenRecord:
    """The methods that all records and messages share."""

    __record__: ClassVar[About]
    __order__: ClassVar[tuple[str, ...] | None]
    """All fields, if all may be passed by position; else None."""

    def __init__(self, *values: Any, **named: Any) -> None:
        order = self.__order__
        if named or order is None or len(values) != len(order):
            self.__dict__.update(_completed(self, values, named))
        else:
            self.__dict__.update(zip(order, values))  # noqa: B905 - as many: it was just seen

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise dataclasses.FrozenInstanceError(f"{type(self).__name__}.{name} cannot be changed")

    def __delattr__(self, name: str) -> NoReturn:
        raise dataclasses.FrozenInstanceError(f"{type(self).__name__}.{name} cannot be deleted")

    def __eq__(self, other: object) -> Any:
        return _compared(self) == _compared(other) if type(self) is type(other) else NotImplemented

    def __hash__(self) -> int:
        return hash(_compared(self))

    def __repr__(self) -> str:
        shown = ", ".join(f"{name}={getattr(self, name)!r}" for name in self.__record__.shown)
        return f"{type(self).__qualname__}({shown})"


def _recorded(cls: Any, *, kw_only: bool, shown: bool) -> Any:
    dataclasses.dataclass(init=False, repr=False, eq=False, match_args=False, kw_only=kw_only)(cls)
    fields = dataclasses.fields(cls)
    above = getattr(cls, "__record__", None)
    cls.__record__ = About(
        tuple(field.name for field in fields),
        tuple(field.name for field in fields if not field.kw_only),
        {field.name: make for field in fields if (make := _default(field)) is not None},
        tuple(field.name for field in fields if field.compare),
        tuple(field.name for field in fields if field.repr) if shown or not above else above.shown,
    )
    names, positional, *_ = cls.__record__
    cls.__order__ = names if names == positional else None
    own = set(vars(cls))
    for name in ("__init__", "__setattr__", "__delattr__", "__eq__", "__hash__", "__repr__"):
        if name not in own and (shown or name != "__repr__"):
            setattr(cls, name, vars(FrozenRecord)[name])
    if "__init__" not in own and hasattr(cls, "__post_init__"):
        cls.__init__ = _init_and_check
    cls.__signature__ = _Signature()
    return cls


def _init_and_check(record: Any, *values: Any, **named: Any) -> None:
    FrozenRecord.__init__(record, *values, **named)
    record.__post_init__()


def _default(field: dataclasses.Field[Any]) -> Callable[[], Any] | None:
    if field.default is not dataclasses.MISSING:
        value = field.default
        return lambda: value
    factory: Any = field.default_factory
    return None if factory is dataclasses.MISSING else factory


def _completed(record: Any, values: tuple[Any, ...], named: dict[str, Any]) -> dict[str, Any]:
    """Returns all fields in order, from positional arguments, keyword arguments and defaults."""
    about: About = record.__record__
    names, defaults = about.names, about.defaults
    given_values = dict(zip(about.positional, values)) | named  # noqa: B905 - seen below
    complete = {
        name: given_values[name] if name in given_values else defaults[name]()
        for name in names
        if name in given_values or name in defaults
    }
    if len(given_values) < len(values) + len(named) or not given_values.keys() <= complete.keys():
        raise TypeError(
            f"{type(record).__name__} takes {', '.join(names)}; it was given "
            f"{len(values)} in order, and {', '.join(named) or 'none'} by name"
        )
    if len(complete) < len(names):
        missing = ", ".join(name for name in names if name not in complete)
        raise TypeError(f"{type(record).__name__} needs {missing}")
    return complete


def _compared(record: Any) -> tuple[Any, ...]:
    return tuple([getattr(record, name) for name in record.__record__.compared])
