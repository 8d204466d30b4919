"""What a repository has warned of, on its way to the caller: a warning of Python's, once each.

Heard where a reply comes in, on whatever thread that is, and told where the caller has asked for
something: his filters may make an error of it, which is not the worker's then.
"""

from __future__ import annotations

import sys
import warnings
from collections import deque
from collections.abc import Sequence

from envhub_sandbox.errors import RemoteEnvWarning
from envhub_worker.protocol.codec.codec import Buffer
from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.messages import warned
from envhub_worker.protocol.text import printable
from envhub_worker.protocol.untrusted import UNTRUSTED

MOST = 100
"""Different warnings of one repository. Whoever has more floods."""
_PACKAGE = __name__.partition(".")[0]
_NO_MORE = (
    "Warning",
    f"there have been more than {MOST} different warnings: further ones are only in what it prints",
)


class Heard:
    """What one repository has warned of, in any of its processes.

    Attributes:
        untold: What the caller has not been told yet. Always the same object.
    """

    def __init__(self) -> None:
        self.untold: deque[warned.Told] = deque()
        self._known: set[warned.Told] = set()

    def take(self, frames: Sequence[Buffer]) -> Sequence[Buffer]:
        """A reply's own frames, without the warnings in front. Trust: input from the worker.

        Raises:
            RemoteProtocolError: These are not what was agreed on.
        """
        if not warned.stand_in_front(frames):
            return frames
        with UNTRUSTED:
            for one in warned.read(frames[0]):
                self._hear(one)
        return frames[1:]

    def _hear(self, one: warned.Told) -> None:
        known = self._known
        if one in known or len(known) > MOST:
            return
        known.add(one)
        self.untold.append(one if len(known) <= MOST else _NO_MORE)

    def tell(self, label: str) -> None:
        """Warn the caller of what he has not been told yet, where his own code stands.

        Raises:
            RemoteEnvWarning: His filters say so. What comes after it is told the next time.
        """
        while self.untold:
            try:
                category, text = self.untold.popleft()
            except IndexError:  # another thread was faster
                return
            warning = RemoteEnvWarning(
                label, one_line(category, warned.MAX_CATEGORY), printable(text, warned.MAX_TEXT)
            )
            warnings.warn(warning, stacklevel=_level_of_the_caller())


def _level_of_the_caller() -> int:
    """How far up the first frame lies that is none of this package, as ``warnings.warn`` counts."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and _is_ours(frame.f_globals.get("__name__")):
        frame, level = frame.f_back, level + 1
    return level


def _is_ours(name: object) -> bool:
    return isinstance(name, str) and name.partition(".")[0] == _PACKAGE
