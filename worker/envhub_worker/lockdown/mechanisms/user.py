"""Changes from root to a user that owns no file and runs no process."""

from __future__ import annotations

import contextlib
import os
import pwd
import random
from operator import itemgetter

from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.mechanisms import kernel, process, procfs

CAP_CHOWN, CAP_SETGID, CAP_SETUID = 0, 6, 7

# User ids far above the ranges that distributions, systemd and rootless containers assign.
_HIGH = range(0x6E000000, 0x6EFFFFFF)
# User ids for a container whose user namespace maps only 65536 users.
_LOW = range(62000, 65000)


def choose() -> int | None:
    """Chooses the user that root's jails become; None if this process is not root.
    Raises ``LayerUnavailableError``: this root has no right to become another user.
    """
    if os.geteuid() != 0:
        return None
    needed = 1 << CAP_CHOWN | 1 << CAP_SETGID | 1 << CAP_SETUID
    if kernel.capget()[0] & needed != needed:
        raise LayerUnavailableError(
            "unprivileged-user",
            "root has no capability here to become another user",
            "Start as a plain user (in a container: --user 1000:1000), or add the capabilities: "
            "--cap-add CHOWN --cap-add SETGID --cap-add SETUID.",
        )
    return unused_uid()


def unused_uid() -> int:
    """Finds a user id that is mapped here, has no name and runs no process.
    Raises ``LayerUnavailableError``: this user namespace maps too few users.
    """
    mapped = _mapped()
    for candidates in (_HIGH, _LOW):
        if mapped[0] <= candidates[0] and candidates[-1] <= mapped[1]:
            return _unused(candidates)
    raise LayerUnavailableError(
        "unprivileged-user",
        "root here cannot become another user: this user namespace maps too few ids",
        "Start as a plain user, or map at least 65536 ids into the container.",
    )


def _mapped() -> tuple[int, int]:
    """Returns the first and last id of the widest range that this user namespace maps."""
    with open("/proc/self/uid_map") as file:
        ranges = [tuple(map(int, line.split())) for line in file]
    inside, _, length = max(ranges, key=itemgetter(2))
    return inside, inside + length - 1


def _unused(candidates: range) -> int:
    running = set()
    for pid in procfs.pids():
        with contextlib.suppress(OSError):
            running.add(os.stat(f"/proc/{pid}").st_uid)
    while True:
        uid = random.SystemRandom().choice(candidates)
        try:
            pwd.getpwuid(uid)
        except KeyError:  # nobody's
            if uid not in running:
                return uid


def become(uid: int) -> None:
    """Become ``uid`` with that group only, for good. Call ``die_with_parent`` again afterwards."""
    # In this order: each step needs a capability that the change of user, the last one, takes.
    process.empty_the_bounding_set()
    os.setgroups([])
    os.setresgid(uid, uid, uid)
    os.setresuid(uid, uid, uid)
    # The change of user gave /proc/self to root; without this line we could not write our user map.
    process.set_dumpable(True)
