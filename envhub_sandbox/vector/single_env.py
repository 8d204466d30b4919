"""One sub-environment with the interface of an ordinary ``gymnasium.Env``.

It is for libraries that take single environments: Stable-Baselines3, tianshou, PufferLib, RLlib's
default mode, TorchRL, and Gymnasium's wrappers. Below it is a vector environment of one, so its
steps use the same fast lane as all others.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, SupportsFloat, cast

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import VectorEnv

from envhub_sandbox.errors import RemoteProtocolError
from envhub_sandbox.vector.actions import batch_of_one
from envhub_sandbox.vector.sandbox_view import SandboxView
from envhub_sandbox.vector.sub_environment import metadata_of_one
from envhub_sandbox.vector.tracebacks import short_traceback, shortened
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.manifest.names import absent, is_servable
from envhub_worker.protocol.spaces import batches

_DECLARED = frozenset({"action_space", "observation_space", "metadata", "render_mode"})
"""Attributes that are read without a request; setting one sets it here and in the environment."""
_OURS = frozenset({"_apart", "_begun", "_close", "_mode", "_observations", "_spec", "_vector"})
_PACKAGE = __name__.partition(".")[0]


class SingleEnv(gym.Env[Any, Any]):
    """The only sub-environment of ``vector``, as a ``gymnasium.Env``.

    A vector environment resets an ended sub-environment by itself; a ``gymnasium.Env`` does not. So
    the runner is told to leave that to ``reset``. A repository's own vector class in the mode
    ``SAME_STEP``, or that states no mode and returns ``final_obs``, has begun the next episode
    already: then ``reset`` without a seed or options returns that first observation and does not
    reset again, so the number of resets is the number that the caller asked for.

    Args:
        vector: With ``num_envs`` 1.
        close: Closes the environment and everything that was made with it; None closes the
            vector environment alone.

    Raises:
        ValueError: ``vector`` has another number of sub-environments.
    """

    def __init__(
        self, vector: VectorEnv[Any, Any, Any], close: Callable[[], None] | None = None
    ) -> None:
        if vector.num_envs != 1:
            raise ValueError(
                f"a gymnasium.Env is one environment, and {vector!r} has {vector.num_envs}: make "
                "it with n_envs=1"
            )
        self._vector = vector
        self._close = close or vector.close
        self._apart = None
        if isinstance(vector, SandboxVectorEnv):
            self._apart = vector._apart(single=True)
        # The next episode, which has begun already.
        self._begun: tuple[Any, dict[str, Any]] | None = None  # what the next reset returns
        # the declared spaces, since the caller may set others
        self._observations = vector.single_observation_space, vector.observation_space
        self.__dict__.update(  # not by __setattr__, which would set them in the environment as well
            observation_space=vector.single_observation_space,
            action_space=vector.single_action_space,
            metadata=metadata_of_one(vector),
            render_mode=vector.render_mode,
        )
        self._mode = vector.metadata.get("autoreset_mode")

    @property
    def vector(self) -> VectorEnv[Any, Any, Any]:
        """The vector environment below."""
        return self._vector

    @property
    def sandbox(self) -> SandboxView:
        """Confinement, resource usage, denials and counters of the environment.

        The environment's own attribute of this name is ``env.vector.envs[0].sandbox``, since its
        claims must not be taken for these.

        Raises:
            AttributeError: There is no sandbox, because it was made with ``sandbox=None``.
        """
        view = getattr(self._vector, "sandbox", None)
        if not isinstance(view, SandboxView):
            raise AttributeError("there is no sandbox around it")
        return view

    @short_traceback
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        Returns:
            An observation of ``observation_space``, and its info.

        Raises:
            WorkerTimeoutError, WorkerDiedError, RemoteEnvError: As ``SandboxVectorEnv.reset``.
        """
        begun, self._begun = self._begun, None
        if begun is not None and seed is None and not options:
            return begun
        if self._apart is not None:
            seeds = None if seed is None else [seed]  # a list of seeds is no seed
            batch, infos = self._apart.reset(seeds, options)
            self._follow_spaces()
        else:
            batch, infos = self._vector.reset(seed=seed, options=options)
        with UNTRUSTED:
            [info, *_], scalars, _ = self._own(infos)
            return self._first(batch, scalars), info

    def _follow_spaces(self) -> None:
        """Show the spaces that the environment has now, if a reset has replaced them."""
        for name, space in cast("SandboxVectorEnv", self._vector)._first_spaces.items():
            if self.__dict__[name] != space:
                self.__dict__[name] = space

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step with ``action``, an element of ``action_space``.

        Returns:
            Observation, reward, terminated, truncated, info. A reward that is a number is a float;
            any other (a list with one for each agent) is unchanged. The observation of a step that
            ends an episode is that episode's last.

        Raises:
            ActionError, WorkerTimeoutError, WorkerDiedError, RemoteEnvError: As
                ``SandboxVectorEnv.step``.
        """
        self._begun = None
        step = self._vector.step if self._apart is None else self._apart.step
        try:
            result = step(batch_of_one(self._vector.single_action_space, action))
        except BaseException as error:
            if shortened(error):
                __tracebackhide__ = True  # pytest hides the frame then
                raise error  # ENVHUB_TRACEBACK=full shows where
            raise
        with UNTRUSTED:  # the results of a repository's own class are not declared
            return self._of_one(*result)

    def _of_one(
        self, batch: Any, rewards: Any, terminations: Any, truncations: Any, infos: Any
    ) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Convert the results of a step of the vector environment to those of one environment."""
        [info, *more], scalars, odd = self._own(infos)
        observation = self._first(batch, scalars)
        terminated, truncated = bool(terminations[0]), bool(truncations[0])
        if (terminated or truncated) and has_begun_again(self._mode, info):
            last, last_info = info.pop("final_obs"), info.pop("final_info", {})
            self._begun = observation, {**info, **(more[0] if more else {})}
            observation, info = batches.restore(self._observations[0], last), last_info
        reward = rewards[0]
        if not np.ndim(reward):  # an array has several rewards, of a repository's own class
            reward = float(reward)
        return observation, odd[0] if odd else reward, terminated, truncated, info

    @short_traceback
    def render(self) -> Any:
        """The environment's rendering in its ``render_mode``, or None."""
        frames = self._vector.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Close the environment and end its processes. Idempotent."""
        self._close()

    @property
    def np_random(self) -> np.random.Generator:
        """The environment's generator; a draw here advances it there, and the other way round."""
        if isinstance(self._vector, SandboxVectorEnv):
            return self._vector._generators.read()[0]
        generator = self._vector.np_random
        return generator[0] if isinstance(generator, tuple) else generator

    @np_random.setter
    @short_traceback
    def np_random(self, value: np.random.Generator) -> None:
        if isinstance(self._vector, SandboxVectorEnv):
            self._vector._generators.put(0, value)
        elif isinstance(self._vector.np_random, tuple):
            self._vector.set_attr("np_random", [value])  # type: ignore[attr-defined]
        else:
            self._vector.np_random = value

    # Gymnasium's checks read this attribute
    _np_random = np_random

    @property
    @short_traceback
    def np_random_seed(self) -> int:
        """The seed of its generator; -1 if it is not known, as in Gymnasium."""
        seeds: Any = self._vector.np_random_seed
        seed = seeds[0] if isinstance(seeds, tuple) else seeds
        return -1 if seed is None else int(seed)

    @property
    @short_traceback
    def spec(self) -> Any:
        """The spec that was set, or one from which ``gym.make`` makes the same, in a sandbox.

        Its limits come from the environment's own spec, ``env.vector.envs[0].spec``.
        """
        if "_spec" not in self.__dict__:
            self._spec = self._own_spec()
        return self._spec

    @spec.setter
    def spec(self, value: Any) -> None:
        own = self._own_spec() if isinstance(value, EnvSpec) else None
        if own is not None and value.id == own.id and value.max_episode_steps is None:
            value = copy(value)  # gym.make does not know the repository's own limit
            value.max_episode_steps = own.max_episode_steps
        self._spec = value

    def _own_spec(self) -> EnvSpec | None:
        vector = self._vector
        if not isinstance(vector, SandboxVectorEnv):
            spec = vector.spec or getattr(self._inner, "spec", None)
            return spec if isinstance(spec, EnvSpec) else None
        facts = vector._manifest.spec
        if facts is None and not (vector._manifest.shardable or vector.closed):
            inner = getattr(self._inner, "spec", None)  # of the own class's first sub-environment
            facts = vars(inner) if isinstance(inner, EnvSpec) else None
        return vector._spec_again(facts)

    @short_traceback
    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute in the wrapper that has it; a new one in the outermost wrapper.

        Raises:
            AttributeError: ``__getattr__`` does not serve this name; use ``set_wrapper_attr``.
        """
        if name in _DECLARED:
            self._vector.set_attr(name, [value])  # type: ignore[attr-defined]
        elif not self._is_local(name):
            if not is_servable(name):
                raise AttributeError(
                    f"a {type(self).__name__} does not set {name!r} in the environment, because it "
                    f"does not read it there; call set_wrapper_attr({name!r}, value)"
                )
            self._vector.set_attr(name, [value])  # type: ignore[attr-defined]
            return
        object.__setattr__(self, name, value)

    def _is_local(self, name: str) -> bool:
        """Whether an attribute is ours, or of a class that is derived from this one."""
        derived = not type(self).__module__.startswith(_PACKAGE) and name.startswith("_")
        return name in _OURS or derived or name.startswith("__") or hasattr(type(self), name)

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        """Set an attribute, also if ``__setattr__`` refuses its name; as in Gymnasium."""
        if self._is_own(name):
            setattr(self, name, value)
        elif force or self._inner.has_wrapper_attr(name):
            self._vector.set_attr(name, [value])  # type: ignore[attr-defined]
        else:
            return False
        return True

    def __getattr__(self, name: str) -> Any:
        """An attribute or a method of the environment or of one of its wrappers."""
        # if a property of ours raises AttributeError, Python calls this with the property's name
        ours = not is_servable(name) or hasattr(type(self), name)
        if "_vector" not in self.__dict__ or ours:
            raise absent(self, name, "get_wrapper_attr")
        return self._inner.get_wrapper_attr(name)

    def has_wrapper_attr(self, name: str) -> bool:
        """Whether the environment or a wrapper of it has an attribute of this name."""
        return self._is_own(name) or bool(self._inner.has_wrapper_attr(name))

    def get_wrapper_attr(self, name: str) -> Any:
        """An attribute of this name, also if ``__getattr__`` does not serve it (``size``)."""
        return getattr(self, name) if self._is_own(name) else self._inner.get_wrapper_attr(name)

    @property
    def _inner(self) -> Any:
        return self._vector.envs[0]  # type: ignore[attr-defined]

    def _is_own(self, name: str) -> bool:
        return name in self.__dict__ or hasattr(type(self), name)

    def __reduce__(self) -> tuple[Any, ...]:
        # also for copy and deepcopy: the copy has processes of its own
        return SingleEnv, (self._vector,)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self._vector!r}>"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        shown = getattr(type(self._vector), "_repr_html_", None)  # of our class, or None
        inside = "" if shown is None else shown(self._vector)
        return f"<code>{html.escape(repr(self))}</code>{inside}"

    def _first(self, batch: Any, scalars: Sequence[bool]) -> Any:
        """The only observation; ``scalars`` says which discrete members were Python numbers."""
        [first, *_] = batches.members(*self._observations, batch, 1)
        if type(first) is np.ndarray or self._apart is None:
            return first
        return batches.as_returned(self._observations[0], first, iter(scalars))

    def _own(
        self, infos: dict[Any, Any]
    ) -> tuple[list[dict[Any, Any]], Sequence[bool], tuple[Any, ...]]:
        """The infos, an episode's last before the next one's first; see ``Results.own``."""
        if self._apart is None:
            return [info_of(infos, 0, 1)], (), ()
        if not infos:
            return [{}, {}], (), ()
        [own], scalars, reward = self._apart.own(infos)
        return [*own, {}, {}], scalars, reward


def has_begun_again(mode: Any, info: dict[Any, Any]) -> bool:
    """Whether the step that ended an episode has reset: a class that states no autoreset mode says
    so by ``final_obs``. Raises ``RemoteProtocolError``: the last observation is missing.
    """
    has_last, value = "final_obs" in info, getattr(mode, "value", mode)
    if value == "SameStep" and not has_last:
        raise RemoteProtocolError(
            "its vector class resets in the step that ends an episode (SAME_STEP), and returns no "
            "final_obs in the infos: the episode's last observation is lost"
        )
    return has_last and value in (None, "SameStep")


def info_of(infos: dict[Any, Any], index: int, num_envs: int) -> dict[Any, Any]:
    """The info of sub-environment ``index``: the inverse of ``VectorEnv._add_info``.

    The info has a key if the key's mask, ``"_" + key``, bool ``(num_envs,)``, is set at the index,
    or if there is no mask. Nested mappings are treated the same. Keys may be numbers, as in
    Gymnasium.
    """
    info = {}
    masks = {f"_{key}" for key in infos}
    for key, value in infos.items():
        if key in masks:
            continue
        mask = infos.get(f"_{key}")
        if mask is None or np.asarray(mask).flat[index]:
            info[key] = _of_one(value, index, num_envs)
    return info


def _of_one(value: Any, index: int, num_envs: int) -> Any:
    if isinstance(value, dict):
        return info_of(value, index, num_envs)
    if isinstance(value, (np.ndarray, list, tuple)) and len(value) == num_envs:
        return value[index]
    return value  # a value of the vector environment, not one for each sub-environment
