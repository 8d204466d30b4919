"""Environments from the Hugging Face Hub, whose code runs in confined processes.

    >>> from envhub_sandbox import make_env
    >>> envs = make_env("org/repo@<commit>", n_envs=4)
    >>> obs, infos = envs.env.reset(seed=0)

Importing this package is cheap: it imports a name's module when the name is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from envhub_sandbox import errors as errors
    from envhub_sandbox.extras.docker.sandbox import DockerSandbox as DockerSandbox
    from envhub_sandbox.extras.fleet.fleet import Fleet as Fleet
    from envhub_sandbox.extras.ray.sandbox import RaySandbox as RaySandbox
    from envhub_sandbox.extras.remote.sandbox import RemoteSandbox as RemoteSandbox
    from envhub_sandbox.factory.make_env import make_env as make_env
    from envhub_sandbox.hub.reference import HubRef as HubRef
    from envhub_sandbox.integrations.gym import SandboxEnv as SandboxEnv
    from envhub_sandbox.settings.policy import Limits as Limits
    from envhub_sandbox.settings.policy import Policy as Policy
    from envhub_sandbox.settings.policy import Timeouts as Timeouts
    from envhub_sandbox.vector.suites import EnvSuites as EnvSuites
    from envhub_sandbox.vector.vector_env import SandboxVectorEnv as SandboxVectorEnv

    __version__: str

_HOMES = {
    "DockerSandbox": "extras.docker.sandbox",
    "EnvSuites": "vector.suites",
    "Fleet": "extras.fleet.fleet",
    "HubRef": "hub.reference",
    "Limits": "settings.policy",
    "Policy": "settings.policy",
    "RaySandbox": "extras.ray.sandbox",
    "RemoteSandbox": "extras.remote.sandbox",
    "SandboxEnv": "integrations.gym",
    "SandboxVectorEnv": "vector.vector_env",
    "Timeouts": "settings.policy",
    "errors": "errors",
    "make_env": "factory.make_env",
}

__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name == "__version__":  # there, because a worker's image lacks this package
        return importlib.import_module("envhub_worker").__version__
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f"{__name__}.{_HOMES[name]}")
    return module if name == "errors" else getattr(module, name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
