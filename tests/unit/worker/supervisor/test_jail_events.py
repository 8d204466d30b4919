"""What happens to jails, and in which order a server hears of it."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import MagicMock, Mock

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


@contextmanager
def told_of(jail: Any) -> Iterator[tuple[JailEvents, JailRecord, Mock, list[Any]]]:
    """The events of one jail, its record, what went wrong, and what is replied to whom."""
    silent, witness, replies = MagicMock(), Mock(spec=Witness), list[tuple[Any, m.Message]]()
    silent.text.return_value = ""
    entry = JailRecord(7, "one", b"", jail, (), silent)

    def reply(asker: Any, message: m.Message, *_: object) -> None:
        replies.append((asker, message))

    events = JailEvents(silent, reply, {7: entry}, silent, witness)
    try:
        yield events, entry, witness, replies
    finally:
        events.close()


@pytest.mark.parametrize("fails", [False, True])
def test_what_a_jail_was_denied_is_known_when_it_is_ended(fails: bool) -> None:
    """Also if what ends it is heard of first, on another descriptor; and it dies of that. Its last
    words may be lost, as where its server has no descriptors left; that goes on."""
    jail = Mock()
    jail.poll.return_value = [CallDenied("socket", "AF_INET"), RunnerExited(1, None, 9, "signal")]
    if fails:
        jail.poll.side_effect = AssertionError("no room for a descriptor")
    with told_of(jail) as (events, entry, witness, _):
        events.end(entry, whole_jail("protocol"))
        assert entry.denied == ([] if fails else ["socket AF_INET"])
        assert witness.failed.called is fails
        assert entry.death.reason == "protocol"
        assert jail.kill.called


@pytest.mark.parametrize("stepped", [True, False])
def test_who_waits_for_a_jail_that_another_closes_hears_of_it(stepped: bool) -> None:
    """A thread that waits for a step, which the server takes or the runner's stream does."""
    jail = MagicMock()
    ours, theirs = socket.socketpair()
    pending: Any = Pending("who steps", "step", [None])
    with theirs, told_of(jail) as (events, entry, _, said):
        link = entry.links[1] = RunnerLink(ours, DEFAULT_LIMITS)
        if stepped:
            size = words.HEADER_BYTES + words.INFO_BYTES
            events.share(link, ServedSlabs(0, size, 64))
            events.step(entry, link, bytes((words.DTYPES - words.SPIN) * 8), (pending, 0))
        else:
            link.pending[1] = pending, 0
        entry.closing.append("who closes")
        events.jail_gone(JailExited(jail, 0, None))
        assert [asker for asker, _ in said] == ["who steps", "who closes"]
        death = said[0][1]
        assert (death.operation, death.detail) == ("step", "the jail was closed")
