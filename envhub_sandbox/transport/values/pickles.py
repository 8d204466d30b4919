"""The caller's own values on their way in, pickled. Nothing is ever unpickled in this process."""

from __future__ import annotations

import io
import sys
from types import FunctionType
from typing import Any

import cloudpickle  # type: ignore[import-untyped]
import numpy as np

from envhub_worker.protocol.codec.arrays import INLINE_BYTES


def pickled(value: object) -> bytes:
    """What the jail makes the same value of; a class of ``__main__`` travels along."""
    buffer = io.BytesIO()
    _Pickler(buffer).dump(value)
    return buffer.getvalue()


def lasting(value: object) -> bytes:
    """The same, if it says all there is to the value: no code of the caller's own is named in it.

    Raises:
        TypeError: It is; who knows what that code is by the next time.
    """
    buffer = io.BytesIO()
    _LastingPickler(buffer).dump(value)
    return buffer.getvalue()


def framed(value: object) -> bytes | memoryview:
    """The same, in a frame of its own where that is worth it."""
    data = pickled(value)
    return data if len(data) <= INLINE_BYTES else memoryview(data)


class _Pickler(cloudpickle.Pickler):  # type: ignore[misc]
    def reducer_override(self, value: Any) -> Any:
        """A view of memory, which pickle knows nothing of, is one of a copy."""
        if type(value) is memoryview:
            plain = value.readonly and value.format == "B" and value.ndim == 1
            return memoryview, (bytes(value) if plain else np.array(value),)
        return super().reducer_override(value)


class _LastingPickler(_Pickler):
    def reducer_override(self, value: Any) -> Any:
        """Judges classes and functions; their names are all that a pickle has of them."""
        if isinstance(value, (type, FunctionType)):
            package = str(value.__module__).partition(".")[0]
            if package not in _INSTALLED and package not in sys.stdlib_module_names:
                raise TypeError(f"{value.__qualname__} may be another one by the next time")
        return super().reducer_override(value)


_INSTALLED = frozenset({"gymnasium", "numpy"})
"""Packages that come with the interpreter, as far as we know."""
