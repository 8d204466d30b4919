"""Plays episodes in a vector environment, and counts them correctly in every autoreset mode.

Each sub-environment has a fixed quota of episodes. Taking the first N that finish anywhere would
favour short ones.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import CustomSpaceError
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from envhub_sandbox.errors import EnvHubError
from envhub_worker.protocol.manifest.manifest import AUTORESET_MODES

MAX_COMPONENTS = 64
"""The most components of a vector reward that are reported one by one."""
_FINAL_KEYS = ("final_obs", "final_observation", "final_info")

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]


class RolloutError(EnvHubError):
    """The environment's results cannot be counted as episodes."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One finished episode.

    Attributes:
        sub_env: Index of the sub-environment that played it.
        returns: The sum of rewards, for each component of the reward; one if it is a number.
        terminated: Whether it terminated; otherwise it was truncated.
        success: ``is_success`` of the last step's info, if there was one.
    """

    sub_env: int
    returns: tuple[float, ...]
    length: int
    terminated: bool
    success: bool | None


@dataclass
class Rollout:
    """The results of a rollout.

    Attributes:
        episodes: The finished episodes within the quota, in the order in which they ended.
        steps: The steps of all sub-environments; resets do not count.
        first_step_s: Seconds from the call of ``reset`` to the first step's result.
        complete: Whether every quota was met.
    """

    episodes: list[Episode] = field(default_factory=list)
    steps: int = 0
    step_s: float = 0.0
    first_step_s: float = 0.0
    complete: bool = False

    @property
    def steps_per_s(self) -> float:
        """Steps of sub-environments per second spent in ``step``."""
        return self.steps / self.step_s if self.step_s > 0 else 0.0


def quotas(num_envs: int, episodes: int) -> list[int]:
    """The number of episodes of each sub-environment: even, and the first ones play the rest."""
    return [(episodes + num_envs - 1 - index) // num_envs for index in range(num_envs)]


def autoreset_mode(env: VectorEnv[Any, Any, Any]) -> str | None:
    """``"NextStep"``, ``"SameStep"``, ``"Disabled"``, or None if the metadata does not say."""
    mode = (env.metadata or {}).get("autoreset_mode")
    mode = getattr(mode, "value", mode)
    return mode if mode in AUTORESET_MODES else None


class EpisodeCounter:
    """Counts episodes from the results of vector steps, which the caller makes.

    If the metadata does not state the autoreset mode, the first step that ends an episode shows it:
    infos with the final observation mean SAME_STEP; otherwise NEXT_STEP is assumed, as Gymnasium's
    own wrappers do.

    Attributes:
        counted: Finished episodes within the quota.
        steps: Steps of sub-environments so far.
        reset_mask: Sub-environments that must be reset before the next step, bool ``(num_envs,)``,
            or None.
    """

    def __init__(self, num_envs: int, episodes: int, mode: str | None) -> None:
        self.counted: list[Episode] = []
        self.steps = 0
        self.reset_mask: Bools | None = None
        self._left = np.array(quotas(num_envs, episodes))
        self._mode = mode
        self._resetting: Bools = np.zeros(num_envs, np.bool_)
        self._lengths = np.zeros(num_envs, np.int64)
        self._returns: Floats | None = None

    @property
    def finished(self) -> bool:
        """Whether every quota is met."""
        return not self._left.any()

    def wants(self, sub_env: int) -> bool:
        """Whether a sub-environment still has episodes to play."""
        return bool(self._left[sub_env] > 0)

    def step(self, rewards: Any, terminations: Any, truncations: Any, infos: Any) -> None:
        """Count one vector step.
        Raises ``RolloutError``: rewards or flags have another shape than ``(num_envs, ...)``.
        """
        played = ~self._resetting
        terminated = self._flags("terminations", terminations)
        done = (terminated | self._flags("truncations", truncations)) & played
        numbers = self._numbers(rewards)
        if self._returns is None:
            self._returns = np.zeros_like(numbers)
        if numbers.shape != self._returns.shape:
            raise RolloutError(
                f"rewards changed their shape from {self._returns.shape} to {numbers.shape}"
            )
        self._returns[played] += numbers[played]
        self._lengths[played] += 1
        self.steps += int(played.sum())
        for index in np.flatnonzero(done):
            self._end(int(index), bool(terminated[index]), infos)
        if self._mode is None and done.any():
            final = isinstance(infos, Mapping) and any(key in infos for key in _FINAL_KEYS)
            self._mode = "SameStep" if final else "NextStep"
        self.reset_mask = done if self._mode == "Disabled" and done.any() else None
        self._resetting = done if self._mode == "NextStep" else np.zeros_like(done)

    def _end(self, index: int, terminated: bool, infos: Any) -> None:
        assert self._returns is not None
        if self._left[index] > 0:
            self._left[index] -= 1
            self.counted.append(
                Episode(
                    sub_env=index,
                    returns=tuple(float(value) for value in np.atleast_1d(self._returns[index])),
                    length=int(self._lengths[index]),
                    terminated=terminated,
                    success=success_of(infos, index),
                )
            )
        self._returns[index] = 0
        self._lengths[index] = 0

    def _numbers(self, rewards: Any) -> Floats:
        count = len(self._left)
        try:
            numbers = np.array(on_cpu(rewards), np.float64)
        except (TypeError, ValueError) as error:
            raise RolloutError(f"rewards are not numbers: {error}") from error
        if numbers.ndim not in (1, 2) or numbers.shape[0] != count:
            raise RolloutError(f"rewards have the shape {numbers.shape}, not ({count},)")
        if numbers.ndim == 2 and not 1 <= numbers.shape[1] <= MAX_COMPONENTS:
            raise RolloutError(
                f"rewards have {numbers.shape[1]} components; 1 to {MAX_COMPONENTS} are reported"
            )
        return numbers

    def _flags(self, name: str, values: Any) -> Bools:
        flags = np.asarray(on_cpu(values))
        if flags.shape != self._left.shape or flags.dtype.kind not in "biu":
            raise RolloutError(f"{name} are {flags.dtype} {flags.shape}, not bool (num_envs,)")
        return flags.astype(np.bool_)


def success_of(infos: Any, index: int) -> bool | None:
    """``is_success`` of one sub-environment, from the final infos if there are any.

    Trust: infos are input from the worker; a value of an unexpected form counts as not stated.
    """
    if not isinstance(infos, Mapping):
        return None
    for source in (infos.get("final_info"), infos):
        success = _success_in(source, index)
        if isinstance(success, (bool, int, float, np.bool_, np.number)):
            return bool(success)
    return None


def _success_in(infos: Any, index: int) -> Any:
    try:
        if not isinstance(infos, Mapping):  # Gymnasium before 1.0: an array of dicts
            return infos[index].get("is_success")
        mask = infos.get("_is_success")
        if mask is not None and not mask[index]:
            return None
        return np.asarray(on_cpu(infos["is_success"]))[index].item()
    except (AttributeError, IndexError, KeyError, TypeError, ValueError):
        return None


def on_cpu(value: Any) -> Any:
    """A tensor as an array; any other value unchanged."""
    is_tensor = hasattr(value, "tolist") and hasattr(value, "cpu")
    return value.cpu().numpy() if is_tensor else value


def rollout(
    env: VectorEnv[Any, Any, Any],
    *,
    episodes: int,
    seed: int,
    actions: str = "random",
    max_steps: int | None = None,
    observe: Callable[[EpisodeCounter], None] = lambda counter: None,
) -> Rollout:
    """Play until every sub-environment has met its quota, ``episodes`` in total.

    Args:
        env: The environment, which stays open.
        seed: For ``reset`` and the actions: the same seed gives the same result.
        actions: ``"random"`` samples from the seeded space; ``"zero"`` is as near to zero as the
            space allows.
        max_steps: Vector steps after which to give up; None for no bound.
        observe: Called after the reset and after every step.
    Raises ``RolloutError``: the environment's answers cannot be counted, or its space is unknown.
    """
    counter = EpisodeCounter(env.num_envs, episodes, autoreset_mode(env))
    result = Rollout(episodes=counter.counted)
    begun, taken = time.perf_counter(), 0
    try:
        zero = zero_action(env.action_space) if actions == "zero" else None
        env.action_space.seed(seed)
        env.reset(seed=seed)
        observe(counter)
        while not counter.finished and (max_steps is None or taken < max_steps):
            action = env.action_space.sample() if zero is None else zero
            _step(env, action, counter, result)
            taken += 1
            if taken == 1:
                result.first_step_s = time.perf_counter() - begun
            observe(counter)
    except gym.error.CustomSpaceError as error:
        raise RolloutError(
            f"its action space is a class of its own ({str(env.single_action_space)[:200]}), for "
            "which envhub cannot make actions; use it from Python"
        ) from error
    result.steps, result.complete = counter.steps, counter.finished
    return result


def _step(
    env: VectorEnv[Any, Any, Any], action: Any, counter: EpisodeCounter, result: Rollout
) -> None:
    if counter.reset_mask is not None:
        env.reset(options={"reset_mask": counter.reset_mask})
    begun = time.perf_counter()
    _, rewards, terminations, truncations, infos = env.step(action)
    result.step_s += time.perf_counter() - begun
    counter.step(rewards, terminations, truncations, infos)


def zero_action(space: gym.Space[Any]) -> Any:
    """A member of ``space`` that is zero, or as near to zero as the space allows.
    Raises ``gymnasium.error.CustomSpaceError``: the space is not of a class of Gymnasium.
    """
    match space:
        case spaces.Box():
            return np.array(np.clip(np.zeros(space.shape), space.low, space.high), space.dtype)
        case spaces.Discrete():
            start = int(space.start)
            return space.dtype.type(min(max(0, start), start + int(space.n) - 1))
        case spaces.MultiDiscrete():
            return np.clip(0, space.start, space.start + space.nvec - 1).astype(space.dtype)
        case spaces.MultiBinary():
            return np.zeros(space.shape, space.dtype)
        case spaces.Text():
            return space.character_list[0] * space.min_length if space.min_length else ""
        case spaces.Dict():
            return {key: zero_action(member) for key, member in space.spaces.items()}
        case spaces.Tuple():
            return tuple(map(zero_action, space.spaces))
        case spaces.Sequence():
            empty = gym.vector.utils.create_empty_array
            return empty(space.feature_space, 0) if space.stack else ()
        case spaces.Graph():
            nodes = np.array([zero_action(space.node_space)])
            return spaces.GraphInstance(nodes=nodes, edges=None, edge_links=None)
        case spaces.OneOf():
            return 0, zero_action(space.spaces[0])
    raise CustomSpaceError(f"no zero action is known for {type(space).__name__}")
