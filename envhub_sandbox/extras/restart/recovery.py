"""``restart="transparent"``: a request is completed although runners have died.

New runners replace the dead ones, with new seeds and the attributes that the caller has set; the
other runners continue. With another ``restart`` there is no ``Recovery``, and a death is an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from envhub_sandbox.errors import EnvHubError, WorkerDiedError, WorkerError, WorkerTimeoutError
from envhub_sandbox.session.failures import Failures, Restarts
from envhub_sandbox.session.lease import Lease
from envhub_sandbox.session.recorder import Recorder
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.transport.deadline import Deadline, StartupDeadline
from envhub_sandbox.transport.replies import RunnersDiedError, check_reply, typed_reply
from envhub_sandbox.transport.results import is_batch
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.lifecycle import Event
from envhub_worker.protocol.spaces import batches

if TYPE_CHECKING:
    from envhub_sandbox.transport.jail import Request
    from envhub_sandbox.transport.lane import Lane

RESTARTED = "worker_restarted"
"""The key in infos that says whether a sub-environment was lost and restarted."""
_SETTINGS = 256
"""The most attributes whose values are remembered."""
_SETTERS = frozenset({"__setattr__", "set_wrapper_attr"})
"""Methods of sub-environments that set an attribute."""


class Recovery:
    """Restarts the dead shards of one environment, in this order: fork new runners, build, set the
    remembered attributes, then repeat the request.
    """

    def __init__(
        self, lease: Lease, restarts: Restarts, failures: Failures, recorder: Recorder
    ) -> None:
        manifest = lease.results.manifest
        self._lease = lease
        self._lifecycle = lease.lifecycle
        self._bounds = lease.results.bounds
        self._restarts = restarts
        self._failures = failures
        self._counters = lease.counters
        self._recorder = recorder
        self._seeds = SeedBook(manifest.num_envs, manifest.shardable)
        self._in_rollout = False  # whether LeRobot has announced one
        self._settings: dict[Any, list[list[bytes]]] = {}  # by target: each shard's frames
        self._setting: tuple[Any, list[list[bytes]]] | None = None  # set by the pending request
        self._asked: Sequence[m.Message] = ()  # of the last request, for new runners to repeat

    # --- requests --------------------------------------------------------------------------------

    def started(self) -> None:
        """Forget the attributes that were set, and a rollout, since the jail is new."""
        self._settings.clear()
        self._in_rollout = False

    def sent(self, request: Request) -> None:
        """Remember the seeds and attributes of a request that was sent."""
        self._asked = messages = request.messages
        self._setting = None
        for message, (start, _) in zip(messages, self._bounds, strict=True):
            if isinstance(message, m.Reset):
                self._seeds.remember(message, start)
                options = message.options if isinstance(message.options, dict) else {}
                self._in_rollout = self._in_rollout or bool(options.get(m.NEW_ROLLOUT))
        target = _target_of(messages)
        if target is not None:
            self._setting = target, request.kept()

    def answered(self) -> None:
        """Remember the attribute that a request has set, since no shard raised."""
        if self._setting is not None:
            target, sent = self._setting
            self._settings.pop(target, None)  # so that the order is that of the last settings
            self._settings[target] = sent
            if len(self._settings) > _SETTINGS:
                del self._settings[next(iter(self._settings))]
            self._setting = None

    # --- deaths --------------------------------------------------------------------------------

    def deaths_of_all(self, error: WorkerError) -> RunnersDiedError:
        """Treat the end of the jail as the death of all shards."""
        if not isinstance(error, WorkerDiedError):  # another environment has given the jail up
            error = WorkerDiedError(str(error), reason="killed")
        shards = range(len(self._bounds))
        replies: list[m.Message | None] = [None for _ in shards]
        return RunnersDiedError(replies, dict.fromkeys(shards, error), jail_gone=True)

    def survive_request(self, deaths: RunnersDiedError) -> list[m.Message]:
        """The replies to a reset, which new runners repeat for the dead shards.
        Raises ``WorkerDiedError``: the request was not a reset, and is not repeated; the next step
        or reset restarts the dead shards.
        """
        replies = self._of_survivors(deaths)
        if self._lifecycle.request != "reset":
            self._lifecycle.answered()
            raise deaths.first
        return self._revive(replies, deaths, "reset")

    def survive_step(self, deaths: RunnersDiedError) -> list[m.StepDone]:
        """The replies to a step, with truncated rows for the dead shards."""
        replies = self._of_survivors(deaths)
        merged = self._revive(replies, deaths, "step")
        return [typed_reply(reply, m.StepDone) for reply in merged]

    def _of_survivors(self, deaths: RunnersDiedError) -> list[m.Message | None]:
        """The replies of the living shards, and None for the dead.
        Raises ``RemoteEnvError``: a living shard raised; the next request handles the deaths.
        """
        try:
            for reply in deaths.replies:
                if reply is not None:
                    check_reply(reply)
        except EnvHubError:
            self._lifecycle.answered()
            raise
        return deaths.replies

    def _revive(
        self, replies: list[m.Message | None], deaths: RunnersDiedError, operation: str
    ) -> list[m.Message]:
        """Restart the dead shards; returns the replies of all shards."""
        # LOSS moves the state from PENDING to REVIVING. From there REVIVAL moves to READY,
        # a timeout or an interrupt to LATE, and any other error to DEAD. The counters and
        # the recorder are up to date before READY, from which the next request may start.
        lifecycle, failures = self._lifecycle, self._failures
        lifecycle.moved(Event.LOSS)
        failures.keep_crash(deaths.first)
        try:
            answers = self._bring_back(deaths, operation)
            with UNTRUSTED:
                fresh = {at: self._revived(at, operation, answers[at]) for at in answers}
        except WorkerTimeoutError as error:
            if lifecycle.closed:
                raise failures.dead(error) from error
            lifecycle.request = None  # its progress is unknown, so the next reset takes a new jail
            failures.interruption = None
            lifecycle.moved(Event.TIMEOUT)
            raise
        except EnvHubError as error:
            cause = error.__cause__ or deaths.first
            raise failures.dead(error) from (None if cause is error else cause)
        except BaseException as error:  # interruption.md, rule 2
            failures.interrupted(error)
            lifecycle.request = None
            raise
        lifecycle.request = None
        self._counters.deaths += len(fresh)
        self._recorder.started()
        lifecycle.moved(Event.REVIVAL)
        merged = [fresh.get(index, reply) for index, reply in enumerate(replies)]
        return [reply for reply in merged if reply is not None]

    def _bring_back(self, deaths: RunnersDiedError, operation: str) -> dict[int, m.Message]:
        """Restart the dead shards; returns the last reply of each new runner."""
        if any(death.reason == "protocol" for death in deaths.deaths.values()):
            raise deaths.first  # a worker that violates the protocol is not restarted
        try:
            self._restarts.spend(operation)
        except WorkerDiedError as spent:
            raise deaths.first from spent
        dead = sorted(deaths.deaths)
        rows = [row for index in dead for row in range(*self._bounds[index])]
        why, label = str(deaths.first).partition("\n")[0], self._lease.repository.label
        # logged, since the caller sees the restart in the infos only
        WORKER.info("%s: %s; sub-environments %s start again in new processes", label, why, rows)
        timeouts = self._lease.repository.timeouts
        deadline = StartupDeadline(timeouts.startup_s)
        if deaths.jail_gone:
            self._lease.replace(deadline)
        else:
            self._lease.rebuild(dead, deadline)
        lane, deadline_of_reset = self._lease.lane, Deadline(timeouts.reset_s)
        assert lane is not None
        try:
            self._set_again(lane, dead, deadline_of_reset)
            replies: list[m.Message] = []
            each = [self._messages(lane, index, operation) for index in dead]
            for messages in zip(*each, strict=True):
                runners = [lane.runners[index] for index in dead]
                requests = [*zip(runners, messages, strict=True)]
                replies = lane.jail.exchange("reset", requests, deadline_of_reset)
            return dict(zip(dead, replies, strict=True))
        except WorkerTimeoutError as error:
            raise self._failures.late("reset", deadline_of_reset) from error

    def _set_again(self, lane: Lane, dead: Sequence[int], deadline: Deadline) -> None:
        """Set the remembered attributes in new runners; a setter's exception is only logged."""
        for (name, *_), frames in list(self._settings.items()):
            requests: list[tuple[int, list[Buffer]]] = [
                (lane.runners[index], [*frames[index]]) for index in dead
            ]
            replies = lane.jail.ask("set_attr", requests, deadline)
            if any(isinstance(reply, m.RaisedException) for reply in replies):
                label = self._lease.repository.label
                WORKER.warning("%s: %r could not be set again", label, name)
            for reply in replies:
                if not isinstance(reply, m.RaisedException):
                    typed_reply(reply, m.Value)

    def _messages(self, lane: Lane, index: int, operation: str) -> list[m.Message]:
        """The requests to a dead shard's new runner, in order."""
        seeds = self._seeds.derived(self._bounds[index], self._counters.restarts)
        if operation == "step":
            return [m.Revive(lane.number, seeds, self._in_rollout)]
        reset = self._asked[index]
        assert isinstance(reset, m.Reset)
        return resets(reset, seeds)

    def _revived(self, index: int, operation: str, answer: m.Message) -> m.Message:
        """A dead shard's reply, from its new runner's answer. Trust: input from the worker."""
        start, stop = self._bounds[index]
        results = self._lease.results
        unjoined = results.apart or results.is_sliced  # as workers send them
        if operation == "step":
            return revived_step(typed_reply(answer, m.StepDone), stop - start, unjoined=unjoined)
        done = typed_reply(answer, m.ResetDone)
        return m.replace(done, info=mark_revived(done.info, stop - start, unjoined=unjoined))


def _target_of(messages: Sequence[m.Message]) -> tuple[Any, ...] | None:
    """The name of the attribute that a request sets, and in which environments; or None."""
    first = messages[0]
    if isinstance(first, m.SetAttr):
        return (first.name,)
    calls = [message for message in messages if isinstance(message, (m.Call, m.CallOne))]
    if not calls or calls[0].name not in _SETTERS:
        return None
    # if one sub-environment is meant, only the call to its shard has the arguments
    args = max((call.args for call in calls), key=len)
    if not args or not isinstance(args[0], str):
        return None
    targets = [(getattr(call, "index", None), getattr(call, "depth", None)) for call in calls]
    return (args[0], calls[0].name, *targets)


def revived_step(reply: m.StepDone, count: int, *, unjoined: bool = False) -> m.StepDone:
    """The rows of a restarted shard for the step in which it died. Trust: its flags are not used.

    The shape of its rewards is used only if they are an array, which took that many bytes to send:
    a described space could claim a ``shape`` of any size in a few bytes.
    """
    rewards: Any = reply.rewards
    return m.StepDone(
        reply.observation,
        np.zeros(rewards.shape if is_batch(rewards) else (count,)),
        np.zeros(count, np.bool_),
        np.ones(count, np.bool_),
        mark_revived(reply.info, count, unjoined=unjoined),
    )


def mark_revived(info: dict[Any, Any], count: int, *, unjoined: bool) -> dict[Any, Any]:
    """The infos of a shard's ``count`` sub-environments, marked as restarted.
    ``unjoined``: whether they are columns with their classes, or each sub-environment's own.
    """
    yes = np.ones(count, np.bool_)
    marked = {**info, RESTARTED: yes, f"_{RESTARTED}": yes.copy()}
    if not unjoined:
        return marked
    if batches.APART_CLASSES in info:
        marked[batches.APART_CLASSES] = {**info[batches.APART_CLASSES], RESTARTED: False}
        return marked
    own = info.copy()
    for index in range(count):
        place = index + count if index + count in info else index
        own[place] = {**info.get(place, {}), RESTARTED: True}
    return own


# --- seeds for the fresh runner of a dead shard --------------------------------------------------


class SeedBook:
    """Remembers the last seeds of sub-environments, and derives the seeds after a restart.

    The seed after a restart is derived from the caller's seed, so that a run can be repeated.
    Without a caller's seed, the environment draws its own.
    ``each``: whether each sub-environment has a seed; else a repository's own class has one seed.
    """

    def __init__(self, num_envs: int, each: bool) -> None:
        self._each = each
        self._last: list[int | None] = [None] * num_envs
        self._own: Any = None

    def remember(self, reset: m.Reset, start: int = 0) -> None:
        """Remember a reset's seeds, of sub-environments from ``start`` on, within its mask."""
        seeds: Any = reset.seeds
        if seeds is None:
            return
        if not self._each:
            self._own = seeds
            return
        chosen_of: Any = [True] * len(seeds) if reset.mask is None else reset.mask
        for index, (chosen, seed) in enumerate(zip(chosen_of, seeds, strict=True), start):
            if chosen and seed is not None:
                self._last[index] = seed

    def derived(self, bounds: tuple[int, int], restart: int) -> Any:
        """The seeds for the sub-environments of a restarted shard."""
        seeds = self._last[slice(*bounds)] if self._each else self._own
        if isinstance(seeds, list):
            return [derived_seed(seed, restart) for seed in seeds]
        return derived_seed(seeds, restart)


def derived_seed(seed: int | None, restart: int) -> int | None:
    """The seed after the ``restart``-th restart, derived from the last seed."""
    if seed is None:
        return None
    return int(np.random.SeedSequence((abs(seed), restart)).generate_state(1)[0])


def resets(message: m.Reset, derived: Any) -> list[m.Message]:
    """The requests to a new runner that replaces one that died in a reset.

    They are the same reset, with derived seeds where the caller gave none. If it has a mask, a
    reset of all sub-environments comes first.
    """
    if message.mask is not None:
        return [m.Reset(message.env, derived, None, None), message]
    return [m.replace(message, seeds=_filled(message.seeds, derived))]


def _filled(seeds: Any, derived: Any) -> Any:
    if not isinstance(seeds, list) or not isinstance(derived, list):
        return derived if seeds is None else seeds
    return [new if seed is None else seed for seed, new in zip(seeds, derived, strict=True)]
