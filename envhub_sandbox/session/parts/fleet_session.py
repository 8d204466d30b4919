"""One environment over several workers: the life of all its parts as that of one.

A *part* is an ``EnvSession`` with some of the sub-environments, in a jail of its own, wherever its
launcher opens that. Its restarts, counters and ends are its own. What a ``SandboxVectorEnv`` asks
of an ``EnvSession`` is asked of all of them here.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any

from envhub_sandbox.session.counters import LEDGER, FleetCounters, Labels
from envhub_sandbox.session.crash.history import History
from envhub_sandbox.session.env_session import GRACE_S, EnvSession
from envhub_sandbox.session.parts.fleet_requests import FleetRequests
from envhub_sandbox.session.prewarm import FleetPrewarm
from envhub_sandbox.system.threads import Calls
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.results import Results
from envhub_worker.protocol.lifecycle import State

_WORST = (
    *(State.CLOSED, State.FOREIGN, State.DEAD, State.EXPIRED, State.LATE, State.REVIVING),
    *(State.PENDING, State.IDLE, State.READY),
)
"""Of several parts' states that of the first in this order counts for all."""


class FleetSession:
    """The life of one vector environment in several jails: see ``EnvSession``.

    Args:
        parts: One for each worker, in the order of their sub-environments.
        history: Of the whole environment; the parts were made with it.
    """

    def __init__(self, parts: Sequence[EnvSession], history: History) -> None:
        self.parts = list(parts)
        self.repository = parts[0].repository
        self.manifest = manifest = parts[0].manifest
        self.bounds = [part.rows for part in parts]
        self.counters = FleetCounters([part.counters for part in parts])
        self.lifecycle = FleetLifecycle(parts)
        self.prewarm = FleetPrewarm([part.prewarm for part in parts])
        results = Results(manifest, self.bounds)
        results.max_bytes = self.repository.wire_limits.message_bytes
        self.requests = FleetRequests(self.parts, results, history, self.counters)
        labels = Labels(self.repository.label, manifest.suite, str(manifest.task))
        LEDGER.add(self, labels, self.counters, self.lifecycle)

    @property
    def jails(self) -> int:
        """That it lives in at a time."""
        return len(self.parts)

    def report(self) -> list[dict[str, Any]]:
        """The layers of every jail, each with the number of its worker."""
        return [
            {**layer, "worker": number}
            for number, part in enumerate(self.parts)
            for layer in part.report()
        ]

    def denials(self) -> tuple[str, ...] | None:
        """What any of the jails was denied; None where that is not recorded."""
        found = [denials for part in self.parts if (denials := part.denials()) is not None]
        return tuple(dict.fromkeys(one for some in found for one in some)) if found else None

    def usage(self) -> dict[str, int]:
        """What all jails hold; empty if one does not say."""
        found = [part.usage() for part in self.parts]
        if not all(found):
            return {}
        return {name: sum(one[name] for one in found) for name in found[0]}

    def stats(self) -> dict[str, Any]:
        """Counters of the whole, and of each worker."""
        workers = [
            {
                "place": part.lease.place,
                "rows": list(rows),
                "state": part.lifecycle.state.name,
                **self.counters.of_worker(number),
            }
            for number, (part, rows) in enumerate(zip(self.parts, self.bounds, strict=True))
        ]
        whole = self.counters.snapshot()
        return {**whole, "state": self.lifecycle.state.name, "workers": workers}

    def recover(self) -> None:
        """Before a reset: see ``EnvSession``. All parts share the time that one has for that."""
        grace = Deadline(GRACE_S)
        if any(part.lifecycle.state is State.DEAD for part in self.parts):
            # what has ended one may have ended others, which have not been asked since
            for part in self.parts:
                part.notice_death()
        for part in self.parts:
            with part.naming():
                part.recover(grace)

    def close(self) -> None:
        """Close every part, side by side: see ``EnvSession``."""
        if not (self.requests.use.is_mine or self.lifecycle.closed):
            with contextlib.suppress(RuntimeError):  # this system has no thread left
                Calls([part.close for part in self.parts]).wait()
        self.finalize()

    def finalize(self) -> None:
        """Close every part, one after the other: a finalizer starts no thread, for the collector
        may have called it where one is being started."""
        with contextlib.ExitStack() as stack:  # interruption.md, rule 9
            for part in self.parts[::-1]:
                stack.callback(part.close)


AnySession = EnvSession | FleetSession


class FleetLifecycle:
    """The state of several parts as that of one: see ``Lifecycle``."""

    def __init__(self, parts: Sequence[EnvSession]) -> None:
        self._parts = [part.lifecycle for part in parts]

    @property
    def state(self) -> State:
        """That of the part that is worst off."""
        return min((part.state for part in self._parts), key=_WORST.index)

    @property
    def closed(self) -> bool:
        """Whether all are closed."""
        return all(part.closed for part in self._parts)
