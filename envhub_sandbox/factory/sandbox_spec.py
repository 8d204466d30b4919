"""Where the code runs: the sandbox and the interpreter that ``make_env`` is given."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.sandboxes.sandbox import Sandbox, is_list
from envhub_sandbox.settings.options import option_name


def sandbox_of(sandbox: str | Sandbox | list[str | Sandbox], server_key: str | None) -> Sandbox:
    """The sandbox of a name, or the one that was given; of a list, a fleet of these.

    Raises:
        PolicyError: There is none of that name.
        SandboxUnavailableError: This platform has none of that kind.
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
    """Refuse an interpreter of this machine that cannot be run.

    Raises:
        PolicyError: It is not there, or is no program.
    """
    if python and not (os.path.isfile(python) and os.access(python, os.X_OK)):
        raise PolicyError(
            f"{option_name('python')} is {python!r}, which is not a program; it takes the path of "
            "an interpreter, such as '.venv/bin/python'"
        )


def check_readable(paths: Iterable[str]) -> None:
    """Refuse to grant what is not on this machine: it would silently not be there.

    Raises:
        PolicyError: A path leads to nothing.
    """
    for path in paths:
        if not os.path.exists(path):
            raise PolicyError(
                f"{option_name('readable')} has {path!r}, and there is no such file or folder on "
                "this machine"
            )
