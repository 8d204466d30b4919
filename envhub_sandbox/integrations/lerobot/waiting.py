"""Environments that have told their spaces, kept for whoever asks for the very same next.

LeRobot wants the features of an environment before it makes any. The jail that told them is the one
that is used then: a simulator is loaded once. Where nobody comes, as before a training whose first
evaluation is an hour away, it is closed.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable

from envhub_sandbox.vector.suites import EnvSuites


class Waiting:
    """At most one for each key, for some seconds each.

    Args:
        seconds: For how long one is kept.
    """

    def __init__(self, seconds: float = 60.0) -> None:
        self._seconds = seconds
        self._lock = threading.Lock()
        self._kept: dict[Hashable, EnvSuites] = {}

    def put(self, key: Hashable, suites: EnvSuites) -> None:
        """Keep these; others of that key are closed."""
        with self._lock:
            before, self._kept[key] = self._kept.get(key), suites
        if before is not None:
            before.close()
        timer = threading.Timer(self._seconds, self._give_up, (key, suites))
        timer.daemon = True
        timer.start()

    def take(self, key: Hashable) -> EnvSuites | None:
        """Those of this key, which are the caller's from now on."""
        with self._lock:
            return self._kept.pop(key, None)

    def _give_up(self, key: Hashable, suites: EnvSuites) -> None:
        with self._lock:
            if self._kept.get(key) is not suites:
                return
            del self._kept[key]
        suites.close()
