"""Makes clients' packages for ``envhub-worker listen --dependencies``.

``python -I -m envhub_sandbox.extras.packages.for_a_server --server-pidfd=N``: stdin is one order as
JSON; stdout is a file with the present state as one JSON object: ``progress``, a line for people,
and at the end ``own``, ``made``, or ``error`` and ``said``. With the word ``check`` it only reports
whether it could work.

Trust: an order comes from a client on another host; its requirements are read like a stranger's
file. All packages and uv's cache lie in a folder of the client's key, under one bound. Two
processes share the task: a maker works, and this watcher measures it, ends it and removes what it
left unfinished. Each has a pidfd of its parent and ends with it, even if the parent is killed:
otherwise nobody would measure the maker or wait for it.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from packaging.utils import canonicalize_name

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.packages import bounds, environments, packages
from envhub_sandbox.extras.packages.declared import WantedPackage, check_versions, parse_requirement
from envhub_sandbox.extras.packages.modules import Guess
from envhub_sandbox.extras.packages.request import DATE, PackageRequest
from envhub_sandbox.extras.packages.resolution import resolutions, uv
from envhub_sandbox.system import locks
from envhub_sandbox.system.folders import CACHE_VARIABLE, remove_tree
from envhub_sandbox.system.platform import end_with, pidfd, program
from envhub_worker.protocol.text import printable

BLOCK_BYTES = 4096
"""The charge of the smallest file, since each takes at least a block of the disk."""
_LOOK_S = 0.5
_WAIT_S = 60.0
_LOCKED_S = 1800.0
"""How long another server of this machine may work, if both share the folder."""
_CLEANING_S = 2 * _WAIT_S
_WHERE_CHARS = 200
_SAID_CHARS = 3800
_NICE = 10
_PROGRAM = "envhub_sandbox.extras.packages.for_a_server"
_PIDFD = "--server-pidfd="


def main(words: Sequence[str] | None = None) -> int:
    """Carries out an order; returns 0 if it wrote a readable answer."""
    words = sys.argv[1:] if words is None else words
    try:
        if "check" in words:
            uv.command()
            return 0
        descriptors = [word.partition("=")[2] for word in words if word.startswith(_PIDFD)]
        ended = int(descriptors[0]) if descriptors else None  # the pidfd of our parent
        order = json.load(sys.stdin)
        os.environ[CACHE_VARIABLE] = order["folder"]
        os.environ["UV_CACHE_DIR"] = str(_uv_cache(order))
        os.environ[bounds.BYTES_VARIABLE] = str(order["bytes"])
        reply = _made(order, ended) if "make" in words else _watched(order, ended)
    except DependencyError as error:
        if "check" in words:
            sys.stderr.write(f"{error}\n")
            return 1
        reply = {"error": error.reason, "said": str(error)[:_SAID_CHARS]}
    if reply:
        _say(reply)
    return 0


def _say(what: Mapping[str, Any]) -> None:
    os.ftruncate(1, 0)
    os.pwrite(1, json.dumps(what).encode(), 0)


# --- the maker ----------------------------------------------------------------------------------


def _made(order: Mapping[str, Any], ended: int | None) -> dict[str, Any]:
    if ended is not None:
        end_with(ended, 0.0)  # uv is in our group, too
    os.nice(_NICE)
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)  # a plain user cannot raise it
    bound = order["bytes"] if most == resource.RLIM_INFINITY else min(order["bytes"], most)
    resource.setrlimit(resource.RLIMIT_FSIZE, (bound, bound))
    request = _request(order)
    # a client could have a build contact any host, and no account covers the costs of builds
    resolutions.BUILDER = None
    if not request.always and packages.HERE.meets(request):
        return {"own": True}
    package_set = packages.HERE.make(request, lambda line: _say({"progress": line[:_WHERE_CHARS]}))
    assert package_set.environment is not None
    return {
        "made": {
            "name": package_set.environment.key,
            "python": package_set.python,
            "packages": package_set.packages,
            "bytes": package_set.environment.size,
            "facts": package_set.facts,
        }
    }


def _request(order: Mapping[str, Any]) -> PackageRequest:
    """Reads the request from an order. Trust: input from a client."""
    python, until = order["python"], order["exclude_newer"]
    try:
        check_versions(python or ">=3")
        check_versions(order["supports"] or ">=3")
        if os.sep in python + order["supports"] or (until and not re.fullmatch(DATE, until)):
            raise ValueError("a path, or an invalid date")
    except ValueError as error:
        raise DependencyError(
            "the client asks for an invalid range of Python versions, for an interpreter by its "
            "path, or for an invalid date",
            reason="requirement",
        ) from error
    left_out = ((name, "without, of the client") for [name] in order["without"])
    return PackageRequest(
        "what the client asks for",
        _wanted(order["requirements"]),
        supports=order["supports"],
        python=python,
        exclude_newer=until or None,
        always=order["always"],
        guesses=tuple(
            Guess(module, _wanted([row])[0], tuple(map(canonicalize_name, names.split())))
            for *row, module, names in order["guesses"]
        ),
        constraints=_wanted(order["constraints"]),
        override=_wanted(order["override"]),
        without=tuple(package.requirement.name for package in _wanted(left_out)),
        gpu=order["gpu"],
    )


def _wanted(rows: Iterable[Sequence[str]]) -> tuple[WantedPackage, ...]:
    return tuple(parse_requirement(text, printable(where, _WHERE_CHARS)) for text, where in rows)


# --- the watcher --------------------------------------------------------------------------------


def _watched(order: Mapping[str, Any], ended: int | None) -> dict[str, Any]:
    """Has the packages made within bounds; returns {} if the maker has written the answer."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    if ended is not None:
        end_with(ended, _CLEANING_S)
    with _alone(Path(order["folder"])) as held:
        unfinished = Path(order["folder"], "unfinished")
        if unfinished.exists():
            _clean(order)  # its maker was killed
        _make_room(order)
        unfinished.touch()
        try:
            finished = _worked(order, held)
        except BaseException:
            _clean(order)
            unfinished.unlink()
            raise
        if not finished or _charged(_uv_cache(order)) > order["bytes"] // 4:
            _clean(order)
        unfinished.unlink()
    return {}


def _worked(order: Mapping[str, Any], held: int) -> bool:
    """Runs the maker; tells whether it ended without leaving anything half-made."""
    with pidfd() as ourselves:
        process = subprocess.Popen(
            [*program(_PROGRAM), "make", f"{_PIDFD}{ourselves}"],
            stdin=subprocess.PIPE,
            pass_fds=(held, ourselves),
            start_new_session=True,  # a group of its own, which includes uv
        )
    try:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError), process.stdin as stdin:
            stdin.write(json.dumps(order).encode())
        while process.poll() is None:
            _look(order)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_LOOK_S)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if process.returncode != 0:
        raise DependencyError(f"the program that makes packages ended with {process.returncode}")
    return "error" not in json.loads(os.pread(1, 1 << 20, 0) or b"{}")


def _look(order: Mapping[str, Any]) -> None:
    charged = _charged(Path(order["folder"]))
    if charged > order["bytes"]:
        raise DependencyError(
            f"the packages of your key have {charged / 2**20:,.0f} MiB there, what is downloaded "
            f"for them included; the server's quota is {order['bytes'] / 2**20:,.0f} MiB "
            "(--max-packages). Nothing was installed",
            reason="size",
        )


def _charged(folder: Path) -> int:
    """Returns the bytes of all files below a folder, at least a block for each."""
    total = 0
    for path in bounds.walk(folder):
        with contextlib.suppress(OSError):
            total += max(path.lstat().st_size, BLOCK_BYTES)
    return total


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[int]:
    """Hold the lock of a client's folder: a killed server may have left a maker there."""
    folder.mkdir(parents=True, exist_ok=True)

    waits = {"progress": "waiting for another process, which makes packages there"}
    lock = locks.held(folder / "lock", wait_s=_LOCKED_S, on_wait=lambda: _say(waits))
    with contextlib.ExitStack() as stack:
        try:
            descriptor = stack.enter_context(lock)
        except TimeoutError:
            raise DependencyError("another process is making packages there; try again") from None
        yield descriptor


def _uv_cache(order: Mapping[str, Any]) -> Path:
    return Path(order["folder"], "uv")


def _clean(order: Mapping[str, Any]) -> None:
    """Remove unfinished folders and uv's cache, where an unpacked package may be damaged.

    A uv that was killed a moment ago holds its lock until the kernel has ended it.
    """
    until = time.monotonic() + _WAIT_S
    while True:
        environments.remove_abandoned()
        remove_tree(_uv_cache(order))
        left = environments.half_made() or _uv_cache(order).exists()
        if not left or time.monotonic() > until:
            return
        time.sleep(_LOOK_S)


def _make_room(order: Mapping[str, Any]) -> None:
    """Keep at least half of the bound free for new packages: remove the longest unused ones."""
    folder, keep = Path(order["folder"]), frozenset[str](order["keep"])
    if _charged(folder) > order["bytes"] // 2:
        remove_tree(_uv_cache(order))
        remove_tree(folder / "resolutions")
    removable = [kept for kept in reversed(environments.every()) if kept.key not in keep]
    for environment in removable:
        if _charged(folder) <= order["bytes"] // 2:
            return
        environments.remove(environment)


if __name__ == "__main__":
    sys.exit(main())
