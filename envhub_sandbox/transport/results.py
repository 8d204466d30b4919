"""Checks the shards' replies against the manifest, and joins them into one batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from envhub_sandbox.errors import EnvHubError, RemoteProtocolError, remote_error
from envhub_sandbox.transport import infos as infos_of
from envhub_sandbox.transport.replies import check_reply, typed_reply
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.errors import FAULTS, UNTRUSTED
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.manifest.manifest import EnvManifest
from envhub_worker.protocol.spaces import batches

_SHOWN = 500
StepResult = tuple[Any, Any, Any, Any, dict[Any, Any]]
Own = tuple[list[list[dict[Any, Any]]], Sequence[bool], tuple[Any, ...]]
"""Infos of each sub-environment, which members are Python numbers, and an odd reward, if any."""


class Results:
    """Joins the replies for one environment. Trust: input from the worker.
    ``manifest``: the description of the environment that the worker declared.
    ``bounds``: the slices of the sub-environments, in the order of the replies.

    Attributes:
        count: The number of sub-environments: all, or those of one worker of several.
        slices: The same as ``bounds``, counted from the first of these sub-environments.
        apart: Whether infos are returned as each sub-environment returned them: ``own`` and
            ``joined`` read these.
        is_sliced: Whether infos come as those of slices, which are to be joined.
        single: Whether a single environment is shown, which the runner never resets by itself.
        restores: Whether members of the space lose their class on the wire, and get it back here.
        max_bytes: How much larger than their own the workers' infos may be when joined.
    """

    def __init__(self, manifest: EnvManifest, bounds: Sequence[tuple[int, int]]) -> None:
        self.manifest = manifest
        self.bounds = list(bounds)
        self.apart = self.single = False
        self.max_bytes = DEFAULT_LIMITS.message_bytes
        self._space = manifest.single_observation_space
        self._declared = manifest.shardable
        self._sizes = [stop - start for start, stop in bounds]  # rows of each shard
        first = self.bounds[0][0]
        # Rows of our own batch.
        self.slices = [(start - first, stop - first) for start, stop in bounds]
        self.count = sum(self._sizes)
        self._is_part = self._declared and self.count < manifest.num_envs
        self.is_sliced = self._declared and self._sizes != [manifest.num_envs]
        self.restores = batches.restores(self._space)

    def step(self, replies: list[m.StepDone]) -> StepResult:
        """The tuple that ``VectorEnv.step`` returns."""
        return (
            self._observation([reply.observation for reply in replies]),
            self._per_env("rewards", [reply.rewards for reply in replies]),
            self._per_env("terminations", [reply.terminations for reply in replies]),
            self._per_env("truncations", [reply.truncations for reply in replies]),
            self.infos([reply.info for reply in replies]),
        )

    def joined_steps(self, parts: Sequence[StepResult]) -> StepResult:
        """Join several workers' checked results of a step; returns and raises as ``step``."""
        observations, rewards, terminations, truncations, own = zip(*parts, strict=True)
        if len({part.shape[1:] for part in rewards}) > 1:
            raise RemoteProtocolError("the workers sent rewards of different shapes")
        return (
            batches.join(self._space, observations),
            np.concatenate(rewards),
            np.concatenate(terminations),
            np.concatenate(truncations),
            self.infos(own),
        )

    def joined_resets(
        self, parts: Sequence[tuple[Any, dict[Any, Any]]]
    ) -> tuple[Any, dict[Any, Any]]:
        """Join several workers' results of a reset."""
        observations, own = zip(*parts, strict=True)
        return batches.join(self._space, observations), self.infos(own)

    def reset(self, replies: list[m.ResetDone]) -> tuple[Any, dict[Any, Any]]:
        """The tuple that ``VectorEnv.reset`` returns."""
        observation = self._observation([reply.observation for reply in replies])
        return observation, self.infos([reply.info for reply in replies])

    def infos(self, parts: Sequence[dict[Any, Any]]) -> dict[Any, Any]:
        """Join the shards' infos into one mapping, which is ``unjoined`` if others are to be joined
        with it. Trust: input from the worker.
        Raises ``RemoteEnvError``: Gymnasium would raise, too.
        """
        if not self.is_sliced:
            return parts[0] if self.apart else self._restored(parts[0])
        if not any(parts):
            return {}
        with UNTRUSTED:
            columns, each = infos_of.read(parts, self._sizes)
        if not self.unjoined:
            return self._joined(columns, each)
        return columns or (parts[0] if len(parts) == 1 else infos_of.unjoined(each))

    @property
    def unjoined(self) -> bool:
        """Whether infos are returned unjoined, to the caller or to be joined with others."""
        return self.apart or self._is_part

    def joined(self, infos: dict[Any, Any]) -> dict[Any, Any]:
        """Infos as ``VectorEnv`` returns them, also if they are unjoined; raises as ``infos`` and
        ``each``.
        """
        if not (self.unjoined and infos):
            return infos
        with UNTRUSTED:
            columns, each = infos_of.read([infos], [self.count])
        _refuse_reward(infos)
        return self._joined(columns, each)

    def _joined(self, columns: dict[Any, Any] | None, each: infos_of.OwnInfos) -> dict[Any, Any]:
        if columns is not None:
            return infos_of.without_classes(columns)
        try:
            return self._restored(infos_of.joined(each, self.max_bytes))
        except FAULTS as error:
            if isinstance(error, (EnvHubError, MemoryError)):
                raise
            name = type(error).__name__
            raise remote_error(name, name, one_line(str(error), _SHOWN)) from error

    def each(self, infos: dict[Any, Any]) -> list[list[dict[Any, Any]]]:
        """Each sub-environment's infos, in order, from unjoined infos.
        Raises ``RemoteEnvError``: a reward is not a number.
        """
        with UNTRUSTED:
            own, *_ = self.own(infos)
        _refuse_reward(infos)
        return own

    def own(self, infos: dict[Any, Any]) -> Own:
        """Each sub-environment's infos, from unjoined infos. A single sub-environment also has
        marks of which members of its observation are Python numbers, and a reward that is not a
        number. Trust: input from the worker.
        """
        scalars, reward = infos.get(batches.APART_SCALARS, ()), infos.get(batches.APART_REWARD, ())
        if type(reward) is not tuple or len(reward) > 1 or type(scalars) is not tuple:
            raise RemoteProtocolError("the worker sent more than one reward")
        each = infos_of.each_of(infos, self.count)
        return [[info for info, _ in some] for some in each], scalars, reward

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
                        "the worker sent an observation that is not a batch of "
                        f"{one_line(str(self._space), _SHOWN)}"
                    )
        joined = parts[0] if len(parts) == 1 else batches.join(self._space, parts)
        return batches.restore_batch(self._space, joined) if self.restores else joined

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
            return isinstance(part, np.ndarray) and part.dtype.kind == "b" and part.ndim == 1
        # AsyncVectorEnv permits several rewards for each sub-environment
        return bool(part.ndim == 1 or not self.manifest.sync)


def _refuse_reward(infos: dict[Any, Any]) -> None:
    """Raise ``RemoteEnvError`` if unjoined infos, which ``own`` has read, have an odd reward."""
    for reward in infos.get(batches.APART_REWARD, ()):
        shown = one_line(batches.reward_misfit(reward, 0), _SHOWN)
        raise remote_error("ValueError", "ValueError", shown)


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
