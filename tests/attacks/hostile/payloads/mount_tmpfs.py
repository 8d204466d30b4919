"""Mount something."""

import tempfile

from payloads.kernel import CLONE_NEWNS, become_root_of_a_namespace, in_child, syscall

_MS_REC_PRIVATE = 0x44000


def attack(alias, source):
    place = tempfile.mkdtemp()

    def work():
        # Not to be seen by anybody else, where this works.
        become_root_of_a_namespace(CLONE_NEWNS)
        syscall("mount", b"none", b"/", b"", _MS_REC_PRIVATE, 0)

    def mount():
        try:
            work()
        except OSError as error:
            failed = str(error)
        else:
            failed = ""
        syscall("mount", source.encode(), place.encode(), b"tmpfs", 0, b"size=64k")
        return failed

    return in_child(alias, mount)
