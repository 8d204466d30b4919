"""Watches state that a process has once and all its sub-environments share.

``AsyncVectorEnv`` gives each sub-environment a process, and with it global generators, module and
class attributes, environment variables and a working directory of its own. Sub-environments that
share a process share all of this: a change during ``reset`` or ``step`` may change the results of
all.

The positions of the generators of ``numpy.random`` and ``random`` are compared after each reset
and step, two words each: a draw moves the index, a seed replaces the state. State that takes longer
to read is compared from time to time: a change stays, so it is seen later. Followed:
``numpy/random/src/mt19937/mt19937.h``, CPython's ``Modules/_randommodule.c``.
"""

from __future__ import annotations

import ctypes
import os
import random
import sys
from collections.abc import Callable, Iterator
from itertools import islice
from types import ModuleType
from typing import Any

import gymnasium as gym
import numpy as np

from envhub_worker.protocol.spaces.spaces import seeded_nodes

_WORDS = 624
"""Of a Mersenne Twister's state."""
_FIRST, _MOST_APART = 64, 1 << 16
"""Resets and steps until the first look at what takes longer to read; each later one is twice as
far away, up to the second number."""
_NOBODYS = {"gymnasium", "gym", "builtins", "__main__"}
"""Packages that define environments, and are not looked at."""
_PLAIN = (bool, int, float, complex, str, bytes, type(None))
_CONTAINERS = (list, dict, set, bytearray)
_MOST = 1024
"""Modules and classes that are looked at."""


class SharedState:
    """Compares the process's shared state with its state when this object was made.

    Attributes of modules and classes, environment variables and the working directory count from
    the first close look on: many are set once, when the first sub-environment is built or stepped.

    Args:
        root: The repository's folder. Its modules and ``packages`` are compared.
        report: Called once, with a name of ``SHARED_STATE``.

    Attributes:
        packages: The packages that define the environments.
    """

    def __init__(self, root: str, report: Callable[[str], None]) -> None:
        self._root = os.path.join(root, "")
        self._report: Callable[[str], None] | None = report  # None once it was called
        self._generators = np.random.mtrand._rand._bit_generator, random._inst
        self._numpy, self._random = _numpy_words(self._generators[0]), _random_words()
        self._numpy_before, self._random_before = self._numpy.tolist(), self._random.tolist()
        self._torch = _torch_states()
        # What takes longer to read, at the last close look.
        self._slow: dict[tuple[str, ...], object] = {}
        self.packages: set[str] = set()
        self._left = self._every = _FIRST  # looks until the next close one, which gets rarer

    def built(self, envs: list[Any]) -> None:
        """Compare the packages that define the environments, too, once all of them are built."""
        names = {type(getattr(env, "unwrapped", env)).__module__ for env in envs}
        self.packages = {name.partition(".")[0] for name in names} - _NOBODYS

    def look(self) -> None:
        """Report state that a reset or a step has changed. Called after each."""
        if self._report is None:
            return
        self._left -= 1
        if self._numpy.tolist() != self._numpy_before:
            self._say("numpy.random")
        elif self._random.tolist() != self._random_before:
            self._say("random")
        elif not self._left:
            self.look_closely()

    def look_closely(self) -> None:
        """Like ``look``, and compare the state that takes longer to read."""
        self._left = self._every = min(2 * self._every, _MOST_APART)
        if self._report is None:
            return
        before, self._slow = self._slow, self._read()  # with modules that were imported since
        torch, self._torch = self._torch, _torch_states()  # it may have been imported since
        # Only what both readings have: a library imported since the first one counts as equal.
        if any(state != now for state, now in zip(torch, self._torch)):  # noqa: B905
            self._say("torch")
            return
        for key, value in before.items():
            if self._slow.get(key) != value:
                self._say(key[0])
                return

    def _say(self, name: str) -> None:
        report, self._report = self._report, None
        if report is not None:
            report(name)

    def _read(self) -> dict[tuple[str, ...], object]:
        """Reads the state by its name in ``SHARED_STATE`` and its owner."""
        return {
            ("environment",): dict(os.environ),
            ("directory",): _working_directory(),
            **dict(islice(self._scopes(), _MOST)),
        }

    def _scopes(self) -> Iterator[tuple[tuple[str, ...], object]]:
        """Yields the attributes of each compared module, and of each class in it."""
        modules: dict[str, Any] = dict(sys.modules)  # which may hold anything
        for name, module in modules.items():
            if not isinstance(module, ModuleType):
                continue
            file = vars(module).get("__file__")
            ours = isinstance(file, str) and file.startswith(self._root)
            if ours or name.partition(".")[0] in self.packages:
                own = dict(vars(module))
                yield ("module", name), _plain(own)
                for key, value in own.items():
                    if isinstance(value, type) and value.__module__ == name:
                        yield ("module", name, key), _plain(dict(vars(value)))


def _plain(attributes: dict[str, Any]) -> dict[str, object]:
    """Returns a comparable form of attributes: immutable values, the lengths of containers, and the
    states of generators, also of spaces.
    """
    comparable: dict[str, object] = {}
    for name, value in attributes.items():
        kind = type(value)
        read = _of_space if issubclass(kind, gym.Space) else _READABLE.get(kind)
        if read is not None and not name.startswith("__"):
            comparable[name] = read(value)
    return comparable


def _of_generator(generator: Any) -> str:
    return str(generator and generator.bit_generator.state)


def _of_space(space: Any) -> list[str]:
    return [_of_generator(getattr(node, "_np_random", None)) for node in seeded_nodes(space)]


_READABLE: dict[type, Callable[[Any], object]] = {
    **{kind: (lambda value: (type(value), value)) for kind in _PLAIN},
    **dict.fromkeys(_CONTAINERS, len),
    np.random.Generator: _of_generator,
    np.random.RandomState: lambda value: str(value.get_state()),
    random.Random: lambda value: value.getstate(),
}


def _numpy_words(generator: Any) -> memoryview:
    """Returns a live view of two words of ``numpy.random``: the state's first, and the position."""
    if type(generator) is not np.random.MT19937:
        return _NO_WORDS
    return _words(generator.ctypes.state_address)[::_WORDS]


def _random_words() -> memoryview:
    """Returns a live view of two words of ``random``: the position, and the state's first."""
    words = _words(id(random._inst) + object.__basicsize__)
    version, state, _ = random.getstate()
    same_words = version == 3 and words.tolist() == [state[-1], *state[:-1]]
    return words[:2] if same_words else _NO_WORDS


def _words(address: int) -> memoryview:
    words = (ctypes.c_uint32 * (_WORDS + 1)).from_address(address)
    return memoryview(words).cast("B").cast("I")


_NO_WORDS = memoryview(bytes(8)).cast("I")
"""Of a generator whose layout is not known."""


def _torch_states() -> list[Any]:
    """Reads the states of torch's generators; none if torch is not imported."""
    torch = sys.modules.get("torch")
    if torch is None or not hasattr(torch, "default_generator"):
        return []
    generators = [torch.default_generator]
    if torch.cuda.is_initialized():
        generators += torch.cuda.default_generators
    return [generator.get_state().cpu().numpy().tobytes() for generator in generators]


def _working_directory() -> str:
    try:
        return os.getcwd()
    except OSError:
        return ""
