"""``SyncVectorEnv(env_fns)`` that lives in a sandbox; as a pytest plugin, in Gymnasium's place.
Imports nothing of our tests: where somebody else's tests run, ``tests`` is their package."""

import contextlib
import importlib
import json
import operator
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import pytest

from envhub_sandbox import RemoteSandbox, SandboxVectorEnv, make_env
from envhub_sandbox.errors import LoadError
from envhub_sandbox.vector.single_env import SingleEnv

REPOSITORY = Path(__file__).resolve().parents[2] / "samples" / "given"
VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "subclass": {"env_kwargs": {"subclass": True}},
    "frames": {"policy": {"lane": "frames"}},
    "workers": {"num_workers": 2},
    "tcp": {},
    "single": {},
}
"""What else ``make_env`` is told; ``"tcp"`` is told where its server is, too. ``"single"`` is for
tests of single environments: what these make is in a sandbox."""
SERVER = "ENVHUB_THEIRS_SERVER"


def vector(
    env_fns: Sequence[Callable[[], gym.Env[Any, Any]]],
    *,
    use_async_envs: bool = False,
    options: dict[str, Any] | None = None,
    **kwargs: Any,
) -> SandboxVectorEnv:
    """A vector environment of these functions, which are called in a sandbox."""
    env_fns = list(env_fns)
    options = dict(options or {})
    with by_value():
        pickled = cloudpickle.dumps((env_fns, kwargs))
    suites = make_env(
        REPOSITORY,
        n_envs=len(env_fns),
        use_async_envs=use_async_envs,
        env_kwargs={**options.pop("env_kwargs", {}), "pickled": pickled},
        **options,
    )
    return suites.env


@contextlib.contextmanager
def by_value() -> Iterator[None]:
    """The tests' own modules are not to be had in the sandbox: what is in them travels along."""
    named = [name for name in sys.modules if name.partition(".")[0] in ("tests", "conftest")]
    modules = [sys.modules[name] for name in named if hasattr(sys.modules[name], "__file__")]
    known = cloudpickle.list_registry_pickle_by_value()
    modules = [module for module in modules if module.__name__ not in known]
    for module in modules:
        cloudpickle.register_pickle_by_value(module)
    try:
        yield
    finally:
        for module in modules:
            cloudpickle.unregister_pickle_by_value(module)


def options_of(variant: str) -> dict[str, Any]:
    options = dict(VARIANTS[variant])
    if variant == "tcp":
        server = json.loads(os.environ[SERVER])
        endpoint = server.pop("endpoint")
        options["sandbox"] = RemoteSandbox(endpoint, **server)
    return options


def replacement(variant: str, use_async_envs: bool) -> type:
    """A class that makes sandboxed environments, and that they are instances of."""
    options = options_of(variant)

    class Meta(type):
        def __call__(cls, env_fns: Any, *args: Any, **kwargs: Any) -> SandboxVectorEnv:
            names = _POSITIONS[use_async_envs]
            kwargs |= dict(zip(names, args, strict=False))
            return vector(env_fns, use_async_envs=use_async_envs, options=options, **kwargs)

        def __instancecheck__(cls, instance: object) -> bool:
            return isinstance(instance, SandboxVectorEnv)

    return Meta("AsyncVectorEnv" if use_async_envs else "SyncVectorEnv", (), {})


_POSITIONS = {
    False: ("copy", "observation_mode", "autoreset_mode"),
    True: ("shared_memory", "copy", "context", "daemon", "worker", "observation_mode"),
}


class SingleMaker:
    """Called like a function or a class of theirs, whose environment is then in a sandbox.
    In the sandbox it is the function or the class itself: their own code names it there."""

    def __init__(self, make: Any) -> None:
        self._make = make

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """One environment, or without a sandbox what no vector environment can be made of."""
        if args and isinstance(args[0], gym.envs.registration.EnvSpec):
            return self._make(*args, **kwargs)  # whose entry point may be a test's own wrapper
        try:
            return SingleEnv(vector([partial(self._make, *args, **kwargs)]))
        except LoadError:  # one without spaces, for instance, which a test of theirs is about
            return self._make(*args, **kwargs)

    def __reduce__(self) -> tuple[Any, ...]:
        return operator.itemgetter(0), ((self._make,),)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--variant", choices=VARIANTS, default="plain", help="how it is sandboxed")


def pytest_configure(config: pytest.Config) -> None:
    """Gymnasium's classes make sandboxed environments from now on, before a test is imported."""
    if config.option.variant == "single":
        theirs = importlib.import_module("tests.testing_env")
        for module, name in ((theirs, "GenericTestEnv"), (gym, "make")):
            setattr(module, name, SingleMaker(getattr(module, name)))
        return
    for name, use_async_envs in (("SyncVectorEnv", False), ("AsyncVectorEnv", True)):
        setattr(gym.vector, name, replacement(config.option.variant, use_async_envs))
