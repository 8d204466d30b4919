"""What a manifest holds for people and wrappers: metadata, and facts of a spec.

Trust: input from the worker. Keys on which Gymnasium acts are typed, and of a spec only the facts
are taken: the rest of its fields are instructions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.manifest.names import optional_name, string_keys

MAX_METADATA = 4096
"""Values in an environment's metadata, those in lists, mappings and arrays included."""
MAX_FPS = 1_000_000.0
"""Frames in a second that metadata may ask a video for."""
_NUMBERS = (int, float, np.integer, np.floating)


def read_metadata_facts(value: object) -> dict[str, Any]:
    """Free data for people, except for the keys that Gymnasium acts on: those are typed."""
    metadata = string_keys(value, "metadata")
    _count(metadata, MAX_METADATA)
    return {
        key: item
        for key, item in metadata.items()
        if key not in _METADATA_OF_GYMNASIUM or _METADATA_OF_GYMNASIUM[key](item)
    }


def _count(value: object, left: int) -> int:
    """How many values may follow. It is no deeper than messages are."""
    left -= 1
    if isinstance(value, np.ndarray):
        left -= value.size
        value = value.tolist() if value.dtype.hasobject and left >= 0 else ()
    inner: Iterable[object] = ()
    if isinstance(value, (dict, list, tuple, set, frozenset)):
        inner = value.values() if isinstance(value, dict) else value
    for item in inner:
        left = _count(item, left)
    if left < 0:
        raise RemoteProtocolError(f"metadata holds more than {MAX_METADATA} values")
    return left


def _is_rate(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, _NUMBERS):
        return False
    return bool(0 < value <= MAX_FPS)


def _are_modes(value: object) -> bool:
    return isinstance(value, (list, tuple)) and all(type(mode) is str for mode in value)


_METADATA_OF_GYMNASIUM: dict[str, Callable[[object], bool]] = {
    "render_fps": _is_rate,
    "render_modes": _are_modes,
    "autoreset_mode": lambda value: False,  # a field of its own says it
}


def read_spec_facts(value: object) -> dict[str, Any] | None:
    """The facts of an ``EnvSpec``. Whatever else a worker says there is left out.

    The rest of its fields are instructions: which code makes the environment, with which
    arguments, in which wrappers.
    """
    if value is None:
        return None
    given = string_keys(value, "spec")
    return {name: read(given[name], name) for name, read in _FACTS.items() if name in given}


def _optional_whole(value: object, what: str) -> int | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise RemoteProtocolError(f"{what} is not a whole number")
    if not -(1 << 63) <= value < 1 << 63:
        raise RemoteProtocolError(f"{what} is out of range")
    return int(value)


def _optional_number(value: object, what: str) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, _NUMBERS):
        raise RemoteProtocolError(f"{what} is not a number")
    if isinstance(value, (float, np.floating)):
        return float(value)
    return _optional_whole(value, what)


def _optional_flag(value: object, what: str) -> bool | None:
    if value is not None and not isinstance(value, (bool, np.bool_)):
        raise RemoteProtocolError(f"{what} is neither true nor false")
    return None if value is None else bool(value)


_FACTS: dict[str, Callable[[object, str], object]] = {
    "id": optional_name,
    "max_episode_steps": _optional_whole,
    "reward_threshold": _optional_number,
    "nondeterministic": _optional_flag,
}
