"""One sub-environment, ``env.envs[0]``: a proxy of the ``Env`` in the jail.

Followed: ``gymnasium.vector.SyncVectorEnv.envs``, which has the environments themselves. A step or
a reset of one of them changes no state of the vector environment, which keeps the observation and
the end of an episode of its own last step.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from envhub_sandbox.errors import RemoteProtocolError
from envhub_sandbox.transport.replies import typed_reply
from envhub_sandbox.transport.values import seeds
from envhub_sandbox.vector.tracebacks import short_traceback
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.inert import RemoteObject
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.lifecycle import State
from envhub_worker.protocol.manifest.names import is_servable
from envhub_worker.protocol.spaces import batches

_OUTERMOST = 0
_SEARCHED = -1
"""In place of a depth: the outermost wrapper that has the attribute."""
_MOST_WRAPPERS = 1000
"""The most wrappers around one environment, which a hostile worker could make endless. A step makes
a nested call for each, of which Python permits about as many."""
_OURS = frozenset({"_vector", "_index", "_depth"})


def _space(name: str) -> Any:
    """A property that is read in the jail, unless there is none that may have changed the space."""

    @short_traceback
    def space(env: SubEnvironment) -> Any:
        runs = env._vector._session.lifecycle.state is State.READY
        shown = env._is_shown and not runs
        return getattr(env._vector, f"single_{name}") if shown else env._get(name)

    return property(space)


def metadata_of_one(vector: Any) -> dict[str, Any]:
    """The metadata without the autoreset mode, which only a vector environment has."""
    return {key: value for key, value in vector.metadata.items() if key != "autoreset_mode"}


class SubEnvironment(gym.Env[Any, Any]):
    """A proxy of one sub-environment of a vector environment, or of one of its wrappers.

    Reading a method asks the worker whether it is a method, and runs nothing. Attributes with an
    underscore and names that libraries look for in any object are not requested; read them by
    ``get_wrapper_attr``.

    Args:
        vector: Its ``SandboxVectorEnv``.
        index: Which of the sub-environments it is.
        depth: How many wrappers are looked through; None for all.
    """

    def __init__(self, vector: Any, index: int, depth: int | None = _OUTERMOST) -> None:
        self._vector = vector
        self._index = index
        self._depth = depth

    # --- the interface of gymnasium.Env ----------------------------------------------------------

    @short_traceback
    def reset(self, *args: Any, **kwargs: Any) -> Any:
        """Reset this sub-environment alone. The state of the vector environment does not change."""
        self._refuse_unless_sync("reset")
        return self._restored(self._call("reset", args, kwargs))

    @short_traceback
    def step(self, *args: Any, **kwargs: Any) -> Any:
        """Step this sub-environment alone; the vector environment's state does not change."""
        self._refuse_unless_sync("step")
        return self._restored(self._call("step", args, kwargs))

    @short_traceback
    def render(self, *args: Any, **kwargs: Any) -> Any:
        """The rendering of this sub-environment."""
        return self._call("render", args, kwargs)

    @short_traceback
    def close(self) -> None:
        """Close it. Raises ``ValueError``: there are others, which cannot continue without it."""
        if self._vector.num_envs > 1:
            raise ValueError(
                f"cannot close sub-environment {self._index} of {self._vector.num_envs}: the "
                "others could not go on without it; close the vector environment"
            )
        self._call("close", (), {})

    @property
    def unwrapped(self) -> SubEnvironment:
        """The innermost environment."""
        if self._depth is None:
            return self
        return SubEnvironment(self._vector, self._index, None)

    @property
    @short_traceback
    def env(self) -> Any:
        """The environment that this wrapper wraps.
        Raises ``AttributeError``: this is not a wrapper; ``RemoteProtocolError``: there are too
        many wrappers.
        """
        if self._depth is not None and self._depth >= _MOST_WRAPPERS:
            raise RemoteProtocolError(f"the worker reports more than {_MOST_WRAPPERS} wrappers")
        wrapped = self._get("env")
        if self._depth is None or not (callable(wrapped) or isinstance(wrapped, RemoteObject)):
            return wrapped
        return SubEnvironment(self._vector, self._index, self._depth + 1)

    action_space = _space("action_space")
    observation_space = _space("observation_space")

    @property
    def render_mode(self) -> Any:  # type: ignore[override]
        """The mode in which it renders."""
        return self._vector.render_mode if self._is_shown else self._get("render_mode")

    @property
    def metadata(self) -> Any:  # type: ignore[override]
        """The metadata of this sub-environment."""
        return metadata_of_one(self._vector) if self._is_shown else self._get("metadata")

    @property
    @short_traceback
    def spec(self) -> Any:  # type: ignore[override]
        """The spec of this sub-environment: facts only, not usable by ``gym.make``."""
        return self._get("spec")

    @property  # type: ignore[misc]  # there is nothing to set
    @short_traceback
    def np_random(self) -> Any:
        """The generator: a draw here advances it in the jail, and the other way round.

        A copy if the repository's own class has the sub-environments.
        """
        if self._vector._manifest.shardable:
            return self._vector._generators.read()[self._index]
        return self._get("np_random")

    @property
    @short_traceback
    def np_random_seed(self) -> Any:
        """The seed of its generator."""
        seed = self._get("np_random_seed")
        with UNTRUSTED:
            return seeds(seed)

    @property
    def _is_shown(self) -> bool:
        """Whether the vector environment shows this one's spaces and metadata as its own."""
        return self._vector._manifest.shardable and not self._index and self._depth == _OUTERMOST

    # --- its own attributes ----------------------------------------------------------------------

    @short_traceback
    def has_wrapper_attr(self, name: str) -> bool:
        """Whether the sub-environment or a wrapper of it has an attribute of this name."""
        has_attribute = self._call("has_wrapper_attr", (name,), {})
        with UNTRUSTED:  # an array has no truth value
            return bool(has_attribute)

    @short_traceback
    def get_wrapper_attr(self, name: str) -> Any:
        """An attribute of the outermost wrapper that has it."""
        return self.np_random if name == "np_random" else self._get(name, _SEARCHED)

    @short_traceback
    def set_wrapper_attr(self, name: str, value: Any, **kwargs: Any) -> Any:
        """Set an attribute of the outermost wrapper that has it."""
        return self._call("set_wrapper_attr", (name, value), kwargs)

    @short_traceback
    def __getattr__(self, name: str) -> Any:
        """An attribute, or a function that calls the method of that name."""
        if not is_servable(name):
            raise AttributeError(
                f"a sub-environment shows no {name!r}; if the environment has one, use "
                f"get_wrapper_attr({name!r})"
            )
        return self._get(name)

    @short_traceback
    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute of the sub-environment in the jail."""
        if name in _OURS:
            object.__setattr__(self, name, value)
        elif name == "np_random" and self._vector._manifest.shardable:
            self._vector._generators.put(self._index, value)
        else:
            self._call("__setattr__", (name, value), {})

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SubEnvironment) and self._identity() == other._identity()

    def __hash__(self) -> int:
        return hash(self._identity())

    def __repr__(self) -> str:
        return f"<sub-environment {self._index} of {self._vector!r}>"

    __str__ = __repr__

    # --- requests --------------------------------------------------------------------------------

    def _identity(self) -> tuple[int, int, int | None]:
        return id(self._vector), self._index, self._depth

    def _get(self, name: str, depth: int | None = None) -> Any:
        level = self._depth if depth is None else depth
        reply = self._vector._requests.ask_one(
            name, self._index, lambda number, row: m.GetOne(number, row, level, name)
        )
        if isinstance(reply, m.Value):
            return self._vector._spaces.of(reply.value)

        @short_traceback
        def method(*args: Any, **kwargs: Any) -> Any:
            return self._call(name, args, kwargs, level)

        method.__name__ = method.__qualname__ = name
        return method

    def _call(
        self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any], depth: int | None = None
    ) -> Any:
        level = self._depth if depth is None else depth

        def message(number: int, row: int | None) -> m.Message:
            call = (args, kwargs) if row is not None else ((), {})
            return m.CallOne(number, row, level, name, *call)

        reply = self._vector._requests.ask_one(name, self._index, message)
        return self._vector._spaces.of(typed_reply(reply, m.Value).value)

    def _restored(self, result: Any) -> Any:
        """The result of a reset or a step, with observations in the classes of the space."""
        space = self._vector._manifest.single_observation_space  # the caller may set another one
        if type(result) is not tuple or not result or not batches.restores(space):
            return result
        with UNTRUSTED:
            return (batches.restore(space, result[0]), *result[1:])

    def _refuse_unless_sync(self, name: str) -> None:
        if not self._vector._manifest.sync:
            raise ValueError(
                f"cannot {name} one sub-environment of an AsyncVectorEnv: use `{name}` of the "
                "vector environment, or have the repository return a SyncVectorEnv "
                "(use_async_envs=False)"
            )
