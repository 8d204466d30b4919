"""Sandboxed environments for Stable-Baselines3.

    >>> env = SandboxVecEnv.make("org/repo@<commit>", n_envs=8)
    >>> PPO("MlpPolicy", env).learn(100_000)

Results, and the order in which sub-environments are reset, follow
``stable_baselines3.common.vec_env.DummyVecEnv``, so that training gives the same weights.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from envhub_sandbox.factory.make_env import make_env
from envhub_sandbox.vector.single_env import has_begun_again, info_of
from envhub_sandbox.vector.sub_environment import metadata_of_one
from envhub_sandbox.vector.suites import choose, closed_if_it_fails
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
from envhub_worker.protocol.codec.inert import RemoteObject
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.spaces import batches

_Indices = int | Iterable[int] | None


class SandboxVecEnv(VecEnv):
    """A vector environment as Stable-Baselines3's ``VecEnv``.

    A ``VecEnv`` resets a sub-environment in the step that ends its episode, and returns the last
    observation as ``info["terminal_observation"]``. Unless the vector environment does this itself
    (``AutoresetMode.SAME_STEP``), this class resets ended sub-environments by ``reset_mask``.

    Each info is the sub-environment's own. Only if a repository's own vector class or a wrapper
    around ``vector`` has joined the infos, this class splits them; then numbers are Python's.

    Args:
        vector: A vector environment from ``make_env``.

    Attributes:
        vector: The same vector environment, which has ``sandbox`` and further attributes.
    """

    def __init__(self, vector: VectorEnv[Any, Any, Any]) -> None:
        self.vector: Any = vector
        self._mode = vector.metadata.get("autoreset_mode")
        self._apart = vector._apart() if isinstance(vector, SandboxVectorEnv) else None
        self._is_plain = hasattr(vector, "env_fns")  # a Sync- or AsyncVectorEnv, or its proxy
        self._one_for_all = True
        self._methods: set[str] = set()  # names that are known to be those of methods
        super().__init__(
            vector.num_envs, vector.single_observation_space, vector.single_action_space
        )
        self.metadata = metadata_of_one(vector)

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
        """Make the environments of a repository.

        Args:
            ref: As in ``make_env``.
            n_envs: Number of sub-environments.
            suite: A suite of the repository; needed if there are several.
            task: A task of the suite; needed if there are several.
            options: Further arguments of ``make_env``.

        Raises:
            ValueError: The repository has several environments, or lacks the named one.
            EnvHubError: As ``make_env``.
        """
        with closed_if_it_fails(make_env(ref, n_envs=n_envs, **options)) as suites:
            return cls(choose(suites, suite, task))

    @property
    def envs(self) -> list[Any]:
        """A handle on each sub-environment: ``SandboxVectorEnv.envs``."""
        return list(self.vector.envs)

    def set_options(self, options: Any = None) -> None:
        """Set the options of the next ``reset``: a mapping for all, or a list with one for each."""
        self._one_for_all = not isinstance(options, (list, tuple))
        super().set_options(options)

    def reset(self) -> Any:
        """Reset all with the seeds of ``seed()`` and the options of ``set_options()``."""
        seeds, options, together = self._seeds, self._options, self._one_for_all
        self._reset_seeds()
        self._reset_options()
        self._one_for_all = True
        if together:
            return self._reset(seeds, options[0] or None, None)
        for index in range(self.num_envs):
            mask = np.arange(self.num_envs) == index
            batch = self._reset(seeds, options[index] or None, mask)
        return batch

    def _reset(self, seeds: Any, options: dict[str, Any] | None, mask: Any) -> Any:
        """Reset the sub-environments of ``mask``, all for None; return all observations."""
        if self._apart is not None:
            batch, infos = self._apart.reset(seeds, options, mask)
        elif mask is None:
            batch, infos = self.vector.reset(seed=seeds, options=options)
        else:
            masked = {**(options or {}), "reset_mask": mask}
            batch, infos = self.vector.reset(seed=seeds, options=masked)
        with UNTRUSTED:
            for index, info in enumerate(self._infos(infos)):
                if mask is None or mask[index]:
                    self.reset_infos[index] = info
        return batch

    def step_async(self, actions: Any) -> None:
        """Send the actions: ``(num_envs, ...)``, a list with one for each, or a batched mapping."""
        if not isinstance(actions, dict):
            actions = _batch_of(self.action_space, actions)
        self.vector.step_async(actions)

    def step_wait(self) -> Any:
        """Return observations, rewards (float32) and dones (bool) ``(num_envs,)``, and infos."""
        wait = self.vector.step_wait if self._apart is None else self._apart.step_wait
        batch, rewards, terminations, truncations, batched = wait()
        with UNTRUSTED:  # a repository's own vector class may return anything
            dones = np.logical_or(terminations, truncations).reshape(self.num_envs)
            infos = self._infos(batched)
            for index, info in enumerate(infos):
                info["TimeLimit.truncated"] = bool(truncations[index] and not terminations[index])
            rewards = np.asarray(rewards, np.float32)
        if dones.any():
            batch = self._begin_again(batch, dones, infos)
        return batch, rewards, dones, infos

    def _begin_again(self, batch: Any, dones: Any, infos: list[dict[str, Any]]) -> Any:
        """Return the observations after resets of ended episodes; ``infos`` gets their last."""
        ended = dones.copy()
        with UNTRUSTED:
            for index in np.flatnonzero(dones).tolist():
                if has_begun_again(self._mode, infos[index]):
                    self._begun(index, infos)
                    ended[index] = False
        if not ended.any():
            return batch
        with UNTRUSTED:
            spaces_of_both = self.observation_space, self.vector.observation_space
            lasts = list(batches.members(*spaces_of_both, batch, self.num_envs))
            for index in np.flatnonzero(ended).tolist():
                last = batches.as_returned(self.observation_space, lasts[index], iter(()))
                infos[index]["terminal_observation"] = last
        return self._reset(None, None, ended)

    def _begun(self, index: int, infos: list[dict[str, Any]]) -> None:
        """Split an info into that of an episode's end and that of the next one's beginning."""
        begun = infos[index]
        last = begun.pop("final_info", {})
        last["TimeLimit.truncated"] = begun.pop("TimeLimit.truncated")
        last["terminal_observation"] = begun.pop("final_obs")
        infos[index], self.reset_infos[index] = last, begun

    def close(self) -> None:
        """End the processes of the sub-environments. Idempotent."""
        self.vector.close()

    def get_attr(self, attr_name: str, indices: _Indices = None) -> list[Any]:
        """Return an attribute of each sub-environment, or of those at ``indices``."""
        if attr_name == "render_mode":
            return [self.vector.render_mode] * len(list(self._get_indices(indices)))
        chosen = list(self._get_indices(indices))
        if not self._is_plain:
            values = self.vector.get_attr(attr_name)
            return [values[index] for index in chosen]
        if chosen == list(range(self.num_envs)):
            values = self.vector.call("get_wrapper_attr", attr_name)  # a method is not called
            if not any(isinstance(value, RemoteObject) for value in values):
                return list(values)
        return [self.envs[index].get_wrapper_attr(attr_name) for index in chosen]

    def set_attr(self, attr_name: str, value: Any, indices: _Indices = None) -> None:
        """Set an attribute of each sub-environment's outermost wrapper, as ``setattr`` does.

        ``env_method("set_wrapper_attr", name, value)`` sets it in the wrapper that has it.

        Raises:
            ValueError: A repository's own vector class can set it only in all sub-environments.
        """
        chosen = list(self._get_indices(indices))
        if self._is_plain:
            self.env_method("__setattr__", attr_name, value, indices=chosen)
        elif set(chosen) == set(range(self.num_envs)):
            self.vector.set_attr(attr_name, [value] * self.num_envs)
        else:
            who = "the repository's own vector class"
            raise ValueError(f"{who} can set {attr_name!r} only in all at once: leave indices out")

    def env_method(
        self, method_name: str, *method_args: Any, indices: _Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of each sub-environment, or of those at ``indices``."""
        chosen = list(self._get_indices(indices))
        if chosen == list(range(self.num_envs)):
            if self._is_plain and method_name not in self._methods:
                method = self.envs[0].get_wrapper_attr(method_name)
                if not callable(method):  # `call` would return it
                    raise TypeError(f"{type(method).__name__!r} object is not callable")
                self._methods.add(method_name)
            return list(self.vector.call(method_name, *method_args, **method_kwargs))
        return [
            self.envs[index].get_wrapper_attr(method_name)(*method_args, **method_kwargs)
            for index in chosen
        ]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: _Indices = None) -> list[bool]:
        """False for each: wrappers in the sandbox are not classes of this process."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return the frames of the sub-environments if the render mode is ``rgb_array``."""
        if self.render_mode == "rgb_array":
            return self.vector.render() or [None] * self.num_envs
        warnings.warn(
            f"the render mode is {self.render_mode}, and images come of `rgb_array` alone",
            UserWarning,
            stacklevel=2,
        )
        return [None] * self.num_envs

    def _infos(self, infos: dict[Any, Any]) -> list[dict[Any, Any]]:
        """Return an info for each sub-environment, merged from an episode's end and the next."""
        if self._apart is None:
            return [_plain(info_of(infos, index, self.num_envs)) for index in range(self.num_envs)]
        own = self._apart.each(infos)
        return [{key: value for info in some[::-1] for key, value in info.items()} for some in own]


def _batch_of(space: spaces.Space[Any], members: Any) -> Any:
    """Batch the members of a space: joins mappings and tuples. Others are unchanged, but bits."""
    if isinstance(space, spaces.Dict):
        return {key: _batch_of(sub, [m[key] for m in members]) for key, sub in space.items()}
    if isinstance(space, spaces.Tuple):
        each = enumerate(space.spaces)
        return tuple(_batch_of(sub, [m[index] for m in members]) for index, sub in each)
    if isinstance(space, spaces.MultiBinary):  # SB3's policies draw float32 bits
        bits = isinstance(members, np.ndarray) and np.isin(members, (0, 1)).all()
        return members.astype(space.dtype) if bits else members
    return members


def _plain(value: Any) -> Any:
    """Convert numpy's numbers, which joining made of Python's, back to Python's."""
    if isinstance(value, dict):
        return {key: _plain(member) for key, member in value.items()}
    return value.item() if isinstance(value, (np.int64, np.float64, np.bool_)) else value
