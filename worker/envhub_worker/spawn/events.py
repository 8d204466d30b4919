"""What a spawner and its jails tell the server: frozen values, read in its poll loop."""

from __future__ import annotations

from typing import Any

from envhub_worker.protocol.confinement import Reason
from envhub_worker.protocol.records import dataclass


@dataclass(frozen=True)
class ZygoteDied:
    """The zygote has gone, and every jail with it.

    Attributes:
        code: Its exit code, or minus the signal that ended it.
    """

    code: int
    log: str


@dataclass(frozen=True)
class Ready:
    """A runner of the jail is confined. ``report``: every layer that holds for it."""

    report: list[dict[str, Any]]


@dataclass(frozen=True)
class Failed:
    """A layer that the profile names cannot be had here; the jail ends, nothing has run."""

    layer: str
    reason: str
    fix: str


@dataclass(frozen=True)
class RunnerStarted:
    """A runner is confined, has tested its denials, and now enters ``runner.main``.

    Attributes:
        pid: Its pid as this process sees it; 0 or less when it has already ended.
        report: Every layer that holds for it, the jail's own first.
    """

    runner_id: int
    pid: int
    report: list[dict[str, Any]]


@dataclass(frozen=True)
class RunnerExited:
    """A runner has ended.

    Attributes:
        detail: The numbers, where a limit was the reason.
    """

    runner_id: int
    code: int | None
    signal: int | None
    reason: Reason
    detail: str = ""


@dataclass(frozen=True)
class Denied:
    """Something in the jail tried a system call that the policy denies, for the first time.

    Attributes:
        call: Its name; of what is asked of a file also "read" or "write".
        detail: What is known of its arguments: a family of sockets, a path, or nothing.
    """

    call: str
    detail: str


JailEvent = Ready | Failed | RunnerStarted | RunnerExited | Denied
