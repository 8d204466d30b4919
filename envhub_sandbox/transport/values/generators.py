"""Random generators in a state that a worker sent.

numpy checks next to nothing of a state: an index behind a key makes the next draw a crash, one
before a buffer makes the process's own memory the numbers, and a generator that stands still
makes ``integers`` loop for ever. So every field is held against what that generator can hold.

Trust: every state is input from the worker.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Union

import numpy as np

from envhub_sandbox.errors import RemoteProtocolError

_Check = Callable[[Any], bool]
_Form = Mapping[str, Union[_Check, "_Form"]]
_KEY_WORDS = 624
"""Of the Mersenne twister."""


def generator(state: object) -> np.random.Generator:
    """A generator in a given state. Trust: the state is input from the worker.

    Raises:
        RemoteProtocolError: It is no state that a generator can have.
    """
    name = state.get("bit_generator") if type(state) is dict else None
    form = _FORMS.get(name) if type(name) is str else None
    if form is None or name is None:
        raise RemoteProtocolError("the worker sent the state of an unknown random generator")
    wrong = _misfit(form, state, name)
    if wrong is not None:
        raise RemoteProtocolError(f"the worker sent a broken generator state: {wrong}")
    bits = getattr(np.random, name)()
    try:
        bits.state = state
    except (TypeError, ValueError, OverflowError) as error:  # newer releases check more themselves
        raise RemoteProtocolError(f"numpy refuses the worker's generator state: {error}") from error
    return np.random.Generator(bits)


def seeds(value: object) -> Any:
    """A seed, or one each. Trust: input from the worker.

    Raises:
        RemoteProtocolError: It is neither a number nor None.
    """
    for one in value if type(value) is tuple else (value,):
        if one is not None and (isinstance(one, bool) or not isinstance(one, (int, np.integer))):
            raise RemoteProtocolError(f"the worker sent a {type(one).__name__} for a seed")
    return value


def _misfit(form: _Form, value: Any, where: str) -> str | None:
    """Which field has no such value; fields are exactly those of the form."""
    if type(value) is not dict or value.keys() != form.keys():
        return f"{where} has the fields {', '.join(form)}"
    for name, check in form.items():
        if isinstance(check, Mapping):
            wrong = _misfit(check, value[name], name)
            if wrong is not None:
                return wrong
        elif not check(value[name]):
            return f"{name} has a value that it never has"
    return None


def _below(limit: int) -> _Check:
    return lambda value: type(value) is int and 0 <= value < limit


def _is_position(value: Any) -> bool:
    return type(value) is int and 1 <= value <= 4  # of the next draw: 4 fills the buffer first


def _words(count: int) -> _Check:
    return lambda value: (
        type(value) is np.ndarray and value.dtype == np.uint64 and value.shape == (count,)
    )


def _is_odd(value: Any) -> bool:
    """An increment without which the generator's period is shorter, down to standing still."""
    return _below(1 << 128)(value) and value % 2 == 1


def _is_key(value: Any) -> bool:
    if type(value) is not np.ndarray or value.dtype != np.uint32 or value.shape != (_KEY_WORDS,):
        return False
    return bool(value[0] >> 31 or value[1:].any())  # else it yields zeros for ever


def _is_name(value: Any) -> bool:
    return True  # its form was found by it


_HALF: _Form = {"has_uint32": _below(2), "uinteger": _below(1 << 32)}
_NAMED: _Form = {"bit_generator": _is_name}
_PCG: _Form = {**_NAMED, "state": {"state": _below(1 << 128), "inc": _is_odd}, **_HALF}
_FORMS: dict[str, _Form] = {
    "PCG64": _PCG,
    "PCG64DXSM": _PCG,
    "MT19937": {**_NAMED, "state": {"key": _is_key, "pos": _below(_KEY_WORDS + 1)}},
    "Philox": {
        **_NAMED,
        "state": {"counter": _words(4), "key": _words(2)},
        "buffer": _words(4),
        "buffer_pos": _is_position,
        **_HALF,
    },
    "SFC64": {**_NAMED, "state": {"state": _words(4)}, **_HALF},
}
