"""What a refused installation leaves in uv's cache: nothing.

uv unpacks what it downloads there before it installs it, and keeps what it had unpacked when it was
ended: that of a wheel that is too large would stay for good, and be found there the next time.
"""

from __future__ import annotations

import contextlib
import fcntl
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from envhub_sandbox.dependencies import index, uv
from envhub_sandbox.errors import DependencyError, IndexUnavailableError
from envhub_sandbox.hub.store import remove_tree

WAIT_S = 10.0
"""For how long to wait for others who use that cache."""
_POLL_S = 0.1
_CLEAN_S = 60.0


@contextlib.contextmanager
def cleared_after_refusal(pins: Sequence[str]) -> Iterator[None]:
    """Remove what uv has of these packages if they are refused; they can be downloaded again.

    Args:
        pins: ``name==version`` of each.
    """
    begun = time.time()
    try:
        yield
    except IndexUnavailableError:
        raise  # what has come is worth keeping
    except DependencyError:
        # from the file system's clock, which may be some milliseconds behind
        if _remove_unfinished(index.uv_cache(), begun - 1):
            _clean(pins)
        raise


def _clean(pins: Sequence[str]) -> None:
    names = sorted({pin.partition("==")[0] for pin in pins})
    with contextlib.suppress(DependencyError):
        uv.run(
            ["cache", "clean", "--no-config", *names],
            what="uv's cache could not be cleaned",
            timeout_s=_CLEAN_S,
        )


def _remove_unfinished(cache: Path, since: float) -> bool:
    """Remove uv's temporary folders of this time, once no uv is at work that could own one.

    Each holds this lock, shared, for as long as it works; where one works on, nothing is removed,
    and False returned.
    """
    with contextlib.suppress(OSError), (cache / ".lock").open("rb") as lock:
        until = time.monotonic() + WAIT_S
        while not _taken(lock.fileno()):
            if time.monotonic() > until:
                return False
            time.sleep(_POLL_S)
        for path in cache.glob(".tmp*"):
            if path.lstat().st_mtime >= since:
                remove_tree(path)
        return True
    return False


def _taken(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
