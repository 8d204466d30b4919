"""Every action and observation checked against its space, to test an environment.

It looks at each value, which takes time. Shapes, dtypes and structures are checked in any case;
values are not, because many environments leave their own bounds and train all the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import count, islice
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv

from envhub_sandbox.errors import ActionError, ObservationError
from envhub_sandbox.session.parts.fleet_session import AnySession
from envhub_sandbox.session.parts.in_flight import Received, Rows
from envhub_sandbox.transport.results import StepResult
from envhub_sandbox.vector.tracebacks import short_traceback
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.spaces.spaces import ARRAY_SPACES, OpaqueSpace

_SHOWN = 200


class ValidatedVectorEnv(SandboxVectorEnv, VectorEnv[Any, Any, Any]):
    """A ``SandboxVectorEnv`` that refuses what is outside of its spaces.

    Raises:
        ActionError: An action is outside of its space; nothing was sent.
        ObservationError: An observation is. The environment is still usable.
    """

    def __init__(self, session: AnySession) -> None:
        super().__init__(session)
        # those of a batch that is no batch of the single space: it is one member of its own
        self._own_observations, own_actions = (
            session.manifest.own_batch(name) for name in ("observation_space", "action_space")
        )
        actions = self.single_action_space, self.action_space, self.num_envs, own_actions
        members = partial(_members, *actions)
        space = self.single_action_space if own_actions is None else own_actions
        # not a bound method: it would refer to this environment (interruption.md, rule 13)
        self._checks = members, space
        self._read_actions = partial(_read_and_check, self._read_actions, *self._checks)

    def _read_rows(self, rows: Rows, actions: Any) -> Any:
        read = partial(super()._read_rows, rows)
        return _read_and_check(read, *self._checks, actions, rows.named)

    def _end_reset(self, timeout_s: float | None) -> tuple[Any, dict[Any, Any]]:
        """What both ``reset`` and ``reset_wait`` end with, checked."""
        observations, infos = super()._end_reset(timeout_s)
        self._check_batch("reset", observations)
        return observations, infos

    @short_traceback
    def step(self, actions: Any) -> StepResult:
        """As ``SandboxVectorEnv.step``, checked."""
        return self._checked(super().step(actions))

    @short_traceback
    def step_wait(self, timeout: float | None = None) -> StepResult:
        """As ``SandboxVectorEnv.step_wait``, checked."""
        return self._checked(super().step_wait(timeout))

    @short_traceback
    def recv(self, min_ready: int | None = None, timeout: float | None = None) -> Received:
        """As ``SandboxVectorEnv.recv``, checked."""
        received = super().recv(min_ready, timeout)
        self._checked(received[:-1], received.env_ids.tolist())
        return received

    def _checked(self, result: StepResult, ids: Sequence[int] = ()) -> StepResult:
        self._check_batch("step", result[0], ids)
        finals = result[4].get("final_obs")
        if isinstance(finals, np.ndarray) and finals.dtype == object:
            self._check("the last step of an episode", finals, ids=ids)
        return result

    def _check_batch(self, operation: str, observations: Any, ids: Sequence[int] = ()) -> None:
        with self._session.repository.named():
            try:
                declared = self.single_observation_space, self.observation_space
                own = self._own_observations
                each = _members(*declared, self.num_envs, own, observations)
                members = list(islice(each, len(ids) or None))
            except Exception as error:  # a vector environment of the repository's own gave it
                text = f"{operation} returned no batch of observations for {self.observation_space}"
                raise ObservationError(text, observation=observations) from error
        self._check(operation, members, self._own_observations, ids)

    def _check(
        self,
        operation: str,
        observations: Iterable[Any],
        own: gym.Space[Any] | None = None,
        ids: Sequence[int] = (),
    ) -> None:
        """``ids``: of the sub-environments that gave them; of all in order for none."""
        space = self.single_observation_space if own is None else own
        with self._session.repository.named():
            for index, observation in zip(ids or count(), observations, strict=False):
                if observation is not None and not holds(space, observation):
                    raise ObservationError(
                        f"{operation} returned an observation outside its space: sub-environment "
                        f"{index} gave {_shown(observation)}, which is not in {space}",
                        index=index,
                        observation=observation,
                    )


def holds(space: gym.Space[Any], member: Any) -> bool:
    """Whether a value is in a space; numbers of another dtype count as what they are worth."""
    if isinstance(space, OpaqueSpace):
        return True  # its members are not known here
    if isinstance(space, spaces.Dict):
        if not isinstance(member, dict) or member.keys() != space.spaces.keys():
            return False
        return all(holds(sub, member[key]) for key, sub in space.spaces.items())
    if isinstance(space, spaces.Tuple):
        if not isinstance(member, tuple) or len(member) != len(space.spaces):
            return False
        return all(map(holds, space.spaces, member))
    try:
        if isinstance(space, ARRAY_SPACES):
            member = np.asarray(member)
            if member.dtype != space.dtype and np.can_cast(member.dtype, space.dtype, "same_kind"):
                member = member.astype(space.dtype)
        return bool(space.contains(member))
    except (AttributeError, TypeError, ValueError):
        return False  # it is nothing of the kind


def _read_and_check(
    read: Callable[[Any], Any],
    members: Callable[[Any], Iterable[Any]],
    single: gym.Space[Any],
    actions: Any,
    ids: Sequence[int] = (),
) -> Any:
    batch = read(actions)
    for index, action in zip(ids or count(), members(batch), strict=False):
        if not holds(single, action):
            raise ActionError(
                f"the action of sub-environment {index} is outside of its space: "
                f"{_shown(action)} is not in {single}"
            )
    return batch


def _members(
    single: gym.Space[Any],
    space: gym.Space[Any],
    count: int,
    own: gym.Space[Any] | None,
    batch: Any,
) -> Iterable[Any]:
    """One value for each sub-environment; the batch where it has a space of its own."""
    if own is not None:
        return [batch]
    if isinstance(space, OpaqueSpace):
        return cast("Iterable[Any]", batch)
    return batches.members(single, space, batch, count)


def _shown(value: Any) -> str:
    """Trust: it may be the worker's."""
    return one_line(repr(value), _SHOWN)
