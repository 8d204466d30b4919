"""What happens to jails, and in which order a server hears of it."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.shared_memory import words
from envhub_worker.spawn.jail import CallDenied, RunnerExited
from envhub_worker.spawn.spawner import JailExited
from envhub_worker.supervisor.jail_events import JailEvents
from envhub_worker.supervisor.records import JailRecord, Pending, Witness, whole_jail
from envhub_worker.supervisor.runner_stream import RunnerLink
from envhub_worker.supervisor.served_slabs import ServedSlabs


class _Jail:
    """One that has told something which nobody has read yet."""

    def __init__(self, *events: Any) -> None:
        self.events = list(events)
        self.killed = False

    def fileno(self) -> int:
        return -1 if self.killed else 99

    def poll(self) -> list[Any]:
        told, self.events = self.events, []
        return [] if self.killed else told

    def kill(self) -> None:
        self.killed = True


class _Silent:
    """Everything else that a jail has to do with."""

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments: ""


def test_what_a_jail_was_denied_is_known_when_it_is_ended() -> None:
    """Also if what ends it is heard of first, on another descriptor; and it dies of that."""
    tried = CallDenied("socket", "AF_INET")
    jail: Any = _Jail(tried, RunnerExited(1, None, 9, "signal"))
    silent: Any = _Silent()
    entry = JailRecord(7, "one", b"", jail, (), silent)
    events = JailEvents(silent, silent, {7: entry}, silent, Witness())
    try:
        events.end(entry, whole_jail("protocol"))
        assert entry.denied == ["socket AF_INET"]
        assert entry.death is not None
        assert entry.death.reason == "protocol"
        assert jail.killed
    finally:
        events.close()


def test_a_jail_that_cannot_be_heard_any_more_ends_alone() -> None:
    """Its last words may be lost, as where its server has no descriptors left; that goes on."""

    class Unheard(_Jail):
        def poll(self) -> list[Any]:
            raise AssertionError("no room for a descriptor")

    class Told(Witness):
        def failed(self, error: Exception) -> None:
            failures.append(str(error))

    failures: list[str] = []
    jail: Any = Unheard()
    silent: Any = _Silent()
    entry = JailRecord(7, "one", b"", jail, (), silent)
    events = JailEvents(silent, silent, {7: entry}, silent, Told())
    try:
        events.end(entry, whole_jail("protocol"))
        assert (jail.killed, failures) == (True, ["no room for a descriptor"])
        assert entry.death is not None
    finally:
        events.close()


@pytest.mark.parametrize("stepped", [True, False])
def test_who_waits_for_a_jail_that_another_closes_hears_of_it(stepped: bool) -> None:
    """A thread that waits for a step, which the server takes or the runner's stream does."""
    jail: Any = _Jail()
    silent: Any = _Silent()
    entry = JailRecord(7, "one", b"", jail, (), silent)
    said: list[tuple[Any, m.Message]] = []
    events = JailEvents(
        silent, lambda asker, reply, *_: said.append((asker, reply)), {7: entry}, silent, Witness()
    )
    ours, theirs = socket.socketpair()
    link = entry.links[1] = RunnerLink(ours, DEFAULT_LIMITS)
    pending: Any = Pending("who steps", "step", [None])  # type: ignore[arg-type]
    try:
        if stepped:
            size = words.HEADER_BYTES + words.INFO_BYTES
            events.share(link, ServedSlabs(0, size, 64))
            events.step(entry, link, bytes((words.DTYPES - words.SPIN) * 8), (pending, 0))
        else:
            link.pending[1] = pending, 0
        entry.closing.append("who closes")  # type: ignore[arg-type]
        events.jail_gone(JailExited(jail, 0, None))
        assert [asker for asker, _ in said] == ["who steps", "who closes"]
        death = said[0][1]
        assert isinstance(death, m.Death)
        assert (death.operation, death.detail) == ("step", "the jail was closed")
    finally:
        events.close()
        theirs.close()
