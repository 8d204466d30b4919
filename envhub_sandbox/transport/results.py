"""Checks the shards' replies against the manifest, and joins them into one batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from envhub_sandbox.errors import EnvHubError, RemoteProtocolError, remote_error
from envhub_sandbox.transport.replies import check_reply, typed_reply
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.errors import FAULTS, UNTRUSTED
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.manifest.manifest import EnvManifest
from envhub_worker.protocol.spaces import batches

_NOT_ONE_EACH = "the worker's infos are not one mapping each"
_SHOWN = 500
StepResult = tuple[Any, Any, Any, Any, dict[Any, Any]]
OwnInfo = tuple[int, dict[Any, Any], batches.Forms]
Own = tuple[list[list[dict[Any, Any]]], Sequence[bool], tuple[Any, ...]]
"""Infos of each sub-environment, which members are Python numbers, and an odd reward, if any."""


class Results:
    """Joins the replies for one environment. Trust: input from the worker.
    ``manifest``: the description of the environment that the worker declared.
    ``bounds``: the slices of the sub-environments, in the order of the replies.

    Attributes:
        manifest, bounds: As given.
        count: The number of sub-environments: all, or those of one worker of several.
        slices: The same as ``bounds``, counted from the first of these sub-environments.
        apart: Whether infos come apart, as each sub-environment returned them: under its index,
            and for an episode that began in the same step, under its index plus ``count``.
        restores: Whether members of the space lose their class on the wire, and get it back here.
        max_bytes: How much larger than their messages the workers' infos may be when joined.
    """

    def __init__(self, manifest: EnvManifest, bounds: Sequence[tuple[int, int]]) -> None:
        self.manifest = manifest
        self.bounds = list(bounds)
        self.apart = False
        self.max_bytes = DEFAULT_LIMITS.message_bytes
        self._space = manifest.single_observation_space
        self._declared = manifest.shardable
        self._sizes = [stop - start for start, stop in bounds]  # rows of each shard
        first = self.bounds[0][0]
        # Rows of our own batch.
        self.slices = [(start - first, stop - first) for start, stop in bounds]
        self.count = sum(self._sizes)
        self.restores = batches.restores(self._space)

    def step(self, replies: list[m.StepDone], infos: dict[Any, Any] | None = None) -> StepResult:
        """The tuple that ``VectorEnv.step`` returns, with ``infos`` in it if given.
        Raises ``Misfit``: the shards' infos cannot be joined; ``joined_own`` can join others.
        """
        return (
            self._observation([reply.observation for reply in replies]),
            self._per_env("rewards", [reply.rewards for reply in replies]),
            self._per_env("terminations", [reply.terminations for reply in replies]),
            self._per_env("truncations", [reply.truncations for reply in replies]),
            self.infos([reply.info for reply in replies]) if infos is None else infos,
        )

    def joined_steps(
        self, parts: Sequence[StepResult], infos: dict[Any, Any] | None = None
    ) -> StepResult:
        """Join several workers' checked results of a step; returns and raises as ``step``."""
        observations, rewards, terminations, truncations, own = zip(*parts, strict=True)
        if len({part.shape[1:] for part in rewards}) > 1:
            raise RemoteProtocolError("the workers sent rewards of different shapes")
        return (
            batches.join(self._space, observations),
            np.concatenate(rewards),
            np.concatenate(terminations),
            np.concatenate(truncations),
            self._joined_infos(own) if infos is None else infos,
        )

    def joined_resets(
        self, parts: Sequence[tuple[Any, dict[Any, Any]]], infos: dict[Any, Any] | None = None
    ) -> tuple[Any, dict[Any, Any]]:
        """Join several workers' results of a reset."""
        observations, own = zip(*parts, strict=True)
        joined = self._joined_infos(own) if infos is None else infos
        return batches.join(self._space, observations), joined

    def _joined_infos(self, own: Sequence[dict[Any, Any]]) -> dict[Any, Any]:
        return (
            self._beside(own)
            if self.apart
            else batches.join_infos(own, self._sizes, self.max_bytes)
        )

    def reset(
        self, replies: list[m.ResetDone], infos: dict[Any, Any] | None = None
    ) -> tuple[Any, dict[Any, Any]]:
        """The tuple that ``VectorEnv.reset`` returns; ``infos`` as for ``step``."""
        observation = self._observation([reply.observation for reply in replies])
        if infos is None:
            infos = self.infos([reply.info for reply in replies])
        return observation, infos

    def joined_own(self, replies: list[m.Value]) -> dict[Any, Any]:
        """Join the infos of all sub-environments, which came singly, as Gymnasium does.
        Raises ``RemoteEnvError``: Gymnasium would raise, too.
        """
        own = self.own_pairs(replies)
        forms = [form for _, _, form in own]
        return self._joined_pairs([(index, info) for index, info, _ in own], forms)

    def _joined_pairs(
        self, pairs: batches.Pairs, forms: Sequence[batches.Forms] = ()
    ) -> dict[Any, Any]:
        most = DEFAULT_LIMITS.message_bytes
        try:
            infos = batches.join_pairs(pairs, self.count, most, forms)
        except FAULTS as error:
            if isinstance(error, (EnvHubError, MemoryError)):
                raise
            name = type(error).__name__
            raise remote_error(name, name, one_line(str(error), _SHOWN)) from error
        return self._restored(infos)

    def own_pairs(self, replies: list[m.Value]) -> list[OwnInfo]:
        """The infos of all sub-environments, each with its index and its forms.
        Trust: input from the worker. Raises ``RemoteProtocolError``: the infos are malformed, or
        the index of one is out of range.
        """
        pairs: list[OwnInfo] = []
        start = 0
        for reply, size in zip(replies, self._sizes, strict=True):
            each = _own_infos(reply.value, size)
            pairs += [(start + index, info, forms) for index, info, forms in each]
            start += size
        return pairs

    def infos(self, parts: list[dict[Any, Any]]) -> dict[Any, Any]:
        """Join the shards' infos into one mapping."""
        if len(parts) == 1:
            return self._restored(parts[0])
        if self.apart:
            return self._beside(parts)
        return self._restored(batches.join_infos(parts, self._sizes))

    def _beside(self, parts: Sequence[dict[Any, Any]]) -> dict[Any, Any]:
        """Join the shards' infos that came apart. Trust: input from the worker."""
        own: dict[Any, Any] = {}
        marks: list[dict[Any, Any]] = []
        for part, (start, _), size in zip(parts, self.slices, self._sizes, strict=True):
            marks.append({})
            for key, value in part.items():
                if type(key) is not int:
                    marks[-1][key] = value
                elif 0 <= key < 2 * size:
                    own[start + key % size + key // size * self.count] = value
        try:
            return {**batches.join_infos(marks, self._sizes), **own}
        except batches.Misfit as error:
            raise RemoteProtocolError(_NOT_ONE_EACH) from error

    def joined(self, infos: dict[Any, Any]) -> dict[Any, Any]:
        """Infos as ``VectorEnv`` returns them, also if they came apart; raises as ``each``."""
        if not self.apart:
            return infos
        pairs = [(at, pair) for at, some in enumerate(self.each(infos)) for pair in some]
        return self._joined_pairs(pairs)

    def each(self, infos: dict[Any, Any]) -> list[list[dict[Any, Any]]]:
        """Each sub-environment's infos, in order, from infos that came apart.
        Raises ``RemoteEnvError``: a reward is not a number.
        """
        with UNTRUSTED:
            own, _, reward = self.own(infos)
        if reward:
            shown = one_line(batches.reward_misfit(reward[0], 0), _SHOWN)
            raise remote_error("ValueError", "ValueError", shown)
        return own

    def own(self, infos: dict[Any, Any]) -> Own:
        """Each sub-environment's infos, from infos that came apart. A single sub-environment also
        has marks of which members of its observation are Python numbers, and a reward that is not
        a number. Trust: input from the worker.
        """
        places = sorted(key for key in infos if type(key) is int and key >= 0)
        scalars, reward = infos.get(batches.APART_SCALARS, ()), infos.get(batches.APART_REWARD, ())
        if type(reward) is not tuple or len(reward) > 1:
            raise RemoteProtocolError("the worker sent more than one reward")
        own: list[list[dict[Any, Any]]] = [[] for _ in range(self.count)]
        for index in places:
            if type(infos[index]) is not dict or index >= 2 * self.count:
                raise RemoteProtocolError(_NOT_ONE_EACH)
            own[index % self.count].append(infos[index])
        if type(scalars) is not tuple:
            raise RemoteProtocolError(_NOT_ONE_EACH)
        for key in infos:  # our masks of the sub-environments that were lost and came back
            if f"_{key}" in infos:
                for at in np.flatnonzero(infos[f"_{key}"]):
                    own[at] = [*own[at][:-1], {**(own[at] or [{}])[-1], key: True}]
        return own, scalars, reward

    def _restored(self, infos: dict[Any, Any]) -> dict[Any, Any]:
        final = infos.get("final_obs") if self.restores else None
        # a repository's own vector class may return any final_obs: other forms stay as they are
        if type(final) is np.ndarray and final.dtype == object and final.ndim == 1:
            for index, member in enumerate(final):
                final[index] = batches.restore(self._space, member)
        return infos

    def info(self, reply: m.Message | None) -> dict[Any, Any]:
        """A shard's infos from its reply; empty for None. Raises if the reply has an exception."""
        if reply is None:
            return {}
        [answer] = all_replies([reply], m.Value)
        if type(answer.value) is not dict:
            raise RemoteProtocolError("the worker's infos are not a mapping")
        return answer.value

    def one_each(self, operation: str, replies: Sequence[m.Value | m.WatchDone]) -> tuple[Any, ...]:
        """Join the replies' tuples into one value for each sub-environment."""
        gathered: list[Any] = []
        for reply, size in zip(replies, self._sizes, strict=True):
            if type(reply.value) is not tuple or len(reply.value) != size:
                raise RemoteProtocolError(f"the worker's {operation} does not have one result each")
            gathered += reply.value
        return tuple(gathered)

    def _observation(self, parts: list[Any]) -> Any:
        if self._declared:
            for part, size in zip(parts, self._sizes, strict=True):
                if not batches.conforms(self._space, part, size):
                    raise RemoteProtocolError(
                        f"the worker sent an observation that is not a batch of {self._space}"
                    )
        joined = parts[0] if len(parts) == 1 else batches.join(self._space, parts)
        if not (self.restores and batches.conforms(self._space, joined, self.count)):
            return joined
        return batches.restore_batch(self._space, joined)

    def _per_env(self, name: str, parts: list[Any]) -> Any:
        for part, size in zip(parts, self._sizes, strict=True):
            shape = getattr(part, "shape", None)
            if not shape or shape[0] != size:
                raise RemoteProtocolError(f"the worker sent {name} that do not fit num_envs")
            if not (_numeric(part) and (not self._declared or self._is_own(name, part))):
                raise RemoteProtocolError(f"the worker sent {name} of a wrong dtype or shape")
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _is_own(self, name: str, part: Any) -> bool:
        """Whether our own vector environments return such an array, so that it can be joined."""
        if name != "rewards":
            return _flags(part)
        # AsyncVectorEnv permits several rewards for each sub-environment
        return bool(part.ndim == 1 or not self.manifest.sync)


def _own_infos(value: Any, size: int) -> Sequence[OwnInfo]:
    """Check the infos of one shard, each with index and forms. Trust: input from the worker."""
    each: Any = value if type(value) is tuple else (None,)
    for own in each:
        if type(own) is not tuple or list(map(type, own)) != [int, dict, dict]:
            raise RemoteProtocolError(_NOT_ONE_EACH)
        if not 0 <= own[0] < size:
            raise RemoteProtocolError("the worker's infos are of an unknown sub-environment")
        if not batches.are_forms(own[2]):
            raise RemoteProtocolError("the worker's infos have an unknown form")
    return cast("Sequence[OwnInfo]", each)


def all_replies(replies: Sequence[m.Message], kind: type[m.M] | tuple[type[m.M], ...]) -> list[m.M]:
    """Return the shards' replies if all are of this kind, or of one of several.
    Raises ``EnvHubError``: the repository raised in any shard; ``RemoteProtocolError``: a reply is
    of another kind.
    """
    others = [reply for reply in replies if type(reply) is not kind]
    for reply in others:
        check_reply(reply)
    for reply in others:
        typed_reply(reply, kind)
    return cast("list[m.M]", replies)


def is_batch(part: Any) -> bool:
    """Whether this is an array or a tensor. A shape alone does not tell: a space has one, too."""
    return isinstance(part, np.ndarray) or hasattr(type(part), "__array__")


def _numeric(part: Any) -> bool:
    """Whether this is a batch of numbers or booleans, as a tensor always is."""
    return is_batch(part) and (not isinstance(part, np.ndarray) or part.dtype.kind in "biuf")


def _flags(part: Any) -> bool:
    """Whether this is an array of booleans in one dimension."""
    return isinstance(part, np.ndarray) and part.dtype.kind == "b" and part.ndim == 1
