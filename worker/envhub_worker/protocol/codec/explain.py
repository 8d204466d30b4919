"""Finds what in a value cannot be sent, for the error message. Runs only after a failure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import Enum

import numpy as np

from envhub_worker.protocol.codec.encoder import Encoder, Pickler
from envhub_worker.protocol.codec.inert import inert_copy, one_line, type_name
from envhub_worker.protocol.limits import WireLimits

Path = tuple[object, ...]
_ATTEMPTS = 2000
"""Values that are pickled to find the one that cannot be."""


def explain(
    value: object,
    error: Exception,
    limits: WireLimits,
    pickler: Pickler | None,
    names: Sequence[str] = (),
) -> str:
    """Says what cannot be sent, and where in the value it is."""
    found = _Search(limits, pickler).first(value, (), ())
    if found is None:
        return f"The value cannot be sent: {error}"
    path, reason = found
    if path and names:
        path = (names[path[0]], *path[1:])  # type: ignore[call-overload]
    return f"{_path_text(path)} cannot be sent: {reason}."


def unpicklable(name: str, value: object, error: Exception, pickler: Pickler) -> str:
    """Says which part of an argument cannot be pickled, and what to do."""
    text, culprit, error = _culprit(name, value, error, pickler, {id(value)})
    reason = one_line(f"{type(error).__name__}: {error}", 500)
    return (
        f"{one_line(text)} cannot be sent: a {type_name(type(culprit))} cannot be pickled "
        f"({reason}). Pass plain data, or a function that makes the object there."
    )


def _culprit(
    text: str, value: object, error: Exception, pickler: Pickler, seen: set[int]
) -> tuple[str, object, Exception]:
    """The innermost value that fails, how to call it, and how it does."""
    for step, child in _members(value):
        if id(child) in seen or len(seen) > _ATTEMPTS:
            continue
        seen.add(id(child))
        try:
            pickler(child)
        except Exception as inner:
            return _culprit(text + step, child, inner, pickler, seen)
    return text, value, error


def _members(value: object) -> Iterator[tuple[str, object]]:
    """What a value consists of, and how one gets at it."""
    for step, child in _children(value) or ():
        yield f"[{_step_text(step)}]", child
    attributes = getattr(value, "__dict__", None)
    if type(attributes) is dict:
        for name, child in attributes.items():
            yield f".{name}", child


class _Search:
    """Walks a value until it meets the offender, or has met as many values as may be sent."""

    def __init__(self, limits: WireLimits, pickler: Pickler | None) -> None:
        self.limits, self.pickler = limits, pickler
        self._left = limits.items

    def first(self, value: object, path: Path, above: tuple[int, ...]) -> tuple[Path, str] | None:
        """Returns path and reason of the first value that is cyclic, too deep, or refused."""
        children = _children(value)
        if children is None:
            reason = self._refusal(value)
            return None if reason is None else (path, reason)
        if id(value) in above:
            return path, "it contains itself"
        if len(above) == self.limits.depth:
            return path, f"it is nested deeper than {self.limits.depth} containers"
        for step, child in children:
            self._left -= 1
            if self._left < 0:
                return None
            found = self.first(child, (*path, step), (*above, id(value)))
            if found is not None:
                return found
        return None

    def _refusal(self, value: object) -> str | None:
        try:
            Encoder(self.pickler, self.limits).frames(value)
        except Exception as error:
            return str(error).rstrip(".") or type(error).__name__
        return None


def _children(value: object) -> list[tuple[object, object]] | None:
    """Returns steps and elements of a container, None for a leaf."""
    if isinstance(value, dict):
        keys = [(key, key) for key in value if isinstance(key, tuple | frozenset | Enum)]
        return [*keys, *value.items()]
    if isinstance(value, list | tuple | set | frozenset):
        return list(enumerate(value))
    if isinstance(value, np.ndarray) and value.dtype.kind == "O":
        return list(enumerate(value.ravel().tolist()))
    return None


def _path_text(path: tuple[object, ...]) -> str:
    """Writes ``("info", "a", 3)`` as ``info["a"][3]``."""
    if not path:
        return "The value"
    first, *rest = path
    named = isinstance(first, str) and first.isidentifier()
    steps = [str(first)] if named else [f"value[{_step_text(first)}]"]
    return one_line("".join([*steps, *(f"[{_step_text(step)}]" for step in rest)]))


def _step_text(step: object) -> str:
    return inert_copy(step).text
