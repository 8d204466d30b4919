"""Slabs by which the server steps a runner for a client that shares no memory with the runner.

The client is on another host, or has chosen frames. It sends its half of the request slab and gets
the bytes that the runner wrote into the other two. The server reads three words of those and does
not interpret the rest.

Trust: a jail can write all of these slabs, and the server has other clients. It reads each word
once; only the client's own bytes and bounded numbers decide what it sends. It never waits: for
doorbells see ``descriptors``; if a jail punches holes into the slabs, the server pays one page
fault per page, and the slabs' size is bounded. A large observation is sent from the slab without a
copy. An honest runner overwrites it only for the next step, which the client requests after it has
received this one; a hostile runner decides what its client reads anyway.
"""

from __future__ import annotations

import os
import select
import struct
from collections.abc import Callable
from time import perf_counter_ns
from typing import Any

from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.limits import LARGE_BYTES
from envhub_worker.protocol.shared_memory import words
from envhub_worker.protocol.shared_memory.descriptors import (
    SEAL_FUTURE_WRITE,
    OwnBell,
    RunnerBell,
    sealed_memfd,
)
from envhub_worker.spawn.channel import close_fds

_HEAD = struct.Struct("<QQ")
_WORD = struct.Struct("<Q")
_HEAD_AT = words.OUTCOME * _WORD.size
_SPIN_AT = words.SPIN * _WORD.size - words.OWN_BYTES
_KNOWN_AT = words.KNOWN * _WORD.size - words.OWN_BYTES
_CHUNK_BYTES = 1 << 19
"""One frame of a large observation: while one is encrypted, the one before it is decrypted."""
_TURN_NS = 20_000
"""How long the server polls the slabs before it does anything else."""
_RECHECK_MS = 2
_MAY_SPIN = os.uname().machine == "x86_64" and len(os.sched_getaffinity(0)) > 1
"""Elsewhere a core may see the sequence word before the data it announces; one core is not two."""
_MAX_VAIN = 16
"""Most rings of a runner in a row without an answer."""


class ServedSlabs:
    """The slabs and doorbells of one runner, and at most one step that it owes.

    Attributes:
        deposit: The runner's descriptors, to be taken once: three slabs, its doorbell, ours.
        owner: The owner of the unanswered step, or None.
        awake_until: The time until which the server polls for the answer instead of sleeping.
        shared_bytes: Size of the two slabs whose size the client chooses.
    """

    def __init__(self, leaves: int, request_bytes: int, observation_bytes: int) -> None:
        self.shared_bytes = request_bytes + observation_bytes
        # Only the server writes the request slab: the jail maps it read-only. The jail writes the
        # other two.
        self._request, request = sealed_memfd("request", request_bytes, SEAL_FUTURE_WRITE)
        self._reply, reply = sealed_memfd("reply", words.REPLY_BYTES)
        observed, observations = sealed_memfd("observations", observation_bytes)
        self._observed = memoryview(observed)
        # Bytes of words in a client's frame.
        self._words = (words.DTYPES - words.SPIN + leaves) * _WORD.size
        self._room = self._words + request_bytes - words.HEADER_BYTES
        self._runner_bell, self.bell = RunnerBell(), OwnBell()
        ends = [slab.fileno() for slab in (request, reply, observations)]
        ends += [self._runner_bell.theirs, self.bell.fileno()]
        self.deposit: list[int] = []
        try:
            for end in ends:
                self.deposit.append(os.dup(end))
        except OSError:  # there is none left: these would be lost, and with them the server
            close_fds(self.deposit)
            raise
        self._runner_bell.handed_over()
        self._asks, self._tells = words.words(self._request), words.words(self._reply)
        self._sequence = self._known = 0  # steps so far; bytes of columns that the client expects
        self.owner: Any = None
        self.awake_until = 0
        self.vain = 0  # rings since the last answer

    def fits(self, frame: bytes) -> bool:
        """Whether a frame has the size of a client's half of the request slab."""
        return self._words <= len(frame) <= self._room

    def ask(self, frame: bytes, owner: Any) -> None:
        """Write a step into the request slab and announce it."""
        # In this order: the words and actions, then the sequence word, which the runner polls. The
        # runner's parked word is read last: the runner parks and then looks at the sequence once
        # more, so it sees this step or we see that it sleeps, and ring. A processor may reorder the
        # two: the runner's first sleep is therefore short (``runner.main``).
        self.owner = owner
        asks, cut = self._asks, self._words
        self._request[words.OWN_BYTES : words.OWN_BYTES + cut] = frame[:cut]
        start = words.HEADER_BYTES
        self._request[start : start + len(frame) - cut] = frame[cut:]
        self._known = min(_WORD.unpack_from(frame, _KNOWN_AT)[0], words.INFO_BYTES)
        spin_ns = min(_WORD.unpack_from(frame, _SPIN_AT)[0], words.MAX_SPIN_NS)
        if not _MAY_SPIN:
            asks[words.SPIN] = spin_ns = 0
        self.awake_until = perf_counter_ns() + spin_ns if spin_ns else 0
        asks[words.PARKED] = not spin_ns
        self._sequence += 1
        asks[words.SEQUENCE] = self._sequence
        if self._tells[words.PARKED]:
            self._runner_bell.ring()

    def park(self) -> None:
        """Ask the runner to ring our doorbell, since the server stops polling."""
        self.awake_until = 0
        self._asks[words.PARKED] = 1

    @property
    def answered(self) -> bool:
        """Whether the answer to the last step has arrived."""
        return bool(self._tells[words.SEQUENCE] == self._sequence)

    def take(self) -> tuple[Any, list[Buffer]]:
        """Returns the step's owner and the frames of the answer. Trust: input from the jail.

        The frames hold outcome and length of infos, the infos, and the observation slab. The client
        refuses impossible values.
        """
        owner, self.owner, self.vain = self.owner, None, 0
        head = self._reply[_HEAD_AT : _HEAD_AT + _HEAD.size]
        outcome, length = _HEAD.unpack(head)
        size = self._known if outcome == words.COLUMNS else min(length, words.INFO_BYTES)
        first = head + self._reply[words.INFOS : words.INFOS + size]
        observed = self._observed
        # Joining copies, but saves a frame; from some size on the copy costs more.
        if len(observed) <= LARGE_BYTES:
            return owner, [first + observed]
        starts = range(0, len(observed), _CHUNK_BYTES)
        return owner, [first, *(observed[start : start + _CHUNK_BYTES] for start in starts)]

    def close(self) -> None:
        """Close all descriptors and views. Idempotent."""
        deposit, self.deposit = self.deposit, []
        close_fds(deposit)
        self._runner_bell.close()
        self.bell.close()
        self._observed.release()
        self._asks.release()
        self._tells.release()


class ServedSteps:
    """All unanswered steps of the server's runners, with a callback for each."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._by_bell: dict[int, ServedSlabs] = {}  # those whose rings are heard
        self._owed: dict[ServedSlabs, Callable[[], None]] = {}  # with what takes the answer

    def fileno(self) -> int:
        """A descriptor that is readable when a runner has rung."""
        return self._epoll.fileno()

    def add(self, slabs: ServedSlabs) -> None:
        """Watch a runner's doorbell."""
        self._by_bell[slabs.bell.fileno()] = slabs
        self._epoll.register(slabs.bell, select.EPOLLIN | select.EPOLLET)

    def forget(self, slabs: ServedSlabs) -> None:
        """Stop watching slabs and close them: the jail has a copy and may go on ringing."""
        self._owed.pop(slabs, None)
        self._deafen(slabs)
        slabs.close()

    def _deafen(self, slabs: ServedSlabs) -> None:
        if self._by_bell.pop(slabs.bell.fileno(), None) is not None:
            self._epoll.unregister(slabs.bell)

    def owe(self, slabs: ServedSlabs, take: Callable[[], None]) -> None:
        """Wait for the answer to a step; ``take`` is called once it is there."""
        self._owed[slabs] = take

    def rung(self) -> None:
        """Count rings, and stop watching runners that ring without answering: each ring wakes the
        server.
        """
        for fd, _ in self._epoll.poll(0):
            slabs = self._by_bell.get(fd)
            if slabs is not None:
                slabs.vain += 1
                if slabs.vain > _MAX_VAIN:
                    self._deafen(slabs)

    def look(self) -> int | None:
        """Take all arrived answers, and poll for a moment for those that come at once.
        Returns how many milliseconds the server may sleep; None for no limit.
        """
        turn, wait_ms = perf_counter_ns() + _TURN_NS, None
        while self._owed:
            for slabs in [slabs for slabs in self._owed if slabs.answered]:
                if take := self._owed.pop(slabs, None):  # an answer may be the end of others
                    take()
            awake = [slabs for slabs in self._owed if slabs.awake_until]
            if not awake:
                return wait_ms
            now = perf_counter_ns()
            for slabs in awake:
                if slabs.awake_until < now:
                    slabs.park()
                    wait_ms = _RECHECK_MS  # an answer may come before the runner sees this
            if now > turn:
                return 0
        return wait_ms

    def close(self) -> None:
        """Stop watching."""
        self._epoll.close()
