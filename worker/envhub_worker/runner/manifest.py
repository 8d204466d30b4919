"""Describes live environments as manifests. Runs in the jail; the client checks each manifest."""

from __future__ import annotations

import os
import platform
import sys
from contextlib import suppress
from typing import Any

from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers import TimeLimit

from envhub_worker.protocol.manifest.manifest import EnvManifest, Manifest
from envhub_worker.protocol.manifest.names import MAX_NAMES, PLAIN_KEYS
from envhub_worker.runner import gymnasium_compat as compat
from envhub_worker.runner.described import facts_of
from envhub_worker.runner.sync_envs import SubEnvs
from envhub_worker.runner.tasks import Task
from envhub_worker.runner.vector_spaces import Sides

_GYMNASIUMS = frozenset(dir(VectorEnv)) | compat.OWN_NAMES | {"num_envs", "env", "envs"}
_HEAD_BYTES = 2048
"""The name and the version come first."""
_LINES = 16


def describe(tasks: list[Task]) -> Manifest:
    """Describes everything that ``make_env`` returned as a manifest."""
    lazy = all(task.recording is not None for task in tasks)
    envs = []
    sides: Sides = {}
    for task in tasks:
        envs.append(_describe_task(task, sides))
        if len(tasks) > 1 and task.probe is not None:
            task.probe.close()  # a suite must not hold an environment of every task
            task.probe = None
    return Manifest(envs=tuple(envs), lazy=lazy, interpreter=_interpreter(), packages=_packages())


def _describe_task(task: Task, sides: Sides) -> EnvManifest:
    recording = task.recording
    if recording is None:
        return describe_vector(task, task.vector, sides)
    source = task.learn_spaces()
    return EnvManifest(
        suite=task.suite,
        task=task.task,
        num_envs=task.num_envs,
        shardable=True,
        sync=recording.sync,
        independent=task.independent,
        single_observation_space=source.observation_space,
        single_action_space=source.action_space,
        observation_space=batch_space(source.observation_space, task.num_envs),
        action_space=batch_space(source.action_space, task.num_envs),
        autoreset_mode=recording.autoreset_mode,
        metadata=_metadata(source),
        render_mode=getattr(source, "render_mode", None),
        spec=_spec(source),
        attributes=(),
        type_name=f"gymnasium.vector.{'Sync' if recording.sync else 'Async'}VectorEnv",
    )


def describe_vector(task: Task, env: Any, sides: Sides | None = None) -> EnvManifest:
    """Describes a vector environment that has its own ``step``."""
    mode = compat.mode_of(env, dict(getattr(env, "metadata", None) or {}).get("autoreset_mode"))
    spaces = env if isinstance(env, SubEnvs) else task.vector_spaces({} if sides is None else sides)
    return EnvManifest(
        suite=task.suite,
        task=task.task,
        num_envs=int(env.num_envs),
        shardable=False,
        sync=True,
        independent=False,
        single_observation_space=spaces.single_observation_space,
        single_action_space=spaces.single_action_space,
        observation_space=spaces.observation_space,
        action_space=spaces.action_space,
        autoreset_mode=getattr(mode, "value", mode),
        metadata=_metadata(env),
        render_mode=getattr(env, "render_mode", None),
        spec=_spec(env),
        attributes=_attributes(env),
        type_name=f"{type(env).__module__}.{type(env).__qualname__}",
    )


def _spec(env: Any) -> dict[str, Any] | None:
    """Returns the facts of the spec; without a spec, the episode length of a ``TimeLimit``."""
    spec = None
    with suppress(Exception):  # Gymnasium's wrappers make it, of what the repository gave them
        spec = env.spec
    if getattr(spec, "id", None) is not None:
        return facts_of(spec)
    limits = (layer for layer in compat.layers(env) if isinstance(layer, TimeLimit))
    return next(({"max_episode_steps": layer._max_episode_steps} for layer in limits), None)


def _attributes(env: Any) -> tuple[str, ...]:
    names = dict.fromkeys(dir(env)) | dict.fromkeys(dir(getattr(env, "unwrapped", env)))
    own = [name for name in names if name not in _GYMNASIUMS and not name.startswith("__")]
    return tuple(own[:MAX_NAMES])


def _metadata(env: Any) -> dict[Any, Any]:
    metadata = dict(getattr(env, "metadata", None) or {})
    return {_key(key): value for key, value in metadata.items() if key != "autoreset_mode"}


def _key(key: Any) -> Any:
    parts = key if type(key) is tuple else (key,)
    return key if all(type(part) in (str, *PLAIN_KEYS) for part in parts) else str(key)


def _interpreter() -> dict[str, str]:
    version = f"{platform.python_implementation()} {platform.python_version()}"
    # as platform.platform(), without the process that this would start
    host = os.uname()
    libc = (os.confstr("CS_GNU_LIBC_VERSION") or "").replace(" ", "")
    system = "-".join(filter(None, (host.sysname, host.release, host.machine, libc)))
    return {"version": version, "executable": sys.executable or "", "platform": system}


def _packages() -> dict[str, str]:
    """Returns versions by name. Reads only the head of each metadata file: whole files would take
    60 ms and 6 MB.
    """
    versions: dict[str, str] = {}
    for folder in sys.path:
        for file in _metadata_in(folder):
            fields = _head_of(file)
            if "Name" in fields and "Version" in fields and len(versions) < MAX_NAMES:
                versions.setdefault(fields["Name"], fields["Version"])
    return {name: versions[name] for name in sorted(versions, key=str.lower)}


def _metadata_in(folder: str) -> list[str]:
    try:
        names = sorted(os.listdir(folder or "."))
    except OSError:
        return []
    files = {".dist-info": "METADATA", ".egg-info": "PKG-INFO"}
    kinds = [(name, files.get(os.path.splitext(name)[1])) for name in names]
    return [os.path.join(folder, name, file) for name, file in kinds if file]


def _head_of(metadata: str) -> dict[str, str]:
    try:
        with open(metadata, "rb", buffering=0) as file:
            head = file.read(_HEAD_BYTES).partition(b"\n\n")[0]
    except OSError:
        return {}
    pairs = (line.decode(errors="replace").partition(": ") for line in head.splitlines()[:_LINES])
    return {key: value.strip() for key, _, value in pairs if key in ("Name", "Version")}
