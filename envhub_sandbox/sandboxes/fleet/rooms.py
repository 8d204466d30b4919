"""How many more workers there is room for in a place, by the word of its server."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from time import monotonic

from envhub_sandbox.sandboxes import server_facts
from envhub_sandbox.sandboxes.fleet.member import Member
from envhub_sandbox.sandboxes.remote import RemoteSandbox
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.system.threads import Call, Calls
from envhub_sandbox.transport.tcp import UnreachableError

_WAIT_S = 1.5
"""How long servers may take to answer: one that takes longer comes after those that have."""
_FRESH_S = 2.0
"""For how long an answer holds, less what has been placed there since."""


@dataclass(frozen=True)
class Room:
    """The room of one place.

    Attributes:
        answers: Whether it has answered; true of a place that is not asked.
        known_s: When it was asked.
        workers: For how many more workers there is room; infinity where nothing bounds them.
    """

    answers: bool = True
    workers: float = float("inf")
    known_s: float = 0.0


class Rooms:
    """The rooms of a fleet's places. Thread-safe.
    ``memory_bytes``: what a worker takes of its key's quota.
    """

    def __init__(self, memory_bytes: int) -> None:
        self._memory_bytes = memory_bytes
        self._asking = threading.RLock()  # interruption.md, rule 12
        self._pending: dict[Member, tuple[float, Call[server_facts.ServerFacts]]] = {}

    def ask(self, members: Iterable[Member]) -> dict[Member, Room]:
        """The room of each, asked of all at the same time; of one that is not a server its own."""
        sandboxes = {one: one.sandbox for one in members}
        servers = {m: one for m, one in sandboxes.items() if isinstance(one, RemoteSandbox)}
        with self._asking:  # who comes next finds the answers
            now = monotonic()
            stale = [one for one in servers if self._is_stale(one, now)]
            calls = [partial(server_facts.ask, servers[one]) for one in stale]
            asked = Calls(calls)
            asked.wait(_WAIT_S)
            self._pending.update({one: (now, p) for one, p in zip(stale, asked.each, strict=True)})
            return {one: self._room(one) for one in servers}

    def _is_stale(self, member: Member, now: float) -> bool:
        at, pending = self._pending.get(member, (0.0, None))
        # one that has not answered yet is still being asked
        return pending is None or (pending.done and now - at > _FRESH_S)

    def _room(self, member: Member) -> Room:
        known_s, pending = self._pending[member]
        facts = pending.value
        if pending.error is not None and not isinstance(pending.error, UnreachableError):
            text = "%s gets no worker as long as others have room: %s"
            WORKER.warning(text, member.address, pending.error)
        if facts is None:
            return Room(answers=False, workers=0)
        if facts.draining:
            return Room(workers=0)
        taken = {"jails": 1, "runners": 1, "memory_bytes": self._memory_bytes}
        quotas, used = facts.quotas, facts.used
        free = [(quotas[n] - used.get(n, 0)) // each for n, each in taken.items() if n in quotas]
        return Room(workers=max(0, min(free, default=1)), known_s=known_s)
