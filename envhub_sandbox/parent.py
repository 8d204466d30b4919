"""A process that ends with the one that started it, whatever ended that.

Who starts one hands it a pidfd of itself, and who was started watches it. The kernel's own signal
at a parent's death would come when the thread ends that has started the child, and a change of user
forgets it.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import threading
import time
from collections.abc import Iterator


@contextlib.contextmanager
def pidfd() -> Iterator[int]:
    """A pidfd of this process, for one that is started meanwhile with it in ``pass_fds``."""
    ourselves = os.pidfd_open(os.getpid())
    try:
        yield ourselves
    finally:
        os.close(ourselves)


def end_with(parent: int, patience_s: float) -> None:
    """End this process as soon as another has ended, and with it the group that it leads.

    Args:
        parent: A pidfd of the other.
        patience_s: For what SIGTERM does here, in the main thread, before all are killed; with none
            they are killed at once.
    """
    os.set_inheritable(parent, False)
    threading.Thread(target=_watch, args=(parent, patience_s), daemon=True).start()


def _watch(parent: int, patience_s: float) -> None:
    poll = select.poll()  # of descriptors beyond 1023, too
    poll.register(parent, select.POLLIN)
    while not poll.poll():
        pass
    if patience_s > 0:
        # of all threads the one whose system call it has to interrupt
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
        time.sleep(patience_s)
    if os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os.kill(os.getpid(), signal.SIGKILL)
