"""A runner tries what it must not be able to do. The last thing before a stranger's code."""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
from collections.abc import Callable, Iterable
from functools import partial

from envhub_worker.lockdown.context import JailContext
from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.mechanisms import kernel, process
from envhub_worker.lockdown.seccomp import filter
from envhub_worker.lockdown.seccomp.syscalls import syscall_number

_PTRACE_ATTACH = 16
_RLIMIT_CORE = 4


def run(jail: JailContext, descriptors: Iterable[int]) -> None:
    """Test every denial that can be tested without harm.
    Raises ``LayerUnavailableError``: layer ``self-test``: one of them does not hold.
    """
    _hold("no capability is left", process.held_capabilities() == 0)
    _hold("no_new_privs is set", process.has_no_new_privileges())
    _hold("a system call filter is installed", filter.installed())
    for path, shared in jail.view.shared.items():
        _hold(f"what is written to {path} stays in the jail", _stays_inside(path, shared))
    listed = {fd for fd in map(int, os.listdir("/proc/self/fd")) if _is_open(fd)}
    _hold("only named descriptors are open", listed <= set(descriptors))
    for claim, attempt in _denials(jail).items():
        _hold(claim, _denied(attempt))


def _denials(jail: JailContext) -> dict[str, Callable[[], object]]:
    init = os.getppid()
    denials: dict[str, Callable[[], object]] = {
        "no user namespace can be made": lambda: kernel.unshare(kernel.CLONE_NEWUSER),
        "nothing can be mounted": lambda: kernel.mount("none", "/tmp", "tmpfs"),
        "init cannot be traced": lambda: kernel.syscall(
            syscall_number("ptrace"), _PTRACE_ATTACH, init, 0, 0
        ),
        "init's limits cannot be changed": lambda: kernel.syscall(
            syscall_number("prlimit64"), init, _RLIMIT_CORE, 0, 0
        ),
    }
    if jail.spec.snapshot in jail.view.refused:
        entry = os.path.join(jail.spec.snapshot, jail.spec.entry)
        denials["the snapshot cannot be written"] = lambda: os.open(entry, os.O_WRONLY)
    for path in jail.view.refused:
        denials[f"{path} cannot be written"] = partial(_make_unnamed, path)
    if jail.common.landlock_abi or jail.common.namespaced:
        canary = jail.common.config.canary
        denials["files outside cannot be read"] = lambda: os.open(canary, os.O_RDONLY)
    if jail.common.landlock_abi >= 6 or jail.common.brokered:
        denials["init cannot be signalled"] = lambda: os.kill(init, 0)
    if jail.common.config.network == "none":
        denials["no internet socket can be made"] = lambda: socket.socket(socket.AF_INET)
    return denials


def _make_unnamed(path: str, folder: int | None = None) -> None:
    """A file without a name: if it can be made, it is gone at once."""
    os.open(path, os.O_TMPFILE | os.O_WRONLY, 0o600, dir_fd=folder)


def _stays_inside(path: str, shared: int) -> bool:
    """Make a file in a view, and look for it in the folder ``shared``; which takes none itself."""
    name = f".{secrets.token_hex(16)}"
    try:
        with contextlib.suppress(OSError):  # where a runner before filled the scratch, for example
            os.close(os.open(f"{path}/{name}", os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
        return not _is_there(name, shared) and _denied(lambda: _make_unnamed(".", shared))
    finally:
        with contextlib.suppress(OSError):
            os.unlink(f"{path}/{name}")
        os.close(shared)  # nothing but this test looks below a view


def _is_there(name: str, folder: int) -> bool:
    try:
        os.lstat(name, dir_fd=folder)
    except FileNotFoundError:
        return False
    return True


def _denied(attempt: Callable[[], object]) -> bool:
    try:
        attempt()
    except OSError:
        return True
    return False


def _is_open(fd: int) -> bool:
    try:
        os.fstat(fd)
    except OSError:
        return False  # the listing's own
    return True


def _hold(claim: str, holds: bool) -> None:
    if not holds:
        raise LayerUnavailableError(
            "self-test",
            f"this is not true: {claim}",
            "Nothing was run. Please report this with the output of `envhub doctor --json`.",
        )
