"""The entry file of the jail in which sources are built; copied into it, and never imported here.

It calls the build backend, a stranger's code, in a child process, and returns the wheel in pieces.
Its answers are not trusted: ``extras.packages.builds`` checks the wheel.
"""

from __future__ import annotations

import base64
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym

TAIL = 16_000
_SINCE = "315532800"
"""The time of all files in a wheel (SOURCE_DATE_EPOCH): the earliest that a zip can have."""


class Build(gym.Env[Any, Any]):
    """An environment in name only, for its method ``build``."""

    observation_space = gym.spaces.Discrete(1)
    action_space = gym.spaces.Discrete(1)
    _wheel: Path

    def build(self, order: Mapping[str, Any]) -> dict[str, Any]:
        """Build a wheel, or return which further packages its backend needs.
        ``order``: ``source``, ``packages``, ``tools``: folders; ``python``: the interpreter;
        ``backend``, ``backend_path``; ``known``: the requirements that the backend has already;
        ``environment``: further variables.
        """
        sys.path.insert(0, order["tools"])
        from pyproject_hooks import BuildBackendHookCaller, HookMissing

        folder = Path(tempfile.gettempdir(), "build")
        shutil.copytree(order["source"], folder / "source", copy_function=_copied)
        (folder / "wheel").mkdir()
        hooks = BuildBackendHookCaller(
            *(str(folder / "source"), order["backend"], order["backend_path"] or None),
            runner=_Runner(folder / "log", order),
            python_executable=order["python"],
        )
        try:
            needed = map(str, hooks.get_requires_for_build_wheel())
            if further := [name for name in needed if name not in order["known"]]:
                return {"requires": further}
            name = hooks.build_wheel(str(folder / "wheel"))
        except subprocess.CalledProcessError:
            return {"failed": _tail(folder / "log")}
        except HookMissing as error:
            return {"failed": repr(error)}
        except Exception as error:  # raised by the backend, or the backend is missing
            return {"failed": f"{_tail(folder / 'log')}\n{type(error).__name__}: {error}"}
        self._wheel = folder / "wheel" / Path(name).name
        mend(self._wheel)
        return {"wheel": self._wheel.name, "size": self._wheel.stat().st_size}

    def read(self, start: int, size: int) -> bytes:
        """Return a piece of the wheel."""
        with self._wheel.open("rb") as file:
            file.seek(start)
            return file.read(size)


def mend(wheel: Path) -> None:
    """Rewrite requirements of old metadata, such as ``x (>=3.)``, in today's form."""
    with zipfile.ZipFile(wheel) as archive:
        files = {member: archive.read(member) for member in archive.infolist()}
    [about] = [member for member in files if member.filename.endswith(".dist-info/METADATA")]
    old = files[about]
    new = b"\n".join(map(_mended, old.split(b"\n")))
    if new == old:
        return
    files[about] = new
    [record] = [member for member in files if member.filename.endswith(".dist-info/RECORD")]
    rows = files[record].replace(_row(about, old), _row(about, new))
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, data in {**files, record: rows}.items():
            archive.writestr(member, data)


def _mended(line: bytes) -> bytes:
    dangling = line.startswith(b"Requires-Dist:")
    return re.sub(rb"(?<=\d)\.(?=\s*[,;)]|\s*$)", b"", line) if dangling else line


def _row(member: zipfile.ZipInfo, data: bytes) -> bytes:
    digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
    return f"{member.filename},sha256={digest},{len(data)}".encode()


class _Runner:
    """Runs the hooks' program in the build environment alone, and logs its output."""

    def __init__(self, log: Path, order: Mapping[str, Any]) -> None:
        self._log = log
        self._python = order["python"]
        packages = order["packages"]
        self._environment = {
            **os.environ,
            "PYTHONPATH": packages,
            "PATH": f"{packages}/bin:{os.environ.get('PATH', '')}",
            "SOURCE_DATE_EPOCH": _SINCE,
            "PYTHONHASHSEED": "0",
            **order["environment"],
        }

    def __call__(
        self,
        cmd: Sequence[str],
        cwd: str | None = None,
        extra_environ: Mapping[str, str] | None = None,
    ) -> None:
        """Run a command; called by ``pyproject_hooks``."""
        with self._log.open("ab") as log:
            subprocess.run(
                [self._python, "-S", *cmd[1:]],  # without the packages of the interpreter
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=cwd,
                env={**self._environment, **(extra_environ or {})},
                check=True,
            )


def _copied(source: str, target: str) -> str:
    """Copy a file with its mode, and with a fixed time, so that builds can be repeated."""
    shutil.copyfile(source, target)
    shutil.copymode(source, target)
    os.utime(target, (int(_SINCE), int(_SINCE)))
    return target


def _tail(log: Path) -> str:
    if not log.exists():
        return ""
    return log.read_bytes()[-TAIL:].decode("utf-8", "replace")


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Make the vector environment; called as any repository's ``make_env``."""
    return gym.vector.SyncVectorEnv([Build])
