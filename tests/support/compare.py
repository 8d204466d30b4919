"""Bit-for-bit comparison of what two environments returned."""

import enum
import math
import struct
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np


def rolled(env: Any) -> list[Any]:
    found = [env.reset(seed=3)]
    env.action_space.seed(3)
    return found + [env.step(env.action_space.sample()) for _ in range(20)]


def assert_same(expected: object, actual: object, what: str = "value") -> None:
    """Assert that two values are the same: types, dtypes, shapes, bits, order of keys.
    A value that cannot cross as itself (an enum member, an object of the repository) is the same
    when its inert stand-in says so."""
    found = next(differences(expected, actual, what), None)
    assert found is None, found


def assert_identical(expected: Any, actual: Any, what: str = "value") -> None:
    """Assert that a value arrived as it is: classes of the tests' own by name, order in memory."""
    # a class that travelled by value is another class of the same name
    assert type(actual).__qualname__ == type(expected).__qualname__, what
    if isinstance(expected, np.ndarray):
        assert actual.flags.fnc == expected.flags.fnc, f"{what}: another order in memory"
        assert (actual.dtype, actual.shape) == (expected.dtype, expected.shape), what
        if not expected.dtype.hasobject:
            assert actual.tobytes() == expected.tobytes(), what
    # the pickle says everything, sets and the memory of views apart
    if isinstance(expected, (set, frozenset)) or expected is ...:
        assert actual == expected, what
    elif isinstance(expected, memoryview):
        assert (actual.format, actual.tolist()) == (expected.format, expected.tolist()), what
        assert actual.readonly == expected.readonly, what
    else:
        assert _unfolded(actual) == _unfolded(expected), what


def _unfolded(value: Any) -> Any:
    """All that a value is made of, as something that can be compared and does not share."""
    name = type(value).__qualname__
    if isinstance(value, dict):
        found: Any = [(_unfolded(key), _unfolded(item)) for key, item in value.items()]
    elif isinstance(value, (list, tuple)):
        found = [_unfolded(item) for item in value]
    elif isinstance(value, np.ndarray):
        found = value.shape, value.dtype.str, [_unfolded(item) for item in value.ravel().tolist()]
    elif isinstance(value, np.random.Generator):
        found = _unfolded(value.bit_generator.state)
    elif isinstance(value, np.random.RandomState):
        found = _unfolded(value.get_state())
    elif not isinstance(value, (type, np.generic)) and getattr(value, "__dict__", None):
        found = _unfolded(vars(value))
    elif isinstance(value, int):
        found = hex(value)
    else:
        found = repr(value)
    extra = getattr(value, "default_factory", None) or getattr(value, "maxlen", None)
    return name, found, repr(extra)


def differences(expected: Any, actual: Any, path: str = "value") -> Iterator[str]:
    if type(actual).__name__ in ("RemoteEnum", "RemoteObject") and actual != expected:
        yield from _stand_in(expected, actual, path)
    elif type(expected) is not type(actual):
        yield f"{path}: expected {_brief(expected)}, got {_brief(actual)}"
    elif isinstance(expected, dict):
        yield from _mappings(expected, actual, path)
    elif isinstance(expected, (list, tuple)):
        yield from _sequences(expected, actual, path)
    elif isinstance(expected, np.ndarray):
        yield from _arrays(expected, actual, path)
    elif isinstance(expected, np.random.Generator):
        yield from differences(_state(expected), _state(actual), f"{path}.state")
    elif not _equal(expected, actual):
        yield f"{path}: expected {_brief(expected)}, got {_brief(actual)}"


def assert_same_space(expected: gym.Space[Any], actual: gym.Space[Any], what: str) -> None:
    """Assert that two spaces are equal, down to dtypes, order of keys and what they sample."""
    assert type(actual) is type(expected), f"{what}: {actual} is no {type(expected).__name__}"
    assert actual == expected, f"{what}: expected {expected}, got {actual}"
    assert repr(actual) == repr(expected), what
    assert actual.shape == expected.shape, what
    assert actual.dtype == expected.dtype, what
    expected.seed(123)
    wanted = expected.sample()
    actual.seed(123)
    assert_same(wanted, actual.sample(), f"sample of {what}")


def _mappings(expected: dict[Any, Any], actual: dict[Any, Any], path: str) -> Iterator[str]:
    if len(expected) != len(actual) or any(
        next(differences(*keys), None) for keys in zip(expected, actual, strict=True)
    ):
        yield f"{path}: expected keys {list(expected)}, got {list(actual)}"
        return
    for key, value, found in zip(expected, expected.values(), actual.values(), strict=True):
        yield from differences(value, found, f"{path}[{key!r}]")


def _sequences(expected: Any, actual: Any, path: str) -> Iterator[str]:
    if len(expected) != len(actual):
        yield f"{path}: expected {len(expected)} items, got {len(actual)}"
        return
    for index, pair in enumerate(zip(expected, actual, strict=True)):
        yield from differences(*pair, f"{path}[{index}]")


def _arrays(expected: Any, actual: Any, path: str) -> Iterator[str]:
    if (expected.dtype, expected.shape) != (actual.dtype, actual.shape):
        yield f"{path}: expected {_brief(expected)}, got {_brief(actual)}"
    elif expected.dtype.hasobject:
        for index in np.ndindex(expected.shape):
            yield from differences(expected[index], actual[index], f"{path}{list(index)}")
    elif expected.tobytes() != actual.tobytes():
        yield f"{path}: expected {expected!r}, got {actual!r}"


def _stand_in(expected: Any, actual: Any, path: str) -> Iterator[str]:
    # The module's name depends on who imported it, the class's does not.
    if not actual.type_name.endswith(type(expected).__qualname__):
        yield f"{path}: expected a {type(expected).__qualname__}, got {actual!r}"
    text = expected.name if isinstance(expected, enum.Enum) else repr(expected)
    if actual.text != text:
        yield f"{path}: expected {text!r}, got {actual!r}"


def _equal(expected: Any, actual: Any) -> bool:
    if isinstance(expected, float) and not isinstance(expected, np.generic):
        return struct.pack("d", expected) == struct.pack("d", actual) or (
            math.isnan(expected) and math.isnan(actual)
        )
    if isinstance(expected, np.generic):
        return bool(expected.dtype == actual.dtype and expected.tobytes() == actual.tobytes())
    if hasattr(expected, "numpy"):  # a torch tensor
        return expected.dtype == actual.dtype and _equal_arrays(expected.numpy(), actual.numpy())
    return bool(expected == actual)


def _equal_arrays(expected: Any, actual: Any) -> bool:
    return next(_arrays(expected, actual, ""), None) is None


def _state(generator: np.random.Generator) -> dict[str, Any]:
    return dict(generator.bit_generator.state)


def _brief(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}"
    return f"{type(value).__name__} {value!r:.120}"
