"""An environment's random generators, whose states the client reads and sets."""

from __future__ import annotations

from typing import Any

import numpy as np


class Generators:
    """The generators of one environment: those of its sub-environments, or its only one."""

    def __init__(self) -> None:
        self._last: dict[int, tuple[int, Any]] = {}

    def states(self, env: Any) -> Any:
        """Returns each generator's state with its number, or the state of the only one."""
        generators = env.np_random
        if not isinstance(generators, tuple):
            return self._state(0, generators)
        return tuple(self._state(index, generator) for index, generator in enumerate(generators))

    def _state(self, index: int, generator: Any) -> dict[str, Any]:
        if not isinstance(generator, np.random.Generator):
            raise TypeError(
                f"np_random is a {type(generator).__name__} here, not a numpy Generator: draw "
                "from it in the environment only"
            )
        number, last = self._last.get(index, (0, None))
        if generator is not last:  # kept, so that no other one gets its id
            self._last[index] = number + 1, generator
        return {"number": self._last[index][0], **generator.bit_generator.state}


def bring(env: Any, states: tuple[Any, ...]) -> None:
    """Set generators to these states in place; None leaves a generator unchanged."""
    generators = env.np_random
    each = generators if isinstance(generators, tuple) else (generators,)
    for generator, state in zip(each, states, strict=True):
        if state is not None:
            generator.bit_generator.state = state


def replace(env: Any, states: tuple[Any, ...]) -> None:
    """Replace the sub-environments' generators, or the vector environment's only one."""
    owners = env.envs if isinstance(env.np_random, tuple) else (env,)
    for owner, state in zip(owners, states, strict=True):
        if state is not None:
            bits = getattr(np.random, state["bit_generator"])()
            bits.state = state
            owner.np_random = np.random.Generator(bits)
