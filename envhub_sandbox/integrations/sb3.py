"""Sandboxed environments for Stable-Baselines3.

    >>> env = SandboxVecEnv.make("org/repo@<commit>", n_envs=8)
    >>> PPO("MlpPolicy", env).learn(100_000)

Followed: ``stable_baselines3.common.vec_env.DummyVecEnv``, for results and for the order in which
environments are reset: what is trained here has the same weights as what is trained there.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import iterate
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from envhub_sandbox.factory.make_env import make_env
from envhub_sandbox.vector.single_env import info_of
from envhub_sandbox.vector.suites import choose, closed_if_it_fails
from envhub_worker.protocol.errors import UNTRUSTED

_Indices = int | Iterable[int] | None


class SandboxVecEnv(VecEnv):
    """A vector environment as Stable-Baselines3's ``VecEnv``.

    A ``VecEnv`` resets what has ended in the same step, and hands over the last observation as
    ``info["terminal_observation"]``. Where the vector environment does not do so itself
    (``AutoresetMode.SAME_STEP``), those that have ended are reset here, by ``reset_mask``.

    Args:
        vector: What ``make_env`` made.

    Attributes:
        vector: The same, for ``sandbox`` and the rest.
    """

    def __init__(self, vector: VectorEnv[Any, Any, Any]) -> None:
        self.vector: Any = vector
        mode = getattr(vector.metadata.get("autoreset_mode"), "value", None)
        self._resets_in_the_same_step = mode == "SameStep"
        super().__init__(
            vector.num_envs, vector.single_observation_space, vector.single_action_space
        )
        metadata = vector.metadata.items()  # the mode is a vector environment's alone
        self.metadata = {key: value for key, value in metadata if key != "autoreset_mode"}

    @classmethod
    def make(
        cls,
        ref: Any,
        n_envs: int = 1,
        *,
        suite: str | None = None,
        task: int | str | None = None,
        **options: Any,
    ) -> SandboxVecEnv:
        """The environments of a repository.

        Args:
            ref: What ``make_env`` takes.
            n_envs: Number of sub-environments.
            suite: Which suite of the repository; needed where there are several.
            task: Which task of it; likewise.
            options: ``make_env``'s.

        Raises:
            ValueError: The repository has several environments, or not the one that is named.
            EnvHubError: As ``make_env``.
        """
        with closed_if_it_fails(make_env(ref, n_envs=n_envs, **options)) as suites:
            return cls(choose(suites, suite, task))

    def reset(self) -> Any:
        """Observations, with the seeds of ``seed()`` and the options of ``set_options()``."""
        seeds, options = self._seeds, self._options
        self._reset_seeds()
        self._reset_options()
        if all(one == options[0] for one in options):
            batch, infos = self.vector.reset(seed=seeds, options=options[0] or None)
            with UNTRUSTED:
                self.reset_infos = self._infos(infos)
            return batch
        for index, own in enumerate(options):
            mask = np.arange(self.num_envs) == index
            batch, infos = self.vector.reset(seed=seeds, options={**own, "reset_mask": mask})
            with UNTRUSTED:
                self.reset_infos[index] = info_of(infos, index, self.num_envs)
        return batch

    def step_async(self, actions: np.ndarray) -> None:
        """Send the actions, ``(num_envs, ...)``."""
        self.vector.step_async(actions)

    def step_wait(self) -> Any:
        """Observations, rewards float32 ``(num_envs,)``, dones bool ``(num_envs,)``, infos."""
        batch, rewards, terminations, truncations, batched = self.vector.step_wait()
        with UNTRUSTED:  # of a repository's own class, whose results nothing declares
            dones = np.logical_or(terminations, truncations).reshape(self.num_envs)
            infos = self._infos(batched)
            for index, info in enumerate(infos):
                info["TimeLimit.truncated"] = bool(truncations[index] and not terminations[index])
            rewards = np.asarray(rewards, np.float32)
        if dones.any():
            batch = self._begin_again(batch, dones, infos)
        return batch, rewards, dones, infos

    def _begin_again(self, batch: Any, dones: Any, infos: list[dict[str, Any]]) -> Any:
        """The observations with which those that have ended begin; ``infos`` gets their last."""
        ended = [index for index in range(self.num_envs) if dones[index]]
        if self._resets_in_the_same_step:
            with UNTRUSTED:
                self._begun(ended, infos)
            return batch
        with UNTRUSTED:
            lasts = list(iterate(self.vector.observation_space, batch))
        batch, begun = self.vector.reset(options={"reset_mask": dones})
        with UNTRUSTED:
            for index in ended:
                infos[index]["terminal_observation"] = lasts[index]
                self.reset_infos[index] = info_of(begun, index, self.num_envs)
        return batch

    def _begun(self, ended: list[int], infos: list[dict[str, Any]]) -> None:
        """Take apart what belongs to the end of an episode, and to the beginning of the next."""
        for index in ended:
            begun = infos[index]
            last = begun.pop("final_info", {})
            last["terminal_observation"] = begun.pop("final_obs")
            last["TimeLimit.truncated"] = begun.pop("TimeLimit.truncated")
            infos[index], self.reset_infos[index] = last, begun

    def close(self) -> None:
        """End their processes. Idempotent."""
        self.vector.close()

    def get_attr(self, attr_name: str, indices: _Indices = None) -> list[Any]:
        """An attribute of each sub-environment, or of those at ``indices``."""
        if attr_name == "render_mode":
            return [self.vector.render_mode] * len(list(self._get_indices(indices)))
        values = self.vector.get_attr(attr_name)
        return [values[index] for index in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: _Indices = None) -> None:
        """Set an attribute of every sub-environment. Raises ``ValueError``: only some are meant."""
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise ValueError("a sandboxed vector environment sets an attribute of all or of none")
        self.vector.set_attr(attr_name, [value] * self.num_envs)

    def env_method(
        self, method_name: str, *method_args: Any, indices: _Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of each sub-environment, or of those at ``indices`` alone."""
        chosen = list(self._get_indices(indices))
        if set(chosen) == set(range(self.num_envs)):
            results = self.vector.call(method_name, *method_args, **method_kwargs)
            return [results[index] for index in chosen]
        return [
            getattr(self.vector.envs[index], method_name)(*method_args, **method_kwargs)
            for index in chosen
        ]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: _Indices = None) -> list[bool]:
        """False for each: what is wrapped in the sandbox is not this process's class."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """What each sub-environment renders."""
        return self.vector.render() or [None] * self.num_envs

    def _infos(self, batched: dict[str, Any]) -> list[dict[str, Any]]:
        return [info_of(batched, index, self.num_envs) for index in range(self.num_envs)]
