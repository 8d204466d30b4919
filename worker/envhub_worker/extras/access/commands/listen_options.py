"""The options of ``listen``."""

from __future__ import annotations

import argparse
import contextlib
import os
from functools import partial
from pathlib import Path
from typing import Any

from envhub_worker.extras.access.audit.log import FORMS, LEVELS
from envhub_worker.extras.access.packages import MAKE_S
from envhub_worker.extras.access.quotas import MAX_CONNECTIONS, Quotas
from envhub_worker.lockdown.mechanisms import landlock
from envhub_worker.protocol.confinement import PROFILES
from envhub_worker.protocol.keys import parse_key
from envhub_worker.protocol.text import parse_size, size_text

DEFAULT_BIND = "tcp://127.0.0.1:5555"
_IDLE_S = 120
_CONTAINER_MARKS = ("/.dockerenv", "/run/.containerenv")
# Field of Quotas: the option's names, the counted resource, and the unit of a bare number.
_QUOTAS: dict[str, tuple[tuple[str, ...], str, str]] = {
    "jails": (("--max-jails",), "open jails", ""),
    "runners": (("--max-runners", "--max-hosts"), "processes of environments", ""),
    "sessions": (("--max-sessions",), "client processes", ""),
    "upload_files": (("--max-upload-files",), "files of a snapshot", ""),
    "processes": (("--max-processes",), "sum of the limits of processes of its jails", ""),
    "open_files": (("--max-open-files",), "sum of the limits of open files of its jails", ""),
    "disk_files": (("--max-disk-files",), "sum of the limits of files of its jails", ""),
    "disk_bytes": (("--max-disk",), "sum of the limits of scratch of its jails", "GiB"),
    "memory_bytes": (("--max-memory",), "sum of the memory limits of its jails", "GiB"),
    "upload_bytes": (("--max-upload",), "size of its snapshots", "MiB"),
    "packages_bytes": (("--max-packages",), "size of its installed packages", "MiB"),
    "inflight_bytes": (("--max-inflight",), "size of its unanswered requests", "MiB"),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of ``listen``."""
    # A container is a layer itself, and often forbids the others. A jail of that profile runs as
    # our user, so it needs Landlock, which hides our keys and stores.
    contained = any(map(os.path.exists, _CONTAINER_MARKS)) and landlock.version() >= 1
    parser.add_argument(
        "--max-connections",
        type=_count,
        default=MAX_CONNECTIONS,
        help=f"most connections, those of unknown hosts included (default: {MAX_CONNECTIONS})",
    )
    parser.add_argument(
        "--bind",
        default=DEFAULT_BIND,
        metavar="tcp://HOST:PORT",
        help=f"where to listen (default: {DEFAULT_BIND})",
    )
    parser.add_argument("--key", type=Path, help="the server's secret key (see keygen)")
    parser.add_argument(
        "--authorized-clients",
        type=Path,
        metavar="FILE",
        help="list of clients: a public key and a name on each line; without this option, a key "
        "for one client is made and printed",
    )
    parser.add_argument(
        "--only-client",
        type=_key,
        metavar="KEY",
        help="public key of the only client, instead of a list",
    )
    parser.add_argument(
        "--insecure-loopback", action="store_true", help="serve without keys, on loopback only"
    )
    parser.add_argument("--state-dir", type=Path, help="private folder for keys and snapshots")
    parser.add_argument(
        "--idle-s",
        type=_seconds,
        default=_IDLE_S,
        help="end the jails of a client that was silent for so many seconds; 0: never "
        f"(default: {_IDLE_S})",
    )
    parser.add_argument(
        "--metrics",
        metavar="[ADDRESS:]PORT",
        help="serve /metrics, /healthz and /readyz there, over plain HTTP and without keys; on "
        "127.0.0.1 unless an address is given",
    )
    parser.add_argument(
        "--drain-s",
        type=_seconds,
        default=0,
        help="after SIGTERM, accept no new jails and wait so many seconds until open ones are "
        "closed; a second SIGTERM ends the server at once (default: 0)",
    )
    parser.add_argument(
        "--weakest-profile",
        choices=PROFILES,
        default="container" if contained else "strict",
        help="the weakest profile that a client's policy may name (default here: %(default)s)",
    )
    parser.add_argument(
        "--allow-network", action="store_true", help="permit policies with network='host'"
    )
    parser.add_argument("--allow-gpu", action="store_true", help="permit policies with gpu=True")
    parser.add_argument(
        "--dependencies",
        action="store_true",
        help="install the packages that repositories declare; needs envhub-sandbox in this "
        "interpreter",
    )
    parser.add_argument(
        "--packages-s",
        type=_count,
        default=int(MAKE_S),
        metavar="SECONDS",
        help=f"longest time for one installation (default: {MAKE_S:.0f})",
    )
    parser.add_argument(
        "--log-format",
        choices=tuple(FORMS),
        default="text",
        help="format of the log on stderr, which has a line for each event (default: text)",
    )
    parser.add_argument(
        "--log-level",
        choices=LEVELS,
        default="info",
        help="lowest level of events in the log (default: info)",
    )
    parser.add_argument("--until-eof", action="store_true", help="end when stdin ends")
    parser.add_argument(
        "--announce",
        action="store_true",
        help="print the public key and what confines the server as one line of JSON, for the "
        "program that started this, instead of the line for the client",
    )
    # for a program that starts its own server: see the docstring of __main__.py
    for name in ("--client-pidfd", "--ready-fd"):
        parser.add_argument(name, type=int, help=argparse.SUPPRESS)
    for field, (names, meaning, unit) in _QUOTAS.items():
        default: int = getattr(Quotas(), field)
        shown, more = str(default), ""
        how: dict[str, Any] = {"type": _count}
        if unit:
            shown, more = size_text(default), f", as in 16G; in {unit} without a unit"
            how = {"type": partial(_size, unit), "metavar": "SIZE"}
        text = f"for each key: {meaning}{more} (default: {shown})"
        parser.add_argument(*names, default=default, help=text, **how)


def quotas_of(arguments: argparse.Namespace) -> Quotas:
    """Returns the quotas that the options choose."""
    values = vars(arguments)
    return Quotas(
        **{
            field: values[names[0].lstrip("-").replace("-", "_")]
            for field, (names, *_) in _QUOTAS.items()
        }
    )


def _key(text: str) -> bytes:
    try:
        return parse_key(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _size(unit: str, text: str) -> int:
    try:
        size = parse_size(text, unit[0].lower())
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{error}, and {text!r} is none") from None
    if size < 1:
        raise argparse.ArgumentTypeError(f"takes a size above 0, not {text!r}")
    return size


def _at_least(least: int, text: str) -> int:
    with contextlib.suppress(ValueError):
        if int(text) >= least:
            return int(text)
    raise argparse.ArgumentTypeError(f"takes a whole number, {least} or more, not {text!r}")


_count, _seconds = partial(_at_least, 1), partial(_at_least, 0)
