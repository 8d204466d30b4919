"""``sandbox=None``: runs the repository's code in the caller's process, exactly as LeRobot does.

Nothing protects the caller here, but the files come from a verified snapshot. Followed:
``lerobot.envs.utils._download_hub_file``, ``_import_hub_module``, ``_call_make_env`` and
``_normalize_hub_result``.
"""

from __future__ import annotations

import importlib.util
import sys
from typing import Any

import gymnasium as gym

from envhub_sandbox.errors import DependencyError, LoadError
from envhub_sandbox.hub.snapshot import Snapshot


def refusal(reference: str) -> RuntimeError:
    """The error for a missing ``trust_remote_code``, with LeRobot's text."""
    return RuntimeError(
        f"Refusing to execute remote code from the Hub for '{reference}'. "
        "Executing hub env modules runs arbitrary Python code from third-party repositories. "
        "If you trust this repo and understand the risks, call `make_env(..., "
        "trust_remote_code=True)` and prefer pinning to a specific revision: "
        "'user/repo@<commit-hash>:env.py'. Or keep it out of this process: "
        '`make_env(..., sandbox="process")` needs no trust.'
    )


def make(
    snapshot: Snapshot, n_envs: int, use_async_envs: bool, cfg: Any, env_kwargs: dict[str, Any]
) -> dict[str, dict[Any, Any]]:
    """Import the entry file in this process, call its ``make_env``, and return its suites."""
    make_env = getattr(_import(snapshot), "make_env", None)
    if make_env is None:
        raise LoadError(
            f"{snapshot.repo_id}:{snapshot.path} must expose "
            "`make_env(n_envs=int, use_async_envs=bool)`."
        )
    arguments = {"n_envs": n_envs, "use_async_envs": use_async_envs, **env_kwargs}
    if cfg is not None:
        arguments["cfg"] = cfg
    return _normalised(make_env(**arguments))


def _import(snapshot: Snapshot) -> Any:
    name = f"hub_env_{snapshot.repo_id.replace('/', '_')}"
    spec = importlib.util.spec_from_file_location(name, snapshot.root / snapshot.path)
    if spec is None or spec.loader is None:
        raise LoadError(f"{snapshot.repo_id}:{snapshot.path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses with postponed annotations look the module up there
    # root could write bytecode into the store, where the next use would find an extra file
    before, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        spec.loader.exec_module(module)
    except ModuleNotFoundError as error:
        del sys.modules[name]
        raise DependencyError(
            f"{snapshot.repo_id}:{snapshot.path} failed to import because the dependency "
            f"'{error.name or error}' is not installed locally."
        ) from error
    except BaseException:
        del sys.modules[name]
        raise
    finally:
        sys.dont_write_bytecode = before
    return module


def _normalised(result: Any) -> dict[str, dict[Any, Any]]:
    if isinstance(result, dict):
        return result
    suite = getattr(getattr(result, "spec", None), "id", None) or "hub_env"
    if isinstance(result, gym.vector.VectorEnv):
        return {suite: {0: result}}
    if isinstance(result, gym.Env):
        return {suite: {0: gym.vector.SyncVectorEnv([lambda: result])}}
    raise LoadError(
        "make_env must return a mapping {suite: {task_id: vec_env}}, a gym.vector.VectorEnv or a "
        f"gym.Env; it returned {type(result).__module__}.{type(result).__qualname__}"
    )
