"""Change what the root may be used for: a sandbox's is read-only."""

from payloads.kernel import CLONE_NEWNS, become_root_of_a_namespace, in_child, syscall

_REMOUNT, _BIND, _PRIVATE = 0x20, 0x1000, 0x44000
_NOSUID, _NODEV, _NOEXEC = 2, 4, 8


def attack(alias):
    def remount():
        answers = []
        try:
            become_root_of_a_namespace(CLONE_NEWNS)
            syscall("mount", b"none", b"/", b"", _PRIVATE, 0)
        except OSError as error:
            answers.append(str(error))
        for flags in (0, _NODEV | _NOSUID, _NODEV | _NOSUID | _NOEXEC):
            try:
                syscall("mount", b"none", b"/", b"", _REMOUNT | _BIND | flags, 0)
                answers.append("remounted")
            except OSError as error:
                answers.append(str(error))
        return answers

    return in_child(alias, remount)
