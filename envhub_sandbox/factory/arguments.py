"""Arguments of ``make_env``: the sandbox, the interpreter, a config object as plain data.

What has no plain form does not cross to the repository's own ``make_env``.
"""

from __future__ import annotations

import contextlib
import inspect
import os
import shutil
from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import partial
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.sandboxes.sandbox import Sandbox, is_list
from envhub_sandbox.session.repository import PlainConfig
from envhub_sandbox.settings.options import option_name
from envhub_worker.protocol.messages import CONFIG_CLASS

_PLAIN = (type(None), bool, int, float, complex, str, bytes, np.ndarray, np.generic)
_MAX_DEPTH = 16
_LEFT_OUT = object()


def sandbox_of(sandbox: str | Sandbox | list[str | Sandbox], server_key: str | None) -> Sandbox:
    """The sandbox of a name, or the one that was given; of a list, a fleet of these.
    Raises ``PolicyError``: there is none of that name; ``SandboxUnavailableError``: this platform
    has none of that kind.
    """
    fleet: Any = sandbox
    if isinstance(sandbox, (list, tuple)) or (isinstance(sandbox, str) and is_list(sandbox)):
        from envhub_sandbox.sandboxes.fleet.fleet import Fleet

        fleet = Fleet(sandbox)
    if callable(getattr(fleet, "opened", None)):
        opened: Sandbox = fleet.opened(partial(sandbox_of, server_key=None), server_key)
        return opened
    if isinstance(sandbox, str) and sandbox.startswith("tcp://"):
        from envhub_sandbox.sandboxes.remote import RemoteSandbox

        return RemoteSandbox(sandbox, server_key=server_key)
    if server_key is not None:
        raise PolicyError(
            f"{option_name('server_key')} is for {option_name('sandbox', 'tcp://HOST:PORT')}; a "
            "RemoteSandbox has its own"
        )
    if not isinstance(sandbox, str):
        if isinstance(sandbox, list) or not callable(getattr(sandbox, "for_repository", None)):
            raise _unknown(sandbox)
        return sandbox
    if sandbox == "process":
        from envhub_sandbox.sandboxes.process import PROCESS, check_platform

        check_platform()  # before anything is downloaded for it
        return PROCESS
    if sandbox == "ray":
        from envhub_sandbox.sandboxes.ray.sandbox import RAY

        return RAY
    kind, _, image = sandbox.partition(":")
    if kind == "docker":
        from envhub_sandbox.sandboxes.docker.sandbox import DockerSandbox

        return DockerSandbox(image=image) if image else DockerSandbox()
    raise _unknown(sandbox)


def _unknown(sandbox: object) -> PolicyError:
    return PolicyError(
        f"sandbox is {sandbox!r}; it takes 'process', 'docker', 'ray', 'tcp://HOST:PORT', a list "
        "of these, or None to run the code here"
    )


def interpreter(python: str | Path | None) -> str:
    """Its path, absolute; a name alone is looked up as a shell does. Empty for ours."""
    if python is None:
        return ""
    text = os.path.expanduser(python)
    found = shutil.which(text) if os.sep not in str(text) else None
    return os.path.abspath(found or text)


def check_executable(python: str) -> None:
    """Refuse an interpreter of this machine that cannot be run. Raises ``PolicyError``."""
    if python and not (os.path.isfile(python) and os.access(python, os.X_OK)):
        raise PolicyError(
            f"{option_name('python')} is {python!r}, which is not a program; it takes the path of "
            "an interpreter, such as '.venv/bin/python'"
        )


def check_readable(paths: Iterable[str]) -> None:
    """Refuse to grant what is not on this machine: it would silently not be there.
    Raises ``PolicyError``: a path leads to nothing.
    """
    for path in paths:
        if not os.path.exists(path):
            raise PolicyError(
                f"{option_name('readable')} has {path!r}, and there is no such file or folder on "
                "this machine"
            )


# --- a config object ---------------------------------------------------------------------------


def reference_of(cfg: Any) -> tuple[str, Any]:
    """The reference in ``cfg``, and the config object if it is one."""
    if isinstance(cfg, str):
        return cfg, None
    if isinstance(cfg, os.PathLike):
        return os.path.abspath(cfg), None
    hub_path = getattr(cfg, "hub_path", None)
    if isinstance(hub_path, os.PathLike):
        return os.path.abspath(hub_path), cfg
    if isinstance(hub_path, str):
        return hub_path, cfg
    kind = f"{type(cfg).__module__}.{type(cfg).__qualname__}"
    if hasattr(cfg, "hub_path"):
        raise TypeError(f"cfg is a {kind} whose hub_path is {hub_path!r}; it takes a hub reference")
    raise TypeError(f"cfg is a hub reference, a folder, or an object with a hub_path, not {kind}")


def plain_config(config: Any) -> dict[str, object]:
    """The attributes of a config object with nested ones, and its own public properties.

    Dataclasses and other plain objects become mappings which say what their classes are called
    (``messages.CONFIG_CLASS``), and so do members of enums and paths. What has no plain form (a
    function, an open file) is left out: nothing of the caller is pickled.
    """
    return config.values if isinstance(config, PlainConfig) else _attributes(config, 0)


def _attributes(config: Any, depth: int) -> dict[str, object]:
    names = list(getattr(config, "__dict__", {}))
    if is_dataclass(config):
        names = list(dict.fromkeys([*(item.name for item in fields(config)), *names]))
    made = _known({name: _plain(getattr(config, name, None), depth + 1) for name in names})
    wanted = {item.name for item in fields(config)} if is_dataclass(config) else made
    computed = _known({name: _plain(value, 1) for name, value in _computed(config, depth)})
    described = (_names(type(config)), tuple(name for name in made if name in wanted), computed)
    return {**made, CONFIG_CLASS: described}


def _is_key(key: Any) -> bool:
    plain = key.value if isinstance(key, Enum) else key
    return isinstance(plain, Hashable) and type(_plain(plain, 0)) is type(plain)


def _known(values: dict[Any, Any]) -> dict[Any, Any]:
    return {name: value for name, value in values.items() if value is not _LEFT_OUT}


def _names(kind: type) -> tuple[tuple[str, str], ...]:
    """Module and name of a class and of those that it inherits from."""
    return tuple((cls.__module__, cls.__qualname__) for cls in kind.__mro__ if cls is not object)


def _computed(config: Any, depth: int) -> Iterator[tuple[str, Any]]:
    """The public properties of a config that can be had: LeRobot's have their ``type`` so."""
    kind = type(config)
    for name in [] if depth else dir(kind):
        if name.startswith("_") or not isinstance(inspect.getattr_static(kind, name), property):
            continue
        with contextlib.suppress(Exception):
            yield name, getattr(config, name)


def _plain(value: Any, depth: int) -> Any:
    if depth > _MAX_DEPTH or callable(value):
        return _LEFT_OUT
    if isinstance(value, Enum):
        inner = _plain(value.value, depth)
        return {CONFIG_CLASS: (_names(type(value)), None, {}), "value": inner}
    if isinstance(value, _PLAIN):
        return value
    if isinstance(value, os.PathLike):
        text = os.fspath(value)
        named = {CONFIG_CLASS: ((("pathlib", "Path"),), None, {}), "value": text}
        return named if isinstance(value, PurePath) else text
    if isinstance(value, Mapping):
        keys = {k: k.value if isinstance(k, Enum) else k for k in value if _is_key(k)}
        kept = _known({key: _plain(value[k], depth + 1) for k, key in keys.items()})
        return kept if type(value) is dict else {**kept, CONFIG_CLASS: ((), (), {})}
    if isinstance(value, (list, tuple, set, frozenset)):
        made = [item for item in (_plain(v, depth + 1) for v in value) if item is not _LEFT_OUT]
        return tuple(made) if isinstance(value, tuple) else made
    if hasattr(value, "__dict__") or is_dataclass(value):
        return _attributes(value, depth)
    return _LEFT_OUT
