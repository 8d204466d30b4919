"""Makes Gymnasium 0.26 to 1.0 in a jail behave like the client's current release.

This module adds what they lack, so that no other module asks for a version:

- **Autoreset.** Before 1.1 there is no mode to choose. 1.0 resets in the step after the end, as
  ``NextStep`` does; 0.29 in the same step, as ``SameStep`` does, but with the last observation as
  ``final_observation``. Vector environments of 0.29 are described as ``SameStep``, and their last
  observations and infos are called ``final_obs`` and ``final_info``, with a dict of arrays for the
  latter.
- **Attributes.** Before 0.29, wrappers forward every attribute by ``__getattr__`` and have no
  ``get_wrapper_attr``; a ``MultiDiscrete`` starts at zero, and a ``Sequence`` is not stacked.
- **Vector environments.** Those of 0.29 have no ``render``, one random generator for all, and look
  attributes up in the outermost wrapper only.
"""

from __future__ import annotations

import builtins
import inspect
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorEnv

from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.spaces.spaces import entropy_of
from envhub_worker.runner import returned

_MODES: Any = getattr(gym.vector, "AutoresetMode", None)
_BEFORE_1_0 = issubclass(VectorEnv, gym.Env)
DEFAULT_MODE = "SameStep" if _BEFORE_1_0 else "NextStep"
"""What a vector environment does that was asked for nothing else."""
OWN_NAMES = frozenset(
    {
        *("action_space", "closed", "is_vector_env", "metadata", "observation_space"),
        *("single_action_space", "single_observation_space", "spec", "viewer"),
    }
)
"""Names of any vector environment; older classes set some of them only when they are made."""
_EXPERIMENTAL = "gymnasium.experimental.vector"


if not hasattr(gym.Env, "get_wrapper_attr"):
    _old_gymnasium: Any = gym
    _old_gymnasium.Env.get_wrapper_attr = lambda self, name: getattr(self, name)
    _old_gymnasium.spaces.MultiDiscrete.start = property(lambda space: np.zeros_like(space.nvec))
    _old_gymnasium.spaces.Sequence.stack = False


def mode_named(mode: Any) -> str:
    """Returns the name of an autoreset mode; takes every form that Gymnasium accepts."""
    return str(mode if _MODES is None else _MODES(mode).value)


def mode_of(env: Any, stated: Any) -> Any:
    """The autoreset mode of a vector environment with a ``step`` of its own.
    ``stated``: what its metadata says, or None.
    """
    if stated is not None or _MODES is not None:
        return stated
    ours = isinstance(env, VectorEnv) or any(
        cls.__module__.startswith(_EXPERIMENTAL) for cls in type(env).__mro__
    )
    return DEFAULT_MODE if ours else None


def renamed(info: Mapping[Any, Any]) -> dict[Any, Any]:
    """Renames the infos of an old vector environment to today's names."""
    infos: dict[Any, Any] = {}
    for key, value in info.items():
        is_mask = isinstance(key, str) and key.startswith("_") and key[1:] in info
        if not is_mask:
            mask = info.get(f"_{key}")
            infos.update(_entry(_RENAMED.get(key, key), value, mask))
    return infos


_RENAMED = {"final_observation": "final_obs"}


def _entry(key: Any, values: Any, mask: Any) -> dict[Any, Any]:
    if mask is None:
        return {key: values}
    dicts = isinstance(values, np.ndarray) and values.dtype == object and key != "final_obs"
    if dicts and mask.any() and all(isinstance(value, dict) for value in values[mask]):
        pairs = [(int(index), {key: values[index]}) for index in np.flatnonzero(mask)]
        return batches.join_pairs(pairs, len(values))
    return {key: values, f"_{key}": mask}


def reset_result(env: Any, result: Any) -> tuple[Any, Any]:
    """Converts what a repository's own vector environment returns from ``reset``."""
    observation, infos = _parts(env, "reset", result, ("observations", "infos"))
    return observation, _own_infos(env, "reset", infos)


def step_result(env: Any, result: Any) -> tuple[Any, ...]:
    """Converts what a repository's own vector environment returns from ``step``."""
    names = ("observations", "rewards", "terminations", "truncations", "infos")
    observation, *columns, infos = _parts(env, "step", result, names)
    each = zip(names[1:-1], columns, (np.float64, np.bool_, np.bool_), strict=True)
    checked = [_column(env, name, column, dtype) for name, column, dtype in each]
    infos = _own_infos(env, "step", infos)
    return (observation, *checked, renamed(infos) if _BEFORE_1_0 else infos)


def _parts(env: Any, method: str, result: Any, names: tuple[str, ...]) -> Any:
    if isinstance(result, (tuple, list)) and len(result) == len(names):
        return result
    got = f"{len(result)} values" if isinstance(result, tuple) else f"a {type(result).__name__}"
    raise _misfit(env, method, f"returns {got} in place of {', '.join(names)}")


def _column(env: Any, name: str, values: Any, dtype: Any) -> Any:
    """Returns one value per sub-environment: an array; Gymnasium's wrappers take lists, too."""
    count = env.num_envs
    if type(values) is np.ndarray and values.dtype.kind in "biuf" and values.shape[:1] == (count,):
        return values
    if isinstance(values, (list, tuple)):
        try:
            values = np.asarray(values, None if name == "rewards" else dtype)
        except ValueError:
            values = np.empty(0, object)
    shape = getattr(values, "shape", None)
    kind = getattr(getattr(values, "dtype", None), "kind", "f")
    # Others arrive as texts: a masked array, and what is an array for numpy alone. Arrays of numpy
    # before 1.22 have no ``__dlpack__``.
    is_array = isinstance(values, np.ndarray) or hasattr(type(values), "__dlpack__")
    is_sent = is_array and not hasattr(values, "mask")
    if not shape or shape[0] != count or kind not in "biuf" or not is_sent:
        returned = f"{batches.shown(values)} as {name}"
        raise _misfit(env, "step", f"returns {returned}, which have to be one number each, {count}")
    return values


def _own_infos(env: Any, method: str, infos: Any) -> Any:
    """Returns infos as one dict; merges a list of dicts like Gymnasium."""
    if isinstance(infos, dict):
        return infos
    mappings = isinstance(infos, (list, tuple)) and all(isinstance(info, dict) for info in infos)
    if not mappings or len(infos) != env.num_envs:
        raise _misfit(env, method, f"returns infos of type {type(infos).__name__}, not a dict")
    return batches.join_pairs([(i, info) for i, info in enumerate(infos) if info], len(infos))


def _misfit(env: Any, method: str, complaint: str) -> Exception:
    kind = type(env)
    text = f"make_env returned a VectorEnv ({kind.__module__}.{kind.__qualname__}) whose {method}"
    return returned.raised_at(TypeError(f"{text} {complaint}"), env, method)


class _WithMode(SyncVectorEnv):
    """``SyncVectorEnv`` of 1.0 with an autoreset mode; the runner does not use its ``step``."""

    def __init__(self, env_fns: Any, *, copy: bool, autoreset_mode: str) -> None:
        super().__init__(env_fns, copy=copy)
        self.metadata = {**(self.metadata or {}), "autoreset_mode": autoreset_mode}
        self.render_mode = getattr(self.envs[0], "render_mode", None)


class _OldSyncVectorEnv(_WithMode):
    """``SyncVectorEnv`` of 0.29 with the methods of later releases."""

    def render(self) -> Any:
        return tuple(env.render() for env in self.envs)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        attributes = [env.get_wrapper_attr(name) for env in self.envs]
        return tuple(
            attribute(*args, **kwargs) if callable(attribute) else attribute
            for attribute in attributes
        )

    def get_attr(self, name: str) -> tuple[Any, ...]:
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        if not isinstance(values, (list, tuple)):
            values = [values] * self.num_envs
        if len(values) != self.num_envs:
            raise ValueError(
                "Values must be a list or tuple with length equal to the number of environments. "
                f"Got `{len(values)}` values for {self.num_envs} environments."
            )
        for env, value in zip(self.envs, values, strict=True):
            setattr(owner(env, name), name, value)

    @property
    def np_random(self) -> Any:
        return tuple(env.np_random for env in self.envs)

    @np_random.setter
    def np_random(self, value: Any) -> None:
        """The generator that Gymnasium's ``seed`` sets; each sub-environment keeps its own."""

    @property
    def np_random_seed(self) -> Any:
        return tuple(entropy_of(generator.bit_generator) for generator in self.np_random)


def owner(env: Any, name: str) -> Any:
    """Returns the outermost layer that has an attribute itself; else the outermost layer."""
    for layer in layers(env):
        if name in vars(layer) or hasattr(type(layer), name):
            return layer
    return env


def layers(env: Any) -> Iterator[Any]:
    """Yields wrappers, ``gym``'s included, from the outermost on, then the wrapped environment."""
    while isinstance(env, gym.Wrapper) or descends_from(env, "gym.core", "Wrapper"):
        yield env
        env = env.env
    yield env


def descends_from(value: object, module: str, name: str) -> bool:
    """Whether an object's class has an ancestor of this name. Does not import that ancestor."""
    return any((cls.__module__, cls.__qualname__) == (module, name) for cls in type(value).__mro__)


SyncBase: Any = SyncVectorEnv
if _MODES is None:
    SyncBase = _OldSyncVectorEnv if _BEFORE_1_0 else _WithMode
"""What the worker's own loop is built on."""

Parameters = dict[str, inspect.Parameter]


def parameters_of(function: Callable[..., Any]) -> Parameters | None:
    """Returns a function's parameters by name; None if Python cannot tell."""
    try:
        return dict(inspect.signature(function).parameters)
    except (TypeError, ValueError):
        return None


def takes(parameters: Parameters, name: str) -> bool:
    """Whether a function takes a keyword argument of this name."""
    return names(parameters, name) or any(
        item.kind is inspect.Parameter.VAR_KEYWORD for item in parameters.values()
    )


def names(parameters: Parameters, name: str) -> bool:
    """Whether a function declares a parameter of this name that can be passed by keyword."""
    parameter = parameters.get(name)
    return parameter is not None and parameter.kind is not inspect.Parameter.POSITIONAL_ONLY


_NUMPYS_OLD_NAMES = {
    name: getattr(builtins, name) for name in ("bool", "complex", "float", "int", "object", "str")
} | {
    "bool8": np.bool_,
    "complex_": np.complex128,
    "float_": np.float64,
    "unicode_": np.str_,
    "Inf": np.inf,
    "NaN": np.nan,
    "infty": np.inf,
}
"""What numpy 1.24 and 2 have taken away, and code of ``gym`` still uses."""


def restore_numpys_names() -> None:
    """Define numpy's removed names if ``gym`` is installed, before any code of ``gym`` runs."""
    if find_spec("gym") is not None:
        for name, value in _NUMPYS_OLD_NAMES.items():
            vars(np).setdefault(name, value)
