"""``Witness``: the interface that is called about each event of a jail."""

from __future__ import annotations

import contextlib
import traceback

from envhub_worker.protocol import messages as m
from envhub_worker.supervisor.records import JailRecord


class Witness:
    """Called about every jail. It must not raise, and must not keep what it is shown.

    This one writes nothing down: the server's client is on this machine, and logs by itself.
    """

    def opened(self, entry: JailRecord, runners: int, seconds: float) -> None:
        """A jail has come up, or further runners in it, so long after it was asked for."""

    def lost(self, entry: JailRecord, death: m.Death) -> None:
        """A runner has died in a jail that goes on."""

    def died(self, entry: JailRecord) -> None:
        """A jail is dead: ``entry.death`` says how."""

    def closed(self, entry: JailRecord) -> None:
        """Nothing is left of a jail that its client has closed, or that the server ends with."""

    def failed(self, error: Exception) -> None:
        """The server itself has met an error, of which it does not die: on stderr."""
        with contextlib.suppress(OSError, ValueError):  # stderr may have no reader any more
            traceback.print_exception(error)
