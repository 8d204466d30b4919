"""A caller's config object as plain data: what of it may cross to the repository's ``make_env``."""

from __future__ import annotations

import contextlib
import inspect
import os
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np

_PLAIN = (type(None), bool, int, float, complex, str, bytes, np.ndarray, np.generic)
_MAX_DEPTH = 16


def reference_of(cfg: Any) -> tuple[str, Any]:
    """The reference in ``cfg``, and the config object if it is one."""
    if isinstance(cfg, str):
        return cfg, None
    if isinstance(cfg, os.PathLike):
        return os.path.abspath(cfg), None
    hub_path = getattr(cfg, "hub_path", None)
    if isinstance(hub_path, os.PathLike):
        return os.path.abspath(hub_path), cfg
    if isinstance(hub_path, str):
        return hub_path, cfg
    kind = f"{type(cfg).__module__}.{type(cfg).__qualname__}"
    if hasattr(cfg, "hub_path"):
        raise TypeError(f"cfg is a {kind} whose hub_path is {hub_path!r}; it takes a hub reference")
    raise TypeError(f"cfg is a hub reference, a folder, or an object with a hub_path, not {kind}")


def plain_config(config: Any) -> dict[str, object]:
    """The ``vars()`` of a config object with nested ones, and its own public properties.

    Dataclasses and other plain objects become mappings, enums their values, paths text. What has
    no plain form (a function, an open file) is left out: nothing of the caller is pickled.
    """
    return _attributes(config, 0)


def _attributes(config: Any, depth: int) -> dict[str, object]:
    names = list(getattr(config, "__dict__", {}))
    if is_dataclass(config):
        names = list(dict.fromkeys([*(item.name for item in fields(config)), *names]))
    made = {name: _plain(getattr(config, name, None), depth + 1) for name in names}
    if not depth:
        made |= {name: _plain(value, 1) for name, value in _computed(config).items()}
    return {name: value for name, value in made.items() if value is not _LEFT_OUT}


def _computed(config: Any) -> dict[str, Any]:
    """The public properties of a config that can be had: LeRobot's have their ``type`` so."""
    kind = type(config)
    found = {}
    for name in dir(kind):
        if name.startswith("_") or not isinstance(inspect.getattr_static(kind, name), property):
            continue
        with contextlib.suppress(Exception):
            found[name] = getattr(config, name)
    return found


_LEFT_OUT = object()


def _plain(value: Any, depth: int) -> Any:
    if depth > _MAX_DEPTH or callable(value):
        return _LEFT_OUT
    if isinstance(value, Enum):
        return _plain(value.value, depth)
    if isinstance(value, _PLAIN):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        items = {_plain(k, depth + 1): _plain(v, depth + 1) for k, v in value.items()}
        return {k: v for k, v in items.items() if k is not _LEFT_OUT and v is not _LEFT_OUT}
    if isinstance(value, (list, tuple, set, frozenset)):
        made = [item for item in (_plain(v, depth + 1) for v in value) if item is not _LEFT_OUT]
        return tuple(made) if isinstance(value, tuple) else made
    if hasattr(value, "__dict__") or is_dataclass(value):
        return _attributes(value, depth)
    return _LEFT_OUT
