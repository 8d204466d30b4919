"""Values that are not plain data: makes spaces, specs, generators and tensors from a worker's
descriptions, and pickles the caller's own values for the jail.

Trust: every description is input from the worker. The client executes and unpickles nothing of it:
a description has the fields of a fixed form, and each value is checked. numpy checks almost nothing
of a generator's state: an index beyond the key makes the next draw crash, an index before the
buffer returns the process's own memory as numbers, and a generator whose state never changes makes
``integers`` loop for ever. So every field is compared with the values that the generator can have.
"""

from __future__ import annotations

import importlib.util
import io
import sys
from collections.abc import Mapping
from functools import cache, partial
from types import FunctionType
from typing import Any, NoReturn, Union

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec

from envhub_sandbox.errors import DependencyError, RemoteProtocolError
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.arrays import INLINE_BYTES, widened_numpy
from envhub_worker.protocol.codec.inert import RemoteObject, one_line
from envhub_worker.protocol.codec.wire import GENERATOR, SPACE, SPEC
from envhub_worker.protocol.limits import WireLimits
from envhub_worker.protocol.manifest.manifest import read_spec_facts
from envhub_worker.protocol.spaces.reader import (
    ELEMENT_BYTES,
    GENERATOR_BYTES,
    SPACE_BYTES,
    SpaceReader,
)

_Form = Mapping[str, Union[range, tuple[Any, int], "_Form"]]
"""The form of a state: for each field a range of integers, a dtype and length, or a form."""


def generator(state: object) -> np.random.Generator:
    """Make a generator in a given state. Trust: the state is input from the worker.
    Raises ``RemoteProtocolError``: no generator can have this state.
    """
    name = state.get("bit_generator") if type(state) is dict else None
    form = _FORMS.get(name) if type(name) is str else None
    if form is None or type(state) is not dict or type(name) is not str:
        raise RemoteProtocolError("the worker sent the state of an unknown random generator")
    fields = {field: part for field, part in state.items() if field != "bit_generator"}
    if wrong := _misfit(form, fields, name):
        raise RemoteProtocolError(f"the worker sent a broken generator state: {wrong}")
    bits = getattr(np.random, name)()
    try:
        bits.state = state
    except (TypeError, ValueError, OverflowError) as error:  # newer releases check more themselves
        raise RemoteProtocolError(f"numpy refuses the worker's generator state: {error}") from error
    return np.random.Generator(bits)


def seeds(value: object) -> Any:
    """Check a seed, or a tuple of seeds, and return it. Trust: input from the worker.
    Raises ``RemoteProtocolError``: a seed is neither a number nor None.
    """
    for seed in value if type(value) is tuple else (value,):
        if seed is not None and not isinstance(seed, (int, np.integer)):
            raise RemoteProtocolError(f"the worker sent a {type(seed).__name__} for a seed")
    return value


def _misfit(form: _Form, value: Any, path: str) -> str | None:
    """Describe the first field that does not fit the form; None if all fields fit."""
    if type(value) is not dict or value.keys() != form.keys():
        return f"{path} has the fields {', '.join(form)}"
    for name, wanted in form.items():
        if isinstance(wanted, Mapping):
            if wrong := _misfit(wanted, value[name], name):
                return wrong
        elif not _fits(wanted, value[name]):
            return f"{name} has a value that it never has"
    return None


def _fits(wanted: range | tuple[Any, int], value: Any) -> bool:
    if isinstance(wanted, range):
        return type(value) is int and value in wanted
    dtype, count = wanted
    if type(value) is not np.ndarray or value.dtype != dtype or value.shape != (count,):
        return False
    # a key of the Mersenne twister without one of these bits yields zeros for ever
    return count != _KEY_WORDS or bool(value[0] >> 31 or value[1:].any())


_KEY_WORDS = 624
_HALF: _Form = {"has_uint32": range(2), "uinteger": range(1 << 32)}
# an even increment shortens the period of a PCG64, down to standing still
_PCG: _Form = {"state": {"state": range(1 << 128), "inc": range(1, 1 << 128, 2)}, **_HALF}
_FORMS: dict[str, _Form] = {
    "PCG64": _PCG,
    "PCG64DXSM": _PCG,
    "MT19937": {"state": {"key": (np.uint32, _KEY_WORDS), "pos": range(_KEY_WORDS + 1)}},
    "Philox": {
        "state": {"counter": (np.uint64, 4), "key": (np.uint64, 2)},
        "buffer": (np.uint64, 4),
        "buffer_pos": range(1, 5),  # of the next draw: 4 fills the buffer first
        **_HALF,
    },
    "SFC64": {"state": {"state": (np.uint64, 4)}, **_HALF},
}


@cache
def installed_torch() -> Any:
    """The caller's torch, or None. Raises ``DependencyError``: it cannot be imported."""
    # a fixed name of ours: nothing is imported because a worker said so
    if importlib.util.find_spec("torch") is None:
        return None
    try:
        import torch
    except Exception as error:  # not the worker's fault
        raise DependencyError(
            f"torch is installed here, and cannot be imported: {error}"
        ) from error
    return torch


def to_tensor(array: npt.NDArray[Any], dtype: str) -> Any:
    """A tensor that owns its memory, or the array if there is no torch.
    ``array``: the bits, owned and writable; ``uint16`` for ``bfloat16``.
    ``dtype``: torch's name of the dtype, out of the codec's table.
    """
    torch = installed_torch()
    if torch is None:
        return widened_numpy(array) if dtype == "bfloat16" else array
    tensor = torch.from_numpy(array)
    return tensor.view(torch.bfloat16) if dtype == "bfloat16" else tensor


_REFUSAL = f"{__name__}:not_here"
_SPEC_TYPE = "gymnasium.envs.registration.EnvSpec"
_SHOWN = 200


class DescriptionReader:
    """Makes the objects that one message describes, within a budget from the message's bytes."""

    def __init__(self, limits: WireLimits) -> None:
        self._reader = SpaceReader(limits.message_bytes // ELEMENT_BYTES, generator=generator)

    def __call__(self, code: int, value: object) -> object:
        """Make the described object. Trust: input from the worker.
        Raises ``RemoteProtocolError``: the description is malformed, or exceeds the budget.
        """
        if code == SPACE:
            return self._reader.space(value)
        if code == SPEC:
            self._reader.spend(SPACE_BYTES)
            facts = read_spec_facts(value)
            spec = spec_of(facts)
            return RemoteObject(_SPEC_TYPE, one_line(str(facts), _SHOWN)) if spec is None else spec
        if code == GENERATOR:
            self._reader.spend(GENERATOR_BYTES)
            return generator(value)
        raise RemoteProtocolError(f"the worker sent a description of unknown code {code}")


unpacked = partial(m.unpack, tensors=to_tensor, things=DescriptionReader)
"""``m.unpack`` for a runner's message, which may describe objects. Trust: worker's input."""


def spec_of(description: dict[str, Any] | None) -> EnvSpec | None:
    """A spec with facts that ``read_spec`` has checked; None if this Gymnasium takes no such id.

    Its entry points are texts, so that it can be written as JSON; they name ``not_here``.
    """
    # gym.make imports what stands before a colon
    if not description or description.get("id") is None or ":" in description["id"]:
        return None
    facts = {name: value for name, value in description.items() if value is not None}
    try:
        return EnvSpec(**facts, entry_point=_REFUSAL, vector_entry_point=_REFUSAL)
    except Exception:  # an id that this Gymnasium cannot read: not worth failing for
        return None


def not_here(*args: Any, reference: str = "", **kwargs: Any) -> NoReturn:
    """Raise ``gymnasium.error.Error``: the entry point of specs that a worker describes."""
    named = f", {reference}" if reference else ""
    raise gym.error.Error(
        f"this describes an environment in a sandbox{named}, whose code never enters this process. "
        "Use envhub_sandbox.make_env with that repository, or copy.deepcopy(env) for a copy"
    )


def pickled(value: object, *, lasting: bool = False) -> bytes:
    """Pickle a value of the caller for the jail, including classes of ``__main__``.
    ``lasting``: whether the bytes must say everything, without names of the caller's own code.
    Raises ``TypeError``: a ``lasting`` value has such code, which may differ the next time.
    """
    buffer = io.BytesIO()
    pickler = _pickler()(buffer)
    pickler.lasting = lasting
    pickler.dump(value)
    return buffer.getvalue()


def framed(value: object) -> bytes | memoryview:
    """Pickle a value of the caller; a large pickle becomes a frame of its own."""
    data = pickled(value)
    return data if len(data) <= INLINE_BYTES else memoryview(data)


@cache
def _pickler() -> Any:
    import cloudpickle  # type: ignore[import-untyped]  # few callers have a value that needs it

    class Pickler(cloudpickle.Pickler):  # type: ignore[misc]
        lasting: bool

        def reducer_override(self, value: Any) -> Any:
            """Pickle a memory view as one of a copy; refuse names that do not last."""
            if self.lasting and isinstance(value, (type, FunctionType)):
                package = str(value.__module__).partition(".")[0]
                if package not in _INSTALLED and package not in sys.stdlib_module_names:
                    raise TypeError(f"{value.__qualname__} may be another object next time")
            if type(value) is memoryview:
                plain = value.readonly and value.format == "B" and value.ndim == 1
                return memoryview, (bytes(value) if plain else np.array(value),)
            return super().reducer_override(value)

    return Pickler


_INSTALLED = frozenset({"gymnasium", "numpy"})
"""Packages that come with the interpreter, as far as we know."""
