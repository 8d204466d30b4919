"""The random generators of an environment, as the caller's own.

In one process the environment and its wrappers draw from one generator. Here the caller has a
generator with the state of the one in the jail, and both follow each other:

- Before a request, the jail gets the state of each generator that the caller has drawn from.
- After it, the caller's generator is out of date, until ``np_random`` is read again. One that the
  caller has kept is updated at once, since its next use cannot be seen.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError

from envhub_sandbox.errors import RemoteEnvError, RemoteProtocolError, WorkerError
from envhub_sandbox.session.requests import MessageFor, RequestOrder, for_every_shard
from envhub_sandbox.transport.values import generator
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.spaces.spaces import BIT_GENERATORS

_NUMBER = "number"
_SAID_NEXT = (WorkerError, RemoteEnvError, AlreadyPendingCallError, ClosedEnvironmentError)
"""Errors of reading generators that must not hide a request's answer; the next one raises them."""


class _Live:
    """One generator.

    Attributes:
        generator: The caller's.
        number: The worker's number of its generator object; None before it is known.
        known: The last state that both had.
    """

    def __init__(self, generator: np.random.Generator, number: int | None) -> None:
        self.generator = generator
        self.number = number
        self.known = generator.bit_generator.state

    def drawn(self) -> dict[str, Any] | None:
        """Its state if the caller has drawn from it; None otherwise."""
        state: Any = self.generator.bit_generator.state
        return None if _equal(state, self.known) else state

    def references(self) -> tuple[int, int]:
        """How many there are to the generator, and to its bits."""
        return sys.getrefcount(self.generator), sys.getrefcount(self.generator.bit_generator)


_UNKEPT = _Live(np.random.Generator(np.random.PCG64(0)), 0).references()
"""The references to a generator that only this module has."""


class Generators:
    """The generators of a vector environment: one of each sub-environment, or its own one.
    ``requests``: those of the vector environment.

    Attributes:
        single: Whether there is but one, of a repository's own class; known once it was read.
    """

    def __init__(self, requests: RequestOrder) -> None:
        self.single = False
        self._requests = requests
        self._live: list[_Live] = []
        self._current = False
        self._asking = False

    def read(self) -> list[np.random.Generator]:
        """The caller's generators, up to date."""
        with self._requests.use.lock:
            if not self._current:
                self._fetch()
            return [live.generator for live in self._live]

    def put(self, index: int, value: Any) -> None:
        """Make this the generator of a sub-environment, as ``env.np_random = value`` does.
        Raises ``TypeError``: its state cannot be sent.
        """
        bits: Any = getattr(value, "bit_generator", None)
        if not isinstance(value, np.random.Generator) or type(bits) not in BIT_GENERATORS:
            names = ", ".join(kind.__name__ for kind in BIT_GENERATORS)
            raise TypeError(f"np_random takes a numpy Generator of {names}, got {value!r}")
        with self._requests.use.lock:
            count = len(self.read())
            self.before_request()  # the draws from others
            states: list[Any] = [None] * count
            states[index] = bits.state
            self.write(states, new=True)
            self._live[index] = _Live(value, None)
            self._fetch()

    def write(self, states: Sequence[Any], *, new: bool = False) -> None:
        """Send states to the generators in the jail; None leaves one as it is.
        ``new``: whether each is another generator, and not the same one after some draws.
        """

        def message(number: int, bounds: tuple[int, int]) -> m.Message:
            own = states if self.single else states[slice(*bounds)]
            return m.SetRandom(number, tuple(own), new)

        self._ask(message)

    def before_request(self) -> None:
        """Send what the caller has drawn; from then on its generators are out of date."""
        if not self._current or self._asking:
            return
        self._current = False  # also where they cannot be sent: a reset is no way back else
        states = [live.drawn() for live in self._live]
        if any(state is not None for state in states):
            self.write(states)

    def after_request(self) -> None:
        """Update the generators that the caller has kept."""
        if self._current or self._asking or self._requests.waiting is not None:
            return
        if any(live.references() != _UNKEPT for live in self._live):
            with suppress(*_SAID_NEXT):
                self._fetch()

    def _fetch(self) -> None:
        replies = self._ask(for_every_shard(m.GetRandom))
        with UNTRUSTED:  # a generator that numpy does not know breaks no rule of the wire
            self.single = type(replies[0].value) is dict
            if self.single:
                states: Sequence[Any] = [replies[0].value]
            else:
                states = self._requests.one_each("np_random", replies)
            fetched = [_read(state) for state in states]
            pairs = zip(self._live or fetched, fetched, strict=True)
            self._live = [_followed(old, new) for old, new in pairs]
        self._current = True
        self._requests.before_request = self.before_request
        self._requests.after_request = self.after_request

    def _ask(self, message: MessageFor) -> list[m.Value]:
        before, self._asking = self._asking, True
        try:
            return self._requests.ask("np_random", message)
        finally:
            self._asking = before


def _read(value: Any) -> _Live:
    """Trust: input from the worker."""
    if type(value) is not dict or type(value.get(_NUMBER)) is not int:
        raise RemoteProtocolError("the worker sent a random generator without a number")
    state = {name: part for name, part in value.items() if name != _NUMBER}
    return _Live(generator(state), value[_NUMBER])


def _followed(old: _Live, new: _Live) -> _Live:
    """The caller's generator in its new state, or a new one if the environment has another."""
    bits, fresh = old.generator.bit_generator, new.generator.bit_generator
    if old.number not in (None, new.number) or type(bits) is not type(fresh):
        return new
    bits.state = new.known
    old.known, old.number = new.known, new.number
    return old


def _equal(state: Any, other: Any) -> bool:
    if isinstance(state, dict):
        return all(_equal(part, other[name]) for name, part in state.items())
    if isinstance(state, np.ndarray):
        return bool(np.array_equal(state, other))
    return bool(state == other)
