"""Exchange the root for another one."""

import os
import tempfile

from payloads.kernel import CLONE_NEWNS, become_root_of_a_namespace, in_child, syscall

_BIND, _PRIVATE = 0x1000, 0x44000


def attack(alias):
    def pivot():
        place = tempfile.mkdtemp().encode()
        try:
            become_root_of_a_namespace(CLONE_NEWNS)
        finally:
            syscall("mount", b"none", b"/", b"", _PRIVATE, 0)
            syscall("mount", place, place, b"", _BIND, 0)
            os.mkdir(place + b"/old")
            syscall("pivot_root", place, place + b"/old")

    return in_child(alias, pivot)
