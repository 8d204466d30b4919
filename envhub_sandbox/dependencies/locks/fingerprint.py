"""What environments look like from outside, in a form that can be compared later and elsewhere."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from envhub_worker.protocol.spaces.spaces import encode_space
from envhub_worker.protocol.text import printable

_SHOWN = 200


@dataclass(frozen=True)
class TaskFingerprint:
    """One environment.

    Attributes:
        suite: Key of the outer mapping.
        task: Key of the inner one.
        mode: Its autoreset mode; empty if it states none.
        observations: The space of one sub-environment's observations, to be read.
        spaces: SHA-256 of both, with every bound.
    """

    suite: str
    task: int | str
    mode: str
    observations: str
    actions: str
    spaces: str

    @property
    def name(self) -> str:
        """For texts."""
        return f"{self.suite}/{self.task}"


def fingerprint_of_task(
    suite: str,
    task: int | str,
    mode: str | None,
    observations: gym.Space[Any],
    actions: gym.Space[Any],
) -> TaskFingerprint:
    """What is to be remembered of an environment. Trust: input from the worker, already checked."""
    spaces = fingerprint_of_spaces(observations, actions)
    return TaskFingerprint(suite, task, mode or "", _shown(observations), _shown(actions), spaces)


def fingerprint_of_spaces(*spaces: gym.Space[Any]) -> str:
    """A hash of spaces: of their kinds, shapes, dtypes and bounds, and of no generator's state."""
    digest = hashlib.sha256()
    for space in spaces:
        _add(digest, encode_space(space))
    return f"sha256:{digest.hexdigest()}"


def _shown(space: gym.Space[Any]) -> str:
    return printable(" ".join(str(space).split()), _SHOWN).replace("\n", " ")


def _add(digest: Any, value: object) -> None:
    """Each value with its kind and length before it, so that no two look alike."""
    if isinstance(value, dict):
        if value.get("kind") == "opaque":  # its text may hold an address
            value = {name: item for name, item in value.items() if name != "text"}
        digest.update(f"dict {len(value)};".encode())
        for key, item in value.items():  # the order of a Dict space is part of it
            _add(digest, key)
            _add(digest, item)
    elif isinstance(value, (list, tuple)):
        digest.update(f"list {len(value)};".encode())
        for item in value:
            _add(digest, item)
    elif isinstance(value, (np.ndarray, np.generic)):
        array = np.ascontiguousarray(value)
        plain = array.astype(array.dtype.newbyteorder("<"), copy=False)
        digest.update(f"array {plain.dtype.str} {np.shape(value)};".encode() + plain.tobytes())
    else:
        data = repr(value).encode("utf-8", "backslashreplace")
        digest.update(f"{type(value).__name__} {len(data)};".encode() + data)
