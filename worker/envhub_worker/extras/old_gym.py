"""Adapts environments of ``gym``, Gymnasium's predecessor, and environments of Gymnasium with a
``reset`` as in ``gym``.

Nobody maintains ``gym``, but many published environments need it. Its interface changed between
0.21 and 0.26, and environments for one release run on another. So this module never checks a
version, but what an environment takes and returns:

- ``reset`` with ``seed`` where the environment and all its wrappers take one, else ``seed()``
  before it, and for a class of Gymnasium its ``np_random``; with an info or without.
- ``step`` with one ``done``, of which ``TimeLimit`` says in the info whether it is a truncation, or
  with two.
- ``render(mode=...)``, or a ``render_mode`` that was given when it was made.
- Spaces of its own classes, which Gymnasium does not know.

Followed: ``gymnasium.wrappers.compatibility.EnvCompatibility`` (0.26 to 0.29, gone since) and
Shimmy's ``GymV21CompatibilityV0`` and ``GymV26CompatibilityV0``.
"""

from __future__ import annotations

import os
import sys
import traceback
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.step_api_compatibility import convert_to_terminated_truncated_step_api
from gymnasium.vector.utils import batch_space, iterate

from envhub_worker.protocol.manifest.names import CONVERTED
from envhub_worker.protocol.spaces import batches
from envhub_worker.runner import gymnasium_compat as compat
from envhub_worker.runner import returned
from envhub_worker.runner.described import facts_of
from envhub_worker.runner.gymnasium_compat import names, parameters_of, takes

_OPTIONAL = ("seed", "options", "return_info")
_MODES = ("rgb_array", "ansi")
"""What ``render`` is asked for where it has to be asked, the first that it can do: no window."""


class OldSpaceError(TypeError):
    """A space of ``gym`` has no counterpart in Gymnasium."""


def is_env(value: object) -> bool:
    """Whether an object is an environment of ``gym``, not of Gymnasium."""
    return not isinstance(value, gym.Env) and compat.descends_from(value, "gym.core", "Env")


def is_vector(value: object) -> bool:
    """Whether an object is a vector environment of ``gym``, where that is an ``Env``."""
    return is_env(value) and compat.descends_from(value, "gym.vector.vector_env", "VectorEnv")


def adapted(env: Any) -> Any:
    """Adapts an environment of ``gym``, or one with a ``reset`` as before Gymnasium 0.26; returns
    any other unchanged.
    """
    if is_env(env):
        return _warned(OldEnv, env)
    above = None
    for layer in compat.layers(env):
        if isinstance(layer, gym.Env) and _is_as_before(layer):
            return _converted(env, above, layer)
        above = layer
    return env


def _is_as_before(env: Any) -> bool:
    """Whether ``reset`` does not take Gymnasium's arguments, or still has ``return_info``."""
    parameters = parameters_of(env.reset)
    if parameters is None:
        return False
    lacks = not (takes(parameters, "seed") and takes(parameters, "options"))
    return lacks or names(parameters, "return_info")


def _converted(env: Any, above: Any, layer: Any) -> Any:
    """Puts an ``OldEnv`` around a layer of ``env``, below the layer ``above``."""
    message = f"{_where(layer, 'reset')} is as before Gymnasium 0.26"
    warnings.warn(
        f"{message}. It runs through a compatibility wrapper of the sandbox, which seeds it by its "
        "seed() and np_random where reset takes no seed: a time limit becomes a truncation. To "
        f"run without it, its author should follow {_GUIDE}",
        stacklevel=1,
    )
    adapter = OldEnv(layer)
    vars(adapter)[CONVERTED] = message
    if above is None:
        return adapter
    above.env = adapter
    return env


def adapted_vector(env: Any) -> Any:
    """Adapts a vector environment of ``gym``."""
    return _warned(OldVectorEnv, env)


def _warned(adapter: Callable[[Any], Any], env: Any) -> Any:
    release = getattr(sys.modules.get("gym"), "__version__", "of an unknown release")
    warnings.warn(
        f"make_env returns environments of gym {release}, which is not maintained. They run as "
        "Gymnasium's, through a compatibility wrapper of the sandbox: a time limit becomes a "
        "truncation. To run without it, its author should move to gymnasium",
        stacklevel=1,
    )
    return adapter(env)


class _Reset:
    """Resets an environment with the arguments that it and all its wrappers take."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self._takes = frozenset(name for name in _OPTIONAL if _passes(env, name))

    def __call__(self, seed: Any, options: Any) -> tuple[Any, Any]:
        """Resets; returns the observation, and the info if there is one."""
        if seed is not None and "seed" not in self._takes:
            self._seed(seed)
        offered = {"seed": seed, "options": options, "return_info": True}
        arguments = {name: offered[name] for name in self._takes if offered[name] is not None}
        result = self._env.reset(**arguments)
        return result if self._has_info(result) else (result, {})

    def _seed(self, seed: Any) -> None:
        *_, innermost = compat.layers(self._env)
        if isinstance(innermost, gym.Env):
            gym.Env.reset(innermost, seed=seed)  # its generator, and nothing else
        # some have a method that takes nothing
        if parameters_of(getattr(innermost, "seed", None) or (lambda: None)):
            compat.owner(self._env, "seed").seed(seed)

    def _has_info(self, result: Any) -> bool:
        if not isinstance(result, tuple) or len(result) != 2 or not isinstance(result[1], dict):
            return False
        space = self._env.observation_space
        return not (hasattr(space, "spaces") and space.contains(result))


def _passes(env: Any, name: str) -> bool:
    """Whether ``reset`` of the environment names an argument, and its wrappers pass it on."""
    *wrappers, innermost = [layer.reset for layer in compat.layers(env)]
    named = names(parameters_of(innermost) or {}, name)
    return named and all(_takes(wrapper, name) for wrapper in wrappers)


def _takes(method: Any, name: str) -> bool:
    return takes(parameters_of(method) or {}, name)


class OldEnv(gym.Env[Any, Any]):
    """Wraps an environment of ``gym``; reads and sets attributes beyond Gymnasium's in it."""

    def __init__(self, env: Any) -> None:
        # Gymnasium's wrappers do not pass a mode on.
        drawing = [
            layer
            for layer in compat.layers(env)
            if getattr(type(layer), "render", None) is not gym.Wrapper.render
        ]
        wants_mode = getattr(env, "render_mode", None) is None and all(
            _takes(layer.render, "mode") for layer in drawing
        )
        metadata = _metadata_of(env)
        mode = next((mode for mode in _MODES if mode in metadata["render_modes"]), None)
        self.__dict__.update(
            env=env,
            observation_space=space_of(env.observation_space),
            action_space=space_of(env.action_space),
            metadata=metadata,
            render_mode=mode if wants_mode else getattr(env, "render_mode", None),
            spec=_spec_of(env),
            _draw=partial(drawing[0].render, **({"mode": mode} if wants_mode and mode else {})),
            _reset=_Reset(env),
        )

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        """Like Gymnasium's ``reset``; seeds the environment in the way that it supports."""
        return self._reset(seed, options)  # type: ignore[no-any-return]

    def step(self, action: Any) -> Any:
        """Like Gymnasium's ``step``."""
        return convert_to_terminated_truncated_step_api(self.env.step(action))

    def render(self) -> Any:
        """Renders in the mode of ``render_mode``."""
        return self._draw()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    @property
    def unwrapped(self) -> Any:
        """The environment without any wrapper."""
        return self.env.unwrapped

    @property
    def np_random(self) -> Any:
        """The environment's generator; before 0.22 a ``RandomState``."""
        return self.env.np_random

    @np_random.setter
    def np_random(self, value: Any) -> None:
        compat.owner(self.env, "np_random").np_random = value

    @property
    def np_random_seed(self) -> int:
        """The environment's seed; -1 if unknown, as in Gymnasium."""
        return int(getattr(self.env, "np_random_seed", -1))

    def __getattr__(self, name: str) -> Any:
        if name == "env":  # not there yet, in a copy that is being made
            raise AttributeError(name)
        return getattr(self.env, name)

    def __setattr__(self, name: str, value: Any) -> None:
        if name in self.__dict__ or isinstance(getattr(type(self), name, None), property):
            super().__setattr__(name, value)
        else:
            setattr(compat.owner(self.env, name), name, value)


class OldVectorEnv:
    """Wraps a vector environment of ``gym``, which resets in the step that ends an episode."""

    def __init__(self, env: Any) -> None:
        self.env = env
        self.num_envs = int(env.num_envs)
        self.single_observation_space = space_of(env.single_observation_space)
        self.single_action_space = space_of(env.single_action_space)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        # before 0.22 it takes one action after the other, whatever the space is
        self._in_turn = type(space_of(env.action_space)) is not type(self.action_space)
        self.metadata = _metadata_of(env) | {"autoreset_mode": "SameStep"}
        self._reset = _Reset(env)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, Any]:
        """Resets; returns observations and infos in Gymnasium's form."""
        observation, infos = self._reset(seed, options)
        return observation, self._joined(infos)

    def step(self, actions: Any) -> Any:
        """Steps; returns five results in Gymnasium's form."""
        if self._in_turn:
            actions = tuple(iterate(self.action_space, actions))
        *results, infos = self.env.step(actions)
        infos = list(infos) if isinstance(infos, tuple) else infos
        if len(results) == 3 and isinstance(infos, dict):
            infos.pop("_TimeLimit.truncated", None)
        converted = convert_to_terminated_truncated_step_api((*results, infos), is_vector_env=True)
        observation, rewards, terminated, truncated, infos = converted
        flags = (np.asarray(terminated, np.bool_), np.asarray(truncated, np.bool_))
        return observation, rewards, *flags, self._joined(infos)

    def _joined(self, infos: Any) -> Any:
        """Joins infos: before 0.24 they are a list with one dict per sub-environment."""
        if isinstance(infos, Mapping):
            return compat.renamed(infos)
        pairs = [(index, info) for index, info in enumerate(infos) if info]
        return batches.join_pairs(pairs, self.num_envs)

    def __getattr__(self, name: str) -> Any:
        if name == "env":
            raise AttributeError(name)
        return getattr(self.env, name)


def _metadata_of(env: Any) -> dict[str, Any]:
    """Returns metadata with Gymnasium's names for keys that 0.21 names differently."""
    metadata = dict(getattr(env, "metadata", None) or {})
    modes: Any = metadata.get("render_modes", metadata.get("render.modes"))
    metadata["render_modes"] = list(modes or ())
    if "video.frames_per_second" in metadata:
        metadata.setdefault("render_fps", metadata["video.frames_per_second"])
    return metadata


def _spec_of(env: Any) -> EnvSpec | None:
    spec = getattr(env, "spec", None)
    if isinstance(spec, EnvSpec):
        return spec
    named = getattr(spec, "id", None) is not None
    return EnvSpec(entry_point="", **facts_of(spec)) if named else None


def space_of(space: Any) -> Any:
    """Converts a space to Gymnasium's class; a subclass becomes its known base class.
    Raises ``OldSpaceError``: no base class of the space is known.
    """
    if isinstance(space, gym.Space):
        return space
    for cls in type(space).__mro__:
        if cls.__module__.startswith("gym.spaces.") and cls.__name__ in _SPACES:
            return _SPACES[cls.__name__](space)
    raise OldSpaceError(
        f"a space of gym is a {type(space).__module__}.{type(space).__qualname__}, which Gymnasium "
        f"does not have; supported are {', '.join(_SPACES)}"
    )


_SPACES: dict[str, Callable[[Any], Any]] = {
    "Box": lambda space: spaces.Box(space.low, space.high, space.shape, space.dtype),
    "Discrete": lambda space: spaces.Discrete(int(space.n), start=int(getattr(space, "start", 0))),
    "MultiDiscrete": lambda space: spaces.MultiDiscrete(space.nvec, dtype=space.dtype),
    "MultiBinary": lambda space: spaces.MultiBinary(space.n),
    "Tuple": lambda space: spaces.Tuple([space_of(part) for part in space.spaces]),
    "Dict": lambda space: spaces.Dict(
        OrderedDict((key, space_of(part)) for key, part in space.spaces.items())
    ),
}


_GUIDE = "https://gymnasium.farama.org/introduction/migration_guide/"
_RETURNS = {
    "reset": "observation, info",
    "step": "observation, reward, terminated, truncated, info",
}


def explained(error: Exception, env: Any, method: str) -> Exception:
    """Returns the error, or one that explains that the environment's ``method`` is as before 0.26.
    ``error``: the error of calling the method, or unpacking its result, as of today.
    """
    text = str(error)
    unpacked = "to unpack" in text or "cannot unpack" in text
    frames = traceback.extract_tb(error.__traceback__)
    if frames and frames[-1].name == f"env_{method}_passive_checker":  # of what it returned
        return returned.raised_at(error, env, method)
    function = getattr(getattr(type(env.unwrapped), method, None), "__code__", None)
    theirs = any(function and frame.filename == function.co_filename for frame in frames)
    if function is None or theirs or not unpacked:
        return error
    message = f"{_where(env.unwrapped, method)} does not return {_RETURNS[method]}"
    if "got 4" in text or (method == "reset" and "non-iterable" not in text):
        message = f"{message}. That is the API before Gymnasium 0.26; see {_GUIDE}"
        if is_env(env.unwrapped):
            message = f"{message}. It may run as it is with: pip install 'gym<0.26'"
    return returned.raised_at(type(error)(f"{message} ({text})"), env, method)


def _where(env: Any, method: str) -> str:
    """Names a method so that its author finds it."""
    name = f"{type(env).__qualname__}.{method}"
    code = getattr(getattr(type(env), method), "__code__", None)
    if code is None:
        return name
    roots = [f"{root.rstrip(os.sep)}{os.sep}" for root in sys.path if root]
    root = next((root for root in roots if code.co_filename.startswith(root)), "")
    return f"{name} ({code.co_filename.removeprefix(root)}, line {code.co_firstlineno})"
