"""Landlock: restricts which files a thread and its descendants may open, which TCP ports they may
bind and connect, and which processes they may signal.

It stops neither chmod, utime and setxattr nor sockets other than TCP. It binds the calling thread
only: call it before any other thread exists.
"""

from __future__ import annotations

import errno
import os
import stat
import struct
from collections.abc import Iterable

from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.mechanisms import kernel
from envhub_worker.protocol.records import dataclass

_VERSION = 1
_RULE_PATH_BENEATH = 1

EXECUTE, WRITE_FILE, READ_FILE, READ_DIR = 1 << 0, 1 << 1, 1 << 2, 1 << 3
REMOVE_DIR, REMOVE_FILE = 1 << 4, 1 << 5
MAKE_CHAR, MAKE_DIR, MAKE_REG, MAKE_SOCK = 1 << 6, 1 << 7, 1 << 8, 1 << 9
MAKE_FIFO, MAKE_BLOCK, MAKE_SYM = 1 << 10, 1 << 11, 1 << 12
REFER, TRUNCATE, IOCTL_DEV = 1 << 13, 1 << 14, 1 << 15

READ = EXECUTE | READ_FILE | READ_DIR
WRITE = READ | WRITE_FILE | REMOVE_DIR | REMOVE_FILE | MAKE_DIR | MAKE_REG | MAKE_SOCK
WRITE |= MAKE_FIFO | MAKE_SYM | REFER | TRUNCATE
DEVICE = READ_FILE | WRITE_FILE | IOCTL_DEV
_ON_FILES = EXECUTE | WRITE_FILE | READ_FILE | TRUNCATE | IOCTL_DEV

_BIND_TCP, _CONNECT_TCP = 1, 2
_SCOPE_ABSTRACT_UNIX_SOCKET, _SCOPE_SIGNAL = 1, 2


@dataclass(frozen=True)
class LandlockRule:
    """The rights that are granted at and below a path."""

    path: str
    access: int


@dataclass(frozen=True)
class Ruleset:
    """The rights that Landlock handles: it denies each handled right that no rule grants."""

    files: int
    tcp: int
    scope: int


def ruleset(abi: int, network: str) -> Ruleset:
    """Returns all rights that ``abi`` can handle; the kernel would refuse an unknown bit.
    ``network``: ``"none"`` denies all TCP; otherwise the network layer decides.
    """
    bits = {1: 13, 2: 14, 3: 15, 4: 15}.get(abi, 16)
    return Ruleset(
        files=(1 << bits) - 1,
        tcp=_BIND_TCP | _CONNECT_TCP if abi >= 4 and network == "none" else 0,
        scope=_SCOPE_ABSTRACT_UNIX_SOCKET | _SCOPE_SIGNAL if scopes(abi) else 0,
    )


def scopes(abi: int) -> bool:
    """Whether ``abi`` keeps signals and abstract sockets inside the domain."""
    return abi >= 6


def version() -> int:
    """The ABI that this kernel offers, or 0."""
    try:
        return kernel.syscall("landlock_create_ruleset", None, 0, _VERSION)
    except OSError:
        return 0


def restrict(handled: Ruleset, rules: Iterable[LandlockRule]) -> None:
    """Enforce ``handled`` on this thread for good. ``no_new_privs`` must be set.

    A rule whose path does not exist is left out: it would permit nothing.
    Raises ``LayerUnavailableError``: the kernel refuses.
    """
    try:
        words = struct.pack("=QQQ", handled.files, handled.tcp, handled.scope)
        # A kernel refuses a structure longer than its own unless the rest is zero. The first
        # kernels with Landlock know the first field only.
        size = 24 if handled.scope else 16 if handled.tcp else 8
        fd = kernel.syscall("landlock_create_ruleset", words, size, 0)
        try:
            for rule in rules:
                _add(fd, rule, handled.files)
            kernel.syscall("landlock_restrict_self", fd, 0)
        finally:
            os.close(fd)
    except OSError as error:
        raise unavailable(error) from error


def _add(ruleset_fd: int, rule: LandlockRule, handled: int) -> None:
    try:
        path = os.open(rule.path, os.O_PATH | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        # The kernel refuses a rule with a right that the ruleset does not handle, or that only
        # folders have.
        access = rule.access & handled
        if not stat.S_ISDIR(os.fstat(path).st_mode):
            access &= _ON_FILES
        words = struct.pack("=Qi", access, path)
        kernel.syscall("landlock_add_rule", ruleset_fd, _RULE_PATH_BENEATH, words, 0)
    finally:
        os.close(path)


def unavailable(error: OSError) -> LayerUnavailableError:
    """Returns the error that says why this host has no Landlock, and what to do."""
    if error.errno == errno.ENOSYS:
        reason = "this kernel has no Landlock (it needs Linux 5.13), or a container hides it"
        fix = "Use a newer kernel; in a container, a runtime whose seccomp profile allows it."
    elif error.errno == errno.EOPNOTSUPP:
        reason = "Landlock is built in but not enabled"
        fix = "Add landlock to the lsm= list on the kernel's command line."
    else:
        reason = f"the kernel answers {errno.errorcode.get(error.errno or 0, '?')}"
        fix = "In a container, use a runtime whose seccomp profile allows landlock_restrict_self."
    return LayerUnavailableError("landlock", reason, fix)
