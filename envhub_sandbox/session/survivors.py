"""When runners of a kept jail have died: how, what the others answered, and what fresh ones say."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from envhub_sandbox.errors import RemoteProtocolError, WorkerDiedError, WorkerError
from envhub_sandbox.session.placement import Place
from envhub_sandbox.session.reseed import Frames
from envhub_sandbox.session.results import Results
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import RunnersDiedError, typed
from envhub_sandbox.transport.shared_memory.lane import Outcome
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.manifest import EnvManifest
from envhub_worker.protocol.spaces import batches

_CAUSE_S = 10.0

Requests = Callable[[int], list[m.Message]]
"""What a shard's fresh runner is asked, one after the other."""


def wait(place: Place, deadline: Deadline) -> list[Outcome]:
    """After ``JailGoneError``: all outcomes of a step, if nobody has died before its answer.

    Raises:
        RunnersDiedError: Some have; all the others have answered.
        WorkerDiedError: The jail has ended.
        WorkerTimeoutError: The deadline came before the answer of one that lives.
    """
    lane = place.lane
    assert lane is not None
    living = lane.survivors(deadline)
    # wanted or not: later columns are of the schema that these bring
    outcomes = [lane.shards[index].outcome() for index in living]
    dead = [index for index in range(len(lane.shards)) if index not in living]
    if not dead:
        return outcomes
    jail = place.loaded.jail
    asked = [(place.runners[index], m.FetchInfos(place.number)) for index in dead]
    try:  # the server knows how, at the latest when they have been reaped
        jail.receive(jail.send("step", asked), Deadline(_CAUSE_S))
    except RunnersDiedError as deaths:
        raise among_all(deaths, dead, len(place.runners)) from None
    raise RemoteProtocolError("the worker says that a process lives which has died")


def among_all(deaths: RunnersDiedError, asked: Sequence[int], shards: int) -> RunnersDiedError:
    """The deaths of those that were asked, as deaths among all shards."""
    if deaths.jail_gone:
        return deaths
    by_shard = {asked[place]: death for place, death in deaths.deaths.items()}
    return RunnersDiedError([None] * shards, by_shard)


def all_died(error: WorkerError, shards: int) -> RunnersDiedError:
    """The jail has ended, and all shards with it."""
    if not isinstance(error, WorkerDiedError):  # a sibling has given the jail up
        error = WorkerDiedError(str(error), reason="killed")
    nobody: list[m.Message | None] = [None] * shards
    return RunnersDiedError(nobody, dict.fromkeys(range(shards), error), jail_gone=True)


def answers_by_lane(
    place: Place,
    deaths: RunnersDiedError,
    manifest: EnvManifest,
    bounds: Sequence[tuple[int, int]],
    results: Results,
    deadline: Deadline,
) -> list[m.Message | None]:
    """What the living wrote into their slabs, as the messages that it stands for.

    Who dies before his infos are fetched is added to the deaths.

    Raises:
        RemoteEnvError: One of them raised.
        WorkerTimeoutError: The deadline came before infos that had to be fetched.
    """
    lane = place.lane
    assert lane is not None
    parts: list[m.Message | None] = [None] * len(bounds)
    observations = batches.split(manifest.single_observation_space, lane.observation(), bounds)
    flags = lane.flags()
    for index in [index for index in range(len(bounds)) if index not in deaths.deaths]:
        shard = lane.shards[index]
        fetch = partial(_fetch_infos, place, place.runners[index], deadline)
        try:
            info = results.lane_info(shard.outcome(), shard, fetch)
        except WorkerDiedError as error:
            deaths.deaths[index] = error
            continue
        rewards, over, cut = (column[slice(*bounds[index])] for column in flags)
        parts[index] = m.StepDone(observations[index], rewards, over, cut, info)
    return parts


def _fetch_infos(place: Place, runner: int, deadline: Deadline) -> m.Message:
    asked = [(runner, m.FetchInfos(place.number))]
    [reply] = place.loaded.jail.exchange("step", asked, deadline)
    return reply


def set_again(
    place: Place,
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
        asked = [(place.runners[index], frames[index]) for index in dead]
        replies = place.loaded.jail.ask("set_attr", asked, deadline)
        if any(isinstance(reply, m.Raised) for reply in replies):
            failed.append(name)
        for reply in replies:
            if not isinstance(reply, m.Raised):
                typed(reply, m.Value)
    return failed


def ask_anew(
    place: Place, dead: Sequence[int], requests: Requests, deadline: Deadline
) -> dict[int, m.Message]:
    """Ask the fresh runners of some shards; what each answers to its last request.

    Raises:
        RemoteEnvError: The repository raised this time.
        WorkerError: One died again, or took too long.
    """
    runners = [place.runners[index] for index in dead]
    replies: list[m.Message] = []
    for messages in zip(*map(requests, dead), strict=True):
        asked = list(zip(runners, messages, strict=True))
        replies = place.loaded.jail.exchange("reset", asked, deadline)
    return dict(zip(dead, replies, strict=True))
