"""Writes crash bundles: the requests that led to the death of a jail, for a replay.

::

    <cache>/crashes/20261121T081500-5f3a9c01/
        README.txt            in words: what died, and how to try again
        bundle.json           everything but the values below
        arguments.bin         make_env's own arguments: one packet of the wire
        requests.bin          what was asked: a packet for each request

A bundle contains no pickles. It is built under another name and renamed into place; only its owner
may read it. New bundles replace the oldest ones. ``bundle_reader`` reads them.
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
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import WorkerDiedError, WorkerTimeoutError
from envhub_sandbox.extras.crash.history import encoded
from envhub_sandbox.hub.logins import without_login
from envhub_sandbox.session.recorder import Crash
from envhub_sandbox.system import folders
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.stream import pack_packet
from envhub_worker.protocol.text import printable

FORMAT = 2
KEPT = 20
"""Bundles in one folder; older ones are removed."""
_NAME = re.compile(r"\d{8}T\d{6}-[0-9a-f]{8}")
_ABANDONED_AFTER_S = 3600.0
_SHOWN_REQUESTS = 8
_SHORTEST_SECRET = 6
"""Characters: what is shorter is a setting, and would be found everywhere."""


def write_bundle(folder: Path, crash: Crash, requests: Sequence[list[bytes]]) -> Path:
    """Write a bundle of the frames of requests; returns its folder.
    Raises ``OSError``: it cannot be written; nothing is left of it.
    """
    folders.make(folder, folders.PRIVATE_MODE)
    with folders.draft(folder) as building:
        load = encoded(crash.load)
        content = {
            "bundle.json": json.dumps(_document(crash), indent=1, default=str).encode(),
            "arguments.bin": packet(load),
            "requests.bin": b"".join(map(packet, requests)),
            "README.txt": _concealed(_in_words(crash, load, requests), crash).encode(),
        }
        for name, data in content.items():
            folders.write_private(building / name, data)
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


def _document(crash: Crash) -> dict[str, Any]:
    denied = crash.error.denied
    return {
        "format": FORMAT,
        "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "label": crash.label,
        "death": {name: _concealed(text, crash) for name, text in death_of(crash.error).items()},
        "denied": None if denied is None else [_concealed(denial, crash) for denial in denied],
        "provenance": crash.provenance,
        "make_env": _plain(crash.options),
        "task": crash.task,
    }


def _concealed(value: Any, crash: Crash) -> Any:
    """Removes the values of granted variables, which the jail may have printed, from a text."""
    if isinstance(value, str):
        for secret, name in _secrets(crash.options.get("policy")):
            value = value.replace(secret, f"<the value of {name}>")
    return value


def _secrets(policy: Any) -> list[tuple[str, str]]:
    """Each value as it may be printed, and the name of its variable; a longer one may contain
    others, so it comes first. Lines of a value count, too: a margin is printed before each.
    """
    names: dict[str, str] = {}
    for name in (policy or {}).get("environment", ()):
        value = os.environ.get(name, "")
        for text in (value, *map(str.strip, value.splitlines())):
            if len(text) >= _SHORTEST_SECRET:
                names |= {text: name, printable(text, len(text)): name}
    return [(text, names[text]) for text in sorted(names, key=len, reverse=True)]


def _text(frames: list[bytes]) -> str:
    return one_line(repr(m.unpack(frames)), 400)


def packet(frames: Sequence[Buffer]) -> bytes:
    """Returns a message in the form of a bundle's file."""
    return b"".join(map(bytes, pack_packet(1, frames)))


def death_of(error: WorkerDiedError | WorkerTimeoutError) -> dict[str, Any]:
    """Returns a jail's death as plain data."""
    if isinstance(error, WorkerTimeoutError):
        detail = f"{error.timeout_s} s" if error.timeout_s else ""
        how = {"reason": "timeout", "exit_code": None, "signal": None, "detail": detail}
        output = ""
    else:
        how = {name: getattr(error, name) for name in ("reason", "exit_code", "signal", "detail")}
        output = error.log_tail
    return {**how, "output": output, "request": error.request, "message": str(error)}


def _plain(value: Any) -> Any:
    if isinstance(value, str):
        return without_login(value)
    if value is None or isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return os.fspath(value) if isinstance(value, os.PathLike) else type(value).__name__


def _in_words(crash: Crash, load: list[bytes], requests: Sequence[list[bytes]]) -> str:
    first, last = requests[:-_SHOWN_REQUESTS][:1], requests[-_SHOWN_REQUESTS:]
    lines = [
        f"A worker process of {crash.label} died.\n",
        f"{printable(str(crash.error))}\n",
        "To do the same again:  envhub replay <this folder>\n",
        f"Arguments: {_text(load)}",
        *([] if crash.task is None else [f"Environment: {one_line(repr(crash.task), 400)}"]),
        *(f"Denied: {printable(denial)}" for denial in crash.error.denied or ()),
        f"\nThe first and the last of {len(requests)} requests, the last one unanswered:",
        *(f"  {_text(request)}" for request in (*first, *last)),
    ]
    return "\n".join(lines) + "\n"
