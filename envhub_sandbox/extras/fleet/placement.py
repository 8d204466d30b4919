"""Chooses a place of a fleet for each worker.

Only places that answer and have room are chosen, as long as there are any. Among these a worker
returns to its previous place; a new worker goes to the place with the fewest workers for its
weight, then to the one whose server reports most room, then to the first in the list. If a place
refuses the worker, the next one is tried, until all have been tried. Results never depend on it.
"""

from __future__ import annotations

import hashlib
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from time import monotonic

from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.extras.fleet.member import ForRepository, Member
from envhub_sandbox.extras.remote import sandbox as remote
from envhub_sandbox.extras.remote.sandbox import RemoteSandbox, ServerFacts
from envhub_sandbox.sandboxes.pool import ServerUse, WorkerServer
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_sandbox.settings.policy import Policy
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.system.threads import Call, Calls
from envhub_sandbox.transport.replies import UnreachableError
from envhub_worker.protocol.runtime import OWN, Runtime

_WAIT_S = 1.5
"""Seconds to wait for servers' answers; a server without one ranks after those that answered."""
_FRESH_S = 2.0
"""Seconds for which an answer is used, less the workers that have been placed there since."""


@dataclass(frozen=True)
class Room:
    """The room of one place.

    Attributes:
        answers: Whether the place has answered; true for a place that is no remote server.
        workers: The number of further workers that fit; infinity for a place that is not asked.
        known_s: The time at which the place was asked.
    """

    answers: bool = True
    workers: float = float("inf")
    known_s: float = 0.0


class Rooms:
    """Asks a fleet's servers for their room. Thread-safe.
    ``memory_bytes``: a worker's share of its key's quota of memory.
    """

    def __init__(self, memory_bytes: int) -> None:
        self._memory_bytes = memory_bytes
        self._asking = threading.RLock()  # interruption.md, rule 12
        self._pending: dict[Member, tuple[float, Call[ServerFacts]]] = {}

    def ask(self, members: Iterable[Member]) -> dict[Member, Room]:
        """Ask all remote servers among the places for their room, at the same time."""
        sandboxes = {member: member.sandbox for member in members}
        servers = {
            m: sandbox for m, sandbox in sandboxes.items() if isinstance(sandbox, RemoteSandbox)
        }
        with self._asking:  # a thread that waits here then uses the fresh answers
            now = monotonic()
            stale = [server for server in servers if self._is_stale(server, now)]
            calls = [partial(remote.ask_facts, servers[server]) for server in stale]
            polls = Calls(calls)
            polls.wait(_WAIT_S)
            self._pending.update({one: (now, p) for one, p in zip(stale, polls.each, strict=True)})
            return {server: self._room(server) for server in servers}

    def _is_stale(self, member: Member, now: float) -> bool:
        at, pending = self._pending.get(member, (0.0, None))
        # a request without an answer is still running: do not ask again
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


_ASKED = 32
"""The number of servers that are asked for their room at the same time."""
ASK_S = 10.0
"""While no server has room for a worker, further servers are asked for so many seconds."""
Resolve = Callable[["str | Sandbox"], Sandbox]


def _key(entry: str | Sandbox) -> str | int:
    """Return the identity of an entry of the list."""
    return entry if isinstance(entry, str) else id(entry)


class Placement:
    """Chooses the places of the workers of one ``make_env``. Thread-safe.

    Args:
        places: The caller's list.
        resolve: Makes the sandbox of an entry of the list.
        runtime: Makes the runtime of a place's jails.
    """

    def __init__(
        self,
        places: Sequence[str | Sandbox],
        resolve: Resolve,
        runtime: Callable[[Member], Runtime],
    ) -> None:
        self._places = places
        self._resolve = resolve
        self._runtime = runtime
        self._lock = threading.RLock()  # interruption.md, rule 12
        self._members: list[Member] = []
        self._at: dict[int, Member] = {}
        self._placed_s: dict[int, float] = {}
        self._repository: ForRepository | None = None
        self._rooms: Rooms | None = None
        self._run_by: tuple[list[Member], Runtime] | None = None

    def members(self) -> list[Member]:
        """Return each place once, with its weight. Raises ``EnvHubError``: an entry is invalid."""
        with self._lock:
            if not self._members:
                named = {_key(entry): entry for entry in self._places}
                members: list[Member] = []
                for key, count in Counter(map(_key, self._places)).items():
                    each = self._resolve(named[key]).workers(count)
                    members += [
                        Member(sandbox, self._runtime, count // len(each)) for sandbox in each
                    ]
                self._members = members
            return list(self._members)

    def seats(self, num_workers: int | None) -> list[Seat]:
        """Make a seat for each worker; by default one for each entry of the list."""
        count = num_workers or sum(member.weight for member in self.members())
        return [Seat(self, number) for number in range(count)]

    def open_for(self, repository: ForRepository, memory_bytes: int) -> None:
        """Prepare the places for a repository.

        An absent place is prepared only when a worker is to go there.
        ``memory_bytes``: see ``Rooms``.
        """
        with self._lock:
            if self._repository is None:
                members = self.members()
                for member in [
                    candidate for candidate in members if not candidate.absent
                ] or members:
                    member.open_for(repository)
                self._rooms = Rooms(memory_bytes)
                self._repository = repository

    def runs_on(self, runtime: Runtime) -> Runtime:
        """Return a runtime that stands for those of all places."""
        with self._lock:  # each of a thousand workers asks, and there may be a thousand places
            members = self._open_ones()
            if self._run_by is None or self._run_by[0] != members:
                self._run_by = members, _all_together(member.runs_on(runtime) for member in members)
            return self._run_by[1]

    def retry_s(self) -> float:
        """Return the seconds that a worker waits for room: the largest value of all places."""
        return max(member.retry_s for member in self._members or self.members())

    def at(self, number: int) -> Member:
        """Return the place of a worker, or a guess before it has been placed."""
        with self._lock:
            if number not in self._at:
                members = self._open_ones()
                return members[number % len(members)]
            return self._at[number]

    def candidates(self, number: int) -> Iterator[Member]:
        """Yield the places for a worker: the best first, then the others if it refuses."""
        tried: list[Member] = []
        took = False
        for places in (self.members, self._open_ones):
            while left := [member for member in places() if member not in tried]:
                best = self._best(number, left)
                tried.append(best)
                if self._opens(number, best):
                    took = True
                    yield best
            if took:
                return

    def _best(self, number: int, members: list[Member]) -> Member:
        """Choose the best of these places, and record that the worker goes there."""
        order = {member: place for place, member in enumerate(members)}
        with self._lock:
            members = sorted(members, key=self._ranks(number, order, {}))
        # ask _ASKED servers, and further ones only if none of these has room: a list may have a
        # thousand servers that do not answer
        until = monotonic() + ASK_S
        for some in (members[start : start + _ASKED] for start in range(0, len(members), _ASKED)):
            rooms = self._rooms.ask(some) if self._rooms and len(members) > 1 else {}
            with self._lock:
                rank = self._ranks(number, order, rooms)
                best = min(some, key=rank)
                full = rank(best)[:2] != (False, False)
                if not full or some[-1] is members[-1] or monotonic() >= until:
                    self._at[number], self._placed_s[number] = best, monotonic()
                    return best
        raise AssertionError("there are no places")

    def _open_ones(self) -> list[Member]:
        """Return the places that are prepared for the repository; all if none is."""
        members = self._members or self.members()
        opened = [member for member in members if member.is_open]
        return opened or members

    def _opens(self, number: int, member: Member) -> bool:
        """Whether a worker can go to a place; prepares an absent place for the repository."""
        try:
            if self._repository is not None:
                member.open_for(self._repository)
        except EnvHubError as error:
            WORKER.warning("%s joins the fleet in vain: %s", member.address, error)
            with self._lock:
                self._at.pop(number, None)
            return False
        return True

    def _ranks(
        self, number: int, order: dict[Member, int], rooms: dict[Member, Room]
    ) -> Callable[[Member], tuple[object, ...]]:
        """Return a key for sorting places: the best place for the worker has the least key."""
        placed: dict[Member, list[float]] = {}
        for worker, at in self._at.items():
            if worker != number:
                placed.setdefault(at, []).append(self._placed_s[worker])

        def rank(member: Member) -> tuple[object, ...]:
            room, here = rooms.get(member, Room()), placed.get(member, [])
            left = room.workers - sum(at_s > room.known_s for at_s in here)
            moves, share = self._at.get(number) is not member, len(here) / member.weight
            return not room.answers, left < 1, moves, share, -left, order[member]

        return rank


def _all_together(each: Iterable[Runtime]) -> Runtime:
    """Return the runtime that all places share, or a hash that stands for different ones."""
    runtimes = sorted(set(each), key=attrgetter("python", "packages"))
    if len(runtimes) == 1:
        return runtimes[0]
    # a hash, because the name is looked up as a path, and thousands of addresses are too long
    digest = hashlib.sha256(repr([tuple(runtime) for runtime in runtimes]).encode())
    return Runtime(f"fleet/of/{digest.hexdigest()}")


class Seat(Sandbox):
    """The sandbox of one worker of a fleet; its place may change."""

    name = "fleet"

    def __init__(self, placement: Placement, number: int) -> None:
        self._placement = placement
        self._number = number

    @property
    def retry_s(self) -> float:  # type: ignore[override]
        """See ``Placement.retry_s``."""
        return self._placement.retry_s()

    @property
    def address(self) -> str:
        """See ``Sandbox``."""
        return self._placement.at(self._number).address

    def for_repository(
        self, snapshot: Path, policy: Policy, runtime: Runtime, assets: tuple[Path, ...] = ()
    ) -> Seat:
        """See ``Sandbox``; each place uses its own runtime instead of ``runtime``."""

        def at(place: Sandbox, runtime: Runtime) -> Sandbox:
            return place.for_repository(snapshot, policy, runtime, assets)

        self._placement.open_for(at, policy.limits.memory_bytes)
        return self

    def runs_on(self, runtime: Runtime) -> Runtime:
        """See ``Sandbox``."""
        return self._placement.runs_on(runtime)

    def candidates(self) -> Iterator[Sandbox]:
        """See ``Sandbox``."""
        return self._placement.candidates(self._number)

    def acquire(
        self, store: Path, runtime: Runtime = OWN, idle_s: float | None = 0.0
    ) -> ServerUse[WorkerServer]:
        """See ``Sandbox``: acquires a server at the worker's present place."""
        return self._placement.at(self._number).acquire(store, runtime, idle_s)
