"""Who is told what becomes of jails: a log, or nobody."""

from __future__ import annotations

import contextlib
import traceback
from typing import Protocol

from envhub_worker.protocol import messages as m
from envhub_worker.supervisor.records import JailEntry


class Witness(Protocol):
    """Hears of every jail. It must not raise, and must not keep what it is shown."""

    def opened(self, entry: JailEntry, runners: int, seconds: float) -> None:
        """A jail has come up, or further runners in it, so long after it was asked for."""

    def lost(self, entry: JailEntry, death: m.Died) -> None:
        """A runner has died in a jail that goes on."""

    def died(self, entry: JailEntry) -> None:
        """A jail is dead: ``entry.death`` says how."""

    def closed(self, entry: JailEntry) -> None:
        """Nothing is left of a jail that its client has closed, or that the server ends with."""

    def failed(self, error: Exception) -> None:
        """The server itself has met an error, of which it does not die."""


class Nobody:
    """The server's client is on this machine, and logs by itself."""

    def opened(self, entry: JailEntry, runners: int, seconds: float) -> None:
        """Nothing."""

    def lost(self, entry: JailEntry, death: m.Died) -> None:
        """Nothing."""

    def died(self, entry: JailEntry) -> None:
        """Nothing."""

    def closed(self, entry: JailEntry) -> None:
        """Nothing."""

    def failed(self, error: Exception) -> None:
        """On stderr, which its client keeps."""
        with contextlib.suppress(OSError, ValueError):  # nobody may read it any more
            traceback.print_exception(error)
