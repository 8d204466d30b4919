"""Giving up every capability: a jail that keeps one remounts /usr writable."""

from __future__ import annotations

import errno

from envhub_worker.lockdown.mechanisms.kernel import capget, capset, prctl

_PR_CAPBSET_DROP = 24
_PR_CAP_AMBIENT = 47
_PR_CAP_AMBIENT_CLEAR_ALL = 4

CAP_SETPCAP = 8


def drop_all() -> None:
    """Empty the bounding, ambient, inheritable, permitted and effective sets."""
    empty_the_bounding_set()
    prctl(_PR_CAP_AMBIENT, _PR_CAP_AMBIENT_CLEAR_ALL)
    capset(0, 0, 0)


def held() -> int:
    """Mask of what this thread has, may have or may pass on."""
    effective, permitted, inheritable = capget()
    return effective | permitted | inheritable


def empty_the_bounding_set() -> None:
    """Let no later ``execve`` bring a capability in. Nothing happens without the right to."""
    if not capget()[0] >> CAP_SETPCAP & 1:
        return
    for capability in range(64):
        try:
            prctl(_PR_CAPBSET_DROP, capability)
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
            return  # the first that this kernel does not know
