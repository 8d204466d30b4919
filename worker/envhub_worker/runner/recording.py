"""Stand-ins for Gymnasium's vector classes while a repository's ``make_env`` runs.

``SyncVectorEnv(...)`` and ``AsyncVectorEnv(...)`` then only record their arguments. The runner
builds the sub-environments that it needs and steps them itself, so a suite of many tasks costs
nothing before it is used. A recording is a real instance of its class: if a wrapper or the
repository reads an attribute, it builds itself after all, and the runner steps it unchanged.

Deleting or closing a recording does not build it: it has nothing to close. Gymnasium's ``__del__``
reads attributes and would build all processes of every unused task, only to end them.

Followed: ``gymnasium.vector.SyncVectorEnv.__init__`` and ``AsyncVectorEnv.__init__`` (0.26 to 1.4).
"""

from __future__ import annotations

import inspect
import multiprocessing
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_start_method
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv, VectorEnv

from envhub_worker.protocol.records import dataclass
from envhub_worker.runner import gymnasium_compat as compat
from envhub_worker.runner.foreign import old_gym

_KEY = "_envhub_recording"
_ANSWERED = frozenset({"unwrapped", "spec", "closed", "close", "num_envs"})
# Arguments whose effect the worker's own loop does not reproduce.
_FOREIGN_ARGUMENTS = frozenset({"worker", "observation_space", "action_space"})


@dataclass(frozen=True)
class Recording:
    """The arguments of a vector environment that has not been built.

    Attributes:
        autoreset_mode: ``"NextStep"``, ``"SameStep"`` or ``"Disabled"``.
        arguments: All arguments, for building it after all.
    """

    env_fns: list[Callable[[], gym.Env[Any, Any]]]
    sync: bool
    autoreset_mode: str
    arguments: dict[str, Any]


def recording(env: object) -> Recording | None:
    """Returns the recording of a vector environment that is neither built nor closed, else None."""
    own = object.__getattribute__(env, "__dict__") if type(env) in _LAZY.values() else {}
    record = None if own.get("closed") else own.get(_KEY)
    return record if isinstance(record, Recording) else None


@contextmanager
def standing_in() -> Iterator[None]:
    """A context in which the two classes record their arguments instead of building."""
    for cls, recorder in _RECORDERS.items():
        cls.__init__ = recorder
    try:
        yield
    finally:
        for cls, real in _REAL_INIT.items():
            cls.__init__ = real


def _recorder(cls: type[VectorEnv[Any, Any, Any]], lazy: type) -> Callable[..., None]:
    real = _REAL_INIT[cls]
    signature = inspect.signature(real)

    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        record = _record(cls, signature, self, args, kwargs) if type(self) is cls else None
        if record is None:
            real(self, *args, **kwargs)
            return
        self.__dict__[_KEY] = record
        self.__dict__["num_envs"] = len(record.env_fns)
        self.__class__ = lazy

    return __init__


def _record(
    cls: type, signature: inspect.Signature, self: Any, args: Any, kwargs: Any
) -> Recording | None:
    try:
        bound = signature.bind(self, *args, **kwargs)
    except TypeError:
        return None  # the real __init__ says it better
    arguments = dict(bound.arguments)
    arguments.pop("self", None)
    if any(arguments.get(name) is not None for name in _FOREIGN_ARGUMENTS):
        return None
    if arguments.get("observation_mode", "same") != "same":
        return None  # the spaces differ, and only all of them make the batched one
    # ``context`` names a start method of processes, and has no other use here.
    methods = (None, *multiprocessing.get_all_start_methods())
    if not _steps_all_at_once(arguments) or arguments.get("context") not in methods:
        return None
    env_fns = arguments["env_fns"] = list(arguments["env_fns"])
    return Recording(
        env_fns=env_fns,
        sync=cls is SyncVectorEnv,
        autoreset_mode=compat.mode_named(arguments.get("autoreset_mode", compat.DEFAULT_MODE)),
        arguments=arguments,
    )


def _steps_all_at_once(arguments: dict[str, Any]) -> bool:
    """Whether no ``max_concurrency`` delays sub-environments, which the worker cannot do."""
    bound = arguments.get("max_concurrency")
    if bound is None:
        return True
    is_number = isinstance(bound, (int, np.integer))
    return is_number and bool(bound >= max(1, len(arguments["env_fns"])))


def _build_after_all(env: Any, cls: type) -> None:
    kept = dict(object.__getattribute__(env, "__dict__"))
    record, closed = kept.pop(_KEY), kept.pop("closed", False)
    env.__class__ = cls
    del env.__dict__[_KEY]
    env.__dict__.pop("closed", None)
    arguments = dict(record.arguments)
    method = arguments.get("context") or get_start_method()
    if record.sync or method == "fork":  # another process could not import what adapts them
        arguments["env_fns"] = [partial(_adapted, fn) for fn in record.env_fns]
    _REAL_INIT[cls](env, **arguments)
    env.__dict__.update(kept)
    if closed:  # and looked into only then
        env.close()


def _adapted(env_fn: Callable[[], Any]) -> Any:
    return old_gym.adapted(env_fn())


def _lazy_class(cls: type[VectorEnv[Any, Any, Any]]) -> type:
    def __getattribute__(self: Any, name: str) -> Any:
        own = object.__getattribute__(self, "__dict__")
        # Python itself reads dunder attributes: these do not build a recording.
        if not name.startswith("__") and name not in _ANSWERED and name not in own:
            _build_after_all(self, cls)
            return getattr(self, name)
        return object.__getattribute__(self, name)

    def __reduce_ex__(self: Any, protocol: Any) -> Any:
        record: Recording = self.__dict__[_KEY]
        return partial(cls, **record.arguments), ()  # a copy is the same call once more

    body: dict[str, Any] = {
        "__getattribute__": __getattribute__,
        "__reduce_ex__": __reduce_ex__,
        "__del__": _end,
        "close": _close,
        "__doc__": cls.__doc__,
        "__module__": __name__,
    }
    return type(cls.__name__, (cls,), body)


def _end(self: Any) -> None:
    """Replaces ``__del__``: a recording has started nothing."""


def _close(self: Any, **kwargs: Any) -> None:
    """Replaces ``close``: marks a recording closed, which has nothing else to close."""
    self.__dict__["closed"] = True


_CLASSES: tuple[Any, ...] = (SyncVectorEnv, AsyncVectorEnv)
_LAZY: dict[Any, type] = {cls: _lazy_class(cls) for cls in _CLASSES}
_REAL_INIT: dict[Any, Callable[..., None]] = {cls: cls.__init__ for cls in _LAZY}
# Made at import, which a zygote does once for all runners: ``inspect.signature`` is slow.
_RECORDERS = {cls: _recorder(cls, lazy) for cls, lazy in _LAZY.items()}
