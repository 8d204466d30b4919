"""Repeats the requests of an environment that died, and tells whether it dies again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from envhub_sandbox.errors import ActionError, RemoteEnvError, WorkerDiedError, WorkerTimeoutError
from envhub_sandbox.extras.crash.bundle_reader import Bundle
from envhub_sandbox.extras.crash.bundle_writer import death_of
from envhub_worker.protocol import messages as m

_SHOWN = 64
_UNFIT = (ActionError, TypeError, ValueError)
"""Errors that are raised before the request is sent if the environment has changed."""


class Verdict(str, Enum):
    """The ways in which a replay can end."""

    SAME = "same"
    DIFFERENT = "different"
    SURVIVED = "survived"


@dataclass(frozen=True, kw_only=True)
class ReplayResult:
    """The result of a replay.

    Attributes:
        requests: Number of repeated requests, the last one included.
        steps: Number of steps among them.
        death: ``reason``, ``exit_code``, ``signal`` and ``message``; None if no jail died.
        note: A further remark, or "".
    """

    verdict: Verdict
    requests: int
    steps: int
    death: dict[str, Any] | None = None
    note: str = ""


def replay(make: Callable[[], Any], bundle: Bundle) -> ReplayResult:
    """Makes the environment (raises like ``make_env``) and repeats a bundle's requests."""
    try:
        env = make()
    except (WorkerDiedError, WorkerTimeoutError) as error:
        return _ended(error, bundle, 0, 0)
    if env is None:
        return ReplayResult(verdict=Verdict.SURVIVED, requests=0, steps=0)
    steps = 0
    for done, message in enumerate(bundle.requests(), start=1):
        steps += isinstance(message, m.Step)
        try:
            ended = _ask(env, message)
        except _UNFIT as error:
            note = f"request {done} does not fit this environment: {error}"
            return ReplayResult(verdict=Verdict.DIFFERENT, requests=done, steps=steps, note=note)
        if ended is not None:
            return _ended(ended, bundle, done, steps)
    return ReplayResult(verdict=Verdict.SURVIVED, requests=bundle.count, steps=steps)


def _ask(env: Any, message: m.Message) -> WorkerDiedError | WorkerTimeoutError | None:
    """Repeat one request; what the repository raises is its answer, as it was before."""
    try:
        _repeat(env, message)
    except (WorkerDiedError, WorkerTimeoutError) as error:
        return error
    except (RemoteEnvError, AttributeError):
        pass
    return None


def _ended(
    error: WorkerDiedError | WorkerTimeoutError, bundle: Bundle, requests: int, steps: int
) -> ReplayResult:
    death = death_of(error)
    how = {name: death[name] for name in ("reason", "exit_code", "signal")}
    same = requests == bundle.count and all(how[name] == bundle.death[name] for name in how)
    return ReplayResult(
        verdict=Verdict.SAME if same else Verdict.DIFFERENT,
        requests=requests,
        steps=steps,
        death={**how, "message": death["message"]},
    )


def _repeat(env: Any, message: m.Message) -> None:
    """Trust: the bundle's. No name in it is looked up in the proxy, and a call that is named reset
    or step is no reset or step of all. What no history has is not asked.
    """
    if isinstance(message, m.Step):
        env.step(message.actions)
    elif isinstance(message, m.Reset):
        options = message.options if isinstance(message.options, dict) else None
        if message.mask is not None:
            options = {**(options or {}), "reset_mask": message.mask}
        env.reset(seed=message.seeds, options=options)
    elif isinstance(message, m.Call):
        env.call(message.name, *message.args, **message.kwargs)
    elif isinstance(message, m.SetAttr):
        env.set_attr(message.name, list(message.values))
    elif isinstance(message, m.Render):
        env.render()
    elif isinstance(message, (m.GetOne, m.CallOne)):
        _ask_one(env, message)
    elif isinstance(message, m.GetRandom):
        env.np_random  # noqa: B018  # asks for it
    elif isinstance(message, m.SetRandom):
        env._generators.write(message.states, new=message.new)


def _ask_one(env: Any, message: m.GetOne | m.CallOne) -> None:
    """Ask one sub-environment, or the vector environment; other shards get no arguments."""

    def message_for(number: int, index: int | None) -> m.Message:
        changes: dict[str, Any] = {"env": number, "index": index}
        if index is None and isinstance(message, m.CallOne):
            changes |= {"args": (), "kwargs": {}}
        return m.replace(message, **changes)

    if message.index is not None and m.ITSELF <= message.index < env.num_envs:
        env._requests.ask_one(message.name, message.index, message_for)


def changed_files(recorded: dict[str, str], found: dict[str, str]) -> Sequence[str]:
    """Returns the paths of files that were changed, added or removed since the death."""
    return sorted(path for path in {*recorded, *found} if recorded.get(path) != found.get(path))
