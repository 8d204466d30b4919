"""A caller's config object, made again of the plain values that have crossed.

Each object comes with the names of its class and of the classes that this inherits from. The class
itself is used where it can be imported here; else a dataclass of the same name, which inherits
from the nearest of them that can. Followed: ``dataclasses.make_dataclass``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from dataclasses import MISSING, field, fields, is_dataclass, make_dataclass
from typing import Any

from envhub_worker.protocol.messages import CONFIG_CLASS

Importer = Callable[[str, str], "type[Any] | None"]
"""The class of a module's name and its own, if there is one here."""


class ConfigMapping(dict[str, Any]):
    """A mapping that was no dict: ``cfg.camera["width"]`` and ``cfg.camera.width`` both work."""

    def __init__(self, values: Any) -> None:
        super().__init__(values)
        self.__dict__ = self


def config_of(value: object, imported: Importer) -> Any:
    """The object, or whatever else it is, that crossed as this plain value."""
    if isinstance(value, (list, tuple)):
        return type(value)(config_of(item, imported) for item in value)
    if not isinstance(value, dict):
        return value
    made = {key: config_of(item, imported) for key, item in value.items() if key != CONFIG_CLASS}
    described: Any = value.get(CONFIG_CLASS)
    if described is None:
        return made
    names, field_names, computed = described
    if not names:
        return ConfigMapping(made)
    if field_names is None:  # an enum's member, or a path
        cls = imported(*names[0])
        return made["value"] if cls is None else cls(made["value"])
    return _instance(names, field_names, made, config_of(computed, imported), imported)


def _instance(
    names: Any, field_names: Any, values: dict[str, Any], computed: Any, imported: Importer
) -> Any:
    cls = imported(*names[0])
    if cls is not None:
        with contextlib.suppress(Exception):  # it cannot be made without its arguments
            return _filled(cls, values)
    found = (imported(*one) for one in names[1:])
    for base in (next(filter(None, found), None), None):
        with contextlib.suppress(Exception):  # of a kind that no dataclass can inherit from
            return _filled(_stand_in(names[0], base, field_names, computed), values)
    raise TypeError(f"cfg: no {names[0][1]} can be made of {', '.join(values)}")


def _filled(cls: type[Any], values: dict[str, Any]) -> Any:
    """An instance with these attributes, as unpickling makes one: no code of its class decides."""
    made: Any = cls.__new__(cls)  # type: ignore[call-overload]
    for item in fields(cls) if is_dataclass(cls) else ():
        if item.name not in values and not hasattr(made, item.name):
            absent = None if item.default_factory is MISSING else item.default_factory()
            object.__setattr__(made, item.name, absent)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


def _stand_in(
    name: tuple[str, str], base: type[Any] | None, field_names: Iterable[str], computed: Any
) -> type[Any]:
    parameters: Any = getattr(base, "__dataclass_params__", None)
    made = make_dataclass(
        name[1].rpartition(".")[2],
        [(one, Any, field(default=None)) for one in field_names],
        bases=() if base is None else (base,),
        namespace={"__module__": name[0], **computed},
        kw_only=True,
        frozen=bool(parameters and parameters.frozen),
    )
    made.__module__ = name[0]
    made.__abstractmethods__ = frozenset()  # type: ignore[attr-defined]  # its methods stayed there
    return made
