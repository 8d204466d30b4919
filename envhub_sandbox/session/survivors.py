"""When runners of a kept jail have died: how, what the others answered, and what fresh ones say."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from envhub_sandbox.errors import WorkerDiedError, WorkerError
from envhub_sandbox.session.reseed import Frames
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import RunnersDiedError, typed
from envhub_sandbox.transport.lane import Lane
from envhub_worker.protocol import messages as m

Requests = Callable[[int], list[m.Message]]
"""What a shard's fresh runner is asked, one after the other."""


def all_died(error: WorkerError, shards: int) -> RunnersDiedError:
    """The jail has ended, and all shards with it."""
    if not isinstance(error, WorkerDiedError):  # a sibling has given the jail up
        error = WorkerDiedError(str(error), reason="killed")
    nobody: list[m.Message | None] = [None] * shards
    return RunnersDiedError(nobody, dict.fromkeys(range(shards), error), jail_gone=True)


def set_again(
    lane: Lane,
    dead: Sequence[int],
    settings: Sequence[tuple[str, Sequence[Frames]]],
    deadline: Deadline,
) -> list[str]:
    """Set attributes in the fresh runners of some shards; the names of those whose setter raised.

    Raises:
        WorkerError: One died again, or took too long.
        RemoteProtocolError: One answered with something else.
    """
    failed = []
    for name, frames in settings:
        asked = [(lane.runners[index], frames[index]) for index in dead]
        replies = lane.jail.ask("set_attr", asked, deadline)
        if any(isinstance(reply, m.Raised) for reply in replies):
            failed.append(name)
        for reply in replies:
            if not isinstance(reply, m.Raised):
                typed(reply, m.Value)
    return failed


def ask_anew(
    lane: Lane, dead: Sequence[int], requests: Requests, deadline: Deadline
) -> dict[int, m.Message]:
    """Ask the fresh runners of some shards; what each answers to its last request.

    Raises:
        RemoteEnvError: The repository raised this time.
        WorkerError: One died again, or took too long.
    """
    runners = [lane.runners[index] for index in dead]
    replies: list[m.Message] = []
    for messages in zip(*map(requests, dead), strict=True):
        asked = list(zip(runners, messages, strict=True))
        replies = lane.jail.exchange("reset", asked, deadline)
    return dict(zip(dead, replies, strict=True))
