"""Reads crash bundles. Trust: a bundle is a stranger's input, who would like us to run something.

Only regular files of bounded size are read, nothing is unpickled, and every value is checked for
its type before it is used. What a bundle asks of this machine beyond what an ordinary run gets
is listed by ``wishes`` and granted only by the user.
"""

from __future__ import annotations

import json
import os
import stat
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from envhub_sandbox.errors import BundleError, EnvHubError
from envhub_sandbox.hub.grammar import LOCAL_TYPES, is_commit
from envhub_sandbox.hub.local import split_local
from envhub_sandbox.hub.reference import is_local, pinned
from envhub_sandbox.session.crash.bundle_writer import FORMAT
from envhub_sandbox.settings.policy import Limits, Policy
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
MAX_REQUESTS = 1_000_000
"""What is read of a bundle at most: a history takes 8 MiB."""

_UNREADABLE: tuple[type[Exception], ...] = (OSError, EnvHubError, *FAULTS)

T = TypeVar("T")


class Requests:
    """Requests, decoded anew each time: all at once may take seventy times their bytes in memory.
    ``decode``: decodes all, one at a time; it is done once here, and raises as it does.
    """

    def __init__(self, decode: Callable[[], Iterator[m.Message]]) -> None:
        self._decode = decode
        kinds = Counter(map(type, decode()))
        self._count, self.steps = kinds.total(), kinds[m.Step]

    def __iter__(self) -> Iterator[m.Message]:
        return self._decode()

    def __len__(self) -> int:
        return self._count


@dataclass(frozen=True, kw_only=True)
class Bundle:
    """A crash bundle, checked.

    Attributes:
        label: Repository, commit and entry file.
        reference: The same, pinned, as ``make_env`` takes it.
        is_ours: It lies where this program writes the caller's bundles.
        files: Digest by path.
        death: ``reason``, ``exit_code``, ``signal``, ``request``, ``message``.
        load: The arguments of the repository's ``make_env``.
        arguments: The other arguments that were used.
        task: ``suite``, ``task``, ``num_envs``, ``shards``, ``lane``; None before ``make_env``
            had returned.
        doubts: Why the same requests may not have the same effect, one sentence each.
        requests: What was asked, in order; the last one was never answered.
    """

    label: str
    reference: str
    is_ours: bool
    files: dict[str, str]
    death: dict[str, Any]
    load: m.Load
    arguments: dict[str, Any]
    task: dict[str, Any] | None
    doubts: tuple[str, ...]
    requests: Requests

    @property
    def steps(self) -> int:
        """How many of the requests are steps."""
        return self.requests.steps


def load_bundle(folder: Path) -> Bundle:
    """The bundle in a folder. Raises ``BundleError``: there is none, or it breaks a rule."""
    try:
        document = json.loads(_read(folder, "bundle.json", MAX_DOCUMENT_BYTES))
        if type(document) is not dict or document.get("format") != FORMAT:
            raise BundleError(f"it is not of format {FORMAT}")
        return _bundle(folder, document)
    except _UNREADABLE as error:
        raise BundleError(f"{folder} cannot be read as a crash bundle: {error}") from error


def _bundle(folder: Path, document: dict[str, Any]) -> Bundle:
    provenance, requests = _member(document, "provenance", dict), _read(folder, "requests.bin")
    history = _member(document, "history", dict)
    arguments = _member(document, "make_env", dict)
    task = document.get("task")
    return Bundle(
        label=one_line(_member(document, "label", str), 1000),
        reference=_reference(provenance),
        is_ours=folder.resolve().parent == (cache_root() / "crashes").resolve(),
        files=_files(_member(provenance, "files", dict)),
        death=_death(_member(document, "death", dict)),
        load=_load(folder),
        arguments=arguments,
        task=None if task is None else _task(task),
        doubts=tuple(_doubts(document, history, arguments)),
        requests=Requests(partial(_requests, requests, _member(history, "requests", list))),
    )


def _doubts(
    document: dict[str, Any], history: dict[str, Any], arguments: dict[str, Any]
) -> Iterator[str]:
    dropped = _member(history, "dropped", int)
    if dropped:
        yield (
            f"{dropped} requests had been forgotten before it died (crash_history of the policy), "
            "or were lost by a transparent restart"
        )
    elif not _member(history, "exact", bool):
        yield (
            "some requests had objects that can only be pickled; the bundle has plain values or "
            "descriptions instead"
        )
    if not _member(arguments, "exact", bool):
        yield "make_env was given objects that only pickle could carry"
    if document.get("task") is not None and not _member(history, "seeded", bool):
        yield "no reset had seeded every sub-environment, so chance may decide otherwise"
    if document.get("shared_jail"):
        yield "other environments were in the same process; their requests are not recorded"


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
        raise BundleError("its task is not one")
    return {
        "suite": _member(task, "suite", str),
        "task": task["task"],
        "num_envs": _member(task, "num_envs", int),
        "shards": _member(task, "shards", int),
        "lane": "frames" if task.get("lane") == "frames" else "auto",
    }


def _load(folder: Path) -> m.Load:
    messages = _packets(_read(folder, "arguments.bin"))
    message = next(messages, None)
    if not isinstance(message, m.Load) or next(messages, None) is not None:
        raise BundleError("its arguments are not those of make_env")
    return message


def _packets(data: bytes) -> Iterator[m.Message]:
    for packet in StreamReader().feed(data):
        yield m.unpack(packet.frames, tensors=to_tensor)


def _requests(data: bytes, index: list[Any]) -> Iterator[m.Message]:
    packets = _packets(data)
    left = MAX_REQUESTS
    for entry in index:
        if type(entry) is not dict:
            raise BundleError("a request is not a mapping")
        message = next(packets, None)
        if message is None:
            raise BundleError("it has fewer requests than it says")
        rows = None if "steps" not in entry else _rows(message, _member(entry, "steps", int))
        left -= 1 if rows is None else len(rows)
        if left < 0:
            raise BundleError(f"it has more than {MAX_REQUESTS} requests")
        if rows is None:
            yield message
        else:
            yield from (m.Step(0, actions) for actions in rows)
    if next(packets, None) is not None:
        raise BundleError("it has more requests than it says")


def _rows(message: m.Message, count: int) -> Any:
    """The actions of so many steps."""
    actions = message.actions if isinstance(message, m.Step) else None
    if not isinstance(actions, np.ndarray) or actions.shape[:1] != (count,):
        raise BundleError("it has other steps than it says")
    return actions


def _read(folder: Path, name: str, most: int = MAX_FILE_BYTES) -> bytes:
    _check_file(folder / name, most)
    return (folder / name).read_bytes()


def _check_file(path: Path, most: int = MAX_FILE_BYTES) -> None:
    found = path.lstat()
    if not stat.S_ISREG(found.st_mode):
        raise BundleError(f"{path} is not a regular file")
    if found.st_size > most:
        raise BundleError(f"{path} has {found.st_size} bytes; at most {most} are read")


def _member(mapping: dict[str, Any], name: str, kind: type[T]) -> T:
    value = mapping.get(name)
    if type(value) is not kind:
        raise BundleError(f"its {name} is not of type {kind.__name__}")
    return value


def _files(mapping: dict[str, Any]) -> dict[str, str]:
    if not all(type(value) is str for value in mapping.values()):
        raise BundleError("its file hashes are not text")
    return mapping


# --- what it asks of this machine --------------------------------------------------------------

_GRANTED = ("profile", "network", "display", "readable", "gpu", "environment")
_CARRIED = ("hub_cache_dir", "endpoint", "python", "dependencies", "lock", "assets")
_MAX_WISH = 4000
_LONGEST_S = 24 * 3600.0
"""Of a timeout."""
_USUAL: tuple[object, ...] = (None, "auto", [])


def wishes(bundle: Bundle) -> list[str]:
    """What it asks for beyond an ordinary run, one ``name=value`` each: for the user to grant.

    Raises ``BundleError``: one is too long to be shown whole, and what is cut off would be granted.
    """
    asked, usual = _policy(bundle), Policy()
    found = [
        f"{name}={asked[name]!r}"
        for name in _GRANTED
        if name in asked and _comparable(asked[name]) != _comparable(getattr(usual, name))
    ]
    limits = asked.get("limits")
    if isinstance(limits, dict):
        found += [f"limits.{n}={v!r}" for n, v in limits.items() if _is_more(n, v)]
    carried = {name: bundle.arguments.get(name) for name in _CARRIED}
    found += [f"{name}={value!r}" for name, value in carried.items() if value not in _USUAL]
    if bundle.reference.startswith("git+") or _is_another_folder(bundle):
        # a host that the bundle chose is asked, or what lies anywhere here is shown to a jail
        found.append(f"repository={bundle.reference!r}")
    for wish in found:
        if len(wish) > _MAX_WISH:
            raise BundleError(f"it asks for more than can be shown: {one_line(wish, 300)}")
    return [one_line(wish, 8 * _MAX_WISH) for wish in found]  # a line each, whatever its name is


def _is_another_folder(bundle: Bundle) -> bool:
    """Whether it is about a folder of this machine, but not the one that the user stands in."""
    if bundle.is_ours or not is_local(bundle.reference):
        return False
    return split_local(bundle.reference).folder.resolve() != Path.cwd()


def _policy(bundle: Bundle) -> dict[str, Any]:
    policy = bundle.arguments.get("policy")
    return policy if isinstance(policy, dict) else {}


def _comparable(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _is_more(name: str, value: Any) -> bool:
    usual = getattr(Limits(), name, 0)
    if usual is None or value is None:  # no cap of its own: the other limits are the cap
        return usual is not None
    return not isinstance(value, (int, float)) or value > usual


def replayed_arguments(bundle: Bundle, *, granted: bool) -> dict[str, Any]:
    """The arguments of ``make_env`` that make it again; ``wishes`` are left out unless granted."""
    policy = _known(Policy, _policy(bundle))
    usable = {name: policy[name] for name in _GRANTED if granted and name in policy}
    limits = _known(Limits, policy.get("limits"))
    usable["limits"] = {n: v for n, v in limits.items() if granted or not _is_more(n, v)}
    usable |= {"crash_history": 0}
    made: dict[str, Any] = {
        "n_envs": bundle.load.n_envs,
        "use_async_envs": bundle.load.use_async_envs,
        "env_kwargs": bundle.load.env_kwargs,
        "policy": usable,
        "timeouts": _timeouts(bundle),
    }
    if bundle.task is not None:
        made |= {"num_workers": bundle.task["shards"], "lane": bundle.task["lane"]}
    if granted:
        carried = {name: bundle.arguments.get(name) for name in _CARRIED}
        made |= {name: value for name, value in carried.items() if type(value) in (str, dict, list)}
    return made


def _known(cls: type[Any], value: Any) -> dict[str, Any]:
    names = {item.name for item in fields(cls)}
    return {n: v for n, v in value.items() if n in names} if isinstance(value, Mapping) else {}


def _timeouts(bundle: Bundle) -> dict[str, Any]:
    """Those that were used, but none without an end, or one that is far."""
    timeouts = bundle.arguments.get("timeouts")
    names = ("startup_s", "reset_s", "step_s", "call_s")
    found = timeouts if isinstance(timeouts, dict) else {}
    given = {name: found[name] for name in names if isinstance(found.get(name), (int, float))}
    return {name: seconds for name, seconds in given.items() if seconds <= _LONGEST_S}
