"""The random generators of an environment, which the caller can use.

In one process the environment and its wrappers draw from the same generator. Here the caller gets a
copy of the generator in the jail, and their states are kept equal:

- Before a request, the jail gets the state of each generator that the caller has drawn from.
- After a request, the caller's generator is out of date until ``np_random`` is read again. If the
  caller has kept a reference to the generator, it is updated at once, since its next use cannot be
  noticed.
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
SAID_NEXT = (WorkerError, RemoteEnvError, AlreadyPendingCallError, ClosedEnvironmentError)
"""Errors of reading generators after a request, which must not hide its answer. The next request
raises them."""


class _Live:
    """One generator of the caller, and its counterpart in the jail.

    Attributes:
        generator: The caller's generator.
        number: The worker's number of its generator object; None before it is known.
        known: The last state that both generators had.
    """

    def __init__(self, generator: np.random.Generator, number: int | None) -> None:
        self.generator = generator
        self.number = number
        self.known = generator.bit_generator.state

    def drawn(self) -> dict[str, Any] | None:
        """The state if the caller has drawn from the generator; None otherwise."""
        state: Any = self.generator.bit_generator.state
        return None if equal_states(state, self.known) else state

    def references(self) -> tuple[int, int]:
        """The reference counts of the generator and of its bit generator."""
        return sys.getrefcount(self.generator), sys.getrefcount(self.generator.bit_generator)


_UNKEPT = _Live(np.random.Generator(np.random.PCG64(0)), 0).references()
"""The reference counts of a generator that only this module refers to."""


class Generators:
    """The generators of a vector environment: one for each sub-environment, or one for all.
    ``requests``: the requests of the vector environment.
    ``single``: whether a repository's own class has one generator; known after the first read.
    """

    def __init__(self, requests: RequestOrder) -> None:
        self.single = False
        self._requests = requests
        self._live: list[_Live] = []
        self._current = False  # whether no request was sent since the last read
        self._asking = False  # whether our own requests run, which change nothing

    def read(self) -> list[np.random.Generator]:
        """Update the caller's generators and return them."""
        with self._requests.use.lock:
            if not self._current:
                self._fetch()
            return [live.generator for live in self._live]

    def put(self, index: int, value: Any) -> None:
        """Replace the generator of a sub-environment, as ``env.np_random = value`` does.
        Raises ``TypeError``: the generator's state cannot be sent.
        """
        bits: Any = getattr(value, "bit_generator", None)
        if not isinstance(value, np.random.Generator) or type(bits) not in BIT_GENERATORS:
            names = ", ".join(kind.__name__ for kind in BIT_GENERATORS)
            raise TypeError(f"np_random takes a numpy Generator of {names}, got {value!r}")
        with self._requests.use.lock:
            count = len(self.read())
            self.before_request()  # send the caller's draws from the other generators
            states: list[Any] = [None] * count
            states[index] = bits.state
            self.write(states, new=True)
            self._live[index] = _Live(value, None)
            self._fetch()

    def write(self, states: Sequence[Any], *, new: bool = False) -> None:
        """Send states to the generators in the jail; None leaves a generator unchanged.
        ``new``: whether the states are those of new generators, not of the same ones after draws.
        """

        def message(number: int, bounds: tuple[int, int]) -> m.Message:
            own = states if self.single else states[slice(*bounds)]
            return m.SetRandom(number, tuple(own), new)

        self._ask(message)

    def before_request(self) -> None:
        """Send states that the caller's draws have changed; its generators are then out of date."""
        if not self._current or self._asking:
            return
        self._current = False  # first: if sending fails, a reset must not try the same again
        states = [live.drawn() for live in self._live]
        if any(state is not None for state in states):
            self.write(states)

    def after_request(self) -> None:
        """Update the generators to which the caller has kept references."""
        if self._current or self._asking or self._requests.waiting is not None:
            return
        if any(live.references() != _UNKEPT for live in self._live):
            with suppress(*SAID_NEXT):
                self._fetch()

    def _fetch(self) -> None:
        replies = self._ask(for_every_shard(m.GetRandom))
        with UNTRUSTED:  # numpy may refuse a state that the protocol permits
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
    """A generator from the worker's description of it. Trust: input from the worker."""
    if type(value) is not dict or type(value.get(_NUMBER)) is not int:
        raise RemoteProtocolError("the worker sent a random generator without a number")
    state = {name: part for name, part in value.items() if name != _NUMBER}
    return _Live(generator(state), value[_NUMBER])


def _followed(old: _Live, new: _Live) -> _Live:
    """The caller's generator in its new state, or a new one if the environment has replaced its."""
    bits, fresh = old.generator.bit_generator, new.generator.bit_generator
    if old.number not in (None, new.number) or type(bits) is not type(fresh):
        return new
    bits.state = new.known
    old.known, old.number = new.known, new.number
    return old


def equal_states(state: Any, other: Any) -> bool:
    """Whether two states of bit generators, or parts of such, are equal."""
    if isinstance(state, dict):
        alike = isinstance(other, dict) and state.keys() == other.keys()
        return alike and all(equal_states(part, other[name]) for name, part in state.items())
    if isinstance(state, np.ndarray):
        return bool(np.array_equal(state, other))
    return bool(state == other)
