"""The control: a repository imported as LeRobot imports it, in a process without any sandbox.

``python control.py REPOSITORY ENTRY ACTIONS RESULTS``, in an environment that has the repository's
packages and nothing of ours. Steps it by hand, with the actions that the sandboxed one was given,
and writes down what came: one line for each reset and step.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

SEED = 7


def plain(value: Any) -> Any:
    """A value as JSON: each array with dtype, shape and bytes, so that equal is bit for bit."""
    if isinstance(value, Mapping):
        return {"keys": [[str(key), plain(value[key])] for key in sorted(value, key=str)]}
    if isinstance(value, (list, tuple)):
        return {"items": [plain(one) for one in value]}
    if isinstance(value, str):
        return {"text": value}
    array = np.asarray(value)
    if array.dtype == object:
        return {"items": [plain(one) for one in array.tolist()]}
    return {"dtype": array.dtype.str, "shape": array.shape, "hex": array.tobytes().hex()}


def restored(value: Any) -> Any:
    """What ``plain`` has written; sequences as tuples, mappings with keys of text."""
    if "keys" in value:
        return {key: restored(one) for key, one in value["keys"]}
    if "items" in value:
        return tuple(restored(one) for one in value["items"])
    if "text" in value:
        return value["text"]
    flat = np.frombuffer(bytes.fromhex(value["hex"]), np.dtype(value["dtype"]))
    return flat.reshape(value["shape"]).copy()


def line(
    observation: Any, reward: Any = 0.0, terminated: Any = False, truncated: Any = False
) -> str:
    """One reset or step, short enough to keep: a hash of the observation, and the rest as it is."""
    digest = hashlib.sha256(json.dumps(plain(observation)).encode()).hexdigest()[:16]
    rewards = np.asarray(reward, np.float64).ravel().tolist()
    flags = [int(np.any(one)) for one in (terminated, truncated)]
    return f"{digest} {rewards!r} {flags!r}"


class Single:
    """An ``Env`` of Gymnasium or gym as a vector of one that resets in the step after the end."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self._over = False

    def reset(self, seed: int) -> Any:
        """The observation in a batch of one."""
        if "seed" in inspect.signature(self._env.unwrapped.reset).parameters:
            return self._batch(self._observation(self._env.reset(seed=seed)))
        seeds = getattr(self._env.unwrapped, "seed", None)
        if seeds is not None and inspect.signature(seeds).parameters:
            self._env.seed(seed)
        return self._batch(self._observation(self._env.reset()))

    def sample(self) -> Any:
        """Some action, in a batch of one."""
        return batch(self._env.action_space, self._env.action_space.sample())

    def step(self, action: Any) -> Any:
        """Observation, reward, terminated, truncated."""
        if self._over:
            self._over = False
            return self._batch(self._observation(self._env.reset())), 0.0, False, False
        observation, reward, *done, info = self._env.step(row(self._env.action_space, action))
        if len(done) == 1:
            cut = info.get("TimeLimit.truncated", False)
            done = [done[0] and not cut, done[0] and cut]
        self._over = any(done)
        return self._batch(observation), reward, *done

    def _observation(self, result: Any) -> Any:
        has_info = isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict)
        return result[0] if has_info else result

    def _batch(self, observation: Any) -> Any:
        return batch(self._env.observation_space, observation)


def batch(space: Any, member: Any) -> Any:
    """A batch of one, as ``SyncVectorEnv`` makes it."""
    kind = type(space).__name__
    if kind == "Dict":
        return {key: batch(one, member[key]) for key, one in space.spaces.items()}
    if kind == "Tuple":
        return tuple(batch(one, part) for one, part in zip(space.spaces, member))  # noqa: B905
    if kind in ("Box", "Discrete", "MultiDiscrete", "MultiBinary"):
        return np.asarray(member, space.dtype)[None]
    return (member,)


def row(space: Any, actions: Any) -> Any:
    """The one action of a batch."""
    kind = type(space).__name__
    if kind == "Dict":
        return {key: row(one, actions[key]) for key, one in space.spaces.items()}
    if kind == "Tuple":
        return tuple(row(one, part) for one, part in zip(space.spaces, actions))  # noqa: B905
    return actions[0]


class Vector:
    """A vector environment, as it is."""

    def __init__(self, env: Any) -> None:
        self._env = env

    def reset(self, seed: int) -> Any:
        """The observation."""
        return self._env.reset(seed=seed)[0]

    def sample(self) -> Any:
        """Some actions."""
        return self._env.action_space.sample()

    def step(self, actions: Any) -> Any:
        """Observation, rewards, terminations, truncations."""
        return self._env.step(actions)[:4]


def first_of(result: Any) -> Any:
    """The first environment of what ``make_env`` returned."""
    while isinstance(result, (Mapping, list, tuple)):
        result = next(iter(result.values() if isinstance(result, Mapping) else result))
    return Vector(result) if hasattr(result, "num_envs") else Single(result)


def make_env_of(repository: Path, entry: str) -> Any:
    """``make_env`` of the entry file, whose folder and root are importable."""
    path = repository / entry
    sys.path[:0] = [str(path.parent), str(repository)]
    spec = importlib.util.spec_from_file_location("hub_env", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["hub_env"] = module
    sys.dont_write_bytecode = True  # a repository in which bytecode lies is another one
    spec.loader.exec_module(module)
    return module.make_env


def main(repository: str, entry: str, actions: str, results: str) -> None:
    """Step it, and write down what came."""
    env = first_of(make_env_of(Path(repository), entry)(n_envs=1, use_async_envs=False))
    lines = [line(env.reset(seed=SEED))]
    if Path(actions).exists():
        given = json.loads(Path(actions).read_text())
        lines += [line(*env.step(restored(one))) for one in given]
    else:  # it did not run in the sandbox: does it here?
        lines += [line(*env.step(env.sample())) for _ in range(3)]
    Path(results).write_text("\n".join(lines))


if __name__ == "__main__":
    main(*sys.argv[1:])
