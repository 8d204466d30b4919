"""Where it runs, and of what: the words for it that ``make_env`` takes."""

from __future__ import annotations

import os
from typing import Any

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.option_names import option_name
from envhub_sandbox.sandboxes.base import Sandbox


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


def sandbox_of(sandbox: str | Sandbox, server_key: str | None) -> Sandbox:
    """The sandbox of a name, or the one that was given.

    Raises:
        PolicyError: There is none of that name.
    """
    if isinstance(sandbox, str) and sandbox.startswith("tcp://"):
        from envhub_sandbox.sandboxes.remote import RemoteSandbox

        return RemoteSandbox(sandbox, server_key=server_key)
    if server_key is not None:
        raise PolicyError(
            f"{option_name('server_key')} is for {option_name('sandbox', 'tcp://HOST:PORT')}; a "
            "RemoteSandbox has its own"
        )
    if not isinstance(sandbox, str):
        if not callable(getattr(sandbox, "acquire", None)):
            raise _unknown(sandbox)
        return sandbox
    if sandbox == "process":
        from envhub_sandbox.sandboxes.process import PROCESS

        return PROCESS
    kind, _, image = sandbox.partition(":")
    if kind == "docker":
        from envhub_sandbox.sandboxes.docker.sandbox import DockerSandbox

        return DockerSandbox(image=image) if image else DockerSandbox()
    raise _unknown(sandbox)


def _unknown(sandbox: object) -> PolicyError:
    return PolicyError(
        f"sandbox is {sandbox!r}; it is 'process', 'docker', 'tcp://HOST:PORT', or None to run the "
        "code here"
    )
