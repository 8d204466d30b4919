"""Shows each warning of a repository once, as a Python warning in the client.

Any thread collects warnings when it reads a reply. They are shown at the end of the caller's
request, because a filter of the caller may turn a warning into an error, which must not count as an
error of the worker.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

from envhub_sandbox.errors import RemoteEnvWarning
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system.log import warn_caller
from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.messages.prefix import (
    MAX_CATEGORY,
    MAX_TEXT,
    SHARED_CATEGORY,
    SHARED_STATE,
    WARNINGS,
    RemoteWarning,
)
from envhub_worker.protocol.text import printable

MOST = 100
"""The most different warnings that are shown of one repository."""
SHARED_WARNING = "SharedStateWarning"
"""The category of warnings about processes that sub-environments share."""
_SHARED = (
    "sub-environments that share a process use {} of it, so they may give other results than with "
    "AsyncVectorEnv, where each has a process. From the next make_env of this commit on each has "
    f"one here too; {option_name('num_workers', '<n_envs>')} gives each one now"
)
_CHOSEN = (
    "sub-environments use {}, which those of one process share. Here "
    f"{option_name('num_workers')}, {option_name('min_ready')} or several places decide which do, "
    "so results may be others than with Gymnasium's own class; without these they are not"
)
_NO_MORE = (
    "Warning",
    f"more than {MOST} different warnings: further ones are only in the worker's output",
)


class RemoteWarnings:
    """The warnings of one repository, from any of its processes.
    ``unshown``: the warnings that the caller has not seen yet. Always the same object.
    ``note_shared``: called when sub-environments that share a process are not independent.
    ``chosen``: whether the caller chose how many processes there are.
    """

    def __init__(self) -> None:
        self.unshown: deque[RemoteWarning] = deque()
        self.note_shared: Callable[[], None] | None = None
        self.chosen = False
        self._known: set[RemoteWarning] = set()  # each is shown once

    def take(self, frames: Sequence[Buffer]) -> Sequence[Buffer]:
        """Collect the warnings in front of a reply; returns the reply's other frames.
        Trust: input from the worker. Raises ``RemoteProtocolError``: the prefix is malformed.
        """
        warnings, rest = WARNINGS.read(frames)
        for warning in warnings:
            if warning[0] != SHARED_CATEGORY:
                self.collect(warning)
            elif self.note_shared is not None:
                self.note_shared()
                self.note_shared = None  # only once: a hostile worker may repeat it
                text = _CHOSEN if self.chosen else _SHARED
                self.collect((SHARED_WARNING, text.format(SHARED_STATE[warning[1]])))
        return rest

    def collect(self, warning: RemoteWarning) -> None:
        """Have a warning shown, unless it was before."""
        shown = self._known
        if warning in shown or len(shown) > MOST:
            return
        shown.add(warning)
        self.unshown.append(warning if len(shown) <= MOST else _NO_MORE)

    def show(self, label: str) -> None:
        """Show new warnings at the line of the caller's own code.
        Raises ``RemoteEnvWarning``: a filter of the caller asks for it; the rest is shown later.
        """
        while self.unshown:
            try:
                category, text = self.unshown.popleft()
            except IndexError:  # another thread was faster
                return
            words = one_line(category, MAX_CATEGORY), printable(text, MAX_TEXT)
            warning = RemoteEnvWarning(label, *words)
            warn_caller(warning)
