"""Crash bundles: what led to the death of a jail, written down so that it can be done again.

::

    <cache>/crashes/20261121T081500-5f3a9c01/
        README.txt            in words: what died, and how to try again
        bundle.json           everything but the values below
        arguments.bin         make_env's own arguments: one packet of the wire
        requests.bin          what was asked: a packet for each request, or for steps in a row

Nothing in it is pickled. It is built under another name and renamed into place; only its owner
may read it; the oldest give way to the newest. ``bundle_reader`` reads it.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import WorkerDiedError, WorkerTimeoutError
from envhub_sandbox.hub.logins import without_login
from envhub_sandbox.session.crash.history import RecordedRequest, Recording, Steps, encoded
from envhub_sandbox.settings.policy import Policy, Timeouts
from envhub_sandbox.system import folders
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.inert import inert_copy, one_line
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.stream import pack_packet
from envhub_worker.protocol.text import printable

FORMAT = 1
KEPT = 20
"""Bundles in one folder; older ones are removed."""
_NAME = re.compile(r"\d{8}T\d{6}-[0-9a-f]{8}")
_ABANDONED_AFTER_S = 3600.0
_SHOWN_REQUESTS = 8
_SHORTEST_SECRET = 6
"""Characters: what is shorter is a setting, and would be found everywhere."""


@dataclass(frozen=True, kw_only=True)
class Crash:
    """What is known of one death.

    Attributes:
        error: What the user gets.
        load: The arguments of the repository's ``make_env``.
        options: The other arguments of ours: plain data, ``Policy`` and ``Timeouts``.
        task: ``suite``, ``task``, ``num_envs``, ``shards``, ``lane``; None before ``make_env`` has
            returned.
        shared: Whether other environments lived in the same jail.
        recording: What was asked of the environment.
    """

    error: WorkerDiedError | WorkerTimeoutError
    label: str
    provenance: dict[str, Any]
    load: m.Load
    options: dict[str, Any]
    task: dict[str, Any] | None
    shared: bool
    recording: Recording


def write_bundle(folder: Path, crash: Crash) -> Path:
    """Write a bundle; returns its folder.
    Raises ``OSError``: it cannot be written; nothing is left of it.
    """
    folders.make(folder, folders.PRIVATE_MODE)
    with folders.draft(folder) as building:
        _write(building, crash)
        home = folder / f"{time.strftime('%Y%m%dT%H%M%S', time.gmtime())}-{secrets.token_hex(4)}"
        building.rename(home)
    _remove_oldest(folder, home.name)
    return home


def _remove_oldest(folder: Path, newest: str) -> None:
    names = os.listdir(folder)
    # its name alone does not tell the newest from others of the same second
    bundles = sorted(filter(_NAME.fullmatch, names), key=lambda name: (name == newest, name))
    abandoned = [
        name for name in names if name.startswith(folders.BUILDING) and _is_old(folder / name)
    ]
    for name in [*bundles[:-KEPT], *abandoned]:
        shutil.rmtree(folder / name, ignore_errors=True)


def _is_old(path: Path) -> bool:
    with contextlib.suppress(OSError):
        return time.time() - path.stat().st_mtime > _ABANDONED_AFTER_S
    return False


def _write(folder: Path, crash: Crash) -> None:
    recording = crash.recording
    requests, denied = _Requests(recording), crash.error.denied
    document = {
        "format": FORMAT,
        "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "label": crash.label,
        "death": {name: _concealed(text, crash) for name, text in death_of(crash.error).items()},
        "denied": None if denied is None else [_concealed(one, crash) for one in denied],
        "provenance": crash.provenance,
        "make_env": _arguments(crash),
        "task": crash.task,
        "shared_jail": crash.shared,
        "history": {
            "exact": recording.exact,
            "seeded": recording.seeded,
            "dropped": recording.dropped,
            "steps": requests.steps,
            "requests": requests.index,
        },
    }
    content = {
        "bundle.json": json.dumps(document, indent=1, default=str).encode(),
        "arguments.bin": _packet(encoded(crash.load).frames),
        "requests.bin": b"".join(map(_packet, requests.packets)),
        "README.txt": str(_concealed(_in_words(crash), crash)).encode(),
    }
    for name, data in content.items():
        folders.write_private(folder / name, data)


def _concealed(value: Any, crash: Crash) -> Any:
    """A text without the values of variables that the jail was granted and may have printed."""
    if isinstance(value, str):
        for secret, name in _secrets(crash.options.get("policy")):
            value = value.replace(secret, f"<the value of {name}>")
    return value


def _secrets(policy: Any) -> list[tuple[str, str]]:
    """What is looked for, as it is printed, with the name of its variable.

    Lines of a value too: a printed one has a margin before each. The longest first, which may
    begin with another.
    """
    found: dict[str, str] = {}
    for name in policy.environment if isinstance(policy, Policy) else ():
        value = os.environ.get(name, "")
        for text in (value, *map(str.strip, value.splitlines())):
            if len(text) >= _SHORTEST_SECRET:
                found |= {text: name, printable(text, len(text)): name}
    return sorted(found.items(), key=lambda one: len(one[0]), reverse=True)


class _Requests:
    """An index of requests, in order, and what it points to."""

    def __init__(self, recording: Recording) -> None:
        self.index: list[dict[str, Any]] = []
        self.packets: list[Sequence[Buffer]] = []
        self.steps = 0
        for request in recording.requests:
            if isinstance(request, Steps):
                self._add_steps(request.actions)
            else:
                self._add(request)

    def _add_steps(self, actions: Any) -> None:
        self.packets.append(encoded(m.Step(0, actions)).frames)
        self.index.append({"steps": len(actions)})
        self.steps += len(actions)

    def _add(self, request: RecordedRequest) -> None:
        self.packets.append(request.frames)
        self.index.append(
            {"operation": request.operation, "exact": request.exact, "text": _text(request)}
        )
        self.steps += request.operation == "step"


def _text(request: RecordedRequest) -> str:
    return one_line(repr(m.unpack(request.frames)), 200)


def _packet(frames: Sequence[Buffer]) -> bytes:
    return b"".join(map(bytes, pack_packet(1, frames)))


def death_of(error: WorkerDiedError | WorkerTimeoutError) -> dict[str, Any]:
    """How it ended, as data."""
    if isinstance(error, WorkerTimeoutError):
        detail = f"{error.timeout_s} s" if error.timeout_s else ""
        how = {"reason": "timeout", "exit_code": None, "signal": None, "detail": detail}
        output = ""
    else:
        how = {name: getattr(error, name) for name in ("reason", "exit_code", "signal", "detail")}
        output = error.log_tail
    return {**how, "output": output, "request": error.request, "message": str(error)}


def _arguments(crash: Crash) -> dict[str, Any]:
    """``make_env``'s arguments; those of the repository also in words, for people."""
    options = {name: _plain(value) for name, value in crash.options.items()}
    return {
        **options,
        "n_envs": crash.load.n_envs,
        "use_async_envs": crash.load.use_async_envs,
        "exact": encoded(crash.load).exact,
        "env_kwargs": {
            name: inert_copy(value).text for name, value in crash.load.env_kwargs.items()
        },
        "cfg": None if crash.load.cfg is None else inert_copy(crash.load.cfg).text,
    }


def _plain(value: Any) -> Any:
    if isinstance(value, (Policy, Timeouts)):
        return asdict(value)
    if isinstance(value, str):
        return without_login(value)
    if value is None or isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return os.fspath(value) if isinstance(value, os.PathLike) else type(value).__name__


def _in_words(crash: Crash) -> str:
    recording = crash.recording
    task = crash.task
    lines = [
        f"A worker process of {crash.label} died.",
        "",
        printable(str(crash.error)),
        "",
        "To do the same again:  envhub replay <this folder>",
        "",
    ]
    if task is not None:
        lines.append(
            f"Environment: suite {task['suite']!r}, task {task['task']!r}, {task['num_envs']} "
            f"sub-environments in {task['shards']} processes, steps by {task['lane']}."
        )
    lines.append(f"Seeded: {'yes' if recording.seeded else 'no, so chance may decide otherwise'}.")
    if recording.dropped:
        lines.append(f"{recording.dropped} requests were forgotten: a replay cannot be exact.")
    if crash.error.denied:
        lines += ["", "What it had tried and was denied:"]
        lines += [f"  {printable(one)}" for one in crash.error.denied]
    lines += ["", "The last requests, the last one unanswered:", *_last_requests(recording), ""]
    return "\n".join(lines)


def _last_requests(recording: Recording) -> list[str]:
    shown = []
    for request in recording.requests[-_SHOWN_REQUESTS:]:
        if isinstance(request, Steps):
            last = printable(repr(request.actions[-1]), 400)
            shown.append(f"  {len(request.actions)} steps, the last with {last}")
        else:
            shown.append(f"  {_text(request)}")
    return shown or ["  none: it died in make_env"]
