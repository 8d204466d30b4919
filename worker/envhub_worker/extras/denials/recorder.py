"""Reports the denied attempts of a jail to its init, and calls that name what is not its own."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable

from envhub_worker.extras.denials.paths import OwnPaths, asked
from envhub_worker.extras.denials.targets import OTHER, is_another_target
from envhub_worker.lockdown.context import JailContext
from envhub_worker.lockdown.root_plan import TERMINALS
from envhub_worker.lockdown.seccomp.notify import Request
from envhub_worker.lockdown.seccomp.policy import BROKERED
from envhub_worker.lockdown.seccomp.syscalls import NAMED, NAMING, PRETENDED
from envhub_worker.lockdown.stages.runner import writable_folders

_MOST_OF_A_KIND = 32
"""Different denials that are reported of a jail, of files, of sockets and of other calls each: a
flood of one kind hides no attempt of another."""
_NETLINKS = (0, 15)
"""Of addresses and of devices: what the C library and what looks for devices asks."""


class Recorder:
    """Reports each denied attempt of one jail once.

    ``report``: called with the name of the call, for files also "read" or "write", and a detail.
    """

    def __init__(self, jail: JailContext, report: Callable[[str, str], None]) -> None:
        self._jail, self._report = jail, report
        self._reported: set[tuple[str, str]] = set()

    def note(self, request: Request) -> None:
        """Report a waiting call if it is denied, or names what is not the jail's own."""
        call, watched = request.call, self._jail.common.watched
        if call in NAMED and call in watched:
            own = _own_paths(self._jail, request.caller, request.thread)
            for attempt in asked(call, request.words, request.thread, own, request.still_waits):
                self._report_once(*attempt)
            return
        detail = _detail(request)
        own_affair = call in watched or call in PRETENDED or call in BROKERED
        if detail or not own_affair:  # else it targets the jail's own processes
            self._report_once(call, detail)

    def _report_once(self, call: str, detail: str) -> None:
        kind, denial = _kind(detail), (call, detail)
        if denial in self._reported:
            return
        if sum(_kind(other) == kind for _, other in self._reported) < _MOST_OF_A_KIND:
            self._reported.add(denial)
            self._report(call, detail)


def _kind(detail: str) -> str:
    return next((begin for begin in ("/", "AF_") if detail.startswith(begin)), "")


def _detail(request: Request) -> str:
    """Returns the scalar arguments that are safe to report, such as the family of a socket."""
    call = request.call
    if call in NAMING and is_another_target(call, request.arguments, request.caller, os.getpid()):
        return OTHER
    if call not in ("socket", "socketpair"):
        return ""
    family, _, protocol = request.arguments
    try:
        name = socket.AddressFamily(family).name
    except ValueError:
        return "AF_UNKNOWN"
    is_known = family != socket.AF_NETLINK or protocol in _NETLINKS
    return name if is_known else f"{name}_OTHER"


def _own_paths(jail: JailContext, pid: int, thread: int) -> OwnPaths:
    """Returns the paths that a process may change and read, under the names that it sees."""
    streams = ("/dev/fd", "/dev/stdin", "/dev/stdout", "/dev/stderr")
    itself = ("/proc/self", "/proc/thread-self", f"/proc/{pid}", f"/proc/{thread}")
    scratch = tuple(writable_folders(jail))
    terminals = (TERMINALS, "/dev/ptmx") if jail.common.namespaced else ()
    changed = (*scratch, *jail.common.root.devices, *terminals, *streams, *itself)
    read = (*jail.common.root.trees, jail.spec.snapshot, *changed)
    return OwnPaths(changed=changed, read=read, scratch=scratch)
