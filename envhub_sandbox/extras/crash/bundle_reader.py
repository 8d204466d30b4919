"""Reads crash bundles. Trust: a bundle may come from a stranger who wants us to run his code.

This module reads only regular files of bounded size, unpickles nothing, and checks the type of
every value before use. ``wishes`` names the parts of this machine that a replay would use. The user
must grant these, except for the user's own bundles in this program's folder.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from envhub_sandbox.errors import BundleError, EnvHubError
from envhub_sandbox.extras.crash.bundle_writer import FORMAT
from envhub_sandbox.hub.grammar import LOCAL_TYPES, is_commit
from envhub_sandbox.hub.reference import pinned
from envhub_sandbox.system import folders
from envhub_sandbox.system.folders import cache_root
from envhub_sandbox.transport.values import to_tensor
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.errors import FAULTS
from envhub_worker.protocol.stream import StreamReader
from envhub_worker.protocol.text import printable

MAX_FILE_BYTES = 64 << 20
MAX_DOCUMENT_BYTES = 16 << 20
"""``bundle.json``: an empty list takes two bytes there, and forty times as much in memory."""
_MAX_WISHES = 4000
"""Characters; a longer line is refused, because a shortened one would hide what is granted."""
_OF_POLICY = ("profile", "network", "display", "readable", "gpu", "environment", "limits")
_OF_MAKE_ENV = (
    *("timeouts", "hub_cache_dir", "endpoint", "python", "dependencies", "lock", "assets"),
)
_UNREADABLE: tuple[type[Exception], ...] = (OSError, EnvHubError, *FAULTS)

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Bundle:
    """A crash bundle, checked.

    Attributes:
        label: Repository, commit and entry file.
        reference: The pinned reference for ``make_env``.
        is_ours: Whether it lies in the folder where this program writes the caller's bundles.
        files: Digest by path.
        death: ``reason``, ``exit_code``, ``signal``, ``request``, ``message``.
        load: The arguments of the repository's ``make_env``.
        arguments: The other arguments that differed from the default ones.
        task: ``suite``, ``task``, ``num_envs``, ``shards``, ``single``, ``lane``; None before
            ``make_env`` had returned.
        count, steps: How many requests there are, and how many of them are steps.
    """

    label: str
    reference: str
    is_ours: bool
    files: dict[str, str]
    death: dict[str, Any]
    load: m.Load
    arguments: dict[str, Any]
    task: dict[str, Any] | None
    packets: bytes
    count: int
    steps: int

    def requests(self) -> Iterator[m.Message]:
        """Yields the requests in order; the last one was never answered.

        Decodes one at a time: all at once may take seventy times their bytes in memory.
        """
        return _messages(self.packets)


def load_bundle(folder: Path) -> Bundle:
    """Loads the bundle in a folder. Raises ``BundleError``: there is none, or it breaks a rule."""
    try:
        document = json.loads(_read(folder, "bundle.json", MAX_DOCUMENT_BYTES))
        if type(document) is not dict or document.get("format") != FORMAT:
            reads = f"this release reads format {FORMAT}"
            raise BundleError(f"{reads}; replay others with the release that wrote them")
        return _bundle(folder, document)
    except _UNREADABLE as error:
        raise BundleError(f"{folder} cannot be read as a crash bundle: {error}") from error


def _bundle(folder: Path, document: dict[str, Any]) -> Bundle:
    provenance, packets = _member(document, "provenance", dict), _read(folder, "requests.bin")
    files = _member(provenance, "files", dict)
    if not all(type(digest) is str for digest in files.values()):
        raise BundleError("its file hashes are not text")
    task = document.get("task")
    are_steps = [isinstance(message, m.Step) for message in _messages(packets)]
    crashes = (cache_root() / "crashes").resolve()
    return Bundle(
        label=one_line(_member(document, "label", str), 1000),
        reference=_reference(provenance),
        is_ours=folder.resolve().parent == crashes and folders.is_ours_alone(crashes),
        files=files,
        death=_death(_member(document, "death", dict)),
        load=_load(folder),
        arguments=_member(document, "make_env", dict),
        task=None if task is None else _task(task),
        packets=packets,
        count=len(are_steps),
        steps=sum(are_steps),
    )


def _reference(provenance: dict[str, Any]) -> str:
    repository, path = _member(provenance, "repository", str), _member(provenance, "path", str)
    kind = _member(provenance, "repo_type", str)
    commit = _member(provenance, "commit", str)
    if kind in LOCAL_TYPES and not os.path.isabs(repository):
        raise BundleError("a local folder's path is not absolute")
    if kind not in (*LOCAL_TYPES, "pypi") and not is_commit(commit):
        raise BundleError(f"{commit} is not a commit")
    return pinned(kind, repository, commit, path)


def _death(death: dict[str, Any]) -> dict[str, Any]:
    code, signal = death.get("exit_code"), death.get("signal")
    return {
        "reason": one_line(_member(death, "reason", str), 100),
        "exit_code": code if type(code) is int else None,
        "signal": one_line(signal, 100) if type(signal) is str else None,
        "request": one_line(str(death.get("request")), 100),
        "message": printable(_member(death, "message", str)),
    }


def _task(task: Any) -> dict[str, Any]:
    if type(task) is not dict or type(task.get("task")) not in (int, str):
        raise BundleError("its task has no number or name")
    return {
        "suite": _member(task, "suite", str),
        "task": task["task"],
        "num_envs": _member(task, "num_envs", int),
        "shards": _member(task, "shards", int),
        "single": task.get("single") is True,
        "lane": "frames" if task.get("lane") == "frames" else "auto",
    }


def _load(folder: Path) -> m.Load:
    messages = _messages(_read(folder, "arguments.bin"))
    message = next(messages, None)
    if not isinstance(message, m.Load) or next(messages, None) is not None:
        raise BundleError("its arguments are not those of make_env")
    return message


def _messages(data: bytes) -> Iterator[m.Message]:
    for packet in StreamReader().feed(data):
        yield m.unpack(packet.frames, tensors=to_tensor)


def _read(folder: Path, name: str, most: int = MAX_FILE_BYTES) -> bytes:
    path = folder / name
    status = path.lstat()
    if not stat.S_ISREG(status.st_mode):
        raise BundleError(f"{path} is not a regular file")
    if status.st_size > most:
        raise BundleError(f"{path} has {status.st_size} bytes; at most {most} are read")
    return path.read_bytes()


def _member(mapping: dict[str, Any], name: str, kind: type[T]) -> T:
    value = mapping.get(name)
    if type(value) is not kind:
        raise BundleError(f"its {name} is not of type {kind.__name__}")
    return value


def wishes(bundle: Bundle) -> str:
    """Returns a line for the user: the parts of this machine that a stranger's replay would use.
    Raises ``BundleError``: the line is too long to be shown whole.
    """
    policy = _chosen(bundle.arguments.get("policy"), _OF_POLICY)
    needed = {"repository": bundle.reference, **policy, **_chosen(bundle.arguments, _OF_MAKE_ENV)}
    text = ", ".join(f"{name}={value!r}" for name, value in needed.items())
    if len(text) > _MAX_WISHES:
        raise BundleError(f"it asks for more than can be shown: {one_line(text, 300)}")
    return one_line(text, 2 * _MAX_WISHES)


def _chosen(mapping: Any, names: tuple[str, ...]) -> dict[str, Any]:
    known = mapping if isinstance(mapping, dict) else {}
    return {name: known[name] for name in names if name in known}


def replayed_arguments(bundle: Bundle) -> dict[str, Any]:
    """Returns the arguments of ``make_env`` that rebuild the bundle's environment."""
    policy = _chosen(bundle.arguments.get("policy"), _OF_POLICY) | {"crash_history": 0}
    arguments = {
        **_chosen(bundle.arguments, _OF_MAKE_ENV),
        "n_envs": bundle.load.n_envs,
        "use_async_envs": bundle.load.use_async_envs,
        "env_kwargs": bundle.load.env_kwargs,
    }
    if bundle.task is not None:
        arguments["num_workers"] = bundle.task["shards"]
        policy["lane"] = bundle.task["lane"]
    return {**arguments, "policy": policy}
