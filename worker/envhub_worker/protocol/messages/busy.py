"""What a refusal for want of room says: which quota, how much is used, when to ask again.

It travels in ``Refusal``, whose ``error`` is then ``ServerBusyError``: ``missing`` is the quota's
name, ``fix`` three numbers. A client that knows nothing of it has a ``WorkerError`` with the text.
"""

from __future__ import annotations

import re

from envhub_worker.protocol.records import dataclass

ERROR = "ServerBusyError"
DRAINING = "draining"
"""In the place of a quota: the server is about to end."""
LONGEST_S = 60.0
_NUMBERS = r"(\d{1,18}) (\d{1,18}) (\d{1,4}(?:\.\d{1,3})?)"
_NAME = r"[a-z_]{1,32}"


@dataclass(frozen=True)
class Busy:
    """Why there is no room at present.

    Attributes:
        used: How much of it others of the same key have.
        limit: How much there is.
        retry_s: After how many seconds it is worth asking again.
    """

    quota: str
    used: int
    limit: int
    retry_s: float

    def words(self) -> str:
        """The numbers as they travel."""
        return f"{self.used} {self.limit} {self.retry_s:.3f}"

    @classmethod
    def read(cls, quota: str, words: str) -> Busy:
        """What travelled; with nothing in it where that is none. Trust: input from the worker."""
        found = re.fullmatch(_NUMBERS, words)
        if found is None or not re.fullmatch(_NAME, quota):
            return cls("", 0, 0, 1.0)
        return cls(quota, int(found[1]), int(found[2]), min(float(found[3]), LONGEST_S))
