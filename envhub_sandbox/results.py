"""Checks what the shards sent against what was declared, and joins it into one batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from envhub_sandbox.errors import RemoteProtocolError
from envhub_sandbox.fast_lane import LaneShard, Outcome
from envhub_sandbox.jail import check, typed
from envhub_worker.protocol import batches, slabs
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.manifest import EnvManifest

StepResult = tuple[Any, Any, Any, Any, dict[Any, Any]]


class Results:
    """Joins the replies for one environment. Trust: input from the worker.

    Args:
        manifest: What the worker declared.
        bounds: The slices of the sub-environments, in the order of the replies.
    """

    def __init__(self, manifest: EnvManifest, bounds: Sequence[tuple[int, int]]) -> None:
        self._space = manifest.single_observation_space
        self._declared = manifest.shardable
        self._sizes = [stop - start for start, stop in bounds]
        self._restores = batches.restores(self._space)

    def step(self, replies: list[m.StepDone]) -> StepResult:
        """What ``VectorEnv.step`` returns."""
        return (
            self._observation([reply.observation for reply in replies]),
            self._per_env("rewards", [reply.rewards for reply in replies]),
            self._per_env("terminations", [reply.terminations for reply in replies]),
            self._per_env("truncations", [reply.truncations for reply in replies]),
            self.infos([reply.info for reply in replies]),
        )

    def reset(self, replies: list[m.ResetDone]) -> tuple[Any, dict[Any, Any]]:
        """What ``VectorEnv.reset`` returns."""
        observation = self._observation([reply.observation for reply in replies])
        return observation, self.infos([reply.info for reply in replies])

    def reset_done(self, observation: Any, reply: m.Message) -> m.ResetDone:
        """A shard's reply to a reset by the fast lane."""
        check(reply)
        return m.ResetDone(observation, self._info(typed(reply, m.Value).value))

    def infos(self, parts: list[dict[Any, Any]]) -> dict[Any, Any]:
        """One mapping of the shards' infos."""
        infos = parts[0] if len(parts) == 1 else batches.join_infos(parts, self._sizes)
        final = infos.get("final_obs") if self._restores else None
        # one that is something else is the repository's own, who has a step of its own
        if type(final) is np.ndarray and final.dtype == object and final.ndim == 1:
            for index, member in enumerate(final):
                final[index] = batches.restore(self._space, member)
        return infos

    def lane_info(
        self, outcome: Outcome, shard: LaneShard, fetch: Callable[[], m.Message]
    ) -> dict[Any, Any]:
        """A shard's infos of a step by the fast lane; ``fetch`` asks for what did not fit.

        Raises:
            RemoteEnvError: The environment raised.
        """
        kind, message = outcome
        if kind == slabs.COLUMNS:
            return shard.columns()
        if kind == slabs.FETCH:
            message = fetch()
        if message is None:
            return {}
        check(message)
        return self._info(typed(message, m.Value).value)

    def one_each(self, what: str, replies: list[m.Value]) -> tuple[Any, ...]:
        """One value for each sub-environment."""
        gathered: list[Any] = []
        for reply, size in zip(replies, self._sizes, strict=True):
            if type(reply.value) is not tuple or len(reply.value) != size:
                raise RemoteProtocolError(f"the worker's {what} does not hold one result each")
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
        if not (self._restores and batches.conforms(self._space, joined, sum(self._sizes))):
            return joined
        return batches.restore_batch(self._space, joined)

    def _per_env(self, name: str, parts: list[Any]) -> Any:
        for part, size in zip(parts, self._sizes, strict=True):
            shape = getattr(part, "shape", None)
            if not shape or shape[0] != size:
                raise RemoteProtocolError(f"the worker sent {name} that do not fit num_envs")
            if not (_numeric(part) and (not self._declared or name == "rewards" or _flags(part))):
                raise RemoteProtocolError(f"the worker sent {name} of a wrong dtype or shape")
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    @staticmethod
    def _info(part: Any) -> dict[Any, Any]:
        if type(part) is not dict:
            raise RemoteProtocolError("the worker's infos are not a mapping")
        return part


def _numeric(part: Any) -> bool:
    """Whether these are numbers or booleans; a tensor's always are."""
    return not isinstance(part, np.ndarray) or part.dtype.kind in "biuf"


def _flags(part: Any) -> bool:
    """Whether this is one boolean each."""
    return isinstance(part, np.ndarray) and part.dtype.kind == "b" and part.ndim == 1
