"""Has a jail build a wheel: by a program of ours, since packages know nothing of sandboxes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from envhub_sandbox import errors
from envhub_sandbox.dependencies.builds.wheels import MAX_BYTES
from envhub_sandbox.errors import DependencyError
from envhub_sandbox.system import processes
from envhub_worker.protocol.text import printable

PROFILE_VARIABLE = "ENVHUB_BUILD_PROFILE"
WALL_S = 1800.0
LIMITS = {"memory_bytes": "8G", "disk_bytes": "6G", "disk_files": 400_000, "cpu_time_s": 7200}
_PROGRAM = "envhub_sandbox.factory.builder"
_SHOWN = 6000
_AROUND_S = 900.0
_MOST_REQUIRED = 200


class BuildFailedError(DependencyError):
    """The build backend failed, or was ended; the text is what it printed last."""


def build(order: Mapping[str, Any], folder: Path) -> Path | tuple[str, ...]:
    """A wheel below an empty folder, or what the build backend needs besides.

    Nothing of either has been looked at: they are a stranger's. The order is read by
    ``factory/builder.py``; limits, profile and what the jail may read are added here. Raises
    ``BuildFailedError``, or ``DependencyError`` where there is no jail on this host.
    """
    said = _run(order, folder)
    further, name = said.get("requires"), said.get("wheel")
    if isinstance(further, list) and 0 < len(further) <= _MOST_REQUIRED:
        return tuple(text for text in further if isinstance(text, str))
    if not isinstance(name, str):
        raise BuildFailedError("its build backend produced no wheel")
    return folder / "wheel" / os.path.basename(name)


def _run(order: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    whole = {
        **order,
        "readable": [order["source"], order["packages"], str(folder / "tools")],
        "limits": LIMITS,
        "wall_s": WALL_S,
        "max_bytes": MAX_BYTES,
        "profile": os.environ.get(PROFILE_VARIABLE) or "strict",
    }
    (folder / "order.json").write_text(json.dumps(whole))
    with processes.pidfd() as ourselves:
        done = subprocess.run(
            [sys.executable, "-I", "-m", _PROGRAM, str(folder), str(ourselves)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            pass_fds=(ourselves,),
            start_new_session=True,
            timeout=WALL_S + _AROUND_S,
        )
    try:
        said: dict[str, Any] = json.loads(done.stdout)
    except ValueError as error:
        shown = printable(done.stderr.decode("utf-8", "replace")[-_SHOWN:])
        raise DependencyError(f"the program that builds failed:\n{shown}") from error
    if "error" in said:
        kind = getattr(errors, str(said["error"]), DependencyError)
        text = str(said["said"])
        if issubclass(kind, errors.SandboxUnavailableError):
            raise DependencyError(
                f"sources are built in a jail, and there is none here: {text}. A weaker profile "
                f"for builds is chosen by {PROFILE_VARIABLE}, as in {PROFILE_VARIABLE}=no-userns"
            )
        raise DependencyError(text)
    if "failed" in said:
        raise BuildFailedError(printable(str(said["failed"])[-_SHOWN:], _SHOWN))
    return said
