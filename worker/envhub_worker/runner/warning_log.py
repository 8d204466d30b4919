"""Records what the repository warns of, for the replies to take along: each text once.

Python's own filters come first, as in any other process. What is heard is shown, too, as it was:
it stands in what the jail prints. Followed: ``warnings.showwarning``.
"""

from __future__ import annotations

import re
import warnings
from typing import Any

from envhub_worker.protocol.codec.codec import Buffer
from envhub_worker.protocol.codec.inert import type_name
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.messages.prefix import MAX_TEXT, WARNINGS, RemoteWarning
from envhub_worker.protocol.text import printable

_MOST = 256
"""Different texts of one runner; further ones are only printed."""
_KEPT = 1024
"""Characters of a text."""
_COLORS = re.compile("\x1b\\[[0-9;]*m")
"""With which Gymnasium's logger surrounds what it says."""


class WarningLog:
    """What has been warned of.

    Attributes:
        pending: What no reply has taken along yet. Always the same list.
    """

    def __init__(self) -> None:
        self.pending: list[RemoteWarning] = []
        self._heard: set[RemoteWarning] = set()

    def listen(self) -> None:
        """Hear whatever is shown from now on, in any thread."""
        show = warnings.showwarning

        def hear(
            message: Any,
            category: Any,
            filename: str,
            lineno: int,
            file: Any = None,
            line: Any = None,
        ) -> None:
            if file is None:
                self._note(message, category)
            show(message, category, filename, lineno, file, line)

        warnings.showwarning = hear

    def _note(self, message: object, category: type) -> None:
        if len(self._heard) >= _MOST:
            return
        try:
            text = _COLORS.sub("", str(message)[:_KEPT])
            one = (type_name(category), printable(text, _KEPT)[:MAX_TEXT])
        except Exception:  # it has no text
            return
        if one not in self._heard:
            self._heard.add(one)
            self.pending.append(one)

    def in_front(self, frames: list[Any]) -> list[Buffer]:
        """A reply's frames, with what is pending in front of them."""
        if not self.pending or len(frames) >= DEFAULT_LIMITS.frames:
            return frames
        some = self.pending[: WARNINGS.most]
        del self.pending[: len(some)]
        return WARNINGS.put(some, frames)
